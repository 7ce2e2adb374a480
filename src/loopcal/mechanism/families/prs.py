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

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Address, LinearMap
from loopcal.mechanism.families.error_models import ErrorModel, single_error
from loopcal.mechanism.families.limb_placement import (
    EX,
    EY,
    EZ,
    JointPlacement,
    PlacedLimb,
    map_displacement,
    map_slide_tilt,
    place_limb,
    translate,
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
    def length(self) -> float | None:
        """Standard deviation of the lengths [m]."""
        return standard_deviation(self.lengths, "the lengths")

    @property
    def angle(self) -> float | None:
        """Standard deviation of the angles [rad]."""
        return standard_deviation(self.angles, "the angles")


@dataclass(frozen=True)
class ChainFrames:
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

    def gap(self, name: str) -> FloatArray:
        """Return the vector from the foot of the guide to the ball at home (3,) [m]."""
        gap = (geometry.invert_pose(self.base) @ self.home @ self.platform)[:3, 3]
        if not np.hypot(gap[0], gap[1]) < self.length:
            raise MechanismError(
                f"the rod of {name} is {self.length * 1e3:g} mm long, but its ball is "
                f"{np.hypot(gap[0], gap[1]) * 1e3:.6g} mm "
                "beside the guide at home; state a longer rod"
            )
        return gap


def build_prs_limb(name: str, motor: str, frames: ChainFrames, axis: str, axes: bool) -> PlacedLimb:
    """Return a limb of carriage, revolute joint about `axis` (x or y), rod upwards and ball.

    `axes` replaces the ball by three axes.
    """
    gap = frames.gap(name)
    # the rod points along z at joint angle zero and leans towards the ball at home
    lean = float(np.arcsin(gap[0] / frames.length if axis == "y" else -gap[1] / frames.length))
    turn = EY if axis == "y" else EX
    steps = (
        JointPlacement(
            "guide", "P", frames.base, EZ, motor, start=float(gap[2] - frames.length * np.cos(lean))
        ),
        JointPlacement("joint", "R", np.eye(4), turn, start=lean),
    )
    end = translate(0.0, 0.0, frames.length)
    if not axes:
        return place_limb(name, steps, end, "ball", frames.platform)
    upright = geometry.make_pose(
        geometry.exp_so3(-lean * turn), np.array([0.0, 0.0, frames.length])
    )
    return place_limb(name, (*steps, *_ball(upright, frames)), np.eye(4), "rigid", frames.platform)


def build_pus_limb(name: str, motor: str, frames: ChainFrames, axes: bool) -> PlacedLimb:
    """Return a limb of a carriage and a rod of fixed length between two balls.

    `axes` replaces them by a universal joint and three axes.
    """
    gap = frames.gap(name)
    height = float(np.sqrt(frames.length**2 - gap[0] ** 2 - gap[1] ** 2))
    guide = JointPlacement("guide", "P", frames.base, EZ, motor, start=float(gap[2] - height))
    if not axes:
        return place_limb(name, (guide,), np.eye(4), "distance", frames.platform, frames.length)
    rod = np.array([gap[0], gap[1], height])
    first = np.cross(rod, EY)
    steps = (
        guide,
        JointPlacement("universal1", "R", np.eye(4), first),
        JointPlacement("universal2", "R", np.eye(4), np.cross(rod, first)),
    )
    return place_limb(
        name, (*steps, *_ball(translate(*rod), frames)), np.eye(4), "rigid", frames.platform
    )


def _ball(place: FloatArray, frames: ChainFrames) -> tuple[JointPlacement, ...]:
    """Return three axes through the ball's center, at zero in the home pose."""
    relative = frames.base[:3, :3].T @ frames.home[:3, :3] @ frames.platform[:3, :3]
    place = place @ geometry.make_pose(relative, np.zeros(3))
    return tuple(
        JointPlacement(f"ball{i + 1}", "R", place if i == 0 else np.eye(4), axis)
        for i, axis in enumerate((EZ, EY, EX))
    )


def end_errors(
    limb: PlacedLimb, number: int, frames: ChainFrames, tolerance: float | None
) -> ErrorModel:
    """Return a.., the center on the platform (three), and b.., the foot of the guide (two).

    Each is written in its chain frame.
    """
    errors = ErrorModel()
    for letter, element, axes in (("a", "platform", "xyz"), ("b", "guide", "xy")):
        frame = frames.platform if letter == "a" else frames.base
        for axis in axes:
            name = f"{letter}{number}{axis}"
            nominal = (frame[:3, :3].T @ frame[:3, 3])["xyz".index(axis)]
            errors += single_error(
                name,
                Dimension.LENGTH,
                nominal,
                tolerance,
                *map_displacement(name, limb, element, axis),
            )
    return errors


def foot_height_error(limb: PlacedLimb, number: int, tolerance: float | None) -> ErrorModel:
    """Return b.z, which has the same effect as the offset along the guide."""
    name = f"b{number}z"
    return single_error(
        name, Dimension.LENGTH, 0.0, tolerance, *map_displacement(name, limb, "guide", "z")
    )


def drive_and_rod_errors(
    limb: PlacedLimb, motor: str, number: int, frames: ChainFrames, tolerance: float | None
) -> ErrorModel:
    """Return q., the carriage's position at reading zero, and l., the rod's length."""
    q, rod = f"q{number}", f"l{number}"
    rods = (
        (LinearMap(rod, Address(limb.name, "rod", "length")),)
        if limb.limb.ending == "distance"
        else map_displacement(rod, limb, "tip", "z")
    )
    return single_error(
        q, Dimension.LENGTH, 0.0, tolerance, LinearMap(q, Address(motor, "transmission", "offset"))
    ) + single_error(rod, Dimension.LENGTH, frames.length, tolerance, *rods)


def guide_angle_errors(
    limb: PlacedLimb, number: int, axes: str, tolerance: float | None
) -> ErrorModel:
    """Return thB.., rotations of the guide about axes of the chain frame."""
    errors = ErrorModel()
    for axis in axes:
        name = f"thB{number}{axis}"
        maps = (
            map_slide_tilt(name, limb, "guide", f"r{axis}")
            if limb.limb.joints[1:]
            else map_displacement(name, limb, "guide", f"r{axis}")
        )
        errors += single_error(name, Dimension.ANGLE, 0.0, tolerance, *maps)
    return errors


def joint_angle_errors(
    limb: PlacedLimb, number: int, axes: str, tolerance: float | None
) -> ErrorModel:
    """Return thC.., rotations of the revolute joint about axes of the chain frame."""
    errors = ErrorModel()
    for axis in axes:
        name = f"thC{number}{axis}"
        errors += single_error(
            name,
            Dimension.ANGLE,
            0.0,
            tolerance,
            *map_displacement(name, limb, "joint", f"r{axis}"),
        )
    return errors


def check_spherical(name: str, spherical: str, error_model: str) -> None:
    """Refuse balls of three axes without errors; raises MechanismError."""
    if spherical == "axes" and error_model == "ideal":
        raise MechanismError(
            f"{name} states spherical: axes with error_model: ideal, whose parameters describe "
            "perfect points; state error_model: complete, or spherical: point"
        )
