# SPDX-License-Identifier: Apache-2.0
"""G-code of a plan commands its poses in order, on paths that were checked."""

import re

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError, MechanismError
from loopcal.io.formats.gcode_program import format_gcode, read_stops
from loopcal.io.robot.robot_file import load_robot
from loopcal.planning.path import check_route

SHEET = """\
## Poses of hexapod-42
step,pose,use,x [mm],y [mm],z [mm],roll [deg],pitch [deg],yaw [deg]
1,1,fit,10,-20.5,190,3,-4,5
2,home,via,0,0,200,0,0,0
3,2 (far),held-out,-30,20,210.25,-3,4,-5
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.csv").write_text(SHEET)
    return tmp_path


def list_moves(text: str) -> list[str]:
    return [line.removeprefix("G53 G1 ") for line in text.splitlines() if line.startswith("G53")]


def test_program_visits_all_stops_from_home_to_home(folder, capsys) -> None:
    assert main(["gcode", "hexapod-42", "plan.csv", "-o", "poses.ngc", "--feed", "600"]) == 0
    assert "poses.ngc: 3 stops, lengths in mm" in capsys.readouterr().out
    text = (folder / "poses.ngc").read_text()
    home = "X0 Y0 Z200 A0 B0 C0 F600"
    assert list_moves(text) == [
        home,
        "X10 Y-20.5 Z190 A3 B-4 C5 F600",
        home,
        "X-30 Y20 Z210.25 A-3 B4 C-5 F600",
        home,
    ]
    assert "\nG21 G90 G94 G40 G49 G61\n" in text
    assert text.count("\nM0\n") == 3  # before home and at both poses, not at the via
    assert text.endswith("M2\n")
    assert "2 _far_" in text
    assert not re.search(r"\([^)]*\([^)]*\)", text)  # comments are not nested


def test_program_in_inches_with_dwell(folder) -> None:
    words = "gcode hexapod-42 . -o poses.ngc --feed 20 --pause 2.5 --unit in"
    assert main(words.split()) == 0
    text = (folder / "poses.ngc").read_text()
    assert "\nG20 G90" in text
    assert text.count("\nG4 P2.5\n") == 2
    assert "X0.393701 Y-0.807087 Z7.480315 A3 B-4 C5 F20" in text


@pytest.mark.parametrize(("unit", "feed"), [("mm", "300"), ("in", "11.811")])
def test_default_feed_is_the_same_speed_in_each_unit(folder, unit: str, feed: str) -> None:
    assert main(["gcode", "hexapod-42", ".", "-o", "poses.ngc", "--unit", unit]) == 0
    moves = list_moves((folder / "poses.ngc").read_text())
    assert {move.rpartition(" F")[2] for move in moves} == {feed}


def test_robot_without_tilt_has_three_words(folder) -> None:
    robot = load_robot("linear-delta")
    (folder / "delta.csv").write_text("step,pose,use,x [mm],y [mm],z [mm]\n1,1,fit,10,5,100\n")
    text = format_gcode(robot, read_stops("delta.csv", robot), np.zeros(3), 0.01)
    assert list_moves(text)[1] == "X10 Y5 Z100 F600"
    assert "A B C" not in text


def test_stops_that_cannot_be_reached_are_refused(folder) -> None:
    robot = load_robot("hexapod-42")
    (folder / "plan.csv").write_text(SHEET.replace("210.25", "290"))
    labels, _, coordinates = read_stops("plan.csv", robot)
    with pytest.raises(MechanismError, match=r"path from home to 2 .far. is not allowed: stroke"):
        check_route(robot, labels, coordinates)


def test_coordinates_without_a_word_are_refused(folder) -> None:
    (folder / "p.csv").write_text("step,pose,use,z [mm],phi [deg],theta [deg]\n1,1,fit,700,0,1\n")
    robot = load_robot("3-prs")
    with pytest.raises(DataError, match="has the commands phi and theta, which have no word"):
        read_stops("p.csv", robot)


def test_other_files_and_settings_are_refused(folder) -> None:
    robot = load_robot("hexapod-42")
    stops = read_stops("plan.csv", robot)
    (folder / "plan.csv").write_text(SHEET.replace("via", "visit"))
    with pytest.raises(FileError, match="the use 'visit' is not fit, held-out or via"):
        read_stops("plan.csv", robot)
    (folder / "plan.csv").write_text("pose,q1 [mm]\n1,2\n")
    with pytest.raises(FileError, match="Name the folder of a plan"):
        read_stops("plan.csv", robot)
    settings = ((0.0, None), (np.nan, None), (np.inf, None), (1.0, -1.0), (1e-9, None), (1.0, 4e-4))
    for feed, pause in settings:  # also those that three decimals round to 0
        with pytest.raises(DataError, match=r"finite number of at least 0\.001 (mm/min|s)"):
            format_gcode(robot, stops, np.zeros(6), feed, pause)
    assert "F0.001\n" in format_gcode(robot, stops, np.zeros(6), 1e-3 / 6e4)
