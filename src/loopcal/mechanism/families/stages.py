# SPDX-License-Identifier: Apache-2.0
"""Chains of stages: serial joints and closed loops, each on the platform of another stage.

A stage is a serial joint (`joint:`) or a robot of any other family (`family:` and its keys). Its
base is the platform of the stage before it, or of the stage that `on:` names, moved by `mount:`.
How to write such a file: docs/robots.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import (
    AXES,
    BASE,
    FORCES,
    PLATFORM,
    Actuator,
    Address,
    Assembly,
    AttachedStage,
    Joint,
    Limb,
    LinearMap,
)
from loopcal.mechanism.families import placement
from loopcal.mechanism.families.drives import (
    Drive,
    LoadFrame,
    NamedTriangleDrive,
    StrokeError,
    list_conditions,
    place_rows,
    refuse_idle_drives,
    row_errors,
)
from loopcal.mechanism.families.limbs import (
    ORIGIN,
    Axis,
    Place,
    axis_vector,
    follow_rigid_limbs,
    matrix_from_place,
)
from loopcal.mechanism.families.records import RobotRecord
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Given, Ratio

# The assembly of a chain: those of its stages, with the stage before each name.


class StageError(placement.RecordError):
    """An impossible stage of a chain; `index` is its place in the list of stages."""

    def __init__(self, sentence: str, index: int) -> None:
        super().__init__(sentence, "stages", index)


def check_stage_names(names: Sequence[str], parents: Sequence[str | None]) -> list[str]:
    """Return what each stage is on: BASE, or an earlier stage; None stands for the previous one."""
    if not names:
        raise StageError(
            "the list of stages is empty. List the coordinates of the chain, from the base on", 0
        )
    previous = [BASE, *names]
    stated = [previous[i] if on is None else on for i, on in enumerate(parents)]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise StageError(f"two stages have the name {name!r}. Give each its own name", i)
        if name == BASE or "." in name or ":" in name or not name:
            raise StageError(
                f"a stage cannot have the name {name!r}. Choose a name without a point or colon, "
                f"other than {BASE!r}",
                i,
            )
    for i, (name, on) in enumerate(zip(names, stated, strict=True)):
        if on not in previous:
            raise StageError(
                f"stage {name!r} is on {on!r}, which is not a stage"
                f"{suggest_names(on, names[:i])}. Allowed: {', '.join((BASE, *names[:i]))}",
                i,
            )
        if on in names[i:]:
            raise StageError(
                f"stage {name!r} is on {on!r}, which is not an earlier stage. Attach it to "
                f"{BASE!r} or to an earlier one, or list {on!r} first",
                i,
            )
    return stated


def join_stages(record: Stages, stages: Sequence[AttachedStage]) -> Assembly:
    """Return the assembly of a chain; its home is found when it is compiled."""
    _refuse_wrong_drives(stages, is_coupled=bool(record.couplings))
    parts = [_add_prefix(stage.name, stage.assembly) for stage in stages]
    joined: dict[str, Any] = {
        name: tuple(item for part in parts for item in getattr(part, name))
        for name in (
            *("limbs", "actuators", "couplings", "parameters", "maps", "shared"),
            *("stored_parameters", "common_errors"),
        )
    }
    return Assembly(
        record.name,
        freedoms=AXES,
        controlled=record.controlled,
        home=stages[-1].mount,
        tool=record.tool.matrix,
        workspace=record.workspace.ranges,
        source=record.source,
        stages=tuple(stages),
        held=record.held,
        **joined,
    )


def couple_stages(record: Stages, chain: Assembly) -> Assembly:
    """Return the assembly of a chain with couplings between its stages as one of limbs, whose
    bodies are the platforms of its stages; raises StageError for one whose limbs are not rigid and
    which has fewer than six freedoms.
    """
    known, limbs, rest = {BASE: np.eye(4)}, list[Limb](), list(chain.limbs)
    for i, stage in enumerate(chain.stages):
        own, is_last = stage.assembly, i + 1 == len(chain.stages)
        is_rigid = all(limb.ending == "rigid" for limb in own.limbs)
        if len(own.freedoms) < len(AXES) and not is_rigid:
            raise StageError(
                f"stage {stage.name!r} has the freedoms {', '.join(own.freedoms)}. In a chain with "
                "couplings, end its limbs rigid, which hold the others",
                i,
            )
        names = {body: f"{stage.name}.{body}" for body in own.bodies}
        names |= {BASE: stage.on, PLATFORM: PLATFORM if is_last else stage.name}
        moved = [_mount_limb(limb, names, stage.mount) for limb in rest[: len(own.limbs)]]
        if own.controlled:
            base = known[stage.on] @ stage.mount
            homes = {**own.bodies, PLATFORM: own.home}
            known |= {names[body]: base @ home for body, home in homes.items()}
        follow_rigid_limbs(known, moved)
        limbs, rest = limbs + moved, rest[len(own.limbs) :]
    conditions = {name: of for name, of in record.conditions.items() if name not in FORCES}
    placed = [
        placement.PlacedLimb(
            limb, {j.name: np.eye(3) for j in limb.joints}, {}, placement.strip_number(limb.name)
        )
        for limb in limbs
    ]
    placed, _, rows = place_rows(placed, {}, (), record.couplings, conditions)
    errors = placement.join_errors(map(row_errors, rows.values()))
    return replace(
        chain,
        limbs=tuple(limb.limb for limb in placed),
        actuators=(*chain.actuators, *list_conditions(conditions)),
        home=known.pop(PLATFORM),
        parameters=chain.parameters + errors.parameters,
        maps=chain.maps + errors.maps,
        stages=(),
        bodies={name: T for name, T in known.items() if name != BASE},
        couplings=(*chain.couplings, *(row.actuator for row in rows.values())),
    )


def _mount_limb(limb: Limb, names: Mapping[str, str], mount: FloatArray) -> Limb:
    """Return a limb of a stage between bodies of a chain; names : body of the stage -> of it."""
    links = limb.links, (limb.attachment,)
    (first, *others), (last,) = (
        [replace(own[0], transform=mount @ own[0].transform), *own[1:]] if end == BASE else own
        for own, end in zip(links, (limb.on, limb.to), strict=True)
    )
    ends = {"on": names[limb.on], "to": names[limb.to]}
    return replace(limb, links=(first, *others), attachment=last, **ends)


def _add_prefix(stage: str, part: Assembly) -> Assembly:
    """Return an assembly with the stage before the names of limbs and parameters; actuators and
    couplings keep theirs.
    """
    rows = {row.name for row in part.rows}

    def name(own: str) -> str:
        return f"{stage}.{own}"

    def rename(address: Address) -> Address:
        is_row = address.element == "transmission" and address.owner in rows
        return address if is_row else replace(address, owner=name(address.owner))

    return replace(
        part,
        limbs=tuple(replace(limb, name=name(limb.name)) for limb in part.limbs),
        parameters=tuple(replace(p, name=name(p.name)) for p in part.parameters),
        maps=tuple(
            replace(entry, parameter=name(entry.parameter), address=rename(entry.address))
            for entry in part.maps
        ),
        shared=tuple(
            replace(of, inputs=tuple(map(name, of.inputs)), outputs=tuple(map(rename, of.outputs)))
            for of in part.shared
        ),
        stored_parameters=tuple(map(name, part.stored_parameters)),
        common_errors=tuple(
            replace(error, name=name(error.name), parameters=tuple(map(name, error.parameters)))
            for error in part.common_errors
        ),
    )


def _refuse_wrong_drives(stages: Sequence[AttachedStage], is_coupled: bool) -> None:
    """Raise StageError for a stage without actuators, unless couplings move it, and for an actuator
    of two stages.
    """
    owner: dict[str, str] = {}
    for i, stage in enumerate(stages):
        if not (stage.assembly.actuators or is_coupled):
            raise StageError(
                f"stage {stage.name!r} has no actuators. Name the drive of one of its joints, or "
                "make it part of the mount of the next stage",
                i,
            )
        rows = (*stage.assembly.actuators, *stage.assembly.couplings)
        own = dict.fromkeys(name for row in rows for name in (row.name, *row.driven_joints))
        for drive in own:
            if drive in owner:
                raise StageError(
                    f"actuator {drive!r} drives the stages {owner[drive]!r} and {stage.name!r}. "
                    "Give each stage its own drives, or one `drive: none` and a coupling",
                    i,
                )
        owner |= dict.fromkeys(own, stage.name)


JointError = Literal[placement.Freedom, "offset", "gain"]
LIMB, LINK, PASSIVE = "serial", "joint", "none"
"""Names of the limb and of the joint of a serial stage, and of no drive."""


@dataclass(frozen=True, kw_only=True)
class SerialJoint:
    """What every serial joint can state.

    at : its place on the platform that carries it. axis : direction in the placed frame.
    tip : platform of this stage in the placed frame, at joint value zero.
    start : reading at home, with a triangle the angle of the joint. stroke : allowed readings.
    gain : joint value per reading.
    sigma : standard deviation of the reading.
    errors : its unknowns: displacements of the placed frame, the `offset` of the joint, its `gain`.
    platform_errors : unknown displacements of the platform of this stage.
    length, angle, ratio : expected spreads of these unknowns.
    """

    GIVEN: ClassVar[Dimension] = Dimension.LENGTH

    at: Place = ORIGIN
    axis: Axis = "z"
    tip: Place = ORIGIN
    start: Given = 0.0
    stroke: tuple[Given, Given] | None = None
    gain: Ratio = 1.0
    sigma: Given | None = None
    errors: tuple[JointError, ...] = ()
    platform_errors: tuple[placement.Freedom, ...] = ()
    length: placement.LengthTolerance | None = None
    angle: placement.AngleTolerance | None = None
    ratio: placement.RatioTolerance | None = None


@dataclass(frozen=True, kw_only=True)
class SerialRotation(SerialJoint):
    """A driven rotary joint as a separate stage.

    drive : name of its actuator (default: of the stage), or `none` of a joint that couplings move.
        Or a linear actuator that turns it, `{triangle: ..}`, which states its own stroke, gain,
        sigma and unknowns.
    """

    GIVEN: ClassVar[Dimension] = Dimension.ANGLE

    kind: Literal["R"]
    drive: str | NamedTriangleDrive = ""


@dataclass(frozen=True, kw_only=True)
class SerialSlide(SerialJoint):
    """A driven slide as a separate stage.

    drive : name of its actuator (default: of the stage), or `none` of a joint that couplings move.
    """

    kind: Literal["P"]
    drive: str = ""


@dataclass(frozen=True)
class StageRecord:
    """A stage: a serial joint, or a robot of another family with the keys of that family.

    on : the stage whose platform carries it, or `base`; default: the previous stage.
    mount : its base on that platform. joint : a serial joint. family : of any other stage.
    """

    OTHER_KEYS: ClassVar[bool] = True

    name: str
    on: str | None = None
    mount: placement.PoseRecord = field(default_factory=placement.PoseRecord)
    joint: SerialRotation | SerialSlide | None = None
    family: str | None = None


@dataclass(frozen=True)
class Stages(RobotRecord):
    """The file of a chain of stages.

    controlled : commanded coordinates of the end platform, one for each freedom that its actuators
        give it. held : actuators that inverse kinematics leaves at their present readings. stages :
        from the base on. The last one carries the end platform.
    tolerances : of the unknowns of serial joints without expected spreads of their own.
    """

    family = "stages"

    controlled: tuple[str, ...] = ()
    stages: tuple[StageRecord, ...] = ()
    held: tuple[str, ...] = ()
    tolerances: placement.LinkTolerances = field(default_factory=placement.LinkTolerances)

    def expand(self) -> Assembly:
        """Refuse: the robots of the stages are not known, see `PlacedStages`."""
        raise TypeError("a chain needs the records of its stages")


@dataclass(frozen=True)
class PlacedStages(Stages):
    """A chain with the records of its stages.

    robots : of every stage, None for a serial joint.
    """

    robots: tuple[RobotRecord | None, ...] = ()

    def expand(self) -> Assembly:
        """Return the assembly of all stages; raises StageError where they do not fit together."""
        is_coupled = bool(self.couplings) or any(name not in FORCES for name in self.conditions)
        for key, is_stated, remedy in (
            ("parameters", bool(self.parameters), "Give them in a stage that has a `family:`"),
            (
                "home",
                self.home != placement.PoseRecord(),
                "Give `start:` of a joint or `home:` of a stage",
            ),
        ):
            if is_stated:
                raise placement.RecordError(
                    f"{self.name} states `{key}:` of a whole chain. {remedy}", key
                )
        names = [stage.name for stage in self.stages]
        parents = check_stage_names(names, [stage.on for stage in self.stages])
        assemblies, strokes = list[Assembly](), dict[str, str]()
        for i in range(len(names)):
            try:
                assemblies.append(self._expand_stage(i))
            except StrokeError as error:  # those of all stages are reported at once
                strokes |= error.strokes
        if strokes:
            raise StrokeError(strokes)
        attached = tuple(
            AttachedStage(stage.name, on, stage.mount.matrix, own)
            for stage, on, own in zip(self.stages, parents, assemblies, strict=True)
        )
        actuators = [a.name for stage in attached for a in stage.assembly.actuators]
        refuse_idle_drives(self.drives, actuators, map(placement.strip_number, actuators))
        chain = join_stages(self, attached)
        return couple_stages(self, chain) if is_coupled else chain

    def _expand_stage(self, i: int) -> Assembly:
        """Return the assembly of a stage alone."""
        stage, robot = self.stages[i], self.robots[i]
        if stage.joint is not None:
            joint = replace(
                stage.joint,
                length=stage.joint.length or self.tolerances.lengths,
                angle=stage.joint.angle or self.tolerances.angles,
            )
            return expand_joint(stage.name, joint, self.drives)
        assert robot is not None
        is_loaded = robot.load != LoadFrame() or any(name in FORCES for name in robot.conditions)
        for key, is_stated, remedy in (
            ("tool", robot.tool != placement.PoseRecord(), "or as the mount of the next stage"),
            ("load", is_loaded, "whose end platform it acts on"),
        ):
            if is_stated:
                sentence = f"stage {stage.name!r} states a {key}. Give it for the whole robot"
                raise StageError(f"{sentence}, {remedy}", i)
        try:
            own = robot.assembly()
            drives = _select_drives(self.drives, [actuator.name for actuator in own.actuators])
            return replace(robot, drives={**drives, **robot.drives}).assembly() if drives else own
        except StrokeError:
            raise
        except MechanismError as error:
            raise StageError(f"stage {stage.name!r}: {error}", i) from None


def _select_drives(drives: Mapping[str, Drive], names: Sequence[str]) -> dict[str, Drive]:
    """Return those of the stated drives that mean one of these actuators."""
    meant = {*names, *map(placement.strip_number, names)}
    return {name: drive for name, drive in drives.items() if name in meant}


def expand_joint(
    name: str, record: SerialRotation | SerialSlide, drives: Mapping[str, Drive]
) -> Assembly:
    """Return the assembly of a serial joint: one rigid limb with one driven joint. drives : what
    the file states of it.
    """
    triangle = record.drive if isinstance(record.drive, NamedTriangleDrive) else None
    drive = (triangle.name if triangle else record.drive) or name
    assert isinstance(drive, str)
    if triangle is not None:
        _refuse_terms_beside_triangle(record, drive)
    is_passive = record.drive == PASSIVE
    joint = Joint(
        LINK, record.kind, None if is_passive else drive, start=record.gain * record.start
    )
    step = placement.JointPlacement(joint, matrix_from_place(record.at), axis_vector(record.axis))
    limb = placement.place_limb(LIMB, (step,), matrix_from_place(record.tip), "rigid", np.eye(4))
    own = Actuator(drive, record.GIVEN, record.stroke, {"gain": record.gain}, sigma=record.sigma)
    stated = _select_drives(drives, [drive])
    if triangle is not None and stated:
        raise placement.RecordError(
            f"the drive {drive!r} appears twice, at its joint and under `drives:`. Leave one out",
            "drives",
            drive,
        )
    if is_passive and not {"offset", "gain"}.isdisjoint(record.errors):
        raise MechanismError(f"the joint has no drive, and so no {' or '.join(record.errors)}")
    robot = RobotRecord(name, drives={drive: triangle} if triangle else stated)
    errors = placement.join_errors(
        _joint_error(record, limb, drive, error) for error in record.errors
    )
    of_platform = placement.join_errors(
        placement.displacement_error(
            f"platform.{axis}", limb, "platform", axis, _tolerance(record, axis)
        )
        for axis in record.platform_errors
    )
    return robot.assemble(
        [limb], errors, freedoms=AXES, controlled=(), own=[own], later=of_platform
    )


def _refuse_terms_beside_triangle(record: SerialRotation | SerialSlide, drive: str) -> None:
    """Refuse what a triangle drive states itself; raises MechanismError."""
    plain, keys = SerialRotation(kind="R"), ("stroke", "gain", "sigma")
    stated = {key: getattr(record, key) != getattr(plain, key) for key in keys}
    stated |= {f"errors: [{key}]": key in record.errors for key in ("offset", "gain")}
    for key, is_stated in stated.items():
        if is_stated:
            raise MechanismError(
                f"the joint has '{key}' besides the triangle of drive {drive!r}, whose readings "
                "are lengths. Give it in the drive"
                + (" under 'unknown'" if key.startswith("errors") else "")
            )


def _joint_error(
    record: SerialRotation | SerialSlide, limb: placement.PlacedLimb, drive: str, error: str
) -> placement.ErrorModel:
    """Return one unknown of a serial joint."""
    if error == "gain":
        gain = LinearMap(error, Address(drive, "transmission", error))
        sd = placement.standard_deviation(record.ratio, error)
        return placement.single_error(error, Dimension.RATIO, record.gain, sd, gain, positive=True)
    if error == "offset":
        return placement.offset_error(error, drive, record.GIVEN, 0.0, _tolerance(record, error))
    return placement.displacement_error(error, limb, LINK, error, _tolerance(record, error))


def _tolerance(record: SerialRotation | SerialSlide, error: str) -> float | None:
    """Return the tolerance of an unknown of a serial joint that is a length or an angle."""
    dimension = placement.get_axis_dimension(error) if error in AXES else record.GIVEN
    return placement.standard_deviation(getattr(record, dimension.value), error)
