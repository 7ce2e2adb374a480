# SPDX-License-Identifier: Apache-2.0
"""Run folders in any order of writing, damage and interruption: nothing complete is ever lost."""

import json
import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from evidence.interruption import INTERRUPT, KILL, LEFTOVER, TRACED, strike
from loopcal.errors import FileError
from loopcal.io.core.outputs import FolderKind, describe_leftover, write_result_folder
from tests.io.folder_writing import RUN, run_in_copy, write

pytestmark = pytest.mark.forks

STUDY = FolderKind("study", "result.json", ("made_by", "paper"), ("page.md", "tables/*.csv"))


def write_until(path: Path, value: int, force: bool, how: str, moment: int) -> str:
    """Write a folder, but strike before a line of Python; return why it was refused."""
    lines = 0

    def trace(frame, event, _argument):
        nonlocal lines
        if frame.f_code.co_filename not in TRACED:
            return None
        if event == "line":
            lines += 1
            if lines == moment:
                strike(os.getpid(), how)
        return trace

    sys.settrace(trace)
    try:
        return write(path, value, force)
    except KeyboardInterrupt:
        return "interrupted"
    finally:
        sys.settrace(None)


class RunFolder(RuleBasedStateMachine):
    """`value` of the complete folder, None without one; `foreign` : files that somebody added;
    `changed` : files that somebody changed.
    """

    def __init__(self) -> None:
        super().__init__()
        self.place = Path(tempfile.mkdtemp())
        self.path = self.place / "run"
        self.value: int | None = None
        self.foreign: set[str] = set()
        self.changed: set[str] = set()
        self.next = 1

    def teardown(self) -> None:
        shutil.rmtree(self.place)

    def expect(self, force: bool) -> str:
        """Return the beginning of the reason for which a write is refused; empty if it is not."""
        if self.value is None:
            return ""
        if not force:
            return "this folder is not empty"
        if RUN.document in self.changed:
            return "this folder contains something other than a run"
        if self.foreign:
            return "this folder also contains"
        return f"{', '.join(sorted(self.changed))}"[:5] if self.changed else ""

    @rule(force=st.booleans())
    def write(self, force: bool) -> None:
        expected, value = self.expect(force), self.next
        self.next += 1
        said = write(self.path, value, force)
        if expected:
            assert said.startswith(f"{self.path}: {expected}")
        else:
            assert said == ""
            self.value = value
            assert [p.name for p in self.place.iterdir()] == ["run"]

    @rule(force=st.booleans(), how=st.sampled_from([KILL, INTERRUPT]), moment=st.integers(1, 400))
    def stop(self, force: bool, how: str, moment: int) -> None:
        expected, value = self.expect(force), self.next
        self.next += 1
        status, said = run_in_copy(lambda: write_until(self.path, value, force, how, moment))
        assert said is not None or os.WIFSIGNALED(status)
        if not self.path.exists() and self.value is not None:
            sentence = describe_leftover(self.path, RUN.document)
            assert "an interrupted command left it as" in sentence
            assert self.expect(force=False) in write(self.path, value, force=False)
        if not expected and self.path.exists():
            found = json.loads((self.path / RUN.document).read_text())["value"]
            assert found in (value, self.value)
            assert found == value or said != ""
            self.value = found

    @precondition(lambda self: self.value is not None)
    @rule(name=st.sampled_from(["notes.txt", "robot.yml", "tables/a.csv", ".hidden"]))
    def add_file(self, name: str) -> None:
        (self.path / name).parent.mkdir(exist_ok=True)
        (self.path / name).write_text("mine")
        self.foreign.add(name)

    @precondition(lambda self: self.foreign)
    @rule()
    def remove_added_files(self) -> None:
        for name in self.foreign:
            (self.path / name).unlink()
        shutil.rmtree(self.path / "tables", ignore_errors=True)
        self.foreign.clear()

    @precondition(lambda self: self.value is not None)
    @rule(name=st.sampled_from(["robot.yaml", "arrays.npz"]))
    def damage(self, name: str) -> None:
        (self.path / name).write_text("changed")
        self.changed.add(name)

    @precondition(lambda self: self.value is not None)
    @rule()
    def remove_folder(self) -> None:
        shutil.rmtree(self.path)
        self.value = None
        self.foreign.clear()
        self.changed.clear()
        for leftover in self.place.iterdir():  # a user who wants it gone removes all of it
            assert LEFTOVER.fullmatch(leftover.name)
            shutil.rmtree(leftover)

    @precondition(lambda self: self.value is not None)
    @rule()
    def write_a_study_in_its_place(self) -> None:
        document = {"made_by": {}, "paper": ""}
        with pytest.raises(FileError, match="something other than a study"):
            write_result_folder(self.path, STUDY, document, {}, force=True)

    @invariant()
    def everything_is_there(self) -> None:
        """Added and changed files, and the complete folder with one value in all other files."""
        for name in self.foreign:
            assert (self.path / name).read_text() == "mine"
        for name in self.changed:
            assert (self.path / name).read_text() == "changed"
        if self.value is not None:
            text = f"value: {self.value}\n"
            assert json.loads((self.path / RUN.document).read_text())["value"] == self.value
            for name in {"robot.yaml", "arrays.npz"} - self.changed:
                assert set((self.path / name).read_text().splitlines()) == {text.strip()}
        assert all(p.name == "run" or LEFTOVER.fullmatch(p.name) for p in self.place.iterdir())


TestRunFolder = RunFolder.TestCase
TestRunFolder.settings = settings(
    max_examples=12,
    stateful_step_count=12,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)


@pytest.mark.evidence
class TestRunFolderLonger(RunFolder.TestCase):
    """Twice as many orders."""

    settings = settings(TestRunFolder.settings, max_examples=25)
