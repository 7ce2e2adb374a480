# SPDX-License-Identifier: Apache-2.0
r"""A profile: how the text that an instrument's software exports is to be read.

delimiter: semicolon                    comma, semicolon, tab or spaces
columns:
  pose: {from: Name, match: 'P(?P<pose>\d+)_(?P<target>\w+)'}
  x: {from: X, unit: mm}                by the name in the export's header, or its place counted from 1
settings: {kind: position, ...}         what the measurement file will state
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import UnitError, suggest_names
from loopcal.io.core.yaml_file import Location, YamlFile, read_yaml, refuse_unknown_keys
from loopcal.io.data.column_types import TEMPERATURE_UNITS, TIME, TIME_UNITS
from loopcal.io.data.columns import COVARIANCE, SIGMA, is_context
from loopcal.io.data.kind_rows import SETTINGS
from loopcal.io.data.kind_settings import list_kind_settings, read_kind
from loopcal.io.exports.export_cells import plain_number, with_point
from loopcal.io.robot.robot_file import check_format
from loopcal.units import Dimension, find_unit, list_symbols

if TYPE_CHECKING:
    from loopcal.measure import Column, Kind

FORMAT = 1
DELIMITERS: Mapping[str, str | None] = {"comma": ",", "semicolon": ";", "tab": "\t", "spaces": None}
DECIMALS: Mapping[str, str] = {"point": ".", "comma": ","}
KEYS: Mapping[str, str] = {
    "format": "1",
    "delimiter": "what stands between columns: comma, semicolon, tab, or spaces (any number of "
    "blanks and tabs)",
    "decimal": "the decimal mark: point (if left out) or comma",
    "comment": "what a line begins with that holds nothing",
    "skip": "number of lines in front to pass over",
    "ignore": "pattern of lines that are none of the measurement, such as totals",
    "encoding": "of the text; utf-8 if left out, with or without byte order mark",
    "missing": "cells that mean not measured, beside empty ones; numbers by their value: -999 is "
    "-999.000, too",
    "columns": "our column -> where it comes from",
    "readings": "actuator -> where its reading comes from, where the export holds it",
    "matrix": "nine columns of a rotation matrix, row by row, in place of the columns of an "
    "orientation",
    "settings": "settings of the measurement file, see docs/files.md; `poses` names the file in "
    "which the poses stand",
}
FROM: Mapping[str, str] = {
    "from": "name in the export's header, or place counted from 1; a list of them is joined by "
    "blanks",
    "unit": "unit of a number",
    "match": "of pose: pattern that finds (?P<pose>..), and (?P<target>..) where each target has a "
    "line of its own",
    "format": "of time: as Python's strptime has it, such as '%d.%m.%Y %H:%M:%S'",
}
MEASURED = "measured."
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

TEXTS = ("pose", "block", "session", "group")


@dataclass(frozen=True)
class Source:
    """Where one of our columns comes from.

    Parameters
    ----------
    places : tuple of str or int
        Names in the export's header, or places counted from 1.
    unit : str or None
        Of a number; None for text.
    match : Pattern or None
        What finds the pose, and the target, in a name.
    time : str or None
        How a date and time is written.
    """

    places: tuple[str | int, ...]
    unit: str | None = None
    match: re.Pattern[str] | None = None
    time: str | None = None


@dataclass(frozen=True)
class Profile:
    """A profile; its fields are the keys of KEYS.

    `columns` has the readings, too, whose names are `readings`; `matrix` is empty where the export
    has none. `kind` is what `settings` describe; `missing_numbers` are those of `missing` that are
    numbers.
    """

    file: YamlFile
    delimiter: str | None
    decimal: str
    comment: str | None
    skip: int
    ignore: re.Pattern[str] | None
    encoding: str
    missing: tuple[str, ...]
    missing_numbers: tuple[float, ...]
    columns: Mapping[str, Source]
    readings: tuple[str, ...]
    matrix: tuple[str | int, ...]
    kind: Kind
    settings: Mapping[str, Any]

    def called(self, name: str) -> str:
        """Return what the profile calls a column of the kind: `measured.NAME` where NAME is a
        reading, too.
        """
        return MEASURED + name if MEASURED + name in self.columns else name


def read_profile(path: str | Path) -> Profile:
    """Read a profile.

    Raises
    ------
    FileError
        A key that is missing, unknown or without sense, a column that is none of ours, a pattern
        that is none; at its line.
    """
    file = read_yaml(path, "profile of an export")
    content = file.content
    refuse_unknown_keys(file, list(content), list(KEYS))
    for key in ("delimiter", "columns", "settings"):
        if key not in content:
            raise file.error(f"this profile does not say {key!r} ({KEYS[key]}); add it")
    if "format" in content:
        check_format(file, FORMAT)
    kind = _kind(file)
    matrix = _matrix(file, kind)
    decimal = DECIMALS[_choice(file, "decimal", list(DECIMALS), "point")]
    delimiter = DELIMITERS[_choice(file, "delimiter", list(DELIMITERS), "comma")]
    if delimiter == decimal:
        raise file.error(
            "a comma cannot be the decimal mark and stand between columns, too; correct one",
            ("decimal",),
        )
    return Profile(
        file,
        delimiter,
        decimal,
        _text(file, "comment"),
        _count(file, "skip"),
        _pattern(file, content["ignore"], ("ignore",)) if "ignore" in content else None,
        _encoding(file),
        *_missing(file, decimal),
        _columns(file, kind, bool(matrix)),
        tuple(content.get("readings", {})),
        matrix,
        kind,
        content["settings"],
    )


def _kind(file: YamlFile) -> Kind:
    """Return the kind that the settings describe."""
    settings, place = file.content["settings"], ("settings",)
    if not isinstance(settings, dict):
        raise file.error(
            "'settings' holds what the measurement file states: kind, noise, ..; correct it", place
        )
    kind = read_kind(file, settings, place)
    known = [key for key in SETTINGS if key != "kinds"]
    refuse_unknown_keys(file, list(settings), [*known, *list_kind_settings(type(kind))], place)
    return kind


def _columns(file: YamlFile, kind: Kind, matrix: bool) -> dict[str, Source]:
    """Return our columns, readings among them, with where they come from."""
    several = len(getattr(kind, "targets", ())) > 1
    own = list(dict.fromkeys(c.name.partition(".")[2] if several else c.name for c in kind.columns))
    if matrix:
        own = own[-3:]
    dimensions, columns = _dimensions(kind, several), dict[str, Source]()
    stated = {part: file.content.get(part, {}) for part in ("columns", "readings")}
    for part, node in stated.items():
        if not isinstance(node, dict):
            raise file.error(
                f"{part!r} must name columns, as {part}: {{x: {{from: X, unit: mm}}}}; correct it",
                (part,),
            )
    for part, node in stated.items():
        for name, said in node.items():
            if part == "columns":
                known = [*TEXTS, "time", "temperature", *own, *(MEASURED + n for n in own)]
                beside = [*dimensions, *(SIGMA + one for one in stated["readings"])]
                _check_name(
                    file,
                    kind,
                    name,
                    known,
                    [n for n in beside if n.startswith((SIGMA, COVARIANCE))],
                )
            elif name in columns:
                sentence = f"{name!r} is a reading and a measured column, too"
                raise file.error(
                    f"{sentence}; call the measured one {MEASURED + name!r} under 'columns'",
                    (part, name),
                )
            columns[name] = _source(
                file, name, said, (part, name), dimensions if part == "columns" else {}
            )
    for name in own:
        if sum(one in stated["columns"] for one in (name, MEASURED + name)) != 1:
            sentence = f"'columns' does not say where {name!r} comes from, once, which the kind {kind.name!r} needs"
            raise file.error(sentence, ("columns",))
    _check_targets(file, columns, several)
    return columns


def _check_name(file: YamlFile, kind: Kind, name: str, known: list[str], noise: list[str]) -> None:
    """Refuse a column that a measurement file of this kind cannot have."""
    of_noise = name.startswith((SIGMA, COVARIANCE))
    allowed, plain = (noise, name.replace(MEASURED, "")) if of_noise else (known, name)
    if plain not in allowed and not is_context(name) and not name.startswith("note"):
        hint = suggest_names(name, allowed) or f"; there are {', '.join(allowed)}"
        raise file.error(
            f"{name!r} is no column of a measurement file of the kind {kind.name!r}{hint}",
            ("columns", name),
        )


def _check_targets(file: YamlFile, columns: Mapping[str, Source], several: bool) -> None:
    """Refuse lines of several targets that nothing tells apart."""
    match = columns["pose"].match if "pose" in columns else None
    if several and (match is None or "target" not in match.groupindex):
        raise file.error(
            "the kind has several targets, each with a line of its own; say how 'match' of 'pose' "
            "finds (?P<target>..)",
            ("columns", "pose"),
        )


def _dimensions(kind: Kind, several: bool) -> dict[str, tuple[Dimension, ...]]:
    """Return what each column of the kind measures, and each sigma and covariance: two dimensions
    for a product.
    """

    def plain(columns: Sequence[Column]) -> dict[str, Dimension]:
        return {c.name.partition(".")[2] if several else c.name: c.dimension for c in columns}

    noise = plain(kind.noise_columns)
    found: dict[str, tuple[Dimension, ...]] = {
        name: (d,) for name, d in plain(kind.columns).items()
    }
    found |= {SIGMA + name: (d,) for name, d in noise.items()}
    found |= {f"{COVARIANCE}{a}.{b}": (noise[a], noise[b]) for a in noise for b in noise if a != b}
    return found


def _source(
    file: YamlFile,
    name: str,
    node: Any,
    place: Location,
    dimensions: Mapping[str, tuple[Dimension, ...]],
) -> Source:
    """Return where a column comes from."""
    if not isinstance(node, dict) or "from" not in node:
        raise file.error(
            f"{name!r} needs 'from', a name or a place in the export, as {{from: X, unit: mm}}; "
            "correct it",
            place,
        )
    refuse_unknown_keys(file, list(node), list(FROM), place)
    places = _places(file, node["from"], (*place, "from"))
    text = name in TEXTS or name.startswith("note") or (name == TIME and "unit" not in node)
    if text != ("unit" not in node):
        raise file.error(
            f"{name!r} {'is text and has no unit; remove it' if text else 'needs the unit of its numbers; add it'}",
            place,
        )
    if len(places) > 1 and not text:
        raise file.error(f"{name!r} is a number and comes from one column; name one", place)
    if "unit" in node:
        wanted = dimensions.get(name.replace(MEASURED, ""), ())
        _check_unit(file, name, str(node["unit"]), (*place, "unit"), wanted)
        _check_header(file, " ".join(map(str, places)), str(node["unit"]), (*place, "unit"))
    for key, owner in (("match", "pose"), ("format", TIME)):
        if key in node and (name != owner or not text):
            raise file.error(
                f"{key!r} belongs to {owner!r}, not to {name!r}; remove it", (*place, key)
            )
    match = _pattern(file, node["match"], (*place, "match")) if "match" in node else None
    if match is not None and "pose" not in match.groupindex:
        raise file.error(
            "this pattern finds no pose; put its part of the name in (?P<pose>..)",
            (*place, "match"),
        )
    return Source(
        places,
        str(node["unit"]) if "unit" in node else None,
        match,
        str(node["format"]) if "format" in node else None,
    )


def _check_unit(
    file: YamlFile, name: str, symbol: str, place: Location, wanted: tuple[Dimension, ...]
) -> None:
    """Refuse a unit that the column cannot have; `wanted` is empty where any will do."""
    if is_context(name):
        known = TIME_UNITS if name == TIME else TEMPERATURE_UNITS
        if symbol not in known:
            raise file.error(
                f"{symbol!r} is no unit of {name!r}; write one of {', '.join(known)}", place
            )
        return
    parts = [part.strip() for part in symbol.split("*")]
    needed = wanted or (None,)
    if len(parts) != len(needed):
        like = "*".join("mm" for _ in needed)
        raise file.error(
            f"{symbol!r} is no unit of {name!r}; write one of {len(needed)} factors, such as {like}",
            place,
        )
    for part, dimension in zip(parts, needed, strict=True):
        try:
            find_unit(part, dimension)
        except UnitError:
            of = (
                f"unit of {name!r}"
                if part in list_symbols()
                else f"unit{suggest_names(part, list_symbols(dimension))}"
            )
            raise file.error(
                f"{part!r} is no {of}; write one of {', '.join(list_symbols(dimension))}", place
            ) from None


def _check_header(file: YamlFile, header: str, symbol: str, place: Location) -> None:
    """Refuse a unit other than the one that the export's header states behind the name."""
    found = STATED.search(header)
    behind = symbol if found is None else found["unit"]
    stated = ALIASES.get(behind, behind)
    if stated != symbol and stated in {*list_symbols(), *TIME_UNITS, *TEMPERATURE_UNITS} - {"1"}:
        sentence = f"the export heads this column {header!r}, but the unit here is {symbol!r}"
        raise file.error(
            f"{sentence}; write the unit {stated}, or name the column by its place", place
        )


def _matrix(file: YamlFile, kind: Kind) -> tuple[str | int, ...]:
    """Return the nine places of a rotation matrix, row by row."""
    if "matrix" not in file.content:
        return ()
    places = _places(file, file.content["matrix"], ("matrix",))
    if (
        len(places) != 9
        or getattr(kind, "orientation", None) != "quaternion"
        or kind.name != "pose"
    ):
        sentence = "a matrix has nine columns, row by row, and becomes the quaternion of 'kind: pose, orientation: quaternion'"
        raise file.error(f"{sentence}; correct it", ("matrix",))
    return places


def _places(file: YamlFile, node: Any, place: Location) -> tuple[str | int, ...]:
    """Return names, or places counted from 1."""
    given = node if isinstance(node, list) else [node]
    for one in given:
        if (
            isinstance(one, bool)
            or not isinstance(one, (str, int))
            or (isinstance(one, int) and one < 1)
            or one == ""
        ):
            raise file.error(
                f"{one!r} is neither a name in the export's header nor a place counted from 1; "
                "correct it",
                place,
            )
    if not given:
        raise file.error(
            "this names no column; write a name in the export's header or a place counted from 1",
            place,
        )
    return tuple(given)


def _choice(file: YamlFile, key: str, allowed: list[str], usual: str) -> str:
    """Return one of a few words."""
    value = file.content.get(key, usual)
    if value not in allowed:
        raise file.error(f"{key!r} is {value!r}; write one of {', '.join(allowed)}", (key,))
    return value


def _pattern(file: YamlFile, text: Any, place: Location) -> re.Pattern[str]:
    """Return a regular expression."""
    try:
        return re.compile(str(text))
    except re.error as error:
        raise file.error(
            f"{text!r} is no regular expression ({error}); correct it", place
        ) from None


def _encoding(file: YamlFile) -> str:
    """Return the name of an encoding of text; UTF-8 passes over a byte order mark."""
    name = str(file.content.get("encoding", "utf-8"))
    try:
        found = codecs.lookup(name).name
        "".encode(found)  # refuses codecs that are no text, such as hex
    except (LookupError, ValueError):
        sentence = (
            f"{name!r} is no encoding of text that is known; write utf-8, utf-16, latin-1 or cp1252"
        )
        raise file.error(sentence, ("encoding",)) from None
    return "utf-8-sig" if found == "utf-8" else found


def _text(file: YamlFile, key: str) -> str | None:
    """Return text that is not empty, None where the key is not there."""
    value = file.content.get(key)
    if value is not None and (not isinstance(value, str) or not value):
        raise file.error(f"{key!r} is {value!r} where text is needed; put it in quotes", (key,))
    return value


def _count(file: YamlFile, key: str) -> int:
    """Return a number of lines."""
    value = file.content.get(key, 0)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise file.error(
            f"{key!r} is {value!r} where a number of lines is needed; write 0, 1, ..", (key,)
        )
    return value


def _missing(file: YamlFile, decimal: str) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return the cells that mean not measured, as text, and those of them that are numbers."""
    value = file.content.get("missing", [])
    given = value if isinstance(value, list) else [value]
    for one in given:
        if isinstance(one, bool) or not isinstance(one, (str, int, float)):
            raise file.error(
                f"'missing' has {one!r} where the text of a cell is needed; put it in quotes",
                ("missing",),
            )
    numbers = [
        plain_number(with_point(one, decimal) if isinstance(one, str) else repr(one))
        for one in given
    ]
    return tuple(str(one) for one in given), tuple(
        number for number in numbers if number is not None
    )
