# SPDX-License-Identifier: Apache-2.0
"""Gough-Stewart platforms: six legs of variable length between ball centres on the base and on the platform.

With `legs: rod` a leg is the distance between its two centres, l_i = |t + R p_i - b_i| = length_i + reading_i: seven
parameters a leg, 42 in all (docs/theory/hexapod.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Actuator, Address, Assembly, Limb, Linear, Link
from loopcal.mechanism.records import LengthTolerance, Point, Robot, per_leg, standard_deviation, translation
from loopcal.parameters import Parameter
from loopcal.units import Dimension, Length


@dataclass(frozen=True)
class GoughTolerances:
    """Tolerances of joint centres on base and platform, and of the leg lengths."""

    base: LengthTolerance | None = None
    platform: LengthTolerance | None = None
    length: LengthTolerance | None = None


@dataclass(frozen=True)
class Gough(Robot):
    """A hexapod's file.

    Attributes
    ----------
    base, platform : centres of the joints, leg by leg, in the base and the platform frame [m].
    lengths : length of a leg at reading zero [m], one for all or one each.
    stroke : allowed readings (low, high) [m]. legs : form of the legs. tolerances : of the parameters.
    """

    base: tuple[Point, ...] = ()
    platform: tuple[Point, ...] = ()
    lengths: Length | tuple[Length, ...] = 0.0
    stroke: tuple[Length, Length] | None = None
    legs: Literal["rod"] = "rod"
    tolerances: GoughTolerances = field(default_factory=GoughTolerances)

    def expand(self) -> Assembly:
        """Six limbs without joints that end in an actuated distance; raises MechanismError for other than six legs."""
        if len(self.base) != 6 or len(self.platform) != 6:
            raise MechanismError(
                f"{self.name} has {len(self.base)} base and {len(self.platform)} platform centres; a hexapod has six of each"
            )
        lengths = per_leg(self.lengths, 6, "lengths")
        limbs, actuators, parameters, maps = [], [], [], []
        for i, (b, p, length) in enumerate(zip(self.base, self.platform, lengths, strict=True)):
            leg, motor = f"leg{i + 1}", f"q{i + 1}"
            limbs.append(
                Limb(leg, (Link("base", translation(b)),), (), "distance", Link("platform", translation(p)), length, motor)
            )
            actuators.append(Actuator(motor, Dimension.LENGTH, self.stroke))
            for element, nominal, tolerance in (
                ("base", b, self.tolerances.base),
                ("platform", p, self.tolerances.platform),
            ):
                sd = standard_deviation(tolerance, f"the {element} centres")
                for axis, value in zip(AXES[3:], nominal, strict=True):
                    parameters.append(Parameter(f"{leg}.{element}.{axis}", Dimension.LENGTH, value, sd))
                    maps.append(Linear(f"{leg}.{element}.{axis}", Address(leg, element, axis)))
            sd = standard_deviation(self.tolerances.length, "the leg lengths")
            parameters.append(Parameter(f"{leg}.length", Dimension.LENGTH, length, sd))
            maps.append(Linear(f"{leg}.length", Address(leg, "rod", "length")))
        return Assembly(
            name=self.name,
            source=self.source,
            limbs=tuple(limbs),
            actuators=tuple(actuators),
            freedoms=AXES,
            controlled=("x", "y", "z", "roll", "pitch", "yaw"),
            home=self.home.matrix,
            tool=self.tool.matrix,
            workspace=self.workspace.ranges,
            parameters=tuple(parameters),
            maps=tuple(maps),
        )
