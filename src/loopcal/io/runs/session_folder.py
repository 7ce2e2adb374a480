# SPDX-License-Identifier: Apache-2.0
"""The folder of a session of measuring.

    rows.csv            each row as it was measured, and what was decided of it; only appended to
    measurements.csv    the rows that are used: the input of a calibration

A row is on the disk before the next one is asked for. A row that a crash cut off is removed when
the session is resumed. The file is locked, so that one command at a time adds to it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io.core import csv_table, text_file
from loopcal.io.data.columns import TIME
from loopcal.io.exports.conversion import Row, format_rows, read_rows
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.units import find_unit

ROWS, DATA = "rows.csv", "measurements.csv"
MEASURED, USED, LEFT_OUT, TAKEN_BACK = "measured", "used", "left out", "taken back"
"""What a line of rows.csv says of a row."""

REMARK = "## Rows as they were measured. Do not edit: measurements.csv is made from them."


@dataclass(frozen=True)
class Visit:
    """A measured row: its number, pose of the sheet, time (ISO 8601), and measured cells. `is_used`
    is None until the row is judged.
    """

    number: int
    pose: str
    time: str
    cells: Row
    is_used: bool | None = None


@dataclass
class Journal:
    """The open rows.csv of a session; `visits` without those that were taken back. measured : the
    cells of all rows, also of these.
    """

    path: Path
    sheet: csv_table.Table
    columns: tuple[str, ...]
    descriptor: int
    count: int = 0
    visits: list[Visit] = field(default_factory=list)
    measured: list[Row] = field(default_factory=list)

    def measure(self, pose: str, cells: Row) -> None:
        """Add a row; it is on the disk when this returns."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self._append(MEASURED, self.count + 1, pose, now, cells)

    def decide(self, event: str, number: int) -> None:
        """Use a row, leave it out, or take it back."""
        self._append(event, number, "", "", {})

    def _append(self, event: str, number: int, pose: str, time: str, cells: Row) -> None:
        line = [event, str(number), pose, time, *(cells.get(name, "") for name in self.columns)]
        write_line(self.descriptor, self.path, csv_table.format_row(line))
        self.enter(event, number, pose, time, cells)

    def enter(self, event: str, number: int, pose: str, time: str, cells: Row) -> None:
        """Do what a line says."""
        if event == MEASURED:
            self.visits.append(Visit(number, pose, time, cells))
            self.measured.append(cells)
            self.count = number
        elif event == TAKEN_BACK:
            self.visits = [visit for visit in self.visits if visit.number != number]
        else:
            self.visits = [
                replace(visit, is_used=event == USED) if visit.number == number else visit
                for visit in self.visits
            ]


def write_line(descriptor: int, path: Path, line: str) -> None:
    """Append a line to a file and write it to the disk, whole or not at all."""
    content, size = (line + "\n").encode(), os.fstat(descriptor).st_size
    with text_file.report_write_errors(path):
        try:
            if os.write(descriptor, content) < len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(descriptor)
        except OSError:
            os.ftruncate(descriptor, size)
            raise


@contextmanager
def open_session(folder: Path, sheet: csv_table.Table, columns: Sequence[str]) -> Iterator[Journal]:
    """Open the session in a folder for a sheet, or begin one; `columns` are measured.

    FileError : the folder cannot be written, is used by another command, has other content, or
    belongs to another sheet.
    """
    path, digest = text_file.resolve_links(folder) / ROWS, text_file.sha256(sheet.path)
    if folder.exists() and not path.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileError.of("session.other-content", folder)
    with text_file.report_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        if text_file.lock(descriptor) is False:
            raise FileError.of("session.in-use", folder)
        header = {"event": None, "row": None, "pose": None, TIME: None}
        header |= {name: sheet.units[name] for name in columns}
        lines = [
            REMARK,
            "# format: 1",
            f"# sheet: {digest}",
            csv_table.format_row(csv_table.format_header(header)),
        ]
        begin, content = "".join(f"{line}\n" for line in lines).encode(), path.read_bytes()
        if begin.startswith(content):  # nothing yet, or a header that was not written to its end
            os.ftruncate(descriptor, 0)
            write_line(descriptor, path, "\n".join(lines))
            text_file.sync_folder(path.parent)
        elif not content.startswith(REMARK.encode()):
            raise FileError.of("session.other-content", folder)
        elif not content.startswith(begin):
            raise FileError.of("session.other-sheet", path, sheet=str(sheet.path))
        elif not content.endswith(b"\n"):  # a row that was not written to its end
            os.ftruncate(descriptor, content.rfind(b"\n") + 1)
        journal = Journal(path, sheet, tuple(columns), descriptor)
        _read_journal(journal)
        yield journal
    finally:
        os.close(descriptor)


def _read_journal(journal: Journal) -> None:
    """Enter the lines of a file."""
    table = csv_table.read_template(journal.path)
    known = set(journal.sheet.pose_names())
    for row, cells in enumerate(table.rows):
        event, number, pose, time, *values = cells
        is_known = number.isdecimal() and (
            pose in known if event == MEASURED else event in (USED, LEFT_OUT, TAKEN_BACK)
        )
        if not is_known or len(values) != len(journal.columns):
            raise table.row_error(row, report_finding("session.line-damaged"))
        journal.enter(
            event, int(number), pose, time, dict(zip(journal.columns, values, strict=True))
        )


def name_visits(visits: Sequence[Visit], taken: Sequence[str]) -> list[str]:
    """Return a name for each visit: that of its pose, and of further ones with their number."""
    names: list[str] = []
    for visit in visits:
        name, count = visit.pose, 1
        while name in names or (count > 1 and name in taken):
            count += 1
            name = f"{visit.pose}-{count}"
        names.append(name)
    return names


def _list_rows(
    sheet: csv_table.Table, visits: Sequence[Visit]
) -> tuple[list[Row], dict[str, str | None]]:
    """Return the rows of visits with the columns of the sheet, and their header."""
    of_sheet = {
        cells["pose"]: cells
        for cells in (dict(zip(sheet.names, row, strict=True)) for row in sheet.rows)
    }
    names = name_visits(visits, sheet.pose_names())
    rows = [
        {**of_sheet[visit.pose], **visit.cells, "pose": name, TIME: visit.time}
        for name, visit in zip(names, visits, strict=True)
    ]
    return rows, {**sheet.units, TIME: None}


def read_visits(robot: Mechanism, sheet: csv_table.Table, visits: Sequence[Visit]) -> Measurements:
    """Return the measurements of visits, each a pose of its own; FileError for a wrong cell."""
    rows, header = _list_rows(sheet, visits)
    return read_rows(robot, sheet, rows, header)


def write_measurements(folder: Path, sheet: csv_table.Table, visits: Sequence[Visit]) -> None:
    """Write the used rows as the input of a calibration."""
    used = [visit for visit in visits if visit.is_used]
    if used:
        text_file.write_text(folder / DATA, format_rows(sheet, *_list_rows(sheet, used)))
    else:
        (folder / DATA).unlink(missing_ok=True)


def read_typed(word: str) -> str | None:
    """Return a typed number, also with a decimal comma; empty for `-`, None for what is none."""
    number = "" if word.strip() == "-" else word.strip().replace(",", ".", 1)
    return number if not number or csv_table.parse_finite(number) is not None else None


def split_values(text: str, count: int) -> tuple[str, list[str] | None]:
    """Return the pose that a typed line names, empty for none, and its `count` numbers; None where
    the line is no row. A `-` stands for a value that was not measured.

    Blanks, tabs or semicolons separate numbers, else commas; then a comma is a decimal mark.
    """
    words = [word.strip(",") for word in text.replace(";", " ").split()]
    if len(words) not in (count, count + 1):
        words = [word.strip() for word in text.split(",")]
    name = words[0] if len(words) == count + 1 else ""
    values = [value for word in words[bool(name) :] if (value := read_typed(word)) is not None]
    return name, values if len(values) == count == len(words) - bool(name) else None


def convert_cells(
    row: Row, units: Mapping[str, str | None], sheet: csv_table.Table, columns: Sequence[str]
) -> Row:
    """Return the measured cells of a row of an export in the units of the sheet."""
    cells: Row = {}
    for name in columns:
        cell, unit, wanted = row.get(name, ""), units.get(name), sheet.units[name]
        if cell and unit and wanted and unit != wanted:
            value = csv_table.parse_exact(cell, find_unit(unit).factor_to_si)
            cell = csv_table.format_exact(value, find_unit(wanted).factor_to_si)
        cells[name] = cell
    return cells
