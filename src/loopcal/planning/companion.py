# SPDX-License-Identifier: Apache-2.0
"""A companion while measuring: does a row fit, how accurate is the robot by now, what comes next.

The state of a session goes in and comes out: the rows measured so far, which of them are used, and
the fit to these. It knows no terminal and no file. The fit is the maximum a posteriori estimate of
setup and machine, so that a row is judged from the first pose on, as far as the tolerances allow.
With the whitened rows [A | r] of the used visits and of all priors,

    step = -(A'A)^-1 A'r,   S = 1 + B (A'A)^-1 B',   d^2 = (q + B step)' S^-1 (q + B step)

is the distance of a new visit with rows [B | q] from what the others predict. Directions that these
leave open, such as the frame of the instrument at first, are projected out of the new rows: what
remains has fewer degrees of freedom, in the end none, and then nothing can be said of the row.

A row is doubted if the probability of its distance, or of its largest single difference, is below
LEVEL (Bonferroni for both). Accuracy and next poses are those of `loopcal.planning.problem` and
`loopcal.planning.design_space`, for the poses that were measured. See docs/theory/planning.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.information import ObservedPoses, observe_poses
from loopcal.estimate.residual_test import FEWEST_DEGREES, SIGNIFICANCE
from loopcal.findings import Finding, report_finding
from loopcal.measure.initial_values import (
    evaluate_measurements,
    guess_nuisance_values_batch,
    whiten_rows,
)
from loopcal.measure.instrument import Instrument
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import compute_whitener
from loopcal.measure.readings import resolve_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward
from loopcal.numerics.decomposition import are_nonzero
from loopcal.numerics.statistics import (
    compute_chi_square_tail,
    compute_f_tail,
    compute_single_level,
)
from loopcal.planning.candidates import Candidates
from loopcal.planning.constraints import PlanOptions, build_checker
from loopcal.planning.design_space import (
    Scoring,
    compute_swap_terms,
    factor_square,
    is_determined,
    score_additions,
)
from loopcal.planning.exchange import RIDGE
from loopcal.planning.path import check_paths, locate_home, measure_distance
from loopcal.planning.problem import DIMENSIONS, ExpectedErrors, PlanningProblem, prepare_problem
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

# Probability of doubting a row although nothing is wrong. A row that is wrong by six standard
# deviations in one of six values is then found in 99.2 % of cases.
LEVEL = 0.004
# Share of a row by which it must change along an open direction for its value to be unpredictable.
OPEN = 1e-6
# Standard deviation of a setup parameter, in radians or in sizes of the robot, above which its rows
# are not linear.
FAR = 0.1
STEPS = 20  # of the iteration to the estimate
SETTLED = 1e-6  # squared length [standard deviations] of a step at which it ends
# Difference of sums of squares up to which another row may be the wrong one, and the largest number
# of such rows that is named.
RIVALS, MOST_SUSPECTS = 12.0, 3
MOST_REPEATS = 60  # poses that are measured again to reach the goal, at most


@dataclass(frozen=True)
class Pace:
    """How long poses take: `minutes` to measure one, None where unknown, and the `speed` of travel
    [m per minute], rotations times the robot's size; infinite where travel does not count.
    """

    minutes: float | None = None
    speed: float = np.inf

    def sum_minutes(self, count: int | FloatArray, path: float | FloatArray) -> Any:
        """Return the minutes of so many poses and a path [m]; without a statement one for each."""
        return count * (self.minutes or 1.0) + path / self.speed


@dataclass(frozen=True, eq=False)
class CompanionTask:
    """What does not change during a session.

    problem : its candidates are the poses of the sheet. labels, is_held_out : (n,) of these.
    check_every : number of rows after which a pose is checked for drift; 0 never.
    """

    problem: PlanningProblem
    labels: tuple[str, ...]
    is_held_out: BoolArray
    pace: Pace = Pace()
    check_every: int = 10

    @property
    def robot(self) -> Mechanism:
        """The robot at its values before the session."""
        return self.problem.robot

    @cached_property
    def scoring(self) -> Scoring:
        """How poses are compared: by the mean variance of the target over the workspace."""
        return self.problem.pose_design(name="I").build_scoring(int((~self.is_held_out).sum()))

    @cached_property
    def scaled(self) -> FloatArray:
        """(n, r, Q) rows of the poses; zero where a pose is not reached."""
        return self.scoring.scale_rows(np.nan_to_num(self.problem.groups.rows))


def prepare_task(
    planned: Measurements,
    robot: Mechanism,
    instrument: Instrument,
    options: PlanOptions,
    pace: Pace = Pace(),
    check_every: int = 10,
) -> CompanionTask:
    """Return the task of measuring planned poses with one row each.

    planned : the sheet of a plan; its values do not count. options : goal, target, share, frame and
    constraints of the plan. Raises as `loopcal.planning.problem.prepare_problem`.
    """
    solution = forward(robot, planned.readings)
    if not solution.converged.all():
        label = planned.labels[int(np.flatnonzero(~solution.converged)[0])]
        raise DataError(
            report_finding("plan.measured-pose-unreachable", robot=robot.name, pose=label)
        )
    coordinates, n = read_coordinates(solution.T, robot.controlled), planned.n_poses
    checker = build_checker(robot, options.constraints)
    candidates = Candidates(coordinates, solution, np.ones(n, dtype=bool), Counter(), n, checker)
    problem = prepare_problem(robot, instrument, options, candidates)
    return CompanionTask(problem, planned.labels, planned.is_held_out, pace, check_every)


class VisitRows(NamedTuple):
    """Rows of n visits, linearized at one point."""

    raw: FloatArray  # (n, m, k + 1) [setup | machine | predicted - measured], per SI
    white: FloatArray  # (n, m, k + 1) whitened; zero where absent
    covariance: FloatArray  # (n, m, m) of the measured values [SI], that of readings included
    expected: FloatArray  # (n, c) columns that the instrument would show [SI]


class PartialSolution(NamedTuple):
    """Least squares of rows that may leave directions open."""

    step: FloatArray  # (k,) from the point of linearization
    root: FloatArray  # (k, q) square root of the covariance
    open: FloatArray  # (k, u) directions that no row changes along
    cost: float  # sum of squares
    degrees: int  # of freedom


def solve_rows(rows: FloatArray, unit: FloatArray) -> PartialSolution:
    """Return the least-squares step of whitened rows (m, k + 1) [A | r], columns scaled.

    unit : (k,) of the unknowns. A direction is open, too, where its standard deviation is not small
    compared with these (FAR): rows are not linear so far, and what they say of it is second order.
    """
    k = rows.shape[1] - 1
    length = np.linalg.norm(rows, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    length[k] = 1.0
    R = factor_square(rows / length)
    u, s, vt = np.linalg.svd(R[:k, :k])
    far = np.linalg.norm(vt / (length[:k] * unit), axis=1) > FAR * s
    known, along = are_nonzero(s) & ~far, u.T @ R[:k, k]
    root = vt[known].T / s[known] / length[:k, None]
    cost = float(R[k, k] ** 2 + (along[~known] ** 2).sum())
    degrees = int(rows.any(axis=1).sum()) - int(known.sum())
    return PartialSolution(
        -root @ along[known], root, vt[~known].T / length[:k, None], cost, degrees
    )


@dataclass(frozen=True, eq=False)
class VisitFit:
    """The estimate from some visits, and the rows of all visits at it."""

    deviation: FloatArray  # (p,) of the machine [tolerances]
    setup: FloatArray  # (U,) [SI]
    rows: VisitRows
    prior: FloatArray  # (., k + 1) whitened rows of the tolerances there
    unit: FloatArray  # (k,) see `solve_rows`
    solution: PartialSolution

    @property
    def is_located(self) -> bool:
        """Whether the rows determine the setup."""
        return not self.solution.open[: len(self.setup)].any()

    @property
    def scale(self) -> tuple[float, float]:
        """Noise in units of the stated one, and its degrees of freedom: 1 and infinity unless the
        rows contradict the stated noise and tolerances.
        """
        cost, degrees = self.solution.cost, self.solution.degrees
        if degrees < FEWEST_DEGREES or compute_chi_square_tail(degrees, cost) >= SIGNIFICANCE:
            return 1.0, np.inf
        return float(np.sqrt(cost / degrees)), float(degrees)


def observe_visits(
    task: CompanionTask, measured: Measurements, deviation: FloatArray, setup: FloatArray
) -> VisitRows:
    """Return the rows of measured visits at deviations (p,) and a setup (U,)."""
    free, nuisance = task.problem.free, measured.nuisance_parameters
    (observed,) = measured.observations
    joints = observed.kind.sensed_joints
    order = np.argsort(observed.rows)
    poses = _observe(free, deviation, measured.readings, joints)
    raw, _ = _evaluate(poses, measured, nuisance, setup)
    covariance = np.array(observed.covariance)
    sigma = resolve_reading_sigma(free.robot, measured.reading_sigma, measured.n_poses)
    for j in range(0 if sigma is None else sigma.shape[1]):
        assert sigma is not None
        change = np.zeros_like(sigma)
        change[:, j] = np.where(np.isfinite(sigma[:, j]), sigma[:, j], 0.0)
        moved = _observe(free, deviation, measured.readings + change, joints)
        by = (_evaluate(moved, measured, nuisance, setup)[0] - raw)[..., -1]
        covariance += by[:, :, None] * by[:, None, :]
    present = observed.present & np.isfinite(raw).all(axis=2)
    raw = np.where(present[..., None], raw, 0.0)
    white = compute_whitener(covariance, present, np.ones(len(observed))) @ raw
    values, kind = nuisance.select(0, setup[None]), observed.kind
    noise = np.zeros((1, len(observed), len(kind.noise_columns)))
    own = kind.stack_joints(poses.joints, observed.rows)
    expected = kind.measure(poses.T[:, observed.rows], noise, values, own)[0]
    return VisitRows(raw[order], white[order], covariance[order], expected[order])


def _observe(
    free: FreeParameters, deviation: FloatArray, readings: FloatArray, joints: Sequence[str]
) -> ObservedPoses:
    robot = free.robot.with_values(free.values(deviation[None])[0])
    return observe_poses(replace(free, robot=robot), readings, joints)


def _evaluate(
    poses: ObservedPoses, measured: Measurements, nuisance: NuisanceParameters, setup: FloatArray
) -> tuple[FloatArray, int]:
    """Return rows (n, m, k + 1), not whitened, [setup | machine | residual], and p."""
    linearized, u = poses.linearized, len(nuisance)
    (evaluated,) = evaluate_measurements(
        measured, linearized.T, setup[None], nuisance, linearized.joints
    )
    n, m = evaluated.residual.shape[1:]
    plain = evaluated._replace(whitener=np.broadcast_to(np.eye(m), (n, m, m)))
    rows = whiten_rows((plain,), linearized.by_parameters, linearized.joints_by_parameters)[0]
    p = rows.shape[1] - u - 1
    raw = np.concatenate([rows[:, p : p + u], rows[:, :p], rows[:, p + u :]], axis=1)
    return raw.reshape(n, m, -1), p


def _list_prior(
    task: CompanionTask, nuisance: NuisanceParameters, deviation: FloatArray, setup: FloatArray
) -> FloatArray:
    """Return the whitened rows of the tolerances of machine and setup."""
    table, machine = nuisance.table, task.problem.free.prior_rows()
    stated = table.free & ~np.isnan(table.tolerance)
    weight = np.diag(1.0 / np.where(stated, table.tolerance, 1.0))[stated]
    u, p = len(setup), len(deviation)
    of_setup = [weight, np.zeros((len(weight), p)), weight @ (setup - table.nominal)[:, None]]
    of_machine = [np.zeros((len(machine), u)), machine, (machine @ deviation)[:, None]]
    return np.concatenate([np.hstack(of_setup), np.hstack(of_machine)])


def linearize_visits(
    task: CompanionTask,
    measured: Measurements,
    used: BoolArray,
    deviation: FloatArray,
    setup: FloatArray,
) -> tuple[VisitFit, float]:
    """Return the linear fit of the used visits (n,) at a point, and the sum of squares there."""
    rows = observe_visits(task, measured, deviation, setup)
    prior = _list_prior(task, measured.nuisance_parameters, deviation, setup)
    stacked = np.concatenate([rows.white[used].reshape(-1, prior.shape[1]), prior])
    is_length = [
        p.dimension is Dimension.LENGTH for p in measured.nuisance_parameters.table.entries
    ]
    unit = np.full(len(setup) + len(deviation), np.inf)  # the machine is near its nominal values
    unit[: len(setup)] = np.where(is_length, task.robot.size, 1.0)
    solution, square = solve_rows(stacked, unit), float((stacked[:, -1] ** 2).sum())
    return VisitFit(deviation, setup, rows, prior, unit, solution), square


def fit_visits(
    task: CompanionTask, measured: Measurements, used: BoolArray, start: VisitFit | None = None
) -> VisitFit:
    """Return the maximum a posteriori estimate from the used visits (n,).

    start : where to begin; by default nominal geometry with the setup that fits best there.
    """
    free = task.problem.free
    z = np.zeros(len(free)) if start is None else start.deviation
    if start is not None and start.is_located:
        setup = start.setup
    else:
        chosen = measured.take(used) if used.any() else measured
        poses = _observe(free, z, chosen.readings, ())
        values = [rows.measured[None] for rows in chosen.observations]
        setup = guess_nuisance_values_batch(chosen, values, poses.T, chosen.nuisance_parameters)[0]
    best, square = linearize_visits(task, measured, used, z, setup)
    u, share = len(setup), 1.0
    for _ in range(STEPS):
        if square - best.solution.cost < SETTLED:
            break
        x = np.concatenate([best.setup, best.deviation]) + share * best.solution.step
        fit, after = linearize_visits(task, measured, used, x[u:], x[:u])
        if after < square:
            best, square, share = fit, after, 1.0
        else:
            share *= 0.5
    return best


# What a new row says.

Judgement = Literal["fits", "untestable", "repeat", "earlier-wrong", "agree", "differ", "moved"]


class Prediction(NamedTuple):
    """What other rows predict of a visit, and what was measured."""

    names: tuple[str, ...]  # of the m numbers with a noise
    difference: FloatArray  # (m,) measured - expected [SI]
    # (m,) of the difference, noise included [SI]; infinite where the others do not predict it, NaN
    # where nothing was measured
    sd: FloatArray
    noise: FloatArray  # (m,) standard deviation of the measured values alone [SI]
    distance: float  # d^2
    degrees: int
    p_value: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a new row says, and which rows are to be used with it."""

    judgement: Judgement
    prediction: Prediction
    expected: FloatArray  # (c,) columns that the instrument was expected to show [SI]
    is_used: BoolArray  # (n,) of all visits, the new one last
    findings: tuple[Finding, ...]


@dataclass(frozen=True, eq=False)
class Companion:
    """The state of a session.

    measured : the visits in order, one pose of its own for each; None before the first one.
    poses : (n,) place of each in the sheet. is_used : (n,) False for rows that do not fit.
    fit : to the used rows; None without any.
    """

    task: CompanionTask
    measured: Measurements | None = None
    poses: tuple[int, ...] = ()
    is_used: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    fit: VisitFit | None = None

    @cached_property
    def pending(self) -> tuple[int, ...]:
        """Places in the sheet of poses whose rows did not fit, and that have none that does."""
        used = {pose for pose, is_used in zip(self.poses, self.is_used, strict=True) if is_used}
        return tuple(dict.fromkeys(pose for pose in self.poses if pose not in used))

    @property
    def scale(self) -> float:
        """Noise in units of the stated one."""
        return 1.0 if self.fit is None else self.fit.scale[0]

    def count_used(self, pose: int) -> int:
        """Return how many used rows a pose has."""
        return sum(p == pose and bool(u) for p, u in zip(self.poses, self.is_used, strict=True))


def examine_row(before: Companion, measured: Measurements, pose: int) -> Verdict:
    """Judge a new row by what was known before.

    measured : all visits, the new one last. pose : its place in the sheet.
    """
    task, n = before.task, measured.n_poses
    poses, is_new = (*before.poses, pose), np.arange(n) == n - 1
    used = np.append(before.is_used, False)
    fitted = used & ~task.is_held_out[list(poses)]
    nuisance = measured.nuisance_parameters
    fit = before.fit
    if fit is None:
        none = np.zeros(n, dtype=bool)
        nominal = np.zeros(len(task.problem.free)), nuisance.table.nominal
        fit, _ = linearize_visits(task, measured, none, *nominal)
    if not fit.is_located:  # the new row locates the setup, too
        fit = fit_visits(task, measured, fitted | is_new, before.fit)
    fit, _ = linearize_visits(task, measured, fitted, fit.deviation, fit.setup)
    setup, z = np.split(fit.solution.step, [len(fit.setup)])
    expected = observe_visits(task, measured, fit.deviation + z, fit.setup + setup).expected[-1]
    prediction, rows = predict_visit(measured, fit, n - 1), fit.rows
    data: dict[str, Any] = {
        "pose": task.labels[pose],
        **_describe_worst(task.robot, measured, prediction),
    }
    same = [i for i in range(n - 1) if poses[i] == pose]
    doubted = [i for i in same if not used[i]]

    def conclude(judgement: Judgement, **more: Any) -> Verdict:
        finding = report_finding(f"companion.{judgement}", **data, **more)
        return Verdict(judgement, prediction, expected, used, (finding,))

    def conclude_drift(since: int) -> Verdict:
        change = rows.raw[since, :, -1] - rows.raw[-1, :, -1]
        sd = fit.scale[0] * np.sqrt(np.diagonal(rows.covariance[since] + rows.covariance[-1]))
        moved = prediction._replace(difference=change, sd=sd)
        data.update(_describe_worst(task.robot, measured, moved))
        return conclude("moved", between=n - 1 - since)

    if prediction.degrees == 0 or prediction.p_value >= LEVEL:
        used[-1] = True
        earlier = [i for i in same if before.is_used[i]]
        if earlier and compare_visits(rows, earlier[0], n - 1, fit.scale) < LEVEL:
            return conclude_drift(earlier[0])
        if prediction.degrees == 0:
            return conclude("untestable", setup=tuple(_list_open(measured, fit)))
        return conclude("fits", earlier=len(doubted))
    agreeing = [i for i in same if compare_visits(rows, i, n - 1, fit.scale) >= LEVEL]
    if not doubted and not agreeing:
        return conclude("repeat")
    if not agreeing:
        return conclude("differ", visits=len(same) + 1)
    used[same] = False
    used[[*agreeing, n - 1]] = True
    apart = [i for i in same if before.is_used[i] and i not in agreeing]
    if apart:
        used[apart] = True  # it was right then
        return conclude_drift(apart[0])
    suspects = find_suspects(fit, fitted, [*agreeing, n - 1])
    if len(suspects) == 1:
        used[suspects] = False
    if suspects:
        return conclude("earlier-wrong", suspects=tuple(task.labels[poses[i]] for i in suspects))
    return conclude("agree")


def take_rows(
    task: CompanionTask,
    measured: Measurements | None,
    poses: Sequence[int],
    used: BoolArray,
    before: Companion | None = None,
) -> Companion:
    """Return the state with these visits, all used as stated, such as by a verdict.

    before : the state from which the fit begins. Held-out poses do not enter the fit.
    """
    fitted = used & ~task.is_held_out[list(poses)]
    fit = None
    if measured is not None and fitted.any():
        fit = fit_visits(task, measured, fitted, None if before is None else before.fit)
    return Companion(task, measured, tuple(poses), used, fit)


def predict_visit(measured: Measurements, fit: VisitFit, number: int) -> Prediction:
    """Return what the rows of a fit predict of a visit that it does not use."""
    (observed,) = measured.observations
    raw, covariance, solution = fit.rows.raw[number], fit.rows.covariance[number], fit.solution
    is_present = raw.any(axis=1)
    A, r = raw[:, :-1], raw[:, -1]
    length = np.linalg.norm(A, axis=1)
    # how far values change along open directions
    along = A @ (solution.open / np.maximum(np.linalg.norm(solution.open, axis=0), 1e-300))
    is_open = (np.abs(along) > OPEN * length[:, None]).any(axis=1)
    half = A @ solution.root
    S = covariance + half @ half.T
    residual = r + A @ solution.step
    sd = np.where(is_present, np.where(is_open, np.inf, np.sqrt(np.diagonal(S))), np.nan)
    names = tuple(column.name for column in observed.kind.noise_columns)
    noise, seen = np.sqrt(np.diagonal(covariance)), np.flatnonzero(is_present)
    if not len(seen):
        return Prediction(names, -residual, sd, noise, 0.0, 0, 1.0)
    L = np.linalg.cholesky(S[np.ix_(seen, seen)])
    white, blocked = np.linalg.solve(L, residual[seen]), np.linalg.solve(L, along[seen])
    size = np.linalg.norm(np.linalg.solve(L, A[seen]), 2)
    basis, s, _ = np.linalg.svd(blocked)
    rank = int((s > OPEN * size).sum())
    scale, left = fit.scale
    rest = basis[:, rank:].T @ white / scale
    testable = seen[~is_open[seen]]
    single = (residual[testable] / (scale * sd[testable])) ** 2
    distance, degrees = float(rest @ rest), len(seen) - rank
    p_value = 1.0
    if degrees:
        p_value = float(compute_f_tail(degrees, left, distance / degrees))
    if len(single):
        largest = float(compute_f_tail(1, left, single.max()))
        p_value = min(2.0 * p_value, 2.0 * (1.0 - (1.0 - largest) ** len(single)), 1.0)
    return Prediction(names, -residual, scale * sd, scale * noise, distance, degrees, p_value)


def compare_visits(rows: VisitRows, i: int, j: int, scale: tuple[float, float]) -> float:
    """Return the probability of a larger difference of two visits of one pose."""
    difference = rows.raw[i, :, -1] - rows.raw[j, :, -1]
    seen = np.flatnonzero(rows.raw[i].any(axis=1) & rows.raw[j].any(axis=1))
    C = (rows.covariance[i] + rows.covariance[j])[np.ix_(seen, seen)]
    square = float(difference[seen] @ np.linalg.solve(C, difference[seen])) / scale[0] ** 2
    m = max(len(seen), 1)
    return float(compute_f_tail(m, scale[1], square / m))


def find_suspects(fit: VisitFit, fitted: BoolArray, added: Sequence[int]) -> list[int]:
    """Return the visits (of `fitted` (n,)) one of which is wrong, where the added ones are right:
    without it the sum of squares falls beyond doubt, and almost as far as without the best.
    """
    kept = fitted.copy()
    kept[list(added)] = True

    def solve_without(visit: int | None) -> PartialSolution:
        rows = fit.rows.white[kept & (np.arange(len(kept)) != visit)]
        stacked = np.concatenate([rows.reshape(-1, fit.prior.shape[1]), fit.prior])
        return solve_rows(stacked, fit.unit)

    numbers = np.setdiff1d(np.flatnonzero(fitted), added)
    if not len(numbers):
        return []
    whole, without = solve_without(None), [solve_without(int(i)) for i in numbers]
    cost, degrees = np.array([(each.cost, each.degrees) for each in without]).T
    variance, m = fit.scale[0] ** 2, fit.rows.white.shape[1]
    limit = compute_single_level(LEVEL, len(numbers))
    is_drop = compute_chi_square_tail(m, (whole.cost - cost) / variance) < limit
    agrees = compute_chi_square_tail(np.maximum(degrees, 1), cost / variance) >= LEVEL
    chosen = numbers[is_drop & agrees & (cost < cost.min() + RIVALS)]
    return chosen.tolist() if len(chosen) <= MOST_SUSPECTS else []


def _describe_worst(
    robot: Mechanism, measured: Measurements, prediction: Prediction
) -> dict[str, object]:
    """Return the difference that is largest in its standard deviations, as data of a finding."""
    (observed,) = measured.observations
    ratio = np.nan_to_num(np.abs(prediction.difference) / prediction.sd)
    worst = int(ratio.argmax())
    dimension = observed.kind.noise_columns[worst].dimension
    is_known = bool(ratio[worst] > 0.0)
    pair = (float(prediction.difference[worst]), float(prediction.sd[worst]))
    shown = [robot.to_quantity(value, dimension) for value in pair] if is_known else [None, None]
    return {
        "name": prediction.names[worst] if is_known else "",
        "difference": shown[0],
        "sd": shown[1],
        "times": float(ratio[worst]) if is_known else float(np.sqrt(prediction.distance)),
        "degrees": prediction.degrees,
    }


def _list_open(measured: Measurements, fit: VisitFit) -> list[str]:
    """Return the setup parameters that the rows do not determine yet."""
    names = measured.nuisance_parameters.table.names
    is_open = fit.solution.open[: len(names)].any(axis=1)
    return [names[i] for i in np.flatnonzero(is_open)]


# Accuracy so far, and the next pose.


def predict_accuracy(companion: Companion, more: Sequence[int] = ()) -> ExpectedErrors | None:
    """Return the errors over the workspace by the used rows, and `more` poses of the sheet; None
    while nothing bounds them. Noise above the stated one widens them.
    """
    task, scale = companion.task, companion.scale
    chosen = [*_list_fitted(companion), *more]
    errors = task.problem.predict_errors(np.array(chosen, dtype=np.int64))
    if errors is None or scale == 1.0:
        return errors
    names = (f"{name}{rms}" for name in DIMENSIONS for rms in ("", "_rms"))
    return replace(errors, **{name: scale * getattr(errors, name) for name in names})


def _list_fitted(companion: Companion) -> list[int]:
    """Return the places of the poses of used rows that are fitted."""
    held_out = companion.task.is_held_out
    pairs = zip(companion.poses, companion.is_used, strict=True)
    return [pose for pose, is_used in pairs if is_used and not held_out[pose]]


Reason = Literal["repeat", "check", "best", "again", "validate", "done"]


@dataclass(frozen=True, eq=False)
class NextPose:
    """What to measure next.

    reason : "repeat" a row that did not fit, "check" for drift, "best" by gain per minute, "again"
        because the sheet has no other pose, "validate" with a held-out pose, or "done".
    pose : place in the sheet; None where nothing is left. via_home : whether the straight path from
        the last pose is not allowed.
    left : number of fit poses to the goal, or of the sheet without a goal; None where MOST_REPEATS
        more do not reach it. held_out : number that is not measured. minutes : of both, if known.
    is_reached : the goal.
    """

    reason: Reason
    pose: int | None
    via_home: bool
    left: int | None
    held_out: int
    minutes: float | None
    is_reached: bool


def choose_next(companion: Companion, skipped: Sequence[int] = ()) -> NextPose:
    """Return what to measure next; `skipped` poses of the sheet are not suggested."""
    task, problem = companion.task, companion.task.problem
    out, goal = task.is_held_out, problem.options.goal
    measured = {pose for pose in companion.poses if companion.count_used(pose)}
    at = problem.candidates.coordinates
    here = at[companion.poses[-1]] if companion.poses else locate_home(task.robot)
    minutes = task.pace.sum_minutes(1, measure_distance(task.robot, here[None], at))
    free = [i for i in np.flatnonzero(~out).tolist() if i not in measured and i not in skipped]
    validating = [i for i in np.flatnonzero(out).tolist() if i not in measured and i not in skipped]
    errors = predict_accuracy(companion)
    is_reached = bool(goal is not None and errors and errors.select(problem.options.target) <= goal)
    order = [] if is_reached else order_by_gain(companion, free, minutes, goal is not None)
    left: int | None = len(order)
    if goal is not None and not is_reached:
        low, high = 0, len(order)
        target = problem.options.target

        def is_enough(count: int) -> bool:
            expected = predict_accuracy(companion, order[:count])
            return expected is not None and expected.select(target) <= goal

        if not is_enough(high):
            left = None
        while left is not None and high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if is_enough(middle) else (middle, high)
        left = None if left is None else high
    total = None
    if left is not None and task.pace.minutes is not None:
        path = [*order[:left], *validating]
        stops = np.concatenate([here[None], at[path]])
        travel = measure_distance(task.robot, stops[:-1], stops[1:]).sum()
        total = float(task.pace.sum_minutes(len(path), travel))
    reason, pose = _choose_pose(companion, order, free, validating, skipped, minutes)
    via_home = False
    if pose is not None and companion.poses:
        path = check_paths(problem.candidates.checker, here[None], at[pose][None])
        via_home = not bool(path.allowed[0])
    return NextPose(reason, pose, via_home, left, len(validating), total, is_reached)


def _choose_pose(
    companion: Companion,
    order: Sequence[int],
    free: Sequence[int],
    validating: Sequence[int],
    skipped: Sequence[int],
    minutes: FloatArray,
) -> tuple[Reason, int | None]:
    """Return what comes next, and why."""
    every = companion.task.check_every
    pending = [pose for pose in companion.pending if pose not in skipped]
    if pending:
        return "repeat", pending[-1]
    fitted = _list_fitted(companion)
    if every and fitted and (order or validating) and _count_since(companion, fitted[0]) >= every:
        return "check", fitted[0]
    if order:
        return "best" if order[0] in free else "again", order[0]
    if validating:
        return "validate", min(validating, key=lambda i: minutes[i])
    return "done", None


def _count_since(companion: Companion, pose: int) -> int:
    """Return the number of rows since a pose was measured last."""
    return len(companion.poses) - 1 - max(i for i, p in enumerate(companion.poses) if p == pose)


def order_by_gain(
    companion: Companion, free: Sequence[int], minutes: FloatArray, repeats: bool
) -> list[int]:
    """Return poses in the order in which each gains most per minute: by how much the logarithm of
    the mean variance over the workspace falls. minutes : (n,) of each pose as the next one.

    repeats : whether poses that were measured follow, up to MOST_REPEATS in all.
    """
    task, scaled = companion.task, companion.task.scaled
    fitted, left, order = _list_fitted(companion), list(free), list[int]()
    usable = np.flatnonzero(~task.is_held_out & scaled.any(axis=(1, 2))).tolist()
    rows = scaled[fitted].reshape(-1, scaled.shape[2])
    most = max(len(left), MOST_REPEATS) if repeats else len(left)
    R = task.scoring.factor(rows)
    while len(order) < most and (left or usable):
        among, at = left or usable, R
        if not is_determined(R):
            at = factor_square(np.concatenate([R, RIDGE * np.eye(len(R))]))
        terms = compute_swap_terms(task.scoring, at, scaled[among])
        gain = score_additions(terms) / (1.0 if order else minutes[among])
        order.append(among[int(np.argmax(gain))])
        R = factor_square(np.concatenate([R, scaled[order[-1]]]))
        if order[-1] in left:
            left.remove(order[-1])
    return order


def report_progress(companion: Companion, following: NextPose) -> tuple[Finding, ...]:
    """Return the accuracy so far, what is left to the goal, and what to measure next."""
    task, options = companion.task, companion.task.problem.options
    errors, findings = predict_accuracy(companion), list[Finding]()
    if companion.scale > 1.0:
        findings.append(report_finding("companion.scatter", times=companion.scale))
    if errors is None:
        findings.append(report_finding("companion.unbounded"))
    else:
        shown = errors.to_quantities(task.robot)
        findings.append(report_finding("companion.accuracy", share=errors.share, errors=shown))
    counts = {"left": following.left, "held_out": following.held_out, "minutes": following.minutes}
    goal = None
    if options.goal is not None:
        goal = task.robot.to_quantity(options.goal, DIMENSIONS[options.target])
    if following.left is None:
        findings.append(report_finding("companion.goal-far", goal=goal, repeats=MOST_REPEATS))
    elif following.left == 0:
        findings.append(report_finding("companion.enough", goal=goal, held_out=following.held_out))
    else:
        findings.append(report_finding("companion.left", goal=goal, **counts))
    if following.pose is not None:
        label, via_home = task.labels[following.pose], following.via_home
        said = report_finding(
            "companion.next", pose=label, reason=following.reason, via_home=via_home
        )
        findings.append(said)
    return tuple(findings)
