# SPDX-License-Identifier: Apache-2.0
"""An instrument: the kinds it measures, each with its noise and its frame."""

from dataclasses import dataclass
from typing import Self

from loopcal.errors import DataError
from loopcal.measure.kinds import Kind
from loopcal.measure.noise import Noise
from loopcal.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Sensor:
    """One kind (with its frame) and the noise of its noise columns.

    Raises
    ------
    DataError
        If the noise does not have one number for each noise column of the kind.
    """

    kind: Kind
    noise: Noise

    def __post_init__(self) -> None:
        names = ", ".join(column.name for column in self.kind.noise_columns)
        if len(self.noise.sigma) != len(self.kind.noise_columns):
            raise DataError(
                f"the noise of kind {self.kind.name!r} has {len(self.noise.sigma)} numbers; give one for each of {names}"
            )


@dataclass(frozen=True, eq=False)
class Instrument:
    """What looks at every pose.

    Parameters
    ----------
    sensors : tuple of Sensor

    Raises
    ------
    DataError
        If there is no sensor.
    """

    sensors: tuple[Sensor, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", tuple(self.sensors))
        if not self.sensors:
            raise DataError("an instrument needs at least one sensor: a kind and its noise")

    def mounted(self, robot: Mechanism) -> Self:
        """The instrument with the robot's tool, wherever a kind states none of its own."""
        return type(self)(tuple(Sensor(s.kind.mounted(robot.tool), s.noise) for s in self.sensors))
