# SPDX-License-Identifier: Apache-2.0
"""The result of `assess_repeatability`: what each visited pose shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from loopcal.findings import Finding
from loopcal.findings.wording import round_to_digits
from loopcal.presentation import TableResult, draw
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIMENSIONS = {"position": Dimension.LENGTH, "orientation": Dimension.ANGLE}
"""Dimensions of the quantities."""


class Estimate(NamedTuple):
    """A value [m] or [rad] with its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class VisitedPose:
    """Pose accuracy and repeatability of one target at one commanded pose.

    Attributes
    ----------
    pose : label of its first visit. target, direction : names of the target and of the direction of
        approach (the group of the rows); empty for the only one. visits : their number.
    components : names of the measured components, such as ("x", "y", "z").
    mean : (c,) attained minus commanded values.
    accuracy, repeatability : AP_p and RP_l of a position; None for an orientation.
    accuracies, repeatabilities : AP and RP of each component.
    commanded : number of the commanded pose.
    """

    pose: str
    target: str
    direction: str
    visits: int
    components: tuple[str, ...]
    mean: FloatArray
    accuracy: Estimate | None
    repeatability: Estimate | None
    accuracies: tuple[Estimate, ...]
    repeatabilities: tuple[Estimate, ...]
    commanded: int = 0

    def list_accuracies(self) -> tuple[Estimate, ...]:
        """Return AP_p of a position, and the AP of each component of an orientation."""
        return self.accuracies if self.accuracy is None else (self.accuracy,)

    def list_repeatabilities(self) -> tuple[Estimate, ...]:
        """Return RP_l of a position, and the RP of each component of an orientation."""
        return self.repeatabilities if self.repeatability is None else (self.repeatability,)

    def to_dict(self) -> dict[str, Any]:
        """Return the content by name for JSON, SI."""
        listed = {
            name: {
                component: estimate._asdict()
                for component, estimate in zip(self.components, estimates, strict=True)
            }
            for name, estimates in (("AP", self.accuracies), ("RP", self.repeatabilities))
        }
        whole = {
            name: estimate._asdict()
            for name, estimate in (("AP_p", self.accuracy), ("RP_l", self.repeatability))
            if estimate is not None
        }
        names = ("pose", "target", "direction", "visits")
        return {**{name: getattr(self, name) for name in names}, **whole, **listed}


@dataclass(frozen=True, eq=False)
class Repeatability(TableResult):
    """Pose accuracy and repeatability of a machine.

    Attributes
    ----------
    frame : in which frame the differences are, in words.
    poses : by quantity, "position" and "orientation", one entry for each pose, target, direction.
    variations : (pose, target) -> largest distance of the mean positions of two directions of
        approach (vAP_p) [m], where there are several.
    findings : what limits these numbers.
    """

    frame: str
    poses: Mapping[str, tuple[VisitedPose, ...]]
    variations: Mapping[tuple[str, str], float]
    findings: tuple[Finding, ...]

    def plot(self) -> Figure:
        """Draw pose accuracy and repeatability of each pose, with intervals of 95 %."""
        return draw("draw_repeatability", self)

    def __repr__(self) -> str:
        counts = (f"{name} of {len(poses)} visited poses" for name, poses in self.poses.items())
        return f"<Repeatability: {', '.join(counts)}>"

    def __str__(self) -> str:
        """Return the largest values of each quantity, and the findings."""
        lines = [
            f"{name}, largest of {len(poses)}: {describe_largest(poses, name)}"
            for name, poses in self.poses.items()
        ]
        return "\n".join([*lines, *(f"{f.severity.value}: {f}" for f in self.findings)])

    def to_dict(self) -> dict[str, Any]:
        """Return the content by name for JSON, SI."""
        return {
            "standard": "ISO 9283:1998",
            "frame": self.frame,
            **{name: [pose.to_dict() for pose in poses] for name, poses in self.poses.items()},
            "variations": [
                {"pose": pose, "target": target, "vAP_p": value}
                for (pose, target), value in self.variations.items()
            ],
            "findings": self.findings,
        }


def describe_largest(poses: tuple[VisitedPose, ...], quantity: str) -> str:
    """Return the largest AP and RP of some poses in words; those of a position are AP_p and RP_l,
    those of an orientation the largest of any component.
    """
    unit = DISPLAY_UNITS[DIMENSIONS[quantity]]
    accuracies = [abs(e.value) for pose in poses for e in pose.list_accuracies()]
    repeatabilities = [e.value for pose in poses for e in pose.list_repeatabilities()]
    words = []
    for name, values in (("AP", accuracies), ("RP", repeatabilities)):
        words.append(f"{name} {round_to_digits(max(values) / unit.factor_to_si)} {unit.symbol}")
    return ", ".join(words)
