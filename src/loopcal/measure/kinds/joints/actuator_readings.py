# SPDX-License-Identifier: Apache-2.0
"""The recorded actuator readings as a measurement of the true ones.

An encoder is an instrument: it shows the true reading plus an error of stated sigma. This kind is
made from the robot. It is not in `KINDS`, because files state readings as columns of their pose.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.kinds import READINGS
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.rows import Column, Evaluation
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False)
class ActuatorReadings(Kind):
    """Readings of all actuators. Residual: `true - recorded`. Angles are not wrapped: a full turn
    too much is an error of a full turn.

    Parameters
    ----------
    actuators : name -> dimension, in the order of the readings.
    """

    name: ClassVar[str] = READINGS
    description: ClassVar[str] = "the readings of the actuators"
    wraps_angles: ClassVar[bool] = False
    actuators: Mapping[str, Dimension]

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a slide and a motor."""
        return (cls({"q1": Dimension.LENGTH, "q2": Dimension.ANGLE}),)

    @property
    def columns(self) -> tuple[Column, ...]:
        """One column for each actuator."""
        return tuple(Column(name, dimension) for name, dimension in self.actuators.items())

    @property
    def sensed_joints(self) -> tuple[str, ...]:
        """The actuators."""
        return tuple(self.actuators)

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        m = len(self.actuators)
        by_joint = np.broadcast_to(np.eye(m), (*joints.shape, m))
        return Evaluation(joints, np.zeros((*joints.shape, 6)), None, by_joint)
