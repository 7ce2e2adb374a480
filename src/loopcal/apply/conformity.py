# SPDX-License-Identifier: Apache-2.0
"""Conformity with a limit: the probability that a true error keeps it, and a decision rule.

What was measured is the true error and the noise of the measurement. A decision from the measured
value alone accepts errors above the limit, or rejects errors below it, with an unknown risk. The
conformance probability is the one that the true error keeps the limit, given the measurement and
its noise (JCGM 106:2012, section 7). The decision rule is that of ISO 14253-1: conformity needs at
least this probability, 95 % by default, and so does nonconformity. In between the measurement
decides nothing. In terms of the estimate, both are guarded: the acceptance limit is the limit less
a guard band, and the rejection limit is the limit plus another one (JCGM 106, section 8).

For the largest of e errors: the true error i is normal with variance v_i = tau^2 / u_i, and the
measured one adds noise of covariance S_i, the stated one times s^2. Neither tau, the u_i (over 4,
chi-square of 4 degrees of freedom: some errors are larger than others) nor s is known. Given these,

    V = (S_i^-1 + I / v_i)^-1    and mean    V S_i^-1 d_i

describe the true error i, and the largest is below L with the probability prod_i P(|t_i| < L). What
errors of few poses do not show, whether they are noise, is judged to the disadvantage of each
statement by two priors of tau. Nonconformity must also be shown against errors of one size: their
largest is no larger than the others. The square of an error has the distribution of a chi-square
with the same first three moments (Imhof, Biometrika 48, 419, 1961, doi 10.1093/biomet/48.3-4.419).
Derivation: docs/theory/accuracy.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.diagnose.row_errors import PoseErrors
from loopcal.errors import EstimationError
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import FINE
from loopcal.measure.observations import Observations
from loopcal.numerics.statistics import (
    compute_chi_square_quantile,
    compute_chi_square_tail,
    find_distinct,
    invert_increasing,
)
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.results.tables import choose_unit, to_quantity
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Unit

LEVEL = 0.95  # probability that conformity and nonconformity need: the default of ISO 14253-1:2017
# Probabilities of the bounds of an interval, and of the estimate between them.
INTERVAL = (0.025, 0.5, 0.975)
# What findings state of an estimate with its interval, and of its limit.
STATED = (
    *("estimate", "expanded", "low", "high", "limit"),
    *("guard_band", "acceptance_limit", "rejection_limit"),
)
STATED_NUMBERS = ("count", "probability", "most_probable", "level")
NODES = 32  # values of tau in each of the two searches
MOST = 300  # errors that are compared one by one
NEGLIGIBLE = 1e-4  # density of tau, in terms of the largest one, that is left out
BISECTIONS = 20  # bisections of a quantile: each halves its interval
# Tau, in terms of the noise, below which an error cannot be told from none: its probability is that
# of a decade of tau, and its tau that of no error. Otherwise the least one would exceed a limit by
# itself.
LEAST_SPREAD, NO_ERROR = 0.03, 1e-6
DECADE = math.log(10.0)
EQUAL_NODES = 300  # values of the size of equal errors


class Law(NamedTuple):
    """The distribution of the largest true error under one idea of true errors."""

    below: Callable[[float], float]  # probability that it is at most a limit
    evidence: float  # logarithm of the probability of the measured errors, up to a constant


class Spread(NamedTuple):
    """What is known of true errors before they are measured.

    slope : exponent of tau in its prior density over log(tau).
    tails, shares : values of u_i, and their probabilities.
    """

    slope: float
    tails: FloatArray
    shares: FloatArray


# Small errors are as probable as large ones: uniform in log(tau); all but a few are normal.
SMALL = Spread(0.0, np.array([0.002, 0.05, 1.0]), np.array([0.005, 0.01, 0.985]))
# Errors may be large: uniform in tau; and some are larger than others: quantiles of chi-square of
# 4 degrees of freedom over 4 give errors the tails of Student's t, and 4 % instead of 1 % the
# largest factor of 4.4, as one bad pose of 25 has.
LARGE = Spread(
    1.0, np.array([0.0517, 0.1338, 0.3047, 0.6175, 1.346]), np.array([0.04, 0.08, 0.18, 0.3, 0.4])
)
NOISE_QUANTILES = np.array([1.0, 3.0, 5.0]) / 6.0  # of its chi-square, where sigma is uncertain


class Decision(Enum):
    """What the rule decides; the value is how people read it."""

    CONFORMS = "conforms"
    UNDECIDED = "neither conforms nor fails"
    FAILS = "does not conform"


@dataclass(frozen=True)
class Conformity(Result):
    """An error with its uncertainty against a limit.

    Attributes
    ----------
    limit : largest allowed error [m] or [rad].
    estimate : the median of the true error. low, high : bounds of its interval of 95 %.
    floor, bound : the values that the true error exceeds, and keeps, with the probability `level`.
    probability, most_probable : of conformity, by what speaks against it and by what speaks for it.
    level : probability that the decision rule asks for.
    count : number of errors, of which the largest is compared.
    """

    limit: float
    estimate: float
    low: float
    high: float
    floor: float
    bound: float
    probability: float
    most_probable: float
    level: float = LEVEL
    count: int = 1

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("limit", "estimate", "low", "high", "floor", "bound", "expanded", "probability"),
        *("most_probable", "level", "guard_band", "acceptance_limit", "rejection_limit", "count"),
        decision="decision.value",
        rule=lambda _: "ISO 14253-1, JCGM 106",
    )

    def __str__(self) -> str:
        """Return the decision with its probability; numbers are in m or rad."""
        error = f"error {self.estimate:.4g} (95 %: {self.low:.4g} to {self.high:.4g})"
        decision = f"{self.decision.value} with a probability of {100.0 * self.probability:.3g} %"
        return f"{error} against a limit of {self.limit:.4g}, all in m or rad: {decision}"

    def choose_unit(self, unit: Unit) -> Unit:
        """Return the unit in which limit and uncertainty are read, of those finer than `unit`."""
        return choose_unit(unit, [min(self.limit, self.expanded or self.limit)], FINE)

    @property
    def expanded(self) -> float:
        """Expanded uncertainty: half the interval of 95 %."""
        return 0.5 * (self.high - self.low)

    @property
    def guard_band(self) -> float:
        """By how much the estimate must be below the limit to be accepted."""
        return self.bound - self.estimate

    @property
    def acceptance_limit(self) -> float:
        """The limit less the guard band: estimates up to it are accepted. 0 where the guard band
        is wider than the limit: no error is shown to be so small.
        """
        return max(self.limit - self.guard_band, 0.0)

    @property
    def rejection_limit(self) -> float:
        """The limit plus a guard band: estimates from it are rejected."""
        return self.limit + self.estimate - self.floor

    @property
    def decision(self) -> Decision:
        """What the rule decides."""
        if self.probability >= self.level:
            return Decision.CONFORMS
        return Decision.FAILS if self.most_probable <= 1.0 - self.level else Decision.UNDECIDED


def judge_estimate(
    estimate: float, uncertainty: float, limit: float, degrees: float = np.inf, level: float = LEVEL
) -> Conformity:
    """Compare a normal estimate with an upper limit.

    Parameters
    ----------
    estimate : such as an error [m]. uncertainty : its standard uncertainty, in the same unit.
    limit : the upper limit. degrees : of freedom of the uncertainty; infinite where it is known.
    level : probability that the decision rule asks for.

    Examples
    --------
    >>> judged = judge_estimate(12e-6, 1.5e-6, 15e-6)
    >>> round(judged.probability, 3), judged.decision.value
    (0.977, 'conforms')
    """
    from scipy.stats import norm, t

    _check_level(level)
    if not (np.isfinite(estimate) and uncertainty >= 0.0 and degrees > 0.0):
        raise EstimationError(
            f"an estimate of {estimate} with the uncertainty {uncertainty} and {degrees} degrees "
            "of freedom allows no comparison. Give finite numbers, and an uncertainty of 0 or more"
        )
    if uncertainty == 0.0:
        p, x = float(estimate <= limit), estimate
        return Conformity(limit, x, x, x, x, x, p, p, level)
    law = norm(estimate, uncertainty) if np.isinf(degrees) else t(degrees, estimate, uncertainty)
    low, middle, high, floor, bound = law.ppf([*INTERVAL, 1.0 - level, level])
    probability = float(law.cdf(limit))
    return Conformity(limit, middle, low, high, floor, bound, probability, probability, level)


def judge_largest_error(
    components: FloatArray,
    covariance: FloatArray,
    limit: float,
    level: float = LEVEL,
    noise_scale: float = 1.0,
    noise_degrees: float = np.inf,
) -> Conformity:
    """Compare the largest of e true errors with an upper limit.

    Parameters
    ----------
    components : (e, c) measured differences [m] or [rad], NaN where not measured.
    covariance : (e, c, c) of their noise. limit : the upper limit.
    level : probability that the decision rule asks for.
    noise_scale : factor s on the standard deviations of the noise; above 1 it speaks against
        nonconformity, but not for conformity. noise_degrees : of freedom of s, or infinite.

    Raises
    ------
    EstimationError : no error is measured, or the level is not between 0.5 and 1.
    """
    _check_level(level)
    mean, noise = _rotate(components, covariance)
    if not len(mean):
        raise EstimationError("the data contain no error to compare with a limit")
    # what exceeds the stated noise may be an error of the machine
    large = _find_distribution(mean, noise, min(noise_scale, 1.0), noise_degrees, LARGE).below
    by_spread = _find_distribution(mean, noise, noise_scale, noise_degrees, SMALL)
    small = by_spread.below
    if np.nansum(noise) > 0.0:
        small = _mix(by_spread, _find_equal_errors(mean, noise, noise_scale, noise_degrees))
    size = np.sqrt((mean**2).sum(axis=1))
    widest = 2.0 * float(size.max() + 10.0 * noise_scale * np.sqrt(np.nansum(noise, axis=1).max()))

    def both(limit: float) -> float:
        return 0.5 * (large(limit) + small(limit))

    laws = zip((small, both, large, small, large), (*INTERVAL, 1.0 - level, level), strict=True)
    low, middle, high, floor, bound = (
        invert_increasing(law, p, widest, BISECTIONS) for law, p in laws
    )
    lowest, highest = sorted((large(limit), small(limit)))
    return Conformity(
        limit, middle, low, high, floor, bound, lowest, highest, level, count=len(mean)
    )


def judge_draws(draws: FloatArray, limit: float) -> Conformity:
    """Compare a true error, given as draws (n,) of its distribution, with an upper limit."""
    low, middle, high, floor, bound = np.quantile(draws, [*INTERVAL, 1.0 - LEVEL, LEVEL]).tolist()
    probability = float((draws <= limit).mean())
    return Conformity(limit, middle, low, high, floor, bound, probability, probability)


def judge_limits(
    observations: Sequence[Observations],
    after: PoseErrors,
    limits: Mapping[str, float | None],
    noise_scale: float = 1.0,
    noise_degrees: float = np.inf,
) -> dict[str, Conformity]:
    """Compare the largest true error of each quantity with its limit.

    Nothing is said of a quantity that no row measures, or whose noise nobody stated.

    observations : the rows. after : their errors. limits : by quantity [m], [rad].
    noise_scale, noise_degrees : see `judge_largest_error`. The scale contains the share of the
        noise that is left where setup parameters were fitted to the same rows.
    """
    judged = {}
    for quantity, limit in limits.items():
        covariance = _collect_covariance(observations, quantity)
        if limit is not None and covariance is not None and len(covariance):
            errors = after[quantity].components
            judged[quantity] = judge_largest_error(
                errors, covariance, limit, LEVEL, noise_scale, noise_degrees
            )
    return judged


def report_conformity(
    judged: Mapping[str, Conformity],
    limits: Mapping[str, float | None],
    after: PoseErrors,
    units: Mapping[str, Unit],
    poses: Sequence[str],
) -> list[Finding]:
    """Return the one statement on each limit: by the conformance probability or, where nobody
    stated the noise, by the measured error, noise included.

    poses : (r,) labels of the rows.
    """
    findings = []
    for quantity, limit in limits.items():
        errors = after[quantity]
        if limit is None:
            continue
        if not len(errors.rows):
            findings.append(report_finding("gates.limit-not-measured", quantity=quantity))
            continue
        worst, unit, result = int(np.argmax(errors.size)), units[quantity], judged.get(quantity)
        measured = float(errors.size[worst])
        stated: dict[str, Any] = {
            "pose": poses[errors.rows[worst]],
            "target": errors.targets[worst],
            "error": measured,
        }
        if result is not None:
            findings.append(report_decision(quantity, result, unit, **stated))
            continue
        code = "gates.limit-exceeded" if measured > limit else "gates.limit-kept"
        stated |= {"limit": to_quantity(limit, unit), "error": to_quantity(measured, unit)}
        findings.append(report_finding(code, quantity=quantity, **stated))
    return findings


def report_decision(quantity: str, result: Conformity, unit: Unit, **measured: Any) -> Finding:
    """Return the decision on a limit in words, its lengths in one unit.

    measured : pose, target and size of the largest measured error; empty for that of a volume.
    """
    if unit.dimension is Dimension.LENGTH:
        unit = result.choose_unit(unit)
    stated = {"pose": "", "target": "", "error": None, **measured}
    stated |= {"error": to_quantity(measured["error"], unit)} if measured else {}
    return report_finding(
        f"conformity.{result.decision.name.lower()}",
        quantity=quantity,
        is_volume=not measured,
        **stated,
        **{name: to_quantity(getattr(result, name), unit) for name in STATED},
        **{name: getattr(result, name) for name in STATED_NUMBERS},
    )


def _check_level(level: float) -> None:
    """Refuse a level at which conformity and nonconformity could both be decided."""
    if not 0.5 < level < 1.0:
        raise EstimationError(
            f"the conformity level is {level}. Give a probability above 0.5 and below 1"
        )


def _collect_covariance(observations: Sequence[Observations], quantity: str) -> FloatArray | None:
    """Return covariances (e, 3, 3) ordered as `compute_row_errors`; None for unstated noise."""
    covariances = [np.zeros((0, 3, 3))]
    for o in observations:
        for group in (g for g in o.kind.error_groups if g.quantity == quantity):
            columns = np.array(group.columns)
            measured = o.present[:, columns].any(axis=1)
            if o.is_noise_assumed and measured.any():
                return None
            block = np.zeros((len(o), 3, 3))
            c = len(columns)
            block[:, :c, :c] = o.covariance[:, columns[:, None], columns]
            covariances.append(block[measured])
    return np.concatenate(covariances)


def _rotate(components: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return errors (e, c) and variances (e, c) in the axes in which the noise is independent; 0
    and NaN for components that are not measured.
    """
    present = np.isfinite(components)
    both = present[:, :, None] & present[:, None, :]
    covariance = np.where(both, covariance, 0.0)
    # an absent component keeps an axis of its own: its eigenvalue is beyond all others
    beyond = 10.0 * np.trace(covariance, axis1=1, axis2=2) + 1.0
    width = covariance.shape[1]
    covariance = covariance + np.where(present, 0.0, beyond[:, None])[:, :, None] * np.eye(width)
    variance, axes = np.linalg.eigh(covariance)
    errors = np.einsum("eij,ei->ej", axes, np.where(present, components, 0.0))
    is_absent = variance >= 0.5 * beyond[:, None]
    variance = np.where(is_absent, np.nan, np.maximum(variance, 0.0))
    kept = ~is_absent.all(axis=1)
    return np.where(is_absent, 0.0, errors)[kept], variance[kept]


def _find_distribution(
    errors: FloatArray, noise: FloatArray, scale: float, degrees: float, spread: Spread
) -> Law:
    """Return the distribution function of the largest true error, from errors (e, c) and the
    variances (e, c) of their noise, NaN where not measured; and the logarithm of its evidence.
    """
    variance, tau, weight, share, evidence = _weigh_scales(errors, noise, scale, degrees, spread)
    is_absent, true = np.isnan(variance), tau[:, None, None, None] ** 2
    true = true / spread.tails[:, None, None]
    kept = np.where(is_absent, 0.0, true / (np.where(is_absent, 1.0, variance) + true))
    left = np.where(is_absent, 0.0, kept * variance)
    square = (kept * errors) ** 2
    moments = np.stack([(left**k + k * left ** (k - 1) * square).sum(axis=-1) for k in (1, 2, 3)])
    (mean, second, third, share), count = _group_similar(np.concatenate([moments, share[None]]))
    is_exact = second <= (1e-12 * mean) ** 2
    third = np.where(is_exact, 1.0, third)
    freedom = np.where(is_exact, 1.0, second**3 / third**2)
    unit = np.where(is_exact, 1.0, np.sqrt(second / freedom))

    def probability(limit: float) -> float:
        tail = compute_chi_square_tail(freedom, np.maximum((limit**2 - mean) / unit + freedom, 0.0))
        tail = (np.where(is_exact, mean > limit**2, tail) * share).sum(axis=1)
        with np.errstate(divide="ignore"):
            each = np.exp((count * np.log1p(-np.minimum(tail, 1.0))).sum(axis=1))
        return min(float(each @ weight), 1.0)  # the weights add up to one but for rounding

    return Law(probability, evidence)


def _find_equal_errors(errors: FloatArray, noise: FloatArray, scale: float, degrees: float) -> Law:
    """Return the same where all true errors have one size and any direction, as a backlash or a
    shifted frame makes them: their largest is no larger than the others. Noise that differs between
    the axes of an error counts by the mean of its weights.
    """
    from scipy.special import i0e

    factors, typical, low, high = _bound_scales(errors, noise, scale, degrees)
    nodes = np.linspace(low, high, EQUAL_NODES)
    noise = np.maximum(noise, (NO_ERROR * typical) ** 2)
    weights = np.nan_to_num(1.0 / noise)[:, :, None, None] / factors[:, None]  # (e, c, f, 1)
    count = np.isfinite(noise).sum(axis=1)[:, None, None]
    x = np.exp(nodes) * np.sqrt(((errors[:, :, None, None] * weights) ** 2).sum(axis=1))
    double, none = -np.expm1(-2.0 * x), np.log(weights, out=0.0 * weights, where=weights > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):  # the logarithms of the means of exp(x u)
        by_count = (x + np.log1p(0.5 * -double), x + np.log(i0e(x)), x + np.log(0.5 * double / x))
    each = np.select([count == 1, count == 2], by_count[:2], np.where(x > 0.0, by_count[2], 0.0))
    each -= 0.5 * np.exp(2.0 * nodes) * weights.sum(axis=1) / count
    each += 0.5 * (none - errors[:, :, None, None] ** 2 * weights).sum(axis=1)
    density = each.sum(axis=0)
    best = float(density.max())
    sums = np.exp(density - best).mean(axis=0) * (high - low) / (EQUAL_NODES - 1)
    sums[0] = np.exp(density[:, 0] - best).mean() * DECADE
    total = np.cumsum(sums)

    def probability(limit: float) -> float:
        return float(np.interp(math.log(limit), nodes, total) / total[-1]) if limit > 0.0 else 0.0

    return Law(probability, best + math.log(total[-1]))


def _mix(*laws: Law) -> Callable[[float], float]:
    """Return the distribution function of several, by what the errors say of each."""
    evidence = np.array([law.evidence for law in laws])
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    return lambda limit: float(
        sum(s * law.below(limit) for s, law in zip(shares, laws, strict=True))
    )


def _bound_scales(
    errors: FloatArray, noise: FloatArray, scale: float, degrees: float
) -> tuple[FloatArray, float, float, float]:
    """Return the factors (f,) on the variances of the noise, its typical size, and the logarithms
    of the least and the largest tau.
    """
    factors = scale**2 * np.ones(1)
    if np.isfinite(degrees):
        factors = scale**2 * degrees / compute_chi_square_quantile(degrees, NOISE_QUANTILES)
    typical = float(np.sqrt(scale**2 * np.nanmean(noise)))
    largest = 10.0 * (float(np.abs(errors).max()) + typical)
    if typical == 0.0:
        return factors, 0.0, -np.inf, math.log(largest) if largest > 0.0 else 0.0
    return factors, typical, math.log(LEAST_SPREAD * typical), math.log(largest)


def _group_similar(moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return moments and shares (4, g, k, e) of squared errors, and their counts: beyond `MOST`
    errors there are groups of similar ones, but the largest errors stay single.
    """
    e = moments.shape[-1]
    if e <= MOST:
        return moments, np.ones(e)
    single = e - MOST // 2
    starts = np.linspace(0, single, MOST // 2, endpoint=False).astype(np.intp)
    starts = np.concatenate([find_distinct(starts), np.arange(single, e)])
    count = np.diff(starts, append=e).astype(np.float64)
    order = np.argsort(moments[0, 0, -1], kind="stable")
    return np.add.reduceat(moments[..., order], starts, axis=-1) / count, count


def _weigh_scales(
    errors: FloatArray, noise: FloatArray, scale: float, degrees: float, spread: Spread
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Return g pairs of noise and tau: variances (g, 1, e, c) and tau (g,), their posterior
    probabilities (g,), those (g, k, e) of the k `tails` of each error, and the log evidence.

    A first search finds where the density is, and a second one resolves it.
    """
    factors, typical, least, most = _bound_scales(errors, noise, scale, degrees)
    if typical == 0.0:
        share = np.broadcast_to(spread.shares[:, None], (1, len(spread.shares), len(errors)))
        return noise[None, None], np.full(1, max(math.exp(most), 1.0)), np.ones(1), share, 0.0

    def weigh(low: float, high: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return variances, tau, logarithms of the densities, and shares."""
        nodes = np.linspace(low, high, NODES)
        variance = np.repeat(factors, NODES)[:, None, None, None] * noise
        tau = np.tile(np.exp(nodes), len(factors))
        total = variance + tau[:, None, None, None] ** 2 / spread.tails[:, None, None]
        each = -0.5 * np.nansum(np.log(total) + errors**2 / total, axis=-1)
        each += np.log(spread.shares)[:, None]
        best = each.max(axis=1, keepdims=True)
        part = np.exp(each - best)
        sums = part.sum(axis=1, keepdims=True)
        density = (best + np.log(sums)).sum(axis=(1, 2)) + spread.slope * np.log(tau)
        return variance, tau, density, part / sums

    _, tau, density, _ = weigh(least, most)
    probable = (density - density.max() > math.log(NEGLIGIBLE)).reshape(len(factors), NODES)
    chosen = np.flatnonzero(probable.any(axis=0))
    first, last = max(chosen[0] - 1, 0), min(chosen[-1] + 1, NODES - 1)
    ends = (math.log(tau[first]), math.log(tau[last]))
    variance, tau, density, share = weigh(*ends)
    step = np.full(tau.shape, (ends[1] - ends[0]) / (NODES - 1))
    if first == 0 and spread.slope == 0.0:  # all smaller tau, which cannot be told apart
        step[::NODES], tau[::NODES] = DECADE, NO_ERROR * typical
    weight = step * np.exp(density - density.max())
    kept = weight > NEGLIGIBLE * weight.max()
    evidence = float(density.max()) + math.log(weight.sum() / len(factors))
    return variance[kept], tau[kept], weight[kept] / weight[kept].sum(), share[kept], evidence
