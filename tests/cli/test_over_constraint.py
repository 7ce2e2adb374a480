# SPDX-License-Identifier: Apache-2.0
"""The commands with an over-constrained machine: what they refuse, and what works."""

from pathlib import Path

import pytest

from tests.over_constrained import EXECHON, close_by_least_squares

CAUSE = "limb right prevents translation along y and rotation about z, as left does"


@pytest.fixture(name="robot")
def write_robot(folder: Path) -> str:
    """Return the name of a robot file in the folder in which commands run."""
    Path("robot.yaml").write_text(EXECHON)
    Path("open.yaml").write_text(close_by_least_squares(EXECHON))
    return "robot.yaml"


def test_check_names_repeated_equations_and_lines_to_write(loopcal, robot) -> None:
    loopcal(
        f"check {robot}",
        f"2 closure equations repeat others (rank tolerance 1e-09): {CAUSE}.",
        "behind right.hinge write `- {joint: R, name: hinge-x, axis: x}`",
    )


@pytest.mark.parametrize(
    "command", ["simulate {} --draw-errors -o data.csv", "identifiability {}", "plan {} -o plan"]
)
def test_commands_that_vary_parameters_refuse_with_the_cause(loopcal, command, robot) -> None:
    said = (CAUSE, "left.gimbal.y", "closure: least-squares")
    loopcal(command.format(robot), *said, code=1)
    if not command.startswith("plan"):  # which takes long
        loopcal(command.format("open.yaml"))


def test_commands_that_use_the_stated_geometry_work(loopcal, robot) -> None:
    loopcal(f"simulate {robot} -o data.csv --draw 12")
    loopcal(f"validate {robot} data.csv")
    loopcal(f"calibrate {robot} data.csv -o run", CAUSE, code=1)
    assert not Path("run").exists()
