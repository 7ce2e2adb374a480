# SPDX-License-Identifier: Apache-2.0
"""README.md: its examples run, and its picture is that of the demo. Lists are complete."""

import re
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest
from ruamel.yaml import YAML

from loopcal.cli.entry_point import command_line
from loopcal.io.robot.robot_file import load_robot
from tests.cli.page_commands import run_page
from tools import speed_tables

README = (Path(__file__).resolve().parent.parent / "README.md").read_text("utf-8")


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch) -> None:
    """Work in an empty folder, as its reader does."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_examples_of_the_readme_print_what_it_shows_and_improve_the_robot() -> None:
    part = README[README.index("## Ten lines") : README.index("## Two commands")]
    block = re.search(r"^```python\n(.*?)^```", part, re.MULTILINE | re.DOTALL)
    assert block
    lines = [line for line in block[1].splitlines() if line and not line.startswith("import")]
    assert len(lines) <= 10
    names = run_page(part)
    assert names["readings"].shape == (40, 6)
    assert Path("report.html").stat().st_size > 100_000
    assert Path("view.html").stat().st_size > 100_000
    truth = load_robot("hexapod-42/truth.yaml").values
    result = load_robot("calibrated.yaml").values
    assert np.linalg.norm(result - truth) < 0.5 * np.linalg.norm(names["robot"].values - truth)


def test_an_installation_and_two_commands_are_all_the_set_up(root) -> None:
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    wheel = f"{project['name']}-{project['version']}-py3-none-any.whl"
    install = re.search(r"^## Install$.*?^```\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    assert install
    assert install[1] == f"pip install {'.' if 'dev' in project['version'] else wheel}\n"
    block = re.search(r"^## Two commands$.*?^```sh\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    assert block
    assert [line.split("  ")[0] for line in block[1].splitlines()] == ["make demo", "make test"]


def test_picture_is_small_and_its_numbers_are_those_of_the_demo(root) -> None:
    """`tools.readme_picture` draws it; that the demo prints these lines: the page's own test."""
    match = re.search(r"!\[(.*)\]\((docs/pictures/\S+\.png)\)", README)
    assert match
    picture = (root / match[2]).read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) < 200_000
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
