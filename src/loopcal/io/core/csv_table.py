# SPDX-License-Identifier: Apache-2.0
"""CSV tables of measured numbers: units in the header, settings in front of it or beside the file.

# kind: pose              settings are `# key: value` lines at the top (YAML behind the #)
## a remark               or a file of the same name that ends in .yaml, without the #
pose,q1 [mm],x [mm]       header: name and [unit]
p1,233.2,0.01             rows; an empty cell means not measured
# a remark                lines with # below the header are ignored
"""

from __future__ import annotations

import csv
import math
import re
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from itertools import accumulate, chain, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.errors import FileError, UnitError, suggest_names
from loopcal.findings import Finding, report_finding
from loopcal.io.core import limits
from loopcal.io.core.text_file import as_path, read_text
from loopcal.io.core.yaml_file import YamlFile, parse_yaml, read_yaml
from loopcal.plain_text import quote
from loopcal.typing import FloatArray, IntArray
from loopcal.units import DISPLAY_UNITS, LARGEST, Dimension, Unit, find_unit, parse_number


def parse_decimals(cells: Sequence[str], factor: float) -> FloatArray:
    """Return products of numbers (n,) with a factor, rounded once as by `parse_exact`, or NaN."""
    exact = _as_decimal(factor)
    _, digits, exponent = exact.as_tuple()
    text = "".join(cells)
    is_plain = text.isascii() and "_" not in text

    def parse(cell: str) -> float:
        try:
            product = float(Decimal(cell) * exact)
        except (ValueError, ArithmeticError):  # such as by an exponent of 18 digits
            return math.nan
        return product if is_plain or parse_number(cell) is not None else math.nan

    if digits == (1,) and is_plain:  # a power of ten, such as of mm
        with suppress(ValueError):  # a cell is no plain decimal
            power = f"e{exponent}"
            return _keep_finite(np.array([float(cell + power) for cell in cells]))
    return _keep_finite(np.array([parse(cell) for cell in cells]))


def _keep_finite(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, math.nan)


# Numbers as text: the fewest digits that read back as the same double.

# Significant digits that are tried, fewest first; 17 always suffice for one double. A number of
# fewer than 15 that reads back is the nearest one of 15, whose zeros at the end are not written.
DIGITS = range(15, 18)


@cache
def _as_decimal(factor: float) -> Decimal:
    return Decimal(repr(factor)).normalize()


def format_exact(value: float, factor: float) -> str:
    """Return the shortest text (up to 17 digits) from which `parse_exact` makes the same double.

    17 digits suffice for every double: rounding to them changes a number by at most 0.5e-16 of it,
    and half the distance of two doubles is at least 0.55e-16 of them.
    """
    scaled = Decimal(value) / _as_decimal(factor)
    number = float(scaled)
    for digits in DIGITS:
        if parse_exact(text := f"{number:.{digits}g}", factor) == value:
            return text
    # rounded once: through a double, the last digit may be that of a neighbor
    return f"{scaled:.{DIGITS[-1]}g}"


def parse_exact(text: str, factor: float) -> float:
    """Return the double nearest to text times factor, rounded once; or raise InvalidOperation."""
    return float(Decimal(text) * _as_decimal(factor))


def parse_finite(text: str) -> float | None:
    """Return the finite number that a text states; None for any other text."""
    value = parse_number(text)
    return value if value is not None and math.isfinite(value) else None


WHAT = "measurement file"
CONVERT_HINT = ", or convert an instrument's export by means of a profile (docs/exports.md)"
# Keys by which a settings file is recognized among YAML files of the same name.
SIDECAR_KEYS = ("kind", "kinds", "noise", "controller", "instrument", "reading_noise", "poses")
BLOCK = 100_000  # characters of rows that are split and parsed at once
NAME_COLUMNS = ("pose", "use", "block", "kind", "session", "group")  # columns whose cells are names
_SETTING = re.compile(r"^#\s*[A-Za-z]\w*:(\s|$)")
_HEADER = re.compile(r"^(?P<name>[^\[\]]*[^\[\]\s])\s*(\[(?P<unit>[^\[\]]*)\])?$")
_ROUND_BRACKETS = re.compile(r"^(?P<name>[^()]*[^()\s])\s*\((?P<unit>[^()]*)\)$")


class Cells(Sequence[str]):
    """The cells of a column, kept as texts of some hundred cells with line feeds between them: as
    objects of their own, the cells of a million rows would take five times the memory.
    """

    def __init__(self, blocks: Iterable[str]) -> None:
        self._texts = tuple(blocks)
        self._begins = list(accumulate((text.count("\n") + 1 for text in self._texts), initial=0))

    @property
    def blocks(self) -> Iterator[list[str]]:
        """The cells, some hundred at a time."""
        return (text.split("\n") for text in self._texts)

    def __len__(self) -> int:
        return self._begins[-1]

    def __iter__(self) -> Iterator[str]:
        return chain.from_iterable(self.blocks)

    def __getitem__(self, place: Any) -> Any:
        number = bisect_right(self._begins, place) - 1
        return self._texts[number].split("\n")[place - self._begins[number]]


@dataclass(frozen=True)
class Table:
    """Cells of a CSV file as text, with their lines.

    `units` : column -> unit symbol as written, None where there is none. `columns` : column ->
    cells without surrounding blanks. `lines` : line of each row. `settings` may be empty.
    """

    path: Path
    settings: YamlFile
    header_line: int
    units: dict[str, str | None]
    columns: Mapping[str, Cells]
    lines: Sequence[int]

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def names(self) -> tuple[str, ...]:
        """Column names in order."""
        return tuple(self.units)

    def text(self, name: str) -> Sequence[str]:
        """Return the cells of a column; empty ones where it does not exist."""
        return self.columns[name] if name in self.units else ("",) * len(self)

    @property
    def rows(self) -> Iterator[tuple[str, ...]]:
        """The cells of each row."""
        return zip(*self.columns.values(), strict=True)

    def pose_names(self) -> tuple[str, ...]:
        """Return the cells of the column `pose`; "1", "2", ... where it does not exist."""
        if "pose" in self.units:
            return tuple(self.text("pose"))
        return tuple(str(i + 1) for i in range(len(self)))

    def numbers(
        self, name: str, dimension: Dimension, empty: bool = True, infinite: bool = False
    ) -> FloatArray:
        """Return a column (n,) [SI], NaN where a cell is empty.

        FileError : no unit or one of another dimension, a cell that is not a finite number (or
        `inf`, where `infinite` cells are allowed), or is empty where it must not be.
        """
        factor = self.unit(name, dimension).factor_to_si
        values = self.scaled_numbers(name, factor, empty, infinite)
        beyond = np.flatnonzero((np.abs(values) > LARGEST) & np.isfinite(values))
        if len(beyond):
            row = int(beyond[0])
            allowed = f"{LARGEST / factor:g} [{self.units[name]}]"
            sentence = f"column {name!r} is {self.text(name)[row]}, outside {allowed}"
            raise self.row_error(row, f"{sentence}. Correct the number or the unit")
        return values

    def scaled_numbers(
        self, name: str, factor: float, empty: bool = True, infinite: bool = False
    ) -> FloatArray:
        """Return the products (n,) of the cells of a column with a factor; see `numbers`."""
        parts, first = [np.zeros(0)], 0
        for cells in self.columns[name].blocks:
            values = parse_decimals(cells, factor)
            for i in np.flatnonzero(np.isnan(values)).tolist():
                if infinite and cells[i] == "inf":
                    values[i] = math.inf
                elif cells[i] or not empty:
                    sentence = f"column {name!r} is empty, but required. Write its value"
                    if cells[i] and parse_number(cells[i]) is None:
                        sentence = f"column {name!r} is {quote(cells[i])}, but must be a number"
                        sentence += ", such as 12.5 or 1e-3"
                    elif cells[i]:
                        sentence = f"column {name!r} is {quote(cells[i])}, which is not finite"
                        sentence += ". Leave the cell empty if you measured nothing"
                    raise self.row_error(first + i, sentence)
            parts.append(values)
            first += len(cells)
        return np.concatenate(parts)

    def unit(self, name: str, dimension: Dimension, symbol: str | None = None) -> Unit:
        """Return the unit of a column, or that of `symbol`, a factor of its unit; see `numbers`."""
        symbol = self.units[name] if symbol is None else symbol
        if symbol is None:
            example = f"{name} [{DISPLAY_UNITS[dimension]}]"
            sentence = f"column {name!r} has no unit. Write it in brackets, such as {example!r}"
            raise self.header_error(sentence)
        try:
            return find_unit(symbol, dimension)
        except UnitError as error:
            raise self.header_error(f"column {name!r}: {error}") from None

    def header_error(self, sentence: str) -> FileError:
        """Return an error at the header line."""
        return FileError(sentence, self.path, self.header_line)

    def row_error(self, row: int, sentence: str | Finding) -> FileError:
        """Return an error at the line of a row."""
        return FileError(sentence, self.path, self.lines[row])

    def places(self, rows: IntArray) -> Places:
        """Return file and line of rows; see `place`."""
        return Places((self,), np.zeros(len(rows), dtype=np.intp), rows)

    def place(self, row: int) -> str:
        """Return file and line of a row, such as `data.csv:12`."""
        return f"{self.path}:{self.lines[row]}"


class Places(Sequence[str]):
    """Files and lines of rows, which are worded where one is asked for."""

    number: IntArray
    rows: IntArray

    def __init__(self, tables: Sequence[Table], number: IntArray, rows: IntArray) -> None:
        """`number` (n,) of the table that has each of the `rows` (n,); -1 without any."""
        self._tables, self.number, self.rows = tables, number, rows

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, i: Any) -> Any:
        number = int(self.number[i])
        return "" if number < 0 else self._tables[number].place(int(self.rows[i]))


def read_table(path: str | Path) -> Table:
    """Read a CSV table with its settings; FileError for a bad header, settings or rows, or none."""
    table = read_template(path)
    if not len(table):
        sentence = "this file has a header but no rows. Add one row for each pose"
        raise FileError(sentence, table.path, table.header_line)
    return table


def read_template(path: str | Path) -> Table:
    """Read a CSV table that may have no rows; raise as `read_table`."""
    path = as_path(path, WHAT)
    text = read_text(path, WHAT, CONVERT_HINT, limits.TABLE_SIZE)
    limits.TABLE_LINES.check(text.count("\n"), WHAT, path)
    settings, first = _read_settings(path, text)
    numbers, longest, header = array("q"), (0, 0), ""
    for at, lines in _iterate_rows(text, first):
        header = header or lines[0]
        numbers.extend(at)
        length = max(map(len, lines))
        if length > longest[0]:
            longest = (length, at[list(map(len, lines)).index(length)])
    if not numbers:
        raise FileError("this file has no header; its first line names columns and units", path)
    header_line = numbers.pop(0)
    limits.TABLE_ROWS.check(len(numbers), WHAT, path)
    limits.LINE_LENGTH.check(longest[0], WHAT, path, longest[1])
    limits.TABLE_COLUMNS.check(header.count(",") + 1, WHAT, path, header_line)
    if "," not in header and (";" in header or "\t" in header):
        separator = "semicolons" if ";" in header else "tabs"
        sentence = f"{separator} separate the columns. Use commas, and decimal points"
        raise FileError(sentence + CONVERT_HINT, path, header_line)
    units = _parse_header(path, header_line, header)
    blocks = []
    for at, lines in _iterate_rows(text, header_line):
        rows = [_split_cells(path, *line) for line in zip(at, lines, strict=True)]
        for number, row in zip(at, rows, strict=True):
            if len(row) != len(units):
                sentence = f"this row has {len(row)} cells, but the header has {len(units)} columns"
                act = "Write one cell for each column, empty if not measured, with decimal points"
                raise FileError(f"{sentence}. {act}", path, number)
        blocks.append(["\n".join(column) for column in zip(*rows, strict=True)])
    columns = {name: Cells(block[i] for block in blocks) for i, name in enumerate(units)}
    table = Table(path, settings, header_line, units, columns, numbers)
    for column in (name for name in NAME_COLUMNS if name in units):
        longest = limits.LONGEST_COMPOSED if column == "pose" else limits.LONGEST_NAME
        for cell in dict.fromkeys(table.text(column)):
            if (fault := limits.find_fault(cell, longest)) is not None:
                raise table.row_error(tuple(table.text(column)).index(cell), fault)
    return table


def require_columns(table: Table, needed: Sequence[str], why: str) -> None:
    """Raise FileError for the first needed column that the table lacks; `why` follows its name."""
    spare = [name for name in table.names if name not in needed]
    for name in needed:
        if name not in table.units:
            hints = (suggest_header(other, symbol, [name]) for other, symbol in table.units.items())
            hint = next(filter(None, hints), suggest_names(name, spare))
            unit = "" if name in NAME_COLUMNS else " with its unit"
            raise table.header_error(f"no column {name!r}{hint}, {why}. Add it{unit}")


def suggest_header(header: str, symbol: str | None, known: Iterable[str]) -> str:
    """Return ` (did you mean 'x [mm]'?)` where only capitals or round brackets differ."""
    match = _ROUND_BRACKETS.match(header) if symbol is None else None
    plain, written = (header, symbol) if match is None else (match["name"], match["unit"])
    name = {name.casefold(): name for name in known}.get(plain.casefold())
    if name is None:
        return ""
    return f" (did you mean {name if written is None else f'{name} [{written}]'!r}?)"


def format_header(units: Mapping[str, str | None]) -> tuple[str, ...]:
    """Return the cells of a header from column -> symbol of its unit, None for text."""
    return tuple(name if unit is None else f"{name} [{unit}]" for name, unit in units.items())


def format_row(cells: Iterable[str]) -> str:
    """Return a line of cells, in quotes where one contains a comma, a quote or a number sign."""
    cells = tuple(cells)
    line = ",".join(cells)
    if '"' not in line and "#" not in line and line.count(",") == max(len(cells) - 1, 0):
        return line
    return ",".join(
        '"' + cell.replace('"', '""') + '"' if any(c in cell for c in ',"#') else cell
        for cell in cells
    )


def format_columns(columns: Mapping[str, Iterable[str]]) -> str:
    """Return columns of cells by heading as CSV text."""
    rows = zip(*columns.values(), strict=True)
    return "".join(format_row(cells) + "\n" for cells in (columns, *rows))


def _iterate_lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of lines above some lines of a text, about `BLOCK` characters, and these."""
    begin, count, has_returns = 0, 0, "\r" in text
    while begin <= len(text):
        end = text.find("\n", begin + BLOCK)
        end = len(text) if end < 0 else end
        lines = text[begin:end].split("\n")
        yield count, [line.rstrip("\r") for line in lines] if has_returns else lines
        begin, count = end + 1, count + len(lines)


def _iterate_rows(text: str, first: int) -> Iterator[tuple[list[int], list[str]]]:
    """Yield numbers and texts of some lines at a time, below the first: no blanks or remarks."""
    for count, lines in _iterate_lines(text):
        begin = max(first - count, 0)
        rows = [
            (number, line)
            for number, line in enumerate(lines[begin:], count + begin + 1)
            if line and line[0] != "#" and not line.isspace()
        ]
        if rows:
            yield [number for number, _ in rows], [line for _, line in rows]


def _read_settings(path: Path, text: str) -> tuple[YamlFile, int]:
    """Return the settings, and the number of lines of the front matter."""
    every = (line for _, lines in _iterate_lines(text) for line in lines)
    lines = list(takewhile(lambda line: line.startswith("#"), every))
    sidecar = _read_sidecar(path, any(map(_SETTING.match, lines)))
    if sidecar is not None:
        return sidecar, 0
    text = "\n".join(line[1:] for line in lines)
    if not any(line.strip() and not line.strip().startswith("#") for line in text.splitlines()):
        return YamlFile(path, "", {}), len(lines)
    try:
        # `# key: value` leaves one blank before each key, the same for all
        return parse_yaml(text, path, "front matter"), len(lines)
    except FileError as error:
        if error.code is not None:
            raise
        advice = "lines with # at the top are settings, '# key: value'. Begin a remark with ##"
        raise FileError(f"{error.sentence} ({advice})", path, error.line) from None


def refuse_settings_beside(path: Path) -> None:
    """Raise FileError where a file with settings of its own would have others beside it."""
    _read_sidecar(path, has_front_matter=True)


def _read_sidecar(path: Path, has_front_matter: bool) -> YamlFile | None:
    """Return the settings file beside a measurement file, None without one."""
    beside = path.with_suffix(".yaml")
    if beside == path or not beside.exists():
        return None
    try:
        settings = read_yaml(beside, "settings file of the measurements")
    except FileError:
        if has_front_matter:
            return None  # an unrelated file of this name
        raise
    if "family" in settings.content:  # a robot file may have the name of its measurements
        return None
    if not has_front_matter:
        return settings
    if any(key in settings.content for key in SIDECAR_KEYS):
        sentence = f"settings are at the top of this file and in {beside.name}. Remove one of them"
        raise FileError(f"{sentence} (a remark begins with ##)", path)
    return None


def _parse_header(path: Path, line: int, text: str) -> dict[str, str | None]:
    """Return name -> unit symbol of a header line."""
    units: dict[str, str | None] = {}
    cells = _split_cells(path, line, text)
    for i, cell in enumerate(cells):
        match = _HEADER.match(cell)
        name = cell if match is None else match["name"]
        fault: str | Finding | None = limits.find_fault(name, limits.LONGEST_COMPOSED)
        if match is None:
            fault = f"header of column {i + 1} is {quote(cell)}. Write name and unit, as 'x [mm]'"
        elif fault is None and name in units:
            fault = f"duplicate column {name!r}. Remove one"
        if fault is not None:
            # by its form the header of a column: a known name, or with a unit
            is_ours = any(cell in NAME_COLUMNS or cell.endswith(("]", ")")) for cell in cells)
            finding = fault if is_ours else report_finding("files.header-not-recognized")
            raise FileError(finding, path, line)
        assert match is not None
        units[name] = match["unit"].strip() if match["unit"] is not None else None
    return units


def _split_cells(path: Path, line: int, text: str) -> tuple[str, ...]:
    """Split one line at its commas."""
    if '"' not in text and "\r" not in text and len(text) < csv.field_size_limit():
        return tuple(map(str.strip, text.split(",")))  # as csv does without quotes
    try:
        return tuple(cell.strip() for cell in next(csv.reader([text], strict=True)))
    except csv.Error as error:
        if "\r" in text:
            sentence = "this line contains a carriage return. Save the file with equal line ends"
            raise FileError(sentence, path, line) from None
        raise FileError(f"not valid CSV ({error}). Correct the quotes", path, line) from None
