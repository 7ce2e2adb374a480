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
from typing import Literal, NamedTuple

import numpy as np

from loopcal.cli.hints import with_hint
from loopcal.cli.terminal import print_text, width
from loopcal.errors import DataError, FileError, suggest_names
from loopcal.findings import Finding, report_finding
from loopcal.io.data.kind_settings import KindRows
from loopcal.io.exports.growing_export import GrowingExport, read_new_rows
from loopcal.io.exports.profile import Profile
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
POLL = 0.5
"""Seconds between two looks at a followed export."""


@dataclass
class FollowedExport:
    """An export that an instrument writes, and how it is read."""

    export: GrowingExport
    profile: Profile
    by_order: bool


class Given(NamedTuple):
    """What was typed, or a row of an export: its pose (empty for the suggested one) and cells."""

    text: str = ""
    pose: str = ""
    cells: dict[str, str] | None = None


@dataclass
class Dialog:
    """The dialog of one session."""

    task: CompanionTask
    journal: Journal
    entry: KindRows
    source: FollowedExport | None
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
            following = choose_next(self.state, self.skipped)
            self.progress = report_progress(self.state, following)
            self.say(*self.progress)
            pose = following.pose if self.chosen is None else self.chosen
            if pose is None and self.source is not None:
                return
            if pose is not None:
                self._show_pose(pose)
            if not self._take(inputs, pose):
                return

    def _take(self, inputs: Iterator[Given], pose: int | None) -> bool:
        """Take rows and commands until the state has changed; return whether to go on."""
        for given in inputs:
            if given.cells is not None:
                if self._measure(given.pose, given.cells, pose):
                    return True
                continue
            word, _, name = given.text.partition(" ")
            if word in ("quit", "exit", "q"):
                return False
            if word in ("help", "?", "h"):
                self.say(*(f"  {word:10} {what}" for word, what in COMMANDS.items()))
            elif word in ("back", "keep", "out"):
                if self._decide(word):
                    return True
            elif word == "skip" and pose is not None:
                self.skipped.append(pose)
                self.chosen = None
                return True
            elif word == "pose":
                if self._find_pose(name) is not None:
                    self.chosen = self._find_pose(name)
                    return True
            elif self._type(given.text, pose):
                return True
        return False

    def _type(self, text: str, pose: int | None) -> bool:
        """Take a typed row; return whether it was one."""
        sheet, columns = self.journal.sheet, self.journal.columns
        name, values = split_values(text, len(columns))
        if values is None:
            headers = tuple(f"{name} [{sheet.units[name]}]" for name in columns)
            shown = text if len(text) < 40 else f"{text[:40]}..."
            facts = {"text": repr(shown), "columns": headers}
            self.say(
                report_finding("session.line-not-understood", **facts, commands=tuple(COMMANDS))
            )
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
        is_known = name and any(v.pose == label and v.cells == cells for v in journal.visits)
        if is_known and self.source is not None:
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
        self.journal.decide(events[word], self.journal.visits[-1].number)
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
        sheet, label = self.journal.sheet, self.task.labels[pose]
        row = sheet.pose_names().index(label)
        readings = [
            f"{a.name} {sheet.text(a.name)[row]} {sheet.units[a.name] or ''}".rstrip()
            for a in self.task.robot.actuators
            if a.name in sheet.units
        ]
        lines = [f"Command pose {label}: {', '.join(readings)}"]
        if self.gcode:
            unit: Literal["mm", "in"] = (
                "in" if self.task.robot.units[Dimension.LENGTH] == "in" else "mm"
            )
            lines.append(
                format_move(self.task.robot, self.task.problem.candidates.coordinates[pose], unit)
            )
        headers = " ".join(f"{name} [{sheet.units[name]}]" for name in self.journal.columns)
        lines.append(f"Measured {headers}, or help:")
        self.say(*lines)

    def _show_verdict(self, verdict: Verdict, measured: Measurements) -> None:
        """Show measured and expected values of the last row, and what it says."""
        (observed,) = measured.observations
        kind, prediction, sheet = observed.kind, verdict.prediction, self.journal.sheet
        are_columns = [c.name for c in kind.columns] == list(prediction.names)
        rows = []
        for i, column in enumerate(kind.noise_columns):
            if np.isnan(prediction.sd[i]):
                continue
            symbol = sheet.units.get(column.name) if are_columns else None
            unit = (
                self.task.robot.get_unit(column.dimension) if symbol is None else find_unit(symbol)
            )
            noise, sd = prediction.noise[i], prediction.sd[i]
            own = np.sqrt(max(sd**2 - noise**2, (1e-3 * noise) ** 2))
            pairs: list[tuple[float, float]] = [(prediction.difference[i], sd)]
            if are_columns:
                last = observed.measured[int(np.argmax(observed.rows))]
                pairs = [(last[i], noise), (verdict.expected[i], own), *pairs]
            cells = []
            for value, spread in pairs:
                if np.isfinite(spread):
                    scaled = value / unit.factor_to_si, spread / unit.factor_to_si
                    cells += [format_with_uncertainty(*scaled), format_uncertainty(scaled[1])]
                else:
                    cells += ["unknown", ""]
            rows.append((column.name, unit.symbol, *cells))
        titles = ("measured", "expected", "difference") if are_columns else ("difference",)
        numbers = (Column(title) for name in titles for title in (name, "sd"))
        columns = (word_column("value"), word_column("unit"), *numbers)
        self.say(Table("", columns, tuple(rows)), *verdict.findings)

    # What comes in.

    def _list_inputs(self) -> Iterator[Given]:
        """Give typed lines and rows of the export as they come; without an export until the input
        ends.
        """
        lines: queue.Queue[str | None] = queue.Queue()
        source = self.source

        def read() -> None:
            for line in iter(sys.stdin.readline, ""):
                lines.put(line)
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        is_open = True
        while True:
            if source is not None:
                yield from self._follow(source)
            try:
                line = lines.get(timeout=POLL if source is not None or is_open else None)
            except queue.Empty:
                continue
            if line is None:
                if source is None:
                    return
                is_open = False
            elif line.strip():
                yield Given(line.strip())

    def _follow(self, source: FollowedExport) -> Iterator[Given]:
        """Give the new rows of the export."""
        new = read_new_rows(source.export, source.profile, self.entry, source.by_order)
        source.export = new.export
        self.say(*new.findings)
        for row in new.rows:
            cells = convert_cells(row, new.units, self.journal.sheet, self.journal.columns)
            yield Given(pose="" if source.by_order else row["pose"], cells=cells)
