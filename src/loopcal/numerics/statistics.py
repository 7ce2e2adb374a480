# SPDX-License-Identifier: Apache-2.0
"""Probabilities and quantiles of the normal, chi-square, F, t and beta distributions; tests by
these, and variance components.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.numerics.split_columns import SplitColumns


NODES = 101  # values of the true noise of each source over which a probability is averaged
Distribution = Callable[..., FloatArray]


def _distribution(name: str) -> Distribution:
    """Return a function of `scipy.special`, whose arguments broadcast. It is imported when one is
    called: its import takes twice as long as that of numpy, and `import loopcal` does not pay for
    it.
    """

    def evaluate(*arguments: ArrayLike) -> FloatArray:
        return np.asarray(getattr(import_module("scipy.special"), name)(*arguments), dtype=float)

    return evaluate


# of at most x
normal_probability: Distribution = _distribution("ndtr")
# value that is not exceeded with a probability
normal_quantile: Distribution = _distribution("ndtri")
# probability of more than x with k degrees of freedom
chi_square_tail: Distribution = _distribution("chdtrc")
# value that chi-square of k degrees of freedom exceeds with a probability
compute_chi_square_quantile: Distribution = _distribution("chdtri")
# probability of more than x with k and `left` degrees of freedom
f_tail: Distribution = _distribution("fdtrc")
# value that is not exceeded with a probability
f_quantile: Distribution = _distribution("fdtri")
# of at most t with some degrees of freedom
student_probability: Distribution = _distribution("stdtr")
# value of t that is not exceeded with a probability
student_quantile: Distribution = _distribution("stdtrit")
# of at most x, of the parameters a and b
beta_probability: Distribution = _distribution("betainc")
# probability of more than k of n trials
binomial_tail: Distribution = _distribution("bdtrc")


def compute_chi_square_tail(degrees: ArrayLike, statistic: ArrayLike) -> FloatArray:
    """Return the probability that chi-square exceeds a statistic; 1 without a degree of freedom.

    degrees : degrees of freedom. statistic : sum of squares [1]. Both broadcast.
    """
    degrees = np.asarray(degrees, dtype=float)
    tail = chi_square_tail(np.where(degrees > 0.0, degrees, 1.0), statistic)
    return np.where(degrees > 0.0, tail, 1.0)


def compute_f_tail(degrees: ArrayLike, left: ArrayLike, statistic: ArrayLike) -> FloatArray:
    """Return the probability that F exceeds a statistic; NaN without degrees of freedom left.

    F is a chi-square per degree of freedom, where the noise is estimated from residuals of `left`
    degrees of freedom; infinite for known noise. Without `degrees` the probability is 1.
    """
    degrees, left = np.asarray(degrees, dtype=float), np.asarray(left, dtype=float)
    tested = np.where(degrees > 0.0, degrees, 1.0)
    is_estimated = (left > 0.0) & np.isfinite(left)
    tail = f_tail(tested, np.where(is_estimated, left, 1.0), statistic)
    if not is_estimated.all():
        known = compute_chi_square_tail(tested, tested * np.asarray(statistic, dtype=float))
        tail = np.where(is_estimated, tail, known)
    return np.where(left > 0.0, np.where(degrees > 0.0, tail, 1.0), np.nan)


def compute_f_quantile(degrees: ArrayLike, left: ArrayLike, probability: ArrayLike) -> FloatArray:
    """Return the statistic that F exceeds with a probability; `left` are the degrees of freedom of
    the estimated noise, infinite for a known one: chi-square over `degrees`.
    """
    left = np.asarray(left, dtype=float)
    is_known = np.isinf(left)
    known = compute_chi_square_quantile(degrees, probability) / np.asarray(degrees)
    estimated = f_quantile(degrees, np.where(is_known, 1.0, left), 1.0 - np.asarray(probability))
    return np.where(is_known, known, estimated)


def compute_averaged_tail(
    chi_square: float, degrees: float, sources: Sequence[tuple[float, float]]
) -> float:
    """Return the probability of a larger chi-square where noise was estimated: the mean over the
    true noise, given the estimated one (Behrens and Fisher; with one source the F distribution).

    The true variance of a source is nu / chi-square(nu) times the estimated one.

    sources : the part of each source in the degrees of freedom of the chi-square, and the degrees
        of freedom nu of its variance.
    """
    total = sum(part for part, _ in sources)
    probability = (np.arange(NODES) + 0.5) / NODES
    true = np.zeros(1)
    for part, nu in sources:
        times = np.ones(1) if np.isinf(nu) else nu / compute_chi_square_quantile(nu, probability)
        true = (true[:, None] + part / total * times).ravel()
    return float(compute_chi_square_tail(degrees, chi_square / true).mean())


# Levels and probabilities where several tests are made at once.

NEAR_ONE = 1.0 - 1e-16  # largest probability of a test whose complement a double still has


def compute_any_probability(p_value: float, tests: int) -> float:
    """Return the probability 1 - (1 - p)^n that any of n tests is as significant; p without any."""
    return float(-np.expm1(max(tests, 1) * np.log1p(-min(p_value, NEAR_ONE))))


def compute_single_level(level: float, tests: int) -> float:
    """Return the level 1 - (1 - a)^(1 / n) of each of n tests, of which any finds something with
    the probability a; a itself without any test.
    """
    return float(-np.expm1(np.log1p(-min(level, NEAR_ONE)) / max(tests, 1)))


# A variance component of a vector whose elements else have equal, unknown variance.

STEPS, NEWTON = 400, 100
"""Values of tau that are compared, and most steps to the saddlepoint."""

# Largest logarithm of 1 - 2 t, t the saddlepoint of a quantile for a largest weight of 1.
SLACK = 40.0
MOST_KNOWN = 1e6  # degrees of freedom of a sigma that is exact
UNSEEN = 1e-6  # share of the variance by errors below which nothing of them is left
# Sizes of errors, in sigma, that are as probable as each other before the data.
EVIDENT = (0.1, 30.0)

SMALLEST, LARGEST = 1e-3, 1e4
"""Ends of the values of tau: the strongest element gains this share of sigma, and this many."""


class VarianceComponent(NamedTuple):
    """The estimate of a variance component.

    variance : mean of sigma^2 tau^2. degrees : its degrees of freedom.
    ratio : of variances, tau^2 at which the likelihood is largest. gain : of the logarithm of this
        likelihood over that without the component.
    evidence : logarithm of the likelihood over that without the component, averaged over the
        logarithm of `EVIDENT` tau; for errors that alone have unit variance. noise : sigma^2 at
        `ratio`.
    """

    variance: float
    degrees: float
    ratio: float
    gain: float
    evidence: float
    noise: float


def compute_component_tail(
    weights: FloatArray, y: FloatArray, rest: tuple[float, float] = (0.0, 0.0)
) -> float:
    """Return the probability of a larger Q without the component; 1 where there is no test.

    weights, y : (k,) elements. rest : sum of squares and number of elements of weight 0; those of a
        stated sigma of `known` degrees of freedom are `known` and `known`.
    """
    total, largest = float((y**2).sum()) + rest[0], float(weights.max(initial=0.0))
    if not (total > 0.0 and largest > 0.0):
        return 1.0
    mean = float(weights @ y**2) / (largest * total)
    count = min(rest[1], MOST_KNOWN)
    return _tail(np.r_[weights / largest - mean, -mean], np.r_[np.ones(len(weights)), count])


def estimate_variance_component(
    weights: FloatArray,
    y: FloatArray,
    known: float = 0.0,
    rest: tuple[float, float] = (0.0, 0.0),
    typical: float = np.inf,
) -> VarianceComponent:
    """Return the size of a component; arguments as of `compute_component_tail`.

    `known` degrees of freedom say that sigma is 1; infinite ones, that it is exactly 1. `rest` :
    sum of squares and number of elements of weight 0. `typical` : the square of the scale of a
    half-Cauchy prior of sigma tau. Without one, few elements bound no mean of the variance.
    """
    largest = float(weights.max())
    tau = np.geomspace(SMALLEST, LARGEST, STEPS) / np.sqrt(largest)
    ratio = tau**2
    scale = 1.0 + ratio[:, None] * weights
    square, count = (y**2 / scale).sum(axis=1) + rest[0], len(y) + rest[1] + known
    if np.isinf(known):
        by_size, variance = -0.5 * square, np.ones(STEPS)
    else:
        by_size, variance = -0.5 * count * np.log(square + known), (square + known) / count
    density = by_size - 0.5 * np.log(scale).sum(axis=1)
    inside = density[(tau > EVIDENT[0]) & (tau < EVIDENT[1])] - density[0]
    top = float(inside.max(initial=-np.inf))
    evidence = top + float(np.log(np.exp(inside - top).mean())) if len(inside) else np.nan
    values = ratio * variance
    probable = density - np.log1p(values / typical)
    share = np.exp(probable - probable.max()) * np.gradient(tau)
    share /= share.sum()
    mean = float(share @ values)
    # sigma^2 at each tau has a relative variance of its own
    own = 2.0 / max(count - 4.0, 1.0)
    spread = float(share @ ((values - mean) ** 2 + own * values**2))
    degrees = max(2.0 * mean**2 / spread, 1.0)
    # the first tau is as good as none
    gain = float(density.max() - density[0])
    best, numbers = int(np.argmax(density)), (gain, evidence)
    return VarianceComponent(mean, degrees, float(ratio[best]), *numbers, float(variance[best]))


class Spectrum(NamedTuple):
    """A component of the variance of residuals along its principal axes."""

    columns: FloatArray  # (R, c) of the errors
    vectors: FloatArray  # (c, k) axes of unit length are what is left of the columns times these
    weights: FloatArray  # (k,) variances of the elements by errors of unit variance
    y: FloatArray  # (k,) elements of the residuals
    rest: tuple[float, float]  # sum of squares and number of all other elements

    def compute_tail(self, known: float = 0.0) -> float:
        """Return the probability of such elements without the component, by sigmas that are stated
        with so many `known` degrees of freedom.
        """
        rest = (self.rest[0] + min(known, MOST_KNOWN), self.rest[1] + known)
        return compute_component_tail(self.weights, self.y, rest)

    def estimate(self, known: float = 0.0) -> VarianceComponent:
        """Return the size of the component."""
        return estimate_variance_component(self.weights, self.y, known, self.rest)


class Remainder(NamedTuple):
    """Residuals M r under the covariance 1 + sum of K_h of components that were found, with the
    quadratic form v' (1 - P P') v of their inverse on what nothing estimated explains.
    """

    taken: SplitColumns  # (R, e) P: the basis of what is estimated, and parts of components
    residual: FloatArray  # (R,)
    degrees: float

    def weigh(self, columns: FloatArray) -> FloatArray:
        """Return (1 - P P') columns (R, c)."""
        return self.taken.remove(columns)

    def find_spectrum(self, columns: FloatArray) -> Spectrum:
        """Return the part of the residuals that independent errors of equal variance with these
        columns (R, c) change.
        """
        changed = np.flatnonzero(columns.any(axis=1))
        own = columns[changed]
        known, weighed = self.taken.take(changed).products(own), self.weigh(self.residual)
        w, vectors = np.linalg.eigh(own.T @ own - known.T @ known)
        kept = w > UNSEEN * float((own**2).sum(axis=0).max(initial=0.0))
        vectors = vectors[:, kept] / np.sqrt(w[kept])
        y, square = (weighed[changed] @ own) @ vectors, float(self.residual @ weighed)
        rest = (max(square - float(y @ y), 0.0), max(self.degrees - len(y), 0.0))
        return Spectrum(columns, vectors, w[kept], y, rest)

    def add(self, spectrum: Spectrum, ratio: float) -> Remainder:
        """Return the remainder with a component of this ratio of variances; an infinite one takes
        all that its errors change.
        """
        w, is_open = spectrum.weights, np.isinf(ratio)
        share = np.ones(len(w)) if is_open else np.sqrt(ratio * w / (1.0 + ratio * w))
        axes = self.weigh(spectrum.columns) @ (spectrum.vectors * share)
        taken = self.taken.append(axes)
        return self._replace(taken=taken, degrees=self.degrees - (len(w) if is_open else 0))


def _tail(values: FloatArray, counts: FloatArray) -> float:
    """Return P(sum of values_i times chi-square of counts_i degrees > 0)."""
    values, counts = values[counts > 0.0], counts[counts > 0.0]
    if not (values.max() > 0.0 > values.min()):
        return 1.0 if values.min() >= 0.0 else 0.0
    low, high = 0.5 / values.min(), 0.5 / values.max()

    t = 0.0
    for _ in range(NEWTON):  # K' grows: Newton's method between the ends, else bisection
        tilted = values / (1.0 - 2.0 * t * values)
        slope, curvature = float(counts @ tilted), 2.0 * float(counts @ tilted**2)
        low, high = (t, high) if slope < 0.0 else (low, t)
        before, t = t, t - slope / curvature
        if not low < t < high:
            t = 0.5 * (low + high)
        if abs(t - before) <= 1e-15 * abs(before):
            break
    return _tail_beyond_slope(values, counts, t)


def _tail_beyond_slope(values: FloatArray, counts: FloatArray, t: float) -> float:
    """Return P(sum of values_i times chi-square of counts_i degrees > x) from its saddlepoint t:

    K(t) = -1/2 sum counts log(1 - 2 t values), K'(t) = x, w = sign(t) sqrt(2 (t x - K(t))),
    v = t sqrt(K''(t)), tail = 1 - Phi(w + log(v / w) / w).
    """
    tilted = values / (1.0 - 2.0 * t * values)
    K = -0.5 * float((counts * np.log1p(-2.0 * t * values)).sum())
    curvature = 2.0 * float((counts * tilted**2).sum())
    x = float((counts * tilted).sum())
    w, v = np.sign(t) * np.sqrt(max(2.0 * (t * x - K), 0.0)), t * np.sqrt(curvature)
    if abs(w) < 1e-4:  # the limit at the mean
        third = 8.0 * float((counts * tilted**3).sum())
        return float(0.5 - third / (6.0 * np.sqrt(2.0 * np.pi) * curvature**1.5))
    return float(normal_probability(-(w + np.log(v / w) / w)))


def compute_weighted_quantile(weights: FloatArray, share: float) -> float:
    """Return what a share of the sums of weights (k,) times squares of standard normal variables
    does not exceed. For shares from 0.7 to 0.99 it is within 2 %, of three equal weights within
    0.3 %.
    """
    largest = float(weights.max(initial=0.0))
    if not largest > 0.0:
        return 0.0
    values, counts = weights / largest, np.ones(len(weights))

    def below(log_slack: float) -> float:  # of 1 - 2 t, from which the sum falls
        return 1.0 - _tail_beyond_slope(values, counts, 0.5 - 0.5 * np.exp(-log_slack))

    low, high = -SLACK, SLACK
    for _ in range(NEWTON // 2):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if below(middle) < share else (low, middle)
    return largest * float((values / (1.0 - values * (1.0 - np.exp(-high)))).sum())


def invert_increasing(
    function: Callable[[float], float], value: float, highest: float, bisections: int
) -> float:
    """Return where an increasing function has a value, by bisection from 0 to `highest`."""
    low, high = 0.0, highest
    for _ in range(bisections):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < value else (low, middle)
    return high


# Distinct values and medians without masked arrays.


def find_distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Return the distinct values of an array, of any shape and type, in ascending order.

    They are those of `np.unique`. With `return_counts`, it does not ask whether the array is masked
    (numpy 2.4).
    """
    return np.unique(values, return_counts=True)[0]


def find_distinct_rows(rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return the distinct rows (k, c) of whole numbers (r, c) in ascending order, and which of them
    each row is (r,).

    Rows are sorted by a sum of their numbers with odd weights, modulo 2^64, and by NumPy, in ten
    times the time, where rows with the same sum differ.
    """
    weights = np.uint64(0x9E3779B97F4A7C15) ** np.arange(1, rows.shape[1] + 1, dtype=np.uint64)
    _, first, member = np.unique(
        rows.astype(np.uint64) @ weights, return_index=True, return_inverse=True
    )
    if (rows[first][member] != rows).any():
        first, member = np.arange(len(rows)), np.arange(len(rows))
    distinct, order = np.unique(rows[first], axis=0, return_inverse=True)
    return distinct, order.ravel()[member]


def choose_evenly(count: int, most: int) -> IntArray:
    """Return at most so many of the numbers below `count`, evenly chosen."""
    return find_distinct(np.linspace(0, count - 1, min(most, count)).astype(np.int64))


def compute_median(values: FloatArray) -> float:
    """Return the median of at least one number: NaN if one is NaN, as `np.median`.

    values : any shape.
    """
    ordered = np.sort(values, axis=None)  # NaN come last
    if np.isnan(ordered[-1]):
        return float("nan")
    return float(np.mean(ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1]))


def compute_known_median(values: FloatArray, axis: int) -> FloatArray:
    """Return medians along an axis of what is not NaN, as `np.nanmedian`; NaN without any."""
    ordered = np.sort(values, axis=axis)  # NaN come last
    count = (~np.isnan(ordered)).sum(axis=axis, keepdims=True)
    middle = np.concatenate([np.maximum(count - 1, 0) // 2, count // 2], axis=axis)
    return np.take_along_axis(ordered, middle, axis=axis).mean(axis=axis)
