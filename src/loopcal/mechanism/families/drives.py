# SPDX-License-Identifier: Apache-2.0
"""Drives of robot files: what the reading of an actuator makes of its joint, in all families.

A family places its limbs and names the drives of their joints. What `drives:` of the file states of
them is read, checked and made an actuator with its unknowns here. Formula and terms:
mechanism/transmission.py. How to write it: docs/robots.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import suggest_names
from loopcal.mechanism.assembly import AXES, FORCES, Actuator, Address, Joint, Limb, LinearMap, Load
from loopcal.mechanism.families import placement
from loopcal.mechanism.transmission import (
    HARMONICS,
    LOAD,
    TABLE,
    WEIGHT,
    Transmissions,
    complete_triangle,
    compute_range,
    count_independent,
    describe_triangle,
    list_constants,
    nominal_terms,
)
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Given, Length, Ratio, Reading

# Records. The reader of files takes the unit of a number from its annotation.


# Distance of an anchor from the axis, as a share of the larger one, that is no lever.
ON_AXIS = 1e-9
DEAD = 1e-6  # sine of the angle from a dead point, below which the actuator does not turn the joint
MOST_POINTS = 200  # rows of a table
SKEW = "skew"


class RowRecord:
    """A drive or coupling: the section of the file that lists it, and what messages call it."""

    SECTION: ClassVar[str] = "drives"
    WORD: ClassVar[str] = "actuator"

    @classmethod
    def refuse(cls, name: str, sentence: str) -> placement.RecordError:
        """Return the error of an impossible one; the sentence begins behind its name."""
        return placement.RecordError(f"{cls.WORD} {name!r} {sentence}", cls.SECTION, name)


class StrokeError(placement.RecordError):
    """Strokes of triangle drives with lengths of no angle; `strokes` has their sentences."""

    def __init__(self, strokes: Mapping[str, str]) -> None:
        what = "strokes" if len(strokes) > 1 else "stroke"
        sentence = "; ".join([*strokes.values(), f"correct the {what} or the anchors"])
        super().__init__(sentence, "drives", next(iter(strokes)))
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

    foot: placement.Point
    head: placement.Point
    skew: Skew = field(default_factory=Skew)


@dataclass(frozen=True, kw_only=True)
class DriveRecord(RowRecord):
    """What every drive can state: its reading, with `stroke`, `period` per turn of the harmonics
    and standard deviation `sigma`; the known terms of what it gives, and which are `unknown`.

    joint value = offset + scale * reading + curve * (reading / reach)^2 + harmonics of the period +
    backlash * direction / 2 + compliance * load + table, where reach is the end of the stroke that
    is farther from zero, and the load is the force [N] that lengthens the drive, or the moment [Nm]
    of a rotary one. Unknown terms have the expected spread `length` or `angle`, the compliance
    has `compliances`. Between the rows [reading, value] of the `table` are straight lines or
    splines (`interpolation`); its unknown values are table1, table2, .., or table for all.
    """

    READING: ClassVar[Dimension] = Dimension.LENGTH
    GIVEN: ClassVar[Dimension] = Dimension.LENGTH

    stroke: tuple[Reading, Reading] | None = None
    period: Reading = 0.0
    sigma: Reading | None = None
    offset: Given = 0.0
    curve: Given = 0.0
    backlash: Given = 0.0
    sin1: Given = 0.0
    cos1: Given = 0.0
    sin2: Given = 0.0
    cos2: Given = 0.0
    compliance: Given = 0.0
    table: tuple[tuple[Reading, Given], ...] = ()
    interpolation: Literal["linear", "cubic"] = "linear"
    unknown: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class GivesLength(DriveRecord):
    """The expected spreads of a drive that gives a length."""

    length: placement.LengthTolerance | None = None
    compliances: placement.LengthTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class Gain:
    """The scale of a drive whose reading has the unit of its joint, with its spread `ratio`."""

    gain: Ratio = 1.0
    ratio: placement.RatioTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class Sum:
    """What several joints give together: with a `sum`, the name of a driven joint -> weight, the
    transmission gives the sum of weight * joint value; unknown weights (weight.m, or weight for
    all) have the expected spread `weights`.
    """

    sum: Mapping[str, Ratio] = field(default_factory=dict)
    weights: placement.RatioTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class Radii:
    """Rotary joints in a sum of lengths: `radius`, joint -> length per radian. Unknown radii have
    the expected spread `radii`.
    """

    radius: Mapping[str, Length] = field(default_factory=dict)
    radii: placement.LengthTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class LengthDrive(Radii, Sum, Gain, GivesLength):
    """A drive of a slide or rod whose reading is a length."""

    reads: Literal["length"]


@dataclass(frozen=True, kw_only=True)
class AngleDrive(Sum, Gain, DriveRecord):
    """A drive of a rotary joint whose reading is an angle."""

    READING: ClassVar[Dimension] = Dimension.ANGLE
    GIVEN: ClassVar[Dimension] = Dimension.ANGLE

    reads: Literal["angle"]
    angle: placement.AngleTolerance | None = None
    compliances: placement.AngleTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class SpoolDrive(Sum, GivesLength):
    """A drive whose reading is an angle and moves a length.

    joint value = offset + radius * reading + buildup * reading^2 / (4 pi) + .. `radius` is the
    length paid out per radian (with gears and tackle), negative if a growing reading shortens,
    `buildup` its growth in one turn.
    """

    READING: ClassVar[Dimension] = Dimension.ANGLE

    reads: Literal["angle"]
    radius: Length
    buildup: Length = 0.0
    radii: placement.LengthTolerance | None = None
    buildups: placement.LengthTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class ScrewDrive(Radii, Sum, GivesLength):
    """A screw whose reading is its angle: it moves by `lead` in one turn, negative if left-hand."""

    READING: ClassVar[Dimension] = Dimension.ANGLE

    reads: Literal["angle"]
    lead: Length
    leads: placement.LengthTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class TriangleDrive(Gain, GivesLength):
    """A linear actuator that turns a revolute joint through two anchors.

    The distance of the anchors is what a length drive gives. `unknown` may also name dimensions of
    the triangle, such as foot.x, or foot for all of one.
    """

    reads: Literal["length"] = "length"
    triangle: Triangle
    angle: placement.AngleTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class NamedTriangleDrive(TriangleDrive):
    """A triangle drive of a serial joint, with the name of its actuator."""

    name: str = ""


Drive = LengthDrive | AngleDrive | SpoolDrive | ScrewDrive | TriangleDrive


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A data column: `temperature`, `temperature.PLACE` [degC], `time` [s], `force.AXIS` [N] or
    `moment.AXIS` [Nm]. It has its `reference` if none is given. Simulations draw from `range`.
    """

    reference: Ratio = 0.0
    range: tuple[Ratio, Ratio] | None = None


@dataclass(frozen=True, kw_only=True)
class LoadFrame:
    """Where the load of `conditions:` acts: in `axes` of the base or of the platform, at a point
    `at` of the platform.
    """

    axes: Literal["base", "platform"] = "base"
    at: placement.Point = (0.0, 0.0, 0.0)

    def place(self, stated: Mapping[str, Condition]) -> Load:
        """Return the load of stated conditions."""
        own = {name: stated[name] for name in FORCES if name in stated}
        wrench = tuple(own[name].reference if name in own else 0.0 for name in FORCES)
        ranges = {name: of.range for name, of in own.items() if of.range is not None}
        return Load(wrench, ranges, tuple(own), self.axes == "platform", self.at)


@dataclass(frozen=True, kw_only=True)
class CouplingRecord(Sum, RowRecord):
    """What every coupling can state."""

    SECTION: ClassVar[str] = "couplings"
    WORD: ClassVar[str] = "coupling"
    GIVEN: ClassVar[Dimension] = Dimension.LENGTH

    offset: Given = 0.0
    condition: str = ""
    slope: Given = 0.0
    unknown: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AngleCoupling(CouplingRecord):
    """Gears, a belt or a differential between rotary joints: the sum of weight * joint value is
    the `offset`, with a `condition` offset + slope * (condition - reference).
    """

    GIVEN: ClassVar[Dimension] = Dimension.ANGLE

    of: Literal["angle"] = "angle"
    angle: placement.AngleTolerance | None = None
    slopes: placement.AngleTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class LengthCoupling(Radii, CouplingRecord):
    """A coupling of slides, and of rotary joints by a `radius` (joint -> length per radian), as of
    a pinion on a rack.
    """

    of: Literal["length"]
    length: placement.LengthTolerance | None = None
    slopes: placement.LengthTolerance | None = None


Coupling = AngleCoupling | LengthCoupling


# Rows of driven joints: drives and couplings at their joints, and their unknowns.

# Term `curve` per build-up: radius + buildup * reading / (2 pi), integrated.
CURVE_OF_BUILDUP = 1 / (4 * np.pi)


class Term(NamedTuple):
    """A number of a drive or coupling that can be unknown.

    maps : transmission term -> its change per unit. positive : of a scale, which keeps its sign.
    """

    dimension: Dimension
    nominal: float
    tolerance: placement.ToleranceRecord | None
    maps: Mapping[str, float]
    positive: bool = False


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


class SumPart(NamedTuple):
    """Weights of a sum: the word for them, that of a joint by the name in the file, whether these
    joints turn, and the dimension and tolerance of the weights.
    """

    word: str
    items: Iterable[tuple[str, float]]
    turns: bool
    dimension: Dimension
    tolerance: placement.ToleranceRecord | None


def list_parts(stated: Drive | Coupling) -> tuple[SumPart, ...]:
    """Return the parts of the sum of a drive or coupling, none of a triangle drive."""
    if isinstance(stated, TriangleDrive):
        return ()
    turns, ratio = stated.GIVEN is Dimension.ANGLE, Dimension.RATIO
    parts = (SumPart("weight", stated.sum.items(), turns, ratio, stated.weights),)
    if isinstance(stated, Radii):
        radii = stated.radius.items()
        parts += (SumPart("radius", radii, True, Dimension.LENGTH, stated.radii),)
    return parts


@dataclass(frozen=True, eq=False)
class PlacedRow:
    """A drive or coupling of a file, which gives a joint, the length of a triangle, or a sum.

    joints : of its sum, driven joint by the name in the file. joint : the first one.
    own : the actuator of the family, which gives the joint from what the drive gives: offset + gain
    * that; it states what the drive does not. reference : of the condition of a coupling.
    """

    name: str
    drive: Drive | Coupling
    joints: Mapping[str, str]
    joint: DrivenJoint
    own: Actuator
    reference: float = 0.0

    @property
    def sense(self) -> float:
        """What the joint value changes per unit of what the drive gives."""
        return self.own.terms.get("gain", 1.0)

    @property
    def unknown(self) -> Sequence[str]:
        """Terms to identify, of a drive those of a triangle and weights first."""
        if isinstance(self.drive, CouplingRecord):
            return self.drive.unknown
        first = ("foot", "head", SKEW, "weight")
        return sorted(self.drive.unknown, key=lambda term: term.partition(".")[0] not in first)

    @property
    def weights(self) -> dict[str, float]:
        """Weights of the driven joints in a sum, in m and rad, by name."""
        return {self.joints[alias]: w for part in list_parts(self.drive) for alias, w in part.items}

    @property
    def stroke(self) -> tuple[float, float] | None:
        """Allowed readings, the family's if the drive states none and has readings like them."""
        return getattr(self.drive, "stroke", None) or (
            self.own.stroke if self._is_like_own else None
        )

    @property
    def load(self) -> Actuator | None:
        """The load of a drive as a reading, where a compliance is stated or unknown."""
        is_elastic = getattr(self.drive, "compliance", 0.0) or "compliance" in self.drive.unknown
        return Actuator(LOAD + self.name, self._load, reference=0.0) if is_elastic else None

    @property
    def _load(self) -> Dimension:
        return Dimension.MOMENT if self.drive.GIVEN is Dimension.ANGLE else Dimension.FORCE

    @property
    def _is_like_own(self) -> bool:
        return self.own.dimension is getattr(self.drive, "READING", None)

    @property
    def law(self) -> dict[str, float]:
        """Terms of the transmission but weights, and the side of a triangle."""
        terms = {"offset": self.own.terms.get("offset", 0.0), "gain": 0.0}
        for of in self.list_terms().values():
            for term, change in of.maps.items():
                if of.nominal and not term.startswith(WEIGHT):
                    terms[term] = terms.get(term, 0.0) + change * of.nominal
        return terms

    @property
    def actuator(self) -> Actuator:
        """The actuator, of a coupling the row of joints, whose only reading is a condition; raises
        MechanismError for an impossible triangle.
        """
        drive, terms = self.drive, self.law
        if isinstance(drive, CouplingRecord):
            sums = {"weights": self.weights, "column": drive.condition}
            return Actuator(self.name, drive.GIVEN, None, terms, **sums)
        if isinstance(drive, TriangleDrive):
            terms |= choose_side(self.name, drive, terms, self.joint.start)
        return Actuator(
            self.name,
            drive.READING,
            self.stroke,
            terms,
            drive.period,
            drive.sigma or (self.own.sigma if self._is_like_own else None),
            self.weights or ({self.name: 1.0} if self.load else {}),
            tuple(reading for reading, _ in drive.table),
            drive.interpolation,
        )

    def list_terms(self) -> dict[str, Term]:
        """Return all terms by the names that a file gives them."""
        terms = self._list_own_terms()
        for part in list_parts(self.drive):
            for alias, weight in part.items:
                maps = {f"{WEIGHT}{self.joints[alias]}": 1.0}
                terms[f"{part.word}.{alias}"] = Term(part.dimension, weight, part.tolerance, maps)
        if isinstance(self.drive, TriangleDrive):
            terms |= list_triangle_terms(self.drive, self.joint.rotation)
        return terms

    def _list_own_terms(self) -> dict[str, Term]:
        """Return the terms that the joint value is a sum of."""
        drive, own, length, sense = self.drive, self.drive.GIVEN, Dimension.LENGTH, self.sense
        tolerance, scale = getattr(drive, own.value), dict[str, Term]()
        if isinstance(drive, CouplingRecord):
            terms = {"offset": Term(own, drive.offset, tolerance, {"offset": 1.0})}
            if drive.condition:
                per = own.per(get_condition_dimension(drive.condition))
                turns = {"gain": 1.0, "offset": -self.reference}  # about the reference
                terms["slope"] = Term(per, drive.slope, drive.slopes, turns)
            return terms
        if isinstance(drive, SpoolDrive):
            buildup = {"curve": sense * CURVE_OF_BUILDUP}
            scale = {
                "radius": Term(length, drive.radius, drive.radii, {"gain": sense}, positive=True),
                "buildup": Term(length, drive.buildup, drive.buildups, buildup),
            }
        elif isinstance(drive, ScrewDrive):
            pitch = {"gain": sense * (1 / (2 * np.pi))}
            scale = {"lead": Term(length, drive.lead, drive.leads, pitch, positive=True)}
        else:
            gain = {"gain": sense}
            scale = {"gain": Term(Dimension.RATIO, drive.gain, drive.ratio, gain, positive=True)}
        reach = max(map(abs, self.stroke or (0.0,)))
        # without a stroke a curve is refused where it is stated
        units = {"curve": 1 / reach**2 if 0.0 < reach < np.inf else np.nan}
        numbers = {t: getattr(drive, t) for t in ("offset", "curve", "backlash", *HARMONICS)}
        numbers |= {f"{TABLE}{k}": value for k, (_, value) in enumerate(drive.table, 1)}
        terms = {
            name: Term(own, number, tolerance, {name: sense * units.get(name, 1.0)})
            for name, number in numbers.items()
        }
        # of the joint, whatever moves it
        given = {"compliance": sense * (1 / sense)}
        per_load = Term(own.per(self._load), drive.compliance, drive.compliances, given)
        return {"offset": terms["offset"]} | scale | terms | {"compliance": per_load}


def row_errors(
    row: PlacedRow,
    unknown: Iterable[str] | None = None,
    spread: placement.LinkTolerances | None = None,
) -> placement.ErrorModel:
    """Return the unknown terms of a drive or coupling, `q1.offset`, `gear.weight.arm.pin` ..; what
    stands before a point, and `table`, means all of a kind. Raises RecordError for impossible ones.

    unknown : default: those of the file. spread : tolerances, in place of those of the file.
    """
    name, terms, errors = row.name, row.list_terms(), []
    for stated in row.unknown if unknown is None else unknown:
        kinds = {term: term.partition(".")[0].rstrip("0123456789") for term in terms}
        whole = [term for term, of in terms.items() if stated == kinds[term] and of.maps]
        chosen = [stated] if stated in terms else whole
        if not chosen:
            hint = f"{suggest_names(stated, list(terms))}. Allowed: {', '.join(terms)}"
            raise row.drive.refuse(name, f"has no term {stated!r}{hint}")
        for term in chosen:
            dimension, nominal, tolerance, changes, positive = terms[term]
            parameter = f"{name}.{term}"
            if not changes:
                sentence = f"has {term}, which rotates its triangle about the joint's own axis and"
                raise row.drive.refuse(name, f"{sentence} changes no length. Leave it out")
            sd = (
                spread.select(dimension)
                if spread
                else placement.standard_deviation(tolerance, parameter)
            )
            maps = [
                LinearMap(parameter, Address(name, "transmission", axis), change)
                for axis, change in changes.items()
            ]
            errors.append(
                placement.single_error(parameter, dimension, nominal, sd, *maps, positive=positive)
            )
    return placement.join_errors(errors)


def complete_row(row: PlacedRow, spread: placement.LinkTolerances) -> placement.ErrorModel:
    """Return the offset of a drive or coupling, and those dimensions of a triangle that, with the
    offset, have the effects of all others, as parameters.

    These are two coordinates of the foot across the axis of the joint, and the one of the head that
    changes its lever most: see docs/theory/kinematics.md.
    """
    unknown = ["offset"]
    if isinstance(row.drive, TriangleDrive):
        across = row.joint.rotation[:, :2]
        foot = sorted(np.argsort(-np.linalg.norm(across, axis=1), kind="stable")[:2].tolist())
        head = int(np.argmax(np.abs(across @ (across.T @ row.drive.triangle.head))))
        unknown += [*(f"foot.{AXES[3 + i]}" for i in foot), f"head.{AXES[3 + head]}"]
    return row_errors(row, unknown, spread)


# Conditions, and the joints of drives and couplings.


def get_condition_dimension(name: str) -> Dimension:
    """Return the dimension of a condition by its name."""
    return Dimension.TIME if name == Dimension.TIME.value else Dimension.TEMPERATURE


def list_conditions(stated: Mapping[str, Condition]) -> Iterator[Actuator]:
    """Yield conditions of a file, but those of the load, as readings."""
    for name, condition in stated.items():
        dimension = get_condition_dimension(name)
        if dimension.value != name.partition(".")[0]:
            raise placement.RecordError(
                f"the condition {name!r} is not a column of times, temperatures or loads. Call it "
                f"temperature, temperature.PLACE, time, or one of {', '.join(FORCES)}",
                "conditions",
                name,
            )
        yield Actuator(name, dimension, condition.range, reference=condition.reference)


def place_rows(
    limbs: Sequence[placement.PlacedLimb],
    stated: Mapping[str, Drive],
    own: Iterable[Actuator],
    couplings: Mapping[str, Coupling],
    conditions: Mapping[str, Condition],
) -> tuple[tuple[placement.PlacedLimb, ...], dict[str, PlacedRow], dict[str, PlacedRow]]:
    """Return the limbs, with `limb.joint` as the drive of each passive joint that a sum names, and
    by name drives in the order of the readings and couplings, those of limbs that are copied one
    for each copy. Raises RecordError where joints and rows do not fit.

    A drive that several limbs name is one drive. stated : the drives of the file; one that is not
    listed reads the joint itself. own : what the family knows of its drives.
    """
    joints, known = find_driven_joints(limbs)
    coupled = dict[str, PlacedRow]()
    for key, coupling in couplings.items():
        reference, base = _find_reference(key, coupling, conditions), Actuator(key, coupling.GIVEN)
        for name, names in _name_joints(key, coupling, joints, known):
            if name in coupled or name in stated or name in joints:
                raise coupling.refuse(key, f"has the name {name!r} of another row. Rename one")
            first = joints[next(iter(names.values()))]
            coupled[name] = PlacedRow(name, coupling, names, first, base, reference)
    for condition in conditions:
        if all(coupling.condition != condition for coupling in couplings.values()):
            raise placement.RecordError(
                f"the condition {condition!r} is in no coupling. Name it there, or leave it out",
                "conditions",
                condition,
            )
    sums = [key for key in stated if any(part.items for part in list_parts(stated[key]))]
    keys: dict[str, tuple[str | None, Mapping[str, str]]] = {
        name: (key, names)
        for key in sums
        for name, names in _name_joints(key, stated[key], joints, known)
    }
    for name, joint in joints.items():
        groups = (key for key in (joint.stated, placement.strip_number(name)) if key not in joints)
        key = next((key for key in (name, *groups) if key in stated), None)
        if not joint.is_passive and key not in sums and (key or not sums):
            keys[name] = key, {}
    if sums:  # the file states the order of the readings
        order = {key: i for i, key in enumerate(stated)}
        keys = dict(sorted(keys.items(), key=lambda item: order[item[1][0] or ""]))
    of_family, drives = {actuator.name: actuator for actuator in own}, dict[str, PlacedRow]()
    for name, (key, names) in keys.items():
        joint = joints[next(iter(names.values()), name)]
        plain = AngleDrive(reads="angle") if joint.turns else LengthDrive(reads="length")
        drive = plain if key is None else stated[key]
        base = of_family.get(name) or Actuator(name, drive.READING)
        drives[name] = PlacedRow(name, drive, names, joint, base)
        _check_drive(drives[name], drive)
    groups = {joint.stated for joint in joints.values() if not joint.is_passive}
    refuse_idle_drives(stated, drives, groups.union(sums, map(placement.strip_number, drives)))
    used = {joint for row in (*coupled.values(), *drives.values()) for joint in row.weights}
    if used:
        driven = {name: of.limb for name, of in joints.items() if name in used or not of.is_passive}
        _check_rows({**drives, **coupled}, driven)
    if strokes := {name: words for name in drives if (words := _word_stroke(drives[name]))}:
        raise StrokeError(strokes)

    def name_passive(limb: Limb, joint: Joint) -> Joint:
        name = f"{limb.name}.{joint.name}"
        is_coupled = not joint.actuator and name in used
        return replace(joint, actuator=name, is_passive=True) if is_coupled else joint

    placed = (
        limb._replace(limb=replace(own, joints=tuple(name_passive(own, j) for j in own.joints)))
        for limb in limbs
        for own in [limb.limb]
    )
    return tuple(placed), drives, coupled


def find_driven_joints(
    limbs: Iterable[placement.PlacedLimb],
) -> tuple[dict[str, DrivenJoint], dict[str, list[str]]]:
    """Return all joints and rods under the names of their drives, passive ones as `limb.joint`, and
    the names that each name in a file means.
    """
    joints, known = dict[str, DrivenJoint](), dict[str, dict[str, None]]()
    for limb in limbs:
        own, copy = limb.limb, limb.name.removeprefix(limb.stem)
        found = [
            (j.actuator, j.name, j.kind == "R", limb.rotations[j.name], j.start) for j in own.joints
        ]
        for drive, joint, turns, rotation, start in (
            *found,
            (own.actuator, "", False, np.eye(3), 0.0),
        ):
            name, names = drive or f"{limb.name}.{joint}", list[str]()
            if joint:
                names += f"{limb.name}.{joint}", f"{limb.stem}.{joint}"
            if drive:
                names += drive, drive.removesuffix(copy)
            if names:
                place = limb.name, turns, rotation, start, not drive
                joints.setdefault(name, DrivenJoint(name, name.removesuffix(copy), *place))
            for alias in names:
                known.setdefault(alias, {})[name] = None
    return joints, {alias: list(names) for alias, names in known.items()}


def _find_reference(key: str, coupling: Coupling, conditions: Mapping[str, Condition]) -> float:
    """Return the reference of the condition of a coupling, 0 for none."""
    name = coupling.condition
    if name in FORCES:
        sentence = (
            f"names {name!r}, but a load acts through drives. Give the `compliance:` of a drive"
        )
        raise coupling.refuse(key, sentence)
    if name and name not in conditions:
        hint = f"which the file does not state{suggest_names(name, list(conditions))}"
        raise coupling.refuse(key, f"names the condition {name!r}, {hint}. Add it to `conditions:`")
    return conditions[name].reference if name else 0.0


def _name_joints(
    key: str,
    stated: Drive | Coupling,
    joints: Mapping[str, DrivenJoint],
    known: Mapping[str, Sequence[str]],
) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield name and driven joints of a sum, or those of all copies. known : name in the file ->
    names of driven joints.
    """
    weights, refuse = dict[str, float](), partial(stated.refuse, key)
    names = [alias for part in list_parts(stated) for alias, _ in part.items]
    for part in list_parts(stated):
        for alias, weight in part.items:
            if names.count(alias) > 1:
                raise stated.refuse(
                    key, f"has {alias!r} under both `sum:` and `radius:`. List it once"
                )
            if alias not in known:
                raise refuse(
                    f"names {alias!r}, which is neither a drive nor a joint of a limb"
                    f"{suggest_names(alias, list(known))}. Write limb.joint or the name of a drive"
                )
            if joints[known[alias][0]].turns != part.turns:
                what = f"adds lengths, but {alias!r} turns"
                if part.turns:
                    kind = "adds angles and" if part.word == "weight" else "has a radius of"
                    what = f"{kind} {alias!r}, which slides"
                remedy = "joints that turn in one of angles, or under `radius:`"
                raise refuse(f"{what}. List slides in a sum of lengths, {remedy}")
            if not np.isfinite(weight):
                raise stated.refuse(
                    key, f"gives {alias!r} the weight {weight:g}. Give a finite number"
                )
            weights[alias] = weight
    if not any(weights.values()):
        raise refuse("has no weight other than 0, so it states nothing. Give one")
    counts = {len(known[alias]) for alias in weights} - {1}
    if len(counts) > 1:
        numbers = " and ".join(map(str, sorted(counts)))
        raise refuse(f"names joints of limbs with {numbers} copies. Name single copies")
    count = counts.pop() if counts else 0
    for i in range(max(count, 1)):
        own = {a: known[a][i if len(known[a]) > 1 else 0] for a in weights}
        yield f"{key}{i + 1}" if count else key, own


def _check_rows(rows: Mapping[str, PlacedRow], known: Mapping[str, str]) -> None:
    """Refuse readings and couplings that leave a driven joint out or repeat each other. known :
    driven joint -> its limb.
    """
    sums = {name: row.weights or {name: 1.0} for name, row in rows.items()}
    read = {joint for weights in sums.values() for joint, w in weights.items() if w != 0.0}
    unread = [joint for joint in known if joint not in read]
    if unread:
        raise placement.RecordError(
            f"joint {unread[0]!r} of limb {known[unread[0]]!r} is in no sum, so its readings are "
            f"missing. Add it to a `sum:`, or list {unread[0]!r} among the actuators",
            "drives",
            next(iter(sums)),
        )
    W = np.array([[weights.get(joint, 0.0) for joint in known] for weights in sums.values()])
    if count_independent(W) == min(W.shape):
        return
    for i, (name, row) in enumerate(rows.items()):
        if count_independent(W[: i + 1]) <= i:
            sentence = f"has a sum that follows from {', '.join(list(sums)[:i])}"
            raise row.drive.refuse(name, f"{sentence}: the weights are singular. Correct a weight")


def _word_stroke(placed: PlacedRow) -> str:
    """Return what of the stroke of a triangle drive no angle reaches, or nothing."""
    if not isinstance(placed.drive, TriangleDrive):
        return ""
    terms = placed.actuator.terms
    low, high = (float(end) for end in compute_range(complete_triangle(terms)))
    ends = [terms["offset"] + terms["gain"] * reading for reading in placed.stroke or ()]
    outside = [f"{end * 1e3:.6g} mm" for end in ends if np.isfinite(end) and not low <= end <= high]
    if not outside:
        return ""
    return (
        f"the stroke of actuator {placed.name!r} contains the length {' and '.join(outside)}, "
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
            raise DriveRecord.refuse(
                name,
                f"drives no joint{suggest_names(name, sorted(known))}. Write 'actuated: {name}' "
                "at one, or leave it out" + (f". {', '.join(used)} drive joints" if used else ""),
            )


def _check_drive(placed: PlacedRow, drive: Drive) -> None:
    """Refuse a drive whose transmission does not give what its joint does, and a term that is
    stated or unknown and cannot be (RecordError).
    """
    name, turns = placed.name, placed.joint.turns
    if not placed.joints and turns != (
        drive.GIVEN is Dimension.ANGLE or isinstance(drive, TriangleDrive)
    ):
        motion, allowed = (
            ("turns", "reads: angle without a radius, or a triangle")
            if turns
            else ("slides", "reads: length, or reads: angle with a radius")
        )
        raise drive.refuse(name, f"drives a joint that {motion}. Give {allowed}")
    stated = {term for term in ("curve", *HARMONICS) if getattr(drive, term)} | {*drive.unknown}
    for term in HARMONICS:
        if term in stated and not drive.period:
            raise drive.refuse(name, f"has {term}, but no period. Give the reading's period")
    if "curve" in stated and not np.isfinite(placed.list_terms()["curve"].maps["curve"]):
        sentence = "has a curve, the deviation at the far end of its stroke, but no stroke"
        raise drive.refuse(name, f"{sentence}. Give the stroke")
    if drive.compliance < 0.0:
        raise drive.refuse(name, "has a negative compliance. Give its size")
    if "compliance" in drive.unknown and drive.compliances is None:
        sentence = (
            "has an unknown compliance. Give `compliances:`, the expected spread of its given value"
        )
        raise drive.refuse(name, sentence)
    if drive.table:
        _check_table(placed, drive)


def _check_table(placed: PlacedRow, drive: Drive) -> None:
    """Refuse a table of one point, out of order, or with which a reading has two joint values."""
    name, points = placed.name, np.array([reading for reading, _ in drive.table])
    if not 2 <= len(points) <= MOST_POINTS or not (np.diff(points) > 0.0).all():
        rows = f"Give 2 to {MOST_POINTS} rows [reading, value], the readings growing"
        raise drive.refuse(name, f"has a table of {len(points)} points. {rows}")
    share = np.linspace(0.0, 1.0, 9)[:-1]
    own = [replace(placed.actuator, terms=placed.law)]
    readings = np.append(points[:-1, None] + share * np.diff(points)[:, None], points[-1])
    law = Transmissions(nominal_terms(own)[None], list_constants(own))
    values = law.evaluate_sums(readings[None, :, None])
    steps = np.diff(values[0, :, 0])
    if not ((steps > 0.0).all() or (steps < 0.0).all()):
        sentence = "has a table that turns its joint back, so two readings have one joint value"
        raise drive.refuse(name, f"{sentence}. Correct a value, or give the gain")


# Triangles: a linear actuator between two anchors beside a rotary joint.


def choose_side(
    name: str, drive: TriangleDrive, stated: Mapping[str, float], start: float
) -> dict[str, float]:
    """Return the side of a triangle at the angle of its joint near home [rad], and the middle of
    this side. stated : the other terms. Raises RecordError: an anchor on the axis, or a start at a
    dead point.
    """
    terms = complete_triangle(stated)
    low, high = (float(end) for end in compute_range(terms))
    # b of l^2 = a - b cos(theta - gamma) is twice the product of both levers
    if not high**2 - low**2 > 4 * ON_AXIS * (terms[:6].reshape(2, 3) ** 2).sum(axis=1).max():
        sentence = "has a degenerate triangle: an anchor is on the axis of the joint, so all angles"
        raise drive.refuse(name, f"{sentence} give one length. Give anchors away from the axis")
    lead = float(geometry.wrap_angle(start - describe_triangle(terms)[2]))
    side = np.sign(np.sin(lead))
    if abs(np.sin(lead)) < DEAD:
        raise drive.refuse(
            name,
            f"does not turn its joint at {np.rad2deg(start):g} deg, a dead point of its triangle: "
            "both anchors and the axis are in one plane. Give another `start:` of the joint, or "
            "other anchors",
        )
    return {"side": float(side), "middle": float(start - lead + side * np.pi / 2)}


def list_triangle_terms(drive: TriangleDrive, rotation: FloatArray) -> Iterator[tuple[str, Term]]:
    """Yield the dimensions of a triangle by name, `foot.x` and so on; a skew about the axis of the
    joint changes nothing.
    """
    of, lengths = drive.triangle, (Dimension.LENGTH, drive.length)
    skew = of.skew.rx, of.skew.ry, of.skew.rz
    for part, axes, values, (dimension, tolerance) in (
        ("foot", AXES[3:], of.foot, lengths),
        ("head", AXES[3:], of.head, lengths),
        (SKEW, AXES[:3], skew, (Dimension.ANGLE, drive.angle)),
    ):
        for axis, nominal, components in zip(axes, values, rotation, strict=True):
            own = components[:2] if part == SKEW else components
            is_idle = part == SKEW and np.linalg.norm(own) < ON_AXIS
            changes = {
                f"{part}.{name}": float(share)
                for name, share in zip("xyz", own, strict=False)
                if abs(share) > 1e-12 and not is_idle
            }
            yield f"{part}.{axis}", Term(dimension, nominal, tolerance, changes)
