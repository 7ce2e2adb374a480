# SPDX-License-Identifier: Apache-2.0
"""Read the rows that an instrument adds to its export while it measures.

The export is read again from its beginning each time: what a line means may depend on a header
above it. Only complete lines count, and of several targets only complete sets. If the beginning has
changed, the instrument began a new file, whose rows all count.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.limits import TABLE_SIZE
from loopcal.io.core.text_file import read_bytes
from loopcal.io.data.kind_settings import KindRows
from loopcal.io.exports.conversion import Row, read_points
from loopcal.io.exports.profile import Profile


@dataclass(frozen=True)
class GrowingExport:
    """How far an export was read.

    size, digest : of the bytes that were read. rows : number of its rows that were read.
    misfits : number of lines that did not match the profile.
    """

    path: Path
    size: int = 0
    digest: str = ""
    rows: int = 0
    misfits: int = 0


@dataclass(frozen=True)
class NewRows:
    """Rows that an export got: `rows` by column, with `pose` where they are named, and the `units`
    of their columns. `export` : how far it is read now.
    """

    export: GrowingExport
    rows: Sequence[Row]
    units: dict[str, str | None]
    findings: tuple[Finding, ...] = ()


def read_new_rows(
    export: GrowingExport, profile: Profile, entry: KindRows, by_order: bool
) -> NewRows:
    """Return the rows that an export got since it was read last; none while it does not exist.

    entry : kind and columns of the sheet that is filled in. FileError : it cannot be read.
    """
    path, k = export.path, max(len(getattr(entry.kind, "targets", ())), 1)
    if not path.exists():
        return NewRows(export, (), {})
    content = read_bytes(path, "export", TABLE_SIZE)
    one, two = (text.encode(profile.encoding) for text in ("x", "x\n"))  # with a byte order mark
    end = content.rfind(two[len(one) :]) + 1
    content = content[: end - 1 + len(two) - len(one) if end else 0]
    is_same = hashlib.sha256(content[: export.size]).hexdigest() == export.digest
    findings: list[Finding] = []
    if export.size and not is_same:
        findings.append(report_finding("session.export-began-again", path=str(path)))
        export = GrowingExport(path)
    if len(content) == export.size or not content.strip():
        return NewRows(export, (), {}, tuple(findings))
    misfits: list[tuple[str, int, str]] = []
    try:
        units, rows = read_points(path, profile, entry, by_order, misfits, content)
    except FileError as error:  # a header alone, or lines that do not match
        if not misfits and not export.misfits:
            findings.append(report_finding("session.no-line-matches", reason=str(error)))
        export = GrowingExport(path, len(content), hashlib.sha256(content).hexdigest(), 0, 1)
        return NewRows(export, (), {}, tuple(findings))
    for _, line, reason in misfits[export.misfits :]:
        findings.append(report_finding("session.line-misfit", line=line, reason=reason))
    if by_order:
        sets = [rows[i : i + k] for i in range(0, len(rows) - k + 1, k)]
        rows = [{n: c for row in of for n, c in row.items() if c and n != "pose"} for of in sets]
    columns = [column.name for column in entry.kind.columns]
    if rows and k > 1 and not all(rows[-1].get(name) for name in columns):
        rows = rows[:-1]  # more of its targets follow
    digest = hashlib.sha256(content).hexdigest()
    after = GrowingExport(path, len(content), digest, len(rows), len(misfits))
    return NewRows(after, rows[export.rows :], dict(units), tuple(findings))
