# SPDX-License-Identifier: Apache-2.0
"""Mechanisms of any limbs between base and platform, written joint by joint in a short file.

`error_model: ideal` has the unknowns that the file names (`errors:` of a limb, `unknown:` of a
drive, `parameters:`). `complete` adds six for every link transform, less those that its joint
repeats. How to write such a file: docs/robots.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Address, Assembly, Cone, LinearMap
from loopcal.mechanism.families.error_models import (
    ErrorModel,
    ErrorTolerances,
    complete_errors,
    offset_error,
    single_error,
)
from loopcal.mechanism.families.limb_parameters import (
    build_actuator,
    check_units,
    drive_errors,
    find_dimension,
    find_engine_axis,
)
from loopcal.mechanism.families.limb_placement import (
    EX,
    EY,
    EZ,
    JointPlacement,
    PlacedLimb,
    map_displacement,
    map_slide_tilt,
    place_limb,
    rotate_about,
)
from loopcal.mechanism.families.limb_records import (
    AngleDrive,
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
    Tilts,
    Universal,
    axis_vector,
    matrix_from_place,
    refuse_branch,
)
from loopcal.mechanism.families.records import RobotRecord, standard_deviation
from loopcal.units import Dimension


@dataclass(frozen=True)
class Limbs(LimbsFile, RobotRecord):
    """The file of a mechanism of any limbs.

    Attributes
    ----------
    freedoms : of the platform, in base axes. controlled : coordinates in which it is commanded.
    actuators : drives by name; a drive that is not listed reads the joint value. In a limb with
        copies, `q` means q1, q2, ..
    limbs : from base to platform. error_model, parameters : see the module. tolerances : of the
        complete model.
    """

    family = "limbs"

    def expand(self) -> Assembly:
        """Return all copies of all limbs; raises MechanismError for an inconsistent file."""
        if not self.limbs:
            raise MechanismError(
                f"{self.name} has no limbs; write those that join the base to the platform"
            )
        names = tuple(limb.name for limb in self.limbs)
        for limb in self.limbs:
            refuse_branch(limb, names)
        members = {limb.name: tuple(_copies(limb)) for limb in self.limbs}
        copies = [member for limb in self.limbs for member in members[limb.name]]
        # a drive that several limbs name is one drive
        drives = tuple(
            {drive[0]: drive for member in copies for drive in self._drives(member)}.values()
        )
        errors = sum((_limb_errors(member) for member in copies), start=ErrorModel())
        errors += sum(
            (drive_errors(name, drive, turns) for name, drive, turns in drives), start=ErrorModel()
        )
        by_name = {name: (drive, turns) for name, drive, turns in drives}
        errors += sum(
            (_named(named, members, by_name) for named in self.parameters), start=ErrorModel()
        )
        if self.error_model == "complete":
            errors = self._complete(copies, drives).without_effects_of(errors) + errors
        self._check(errors, tuple(by_name))
        return Assembly(
            name=self.name,
            source=self.source,
            limbs=tuple(member.placed.limb for member in copies),
            actuators=tuple(build_actuator(name, drive) for name, drive, _ in drives),
            freedoms=self.freedoms,
            controlled=self.controlled,
            home=self.home.matrix,
            tool=self.tool.matrix,
            workspace=self.workspace.ranges,
            parameters=errors.parameters,
            maps=errors.maps,
        )

    def _check(self, errors: ErrorModel, drives: tuple[str, ...]) -> None:
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

    def _drives(self, member: _Member) -> Iterator[tuple[str, Drive, bool]]:
        """Yield the names of a limb's drives, the drives, and whether their joints are rotary."""
        limb = member.placed.limb
        driven = [(j.actuator, j.kind == "R") for j in limb.joints if j.actuator]
        for name, turns in (*driven, *([(limb.actuator, False)] if limb.actuator else [])):
            plain = AngleDrive("angle") if turns else LengthDrive("length")
            drive = (
                self.actuators.get(name)
                or self.actuators.get(name.removesuffix(member.suffix))
                or plain
            )
            if turns != isinstance(drive, AngleDrive):
                motion = "turns" if turns else "slides"
                raise MechanismError(
                    f"actuator {name!r} drives a joint that {motion}; state "
                    + (
                        "reads: angle without a radius"
                        if turns
                        else "reads: length, or reads: angle with a radius"
                    )
                )
            yield name, drive, turns

    def _complete(
        self, copies: list[_Member], drives: tuple[tuple[str, Drive, bool], ...]
    ) -> ErrorModel:
        """Return all errors of all limbs, and the offset of every drive once."""
        length = standard_deviation(self.tolerances.lengths, "the lengths")
        angle = standard_deviation(self.tolerances.angles, "the angles")
        errors = sum(
            (
                complete_errors(member.placed, ErrorTolerances(length, angle), offsets=False)
                for member in copies
            ),
            start=ErrorModel(),
        )
        for name, drive, turns in drives:
            dimension, sd = (Dimension.ANGLE, angle) if turns else (Dimension.LENGTH, length)
            errors += offset_error(f"{name}.offset", name, dimension, drive.offset, sd)
        return errors


@dataclass(frozen=True)
class _Member:
    """One copy of a limb, with the number appended to its names."""

    record: LimbRecord
    placed: PlacedLimb
    suffix: str


def _copies(limb: LimbRecord) -> Iterator[_Member]:
    """Yield the copies of a limb."""
    if limb.copies is None:
        yield _Member(limb, _place_copy(limb, limb.name, "", np.eye(4)), "")
        return
    if limb.copies.count < 1:
        raise MechanismError(f"limb {limb.name!r} has {limb.copies.count} copies; give one or more")
    step = limb.copies.step if limb.copies.step is not None else 2 * np.pi / limb.copies.count
    for i in range(limb.copies.count):
        turn = rotate_about(limb.copies.about, limb.copies.start + i * step)
        yield _Member(limb, _place_copy(limb, f"{limb.name}{i + 1}", str(i + 1), turn), str(i + 1))


def _place_copy(limb: LimbRecord, name: str, suffix: str, turn: np.ndarray) -> PlacedLimb:
    """Return one copy of a limb, rotated."""
    steps: list[JointPlacement] = []
    for i, joint in enumerate(limb.chain):
        number = 1 + sum(other.joint == joint.joint for other in limb.chain[:i])
        steps += _steps(joint, joint.name or f"{joint.joint}{number}", suffix)
    tip = matrix_from_place(limb.tip)
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
    cones = tuple(Cone(cone.end, _plain(axis_vector(cone.axis)), cone.angle) for cone in limb.cones)
    return place_limb(
        name,
        tuple(steps),
        tip,
        limb.ending,
        turn @ matrix_from_place(limb.attach),
        limb.length,
        drive,
        cones,
    )


def _steps(joint: JointRecord, name: str, suffix: str) -> list[JointPlacement]:
    """Return a joint as R and P joints."""
    place, unmoved = matrix_from_place(joint.at), np.eye(4)
    if isinstance(joint, Revolute):
        motor = joint.actuated + suffix if joint.actuated else None
        pitch = joint.lead / (2 * np.pi)
        return [
            JointPlacement(
                name, "R", place, axis_vector(joint.axis), motor, pitch, joint.start, joint.limits
            )
        ]
    if isinstance(joint, Prismatic):
        motor = joint.actuated + suffix if joint.actuated else None
        return [
            JointPlacement(
                name, "P", place, axis_vector(joint.axis), motor, 0.0, joint.start, joint.limits
            )
        ]
    if isinstance(joint, Cylindrical):
        axis = axis_vector(joint.axis)
        turn = JointPlacement(f"{name}.turn", "R", place, axis, start=joint.start)
        return [turn, JointPlacement(f"{name}.slide", "P", unmoved, axis, start=joint.slide_start)]
    axes = (
        [axis_vector(axis) for axis in joint.axes] if isinstance(joint, Universal) else [EZ, EY, EX]
    )
    return [
        JointPlacement(f"{name}.{i + 1}", "R", place if i == 0 else unmoved, axis, start=start)
        for i, (axis, start) in enumerate(zip(axes, joint.start, strict=True))
    ]


def _limb_errors(member: _Member) -> ErrorModel:
    """Return the unknowns that a limb's record names."""
    errors = (
        _shifts(member.placed, e) if isinstance(e, Shifts) else _tilts(member.placed, e)
        for e in member.record.errors
    )
    return sum(errors, start=ErrorModel())


def _shifts(limb: PlacedLimb, entry: Shifts) -> ErrorModel:
    """Return the unknown lengths of a limb."""
    sd, errors = standard_deviation(entry.tolerance, f"{limb.name} {entry.of}"), ErrorModel()
    for axis in entry.shift:
        label = f"{limb.name}.{entry.name or entry.of}"
        if axis == "length":
            _check_rod(limb, entry)
            name = label if entry.name else f"{limb.name}.length"
            address = Address(limb.name, "rod", "length")
            errors += single_error(
                name, Dimension.LENGTH, limb.limb.length, sd, LinearMap(name, address)
            )
            continue
        element = _element(limb, entry.of)
        place, name = limb.placements[element], f"{label}.{axis}"
        nominal = float((place[:3, :3].T @ place[:3, 3])["xyz".index(axis)])
        errors += single_error(
            name, Dimension.LENGTH, nominal, sd, *map_displacement(name, limb, element, axis)
        )
    return errors


def _check_rod(limb: PlacedLimb, entry: Shifts) -> None:
    if limb.limb.ending != "distance" or entry.of != "rod":
        raise MechanismError(
            f"{limb.name!r}: 'length' belongs to a rod; write 'of: rod' in a limb that ends in a "
            "distance"
        )


def _tilts(limb: PlacedLimb, entry: Tilts) -> ErrorModel:
    """Return the unknown angles of a limb."""
    sd, errors = standard_deviation(entry.tolerance, f"{limb.name} {entry.of}"), ErrorModel()
    element = _element(limb, entry.of)
    for axis in entry.tilt:
        name = f"{limb.name}.{entry.name or entry.of}.{axis}"
        maps = (
            map_slide_tilt(name, limb, element, axis)
            if entry.alone
            else map_displacement(name, limb, element, axis)
        )
        errors += single_error(name, Dimension.ANGLE, 0.0, sd, *maps)
    return errors


def _element(limb: PlacedLimb, name: str) -> str:
    """Return the link of a limb by name; a joint of several axes means its first.

    Raises
    ------
    MechanismError
        No such link; lists the existing ones.
    """
    for candidate in (name, f"{name}.1", f"{name}.turn"):
        if candidate in limb.elements:
            return candidate
    raise MechanismError(f"limb {limb.name!r} has no {name!r}; it has {', '.join(limb.elements)}")


def _named(
    named: NamedParameter,
    members: dict[str, tuple[_Member, ...]],
    drives: Mapping[str, tuple[Drive, bool]],
) -> ErrorModel:
    """Return a named parameter with its maps."""
    if isinstance(named, NamedLength):
        nominal = named.length
    else:
        nominal = named.angle if isinstance(named, NamedAngle) else named.ratio
    maps = [linear for entry in named.maps for linear in _map_entry(named, entry, members, drives)]
    sd = standard_deviation(named.tolerance, named.name)
    return single_error(named.name, find_dimension(named), nominal, sd, *maps)


def _map_entry(
    named: NamedParameter,
    entry: MapEntry,
    members: dict[str, tuple[_Member, ...]],
    drives: Mapping[str, tuple[Drive, bool]],
) -> Iterator[LinearMap]:
    """Yield the maps of one entry, for every copy that it means."""
    name, (axis, coefficient) = named.name, find_engine_axis(named.name, entry)
    if entry.limb in drives:
        check_units(named, entry, drives[entry.limb])
        yield LinearMap(name, Address(entry.limb, entry.element, axis), coefficient)
        return
    chosen = members.get(entry.limb) or tuple(
        m for ms in members.values() for m in ms if m.placed.name == entry.limb
    )
    if not chosen:
        known = ", ".join((*members, *sorted(drives)))
        raise MechanismError(
            f"parameter {name!r} is mapped onto {entry.limb!r}, which is not there; known are "
            f"{known}"
        )
    check_units(named, entry, None)
    for member in chosen:
        if axis in AXES:
            yield from map_displacement(
                name, member.placed, _element(member.placed, entry.element), axis, coefficient
            )
        else:
            yield LinearMap(name, Address(member.placed.name, entry.element, axis), coefficient)


def _plain(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z
