# SPDX-License-Identifier: Apache-2.0
"""Fill in the data sheet of a plan from the exports of an instrument.

The sheet states poses, readings and the instrument; a profile states how the export is read. Points
are joined with the sheet by their names, or by their order: all targets of the first pose, then
those of the second, and so on. Numbers keep the digits and the unit of the export. Before anything
is written, the points are to be examined: `loopcal.diagnose.point_names.examine_points`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.csv_table import (
    Cells,
    Table,
    format_header,
    format_row,
    read_table,
    require_columns,
)
from loopcal.io.core.text_file import read_text
from loopcal.io.data.kind_settings import KindRows, read_kinds
from loopcal.io.data.measurement_file import join_tables, read_tables
from loopcal.io.exports.conversion import convert_export, list_headers
from loopcal.io.exports.profile import Profile, check_columns
from loopcal.measure.kinds.position import name_point
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism

Row = dict[str, str]
"""Column -> cell."""


@dataclass(frozen=True)
class FilledSheet:
    """A sheet with the points of an export.

    text : the measurement file. table : its header and rows.
    misfits : export, line and reason of lines that do not match the profile.
    data : the measurements, for checks before the file is written. unit : of the points.
    findings : what is filled in, missing, unknown or repeated.
    """

    text: str
    table: tuple[tuple[str, ...], ...]
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
    table, entry = _read_sheet(Path(sheet), robot)
    columns = [column.name for column in entry.kind.columns]
    targets = tuple(getattr(entry.kind, "targets", ())) or ("",)
    filled: dict[str, list[Row]] = {}
    units: dict[str, str | None] = {}
    misfits: list[tuple[str, int, str]] = []
    unknown: list[str] = []
    identical: list[str] = []
    has_sessions, poses = len(exports) > 1 and not has_one_session, set(table.pose_names())
    for export in exports:
        of_export, rows = _read_points(Path(export), profile, entry, table, by_order, misfits)
        for name, unit in of_export.items():  # the profile is one
            if units.setdefault(name, unit) != unit:
                sentence = f"column {name!r} has another unit than in the first export"
                raise FileError(sentence, Path(export))
        if has_sessions:
            units.setdefault("session", None)
        for pose, row in rows:
            if pose not in poses:
                unknown += [name_point(pose, t, targets) for t in _list_measured(row, targets)]
                continue
            cells = {"session": Path(export).stem, **row} if has_sessions else row
            if _add_row(filled.setdefault(pose, []), cells, columns):
                identical += [name_point(pose, t, targets) for t in _list_measured(row, targets)]
    if not filled:
        wanted = [name_point(p, t, targets) for p in table.pose_names() for t in targets]
        code = "sheet.no-name-matches"
        raise FileError(
            report_finding(code, exported=_shorten(unknown), wanted=_shorten(wanted)),
            Path(exports[0]),
        )
    findings = _report_counts(table, filled, targets)
    for code, names in (("points-unknown", unknown), ("points-identical", identical)):
        if names:
            findings.append(report_finding(f"sheet.{code}", names=tuple(dict.fromkeys(names))))
    body = list(_merge(table, filled, units, columns))
    # columns of the sheet, measured ones with the unit of the export, then further ones
    header = {n: units.get(n, u) if n in columns else u for n, u in table.units.items()}
    header |= {name: unit for name, unit in units.items() if name not in header}
    data = _read_measurements(robot, table, body, header)
    source = " and ".join(map(str, exports))  # the file whose values a check doubts
    data = replace(data, observations=tuple(replace(o, source=source) for o in data.observations))
    above = read_text(table.path, "sheet").lstrip("\ufeff").splitlines()[: table.header_line - 1]
    lines = [line for line in above if line.strip()]
    cells = tuple(tuple(row.get(name, "") for name in header) for row in body)
    written = (format_header(header), *cells)
    text = "\n".join([*lines, *map(format_row, written)]) + "\n"
    unit = next((units.get(name) for name in columns if units.get(name)), None) or "mm"
    return FilledSheet(text, written, tuple(misfits), data, unit, tuple(findings))


def _read_sheet(path: Path, robot: Mechanism) -> tuple[Table, KindRows]:
    """Return the sheet and its only kind; FileError where it has measured values or other rows."""
    table = read_table(path)
    require_columns(table, ("pose",), "which the points of an export are joined with")
    kinds = read_kinds(table, robot)
    if len(kinds) != 1 or kinds[0].kind.poses_per_row != 1 or "kinds" in table.settings.content:
        raise FileError(report_finding("sheet.kinds", count=len(kinds)), path)
    names = [column.name for column in kinds[0].kind.columns]
    for row, cells in enumerate(zip(*(table.text(name) for name in names), strict=True)):
        if any(cells):
            raise table.row_error(row, report_finding("sheet.already-filled"))
    return table, kinds[0]


def _read_points(
    export: Path,
    profile: Profile,
    entry: KindRows,
    table: Table,
    by_order: bool,
    misfits: list[tuple[str, int, str]],
) -> tuple[Mapping[str, str | None], list[tuple[str, Row]]]:
    """Return the units of the columns of an export, and its rows by pose; add its misfits."""
    kind, record = entry.kind, replace(profile.record, settings={})
    targets = tuple(getattr(kind, "targets", ()))
    if by_order:
        columns = {name: of for name, of in record.columns.items() if name != "pose"}
        record = replace(record, columns=columns)
        if len(targets) > 1:
            kind = replace(kind, targets=("point",), places=None)  # pyright: ignore[reportCallIssue]
    mine = replace(profile, record=record, kind=kind)
    check_columns(mine)
    conversion = convert_export(export, mine)
    misfits += [(str(export), line, reason) for line, reason in conversion.misfits]
    units = {name: unit for name, unit in list_headers(mine).items() if name != "pose"}
    rows = [dict(zip(("pose", *units), cells, strict=True)) for cells in conversion.table[1:]]
    if not by_order:
        return units, [(row.pop("pose"), row) for row in rows]
    poses, k = table.pose_names(), max(len(targets), 1)
    if len(rows) != len(poses) * k:
        wanted, count = len(poses) * k, len(rows)
        code = "sheet.count-differs"
        raise FileError(
            report_finding(code, wanted=wanted, poses=len(poses), targets=k, count=count), export
        )
    measured = {column.name for column in kind.columns}
    own: dict[str, str | None] = {}
    named: list[tuple[str, Row]] = []
    for i, row in enumerate(rows):
        of_target = {
            name: f"{targets[i % k]}.{name}" if k > 1 and name in measured else name
            for name in units
        }
        own |= {of_target[name]: unit for name, unit in units.items()}
        named.append((poses[i // k], {of_target[name]: row[name] for name in units}))
    return own, named


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
        wanted = poses * len(targets)
        findings.append(
            report_finding(
                "sheet.points-missing", names=tuple(missing), count=len(missing), wanted=wanted
            )
        )
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


def _read_measurements(
    robot: Mechanism, table: Table, body: Sequence[Row], header: dict[str, str | None]
) -> Measurements:
    """Return the measurements of a filled sheet, without the poses that have no measured value."""
    lines = dict(zip(table.pose_names(), table.lines, strict=True))
    columns = {name: Cells(["\n".join(row.get(name, "") for row in body)]) for name in header}
    of_rows = tuple(lines[pose] for pose in columns["pose"])
    filled = replace(table, units=header, columns=columns, lines=of_rows)
    others = read_tables(table.path)[1:]
    data = join_tables((filled, *others), robot, allow_outside_stroke=True, allow_duplicates=True)
    measured = tuple(rows.take(rows.is_measured) for rows in data.observations)
    return replace(data, observations=measured)
