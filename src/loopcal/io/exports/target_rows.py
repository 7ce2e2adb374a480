# SPDX-License-Identifier: Apache-2.0
"""Rows of the measurement file: one for each line, or one for the lines of all targets of a pose.

Values, sigma, covariance and remarks belong to a target and get a column for each target. Readings
belong to the pose and are the same in all of its lines. Lines that differ in anything else have
rows of their own, except for the time: a row has the time of its first line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from loopcal.findings import Finding, report_finding
from loopcal.io.core.numbers import parse_finite
from loopcal.io.data.column_types import TIME
from loopcal.io.data.columns import COVARIANCE, NOTE, SIGMA
from loopcal.io.exports.export_lines import Misfit
from loopcal.io.exports.profile import Profile, strip_target

Row = dict[str, str]
"""Column -> cell."""


@dataclass
class Rows:
    """Rows in the order of their first lines."""

    profile: Profile
    rows: list[Row] = field(default_factory=list)
    _readings: dict[str, Row] = field(default_factory=dict)
    _other_times: int = 0

    def add(self, row: Row) -> None:
        """Add a line, as a row or to the last row of its pose.

        Raises
        ------
        Misfit : an unknown target, or a reading that differs from an earlier line of the pose.
        """
        targets = self.profile.targets
        if "target" not in row or not targets:
            self.rows.append(row)
            return
        target = row["target"]
        if target not in targets:
            raise Misfit(f"the target {target!r} is not one of {', '.join(targets)}")
        shared = {name: cell for name, cell in row.items() if name != "target"}
        if len(targets) == 1:
            self.rows.append(shared)
            return
        values = {
            _add_target(name, target): shared.pop(name)
            for name in list(shared)
            if _belongs_to_target(name, self.profile)
        }
        self._check_readings(shared)
        last = self.rows[-1] if self.rows else {}
        if any(name in last for name in values) or not _agree(last, shared):
            self.rows.append(shared | values)
            return
        if last.get(TIME) and shared.get(TIME):
            self._other_times += last[TIME] != shared[TIME]
        last.update(values)
        last.update({name: cell for name, cell in shared.items() if not last.get(name)})

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Differences between lines that a row does not keep."""
        if not self._other_times:
            return ()
        return (report_finding("files.other-times", count=self._other_times),)

    def _check_readings(self, row: Row) -> None:
        """Raise Misfit for a reading that differs from an earlier line of this pose."""
        known = self._readings.setdefault(row["pose"], {})
        for name in self.profile.record.readings:
            cell, before = row[name], known.get(name, "")
            if cell and before and not _is_equal(cell, before):
                sentence = f"{name!r} is {cell} here, but {before} in an earlier line of the pose"
                raise Misfit(f"{sentence} {row['pose']!r}")
            if cell and not before:
                known[name] = cell


def list_headers(profile: Profile) -> dict[str, str | None]:
    """Return column -> unit of the measurement file, None for text."""
    units = {name: source.symbol for name, source in profile.columns.items() if name != "pose"}
    units |= {name: "1" for name in ("qw", "qx", "qy", "qz") if profile.record.matrix}
    names = [column.name for column in profile.kind.columns]
    first: dict[str, str | None] = {"pose": None}
    if len(profile.targets) < 2:
        own = [profile.name_measured(name) for name in names]
        others = {n: u for n, u in units.items() if n not in own}
        return first | others | {n: units[n] for n in own}
    shared = {n: u for n, u in units.items() if not _belongs_to_target(n, profile)}
    values = list(dict.fromkeys(strip_target(name) for name in names))
    beside = [n for n in units if n not in shared and n not in values]
    pairs = [(name, target) for target in profile.targets for name in values]
    pairs += [(name, target) for name in beside for target in profile.targets]
    return first | shared | {_add_target(name, target): units[name] for name, target in pairs}


def _belongs_to_target(name: str, profile: Profile) -> bool:
    """Return whether a column belongs to a target, not to the pose."""
    values = {strip_target(column.name) for column in profile.kind.columns}
    return name.removeprefix(SIGMA) in values or name.startswith((COVARIANCE, NOTE))


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
