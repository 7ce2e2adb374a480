# SPDX-License-Identifier: Apache-2.0
"""Bases of the kinds that measure directions: an axis of the platform from a frame, or gravity on
the platform.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from loopcal import geometry
from loopcal.geometry.alignment import solve_directions
from loopcal.measure.array_checks import check_pose, set_fields
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.rows import Evaluation
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class DirectionKind(Kind):
    """A kind that is a function of a direction `d = S' Q a`, with S an orientation and a a
    direction; both may be unknown.

    Outward, Q = R, the platform's rotation: a is an axis of the platform, S the orientation of an
    instrument in the base. Inward, Q = R': a is a direction of the base (gravity), S the mounting
    of a sensor on the platform. With s the rotation of S: `dd = S' (dQ a) + S' Q da + S' (Q a x
    s)`, where `dR a = omega x R a`, `dR' a = R' (a x omega)`.

    Parameters
    ----------
    unknown : tuple of str
        Which of `allowed_unknown`, (orientation, direction), are unknown: three and two numbers.
        One value holds for a session.
    """

    unknown: tuple[str, ...] = ()

    inward: ClassVar[bool] = False
    angle_error: ClassVar[str] = "orientation"

    @property
    @abstractmethod
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Name and rotation (3, 3) of the orientation; name and unit vector of the direction."""

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Orientation and direction."""
        orientation, S, direction, a = self.stated
        items = (
            setup.make_orientation_item(orientation, S),
            setup.make_direction_item(direction, a),
        )
        return dict(zip(self.allowed_unknown, items, strict=True))

    def locate_direction(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the direction d (.., 3) and its derivative (.., 3, 6 + u)."""
        _, S, _, stated = self.stated
        of_orientation, of_direction = self.allowed_unknown
        rotation, angles = (self.item_values(values, name) for name in self.allowed_unknown)
        R = T[..., :3, :3]
        Q = np.swapaxes(R, -1, -2) if self.inward else R
        if rotation is not None:
            S = geometry.exp_so3(rotation) @ S
        St = np.swapaxes(S, -1, -2)
        a = setup.place_direction(stated, angles)
        rotated = (Q @ a[..., None])[..., 0]
        by_omega = St @ (Q @ geometry.hat(a) if self.inward else -geometry.hat(rotated))
        blocks = {"twist": np.concatenate([by_omega, np.zeros_like(by_omega)], axis=-1)}
        if rotation is not None:
            by_rotation = geometry.left_jacobian_so3(rotation)
            blocks[of_orientation] = St @ geometry.hat(rotated) @ by_rotation
        if angles is not None:
            blocks[of_direction] = St @ Q @ setup.linearize_direction(stated, angles)
        d = (St @ rotated[..., None])[..., 0]
        return d, self.join_columns(blocks, d.shape)

    @abstractmethod
    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the columns (.., m) of directions d (.., 3), and their derivatives (.., m, 3)."""

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        d, rows = self.locate_direction(T, values)
        predicted, slopes = self.predict(d)
        return self.split_columns(predicted, slopes @ rows)

    @abstractmethod
    def convert_to_directions(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return the unit vectors d (.., 3) that columns (.., c) can stand for, usually one."""

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return orientation and direction in closed form, from the whole rotation group."""
        complete = ~np.any(np.isnan(measured), axis=-1)
        if not self.unknown or np.count_nonzero(complete) < 3:
            return self.nominal_values[None]
        R = T[complete, :3, :3]
        Q = np.swapaxes(R, -1, -2) if self.inward else R
        directions = self.convert_to_directions(measured[complete])
        return np.concatenate([self._solve(Q, d) for d in directions])

    def _solve(self, Q: FloatArray, d: FloatArray) -> FloatArray:
        """Return candidates (k, u) from measured directions d (r, 3)."""
        _, S, _, a = self.stated
        of_orientation, of_direction = self.allowed_unknown
        if of_orientation in self.unknown:
            known = None if of_direction in self.unknown else a
            rotations, directions = solve_directions(d, Q, known)
        else:
            mean = np.einsum("rji,jk,rk->i", Q, S, d)
            rotations, directions = S[None], (mean / np.linalg.norm(mean))[None]
        items = {
            of_orientation: setup.encode_rotation(S, rotations),
            of_direction: setup.encode_direction(a, directions),
        }
        return self.assemble_values(items)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class AxisKind(DirectionKind):
    """A kind that measures an axis of the platform in the frame of an instrument.

    Parameters
    ----------
    T_base_frame : (4, 4)
        Frame of the instrument in the base; only its orientation matters.
    frame : str
        Name of the frame. Kinds that use the same name share its parameters.
    Others: see `DirectionKind`.
    """

    T_base_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    frame: str = "frame"

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, T_base_frame=check_pose(self.T_base_frame, "T_base_frame"))
