# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton iteration on many small least-squares problems at once; the descent of a fit, whose
step control does more, is `loopcal.estimate.descent`.

    halving    the full step, halved where it does not lower the sum of squares; for problems whose
               full step is right in nearly all cases (`minimize_by_halving`)
    damping    for starts that may be far off (`minimize_from_starts`)

A step is negligible, and its trial converged, when it changes the whitened residuals by less than a
stated share of their norm (the relative offset of Bates and Watts, Technometrics 23, 1981).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from loopcal import engine
from loopcal.typing import BoolArray, FloatArray, IntArray

# Relative change of a sum of squares that is rounding and says nothing about a step.
ROUNDING = 1e-12


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


class Halving(NamedTuple):
    """Settings of `minimize_by_halving`.

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


def minimize_by_halving(
    point: Any,
    propose: Callable[[Any], Any],
    move: Callable[[Any, Any, FloatArray], Any],
    control: Halving,
    is_part_worse: Callable[[Any, Any], BoolArray] | None = None,
) -> tuple[Any, BoolArray]:
    """Minimize sums of squares by full Gauss-Newton steps, halved where they are too long; return
    the last point and which trials (t,) converged.

    All trials are evaluated together in each attempt. What has ended is moved by a share of zero.

    propose : from a point to its full step, with `change` (t,), the squared change of the residuals
        to first order, and `share` (t, m) of each of its m parts that is tried first, at most one.
    move : from a point, its step and shares (t, m) of it to the next point.
    is_part_worse : from two points to the parts (t, m) that became worse, where these are
        independent; default: all parts of a trial whose sum of squares grew.
    """
    stuck = ~np.isfinite(point.cost)
    converged = np.zeros(len(point.cost), dtype=bool)
    last = np.inf  # share of the step before: along a curved valley the next one is as long
    for _ in range(control.steps):
        step = propose(point)
        converged = control.is_negligible(step.change, point.cost)
        if (converged | stuck).all():
            break
        active = ~converged & ~stuck
        share = np.where(active[:, None], np.minimum(step.share, 2.0 * last), 0.0)
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
        point, last = candidate, np.where(share > 0.0, share, np.inf)
        if not share.any():
            break
    return point, converged


STEPS = 60  # steps of damped Gauss-Newton [1]; starts in the right basin need fewer than ten

FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e4
"""Damping of the first step [1], in columns of length one, and that at which a descent ends."""

# Step, in standard deviations or as a share of the residuals, that is short enough at the start of
# another descent: of shorter ones, rounding of the sums decides.
GOOD_START = 1e-4
SMALLEST = 1e-12  # singular value of columns of length one that counts as zero

Linearize = Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]]
"""From values (c, u) of starts, whose numbers are (c,), to residuals (c, M), in units of their
standard deviation or of order one, and their Jacobians (c, M, u)."""


def minimize_from_starts(
    linearize: Linearize, x: FloatArray, steps: int, rivals: IntArray, worth: float
) -> tuple[FloatArray, FloatArray]:
    """Minimize sums of squares from starts x (c, u) at once, by damped Gauss-Newton; return the
    ends and the sums of squares (c,), infinite where a start cannot be evaluated.

    A start ends after a step that moves the residuals by at most `GOOD_START`, whose end is not
    evaluated; and at once where its sum of squares is more than `worth` times the lowest one of its
    `rivals`, the starts with the same number (c,).
    """
    x = np.array(x)
    residual, jacobian = map(np.array, linearize(x, np.arange(len(x))))
    cost, damping = sum_squares(residual), np.full(len(x), FIRST_DAMPING)
    active = np.flatnonzero(np.isfinite(cost))
    if worth < np.inf:
        lowest = np.full(int(rivals.max()) + 1, np.inf)
        np.minimum.at(lowest, rivals, cost)
        active = active[cost[active] <= worth * lowest[rivals[active]]]
    for _ in range(steps):
        if not active.size:
            break
        step, length = _damp_step(residual[active], jacobian[active], damping[active])
        goes_on = length > GOOD_START * (1.0 + np.sqrt(cost[active]))
        x[active[~goes_on]] += step[~goes_on]
        active, moved = active[goes_on], x[active[goes_on]] + step[goes_on]
        if not active.size:
            break
        new_residual, new_jacobian = linearize(moved, active)
        new_cost = sum_squares(new_residual)
        goes_on = damping[active] <= LARGEST_DAMPING
        better = new_cost < cost[active]
        damping[active] *= np.where(better, 0.1, 10.0)
        taken = active[better]
        x[taken], cost[taken] = moved[better], new_cost[better]
        residual[taken], jacobian[taken] = new_residual[better], new_jacobian[better]
        active = active[goes_on]
    return x, cost


def sum_squares(residual: FloatArray) -> FloatArray:
    """Return sums of squares (c,) of residuals (c, M); infinite where they are not finite."""
    total = np.sum(residual * residual, axis=1)
    return np.where(np.isfinite(total), total, np.inf)


def _damp_step(
    residual: FloatArray, jacobian: FloatArray, damping: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return damped steps (c, u), from a decomposition of columns of length one, and their lengths
    (c,) in the residuals.
    """
    norm = np.linalg.norm(jacobian, axis=1)
    scale = np.where(norm > 0.0, norm, 1.0)
    # one triangular factor, so that the decomposition does not grow with the rows
    columns = jacobian / scale[:, None, :]
    stack = np.concatenate([columns, residual[..., None]], axis=-1)
    if not np.isfinite(stack.sum()):  # else no entry is infinite or NaN
        stack = np.nan_to_num(stack)
    (c, _, w) = stack.shape
    R = engine.fold(np.zeros((c, w, w)), stack)
    U, s, V = np.linalg.svd(R[..., :-1], full_matrices=False)
    right = np.einsum("cmk,cm->ck", U, R[..., -1])
    total = s * s + damping[:, None] ** 2 + SMALLEST**2
    gain = np.where(s > SMALLEST, s / total, 0.0)
    step = np.where(norm > 0.0, -np.einsum("cku,ck->cu", V, gain * right) / scale, 0.0)
    return step, np.linalg.norm(step * scale, axis=1)
