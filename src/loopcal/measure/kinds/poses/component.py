# SPDX-License-Identifier: Apache-2.0
"""Kind `component`: some coordinates of the tool in a frame; z alone is a probed height.

Angles are those of the declared orientation; their differences are wrapped. Near zero tilt the
azimuth phi is not defined. There the x and y components of the unit normal replace theta and phi.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.geometry import OrientationForm
from loopcal.geometry.alignment import align_point_sets
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Column, Evaluation
from loopcal.measure.kinds.poses.tool_kind import ToolKind
from loopcal.measure.kinds.setup_parameters import POSITION_AXES
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

SMALL_TILT = 0.05
"""Measured tilt [rad] below which the normal replaces phi and theta; the noise of phi is twenty
times that of theta there.
"""

SINGULAR_RATES = 1e-3
"""Smallest |det E| of measured angles [1]; below it a and c are the same rotation to
a thousandth.
"""


@dataclass(frozen=True, eq=False, repr=False)
class Component(ToolKind):
    """Some coordinates of the tool. Residual: `predicted - measured` of each, angles wrapped into
    (-pi, pi].

    With E the rates of the declared angles, Q the rotation from base to frame and a the arm from
    platform origin to tool: `d(angles) = E^-1 Q omega` and `d t = Q (v + omega x a)`. Where the
    measured tilt is below 0.05 rad, the residuals of theta and phi are the differences of the
    normal's x and y [rad], with `d n = (Q omega) x n`; a sigma stated for theta and phi applies to
    these differences.

    Parameters
    ----------
    components : tuple of str
        Measured coordinates in the order of the columns: x y z, and angles of the declared
        orientation.
    orientation : str, optional
        Form of the angles, "tilt-torsion" (phi theta psi) or "euler-" and an order (a b c).
        Required if an angle is measured.
    form, _component_indices
        The form of the orientation, and the index of each component among all: three angles (if
        declared), then x y z.
    T_base_frame, T_platform_tool, unknown, frame
        See `ToolKind`.

    Raises
    ------
    DataError
        If a component does not exist or is named twice, if angles have no declared orientation, or
        if phi is measured without theta.
    """

    components: tuple[str, ...] = ("z",)
    orientation: str | None = None

    form: OrientationForm | None = field(init=False)
    _component_indices: IntArray = field(init=False)

    name: ClassVar[str] = "component"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "components", tuple(self.components))
        form = None if self.orientation is None else geometry.parse_orientation(self.orientation)
        if form is not None and not form.angles:
            raise DataError(
                f"single components of a {form.name} cannot be measured: declare tilt-torsion, or "
                "euler- with an order such as euler-xyz, or use the kind 'pose'"
            )
        allowed = (() if form is None else form.columns) + POSITION_AXES
        self._check_components(allowed)
        object.__setattr__(self, "form", form)
        indices = np.array([allowed.index(name) for name in self.components])
        indices.setflags(write=False)
        object.__setattr__(self, "_component_indices", indices)

    def _check_components(self, allowed: tuple[str, ...]) -> None:
        for name in self.components:
            if name not in allowed:
                hint = (
                    "; declare an orientation to measure angles" if self.orientation is None else ""
                )
                raise DataError(
                    f"the component {name!r} does not exist; use {', '.join(allowed)}{hint}"
                )
        if not self.components or len(set(self.components)) < len(self.components):
            named = ", ".join(self.components) or "empty"
            raise DataError(f"the components are {named}; name at least one, and each once")
        if "phi" in self.components and "theta" not in self.components:
            raise DataError(
                "phi is measured without theta, but phi is not defined where theta is zero; "
                "measure both or neither"
            )

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

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Return rows at the singularity of the Euler angles."""
        if self.form is None or "b" not in self.components:
            return ()
        middle = measured[..., self.components.index("b")]
        angles = np.stack([np.zeros_like(middle), middle, np.zeros_like(middle)], axis=-1)
        determinant = np.abs(np.linalg.det(self.form.rates(np.nan_to_num(angles, nan=0.5))))
        return tuple(
            (
                int(i),
                (
                    f"has b = {np.rad2deg(middle[i]):.6g} deg, where a and c of {self.form.name} "
                    "are the same rotation; declare another order, or use the kind 'pose'"
                ),
            )
            for i in np.flatnonzero(determinant < SINGULAR_RATES)
        )

    @property
    def placeholder(self) -> FloatArray:
        """NaN, which `_evaluate` replaces component by component."""
        return np.full(len(self.components), np.nan)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        tool = self.predict_tool(T, values)
        predicted, slopes = self._predict(tool)
        difference = predicted - np.where(np.isnan(measured), predicted, measured)
        residual = difference
        if self.form is not None:
            residual = np.where(
                self._component_indices < 3, geometry.wrap_angle(difference), difference
            )
        by_tool = self.linearize_tool(T, values)
        rows = slopes @ by_tool
        if not self._has_azimuth:
            return self.split_columns(residual, rows)
        return self._replace_by_normal(residual, rows, tool, measured, by_tool)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return columns (t, r, m) of the tool with noise.

        Near zero tilt the noise of phi and theta applies to the normal.
        """
        tool = self.predict_tool(T, nuisance)
        exact, _ = self._predict(tool)
        noisy = exact + noise
        if not self._has_azimuth:
            return noisy
        theta, phi = self._normal_indices
        x, y = tool[..., 0, 2] + noise[..., theta], tool[..., 1, 2] + noise[..., phi]
        flat = np.abs(exact[..., theta]) < SMALL_TILT
        tilt, azimuth = np.arcsin(np.clip(np.hypot(x, y), 0.0, 1.0)), np.arctan2(y, x)
        indices = np.arange(len(self.components))
        noisy = np.where(flat[..., None] & (indices == theta), tilt[..., None], noisy)
        return np.where(flat[..., None] & (indices == phi), azimuth[..., None], noisy)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the frame from positions where x, y and z are measured, else 24 orientations."""
        complete = ~np.any(np.isnan(measured), axis=-1)
        if (
            self.unknown != ("frame",)
            or not set(POSITION_AXES) <= set(self.components)
            or np.count_nonzero(complete) < 3
        ):
            return super().guess_values(T, measured)
        points = (T @ self._tool())[complete, :3, 3]
        positions = measured[complete][:, [self.components.index(name) for name in POSITION_AXES]]
        frame = align_point_sets(positions, points)
        return setup.encode_frame(self.T_base_frame, frame)[None]

    def covariance_of_rotation(self, measured: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the covariance of the residuals from that of rotation error and position.

        Parameters
        ----------
        measured : (r, m) [SI]
            Angles enter the derivative; those that are not components count as zero.
        covariance : (r or 1, 6, 6) [rad, m]
            Of the tool's rotation error and position, in axes of the frame, rotation first.

        Returns
        -------
        covariance : (r, m, m)
            `A C A'` with A the derivative of the residuals.
        """
        values = np.where(np.isnan(measured), 0.0, measured)
        angles = np.stack([self._component(values, name) for name in self._angle_names], axis=-1)
        position = np.zeros((*values.shape[:-1], 3))
        rotation = np.broadcast_to(np.eye(3), (*values.shape[:-1], 3, 3))
        tool = geometry.make_pose(
            rotation if self.form is None else self.form.to_matrix(angles), position
        )
        rows = self._linearize(angles)
        if self._has_azimuth:
            rows = np.where(self._is_flat(measured), self._linearize_normal(tool, rows), rows)
        return rows @ covariance @ np.swapaxes(rows, -1, -2)

    # --- predictions and derivatives

    @property
    def _angle_names(self) -> tuple[str, ...]:
        return ("", "", "") if self.form is None else self.form.columns

    @property
    def _has_azimuth(self) -> bool:
        return "phi" in self.components

    @property
    def _normal_indices(self) -> tuple[int, int]:
        """Indices of theta and phi among the components."""
        return self.components.index("theta"), self.components.index("phi")

    def _component(self, values: FloatArray, name: str) -> FloatArray:
        return (
            values[..., self.components.index(name)]
            if name in self.components
            else np.zeros(values.shape[:-1])
        )

    def _predict(self, tool: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return components (..., m) of tool poses (..., 4, 4) and their derivative (..., m, 6) by
        the tool's twist.
        """
        position = tool[..., :3, 3]
        if self.form is None:
            return position[..., self._component_indices], self._linearize(np.zeros((1, 1, 3)))
        angles = self.form.from_matrix(tool[..., :3, :3])
        everything = np.concatenate([angles, position], axis=-1)
        return everything[..., self._component_indices], self._linearize(angles)

    def _linearize(self, angles: FloatArray) -> FloatArray:
        """Return the derivative (..., m, 6) of the components by the tool's twist, in axes of the
        frame.
        """
        identity, zero = np.eye(3), np.zeros((3, 3))
        shape = (*angles.shape[:-1], 3, 6)
        rows = np.broadcast_to(np.concatenate([zero, identity], axis=-1), shape)
        if self.form is not None:
            inverse = self.form.rates_inverse(angles)
            by_rotation = np.concatenate([inverse, np.zeros_like(inverse)], axis=-1)
            rows = np.concatenate([by_rotation, rows], axis=-2)
        return rows[..., self._component_indices, :]

    def _is_flat(self, measured: FloatArray) -> BoolArray:
        """Return rows (..., 1, 1) where the normal replaces phi and theta: both are measured, and
        the tilt is small.
        """
        theta, phi = self._normal_indices
        flat = (np.abs(measured[..., theta]) < SMALL_TILT) & ~np.isnan(measured[..., phi])
        return flat[..., None, None]

    def _linearize_normal(self, tool: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the derivative (..., m, 6) with rows of the normal's x and y in place of those of
        theta and phi: `d n = omega x n`.
        """
        normal = -geometry.hat(tool[..., :3, 2])
        x, y = (
            np.concatenate([normal[..., i, :], np.zeros_like(normal[..., i, :])], axis=-1)
            for i in range(2)
        )
        theta, phi = self._normal_indices
        indices = np.arange(len(self.components))[:, None]
        return np.where(
            indices == theta, x[..., None, :], np.where(indices == phi, y[..., None, :], rows)
        )

    def _replace_by_normal(
        self,
        residual: FloatArray,
        rows: FloatArray,
        tool: FloatArray,
        measured: FloatArray,
        by_tool: FloatArray,
    ) -> Evaluation:
        """Return the evaluation with the normal in place of phi and theta where the measured tilt
        is small.
        """
        flat = self._is_flat(measured)
        theta, phi = self._normal_indices
        indices = np.arange(len(self.components))
        sine = np.sin(np.where(np.isnan(measured[..., theta]), 0.0, measured[..., theta]))
        azimuth = np.where(np.isnan(measured[..., phi]), 0.0, measured[..., phi])
        x = tool[..., 0, 2] - np.cos(azimuth) * sine
        y = tool[..., 1, 2] - np.sin(azimuth) * sine
        normal = np.where(
            indices == theta, x[..., None], np.where(indices == phi, y[..., None], residual)
        )
        slopes = self._linearize_normal(tool, np.zeros((1, 1, len(self.components), 6))) @ by_tool
        replaced = flat & ((indices == theta) | (indices == phi))[:, None]
        return self.split_columns(
            np.where(replaced[..., 0], normal, residual), np.where(replaced, slopes, rows)
        )
