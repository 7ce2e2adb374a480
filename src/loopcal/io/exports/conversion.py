# SPDX-License-Identifier: Apache-2.0
"""From an export to the text of a measurement file, as a profile says: numbers keep their digits,
no line goes unseen.

Every line is a row, is passed over as the profile says (blank, a comment, skipped, ignored, the
header), or does not fit; lines of the last sort are listed with the reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from loopcal.errors import FileError
from loopcal.io.core.csv_table import quote_cell
from loopcal.io.data.columns import COVARIANCE, LINK
from loopcal.io.data.measurement_file import FORMAT
from loopcal.io.exports.export_cells import plain_number, with_point
from loopcal.io.exports.export_lines import Line, Misfit, check_count, read_lines, unlike_most
from loopcal.io.exports.profile import Profile, Source
from loopcal.io.exports.target_rows import Rows, headers

PLAIN = re.compile(r"(?!(?i:null|true|false|yes|no|on|off|y|n)$)[A-Za-z](?:[\w /.-]*[\w/.-])?")
"""Text that YAML reads as itself."""

SQUARE = 1e-3
"""How far a rotation matrix of an export may be from a rotation [1]: what four decimals leave."""


@dataclass(frozen=True)
class Converted:
    """What became of an export.

    Parameters
    ----------
    text : str
        The measurement file.
    rows : int
        Its rows; where targets have lines of their own, one for each pose.
    passed : int
        Lines that the profile says hold nothing.
    misfits : tuple of (int, str)
        Lines that do not fit the profile, with the reason.
    notes : tuple of str
        Sentences on what lines of several targets say differently.
    """

    text: str
    rows: int
    passed: int
    misfits: tuple[tuple[int, str], ...]
    notes: tuple[str, ...] = ()


def convert_export(path: str | Path, profile: Profile) -> Converted:
    """Read an export.

    Parameters
    ----------
    path : str or Path
        The export. profile : how to read it.

    Raises
    ------
    FileError
        It cannot be read, has not the header that the profile wants, or no line fits.
    """
    path = Path(path)
    lines = read_lines(path, profile)
    rows, fitting, misfits = Rows(profile), [], []
    for line in lines.found:
        try:
            check_count(line, profile.delimiter)
            fitting.append((line, _row(line, profile)))
        except Misfit as error:
            misfits.append((line.number, str(error)))
    unlike = dict(unlike_most([line for line, _ in fitting]))
    for line, row in fitting:
        try:
            if line.number in unlike:
                raise Misfit(unlike[line.number])
            rows.enter(row)
        except Misfit as error:
            misfits.append((line.number, str(error)))
    misfits.sort()
    if not rows.rows:
        if not misfits:
            raise FileError(
                "every line of this export is passed over as the profile says; correct the profile",
                path,
            )
        number, reason = misfits[0]
        raise FileError(
            f"no line of this export fits {profile.file.path}; this one, the first: {reason}",
            path,
            number,
        )
    text = _text(path, profile, rows, misfits)
    return Converted(text, len(rows.rows), lines.passed, tuple(misfits), rows.notes)


def _row(line: Line, profile: Profile) -> dict[str, str]:
    """Return our column -> cell of one line, `target` among them where the name of a pose tells it;
    raises Misfit.
    """
    row: dict[str, str] = {}
    for name, source in profile.columns.items():
        given = [_cell(line, place) for place in source.places]
        if source.unit is not None:
            row[name] = _number(given[0], profile, name)
            continue
        given = ["" if cell in profile.missing else cell for cell in given]
        if source.match is not None:
            row |= _named(given, source)
        elif name == "time":
            row[name] = _time(" ".join(given).strip(), source)
        else:
            row[name] = " ".join(given).strip()
    if "pose" in profile.columns and (not row["pose"] or LINK in row["pose"]):
        raise Misfit(f"{row['pose']!r} is no name of a pose: it is empty, or holds {LINK!r}")
    if profile.matrix:
        row |= _quaternion(
            [_number(_cell(line, place), profile, "matrix") for place in profile.matrix]
        )
    return row


def _cell(line: Line, place: str | int) -> str:
    """Return a cell by the header's name, or its place."""
    at = (
        line.header.places[place]
        if isinstance(place, str) and line.header is not None
        else int(place) - 1
    )
    if at >= len(line.cells):
        called = (
            f"{place!r} is column {at + 1}"
            if isinstance(place, str)
            else f"column {place} is needed"
        )
        raise Misfit(f"it has {len(line.cells)} columns, but {called}")
    return line.cells[at]


def _number(text: str, profile: Profile, name: str) -> str:
    """Return a finite number with a decimal point, its digits as they are; nothing for nothing, or
    what is missing.
    """
    if not text or text in profile.missing:
        return ""
    plain = with_point(text, profile.decimal)
    value = plain_number(plain)
    if value in profile.missing_numbers:
        return ""
    if value is None:
        raise Misfit(f"{text!r} is no number for {name!r}")
    return plain


def _named(given: Sequence[str], source: Source) -> dict[str, str]:
    """Return the pose, and the target, in a name."""
    name = " ".join(given).strip()
    found = source.match.fullmatch(name) if source.match is not None else None
    if source.match is None or found is None:
        raise Misfit(
            f"the name {name!r} does not match {source.match.pattern if source.match else ''}"
        )
    return {
        key: (value or "").strip()
        for key, value in found.groupdict().items()
        if key in {"pose", "target"}
    }


def _time(text: str, source: Source) -> str:
    """Return a date and time as ISO 8601."""
    if not text:
        return ""
    try:
        return (
            datetime.fromisoformat(text)
            if source.time is None
            else datetime.strptime(text, source.time)
        ).isoformat()
    except ValueError:
        raise Misfit(
            f"the time {text!r} is not written as {source.time or 'ISO 8601, 2026-05-04T10:22:31'}"
        ) from None


def _quaternion(numbers: Sequence[str]) -> dict[str, str]:
    """Return qw qx qy qz of a rotation matrix, row by row; empty where the whole of it is."""
    import numpy as np

    from loopcal import geometry

    names = ("qw", "qx", "qy", "qz")
    if not all(numbers):
        if any(numbers):
            raise Misfit("it has only a part of the rotation matrix")
        return dict.fromkeys(names, "")
    R = np.array([float(number) for number in numbers]).reshape(3, 3)
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > SQUARE or np.linalg.det(R) < 0.0:
        raise Misfit(f"the nine numbers are no rotation matrix (off by {off:.2g})")
    U, _, Vt = np.linalg.svd(R)  # the rotation next to what was rounded to a few decimals
    return dict(
        zip(names, (repr(float(q)) for q in geometry.matrix_to_quaternion(U @ Vt)), strict=True)
    )


def _text(path: Path, profile: Profile, rows: Rows, misfits: Sequence[tuple[int, str]]) -> str:
    """Return the measurement file."""
    columns = headers(profile)
    lines = [" ".join(f"## read from {path.name} by {profile.file.path.name}".split())]
    lines += (
        [f"## lines that did not fit: {', '.join(str(number) for number, _ in misfits)}"]
        if misfits
        else []
    )
    lines += [f"## {note}" for note in rows.notes]
    lines += [
        f"# {key}: {_flow(value)}" for key, value in {"format": FORMAT, **profile.settings}.items()
    ]
    lines.append(
        ",".join(
            name if symbol is None else f"{name} [{symbol}]" for name, symbol in columns.items()
        )
    )
    for i, row in enumerate(rows.rows):
        cells = {"pose": str(i + 1), **row}
        # a target without a line has no covariance
        lines.append(
            ",".join(
                quote_cell(cells.get(name, "0" if name.startswith(COVARIANCE) else ""))
                for name in columns
            )
        )
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    """Return a setting on one line of YAML."""
    plain = isinstance(value, str) and PLAIN.fullmatch(value) is not None
    return str(value) if plain else json.dumps(value, ensure_ascii=False)
