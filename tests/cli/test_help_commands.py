# SPDX-License-Identifier: Apache-2.0
"""loopcal example, loopcal completion and loopcal -V: what a new user tries first."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from loopcal.io.example_folders import list_examples


def test_version_has_a_short_option(loopcal) -> None:
    short = loopcal("-V").out
    assert short == loopcal("--version").out
    assert short.startswith("loopcal ")


def test_examples_are_listed_with_their_titles(loopcal, root) -> None:
    out = loopcal("example").out
    for folder in (root / "examples").iterdir():
        assert folder.name in out
    assert "A hexapod from nominal to calibrated" in out
    assert set(loopcal("example --json").json["examples"]) == set(list_examples())


@pytest.mark.parametrize("name", sorted(list_examples()))
def test_an_example_is_written_whole(loopcal, name, root, tmp_path) -> None:
    printed = loopcal(["example", name])
    written = {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
    originals = (root / "examples" / name).iterdir()
    assert written == {path.name: path.read_bytes() for path in originals}
    assert printed.out.startswith(f"Written to {name}: ")


def test_an_example_replaces_nothing(loopcal) -> None:
    Path("mine").mkdir()
    loopcal("example hexapod-42 -o mine")  # an empty folder
    Path("mine/poses.csv").write_text("my own")
    loopcal("example hexapod-42 -o mine", "This folder is in use", code=1)
    assert Path("mine/poses.csv").read_text() == "my own"
    loopcal("example hexapod-42 -o .", code=1)


def test_an_unknown_example_is_refused_with_similar_names(loopcal) -> None:
    err = " ".join(loopcal("example hexapod", code=1).err.split())
    assert "hexapod is not an example" in err
    assert "hexapod-42" in err


def test_a_written_example_is_calibrated(loopcal, monkeypatch) -> None:
    loopcal("example delta-printer")
    monkeypatch.chdir("delta-printer")
    loopcal("calibrate printer.yaml heights.csv -o run")


def test_the_wheel_contains_the_examples(root) -> None:
    """Once: in the repository they are at the top, in the wheel in the package."""
    project = tomllib.loads((root / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"examples": "loopcal/examples"}
    assert not (root / "src" / "loopcal" / "examples").exists()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_call_loopcal(loopcal, shell) -> None:
    loopcal(["completion", shell], f"_LOOPCAL_COMPLETE={shell}_complete")


def test_an_unknown_shell_is_refused(loopcal) -> None:
    loopcal("completion csh", "'bash', 'zsh', 'fish'", code=1)


def complete(words: str, tmp_path: Path) -> list[str]:
    """Return what bash would offer after some words."""
    parts = words.split(" ")
    environment = os.environ | {
        "_LOOPCAL_COMPLETE": "bash_complete",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(parts) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", "from loopcal.cli.entry_point import main; main([])"],
        env=environment,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.stderr == ""
    return done.stdout.splitlines()


@pytest.mark.slow
def test_commands_options_robots_and_files_are_completed(tmp_path) -> None:
    assert complete("loopcal com", tmp_path) == [
        "plain,compare",
        "plain,compensate",
        "plain,completion",
    ]
    assert "plain,--hold-out" in complete("loopcal calibrate --h", tmp_path)
    assert complete("loopcal check hexapod-4", tmp_path) == ["plain,hexapod-42"]
    assert complete("loopcal check my-robot", tmp_path) == ["file,my-robot"]
    assert complete("loopcal study su", tmp_path) == ["plain,summary"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_accepts_the_script(loopcal) -> None:
    script = loopcal("completion bash").out + "\ncomplete -p loopcal"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "_loopcal_completion" in done.stdout
