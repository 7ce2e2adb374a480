# SPDX-License-Identifier: Apache-2.0
"""Records of `limbs` files: joints, limbs, drives and named parameters.

Frames: a limb carries a frame from the base to its tip. `at:` places a joint in it, as [x, y, z] or
as a full pose, and `axis:` is a direction in the placed frame. With all joints at zero and no
rotated placement, all axes are those of the base (of a copy: rotated with it).

Records that differ in a dimension only are classes of their own, because the reader of files takes
the unit of a number from its annotation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import AXES, Address, LinearMap
from loopcal.mechanism.families.records import (
    AngleTolerance,
    ErrorModel,
    LengthTolerance,
    Point,
    PoseRecord,
    RatioTolerance,
    RecordError,
    join_errors,
    single_error,
    standard_deviation,
    translate,
)
from loopcal.mechanism.transmission import (
    TRIANGLE_TERMS,
    compute_range,
    count_independent,
    find_side,
)
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

    rotation : (3, 3) R_placed_joint, whose third column is the joint's axis. start : angle of the
        joint near home [rad], which selects the side.
    Raises MechanismError: an anchor on the axis, a start at a dead point, or a stroke that no angle
        reaches.
    """
    triangle = drive.triangle
    points = np.array([triangle.foot, triangle.head]) @ rotation
    skew = rotation.T @ [triangle.skew.rx, triangle.skew.ry, triangle.skew.rz]
    terms = np.array([*points.ravel(), *skew[:2], 1.0, 0.0])
    low, high = (float(end) for end in compute_range(terms))
    # b of l^2 = a - b cos(theta - gamma) is twice the product of both levers
    if not high**2 - low**2 > 4 * ON_AXIS * float((points**2).sum(axis=1).max()):
        raise MechanismError(
            f"the triangle of actuator {name!r} is degenerate: an anchor is on the axis of the "
            "joint, so that the length is the same at every angle; state anchors beside the axis"
        )
    sine, middle = find_side(start, terms)
    if abs(sine) < DEAD:
        raise MechanismError(
            f"actuator {name!r} does not turn its joint at {np.rad2deg(start):g} deg, a dead point "
            "of its triangle, where both anchors and the axis are in one plane; state another "
            "`start:` of the joint, or other anchors"
        )
    terms[-2:] = np.sign(sine), middle
    for reading in drive.stroke or ():
        length = drive.offset + drive.gain * reading
        if np.isfinite(length) and not low <= length <= high:
            raise MechanismError(
                f"the stroke of actuator {name!r} contains the length {length * 1e3:.6g} mm, which "
                f"no angle of its joint reaches: the anchors are {low * 1e3:.6g} to "
                f"{high * 1e3:.6g} mm apart; correct the stroke or the anchors"
            )
    return dict(zip(TRIANGLE_TERMS, (float(term) for term in terms), strict=True))


def triangle_errors(
    name: str, drive: TriangleDrive, rotation: FloatArray, other: tuple[str, ...]
) -> ErrorModel:
    """Return the unknown dimensions of a triangle, `q1.foot.x` and so on; `other` are the other
    terms of the drive. Raises MechanismError: a dimension that a triangle does not have, or a skew
    about its axis.
    """
    known = (
        *(f"{point}.{axis}" for point in POINTS for axis in AXES[3:]),
        *(f"{SKEW}.{axis}" for axis in AXES[:3]),
    )
    errors = []
    for term in _expand_unknowns(drive, rotation):
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


Axis = Literal["x", "y", "z", "-x", "-y", "-z"] | tuple[Ratio, Ratio, Ratio]
Place = Point | PoseRecord
ORIGIN: Point = (0.0, 0.0, 0.0)
Moving = Literal["x", "y", "z", "length"]
Turning = Literal["rx", "ry", "rz"]
Freedom = Literal["rx", "ry", "rz", "x", "y", "z"]
Movable = Literal["length", "lead", "pitch", "offset", "gain", "curve", "backlash"]
MapAxis = Literal[Freedom, Movable]


def axis_vector(axis: Axis) -> FloatArray:
    """Return an axis as a vector (3,)."""
    if isinstance(axis, str):
        return (-1.0 if axis.startswith("-") else 1.0) * np.eye(3)["xyz".index(axis[-1])]
    return np.array(axis, dtype=float)


def matrix_from_place(place: Place) -> FloatArray:
    """Return a placement as (4, 4)."""
    return place.matrix if isinstance(place, PoseRecord) else translate(*place)


@dataclass(frozen=True)
class Revolute:
    """A rotary joint.

    `lead` is its advance along the axis in one turn (a screw), `start` its angle near home,
    `limits` its allowed values (low, high).
    """

    joint: Literal["R"]
    name: str = ""
    at: Place = ORIGIN
    axis: Axis = "z"
    actuated: str | None = None
    lead: Length = 0.0
    start: Angle = 0.0
    limits: tuple[Angle, Angle] | None = None


@dataclass(frozen=True)
class Prismatic:
    """A slide."""

    joint: Literal["P"]
    name: str = ""
    at: Place = ORIGIN
    axis: Axis = "z"
    actuated: str | None = None
    start: Length = 0.0
    limits: tuple[Length, Length] | None = None


@dataclass(frozen=True)
class Universal:
    """Two rotary joints whose axes intersect."""

    joint: Literal["U"]
    name: str = ""
    at: Place = ORIGIN
    axes: tuple[Axis, Axis] = ("x", "y")
    start: tuple[Angle, Angle] = (0.0, 0.0)


@dataclass(frozen=True)
class Cylindrical:
    """A rotation about and a slide along the same axis."""

    joint: Literal["C"]
    name: str = ""
    at: Place = ORIGIN
    axis: Axis = "z"
    start: Angle = 0.0
    slide_start: Length = 0.0


@dataclass(frozen=True)
class Spherical:
    """Three rotary joints about z, then y, then x through one point.

    It is singular with the second joint at 90 degrees.
    """

    joint: Literal["S"]
    name: str = ""
    at: Place = ORIGIN
    start: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)


JointRecord = Revolute | Prismatic | Universal | Cylindrical | Spherical


@dataclass(frozen=True)
class Copies:
    """Copies of a limb, rotated about an axis of base and platform.

    The numbers 1, 2, .. are appended to its names. Copy i is rotated by start + (i - 1) step;
    without a step the copies divide the full turn.
    """

    count: int
    about: Literal["x", "y", "z"] = "z"
    step: Angle | None = None
    start: Angle = 0.0


@dataclass(frozen=True)
class Shifts:
    """Unknown lengths of a limb: positions of an element in its placed frame, or the rod's length.

    `of` is a joint, `tip` (in a limb without joints its first body, such as `base`), its second
    body, such as `platform`, or `rod`. Parameters are called `limb.NAME.axis`, or `limb.NAME` for a
    rod's length, with NAME = `of` unless `name` is given.
    """

    of: str
    shift: tuple[Moving, ...]
    name: str = ""
    tolerance: LengthTolerance | None = None


@dataclass(frozen=True)
class Tilts:
    """Unknown angles of a limb: rotations of a joint's axis together with all that follows.

    `alone: true` rotates the axis of a slide alone.
    """

    of: str
    tilt: tuple[Turning, ...]
    name: str = ""
    alone: bool = False
    tolerance: AngleTolerance | None = None


@dataclass(frozen=True)
class LinkTolerances:
    """Tolerances of lengths and angles in the complete error model."""

    lengths: LengthTolerance | None = None
    angles: AngleTolerance | None = None


@dataclass(frozen=True)
class RodCone:
    """Allowed inclination of a rod from an axis at one end.

    `end` is `tip` (rod towards the platform) or `attachment` (rod towards the tip).
    """

    end: Literal["tip", "attachment"]
    axis: Axis
    angle: Angle


@dataclass(frozen=True)
class BodyRecord:
    """A body inside the loops, beside base and platform, that limbs join.

    Attributes
    ----------
    home : first guess of its pose in the base at home; without it the joints of a rigid limb, at
        their `start`, place the body.
    copies : repeat the body around an axis. Copy i of a limb that names it joins copy i of the
        body, and is written in the frame of that copy.
    """

    name: str
    home: PoseRecord | None = None
    copies: Copies | None = None


@dataclass(frozen=True)
class LimbRecord:
    """A limb: joints from one body on, then its ending on another one.

    Attributes
    ----------
    on, to : the bodies where it begins and ends: `base`, `platform`, or one of `bodies:`.
    chain : its joints. tip : its end, in the last carried frame; in a limb without joints its point
        on the first body.
    ending : `rigid`, `ball` (tip and attachment meet in a point) or `distance` (a rod of `length`
        between them).
    attach : the attachment in the frame of the second body. actuated : the drive of a `distance` of
        variable length.
    cones : allowed inclinations of that rod. copies : repeat the limb around an axis. errors : its
        unknowns in the ideal model.
    """

    name: str
    ending: Literal["rigid", "ball", "distance"]
    attach: Place = ORIGIN
    chain: tuple[JointRecord, ...] = ()
    tip: Place = ORIGIN
    length: Length = 0.0
    actuated: str | None = None
    on: str = "base"
    to: str = "platform"
    cones: tuple[RodCone, ...] = ()
    copies: Copies | None = None
    errors: tuple[Shifts | Tilts, ...] = ()


@dataclass(frozen=True)
class LengthDrive:
    """A drive whose reading is a length.

    joint value = offset + gain * reading + harmonics of the period. `unknown` names terms to
    identify (offset, gain, backlash, and with a period sin1, cos1, sin2, cos2), with the tolerances
    `length` and, for the gain, `ratio`. With a `sum`, the name of a driven joint -> weight, this is
    the sum of weight * joint value; its unknown weights (weight.m, or weight for all) have the
    tolerance `weights`.
    """

    reads: Literal["length"]
    stroke: tuple[Length, Length] | None = None
    gain: Ratio = 1.0
    offset: Length = 0.0
    period: Length = 0.0
    sigma: Length | None = None
    unknown: tuple[str, ...] = ()
    length: LengthTolerance | None = None
    ratio: RatioTolerance | None = None
    sum: Mapping[str, Ratio] = field(default_factory=dict)
    weights: RatioTolerance | None = None


@dataclass(frozen=True)
class AngleDrive:
    """A drive whose reading is an angle, on a rotary joint.

    joint value = offset + gain * reading + harmonics.
    """

    reads: Literal["angle"]
    stroke: tuple[Angle, Angle] | None = None
    gain: Ratio = 1.0
    offset: Angle = 0.0
    period: Angle = 0.0
    sigma: Angle | None = None
    unknown: tuple[str, ...] = ()
    angle: AngleTolerance | None = None
    ratio: RatioTolerance | None = None
    sum: Mapping[str, Ratio] = field(default_factory=dict)
    weights: RatioTolerance | None = None


@dataclass(frozen=True)
class SpoolDrive:
    """A drive whose reading is an angle and moves a length.

    joint value = offset + radius * reading + buildup * reading^2 / (4 pi) + harmonics. `radius` is
    the length paid out per radian of the reading (spool radius with gears and tackle; lead / (2 pi)
    of a spindle), negative if a growing reading shortens; `buildup` is its growth in one turn of
    the reading.
    """

    reads: Literal["angle"]
    radius: Length
    buildup: Length = 0.0
    stroke: tuple[Angle, Angle] | None = None
    offset: Length = 0.0
    period: Angle = 0.0
    sigma: Angle | None = None
    unknown: tuple[str, ...] = ()
    length: LengthTolerance | None = None
    radii: LengthTolerance | None = None
    buildups: LengthTolerance | None = None
    sum: Mapping[str, Ratio] = field(default_factory=dict)
    weights: RatioTolerance | None = None


Drive = LengthDrive | AngleDrive | SpoolDrive | TriangleDrive


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


@dataclass(frozen=True)
class LimbsFile:
    """The fields of a `limbs` file in addition to those of every robot; see `Limbs`."""

    freedoms: tuple[Freedom, ...] = ("rx", "ry", "rz", "x", "y", "z")
    controlled: tuple[str, ...] = ()
    actuators: Mapping[str, Drive] = field(default_factory=dict)
    bodies: tuple[BodyRecord, ...] = ()
    limbs: tuple[LimbRecord, ...] = ()
    error_model: Literal["ideal", "complete"] = "ideal"
    parameters: tuple[NamedParameter, ...] = ()
    tolerances: LinkTolerances = field(default_factory=LinkTolerances)
    closure: Literal["exact", "least-squares"] = "exact"


# Drives of `limbs` files whose readings are sums of joint values: `sum: {m: 1, n: 2}`.

WEIGHT = "weight"


class SumError(RecordError):
    """An impossible sum; `actuator` is the name under which a file states it."""

    def __init__(self, sentence: str, actuator: str) -> None:
        super().__init__(sentence, "actuators", actuator)


def has_sums(actuators: Mapping[str, object]) -> bool:
    """Return whether a drive of a file is a sum."""
    return any(getattr(drive, "sum", None) for drive in actuators.values())


def list_readings(
    actuators: Mapping[str, object], joints: Mapping[str, str]
) -> dict[str, tuple[str, Mapping[str, float]]]:
    """Return the readings of a file with sums: name -> (key in the file, weights of joints), of
    driven joints by name, each with the name that the file states.

    Raises SumError: a triangle drive, or a drive that is no sum and moves no joint.
    """
    readings: dict[str, tuple[str, Mapping[str, float]]] = {}
    for key, drive in actuators.items():
        weights: Mapping[str, float] | None = getattr(drive, "sum", None)
        if weights is None:
            raise SumError(
                f"actuator {key!r} is a triangle drive beside sums; let it drive a stage of its "
                "own in a file of the family stages",
                key,
            )
        if weights:
            readings[key] = key, weights
            continue
        own = [name for name, stated in joints.items() if key in (name, stated)]
        if not own:
            raise SumError(
                f"actuator {key!r} drives no joint and states no `sum:`; write 'actuated: {key}' "
                f"at a joint, or the sum that it reads of {', '.join(joints)}",
                key,
            )
        readings |= {name: (key, {name: 1.0}) for name in own}
    return readings


def check_sums(
    sums: Mapping[str, Mapping[str, float]], turning: Mapping[str, bool], known: Mapping[str, str]
) -> None:
    """Refuse sums, readings by name with the weights of their joints, that are no readings of the
    driven joints. turning : whether each of them is rotary. known : driven joint -> its limb.
    """
    for name, weights in sums.items():
        _check_sum(name, weights, turning)
    read = {joint for weights in sums.values() for joint, w in weights.items() if w != 0.0}
    unread = [joint for joint in turning if joint not in read]
    if unread:
        raise SumError(
            f"joint {unread[0]!r} of limb {known[unread[0]]!r} is in no sum, so no reading states "
            f"it; add it to a `sum:`, or list {unread[0]!r} among the actuators",
            next(iter(sums)),
        )
    W = np.array([[weights.get(joint, 0.0) for joint in turning] for weights in sums.values()])
    a, joints = W.shape
    if a > joints:
        raise SumError(
            f"{a} readings ({', '.join(sums)}) are sums of {joints} joints "
            f"({', '.join(turning)}); leave out readings",
            list(sums)[-1],
        )
    for i in range(a):
        if count_independent(W[: i + 1]) <= i:
            name = list(sums)[i]
            raise SumError(
                f"the weights of the sums are singular: that of actuator {name!r} follows from "
                f"those of {', '.join(list(sums)[:i])}, so it states nothing new; correct a weight",
                name,
            )


def _check_sum(name: str, weights: Mapping[str, float], turning: Mapping[str, bool]) -> None:
    """Refuse a sum of unknown joints, of unlike joints, or without a weight."""
    for joint, weight in weights.items():
        if joint not in turning:
            raise SumError(
                f"the sum of actuator {name!r} names {joint!r}, which no limb states under "
                f"'actuated:'{suggest_names(joint, list(turning))}; allowed are "
                f"{', '.join(turning)}",
                name,
            )
        if not np.isfinite(weight):
            raise SumError(
                f"the weight of {joint!r} in the sum of actuator {name!r} is {weight:g}; state a "
                "finite number",
                name,
            )
    if not any(weights.values()):
        raise SumError(
            f"all weights in the sum of actuator {name!r} are zero, so its reading states nothing; "
            "give a weight other than 0",
            name,
        )
    angles = [joint for joint in weights if turning[joint]]
    lengths = [joint for joint in weights if not turning[joint]]
    if angles and lengths:
        raise SumError(
            f"actuator {name!r} is a sum of the angle {angles[0]!r} and the length {lengths[0]!r}; "
            "sum joints of one kind, and describe a screw with the `lead:` of its joint",
            name,
        )


def is_weight(weights: Mapping[str, float], term: str) -> bool:
    """Return whether an unknown of a drive is a weight of its sum."""
    return bool(weights) and term.partition(".")[0] == WEIGHT


def weight_errors(
    name: str, drive: object, weights: Mapping[str, float], other: tuple[str, ...]
) -> ErrorModel:
    """Return the unknown weights of a sum, `q1.weight.m` and so on; `other` are the other terms of
    the drive.
    """
    unknown: tuple[str, ...] = getattr(drive, "unknown", ())
    tolerance: RatioTolerance | None = getattr(drive, "weights", None)
    joints: list[str] = []
    for term in unknown:
        if is_weight(weights, term):  # `weight` means all of a sum
            joints += weights if term == WEIGHT else [term.partition(".")[2]]
    errors = []
    for joint in joints:
        if joint not in weights:
            allowed = (*other, WEIGHT, *(f"{WEIGHT}.{known}" for known in weights))
            raise SumError(
                f"actuator {name!r} has no term {WEIGHT + '.' + joint!r}; allowed are "
                f"{', '.join(allowed)}",
                name,
            )
        parameter = f"{name}.{WEIGHT}.{joint}"
        address = Address(name, "transmission", f"{WEIGHT}.{joint}")
        sd = standard_deviation(tolerance, parameter)
        entry = LinearMap(parameter, address)
        errors.append(single_error(parameter, Dimension.RATIO, weights[joint], sd, entry))
    return join_errors(errors)
