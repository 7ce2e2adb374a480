# SPDX-License-Identifier: Apache-2.0
"""An instrument: the kinds it measures, each with its frame and its noise, and random streams."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.measure import array_checks
from loopcal.measure.kinds.kind import Kind, measure_progress
from loopcal.measure.nuisance import StatedValue
from loopcal.measure.observations import TextArray, check_labels, check_poses, check_rows
from loopcal.mechanism.model import Mechanism
from loopcal.plain_text import represent
from loopcal.typing import FloatArray, IntArray
from loopcal.units import SD_RANGE, Dimension, is_sd

# Standard deviations [SI] of an instrument where none are stated.
SIGMA = {Dimension.LENGTH: 1e-5, Dimension.ANGLE: 5e-5, Dimension.RATIO: 5e-5, Dimension.PIXEL: 0.1}


class Noise(ABC):
    """Independent noise of m columns.

    sight : name -> standard deviation [SI] of noise by `Kind.sight_noise`, in addition.
    """

    sight: Mapping[str, float] = MappingProxyType({})

    @property
    @abstractmethod
    def sigma(self) -> FloatArray:
        """Standard deviations (m,) [SI]."""

    @abstractmethod
    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return noise of n rows, (n, m) [SI]."""


def _check_positive(value: ArrayLike, what: str) -> FloatArray:
    array = array_checks.check_array(value, what, (None,))
    array_checks.refuse_first(
        ~is_sd(array),
        lambda i: (
            f"{what} contains {array[i]:.6g}. Give a number above 0 for each column, {SD_RANGE}"
        ),
    )
    return array


@dataclass(frozen=True, eq=False)
class Gaussian(Noise):
    """Normal noise with standard deviations `sd` (m,) [SI]; DataError unless each is above 0.

    sight : standard deviations [SI] of a tracker in addition, such as
        `{"range": 6e-6, "angle": 5e-6}`; `sd` may then be 0.
    """

    sd: FloatArray
    sight: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        what = "the sigma of the noise"
        sd = array_checks.check_array(self.sd, what, (None,))
        stated = [*self.sight.values(), *sd[sd != 0.0]] if self.sight else sd
        _check_positive(stated, what)
        array_checks.set_fields(self, sd=sd)

    __repr__ = represent

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (m,) [SI]."""
        return self.sd

    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return noise of n rows, (n, m) [SI]."""
        return generator.standard_normal((n, len(self.sd))) * self.sd


@dataclass(frozen=True, eq=False)
class Uniform(Noise):
    """Uniform noise between -limit and +limit (m,) [SI], each above 0; sigma = limit / sqrt(3)."""

    limit: FloatArray

    def __post_init__(self) -> None:
        array_checks.set_fields(self, limit=_check_positive(self.limit, "the limits of the noise"))

    __repr__ = represent

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (m,) [SI]."""
        return self.limit / np.sqrt(3.0)

    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return noise of n rows, (n, m) [SI]."""
        return generator.uniform(-1.0, 1.0, (n, len(self.limit))) * self.limit


@dataclass(frozen=True)
class BlockStream:
    """The random stream of a block of trials, in place of a seed.

    It is that of the counter-based generator Philox, of which each trial and purpose uses a part of
    its own; Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11 (2011), doi
    10.1145/2063384.2063405.
    """

    key: int  # 128 bits of the study
    block: int  # number of the block


Seed = int | BlockStream
Distribution = Literal["normal", "uniform"]


def make_random_stream(seed: Seed, trial: int, purpose: int = 0) -> np.random.Generator:
    """Return the generator of one trial, counted from 0: a function of these three numbers only.

    purpose : separates what one trial draws: 0 noise, 1 true values, 2 noise of readings, 3
        effects, 4 errors of the readings of held-out poses, 5 setup parameters, 6
        conditions.
    """
    if isinstance(seed, BlockStream):
        counter = np.array([0, purpose, trial, seed.block], dtype=np.uint64)
        return np.random.Generator(np.random.Philox(key=seed.key, counter=counter))
    array_checks.check_seed(seed)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(trial, purpose)))


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """One kind (with its frame), the noise of its noise columns, and the poses that it measures.

    Parameters
    ----------
    rows : (r,) or (r, l) poses of each row. Default: every pose once, or as often as the kind has
        rows for each pose (`Kind.rows_per_pose`). Where a row compares poses:
        each pose with the next one, and the last with the first. Targets on the base are measured
        twice by default, before and after the poses; only the number of their rows matters.
    session, group : text or (r,) text, see `Observations`.

    Raises
    ------
    DataError : the noise does not have one number for each noise column of the kind.
    """

    kind: Kind
    noise: Noise
    rows: IntArray | None = None
    session: TextArray = field(default_factory=lambda: np.array(""))
    group: TextArray = field(default_factory=lambda: np.array(""))

    def __post_init__(self) -> None:
        array_checks.check_type(self.kind, Kind, "kind", "such as loopcal.Pose()")
        array_checks.check_type(self.noise, Noise, "noise", "such as loopcal.Gaussian([...])")
        if len(self.noise.sigma) != len(self.kind.noise_columns):
            names = ", ".join(column.name for column in self.kind.noise_columns)
            raise DataError(
                f"the noise of kind {self.kind.name!r} has {len(self.noise.sigma)} numbers. Give "
                f"one for each of {names}"
            )

    __repr__ = represent

    def assign_rows(self, n_poses: int) -> Self:
        """Return the sensor with explicit rows, sessions and groups for n poses; DataError where a
        pose does not exist.
        """
        rows = self._list_rows(n_poses)
        check_poses(rows, self.kind, n_poses)
        names = {
            name: check_labels(getattr(self, name), len(rows), name)
            for name in ("session", "group")
        }
        return replace(self, rows=rows, **names)

    @property
    def drift_part(self) -> FloatArray:
        """(r,) the part of its session's drift that each row takes, in their order."""
        return measure_progress(self.session, None)

    @property
    def assigned_rows(self) -> IntArray:
        """Rows of a sensor from `assign_rows`; DataError where they are still implicit."""
        if self.rows is None:
            raise DataError("the sensor has no rows yet. Use sensor.assign_rows(n_poses)")
        return self.rows

    def _list_rows(self, n: int) -> IntArray:
        """Return the poses of the rows for n poses."""
        if self.kind.is_of_base:
            return np.zeros(2 if self.rows is None else len(self.rows), dtype=np.intp)
        if self.rows is not None:
            return check_rows(self.rows, self.kind)
        if self.kind.poses_per_row == 1:
            return np.repeat(np.arange(n), self.kind.rows_per_pose)
        if n < 2:
            raise DataError(
                f"a row of kind {self.kind.name!r} compares two poses, but the number of poses is "
                f"{n}. Give at least 2"
            )
        first = np.arange(n if n > 2 else 1)
        return np.stack([first, (first + 1) % n], axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class Instrument:
    """The sensors, at least one, that measure every pose.

    stated_values : priors of its setup parameters, such as a scale of 2 ppm:
    `StatedValue("position.scale", sd=2e-6)`. A simulation draws the true values from them.
    has_stations : whether the sensors are stations of one, of which a plan chooses one for a pose.
    """

    sensors: tuple[Sensor, ...]
    stated_values: tuple[StatedValue, ...] = ()
    has_stations: bool = False

    def __post_init__(self) -> None:
        array_checks.set_fields(
            self, sensors=tuple(self.sensors), stated_values=tuple(self.stated_values)
        )
        if not self.sensors:
            raise DataError("an instrument needs at least one sensor: a kind and its noise")
        for sensor in self.sensors:
            array_checks.check_type(
                sensor, Sensor, "sensors", "such as loopcal.Sensor(kind, noise)"
            )

    def __repr__(self) -> str:
        sensors = "".join(f"  {sensor!r},\n" for sensor in self.sensors[:8])
        more = f"  and {len(self.sensors) - 8} more\n" if len(self.sensors) > 8 else ""
        return f"Instrument((\n{sensors}{more}))"

    def with_tool(self, robot: Mechanism) -> Self:
        """Return the instrument with the robot's tool, wherever a kind does not state one."""
        sensors = (replace(s, kind=s.kind.with_tool(robot.tool)) for s in self.sensors)
        return replace(self, sensors=tuple(sensors))
