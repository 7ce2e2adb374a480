# SPDX-License-Identifier: Apache-2.0
"""README.md: its Python example and its command lines run; docs/commands.md lists every command."""

import re
import shutil
from pathlib import Path

import click
import numpy as np
import pytest

from loopcal.cli import command_line, main
from loopcal.io import load_robot

README = (Path(__file__).resolve().parent.parent / "README.md").read_text("utf-8")


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch, root) -> None:
    """Work in a folder that contains the examples only."""
    shutil.copytree(root / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)


def test_python_example_of_the_readme_runs_and_improves_the_robot(tmp_path, capsys) -> None:
    block = re.search(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    assert block
    assert (
        len([line for line in block[1].splitlines() if line and not line.startswith("import")])
        <= 10
    )
    names: dict = {}
    exec(block[1], names)  # noqa: S102
    assert names["readings"].shape == (40, 6)
    truth = load_robot("examples/hexapod-42/truth.yaml").values
    result = load_robot("calibrated.yaml").values
    assert np.linalg.norm(result - truth) < 0.5 * np.linalg.norm(names["robot"].values - truth)
    assert "42 of 42 parameter combinations" in capsys.readouterr().out


def test_every_command_of_the_first_half_hour_runs(capsys) -> None:
    part = README[README.index("## The first half hour") : README.index("## Status")]
    lines = [
        line
        for block in re.findall(r"^```sh\n(.*?)^```", part, re.MULTILINE | re.DOTALL)
        for line in block.splitlines()
    ]
    assert len(lines) == 5
    for line in lines:
        assert line.startswith("loopcal ")
        assert main(line.split()[1:]) == 0, capsys.readouterr().err
        assert capsys.readouterr().err == ""


def test_demo_prints_what_the_readme_shows(capsys) -> None:
    block = re.search(r"^```\n(Calibrated: .*?)^```", README, re.MULTILINE | re.DOTALL)
    assert block
    data = "examples/hexapod-42/measurements.csv"
    assert main(["calibrate", "hexapod-42", data, "-o", "run", "--hold-out", "0.25"]) == 0
    assert capsys.readouterr().out.startswith(block[1])


def test_table_of_commands_is_complete(root) -> None:
    page = (root / "docs" / "commands.md").read_text("utf-8")
    listed = set(re.findall(r"^\| `loopcal ([a-z-]+)", page, re.MULTILINE))
    assert listed == set(command_line.list_commands(click.Context(command_line)))
