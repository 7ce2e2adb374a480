# SPDX-License-Identifier: Apache-2.0
"""Designs by their size: the value of good designs, and the smallest size that meets a target.

Each design also starts from the smaller one with the best groups added, and more rows never hurt,
so the curve is monotone. The bound of the relaxation says below which size no design can meet the
target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.findings import report_finding
from loopcal.planning.design.certificate import CertifiedDesign, choose_design
from loopcal.planning.design.criteria import Criterion, D
from loopcal.planning.design.design_space import (
    PriorInformation,
    count_groups_needed,
    find_observable_space,
    is_allowed,
    require_enough,
)
from loopcal.planning.design.relaxation import relax_design
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress

PERTURBATIONS = 10
"""Number of perturbations of each design of a curve."""

BOUND_GAP = 3e-3
"""Gap of the relaxation where only the size is needed."""


@dataclass(frozen=True, eq=False)
class DesignCurve:
    """Values of designs by their number of groups.

    Attributes
    ----------
    sizes : (k,) numbers of groups, ascending.
    values : (k,) of the criterion, never worse with more groups.
    bounds : (k,) values that no design of the same size exceeds.
    designs : k designs.
    """

    sizes: IntArray
    values: FloatArray
    bounds: FloatArray
    designs: tuple[CertifiedDesign, ...]


@dataclass(frozen=True, eq=False)
class SmallestDesign:
    """The smallest design found that meets a target.

    Attributes
    ----------
    n : its number of groups. at_least : no smaller number of groups can meet the target.
    certified : the design. curve : all designs that the search made.
    """

    n: int
    at_least: int
    certified: CertifiedDesign
    curve: DesignCurve


def compute_design_curve(
    rows: FloatArray,
    sizes: Sequence[int],
    criterion: Criterion,
    prior: PriorInformation,
    seed: int = 0,
    perturbations: int = PERTURBATIONS,
    repeats: bool = False,
    progress: Progress = report_no_progress,
) -> DesignCurve:
    """Return designs of several sizes with their values and bounds; arguments as `choose_design`.

    `progress` receives the sizes that are done.

    Raises
    ------
    EstimationError
        The smallest size cannot determine the unknowns, or fewer candidates are allowed than the
        largest.
    """
    designs: list[CertifiedDesign] = []
    for done, n in enumerate(sorted(set(sizes))):
        progress(done, len(set(sizes)), "computing the error by the number of poses")
        first = [designs[-1].design.chosen] if designs else []
        designs.append(
            choose_design(rows, n, criterion, prior, seed, perturbations, repeats, first=first)
        )
    return _collect_curve(designs)


def find_smallest_design(
    rows: FloatArray,
    target: float,
    criterion: Criterion,
    prior: PriorInformation,
    most: int | None = None,
    seed: int = 0,
    perturbations: int = PERTURBATIONS,
    repeats: bool = False,
) -> SmallestDesign:
    """Return the smallest design found whose criterion is at least as good as a target.

    Parameters
    ----------
    target : value of the criterion (for I a variance: the square of an rms standard deviation).
    most : largest number of groups; default: all that are allowed.
    others : see `choose_design`.

    Raises
    ------
    EstimationError
        No design of this many groups meets the target (so the bound says), or none was found.
    """
    count = int(is_allowed(rows).sum())
    most = count if most is None else most if repeats else min(most, count)
    space = find_observable_space(rows, prior)
    require_enough(most, rows, prior, space, repeats)
    bounds: dict[int, float] = {}

    def bound_of(n: int) -> float:
        bounds[n] = relax_design(rows, n, criterion, prior, BOUND_GAP, repeats).bound
        return bounds[n]

    made: dict[int, CertifiedDesign] = {}

    def value_of(n: int) -> float:
        smaller = [k for k in made if k < n]
        first = [made[max(smaller)].design.chosen] if smaller else []
        made[n] = choose_design(
            rows, n, criterion, prior, seed, perturbations, repeats, first=first
        )
        return made[n].design.value

    least, q = count_groups_needed(rows.shape[1], prior, space), len(space)
    at_least = search_size(bound_of, least, most, min(2 * least, most), criterion, target, q)
    numbers = {"size": most, "available": count, "criterion": criterion.name, "target": target}
    if at_least > most:
        raise EstimationError(
            report_finding("plan.target-impossible", best=bounds[most], **numbers)
        )
    n = search_size(value_of, at_least, most, at_least, criterion, target, q)
    if n > most:
        best = made[most].design.value
        raise EstimationError(report_finding("plan.target-not-reached", best=best, **numbers))
    return SmallestDesign(n, at_least, made[n], _collect_curve([made[k] for k in sorted(made)]))


def search_size(
    value_of: Callable[[int], float],
    low: int,
    high: int,
    n: int,
    criterion: Criterion,
    target: float,
    q: int,
) -> int:
    """Return the smallest size from low to high whose value meets the target, else high + 1.

    Values are assumed to be monotone. The next size is estimated as if the information grew with
    the size; every second step halves the interval, or doubles the size while no size has met the
    target.

    Parameters
    ----------
    n : first size to try. q : number of observable directions.
    """
    low, limit, step = low - 1, high + 1, 0
    high = limit
    while high - low > 1:
        n = min(max(n, low + 1), high - 1)
        value, step = value_of(n), step + 1
        low, high = (low, n) if _meets_target(criterion, value, target) else (n, high)
        if step % 2:
            growth = np.exp((target - value) / q) if isinstance(criterion, D) else value / target
            n = int(np.ceil(n * min(growth, 4.0)))
        else:
            n = 2 * n if high == limit else (low + high) // 2
    return high


def _meets_target(criterion: Criterion, value: float, target: float) -> bool:
    """Return whether a value is at least as good as the target."""
    return value >= target if isinstance(criterion, D) else value <= target


def _collect_curve(designs: list[CertifiedDesign]) -> DesignCurve:
    """Return the curve of designs, ascending in size."""
    sizes = np.array([len(made.design.chosen) for made in designs], dtype=np.int64)
    values = np.array([made.design.value for made in designs])
    bounds = np.array([made.relaxed.bound for made in designs])
    return DesignCurve(sizes, values, bounds, tuple(designs))
