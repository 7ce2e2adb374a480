# SPDX-License-Identifier: Apache-2.0
"""RU-PUS-PRS solar trackers: a platform on a post, tilted about two axes by two carriages.

Chain 1 (PUS) ends at (-a1, 0, 0) of the platform with its guide at (-b1, 0), chain 2 (PRS) at (0,
a2, 0) with its guide at (0, b2) and its revolute joint along x; both guides are vertical. Chain 3
(RU) is the post: a revolute joint along y in the base's origin, a link of length r to the
platform's origin, there a universal joint with its first axis along x on the link and its second
along y of the platform. The platform's origin stays fixed; only phi and theta are free.

Parameters: those of doi:10.1177/1687814016667908, which counts twenty-five without listing them
all. Chain 1 has a1x a1y a1z b1x b1y q1 l1 thB1x thB1y, chain 2 the same and thC2y thC2z, chain 3 r
and rotations of its three axes, thOx thOz (revolute joint), thU1y thU1z (first axis) and thU2x
thU2z (second). These are `twenty-seven`, of rank 26: thOz rotates post and first axis together, and
so does thU1z. `twenty-five` leaves out thOz, and thU1z, which thU2z nearly repeats: our choice.
Derivation: docs/theory/tripods.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.mechanism.assembly import AXES, Actuator, Assembly
from loopcal.mechanism.families.error_models import (
    ErrorModel,
    ErrorTolerances,
    complete_errors,
    single_error,
)
from loopcal.mechanism.families.limb_placement import (
    EX,
    EY,
    JointPlacement,
    PlacedLimb,
    map_displacement,
    place_limb,
    translate,
)
from loopcal.mechanism.families.prs import (
    ChainFrames,
    TripodTolerances,
    build_prs_limb,
    build_pus_limb,
    check_spherical,
    drive_and_rod_errors,
    end_errors,
    guide_angle_errors,
    joint_angle_errors,
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
"""Rotations of the post's axes: name, element, axis of the carried frame (base or platform)."""

LEFT_OUT = ("thOz", "thU1z")
"""Parameters of the twenty-seven that the twenty-five leave out."""


@dataclass(frozen=True)
class RuPusPrs(RobotRecord):
    """The file of an RU-PUS-PRS tracker.

    Attributes
    ----------
    platform_radius, base_radius, rod, post : a, b, l and r [m]. stroke : allowed readings (low,
        high) [m].
    error_model : `ideal`, the named parameters, or `complete`. parameters : with `ideal`, the set
        (see the module).
    spherical : joints at the rods' ends as perfect `point`s, or with `complete` as `axes` with
        errors of their own.
    tolerances : of lengths and angles.
    """

    family = "ru-pus-prs"

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
        """Return three limbs under a free platform."""
        check_spherical(self.name, self.spherical, self.error_model)
        a, b, axes, home = (
            self.platform_radius,
            self.base_radius,
            self.spherical == "axes",
            self.home.matrix,
        )
        first = ChainFrames(translate(-b), translate(-a), self.rod, home)
        second = ChainFrames(translate(0.0, b), translate(0.0, a), self.rod, home)
        rod, tripod = (
            build_pus_limb("chain1", "q1", first, axes),
            build_prs_limb("chain2", "q2", second, "x", axes),
        )
        post = self._post()
        length, angle = self.tolerances.length, self.tolerances.angle
        if self.error_model == "complete":
            errors = sum(
                (
                    complete_errors(limb, ErrorTolerances(length, angle))
                    for limb in (rod, tripod, post)
                ),
                start=ErrorModel(),
            )
        else:
            errors = (
                end_errors(rod, 1, first, length)
                + drive_and_rod_errors(rod, "q1", 1, first, length)
                + guide_angle_errors(rod, 1, "xy", angle)
                + end_errors(tripod, 2, second, length)
                + drive_and_rod_errors(tripod, "q2", 2, second, length)
                + guide_angle_errors(tripod, 2, "xy", angle)
                + joint_angle_errors(tripod, 2, "yz", angle)
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

    def _post(self) -> PlacedLimb:
        """Return revolute joint, link and universal joint; at home all frames are parallel."""
        steps = (
            JointPlacement("pivot", "R", np.eye(4), EY),
            JointPlacement("universal1", "R", translate(0.0, 0.0, self.post), EX),
            JointPlacement("universal2", "R", np.eye(4), EY),
        )
        return place_limb("chain3", steps, np.eye(4), "rigid", np.eye(4))

    def _post_errors(
        self, post: PlacedLimb, length: float | None, angle: float | None
    ) -> ErrorModel:
        """Return r and the angles of the post."""
        errors = single_error(
            "r",
            Dimension.LENGTH,
            self.post,
            length,
            *map_displacement("r", post, "universal1", "z"),
        )
        for name, element, axis in POST_ANGLES:
            if self.parameters == "twenty-seven" or name not in LEFT_OUT:
                errors += single_error(
                    name, Dimension.ANGLE, 0.0, angle, *map_displacement(name, post, element, axis)
                )
        return errors
