# SPDX-License-Identifier: Apache-2.0
"""How many units: the criterion of good designs against their size, and the smallest size that
meets a target.

Each design also starts from the one before with the best units added, and more rows never hurt, so
that the curve is monotone. The relaxation's bound says below which size no design at all can meet
the target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.planning.certified import Certified, certified_design
from loopcal.planning.criteria import Criterion, D
from loopcal.planning.design import Start, allowed, directions, fewest, require_enough
from loopcal.planning.relaxation import relaxed_design
from loopcal.typing import FloatArray, IntArray

SHAKES = 10
"""Times that each design of a curve is shaken."""

BOUND_GAP = 3e-3
"""Gap of the relaxation where only the size is sought."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Values of designs by their number of units.

    Attributes
    ----------
    numbers : (k,) units, ascending. values : (k,) of the criterion, never worse with more units.
    bounds : (k,) that no design of so many units beats. designs : k designs.
    """

    numbers: IntArray
    values: FloatArray
    bounds: FloatArray
    designs: tuple[Certified, ...]


@dataclass(frozen=True, eq=False)
class Enough:
    """The smallest design found that meets a target.

    Attributes
    ----------
    n : its units. at_least : no design of fewer units meets the target. certified : the design.
    curve : all designs that were made on the way.
    """

    n: int
    at_least: int
    certified: Certified
    curve: Curve


def design_curve(
    rows: FloatArray,
    numbers: Sequence[int],
    criterion: Criterion,
    start: Start,
    seed: int = 0,
    shakes: int = SHAKES,
    repeats: bool = False,
) -> Curve:
    """Return designs of several sizes with their values and bounds; arguments as of
    `certified_design`.

    Raises
    ------
    EstimationError
        The smallest number cannot determine the unknowns, or fewer candidates are allowed than the
        largest.
    """
    found: list[Certified] = []
    for n in sorted(set(numbers)):
        first = [found[-1].design.chosen] if found else []
        found.append(
            certified_design(rows, n, criterion, start, seed, shakes, repeats, first=first)
        )
    return _curve(found)


def enough(
    rows: FloatArray,
    target: float,
    criterion: Criterion,
    start: Start,
    most: int | None = None,
    seed: int = 0,
    shakes: int = SHAKES,
    repeats: bool = False,
) -> Enough:
    """Return the smallest design found whose criterion is at least as good as a target.

    Parameters
    ----------
    target : value of the criterion (for I a variance: the square of the rms standard deviation
        asked for).
    most : units at most; default: all that are allowed. Others as of `certified_design`.

    Raises
    ------
    EstimationError
        No design of so many units meets the target (which the bound says), or none was found.
    """
    count = int(allowed(rows).sum())
    most = count if most is None else most if repeats else min(most, count)
    space = directions(rows, start)
    require_enough(most, rows, start, space, repeats)
    bounds: dict[int, float] = {}

    def bound_of(n: int) -> float:
        bounds[n] = relaxed_design(rows, n, criterion, start, BOUND_GAP, repeats).bound
        return bounds[n]

    made: dict[int, Certified] = {}

    def value_of(n: int) -> float:
        smaller = [k for k in made if k < n]
        first = [made[max(smaller)].design.chosen] if smaller else []
        made[n] = certified_design(rows, n, criterion, start, seed, shakes, repeats, first=first)
        return made[n].design.value

    least, q = fewest(rows.shape[1], start, space), len(space)
    at_least = smallest(bound_of, least, most, min(2 * least, most), criterion, target, q)
    if at_least > most:
        raise EstimationError(
            f"no {most} of the {count} allowed candidates bring criterion {criterion.name} to "
            f"{target:.6g}: the best possible"
            f" is {bounds[most]:.6g}; allow more poses, a less demanding target or a better "
            "instrument"
        )
    n = smallest(value_of, at_least, most, at_least, criterion, target, q)
    if n > most:
        raise EstimationError(
            f"no {most} of the {count} allowed candidates were found that bring criterion "
            f"{criterion.name} to {target:.6g}:"
            f" the best found has {made[most].design.value:.6g}; allow more poses or a less "
            "demanding target"
        )
    return Enough(n, at_least, made[n], _curve([made[k] for k in sorted(made)]))


def smallest(
    value_of: Callable[[int], float],
    low: int,
    high: int,
    n: int,
    criterion: Criterion,
    target: float,
    q: int,
) -> int:
    """Return the smallest size from low to high whose value meets the target, high + 1 where none
    does.

    Values are taken as monotone. Sizes are guessed as if the information grew with the size, and
    every second time the interval is halved, or the size doubled where none has met the target yet.
    """
    low, never, step = low - 1, high + 1, 0
    high = never
    while high - low > 1:
        n = min(max(n, low + 1), high - 1)
        value, step = value_of(n), step + 1
        low, high = (low, n) if _meets(criterion, value, target) else (n, high)
        if step % 2:
            growth = np.exp((target - value) / q) if isinstance(criterion, D) else value / target
            n = int(np.ceil(n * min(growth, 4.0)))
        else:
            n = 2 * n if high == never else (low + high) // 2
    return high


def _meets(criterion: Criterion, value: float, target: float) -> bool:
    """Tell whether a value is at least as good as the target."""
    return value >= target if isinstance(criterion, D) else value <= target


def _curve(found: list[Certified]) -> Curve:
    """Curve of designs, ascending in size."""
    numbers = np.array([len(one.design.chosen) for one in found], dtype=np.int64)
    values, bounds = (
        np.array([one.design.value for one in found]),
        np.array([one.relaxed.bound for one in found]),
    )
    return Curve(numbers, values, bounds, tuple(found))
