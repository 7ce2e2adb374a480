# SPDX-License-Identifier: Apache-2.0
"""The building blocks of docs/robots.md are complete, and every picture of a robot exists."""

import re
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism.platform_coordinates import compare_coordinates
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tools.robot_pictures import PICTURES, read_blocks

BLOCKS = read_blocks()


@pytest.fixture(params=BLOCKS)
def path(request, tmp_path: Path) -> Path:
    """Return the file of a building block."""
    path = tmp_path / "robot.yaml"
    path.write_text(BLOCKS[request.param], "utf-8")
    return path


def test_a_building_block_is_a_machine_that_moves(path) -> None:
    robot = load_robot(path)
    target = sample_workspace(robot, 50, seed=1).coordinates
    there = inverse(robot, target)
    back = forward(robot, there.q)
    assert there.converged.all()
    assert back.converged.all()
    error = compare_coordinates(back.T, target, robot.controlled, robot.size)[0]
    np.testing.assert_allclose(error, 0.0, atol=1e-9 * robot.size)


def test_all_parameters_of_a_building_block_are_identifiable(path, capsys) -> None:
    assert main(["identifiability", str(path)]) == 0
    n = len(load_robot(path).parameters)
    assert f"determine {n} of {n} parameter combinations" in capsys.readouterr().out


def test_the_page_quotes_what_check_says_of_a_spinning_leg(tmp_path, capsys, root) -> None:
    (tmp_path / "robot.yaml").write_text(BLOCKS["hexapod-sps"], "utf-8")
    assert main(["check", str(tmp_path / "robot.yaml")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    page = " ".join((root / "docs" / "robots.md").read_text("utf-8").split())
    quoted = re.findall(r'says of each leg between two ball joints: "(.*?)"', page)[0]
    assert quoted in said


def test_every_shipped_robot_and_every_block_has_a_picture_on_the_page(root) -> None:
    text = (root / "docs" / "robots.md").read_text("utf-8")
    for folder, names in (("robots", list_shipped_robots()), ("blocks", BLOCKS)):
        shown = re.findall(rf"\(pictures/{folder}/([\w-]+)\.png\)", text)
        assert set(shown) == set(names)
        assert {p.stem for p in (PICTURES / folder).glob("*.png")} == set(names)
