# SPDX-License-Identifier: Apache-2.0
"""Kind `pose`: position and full orientation of the tool in a frame."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal import engine, geometry
from loopcal.geometry import OrientationForm
from loopcal.geometry.alignment import solve_hand_eye
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.poses.tool_kind import SMALL_TILT, ToolKind
from loopcal.measure.kinds.rows import (
    POSITION_COLUMNS,
    Column,
    Evaluation,
    InvalidRows,
    is_incomplete,
    list_rows,
)
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False)
class Pose(ToolKind):
    """Full pose of the tool. Residual: `(log(R_predicted R_measured'), t_predicted - t_measured)`,
    in axes of the frame.

    With r the rotation part, Q the rotation from base to frame and a the arm from platform origin
    to tool: `d r = J_left^-1(r) Q omega` and `d t = Q (v + omega x a)`.

    Setup parameters: `frame.rx` to `frame.rz` [rad], `frame.x` to `frame.z` [m]; likewise
    `tool.rx` to `tool.z`.

    Parameters
    ----------
    orientation : str
        Form of the orientation columns, see `loopcal.geometry.OrientationForm`. Noise of a rotation
        vector or a quaternion is a rotation error rx ry rz about the axes of the frame. Noise of
        angles is noise of these angles, except near a singularity of the angles (`|det E| < 0.05`,
        E their rates), where it is a rotation error too.
    T_base_frame, T_platform_tool, unknown, frame
        See `ToolKind`.

    Raises
    ------
    DataError
        If the orientation form does not exist or a frame is not a pose.

    Examples
    --------
    >>> from loopcal.geometry import make_pose, rotation_about_axis
    >>> kind = Pose("euler-xyz", T_platform_tool=np.eye(4))
    >>> T = make_pose(rotation_about_axis(0.1, 0), np.array([1.0, 2.0, 3.0]))
    >>> kind.measure(T[None, None], noise=np.zeros((1, 1, 6))).round(6)
    array([[[0.1, 0. , 0. , 1. , 2. , 3. ]]])
    """

    orientation: str = "rotation-vector"

    name: ClassVar[str] = "pose"

    def __post_init__(self) -> None:
        super().__post_init__()
        geometry.parse_orientation(self.orientation)  # refuses an unknown form

    @cached_property
    def form(self) -> OrientationForm:
        """The form of the orientation as an object."""
        return geometry.parse_orientation(self.orientation)

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return each form of orientation, and an unknown frame with an unknown tool."""
        angles = ("tilt-torsion", "euler-xyz", "euler-ZYX", "euler-ZXZ")
        forms = (cls(form) for form in ("rotation-vector", "quaternion", *angles))
        return (*forms, cls(unknown=("frame", "tool"), frame="tracker"))

    @property
    def columns(self) -> tuple[Column, ...]:
        """Orientation, then x y z."""
        orientation = tuple(Column(name, self.form.dimension) for name in self.form.columns)
        return orientation + POSITION_COLUMNS

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """Three rotations or angles, then x y z."""
        rotations = tuple(Column(name, Dimension.ANGLE) for name in self.form.noise_columns)
        return rotations + POSITION_COLUMNS

    def detect_present(self, measured: FloatArray) -> BoolArray:
        """Return which residuals exist: the orientation as a whole, x y z one by one."""
        is_missing = np.isnan(measured)
        present = np.ones((*measured.shape[:-1], 6), dtype=bool)
        if is_missing.any():  # rarely, and several times as long
            present[..., :3] = ~is_missing[..., :-3].any(axis=-1, keepdims=True)
            present[..., 3:] = ~is_missing[..., -3:]
        return present

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows with an incomplete orientation or a quaternion whose length is not 1."""
        orientation = measured[..., :-3]
        invalid = list_rows(
            is_incomplete(orientation),
            lambda _: (
                "has an incomplete orientation; give all of its columns or none, or use the "
                "kind 'component'"
            ),
        )
        if self.orientation != "quaternion":
            return invalid
        length = np.linalg.norm(orientation, axis=-1)
        return invalid + list_rows(
            np.abs(length - 1.0) > 1e-3,
            lambda i: (
                f"has a quaternion of length {length[i]:.6g}; the length must be 1 to 1e-3, "
                "with the scalar first"
            ),
        )

    @property
    def placeholder(self) -> FloatArray:
        """The identity, where no orientation was measured."""
        return np.array([1.0, *[0.0] * 6] if self.orientation == "quaternion" else [0.0] * 6)

    def _compute_reference(self, measured: FloatArray) -> FloatArray:
        """Return the nine entries of the measured rotation, then x y z."""
        R = self.form.to_matrix(self._fill_orientation(measured))
        return np.concatenate([R.reshape(*R.shape[:-2], 9), measured[..., -3:]], axis=-1)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        tool, rows = self.locate_tool(T, values)
        residual, by_twist = compare_poses(tool, measured)
        if self.measures_platform:
            return Evaluation(residual, by_twist)
        by_rotation = by_twist[..., :3, :3] @ rows[..., :3, :]
        return self.split_columns(
            residual, np.concatenate([by_rotation, rows[..., 3:, :]], axis=-2)
        )

    def _measure(
        self, T: FloatArray, noise: FloatArray, values: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return columns (t, r, c) of the tool pose with noise (t, r, 6).

        The first three numbers of the noise are a rotation error, or are added to the angles.
        """
        tool, _ = self.locate_tool(T, values)
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
        columns = measured[complete]
        frame, tool = solve_hand_eye(
            T[complete],
            geometry.make_pose(self.form.to_matrix(columns[:, :-3]), columns[:, -3:]),
            None if "frame" in self.unknown else self.T_base_frame,
            None if "tool" in self.unknown else self.stated_tool,
        )
        items = {
            "frame": setup.encode_frame(self.T_base_frame, frame),
            "tool": setup.encode_frame(self.stated_tool, tool),
        }
        return self.assemble_values(items)

    def linearize_noise(self, measured: FloatArray) -> FloatArray:
        """Return the matrix (..., 6, 6): E of the angles (or the identity, see the class) for the
        rotation, the identity for x y z.
        """
        if not self.form.angles:
            return np.broadcast_to(np.eye(6), (*measured.shape[:-1], 6, 6))
        rates = self.form.rates(self._fill_orientation(measured))
        rates = np.where(_is_singular(rates), np.eye(3), rates)
        return setup.stack_diagonally(rates, np.eye(3))

    def _fill_orientation(self, measured: FloatArray) -> FloatArray:
        """Return the orientation columns, with the identity where any of them is missing."""
        orientation = measured[..., :-3]
        missing = np.any(np.isnan(orientation), axis=-1, keepdims=True)
        return np.where(missing, self.placeholder[:-3], orientation)


def _is_singular(rates: FloatArray) -> BoolArray:
    """Return whether rates (..., 3, 3) of angles are close to a singularity, (..., 1, 1)."""
    return (np.abs(np.linalg.det(rates)) < SMALL_TILT)[..., None, None]


def compare_poses(T: FloatArray, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (t, r, 6) of poses T (t | 1, r, 4, 4), and their derivatives (t, r, 6, 6) by
    the twists of T.

    reference : (t | 1, r, 12) rotations row by row, then positions.
    """
    compared = engine.compare_poses(T, reference)
    if compared is not None:
        return compared
    R = reference[..., :9].reshape(*reference.shape[:-1], 3, 3)
    rotation = geometry.log_so3(T[..., :3, :3] @ np.swapaxes(R, -1, -2))
    residual = np.concatenate([rotation, T[..., :3, 3] - reference[..., -3:]], axis=-1)
    inverse = geometry.left_jacobian_inverse_so3(rotation)
    return residual, setup.stack_diagonally(inverse, np.eye(3))
