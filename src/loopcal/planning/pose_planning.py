# SPDX-License-Identifier: Apache-2.0
"""Plan which poses to measure, so that the tool is predicted best all over the workspace.

Candidates satisfy every constraint. The convex relaxation gives the bound, exchange the poses. The
validation poses are drawn evenly, and a short path visits all of them. Theory:
docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.apply.validation import FEW_ROWS
from loopcal.errors import EstimationError
from loopcal.findings import Finding, report_finding
from loopcal.measure.instrument import Instrument
from loopcal.mechanism.model import Mechanism
from loopcal.planning.constraints import N_POSES, PlanOptions
from loopcal.planning.design_space import Criterion, evaluate_criterion, factor_design, is_allowed
from loopcal.planning.exchange import EXCHANGES, choose_design
from loopcal.planning.path import order_poses
from loopcal.planning.problem import (
    PlanningProblem,
    compute_error_curve,
    find_sample_size,
    prepare_problem,
)
from loopcal.planning.result import DesignQuality, ErrorForecast, Plan, PlannedPoses
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress
from loopcal.units import Dimension, find_unit

# Number of perturbations of a design: more of them gain some tenths of a per cent.
PERTURBATIONS = 10
GAP = 5e-3  # gap of the efficiency up to which the bound is computed
DRAWS = 20  # sets of evenly drawn poses that a plan is compared with
# Decimal places of the robot's size, in its unit, or of a radian, to which readings are stated.
DIGITS = 8
# Largest number of times that poses are added where a goal is missed because some are held out.
EXTENSIONS = 12
# Poses of the fit for each validation pose, by default. At least FEW_ROWS poses are held out:
# fewer leave the verdict of a calibration undecided.
FITTED_PER_HELD_OUT = 4


def plan(
    robot: Mechanism,
    instrument: Instrument,
    n_poses: int | None = None,
    criterion: str | None = None,
    options: PlanOptions | None = None,
    progress: Progress = report_no_progress,
) -> Plan:
    """Plan the poses to measure.

    Parameters
    ----------
    robot : at its present values. instrument : what will measure, with its noise.
    n_poses, criterion : short for these options.
    options : constraints, candidates, goal, earlier measurements, seed; see `PlanOptions`.
    progress : receives the steps that are done.

    Raises
    ------
    EstimationError
        Fewer equations than unknowns, an unknown criterion, a goal out of reach, or a number of
        poses that is not possible.
    MechanismError
        The constraints exclude the whole workspace.
    """
    options = options or PlanOptions()
    if n_poses is not None:
        options = replace(options, n_poses=n_poses)
    if criterion is not None:
        options = replace(options, criterion=criterion)
    return plan_poses(prepare_problem(robot, instrument, options), progress)


def plan_poses(problem: PlanningProblem, progress: Progress = report_no_progress) -> Plan:
    """Plan the poses of a prepared problem; see `plan`."""
    options, k = problem.options, problem.poses_per_group
    if options.goal is None:
        number = N_POSES if options.n_poses is None else options.n_poses
        result = _plan_number(problem, number, progress)
        if not options.curve:
            return result
        return replace(result, curve=compute_error_curve(problem, progress))
    curve = find_sample_size(problem, progress)
    assert curve.enough is not None, "a goal was given"
    n = curve.enough
    # Validation poses are taken from the candidates, and D is not what the goal counts: both can
    # cost some more poses.
    for _ in range(EXTENSIONS):
        result = _plan_number(problem, n * k, progress)
        if result.errors.after.select(options.target, problem.prediction.size) <= options.goal:
            return replace(result, curve=replace(curve, enough=n))
        n += max(n // 20, 1)
    raise EstimationError(
        report_finding(
            "plan.goal-missed",
            number=n,
            counted=problem.counted,
            criterion=options.criterion,
            expected=curve.enough,
        )
    )


def _plan_number(problem: PlanningProblem, n_poses: int, progress: Progress) -> Plan:
    """Plan a number of poses."""
    k, robot, options, groups = (
        problem.poses_per_group,
        problem.robot,
        problem.options,
        problem.groups,
    )
    default = max(n_poses // FITTED_PER_HELD_OUT // k, -(-FEW_ROWS // k)) * k
    n_held_out = default if options.hold_out is None else options.hold_out
    for use, number, least in (("for the fit", n_poses, 1), ("to hold out", n_held_out, 0)):
        if number < least or number % k:
            multiples = (
                f", in multiples of {k} because the instrument compares {k} poses" if k > 1 else ""
            )
            raise EstimationError(f"{number} poses {use}; give {least} or more{multiples}")
    n = n_poses // k
    problem.require_equations(n)
    rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(1,)))
    # groups whose poses were drawn evenly
    is_uniform = problem.candidates.is_uniform[groups.members].all(axis=1)
    uniform = np.flatnonzero(is_uniform & is_allowed(groups.rows))
    held_out = _draw_held_out(problem, n_held_out // k, rng.permutation(uniform))
    rows = np.array(groups.rows)
    rows[np.isin(groups.members, groups.members[held_out]).any(axis=1)] = np.nan
    design = problem.pose_design(rows)
    left = len(design.allowed)
    if left < n:
        counts = {"requested": n, "what": problem.counted, "available": left}
        raise EstimationError(report_finding("plan.too-few-candidates", **counts))
    best = choose_design(design, n, options.seed, PERTURBATIONS, gap=GAP, progress=progress)
    chosen = best.chosen
    after = problem.predict_errors(chosen)
    assert after is not None, "the exchange determines every direction"
    by_error = problem.build_criterion("I")
    random = None
    if len(uniform) >= n:  # the median, by I, of some sets of evenly drawn groups
        sets = [rng.choice(uniform, n, replace=False) for _ in range(DRAWS)]
        values = [_evaluate(problem, by_error, drawn) for drawn in sets]
        random = problem.predict_errors(sets[int(np.argsort(values)[DRAWS // 2])])
    forecast = ErrorForecast(
        before=problem.predict_errors(np.zeros(0, dtype=np.int64)),
        random=random,
        after=after,
        frame=problem.prediction.frame.describe(axes=""),
    )
    criteria = (Criterion("D"), by_error, Criterion("A"), Criterion("E"))
    quality = DesignQuality(
        {c.name: _evaluate(problem, c, chosen) for c in criteria}, min(best.efficiency, 1.0), left
    )
    poses, is_order_short = _arrange_poses(problem, chosen, held_out)
    notes = _collect_notes(problem)
    if not best.is_converged:
        counts = {"counted": problem.counted, "exchanges": EXCHANGES * n}
        notes.append(report_finding("plan.exchanges-exhausted", **counts))
    if not is_order_short:
        notes.append(report_finding("plan.order-exhausted"))
    return Plan(robot, problem.instrument, options, poses, quality, forecast, tuple(notes))


def _evaluate(problem: PlanningProblem, criterion: Criterion, chosen: IntArray) -> float:
    """Return a criterion of groups (n,) in the directions that all candidates determine."""
    factor = factor_design(problem.groups.rows[chosen], problem.prior, problem.space)
    return evaluate_criterion(criterion, factor, problem.space.machine)


def _draw_held_out(problem: PlanningProblem, count: int, drawn: IntArray) -> IntArray:
    """Return the first `count` of the drawn groups that have no pose in common."""
    chosen: list[int] = []
    used: set[int] = set()
    for group in drawn.tolist():
        if len(chosen) == count:
            break
        poses = problem.groups.members[group].tolist()
        if not used & set(poses):
            chosen.append(group)
            used.update(poses)
    if len(chosen) < count:
        raise EstimationError(
            report_finding(
                "plan.too-few-held-out",
                requested=count,
                counted=problem.counted,
                candidates=len(problem.candidates),
                available=len(chosen),
            )
        )
    return np.array(chosen, dtype=np.int64)


def _arrange_poses(
    problem: PlanningProblem, chosen: IntArray, held_out: IntArray
) -> tuple[PlannedPoses, bool]:
    """Return the poses of groups for the fit and for validation in the order of visiting, and
    whether the search for a short order came to its end.
    """
    members, candidates = problem.groups.members, problem.candidates
    selected = members[np.concatenate([chosen, held_out])]
    poses = np.unique(selected)
    visit = order_poses(candidates.checker, candidates.coordinates[poses])
    ordered = poses[visit.order]
    place = np.empty(len(candidates), dtype=np.int64)
    place[ordered] = np.arange(len(ordered))
    numbers = [int(name) for name in problem.used_names if name.isdecimal()]
    planned = PlannedPoses(
        tuple(str(max(numbers, default=0) + i) for i in range(1, len(ordered) + 1)),
        candidates.coordinates[ordered],
        _round_readings(problem.robot, candidates.solution.q[ordered]),
        np.isin(ordered, members[held_out]),
        visit.via_home,
        place[selected],
        visit.length,
    )
    return planned, visit.is_converged


def _round_readings(robot: Mechanism, readings: FloatArray) -> FloatArray:
    """Round readings (m, a) to DIGITS in the robot's units: a person can type them, and no
    instrument resolves the difference.
    """
    dimensions = [actuator.dimension for actuator in robot.actuators]
    factors = np.array([find_unit(robot.units[d]).factor_to_si for d in dimensions])
    scale = np.array([robot.size if d is Dimension.LENGTH else 1.0 for d in dimensions])
    steps = 10.0 ** (np.floor(np.log10(scale / factors)) - DIGITS)
    # + 0: no reading is -0
    return np.round(readings / factors / steps) * steps * factors + 0.0


def _collect_notes(problem: PlanningProblem) -> list[Finding]:
    """Return findings on what was assumed and excluded."""
    p, rank, assumed = len(problem.free), int(problem.observable.rank[0]), problem.free.assumed
    notes = [problem.candidates.report()]
    if assumed.any():
        notes.append(
            report_finding("plan.tolerances-missing", missing=int(assumed.sum()), parameters=p)
        )
    frame = problem.prediction.frame
    if frame.fitted or frame.undetermined:
        frames = frame.fitted or frame.undetermined
        notes.append(report_finding("plan.frames-undetermined", frames=frames))
    if rank < p:
        notes.append(report_finding("plan.unobservable", count=p - rank, parameters=p))
    return notes
