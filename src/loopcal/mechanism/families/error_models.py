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

from dataclasses import dataclass, replace

import numpy as np

from loopcal.mechanism.assembly import AXES, Address, LinearMap
from loopcal.mechanism.families.limb_placement import PlacedLimb, map_displacement
from loopcal.parameters import Parameter
from loopcal.units import Dimension

KEPT_AXES = {"R": ("rx", "ry", "x", "y"), "P": ("rx", "ry")}
"""Displacements of a link that its joint does not repeat."""


@dataclass(frozen=True)
class ErrorModel:
    """Parameters with their maps; `+` joins two."""

    parameters: tuple[Parameter, ...] = ()
    maps: tuple[LinearMap, ...] = ()

    def __add__(self, other: ErrorModel) -> ErrorModel:
        return ErrorModel(self.parameters + other.parameters, self.maps + other.maps)

    def without_effects_of(self, named: ErrorModel) -> ErrorModel:
        """Return these parameters without those whose effect `named` or earlier ones have already.

        A parameter whose name is taken gets the suffix `.own`.
        """
        place = {
            address: i
            for i, address in enumerate(dict.fromkeys(m.address for m in (*named.maps, *self.maps)))
        }
        taken, left, basis = (
            {p.name for p in named.parameters},
            ErrorModel(),
            np.zeros((0, len(place))),
        )
        for errors in (named, self):
            rows = dict.fromkeys((p.name for p in errors.parameters), np.zeros(len(place)))
            for entry in errors.maps:
                rows[entry.parameter] = (
                    rows[entry.parameter]
                    + entry.coefficient * np.eye(len(place))[place[entry.address]]
                )
            for parameter in errors.parameters:
                row = rows[parameter.name]
                rest = row - (basis @ row) @ basis
                if np.linalg.norm(rest) <= 1e-9 * np.linalg.norm(row):
                    continue
                basis = np.vstack([basis, rest / np.linalg.norm(rest)])
                if errors is self:
                    left += self._rename(
                        parameter,
                        f"{parameter.name}.own" if parameter.name in taken else parameter.name,
                    )
        return left

    def _rename(self, parameter: Parameter, name: str) -> ErrorModel:
        """Return one of the parameters, with its maps, under another name."""
        maps = tuple(
            replace(entry, parameter=name)
            for entry in self.maps
            if entry.parameter == parameter.name
        )
        return ErrorModel((replace(parameter, name=name),), maps)


@dataclass(frozen=True)
class ErrorTolerances:
    """Standard deviations of lengths and angles [m, rad]; None where none is stated."""

    length: float | None = None
    angle: float | None = None

    def of(self, axis: str) -> float | None:
        """Return the standard deviation for a displacement axis."""
        return self.angle if axis in AXES[:3] else self.length


def single_error(
    name: str,
    dimension: Dimension,
    nominal: float,
    tolerance: float | None,
    *maps: LinearMap,
    free: bool = True,
) -> ErrorModel:
    """Return an error model of one named parameter."""
    return ErrorModel((Parameter(name, dimension, float(nominal), tolerance, free),), maps)


def point_errors(
    limb: PlacedLimb, element: str, axes: str, tolerance: float | None, label: str = ""
) -> ErrorModel:
    """Return the coordinates of a link's origin as parameters `limb.element.x` and so on.

    They are coordinates in the frame carried before the link; nominal values are those of its
    placement.
    """
    errors = ErrorModel()
    for axis in axes:
        name = f"{limb.name}.{label or element}.{axis}"
        nominal = limb.placements[element][:3, 3]["xyz".index(axis)]
        # the displacement acts in the placed frame, the coordinate is one of the frame before it
        maps = _in_frame_before(name, limb, element, axis)
        errors += single_error(name, Dimension.LENGTH, nominal, tolerance, *maps)
    return errors


def rod_length_error(limb: PlacedLimb, tolerance: float | None) -> ErrorModel:
    """Return the length of the rod of a `distance` ending at reading zero, `limb.length`."""
    name = f"{limb.name}.length"
    address = Address(limb.name, "rod", "length")
    return single_error(
        name, Dimension.LENGTH, limb.limb.length, tolerance, LinearMap(name, address)
    )


def offset_error(
    name: str, actuator: str, dimension: Dimension, nominal: float, tolerance: float | None
) -> ErrorModel:
    """Return the value of a driven joint at reading zero as a parameter."""
    return single_error(
        name,
        dimension,
        nominal,
        tolerance,
        LinearMap(name, Address(actuator, "transmission", "offset")),
    )


def complete_errors(limb: PlacedLimb, spread: ErrorTolerances, offsets: bool = True) -> ErrorModel:
    """Return the complete error model of a limb, see the module.

    Without `offsets` the family names the offsets of the actuators itself.
    """
    errors = ErrorModel()
    for joint in limb.limb.joints:
        for axis in KEPT_AXES[joint.kind]:
            errors += _displacement(limb, joint.name, axis, spread)
        if joint.actuator and offsets:
            dimension = Dimension.ANGLE if joint.kind == "R" else Dimension.LENGTH
            sd = spread.angle if joint.kind == "R" else spread.length
            errors += offset_error(f"{joint.actuator}.offset", joint.actuator, dimension, 0.0, sd)
    if limb.limb.ending != "rigid":
        for axis in AXES[3:]:
            errors += _displacement(limb, limb.limb.links[-1].name, axis, spread)
    for axis in AXES if limb.limb.ending == "rigid" else AXES[3:]:
        errors += _displacement(limb, "platform", axis, spread)
    if limb.limb.ending == "distance" and limb.limb.actuator and offsets:
        name = limb.limb.actuator
        errors += offset_error(f"{name}.offset", name, Dimension.LENGTH, 0.0, spread.length)
    elif limb.limb.ending == "distance" and not limb.limb.actuator:
        errors += rod_length_error(limb, spread.length)
    return errors


def _displacement(limb: PlacedLimb, element: str, axis: str, spread: ErrorTolerances) -> ErrorModel:
    """Return one displacement of a link in its own frame, nominally zero."""
    name = f"{limb.name}.{element}.{axis}"
    dimension = Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH
    return single_error(
        name, dimension, 0.0, spread.of(axis), LinearMap(name, Address(limb.name, element, axis))
    )


def _in_frame_before(name: str, limb: PlacedLimb, element: str, axis: str) -> tuple[LinearMap, ...]:
    """Return the maps of a translation along an axis of the frame before the placement."""
    turn = limb.placements[element][:3, :3]
    components = turn.T @ [float(a == axis) for a in "xyz"]
    return tuple(
        linear
        for a, part in zip(AXES[3:], components, strict=True)
        if abs(part) > 1e-12
        for linear in map_displacement(name, limb, element, a, float(part))
    )
