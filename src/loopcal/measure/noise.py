# SPDX-License-Identifier: Apache-2.0
"""Noise of an instrument's columns, and the random streams that draw it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.measure.array_checks import check_array, set_fields
from loopcal.typing import FloatArray


class Noise(ABC):
    """Independent noise of m columns."""

    @property
    @abstractmethod
    def sigma(self) -> FloatArray:
        """Standard deviations (m,) [SI]."""

    @abstractmethod
    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return noise of n rows, (n, m) [SI]."""


def _check_positive(value: ArrayLike, what: str) -> FloatArray:
    array = check_array(value, what, (None,))
    if np.any(array <= 0.0):
        raise DataError(
            f"{what} contains {float(np.min(array)):.6g}; give a number above 0 for each column"
        )
    return array


@dataclass(frozen=True, eq=False)
class Gaussian(Noise):
    """Normal noise with standard deviations `sd` (m,) [SI]; DataError unless each is above 0."""

    sd: FloatArray

    def __post_init__(self) -> None:
        set_fields(self, sd=_check_positive(self.sd, "the sigma of the noise"))

    def __repr__(self) -> str:
        return f"Gaussian({self.sd.tolist()})"

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (m,) [SI]."""
        return self.sd

    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return noise of n rows, (n, m) [SI]."""
        return generator.standard_normal((n, len(self.sd))) * self.sd


@dataclass(frozen=True, eq=False)
class Uniform(Noise):
    """Uniform noise between -limit and +limit (m,) [SI], with sigma = limit / sqrt(3); DataError
    unless each is above 0.
    """

    limit: FloatArray

    def __post_init__(self) -> None:
        set_fields(self, limit=_check_positive(self.limit, "the limits of the noise"))

    def __repr__(self) -> str:
        return f"Uniform({self.limit.tolist()})"

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (m,) [SI]."""
        return self.limit / np.sqrt(3.0)

    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return noise of n rows, (n, m) [SI]."""
        return generator.uniform(-1.0, 1.0, (n, len(self.limit))) * self.limit


def make_random_stream(seed: int, trial: int, purpose: int = 0) -> np.random.Generator:
    """Return the generator of one trial of a study, a function of these three numbers only.

    Parameters
    ----------
    seed : int
        Of the study.
    trial : int
        Counted from 0. A trial gets the same numbers for any number of trials.
    purpose : int
        Separates what one trial draws: 0 noise, 1 true values, 2 noise of readings.

    Returns
    -------
    generator : numpy.random.Generator
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(trial, purpose)))
