# SPDX-License-Identifier: Apache-2.0
"""A session of measuring the poses of a plan, which the terminal and `loopcal app` share.

Given rows and words change the state and the files of the session; what they mean is decided by
`loopcal.planning.companion`. What is to be shown goes to `say`, which each of the two defines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from loopcal.errors import DataError, FileError, suggest_names
from loopcal.findings import Finding, report_finding
from loopcal.io.core.csv_table import Table as Sheet
from loopcal.io.data import measurement_file
from loopcal.io.data.kind_settings import KindRows
from loopcal.io.exports.conversion import read_sheet
from loopcal.io.exports.growing_export import GrowingExport, read_new_rows
from loopcal.io.formats.gcode_program import format_move
from loopcal.io.runs.plan_folder import find_asked
from loopcal.io.runs.session_folder import (
    LEFT_OUT,
    TAKEN_BACK,
    USED,
    Journal,
    Visit,
    convert_cells,
    read_visits,
    split_values,
    write_measurements,
)
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.planning import companion
from loopcal.planning.constraints import restore_options
from loopcal.results import tables
from loopcal.units import Dimension, find_unit

COMMANDS = {
    "back": "take the last row back",
    "keep": "use the last row although it does not fit",
    "out": "leave the last row out",
    "skip": "suggest another pose",
    "pose NAME": "measure this pose next",
    "help": "show these words",
    "quit": "end, and resume with this command later",
}


Row = tuple[str, dict[str, str]]
"""Pose of a row of an export, empty for the suggested one, and its cells."""


def make_pace(minutes: float | None, speed: float | None) -> companion.Pace:
    """Return how long poses take; `speed` [mm per minute] without `minutes` is a DataError."""
    if speed is not None and minutes is None:
        raise DataError.of("session.speed-alone")
    return companion.Pace(minutes) if speed is None else companion.Pace(minutes, 1e-3 * speed)


def prepare_session(
    sheet: Path,
    robot: Mechanism,
    goal: tuple[float, str] | None,
    pace: companion.Pace,
    check_every: int,
) -> tuple[companion.CompanionTask, Sheet, KindRows]:
    """Return the task of measuring a sheet, its table, and its kind.

    goal : error over the workspace [SI] and its quantity; None takes that of the plan.

    FileError : the sheet asks for readings, or has measured values. Raises as `prepare_task`.
    """
    table, entry = read_sheet(sheet, robot)
    if measurement_file.has_empty_readings(sheet, robot):
        raise FileError("this sheet asks for readings. Fill in the file itself", sheet)
    asked = {} if goal is None else dict(zip(("goal", "target"), goal, strict=True))
    task = companion.prepare_task(
        measurement_file.load_measurements(sheet, robot),
        robot,
        measurement_file.load_instrument_to_plan(sheet, robot),
        restore_options({**find_asked(sheet), **asked}),
        pace,
        check_every,
    )
    return task, table, entry


@dataclass
class MeasuringSession:
    """The state of one session: rows, skipped poses, and the pose to measure next; `say` shows
    paragraphs, tables and findings. known : cells of earlier rows that the export has not repeated.
    """

    task: companion.CompanionTask
    journal: Journal
    say: Callable[..., None]
    export: GrowingExport | None = None
    gcode: bool = False
    state: companion.Companion = field(init=False)
    skipped: list[int] = field(default_factory=list)
    chosen: int | None = None
    pose: int | None = None
    progress: tuple[Finding, ...] = ()
    known: list[dict[str, str]] = field(default_factory=list)

    def resume(self) -> None:
        """Take the rows that are on the disk."""
        visits, self.known = self.journal.visits, list(self.journal.measured)
        judged = [visit for visit in visits if visit.is_used is not None]
        self.state = self._restore(judged)
        if visits:
            used = sum(bool(visit.is_used) for visit in visits)
            self.say(report_finding("session.resumed", rows=len(visits), used=used))
        if len(judged) < len(visits):  # the command ended before the last row was judged
            self._judge()
        self._write()

    def choose_pose(self) -> None:
        """Choose the pose to measure next, and say how far the work is."""
        following = companion.choose_next(self.state, self.skipped, self.chosen)
        self.progress, self.pose = companion.report_progress(self.state, following), following.pose
        self.say(*self.progress)

    def take(self, given: str | Row) -> bool:
        """Take a row or a word of `COMMANDS`; return whether the state has changed."""
        word, _, name = given.partition(" ") if isinstance(given, str) else ("", "", "")
        if isinstance(given, tuple):
            return self._measure(*given)
        if word in ("back", "keep", "out"):
            return self._decide(word)
        if word == "skip" and self.pose is not None:
            self.skipped.append(self.pose)
            self.chosen = None
            return True
        if word == "pose":
            self.chosen = self._find_pose(name)
            return self.chosen is not None
        return self._type(given)

    def _type(self, text: str) -> bool:
        """Take a typed row; return whether it was one."""
        columns = self.journal.columns
        name, values = split_values(text, len(columns))
        if values is None:
            shown = repr(text if len(text) < 40 else f"{text[:40]}...")
            facts = {"text": shown, "columns": self.list_headers(), "commands": tuple(COMMANDS)}
            self.say(report_finding("session.line-not-understood", **facts))
            return False
        return self._measure(name, dict(zip(columns, values, strict=True)))

    def _find_pose(self, name: str) -> int | None:
        """Return the place of a pose in the sheet; None, with a note, where there is none."""
        labels = self.task.labels
        if name in labels:
            return labels.index(name)
        similar = suggest_names(name, labels)
        self.say(report_finding("session.pose-unknown", pose=repr(name), similar=similar))
        return None

    def _measure(self, name: str, cells: dict[str, str]) -> bool:
        """Write a row to the disk, judge it, and say so; return whether there is one."""
        place = self._find_pose(name) if name else self.pose
        if place is None:
            return False
        journal, label = self.journal, self.task.labels[place]
        if not any(cells.values()):
            self.say(report_finding("session.no-value"))
            return False
        equal = [v for v in journal.visits if v.pose == label and v.cells == cells]
        if self.export is None and any(v.is_used is False for v in equal):
            self.say(report_finding("session.row-copied", pose=label))
            return False
        if name and equal and self.export is not None:
            self.say(report_finding("session.row-identical", pose=label))
            return False
        journal.measure(label, cells)
        return self._judge()

    def _judge(self) -> bool:
        """Judge the last row on the disk, and say so; return whether it can be read."""
        journal = self.journal
        try:
            measured = read_visits(self.task.robot, journal.sheet, journal.visits)
        except (DataError, FileError) as error:
            journal.decide(TAKEN_BACK, journal.visits[-1].number)
            self.say(str(error))
            return False
        place = self.task.labels.index(journal.visits[-1].pose)
        verdict = companion.examine_row(self.state, measured, place)
        self._show_verdict(verdict, measured)
        for visit, now in zip(journal.visits, verdict.is_used, strict=True):
            if visit.is_used != now:
                journal.decide(USED if now else LEFT_OUT, visit.number)
        poses = (*self.state.poses, place)
        self.state = companion.take_rows(self.task, measured, poses, verdict.is_used, self.state)
        self._write()
        self.chosen = None
        return True

    def read_export(self) -> Iterator[Row]:
        """Give the new rows of the export."""
        if self.export is not None:
            new, journal = read_new_rows(self.export), self.journal
            self.export = new.export
            self.say(*new.findings)
            for row in new.rows:
                cells = convert_cells(row, new.units, journal.sheet, journal.columns)
                if not row.get("pose") and cells in self.known:  # of an earlier command
                    self.known.remove(cells)
                else:
                    yield row.get("pose", ""), cells

    def _decide(self, word: str) -> bool:
        """Take the last row back, use it or leave it out; return whether there is one."""
        if not self.journal.visits:
            self.say(report_finding("session.nothing-to-take-back"))
            return False
        events = {"back": TAKEN_BACK, "keep": USED, "out": LEFT_OUT}
        last = self.journal.visits[-1]
        self.journal.decide(events[word], last.number)
        self.say(report_finding("session.row-decided", word=word, pose=last.pose))
        self.state = self._restore(self.journal.visits)
        self._write()
        return True

    def _restore(self, visits: Sequence[Visit]) -> companion.Companion:
        """Return the state of rows on the disk."""
        poses = [self.task.labels.index(visit.pose) for visit in visits]
        used = np.array([bool(visit.is_used) for visit in visits], dtype=bool)
        measured = read_visits(self.task.robot, self.journal.sheet, visits) if visits else None
        return companion.take_rows(self.task, measured, poses, used)

    def _write(self) -> None:
        write_measurements(self.journal.path.parent, self.journal.sheet, self.journal.visits)

    # What is shown.

    def describe_pose(self, pose: int) -> list[str]:
        """Return what to command for a pose."""
        sheet, label, robot = self.journal.sheet, self.task.labels[pose], self.task.robot
        row = sheet.pose_names().index(label)
        names = [a.name for a in robot.actuators if a.name in sheet.units]
        cells = (f"{n}={sheet.text(n)[row]}{sheet.units[n] or ''}" for n in names)
        lines = [f"Command pose {label}: {', '.join(cells)}"]
        if self.gcode:
            coordinates = self.task.problem.candidates.coordinates[pose]
            unit: Literal["mm", "in"] = "in" if robot.units[Dimension.LENGTH] == "in" else "mm"
            lines.append(format_move(robot, coordinates, unit))
        return lines

    def list_headers(self) -> tuple[str, ...]:
        """Return the measured columns, with their units."""
        units = self.journal.sheet.units
        return tuple(f"{n} [{units[n]}]" if units[n] else n for n in self.journal.columns)

    def _show_verdict(self, verdict: companion.Verdict, measured: Measurements) -> None:
        """Show measured and expected values of the last row, and what it says."""
        (observed,) = measured.observations
        kind, found, units = observed.kind, verdict.prediction, self.journal.sheet.units
        last = observed.measured[int(np.argmax(observed.rows))]
        own = np.sqrt(np.maximum(found.sd**2 - found.noise**2, (1e-3 * found.noise) ** 2))
        pairs = {"difference": (found.difference, found.sd)}
        if [column.name for column in kind.columns] == list(found.names):
            shown = {"measured": (last, found.noise), "expected": (verdict.expected, own)}
            pairs = shown | pairs
        rows = []
        for i in np.flatnonzero(~np.isnan(found.sd)):
            column = kind.noise_columns[i]
            symbol = units.get(column.name) or self.task.robot.get_unit(column.dimension).symbol
            cells, factor = [column.name, symbol], find_unit(symbol).factor_to_si
            for values, sds in pairs.values():
                value, sd = values[i] / factor, sds[i] / factor
                is_known = np.isfinite(sd)
                cells.append(tables.format_with_uncertainty(value, sd) if is_known else "unknown")
                cells.append(tables.format_uncertainty(sd) if is_known else "")
            rows.append(tuple(cells))
        numbers = (tables.Column(title) for name in pairs for title in (name, "sd"))
        columns = (tables.word_column("value"), tables.word_column("unit"), *numbers)
        self.say(tables.Table("", columns, tuple(rows)), *verdict.findings)
