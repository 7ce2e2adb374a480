# SPDX-License-Identifier: Apache-2.0
"""Readings that are not exact: how far each is believed, and the recorded reading as a measurement
of the true one.

An encoder is an instrument like any other: it shows the true reading and an error of stated sigma.
Its kind is made from the robot and never written into a file, where a reading is a column of its
pose.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.kinds.kind import Column, Evaluation, Kind
from loopcal.measure.measurements import Measurements
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

BEYOND = 1e6
"""Sigma of a reading, in sizes of the robot or radians, that says no more than infinity does."""


@dataclass(frozen=True, eq=False)
class Readings(Kind):
    """Readings of all actuators. Residual: `true - recorded`; a turn more is an error of a turn.

    Parameters
    ----------
    actuators : name -> dimension, in the order of the readings.
    """

    name: ClassVar[str] = "readings"
    description: ClassVar[str] = "the readings of the actuators"
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
    def sensed_joints(self) -> tuple[str, ...]:
        """The actuators."""
        return tuple(self.actuators)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        residual = joints - measured
        m = len(self.actuators)
        slope = np.broadcast_to(np.eye(m), (*residual.shape, m))
        return Evaluation(residual, np.zeros((*residual.shape, 6)), None, slope)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Recorded readings (t, r, a)."""
        return noise if joints is None else joints + noise


def make_readings_kind(robot: Mechanism) -> Readings:
    """The kind of a robot's readings."""
    return Readings({actuator.name: actuator.dimension for actuator in robot.actuators})


def resolve_reading_sigma(robot: Mechanism, given: FloatArray | None, n: int) -> FloatArray | None:
    """Standard deviations (n, a) [SI] of readings: those given, else those that the robot states;
    None where all are exact.

    Parameters
    ----------
    given : (n, a) or None, as in `Measurements.reading_sigma`.

    Raises
    ------
    DataError
        A sigma that is none, or so large that it says nothing; an exact reading of a robot with
        more actuators than freedoms, whose poses are moved freely, readings following, so that none
        can be held (docs/theory/latent.md).
    """
    stated = [actuator.sigma for actuator in robot.actuators]
    if given is None:
        if not any(stated):
            return None
        given = np.tile([sigma or 0.0 for sigma in stated], (n, 1))
    _check_sigma(robot, given)
    if robot.program.sigma is not None and np.any(given == 0.0):
        name = robot.actuators[int(np.argwhere(given == 0.0)[0, 1])].name
        raise DataError(
            f"the readings of {name} are stated to be exact, but {robot.name!r} has {len(stated)} "
            "actuators for"
            f" {len(robot.freedoms)} freedoms, and with redundant actuators no reading can be held "
            "exactly; state a sigma"
            " above 0 for each, a small one where it is very good"
        )
    return given if np.any(given != 0.0) else None


def _check_sigma(robot: Mechanism, sigma: FloatArray) -> None:
    """Refuse standard deviations (n, a) that are none or beyond what any reading can be off by,
    naming the actuator.
    """
    size = np.array(
        [
            robot.size if actuator.dimension is Dimension.LENGTH else 1.0
            for actuator in robot.actuators
        ]
    )
    for wrong, what in (
        (
            ~(sigma >= 0.0),
            "is no standard deviation; give 0 (exact), a positive number, or infinity (not taken)",
        ),
        (
            np.isfinite(sigma) & (sigma / size > BEYOND),
            "is beyond anything that such a reading can be off by; state inf instead",
        ),
    ):
        if np.any(wrong):
            pose, column = (int(i) for i in np.argwhere(wrong)[0])
            actuator = robot.actuators[column]
            shown = find_unit(
                robot.units.get(actuator.dimension, DISPLAY_UNITS[actuator.dimension].symbol)
            )
            value = f"{sigma[pose, column] / shown.factor_to_si:.6g} {shown.symbol}"
            raise DataError(
                f"the sigma {value} of the reading of {actuator.name} in row {pose + 1} {what}"
            )


def fill_in_reading_sigma(robot: Mechanism, data: Measurements) -> Measurements:
    """Measurements that say themselves how far their readings are believed; the same object where
    all are exact.
    """
    sigma = resolve_reading_sigma(robot, data.reading_sigma, data.n_poses)
    return (
        data if sigma is None or sigma is data.reading_sigma else replace(data, reading_sigma=sigma)
    )
