# SPDX-License-Identifier: Apache-2.0
"""3-PRS tripods: three carriages on vertical guides, rods that swing in vertical planes, balls.

Chain i is at the angle 120 (i - 1) degrees, with the chain frame Rz(angle): guide along z, revolute
joint along y, foot of the guide at x = base_radius, ball at x = platform_radius. The machine moves
in z and tilts (phi, theta); x, y and psi follow. Parameters: the eleven of each chain of
doi:10.1177/1687814016667908 (a.x a.y a.z b.x b.y q l thB.x thB.y thC.x thC.z, with the number of
the chain in place of the point), or fourteen: of the three more, b.z repeats q, and thB.z and thC.y
rotate an axis about itself. Derivation: docs/theory/tripods.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.mechanism.assembly import AXES, Actuator, Assembly
from loopcal.mechanism.families.error_models import ErrorModel, check_spherical, complete_errors
from loopcal.mechanism.families.limb_placement import PlacedLimb, rotate_about, translate
from loopcal.mechanism.families.prs import (
    ChainFrames,
    TripodTolerances,
    build_prs_limb,
    carriage_errors,
)
from loopcal.mechanism.families.records import RobotRecord
from loopcal.units import Dimension, Length


@dataclass(frozen=True)
class ThreePrs(RobotRecord):
    """The file of a 3-PRS tripod.

    Attributes
    ----------
    platform_radius, base_radius, rod : a, b and l [m]. stroke : allowed readings (low, high) [m].
    error_model : `ideal`, the named parameters, or `complete`.
    parameters : with `ideal`, the `eleven` identifiable ones of each chain, or all `fourteen`.
    spherical : upper joints as perfect `point`s, or with `complete` as three `axes` with errors of
        their own.
    tolerances : of lengths and angles.
    """

    family = "3-prs"

    platform_radius: Length = 0.0
    base_radius: Length = 0.0
    rod: Length = 0.0
    stroke: tuple[Length, Length] | None = None
    error_model: Literal["ideal", "complete"] = "ideal"
    parameters: Literal["eleven", "fourteen"] = "eleven"
    spherical: Literal["point", "axes"] = "point"
    tolerances: TripodTolerances = field(default_factory=TripodTolerances)

    def expand(self) -> Assembly:
        """Return three PRS limbs under a free platform."""
        check_spherical(self.name, self.spherical, self.error_model)
        limbs, errors = [], ErrorModel()
        for number in (1, 2, 3):
            turn = rotate_about("z", 2 * np.pi / 3 * (number - 1))
            base, platform = translate(self.base_radius), translate(self.platform_radius)
            frames = ChainFrames(turn @ base, turn @ platform, self.rod, self.home.matrix)
            axes = self.spherical == "axes"
            limb = build_prs_limb(f"chain{number}", f"q{number}", frames, "y", axes)
            limbs.append(limb.limb)
            errors += self._errors(limb, number, frames)
        return self.assemble(
            limbs,
            (Actuator(f"q{number}", Dimension.LENGTH, self.stroke) for number in (1, 2, 3)),
            errors,
            freedoms=AXES,
            controlled=("z", "phi", "theta"),
        )

    def _errors(self, limb: PlacedLimb, number: int, frames: ChainFrames) -> ErrorModel:
        """Return the error model of one chain."""
        spread = self.tolerances.deviations
        if self.error_model == "complete":
            return complete_errors(limb, spread)
        if self.parameters == "eleven":
            return carriage_errors(limb, number, frames, spread, joint="xz")
        return carriage_errors(limb, number, frames, spread, foot="xyz", guide="xyz", joint="xyz")
