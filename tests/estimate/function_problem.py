# SPDX-License-Identifier: Apache-2.0
"""A least-squares problem that a test states as a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.linearization import Linearization, Start
from loopcal.typing import FloatArray, IntArray


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
