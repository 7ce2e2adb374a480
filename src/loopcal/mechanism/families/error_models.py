# SPDX-License-Identifier: Apache-2.0
"""Error models: named parameters with their maps, by hand for `ideal`, by rule for `complete`.

`complete` gives every link transform six displacements in its own frame (z along the joint), less
those that the joint's own motion repeats: R keeps rx, ry, x, y; P keeps rx, ry; an actuated joint
keeps its offset. A `rigid` ending adds six of the platform (those of the tip would repeat them),
`ball` and `distance` three of the tip and three of the attachment, `distance` the length of a rod
without an actuator; a rod with one has its offset. A limb with r rotary and p sliding joints has 4
r + 2 p + 6 (7 for a rod) parameters plus the offsets. Less its passive joints, 4 r + 2 p + 6 (7) of
them are identifiable in general: the counting rule C = 3R + P + E + 6L + 6(F - 1), limb by limb.
Derivation: docs/theory/parameters.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Address, LinearMap, SharedMap
from loopcal.mechanism.families.limb_placement import PlacedLimb, map_displacement
from loopcal.parameters import Parameter
from loopcal.units import Dimension

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
        """Return these parameters without those whose effect `named` or earlier ones have already.

        A parameter whose name is taken gets the suffix `.own`.
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
    """Return an error model of one named parameter.

    `positive` : whether only values above zero exist; a nominal value of zero then allows others.
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
    """Return the coordinates of a link's origin as parameters `limb.label.x`, `.y` and `.z`.

    They are coordinates in the frame carried before the link; nominal values are those of its
    placement, which is not rotated.
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


def complete_errors(limb: PlacedLimb, spread: ErrorTolerances, offsets: bool = True) -> ErrorModel:
    """Return the complete error model of a limb, see the module.

    Without `offsets` the family names the offsets of the actuators itself.
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
    add_displacements("platform", AXES if limb.limb.ending == "rigid" else AXES[3:])
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
