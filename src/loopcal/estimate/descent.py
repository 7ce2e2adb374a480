# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton on whitened, scaled rows with step control, many trials at once and each on its own.

At every accepted point the rows are one triangular factor and that factor one decomposition. The
first step tried is the full one to the filtered solution for the TOTAL deviation z from nominal;
where it does not lower the sum of squares, Levenberg-Marquardt damping shortens it, adapted as by
Nielsen. Trials that ended are frozen. Sources: Madsen, Nielsen, Tingleff, "Methods for non-linear
least squares problems" (2004); docs/theory/estimation.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Protocol

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.steps import Step, penalised, propose
from loopcal.numerics.decomposition import RANK_TOLERANCE, Decomposition, decompose
from loopcal.typing import BoolArray, FloatArray, IntArray

ACCEPT = 1e-4
"""Share of the predicted decrease that a step must bring."""

ROUNDING = 1e-12
"""Change of the sum of squares, relative, that is rounding and says nothing about a step."""

TINY, SMALL, SHORTEST = 1e-6, 1e-3, 1e-9
"""Lengths in tolerances, relative to 1 + |z|. A full step below TINY that brings no decrease has
met rounding:
converged. Damped below SHORTEST without a decrease it has too, if the full step is below SMALL."""

SMALLEST = np.finfo(np.float64).tiny
FIRST_DAMPING = 1e-6
"""Damping after the first rejected step, in units of the largest squared singular value."""


class DescentStatus(IntEnum):
    """How a fit ended, one per trial."""

    CONVERGED = 0
    OUT_OF_ITERATIONS = 1
    NO_DESCENT = 2
    BAD_START = 3
    RUNNING = 4

    @property
    def sentence(self) -> str:
        """What happened and what to do about it."""
        return _SENTENCES[self]


_SENTENCES = {
    DescentStatus.CONVERGED: "converged",
    DescentStatus.OUT_OF_ITERATIONS: "did not converge within the allowed iterations; allow more "
    "or start closer",
    DescentStatus.NO_DESCENT: "no further step stays within the mechanism's reach; start closer or "
    "look for wrong rows",
    DescentStatus.BAD_START: "the start gives no finite residuals (rows out of reach); check units "
    "and readings",
    DescentStatus.RUNNING: "still running",
}


class Problem(Protocol):
    """A least-squares problem as the descent sees it: whitened rows, columns scaled by tolerance."""

    @property
    def parameters(self) -> int:
        """Number of unknowns p."""
        ...

    @property
    def rows(self) -> IntArray:
        """(t,) number of equations of each trial, those of weight zero not counted."""
        ...

    def fold(self, deviation: FloatArray, trials: IntArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate some trials.

        Parameters
        ----------
        deviation : (a, p) z, one row for each of the trials.
        trials : (a,) which trials of the problem these are.

        Returns
        -------
        factor : (a, p + 1, p + 1) triangular factor of rows [A | residual].
        cost : (a,) sum of squares; infinite or nan where it cannot be evaluated.
        """
        ...


@dataclass(frozen=True)
class StepControl:
    """Settings of the descent.

    Parameters
    ----------
    iterations : evaluations of the rows after the first, at most.
    relative : converged when the step changes the whitened residuals by at most this share of their
        norm (the relative offset of Bates and Watts, Technometrics 23, 1981). That step is still
        taken, without evaluating the rows again: the result is the solution of the last
        decomposition.
    absolute : converged when the step is at most this long, in tolerances, relative to 1 + |z|.
    damping : of the first step, in units of the largest squared singular value; zero tries the full
        step.
    """

    iterations: int = 50
    relative: float = 1e-6
    absolute: float = 1e-12
    damping: float = 0.0

    def __post_init__(self) -> None:
        for name in ("relative", "absolute"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise EstimationError(
                    f"{name} is {getattr(self, name)}; it must be finite and above 0"
                )
        if self.iterations < 0:
            raise EstimationError(f"iterations is {self.iterations}; it must not be negative")
        if not 0.0 <= self.damping < np.inf:
            raise EstimationError(f"damping is {self.damping}; it must be finite and not negative")


@dataclass(frozen=True)
class Descent:
    """Where the descent ended.

    Attributes
    ----------
    deviation : (t, p) total deviation z from nominal, in tolerances.
    decomposition : of the rows next to `deviation`, for the total deviation.
    penalty : (t, p) what the method penalised there.
    cost : (t,) sum of squares of the whitened residuals.
    status : (t,) DescentStatus. iterations : (t,) steps taken. step : (t,) length of the last step
        considered.
    deviation_history, cost_history : (i + 1, t, p) and (i + 1, t) after each round; what ended
        repeats.
    """

    deviation: FloatArray
    decomposition: Decomposition
    penalty: FloatArray
    cost: FloatArray
    status: IntArray
    iterations: IntArray
    step: FloatArray
    deviation_history: FloatArray
    cost_history: FloatArray

    def after(self, first: Descent) -> Descent:
        """Return this descent with the steps of the one that led to its start before its own."""
        return replace(
            self,
            iterations=first.iterations + self.iterations,
            deviation_history=np.concatenate([first.deviation_history, self.deviation_history[1:]]),
            cost_history=np.concatenate([first.cost_history, self.cost_history[1:]]),
        )


def descend(
    problem: Problem,
    start: FloatArray,
    method: Method,
    control: StepControl | None = None,
    tolerance: float = RANK_TOLERANCE,
) -> Descent:
    """Minimise the whitened sum of squares, filtered by the method, from `start`.

    Parameters
    ----------
    problem : the rows.
    start : (t, p) deviation to start from, in tolerances.
    method : how directions are penalised.
    control : settings of the steps.
    tolerance : relative rank tolerance.

    Returns
    -------
    Descent; a trial that fails is marked in `status` and never stops the others.
    """
    control = control or StepControl()
    run = _Run(problem, method, tolerance, np.array(start, dtype=np.float64), control.damping)
    deviations, costs = [run.z.copy()], [run.cost.copy()]
    for _ in range(control.iterations):
        active, step = run.propose(control)
        if active.size == 0:
            break
        if run.attempt(active, step):
            deviations.append(run.z.copy())
            costs.append(run.cost.copy())
    else:
        run.propose(control)  # the last accepted point may be good enough
    if (run.z != deviations[-1]).any():
        deviations.append(run.z)
        costs.append(run.cost)
    run.status[run.status == DescentStatus.RUNNING] = DescentStatus.OUT_OF_ITERATIONS
    return Descent(
        deviation=run.z,
        decomposition=run.decomposition,
        penalty=run.penalty,
        cost=run.cost,
        status=run.status,
        iterations=run.iterations,
        step=run.step,
        deviation_history=np.stack(deviations),
        cost_history=np.stack(costs),
    )


class _Run:
    """The current point of every trial: working memory of one call of `descend`."""

    def __init__(
        self, problem: Problem, method: Method, tolerance: float, start: FloatArray, damping: float
    ) -> None:
        self.problem, self.method, self.tolerance = problem, method, tolerance
        self.scale, self.flat = method.scale(problem.parameters), method.flat(problem.parameters)
        t = len(start)
        with np.errstate(over="ignore", invalid="ignore"):  # told as a bad start
            factor, self.cost = problem.fold(start, np.arange(t))
        good = np.isfinite(self.cost) & np.isfinite(factor).all(axis=(1, 2))
        self.z = start
        self.decomposition = decompose(
            np.where(good[:, None, None], factor, 0.0),
            problem.rows.copy(),
            start,
            self.scale,
            tolerance,
            self.flat,
        )
        self.penalty: FloatArray = np.array(method.penalty(self.decomposition), dtype=np.float64)
        self.status = np.where(good, DescentStatus.RUNNING, DescentStatus.BAD_START).astype(
            np.int64
        )
        self.iterations = np.zeros(t, dtype=np.int64)
        self.step = np.zeros(t)
        self.damping = damping * self.decomposition.singular_values[:, 0] ** 2
        self.growth = np.full(t, 2.0)

    def propose(self, control: StepControl) -> tuple[IntArray, Step]:
        """Mark trials whose next step is negligible as converged; return the others and their
        steps.
        """
        active = np.flatnonzero(self.status == DescentStatus.RUNNING)
        step = propose(
            self.z[active],
            self.decomposition.take(active),
            self.penalty[active],
            self.damping[active],
        )
        self.step[active] = step.length
        done = step.offset <= control.relative**2 * self.cost[active]
        done |= step.full_length <= control.absolute * self._spread(active)
        self.status[active[done]] = DescentStatus.CONVERGED
        self.iterations[active[done]] += 1
        self.z[active[done]] = step.target[done]
        return (active[~done], step.take(~done)) if done.any() else (active, step)

    def attempt(self, active: IntArray, step: Step) -> bool:
        """Evaluate the steps of the active trials, move those that gain, adapt each damping; tell
        if any moved.
        """
        factor, cost = self.problem.fold(step.deviation, active)
        here, penalty = self.decomposition.take(active), self.penalty[active]
        before = self.cost[active] + penalised(here, penalty, self.z[active])
        good = np.isfinite(cost) & np.isfinite(factor).all(axis=(1, 2))
        after = np.where(good, cost, np.inf) + penalised(here, penalty, step.deviation)
        gained = before - after + ROUNDING * before
        # A truncated direction on its way back to nominal may cost something: up to twice what was
        # predicted.
        accepted = gained >= np.where(step.predicted > 0.0, ACCEPT, 2.0) * step.predicted
        self._adapt(active, accepted, gained / np.maximum(np.abs(step.predicted), SMALLEST))
        spread = self._spread(active)
        met_rounding = good & (step.full_length <= TINY * spread)
        stuck = ~accepted & (met_rounding | (step.length <= SHORTEST * spread))
        converged = good & (step.full_length <= SMALL * spread)
        self.status[active[stuck]] = np.where(
            converged, DescentStatus.CONVERGED, DescentStatus.NO_DESCENT
        )[stuck]
        if accepted.any():
            self._move(active[accepted], step.deviation[accepted], factor[accepted], cost[accepted])
        return bool(accepted.any())

    def _spread(self, trials: IntArray) -> FloatArray:
        """1 + |z| (a,), with which lengths are compared."""
        return 1.0 + np.linalg.norm(self.z[trials], axis=1)

    def _adapt(self, active: IntArray, accepted: BoolArray, ratio: FloatArray) -> None:
        """Less damping after a step as good as predicted, ever faster more after rejected ones
        (Nielsen).
        """
        first = FIRST_DAMPING * self.decomposition.singular_values[active, 0] ** 2
        less = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.clip(ratio, 0.0, 1.0) - 1.0) ** 3)
        more = np.maximum(self.damping[active] * self.growth[active], first)
        self.damping[active] = np.where(accepted, self.damping[active] * less, more)
        self.growth[active] = np.where(accepted, 2.0, 2.0 * self.growth[active])

    def _move(self, trials: IntArray, z: FloatArray, factor: FloatArray, cost: FloatArray) -> None:
        """Put some trials at a new point."""
        new = decompose(factor, self.problem.rows[trials], z, self.scale, self.tolerance, self.flat)
        penalty = self.method.penalty(new)
        self.iterations[trials] += 1
        self.z[trials], self.cost[trials], self.penalty[trials] = z, cost, penalty
        self.decomposition = self.decomposition.put(trials, new)
