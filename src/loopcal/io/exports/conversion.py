# SPDX-License-Identifier: Apache-2.0
"""From an export to the text of a measurement file; numbers keep their digits.

Every line becomes part of a row, is skipped by the profile (blank, comment, header, ...), or does
not fit. Lines that do not fit are listed with the reason.

Where the lines of all targets of a pose become one row, values, sigma, covariance and remarks
belong to a target and get a column for each target. Readings belong to the pose and are the same in
all of its lines. Lines that differ in anything else have rows of their own, except for the time: a
row has the time of its first line.

The data sheet of a plan states poses, readings and the instrument. Points are joined with it by
their names, or by their order: all targets of the first pose, then those of the second, and so on.
Before it is written, the points are to be examined:
`loopcal.diagnose.measured_points.examine_points`.
"""

from __future__ import annotations

import csv
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import regex

from loopcal import geometry
from loopcal.errors import FileError, suggest_names
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import name_count
from loopcal.io.core import limits
from loopcal.io.core.csv_table import (
    NAME_COLUMNS,
    Cells,
    Table,
    format_header,
    format_row,
    parse_finite,
    read_table,
    refuse_settings_beside,
    require_columns,
)
from loopcal.io.core.text_file import as_path, read_bytes, read_text, write_text
from loopcal.io.core.yaml_file import format_flow
from loopcal.io.data.columns import COVARIANCE, LINK, MEASURED, NOTE, SIGMA, TIME, USE_COLUMN
from loopcal.io.data.kind_settings import KindRows, read_kinds
from loopcal.io.data.measurement_file import FORMAT, join_tables, read_tables
from loopcal.io.exports.profile import (
    DELIMITERS,
    ColumnSource,
    PatternClock,
    Place,
    Profile,
    check_columns,
    normalize_name,
)
from loopcal.measure.kinds.position import name_point
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.plain_text import quote

# The lines of an export as cells, each with the header that applies to it.


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


def read_lines(
    path: Path, profile: Profile, clock: PatternClock, content: bytes | None = None
) -> tuple[list[Line], int]:
    """Return the lines of an export that may be rows, and the number of lines without data: headers
    and those that the profile skips. FileError : unreadable, empty, or without the header.
    """
    record = profile.record
    ignored = None if record.ignore is None else regex.compile(record.ignore)
    by_target = profile.columns_by_target.values()
    sources = [p for columns in by_target for source in columns.values() for p in source.places]
    named = {place for place in (*sources, *record.matrix) if isinstance(place, str)}
    lines: list[Line] = []
    header, nearest, skipped = None, None, 0
    text = _decode(path, profile, content).replace("\r\n", "\n").replace("\r", "\n")
    limits.TABLE_ROWS.check(text.count("\n"), "export", path)
    for number, line in enumerate(text.split("\n"), 1):
        limits.LINE_LENGTH.check(len(line), "export", path, number)
        is_comment = record.comment is not None and line.lstrip().startswith(record.comment)
        is_ignored = ignored is not None and clock.match(ignored.search, line, ("ignore",))
        if number <= record.skip or not line.strip() or is_comment or is_ignored:
            skipped += bool(line.strip())
            continue
        cells = _split(line, profile.delimiter)
        names = [normalize_name(cell) for cell in cells] if named else []
        if named and named <= set(names):
            for name in sorted(named):
                if names.count(name) > 1:
                    sentence = f"duplicate column {name!r}. Name it by its place in the profile"
                    raise FileError(sentence, path, number)
            places = {name: place for place, name in reversed(list(enumerate(names)))}
            header = Header(places, len(names))
        elif not named or header is not None:
            lines.append(Line(number, cells, header))
            continue
        for other, mark in DELIMITERS.items() if header is None else ():
            if named <= set(map(normalize_name, _split(line, mark))):
                raise FileError.of(
                    "files.export-separator",
                    path,
                    number,
                    profile=str(profile.file.path),
                    found=other,
                    wanted=record.delimiter,
                )
        count = len(named & set(names))
        if nearest is None or count > nearest[0]:
            nearest = (count, number, names)
        skipped += 1
    if named and header is None:
        _refuse_header(path, profile, named, nearest)
    return lines, skipped


def _report_unused(line: Line, profile: Profile) -> tuple[Finding, ...]:
    """Return which columns of a line the profile does not use: names of a header, or numbers."""
    places = (of.places for each in profile.columns_by_target.values() for of in each.values())
    used = {*itertools.chain(*places), *profile.record.matrix}
    numbers = {str(i + 1): i for i in range(len(line.cells))}
    names = numbers if line.header is None else line.header.places
    ordered = sorted(names, key=names.__getitem__)
    unused = [name for name in ordered if name and not {name, names[name] + 1} & used]
    return (report_finding("files.export-columns-unused", columns=unused),) if unused else ()


def _refuse_header(
    path: Path, profile: Profile, named: set[str], nearest: tuple[int, int, list[str]] | None
) -> NoReturn:
    """Raise FileError for an export without the header of a profile.

    `nearest` : the first of the lines with the most of these names: their count, number and cells.
    """
    if nearest is None or nearest[0] == 0:
        names, number = ", ".join(sorted(named)), None if nearest is None else nearest[1]
        sentence = f"no line names the columns {names} of {profile.file.path}"
        raise FileError(f"{sentence}. Correct the profile", path, number)
    _, number, cells = nearest
    known = {cell.casefold(): cell for cell in reversed(cells) if cell}
    missing = []
    for name in sorted(named - set(cells)):
        same = known.get(name.casefold())
        close = f" (did you mean {same!r}?)" if same else suggest_names(name, known.values())
        missing.append(f"{name!r}{close}")
    raise FileError.of(
        "files.export-column-missing",
        path,
        number,
        profile=str(profile.file.path),
        missing=tuple(missing),
        columns=tuple(quote(cell)[1:-1] for cell in cells if cell),
    )


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
    raise Misfit(
        f"it has {name_count(count, 'cell')}, but the header has {wanted} columns ({reason})"
    )


def _count(cells: Sequence[str], wanted: int) -> int:
    """Return the number of cells; one separator behind the wanted cells is not a cell."""
    return len(cells) - (len(cells) > wanted and not cells[-1])


def _decode(path: Path, profile: Profile, content: bytes | None) -> str:
    """Return the text of the export."""
    raw = read_bytes(path, "export", limits.TABLE_SIZE) if content is None else content
    act = "Give its 'encoding' in the profile"
    try:
        text = raw.decode(profile.encoding)
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        sentence = f"byte 0x{raw[error.start]:02x} is not {profile.record.encoding} text. {act}"
        raise FileError(sentence, path, line) from None
    except UnicodeError as error:
        raise FileError(
            f"this is not {profile.record.encoding} text ({error}). {act}", path
        ) from None
    if not text.strip():
        raise FileError("this export is empty. Export it again", path)
    return text


def _split(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells."""
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return [line]  # longer than any cell may be


Row = dict[str, str]
"""Column -> cell."""


def _join_rows(
    lines: Sequence[tuple[Line, Row]], profile: Profile
) -> tuple[list[Row], list[tuple[int, str]], tuple[Finding, ...]]:
    """Return rows in the order of their first lines, lines that do not fit, and what rows lose."""
    rows: list[Row] = []
    misfits: list[tuple[int, str]] = []
    readings: dict[str, Row] = {}
    other_times = 0
    placed = [line for line, _ in lines if line.header is None]
    counts = Counter(len(line.cells) for line in placed)
    most = max(counts, key=lambda count: (counts[count], -count), default=0)
    for line, row in lines:
        try:
            if line.header is None and (count := _count(line.cells, most)) != most:
                raise Misfit(f"it has {name_count(count, 'cell')}, but most lines have {most}")
            shared, values = _split_row(row, profile)
            known = readings.get(row["pose"], {}) if values else {}
            for name, before in known.items():
                if shared[name] and not _is_equal(shared[name], before):
                    sentence = f"{name!r} is {shared[name]} here, but {before} in an earlier line"
                    raise Misfit(f"{sentence} of the pose {row['pose']!r}")
        except Misfit as error:
            misfits.append((line.number, str(error)))
            continue
        last = rows[-1] if rows else {}
        if values:
            stated = {n: shared[n] for n in profile.record.readings if shared[n]}
            readings[row["pose"]] = stated | readings.get(row["pose"], {})
        if not values or any(name in last for name in values) or not _agree(last, shared):
            rows.append(shared | values)
            continue
        other_times += bool(last.get(TIME) and shared.get(TIME) and last[TIME] != shared[TIME])
        added = {name: cell for name, cell in shared.items() if not last.get(name)}
        rows[-1] = last | values | added
    if not other_times:
        return rows, misfits, ()
    return rows, misfits, (report_finding("files.other-times", count=other_times),)


def _split_row(row: Row, profile: Profile) -> tuple[Row, Row]:
    """Return the cells of a line for its pose and for one target; Misfit where it is unknown."""
    targets = profile.targets
    if "target" not in row or not targets:
        return row, {}
    target = row["target"]
    if target not in targets and (target or len(targets) > 1):
        if not target:
            raise Misfit(f"it names the pose {quote(row['pose'])}, but no target")
        raise Misfit(f"the target {quote(target)} is not one of {', '.join(targets)}")
    shared = {name: cell for name, cell in row.items() if name != "target"}
    if len(targets) == 1:
        return shared, {}
    names = [name for name in shared if _belongs_to_target(name, profile)]
    return shared, {_add_target(name, target): shared.pop(name) for name in names}


def list_headers(profile: Profile) -> dict[str, str | None]:
    """Return column -> unit of the measurement file, None for text."""
    units = {name: source.symbol for name, source in profile.columns.items() if name != "pose"}
    units |= {name: "1" for name in ("qw", "qx", "qy", "qz") if profile.record.matrix}
    first: dict[str, str | None] = {"pose": None}
    if len(profile.targets) < 2:
        stated = ((name, MEASURED + name) for name in profile.measured)
        measured = [own if own in profile.columns else name for name, own in stated]
        others = {n: u for n, u in units.items() if n not in measured}
        return first | others | {n: units[n] for n in measured}
    shared = {n: u for n, u in units.items() if not _belongs_to_target(n, profile)}
    beside = [n for n in units if n not in shared and n not in profile.measured]
    pairs = [(name, target) for target in profile.targets for name in profile.measured]
    pairs += [(name, target) for name in beside for target in profile.targets]
    return first | shared | {_add_target(name, target): units[name] for name, target in pairs}


def _belongs_to_target(name: str, profile: Profile) -> bool:
    """Return whether a column belongs to a target, not to the pose."""
    return name.removeprefix(SIGMA) in profile.measured or name.startswith((COVARIANCE, NOTE))


def _add_target(name: str, target: str) -> str:
    """Return the name of a column of one of several targets."""
    if name.startswith(NOTE):
        return f"{name} {target}"
    if name.startswith(COVARIANCE):
        factors = name.removeprefix(COVARIANCE).split(".")
        return COVARIANCE + ".".join(f"{target}.{factor}" for factor in factors)
    if name.startswith(SIGMA):
        return f"{SIGMA}{target}.{name.removeprefix(SIGMA)}"
    return f"{target}.{name}"


def _agree(last: Mapping[str, str], row: Mapping[str, str]) -> bool:
    """Return whether two lines agree in pose, session, group and block, and all but the time."""
    if any(last.get(name) != row.get(name) for name in ("pose", "session", "group", "block")):
        return False
    common = [name for name in row if name != TIME and last.get(name) and row[name]]
    return all(_is_equal(last[name], row[name]) for name in common)


def _is_equal(cell: str, other: str) -> bool:
    """Return whether two cells are the same, numbers by their value."""
    value = parse_finite(cell)
    return cell == other or (value is not None and value == parse_finite(other))


# Accepted deviation of an exported matrix from a rotation [1]: the rounding of four decimals.
ROTATION_ERROR = 1e-3
QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Conversion:
    """The result of converting an export.

    text : the measurement file. table : its header and rows.
    passed : number of lines without data.
    misfits : lines that do not fit the profile, with the reason.
    findings : differences between lines of a pose that the file does not keep.
    """

    text: str
    table: tuple[tuple[str, ...], ...]
    passed: int
    misfits: tuple[tuple[int, str], ...]
    findings: tuple[Finding, ...] = ()

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.table) - 1


def convert_export(
    path: str | Path,
    profile: Profile,
    pattern_seconds: float = limits.PATTERN_SECONDS.most,
    content: bytes | None = None,
) -> Conversion:
    """Convert an export; the patterns of the profile may take `pattern_seconds`, else FileError.

    content : the part of the export to convert; by default the whole file.
    FileError : unreadable, without the header that the profile needs, or no line fits.
    """
    path = as_path(path, "export")
    clock = PatternClock(profile.file, pattern_seconds)
    read, skipped = read_lines(path, profile, clock, content)
    fitting, misfits = [], []
    for line in read:
        try:
            check_count(line, profile.delimiter)
            of_targets = {
                target: _parse_row(line, profile, columns, clock)
                for target, columns in profile.columns_by_target.items()
            }
            fitting += [(line, r | {"target": t} if t else r) for t, r in of_targets.items()]
        except Misfit as error:
            misfits.append((line.number, str(error)))
    rows, others, findings = _join_rows(fitting, profile)
    misfits += others
    misfits.sort()
    if not rows:
        if not misfits:
            raise FileError.of("files.export-without-rows", path)
        number, reason = misfits[0]
        sentence = f"no line of this export fits {profile.file.path}"
        if read[0].header is None and not fitting:
            # nothing shows that the profile is meant for this file, which may contain secrets
            raise FileError(f"{sentence}. Compare the first one with the profile", path, number)
        raise FileError(f"{sentence}; reason for the first one: {reason}", path, number)
    findings += _report_unused(fitting[0][0], profile)
    settings = {"format": FORMAT, **profile.record.settings}
    remark = limits.format_comment(f"converted from {path.name} by {profile.file.path.name}")
    lines = [f"## {remark}"]
    if misfits:
        lines.append(f"## lines that do not fit: {', '.join(str(number) for number, _ in misfits)}")
    lines += [f"## {limits.format_comment(str(finding))}" for finding in findings]
    lines += [f"# {key}: {format_flow(value)}" for key, value in settings.items()]
    columns = list_headers(profile)
    # a target without a line has no covariance
    absent = {name: "0" if name.startswith(COVARIANCE) else "" for name in columns}
    numbered = [{**absent, "pose": str(i), **row} for i, row in enumerate(rows, 1)]
    table = (format_header(columns), *(tuple(row[n] for n in columns) for row in numbered))
    text = "\n".join([*lines, *map(format_row, table)]) + "\n"
    return Conversion(text, table, skipped, tuple(misfits), findings)


def save_converted(text: str, path: str | Path) -> None:
    """Write the measurement file that became of an export."""
    refuse_settings_beside(Path(path))
    write_text(path, text)


def _parse_row(
    line: Line, profile: Profile, columns: Mapping[str, ColumnSource], clock: PatternClock
) -> Row:
    """Return column -> cell of one line, with `target` where the name states it; raise Misfit."""
    row: Row = {}
    for name, source in columns.items():
        cells = [_get_cell(line, place) for place in source.places]
        if source.symbol is not None:
            number = _parse_number(cells[0], profile, name)
            row[name] = _scale_sigma(number, source, name) if name.startswith(SIGMA) else number
            continue
        text = " ".join("" if cell in profile.missing else cell for cell in cells).strip()
        if source.pattern is not None:
            match = clock.match(source.pattern.fullmatch, text, ("columns", "pose", "match"))
            if match is None:
                raise Misfit(f"the name {quote(text)} does not match {source.pattern.pattern}")
            groups = match.groupdict("")
            row |= {k: groups[k].strip() for k in ("pose", "target") if k in groups}
        else:
            row[name] = limits.make_name(text) if name.startswith(NOTE) else text
            row[name] = _parse_time(text, source) if name == TIME else row[name]
    if (use := row.get(USE_COLUMN.name, "")) not in ("", *USE_COLUMN.choices):
        raise Misfit(f"the use {quote(use)} is not {' or '.join(USE_COLUMN.choices)}")
    for name in NAME_COLUMNS:
        if (fault := limits.find_fault(row.get(name, ""))) is not None:
            raise Misfit(str(fault))
    if "pose" in profile.columns and (not row["pose"] or LINK in row["pose"]):
        raise Misfit(
            f"{quote(row['pose'])} is not a name of a pose: it is empty or contains {LINK!r}"
        )
    if profile.record.matrix:
        cells = (_get_cell(line, place) for place in profile.record.matrix)
        row |= _to_quaternion([_parse_number(cell, profile, "matrix") for cell in cells])
    return row


def _get_cell(line: Line, place: Place) -> str:
    """Return a cell by the name in the header, or by its place."""
    if isinstance(place, str) and line.header is not None:
        index, name = line.header.places[place], f"{place!r} is column"
    else:
        index, name = int(place) - 1, "the profile needs column"
    if index >= len(line.cells):
        raise Misfit(f"it has {len(line.cells)} columns, but {name} {index + 1}")
    return line.cells[index]


def _parse_number(text: str, profile: Profile, name: str) -> str:
    """Return a finite number with a decimal point and its own digits; "" where it is missing."""
    if not text or text in profile.missing:
        return ""
    if (value := profile.parse(text)) is None:
        raise Misfit(f"{quote(text)} is not a number for {name!r}")
    is_missing = any(profile.parse(number) == value for number in profile.missing)
    return "" if is_missing else profile.with_point(text)


def _scale_sigma(text: str, source: ColumnSource, name: str) -> str:
    """Return a standard deviation times its factor, not below its floor; "" where it is missing."""
    if not text:
        return ""
    scaled = Decimal(text) * Decimal(repr(source.factor))
    if scaled < 0:
        act = "List this number under 'missing' if it means unknown"
        raise Misfit(f"{name!r} is {text}, but no standard deviation is negative. {act}")
    if scaled < Decimal(source.least):
        return source.least
    if scaled <= 0:
        raise Misfit(f"{name!r} is {text}, but must be positive. Give a 'floor' in the profile")
    return text if source.factor == 1.0 else f"{scaled.normalize():.17g}"


def _parse_time(text: str, source: ColumnSource) -> str:
    """Return a date and time in ISO 8601."""
    if not text:
        return ""
    try:
        if source.format is None:
            return datetime.fromisoformat(text).isoformat()
        return datetime.strptime(text, source.format).isoformat()
    except ValueError:
        wanted = source.format or "ISO 8601, such as 2026-05-04T10:22:31"
        raise Misfit(f"the time {quote(text)} does not have the format {wanted}") from None


def _to_quaternion(cells: Sequence[str]) -> Row:
    """Return the quaternion of a rotation matrix, row by row; empty where the matrix is missing."""
    if not all(cells):
        if any(cells):
            raise Misfit("part of the rotation matrix is missing")
        return dict.fromkeys(QUATERNION, "")
    matrix = np.array([float(c) for c in cells]).reshape(3, 3)
    error = float(geometry.measure_rotation_error(matrix))
    if error > ROTATION_ERROR:
        raise Misfit(f"the nine numbers are not a rotation matrix (error {error:.2g})")
    R = geometry.project_to_rotations(matrix)
    quaternion = (repr(float(q)) for q in geometry.matrix_to_quaternion(R))
    return dict(zip(QUATERNION, quaternion, strict=True))


# The data sheet of a plan, filled in from the exports of an instrument.


@dataclass(frozen=True)
class FilledSheet:
    """A sheet with the points of an export.

    text : the measurement file.
    misfits : export, line and reason of lines that do not match the profile.
    data : the measurements, for checks before the file is written. unit : of the points.
    findings : what is filled in, missing, unknown or repeated.
    """

    text: str
    misfits: tuple[tuple[str, int, str], ...]
    data: Measurements
    unit: str
    findings: tuple[Finding, ...]


def fill_sheet(
    robot: Mechanism,
    sheet: str | Path,
    exports: Sequence[str | Path],
    profile: Profile,
    *,
    by_order: bool = False,
    has_one_session: bool = False,
) -> FilledSheet:
    """Fill in a sheet.

    robot : whose poses the sheet lists. sheet : data file of a plan, without measured values.
    exports : of the instrument. Several are one session each, named after their files, unless
        `has_one_session` says that the instrument stood still.
    profile : how they are read; kind, targets and noise are those of the sheet.
    by_order : join points by their order, not by their names.
    FileError : a file cannot be read, or no name or another number of points matches.
    """
    table, entry = read_sheet(Path(sheet), robot)
    columns = [column.name for column in entry.kind.columns]
    targets = tuple(getattr(entry.kind, "targets", ())) or ("",)
    filled: dict[str, list[Row]] = {}
    units: dict[str, str | None] = {}
    misfits: list[tuple[str, int, str]] = []
    unknown: list[str] = []
    identical: list[str] = []
    has_sessions, poses = len(exports) > 1 and not has_one_session, set(table.pose_names())
    for export in exports:
        of_export, rows = read_points(Path(export), profile, entry, by_order, misfits)
        for name, unit in of_export.items():  # the profile is one
            if units.setdefault(name, unit) != unit:
                sentence = f"column {name!r} has another unit than in the first export"
                raise FileError(sentence, Path(export))
        if has_sessions:
            units.setdefault("session", None)
        for pose, row in _name_rows(rows, entry, table, by_order, Path(export)):
            if pose not in poses:
                unknown += [name_point(pose, t, targets) for t in _list_measured(row, targets)]
                continue
            cells = {"session": Path(export).stem, **row} if has_sessions else row
            if _add_row(filled.setdefault(pose, []), cells, columns):
                identical += [name_point(pose, t, targets) for t in _list_measured(row, targets)]
    if not filled:
        wanted = [name_point(p, t, targets) for p in table.pose_names() for t in targets]
        facts: dict[str, Any] = {"exported": _shorten(unknown), "wanted": _shorten(wanted)}
        raise FileError.of("sheet.no-name-matches", Path(exports[0]), **facts)
    findings = _report_counts(table, filled, targets)
    for code, names in (("points-unknown", unknown), ("points-identical", identical)):
        if names:
            findings.append(report_finding(f"sheet.{code}", names=tuple(dict.fromkeys(names))))
    body = list(_merge(table, filled, units, columns))
    # columns of the sheet, measured ones with the unit of the export, then further ones
    header = {n: units.get(n, u) if n in columns else u for n, u in table.units.items()}
    header |= {name: unit for name, unit in units.items() if name not in header}
    data = read_rows(robot, table, body, header)
    source = " and ".join(map(str, exports))  # the file whose values a check doubts
    data = replace(data, observations=tuple(replace(o, source=source) for o in data.observations))
    unit = next((units.get(name) for name in columns if units.get(name)), None) or "mm"
    return FilledSheet(
        format_rows(table, body, header), tuple(misfits), data, unit, tuple(findings)
    )


def format_rows(table: Table, body: Sequence[Row], header: Mapping[str, str | None]) -> str:
    """Return the text of the measurement file of rows with the settings of a sheet."""
    text = read_text(table.path, "sheet").lstrip("\ufeff")  # whose lines end as those of a table
    above = (line.rstrip("\r") for line in text.split("\n")[: table.header_line - 1])
    lines = [line for line in above if line.strip()]
    cells = ([row.get(name, "") for name in header] for row in body)
    return "\n".join([*lines, *map(format_row, (format_header(header), *cells))]) + "\n"


def read_sheet(path: Path, robot: Mechanism) -> tuple[Table, KindRows]:
    """Return the sheet and its only kind; FileError where it has measured values or other rows."""
    table = read_table(path)
    require_columns(table, ("pose",), "to join the points of an export with")
    kinds = read_kinds(table, robot)
    one = kinds[0].kind if len(kinds) == 1 and "kinds" not in table.settings.content else None
    if one is None or one.poses_per_row != 1 or one.label_count:
        raise FileError.of("sheet.kinds", path, count=len(kinds))
    names = [column.name for column in kinds[0].kind.columns]
    for row, cells in enumerate(zip(*(table.text(name) for name in names), strict=True)):
        if any(cells):
            raise table.row_error(row, report_finding("sheet.already-filled"))
    return table, kinds[0]


def read_points(
    export: Path,
    profile: Profile,
    entry: KindRows,
    by_order: bool,
    misfits: list[tuple[str, int, str]],
    content: bytes | None = None,
) -> tuple[Mapping[str, str | None], list[Row]]:
    """Return the units of the columns of an export or its `content`, and rows; add misfits."""
    kind, record = entry.kind, replace(profile.record, settings={})
    targets = tuple(getattr(kind, "targets", ()))
    if by_order:
        columns = {name: of for name, of in record.columns.items() if name != "pose"}
        record = replace(record, columns=columns)
        if len(targets) > 1:
            kind = replace(kind, targets=("point",), places=None)  # pyright: ignore[reportCallIssue]
    mine = replace(profile, record=record, kind=kind)
    check_columns(mine)
    conversion = convert_export(export, mine, content=content)
    misfits += [(str(export), line, reason) for line, reason in conversion.misfits]
    units = {name: unit for name, unit in list_headers(mine).items() if name != "pose"}
    rows = [dict(zip(("pose", *units), cells, strict=True)) for cells in conversion.table[1:]]
    if not by_order or len(targets) < 2:
        return units, rows
    k, measured = len(targets), {column.name for column in kind.columns}
    own: dict[str, str | None] = {}
    for i, row in enumerate(rows):
        named = {n: f"{targets[i % k]}.{n}" if n in measured else n for n in units}
        own |= {named[name]: unit for name, unit in units.items()}
        rows[i] = {named[name]: row[name] for name in units}
    return own, rows


def _name_rows(
    rows: Sequence[Row], entry: KindRows, table: Table, by_order: bool, export: Path
) -> list[tuple[str, Row]]:
    """Return the rows of an export by pose; FileError where their number differs from the sheet."""
    if not by_order:
        return [(row.pop("pose"), row) for row in rows]
    poses, k = table.pose_names(), max(len(getattr(entry.kind, "targets", ())), 1)
    if len(rows) != len(poses) * k:
        counts: dict[str, Any] = {"wanted": len(poses) * k, "poses": len(poses)}
        counts |= {"targets": k, "count": len(rows)}
        raise FileError.of("sheet.count-differs", export, **counts)
    return [
        (poses[i // k], {n: c for n, c in row.items() if n != "pose"}) for i, row in enumerate(rows)
    ]


def _add_row(rows: list[Row], row: Row, columns: Sequence[str]) -> bool:
    """Add points to the rows of a pose; return whether they are there already, digit for digit."""
    measured = {name for name in columns if row.get(name)}
    for known in rows:
        if known.get("session") != row.get("session"):
            continue
        present = {name for name in measured if known.get(name)}
        if measured and present == measured and all(known[n] == row[n] for n in measured):
            return True
        if not present:
            known |= {name: cell for name, cell in row.items() if cell and not known.get(name)}
            return False
    rows.append(row)
    return False


def _list_measured(row: Row, targets: Sequence[str]) -> list[str]:
    """Return the targets that a row of an export measures."""
    if len(targets) < 2:
        return list(targets)
    return [target for target in targets if any(row.get(f"{target}.{n}") for n in "xyz")]


def _shorten(names: Sequence[str]) -> tuple[str, ...]:
    """Return the first names of a list, for a sentence."""
    distinct = list(dict.fromkeys(names))
    return tuple(distinct[:5] + [".."] * (len(distinct) > 5))


def _report_counts(
    table: Table, filled: Mapping[str, Sequence[Row]], targets: Sequence[str]
) -> list[Finding]:
    """Return what is filled in, missing and repeated."""
    missing, repeated, points = [], [], 0
    for pose in table.pose_names():
        rows = filled.get(pose, ())
        for target in targets:
            count = sum(target in _list_measured(row, targets) for row in rows)
            points += count
            name = name_point(pose, target, targets)
            missing += [name] * (count == 0)
            repeated += [name] * (count > 1)
    poses = len(table.pose_names())
    findings = [report_finding("sheet.filled", points=points, filled=len(filled), poses=poses)]
    if missing:
        counts: dict[str, Any] = {"count": len(missing), "wanted": poses * len(targets)}
        findings.append(report_finding("sheet.points-missing", names=tuple(missing), **counts))
    if repeated:
        findings.append(report_finding("sheet.points-repeated", names=tuple(repeated)))
    return findings


def _merge(
    table: Table,
    filled: Mapping[str, Sequence[Row]],
    units: Mapping[str, str | None],
    columns: Sequence[str],
) -> Iterator[Row]:
    """Yield the rows of the filled sheet, in its order; repetitions follow their pose."""
    for cells in table.rows:
        row = dict(zip(table.names, cells, strict=True))
        kept = {name: cell for name, cell in row.items() if name not in columns}
        for points in filled.get(row["pose"], ()) or ({},):
            yield {**dict.fromkeys(units, ""), **kept, **{n: c for n, c in points.items() if c}}


def read_rows(
    robot: Mechanism, table: Table, body: Sequence[Row], header: dict[str, str | None]
) -> Measurements:
    """Return the measurements of a filled sheet, without the poses that have no measured value."""
    lines = dict(zip(table.pose_names(), table.lines, strict=True))
    columns = {name: Cells(["\n".join(row.get(name, "") for row in body)]) for name in header}
    of_rows = tuple(lines.get(pose, table.header_line) for pose in columns["pose"])
    filled = replace(table, units=header, columns=columns, lines=of_rows)
    others = read_tables(table.path)[1:]
    data = join_tables((filled, *others), robot, allow_outside_stroke=True)
    measured = tuple(rows.take(rows.is_measured) for rows in data.observations)
    return replace(data, observations=measured)
