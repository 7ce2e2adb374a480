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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Actuator, Assembly, Joint
from loopcal.mechanism.families.placement import (
    EX,
    EY,
    EZ,
    ErrorModel,
    JointPlacement,
    LinkTolerances,
    PlacedLimb,
    displacement_error,
    join_errors,
    map_displacement,
    map_slide_tilt,
    offset_error,
    place_limb,
    place_limb_with_ball,
    point_errors,
    rod_length_error,
    rotate_about,
    single_error,
    translate,
)
from loopcal.mechanism.families.records import RobotRecord, check_spherical
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Length


class ChainFrames(NamedTuple):
    """The frames in which a limb with a guide begins and ends.

    Attributes
    ----------
    base : (4, 4) chain frame in the base, at the foot of the guide. platform : (4, 4) chain frame
        in the platform, at the ball.
    length : of the rod [m]. home : (4, 4) T_base_platform of the home pose.
    """

    base: FloatArray
    platform: FloatArray
    length: float
    home: FloatArray

    @property
    def orientation(self) -> FloatArray:
        """Orientation (3, 3) of the platform's chain frame in that of the base, at home."""
        return self.base[:3, :3].T @ self.home[:3, :3] @ self.platform[:3, :3]

    def gap(self, name: str) -> FloatArray:
        """Return the vector from the foot of the guide to the ball at home (3,) [m]."""
        gap = (geometry.invert_pose(self.base) @ self.home @ self.platform)[:3, 3]
        aside = float(np.hypot(gap[0], gap[1]))
        if not aside < self.length:
            raise MechanismError(
                f"the rod of {name} is {self.length * 1e3:g} mm long, but its ball is "
                f"{aside * 1e3:.6g} mm away from the guide at home. Give a longer rod"
            )
        return gap


def build_prs_limb(name: str, motor: str, frames: ChainFrames, axis: str, axes: bool) -> PlacedLimb:
    """Return a limb of carriage, revolute joint about `axis` (x or y), rod upwards and ball.

    `axes` replaces the ball by three axes.
    """
    gap, length = frames.gap(name), frames.length
    # the rod points along z at joint angle zero and leans towards the ball at home
    lean = float(np.arcsin(gap[0] / length if axis == "y" else -gap[1] / length))
    turn = EY if axis == "y" else EX
    guide = Joint("guide", "P", motor, start=float(gap[2] - length * np.cos(lean)))
    steps = (
        JointPlacement(guide, frames.base, EZ),
        JointPlacement(Joint("joint", "R", start=lean), np.eye(4), turn),
    )
    upright = geometry.exp_so3(-lean * turn) @ frames.orientation if axes else None
    return place_limb_with_ball(name, steps, length * EZ, frames.platform, upright)


def build_pus_limb(name: str, motor: str, frames: ChainFrames, axes: bool) -> PlacedLimb:
    """Return a limb of a carriage and a rod of fixed length between two balls.

    `axes` replaces them by a universal joint and three axes.
    """
    gap = frames.gap(name)
    height = float(np.sqrt(frames.length**2 - gap[0] ** 2 - gap[1] ** 2))
    slide = Joint("guide", "P", motor, start=float(gap[2] - height))
    guide = JointPlacement(slide, frames.base, EZ)
    if not axes:
        return place_limb(name, (guide,), np.eye(4), "distance", frames.platform, frames.length)
    rod = np.array([gap[0], gap[1], height])
    first = np.cross(rod, EY)
    steps = (
        guide,
        JointPlacement(Joint("universal1", "R"), np.eye(4), first),
        JointPlacement(Joint("universal2", "R"), np.eye(4), np.cross(rod, first)),
    )
    return place_limb_with_ball(name, steps, rod, frames.platform, frames.orientation)


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
    errors = [point_errors(f"a{number}", limb, "platform", length)]
    errors.append(point_errors(f"b{number}", limb, "guide", length, foot))
    (motor,), rod = limb.limb.drives, f"l{number}"
    errors.append(offset_error(f"q{number}", motor, Dimension.LENGTH, 0.0, length))
    if limb.limb.ending == "distance":
        errors.append(rod_length_error(limb, rod, length))
    else:
        errors.append(displacement_error(rod, limb, "tip", "z", length, positive=True))
    # a tilt of the guide does not rotate a joint on the carriage
    tilt = map_slide_tilt if len(limb.limb.joints) > 1 else map_displacement
    for axis in guide:
        name = f"thB{number}{axis}"
        maps = tilt(name, limb, "guide", f"r{axis}")
        errors.append(single_error(name, Dimension.ANGLE, 0.0, angle, *maps))
    errors += (
        displacement_error(f"thC{number}{axis}", limb, "joint", f"r{axis}", angle) for axis in joint
    )
    return join_errors(errors)


# RU-PUS-PRS solar trackers: a platform on a post, tilted about two axes by two carriages.

POST_ANGLES = (
    ("thOx", "pivot", "rx"),
    ("thOz", "pivot", "rz"),
    ("thU1y", "universal1", "ry"),
    ("thU1z", "universal1", "rz"),
    ("thU2x", "platform", "rx"),
    ("thU2z", "platform", "rz"),
)
"""Rotations of the post's axes: name, element, axis of the carried frame (base or platform)."""

LEFT_OUT = ("thOz", "thU1z")
"""Parameters of the twenty-seven that the twenty-five leave out."""


@dataclass(frozen=True)
class CarriageRobot(RobotRecord):
    """The keys of robots with carriages.

    Attributes
    ----------
    platform_radius, base_radius, rod : a, b and l [m]. stroke : allowed readings (low, high) [m].
    error_model : `ideal`, the named parameters, or `complete`.
    spherical : joints at the upper ends of rods, of a PUS limb at both, as perfect `point`s, or
        with `complete` as three `axes` with errors of their own.
    tolerances : of lengths and angles.
    """

    OLDER_KEYS: ClassVar[Mapping[str, tuple[type, str]]] = {
        **RobotRecord.OLDER_KEYS,
        "parameters": (str, "parameter_set"),
    }

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
            ErrorModel() if spread else join_errors(errors),
            freedoms=AXES,
            controlled=controlled,
            own=(Actuator(name, Dimension.LENGTH, self.stroke) for name in drives),
            complete=spread,
        )


@dataclass(frozen=True)
class RuPusPrs(CarriageRobot):
    """The file of an RU-PUS-PRS tracker.

    Attributes
    ----------
    post : its length r [m]. parameter_set : with `ideal`, the set (see the module); `parameters:`
        with the name of a set means the same.
    """

    family = "ru-pus-prs"

    post: Length = 0.0
    parameter_set: Literal["twenty-five", "twenty-seven"] = "twenty-five"

    def expand(self) -> Assembly:
        """Return three limbs under a free platform."""
        a, b, axes = self.platform_radius, self.base_radius, self.spherical == "axes"
        home, spread = self.home.matrix, self.tolerances
        first = ChainFrames(translate(-b), translate(-a), self.rod, home)
        second = ChainFrames(translate(0.0, b), translate(0.0, a), self.rod, home)
        # revolute joint, link and universal joint; at home all frames are parallel
        steps = (
            JointPlacement(Joint("pivot", "R"), np.eye(4), EY),
            JointPlacement(Joint("universal1", "R"), translate(0.0, 0.0, self.post), EX),
            JointPlacement(Joint("universal2", "R"), np.eye(4), EY),
        )
        limbs = (
            build_pus_limb("chain1", "q1", first, axes),
            build_prs_limb("chain2", "q2", second, "x", axes),
            place_limb("chain3", steps, np.eye(4), "rigid", np.eye(4)),
        )

        def list_errors() -> Iterator[ErrorModel]:
            yield carriage_errors(limbs[0], 1, spread)
            yield carriage_errors(limbs[1], 2, spread, joint="yz")
            of_post = limbs[2], "universal1", "z", spread.select(Dimension.LENGTH)
            yield displacement_error("r", *of_post, positive=True)
            angle = spread.select(Dimension.ANGLE)
            left_out = LEFT_OUT if self.parameter_set == "twenty-five" else ()
            for name, element, axis in POST_ANGLES:
                if name not in left_out:
                    yield displacement_error(name, limbs[2], element, axis, angle)

        return self.join(limbs, list_errors(), "phi", "theta")


# 3-PRS tripods: three carriages on vertical guides, rods that swing in vertical planes, balls.


@dataclass(frozen=True)
class ThreePrs(CarriageRobot):
    """The file of a 3-PRS tripod.

    Attributes
    ----------
    parameter_set : with `ideal`, the `eleven` identifiable ones of each chain, or all `fourteen`;
        `parameters:` with the name of a set means the same.
    """

    family = "3-prs"

    parameter_set: Literal["eleven", "fourteen"] = "eleven"

    def expand(self) -> Assembly:
        """Return three PRS limbs under a free platform."""
        base, platform = translate(self.base_radius), translate(self.platform_radius)
        turns = [rotate_about(EZ, 2 * np.pi / 3 * k) for k in range(3)]
        home, axes, spread = self.home.matrix, self.spherical == "axes", self.tolerances
        frames = [ChainFrames(T @ base, T @ platform, self.rod, home) for T in turns]
        limbs = [
            build_prs_limb(f"chain{k}", f"q{k}", own, "y", axes) for k, own in enumerate(frames, 1)
        ]
        chosen = {"foot": "xyz", "guide": "xyz", "joint": "xyz"}
        if self.parameter_set == "eleven":
            chosen = {"joint": "xz"}
        errors = (carriage_errors(limb, k, spread, **chosen) for k, limb in enumerate(limbs, 1))
        return self.join(limbs, errors, "z", "phi", "theta")
