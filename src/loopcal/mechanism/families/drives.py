# SPDX-License-Identifier: Apache-2.0
"""Drives of robot files: what the reading of an actuator makes of its joint, in all families.

A family places its limbs and names the drives of their joints. What `drives:` of the file states of
them is read, checked and made an actuator with its unknowns here. Formula and terms:
mechanism/transmission.py. How to write it: docs/robots.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np

from loopcal.errors import suggest_names
from loopcal.mechanism.assembly import AXES, FORCES, Actuator, Address, Joint, Limb, LinearMap, Load
from loopcal.mechanism.families.placement import (
    AngleTolerance,
    ErrorModel,
    ErrorTolerances,
    LengthTolerance,
    PlacedLimb,
    Point,
    RatioTolerance,
    RecordError,
    join_errors,
    offset_error,
    single_error,
    standard_deviation,
)
from loopcal.mechanism.transmission import (
    HARMONICS,
    LOAD,
    TABLE,
    TRIANGLE_TERMS,
    compute_range,
    count_independent,
    evaluate_sums,
    find_side,
    list_constants,
    nominal_terms,
)
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Length, Ratio

# Records. Those that differ in a dimension only are classes of their own, because the reader of
# files takes the unit of a number from its annotation.


ON_AXIS = 1e-9
"""Distance of an anchor from the axis, as a share of the larger one, that is no lever."""
DEAD = 1e-6
"""Sine of the angle from a dead point, below which the actuator does not turn the joint."""
MOST_POINTS = 200
"""Rows of a table."""
POINTS, SKEW = ("foot", "head"), "skew"


class DriveError(RecordError):
    """An impossible drive; `name` is the one under which a file states it."""

    def __init__(self, sentence: str, name: str) -> None:
        super().__init__(sentence, "drives", name)


class CouplingError(RecordError):
    """An impossible coupling; `name` is the one under which a file states it."""

    def __init__(self, sentence: str, name: str) -> None:
        super().__init__(sentence, "couplings", name)


class StrokeError(DriveError):
    """Strokes of triangle drives with lengths of no angle; `strokes` has their sentences."""

    def __init__(self, strokes: Mapping[str, str]) -> None:
        what = "strokes" if len(strokes) > 1 else "stroke"
        sentence = "; ".join([*strokes.values(), f"correct the {what} or the anchors"])
        super().__init__(sentence, next(iter(strokes)))
        self.strokes = strokes


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


@dataclass(frozen=True, kw_only=True)
class ReadsLength:
    """A drive whose reading is a length; `period` is the reading per turn of the harmonics, `sigma`
    its standard deviation.
    """

    reads: Literal["length"]
    stroke: tuple[Length, Length] | None = None
    period: Length = 0.0
    sigma: Length | None = None


@dataclass(frozen=True, kw_only=True)
class ReadsAngle:
    """A drive whose reading is an angle; keys as those of a length."""

    reads: Literal["angle"]
    stroke: tuple[Angle, Angle] | None = None
    period: Angle = 0.0
    sigma: Angle | None = None


@dataclass(frozen=True, kw_only=True)
class GivesLength:
    """The known terms of a drive of a slide or rod, and what of it is to be identified.

    joint value = offset + scale * reading + curve * (reading / reach)^2 + harmonics of the period +
    backlash * direction / 2 + compliance * load, where reach is the end of the stroke that is
    farther from zero, and the load is the force [N] that lengthens the drive. `unknown` names terms
    to identify, with the tolerance `length`, that of the compliance is `compliances`.
    """

    offset: Length = 0.0
    curve: Length = 0.0
    backlash: Length = 0.0
    sin1: Length = 0.0
    cos1: Length = 0.0
    sin2: Length = 0.0
    cos2: Length = 0.0
    compliance: Length = 0.0
    compliances: LengthTolerance | None = None
    unknown: tuple[str, ...] = ()
    length: LengthTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class GivesAngle:
    """The known terms of a drive of a rotary joint; keys as those of a slide, with a load in
    Nm.
    """

    offset: Angle = 0.0
    curve: Angle = 0.0
    backlash: Angle = 0.0
    sin1: Angle = 0.0
    cos1: Angle = 0.0
    sin2: Angle = 0.0
    cos2: Angle = 0.0
    compliance: Angle = 0.0
    compliances: AngleTolerance | None = None
    unknown: tuple[str, ...] = ()
    angle: AngleTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class Interpolation:
    """How a `table`, rows of a reading and a value that is added to the joint value, goes from
    point to point. Unknown values are table1, table2, .., or table for all.
    """

    interpolation: Literal["linear", "cubic"] = "linear"


@dataclass(frozen=True, kw_only=True)
class Gain:
    """The scale of a drive whose reading has the unit of its joint, with its tolerance `ratio`."""

    gain: Ratio = 1.0
    ratio: RatioTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class Sum:
    """What several joints give together: with a `sum`, the name of a driven joint -> weight, the
    transmission gives the sum of weight * joint value; unknown weights (weight.m, or weight for
    all) have the tolerance `weights`.
    """

    sum: Mapping[str, Ratio] = field(default_factory=dict)
    weights: RatioTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class LengthDrive(Interpolation, Sum, Gain, GivesLength, ReadsLength):
    """A drive of a slide or rod whose reading is a length."""

    table: tuple[tuple[Length, Length], ...] = ()


@dataclass(frozen=True, kw_only=True)
class AngleDrive(Interpolation, Sum, Gain, GivesAngle, ReadsAngle):
    """A drive of a rotary joint whose reading is an angle."""

    table: tuple[tuple[Angle, Angle], ...] = ()


@dataclass(frozen=True, kw_only=True)
class SpoolDrive(Interpolation, Sum, GivesLength, ReadsAngle):
    """A drive whose reading is an angle and moves a length.

    joint value = offset + radius * reading + buildup * reading^2 / (4 pi) + .. `radius` is the
    length paid out per radian of the reading (spool radius with gears and tackle), negative if a
    growing reading shortens; `buildup` is its growth in one turn of the reading. Their tolerances
    are `radii` and `buildups`.
    """

    radius: Length
    buildup: Length = 0.0
    radii: LengthTolerance | None = None
    buildups: LengthTolerance | None = None
    table: tuple[tuple[Angle, Length], ...] = ()


@dataclass(frozen=True, kw_only=True)
class ScrewDrive(Interpolation, Sum, GivesLength, ReadsAngle):
    """A screw whose reading is its angle: it moves by `lead` in one turn, negative for a left-hand
    one, with the tolerance `leads`.
    """

    lead: Length
    leads: LengthTolerance | None = None
    table: tuple[tuple[Angle, Length], ...] = ()


@dataclass(frozen=True, kw_only=True)
class TriangleDrive(Interpolation, Gain, GivesLength, ReadsLength):
    """A linear actuator that turns a revolute joint through two anchors.

    The distance of the anchors is what a length drive gives. `unknown` may also name dimensions of
    the triangle (foot.x, head.z, skew.rx; or foot, head and skew for all of one), with the
    tolerances `length` and `angle`.
    """

    reads: Literal["length"] = "length"
    triangle: Triangle
    angle: AngleTolerance | None = None
    table: tuple[tuple[Length, Length], ...] = ()


@dataclass(frozen=True, kw_only=True)
class NamedTriangleDrive(TriangleDrive):
    """A triangle drive of a serial joint, with the name of its actuator."""

    name: str = ""


Drive = LengthDrive | AngleDrive | SpoolDrive | ScrewDrive | TriangleDrive


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A column of the data that is never commanded: `temperature`, `temperature.PLACE` [degC],
    `time` [s], or of the load `force.AXIS` [N], `moment.AXIS` [Nm]. Where none is given it has its
    `reference`; simulations draw it from its `range`.
    """

    reference: Ratio = 0.0
    range: tuple[Ratio, Ratio] | None = None


@dataclass(frozen=True, kw_only=True)
class LoadFrame:
    """Where the load of `conditions:` acts: in `axes` of the base or of the platform, at a point
    `at` of the platform.
    """

    axes: Literal["base", "platform"] = "base"
    at: Point = (0.0, 0.0, 0.0)

    def place(self, stated: Mapping[str, Condition]) -> Load:
        """Return the load of stated conditions."""
        own = {name: stated[name] for name in FORCES if name in stated}
        wrench = tuple(own[name].reference if name in own else 0.0 for name in FORCES)
        ranges = {name: of.range for name, of in own.items() if of.range is not None}
        return Load(wrench, ranges, tuple(own), self.axes == "platform", self.at)


@dataclass(frozen=True, kw_only=True)
class AngleCoupling(Sum):
    """Gears, a belt or a differential between rotary joints: the sum of weight * joint value is
    the `offset`. Joints are drives, or passive joints `limb.joint`; `unknown` names weights and
    offset. With a `condition` it is offset + slope * (condition - reference), the slope in units
    of the sum per degC or second.
    """

    of: Literal["angle"] = "angle"
    offset: Angle = 0.0
    condition: str = ""
    slope: Angle = 0.0
    unknown: tuple[str, ...] = ()
    angle: AngleTolerance | None = None
    slopes: AngleTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class LengthCoupling(Sum):
    """A coupling of slides, and of rotary joints by a `radius` (joint -> length per radian), as of
    a pinion on a rack. Unknown radii have the tolerance `radii`.
    """

    of: Literal["length"]
    radius: Mapping[str, Length] = field(default_factory=dict)
    offset: Length = 0.0
    condition: str = ""
    slope: Length = 0.0
    unknown: tuple[str, ...] = ()
    length: LengthTolerance | None = None
    slopes: LengthTolerance | None = None
    radii: LengthTolerance | None = None


Coupling = AngleCoupling | LengthCoupling


# Drives at their joints: actuators, and their unknowns.

CURVE_OF_BUILDUP = 1 / (4 * np.pi)
"""Term `curve` per build-up: radius + buildup * reading / (2 pi), integrated."""

Tolerance = LengthTolerance | AngleTolerance | RatioTolerance | None
Term = tuple[Dimension, float, Tolerance, str, float]
"""Dimension, nominal value, tolerance, transmission term, and change of that term per unit."""


@dataclass(frozen=True, eq=False)
class DrivenJoint:
    """A joint or rod under the name of its drive.

    stated : this name as the file states it, without the number of a copy. limb : its limb.
    turns : whether it is rotary. rotation : (3, 3) R_placed_joint, whose third column is its axis.
    start : its value near home [rad or m]. is_passive : as of `Joint`.
    """

    name: str
    stated: str
    limb: str
    turns: bool
    rotation: FloatArray
    start: float
    is_passive: bool = False


@dataclass(frozen=True, eq=False)
class PlacedDrive:
    """A drive and the joint that it moves; of several joints, the first.

    turns, rotation, start : as in `DrivenJoint`. own : the actuator of the family, which gives the
    joint from what the drive gives: offset + gain * that; it states what the drive does not.
    weights : of the driven joints in a sum, by name.
    """

    drive: Drive
    turns: bool
    rotation: FloatArray
    start: float
    own: Actuator
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def dimension(self) -> Dimension:
        """Dimension of what the transmission gives: the joint, or the length of a triangle."""
        is_angle = self.turns and not isinstance(self.drive, TriangleDrive)
        return Dimension.ANGLE if is_angle else Dimension.LENGTH

    @property
    def stroke(self) -> tuple[float, float] | None:
        """Allowed readings, the family's if the drive states none and has readings like them."""
        return self.drive.stroke or (self.own.stroke if self._is_like_own else None)

    @property
    def sense(self) -> float:
        """What the joint value changes per unit of what the drive gives."""
        return self.own.terms.get("gain", 1.0)

    @property
    def reading(self) -> Dimension:
        """Dimension of the reading."""
        return Dimension(self.drive.reads)

    @property
    def load(self) -> Actuator | None:
        """The load as a reading, where a compliance is stated or unknown."""
        is_elastic = self.drive.compliance or "compliance" in self.drive.unknown
        load = Actuator(LOAD + self.own.name, self._load, reference=0.0)
        return load if is_elastic else None

    @property
    def _load(self) -> Dimension:
        return Dimension.MOMENT if self.dimension is Dimension.ANGLE else Dimension.FORCE

    @property
    def _is_like_own(self) -> bool:
        return self.own.dimension is self.reading

    @property
    def law(self) -> dict[str, float]:
        """Terms of the transmission but those of a triangle."""
        terms = {"offset": self.own.terms.get("offset", 0.0)}
        for _, value, _, term, coefficient in self.list_terms().values():
            if value or term == "gain":
                terms[term] = terms.get(term, 0.0) + self.sense * coefficient * value
        return terms

    @property
    def actuator(self) -> Actuator:
        """The actuator; raises MechanismError for an impossible triangle."""
        drive, name = self.drive, self.own.name
        terms: Mapping[str, float] = self.law
        if isinstance(drive, TriangleDrive):
            terms = {**terms, **place_triangle(name, drive, self.rotation, self.start)}
        points = tuple(reading for reading, _ in drive.table)
        sigma = drive.sigma or (self.own.sigma if self._is_like_own else None)
        return Actuator(
            name,
            self.reading,
            self.stroke,
            terms,
            drive.period,
            sigma,
            self.weights or ({name: 1.0} if self.load else {}),
            points,
            drive.interpolation,
        )

    def list_terms(self) -> Mapping[str, Term]:
        """Return the terms of the drive by the names that a file gives them."""
        drive, ratio, length = self.drive, Dimension.RATIO, Dimension.LENGTH
        tolerance = drive.angle if isinstance(drive, AngleDrive) else drive.length
        own = self.dimension
        terms: dict[str, Term] = {"offset": (own, drive.offset, tolerance, "offset", 1.0)}
        if isinstance(drive, SpoolDrive):
            terms["radius"] = (length, drive.radius, drive.radii, "gain", 1.0)
            terms["buildup"] = (length, drive.buildup, drive.buildups, "curve", CURVE_OF_BUILDUP)
        elif isinstance(drive, ScrewDrive):
            terms["lead"] = (length, drive.lead, drive.leads, "gain", 1 / (2 * np.pi))
        else:
            terms["gain"] = (ratio, drive.gain, drive.ratio, "gain", 1.0)
        reach = max(map(abs, self.stroke or (0.0,)))
        for term in ("curve", "backlash", *HARMONICS):
            coefficient = 1.0
            if term == "curve":  # without a stroke it is refused where it is stated
                coefficient = 1 / reach**2 if 0.0 < reach < np.inf else np.nan
            terms[term] = (own, getattr(drive, term), tolerance, term, coefficient)
        terms["compliance"] = (
            *(own.per(self._load), drive.compliance, drive.compliances),
            *("compliance", 1 / self.sense),  # of the joint, whatever moves it
        )
        for k, (_, value) in enumerate(drive.table, 1):
            terms[f"{TABLE}{k}"] = (own, value, tolerance, f"{TABLE}{k}", 1.0)
        return terms


@dataclass(frozen=True, eq=False)
class PlacedCoupling:
    """A coupling of joints by their drives; weights in m and rad. reference : of its condition."""

    name: str
    drive: Coupling
    weights: Mapping[str, float]
    reference: float = 0.0
    sense: ClassVar[float] = 1.0

    @property
    def dimension(self) -> Dimension:
        """Dimension of the sum."""
        return Dimension(self.drive.of)

    @property
    def actuator(self) -> Actuator:
        """The row of joints, whose only reading is a condition."""
        slope = self.drive.slope
        terms = {"offset": self.drive.offset - slope * self.reference, "gain": slope}
        column = self.drive.condition
        return Actuator(self.name, self.dimension, None, terms, weights=self.weights, column=column)


def get_condition_dimension(name: str) -> Dimension:
    """Return the dimension of a condition by its name."""
    return Dimension.TIME if name == Dimension.TIME.value else Dimension.TEMPERATURE


def list_conditions(stated: Mapping[str, Condition]) -> Iterator[Actuator]:
    """Yield conditions of a file, but those of the load, as readings."""
    for name, condition in stated.items():
        dimension = get_condition_dimension(name)
        if dimension.value != name.partition(".")[0]:
            raise RecordError(
                f"the condition {name!r} is not a column of times, temperatures or loads. Call it "
                f"temperature, temperature.PLACE, time, or one of {', '.join(FORCES)}",
                "conditions",
                name,
            )
        yield Actuator(name, dimension, condition.range, reference=condition.reference)


def couple_joints(
    limbs: Iterable[PlacedLimb],
    drives: Mapping[str, Drive],
    stated: Mapping[str, Coupling],
    conditions: Mapping[str, Condition],
) -> tuple[tuple[PlacedLimb, ...], tuple[PlacedCoupling, ...]]:
    """Return the couplings of a file, and its limbs with `limb.joint` as the drive of each passive
    joint that a coupling, or the sum of a drive, names.

    A coupling of limbs that are copied is one for each copy. Raises MechanismError: unknown joints,
    and couplings of unlike ones.
    """
    limbs = tuple(limbs)
    known, turning = dict[str, list[str]](), dict[str, bool]()
    for limb in limbs:
        copy = limb.name.removeprefix(limb.stem)
        for joint in limb.limb.joints:
            name = joint.actuator or f"{limb.name}.{joint.name}"
            turning[name] = joint.kind == "R"
            for alias in (f"{limb.name}.{joint.name}", f"{limb.stem}.{joint.name}"):
                known.setdefault(alias, []).append(name)
            for alias in {name, name.removesuffix(copy)} if joint.actuator else ():
                known.setdefault(alias, []).append(name)
        if limb.limb.actuator:
            name, turning[limb.limb.actuator] = limb.limb.actuator, False
            for alias in {name, name.removesuffix(copy)}:
                known.setdefault(alias, []).append(name)
    known = {alias: list(dict.fromkeys(names)) for alias, names in known.items()}
    couplings: list[PlacedCoupling] = []
    for key, coupling in stated.items():
        name = coupling.condition
        if name in FORCES:
            raise CouplingError(
                f"coupling {key!r} names {name!r}, but a load acts through drives; state the "
                "`compliance:` of a drive",
                key,
            )
        if name and name not in conditions:
            raise CouplingError(
                f"coupling {key!r} names the condition {name!r}, which the file does not state"
                f"{suggest_names(name, list(conditions))}. Add it to `conditions:`",
                key,
            )
        reference = conditions[name].reference if name else 0.0
        couplings += _place_coupling(key, coupling, known, turning, reference)
    for name in conditions:
        if all(coupling.condition != name for coupling in stated.values()):
            raise RecordError(
                f"the condition {name!r} is in no coupling. Name it there, or leave it out",
                "conditions",
                name,
            )
    used = {joint for coupling in couplings for joint in coupling.weights}
    used |= {joint for drive in drives.values() for joint in getattr(drive, "sum", ())}

    def name_passive(limb: Limb, joint: Joint) -> Joint:
        own = f"{limb.name}.{joint.name}"
        is_coupled = not joint.actuator and own in used
        return replace(joint, actuator=own, is_passive=True) if is_coupled else joint

    placed = [
        limb._replace(limb=replace(own, joints=tuple(name_passive(own, j) for j in own.joints)))
        for limb in limbs
        for own in [limb.limb]
    ]
    return tuple(placed), tuple(couplings)


def _place_coupling(
    key: str,
    coupling: Coupling,
    known: Mapping[str, Sequence[str]],
    turning: Mapping[str, bool],
    reference: float,
) -> Iterator[PlacedCoupling]:
    """Yield a coupling, or those of all copies. known : alias -> names of driven joints."""
    radius: Mapping[str, float] = getattr(coupling, "radius", {})
    weights = {**coupling.sum, **radius}
    for alias in coupling.sum:
        if alias in radius:
            raise CouplingError(
                f"coupling {key!r} has {alias!r} under both `sum:` and `radius:`. List it once", key
            )
    for alias, weight in weights.items():
        if alias not in known:
            raise CouplingError(
                f"coupling {key!r} names {alias!r}, which is neither a drive nor a joint of a limb"
                f"{suggest_names(alias, list(known))}. Write limb.joint or the name of a drive",
                key,
            )
        is_angle = coupling.of == "angle" or alias not in coupling.sum
        if turning[known[alias][0]] != is_angle:
            raise CouplingError(
                f"coupling {key!r} adds {'angles' if is_angle else 'lengths'}, but {alias!r} "
                + ("slides. Give `of: length`" if is_angle else "turns. List it under `radius:`"),
                key,
            )
        if not np.isfinite(weight):
            raise CouplingError(
                f"the weight of {alias!r} in coupling {key!r} is {weight:g}. Give a finite number",
                key,
            )
    if not any(weights.values()):
        raise CouplingError(
            f"coupling {key!r} has no weight other than 0, so it couples nothing. Give one", key
        )
    counts = {len(known[alias]) for alias in weights} - {1}
    if len(counts) > 1:
        raise CouplingError(
            f"coupling {key!r} names joints of limbs with {' and '.join(map(str, sorted(counts)))} "
            "copies. Name single copies",
            key,
        )
    count = counts.pop() if counts else 0
    for i in range(max(count, 1)):
        name = f"{key}{i + 1}" if count else key
        own = {known[a][i if len(known[a]) > 1 else 0]: w for a, w in weights.items()}
        yield PlacedCoupling(name, coupling, own, reference)


def coupling_errors(placed: PlacedCoupling) -> ErrorModel:
    """Return the unknown offset, weights and radii of a coupling, as `gear.weight.arm.pin`."""
    name, coupling = placed.name, placed.drive
    of_radii = getattr(coupling, "radius", {})
    own = dict(zip({**coupling.sum, **of_radii}, placed.weights, strict=True))
    spread = coupling.angle if isinstance(coupling, AngleCoupling) else coupling.length
    terms: dict[str, tuple[Dimension, float, Tolerance, str]]
    terms = {"offset": (placed.dimension, coupling.offset, spread, "offset")}
    if coupling.condition:
        per = placed.dimension.per(get_condition_dimension(coupling.condition))
        terms["slope"] = per, coupling.slope, coupling.slopes, "gain"
    for key, joints, dimension, tolerance in (
        (WEIGHT, coupling.sum, Dimension.RATIO, coupling.weights),
        ("radius", of_radii, Dimension.LENGTH, getattr(coupling, "radii", None)),
    ):
        for alias, weight in joints.items():
            terms[f"{key}.{alias}"] = dimension, weight, tolerance, f"{WEIGHT}.{own[alias]}"
    errors = []
    for stated in coupling.unknown:
        chosen = [term for term in terms if stated in (term, term.partition(".")[0])]
        if not chosen:
            hint = f"{suggest_names(stated, list(terms))}. Allowed: {', '.join(terms)}"
            raise CouplingError(f"coupling {name!r} has no term {stated!r}{hint}", name)
        for term in chosen:
            dimension, nominal, tolerance, axis = terms[term]
            parameter = f"{name}.{term}"
            sd = standard_deviation(tolerance, parameter)
            maps = [LinearMap(parameter, Address(name, "transmission", axis))]
            if axis == "gain":  # the slope turns about the reference
                offset = Address(name, "transmission", "offset")
                maps.append(LinearMap(parameter, offset, -placed.reference))
            errors.append(single_error(parameter, dimension, nominal, sd, *maps))
    return join_errors(errors)


def list_driven_joints(limb: PlacedLimb) -> Iterator[DrivenJoint]:
    """Yield the driven joints of a limb, the rod last."""
    placed, suffix = limb.limb, limb.name.removeprefix(limb.stem)
    for j in placed.joints:
        if j.actuator:
            stated, turn = j.actuator.removesuffix(suffix), limb.rotations[j.name]
            turns = j.kind == "R"
            yield DrivenJoint(j.actuator, stated, placed.name, turns, turn, j.start, j.is_passive)
    if placed.actuator:
        stated = placed.actuator.removesuffix(suffix)
        yield DrivenJoint(placed.actuator, stated, placed.name, False, np.eye(3), 0.0)


def place_drives(
    limbs: Iterable[PlacedLimb],
    stated: Mapping[str, Drive],
    own: Iterable[Actuator] = (),
    couplings: Iterable[PlacedCoupling] = (),
) -> dict[str, PlacedDrive]:
    """Return the drives by name, in the order of the readings, with their joints.

    A drive that several limbs name is one drive. stated : the drives of the file; one that is not
    listed reads the joint itself. own : what the family knows of its drives. couplings : of
    `couple_joints`.
    Raises MechanismError: a drive without a joint, or of another kind than its joint.
    """
    joints: dict[str, DrivenJoint] = {}
    for joint in (joint for limb in limbs for joint in list_driven_joints(limb)):
        joints.setdefault(joint.name, joint)
    known, drives = {actuator.name: actuator for actuator in own}, dict[str, PlacedDrive]()
    rows = {coupling.name: coupling.weights for coupling in couplings}
    limb_of = {name: joint.limb for name, joint in joints.items()}

    def place(name: str, drive: Drive | None, joint: DrivenJoint) -> PlacedDrive:
        plain = AngleDrive(reads="angle") if joint.turns else LengthDrive(reads="length")
        drive = drive or plain
        check_motion(name, drive, joint.turns)
        base = known.get(name) or Actuator(name, Dimension(drive.reads))
        return _check_terms(PlacedDrive(drive, joint.turns, joint.rotation, joint.start, base))

    if has_sums(stated):
        named = {name: joint.stated for name, joint in joints.items()}
        turning = {name: joint.turns for name, joint in joints.items()}
        readings = list_readings(stated, named)
        for name, (_, weights) in readings.items():
            _check_sum(name, weights, turning)
        check_rows({**{name: w for name, (_, w) in readings.items()}, **rows}, limb_of)
        for name, (key, weights) in readings.items():
            own_joint = tuple(weights) == (name,) and weights[name] == 1.0
            placed = place(name, stated[key], joints[next(iter(weights))])
            drives[name] = replace(placed, weights={} if own_joint else weights)
    else:
        for name, joint in joints.items():
            if not joint.is_passive:
                drives[name] = place(name, stated.get(name) or stated.get(joint.stated), joint)
        if rows:
            check_rows({name: {name: 1.0} for name in drives} | rows, limb_of)
    if strokes := {name: words for name in drives if (words := _word_stroke(drives[name]))}:
        raise StrokeError(strokes)
    refuse_idle_drives(stated, drives, {joint.stated for joint in joints.values()})
    return drives


def _word_stroke(placed: PlacedDrive) -> str:
    """Return what of the stroke of a triangle drive no angle reaches, or nothing."""
    if not isinstance(placed.drive, TriangleDrive):
        return ""
    terms = placed.actuator.terms
    low, high = (float(end) for end in compute_range(np.array([terms[t] for t in TRIANGLE_TERMS])))
    ends = [terms["offset"] + terms["gain"] * reading for reading in placed.stroke or ()]
    outside = [f"{end * 1e3:.6g} mm" for end in ends if np.isfinite(end) and not low <= end <= high]
    if not outside:
        return ""
    return (
        f"the stroke of actuator {placed.own.name!r} contains the length {' and '.join(outside)}, "
        f"which no angle of its joint reaches: the anchors are {low * 1e3:.6g} to "
        f"{high * 1e3:.6g} mm apart"
    )


def refuse_idle_drives(
    stated: Iterable[str], used: Iterable[str], groups: Iterable[str] = ()
) -> None:
    """Refuse a stated drive that is none of those used, nor a name of several (RecordError)."""
    used, known = tuple(used), {*used, *groups}
    for name in stated:
        if name not in known:
            raise DriveError(
                f"actuator {name!r} drives no joint{suggest_names(name, sorted(known))}. Write "
                f"'actuated: {name}' at one, or leave it out"
                + (f"; joints are driven by {', '.join(used)}" if used else ""),
                name,
            )


def _check_terms(placed: PlacedDrive) -> PlacedDrive:
    """Return a drive; refuse a term that is stated or unknown and cannot be."""
    drive, name = placed.drive, placed.own.name
    stated = {term for term in ("curve", *HARMONICS) if getattr(drive, term)} | {*drive.unknown}
    for term in HARMONICS:
        if term in stated and not drive.period:
            raise DriveError(
                f"actuator {name!r} states {term}, but no period. Give the reading's period", name
            )
    if "curve" in stated and not np.isfinite(placed.list_terms()["curve"][-1]):
        raise DriveError(
            f"actuator {name!r} states a curve, the deviation at the far end of its stroke, but no "
            "stroke. Give the stroke",
            name,
        )
    if drive.compliance < 0.0:
        raise DriveError(f"the compliance of actuator {name!r} is negative; state its size", name)
    if "compliance" in drive.unknown and drive.compliances is None:
        raise DriveError(
            f"the compliance of actuator {name!r} is unknown; state `compliances:`, the tolerance "
            "of its stated value",
            name,
        )
    if drive.table:
        _check_table(placed)
    return placed


def _check_table(placed: PlacedDrive) -> None:
    """Refuse a table of one point, out of order, or with which a reading has two joint values."""
    name, points = placed.own.name, np.array([reading for reading, _ in placed.drive.table])
    if not 2 <= len(points) <= MOST_POINTS or not (np.diff(points) > 0.0).all():
        raise DriveError(
            f"the table of actuator {name!r} has {len(points)} points. Give 2 to {MOST_POINTS} "
            "rows [reading, value], the readings growing",
            name,
        )
    share = np.linspace(0.0, 1.0, 9)[:-1]
    own = [replace(placed.actuator, terms=placed.law)]
    readings = np.append(points[:-1, None] + share * np.diff(points)[:, None], points[-1])
    values = evaluate_sums(readings[None, :, None], nominal_terms(own)[None], list_constants(own))
    steps = np.diff(values[0, :, 0])
    if not ((steps > 0.0).all() or (steps < 0.0).all()):
        raise DriveError(
            f"the table of actuator {name!r} turns its joint back, so two readings have one "
            "joint value. Correct a value, or give the gain",
            name,
        )


def drive_errors(placed: PlacedDrive) -> ErrorModel:
    """Return the unknown terms of a drive, `q1.offset` ..; MechanismError for impossible ones."""
    drive, name, known = placed.drive, placed.own.name, placed.list_terms()
    errors = [weight_errors(name, drive, placed.weights, tuple(known))]
    if isinstance(drive, TriangleDrive):
        errors.insert(0, triangle_errors(name, drive, placed.rotation, tuple(known)))
    whole = {TABLE: [f"{TABLE}{k + 1}" for k in range(len(drive.table))]} if drive.table else {}
    for term in (part for stated in drive.unknown for part in whole.get(stated, [stated])):
        if is_of_triangle(drive, term) or is_weight(placed.weights, term):
            continue
        if term not in known:
            raise _refuse_term(name, term, tuple(known))
        errors.append(_term_error(placed, term))
    return join_errors(errors)


def _refuse_term(name: str, term: str, allowed: tuple[str, ...]) -> DriveError:
    """Return the error of a drive that has no such term."""
    hint = f"{suggest_names(term, allowed)}. Allowed: {', '.join(allowed)}"
    return DriveError(f"actuator {name!r} has no term {term!r}{hint}", name)


def _term_error(placed: PlacedDrive, term: str) -> ErrorModel:
    """Return a term of a drive as a parameter."""
    name = placed.own.name
    dimension, nominal, tolerance, axis, coefficient = placed.list_terms()[term]
    parameter, address = f"{name}.{term}", Address(name, "transmission", axis)
    sd = standard_deviation(tolerance, parameter)
    entry = LinearMap(parameter, address, placed.sense * coefficient)
    is_scale = axis == "gain"
    return single_error(parameter, dimension, nominal, sd, entry, positive=is_scale)


def check_motion(name: str, drive: Drive, turns: bool) -> None:
    """Refuse a drive whose transmission does not give what its joint does (MechanismError)."""
    if turns == isinstance(drive, AngleDrive | TriangleDrive):
        return
    motion, allowed = (
        ("turns", "reads: angle without a radius, or a triangle")
        if turns
        else ("slides", "reads: length, or reads: angle with a radius")
    )
    raise DriveError(f"actuator {name!r} drives a joint that {motion}. Give {allowed}", name)


def complete_drives(
    drives: Mapping[str, PlacedDrive], couplings: Iterable[PlacedCoupling], spread: ErrorTolerances
) -> ErrorModel:
    """Return the offsets of drives and couplings and dimensions of triangles as parameters."""
    errors = [
        offset_error(f"{c.name}.offset", c.name, d, c.drive.offset, spread.select(d))
        for c in couplings
        for d in [c.dimension]
    ]
    for name, placed in drives.items():
        tolerance = spread.select(placed.dimension)
        errors.append(
            offset_error(f"{name}.offset", name, placed.dimension, placed.drive.offset, tolerance)
        )
        if isinstance(placed.drive, TriangleDrive):
            lengths = LengthTolerance(sd=spread.length) if spread.length else None
            errors.append(complete_triangle(name, placed.drive, placed.rotation, lengths))
    return join_errors(errors)


# Triangles: a linear actuator between two anchors beside a rotary joint.


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
        raise DriveError(
            f"the triangle of actuator {name!r} is degenerate: an anchor is on the axis of the "
            "joint, so the length is the same at every angle. Give anchors away from the axis",
            name,
        )
    sine, middle = find_side(start, terms)
    if abs(sine) < DEAD:
        raise DriveError(
            f"actuator {name!r} does not turn its joint at {np.rad2deg(start):g} deg, a dead point "
            "of its triangle, where both anchors and the axis are in one plane. Give another "
            "`start:` of the joint, or other anchors",
            name,
        )
    terms[-2:] = np.sign(sine), middle
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
            raise _refuse_term(name, term, (*other, *POINTS, SKEW, *known))
        part, _, axis = term.partition(".")
        direction = np.eye(3)[AXES.index(axis) % 3]
        components = rotation.T @ direction
        is_skew, parameter = part == SKEW, f"{name}.{term}"
        if is_skew and np.linalg.norm(components[:2]) < ON_AXIS:
            raise DriveError(
                f"{parameter} rotates the triangle about the joint's own axis, which changes no "
                "length. Leave it out",
                name,
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
    changes its lever most: see docs/theory/kinematics.md. Arguments are as above.
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


# Drives of `limbs` files whose readings are sums of joint values: `sum: {m: 1, n: 2}`.

WEIGHT = "weight"


def has_sums(actuators: Mapping[str, object]) -> bool:
    """Return whether a drive of a file is a sum."""
    return any(getattr(drive, "sum", None) for drive in actuators.values())


def list_readings(
    actuators: Mapping[str, object], joints: Mapping[str, str]
) -> dict[str, tuple[str, Mapping[str, float]]]:
    """Return the readings of a file with sums: name -> (key in the file, weights of joints), of
    driven joints by name, each with the name that the file states.

    Raises DriveError: a triangle drive, or a drive that is no sum and moves no joint.
    """
    readings: dict[str, tuple[str, Mapping[str, float]]] = {}
    for key, drive in actuators.items():
        weights: Mapping[str, float] | None = getattr(drive, "sum", None)
        if weights is None:
            raise DriveError(
                f"actuator {key!r} is a triangle drive together with sums. Let it drive a "
                f"stage of its "
                "own in a file of the family stages",
                key,
            )
        if weights:
            readings[key] = key, weights
            continue
        own = [name for name, stated in joints.items() if key in (name, stated)]
        if not own:
            raise DriveError(
                f"actuator {key!r} drives no joint and has no `sum:`. Write 'actuated: {key}' "
                f"at a joint, or the sum that it reads of {', '.join(joints)}",
                key,
            )
        readings |= {name: (key, {name: 1.0}) for name in own}
    return readings


def check_rows(sums: Mapping[str, Mapping[str, float]], known: Mapping[str, str]) -> None:
    """Refuse sums, readings and couplings by name with the weights of their joints, that leave a
    driven joint out or repeat each other. known : driven joint -> its limb.
    """
    read = {joint for weights in sums.values() for joint, w in weights.items() if w != 0.0}
    unread = [joint for joint in known if joint not in read]
    if unread:
        raise DriveError(
            f"joint {unread[0]!r} of limb {known[unread[0]]!r} is in no sum, so no reading states "
            f"it. Add it to a `sum:`, or list {unread[0]!r} among the actuators",
            next(iter(sums)),
        )
    W = np.array([[weights.get(joint, 0.0) for joint in known] for weights in sums.values()])
    a, joints = W.shape
    if a > joints:
        raise DriveError(
            f"{a} readings ({', '.join(sums)}) are sums of {joints} joints "
            f"({', '.join(known)}). Leave out readings",
            list(sums)[-1],
        )
    for i in range(a):
        if count_independent(W[: i + 1]) <= i:
            name = list(sums)[i]
            raise DriveError(
                f"the weights of the sums are singular: that of actuator {name!r} follows from "
                f"those of {', '.join(list(sums)[:i])}, so it states nothing new. Correct a weight",
                name,
            )


def _check_sum(name: str, weights: Mapping[str, float], turning: Mapping[str, bool]) -> None:
    """Refuse a sum of unknown joints, of unlike joints, or without a weight."""
    for joint, weight in weights.items():
        if joint not in turning:
            raise DriveError(
                f"the sum of actuator {name!r} names {joint!r}, which no limb states under "
                f"'actuated:'{suggest_names(joint, list(turning))}. Allowed: "
                f"{', '.join(turning)}",
                name,
            )
        if not np.isfinite(weight):
            raise DriveError(
                f"the weight of {joint!r} in the sum of actuator {name!r} is {weight:g}. Give a "
                "finite number",
                name,
            )
    if not any(weights.values()):
        raise DriveError(
            f"all weights in the sum of actuator {name!r} are zero, so its reading states nothing. "
            "Give a weight other than 0",
            name,
        )
    angles = [joint for joint in weights if turning[joint]]
    lengths = [joint for joint in weights if not turning[joint]]
    if angles and lengths:
        raise DriveError(
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
    """Return the unknown weights of a sum, `q1.weight.m` ..; `other` are its other terms."""
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
            raise DriveError(
                f"actuator {name!r} has no term {WEIGHT + '.' + joint!r}. Allowed: "
                f"{', '.join(allowed)}",
                name,
            )
        parameter = f"{name}.{WEIGHT}.{joint}"
        address = Address(name, "transmission", f"{WEIGHT}.{joint}")
        sd = standard_deviation(tolerance, parameter)
        entry = LinearMap(parameter, address)
        errors.append(single_error(parameter, Dimension.RATIO, weights[joint], sd, entry))
    return join_errors(errors)
