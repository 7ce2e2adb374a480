# SPDX-License-Identifier: Apache-2.0
"""Array types and the progress callback, defined once."""

from __future__ import annotations

from typing import Any, Protocol, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Numbers in SI units, double precision."""

IntArray = NDArray[np.int64]
"""Counts, positions in a table, or status codes."""

BoolArray = NDArray[np.bool_]
"""Yes or no, element by element."""


def find_array_type(annotation: Any) -> Any:
    """Return the type of the entries that the annotation of an array states; None for any other.

    Since NumPy 2.5 `NDArray` is an alias of its own, before it stands for `np.ndarray`.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is np.ndarray:
        return get_args(arguments[1])[0]
    return arguments[0] if origin is NDArray else None


class Progress(Protocol):
    """A callback to which long work reports how far it is.

    The library never prints. A caller passes a function; work of known length calls it after each
    step, and a view (the command line, a notebook) draws it.
    """

    def __call__(self, done: int, total: int, what: str, /) -> None:
        """Receive one report: `done` of `total` steps of `what` (a short noun phrase) are done."""
        ...


def report_no_progress(_done: int, _total: int, _what: str, /) -> None:
    """Do nothing: the default callback of long work."""


class StepCounter:
    """Reports the steps of one task to a progress callback, one after the other.

    progress : the callback. total : number of steps.
    """

    def __init__(self, progress: Progress, total: int) -> None:
        self.progress = progress
        self._total, self._done = total, 0

    def begin(self, what: str) -> None:
        """Report that the next step begins."""
        self.progress(self._done, self._total, what)
        self._done += 1
