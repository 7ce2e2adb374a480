# SPDX-License-Identifier: Apache-2.0
"""Linear deltas in the terms of printer firmware: three carriages on vertical towers, three rods.

Tower k is at radius (cos angle_k, sin angle_k). With the carriage at reading r its rod ends at the
height z_k = stop_k + sqrt(arm_k^2 - radius^2) - r (`readings: drop`, counted down from the end
stop) or z_k = stop_k + sqrt(arm_k^2 - radius^2) + r (`readings: height`). The nozzle is the lower
point at distance arm_k from all three. Radius and angles are shared parameters
(docs/theory/families.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.errors import MechanismError
from loopcal.geometry import stack_matrix
from loopcal.mechanism.assembly import Actuator, Address, Assembly, Joint, LinearMap, SharedMap
from loopcal.mechanism.families import placement
from loopcal.mechanism.families.records import RobotRecord, values_per_leg
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Length


@dataclass(frozen=True)
class DeltaTolerances:
    """Expected spreads of the delta's parameters."""

    radius: placement.LengthTolerance | None = None
    angles: placement.AngleTolerance | None = None
    arms: placement.LengthTolerance | None = None
    stops: placement.LengthTolerance | None = None


@dataclass(frozen=True)
class TowerMap(SharedMap):
    """Map (radius, angle, arm, stop) to the tower's displacement and the carriage's offset.

    x = radius cos angle, y = radius sin angle, offset = stop + sqrt(arm^2 - radius^2).
    """

    def value(self, inputs: FloatArray) -> FloatArray:
        """Map (.., 4) [m, rad, m, m] to (.., 3) [m]."""
        radius, angle, arm, stop = (inputs[..., i] for i in range(4))
        x, y, height = radius * np.cos(angle), radius * np.sin(angle), _compute_rise(arm, radius)
        return stack_matrix(((x, y, stop + height),))[..., 0, :]

    def jacobian(self, inputs: FloatArray) -> FloatArray:
        """Return the derivative (.., 3, 4) at (.., 4)."""
        radius, angle, arm, _ = (inputs[..., i] for i in range(4))
        c, s, height = np.cos(angle), np.sin(angle), _compute_rise(arm, radius)
        return stack_matrix(
            (
                (c, -radius * s, 0.0, 0.0),
                (s, radius * c, 0.0, 0.0),
                (-radius / height, 0.0, arm / height, 1.0),
            )
        )


def _compute_rise(arm: FloatArray, radius: FloatArray) -> FloatArray:
    """Return how high rods rise over a radius [m]; NaN where they are too short for it."""
    square = arm**2 - radius**2
    return np.sqrt(np.where(square > 0.0, square, np.nan))


@dataclass(frozen=True)
class LinearDelta(RobotRecord):
    """The file of a linear delta.

    radius : horizontal distance of a rod's ends with the nozzle in the center [m].
    angles : of the towers [rad]; the third one defines the base frame's x axis and is fixed.
    arms : lengths of the rods [m], one or three.
    stops : heights of the nozzle in the center at reading zero [m], one or three.
    readings : `drop` below the end stop or `height` above the lowest carriage position. stroke :
        allowed readings [m].
    stored_parameters : by default what firmware of printers calibrates: radius, angles, stops.
    """

    family = "linear-delta"

    stored_parameters: tuple[str, ...] = ("radius", "tower*.angle", "tower*.stop")
    radius: Length = 0.0
    angles: tuple[Angle, ...] = ()
    arms: Length | tuple[Length, ...] = 0.0
    stops: Length | tuple[Length, ...] = 0.0
    readings: Literal["drop", "height"] = "drop"
    stroke: tuple[Length, Length] | None = None
    tolerances: DeltaTolerances = field(default_factory=DeltaTolerances)

    def expand(self) -> Assembly:
        """Return three limbs, a driven carriage and a rod each; the platform keeps x, y and z."""
        arms, stops = values_per_leg(self.arms, 3, "arms"), values_per_leg(self.stops, 3, "stops")
        if len(self.angles) != 3:
            raise MechanismError(f"{self.name} has {len(self.angles)} tower angles. Give three")
        if not min(arms) > self.radius > 0:
            raise MechanismError(
                f"{self.name} has a radius of {self.radius * 1e3:g} mm and an arm of "
                f"{min(arms) * 1e3:g} mm; the radius must be positive and every arm longer than it"
            )
        sd = {
            name: placement.standard_deviation(getattr(self.tolerances, name), f"the {name}")
            for name in ("radius", "angles", "arms", "stops")
        }
        errors = placement.single_error(
            "radius", Dimension.LENGTH, self.radius, sd["radius"], positive=True
        )
        limbs, own = list[placement.PlacedLimb](), list[Actuator]()
        for k, (angle, arm, stop) in enumerate(zip(self.angles, arms, stops, strict=True), start=1):
            limb, motor = f"arm{k}", f"q{k}"
            # above the nozzle: the other side is the mirrored working mode
            rise = float(np.sqrt(arm**2 - self.radius**2))
            carriage = Joint("carriage", "P", motor, start=self.home.z + rise)
            foot = placement.translate(self.radius * np.cos(angle), self.radius * np.sin(angle))
            steps = (placement.JointPlacement(carriage, foot, placement.EZ),)
            limbs.append(placement.place_limb(limb, steps, np.eye(4), "distance", np.eye(4), arm))
            terms = {"offset": stop + rise, "gain": -1.0 if self.readings == "drop" else 1.0}
            own.append(Actuator(motor, Dimension.LENGTH, self.stroke, terms))
            names = (f"tower{k}.angle", f"arm{k}.length", f"tower{k}.stop")
            parameters = (
                Parameter(names[0], Dimension.ANGLE, angle, sd["angles"], free=k < 3),
                Parameter(names[1], Dimension.LENGTH, arm, sd["arms"], positive=True),
                Parameter(names[2], Dimension.LENGTH, stop, sd["stops"]),
            )
            rod = LinearMap(names[1], Address(limb, "rod", "length"))
            x, y = (Address(limb, "carriage", axis) for axis in "xy")
            tower = TowerMap(("radius", *names), (x, y, Address(motor, "transmission", "offset")))
            errors += placement.ErrorModel(parameters, (rod,), (tower,))
        axes = ("x", "y", "z")
        return self.assemble(limbs, errors, freedoms=axes, controlled=axes, own=own)
