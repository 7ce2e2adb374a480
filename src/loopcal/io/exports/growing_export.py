# SPDX-License-Identifier: Apache-2.0
"""Read the rows that an instrument adds to its export while it measures.

An export that has changed is read again from its beginning: what a line means may depend on a
header above it. Only complete lines count, and of several targets only complete sets. If the
beginning has changed, the instrument began a new file, whose rows all count.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.limits import TABLE_SIZE
from loopcal.io.core.text_file import read_bytes
from loopcal.io.data.kind_settings import KindRows
from loopcal.io.exports.conversion import Row, read_points
from loopcal.io.exports.profile import Profile

POLL = 0.5  # seconds between two looks at an export that is followed


@dataclass(frozen=True)
class GrowingExport:
    """An export that grows, how it is read, and how far it was read.

    entry : kind and columns of the sheet that is filled in. by_order : whether names of points do
    not count. state : of the file when it was read. size, digest : of the bytes that were read.
    rows, misfits : numbers of rows that were read, and of lines that do not match the profile.
    """

    path: Path
    profile: Profile
    entry: KindRows
    by_order: bool = False
    state: tuple[int, ...] = ()
    size: int = 0
    digest: str = ""
    rows: int = 0
    misfits: int = 0


class NewRows(NamedTuple):
    """Rows that an export got, by column, with `pose` unless they are in the order of the poses."""

    export: GrowingExport  # how far it is read now
    rows: Sequence[Row] = ()
    units: Mapping[str, str | None] = {}
    findings: Sequence[Finding] = ()


def read_new_rows(export: GrowingExport) -> NewRows:
    """Return the rows that an export got; none while it does not exist. FileError : unreadable."""
    path, kind = export.path, export.entry.kind
    found = path.stat() if path.exists() else None
    state = () if found is None else (found.st_ino, found.st_size, found.st_mtime_ns)
    if state in ((), export.state):
        return NewRows(export)
    export = replace(export, state=state)
    content, findings = read_bytes(path, "export", TABLE_SIZE), list[Finding]()
    one, two = (text.encode(export.profile.encoding) for text in ("x", "x\n"))
    mark = two[len(one) :]  # of the end of a line, without a byte order mark
    place = content.rfind(mark)
    content = content[: place + len(mark)] if place >= 0 else b""
    if hashlib.sha256(content[: export.size]).hexdigest() != export.digest and export.size:
        findings.append(report_finding("session.export-began-again", path=str(path)))
        export = replace(export, size=0, digest="", rows=0, misfits=0)
    if len(content) == export.size or not content.strip():
        return NewRows(export, findings=findings)
    digest, misfits = hashlib.sha256(content).hexdigest(), list[tuple[str, int, str]]()
    after = replace(export, size=len(content), digest=digest)
    try:
        units, rows = read_points(
            path, export.profile, export.entry, export.by_order, misfits, content
        )
    except FileError as error:  # a header alone, or lines that do not match
        if error.code == "files.export-without-rows":
            return NewRows(after, findings=findings)
        if not export.misfits:
            findings.append(report_finding("session.no-line-matches", reason=str(error)))
        return NewRows(replace(after, misfits=1), findings=findings)
    for _, line, reason in misfits[export.misfits :]:
        findings.append(report_finding("session.line-misfit", line=line, reason=reason))
    k = max(len(getattr(kind, "targets", ())), 1)
    if export.by_order:
        sets = [rows[i : i + k] for i in range(0, len(rows) - k + 1, k)]
        rows = [{n: c for row in of for n, c in row.items() if c and n != "pose"} for of in sets]
    if k > 1 and rows and not all(rows[-1].get(column.name) for column in kind.columns):
        rows = rows[:-1]  # more of its targets follow
    after = replace(after, rows=len(rows), misfits=len(misfits))
    return NewRows(after, rows[export.rows :], units, findings)
