# SPDX-License-Identifier: Apache-2.0
"""Named parameters of robot files: numbers of one's own that several limbs or drives share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Address, LinearMap
from loopcal.mechanism.families.drives import PlacedRow, ScrewDrive, SpoolDrive
from loopcal.mechanism.families.placement import (
    AngleTolerance,
    ErrorModel,
    LengthTolerance,
    PlacedLimb,
    RatioTolerance,
    map_displacement,
    single_error,
    standard_deviation,
)
from loopcal.units import ARTICLES, Angle, Dimension, Length, Ratio

Freedom = Literal["rx", "ry", "rz", "x", "y", "z"]
Movable = Literal["length", "lead", "pitch", "offset", "gain", "curve", "backlash"]
MapAxis = Literal[Freedom, Movable]
POSITIVE = ("length", "lead", "gain")
"""What named parameters are mapped onto that keeps its sign: rods, screws and scales."""


@dataclass(frozen=True)
class MapEntry:
    """A number that a named parameter changes.

    It is axis `axis` of the frame placed at `element` of `limb` (of all its copies). With `limb`
    the name of a drive, `element` is `transmission` and `axis` one of its terms. The displacement
    is coefficient * change, or arm * change for an angle or ratio that moves a length [arm per
    radian]. `lead` is a screw's advance in one turn (`pitch`, the advance in a radian, is refused);
    a `curve` counts per radian or meter.
    """

    limb: str
    element: str
    axis: MapAxis
    coefficient: Ratio = 1.0
    arm: Length | None = None


@dataclass(frozen=True)
class NamedLength:
    """A named parameter that is a length, with its nominal value.

    `positive: true` says that no machine has it at zero or below, such as a radius. It is always so
    where a nominal value above zero is mapped onto a rod's length, a lead or a gain.
    """

    name: str
    length: Length
    maps: tuple[MapEntry, ...]
    tolerance: LengthTolerance | None = None
    positive: bool = False


@dataclass(frozen=True)
class NamedAngle:
    """A named parameter that is an angle, with its nominal value."""

    name: str
    angle: Angle
    maps: tuple[MapEntry, ...]
    tolerance: AngleTolerance | None = None


@dataclass(frozen=True)
class NamedRatio:
    """A named parameter without dimension, with its nominal value."""

    name: str
    ratio: Ratio
    maps: tuple[MapEntry, ...]
    tolerance: RatioTolerance | None = None


NamedParameter = NamedLength | NamedAngle | NamedRatio


def get_quantity(named: NamedParameter) -> tuple[Dimension, float]:
    """Return the dimension and the nominal value [SI] of a named parameter."""
    if isinstance(named, NamedLength):
        return Dimension.LENGTH, named.length
    if isinstance(named, NamedAngle):
        return Dimension.ANGLE, named.angle
    return Dimension.RATIO, named.ratio


def is_always_positive(named: NamedParameter) -> bool:
    """Return whether only values above zero of a named parameter exist, if its nominal value is."""
    is_stated = isinstance(named, NamedLength) and named.positive
    nominal = get_quantity(named)[1]
    if is_stated and not nominal > 0.0:
        raise MechanismError(
            f"parameter {named.name!r} must be positive, but its nominal value is "
            f"{nominal * 1e3:g} mm. Correct the value, or leave out 'positive'"
        )
    return is_stated or any(entry.axis in POSITIVE for entry in named.maps)


def find_engine_axis(name: str, entry: MapEntry) -> tuple[str, float]:
    """Return the engine's axis of a map entry and the change of it per unit of the parameter: a
    file states a lead per turn, the engine a pitch per radian.
    """
    if entry.axis == "pitch":
        raise MechanismError(
            f"parameter {name!r} is mapped onto 'pitch'. Use lead, the advance in one turn"
        )
    coefficient = entry.coefficient * (1.0 if entry.arm is None else entry.arm)
    if entry.axis == "lead":
        return "pitch", coefficient * (1 / (2 * np.pi))
    return entry.axis, coefficient


def check_units(named: NamedParameter, entry: MapEntry, drive: PlacedRow | None) -> None:
    """Refuse a map between unlike units, onto the drive that the entry names; a ratio is a slope
    for an angle.
    """
    (dimension, _), axis = get_quantity(named), entry.axis
    if drive is None or axis not in ("offset", "backlash", "gain", "curve"):
        needed = Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH
    elif axis in ("gain", "curve"):  # per unit of the reading
        needed = (
            Dimension.LENGTH
            if isinstance(drive.drive, SpoolDrive | ScrewDrive)
            else Dimension.RATIO
        )
    else:
        needed = drive.dimension
    what = f"parameter {named.name!r} is {ARTICLES[dimension]}"
    onto = f"{entry.axis} of {entry.limb!r} {ARTICLES[needed]}"
    if entry.arm is not None:
        if dimension is Dimension.LENGTH:
            raise MechanismError(
                f"{what} with an arm. Leave the arm out, which turns an angle into a length"
            )
        if needed is not Dimension.LENGTH:
            raise MechanismError(f"{what} with an arm and {onto}. Leave the arm out")
        return
    slope = dimension is Dimension.RATIO and needed is Dimension.ANGLE
    if dimension is needed or slope:
        return
    if needed is Dimension.LENGTH:
        raise MechanismError(
            f"{what} and {onto}. Give an `arm:` [length per radian], or the parameter as a length"
        )
    raise MechanismError(f"{what} and {onto}. Give it as {ARTICLES[needed]}")


def named_error(
    named: NamedParameter, limbs: Sequence[PlacedLimb], drives: Mapping[str, PlacedRow]
) -> ErrorModel:
    """Return a named parameter with its maps onto limbs and drives."""
    dimension, nominal = get_quantity(named)
    sd = standard_deviation(named.tolerance, named.name)
    maps = [m for entry in named.maps for m in _map_entry(named, entry, limbs, drives)]
    is_positive = is_always_positive(named)
    return single_error(named.name, dimension, nominal, sd, *maps, positive=is_positive)


def _map_entry(
    named: NamedParameter,
    entry: MapEntry,
    limbs: Sequence[PlacedLimb],
    drives: Mapping[str, PlacedRow],
) -> Iterator[LinearMap]:
    """Yield the maps of one entry, for every copy that it means."""
    name, (axis, coefficient) = named.name, find_engine_axis(named.name, entry)
    check_units(named, entry, drives.get(entry.limb))
    # a limb and a drive may have one name; only a limb has links with axes
    if entry.limb in drives and axis not in AXES:
        scale = drives[entry.limb].sense * coefficient
        yield LinearMap(name, Address(entry.limb, entry.element, axis), scale)
        return
    chosen = [limb for limb in limbs if entry.limb == limb.stem]
    chosen = chosen or [limb for limb in limbs if entry.limb == limb.name]
    if not chosen:
        known = dict.fromkeys([*(limb.stem for limb in limbs), *sorted(drives)])
        raise MechanismError(
            f"parameter {name!r} is mapped onto {entry.limb!r}, which is not there. Known: "
            f"{', '.join(known)}"
        )
    for limb in chosen:
        if axis in AXES:
            element = limb.find_element(entry.element)
            yield from map_displacement(name, limb, element, axis, coefficient)
        else:
            yield LinearMap(name, Address(limb.name, entry.element, axis), coefficient)
