# SPDX-License-Identifier: Apache-2.0
"""Conditions on poses, and inputs at other deviations, that are functions of Python."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from loopcal.engine import Steps, Task
from loopcal.typing import FloatArray
from loopcal_native.library import MOST_CONDITIONS, MOVE, TASK, as_reals
from loopcal_native.programs import require

NO_TASK, NO_MOVE = TASK(0), MOVE(0)


class TaskCalls:
    """A task as a function that the library calls once for each step of many rows.

    function : for the library. error : what the task raised, to be raised again by the caller.
    """

    def __init__(self, task: Task) -> None:
        self.error: BaseException = RuntimeError("the task was not called")
        self._task, self._kept = task, ()
        self.function = TASK(self._answer)

    def _answer(self, _context: Any, count: int, poses: int, rows: int, answer: Any) -> int:
        """Write the addresses of residuals and slopes; return 1 where the task fails."""
        try:
            T = _view(poses, ctypes.c_double, count * 12).reshape(count, 3, 4)
            residual, slopes = self._task(T.copy(), _view(rows, ctypes.c_int64, count).copy())
            residual, slopes = as_reals(residual), as_reals(slopes)
            require(
                residual.ndim == 2
                and len(residual) == count
                and residual.shape[1] <= MOST_CONDITIONS
                and slopes.shape == (*residual.shape, 6),
                f"of a task residuals ({count}, c) and slopes ({count}, c, 6), c up to "
                f"{MOST_CONDITIONS}, not {residual.shape} and {slopes.shape}",
            )
        except BaseException as error:  # noqa: BLE001 - it must pass through the library
            self.error = error
            return 1
        self._kept = residual, slopes
        answer[0].residual, answer[0].slopes = residual.ctypes.data, slopes.ctypes.data
        answer[0].conditions = residual.shape[1]
        return 0


class MoveCalls:
    """Inputs e, q and those of a map at other deviations, as a function that the library calls once
    for each step and that writes into these arrays.

    function : for the library. error : what the caller's function raised.
    """

    def __init__(self, steps: Steps, arrays: Sequence[FloatArray]) -> None:
        self.error: BaseException = RuntimeError("no inputs were asked for")
        self._steps, self._arrays = steps, arrays
        self.function = MOVE(self._write) if steps.move else NO_MOVE

    def _write(self, deviation: int) -> int:
        """Write the inputs at a deviation (p,); return 1 where the function fails."""
        try:
            assert self._steps.move is not None
            z = _view(deviation, ctypes.c_double, len(self._steps.deviation)).copy()
            e, q, at = self._steps.move(z)
            moved = e, q, at.displacements, at.joints, at.basis
            for array, other in zip(self._arrays, moved, strict=True):
                np.copyto(array, other)
        except BaseException as error:  # noqa: BLE001 - it must pass through the library
            self.error = error
            return 1
        return 0


def _view(address: int, kind: Any, count: int) -> np.ndarray:
    """Return the numbers at an address, without a copy."""
    return np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(kind)), (count,))
