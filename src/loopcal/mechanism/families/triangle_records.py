# SPDX-License-Identifier: Apache-2.0
"""Records of triangle drives: a linear actuator that turns a revolute joint through two anchors.

Both anchors are in the frame in which the file places the joint, with the joint at zero; its axes
are those of the joint's errors. Formulas: `loopcal.mechanism.transmission.triangle`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import AXES, Address, LinearMap
from loopcal.mechanism.families.error_models import ErrorModel, join_errors, single_error
from loopcal.mechanism.families.records import (
    AngleTolerance,
    LengthTolerance,
    Point,
    RatioTolerance,
    standard_deviation,
)
from loopcal.mechanism.transmission.triangle import TRIANGLE_TERMS, compute_range, find_side
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Length, Ratio

ON_AXIS = 1e-9
"""Distance of an anchor from the axis, as a share of the larger one, that is no lever."""
DEAD = 1e-6
"""Sine of the angle from a dead point, below which the actuator does not turn the joint."""
POINTS, SKEW = ("foot", "head"), "skew"


@dataclass(frozen=True)
class Skew:
    """Rotation vector that tilts the axis of a joint in the frame of its two anchors."""

    rx: Angle = 0.0
    ry: Angle = 0.0
    rz: Angle = 0.0


@dataclass(frozen=True)
class Triangle:
    """The two anchors of a linear actuator beside a revolute joint, and the skew of its axis.

    foot : on what carries the joint. head : on what the joint turns, with the joint at zero.
    """

    foot: Point
    head: Point
    skew: Skew = field(default_factory=Skew)


@dataclass(frozen=True)
class TriangleDrive:
    """A linear actuator that turns a revolute joint through two anchors.

    distance of the anchors = offset + gain * reading + harmonics. `unknown` names terms to identify
    (offset, gain, backlash, harmonics) and dimensions of the triangle (foot.x, head.z, skew.rx; or
    foot, head and skew for all of one), with the tolerances `length`, `angle` and `ratio`.
    """

    triangle: Triangle
    reads: Literal["length"] = "length"
    stroke: tuple[Length, Length] | None = None
    gain: Ratio = 1.0
    offset: Length = 0.0
    period: Length = 0.0
    sigma: Length | None = None
    unknown: tuple[str, ...] = ()
    length: LengthTolerance | None = None
    angle: AngleTolerance | None = None
    ratio: RatioTolerance | None = None


@dataclass(frozen=True)
class NamedTriangleDrive(TriangleDrive):
    """A triangle drive of a serial joint, with the name of its actuator."""

    name: str = ""


def place_triangle(
    name: str, drive: TriangleDrive, rotation: FloatArray, start: float
) -> Mapping[str, float]:
    """Return the terms of a triangle in the joint's own frame, by name.

    Parameters
    ----------
    name : of the actuator. rotation : (3, 3) R_placed_joint, whose third column is the joint's
        axis. start : angle of the joint near home [rad], which selects the side.

    Raises
    ------
    MechanismError
        An anchor on the axis, a start at a dead point, or a stroke that no angle reaches.
    """
    triangle = drive.triangle
    points = np.array([triangle.foot, triangle.head]) @ rotation
    skew = rotation.T @ [triangle.skew.rx, triangle.skew.ry, triangle.skew.rz]
    terms = np.array([*points.ravel(), *skew[:2], 1.0, 0.0])
    _refuse_anchors_on_axis(name, terms)
    sine, middle = find_side(start, terms)
    if abs(sine) < DEAD:
        raise MechanismError(
            f"actuator {name!r} does not turn its joint at {np.rad2deg(start):g} deg, a dead point "
            "of its triangle, where both anchors and the axis are in one plane; state another "
            "`start:` of the joint, or other anchors"
        )
    terms[-2:] = np.sign(sine), middle
    _refuse_stroke(name, drive, terms)
    return dict(zip(TRIANGLE_TERMS, (float(term) for term in terms), strict=True))


def _refuse_anchors_on_axis(name: str, terms: FloatArray) -> None:
    """Refuse an anchor on the axis of the joint; terms : (10,)."""
    # b of l^2 = a - b cos(theta - gamma) is twice the product of both levers
    low, high = compute_range(terms)
    scale = max(np.linalg.norm(terms[0:3]), np.linalg.norm(terms[3:6]))
    if high**2 - low**2 > 4 * ON_AXIS * scale**2:
        return
    raise MechanismError(
        f"the triangle of actuator {name!r} is degenerate: an anchor is on the axis of the joint, "
        "so that the length is the same at every angle; state anchors beside the axis"
    )


def _refuse_stroke(name: str, drive: TriangleDrive, terms: FloatArray) -> None:
    """Refuse a stroke with a length that no angle of the joint reaches."""
    low, high = (float(end) for end in compute_range(terms))
    for reading in drive.stroke or ():
        length = drive.offset + drive.gain * reading
        if np.isfinite(length) and not low <= length <= high:
            raise MechanismError(
                f"the stroke of actuator {name!r} contains the length {length * 1e3:.6g} mm, which "
                f"no angle of its joint reaches: the anchors are {low * 1e3:.6g} to "
                f"{high * 1e3:.6g} mm apart; correct the stroke or the anchors"
            )


def list_triangle_parameters(drive: TriangleDrive) -> tuple[str, ...]:
    """Return the names of all dimensions of a triangle."""
    points = tuple(f"{point}.{axis}" for point in POINTS for axis in AXES[3:])
    return (*points, *(f"{SKEW}.{axis}" for axis in AXES[:3]))


def triangle_errors(
    name: str, drive: TriangleDrive, rotation: FloatArray, other: tuple[str, ...]
) -> ErrorModel:
    """Return the unknown dimensions of a triangle, `q1.foot.x` and so on.

    Parameters
    ----------
    name, drive, rotation : as in `place_triangle`. other : terms of the drive beside the triangle.

    Raises
    ------
    MechanismError
        A dimension that a triangle does not have, or a skew about the joint's own axis.
    """
    errors = []
    for term in _expand_unknowns(drive, rotation):
        known = list_triangle_parameters(drive)
        if term not in known:
            allowed = (*other, *POINTS, SKEW, *known)
            raise MechanismError(
                f"actuator {name!r} has no term {term!r}{suggest_names(term, allowed)}; allowed "
                f"are {', '.join(allowed)}"
            )
        part, _, axis = term.partition(".")
        direction = np.eye(3)[AXES.index(axis) % 3]
        components = rotation.T @ direction
        is_skew, parameter = part == SKEW, f"{name}.{term}"
        if is_skew and np.linalg.norm(components[:2]) < ON_AXIS:
            raise MechanismError(
                f"{parameter} rotates the triangle about the joint's own axis, which changes no "
                "length; leave it out"
            )
        stated = getattr(drive.triangle, part)
        nominal = getattr(stated, axis) if is_skew else stated[AXES.index(axis) % 3]
        tolerance = drive.angle if is_skew else drive.length
        maps = tuple(
            LinearMap(parameter, Address(name, "transmission", f"{part}.{own}"), float(share))
            for own, share in zip("xy" if is_skew else "xyz", components, strict=False)
            if abs(share) > 1e-12
        )
        dimension = Dimension.ANGLE if is_skew else Dimension.LENGTH
        sd = standard_deviation(tolerance, parameter)
        errors.append(single_error(parameter, dimension, nominal, sd, *maps))
    return join_errors(errors)


def complete_triangle(
    name: str, drive: TriangleDrive, rotation: FloatArray, tolerance: LengthTolerance | None
) -> ErrorModel:
    """Return the dimensions of a triangle that, with its offset, have the effects of all others.

    These are two coordinates of the foot across the axis of the joint, and the one of the head that
    changes its lever most: see docs/theory/triangle-drives.md. Arguments are as above.
    """
    across = rotation[:, :2]
    foot = sorted(np.argsort(-np.linalg.norm(across, axis=1), kind="stable")[:2].tolist())
    head = int(np.argmax(np.abs(across @ (across.T @ drive.triangle.head))))
    unknown = (*(f"foot.{AXES[3 + i]}" for i in foot), f"head.{AXES[3 + head]}")
    return triangle_errors(name, replace(drive, unknown=unknown, length=tolerance), rotation, ())


def is_of_triangle(drive: object, term: str) -> bool:
    """Return whether an unknown of a drive is a dimension of its triangle."""
    return isinstance(drive, TriangleDrive) and term.partition(".")[0] in (*POINTS, SKEW)


def _expand_unknowns(drive: TriangleDrive, rotation: FloatArray) -> Iterator[str]:
    """Yield the unknown dimensions, `foot` as foot.x, foot.y, foot.z.

    A whole skew is that about the two axes across that of the joint, if it is along one.
    """
    for term in drive.unknown:
        if term in POINTS:
            yield from (f"{term}.{axis}" for axis in AXES[3:])
        elif term == SKEW:
            across = np.linalg.norm(rotation[:, :2], axis=1) > ON_AXIS
            yield from (
                f"{SKEW}.{a}" for a, is_across in zip(AXES[:3], across, strict=True) if is_across
            )
        elif is_of_triangle(drive, term):
            yield term
