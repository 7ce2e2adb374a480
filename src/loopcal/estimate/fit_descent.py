# SPDX-License-Identifier: Apache-2.0
"""The descents of one fit: with or without a loss, from the closure or the kinematics, and again
where the data ask for other tolerances than those of the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from loopcal import geometry
from loopcal.estimate.descent import Descent, StepControl, descend
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Start
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, Method, Ridge
from loopcal.estimate.pose_linearization import LinearizedPoses
from loopcal.estimate.prior_inflation import ROUNDS, choose_methods
from loopcal.estimate.problem import Problem, make_exact_problem
from loopcal.estimate.robust_descent import Run, descend_robustly
from loopcal.findings import Finding, report_finding
from loopcal.measure.kinds.kind import Evaluation
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
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

    first = descend(part, deviation, method, control, tolerance, progress=report)
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


def sum_squares(problem: Problem, deviation: FloatArray) -> float:
    """Return the whitened sum of squares of one trial at a deviation (1, p), without derivatives;
    infinite where a pose that a row needs is not reached.
    """
    is_lost = False

    def observe(i: int, poses: LinearizedPoses, evaluations: Sequence[Evaluation | None]) -> None:
        nonlocal is_lost
        del evaluations
        is_lost |= bool(poses.is_lost(problem.poses.blocks[i].is_needed)[0])

    with np.errstate(over="ignore", invalid="ignore"):  # poses out of reach
        solution = problem.solve(deviation, problem.start(deviation), derivatives=False)
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
        return descend(with_prior, z, method, control, tolerance, start, progress)

    located, first = locate_measured_poses(problem), None
    if located is not None:
        coarse = replace(control, relative=max(control.relative, RELATIVE))
        first = descend(problem.at_measured_poses(located), z, method, coarse, tolerance)
        z = np.where((first.status == DescentStatus.CONVERGED)[:, None], first.deviation, z)
    fit = descend(with_prior, z, method, control, tolerance, start, progress)
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
    """Descend with or without a loss; return also the weight (n,) of each pose and the problem with
    these weights.
    """
    run: Run = partial(fit_rows, options=options, progress=progress)
    if options.loss is None:
        return run(problem, z, None), np.ones(data.n_poses), problem
    estimated, blocks = options.noise == "estimated", linked_blocks(data)
    robust = descend_robustly(problem, blocks, options.loss, z, estimated, run, options.prior)
    return robust.fit, robust.weight, robust.problem


def fit_with_tolerances(
    problem: Problem,
    data: Measurements,
    z: FloatArray,
    options: FitOptions,
    free: FreeParameters,
    progress: Progress = report_no_progress,
) -> tuple[Descent, FloatArray, Problem, FitOptions]:
    """Descend, and again as long as the data ask for other components of the tolerances; return
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
    """Descend again in trials whose data ask for components of the tolerances."""
    for i, method in choose_methods(free, fit, get_method(options)).items():
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
    return fit


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
        return [report_finding("poses.closure-start-exhausted", steps=options.control.iterations)]
    if options.begin != "closure":
        return []
    if problem.is_uncertain:
        return [report_finding("poses.closure-start-uncertain-readings")]
    if locate_measured_poses(problem) is None:
        return [report_finding("poses.closure-start-incomplete-poses")]
    return []


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
