# SPDX-License-Identifier: Apache-2.0
"""Probabilities and quantiles of the normal, chi-square, F, t and beta distributions.

They are those of `scipy.special`, whose import takes twice as long as that of numpy: many values
are left to it. A few are computed here, from two incomplete integrals by their continued fractions
(Lentz), with factors by the saddle point of Loader that lose no digit for many degrees of freedom.

Sources: W. J. Lentz, Applied Optics 15 (1976) 668, doi:10.1364/AO.15.000668; C. Loader, Fast and
accurate computation of binomial probabilities (2000).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

import numpy as np
from numpy.typing import ArrayLike

from loopcal.typing import FloatArray

FEW = 2000
"""Values up to which they are computed here."""

MANY = 1e8
"""Degrees of freedom up to which sums are short and rounding decides nothing."""

STEPS, TINY = 100_000, 1e-300
"""Most terms of a continued fraction, which need a few times the root of the degrees of freedom;
and the number that stands for zero in it."""

STIRLING = (1.0 / 12.0, 1.0 / 360.0, 1.0 / 1260.0, 1.0 / 1680.0, 1.0 / 1188.0)
"""Coefficients of the error of Stirling's formula, with alternating signs."""

LARGE = 16.0
"""Numbers from which these terms are exact in double precision."""


def _compute_stirling_error(n: float) -> float:
    """Return log Gamma(n + 1) - (n + 1/2) log n + n - 1/2 log 2 pi."""
    if n < LARGE:
        return math.lgamma(n + 1.0) - (n + 0.5) * math.log(n) + n - 0.5 * math.log(2.0 * math.pi)
    total = 0.0
    for coefficient in reversed(STIRLING):
        total = coefficient - total / (n * n)
    return total / n


def _compute_deviance(x: float, mean: float) -> float:
    """Return x log(x / mean) + mean - x without cancellation."""
    difference = (x - mean) / (x + mean)
    if abs(difference) > 0.1:
        return x * math.log(x / mean) + mean - x
    total, power, k = (x - mean) * difference, 2.0 * x * difference, 1
    while True:  # the series of the logarithm
        power *= difference * difference
        if total == (total := total + power / (2 * k + 1)):
            return total
        k += 1


def _sum_fraction(term: Callable[[int], tuple[float, float]], first: float) -> float:
    """Return first + a1 / (b1 + a2 / (b2 + ..)) of terms (a, b)."""
    value = first or TINY
    c, d = value, 0.0
    for k in range(1, STEPS):
        a, b = term(k)
        d, c = 1.0 / ((b + a * d) or TINY), (b + a / c) or TINY
        value *= c * d
        if abs(c * d - 1.0) < 3e-16:
            break
    return value


Shares = tuple[float, float, float]
"""Probability below and above a value u, and density there."""


def _split_at_end(is_first: bool, is_last: bool) -> Shares:
    """Return the shares at an end of the distribution; NaN where the value is not a number."""
    return (
        (0.0, 1.0, 0.0)
        if is_first
        else (1.0, 0.0, 0.0)
        if is_last
        else (math.nan, math.nan, math.nan)
    )


def _split_gamma(a: float, x: float) -> Shares:
    """Return the shares of the integral of t^(a - 1) e^-t below and above t = x, by u = log x."""
    if not 0.0 < x < math.inf:
        return _split_at_end(x <= 0.0, x > 0.0)
    density = math.exp(-_compute_stirling_error(a) - _compute_deviance(a, x))
    density *= math.sqrt(a / (2.0 * math.pi))  # x^a e^-x / Gamma(a)
    if x > a + 1.0:
        first = x + 1.0 - a
        above = density / _sum_fraction(lambda k: (-k * (k - a), first + 2 * k), first)
        return 1.0 - above, above, density
    total = part = 1.0 / a
    k = a
    while part > 1e-17 * total:
        k += 1.0
        part *= x / k
        total += part
    return density * total, 1.0 - density * total, density


def _split_beta(a: float, b: float, x: float, y: float) -> Shares:
    """Return the shares of the integral of t^(a - 1) (1 - t)^(b - 1) below and above t = x = 1 - y,
    by u = log(x / y).
    """
    if not (x > 0.0 and y > 0.0):
        return _split_at_end(x <= 0.0, y <= 0.0)
    n = a + b
    if x > (a + 1.0) / (n + 2.0):
        above, below, density = _split_beta(b, a, y, x)
        return below, above, density
    errors = _compute_stirling_error(n) - _compute_stirling_error(a) - _compute_stirling_error(b)
    density = math.exp(errors - _compute_deviance(a, n * x) - _compute_deviance(b, n * y))
    density *= math.sqrt(a * b / (2.0 * math.pi * n))  # x^a y^b / B(a, b)

    def term(k: int) -> tuple[float, float]:
        m = k // 2
        if k % 2:
            return -(a + m) * (n + m) * x / ((a + 2 * m) * (a + 2 * m + 1)), 1.0
        return m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)), 1.0

    below = density / a / _sum_fraction(term, 1.0)
    return below, 1.0 - below, density


def _split_f(degrees: float, left: float, value: float) -> Shares:
    """Return the shares of the F distribution below and above a value."""
    if math.isinf(value):
        return 1.0, 0.0, 0.0
    total = degrees * value + left
    return _split_beta(0.5 * degrees, 0.5 * left, degrees * value / total, left / total)


def _find_quantile(split: Callable[[float], Shares], u: float, above: float) -> float:
    """Return u with a probability above it, by Newton's method from near the mean.

    The logarithm of either probability is concave in u, so every step ends on one side. Near the
    end a step has the size of the square of the last one, or else of the rounding of thousands of
    degrees of freedom.
    """
    if not 0.0 < above < 1.0:
        return math.inf if above <= 0.0 else -math.inf if above >= 1.0 else math.nan
    sign, number, goal = (1.0, 1, above) if above <= 0.5 else (-1.0, 0, 1.0 - above)
    known, goal, last = u, math.log(goal), math.inf
    for _ in range(STEPS):
        shares = split(u)
        if not shares[number] > 0.0:  # beyond the smallest number
            u = 0.5 * (u + known)
            continue
        step = (math.log(shares[number]) - goal) * shares[number] / shares[2]
        known, u = u, u + sign * min(max(step, -1.0), 1.0)
        if abs(step) < 1e-14 or u == known or 0.1 * last < abs(step) < 1e-8:
            break
        last = abs(step)
    return u


def _find_f_quantile(degrees: float, left: float, above: float, near: float = 1.0) -> float:
    """Return the value of F that is exceeded with a probability; near : a guess of it."""
    a, b = 0.5 * degrees, 0.5 * left

    def split(u: float) -> Shares:
        return _split_beta(a, b, 1.0 / (1.0 + math.exp(-u)), 1.0 / (1.0 + math.exp(u)))

    return left / degrees * math.exp(_find_quantile(split, math.log(near * a / b), above))


def _find_chi_square_quantile(degrees: float, above: float) -> float:
    """Return the chi-square that is exceeded with a probability."""
    a = 0.5 * degrees
    return 2.0 * math.exp(
        _find_quantile(lambda u: _split_gamma(a, math.exp(u)), math.log(a), above)
    )


@lru_cache(maxsize=4096)
def _find_normal_quantile(probability: float) -> float:
    """Return the standard normal value that is not exceeded with a probability."""
    outside = 2.0 * min(probability, 1.0 - probability)
    size = 0.0 if outside == 1.0 else math.sqrt(_find_chi_square_quantile(1.0, outside))
    return math.copysign(size, probability - 0.5)


@lru_cache(maxsize=4096)  # parameters have intervals of one level in several tables
def _find_student_quantile(degrees: float, probability: float) -> float:
    """Return the t that is not exceeded with a probability; its square has an F distribution."""
    outside, z = 2.0 * min(probability, 1.0 - probability), _find_normal_quantile(probability)
    if not 0.0 < outside < 1.0:
        return z
    near = z * z * (1.0 + (z * z + 1.0) / (2.0 * degrees))  # the first term of Cornish and Fisher
    size = math.sqrt(_find_f_quantile(1.0, degrees, outside, near))
    return math.copysign(size, probability - 0.5)


def _compute_student_probability(degrees: float, t: float) -> float:
    """Return the probability of at most t."""
    if math.isinf(degrees):
        return 0.5 * math.erfc(-t / math.sqrt(2.0))
    outside = 0.5 * _split_f(1.0, degrees, t * t)[1]
    return 1.0 - outside if t > 0.0 else outside


def _distribution(name: str, compute: Callable[..., float]) -> Callable[..., FloatArray]:
    """Return a function of arrays that broadcast; `name` is that of `scipy.special`."""

    def evaluate(*arguments: ArrayLike) -> FloatArray:
        arrays = np.broadcast_arrays(*arguments)
        is_long = any(((array > MANY) & (array < np.inf)).any() for array in arrays[:-1])
        if arrays[0].size > FEW or is_long:
            return np.asarray(getattr(import_module("scipy.special"), name)(*arrays))
        rows = list(zip(*(array.ravel().tolist() for array in arrays), strict=True))
        known = {row: compute(*map(float, row)) for row in dict.fromkeys(rows)}
        return np.array([known[row] for row in rows], dtype=np.float64).reshape(arrays[0].shape)

    return evaluate


normal_probability = _distribution("ndtr", lambda x: 0.5 * math.erfc(-x / math.sqrt(2.0)))
"""Probability of at most x."""

normal_quantile = _distribution("ndtri", _find_normal_quantile)
"""Value that is not exceeded with a probability."""

chi_square_tail = _distribution("chdtrc", lambda k, x: _split_gamma(0.5 * k, 0.5 * x)[1])
"""Probability of more than x with k degrees of freedom."""

chi_square_quantile = _distribution("chdtri", _find_chi_square_quantile)
"""Value that k degrees of freedom exceed with a probability."""

f_tail = _distribution("fdtrc", lambda k, left, x: _split_f(k, left, x)[1])
"""Probability of more than x with k and `left` degrees of freedom."""

f_quantile = _distribution("fdtri", lambda k, left, p: _find_f_quantile(k, left, 1.0 - p))
"""Value that is not exceeded with a probability."""

student_probability = _distribution("stdtr", _compute_student_probability)
"""Probability of at most t with some degrees of freedom."""

student_quantile = _distribution("stdtrit", _find_student_quantile)
"""Value of t that is not exceeded with a probability."""

beta_probability = _distribution("betainc", lambda a, b, x: _split_beta(a, b, x, 1.0 - x)[0])
"""Probability of at most x."""

binomial_tail = _distribution(
    "bdtrc",
    lambda k, n, p: _split_beta(k + 1.0, n - k, p, 1.0 - p)[0] if 0 <= k < n else float(k < 0),
)
"""Probability of more than k of n trials."""
