# SPDX-License-Identifier: Apache-2.0
"""Kind `pose`: position and full orientation of the tool in a frame."""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.geometry.orientation_forms import OrientationForm, parse_orientation
from loopcal.measure.closed_form import hand_eye
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.component import FLAT
from loopcal.measure.kinds.kind import Bools, Column, Evaluation
from loopcal.measure.kinds.tool import ToolKind, position_columns, stacked
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False)
class Pose(ToolKind):
    """Full pose of the tool. Residual `(log(R_predicted R_measured'), t_predicted - t_measured)`,
    in axes of the frame.

    With r the rotation part, Q the turn from base to frame and a the arm from platform origin to
    tool, `d r = J_left^-1(r) Q omega` and `d t = Q (v + omega x a)`.

    Parameters
    ----------
    orientation : str
        Form of the orientation columns, see `loopcal.geometry.orientation_forms`. Noise of a
        rotation vector or a quaternion is a rotation error rx ry rz about the axes of the frame;
        noise of angles is theirs, and is mapped. Where two angles are nearly the same turn (`|det
        E| < FLAT`, E their rates), it counts as a rotation error, too.
    form
        The same as an object.
    T_base_frame, T_platform_tool, unknown, frame
        See `ToolKind`.

    Raises
    ------
    DataError
        If the orientation is unknown or a frame is not a pose.
    """

    orientation: str = "rotation-vector"
    form: OrientationForm = field(init=False, repr=False)

    name: ClassVar[str] = "pose"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "form", parse_orientation(self.orientation))

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """One of each form of orientation, and one with unknown frame and tool."""
        names = (
            "rotation-vector",
            "quaternion",
            "tilt-torsion",
            "euler-xyz",
            "euler-ZYX",
            "euler-ZXZ",
        )
        return (*(cls(name) for name in names), cls(unknown=("frame", "tool"), frame="tracker"))

    @property
    def columns(self) -> tuple[Column, ...]:
        """Orientation, then x y z."""
        return (
            tuple(Column(name, self.form.dimension) for name in self.form.columns)
            + position_columns()
        )

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """Three rotations or angles, then x y z."""
        return (
            tuple(Column(name, Dimension.ANGLE) for name in self.form.noise_columns)
            + position_columns()
        )

    def detect_present(self, measured: FloatArray) -> Bools:
        """Orientation is there as a whole or not at all, x y z each for itself."""
        whole = ~np.any(np.isnan(measured[..., :-3]), axis=-1, keepdims=True)
        return np.concatenate(
            [np.repeat(whole, 3, axis=-1), ~np.isnan(measured[..., -3:])], axis=-1
        )

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Rows with a part of an orientation, or with a quaternion that is not of length one."""
        turned = measured[..., :-3]
        missing = np.isnan(turned)
        partly = np.any(missing, axis=-1) & ~np.all(missing, axis=-1)
        found = [
            (
                int(i),
                (
                    "has only a part of its orientation; give all of it or none, or use the kind "
                    "'component'"
                ),
            )
            for i in np.flatnonzero(partly)
        ]
        if self.orientation == "quaternion":
            length = np.linalg.norm(turned, axis=-1)
            found += [
                (
                    int(i),
                    (
                        f"has a quaternion of length {length[i]:.6g}; it must be 1 to 1e-3, scalar "
                        "first"
                    ),
                )
                for i in np.flatnonzero(np.abs(length - 1.0) > 1e-3)
            ]
        return tuple(found)

    @property
    def placeholder(self) -> FloatArray:
        """The identity for an orientation that was not measured."""
        return np.array([1.0, *[0.0] * 6] if self.orientation == "quaternion" else [0.0] * 6)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        seen = self.seen(T, values)
        turned = self.form.to_matrix(self._filled(measured))
        rotation = geometry.log_so3(seen[..., :3, :3] @ np.swapaxes(turned, -1, -2))
        residual = np.concatenate([rotation, seen[..., :3, 3] - measured[..., -3:]], axis=-1)
        moved = self.transport(T, values)
        turning = geometry.left_jacobian_inverse_so3(rotation) @ moved[..., :3, :]
        return self.split(residual, np.concatenate([turning, moved[..., 3:, :]], axis=-2))

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns (t, r, c) of the tool pose with noise (t, r, 6): a rotation error, or added to
        the angles.
        """
        seen = self.seen(T, unknowns)
        turned = self.form.from_matrix(geometry.exp_so3(noise[..., :3]) @ seen[..., :3, :3])
        if self.form.angles:
            exact = self.form.from_matrix(seen[..., :3, :3])
            turned = np.where(
                _degenerate(self.form.rates(exact))[..., 0], turned, exact + noise[..., :3]
            )
        return np.concatenate([turned, seen[..., :3, 3] + noise[..., 3:]], axis=-1)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Frame and tool in closed form, from rows that are complete."""
        whole = ~np.any(np.isnan(measured), axis=-1)
        if not self.unknown or np.count_nonzero(whole) < 3:
            return super().guess_values(T, measured)
        seen = geometry.make_pose(self.form.to_matrix(measured[whole, :-3]), measured[whole, -3:])
        frame, tool = hand_eye(
            T[whole],
            seen,
            None if "frame" in self.unknown else self.T_base_frame,
            None if "tool" in self.unknown else self._tool(),
        )
        found = {
            "frame": parts.frame_values(self.T_base_frame, frame),
            "tool": parts.frame_values(self._tool(), tool),
        }
        return stacked(self, found, 1)

    def linearize_noise(self, measured: FloatArray) -> FloatArray:
        """Matrix (..., 6, 6): E of the angles (or the identity, see the class) for the rotation,
        the identity for x y z.
        """
        rates = self.form.rates(self._filled(measured))
        rates = np.where(_degenerate(rates), np.eye(3), rates)
        zero = np.zeros_like(rates)
        identity = np.broadcast_to(np.eye(3), rates.shape)
        top = np.concatenate([rates, zero], axis=-1)
        return np.concatenate([top, np.concatenate([zero, identity], axis=-1)], axis=-2)

    def _filled(self, measured: FloatArray) -> FloatArray:
        """Orientation columns, with the identity where any of them was not measured."""
        turned = measured[..., :-3]
        return np.where(
            np.any(np.isnan(turned), axis=-1, keepdims=True), self.placeholder[:-3], turned
        )


def _degenerate(rates: FloatArray) -> Bools:
    """Whether angles with these rates (..., 3, 3) are nearly the same turn, (..., 1, 1)."""
    return (np.abs(np.linalg.det(rates)) < FLAT)[..., None, None]
