# SPDX-License-Identifier: Apache-2.0
"""CSV tables: units in the header, settings in table or sidecar, errors with their line."""

import math

import pytest

from loopcal.errors import FileError
from loopcal.io.core.csv_table import read_table, require_columns
from loopcal.units import Dimension

GOOD = """# kind: pose
# noise: {x: 0.001 mm}
## a remark
pose,q.leg1 [mm],rx [mrad]
p1,233.5,1e-3
# skipped

p2,234.5,
"""


def write(folder, text: str | bytes):
    path = folder / "data.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def read_all(path):
    table = read_table(path)
    require_columns(table, ["q.leg1"], "is a reading")
    return table.numbers("q.leg1", Dimension.LENGTH, empty=False), table.numbers(
        "rx", Dimension.ANGLE
    )


def test_columns_are_read_in_si_units_with_nan_for_empty_cells(tmp_path) -> None:
    path = write(tmp_path, GOOD)
    readings, angles = read_all(path)
    assert readings.tolist() == pytest.approx([0.2335, 0.2345], rel=4e-16)
    assert angles[0] == pytest.approx(1e-6, rel=4e-16)
    assert math.isnan(angles[1])
    table = read_table(path)
    assert tuple(table.text("pose")) == ("p1", "p2")
    assert table.settings.content == {"kind": "pose", "noise": {"x": "0.001 mm"}}
    assert (table.header_line, list(table.lines)) == (4, [5, 8])


@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_byte_order_mark_and_line_ends_of_others_are_accepted(tmp_path, end) -> None:
    path = write(tmp_path, b"\xef\xbb\xbf" + GOOD.replace("\n", end).encode())
    table = read_table(path)
    assert (table.header_line, list(table.lines)) == (4, [5, 8])
    assert read_all(path)[0].tolist() == pytest.approx([0.2335, 0.2345], rel=4e-16)


def test_single_carriage_return_is_named(tmp_path) -> None:
    path = write(tmp_path, GOOD.replace("p1,", "p1,\r").encode())
    with pytest.raises(FileError, match=":5: this line contains a carriage return"):
        read_table(path)


def test_settings_are_read_from_a_sidecar_file(tmp_path) -> None:
    path = write(
        tmp_path,
        GOOD.replace("# kind: pose", "# measured on a cold day").replace(
            "# noise: {x: 0.001 mm}\n", ""
        ),
    )
    (tmp_path / "data.yaml").write_text("kind: component\n")
    assert read_table(path).settings.content == {"kind": "component"}


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        (GOOD, "", None, "is empty"),
        (GOOD, "# kind: pose\n", None, "no header"),
        ("p1,233.5,1e-3\n# skipped\n\np2,234.5,\n", "", 4, "a header but no rows"),
        ("# kind: pose", "# cold day", 2, "Begin a remark with ##"),
        ("# kind: pose", "# kind: pose\n# kind: pose", 2, "duplicate key"),
        ("q.leg1 [mm]", "q.leg1", 4, "column 'q.leg1' has no unit. Write it in brackets"),
        ("q.leg1 [mm]", "q.leg1 []", 4, "column 'q.leg1': unknown unit ''"),
        (
            "q.leg1 [mm]",
            "q.leg1 [mmm]",
            4,
            "column 'q.leg1': unknown unit 'mmm' .did you mean 'mm'",
        ),
        ("q.leg1 [mm]", "q.leg1 [deg]", 4, "'deg' is a unit of angle, not of a length"),
        ("q.leg1 [mm]", "q.leg2 [mm]", 4, "no column 'q.leg1' .did you mean 'q.leg2'"),
        ("q.leg1 [mm]", "q.leg1 [mm", 4, "header of column 2 is 'q.leg1 .mm'"),
        ("q.leg1 [mm]", "", 4, "header of column 2 is ''"),
        ("rx [mrad]", "q.leg1 [mm]", 4, "duplicate column 'q.leg1'"),
        ("p1,233.5,1e-3", "p1,233.5", 5, "has 2 cells, but the header has 3 columns"),
        ("p1,233.5,1e-3", "p1,233,5,1e-3", 5, "has 4 cells, but the header has 3 columns"),
        ("p1,233.5,1e-3", "p1,,1e-3", 5, "column 'q.leg1' is empty"),
        ("p1,233.5,1e-3", "p1,233.5mm,1e-3", 5, "is '233.5mm', but must be a number"),
        ("p1,233.5,1e-3", "p1,2_3,1e-3", 5, "is '2_3', but must be a number"),
        ("p2,234.5,", "p2,234.5,NaN", 8, "is 'NaN', which is not finite. Leave"),
        ("p2,234.5,", "p2,234.5,inf", 8, "not finite"),
        ("p2,234.5,", 'p2,"234.5,', 8, "not valid CSV"),
        (
            "pose,q.leg1 [mm],rx [mrad]",
            "pose;q.leg1 [mm];rx [mrad]",
            4,
            "semicolons separate the columns. Use commas",
        ),
    ],
)
def test_invalid_table_is_refused_in_one_sentence_with_its_line(
    tmp_path, old: str, new: str, line: int | None, message: str
) -> None:
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(FileError, match=message) as caught:
        read_all(path)
    assert caught.value.line == line
    assert "\n" not in str(caught.value)


SIDECARS = {
    "family: gough\n": None,  # a robot file may have the name of its measurements
    "title: a plot\n": None,
    "- a\n- list\n": None,
    "not: [yaml\n": None,
    "": None,
    "kind: component\n": r"at the top of this file and in data.yaml. Remove one",
    "noise: {x: 1 mm}\n": r"at the top of this file and in data.yaml. Remove one",
}


@pytest.mark.parametrize("sidecar", SIDECARS)
def test_other_settings_beside_a_table_are_refused_and_unrelated_files_ignored(
    tmp_path, sidecar
) -> None:
    path = write(tmp_path, GOOD)
    (tmp_path / "data.yaml").write_text(sidecar)
    if SIDECARS[sidecar] is None:
        assert read_table(path).settings.content["kind"] == "pose"
        return
    with pytest.raises(FileError, match=SIDECARS[sidecar]):
        read_table(path)
