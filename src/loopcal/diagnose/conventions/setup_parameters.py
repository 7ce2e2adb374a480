# SPDX-License-Identifier: Apache-2.0
"""Check setup parameters (frames, targets, surfaces): stated values, and values kept from a fit.

Stated values. A coordinate of a frame that is fixed at a wrong value, or has a wrong prior, is
compensated by the robot: all its dimensions change, and the fit looks good or diverges. When the
parameter is estimated instead, the residuals vanish and the estimate shows the true value.

Kept values. Whitened prediction errors have one size with the values of a fit, and another one when
setup parameters are fitted to the same rows, which costs as many degrees of freedom. Where nothing
was moved the two agree. A setup item was moved if keeping only this one brings the large size back.
Where none does alone (a shift of the frame equals a shift of the target on a robot that does not
turn), any of them may have been moved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from loopcal.diagnose.conventions.misfit import Comparison, compare_with_robot, exclude_far_rows
from loopcal.mechanism import Mechanism
from loopcal.parameters import Parameter

MOST_SINGLE = 12
"""Number of stated parameters up to which each is estimated alone, to find the wrong one."""

SMALLER = 3.0
"""Factor by which errors must decrease when a moved setup item is fitted again."""

ABOVE = 3.0
"""Standard deviations of the noise (rms) that the errors with kept values must exceed; below, noise
may be the reason.
"""

FEWEST = 8
"""Smallest number of equations beyond the fitted parameters that supports a result."""


class Contradiction(NamedTuple):
    """Stated setup parameters that the data contradict.

    Attributes
    ----------
    comparison : of the measurements with these parameters estimated. misfit : the remaining misfit.
    names : of the parameters. values : for each its name, estimate, stated value and certainty.
    """

    comparison: Comparison
    misfit: float
    names: tuple[str, ...]
    values: tuple[dict[str, Any], ...]


class MovedSetups(NamedTuple):
    """Frames, targets and surfaces that are no longer where a fit located them.

    Attributes
    ----------
    names : of those that moved, or of all that may have moved. times : factor by which the errors
        decrease when they are fitted again.
    """

    names: tuple[str, ...]
    times: float


def find_contradiction(stated: Comparison, misfit: float, better: float) -> Contradiction | None:
    """Find stated setup parameters without which measurements fit far better.

    Parameters
    ----------
    stated : the measurements as written. misfit : of these. better : factor by which it must
        decrease.

    Returns
    -------
    Contradiction or None
        Of the parameter that alone explains the misfit, or else of all stated ones.
    """
    present = set(stated.data.nuisance_parameters.table.names)
    names = tuple(value.name for value in stated.data.stated_values if value.name in present)
    if not names:
        return None
    together = _estimate_stated(stated, names)
    if not together.misfit * better < misfit:
        return None
    options = [together]
    if 1 < len(names) <= MOST_SINGLE:
        single = [_estimate_stated(stated, (name,)) for name in names]
        options += [option for option in single if option.misfit * better < misfit]
    return min(options, key=lambda option: (len(option.names), option.misfit))


def find_moved_setups(
    names: Sequence[str], sizes: Callable[[tuple[str, ...]], tuple[float, int]]
) -> MovedSetups | None:
    """Find frames, targets and surfaces that were moved since a fit.

    Parameters
    ----------
    names : of those whose values are kept.
    sizes : from the names that are fitted again to the root mean square [1] of whitened errors,
        with the lost degrees of freedom taken into account, and the number of equations left; NaN
        and 0 where the rows do not determine them.
    """
    names = tuple(names)
    if not names:
        return None
    kept, _ = sizes(())
    fitted, left = sizes(names)
    if left < FEWEST or not kept > ABOVE or not kept > SMALLER * fitted:
        return None
    moved = names
    if len(names) > 1:
        moved = tuple(
            name
            for name in names
            if sizes(tuple(other for other in names if other != name))[0] > SMALLER * fitted
        )
    return MovedSetups(moved or names, kept / fitted)


def _estimate_stated(stated: Comparison, names: tuple[str, ...]) -> Contradiction:
    """Compare the measurements with some stated parameters estimated."""
    from loopcal.diagnose.conventions.refinement import refine_misfit

    free, data = stated.problem.free, stated.data
    remaining = tuple(value for value in data.stated_values if value.name not in names)
    freed = replace(data, stated_values=remaining)
    comparison = exclude_far_rows(compare_with_robot(free, freed))
    misfit, estimates = refine_misfit(comparison)
    before, after = data.nuisance_parameters.table, freed.nuisance_parameters.table
    values = tuple(
        _describe_value(
            free.robot, before.entries[before.index(name)], float(estimates[after.index(name)])
        )
        for name in names
    )
    return Contradiction(comparison, misfit, names, values)


def _describe_value(robot: Mechanism, entry: Parameter, estimate: float) -> dict[str, Any]:
    """Return estimate, stated value and certainty of a parameter, in the unit of the robot's
    file.
    """
    unit = robot.get_unit(entry.dimension)
    symbol, factor = unit.symbol, unit.factor_to_si
    certainty = "fixed"
    if entry.free and entry.tolerance is not None:
        certainty = f"sd {entry.tolerance / factor:.3g} {symbol}"
    return {
        "name": entry.name,
        "estimated": f"{estimate / factor:.4g} {symbol}",
        "stated": f"{entry.nominal / factor:.4g} {symbol}",
        "certainty": certainty,
    }
