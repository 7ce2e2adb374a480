# SPDX-License-Identifier: Apache-2.0
"""Designs for polynomial regression on [-1, 1], which are known in closed form, and random rows."""

import numpy as np
from numpy.typing import NDArray

from loopcal.planning.design_space import Criterion, DesignProblem, PriorInformation

Array = NDArray[np.float64]
Places = NDArray[np.int64]
L = np.random.default_rng(1).normal(size=(9, 4))
CASES = {
    f"{criterion.name}-nuisance{nuisance}-{'prior' if prior else 'none'}": (
        criterion,
        nuisance,
        prior,
    )
    for criterion in (Criterion("D"), Criterion("A"), Criterion("I", L, 3))
    for nuisance in (0, 2)
    for prior in (False, True)
}
"""Each criterion with and without nuisance parameters and spreads."""


def draw_rows(N: int = 12, r: int = 2, nuisance: int = 0, machine: int = 4, seed: int = 0) -> Array:
    """Return rows (N, r, nuisance + machine) of normal numbers."""
    return np.random.default_rng(seed).normal(size=(N, r, nuisance + machine))


def make_problem(
    rows: Array,
    criterion: Criterion | None = None,
    nuisance: int = 0,
    prior: bool = False,
    repeats: bool = False,
) -> DesignProblem:
    """Return a problem with or without the spreads of the machine as the prior; by default D."""
    make = PriorInformation.from_tolerances if prior else PriorInformation.none
    start = make(rows.shape[2] - nuisance, nuisance)
    return DesignProblem(rows, criterion or Criterion("D"), start, repeats)


def polynomial_rows(x: Array, degree: int) -> Array:
    """Return rows (N, 1, degree + 1) of 1, x, x^2, ..."""
    return (x[:, None] ** np.arange(degree + 1))[:, None, :]


def make_grid(extra: float = 0.0) -> Array:
    """Return points of [-1, 1] in steps of 0.02, and +-extra."""
    return np.unique(np.concatenate([np.arange(-50, 51) / 50, [-extra, extra]]))


def compute_covariance(rows: Array, start: Array, nuisance: int) -> Array:
    """Return the covariance of the machine parameters: a block of the inverse information."""
    stacked = np.concatenate([start, rows.reshape(-1, rows.shape[-1])])
    return np.asarray(np.linalg.inv(stacked.T @ stacked), dtype=np.float64)[nuisance:, nuisance:]
