# SPDX-License-Identifier: Apache-2.0
"""README.md: its examples run, and its picture is that of the demo. Lists are complete."""

import re
import shutil
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest
from ruamel.yaml import YAML

from loopcal.cli.entry_point import command_line, main
from loopcal.io.robot.robot_file import load_robot
from tests.cli.page_commands import list_commands
from tools import speed_tables

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


@pytest.mark.slow
def test_commands_of_the_readme_run(capsys) -> None:
    part = README[README.index("## On the command line") : README.index("## In Python")]
    for words in list_commands(part):
        assert main(words) == 0, capsys.readouterr().err
        assert capsys.readouterr().err == ""
    assert Path("report.html").stat().st_size > 100_000


def test_picture_is_small_and_its_numbers_are_those_of_the_demo(root) -> None:
    """`tools.readme_picture` draws it; that the demo prints these lines: the page's own test."""
    match = re.search(r"!\[(.*)\]\((docs/pictures/\S+\.png)\)", README)
    assert match
    picture = (root / match[2]).read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) < 150_000
    page = (root / "docs" / "getting-started.md").read_text("utf-8")
    line = re.search(r"^position +rms +(\d+) +(\S+) +(\S+) +(\S+) +um$", page, re.MULTILINE)
    assert line
    count, before, after, floor = line.groups()
    assert f"errors at {count} held-out poses" in match[1]
    assert f"position {before} um and {after} um rms, noise floor {floor} um" in match[1]


def test_stated_speeds_are_those_of_the_committed_benchmarks() -> None:
    """`python -m tools.speed_tables` writes them."""
    assert speed_tables.find_outdated() == {}
    assert speed_tables.describe_ratio(0.0021) == "480 times faster"
    assert speed_tables.describe_ratio(11.8) == "12 times slower"


def test_citation_file_is_valid_cff(root) -> None:
    """Required keys of CFF 1.2.0, types and versions; `authors` of an entity have a `name`."""
    citation = YAML(typ="safe").load((root / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    assert citation["cff-version"] == "1.2.0"
    assert citation["message"]
    assert citation["title"].startswith("loopcal: ")
    assert citation["authors"] == [{"name": "The loopcal developers"}]
    assert citation["type"] == "software"
    assert citation["license"] in project["license"].split(" AND ")  # the other: three.js
    assert citation["version"] == project["version"]
    assert citation["keywords"] == project["keywords"]
    allowed = {"cff-version", "message", "title", "authors", "type", "license", "version"}
    assert set(citation) <= allowed | {"keywords", "abstract", "date-released", "doi", "url"}


def test_table_of_commands_is_complete(root) -> None:
    page = (root / "docs" / "commands.md").read_text("utf-8")
    listed = set(re.findall(r"^\| `loopcal ([a-z-]+)", page, re.MULTILINE))
    assert listed == set(command_line.list_commands(click.Context(command_line)))
