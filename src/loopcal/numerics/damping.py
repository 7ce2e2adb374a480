# SPDX-License-Identifier: Apache-2.0
"""Damping of Gauss-Newton steps, and the test of progress: working memory of one iteration.

Damping is adapted as by Nielsen: Madsen, Nielsen, Tingleff, "Methods for non-linear least squares
problems" (2004).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

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

    value: FloatArray

    def __init__(self, first: FloatArray) -> None:
        self.value = np.array(first)

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

    marks: FloatArray
    age: IntArray

    def __init__(self, trials: int) -> None:
        self.marks = np.full((trials, 3), np.inf)
        self.age = np.zeros(trials, dtype=np.int64)

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
