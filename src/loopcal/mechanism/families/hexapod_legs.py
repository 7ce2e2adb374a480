# SPDX-License-Identifier: Apache-2.0
"""Legs of a hexapod as chains: universal joint, driven slide, then a ball or a screw and a second
universal joint.

Two rotary joints across the leg point its slide at the upper center. A `ball` closes the chain, or
three axes through that center and a `rigid` ending if they have errors of their own.

In a leg with a screw the nut is carried by the lower universal joint and the spindle by the upper
one, so that |t + R p - b| = length + reading - lead a / (2 pi). The angle a about the leg, from the
lower joint's axis to the upper one's, both seen along the leg, is zero where they are parallel.
This is the correction of LinuxCNC's genhexkins, which takes asin(sin a) in place of a. Derivation:
docs/theory/hexapod.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Joint
from loopcal.mechanism.families.limb_placement import (
    EZ,
    JointPlacement,
    PlacedLimb,
    place_limb,
    place_limb_with_ball,
    rotation_matrix,
    translate,
)
from loopcal.mechanism.families.records import values_per_leg
from loopcal.typing import FloatArray
from loopcal.units import Length, Ratio

Direction = tuple[Ratio, Ratio, Ratio]


@dataclass(frozen=True)
class ScrewLeg:
    """Screw of one leg: lead [m per turn], joint axes fixed to base and platform (3,)."""

    lead: float
    base_axis: Direction
    platform_axis: Direction


@dataclass(frozen=True)
class Screw:
    """Screws in the legs of a hexapod.

    Attributes
    ----------
    lead : change of length in one turn [m], one for all legs or one each; negative for a
        left-handed screw.
    base_axes, platform_axes : direction of the joint axis fixed to the base (platform), leg by leg.
    """

    lead: Length | tuple[Length, ...] = 0.0
    base_axes: tuple[Direction, ...] = ()
    platform_axes: tuple[Direction, ...] = ()

    def legs(self) -> tuple[ScrewLeg, ...]:
        """Return the six screws; raises MechanismError for another number."""
        if len(self.base_axes) != 6 or len(self.platform_axes) != 6:
            raise MechanismError(
                f"the screw names {len(self.base_axes)} base_axes and {len(self.platform_axes)} "
                "platform_axes; name six of each"
            )
        leads = values_per_leg(self.lead, 6, "the screw's lead")
        return tuple(
            ScrewLeg(*leg) for leg in zip(leads, self.base_axes, self.platform_axes, strict=True)
        )


def build_ups_leg(
    name: str, motor: str, base: Direction, top: Direction, home: FloatArray, axes: bool
) -> PlacedLimb:
    """Return a leg whose joints are all at zero in the home pose.

    Parameters
    ----------
    base, top : centers in base and platform frame [m]. home : (4, 4) T_base_platform of the home
        pose.
    axes : True for an upper joint of three axes, False for a ball.
    """
    s, length = _find_direction(name, base, top, home)
    first = _across(s, EZ)
    # the axes in the base frame, which is the carried frame while every joint is at zero
    steps = (
        JointPlacement(Joint("universal1", "R"), translate(*base), first),
        JointPlacement(Joint("universal2", "R"), np.eye(4), np.cross(s, first)),
        JointPlacement(Joint("slide", "P", motor, start=length), np.eye(4), s),
    )
    return place_limb_with_ball(
        name, steps, np.zeros(3), translate(*top), home[:3, :3] if axes else None
    )


def build_screw_leg(
    name: str, motor: str, base: Direction, top: Direction, home: FloatArray, screw: ScrewLeg
) -> PlacedLimb:
    """Return a leg with a screw, in which the reading alone drives the slide.

    Raises
    ------
    MechanismError
        A joint axis lies along the leg at home.
    """
    s, length = _find_direction(name, base, top, home)
    lower = _normalize(name, screw.base_axis)
    upper = home[:3, :3] @ _normalize(name, screw.platform_axis)
    for axis in (lower, upper):
        if np.linalg.norm(np.cross(axis, s)) < 1e-6:
            raise MechanismError(
                f"a screw's joint axis lies along {name} at home; give it another direction"
            )
    low, high = _across(s, lower), _across(s, upper)
    turned = float(np.arctan2(np.cross(low, high) @ s, low @ high))
    # at zero the spindle stands turned back by the angle that it has at home
    back = rotation_matrix(geometry.exp_so3(-turned * s))
    pitch = screw.lead / (2 * np.pi)
    slide = Joint("slide", "P", motor, start=length + pitch * turned)
    thread = Joint("screw", "R", pitch=-pitch, start=turned)
    steps = (
        JointPlacement(Joint("universal1", "R"), translate(*base), lower),
        JointPlacement(Joint("universal2", "R"), np.eye(4), np.cross(s, low)),
        JointPlacement(slide, np.eye(4), s),
        JointPlacement(thread, np.eye(4), s),
        JointPlacement(Joint("universal3", "R"), back, np.cross(s, high)),
        JointPlacement(Joint("universal4", "R"), np.eye(4), upper),
    )
    return place_limb(name, steps, rotation_matrix(home[:3, :3]), "rigid", translate(*top))


def _find_direction(
    name: str, base: Direction, top: Direction, home: FloatArray
) -> tuple[FloatArray, float]:
    """Return the unit vector from the lower center to the upper one at home, and the distance."""
    gap = home[:3, :3] @ np.array(top, dtype=float) + home[:3, 3] - np.array(base, dtype=float)
    length = float(np.linalg.norm(gap))
    if not length > 0:
        raise MechanismError(f"{name} has length zero at home; move its centers or the home pose")
    return gap / length, length


def _across(s: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the unit vector across s nearest to `axis`, or any if they are parallel."""
    part = axis - float(axis @ s) * s
    if np.linalg.norm(part) < 1e-6 * np.linalg.norm(axis):
        part = np.cross(s, np.eye(3)[int(np.argmin(np.abs(s)))])
    return np.array(part / np.linalg.norm(part), dtype=float)


def _normalize(name: str, axis: Direction) -> FloatArray:
    """Return a unit vector (3,); raises MechanismError for zero."""
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise MechanismError(f"a joint axis of {name} is [0, 0, 0]; state a direction")
    return np.array(axis) / length
