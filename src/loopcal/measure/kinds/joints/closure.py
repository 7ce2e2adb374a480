# SPDX-License-Identifier: Apache-2.0
"""Kind `closure`: nothing is measured but the actuator readings of the pose.

A robot with more actuators than degrees of freedom measures itself: its readings must agree on one
pose. What they contribute are the rows of the kind `readings`, which every pose of uncertain
readings has; see docs/theory/uncertain-readings.md. A row of this kind has no column. It states
that its pose has no measured value on purpose, and which session and time its readings belong to.
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.kinds import CLOSURE
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.rows import Column, Evaluation
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Closure(Kind):
    """Actuator readings alone: the closed loops of a robot with redundant actuators.

    No column is measured, so that a row has no residual of its own, no noise and no setup. The
    robot must have more actuators than degrees of freedom. The `sigma` of its readings is the
    noise.

    Examples
    --------
    >>> Closure().columns
    ()
    """

    name: ClassVar[str] = CLOSURE
    description: ClassVar[str] = "the readings of redundant actuators"
    changes_with_pose: ClassVar[bool] = False

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return the only one: it has no settings."""
        return (cls(),)

    @property
    def columns(self) -> tuple[Column, ...]:
        """None."""
        return ()

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        shape = (max(len(T), len(values)), T.shape[1], 0)
        return Evaluation(np.zeros(shape), np.zeros((*shape, 6)))
