# SPDX-License-Identifier: Apache-2.0
r"""Profiles: how to read the text that an instrument's software exports.

delimiter: semicolon                    comma, semicolon, tab or spaces
columns:
  pose: {from: Name, match: 'P(?P<pose>\d+)_(?P<target>\w+)'}
  x: {from: X, unit: mm}                by the name in the export's header, or its place from 1
settings: {kind: position, ...}         settings of the measurement file
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from loopcal.errors import UnitError, suggest_names
from loopcal.io.core.numbers import parse_finite
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
    is_context,
)
from loopcal.io.data.kind_rows import SETTINGS
from loopcal.io.data.kind_settings import list_kind_settings, read_kind
from loopcal.io.robot.robot_file import check_format
from loopcal.units import Dimension, find_unit, list_symbols

if TYPE_CHECKING:
    from loopcal.measure import Column, Kind

FORMAT = 1
DELIMITERS: Mapping[str, str | None] = {"comma": ",", "semicolon": ";", "tab": "\t", "spaces": None}
DECIMALS: Mapping[str, str] = {"point": ".", "comma": ","}
TEXTS = ("pose", "block", "session", "group")
"""Columns of text that an export may have."""

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

Place = int | str


@dataclass(frozen=True)
class ColumnSource:
    """The source of one column of the measurement file.

    Parameters
    ----------
    from_ : name in the export's header, or place counted from 1; several are joined by blanks.
    unit : unit of a number.
    match : of `pose`: pattern that finds (?P<pose>..), and (?P<target>..) where each target has a
        line of its own.
    format : of `time`: format of Python's strptime, such as '%d.%m.%Y %H:%M:%S'.
    """

    from_: Place | tuple[Place, ...]
    unit: str | int | None = None
    match: str | None = None
    format: str | None = None

    @property
    def places(self) -> tuple[Place, ...]:
        """Names in the export's header, or places counted from 1."""
        return self.from_ if isinstance(self.from_, tuple) else (self.from_,)

    @property
    def symbol(self) -> str | None:
        """Unit of a number; None for text."""
        return None if self.unit is None else str(self.unit)

    @cached_property
    def pattern(self) -> re.Pattern[str] | None:
        """The compiled `match`."""
        return None if self.match is None else re.compile(self.match)


@dataclass(frozen=True)
class ProfileRecord:
    """The keys of a profile.

    Parameters
    ----------
    delimiter : separator of columns; `spaces` is any number of blanks and tabs.
    columns : column of the measurement file -> its source.
    settings : settings of the measurement file, see docs/files.md; `poses` names the file with the
        readings of the poses.
    format : version of the format, 1.
    decimal : the decimal mark.
    comment : start of lines without data.
    skip : number of lines at the top without data.
    ignore : pattern of further lines without data, such as totals.
    encoding : of the text; UTF-8 with or without byte order mark by default.
    missing : cells that mean not measured, besides empty ones; numbers count by value, so that -999
        includes -999.000.
    readings : actuator -> source of its reading, where the export contains readings.
    matrix : nine columns of a rotation matrix, row by row, in place of the columns of an
        orientation.
    """

    delimiter: Literal["comma", "semicolon", "tab", "spaces"]
    columns: Mapping[str, ColumnSource]
    settings: Mapping[str, Any]
    format: int = 1
    decimal: Literal["point", "comma"] = "point"
    comment: str | None = None
    skip: int = 0
    ignore: str | None = None
    encoding: str = "utf-8"
    missing: str | int | float | tuple[str | int | float, ...] = ()
    readings: Mapping[str, ColumnSource] = field(default_factory=dict)
    matrix: tuple[Place, ...] = ()


@dataclass(frozen=True)
class Profile:
    """A checked profile; `kind` is the kind that its settings describe."""

    file: YamlFile
    record: ProfileRecord
    kind: Kind

    @property
    def delimiter(self) -> str | None:
        """The separator; None for blanks and tabs."""
        return DELIMITERS[self.record.delimiter]

    @property
    def encoding(self) -> str:
        """Name of the codec; that of UTF-8 skips a byte order mark."""
        name = codecs.lookup(self.record.encoding).name
        return "utf-8-sig" if name == "utf-8" else name

    @cached_property
    def ignored(self) -> re.Pattern[str] | None:
        """The compiled `ignore`."""
        return None if self.record.ignore is None else re.compile(self.record.ignore)

    @cached_property
    def columns(self) -> Mapping[str, ColumnSource]:
        """Sources of all columns, readings included."""
        return {**self.record.columns, **self.record.readings}

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """Cells that mean not measured."""
        cells = self.record.missing
        return tuple(str(c) for c in (cells if isinstance(cells, tuple) else (cells,)))

    @cached_property
    def missing_numbers(self) -> tuple[float, ...]:
        """Numbers that mean not measured."""
        numbers = (self.parse(text) for text in self.missing)
        return tuple(number for number in numbers if number is not None)

    @property
    def targets(self) -> tuple[str, ...]:
        """Targets of the kind; empty for a kind without targets."""
        return getattr(self.kind, "targets", ())

    def with_point(self, text: str) -> str:
        """Return a number with a decimal point; a misplaced point becomes an invalid number."""
        mark = DECIMALS[self.record.decimal]
        return text if mark == "." else text.replace(".", "?").replace(mark, ".")

    def parse(self, text: str) -> float | None:
        """Return the finite number of a cell; None for other text."""
        return parse_finite(self.with_point(text))

    def name_measured(self, name: str) -> str:
        """Return the profile's name of a measured column: `measured.NAME` where it is stated so."""
        return MEASURED + name if MEASURED + name in self.columns else name


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
    place = ("settings",)
    kind = read_kind(file, record.settings, place)
    allowed = [key for key in SETTINGS if key != "kinds"]
    settings = list_kind_settings(type(kind))
    refuse_unknown_keys(file, list(record.settings), [*allowed, *settings], place)
    if DELIMITERS[record.delimiter] == DECIMALS[record.decimal]:
        sentence = "a comma cannot be both the decimal mark and the separator; correct one"
        raise file.error(sentence, ("decimal",))
    if record.skip < 0:
        raise file.error(f"'skip' is {record.skip}; write a number of lines, 0 or more", ("skip",))
    if record.comment == "":
        raise file.error("'comment' is empty; write the start of a comment line", ("comment",))
    if record.ignore is not None:
        _check_pattern(file, record.ignore, ("ignore",))
    _check_encoding(file, record.encoding)
    profile = Profile(file, record, kind)
    _check_matrix(profile)
    _check_columns(profile)
    return profile


def _check_columns(profile: Profile) -> None:
    """Raise FileError for columns that a measurement file of this kind cannot have, or lacks."""
    file, kind, record = profile.file, profile.kind, profile.record
    several = len(profile.targets) > 1
    measured = list(
        dict.fromkeys(strip_target(c.name) if several else c.name for c in kind.columns)
    )
    measured = measured[-3:] if record.matrix else measured
    dimensions = _list_dimensions(kind, several)
    known = [*TEXTS, TIME, "temperature", *measured, *(MEASURED + name for name in measured)]
    noise = [n for n in dimensions if n.startswith((SIGMA, COVARIANCE))]
    noise += [SIGMA + name for name in record.readings]
    for name, source in record.columns.items():
        is_noise = name.startswith((SIGMA, COVARIANCE))
        allowed, plain = (noise, name.replace(MEASURED, "")) if is_noise else (known, name)
        if plain not in allowed and not is_context(name) and not name.startswith(NOTE):
            hint = suggest_names(name, allowed) or f"; allowed: {', '.join(allowed)}"
            sentence = f"{name!r} is not a column of measurement files of the kind {kind.name!r}"
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
            sentence = f"'columns' states {count} sources of {name!r}, but the kind {kind.name!r}"
            raise file.error(f"{sentence} needs one; correct it", ("columns",))
    pattern = record.columns["pose"].pattern if "pose" in record.columns else None
    if several and (pattern is None or "target" not in pattern.groupindex):
        sentence = "the kind has several targets, each with a line of its own"
        act = "add (?P<target>..) to 'match' of 'pose'"
        raise file.error(f"{sentence}; {act}", ("columns", "pose"))


def strip_target(column: str) -> str:
    """Return the name of a column of several targets without its target: `x` for `a.x`."""
    return column.partition(".")[2]


def _list_dimensions(kind: Kind, several: bool) -> dict[str, tuple[Dimension, ...]]:
    """Return the dimensions of the columns of a kind, of sigma and (two) of covariances."""

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
    for key, value, owner in (("match", source.match, "pose"), ("format", source.format, TIME)):
        if value is not None and (name != owner or not is_text):
            sentence = f"{key!r} belongs to {owner!r}, not to {name!r}; remove it"
            raise file.error(sentence, (*place, key))
    if source.match is not None:
        _check_pattern(file, source.match, (*place, "match"))
        if source.pattern is None or "pose" not in source.pattern.groupindex:
            sentence = "this pattern finds no pose; put its part of the name in (?P<pose>..)"
            raise file.error(sentence, (*place, "match"))


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
    places, kind = profile.record.matrix, profile.kind
    if "matrix" not in profile.file.content:
        return
    _check_places(profile.file, places, ("matrix",))
    is_quaternion = getattr(kind, "orientation", None) == "quaternion" and kind.name == "pose"
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


def _check_pattern(file: YamlFile, text: str, place: Location) -> None:
    """Raise FileError for text that is not a regular expression."""
    try:
        re.compile(text)
    except re.error as error:
        sentence = f"{text!r} is not a regular expression ({error}); correct it"
        raise file.error(sentence, place) from None


def _check_encoding(file: YamlFile, name: str) -> None:
    """Raise FileError for a name that is not a known encoding of text."""
    try:
        "".encode(codecs.lookup(name).name)  # refuses codecs that are not text, such as hex
    except (LookupError, ValueError):
        sentence = f"{name!r} is not a known encoding; write utf-8, utf-16, latin-1 or cp1252"
        raise file.error(sentence, ("encoding",)) from None
