# SPDX-License-Identifier: Apache-2.0
"""The lines of an export as cells, each under the header that stood last above it.

A line with other cells than its header is never read by it: where a decimal comma or a blank in a
name cuts a cell in two, every cell behind it would be taken for its neighbour.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.core.text_file import read_bytes
from loopcal.io.exports.profile import Profile


class Misfit(Exception):  # noqa: N818
    """A line that does not fit, with the reason; caught where the line is counted."""


@dataclass(frozen=True)
class Header:
    """A line that names columns: name -> place from 0, and how many cells it has."""

    places: Mapping[str, int]
    count: int


@dataclass(frozen=True)
class Line:
    """A line as cells, its number in the export, and the header above it, None where columns go by
    place only.
    """

    number: int
    cells: Sequence[str]
    header: Header | None


@dataclass
class Lines:
    """Lines that may be rows, and how many were passed over."""

    found: list[Line] = field(default_factory=list)
    passed: int = 0


def read_lines(path: Path, profile: Profile) -> Lines:
    """Split an export into cells; headers and what the profile passes over are counted.

    Raises
    ------
    FileError
        It cannot be read, is empty, or has not the header that the profile wants.
    """
    text = _decoded(path, profile)
    named = {p for source in profile.columns.values() for p in source.places if isinstance(p, str)}
    named |= {place for place in profile.matrix if isinstance(place, str)}
    lines, header, first = Lines(), None, None
    for i, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n")):
        nothing = not line.strip() or (
            profile.comment is not None and line.lstrip().startswith(profile.comment)
        )
        if (
            i < profile.skip
            or nothing
            or (profile.ignore is not None and profile.ignore.search(line))
        ):
            lines.passed += bool(line.strip())
            continue
        cells = _cells(line, profile.delimiter)
        if named and named <= set(cells):
            header = _header(path, i + 1, cells, named)
        elif not named or header is not None:
            lines.found.append(Line(i + 1, cells, header))
            continue
        first = first or (i + 1, cells)
        lines.passed += 1
    if named and header is None:
        wanted, number = ", ".join(sorted(named)), first[0] if first else None
        seen = f"; this line, the first, has {' | '.join(first[1])!r}" if first else ""
        raise FileError(
            f"no line names the columns {wanted}, as {profile.file.path} says{seen}", path, number
        )
    return lines


def check_count(line: Line, delimiter: str | None) -> None:
    """Refuse a line that has not the cells of its header: Misfit.

    One separator at the end of a line is no cell. Fewer cells are cells left out at the end, but
    not where commas or blanks, which stand in numbers and names, too, separate them.
    """
    if line.header is None:
        return
    wanted = line.header.count
    count = _count(line.cells, wanted)
    if count > wanted or (count < wanted and delimiter in {None, ","}):
        why = (
            "a separator within a number or a name"
            if count > wanted
            else "one left out, or one cut in two"
        )
        raise Misfit(f"it has {_counted(count)}, but the header has {wanted} columns ({why})")


def unlike_most(lines: Sequence[Line]) -> list[tuple[int, str]]:
    """Return number and reason of lines that have not as many cells as most, where no header says
    how many there are.
    """
    placed = [line for line in lines if line.header is None]
    counts = Counter(len(line.cells) for line in placed)
    most = max(counts, key=lambda count: (counts[count], -count), default=0)
    return [
        (line.number, f"it has {_counted(_count(line.cells, most))}, but most lines have {most}")
        for line in placed
        if _count(line.cells, most) != most
    ]


def _count(cells: Sequence[str], wanted: int) -> int:
    """Return the number of cells; one separator at the end, behind as many as are wanted, is no
    cell.
    """
    return len(cells) - (len(cells) > wanted and not cells[-1])


def _counted(count: int) -> str:
    return f"{count} cell{'' if count == 1 else 's'}"


def _decoded(path: Path, profile: Profile) -> str:
    """Return the text of the export."""
    raw = read_bytes(path, "export")
    try:
        text = raw.decode(profile.encoding)
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        sentence = f"byte 0x{raw[error.start]:02x} is not {profile.encoding} text; state 'encoding' in the profile"
        raise FileError(sentence, path, line) from None
    except UnicodeError as error:
        raise FileError(
            f"this is not {profile.encoding} text ({error}); state 'encoding' in the profile", path
        ) from None
    if not text.strip():
        raise FileError("this export is empty; export it again", path)
    return text


def _header(path: Path, number: int, cells: Sequence[str], named: set[str]) -> Header:
    """Return where the columns are; FileError where one is there twice."""
    for name in sorted(named):
        if cells.count(name) > 1:
            raise FileError(
                f"two columns are headed {name!r}; name it by its place in the profile",
                path,
                number,
            )
    return Header({cell: place for place, cell in reversed(list(enumerate(cells)))}, len(cells))


def _cells(line: str, delimiter: str | None) -> list[str]:
    """Split a line."""
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return [line]  # longer than any cell may be
