# SPDX-License-Identifier: Apache-2.0
"""A kind of measurement in a file: its name, its own settings, its noise and its rows.

    kind: pose                                the name of a kind of `loopcal.measure.kinds.KINDS`
    orientation: euler-xyz                    the fields of its dataclass
    T_base_frame: {x: 12 mm, yaw: 90 deg}     poses: x y z, and R = Rz(yaw) Ry(pitch) Rx(roll)
    places: [[100 mm, 0 mm, 20 mm]]           lengths with units; directions as plain numbers
    noise: {x: 1 um, "*": 5 urad}             standard deviations of the noise columns, by name or
                                              pattern; the last one that matches counts
    noise_source: assumed                     nobody stated this noise

The record of a kind's settings is made from its dataclass, so that a new kind needs nothing here:
arrays called T_.. are poses, those in DIRECTIONS are directions, other arrays are lengths, and
numbers, too, unless they state another dimension, as Annotated[float, Dimension.ANGLE].
"""

from __future__ import annotations

import dataclasses
import math
import operator
import types
import typing
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, make_dataclass, replace
from fnmatch import fnmatchcase
from functools import cache, reduce
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.errors import DataError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Places, Table, require_columns
from loopcal.io.core.records import get_field_types, read_record
from loopcal.io.core.text_file import name_files
from loopcal.io.core.yaml_file import Location, YamlFile, refuse_unknown_keys
from loopcal.io.data.columns import (
    ROW_COLUMNS,
    SIGMA,
    find_column_fault,
    list_columns,
    name_covariance,
    name_measured,
    refuse_unknown_columns,
)
from loopcal.measure.array_checks import drop_repeats
from loopcal.measure.data_checks import check_kinds
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.kind import BASE, Kind, name_shared_error
from loopcal.measure.nuisance import StatedValue, collect_nuisance_parameters
from loopcal.measure.observations import InstrumentRecord, NoisePart, Observations, StatedSize
from loopcal.mechanism.families.placement import PoseRecord
from loopcal.mechanism.model import Mechanism
from loopcal.parameters import Parameter
from loopcal.plain_text import quote
from loopcal.typing import BoolArray, FloatArray, IntArray, find_array_type
from loopcal.units import (
    DISPLAY_UNITS,
    EXAMPLES,
    NUMBER,
    SI_SYMBOLS,
    SMALLEST_SD,
    UNITS,
    Dimension,
    Expansion,
    Given,
    Length,
    Ratio,
    Temperature,
    Unit,
    find_sd_fault,
    format_scaled,
    scale,
)

DIRECTIONS = ("along", "axis", "normal", "up")
NOISE_UNITS = {
    Dimension.LENGTH: ("um", 1e-6),
    Dimension.ANGLE: ("urad", 1e-6),
    Dimension.RATIO: ("1", 1.0),
    Dimension.PIXEL: ("px", 1.0),
}
ASSUMED = "assumed"  # word for noise that a program assumed
MANY_SIGMAS = 3  # number of columns above which an equal noise is written once

SQRT_3 = math.sqrt(3.0)
# Key that states an uncertainty -> distribution and divisor; None where `k` is the divisor.
FORMS: Mapping[str, tuple[str, float | None]] = {
    "sd": ("normal", 1.0),
    "limit": ("uniform", SQRT_3),
    "U": ("normal", None),
}

MOST_K = 10.0  # largest coverage factor


@dataclass(frozen=True)
class Uncertainty:
    """An uncertainty: a standard deviation, a limit, or an expanded uncertainty.

    sd : standard deviation. limit : half of the width within which the value is uniform.
    U : expanded uncertainty, `k` standard deviations.
    """

    sd: Any = None
    limit: Any = None
    U: Any = None
    k: float | None = None

    def __post_init__(self) -> None:
        if len(self.forms) != 1:
            sentence = "an uncertainty has one form: 'sd', 'limit' (uniform within it), or 'U'"
            raise ValueError(f"{sentence} with its 'k'. Write one of them")
        if self.k is not None and (self.forms != ["U"] or not 1.0 <= self.k <= MOST_K):
            act = f"Write the coverage factor of 'U', from 1 to {MOST_K:g}"
            raise ValueError(f"k is {self.k:g}. {act}")

    @property
    def forms(self) -> list[str]:
        """The keys of FORMS that are stated."""
        return [name for name in FORMS if getattr(self, name) is not None]

    def read(
        self,
        file: YamlFile,
        dimension: Dimension,
        place: Location,
        what: str,
        may_be_zero: bool = False,
    ) -> StatedSd:
        """Return the standard deviation [SI] with its statement; FileError where it is none."""
        (form,) = self.forms
        distribution, divisor = FORMS[form]
        divisor = divisor or self.k or 2.0
        text = getattr(self, form)
        sd = file.quantity(text, dimension, place, is_difference=True)
        if (sd or not may_be_zero) and (fault := find_sd_fault(sd)):
            raise file.error(f"{what} is {text}; {fault}", place)
        return sd / divisor, _state_size(text, distribution, divisor)


StatedSd = tuple[float, StatedSize]  # standard deviation [SI], and how it is stated

LENGTHS = Annotated[list[Any], Dimension.LENGTH]
NUMBERS = Annotated[list[Any], Dimension.RATIO]
NAMES = tuple[str, ...] | str
Scope = Literal["session", "all"]


def read_kind(file: YamlFile, node: Mapping[str, Any], location: Location) -> Kind:
    """Return the kind that settings (`node` at a location) describe; keys of others are ignored.

    FileError : no or an unknown kind, a setting that does not fit it, or a name of a target that
    no column can have.
    """
    name = node.get("kind")
    if name is None:
        example = "write '# kind: pose' at the top, or 'kind: pose' in a .yaml file of this name"
        sentence = f"the kind of measurement is missing; {example} (kinds: {', '.join(KINDS)})"
        raise file.error(sentence, location)
    if not isinstance(name, str) or name not in KINDS:
        sentence = f"{quote(name)} is not a kind of measurement{suggest_names(str(name), KINDS)}"
        raise file.error(f"{sentence}. Allowed: {', '.join(KINDS)}", (*location, "kind"))
    kind = KINDS[name]
    settings = {key: node[key] for key in list_kind_settings(kind) if key in node}
    hints = get_field_types(make_settings_record(kind))
    record = read_record(file, settings, make_settings_record(kind), None, location)
    given = {key: getattr(record, key) for key in settings}
    for key, value in given.items():
        if hints[key] in (LENGTHS, NUMBERS):
            if not _is_array(value):
                sentence = "must be a list of numbers, or of lists of equal length. Correct it"
                raise file.error(f"{key!r} {sentence}", (*location, key))
            given[key] = np.array(value, dtype=float)
        elif isinstance(value, PoseRecord):
            given[key] = value.matrix
        elif isinstance(value, str) and hints[key] == NAMES:
            given[key] = (value,)
    try:
        made = kind(**given)
    except DataError as error:
        raise file.error(f"{error}", (*location, next(iter(settings), "kind"))) from None
    for column in made.columns:
        if fault := find_column_fault(column.name, "measured value"):
            raise file.error(fault, (*location, "targets" if "targets" in settings else "kind"))
    return made


def list_kind_settings(kind: type[Kind]) -> dict[str, Any]:
    """Return name -> annotation of the settings of a kind."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(cast(Any, kind)) if f.init}


def read_noise(
    file: YamlFile, node: Mapping[str, Any], kind: Kind, location: Location
) -> dict[str, StatedSd]:
    """Return noise column -> standard deviation [SI] with its statement, of the columns for which
    one is stated; FileError for an unknown column or a bad number.
    """
    stated, place = node.get("noise", {}), (*location, "noise")
    dimensions = {column.name: column.dimension for column in kind.noise_columns}
    sight = kind.sight_noise
    if not isinstance(stated, dict):
        example = ", ".join(f"{name}: {EXAMPLES[d]}" for name, d in dimensions.items())
        sentence = "'noise' must give a standard deviation for each column"
        raise file.error(f"{sentence}. Write 'noise: {{{example}}}'", place)
    noise: dict[str, StatedSd] = {}
    for text, names, at in match_names(file, stated, [*dimensions, *sight], place):
        uncertainty = text if isinstance(text, dict) else {"sd": text}
        record = read_record(file, uncertainty, Uncertainty, None, at)
        for column in names:
            if column in dimensions or column == at[-1]:  # a pattern is of columns
                dimension, what = {**dimensions, **sight}[column], f"the noise of {at[-1]!r}"
                noise[column] = record.read(file, dimension, at, what)
    return noise


def match_names(
    file: YamlFile, stated: Mapping[str, Any], names: list[str], place: Location
) -> Iterator[tuple[Any, list[str], Location]]:
    """Yield what is stated by names or patterns, the names that each denotes, and its place."""
    for pattern, node in stated.items():
        matching = [name for name in names if fnmatchcase(name, pattern)]
        matching = [pattern] if pattern in names else matching
        if not matching:
            of_all = [f"*.{pattern}" for name in names if name.endswith(f".{pattern}")]
            refuse_unknown_keys(file, [pattern], [*of_all[:1], *names], place)
        yield node, matching, (*place, pattern)


def _state_size(text: Any, distribution: str = "normal", divisor: float = 1.0) -> StatedSize:
    """Return a number with its unit as a file states it."""
    match = NUMBER.match(text := str(text).strip())
    assert match is not None, "the reader has found the number"
    return StatedSize(float(match[0]), text[match.end() :].strip(), distribution, divisor)


def describe_kind(
    kind: Kind, noise: Mapping[str, float], tool: FloatArray, is_noise_assumed: bool = False
) -> dict[str, Any]:
    """Return the settings of a kind as a file states them.

    Keyword-only settings are left out where they are the default, or the robot's `tool`.
    """
    hints = get_field_types(make_settings_record(type(kind)))
    settings: dict[str, Any] = {"kind": kind.name}
    for setting in dataclasses.fields(cast(Any, kind)):
        if not setting.init or (value := getattr(kind, setting.name)) is None:
            continue
        usual = setting.default
        if setting.name == "T_platform_tool":
            usual = tool
        elif setting.default_factory is not dataclasses.MISSING:
            usual = setting.default_factory()
        is_usual = usual is not dataclasses.MISSING and bool(np.array_equal(value, usual))
        if not is_usual or (not setting.kw_only and isinstance(value, str | tuple)):
            settings[setting.name] = _describe_setting(value, hints[setting.name])
    if noise:
        units = {column.name: NOISE_UNITS[column.dimension] for column in kind.noise_columns}
        units |= {name: NOISE_UNITS[dimension] for name, dimension in kind.sight_noise.items()}
        # nine digits: more would be rounding
        sigmas = {name: f"{s / units[name][1]:.9g} {units[name][0]}" for name, s in noise.items()}
        if len(sigmas) > MANY_SIGMAS and len(set(sigmas.values())) == 1:
            sigmas = {"*": next(iter(sigmas.values()))}
        settings["noise"] = sigmas
    return {**settings, "noise_source": ASSUMED} if is_noise_assumed else settings


def describe_quantity(value: float, dimension: Dimension, unit: Unit | None = None) -> str | float:
    """Return a number with its unit, in SI where only that reads back as the same double; a ratio
    for which none is given without a unit.
    """
    if dimension is Dimension.RATIO and unit is None:
        return value
    shown = unit or DISPLAY_UNITS[dimension]
    text = format_scaled(value, shown.factor_to_si)
    if scale(float(text), shown.factor_to_si) == value:
        return f"{text} {shown.symbol}"
    return f"{value!r} {SI_SYMBOLS[dimension]}"


@cache
def make_settings_record(kind: type[Kind]) -> type:
    """Return a record of the settings of a kind (cached); all may be left out."""
    fields = [(n, _annotate(n, hint), None) for n, hint in list_kind_settings(kind).items()]
    return make_dataclass(f"{kind.__name__}Settings", fields, frozen=True)


def _annotate(name: str, annotation: Any) -> Any:
    """Return the annotation of a setting in files, from the annotation in its kind."""
    origin, members = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        of_members = (_annotate(name, m) for m in members if m is not types.NoneType)
        return reduce(operator.or_, of_members)
    if find_array_type(annotation):
        return PoseRecord if name.startswith("T_") else NUMBERS if name in DIRECTIONS else LENGTHS
    if annotation == tuple[str, ...]:
        return NAMES
    if origin is tuple:
        return tuple[tuple(_annotate(name, member) for member in members)]
    return Length if annotation is float else annotation


def _is_array(value: list[Any]) -> bool:
    """Return whether a list holds numbers only, or lists of numbers of one length."""
    if not any(isinstance(item, list) for item in value):
        return all(isinstance(item, float | int) and not isinstance(item, bool) for item in value)
    lengths = {len(item) if isinstance(item, list) else -1 for item in value}
    return len(lengths) == 1 and all(_is_array(item) for item in value)


def _describe_setting(value: Any, annotation: Any) -> Any:
    """Return a setting as `read_kind` reads it, by its annotation in files."""
    if annotation is PoseRecord:
        angles = geometry.matrix_to_euler(value[:3, :3], "xyz")
        numbers = [float(v) + 0.0 for v in (*value[:3, 3], *angles)]
        names = ("x", "y", "z", "roll", "pitch", "yaw")
        units = [Dimension.LENGTH] * 3 + [Dimension.ANGLE] * 3
        return dict(zip(names, map(describe_quantity, numbers, units), strict=True))
    return _describe_items(value, _find_dimension(annotation))


def _find_dimension(annotation: Any) -> Dimension | None:
    """Return the dimension of the numbers of an annotation; None where it states none."""
    marks = getattr(annotation, "__metadata__", map(_find_dimension, get_args(annotation)))
    return next((mark for mark in marks if isinstance(mark, Dimension)), None)


def _describe_items(value: Any, dimension: Dimension | None) -> Any:
    """Return a value, or a list or array of values; numbers have the dimension."""
    items = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(items, list | tuple):
        return [_describe_items(item, dimension) for item in items]
    if dimension is None or isinstance(items, str):
        return items
    return describe_quantity(float(items), dimension)


# Prior knowledge of setup parameters (frames, targets, surfaces, offsets).

KEY, FIXED = "unknowns", "fixed"
EXAMPLE = (
    f"write '{FIXED}', {{sd: 1 mm}}, {{start: 12 mm, sd: 1 mm}}, {{start: 12 mm, {FIXED}: true}}, "
    "or {scope: all} for one value in all sessions"
)


@dataclass(frozen=True)
class KnownParameter:
    """The knowledge of a parameter, whose dimension its class states."""

    start: Given | None = None
    sd: Given | None = None
    fixed: bool = False
    scope: Scope = "session"


# Dimension -> record of the knowledge of a parameter.
RECORDS = {
    dimension: type("KnownParameter", (KnownParameter,), {"GIVEN": dimension})
    for dimension in (Dimension.LENGTH, Dimension.ANGLE, Dimension.RATIO, Dimension.PIXEL)
}


Stated = tuple[StatedValue, YamlFile, Location]  # what is known, and where it is stated


def read_stated_values(
    files: Sequence[tuple[YamlFile, Sequence[Observations], Sequence[StatedValue]]],
    labels: tuple[str, ...],
) -> tuple[StatedValue, ...]:
    """Return the knowledge that files state of the setup parameters of their own rows.

    `files` : settings of each file, its rows, and the priors of the common errors of its
    instruments, of `read_shared_errors`. `labels` : names of the poses.

    FileError : a name that is not a parameter of the file, a bad statement, contradicting files.
    DataError : two kinds of a file state one parameter differently.
    """
    known: dict[str, Stated] = {}
    for file, observations, shared in files:
        of_file = _read_values_of_file(file, observations, shared, labels)
        for name, (value, _, place) in of_file.items():
            if name in known and known[name][0] != value:
                _, other, other_place = known[name]
                line = f"{other.path}:{other.line(other_place)}"
                sentence = f"parameter {name!r} differs from {line}. Give it once"
                raise file.error(sentence, place)
        known = of_file | known
    common = [name for name, (value, _, _) in known.items() if value.scope == "all"]
    for name, (_, file, place) in known.items():
        if any(name != other and _is_parameter(name, other) for other in common):
            sentence = f"parameter {name!r} has the scope all in another line or file"
            raise file.error(f"{sentence}. Give its scope once", place)
    return tuple(value for value, _, _ in known.values())


def _read_values_of_file(
    file: YamlFile,
    observations: Sequence[Observations],
    shared: Sequence[StatedValue],
    labels: tuple[str, ...],
) -> dict[str, Stated]:
    """Return name -> what one file states of a parameter."""
    stated = file.content.get(KEY, {})
    if not isinstance(stated, dict):
        sentence = f"{KEY!r} must name parameters, as {KEY}: {{tracker.x: {{sd: 1 mm}}}}"
        raise file.error(sentence, (KEY,))
    if not (stated or shared):
        return {}
    entries = collect_nuisance_parameters(observations, labels).table.entries
    values: dict[str, Stated] = {}
    for value in shared:
        names = [value.name]
        if value.scope == "session":
            names = [e.name for e in entries if _is_parameter(e.name, value.name)]
        for name in names:
            prior = replace(value, name=name)
            if values.setdefault(name, (prior, file, ()))[0] != prior:
                sentence = f"two kinds of this file define {value.name!r} differently"
                raise file.error(f"{sentence}. Give it alike, or give their frames two names")
    own_names = {p.name for rows in observations for p in rows.kind.nuisance_parameters}
    for pattern, node in stated.items():
        place = (KEY, pattern)
        for value in _read_one(file, node, _match(file, entries, pattern), place):
            name = value.name
            if value.scope == "all":
                name = next(own for own in own_names if _is_parameter(name, own))
            values[name] = (replace(value, name=name), file, place)
    return values


def read_setup_priors(file: YamlFile, kinds: Sequence[KindRows]) -> tuple[StatedValue, ...]:
    """Return the knowledge of setup parameters that settings state for all sessions."""
    priors = [value for entry in kinds for value in entry.shared_errors]
    stated = file.content.get(KEY, {})
    parameters = [p for entry in kinds for p in entry.kind.nuisance_parameters]
    for pattern, node in stated.items() if isinstance(stated, dict) else ():
        matching = [p for p in parameters if fnmatchcase(p.name, pattern)]
        # what is known of one session holds for no other, but must be a parameter
        if not any(fnmatchcase(p.name, pattern.partition(".")[2]) for p in parameters):
            matching = matching or _match(file, parameters, pattern)
        for known in {p.name: p for p in matching}.values():
            priors += _read_one(file, node, [known], (KEY, pattern))
    return tuple(dict.fromkeys(priors))


def _is_parameter(name: str, own_name: str) -> bool:
    """Return whether a name is that of a parameter, with or without a session in front."""
    return name == own_name or name.endswith(f".{own_name}")


def describe_stated_values(
    known: Sequence[StatedValue], entries: Sequence[Parameter]
) -> dict[str, Any]:
    """Return the setting `unknowns`, for the parameters among `entries`."""
    dimensions = {entry.name: entry.dimension for entry in entries}
    content: dict[str, Any] = {}
    for value in known:
        names = (name for name in dimensions if _is_parameter(name, value.name))
        name = next(names, None)
        if name is None or (np.isinf(value.sd) and value.scope == "session"):
            continue
        dimension, stated = dimensions[name], dict[str, Any]()
        for key, number in (("start", value.nominal), ("sd", value.sd or None)):
            if number is not None and np.isfinite(number):
                unit = UNITS["ppm"] if dimension is Dimension.RATIO else None
                stated[key] = describe_quantity(number, dimension, unit)
        if not value.sd and (stated or value.scope == "all"):
            stated[FIXED] = True
        if value.scope == "all":
            stated["scope"] = "all"
        content[value.name] = stated or FIXED
    return content


def _match(file: YamlFile, entries: Sequence[Parameter], pattern: str) -> list[Parameter]:
    """Return the parameters that a name or a pattern denotes."""
    exact = [entry for entry in entries if entry.name == pattern]
    whole = exact or [entry for entry in entries if fnmatchcase(entry.name, pattern)]
    matching = whole or [entry for entry in entries if fnmatchcase(entry.name, f"*.{pattern}")]
    if not matching:
        names = [entry.name for entry in entries]
        allowed = ", ".join(names[:12]) or "none. Give some, as 'unknown: [frame]' of the kind"
        sentence = f"this file has no setup parameter {pattern!r}{suggest_names(pattern, names)}"
        raise file.error(f"{sentence}; it has {allowed}", (KEY, pattern))
    return matching


def _read_one(
    file: YamlFile, node: Any, matching: Sequence[Parameter], place: Location
) -> list[StatedValue]:
    """Return the knowledge that one line states of each parameter that it denotes."""
    if node == FIXED:
        return [StatedValue(entry.name) for entry in matching]
    if not isinstance(node, dict):
        raise file.error(f"{node!r} gives no knowledge of a parameter. {EXAMPLE}", place)
    dimensions = {entry.dimension for entry in matching}
    if len(dimensions) > 1 and ("start" in node or "sd" in node):
        sentence = "this pattern matches lengths and angles. Give them in separate lines"
        raise file.error(sentence, place)
    stated = read_record(file, node, RECORDS[matching[0].dimension], None, place)
    is_only_shared = stated.scope == "all" and not stated.fixed and "sd" not in node
    if stated.fixed == ("sd" in node) and not is_only_shared:
        raise file.error(f"give either 'sd' or '{FIXED}: true'. {EXAMPLE}", place)
    if "sd" in node and (fault := find_sd_fault(stated.sd or 0.0)):
        sentence = f"the standard deviation is {node['sd']}; {fault}, or {FIXED}"
        raise file.error(sentence, (*place, "sd"))
    sd = np.inf if is_only_shared else stated.sd or 0.0
    return [StatedValue(e.name, sd, stated.start, scope=stated.scope) for e in matching]


def read_instrument(
    file: YamlFile, node: Mapping[str, Any], location: Location
) -> InstrumentRecord | None:
    """Return the stated instrument, None where there is none; FileError for wrong content."""
    if (stated := node.get("instrument")) is None:
        return None
    if isinstance(stated, str):
        return InstrumentRecord(name=stated)
    place = (*location, "instrument")
    if not isinstance(stated, dict) or not stated:
        sentence = "'instrument' is neither a name nor facts of an instrument. Write its name, or"
        example = 'instrument: {name: AT960, serial_number: "750123", certificate: D-K-15123}'
        raise file.error(f"{sentence} '{example}'", place)
    return read_record(file, stated, InstrumentRecord, None, place)


def describe_instrument(record: InstrumentRecord) -> str | dict[str, str]:
    """Return the setting of an instrument: its name, or its facts where there are others."""
    stated = record.to_dict()
    return record.name if list(stated) == ["name"] else stated


# Common errors of an instrument, which its rows share, in the settings of a kind.

UNKNOWN, MPE = "unknown", "mpe"
SHARED_ERRORS: Mapping[str, str] = {
    "session_bias": "`unknown`, or component -> standard deviation or `unknown`: an offset that "
    "all rows of a session share",
    "session_drift": "as above, for a change over a session, linear in time or, without the column "
    "`time`, in the order of the rows",
    "scale": "a factor on all measured lengths: `sd` of its deviation from 1, and, unless 0, its "
    "`mean`. With `scope: all` one factor holds in all sessions",
    "temperature": "of the machine or part: `value`, `sd`, its `expansion` minus the scale's, and, "
    "unless 0, `expansion_sd`. Measured lengths are longer by `expansion * (value - reference)`. "
    "`reference` is 20 degC, `scope` as of `scale`",
    MPE: "maximum permissible error of the certificate, `constant` and `per_length`, in place of "
    "the noise of lengths and of the scale, with `scope` as of `scale`",
}


@dataclass(frozen=True, kw_only=True)
class Scale(Uncertainty):
    """A factor on all measured lengths, whose deviation from 1 has this mean."""

    mean: Ratio = 0.0
    scope: Scope = "session"


@dataclass(frozen=True, kw_only=True)
class PartTemperature(Uncertainty):
    """The temperature of the machine or part, and its expansion minus that of the scale."""

    value: Temperature
    expansion: Expansion
    expansion_sd: Expansion = 0.0
    reference: Temperature = 20.0  # [degC], of ISO 1
    scope: Scope = "session"


@dataclass(frozen=True, kw_only=True)
class PermissibleError:
    """The maximum permissible error of lengths."""

    constant: Length
    per_length: Ratio = 0.0
    scope: Scope = "session"


# Setting -> record of what scales lengths.
SCALED: Mapping[str, type[Any]] = {
    "scale": Scale,
    "temperature": PartTemperature,
    MPE: PermissibleError,
}
ITEMS: Mapping[str, str] = {"session_bias": "bias", "session_drift": "drift"}


def read_shared_errors(
    file: YamlFile, node: Mapping[str, Any], kind: Kind, location: Location
) -> tuple[Kind, dict[str, StatedSd], list[StatedValue]]:
    """Return a kind with the common errors of its instrument as unknowns, the noise [SI] of columns
    that an MPE states, and the priors, of 0 where a component has no such error. FileError : an
    unknown component or key, or no number.
    """
    noise: dict[str, StatedSd] = {}
    priors: dict[str, StatedValue] = {}
    for key in (key for key in SHARED_ERRORS if key in node):
        place, stated = (*location, key), node[key]
        components = dict(kind.component_columns.keys())
        measured = set(components.values())
        if not measured or (key in SCALED and Dimension.LENGTH not in measured):
            what = "lengths" if key in SCALED else "values"
            raise file.error(f"the kind {kind.name!r} measures no {what}. Remove {key!r}", place)
        if key in SCALED:
            lengths, factors, scope = _read_scales(file, key, stated, place)
            columns = [c.name for c in kind.noise_columns if c.dimension is Dimension.LENGTH]
            noise |= {} if lengths is None else dict.fromkeys(columns, lengths)
            if key == MPE and "scale" in node:
                sentence = f"{MPE!r} and 'scale' both define the scale of the instrument"
                raise file.error(f"{sentence}. Remove one of them", place)
            kind = _add_unknown(kind, tuple(factors))
            for item, (mean, sd, size) in factors.items():
                name = name_shared_error(kind, item, "")
                priors[name] = StatedValue(name, sd, mean or None, scope=scope, size=size)
            continue
        if stated != UNKNOWN and not (isinstance(stated, dict) and stated):
            example = ", ".join(f"{name}: {EXAMPLES[d]}" for name, d in components.items())
            sentence = f"{key!r} is {stated!r}. Write '{key}: {UNKNOWN}', or standard deviations"
            raise file.error(f"{sentence}, as '{key}: {{{example}}}'", place)
        item = ITEMS[key]
        kind = _add_unknown(kind, (item,))
        if stated == UNKNOWN:
            continue
        names = [name_shared_error(kind, item, name) for name in components]
        priors |= {name: StatedValue(name) for name in names}
        for text, chosen, at in match_names(file, stated, list(components), place):
            for name in chosen:
                parameter = name_shared_error(kind, item, name)
                priors.pop(parameter, None)
                if text != UNKNOWN:
                    sd = file.quantity(text, components[name], at)
                    if fault := find_sd_fault(sd):
                        sentence = f"the standard deviation is {text}; {fault}, or {UNKNOWN}"
                        raise file.error(sentence, at)
                    priors[parameter] = StatedValue(parameter, sd)
    return kind, noise, list(priors.values())


def _add_unknown(kind: Kind, items: tuple[str, ...]) -> Kind:
    """Return a kind with more unknown setup items."""
    return replace(cast(Any, kind), unknown=tuple(dict.fromkeys((*kind.unknown, *items))))


def _read_scales(
    file: YamlFile, key: str, node: Any, place: Location
) -> tuple[StatedSd | None, dict[str, tuple[float, float, StatedSize]], Scope]:
    """Return what one of the settings `SCALED` states: the standard deviation [m] of each length,
    where it states one; setup item -> mean, standard deviation and its statement, of a factor minus
    1; and whether one value holds for a session or for all.
    """
    stated: Any = read_record(file, node, SCALED[key], None, place)

    def state(name: str) -> tuple[float, StatedSize] | None:
        """Return a size that is not zero, and its statement; those of an MPE are uniform."""
        if not (size := getattr(stated, name)):
            return None
        if fault := find_sd_fault(size):
            raise file.error(f"{name!r} of {key!r} is {node[name]}; {fault}", (*place, name))
        if key == MPE:
            return size / SQRT_3, _state_size(node[name], "uniform", SQRT_3)
        return size, _state_size(node[name])

    if key == MPE:
        scale = state("per_length")
        return state("constant"), {"scale": (0.0, *scale)} if scale else {}, stated.scope
    dimension = Dimension.RATIO if key == "scale" else Dimension.TEMPERATURE
    (form,) = stated.forms
    what = f"{form!r} of {key!r}"
    sd, size = stated.read(file, dimension, (*place, form), what, may_be_zero=True)
    if key == "scale":
        return None, {"scale": (stated.mean, sd, size)}, stated.scope
    rise, slope = stated.value - stated.reference, stated.expansion
    factors = {"temperature": (rise * slope, abs(slope) * sd, size)}
    if of_slope := state("expansion_sd"):
        factors["expansion"] = (0.0, of_slope[0] * float(np.hypot(rise, sd)), of_slope[1])
    return None, {item: of for item, of in factors.items() if any(of[:2])}, stated.scope


# The rows of each kind: measured values and their noise.

SETTINGS: Mapping[str, str] = {
    "format": "1",
    "robot": "name of the robot. loopcal reports a difference from the robot in use",
    "instrument": "name of the instrument, or its facts for traceability: see "
    "[instruments](#instruments-and-their-traceability)",
    "controller": "robot file of the geometry that converts commanded coordinates to readings. "
    "Default: the nominal robot",
    "kind": "the kind of all rows, followed by its own settings and noise",
    "kinds": "label -> kind, settings and noise, in files with several kinds",
    "noise": "standard deviation of each noise column, with its unit, by name or pattern, such as "
    '`"*.x": 5 um`. Of a position also `range`, `angle` and `centering`, as of a tracker. In place '
    "of a standard deviation `{limit: 15 um}` (uniform within it) or `{U: 10 um, k: 2}`",
    "noise_source": "`assumed` for a noise that users did not give, as in imported files. Default: "
    "`stated`. Quality gates ignore assumed noise",
    **SHARED_ERRORS,
    "unknowns": "name or pattern -> prior knowledge of a setup parameter (frame, target, surface, "
    "offset), or `fixed`",
    "session": "session of all rows without an entry in the column",
    "group": "group of all rows without an entry in the column",
    "reading_noise": "standard deviation of the readings: one for all, or actuator or pattern -> "
    "one. Default: from the robot file",
    "poses": "another file in this folder, with the readings of the poses",
}
# Settings of kinds that are columns, too, by which a row belongs to a kind.
ROW_SETTINGS = ("camera", "board")
# Settings beside those of the kind itself.
KIND_SETTINGS = ("noise", "noise_source", "instrument", *SHARED_ERRORS)
# Settings of a file without measured values.
POSE_SETTINGS = ("format", "robot", "controller", "reading_noise")


@dataclass(frozen=True, eq=False)
class KindRows:
    """A kind in a file: its noise [SI] by column, its rows, and the place of its settings.

    `is_noise_assumed` where nobody stated the noise; `shared_errors` are the priors of
    `read_shared_errors`; `sizes` are the statements of the noise.
    """

    kind: Kind
    noise: dict[str, float]
    rows: IntArray
    location: Location
    is_noise_assumed: bool = False
    shared_errors: Sequence[StatedValue] = ()
    instrument: InstrumentRecord | None = None
    sizes: Mapping[str, StatedSize] = dataclasses.field(default_factory=dict)


def has_measured_values(table: Table) -> bool:
    """Return whether a file states a kind; one that does not only holds readings of poses."""
    return any(key in table.settings.content for key in ("kind", "kinds"))


def read_kinds(table: Table, robot: Mechanism, several: bool = False) -> tuple[KindRows, ...]:
    """Return the kinds of a file, mounted on the robot's tool, with the indices of their rows.

    One of `several` files may have none, and then only holds readings of poses. FileError :
    settings or columns without a meaning.
    """
    file, content = table.settings, table.settings.content
    labeled = content.get("kinds")
    if several and not has_measured_values(table):
        refuse_unknown_keys(file, list(content), POSE_SETTINGS)
        kinds: tuple[KindRows, ...] = ()
    elif labeled is None:
        kinds = (_read_entry(file, content, robot, (), np.arange(len(table))),)
    else:
        of_kind = {"kind", *KIND_SETTINGS} - {"instrument"}
        refuse_unknown_keys(file, list(content), [key for key in SETTINGS if key not in of_kind])
        if not isinstance(labeled, dict) or not all(isinstance(n, dict) for n in labeled.values()):
            example = "'kinds: {height: {kind: component, ..}}'"
            raise file.error(f"'kinds' must map labels to kinds, as {example}", ("kinds",))
        by_settings = "kind" not in table.units
        if not (by_settings and any(name in table.units for name in ROW_SETTINGS)):
            require_columns(table, ["kind"], "which assigns each row to one of the kinds")
            by_settings = False
        cells = np.array(table.text("kind"))
        for row, cell in enumerate(cells):
            if cell and cell not in labeled:  # without a kind, a row only holds readings
                sentence = f"column 'kind' is {cell!r}. Allowed: {', '.join(labeled)}"
                raise table.row_error(row, sentence)
        kinds = tuple(
            _read_entry(
                file, node, robot, ("kinds", label), np.flatnonzero(by_settings | (cells == label))
            )
            for label, node in labeled.items()
        )
    kinds = _select_by_settings(table, kinds)
    refuse_unknown_columns(table, robot, [entry.kind for entry in kinds])
    return kinds


def read_observations(
    table: Table,
    robot: Mechanism,
    entry: KindRows,
    members: Sequence[tuple[int, ...]],
    context: Mapping[str, FloatArray],
    pose_context: Mapping[str, FloatArray],
) -> tuple[Observations, Places]:
    """Read the rows of one kind; return them with file and line of each.

    `members` are the poses of each row of the file; `context` and `pose_context` times and
    temperatures of its rows (rows,) and of the poses (n,), for rows that state none.

    FileError : a cell that does not fit. DataError : noise that is not a covariance.
    """
    entry = _select_rows(table, entry, members)
    links, rows = entry.kind.poses_per_row, entry.rows
    measured, covariance, parts = _read_values(table, robot, entry)
    if entry.kind.is_of_base:
        poses, pose_context = np.zeros((len(rows), 1), dtype=np.intp), {}
    else:
        poses = np.array([members[row] for row in rows], dtype=np.intp).reshape(-1, links)
    beside = {}
    for name in dict.fromkeys([*context, *pose_context]):
        values = context[name][rows] if name in context else np.full(len(rows), np.nan)
        if name in pose_context:
            values = np.where(np.isnan(values), pose_context[name][poses].mean(axis=1), values)
        if not np.isnan(values).all():
            beside[name] = values
    names: dict[str, Any] = {name: _read_names(table, name, rows) for name in ROW_COLUMNS}
    with name_files(table.path):
        observations = Observations(
            entry.kind,
            poses[:, 0] if links == 1 else poses,
            measured,
            covariance,
            **names,
            context=beside,
            source=str(table.path),
            is_noise_assumed=entry.is_noise_assumed,
            instrument=entry.instrument,
            noise_parts=parts,
        )
    return observations, table.places(rows)


def _read_entry(
    file: YamlFile, node: Mapping[str, Any], robot: Mechanism, place: Location, rows: IntArray
) -> KindRows:
    """Return the kind of some rows, from the settings at a place of the file, mounted on the
    robot's tool; refuse what it cannot measure.
    """
    kind = read_kind(file, node, place).with_tool(robot.tool)
    bodies = [stage.name for stage in robot.stages] or list(robot.assembly.bodies)
    if kind.of and not kind.is_of_base and kind.of not in bodies:
        known = f"a stage or body ({', '.join(bodies)}), or base" if bodies else "base"
        hint = suggest_names(kind.of, [*bodies, BASE])
        sentence = f"{robot.name!r} has no stage or body {kind.of!r}{hint}; `of` is {known}"
        raise file.error(sentence, (*place, "of"))
    try:
        check_kinds(robot, (kind,))
    except DataError as error:
        raise file.error(error.args[0], (*place, "kind")) from None
    allowed = ["kind", *KIND_SETTINGS] if place else SETTINGS
    refuse_unknown_keys(file, list(node), [*allowed, *list_kind_settings(type(kind))], place)
    kind, of_mpe, shared = read_shared_errors(file, node, kind, place)
    stated = of_mpe | read_noise(file, node, kind, place)
    noise = {name: sd for name, (sd, _) in stated.items()}
    sizes = {name: size for name, (_, size) in stated.items()}
    source = node.get("noise_source", "stated")
    if source not in (ASSUMED, "stated"):
        sentence = f"noise_source is {source!r}. Write {ASSUMED} if the noise is unknown"
        raise file.error(f"{sentence}, or stated", (*place, "noise_source"))
    instrument = read_instrument(file, node, place)
    if instrument is None and place:
        instrument = read_instrument(file, file.content, ())
    assumed = bool(source == ASSUMED)
    return KindRows(kind, noise, rows, place, assumed, shared, instrument, sizes)


def _select_by_settings(table: Table, kinds: tuple[KindRows, ...]) -> tuple[KindRows, ...]:
    """Return kinds with those rows whose cells repeat the kind's settings, such as its camera;
    FileError for a row that belongs to no kind, or to two.
    """
    selected, count, offered = [], np.zeros(len(table), int), np.zeros(len(table), bool)
    for entry in kinds:
        names = [name for name in entry.kind.row_settings if name in table.units]
        rows = entry.rows
        for name in names:
            cells = np.array(table.text(name))
            offered[rows[cells[rows] != ""]] = True
            rows = rows[cells[rows] == getattr(entry.kind, name)]
        if names:
            count[rows] += 1
        selected.append(replace(entry, rows=rows))
    for row in np.flatnonzero((offered & (count == 0)) | (count > 1)).tolist():
        cells = ", ".join(f"{n} {table.text(n)[row]!r}" for n in ROW_SETTINGS if n in table.units)
        which = "no kind has" if not count[row] else "several kinds have"
        act = "Correct the cell, or the settings of the kinds"
        raise table.row_error(row, f"{which} {cells}. {act}")
    return tuple(selected)


def _select_rows(table: Table, entry: KindRows, members: Sequence[tuple[int, ...]]) -> KindRows:
    """Return only the rows that measure: those of two poses, for a kind that compares poses."""
    links = 0 if entry.kind.is_of_base else entry.kind.poses_per_row
    if links > 1 and "kind" not in table.units:
        entry = replace(entry, rows=entry.rows[[len(members[row]) > 1 for row in entry.rows]])
    for row in entry.rows:
        if (count := len(members[row])) != links:
            sentence = (
                f"this row names {count} poses, but the kind {entry.kind.name!r} needs {links}"
            )
            raise table.row_error(int(row), f"{sentence}. Correct the column 'pose'")
    return entry


def _read_values(
    table: Table, robot: Mechanism, entry: KindRows
) -> tuple[FloatArray, FloatArray, tuple[NoisePart, ...]]:
    """Return measured values (r, c), the covariance (r, m, m) of residuals [SI] and its parts."""
    kind, rows = entry.kind, entry.rows
    known = list_columns(robot, [kind])
    names = [name_measured(column.name, robot) for column in kind.columns]
    require_columns(table, names, f"which the kind {kind.name!r} measures")
    measured = np.zeros((len(rows), len(names)))
    for i, name in enumerate(names):
        measured[:, i] = known[name].parse(table)[rows]
    for i, doubt in kind.find_invalid_rows(measured):
        raise table.row_error(int(rows[i]), f"this row {doubt}")
    absent = np.zeros((len(rows), len(kind.noise_columns)), bool)
    if kind.noise_columns == kind.columns:  # then a value that was not measured needs no sigma
        absent = np.isnan(measured)
    sigma = np.zeros(absent.shape)
    for i in range(absent.shape[1]):
        sigma[:, i] = _read_sigma(table, robot, entry, i, absent[:, i])
    N = drop_repeats(kind.linearize_noise(measured))
    if np.all(sigma == sigma[:1]):  # rows with equal noise share one matrix
        sigma = sigma[:1]
    covariance = sigma[:, :, None] * np.eye(sigma.shape[1]) * sigma[:, None, :]
    for i, a in enumerate(kind.noise_columns):
        for j, b in enumerate(kind.noise_columns):
            name = name_covariance(a.name, b.name, robot)
            if i != j and name in table.units:
                covariance = np.array(np.broadcast_to(covariance, (len(rows), *N.shape[1:])))
                covariance[:, i, j] = covariance[:, j, i] = known[name].parse(table)[rows]
    covariance = N @ covariance @ np.swapaxes(N, -1, -2)
    covariance = np.broadcast_to(covariance, (len(rows), *N.shape[1:]))
    of_columns = {entry.sizes.get(column.name) for column in kind.noise_columns}
    is_alike = len(of_columns) == 1 and all(SIGMA + name not in table.units for name in names)
    parts = [NoisePart("", covariance, of_columns.pop() if is_alike else None)]
    if sight := [name for name in kind.sight_noise if name in entry.noise]:
        parts = parts if covariance.any() else []
        with name_files(table.path):
            spread = kind.spread_sight_noise(measured)
        parts += [NoisePart(n, entry.noise[n] ** 2 * spread[n], entry.sizes[n]) for n in sight]
        covariance = np.sum([part.covariance for part in parts], axis=0)
    return measured, covariance, tuple(parts)


def _read_names(table: Table, name: str, rows: IntArray) -> NDArray[np.str_]:
    """Return the sessions or groups (r,) of rows: of their cells, else of the setting, else ''."""
    stated = table.settings.content.get(name, "")
    if isinstance(stated, dict | list):
        sentence = f"{name!r} names the {name} of all rows. Write a name or a number"
        raise table.settings.error(sentence, (name,))
    usual = str(stated if stated is not None else "").strip()
    if name not in table.units:
        return np.full(len(rows), unicodedata.normalize("NFC", usual))
    cells = [unicodedata.normalize("NFC", cell or usual) for cell in table.text(name)]
    return np.array(cells, dtype=np.str_)[rows]


def _read_sigma(
    table: Table, robot: Mechanism, entry: KindRows, place: int, absent: BoolArray
) -> FloatArray:
    """Return the standard deviations (r,) [SI] of one noise column, from its column or settings.

    An empty cell of a value that is `absent` (r,) gets the sigma of another row, without effect.
    """
    column = entry.kind.noise_columns[place]
    name = SIGMA + name_measured(column.name, robot)
    if name not in table.units:
        if column.name not in entry.noise and entry.kind.sight_noise.keys() & entry.noise.keys():
            return np.zeros(len(entry.rows))
        if column.name not in entry.noise:
            raise table.settings.error(
                report_finding(
                    "files.noise-missing",
                    column=column.name,
                    example=f"noise: {{{column.name}: {EXAMPLES[column.dimension]}}}",
                    sigma=name,
                ),
                (*entry.location, "noise"),
            )
        return np.full(len(entry.rows), entry.noise[column.name])
    cells = table.numbers(name, column.dimension)[entry.rows]
    sigma = np.where(np.isnan(cells), entry.noise.get(column.name, np.nan), cells)
    if (positive := sigma[sigma > 0]).size:
        sigma = np.where(absent & np.isnan(sigma), positive[0], sigma)
    for i in np.flatnonzero(~(sigma >= SMALLEST_SD)):
        size = "too small" if sigma[i] > 0.0 else "not positive"
        sentence = f"column {name!r} is {size}. Write a standard deviation"
        raise table.row_error(int(entry.rows[i]), sentence)
    return sigma
