# SPDX-License-Identifier: Apache-2.0
"""Gough-Stewart platforms: six legs of variable length between joint centers on base and platform.

With `legs: rod` a leg is the distance between its two centers, l_i = |t + R p_i - b_i| = length_i +
reading_i: seven parameters a leg, 42 in all. With `legs: ups` it is a chain of joints (see
`hexapod_legs.py`), which can carry the complete error model and a screw that turns with the joints.
Derivation: docs/theory/families.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Actuator, Assembly, Cone, Joint
from loopcal.mechanism.families import placement
from loopcal.mechanism.families.placement import (
    AngleTolerance,
    ErrorModel,
    JointPlacement,
    LengthTolerance,
    LinkTolerances,
    PlacedLimb,
    Point,
)
from loopcal.mechanism.families.records import RobotRecord, check_spherical, values_per_leg
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Length, Ratio

# Legs of a hexapod as chains: universal joint, driven slide, then a ball or a screw and a
# second universal joint.

Direction = tuple[Ratio, Ratio, Ratio]


@dataclass(frozen=True)
class Screw:
    """Screws in the legs of a hexapod.

    lead : change of length in one turn [m], one for all legs or one each; negative for a
        left-handed screw.
    base_axes, platform_axes : direction of the joint axis fixed to the base (platform), leg by leg.
    """

    lead: Length | tuple[Length, ...] = 0.0
    base_axes: tuple[Direction, ...] = ()
    platform_axes: tuple[Direction, ...] = ()


def build_leg(
    name: str,
    motor: str,
    base: Direction,
    top: Direction,
    home: FloatArray,
    axes: bool = False,
    screw: tuple[float, Direction, Direction] | None = None,
) -> PlacedLimb:
    """Return a leg between centers in base and platform [m], whose joints are all at zero in the
    home pose (4, 4), but those of a screw, in which the reading alone drives the slide.

    axes : the upper joint has three axes in place of a ball. screw : lead [m per turn], and joint
    axes fixed to base and platform (3,).
    """
    gap = home[:3, :3] @ np.array(top, dtype=float) + home[:3, 3] - np.array(base, dtype=float)
    s, length = _normalize(
        gap, f"{name} has length zero at home. Move its centers or the home pose"
    )
    pitch = turned = 0.0
    lower = upper = geometry.find_perpendicular(s, placement.EZ)
    if screw:
        zero = f"a joint axis of {name} is [0, 0, 0]. Give a direction"
        (lower, _), (upper, _) = (_normalize(axis, zero) for axis in screw[1:])
        upper = home[:3, :3] @ upper
        if min(np.linalg.norm(np.cross(axis, s)) for axis in (lower, upper)) < 1e-6:
            raise MechanismError(
                f"a screw's joint axis lies along {name} at home. Give it another direction"
            )
        pitch = screw[0] / (2 * np.pi)
    low, high = (geometry.find_perpendicular(s, axis) for axis in (lower, upper))
    if screw:
        turned = float(np.arctan2(np.cross(low, high) @ s, low @ high))
    # the axes in the base frame, which is the carried frame while every joint is at zero
    steps = (
        JointPlacement(Joint("universal1", "R"), placement.translate(*base), lower),
        JointPlacement(Joint("universal2", "R"), np.eye(4), np.cross(s, low)),
        JointPlacement(Joint("slide", "P", motor, start=length + pitch * turned), np.eye(4), s),
    )
    if not screw:
        ball = home[:3, :3] if axes else None
        return placement.place_limb_with_ball(
            name, steps, np.zeros(3), placement.translate(*top), ball
        )
    # at zero the spindle stands turned back by the angle that it has at home
    back = placement.rotation_matrix(geometry.exp_so3(-turned * s))
    thread = (
        JointPlacement(Joint("screw", "R", pitch=-pitch, start=turned), np.eye(4), s),
        JointPlacement(Joint("universal3", "R"), back, np.cross(s, high)),
        JointPlacement(Joint("universal4", "R"), np.eye(4), upper),
    )
    end = placement.rotation_matrix(home[:3, :3]), "rigid", placement.translate(*top)
    return placement.place_limb(name, (*steps, *thread), *end)


def _normalize(vector: ArrayLike, refusal: str) -> tuple[FloatArray, float]:
    """Return a vector (3,) as unit vector and length; raises MechanismError for zero."""
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise MechanismError(refusal)
    return np.array(vector) / length, length


@dataclass(frozen=True)
class GoughTolerances:
    """Expected spreads of joint centers on base and platform and of leg lengths.

    `links` and `angles` are those of the complete model.
    """

    base: LengthTolerance | None = None
    platform: LengthTolerance | None = None
    length: LengthTolerance | None = None
    links: LengthTolerance | None = None
    angles: AngleTolerance | None = None


@dataclass(frozen=True)
class GoughCones:
    """Allowed inclination of a rod at its base and platform joints from its direction at home."""

    base: Angle | None = None
    platform: Angle | None = None


@dataclass(frozen=True)
class Gough(RobotRecord):
    """The file of a hexapod.

    base, platform : centers of the joints, leg by leg, in the base and the platform frame [m].
    lengths : length of a leg at reading zero [m], one for all or one each.
    stroke : allowed readings (low, high) [m]. cones : of the joints of rods.
    legs : form of the legs, a `rod` or the chain `ups`.
    spherical : with `ups`, the upper joint as a perfect `point`, or as three `axes` with errors of
        their own.
    screw : with `ups`, a screw in every leg; its nut turns with the lower joint, its spindle with
        the upper one.
    error_model : `ideal`, 42 parameters, or `complete`, which needs `ups`.
    tolerances : of the parameters.
    """

    family = "gough"

    base: tuple[Point, ...] = ()
    platform: tuple[Point, ...] = ()
    lengths: Length | tuple[Length, ...] = 0.0
    stroke: tuple[Length, Length] | None = None
    cones: GoughCones = field(default_factory=GoughCones)
    legs: Literal["rod", "ups"] = "rod"
    spherical: Literal["point", "axes"] = "point"
    screw: Screw | None = None
    error_model: Literal["ideal", "complete"] = "ideal"
    tolerances: GoughTolerances = field(default_factory=GoughTolerances)

    def expand(self) -> Assembly:
        """Return six legs in the stated form; MechanismError for a model that it cannot carry."""
        self._check()
        legs, own, errors = list[PlacedLimb](), list[Actuator](), ErrorModel()
        for i, length in enumerate(values_per_leg(self.lengths, 6, "lengths")):
            if not length >= 0.0:
                raise MechanismError(
                    f"leg {i + 1} of {self.name} has the length {length * 1e3:g} mm at reading "
                    "zero. A length must be positive, or zero if readings are whole lengths"
                )
            leg, motor = self._leg(i, length), f"q{i + 1}"
            legs.append(leg)
            # a rod has its length in the ending, a chain in the offset of its sliding joint
            terms = {} if self.legs == "rod" else {"offset": length}
            own.append(Actuator(motor, Dimension.LENGTH, self.stroke, terms))
            errors += self._errors(leg, motor, length)
        links, angles = self.tolerances.links, self.tolerances.angles
        is_complete = self.error_model == "complete"
        return self.assemble(
            legs,
            errors,
            freedoms=AXES,
            controlled=("x", "y", "z", "roll", "pitch", "yaw"),
            own=own,
            complete=LinkTolerances(links, angles) if is_complete else None,
        )

    def _check(self) -> None:
        is_rod = self.legs == "rod"
        check_spherical(self.name, self.spherical, "complete" if is_rod else self.error_model)
        needs_chain = "but a rod has no joints that could carry it. Give legs: ups"
        for key, is_stated, reason in (
            ("error_model: complete", is_rod and self.error_model == "complete", needs_chain),
            ("spherical: axes", is_rod and self.spherical == "axes", needs_chain),
            ("a screw", is_rod and self.screw is not None, needs_chain),
            (
                *("cones", not is_rod and self.cones != GoughCones()),
                "whose joints have no cones. Give legs: rod",
            ),
        ):
            if is_stated:
                raise MechanismError(f"{self.name} states legs: {self.legs} with {key}, {reason}")
        lists = [("base", self.base), ("platform", self.platform)]
        if self.screw:
            own = self.screw
            lists += [("base_axes", own.base_axes), ("platform_axes", own.platform_axes)]
        for key, values in lists:
            if len(values) != 6:
                raise MechanismError(
                    f"{self.name} has {len(values)} values under `{key}:`; a hexapod has six"
                )

    def _leg(self, i: int, length: float) -> PlacedLimb:
        """Return leg i in its form."""
        leg, motor, base, top = f"leg{i + 1}", f"q{i + 1}", self.base[i], self.platform[i]
        if self.legs == "rod":
            ends = placement.translate(*base), placement.translate(*top)
            cones = self._cones(*ends)
            return placement.place_limb(leg, (), ends[0], "distance", ends[1], length, motor, cones)
        axes, screw = self.spherical == "axes", self.screw
        of_leg = None
        if screw:
            leads = values_per_leg(screw.lead, 6, "the screw's lead")
            of_leg = leads[i], screw.base_axes[i], screw.platform_axes[i]
        return build_leg(leg, motor, base, top, self.home.matrix, axes, of_leg)

    def _cones(self, base: FloatArray, top: FloatArray) -> tuple[Cone, ...]:
        """Return the cones of a rod between these centers (4, 4), about its direction at home."""
        home = self.home.matrix
        rod = (home @ top)[:3, 3] - base[:3, 3]
        toward = -home[:3, :3].T @ rod
        ends = ("tip", self.cones.base, rod), ("attachment", self.cones.platform, toward)
        return tuple(
            Cone(end, (float(axis[0]), float(axis[1]), float(axis[2])), angle)
            for end, angle, axis in ends
            if angle is not None
        )

    def _errors(self, leg: PlacedLimb, motor: str, length: float) -> ErrorModel:
        """Return two centers and a length, the same in both forms; of the complete model, whose
        links have errors of their own, the length.
        """
        sd, name, errors = self.tolerances, f"{leg.name}.length", ErrorModel()
        length_sd = placement.standard_deviation(sd.length, "the leg lengths")
        if self.error_model == "ideal":
            base_sd = placement.standard_deviation(sd.base, "the base centers")
            platform_sd = placement.standard_deviation(sd.platform, "the platform centers")
            errors = placement.point_errors(f"{leg.name}.base.", leg, leg.elements[0], base_sd)
            errors += placement.point_errors(f"{leg.name}.platform.", leg, "platform", platform_sd)
        if self.legs == "rod":
            return errors + placement.rod_length_error(leg, name, length_sd)
        return errors + placement.offset_error(
            name, motor, Dimension.LENGTH, length, length_sd, positive=True
        )
