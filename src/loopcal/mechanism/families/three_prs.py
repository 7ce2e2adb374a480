# SPDX-License-Identifier: Apache-2.0
"""3-PRS tripods: three carriages on vertical guides, rods that swing in vertical planes, balls on
the platform.

Chain i stands at the angle 120 (i - 1) degrees, with the chain frame Rz(angle): guide along z,
revolute joint along y, foot of the guide at x = base_radius, ball at x = platform_radius. The
machine moves in z and tilts (phi, theta); x, y and psi follow. Parameters: the eleven a chain of
doi:10.1177/1687814016667908 (a.x a.y a.z b.x b.y q l thB.x thB.y thC.x thC.z, the point standing
for the chain's number), or fourteen natural ones: of the three more, b.z repeats q, and thB.z and
thC.y turn an axis about itself. Derivation: docs/theory/tripods.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.mechanism.assembly import AXES, Actuator, Assembly
from loopcal.mechanism.families.chain import Placed, at, turn_about
from loopcal.mechanism.families.error_models import Errors, Spread, complete
from loopcal.mechanism.families.prs import (
    Frames,
    TripodTolerances,
    check_spherical,
    drive_and_rod,
    ends,
    foot_height,
    guide_angles,
    joint_angles,
    prs_limb,
)
from loopcal.mechanism.families.records import RobotRecord
from loopcal.units import Dimension, Length


@dataclass(frozen=True)
class ThreePrs(RobotRecord):
    """A 3-PRS tripod's file.

    Attributes
    ----------
    platform_radius, base_radius, rod : a, b and l [m]. stroke : allowed readings (low, high) [m].
    error_model : `ideal`, the named parameters, or `complete`.
    parameters : with `ideal`, the `eleven` a chain that can be told apart, or all `fourteen`.
    spherical : upper joints as perfect `point`s, or with `complete` as three `axes` with errors of
        their own.
    tolerances : of lengths and angles.
    """

    platform_radius: Length = 0.0
    base_radius: Length = 0.0
    rod: Length = 0.0
    stroke: tuple[Length, Length] | None = None
    error_model: Literal["ideal", "complete"] = "ideal"
    parameters: Literal["eleven", "fourteen"] = "eleven"
    spherical: Literal["point", "axes"] = "point"
    tolerances: TripodTolerances = field(default_factory=TripodTolerances)

    def expand(self) -> Assembly:
        """Three PRS limbs under a free platform."""
        check_spherical(self.name, self.spherical, self.error_model)
        limbs, errors = [], Errors()
        for number in (1, 2, 3):
            turn = turn_about("z", 2 * np.pi / 3 * (number - 1))
            frames = Frames(
                turn @ at(self.base_radius),
                turn @ at(self.platform_radius),
                self.rod,
                self.home.matrix,
            )
            limb = prs_limb(f"chain{number}", f"q{number}", frames, "y", self.spherical == "axes")
            limbs.append(limb)
            errors += self._errors(limb, number, frames)
        return Assembly(
            name=self.name,
            source=self.source,
            limbs=tuple(limb.limb for limb in limbs),
            actuators=tuple(
                Actuator(f"q{number}", Dimension.LENGTH, self.stroke) for number in (1, 2, 3)
            ),
            freedoms=AXES,
            controlled=("z", "phi", "theta"),
            home=self.home.matrix,
            tool=self.tool.matrix,
            workspace=self.workspace.ranges,
            parameters=errors.parameters,
            maps=errors.maps,
        )

    def _errors(self, limb: Placed, number: int, frames: Frames) -> Errors:
        """The error model of one chain."""
        length, angle = self.tolerances.length, self.tolerances.angle
        if self.error_model == "complete":
            return complete(limb, Spread(length, angle))
        all_of_them = self.parameters == "fourteen"
        return (
            ends(limb, number, frames, length)
            + (foot_height(limb, number, length) if all_of_them else Errors())
            + drive_and_rod(limb, f"q{number}", number, frames, length)
            + guide_angles(limb, number, "xyz" if all_of_them else "xy", angle)
            + joint_angles(limb, number, "xyz" if all_of_them else "xz", angle)
        )
