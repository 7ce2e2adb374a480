# SPDX-License-Identifier: Apache-2.0
"""Exports of instruments are converted by a profile, and every skipped line is reported."""

import json
from pathlib import Path

import numpy as np
import pytest

from loopcal import geometry
from loopcal.cli.entry_point import main
from loopcal.errors import FileError
from loopcal.estimate.pose_estimate import fit_nuisance_values
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.exports.conversion import Conversion, convert_export
from loopcal.io.exports.profile import find_profile_file, read_profile
from loopcal.measure.initial_values import evaluate_measurements, whiten_rows
from loopcal.mechanism.solutions import forward
from tests.io import export_texts, test_profiles
from tests.io.export_texts import read_rows

EXAMPLES = Path("examples/exports").resolve()
CASES = {
    "tracker-points.txt": (8, 3, [27]),
    "six-dof.txt": (8, 2, []),
    "cmm-spheres.csv": (8, 3, []),
}


@pytest.mark.parametrize("name", CASES)
def test_imported_examples_agree_with_the_robot_within_their_noise(
    tmp_path, monkeypatch, capsys, robot, name
) -> None:
    """A wrong sign, order, unit or scalar place would leave residuals of thousands of sigma."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poses.csv").write_bytes((EXAMPLES / "poses.csv").read_bytes())
    profile = (EXAMPLES / name).with_suffix(".yaml")
    assert (
        main(
            ["import", str(EXAMPLES / name), "--profile", str(profile), "-o", "data.csv", "--json"]
        )
        == 0
    )
    rows, passed, misfits = CASES[name]
    document = json.loads(capsys.readouterr().out)
    assert (document["rows"], document["passed"]) == (rows, passed)
    assert [misfit["line"] for misfit in document["misfits"]] == misfits
    data = load_measurements("data.csv", robot)
    T = forward(robot, data.readings).T
    values = fit_nuisance_values(robot, data, T)
    white = whiten_rows(
        evaluate_measurements(data, T[None], values[None]), np.zeros((1, len(T), 6, 0))
    )[0, :, -1]
    degrees = data.n_rows - len(data.nuisance_parameters)
    assert white @ white < 2.5 * degrees  # chi-square, 11 degrees or more: above once in 400
    assert white @ white > 0.2 * degrees


def test_digits_of_numbers_and_empty_cells_are_kept() -> None:
    text = convert_export(
        EXAMPLES / "cmm-spheres.csv", read_profile(EXAMPLES / "cmm-spheres.yaml")
    ).text
    lines = [line for line in text.split("\n") if not line.startswith("#")]
    assert lines[0] == "pose,note diameter,x [mm],y [mm],z [mm]"
    assert lines[1] == '1,"25,0008",265.7983,-340.2645,354.4649'
    assert lines[4].endswith(",")


PROFILE = """format: 1
delimiter: semicolon
decimal: comma
columns:
  pose: {from: Name}
  x: {from: X, unit: mm}
  y: {from: Y, unit: mm}
  z: {from: Z, unit: mm}
settings: {kind: position, noise: {x: 1 um, y: 1 um, z: 1 um}}
"""
EXPORT = "Liste\nName;X;Y;Z\nP1;1,5;2;3\n\nP2;4;5;6e-1\n"


def convert(folder, export: str | bytes = EXPORT, profile: str = PROFILE) -> Conversion:
    return export_texts.convert(folder, export, profile)


def test_stated_encoding_is_used(tmp_path) -> None:
    named = PROFILE.replace("from: Name", "from: Prüfpunkt").replace(
        "decimal", "encoding: utf-16\ndecimal"
    )
    text = convert(
        tmp_path,
        EXPORT.replace("Name", "Prüfpunkt").replace("P1", "Fläche 1").encode("utf-16"),
        named,
    ).text
    assert read_rows(text)[0] == "Fläche 1,1.5,2,3"


def test_names_with_commas_quotes_and_number_signs_are_kept(tmp_path, robot) -> None:
    name = 'a,b "c" #1'
    export = EXPORT.replace("P1", '"a,b ""c"" #1"')
    names = '"a,b ""c"" #1"'
    readings = "pose,q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm]\n"
    (tmp_path / "poses.csv").write_text(f"{readings}{names},0,0,0,0,0,0\nP2,1,1,1,1,1,1\n")
    (tmp_path / "data.csv").write_text(convert(tmp_path, export).text)
    data = load_measurements([tmp_path / "poses.csv", tmp_path / "data.csv"], robot)
    assert data.labels == (name, "P2")
    np.testing.assert_array_equal(
        data.observations[0].measured, [[0.0015, 0.002, 0.003], [0.004, 0.005, 0.0006]]
    )


def test_columns_that_a_profile_does_not_use_are_named_once(tmp_path) -> None:
    for name, export in {"faro": "Name,RMS,X,Y,Z,Nominal X,\n", "leica": ""}.items():
        mark, ending = (",", ",7,8") if export else (" ", " 7")
        cells = (["1_SMR1", *["7"] * bool(export), "1", "2", "3"] for _ in range(2))
        path = tmp_path / f"{name}.txt"
        path.write_text(export + "".join(mark.join(row) + ending + "\n" for row in cells))
        (finding,) = convert_export(path, read_profile(find_profile_file(name))).findings
        assert finding.data["columns"] == (["RMS", "Nominal X"] if export else ["5"])


def test_lines_that_do_not_fit_are_listed_in_result_and_file(tmp_path) -> None:
    export = EXPORT + "P3;1;2\nP4;1;two;3\n;1;2;3\nP5;1.234,5;2;3\nP;6;1;2;3\nP7;1;2;3\n"
    found = convert(tmp_path, export)
    assert found.rows == 3
    assert [line for line, _ in found.misfits] == [6, 7, 8, 9, 10]
    reasons = " / ".join(reason for _, reason in found.misfits)
    for part in ("it has 3 columns, but 'Z' is column 4", "'two' is not a number for 'y'", "'' is not a name of a pose",  # noqa: E501
                 "'1.234,5' is not a number for 'x'", "it has 5 cells, but the header has 4 columns"):  # fmt: skip  # noqa: E501
        assert part in reasons
    assert "## lines that do not fit: 6, 7, 8, 9, 10\n" in found.text
    assert found.passed + found.rows + len(found.misfits) == sum(
        bool(line.strip()) for line in export.split("\n")
    )


def test_rotation_matrices_are_converted_to_quaternions(tmp_path) -> None:
    R = geometry.exp_so3(np.random.default_rng(2).normal(size=(3, 3)))
    lines = [
        ";".join([f"P{i}", *(f"{v:.5f}" for v in r.ravel()), "1", "2", "3"])
        for i, r in enumerate(R)
    ]
    broken = "B;" + ";".join(["1"] * 9) + ";1;2;3"
    profile = """delimiter: semicolon
matrix: [2, 3, 4, 5, 6, 7, 8, 9, 10]
columns: {pose: {from: 1}, x: {from: 11, unit: mm}, y: {from: 12, unit: mm}, z: {from: 13, unit: mm}}
settings: {kind: pose, orientation: quaternion}
"""  # noqa: E501
    found = convert(tmp_path, "\n".join([*lines, broken]), profile)
    assert [reason for _, reason in found.misfits] == [
        "the nine numbers are not a rotation matrix (error 3)"
    ]
    cells = np.array([row.split(",") for row in read_rows(found.text)])
    read = geometry.quaternion_to_matrix(cells[:, 1:5].astype(float))
    np.testing.assert_allclose(read, R, atol=1e-5)  # the five decimals of the export


def test_lines_of_several_targets_share_a_row_and_repeats_get_another(tmp_path) -> None:
    profile = PROFILE.replace(
        "{from: Name}", "{from: Name, match: '(?P<pose>P.)-(?P<target>.)'}"
    ).replace(
        "kind: position, noise: {x: 1 um, y: 1 um, z: 1 um}", "kind: position, targets: [a, b]"
    )
    lines = ["P1-a;1;1;1", "P1-b;2;2;2", "P1-b;2;2;3", "P2-b;3;3;3", "P2-c;3;3;3"]
    found = convert(tmp_path, "Name;X;Y;Z\n" + "\n".join(lines), profile)
    assert read_rows(found.text) == ["P1,1,1,1,2,2,2", "P1,,,,2,2,3", "P2,,,,3,3,3"]
    assert found.misfits == ((6, "the target 'c' is not one of a, b"),)


def test_one_line_holds_the_columns_of_all_targets(tmp_path) -> None:
    profile = PROFILE.replace(
        "kind: position, noise: {x: 1 um, y: 1 um, z: 1 um}", "kind: position, targets: [a, b]"
    )
    for name in "XYZ":
        profile = profile.replace(f"from: {name},", f"from: '{{target}} {name}',")
    head = "Name;a X;a Y;a Z;b X;b Y;b Z\n"
    lines = ["P1;1;1;1;2;2;2", "P2;3;3;3;;;", "P3;4;4;4;5;oops;5"]
    found = convert(tmp_path, head + "\n".join(lines), profile)
    assert read_rows(found.text) == ["P1,1,1,1,2,2,2", "P2,3,3,3,,,"]
    assert [number for number, _ in found.misfits] == [4]  # not in part
    with pytest.raises(FileError, match=r"'b Z'"):
        convert(tmp_path, head.replace("b Z", "c Z") + "\n".join(lines), profile)


BAD_EXPORTS = {
    "an empty file": (" \n", "export.txt: this export is empty. Export it again"),
    "a preamble alone": ("Liste\n", ("export.txt:1: no line names the columns Name, X, Y, Z of "
                                    ".*profile.yaml")),
    "another header": ("A;B;C\n1;2;3\n", ("export.txt:1: no line names the columns Name, X, Y, "
                                         "Z of .*profile.yaml. Correct the profile$")),
    "other separators": (EXPORT.replace(";", "\t"), r"\(tab in place of semicolon\)"),
    "decimal points instead of commas": (
        "Name;X;Y;Z\nP1;1.5;2.5;3\n",
        ("export.txt:2: no line of this export fits .*profile.yaml; reason for the first one: "
         "'1.5' is "
        "not a number for 'x'"),
    ),
    "a header alone": ("Name;X;Y;Z\n", "this export has no rows, only headers"),
    "another encoding": ("Name;X;Y;Z\nø1;1;2;3\n".encode("latin-1"), ("export.txt:2: byte 0xf8 is "
                                                                     "not utf-8.*'encoding'")),
    "a header twice": ("Name;X;X;Y;Z\nP;1;1;2;3\n", "export.txt:1: duplicate column 'X'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_EXPORTS)
def test_export_that_does_not_fit_the_profile_is_refused_with_the_reason(tmp_path, case) -> None:
    export, message = BAD_EXPORTS[case]
    with pytest.raises(FileError, match=message) as caught:
        convert(tmp_path, export)
    assert "\n" not in str(caught.value)


BAD_PROFILES = {
    "no delimiter": ("delimiter: semicolon\n", "", None, "no key 'delimiter'"),
    "an unknown delimiter": ("semicolon", "pipe", 2, "'delimiter' is 'pipe'. Allowed: 'comma'"),
    "a comma for two things": ("semicolon", "comma", 3, "'decimal' is the comma, as the separator"),
    "an unknown key": ("decimal", "decimals", 3, "unknown key 'decimals'.*did you mean 'decimal'"),
    "an unknown column": ("  z:", "  zz:", 8, "'zz' is not a column of .* the kind 'position'"),
    "a missing column": ("  z: {from: Z, unit: mm}\n", "", 4, "gives 0 sources of 'z'"),
    "no unit": ("Z, unit: mm", "Z", 8, "'z' has no unit"),
    "an unknown unit": (
        "Z, unit: mm",
        "Z, unit: mmm",
        8,
        "'z': unknown unit 'mmm' .did you mean 'mm'",
    ),
    "a unit of text": ("Name", "Name, unit: mm", 5, "'pose' is text and has no unit"),
    "an invalid column number": (
        "from: Z",
        "from: 0",
        8,
        "is 0, which is neither a name in .* nor a place",
    ),
    "no source": ("{from: Z, unit: mm}", "Z", 8, "'columns.z' is the text 'Z'"),
    "an invalid pattern": ("Name", "Name, match: '('", 5, "is not a regular expression"),
    "a pattern without a pose": ("Name", "Name, match: 'P.'", 5, "this pattern finds no pose"),
    "no pattern": ("position,", "position, targets: [a, b],", 5, "to 'match' of 'pose'"),
    "an unknown kind": ("position", "positon", 9, "is not a kind .* .did you mean 'position'"),
    "a matrix of four": ("decimal", "matrix: [1, 2, 3, 4]\ndecimal", 3, "matrix has nine columns"),
    "no kind": ("kind: position, ", "", 9, "the kind of measurement is missing"),
    "a newer format": ("format: 1", "format: 7", 1, "this file has format 7"),
    "an angle for a length": (
        "X, unit: mm",
        "X, unit: deg",
        6,
        "'x': 'deg' is a unit of angle, not of a length",
    ),
    "one unit for a covariance": ("  z:", "  cov.x.y: {from: C, unit: mm}\n  z:", 8, "not a unit"),
    "an unknown sigma": (
        "  z:",
        "  sigma.w: {from: C, unit: mm}\n  z:",
        8,
        "'sigma.w' is not a column .*did you mean 'sigma",
    ),
    "another unit in the header": ("from: X", 'from: "X [m]"', 6, "header is 'X .m.', but"),
    "degrees in the header": ("from: X", 'from: "X (°)"', 6, "Write the unit deg"),
    "no readings": ("settings", "readings:\nsettings", 9, "'readings' is empty"),
    "an empty value": ("delimiter", "missing: [null]\ndelimiter", 2, "'missing entry 1' is empty"),
} | {
    name: ("decimal", f"encoding: {name}\ndecimal", 3, f"'{name}', which is not a known encoding")
    for name in ("utf-99", "hex", "rot13")
}
BAD_UNCERTAINTIES = {
    "factor 0": ("factor: 0.5, floor", "factor: 0, floor", 9, "factor' is 0. Write a positive"),
    "floor 0": ("floor: 0.002 mm", "floor: 0 mm", 9, "floor' is 0 mm. Write a positive quantity"),
    "floor in degrees": ("floor: 0.002 mm", "floor: 2 deg", 9, "deg"),
    "floor without unit": ("floor: 0.002 mm", "floor: 2", 9, "unit"),
    "factor of x": ('mm]", unit: mm', 'mm]", unit: mm, factor: 2', 6, "'factor' belongs to"),
    "floor of x": ('mm]", unit: mm', 'mm]", unit: mm, floor: 1 um', 6, "'floor' belongs to"),
}
BAD_READINGS = {
    "no pose": ("pose: {from: Point}, ", "", 4, "Add the column 'pose'"),
    "a measured column": (
        "pose: {from: Point}",
        "pose: {from: Point}, x: {from: L1, unit: mm}",
        4,
        r"'x' is not a column of a table of readings \(without a kind\)",
    ),
    "noise": ("robot: hexapod-42", "noise: {x: 1 um}", 12, "unknown key 'noise'"),
}
REFUSED_PROFILES = [
    pytest.param(profile, *case, id=name)
    for profile, cases in (
        (PROFILE, BAD_PROFILES),
        (test_profiles.PROFILE, BAD_UNCERTAINTIES),
        (test_profiles.READINGS, BAD_READINGS),
    )
    for name, case in cases.items()
]


@pytest.mark.parametrize(("profile", "old", "new", "line", "message"), REFUSED_PROFILES)
def test_invalid_profile_is_refused_with_its_line(tmp_path, profile, old, new, line, message):
    assert old in profile
    with pytest.raises(FileError, match=message) as caught:
        convert(tmp_path, EXPORT, profile.replace(old, new, 1))
    assert caught.value.line == line
    assert "\n" not in str(caught.value)


def test_format_with_a_profile_and_existing_output_are_refused(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    convert(tmp_path)
    words = ["import", "export.txt", "--profile", "profile.yaml", "-o", "data.csv"]
    assert main([*words, "--format", "klipper"]) == 1
    assert "--format has no effect with --profile" in capsys.readouterr().err
    assert main(words) == 0
    assert main(words) == 1
    assert "this file exists" in capsys.readouterr().err
    assert main(["import", "none.txt", *words[2:], "--force"]) == 1
    assert "this export does not exist" in capsys.readouterr().err
