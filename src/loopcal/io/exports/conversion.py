# SPDX-License-Identifier: Apache-2.0
"""From an export to the text of a measurement file; numbers keep their digits.

Every line becomes part of a row, is skipped by the profile (blank, comment, header, ...), or does
not fit. Lines that do not fit are listed with the reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError
from loopcal.findings import Finding
from loopcal.io.core.csv_table import quote_cell
from loopcal.io.core.text_file import as_path
from loopcal.io.data.columns import COVARIANCE, LINK
from loopcal.io.data.measurement_file import FORMAT
from loopcal.io.exports.export_lines import (
    Line,
    Misfit,
    check_count,
    find_unusual_lines,
    read_lines,
)
from loopcal.io.exports.profile import ColumnSource, Place, Profile
from loopcal.io.exports.target_rows import Row, Rows, list_headers

PLAIN = re.compile(r"(?!(?i:null|true|false|yes|no|on|off|y|n)$)[A-Za-z](?:[\w /.-]*[\w/.-])?")
"""Text that YAML reads as itself."""

ROTATION_ERROR = 1e-3
"""Accepted deviation of an exported matrix from a rotation [1]: the rounding of four decimals."""

QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Conversion:
    """The result of converting an export.

    Parameters
    ----------
    text : the measurement file. rows : their number. passed : number of lines without data.
    misfits : lines that do not fit the profile, with the reason.
    findings : differences between lines of a pose that the file does not keep.
    """

    text: str
    rows: int
    passed: int
    misfits: tuple[tuple[int, str], ...]
    findings: tuple[Finding, ...] = ()


def convert_export(path: str | Path, profile: Profile) -> Conversion:
    """Convert an export by means of a profile.

    Raises
    ------
    FileError : unreadable, without the header that the profile needs, or no line fits.
    """
    path = as_path(path, "export")
    lines = read_lines(path, profile)
    rows, fitting, misfits = Rows(profile), [], []
    for line in lines.data:
        try:
            check_count(line, profile.delimiter)
            fitting.append((line, _parse_row(line, profile)))
        except Misfit as error:
            misfits.append((line.number, str(error)))
    unusual = find_unusual_lines([line for line, _ in fitting])
    for line, row in fitting:
        try:
            if line.number in unusual:
                raise Misfit(unusual[line.number])
            rows.add(row)
        except Misfit as error:
            misfits.append((line.number, str(error)))
    misfits.sort()
    if not rows.rows:
        if not misfits:
            raise FileError("the profile skips every line of this export; correct it", path)
        number, reason = misfits[0]
        sentence = f"no line of this export fits {profile.file.path}"
        raise FileError(f"{sentence}; reason for the first one: {reason}", path, number)
    text = _format_file(path, profile, rows, misfits)
    return Conversion(text, len(rows.rows), lines.skipped, tuple(misfits), rows.findings)


def _parse_row(line: Line, profile: Profile) -> Row:
    """Return column -> cell of one line, with `target` where the name states it; raise Misfit."""
    row: Row = {}
    for name, source in profile.columns.items():
        cells = [_get_cell(line, place) for place in source.places]
        if source.symbol is not None:
            row[name] = _parse_number(cells[0], profile, name)
            continue
        text = " ".join("" if cell in profile.missing else cell for cell in cells).strip()
        if source.pattern is not None:
            row |= _match_name(text, source.pattern)
        else:
            row[name] = _parse_time(text, source) if name == "time" else text
    if "pose" in profile.columns and (not row["pose"] or LINK in row["pose"]):
        raise Misfit(f"{row['pose']!r} is not a name of a pose: it is empty or contains {LINK!r}")
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
    value = profile.parse(text)
    if value in profile.missing_numbers:
        return ""
    if value is None:
        raise Misfit(f"{text!r} is not a number for {name!r}")
    return profile.with_point(text)


def _match_name(name: str, pattern: re.Pattern[str]) -> Row:
    """Return the pose, and the target, in a name."""
    match = pattern.fullmatch(name)
    if match is None:
        raise Misfit(f"the name {name!r} does not match {pattern.pattern}")
    groups = match.groupdict().items()
    return {key: (value or "").strip() for key, value in groups if key in {"pose", "target"}}


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
        raise Misfit(f"the time {text!r} does not have the format {wanted}") from None


def _to_quaternion(cells: Sequence[str]) -> Row:
    """Return the quaternion of a rotation matrix, row by row; empty where the matrix is missing."""
    if not all(cells):
        if any(cells):
            raise Misfit("part of the rotation matrix is missing")
        return dict.fromkeys(QUATERNION, "")
    R, error = geometry.project_to_rotation(np.array([float(c) for c in cells]).reshape(3, 3))
    if error > ROTATION_ERROR:
        raise Misfit(f"the nine numbers are not a rotation matrix (error {error:.2g})")
    quaternion = (repr(float(q)) for q in geometry.matrix_to_quaternion(R))
    return dict(zip(QUATERNION, quaternion, strict=True))


def _format_file(
    path: Path, profile: Profile, rows: Rows, misfits: Sequence[tuple[int, str]]
) -> str:
    """Return the text of the measurement file."""
    columns = list_headers(profile)
    lines = [" ".join(f"## converted from {path.name} by {profile.file.path.name}".split())]
    if misfits:
        lines.append(f"## lines that do not fit: {', '.join(str(number) for number, _ in misfits)}")
    lines += [f"## {finding}" for finding in rows.findings]
    settings = {"format": FORMAT, **profile.record.settings}
    lines += [f"# {key}: {_format_setting(value)}" for key, value in settings.items()]
    headers = (f"{n} [{symbol}]" if symbol is not None else n for n, symbol in columns.items())
    lines.append(",".join(headers))
    for i, row in enumerate(rows.rows, 1):
        cells = {"pose": str(i), **row}
        # a target without a line has no covariance
        absent = ("0" if name.startswith(COVARIANCE) else "" for name in columns)
        pairs = zip(columns, absent, strict=True)
        lines.append(",".join(quote_cell(cells.get(name, usual)) for name, usual in pairs))
    return "\n".join(lines) + "\n"


def _format_setting(value: Any) -> str:
    """Return a setting on one line of YAML."""
    is_plain = isinstance(value, str) and PLAIN.fullmatch(value) is not None
    return str(value) if is_plain else json.dumps(value, ensure_ascii=False)
