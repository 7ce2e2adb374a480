# SPDX-License-Identifier: Apache-2.0
"""Measurements: the readings of the actuators at n poses, and what the instruments saw there."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.errors import DataError
from loopcal.measure.arrays import stored
from loopcal.measure.observations import Observations

Array = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Everything measured on one robot.

    Parameters
    ----------
    robot_name : str
    readings : (n, a) [SI]
        Actuator readings at each pose.
    observations : tuple of Observations
        Their rows are indices of poses.
    block : (n,) int, optional
        Poses of equal number belong together (a repeat, a shared covariance) and are never split. Default: each alone.
    labels : tuple of str, optional
        Names of the poses, for messages and tables. Default "1", "2", ...

    Raises
    ------
    DataError
        If shapes differ, a reading is not finite, or a row refers to a pose that is not there.
    """

    robot_name: str
    readings: Array
    observations: tuple[Observations, ...]
    block: Ints = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    labels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        readings = stored(self.readings, "readings", (None, None))
        n = len(readings)
        if n == 0:
            raise DataError("there is no pose in these measurements; give at least one row of readings")
        block = np.array(self.block if len(self.block) else np.arange(n))
        if block.shape != (n,) or not np.issubdtype(block.dtype, np.integer):
            raise DataError(f"block has shape {block.shape} and type {block.dtype}; give one whole number for each pose")
        block.setflags(write=False)
        labels = tuple(self.labels) or tuple(str(i + 1) for i in range(n))
        if len(labels) != n:
            raise DataError(f"there are {len(labels)} labels for {n} poses; give one for each")
        for rows in self.observations:
            _check_rows(rows, n)
        values = {"readings": readings, "block": block, "labels": labels, "observations": tuple(self.observations)}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def n_poses(self) -> int:
        """Number of poses n."""
        return len(self.readings)

    @property
    def n_rows(self) -> int:
        """Number of scalar residuals that count (present, weight above 0), over all kinds."""
        return sum(rows.n_residuals for rows in self.observations)

    def take(self, poses: ArrayLike) -> Self:
        """Measurements of these poses alone, in this order; rows that need any other pose are left out.

        Parameters
        ----------
        poses : (k,) int, or (n,) bool

        Returns
        -------
        measurements : Measurements

        Raises
        ------
        DataError
            If a pose is not there, is named twice, or none is left.
        """
        asked = np.asarray(poses)
        chosen = np.flatnonzero(asked) if asked.dtype == bool else asked.astype(np.intp)
        outside = (chosen < 0) | (chosen >= self.n_poses)
        if np.any(outside) or len(np.unique(chosen)) < len(chosen) or not len(chosen):
            raise DataError(f"cannot take poses {chosen.tolist()}: name some of 0 to {self.n_poses - 1}, each once")
        place = np.full(self.n_poses, -1)
        place[chosen] = np.arange(len(chosen))
        return replace(
            self,
            readings=self.readings[chosen],
            observations=tuple(_moved(rows, place) for rows in self.observations),
            block=self.block[chosen],
            labels=tuple(self.labels[i] for i in chosen),
        )

    def split(self, fraction: float, seed: int) -> tuple[Self, Self]:
        """Two parts, one to fit and one held out, by whole blocks drawn at random.

        Parameters
        ----------
        fraction : float
            Share of the poses in the first part, as nearly as whole blocks allow; both parts get at least one block.
        seed : int
            The same seed gives the same parts.

        Returns
        -------
        fit, held_out : Measurements
            Poses in their old order.

        Raises
        ------
        DataError
            If the fraction is not between 0 and 1, or there is only one block.
        """
        if not 0.0 < fraction < 1.0:
            raise DataError(f"cannot split at {fraction}: give the share of the fit, above 0 and below 1, such as 0.75")
        names, member, sizes = np.unique(self.block, return_inverse=True, return_counts=True)
        if len(names) < 2:
            raise DataError("cannot split measurements of a single block; measure more poses, or state finer blocks")
        order = np.random.default_rng(np.random.SeedSequence(seed)).permutation(len(names))
        missed = np.abs(np.cumsum(sizes[order])[:-1] - fraction * self.n_poses)
        fit = np.isin(member, order[: int(np.argmin(missed)) + 1])
        return self.take(fit), self.take(~fit)

    def reweighted(self, weight: ArrayLike) -> Self:
        """The same measurements with one weight (n,) for each pose; a row that links poses takes their product.

        For a weight of each row use `Observations.reweighted`.

        Raises
        ------
        DataError
            If there is not one weight for each pose, or one is negative.
        """
        given = stored(weight, "the weight of the poses", (self.n_poses,))
        parts = tuple(rows.reweighted(given[rows.rows].reshape(len(rows), -1).prod(axis=1)) for rows in self.observations)
        return replace(self, observations=parts)


def _check_rows(rows: Observations, n: int) -> None:
    absent = (rows.rows < 0) | (rows.rows >= n)
    if np.any(absent):
        place = int(np.argwhere(absent)[0][0])
        index = int(rows.rows[absent][0])
        raise DataError(
            f"row {place + 1} of kind {rows.kind.name!r} refers to pose {index}, but the {n} poses are 0 to {n - 1};"
            " correct the row or add the pose's readings"
        )


def _moved(rows: Observations, place: Ints) -> Observations:
    """Rows whose poses are all kept, with their new indices; `place` (n,) is -1 for poses that go."""
    target = place[rows.rows]
    kept = np.all(target.reshape(len(rows), -1) >= 0, axis=1)
    return replace(rows.take(kept), rows=target[kept])
