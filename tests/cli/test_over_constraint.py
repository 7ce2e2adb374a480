# SPDX-License-Identifier: Apache-2.0
"""The commands with an over-constrained machine: what they refuse, and what works."""

from pathlib import Path

import pytest

from loopcal.cli.entry_point import main
from tests.over_constrained import EXECHON, close_by_least_squares

CAUSE = "limb right prevents translation along y and rotation about z, as left does"


def run(command: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Return the exit code of a command and all that it printed, on one line."""
    code = main(command.split())
    out, err = capsys.readouterr()
    return code, " ".join((out + err).split())


@pytest.fixture(name="robot")
def write_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a robot file in the folder in which commands run."""
    monkeypatch.chdir(tmp_path)
    Path("robot.yaml").write_text(EXECHON)
    Path("open.yaml").write_text(close_by_least_squares(EXECHON))
    return "robot.yaml"


def test_check_names_repeated_equations_and_lines_to_write(robot, capsys) -> None:
    code, said = run(f"check {robot}", capsys)
    assert code == 0
    assert f"2 closure equations repeat others (rank tolerance 1e-09): {CAUSE}." in said
    assert "behind right.hinge write `- {joint: R, name: hinge-x, axis: x}`" in said


@pytest.mark.parametrize(
    "command", ["simulate {} --draw-errors -o data.csv", "identifiability {}", "plan {} -o plan"]
)
def test_commands_that_vary_parameters_refuse_with_the_cause(command, robot, capsys) -> None:
    code, said = run(command.format(robot), capsys)
    assert code == 1
    assert CAUSE in said
    assert "left.gimbal.y" in said
    assert "closure: least-squares" in said
    if not command.startswith("plan"):  # which takes long
        assert run(command.format("open.yaml"), capsys)[0] == 0


def test_commands_that_use_the_stated_geometry_work(robot, capsys) -> None:
    assert run(f"simulate {robot} -o data.csv --draw 12", capsys)[0] == 0
    assert run(f"validate {robot} data.csv", capsys)[0] == 0
    code, said = run(f"calibrate {robot} data.csv -o run", capsys)
    assert code == 1
    assert CAUSE in said
    assert not Path("run").exists()
