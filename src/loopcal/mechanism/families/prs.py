# SPDX-License-Identifier: Apache-2.0
"""Limbs with a carriage on a fixed guide: PRS (carriage, revolute joint, rod, ball) and PUS
(carriage, rod between balls).

Both begin at a chain frame on the base, whose z axis the guide follows, and end in a chain frame on
the platform. Their named parameters are those of doi:10.1177/1687814016667908: joint centres a on
the platform and b on the base, offset q along the guide, rod length l, direction of the guide
(angles thB) and of the revolute joint (angles thC), all in the chain frame. A tilted guide moves
the carriage and does not turn the revolute joint on it. Derivation: docs/theory/tripods.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Address, LinearMap
from loopcal.mechanism.families.chain import EX, EY, EZ, Placed, Step, at, moved, placed, tilted
from loopcal.mechanism.families.error_models import Errors, quantity
from loopcal.mechanism.families.records import AngleTolerance, LengthTolerance, standard_deviation
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True)
class TripodTolerances:
    """Tolerances of all lengths (centres, offsets, rods) and of all angles."""

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
class Frames:
    """Where a limb with a guide begins and ends.

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
        """From the foot of the guide to the ball at home (3,), in the chain frame [m]."""
        gap = (geometry.invert_pose(self.base) @ self.home @ self.platform)[:3, 3]
        if not np.hypot(gap[0], gap[1]) < self.length:
            raise MechanismError(
                f"the rod of {name} is {self.length * 1e3:g} mm long, but its ball is "
                f"{np.hypot(gap[0], gap[1]) * 1e3:.6g} mm "
                "beside the guide at home; the rod must be longer"
            )
        return gap


def prs_limb(name: str, motor: str, frames: Frames, axis: str, axes: bool) -> Placed:
    """Carriage, revolute joint about `axis` (x or y) of the chain frame, rod upwards, ball (or
    three axes).
    """
    gap = frames.gap(name)
    # the rod points along z at joint angle zero and leans towards the ball at home
    lean = float(np.arcsin(gap[0] / frames.length if axis == "y" else -gap[1] / frames.length))
    turn = EY if axis == "y" else EX
    steps = (
        Step(
            "guide", "P", frames.base, EZ, motor, start=float(gap[2] - frames.length * np.cos(lean))
        ),
        Step("joint", "R", np.eye(4), turn, start=lean),
    )
    end = at(0.0, 0.0, frames.length)
    if not axes:
        return placed(name, steps, end, "ball", frames.platform)
    upright = geometry.make_pose(
        geometry.exp_so3(-lean * turn), np.array([0.0, 0.0, frames.length])
    )
    return placed(name, (*steps, *_ball(upright, frames)), np.eye(4), "rigid", frames.platform)


def pus_limb(name: str, motor: str, frames: Frames, axes: bool) -> Placed:
    """Carriage and a rod of fixed length between two balls (or universal joint and three axes)."""
    gap = frames.gap(name)
    height = float(np.sqrt(frames.length**2 - gap[0] ** 2 - gap[1] ** 2))
    guide = Step("guide", "P", frames.base, EZ, motor, start=float(gap[2] - height))
    if not axes:
        return placed(name, (guide,), np.eye(4), "distance", frames.platform, frames.length)
    rod = np.array([gap[0], gap[1], height])
    first = np.cross(rod, EY)
    steps = (
        guide,
        Step("universal1", "R", np.eye(4), first),
        Step("universal2", "R", np.eye(4), np.cross(rod, first)),
    )
    return placed(name, (*steps, *_ball(at(*rod), frames)), np.eye(4), "rigid", frames.platform)


def _ball(place: FloatArray, frames: Frames) -> tuple[Step, ...]:
    """Three axes through the ball's centre, at zero in the home pose."""
    relative = frames.base[:3, :3].T @ frames.home[:3, :3] @ frames.platform[:3, :3]
    place = place @ geometry.make_pose(relative, np.zeros(3))
    return tuple(
        Step(f"ball{i + 1}", "R", place if i == 0 else np.eye(4), axis)
        for i, axis in enumerate((EZ, EY, EX))
    )


def ends(limb: Placed, number: int, frames: Frames, tolerance: float | None) -> Errors:
    """a.., the centre on the platform (three), and b.., the foot of the guide (two), each in its
    chain frame.
    """
    found = Errors()
    for letter, element, axes in (("a", "platform", "xyz"), ("b", "guide", "xy")):
        frame = frames.platform if letter == "a" else frames.base
        for axis in axes:
            name = f"{letter}{number}{axis}"
            nominal = (frame[:3, :3].T @ frame[:3, 3])["xyz".index(axis)]
            found += quantity(
                name, Dimension.LENGTH, nominal, tolerance, *moved(name, limb, element, axis)
            )
    return found


def foot_height(limb: Placed, number: int, tolerance: float | None) -> Errors:
    """b.z, which the offset along the guide repeats."""
    name = f"b{number}z"
    return quantity(name, Dimension.LENGTH, 0.0, tolerance, *moved(name, limb, "guide", "z"))


def drive_and_rod(
    limb: Placed, motor: str, number: int, frames: Frames, tolerance: float | None
) -> Errors:
    """q., the carriage's place at reading zero, and l., the rod's length."""
    q, rod = f"q{number}", f"l{number}"
    rods = (
        (LinearMap(rod, Address(limb.name, "rod", "length")),)
        if limb.limb.ending == "distance"
        else moved(rod, limb, "tip", "z")
    )
    return quantity(
        q, Dimension.LENGTH, 0.0, tolerance, LinearMap(q, Address(motor, "transmission", "offset"))
    ) + quantity(rod, Dimension.LENGTH, frames.length, tolerance, *rods)


def guide_angles(limb: Placed, number: int, axes: str, tolerance: float | None) -> Errors:
    """thB.., turns of the guide's direction about axes of the chain frame."""
    found = Errors()
    for axis in axes:
        name = f"thB{number}{axis}"
        maps = (
            tilted(name, limb, "guide", f"r{axis}")
            if limb.limb.joints[1:]
            else moved(name, limb, "guide", f"r{axis}")
        )
        found += quantity(name, Dimension.ANGLE, 0.0, tolerance, *maps)
    return found


def joint_angles(limb: Placed, number: int, axes: str, tolerance: float | None) -> Errors:
    """thC.., turns of the revolute joint's direction about axes of the chain frame."""
    found = Errors()
    for axis in axes:
        name = f"thC{number}{axis}"
        found += quantity(
            name, Dimension.ANGLE, 0.0, tolerance, *moved(name, limb, "joint", f"r{axis}")
        )
    return found


def check_spherical(name: str, spherical: str, error_model: str) -> None:
    """Refuse joints of three axes without errors; raises MechanismError."""
    if spherical == "axes" and error_model == "ideal":
        raise MechanismError(
            f"{name} states spherical: axes with error_model: ideal, whose named parameters see "
            "perfect points; "
            "state error_model: complete, or spherical: point"
        )
