# SPDX-License-Identifier: Apache-2.0
"""Files of the user are never replaced without a word, and a command writes all of its files or none."""

import shutil
from pathlib import Path

import pytest

from loopcal.cli import main
from loopcal.io.robot_file import robot_path

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"
TARGETS = "pose,x [mm],y [mm],z [mm],roll [deg],pitch [deg],yaw [deg]\nhome,0,0,200,0,0,0\n"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run a command line in a folder with a robot and data; return exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(robot_path("hexapod-42"), "robot.yaml")
    shutil.copy(EXAMPLE / "measurements.csv", "data.csv")
    Path("pp.csv").write_text(TARGETS)
    Path("old.csv").write_text("mine\n")
    Path("old.png").write_text("mine\n")

    def run(words: str) -> tuple[int, str, str]:
        code = main(words.split())
        return code, *capsys.readouterr()

    return run


def contents() -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


READ, TWO, THERE, FOLDER = "is read by the same command", "two outputs", "this file exists", "there is no folder nodir"
REFUSED = {
    "simulate robot.yaml -o robot.yaml": READ,
    "simulate robot.yaml -o robot.yaml --force": READ,
    "simulate robot.yaml --poses pp.csv -o ./pp.csv --force": READ,
    "simulate robot.yaml -o new.csv --truth robot.yaml --force": READ,
    "simulate robot.yaml -o new.csv --truth ./new.csv": TWO,
    "simulate robot.yaml -o old.csv": THERE,
    "simulate robot.yaml -o new.csv --truth old.csv": THERE,
    "simulate robot.yaml -o new.csv --truth nodir/t.yaml": FOLDER,
    "compensate robot.yaml pp.csv -o pp.csv --force": READ,
    "compensate robot.yaml pp.csv -o robot.yaml --force": READ,
    "compensate robot.yaml pp.csv -o old.csv": THERE,
    "check robot.yaml --plot old.png": THERE,
    "identifiability robot.yaml data.csv --reduce -o robot.yaml --force": READ,
    "export robot.yaml --format csv -o robot.yaml --force": READ,
    "new gough -o a.yaml --measurements nodir/x.csv": FOLDER,
    "new gough -o a.yaml --measurements a.yaml": TWO,
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_would_replace_or_lose_a_file_is_refused_before_anything_is_written(run, words) -> None:
    before = contents()
    code, out, err = run(words)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert REFUSED[words] in err
    assert contents() == before


def test_force_replaces_a_file_that_is_not_read(run) -> None:
    assert run("simulate robot.yaml -o old.csv --force")[0] == 0
    assert Path("old.csv").read_text() != "mine\n"
    assert run("compensate robot.yaml pp.csv -o old.csv --force")[0] == 0
    assert "note status" in Path("old.csv").read_text()


def test_a_run_that_is_read_is_not_replaced(run) -> None:
    assert run("calibrate robot.yaml data.csv -o run")[0] == 0
    before = contents()
    for words in ("run/robot.yaml data.csv -o run --force", "robot.yaml pp.csv -o run --force --prior run"):
        code, _, err = run(f"calibrate {words}")
        assert code == 1
        assert "this folder would be replaced" in err
    code, _, err = run("compensate run pp.csv -o run/robot.yaml --force")
    assert (code, READ in err) == (1, True)
    assert contents() == before
