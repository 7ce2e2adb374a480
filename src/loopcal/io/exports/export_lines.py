# SPDX-License-Identifier: Apache-2.0
"""The lines of an export as cells, each with the header that applies to it.

A line with another number of cells than its header is never read: where a decimal comma or a blank
in a name splits a cell, all later cells would be read as those of the next column.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from loopcal.errors import FileError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.limits import LINE_LENGTH, TABLE_ROWS, TABLE_SIZE
from loopcal.io.core.text_file import read_bytes
from loopcal.io.exports.patterns import PatternClock
from loopcal.io.exports.profile import Profile, normalize_name
from loopcal.plain_text import quote


class Misfit(Exception):  # noqa: N818
    """A line that does not fit, with the reason; caught where such lines are collected."""


@dataclass(frozen=True)
class Header:
    """A line that names columns: name -> place from 0, and its number of cells."""

    places: Mapping[str, int]
    count: int


@dataclass(frozen=True)
class Line:
    """A line as cells, its number in the export, and its header; None where only places count."""

    number: int
    cells: Sequence[str]
    header: Header | None


def read_lines(path: Path, profile: Profile, clock: PatternClock) -> tuple[list[Line], int]:
    """Return the lines of an export that may be rows, and the number of lines without data.

    Headers and lines that the profile skips have no data.

    Raises
    ------
    FileError : unreadable, empty, or without the header that the profile needs.
    """
    record = profile.record
    sources = [place for source in profile.columns.values() for place in source.places]
    named = {place for place in (*sources, *record.matrix_places) if isinstance(place, str)}
    lines: list[Line] = []
    header, nearest, skipped = None, None, 0
    text = _decode(path, profile).replace("\r\n", "\n").replace("\r", "\n")
    TABLE_ROWS.check(text.count("\n"), "export", path)
    for number, line in enumerate(text.split("\n"), 1):
        LINE_LENGTH.check(len(line), "export", path, number)
        is_comment = record.comment is not None and line.lstrip().startswith(record.comment)
        ignored = profile.ignored
        is_ignored = ignored is not None and clock.search(ignored, line, ("ignore",))
        if number <= record.skip or not line.strip() or is_comment or is_ignored:
            skipped += bool(line.strip())
            continue
        cells = _split(line, profile.delimiter)
        names = [normalize_name(cell) for cell in cells] if named else []
        if named and named <= set(names):
            header = _parse_header(path, number, names, named)
        elif not named or header is not None:
            lines.append(Line(number, cells, header))
            continue
        count = len(named & set(names))
        if nearest is None or count > nearest[0]:
            nearest = (count, number, names)
        skipped += 1
    if named and header is None:
        _refuse_header(path, profile, named, nearest)
    return lines, skipped


def _refuse_header(
    path: Path, profile: Profile, named: set[str], nearest: tuple[int, int, list[str]] | None
) -> NoReturn:
    """Raise FileError for an export without the header of a profile.

    `nearest` : the first of the lines with the most of these names: their count, number and cells.
    """
    if nearest is None or nearest[0] == 0:
        names, number = ", ".join(sorted(named)), None if nearest is None else nearest[1]
        sentence = f"no line names the columns {names} of {profile.file.path}"
        raise FileError(f"{sentence}; correct the profile", path, number)
    _, number, cells = nearest
    known = {cell.casefold(): cell for cell in reversed(cells) if cell}
    missing = []
    for name in sorted(named - set(cells)):
        same = known.get(name.casefold())
        close = f" (did you mean {same!r}?)" if same else suggest_names(name, known.values())
        missing.append(f"{name!r}{close}")
    finding = report_finding(
        "files.export-column-missing",
        profile=str(profile.file.path),
        missing=tuple(missing),
        columns=tuple(quote(cell)[1:-1] for cell in cells if cell),
    )
    raise FileError(finding, path, number)


def check_count(line: Line, delimiter: str | None) -> None:
    """Raise Misfit for a line with another number of cells than its header.

    One separator at the end of a line is not a cell. Fewer cells mean that cells at the end are
    left out, except where commas or blanks separate them, which also occur in numbers and names.
    """
    if line.header is None:
        return
    wanted = line.header.count
    count = _count(line.cells, wanted)
    if count > wanted:
        reason = "a separator within a number or a name"
    elif count < wanted and delimiter in {None, ","}:
        reason = "one is missing, or a number or a name is split"
    else:
        return
    raise Misfit(f"it has {_count_cells(count)}, but the header has {wanted} columns ({reason})")


def find_unusual_lines(lines: Sequence[Line]) -> dict[int, str]:
    """Return number -> reason of lines without a header that have another length than most."""
    placed = [line for line in lines if line.header is None]
    counts = Counter(len(line.cells) for line in placed)
    most = max(counts, key=lambda count: (counts[count], -count), default=0)
    return {
        line.number: f"it has {_count_cells(count)}, but most lines have {most}"
        for line in placed
        if (count := _count(line.cells, most)) != most
    }


def _count(cells: Sequence[str], wanted: int) -> int:
    """Return the number of cells; one separator behind the wanted cells is not a cell."""
    return len(cells) - (len(cells) > wanted and not cells[-1])


def _count_cells(count: int) -> str:
    return f"{count} cell{'' if count == 1 else 's'}"


def _decode(path: Path, profile: Profile) -> str:
    """Return the text of the export."""
    raw = read_bytes(path, "export", TABLE_SIZE)
    act = "state its 'encoding' in the profile"
    try:
        text = raw.decode(profile.encoding)
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        sentence = f"byte 0x{raw[error.start]:02x} is not {profile.record.encoding} text; {act}"
        raise FileError(sentence, path, line) from None
    except UnicodeError as error:
        raise FileError(
            f"this is not {profile.record.encoding} text ({error}); {act}", path
        ) from None
    if not text.strip():
        raise FileError("this export is empty; export it again", path)
    return text


def _parse_header(path: Path, number: int, cells: Sequence[str], named: set[str]) -> Header:
    """Return the places of the columns; FileError where a needed name occurs twice."""
    for name in sorted(named):
        if cells.count(name) > 1:
            sentence = f"duplicate column {name!r}; name it by its place in the profile"
            raise FileError(sentence, path, number)
    return Header({cell: place for place, cell in reversed(list(enumerate(cells)))}, len(cells))


def _split(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells."""
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return [line]  # longer than any cell may be
