# SPDX-License-Identifier: Apache-2.0
"""Chains of full Gauss-Newton steps that may raise the sum of squares on their way to the solution.

Where the residuals are strongly curved along a direction that the rows hardly determine, the sum of
squares forms a narrow bent valley. A damped descent follows its bottom in hundreds of short steps.
Full steps leave the bottom and come back to it: the sum of squares rises, but every full step is
shorter than the one before. This is the natural monotonicity test (P. Deuflhard, "Newton Methods
for Nonlinear Problems", Springer 2004, chapters 3.3 and 4.3). A chain of full steps

    begins   where a full step was refused, and again after some damped steps: 2, then 4, 8, ...
    goes on  while each full step is at most CONTRACTION times as long as the one before
    ends     at the first point that brings LEAST_GAIN of the predicted decrease;
             otherwise the descent goes on from where the chain began
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from loopcal.typing import BoolArray, FloatArray, IntArray

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
