# SPDX-License-Identifier: Apache-2.0
"""Adjust the uncertainty of a fit to what its residuals show about their errors.

An effect of size g, with whitened columns Z, that the model does not have displaces the estimate by
root G'Z g. As g is not known, only its second moments, root G'Z E[g g'] Z'G root' is added to the
covariance: an interval then contains the truth at least as often as one without the effect.
Correlated errors replace the part of the covariance that independent errors cause, where theirs is
larger. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.diagnose import error_frames, model_discrepancy
from loopcal.diagnose.error_causes import OUTLIERS, explain_residuals
from loopcal.diagnose.residual_patterns import (
    BLOCK,
    ORDER,
    POSE,
    READING,
    ROUGH,
    SESSION,
    SMOOTH,
    TARGET,
    TEMPERATURE,
    TIME,
    WALK,
    Cause,
    EffectSizes,
    ExplainedResiduals,
    ResidualRows,
    collect_residual_rows,
    estimate_correlated_errors,
    estimate_sizes,
    has_time,
    linearize_examined,
    test_correlation,
    test_effect,
)
from loopcal.diagnose.residual_patterns import LEVEL as CORRELATED
from loopcal.diagnose.residual_patterns import MOST_POSES as EVEN_CHOICE
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.posterior import NOISE
from loopcal.estimate.residual_test import FALSE_ALARMS, choose_severity
from loopcal.estimate.result import Identification, add_covariance
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.numerics.statistics import choose_evenly, compute_median, find_distinct
from loopcal.results.tables import to_quantity
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import DISPLAY_UNITS, find_unit

# Probability without an effect, from which slow errors of the poses explain what shows it.
LEFT_OVER = FALSE_ALARMS["causes of residuals"]
SHARED = "residuals.shared-errors"  # code of the finding
# Code of the finding that independent errors would mean that sigma is too large.
TOO_SMALL = "noise.residuals-too-small"
# Codes of the findings on what residuals depend on.
CODES = {
    ORDER: "residuals.trend",
    TIME: "residuals.drift",
    SESSION: "residuals.sessions-differ",
    BLOCK: "residuals.sessions-differ",
    TEMPERATURE: "residuals.depend-on-temperature",
    READING: "residuals.depend-on-reading",
}


def adjust_uncertainty(
    fit: Identification,
    data: Measurements,
    linear: FitLinearization | None = None,
    explained: ExplainedResiduals | None = None,
    slow_p_value: float = 1.0,
) -> Identification:
    """Return a fit whose covariance allows for what the residuals of its data show, and says why.
    Estimates stay, and no variance becomes smaller. A fit that did not converge, has no intervals,
    or has weights by a loss is returned as it is. `linear` : see `linearize_fit`. `explained` : the
    causes of the residuals, where these are known. `slow_p_value` : the probability without slow
    errors of the poses, where other measurements have shown them.
    """
    if not is_explainable(fit):
        return fit
    linear = linearize_examined(fit, data, linear)
    share = linear.data.n_poses / data.n_poses
    if share < 1.0:
        count, rest = linear.data.n_poses, data.n_poses - linear.data.n_poses
        finding = report_finding("residuals.examined-part", count=count, rest=rest)
        fit = replace(fit, findings=(*fit.findings, finding))
    data = linear.data
    if explained is None:
        explained = explain_residuals(linear)
    if linear.solution.linearized is None or fit.poses is not None:
        T = error_frames.locate_measured_poses(fit, data).T
    else:  # readings are exact, and the linearization has kept the poses
        poses = linear.solution.linearized
        T = poses.T[0, poses.is_reached[0]]
    named = [cause.p_value for cause in explained.causes if cause.source == SMOOTH]
    slow = None
    if not any(cause.source == OUTLIERS for cause in explained.causes[:1]):  # like any error
        slow = model_discrepancy.find_slow_errors(linear, T, min([slow_p_value, *named]))
    if explained.rows is not None:
        fit = _add_patterns(fit, linear, explained, slow, share)
    return fit if slow is None else model_discrepancy.add_slow_errors(fit, slow)


def is_explainable(fit: Identification) -> bool:
    """Return whether the residuals of a fit can say what causes them."""
    return fit.converged and fit.residual_test.intervals and fit.options.loss is None


def _add_patterns(
    fit: Identification,
    linear: FitLinearization,
    explained: ExplainedResiduals,
    slow: model_discrepancy.SlowErrors | None,
    share: float,
) -> Identification:
    """Return a fit whose covariance allows for the causes of its residuals, and for the correlation
    of neighbors; the rows are of a share of its poses. What slow errors of the poses explain counts
    once, with these: a dependence on a reading, and the order of rows that follows the places.
    """
    rows, causes, data = explained.rows, explained.causes, linear.data
    assert rows is not None
    if causes:
        fit = replace(fit, findings=(*fit.findings, *(cause.finding for cause in causes)))
    effects = [
        estimate_sizes(rows, cause, cause.effect)
        for cause in causes
        if cause.effect is not None and cause.source in CODES
    ]
    shared = [c for c in causes if c.source in (POSE, TARGET, WALK)]
    rest = rows
    if slow is not None and slow.is_slow:
        rest = model_discrepancy.exclude_slow_errors(linear, rows, slow)
        effects = [
            e
            for e in effects
            if e.cause.source != READING and test_effect(rest, e.effect) < LEFT_OVER
        ]
        shared = [c for c in shared if c.effect and test_effect(rest, c.effect) < LEFT_OVER]
    # errors that groups of rows share make neighbors alike; a walk begins at zero, and correlated
    # errors anywhere, so that what both add contains either
    is_shared = bool({SESSION, BLOCK, POSE, TARGET, ROUGH} & {cause.source for cause in causes})
    left = rest
    for effect in effects:
        left = left.with_effects(effect.effect.columns)
    p_value = test_correlation(left)[1]
    is_correlated = p_value < CORRELATED and not is_shared
    if not (effects or shared or is_correlated):
        return fit
    # orientation and position (3 n, p) of evenly chosen measured poses, frames fitted, by the
    # parameters [per SI], and the sum of the variances of each that the fit states
    solution = error_frames.locate_measured_poses(fit, data)
    solution = solution.take(choose_evenly(len(solution.q), error_frames.MOST_POSES))
    posterior = fit.posterior
    D = (
        error_frames.linearize_tool_errors(posterior, solution, error_frames.FITTED).by_parameters
        / posterior.unit
    )
    effects_of = [D[:, rows].reshape(-1, D.shape[-1]) for rows in (slice(0, 3), slice(3, 6))]
    tool = [(E, float(((E @ posterior.root) ** 2).sum())) for E in effects_of]
    for effect in effects:
        moments = take_root(effect.moments, np.diag(effect.moments))
        root = rows.move(effect.effect.acting) @ moments
        finding = _report_effect(effect, _measure_growth(tool, root))
        fit = add_covariance(fit, root, effect.degrees, finding)
    for cause in shared:
        assert cause.effect is not None
        assert cause.size is not None
        # of many poses only some have columns, and errors of more of them cancel
        times = share * max(data.n_poses / EVEN_CHOICE, 1.0) if cause.source == POSE else 1.0
        size = np.sqrt(times * cause.size.variance)
        root = rows.move(cause.effect.scaled) * size
        finding = _report_shared(cause, _measure_growth(tool, root))
        fit = add_covariance(fit, root, cause.size.degrees, finding)
    if is_correlated:
        fit = _add_correlation(fit, left, p_value, data, tool, share)
    return _without_doubt_of_sigma(fit)


def _report_shared(cause: Cause, ratio: float) -> Finding:
    """Return the sizes of errors that rows share, by component."""
    assert cause.effect is not None
    assert cause.size is not None
    sizes = dict(zip(cause.effect.labels, cause.effect.unit.tolist(), strict=True))
    shown = [(sd, DISPLAY_UNITS[dimension]) for (_, dimension), sd in sizes.items()]
    sigma = float(np.sqrt(cause.size.variance))
    return report_finding(
        SHARED,
        cause=cause.source,
        components=tuple(component for component, _ in sizes),
        sizes=tuple(to_quantity(sigma * sd, u) for sd, u in shown),
        ratio=ratio,
        p_value=cause.p_value,
        severity=cause.severity,
    )


def add_shared_errors(data: Measurements, finding: Finding) -> Measurements:
    """Return measurements whose noise includes the errors that all targets of a pose share."""
    stated = zip(finding.data["components"], finding.data["sizes"], strict=True)
    sizes = {name: size.value * find_unit(size.unit).factor_to_si for name, size in stated}
    rows = []
    for o in data.observations:
        covariance = o.covariance.copy()
        for (name, _), columns in o.kind.component_columns.items():
            covariance[:, np.array(columns)[:, None], columns] += sizes.get(name, 0.0) ** 2
        rows.append(replace(o, covariance=covariance))
    return replace(data, observations=tuple(rows))


def _add_correlation(
    fit: Identification,
    rows: ResidualRows,
    p_value: float,
    data: Measurements,
    tool: Sequence[tuple[FloatArray, float]],
    share: float,
) -> Identification:
    """Return a fit with what correlated errors add to the covariance by independent ones; the rows
    are of this share of its poses.
    """
    errors = estimate_correlated_errors(rows, fit.residual_test.sigma_degrees)
    independent = np.diag(np.full(len(errors.covariance), fit.residual_test.sigma_scale**2))
    s = len(rows.root.setup)
    independent[s:, s:] = 0.0
    for part in (part for part in fit.posterior.parts if part.source == NOISE):
        scaled = part.root / fit.tolerance[:, None]
        directions = rows.root.machine / fit.tolerance[:, None]
        by_noise = np.linalg.lstsq(directions, scaled, rcond=None)[0]
        independent[s:, s:] += by_noise @ by_noise.T
    # what correlated errors cause beyond independent ones, where that is more
    covariance = share * errors.covariance
    more = take_root(covariance - independent, np.diag(covariance + independent))
    root = rows.root.times(more)
    finding = report_finding(
        "residuals.correlated",
        correlation=errors.correlation,
        order=TIME if has_time(data) else ORDER,
        ratio=_measure_growth(tool, root),
        p_value=p_value,
        severity=choose_severity(p_value),
    )
    return add_covariance(fit, root, errors.degrees, finding)


def _measure_growth(parts: Sequence[tuple[FloatArray, float]], root: FloatArray) -> float:
    """Return the factor by which a covariance of root (p + U, k) [SI] increases the standard
    uncertainty, the larger one of the parts: position and orientation.
    """
    added = [(float(((E @ root[: E.shape[1]]) ** 2).sum()), stated) for E, stated in parts]
    shares = [square / stated for square, stated in added if stated > 0.0]
    return float(np.sqrt(1.0 + max(shares, default=0.0)))


def take_root(matrix: FloatArray, squares: FloatArray) -> FloatArray:
    """Return a root (c, r) of a matrix (c, c), in the directions, relative to the roots of
    `squares` (c,), in which it is positive.
    """
    scale = np.sqrt(squares)
    scale = np.where(scale > 0.0, scale, 1.0)
    s, v = np.linalg.eigh(matrix / scale[:, None] / scale)
    return np.asarray(scale[:, None] * v[:, s > 0.0] * np.sqrt(s[s > 0.0]))


def _report_effect(effect: EffectSizes, ratio: float) -> Finding:
    """Return what the residuals depend on, with the size that exceeds its uncertainty most."""
    most = int(np.argmax(np.abs(effect.sizes) / effect.errors))
    component, dimension = effect.effect.labels[most]
    unit = DISPLAY_UNITS[dimension]
    size, error = (to_quantity(values[most], unit) for values in (effect.sizes, effect.errors))
    source, name = effect.effect.source, effect.effect.name
    return report_finding(
        CODES[source],
        **({"name": name} if name else {}),
        **({"unit": source} if source in (SESSION, BLOCK) else {}),
        component=component,
        size=size,
        error=error,
        ratio=ratio,
        p_value=effect.cause.p_value,
        severity=effect.cause.severity,
    )


def _without_doubt_of_sigma(fit: Identification) -> Identification:
    """Return a fit that does not call sigma alone too large: correlated errors make residuals
    small. Where the dependence is no warning, the small residuals still are.
    """
    warnings = (f.code for f in fit.findings if f.severity is Severity.WARNING)
    warned = any(code.startswith("residuals.") for code in warnings)
    severity = Severity.INFO if warned else Severity.WARNING
    findings = tuple(
        report_finding("noise.not-independent", ratio=f.data["ratio"], severity=severity)
        if f.code == TOO_SMALL
        else f
        for f in fit.findings
    )
    return replace(fit, findings=findings)


LEVEL = FALSE_ALARMS["heavy tails"]
DRAWS, BATCH = 10_000, 500  # draws of normal errors at most, and at once
DOUBT = 0.05  # probability from which no more draws are needed
FEWEST = 5.0  # degrees of freedom of the residuals from which the test is made
MOST_ROWS = 1000  # residuals that are tested at most, evenly chosen
TESTABLE = 1e-6  # share of its variance that the fit must leave of a row to be tested
PATTERNS = "residuals."  # beginning of the codes that say what the residuals of a fit depend on


@dataclass(frozen=True)
class HeavyTails:
    """The test of the residuals for heavy tails."""

    rows: int = 0  # number of residuals that are tested
    p_value: float = np.nan  # of a smaller T for normal noise; NaN where there is no test
    # median, expected: of the absolute residuals in standard deviations, and that of normal noise
    median: float = np.nan
    expected: float = np.nan
    largest: float = np.nan  # the largest of them

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The finding; none where normal noise explains the residuals, or without a test."""
        if not self.p_value < LEVEL:
            return ()
        finding = report_finding(
            "residuals.heavy-tailed",
            severity=choose_severity(self.p_value),
            p_value=self.p_value,
            median=self.median,
            expected=self.expected,
            largest=self.largest,
            level=LEVEL,
        )
        return (finding,)


def check_heavy_tails(
    fit: Identification,
    data: Measurements,
    outliers: Sequence[str] = (),
    linear: FitLinearization | None = None,
) -> HeavyTails:
    """Test whether large residuals are more frequent than normal noise makes them. Not tested are a
    fit with a loss, without intervals, or with uncertain readings, and one whose residuals depend
    on something, which makes some of them larger. `outliers` : labels of poses that are known to be
    wrong.
    """
    if not (fit.converged and fit.residual_test.intervals) or fit.options.loss is not None:
        return HeavyTails()
    reported = (f for f in fit.findings if f.severity is Severity.WARNING)
    if any(f.code.startswith(PATTERNS) for f in reported):
        return HeavyTails()
    linear = linearize_examined(fit, data, linear)
    rows = collect_residual_rows(linear)
    if rows is None:
        return HeavyTails()
    is_named = np.isin(np.array(linear.data.labels), list(outliers))
    is_wrong = np.zeros(len(rows.residual), dtype=bool)
    for number, o in enumerate(o for o in linear.data.observations if len(o)):
        own = rows.kind == number
        is_held = np.asarray(is_named[o.rows].reshape(len(o), -1).any(axis=1))
        is_wrong[own] = is_held[rows.row[own]]
    wrong = np.flatnonzero(is_wrong)
    return assess_tails(rows.without(wrong) if wrong.size else rows)


def assess_tails(rows: ResidualRows) -> HeavyTails:
    """Return the test of residuals."""
    kept = choose_evenly(len(rows.residual), MOST_ROWS)
    left = 1.0 - rows.basis.take(kept).squares()
    testable = left > TESTABLE
    kept, left = kept[testable], left[testable]
    basis = rows.basis.localize(kept)[1]
    if basis.shape[1] > len(kept):  # as many variables do the same
        basis = np.asarray(np.linalg.qr(basis.T, mode="r")).T
    if left.sum() < FEWEST:
        return HeavyTails(len(kept))
    member = rows.series[kept][:, None] == find_distinct(rows.series[kept])
    u = _standardize(rows.residual[kept, None], left, member)
    square, vectors = np.linalg.eigh(np.eye(basis.shape[1]) - basis.T @ basis)
    known = square > TESTABLE
    others = np.asarray(vectors[:, known] * np.sqrt(square[known]))
    rng, done, smaller = np.random.default_rng(0), 0, 0
    median, observed = 0.0, _compute_statistic(u)[0]
    while done < DRAWS:
        errors = rng.standard_normal((len(kept), BATCH))
        taken = basis.T @ errors + others @ rng.standard_normal((others.shape[1], BATCH))
        drawn = _standardize(errors - basis @ taken, left, member)
        smaller += int((_compute_statistic(drawn) <= observed).sum())
        # the median of each column, faster than `np.median` for some hundred rows
        ordered, n = np.sort(np.abs(drawn), axis=0), len(drawn)
        median += float((0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])).sum())
        done += BATCH
        if (1 + smaller) / (1 + done) > DOUBT:
            break
    size = np.abs(u)
    p_value = (1 + smaller) / (1 + done)
    return HeavyTails(len(kept), p_value, compute_median(size), median / done, float(size.max()))


def _standardize(residual: FloatArray, left: FloatArray, member: BoolArray) -> FloatArray:
    """Return residuals (k, d) in units of their standard deviation, by the series (k, s)."""
    expected = member.T @ left
    scale = np.sqrt((member.T @ residual**2) / expected[:, None])
    scale = np.where(scale > 0.0, scale, 1.0)
    return np.asarray(residual / (np.sqrt(left)[:, None] * (member @ scale)))


def _compute_statistic(u: FloatArray) -> FloatArray:
    """Return T (d,) of residuals (k, d)."""
    return np.asarray(np.log1p(u**2 / 3.0).mean(axis=0))
