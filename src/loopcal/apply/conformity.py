# SPDX-License-Identifier: Apache-2.0
"""Conformity with a limit: the probability that a true error keeps it, and a decision rule.

What was measured is the true error and the noise of the measurement. A decision from the measured
value alone accepts errors above the limit, or rejects errors below it, with an unknown risk. The
probability of conformity is the one that the true error keeps the limit, given the measurement and
its noise (JCGM 106:2012, section 7). The decision rule is that of ISO 14253-1: conformity needs at
least this probability, 95 % by default, and so does nonconformity. In between the measurement
decides nothing. In terms of the estimate, the rule is guarded acceptance: the acceptance limit is
the limit less a guard band (JCGM 106, section 8).

For the largest of e errors: the true components are normal with variance tau^2, whose square root
is not known (uniform prior), and the measured ones add noise with the stated covariance S_i. Given
tau, the true error i is normal with

    V = (S_i^-1 + I / tau^2)^-1    and mean    V S_i^-1 d_i

and the largest is below L with the probability prod_i P(|t_i| < L). The square of an error has the
distribution of a chi-square with the same first three moments (Imhof, Biometrika 48, 419, 1961, doi
10.1093/biomet/48.3-4.419). Derivation: docs/theory/accuracy.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

import numpy as np

from loopcal.diagnose.row_errors import PoseErrors
from loopcal.errors import EstimationError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure.kinds.kind import list_error_groups
from loopcal.measure.observations import Observations
from loopcal.numerics.statistics import compute_chi_square_tail, find_distinct, invert_increasing
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.typing import FloatArray
from loopcal.units import Unit

LEVEL = 0.95  # probability that conformity and nonconformity need: the default of ISO 14253-1:2017
# Probabilities of the bounds of an interval, and of the estimate between them.
INTERVAL = (0.025, 0.5, 0.975)
# What findings state of an estimate with its interval, and of its limit.
STATED = ("estimate", "expanded", "low", "high", "limit", "guard_band", "acceptance_limit")
NODES = 32  # values of tau in each of the two searches
MOST = 2000  # errors that are compared one by one
NEGLIGIBLE = 1e-6  # density of tau, in terms of the largest one, that is left out
BISECTIONS = 24  # bisections of a quantile: each halves its interval


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
    bound : the value that the true error keeps with the probability `level`.
    probability : of conformity. level : that the decision rule asks for.
    count : number of errors, of which the largest is compared.
    """

    limit: float
    estimate: float
    low: float
    high: float
    bound: float
    probability: float
    level: float = LEVEL
    count: int = 1

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("limit", "estimate", "low", "high", "expanded", "probability", "level"),
        *("guard_band", "acceptance_limit", "count"),
        decision="decision.value",
        rule=lambda _: "ISO 14253-1, JCGM 106",
    )

    def __str__(self) -> str:
        """Return the decision with its probability; numbers are in m or rad."""
        error = f"error {self.estimate:.4g} (95 %: {self.low:.4g} to {self.high:.4g})"
        decision = f"{self.decision.value} with a probability of {100.0 * self.probability:.3g} %"
        return f"{error} against a limit of {self.limit:.4g}, all in m or rad: {decision}"

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
        """The limit less the guard band: estimates up to it are accepted."""
        return self.limit - self.guard_band

    @property
    def decision(self) -> Decision:
        """What the rule decides."""
        if self.probability >= self.level:
            return Decision.CONFORMS
        return Decision.FAILS if self.probability <= 1.0 - self.level else Decision.UNDECIDED


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
            "of freedom cannot be compared; give finite numbers, and an uncertainty of 0 or more"
        )
    if uncertainty == 0.0:
        return Conformity(
            limit, estimate, estimate, estimate, estimate, float(estimate <= limit), level
        )
    law = norm(estimate, uncertainty) if np.isinf(degrees) else t(degrees, estimate, uncertainty)
    low, middle, high, bound = law.ppf([*INTERVAL, level])
    return Conformity(limit, middle, low, high, bound, float(law.cdf(limit)), level)


def judge_largest_error(
    components: FloatArray, covariance: FloatArray, limit: float, level: float = LEVEL
) -> Conformity:
    """Compare the largest of e true errors with an upper limit.

    Parameters
    ----------
    components : (e, c) measured differences [m] or [rad], NaN where not measured.
    covariance : (e, c, c) of their noise. limit : the upper limit.
    level : probability that the decision rule asks for.

    Raises
    ------
    EstimationError : no error is measured, or the level is not between 0.5 and 1.
    """
    _check_level(level)
    mean, noise = _rotate(components, covariance)
    if not len(mean):
        raise EstimationError("no error is measured, so none can be compared with a limit")
    exceed = _find_distribution(mean, noise)
    size = np.sqrt((mean**2).sum(axis=1))
    widest = 2.0 * float(size.max() + 10.0 * np.sqrt(np.nansum(noise, axis=1).max()))
    low, estimate, high, bound = (
        invert_increasing(exceed, p, widest, BISECTIONS) for p in (*INTERVAL, level)
    )
    return Conformity(
        limit, estimate, low, high, bound, float(exceed(limit)), level, count=len(mean)
    )


def judge_limits(
    observations: Sequence[Observations],
    after: PoseErrors,
    limits: Mapping[str, float | None],
    share: float = 1.0,
) -> dict[str, Conformity]:
    """Compare the largest true error of each quantity with its limit.

    Nothing is said of a quantity that no row measures, or whose noise nobody stated.

    observations : the rows. after : their errors. limits : by quantity [m], [rad].
    share : of the noise that the errors contain. It is below 1 where setup parameters were fitted
        to the same rows and took up some of it.
    """
    judged = {}
    for quantity, limit in limits.items():
        covariance = _collect_covariance(observations, quantity)
        if limit is not None and covariance is not None and len(covariance):
            errors = after[quantity].components
            judged[quantity] = judge_largest_error(errors, share * covariance, limit)
    return judged


def report_conformity(
    judged: Mapping[str, Conformity],
    limits: Mapping[str, float | None],
    after: PoseErrors,
    units: Mapping[str, Unit],
) -> list[Finding]:
    """Return the statement on each limit, or why there is none."""
    findings = []
    for quantity, limit in limits.items():
        if limit is None or not len(after[quantity].rows):
            continue
        if quantity not in judged:
            findings.append(report_finding("conformity.noise-not-stated", quantity=quantity))
            continue
        result, unit = judged[quantity], units[quantity]
        values: dict[str, Any] = {
            name: Quantity(float(getattr(result, name)) / unit.factor_to_si, unit.symbol)
            for name in STATED
        }
        values |= {name: getattr(result, name) for name in ("count", "probability", "level")}
        code = f"conformity.{result.decision.name.lower()}"
        findings.append(report_finding(code, quantity=quantity, **values))
    return findings


def _check_level(level: float) -> None:
    """Refuse a level at which conformity and nonconformity could both be decided."""
    if not 0.5 < level < 1.0:
        raise EstimationError(
            f"the conformity level is {level}; give a probability above 0.5 and below 1"
        )


def _collect_covariance(observations: Sequence[Observations], quantity: str) -> FloatArray | None:
    """Return the covariances (e, 3, 3) of errors as `compute_row_errors` orders them; None where
    nobody stated the noise of some.
    """
    covariances = [np.zeros((0, 3, 3))]
    for o in observations:
        for group in (g for g in list_error_groups(o.kind) if g.quantity == quantity):
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


def _find_distribution(errors: FloatArray, noise: FloatArray) -> Callable[[float], float]:
    """Return the distribution function of the largest true error, from errors (e, c) and the
    variances (e, c) of their noise, NaN where not measured.
    """
    tau, weight = _weigh_scales(errors, noise)
    is_absent, scale = np.isnan(noise), tau[:, None, None] ** 2
    total = np.where(is_absent, 1.0, noise) + scale
    kept = np.where(is_absent, 0.0, scale / total)
    variance = np.where(is_absent, 0.0, kept * noise)
    square = (kept * errors) ** 2
    moments = np.stack([(variance**k + k * variance ** (k - 1) * square) for k in (1, 2, 3)])
    (mean, second, third), count = _group_similar(moments.sum(axis=3))
    is_exact = second <= (1e-12 * mean) ** 2
    third = np.where(is_exact, 1.0, third)
    degrees = np.where(is_exact, 1.0, second**3 / third**2)
    unit = np.where(is_exact, 1.0, np.sqrt(second / degrees))

    def probability(limit: float) -> float:
        tail = compute_chi_square_tail(degrees, np.maximum((limit**2 - mean) / unit + degrees, 0.0))
        tail = np.where(is_exact, mean > limit**2, tail)
        with np.errstate(divide="ignore"):
            total = float(np.exp((count * np.log1p(-tail)).sum(axis=1)) @ weight)
        return min(total, 1.0)  # the weights add up to one but for rounding

    return probability


def _group_similar(moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return moments (3, k, g) of squared errors and their counts: beyond `MOST` errors there are
    groups of similar ones, but the largest errors stay single.
    """
    e = moments.shape[2]
    if e <= MOST:
        return moments, np.ones(e)
    single = e - MOST // 2
    starts = np.linspace(0, single, MOST // 2, endpoint=False).astype(np.intp)
    starts = np.concatenate([find_distinct(starts), np.arange(single, e)])
    count = np.diff(starts, append=e).astype(np.float64)
    order = np.argsort(moments[0, 0], kind="stable")
    return np.add.reduceat(moments[:, :, order], starts, axis=2) / count, count


def _weigh_scales(errors: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return values (k,) of tau and their posterior probabilities (k,), by a search that finds
    where the density is, and one that resolves it.
    """
    typical = float(np.sqrt(np.nanmean(noise)))
    largest = 10.0 * (float(np.abs(errors).max()) + typical)
    if typical == 0.0 or largest == 0.0:
        return np.array([max(largest, 1.0)]), np.ones(1)
    is_present = ~np.isnan(noise)
    squares, variances = errors[is_present] ** 2, noise[is_present]

    def weigh(low: float, high: float) -> tuple[FloatArray, FloatArray]:
        """Return logarithms of tau from low to high, and densities relative to the largest."""
        nodes = np.linspace(low, high, NODES)
        total = variances + np.exp(2.0 * nodes)[:, None]
        density = nodes - 0.5 * (np.log(total) + squares / total).sum(axis=1)  # uniform in tau
        return nodes, np.exp(density - density.max())

    nodes, weight = weigh(math.log(1e-3 * typical), math.log(largest))
    chosen = np.flatnonzero(weight > NEGLIGIBLE)
    first, last = max(chosen[0] - 1, 0), min(chosen[-1] + 1, NODES - 1)
    nodes, weight = weigh(float(nodes[first]), float(nodes[last]))
    kept = weight > NEGLIGIBLE
    return np.exp(nodes[kept]), weight[kept] / weight[kept].sum()
