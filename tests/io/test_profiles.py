# SPDX-License-Identifier: Apache-2.0
"""Profiles: expanded uncertainties, names of columns, tables of readings, and hostile exports."""

import re

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import FileError
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.exports.conversion import Conversion
from tests.io import export_texts
from tests.io.export_texts import read_rows

PROFILE = """format: 1
delimiter: semicolon
decimal: comma
columns:
  pose: {from: Name}
  x: {from: "X [mm]", unit: mm}
  y: {from: "Y [mm]", unit: mm}
  z: {from: "Z [mm]", unit: mm}
  sigma.x: {from: "U(95) X", unit: um, factor: 0.5, floor: 0.002 mm}
  sigma.y: {from: "U(95) Y", unit: um, factor: 0.5, floor: 0.002 mm}
  sigma.z: {from: "U(95) Z", unit: um, factor: 0.5, floor: 0.002 mm}
settings: {kind: position, poses: poses.csv}
"""
EXPORT = """Report of a tracker;;;;;;
Name;X [mm];Y [mm];Z [mm];U(95) X;U(95) Y;U(95) Z
P1;1,5;2;203;12,5;0;7
P2;4;5;204;3;9,75;0
P3;4,5;5;205;;9,75;8
"""
NINE = "1,2,3,4,5,6,7,8,9"
NOISE = "noise: {x: 5 um, y: 5 um, z: 5 um}"
READINGS = """format: 1
delimiter: semicolon
decimal: comma
columns: {pose: {from: Point}, use: {from: Purpose}}
readings:
  q1: {from: L1, unit: mm}
  q2: {from: L2, unit: mm}
  q3: {from: L3, unit: mm}
  q4: {from: L4, unit: mm}
  q5: {from: L5, unit: mm}
  q6: {from: L6, unit: mm}
settings: {robot: hexapod-42}
"""
LENGTHS = """Point;Purpose;L1;L2;L3;L4;L5;L6
P1;fit;1,5;2;3;4;5;6
P2;held-out;0;0;0;0;0;1e-1
P3;;1;1;1;1;1;1
"""


def convert(folder, export: str | bytes = EXPORT, profile: str = PROFILE) -> Conversion:
    return export_texts.convert(folder, export, profile)


def test_expanded_uncertainties_are_divided_and_zeros_become_the_floor(tmp_path, robot) -> None:
    export = EXPORT.replace("P3;4,5;5;205;;9,75", "P3;4,5;5;205;4,5;9,75")
    found = convert(tmp_path, export)
    assert found.misfits == ()
    sigmas = [row.split(",")[1:4] for row in read_rows(found.text)]
    assert sigmas == [["6.25", "2", "3.5"], ["2", "4.875", "2"], ["2.25", "4.875", "4"]]
    (tmp_path / "data.csv").write_text(found.text)
    (tmp_path / "poses.csv").write_text(convert(tmp_path, LENGTHS, READINGS).text)
    data = load_measurements(tmp_path / "data.csv", robot)
    sigma = np.sqrt(np.diagonal(data.observations[0].covariance, axis1=1, axis2=2))
    wanted = [[6.25, 2, 3.5], [2, 4.875, 2], [2.25, 4.875, 4]]
    np.testing.assert_allclose(sigma * 1e6, wanted, rtol=1e-12)


def test_zero_without_a_floor_is_named_and_missing_sigma_stays_missing(tmp_path) -> None:
    plain = PROFILE.replace(", floor: 0.002 mm", "").replace(", factor: 0.5", "")
    found = convert(tmp_path, profile=plain)
    assert [line for line, _ in found.misfits] == [3, 4]
    assert "'sigma.y' is 0, but must be positive. Give a 'floor'" in found.misfits[0][1]
    assert read_rows(found.text) == ["P3,,9.75,8,4.5,5,205"]


@pytest.mark.parametrize("floor", ["", ", floor: 0.002 mm"])
def test_negative_sigma_does_not_become_the_floor(tmp_path, floor) -> None:
    """Instruments write -1 where they know no uncertainty; the floor would be a confident one."""
    profile = PROFILE.replace(", floor: 0.002 mm", floor)
    export = EXPORT.replace("P3;4,5;5;205;;9,75", "P3;4,5;5;205;-1;9,75").replace(
        "12,5;0", "12,5;1"
    )
    found = convert(tmp_path, export, profile)
    assert "'sigma.x' is -1, but no standard deviation is negative" in found.misfits[-1][1]
    found = convert(tmp_path, export, profile + "missing: [-1]\n")
    assert not any("negative" in reason for _, reason in found.misfits)


def test_factor_writes_no_more_than_seventeen_digits(tmp_path) -> None:
    third = PROFILE.replace("factor: 0.5", "factor: 0.3333333333333333")
    cells = read_rows(convert(tmp_path, profile=third).text)[0].split(",")
    assert float(cells[1]) == pytest.approx(12.5 / 3, rel=1e-15)
    assert all(len(re.sub(r"\D", "", cell).lstrip("0")) <= 17 for cell in cells[1:])


@pytest.mark.parametrize(
    ("cell", "stated"),
    [
        (" X [mm] ", "X [mm]"),
        ("X [mm]", "  X [mm]  "),
        ("X  [mm]", "X [mm]"),
        ("X\u00a0[mm]", "X [mm]"),
        ("X [mm]", "X\u00a0 [mm]"),
        ('" X [mm] "', "X [mm]"),
        ("\u00dc", "U\u0308"),
    ],
)
def test_header_and_from_are_stripped_in_the_same_way(tmp_path, cell, stated) -> None:
    profile = PROFILE.replace('from: "X [mm]"', f'from: "{stated}"')
    found = convert(tmp_path, EXPORT.replace("X [mm]", cell), profile)
    assert found.rows == 3
    assert read_rows(found.text)[0].endswith(",1.5,2,203")


def test_blanks_in_front_of_the_first_column_and_in_a_matrix_are_stripped(tmp_path) -> None:
    names = [f"r{i}{j}" for i in "123" for j in "123"]
    profile = f"""format: 1
delimiter: comma
columns: {{pose: {{from: " Name"}}, x: {{from: x, unit: mm}}, y: {{from: y, unit: mm}},
  z: {{from: z, unit: mm}}}}
matrix: [{", ".join(f"'{name} '" for name in names)}]
settings: {{kind: pose, orientation: quaternion, noise: {{"*": 1 urad, x: 1 um, y: 1 um, z: 1 um}}}}
"""
    export = f"\ufeff Name , x,y,z, {' , '.join(names)}\nA,1,2,3,1,0,0,0,1,0,0,0,1\n"
    assert read_rows(convert(tmp_path, export, profile).text) == ["A,1.0,0.0,0.0,0.0,1,2,3"]


MISSING = {
    "another case": ("Z [mm];", "z [mm];", "'Z [mm]' (did you mean 'z [mm]'?)"),
    "a typing error": ("U(95) X", "U(95)X", "'U(95) X' (did you mean 'U(95)X'"),
    "left out": (";U(95) Z", "", "'U(95) Z'"),
}


@pytest.mark.parametrize("case", MISSING)
def test_missing_column_is_named_with_the_columns_that_exist(tmp_path, case) -> None:
    old, new, sentence = MISSING[case]
    with pytest.raises(FileError) as refused:
        convert(tmp_path, EXPORT.replace(old, new))
    assert refused.value.code == "files.export-column-missing"
    text = str(refused.value)
    assert text.startswith(f"{tmp_path}/export.txt:2: {tmp_path}/profile.yaml needs the column ")
    assert sentence in text
    assert "has Name, X [mm], Y [mm]" in text


def test_table_of_readings_alone_is_joined_with_measured_values(tmp_path, robot) -> None:
    found = convert(tmp_path, LENGTHS, READINGS)
    assert (found.rows, found.misfits) == (3, ())
    assert "kind" not in found.text
    (tmp_path / "poses.csv").write_text(found.text)
    values = PROFILE.replace("kind: position", f"kind: position, {NOISE}")
    (tmp_path / "data.csv").write_text(convert(tmp_path, profile=values).text)
    data = load_measurements(tmp_path / "data.csv", robot)
    assert data.labels == ("P1", "P2", "P3")
    np.testing.assert_allclose(data.readings[:, 5] * 1e3, [6, 0.1, 1], rtol=1e-15)
    assert data.is_held_out.tolist() == [False, True, False]


def test_unknown_use_is_a_line_that_does_not_fit(tmp_path) -> None:
    found = convert(tmp_path, LENGTHS.replace("held-out", "validate"), READINGS)
    assert found.misfits == ((3, "the use 'validate' is not fit or held-out"),)


HOSTILE = {
    "old Mac lines": lambda text: text.replace("\n", "\r").encode(),
    "Windows lines": lambda text: text.replace("\n", "\r\n").encode(),
    "byte order mark": lambda text: text.encode("utf-8-sig"),
    "blanks at the ends of lines": lambda text: text.replace("\n", "   \n").encode(),
    "separator at the ends of lines": lambda text: text.replace("\n", ";\n").encode(),
    "repeated header": lambda text: (text + "\n".join(text.split("\n")[:1]) + "\n").encode(),
    "quotes": lambda text: text.replace("P1", '"P1"').replace("1,5", '"1,5"').encode(),
    "blanks around cells": lambda text: text.replace(";", " ; ").encode(),
    "empty lines": lambda text: text.replace("\n", "\n\n \n").encode(),
    "a further column": lambda text: "\n".join(f"{line};9" for line in text.split("\n")).encode(),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_layout_of_an_export_makes_no_difference(tmp_path, case) -> None:
    text = EXPORT.split("\n", 1)[1]
    usual = read_rows(convert(tmp_path, text).text)
    assert len(usual) == 3
    assert read_rows(convert(tmp_path, HOSTILE[case](text)).text) == usual


@pytest.mark.parametrize(
    "cell", ["NaN", "nan", "n/a", "-nan(ind)", "#VALUE!", "inf", "1.234,5", "1 5"]
)
def test_text_in_place_of_a_number_is_named_unless_it_means_missing(tmp_path, cell) -> None:
    export = EXPORT.replace("P1;1,5", f"P1;{cell}")
    found = convert(tmp_path, export)
    assert [line for line, _ in found.misfits] == [3]
    assert f"{cell!r} is not a number for 'x'" in found.misfits[0][1]
    known = PROFILE.replace("decimal: comma", f"decimal: comma\nmissing: ['{cell}']")
    found = convert(tmp_path, export, known)
    assert found.misfits == ()
    assert read_rows(found.text)[0].endswith(",,2,203")


def test_needed_column_that_occurs_twice_is_refused(tmp_path) -> None:
    with pytest.raises(FileError, match=r"export\.txt:2: duplicate column 'X \[mm\]'"):
        convert(
            tmp_path,
            EXPORT.replace("Y [mm]", "X [mm] ", 1)
            .replace("U(95) X", "Y [mm]", 1)
            .replace("U(95) Y", "U(95) X;U(95) Y", 1),
        )


@pytest.mark.parametrize(
    ("name", "export"),
    [
        ("leica", "// name x y z\nP007_SMR1 1 2 3 9.5\nP007_SMR2 4 5 6 9.5\nP007_SMR3 7 8 9 9.5\n"),
        ("faro", "Name,X,Y,Z\n7_SMR1,1,2,3\n7_SMR2,4,5,6\n7_SMR3,7,8,9\n"),
        ("spatial-analyzer", "A,G,7_SMR1,1,2,3\nA,G,7_SMR2,4,5,6\nA,G,7_SMR3,7,8,9\n"),
        ("wide", f"Name,{','.join(f'SMR{i} {c}' for i in (1, 2, 3) for c in 'XYZ')}\n7,{NINE}\n"),
    ],
)
def test_shipped_profile_reads_its_export_and_assumes_the_noise(
    tmp_path, monkeypatch, name, export
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "export.txt").write_text(export)
    assert main(["import", "export.txt", "--profile", name, "-o", "data.csv"]) == 0
    lines = (tmp_path / "data.csv").read_text().splitlines()
    assert lines[-1] == f"7,{NINE}"
    assert "# noise_source: assumed" in lines  # nobody gave 15 um, so no quality gate may use it
