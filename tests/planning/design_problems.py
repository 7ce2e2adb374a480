# SPDX-License-Identifier: Apache-2.0
"""Designs for polynomial regression on [-1, 1], which are known in closed form, and random rows."""

import numpy as np
from numpy.typing import NDArray

from loopcal.planning.design_space import PriorInformation

Array = NDArray[np.float64]
Places = NDArray[np.int64]


def polynomial_rows(x: Array, degree: int) -> Array:
    """Return rows (N, 1, degree + 1) of 1, x, x^2, ..."""
    return (x[:, None] ** np.arange(degree + 1))[:, None, :]


def make_grid(extra: float = 0.0) -> Array:
    """Return points of [-1, 1] in steps of 0.02, and +-extra."""
    return np.unique(np.concatenate([np.arange(-50, 51) / 50, [-extra, extra]]))


def draw_rows(N: int = 12, r: int = 2, nuisance: int = 0, machine: int = 4, seed: int = 0) -> Array:
    """Return rows (N, r, nuisance + machine) of normal numbers."""
    return np.random.default_rng(seed).normal(size=(N, r, nuisance + machine))


def make_prior(has_tolerances: bool, nuisance: int, machine: int = 4) -> PriorInformation:
    """Return the tolerances of the machine parameters as the prior, or no prior."""
    make = PriorInformation.from_tolerances if has_tolerances else PriorInformation.none
    return make(machine, nuisance)


def compute_covariance(rows: Array, start: Array, nuisance: int) -> Array:
    """Return the covariance of the machine parameters: a block of the inverse information."""
    stacked = np.concatenate([start, rows.reshape(-1, rows.shape[-1])])
    return np.asarray(np.linalg.inv(stacked.T @ stacked), dtype=np.float64)[nuisance:, nuisance:]
