# SPDX-License-Identifier: Apache-2.0
"""Every command that writes, killed and interrupted while it writes.

A command runs in a process of its own up to the moment before it creates its first temporary file.
From there it continues in many forked copies, one after the other, each in the same folder with the
same old outputs. A copy is killed (SIGKILL) or interrupted (SIGINT) before a line of Python runs
that has to do with outputs, or, in copies whose file operations are slowed down, after a time.
Afterwards the command writes once more, undisturbed.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from loopcal.cli.entry_point import main
from loopcal.io.core import outputs, text_file

MODULES = (outputs, text_file, shutil)
TRACED = frozenset(str(module.__file__) for module in MODULES)
FIRST = ("write_result_folder", "restore_files", "replace_file")
"""The functions that write; the first one that is called begins to write."""

LEFTOVER = re.compile(r"\.loopcal-(new|old)-[0-9a-f]{16}-.+")
DELAY = 0.004
"""Before and after each file operation of a slow copy [s]."""

MEMORY = Path("/dev/shm")
"""A disk in memory, where hundreds of synchronized writes take no time."""

KILL, INTERRUPT = "kill -9", "Ctrl-C"
PRINTER = """[printer]
kinematics: delta
delta_radius: 130.25
[stepper_a]
position_endstop: 250
arm_length: 269
"""
FIVE_BAR = {
    "data.csv": "simulate five-bar -o data.csv",
    "run": "calibrate five-bar data.csv -o run",
    "targets.csv": "pose,x [mm],y [mm]\na,0,200\nb,20,210\n",
}
"""Inputs: the text of a file, or the command that makes it."""


@dataclass(frozen=True)
class Case:
    """A command and its outputs; `old` makes the old ones where it is not the text of a file."""

    words: str
    outputs: tuple[str, ...]
    old: str = "old\n"


CASES = {
    "calibrate": Case("calibrate five-bar data.csv -o out --force", ("out",), "--seed 5"),
    "calibrate, no old run": Case("calibrate five-bar data.csv -o out", ("out",), ""),
    "plan": Case("plan five-bar -o out --poses 8 --force", ("out",), "--seed 5"),
    "plan, no old plan": Case("plan five-bar -o out --poses 8", ("out",), ""),
    "reproduce": Case("reproduce hexapod-42 -o out --trials 2 --force", ("out",), "--seed 5"),
    "compensate": Case("compensate run targets.csv -o out.csv --force", ("out.csv",)),
    "import": Case("import printer.cfg -o out.yaml --force", ("out.yaml",)),
    "export": Case("export run --format json -o out.json --force", ("out.json",)),
    "new": Case("new five-bar -o out.yaml --measurements out.csv --force", ("out.yaml", "out.csv")),
    "simulate": Case(
        "simulate five-bar -o out.csv --truth out.yaml --force", ("out.csv", "out.yaml")
    ),
    "bootstrap": Case("bootstrap run -o out.csv --count 50 --force", ("out.csv",)),
    "sample": Case("sample run -o out.csv --force", ("out.csv",)),
    "identifiability": Case(
        "identifiability five-bar data.csv --fix-unidentifiable -o out.yaml --force", ("out.yaml",)
    ),
    "check": Case("check five-bar --plot out.png --force", ("out.png",)),
}

MOMENTS, TIMES = 50, 12
"""Lines before which a copy is stopped, and times at which a slow one is; a slow copy takes up to a
second.
"""

State = dict[str, dict[str, bytes] | None]
"""Output -> name -> content of its files; None where there is no output."""


@dataclass(frozen=True)
class Fault:
    """What happens to a copy: `how` (KILL, INTERRUPT or nothing) before line number `moment`, or
    where it is slow after this share of its time.
    """

    how: str = ""
    moment: float = 0.0
    is_slow: bool = False


def prepare_inputs(folder: Path) -> None:
    """Make the inputs of all cases in a folder."""
    (folder / "printer.cfg").write_text(PRINTER)
    for name, content in FIVE_BAR.items():
        if "\n" in content:
            (folder / name).write_text(content)
        else:
            _run_in(folder, content)


def examine(case: Case, inputs: Path, moments: int, slow: int) -> dict[str, Any]:
    """Return how a command's outputs fare: a count of outcomes for each way to stop it.

    Parameters
    ----------
    inputs : folder of `prepare_inputs`. moments, slow : number of moments, and of times.
    """
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as place:
        folder, base, result = (Path(place).resolve() / name for name in ("work", "base", "result"))
        shutil.copytree(inputs, base)
        for output in case.outputs if case.old.endswith("\n") else ():
            (base / output).write_text(case.old)
        if case.old and not case.old.endswith("\n"):
            _run_in(base, f"{case.words} {case.old}")
        folder.mkdir()
        server = _Server(case, base, folder, moments, slow)
        copied = os.fork()
        if copied == 0:
            code = 1
            try:
                code = server.run(result)
            finally:
                os._exit(code)
        _, status = os.waitpid(copied, 0)
        said = folder / ".said"
        assert status == 0, f"{case.words}: {said.read_text() if said.exists() else status}"
        return json.loads(result.read_text())


class _Server:
    """Runs a command up to its first temporary name, and from there in copies of the process."""

    def __init__(self, case: Case, base: Path, folder: Path, moments: int, slow: int) -> None:
        self.case, self.base, self.folder = case, base, folder
        self.moments, self.slow = moments, slow
        self.lines, self.fault, self.is_copy = 0, Fault(), False
        self.outcomes: dict[str, Counter[str]] = {}

    def run(self, result: Path) -> int:
        """Run the command; the first copies serve. Return the exit code of this process."""
        self._reset()
        os.chdir(self.folder)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
        sys.argv = ["loopcal", *self.case.words.split()]
        self._redirect()
        sys.settrace(self._trace)
        code = main(self.case.words.split())
        sys.settrace(None)
        if self.is_copy:
            os._exit(code)
        result.write_text(json.dumps(self.outcomes))
        return 0 if self.outcomes else 1

    def _trace(self, frame: FrameType, event: str, _argument: Any) -> Callable[..., Any] | None:
        """Serve before the first temporary name; strike before the line of a fault."""
        if frame.f_code.co_filename not in TRACED:
            return None
        if not self.is_copy and not self.outcomes and frame.f_code.co_name in FIRST:
            sys.settrace(None)
            try:
                self._serve()
            except Exception:  # noqa: BLE001 it must not reach the command
                traceback.print_exc()
                sys.stderr.flush()
                os._exit(1)
            sys.settrace(self._trace)
        if event == "line" and self.is_copy:
            self.lines += 1
            if self.lines == self.fault.moment and not self.fault.is_slow:
                strike(os.getpid(), self.fault.how)
        return self._trace

    def _serve(self) -> None:
        """Run all copies; each of them returns from here and goes on."""
        old = self._read_state()
        self._run_copy(Fault())
        if self.is_copy:
            return
        new, lines = self._read_state(), int((self.folder / ".lines").read_text())
        assert new != old
        seconds = self._time_copy()
        if self.is_copy:
            return
        chosen = [
            1 + round(i * (lines - 1) / max(self.moments - 1, 1)) for i in range(self.moments)
        ]
        faults = [Fault(how, moment) for how in (KILL, INTERRUPT) for moment in chosen]
        times = [seconds * (i + 0.5) / self.slow for i in range(self.slow)]
        faults += [Fault(how, t, True) for how in (KILL, INTERRUPT) for t in times]
        for fault in faults:
            self._reset()
            self._run_copy(fault)
            if self.is_copy:
                return
            words = self._judge(fault, old, new)
            self._run_copy(Fault())
            if self.is_copy:
                return
            again = self._read_state() == new and not self._list_leftovers()
            key = f"{fault.how}, slow" if fault.is_slow else fault.how
            counts = self.outcomes.setdefault(key, Counter())
            counts[words if again else f"{words}; blocks the next run"] += 1
        self._reset()

    def _time_copy(self) -> float:
        """Return the seconds that a slow copy takes without a fault."""
        self._reset()
        begin = time.perf_counter()
        self._run_copy(Fault(is_slow=True))
        return time.perf_counter() - begin

    def _run_copy(self, fault: Fault) -> None:
        """Fork; the copy returns with its fault, the original when the copy has ended.

        The time of a fault begins when the copy is ready, however long a busy machine takes.
        """
        is_ready, say_ready = os.pipe()
        copied = os.fork()
        if copied == 0:
            self.is_copy, self.fault, self.lines = True, fault, 0
            self._redirect()
            if fault.is_slow:
                _slow_down()
            if not fault.how:
                _at_exit_write(self)
            os.write(say_ready, b"1")
            return
        os.close(say_ready)
        os.read(is_ready, 1)
        os.close(is_ready)
        if fault.how and fault.is_slow:
            time.sleep(fault.moment)
            strike(copied, fault.how)
        os.waitpid(copied, 0)

    def _judge(self, fault: Fault, old: State, new: State) -> str:
        """Return in words what a copy has left behind and said."""
        state = self._read_state()
        words = []
        for output, files in state.items():
            if files == new[output]:
                words.append("new")
            elif files == old[output]:
                words.append("old")
            else:
                words.append("set aside" if files is None and self._find_old(old) else "DAMAGED")
        said = (self.folder / ".said").read_text()
        if "Traceback" in said:
            words.append("TRACEBACK")
        if fault.how == INTERRUPT and "stopped before the end" in said:
            denied = "wrote no result" in said
            named = all(
                (f in re.split(r"\W*(?:\s|$)", said.replace(":", "")) or f in said)
                == (files == new[f])
                for f, files in state.items()
            )
            is_true = denied if all(state[f] == old[f] for f in state) else named and not denied
            words += [] if is_true else ["UNTRUE"]
        if set(words) == {"old", "new"}:
            return "each file old or new" if fault.how == KILL else "MIXED"
        return " and ".join(dict.fromkeys(words))

    def _find_old(self, old: State) -> bool:
        """Return whether a complete old output has a temporary name."""
        return any(_read_tree(path) in old.values() for path in self._list_leftovers())

    def _list_leftovers(self) -> list[Path]:
        """Return what has a temporary name."""
        return [path for path in self.folder.iterdir() if LEFTOVER.fullmatch(path.name)]

    def _read_state(self) -> State:
        """Return all outputs."""
        return {output: _read_tree(self.folder / output) for output in self.case.outputs}

    def _reset(self) -> None:
        """Make the folder anew, with inputs and old outputs."""
        for path in self.folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)  # of a copy that is not quite gone
        shutil.copytree(self.base, self.folder, dirs_exist_ok=True)

    def _redirect(self) -> None:
        """Send everything that is printed to a file."""
        file = os.open(self.folder / ".said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(file, number)
            setattr(sys, name, os.fdopen(os.dup(number), "w", encoding="utf-8"))


def _at_exit_write(server: _Server) -> None:
    """Have an undisturbed copy note its number of lines when it has ended."""
    exit_now = os._exit

    def note(code: int) -> None:
        (server.folder / ".lines").write_text(str(server.lines))
        exit_now(code)

    os._exit = note


def strike(process: int, how: str) -> None:
    """Kill or interrupt a process."""
    if how == INTERRUPT and process == os.getpid():
        signal.raise_signal(signal.SIGINT)
    else:
        os.kill(process, signal.SIGKILL if how == KILL else signal.SIGINT)


def _slow_down() -> None:
    """Have every file operation of this process take longer, before and after."""
    for name in ("rename", "replace", "fsync", "mkdir", "link", "unlink"):
        setattr(os, name, _delay(getattr(os, name)))


def _delay(function: Callable[..., Any]) -> Callable[..., Any]:
    def slow(*arguments: Any, **named: Any) -> Any:
        time.sleep(DELAY)
        result = function(*arguments, **named)
        time.sleep(DELAY)
        return result

    return slow


def _read_tree(path: Path) -> dict[str, bytes] | None:
    """Return the content of a file or of all files of a folder; None where it is missing."""
    if not path.exists():
        return None
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {file.relative_to(path).as_posix(): file.read_bytes() for file in files}


def _run_in(folder: Path, words: str) -> None:
    """Run a command in a folder."""
    with _change_folder(folder):
        copied = os.fork()
        if copied == 0:
            sys.stdout = sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115 until it ends
            code = 1
            try:
                sys.argv = ["loopcal", *words.split()]
                code = main(words.split())
            finally:
                os._exit(code)
        assert os.waitpid(copied, 0)[1] == 0, words


@contextmanager
def _change_folder(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def list_failures(outcomes: dict[str, dict[str, int]]) -> list[str]:
    """Return the outcomes that must not be."""
    wrong = re.compile("[A-Z]{4}|blocks")
    return [
        f"{how}: {words}"
        for how, counts in outcomes.items()
        for words in counts
        if wrong.search(words)
    ]


QUICK = {"MOMENTS": 2, "TIMES": 1, "CASES": {name: CASES[name] for name in ("calibrate", "new")}}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(row[-1] == 0 for row in tables["outcomes"]["rows"])


def collect() -> dict[str, Any]:
    """Return the counts of all cases."""
    kinds = [KILL, INTERRUPT, f"{KILL}, slow", f"{INTERRUPT}, slow"]
    rows, failures = [], []
    with tempfile.TemporaryDirectory() as place:
        inputs = Path(place)
        prepare_inputs(inputs)
        for name, case in CASES.items():
            outcomes = examine(case, inputs, MOMENTS, TIMES)
            failures += [f"{name}: {words}" for words in list_failures(outcomes)]
            for kind in kinds:
                counts = Counter(outcomes[kind])
                failed = sum(
                    counts[words.partition(": ")[2]]
                    for words in list_failures({kind: dict(counts)})
                )
                one = [
                    counts.get(words, 0)
                    for words in ("old", "new", "set aside", "each file old or new")
                ]
                rows.append([name, kind, sum(counts.values()), *one, failed])
    columns = [
        "command",
        "stopped by",
        "moments",
        "old",
        "new",
        "set aside",
        "files of both",
        "failed",
    ]
    return {
        "moments": MOMENTS,
        "times": TIMES,
        "failures": failures,
        "tables": {"outcomes": {"columns": columns, "formats": ["", "", *["d"] * 6], "rows": rows}},
    }
