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
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray

PATIENCE = 20
"""Evaluations without progress after which a trial ends. One whose result is not finite, such as
that of poses out of reach, counts `NOT_FINITE` times: it takes the longest and says the least."""

NOT_FINITE = 5

LESS_COST, LESS_LENGTH, LESS_DAMPING = 0.99, 0.95, 0.1
"""Progress is a decrease of the sum of squares, of the length of the full step, or of the damping
to this share of its value at the last progress."""


class Damping:
    """Levenberg-Marquardt damping of t trials by Nielsen's rule: working memory of one iteration.

    Parameters
    ----------
    first : (t,) damping of the first step.
    floor : from trials (a,) to their damping after the first rejected step (a,), at least; asked
        only for trials with a rejected step.
    """

    value: FloatArray
    growth: FloatArray

    def __init__(self, first: FloatArray, floor: Callable[[IntArray], FloatArray]) -> None:
        self.value, self._ask_floor = np.array(first), floor
        self.growth = np.full(len(self.value), 2.0)
        self._floor = np.full(len(self.value), np.nan)

    def adapt(self, trials: IntArray, accepted: BoolArray, ratio: FloatArray) -> None:
        """Lower the damping after a good step; raise it ever faster after rejected ones.

        `ratio` (a,) is the decrease over the predicted one.
        """
        if accepted.all() and not self.value[trials].any():
            self.growth[trials] = 2.0
            return
        unknown = trials[~accepted & np.isnan(self._floor[trials])]
        if unknown.size:
            self._floor[unknown] = self._ask_floor(unknown)
        less = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.clip(ratio, 0.0, 1.0) - 1.0) ** 3)
        more = np.fmax(self.value[trials] * self.growth[trials], self._floor[trials])
        self.value[trials] = np.where(accepted, self.value[trials] * less, more)
        self.growth[trials] = np.where(accepted, 2.0, 2.0 * self.growth[trials])

    def release(self, trials: IntArray) -> None:
        """Remove the damping of some trials."""
        self.value[trials], self.growth[trials] = 0.0, 2.0


class FixedFactors:
    """Damping that is divided by ten after an accepted step and multiplied by ten otherwise."""

    def __init__(self, first: FloatArray) -> None:
        self.value: FloatArray = np.array(first)

    def adapt(self, trials: IntArray, accepted: BoolArray, ratio: FloatArray) -> None:
        """Adapt the damping of some trials."""
        del ratio
        self.value[trials] *= np.where(accepted, 0.1, 10.0)

    def release(self, trials: IntArray) -> None:
        """Remove the damping of some trials."""
        self.value[trials] = 0.0


class Progress:
    """The last progress of t trials: working memory of one iteration.

    A trial that makes none within `PATIENCE` evaluations ends. Nothing is recorded before that many
    evaluations, in which most trials converge.
    """

    def __init__(self, trials: int) -> None:
        self.marks: FloatArray = np.full((trials, 3), np.inf)
        self.age: IntArray = np.zeros(trials, dtype=np.int64)

    def find_stalled(
        self, trials: IntArray, is_finite: BoolArray, *measures: FloatArray
    ) -> BoolArray:
        """Return which trials (a,) made no progress for too long.

        `is_finite` (a,) says which were evaluated with a finite result. `measures` are the sums of
        squares, the lengths of the full steps and the dampings (a,) before.
        """
        values = np.stack(measures, axis=1)
        share = np.array([LESS_COST, LESS_LENGTH, LESS_DAMPING])
        progress = values < share * self.marks[trials]
        self.marks[trials] = np.where(progress, values, self.marks[trials])
        age = np.where(progress.any(axis=1), 0, self.age[trials])
        self.age[trials] = age + np.where(is_finite, 1, NOT_FINITE)
        return self.age[trials] >= PATIENCE


CONTRACTION = 0.9
"""Largest ratio of the lengths of two full steps of a chain."""

LEAST_GAIN = 0.25
"""Share of the predicted decrease that a chain must bring. With less, full steps may lead into the
basin of another, higher minimum."""

LONGEST_CHAIN = 10
"""Steps of a chain, at most."""

FIRST_WAIT = 2
"""Damped steps before a chain is tried; twice as many after every one that led nowhere."""


class FullSteps:
    """Chains of full steps of t trials: working memory of one iteration.

    Parameters
    ----------
    trials : t. is_enabled : whether chains are tried.
    """

    is_enabled: bool
    is_ahead: BoolArray

    def __init__(self, trials: int, is_enabled: bool) -> None:
        self.is_enabled, self.is_ahead = is_enabled, np.zeros(trials, dtype=bool)
        self._is_low = np.zeros(trials, dtype=bool)
        self._count, self._taken = np.zeros(trials, dtype=np.int64), np.zeros(trials, dtype=int)
        self._wait = np.full(trials, FIRST_WAIT)
        self._length, self._promised = np.zeros(trials), np.zeros(trials)
        self._point: Any = None

    def find_arrived(self, model: Any) -> tuple[IntArray, Any]:
        """End the chains that reached a lower point or led nowhere.

        Return the trials (a,) that reached a lower point, and these points.
        """
        ahead = np.flatnonzero(self.is_ahead)
        points_ahead = self._point.take(ahead)
        length = model.propose(points_ahead, np.zeros(len(ahead))).full_length
        contracts = length <= CONTRACTION * self._length[ahead]
        is_lower = contracts & self._is_low[ahead]
        goes_on = contracts & ~is_lower & (self._count[ahead] < LONGEST_CHAIN)
        self._end(ahead[~goes_on & ~is_lower])
        arrived = ahead[is_lower]
        self.is_ahead[arrived], self._wait[arrived], self._taken[arrived] = False, FIRST_WAIT, 0
        return arrived, points_ahead.take(np.flatnonzero(is_lower))

    def start_due(self, point: Any, active: IntArray, damping: FloatArray) -> None:
        """Begin chains at the points of trials (a,) that took enough damped steps."""
        if not self.is_enabled or not damping.any():
            return
        due = (damping > 0.0) & (self._taken[active] >= self._wait[active])
        due &= ~self.is_ahead[active]
        if due.any():
            trials = active[due]
            self._begin(trials, point, point.take(trials), 0)

    def is_away(self, active: IntArray) -> BoolArray:
        """Return which trials (a,) are at a point of a chain that is not accepted."""
        return self.is_ahead[active] & (self._count[active] > 0)

    def replace_points(self, current: Any, active: IntArray) -> Any:
        """Return the points of trials (a,), those of chains where a chain goes on."""
        ahead = np.flatnonzero(self.is_ahead[active])
        return current if not ahead.size else current.put(ahead, self._point.take(active[ahead]))

    def expect(self, step: Any, active: IntArray) -> Any:
        """Return steps (a,) with the decrease that the first full step of their chain predicted."""
        is_first = self.is_ahead[active] & (self._count[active] == 0)
        self._promised[active[is_first]] = step.predicted[is_first]
        self._length[active] = step.full_length
        promised = np.where(self.is_ahead[active], self._promised[active], step.predicted)
        return replace(step, predicted=promised)

    def record(
        self,
        point: Any,
        step: Any,
        candidate: Any,
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
        ahead, finite = self.is_ahead[active], np.isfinite(candidate.cost)
        self._taken[active[accepted & ~ahead]] += 1
        begun = ~ahead & ~accepted & is_full & finite
        if begun.any():
            trials = active[begun]
            self._promised[trials] = step.predicted[begun]
            self._length[trials] = step.full_length[begun]
            self._begin(trials, point, candidate.take(np.flatnonzero(begun)), 1)
        moved = ahead & finite
        if moved.any():
            trials = active[moved]
            self._point = self._point.put(trials, candidate.take(np.flatnonzero(moved)))
            self._is_low[trials] = accepted[moved] & (ratio[moved] >= LEAST_GAIN)
            self._count[trials] += 1
        self._end(active[ahead & ~finite])

    def _begin(self, trials: IntArray, point: Any, first: Any, count: int) -> None:
        """Begin chains at the points `first`; `point` are the accepted ones of all trials."""
        self._point = (point if self._point is None else self._point).put(trials, first)
        self.is_ahead[trials], self._is_low[trials], self._count[trials] = True, False, count

    def _end(self, trials: IntArray) -> None:
        """End chains that led nowhere."""
        again = trials[self._taken[trials] >= self._wait[trials]]
        self._wait[again] *= 2
        self.is_ahead[trials], self._taken[trials] = False, 0


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
    """The rules of one kind of problem for `minimize`. By default every decrease is accepted, and
    no step is the last.
    """

    def propose(self, point: Any, damping: FloatArray) -> Any:
        """Return the steps of points, damped by `damping` (a,)."""
        ...

    def is_negligible(self, point: Any, step: Any) -> BoolArray:
        """Return which steps (a,) are the last: they are taken without being evaluated."""
        del step
        return np.zeros(len(point.cost), dtype=bool)

    def finish(self, point: Any, step: Any, trials: IntArray) -> Any:
        """Return all points, those of some trials (a,) after their negligible steps (a,), with
        their cost and model unchanged.
        """
        del step, trials
        return point

    def evaluate(self, point: Any, step: Any, trials: IntArray) -> Any:
        """Return the points to which steps lead; `trials` (a,) are their numbers."""
        ...

    def judge(self, point: Any, step: Any, candidate: Any) -> tuple[BoolArray, FloatArray]:
        """Return which candidates are accepted (a,), and decrease over predicted decrease (a,)."""
        del step
        return candidate.cost < point.cost, np.ones(len(point.cost))

    def objective(self, point: Any) -> FloatArray:
        """Return what is minimized (a,), the sum of squares with penalties."""
        return np.asarray(point.cost)

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

    A trial that fails is marked in `status` and never stops the others. With `Damping`, chains of
    full steps are tried, and trials that make no progress end, see `Progress`. `iterations` counts
    the evaluations after the first; `observe` is called with the points after each that moved one.
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
    """Minimize sums of squares by full Gauss-Newton steps, halved where they are too long; return
    the last point and which trials (t,) converged.

    All trials are evaluated together in each attempt. What has ended is moved by a share of zero.

    Parameters
    ----------
    move : from a point, its step and shares (t, m) of it to the next point.
    is_part_worse : from two points to the parts (t, m) that became worse, where these are
        independent; default: all parts of a trial whose sum of squares grew.
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


STEPS = 60
"""Steps of damped Gauss-Newton [1]; starts in the right basin need fewer than ten."""

FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e4
"""Damping of the first step [1], in columns of length one, and that at which a descent ends."""

NEGLIGIBLE_STEP = 1e-6
"""Step, in standard deviations or as a share of the residuals, that is as good as none."""

SMALLEST = 1e-12
"""Singular value of columns of length one that counts as zero."""

Linearize = Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]]
"""From values (c, u) of starts, whose numbers are (c,), to residuals (c, M), in units of their
standard deviation or of order one, and their Jacobians (c, M, u)."""


def minimize_from_starts(
    linearize: Linearize, x: FloatArray, steps: int = STEPS
) -> tuple[FloatArray, FloatArray]:
    """Minimize sums of squares from starts x (c, u) at once, by damped Gauss-Newton; return the
    ends and the sums of squares (c,), infinite where a start cannot be evaluated.
    """
    residual, jacobian = linearize(x, np.arange(len(x)))
    start = _Point(x, residual, jacobian, sum_squares(residual))
    damping = FixedFactors(np.full(len(x), FIRST_DAMPING))
    point = minimize(_Descent(linearize), start, damping, steps).point
    return point.x, point.cost


def sum_squares(residual: FloatArray) -> FloatArray:
    """Return sums of squares (c,) of residuals (c, M); infinite where they are not finite."""
    total = np.sum(residual * residual, axis=1)
    return np.where(np.isfinite(total), total, np.inf)


@dataclass(frozen=True, eq=False)
class _Point(TrialBatch):
    """Values x (c, u), residuals (c, M), Jacobians (c, M, u), sums of squares (c,)."""

    x: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    cost: FloatArray


@dataclass(frozen=True, eq=False)
class _Step(TrialBatch):
    """A damped step (c, u), its length (c,) in the residuals, and its damping (c,)."""

    x: FloatArray
    length: FloatArray
    damping: FloatArray


@dataclass(frozen=True)
class _Descent(Model):
    """The rules of `minimize_from_starts`."""

    linearize: Linearize

    def propose(self, point: _Point, damping: FloatArray) -> _Step:
        """Return the damped steps, from a decomposition of columns of length one."""
        norm = np.linalg.norm(point.jacobian, axis=1)
        scale = np.where(norm > 0.0, norm, 1.0)
        # one triangular factor, so that the decomposition does not grow with the rows
        columns = point.jacobian / scale[:, None, :]
        stack = np.nan_to_num(np.concatenate([columns, point.residual[..., None]], axis=-1))
        R = np.asarray(np.linalg.qr(stack, mode="r"), dtype=float)
        U, s, V = np.linalg.svd(R[..., :-1], full_matrices=False)
        right = np.einsum("cmk,cm->ck", U, R[..., -1])
        total = s * s + damping[:, None] ** 2 + SMALLEST**2
        gain = np.where(s > SMALLEST, s / total, 0.0)
        step = np.where(norm > 0.0, -np.einsum("cku,ck->cu", V, gain * right) / scale, 0.0)
        return _Step(step, np.linalg.norm(step * scale, axis=1), damping)

    def evaluate(self, point: _Point, step: _Step, trials: IntArray) -> _Point:
        """Return the points to which steps lead."""
        x = point.x + step.x
        residual, jacobian = self.linearize(x, trials)
        return _Point(x, residual, jacobian, sum_squares(residual))

    def ending(
        self, point: _Point, step: _Step, candidate: _Point, accepted: BoolArray
    ) -> IntArray:
        """End where a step moves the residuals by a millionth of their sigma, or of themselves."""
        del point, accepted
        is_small = step.length <= NEGLIGIBLE_STEP * (1.0 + np.sqrt(candidate.cost))
        stuck = np.where(
            step.damping > LARGEST_DAMPING, DescentStatus.NO_DESCENT, DescentStatus.RUNNING
        )
        return np.where(is_small, DescentStatus.CONVERGED, stuck)
