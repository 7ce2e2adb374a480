# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton iteration on many least-squares problems at once, with step control.

A point is one value for all t trials of a batch: where they are, their sums of squares, and the
linear model there. Two controls of the step exist:

    damping    Levenberg-Marquardt: every trial has its own damping, is accepted or rejected on its
               own, and leaves the batch when it ends (`minimize`)
    halving    the full step, halved where it does not lower the sum of squares; for problems whose
               full step is right in nearly all cases (`minimize_by_halving`)

A step is negligible, and its trial converged, when it changes the whitened residuals by less than a
stated share of their norm (the relative offset of Bates and Watts, Technometrics 23, 1981).
Damping is adapted as by Nielsen: Madsen, Nielsen, Tingleff, "Methods for non-linear least squares
problems" (2004).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol, Self

import numpy as np

from loopcal.typing import BoolArray, FloatArray, IntArray

ROUNDING = 1e-12
"""Relative change of a sum of squares that is rounding and says nothing about a step."""


class DescentStatus(IntEnum):
    """How the iteration of one trial ended."""

    CONVERGED = 0
    OUT_OF_ITERATIONS = 1
    NO_DESCENT = 2
    BAD_START = 3
    RUNNING = 4


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
    """A proposed step of some trials."""

    def take(self, trials: np.ndarray) -> Self:
        """Return some trials."""
        ...


class Damping:
    """Levenberg-Marquardt damping of t trials by Nielsen's rule: working memory of one iteration.

    Parameters
    ----------
    first : (t,) damping of the first step.
    floor : (t,) damping after the first rejected step, at least.
    """

    value: FloatArray
    floor: FloatArray
    growth: FloatArray

    def __init__(self, first: FloatArray, floor: FloatArray) -> None:
        self.value, self.floor = np.array(first), floor
        self.growth = np.full(len(self.value), 2.0)

    def adapt(self, trials: IntArray, accepted: BoolArray, ratio: FloatArray) -> None:
        """Lower the damping after a good step; raise it ever faster after rejected ones.

        `ratio` (a,) is the decrease over the predicted one.
        """
        less = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.clip(ratio, 0.0, 1.0) - 1.0) ** 3)
        more = np.maximum(self.value[trials] * self.growth[trials], self.floor[trials])
        self.value[trials] = np.where(accepted, self.value[trials] * less, more)
        self.growth[trials] = np.where(accepted, 2.0, 2.0 * self.growth[trials])


class FixedFactors:
    """Damping that is divided by ten after an accepted step and multiplied by ten otherwise."""

    value: FloatArray

    def __init__(self, first: FloatArray) -> None:
        self.value = np.array(first)

    def adapt(self, trials: IntArray, accepted: BoolArray, ratio: FloatArray) -> None:
        """Adapt the damping of some trials."""
        del ratio
        self.value[trials] *= np.where(accepted, 0.1, 10.0)


class Model(Protocol):
    """The rules of one kind of problem for `minimize`."""

    def propose(self, point: Any, damping: FloatArray) -> Any:
        """Return the steps of points, damped by `damping` (a,)."""
        ...

    def is_negligible(self, point: Any, step: Any) -> BoolArray:
        """Return which steps (a,) are the last: they are taken without being evaluated."""
        ...

    def finish(self, point: Any, step: Any) -> Any:
        """Return the points after a negligible step, their cost and model unchanged."""
        ...

    def evaluate(self, point: Any, step: Any, trials: IntArray) -> Any:
        """Return the points to which steps lead; `trials` (a,) are their numbers."""
        ...

    def judge(self, point: Any, step: Any, candidate: Any) -> tuple[BoolArray, FloatArray]:
        """Return which candidates are accepted (a,), and decrease over predicted decrease (a,)."""
        ...

    def ending(self, point: Any, step: Any, candidate: Any, accepted: BoolArray) -> IntArray:
        """Return the status (a,) of every trial after this step, RUNNING where it goes on."""
        ...


@dataclass(frozen=True)
class Minimum:
    """Where an iteration ended.

    Attributes
    ----------
    point : of all trials. status : (t,) `DescentStatus`. iterations : (t,) accepted steps.
    """

    point: Any
    status: IntArray
    iterations: IntArray


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
    model : rules of the problem. point : the start of all trials. damping : of the steps.
    iterations : evaluations after the first, at most.
    observe : called with the points after every evaluation by which one of them moved.

    Returns
    -------
    Minimum; a trial that fails is marked in `status` and never stops the others.
    """
    good = np.isfinite(point.cost)
    status = np.where(good, DescentStatus.RUNNING, DescentStatus.BAD_START).astype(np.int64)
    taken = np.zeros(len(status), dtype=np.int64)
    for i in range(iterations + 1):
        active = np.flatnonzero(status == DescentStatus.RUNNING)
        if not active.size:
            break
        current = point.take(active)
        step = model.propose(current, damping.value[active])
        is_last = model.is_negligible(current, step)
        if is_last.any():
            last, going = np.flatnonzero(is_last), np.flatnonzero(~is_last)
            status[active[last]] = DescentStatus.CONVERGED
            taken[active[last]] += 1
            point = point.put(active[last], model.finish(current.take(last), step.take(last)))
            if not going.size:
                break
            active, current, step = active[going], current.take(going), step.take(going)
        if i == iterations:
            break
        candidate = model.evaluate(current, step, active)
        accepted, ratio = model.judge(current, step, candidate)
        damping.adapt(active, accepted, ratio)
        status[active] = model.ending(current, step, candidate, accepted)
        if accepted.any():
            moved = active[accepted]
            taken[moved] += 1
            point = point.put(moved, candidate.take(np.flatnonzero(accepted)))
            observe(point)
    status[status == DescentStatus.RUNNING] = DescentStatus.OUT_OF_ITERATIONS
    return Minimum(point, status, taken)


@dataclass(frozen=True)
class Halving:
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
            parts = np.broadcast_to(worse[:, None], share.shape)
            if is_part_worse is not None:
                parts = parts & is_part_worse(point, candidate)
            share = np.where(parts, (0.5 if attempt < control.attempts - 1 else 0.0) * share, share)
        gained = point.cost - candidate.cost
        promised = step.change > control.stuck * point.cost
        stuck |= promised & ~(gained > control.stuck * step.change)
        point = candidate
        if not share.any():
            break
    return point, converged
