# SPDX-License-Identifier: Apache-2.0
"""Compute the misfit of measurements to a robot that is free within its spreads, and search for
the interpretation of them that explains them.

Interpretations that differ in measured values share poses and sensitivities: they are the trials of
one problem. Every interpretation has its own nuisance parameters (frames, targets, surfaces) and
its own excluded rows. Those of the actuator readings are evaluated one by one, because they have
their own poses. Pairs are tested only if no single interpretation explains the data: the most
promising ones are applied, and all others are tested on the result. All functions are pure; see
docs/theory/residual-patterns.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.diagnose.conventions.interpretations import (
    Interpretation,
    combine,
    interpret_readings,
    list_interpretations,
    list_reading_interpretations,
)
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.descent import StepControl, descend
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.observation_rows import ObservationRows, Residuals
from loopcal.estimate.penalties import Ridge
from loopcal.estimate.problem import Problem, make_exact_problem, make_problem, problem_of
from loopcal.estimate.resampling import CenteredProblem
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure.initial_values import guess_nuisance_values
from loopcal.measure.kinds.kind import Column, Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.mechanism.kinematics import compute_readings, find_directly_reachable, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.numerics.gauss_newton import Halving
from loopcal.numerics.statistics import choose_evenly, compute_known_median
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

FEWEST = 3  # smallest number of equations beyond those of unknown frames that gives a misfit
ALLOWED = 4.0  # misfit up to which tolerances and noise explain a residual
# Ratio of misfits up to which two interpretations fit equally well; the first in the list is
# reported, the others as alternatives.
EQUALLY = 1.2
# Rows this many times the median row away are excluded, up to this share of the rows; the check
# for outliers names them. The same share of the poses may be out of reach.
FAR, MOST_EXCLUDED = 5.0, 0.25
# Number of poses that Newton's method does not reach from home at once, and that are tried along
# a path before all others.
FOLLOWED = 8
# Factor by which open loops must close in another unit of the readings before they are refused, and
# share of the robot's size by which they must be open: smaller readings are closer to home, where
# all loops close.
CLOSER, WIDE_OPEN = 20.0, 0.1


class Effort(NamedTuple):
    """Effort for unknown frames. An interpretation that fits needs two or three steps of it."""

    candidates: int | None  # for their start values; None: all
    guess_steps: int  # steps of each candidate
    control: Halving  # of the iteration to the best frames


QUICK = Effort(2, 8, Halving(3, 2))  # to compare many interpretations before a few are judged
THOROUGH = Effort(None, 30, Halving(8, 6))  # to judge a few


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measurements in t interpretations of their values, compared with a robot at its values."""

    data: Measurements  # at poses that the robot reaches
    problem: Problem  # of all interpretations
    # at the robot's values; None where the rows do not locate a target
    linearization: Linearization | None
    effort: Effort  # for unknown frames
    # labels of the rows of the first interpretation that are far off the others, and that the
    # problem does not contain
    excluded: tuple[str, ...] = ()

    @cached_property
    def misfits(self) -> FloatArray:
        """(t,) to first order in the parameters; NaN with too few rows."""
        linearization = self.linearization
        if linearization is None:
            return np.full(len(self.problem), np.nan)
        return _compute_misfit(linearization)

    @property
    def misfit(self) -> float:
        """Misfit of the first interpretation."""
        return float(self.misfits[0])

    @property
    def is_finite(self) -> bool:
        """Whether the first interpretation has a misfit."""
        return self.linearization is not None and bool(np.isfinite(self.misfit))

    def residuals(self) -> tuple[Residuals, ...]:
        """Return the residuals of every interpretation at the robot's values."""
        linearization = self.linearization
        assert linearization is not None
        values = None if linearization.nuisance is None else linearization.nuisance.values
        solution = self.problem.solve(linearization.deviation, linearization.next_start, values)
        return self.problem.residuals(linearization.deviation, solution)


def is_redundant(free: FreeParameters) -> bool:
    """Return whether readings are rows, too: more actuators than freedoms."""
    return free.robot.redundancy is not None


def select_reached(
    free: FreeParameters, data: Measurements, *, follow: bool = False
) -> tuple[Measurements | None, int, int]:
    """Return the measurements at the poses that the robot reaches with the readings, None where it
    reaches too few; and how many it reaches of how many that were tried.

    With `follow`, paths lead to a few poses that are not reached at once, and to the others only if
    these succeed, because failures take longest.
    """
    robot, q, tried = free.robot, data.readings, len(data.readings)
    reached = find_directly_reachable(robot, robot.values[None], q[None])[0]
    if follow and reached.sum() < (1.0 - MOST_EXCLUDED) * len(q):
        hard = np.flatnonzero(~reached)
        sampled = hard[choose_evenly(len(hard), FOLLOWED)]
        reached[sampled] = forward(robot, q[sampled]).converged
        rest = np.setdiff1d(hard, sampled)
        if len(rest) and reached[sampled].mean() >= 1.0 - MOST_EXCLUDED:
            reached[rest] = forward(robot, q[rest]).converged
        else:
            tried -= len(rest)
    count = int(reached.sum())
    if count < (1.0 - MOST_EXCLUDED) * tried:
        return None, count, tried
    return data if reached.all() else data.take(reached), count, tried


def compare_with_robot(
    free: FreeParameters,
    data: Measurements,
    interpretations: Sequence[Interpretation] = (),
    effort: Effort = THOROUGH,
    start: FloatArray | None = None,
) -> Comparison:
    """Compare measurements, at poses that the robot reaches, with it, all rows included.

    interpretations : of their values; default: as written. start : (t, U) nuisance parameters to
        start from; default: guessed from the data.
    """
    nuisance, rows = data.nuisance_parameters, []
    read = [interpretation.apply(data) for interpretation in interpretations] or [data]
    count = len(read)
    for i, o in enumerate(data.observations):
        if not len(o):
            continue
        measured = np.stack([each.observations[i].measured for each in read])
        # a row that another interpretation leaves without some of its residuals is absent there
        same = (o.kind.detect_present(measured) == o.present).all(axis=-1)
        whitener = o.whitener * same[..., None, None]
        places, factor = nuisance.indices[i], nuisance.factor(i)
        rows.append(ObservationRows(o.kind, o.rows, measured, whitener, places, factor))
    chosen = NuisanceParameters(
        nuisance.table, tuple(r.nuisance for r in rows), tuple(r.factor for r in rows)
    )
    if is_redundant(free):
        recorded = np.repeat(data.readings[None], count, axis=0)
        problem = make_problem(
            free, recorded, data.reading_sigma, tuple(rows), count, chosen, lambda _: data
        )
    else:
        problem = make_exact_problem(
            free, data.readings[None], tuple(rows), count, chosen, lambda _: data
        )
    problem = replace(problem, control=effort.control)
    return Comparison(data, problem, _linearize(problem, data, effort, start), effort)


def exclude_far_rows(comparison: Comparison) -> Comparison:
    """Compare without the rows of each interpretation that are far off its others; the same
    comparison where there are none, or where a misfit is not finite.
    """
    linearization, problem, data = comparison.linearization, comparison.problem, comparison.data
    if linearization is None or not np.isfinite(comparison.misfits).all():
        return comparison
    # standard deviations (r, m) of whitened residuals by spreads and noise; by noise alone for
    # estimated poses, whose rows depend on each other
    expected = [np.ones(rows.whitener.shape[1:3]) for rows in problem.rows]
    first, p = np.arange(1), problem.parameters
    if not problem.is_uncertain:
        for rows_of_block in problem.take(first).leverage_rows(linearization.take(first)):
            for rows in rows_of_block:
                A = rows.rows[..., -p - 1 : -1]
                chosen = rows.numbers[:, None], rows.columns
                expected[rows.kind][chosen] = np.sqrt(1.0 + (A**2).sum(axis=-1))
    ratios = []
    for r, sd in zip(comparison.residuals(), expected, strict=True):
        # root mean square (t, r) of the present residuals; NaN for absent rows
        present = (r.whitened != 0.0).sum(axis=-1)
        total = ((r.whitened / sd) ** 2).sum(axis=-1)
        ratios.append(np.sqrt(np.where(present > 0, total / np.maximum(present, 1), np.nan)))
    if problem.is_uncertain:
        ratios[-1][:] = np.nan  # readings are no rows of their own: they locate the pose
    together = np.concatenate(ratios, axis=1)
    if np.isnan(together).all():
        return comparison
    limit = FAR * compute_known_median(together, axis=1)
    if np.any(together > limit[:, None]):
        limit = np.maximum(limit, np.nanquantile(together, 1.0 - MOST_EXCLUDED, axis=1))
    if not np.any(together > limit[:, None]):
        return comparison
    kept_rows, excluded, effort = [], [], comparison.effort
    for rows, ratio in zip(problem.rows, ratios, strict=True):
        kept = ~(ratio > limit[:, None])
        far = rows.poses.reshape(len(kept[0]), -1)[~kept[0]]
        excluded += ["/".join(data.labels[i] for i in poses) for poses in far]
        whitener = rows.take_trials(problem.trials)[1] * kept[..., None, None]
        kept_rows.append(replace(rows, whitener=whitener))
    problem = problem.with_rows(kept_rows)
    start = None if linearization.nuisance is None else linearization.nuisance.values
    if len(problem) == 1 and effort == THOROUGH:
        start = None  # far rows may have spoilt the guess
    return Comparison(
        data, problem, _linearize(problem, data, effort, start), effort, tuple(excluded)
    )


def compute_misfits(
    free: FreeParameters,
    data: Measurements,
    interpretations: Sequence[Interpretation],
    effort: Effort,
) -> FloatArray:
    """Return the misfits (t,) of interpretations of the values without far rows."""
    if not interpretations:
        return np.zeros(0)
    together = compare_with_robot(free, data, interpretations, effort)
    if together.linearization is None and len(interpretations) > 1:  # one cannot be evaluated
        middle = len(interpretations) // 2
        halves = (interpretations[:middle], interpretations[middle:])
        return np.concatenate([compute_misfits(free, data, half, effort) for half in halves])
    return exclude_far_rows(together).misfits


def compute_quick_misfit(free: FreeParameters, data: Measurements) -> float:
    """Return an upper bound of the misfit of measurements as written, in one step of a fit from the
    nominal values of unknown frames; infinite where a pose is out of reach, NaN with too few rows.
    """
    if not find_directly_reachable(free.robot, free.robot.values[None], data.readings[None]).all():
        return np.inf
    problem = problem_of(free, data)
    z = free.deviation(free.robot.values[None])
    with np.errstate(all="ignore"):
        linearization = problem.linearize(z, problem.start(z, seek=False))
        if not np.isfinite(linearization.cost[0]):
            return np.inf
        return float(_compute_misfit(linearization)[0])


def compute_fitted_misfit(robot: Mechanism, data: Measurements) -> float:
    """Return the misfit that a fit of redundant readings leaves, with spreads as prior; infinite
    where it does not converge, and for other robots. Such readings of a machine far from its file
    lead to no pose to compare.
    """
    if robot.redundancy is None:
        return np.inf
    try:
        fit = identify(robot, data.fitted)
    except (DataError, EstimationError):
        return np.inf
    if not fit.converged or fit.residual_test.dof <= 0:
        return np.inf
    return float(np.sqrt(fit.residual_test.chi_square / fit.residual_test.dof))


def find_reading_unit(free: FreeParameters, data: Measurements) -> Finding | None:
    """Return the refusal of redundant readings that close the loops of the robot far better in
    another unit; None without one. A fit would shrink the robot to such readings.
    """
    robot = free.robot
    if robot.redundancy is None:
        return None
    few = data.take(choose_evenly(data.n_poses, FOLLOWED))

    def measure_gap(read: Measurements) -> float:
        return float(np.median(forward(robot, read.readings).residual))

    gap = measure_gap(few)
    if not gap > WIDE_OPEN * robot.size:
        return None
    units = list_reading_interpretations(few, robot.actuators)
    gaps = {u: measure_gap(u.apply(few)) for u in units if u.slip == "unit"}
    best = min(gaps, key=gaps.__getitem__)
    if not gaps[best] * CLOSER < gap:
        return None
    found = {"gap": robot.describe_gap(gap), "other_gap": robot.describe_gap(gaps[best])}
    return report_finding(
        "conventions.readings-in-other-unit", robot=robot.name, **found, **best.details
    )


def _linearize(
    problem: Problem, data: Measurements, effort: Effort, start: FloatArray | None
) -> Linearization | None:
    """Linearize at the robot's values, from nuisance parameters `start` (t, U) or from guesses;
    None where the rows do not locate a target, which the fit reports.
    """
    z = np.repeat(problem.free.deviation(problem.free.robot.values[None]), len(problem), axis=0)
    begin = problem.start(z, seek=False)
    try:
        if start is None and problem.nuisance is not None:
            robot, t, observations = problem.free.robot, len(problem), list(data.observations)
            measured = [np.broadcast_to(o.measured, (t, *o.measured.shape)) for o in observations]
            used = [i for i, o in enumerate(observations) if len(o)]
            for i, rows in zip(used, problem.rows, strict=False):  # readings may follow
                measured[i] = np.broadcast_to(rows.measured, measured[i].shape)
                if t == 1:  # absent rows do not count
                    present = np.any(rows.whitener[0] != 0.0, axis=(1, 2))
                    weighted = observations[i].with_weights(present * observations[i].weight)
                    observations[i] = weighted
            start = guess_nuisance_values(
                replace(data, observations=tuple(observations)),
                measured,
                forward_trials(robot, robot.values[None], data.readings[None]).T,
                data.nuisance_parameters,
                most=effort.candidates,
                steps=effort.guess_steps,
            )
        return problem.linearize(z, begin if start is None else begin.with_nuisance(start))
    except DataError:
        return None


def _compute_misfit(linearization: Linearization, cost: FloatArray | None = None) -> FloatArray:
    """Return the root mean square (t,) of a cost over the equations; NaN with too few.

    The default is the smallest |R z + r|^2 + |z|^2 of the factor.
    """
    if cost is None:
        factor = linearization.factor
        t, p = len(factor), factor.shape[-1] - 1
        prior = np.broadcast_to(np.eye(p, p + 1), (t, p, p + 1))
        cost = (engine.fold(factor, prior) if p else factor)[:, -1, -1] ** 2
    rows = linearization.equations
    return np.where(rows >= FEWEST, np.sqrt(cost / np.maximum(rows, 1)), np.nan)


# Factor by which another interpretation must fit better before data are refused: true data of a
# robot far beyond its spreads fit twice as well in none of them.
BETTER = 5.0


def judge_data(
    free: FreeParameters,
    data: Measurements,
    start: FloatArray | None = None,
    effort: Effort = THOROUGH,
) -> Comparison | None:
    """Compare measurements with the robot without far rows; None where it reaches too few poses."""
    reached = select_reached(free, data)[0]
    if reached is None:
        return None
    return exclude_far_rows(compare_with_robot(free, reached, (), effort, start))


def compute_rms_residuals(comparison: Comparison) -> dict[Dimension, float]:
    """Return root mean squares [m or rad] of the first interpretation's residuals by dimension."""
    square: dict[Dimension, list[FloatArray]] = {}
    for s, r in zip(comparison.problem.rows, comparison.residuals(), strict=True):
        present = np.einsum("rmm->rm", s.whitener[0]) != 0.0
        for j, column in enumerate(s.kind.noise_columns):
            square.setdefault(column.dimension, []).append(r.raw[0, present[:, j], j] ** 2)
    joined = {dimension: np.concatenate(squares) for dimension, squares in square.items()}
    return {d: float(np.sqrt(values.mean())) for d, values in joined.items() if len(values)}


def list_rms_residuals(comparison: Comparison) -> tuple[Quantity, ...]:
    """Return these root mean squares in units of the robot's file."""
    to_quantity = comparison.problem.free.robot.to_quantity
    return tuple(to_quantity(size, d) for d, size in compute_rms_residuals(comparison).items())


def guess_frames(
    free: FreeParameters, data: Measurements, readings: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Guess nuisance parameters for sets of readings (h, n, a), the robot as it is: the sets (k,)
    with which the robot reaches enough poses, their nuisance parameters (k, U), and the median (k,)
    of the sizes of whitened residuals. Poses out of reach are taken at home.
    """
    robot, a = free.robot, readings.shape[-1]
    reached = find_directly_reachable(robot, robot.values[None], readings.reshape(1, -1, a))
    reached = reached.reshape(readings.shape[:2])
    near = np.flatnonzero(reached.mean(axis=1) >= 1.0 - MOST_EXCLUDED)
    readings, reached = readings[near], reached[near]
    nuisance, h = data.nuisance_parameters, len(near)
    T = np.broadcast_to(robot.home_state.T.reshape(-1, 4, 4)[0], (*reached.shape, 4, 4)).copy()
    T[reached] = forward_trials(robot, robot.values[None], readings[reached][None]).T[0]
    measured = [np.broadcast_to(o.measured, (h, *o.measured.shape)) for o in data.observations]
    most, steps = QUICK.candidates, QUICK.guess_steps
    start = guess_nuisance_values(data, measured, T, nuisance, most=most, steps=steps)
    sizes = [np.zeros((h, 0))]
    for o, places in zip(data.observations, nuisance.indices, strict=True):
        if h and len(o) and not o.kind.sensed_joints:
            residual = o.compute_residuals(T, start[:, places])
            whitened = np.matmul(o.whitener, residual[..., None])[..., 0]
            sizes.append(np.linalg.norm(whitened, axis=-1))
    size = np.concatenate(sizes, axis=1)
    return near, start, np.median(size, axis=1) if size.shape[1] else np.zeros(h)


def is_informative(
    free: FreeParameters, data: Measurements, interpretation: Interpretation, misfit: float
) -> bool:
    """Return whether values that shrink fit far better than controls without information: random
    numbers of any size fit as well at any pose, and zeros in every unit.
    """
    parts = interpretation.parts or (interpretation,)
    if not any(part.details.get("factor", 1.0) < 1.0 for part in parts):
        return True
    changed, rng = interpretation.apply(data), np.random.default_rng(0)
    shuffled = [o.measured[rng.permutation(len(o))] for o in changed.observations]
    pairs = zip(data.observations, changed.observations, strict=True)
    constant = [_make_constant(old.measured, new.measured) for old, new in pairs]
    readings = _make_constant(data.readings, changed.readings)
    for measured, q in ((shuffled, changed.readings), (constant, readings)):
        pairs = zip(changed.observations, measured, strict=True)
        observations = tuple(replace(o, measured=values) for o, values in pairs)
        control = judge_data(free, replace(changed, readings=q, observations=observations))
        if control is not None and control.misfit < BETTER * misfit:
            return False
    return True


def _make_constant(old: FloatArray, new: FloatArray) -> FloatArray:
    """Return a table with the median of its column in place of the values that changed."""
    is_changed = ~np.isclose(old, new, rtol=1e-12, atol=0.0, equal_nan=True)
    return np.where(is_changed, np.nanmedian(new, axis=0), new) if is_changed.any() else new


# Steps by which the stated convention and the best other one are compared finally.
REFINEMENT = 3
LARGEST_STEP = 30.0  # tolerances that a parameter may leave its value in these steps
# Factor by which the deviations of a robot far from nominal may exceed its spreads, and the
# steps of its fit.
FAR_AWAY, FIT = 30.0, 12


def refine_misfit(comparison: Comparison) -> tuple[float, FloatArray]:
    """Return the misfit of the first interpretation after steps of a fit within the spreads, or
    to first order where that is smaller, and its nuisance parameters (U,) there.
    """
    if not comparison.is_finite:
        return comparison.misfit, comparison.data.nuisance_parameters.values()
    misfit, end = _fit(comparison, 1.0, REFINEMENT)
    return min(comparison.misfit, misfit), end.nuisance[0]


def explains_after_fit(comparison: Comparison) -> bool:
    """Return whether a robot far from nominal explains the first interpretation: after a fit with
    tolerances `FAR_AWAY` times as large.
    """
    return comparison.is_finite and _fit(comparison, FAR_AWAY, FIT)[0] <= ALLOWED


def _fit(comparison: Comparison, scale: float, steps: int) -> tuple[float, Start]:
    """Return the misfit of the first interpretation after steps of a fit with tolerances `scale`
    times as large, infinite where a parameter leaves them by far, and where the fit ended.
    """
    assert comparison.linearization is not None
    first = np.arange(1)
    problem, at = comparison.problem.take(first), comparison.linearization.take(first)
    centered = CenteredProblem(problem, at.deviation, at.equations)
    control, start = StepControl(steps), at.next_start
    end = descend(centered, np.zeros_like(at.deviation), Ridge(scale**-2), control, start=start)
    if np.abs(end.deviation).max(initial=0.0) > LARGEST_STEP * scale:
        return np.inf, start
    cost = end.cost + ((end.deviation / scale) ** 2).sum(axis=1)
    return float(_compute_misfit(at, cost)[0]), end.start


# Number of constants in a scan, factor by which the next scan is narrower, and number of scans.
SCANNED, NARROWER, SCANS = 25, 8.0, 4
BEST = 3  # number of hypotheses that are scanned again
BESIDE = 0.02  # share of the stroke by which readings may be outside: the stroke is nominal, too


class _Zero(NamedTuple):
    """Readings `sign q + base + c` of some actuators, with c between two limits."""

    columns: list[int]  # of the actuators
    sign: float  # 1 or -1
    base: FloatArray  # (k,) of each of them [m or rad]
    # low, high: of c [m or rad]
    low: float
    high: float

    def apply(self, readings: FloatArray, constant: float) -> FloatArray:
        """Return the readings (n, a) with a value of c."""
        changed = np.array(readings)
        changed[:, self.columns] = self.sign * readings[:, self.columns] + self.base + constant
        return changed


def find_zero_interpretations(
    free: FreeParameters, data: Measurements, poses: IntArray, reversed_only: bool
) -> list[Interpretation]:
    """Return the zeros, at most three, with which the given robot fits best at some poses, the best
    first; only of readings that are counted in the opposite direction with `reversed_only`.
    """
    robot = free.robot
    zeros = [zero for zero in _list_zeros(free, data) if zero.sign < 0.0 or not reversed_only]
    few, constants = data.take(poses), np.zeros(0)
    for scan in range(SCANS):
        if not zeros:
            return []
        grids = [np.linspace(zero.low, zero.high, SCANNED) for zero in zeros]
        tested = zip(zeros, grids, strict=True)
        readings = [zero.apply(few.readings, c) for zero, grid in tested for c in grid.tolist()]
        sizes = np.full(len(readings), np.inf)
        near, _, size = guess_frames(free, few, np.stack(readings))
        sizes[near] = np.nan_to_num(size, nan=np.inf)
        sizes = sizes.reshape(len(zeros), SCANNED)
        best = np.argsort(sizes.min(axis=1), kind="stable")[:BEST]
        best = best[np.isfinite(sizes.min(axis=1)[best])]
        zeros = [zeros[i] for i in best]
        constants = np.array([grids[i][np.argmin(sizes[i])] for i in best])
        if scan < SCANS - 1:
            halves = [0.5 * (zero.high - zero.low) / NARROWER for zero in zeros]
            zeros = [
                zero._replace(low=constant - half, high=constant + half)
                for zero, constant, half in zip(zeros, constants.tolist(), halves, strict=True)
            ]
    result = []
    for zero, constant in zip(zeros, constants.tolist(), strict=True):
        total = zero.base + constant
        dimension = robot.actuators[zero.columns[0]].dimension
        shown = [robot.to_quantity(float(value), dimension) for value in total]
        same = np.ptp(total) < 1e-9 * max(float(np.abs(total).max()), 1e-9)
        details = {
            "actuators": tuple(robot.actuators[j].name for j in zero.columns),
            "reversed": zero.sign < 0.0,
            "zeros": tuple(shown[:1] if same else shown),
        }
        change = partial(zero.apply, constant=constant)
        result.append(interpret_readings("reading-zero", details, change))
    return result


def _list_zeros(free: FreeParameters, data: Measurements) -> Iterator[_Zero]:
    """Yield the hypotheses about zeros, those of all actuators of a dimension first."""
    robot = free.robot
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    smallest, largest = np.nanmin(data.readings, axis=0), np.nanmax(data.readings, axis=0)
    spread = largest - smallest
    strokes = [
        actuator.stroke or (home[j] - spread[j], home[j] + spread[j])
        for j, actuator in enumerate(robot.actuators)
    ]
    low, high = np.array(strokes).T
    low, high = low - BESIDE * (high - low), high + BESIDE * (high - low)
    dimensions = [actuator.dimension for actuator in robot.actuators]
    groups = [[j for j, d in enumerate(dimensions) if d is each] for each in dimensions]
    for columns in dict.fromkeys(map(tuple, [*groups, *([j] for j in range(len(groups)))])):
        chosen = list(columns)
        zero, start, ends = np.zeros(len(chosen)), home[chosen], (low + high)[chosen]
        bases = [(1.0, zero), (1.0, start), (-1.0, zero), (-1.0, start), (-1.0, ends)]
        if len(chosen) == 1:  # the scan contains the others
            bases = [(1.0, zero), (-1.0, zero)]
        for sign, base in bases:
            ends_of = np.sort(sign * np.array([smallest, largest])[:, chosen], axis=0) + base
            least = float((low[chosen] - ends_of[0]).max())
            most = float((high[chosen] - ends_of[1]).min())
            if least < most:
                yield _Zero(chosen, sign, base, least, most)


# Interpretations of measurements with a frame, target or anchor that no file declares unknown.

# Setup items that a user may forget to declare unknown. Surfaces with their frames and offsets
# are none of them: the errors of the machine explain those, too.
DECLARED = ("frame", "targets", "tool", "anchor")
UNDECLARED = "undeclared-setup"  # the slip of such interpretations


def list_setup_interpretations(data: Measurements, count: int) -> Iterator[Interpretation]:
    """Yield measurements with `count` setup items unknown that are known as written, in all kinds
    that allow them; two of them are the frame and another one.
    """

    def declare_unknown(data: Measurements, items: tuple[str, ...]) -> Measurements:
        changed = []
        for rows in data.observations:
            more = tuple(item for item in items if item in _list_known(rows.kind))
            unknown = (*rows.kind.unknown, *more)
            changed.append(replace(rows, kind=replace(rows.kind, unknown=unknown)))
        return replace(data, observations=tuple(changed))

    known = [_list_known(rows.kind) if len(rows) else () for rows in data.observations]
    items = [item for item in DECLARED if any(item in names for names in known)]
    for chosen in combinations(items, count):
        if count > 1 and chosen[0] != "frame":
            continue
        first = next(i for i, names in enumerate(known) if chosen[0] in names)
        unknown = (*data.observations[first].kind.unknown, *chosen)
        details = {"items": chosen, "unknown": tuple(dict.fromkeys(unknown))}
        apply = partial(declare_unknown, items=chosen)
        yield Interpretation(UNDECLARED, details, apply, of_values=True)


def _list_known(kind: Kind) -> tuple[str, ...]:
    """Return the items that a kind allows to be unknown, and that it states."""
    allowed = set(kind.allowed_unknown)
    if "surface" in allowed:
        allowed.discard("frame")
    return tuple(i for i in DECLARED if i in allowed and i not in kind.unknown)


# Factor by which it must fit better if tolerances and noise do not explain the rest, as of a
# robot far from nominal in data with a wrong unit.
FAR_BETTER = 10.0
# Misfit above which data that contradict stated setup parameters are refused. Below it, robots
# far beyond their spreads look the same, and it is a warning.
GROSS = 100.0
# Misfit up to which another interpretation is accepted if the robot reaches too few poses of the
# data as written, which then have no misfit to compare.
LARGEST = 10.0
# Number of rows, and smallest number of poses, by which all interpretations are compared first.
FEW_ROWS, FEWEST_POSES = 60, 20
# Factor by which the misfit on these rows may exceed the limit of a far better fit, and largest
# number of interpretations that are judged by all rows.
PROMISING, MOST_JUDGED = 2.0, 8
# Number of interpretations of the readings that are judged: those of the smallest misfit before
# parameters change.
NEAREST, NEAREST_IN_PAIRS = 12, 4
# Share of the misfit below which an interpretation is a base of pairs, and largest number of
# bases among the values, and among the readings.
LOWERED, MOST_BASES = 0.7, 3


class Selection(NamedTuple):
    """The selected interpretation."""

    interpretation: Interpretation
    comparison: Comparison  # of the data so interpreted
    misfit: float
    alternatives: tuple[Interpretation, ...]  # that fit equally well


class _Test(NamedTuple):
    """A tested interpretation; a misfit that was not computed is infinite."""

    interpretation: Interpretation
    quick: float  # misfit by a few rows
    misfit: float  # and, if that is promising, by all rows


def search_interpretations(
    free: FreeParameters, data: Measurements, stated: Comparison | None, misfit: float, pairs: bool
) -> tuple[Selection | None, int, str]:
    """Search for the interpretation that fits far better than the stated one.

    data : as written. stated : their comparison at the poses that the robot reaches; None where it
        reaches too few. misfit : of the data as written. pairs : test pairs if no single
        interpretation explains the data.
    Returns the interpretation that explains the data, None without one; the number of tested
    ones; the unit, in words, in which the data would fit where that is no evidence, because values
    so small fit by chance.
    """
    written = None if stated is None else stated.data
    search = _Search(free, data, written, misfit)
    select, singles = search.select_best, search.test_all()
    best, count = select(singles, ALLOWED), len(singles)
    if best is None and pairs:
        parameters = search.test_parameters()
        best, count = select(parameters, ALLOWED), count + len(parameters)
    if best is None and pairs:
        tested = list(search.test_pairs(singles))
        best, count = select(tested, ALLOWED), count + len(tested)
    if best is None:
        best = select(singles, misfit / FAR_BETTER if np.isfinite(misfit) else LARGEST)
        if best is not None and best.misfit > ALLOWED and not _is_robot_far(stated, best):
            best = None
    units = [test for test in singles if test.interpretation.slip == "unit"]
    possible = min(units, key=lambda test: test.misfit, default=None)
    if best is not None or possible is None or possible.misfit > ALLOWED:
        return best, count, ""
    return best, count, str(possible.interpretation.finding)


def _is_robot_far(stated: Comparison | None, chosen: Selection) -> bool:
    """Return whether an interpretation that leaves a misfit is true for a robot far from nominal:
    it explains the data so, and not as they are written; or its residuals become far smaller, too.
    """
    if stated is not None:
        before = compute_rms_residuals(stated)
        after = compute_rms_residuals(chosen.comparison)
        if any(FAR_BETTER * size < before.get(dimension, 0.0) for dimension, size in after.items()):
            return True
    explains = explains_after_fit(chosen.comparison)
    return explains and (stated is None or not explains_after_fit(stated))


def shares_poses(data: Measurements) -> bool:
    """Return whether rows share more than their pose: pairs of poses, or groups."""
    return any(o.kind.poses_per_row > 1 or bool((o.group != "").any()) for o in data.observations)


def _test(
    listed: Sequence[Interpretation],
    screened: FloatArray,
    judge: Callable[[list[Interpretation]], FloatArray | list[float]],
    misfit: float,
) -> list[_Test]:
    """Return the tests of interpretations with misfits by a few rows: `judge` computes the misfits
    by all rows of the best that may belong to a far better fit than `misfit`.
    """
    finite = np.sort(screened[np.isfinite(screened)])
    bound = min(PROMISING * misfit / BETTER, *finite[MOST_JUDGED - 1 : MOST_JUDGED], np.inf)
    promising = np.flatnonzero((screened <= bound) & np.isfinite(screened))
    judged = np.full(len(listed), np.inf)
    judged[promising] = judge([listed[i] for i in promising.tolist()])
    numbers = (np.nan_to_num(misfits, nan=np.inf).tolist() for misfits in (screened, judged))
    return [_Test(*row) for row in zip(listed, *numbers, strict=True)]


class _Search(NamedTuple):
    """The search for an interpretation that fits far better than the data as written."""

    free: FreeParameters
    data: Measurements  # as written
    reached: Measurements | None  # where the robot reaches their poses; None where too few
    misfit: float  # of the data as written

    def judge(
        self, data: Measurements, effort: Effort = THOROUGH, start: FloatArray | None = None
    ) -> float:
        """Return the misfit of interpreted data; infinite where too few poses are reached."""
        comparison = judge_data(self.free, data, start, effort)
        return np.inf if comparison is None else comparison.misfit

    def test_all(self, nearest: int = NEAREST) -> list[_Test]:
        """Test all single interpretations of data as written: those of the values, together, only
        if the robot reaches enough poses; those of the readings by their reach, and the `nearest`
        ones by residuals before parameters change.
        """
        free, data, reached, misfit = self
        tests: list[_Test] = []
        if reached is not None:
            of_values, few = list(list_interpretations(reached)), reached.take(_select_few(reached))
            screened = compute_misfits(free, few, of_values, QUICK)
            judge = partial(compute_misfits, free, reached, effort=THOROUGH)
            tests = _test(of_values, screened, judge, misfit)
        robot, poses = free.robot, _select_few(data)
        home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
        listed = list(list_reading_interpretations(data, robot.actuators, home))
        readings = np.stack([each.apply(data).readings[poses] for each in listed])
        near, start, size = guess_frames(free, data.take(poses), readings)
        screened = np.full(len(listed), np.inf)
        for i in np.sort(np.argsort(size, kind="stable")[:nearest]).tolist():
            few = listed[near[i]].apply(data).take(poses)
            screened[near[i]] = self.judge(few, QUICK, start[[i]])
        return tests + _test(
            listed, screened, lambda some: [self.judge(each.apply(data)) for each in some], misfit
        )

    def test_parameters(self) -> list[_Test]:
        """Test interpretations that have parameters of their own: setup items that are not declared
        unknown, and other zeros of the readings.
        """
        free, written, reached, misfit = self

        def test_each(listed: Sequence[Interpretation], data: Measurements) -> list[_Test]:
            def judge(chosen: list[Interpretation]) -> list[float]:
                judged = [judge_data(free, each.apply(data)) for each in chosen]
                return [np.inf if each is None else refine_misfit(each)[0] for each in judged]

            few = _select_few(data)
            screened = [self.judge(each.apply(data).take(few), QUICK) for each in listed]
            return _test(listed, np.array(screened), judge, misfit)

        poses = _select_few(written)
        tests = test_each(
            find_zero_interpretations(free, written, poses, not misfit > GROSS), written
        )
        for count in (1, 2):
            if reached is not None and all(test.misfit > ALLOWED for test in tests):
                tests += test_each(list(list_setup_interpretations(reached, count)), reached)
        return tests

    def test_pairs(self, singles: Sequence[_Test]) -> Iterator[_Test]:
        """Yield tests of pairs: the most promising single ones, each with all others after it."""
        free, data, reached, misfit = self
        for of_values in (True, False):
            promising = [
                test
                for test in singles
                if test.interpretation.of_values == of_values and test.quick < LOWERED * misfit
            ]
            for base in sorted(promising, key=lambda test: test.quick)[:MOST_BASES]:
                changed, left = base.interpretation.apply(data), reached
                if not of_values:
                    left = select_reached(free, changed)[0]
                elif reached is not None:
                    left = base.interpretation.apply(reached)
                search = _Search(free, changed, left, min(misfit, base.quick))
                for test in search.test_all(NEAREST_IN_PAIRS):
                    pair = combine(base.interpretation, test.interpretation)
                    yield test._replace(interpretation=pair)

    def select_best(self, tested: Sequence[_Test], limit: float) -> Selection | None:
        """Select the interpretation of the smallest misfit up to `limit` that is far better than
        the data as written; None without one.
        """
        free, written, reached, misfit = self

        def choose_data(interpretation: Interpretation) -> Measurements:
            return reached if interpretation.of_values and reached is not None else written

        better = [
            test
            for test in tested
            if test.misfit <= limit
            and test.misfit * BETTER < misfit
            and is_informative(
                free, choose_data(test.interpretation), test.interpretation, test.misfit
            )
        ]
        if not better:
            return None
        smallest = min(test.misfit for test in better)
        equal = [t.interpretation for t in better if t.misfit <= max(EQUALLY * smallest, 1.0)]
        best, *others = _drop_same(written, equal)
        comparison = judge_data(free, best.apply(choose_data(best)))
        least = np.inf if comparison is None else refine_misfit(comparison)[0]
        if comparison is None or not (least * BETTER < misfit and least <= limit):
            return None
        return Selection(best, comparison, least, tuple(others))


def _drop_same(
    data: Measurements, interpretations: Sequence[Interpretation]
) -> list[Interpretation]:
    """Return the interpretations without those that make the same data as an earlier one."""
    kept: list[tuple[Interpretation, list[FloatArray], list[tuple[str, ...]]]] = []
    for interpretation in interpretations:
        changed = interpretation.apply(data)
        table = [changed.readings, *(o.measured for o in changed.observations)]
        setup = [o.kind.unknown for o in changed.observations]
        if not any(
            setup == other_setup
            and all(np.allclose(a, b, equal_nan=True) for a, b in zip(table, other, strict=True))
            for _, other, other_setup in kept
        ):
            kept.append((interpretation, table, setup))
    return [interpretation for interpretation, _, _ in kept]


def _select_few(data: Measurements) -> IntArray:
    """Return poses spread over the data by which many interpretations are compared, without the
    ends, one of which shifted readings leave wrong; all where rows share more than their pose.
    """
    n = data.n_poses
    equations = sum(o.whitener.shape[-1] * len(o) for o in data.observations)
    count = max(FEWEST_POSES, -(-FEW_ROWS * n // max(equations, 1)))
    if n < count + 2 or shares_poses(data):
        return np.arange(n)
    return 1 + choose_evenly(n - 2, count)


# Data that another interpretation explains as well as the stated one cannot show which is true.

# Number of measured residuals from which the order of a redundant robot's actuators is certain:
# those of four positions, by which no machine of another order agrees with its redundant
# readings. With fewer, poses are known from the readings.
MEASURED = 12
# Slips in the order of the actuators.
ORDERS = ("swapped-readings", "reversed-readings", "permuted-readings")
# Columns of a height, and standard deviations of the noise from which its sign matters.
HEIGHT, SIGNIFICANT = (Column("z", Dimension.LENGTH),), 10.0


def report_equals(free: FreeParameters, data: Measurements, misfit: float) -> Finding | None:
    """Report other orders of a redundant robot's actuators, or the other sign of heights, that
    explain data as well as they are written; None without any.
    """
    heights = [o for o in data.observations if o.kind.columns == HEIGHT]
    sizes = [np.nan_to_num(o.whitener[:, 0, 0] * o.measured[:, 0]) for o in heights]
    is_significant = any(np.abs(size).max(initial=0.0) > SIGNIFICANT for size in sizes)
    if len(heights) == len(data.observations) and is_significant:
        mirrored = tuple(replace(o, measured=-o.measured) for o in heights)
        opposite = compute_quick_misfit(free, replace(data, observations=mirrored))
        if opposite <= max(EQUALLY * misfit, 1.0):
            return report_finding(
                "conventions.height-sign-undecided",
                robot=free.robot.name,
                misfit=misfit,
                other_misfit=opposite,
            )
    if not is_redundant(free) or sum(o.n_residuals for o in data.observations) >= MEASURED:
        return None
    few = data.take(select_measured(data))
    orders = []
    for interpretation in list_reading_interpretations(few, free.robot.actuators):
        if interpretation.slip in ORDERS:
            comparison = judge_data(free, interpretation.apply(few))
            if comparison is not None and refine_misfit(comparison)[0] <= ALLOWED:
                orders.append(interpretation.describe())
    if not orders:
        return None
    return report_finding(
        "conventions.orders-undecided", robot=free.robot.name, alternatives=tuple(orders)
    )


def select_measured(data: Measurements) -> IntArray:
    """Return the measured poses, and others spread over the data up to `FEWEST_POSES`."""
    measured = np.unique(np.concatenate([o.rows.ravel() for o in data.observations] or [[]]))
    others = np.setdiff1d(np.arange(data.n_poses), measured)
    more = choose_evenly(len(others), max(FEWEST_POSES - len(measured), 0))
    return np.union1d(measured, others[more]).astype(np.intp)
