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
from loopcal.planning.design_space import (
    A,
    Criterion,
    E,
    I,
    evaluate_criterion,
    factor_design,
    is_allowed,
)
from loopcal.planning.exchange import EXCHANGES, choose_design
from loopcal.planning.path import order_poses
from loopcal.planning.prediction import ExpectedErrors
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

    Returns
    -------
    Plan

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
    options = problem.options
    if options.goal is not None:
        return _plan_for_goal(problem, progress)
    number = N_POSES if options.n_poses is None else options.n_poses
    result = _plan_number(problem, number, progress)
    if not options.curve:
        return result
    return replace(result, curve=compute_error_curve(problem, progress))


def _plan_for_goal(problem: PlanningProblem, progress: Progress) -> Plan:
    """Plan the smallest number of poses whose expected error reaches the goal."""
    options, k = problem.options, problem.poses_per_group
    curve = find_sample_size(problem, progress)
    assert curve.enough is not None, "a goal was given"
    assert options.goal is not None, "a goal was given"
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
            counted=problem.group_name,
            criterion=options.criterion,
            expected=curve.enough,
        )
    )


def _plan_number(problem: PlanningProblem, n_poses: int, progress: Progress) -> Plan:
    """Plan a number of poses."""
    k, robot, options = problem.poses_per_group, problem.robot, problem.options
    n_held_out = _require_numbers(problem, n_poses)
    n = n_poses // k
    problem.require_equations(n)
    criterion = problem.build_criterion()
    rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(1,)))
    held_out = _draw_held_out(problem, n_held_out // k, rng)
    rows, members = np.array(problem.groups.rows), problem.groups.members
    rows[np.isin(members, members[held_out]).any(axis=1)] = np.nan
    left = int(is_allowed(rows).sum())
    if left < n:
        raise EstimationError(
            report_finding(
                "plan.too-few-candidates", requested=n, what=problem.group_name, available=left
            )
        )
    best = choose_design(
        rows, n, criterion, problem.prior, options.seed, PERTURBATIONS, gap=GAP, progress=progress
    )
    chosen = best.design.chosen
    after = problem.predict_errors(chosen)
    assert after is not None, "the exchange determines every direction"
    forecast = ErrorForecast(
        before=problem.predict_errors(np.zeros(0, dtype=np.int64)),
        random=_predict_random(problem, n, criterion, rng),
        after=after,
        frame=problem.prediction.frame.describe(axes=""),
    )
    factor = factor_design(rows[chosen], problem.prior, problem.space)
    criteria: tuple[Criterion, ...] = (
        problem.build_criterion("D"),
        problem.build_criterion("I"),
        A(),
        E(),
    )
    quality = DesignQuality(
        {c.name: evaluate_criterion(c, factor, problem.space.machine) for c in criteria},
        min(best.efficiency, 1.0),
        int(is_allowed(rows).sum()),
    )
    poses, is_order_short = _arrange_poses(problem, chosen, held_out)
    notes = list(_collect_notes(problem))
    if not best.design.is_converged:
        counts = {"counted": problem.group_name, "exchanges": EXCHANGES * n}
        notes.append(report_finding("plan.exchanges-exhausted", **counts))
    if not is_order_short:
        notes.append(report_finding("plan.order-exhausted"))
    return Plan(robot, problem.instrument, options, poses, quality, forecast, tuple(notes))


def _require_numbers(problem: PlanningProblem, n_poses: int) -> int:
    """Return the number of poses to hold out; refuse impossible numbers."""
    k, hold_out = problem.poses_per_group, problem.options.hold_out
    default = max(n_poses // FITTED_PER_HELD_OUT // k, -(-FEW_ROWS // k)) * k
    n_held_out = default if hold_out is None else hold_out
    for use, number, least in (("for the fit", n_poses, 1), ("to hold out", n_held_out, 0)):
        if number < least or number % k:
            multiples = (
                f", in multiples of {k} because the instrument compares {k} poses" if k > 1 else ""
            )
            raise EstimationError(f"{number} poses {use}; give {least} or more{multiples}")
    return n_held_out


def _list_uniform_groups(problem: PlanningProblem) -> IntArray:
    """Return the groups whose poses were drawn evenly."""
    groups = problem.groups
    uniform = problem.candidates.is_uniform[groups.members].all(axis=1)
    return np.flatnonzero(uniform & is_allowed(groups.rows))


def _draw_held_out(problem: PlanningProblem, count: int, rng: np.random.Generator) -> IntArray:
    """Draw groups (count,) for validation: of evenly drawn poses, no pose in two of them."""
    chosen: list[int] = []
    used: set[int] = set()
    for group in rng.permutation(_list_uniform_groups(problem)).tolist():
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
                counted=problem.group_name,
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
    members = problem.groups.members
    selected = members[np.concatenate([chosen, held_out])]
    poses = np.unique(selected)
    candidates = problem.candidates
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
    factors = np.array(
        [find_unit(robot.units[actuator.dimension]).factor_to_si for actuator in robot.actuators]
    )
    scale = np.array(
        [
            robot.size if actuator.dimension is Dimension.LENGTH else 1.0
            for actuator in robot.actuators
        ]
    )
    steps = 10.0 ** (np.floor(np.log10(scale / factors)) - DIGITS)
    # + 0: no reading is -0
    return np.round(readings / factors / steps) * steps * factors + 0.0


def _predict_random(
    problem: PlanningProblem, n: int, criterion: Criterion, rng: np.random.Generator
) -> ExpectedErrors | None:
    """Return the errors of the median, by I, of some sets of n evenly drawn groups.

    None where there are too few.
    """
    uniform = _list_uniform_groups(problem)
    if len(uniform) < n:
        return None
    criterion = criterion if isinstance(criterion, I) else problem.build_criterion("I")
    sets = [rng.choice(uniform, n, replace=False) for _ in range(DRAWS)]
    values = []
    for chosen in sets:
        factor = factor_design(problem.groups.rows[chosen], problem.prior, problem.space)
        values.append(evaluate_criterion(criterion, factor, problem.space.machine))
    return problem.predict_errors(sets[int(np.argsort(values)[DRAWS // 2])])


def _collect_notes(problem: PlanningProblem) -> tuple[Finding, ...]:
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
    return tuple(notes)
