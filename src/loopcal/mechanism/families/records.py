# SPDX-License-Identifier: Apache-2.0
"""Records that the robot files of all families share: pose, tolerances, workspace, base record.

Numbers are in SI; `loopcal.io` converts them from the units of the file, by the annotations here.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import (
    AXES,
    BASE,
    PLATFORM,
    Actuator,
    Address,
    Assembly,
    Cone,
    Joint,
    Limb,
    LinearMap,
    Link,
    SharedMap,
)
from loopcal.parameters import CommonError, Parameter
from loopcal.typing import FloatArray
from loopcal.units import SD_RANGE, Angle, Dimension, Length, Ratio, is_sd

# Limbs with joints about any axis, placed one after the other, in the form of the engine.

EX, EY, EZ = np.eye(3)


class RecordError(MechanismError):
    """An impossible content of a robot file; `location` is the path of keys to it."""

    def __init__(self, sentence: str, *location: str | int) -> None:
        super().__init__(sentence)
        self.location = location


@dataclass(frozen=True, eq=False)
class JointPlacement:
    """A joint of a limb, and where it is; the link before it has its name.

    Attributes
    ----------
    place : (4, 4) of the joint in the frame carried up to it [m].
    axis : (3,) in the placed frame, of any length but zero.
    """

    joint: Joint
    place: FloatArray
    axis: FloatArray


class PlacedLimb(NamedTuple):
    """A limb for the engine, with the frames in which its file is written.

    Attributes
    ----------
    rotations : name of a link -> (3, 3) R_carried_link, from the link's axes to the carried ones.
    placements : name of a link -> (4, 4) its placement in the frame carried before it [m].
    """

    limb: Limb
    rotations: Mapping[str, FloatArray]
    placements: Mapping[str, FloatArray]

    @property
    def name(self) -> str:
        """Name of the limb."""
        return self.limb.name

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the links from base to tip, then of the attachment."""
        return (*(link.name for link in self.limb.links), self.limb.attachment.name)


def place_limb(
    name: str,
    steps: tuple[JointPlacement, ...],
    tip: FloatArray,
    ending: str,
    attachment: FloatArray,
    length: float = 0.0,
    actuator: str | None = None,
    cones: tuple[Cone, ...] = (),
    bodies: tuple[str, str] = (BASE, PLATFORM),
) -> PlacedLimb:
    """Return a limb of its joints from one body to its tip, its tip and its attachment to another.

    tip : (4, 4) in the last carried frame [m]; its link is called `tip`, without joints like the
        first body. attachment : (4, 4) in the second body [m]; its link is called like that body.
    length, actuator, cones : of the rod of a `distance` ending [m].
    """
    back, links, rotations, placements = np.eye(4), [], {}, {}
    for step in steps:
        link, turn = step.joint.name, frame_from_axis(step.axis, step.joint.name)
        links.append(Link(link, back @ step.place @ rotation_matrix(turn)))
        rotations[link], placements[link] = turn, step.place
        back = rotation_matrix(turn.T)
    last, end = "tip" if steps else bodies[0], Link(bodies[1], attachment)
    links.append(Link(last, back @ tip))
    rotations |= {last: np.eye(3), end.name: np.eye(3)}
    placements |= {last: tip, end.name: attachment}
    joints = tuple(step.joint for step in steps)
    limb = Limb(name, tuple(links), joints, ending, end, length, actuator, cones)
    return PlacedLimb(limb, rotations, placements)


def place_limb_with_ball(
    name: str,
    steps: tuple[JointPlacement, ...],
    center: FloatArray,
    attachment: FloatArray,
    axes: FloatArray | None,
) -> PlacedLimb:
    """Return a limb that ends in a ball at `center` (3,) of the last carried frame [m].

    axes : None for a perfect ball; one of three rotary joints z, y, x, with errors of their own,
        has the orientation (3, 3) at which they are all at zero.
    """
    if axes is None:
        return place_limb(name, steps, translate(*center), "ball", attachment)
    ball = tuple(
        JointPlacement(Joint(f"ball{i + 1}", "R"), place, axis)
        for i, (place, axis) in enumerate(
            ((geometry.make_pose(axes, center), EZ), (np.eye(4), EY), (np.eye(4), EX))
        )
    )
    return place_limb(name, (*steps, *ball), np.eye(4), "rigid", attachment)


def frame_from_axis(axis: FloatArray, name: str) -> FloatArray:
    """Return a rotation (3, 3) whose third column is along `axis`; x, y and z give a cyclic
    permutation.
    """
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise MechanismError(f"joint {name!r} has the axis [0, 0, 0]; state a direction")
    z = np.asarray(axis, dtype=float) / length
    # the cyclic successor of the largest component is never parallel to the axis
    across = np.eye(3)[(int(np.argmax(np.abs(z))) + 1) % 3]
    x = across - float(across @ z) * z
    x /= float(np.linalg.norm(x))
    return np.array([x, np.cross(z, x), z], dtype=float).T


def map_displacement(
    parameter: str, limb: PlacedLimb, element: str, axis: str, coefficient: float = 1.0
) -> tuple[LinearMap, ...]:
    """Map a parameter onto a translation along, or rotation about, an axis of the carried frame."""
    direction = coefficient * np.eye(3)[AXES.index(axis) % 3]
    return map_direction(parameter, limb, element, direction, turns=axis in AXES[:3])


def map_direction(
    parameter: str, limb: PlacedLimb, element: str, direction: FloatArray, *, turns: bool
) -> tuple[LinearMap, ...]:
    """Map a parameter onto a rotation about (or translation along) `direction` (3,) of the carried
    frame.
    """
    components = limb.rotations[element].T @ direction
    axes = AXES[:3] if turns else AXES[3:]
    # what is below rounding of a direction is no component
    return tuple(
        LinearMap(parameter, Address(limb.name, element, axis), float(part))
        for axis, part in zip(axes, components, strict=True)
        if abs(part) > 1e-12 * np.abs(components).max()
    )


def map_slide_tilt(
    parameter: str, limb: PlacedLimb, element: str, axis: str
) -> tuple[LinearMap, ...]:
    """Map a parameter onto the tilt of a slide's axis that does not rotate what slides on it.

    exp(w) A_j [slide] A_j^-1 P A_k exp(w') keeps the orientation P A_k if w' = -(P A_k)' w. The
    translation of what is placed off the slide is compensated to first order.
    """
    names = limb.elements
    place = names.index(element)
    if place >= len(limb.limb.joints) or limb.limb.joints[place].kind != "P":
        raise MechanismError(
            f"{parameter} tilts {element!r} of {limb.name!r} alone, which only a slide allows; "
            "leave out `alone: true`"
        )
    w, after = np.eye(3)[AXES.index(axis)], names[place + 1]
    behind = limb.placements[after]
    maps = map_displacement(parameter, limb, element, axis)
    maps += map_direction(parameter, limb, after, -behind[:3, :3].T @ w, turns=True)
    shift = -behind[:3, :3].T @ np.cross(w, behind[:3, 3])
    if shift.any():
        maps += map_direction(parameter, limb, after, shift, turns=False)
    return maps


def translate(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> FloatArray:
    """Return a translation (4, 4) [m]."""
    return geometry.make_pose(np.eye(3), np.array([x, y, z], dtype=float))


def rotation_matrix(rotation: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) as (4, 4)."""
    return geometry.make_pose(rotation, np.zeros(3))


def rotate_about(axis: str, angle: float) -> FloatArray:
    """Return a rotation (4, 4) about x, y or z [rad]."""
    return rotation_matrix(geometry.exp_so3(angle * np.eye(3)["xyz".index(axis)]))


# Error models: named parameters with their maps, by hand for `ideal`, by rule for `complete`.

KEPT_AXES: Mapping[str, tuple[str, ...]] = {"R": ("rx", "ry", "x", "y"), "P": ("rx", "ry")}
"""Displacements of a link that its joint does not repeat."""


@dataclass(frozen=True)
class ErrorModel:
    """Parameters with their maps; `+` joins two."""

    parameters: tuple[Parameter, ...] = ()
    maps: tuple[LinearMap, ...] = ()
    shared: tuple[SharedMap, ...] = ()

    def __add__(self, other: ErrorModel) -> ErrorModel:
        return join_errors((self, other))

    def without_effects_of(self, named: ErrorModel) -> ErrorModel:
        """Return these parameters without those whose effect `named` or earlier ones have already;
        where a name is taken, `.own` is appended.
        """
        addresses = dict.fromkeys(entry.address for entry in named.maps + self.maps)
        place = {address: i for i, address in enumerate(addresses)}
        taken, left = {p.name for p in named.parameters}, []
        basis = np.zeros((0, len(place)))
        for errors in (named, self):
            effects = {p.name: np.zeros(len(place)) for p in errors.parameters}
            for entry in errors.maps:
                effects[entry.parameter][place[entry.address]] += entry.coefficient
            for parameter in errors.parameters:
                effect = effects[parameter.name]
                rest = effect - (basis @ effect) @ basis
                if np.linalg.norm(rest) <= 1e-9 * np.linalg.norm(effect):
                    continue
                basis = np.vstack([basis, rest / np.linalg.norm(rest)])
                if errors is self:
                    suffix = ".own" if parameter.name in taken else ""
                    left.append(self._rename(parameter, parameter.name + suffix))
        return join_errors(left)

    def _rename(self, parameter: Parameter, name: str) -> ErrorModel:
        """Return one of the parameters, with its maps, under another name."""
        maps = (entry for entry in self.maps if entry.parameter == parameter.name)
        renamed = tuple(replace(entry, parameter=name) for entry in maps)
        return ErrorModel((replace(parameter, name=name),), renamed)


def join_errors(models: Iterable[ErrorModel]) -> ErrorModel:
    """Return all parameters and maps of error models."""
    joined = tuple(models)
    return ErrorModel(
        tuple(parameter for model in joined for parameter in model.parameters),
        tuple(entry for model in joined for entry in model.maps),
        tuple(entry for model in joined for entry in model.shared),
    )


class ErrorTolerances(NamedTuple):
    """Standard deviations of lengths and angles [m, rad]; None where none is stated."""

    length: float | None = None
    angle: float | None = None


def single_error(
    name: str,
    dimension: Dimension,
    nominal: float,
    tolerance: float | None,
    *maps: LinearMap,
    positive: bool = False,
) -> ErrorModel:
    """Return an error model of one named parameter; `positive` says that only values above zero
    exist, if the nominal one is.
    """
    has_sign = positive and nominal > 0.0
    parameter = Parameter(name, dimension, float(nominal), tolerance, positive=has_sign)
    return ErrorModel((parameter,), maps)


def displacement_error(
    name: str,
    limb: PlacedLimb,
    element: str,
    axis: str,
    tolerance: float | None,
    nominal: float = 0.0,
    positive: bool = False,
) -> ErrorModel:
    """Return a displacement of a link, of AXES in its carried frame, as a parameter."""
    maps = map_displacement(name, limb, element, axis)
    dimension = get_axis_dimension(axis)
    return single_error(name, dimension, nominal, tolerance, *maps, positive=positive)


def point_errors(limb: PlacedLimb, element: str, tolerance: float | None, label: str) -> ErrorModel:
    """Return the coordinates of a link's origin in the frame carried before it as parameters
    `limb.label.x`, `.y` and `.z`, of a placement that is not rotated.
    """
    point = limb.placements[element][:3, 3]
    return join_errors(
        displacement_error(f"{limb.name}.{label}.{axis}", limb, element, axis, tolerance, nominal)
        for axis, nominal in zip(AXES[3:], point, strict=True)
    )


def rod_length_error(limb: PlacedLimb, name: str, tolerance: float | None) -> ErrorModel:
    """Return the length of the rod of a `distance` ending at reading zero as a parameter."""
    rod = LinearMap(name, Address(limb.name, "rod", "length"))
    length = limb.limb.length
    return single_error(name, Dimension.LENGTH, length, tolerance, rod, positive=True)


def offset_error(
    name: str,
    actuator: str,
    dimension: Dimension,
    nominal: float,
    tolerance: float | None,
    positive: bool = False,
) -> ErrorModel:
    """Return the value of a driven joint at reading zero as a parameter."""
    offset = LinearMap(name, Address(actuator, "transmission", "offset"))
    return single_error(name, dimension, nominal, tolerance, offset, positive=positive)


def complete_errors(
    limb: PlacedLimb, spread: ErrorTolerances, offsets: bool = True, places_body: bool = False
) -> ErrorModel:
    """Return the complete error model of a limb; without `offsets` the family names those of the
    actuators. Errors of an attachment that `places_body` are none: they move the frame of the body.
    """
    errors: list[ErrorModel] = []

    def add_displacements(element: str, axes: Iterable[str]) -> None:
        for axis in axes:
            name, dimension = f"{limb.name}.{element}.{axis}", get_axis_dimension(axis)
            sd = spread.angle if dimension is Dimension.ANGLE else spread.length
            address = Address(limb.name, element, axis)
            errors.append(single_error(name, dimension, 0.0, sd, LinearMap(name, address)))

    def add_offset(drive: str | None, dimension: Dimension) -> None:
        if drive and offsets:
            sd = spread.angle if dimension is Dimension.ANGLE else spread.length
            errors.append(offset_error(f"{drive}.offset", drive, dimension, 0.0, sd))

    for joint in limb.limb.joints:
        add_displacements(joint.name, KEPT_AXES[joint.kind])
        add_offset(joint.actuator, joint.dimension)
    if limb.limb.ending != "rigid":
        add_displacements(limb.limb.links[-1].name, AXES[3:])
    if not places_body:
        end = limb.limb.attachment.name
        add_displacements(end, AXES if limb.limb.ending == "rigid" else AXES[3:])
    add_offset(limb.limb.actuator, Dimension.LENGTH)
    if limb.limb.ending == "distance" and not limb.limb.actuator:
        errors.append(rod_length_error(limb, f"{limb.name}.length", spread.length))
    return join_errors(errors)


def get_axis_dimension(axis: str) -> Dimension:
    """Return the dimension of a displacement along or about one of AXES."""
    return Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH


def check_spherical(name: str, spherical: str, error_model: str) -> None:
    """Refuse balls of three axes without errors; raises MechanismError."""
    if spherical == "axes" and error_model == "ideal":
        raise MechanismError(
            f"{name} states spherical: axes with error_model: ideal, whose parameters describe "
            "perfect points; state error_model: complete, or spherical: point"
        )


Point = tuple[Length, Length, Length]


@dataclass(frozen=True)
class PoseRecord:
    """Position and orientation R = Rz(yaw) Ry(pitch) Rx(roll), as a robot file states them.

    A file may state tilt-and-torsion phi, theta, psi in place of roll, pitch, yaw.
    """

    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0
    roll: Angle = 0.0
    pitch: Angle = 0.0
    yaw: Angle = 0.0

    @property
    def matrix(self) -> FloatArray:
        """Homogeneous matrix (4, 4)."""
        R = geometry.euler_to_matrix(np.array([self.roll, self.pitch, self.yaw]), "xyz")
        return geometry.make_pose(R, np.array([self.x, self.y, self.z]))


@dataclass(frozen=True)
class LengthTolerance:
    """Tolerance of a length: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    sd: Length | None = None
    limits: Length | None = None


@dataclass(frozen=True)
class AngleTolerance:
    """Tolerance of an angle: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    sd: Angle | None = None
    limits: Angle | None = None


@dataclass(frozen=True)
class RatioTolerance:
    """Tolerance of a ratio: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    sd: Ratio | None = None
    limits: Ratio | None = None


def standard_deviation(
    tolerance: LengthTolerance | AngleTolerance | RatioTolerance | None, name: str
) -> float | None:
    """Return the standard deviation of a tolerance [SI], None if none is stated; raises
    MechanismError.
    """
    if tolerance is None:
        return None
    if (tolerance.sd is None) == (tolerance.limits is None):
        raise MechanismError(
            f"the tolerance of {name} must state either sd or limits, not both or neither"
        )
    stated = tolerance.sd if tolerance.sd is not None else tolerance.limits or 0.0
    if not is_sd(stated):
        unit = {LengthTolerance: " m", AngleTolerance: " rad", RatioTolerance: ""}[type(tolerance)]
        raise MechanismError(
            f"the tolerance of {name} is {stated:g}{unit}; it must be greater than zero "
            f"({SD_RANGE}), or left out"
        )
    return float(stated if tolerance.sd is not None else stated / np.sqrt(3.0))


@dataclass(frozen=True)
class CommonErrorRecord:
    """An error that several parameters share in addition to their own, such as that of one batch.

    Attributes
    ----------
    name : of the common error. of : the parameters, by name or pattern, such as `arm*.length`.
    length, angle, ratio : the tolerance of the common error, by the dimension of the parameters.
    """

    name: str
    of: tuple[str, ...]
    length: LengthTolerance | None = None
    angle: AngleTolerance | None = None
    ratio: RatioTolerance | None = None

    def resolve(self, parameters: Sequence[Parameter]) -> CommonError:
        """Return the common error of the parameters that match; raises MechanismError for unlike
        parameters, a single one, or one without a tolerance of its own.
        """
        stated = {d: getattr(self, d.value) for d in Dimension if getattr(self, d.value)}
        if len(stated) != 1:
            raise MechanismError(
                f"common error {self.name!r} states {len(stated)} tolerances; give one, such as "
                "`length: {sd: 0.1}`"
            )
        ((dimension, tolerance),) = stated.items()
        sd = standard_deviation(tolerance, f"common error {self.name!r}")
        assert sd is not None
        names = [parameter.name for parameter in parameters]
        matching = _match_all(self.of, names, "common_errors")
        chosen = [parameter for parameter in parameters if parameter.name in matching]
        for parameter in chosen:
            self._check(parameter, dimension)
        if len(chosen) < 2:
            raise MechanismError(
                f"common error {self.name!r} belongs to {chosen[0].name} alone; name two or more "
                "parameters, or state the tolerance of that parameter"
            )
        return CommonError(self.name, tuple(parameter.name for parameter in chosen), sd)

    def _check(self, parameter: Parameter, dimension: Dimension) -> None:
        """Refuse a parameter that cannot have this common error."""
        place = f"common error {self.name!r} of {parameter.name}"
        if parameter.dimension is not dimension:
            raise MechanismError(
                f"{place} states a tolerance of {dimension.value}, but the parameter is of "
                f"dimension {parameter.dimension.value}; use the key `{parameter.dimension.value}`"
            )
        if parameter.tolerance is None:
            raise MechanismError(
                f"{place}: the parameter has no tolerance of its own; state it, because no two "
                "parts are exactly equal"
            )


@dataclass(frozen=True)
class Workspace:
    """Ranges (low, high) of the controlled coordinates in which the machine works."""

    x: tuple[Length, Length] | None = None
    y: tuple[Length, Length] | None = None
    z: tuple[Length, Length] | None = None
    roll: tuple[Angle, Angle] | None = None
    pitch: tuple[Angle, Angle] | None = None
    yaw: tuple[Angle, Angle] | None = None
    phi: tuple[Angle, Angle] | None = None
    theta: tuple[Angle, Angle] | None = None
    psi: tuple[Angle, Angle] | None = None

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Stated ranges, coordinate -> (low, high); raises MechanismError unless low < high."""
        ranges = {f.name: getattr(self, f.name) for f in fields(self)}
        stated = {name: pair for name, pair in ranges.items() if pair is not None}
        for name, (low, high) in stated.items():
            if not low < high:
                unit = "m" if name in ("x", "y", "z") else "rad"
                raise MechanismError(
                    f"the workspace of {name} runs from {low:g} {unit} to {high:g} {unit}; the "
                    "first value must be smaller"
                )
        if "theta" in stated and not 0.0 < stated["theta"][1] <= math.pi:
            raise MechanismError(
                f"the workspace of theta runs to {stated['theta'][1]:g} rad; a tilt is above 0 and "
                "at most 180 degrees"
            )
        return stated


@dataclass(frozen=True)
class RobotRecord:
    """The fields of every robot file; a family adds its own fields and `expand`.

    Attributes
    ----------
    name : name of the robot. source : origin of its numbers.
    home : platform pose in the base at which the loops are closed first; zero by default.
    tool : tool pose on the platform. workspace : where the machine works; poses are drawn from it.
    fixed : parameters that are not identified, by name or pattern, such as `arm*.length`.
    stored_parameters : parameters that the controller of the machine stores, by name or pattern.
    common_errors : errors that several parameters share, such as those of one batch of parts or of
        a common zero.
    """

    family: ClassVar[str] = ""
    """Name of the family in robot files."""

    name: str
    source: str = ""
    home: PoseRecord = field(default_factory=PoseRecord)
    tool: PoseRecord = field(default_factory=PoseRecord)
    workspace: Workspace = field(default_factory=Workspace)
    fixed: tuple[str, ...] = ()
    stored_parameters: tuple[str, ...] = ()
    common_errors: tuple[CommonErrorRecord, ...] = ()

    def expand(self) -> Assembly:
        """Return the generic description of this robot."""
        raise TypeError("a record of no family cannot be expanded")

    def assemble(
        self,
        limbs: Iterable[Limb],
        actuators: Iterable[Actuator],
        errors: ErrorModel,
        *,
        freedoms: tuple[str, ...],
        controlled: tuple[str, ...],
    ) -> Assembly:
        """Return the assembly of limbs, drives and errors at the home pose of this record."""
        return Assembly(
            self.name,
            tuple(limbs),
            tuple(actuators),
            freedoms,
            controlled,
            self.home.matrix,
            errors.parameters,
            errors.maps,
            errors.shared,
            self.tool.matrix,
            self.workspace.ranges,
            self.source,
        )

    def assembly(self, expanded: Assembly | None = None) -> Assembly:
        """Return the expanded robot, with the parameters of `fixed` kept at their nominal values,
        the names of those that the controller stores, and the common errors of the others.
        """
        expanded = self.expand() if expanded is None else expanded
        names = [parameter.name for parameter in expanded.parameters]
        fixed = _match_all(self.fixed, names, "fixed")
        stored = _match_all(self.stored_parameters, names, "stored_parameters")
        parameters = tuple(
            replace(p, free=False) if p.name in fixed else p for p in expanded.parameters
        )
        stored.update(expanded.stored_parameters)
        present = tuple(name for name in names if name in stored)
        own = (record.resolve(parameters) for record in self.common_errors)
        common = (*expanded.common_errors, *own)
        titles = [error.name for error in common]
        if duplicate := [title for title in titles if titles.count(title) > 1]:
            raise MechanismError(
                f"two common errors are called {duplicate[0]!r}; give each its own name"
            )
        return replace(
            expanded, parameters=parameters, stored_parameters=present, common_errors=common
        )


def _match_all(patterns: Iterable[str], names: Sequence[str], key: str) -> set[str]:
    """Return the parameters that match any of these names or patterns."""
    return {n for pattern in patterns for n in match_parameter_names(pattern, names, key)}


def match_parameter_names(pattern: str, names: Sequence[str], key: str = "fixed") -> list[str]:
    """Return the parameters that match a name or pattern; raises MechanismError if none does."""
    matching = fnmatch.filter(names, pattern)
    if not matching:
        hint = suggest_names(pattern, names) or f"; its parameters are {', '.join(names)}"
        raise MechanismError(
            f"{pattern!r} under `{key}` matches no parameter of this robot{hint}; correct it"
        )
    return matching


def values_per_leg(value: float | tuple[float, ...], count: int, name: str) -> tuple[float, ...]:
    """Return one value for each leg; raises MechanismError for another number of values."""
    values = (value,) * count if isinstance(value, (int, float)) else tuple(value)
    if len(values) != count:
        raise MechanismError(
            f"{name} has {len(values)} values for {count} legs; give one value, or one for each leg"
        )
    return tuple(float(v) for v in values)
