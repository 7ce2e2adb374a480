# SPDX-License-Identifier: Apache-2.0
"""Read profiles of exports, and refuse what no measurement file can have, at its line."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import UnitError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import Location, YamlFile, read_yaml, refuse_unknown_keys
from loopcal.io.data.columns import (
    COVARIANCE,
    MEASURED,
    NOTE,
    SIGMA,
    TEMPERATURE_UNITS,
    TIME,
    TIME_UNITS,
    USE_COLUMN,
    is_context,
)
from loopcal.io.data.kind_rows import POSE_SETTINGS, SETTINGS
from loopcal.io.data.kind_settings import list_kind_settings, read_kind
from loopcal.io.exports.patterns import refuse_pattern
from loopcal.io.exports.profile import (
    DECIMALS,
    DELIMITERS,
    ColumnSource,
    Place,
    Profile,
    ProfileRecord,
    strip_target,
)
from loopcal.io.robot.robot_file import check_format
from loopcal.plain_text import quote
from loopcal.units import Dimension, find_unit, list_symbols

if TYPE_CHECKING:
    from loopcal.measure import Column, Kind

FORMAT = 1
TEXTS = ("pose", USE_COLUMN.name, "block", "session", "group")
"""Columns of text that an export may have."""

SOME_TIME = datetime(2026, 5, 4, 10, 22, 31, tzinfo=UTC)
"""A time that a format must write and read."""

STATED = re.compile(r"[\[(]\s*(?P<unit>[^\[\]()]*?)\s*[\])]$")
"""The unit behind a name in a header, as in `X [mm]` or `X (mm)`."""

ALIASES: Mapping[str, str] = {
    "°": "deg",
    "°C": "degC",
    "°F": "degF",
    "µm": "um",
    "μm": "um",
    "inch": "in",
    '"': "in",
}
"""Units as instruments write them -> ours."""


def read_profile(path: str | Path) -> Profile:
    """Read a profile.

    Raises
    ------
    FileError
        A missing or unknown key, an unknown column, a bad unit, pattern or encoding; at its line.
    """
    file = read_yaml(path, "profile of an export")
    record = read_record(file, file.content, ProfileRecord, None)
    if "format" in file.content:
        check_format(file, FORMAT)
    kind = _read_kind(file, record)
    if DELIMITERS[record.delimiter] == DECIMALS[record.decimal]:
        sentence = "a comma cannot be both the decimal mark and the separator; correct one"
        raise file.error(sentence, ("decimal",))
    if record.skip < 0:
        raise file.error(f"'skip' is {record.skip}; write a number of lines, 0 or more", ("skip",))
    if record.comment == "":
        raise file.error("'comment' is empty; write the start of a comment line", ("comment",))
    if record.ignore is not None:
        refuse_pattern(file, record.ignore, ("ignore",))
    _check_encoding(file, record.encoding)
    profile = Profile(file, record, kind)
    _check_matrix(profile)
    check_columns(profile)
    return profile


def _read_kind(file: YamlFile, record: ProfileRecord) -> Kind | None:
    """Return the kind of the settings; None for a table that only holds readings of named poses."""
    place, keys = ("settings",), list(record.settings)
    if "kind" in record.settings or not record.readings:
        kind = read_kind(file, record.settings, place)
        allowed = [key for key in SETTINGS if key != "kinds"]
        refuse_unknown_keys(file, keys, [*allowed, *list_kind_settings(type(kind))], place)
        return kind
    refuse_unknown_keys(file, keys, POSE_SETTINGS, place)
    if "pose" not in record.columns:
        raise file.error(report_finding("files.readings-without-poses"), ("columns",))
    return None


def check_columns(profile: Profile) -> None:
    """Raise FileError for columns that a measurement file of this kind cannot have, or lacks."""
    file, record = profile.file, profile.record
    several = len(profile.targets) > 1
    measured = list(
        dict.fromkeys(strip_target(c.name) if several else c.name for c in profile.measured)
    )
    measured = measured[-3:] if record.matrix else measured
    dimensions = _list_dimensions(profile.kind, several)
    subject = (
        "a table of readings (no kind is stated)"
        if profile.kind is None
        else f"measurement files of the kind {profile.kind.name!r}"
    )
    known = [*TEXTS, TIME, "temperature", *measured, *(MEASURED + name for name in measured)]
    noise = [n for n in dimensions if n.startswith((SIGMA, COVARIANCE))]
    noise += [SIGMA + name for name in record.readings]
    for name, source in record.columns.items():
        is_noise = name.startswith((SIGMA, COVARIANCE))
        allowed, plain = (noise, name.replace(MEASURED, "")) if is_noise else (known, name)
        if plain not in allowed and not is_context(name) and not name.startswith(NOTE):
            hint = suggest_names(name, allowed) or f"; allowed: {', '.join(allowed)}"
            sentence = f"{name!r} is not a column of {subject}"
            raise file.error(f"{sentence}{hint}", ("columns", name))
        _check_source(file, name, source, ("columns", name), dimensions)
    for name, source in record.readings.items():
        if name in record.columns:
            act = f"name the measured one {MEASURED + name!r} under 'columns'"
            raise file.error(
                f"{name!r} is a reading and a measured column; {act}", ("readings", name)
            )
        _check_source(file, name, source, ("readings", name), {})
    for name in measured:
        count = sum(column in record.columns for column in (name, MEASURED + name))
        if count != 1:
            sentence = (
                f"'columns' states {count} sources of {name!r}, but one is needed in {subject}"
            )
            raise file.error(f"{sentence}; correct it", ("columns",))
    pattern = record.columns["pose"].pattern if "pose" in record.columns else None
    if several and (pattern is None or "target" not in pattern.groupindex):
        sentence = "the kind has several targets, each with a line of its own"
        act = "add (?P<target>..) to 'match' of 'pose'"
        raise file.error(f"{sentence}; {act}", ("columns", "pose"))


def _list_dimensions(kind: Kind | None, several: bool) -> dict[str, tuple[Dimension, ...]]:
    """Return the dimensions of the columns of a kind, of sigma and (two) of covariances."""
    if kind is None:
        return {}

    def list_plain(columns: Sequence[Column]) -> dict[str, Dimension]:
        return {strip_target(c.name) if several else c.name: c.dimension for c in columns}

    noise = list_plain(kind.noise_columns)
    dimensions: dict[str, tuple[Dimension, ...]] = {
        name: (d,) for name, d in list_plain(kind.columns).items()
    }
    dimensions |= {SIGMA + name: (d,) for name, d in noise.items()}
    pairs = ((a, b) for a in noise for b in noise if a != b)
    return dimensions | {f"{COVARIANCE}{a}.{b}": (noise[a], noise[b]) for a, b in pairs}


def _check_source(
    file: YamlFile,
    name: str,
    source: ColumnSource,
    place: Location,
    dimensions: Mapping[str, tuple[Dimension, ...]],
) -> None:
    """Raise FileError for a source without sense."""
    _check_places(file, source.places, (*place, "from"))
    has_unit = source.unit is not None
    is_text = name in TEXTS or name.startswith(NOTE) or (name == TIME and not has_unit)
    if is_text and has_unit:
        raise file.error(f"{name!r} is text and has no unit; remove 'unit'", place)
    if not is_text and not has_unit:
        raise file.error(f"{name!r} has no unit; add 'unit'", place)
    if len(source.places) > 1 and not is_text:
        raise file.error(f"{name!r} is a number and has one source; name one column", place)
    if source.symbol is not None:
        unit_place = (*place, "unit")
        wanted = dimensions.get(name.replace(MEASURED, ""), ())
        _check_unit(file, name, source.symbol, unit_place, wanted)
        _check_header_unit(file, " ".join(map(str, source.places)), source.symbol, unit_place)
    _check_scale(file, name, source, place)
    for key, value, owner in (("match", source.match, "pose"), ("format", source.format, TIME)):
        if value is not None and (name != owner or not is_text):
            sentence = f"{key!r} belongs to {owner!r}, not to {name!r}; remove it"
            raise file.error(sentence, (*place, key))
    if source.format is not None:
        _check_time_format(file, source.format, (*place, "format"))
    if source.match is not None:
        refuse_pattern(file, source.match, (*place, "match"))
        if source.pattern is None or "pose" not in source.pattern.groupindex:
            sentence = "this pattern finds no pose; put its part of the name in (?P<pose>..)"
            raise file.error(sentence, (*place, "match"))


def _check_time_format(file: YamlFile, text: str, place: Location) -> None:
    """Raise FileError for a format with which Python cannot read the times that it writes."""
    try:
        datetime.strptime(SOME_TIME.strftime(text), text)
    except (ValueError, re.error):  # strptime makes a regular expression of it
        sentence = (
            f"{quote(text)} is not a format of times; write each of its parts once, such as "
            "'%d.%m.%Y %H:%M:%S'"
        )
        raise file.error(sentence, place) from None


def _check_scale(file: YamlFile, name: str, source: ColumnSource, place: Location) -> None:
    """Raise FileError for a factor or a floor that is not positive, or not of a sigma."""
    for key, is_stated in (("factor", source.factor != 1.0), ("floor", source.floor is not None)):
        if is_stated and not name.startswith(SIGMA):
            raise file.error(
                report_finding("files.not-a-sigma", key=key, column=name), (*place, key)
            )
    if not (source.factor > 0.0 and math.isfinite(source.factor)):
        sentence = f"'factor' is {source.factor:g}; write a positive number, such as 0.5 for U(k=2)"
        raise file.error(sentence, (*place, "factor"))
    if source.floor is not None and source.symbol is not None:
        dimension = find_unit(source.symbol).dimension
        if not file.quantity(source.floor, dimension, (*place, "floor")) > 0.0:
            sentence = f"'floor' is {source.floor}; write a positive quantity, such as 1 um"
            raise file.error(sentence, (*place, "floor"))


def _check_unit(
    file: YamlFile, name: str, symbol: str, place: Location, wanted: tuple[Dimension, ...]
) -> None:
    """Raise FileError for a unit that the column cannot have; any unit where `wanted` is empty."""
    if is_context(name):
        known = TIME_UNITS if name == TIME else TEMPERATURE_UNITS
        if symbol not in known:
            sentence = f"{symbol!r} is not a unit of {name!r}; allowed: {', '.join(known)}"
            raise file.error(sentence, place)
        return
    factors = [part.strip() for part in symbol.split("*")]
    needed = wanted or (None,)
    if len(factors) != len(needed):
        example = "*".join("mm" for _ in needed)
        raise file.error(
            f"{symbol!r} is not a unit of {name!r}; write a unit such as {example}", place
        )
    for factor, dimension in zip(factors, needed, strict=True):
        try:
            find_unit(factor, dimension)
        except UnitError:
            allowed = list_symbols(dimension)
            hint = "" if factor in list_symbols() else suggest_names(factor, allowed)
            sentence = f"{factor!r} is not a unit of {name!r}{hint}; allowed: {', '.join(allowed)}"
            raise file.error(sentence, place) from None


def _check_header_unit(file: YamlFile, header: str, symbol: str, place: Location) -> None:
    """Raise FileError where the export's header states another unit behind the name."""
    match = STATED.search(header)
    behind = symbol if match is None else match["unit"]
    stated = ALIASES.get(behind, behind)
    if stated != symbol and stated in {*list_symbols(), *TIME_UNITS, *TEMPERATURE_UNITS} - {"1"}:
        sentence = f"the export's header is {header!r}, but the unit here is {symbol!r}"
        act = f"write the unit {stated}, or name the column by its place"
        raise file.error(f"{sentence}; {act}", place)


def _check_matrix(profile: Profile) -> None:
    """Raise FileError for a matrix that does not have nine columns, or a kind without it."""
    places, kind = profile.record.matrix_places, profile.kind
    if "matrix" not in profile.file.content:
        return
    _check_places(profile.file, places, ("matrix",))
    is_pose = kind is not None and kind.name == "pose"
    is_quaternion = is_pose and getattr(kind, "orientation", None) == "quaternion"
    if len(places) != 9 or not is_quaternion:
        sentence = "a matrix has nine columns, row by row, and needs 'kind: pose, orientation:"
        raise profile.file.error(f"{sentence} quaternion'; correct it", ("matrix",))


def _check_places(file: YamlFile, places: Sequence[Place], location: Location) -> None:
    """Raise FileError for places that are neither names nor numbers from 1."""
    for place in places:
        if place == "" or (isinstance(place, int) and place < 1):
            sentence = f"{place!r} is neither a name in the export's header nor a place from 1"
            raise file.error(f"{sentence}; correct it", location)
    if not places:
        sentence = "no column is named; write a name in the export's header or a place from 1"
        raise file.error(sentence, location)


def _check_encoding(file: YamlFile, name: str) -> None:
    """Raise FileError for a name that is not a known encoding of text."""
    try:
        "".encode(codecs.lookup(name).name)  # refuses codecs that are not text, such as hex
    except (LookupError, ValueError):
        sentence = f"{name!r} is not a known encoding; write utf-8, utf-16, latin-1 or cp1252"
        raise file.error(sentence, ("encoding",)) from None
