# SPDX-License-Identifier: Apache-2.0
"""Readings that are not exact: how far each is believed, and the recorded reading as a measurement of the true one.

An encoder is an instrument like any other: it shows the true reading and an error of stated sigma. Its kind is made from
the robot and never written into a file, where a reading is a column of its pose.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError
from loopcal.measure.kinds.kind import Column, Evaluation, Kind
from loopcal.measure.measurements import Measurements
from loopcal.mechanism import Mechanism
from loopcal.units import Dimension

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Readings(Kind):
    """Readings of all actuators. Residual: `true - recorded`; a turn more is an error of a turn.

    Parameters
    ----------
    actuators : name -> dimension, in the order of the readings.
    """

    name: ClassVar[str] = "readings"
    said: ClassVar[str] = "the readings of the actuators"
    actuators: Mapping[str, Dimension]

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """A slide and a motor."""
        return (cls({"q1": Dimension.LENGTH, "q2": Dimension.ANGLE}),)

    @property
    def columns(self) -> tuple[Column, ...]:
        """One for each actuator."""
        return tuple(Column(name, dimension) for name, dimension in self.actuators.items())

    @property
    def looks_at(self) -> tuple[str, ...]:
        """The actuators."""
        return tuple(self.actuators)

    def _evaluate(self, T: Array, measured: Array, values: Array, joints: Array) -> Evaluation:
        residual = joints - measured
        m = len(self.actuators)
        slope = np.broadcast_to(np.eye(m), (*residual.shape, m))
        return Evaluation(residual, np.zeros((*residual.shape, 6)), None, slope)

    def measure(self, T: Array, noise: Array, unknowns: Array | None = None, joints: Array | None = None) -> Array:
        """Recorded readings (t, r, a)."""
        return noise if joints is None else joints + noise


def readings_kind(robot: Mechanism) -> Readings:
    """The kind of a robot's readings."""
    return Readings({actuator.name: actuator.dimension for actuator in robot.actuators})


def believed_sigma(robot: Mechanism, given: Array | None, n: int) -> Array | None:
    """Standard deviations (n, a) [SI] of readings: those given, else those that the robot states; None where all are exact.

    Parameters
    ----------
    given : (n, a) or None, as in `Measurements.reading_sigma`.

    Raises
    ------
    DataError
        An exact reading of a robot with more actuators than freedoms: exact readings would contradict each other.
    """
    stated = [actuator.sigma for actuator in robot.actuators]
    if given is None:
        if not any(stated):
            return None
        given = np.tile([sigma or 0.0 for sigma in stated], (n, 1))
    if robot.program.sigma is not None and np.any(given == 0.0):
        name = robot.actuators[int(np.argwhere(given == 0.0)[0, 1])].name
        raise DataError(
            f"the readings of {name} are stated to be exact, but {robot.name!r} has {len(stated)} actuators for"
            f" {len(robot.freedoms)} freedoms, and exact readings would contradict each other; give all of them a sigma above 0"
        )
    return given if np.any(given != 0.0) else None


def with_stated_sigma(robot: Mechanism, data: Measurements) -> Measurements:
    """Measurements that say themselves how far their readings are believed; the same object where all are exact."""
    sigma = believed_sigma(robot, data.reading_sigma, data.n_poses)
    return data if sigma is None or sigma is data.reading_sigma else replace(data, reading_sigma=sigma)
