# SPDX-License-Identifier: Apache-2.0
"""RU-PUS-PRS solar trackers: a platform on a post, turned in two angles by two carriages.

Chain 1 (PUS) ends at (-a1, 0, 0) of the platform with its guide at (-b1, 0), chain 2 (PRS) at (0,
a2, 0) with its guide at (0, b2) and its revolute joint along x; both guides are vertical. Chain 3
(RU) is the post: a revolute joint along y in the base's origin, a link of length r to the
platform's origin, there a universal joint with its first axis along x on the link and its second
along y of the platform. So the platform's origin stays where it is and only phi and theta are free.

Parameters: those of doi:10.1177/1687814016667908, which prints twenty-five without listing them
all. Chain 1 has a1x a1y a1z b1x b1y q1 l1 thB1x thB1y, chain 2 the same and thC2y thC2z, chain 3 r
and turns of its three axes, thOx thOz (revolute joint), thU1y thU1z (first axis) and thU2x thU2z
(second). That is `twenty-seven`, of rank 26: thOz turns post and first axis together, just as thU1z
does. `twenty-five` leaves out thOz, and thU1z, which thU2z nearly repeats: our choice. Derivation:
docs/theory/tripods.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.mechanism.assembly import AXES, Actuator, Assembly
from loopcal.mechanism.families.chain import EX, EY, Placed, Step, at, moved, placed
from loopcal.mechanism.families.error_models import Errors, Spread, complete, quantity
from loopcal.mechanism.families.prs import (
    Frames,
    TripodTolerances,
    check_spherical,
    drive_and_rod,
    ends,
    guide_angles,
    joint_angles,
    prs_limb,
    pus_limb,
)
from loopcal.mechanism.families.records import RobotRecord
from loopcal.units import Dimension, Length

POST_ANGLES = (
    ("thOx", "pivot", "rx"),
    ("thOz", "pivot", "rz"),
    ("thU1y", "universal1", "ry"),
    ("thU1z", "universal1", "rz"),
    ("thU2x", "platform", "rx"),
    ("thU2z", "platform", "rz"),
)
"""Turns of the post's axes: name, element, axis in the frame carried there (that of the base, or of
the platform).
"""

LEFT_OUT = ("thOz", "thU1z")
"""What the twenty-five leave out of the twenty-seven."""


@dataclass(frozen=True)
class RuPusPrs(RobotRecord):
    """An RU-PUS-PRS tracker's file.

    Attributes
    ----------
    platform_radius, base_radius, rod, post : a, b, l and r [m]. stroke : allowed readings (low,
        high) [m].
    error_model : `ideal`, the named parameters, or `complete`. parameters : with `ideal`, which set
        (see the module).
    spherical : joints at the rods' ends as perfect `point`s, or with `complete` as `axes` with
        errors of their own.
    tolerances : of lengths and angles.
    """

    platform_radius: Length = 0.0
    base_radius: Length = 0.0
    rod: Length = 0.0
    post: Length = 0.0
    stroke: tuple[Length, Length] | None = None
    error_model: Literal["ideal", "complete"] = "ideal"
    parameters: Literal["twenty-five", "twenty-seven"] = "twenty-five"
    spherical: Literal["point", "axes"] = "point"
    tolerances: TripodTolerances = field(default_factory=TripodTolerances)

    def expand(self) -> Assembly:
        """Three limbs under a free platform."""
        check_spherical(self.name, self.spherical, self.error_model)
        a, b, axes, home = (
            self.platform_radius,
            self.base_radius,
            self.spherical == "axes",
            self.home.matrix,
        )
        first = Frames(at(-b), at(-a), self.rod, home)
        second = Frames(at(0.0, b), at(0.0, a), self.rod, home)
        rod, tripod = (
            pus_limb("chain1", "q1", first, axes),
            prs_limb("chain2", "q2", second, "x", axes),
        )
        post = self._post()
        length, angle = self.tolerances.length, self.tolerances.angle
        if self.error_model == "complete":
            errors = sum(
                (complete(limb, Spread(length, angle)) for limb in (rod, tripod, post)),
                start=Errors(),
            )
        else:
            errors = (
                ends(rod, 1, first, length)
                + drive_and_rod(rod, "q1", 1, first, length)
                + guide_angles(rod, 1, "xy", angle)
                + ends(tripod, 2, second, length)
                + drive_and_rod(tripod, "q2", 2, second, length)
                + guide_angles(tripod, 2, "xy", angle)
                + joint_angles(tripod, 2, "yz", angle)
                + self._post_errors(post, length, angle)
            )
        return Assembly(
            name=self.name,
            source=self.source,
            limbs=(rod.limb, tripod.limb, post.limb),
            actuators=tuple(Actuator(q, Dimension.LENGTH, self.stroke) for q in ("q1", "q2")),
            freedoms=AXES,
            controlled=("phi", "theta"),
            home=home,
            tool=self.tool.matrix,
            workspace=self.workspace.ranges,
            parameters=errors.parameters,
            maps=errors.maps,
        )

    def _post(self) -> Placed:
        """Revolute joint, link, universal joint; at home all frames are parallel to the base."""
        steps = (
            Step("pivot", "R", np.eye(4), EY),
            Step("universal1", "R", at(0.0, 0.0, self.post), EX),
            Step("universal2", "R", np.eye(4), EY),
        )
        return placed("chain3", steps, np.eye(4), "rigid", np.eye(4))

    def _post_errors(self, post: Placed, length: float | None, angle: float | None) -> Errors:
        """r and the angles of the post."""
        found = quantity(
            "r", Dimension.LENGTH, self.post, length, *moved("r", post, "universal1", "z")
        )
        for name, element, axis in POST_ANGLES:
            if self.parameters == "twenty-seven" or name not in LEFT_OUT:
                found += quantity(
                    name, Dimension.ANGLE, 0.0, angle, *moved(name, post, element, axis)
                )
        return found
