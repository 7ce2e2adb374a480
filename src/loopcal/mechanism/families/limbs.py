# SPDX-License-Identifier: Apache-2.0
"""Mechanisms of any limbs between bodies, written joint by joint in a short file.

`error_model: ideal` has the unknowns that the file names (`errors:` of a limb, `unknown:` of a
drive, `parameters:`). `complete` adds six for every link transform, less those that its joint
repeats. How to write such a file: docs/robots.md.

Frames: a limb carries a frame from the base to its tip. `at:` places a joint in it, as [x, y, z] or
as a full pose, and `axis:` is a direction in the placed frame. With all joints at zero and no
rotated placement, all axes are those of the base (of a copy: rotated with it).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from loopcal.errors import MechanismError, suggest_names
from loopcal.geometry import invert_pose
from loopcal.mechanism.assembly import (
    BASE,
    MOST_COPIES,
    MOST_LIMBS,
    PLATFORM,
    Assembly,
    Cone,
    Joint,
    Limb,
    refuse_more,
)
from loopcal.mechanism.families import placement
from loopcal.mechanism.families.records import RobotRecord
from loopcal.mechanism.limb_rows import move_joint
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Length, Ratio

Axis = Literal["x", "y", "z", "-x", "-y", "-z"] | tuple[Ratio, Ratio, Ratio]
Place = placement.Point | placement.PoseRecord
ORIGIN: placement.Point = (0.0, 0.0, 0.0)
Moving = Literal["x", "y", "z", "length"]
Turning = Literal["rx", "ry", "rz"]


def axis_vector(axis: Axis) -> FloatArray:
    """Return an axis as a vector (3,)."""
    if isinstance(axis, str):
        return (-1.0 if axis.startswith("-") else 1.0) * np.eye(3)["xyz".index(axis[-1])]
    return np.array(axis, dtype=float)


def matrix_from_place(place: Place) -> FloatArray:
    """Return a placement as (4, 4)."""
    return place.matrix if isinstance(place, placement.PoseRecord) else placement.translate(*place)


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
    """A rotation about and a slide along one axis."""

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

    Copy i has the rotation start + (i - 1) step. Without a step they divide the full turn.
    """

    count: int
    about: Axis = "z"
    step: Angle | None = None
    start: Angle = 0.0


@dataclass(frozen=True)
class Shifts:
    """Unknown lengths of a limb: positions of an element in its placed frame, or the rod's length.

    `of` is a joint, `tip` (in a limb without joints its first body, such as `base`), its second
    body, such as `platform`, or `rod`. Parameters are `limb.NAME.axis`, or `limb.NAME` for a rod's
    length, with NAME = `of` by default.
    """

    of: str
    shift: tuple[Moving, ...]
    name: str = ""
    tolerance: placement.LengthTolerance | None = None


@dataclass(frozen=True)
class Tilts:
    """Unknown angles of a limb: rotations of a joint's axis together with all that follows.

    `alone: true` rotates the axis of a slide alone.
    """

    of: str
    tilt: tuple[Turning, ...]
    name: str = ""
    alone: bool = False
    tolerance: placement.AngleTolerance | None = None


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
    """A further body inside the loops that limbs join.

    home : first guess of its pose in the base at home. Without it the joints of a rigid limb, at
        their `start`, place the body.
    copies : repeat the body around an axis. Copy i of a limb that names it joins copy i of the
        body, in the frame of that copy.
    """

    name: str
    home: placement.PoseRecord | None = None
    copies: Copies | None = None


@dataclass(frozen=True)
class LimbRecord:
    """A limb: joints from one body on, then its ending on another one.

    on, to : the bodies where it begins and ends: `base`, `platform`, or one of `bodies:`.
    chain : its joints. tip : its end, in the last carried frame, or without joints its point on the
        first body.
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
class Limbs(RobotRecord):
    """The file of a mechanism of any limbs.

    freedoms : of the platform, in base axes. controlled : coordinates in which it is commanded.
    bodies : further bodies. limbs : from body to body. error_model : see the
        module. tolerances : of the complete model. closure : how over-constrained loops
        close.
    """

    family = "limbs"

    freedoms: tuple[placement.Freedom, ...] = ("rx", "ry", "rz", "x", "y", "z")
    controlled: tuple[str, ...] = ()
    bodies: tuple[BodyRecord, ...] = ()
    limbs: tuple[LimbRecord, ...] = ()
    error_model: Literal["ideal", "complete"] = "ideal"
    tolerances: placement.LinkTolerances = field(default_factory=placement.LinkTolerances)
    closure: Literal["exact", "least-squares"] = "exact"

    def expand(self) -> Assembly:
        """Return all copies of all limbs; raises MechanismError for an inconsistent file."""
        if not self.limbs:
            raise MechanismError(
                f"{self.name} has no limbs. Write those that join the base to the platform"
            )
        counts = [1 if limb.copies is None else limb.copies.count for limb in self.limbs]
        for limb, count in zip(self.limbs, counts, strict=True):
            if not 1 <= count <= MOST_COPIES:
                raise MechanismError(
                    f"limb {limb.name!r} has {count} copies. Give 1 to {MOST_COPIES}"
                )
        refuse_more(MOST_LIMBS, sum(counts), f"{self.name} has", "limbs")
        named = {body.name: body for body in self.bodies}
        copies = [copy for limb in self.limbs for copy in _copies(limb, named)]
        placed = [limb for _, limb in copies]
        errors = placement.join_errors(
            error
            for record, limb in copies
            for entry in record.errors
            for error in _list_errors(limb, entry)
        )
        assembly = self.assemble(
            placed,
            errors,
            freedoms=self.freedoms,
            controlled=self.controlled,
            complete=self.tolerances if self.error_model == "complete" else None,
        )
        bodies = _place_bodies(self, [limb.limb for limb in placed])
        return replace(assembly, closure=self.closure, bodies=bodies)


def _copies(
    limb: LimbRecord, bodies: Mapping[str, BodyRecord]
) -> Iterator[tuple[LimbRecord, placement.PlacedLimb]]:
    """Yield the copies of a limb, each with its record."""
    count = 0 if limb.copies is None else limb.copies.count
    for end in {limb.on, limb.to}.intersection(bodies):
        copies = bodies[end].copies
        if copies is not None and copies.count != count:
            raise MechanismError(
                f"limb {limb.name!r} has {count} copies, and body {end!r} has "
                f"{copies.count}. Give both equal `copies:`, or name one copy, such as "
                f"{end + '1'!r}"
            )
    turns = _list_turns(limb.copies)
    for number, turn in enumerate(turns, 1):
        suffix = str(number) if limb.copies else ""
        yield limb, _place_copy(limb, suffix, turn, bodies)


def _list_turns(copies: Copies | None) -> list[FloatArray]:
    """Return the rotations (4, 4) of copies, the identity alone for a single limb or body."""
    if copies is None:
        return [np.eye(4)]
    step = copies.step if copies.step is not None else 2 * np.pi / copies.count
    axis = axis_vector(copies.about)
    return [placement.rotate_about(axis, copies.start + i * step) for i in range(copies.count)]


def _place_bodies(record: Limbs, limbs: Sequence[Limb]) -> dict[str, FloatArray]:
    """Return the first guesses (4, 4) of the home poses of all bodies but base and platform.

    Raises MechanismError: two bodies with one name, an unknown one, or one without a guess.
    """
    homes = [
        (body.name + (str(i + 1) if body.copies else ""), body.home and turn @ body.home.matrix)
        for body in record.bodies
        for i, turn in enumerate(_list_turns(body.copies))
    ]
    names = [name for name, _ in homes]
    _check_ends(limbs, names)
    known = {BASE: np.eye(4)} | {name: T for name, T in homes if T is not None}
    follow_rigid_limbs(known, [limb for limb in limbs if PLATFORM not in (limb.on, limb.to)])
    known[PLATFORM] = record.home.matrix  # less certain than what the base carries
    follow_rigid_limbs(known, limbs)
    missing = [name for name in names if name not in known]
    if missing:
        raise MechanismError(
            f"body {missing[0]!r} has no rigid limb from a body with a known pose. Give its "
            "`home:` under `bodies:`"
        )
    return {name: known[name] for name in names}


def follow_rigid_limbs(known: dict[str, FloatArray], limbs: Sequence[Limb]) -> None:
    """Add the poses of bodies that rigid limbs join to bodies of known poses, by their joints at
    start.
    """
    count = 0
    while count < len(known):
        count = len(known)
        for limb in limbs:
            if limb.ending == "rigid" and (limb.on in known) != (limb.to in known):
                step = limb.links[0].transform
                for joint, link in zip(limb.joints, limb.links[1:], strict=True):
                    step = step @ move_joint(joint, joint.start) @ link.transform
                step = step @ invert_pose(limb.attachment.transform)
                if limb.on in known:
                    known[limb.to] = known[limb.on] @ step
                else:
                    known[limb.on] = known[limb.to] @ invert_pose(step)


def _check_ends(limbs: Sequence[Limb], names: Sequence[str]) -> None:
    """Refuse two bodies with one name or without limbs, and limbs that do not join two bodies."""
    joined = {end for limb in limbs for end in (limb.on, limb.to)}
    for name in names:
        if name in (BASE, PLATFORM) or names.count(name) > 1:
            raise MechanismError(
                f"two bodies have the name {name!r}, base and platform among them. Rename one"
            )
        if name not in joined:
            raise MechanismError(
                f"no limb joins the body {name!r}. Let limbs begin or end on it, or leave it out"
            )
    for limb in limbs:
        for name in (limb.on, limb.to):
            if name not in (BASE, PLATFORM, *names):
                raise MechanismError(
                    f"limb {limb.name!r} names {name!r}, which is not a body"
                    f"{suggest_names(name, names)}. Add it to `bodies:`, or name one of "
                    f"{', '.join((BASE, PLATFORM, *names))}"
                )
        if limb.on == limb.to:
            raise MechanismError(
                f"limb {limb.name!r} begins and ends on {limb.on!r}, which it cannot move. Name "
                "two bodies under `on:` and `to:`"
            )


def _place_copy(
    limb: LimbRecord, suffix: str, turn: FloatArray, bodies: Mapping[str, BodyRecord]
) -> placement.PlacedLimb:
    """Return one copy of a limb, rotated, with the suffix on its names; in a body with copies of
    its own it is not rotated.
    """
    if limb.ending != "distance" and (limb.length or limb.actuated or limb.cones):
        raise MechanismError(
            f"limb {limb.name!r} ends {limb.ending} and has a length, drive or cone of a rod. "
            "Give ending: distance, or leave it out"
        )
    if limb.ending == "distance" and not limb.actuated and not limb.length > 0:
        raise MechanismError(
            f"limb {limb.name!r} ends in a rod that no drive moves, of length {limb.length:g} m; "
            "it needs a positive `length:`"
        )
    steps: list[placement.JointPlacement] = []
    for i, joint in enumerate(limb.chain):
        number = 1 + sum(other.joint == joint.joint for other in limb.chain[:i])
        steps += _place_joint(joint, joint.name or f"{joint.joint}{number}", suffix)
    own = [name in bodies and bodies[name].copies is not None for name in (limb.on, limb.to)]
    first, last = (np.eye(4) if is_copied else turn for is_copied in own)
    on, to = (
        name + suffix * is_copied for name, is_copied in zip((limb.on, limb.to), own, strict=True)
    )
    tip, attachment = matrix_from_place(limb.tip), last @ matrix_from_place(limb.attach)
    if steps:
        steps[0] = replace(steps[0], place=first @ steps[0].place)
    else:
        tip = first @ tip
    drive = limb.actuated + suffix if limb.actuated else None
    cones = []
    for cone in limb.cones:
        x, y, z = axis_vector(cone.axis).tolist()
        cones.append(Cone(cone.end, (x, y, z), cone.angle))
    for step in steps:
        if step.joint.name == limb.to:
            raise MechanismError(
                f"limb {limb.name!r} has a joint {limb.to!r}, like the body on which it ends. "
                "Rename the joint"
            )
    placed = placement.place_limb(
        limb.name + suffix,
        tuple(steps),
        tip,
        limb.ending,
        attachment,
        limb.length,
        drive,
        tuple(cones),
        (limb.on, limb.to),
    )
    return placed._replace(limb=replace(placed.limb, on=on, to=to), stem=limb.name)


def _place_joint(record: JointRecord, name: str, suffix: str) -> list[placement.JointPlacement]:
    """Return a joint as R and P joints, the first one where the record places it."""
    if isinstance(record, Revolute | Prismatic):
        drive = record.actuated + suffix if record.actuated else None
        pitch = record.lead / (2 * np.pi) if isinstance(record, Revolute) else 0.0
        joints = [Joint(name, record.joint, drive, pitch, record.start, record.limits)]
        axes = [axis_vector(record.axis)]
    elif isinstance(record, Cylindrical):
        joints = [
            Joint(f"{name}.turn", "R", start=record.start),
            Joint(f"{name}.slide", "P", start=record.slide_start),
        ]
        axes = [axis_vector(record.axis)] * 2
    else:
        joints = [Joint(f"{name}.{i + 1}", "R", start=s) for i, s in enumerate(record.start)]
        is_universal = isinstance(record, Universal)
        axes = (
            [axis_vector(axis) for axis in record.axes]
            if is_universal
            else [placement.EZ, placement.EY, placement.EX]
        )
    places = [matrix_from_place(record.at), np.eye(4), np.eye(4)]
    return [placement.JointPlacement(*step) for step in zip(joints, places, axes, strict=False)]


def _list_errors(
    limb: placement.PlacedLimb, entry: Shifts | Tilts
) -> Iterator[placement.ErrorModel]:
    """Yield the unknown lengths or angles of a limb."""
    sd = placement.standard_deviation(entry.tolerance, f"{limb.name} {entry.of}")
    label = f"{limb.name}.{entry.name or entry.of}"
    for axis in entry.shift if isinstance(entry, Shifts) else entry.tilt:
        name = f"{label}.{axis}"
        if axis == "length":
            if limb.limb.ending != "distance" or entry.of != "rod":
                raise MechanismError(
                    f"{limb.name!r}: 'length' belongs to a rod. Write 'of: rod' in a limb that "
                    "ends in a distance"
                )
            yield placement.rod_length_error(
                limb, label if entry.name else f"{limb.name}.length", sd
            )
        elif isinstance(entry, Tilts) and entry.alone:
            maps = placement.map_slide_tilt(name, limb, limb.find_element(entry.of), axis)
            yield placement.single_error(name, Dimension.ANGLE, 0.0, sd, *maps)
        else:
            yield placement.displacement_error(name, limb, limb.find_element(entry.of), axis, sd)
