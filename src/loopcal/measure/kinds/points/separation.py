# SPDX-License-Identifier: Apache-2.0
"""Kind `separation`: the distance between the places of a point at two poses, by a ball bar or by
callipers on a printed part.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.kinds.kind import Column, Evaluation
from loopcal.measure.kinds.points.target_kind import (
    TargetKind,
    evaluate_offset,
    find_nonpositive_rows,
    measure_lengths,
)
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Separation(TargetKind):
    """Distance of each target between two poses. Residual: `|x_2 - x_1| + offset - measured`.

    A row names two poses. The frame does not matter.

    Parameters
    ----------
    See `TargetKind`; "targets" and "offset" (the zero of the callipers, the width of a printed
    line) may be unknown.
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
        """Return the tool's point, and an unknown point with an unknown zero."""
        return (cls(), cls(targets=("nozzle",), unknown=("targets", "offset")))

    def make_item_parameters(self, name: str) -> tuple[Parameter, ...]:
        """Return the parameter of the offset."""
        return self.make_offset_parameter()

    def find_invalid_rows(self, measured: FloatArray) -> tuple[tuple[int, str], ...]:
        """Return rows with a distance that is not above zero."""
        return find_nonpositive_rows(measured)

    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """Return the lengths (.., k, 1) of differences x (.., k, 3), and unit vectors."""
        offset, by_item = evaluate_offset(self, values)
        length, unit = measure_lengths(x)
        return length + offset, unit[..., None, :], by_item

    def _compare_poses(
        self, T: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return columns (t, r, m), derivatives (t, r, 2, m, 6) and (t, r, m, u)."""
        x, rows = self.locate_targets(T, values[..., None, :])
        predicted, unit, by_item = self.predict(x[..., 1, :, :] - x[..., 0, :, :], values)
        by_pose = unit[..., None, :, :, :] @ rows * np.array([-1.0, 1.0])[:, None, None, None]
        total = np.sum(by_pose, axis=-4) + self.join_columns(by_item, predicted.shape)
        jacobian = by_pose[..., 0, :6]
        if not self.setup_items:
            return predicted[..., 0], jacobian, None
        return predicted[..., 0], jacobian, total[..., 0, 6:]

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        predicted, jacobian, by_nuisance = self._compare_poses(T, values)
        return Evaluation(predicted - measured, jacobian, by_nuisance)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return columns (t, r, c) with noise added."""
        return self._compare_poses(T, self.values_or_nominal(nuisance))[0] + noise
