# SPDX-License-Identifier: Apache-2.0
"""Kind `component`: some coordinates of the tool in a frame; z alone is a probed height.

Angles are those of the declared orientation; their differences are wrapped. Near zero tilt the
azimuth phi is not defined. There the x and y components of the unit normal replace theta and phi.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.geometry import OrientationForm
from loopcal.geometry.alignment import align_point_sets
from loopcal.measure.array_checks import check_names, set_fields
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.poses.tool_kind import SMALL_TILT, ToolKind
from loopcal.measure.kinds.rows import Column, Evaluation, InvalidRows, list_rows
from loopcal.measure.kinds.setup_parameters import POSITION_AXES
from loopcal.typing import FloatArray
from loopcal.units import Dimension

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

    Setup parameters: those of `Pose`.

    Parameters
    ----------
    components : tuple of str
        Measured coordinates in the order of the columns: x y z, and angles of the declared
        orientation.
    orientation : str, optional
        Form of the angles, "tilt-torsion" (phi theta psi) or "euler-" and an order (a b c).
        Required if an angle is measured.
    T_base_frame, T_platform_tool, unknown, frame
        See `ToolKind`.

    Raises
    ------
    DataError
        If a component does not exist or is named twice, if angles have no declared orientation, or
        if phi is measured without theta.

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
                f"single components of a {form.name} cannot be measured: declare tilt-torsion, or "
                "euler- with an order such as euler-xyz, or use the kind 'pose'"
            )
        for name in self.components:
            if name not in self._coordinates:
                hint = "; declare an orientation to measure angles" if form is None else ""
                raise DataError(
                    f"the component {name!r} does not exist; use {', '.join(self._coordinates)}"
                    f"{hint}"
                )
        check_names(self.components, "components")
        if self._has_azimuth and "theta" not in self.components:
            raise DataError(
                "phi is measured without theta, but phi is not defined where theta is zero; "
                "measure both or neither"
            )

    @cached_property
    def form(self) -> OrientationForm | None:
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
        return list_rows(
            determinant < SINGULAR_RATES,
            lambda i: (
                f"has b = {np.rad2deg(middle[i]):.6g} deg, where a and c of {name} are the "
                "same rotation; declare another order, or use the kind 'pose'"
            ),
        )

    @property
    def placeholder(self) -> FloatArray:
        """NaN: only its own component depends on it, unless the normal replaces two of them."""
        return np.full(1, np.nan)

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        tool, by_tool = self.locate_tool(T, values)
        predicted, slopes = self._predict_components(tool)
        return self.split_columns(predicted, slopes @ by_tool)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        """Replace phi and theta by the normal where the measured tilt is small."""
        if not self._has_azimuth:
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
        """Return columns (t, r, m) of the tool with noise.

        Near zero tilt the noise of phi and theta applies to the normal.
        """
        tool, _ = self.locate_tool(T, values)
        exact, _ = self._predict_components(tool)
        noisy = exact + noise
        if not self._has_azimuth:
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
        frame = align_point_sets(positions, points)
        return setup.encode_frame(self.T_base_frame, frame)[None]

    # --- predictions and derivatives

    @property
    def _coordinates(self) -> tuple[str, ...]:
        """All coordinates that can be measured: three angles (if declared), then x y z."""
        return (() if self.form is None else self.form.columns) + POSITION_AXES

    @property
    def _has_azimuth(self) -> bool:
        return "phi" in self.components

    @property
    def _normal_indices(self) -> tuple[int, int]:
        """Indices of theta and phi among the components."""
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
