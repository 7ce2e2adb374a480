# SPDX-License-Identifier: Apache-2.0
"""The dialog of `loopcal measure`: what it shows, and the rows and commands that it takes.

Rows come from standard input, where they are typed, pasted or piped, and from an export that an
instrument writes meanwhile. What rows mean is decided by `loopcal.planning.companion`.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.cli.hints import with_hint
from loopcal.cli.terminal import print_text, width
from loopcal.errors import DataError, FileError, suggest_names
from loopcal.findings import Finding, report_finding
from loopcal.io.exports.growing_export import GrowingExport, read_new_rows
from loopcal.io.formats.gcode_program import format_move
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
from loopcal.planning.companion import (
    Companion,
    CompanionTask,
    Verdict,
    choose_next,
    examine_row,
    report_progress,
    take_rows,
)
from loopcal.results.tables import (
    Block,
    Column,
    Table,
    format_uncertainty,
    format_with_uncertainty,
    render_text,
    word_column,
)
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
POLL = 0.5  # seconds between two looks at a followed export


Row = tuple[str, dict[str, str]]
"""Pose of a row of an export, empty for the suggested one, and its cells."""


@dataclass
class Dialog:
    """The dialog of one session."""

    task: CompanionTask
    journal: Journal
    export: GrowingExport | None
    gcode: bool
    is_silent: bool
    state: Companion = field(init=False)
    skipped: list[int] = field(default_factory=list)
    chosen: int | None = None
    progress: tuple[Finding, ...] = ()

    def run(self) -> None:
        """Ask for rows until the work is done, or the input ends."""
        visits = self.journal.visits
        judged = [visit for visit in visits if visit.is_used is not None]
        self.state = self._restore(judged)
        if visits:
            used = sum(bool(visit.is_used) for visit in visits)
            self.say(report_finding("session.resumed", rows=len(visits), used=used))
        if len(judged) < len(visits):  # the command ended before the last row was judged
            self._judge()
        self._write()
        inputs = self._list_inputs()
        while True:
            following = choose_next(self.state, self.skipped, self.chosen)
            self.progress = report_progress(self.state, following)
            self.say(*self.progress)
            pose = following.pose
            if pose is None and self.export is not None:
                return
            if pose is not None:
                self._show_pose(pose)
            if not self._take(inputs, pose):
                return

    def _take(self, inputs: Iterator[str | Row], pose: int | None) -> bool:
        """Take rows and commands until the state has changed; return whether to go on."""
        for given in inputs:
            word, _, name = given.partition(" ") if isinstance(given, str) else ("", "", "")
            if word in ("quit", "exit", "q"):
                return False
            if isinstance(given, tuple):
                is_done = self._measure(*given, pose)
            elif word in ("back", "keep", "out"):
                is_done = self._decide(word)
            elif word == "skip" and pose is not None:
                self.skipped.append(pose)
                self.chosen, is_done = None, True
            elif word == "pose":
                self.chosen = self._find_pose(name)
                is_done = self.chosen is not None
            elif word in ("help", "?", "h"):
                self.say(*(f"  {word:10} {what}" for word, what in COMMANDS.items()))
                is_done = False
            else:
                is_done = self._type(given, pose)
            if is_done:
                return True
        return False

    def _type(self, text: str, pose: int | None) -> bool:
        """Take a typed row; return whether it was one."""
        columns = self.journal.columns
        name, values = split_values(text, len(columns))
        if values is None:
            shown = repr(text if len(text) < 40 else f"{text[:40]}...")
            facts = {"text": shown, "columns": self._list_headers(), "commands": tuple(COMMANDS)}
            self.say(report_finding("session.line-not-understood", **facts))
            return False
        return self._measure(name, dict(zip(columns, values, strict=True)), pose)

    def _find_pose(self, name: str) -> int | None:
        """Return the place of a pose in the sheet; None, with a note, where there is none."""
        labels = self.task.labels
        if name in labels:
            return labels.index(name)
        similar = suggest_names(name, labels)
        self.say(report_finding("session.pose-unknown", pose=repr(name), similar=similar))
        return None

    def _measure(self, name: str, cells: dict[str, str], pose: int | None) -> bool:
        """Write a row to the disk, judge it, and say so; return whether there is one."""
        place = self._find_pose(name) if name else pose
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
        verdict = examine_row(self.state, measured, place)
        self._show_verdict(verdict, measured)
        for visit, now in zip(journal.visits, verdict.is_used, strict=True):
            if visit.is_used != now:
                journal.decide(USED if now else LEFT_OUT, visit.number)
        poses = (*self.state.poses, place)
        self.state = take_rows(self.task, measured, poses, verdict.is_used, self.state)
        self._write()
        self.chosen = None
        return True

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

    def _restore(self, visits: Sequence[Visit]) -> Companion:
        """Return the state of rows on the disk."""
        poses = [self.task.labels.index(visit.pose) for visit in visits]
        used = np.array([bool(visit.is_used) for visit in visits], dtype=bool)
        measured = read_visits(self.task.robot, self.journal.sheet, visits) if visits else None
        return take_rows(self.task, measured, poses, used)

    def _write(self) -> None:
        write_measurements(self.journal.path.parent, self.journal.sheet, self.journal.visits)

    # What is shown.

    def say(self, *lines: Block | Finding) -> None:
        """Print lines or findings, wrapped; nothing with --json."""
        if lines and not self.is_silent:
            words = [with_hint(line) if isinstance(line, Finding) else line for line in lines]
            print_text(render_text(words, width()) + "\n")

    def _show_pose(self, pose: int) -> None:
        """Show what to command for a pose, and ask for its values."""
        sheet, label, robot = self.journal.sheet, self.task.labels[pose], self.task.robot
        row = sheet.pose_names().index(label)
        names = [a.name for a in robot.actuators if a.name in sheet.units]
        cells = (f"{n}={sheet.text(n)[row]}{sheet.units[n] or ''}" for n in names)
        lines = [f"Command pose {label}: {', '.join(cells)}"]
        if self.gcode:
            coordinates = self.task.problem.candidates.coordinates[pose]
            unit: Literal["mm", "in"] = "in" if robot.units[Dimension.LENGTH] == "in" else "mm"
            lines.append(format_move(robot, coordinates, unit))
        self.say(*lines, f"Measured {' '.join(self._list_headers())}, or help:")

    def _list_headers(self) -> tuple[str, ...]:
        units = self.journal.sheet.units
        return tuple(f"{n} [{units[n]}]" if units[n] else n for n in self.journal.columns)

    def _show_verdict(self, verdict: Verdict, measured: Measurements) -> None:
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
                cells.append(format_with_uncertainty(value, sd) if is_known else "unknown")
                cells.append(format_uncertainty(sd) if is_known else "")
            rows.append(tuple(cells))
        numbers = (Column(title) for name in pairs for title in (name, "sd"))
        columns = (word_column("value"), word_column("unit"), *numbers)
        self.say(Table("", columns, tuple(rows)), *verdict.findings)

    # What comes in.

    def _list_inputs(self) -> Iterator[str | Row]:
        """Give typed lines and rows of the export as they come; without an export until the input
        ends.
        """
        lines: queue.Queue[str | None] = queue.Queue()

        def read() -> None:
            for line in iter(sys.stdin.readline, ""):
                lines.put(line.strip())
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        while True:
            if self.export is not None:
                yield from self._follow(self.export)
            try:
                line = lines.get(timeout=POLL)
            except queue.Empty:
                continue
            if line is None and self.export is None:
                return
            if line:
                yield line

    def _follow(self, export: GrowingExport) -> Iterator[Row]:
        """Give the new rows of the export."""
        new, journal = read_new_rows(export), self.journal
        self.export = new.export
        self.say(*new.findings)
        for row in new.rows:
            cells = convert_cells(row, new.units, journal.sheet, journal.columns)
            yield row.get("pose", ""), cells
