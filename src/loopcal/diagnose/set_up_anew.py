# SPDX-License-Identifier: Apache-2.0
"""Which of the frames, targets and surfaces that a fit found were set up anew before other
measurements were taken.

Kept as the fit found them, whitened prediction errors have some size; found anew from the same
rows, with as many degrees of freedom less, they have another. Where nothing was moved the two are
alike. One that alone, kept, brings the large size back was moved; where none does (a shift of the
frame is a shift of the target on a robot that does not turn), any of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from loopcal.estimate.inference.null_space import listed

SMALLER = 3.0
"""Times by which errors shrink when something is found anew, from which it is said to have been set
up anew.
"""

ABOVE = 3.0
"""Standard deviations of the noise (rms) that the errors must have while it is kept: below, noise
may be the reason.
"""

FEWEST = 8
"""Equations beyond what is found anew, without which nothing is said."""


@dataclass(frozen=True)
class MovedSetups:
    """Frames, targets and surfaces that stand elsewhere than the fit found them.

    Attributes
    ----------
    names : of those that were moved, or of all that may have been. times : how many times smaller
        errors are without them.
    """

    names: tuple[str, ...]
    times: float

    @property
    def sentence(self) -> str:
        """What this means and what to do."""
        one = len(self.names) == 1
        flags = " ".join(f"--refit {name}" for name in self.names)
        return (
            f"{listed(self.names, len(self.names))} {'seems' if one else 'seem'} to have been set "
            "up anew since the fit: found"
            f" anew from these rows, errors are {self.times:.3g} times smaller; use {flags}"
        )


def find_moved_setups(
    names: Sequence[str], sizes: Callable[[tuple[str, ...]], tuple[float, int]]
) -> MovedSetups | None:
    """Find what was set up anew, if anything was.

    Parameters
    ----------
    names : frames, targets and surfaces that are kept.
    sizes : from the names that are found anew to the root mean square [1] of whitened errors, each
        equation that this takes up counted as lost, and the number of equations left; NaN and 0
        where they do not tell where it is.

    Returns
    -------
    MovedSetups or None
    """
    every = tuple(names)
    if not every:
        return None
    kept, _ = sizes(())
    free, left = sizes(every)
    if left < FEWEST or not kept > ABOVE or not kept > SMALLER * free:
        return None
    moved = (
        [one for one in every if sizes(tuple(n for n in every if n != one))[0] > SMALLER * free]
        if every[1:]
        else every
    )
    return MovedSetups(tuple(moved) or every, kept / free)
