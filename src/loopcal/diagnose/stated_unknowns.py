# SPDX-License-Identifier: Apache-2.0
"""Does what a file states of frames, targets and surfaces contradict the data? They are freed, and
the misfits compared.

A frame whose coordinate is kept at a wrong value, or has a prior about one, is made up for by the
robot: all its dimensions move, and the fit is good or does not end. Left to the data, the unknown
tells where it is, and nothing is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from loopcal.diagnose.read_as import InterpretedData, refined
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import listed
from loopcal.parameters import Parameter
from loopcal.units import DISPLAY_UNITS, find_unit

MOST_ALONE = 12
"""Stated unknowns up to which each is freed alone, to see which of them it is."""


@dataclass(frozen=True, eq=False)
class Contradiction:
    """Stated unknowns that the data contradict.

    Attributes
    ----------
    freed : the measurements with these unknowns left to the data. misfit : what is left then.
    names : of the unknowns. shown : for each, where the data put it and what was stated.
    """

    freed: InterpretedData
    misfit: float
    names: tuple[str, ...]
    shown: tuple[str, ...]

    @property
    def words(self) -> str:
        """What is read otherwise, and how; follows "with"."""
        return f"{listed(self.names)} left to the data"


def contradicted(
    free: FreeParameters, stated: InterpretedData, misfit: float, better: float
) -> Contradiction | None:
    """Find stated unknowns without which measurements fit far better.

    Parameters
    ----------
    free, stated : the robot's parameters, and the measurements as they are written. misfit :
        theirs.
    better : how many times smaller it must become.

    Returns
    -------
    Contradiction or None
        Of the unknowns that alone explain it, or else of all that are stated.
    """
    there = set(stated.local.table.names)
    names = tuple(known.name for known in stated.whole.stated_values if known.name in there)
    if not names or not stated.enough:
        return None
    every, found = _freed(free, stated, names)
    if not found * better < misfit:
        return None
    chosen, best = names, (every, found)
    if 1 < len(names) <= MOST_ALONE:
        single = [((name,), _freed(free, stated, (name,))) for name in names]
        chosen, best = min(
            [(names, best), *(one for one in single if one[1][1] * better < misfit)], key=_fewest
        )
    stated_as, meant = stated.local.table, best[0]
    values = meant.local.values() if meant.nuisance is None else meant.nuisance[0]
    shown = [
        _shown(
            free,
            stated_as.entries[stated_as.index(name)],
            float(values[meant.local.table.index(name)]),
        )
        for name in chosen
    ]
    return Contradiction(meant, best[1], chosen, tuple(shown))


def _fewest(one: tuple[tuple[str, ...], tuple[InterpretedData, float]]) -> tuple[int, float]:
    """Fewest unknowns first, then what fits best."""
    return len(one[0]), one[1][1]


def _freed(
    free: FreeParameters, stated: InterpretedData, names: tuple[str, ...]
) -> tuple[InterpretedData, float]:
    """The measurements with some unknowns left to the data, and their misfit, blunders left out."""
    known = tuple(one for one in stated.whole.stated_values if one.name not in names)
    way = InterpretedData(free, replace(stated.whole, stated_values=known))
    way.misfits()
    way.leave_out()
    return way, min(way.misfit(), refined(way))


def _shown(free: FreeParameters, entry: Parameter, value: float) -> str:
    """Where the data put an unknown and what was stated of it, in the unit of the robot's file."""
    symbol = free.robot.units.get(entry.dimension, DISPLAY_UNITS[entry.dimension].symbol)
    factor = find_unit(symbol).factor_to_si
    known = (
        "fixed"
        if not entry.free or entry.tolerance is None
        else f"sd {entry.tolerance / factor:.3g} {symbol}"
    )
    return f"{entry.name} at {value / factor:.4g} {symbol}, not at {entry.nominal / factor:.4g} {symbol} ({known})"
