# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton iteration on many least-squares problems at once, with step control.

A point is one value for all t trials of a batch: where they are, their sums of squares, and the
linear model there. Two controls of the step exist:

    damping    Levenberg-Marquardt: every trial has its own damping, is accepted or rejected on its
               own, and leaves the batch when it ends (`minimize`); chains of full steps shorten the
               way through narrow valleys (`full_steps`)
    halving    the full step, halved where it does not lower the sum of squares; for problems whose
               full step is right in nearly all cases (`minimize_by_halving`)

A step is negligible, and its trial converged, when it changes the whitened residuals by less than a
stated share of their norm (the relative offset of Bates and Watts, Technometrics 23, 1981).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from loopcal.numerics.damping import PATIENCE, Damping, FixedFactors, Progress
from loopcal.numerics.full_steps import FullSteps
from loopcal.typing import BoolArray, FloatArray, IntArray

ROUNDING = 1e-12
"""Relative change of a sum of squares that is rounding and says nothing about a step."""


class DescentStatus(IntEnum):
    """How the iteration of one trial ended.

    With arrays, use `value`: NumPy converts a member of an enumeration in ten times the time of a
    comparison.
    """

    CONVERGED = 0
    OUT_OF_ITERATIONS = 1
    NO_DESCENT = 2
    BAD_START = 3
    RUNNING = 4
    NO_PROGRESS = 5


class Point(Protocol):
    """Points of t trials with their linear models."""

    @property
    def cost(self) -> FloatArray:
        """(t,) sums of squares; infinite or NaN where they cannot be evaluated."""
        ...

    def take(self, trials: IntArray) -> Self:
        """Return some trials."""
        ...

    def put(self, trials: IntArray, other: Self) -> Self:
        """Return these points with some trials taken from others."""
        ...


class Step(Protocol):
    """A proposed step of some trials; with `full_length` (a,) of the undamped step and `predicted`
    (a,), the decrease by the linear model, where chains of full steps are tried.
    """

    def take(self, trials: np.ndarray) -> Self:
        """Return some trials."""
        ...


class Model(Protocol):
    """The rules of one kind of problem for `minimize`."""

    def propose(self, point: Any, damping: FloatArray) -> Any:
        """Return the steps of points, damped by `damping` (a,)."""
        ...

    def is_negligible(self, point: Any, step: Any) -> BoolArray:
        """Return which steps (a,) are the last: they are taken without being evaluated."""
        ...

    def finish(self, point: Any, step: Any, trials: IntArray) -> Any:
        """Return all points, those of some trials (a,) after their negligible steps (a,), with
        their cost and model unchanged.
        """
        ...

    def evaluate(self, point: Any, step: Any, trials: IntArray) -> Any:
        """Return the points to which steps lead; `trials` (a,) are their numbers."""
        ...

    def judge(self, point: Any, step: Any, candidate: Any) -> tuple[BoolArray, FloatArray]:
        """Return which candidates are accepted (a,), and decrease over predicted decrease (a,)."""
        ...

    def objective(self, point: Any) -> FloatArray:
        """Return what is minimized (a,), the sum of squares with penalties."""
        ...

    def ending(self, point: Any, step: Any, candidate: Any, accepted: BoolArray) -> IntArray:
        """Return the status (a,) of every trial after this step, RUNNING where it goes on."""
        ...


class Minimum(NamedTuple):
    """Where an iteration ended.

    Attributes
    ----------
    point : of all trials. status : (t,) `DescentStatus`. iterations : (t,) accepted steps.
    """

    point: Any
    status: IntArray
    iterations: IntArray


class _Run:
    """One iteration over all trials: working memory of `minimize`."""

    def __init__(self, model: Model, point: Any, damping: Damping | FixedFactors) -> None:
        t = len(point.cost)
        good = np.isfinite(point.cost)
        self.model, self.point, self.damping = model, point, damping
        running, bad = DescentStatus.RUNNING.value, DescentStatus.BAD_START.value
        self.status = np.where(good, running, bad).astype(int)
        self.taken = np.zeros(t, dtype=np.int64)
        self.chains = FullSteps(t, isinstance(damping, Damping))
        self.progress = Progress(t)

    def list_running(self) -> IntArray:
        """Return the trials (a,) that go on."""
        return np.flatnonzero(self.status == DescentStatus.RUNNING.value)

    def accept_chains(self) -> bool:
        """Move trials to the lower points that chains of full steps reached; return whether any."""
        if not self.chains.is_ahead.any():
            return False
        arrived, lower = self.chains.find_arrived(self.model)
        if not arrived.size:
            return False
        self.point = self.point.put(arrived, lower)
        self.damping.release(arrived)
        self.taken[arrived] += 1
        return True

    def propose(self, active: IntArray) -> tuple[IntArray, Any, Any]:
        """Return the trials (a,) that go on, their points and steps; end those that converged."""
        damping, current = self.damping.value[active], self.point.take(active)
        self.chains.start_due(self.point, active, damping)
        if self.chains.is_ahead.any():
            current = self.chains.replace_points(current, active)
            damping = np.where(self.chains.is_ahead[active], 0.0, damping)
        step = self.model.propose(current, damping)
        is_last = self.model.is_negligible(current, step)
        if self.chains.is_ahead.any():
            is_last &= ~self.chains.is_away(active)
        if is_last.any():
            last, going = np.flatnonzero(is_last), np.flatnonzero(~is_last)
            self.chains.is_ahead[active[last]] = False
            self.status[active[last]] = DescentStatus.CONVERGED
            self.taken[active[last]] += 1
            self.point = self.model.finish(self.point, step.take(last), active[last])
            active = active[going]
            if active.size:
                current, step = current.take(going), step.take(going)
        return active, current, step

    def evaluate(self, active: IntArray, current: Any, step: Any, round_number: int) -> bool:
        """Evaluate steps of trials (a,) and take those that are accepted; return whether any."""
        model, chains, reference = self.model, self.chains, current
        candidate = model.evaluate(current, step, active)
        ahead = chains.is_ahead[active]
        if has_chains := ahead.any():
            reference, step = self.point.take(active), chains.expect(step, active)
        accepted, ratio = model.judge(reference, step, candidate)
        status = model.ending(reference, step, candidate, accepted)
        single = np.flatnonzero(~ahead)
        was_full = self.damping.value[active] == 0.0
        if has_chains:
            self.damping.adapt(active[single], accepted[single], ratio[single])
            status = np.where(ahead, DescentStatus.RUNNING.value, status)
        else:
            self.damping.adapt(active, accepted, ratio)
        self.status[active] = status
        if chains.is_enabled:
            chains.record(self.point, step, candidate, active, accepted, ratio, was_full)
            if round_number >= PATIENCE:
                finite = np.isfinite(candidate.cost)[single]
                self._end_stalled(active[single], finite, reference.take(single), step.take(single))
        is_taken = accepted & ~ahead
        if not is_taken.any():
            return False
        moved = active[is_taken]
        self.taken[moved] += 1
        self.point = self.point.put(moved, candidate.take(np.flatnonzero(is_taken)))
        return True

    def _end_stalled(self, trials: IntArray, is_finite: BoolArray, point: Any, step: Any) -> None:
        """End trials (a,) that made no progress for too long."""
        measures = self.model.objective(point), step.full_length, self.damping.value[trials]
        stalled = self.progress.find_stalled(trials, is_finite, *measures)
        running = self.status[trials] == DescentStatus.RUNNING.value
        self.status[trials[stalled & running]] = DescentStatus.NO_PROGRESS


def minimize(
    model: Model,
    point: Any,
    damping: Damping | FixedFactors,
    iterations: int,
    observe: Callable[[Any], None] = lambda _: None,
) -> Minimum:
    """Minimize sums of squares by damped Gauss-Newton, every trial on its own.

    Parameters
    ----------
    model : rules of the problem. point : the start of all trials.
    damping : of the steps. With `Damping`, chains of full steps are tried, see
        `loopcal.numerics.full_steps`, and trials that make no progress end, see `Progress`.
    iterations : evaluations after the first, at most.
    observe : called with the points after every evaluation by which one of them moved.

    Returns
    -------
    Minimum; a trial that fails is marked in `status` and never stops the others.
    """
    run = _Run(model, point, damping)
    for i in range(iterations + 1):
        if run.accept_chains():
            observe(run.point)
        active = run.list_running()
        if not active.size:
            break
        active, current, step = run.propose(active)
        if not active.size or i == iterations:
            break
        if run.evaluate(active, current, step, i):
            observe(run.point)
    run.status[run.list_running()] = DescentStatus.OUT_OF_ITERATIONS
    return Minimum(run.point, run.status, run.taken)


class Halving(NamedTuple):
    """Settings of `minimize_by_halving`.

    Parameters
    ----------
    steps : at most. attempts : lengths that are tried for each step, each half the one before.
    relative, absolute : converged when a step changes the whitened residuals by less than this
        share of their norm, plus this many standard deviations.
    stuck : a trial ends that gains less than this share of the promised decrease, where that is as
        large a share of the sum of squares: at the end of its reach a pose gains nothing, however
        often the step is halved. With 0 it ends when it gains nothing at all.
    """

    steps: int = 30
    attempts: int = 20
    relative: float = 1e-7
    absolute: float = 1e-5
    stuck: float = 0.0

    def is_negligible(self, change: FloatArray, cost: FloatArray) -> BoolArray:
        """Return which squared changes (a,) of the residuals are negligible."""
        if not self.relative:  # infinity times zero is no number
            return (change <= self.absolute**2) & np.isfinite(cost)
        return change <= self.relative**2 * cost + self.absolute**2

    def is_worse(self, cost: FloatArray, before: FloatArray) -> BoolArray:
        """Return which sums of squares (a,) are larger than before, beyond rounding."""
        return ~(cost <= (1.0 + ROUNDING) * before + self.absolute**2)


class FullStep(Protocol):
    """A full step of t trials.

    Attributes
    ----------
    change : (t,) squared change of the residuals to first order. share : (t, m) of each of its m
        parts that is tried first, at most one.
    """

    @property
    def change(self) -> FloatArray: ...  # noqa: D102

    @property
    def share(self) -> FloatArray: ...  # noqa: D102


def minimize_by_halving(
    point: Any,
    propose: Callable[[Any], FullStep],
    move: Callable[[Any, Any, FloatArray], Any],
    control: Halving,
    is_part_worse: Callable[[Any, Any], BoolArray] | None = None,
) -> tuple[Any, BoolArray]:
    """Minimize sums of squares by full Gauss-Newton steps, halved where they are too long.

    All trials are evaluated together in each attempt. What has ended is moved by a share of zero.

    Parameters
    ----------
    point : the start, with `cost` (t,).
    propose : from a point to its full step.
    move : from a point, its step and shares (t, m) of it to the next point.
    is_part_worse : from two points to the parts (t, m) that became worse, where parts are
        independent; default: all parts of a trial whose sum of squares grew.

    Returns
    -------
    point : the last one. is_converged : (t,).
    """
    stuck = ~np.isfinite(point.cost)
    converged = np.zeros(len(point.cost), dtype=bool)
    for _ in range(control.steps):
        step = propose(point)
        converged = control.is_negligible(step.change, point.cost)
        if (converged | stuck).all():
            break
        active = ~converged & ~stuck
        share = np.where(active[:, None], step.share, 0.0)
        candidate = point
        for attempt in range(control.attempts + 1):
            candidate = move(point, step, share)
            worse = active & control.is_worse(candidate.cost, point.cost)
            if not worse.any():
                break
            worse_parts = np.broadcast_to(worse[:, None], share.shape)
            if is_part_worse is not None:
                worse_parts = worse_parts & is_part_worse(point, candidate)
            share = np.where(
                worse_parts, (0.5 if attempt < control.attempts - 1 else 0.0) * share, share
            )
        with np.errstate(invalid="ignore"):
            # inf - inf and 0 * inf give NaN; these trials are stuck already
            gained = point.cost - candidate.cost
            promised = step.change > control.stuck * point.cost
            stuck |= promised & ~(gained > control.stuck * step.change)
        point = candidate
        if not share.any():
            break
    return point, converged
