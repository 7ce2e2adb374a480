# SPDX-License-Identifier: Apache-2.0
"""Linear deltas in the terms of printer firmware: three carriages on vertical towers, three rods.

Tower k is at radius (cos angle_k, sin angle_k). With the carriage at reading r its rod ends at the
height z_k = stop_k + sqrt(arm_k^2 - radius^2) - r (`readings: drop`, counted down from the end
stop) or z_k = stop_k + sqrt(arm_k^2 - radius^2) + r (`readings: height`). The nozzle is the lower
point at distance arm_k from all three. Radius and angles are shared parameters
(docs/theory/delta.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator, Address, Assembly, Joint, Limb, LinearMap, Link
from loopcal.mechanism.families.records import (
    AngleTolerance,
    LengthTolerance,
    RobotRecord,
    standard_deviation,
    translation_matrix,
    values_per_leg,
)
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Length


@dataclass(frozen=True)
class DeltaTolerances:
    """Tolerances of the delta's parameters."""

    radius: LengthTolerance | None = None
    angles: AngleTolerance | None = None
    arms: LengthTolerance | None = None
    stops: LengthTolerance | None = None


@dataclass(frozen=True)
class TowerMap:
    """Map (radius, angle, arm, stop) to the tower's displacement and the carriage's offset.

    x = radius cos angle, y = radius sin angle, offset = stop + sqrt(arm^2 - radius^2).
    """

    inputs: tuple[str, ...]
    outputs: tuple[Address, ...]

    def value(self, inputs: FloatArray) -> FloatArray:
        """Map (t, 4) [m, rad, m, m] to (t, 3) [m]."""
        radius, angle, arm, stop = inputs.T
        return np.stack(
            [radius * np.cos(angle), radius * np.sin(angle), stop + np.sqrt(arm**2 - radius**2)],
            axis=1,
        )

    def jacobian(self, inputs: FloatArray) -> FloatArray:
        """Return the derivative (t, 3, 4) at (t, 4)."""
        radius, angle, arm, _ = inputs.T
        c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(radius)
        height = np.sqrt(arm**2 - radius**2)
        rows = [
            [c, -radius * s, zero, zero],
            [s, radius * c, zero, zero],
            [-radius / height, zero, arm / height, zero + 1.0],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


@dataclass(frozen=True)
class LinearDelta(RobotRecord):
    """The file of a linear delta.

    Attributes
    ----------
    radius : horizontal distance of a rod's ends with the nozzle in the center [m].
    angles : of the towers [rad]; the third one defines the base frame's x axis and is fixed.
    arms : lengths of the rods [m], one or three. stops : end-stop heights [m], one or three.
    readings : `drop` below the end stop or `height` above the lowest carriage position. stroke :
        allowed readings [m].
    """

    family = "linear-delta"

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
            raise MechanismError(f"{self.name} has {len(self.angles)} tower angles; state three")
        if not min(arms) > self.radius > 0:
            raise MechanismError(
                f"{self.name} has a radius of {self.radius * 1e3:g} mm and an arm of "
                f"{min(arms) * 1e3:g} mm; "
                "the radius must be positive and every arm longer than it"
            )
        sd = {
            name: standard_deviation(getattr(self.tolerances, name), f"the {name}")
            for name in ("radius", "angles", "arms", "stops")
        }
        parameters = [Parameter("radius", Dimension.LENGTH, self.radius, sd["radius"])]
        limbs, actuators, maps, shared = [], [], [], []
        for k, (angle, arm, stop) in enumerate(zip(self.angles, arms, stops, strict=True), start=1):
            limb, motor = f"arm{k}", f"q{k}"
            foot = (self.radius * np.cos(angle), self.radius * np.sin(angle), 0.0)
            # above the nozzle: the other side is the mirrored working mode
            height = self.home.z + float(np.sqrt(arm**2 - self.radius**2))
            joints = (Joint("carriage", "P", motor, start=height),)
            links = (Link("tower", translation_matrix(foot)), Link("hinge", np.eye(4)))
            limbs.append(Limb(limb, links, joints, "distance", Link("nozzle", np.eye(4)), arm))
            sign = -1.0 if self.readings == "drop" else 1.0
            offset = stop + np.sqrt(arm**2 - self.radius**2)
            actuators.append(
                Actuator(motor, Dimension.LENGTH, self.stroke, {"offset": offset, "gain": sign})
            )
            parameters += [
                Parameter(f"tower{k}.angle", Dimension.ANGLE, angle, sd["angles"], free=k < 3),
                Parameter(f"arm{k}.length", Dimension.LENGTH, arm, sd["arms"]),
                Parameter(f"tower{k}.stop", Dimension.LENGTH, stop, sd["stops"]),
            ]
            maps.append(LinearMap(f"arm{k}.length", Address(limb, "rod", "length")))
            shared.append(
                TowerMap(
                    ("radius", f"tower{k}.angle", f"arm{k}.length", f"tower{k}.stop"),
                    (
                        Address(limb, "tower", "x"),
                        Address(limb, "tower", "y"),
                        Address(motor, "transmission", "offset"),
                    ),
                )
            )
        return Assembly(
            name=self.name,
            source=self.source,
            limbs=tuple(limbs),
            actuators=tuple(actuators),
            freedoms=("x", "y", "z"),
            controlled=("x", "y", "z"),
            home=self.home.matrix,
            tool=self.tool.matrix,
            workspace=self.workspace.ranges,
            parameters=tuple(parameters),
            maps=tuple(maps),
            shared=tuple(shared),
        )
