# SPDX-License-Identifier: Apache-2.0
"""Kind `pose`: position and full orientation of the tool in a frame."""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.geometry import OrientationForm
from loopcal.geometry.alignment import solve_hand_eye
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import POSITION_COLUMNS, Column, Evaluation
from loopcal.measure.kinds.poses.component import SMALL_TILT
from loopcal.measure.kinds.poses.tool_kind import ToolKind
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False)
class Pose(ToolKind):
    """Full pose of the tool. Residual: `(log(R_predicted R_measured'), t_predicted - t_measured)`,
    in axes of the frame.

    With r the rotation part, Q the rotation from base to frame and a the arm from platform origin
    to tool: `d r = J_left^-1(r) Q omega` and `d t = Q (v + omega x a)`.

    Parameters
    ----------
    orientation : str
        Form of the orientation columns, see `loopcal.geometry.OrientationForm`. Noise of a rotation
        vector or a quaternion is a rotation error rx ry rz about the axes of the frame. Noise of
        angles is noise of these angles, except near a singularity of the angles (`|det E| < 0.05`,
        E their rates), where it is a rotation error too.
    form
        The form of the orientation as an object.
    T_base_frame, T_platform_tool, unknown, frame
        See `ToolKind`.

    Raises
    ------
    DataError
        If the orientation form does not exist or a frame is not a pose.
    """

    orientation: str = "rotation-vector"
    form: OrientationForm = field(init=False)

    name: ClassVar[str] = "pose"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "form", geometry.parse_orientation(self.orientation))

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return each form of orientation, and an unknown frame with an unknown tool."""
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
            + POSITION_COLUMNS
        )

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """Three rotations or angles, then x y z."""
        return (
            tuple(Column(name, Dimension.ANGLE) for name in self.form.noise_columns)
            + POSITION_COLUMNS
        )

    def detect_present(self, measured: FloatArray) -> BoolArray:
        """Return which residuals exist: the orientation as a whole, x y z one by one."""
        complete = ~np.any(np.isnan(measured[..., :-3]), axis=-1, keepdims=True)
        return np.concatenate(
            [np.repeat(complete, 3, axis=-1), ~np.isnan(measured[..., -3:])], axis=-1
        )

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Return rows with an incomplete orientation or a quaternion whose length is not 1."""
        orientation = measured[..., :-3]
        missing = np.isnan(orientation)
        incomplete = np.any(missing, axis=-1) & ~np.all(missing, axis=-1)
        invalid = [
            (
                int(i),
                (
                    "has an incomplete orientation; give all of its columns or none, or use the "
                    "kind 'component'"
                ),
            )
            for i in np.flatnonzero(incomplete)
        ]
        if self.orientation == "quaternion":
            length = np.linalg.norm(orientation, axis=-1)
            invalid += [
                (
                    int(i),
                    (
                        f"has a quaternion of length {length[i]:.6g}; the length must be 1 to "
                        "1e-3, with the scalar first"
                    ),
                )
                for i in np.flatnonzero(np.abs(length - 1.0) > 1e-3)
            ]
        return tuple(invalid)

    @property
    def placeholder(self) -> FloatArray:
        """The identity, where no orientation was measured."""
        return np.array([1.0, *[0.0] * 6] if self.orientation == "quaternion" else [0.0] * 6)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        tool = self.predict_tool(T, values)
        R_measured = self.form.to_matrix(self._fill_orientation(measured))
        rotation = geometry.log_so3(tool[..., :3, :3] @ np.swapaxes(R_measured, -1, -2))
        residual = np.concatenate([rotation, tool[..., :3, 3] - measured[..., -3:]], axis=-1)
        slopes = self.linearize_tool(T, values)
        by_rotation = geometry.left_jacobian_inverse_so3(rotation) @ slopes[..., :3, :]
        return self.split_columns(
            residual, np.concatenate([by_rotation, slopes[..., 3:, :]], axis=-2)
        )

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return columns (t, r, c) of the tool pose with noise (t, r, 6).

        The first three numbers of the noise are a rotation error, or are added to the angles.
        """
        tool = self.predict_tool(T, nuisance)
        orientation = self.form.from_matrix(geometry.exp_so3(noise[..., :3]) @ tool[..., :3, :3])
        if self.form.angles:
            exact = self.form.from_matrix(tool[..., :3, :3])
            orientation = np.where(
                _is_singular(self.form.rates(exact))[..., 0], orientation, exact + noise[..., :3]
            )
        return np.concatenate([orientation, tool[..., :3, 3] + noise[..., 3:]], axis=-1)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return frame and tool in closed form, from the complete rows."""
        complete = ~np.any(np.isnan(measured), axis=-1)
        if not self.unknown or np.count_nonzero(complete) < 3:
            return super().guess_values(T, measured)
        poses = geometry.make_pose(
            self.form.to_matrix(measured[complete, :-3]), measured[complete, -3:]
        )
        frame, tool = solve_hand_eye(
            T[complete],
            poses,
            None if "frame" in self.unknown else self.T_base_frame,
            None if "tool" in self.unknown else self._tool(),
        )
        items = {
            "frame": setup.encode_frame(self.T_base_frame, frame),
            "tool": setup.encode_frame(self._tool(), tool),
        }
        return self.assemble_values(items, 1)

    def linearize_noise(self, measured: FloatArray) -> FloatArray:
        """Return the matrix (..., 6, 6): E of the angles (or the identity, see the class) for the
        rotation, the identity for x y z.
        """
        rates = self.form.rates(self._fill_orientation(measured))
        rates = np.where(_is_singular(rates), np.eye(3), rates)
        zero = np.zeros_like(rates)
        identity = np.broadcast_to(np.eye(3), rates.shape)
        top = np.concatenate([rates, zero], axis=-1)
        return np.concatenate([top, np.concatenate([zero, identity], axis=-1)], axis=-2)

    def _fill_orientation(self, measured: FloatArray) -> FloatArray:
        """Return the orientation columns, with the identity where any of them is missing."""
        orientation = measured[..., :-3]
        missing = np.any(np.isnan(orientation), axis=-1, keepdims=True)
        return np.where(missing, self.placeholder[:-3], orientation)


def _is_singular(rates: FloatArray) -> BoolArray:
    """Return whether rates (..., 3, 3) of angles are close to a singularity, (..., 1, 1)."""
    return (np.abs(np.linalg.det(rates)) < SMALL_TILT)[..., None, None]
