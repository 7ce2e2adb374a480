# SPDX-License-Identifier: Apache-2.0
"""`loopcal new` writes robot files and measurement templates that work without changes."""

import pytest

import loopcal as lc
from loopcal.mechanism.families import FAMILIES
from tests.zoo import FEW_ROBOTS


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*FAMILIES, *(robot for robot in FEW_ROBOTS if robot.values[0] not in FAMILIES)]
)
def test_new_robot_file_loads_and_lists_its_optional_keys(loopcal, name) -> None:
    loopcal(["new", name, "-o", "mine.yaml"])
    robot = lc.load_robot("mine.yaml")
    assert robot.name == "mine"
    text = robot.record.text
    for key in ("workspace", "tolerances", "fixed"):
        assert f"#   {key}: " in text
    assert max(len(line) for line in text.split("\n") if line.startswith("#   ")) <= 120


def test_robot_name_that_looks_like_a_number_is_quoted(loopcal) -> None:
    loopcal("new gough -o 2.yaml")
    assert lc.load_robot("2.yaml").name == "2"


def test_measurement_template_lacks_only_rows(loopcal, tmp_path) -> None:
    words = "new linear-delta -o printer.yaml --measurements heights.csv --kind component --components z --sigma-position 20um"  # noqa: E501
    loopcal(words)
    template = tmp_path / "heights.csv"
    assert (
        "# noise: {z: 20 um}\npose,q1 [mm],q2 [mm],q3 [mm],z [mm]\n# Add one row"
        in template.read_text()
    )
    assert "Optional columns: block, session, group, time" in template.read_text()
    loopcal(
        "calibrate printer.yaml heights.csv -o run",
        "has a header but no rows. Add one row for each pose",
        code=1,
    )
    rows = [f"p{i},{150 + 7 * i},{150 + i * i},{160 - 3 * i},100.0" for i in range(12)]
    template.write_text(template.read_text() + "\n".join(rows) + "\n")
    loopcal("identifiability printer.yaml heights.csv --allow-still --allow-implausible")


def test_filled_in_template_of_two_kinds_is_accepted(loopcal, tmp_path) -> None:
    words = "new gough -o robot.yaml --measurements data.csv --kind position,inclination --sigma-position 5um"  # noqa: E501
    loopcal(words)
    text = (tmp_path / "data.csv").read_text()
    assert "#   position: {kind: position, noise: {x: 5 um" in text
    assert "#   inclination: {kind: inclination" in text
    assert "pose,kind,q1 [mm]" in text
    rows = [f"p{i},position" + f",{i}" * 6 + f",{0.1 * i},{0.2 * i},{300 + i},," for i in range(4)]
    rows += [f"p{i},inclination,,,,,,,,,,{0.01 * i},{0.02 * i}" for i in range(4)]
    (tmp_path / "data.csv").write_text(text + "\n".join(rows) + "\n")
    loopcal("identifiability robot.yaml data.csv --allow-still --allow-implausible")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("hexpod", "neither a family nor a shipped robot"),
        ("gough --measurements d.csv --kind position,position", "'position' occurs twice"),
        ("gough --kind pose --targets SMR1", "the kind 'pose' measures no targets"),
        ("gough --kind position --frames tracker", "an unknown frame is 'tracker'"),
    ],
)
def test_wrong_words_are_refused_and_nothing_is_written(loopcal, folder, words, said) -> None:
    loopcal(f"new -o mine.yaml {words}", said, code=1)
    assert list(folder.iterdir()) == []


def test_template_of_a_tracker_declares_unknown_frame_and_targets(loopcal, tmp_path) -> None:
    words = "new gough -o my.yaml --measurements tracker.csv --kind position --frames base"
    loopcal([*words.split(), "--targets", "SMR1,SMR2,SMR3", "--sigma-position", "15um"])
    text = (tmp_path / "tracker.csv").read_text()
    assert "# targets: [SMR1, SMR2, SMR3]\n# places: [[160 mm, 0 mm, 0 mm], [-80 mm" in text
    assert '# unknown: [frame, targets]\n# noise: {"*": 15 um}\npose,q1 [mm]' in text
    assert ",SMR3.x [mm],SMR3.y [mm],SMR3.z [mm]\n" in text
    assert "# Replace the places of the targets above by yours" in text
