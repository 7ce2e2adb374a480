# SPDX-License-Identifier: Apache-2.0
"""A kind of measurement in the settings of a file: its name, its own settings and its noise.

    kind: pose                                the name of a kind of `loopcal.measure.KINDS`
    orientation: euler-xyz                    the fields of its dataclass
    T_base_frame: {x: 12 mm, yaw: 90 deg}     poses: x y z, and R = Rz(yaw) Ry(pitch) Rx(roll)
    places: [[100 mm, 0 mm, 20 mm]]           lengths with units; directions as plain numbers
    noise: {x: 1 um, "*": 5 urad}             standard deviations of the noise columns, by name or
                                              pattern; the last one that matches counts
    noise_source: assumed                     nobody stated this noise

The record of a kind's settings is made from its dataclass, so that a new kind needs nothing here:
arrays called T_.. are poses, those in DIRECTIONS are directions, other arrays and numbers are
lengths, the rest is text.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, suggest_names
from loopcal.io.core.csv_table import format_scaled
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import (
    Location,
    YamlFile,
    format_flow_mapping,
    quote_scalar,
    refuse_unknown_keys,
)
from loopcal.io.data.columns import find_column_fault
from loopcal.mechanism.families.records import PoseRecord
from loopcal.plain_text import quote
from loopcal.typing import FloatArray
from loopcal.units import (
    DISPLAY_UNITS,
    EXAMPLES,
    SI_SYMBOLS,
    Angle,
    Dimension,
    Length,
    Ratio,
    find_sd_fault,
)

if TYPE_CHECKING:
    from loopcal.measure.kinds.kind import Kind
    from loopcal.measure.nuisance import StatedValue
    from loopcal.measure.observations import InstrumentRecord, Observations
    from loopcal.parameters import Parameter

DIRECTIONS = ("along", "axis", "normal", "up")
NOISE_UNITS = {
    Dimension.LENGTH: ("um", 1e-6),
    Dimension.ANGLE: ("urad", 1e-6),
    Dimension.RATIO: ("1", 1.0),
}
ASSUMED = "assumed"
"""Word for noise that a program assumed."""

MANY_SIGMAS = 3
"""Number of columns above which an equal noise is written once."""

LENGTHS = Annotated[list[Any], Dimension.LENGTH]
NUMBERS = Annotated[list[Any], Dimension.RATIO]


def read_kind(file: YamlFile, node: Mapping[str, Any], location: Location) -> Kind:
    """Return the kind that settings (`node` at a location of the file) describe; keys of others
    are ignored.

    FileError : no or an unknown kind, a setting that does not fit it, or a name of a target that
    no column can have.
    """
    from loopcal.measure.kinds import KINDS

    name, known = node.get("kind"), ", ".join(KINDS)
    if name is None:
        example = "write '# kind: pose' at the top, or 'kind: pose' in a .yaml file of this name"
        raise file.error(f"no kind of measurement is stated; {example} (kinds: {known})", location)
    if not isinstance(name, str) or name not in KINDS:
        sentence = f"{quote(name)} is not a kind of measurement{suggest_names(str(name), KINDS)}"
        raise file.error(f"{sentence}; allowed: {known}", (*location, "kind"))
    kind = KINDS[name]
    settings = {key: node[key] for key in list_kind_settings(kind) if key in node}
    values = vars(read_record(file, settings, _make_record(kind), None, location))
    for key, value in values.items():
        if isinstance(value, list) and not _is_array(value):
            sentence = f"{key!r} must be a list of numbers, or of lists of equal length; correct it"
            raise file.error(sentence, (*location, key))
    given, types = {}, list_kind_settings(kind)
    for key in settings:
        value = values[key]
        is_single = isinstance(value, str) and "tuple" in str(types[key])
        given[key] = value.matrix if isinstance(value, PoseRecord) else value
        given[key] = (value,) if is_single else given[key]
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
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(typing.cast(Any, kind)) if f.init}


def read_noise(
    file: YamlFile, node: Mapping[str, Any], kind: Kind, location: Location
) -> dict[str, float]:
    """Return noise column -> standard deviation [SI], of the columns for which one is stated;
    FileError for an unknown column or a bad number.
    """
    stated, place = node.get("noise", {}), (*location, "noise")
    dimensions = {column.name: column.dimension for column in kind.noise_columns}
    if not isinstance(stated, dict):
        example = ", ".join(f"{name}: {EXAMPLES[d]}" for name, d in dimensions.items())
        sentence = "'noise' must state a standard deviation for each column"
        raise file.error(f"{sentence}; write 'noise: {{{example}}}'", place)
    noise: dict[str, float] = {}
    for name, text in stated.items():
        matching = [c for c in dimensions if c == name or fnmatchcase(c, name)]
        matching = [name] if name in dimensions else matching
        if not matching:
            refuse_unknown_keys(file, [name], list(dimensions), place)
        for column in matching:
            noise[column] = file.quantity(text, dimensions[column], (*place, name))
            if fault := find_sd_fault(noise[column]):
                raise file.error(f"the noise of {name!r} is {text}; {fault}", (*place, name))
    return noise


def read_noise_source(file: YamlFile, node: Mapping[str, Any], location: Location) -> bool:
    """Return whether settings say that the noise is assumed; FileError for other words."""
    source = node.get("noise_source", "stated")
    if source not in (ASSUMED, "stated"):
        sentence = f"noise_source is {source!r}; write {ASSUMED} where nobody stated the noise"
        raise file.error(f"{sentence}, or stated", (*location, "noise_source"))
    return bool(source == ASSUMED)


def format_kind(
    kind: Kind, noise: Mapping[str, float], tool: FloatArray, is_noise_assumed: bool = False
) -> dict[str, str]:
    """Return key -> text of the settings of a kind.

    Keyword-only settings are left out where they are the default, or the robot's `tool`.
    """
    texts = {"kind": kind.name}
    for field in dataclasses.fields(typing.cast(Any, kind)):
        if not field.init or (value := getattr(kind, field.name)) is None:
            continue
        usual = field.default
        if field.name == "T_platform_tool":
            usual = tool
        elif field.default_factory is not dataclasses.MISSING:
            usual = field.default_factory()
        is_usual = usual is not dataclasses.MISSING and bool(np.array_equal(value, usual))
        if not is_usual or (not field.kw_only and isinstance(value, str | tuple)):
            texts[field.name] = _format_setting(field.name, value)
    if noise:
        units = {column.name: NOISE_UNITS[column.dimension] for column in kind.noise_columns}
        # nine digits: more would be rounding
        sigmas = {name: f"{s / units[name][1]:.9g} {units[name][0]}" for name, s in noise.items()}
        if len(sigmas) > MANY_SIGMAS and len(set(sigmas.values())) == 1:
            sigmas = {"*": next(iter(sigmas.values()))}
        texts["noise"] = format_flow_mapping(sigmas)
    return {**texts, "noise_source": ASSUMED} if is_noise_assumed else texts


def format_quantity(value: float, dimension: Dimension) -> str:
    """Return a number with its unit, in SI where only that reads back as the same double."""
    shown = DISPLAY_UNITS[dimension]
    text = format_scaled(value, shown.factor_to_si)
    if float(text) * shown.factor_to_si == value:
        return f"{text} {shown.symbol}"
    return f"{value!r} {SI_SYMBOLS[dimension]}"


@cache
def _make_record(kind: type[Kind]) -> type:
    """Return a record of the settings of a kind (cached); all may be left out."""
    fields: list[tuple[str, Any, None]] = []
    for name, annotation in list_kind_settings(kind).items():
        text, in_file = str(annotation), cast(Any, str)
        if "ndarray" in text:
            in_file = NUMBERS if name in DIRECTIONS else LENGTHS
            in_file = PoseRecord if name.startswith("T_") else in_file
        elif annotation is float:
            in_file = Annotated[float, Dimension.LENGTH]
        elif "tuple" in text:
            in_file = tuple[str, ...] | str
        fields.append((name, in_file, None))
    return make_dataclass(f"{kind.__name__}Settings", fields, frozen=True)


def _is_array(value: list[Any]) -> bool:
    """Return whether a list holds numbers only, or lists of numbers of one length."""
    if not any(isinstance(item, list) for item in value):
        return all(isinstance(item, float | int) and not isinstance(item, bool) for item in value)
    lengths = {len(item) if isinstance(item, list) else -1 for item in value}
    return len(lengths) == 1 and all(_is_array(item) for item in value)


def _format_setting(key: str, value: Any) -> str:
    """Return a setting as text that `read_kind` reads."""
    if key.startswith("T_"):
        angles = geometry.matrix_to_euler(value[:3, :3], "xyz")
        numbers = [float(v) + 0.0 for v in (*value[:3, 3], *angles)]
        names = ("x", "y", "z", "roll", "pitch", "yaw")
        units = [Dimension.LENGTH] * 3 + [Dimension.ANGLE] * 3
        texts = map(format_quantity, numbers, units)
        return format_flow_mapping(dict(zip(names, texts, strict=True)))
    if isinstance(value, str):
        return quote_scalar(value)
    if isinstance(value, float):
        return repr(value) if key in DIRECTIONS else format_quantity(value, Dimension.LENGTH)
    items = value if isinstance(value, list | tuple) else value.tolist()
    if not isinstance(items, list | tuple):
        return _format_setting(key, items)
    return f"[{', '.join(_format_setting(key, item) for item in items)}]"


# Prior knowledge of setup parameters (frames, targets, surfaces, offsets).

KEY, FIXED = "unknowns", "fixed"
EXAMPLE = (
    f"write '{FIXED}', {{sd: 1 mm}}, {{start: 12 mm, sd: 1 mm}} or {{start: 12 mm, {FIXED}: true}}"
)


_NUMBERS: tuple[Any, ...] = (Length, Angle, Ratio)
RECORDS = {
    dimension: make_dataclass(
        "KnownParameter",
        [("start", number | None, None), ("sd", number | None, None), ("fixed", bool, False)],
        frozen=True,
    )
    for dimension, number in zip(
        (Dimension.LENGTH, Dimension.ANGLE, Dimension.RATIO), _NUMBERS, strict=True
    )
}
"""Dimension -> record of the knowledge of a parameter."""


def read_stated_values(
    files: Sequence[tuple[YamlFile, Sequence[Observations], Mapping[str, float]]],
    labels: tuple[str, ...],
) -> tuple[StatedValue, ...]:
    """Return the knowledge that files state of the setup parameters of their own rows.

    `files` : settings of each file, its rows, and the standard deviations of their biases and
    drifts by name without the session, 0 where there is none. `labels` : names of the poses.

    FileError : a name that is not a parameter of the file, a bad statement, contradicting files.
    DataError : two kinds of a file state one parameter differently.
    """
    from loopcal.measure.nuisance import StatedValue, collect_nuisance_parameters

    known: dict[str, tuple[StatedValue, YamlFile, Location]] = {}
    for file, observations, shared in files:
        stated = file.content.get(KEY, {})
        if not isinstance(stated, dict):
            sentence = f"{KEY!r} must name parameters, as {KEY}: {{tracker.x: {{sd: 1 mm}}}}"
            raise file.error(sentence, (KEY,))
        of_file: dict[str, tuple[StatedValue, YamlFile, Location]] = {}
        entries: tuple[Parameter, ...] = ()
        if stated or shared:
            entries = collect_nuisance_parameters(observations, labels).table.entries
        for name, sd in shared.items():
            of_sessions = [e.name for e in entries if e.name == name or e.name.endswith(f".{name}")]
            of_file |= {n: (StatedValue(n, sd), file, (KEY,)) for n in of_sessions}
        for pattern, node in stated.items():
            place = (KEY, pattern)
            matching = _match(file, entries, pattern)
            of_file |= {k.name: (k, file, place) for k in _read_one(file, node, matching, place)}
        for name, (value, _, place) in of_file.items():
            if name in known and known[name][0] != value:
                _, other, other_place = known[name]
                line = f"{other.path}:{other.line(other_place)}"
                sentence = f"parameter {name!r} is stated differently in {line}; state it once"
                raise file.error(sentence, place)
        known = of_file | known
    return tuple(value for value, _, _ in known.values())


def format_stated_values(known: Sequence[StatedValue], entries: Sequence[Parameter]) -> str:
    """Return the setting `unknowns` as text, for the parameters among `entries`."""
    dimensions = {entry.name: entry.dimension for entry in entries}
    texts: dict[str, str] = {}
    for value in known:
        if value.name not in dimensions:
            continue
        dimension = dimensions[value.name]
        text = FIXED
        if value.sd:
            text = f"{{sd: {format_quantity(value.sd, dimension)}}}"
        if value.nominal is not None:
            start = f"start: {format_quantity(value.nominal, dimension)}"
            text = f"{{{start}, {text[1:]}" if value.sd else f"{{{start}, {FIXED}: true}}"
        texts[value.name] = text
    return format_flow_mapping(texts) if texts else ""


def _match(file: YamlFile, entries: Sequence[Parameter], stated: str) -> list[Parameter]:
    """Return the parameters that a name, also an earlier one of an offset, or a pattern denotes."""
    from loopcal.measure.kinds.kind import update_setup_name

    pattern = update_setup_name(stated)
    exact = [entry for entry in entries if entry.name == pattern]
    whole = exact or [entry for entry in entries if fnmatchcase(entry.name, pattern)]
    matching = whole or [entry for entry in entries if fnmatchcase(entry.name, f"*.{pattern}")]
    if pattern in ("distance.offset", "separation.offset"):  # once the name for all fixed points
        matching = matching or [entry for entry in entries if entry.name.endswith(".offset")]
    if not matching:
        names = [entry.name for entry in entries]
        allowed = ", ".join(names[:12]) or "none; state some, as 'unknown: [frame]' of the kind"
        sentence = f"this file has no setup parameter {pattern!r}{suggest_names(pattern, names)}"
        raise file.error(f"{sentence}; it has {allowed}", (KEY, stated))
    return matching


def _read_one(
    file: YamlFile, node: Any, matching: Sequence[Parameter], place: Location
) -> list[StatedValue]:
    """Return the knowledge that one line states of each parameter that it denotes."""
    from loopcal.measure.nuisance import StatedValue

    if node == FIXED:
        return [StatedValue(entry.name) for entry in matching]
    if not isinstance(node, dict):
        raise file.error(f"{node!r} does not state knowledge of a parameter; {EXAMPLE}", place)
    dimensions = {entry.dimension for entry in matching}
    if len(dimensions) > 1 and ("start" in node or "sd" in node):
        sentence = "this pattern matches lengths and angles; state them in separate lines"
        raise file.error(sentence, place)
    stated = read_record(file, node, RECORDS[matching[0].dimension], None, place)
    if stated.fixed == ("sd" in node):
        raise file.error(f"state either 'sd' or '{FIXED}: true'; {EXAMPLE}", place)
    if not stated.fixed and (fault := find_sd_fault(stated.sd or 0.0)):
        sentence = f"the standard deviation is {node['sd']}; {fault}, or {FIXED}"
        raise file.error(sentence, (*place, "sd"))
    sd = 0.0 if stated.fixed else stated.sd or 0.0
    return [StatedValue(entry.name, sd, stated.start) for entry in matching]


def read_instrument(
    file: YamlFile, node: Mapping[str, Any], location: Location
) -> InstrumentRecord | None:
    """Return the instrument that settings state, None where they state none; FileError for other
    keys or values.
    """
    from loopcal.measure.observations import InstrumentRecord

    stated, place = node.get("instrument"), (*location, "instrument")
    if stated is None:
        return None
    if isinstance(stated, str):
        return InstrumentRecord(name=stated)
    if not isinstance(stated, dict) or not stated:
        sentence = "'instrument' is neither a name nor facts of an instrument; write its name, or"
        example = 'instrument: {name: AT960, serial_number: "750123", certificate: D-K-15123}'
        raise file.error(f"{sentence} '{example}'", place)
    try:
        return read_record(file, stated, InstrumentRecord, None, place)
    except DataError as error:
        raise file.error(str(error), place) from None


def format_instrument(record: InstrumentRecord) -> str:
    """Return the setting of an instrument as YAML text in one line."""
    stated = record.to_dict()
    if list(stated) == ["name"]:
        return quote_scalar(record.name)
    return format_flow_mapping({name: quote_scalar(value) for name, value in stated.items()})


# Errors that the rows of a session share, in the settings of a kind.

UNKNOWN = "unknown"
SETTINGS: Mapping[str, str] = {
    "session_bias": "`unknown`, or component -> standard deviation or `unknown`: an offset that "
    "all rows of a session share",
    "session_drift": "the same for a change from the first to the last row of a session, linear "
    "in time or, without the column `time`, in the order of the rows",
}
ITEMS: Mapping[str, str] = {"session_bias": "bias", "session_drift": "drift"}


def read_shared_errors(
    file: YamlFile, node: Mapping[str, Any], kind: Kind, location: Location
) -> tuple[Kind, dict[str, float]]:
    """Return a kind with its shared errors as unknowns, and parameter -> standard deviation [SI]
    of those with a prior; 0 where a component has no such error. FileError : an unknown component,
    or no number.
    """
    from loopcal.measure.kinds.kind import list_components, name_shared_error

    priors: dict[str, float] = {}
    for key, item in ITEMS.items():
        if key not in node:
            continue
        place, stated = (*location, key), node[key]
        components = dict(list_components(kind))
        if stated != UNKNOWN and not (isinstance(stated, dict) and stated):
            example = ", ".join(f"{name}: {EXAMPLES[d]}" for name, d in components)
            sentence = f"{key!r} is {stated!r}; write '{key}: {UNKNOWN}', or standard deviations"
            raise file.error(f"{sentence}, as '{key}: {{{example}}}'", place)
        kind = replace(cast(Any, kind), unknown=tuple(dict.fromkeys((*kind.unknown, item))))
        if stated == UNKNOWN:
            continue
        priors |= {name_shared_error(kind, item, name): 0.0 for name, _ in components}
        for pattern, text in stated.items():
            matching = [(n, d) for n, d in components if fnmatchcase(n, str(pattern))]
            if not matching:
                refuse_unknown_keys(file, [pattern], [name for name, _ in components], place)
            for name, dimension in matching:
                parameter = name_shared_error(kind, item, name)
                priors.pop(parameter, None)
                if text == UNKNOWN:
                    continue
                priors[parameter] = file.quantity(text, dimension, (*place, pattern))
                if fault := find_sd_fault(priors[parameter]):
                    sentence = f"the standard deviation is {text}; {fault}, or {UNKNOWN}"
                    raise file.error(sentence, (*place, pattern))
    return kind, priors
