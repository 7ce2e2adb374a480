# SPDX-License-Identifier: Apache-2.0
"""A CSV table of numbers with the unit of each column in its header, and settings in front of it or
beside it.

# kind: pose                     settings: `# key: value` lines at the top (YAML behind the #; `##`
# is a remark), noise: {x: 1 um}               or the same YAML without # in a file of the same name
# ending in .yaml
pose,q.leg1 [mm],x [mm]          header: name and [unit]
p1,233.2,0.01                    rows; an empty cell means not measured
# a remark                       ignored below the header
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import FileError, UnitError, suggest_names
from loopcal.io.core.numbers import exact
from loopcal.io.core.text_file import read_text
from loopcal.io.core.yaml_file import YamlFile, parse_yaml, read_yaml
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    import numpy as np

WHAT = "measurement file"
BY_PROFILE = (
    ", or read an instrument's export as it is by 'loopcal import --profile' (docs/exports.md)"
)
"""What helps with text that other programs wrote."""

SIDECAR_KEYS = ("kind", "kinds", "noise", "controller", "instrument", "reading_noise", "poses")
"""What tells a settings file from another YAML file of the same name."""

_SETTING = re.compile(r"^#\s*[A-Za-z]\w*:(\s|$)")
_HEADER = re.compile(r"^(?P<name>[^\[\]]*[^\[\]\s])\s*(\[(?P<unit>[^\[\]]*)\])?$")

_ROUND = re.compile(r"^(?P<name>[^()]*[^()\s])\s*\((?P<unit>[^()]*)\)$")


@dataclass(frozen=True)
class Table:
    """Cells of a CSV file as text, with their lines.

    Parameters
    ----------
    path : Path
        The file.
    settings : YamlFile
        Front matter or sidecar; empty content where there is neither.
    header_line : int
        Line of the header.
    units : dict
        Column name -> unit symbol as written, None where none is written.
    rows : tuple of tuple of str
        Cells, stripped, as many in each row as columns.
    lines : tuple of int
        Line of each row.
    """

    path: Path
    settings: YamlFile
    header_line: int
    units: dict[str, str | None]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Column names in order."""
        return tuple(self.units)

    def text(self, name: str) -> tuple[str, ...]:
        """Return the cells of a column as text."""
        place = self.names.index(name)
        return tuple(row[place] for row in self.rows)

    def numbers(self, name: str, dimension: Dimension, empty: bool = True) -> np.ndarray:
        """Return a column in SI.

        Parameters
        ----------
        name : str
            The column.
        dimension : Dimension
            What its unit must measure.
        empty : bool
            Empty cells are allowed and become NaN.

        Returns
        -------
        ndarray
            (n,) values [SI].

        Raises
        ------
        FileError
            Unit missing or of another dimension, a cell that is not a finite number, an empty cell.
        """
        return self.scaled(name, dimension, self.text(name), empty)

    def scaled(
        self, name: str, dimension: Dimension, cells: Sequence[str], empty: bool = True
    ) -> np.ndarray:
        """Return cells (n,) of a column, or what stands for them, in SI; see `numbers`."""
        import numpy as np

        factor = self.factor(name, dimension)
        known = [self.number(name, i, cell, empty) for i, cell in enumerate(cells)]
        return np.array(
            [exact(c, factor) if v == v else v for v, c in zip(known, cells, strict=True)]  # noqa: PLR0124
        )

    def factor(self, name: str, dimension: Dimension) -> float:
        """Return SI per unit of a column; see `numbers`."""
        symbol = self.units[name]
        if symbol is None:
            example = f"'{name} [{'mm' if dimension is Dimension.LENGTH else 'deg'}]'"
            raise self.header_error(
                f"column {name!r} has no unit; write it in brackets, for example {example}"
            )
        try:
            return find_unit(symbol, dimension).factor_to_si
        except UnitError as error:
            raise self.header_error(f"column {name!r}: {error}") from None

    def header_error(self, sentence: str) -> FileError:
        """Return an error at the header line."""
        return FileError(sentence, self.path, self.header_line)

    def row_error(self, row: int, sentence: str) -> FileError:
        """Return an error at the line of a row."""
        return FileError(sentence, self.path, self.lines[row])

    def place(self, row: int) -> str:
        """Return where a row is, for the message about another one: `data.csv:12`."""
        return f"{self.path}:{self.lines[row]}"

    def number(self, name: str, row: int, cell: str, empty: bool) -> float:
        """Return one cell as a number, NaN for an empty one."""
        if not cell:
            if empty:
                return math.nan
            raise self.row_error(
                row, f"column {name!r} is empty, but every row needs it; write its value"
            )
        try:
            value = float(cell)
        except ValueError:
            value = None
        if value is None or "_" in cell:
            raise self.row_error(
                row,
                f"column {name!r} is {cell!r} where a number is needed; write it like 12.5 or 1e-3",
            )
        if not math.isfinite(value):
            raise self.row_error(
                row,
                f"column {name!r} is {cell!r}, which is not a finite number; leave empty what was "
                "not measured",
            )
        return value


def read_table(path: str | Path) -> Table:
    """Read a CSV table with its settings.

    Raises
    ------
    FileError
        Unreadable file, bad settings, no header, a header that cannot be read, no rows, rows of the
        wrong length.
    """
    path = Path(path)
    lines = [line.rstrip("\r") for line in read_text(path, WHAT, BY_PROFILE).split("\n")]
    settings, first = _settings(path, lines)
    numbered = [
        (i + 1, line)
        for i, line in enumerate(lines)
        if i >= first and line.strip() and not line.startswith("#")
    ]
    if not numbered:
        raise FileError(
            "this file has no header and no rows; the first line names the columns and their units",
            path,
        )
    header_line, header = numbered[0]
    if "," not in header and (";" in header or "\t" in header):
        found = "semicolons" if ";" in header else "tabs"
        raise FileError(
            f"columns are separated by {found}; use commas, and points in numbers{BY_PROFILE}",
            path,
            header_line,
        )
    units = _header(path, header_line, header)
    rows = tuple(_row(path, line, text, len(units)) for line, text in numbered[1:])
    if not rows:
        raise FileError(
            "this file has a header but no rows; add one row for each measured pose",
            path,
            header_line,
        )
    return Table(path, settings, header_line, units, rows, tuple(line for line, _ in numbered[1:]))


def meant(header: str, symbol: str | None, known: Iterable[str]) -> str:
    """Return ` (did you mean 'x [mm]'?)` where a header is a known name but for capitals or round
    brackets, else nothing.
    """
    found = _ROUND.match(header)
    plain, written = (
        (found["name"], found["unit"]) if found is not None and symbol is None else (header, symbol)
    )
    names = {name.casefold(): name for name in known}
    if plain.casefold() not in names:
        return ""
    name = names[plain.casefold()]
    return f" (did you mean {name if written is None else f'{name} [{written}]'!r}?)"


def require_columns(table: Table, needed: Sequence[str], why: str) -> None:
    """Raise for the first of the needed columns that the table lacks.

    Raises
    ------
    FileError
        A column is missing.
    """
    for name in needed:
        if name not in table.units:
            hints = [meant(other, symbol, [name]) for other, symbol in table.units.items()]
            hint = next(filter(None, hints), suggest_names(name, table.names))
            raise table.header_error(
                f"there is no column {name!r}{hint}, which {why}; add it with its unit"
            )


def quoted(text: str) -> str:
    """Return text as a cell, in quotes where it holds a comma, a quote or the mark of a remark."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"#') else text


def sidecar(path: Path) -> Path:
    """Return the name of the settings file beside a measurement file."""
    return path.with_suffix(".yaml")


def read_robot_name(path: str | Path) -> str | None:
    """Return the robot that a measurement file says it belongs to, None where it says none; raises
    FileError.
    """
    lines = [line.rstrip("\r") for line in read_text(path, WHAT, BY_PROFILE).split("\n")]
    found = _settings(Path(path), lines)[0].content.get("robot")
    return None if found is None else str(found).strip()


def _settings(path: Path, lines: Sequence[str]) -> tuple[YamlFile, int]:
    """Return the settings and the index of the first line behind the front matter."""
    count = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    beside = _beside(path, front=any(_SETTING.match(line) for line in lines[:count]))
    if beside is not None:
        return beside, 0
    text = "\n".join(line[1:] for line in lines[:count])
    # `# key: value` leaves one blank before each key, the same for all
    if not any(line.strip() and not line.strip().startswith("#") for line in text.splitlines()):
        return YamlFile(path, "", {}, {}), count
    try:
        return parse_yaml(text, path, "front matter"), count
    except FileError as error:
        advice = "lines that begin with # at the top are settings, '# key: value'; begin a remark with ##"
        raise FileError(f"{error.sentence} ({advice})", path, error.line) from None


def _beside(path: Path, front: bool) -> YamlFile | None:
    """Return the settings file beside a measurement file, if there is one; refuse it where there
    are settings in front.
    """
    beside = sidecar(path)
    if beside == path or not beside.exists():
        return None
    try:
        settings = read_yaml(beside, "settings file of the measurements")
    except FileError:
        if front:
            return None  # some other file of this name
        raise
    if "family" in settings.content:  # a robot file may have the same name as its measurements
        return None
    if not front:
        return settings
    if any(key in settings.content for key in SIDECAR_KEYS):
        raise FileError(
            f"there are settings at the top of this file and in {beside.name}; keep one of the two "
            "(a remark begins with ##)",
            path,
        )
    return None


def _header(path: Path, line: int, text: str) -> dict[str, str | None]:
    """Return name -> unit symbol of a header line."""
    units: dict[str, str | None] = {}
    for i, cell in enumerate(_cells(path, line, text)):
        found = _HEADER.match(cell)
        if found is None:
            raise FileError(
                f"column {i + 1} is headed {cell!r}; write a name and its unit, as 'x [mm]'",
                path,
                line,
            )
        name = found["name"]
        if name in units:
            raise FileError(
                f"column {name!r} stands here for the second time; keep one of the two", path, line
            )
        units[name] = found["unit"].strip() if found["unit"] is not None else None
    return units


def _row(path: Path, line: int, text: str, count: int) -> tuple[str, ...]:
    """Return the cells of a row, as many as the header has."""
    cells = _cells(path, line, text)
    if len(cells) != count:
        raise FileError(
            f"this row has {len(cells)} cells, but the header names {count} columns; "
            "write one cell for each, empty where nothing was measured, and points in numbers",
            path,
            line,
        )
    return cells


def _cells(path: Path, line: int, text: str) -> tuple[str, ...]:
    """Split one line at its commas."""
    try:
        return tuple(cell.strip() for cell in next(csv.reader([text], strict=True)))
    except csv.Error as error:
        raise FileError(
            f"this line is not CSV ({error}); close the quotes, or leave them out", path, line
        ) from None
