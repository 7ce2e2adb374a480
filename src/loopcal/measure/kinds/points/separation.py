# SPDX-License-Identifier: Apache-2.0
"""Kind `separation`: the distance between the places of a point at two poses, by a ball bar or by
calipers on a printed part.
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.kinds.points.target_kind import LengthKind
from loopcal.measure.kinds.rows import Column, Evaluation
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Separation(LengthKind):
    """Distance of each target between two poses. Residual: `|x_2 - x_1| + offset - measured`.

    A row names two poses. The frame does not matter.

    Setup parameters [m]: `target.x` to `target.z` of each target, and `separation.offset`.

    Parameters
    ----------
    See `TargetKind`; "targets" and "offset" (the zero of the calipers, the width of a printed
    line) may be unknown.

    Examples
    --------
    >>> kind = Separation(places=np.zeros((1, 3)))
    >>> T = np.tile(np.eye(4), (1, 1, 2, 1, 1))
    >>> T[0, 0, 1, :3, 3] = 3.0, 4.0, 0.0
    >>> kind.measure(T, noise=np.zeros((1, 1, 1)))
    array([[[5.]]])
    """

    name: ClassVar[str] = "separation"
    poses_per_row: ClassVar[int] = 2
    description: ClassVar[str] = (
        "distances between two poses (ball bar; calipers on a printed part)"
    )
    per_target: ClassVar[tuple[Column, ...]] = (Column("separation", Dimension.LENGTH),)
    allowed_unknown: ClassVar[tuple[str, ...]] = ("targets", "offset")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return the tool's point, and an unknown point with an unknown zero."""
        return (cls(), cls(targets=("nozzle",), unknown=("targets", "offset")))

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        x, rows = self.locate_targets(T, values[..., None, :])
        predicted, unit, by_item = self.predict(x[..., 1, :, :] - x[..., 0, :, :], values)
        by_pose = unit[..., None, :, :, :] @ rows * np.array([-1.0, 1.0])[:, None, None, None]
        total = np.sum(by_pose, axis=-4) + self.join_columns(by_item, predicted.shape)
        evaluation = self.split_columns(predicted[..., 0], total[..., 0, :])
        return evaluation._replace(jacobian=by_pose[..., 0, :6])
