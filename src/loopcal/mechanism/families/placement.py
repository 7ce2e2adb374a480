# SPDX-License-Identifier: Apache-2.0
"""Limbs as robot files place them, tolerances, and parameters with their maps.

Numbers are in SI; `loopcal.io` converts them from the units of the file, by the annotations here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism import assembly
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import SD_RANGE, Angle, Dimension, Given, Length, is_sd

# Limbs with joints about any axis, placed one after the other, in the form of the engine.

EX, EY, EZ = np.eye(3)
Freedom = Literal["rx", "ry", "rz", "x", "y", "z"]


class RecordError(MechanismError):
    """An impossible content of a robot file; `location` is the path of keys to it."""

    def __init__(self, sentence: str, *location: str | int) -> None:
        super().__init__(sentence)
        self.location = location


@dataclass(frozen=True, eq=False)
class JointPlacement:
    """A joint of a limb, and where it is; the link before it has its name.

    place : (4, 4) of the joint in the frame carried up to it [m].
    axis : (3,) in the placed frame, of any length but zero.
    """

    joint: assembly.Joint
    place: FloatArray
    axis: FloatArray


class PlacedLimb(NamedTuple):
    """A limb for the engine, with the frames in which its file is written.

    rotations : name of a link -> (3, 3) R_carried_link, from the link's axes to the carried ones.
    placements : name of a link -> (4, 4) its placement in the frame carried before it [m].
    stem : name without the number of a copy.
    """

    limb: assembly.Limb
    rotations: Mapping[str, FloatArray]
    placements: Mapping[str, FloatArray]
    stem: str

    @property
    def name(self) -> str:
        """Name of the limb."""
        return self.limb.name

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the links from base to tip, then of the attachment."""
        return (*(link.name for link in self.limb.links), self.limb.attachment.name)

    def find_element(self, name: str) -> str:
        """Return a link by name; a joint of several axes means its first, and a joint called as the
        end of its chain is meant before that end.
        """
        for candidate in (name, f"{name}.1", f"{name}.turn"):
            if candidate in self.elements:
                return candidate
        raise MechanismError(
            f"limb {self.name!r} has no {name!r}; it has {', '.join(self.elements)}"
        )


def place_limb(
    name: str,
    steps: tuple[JointPlacement, ...],
    tip: FloatArray,
    ending: str,
    attachment: FloatArray,
    length: float = 0.0,
    actuator: str | None = None,
    cones: tuple[assembly.Cone, ...] = (),
    bodies: tuple[str, str] = (assembly.BASE, assembly.PLATFORM),
) -> PlacedLimb:
    """Return a limb of its joints from one body to its tip, its tip and its attachment to another.

    tip : (4, 4) in the last carried frame [m]; its link is called `tip`, without joints like the
        first body. attachment : (4, 4) in the second body [m]; its link is called like that body.
    length, actuator, cones : of the rod of a `distance` ending [m].
    """
    back, links, rotations, placements = np.eye(4), [], {}, {}
    for step in steps:
        link, turn = step.joint.name, frame_from_axis(step.axis, f"joint {step.joint.name!r}")
        links.append(assembly.Link(link, back @ step.place @ rotation_matrix(turn)))
        rotations[link], placements[link] = turn, step.place
        back = rotation_matrix(turn.T)
    last, end = "tip" if steps else bodies[0], assembly.Link(bodies[1], attachment)
    links.append(assembly.Link(last, back @ tip))
    rotations |= {last: np.eye(3), end.name: np.eye(3)}
    placements |= {last: tip, end.name: attachment}
    joints = tuple(step.joint for step in steps)
    limb = assembly.Limb(name, tuple(links), joints, ending, end, length, actuator, cones)
    return PlacedLimb(limb, rotations, placements, strip_number(name))


def strip_number(name: str) -> str:
    """Return a name without the number of a copy."""
    return name.rstrip("0123456789")


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
    ball = (
        JointPlacement(assembly.Joint("ball1", "R"), geometry.make_pose(axes, center), EZ),
        JointPlacement(assembly.Joint("ball2", "R"), np.eye(4), EY),
        JointPlacement(assembly.Joint("ball3", "R"), np.eye(4), EX),
    )
    return place_limb(name, (*steps, *ball), np.eye(4), "rigid", attachment)


def frame_from_axis(axis: FloatArray, owner: str) -> FloatArray:
    """Return a rotation (3, 3), third column along `axis`; x, y, z permute axes cyclically."""
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise MechanismError(f"{owner} has the axis [0, 0, 0]. Give a direction")
    z = np.asarray(axis, dtype=float) / length
    # the cyclic successor of the largest component is never parallel to the axis
    across = np.eye(3)[(int(np.argmax(np.abs(z))) + 1) % 3]
    x = across - float(across @ z) * z
    x /= float(np.linalg.norm(x))
    return np.array([x, np.cross(z, x), z], dtype=float).T


def map_displacement(
    parameter: str, limb: PlacedLimb, element: str, axis: str, coefficient: float = 1.0
) -> tuple[assembly.LinearMap, ...]:
    """Map a parameter onto a translation along, or rotation about, an axis of the carried frame."""
    direction = coefficient * np.eye(3)[assembly.AXES.index(axis) % 3]
    return map_direction(parameter, limb, element, direction, turns=axis in assembly.AXES[:3])


def map_direction(
    parameter: str, limb: PlacedLimb, element: str, direction: FloatArray, *, turns: bool
) -> tuple[assembly.LinearMap, ...]:
    """Map a parameter onto a turn about (or shift along) `direction` (3,) of a carried frame."""
    components = limb.rotations[element].T @ direction
    axes = assembly.AXES[:3] if turns else assembly.AXES[3:]
    # what is below rounding of a direction is no component
    return tuple(
        assembly.LinearMap(parameter, assembly.Address(limb.name, element, axis), float(part))
        for axis, part in zip(axes, components, strict=True)
        if abs(part) > 1e-12 * np.abs(components).max()
    )


def map_slide_tilt(
    parameter: str, limb: PlacedLimb, element: str, axis: str
) -> tuple[assembly.LinearMap, ...]:
    """Map a parameter onto the tilt of a slide's axis that does not rotate what slides on it.

    exp(w) A_j [slide] A_j^-1 P A_k exp(w') keeps the orientation P A_k if w' = -(P A_k)' w. The
    translation of what is placed off the slide is compensated to first order.
    """
    names = limb.elements
    place = names.index(element)
    if place >= len(limb.limb.joints) or limb.limb.joints[place].kind != "P":
        raise MechanismError(
            f"{parameter} tilts {element!r} of {limb.name!r} alone, which only a slide allows. "
            "Leave out `alone: true`"
        )
    w, after = np.eye(3)[assembly.AXES.index(axis)], names[place + 1]
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


def rotate_about(axis: FloatArray, angle: float) -> FloatArray:
    """Return a rotation (4, 4) by an angle [rad] about an axis (3,) of any length but zero."""
    return rotation_matrix(geometry.exp_so3(angle * frame_from_axis(axis, "a copy")[:, 2]))


# Error models: named parameters with their maps, by hand for `ideal`, by rule for `complete`.

# Displacements of a link that its joint does not repeat.
KEPT_AXES: Mapping[str, tuple[str, ...]] = {"R": ("rx", "ry", "x", "y"), "P": ("rx", "ry")}


@dataclass(frozen=True)
class ErrorModel:
    """Parameters with their maps; `+` joins two."""

    parameters: tuple[Parameter, ...] = ()
    maps: tuple[assembly.LinearMap, ...] = ()
    shared: tuple[assembly.SharedMap, ...] = ()

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


def single_error(
    name: str,
    dimension: Dimension,
    nominal: float,
    tolerance: float | None,
    *maps: assembly.LinearMap,
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
    positive: bool = False,
) -> ErrorModel:
    """Return a displacement of a link, of AXES in its carried frame, as a parameter; the nominal
    value of a translation is that of the placement of the link.
    """
    maps, place = map_displacement(name, limb, element, axis), limb.placements[element]
    at = np.concatenate([np.zeros(3), place[:3, :3].T @ place[:3, 3]])[assembly.AXES.index(axis)]
    dimension = get_axis_dimension(axis)
    return single_error(name, dimension, at, tolerance, *maps, positive=positive)


def point_errors(
    prefix: str, limb: PlacedLimb, element: str, tolerance: float | None, axes: str = "xyz"
) -> ErrorModel:
    """Return coordinates of a link's origin, with the prefix before their names, as parameters."""
    return join_errors(
        displacement_error(f"{prefix}{axis}", limb, element, axis, tolerance) for axis in axes
    )


def rod_length_error(limb: PlacedLimb, name: str, tolerance: float | None) -> ErrorModel:
    """Return the length of the rod of a `distance` ending at reading zero as a parameter."""
    rod = assembly.LinearMap(name, assembly.Address(limb.name, "rod", "length"))
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
    offset = assembly.LinearMap(name, assembly.Address(actuator, "transmission", "offset"))
    return single_error(name, dimension, nominal, tolerance, offset, positive=positive)


def complete_limbs(limbs: Sequence[PlacedLimb], spread: LinkTolerances) -> ErrorModel:
    """Return all errors of the links of all limbs."""
    # the first rigid limb of a body places its frame, so that errors of its end are none
    places = {limb.limb.to: limb.name for limb in limbs[::-1] if limb.limb.ending == "rigid"}
    errors: list[ErrorModel] = []
    for limb in limbs:
        name, own = limb.name, limb.limb
        is_rigid = own.ending == "rigid"
        chosen = [(joint.name, KEPT_AXES[joint.kind]) for joint in own.joints]
        if not is_rigid:
            chosen.append((own.links[-1].name, assembly.AXES[3:]))
        if own.to == assembly.PLATFORM or places.get(own.to) != name:
            chosen.append((own.attachment.name, assembly.AXES if is_rigid else assembly.AXES[3:]))
        for element, axis in ((element, axis) for element, axes in chosen for axis in axes):
            parameter, dimension = f"{name}.{element}.{axis}", get_axis_dimension(axis)
            entry = assembly.LinearMap(parameter, assembly.Address(name, element, axis))
            errors.append(single_error(parameter, dimension, 0.0, spread.select(dimension), entry))
        if own.ending == "distance" and not own.actuator:
            sd = spread.select(Dimension.LENGTH)
            errors.append(rod_length_error(limb, f"{name}.length", sd))
    return join_errors(errors)


def get_axis_dimension(axis: str) -> Dimension:
    """Return the dimension of a displacement along or about one of AXES."""
    return Dimension.ANGLE if axis in assembly.AXES[:3] else Dimension.LENGTH


Point = tuple[Length, Length, Length]


@dataclass(frozen=True)
class PoseRecord:
    """Position and orientation R = Rz(yaw) Ry(pitch) Rx(roll), as in a robot file.

    Allowed in place of roll, pitch, yaw: tilt-and-torsion phi, theta, psi.
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
class ToleranceRecord:
    """Expected spread of a number: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    GIVEN: ClassVar[Dimension] = Dimension.RATIO

    sd: Given | None = None
    limits: Given | None = None


@dataclass(frozen=True)
class LengthTolerance(ToleranceRecord):
    """Expected spread of a length: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    GIVEN: ClassVar[Dimension] = Dimension.LENGTH


@dataclass(frozen=True)
class AngleTolerance(ToleranceRecord):
    """Expected spread of an angle: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    GIVEN: ClassVar[Dimension] = Dimension.ANGLE


@dataclass(frozen=True)
class RatioTolerance(ToleranceRecord):
    """Expected spread of a ratio: sd, or limits of a uniform error (sd = limits / sqrt 3)."""


def standard_deviation(tolerance: ToleranceRecord | None, name: str) -> float | None:
    """Return the standard deviation of a spread [SI], None without; MechanismError if wrong."""
    if tolerance is None:
        return None
    if (tolerance.sd is None) == (tolerance.limits is None):
        raise MechanismError(
            f"the expected spread of {name} must give exactly one of sd and limits"
        )
    stated = tolerance.sd if tolerance.sd is not None else tolerance.limits or 0.0
    if not is_sd(stated):
        unit = {Dimension.LENGTH: " m", Dimension.ANGLE: " rad"}.get(tolerance.GIVEN, "")
        raise MechanismError(
            f"the expected spread of {name} is {stated:g}{unit}, but must be greater than zero "
            f"({SD_RANGE}), or left out"
        )
    return float(stated if tolerance.sd is not None else stated / np.sqrt(3.0))


@dataclass(frozen=True)
class LinkTolerances:
    """Expected spreads of all lengths and of all angles."""

    lengths: LengthTolerance | None = None
    angles: AngleTolerance | None = None

    def select(self, dimension: Dimension) -> float | None:
        """Return the standard deviation of a dimension [m, rad], None where none is stated."""
        if dimension is Dimension.ANGLE:
            return standard_deviation(self.angles, "the angles")
        return standard_deviation(self.lengths, "the lengths")
