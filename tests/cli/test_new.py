# SPDX-License-Identifier: Apache-2.0
"""`loopcal new` writes robot files and measurement templates that work without changes."""

import pytest

from loopcal.cli.entry_point import main
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism.families import FAMILIES


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*FAMILIES, *list_shipped_robots()}))
def test_new_robot_file_loads_and_lists_its_optional_keys(name) -> None:
    assert main(["new", name, "-o", "mine.yaml"]) == 0
    robot = load_robot("mine.yaml")
    assert robot.name == "mine"
    text = robot.record.text
    for key in ("workspace", "tolerances", "fixed"):
        assert f"#   {key}: " in text
    assert max(len(line) for line in text.split("\n") if line.startswith("#   ")) <= 120


def test_robot_name_that_looks_like_a_number_is_quoted() -> None:
    assert main(["new", "gough", "-o", "2.yaml"]) == 0
    assert load_robot("2.yaml").name == "2"


def test_measurement_template_lacks_only_rows(tmp_path, capsys) -> None:
    words = "new linear-delta -o printer.yaml --measurements heights.csv --kind component --components z --sigma-position 20um"  # noqa: E501
    assert main(words.split()) == 0
    template = tmp_path / "heights.csv"
    assert (
        "# noise: {z: 20 um}\npose,q1 [mm],q2 [mm],q3 [mm],z [mm]\n# Add one row"
        in template.read_text()
    )
    assert "Optional columns: block, session, group, time" in template.read_text()
    assert main(["calibrate", "printer.yaml", "heights.csv", "-o", "run"]) == 1
    assert "has a header but no rows; add one row for each pose" in capsys.readouterr().err
    rows = [f"p{i},{150 + 7 * i},{150 + i * i},{160 - 3 * i},100.0" for i in range(12)]
    template.write_text(template.read_text() + "\n".join(rows) + "\n")
    assert (
        main(
            [
                "identifiability",
                "printer.yaml",
                "heights.csv",
                "--allow-still",
                "--allow-implausible",
            ]
        )
        == 0
    )


def test_filled_in_template_of_two_kinds_is_accepted(tmp_path, capsys) -> None:
    words = "new gough -o robot.yaml --measurements data.csv --kind position,inclination --sigma-position 5um"  # noqa: E501
    assert main(words.split()) == 0
    text = (tmp_path / "data.csv").read_text()
    assert "#   position: {kind: position, noise: {x: 5 um" in text
    assert "#   inclination: {kind: inclination" in text
    assert "pose,kind,q1 [mm]" in text
    rows = [f"p{i},position" + f",{i}" * 6 + f",{0.1 * i},{0.2 * i},{300 + i},," for i in range(4)]
    rows += [f"p{i},inclination,,,,,,,,,,{0.01 * i},{0.02 * i}" for i in range(4)]
    (tmp_path / "data.csv").write_text(text + "\n".join(rows) + "\n")
    assert (
        main(["identifiability", "robot.yaml", "data.csv", "--allow-still", "--allow-implausible"])
        == 0
    )
    assert (
        main(
            [
                "new",
                "gough",
                "-o",
                "other.yaml",
                "--measurements",
                "d.csv",
                "--kind",
                "position,position",
            ]
        )
        == 1
    )
    assert "'position' is named twice" in capsys.readouterr().err


def test_existing_file_is_replaced_only_with_force(tmp_path, capsys) -> None:
    assert main(["new", "gough", "-o", "mine.yaml"]) == 0
    (tmp_path / "mine.yaml").write_text("mine")
    capsys.readouterr()
    assert main(["new", "3-prs", "-o", "mine.yaml"]) == 1
    assert "this file exists" in capsys.readouterr().err
    assert (tmp_path / "mine.yaml").read_text() == "mine"
    assert main(["new", "3-prs", "-o", "mine.yaml", "--force"]) == 0


def test_unknown_family_is_refused(capsys) -> None:
    assert main(["new", "hexpod", "-o", "mine.yaml"]) == 1
    assert "neither a family nor a shipped robot" in capsys.readouterr().err


def test_template_of_a_tracker_declares_unknown_frame_and_targets(tmp_path, capsys) -> None:
    words = "new gough -o my.yaml --measurements tracker.csv --kind position --frames base"
    assert main([*words.split(), "--targets", "SMR1,SMR2,SMR3", "--sigma-position", "15um"]) == 0
    text = (tmp_path / "tracker.csv").read_text()
    assert "# targets: [SMR1, SMR2, SMR3]\n# places: [[160 mm, 0 mm, 0 mm], [-80 mm" in text
    assert '# unknown: [frame, targets]\n# noise: {"*": 15 um}\npose,q1 [mm]' in text
    assert ",SMR3.x [mm],SMR3.y [mm],SMR3.z [mm]\n" in text
    assert "# Replace the places of the targets above by yours" in text
    assert main(["new", "gough", "-o", "other.yaml", "--kind", "pose", "--targets", "SMR1"]) == 1
    assert "the kind 'pose' measures no targets" in capsys.readouterr().err
    assert (
        main("new gough -o other.yaml --kind position --frames tracker".split()) == 1  # noqa: SIM905
    )
    assert "'tracker' is not a frame that can be unknown" in capsys.readouterr().err
    assert not (tmp_path / "other.yaml").exists()
