# SPDX-License-Identifier: Apache-2.0
"""Kind `sphere`: points of the platform on a sphere, such as a probed master ball."""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.geometry.alignment import solve_trilateration
from loopcal.measure.kinds.points.target_kind import Prediction, measure_lengths
from loopcal.measure.kinds.rows import Column
from loopcal.measure.kinds.surfaces.surface_kind import SurfaceKind
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Length


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Sphere(SurfaceKind):
    """Points on a sphere about c. Residual: `|x - c| - radius - gap`.

    An unknown sphere has four parameters for each group of rows: its center and its radius, which
    includes that of the probe.

    Setup parameters [m]: `sphere.x` to `sphere.z` and `sphere.radius`, and `target.x` to
    `target.z` of each target.

    Parameters
    ----------
    radius : float [m]
        Sum of the radii of ball and probe. If the surface is unknown, its nominal value.
    Others: see `SurfaceKind`; `through` is the center, and `along` does not matter.

    Raises
    ------
    DataError
        As `SurfaceKind`, and if the radius is not above zero.

    Examples
    --------
    >>> kind = Sphere(through=np.array([0.0, 0.0, 0.5]), radius=0.1, places=np.zeros((1, 3)))
    >>> kind.evaluate(np.eye(4)[None, None], np.zeros((1, 1, 1))).residual
    array([[[0.4]]])
    """

    surface: str = "sphere"
    radius: Length = 0.0125

    name: ClassVar[str] = "sphere"
    per_target: ClassVar[tuple[Column, ...]] = (Column("gap", Dimension.LENGTH),)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.radius > 0.0:
            raise DataError(f"the radius of a sphere is {self.radius} m; give a length above 0")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known sphere, and an unknown one."""
        far = np.array([1.5, -0.8, 1.1])
        return (cls(through=far), cls(unknown=("surface",), through=far, surface="ball"))

    @property
    def surface_parameters(self) -> tuple[Parameter, ...]:
        """Center and radius."""
        nominal = np.array([*self.through, self.radius])
        return self.make_parameters(("x", "y", "z", "radius"), Dimension.LENGTH, nominal)

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return distances (.., k, 1) from the sphere."""
        surface = self.item_values(values, "surface")
        if surface is None:
            distance, unit = measure_lengths(x - self.through)
            return distance - self.radius, unit[..., None, :], {}
        distance, unit = measure_lengths(x - surface[..., None, :3])
        unit = unit[..., None, :]
        by_surface = -np.concatenate([unit, np.ones_like(unit[..., :1])], axis=-1)
        return distance - surface[..., None, 3:], unit, {"surface": by_surface}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return center and radius by trilateration: a distance from the center is a gap plus the
        radius, which is a common offset.
        """
        x, gaps = self.collect_contacts(T, measured)
        if "surface" not in self.unknown or len(x) < 4:
            return self.nominal_values[None]
        centers, offsets = solve_trilateration(x, gaps[:, 0], with_offset=True)
        values = np.concatenate([centers, -offsets[:, None]], axis=-1)
        return self.assemble_values({"surface": values})
