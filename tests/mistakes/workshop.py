# SPDX-License-Identifier: Apache-2.0
"""Machines with correct files, and mistakes that users make in them.

A mistake edits the correct files, runs one command, and states what loopcal must answer: the exit
code, what the text must say, and what it must not say. The correct files are tested too: they lead
to a calibration without a warning, so that every answer is due to the mistake.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from loopcal.cli.entry_point import main

Files = dict[str, str]

ROBOT, DATA = "robot.yaml", "data.csv"
CALIBRATE = f"calibrate {ROBOT} {DATA} -o run --hold-out 0.25"


@dataclass(frozen=True)
class Machine:
    """A machine and its instrument.

    Attributes
    ----------
    robot : text of its robot file. instrument : options of `loopcal simulate`. seed : of the
        simulated errors and noise.
    """

    robot: str
    instrument: str
    seed: int = 1

    def make_files(self, folder: Path) -> Files:
        """Return the correct robot file and measurement file."""
        (folder / ROBOT).write_text(self.robot)
        options = f"--draw-errors --seed {self.seed} {self.instrument}"
        assert main(f"simulate {folder / ROBOT} -o {folder / DATA} {options}".split()) == 0
        return {name: (folder / name).read_text("utf-8") for name in (ROBOT, DATA)}


@dataclass(frozen=True)
class Mistake:
    """What a user does wrong, and the right answer.

    Attributes
    ----------
    edit : correct files -> wrong files. exit_code : of the command.
    says : patterns that the output (both streams, spaces joined) must contain.
    never : patterns that it must not contain. command : with the names of the files.
    """

    edit: Callable[[Files], Files]
    exit_code: int
    says: tuple[str, ...]
    never: tuple[str, ...] = ()
    command: str = CALIBRATE


def answer(
    files: Mapping[str, str], command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> tuple[int, str]:
    """Run a command on files in a folder; return its exit code and all that it prints."""
    for name, text in files.items():
        (folder / name).write_text(text, "utf-8")
    capsys.readouterr()
    code = main(command.split())
    printed = capsys.readouterr()
    return code, " ".join((printed.out + " " + printed.err).split())


def check_answer(
    files: Mapping[str, str], mistake: Mistake, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Make the mistake and compare the answer with the right one."""
    edited = mistake.edit(dict(files))
    assert edited != files or mistake.command != CALIBRATE, "nothing was changed"
    code, text = answer(edited, mistake.command, folder, capsys)
    assert code == mistake.exit_code, text
    for pattern in mistake.says:
        assert re.search(pattern, text), f"{pattern!r} is not said in: {text}"
    for pattern in (*mistake.never, "Traceback"):
        assert not re.search(pattern, text), f"{pattern!r} is said in: {text}"


# --- edits of the measurement file


@dataclass(frozen=True)
class Sheet:
    """A measurement file as settings, header and rows of cells."""

    settings: tuple[str, ...]
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def column(self, name: str) -> int:
        """Return the index of the column whose header begins with this name."""
        return [head.split(" ")[0] for head in self.header].index(name)


def read_sheet(text: str) -> Sheet:
    """Return the parts of a measurement file."""
    lines = text.splitlines()
    settings = tuple(line for line in lines if line.startswith("#"))
    header, *rows = (tuple(line.split(",")) for line in lines if not line.startswith("#"))
    return Sheet(settings, header, tuple(rows))


def write_sheet(sheet: Sheet) -> str:
    """Return the text of a measurement file."""
    table = (sheet.header, *sheet.rows)
    return "\n".join((*sheet.settings, *(",".join(cells) for cells in table))) + "\n"


def in_sheet(change: Callable[[Sheet], Sheet]) -> Callable[[Files], Files]:
    """Return an edit of the files that changes the measurement file."""
    return lambda files: files | {DATA: write_sheet(change(read_sheet(files[DATA])))}


def change_values(
    change: Callable[[float], float | None], *names: str, rows: slice = slice(None)
) -> Callable[[Files], Files]:
    """Return an edit that changes the numbers of columns in some rows; None empties a cell."""

    def edit(sheet: Sheet) -> Sheet:
        places = [sheet.column(name) for name in names]
        changed = list(sheet.rows)
        for i in range(len(changed))[rows]:
            cells = list(changed[i])
            for place in places:
                value = change(float(cells[place]))
                cells[place] = "" if value is None else repr(value)
            changed[i] = tuple(cells)
        return replace(sheet, rows=tuple(changed))

    return in_sheet(edit)


def swap_columns(first: str, second: str) -> Callable[[Files], Files]:
    """Return an edit that writes the values of two columns under the header of the other."""

    def edit(sheet: Sheet) -> Sheet:
        a, b = sheet.column(first), sheet.column(second)
        order = list(range(len(sheet.header)))
        order[a], order[b] = b, a
        return replace(sheet, rows=tuple(tuple(row[i] for i in order) for row in sheet.rows))

    return in_sheet(edit)


def shift_rows(*names: str) -> Callable[[Files], Files]:
    """Return an edit that moves the values of columns one row down; the first row is lost."""

    def edit(sheet: Sheet) -> Sheet:
        places = {sheet.column(name) for name in names}
        pairs = zip(sheet.rows[1:], sheet.rows[:-1], strict=True)
        rows = (
            tuple((before if i in places else now)[i] for i in range(len(now)))
            for now, before in pairs
        )
        return replace(sheet, rows=tuple(rows))

    return in_sheet(edit)


def take_rows(chosen: slice) -> Callable[[Files], Files]:
    """Return an edit that keeps some rows only."""
    return in_sheet(lambda sheet: replace(sheet, rows=sheet.rows[chosen]))


def empty_cell(name: str, row: int) -> Callable[[Files], Files]:
    """Return an edit that empties one cell."""

    def edit(sheet: Sheet) -> Sheet:
        rows = [list(cells) for cells in sheet.rows]
        rows[row][sheet.column(name)] = ""
        return replace(sheet, rows=tuple(map(tuple, rows)))

    return in_sheet(edit)


def replace_text(file: str, old: str, new: str, count: int = 1) -> Callable[[Files], Files]:
    """Return an edit that replaces text in a file."""

    def edit(files: Files) -> Files:
        assert old in files[file], f"{old!r} does not occur in {file}"
        return files | {file: files[file].replace(old, new, count)}

    return edit


def keep_files(files: Files) -> Files:
    """Change nothing: the mistake is in the command."""
    return files
