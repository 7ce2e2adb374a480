# SPDX-License-Identifier: Apache-2.0
"""Any mechanism of limbs between base and platform, written out joint by joint: one short file is a
robot.

`error_model: ideal` takes the unknowns that the file names (`errors:` of a limb, `unknown:` of a
drive, `parameters:`), `complete` six for every link transform less what its joint absorbs, beside
the named ones. How to write such a file: docs/robots.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Address, Assembly, Cone, LinearMap
from loopcal.mechanism.families.chain import (
    EX,
    EY,
    EZ,
    Placed,
    Step,
    moved,
    placed,
    tilted,
    turn_about,
)
from loopcal.mechanism.families.drives import actuator, drive_errors
from loopcal.mechanism.families.error_models import Errors, Spread, complete, offset, quantity
from loopcal.mechanism.families.limb_records import (
    AngleDrive,
    Cylindrical,
    Drive,
    JointRecord,
    LengthDrive,
    LimbRecord,
    LimbsFile,
    Named,
    NamedAngle,
    NamedLength,
    Onto,
    Prismatic,
    Revolute,
    Shifts,
    Tilts,
    Universal,
    direction,
    place_matrix,
    refuse_branch,
)
from loopcal.mechanism.families.map_units import check_units, dimension_of, engine_axis
from loopcal.mechanism.families.records import RobotRecord, standard_deviation
from loopcal.units import Dimension


@dataclass(frozen=True)
class Limbs(LimbsFile, RobotRecord):
    """The file of a mechanism of any limbs.

    Attributes
    ----------
    freedoms : of the platform, in base axes. controlled : coordinates it is commanded in.
    actuators : drives by name; a drive that is not listed reads the joint's value. In a limb with
        copies, `q` means q1, q2, ..
    limbs : from base to platform. error_model, parameters : see the module. tolerances : of the
        complete model.
    """

    def expand(self) -> Assembly:
        """All copies of all limbs; raises MechanismError for what cannot be."""
        if not self.limbs:
            raise MechanismError(
                f"{self.name} has no limbs; write those that join the base to the platform"
            )
        names = tuple(limb.name for limb in self.limbs)
        for limb in self.limbs:
            refuse_branch(limb, names)
        members = {limb.name: tuple(_copies(limb)) for limb in self.limbs}
        everyone = [one for limb in self.limbs for one in members[limb.name]]
        # a drive that several limbs name is one drive
        drives = tuple(
            {drive[0]: drive for one in everyone for drive in self._drives(one)}.values()
        )
        errors = sum((_limb_errors(one) for one in everyone), start=Errors())
        errors += sum(
            (drive_errors(name, drive, turns) for name, drive, turns in drives), start=Errors()
        )
        by_name = {name: (drive, turns) for name, drive, turns in drives}
        errors += sum(
            (_named(named, members, by_name) for named in self.parameters), start=Errors()
        )
        if self.error_model == "complete":
            errors = self._complete(everyone, drives).beside(errors) + errors
        self._check(errors, tuple(by_name))
        return Assembly(
            name=self.name,
            source=self.source,
            limbs=tuple(one.placed.limb for one in everyone),
            actuators=tuple(actuator(name, drive) for name, drive, _ in drives),
            freedoms=self.freedoms,
            controlled=self.controlled,
            home=self.home.matrix,
            tool=self.tool.matrix,
            workspace=self.workspace.ranges,
            parameters=errors.parameters,
            maps=errors.maps,
        )

    def _check(self, errors: Errors, drives: tuple[str, ...]) -> None:
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
        if not errors.parameters:
            raise MechanismError(
                f"{self.name} names no unknown; give a limb 'errors:', a drive 'unknown:', or "
                "state error_model: complete"
            )

    def _drives(self, one: _Member) -> Iterator[tuple[str, Drive, bool]]:
        """Names of a limb's drives, what they are, and whether the joint turns."""
        limb = one.placed.limb
        driven = [(j.actuator, j.kind == "R") for j in limb.joints if j.actuator]
        for name, turns in (*driven, *([(limb.actuator, False)] if limb.actuator else [])):
            plain = AngleDrive("angle") if turns else LengthDrive("length")
            drive = (
                self.actuators.get(name)
                or self.actuators.get(name.removesuffix(one.suffix))
                or plain
            )
            if turns != isinstance(drive, AngleDrive):
                found = "turns" if turns else "slides"
                raise MechanismError(
                    f"actuator {name!r} drives a joint that {found}; state "
                    + (
                        "reads: angle without a radius"
                        if turns
                        else "reads: length, or reads: angle with a radius"
                    )
                )
            yield name, drive, turns

    def _complete(
        self, everyone: list[_Member], drives: tuple[tuple[str, Drive, bool], ...]
    ) -> Errors:
        """All errors of all limbs, and the offset of every drive once, however many limbs it moves."""
        length = standard_deviation(self.tolerances.lengths, "the lengths")
        angle = standard_deviation(self.tolerances.angles, "the angles")
        found = sum(
            (complete(one.placed, Spread(length, angle), offsets=False) for one in everyone),
            start=Errors(),
        )
        for name, drive, turns in drives:
            dimension, sd = (Dimension.ANGLE, angle) if turns else (Dimension.LENGTH, length)
            found += offset(f"{name}.offset", name, dimension, drive.offset, sd)
        return found


@dataclass(frozen=True)
class _Member:
    """A limb that is there: a copy of its record, with the number that its names end in."""

    record: LimbRecord
    placed: Placed
    suffix: str


def _copies(limb: LimbRecord) -> Iterator[_Member]:
    """A limb as often as it stands there."""
    if limb.copies is None:
        yield _Member(limb, _placed(limb, limb.name, "", np.eye(4)), "")
        return
    if limb.copies.count < 1:
        raise MechanismError(f"limb {limb.name!r} has {limb.copies.count} copies; give one or more")
    step = limb.copies.step if limb.copies.step is not None else 2 * np.pi / limb.copies.count
    for i in range(limb.copies.count):
        turn = turn_about(limb.copies.about, limb.copies.start + i * step)
        yield _Member(limb, _placed(limb, f"{limb.name}{i + 1}", str(i + 1), turn), str(i + 1))


def _placed(limb: LimbRecord, name: str, suffix: str, turn: np.ndarray) -> Placed:
    """One copy of a limb, turned."""
    steps: list[Step] = []
    for i, joint in enumerate(limb.chain):
        number = 1 + sum(other.joint == joint.joint for other in limb.chain[:i])
        steps += _steps(joint, joint.name or f"{joint.joint}{number}", suffix)
    tip = place_matrix(limb.tip)
    if steps:
        steps[0] = replace(steps[0], place=turn @ steps[0].place)
    else:
        tip = turn @ tip
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
    drive = limb.actuated + suffix if limb.actuated else None
    cones = tuple(Cone(cone.end, _plain(direction(cone.axis)), cone.angle) for cone in limb.cones)
    return placed(
        name,
        tuple(steps),
        tip,
        limb.ending,
        turn @ place_matrix(limb.attach),
        limb.length,
        drive,
        cones,
    )


def _steps(joint: JointRecord, name: str, suffix: str) -> list[Step]:
    """A joint as R and P joints."""
    place, here = place_matrix(joint.at), np.eye(4)
    if isinstance(joint, Revolute):
        motor = joint.actuated + suffix if joint.actuated else None
        pitch = joint.lead / (2 * np.pi)
        return [
            Step(name, "R", place, direction(joint.axis), motor, pitch, joint.start, joint.limits)
        ]
    if isinstance(joint, Prismatic):
        motor = joint.actuated + suffix if joint.actuated else None
        return [
            Step(name, "P", place, direction(joint.axis), motor, 0.0, joint.start, joint.limits)
        ]
    if isinstance(joint, Cylindrical):
        axis = direction(joint.axis)
        turn = Step(f"{name}.turn", "R", place, axis, start=joint.start)
        return [turn, Step(f"{name}.slide", "P", here, axis, start=joint.slide_start)]
    axes = (
        [direction(axis) for axis in joint.axes] if isinstance(joint, Universal) else [EZ, EY, EX]
    )
    return [
        Step(f"{name}.{i + 1}", "R", place if i == 0 else here, axis, start=start)
        for i, (axis, start) in enumerate(zip(axes, joint.start, strict=True))
    ]


def _limb_errors(one: _Member) -> Errors:
    """Unknowns that a limb's record names."""
    parts = (
        _shifts(one.placed, e) if isinstance(e, Shifts) else _tilts(one.placed, e)
        for e in one.record.errors
    )
    return sum(parts, start=Errors())


def _shifts(limb: Placed, entry: Shifts) -> Errors:
    """Unknown lengths of a limb."""
    sd, found = standard_deviation(entry.tolerance, f"{limb.name} {entry.of}"), Errors()
    for axis in entry.shift:
        label = f"{limb.name}.{entry.name or entry.of}"
        if axis == "length":
            _check_rod(limb, entry)
            name = label if entry.name else f"{limb.name}.length"
            address = Address(limb.name, "rod", "length")
            found += quantity(
                name, Dimension.LENGTH, limb.limb.length, sd, LinearMap(name, address)
            )
            continue
        element = _element(limb, entry.of)
        place, name = limb.places[element], f"{label}.{axis}"
        nominal = float((place[:3, :3].T @ place[:3, 3])["xyz".index(axis)])
        found += quantity(name, Dimension.LENGTH, nominal, sd, *moved(name, limb, element, axis))
    return found


def _check_rod(limb: Placed, entry: Shifts) -> None:
    if limb.limb.ending != "distance" or entry.of != "rod":
        raise MechanismError(
            f"{limb.name!r}: 'length' belongs to a rod; write 'of: rod' in a limb that ends in a "
            "distance"
        )


def _tilts(limb: Placed, entry: Tilts) -> Errors:
    """Unknown angles of a limb."""
    sd, found = standard_deviation(entry.tolerance, f"{limb.name} {entry.of}"), Errors()
    element = _element(limb, entry.of)
    for axis in entry.tilt:
        name = f"{limb.name}.{entry.name or entry.of}.{axis}"
        maps = (
            tilted(name, limb, element, axis) if entry.alone else moved(name, limb, element, axis)
        )
        found += quantity(name, Dimension.ANGLE, 0.0, sd, *maps)
    return found


def _element(limb: Placed, name: str) -> str:
    """A link of a limb; a joint of several is meant by its first. Raises MechanismError listing
    what there is.
    """
    for found in (name, f"{name}.1", f"{name}.turn"):
        if found in limb.elements:
            return found
    raise MechanismError(f"limb {limb.name!r} has no {name!r}; it has {', '.join(limb.elements)}")


def _named(
    named: Named, members: dict[str, tuple[_Member, ...]], drives: Mapping[str, tuple[Drive, bool]]
) -> Errors:
    """A parameter with maps of its own."""
    if isinstance(named, NamedLength):
        nominal = named.length
    else:
        nominal = named.angle if isinstance(named, NamedAngle) else named.ratio
    maps = [linear for entry in named.maps for linear in _onto(named, entry, members, drives)]
    sd = standard_deviation(named.tolerance, named.name)
    return quantity(named.name, dimension_of(named), nominal, sd, *maps)


def _onto(
    named: Named,
    entry: Onto,
    members: dict[str, tuple[_Member, ...]],
    drives: Mapping[str, tuple[Drive, bool]],
) -> Iterator[LinearMap]:
    """One entry of a parameter's maps, for every copy that it means."""
    name, (axis, coefficient) = named.name, engine_axis(named.name, entry)
    if entry.limb in drives:
        check_units(named, entry, drives[entry.limb])
        yield LinearMap(name, Address(entry.limb, entry.element, axis), coefficient)
        return
    found = members.get(entry.limb) or tuple(
        m for ms in members.values() for m in ms if m.placed.name == entry.limb
    )
    if not found:
        known = ", ".join((*members, *sorted(drives)))
        raise MechanismError(
            f"parameter {name!r} is mapped onto {entry.limb!r}, which is not there; known are "
            f"{known}"
        )
    check_units(named, entry, None)
    for one in found:
        if axis in AXES:
            yield from moved(
                name, one.placed, _element(one.placed, entry.element), axis, coefficient
            )
        else:
            yield LinearMap(name, Address(one.placed.name, entry.element, axis), coefficient)


def _plain(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z
