# SPDX-License-Identifier: Apache-2.0
"""The descents of one fit: with or without a loss, from the closure or the kinematics, and again
where the data ask for other spreads than those of the prior.

A robust fit descends, weighs each block by its distance from the fit, and repeats. The weights are
determined outside the descent and enter it as weights of the rows, so that every method,
decomposition and covariance is used as it is. Blocks are the poses that `Measurements.block`
declares to belong together, joined where a row links them; never a single component.

The uncertainty of a fit with a loss, where its residuals exceed the stated noise: with the weight
w(d) of a block of m residuals at distance d, the estimate solves sum A' w r = 0. Its covariance is
(Huber, Robust Statistics, 1981, section 7.6)

    K^2 (sum w^2 d^2 / (N - p)) / h^2 (A'A)^-1        h = sum (m w + d w'(d)) / N

with N residuals, p parameters, and K = 1 + p / N var((m w + d w') / m) / h^2. The weighted rows
give (A'WA)^-1 = (A'A)^-1 / mean w, for unit noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from loopcal import geometry
from loopcal.estimate.descent import Descent, StepControl, descend
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import LinearizedPoses, Start
from loopcal.estimate.losses import Huber, Loss, Tukey, weigh_blocks
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import HOLD, MAP, WEAKEST, LeastSquares, Method, Ridge
from loopcal.estimate.posterior import NOISE
from loopcal.estimate.prior_inflation import ROUNDS, choose_methods
from loopcal.estimate.problem import Problem, make_exact_problem
from loopcal.estimate.residual_test import SIGNIFICANCE
from loopcal.estimate.result import Identification, add_covariance
from loopcal.findings import Finding, report_finding
from loopcal.measure.kinds.kind import Evaluation
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.numerics import statistics
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.parameters import ParameterTable
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

SHARE = 16
"""A part has one of so many poses. Its estimate is about four standard deviations of all poses
away: from there, one step of all poses is enough for noise of 1e-5 m and rad, too."""
FEWEST_POSES = 65_536
"""A part is used from so many poses on. Processor time of fits of hexapod-42 with drawn errors, in
seconds with a part | without: noise of 1e-6 m and rad, 66,000 poses 0.49 | 0.49, 100,000 0.69 |
0.84; noise of 1e-5, 33,000 0.28 | 0.23, 66,000 0.44 | 0.73, 100,000 0.77 | 0.97. A fit that begins
at the truth needs no part and loses its time."""
EQUATIONS = 50
"""Equations of a part for each parameter, at least: its estimate is near enough then."""
METHODS = (LeastSquares, Ridge, MAP)
"""Methods whose estimate from a part of the poses is near that from all of them. A chosen number of
directions, for example, depends on how many equations there are."""

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def fit_part_first(
    problem: Problem,
    deviation: FloatArray,
    method: Method,
    control: StepControl,
    tolerance: float,
    progress: Progress = report_no_progress,
) -> Descent | None:
    """Descend from a deviation (1, p) with a part of the poses, and from there with all of them.

    None where a part cannot be used, where the residuals at the deviation are not finite, or where
    a descent does not converge within the steps of `control`. The history has the steps of the
    part, whose sums of squares are estimates for all poses: times the ratio of the numbers of
    equations.
    """
    part = select_part(problem) if type(method) in METHODS else None
    if part is None:
        return None
    count, at_start = part.readings.shape[1], sum_squares(problem, deviation)
    if not np.isfinite(at_start):
        return None

    def report(done: int, total: int, what: str) -> None:
        progress(done, total, f"{what} ({count} of {problem.readings.shape[1]} poses)")

    first = descend(part, deviation, method, control, tolerance, progress=report, ends_weak=True)
    if not _is_converged(first) or int(first.decomposition.rank[0]) < problem.parameters:
        return None
    left = control.iterations - int(first.iterations[0])
    if left <= 0:
        return None
    control = replace(control, iterations=left)
    fit = descend(problem, first.deviation, method, control, tolerance, progress=progress)
    if not _is_converged(fit):
        return None
    costs = first.cost_history * (problem.equations[0] / part.equations[0])
    costs[0], costs[-1] = at_start, fit.cost_history[0]
    return fit.after(replace(first, cost_history=costs))


def sum_squares(problem: Problem, deviation: FloatArray, start: Start | None = None) -> float:
    """Return the whitened sum of squares of one trial at a deviation (1, p), without derivatives;
    infinite where a pose that a row needs is not reached. `start`: where it is known already.
    """
    is_lost = False

    def observe(i: int, poses: LinearizedPoses, evaluations: Sequence[Evaluation | None]) -> None:
        nonlocal is_lost
        del evaluations
        is_lost |= bool(poses.is_lost(problem.poses.blocks[i].is_needed)[0])

    with np.errstate(over="ignore", invalid="ignore"):  # poses out of reach
        start = problem.start(deviation) if start is None else start
        solution = problem.solve(deviation, start, derivatives=False)
        residuals = problem.residuals(deviation, solution, observe)
        cost = sum(float(np.nansum(r.whitened**2)) for r in residuals)  # NaN: not measured
    return np.inf if is_lost else cost


def select_part(problem: Problem) -> Problem | None:
    """Return the problem of a spread part of the poses; None where the poses are too few, several
    trials are fitted at once, or something other than the free parameters and the readings
    determines the rows (`Problem.folds_plain_rows`).
    """
    n = problem.readings.shape[1]
    if not problem.folds_plain_rows or len(problem) != 1:
        return None
    count = n // SHARE
    if n < FEWEST_POSES or problem.equations[0] * count < EQUATIONS * problem.parameters * n:
        return None
    return take_poses(problem, spread_poses(n, count))


def spread_poses(n: int, count: int) -> IntArray:
    """Return `count` of n poses, one in each of as many equal ranges.

    Their places in the ranges follow the golden ratio, i G modulo 1. Whatever repeats in the order
    of the poses, as the lines of a grid do, every phase of it has its share.
    """
    i = np.arange(count)
    return np.floor((i + (i * GOLDEN) % 1.0) * (n / count)).astype(np.int64)


def take_poses(problem: Problem, poses: IntArray) -> Problem:
    """Return the problem of some poses (k,), ascending; every row must depend on one pose."""
    place = np.full(problem.readings.shape[1], -1)
    place[poses] = np.arange(len(poses))
    chosen = [np.flatnonzero(place[rows.poses] >= 0) for rows in problem.rows]
    rows = [r.take_rows(numbers, place) for r, numbers in zip(problem.rows, chosen, strict=True)]
    readings, trials = problem.readings[:, poses], len(problem)
    nothing = NuisanceParameters(ParameterTable(()), ())
    return make_exact_problem(problem.free, readings, tuple(rows), trials, nothing, problem.data)


def _is_converged(fit: Descent) -> bool:
    return bool(fit.status[0] == DescentStatus.CONVERGED.value)


def fit_rows(
    problem: Problem,
    z: FloatArray,
    start: Start | None,
    options: FitOptions,
    progress: Progress = report_no_progress,
) -> Descent:
    """Descend from deviations z (t, p); the history includes steps of the linearized closure.

    `progress` receives the steps.
    """
    method, control, tolerance = get_method(options), options.control, options.rank_tolerance
    with_prior = problem if options.prior is None else options.prior.added(problem)
    if options.begin == "kinematics":
        return descend(with_prior, z, method, control, tolerance, start, progress, ends_weak=True)

    located, first = locate_measured_poses(problem), None
    if located is not None:
        coarse = replace(control, relative=max(control.relative, RELATIVE))
        first = descend(problem.at_measured_poses(located), z, method, coarse, tolerance)
        z = np.where((first.status == DescentStatus.CONVERGED)[:, None], first.deviation, z)
    fit = descend(with_prior, z, method, control, tolerance, start, progress, ends_weak=True)
    if first is None:
        return fit
    is_exhausted = bool((first.status == DescentStatus.OUT_OF_ITERATIONS.value).any())
    return replace(fit.after(first), is_start_exhausted=is_exhausted)


def fit_with_loss(
    problem: Problem,
    data: Measurements,
    z: FloatArray,
    options: FitOptions,
    progress: Progress = report_no_progress,
) -> tuple[Descent, FloatArray, Problem]:
    """Descend with or without a loss (then one trial); return also the weight (n,) of each pose and
    the problem with these weights.

    Where sigmas are only known up to a factor, it is the median of the blocks' distances.
    """
    run = partial(fit_rows, options=options, progress=progress)
    fit = RobustFit(run(problem, z, None), problem, np.ones(data.n_poses))
    if (loss := options.loss) is None:
        return fit.fit, fit.weight, problem
    member = np.unique(linked_blocks(data), return_inverse=True)[1]
    is_estimated = options.noise == "estimated"

    def reweight(robust: RobustFit, loss: Loss, change: float) -> RobustFit:
        """Reweight until no weight changes by more than `change`."""
        for _ in range(REWEIGHTINGS):
            fit = robust.fit
            if fit.status[0] != DescentStatus.CONVERGED:
                break
            distance, degrees = measure_block_distances(
                problem, fit.deviation, fit.start, member, robust.problem
            )
            if is_estimated:
                distance = distance / estimate_scale_of(distance, degrees)
            weight = weigh_blocks(loss, distance, degrees)[member]
            if float(np.abs(weight - robust.weight).max()) <= change:
                break
            weighted = problem.weighted(weight)
            again = run(weighted, fit.deviation, fit.start).after(fit)
            robust = RobustFit(again, weighted, weight)
        return robust

    if fit.fit.status[0] not in (DescentStatus.CONVERGED, DescentStatus.BAD_START):
        # one row that is far off can prevent every step: blocks far from the start, whose error the
        # distance of the median block shows, are left out first
        distance, degrees = measure_block_distances(problem, z, problem.start(z), member, problem)
        weight = Tukey().weight(distance / estimate_scale_of(distance, degrees), degrees)[member]
        weighted = problem.weighted(weight)
        fit = RobustFit(run(weighted, z, None), weighted, weight)
    if getattr(loss, "is_redescending", False):
        fit = reweight(fit, Huber(), 100.0 * CONVERGED_CHANGE)
    fit = reweight(fit, loss, CONVERGED_CHANGE)
    if fit.problem is problem:
        return fit.fit, fit.weight, problem
    # the first cost is weighted as the last one, so that both compare
    whole = fit.problem if options.prior is None else options.prior.added(fit.problem)
    costs = fit.fit.cost_history.copy()
    costs[0] = whole.linearize(z, fit.fit.start).cost
    return replace(fit.fit, cost_history=costs), fit.weight, fit.problem


def fit_with_tolerances(
    problem: Problem,
    data: Measurements,
    z: FloatArray,
    options: FitOptions,
    free: FreeParameters,
    progress: Progress = report_no_progress,
) -> tuple[Descent, FloatArray, Problem, FitOptions]:
    """Descend, and again as long as the data ask for other components of the spreads; return
    also the options with these.
    """
    first = None
    # a loss needs all poses to tell which of them are far off, and the rows of an earlier
    # calibration would outweigh a part
    if options.begin == "kinematics" and options.loss is None and options.prior is None:
        method, tolerance = get_method(options), options.rank_tolerance
        first = fit_part_first(problem, z, method, options.control, tolerance, progress)
    if first is None:
        fit, weights, weighted = fit_with_loss(problem, data, z, options, progress)
    else:
        fit, weights, weighted = first, np.ones(data.n_poses), problem
    held = get_method(options).hold() if _find_weak(fit, get_method(options)).size else ()
    for i, method in enumerate(held):
        other = replace(options, method=method)
        again, new_weights, new_problem = fit_with_loss(problem, data, z, other, progress)
        if i == 0 or _is_converged(again):
            fit, weights, weighted, options = again.after(fit), new_weights, new_problem, other
            z = fit.deviation
    for _ in range(ROUNDS):
        method = choose_methods(free, fit, get_method(options)).get(0)
        if method is None:
            break
        other = replace(options, method=method)
        again, new_weights, new_problem = fit_with_loss(
            problem, data, fit.deviation, other, progress
        )
        if again.status[0] != DescentStatus.CONVERGED.value:
            break
        fit, weights, weighted, options = again.after(fit), new_weights, new_problem, other
    return fit, weights, weighted, options


def repeat_trials(
    problem: Problem, fit: Descent, options: FitOptions, free: FreeParameters
) -> Descent:
    """Descend again in trials whose data ask for components of the spreads, or determine some
    combination too weakly.
    """
    first, stated = fit, get_method(options)
    weak = _find_weak(fit, stated)
    for i, method in choose_methods(free, fit, stated).items():
        alone, chosen = np.array([i]), replace(options, method=method)
        own = problem.take(alone)
        again = fit_rows(own, fit.deviation[alone], None, chosen)
        for _ in range(ROUNDS - 1):
            other = choose_methods(free, again, get_method(chosen)).get(0)
            if other is None:
                break
            chosen = replace(options, method=other)
            again = fit_rows(own, again.deviation, None, chosen)
        if again.status[0] == DescentStatus.CONVERGED.value:
            fit = fit.put(alone, again)
    if weak.size:
        own, z = problem.take(weak), first.deviation_history[0][weak]
        chosen = [replace(options, method=method) for method in stated.hold()]
        again = fit_rows(own, z, None, chosen[0])
        for held in chosen[1:]:
            again = fit_rows(own, again.deviation, None, held)
        left = np.flatnonzero(again.status != DescentStatus.CONVERGED.value)
        if left.size and len(chosen) > 1:
            again = again.put(left, fit_rows(own.take(left), z[left], None, chosen[0]))
        fit = fit.put(weak, repeat_trials(own, again, chosen[-1], free))
    return fit


def _find_weak(fit: Descent, method: Method) -> IntArray:
    """Return the trials whose method must hold what data determine weakly: from a limit on where
    they did not converge, and from a higher one where they did.
    """
    if method.unpenalized(fit.deviation.shape[1]) is None:  # no decomposition is needed
        return np.zeros(0, dtype=np.int64)
    limit = np.where(fit.status == DescentStatus.CONVERGED.value, WEAKEST, HOLD)
    return np.flatnonzero(method.find_weak(fit.decomposition, limit).any(axis=1))


def get_method(options: FitOptions) -> Method:
    """Return the method, which `adapt_method` has set."""
    assert options.method is not None
    return options.method


RELATIVE = 1e-3
"""Share of the residual by which a step may still change it when the exact descent takes over."""

STEPS = 20
"""Newton steps by which a pose is located; a rotation vector takes one, angles a few."""


def report_closure_start(problem: Problem, options: FitOptions, fit: Descent) -> list[Finding]:
    """Return why the fit did not begin with the closure, where the options ask for it, or that
    the steps of this start ran out.
    """
    if fit.is_start_exhausted:
        reason = "exhausted"
    elif options.begin == "closure" and problem.is_uncertain:
        reason = "uncertain-readings"
    elif options.begin == "closure" and locate_measured_poses(problem) is None:
        reason = "incomplete-poses"
    else:
        return []
    steps = options.control.iterations
    return [report_finding("poses.closure-start-unused", reason=reason, steps=steps)]


def locate_measured_poses(problem: Problem) -> FloatArray | None:
    """Return the measured poses T_base_platform (t | 1, n, 4, 4).

    None where readings are uncertain or not all poses are measured in full, in a known frame.
    """
    robot = problem.free.robot
    passive = any(group.unknown_joints(False) for group in robot.program.groups)
    if robot.stages or passive or len(robot.program.freedoms) < 6:
        return None
    if problem.is_uncertain or len(problem.rows) != 1 or problem.nuisance is not None:
        return None
    (rows,) = problem.rows
    t, (r, m) = max(len(rows.measured), len(rows.whitener)), rows.whitener.shape[1:3]
    plain = rows.kind.poses_per_row == 1 and not rows.kind.sensed_joints
    n = problem.readings.shape[1]
    if not (m == 6 and plain and rows.is_present.all()):
        return None
    if not np.array_equal(rows.poses, np.arange(n)):
        return None
    T = np.broadcast_to(robot.home, (t, r, 4, 4))
    for _ in range(STEPS):
        evaluation = rows.kind.evaluate(T, rows.measured)
        solved = np.linalg.solve(evaluation.jacobian, evaluation.residual[..., None])[..., 0]
        step = -np.asarray(solved, dtype=np.float64)
        T = geometry.apply_twist(T, step)
        turn, shift = np.abs(step[..., :3]).max(), np.abs(step[..., 3:]).max()
        if turn < 1e-14 and shift < 1e-14 * robot.size:
            break
    return T if np.isfinite(T).all() else None


REWEIGHTINGS = 50
"""Reweightings, at most."""

CONVERGED_CHANGE = 1e-4
"""Largest change of a weight at which the weights have converged; a hundred times that where they
only begin another loss."""


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A robust descent.

    fit : descent of the weighted problem, after all those that determined the weights. The first of
        its costs, and those of the last descent, have these weights; those between have the weights
        of their rounds.
    problem : weighted. weight : (n,) of each pose, equal within a block.
    """

    fit: Descent
    problem: Problem
    weight: FloatArray


def measure_block_distances(
    problem: Problem, z: FloatArray, start: Start, member: IntArray, weighted: Problem
) -> tuple[FloatArray, FloatArray]:
    """Return d = |W r| (u,) and the number of residuals (u,) of every block at a deviation (1, p),
    with the nuisance parameters that fit `weighted` best; `member` (n,) is the block of each pose.
    """
    count = int(member.max()) + 1
    nuisance = None
    if problem.nuisance is not None:
        nuisance = weighted.solve(z, start).nuisance
    solution = problem.solve(z, start, nuisance)
    square, degrees = np.zeros(count), np.zeros(count)
    for rows, kind in zip(problem.rows, problem.residuals(z, solution), strict=True):
        blocks, present = member[rows.first_poses], rows.is_present[0]
        each = np.where(present, kind.whitened[0] ** 2, 0.0).sum(axis=1)
        square += np.bincount(blocks, each, count)
        degrees += np.bincount(blocks, present.sum(axis=1), count)
    if solution.estimates is not None:  # free poses take up residuals
        of_poses = member[problem.poses.first_pose]
        degrees -= np.bincount(of_poses, solution.estimates.rank[0], count)
    return np.sqrt(square), degrees


def estimate_scale_of(distance: FloatArray, degrees: FloatArray) -> float:
    """Return the factor on sigma that the median block shows.

    It is the median of d over the median of the chi distribution with the block's degrees.
    """
    is_tested = degrees > 0.0
    ratio = distance[is_tested] / np.sqrt(
        statistics.compute_chi_square_quantile(degrees[is_tested], 0.5)
    )
    middle = statistics.compute_median(ratio) if len(ratio) else 1.0
    return middle if middle > 0.0 else 1.0


NUDGE = 1e-4
"""Relative change of a distance for the derivative of a weight."""


def add_loss_uncertainty(
    result: Identification, fit: Descent, problem: Problem, weighted: Problem, blocks: IntArray
) -> Identification:
    """Return a fit with a loss whose covariance allows for residuals that exceed the noise in it.

    Without a loss, or where the residuals agree with the noise (p > 0.001), it stays as it is.
    """
    loss, test = result.options.loss, result.residual_test
    if loss is None or not (result.converged and test.intervals):
        return result
    member = np.unique(blocks, return_inverse=True)[1]
    distance, counts = measure_block_distances(problem, fit.deviation, fit.start, member, weighted)
    unit = estimate_scale_of(distance, counts) if test.noise == "estimated" else 1.0
    variance, left = compute_loss_variance(loss, distance, counts, result.rank, unit)
    times = variance / test.sigma_scale**2
    if left < 1.0 or statistics.compute_chi_square_tail(left, left * times) >= SIGNIFICANCE:
        return result
    roots = [part.root for part in result.posterior.parts if part.source == NOISE]
    root = np.sqrt(times - 1.0) * np.concatenate(roots, axis=1)
    finding = report_finding("noise.loss-contradicted", ratio=float(np.sqrt(times)))
    return add_covariance(result, root, left, finding)


def add_setup_uncertainty(result: Identification, fit: Descent) -> Identification:
    """Return a fit with the uncertainty that was stated of setup parameters, such as a scale.

    Residuals below the stated noise scale the covariance of all rows, by s^2, and so that of these
    statements, of which they show nothing: 1 - s^2 of their part is added.
    """
    test = result.residual_test
    if not (result.converged and test.intervals and test.sigma_scale < 1.0):
        return result
    setup = result.nuisance
    stated = setup.table.free & ~np.isnan(setup.table.tolerance)
    V, information = fit.decomposition.directions[0], fit.decomposition.singular_values[0] ** 2
    rows = (setup.slope[stated] / setup.table.tolerance[stated, None]) @ V
    used = fit.decomposition.used[0]
    change = np.divide(rows, information + fit.penalty[0], out=np.zeros_like(rows), where=used)
    own = setup.root.fill(np.arange(len(setup.table))) / test.sigma_scale
    by_prior = own @ own[stated].T / setup.table.tolerance[stated]
    root = np.vstack([result.tolerance[:, None] * (V @ change.T), by_prior])
    finding = report_finding("noise.setup-as-stated", scale=test.sigma_scale)
    root *= np.sqrt(1.0 - test.sigma_scale**2)
    return add_covariance(result, root, np.inf, finding)


def compute_loss_variance(
    loss: Loss, distance: FloatArray, counts: FloatArray, rank: int, unit: float = 1.0
) -> tuple[float, float]:
    """Return the variance of the noise that the covariance of the weighted rows must contain, and
    its degrees of freedom, from norm and number (u,) of the whitened residuals of each block. The
    loss divides distances by `unit`.
    """
    weight = loss.weight(distance / unit, counts)
    longer = loss.weight(distance * (1.0 + NUDGE) / unit, counts)
    slope = (longer - loss.weight(distance * (1.0 - NUDGE) / unit, counts)) / (2.0 * NUDGE)
    total, is_tested = float(counts.sum()), counts > 0.0
    left = total - rank
    influence = counts * weight + slope
    gain = float(influence.sum()) / total
    mean_weight = float((counts * weight).sum()) / total
    if left < 1.0 or gain <= 0.0:
        return np.nan, 0.0
    each = influence[is_tested] / counts[is_tested]
    correction = 1.0 + rank / total * float(np.var(each)) / gain**2
    square = float(((weight * distance) ** 2).sum()) / left
    return correction**2 * square * mean_weight / gain**2, left
