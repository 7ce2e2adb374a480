# SPDX-License-Identifier: Apache-2.0
"""How tests run commands, which write placeholders for pictures."""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from loopcal.cli.entry_point import main
from tests.conftest import leave_out_drawing


@pytest.fixture(autouse=True, scope="module")
def use_placeholders() -> Iterator[None]:
    """Write placeholders for pictures in all tests of this folder and their fixtures."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out_drawing(patch)
        yield


class Printed(NamedTuple):
    """What a command printed."""

    code: int
    out: str
    err: str

    @property
    def words(self) -> str:
        """Standard output as one line."""
        return " ".join(self.out.split())

    @property
    def json(self) -> Any:
        """The document on standard output."""
        return json.loads(self.out, parse_constant=pytest.fail)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Work in an empty folder and return it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def loopcal(tmp_path, monkeypatch, capsys) -> Callable[..., Printed]:
    """Run a command line in an empty folder, or where a later fixture went."""
    monkeypatch.chdir(tmp_path)

    def run(words: str | Sequence[str], *said: str, code: int | tuple[int, ...] = 0) -> Printed:
        """Check the exit code, and that texts are printed: of a refusal in its one sentence."""
        capsys.readouterr()
        found = main(words.split() if isinstance(words, str) else list(words))
        printed = Printed(found, *capsys.readouterr())
        assert found == code if isinstance(code, int) else found in code, printed.err
        text = printed.err if found == 1 else printed.out + printed.err
        for part in said:
            assert part in text or part in " ".join(text.split())
        if found == 1:
            notes = ("loopcal: note: ", "Hint: ")
            refusals = [line for line in printed.err.splitlines() if not line.startswith(notes)]
            text = printed.out if "--json" in words else ""  # a document repeats the refusal
            assert (printed.out, len(refusals)) == (text, 1), printed.err
        return printed

    return run
