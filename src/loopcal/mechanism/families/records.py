# SPDX-License-Identifier: Apache-2.0
"""The record that the robot files of all families share: home, tool, workspace, drives, parameters.

Numbers are in SI; `loopcal.io` converts them from the units of the file, by the annotations here.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar, Literal

import numpy as np

from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import AXES, FORCES, Actuator, Address, Assembly, LinearMap
from loopcal.mechanism.families import placement
from loopcal.mechanism.families.drives import (
    Condition,
    Coupling,
    Drive,
    LoadFrame,
    PlacedRow,
    ScrewDrive,
    SpoolDrive,
    complete_row,
    list_conditions,
    place_rows,
    row_errors,
)
from loopcal.mechanism.transmission import LOAD
from loopcal.parameters import CommonError, Parameter
from loopcal.units import ARTICLES, Angle, Dimension, Length, Ratio

# Named parameters: numbers of one's own that several limbs or drives share.

Movable = Literal["length", "lead", "pitch", "offset", "gain", "curve", "backlash"]
MapAxis = Literal[placement.Freedom, Movable]
# What named parameters are mapped onto that keeps its sign: rods, screws and scales.
POSITIVE = ("length", "lead", "gain")


@dataclass(frozen=True)
class MapEntry:
    """A number that a named parameter changes.

    It is axis `axis` of the frame placed at `element` of `limb` (of all its copies). With `limb`
    the name of a drive, `element` is `transmission` and `axis` one of its terms. The displacement
    is coefficient * change, or arm * change for an angle or ratio that moves a length [arm per
    radian]. `pitch` is refused: write `lead`. A `curve` counts per radian or meter.
    """

    limb: str
    element: str
    axis: MapAxis
    coefficient: Ratio = 1.0
    arm: Length | None = None


@dataclass(frozen=True)
class NamedRecord:
    """A parameter of one's own."""

    GIVEN: ClassVar[Dimension] = Dimension.RATIO

    name: str

    @property
    def nominal(self) -> float:
        """Nominal value [SI]."""
        return float(getattr(self, self.GIVEN.value))


@dataclass(frozen=True)
class NamedLength(NamedRecord):
    """A named parameter that is a length, with its nominal value.

    `positive: true` says that no machine has it at zero or below. It is always so if a nominal
    value above zero maps onto a rod's length, a lead or a gain.
    """

    GIVEN: ClassVar[Dimension] = Dimension.LENGTH

    length: Length
    maps: tuple[MapEntry, ...]
    tolerance: placement.LengthTolerance | None = None
    positive: bool = False


@dataclass(frozen=True)
class NamedAngle(NamedRecord):
    """A named parameter that is an angle, with its nominal value."""

    GIVEN: ClassVar[Dimension] = Dimension.ANGLE

    angle: Angle
    maps: tuple[MapEntry, ...]
    tolerance: placement.AngleTolerance | None = None


@dataclass(frozen=True)
class NamedRatio(NamedRecord):
    """A named parameter without dimension, with its nominal value."""

    ratio: Ratio
    maps: tuple[MapEntry, ...]
    tolerance: placement.RatioTolerance | None = None


NamedParameter = NamedLength | NamedAngle | NamedRatio


def named_error(
    named: NamedParameter, limbs: Sequence[placement.PlacedLimb], drives: Mapping[str, PlacedRow]
) -> placement.ErrorModel:
    """Return a named parameter with its maps onto limbs and drives."""
    name, nominal, is_positive = named.name, named.nominal, getattr(named, "positive", False)
    if is_positive and not nominal > 0.0:
        raise MechanismError(
            f"parameter {name!r} must be positive, but its nominal value is {nominal * 1e3:g} mm. "
            "Correct the value, or leave out 'positive'"
        )
    is_positive = is_positive or any(entry.axis in POSITIVE for entry in named.maps)
    sd = placement.standard_deviation(named.tolerance, name)
    maps = [m for entry in named.maps for m in _map_entry(named, entry, limbs, drives)]
    return placement.single_error(name, named.GIVEN, nominal, sd, *maps, positive=is_positive)


def _check_units(named: NamedParameter, entry: MapEntry, drive: PlacedRow | None) -> None:
    """Refuse a map between unlike units, onto the drive that the entry names; a ratio is a slope
    for an angle.
    """
    dimension, axis, length = named.GIVEN, entry.axis, Dimension.LENGTH
    needed = Dimension.ANGLE if axis in AXES[:3] else length
    if drive is not None and axis in ("offset", "backlash"):
        needed = drive.drive.GIVEN
    elif drive is not None and axis in ("gain", "curve"):  # per unit of the reading
        moves_length = isinstance(drive.drive, SpoolDrive | ScrewDrive)
        needed = length if moves_length else Dimension.RATIO
    what = f"parameter {named.name!r} is {ARTICLES[dimension]}"
    onto = f"{entry.axis} of {entry.limb!r} {ARTICLES[needed]}"
    if entry.arm is not None and dimension is length:
        raise MechanismError(
            f"{what} with an arm. Leave the arm out, which turns an angle into a length"
        )
    if entry.arm is not None and needed is not length:
        raise MechanismError(f"{what} with an arm and {onto}. Leave the arm out")
    slope = dimension is Dimension.RATIO and needed is Dimension.ANGLE
    if entry.arm is None and dimension is not needed and not slope:
        remedy = f"it as {ARTICLES[needed]}"
        if needed is length:
            remedy = "an `arm:` [length per radian], or the parameter as a length"
        raise MechanismError(f"{what} and {onto}. Give {remedy}")


def _map_entry(
    named: NamedParameter,
    entry: MapEntry,
    limbs: Sequence[placement.PlacedLimb],
    drives: Mapping[str, PlacedRow],
) -> Iterator[LinearMap]:
    """Yield the maps of one entry, for every copy that it means. A file states a lead per turn, the
    engine a pitch per radian.
    """
    name, axis = named.name, entry.axis
    coefficient = entry.coefficient * (1.0 if entry.arm is None else entry.arm)
    if axis == "pitch":
        raise MechanismError(
            f"parameter {name!r} maps onto 'pitch'. Use lead, the advance in one turn"
        )
    if axis == "lead":
        axis, coefficient = "pitch", coefficient * (1 / (2 * np.pi))
    _check_units(named, entry, drives.get(entry.limb))
    # a limb and a drive may have one name; only a limb has links with axes
    if entry.limb in drives and axis not in AXES:
        scale = drives[entry.limb].sense * coefficient
        yield LinearMap(name, Address(entry.limb, entry.element, axis), scale)
        return
    chosen = [limb for limb in limbs if entry.limb == limb.stem]
    chosen = chosen or [limb for limb in limbs if entry.limb == limb.name]
    if not chosen:
        known = dict.fromkeys([*(limb.stem for limb in limbs), *sorted(drives)])
        raise MechanismError(
            f"parameter {name!r} maps onto {entry.limb!r}, which does not exist. Known: "
            f"{', '.join(known)}"
        )
    for limb in chosen:
        if axis in AXES:
            element = limb.find_element(entry.element)
            yield from placement.map_displacement(name, limb, element, axis, coefficient)
        else:
            yield LinearMap(name, Address(limb.name, entry.element, axis), coefficient)


# What is common to all families.


@dataclass(frozen=True)
class CommonErrorRecord:
    """An error that several parameters share in addition to their own, such as one batch.

    name : of the common error. of : the parameters, by name or pattern, such as `arm*.length`.
    length, angle, ratio : its expected spread, by the dimension of the parameters.
    """

    name: str
    of: tuple[str, ...]
    length: placement.LengthTolerance | None = None
    angle: placement.AngleTolerance | None = None
    ratio: placement.RatioTolerance | None = None

    def resolve(self, parameters: Sequence[Parameter], place: int) -> CommonError:
        """Return the common error of the parameters that match; raises RecordError for unlike
        parameters, a single one, or one without a spread of its own. place : in the list of the
        file.
        """
        at = ("common_errors", place)

        def refuse(sentence: str) -> placement.RecordError:
            return placement.RecordError(f"common error {self.name!r} {sentence}", *at)

        stated = {d: t for d in Dimension if (t := getattr(self, d.value, None)) is not None}
        if len(stated) != 1:
            example = "Give one, such as `length: {sd: 0.1}`"
            raise refuse(f"has {len(stated)} expected spreads. {example}")
        ((dimension, tolerance),) = stated.items()
        try:
            sd = placement.standard_deviation(tolerance, f"common error {self.name!r}")
        except MechanismError as error:
            raise placement.RecordError(str(error), *at, dimension.value) from None
        assert sd is not None
        matching = match_parameter_names(self.of, [p.name for p in parameters], *at, "of")
        chosen = [parameter for parameter in parameters if parameter.name in matching]
        for parameter in chosen:
            own = parameter.dimension
            if own is not dimension:
                raise refuse(
                    f"of {parameter.name} has an expected spread of {dimension.value}, but the "
                    f"parameter has the dimension {own.value}. Use the key `{own.value}`"
                )
            if parameter.tolerance is None:
                raise refuse(
                    f"of {parameter.name}: the parameter has no separate expected spread. Give it, "
                    "because no two parts are exactly equal"
                )
        if len(chosen) < 2:
            raise refuse(
                f"belongs to {chosen[0].name} alone. Name two or more parameters, or give the "
                "expected spread of that parameter"
            )
        return CommonError(self.name, tuple(parameter.name for parameter in chosen), sd)


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

    name : name of the robot. source : origin of its numbers.
    home : platform pose in the base at which loopcal closes the loops first (default: zero).
    tool : tool pose on the platform. workspace : region of work, from which loopcal draws poses.
    fixed : parameters outside the fit, by name or pattern, such as `arm*.length`.
    stored_parameters : parameters that the controller of the machine stores, by name or pattern.
    common_errors : errors that several parameters share, as parts of one batch do, or a common
        zero.
    drives : by name. In numbered limbs, `q` means q1, q2, .. Without an entry a drive reads the
        joint value. couplings : of driven and passive joints, by name. conditions : data columns in
        them, and the load on the platform. load : point and axes of this load. parameters : of
        one's own, with maps onto limbs and drives.
    """

    OTHER_NAMES: ClassVar[Mapping[str, str]] = {"actuators": "drives"}
    """Key that a file may state -> field that it means."""

    family: ClassVar[str] = ""
    """Name of the family in robot files."""

    name: str
    source: str = ""
    home: placement.PoseRecord = field(default_factory=placement.PoseRecord)
    tool: placement.PoseRecord = field(default_factory=placement.PoseRecord)
    workspace: Workspace = field(default_factory=Workspace)
    fixed: tuple[str, ...] = ()
    stored_parameters: tuple[str, ...] = ()
    common_errors: tuple[CommonErrorRecord, ...] = ()
    drives: Mapping[str, Drive] = field(default_factory=dict, hash=False)
    couplings: Mapping[str, Coupling] = field(default_factory=dict, hash=False)
    conditions: Mapping[str, Condition] = field(default_factory=dict, hash=False)
    load: LoadFrame = field(default_factory=LoadFrame)
    parameters: tuple[NamedParameter, ...] = ()

    def expand(self) -> Assembly:
        """Return the generic description of this robot."""
        raise TypeError("a record without family has no assembly")

    def assemble(
        self,
        limbs: Iterable[placement.PlacedLimb],
        errors: placement.ErrorModel,
        *,
        freedoms: tuple[str, ...],
        controlled: tuple[str, ...],
        own: Iterable[Actuator] = (),
        complete: placement.LinkTolerances | None = None,
        later: placement.ErrorModel | None = None,
    ) -> Assembly:
        """Return the assembly of limbs at the home pose of this record, with the drives and
        parameters that it states.

        errors, later : the unknowns of the family, before and behind those of drives.
        own : what the family knows of its drives. complete : tolerances of the errors of every link
        and drive, which are unknown, too, where stated.
        """
        columns = {name: of for name, of in self.conditions.items() if name not in FORCES}
        conditions = tuple(list_conditions(columns))
        limbs, drives, couplings = place_rows(
            tuple(limbs), self.drives, own, self.couplings, columns
        )
        rows = {**drives, **couplings}
        errors = placement.join_errors(
            (
                errors,
                *map(row_errors, rows.values()),
                *(named_error(named, limbs, rows) for named in self.parameters),
                *([later] if later else []),
            )
        )
        if complete is not None:
            every = [complete_row(row, complete) for row in {**couplings, **drives}.values()]
            all_errors = placement.complete_limbs(limbs, complete) + placement.join_errors(every)
            errors = all_errors.without_effects_of(errors) + errors
        return Assembly(
            self.name,
            tuple(limb.limb for limb in limbs),
            (
                *(drive.actuator for drive in drives.values()),
                *conditions,
                *(load for drive in drives.values() if (load := drive.load)),
            ),
            freedoms,
            controlled,
            self.home.matrix,
            errors.parameters,
            errors.maps,
            errors.shared,
            self.tool.matrix,
            self.workspace.ranges,
            self.source,
            couplings=tuple(coupling.actuator for coupling in couplings.values()),
        )

    def assembly(self) -> Assembly:
        """Return the expanded robot, with the parameters of `fixed` kept at their nominal values,
        the names of those that the controller stores, and the common errors of the others.
        """
        expanded = self.expand()
        names = [parameter.name for parameter in expanded.parameters]
        fixed = match_parameter_names(self.fixed, names, "fixed")
        stored = match_parameter_names(self.stored_parameters, names, "stored_parameters")
        stored.update(expanded.stored_parameters)
        parameters = tuple(
            replace(p, free=False) if p.name in fixed else p for p in expanded.parameters
        )
        own = (record.resolve(parameters, i) for i, record in enumerate(self.common_errors))
        common = (*expanded.common_errors, *own)
        titles = [error.name for error in common]
        if duplicate := [title for title in titles if titles.count(title) > 1]:
            raise MechanismError(
                f"two common errors have the name {duplicate[0]!r}. Give each its own name"
            )
        load = self.load.place(self.conditions)
        is_elastic = any(a.name.startswith(LOAD) for a in expanded.actuators)
        if not is_elastic and (load.stated or self.load != LoadFrame()):
            raise placement.RecordError(
                f"{self.name} has a load, but no drive with a compliance. Give a `compliance:` "
                "under `drives:`",
                "conditions" if load.stated else "load",
                *load.stated[:1],
            )
        return replace(
            expanded,
            parameters=parameters,
            stored_parameters=tuple(name for name in names if name in stored),
            common_errors=common,
            load=load,
        )


def match_parameter_names(
    patterns: Sequence[str], names: Sequence[str], *key: str | int
) -> set[str]:
    """Return the parameters that match any of these names or patterns, which a file lists at `key`;
    raises RecordError for one that none matches.
    """
    found: set[str] = set()
    for i, pattern in enumerate(patterns):
        matching = fnmatch.filter(names, pattern)
        if not matching:
            hint = suggest_names(pattern, names) or f"; its parameters are {', '.join(names)}"
            sentence = f"{pattern!r} under `{key[0]}` matches no parameter of this robot{hint}"
            raise placement.RecordError(f"{sentence}. Correct it", *key, i)
        found.update(matching)
    return found


def values_per_leg(value: float | tuple[float, ...], count: int, name: str) -> tuple[float, ...]:
    """Return one value for each leg; raises MechanismError for another number of values."""
    values = (value,) * count if isinstance(value, (int, float)) else tuple(value)
    if len(values) != count:
        raise MechanismError(
            f"{name} has {len(values)} values for {count} legs. Give one value, or one for each leg"
        )
    return tuple(float(v) for v in values)


def check_spherical(name: str, spherical: str, error_model: str) -> None:
    """Refuse balls of three axes without errors; raises MechanismError."""
    if spherical == "axes" and error_model == "ideal":
        raise MechanismError(
            f"{name} has spherical: axes with error_model: ideal, whose parameters describe "
            "perfect points. Give error_model: complete, or spherical: point"
        )
