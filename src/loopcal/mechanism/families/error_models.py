# SPDX-License-Identifier: Apache-2.0
"""Error models: named parameters and their maps, by hand for `ideal`, by rule for `complete`.

`complete` gives every link transform six displacements, in its own frame (z along the joint), less
what the joint's own freedom absorbs: R keeps rx, ry, x, y; P keeps rx, ry; an actuated joint keeps
its offset. A `rigid` ending adds six of the platform's side (those of the tip would repeat them),
`ball` and `distance` three of the tip and three of the attachment, `distance` the length of a rod
that is not actuated; an actuated one has its offset. Of a limb with r turning and p sliding joints
that makes 4 r + 2 p + 6 (7 for a rod) plus the offsets. 4 r + 2 p + 6 (7) less the passive joints
of them can be told apart in general, which is the counting rule C = 3R + P + E + 6L + 6(F - 1) limb
by limb. Derivation: docs/theory/parameters.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.mechanism.assembly import AXES, Address, LinearMap
from loopcal.mechanism.families.chain import Placed, moved
from loopcal.parameters import Parameter
from loopcal.units import Dimension

KEPT = {"R": ("rx", "ry", "x", "y"), "P": ("rx", "ry")}
"""Displacements of a link that its joint does not absorb."""


@dataclass(frozen=True)
class Errors:
    """Parameters with their maps; `+` joins two."""

    parameters: tuple[Parameter, ...] = ()
    maps: tuple[LinearMap, ...] = ()

    def __add__(self, other: Errors) -> Errors:
        return Errors(self.parameters + other.parameters, self.maps + other.maps)

    def beside(self, named: Errors) -> Errors:
        """These, less those whose effect `named` and the ones before have already; a name that is
        taken gets `.own`.
        """
        place = {
            address: i
            for i, address in enumerate(dict.fromkeys(m.address for m in (*named.maps, *self.maps)))
        }
        taken, left, basis = {p.name for p in named.parameters}, Errors(), np.zeros((0, len(place)))
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
                    left += self._called(
                        parameter,
                        f"{parameter.name}.own" if parameter.name in taken else parameter.name,
                    )
        return left

    def _called(self, parameter: Parameter, name: str) -> Errors:
        """One of the parameters with its maps, under a name."""
        maps = tuple(
            replace(entry, parameter=name)
            for entry in self.maps
            if entry.parameter == parameter.name
        )
        return Errors((replace(parameter, name=name),), maps)


@dataclass(frozen=True)
class Spread:
    """Standard deviations of a kind of error [m, rad]; None where nothing is stated."""

    length: float | None = None
    angle: float | None = None

    def of(self, axis: str) -> float | None:
        """The one of an axis."""
        return self.angle if axis in AXES[:3] else self.length


def quantity(
    name: str,
    dimension: Dimension,
    nominal: float,
    tolerance: float | None,
    *maps: LinearMap,
    free: bool = True,
) -> Errors:
    """One named parameter."""
    return Errors((Parameter(name, dimension, float(nominal), tolerance, free),), maps)


def point(
    limb: Placed, element: str, axes: str, tolerance: float | None, label: str = ""
) -> Errors:
    """Coordinates of a link's origin in the frame carried before it, `limb.element.x` and so on;
    nominal as placed.
    """
    found = Errors()
    for axis in axes:
        name = f"{limb.name}.{label or element}.{axis}"
        nominal = limb.places[element][:3, 3]["xyz".index(axis)]
        # the displacement acts in the placed frame, the coordinate is one of the frame before it
        maps = _in_frame_before(name, limb, element, axis)
        found += quantity(name, Dimension.LENGTH, nominal, tolerance, *maps)
    return found


def rod_length(limb: Placed, tolerance: float | None) -> Errors:
    """The length of a `distance` ending's rod at reading zero, `limb.length`."""
    name = f"{limb.name}.length"
    address = Address(limb.name, "rod", "length")
    return quantity(name, Dimension.LENGTH, limb.limb.length, tolerance, LinearMap(name, address))


def offset(
    name: str, actuator: str, dimension: Dimension, nominal: float, tolerance: float | None
) -> Errors:
    """What a driven joint's value is at reading zero."""
    return quantity(
        name,
        dimension,
        nominal,
        tolerance,
        LinearMap(name, Address(actuator, "transmission", "offset")),
    )


def complete(limb: Placed, spread: Spread, offsets: bool = True) -> Errors:
    """The complete error model of a limb (see the module); `offsets` False where the family names
    its own.
    """
    found = Errors()
    for joint in limb.limb.joints:
        for axis in KEPT[joint.kind]:
            found += _displacement(limb, joint.name, axis, spread)
        if joint.actuator and offsets:
            dimension = Dimension.ANGLE if joint.kind == "R" else Dimension.LENGTH
            sd = spread.angle if joint.kind == "R" else spread.length
            found += offset(f"{joint.actuator}.offset", joint.actuator, dimension, 0.0, sd)
    if limb.limb.ending != "rigid":
        for axis in AXES[3:]:
            found += _displacement(limb, limb.limb.links[-1].name, axis, spread)
    for axis in AXES if limb.limb.ending == "rigid" else AXES[3:]:
        found += _displacement(limb, "platform", axis, spread)
    if limb.limb.ending == "distance" and limb.limb.actuator and offsets:
        name = limb.limb.actuator
        found += offset(f"{name}.offset", name, Dimension.LENGTH, 0.0, spread.length)
    elif limb.limb.ending == "distance" and not limb.limb.actuator:
        found += rod_length(limb, spread.length)
    return found


def _displacement(limb: Placed, element: str, axis: str, spread: Spread) -> Errors:
    """One displacement of a link in its own frame, nominally zero."""
    name = f"{limb.name}.{element}.{axis}"
    dimension = Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH
    return quantity(
        name, dimension, 0.0, spread.of(axis), LinearMap(name, Address(limb.name, element, axis))
    )


def _in_frame_before(name: str, limb: Placed, element: str, axis: str) -> tuple[LinearMap, ...]:
    """Maps of a move along an axis of the frame before the placement."""
    turn = limb.places[element][:3, :3]
    parts = turn.T @ [float(a == axis) for a in "xyz"]
    return tuple(
        linear
        for a, part in zip(AXES[3:], parts, strict=True)
        if abs(part) > 1e-12
        for linear in moved(name, limb, element, a, float(part))
    )
