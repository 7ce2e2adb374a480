# SPDX-License-Identifier: Apache-2.0
"""Names in files: plain text of limited length that no spreadsheet computes."""

import json
from pathlib import Path

import pytest

from loopcal.errors import FileError
from loopcal.io.core.csv_table import read_table
from loopcal.io.core.limits import (
    LONGEST_COMPOSED,
    LONGEST_NAME,
    TEXT_LENGTH,
    find_fault,
    format_comment,
    is_formula,
    make_name,
)
from loopcal.io.core.yaml_file import parse_yaml, read_yaml
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.exports.conversion import convert_export
from loopcal.io.exports.profile import read_profile
from loopcal.io.formats.linkages import urdf
from loopcal.io.robot.robot_file import find_robot_file, load_robot

CONTROLS = ["\x1b[31m", "\x07", "\x9b31m", "\x7f", "\u202e", "\u2066", "\u200b", "\ufeff", "\ud800"]
LINES = ["a\nG28", "a\rG28", "a\u2028b", "a\x85b"]
FORMULAS = [
    "=cmd|' /C calc'!A0",
    "=1+1",
    "@SUM(A1)",
    "+cmd|x!A",
    "-2+3+cmd|x!A",
    "+HYPERLINK(a)",
    "\uff1dcmd",
    "a,=cmd|x",
    "a; @b",
    'a,"=cmd|x',
]
ALLOWED = [
    "+x",
    "-x",
    "+1",
    "-1.5",
    "#3",
    "P1, left",
    "a=b",
    "x@y",
    "@",
    "=",
    "a;b",
    "Größe",
    "leg (1)",
]
FIVE_BAR = find_robot_file("five-bar").read_text("utf-8")


def list_codes(*names: str) -> list[str | None]:
    return [fault and fault.code for fault in map(find_fault, names)]


def test_rule_refuses_what_is_not_plain_or_computed() -> None:
    assert set(list_codes(*CONTROLS, *LINES)) == {"files.name-not-plain"}
    assert set(list_codes(*FORMULAS)) == {"files.name-computed"}
    assert set(list_codes(*ALLOWED)) == {None}
    assert list_codes("x" * LONGEST_NAME, "x" * (LONGEST_NAME + 1)) == [None, "files.name-too-long"]
    assert (
        find_fault("two\nlines of =1 " + "x" * LONGEST_COMPOSED, TEXT_LENGTH.count, is_text=True)
        is None
    )
    assert find_fault("\x1b", is_text=True) is not None


@pytest.mark.parametrize("name", [*CONTROLS, *LINES, *FORMULAS])
def test_message_about_a_name_is_one_plain_line(name) -> None:
    text = str(find_fault(name))
    assert text.isprintable()


@pytest.mark.parametrize("text", [*CONTROLS, *LINES, *FORMULAS, *ALLOWED, "x" * 999])
def test_text_of_another_origin_becomes_a_name_and_a_comment(text) -> None:
    assert find_fault(make_name(text)) is None
    comment = format_comment(f"read from {text}")
    assert comment.isprintable()
    assert not is_formula(comment)


BAD = ["\x1bm", "a\nb", "\u202eb", "\ud800", "=cmd|x!A", "x" * (LONGEST_NAME + 1)]


@pytest.mark.parametrize("place", ["name: five-bar", "name: west", "left", "name: motor"])
@pytest.mark.parametrize("name", BAD)
def test_robot_file_with_such_a_name_is_refused_at_its_line(tmp_path, place, name) -> None:
    key = place.split()[-1]
    text = FIVE_BAR.replace(place, place.replace(key, json.dumps(name)))
    (tmp_path / "robot.yaml").write_text(text)
    with pytest.raises(FileError) as caught:
        load_robot(tmp_path / "robot.yaml")
    assert caught.value.code is not None
    assert caught.value.code.startswith("files.name-")
    assert str(caught.value).isprintable()
    if "\n" not in name:
        assert caught.value.line == 1 + text[: text.index(json.dumps(name))].count("\n")


def test_source_of_a_robot_may_have_several_lines(tmp_path) -> None:
    text = FIVE_BAR.replace("source: ours", "source: |\n  =a long story\n  " + 300 * "word ")
    (tmp_path / "robot.yaml").write_text(text)
    assert load_robot(tmp_path / "robot.yaml").name == "five-bar"


DATA = """\
# kind: position
# noise: {{x: 1 um, y: 1 um, z: 1 um}}
# {key}: {value}
pose,{column},left [deg],right [deg],x [mm],y [mm],z [mm]
p1,{cell},1,2,3,4,5
"""
UNWRITABLE = ("a\nb", "\ud800")
"""Names that no line of CSV contains."""

GOOD = {"key": "instrument", "value": "tracker", "column": "session", "cell": "monday"}


@pytest.mark.parametrize(
    ("field", "name"),
    [(f, n) for f in GOOD for n in BAD if f in ("key", "value") or n not in UNWRITABLE],
)
def test_measurement_file_with_such_a_name_is_refused_at_its_line(tmp_path, field, name) -> None:
    if field in ("key", "value"):
        name = json.dumps(name)
    if field == "column":
        name = name + "x" * LONGEST_COMPOSED * name.startswith("xx")
    path = tmp_path / "data.csv"
    path.write_text(DATA.format(**{**GOOD, field: name}))
    with pytest.raises(FileError) as caught:
        read_table(path)
    assert caught.value.code is not None
    assert caught.value.code.startswith("files.name-")
    assert caught.value.line == {"key": 3, "value": 3, "column": 4, "cell": 5}[field]
    assert str(caught.value).isprintable()


def test_labels_of_poses_may_begin_with_a_sign_or_a_number_sign(tmp_path) -> None:
    labels = ["+x", "-1", "+1.5e3", "P1, left"]
    path = tmp_path / "data.csv"
    rows = "".join(f'"{label}",{i},2,3\n' for i, label in enumerate(labels))
    path.write_text(
        "# kind: component\n# components: [x]\n# noise: {x: 1 um}\n"
        "pose,left [deg],right [deg],x [mm]\n" + rows + '"#3",5,2,3\n'
    )
    data = load_measurements(path, load_robot("five-bar"), allow_outside_stroke=True)
    assert data.labels == (*labels, "#3")


def test_settings_file_and_profile_with_such_names_are_refused(tmp_path) -> None:
    (tmp_path / "data.csv").write_text("pose,x [mm]\np,1\n")
    (tmp_path / "data.yaml").write_text('kind: position\nframe: "\\e[31m"\n')
    with pytest.raises(FileError, match=r"data.yaml:2: the name '\\x1b\[31m' contains U\+001B"):
        read_table(tmp_path / "data.csv")
    profile = tmp_path / "profile.yaml"
    profile.write_text('columns: {pose: {from: "=A(1)", match: "=(?P<pose>.*)"}, "=x|": {from: 1}}')
    with pytest.raises(FileError, match=r"a spreadsheet computes the name '=x\|'"):
        read_yaml(profile, "profile")


def test_names_of_an_export_that_no_file_may_contain_do_not_fit(tmp_path) -> None:
    profile = tmp_path / "profile.yaml"
    profile.write_text(
        "delimiter: semicolon\nsettings: {kind: position, noise: {x: 1 um, y: 1 um, z: 1 um}}\n"
        "columns: {pose: {from: N}, x: {from: X, unit: mm}, y: {from: X, unit: mm}, "
        "z: {from: X, unit: mm}, note remark: {from: R}}\n"
    )
    export = tmp_path / "export.txt"
    export.write_text("N;X;R\np1;1;=cmd|x!A\n=cmd|x!A;1;b\n\x1b[2J;1;\x1b[31m\n")
    converted = convert_export(export, read_profile(profile))
    assert [line for line, _ in converted.misfits] == [3, 4]
    assert converted.text.splitlines()[-1] == "p1,_cmd_x_A,1,1,1"
    assert "\x1b" not in converted.text


def test_joint_of_a_urdf_with_such_a_name_is_refused() -> None:
    text = '<robot name="r">\n<link name="a"/>\n<link name="&#x202E;b"/>\n</robot>'
    with pytest.raises(FileError, match=r"a.urdf:3: the name '\\u202eb' contains U\+202E"):
        urdf.parse(text, Path("a.urdf"))


def test_composed_names_may_be_longer() -> None:
    long, composed = "x" * 150, ".".join(["x" * 150] * 3)
    text = f"family: f\nname: {long}\nidentified:\n- {{name: {composed}}}\nfixed: [{composed}]\n"
    assert parse_yaml(text, "r.yaml", "robot file").content["name"] == long
    with pytest.raises(FileError, match="has 452 characters, above the limit of 200"):
        parse_yaml(f"family: f\nname: {composed}", "r.yaml", "robot file")
