# SPDX-License-Identifier: Apache-2.0
"""From an export to the text of a measurement file, as a profile says: numbers keep their digits, no line goes unseen.

Every line is a row, is passed over as the profile says (blank, a comment, skipped, ignored, the header), or does not fit;
lines of the last sort are listed with the reason.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from loopcal.errors import FileError
from loopcal.io.csv_table import quoted
from loopcal.io.exports.profile import Profile, Source
from loopcal.io.measurement_file import FORMAT
from loopcal.io.pose_rows import LINK
from loopcal.io.text_file import read_raw

PLAIN = re.compile(r"[A-Za-z][\w /.-]*")
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
    """

    text: str
    rows: int
    passed: int
    misfits: tuple[tuple[int, str], ...]


class _Misfit(Exception):  # noqa: N818
    """A line that does not fit, with the reason; caught where the line is counted."""


@dataclass
class _Lines:
    """Lines of an export as cells, with their numbers."""

    cells: list[tuple[int, list[str]]] = field(default_factory=list)
    passed: int = 0
    header: dict[str, int] = field(default_factory=dict)


def convert(path: str | Path, profile: Profile) -> Converted:
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
    found = _lines(path, profile)
    rows: list[dict[str, str]] = []
    misfits: list[tuple[int, str]] = []
    for number, cells in found.cells:
        try:
            _enter(rows, _row(cells, found.header, profile), profile)
        except _Misfit as error:
            misfits.append((number, str(error)))
    if not rows:
        if not misfits:
            raise FileError("every line of this export is passed over as the profile says; correct the profile", path)
        number, reason = misfits[0]
        raise FileError(f"no line of this export fits {profile.file.path}; this one, the first: {reason}", path, number)
    return Converted(_text(path, profile, rows, misfits), len(rows), found.passed, tuple(misfits))


def _lines(path: Path, profile: Profile) -> _Lines:
    """Split the export into cells, and find its header where columns go by name."""
    raw = read_raw(path, "export")
    try:
        text = raw.decode(profile.encoding)
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        sentence = f"byte 0x{raw[error.start]:02x} is not {profile.encoding} text; state 'encoding' in the profile"
        raise FileError(sentence, path, line) from None
    if not text.strip():
        raise FileError("this export is empty; export it again", path)
    named = {p for source in profile.columns.values() for p in source.places if isinstance(p, str)}
    named |= {place for place in profile.matrix if isinstance(place, str)}
    found, first = _Lines(), None
    for i, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n")):
        nothing = not line.strip() or (profile.comment is not None and line.lstrip().startswith(profile.comment))
        if i < profile.skip or nothing or (profile.ignore is not None and profile.ignore.search(line)):
            found.passed += bool(line.strip())
            continue
        cells = _cells(line, profile.delimiter)
        if named and not found.header:
            found.passed += 1
            first = first or (i + 1, cells)
            if named <= set(cells):
                found.header = {cell: place for place, cell in reversed(list(enumerate(cells)))}
                twice = [cell for cell in sorted(named) if cells.count(cell) > 1]
                if twice:
                    raise FileError(f"two columns are headed {twice[0]!r}; name it by its place in the profile", path, i + 1)
            continue
        found.cells.append((i + 1, cells))
    if named and not found.header:
        wanted, number = ", ".join(sorted(named)), first[0] if first else None
        seen = f"; this line, the first, has {' | '.join(first[1])!r}" if first else ""
        raise FileError(f"no line names the columns {wanted}, as {profile.file.path} says{seen}", path, number)
    return found


def _cells(line: str, delimiter: str | None) -> list[str]:
    """Split a line."""
    if delimiter is None:
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return [line]  # longer than any cell may be


def _row(cells: Sequence[str], header: Mapping[str, int], profile: Profile) -> dict[str, str]:
    """Return our column -> cell of one line, `target` among them where the name of a pose tells it; raises _Misfit."""
    row: dict[str, str] = {}
    for name, source in profile.columns.items():
        given = [_cell(cells, place, header) for place in source.places]
        given = ["" if cell in profile.missing else cell for cell in given]
        if source.unit is not None:
            row[name] = _number(given[0], profile.decimal, name)
        elif source.match is not None:
            row |= _named(given, source)
        elif name == "time":
            row[name] = _time(" ".join(given).strip(), source)
        else:
            row[name] = " ".join(given).strip()
    if "pose" in profile.columns and (not row["pose"] or LINK in row["pose"]):
        raise _Misfit(f"{row['pose']!r} is no name of a pose: it is empty, or holds {LINK!r}")
    if profile.matrix:
        row |= _quaternion([_number(_cell(cells, place, header), profile.decimal, "matrix") for place in profile.matrix])
    return row


def _cell(cells: Sequence[str], place: str | int, header: Mapping[str, int]) -> str:
    """Return a cell by the header's name, or its place."""
    at = header[place] if isinstance(place, str) else place - 1
    if at >= len(cells):
        raise _Misfit(f"it has {len(cells)} columns, but {place!r} is the column {at + 1}")
    return cells[at]


def _number(text: str, decimal: str, name: str) -> str:
    """Return a finite number with a decimal point, its digits as they are; nothing for nothing."""
    if not text:
        return ""
    plain = text if decimal == "." else text.replace(".", "?").replace(decimal, ".")
    try:
        value = float(plain)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in plain:
        raise _Misfit(f"{text!r} is no number for {name!r}")
    return plain


def _named(given: Sequence[str], source: Source) -> dict[str, str]:
    """Return the pose, and the target, in a name."""
    name = " ".join(given).strip()
    found = source.match.fullmatch(name) if source.match is not None else None
    if source.match is None or found is None:
        raise _Misfit(f"the name {name!r} does not match {source.match.pattern if source.match else ''}")
    return {key: (value or "").strip() for key, value in found.groupdict().items() if key in {"pose", "target"}}


def _time(text: str, source: Source) -> str:
    """Return a date and time as ISO 8601."""
    if not text:
        return ""
    try:
        return (datetime.fromisoformat(text) if source.time is None else datetime.strptime(text, source.time)).isoformat()
    except ValueError:
        raise _Misfit(f"the time {text!r} is not written as {source.time or 'ISO 8601, 2026-05-04T10:22:31'}") from None


def _quaternion(numbers: Sequence[str]) -> dict[str, str]:
    """Return qw qx qy qz of a rotation matrix, row by row; empty where the whole of it is."""
    import numpy as np

    from loopcal import se3

    names = ("qw", "qx", "qy", "qz")
    if not all(numbers):
        if any(numbers):
            raise _Misfit("it has only a part of the rotation matrix")
        return dict.fromkeys(names, "")
    R = np.array([float(number) for number in numbers]).reshape(3, 3)
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > SQUARE or np.linalg.det(R) < 0.0:
        raise _Misfit(f"the nine numbers are no rotation matrix (off by {off:.2g})")
    U, _, Vt = np.linalg.svd(R)  # the rotation next to what was rounded to a few decimals
    return dict(zip(names, (repr(float(q)) for q in se3.matrix_to_quaternion(U @ Vt)), strict=True))


def _enter(rows: list[dict[str, str]], row: dict[str, str], profile: Profile) -> None:
    """Add a row, or where targets have lines of their own, put this target into the last row of its pose."""
    targets: tuple[str, ...] = getattr(profile.kind, "targets", ())
    if "target" not in row or not targets:
        rows.append(row)
        return
    target = row.pop("target")
    if target not in targets:
        raise _Misfit(f"the target {target!r} is none of {', '.join(targets)}")
    if len(targets) == 1:
        rows.append(row)
        return
    own = {column.name.partition(".")[2] for column in profile.kind.columns}
    values = {f"{target}.{name}": row.pop(name) for name in own}
    last = rows[-1] if rows else {}
    same = last.get("pose") == row["pose"] and all(last.get(n) == row.get(n) for n in ("session", "group", "block"))
    if same and not any(name in last for name in values):
        last.update(values)
    else:
        rows.append(row | values)


def _text(path: Path, profile: Profile, rows: Sequence[Mapping[str, str]], misfits: Sequence[tuple[int, str]]) -> str:
    """Return the measurement file."""
    units = {name: source.unit for name, source in profile.columns.items()}
    several = len(getattr(profile.kind, "targets", ())) > 1
    kinds = {
        column.name: units.get(column.name.partition(".")[2] if several else column.name) for column in profile.kind.columns
    }
    kinds |= {name: "1" for name in ("qw", "qx", "qy", "qz") if profile.matrix}
    inner = {name.partition(".")[2] for name in kinds} if several else set(kinds)
    own = {"pose": None} | {name: symbol for name, symbol in units.items() if name not in inner and name != "pose"}
    columns = own | kinds
    lines = [f"## read from {path.name} by {profile.file.path.name}"]
    lines += [f"## lines that did not fit: {', '.join(str(number) for number, _ in misfits)}"] if misfits else []
    lines += [f"# {key}: {_flow(value)}" for key, value in {"format": FORMAT, **profile.settings}.items()]
    lines.append(",".join(name if symbol is None else f"{name} [{symbol}]" for name, symbol in columns.items()))
    for i, row in enumerate(rows):
        cells = {"pose": str(i + 1), **row}
        lines.append(",".join(quoted(cells.get(name, "")) for name in columns))
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    """Return a setting on one line of YAML."""
    plain = isinstance(value, str) and PLAIN.fullmatch(value) is not None
    return str(value) if plain else json.dumps(value, ensure_ascii=False)
