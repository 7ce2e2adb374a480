# SPDX-License-Identifier: Apache-2.0
"""Robot files: shipped robots, corrected files with identified values, errors with their line."""

import numpy as np
import pytest

from loopcal.errors import FileError, LoopcalError, MechanismError
from loopcal.io.robot.robot_file import find_robot_file, list_shipped_robots, load_robot, save_robot
from loopcal.mechanism.compilation import build

HEXAPOD = find_robot_file("hexapod-42").read_text()


@pytest.fixture
def robot():
    return load_robot("hexapod-42")


def write(folder, text: str):
    path = folder / "robot.yaml"
    path.write_text(text)
    return path


def test_every_shipped_robot_loads_and_states_its_source() -> None:
    robots = list_shipped_robots()
    assert "hexapod-42" in robots
    for name in robots:
        loaded = load_robot(name)
        assert loaded.name == name
        assert build(loaded.record.record.assembly()).parameters == loaded.parameters
        assert loaded.record.record.source
        assert np.array_equal(loaded.values, loaded.parameters.nominal)


def test_saved_nominal_robot_equals_its_file_byte_for_byte(tmp_path, robot) -> None:
    save_robot(robot, tmp_path / "copy.yaml")
    assert (tmp_path / "copy.yaml").read_text() == HEXAPOD


def test_identified_table_is_applied_and_deleting_it_restores_the_nominal(tmp_path, robot) -> None:
    path = tmp_path / "corrected.yaml"
    truth = robot.values + np.random.default_rng(3).normal(0.0, 1e-4, len(robot.values))
    plus_minus = np.full(len(truth), 2.5e-7)
    plus_minus[-1] = np.inf
    save_robot(robot.with_values(truth), path, plus_minus)
    text = path.read_text()
    assert text.count("+/-: null") == 1
    assert text.startswith(HEXAPOD)
    assert "+/-: 0.00025, unit: mm}" in text
    loaded = load_robot(path)
    np.testing.assert_allclose(
        loaded.values, truth, rtol=1e-15, atol=0
    )  # one rounding of value / unit * unit
    assert np.array_equal(loaded.parameters.nominal, robot.parameters.nominal)
    save_robot(loaded.nominal, tmp_path / "nominal.yaml")
    assert (tmp_path / "nominal.yaml").read_text() == HEXAPOD
    lines = text.split("\n")
    start = next(i for i, line in enumerate(lines) if line.startswith("identified:"))
    path.write_text("\n".join(lines[:start]) + "\n")
    assert np.array_equal(load_robot(path).values, robot.values)


def test_identified_table_in_the_middle_of_a_file_is_replaced(tmp_path, robot) -> None:
    table = "identified:\n  - {name: leg1.base.x, value: 121, +/-: null, unit: mm}\n# the legs\nlegs: rod\n"  # noqa: E501
    loaded = load_robot(write(tmp_path, HEXAPOD.replace("legs: rod\n", table)))
    assert loaded.values[0] == pytest.approx(0.121, rel=2e-16)
    save_robot(loaded, tmp_path / "again.yaml")
    text = (tmp_path / "again.yaml").read_text()
    assert text.count("identified:") == 1
    assert "# the legs\nlegs: rod\n" in text
    assert np.array_equal(load_robot(tmp_path / "again.yaml").values, loaded.values)


def test_robot_without_a_file_cannot_be_saved(tmp_path, robot) -> None:
    with pytest.raises(MechanismError, match="does not come from a robot file"):
        save_robot(build(robot.assembly), tmp_path / "r.yaml")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format: 1\n", "", "has no format. Begin it with 'format: 1'"),
        ("format: 1", "format: 2", "format 2, but this loopcal reads formats up to 1"),
        ("format: 1", "format: one", "'format' is 'one'"),
        (
            "family: gough",
            "family: guogh",
            "'guogh' is not a family of robots .*did you mean 'gough'",
        ),
        ("family: gough\n", "", "names no family. Write 'family:' and one of .*gough"),
        ("units: {length: mm, angle: deg}\n", "", "has no units"),
        ("stroke: [-75, 75]", "strokes: [-75, 75]", "unknown key 'strokes' .did you mean 'stroke'"),
        ("stroke: [-75, 75]", "stroke: [-75]", "'stroke' has 1 values, but must have 2"),
        ("[120, -140, 0]", "[120, -140]", "'base entry 1' has 2 values, but must have 3"),
        ("[120, -140, 0]", "[120, '-140', 0]", "is the text '-140', but must be a number"),
        ("[120, -140, 0]", "[120, .nan, 0]", "is nan. Write a finite number"),
        ("home: {z: 200}", "home: {z: 200}\nhome: {z: 200}", "duplicate key 'home'"),
        ("home: {z: 200}", "home: {zz: 200}", "unknown key 'zz' in 'home'"),
        ("lengths: 233.238076 ", "lengths: long ", "'lengths' is the text 'long'"),
        ("legs: rod", "legs: pole", "'legs' is 'pole'.*. Allowed: 'rod'"),
    ],
)
def test_error_in_a_robot_file_is_reported_with_its_line(
    tmp_path, old: str, new: str, message: str
) -> None:
    assert old in HEXAPOD
    text = HEXAPOD.replace(old, new, 1)
    with pytest.raises(FileError, match=message) as caught:
        load_robot(write(tmp_path, text))
    assert caught.value.line == (
        text[: text.rindex(new)].count("\n") + new.count("\n") + 1 if new else None
    )


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            "{name: leg1.base.q, value: 1, unit: mm}",
            "'leg1.base.q' is not a parameter of this robot .did you mean 'leg1.base",
        ),
        ("{name: leg1.base.x, value: 1, unit: deg}", "'leg1.base.x': 'deg' is a unit of angle"),
        ("{name: leg1.base.x, value: a, unit: mm}", "the value of 'leg1.base.x' is 'a'"),
        ("{name: leg1.base.x, value: 1}", "has no 'unit'"),
        ("{name: leg1.base.x, vale: 1, unit: mm}", "unknown key 'vale' .*did you mean 'value'"),
        ("5", "this row is not a mapping. Write"),
    ],
)
def test_error_in_the_identified_table_is_reported_with_its_line(
    tmp_path, row: str, message: str
) -> None:
    text = f"{HEXAPOD}identified:\n  - {row}\n"
    with pytest.raises(FileError, match=message) as caught:
        load_robot(write(tmp_path, text))
    assert caught.value.line == len(text.split("\n")) - 1


def test_parameters_are_fixed_by_name_or_pattern(tmp_path) -> None:
    table = load_robot(write(tmp_path, HEXAPOD + "fixed: [leg1.base.x, leg*.length]\n")).parameters
    fixed = [name for name, free in zip(table.names, table.free, strict=True) if not free]
    assert fixed == ["leg1.base.x", *(f"leg{i}.length" for i in range(1, 7))]
    record = load_robot(tmp_path / "robot.yaml").record.record
    assert build(record.assembly()).parameters == table  # the same robot without its file
    with pytest.raises(
        FileError,
        match=r"'leg1.base.q' under .fixed. matches no parameter of this robot .did you mean "
        r"'leg1.base",
    ):
        load_robot(write(tmp_path, HEXAPOD + "fixed: [leg1.base.q]\n"))


def test_robot_that_cannot_be_built_is_reported_with_its_file(tmp_path) -> None:
    path = write(tmp_path, HEXAPOD.replace("  - [120, 140, 0]\n", ""))
    with pytest.raises(LoopcalError, match=r"robot.yaml: hexapod-42 has 5 values under `base:`"):
        load_robot(path)


def test_unknown_robot_name_is_refused_with_the_shipped_ones() -> None:
    with pytest.raises(
        FileError, match=r"does not exist .did you mean 'hexapod-42'.*shipped robots: .*hexapod-42"
    ):
        load_robot("hexapod-43")


def test_folder_with_the_name_of_a_shipped_robot_does_not_hide_it(tmp_path, monkeypatch) -> None:
    """`loopcal example hexapod-42` makes such a folder."""
    monkeypatch.chdir(tmp_path)
    shipped = find_robot_file("hexapod-42")
    (tmp_path / "hexapod-42").mkdir()
    assert find_robot_file("hexapod-42") == shipped
    own = tmp_path / "linear-delta"
    own.write_text(HEXAPOD)
    assert find_robot_file("linear-delta").resolve() == own.resolve()
