# SPDX-License-Identifier: Apache-2.0
"""The prior of a fit by MAP: which parts of the spreads are wider than stated, the tests of the
spreads, and the uncertainty of the factors by which they are inflated.

A factor is estimated from the data that are fitted. Its error moves the estimate, by dz / d(log
factor) times the error of its logarithm, and this is added to the covariance. It also changes the
variances that the spreads cause: with the standard deviation s of its logarithm these have the
relative standard deviation 2 s, which is that of 1 / (2 s^2) degrees of freedom.

The stated spreads are tested against the data. With the prior z ~ N(0, 1) and unit noise the
projections c_i = u_i'b are independent, c_i ~ N(0, 1 + s_i^2), and the most probable deviation is z
= V y, y_i = s_i c_i / (1 + s_i^2), of variance w_i = s_i^2 / (1 + s_i^2). Three tests ask whether
the data are what such a prior predicts:

    all deviations    Q = sum y_i^2 = sum w_i chi2_i, compared with the scaled chi-square of equal
                      mean and variance (Satterthwaite): (sum w)^2 / sum w^2 degrees of freedom
    worst direction   max |c_i| / sqrt(1 + s_i^2)
    worst parameter   max |z_k| / sqrt(sum_i V_ki^2 w_i), which is |z_k| / sqrt(1 - v_k) with the
                      share v_k of the prior variance that the data leave

The last two are normal; the probability of the largest of n is 1 - (1 - p)^n, and that of the most
significant of the three tests 1 - (1 - p)^3 (Sidak). Directions that the data do not determine have
no weight. The part of the data outside the range contains no information on the prior; it is used
for the noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.estimate.descent import Descent
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.penalties import HOLD, MAP, Method
from loopcal.estimate.posterior import INFLATION, TOLERANCES, CovariancePart, find_variance_sources
from loopcal.estimate.residual_test import FALSE_ALARMS
from loopcal.estimate.result import Identification, add_covariance
from loopcal.estimate.tolerance_components import (
    LARGEST_FACTOR,
    InflatedTolerances,
    Kind,
    ToleranceComponent,
    are_penalized,
    compute_prior_covariance,
    compute_symmetric_root,
    estimate_excess_noise,
    find_most_probable_factor,
    list_components,
    list_shifts,
)
from loopcal.findings import Finding, report_finding
from loopcal.numerics import statistics
from loopcal.numerics.decomposition import Decomposition, decompose
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.results.description import Field, fields
from loopcal.typing import BoolArray, FloatArray

# Odds of each kind of component against none, before the data: parts of one batch and common zeros
# are frequent, the others less so. With these odds and right spreads about 1 % of data sets get
# a component.
PRIOR_ODDS: Mapping[Kind, float] = {"shift": 0.3, "group": 0.1, "single": 0.1}
# Components that are chosen at most; more say that the stated spreads are no prior at all.
MOST_COMPONENTS = 8
CYCLES = 4  # cycles in which the variances of the chosen components are optimized in turn
WIDEST = 30.0  # factor on an estimated factor up to which its distribution is integrated
# Variances over which the evidence is integrated: factors uniform in their logarithm.
VARIANCES = np.expm1(2.0 * np.linspace(0.0, np.log(WIDEST), 41)[1:])


class PredictedData(NamedTuple):
    """Data as a prior predicts them, in the parameters.

    information : (t, p, p) Q = A'K^-1 A. score : (t, p) h = A'K^-1 b.
    """

    information: FloatArray
    score: FloatArray

    def project(self, places: np.ndarray, is_shift: bool) -> tuple[FloatArray, FloatArray]:
        """Return l and u^2 (t, n, k) of n components of k parameters each, places (n, k)."""
        Q = self.information[:, places[:, :, None], places[:, None, :]]
        h = self.score[:, places]
        if is_shift:
            return Q.sum(axis=(2, 3))[..., None], (h.sum(axis=2) ** 2)[..., None]
        if places.shape[1] == 1:
            return Q[..., 0], h**2
        size, axes = np.linalg.eigh(Q)
        return np.maximum(size, 0.0), np.matmul(h[:, :, None, :], axes)[:, :, 0] ** 2


def predict(decomposition: Decomposition, factor: FloatArray) -> PredictedData:
    """Return Q and h (t,) for tolerances `factor` (t,) times those of the decomposition's root."""
    d = decomposition
    s = np.where(are_penalized(d), d.singular_values, 0.0)
    root = np.sqrt(1.0 + (factor[:, None] * s) ** 2)
    rows = (s / root)[:, :, None] * d.inverse
    score = np.matmul((d.projections / root)[:, None, :], rows)[:, 0]
    return PredictedData(np.matmul(rows.swapaxes(-1, -2), rows), score)


def compute_evidence(data: PredictedData, candidates: Sequence[ToleranceComponent]) -> FloatArray:
    """Return the logarithm of the evidence (t, n) of each candidate minus its penalty; minus
    infinity where it cannot be above 0.
    """
    result = np.full((len(data.score), len(candidates)), -np.inf)
    alike = Counter(candidate.kind for candidate in candidates)
    shapes: dict[tuple[Kind, int], list[int]] = {}
    for i, candidate in enumerate(candidates):
        shapes.setdefault((candidate.kind, len(candidate.places)), []).append(i)
    for (kind, _), members in shapes.items():
        places = np.array([candidates[i].places for i in members])
        penalty = float(np.log(alike[kind] / PRIOR_ODDS[kind]))
        result[:, members] = _integrate(*data.project(places, kind == "shift"), penalty)
    return result


def _integrate(size: FloatArray, square: FloatArray, penalty: float) -> FloatArray:
    """Return log mean exp(g) over VARIANCES of l and u^2 (.., k) minus the penalty.

    It is computed where the bound of g exceeds the penalty: each direction by itself adds at most
    (r - 1 - log r) / 2, r = u^2 / l > 1, to g.
    """
    result = np.full(size.shape[:-1], -np.inf)
    ratio = np.maximum(np.divide(square, size, out=np.ones_like(size), where=size > 0.0), 1.0)
    is_possible = 0.5 * (ratio - 1.0 - np.log(ratio)).sum(axis=-1) > penalty
    if is_possible.any():
        gain = _gain(size[is_possible], square[is_possible], VARIANCES)
        top = gain.max(axis=-1)
        result[is_possible] = top + np.log(np.exp(gain - top[:, None]).mean(axis=-1)) - penalty
    return result


def _gain(size: FloatArray, square: FloatArray, variance: FloatArray) -> FloatArray:
    """Return g (n, v) at variances (v,) for l and u^2 (n, k)."""
    d = 1.0 + variance[:, None] * size[:, None, :]
    return 0.5 * (variance[:, None] * square[:, None, :] / d - np.log(d)).sum(axis=-1)


def optimize_variance(size: FloatArray, square: FloatArray) -> tuple[float, float]:
    """Return the variance of largest g for l and u^2 (k,), and that g; the variance may be 0."""
    low, high, count = 0.0, float(np.log(LARGEST_FACTOR)), 201
    best, largest = 0.0, 0.0
    for _ in range(4):
        grid = np.linspace(low, high, count)
        gain = _gain(size[None], square[None], np.expm1(2.0 * grid))[0]
        i = int(gain.argmax())
        best, largest = float(np.expm1(2.0 * grid[i])), float(gain[i])
        low, high, count = grid[max(i - 1, 0)], grid[min(i + 1, count - 1)], 21
    return best, largest


def estimate_log_spread(size: FloatArray, square: FloatArray, center: float) -> float:
    """Return the root mean square deviation of the log factor of a component from `center`, for l
    and u^2 (k,): that of the distribution exp(g) over factors from 1 to WIDEST times this one.
    """
    grid = np.linspace(0.0, center + np.log(WIDEST), 200)
    gain = _gain(size[None], square[None], np.expm1(2.0 * grid))[0]
    weight = np.exp(gain - gain.max())
    return float(np.sqrt((weight * (grid - center) ** 2).sum() / weight.sum()))


class ComponentSearch(NamedTuple):
    """The search for the components of one prior (t = 1).

    rows : decomposition of the rows, their noise 1. correlation : (p, p) as stated, or None.
    unpenalized : (p,) parameters without a prior, or None. candidates : that may be chosen.
    """

    rows: Decomposition
    correlation: FloatArray | None
    unpenalized: np.ndarray | None
    candidates: tuple[ToleranceComponent, ...]

    def choose(self) -> tuple[ToleranceComponent, ...]:
        """Return the chosen components, of the better of two searches: from the stated spreads,
        and from inflated ones.
        """
        searches = [self._search(is_inflated) for is_inflated in (False, True)]
        return min(searches, key=lambda search: search[0])[1]

    def _search(self, is_inflated: bool) -> tuple[float, tuple[ToleranceComponent, ...]]:
        """Return minus the log evidence, up to a constant, and the components."""
        chosen: dict[int, float] = {}
        factor, penalty = self._find_factor(chosen) if is_inflated else 1.0, 0.0
        while len(chosen) < MOST_COMPONENTS:
            data = predict(self._decompose(chosen), np.array([factor]))
            evidence = compute_evidence(data, self.candidates)[0]
            evidence[list(chosen)] = -np.inf
            best = int(evidence.argmax()) if len(evidence) else 0
            if not len(evidence) or evidence[best] <= 0.0:
                break
            variance, gain = optimize_variance(*self._project(data, best))
            penalty += gain - float(evidence[best])
            chosen = {**chosen, best: variance / factor**2}
            chosen, factor = self._optimize(chosen, factor, is_inflated)
        factor = self._find_factor(chosen)
        components = tuple(replace(self.candidates[i], variance=v) for i, v in chosen.items())
        d = self._decompose(chosen)
        s = np.where(are_penalized(d), d.singular_values, 0.0)[0] * factor
        c = np.where(are_penalized(d), d.projections, 0.0)[0]
        score = 0.5 * float((np.log1p(s**2) + c**2 / (1.0 + s**2)).sum())
        return score + penalty, tuple(c for c in components if c.variance > 0.0)

    def _optimize(
        self, chosen: Mapping[int, float], factor: float, is_inflated: bool
    ) -> tuple[dict[int, float], float]:
        """Return variances and factor, optimized in turn."""
        chosen = dict(chosen)
        for _ in range(CYCLES):
            for i in chosen:
                others = {j: v for j, v in chosen.items() if j != i}
                data = predict(self._decompose(others), np.array([factor]))
                chosen[i] = optimize_variance(*self._project(data, i))[0] / factor**2
            factor = self._find_factor(chosen) if is_inflated else factor
        return chosen, factor

    def _project(self, data: PredictedData, i: int) -> tuple[FloatArray, FloatArray]:
        """Return l and u^2 (k,) of a candidate."""
        candidate = self.candidates[i]
        size, square = data.project(np.array([candidate.places]), candidate.kind == "shift")
        return size[0, 0], square[0, 0]

    def _find_factor(self, chosen: Mapping[int, float]) -> float:
        """Return the most probable factor on all spreads with the chosen components."""
        return float(find_most_probable_factor(self._decompose(chosen))[0])

    def _decompose(self, chosen: Mapping[int, float]) -> Decomposition:
        """Return the decomposition of the rows for the prior with the chosen components."""
        components = [replace(self.candidates[i], variance=v) for i, v in chosen.items()]
        covariance = compute_prior_covariance(
            self.rows.directions.shape[1], self.correlation, components
        )
        return restate(self.rows, covariance, self.unpenalized)


def restate(
    rows: Decomposition, covariance: FloatArray, unpenalized: BoolArray | None = None
) -> Decomposition:
    """Return the decomposition of the same rows for a prior of another covariance (p, p)."""
    p = rows.directions.shape[1]
    factor = np.zeros((len(rows.rows), p + 1, p + 1))
    factor[:, :p, :p] = rows.singular_values[:, :, None] * rows.inverse
    factor[:, :p, p] = rows.projections
    factor[:, p, p] = np.sqrt(rows.outside)
    return decompose(
        factor,
        rows.rows,
        tolerance=rows.tolerance,
        unpenalized=unpenalized,
        root=compute_symmetric_root(covariance),
    )


POWER_QUANTILE = 0.8416212335729143  # normal quantile of the power 0.8
WIDE = 5.0  # deviation in spreads that a test should show; what it could not is reported
NAMED = 4  # largest number of parameters that are named


def report_undetectable(free: FreeParameters, rows: Decomposition) -> list[Finding]:
    """Return a finding where deviations of WIDE tolerances would stay undetected by rows for the
    stated spreads, divided by their noise (t = 1).
    """
    Q, count = predict(rows, np.ones(1)).information[0], int((~free.assumed).sum())
    if count == 0:
        return []
    least = find_information(WIDE, count)
    own, names = np.where(free.assumed, np.inf, np.diag(Q)), free.names
    order = np.argsort(own)
    single = order[own[order] < least]
    shifts = [list(shift.places) for shift in list_shifts(free)]
    E = np.zeros((len(Q), len(shifts)))
    for j, places in enumerate(shifts):
        E[places, j] = 1.0
    common = (E * (Q @ E)).sum(axis=0)
    shared = np.flatnonzero(common < least)
    if not single.size and not shared.size:
        return []
    # the first of those that the data show least; rounding must not choose among several
    worst = shifts[int(np.argmax(common <= common.min() + 1e-6 * least))] if shared.size else []
    return [
        report_finding(
            "prior.undetectable",
            size=WIDE,
            names=tuple(names[i] for i in single[:NAMED]),
            count=len(single),
            total=count,
            together=tuple(names[i] for i in worst),
        )
    ]


def find_information(size: float, count: int) -> float:
    """Return the E'Q E with which a deviation of `size` tolerances is detected in four of five data
    sets by a test of `count` statistics.
    """
    level = statistics.compute_single_level(LEVEL, 3 * count)
    threshold = float(np.sqrt(statistics.compute_chi_square_quantile(1.0, level)))
    return ((threshold + POWER_QUANTILE) / size) ** 2


ROUNDS = 4  # fits at most until the chosen components are those of the fit
SAME_FACTOR = 0.05  # relative change of a component's factor below which the fit is not repeated


def choose_methods(free: FreeParameters, fit: Descent, method: Method) -> dict[int, MAP]:
    """Return the method with which a trial must be fitted again, by trial: those whose data ask for
    other components of the spreads than those of `method`.
    """
    if not (isinstance(method, MAP) and isinstance(method.inflation, InflatedTolerances)):
        return {}
    candidates = list_components(free, method.inflation.by)
    converged = np.flatnonzero(fit.status == DescentStatus.CONVERGED.value)
    if not candidates or not len(converged):
        return {}
    asked, rows = converged, _divide(fit.decomposition, method)
    if not method.components:
        # those in which any component has more evidence than none, besides the stated spreads or
        # the inflated ones
        shown = rows.take(converged)
        factor = method.read_inflation(fit.decomposition, fit.penalty)[converged]
        evidence = compute_evidence(predict(shown, np.ones(len(factor))), candidates)
        if (factor > 1.0).any():
            evidence = np.maximum(evidence, compute_evidence(predict(shown, factor), candidates))
        asked = converged[(evidence > 0.0).any(axis=1)]
    chosen: dict[int, MAP] = {}
    before = {(c.kind, c.places): c.factor for c in method.components}
    for i in asked:
        trial, unpenalized = rows.take(np.array([i])), method.unpenalized(len(free))
        search = ComponentSearch(trial, method.covariance(len(free)), unpenalized, candidates)
        components = search.choose()
        factors = {(c.kind, c.places): c.factor for c in components}
        is_same = factors.keys() == before.keys() and all(
            abs(value / before[key] - 1.0) <= SAME_FACTOR for key, value in factors.items()
        )
        if not is_same:
            chosen[int(i)] = replace(method, components=components)
    return chosen


def run_prior_tests(
    free: FreeParameters, fit: Descent, method: Method
) -> tuple[PriorConflict | None, list[Finding]]:
    """Return the tests of the prior, where the method uses one, and their findings: those on the
    spreads, and which deviations from them the data could not show.
    """
    if not isinstance(method, MAP):
        return None, []
    rows, on_held = fit.decomposition, list[Finding]()
    if method.components or method.held:
        stated = compute_prior_covariance(len(free), method.correlation, ())
        rows = restate(rows, stated, np.array(method.free) if any(method.free) else None)
    if method.held:
        weak = method.find_weak(rows, HOLD)[0]
        part = np.abs(rows.directions[0][:, weak][:, -1:]).max(axis=1, initial=0.0)
        order = np.argsort(-part)[:NAMED]
        names = tuple(free.names[i] for i in order if part[i] > MAIN_PART * part.max())
        factor, count = method.read_inflation(fit.decomposition, fit.penalty)[0], int(weak.sum())
        assumed = free.list_assumed(HOLD * float(factor))
        on_held = [report_finding("fit.held", count=count, names=names, assumed=assumed)]
    rows = _divide(rows, method)
    inflation = float(method.read_inflation(fit.decomposition, fit.penalty)[0])
    conflict = assess_prior_conflict(free, rows, inflation, fit.deviation[0], method.components)
    if fit.status[0] != DescentStatus.CONVERGED.value:
        return conflict, on_held
    return conflict, [*on_held, *conflict.report(), *report_undetectable(free, rows)]


def add_factor_uncertainty(result: Identification, fit: Descent) -> Identification:
    """Return the result with the uncertainty of the factors that inflated its spreads.

    Nothing is added where the spreads count as stated: below 1 no factor is used, and its
    distribution has no error to one side.
    """
    method = result.method
    if not (isinstance(method, MAP) and callable(method.inflation) and result.converged):
        return result
    factor = float(method.read_inflation(fit.decomposition, fit.penalty)[0])
    if factor <= 1.0 and not method.components:
        return result
    errors = [_estimate_factor_error(result, fit, method, factor)] if factor > 1.0 else []
    errors += _estimate_component_errors(fit, method, factor)
    scale = result.tolerance[:, None]
    component_rows = tuple(component.to_row(result.names) for component in method.components)
    source: dict[str, Any] = {"source": "given or assumed"} if method.held else {}
    finding = report_finding(INFLATION, factor=factor, parts=component_rows, **source)
    change = np.stack([error[0] for error in errors], axis=1)
    uncertain = [
        CovariancePart(TOLERANCES, scale * caused, 0.5 / spread**2) for _, caused, spread in errors
    ]
    return add_covariance(result, scale * change, np.inf, finding, uncertain)


_FactorError = tuple[FloatArray, FloatArray, float]
"""What an error of a factor does: the change (p,) of the estimate, in spreads, by one standard
deviation of the log factor; a root (p, k) of the covariance that the inflated deviations cause; and
this standard deviation.
"""


def _estimate_factor_error(
    result: Identification, fit: Descent, method: MAP, factor: float
) -> _FactorError:
    """Return what the error of the factor on all spreads does.

    In the coordinates y of the decomposition the estimate changes by 2 (1 - f_i) y_i; deviations
    of the variance tau_i^2 cause the error (1 - f_i) tau_i.
    """
    d, penalty = fit.decomposition, np.where(np.isfinite(fit.penalty), fit.penalty, 0.0)
    rows = _divide(d, method)  # a factor is one component of all spreads
    s, c = (
        np.where(are_penalized(rows), x, 0.0)[0] for x in (rows.singular_values, rows.projections)
    )
    spread = estimate_log_spread(
        s**2 / (1.0 + s**2), (s * c / (1.0 + s**2)) ** 2, float(np.log(factor))
    )
    change = 2.0 * (1.0 - d.filter_factors(penalty)) * d.solution(fit.penalty)
    change = np.where(penalty > 0.0, change, 0.0)
    test, free = result.residual_test, result.free_parameters
    prior = find_variance_sources(d, fit.penalty, test, method, free).prior
    inverse = np.divide(1.0, penalty, out=np.zeros_like(penalty), where=penalty > 0.0)
    variance = inverse if prior is None else np.where(penalty > 0.0, prior, 0.0)
    left = (1.0 - d.filter_factors(penalty)) * np.sqrt(variance)
    caused = d.directions[0] * left[0]
    return d.deviation(change * spread)[0], caused, spread


def _estimate_component_errors(fit: Descent, method: MAP, factor: float) -> list[_FactorError]:
    """Return what the errors of the factors of the components do.

    With the covariance S of the prior z = S h, and a variance v of E changes it by dz / dv = (1 - S
    Q) E E'h (`component_choice`), v = factor^2 - 1 of the component. Its deviations E w cause the
    error (1 - S Q) E w of the estimate.
    """
    rows, p = _divide(fit.decomposition, method), len(fit.deviation[0])
    data = predict(rows, np.array([factor]))
    Q, h = data.information[0], data.score[0]
    S = factor**2 * compute_prior_covariance(p, method.covariance(p), method.components)
    # parameters without a spread follow the others
    penalized = are_penalized(rows)
    errors = []
    for component in method.components:
        others = tuple(c for c in method.components if c is not component)
        stated = compute_prior_covariance(p, method.covariance(p), others)
        alone = restate(rows, stated, method.unpenalized(p))
        variance = factor**2 * component.variance
        places, is_shift = np.array([component.places]), component.kind == "shift"
        size, square = predict(alone, np.array([factor])).project(places, is_shift)
        spread = estimate_log_spread(size[0, 0], square[0, 0], 0.5 * np.log1p(variance))
        E = component.columns(p)
        left = E - S @ (Q @ E)
        left = rows.deviation(np.where(penalized, rows.coordinates(left.T), 0.0)).T
        change = left @ (E.T @ h) * (2.0 * (1.0 + variance) * spread)
        errors.append((change, left * np.sqrt(variance), spread))
    return errors


def _divide(decomposition: Decomposition, method: MAP) -> Decomposition:
    """Return the decomposition of the rows divided by the noise that they show."""
    divided = decomposition.divided(method.sigma(decomposition))
    return divided.divided(estimate_excess_noise(divided))


# Probability that any of the tests rejects tolerances that are right.
LEVEL = FALSE_ALARMS["tolerances"]
FAR = 2.0  # deviation from nominal, in spreads, above which a parameter is named
NAMED_FARTHEST = 3  # largest number of parameters that are named
# Part of a parameter in a direction, relative to the largest, above which it is named.
MAIN_PART = 0.3
# Share of the prior variance that data must explain for a parameter or direction to be tested.
TESTABLE = 1e-6


@dataclass(frozen=True)
class LargestDeviation:
    """The test of the largest of several standard normal statistics.

    statistic : the largest absolute value; 0 without a test. count : number of statistics.
    p_value : probability of a larger one in any of them. names : of the parameters in question.
    """

    statistic: float
    count: int
    p_value: float
    names: tuple[str, ...]


@dataclass(frozen=True)
class PriorConflict:
    """The stated spreads against the data.

    statistic, degrees, p_value : Q, its degrees of freedom and the probability of a larger Q.
    direction, parameter : the tests of the worst direction and of the worst parameter.
    joint_p_value : probability that the most significant of the three tests is more significant.
    inflation : factor by which all spreads were inflated for the estimate.
    components : parts of them that were inflated further.
    component_rows : kind, name, names of the parameters and factor of each.
    farthest : names of the parameters farthest from nominal, and their deviations in spreads.
    """

    statistic: float
    degrees: float
    p_value: float
    direction: LargestDeviation
    parameter: LargestDeviation
    joint_p_value: float
    inflation: float
    farthest: tuple[tuple[str, float], ...]
    components: tuple[ToleranceComponent, ...]
    component_rows: tuple[dict[str, object], ...]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("statistic", "degrees", "p_value", worst_direction="direction"),
        *fields(worst_parameter="parameter", joint_p_value="", inflation=""),
        *fields(components="component_rows", conflict="", farthest=""),
        *fields(sentence=lambda conflict: str(conflict.finding)),
    )

    @property
    def conflict(self) -> bool:
        """Whether the data contradict the spreads."""
        return self.joint_p_value < LEVEL

    @property
    def finding(self) -> Finding:
        """Whether the spreads agree with the data, and what the method did."""
        if self.degrees < 0.5:
            return report_finding("prior.untested")
        inflated = self.inflation > 1.0 or bool(self.components)
        # of a parameter or direction, where it is more significant than the test of all
        worst = min(self.parameter, self.direction, key=lambda test: test.p_value)
        is_worst = worst.p_value < self.p_value
        if not self.conflict and self.components:
            return report_finding(
                "prior.components-inflated", parts=self.component_rows, factor=self.inflation
            )
        if not self.conflict:
            return report_finding("prior.consistent", p_value=self.joint_p_value, level=LEVEL)
        return report_finding(
            "prior.tolerances-inflated" if inflated else "prior.tolerances-too-narrow",
            ratio=float(np.sqrt(self.statistic / self.degrees)),
            names=tuple(name for name, _ in self.farthest),
            deviations=tuple(deviation for _, deviation in self.farthest),
            worst=worst.names if is_worst else (),
            worst_statistic=worst.statistic if is_worst else 0.0,
            factor=self.inflation,
            parts=self.component_rows,
            p_value=self.joint_p_value,
            level=LEVEL,
        )

    def report(self) -> list[Finding]:
        """Return the finding where it says more than that the spreads agree with the data."""
        return [self.finding] if self.conflict or self.components else []


def assess_prior_conflict(
    free: FreeParameters,
    decomposition: Decomposition,
    inflation: float,
    deviation: FloatArray,
    components: tuple[ToleranceComponent, ...] = (),
) -> PriorConflict:
    """Test the prior of a fit (t = 1), from its decomposition for the stated spreads, rows
    divided by the noise that they show, and its deviation (p,) in spreads. `inflation` and
    `components` are what the method inflated.
    """
    statistic, degrees = (float(value[0]) for value in compute_prior_statistic(decomposition))
    p_value, names = float(statistics.compute_chi_square_tail(degrees, statistic)), free.names
    square = np.where(are_penalized(decomposition), decomposition.singular_values**2, 0.0)[0]
    share, projections = square / (1.0 + square), decomposition.projections[0]
    # the worst direction is named by its largest parts, in spreads
    basis, is_testable = decomposition.directions[0], share > TESTABLE
    values = np.where(is_testable, np.abs(projections) / np.sqrt(1.0 + square), 0.0)
    part = np.where(free.assumed, 0.0, np.abs(basis[:, int(np.argmax(values))]))
    main = [i for i in np.argsort(-part) if part[i] > MAIN_PART * part.max()]
    direction = _test_largest(values, is_testable, tuple(names[i] for i in main))
    variance = basis**2 @ share
    is_testable = (variance > TESTABLE) & ~free.assumed
    sizes = np.abs(basis @ (np.sqrt(square) * projections / (1.0 + square)))
    values = np.where(is_testable, sizes / np.sqrt(np.where(is_testable, variance, 1.0)), 0.0)
    parameter = _test_largest(values, is_testable, (names[int(np.argmax(values))],))
    distance = np.where(free.assumed, 0.0, np.abs(deviation))
    order = np.argsort(-distance)
    far = order[distance[order] > FAR][:NAMED_FARTHEST]
    return PriorConflict(
        statistic=statistic,
        degrees=degrees,
        p_value=p_value,
        direction=direction,
        parameter=parameter,
        joint_p_value=statistics.compute_any_probability(
            min(p_value, direction.p_value, parameter.p_value), 3
        ),
        inflation=inflation,
        farthest=tuple((names[i], float(deviation[i])) for i in far),
        components=components,
        component_rows=tuple(component.to_row(names) for component in components),
    )


def compute_prior_statistic(decomposition: Decomposition) -> tuple[FloatArray, FloatArray]:
    """Return Q (t,), scaled to a chi-square, and its degrees of freedom (t,).

    The sums are over the directions that a prior penalizes.
    """
    square = np.where(are_penalized(decomposition), decomposition.singular_values**2, 0.0)
    share = square / (1.0 + square)
    value = (share * decomposition.projections**2 / (1.0 + square)).sum(axis=1)
    first, second = share.sum(axis=1), (share**2).sum(axis=1)
    testable = second > 0.0
    safe = np.where(testable, second, 1.0)
    return np.where(testable, value * first / safe, 0.0), np.where(testable, first**2 / safe, 0.0)


def _test_largest(
    values: FloatArray, testable: BoolArray, names: tuple[str, ...]
) -> LargestDeviation:
    """Return the test of the largest of standard normal values that are testable."""
    count = int(testable.sum())
    if count == 0:
        return LargestDeviation(0.0, 0, 1.0, ())
    largest = float(values.max())
    single = float(statistics.compute_chi_square_tail(1.0, largest**2))
    return LargestDeviation(
        largest, count, statistics.compute_any_probability(single, count), names
    )
