# SPDX-License-Identifier: Apache-2.0
"""Normal, chi-square, F, t, beta and binomial distributions, by the names of `scipy.special`.

`import scipy.special` takes twice as long as `import numpy`, a fifth of a calibration on the
command line, because it imports numpy.f2py and numpy.testing. These few functions are the ones that
every fit needs. Incomplete gamma and beta functions are the series and continued fractions of
Abramowitz and Stegun, 6.5.29, 6.5.31 and 26.5.8, by the method of Lentz; their leading
factors are computed without cancellation (C. Loader, Fast and accurate computation of binomial
probabilities, 2000), so that results keep 12 digits for millions of degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from loopcal.typing import BoolArray, FloatArray

SMALLEST_CHANGE, CHECKED = 4e-16, 4
"""Relative change at which a series or fraction has ended, which every so many terms tell."""

TOGETHER = 4096
"""Terms of all arguments that are summed at once."""

LONGEST = 1_000_000
"""Terms, at most: their number grows with the root of the degrees of freedom."""

STEPS, LAST = 100, 1e-9
"""Steps to a quantile, at most, and the length of the last one, after which the error is rounding:
each step squares it."""

LARGEST = 700.0
"""Ends of logarithms between which quantiles are sought."""

_lgamma = np.frompyfunc(math.lgamma, 1, 1)
_erfc = np.frompyfunc(math.erfc, 1, 1)


def ndtr(x: ArrayLike) -> FloatArray:
    """Return the probability that a standard normal variable is at most x."""
    scaled = np.asarray(x, dtype=np.float64) * -math.sqrt(0.5)
    return 0.5 * np.asarray(_erfc(scaled), dtype=np.float64)[()]


def ndtri(p: ArrayLike) -> FloatArray:
    """Return the quantile of the standard normal distribution."""
    p = np.asarray(p, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.minimum(p, 1.0 - p)
        t = np.sqrt(-2.0 * np.log(least))
        # Abramowitz and Stegun 26.2.23, then Newton's method on the logarithm of the tail
        z = t - (2.515517 + t * (0.802853 + t * 0.010328)) / (
            1.0 + t * (1.432788 + t * (0.189269 + t * 0.001308))
        )
        for _ in range(4):
            tail = ndtr(-z)
            hazard = np.exp(-0.5 * z**2) / (math.sqrt(2.0 * math.pi) * tail)
            z = np.where(np.isinf(t), z, z + np.log(tail / least) / hazard)
        z = np.where(np.isinf(t), np.inf, np.where(least == 0.5, 0.0, z))
    return np.where(p < 0.5, -z, z)[()]


def chdtrc(degrees: ArrayLike, x: ArrayLike) -> FloatArray:
    """Return the probability that chi-square is larger than x."""
    x = np.asarray(x, dtype=np.float64)
    return _gamma(0.5 * np.asarray(degrees, dtype=np.float64), 0.5 * np.maximum(x, 0.0))[1]


def chdtri(degrees: ArrayLike, p: ArrayLike) -> FloatArray:
    """Return the value that chi-square exceeds with probability p."""

    def seek(degrees: FloatArray, p: FloatArray) -> FloatArray:
        a = 0.5 * degrees

        def tails(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            x = np.exp(u)
            return *_gamma(a, x), a * _gamma_factor(a, x)

        # the approximation of Wilson and Hilferty
        root = 1.0 - 1.0 / (9.0 * a) - ndtri(p) / (3.0 * np.sqrt(a))
        start = np.log(a) + 3.0 * np.log(np.where(root > 0.1, root, 0.1))
        return 2.0 * np.exp(_invert(tails, p, start, is_upper=True))

    return _each(seek, (degrees, p), (0.0, np.inf), (1.0, 0.0))


def betainc(a: ArrayLike, b: ArrayLike, x: ArrayLike) -> FloatArray:
    """Return the regularized incomplete beta function I_x(a, b)."""
    x = np.asarray(x, dtype=np.float64)
    return _beta(a, b, x, 1.0 - x)[0]


def betaincinv(a: ArrayLike, b: ArrayLike, p: ArrayLike) -> FloatArray:
    """Return x with I_x(a, b) = p."""
    return _each(lambda *given: _divide(_beta_odds(*given)), (a, b, p), (0.0, 0.0), (1.0, 1.0))


def fdtrc(first: ArrayLike, second: ArrayLike, x: ArrayLike) -> FloatArray:
    """Return the probability that F of these degrees of freedom is larger than x."""
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    product = first * np.maximum(np.asarray(x, dtype=np.float64), 0.0)
    with np.errstate(invalid="ignore"):
        share = np.where(np.isinf(product), 1.0, product / (second + product))
    return _beta(0.5 * second, 0.5 * first, second / (second + product), share)[0]


def fdtri(first: ArrayLike, second: ArrayLike, p: ArrayLike) -> FloatArray:
    """Return the value that F of these degrees of freedom does not exceed with probability p."""

    def seek(first: FloatArray, second: FloatArray, p: FloatArray) -> FloatArray:
        return second / first * np.exp(_beta_odds(0.5 * first, 0.5 * second, p))

    return _each(seek, (first, second, p), (0.0, 0.0), (1.0, np.inf))


def stdtr(degrees: ArrayLike, t: ArrayLike) -> FloatArray:
    """Return the probability that Student's t is at most t."""
    t = np.asarray(t, dtype=np.float64)
    half = 0.5 * fdtrc(1.0, degrees, t**2)
    return np.where(t > 0.0, 1.0 - half, half)[()]


def stdtrit(degrees: ArrayLike, p: ArrayLike) -> FloatArray:
    """Return the quantile of Student's t; the normal one for infinite degrees of freedom."""

    def seek(degrees: FloatArray, p: FloatArray) -> FloatArray:
        is_normal = np.isinf(degrees)
        finite = np.where(is_normal, 1.0, degrees)
        least = np.where(p == 0.5, 0.25, np.minimum(p, 1.0 - p))
        odds = _beta_odds(0.5 * finite, np.full(p.shape, 0.5), 2.0 * least)
        size = np.where(p == 0.5, 0.0, np.sqrt(finite) * np.exp(-0.5 * odds))
        return np.where(is_normal, ndtri(p), np.where(p < 0.5, -size, size))

    return _each(seek, (degrees, p), (0.0, -np.inf), (1.0, np.inf))


def bdtr(k: ArrayLike, n: ArrayLike, p: ArrayLike) -> FloatArray:
    """Return the probability of at most k successes in n trials of probability p."""
    return _binomial(k, n, p)[1]


def bdtrc(k: ArrayLike, n: ArrayLike, p: ArrayLike) -> FloatArray:
    """Return the probability of more than k successes in n trials of probability p."""
    return _binomial(k, n, p)[0]


def _binomial(k: ArrayLike, n: ArrayLike, p: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the probabilities of more than k successes, and of at most k."""
    k, n = np.floor(np.asarray(k, dtype=np.float64)), np.asarray(n, dtype=np.float64)
    p = np.asarray(p, dtype=np.float64)
    inside = (k >= 0.0) & (k < n)
    more, most = _beta(np.where(inside, k + 1.0, 1.0), np.where(inside, n - k, 1.0), p, 1.0 - p)
    return np.where(inside, more, k < 0.0)[()], np.where(inside, most, k >= 0.0)[()]


def _each(
    seek: Callable[..., FloatArray],
    arguments: tuple[ArrayLike, ...],
    low: tuple[float, float],
    high: tuple[float, float],
) -> FloatArray:
    """Return quantiles of distinct arguments, the last of which is a probability.

    `low` and `high` are pairs: of a probability at an end of the support, and the quantile there.
    """
    arrays = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in arguments))
    distinct, place = np.unique(
        np.stack([a.ravel() for a in arrays], axis=1), axis=0, return_inverse=True
    )
    p = distinct[:, -1]
    usable = (distinct[:, :-1] > 0.0).all(axis=1) & (p > 0.0) & (p < 1.0)
    result = np.full(len(distinct), np.nan)
    for probability, value in (low, high):
        result[(distinct[:, :-1] > 0.0).all(axis=1) & (p == probability)] = value
    if usable.any():
        result[usable] = seek(*distinct[usable].T)
    return result[place.ravel()].reshape(arrays[0].shape)[()]


def _beta_odds(a: FloatArray, b: FloatArray, p: FloatArray) -> FloatArray:
    """Return log(x / (1 - x)) of x with I_x(a, b) = p."""

    def tails(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        x, y = _divide(u), _divide(-u)
        return *_beta(a, b, x, y), a * b / (a + b) * _beta_factor(a, b, x, y)

    spread = np.sqrt(1.0 / a + 1.0 / b)
    return _invert(tails, p, np.log(a / b) + spread * ndtri(p), is_upper=False)


def _divide(u: FloatArray) -> FloatArray:
    """Return x with log(x / (1 - x)) = u."""
    return 1.0 / (1.0 + np.exp(-u))


def _invert(
    tails: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]],
    p: FloatArray,
    start: FloatArray,
    is_upper: bool,
) -> FloatArray:
    """Return u at which the upper or lower tail is p, by Newton's method on the logarithm of the
    smaller tail, with bisection.

    `tails` returns both tails, the lower one first, and the density of u.
    """
    seeks_upper = (p <= 0.5) == is_upper
    target = np.minimum(p, 1.0 - p)
    low, high = np.full(p.shape, -LARGEST), np.full(p.shape, LARGEST)
    u = np.clip(start, -LARGEST, LARGEST)
    for _ in range(STEPS):
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            lower, upper, density = tails(u)
        tail = np.where(seeks_upper, upper, lower)
        is_low = np.where(seeks_upper, tail > target, tail < target)
        low, high = np.where(is_low, u, low), np.where(is_low, high, u)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = np.log(tail / target) * tail / density
            new = u + np.where(seeks_upper, step, -step)
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        change, u = np.abs(new - u), new
        if (change <= LAST * (1.0 + np.abs(u))).all():
            break
    return u


def _gamma(a: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the regularized incomplete gamma functions P(a, x) and Q(a, x)."""
    a, x = np.broadcast_arrays(a, x)
    usable = (a > 0.0) & (x > 0.0) & np.isfinite(x) & np.isfinite(a)
    b, y = np.where(usable, a, 1.0), np.where(usable, x, 1.0)
    # up to three standard deviations the upper part is large enough to be a difference from one
    factor, is_low = _gamma_factor(b, y), y < b + 1.0 + 3.0 * np.sqrt(b)
    total = np.ones(b.shape)
    if is_low.any():
        total = _sum_series(np.where(is_low, y, 0.0), b)
    if not is_low.all():
        fraction = _gamma_fraction(b, np.where(is_low, 10.0 * (b + 1.0), y))
        total = np.where(is_low, total, b / fraction)
    part = np.clip(factor * total, 0.0, 1.0)
    P, Q = np.where(is_low, part, 1.0 - part), np.where(is_low, 1.0 - part, part)
    is_number = (a > 0.0) & ~np.isnan(x)
    ends = np.where(is_number, np.where(x > 0.0, 1.0, 0.0), np.nan)
    return np.where(usable, P, ends)[()], np.where(usable, Q, 1.0 - ends)[()]


def _sum_series(x: FloatArray, a: FloatArray) -> FloatArray:
    """Return 1 + x / (a + 1) + x^2 / ((a + 1) (a + 2)) + ..."""
    term, total = np.ones(x.shape), np.ones(x.shape)
    count = max(1, TOGETHER // max(x.size, 32))
    for first in range(1, LONGEST, count):
        n = np.arange(first, first + count)
        terms = term[..., None] * np.cumprod(x[..., None] / (a[..., None] + n), axis=-1)
        total, term = total + terms.sum(axis=-1), terms[..., -1]
        if (term <= SMALLEST_CHANGE * total).all():
            break
    return total


def _gamma_fraction(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return x + 1 - a - 1 (1 - a) / (x + 3 - a - 2 (2 - a) / (x + 5 - a - ...)), for x > a + 1."""
    b = x + 1.0 - a
    return _evaluate_fraction(b, lambda n: (n * (a - n), b + 2.0 * n), x.shape)


def _beta(a: ArrayLike, b: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return I_x(a, b) and 1 - I_x(a, b), for y = 1 - x."""
    a, b, x, y = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (a, b, x, y)))
    usable = (a > 0.0) & (b > 0.0) & (x > 0.0) & (y > 0.0)
    usable = usable & np.isfinite(a) & np.isfinite(b)
    is_low = x * (a + b + 2.0) < a + 1.0
    first, second = np.where(is_low, a, b), np.where(is_low, b, a)
    near, far = np.where(is_low, x, y), np.where(is_low, y, x)
    first, second = np.where(usable, first, 1.0), np.where(usable, second, 1.0)
    near, far = np.where(usable, near, 0.25), np.where(usable, far, 0.75)
    share = second / (first + second)
    fraction = _beta_fraction(first, second, near)
    part = np.clip(_beta_factor(first, second, near, far) * share / fraction, 0.0, 1.0)
    is_number = (a > 0.0) & (b > 0.0) & ~np.isnan(x)
    ends = np.where(is_number, np.where(x > 0.0, 1.0, 0.0), np.nan)
    lower, upper = np.where(is_low, part, 1.0 - part), np.where(is_low, 1.0 - part, part)
    return np.where(usable, lower, ends)[()], np.where(usable, upper, 1.0 - ends)[()]


def _beta_fraction(a: FloatArray, b: FloatArray, x: FloatArray) -> FloatArray:
    """Return the continued fraction 1 + d_1 x / (1 + d_2 x / (1 + ...)) of I_x(a, b)."""

    def term(n: int) -> tuple[FloatArray, FloatArray]:
        m, is_odd = divmod(n, 2)
        if is_odd:
            d = -(a + m) * (a + b + m) / ((a + 2 * m) * (a + 2 * m + 1))
        else:
            d = m * (b - m) / ((a + 2 * m - 1) * (a + 2 * m))
        return d * x, np.ones(x.shape)

    return _evaluate_fraction(np.ones(x.shape), term, x.shape)


def _evaluate_fraction(
    first: FloatArray, term: Callable[[int], tuple[FloatArray, FloatArray]], shape: tuple[int, ...]
) -> FloatArray:
    """Return b_0 + a_1 / (b_1 + a_2 / (b_2 + ...)) by the method of Lentz.

    `term` returns a_n and b_n. No denominator is zero where this is used.
    """
    value = first
    C, D = value, np.zeros(shape)
    for n in range(1, LONGEST):
        a, b = term(n)
        D, C = 1.0 / (b + a * D), b + a / C
        change = C * D
        value = value * change
        if n % CHECKED == 0 and (np.abs(change - 1.0) <= SMALLEST_CHANGE).all():
            break
    return value


def _gamma_factor(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return x^a e^-x / Gamma(a + 1)."""
    return np.exp(-_stirling_error(a) - _deviance(a, x)) / np.sqrt(2.0 * math.pi * a)


def _beta_factor(a: FloatArray, b: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return x^a y^b Gamma(a + b + 1) / (Gamma(a + 1) Gamma(b + 1)), for y = 1 - x."""
    n = a + b
    rest = _stirling_error(n) - _stirling_error(a) - _stirling_error(b)
    return np.exp(rest - _deviance(a, n * x) - _deviance(b, n * y)) * np.sqrt(
        n / (2.0 * math.pi * a * b)
    )


def _stirling_error(a: FloatArray) -> FloatArray:
    """Return log Gamma(a + 1) - (a + 1/2) log a + a - log(2 pi) / 2, for a > 0."""
    is_large = a > 15.0
    small, square = np.where(is_large, 1.0, a), np.where(is_large, a, 15.0) ** -2
    exact = np.asarray(_lgamma(small + 1.0), dtype=np.float64) + small
    exact = exact - (small + 0.5) * np.log(small) - 0.5 * math.log(2.0 * math.pi)
    series = 1 / 1188
    for coefficient in (-1 / 1680, 1 / 1260, -1 / 360, 1 / 12):
        series = coefficient + square * series
    return np.where(is_large, series * np.sqrt(square), exact)


def _deviance(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return a log(a / x) + x - a without cancellation, for a, x > 0."""
    d = x - a
    is_near: BoolArray = np.asarray(np.abs(d) < 0.1 * (x + a))
    v = np.where(is_near, d / (x + a), 0.0)
    # with a = (x + a) (1 - v) / 2 and log(a / x) = -2 (v + v^3 / 3 + v^5 / 5 + ...)
    odd = sum(v ** (2 * j) / (2 * j + 1) for j in range(1, 9))
    near = d * v - 2.0 * a * v * odd
    with np.errstate(over="ignore", divide="ignore"):
        far = a * np.log(np.where(is_near, 1.0, a / x)) + d
    return np.where(is_near, near, far)
