# SPDX-License-Identifier: Apache-2.0
"""Mechanisms of any limbs between bodies, written joint by joint in a short file.

`error_model: ideal` has the unknowns that the file names (`errors:` of a limb, `unknown:` of a
drive, `parameters:`). `complete` adds six for every link transform, less those that its joint
repeats. How to write such a file: docs/robots.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from loopcal.errors import MechanismError, suggest_names
from loopcal.geometry import invert_pose
from loopcal.mechanism.assembly import (
    AXES,
    BASE,
    MOST_COPIES,
    MOST_LIMBS,
    PLATFORM,
    Actuator,
    Address,
    Assembly,
    Cone,
    Joint,
    Limb,
    LinearMap,
    refuse_more,
)
from loopcal.mechanism.families.limb_records import (
    AngleDrive,
    BodyRecord,
    Copies,
    Cylindrical,
    Drive,
    JointRecord,
    LengthDrive,
    LimbRecord,
    LimbsFile,
    MapEntry,
    NamedAngle,
    NamedLength,
    NamedParameter,
    Prismatic,
    Revolute,
    Shifts,
    SpoolDrive,
    Tilts,
    TriangleDrive,
    Universal,
    axis_vector,
    check_sums,
    complete_triangle,
    has_sums,
    is_of_triangle,
    is_weight,
    list_readings,
    matrix_from_place,
    place_triangle,
    triangle_errors,
    weight_errors,
)
from loopcal.mechanism.families.records import (
    EX,
    EY,
    EZ,
    AngleTolerance,
    ErrorModel,
    ErrorTolerances,
    JointPlacement,
    LengthTolerance,
    PlacedLimb,
    RatioTolerance,
    RobotRecord,
    complete_errors,
    displacement_error,
    join_errors,
    map_displacement,
    map_slide_tilt,
    offset_error,
    place_limb,
    rod_length_error,
    rotate_about,
    single_error,
    standard_deviation,
)
from loopcal.mechanism.limb_rows import move_joint
from loopcal.typing import FloatArray
from loopcal.units import ARTICLES, Dimension

# Parameters of `limbs` files: unknown terms of drives, and units of named parameters.

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
    """Return the unknown terms of a drive, `q1.offset` and so on; raises MechanismError for
    impossible ones.
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
    """Return whether only values above zero of a named parameter exist, if its nominal value is."""
    is_stated = isinstance(named, NamedLength) and named.positive
    nominal = get_quantity(named)[1]
    if is_stated and not nominal > 0.0:
        raise MechanismError(
            f"parameter {named.name!r} is stated to be positive, but its nominal value is "
            f"{nominal * 1e3:g} mm; correct the value, or leave out 'positive'"
        )
    return is_stated or any(entry.axis in POSITIVE for entry in named.maps)


def find_engine_axis(name: str, entry: MapEntry) -> tuple[str, float]:
    """Return the engine's axis of a map entry and the change of it per unit of the parameter: a
    file states a lead per turn, the engine a pitch per radian.
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
    """Refuse a map between unlike units, onto the drive that the entry names; a ratio is a slope
    for an angle.
    """
    (dimension, _), axis = get_quantity(named), entry.axis
    if drive is None or axis not in ("offset", "backlash", "gain", "curve"):
        needed = Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH
    elif axis in ("gain", "curve"):  # per unit of the reading
        needed = Dimension.LENGTH if isinstance(drive.drive, SpoolDrive) else Dimension.RATIO
    else:
        needed = drive.dimension
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


@dataclass(frozen=True)
class Limbs(LimbsFile, RobotRecord):
    """The file of a mechanism of any limbs.

    Attributes
    ----------
    freedoms : of the platform, in base axes. controlled : coordinates in which it is commanded.
    actuators : drives by name; a drive that is not listed reads the joint value. In a limb with
        copies, `q` means q1, q2, ..
    bodies : those beside base and platform. limbs : from body to body. error_model, parameters :
        see the module. tolerances : of the complete model. closure : how over-constrained loops
        close.
    """

    family = "limbs"

    def expand(self) -> Assembly:
        """Return all copies of all limbs; raises MechanismError for an inconsistent file."""
        if not self.limbs:
            raise MechanismError(
                f"{self.name} has no limbs; write those that join the base to the platform"
            )
        counts = [1 if limb.copies is None else limb.copies.count for limb in self.limbs]
        for limb, count in zip(self.limbs, counts, strict=True):
            if not 1 <= count <= MOST_COPIES:
                raise MechanismError(
                    f"limb {limb.name!r} has {count} copies; give 1 to {MOST_COPIES}"
                )
        refuse_more(MOST_LIMBS, sum(counts), f"{self.name} has", "limbs")
        named = {body.name: body for body in self.bodies}
        members = {limb.name: tuple(_copies(limb, named)) for limb in self.limbs}
        copies = [member for group in members.values() for member in group]
        drives = self._place_drives(copies)
        errors = join_errors(
            (
                *(
                    _shifts(member.placed, entry)
                    if isinstance(entry, Shifts)
                    else _tilts(member.placed, entry)
                    for member in copies
                    for entry in member.record.errors
                ),
                *(drive_errors(name, drive) for name, drive in drives.items()),
                *(_named(named, members, drives) for named in self.parameters),
            )
        )
        if self.error_model == "complete":
            errors = self._complete(copies, drives).without_effects_of(errors) + errors
        idle = [
            name
            for name in self.actuators
            if name not in drives and not any(d.rstrip("0123456789") == name for d in drives)
        ]
        if idle:
            raise MechanismError(
                f"actuator {idle[0]!r} drives no joint; write 'actuated: {idle[0]}' at one, or "
                "leave it out" + (f"; joints are driven by {', '.join(drives)}" if drives else "")
            )
        assembly = self.assemble(
            (member.placed.limb for member in copies),
            (build_actuator(name, drive) for name, drive in drives.items()),
            errors,
            freedoms=self.freedoms,
            controlled=self.controlled,
        )
        bodies = _place_bodies(self, [member.placed.limb for member in copies])
        return replace(assembly, closure=self.closure, bodies=bodies)

    def _place_drives(self, copies: list[_Member]) -> dict[str, PlacedDrive]:
        """Return the drives by name, in the order of the readings, with their joints."""
        # a drive that several limbs name is one drive
        joints: dict[str, _DrivenJoint] = {}
        for member in copies:
            for joint in _list_driven_joints(member):
                joints.setdefault(joint.name, joint)
        drives: dict[str, PlacedDrive] = {}
        if not has_sums(self.actuators):
            for name, joint in joints.items():
                plain = AngleDrive("angle") if joint.turns else LengthDrive("length")
                drive = self.actuators.get(name) or self.actuators.get(joint.stated) or plain
                check_motion(name, drive, joint.turns)
                drives[name] = PlacedDrive(drive, joint.turns, joint.rotation, joint.start)
            return drives
        stated = {name: joint.stated for name, joint in joints.items()}
        turning = {name: joint.turns for name, joint in joints.items()}
        readings = list_readings(self.actuators, stated)
        limb_of = {name: joint.limb for name, joint in joints.items()}
        check_sums({name: weights for name, (_, weights) in readings.items()}, turning, limb_of)
        for name, (key, weights) in readings.items():
            drive, turns = self.actuators[key], turning[next(iter(weights))]
            check_motion(name, drive, turns)
            own = {} if tuple(weights) == (name,) and weights[name] == 1.0 else weights
            drives[name] = PlacedDrive(drive, turns, np.eye(3), 0.0, own)
        return drives

    def _complete(self, copies: list[_Member], drives: Drives) -> ErrorModel:
        """Return all errors of all limbs, and of every drive once its offset and its triangle."""
        spread = ErrorTolerances(
            standard_deviation(self.tolerances.lengths, "the lengths"),
            standard_deviation(self.tolerances.angles, "the angles"),
        )
        # the first rigid limb of a body places its frame, so that errors of its end are none
        rigid = [m.placed.limb for m in copies[::-1] if m.record.ending == "rigid"]
        places = {limb.to: limb.name for limb in rigid if limb.to != PLATFORM}
        errors = [
            complete_errors(m.placed, spread, False, places.get(m.placed.limb.to) == m.placed.name)
            for m in copies
        ]
        for name, placed in drives.items():
            dimension, offset = placed.dimension, placed.drive.offset
            sd = spread.angle if dimension is Dimension.ANGLE else spread.length
            errors.append(offset_error(f"{name}.offset", name, dimension, offset, sd))
            if isinstance(placed.drive, TriangleDrive):
                lengths = self.tolerances.lengths
                errors.append(complete_triangle(name, placed.drive, placed.rotation, lengths))
        return join_errors(errors)


@dataclass(frozen=True)
class _Member:
    """One copy of a limb, with the number appended to its names."""

    record: LimbRecord
    placed: PlacedLimb
    suffix: str


@dataclass(frozen=True, eq=False)
class _DrivenJoint:
    """A joint or rod under the name of its drive.

    stated : this name as the file states it, without the number of a copy. limb : its limb.
    turns, rotation, start : as in `PlacedDrive`.
    """

    name: str
    stated: str
    limb: str
    turns: bool
    rotation: FloatArray
    start: float


def _list_driven_joints(member: _Member) -> Iterator[_DrivenJoint]:
    """Yield the driven joints of a limb, the rod last."""
    limb, rotations = member.placed.limb, member.placed.rotations
    for j in limb.joints:
        if j.actuator:
            stated = j.actuator.removesuffix(member.suffix)
            turns = j.kind == "R"
            yield _DrivenJoint(j.actuator, stated, limb.name, turns, rotations[j.name], j.start)
    if limb.actuator:
        stated = limb.actuator.removesuffix(member.suffix)
        yield _DrivenJoint(limb.actuator, stated, limb.name, False, np.eye(3), 0.0)


Members = Mapping[str, tuple[_Member, ...]]
"""The copies of each limb of the file."""
Drives = Mapping[str, PlacedDrive]
"""Drives by name, with the joints that they move."""


def _copies(limb: LimbRecord, bodies: Mapping[str, BodyRecord]) -> Iterator[_Member]:
    """Yield the copies of a limb."""
    count = 0 if limb.copies is None else limb.copies.count
    for end in {limb.on, limb.to}.intersection(bodies):
        copies = bodies[end].copies
        if copies is not None and copies.count != count:
            raise MechanismError(
                f"limb {limb.name!r} has {count} copies, and body {end!r} has {copies.count}; give "
                f"both the same `copies:`, or name one copy, such as {end + '1'!r}"
            )
    turns = _list_turns(limb.copies)
    for number, turn in enumerate(turns, 1):
        suffix = str(number) if limb.copies else ""
        yield _Member(limb, _place_copy(limb, suffix, turn, bodies), suffix)


def _list_turns(copies: Copies | None) -> list[FloatArray]:
    """Return the rotations (4, 4) of copies, the identity alone for a single limb or body."""
    if copies is None:
        return [np.eye(4)]
    step = copies.step if copies.step is not None else 2 * np.pi / copies.count
    return [rotate_about(copies.about, copies.start + i * step) for i in range(copies.count)]


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
    _follow_rigid_limbs(known, [limb for limb in limbs if PLATFORM not in (limb.on, limb.to)])
    known[PLATFORM] = record.home.matrix  # less certain than what the base carries
    _follow_rigid_limbs(known, limbs)
    missing = [name for name in names if name not in known]
    if missing:
        raise MechanismError(
            f"body {missing[0]!r} has no rigid limb from a body with a known pose; state its "
            "`home:` under `bodies:`"
        )
    return {name: known[name] for name in names}


def _follow_rigid_limbs(known: dict[str, FloatArray], limbs: Sequence[Limb]) -> None:
    """Add the poses of bodies that rigid limbs join to bodies of known poses."""
    count = 0
    while count < len(known):
        count = len(known)
        for limb in limbs:
            if limb.ending == "rigid" and (limb.on in known) != (limb.to in known):
                step = _follow_at_start(limb) @ invert_pose(limb.attachment.transform)
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
                f"two bodies are called {name!r}, base and platform among them; rename one"
            )
        if name not in joined:
            raise MechanismError(
                f"no limb joins the body {name!r}; let limbs begin or end on it, or leave it out"
            )
    for limb in limbs:
        for name in (limb.on, limb.to):
            if name not in (BASE, PLATFORM, *names):
                raise MechanismError(
                    f"limb {limb.name!r} names {name!r}, which is not a body"
                    f"{suggest_names(name, names)}; add it to `bodies:`, or name one of "
                    f"{', '.join((BASE, PLATFORM, *names))}"
                )
        if limb.on == limb.to:
            raise MechanismError(
                f"limb {limb.name!r} begins and ends on {limb.on!r}, which it cannot move; name "
                "two bodies under `on:` and `to:`"
            )


def _follow_at_start(limb: Limb) -> FloatArray:
    """Return the tip (4, 4) of a limb in the body where it begins, its joints at their start."""
    T = limb.links[0].transform
    for joint, link in zip(limb.joints, limb.links[1:], strict=True):
        motion = move_joint(joint.kind, np.array(joint.start), np.array(joint.pitch))
        T = T @ motion @ link.transform
    return T


def _place_copy(
    limb: LimbRecord, suffix: str, turn: FloatArray, bodies: Mapping[str, BodyRecord]
) -> PlacedLimb:
    """Return one copy of a limb, rotated, with the suffix on its names; in a body with copies of
    its own it is not rotated.
    """
    if limb.ending != "distance" and (limb.length or limb.actuated or limb.cones):
        raise MechanismError(
            f"limb {limb.name!r} ends {limb.ending} and states a length, drive or cone of a rod; "
            "state ending: distance, or leave it out"
        )
    if limb.ending == "distance" and not limb.actuated and not limb.length > 0:
        raise MechanismError(
            f"limb {limb.name!r} ends in a rod that no drive moves, of length {limb.length:g} m; "
            "it needs a positive `length:`"
        )
    steps: list[JointPlacement] = []
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
                f"limb {limb.name!r} has a joint {limb.to!r}, like the body on which it ends; "
                "rename the joint"
            )
    placed = place_limb(
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
    return placed._replace(limb=replace(placed.limb, on=on, to=to))


def _place_joint(record: JointRecord, name: str, suffix: str) -> list[JointPlacement]:
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
        axes = [axis_vector(axis) for axis in record.axes] if is_universal else [EZ, EY, EX]
    places = [matrix_from_place(record.at), np.eye(4), np.eye(4)]
    return [JointPlacement(*step) for step in zip(joints, places, axes, strict=False)]


def _shifts(limb: PlacedLimb, entry: Shifts) -> ErrorModel:
    """Return the unknown lengths of a limb."""
    sd, errors = standard_deviation(entry.tolerance, f"{limb.name} {entry.of}"), []
    label = f"{limb.name}.{entry.name or entry.of}"
    for axis in entry.shift:
        if axis == "length":
            if limb.limb.ending != "distance" or entry.of != "rod":
                raise MechanismError(
                    f"{limb.name!r}: 'length' belongs to a rod; write 'of: rod' in a limb that "
                    "ends in a distance"
                )
            name = label if entry.name else f"{limb.name}.length"
            errors.append(rod_length_error(limb, name, sd))
            continue
        element = _find_element(limb, entry.of)
        place = limb.placements[element]
        nominal = (place[:3, :3].T @ place[:3, 3])["xyz".index(axis)]
        errors.append(displacement_error(f"{label}.{axis}", limb, element, axis, sd, nominal))
    return join_errors(errors)


def _tilts(limb: PlacedLimb, entry: Tilts) -> ErrorModel:
    """Return the unknown angles of a limb."""
    sd = standard_deviation(entry.tolerance, f"{limb.name} {entry.of}")
    element, tilt = (
        _find_element(limb, entry.of),
        map_slide_tilt if entry.alone else map_displacement,
    )
    names = {axis: f"{limb.name}.{entry.name or entry.of}.{axis}" for axis in entry.tilt}
    return join_errors(
        single_error(name, Dimension.ANGLE, 0.0, sd, *tilt(name, limb, element, axis))
        for axis, name in names.items()
    )


def _find_element(limb: PlacedLimb, name: str) -> str:
    """Return the link of a limb by name; a joint of several axes means its first."""
    for candidate in (name, f"{name}.1", f"{name}.turn"):
        if candidate in limb.elements:
            return candidate
    raise MechanismError(f"limb {limb.name!r} has no {name!r}; it has {', '.join(limb.elements)}")


def _named(named: NamedParameter, members: Members, drives: Drives) -> ErrorModel:
    """Return a named parameter with its maps."""
    dimension, nominal = get_quantity(named)
    sd = standard_deviation(named.tolerance, named.name)
    maps = [m for entry in named.maps for m in _map_entry(named, entry, members, drives)]
    is_positive = is_always_positive(named)
    return single_error(named.name, dimension, nominal, sd, *maps, positive=is_positive)


def _map_entry(
    named: NamedParameter, entry: MapEntry, members: Members, drives: Drives
) -> Iterator[LinearMap]:
    """Yield the maps of one entry, for every copy that it means."""
    name, (axis, coefficient) = named.name, find_engine_axis(named.name, entry)
    check_units(named, entry, drives.get(entry.limb))
    # a limb and a drive may have one name; only a limb has links with axes
    if entry.limb in drives and axis not in AXES:
        yield LinearMap(name, Address(entry.limb, entry.element, axis), coefficient)
        return
    copies = [member for group in members.values() for member in group]
    chosen = members.get(entry.limb) or [m for m in copies if m.placed.name == entry.limb]
    if not chosen:
        raise MechanismError(
            f"parameter {name!r} is mapped onto {entry.limb!r}, which is not there; known are "
            f"{', '.join((*members, *sorted(drives)))}"
        )
    for limb in (member.placed for member in chosen):
        if axis in AXES:
            element = _find_element(limb, entry.element)
            yield from map_displacement(name, limb, element, axis, coefficient)
        else:
            yield LinearMap(name, Address(limb.name, entry.element, axis), coefficient)
