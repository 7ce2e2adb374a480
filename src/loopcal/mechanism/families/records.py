# SPDX-License-Identifier: Apache-2.0
"""Pieces that robot files of every family share: pose, tolerance, workspace, and the base of all
family records.

Numbers are in SI; `loopcal.io` converts them from the units that the file states, by the
annotations here.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import Assembly
from loopcal.typing import FloatArray
from loopcal.units import Angle, Length, Ratio

Point = tuple[Length, Length, Length]


@dataclass(frozen=True)
class PoseRecord:
    """Position and orientation R = Rz(yaw) Ry(pitch) Rx(roll), or tilt-and-torsion phi, theta, psi
    in its place.
    """

    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0
    roll: Angle = 0.0
    pitch: Angle = 0.0
    yaw: Angle = 0.0

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) homogeneous matrix."""
        R = geometry.euler_to_matrix(np.array([self.roll, self.pitch, self.yaw]), "xyz")
        return geometry.make_pose(R, np.array([self.x, self.y, self.z]))


@dataclass(frozen=True)
class LengthTolerance:
    """How far a length may be from nominal: a standard deviation, or limits taken as uniform (sd =
    limits / sqrt 3).
    """

    sd: Length | None = None
    limits: Length | None = None


@dataclass(frozen=True)
class AngleTolerance:
    """How far an angle may be from nominal: a standard deviation, or limits taken as uniform (sd =
    limits / sqrt 3).
    """

    sd: Angle | None = None
    limits: Angle | None = None


@dataclass(frozen=True)
class RatioTolerance:
    """How far a ratio may be from nominal: a standard deviation, or limits taken as uniform (sd =
    limits / sqrt 3).
    """

    sd: Ratio | None = None
    limits: Ratio | None = None


def standard_deviation(
    tolerance: LengthTolerance | AngleTolerance | RatioTolerance | None, name: str
) -> float | None:
    """The standard deviation of a tolerance [SI], None where nothing is stated; raises
    MechanismError for an unclear one.
    """
    if tolerance is None:
        return None
    if (tolerance.sd is None) == (tolerance.limits is None):
        raise MechanismError(
            f"the tolerance of {name} must state either sd or limits, and not both"
        )
    stated = tolerance.sd if tolerance.sd is not None else tolerance.limits or 0.0
    if not stated > 0:
        unit = (
            " m"
            if isinstance(tolerance, LengthTolerance)
            else " rad"
            if isinstance(tolerance, AngleTolerance)
            else ""
        )
        raise MechanismError(
            f"the tolerance of {name} is {stated:g}{unit}; it must be greater than zero, or left "
            "out"
        )
    return float(stated if tolerance.sd is not None else stated / np.sqrt(3.0))


@dataclass(frozen=True)
class Workspace:
    """Ranges of the controlled coordinates in which the machine works (low, high)."""

    x: tuple[Length, Length] | None = None
    y: tuple[Length, Length] | None = None
    z: tuple[Length, Length] | None = None
    roll: tuple[Angle, Angle] | None = None
    pitch: tuple[Angle, Angle] | None = None
    yaw: tuple[Angle, Angle] | None = None
    phi: tuple[Angle, Angle] | None = None
    theta: tuple[Angle, Angle] | None = None
    psi: tuple[Angle, Angle] | None = None

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Coordinate -> (low, high), the stated ones only; raises MechanismError where low is not
        below high.
        """
        found = {
            f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None
        }
        for name, (low, high) in found.items():
            if not low < high:
                unit = "m" if name in ("x", "y", "z") else "rad"
                raise MechanismError(
                    f"the workspace of {name} runs from {low:g} {unit} to {high:g} {unit}; the "
                    "first must be smaller"
                )
        return found


@dataclass(frozen=True)
class RobotRecord:
    """What every robot file may say, whatever its family. A family adds its own fields and
    `expand`.

    Attributes
    ----------
    name : what the robot is called. source : where its numbers come from.
    home : the platform's pose, in the base, at which loops are closed first; what is not said is
        zero.
    tool : the tool's pose on the platform. workspace : where the machine works; poses are drawn
        from it.
    fixed : parameters that are not to be identified, by name or pattern, such as `arm*.length`.
    """

    name: str
    source: str = ""
    home: PoseRecord = field(default_factory=PoseRecord)
    tool: PoseRecord = field(default_factory=PoseRecord)
    workspace: Workspace = field(default_factory=Workspace)
    fixed: tuple[str, ...] = ()

    def expand(self) -> Assembly:
        """The generic description of this robot."""
        raise TypeError("a record of no family cannot be expanded")

    def assembly(self) -> Assembly:
        """`expand`, with the parameters that `fixed` calls by name or pattern (arm*) kept at their
        nominal values.

        Raises
        ------
        MechanismError
            A name that calls no parameter.
        """
        expanded = self.expand()
        names = [parameter.name for parameter in expanded.parameters]
        held = {name for pattern in self.fixed for name in match_parameter_names(pattern, names)}
        parameters = tuple(
            replace(p, free=False) if p.name in held else p for p in expanded.parameters
        )
        return replace(expanded, parameters=parameters)


def match_parameter_names(pattern: str, names: Sequence[str]) -> list[str]:
    """The parameters that a name or pattern calls; raises MechanismError where there is none."""
    found = fnmatch.filter(names, pattern)
    if not found:
        hint = suggest_names(pattern, names) or f"; its parameters are {', '.join(names)}"
        raise MechanismError(f"{pattern!r} fixes no parameter of this robot{hint}; correct it")
    return found


def translation(point: tuple[float, float, float]) -> FloatArray:
    """(4, 4) pure translation [m]."""
    return geometry.make_pose(np.eye(3), np.array(point, dtype=float))


def values_per_leg(value: float | tuple[float, ...], count: int, name: str) -> tuple[float, ...]:
    """One value for all legs, or one each; raises MechanismError for another count."""
    values = (value,) * count if isinstance(value, (int, float)) else tuple(value)
    if len(values) != count:
        raise MechanismError(
            f"{name} has {len(values)} values for {count} legs; give one value, or one for each leg"
        )
    return tuple(float(v) for v in values)
