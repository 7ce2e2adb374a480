# SPDX-License-Identifier: Apache-2.0
"""Parameters of `limbs` files: unknown terms of drives, and units of named parameters.

Every unknown is a named quantity in a unit that people measure: the radius and build-up of a spool
stand for gain and curve. Formulas: docs/theory/parameters.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Actuator, Address, LinearMap
from loopcal.mechanism.families.error_models import ErrorModel, join_errors, single_error
from loopcal.mechanism.families.limb_records import (
    AngleDrive,
    Drive,
    LengthDrive,
    MapEntry,
    NamedAngle,
    NamedLength,
    NamedParameter,
    SpoolDrive,
)
from loopcal.mechanism.families.records import (
    AngleTolerance,
    LengthTolerance,
    RatioTolerance,
    standard_deviation,
)
from loopcal.mechanism.families.summed_records import is_weight, weight_errors
from loopcal.mechanism.families.triangle_records import (
    TriangleDrive,
    is_of_triangle,
    place_triangle,
    triangle_errors,
)
from loopcal.typing import FloatArray
from loopcal.units import ARTICLES, Dimension

HARMONICS = ("sin1", "cos1", "sin2", "cos2")
CURVE_OF_BUILDUP = 1 / (4 * np.pi)
"""Term `curve` per unit of build-up: radius + buildup * reading / (2 pi), integrated over the
reading.
"""

POSITIVE = ("length", "lead", "gain")
"""What named parameters are mapped onto that keeps its sign: rods, screws and scales."""

Tolerance = LengthTolerance | AngleTolerance | RatioTolerance | None
Term = tuple[Dimension, float, Tolerance, str, float]
"""Dimension, nominal value, tolerance, transmission term, and change of that term per unit."""


@dataclass(frozen=True, eq=False)
class PlacedDrive:
    """A drive and the joint that it moves; of several joints, the first.

    turns : whether the joint is rotary. rotation : (3, 3) R_placed_joint, whose third column is
    the joint's axis. start : value of the joint near home [rad or m]. weights : of the driven
    joints in a sum, by name.
    """

    drive: Drive
    turns: bool
    rotation: FloatArray
    start: float = 0.0
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def dimension(self) -> Dimension:
        """Dimension of what the transmission gives: the joint, or the length of a triangle."""
        is_angle = self.turns and not isinstance(self.drive, TriangleDrive)
        return Dimension.ANGLE if is_angle else Dimension.LENGTH


def check_motion(name: str, drive: Drive, turns: bool) -> None:
    """Refuse a drive whose transmission does not give what its joint does; raises
    MechanismError.
    """
    if turns == isinstance(drive, AngleDrive | TriangleDrive):
        return
    motion, allowed = (
        ("turns", "reads: angle without a radius, or a triangle")
        if turns
        else ("slides", "reads: length, or reads: angle with a radius")
    )
    raise MechanismError(f"actuator {name!r} drives a joint that {motion}; state {allowed}")


def build_actuator(name: str, placed: PlacedDrive) -> Actuator:
    """Return the actuator of a drive; raises MechanismError for an impossible triangle."""
    drive = placed.drive
    if isinstance(drive, SpoolDrive):
        terms = {"gain": drive.radius, "curve": CURVE_OF_BUILDUP * drive.buildup}
    else:
        terms = {"gain": drive.gain}
    if isinstance(drive, TriangleDrive):
        terms |= place_triangle(name, drive, placed.rotation, placed.start)
    reads_length = isinstance(drive, LengthDrive | TriangleDrive)
    dimension = Dimension.LENGTH if reads_length else Dimension.ANGLE
    terms = {"offset": drive.offset, **terms}
    period, sigma = drive.period, drive.sigma
    return Actuator(name, dimension, drive.stroke, terms, period, sigma, placed.weights)


def drive_errors(name: str, placed: PlacedDrive) -> ErrorModel:
    """Return the unknown terms of a drive, `q1.offset` and so on.

    Raises
    ------
    MechanismError
        A term that the drive does not have, or a harmonic without a period.
    """
    drive = placed.drive
    known = _list_terms(drive, placed.dimension)
    errors = []
    if isinstance(drive, TriangleDrive):
        errors.append(triangle_errors(name, drive, placed.rotation, tuple(known)))
    errors += [weight_errors(name, drive, placed.weights, tuple(known))]
    for term in drive.unknown:
        if is_of_triangle(drive, term) or is_weight(placed.weights, term):
            continue
        if term not in known:
            raise MechanismError(
                f"actuator {name!r} has no term {term!r}; allowed are {', '.join(known)}"
            )
        if term in HARMONICS and not drive.period:
            raise MechanismError(
                f"actuator {name!r} has an unknown {term}, but no period; state the reading's "
                "period"
            )
        dimension, nominal, tolerance, axis, coefficient = known[term]
        parameter, address = f"{name}.{term}", Address(name, "transmission", axis)
        sd = standard_deviation(tolerance, parameter)
        entry = LinearMap(parameter, address, coefficient)
        is_scale = axis == "gain"
        errors.append(single_error(parameter, dimension, nominal, sd, entry, positive=is_scale))
    return join_errors(errors)


def _list_terms(drive: Drive, joint_dimension: Dimension) -> Mapping[str, Term]:
    """Return the terms of a drive by name."""
    tolerance = drive.angle if isinstance(drive, AngleDrive) else drive.length
    length, curve = Dimension.LENGTH, CURVE_OF_BUILDUP
    terms: dict[str, Term] = {"offset": (joint_dimension, drive.offset, tolerance, "offset", 1.0)}
    if isinstance(drive, SpoolDrive):
        terms["radius"] = (length, drive.radius, drive.radii, "gain", 1.0)
        terms["buildup"] = (length, drive.buildup, drive.buildups, "curve", curve)
    else:
        terms["gain"] = (Dimension.RATIO, drive.gain, drive.ratio, "gain", 1.0)
    for term in ("backlash", *HARMONICS):
        terms[term] = (joint_dimension, 0.0, tolerance, term, 1.0)
    return terms


def get_quantity(named: NamedParameter) -> tuple[Dimension, float]:
    """Return the dimension and the nominal value [SI] of a named parameter."""
    if isinstance(named, NamedLength):
        return Dimension.LENGTH, named.length
    if isinstance(named, NamedAngle):
        return Dimension.ANGLE, named.angle
    return Dimension.RATIO, named.ratio


def is_always_positive(named: NamedParameter) -> bool:
    """Return whether only values above zero of a named parameter exist, if its nominal value is.

    Raises
    ------
    MechanismError
        The file says so, but the nominal value is not above zero.
    """
    is_stated = isinstance(named, NamedLength) and named.positive
    nominal = get_quantity(named)[1]
    if is_stated and not nominal > 0.0:
        raise MechanismError(
            f"parameter {named.name!r} is stated to be positive, but its nominal value is "
            f"{nominal * 1e3:g} mm; correct the value, or leave out 'positive'"
        )
    return is_stated or any(entry.axis in POSITIVE for entry in named.maps)


def find_engine_axis(name: str, entry: MapEntry) -> tuple[str, float]:
    """Return the engine's axis of a map entry and the change of it per unit of the parameter.

    A file states a lead per turn, the engine a pitch per radian.

    Raises
    ------
    MechanismError
        The axis `pitch`, for which a file states the lead.
    """
    if entry.axis == "pitch":
        raise MechanismError(
            f"parameter {name!r} is mapped onto 'pitch'; use lead, the advance in one turn"
        )
    coefficient = entry.coefficient * (1.0 if entry.arm is None else entry.arm)
    if entry.axis == "lead":
        return "pitch", coefficient * (1 / (2 * np.pi))
    return entry.axis, coefficient


def check_units(named: NamedParameter, entry: MapEntry, drive: PlacedDrive | None) -> None:
    """Refuse a map between unlike units; raises MechanismError with what to state.

    `drive` is the drive that the entry names. A ratio is a slope for an angle.
    """
    (dimension, _), needed = get_quantity(named), _find_needed_dimension(entry.axis, drive)
    what = f"parameter {named.name!r} is {ARTICLES[dimension]}"
    onto = f"{entry.axis} of {entry.limb!r} {ARTICLES[needed]}"
    if entry.arm is not None:
        if dimension is Dimension.LENGTH:
            raise MechanismError(
                f"{what} with an arm; leave the arm out, which turns an angle into a length"
            )
        if needed is not Dimension.LENGTH:
            raise MechanismError(f"{what} with an arm and {onto}; leave the arm out")
        return
    slope = dimension is Dimension.RATIO and needed is Dimension.ANGLE
    if dimension is needed or slope:
        return
    if needed is Dimension.LENGTH:
        raise MechanismError(
            f"{what} and {onto}; state an `arm:` [length per radian], or the parameter as a length"
        )
    raise MechanismError(f"{what} and {onto}; state it as {ARTICLES[needed]}")


def _find_needed_dimension(axis: str, drive: PlacedDrive | None) -> Dimension:
    """Return the dimension of what an entry moves; gain and curve count per unit of the reading."""
    if drive is None or axis not in ("offset", "backlash", "gain", "curve"):
        return Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH
    if axis in ("gain", "curve"):
        return Dimension.LENGTH if isinstance(drive.drive, SpoolDrive) else Dimension.RATIO
    return drive.dimension
