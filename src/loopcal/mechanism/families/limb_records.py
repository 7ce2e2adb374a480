# SPDX-License-Identifier: Apache-2.0
"""Records of `limbs` files: joints, bodies and limbs.

Frames: a limb carries a frame from the base to its tip. `at:` places a joint in it, as [x, y, z] or
as a full pose, and `axis:` is a direction in the placed frame. With all joints at zero and no
rotated placement, all axes are those of the base (of a copy: rotated with it).

Records that differ in a dimension only are classes of their own, because the reader of files takes
the unit of a number from its annotation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.mechanism.families.named_parameters import Freedom
from loopcal.mechanism.families.placement import (
    AngleTolerance,
    LengthTolerance,
    LinkTolerances,
    Point,
    PoseRecord,
    translate,
)
from loopcal.typing import FloatArray
from loopcal.units import Angle, Length, Ratio

Axis = Literal["x", "y", "z", "-x", "-y", "-z"] | tuple[Ratio, Ratio, Ratio]
Place = Point | PoseRecord
ORIGIN: Point = (0.0, 0.0, 0.0)
Moving = Literal["x", "y", "z", "length"]
Turning = Literal["rx", "ry", "rz"]


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
    about: Axis = "z"
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
class LimbsFile:
    """The fields of a `limbs` file in addition to those of every robot; see `Limbs`."""

    freedoms: tuple[Freedom, ...] = ("rx", "ry", "rz", "x", "y", "z")
    controlled: tuple[str, ...] = ()
    bodies: tuple[BodyRecord, ...] = ()
    limbs: tuple[LimbRecord, ...] = ()
    error_model: Literal["ideal", "complete"] = "ideal"
    tolerances: LinkTolerances = field(default_factory=LinkTolerances)
    closure: Literal["exact", "least-squares"] = "exact"
