# SPDX-License-Identifier: Apache-2.0
"""Records of `limbs` files: joints, limbs, drives and named parameters.

Frames: a limb carries a frame from the base to its tip. `at:` places a joint in it, as [x, y, z] or
as a full pose, and `axis:` is a direction in the placed frame. With all joints at zero and no
rotated placement, all axes are those of the base (of a copy: rotated with it).

Records that differ in a dimension only are classes of their own, because the reader of files takes
the unit of a number from its annotation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.families.limb_placement import translate
from loopcal.mechanism.families.records import (
    AngleTolerance,
    LengthTolerance,
    Point,
    PoseRecord,
    RatioTolerance,
)
from loopcal.mechanism.families.triangle_records import TriangleDrive
from loopcal.typing import FloatArray
from loopcal.units import Angle, Length, Ratio

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

    `of` is a joint, `tip` (`base` in a limb without joints), `platform` or `rod`. Parameters are
    called `limb.NAME.axis`, or `limb.NAME` for a rod's length, with NAME = `of` unless `name` is
    given.
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
class LimbRecord:
    """A limb: joints from the base on, then its ending on the platform.

    Attributes
    ----------
    on, to : where it begins and ends; only `base` and `platform` exist.
    chain : its joints. tip : its end, in the last carried frame; in a limb without joints its point
        on the base.
    ending : `rigid`, `ball` (tip and attachment meet in a point) or `distance` (a rod of `length`
        between them).
    attach : the attachment in the platform frame. actuated : the drive of a `distance` of variable
        length.
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
    limbs: tuple[LimbRecord, ...] = ()
    error_model: Literal["ideal", "complete"] = "ideal"
    parameters: tuple[NamedParameter, ...] = ()
    tolerances: LinkTolerances = field(default_factory=LinkTolerances)
    closure: Literal["exact", "least-squares"] = "exact"


def refuse_branch(limb: LimbRecord, names: tuple[str, ...]) -> None:
    """Refuse a limb that does not join base and platform; raises MechanismError."""
    for key, stated, allowed in (("starts on", limb.on, "base"), ("ends on", limb.to, "platform")):
        if stated == allowed:
            continue
        what = f"limb {stated!r}" if stated in names else f"{stated!r}"
        raise MechanismError(
            f"limb {limb.name!r} {key} {what}: loopcal has no limbs that branch from limbs; let it "
            f"{key.replace('s on', ' on')} the {allowed}, or model the branch as separate limbs"
        )
