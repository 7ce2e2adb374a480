# SPDX-License-Identifier: Apache-2.0
"""Whether a named parameter and what it is mapped onto have the same unit, and the factor between
them.
"""

from __future__ import annotations

import math

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.families.limb_records import (
    Drive,
    Named,
    NamedAngle,
    NamedLength,
    Onto,
    SpoolDrive,
)
from loopcal.units import Dimension

WORDS = {Dimension.LENGTH: "a length", Dimension.ANGLE: "an angle", Dimension.RATIO: "a ratio"}
PER_RADIAN = 1 / (2 * math.pi)


def dimension_of(named: Named) -> Dimension:
    """What a named parameter is."""
    if isinstance(named, NamedLength):
        return Dimension.LENGTH
    return Dimension.ANGLE if isinstance(named, NamedAngle) else Dimension.RATIO


def engine_axis(name: str, entry: Onto) -> tuple[str, float]:
    """The axis of the engine that an entry moves and the change of it per unit: a lead is per turn,
    a pitch per radian.

    Raises
    ------
    MechanismError
        The axis `pitch`, which a file calls by its lead.
    """
    if entry.axis == "pitch":
        raise MechanismError(
            f"parameter {name!r} is mapped onto 'pitch'; use lead, the advance in one turn"
        )
    coefficient = entry.coefficient * (1.0 if entry.arm is None else entry.arm)
    return (
        ("pitch", coefficient * PER_RADIAN) if entry.axis == "lead" else (entry.axis, coefficient)
    )


def check_units(named: Named, entry: Onto, drive: tuple[Drive, bool] | None) -> None:
    """Refuse a map between unlike units; `drive` is the one that `limb` names, and whether its
    joint turns.

    A ratio stands for a slope where it turns something. Raises MechanismError with what to state.
    """
    found, needed = dimension_of(named), _needed(entry.axis, drive)
    what = f"parameter {named.name!r} is {WORDS[found]}"
    onto = f"{entry.axis} of {entry.limb!r} {WORDS[needed]}"
    if entry.arm is not None:
        if found is Dimension.LENGTH:
            raise MechanismError(
                f"{what} with an arm; leave the arm out, which turns an angle into a length"
            )
        if needed is not Dimension.LENGTH:
            raise MechanismError(f"{what} with an arm and {onto}; leave the arm out")
        return
    slope = found is Dimension.RATIO and needed is Dimension.ANGLE
    if found is needed or slope:
        return
    if needed is Dimension.LENGTH:
        raise MechanismError(
            f"{what} and {onto}; state an `arm:` [length per radian], or the parameter as a length"
        )
    raise MechanismError(f"{what} and {onto}; state it as {WORDS[needed]}")


def _needed(axis: str, drive: tuple[Drive, bool] | None) -> Dimension:
    """The dimension of what an entry moves; a gain or curve counts per unit of the reading."""
    if drive is None or axis not in ("offset", "backlash", "gain", "curve"):
        return Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH
    how, turns = drive
    if axis in ("gain", "curve"):
        return Dimension.LENGTH if isinstance(how, SpoolDrive) else Dimension.RATIO
    return Dimension.ANGLE if turns else Dimension.LENGTH
