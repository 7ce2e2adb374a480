# SPDX-License-Identifier: Apache-2.0
"""Gough-Stewart platforms: six legs of variable length between joint centers on base and platform.

With `legs: rod` a leg is the distance between its two centers, l_i = |t + R p_i - b_i| = length_i +
reading_i: seven parameters a leg, 42 in all. With `legs: ups` it is a chain of joints (see
`hexapod_legs.py`), which can carry the complete error model and a screw that turns with the joints.
Derivation: docs/theory/hexapod.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Actuator, Assembly, Cone
from loopcal.mechanism.families.error_models import (
    ErrorModel,
    ErrorTolerances,
    check_spherical,
    complete_errors,
    offset_error,
    point_errors,
    rod_length_error,
)
from loopcal.mechanism.families.hexapod_legs import Screw, build_screw_leg, build_ups_leg
from loopcal.mechanism.families.limb_placement import PlacedLimb, place_limb, translate
from loopcal.mechanism.families.records import (
    AngleTolerance,
    LengthTolerance,
    Point,
    RobotRecord,
    standard_deviation,
    values_per_leg,
)
from loopcal.typing import FloatArray
from loopcal.units import Angle, Dimension, Length


@dataclass(frozen=True)
class GoughTolerances:
    """Tolerances of joint centers on base and platform and of leg lengths.

    `links` and `angles` are those of the complete model.
    """

    base: LengthTolerance | None = None
    platform: LengthTolerance | None = None
    length: LengthTolerance | None = None
    links: LengthTolerance | None = None
    angles: AngleTolerance | None = None


@dataclass(frozen=True)
class GoughCones:
    """Allowed inclination of a rod at its base and platform joints from its direction at home."""

    base: Angle | None = None
    platform: Angle | None = None


@dataclass(frozen=True)
class Gough(RobotRecord):
    """The file of a hexapod.

    Attributes
    ----------
    base, platform : centers of the joints, leg by leg, in the base and the platform frame [m].
    lengths : length of a leg at reading zero [m], one for all or one each.
    stroke : allowed readings (low, high) [m]. cones : of the joints of rods.
    legs : form of the legs, a `rod` or the chain `ups`.
    spherical : with `ups`, the upper joint as a perfect `point`, or as three `axes` with errors of
        their own.
    screw : with `ups`, a screw in every leg; its nut turns with the lower joint, its spindle with
        the upper one.
    error_model : `ideal`, 42 parameters, or `complete`, which needs `ups`.
    tolerances : of the parameters.
    """

    family = "gough"

    base: tuple[Point, ...] = ()
    platform: tuple[Point, ...] = ()
    lengths: Length | tuple[Length, ...] = 0.0
    stroke: tuple[Length, Length] | None = None
    cones: GoughCones = field(default_factory=GoughCones)
    legs: Literal["rod", "ups"] = "rod"
    spherical: Literal["point", "axes"] = "point"
    screw: Screw | None = None
    error_model: Literal["ideal", "complete"] = "ideal"
    tolerances: GoughTolerances = field(default_factory=GoughTolerances)

    def expand(self) -> Assembly:
        """Return six legs in the stated form.

        Raises
        ------
        MechanismError
            Another number of legs, or a model that this form cannot carry.
        """
        self._check()
        legs, actuators, errors = [], [], ErrorModel()
        for i, length in enumerate(values_per_leg(self.lengths, 6, "lengths")):
            if not length >= 0.0:
                raise MechanismError(
                    f"leg {i + 1} of {self.name} has the length {length * 1e3:g} mm at reading "
                    "zero; a length must be positive, or zero where readings are whole lengths"
                )
            leg, motor = self._leg(i, length), f"q{i + 1}"
            legs.append(leg.limb)
            # a rod has its length in the ending, a chain in the offset of its sliding joint
            terms = {} if self.legs == "rod" else {"offset": length}
            actuators.append(Actuator(motor, Dimension.LENGTH, self.stroke, terms))
            errors += self._errors(leg, motor, length)
        return self.assemble(
            legs,
            actuators,
            errors,
            freedoms=AXES,
            controlled=("x", "y", "z", "roll", "pitch", "yaw"),
        )

    def _check(self) -> None:
        if len(self.base) != 6 or len(self.platform) != 6:
            raise MechanismError(
                f"{self.name} has {len(self.base)} base and {len(self.platform)} platform centers; "
                "a hexapod has six of each"
            )
        stated = {
            "error_model: complete": self.error_model == "complete",
            "spherical: axes": self.spherical == "axes",
            "a screw": self.screw is not None,
        }
        asked = [words for words, is_stated in stated.items() if is_stated]
        model = "complete" if self.legs == "rod" else self.error_model
        check_spherical(self.name, self.spherical, model)
        if self.legs == "ups" and self.cones != GoughCones():
            raise MechanismError(
                f"{self.name} states cones with legs: ups, whose joints have no cones; state legs: "
                "rod"
            )
        if self.legs == "rod" and asked:
            raise MechanismError(
                f"{self.name} states legs: rod with {asked[0]}, but a rod has no joints that could "
                "carry it; state legs: ups"
            )

    def _leg(self, i: int, length: float) -> PlacedLimb:
        """Return leg i in its form."""
        leg, motor, base, top = f"leg{i + 1}", f"q{i + 1}", self.base[i], self.platform[i]
        if self.legs == "rod":
            ends = translate(*base), translate(*top)
            cones = self._cones(*ends)
            return place_limb(leg, (), ends[0], "distance", ends[1], length, motor, cones)
        home = self.home.matrix
        if self.screw:
            return build_screw_leg(leg, motor, base, top, home, self.screw.legs()[i])
        return build_ups_leg(leg, motor, base, top, home, self.spherical == "axes")

    def _cones(self, base: FloatArray, top: FloatArray) -> tuple[Cone, ...]:
        """Return the cones of a rod between these centers (4, 4), about its direction at home."""
        home = self.home.matrix
        rod = (home @ top)[:3, 3] - base[:3, 3]
        ends = (
            ("tip", self.cones.base, rod),
            ("attachment", self.cones.platform, -home[:3, :3].T @ rod),
        )
        return tuple(
            Cone(end, (float(axis[0]), float(axis[1]), float(axis[2])), angle)
            for end, angle, axis in ends
            if angle is not None
        )

    def _errors(self, leg: PlacedLimb, motor: str, length: float) -> ErrorModel:
        """Return two centers (or the errors of every link) and a length, the same in both forms."""
        sd, name = self.tolerances, f"{leg.name}.length"
        length_sd = standard_deviation(sd.length, "the leg lengths")
        if self.error_model == "complete":
            spread = ErrorTolerances(
                standard_deviation(sd.links, "the links"),
                standard_deviation(sd.angles, "the link angles"),
            )
            errors = complete_errors(leg, spread, offsets=False)
        else:
            base_sd = standard_deviation(sd.base, "the base centers")
            platform_sd = standard_deviation(sd.platform, "the platform centers")
            errors = point_errors(leg, leg.elements[0], base_sd, "base")
            errors += point_errors(leg, "platform", platform_sd, "platform")
        if self.legs == "rod":
            return errors + rod_length_error(leg, name, length_sd)
        return errors + offset_error(
            name, motor, Dimension.LENGTH, length, length_sd, positive=True
        )
