# SPDX-License-Identifier: Apache-2.0
"""The generic description of a mechanism: limbs, actuators, parameters and their maps.

Every family expands into an `Assembly`; `compilation.build` compiles it for the engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.errors import MechanismError
from loopcal.parameters import CommonError, Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension

AXES = ("rx", "ry", "rz", "x", "y", "z")
# Axes of a displacement in a link's own frame. `pitch` and `length` can be displaced too.
TWIST_UNITS = ("rad", "rad", "rad", "m", "m", "m")

BASE, PLATFORM = "base", "platform"
ALONG = 1e-9  # component of an axis below which it is across
"""Names of the base, also of a chain of stages, and of the platform."""

MOST_LIMBS, MOST_JOINTS, MOST_ACTUATORS, MOST_PARAMETERS = 100, 50, 200, 2000
"""Largest numbers of limbs, joints of one limb, actuators and parameters."""

MOST_COPIES = 100  # largest number of copies of one limb


@dataclass(frozen=True, eq=False)
class Link:
    """A link transform (4, 4) [m] from coordinates behind the link to those before it; the joint
    behind it moves along or about its z axis.
    """

    name: str
    transform: FloatArray


@dataclass(frozen=True)
class Joint:
    """A joint about (R) or along (P) the z axis of the link before it.

    name : unique in its limb. kind : R or P. actuator : name of its drive, None if passive.
    pitch : advance per turn angle of a screw [m/rad], R only.
    start : first guess of the home position [m or rad]; it selects the working mode.
    limits : allowed values (low, high) [m or rad]. is_passive : no reading states its value;
        its `actuator` is a name in couplings and sums only.
    """

    name: str
    kind: str
    actuator: str | None = None
    pitch: float = 0.0
    start: float = 0.0
    limits: tuple[float, float] | None = None
    is_passive: bool = False

    @property
    def dimension(self) -> Dimension:
        """Dimension of its value."""
        return Dimension.ANGLE if self.kind == "R" else Dimension.LENGTH


class Cone(NamedTuple):
    """Allowed inclination of a rod at one of its ends: at most `angle` [rad] from `axis` (3,).

    `end` is `tip` (axis in the frame of the chain's tip, rod pointing to the platform) or
    `attachment` (axis in the frame of the attachment, rod pointing to the tip).
    """

    end: str
    axis: tuple[float, float, float]
    angle: float


@dataclass(frozen=True, eq=False)
class Limb:
    """A serial chain between two bodies: link, joint, link, ..., link, ending, attachment.

    links : one more than joints. ending : rigid, ball or distance. attachment : on the body at its
        end, in the frame of that body.
    length : nominal length of the rod of a `distance` ending at joint value zero [m].
    actuator : drive of that length, None for a rod of fixed length.
    cones : allowed inclinations of the rod. on, to : the bodies at which it begins and ends.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    ending: str
    attachment: Link
    length: float = 0.0
    actuator: str | None = None
    cones: tuple[Cone, ...] = ()
    on: str = BASE
    to: str = PLATFORM

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the actuators that drive this limb."""
        return tuple(name for name in (*(j.actuator for j in self.joints), self.actuator) if name)


@dataclass(frozen=True)
class Address:
    """A number that parameters can change.

    `owner` is a limb or an actuator; `element` a link or joint of the limb, `rod`, or
    `transmission`; `axis` one of AXES, `pitch`, `length`, or a term (see
    `loopcal.mechanism.transmission`).
    """

    owner: str
    element: str
    axis: str

    def __str__(self) -> str:
        return f"{self.owner}/{self.element}/{self.axis}"


@dataclass(frozen=True)
class LinearMap:
    """Map of a parameter onto an address: displacement += coefficient * (value - nominal)."""

    parameter: str
    address: Address
    coefficient: float = 1.0


@dataclass(frozen=True)
class SharedMap:
    """Smooth map of several parameters onto several addresses, such as delta radius and angle.

    inputs : names of the i parameters. outputs : the o addresses.
    """

    inputs: tuple[str, ...]
    outputs: tuple[Address, ...]

    def value(self, inputs: FloatArray) -> FloatArray:
        """Map (.., i) to (.., o); its change from the nominal value is the displacement."""
        raise NotImplementedError

    def jacobian(self, inputs: FloatArray) -> FloatArray:
        """Return the derivative (.., o, i) at inputs (.., i)."""
        raise NotImplementedError


@dataclass(frozen=True)
class Actuator:
    """A drive with a reading.

    name : column of the readings. dimension : of the reading. stroke : allowed readings (low, high)
        [m or rad].
    terms : nominal transmission from reading to joint value, by name of the term; without terms
        the joint value is the reading.
        A drive with a `compliance` [m/N, rad/Nm] has its load as a condition.
    period : reading per turn of the source of the harmonics [m or rad], 0 for none.
    sigma : standard deviation of the reading, weighs redundant readings [m or rad].
    weights : of a summed drive, by the name of a driven joint: the transmission gives the sum of
        weight * joint value. Without them it gives the value of the joint of its own name.
    points : readings of its table, whose values are the terms table1, table2, ..; between them it
        is `linear` or `cubic`.
    column : of a coupling, the name of the condition that it has as its reading, "" for none; None
        of a drive, which reads its own name.
    reference : of a condition, a reading such as a temperature that is never commanded, its value
        in inverse kinematics; None for others.
    """

    name: str
    dimension: Dimension
    stroke: tuple[float, float] | None = None
    terms: Mapping[str, float] = field(default_factory=dict)
    period: float = 0.0
    sigma: float | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    points: tuple[float, ...] = ()
    interpolation: str = "linear"
    column: str | None = None
    reference: float | None = None

    @property
    def driven_joints(self) -> tuple[str, ...]:
        """Names of the driven joints that it reads: its own, or those of its sum."""
        if self.reference is not None:
            return ()
        return tuple(self.weights) or (self.name,)

    @property
    def is_triangle(self) -> bool:
        """Whether it turns its joint through two anchors, so that it reads no joint value."""
        return "side" in self.terms


@dataclass(frozen=True)
class Load:
    """What acts on the platform from outside.

    wrench : force [N] and moment [Nm], FORCES. ranges : of these, from which simulations draw.
    stated : components that the robot file names, so that measurement files have them.
    of_platform : whether their axes are those of the platform, not those of the base. at : where
        the force acts and about what the moment is, in the platform [m].
    """

    wrench: tuple[float, ...] = (0.0,) * 6
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict, hash=False)
    stated: tuple[str, ...] = ()
    of_platform: bool = False
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)


# Names of the components of a wrench.
FORCES = tuple(f"{what}.{axis}" for what in ("force", "moment") for axis in "xyz")


@dataclass(frozen=True, eq=False)
class Assembly:
    """A mechanism as the `expand` method of a family returns it.

    name, source : for people. limbs, actuators : in the order of readings and tables; conditions
        are the last actuators.
    freedoms : those of the platform, of AXES in base axes. controlled : coordinates in which the
        machine is commanded.
    home : (4, 4) T_base_platform of the home pose; only its controlled coordinates must be exact.
    tool : (4, 4) T_platform_tool. workspace : coordinate -> (low, high) [m, rad].
    parameters, maps, shared : the unknowns and their maps.
    stored_parameters : names of the parameters that the controller stores; empty if not known.
    common_errors : errors that several parameters share.
    stages : of a chain, each after the one that it is attached to; the fields above are those of
        all stages together, with the name of the stage before those of limbs and parameters.
    closure : of over-constrained loops, `exact` or `least-squares`.
    bodies : name -> first guess (4, 4) of the home pose in the base, of each body beside base and
        platform that limbs join.
    held : of a chain, the actuators that inverse kinematics leaves at their present readings.
    couplings : rows of driven joints beside those of actuators, without a reading of their own.
    load : on the end platform.
    """

    name: str
    limbs: tuple[Limb, ...]
    actuators: tuple[Actuator, ...]
    freedoms: tuple[str, ...]
    controlled: tuple[str, ...]
    home: FloatArray
    parameters: tuple[Parameter, ...]
    maps: tuple[LinearMap, ...]
    shared: tuple[SharedMap, ...] = ()
    tool: FloatArray = field(default_factory=lambda: np.eye(4))
    workspace: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    source: str = ""
    stored_parameters: tuple[str, ...] = ()
    common_errors: tuple[CommonError, ...] = ()
    stages: tuple[AttachedStage, ...] = ()
    closure: str = "exact"
    bodies: Mapping[str, FloatArray] = field(default_factory=dict)
    held: tuple[str, ...] = ()
    couplings: tuple[Actuator, ...] = ()
    load: Load = field(default_factory=Load)

    @cached_property
    def rows(self) -> tuple[Actuator, ...]:
        """The rows that determine the driven joints: commanded actuators, then couplings."""
        if self.stages:
            return tuple(row for stage in self.stages for row in stage.assembly.rows)
        return (*(a for a in self.actuators if a.reference is None), *self.couplings)

    @cached_property
    def numbers(self) -> Mapping[str, int]:
        """The number of each body, as an engine knows it."""
        names = (BASE, PLATFORM, *self.bodies)
        return {name: number for number, name in enumerate(names, engine.BASE)}

    @cached_property
    def freedoms_of_bodies(self) -> tuple[str, ...]:
        """Those of the platform and of the joints of rigid limbs at bodies: a crank turns, even if
        the platform does not. Axes in the base with every joint at zero; two rotations about
        different axes lead to a third one, and a rotation moves points of a machine that shifts.
        """
        at_home = {BASE: np.eye(4), PLATFORM: self.home, **self.bodies}
        moves = np.array([axis in self.freedoms for axis in AXES])
        for limb in self.limbs:
            T = at_home[limb.on]
            if limb.ending == "rigid" and not self.bodies.keys().isdisjoint((limb.on, limb.to)):
                for link, joint in zip(limb.links, limb.joints, strict=False):
                    T = T @ link.transform
                    along = np.abs(T[:3, 2]) > ALONG
                    turns = along if joint.kind == "R" else np.zeros(3, bool)
                    across = (turns.any() & ~turns | (turns.sum() > 1)) & moves[3:].any()
                    moves |= np.concatenate([turns, across | (along & ~turns)])
        moves |= moves[:3].sum() == 2
        return tuple(axis for axis, moved in zip(AXES, moves, strict=True) if moved)

    def select_rows(self, limb: Limb) -> tuple[int, ...]:
        """Return the closure rows of a limb, in the freedoms of what it joins."""
        is_inner = not self.bodies.keys().isdisjoint((limb.on, limb.to))
        return select_rows(limb.ending, self.freedoms_of_bodies if is_inner else self.freedoms)

    @cached_property
    def driven_joints(self) -> tuple[str, ...]:
        """Names of the driven joints: those of the actuators, of sums and couplings theirs."""
        return tuple(dict.fromkeys(name for a in self.rows for name in a.driven_joints))

    @cached_property
    def turning_drives(self) -> frozenset[str | None]:
        """Names of the drives, and of coupled joints, that turn a joint."""
        return frozenset(j.actuator for limb in self.limbs for j in limb.joints if j.kind == "R")

    @cached_property
    def passive_joints(self) -> tuple[tuple[Limb, Joint], ...]:
        """Joints whose value is no reading, with their limbs: passive ones, also in couplings, and
        pins of triangles that a linear actuator turns.
        """
        read = {name for a in self.rows if not a.is_triangle for name in a.driven_joints}
        pairs = ((limb, joint) for limb in self.limbs for joint in limb.joints)
        return tuple(
            (limb, joint) for limb, joint in pairs if joint.is_passive or joint.actuator not in read
        )

    @cached_property
    def limb_by_parameter(self) -> Mapping[str, str]:
        """The limb that each parameter changes, by name; without those that change several."""
        limb_of = {drive: limb.name for limb in reversed(self.limbs) for drive in limb.drives}
        limb_of |= {limb.name: limb.name for limb in self.limbs}
        owners: dict[str, set[str]] = {}
        for actuator in self.rows:
            # the terms of a sum belong to the limbs of its joints
            limbs = {limb_of[name] for name in actuator.driven_joints}
            limb_of.setdefault(actuator.name, next(iter(limbs)) if len(limbs) == 1 else "")
        for entry in self.maps:
            owners.setdefault(entry.parameter, set()).add(limb_of[entry.address.owner])
        for shared in self.shared:
            limbs = {limb_of[address.owner] for address in shared.outputs}
            for name in shared.inputs:
                owners.setdefault(name, set()).update(limbs)
        single = {name: next(iter(limbs)) for name, limbs in owners.items() if len(limbs) == 1}
        return {name: limb for name, limb in single.items() if limb}


@dataclass(frozen=True, eq=False)
class AttachedStage:
    """A stage of a chain: an assembly whose base is attached to the platform of another stage.

    name : unique in the chain. on : name of that other stage, BASE for the base of the chain.
    mount : (4, 4) T_platform_base, from the base of this stage to the platform of the other [m].
    assembly : of this stage alone, with its own names.
    """

    name: str
    on: str
    mount: FloatArray
    assembly: Assembly


def is_serial(assembly: Assembly) -> bool:
    """Return whether the pose is the product of driven joints: one limb without passive joints, or
    couplings.
    """
    if assembly.stages or assembly.bodies or assembly.couplings or len(assembly.limbs) != 1:
        return False
    if len(assembly.freedoms) < len(AXES):
        return False
    (limb,) = assembly.limbs
    return limb.ending == "rigid" and all(joint.actuator for joint in limb.joints)


def refuse_more(most: int, count: int, subject: str, noun: str) -> None:
    """Raise MechanismError where `count` is above `most`: `subject count noun`."""
    if count > most:
        raise MechanismError(f"{subject} {count} {noun}. Allowed: at most {most}")


def select_rows(ending: str, freedoms: tuple[str, ...]) -> tuple[int, ...]:
    """Return the rows of an ending in these freedoms, such as those of a plane."""
    if ending == "distance":
        return (0,)
    axes = AXES if ending == "rigid" else AXES[3:]
    return tuple(i for i, axis in enumerate(axes) if axis in freedoms)
