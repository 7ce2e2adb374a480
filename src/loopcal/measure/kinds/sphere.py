# SPDX-License-Identifier: Apache-2.0
"""Kind `sphere`: points of the platform that lie on a sphere, such as a master ball that is probed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.closed_form import trilateration
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Column
from loopcal.measure.kinds.surface import SurfaceKind
from loopcal.measure.kinds.target import length_of
from loopcal.measure.kinds.tool import stacked
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Length


@dataclass(frozen=True, eq=False, kw_only=True)
class Sphere(SurfaceKind):
    """Points on a sphere about c. Residual: `|x - c| - radius - gap`.

    Unknown are the centre and the radius (with that of the probe), one set for each group of rows.

    Parameters
    ----------
    radius : float [m]
        Of ball and probe together. Where the surface is unknown, the value it is counted from.
    Others: see `SurfaceKind`, whose `through` is the centre here; `along` does not matter.

    Raises
    ------
    DataError
        As `SurfaceKind`, and if the radius is not above zero.
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
        """A known sphere, and an unknown one."""
        far = np.array([1.5, -0.8, 1.1])
        return (cls(through=far), cls(unknown=("surface",), through=far, surface="ball"))

    def own_item(self, name: str) -> tuple[Parameter, ...]:
        """Centre and radius."""
        radius = Parameter(f"{self.surface}.radius", Dimension.LENGTH, self.radius, scope="group")
        return (*parts.point_part(self.surface, self.through, "group"), radius)

    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """Distances (.., k, 1) from the sphere."""
        own = self.item_values(values, "surface")
        if own is None:
            length, unit = length_of(x - self.through)
            return length - self.radius, unit[..., None, :], {}
        length, unit = length_of(x - own[..., None, :3])
        unit = unit[..., None, :]
        blocks = {"surface": -np.concatenate([unit, np.ones_like(unit[..., :1])], axis=-1)}
        return length - own[..., None, 3:], unit, blocks

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Centre and radius by trilateration: distances from the centre are gaps and a common
        offset, the radius.
        """
        x, gaps = self.touched(T, measured)
        if "surface" not in self.unknown or len(x) < 4:
            return self.nominal_values[None]
        centres, offsets = trilateration(x, gaps[:, 0], with_offset=True)
        return stacked(
            self, {"surface": np.concatenate([centres, -offsets[:, None]], axis=-1)}, len(centres)
        )
