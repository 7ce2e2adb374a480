# SPDX-License-Identifier: Apache-2.0
"""Test whether the residuals of a fit vary slowly with the pose, and add what they show to its
uncertainty.

With the whitened rows A of the parameters, the rows of the prior, and the rows Phi of slow errors
of the poses (`SmoothErrors`), the elimination of the parameters leaves (y, S) of the residuals and
Phi. If the model is right, y has the variance sigma^2; with errors of amplitude tau it has
sigma^2 + tau^2 S S'. The test compares residuals by their weights alone: it needs no sigma, and
does not depend on the order of the poses. Displacements and rotations of the tool are tested one
after the other, the more significant first. Only directions that the rows sense have errors, each
as large as its own residuals show. The likelihood chooses over which length the errors vary. See
docs/theory/residual-patterns.md.

The lack of fit is tested against the pure error of repeated poses, which have equal predictions:
SS_pure = sum over groups min over mu of |W (r - mu)|^2, SS_lack = RSS - SS_pure, and SS_lack /
dof_lack over SS_pure / dof_pure has an F distribution if the model is right, whatever the true
sigma is. Source: Draper and Smith, Applied Regression Analysis.

A smooth map of the residuals is tested by errors in regions of poses that are left out. The rows
are r = U b + Phi c + e, with U all that is estimated, any b, the smooth errors Phi c with
independent c of variance 1, and noise e of the variance sigma^2. Ridge regression on X = [U, Phi]
with H = X (X'X + diag(0, sigma^2))^-1 X' leaves, of the rows g of a region that it was not made
from,

    (I - H_gg)^-1 (r - H r)_g

Without a map, X = U. The squares of both are compared region by region. Length and amplitude of the
errors are those of all rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from loopcal.diagnose.residual_patterns import ResidualRows, collect_residual_rows, collect_rows
from loopcal.estimate import residual_test
from loopcal.estimate.fit_linearization import FitLinearization, fold_smooth_errors
from loopcal.estimate.free_parameters import choose_pivots
from loopcal.estimate.identification import prepare_fitted_data
from loopcal.estimate.posterior import DISCREPANCY, ModelDiscrepancy, combine_degrees
from loopcal.estimate.problem import problem_of
from loopcal.estimate.result import Identification, add_covariance
from loopcal.estimate.smooth_errors import (
    CENTERS,
    FINE_CENTERS,
    SmoothErrors,
    describe_smooth_errors,
)
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.solutions import forward
from loopcal.numerics import statistics
from loopcal.numerics.split_columns import SplitColumns
from loopcal.results.description import Field, fields
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

DETERMINED = 1e-6  # least eigenvalue of I - H_gg; below, the other regions do not predict the rows


class MapTest(NamedTuple):
    """What the map does to errors in regions that it was not made from.

    before, after : root mean square of the whitened rows, without and with the map. lowest : lower
    end of the interval of 95 % of the share of the mean square that the map removes; NaN
    without a test. regions : their number.
    """

    before: float
    after: float
    lowest: float
    regions: int

    @property
    def is_gain(self) -> bool:
        """Whether the map is proven to lower the errors."""
        return self.lowest > 0.0


def check_map(
    linear: FitLinearization, errors: SmoothErrors, noise: float, T: FloatArray
) -> MapTest:
    """Compare the errors in left-out regions of the measured poses T (n, 4, 4) with and without a
    map of these smooth errors; `noise` is sigma^2.
    """
    untested, rows = MapTest(np.nan, np.nan, np.nan, 0), collect_residual_rows(linear)
    if rows is None or len(T) != linear.data.n_poses:
        return untested
    regions = errors.group_regions(T, FEWEST_REGIONS)[rows.locate_poses(linear.data)]
    columns = rows.basis.remove(rows.basis.remove(collect_columns(linear, errors)))
    s, axes = np.linalg.eigh(columns.T @ columns)
    by_errors = columns @ (axes / np.sqrt(np.maximum(s, 0.0) + noise))
    left = [
        _leave_out(each, rows.residual, regions)
        for each in (rows.basis, rows.basis.append(by_errors))
    ]
    known = np.isfinite(left).all(axis=0)
    if known.sum() < FEWEST_REGIONS:
        return untested._replace(regions=int(known.sum()))
    before, after = (squares[known] for squares in left)
    count, removed = len(before), before - after
    half = float(residual_test.coverage_factor(count - 1.0)) * np.sqrt(count) * removed.std(ddof=1)
    number = np.isin(regions, np.flatnonzero(known)).sum()
    rms = np.sqrt(np.array([before.sum(), after.sum()]) / number).tolist()
    return MapTest(rms[0], rms[1], float((removed.sum() - half) / before.sum()), count)


def collect_columns(linear: FitLinearization, errors: SmoothErrors) -> FloatArray:
    """Return the columns (R, m) of smooth errors in the rows of a fit of exact readings."""
    problem, solution = linear.problem.with_errors(errors, linear.solution)
    apart = replace(linear.linearization, nuisance=None)  # the setup takes up no part of them
    stacked = collect_rows(linear.data, problem, problem.leverage_rows(apart, solution))
    assert stacked is not None
    return stacked.columns.wide[:, -errors.count :]


def _leave_out(X: SplitColumns, residual: FloatArray, regions: IntArray) -> FloatArray:
    """Return the sum of squares of the rows of each region by regression on the others, with
    H = X X', X (R, k); NaN where these do not predict it.
    """
    left, squares = X.remove(residual), np.full(regions.max() + 1, np.nan)
    for region in range(len(squares)):
        own = np.flatnonzero(regions == region)
        part = X.take(own).toarray()
        rest = np.eye(len(own)) - part @ part.T
        if own.size and np.linalg.eigvalsh(rest)[0] > DETERMINED:
            squares[region] = float((np.linalg.solve(rest, left[own]) ** 2).sum())
    return squares


FEWEST_POSES = 5  # different poses below which nothing can be said of how errors vary with the pose
# Share of the effect of errors on the rows below which the parameters take up all of it.
UNSEEN = 1e-8
NEGLIGIBLE = 1e-12  # share of the largest variance by slow errors below which one is rounding
# Lengths over which slow errors vary, in halves of the range of a coordinate, and whether they
# vary with the rotation of the platform: a wave over the workspace, and slower ones. They find slow
# errors; where poses are dense, the shortest of the short ones does so, too. The likelihood chooses
# among all, with more centers.
KERNELS = ((0.6, False), (1.7, True))
SHORT_KERNELS = ((0.3, False), (0.35, False), (0.42, False), (0.5, False))
# Share of the information on the direction that the rows sense best, below which they do not
# measure a direction: errors of it are seen a tenth as well.
UNMEASURED_SHARE = 0.01
# Length, in halves of the range, over which errors vary that no two poses share, and most poses
# for these.
ROUGH, MOST_ROUGH = 1e-3, 150
# Probability that independent errors look like slow errors of the poses, over all tests of a fit.
LEVEL = residual_test.FALSE_ALARMS["model discrepancy"]
# Probability without errors in a direction below which it has some, once its machine shows any.
DIRECTION_LEVEL = 0.3
FEWEST_REGIONS = 8  # of which each is left out; of fewer, a quarter is not a share of the regions
TOO_LARGE = "noise.residuals-too-large"  # code of the finding that noise does not explain
NAMED = 0.5  # share of the largest component of errors from which an axis is named


class SlowErrorRows(NamedTuple):
    """What the elimination of the parameters leaves of residuals and slow errors."""

    errors: SmoothErrors  # of unit amplitude
    slope: FloatArray  # (p, m) change of the estimates [SI] with the coefficients
    rows: FloatArray  # (m, m) S
    residuals: FloatArray  # (m,) y
    sizes: FloatArray  # (d,) whitened size of the errors of each direction before the elimination


class SlowError(NamedTuple):
    """Independent errors of equal size in some directions."""

    directions: FloatArray  # (6, d) unit vectors of rotation and place
    size: statistics.VarianceComponent
    p_value: float  # without them, in any of the tests that are made


class SlowErrors(NamedTuple):
    """Slow errors that residuals show."""

    rows: SlowErrorRows  # that show them
    errors: tuple[SlowError, ...]
    is_slow: bool = True  # whether neighboring poses share them; otherwise each pose has its own
    test: MapTest = MapTest(np.nan, np.nan, np.nan, 0)  # of a map that corrects them

    @property
    def amplitude(self) -> FloatArray:
        """(6, d) amplitudes of the directions, those of rotation first."""
        ordered = sorted(self.errors, key=lambda error: _is_place(error.directions))
        return np.hstack([e.directions * np.sqrt(e.size.variance) for e in ordered])


def find_slow_errors(
    linear: FitLinearization, T: FloatArray, named: float = 1.0
) -> SlowErrors | None:
    """Return the slow errors that the residuals of a fit with intervals show at its measured poses
    T (n, 4, 4) [m]; None without any, or where nothing can be tested. `named` : the probability of
    residuals as these by noise, where errors of the place are known to cause them.
    """
    fit, tool = linear.fit, linear.fit.robot.tool[:3, 3]
    # deviations from nominal show errors, too, but only as far as the spreads are right
    if len(T) < FEWEST_POSES or fit.residual_test.degrees < residual_test.FEWEST_DEGREES:
        return None

    def project(
        kernels: Sequence[tuple[float, bool]], directions: FloatArray, most: int = CENTERS
    ) -> list[SlowErrorRows]:
        each = (
            describe_smooth_errors(T, tool, fit.robot.size, length, most, by_rotation=by_rotation)
            for length, by_rotation in kernels
        )
        scaled = (e.scaled(directions) for e in each if kernels is KERNELS or e.is_dense)
        projected = (project_slow_errors(linear, errors) for errors in scaled)
        return [rows for rows in projected if rows is not None]

    tested = project(KERNELS, np.eye(6))
    if not tested:
        return None
    groups = find_measured_directions(tested[0])
    measured = np.hstack([np.zeros((6, 0)), *groups])
    short = project(SHORT_KERNELS[:1], measured, FINE_CENTERS) if measured.size else []
    known = residual_test.count_sigma_degrees(
        fit.residual_test.noise, fit.options.sigma_uncertainty
    )
    lengths = (*tested, *short)
    level = statistics.compute_single_level(LEVEL, len(lengths)) if named == 1.0 else 1.0
    slow = [detect_slow_errors(rows, groups, known, level) for rows in lengths]
    if not any(slow):
        return find_rough_errors(linear, T)
    found = min((each for each in slow if each), key=lambda each: min(e.p_value for e in each))
    tests = len(lengths) * len(groups)
    p_values = [min(named, statistics.compute_any_probability(e.p_value, tests)) for e in found]
    found = [e._replace(p_value=p) for e, p in zip(found, p_values, strict=True)]
    fine = [*project(KERNELS, measured, FINE_CENTERS), *short]
    fine += project(SHORT_KERNELS[1:], measured, FINE_CENTERS)
    divided = [SlowErrors(rows, divide_by_direction(rows, found, groups, known)) for rows in fine]
    best = max(divided, key=_score)
    errors = best.rows.errors.scaled(best.amplitude)
    return best._replace(test=check_map(linear, errors, best.errors[-1].size.noise, T))


def _score(slow: SlowErrors) -> float:
    """Return the logarithm of the probability of the length of errors, up to a constant: that of
    the residuals, and a half-Cauchy prior of the amplitude, in units of that of independent errors
    as large as the residuals. Larger errors would hide in the parameters.
    """
    rows, score = slow.rows, 0.0
    for error in slow.errors:
        square = error.size.variance * measure_size(rows, error.directions)
        score += error.size.gain - np.log1p(square / float(rows.residuals @ rows.residuals))
    return score


def measure_size(rows: SlowErrorRows, directions: FloatArray) -> float:
    """Return the whitened sum of squares of errors of unit variance in directions (6, d), before
    the elimination of the parameters.
    """
    return float((((rows.errors.amplitude.T @ directions).T * rows.sizes) ** 2).sum())


def find_rough_errors(linear: FitLinearization, T: FloatArray) -> SlowErrors | None:
    """Return errors that every pose has of its own, where repeats of a pose agree much better with
    each other than with the fit; None elsewhere.

    With the variance sigma^2 of pure error, the residuals that such errors can change have the
    variance sigma^2 + tau^2 S S'.
    """
    robot, lack = linear.fit.robot, check_lack_of_fit(linear.fit, linear.data)
    if lack.is_explained is not False:
        return None
    errors = describe_smooth_errors(T, robot.tool[:3, 3], robot.size, ROUGH, MOST_ROUGH)
    rows = project_slow_errors(linear, errors)
    if rows is None:
        return None
    rough = []
    for directions in find_measured_directions(rows):
        u, w = _find_axes(_columns(rows.rows, rows.errors, directions))
        y = (u.T @ rows.residuals) / lack.sigma_scale
        p_value = float(statistics.compute_f_tail(len(y), lack.pure_degrees, float(y @ y) / len(y)))
        if p_value < REPEATS_LEVEL:
            size = statistics.estimate_variance_component(w, y, lack.pure_degrees)
            size = size._replace(variance=size.variance * lack.sigma_scale**2)
            rough.append(SlowError(directions, size, p_value))
    return SlowErrors(rows, tuple(rough), is_slow=False) if rough else None


def exclude_slow_errors(
    linear: FitLinearization, rows: ResidualRows, slow: SlowErrors
) -> ResidualRows:
    """Return the rows of a fit as if it had also estimated slow errors, as far as these exceed the
    noise: what other errors than these show.
    """
    columns = rows.project(collect_columns(linear, slow.rows.errors.scaled(slow.amplitude)))
    u, variances = _find_axes(columns)
    return rows.with_effects(u[:, variances > slow.errors[-1].size.noise])


def add_slow_errors(fit: Identification, slow: SlowErrors) -> Identification:
    """Return a fit whose uncertainty includes slow errors that were found in its residuals.

    The parameters get what the errors do to them, and poses what is left of them. Estimates stay.
    """
    rows, first = slow.rows, fit.posterior
    ordered = sorted(slow.errors, key=lambda error: _is_place(error.directions))
    amplitude = slow.amplitude
    degrees = np.concatenate([np.full(e.directions.shape[1], e.size.degrees) for e in ordered])
    root = _columns(rows.slope, rows.errors, amplitude)
    S, noise = _columns(rows.rows, rows.errors, amplitude), ordered[-1].size.noise
    # the errors leave y' (1 + S S')^-1 y of the residuals
    w, u = np.linalg.eigh(S @ S.T)
    own = float((w / (1.0 + w) * (u.T @ rows.residuals) ** 2).sum())
    test = fit.residual_test.explain(fit.residual_test.chi_square - own)
    if test is not fit.residual_test:
        findings = (test.finding if f.code == TOO_LARGE else f for f in fit.findings)
        fit = replace(fit, residual_test=test, findings=tuple(findings))
    if not slow.test.is_gain:  # no map is kept
        S = S[:, :0]
    # the coefficients given -y = S c + noise: residuals are predicted less measured values
    precision, axes = np.linalg.eigh(S.T @ S + noise * np.eye(S.shape[1]))
    discrepancy = ModelDiscrepancy(
        rows.errors.scaled(amplitude),
        root,
        degrees,
        first.directions,
        first.variance,
        test=np.array(slow.test),
        mean=-axes @ (axes.T @ (S.T @ rows.residuals) / precision),
        axes=axes,
        left=np.sqrt(noise / precision),
    )
    for is_place, own, of_part in discrepancy.parts:
        squares = (amplitude[:, own] ** 2).sum(axis=0)
        common = float(combine_degrees(squares.sum(), zip(squares, degrees[own], strict=True)))
        p_value = min(e.p_value for e in ordered if _is_place(e.directions) == is_place)
        dimension = Dimension.LENGTH if is_place else Dimension.ANGLE
        axes = np.abs(amplitude[:, own]).max(axis=1).reshape(2, 3)[int(is_place)]
        finding = report_finding(
            DISCREPANCY,
            quantity="position" if is_place else "orientation",
            axes=tuple(a for a, size in zip("xyz", axes, strict=True) if size > NAMED * axes.max()),
            amplitude=fit.robot.to_quantity(float(np.sqrt(squares.max())), dimension),
            degrees=common,
            p_value=p_value,
            is_slow=slow.is_slow,
            level=LEVEL if slow.is_slow else REPEATS_LEVEL,
            severity=residual_test.choose_severity(
                p_value
            ),  # a warning where they are beyond doubt
        )
        fit = add_covariance(fit, of_part, common, finding)
    return replace(fit, posterior=replace(fit.posterior, discrepancy=discrepancy))


def find_dense_regions(fit: Identification, data: Measurements) -> IntArray | None:
    """Return the numbers (n,) of the regions of measured poses within which slow errors of a fit
    are alike, so that a pose beside fitted ones tests nothing; None where poses are farther apart
    than these errors, or share all of them.
    """
    own = fit.posterior.discrepancy
    if own is None or not own.errors.is_dense or not np.isfinite(data.readings).all():
        return None
    solution = forward(fit.robot, data.readings)
    if not solution.converged.all():
        return None
    regions = own.errors.group_regions(solution.T)
    return regions if len(statistics.find_distinct(regions)) >= FEWEST_REGIONS else None


def find_measured_directions(rows: SlowErrorRows) -> list[FloatArray]:
    """Return the directions (6, d) of the errors of place, then of rotation, that rows measure;
    they are base axes where the rows measure all three.
    """
    by_axis, listed = rows.rows.reshape(len(rows.rows), 6, -1), []
    for first in (3, 0):
        own = by_axis[:, first : first + 3]
        if not np.linalg.norm(own) > UNSEEN * np.linalg.norm(by_axis):
            continue
        information, axes = np.linalg.eigh(np.einsum("rak,rbk->ab", own, own))
        axes = axes[:, information > UNMEASURED_SHARE * information[-1]]
        # the same space by base axes, as far as it contains them
        chosen = choose_pivots(axes.T, True)
        directions = np.zeros((6, axes.shape[1]))
        directions[first : first + 3] = np.linalg.qr(axes @ axes[chosen].T)[0]
        listed.append(directions)
    return listed


def divide_by_direction(
    rows: SlowErrorRows, found: Sequence[SlowError], groups: Sequence[FloatArray], known: float
) -> tuple[SlowError, ...]:
    """Return errors that were found in some of the groups of directions, with a size for each
    direction whose own residuals show them; with a common size where none does by itself. Their
    p-values stay those with which they were found.
    """
    kinds = {_is_place(error.directions) for error in found}
    together = [directions for directions in groups if _is_place(directions) in kinds]
    single = [directions[:, [i]] for directions in together for i in range(directions.shape[1])]
    level = statistics.compute_any_probability(DIRECTION_LEVEL, len(single))
    shown = detect_slow_errors(rows, single, known, level)
    kinds = {_is_place(error.directions) for error in shown}
    rest = [directions for directions in together if _is_place(directions) not in kinds]
    divided = (*shown, *detect_slow_errors(rows, rest, known, 1.0))
    p_values = {_is_place(error.directions): error.p_value for error in found}
    return tuple(e._replace(p_value=p_values[_is_place(e.directions)]) for e in divided)


def detect_slow_errors(
    rows: SlowErrorRows, groups: Sequence[FloatArray], known: float, level: float = LEVEL
) -> tuple[SlowError, ...]:
    """Return the errors of groups of directions (6, d) that are significant, the most significant
    first.

    `known` degrees of freedom say that the residuals have unit variance. `level` : probability of
    finding any without such errors.
    """
    remaining, found = list(range(len(groups))), []
    level = statistics.compute_single_level(level, len(remaining))
    residuals, whitened = rows.residuals, rows.rows
    while remaining:
        turned = {i: _find_axes(_columns(whitened, rows.errors, groups[i])) for i in remaining}
        tests = {i: (w, u.T @ residuals) for i, (u, w) in turned.items()}
        p_values = {i: statistics.compute_component_tail(*test) for i, test in tests.items()}
        best = min(remaining, key=lambda each: p_values[each])
        if not p_values[best] <= level:
            break
        u, w = turned[best]
        # residuals that the errors cannot change say how large the noise is
        y = tests[best][1]
        rest = (max(float(residuals @ residuals - y @ y), 0.0), len(residuals) - len(y))
        typical = float(rows.residuals @ rows.residuals) / measure_size(rows, groups[best])
        size = statistics.estimate_variance_component(w, y, known, rest, typical)
        found.append(SlowError(groups[best], size, p_values[best]))
        # u diag(1 / sqrt(1 + ratio w)) u' + (I - u u')
        shrink = 1.0 / np.sqrt(1.0 + size.ratio * w) - 1.0
        residuals = residuals + (u * shrink) @ (u.T @ residuals)
        whitened = whitened + (u * shrink) @ (u.T @ whitened)
        remaining.remove(best)
    return tuple(found)


def project_slow_errors(linear: FitLinearization, errors: SmoothErrors) -> SlowErrorRows | None:
    """Return residuals and slow errors without what the parameters explain; None where there are
    too few different poses or residuals.
    """
    if len(errors.centers) < FEWEST_POSES:
        return None
    d, m, used = linear.decomposition, errors.count, linear.decomposition.used[0]
    k = int(used.sum())
    to_z = d.directions[0][:, used]
    penalty = np.where(np.isfinite(linear.penalty[0]), linear.penalty[0], 0.0)[used]
    prior = np.zeros((k, k + m + 1))
    prior[:, :k] = np.diag(np.sqrt(penalty))
    prior[:, -1] = np.sqrt(penalty) * d.coordinates(linear.linearization.deviation)[0][used]
    factor, p = fold_smooth_errors(linear, errors), len(used)
    factor = factor[factor.any(axis=1)]  # there may be fewer rows than coefficients
    # only the first rows of a triangle have columns of the parameters
    first = np.concatenate([factor[:p, :p] @ to_z, factor[:p, p:]], axis=1)
    top = np.asarray(np.linalg.qr(np.concatenate([first, prior[penalty > 0.0]]), mode="r"))
    rest = np.linalg.qr(np.concatenate([factor[p:, p:], top[k:, k:]]), mode="r")
    degrees = int(linear.linearization.equations[0] + (penalty > 0.0).sum()) - k
    if degrees < residual_test.FEWEST_DEGREES:
        return None
    slope = linear.fit.tolerance[:, None] * (to_z @ np.linalg.solve(top[:k, :k], top[:k, k:-1]))
    rest = np.asarray(rest[: min(m, degrees)])  # further rows are rounding
    triangle, residuals = rest[:, :m], rest[:, m]
    by_direction = factor[:, p : p + m].reshape(len(factor), -1, len(errors.centers))
    sizes = np.linalg.norm(by_direction, axis=(0, 2))
    if not np.linalg.norm(triangle) > UNSEEN * np.linalg.norm(sizes):
        return None
    return SlowErrorRows(errors, slope, triangle, residuals, sizes)


def _columns(rows: FloatArray, errors: SmoothErrors, directions: FloatArray) -> FloatArray:
    """Return the columns (r, d k) by errors in directions (6, d), from rows (r, m) by errors of
    unit amplitude in orthogonal directions that contain these.
    """
    shares = errors.amplitude.T @ directions
    by_direction = rows.reshape(len(rows), len(shares), -1)
    return np.einsum("rak,ad->rdk", by_direction, shares).reshape(len(rows), -1)


def _is_place(directions: FloatArray) -> bool:
    """Return whether directions (6, d) are of place; otherwise of rotation."""
    return bool(directions[3:].any())


def _find_axes(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the axes u (k, r) of the variances that rows (k, m) times independent errors have, and
    these variances (r,). Weak ones need no accuracy: they weigh little.
    """
    part = rows[filled := rows.any(axis=1)]  # a triangle has zeros below
    is_tall = part.shape[0] > part.shape[1]
    variances, inner = np.linalg.eigh(part.T @ part if is_tall else part @ part.T)
    kept = variances > NEGLIGIBLE * variances[-1]
    variances, inner = variances[kept], inner[:, kept]
    axes = np.zeros((len(rows), inner.shape[1]))
    axes[filled] = part @ (inner / np.sqrt(variances)) if is_tall else inner
    return axes, variances


# Singular values of the whiteners of repeats below this share of the largest belong to components
# that no repeat measured, which have no mean. Stated sigmas differ by less than that.
UNMEASURED = 1e-12
REPEATS_LEVEL = 0.01  # probability below which the lack of fit exceeds the pure error


@dataclass(frozen=True)
class LackOfFit:
    """Lack of fit against the pure error of repeated poses."""

    # the result of the test, and the repeatability where it contradicts the stated sigma
    findings: tuple[Finding, ...]
    groups: int = 0  # number of poses that were repeated
    pure: float = 0.0  # sum of squares between repeats in units of the stated sigma
    pure_degrees: int = 0
    sigma_scale: float = np.nan  # repeatability over the stated sigma
    lack: float = np.nan  # the remaining sum of squares of the fit
    lack_degrees: float = np.nan
    p_value: float = np.nan  # of a larger F if the model is right; NaN where there is no test
    is_explained: bool | None = None  # whether the model explains the data; None without a test

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("groups", "pure", "pure_degrees", "lack", "lack_degrees", "sigma_scale", "p_value"),
        *("findings",),
        explained="is_explained",
    )


NOT_COMPARABLE = "residuals.repeats-not-comparable"


def check_lack_of_fit(fit: Identification, data: Measurements) -> LackOfFit:
    """Test a fit against the pure error of repeated poses."""
    data = prepare_fitted_data(fit, data)
    if data.reading_sigma is not None:
        return LackOfFit((report_finding(NOT_COMPARABLE, reason="uncertain-readings"),))
    member = data.repeats
    times = np.bincount(member)
    pure, degrees = _pure_error(fit, data, member)
    lack = float(fit.history.cost[-1]) - pure
    lack_degrees = fit.residual_test.dof - degrees
    if degrees == 0:
        return LackOfFit((report_finding("residuals.no-repeats"),))
    scale = float(np.sqrt(pure / degrees))
    known = (int((times > 1).sum()), pure, degrees, scale)
    if fit.pose_weights.min(initial=1.0) < 1.0:
        return LackOfFit((report_finding(NOT_COMPARABLE, reason="weights"),), *known)
    if lack_degrees < 1.0 or pure <= 0.0:
        return LackOfFit((report_finding(NOT_COMPARABLE, reason="few-equations"),), *known)
    ratio = max(lack, 0.0) / lack_degrees / (pure / degrees)
    p_value = float(statistics.compute_f_tail(lack_degrees, degrees, ratio))
    findings = [report_finding("residuals.explained")]
    if p_value < REPEATS_LEVEL:
        findings = [report_finding("residuals.lack-of-fit", ratio=float(np.sqrt(ratio)))]
    tail = float(statistics.compute_chi_square_tail(degrees, scale**2 * degrees))
    if tail < residual_test.SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-larger", scale=scale))
    if tail > 1.0 - residual_test.SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-smaller", scale=scale))
    numbers = (*known, lack, lack_degrees, p_value, p_value >= REPEATS_LEVEL)
    return LackOfFit(tuple(findings), *numbers)


def _pure_error(fit: Identification, data: Measurements, member: IntArray) -> tuple[float, int]:
    """Sum of squares between repeats of a kind (of a corner), and its degrees of freedom."""
    problem, groups = problem_of(fit.free_parameters, data), []
    for rows in problem.rows:
        counts = [column.dimension is Dimension.COUNT for column in rows.kind.columns]
        numbers = np.nan_to_num(rows.measured[0][:, counts], nan=-1.0)
        same = np.column_stack([member[rows.poses_by_link], rows.nuisance, numbers])
        if rows.kind.is_of_base:  # rows of targets on the base repeat no pose
            same = np.arange(len(rows.poses))[:, None]
        groups.append(np.unique(same, axis=0, return_inverse=True)[1].ravel())
    total, degrees = 0.0, 0
    if all(len(statistics.find_distinct(of_rows)) == len(of_rows) for of_rows in groups):
        return total, degrees
    z = fit.free_parameters.deviation(fit.robot.values[None])
    residuals = problem.residuals(z, problem.solve(z, problem.start(z)))
    for rows, group_of_row, residual in zip(problem.rows, groups, residuals, strict=True):
        for group in np.flatnonzero(np.bincount(group_of_row) > 1):
            chosen = group_of_row == group
            W = rows.whitener[0, chosen]
            present = np.einsum("rii->ri", W) != 0.0
            A = W.reshape(-1, W.shape[-1])
            b = np.where(present, residual.whitened[0, chosen], 0.0).ravel()
            mean, _, rank, _ = np.linalg.lstsq(A, b, rcond=UNMEASURED)
            total += float(((b - A @ mean) ** 2).sum())
            degrees += int(present.sum()) - int(rank)
    return total, degrees
