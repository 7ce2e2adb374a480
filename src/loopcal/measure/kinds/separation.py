# SPDX-License-Identifier: Apache-2.0
"""Kind `separation`: the distance between where a point was at two poses, by a ballbar or callipers
on a printed part.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.kinds.distance import not_above_zero
from loopcal.measure.kinds.kind import Column, Evaluation
from loopcal.measure.kinds.target import TargetKind, length_of, offset_of
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class Separation(TargetKind):
    """Distance between two poses of each target. Residual: `|x_2 - x_1| + offset - measured`.

    A row names two poses; no frame matters.

    Parameters
    ----------
    See `TargetKind`; "targets" and "offset" (the callipers' zero, the width of a printed line) may
    be unknown.
    """

    name: ClassVar[str] = "separation"
    poses_per_row: ClassVar[int] = 2
    description: ClassVar[str] = (
        "distances between two poses (ball bar; callipers on a printed part)"
    )
    per_target: ClassVar[tuple[Column, ...]] = (Column("separation", Dimension.LENGTH),)
    allowed_unknown: ClassVar[tuple[str, ...]] = ("targets", "offset")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """The tool's point, and an unknown point with unknown zero."""
        return (cls(), cls(targets=("nozzle",), unknown=("targets", "offset")))

    def own_item(self, name: str) -> tuple[Parameter, ...]:
        """One unknown: the offset."""
        return self.offset_part()

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Rows with a distance that is none."""
        return not_above_zero(measured)

    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """Length (.., k, 1) of differences x (.., k, 3), and unit vectors."""
        offset, blocks = offset_of(self, values)
        length, unit = length_of(x)
        return length + offset, unit[..., None, :], blocks

    def _linked(
        self, T: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Columns (t, r, m), derivatives (t, r, 2, m, 6) and (t, r, m, u)."""
        x, rows = self.sight(T, values[..., None, :])
        predicted, unit, blocks = self.predict(x[..., 1, :, :] - x[..., 0, :, :], values)
        each = unit[..., None, :, :, :] @ rows * np.array([-1.0, 1.0])[:, None, None, None]
        own = np.sum(each, axis=-4) + self.columns_of(blocks, predicted.shape)
        jacobian = each[..., 0, :6]
        if not self.setup_items:
            return predicted[..., 0], jacobian, None
        return predicted[..., 0], jacobian, own[..., 0, 6:]

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        predicted, jacobian, own = self._linked(T, values)
        return Evaluation(predicted - measured, jacobian, own)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns (t, r, c) with noise added."""
        return self._linked(T, self.values(unknowns))[0] + noise
