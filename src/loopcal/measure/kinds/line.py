# SPDX-License-Identifier: Apache-2.0
"""Kind `line`: points of the platform that lie on a straight line, such as a ruler, an edge or a
light beam.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Column
from loopcal.measure.kinds.surface import SurfaceKind
from loopcal.measure.kinds.tool import stacked
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class Line(SurfaceKind):
    """Points on a line. Residual: `B'R'(x - through) - shift - gap`, B two unit vectors across the
    stated direction.

    R turns the stated direction to the true one. Unknown are its two turns u, v and two shifts a, b
    along the turned B, one set for each group of rows.

    Parameters
    ----------
    See `SurfaceKind`.
    """

    surface: str = "line"

    name: ClassVar[str] = "line"
    per_target: ClassVar[tuple[Column, ...]] = (
        Column("gap_a", Dimension.LENGTH),
        Column("gap_b", Dimension.LENGTH),
    )

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """A known line, and an unknown one."""
        return (cls(), cls(unknown=("surface",), along=np.array([0.6, 0.0, 0.8]), surface="ruler"))

    def own_item(self, name: str) -> tuple[Parameter, ...]:
        """Two turns and two shifts."""
        shifts = tuple(
            Parameter(f"{self.surface}.{axis}", Dimension.LENGTH, 0.0, scope="group")
            for axis in ("a", "b")
        )
        return (*parts.direction_part(self.surface, "group"), *shifts)

    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """Distances (.., k, 2) across the line."""
        own = self.item_values(values, "surface")
        B, lever = parts.across(self.along), x - self.through
        if own is None:
            return lever @ B, B.T, {}
        R, spread = parts.direction_turn(self.along, own[..., :2])
        rows = np.swapaxes(R @ B, -1, -2)[..., None, :, :]
        # d (R b)'x = (w x R b)'x = (R b)'(x x w)
        turning = rows @ geometry.hat(lever) @ spread[..., None, :, :]
        shifts = np.broadcast_to(-np.eye(2), (*turning.shape[:-1], 2))
        gaps = (rows @ lever[..., None])[..., 0] - own[..., None, 2:]
        return gaps, rows, {"surface": np.concatenate([turning, shifts], axis=-1)}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """The line of largest scatter through the points."""
        x, gaps = self.touched(T, measured)
        if "surface" not in self.unknown or len(x) < 2:
            return self.nominal_values[None]
        middle = x.mean(axis=0)
        direction = np.linalg.svd(x - middle, full_matrices=False)[2][0]
        turns = parts.direction_values(
            self.along, direction if direction @ self.along >= 0.0 else -direction
        )
        across = parts.direction_turn(self.along, turns)[0] @ parts.across(self.along)
        shifts = (middle - self.through) @ across - gaps.mean(axis=0)
        return stacked(self, {"surface": np.concatenate([turns, shifts])}, 1)
