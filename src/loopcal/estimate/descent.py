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

from loopcal.engine import fold
from loopcal.errors import EstimationError
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.penalties import FixedPenalty, Method, decompose_for, fix_penalty
from loopcal.measure.array_checks import check_type
from loopcal.numerics.decomposition import (
    RANK_TOLERANCE,
    Decomposition,
    empty_factor,
    solve_regular,
)
from loopcal.numerics.gauss_newton import ROUNDING, Damping, DescentStatus, Model, minimize
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress


@dataclass(frozen=True, eq=False)
class FilteredStep(TrialBatch):
    """A step of some trials towards the filtered solution.

    Attributes
    ----------
    deviation : (a, p) total deviation to which it leads. target : (a, p) that of the full step.
    length, full_length : (a,) of this step and of the full one, in tolerances.
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


def propose_step(
    deviation: FloatArray, decomposition: Decomposition, penalty: FloatArray, damping: FloatArray
) -> FilteredStep:
    """Return the step from `deviation` (a, p) to the filtered solution, damped by mu (a,)."""
    s, c = decomposition.singular_values, decomposition.projections
    current = decomposition.coordinates(deviation)
    solution = decomposition.solution(penalty)
    full = solution - current
    # a direction that is not used is as stiff as the weakest one that is
    used, stiffness = np.isfinite(penalty), s**2 + _finite(penalty)
    weakest = np.where(used, stiffness, np.inf).min(axis=1, initial=np.inf)
    others = np.where(np.isfinite(weakest), weakest, 1.0)[:, None]
    curvature = np.where(used, stiffness, others)
    new = current + curvature / (curvature + damping[:, None]) * full
    # differences of squares as products, so that a small decrease is not lost in a large sum
    data = s * (current - new) * (s * (current + new) - 2.0 * c)
    prior = _finite(penalty) * (current - new) * (current + new)
    reached = decomposition.deviation(new)
    return FilteredStep(
        deviation=reached,
        target=decomposition.deviation(solution),
        length=np.linalg.norm(reached - deviation, axis=1),
        full_length=np.linalg.norm(decomposition.deviation(full), axis=1),
        predicted=(data + prior).sum(axis=1),
        change=(curvature * full**2).sum(axis=1),
    )


def penalize(
    decomposition: Decomposition, penalty: FloatArray, deviation: FloatArray
) -> FloatArray:
    """Return what the penalty adds to the sum of squares at `deviation` (a, p).

    It is the sum of penalty_i (v_i'z)^2, (a,), without directions that are not used.
    """
    weight = _finite(penalty)
    if not weight.any():
        return np.zeros(len(deviation))
    return (weight * decomposition.coordinates(deviation) ** 2).sum(axis=1)


def _finite(penalty: FloatArray) -> FloatArray:
    """Return the penalty with zero for directions that are not used."""
    return np.where(np.isfinite(penalty), penalty, 0.0)


@dataclass(frozen=True, eq=False)
class SpectralModel(TrialBatch):
    """The decomposition of the rows, and the penalty (t, p) that the method chose from it."""

    decomposition: Decomposition
    penalty: FloatArray

    def propose(self, deviation: FloatArray, damping: FloatArray) -> FilteredStep:
        """Return the steps from deviations (t, p), damped by (t,)."""
        return propose_step(deviation, self.decomposition, self.penalty, damping)

    def penalize(self, deviation: FloatArray) -> FloatArray:
        """Return what the penalty adds to the sum of squares (t,) at deviations (t, p)."""
        return penalize(self.decomposition, self.penalty, deviation)


@dataclass(frozen=True, eq=False)
class TriangularModel(TrialBatch):
    """The triangular factor of the rows, for a penalty that does not depend on them.

    Attributes
    ----------
    factor : (t, p + 1, p + 1) of rows [A | r]. deviation : (t, p) where they were linearized.
    equations : (t,) that were folded.
    step : (t, p) the full step. gain : (t,) decrease by it of the sum of squares with penalties, as
        the linear model predicts it. is_regular : (t,) where these are known; elsewhere a direction
        might not count, and the decomposition decides.
    method, tolerance, fixed : the method, its rank tolerance and its penalty.
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
    fixed: FixedPenalty

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
            return propose_step(deviation, self.decomposition, self.penalty, damping)
        target = deviation + self.step
        length = np.linalg.norm(self.step, axis=1)
        full = FilteredStep(target, target, length, length, self.gain, self.gain)
        if is_simple.all():
            return full
        others = np.flatnonzero(~is_simple)
        return full.put(others, self.take(others).propose(deviation[others], damping[others]))

    def penalize(self, deviation: FloatArray) -> FloatArray:
        """Return what the penalty adds to the sum of squares (t,) at deviations (t, p)."""
        if not len(self.fixed.rows):
            return np.zeros(len(deviation))
        return (self.fixed.evaluate(deviation) ** 2).sum(axis=1)


LinearModel = SpectralModel | TriangularModel
"""The linear model at the points of t trials."""


def make_linear_model(
    linearized: Linearization, method: Method, tolerance: float, fixed: FixedPenalty | None
) -> LinearModel:
    """Return the linear model of linearized rows; `fixed` is that of `fix_penalty`."""
    factor, equations, z = linearized.factor, linearized.equations, linearized.deviation
    if fixed is None:
        decomposition = decompose_for(method, factor, equations, z, tolerance)
        penalty = np.array(method.penalty(decomposition), dtype=np.float64)
        return SpectralModel(decomposition, penalty)
    p = z.shape[1]
    triangle, residual = fixed.scale_columns(factor[:, :p, :p]), factor[:, :p, p]
    if len(fixed.rows) or not fixed.is_triangular:
        triangle, residual = _append_penalty(triangle, residual, fixed, z)
    u, is_regular = solve_regular(triangle, -residual, tolerance)
    gain = (residual**2).sum(axis=1)
    step = fixed.to_deviation(u)
    return TriangularModel(factor, z, equations, step, gain, is_regular, method, tolerance, fixed)


def _append_penalty(
    triangle: FloatArray, residual: FloatArray, fixed: FixedPenalty, deviation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the triangular factor (t, p, p) and the residual (t, p) of rows and penalty."""
    t, p = residual.shape
    factor = empty_factor(t, p)
    factor[:, :p, :p], factor[:, :p, p] = triangle, residual
    rows = np.empty((t, len(fixed.rows), p + 1))
    rows[:, :, :p], rows[:, :, p] = fixed.rows, fixed.evaluate(deviation)
    if fixed.is_triangular:
        factor = fold(factor, rows)
    else:
        factor = fold(empty_factor(t, p), np.concatenate([factor[:, :p], rows], axis=1))
    return factor[:, :p, :p], factor[:, :p, p]


ACCEPTED_SHARE = 1e-4
"""Share of the predicted decrease that a step must bring."""

ROUNDING_STEP, SMALL_STEP, SHORTEST_STEP = 1e-6, 1e-3, 1e-9
"""Lengths in tolerances, relative to 1 + |z|. A full step below ROUNDING_STEP that brings no
decrease has met rounding: the trial converged. So has one that was damped below SHORTEST_STEP
without a decrease, if its full step is below SMALL_STEP."""

MOST_ITERATIONS = 1000
"""Evaluations of the rows: far more than fits need, since those without progress end early."""

CONTRACTION = 0.25
"""Largest ratio of two steps from which the lengths of further ones are expected."""

FIRST_DAMPING = 1e-6
"""Damping after the first rejected step, in units of the largest squared singular value."""


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


@dataclass(frozen=True, eq=False)
class FunctionProblem:
    """A least-squares problem that is given by a function.

    Parameters
    ----------
    parameters : number of unknowns p.
    evaluate : from deviations (a, p) and numbers of trials (a,) to factor (a, p + 1, p + 1) and sum
        of squares (a,). equations : (t,) of each trial. trials : (t,) numbers, default all.
    """

    parameters: int
    evaluate: Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]]
    equations: IntArray
    trials: IntArray | None = None

    def start(self, deviation: FloatArray) -> Start:
        """Return a start without nuisance parameters and poses."""
        t, p = deviation.shape
        return Start(deviation, np.zeros((t, 0)), np.zeros((t, 0, p)), np.zeros((t, 0)))

    def linearize(self, deviation: FloatArray, start: Start) -> Linearization:
        """Evaluate the function."""
        factor, cost = self.evaluate(deviation, self._numbers)
        return Linearization(deviation, factor, cost, self.equations, start)

    def take(self, trials: IntArray) -> FunctionProblem:
        """Return the problem of some trials."""
        return replace(self, equations=self.equations[trials], trials=self._numbers[trials])

    @property
    def _numbers(self) -> IntArray:
        """(t,) numbers of the trials."""
        return np.arange(len(self.equations)) if self.trials is None else self.trials


@dataclass(frozen=True)
class StepControl:
    """Settings of the descent.

    Parameters
    ----------
    iterations : evaluations of the rows after the first, at most.
    relative : converged when the step changes the whitened residuals by at most this share of their
        norm. That step is still taken, without evaluating the rows again: the result is the
        solution of the last decomposition.
    absolute : converged when the step is at most this long, in tolerances, relative to 1 + |z|.
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
                    f"{name} is {getattr(self, name)}; give a finite number above 0"
                )
        if self.iterations < 0:
            raise EstimationError(f"iterations is {self.iterations}; give 0 or more")
        if not 0.0 <= self.damping < np.inf:
            raise EstimationError(f"damping is {self.damping}; give 0 or a finite number above it")


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the descent ended.

    Attributes
    ----------
    deviation : (t, p) total deviation z from nominal, in tolerances.
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
) -> Descent:
    """Minimize the whitened sum of squares, filtered by the method.

    A trial that fails is marked in `status` and never stops the others.

    Parameters
    ----------
    deviation : (t, p) where to begin, in tolerances. tolerance : relative rank tolerance.
    start : warm start; default: the first one of the problem.
    progress : receives each step with the sum of squares of the first trial.
    arrival : (t,), optional; by how much the step that led to `deviation` changed the whitened
        residuals.
    sufficient : a trial has also converged where this step and all further ones together would
        change the whitened residuals by less than that, apart from the step itself, which is taken.
        They become shorter at least by the ratio of the last two.
    """
    control = control or StepControl()
    fixed = fix_penalty(method, problem.parameters)
    model = _FilteredDescent(problem, method, tolerance, control, fixed, sufficient)
    z = np.array(deviation, dtype=np.float64)
    progress(0, 1, "fitting")
    with np.errstate(over="ignore", invalid="ignore"):  # reported as a bad start
        begin = problem.start(z) if start is None else start
        first = _clear_failed(problem.linearize(z, begin))
    arrival = np.full(len(z), np.inf) if arrival is None else arrival
    point = model.locate(replace(first, deviation=z), arrival)
    linear_model = point.linear_model
    deviations, costs = [z.copy()], [point.cost.copy()]

    def observe(moved: _Point) -> None:
        deviations.append(moved.z.copy())
        costs.append(moved.cost.copy())
        progress(0, 1, f"fitting, step {len(costs) - 1}: sum of squares {moved.cost[0]:.4g}")

    def measure_curvature(trials: IntArray) -> FloatArray:
        decomposition = linear_model.take(trials).decomposition
        return decomposition.singular_values.max(axis=1, initial=0.0) ** 2

    first_damping = np.zeros(len(z))
    if control.damping:
        first_damping = control.damping * measure_curvature(np.arange(len(z)))
    damping = Damping(first_damping, lambda trials: FIRST_DAMPING * measure_curvature(trials))
    minimum = minimize(model, point, damping, control.iterations, observe)
    last: _Point = minimum.point
    if (last.z != deviations[-1]).any():
        deviations.append(last.z)
        costs.append(last.cost)
    return Descent(
        deviation=last.z,
        linear_model=last.linear_model,
        cost=last.cost,
        status=minimum.status,
        iterations=minimum.iterations,
        start=last.start,
        deviation_history=np.stack(deviations),
        cost_history=np.stack(costs),
    )


def _clear_failed(linearized: Linearization) -> Linearization:
    """Return a linearization with infinite cost and no rows where one of them is not finite."""
    is_finite = np.isfinite(linearized.cost) & np.isfinite(linearized.factor).all(axis=(1, 2))
    if is_finite.all():
        return linearized
    factor = np.where(is_finite[:, None, None], linearized.factor, 0.0)
    return replace(linearized, factor=factor, cost=np.where(is_finite, linearized.cost, np.inf))


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

    @property
    def spread(self) -> FloatArray:
        """(a,) 1 + |z|, with which lengths of steps are compared."""
        return 1.0 + np.linalg.norm(self.z, axis=1)


class _Candidate(NamedTuple):
    """The linearization at proposed deviations; its linear model is made where it is needed."""

    model: _FilteredDescent
    linearized: Linearization
    arrival: FloatArray

    @property
    def cost(self) -> FloatArray:
        """(a,) sums of squares, infinite where the rows are not finite."""
        return self.linearized.cost

    def take(self, trials: IntArray) -> _Point:
        """Return the points of some trials."""
        needed = replace(self.linearized, nuisance=None, poses=None)  # the rest is not copied
        return self.model.locate(needed.take(trials), self.arrival[trials])


@dataclass(frozen=True, eq=False)
class _FilteredDescent(Model):
    """The rules of the descent for `loopcal.numerics.gauss_newton.minimize`."""

    problem: LeastSquaresProblem
    method: Method
    tolerance: float
    control: StepControl
    fixed: FixedPenalty | None
    sufficient: float

    def locate(self, linearized: Linearization, arrival: FloatArray) -> _Point:
        """Return the points of a linearization."""
        linear_model = make_linear_model(linearized, self.method, self.tolerance, self.fixed)
        z, start = linearized.deviation, linearized.next_start
        return _Point(z, linearized.cost, linear_model, start, arrival)

    def propose(self, point: _Point, damping: FloatArray) -> FilteredStep:
        """Return the damped steps."""
        return point.linear_model.propose(point.z, damping)

    def is_negligible(self, point: _Point, step: FilteredStep) -> BoolArray:
        """Return which steps are the last."""
        by_residuals = step.change <= self.control.relative**2 * point.cost
        is_last = by_residuals | (step.full_length <= self.control.absolute * point.spread)
        if not self.sufficient:
            return is_last
        change = np.sqrt(step.change)
        ratio = change / np.maximum(point.arrival, np.finfo(np.float64).tiny)
        remaining = change * ratio / np.maximum(1.0 - ratio, 1.0 - CONTRACTION)
        return is_last | ((ratio <= CONTRACTION) & (remaining <= self.sufficient))

    def finish(self, point: _Point, step: FilteredStep, trials: IntArray) -> _Point:
        """Return the points, some after their full step, without copies of the linear model."""
        z = point.z.copy()
        z[trials] = step.target
        return replace(point, z=z)

    def evaluate(self, point: _Point, step: FilteredStep, trials: IntArray) -> _Candidate:
        """Linearize at the deviations of the steps."""
        linearized = self.problem.take(trials).linearize(step.deviation, point.start)
        is_full = step.length >= step.full_length
        arrival = np.where(is_full, np.sqrt(step.change), np.inf)
        return _Candidate(self, _clear_failed(linearized), arrival)

    def judge(
        self, point: _Point, step: FilteredStep, candidate: _Candidate
    ) -> tuple[BoolArray, FloatArray]:
        """Accept steps that bring a share of the decrease that was predicted."""
        before = self.objective(point)
        after = candidate.cost + point.linear_model.penalize(step.deviation)
        gained = before - after + ROUNDING * before
        # a truncated direction on its way back to nominal may cost something: up to twice what was
        # predicted
        needed = np.where(step.predicted > 0.0, ACCEPTED_SHARE, 2.0) * step.predicted
        smallest = np.finfo(np.float64).tiny
        return gained >= needed, gained / np.maximum(np.abs(step.predicted), smallest)

    def objective(self, point: _Point) -> FloatArray:
        """Return the sum of squares plus penalty."""
        return point.cost + point.linear_model.penalize(point.z)

    def ending(
        self, point: _Point, step: FilteredStep, candidate: _Candidate, accepted: BoolArray
    ) -> IntArray:
        """End trials that met rounding, or whose steps became too short."""
        spread, good = point.spread, np.isfinite(candidate.cost)
        met_rounding = good & (step.full_length <= ROUNDING_STEP * spread)
        is_stuck = ~accepted & (met_rounding | (step.length <= SHORTEST_STEP * spread))
        converged = good & (step.full_length <= SMALL_STEP * spread)
        ending = np.where(converged, DescentStatus.CONVERGED.value, DescentStatus.NO_DESCENT.value)
        return np.where(is_stuck, ending, DescentStatus.RUNNING.value)
