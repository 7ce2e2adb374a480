# SPDX-License-Identifier: Apache-2.0
"""Test whether the residuals of a fit vary slowly with the pose, and add what they show to its
uncertainty.

With the whitened rows A of the parameters, the rows of the prior, and the rows Phi of slow errors
of the poses (`SmoothErrors`), the elimination of the parameters leaves (y, S) of the residuals and
Phi. If the model is right, y has the variance sigma^2; with errors of amplitude tau it has
sigma^2 + tau^2 S S'. The test compares residuals by their weights alone: it needs no sigma, and
does not depend on the order of the poses. Displacements and rotations of the tool are tested one
after the other, the more significant first. See docs/theory/uncertainty.md.

The lack of fit is tested against the pure error of repeated poses, which have equal predictions:
SS_pure = sum over groups min over mu of |W (r - mu)|^2, SS_lack = RSS - SS_pure, and SS_lack /
dof_lack over SS_pure / dof_pure has an F distribution if the model is right, whatever the true
sigma is. Source: Draper and Smith, Applied Regression Analysis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from loopcal.diagnose.residual_patterns import LEVEL
from loopcal.estimate.fit_linearization import FitLinearization, linearize_smooth_errors
from loopcal.estimate.identification import prepare_fitted_data
from loopcal.estimate.posterior import DISCREPANCY, ModelDiscrepancy
from loopcal.estimate.problem import problem_of
from loopcal.estimate.residual_test import (
    FEWEST_DEGREES,
    SIGNIFICANCE,
    choose_severity,
    count_sigma_degrees,
)
from loopcal.estimate.result import Identification, add_covariance
from loopcal.estimate.smooth_errors import SmoothErrors, describe_smooth_errors
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.numerics.statistics import (
    VarianceComponent,
    compute_chi_square_tail,
    compute_component_tail,
    compute_f_tail,
    compute_single_level,
    estimate_variance_component,
    find_distinct,
)
from loopcal.results.description import Field, fields
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

FEWEST_POSES = 5  # different poses below which nothing can be said of how errors vary with the pose
# Share of the effect of errors on the rows below which the parameters take up all of it.
UNSEEN = 1e-8
NEGLIGIBLE = 1e-12  # share of the largest variance by slow errors below which one is rounding
# Lengths over which slow errors vary, in halves of the range of a coordinate, and whether they
# vary with the rotation of the platform: a wave over the workspace, and slower ones.
KERNELS = ((0.6, False), (1.7, True))
# Length, in halves of the range, over which errors vary that no two poses share, and most poses
# for these.
ROUGH, MOST_ROUGH = 1e-3, 150
ROTATION, PLACE = 0, 1  # number of the errors of rotation and of place


class SlowErrorRows(NamedTuple):
    """What the elimination of the parameters leaves of residuals and slow errors."""

    errors: SmoothErrors  # of unit amplitude
    slope: FloatArray  # (p, m) change of the estimates [SI] with the coefficients
    rows: FloatArray  # (m, m) S
    residuals: FloatArray  # (m,) y


class SlowErrors(NamedTuple):
    """Slow errors that residuals show."""

    rows: SlowErrorRows  # that show them
    # PLACE or ROTATION -> size and probability of these errors
    components: Mapping[int, tuple[VarianceComponent, float]]
    is_slow: bool = True  # whether neighboring poses share them; otherwise each pose has its own


def find_slow_errors(linear: FitLinearization, T: FloatArray) -> SlowErrors | None:
    """Return the slow errors that the residuals of a fit with intervals show at its measured poses
    T (n, 4, 4) [m]; None without any, or where nothing can be tested.
    """
    fit, tool = linear.fit, linear.fit.robot.tool[:3, 3]
    # deviations from nominal show errors, too, but only as far as the tolerances are right
    if len(T) < FEWEST_POSES or fit.residual_test.degrees < FEWEST_DEGREES:
        return None
    kernels = (
        describe_smooth_errors(T, tool, fit.robot.size, length, by_rotation=by_rotation)
        for length, by_rotation in KERNELS
    )
    projected = (project_slow_errors(linear, errors) for errors in kernels)
    tested = [rows for rows in projected if rows is not None]
    level = compute_single_level(LEVEL, len(tested))
    known = count_sigma_degrees(fit.residual_test.noise, fit.options.sigma_uncertainty)
    slow = [SlowErrors(rows, detect_slow_errors(rows, known, level)) for rows in tested]
    slow = [each for each in slow if each.components]
    if slow:
        return min(slow, key=lambda each: min(p for _, p in each.components.values()))
    return find_rough_errors(linear, T)


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
    components = {}
    for part in (part for part in (PLACE, ROTATION) if _is_seen(rows, part)):
        u, w = _find_axes(rows.rows[:, _columns(rows.errors, part)])
        y = (u.T @ rows.residuals) / lack.sigma_scale
        p_value = float(compute_f_tail(len(y), lack.pure_degrees, float(y @ y) / len(y)))
        if p_value < REPEATS_LEVEL:
            size = estimate_variance_component(w, y, lack.pure_degrees)
            variance = size.variance * lack.sigma_scale**2
            components[part] = (size._replace(variance=variance), p_value)
    return SlowErrors(rows, components, is_slow=False) if components else None


def add_slow_errors(fit: Identification, slow: SlowErrors) -> Identification:
    """Return a fit whose uncertainty includes slow errors that were found in its residuals.

    The parameters get what the errors do to them, and poses what is left of them. Estimates stay.
    """
    rows, first = slow.rows, fit.posterior
    amplitude, degrees = np.zeros(6), np.full(2, np.inf)
    for part, (component, _) in slow.components.items():
        amplitude[3 * part : 3 * part + 3] = np.sqrt(component.variance)
        degrees[part] = component.degrees
    errors = rows.errors.scaled(amplitude)
    root = rows.slope * np.repeat(amplitude, rows.errors.count // 6)
    for part, (component, p_value) in slow.components.items():
        dimension = (Dimension.ANGLE, Dimension.LENGTH)[part]
        finding = report_finding(
            DISCREPANCY,
            quantity=("orientation", "position")[part],
            amplitude=fit.robot.to_quantity(float(np.sqrt(component.variance)), dimension),
            degrees=component.degrees,
            p_value=p_value,
            is_slow=slow.is_slow,
            level=LEVEL if slow.is_slow else REPEATS_LEVEL,
            severity=choose_severity(p_value),  # a warning where they are beyond doubt
        )
        own = root[:, _columns(rows.errors, part)]
        fit = add_covariance(fit, own, component.degrees, finding)
    discrepancy = ModelDiscrepancy(errors, root, degrees, first.directions, first.variance)
    return replace(fit, posterior=replace(fit.posterior, discrepancy=discrepancy))


def detect_slow_errors(
    rows: SlowErrorRows, known: float, level: float = LEVEL
) -> dict[int, tuple[VarianceComponent, float]]:
    """Return the significant errors, the number of each -> its size and probability.

    `known` degrees of freedom say that the residuals have unit variance. `level` : probability of
    finding any without such errors.
    """
    remaining = [part for part in (PLACE, ROTATION) if _is_seen(rows, part)]
    level = compute_single_level(level, len(remaining))
    residuals, whitened, components = rows.residuals, rows.rows, {}
    while remaining:
        turned = {part: _find_axes(whitened[:, _columns(rows.errors, part)]) for part in remaining}
        tests = {part: (w, u.T @ residuals) for part, (u, w) in turned.items()}
        p_values = {part: compute_component_tail(*test) for part, test in tests.items()}
        part = min(remaining, key=lambda each: p_values[each])
        if p_values[part] >= level:
            break
        u, w = turned[part]
        component = estimate_variance_component(*tests[part], known)
        components[part] = (component, p_values[part])
        # u diag(1 / sqrt(1 + ratio w)) u' + (I - u u')
        shrink = 1.0 / np.sqrt(1.0 + component.ratio * w) - 1.0
        residuals = residuals + (u * shrink) @ (u.T @ residuals)
        whitened = whitened + (u * shrink) @ (u.T @ whitened)
        remaining.remove(part)
    return components


def project_slow_errors(linear: FitLinearization, errors: SmoothErrors) -> SlowErrorRows | None:
    """Return residuals and slow errors without what the parameters explain; None where there are
    too few different poses or residuals.
    """
    if len(errors.centers) < FEWEST_POSES:
        return None
    extended = linearize_smooth_errors(linear, errors)
    d, m, used = linear.decomposition, errors.count, linear.decomposition.used[0]
    k = int(used.sum())
    to_z = d.directions[0][:, used]
    penalty = np.where(np.isfinite(linear.penalty[0]), linear.penalty[0], 0.0)[used]
    prior = np.zeros((k, k + m + 1))
    prior[:, :k] = np.diag(np.sqrt(penalty))
    prior[:, -1] = np.sqrt(penalty) * d.coordinates(linear.linearization.deviation)[0][used]
    factor = extended.factor[0]
    factor = factor[factor.any(axis=1)]  # there may be fewer rows than coefficients
    p = len(used)
    columns = np.concatenate([factor[:, :p] @ to_z, factor[:, p:]], axis=1)
    R = np.asarray(np.linalg.qr(np.concatenate([columns, prior[penalty > 0.0]]), mode="r"))
    degrees = int(extended.equations[0] + (penalty > 0.0).sum()) - k
    if degrees < FEWEST_DEGREES:
        return None
    slope = linear.fit.tolerance[:, None] * (to_z @ np.linalg.solve(R[:k, :k], R[:k, k : k + m]))
    triangle, residuals = R[k : k + m, k : k + m], R[k : k + m, k + m]
    size = np.linalg.norm(factor[:, p : p + m])
    if not np.linalg.norm(triangle) > UNSEEN * size:
        return None
    return SlowErrorRows(errors, slope, triangle, residuals)


def _columns(errors: SmoothErrors, part: int) -> slice:
    """Return the coefficients of the errors of rotation or of place."""
    half = errors.count // 2
    return slice(part * half, (part + 1) * half)


def _find_axes(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the axes u (k, r) of the variances that rows (k, m) times independent errors have, and
    these variances (r,). Weak ones need no accuracy: they weigh little.
    """
    filled = rows.any(axis=1)  # a triangle has zeros below
    part, basis = rows[filled], None
    if part.shape[0] > part.shape[1]:
        basis, part = np.linalg.qr(part)
    variances, inner = np.linalg.eigh(part @ part.T)
    kept = variances > NEGLIGIBLE * variances[-1]
    inner = inner[:, kept]
    axes = np.zeros((len(rows), inner.shape[1]))
    axes[filled] = inner if basis is None else basis @ inner
    return axes, variances[kept]


def _is_seen(rows: SlowErrorRows, part: int) -> bool:
    """Return whether the residuals can show errors of rotation or of place."""
    own = rows.rows[:, _columns(rows.errors, part)]
    return bool(len(own)) and bool(np.linalg.norm(own) > UNSEEN * np.linalg.norm(rows.rows))


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


def check_lack_of_fit(fit: Identification, data: Measurements) -> LackOfFit:
    """Test a fit against the pure error of repeated poses."""
    data = prepare_fitted_data(fit, data)
    if data.reading_sigma is not None:
        return LackOfFit((report_finding("residuals.repeats-with-uncertain-readings"),))
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
        return LackOfFit((report_finding("residuals.repeats-with-weights"),), *known)
    if lack_degrees < 1.0 or pure <= 0.0:
        return LackOfFit((report_finding("residuals.repeats-only"),), *known)
    ratio = max(lack, 0.0) / lack_degrees / (pure / degrees)
    p_value = float(compute_f_tail(lack_degrees, degrees, ratio))
    findings = [report_finding("residuals.explained")]
    if p_value < REPEATS_LEVEL:
        findings = [report_finding("residuals.lack-of-fit", ratio=float(np.sqrt(ratio)))]
    tail = float(compute_chi_square_tail(degrees, scale**2 * degrees))
    if tail < SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-larger", scale=scale))
    if tail > 1.0 - SIGNIFICANCE:
        findings.append(report_finding("residuals.repeatability-smaller", scale=scale))
    numbers = (*known, lack, lack_degrees, p_value, p_value >= REPEATS_LEVEL)
    return LackOfFit(tuple(findings), *numbers)


def _pure_error(fit: Identification, data: Measurements, member: IntArray) -> tuple[float, int]:
    """Sum of squares between repeats, and its degrees of freedom; each kind has its own means."""
    problem, groups = problem_of(fit.free_parameters, data), []
    for rows in problem.rows:
        same = np.column_stack([member[rows.poses_by_link], rows.nuisance])
        if rows.kind.is_of_base:  # rows of targets on the base repeat no pose
            same = np.arange(len(rows.poses))[:, None]
        groups.append(np.unique(same, axis=0, return_inverse=True)[1].ravel())
    total, degrees = 0.0, 0
    if all(len(find_distinct(of_rows)) == len(of_rows) for of_rows in groups):
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
