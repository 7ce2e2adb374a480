# SPDX-License-Identifier: Apache-2.0
"""A companion while measuring: does a row fit, how accurate is the robot by now, what comes next.

The state of a session goes in and comes out: the rows measured so far, which of them are used, and
the fit to these. It knows no terminal and no file. The fit is the maximum a posteriori estimate of
setup and machine, so that a row is judged from the first pose on, as far as the spreads allow.
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

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np

from loopcal.diagnose.conventions.convention_check import compare_conventions
from loopcal.errors import DataError
from loopcal.estimate.information import ObservedPoses, observe_poses, observe_rows
from loopcal.estimate.residual_test import FEWEST_DEGREES, NO_NOISE, SIGNIFICANCE
from loopcal.findings import Finding, report_finding
from loopcal.measure.initial_values import guess_nuisance_values
from loopcal.measure.instrument import Instrument
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import resolve_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward
from loopcal.numerics.decomposition import are_nonzero
from loopcal.numerics.statistics import (
    compute_chi_square_quantile,
    compute_chi_square_tail,
    compute_f_tail,
    compute_single_level,
)
from loopcal.planning import design_space
from loopcal.planning.candidates import Candidates
from loopcal.planning.constraints import PlanOptions, build_checker
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
# Share of the variance of a combination of measured values that the spreads of the machine explain,
# up to which it shows the noise.
QUIET = 0.1
STEPS = 20  # of the iteration to the estimate
SETTLED = 1e-6  # squared length [standard deviations] of a step at which it ends
# Difference of sums of squares up to which another row may be the wrong one, and the largest number
# of such rows that is named.
RIVALS, MOST_SUSPECTS = 12.0, 3
TIE = 1e-9  # difference of gains, which are logarithms, that rounding explains
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
    def scoring(self) -> design_space.Scoring:
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
        raise DataError.of("plan.measured-pose-unreachable", robot=robot.name, pose=label)
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
    length = np.append(np.linalg.norm(rows[:, :k], axis=0), 1.0)
    length[length == 0.0] = 1.0
    R = design_space.factor_square(rows / length)
    u, s, vt = np.linalg.svd(R[:k, :k])
    far = np.linalg.norm(vt / (length[:k] * unit), axis=1) > FAR * s
    known, along = are_nonzero(s) & ~far, u.T @ R[:k, k]
    root, free = vt[known].T / s[known] / length[:k, None], vt[~known].T / length[:k, None]
    cost = float(R[k, k] ** 2 + (along[~known] ** 2).sum())
    degrees = int(rows.any(axis=1).sum()) - int(known.sum())
    return PartialSolution(-root @ along[known], root, free, cost, degrees)


@dataclass(frozen=True, eq=False)
class VisitFit:
    """The estimate from some visits, and the rows of all visits at it."""

    x: FloatArray  # (k,) setup [SI] and deviations of the machine [spreads]
    unit: FloatArray  # (k,) see `solve_rows`; infinite for the machine
    rows: VisitRows
    prior: FloatArray  # (., k + 1) whitened rows of the spreads there
    cost: float  # sum of squares at x
    solution: PartialSolution
    used: BoolArray  # (n,) visits

    @property
    def is_located(self) -> bool:
        """Whether the rows determine the setup."""
        return not self.solution.open[np.isfinite(self.unit)].any()

    @property
    def scale(self) -> tuple[float, float]:
        """Noise in units of the stated one, and its degrees of freedom: 1 and infinity unless the
        rows contradict the stated noise and spreads.
        """
        cost, degrees = self.solution.cost, self.solution.degrees
        if degrees < FEWEST_DEGREES or compute_chi_square_tail(degrees, cost) >= SIGNIFICANCE:
            return 1.0, np.inf
        return float(np.sqrt(cost / degrees)), float(degrees)

    def measure_noise(self) -> tuple[float, float]:
        """Return the whitened sum of squares, and its degrees of freedom, of what the used rows
        show that neither setup nor machine explains.

        With the influence matrix H = A (A'A)^-1 A' = U diag(h) U' of the measured rows, an element
        of U'r / (1 - h) has the variance of the noise and h / (1 - h) by the spreads. So wrong
        spreads never make the noise too small.
        """
        rows = self.rows.white[self.used].reshape(-1, len(self.x) + 1)
        rows = rows[rows.any(axis=1)]
        u, s, _ = np.linalg.svd(rows[:, :-1] @ self.solution.root)
        share = np.zeros(len(rows))
        share[: len(s)] = s**2
        is_quiet = share < QUIET
        residual = rows[:, -1] + rows[:, :-1] @ self.solution.step
        shown = u[:, is_quiet].T @ residual / (1.0 - share[is_quiet])
        return float(shown @ shown), float(is_quiet.sum())


def observe_visits(task: CompanionTask, measured: Measurements, x: FloatArray) -> VisitRows:
    """Return the rows of measured visits at setup and machine x (k,)."""
    (observed,), nuisance = measured.observations, measured.nuisance_parameters
    setup, z = np.split(x, [len(nuisance)])
    free, kind = task.problem.free, observed.kind
    free = replace(free, robot=free.robot.with_values(free.values(z[None])[0]))
    both = observed.present[:, :, None] & observed.present[:, None, :]
    C = np.where(both, observed.covariance, 0.0) + ~both * np.eye(both.shape[1])
    shape = (*observed.present.shape, len(x) + 1)

    def evaluate(data: Measurements) -> tuple[ObservedPoses, FloatArray]:
        poses = observe_poses(free, data.readings, kind.sensed_joints)
        white = observe_rows(poses, data, nuisance, setup)[0].reshape(shape)
        return poses, np.where(np.isfinite(white).all(axis=2, keepdims=True), white, 0.0)

    poses, white = evaluate(measured)
    sigma = resolve_reading_sigma(free.robot, measured.reading_sigma, measured.n_poses)
    if sigma is not None:
        L = np.linalg.cholesky(C)
        for change in np.where(np.isfinite(sigma), sigma, 0.0) * np.eye(sigma.shape[1])[:, None]:
            moved = evaluate(replace(measured, readings=measured.readings + change))[1]
            by = L @ (moved - white)[..., -1:]
            C = C + by @ by.swapaxes(1, 2)
        wider = replace(measured, observations=(replace(observed, covariance=C),))
        white = evaluate(wider)[1]
    own = kind.stack_joints(poses.joints, observed.rows)
    noise = np.zeros((1, len(observed), len(kind.noise_columns)))
    values = nuisance.select(0, setup[None])
    expected = kind.measure(poses.T[:, observed.rows], noise, values, own)[0]
    order = np.argsort(observed.rows)
    raw = np.linalg.cholesky(C) @ white
    return VisitRows(raw[order], white[order], C[order], expected[order])


def linearize_visits(
    task: CompanionTask, measured: Measurements, used: BoolArray, x: FloatArray | None = None
) -> VisitFit:
    """Return the linear fit of the used visits (n,) at x (k,), by default at nominal values."""
    table, machine = measured.nuisance_parameters.table, task.problem.free.prior_rows()
    stated, p = table.free & ~np.isnan(table.tolerance), machine.shape[1]
    nominal = np.append(table.nominal, np.zeros(p))
    x = nominal if x is None else x
    P = np.zeros((int(stated.sum()) + len(machine), len(x)))
    P[: -len(machine) or None, : len(table)] = np.diag(1.0 / table.tolerance)[stated]
    P[len(P) - len(machine) :, len(table) :] = machine
    prior = np.column_stack([P, P @ (x - nominal)])
    rows = observe_visits(task, measured, x)
    stacked = np.concatenate([rows.white[used].reshape(-1, prior.shape[1]), prior])
    size = {Dimension.LENGTH: task.robot.size}
    unit = np.array([size.get(dimension, 1.0) for dimension in table.dimensions] + [np.inf] * p)
    square = float((stacked[:, -1] ** 2).sum())
    return VisitFit(x, unit, rows, prior, square, solve_rows(stacked, unit), used)


def fit_visits(
    task: CompanionTask, measured: Measurements, used: BoolArray, start: VisitFit | None = None
) -> VisitFit:
    """Return the maximum a posteriori estimate from the used visits (n,).

    start : where to begin; its setup counts if the rows determined it.
    """
    best = linearize_visits(task, measured, used, None if start is None else start.x)
    if (start is None or not start.is_located) and used.any():
        best = linearize_visits(
            task, measured, used, _locate_setup(task, measured.take(used), best.x)
        )
    share = 1.0
    for _ in range(STEPS):
        if best.cost - best.solution.cost < SETTLED:
            break
        after = linearize_visits(task, measured, used, best.x + share * best.solution.step)
        best, share = (after, 1.0) if after.cost < best.cost else (best, 0.5 * share)
    return best


def _locate_setup(task: CompanionTask, measured: Measurements, x: FloatArray) -> FloatArray:
    """Return x (k,) with the setup that fits visits best at its machine."""
    free, z = task.problem.free, x[len(x) - len(task.problem.free) :]
    free = replace(free, robot=free.robot.with_values(free.values(z[None])[0]))
    (observed,) = measured.observations
    distance = np.linalg.norm(np.nan_to_num(observed.measured - observed.measured[0]), axis=1)
    for chosen in (measured, measured.take(np.unique([0, distance.argmax()]))):
        T, nuisance = observe_poses(free, chosen.readings).T, chosen.nuisance_parameters
        values = [rows.measured[None] for rows in chosen.observations]
        with suppress(DataError):  # all points on one line, of which two are enough
            return np.append(guess_nuisance_values(chosen, values, T, nuisance)[0], z)
    return x


# What a new row says.

Judgement = Literal[
    "fits", "untestable", "repeat", "earlier-wrong", "agree", "differ", "moved", "misread"
]


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

    @property
    def scale(self) -> float:
        """Noise in units of the stated one."""
        return 1.0 if self.fit is None else self.fit.scale[0]

    @cached_property
    def noise(self) -> float:
        """Noise that the accuracy is computed with: 1, the stated one, unless the rows contradict
        it with the confidence of the goal. Then it is theirs; of a smaller one, the upper limit.
        Where they contradict the spreads as well, `scale` counts instead.
        """
        if self.fit is None or not self.fit.is_located or self.scale > 1.0:
            return 1.0
        square, degrees = self.fit.measure_noise()
        if degrees < FEWEST_DEGREES or square < NO_NOISE**2 * degrees:
            return 1.0
        share = self.task.problem.options.share
        if compute_chi_square_tail(degrees, square) < 1.0 - share:
            return float(np.sqrt(square / degrees))
        return min(1.0, float(np.sqrt(square / compute_chi_square_quantile(degrees, share))))

    @cached_property
    def used(self) -> tuple[int, ...]:
        """Places in the sheet of the poses of all used rows."""
        return tuple(self.poses[i] for i in np.flatnonzero(self.is_used))

    @cached_property
    def fitted(self) -> list[int]:
        """Those that are fitted, in the order of measuring."""
        return [pose for pose in self.used if not self.task.is_held_out[pose]]

    @property
    def pending(self) -> tuple[int, ...]:
        """Places in the sheet of poses whose last row is not used."""
        is_last_used = dict(zip(self.poses, self.is_used, strict=True))
        return tuple(pose for pose in is_last_used if not is_last_used[pose])


def examine_row(before: Companion, measured: Measurements, pose: int) -> Verdict:
    """Judge a new row by what was known before.

    measured : all visits, the new one last. pose : its place in the sheet.
    """
    task, n = before.task, measured.n_poses
    poses, is_new = (*before.poses, pose), np.arange(n) == n - 1
    used = np.append(before.is_used, False)
    fitted = used & ~task.is_held_out[list(poses)]
    fit = linearize_visits(task, measured, fitted, None if before.fit is None else before.fit.x)
    if not fit.is_located:  # the new row locates the setup, too
        joined = fit_visits(task, measured, fitted | is_new, before.fit)
        fit = linearize_visits(task, measured, fitted, joined.x)
    expected = observe_visits(task, measured, fit.x + fit.solution.step).expected[-1]
    prediction, rows = predict_visit(measured, fit, n - 1), fit.rows
    data = {"pose": task.labels[pose], **_describe_worst(task.robot, measured, prediction)}
    same = [i for i in range(n - 1) if poses[i] == pose]
    doubted = [i for i in same if not used[i]]

    def conclude(judgement: Judgement, *others: Finding, **more: Any) -> Verdict:
        said = (report_finding(f"companion.{judgement}", **data, **more), *others)
        return Verdict(judgement, prediction, expected, used, said)

    def conclude_drift(since: int, new: list[int]) -> Verdict:
        if find_suspects(fit, fitted, new) == [since]:  # all other rows contradict it, too
            without = before.is_used & (np.arange(n - 1) != since)
            return examine_row(replace(before, is_used=without), measured, pose)
        change = rows.raw[since, :, -1] - rows.raw[-1, :, -1]
        sd = fit.scale[0] * np.sqrt(np.diagonal(rows.covariance[since] + rows.covariance[-1]))
        moved = prediction._replace(difference=change, sd=sd)
        data.update(_describe_worst(task.robot, measured, moved))
        return conclude("moved", between=n - 1 - since)

    if prediction.degrees == 0 or prediction.p_value >= LEVEL:
        used[-1] = True
        earlier = [i for i in same if before.is_used[i]]
        if earlier and compare_visits(rows, earlier[0], n - 1, fit.scale) < LEVEL:
            return conclude_drift(earlier[0], [n - 1])
        if prediction.degrees == 0:
            names = measured.nuisance_parameters.table.names
            is_open = fit.solution.open[: len(names)].any(axis=1)
            return conclude("untestable", setup=tuple(names[i] for i in np.flatnonzero(is_open)))
        return conclude("fits", earlier=len(doubted))
    agreeing = [i for i in same if compare_visits(rows, i, n - 1, fit.scale) >= LEVEL]
    if not agreeing:
        return conclude("differ" if doubted else "repeat", visits=len(same) + 1)
    used[same] = False
    used[[*agreeing, n - 1]] = True
    apart = [i for i in same if before.is_used[i] and i not in agreeing]
    if apart:
        used[apart] = True  # it was right then
        return conclude_drift(apart[0], [*agreeing, n - 1])
    suspects = find_suspects(fit, fitted, [*agreeing, n - 1])
    if suspects:
        used[suspects] = len(suspects) > 1
        return conclude("earlier-wrong", suspects=tuple(task.labels[poses[i]] for i in suspects))
    check = compare_conventions(task.robot, measured.take(used))
    found = check.finding
    others = () if found is None else (replace(found, data={**found.data, "is_session": True}),)
    if check.is_refused or (others and not before.is_used.any()):  # such as another unit
        used[[*same, n - 1]] = False
        return conclude("misread", *others)
    return conclude("agree", *others)


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
) -> dict[str, Any]:
    """Return the difference that is largest in its standard deviations, as data of a finding."""
    (observed,) = measured.observations
    ratio = np.nan_to_num(np.abs(prediction.difference) / prediction.sd)
    worst, times = int(ratio.argmax()), float(np.sqrt(prediction.distance))
    name, difference, sd = "", None, None
    if ratio[worst] > 0.01:  # less is shown as none
        name, times = prediction.names[worst], float(ratio[worst])
        dimension = observed.kind.noise_columns[worst].dimension
        pair = prediction.difference[worst], prediction.sd[worst]
        difference, sd = (robot.to_quantity(float(value), dimension) for value in pair)
    return {"name": name, "difference": difference, "sd": sd, "times": times}


# Accuracy so far, and the next pose.


def predict_accuracy(companion: Companion, more: Sequence[int] = ()) -> ExpectedErrors | None:
    """Return the errors over the workspace by the used rows, and `more` poses of the sheet; None
    while nothing bounds them. The noise is what the rows show of it; rows that contradict noise and
    spreads widen all errors.
    """
    task, scale = companion.task, companion.scale
    chosen = np.array([*companion.fitted, *more], dtype=np.int64)
    errors = task.problem.predict_errors(chosen, companion.noise)
    if errors is None or scale == 1.0:
        return errors
    names = (f"{name}{rms}" for name in DIMENSIONS for rms in ("", "_rms"))
    return replace(errors, **{name: scale * getattr(errors, name) for name in names})


Reason = Literal["chosen", "repeat", "check", "best", "again", "validate", "done"]


@dataclass(frozen=True, eq=False)
class NextPose:
    """What to measure next.

    reason : "chosen" by the operator, "repeat" a row that did not fit, "check" for drift, "best" by
        gain per minute, "again" because the sheet has no other pose, "validate" with a held-out
        pose, or "done".
    pose : place in the sheet; None where nothing is left.
    left : number of fit poses to the goal, or of the sheet without a goal; None where MOST_REPEATS
        more do not reach it. held_out : number that is not measured. minutes : of both, if known.
    """

    reason: Reason
    pose: int | None
    left: int | None
    held_out: int
    minutes: float | None


def choose_next(
    companion: Companion, skipped: Sequence[int] = (), chosen: int | None = None
) -> NextPose:
    """Return what to measure next: the chosen pose, or one of the sheet that is not `skipped`."""
    task, problem = companion.task, companion.task.problem
    goal, target, at = problem.options.goal, problem.options.target, problem.candidates.coordinates
    here = at[companion.poses[-1]] if companion.poses else locate_home(task.robot)
    minutes = task.pace.sum_minutes(1, measure_distance(task.robot, here[None], at))
    others = [i for i in range(len(at)) if i not in companion.used and i not in skipped]
    free = [i for i in others if not task.is_held_out[i]]
    validating = [i for i in others if task.is_held_out[i]]
    gaining, order = order_by_gain(companion, free, minutes, goal is not None), list[int]()

    def is_enough(count: int) -> bool:
        order.extend(islice(gaining, max(count - len(order), 0)))
        errors = predict_accuracy(companion, order[:count])
        return goal is not None and errors is not None and errors.select(target) <= goal

    left: int | None = len(free)
    if goal is None:
        order.extend(gaining)
    else:
        high = 1
        while not is_enough(high) and len(order) == high:
            high *= 2
        left = bisect_left(range(high + 1), True, lo=high // 2, key=is_enough)
        left = None if left > high else left
    total = None
    if left is not None and task.pace.minutes is not None:
        path = [*order[:left], *validating]
        stops = np.concatenate([here[None], at[path]])
        travel = measure_distance(task.robot, stops[:-1], stops[1:]).sum()
        total = float(task.pace.sum_minutes(len(path), travel))
    reason: Reason = "done"
    pending = [pose for pose in companion.pending if pose not in skipped]
    fitted, going = companion.fitted, order if left or (left is None and free) else []
    since = companion.poses[::-1].index(fitted[0]) if fitted else 0
    pose = None
    if chosen is not None:
        reason, pose = "chosen", chosen
    elif pending:
        reason, pose = "repeat", pending[-1]
    elif 0 < task.check_every <= since and (going or validating):
        reason, pose = "check", fitted[0]
    elif going:
        reason, pose = "best" if going[0] in free else "again", going[0]
    elif validating:
        reason, pose = "validate", min(validating, key=lambda i: minutes[i])
    return NextPose(reason, pose, left, len(validating), total)


def order_by_gain(
    companion: Companion, free: Sequence[int], minutes: FloatArray, repeats: bool
) -> Iterator[int]:
    """Yield poses in the order in which each gains most per minute: by how much the logarithm of
    the mean variance over the workspace falls. minutes : (n,) of each pose as the next one.

    repeats : whether poses that were measured follow, up to MOST_REPEATS in all.
    """
    task, scaled = companion.task, companion.task.scaled / companion.noise
    left, count = list(free), 0
    usable = np.flatnonzero(~task.is_held_out & scaled.any(axis=(1, 2))).tolist()
    rows = scaled[companion.fitted].reshape(-1, scaled.shape[2])
    most = max(len(left), MOST_REPEATS) if repeats else len(left)
    R, is_regular = task.scoring.factor(rows), False
    while count < most and (left or usable):
        among, at = left or usable, R
        is_regular = is_regular or design_space.is_determined(R)
        if not is_regular:
            at = design_space.factor_square(np.concatenate([R, RIDGE * np.eye(len(R))]))
        terms = design_space.compute_swap_terms(task.scoring, at, scaled[among])
        gain = design_space.score_additions(terms) / (1.0 if count else minutes[among])
        # of poses that gain equally but for rounding, as on a symmetric machine, the first one
        best = among[int(np.argmax(gain >= gain.max() - TIE))]
        yield best
        count += 1
        R = design_space.factor_square(np.concatenate([R, scaled[best]]))
        if best in left:
            left.remove(best)


def report_progress(companion: Companion, following: NextPose) -> tuple[Finding, ...]:
    """Return the accuracy so far, what is left to the goal, what to measure next, and whether the
    straight path to it is not allowed.
    """
    task, options = companion.task, companion.task.problem.options
    errors, findings = predict_accuracy(companion), list[Finding]()
    if companion.scale > 1.0:
        findings.append(report_finding("companion.scatter", times=companion.scale))
    if errors is None:
        findings.append(report_finding("companion.unbounded"))
    else:
        shown = errors.to_quantities(task.robot)
        findings.append(report_finding("companion.accuracy", share=errors.share, errors=shown))
    goal, label, left, via_home = None, "", following.left, False
    if options.goal is not None:
        goal = task.robot.to_quantity(options.goal, DIMENSIONS[options.target])
    if following.pose is not None:
        label, candidates = task.labels[following.pose], task.problem.candidates
        if companion.poses:
            ends = candidates.coordinates[[companion.poses[-1], following.pose]]
            via_home = not check_paths(candidates.checker, ends[:1], ends[1:]).allowed[0]
    code = "goal-far" if left is None else "left" if left else "enough"
    facts = {**vars(following), "goal": goal, "pose": label, "via_home": via_home}
    facts["repeats"] = MOST_REPEATS
    codes = (code, "next") if label else (code,)
    findings += [report_finding(f"companion.{code}", **facts) for code in codes]
    return tuple(findings)
