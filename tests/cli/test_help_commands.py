# SPDX-License-Identifier: Apache-2.0
"""loopcal example, loopcal completion and loopcal -V: what a new user tries first."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from loopcal.cli.entry_point import main
from loopcal.io.example_folders import list_examples


def test_version_has_a_short_option(capsys) -> None:
    assert main(["-V"]) == 0
    short = capsys.readouterr().out
    assert main(["--version"]) == 0
    assert short == capsys.readouterr().out
    assert short.startswith("loopcal ")


def test_examples_are_listed_with_their_titles(root, capsys) -> None:
    assert main(["example"]) == 0
    out = capsys.readouterr().out
    for folder in (root / "examples").iterdir():
        assert folder.name in out
    assert "A hexapod from nominal to calibrated" in out
    assert main(["example", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["examples"]) == set(list_examples())


@pytest.mark.parametrize("name", sorted(list_examples()))
def test_an_example_is_written_whole(name, root, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["example", name]) == 0
    written = {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
    originals = (root / "examples" / name).iterdir()
    assert written == {path.name: path.read_bytes() for path in originals}
    assert capsys.readouterr().out.startswith(f"Written to {name}: ")


def test_an_example_replaces_nothing(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    assert main(["example", "hexapod-42", "-o", "mine"]) == 0  # an empty folder
    Path("mine/poses.csv").write_text("my own")
    assert main(["example", "hexapod-42", "-o", "mine"]) == 1
    assert "This folder is in use" in " ".join(capsys.readouterr().err.split())
    assert Path("mine/poses.csv").read_text() == "my own"
    assert main(["example", "hexapod-42", "-o", "."]) == 1


def test_an_unknown_example_is_refused_with_similar_names(capsys) -> None:
    assert main(["example", "hexapod"]) == 1
    err = " ".join(capsys.readouterr().err.split())
    assert "hexapod is not an example" in err
    assert "hexapod-42" in err


def test_a_written_example_is_calibrated(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["example", "delta-printer"]) == 0
    monkeypatch.chdir("delta-printer")
    assert main(["calibrate", "printer.yaml", "heights.csv", "-o", "run"]) == 0


def test_the_wheel_contains_the_examples(root) -> None:
    """Once: in the repository they are at the top, in the wheel in the package."""
    project = tomllib.loads((root / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"examples": "loopcal/examples"}
    assert not (root / "src" / "loopcal" / "examples").exists()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_call_loopcal(shell, capsys) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert f"_LOOPCAL_COMPLETE={shell}_complete" in script


def test_an_unknown_shell_is_refused(capsys) -> None:
    assert main(["completion", "csh"]) == 1
    assert "'bash', 'zsh', 'fish'" in capsys.readouterr().err


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
def test_bash_accepts_the_script(capsys) -> None:
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out + "\ncomplete -p loopcal"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "_loopcal_completion" in done.stdout
