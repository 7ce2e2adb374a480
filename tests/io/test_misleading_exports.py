# SPDX-License-Identifier: Apache-2.0
"""Exports with hidden errors: split cells, later headers, contradictory targets, wrong units."""

import json
import re

import pytest

from loopcal.cli.entry_point import main
from loopcal.diagnose.conventions.convention_check import check_conventions
from loopcal.errors import FileError, LoopcalError
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import load_robot
from tests.io.export_texts import BY_NAME, convert, read_table_lines

BY_PLACE = BY_NAME.replace("Name", "1").replace("X", "2").replace("Y", "3").replace("Z", "4")
TARGETS = """format: 1
delimiter: semicolon
decimal: comma
columns:
  pose: {from: Name, match: '(?P<pose>P\\d+)_(?P<target>\\w+)'}
  x: {from: X, unit: mm}
  y: {from: Y, unit: mm}
  z: {from: Z, unit: mm}
  MORE
settings: {kind: position, targets: [a, b], unknown: [frame], frame: cmm, noise: {"*": 2 um}}
"""
READINGS = (
    "readings: {"
    + ", ".join(f"q{i}: {{from: J{i}, unit: mm}}" for i in range(1, 7))
    + "}\nsettings:"
)


@pytest.mark.parametrize(
    ("export", "delimiter", "misfits", "rows"),
    [
        (
            "Name,X,Y,Z\n1,1,5,2,5,3,5\n2,1,2,3\n3,1,2,3,\n",
            "comma",
            {2: "it has 7 cells, but the header has 4"},
            2,
        ),
        (
            "Name,X,Y,Z,R,S,T,U\n1,1,5,2,5,3,5\n2,1,2,3,,,,\n",
            "comma",
            {2: "it has 7 cells, but the header has 8"},
            1,
        ),
        (
            "Name,X,Y,Z,R,S,T,U\n1,1,5,2,5,3,5,,,\n2,1,2,3,,,,\n",
            "comma",
            {2: "it has 9 cells, but the header"},
            1,
        ),
        (
            "Name X Y Z\nPose 1 10 20 30\nP2 1 2 3\n",
            "spaces",
            {2: "it has 5 cells, but the header has 4"},
            1,
        ),
        (
            "Name X Y Z R\nP1 20 30 7\nP2 1 2 3 4\n",
            "spaces",
            {2: "it has 4 cells, but the header has 5"},
            1,
        ),
        ("Name;X;Y;Z;Note\nP1;1;2;3\nP2;1;2;3;good\n", "semicolon", {}, 2),
    ],
)
def test_line_with_another_number_of_cells_than_the_header_is_skipped(
    tmp_path, export, delimiter, misfits, rows
) -> None:
    found = convert(tmp_path, export, BY_NAME.replace("comma", delimiter))
    assert (found.rows, [line for line, _ in found.misfits]) == (rows, list(misfits))
    assert all(
        part in reason for (_, reason), part in zip(found.misfits, misfits.values(), strict=True)
    )


def test_line_with_another_number_of_cells_than_most_is_skipped(tmp_path) -> None:
    found = convert(tmp_path, "1,1,2,3\n2,1,5,2,5,3,5\n3,1,2,3,\n4,1,2,\n", BY_PLACE)
    assert found.misfits == ((2, "it has 7 cells, but most lines have 4"),)
    assert read_table_lines(found.text)[1:] == ["1,1,2,3", "3,1,2,3", "4,1,2,"]


def test_later_header_applies_to_the_lines_below_it(tmp_path) -> None:
    found = convert(
        tmp_path, "Name,X,Y,Z\n1,1,2,3\nName,X,Y,Z\n2,4,5,6\nZ,Y,R,X,Name\n9,8,0,7,3\n", BY_NAME
    )
    assert read_table_lines(found.text)[1:] == ["1,1,2,3", "2,4,5,6", "3,7,8,9"]
    assert (found.passed, found.misfits) == (3, ())


@pytest.mark.parametrize(("mark", "name"), [(";", "semicolon"), ("\t", "tab")])
def test_a_header_with_another_separator_is_named(tmp_path, mark, name) -> None:
    text = "Report\nName,X,Y,Z\n1,1,2,3\n".replace(",", mark)
    with pytest.raises(FileError, match=rf"export.txt:2: .*\({name} in place of comma\)"):
        convert(tmp_path, text, BY_NAME)


def test_later_header_with_a_duplicate_column_is_refused(tmp_path) -> None:
    with pytest.raises(FileError, match=r"export.txt:3: duplicate column 'X'"):
        convert(tmp_path, "Name,X,Y,Z\n1,1,2,3\nName,X,X,Y,Z\n", BY_NAME)


def test_sigma_covariance_and_notes_are_kept_for_each_target(tmp_path) -> None:
    more = "sigma.x: {from: S, unit: um}\n  cov.x.y: {from: C, unit: um*um}\n  note rms: {from: R}"
    profile = TARGETS.replace("MORE", more).replace("settings:", READINGS)
    lines = [
        "P1_a;1,5;2;3;4;1;r1;0;0;0;0;0;0",
        "P1_b;1,6;2;3;5;2;r2;0;0;0;0;0;0",
        "P2_b;1,7;2;3;6;3;r3;1;0;0;0;0;0",
    ]
    found = convert(tmp_path, "Name;X;Y;Z;S;C;R;J1;J2;J3;J4;J5;J6\n" + "\n".join(lines), profile)
    header, *rows = read_table_lines(found.text)
    cells = [dict(zip(header.split(","), row.split(","), strict=True)) for row in rows]
    assert (found.rows, found.misfits) == (2, ())
    assert (cells[0]["sigma.a.x [um]"], cells[0]["sigma.b.x [um]"], cells[1]["sigma.a.x [um]"]) == (
        "4",
        "5",
        "",
    )
    assert (cells[0]["cov.a.x.a.y [um*um]"], cells[0]["cov.b.x.b.y [um*um]"]) == ("1", "2")
    assert (cells[0]["note rms a"], cells[0]["note rms b"]) == ("r1", "r2")
    (tmp_path / "data.csv").write_text(found.text)
    data = load_measurements(tmp_path / "data.csv", load_robot("hexapod-42"))
    sigma = data.observations[0].covariance.diagonal(axis1=1, axis2=2) ** 0.5
    assert sigma[0] == pytest.approx([4e-6, 2e-6, 2e-6, 5e-6, 2e-6, 2e-6])  # [m]


def test_target_without_a_line_needs_no_sigma(tmp_path) -> None:
    profile = TARGETS.replace("MORE", "sigma.x: {from: S, unit: um}").replace("settings:", READINGS)
    profile = profile.replace('"*": 2 um', '"*.y": 2 um, "*.z": 2 um')
    lines = [
        "P1_a;1,5;2;3;4;0;0;0;0;0;0",
        "P1_b;1,6;2;3;5;0;0;0;0;0;0",
        "P2_b;1,7;2;3;6;1;0;0;0;0;0",
    ]
    (tmp_path / "data.csv").write_text(
        convert(tmp_path, "Name;X;Y;Z;S;J1;J2;J3;J4;J5;J6\n" + "\n".join(lines), profile).text
    )
    data = load_measurements(tmp_path / "data.csv", load_robot("hexapod-42"))
    rows = data.observations[0]
    assert rows.present.tolist() == [[True] * 6, [False] * 3 + [True] * 3]
    assert rows.covariance[1, 3, 3] ** 0.5 == pytest.approx(6e-6)  # [m]
    (tmp_path / "data.csv").write_text(
        (tmp_path / "data.csv").read_text().replace(",6,1,", ",,1,").replace(",6\n", ",\n")
    )
    with pytest.raises(LoopcalError, match=r"column 'sigma.b.x' is not positive"):
        load_measurements(tmp_path / "data.csv", load_robot("hexapod-42"))


def test_target_line_with_other_readings_is_skipped(tmp_path) -> None:
    profile = TARGETS.replace("MORE", "").replace("settings:", READINGS)
    lines = ["P1_a;1;2;3;7,0;0;0;0;0;0", "P1_b;1;2;3;7,00;0;0;0;0;0", "P2_a;1;2;3;8;0;0;0;0;0", "P2_b;1;2;3;9;0;0;0;0;0",  # noqa: E501
             "P1_b;1;2;4;6;0;0;0;0;0"]  # fmt: skip
    found = convert(tmp_path, "Name;X;Y;Z;J1;J2;J3;J4;J5;J6\n" + "\n".join(lines), profile)
    assert found.misfits == (
        (5, "'q1' is 9 here, but 8 in an earlier line of the pose 'P2'"),
        (6, "'q1' is 6 here, but 7.0 in an earlier line of the pose 'P1'"),
    )
    assert found.rows == 2


def test_targets_at_another_temperature_get_separate_rows(tmp_path) -> None:
    more = "temperature: {from: T, unit: degC}\n  time: {from: When}"
    lines = [
        "P1_a;1;2;3;20;2026-05-04T10:00:00",
        "P1_b;1;2;3;20,0;2026-05-04T10:00:07",
        "P2_a;1;2;3;20;",
        "P2_b;1;2;3;21;",
    ]
    found = convert(
        tmp_path, "Name;X;Y;Z;T;When\n" + "\n".join(lines), TARGETS.replace("MORE", more)
    )
    assert read_table_lines(found.text) == [
        "pose,temperature [degC],time,a.x [mm],a.y [mm],a.z [mm],b.x [mm],b.y [mm],b.z [mm]",
        "P1,20,2026-05-04T10:00:00,1,2,3,1,2,3",
        "P2,20,,1,2,3,,,",
        "P2,21,,,,,1,2,3",
    ]
    assert [(f.code, f.data["count"]) for f in found.findings] == [("files.other-times", 1)]
    assert f"## {found.findings[0]}\n" in found.text


def test_missing_values_are_compared_as_numbers_and_missing_words_as_text(tmp_path) -> None:
    profile = BY_NAME.replace("columns:", "missing: [-999.0, 0, 'n/a']\ncolumns:", 1)
    found = convert(
        tmp_path, "Name,X,Y,Z\n0.5,-999.0000,-999,0.000\nP2,n/a,1,-9.99e2\nP3,-99,1e-9,2\n", profile
    )
    assert read_table_lines(found.text)[1:] == ["0.5,,,", "P2,,1,", "P3,-99,1e-9,2"]
    comma = profile.replace("comma", "semicolon\ndecimal: comma").replace("-999.0", "'-999,0'")
    assert read_table_lines(convert(tmp_path, "Name;X;Y;Z\nP1;-999,00;0,0;3,5\n", comma).text)[
        1:
    ] == ["P1,,,3.5"]


@pytest.mark.parametrize(
    "cell", ["1_0", "\uff11.5", "nan", "inf", "1.5D+3", "\u22121.5", "0x1f", "1 234"]
)
def test_cell_that_only_resembles_a_number_is_skipped(tmp_path, cell) -> None:
    found = convert(tmp_path, f"Name,X,Y,Z\nP1,1,2,3\nP2,{cell},2,3\n", BY_NAME)
    assert found.misfits == ((3, f"{cell!r} is not a number for 'x'"),)


def test_missing_cells_of_a_rotation_matrix_give_empty_orientation_cells(tmp_path) -> None:
    profile = """delimiter: semicolon
missing: -999
matrix: [2, 3, 4, 5, 6, 7, 8, 9, 10]
columns: {pose: {from: 1}, x: {from: 11, unit: mm}, y: {from: 12, unit: mm}, z: {from: 13, unit: mm}}
settings: {kind: pose, orientation: quaternion}
"""  # noqa: E501
    found = convert(tmp_path, "P1;" + "-999.0;" * 9 + "1;2;3\n", profile)
    assert read_table_lines(found.text)[1:] == ["P1,,,,,1,2,3"]


JOINT = """delimiter: comma
columns:
  pose: {from: Name}
  measured.q1: {from: B1, unit: mm}
  sigma.measured.q1: {from: S, unit: um}
readings: {q1: {from: J1, unit: mm}}
settings: {kind: joint, joints: [q1], noise: {"*": 2 um}}
"""


def test_joint_with_reading_and_measurement_has_two_columns(tmp_path) -> None:
    found = convert(tmp_path, "Name,B1,J1,S\n1,5,7,3\n", JOINT)
    assert read_table_lines(found.text) == [
        "pose,sigma.measured.q1 [um],q1 [mm],measured.q1 [mm]",
        "1,3,7,5",
    ]
    with pytest.raises(
        FileError,
        match=r"'q1' is a reading and a measured column. Name the measured one 'measured.q1'",
    ):
        convert(tmp_path, "Name,B1,J1\n1,5,7\n", JOINT.replace("  measured.q1", "  q1"))


@pytest.mark.parametrize("word", ["null", "true", "No", "a"])
def test_setting_that_yaml_would_convert_is_quoted(tmp_path, word) -> None:
    profile = BY_NAME.replace("settings: {", f"settings: {{session: '{word}', poses: poses.csv, ")
    (tmp_path / "poses.csv").write_text(
        "pose,q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm]\n1,0,0,0,0,0,0\n"
    )
    (tmp_path / "data.csv").write_text(convert(tmp_path, "Name,X,Y,Z\n1,1,2,3\n", profile).text)
    data = load_measurements(tmp_path / "data.csv", load_robot("hexapod-42"))
    assert data.observations[0].session.tolist() == [word]


def test_import_reports_targets_with_different_times(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    lines = "Name;X;Y;Z;When\nP1_a;1;2;3;2026-05-04\nP1_b;1;2;3;2026-05-05\n"
    convert(tmp_path, lines, TARGETS.replace("MORE", "time: {from: When}"))
    words = ["import", "export.txt", "--profile", "profile.yaml", "-o", "data.csv"]
    assert main(words) == 0
    assert "note: 1 line of further targets with another time" in capsys.readouterr().out
    assert main([*words, "--json", "--force"]) == 0
    assert len(json.loads(capsys.readouterr().out)["notes"]) == 1


HEADER = (
    "pose,q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm],temperature [degC],x [mm],y [mm],z [mm]\n"
)
FRONT = "# kind: position\n# noise: {'*': 1 um}\n"
ROWS = FRONT + HEADER + "".join(f"P{i},{i},0,{i % 3},0,0,{i % 2},20,{i},2,3\n" for i in range(4))
REFUSED = {
    "semicolons": (ROWS.replace(",", ";"), "semicolons separate the columns.*profile"),
    "tabs": (ROWS.replace(",", "\t"), "tabs separate the columns.*profile"),
    "latin-1": (("## Länge\n" + ROWS).encode("latin-1"), "is not UTF-8 text .*profile"),
    "utf-16": (ROWS.encode("utf-16"), "is not UTF-8 text .*profile"),
    "capitals": (
        ROWS.replace("x [mm]", "X [mm]"),
        r"column 'X' is unknown \(did you mean 'x \[mm\]'\?\)",
    ),
    "brackets": (
        ROWS.replace("x [mm]", "x (mm)"),
        r"'x \(mm\)' is unknown \(did you mean 'x \[mm\]'\?\)",
    ),
    "both": (
        ROWS.replace("q1 [mm]", "Q1(mm)"),
        r"'Q1\(mm\)' is unknown \(did you mean 'q1 \[mm\]'\?\)",
    ),
    "ice": (ROWS.replace(",20,2,", ",-300,2,"), "data.csv:6: .*is -300 degC, below absolute zero"),
    "still": (
        re.sub(",20,.,2", ",20,1,2", ROWS),
        r"stay within 0 mm, but the robot moves it by [\d.]+ mm",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_measurement_file_of_another_program_is_refused_with_advice(tmp_path, case) -> None:
    content, message = REFUSED[case]
    raw = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "data.csv").write_bytes(raw)
    robot = load_robot("hexapod-42")
    with pytest.raises(LoopcalError, match=message) as caught:
        check_conventions(robot, load_measurements(tmp_path / "data.csv", robot))
    assert "\n" not in str(caught.value)


def test_temperature_of_zero_kelvin_is_accepted(tmp_path) -> None:
    (tmp_path / "data.csv").write_text(
        ROWS.replace("[degC]", "[degF]").replace(",20,2,", ",-459.67,2,")
    )
    data = load_measurements(tmp_path / "data.csv", load_robot("hexapod-42"))
    assert data.observations[0].context["temperature"][2] == pytest.approx(
        -273.15, abs=1e-9
    )  # [degC], rounding
