# SPDX-License-Identifier: Apache-2.0
"""The most probable factor on all tolerances, and how well the data determine it.

With the prior z ~ N(0, factor^2) and unit noise the projections c_i = u_i'b are independent, c_i ~
N(0, d_i), d_i = 1 + factor^2 s_i^2. Minus twice the log density of the data is

    L(factor) = sum log d_i + c_i^2 / d_i

The factor with the smallest L, at least 1, is used: stated tolerances are inflated, never reduced.
Of a factor nothing is known beforehand but that it is at least 1 (its logarithm is uniform), so
that exp(-L/2) is its distribution afterwards. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.inference.residual_test import SIGNIFICANCE
from loopcal.numerics.chi_square import compute_chi_square_tail
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import BoolArray, FloatArray

LARGEST_FACTOR = 1e6
"""Factor on tolerances up to which the most probable one is searched."""

WIDEST = 30.0
"""Factor on an estimated factor up to which its distribution is integrated."""

GRID = np.log(LARGEST_FACTOR) * np.linspace(0.0, 1.0, 20) ** 1.5
"""Logarithms of factors among which the minimum is bracketed."""

NEWTON_STEPS = 6
"""Steps at most that refine a minimum inside its bracket; four are enough but for rounding."""

By = Literal["auto", "global", "groups", "heavy-tailed"]
"""What may get a factor of its own; see `InflatedTolerances`."""


@dataclass(frozen=True)
class InflatedTolerances:
    """Inflate the tolerances by the factors that the data make most probable, at least 1.

    The noise that the rows show (`estimate_excess_noise`) counts, so that a wrong sigma, wrong rows
    or an incomplete model do not inflate the tolerances.

    Called with a decomposition, the rule returns the factor on all tolerances. `identify` also
    chooses the `loopcal.estimate.methods.tolerance_components` that it allows.

    Parameters
    ----------
    by : "global": one factor on all tolerances. "groups": also factors of their own for limbs and
        types of parameters, and shifts that parameters of one type share. "heavy-tailed": also
        single parameters. "auto", the default: all of these.

    Raises
    ------
    EstimationError : another word.
    """

    by: By = "auto"

    def __post_init__(self) -> None:
        if self.by not in get_args(By):
            raise EstimationError(
                f"inflated tolerances by {self.by!r}; give 'global', 'groups', 'heavy-tailed' or "
                "'auto'"
            )

    def __call__(self, decomposition: Decomposition) -> FloatArray:
        """Return the factor (t,) on all tolerances."""
        return find_most_probable_factor(
            decomposition.divided(estimate_excess_noise(decomposition))
        )


def find_most_probable_factor(decomposition: Decomposition) -> FloatArray:
    """Return the factor (t,) on all tolerances, at least 1, that makes the data most probable.

    The smallest L on a grid is refined by Newton's method in the logarithm of factor^2:

        L' = sum f_i (1 - r_i),   L'' = sum f_i ((1 - f_i) (1 - r_i) + f_i r_i)

    with f_i = 1 - 1 / d_i and r_i = c_i^2 / d_i.
    """
    square, projected = _count_penalized(decomposition)
    best = np.argmin(_score(square, projected, GRID), axis=1)
    x, low, high = (2.0 * GRID[np.clip(best + shift, 0, len(GRID) - 1)] for shift in (0, -1, 1))
    for _ in range(NEWTON_STEPS):
        d = 1.0 + np.exp(x)[:, None] * square
        ratio = projected / d
        f, excess = 1.0 - 1.0 / d, 1.0 - ratio
        slope = (f * excess).sum(axis=1)
        if (slope >= 0.0)[best == 0].all() and (best == 0).all():
            return np.ones(len(x))
        curvature = (f * (excess + f * (ratio - excess))).sum(axis=1)
        # the minimum is on the side towards which L falls
        low, high = np.where(slope < 0.0, x, low), np.where(slope > 0.0, x, high)
        step = slope / np.where(curvature > 0.0, curvature, np.inf)
        before, x = x, np.where(curvature > 0.0, np.clip(x - step, low, high), 0.5 * (low + high))
        if np.abs(x - before).max() < 1e-6:  # the error is the square of this
            break
    return np.asarray(np.exp(0.5 * x))


def estimate_factor_spread(decomposition: Decomposition, factor: FloatArray) -> FloatArray:
    """Return the root mean square deviation (t,) of the log factor from that of `factor` (t,).

    It is that of the distribution exp(-L/2) over factors from 1 to WIDEST times `factor`, which is
    cut off at 1.
    """
    square, projected = _count_penalized(decomposition)
    spread = np.empty(len(factor))
    for i, center in enumerate(np.log(factor)):
        grid = np.linspace(0.0, center + np.log(WIDEST), 200)
        score = _score(square[[i]], projected[[i]], grid)[0]
        weight = np.exp(-0.5 * (score - score.min()))
        spread[i] = np.sqrt((weight * (grid - center) ** 2).sum() / weight.sum())
    return spread


def estimate_excess_noise(decomposition: Decomposition) -> FloatArray:
    """Return the factor (t,) on sigma that the part outside the range shows.

    It is 1 unless that part is larger than the noise beyond doubt.
    """
    left = (decomposition.rows - decomposition.rank).astype(np.float64)
    larger = compute_chi_square_tail(left, decomposition.unexplained) < SIGNIFICANCE
    return np.sqrt(np.where(larger, decomposition.unexplained / np.maximum(left, 1.0), 1.0))


def are_penalized(decomposition: Decomposition) -> BoolArray:
    """Return which directions (t, p) a prior penalizes."""
    unpenalized = decomposition.unpenalized
    if unpenalized is None:
        return np.ones(decomposition.singular_values.shape, dtype=bool)
    return ~unpenalized


def _count_penalized(decomposition: Decomposition) -> tuple[FloatArray, FloatArray]:
    """Return s^2 and c^2 (t, p), zero for directions of which the prior knows nothing."""
    counted = are_penalized(decomposition)
    return (
        np.where(counted, decomposition.singular_values, 0.0) ** 2,
        np.where(counted, decomposition.projections, 0.0) ** 2,
    )


def _score(square: FloatArray, projected: FloatArray, log_factor: FloatArray) -> FloatArray:
    """Return L (t, g) up to a constant at g log factors."""
    d = 1.0 + np.exp(2.0 * log_factor)[:, None] * square[:, None, :]
    return (np.log(d) + projected[:, None, :] / d).sum(axis=2)
