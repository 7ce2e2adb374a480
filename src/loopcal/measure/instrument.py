# SPDX-License-Identifier: Apache-2.0
"""An instrument: the kinds it measures, each with its noise and its frame."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError
from loopcal.measure.kinds import Kind
from loopcal.measure.noise import Noise
from loopcal.measure.observations import indices, labels
from loopcal.mechanism import Mechanism

Ints = NDArray[np.intp]
Texts = NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class Sensor:
    """One kind (with its frame), the noise of its noise columns, and what it looks at.

    Parameters
    ----------
    kind : Kind
    noise : Noise
    rows : (r,) or (r, l) int, optional
        Poses of each row. Default: every pose once; where rows link poses, each with the next and
        the last with the first.
    session, group : text or (r,) text, optional
        See `Observations`.

    Raises
    ------
    DataError
        If the noise does not have one number for each noise column of the kind.
    """

    kind: Kind
    noise: Noise
    rows: Ints | None = None
    session: Texts = field(default_factory=lambda: np.array(""))
    group: Texts = field(default_factory=lambda: np.array(""))

    def __post_init__(self) -> None:
        names = ", ".join(column.name for column in self.kind.noise_columns)
        if len(self.noise.sigma) != len(self.kind.noise_columns):
            raise DataError(
                f"the noise of kind {self.kind.name!r} has {len(self.noise.sigma)} numbers; give "
                f"one for each of {names}"
            )

    def assign_rows(self, n_poses: int) -> Self:
        """The sensor with its rows, sessions and groups spelt out for n poses; DataError where a
        pose is not there.
        """
        rows = self._rows(n_poses)
        if rows.size and (rows.min() < 0 or rows.max() >= n_poses):
            raise DataError(
                f"the kind {self.kind.name!r} is to see poses up to {int(rows.max())} of 0 to "
                f"{n_poses - 1}; correct it"
            )
        spread = {
            name: labels(getattr(self, name), len(rows), name) for name in ("session", "group")
        }
        return replace(self, rows=rows, **spread)

    def _rows(self, n: int) -> Ints:
        if self.rows is not None:
            return indices(self.rows, self.kind)
        if self.kind.poses_per_row == 1:
            return np.arange(n)
        if n < 2:
            raise DataError(
                f"the kind {self.kind.name!r} compares poses, but there is {n}; give at least 2"
            )
        first = np.arange(n if n > 2 else 1)
        return np.stack([first, (first + 1) % n], axis=-1)


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

    def with_tool(self, robot: Mechanism) -> Self:
        """The instrument with the robot's tool, wherever a kind states none of its own."""
        return type(self)(
            tuple(replace(s, kind=s.kind.with_tool(robot.tool)) for s in self.sensors)
        )
