# SPDX-License-Identifier: Apache-2.0
"""Kinds that measure the robot's tool in the frame of an instrument: poses and components."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal import engine, geometry
from loopcal.errors import DataError
from loopcal.measure.array_checks import check_names, check_pose, set_fields
from loopcal.measure.kinds import kind
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Column, Evaluation, InvalidRows, Kind, MeasuredColumns
from loopcal.measure.kinds.setup_parameters import POSITION_AXES
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

# Measured tilt [rad] below which the normal replaces phi and theta; the noise of phi is twenty
# times that of theta there.
SMALL_TILT = 0.05
# Smallest |det E| of measured angles; below it a and c are the same rotation to a thousandth.
SINGULAR_RATES = 1e-3


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ToolKind(Kind):
    """A kind that measures the tool in the frame of the instrument.

    T_base_frame : (4, 4), frame of the instrument in the base; default: the base itself. If it is
        unknown, its nominal value.
    T_platform_tool : (4, 4), tool on the platform; default: the tool of the robot.
    unknown : which of "frame" and "tool" are unknown, six numbers each. One value holds for a
        session.
    frame : name of the frame. Kinds that use the same name share its parameters.
    """

    T_base_frame: FloatArray = kind.checked(check_pose, "T_base_frame", np.eye(4))
    T_platform_tool: FloatArray | None = kind.checked(check_pose, "T_platform_tool")
    unknown: tuple[str, ...] = ()
    frame: str = "frame"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "tool")
    length_error: ClassVar[str] = "position"
    angle_error: ClassVar[str] = "orientation"

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """Return the kind with this tool (4, 4), unless it states one."""
        return self if self.has_tool else replace(self, T_platform_tool=T_platform_tool)

    @property
    def has_tool(self) -> bool:
        """Whether the tool is stated; if the tool is unknown, its nominal value."""
        return self.T_platform_tool is not None

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Frame and tool, with six parameters each."""
        tool = np.eye(4) if self.T_platform_tool is None else self.T_platform_tool
        return {
            "frame": setup.make_frame_item(self.frame, self.T_base_frame),
            "tool": setup.make_frame_item("tool", tool),
        }

    def locate_tool(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return T_frame_tool (.., 4, 4) at platform poses T (.., 4, 4), and the derivative
        (.., 6, 6 + u) of its twist, in axes of the frame, by the platform twist and the values.
        """
        if self.measures_platform:
            return T, np.broadcast_to(np.eye(6), (*T.shape[:-2], 6, 6))
        of_frame, of_tool = (self.item_values(values, name) for name in ("frame", "tool"))
        frame = setup.place_frame(self.T_base_frame, of_frame)
        tool = setup.place_frame(self.stated_tool, of_tool)
        inverse = self._stated_inverse if of_frame is None else geometry.invert_pose(frame)
        Q, R = inverse[..., :3, :3], T[..., :3, :3]
        arm = (R @ tool[..., :3, 3:])[..., 0]
        blocks = {"twist": geometry.transport_matrix(arm, Q)}
        if of_frame is not None:
            # a motion of the frame is the opposite motion of the tool in that frame
            lever = arm + T[..., :3, 3] - frame[..., :3, 3]
            by_twist = -geometry.transport_matrix(lever, Q)
            blocks["frame"] = by_twist @ setup.linearize_frame(of_frame)
        if of_tool is not None:
            by_twist = geometry.transport_matrix(np.zeros(3), Q @ R)
            blocks["tool"] = by_twist @ setup.linearize_frame(of_tool)
        return inverse @ (T @ tool), self.join_columns(blocks, (*T.shape[:-2], 6))

    @cached_property
    def measures_platform(self) -> bool:
        """Whether the tool and the frame are those of platform and base, and known to be."""
        same = all(np.array_equal(a, np.eye(4)) for a in (self.T_base_frame, self.stated_tool))
        return same and not self.own_items

    @cached_property
    def _stated_inverse(self) -> FloatArray:
        return geometry.invert_pose(self.T_base_frame)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return 24 evenly spread orientations of the frame."""
        return self.spread_frames()

    @property
    def stated_tool(self) -> FloatArray:
        """The stated tool (4, 4); DataError where the kind has none."""
        if self.T_platform_tool is None:
            raise DataError(
                f"the kind {self.name!r} has no tool: use kind.with_tool(robot.tool), or "
                f"give T_platform_tool (np.eye(4) for the platform itself)"
            )
        return self.T_platform_tool


@dataclass(frozen=True, eq=False, repr=False)
class Pose(ToolKind):
    """Position and orientation of the tool, in axes of the frame.

    Residual: `(log(R_predicted R_measured'), t_predicted - t_measured)`.
    Setup parameters: `frame.rx` to `frame.rz` [rad], `frame.x` to `frame.z` [m]; likewise
    `tool.rx` to `tool.z`.

    Parameters
    ----------
    orientation : form of the orientation columns, see `loopcal.geometry.OrientationForm`. Noise of
        a rotation vector or a quaternion is a rotation error rx ry rz about the axes of the frame.
        Noise of angles is noise of these angles, except near a singularity of the angles (`|det E|
        < 0.05`, E their rates), where it is a rotation error too.
    Others : see `ToolKind`.

    Raises
    ------
    DataError : the orientation form does not exist or a frame is not a pose.

    Notes
    -----
    With r the rotation part, Q the rotation from base to frame and a the arm from platform origin
    to tool: `d r = J_left^-1(r) Q omega` and `d t = Q (v + omega x a)`.

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
    def form(self) -> geometry.OrientationForm:
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
        return orientation + kind.POSITION_COLUMNS

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """Three rotations or angles, then x y z."""
        rotations = tuple(Column(name, Dimension.ANGLE) for name in self.form.noise_columns)
        return rotations + kind.POSITION_COLUMNS

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
        incomplete = (
            "has an incomplete orientation. Give all of its columns or none, or use the kind "
            "'component'"
        )
        invalid = kind.list_rows(kind.is_incomplete(orientation), lambda _: incomplete)
        if self.orientation != "quaternion":
            return invalid
        return invalid + kind.list_not_unit(orientation, "quaternion", ", with the scalar first")

    @property
    def placeholder(self) -> FloatArray:
        """The identity, where no orientation was measured."""
        return np.array([1.0, *[0.0] * 6] if self.orientation == "quaternion" else [0.0] * 6)

    def _compute_reference(self, measured: FloatArray) -> FloatArray:
        """Return the nine entries of the measured rotation, then x y z."""
        R = self.form.to_matrix(self._fill_orientation(measured))
        return np.concatenate([R.reshape(*R.shape[:-2], 9), measured[..., -3:]], axis=-1)

    def compare_platform(self, measured: MeasuredColumns) -> tuple[FloatArray, FloatArray] | None:
        """Return the measured poses, all of whose differences are residuals."""
        return (measured.reference, np.eye(6)) if self.measures_platform else None

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
        """Return the columns; the noise begins with a rotation error, or is added to the angles."""
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
        frame, tool = geometry.solve_hand_eye(
            T[complete],
            geometry.make_pose(self.form.to_matrix(columns[:, :-3]), columns[:, -3:]),
            None if "frame" in self.unknown else self.T_base_frame,
            None if "tool" in self.unknown else self.stated_tool,
        )
        of_frame = setup.encode_frame(self.T_base_frame, frame)
        of_tool = setup.encode_frame(self.stated_tool, tool)
        return self.assemble_values({"frame": of_frame, "tool": of_tool})

    def linearize_noise(self, measured: FloatArray) -> FloatArray:
        """Return E of the angles (or the identity, see the class), and the identity for x y z."""
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
    """Return residuals (t, r, 6) of poses T (t | 1, r, 4, 4), with derivatives by the twists of T.

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


@dataclass(frozen=True, eq=False, repr=False)
class Component(ToolKind):
    """Some coordinates of the tool. z alone is a probed height. Residual: `predicted - measured` of
    each, angles wrapped into (-pi, pi].

    Below a measured tilt of 0.05 rad, the residuals of theta and phi are the differences of the
    normal's x and y [rad]. The sigma of theta and phi applies to these differences.

    Setup parameters: those of `Pose`.

    Parameters
    ----------
    components : measured coordinates in the order of the columns: x y z, and angles of the declared
        orientation.
    orientation : form of the angles, "tilt-torsion" (phi theta psi) or "euler-" and an order (a b
        c). Required for angles.
    Others : see `ToolKind`.

    Raises
    ------
    DataError : a component does not exist or is named twice, if angles have no declared
        orientation, or if phi is measured without theta.

    Notes
    -----
    With E the rates of the declared angles, Q the rotation from base to frame and a the arm from
    platform origin to tool: `d(angles) = E^-1 Q omega`, `d t = Q (v + omega x a)`, and of the
    normal `d n = (Q omega) x n`.

    Examples
    --------
    >>> kind = Component(("z", "psi"), "tilt-torsion", unknown=("frame",), frame="plate")
    >>> [(column.name, column.dimension.value) for column in kind.columns]
    [('z', 'length'), ('psi', 'angle')]
    >>> [parameter.name for parameter in kind.nuisance_parameters]
    ['plate.rx', 'plate.ry', 'plate.rz', 'plate.x', 'plate.y', 'plate.z']
    """

    components: tuple[str, ...] = ("z",)
    orientation: str | None = None

    name: ClassVar[str] = "component"

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, components=tuple(self.components))
        form = self.form
        if form is not None and not form.angles:
            raise DataError(
                f"a {form.name} has no single components to measure. Declare tilt-torsion, or "
                "euler- with an order such as euler-xyz, or use the kind 'pose'"
            )
        for name in self.components:
            if name not in self._coordinates:
                hint = "; for angles, declare orientation: tilt-torsion" if form is None else ""
                raise DataError(
                    f"the component {name!r} does not exist. Use {', '.join(self._coordinates)}"
                    f"{hint}"
                )
        check_names(self.components, "components")
        if "phi" in self.components and "theta" not in self.components:
            raise DataError(
                "phi needs theta, because phi has no value at theta = 0. Measure both or neither"
            )

    @cached_property
    def form(self) -> geometry.OrientationForm | None:
        """The form of the orientation, None where no angle is declared."""
        return None if self.orientation is None else geometry.parse_orientation(self.orientation)

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a height, a point, five of six coordinates, angles alone, and unknown frames."""
        return (
            cls(("z",)),
            cls(("x", "y", "z")),
            cls(("x", "y", "z", "phi", "theta"), "tilt-torsion"),
            cls(("psi", "theta"), "tilt-torsion"),
            cls(("z", "a", "b"), "euler-xyz"),
            cls(("c", "a", "b"), "euler-ZXZ"),
            cls(("x", "y", "z", "phi", "theta"), "tilt-torsion", unknown=("frame",)),
            cls(("z", "x"), unknown=("tool", "frame")),
        )

    @property
    def columns(self) -> tuple[Column, ...]:
        """The components."""
        return tuple(
            Column(name, Dimension.LENGTH if name in POSITION_AXES else Dimension.ANGLE)
            for name in self.components
        )

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows at the singularity of the Euler angles."""
        if self.form is None or "b" not in self.components:
            return ()
        name, middle = self.form.name, measured[..., self.components.index("b")]
        angles = np.stack([np.zeros_like(middle), middle, np.zeros_like(middle)], axis=-1)
        determinant = np.abs(np.linalg.det(self.form.rates(np.nan_to_num(angles, nan=0.5))))
        return kind.list_rows(
            determinant < SINGULAR_RATES,
            lambda i: (
                f"has b = {np.rad2deg(middle[i]):.6g} deg, at which a and c of {name} are one "
                "rotation. Declare another order, or use the kind 'pose'"
            ),
        )

    @property
    def placeholder(self) -> FloatArray:
        """NaN: only its own component depends on it, unless the normal replaces two of them."""
        return np.full(1, np.nan)

    def compare_platform(self, measured: MeasuredColumns) -> tuple[FloatArray, FloatArray] | None:
        """Return places with any rotation, where all components are those of a place."""
        if self.form is not None or not self.measures_platform:
            return None
        columns = [3 + POSITION_AXES.index(name) for name in self.components]
        reference = np.zeros((*measured.columns.shape[:-1], 12))
        reference[..., [0, 4, 8]] = 1.0
        reference[..., [6 + column for column in columns]] = measured.columns
        return reference, np.eye(6)[columns]

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        tool, by_tool = self.locate_tool(T, values)
        predicted, slopes = self._predict_components(tool)
        return self.split_columns(predicted, slopes @ by_tool)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        """Replace phi and theta by the normal where the measured tilt is small."""
        if "phi" not in self.components:
            return super()._evaluate(T, measured, values, joints)
        tool, by_tool = self.locate_tool(T, values)
        predicted, slopes = self._predict_components(tool)
        residual = self._subtract(predicted, measured)
        theta, phi = (measured[..., i] for i in self._normal_indices)
        flat = ((np.abs(theta) < SMALL_TILT) & ~np.isnan(phi))[..., None]
        normal, by_rotation = tool[..., :3, 2], -geometry.hat(tool[..., :3, 2])
        by_twist = np.concatenate([by_rotation, np.zeros_like(by_rotation)], axis=-1)
        measured_normal = (np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta))
        indices = np.arange(len(self.components))
        for i, index in enumerate(self._normal_indices):
            replaced = flat & (indices == index)
            difference = (normal[..., i] - measured_normal[i])[..., None]
            residual = np.where(replaced, difference, residual)
            slopes = np.where(replaced[..., None], by_twist[..., i, None, :], slopes)
        return self.split_columns(residual, slopes @ by_tool)

    def _measure(
        self, T: FloatArray, noise: FloatArray, values: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return the columns; near zero tilt the noise of phi and theta is that of the normal."""
        tool, _ = self.locate_tool(T, values)
        exact, _ = self._predict_components(tool)
        noisy = exact + noise
        if "phi" not in self.components:
            return noisy
        theta, phi = self._normal_indices
        x, y = tool[..., 0, 2] + noise[..., theta], tool[..., 1, 2] + noise[..., phi]
        tilt, azimuth = np.arcsin(np.clip(np.hypot(x, y), 0.0, 1.0)), np.arctan2(y, x)
        flat = np.abs(exact[..., theta, None]) < SMALL_TILT
        indices = np.arange(len(self.components))
        noisy = np.where(flat & (indices == theta), tilt[..., None], noisy)
        return np.where(flat & (indices == phi), azimuth[..., None], noisy)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the frame from positions where x, y and z are measured, else 24 orientations."""
        complete = ~np.any(np.isnan(measured), axis=-1)
        if (
            self.unknown != ("frame",)
            or not set(POSITION_AXES) <= set(self.components)
            or np.count_nonzero(complete) < 3
        ):
            return super().guess_values(T, measured)
        points = (T @ self.stated_tool)[complete, :3, 3]
        positions = measured[complete][:, [self.components.index(name) for name in POSITION_AXES]]
        frame = geometry.align_point_sets(positions, points)
        return setup.encode_frame(self.T_base_frame, frame)[None]

    @property
    def _coordinates(self) -> tuple[str, ...]:
        """All coordinates that can be measured: three angles (if declared), then x y z."""
        return (() if self.form is None else self.form.columns) + POSITION_AXES

    @property
    def _normal_indices(self) -> tuple[int, int]:
        return self.components.index("theta"), self.components.index("phi")

    def _predict_components(self, tool: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return components (..., m) of tool poses (..., 4, 4) and their derivative (..., m, 6) by
        the tool's twist, in axes of the frame.
        """
        values = tool[..., :3, 3]
        rows = np.broadcast_to(np.eye(6)[3:], (*values.shape, 6))
        if self.form is not None:
            angles = self.form.from_matrix(tool[..., :3, :3])
            inverse = self.form.rates_inverse(angles)
            by_angles = np.concatenate([inverse, np.zeros_like(inverse)], axis=-1)
            values = np.concatenate([angles, values], axis=-1)
            rows = np.concatenate([by_angles, rows], axis=-2)
        indices = np.array([self._coordinates.index(name) for name in self.components])
        return values[..., indices], rows[..., indices, :]
