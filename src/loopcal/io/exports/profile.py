# SPDX-License-Identifier: Apache-2.0
"""Read profiles of exports, and refuse what no measurement file can have, at its line."""

from __future__ import annotations

import codecs
import math
import re
import time
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from importlib import resources
from itertools import permutations
from pathlib import Path
from typing import Any, Literal

import regex

from loopcal.errors import FileError, UnitError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.csv_table import parse_finite
from loopcal.io.core.limits import PATTERN_COUNTS, PATTERN_LENGTH, PATTERN_SECONDS
from loopcal.io.core.records import read_record
from loopcal.io.core.text_file import as_path
from loopcal.io.core.yaml_file import Location, YamlFile, read_yaml, refuse_unknown_keys
from loopcal.io.data.columns import (
    COVARIANCE,
    MEASURED,
    NOTE,
    POSE_COLUMNS,
    ROW_COLUMNS,
    SIGMA,
    TIME,
    ContextColumn,
    is_context,
)
from loopcal.io.data.kind_settings import POSE_SETTINGS, SETTINGS, list_kind_settings, read_kind
from loopcal.io.robot.robot_file import check_format
from loopcal.measure.kinds.kind import Kind
from loopcal.plain_text import quote
from loopcal.units import UNITS, Dimension, find_unit, format_scaled, list_symbols, parse_quantity

# Regular expressions of users, with a limit on their time.

SECONDS_PER_LINE = 1e-4  # time that each line of an export adds to the limit [s]

Pattern = regex.Pattern[str]

_COUNT = re.compile(r"\{\s*(\d*)\s*(?:,\s*(\d*)\s*)?\}")


class PatternClock:
    """The time that the patterns of one profile may still take for one export.

    file : the profile. seconds : at first; each match adds SECONDS_PER_LINE.
    """

    def __init__(self, file: YamlFile, seconds: float = PATTERN_SECONDS.most) -> None:
        self.file: YamlFile = file
        self.seconds: float = seconds
        self.remaining: float = seconds

    def match(
        self, find: Callable[..., regex.Match[str] | None], text: str, location: Location
    ) -> regex.Match[str] | None:
        """Return what `find`, such as `search` of the pattern at `location` of the profile, finds
        in a text; raise FileError.
        """
        start = time.process_time()
        self.remaining += SECONDS_PER_LINE
        try:
            return find(text, timeout=max(self.remaining, SECONDS_PER_LINE))
        except TimeoutError:
            finding = report_finding("files.pattern-too-slow", seconds=self.seconds)
            raise self.file.error(finding, location) from None
        finally:
            self.remaining -= time.process_time() - start


def refuse_pattern(file: YamlFile, text: str, location: Location) -> None:
    """Raise FileError for text that is no regular expression, or beyond a limit: of its length, or
    of the product of all counts in braces, the larger one of each pair.
    """
    shown = quote(text if len(text) <= 40 else f"{text[:40]}..")
    pairs = (match.groups("0") for match in _COUNT.finditer(text))
    counts = math.prod(max(int(n) for n in (*pair, "1") if n) for pair in pairs)
    for limit, count in ((PATTERN_LENGTH, len(text)), (PATTERN_COUNTS, counts)):
        limit.check(count, f"pattern {shown}", file.path, file.line(location))
    try:
        re.compile(text)
        regex.compile(text)
    except (re.error, regex.error) as error:
        sentence = f"{shown} is not a regular expression ({error}). Correct it"
        raise file.error(sentence, location) from None
    except (RecursionError, OverflowError):
        sentence = f"the pattern {shown} is too deeply nested. Simplify it"
        raise file.error(sentence, location) from None


# Profiles: how to read the text that an instrument's software exports.

DELIMITERS: Mapping[str, str | None] = {"comma": ",", "semicolon": ";", "tab": "\t", "spaces": None}
DECIMALS: Mapping[str, str] = {"point": ".", "comma": ","}
Place = int | str
SOME_TIME = datetime(2026, 5, 4, 10, 22, 31, tzinfo=UTC)  # a time that a format must write and read


def normalize_name(text: str) -> str:
    """Return a name in a header, or in `from`, without blanks around it and with single ones in it.

    Blanks include those that do not break a line; a byte order mark within the text counts, too.
    """
    return " ".join(unicodedata.normalize("NFC", text.replace("\ufeff", " ")).split())


def _normalize_places(places: Iterable[Place]) -> tuple[Place, ...]:
    return tuple(normalize_name(p) if isinstance(p, str) else p for p in places)


def _check_places(key: str, places: Sequence[Place]) -> None:
    """Raise ValueError for places, of a key, that are neither names nor numbers from 1."""
    for place in places or ("",):
        if place == "" or (isinstance(place, int) and place < 1):
            sentence = f"{key} is {place!r}, which is neither a name in the export's header nor a"
            raise ValueError(f"{sentence} place from 1. Correct it")


TARGET = "{target}"  # part of a name in the header that stands for each target


@dataclass(frozen=True)
class ColumnSource:
    """The source of one column of the measurement file.

    from_ : name in the export's header, or place counted from 1. Blanks join several.
        `{target}` in a name stands for each target, if a line has the columns of all of them.
    unit : unit of a number.
    factor : of a sigma: factor, such as 0.5 for an expanded uncertainty U(95) with k = 2.
    floor : of a sigma: least standard deviation with its unit, which replaces zeros.
    match : of `pose`: pattern that finds (?P<pose>..), and (?P<target>..) if each target has a
        line.
    format : of `time`: format of Python's strptime, such as '%d.%m.%Y %H:%M:%S'.
    """

    from_: Place | tuple[Place, ...]
    unit: str | int | None = None
    factor: float = 1.0
    floor: str | int | float | None = None
    match: str | None = None
    format: str | None = None

    def __post_init__(self) -> None:
        _check_places("from", self.places)
        if not (self.factor > 0.0 and math.isfinite(self.factor)):
            act = "Write a positive number, such as 0.5 for U(k=2)"
            raise ValueError(f"factor is {self.factor:g}. {act}")
        if self.symbol in UNITS:
            try:
                is_positive = self.floor is None or float(self.least) > 0.0
            except UnitError as error:
                raise ValueError(f"floor is wrong: {error}") from None
            if not is_positive:
                act = "Write a positive quantity, such as 1 um"
                raise ValueError(f"floor is {self.floor}. {act}")
        if self.format is not None:
            try:
                datetime.strptime(SOME_TIME.strftime(self.format), self.format)
            except (ValueError, re.error):  # strptime makes a regular expression of it
                act = "Write each of its parts once, such as '%d.%m.%Y %H:%M:%S'"
                sentence = f"format is {quote(self.format)}, which is not a format of times"
                raise ValueError(f"{sentence}. {act}") from None

    @property
    def places(self) -> tuple[Place, ...]:
        """Names in the export's header, or places counted from 1."""
        return _normalize_places(self.from_ if isinstance(self.from_, tuple) else (self.from_,))

    @property
    def symbol(self) -> str | None:
        """Unit of a number; None for text."""
        return None if self.unit is None else str(self.unit)

    @cached_property
    def least(self) -> str:
        """The floor in the unit of the column; 0 where there is none."""
        if self.floor is None or self.symbol is None:
            return "0"
        unit = find_unit(self.symbol)
        return format_scaled(parse_quantity(str(self.floor), unit.dimension), unit.factor_to_si)

    @cached_property
    def pattern(self) -> Pattern | None:
        """The compiled `match`."""
        return None if self.match is None else regex.compile(self.match)


@dataclass(frozen=True)
class ProfileRecord:
    """The keys of a profile.

    delimiter : separator of columns (`spaces`: any number of blanks and tabs).
    columns : column of the measurement file -> its source.
    settings : settings of the measurement file (docs/files.md). `poses` names the file with the
        readings of the poses. Without `kind`, the table holds readings alone.
    format : version of the format, 1.
    decimal : the decimal mark.
    comment : start of lines without data.
    skip : number of lines at the top without data.
    ignore : pattern of further lines without data, such as totals.
    encoding : of the text, by default UTF-8 with or without byte order mark.
    missing : further cells that mean not measured, by value (-999 includes -999.000).
    readings : actuator -> source of its reading, if the export contains readings.
    matrix : nine columns of a rotation matrix, row by row, in place of an orientation.
    """

    delimiter: Literal["comma", "semicolon", "tab", "spaces"]
    columns: Mapping[str, ColumnSource]
    settings: Mapping[str, Any] = field(default_factory=dict)
    format: int = 1
    decimal: Literal["point", "comma"] = "point"
    comment: str | None = None
    skip: int = 0
    ignore: str | None = None
    encoding: str = "utf-8"
    missing: str | int | float | tuple[str | int | float, ...] = ()
    readings: Mapping[str, ColumnSource] = field(default_factory=dict)
    matrix: tuple[Place, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _normalize_places(self.matrix))
        if self.matrix:
            _check_places("matrix", self.matrix)
        if DELIMITERS[self.delimiter] == DECIMALS[self.decimal]:
            raise ValueError("decimal is the comma, as the separator. Correct one")
        if self.skip < 0:
            raise ValueError(f"skip is {self.skip}. Write a number of lines, 0 or more")
        if self.comment == "":
            raise ValueError("comment is empty. Write the start of a comment line")
        try:
            "".encode(codecs.lookup(self.encoding).name)  # refuses codecs not of text, such as hex
        except (LookupError, ValueError):
            sentence = f"encoding is {self.encoding!r}, which is not a known encoding"
            raise ValueError(f"{sentence}. Write utf-8, utf-16, latin-1 or cp1252") from None


@dataclass(frozen=True)
class Profile:
    """A checked profile; `kind` is the kind that its settings describe, None for readings alone."""

    file: YamlFile
    record: ProfileRecord
    kind: Kind | None

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
    def columns(self) -> Mapping[str, ColumnSource]:
        """Sources of all columns, readings included."""
        return {**self.record.columns, **self.record.readings}

    @cached_property
    def columns_by_target(self) -> Mapping[str, Mapping[str, ColumnSource]]:
        """Sources of columns by target, where a line has all of them; else one without a name."""
        if not any(TARGET in str(p) for source in self.columns.values() for p in source.places):
            return {"": self.columns}

        def fill(source: ColumnSource, target: str) -> ColumnSource:
            places = (p.replace(TARGET, target) if isinstance(p, str) else p for p in source.places)
            return replace(source, from_=tuple(places))

        return {t: {n: fill(of, t) for n, of in self.columns.items()} for t in self.targets}

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """Cells that mean not measured."""
        cells = self.record.missing
        return tuple(str(c) for c in (cells if isinstance(cells, tuple) else (cells,)))

    @property
    def measured(self) -> tuple[str, ...]:
        """The columns of the kind, each once without its target; none for readings alone."""
        names = [] if self.kind is None else [column.name for column in self.kind.columns]
        return tuple(dict.fromkeys(self.strip_target(name) for name in names))

    @property
    def targets(self) -> tuple[str, ...]:
        """Targets of the kind; empty for a kind without targets."""
        return getattr(self.kind, "targets", ())

    def strip_target(self, column: str) -> str:
        """Return the name of a column without its target where there are several: `x` of `a.x`."""
        return column.partition(".")[2] if len(self.targets) > 1 else column

    def with_point(self, text: str) -> str:
        """Return a number with a decimal point; a misplaced point becomes an invalid number."""
        mark = DECIMALS[self.record.decimal]
        return text if mark == "." else text.replace(".", "?").replace(mark, ".")

    def parse(self, text: str) -> float | None:
        """Return the finite number of a cell; None for other text."""
        return parse_finite(self.with_point(text))


FORMAT = 1
# Columns of text that an export may have.
TEXTS = ("pose", *(column.name for column in POSE_COLUMNS), *ROW_COLUMNS)
# The unit behind a name in a header, as in `X [mm]` or `X (mm)`.
STATED = re.compile(r"[\[(]\s*(?P<unit>[^\[\]()]*?)\s*[\])]$")
# Units as instruments write them -> ours.
ALIASES: Mapping[str, str] = {
    "°": "deg",
    "°C": "degC",
    "°F": "degF",
    "µm": "um",
    "μm": "um",
    "inch": "in",
    '"': "in",
}


def read_profile(path: str | Path) -> Profile:
    """Read a profile; FileError for a wrong key, column, unit, pattern or encoding, at its line."""
    file = read_yaml(path, "profile of an export")
    record = read_record(file, file.content, ProfileRecord, None)
    if "format" in file.content:
        check_format(file, FORMAT)
    kind, place, keys = None, ("settings",), list(record.settings)
    if "kind" in record.settings or not record.readings:
        kind = read_kind(file, record.settings, place)
        allowed = [key for key in SETTINGS if key != "kinds"]
        refuse_unknown_keys(file, keys, [*allowed, *list_kind_settings(type(kind))], place)
    else:  # a table that only holds readings of named poses
        refuse_unknown_keys(file, keys, POSE_SETTINGS, place)
        if "pose" not in record.columns:
            raise file.error(report_finding("files.readings-without-poses"), ("columns",))
    if record.ignore is not None:
        refuse_pattern(file, record.ignore, ("ignore",))
    profile = Profile(file, record, kind)
    if "matrix" in file.content:
        is_pose = kind is not None and kind.name == "pose"
        is_quaternion = is_pose and getattr(kind, "orientation", None) == "quaternion"
        if len(record.matrix) != 9 or not is_quaternion:
            sentence = "a matrix has nine columns, row by row, and needs 'kind: pose, orientation:"
            raise file.error(f"{sentence} quaternion'. Correct it", ("matrix",))
    check_columns(profile)
    return profile


def check_columns(profile: Profile) -> None:
    """Raise FileError for columns that a measurement file of this kind cannot have, or lacks."""
    file, record = profile.file, profile.record
    measured = profile.measured[-3:] if record.matrix else profile.measured
    # of the columns of a kind, of sigma and (two) of covariances
    dimensions: dict[str, tuple[Dimension, ...]] = {}
    if kind := profile.kind:
        of = {profile.strip_target(c.name): c.dimension for c in kind.noise_columns}
        dimensions = {profile.strip_target(c.name): (c.dimension,) for c in kind.columns}
        dimensions |= {SIGMA + name: (d,) for name, d in of.items()}
        dimensions |= {f"{COVARIANCE}{a}.{b}": (of[a], of[b]) for a, b in permutations(of, 2)}
    subject = (
        "a table of readings (without a kind)"
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
            hint = suggest_names(name, allowed) or f". Allowed: {', '.join(allowed)}"
            sentence = f"{name!r} is not a column of {subject}"
            raise file.error(f"{sentence}{hint}", ("columns", name))
        _check_source(file, name, source, ("columns", name), dimensions)
    for name, source in record.readings.items():
        if name in record.columns:
            act = f"Name the measured one {MEASURED + name!r} under 'columns'"
            raise file.error(
                f"{name!r} is a reading and a measured column. {act}", ("readings", name)
            )
        _check_source(file, name, source, ("readings", name), {})
    for name in measured:
        count = sum(column in record.columns for column in (name, MEASURED + name))
        if count != 1:
            sentence = f"'columns' gives {count} sources of {name!r}, but {subject} needs one"
            raise file.error(f"{sentence}. Correct it", ("columns",))
    pattern = record.columns["pose"].pattern if "pose" in record.columns else None
    has_target = "" not in profile.columns_by_target  # each line has the columns of all
    has_target |= pattern is not None and "target" in pattern.groupindex
    if len(profile.targets) > 1 and not has_target:
        sentence = "the kind has several targets, each with a separate line"
        act = "Add (?P<target>..) to 'match' of 'pose', or {target} to names in 'from'"
        raise file.error(f"{sentence}. {act}", ("columns", "pose"))


def _check_source(
    file: YamlFile,
    name: str,
    source: ColumnSource,
    place: Location,
    dimensions: Mapping[str, tuple[Dimension, ...]],
) -> None:
    """Raise FileError for a source that its column cannot have."""
    has_unit = source.unit is not None
    is_text = name in TEXTS or name.startswith(NOTE) or (name == TIME and not has_unit)
    if is_text and has_unit:
        raise file.error(f"{name!r} is text and has no unit. Remove 'unit'", place)
    if not is_text and not has_unit:
        raise file.error(f"{name!r} has no unit. Add 'unit'", place)
    if len(source.places) > 1 and not is_text:
        raise file.error(f"{name!r} is a number and has one source. Name one column", place)
    if source.symbol is not None:
        unit_place = (*place, "unit")
        of_context = (ContextColumn(name).dimension,) if is_context(name) else ()
        wanted = of_context or dimensions.get(name.replace(MEASURED, ""), ())
        _check_unit(file, name, source.symbol, unit_place, wanted)
        header = " ".join(map(str, source.places))
        match = STATED.search(header)
        stated = source.symbol if match is None else ALIASES.get(match["unit"], match["unit"])
        known = {*list_symbols()} - {"1"}
        if stated != source.symbol and stated in known:
            sentence = f"the export's header is {header!r}, but the unit here is {source.symbol!r}"
            act = f"Write the unit {stated}, or name the column by its place"
            raise file.error(f"{sentence}. {act}", unit_place)
    for key, is_stated in (("factor", source.factor != 1.0), ("floor", source.floor is not None)):
        if is_stated and not name.startswith(SIGMA):
            finding = report_finding("files.not-a-sigma", key=key, column=name)
            raise file.error(finding, (*place, key))
    for key, value, owner in (("match", source.match, "pose"), ("format", source.format, TIME)):
        if value is not None and (name != owner or not is_text):
            sentence = f"{key!r} belongs to {owner!r}, not to {name!r}. Remove it"
            raise file.error(sentence, (*place, key))
    if source.match is not None:
        refuse_pattern(file, source.match, (*place, "match"))
        if source.pattern is None or "pose" not in source.pattern.groupindex:
            sentence = "this pattern finds no pose. Put its part of the name in (?P<pose>..)"
            raise file.error(sentence, (*place, "match"))


def _check_unit(
    file: YamlFile, name: str, symbol: str, place: Location, wanted: tuple[Dimension, ...]
) -> None:
    """Raise FileError for a unit that the column cannot have; any unit where `wanted` is empty."""
    factors = [part.strip() for part in symbol.split("*")]
    needed = wanted or (None,)
    if len(factors) != len(needed):
        example = "*".join("mm" for _ in needed)
        raise file.error(
            f"{symbol!r} is not a unit of {name!r}. Write a unit such as {example}", place
        )
    for factor, dimension in zip(factors, needed, strict=True):
        try:
            find_unit(factor, dimension)
        except UnitError as error:
            raise file.error(f"{name!r}: {error}", place) from None


# Profiles that come with loopcal, and what differs between two computers with the same
# software.


def list_shipped_profiles() -> dict[str, Path]:
    """Return name -> file of the profiles that come with loopcal."""
    folder = Path(str(resources.files("loopcal"))) / "profiles"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def find_profile_file(source: str | Path) -> Path:
    """Return the file of a profile that is given as a file or by the name of a shipped one."""
    path, shipped = as_path(source, "profile of an export"), list_shipped_profiles()
    if str(source) in shipped and not path.is_file():
        return shipped[str(source)]
    if path.exists():
        return path
    similar = suggest_names(str(source), shipped)
    raise FileError.of("files.profile-missing", path, similar=similar, shipped=tuple(shipped))


def with_local_settings(
    profile: Profile, unit: str | None = None, has_decimal_comma: bool = False
) -> Profile:
    """Return a profile with another unit of lengths, or with decimal commas: then columns are
    separated by semicolons in place of commas. FileError where its columns name another unit.
    """
    record = profile.record
    if unit is not None:
        columns = {name: _with_length(source, unit) for name, source in record.columns.items()}
        readings = {name: _with_length(source, unit) for name, source in record.readings.items()}
        record = replace(record, columns=columns, readings=readings)
    if has_decimal_comma:
        is_comma = record.delimiter == "comma"
        delimiter = "semicolon" if is_comma else record.delimiter
        record = replace(record, decimal="comma", delimiter=delimiter)
    changed = replace(profile, record=record)
    check_columns(changed)
    return changed


def _with_length(source: ColumnSource, unit: str) -> ColumnSource:
    """Return the source with another unit where it has one of length."""
    if source.symbol is None:
        return source
    try:
        find_unit(source.symbol, Dimension.LENGTH)
    except UnitError:
        return source
    return replace(source, unit=unit)
