# SPDX-License-Identifier: Apache-2.0
"""What is written is read back equal, and names that a file cannot hold are refused when they are
read.
"""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unicodedata import normalize

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError
from loopcal.io.data.measurement_file import load_measurements, save_measurements
from loopcal.io.robot.robot_file import find_robot_file, load_robot, save_robot
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.units import find_unit

FIVE_BAR = find_robot_file("five-bar").read_text()


def write_robot(folder, **names: str):
    text = FIVE_BAR
    for word, name in names.items():
        text = re.sub(rf"\b{word}\b", lambda _, n=name: json.dumps(n, ensure_ascii=False), text)
    path = folder / "robot.yaml"
    path.write_text(text)
    return path


def make_data(robot, **changes) -> Measurements:
    kind = Position().with_tool(robot.tool)
    rows = Observations.from_sigma(kind, np.arange(3), np.full((3, 3), 0.1), 1e-5)
    return Measurements(robot.name, np.full((3, 2), 0.5) + np.eye(3, 2), (rows,), **changes)


RESERVED = ("use", "time", "temperature", "temperature.motor", "pose", "kind", "session", "group")
PREFIXED = ("block", "note", "notes", "sigma.x", "measured.x", "commanded.x", "cov.a.b", "step")


@pytest.mark.parametrize("name", [*RESERVED, *PREFIXED, "hold"])
def test_an_actuator_with_the_name_of_another_column_is_refused(tmp_path, name: str) -> None:
    with pytest.raises(FileError, match="has the name of a column with another mean") as caught:
        load_robot(write_robot(tmp_path, left=name))
    assert caught.value.line == 11


@pytest.mark.parametrize("name", ["q [", "q]", "[mm]", " q", "q "])
def test_a_name_that_no_header_can_contain_is_refused(tmp_path, name: str) -> None:
    for word in ("left", "west", "motor") if name.strip() == name else ("left",):
        with pytest.raises(FileError, match="is not a valid name of a column") as caught:
            load_robot(write_robot(tmp_path, **{word: name}))
        assert caught.value.line is not None


def test_a_joint_cannot_have_the_name_of_a_temperature(tmp_path) -> None:
    with pytest.raises(FileError, match=r"the joint 'temperature.motor' has the name of a column"):
        load_robot(write_robot(tmp_path, west="temperature"))


@pytest.mark.parametrize("name", ["x", "y", "rx", "a, b", "#", '"', "'", "1e3", "=", "-"])
def test_an_actuator_may_have_the_name_of_a_coordinate(tmp_path, monkeypatch, name: str) -> None:
    """Measured values and commands then have a prefix in files."""
    monkeypatch.chdir(tmp_path)
    robot = load_robot(write_robot(tmp_path, left=name))
    data = make_data(robot, labels=("#1", 'a "quoted" one, here', "é"))
    save_measurements(data, "data.csv", robot)
    read = load_measurements("data.csv", robot, allow_outside_stroke=True)
    assert read.labels == data.labels
    assert np.array_equal(read.readings, data.readings)
    assert np.array_equal(read.observations[0].measured, data.observations[0].measured)


def test_a_plan_tells_readings_from_commands_of_the_same_name(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    robot = load_robot(write_robot(tmp_path, left="y", right="a, b"))
    words = "plan robot.yaml --poses 6 --hold-out 2 --kind position -o plan"
    assert main(words.split()) == 0
    lines = (tmp_path / "plan" / "plan.csv").read_text().splitlines()
    header = next(line for line in lines if not line.startswith("#"))
    assert header == 'step,pose,use,x [mm],commanded.y [mm],y [deg],"a, b [deg]"'
    data = load_measurements("plan/measurements.csv", robot)
    assert np.abs(data.readings).max() < 4  # [rad]: not the commands


@pytest.mark.parametrize("label", ["", " a", "a ", "a;b", "a\nb"])
def test_a_label_that_no_cell_can_contain_is_refused(tmp_path, label: str) -> None:
    robot = load_robot("five-bar")
    with pytest.raises(DataError, match=r"Rename it|Remove it"):
        save_measurements(make_data(robot, labels=("1", label, "3")), tmp_path / "d.csv", robot)
    assert not list(tmp_path.iterdir())


def test_a_label_with_a_number_sign_survives_compensation(tmp_path, monkeypatch) -> None:
    """A line that begins with # is a remark, so the label is in quotes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "targets.csv").write_text('pose,x [mm],y [mm]\n"#1",0,330\n"a ""b"", c",5,330\n')
    assert main(["compensate", "five-bar", "targets.csv", "-o", "readings.csv"]) == 0
    text = (tmp_path / "readings.csv").read_text()
    assert '"#1",' in text
    assert '"a ""b"", c",' in text


@pytest.mark.parametrize(
    "command",
    [
        "simulate five-bar -o data.csv --kind position",
        "new five-bar -o r.yaml --measurements data.csv",
    ],
)
def test_measurements_are_not_written_beside_other_settings(
    tmp_path, monkeypatch, capsys, command: str
) -> None:
    """The settings in data.yaml would contradict those at the top of data.csv."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data.yaml").write_text("kind: pose\n")
    assert main(command.split()) == 1
    assert "settings are at the top of this file and in data.yaml" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["data.yaml"]


LABEL = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), max_size=8)
LABELS = LABEL | st.sampled_from(["#1", '"', 'a"b', "a,b", "'", "a\tb", "1e3", "yes", "-", "+x"])


@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.lists(LABELS, min_size=3, max_size=3), LABELS, LABELS, st.booleans())
def test_any_labels_are_read_back_or_refused(labels, session, group, is_held_out) -> None:
    """Whatever `save_measurements` accepts, `load_measurements` gives again."""
    robot = load_robot("five-bar")
    kind = Position().with_tool(robot.tool)
    measured = np.array([[0.1, 1 / 3, np.nan], [1e-9, -0.0, 7.0], [np.pi, 1e3, 0.3]])
    rows = Observations.from_sigma(kind, np.arange(3), measured, 1e-5, session, group)
    held_out = [is_held_out, False, False]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "data.csv"
        try:
            data = make_data(robot, labels=tuple(labels), is_held_out=np.array(held_out))
            save_measurements(replace(data, observations=(rows,)), path, robot)
        except DataError:  # refused before it is written; a defect is a FileError
            return
        read = load_measurements(path, robot, allow_outside_stroke=True)
        assert sorted(read.labels) == sorted(normalize("NFC", label) for label in labels)
        assert set(read.observations[0].session.tolist()) == {normalize("NFC", session)}


@pytest.mark.parametrize("name", ["json", "csv"])
def test_a_table_of_parameters_has_the_same_doubles(tmp_path, monkeypatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    robot = load_robot("linear-delta")
    robot = robot.with_values(robot.values * 1.001)
    save_robot(robot, "delta.yaml")
    assert main(f"export delta.yaml --format {name} -o out".split()) == 0
    text = (tmp_path / "out").read_text()
    rows = json.loads(text)["parameters"] if name == "json" else csv.DictReader(text.split("\n"))
    read = [float(row["value"]) * find_unit(row["unit"]).factor_to_si for row in rows]
    assert read == pytest.approx(robot.values, rel=1e-15)


def test_values_of_a_robot_are_read_back(tmp_path) -> None:
    robot = load_robot("five-bar")
    robot = robot.with_values(robot.values * np.pi)
    save_robot(robot, tmp_path / "robot.yaml")
    read = load_robot(tmp_path / "robot.yaml")
    assert (read.actuators, read.parameters) == (robot.actuators, robot.parameters)
    assert read.values == pytest.approx(robot.values, rel=2.3e-16)
