# SPDX-License-Identifier: Apache-2.0
"""Records that the robot files of all families share: pose, tolerances, workspace, base record.

Numbers are in SI; `loopcal.io` converts them from the units of the file, by the annotations here.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import Actuator, Assembly, Limb
from loopcal.mechanism.families.error_models import ErrorModel
from loopcal.parameters import CommonError, Parameter
from loopcal.typing import FloatArray
from loopcal.units import SD_RANGE, Angle, Dimension, Length, Ratio, is_sd

Point = tuple[Length, Length, Length]


@dataclass(frozen=True)
class PoseRecord:
    """Position and orientation R = Rz(yaw) Ry(pitch) Rx(roll), as a robot file states them.

    A file may state tilt-and-torsion phi, theta, psi in place of roll, pitch, yaw.
    """

    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0
    roll: Angle = 0.0
    pitch: Angle = 0.0
    yaw: Angle = 0.0

    @property
    def matrix(self) -> FloatArray:
        """Homogeneous matrix (4, 4)."""
        R = geometry.euler_to_matrix(np.array([self.roll, self.pitch, self.yaw]), "xyz")
        return geometry.make_pose(R, np.array([self.x, self.y, self.z]))


@dataclass(frozen=True)
class LengthTolerance:
    """Tolerance of a length: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    sd: Length | None = None
    limits: Length | None = None


@dataclass(frozen=True)
class AngleTolerance:
    """Tolerance of an angle: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    sd: Angle | None = None
    limits: Angle | None = None


@dataclass(frozen=True)
class RatioTolerance:
    """Tolerance of a ratio: sd, or limits of a uniform error (sd = limits / sqrt 3)."""

    sd: Ratio | None = None
    limits: Ratio | None = None


def standard_deviation(
    tolerance: LengthTolerance | AngleTolerance | RatioTolerance | None, name: str
) -> float | None:
    """Return the standard deviation of a tolerance [SI], None if none is stated.

    Raises
    ------
    MechanismError
        Both or neither of sd and limits, or a value that is not positive.
    """
    if tolerance is None:
        return None
    if (tolerance.sd is None) == (tolerance.limits is None):
        raise MechanismError(
            f"the tolerance of {name} must state either sd or limits, not both or neither"
        )
    stated = tolerance.sd if tolerance.sd is not None else tolerance.limits or 0.0
    if not is_sd(stated):
        unit = {LengthTolerance: " m", AngleTolerance: " rad", RatioTolerance: ""}[type(tolerance)]
        raise MechanismError(
            f"the tolerance of {name} is {stated:g}{unit}; it must be greater than zero "
            f"({SD_RANGE}), or left out"
        )
    return float(stated if tolerance.sd is not None else stated / np.sqrt(3.0))


@dataclass(frozen=True)
class CommonErrorRecord:
    """An error that several parameters share in addition to their own, such as that of one batch.

    Attributes
    ----------
    name : of the common error. of : the parameters, by name or pattern, such as `arm*.length`.
    length, angle, ratio : the tolerance of the common error, by the dimension of the parameters.
    """

    name: str
    of: tuple[str, ...]
    length: LengthTolerance | None = None
    angle: AngleTolerance | None = None
    ratio: RatioTolerance | None = None

    def resolve(self, parameters: Sequence[Parameter]) -> CommonError:
        """Return the common error of the parameters that match.

        Raises
        ------
        MechanismError : no or several dimensions, a single parameter, or parameters of another
            dimension or without a tolerance of their own.
        """
        stated = {d: getattr(self, d.value) for d in Dimension if getattr(self, d.value)}
        if len(stated) != 1:
            raise MechanismError(
                f"common error {self.name!r} states {len(stated)} tolerances; give one, such as "
                "`length: {sd: 0.1}`"
            )
        ((dimension, tolerance),) = stated.items()
        sd = standard_deviation(tolerance, f"common error {self.name!r}")
        assert sd is not None
        names = [parameter.name for parameter in parameters]
        matching = _match_all(self.of, names, "common_errors")
        chosen = [parameter for parameter in parameters if parameter.name in matching]
        for parameter in chosen:
            self._check(parameter, dimension)
        if len(chosen) < 2:
            raise MechanismError(
                f"common error {self.name!r} belongs to {chosen[0].name} alone; name two or more "
                "parameters, or state the tolerance of that parameter"
            )
        return CommonError(self.name, tuple(parameter.name for parameter in chosen), sd)

    def _check(self, parameter: Parameter, dimension: Dimension) -> None:
        """Refuse a parameter that cannot have this common error."""
        place = f"common error {self.name!r} of {parameter.name}"
        if parameter.dimension is not dimension:
            raise MechanismError(
                f"{place} states a tolerance of {dimension.value}, but the parameter is of "
                f"dimension {parameter.dimension.value}; use the key `{parameter.dimension.value}`"
            )
        if parameter.tolerance is None:
            raise MechanismError(
                f"{place}: the parameter has no tolerance of its own; state it, because no two "
                "parts are exactly equal"
            )


@dataclass(frozen=True)
class Workspace:
    """Ranges (low, high) of the controlled coordinates in which the machine works."""

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
        """Stated ranges, coordinate -> (low, high); raises MechanismError unless low < high."""
        ranges = {f.name: getattr(self, f.name) for f in fields(self)}
        stated = {name: pair for name, pair in ranges.items() if pair is not None}
        for name, (low, high) in stated.items():
            if not low < high:
                unit = "m" if name in ("x", "y", "z") else "rad"
                raise MechanismError(
                    f"the workspace of {name} runs from {low:g} {unit} to {high:g} {unit}; the "
                    "first value must be smaller"
                )
        if "theta" in stated and not 0.0 < stated["theta"][1] <= math.pi:
            raise MechanismError(
                f"the workspace of theta runs to {stated['theta'][1]:g} rad; a tilt is above 0 and "
                "at most 180 degrees"
            )
        return stated


@dataclass(frozen=True)
class RobotRecord:
    """The fields of every robot file; a family adds its own fields and `expand`.

    Attributes
    ----------
    name : name of the robot. source : origin of its numbers.
    home : platform pose in the base at which the loops are closed first; zero by default.
    tool : tool pose on the platform. workspace : where the machine works; poses are drawn from it.
    fixed : parameters that are not identified, by name or pattern, such as `arm*.length`.
    stored_parameters : parameters that the controller of the machine stores, by name or pattern.
    common_errors : errors that several parameters share, such as those of one batch of parts or of
        a common zero.
    """

    family: ClassVar[str] = ""
    """Name of the family in robot files."""

    name: str
    source: str = ""
    home: PoseRecord = field(default_factory=PoseRecord)
    tool: PoseRecord = field(default_factory=PoseRecord)
    workspace: Workspace = field(default_factory=Workspace)
    fixed: tuple[str, ...] = ()
    stored_parameters: tuple[str, ...] = ()
    common_errors: tuple[CommonErrorRecord, ...] = ()

    def expand(self) -> Assembly:
        """Return the generic description of this robot."""
        raise TypeError("a record of no family cannot be expanded")

    def assemble(
        self,
        limbs: Iterable[Limb],
        actuators: Iterable[Actuator],
        errors: ErrorModel,
        *,
        freedoms: tuple[str, ...],
        controlled: tuple[str, ...],
    ) -> Assembly:
        """Return the assembly of limbs, drives and errors at the home pose of this record."""
        return Assembly(
            self.name,
            tuple(limbs),
            tuple(actuators),
            freedoms,
            controlled,
            self.home.matrix,
            errors.parameters,
            errors.maps,
            errors.shared,
            self.tool.matrix,
            self.workspace.ranges,
            self.source,
        )

    def assembly(self, expanded: Assembly | None = None) -> Assembly:
        """Return the expanded robot, with the parameters of `fixed` kept at their nominal values,
        the names of those that the controller stores, and the common errors of the others.

        Parameters
        ----------
        expanded : result of `expand`, where it is known.

        Raises
        ------
        MechanismError
            A name or pattern that matches no parameter, or a common error that cannot be.
        """
        expanded = self.expand() if expanded is None else expanded
        names = [parameter.name for parameter in expanded.parameters]
        fixed = _match_all(self.fixed, names, "fixed")
        stored = _match_all(self.stored_parameters, names, "stored_parameters")
        parameters = tuple(
            replace(p, free=False) if p.name in fixed else p for p in expanded.parameters
        )
        stored.update(expanded.stored_parameters)
        present = tuple(name for name in names if name in stored)
        own = (record.resolve(parameters) for record in self.common_errors)
        common = (*expanded.common_errors, *own)
        titles = [error.name for error in common]
        if duplicate := [title for title in titles if titles.count(title) > 1]:
            raise MechanismError(
                f"two common errors are called {duplicate[0]!r}; give each its own name"
            )
        return replace(
            expanded, parameters=parameters, stored_parameters=present, common_errors=common
        )


def _match_all(patterns: Iterable[str], names: Sequence[str], key: str) -> set[str]:
    """Return the parameters that match any of these names or patterns."""
    return {n for pattern in patterns for n in match_parameter_names(pattern, names, key)}


def match_parameter_names(pattern: str, names: Sequence[str], key: str = "fixed") -> list[str]:
    """Return the parameters that match a name or pattern; raises MechanismError if none does."""
    matching = fnmatch.filter(names, pattern)
    if not matching:
        hint = suggest_names(pattern, names) or f"; its parameters are {', '.join(names)}"
        raise MechanismError(
            f"{pattern!r} under `{key}` matches no parameter of this robot{hint}; correct it"
        )
    return matching


def values_per_leg(value: float | tuple[float, ...], count: int, name: str) -> tuple[float, ...]:
    """Return one value for each leg; raises MechanismError for another number of values."""
    values = (value,) * count if isinstance(value, (int, float)) else tuple(value)
    if len(values) != count:
        raise MechanismError(
            f"{name} has {len(values)} values for {count} legs; give one value, or one for each leg"
        )
    return tuple(float(v) for v in values)
