# SPDX-License-Identifier: Apache-2.0
"""Base of the kinds that measure directions: an axis of the platform from a frame, or gravity on
the platform.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal import geometry
from loopcal.geometry.alignment import solve_directions
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Evaluation, Kind
from loopcal.parameters import Parameter
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

    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "axis")
    inward: ClassVar[bool] = False

    @property
    @abstractmethod
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Name and rotation (3, 3) of the orientation; name and unit vector of the direction."""

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """Orientation and direction, if unknown."""
        orientation, _, direction, _ = self.stated
        items = {
            self.allowed_unknown[0]: setup.make_rotation_parameters(orientation),
            self.allowed_unknown[1]: setup.make_direction_parameters(direction),
        }
        return {name: items[name] for name in self.unknown}

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientation and direction."""
        orientation, S, direction, a = self.stated
        stated = {
            self.allowed_unknown[0]: (orientation, S),
            self.allowed_unknown[1]: (direction, a),
        }
        return dict(stated[name] for name in self.unknown)

    def locate_direction(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the direction d (.., 3) and its derivative (.., 3, 6 + u)."""
        _, S, _, a = self.stated
        of_orientation, of_direction = self.allowed_unknown
        rotation, angles = (self.item_values(values, name) for name in self.allowed_unknown)
        R = T[..., :3, :3]
        Q = np.swapaxes(R, -1, -2) if self.inward else R
        if rotation is not None:
            S = geometry.exp_so3(rotation) @ S
        St = np.swapaxes(S, -1, -2)
        a = setup.place_direction(a, angles)
        rotated = (Q @ a[..., None])[..., 0]
        by_omega = Q @ geometry.hat(a) if self.inward else -geometry.hat(rotated)
        by_omega = St @ by_omega
        blocks = {"twist": np.concatenate([by_omega, np.zeros_like(by_omega)], axis=-1)}
        if rotation is not None:
            blocks[of_orientation] = (
                St @ geometry.hat(rotated) @ geometry.left_jacobian_so3(rotation)
            )
        if angles is not None:
            blocks[of_direction] = St @ Q @ setup.linearize_direction(self.stated[3], angles)
        d = (St @ rotated[..., None])[..., 0]
        return d, self.join_columns(blocks, d.shape)

    @abstractmethod
    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the columns (.., m) of directions d (.., 3), and their derivatives (.., m, 3)."""

    @abstractmethod
    def convert_to_directions(self, measured: FloatArray) -> FloatArray:
        """Return the unit vectors d (.., 3) of columns (.., c)."""

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        d, rows = self.locate_direction(T, values)
        predicted, slopes = self.predict(d)
        return self.split_columns(geometry.wrap_angle(predicted - measured), slopes @ rows)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return columns (t, r, c) with noise added."""
        return (
            self.predict(self.locate_direction(T, self.values_or_nominal(nuisance))[0])[0] + noise
        )

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return orientation and direction in closed form, from the whole rotation group."""
        complete = ~np.any(np.isnan(measured), axis=-1)
        if not self.unknown or np.count_nonzero(complete) < 3:
            return self.nominal_values[None]
        Q = T[complete, :3, :3]
        if self.inward:
            Q = np.swapaxes(Q, -1, -2)
        return np.concatenate(
            [self._solve(Q, d) for d in self.interpret_columns(measured[complete])]
        )

    def interpret_columns(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """Return all directions (r, 3) that columns (r, c) can stand for."""
        return (self.convert_to_directions(measured),)

    def _solve(self, Q: FloatArray, d: FloatArray) -> FloatArray:
        """Return candidates (k, u) from measured directions d (r, 3)."""
        _, S, _, a = self.stated
        of_orientation, of_direction = self.allowed_unknown
        if of_orientation in self.unknown:
            rotations, directions = solve_directions(
                d, Q, None if of_direction in self.unknown else a
            )
        else:
            mean = np.einsum("rji,jk,rk->i", Q, S, d)
            rotations, directions = S[None], (mean / np.linalg.norm(mean))[None]
        items = {
            of_orientation: setup.encode_rotation(S, rotations),
            of_direction: setup.encode_direction(a, directions),
        }
        return self.assemble_values(items, len(rotations))
