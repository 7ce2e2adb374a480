# SPDX-License-Identifier: Apache-2.0
"""Test whether residuals depend on order, time, temperature, session or actuator readings.

With r the residuals that no parameter explains, of nu degrees of freedom (`ResidualRows`), and Q
the basis of the part of an effect's columns that nothing estimated explains, of rank q,

    F = |Q'r|^2 / q  /  ((|r|^2 - |Q'r|^2) / (nu - q))

has an F distribution for independent normal errors of any size. The correlation of neighbors in the
order of measurement is r'L r / |r|^2, L the mean of the shifts by one row in both directions within
every series. Its mean and variance for independent errors follow from the traces of M L and
(M L)^2, M = I - U U'; it is compared with the beta distribution on (-1, 1) of these moments.
Source: Durbin and Watson, Testing for serial correlation in least squares regression, Biometrika
37 (1950) and 58 (1971).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.residuals.residual_effects import ORDER, TIME, Effect, list_effects
from loopcal.diagnose.residuals.residual_rows import ResidualRows, span_columns
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.numerics.chi_square import compute_f_tail
from loopcal.numerics.multiple_tests import compute_any_probability
from loopcal.typing import FloatArray

LEVEL = 0.05
"""Probability that independent errors show any pattern, over all tests of a fit (Sidak); and the
same for slow errors of the poses (`model_discrepancy`).
"""

FALSE_ALARMS = compute_any_probability(LEVEL, 2)
"""Probability that independent errors change the uncertainty of a fit: patterns or slow errors."""

FEWEST_LEFT = 3.0
"""Degrees of freedom of the residuals for each size of an effect that is tested, at least."""


class EffectSizes(NamedTuple):
    """The sizes of a significant effect, and how they act on the residuals.

    Attributes
    ----------
    effect : what the residuals depend on. p_value : probability that independent errors show an
        effect as large, in any of the tests of a fit (Sidak).
    sizes, errors : (c,) [SI] estimates and standard deviations.
    moments : (c, c) [SI] expected products of the sizes.
    """

    effect: Effect
    p_value: float
    sizes: FloatArray
    errors: FloatArray
    moments: FloatArray


class ResidualPatterns(NamedTuple):
    """What the residuals of a fit show.

    Attributes
    ----------
    tests : number of tests. effects : that are significant, the first found first.
    correlation : of neighboring residuals, less what a fit causes. p_value : probability of a
        larger one for independent errors, in any of the tests (Sidak).
    is_correlated : whether it is significant. order : "time" or "order", that of the rows.
    rows : the residuals, as if the fit had estimated the effects.
    """

    tests: int
    effects: tuple[EffectSizes, ...]
    correlation: float
    p_value: float
    is_correlated: bool
    order: str
    rows: ResidualRows


def find_patterns(rows: ResidualRows, data: Measurements, robot: Mechanism) -> ResidualPatterns:
    """Test the residuals against every effect, then against correlation in the order of rows.

    The most significant effect is estimated, and the others are tested again without it, until none
    is significant.
    """
    listed = list_effects(rows, data, robot)
    order = TIME if any(effect.source == TIME for effect in listed) else ORDER
    effects = _list_testable(rows, listed)
    correlation, p_value = test_correlation(rows)
    tests = len(effects) + int(np.isfinite(p_value))
    significant: list[EffectSizes] = []
    while effects:
        p_values = [_compute_tail(rows, basis) for _, basis in effects]
        best = int(np.argmin(p_values))
        p_any = compute_any_probability(p_values[best], tests)
        if not p_any < LEVEL:
            break
        effect, _ = effects.pop(best)
        significant.append(estimate_sizes(rows, effect, p_any))
        rows = rows.with_effects(effect.columns)
        effects = _list_testable(rows, [other for other, _ in effects])
    if significant:
        correlation, p_value = test_correlation(rows)
    p_any = compute_any_probability(p_value, tests)
    is_correlated = p_any < LEVEL
    return ResidualPatterns(
        tests, tuple(significant), correlation, p_any, is_correlated, order, rows
    )


def test_effect(rows: ResidualRows, effect: Effect) -> float:
    """Return the probability of a larger F for independent errors."""
    return _compute_tail(rows, span_columns(rows.project(effect.columns)))


def _compute_tail(rows: ResidualRows, basis: FloatArray) -> float:
    """Return the same for an effect with the basis (R, q) of what nothing estimated explains."""
    q, explained = basis.shape[1], float(((basis.T @ rows.residual) ** 2).sum())
    left = rows.degrees - q
    statistic = explained / q / ((rows.square - explained) / left)
    return float(compute_f_tail(q, left, statistic))


def estimate_sizes(rows: ResidualRows, effect: Effect, p_value: float) -> EffectSizes:
    """Return the sizes of an effect, by least squares where residuals show them.

    Sizes that the residuals hardly show, because they are like a parameter of the machine, get the
    variance that the others have: g ~ N(0, tau^2) in units of the noise, tau^2 by its moments.
    Combinations that change no row, such as an equal offset of all sessions, count as zero.
    """
    length = np.linalg.norm(effect.columns, axis=0) / np.sqrt(len(rows.residual))
    scaled = effect.columns / length
    left = rows.project(scaled)
    noise = rows.square / rows.degrees
    u, s, vt = np.linalg.svd(left, full_matrices=False)
    is_observable = s > 1e-6 * np.linalg.norm(scaled)
    c = np.where(is_observable, u.T @ rows.residual, 0.0)
    excess = float((c**2).sum()) - noise * int(is_observable.sum())
    tau2 = max(excess, noise) / float((s[is_observable] ** 2).sum())
    variance = 1.0 / (s**2 / noise + 1.0 / tau2)
    mean = vt.T @ (variance * s * c / noise)
    spread = _span_rows(scaled) @ (vt.T * np.sqrt(variance))
    back = 1.0 / length
    return EffectSizes(
        effect,
        p_value,
        back * mean,
        back * np.linalg.norm(spread, axis=1),
        back[:, None] * (np.outer(mean, mean) + spread @ spread.T) * back,
    )


def _span_rows(columns: FloatArray) -> FloatArray:
    """Return the projection (c, c) on the combinations of columns (R, c) that change a row."""
    _, s, vt = np.linalg.svd(columns, full_matrices=False)
    kept = vt[s > 1e-10 * s.max(initial=0.0)]
    return kept.T @ kept


def test_correlation(rows: ResidualRows) -> tuple[float, float]:
    """Return the correlation of neighboring residuals less its mean for independent errors, and the
    probability of a larger one; NaN without neighbors or degrees of freedom.
    """
    pairs = np.flatnonzero(rows.series[1:] == rows.series[:-1])
    nu = rows.degrees
    if len(pairs) == 0 or nu < FEWEST_LEFT:
        return np.nan, np.nan
    r, U = rows.residual, rows.basis
    observed = float(r[pairs] @ r[pairs + 1]) / rows.square
    LU = _shift(U, pairs)
    inner = U.T @ LU
    # traces of B = M L M, from tr L = 0 and tr L^2 = pairs / 2
    first = -float(np.trace(inner))
    second = 0.5 * len(pairs) - 2.0 * float((LU**2).sum()) + float((inner**2).sum())
    mean = first / nu
    variance = 2.0 * (second - first**2 / nu) / (nu * (nu + 2.0))
    if not variance > 0.0:
        return np.nan, np.nan
    return observed - mean, _compute_beta_tail(observed, mean, variance)


def _shift(columns: FloatArray, pairs: np.ndarray) -> FloatArray:
    """Return L columns, L the symmetric matrix with 1/2 for each pair of neighbors."""
    moved = np.zeros_like(columns)
    moved[pairs] += 0.5 * columns[pairs + 1]
    moved[pairs + 1] += 0.5 * columns[pairs]
    return moved


def _compute_beta_tail(observed: float, mean: float, variance: float) -> float:
    """Return the probability of a larger value of a beta variable on (-1, 1)."""
    from loopcal.numerics.special_functions import betainc

    center, spread = 0.5 * (1.0 + mean), 0.25 * variance
    total = center * (1.0 - center) / spread - 1.0
    if not total > 0.0:
        return float("nan")
    place = float(np.clip(0.5 * (1.0 - observed), 0.0, 1.0))
    return float(betainc((1.0 - center) * total, center * total, place))


def _list_testable(
    rows: ResidualRows, effects: Iterable[Effect]
) -> list[tuple[Effect, FloatArray]]:
    """Return the effects that residuals can show, with enough degrees of freedom left, each with
    the basis (R, q) of what nothing estimated explains of it.
    """
    testable = []
    for effect in effects:
        if effect.columns.shape[1]:
            basis = span_columns(rows.project(effect.columns))
            if basis.shape[1] > 0 and rows.degrees >= (1.0 + FEWEST_LEFT) * basis.shape[1]:
                testable.append((effect, basis))
    return testable
