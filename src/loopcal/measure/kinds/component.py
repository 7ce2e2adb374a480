# SPDX-License-Identifier: Apache-2.0
"""Kind `component`: some of the tool's coordinates and declared angles in a frame; z alone is a
probed height.

Angles are the ones the data declare, their differences wrapped. Near zero tilt the azimuth phi
loses its meaning; there the x and y components of the unit normal stand in for theta and phi.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.geometry.orientation_forms import OrientationForm, parse_orientation
from loopcal.measure.closed_form import kabsch
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Bools, Column, Evaluation
from loopcal.measure.kinds.tool import POSITION, ToolKind
from loopcal.typing import FloatArray
from loopcal.units import Dimension

FLAT = 0.05
"""Measured tilt [rad] below which the normal stands in for phi and theta; phi is there twenty times
as noisy.
"""

GIMBAL = 1e-3
"""Smallest |det E| of measured angles [1]; below it a and c are the same turn to a thousandth."""


@dataclass(frozen=True, eq=False)
class Component(ToolKind):
    """Some coordinates of the tool. Residual: `predicted - measured` of each, angles wrapped into
    (-pi, pi].

    With E of the declared angles, Q the turn from base to frame and a the arm from platform origin
    to tool, `d(angles) = E^-1 Q omega` and `d t = Q (v + omega x a)`. Where the measured tilt is
    below `FLAT`, the residuals called theta and phi are the differences of the normal's x and y
    [rad], with `d n = (Q omega) x n`; a sigma stated for theta and phi is then taken as theirs.

    Parameters
    ----------
    components : tuple of str
        In the order of the columns: x y z, and the angles of the declared orientation.
    orientation : str, optional
        Form of the angles, "tilt-torsion" (phi theta psi) or "euler-" with an order (a b c); needed
        as soon as an angle is measured.
    form, _places_among
        The orientation's form, and the place of each component among all: three angles (if
        declared), then x y z.
    T_base_frame, T_platform_tool, unknown, frame
        See `ToolKind`.

    Raises
    ------
    DataError
        If a component is unknown or named twice, or the angles are not declared, or phi comes
        without theta.
    """

    components: tuple[str, ...] = ("z",)
    orientation: str | None = None

    form: OrientationForm | None = field(init=False, repr=False)
    _places_among: NDArray[np.intp] = field(init=False, repr=False)

    name: ClassVar[str] = "component"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "components", tuple(self.components))
        form = None if self.orientation is None else parse_orientation(self.orientation)
        if form is not None and not form.angles:
            raise DataError(
                f"components of a {form.name} cannot be measured one by one: declare tilt-torsion "
                "or euler- with an"
                " order such as euler-xyz, or use the kind 'pose'"
            )
        allowed = (() if form is None else form.columns) + POSITION
        self._check(allowed)
        object.__setattr__(self, "form", form)
        places = np.array([allowed.index(name) for name in self.components])
        places.setflags(write=False)
        object.__setattr__(self, "_places_among", places)

    def _check(self, allowed: tuple[str, ...]) -> None:
        for name in self.components:
            if name not in allowed:
                hint = (
                    "; declare an orientation to measure angles" if self.orientation is None else ""
                )
                raise DataError(
                    f"the component {name!r} is unknown: use some of {', '.join(allowed)}{hint}"
                )
        if not self.components or len(set(self.components)) < len(self.components):
            named = ", ".join(self.components) or "nothing"
            raise DataError(f"the components are {named}: name at least one, and each once")
        if "phi" in self.components and "theta" not in self.components:
            raise DataError(
                "phi is measured without theta, but means nothing where theta is zero: measure "
                "both or none"
            )

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """A probed height, a point, five of six coordinates, angles alone, and unknown places."""
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
        """The components as named."""
        return tuple(
            Column(name, Dimension.LENGTH if name in POSITION else Dimension.ANGLE)
            for name in self.components
        )

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Rows whose Euler angles are at the point where the first and the last turn are one."""
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
                    "are the same turn;"
                    " declare another order, or use the kind 'pose'"
                ),
            )
            for i in np.flatnonzero(determinant < GIMBAL)
        )

    @property
    def placeholder(self) -> FloatArray:
        """NaN, which each component sorts out for itself."""
        return np.full(len(self.components), np.nan)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        seen = self.seen(T, values)
        predicted, slopes = self._predict(seen)
        difference = predicted - np.where(np.isnan(measured), predicted, measured)
        residual = difference
        if self.form is not None:
            residual = np.where(self._places_among < 3, geometry.wrap_angle(difference), difference)
        moved = self.transport(T, values)
        rows = slopes @ moved
        if not self._has_normal:
            return self.split(residual, rows)
        return self._flattened(residual, rows, seen, measured, moved)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns (t, r, m) of the tool with noise added; near zero tilt the noise of phi and theta
        is the normal's.
        """
        seen = self.seen(T, unknowns)
        exact, _ = self._predict(seen)
        noisy = exact + noise
        if not self._has_normal:
            return noisy
        theta, phi = self._normal_places
        x, y = seen[..., 0, 2] + noise[..., theta], seen[..., 1, 2] + noise[..., phi]
        flat = np.abs(exact[..., theta]) < FLAT
        tilt, azimuth = np.arcsin(np.clip(np.hypot(x, y), 0.0, 1.0)), np.arctan2(y, x)
        places = np.arange(len(self.components))
        noisy = np.where(flat[..., None] & (places == theta), tilt[..., None], noisy)
        return np.where(flat[..., None] & (places == phi), azimuth[..., None], noisy)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """The frame from positions, where all three are measured; else in 24 orientations."""
        whole = ~np.any(np.isnan(measured), axis=-1)
        if (
            self.unknown != ("frame",)
            or not set(POSITION) <= set(self.components)
            or np.count_nonzero(whole) < 3
        ):
            return super().guess_values(T, measured)
        point = (T @ self._tool())[whole, :3, 3]
        seen = measured[whole][:, [self.components.index(name) for name in POSITION]]
        return parts.frame_values(self.T_base_frame, kabsch(seen, point))[None]

    def covariance_of_rotation(self, measured: FloatArray, covariance: FloatArray) -> FloatArray:
        """Covariance of the residuals from that of the tool's rotation error and position.

        Parameters
        ----------
        measured : (r, m) [SI]
            The angles enter the map; those not declared as components count as zero.
        covariance : (r or 1, 6, 6) [rad, m]
            Of the rotation error and the position, in axes of the frame, rotation first.

        Returns
        -------
        covariance : (r, m, m)
            `A C A'` with A the derivative of the residuals.
        """
        values = np.where(np.isnan(measured), 0.0, measured)
        angles = np.stack([self._value(values, name) for name in self._angle_names], axis=-1)
        position = np.zeros((*values.shape[:-1], 3))
        rotation = np.broadcast_to(np.eye(3), (*values.shape[:-1], 3, 3))
        seen = geometry.make_pose(
            rotation if self.form is None else self.form.to_matrix(angles), position
        )
        rows = self._slopes(angles)
        if self._has_normal:
            rows = np.where(self._flat(measured), self._normal_rows(seen, rows), rows)
        return rows @ covariance @ np.swapaxes(rows, -1, -2)

    # --- pieces
    # ------------------------------------------------------------------------------------------------------

    @property
    def _angle_names(self) -> tuple[str, ...]:
        return ("", "", "") if self.form is None else self.form.columns

    @property
    def _has_normal(self) -> bool:
        return "phi" in self.components

    @property
    def _normal_places(self) -> tuple[int, int]:
        """Places of theta and phi among the components."""
        return self.components.index("theta"), self.components.index("phi")

    def _value(self, values: FloatArray, name: str) -> FloatArray:
        return (
            values[..., self.components.index(name)]
            if name in self.components
            else np.zeros(values.shape[:-1])
        )

    def _predict(self, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Components (..., m) of tool poses (..., 4, 4), and their derivative (..., m, 6) by the
        tool's twist.
        """
        position = seen[..., :3, 3]
        if self.form is None:
            return position[..., self._places_among], self._slopes(np.zeros((1, 1, 3)))
        angles = self.form.from_matrix(seen[..., :3, :3])
        return np.concatenate([angles, position], axis=-1)[..., self._places_among], self._slopes(
            angles
        )

    def _slopes(self, angles: FloatArray) -> FloatArray:
        """Derivative (..., m, 6) of the components by the tool's twist, in axes of the frame."""
        identity, zero = np.eye(3), np.zeros((3, 3))
        shape = (*angles.shape[:-1], 3, 6)
        rows = np.broadcast_to(np.concatenate([zero, identity], axis=-1), shape)
        if self.form is not None:
            inverse = self.form.rates_inverse(angles)
            turning = np.concatenate([inverse, np.zeros_like(inverse)], axis=-1)
            rows = np.concatenate([turning, rows], axis=-2)
        return rows[..., self._places_among, :]

    def _flat(self, measured: FloatArray) -> Bools:
        """Rows (..., 1, 1) whose normal stands in for phi and theta: both measured, and little
        tilt.
        """
        theta, phi = self._normal_places
        flat = (np.abs(measured[..., theta]) < FLAT) & ~np.isnan(measured[..., phi])
        return flat[..., None, None]

    def _normal_rows(self, seen: FloatArray, rows: FloatArray) -> FloatArray:
        """The derivative (..., m, 6), with rows of the normal's x and y for theta and phi: `d n =
        omega x n`.
        """
        normal = -geometry.hat(seen[..., :3, 2])
        x, y = (
            np.concatenate([normal[..., i, :], np.zeros_like(normal[..., i, :])], axis=-1)
            for i in range(2)
        )
        theta, phi = self._normal_places
        places = np.arange(len(self.components))[:, None]
        return np.where(
            places == theta, x[..., None, :], np.where(places == phi, y[..., None, :], rows)
        )

    def _flattened(
        self,
        residual: FloatArray,
        rows: FloatArray,
        seen: FloatArray,
        measured: FloatArray,
        moved: FloatArray,
    ) -> Evaluation:
        """The evaluation with the normal in place of phi and theta where the measured tilt is
        small.
        """
        flat = self._flat(measured)
        theta, phi = self._normal_places
        places = np.arange(len(self.components))
        tilt = np.sin(np.where(np.isnan(measured[..., theta]), 0.0, measured[..., theta]))
        azimuth = np.where(np.isnan(measured[..., phi]), 0.0, measured[..., phi])
        x = seen[..., 0, 2] - np.cos(azimuth) * tilt
        y = seen[..., 1, 2] - np.sin(azimuth) * tilt
        normal = np.where(
            places == theta, x[..., None], np.where(places == phi, y[..., None], residual)
        )
        slopes = self._normal_rows(seen, np.zeros((1, 1, len(self.components), 6))) @ moved
        chosen = flat & ((places == theta) | (places == phi))[:, None]
        return self.split(
            np.where(chosen[..., 0], normal, residual), np.where(chosen, slopes, rows)
        )
