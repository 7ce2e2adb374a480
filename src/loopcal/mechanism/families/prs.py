# SPDX-License-Identifier: Apache-2.0
"""Limbs with a carriage on a fixed guide: PRS (carriage, revolute joint, rod, ball) and PUS limbs.

A PUS limb has a carriage and a rod between two balls. Both limbs begin at a chain frame on the
base, whose z axis is the guide, and end in a chain frame on the platform. Their named parameters
are those of doi:10.1177/1687814016667908: joint centers a on the platform and b on the base, offset
q along the guide, rod length l, direction of the guide (angles thB) and of the revolute joint
(angles thC), all in the chain frame. A tilted guide moves the carriage and does not rotate the
revolute joint on it. Derivation: docs/theory/tripods.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Joint
from loopcal.mechanism.families.error_models import (
    ErrorModel,
    ErrorTolerances,
    displacement_error,
    join_errors,
    offset_error,
    rod_length_error,
    single_error,
)
from loopcal.mechanism.families.limb_placement import (
    EX,
    EY,
    EZ,
    JointPlacement,
    PlacedLimb,
    map_slide_tilt,
    place_limb,
    place_limb_with_ball,
)
from loopcal.mechanism.families.records import AngleTolerance, LengthTolerance, standard_deviation
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True)
class TripodTolerances:
    """Tolerances of all lengths (centers, offsets, rods) and of all angles."""

    lengths: LengthTolerance | None = None
    angles: AngleTolerance | None = None

    @property
    def deviations(self) -> ErrorTolerances:
        """Standard deviations [m, rad]."""
        return ErrorTolerances(
            standard_deviation(self.lengths, "the lengths"),
            standard_deviation(self.angles, "the angles"),
        )


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
                f"{aside * 1e3:.6g} mm beside the guide at home; state a longer rod"
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
    frames: ChainFrames,
    spread: ErrorTolerances,
    *,
    foot: str = "xy",
    guide: str = "xy",
    joint: str = "",
) -> ErrorModel:
    """Return the named parameters of a limb with a carriage, `number` in their names.

    They are a.. (all three axes), b.., q, l, thB.. and thC.., see the module.

    Parameters
    ----------
    foot, guide, joint : axes of b, thB and thC. The z coordinate of b has the same effect as q.
    """
    length, angle = spread.length, spread.angle
    errors = []
    for letter, element, frame, axes in (
        ("a", "platform", frames.platform, "xyz"),
        ("b", "guide", frames.base, foot),
    ):
        point = frame[:3, :3].T @ frame[:3, 3]
        for axis in axes:
            name, nominal = f"{letter}{number}{axis}", point["xyz".index(axis)]
            errors.append(displacement_error(name, limb, element, axis, length, nominal))
    (motor,), rod = limb.limb.drives, f"l{number}"
    errors.append(offset_error(f"q{number}", motor, Dimension.LENGTH, 0.0, length))
    if limb.limb.ending == "distance":
        errors.append(rod_length_error(limb, rod, length))
    else:
        errors.append(
            displacement_error(rod, limb, "tip", "z", length, frames.length, positive=True)
        )
    for axis in guide:
        name, has_joint = f"thB{number}{axis}", len(limb.limb.joints) > 1
        if has_joint:
            maps = map_slide_tilt(name, limb, "guide", f"r{axis}")
            errors.append(single_error(name, Dimension.ANGLE, 0.0, angle, *maps))
        else:
            errors.append(displacement_error(name, limb, "guide", f"r{axis}", angle))
    errors += (
        displacement_error(f"thC{number}{axis}", limb, "joint", f"r{axis}", angle) for axis in joint
    )
    return join_errors(errors)
