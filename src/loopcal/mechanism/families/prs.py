# SPDX-License-Identifier: Apache-2.0
"""Limbs with a carriage on a fixed guide: PRS (carriage, revolute joint, rod, ball) and PUS limbs.

A PUS limb has a carriage and a rod between two balls. Both limbs begin at a chain frame on the
base, whose z axis is the guide, and end in a chain frame on the platform. Their named parameters
are those of doi:10.1177/1687814016667908: joint centers a on the platform and b on the base, offset
q along the guide, rod length l, direction of the guide (angles thB) and of the revolute joint
(angles thC), all in the chain frame. A tilted guide moves the carriage and does not rotate the
revolute joint on it. Derivation: docs/theory/families.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Actuator, Assembly, Joint
from loopcal.mechanism.families import placement
from loopcal.mechanism.families.placement import (
    ErrorModel,
    JointPlacement,
    LinkTolerances,
    PlacedLimb,
)
from loopcal.mechanism.families.records import RobotRecord, check_spherical
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Length


def build_carriage_limb(
    number: int,
    base: FloatArray,
    platform: FloatArray,
    length: float,
    home: FloatArray,
    axis: str = "",
    axes: bool = False,
) -> PlacedLimb:
    """Return the limb `chain1` with the drive `q1`, or another number: a carriage and a rod [m].

    base, platform : (4, 4) chain frames, at the foot of the guide in the base and at the upper ball
        in the platform. home : (4, 4) T_base_platform.
    axis : of the revolute joint at the carriage (x or y), with the rod upwards; without it a ball.
    axes : three axes replace the upper ball, a universal joint the lower one.
    """
    name, T = f"chain{number}", geometry.invert_pose(base) @ home @ platform
    gap, aside = T[:3, 3], float(np.hypot(T[0, 3], T[1, 3]))
    if not aside < length:
        raise MechanismError(
            f"the rod of {name} is {length * 1e3:g} mm long, but its ball is {aside * 1e3:.6g} mm "
            "away from the guide at home. Give a longer rod"
        )
    # the rod points along z at joint angle zero and leans towards the ball at home
    lean = float(np.arcsin((gap[0] if axis == "y" else -gap[1]) / length))
    height = float(
        length * np.cos(lean) if axis else np.sqrt(length**2 - gap[0] ** 2 - gap[1] ** 2)
    )
    slide = Joint("guide", "P", name.replace("chain", "q"), start=float(gap[2] - height))
    steps: tuple[JointPlacement, ...] = (JointPlacement(slide, base, placement.EZ),)
    rod, upright = np.array([gap[0], gap[1], height]), T[:3, :3]
    if axis:
        turn = placement.EY if axis == "y" else placement.EX
        steps += (JointPlacement(Joint("joint", "R", start=lean), np.eye(4), turn),)
        rod, upright = length * placement.EZ, geometry.exp_so3(-lean * turn) @ upright
    elif axes:
        first = np.cross(rod, placement.EY)
        steps += (
            JointPlacement(Joint("universal1", "R"), np.eye(4), first),
            JointPlacement(Joint("universal2", "R"), np.eye(4), np.cross(rod, first)),
        )
    else:
        return placement.place_limb(name, steps, np.eye(4), "distance", platform, length)
    return placement.place_limb_with_ball(name, steps, rod, platform, upright if axes else None)


def carriage_errors(
    limb: PlacedLimb,
    number: int,
    spread: LinkTolerances,
    *,
    foot: str = "xy",
    guide: str = "xy",
    joint: str = "",
) -> ErrorModel:
    """Return the named parameters of a limb with a carriage, `number` in their names.

    They are a.. (all three axes), b.., q, l, thB.. and thC.., see the module.

    foot, guide, joint : axes of b, thB and thC. The z coordinate of b has the same effect as q.
    """
    length, angle = map(spread.select, (Dimension.LENGTH, Dimension.ANGLE))
    errors = [placement.point_errors(f"a{number}", limb, "platform", length)]
    errors.append(placement.point_errors(f"b{number}", limb, "guide", length, foot))
    (motor,), rod = limb.limb.drives, f"l{number}"
    errors.append(placement.offset_error(f"q{number}", motor, Dimension.LENGTH, 0.0, length))
    if limb.limb.ending == "distance":
        errors.append(placement.rod_length_error(limb, rod, length))
    else:
        errors.append(placement.displacement_error(rod, limb, "tip", "z", length, positive=True))
    # a tilt of the guide does not rotate a joint on the carriage
    tilt = placement.map_slide_tilt if len(limb.limb.joints) > 1 else placement.map_displacement
    for axis in guide:
        name = f"thB{number}{axis}"
        maps = tilt(name, limb, "guide", f"r{axis}")
        errors.append(placement.single_error(name, Dimension.ANGLE, 0.0, angle, *maps))
    errors += (
        placement.displacement_error(f"thC{number}{axis}", limb, "joint", f"r{axis}", angle)
        for axis in joint
    )
    return placement.join_errors(errors)


# RU-PUS-PRS solar trackers: a platform on a post, tilted about two axes by two carriages.

# Rotations of the post's axes: name, element, axis of the carried frame (base or platform).
POST_ANGLES = (
    ("thOx", "pivot", "rx"),
    ("thOz", "pivot", "rz"),
    ("thU1y", "universal1", "ry"),
    ("thU1z", "universal1", "rz"),
    ("thU2x", "platform", "rx"),
    ("thU2z", "platform", "rz"),
)

LEFT_OUT = ("thOz", "thU1z")  # parameters of the twenty-seven that the twenty-five leave out


@dataclass(frozen=True)
class CarriageRobot(RobotRecord):
    """The keys of robots with carriages.

    platform_radius, base_radius, rod : a, b and l [m]. stroke : allowed readings (low, high) [m].
    error_model : `ideal`, the named parameters, or `complete`.
    spherical : joints at the upper ends of rods, of a PUS limb at both, as perfect `point`s, or
        with `complete` as three `axes` with errors of their own.
    tolerances : of lengths and angles.
    """

    platform_radius: Length = 0.0
    base_radius: Length = 0.0
    rod: Length = 0.0
    stroke: tuple[Length, Length] | None = None
    error_model: Literal["ideal", "complete"] = "ideal"
    spherical: Literal["point", "axes"] = "point"
    tolerances: LinkTolerances = field(default_factory=LinkTolerances)

    def join(
        self, limbs: Sequence[PlacedLimb], errors: Iterator[ErrorModel], *controlled: str
    ) -> Assembly:
        """Return limbs under a free platform; errors : of the ideal model."""
        check_spherical(self.name, self.spherical, self.error_model)
        spread = self.tolerances if self.error_model == "complete" else None
        drives = [name for limb in limbs for name in limb.limb.drives]
        return self.assemble(
            limbs,
            ErrorModel() if spread else placement.join_errors(errors),
            freedoms=AXES,
            controlled=controlled,
            own=(Actuator(name, Dimension.LENGTH, self.stroke) for name in drives),
            complete=spread,
        )


@dataclass(frozen=True)
class RuPusPrs(CarriageRobot):
    """The file of an RU-PUS-PRS tracker.

    post : its length r [m]. parameter_set : with `ideal`, the set (see the module).
    """

    family = "ru-pus-prs"

    post: Length = 0.0
    parameter_set: Literal["twenty-five", "twenty-seven"] = "twenty-five"

    def expand(self) -> Assembly:
        """Return three limbs under a free platform."""
        a, b, axes = self.platform_radius, self.base_radius, self.spherical == "axes"
        of_rods, spread = (self.rod, self.home.matrix), self.tolerances
        second = placement.translate(0.0, b), placement.translate(0.0, a)
        # revolute joint, link and universal joint; at home all frames are parallel
        steps = (
            JointPlacement(Joint("pivot", "R"), np.eye(4), placement.EY),
            JointPlacement(
                Joint("universal1", "R"), placement.translate(0.0, 0.0, self.post), placement.EX
            ),
            JointPlacement(Joint("universal2", "R"), np.eye(4), placement.EY),
        )
        limbs = (
            build_carriage_limb(
                1, placement.translate(-b), placement.translate(-a), *of_rods, "", axes
            ),
            build_carriage_limb(2, *second, *of_rods, "x", axes),
            placement.place_limb("chain3", steps, np.eye(4), "rigid", np.eye(4)),
        )

        def list_errors() -> Iterator[ErrorModel]:
            yield carriage_errors(limbs[0], 1, spread)
            yield carriage_errors(limbs[1], 2, spread, joint="yz")
            of_post = limbs[2], "universal1", "z", spread.select(Dimension.LENGTH)
            yield placement.displacement_error("r", *of_post, positive=True)
            angle = spread.select(Dimension.ANGLE)
            left_out = LEFT_OUT if self.parameter_set == "twenty-five" else ()
            for name, element, axis in POST_ANGLES:
                if name not in left_out:
                    yield placement.displacement_error(name, limbs[2], element, axis, angle)

        return self.join(limbs, list_errors(), "phi", "theta")


# 3-PRS tripods: three carriages on vertical guides, rods that swing in vertical planes, balls.


@dataclass(frozen=True)
class ThreePrs(CarriageRobot):
    """The file of a 3-PRS tripod.

    parameter_set : with `ideal`, the `eleven` identifiable ones of each chain, or all `fourteen`.
    """

    family = "3-prs"

    parameter_set: Literal["eleven", "fourteen"] = "eleven"

    def expand(self) -> Assembly:
        """Return three PRS limbs under a free platform."""
        base = placement.translate(self.base_radius)
        platform = placement.translate(self.platform_radius)
        turns = [placement.rotate_about(placement.EZ, 2 * np.pi / 3 * k) for k in range(3)]
        home, axes, spread = self.home.matrix, self.spherical == "axes", self.tolerances
        limbs = [
            build_carriage_limb(k, T @ base, T @ platform, self.rod, home, "y", axes)
            for k, T in enumerate(turns, 1)
        ]
        chosen = {"foot": "xyz", "guide": "xyz", "joint": "xyz"}
        if self.parameter_set == "eleven":
            chosen = {"joint": "xz"}
        errors = (carriage_errors(limb, k, spread, **chosen) for k, limb in enumerate(limbs, 1))
        return self.join(limbs, errors, "z", "phi", "theta")
