# SPDX-License-Identifier: Apache-2.0
"""Rows of the measurement file: one for each line of an export, or one for the lines of several
targets of a pose.

What belongs to a target (its values, their sigma and covariance, remarks) gets a column for each
target. What belongs to the pose, its readings, is the same in all of its lines or a line does not
fit. Lines that say anything else differently have rows of their own; only the time is that of the
first line of a row, since a row has one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from loopcal.io.data.column_types import TIME
from loopcal.io.data.columns import COVARIANCE, SIGMA
from loopcal.io.exports.export_cells import plain_number
from loopcal.io.exports.export_lines import Misfit
from loopcal.io.exports.profile import Profile


@dataclass
class Rows:
    """Rows as they come, our column -> cell."""

    profile: Profile
    rows: list[dict[str, str]] = field(default_factory=list)
    _first: dict[str, dict[str, str]] = field(default_factory=dict)
    _later: int = 0

    def enter(self, row: dict[str, str]) -> None:
        """Add a row, or where targets have lines of their own, put this target into the last row of
        its pose.

        Raises
        ------
        Misfit
            A target that is none, or a reading that is another than in a line of this pose before.
        """
        targets: tuple[str, ...] = getattr(self.profile.kind, "targets", ())
        if "target" not in row or not targets:
            self.rows.append(row)
            return
        target = row["target"]
        if target not in targets:
            raise Misfit(f"the target {target!r} is none of {', '.join(targets)}")
        shared = {name: cell for name, cell in row.items() if name != "target"}
        if len(targets) == 1:
            self.rows.append(shared)
            return
        values = {
            _of_target(name, target): shared.pop(name)
            for name in list(shared)
            if _is_of_target(name, self.profile)
        }
        self._check_readings(shared)
        last = self.rows[-1] if self.rows else {}
        if not any(name in last for name in values) and _agree(last, shared):
            self._later += bool(last.get(TIME) and shared.get(TIME)) and last[TIME] != shared[TIME]
            last.update(values)
            last.update({name: cell for name, cell in shared.items() if not last.get(name)})
        else:
            self.rows.append(shared | values)

    @property
    def notes(self) -> tuple[str, ...]:
        """What lines of several targets say differently."""
        if not self._later:
            return ()
        count = (
            "1 line of a further target states"
            if self._later == 1
            else f"{self._later} lines of further targets state"
        )
        return (f"{count} another time than the first line of the row, whose time is kept",)

    def _check_readings(self, row: Mapping[str, str]) -> None:
        """Refuse a reading that is another than in a line of this pose before."""
        first = self._first.setdefault(row["pose"], {})
        for name in self.profile.readings:
            cell, before = row[name], first.get(name, "")
            if cell and before and not _same(cell, before):
                raise Misfit(
                    f"{name!r} is {cell} here, but {before} in a line of the pose {row['pose']!r} "
                    "before"
                )
        first.update(
            {name: row[name] for name in self.profile.readings if row[name] and not first.get(name)}
        )


def headers(profile: Profile) -> dict[str, str | None]:
    """Return column -> unit of the measurement file, None for text."""
    units = {name: source.unit for name, source in profile.columns.items() if name != "pose"}
    units |= {name: "1" for name in ("qw", "qx", "qy", "qz") if profile.matrix}
    targets: tuple[str, ...] = getattr(profile.kind, "targets", ())
    if len(targets) < 2:
        own = [profile.called(column.name) for column in profile.kind.columns]
        return (
            {"pose": None}
            | {n: u for n, u in units.items() if n not in own}
            | {n: units[n] for n in own}
        )
    pose = {name: symbol for name, symbol in units.items() if not _is_of_target(name, profile)}
    values = list(dict.fromkeys(column.name.partition(".")[2] for column in profile.kind.columns))
    beside = [name for name in units if _is_of_target(name, profile) and name not in values]
    each = [(name, target) for target in targets for name in values] + [
        (n, t) for n in beside for t in targets
    ]
    return {"pose": None} | pose | {_of_target(name, target): units[name] for name, target in each}


def _is_of_target(name: str, profile: Profile) -> bool:
    """Tell whether a column says something of a target, not of the pose."""
    values = {column.name.partition(".")[2] for column in profile.kind.columns}
    stem = name.removeprefix(SIGMA)
    return stem in values or name.startswith((COVARIANCE, "note"))


def _of_target(name: str, target: str) -> str:
    """Return what a column is called for one of several targets."""
    if name.startswith("note"):
        return f"{name} {target}"
    if name.startswith(COVARIANCE):
        return COVARIANCE + ".".join(
            f"{target}.{part}" for part in name.removeprefix(COVARIANCE).split(".")
        )
    return (
        f"{SIGMA}{target}.{name.removeprefix(SIGMA)}"
        if name.startswith(SIGMA)
        else f"{target}.{name}"
    )


def _agree(last: Mapping[str, str], row: Mapping[str, str]) -> bool:
    """Tell whether two lines are of one pose, session, group and block, and say nothing else
    differently but the time.
    """
    alike = all(last.get(name) == row.get(name) for name in ("pose", "session", "group", "block"))
    said = [name for name in row if name != TIME and last.get(name) and row[name]]
    return alike and all(_same(last[name], row[name]) for name in said)


def _same(one: str, other: str) -> bool:
    """Tell whether two cells say the same, numbers by their value."""
    a, b = plain_number(one), plain_number(other)
    return one == other or (a is not None and a == b)
