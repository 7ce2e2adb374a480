# SPDX-License-Identifier: Apache-2.0
"""Measurements: the readings of the actuators at n poses, and what the instruments saw there."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.errors import DataError
from loopcal.measure.arrays import stored
from loopcal.measure.nuisance import NuisanceParameters, StatedValue, collect_nuisance_parameters
from loopcal.measure.observations import Observations
from loopcal.typing import FloatArray

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
        Poses of equal number belong together (a repeat, a shared covariance) and are never split.
        Default: each alone.
    labels : tuple of str, optional
        Names of the poses, for messages and tables. Default "1", "2", ...
    reading_sigma : (n, a) or what spreads to it [SI], optional
        Standard deviation of each reading: 0 is exact, infinite was not taken or is not believed. A
        reading may be NaN exactly where this is infinite. Default None: exact, but where the robot
        states the sigma of its actuators.
    stated_values : tuple of StatedValue, optional
        Priors and fixed values of unknowns that the observations bring with them. Default: all are
        left to the data.

    Raises
    ------
    DataError
        If shapes differ, a reading is not finite though it has a sigma, a sigma is negative, or a
        row refers to a pose that is not there.
    """

    robot_name: str
    readings: FloatArray
    observations: tuple[Observations, ...]
    block: Ints = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    labels: tuple[str, ...] = ()
    reading_sigma: FloatArray | None = None
    stated_values: tuple[StatedValue, ...] = ()

    def __post_init__(self) -> None:
        readings = _readings(self.readings, self.reading_sigma is not None)
        n = len(readings)
        if n == 0:
            raise DataError(
                "there is no pose in these measurements; give at least one row of readings"
            )
        block = np.array(self.block if len(self.block) else np.arange(n))
        if block.shape != (n,) or not np.issubdtype(block.dtype, np.integer):
            raise DataError(
                f"block has shape {block.shape} and type {block.dtype}; give one whole number for "
                "each pose"
            )
        block.setflags(write=False)
        labels = tuple(self.labels) or tuple(str(i + 1) for i in range(n))
        if len(labels) != n:
            raise DataError(f"there are {len(labels)} labels for {n} poses; give one for each")
        for rows in self.observations:
            _check_rows(rows, n)
        values = {
            "readings": readings,
            "block": block,
            "labels": labels,
            "observations": tuple(self.observations),
        }
        if self.reading_sigma is not None:
            values["reading_sigma"] = _reading_sigma(self.reading_sigma, readings, labels)
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

    @property
    def nuisance_parameters(self) -> NuisanceParameters:
        """The unknowns that the observations bring with them, with what is known of them."""
        return collect_nuisance_parameters(self.observations, self.labels, self.stated_values)

    @property
    def context(self) -> Mapping[str, FloatArray]:
        """Time [s] and temperatures [degC] by name, (n,): the mean over the rows that saw a pose,
        NaN where none says.
        """
        found: dict[str, FloatArray] = {}
        for name in dict.fromkeys(name for rows in self.observations for name in rows.context):
            total, count = np.zeros(self.n_poses), np.zeros(self.n_poses)
            for rows in (rows for rows in self.observations if name in rows.context):
                values = np.broadcast_to(
                    rows.context[name][:, None], (len(rows), rows.kind.poses_per_row)
                )
                there = ~np.isnan(values)
                np.add.at(total, rows.rows.reshape(values.shape)[there], values[there])
                np.add.at(count, rows.rows.reshape(values.shape)[there], 1.0)
            found[name] = np.divide(
                total, count, out=np.full(self.n_poses, np.nan), where=count > 0.0
            )
        return found

    def take(self, poses: ArrayLike) -> Self:
        """Measurements of these poses alone, in this order; rows that need any other pose are left
        out.

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
            raise DataError(
                f"cannot take poses {chosen.tolist()}: name some of 0 to {self.n_poses - 1}, each "
                "once"
            )
        place = np.full(self.n_poses, -1)
        place[chosen] = np.arange(len(chosen))
        return replace(
            self,
            readings=self.readings[chosen],
            observations=tuple(_moved(rows, place) for rows in self.observations),
            block=self.block[chosen],
            labels=tuple(self.labels[i] for i in chosen),
            reading_sigma=None if self.reading_sigma is None else self.reading_sigma[chosen],
        )

    def split(self, fraction: float, seed: int) -> tuple[Self, Self]:
        """Two parts, one to fit and one held out, by whole blocks drawn at random.

        Parameters
        ----------
        fraction : float
            Share of the poses in the first part, as nearly as whole blocks allow; both parts get at
            least one block.
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
            raise DataError(
                f"cannot split at {fraction}: give the share of the fit, above 0 and below 1, such "
                "as 0.75"
            )
        names, member, sizes = np.unique(self.block, return_inverse=True, return_counts=True)
        if len(names) < 2:
            raise DataError(
                "cannot split measurements of a single block; measure more poses, or state finer "
                "blocks"
            )
        order = np.random.default_rng(np.random.SeedSequence(seed)).permutation(len(names))
        missed = np.abs(np.cumsum(sizes[order])[:-1] - fraction * self.n_poses)
        fit = np.isin(member, order[: int(np.argmin(missed)) + 1])
        return self.take(fit), self.take(~fit)

    def with_weights(self, weight: ArrayLike) -> Self:
        """The same measurements with one weight (n,) for each pose; a row that links poses takes
        their product.

        Readings that have a sigma are weighted like the rows of their pose: sigma / sqrt(weight).
        For a weight of each row use `Observations.with_weights`.

        Raises
        ------
        DataError
            If there is not one weight for each pose, or one is negative.
        """
        given = stored(weight, "the weight of the poses", (self.n_poses,))
        parts = tuple(
            rows.with_weights(given[rows.rows].reshape(len(rows), -1).prod(axis=1))
            for rows in self.observations
        )
        return replace(
            self, observations=parts, reading_sigma=weight_reading_sigma(self.reading_sigma, given)
        )


def _readings(readings: ArrayLike, uncertain: bool) -> FloatArray:
    """Checked, read-only readings (n, a); NaN stands for one that was not taken, which needs a
    sigma.
    """
    try:
        return stored(readings, "readings", (None, None), allow_nan=uncertain)
    except DataError as error:
        if not uncertain and np.isnan(np.asarray(readings, dtype=float)).any():
            raise DataError(f"{error}, or, where it was not taken, reading_sigma = inf") from None
        raise


def weight_reading_sigma(sigma: FloatArray | None, weight: FloatArray) -> FloatArray | None:
    """Standard deviations (n, a) of readings whose squares count by a weight (n,): infinite for 0;
    exact ones stay exact.
    """
    if sigma is None:
        return None
    root = np.sqrt(weight)[:, None]
    apart = np.divide(sigma, root, out=np.full(sigma.shape, np.inf), where=root > 0.0)
    return np.where(sigma == 0.0, 0.0, apart)


def broadcast_reading_sigma(sigma: ArrayLike, readings: FloatArray) -> FloatArray:
    """Standard deviations (n, a) of readings (n, a) from what spreads to them; DataError where that
    does not fit.
    """
    try:
        if np.iscomplexobj(sigma):
            raise TypeError
        given = np.asarray(sigma, dtype=float)
    except (TypeError, ValueError):
        raise DataError(
            f"reading_sigma is {sigma!r}; give numbers, in metres and radians"
        ) from None
    try:
        return np.array(np.broadcast_to(given, readings.shape))
    except ValueError:
        raise DataError(
            f"reading_sigma has shape {given.shape}; give one number, or one for each of the "
            f"{readings.shape[1]} actuators,"
            f" or one for each of the {readings.shape[0]} x {readings.shape[1]} readings"
        ) from None


def _reading_sigma(sigma: ArrayLike, readings: FloatArray, labels: tuple[str, ...]) -> FloatArray:
    """Checked, read-only standard deviations (n, a) of the readings."""
    spread = broadcast_reading_sigma(sigma, readings)
    for wrong, what in (
        (
            ~(spread >= 0.0),
            "is no standard deviation; give 0 (exact), a positive number, or infinity (not taken)",
        ),
        (
            np.isnan(readings) & np.isfinite(spread),
            "belongs to a reading that is not there; give the reading, or infinity",
        ),
    ):
        if np.any(wrong):
            pose, column = (int(i) for i in np.argwhere(wrong)[0])
            value = f"{spread[pose, column]:.6g}"
            raise DataError(
                f"pose {labels[pose]!r}: the sigma {value} [m or rad] of reading {column + 1} "
                f"{what}"
            )
    spread.setflags(write=False)
    return spread


def _check_rows(rows: Observations, n: int) -> None:
    absent = (rows.rows < 0) | (rows.rows >= n)
    if np.any(absent):
        place = int(np.argwhere(absent)[0][0])
        index = int(rows.rows[absent][0])
        raise DataError(
            f"row {place + 1} of kind {rows.kind.name!r} refers to pose {index}, but the {n} poses "
            f"are 0 to {n - 1};"
            " correct the row or add the pose's readings"
        )


def _moved(rows: Observations, place: Ints) -> Observations:
    """Rows whose poses are all kept, with their new indices; `place` (n,) is -1 for poses that go."""
    target = place[rows.rows]
    kept = np.all(target.reshape(len(rows), -1) >= 0, axis=1)
    return replace(rows.take(kept), rows=target[kept])
