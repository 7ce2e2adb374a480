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

from loopcal.mechanism.assembly import AXES, Actuator, Assembly, Joint
from loopcal.mechanism.families.error_models import (
    ErrorModel,
    ErrorTolerances,
    check_spherical,
    complete_errors,
    displacement_error,
    join_errors,
)
from loopcal.mechanism.families.limb_placement import (
    EX,
    EY,
    JointPlacement,
    PlacedLimb,
    place_limb,
    translate,
)
from loopcal.mechanism.families.prs import (
    ChainFrames,
    TripodTolerances,
    build_prs_limb,
    build_pus_limb,
    carriage_errors,
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
        a, b, axes = self.platform_radius, self.base_radius, self.spherical == "axes"
        home, spread = self.home.matrix, self.tolerances.deviations
        first = ChainFrames(translate(-b), translate(-a), self.rod, home)
        second = ChainFrames(translate(0.0, b), translate(0.0, a), self.rod, home)
        limbs = (
            build_pus_limb("chain1", "q1", first, axes),
            build_prs_limb("chain2", "q2", second, "x", axes),
            self._post(),
        )
        if self.error_model == "complete":
            errors = join_errors(complete_errors(limb, spread) for limb in limbs)
        else:
            errors = (
                carriage_errors(limbs[0], 1, first, spread)
                + carriage_errors(limbs[1], 2, second, spread, joint="yz")
                + self._post_errors(limbs[2], spread)
            )
        return self.assemble(
            (limb.limb for limb in limbs),
            (Actuator(q, Dimension.LENGTH, self.stroke) for q in ("q1", "q2")),
            errors,
            freedoms=AXES,
            controlled=("phi", "theta"),
        )

    def _post(self) -> PlacedLimb:
        """Return revolute joint, link and universal joint; at home all frames are parallel."""
        steps = (
            JointPlacement(Joint("pivot", "R"), np.eye(4), EY),
            JointPlacement(Joint("universal1", "R"), translate(0.0, 0.0, self.post), EX),
            JointPlacement(Joint("universal2", "R"), np.eye(4), EY),
        )
        return place_limb("chain3", steps, np.eye(4), "rigid", np.eye(4))

    def _post_errors(self, post: PlacedLimb, spread: ErrorTolerances) -> ErrorModel:
        """Return r and the angles of the post."""
        left_out = LEFT_OUT if self.parameters == "twenty-five" else ()
        return displacement_error(
            "r", post, "universal1", "z", spread.length, self.post, positive=True
        ) + join_errors(
            displacement_error(name, post, element, axis, spread.angle)
            for name, element, axis in POST_ANGLES
            if name not in left_out
        )
