# SPDX-License-Identifier: Apache-2.0
"""Mistyped values in robot files and settings are refused with their line, whatever they are."""

import json

import numpy as np
import pytest

import loopcal as lc
from loopcal.errors import DataError, FileError, LoopcalError
from loopcal.io.core.yaml_file import make_yaml, parse_yaml
from loopcal.io.formats.linkages.closures import read_mechanism
from loopcal.io.formats.linkages.urdf import read_tree
from loopcal.io.robot.robot_file import build_robot, find_robot_file
from loopcal.measure.kinds import KINDS
from loopcal.measure.observations import Observations
from tests.io.changed_documents import change_value, list_places

ROBOTS = ("hexapod-42", "linear-delta", "3-prs", "five-bar")
WRONG = (..., {}, [], [None], {"rod": 1}, "x", 1e160, -1e308, None, True, [[1]], "*a")


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_a_wrong_value_in_a_robot_file_is_refused_or_builds_a_robot(name) -> None:
    """Every place is tried with one wrong value, a different one at each."""
    plain = make_yaml().load(find_robot_file(name).read_text("utf-8"))
    document = json.loads(json.dumps(plain))
    refused, places = 0, list(list_places(document))
    for i, place in enumerate(places):
        text = json.dumps(change_value(document, place, WRONG[i % len(WRONG)]))
        refused += is_refused(text)
    assert refused > 0.5 * len(places)


def is_refused(text: str) -> bool:
    """Return whether the text of a robot file is refused; any other exception fails the test."""
    try:
        with np.errstate(all="raise", under="ignore"):
            build_robot(parse_yaml(text, "robot.yaml", "robot file"))
    except LoopcalError:
        return True
    return False


DELTA = find_robot_file("linear-delta").read_text("utf-8")


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("readings: {}", "'readings' is"),
        ("readings: [[]]", "'readings' is"),
        ("arms: {rod: 1}", "'arms' is a mapping, but"),
        ("radius: 1.0e+160", r"'radius'.*1e\+160 mm exceeds"),
        ("angles: &a [*a]", "not valid YAML|more than|nest"),
        ('name: "\\ud800"', "name"),
    ],
)
def test_a_mistyped_line_of_a_robot_file_is_named(tmp_path, line, sentence) -> None:
    key = line.partition(":")[0]
    lines = [text for text in DELTA.splitlines() if not text.startswith(f"{key}:")]
    path = tmp_path / "robot.yaml"
    path.write_text("\n".join([*lines, line]) + "\n")
    with pytest.raises(FileError, match=sentence) as caught:
        lc.load_robot(path)
    assert str(caught.value).startswith(f"{path}:")


ROBOT = lc.load_robot("five-bar")
HEADER = "pose,left [deg],right [deg],x [mm],y [mm],z [mm]"
ROWS = [f"p{i},{100 + 3 * i},{40 - i},{i},{250 + i},0.0" for i in range(8)]
SETTINGS = {
    "kind": "position",
    "places": "[[0 mm, 0 mm, 0 mm]]",
    "noise": "{x: 1 um, y: 1 um, z: 1 um}",
}


def load(folder, settings: dict[str, str], columns: str = "", cells: str = "") -> lc.Measurements:
    """Read a measurement file of the five-bar."""
    lines = [f"# {key}: {value}" for key, value in settings.items()]
    path = folder / "data.csv"
    path.write_text("\n".join([*lines, HEADER + columns, *(row + cells for row in ROWS)]) + "\n")
    return lc.load_measurements(path, ROBOT, allow_outside_stroke=True)


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("places", "[[0 mm, 0 mm, 0 mm], [1 mm]]", "lists of equal length"),
        ("places", "[null]", "lists of equal length"),
        ("places", "[[1e160 m, 0 m, 0 m]]", "exceeds 1e\\+09 m"),
        ("places", "null", "'places' is empty, but must be a list"),
        ("kind", "[position]", "is not a kind of measurement"),
        ("kind", "{a: 1}", "is not a kind of measurement"),
        ("targets", "null", "'targets' is empty"),
        ("unknown", "null", "'unknown' is empty"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_line(tmp_path, key, value, sentence) -> None:
    with pytest.raises(FileError, match=sentence) as caught:
        load(tmp_path, SETTINGS | {key: value})
    assert "data.csv:" in str(caught.value)


def test_no_setting_of_any_type_ends_in_another_error(tmp_path) -> None:
    keys = ["kinds", "unknowns", "session", "controller", "poses", "T_base_frame", "orientation"]
    keys += ["along", "axis", "session_drift", "instrument", "robot", "format", *SETTINGS]
    refused = 0
    for key in keys:
        for value in ("null", "[]", "true", "{p: 5}", "[1, [2]]"):
            try:
                load(tmp_path, SETTINGS | {key: value})
            except LoopcalError:
                refused += 1
    assert refused > 50


@pytest.mark.parametrize(
    ("columns", "cells", "sentence"),
    [
        (",sigma.x [mm]", ",1e-320", "too small"),
        (",sigma.left [deg]", ",1e-320", "too small"),
        (",sigma.x [mm]", ",-1", "not positive"),
    ],
)
def test_a_wrong_cell_is_refused_with_its_line(tmp_path, columns, cells, sentence) -> None:
    with pytest.raises(FileError, match=sentence) as caught:
        load(tmp_path, SETTINGS, columns, cells)
    assert "data.csv:5" in str(caught.value)


def test_a_cell_that_is_no_covariance_is_refused(tmp_path) -> None:
    with pytest.raises(DataError, match="covariance of row 1 is not positive definite"):
        load(tmp_path, SETTINGS, ",cov.x.y [mm*mm]", ",-1e308")


@pytest.mark.parametrize("value", [-1e308, 1e308, -1.0, 1e-10])
def test_a_covariance_that_is_none_is_refused_before_it_is_inverted(value) -> None:
    kind = KINDS["position"]().with_tool(np.eye(4))
    covariance = np.tile(1e-10 * np.eye(3), (2, 1, 1))
    covariance[1, 0, 1] = covariance[1, 1, 0] = value
    with pytest.raises(DataError, match="covariance of row 2 is not positive definite"):
        Observations(kind, np.arange(2), np.zeros((2, 3)), covariance)


def test_an_anchor_that_is_used_twice_causes_no_warning(recwarn) -> None:
    text = "a: &x [1]\nb: &x [2]\nc: *x\n"
    assert parse_yaml(text, "robot.yaml", "robot file").content["c"] == [2]
    assert not recwarn.list


def test_a_kind_without_rows_is_accepted(tmp_path) -> None:
    position = "{kind: position, places: [[0 mm, 0 mm, 0 mm]], noise: {x: 1 um, y: 1 um, z: 1 um}}"
    settings = {"kinds": f"{{a: {position}, b: {position}}}"}
    assert len(load(tmp_path, settings, ",kind", ",a").labels) == len(ROWS)


def test_a_closure_that_is_no_name_is_refused(tmp_path) -> None:
    urdf = (
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute">'
        '<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>'
    )
    (tmp_path / "r.urdf").write_text(urdf)
    (tmp_path / "loops.yaml").write_text("closed_loop: [[[j], j]]\ntype: [6d]\nname_mot: [j]\n")
    with pytest.raises(FileError, match=r"loops\.yaml:1: .*names of two frames"):
        read_mechanism(read_tree(tmp_path / "r.urdf"), tmp_path / "loops.yaml")
