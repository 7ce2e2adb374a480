# SPDX-License-Identifier: Apache-2.0
"""The descent to the filtered solution: damped Gauss-Newton, many trials at once.

At every accepted point the whitened, scaled rows are one triangular factor, from which the step
follows (`linear_model`). The first step tried is the full one to the filtered solution for the
TOTAL deviation z from nominal. Where it does not lower the sum of squares plus penalty,
Levenberg-Marquardt damping shortens it (`filtered_step`). A trial ends without a solution where it
makes no progress. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Integral
from typing import ClassVar, NamedTuple, Protocol, Self

import numpy as np

from loopcal.engine import Advanced, Steps, fold
from loopcal.errors import EstimationError
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.penalties import Method, decompose_for, fix_penalty
from loopcal.measure.array_checks import check_type
from loopcal.numerics.decomposition import (
    RANK_TOLERANCE,
    Decomposition,
    certain_share,
    solve_regular,
)
from loopcal.numerics.gauss_newton import ROUNDING, DescentStatus
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress


@dataclass(frozen=True, eq=False)
class FilteredStep(TrialBatch):
    """A step of some trials towards the filtered solution.

    deviation : (a, p) total deviation to which it leads. target : (a, p) that of the full step.
    length, full_length : (a,) of this step and of the full one, in spreads.
    predicted : (a,) decrease of sum of squares plus penalty by the linear model.
    change : (a,) squared length of the full step measured in the whitened residuals and the
        penalty.
    """

    deviation: FloatArray
    target: FloatArray
    length: FloatArray
    full_length: FloatArray
    predicted: FloatArray
    change: FloatArray


@dataclass(frozen=True, eq=False)
class SpectralModel(TrialBatch):
    """The decomposition of the rows, and the penalty (t, p) that the method chose from it."""

    decomposition: Decomposition
    penalty: FloatArray

    @property
    def finite_penalty(self) -> FloatArray:
        """(t, p) with zero for directions that are not used."""
        return np.where(np.isfinite(self.penalty), self.penalty, 0.0)

    def propose(self, deviation: FloatArray, damping: FloatArray) -> FilteredStep:
        """Return the steps from deviations (t, p) to the filtered solutions, damped by mu (t,)."""
        decomposition, penalty, finite = self.decomposition, self.penalty, self.finite_penalty
        s, c = decomposition.singular_values, decomposition.projections
        current = decomposition.coordinates(deviation)
        solution = decomposition.solution(penalty)
        full = solution - current
        # a direction that is not used is as stiff as the weakest one that is
        used, stiffness = np.isfinite(penalty), s**2 + finite
        weakest = np.where(used, stiffness, np.inf).min(axis=1, initial=np.inf)
        others = np.where(np.isfinite(weakest), weakest, 1.0)[:, None]
        curvature = np.where(used, stiffness, others)
        new = current + curvature / (curvature + damping[:, None]) * full
        # differences of squares as products, so that a small decrease is not lost in a large sum
        data = s * (current - new) * (s * (current + new) - 2.0 * c)
        prior = finite * (current - new) * (current + new)
        reached = decomposition.deviation(new)
        return FilteredStep(
            deviation=reached,
            target=decomposition.deviation(solution),
            length=np.linalg.norm(reached - deviation, axis=1),
            full_length=np.linalg.norm(decomposition.deviation(full), axis=1),
            predicted=(data + prior).sum(axis=1),
            change=(curvature * full**2).sum(axis=1),
        )

    def penalize(self, deviation: FloatArray) -> FloatArray:
        """Return what the penalty adds to the sum of squares at deviations (t, p): the sum of
        penalty_i (v_i'z)^2, (t,), without directions that are not used.
        """
        weight = self.finite_penalty
        if not weight.any():
            return np.zeros(len(deviation))
        return (weight * self.decomposition.coordinates(deviation) ** 2).sum(axis=1)


@dataclass(frozen=True, eq=False)
class TriangularModel(TrialBatch):
    """The triangular factor of the rows, for a penalty that does not depend on them.

    factor : (t, p + 1, p + 1) of rows [A | r]. deviation : (t, p) where they were linearized.
    equations : (t,) that were folded.
    step : (t, p) the full step. gain : (t,) decrease by it of the sum of squares with penalties, as
        the linear model predicts it. is_regular : (t,) where these are known; elsewhere a direction
        might not count, and the decomposition decides.
    method, tolerance : the method and its rank tolerance. fixed : (k, p) P of its penalty |P z|^2.
    """

    shared: ClassVar[tuple[str, ...]] = ("method", "tolerance", "fixed")

    factor: FloatArray
    deviation: FloatArray
    equations: IntArray
    step: FloatArray
    gain: FloatArray
    is_regular: BoolArray
    method: Method
    tolerance: float
    fixed: FloatArray

    @cached_property
    def decomposition(self) -> Decomposition:
        """The decomposition of the rows for the total deviation."""
        of_rows = self.factor, self.equations, self.deviation
        return decompose_for(self.method, *of_rows, self.tolerance)

    @cached_property
    def penalty(self) -> FloatArray:
        """(t, p) of each direction of the decomposition."""
        return np.array(self.method.penalty(self.decomposition), dtype=np.float64)

    def propose(self, deviation: FloatArray, damping: FloatArray) -> FilteredStep:
        """Return the steps from deviations (t, p), damped by (t,)."""
        is_simple = self.is_regular & (damping == 0.0)
        if not is_simple.any():
            return SpectralModel(self.decomposition, self.penalty).propose(deviation, damping)
        target = deviation + self.step
        length = np.linalg.norm(self.step, axis=1)
        full = FilteredStep(target, target, length, length, self.gain, self.gain)
        if is_simple.all():
            return full
        others = np.flatnonzero(~is_simple)
        return full.put(others, self.take(others).propose(deviation[others], damping[others]))

    def penalize(self, deviation: FloatArray) -> FloatArray:
        """Return what the penalty adds to the sum of squares (t,) at deviations (t, p)."""
        return (np.matmul(self.fixed, deviation[:, :, None]) ** 2).sum(axis=(1, 2))


LinearModel = SpectralModel | TriangularModel
"""The linear model at the points of t trials."""


def make_linear_model(
    linearized: Linearization, method: Method, tolerance: float, fixed: FloatArray | None
) -> LinearModel:
    """Return the linear model of linearized rows; `fixed` is that of `fix_penalty`."""
    factor, equations, z = linearized.factor, linearized.equations, linearized.deviation
    if fixed is None:
        decomposition = decompose_for(method, factor, equations, z, tolerance)
        penalty = np.array(method.penalty(decomposition), dtype=np.float64)
        return SpectralModel(decomposition, penalty)
    p, joint = z.shape[1], factor
    if len(fixed):
        rows = np.empty((len(z), len(fixed), p + 1))
        rows[:, :, :p], rows[:, :, p:] = fixed, np.matmul(fixed, z[:, :, None])
        joint = fold(factor, rows)
    residual = joint[:, :p, p]
    step, is_regular = solve_regular(joint[:, :p, :p], -residual, tolerance)
    gain = (residual**2).sum(axis=1)
    return TriangularModel(factor, z, equations, step, gain, is_regular, method, tolerance, fixed)


ACCEPTED_SHARE = 1e-4
"""Share of the predicted decrease that a step must bring."""

ROUNDING_STEP, SMALL_STEP, SHORTEST_STEP = 1e-6, 1e-3, 1e-9
"""Lengths in spreads, relative to 1 + |z|. A full step below ROUNDING_STEP that brings no
decrease has met rounding: the trial converged. So has one that was damped below SHORTEST_STEP
without a decrease, if its full step is below SMALL_STEP."""

AS_LOW = 1.0 + 1e-9
"""Ratio to which rounding may raise a sum of squares: residuals are rounded at the size of the
robot, more than the sum itself."""

MOST_ITERATIONS = 1000
"""Evaluations of the rows: far more than fits need, since those without progress end early."""

CONTRACTION, SLOWEST = 0.25, 0.1
"""Largest ratio of two steps from which a chord may end, and the least difference from 1 of a ratio
with which the length of all further steps is expected."""

FURTHER = 1e-3
"""Share of what the last step may change that all further steps may change together."""

FIRST_DAMPING = 1e-6
"""Damping after the first rejected step, in units of the largest squared singular value."""


PATIENCE = 20
"""Evaluations without progress after which a trial ends. One whose result is not finite, such as
that of poses out of reach, counts `NOT_FINITE` times: it takes the longest and says the least."""

NOT_FINITE = 5

LESS_COST, LESS_LENGTH, LESS_DAMPING = 0.99, 0.95, 0.1
"""Progress is a decrease of the sum of squares, of the length of the full step, or of the damping
to this share of its value at the last progress."""


CHAIN_CONTRACTION = 0.9
"""Largest ratio of the lengths of two full steps of a chain."""

LEAST_GAIN = 0.25
"""Share of the predicted decrease that a chain must bring. With less, full steps may lead into the
basin of another, higher minimum."""

LONGEST_CHAIN = 10
"""Steps of a chain, at most."""

FIRST_WAIT = 2
"""Damped steps before a chain is tried; twice as many after every one that led nowhere."""


class LeastSquaresProblem(Protocol):
    """A least-squares problem of t trials: whitened rows, columns scaled by tolerance."""

    @property
    def parameters(self) -> int:
        """Number of unknowns p."""
        ...

    def start(self, deviation: FloatArray) -> Start:
        """Return the warm start of a descent from deviations (t, p)."""
        ...

    def linearize(self, deviation: FloatArray, start: Start) -> Linearization:
        """Linearize at deviations (t, p)."""
        ...

    def take(self, trials: IntArray) -> Self:
        """Return the problem of some trials."""
        ...


@dataclass(frozen=True)
class StepControl:
    """Settings of the descent.

    Parameters
    ----------
    iterations : evaluations of the rows after the first, at most.
    relative : converged when the step changes the whitened residuals by at most this share of their
        norm, and all further ones together would by at most a thousandth of it, as the ratio of the
        last two full steps lets expect. That step is still taken, without evaluating the rows
        again: the result is the solution of the last decomposition.
    absolute : converged when the step is at most this long, in spreads, relative to 1 + |z|.
    damping : of the first step, in units of the largest squared singular value; zero tries the full
        step.

    Raises
    ------
    EstimationError : a setting is out of its range.
    """

    iterations: int = MOST_ITERATIONS
    relative: float = 1e-6
    absolute: float = 1e-12
    damping: float = 0.0

    def __post_init__(self) -> None:
        check_type(self.iterations, Integral, "iterations", "a whole number, 0 or more")
        for name in ("relative", "absolute"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise EstimationError(
                    f"{name} is {getattr(self, name)}. Give a finite number above 0"
                )
        if self.iterations < 0:
            raise EstimationError(f"iterations is {self.iterations}. Give 0 or more")
        if not 0.0 <= self.damping < np.inf:
            raise EstimationError(f"damping is {self.damping}. Give 0 or a finite number above it")


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the descent ended.

    deviation : (t, p) total deviation z from nominal, in spreads.
    linear_model : of the rows next to `deviation`.
    cost : (t,) sum of squares of the whitened residuals.
    status : (t,) DescentStatus. iterations : (t,) steps taken.
    start : warm start of the last points at which rows were evaluated and accepted.
    deviation_history, cost_history : (i + 1, t, p) and (i + 1, t) after each round; trials that
        have ended repeat.
    is_start_exhausted : whether the steps ran out in a search for a start before it.
    """

    deviation: FloatArray
    linear_model: LinearModel
    cost: FloatArray
    status: IntArray
    iterations: IntArray
    start: Start
    deviation_history: FloatArray
    cost_history: FloatArray
    is_start_exhausted: bool = False

    @property
    def decomposition(self) -> Decomposition:
        """The decomposition of the rows next to `deviation`, for the total deviation."""
        return self.linear_model.decomposition

    @property
    def penalty(self) -> FloatArray:
        """(t, p) what the method penalized there."""
        return self.linear_model.penalty

    def after(self, first: Descent) -> Descent:
        """Return this descent with the steps of the one that led to its start before its own."""
        return replace(
            self,
            is_start_exhausted=self.is_start_exhausted or first.is_start_exhausted,
            iterations=first.iterations + self.iterations,
            deviation_history=np.concatenate([first.deviation_history, self.deviation_history[1:]]),
            cost_history=np.concatenate([first.cost_history, self.cost_history[1:]]),
        )

    def put(self, trials: IntArray, other: Descent) -> Descent:
        """Return this descent with where some trials ended taken from another one; start and
        history stay.
        """
        names = ("deviation", "cost", "status", "iterations")
        arrays = {name: np.array(getattr(self, name)) for name in names}
        for name, array in arrays.items():
            array[trials] = getattr(other, name)
        decomposition = self.decomposition.with_dual().put(trials, other.decomposition.with_dual())
        penalty = self.penalty.copy()
        penalty[trials] = other.penalty
        return replace(self, **arrays, linear_model=SpectralModel(decomposition, penalty))


def descend(
    problem: LeastSquaresProblem,
    deviation: FloatArray,
    method: Method,
    control: StepControl | None = None,
    tolerance: float = RANK_TOLERANCE,
    start: Start | None = None,
    progress: Progress = report_no_progress,
    arrival: FloatArray | None = None,
    sufficient: float = 0.0,
    ends_weak: bool = False,
) -> Descent:
    """Minimize the whitened sum of squares, filtered by the method.

    A trial that fails is marked in `status` and never stops the others.

    deviation : (t, p) where to begin, in spreads. tolerance : relative rank tolerance.
    start : warm start; default: the first one of the problem.
    progress : receives each step with the sum of squares of the first trial.
    arrival : (t,), optional; by how much the step that led to `deviation` changed the whitened
        residuals.
    sufficient : a trial has also converged where this step and all further ones together would
        change the whitened residuals by less than that, apart from the step itself, which is taken.
        They become shorter at least by the ratio of the last two.
    ends_weak : end a trial, as one without progress, where the method must hold directions, see
        `Method.find_weak`.
    """
    control = control or StepControl()
    z = np.array(deviation, dtype=np.float64)
    progress(0, 1, "fitting")
    with np.errstate(over="ignore", invalid="ignore"):  # reported as a bad start
        begin = problem.start(z) if start is None else start
        may_be_weak = ends_weak and method.unpenalized(z.shape[1]) is not None
        is_plain = arrival is None and not (sufficient or control.damping or may_be_weak)
        fixed = fix_penalty(method, problem.parameters)
        way = _advance(problem, z, begin, fixed, control, tolerance) if is_plain else None
        first = way[0] if way else _linearize(problem, z, begin)
    arrival = np.full(len(z), way[1].change if way else np.inf) if arrival is None else arrival
    taken = len(way[1].costs) - 1 if way else 0

    def model_start() -> LinearModel:
        return make_linear_model(_linearize(problem, z, begin), method, tolerance, fixed)

    at_start = model_start if taken else None
    at = first, arrival, taken, at_start
    run = _Run(problem, method, fixed, tolerance, control, sufficient, *at)
    if may_be_weak:
        is_weak = method.find_weak(run.point.linear_model.decomposition).any(axis=1)
        run.status = np.where(is_weak, DescentStatus.NO_PROGRESS.value, run.status)
    deviations, costs = [z.copy()], [run.point.cost.copy()]

    def observe(z: FloatArray, cost: FloatArray) -> None:
        deviations.append(z.copy())
        costs.append(cost.copy())
        progress(0, 1, f"fitting, step {len(costs) - 1}: sum of squares {costs[-1][0]:.4g}")

    if way:
        costs = [way[1].costs[:1]]
        for reached, cost in zip(way[1].deviations[1:], way[1].costs[1:], strict=True):
            observe(reached[None], cost[None])
    for i in range(taken, control.iterations + 1):
        if run.accept_chains():
            observe(run.point.z, run.point.cost)
        active = np.flatnonzero(run.status == DescentStatus.RUNNING.value)
        if not active.size:
            break
        active, current, step = run.propose(active)
        if not active.size or i == control.iterations:
            break
        if run.evaluate(active, current, step, i):
            observe(run.point.z, run.point.cost)
    running = run.status == DescentStatus.RUNNING.value
    run.status[running] = DescentStatus.OUT_OF_ITERATIONS
    last = run.point
    if (last.z != deviations[-1]).any():
        deviations.append(last.z)
        costs.append(last.cost)
    return Descent(
        deviation=last.z,
        linear_model=last.linear_model,
        cost=last.cost,
        status=run.status,
        iterations=run.taken,
        start=last.start,
        deviation_history=np.stack(deviations),
        cost_history=np.stack(costs),
    )


def _advance(
    problem: LeastSquaresProblem,
    z: FloatArray,
    begin: Start,
    fixed: FloatArray | None,
    control: StepControl,
    tolerance: float,
) -> tuple[Linearization, Advanced] | None:
    """Return the linearization to which full steps of one trial lead from z (1, p), and the way
    there, by one call of the engine; None where steps must be taken one by one.
    """
    advance = getattr(problem, "advance", None)
    if advance is None or fixed is None:
        return None
    most, limits = min(control.iterations, PATIENCE), (control.relative, control.absolute)
    rules = FURTHER, SLOWEST, ACCEPTED_SHARE, ROUNDING, certain_share(tolerance)
    return advance(z, begin, Steps(z[0], fixed, most, np.inf, *limits, *rules))


@dataclass(frozen=True, eq=False)
class _Point(TrialBatch):
    """Deviations z (a, p) with sums of squares (a,), linear model and warm start.

    arrival : (a,) by how much the full step that led there changed the whitened residuals to first
    order; infinite where it was damped, or at the start.
    """

    z: FloatArray
    cost: FloatArray
    linear_model: LinearModel
    start: Start
    arrival: FloatArray

    def propose(self, damping: FloatArray) -> FilteredStep:
        """Return the steps, damped by `damping` (a,)."""
        return self.linear_model.propose(self.z, damping)

    @property
    def objective(self) -> FloatArray:
        """(a,) sum of squares plus penalty."""
        return self.cost + self.linear_model.penalize(self.z)

    @property
    def spread(self) -> FloatArray:
        """(a,) 1 + |z|, with which lengths of steps are compared."""
        return 1.0 + np.linalg.norm(self.z, axis=1)


class _Candidate(NamedTuple):
    """The linearization at proposed deviations; its linear model is made where it is needed."""

    run: _Run
    linearized: Linearization
    arrival: FloatArray

    def take(self, trials: np.ndarray) -> _Point:
        """Return the points of some trials."""
        if len(trials) == len(self.arrival):
            return self.run.locate(self.linearized, self.arrival)
        needed = replace(self.linearized, nuisance=None, poses=None)  # the rest is not copied
        return self.run.locate(needed.take(trials), self.arrival[trials])


class _Run:
    """One descent of t trials: its working memory."""

    def __init__(
        self,
        problem: LeastSquaresProblem,
        method: Method,
        fixed: FloatArray | None,
        tolerance: float,
        control: StepControl,
        sufficient: float,
        first: Linearization,
        arrival: FloatArray,
        taken: int,
        at_start: Callable[[], LinearModel] | None,
    ) -> None:
        self.problem, self.method, self.fixed, self.tolerance = problem, method, fixed, tolerance
        self.control, self.sufficient = control, sufficient
        self.point, t = self.locate(first, arrival), len(first.deviation)
        running, bad = DescentStatus.RUNNING.value, DescentStatus.BAD_START.value
        self.status = np.where(np.isfinite(self.point.cost), running, bad).astype(int)
        self.taken = np.full(t, taken)
        self.chains = _FullSteps(self.point, taken)
        model = self.point.linear_model  # without the rows of the start, and without this run
        self.damping = _Damping(t, control.damping, at_start or (lambda: model))
        self.marks = np.full((t, 3), np.inf)  # of the last progress, and evaluations since then
        self.age = np.zeros(t, dtype=np.int64)

    def locate(self, linearized: Linearization, arrival: FloatArray) -> _Point:
        """Return the points of a linearization."""
        linear_model = make_linear_model(linearized, self.method, self.tolerance, self.fixed)
        z, start = linearized.deviation, linearized.next_start
        return _Point(z, linearized.cost, linear_model, start, arrival)

    def accept_chains(self) -> bool:
        """Move trials to the lower points that chains of full steps reached; return whether any."""
        if not self.chains.is_ahead.any():
            return False
        arrived, lower = self.chains.find_arrived()
        if not arrived.size:
            return False
        self.point = self.point.put(arrived, lower)
        self.damping.release(arrived)
        self.taken[arrived] += 1
        return True

    def propose(self, active: IntArray) -> tuple[IntArray, _Point, FilteredStep]:
        """Return the trials (a,) that go on, their points and steps; end those that converged,
        after their full step and with the linear model before it.
        """
        damping, current = self.damping.value[active], self.point.take(active)
        self.chains.start_due(self.point, active, damping)
        if self.chains.is_ahead.any():
            current = self.chains.replace_points(current, active)
            damping = np.where(self.chains.is_ahead[active], 0.0, damping)
        step = current.propose(damping)
        is_last = self.is_negligible(current, step)
        if self.chains.is_ahead.any():
            is_last &= ~self.chains.is_away(active)
        if is_last.any():
            last, going = active[is_last], np.flatnonzero(~is_last)
            self.chains.is_ahead[last] = False
            self.status[last] = DescentStatus.CONVERGED
            self._take_last(last, step.target[is_last])
            active = active[going]
            if active.size:
                current, step = current.take(going), step.take(going)
        return active, current, step

    def _take_last(self, trials: IntArray, target: FloatArray) -> None:
        """Move trials (a,) to the ends (a, p) of their full steps; the rows stay those before."""
        z = self.point.z.copy()
        z[trials] = target
        self.point, self.taken[trials] = replace(self.point, z=z), self.taken[trials] + 1

    def is_negligible(self, point: _Point, step: FilteredStep) -> BoolArray:
        """Return which steps are the last."""
        change, limit = np.sqrt(step.change), self.control.relative * np.sqrt(point.cost)
        ratio = change / np.maximum(point.arrival, np.finfo(np.float64).tiny)
        remaining = change * ratio / np.maximum(1.0 - ratio, SLOWEST)
        by_residuals = (change <= limit) & (remaining <= FURTHER * limit)
        is_last = by_residuals | (step.full_length <= self.control.absolute * point.spread)
        if not self.sufficient:
            return is_last
        is_known = np.isfinite(point.arrival) & (ratio <= CONTRACTION)
        return is_last | (is_known & (remaining <= self.sufficient))

    def evaluate(
        self, active: IntArray, current: _Point, step: FilteredStep, round_number: int
    ) -> bool:
        """Evaluate steps of trials (a,) and take those that are accepted; return whether any."""
        linearized = self.problem.take(active).linearize(step.deviation, current.start)
        candidate = _Candidate(self, _clear_failed(linearized), np.sqrt(step.change))
        cost, chains, reference = candidate.linearized.cost, self.chains, current
        ahead = chains.is_ahead[active]
        if has_chains := ahead.any():
            reference, step = self.point.take(active), chains.expect(step, active)
        accepted, ratio = _judge(reference, step, cost)
        status = _find_ending(reference, step, cost, accepted)
        single, was_full = np.flatnonzero(~ahead), self.damping.value[active] == 0.0
        if has_chains:
            self.damping.adapt(active[single], accepted[single], ratio[single])
            status = np.where(ahead, DescentStatus.RUNNING.value, status)
        else:
            self.damping.adapt(active, accepted, ratio)
        self.status[active] = status
        # a sum of squares tells less than its gradient: the step is right, its gain is lost in
        # rounding
        met_rounding = (status == DescentStatus.CONVERGED.value) & (cost <= AS_LOW * reference.cost)
        if met_rounding.any():
            self._take_last(active[met_rounding], step.target[met_rounding])
        chains.record(step, candidate, active, accepted, ratio, was_full)
        if round_number >= PATIENCE:  # most trials have converged before
            finite = np.isfinite(cost)[single]
            self._end_stalled(active[single], finite, reference.take(single), step.take(single))
        is_taken = accepted & ~ahead
        if not is_taken.any():
            return False
        moved = active[is_taken]
        self.taken[moved] += 1
        self.point = self.point.put(moved, candidate.take(np.flatnonzero(is_taken)))
        return True

    def _end_stalled(
        self, trials: IntArray, is_finite: BoolArray, point: _Point, step: FilteredStep
    ) -> None:
        """End trials (a,) that made no progress within `PATIENCE` evaluations."""
        values = np.stack([point.objective, step.full_length, self.damping.value[trials]], axis=1)
        progress = values < np.array([LESS_COST, LESS_LENGTH, LESS_DAMPING]) * self.marks[trials]
        self.marks[trials] = np.where(progress, values, self.marks[trials])
        age = np.where(progress.any(axis=1), 0, self.age[trials])
        self.age[trials] = age + np.where(is_finite, 1, NOT_FINITE)
        running = self.status[trials] == DescentStatus.RUNNING.value
        stalled = self.age[trials] >= PATIENCE
        self.status[trials[stalled & running]] = DescentStatus.NO_PROGRESS


class _Damping:
    """Levenberg-Marquardt damping of t trials by Nielsen's rule: working memory of one iteration.

    first : damping of the first step, in units of these squares.
    start : gives its linear model, whose largest squared singular values scale the damping.
    """

    def __init__(self, trials: int, first: float, start: Callable[[], LinearModel]) -> None:
        self._start = start
        self.value: FloatArray = np.zeros(trials)
        if first:
            self.value = first * self._measure_curvature(np.arange(trials))
        self.growth: FloatArray = np.full(trials, 2.0)
        self._floor = np.full(trials, np.nan)

    @cached_property
    def _model(self) -> LinearModel:
        return self._start()

    def _measure_curvature(self, trials: IntArray) -> FloatArray:
        """Return the largest squared singular values (a,) of some trials."""
        s = self._model.take(trials).decomposition.singular_values
        return s.max(axis=1, initial=0.0) ** 2

    def adapt(self, trials: IntArray, accepted: BoolArray, ratio: FloatArray) -> None:
        """Lower the damping after a good step; raise it ever faster after rejected ones.

        `ratio` (a,) is the decrease over the predicted one.
        """
        if accepted.all() and not self.value[trials].any():
            self.growth[trials] = 2.0
            return
        unknown = trials[~accepted & np.isnan(self._floor[trials])]
        if unknown.size:
            self._floor[unknown] = FIRST_DAMPING * self._measure_curvature(unknown)
        less = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.clip(ratio, 0.0, 1.0) - 1.0) ** 3)
        more = np.fmax(self.value[trials] * self.growth[trials], self._floor[trials])
        self.value[trials] = np.where(accepted, self.value[trials] * less, more)
        self.growth[trials] = np.where(accepted, 2.0, 2.0 * self.growth[trials])

    def release(self, trials: IntArray) -> None:
        """Remove the damping of some trials."""
        self.value[trials], self.growth[trials] = 0.0, 2.0


class _FullSteps:
    """Chains of full steps of t trials: working memory of one iteration.

    `is_ahead` (t,) are the trials with a chain.
    """

    def __init__(self, point: _Point, taken: int) -> None:
        self._point, trials = point, len(point.z)
        self.is_ahead: BoolArray = np.zeros(trials, dtype=bool)
        self._is_low = np.zeros(trials, dtype=bool)
        self._count, self._taken = np.zeros(trials, dtype=np.int64), np.full(trials, taken)
        self._wait = np.full(trials, FIRST_WAIT)
        self._length, self._promised = np.zeros(trials), np.zeros(trials)

    def find_arrived(self) -> tuple[IntArray, _Point]:
        """End the chains that reached a lower point or led nowhere.

        Return the trials (a,) that reached a lower point, and these points.
        """
        ahead = np.flatnonzero(self.is_ahead)
        points_ahead = self._point.take(ahead)
        length = points_ahead.propose(np.zeros(len(ahead))).full_length
        contracts = length <= CHAIN_CONTRACTION * self._length[ahead]
        is_lower = contracts & self._is_low[ahead]
        goes_on = contracts & ~is_lower & (self._count[ahead] < LONGEST_CHAIN)
        self._end(ahead[~goes_on & ~is_lower])
        arrived = ahead[is_lower]
        self.is_ahead[arrived], self._wait[arrived], self._taken[arrived] = False, FIRST_WAIT, 0
        return arrived, points_ahead.take(np.flatnonzero(is_lower))

    def start_due(self, point: _Point, active: IntArray, damping: FloatArray) -> None:
        """Begin chains at the points of trials (a,) that took enough damped steps."""
        if not damping.any():
            return
        due = (damping > 0.0) & (self._taken[active] >= self._wait[active])
        due &= ~self.is_ahead[active]
        if due.any():
            trials = active[due]
            self._begin(trials, point.take(trials), 0)

    def is_away(self, active: IntArray) -> BoolArray:
        """Return which trials (a,) are at a point of a chain that is not accepted."""
        return self.is_ahead[active] & (self._count[active] > 0)

    def replace_points(self, current: _Point, active: IntArray) -> _Point:
        """Return the points of trials (a,), those of chains where a chain goes on."""
        ahead = np.flatnonzero(self.is_ahead[active])
        return current if not ahead.size else current.put(ahead, self._point.take(active[ahead]))

    def expect(self, step: FilteredStep, active: IntArray) -> FilteredStep:
        """Return steps (a,) with the decrease that the first full step of their chain predicted."""
        is_first = self.is_ahead[active] & (self._count[active] == 0)
        self._promised[active[is_first]] = step.predicted[is_first]
        self._length[active] = step.full_length
        promised = np.where(self.is_ahead[active], self._promised[active], step.predicted)
        return replace(step, predicted=promised)

    def record(
        self,
        step: FilteredStep,
        candidate: _Candidate,
        active: IntArray,
        accepted: BoolArray,
        ratio: FloatArray,
        is_full: BoolArray,
    ) -> None:
        """Record what was evaluated at the ends of steps (a,).

        Chains begin where a full step was refused; `is_full` (a,) are the undamped steps, `ratio`
        (a,) the decrease over the predicted one.
        """
        if accepted.all() and not self.is_ahead.any():
            self._taken[active] += 1
            return
        ahead, finite = self.is_ahead[active], np.isfinite(candidate.linearized.cost)
        self._taken[active[accepted & ~ahead]] += 1
        begun = ~ahead & ~accepted & is_full & finite
        if begun.any():
            trials = active[begun]
            self._promised[trials] = step.predicted[begun]
            self._length[trials] = step.full_length[begun]
            self._begin(trials, candidate.take(np.flatnonzero(begun)), 1)
        moved = ahead & finite
        if moved.any():
            trials = active[moved]
            self._point = self._point.put(trials, candidate.take(np.flatnonzero(moved)))
            self._is_low[trials] = accepted[moved] & (ratio[moved] >= LEAST_GAIN)
            self._count[trials] += 1
        self._end(active[ahead & ~finite])

    def _begin(self, trials: IntArray, first: _Point, count: int) -> None:
        """Begin chains at the points `first`."""
        self._point = self._point.put(trials, first)
        self.is_ahead[trials], self._is_low[trials], self._count[trials] = True, False, count

    def _end(self, trials: IntArray) -> None:
        """End chains that led nowhere."""
        again = trials[self._taken[trials] >= self._wait[trials]]
        self._wait[again] *= 2
        self.is_ahead[trials], self._taken[trials] = False, 0


def _judge(point: _Point, step: FilteredStep, cost: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Return which steps bring a share of the decrease that was predicted, and the ratio of both;
    `cost` (a,) is the sum of squares after the steps.
    """
    before = point.objective
    after = cost + point.linear_model.penalize(step.deviation)
    gained = before - after + ROUNDING * before
    # a truncated direction on its way back to nominal may cost something: up to twice what was
    # predicted
    needed = np.where(step.predicted > 0.0, ACCEPTED_SHARE, 2.0) * step.predicted
    smallest = np.finfo(np.float64).tiny
    return gained >= needed, gained / np.maximum(np.abs(step.predicted), smallest)


def _find_ending(
    point: _Point, step: FilteredStep, cost: FloatArray, accepted: BoolArray
) -> IntArray:
    """Return the status (a,): trials end that met rounding, or whose steps became too short."""
    spread, good = point.spread, np.isfinite(cost)
    met_rounding = good & (step.full_length <= ROUNDING_STEP * spread)
    is_stuck = ~accepted & (met_rounding | (step.length <= SHORTEST_STEP * spread))
    converged = good & (step.full_length <= SMALL_STEP * spread)
    ending = np.where(converged, DescentStatus.CONVERGED.value, DescentStatus.NO_DESCENT.value)
    return np.where(is_stuck, ending, DescentStatus.RUNNING.value)


def _linearize(problem: LeastSquaresProblem, z: FloatArray, start: Start) -> Linearization:
    """Linearize where a descent begins."""
    return replace(_clear_failed(problem.linearize(z, start)), deviation=z)


def _clear_failed(linearized: Linearization) -> Linearization:
    """Return a linearization with infinite cost and no rows where one of them is not finite."""
    is_finite = np.isfinite(linearized.cost) & np.isfinite(linearized.factor).all(axis=(1, 2))
    if is_finite.all():
        return linearized
    factor = np.where(is_finite[:, None, None], linearized.factor, 0.0)
    return replace(linearized, factor=factor, cost=np.where(is_finite, linearized.cost, np.inf))
