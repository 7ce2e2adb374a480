# SPDX-License-Identifier: Apache-2.0
"""`loopcal compensate` and `loopcal calibrate --prior`: files, exit codes and error messages."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.core.csv_table import read_table

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"
TARGETS = """pose,x [mm],y [mm],z [mm],roll [deg],pitch [deg],yaw [deg]
home,0,0,200,0,0,0
left,-20,10,0.21e3,5,-3,8
"""
UNREACHABLE = "high,0,0,300,0,0,0\n"
WANTED = np.array([[0, 0, 0.2, 0, 0, 0], [-0.02, 0.01, 0.21, *np.deg2rad([5, -3, 8])]])


@pytest.fixture(scope="module")
def example_folder(tmp_path_factory):
    """A folder with the example's files and a run on its measurements."""
    folder = tmp_path_factory.mktemp("compensate")
    for path in EXAMPLE.iterdir():
        shutil.copy(path, folder)
    words = ["calibrate", "hexapod-42", str(folder / "measurements.csv"), "-o", str(folder / "run")]
    assert main([*words, "--method", "ls"]) == 0
    return folder


@pytest.fixture
def loopcal(loopcal, example_folder, monkeypatch):
    """Run a command line in the example folder."""
    monkeypatch.chdir(example_folder)
    (example_folder / "targets.csv").write_text(TARGETS)
    return loopcal


def test_written_readings_move_the_calibrated_robot_to_the_targets(loopcal, example_folder) -> None:
    loopcal(
        "compensate run targets.csv -o readings.csv",
        "home",
        "Frame: tool point, base axes, absolute in the base frame of the robot file",
    )
    table = read_table(example_folder / "readings.csv")
    q = np.column_stack([table.numbers(f"q{i}", lc.Dimension.LENGTH) for i in range(1, 7)])
    np.testing.assert_allclose(
        q, lc.inverse(lc.load_robot("run/robot.yaml"), WANTED).q, rtol=0, atol=1e-15
    )
    assert set(table.text("note status")) == {"reached in full"}
    assert (table.numbers("note U x", lc.Dimension.LENGTH) < 3e-6).all()  # [m], instrument 1 um


def test_written_commands_reach_the_targets_through_the_nominal_controller(
    loopcal, example_folder
) -> None:
    line = "compensate run targets.csv --mode commands --steps {} -o commands.csv --force"
    # was some 1e-9 mm
    last = loopcal(line.format(4), "After step 3: at most 0 mm and 0 deg").out
    first = loopcal(line.format(1), "um and", "urad from the best").out
    assert not re.search(r"\de-\d|\b0\.000\d", first + last)  # the unit suits the size
    loopcal(line.format(4))
    table = read_table(example_folder / "commands.csv")
    commanded = [table.numbers(f"commanded.{n}", lc.Dimension.LENGTH) for n in "xyz"]
    commanded += [
        table.numbers(f"commanded.{n}", lc.Dimension.ANGLE) for n in ("roll", "pitch", "yaw")
    ]
    readings = lc.inverse(lc.load_robot("hexapod-42"), np.column_stack(commanded)).q
    calibrated = lc.load_robot("run/robot.yaml")
    wanted = lc.inverse(calibrated, WANTED).T
    np.testing.assert_allclose(lc.forward(calibrated, readings).T, wanted, rtol=0, atol=1e-12)


def test_compensate_without_an_output_file_prints_csv_or_json(loopcal) -> None:
    out = loopcal("compensate run targets.csv").out
    assert out.startswith("pose,q1 [mm],q2 [mm]")
    printed = loopcal("compensate run targets.csv --json")
    assert printed.err == ""
    document = printed.json
    assert document["labels"] == ["home", "left"]
    assert np.shape(document["uncertainty"]["expanded"]) == (2, 6)


def test_compensation_from_a_robot_file_has_no_uncertainty(loopcal) -> None:
    document = loopcal("compensate truth.yaml targets.csv --json").json
    assert document["uncertainty"] is None


def test_target_outside_the_limits_gives_exit_code_2_and_no_reading(
    loopcal, example_folder
) -> None:
    (example_folder / "targets.csv").write_text(TARGETS + UNREACHABLE)
    out = loopcal(
        "compensate run targets.csv",
        "target 'high': outside the machine's limits: stroke of q1",
        code=2,
    ).out
    assert out.split("\n")[3].startswith("high,,,,,,,")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (TARGETS.replace("roll [deg]", "roll"), "targets.csv:1: column 'roll' has no unit"),
        (
            TARGETS.replace("z [mm]", "z [deg]"),
            "targets.csv:1: column 'z': 'deg' is a unit of angle, not of a length",
        ),
        (TARGETS.replace("yaw", "jaw"), "targets.csv:1: no column 'yaw' (did you mean 'jaw'?)"),
        (TARGETS.replace("x [mm]", "X [mm],x [mm]"), "has 8 columns"),
        (TARGETS.replace("0.21e3", ""), "targets.csv:3: column 'z' is empty"),
        (TARGETS.replace("left", "home"), "targets.csv:3: pose 'home' is also row 1"),
        ("pose\n", "has a header but no rows"),
    ],
)
def test_invalid_target_file_is_refused_in_one_sentence(
    loopcal, example_folder, text, sentence
) -> None:
    (example_folder / "targets.csv").write_text(text)
    loopcal("compensate run targets.csv", sentence, code=1)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("compensate nothing targets.csv", "this run folder does not exist"),
        ("compensate run nothing.csv", "nothing.csv: this measurement file does not exist"),
        ("compensate run targets.csv --controller nobody", "nobody"),
        (
            "calibrate hexapod-42 measurements.csv -o new --prior run",
            "Measure again: these data add nothing to the earlier calibration",
        ),
        ("calibrate hexapod-42 measurements.csv -o new --free-limb leg3", "Hint: add --prior RUN"),
        (
            "calibrate hexapod-42 later.csv -o new --prior run --method map",
            "Hint: leave out --method",
        ),
        ("calibrate hexapod-42 later.csv -o new --prior run --free-limb leg9", "no limb 'leg9'"),
    ],
)
def test_invalid_command_line_is_refused_in_one_sentence(
    loopcal, example_folder, later_data, words, sentence
) -> None:
    loopcal(words, sentence, code=1)
    assert not (example_folder / "new").exists()


@pytest.fixture(scope="module")
def later_data(example_folder):
    """Measurements of the same machine on another day."""
    words = "--sigma-position 0.001mm --sigma-angle 5urad --seed 7"
    truth, poses, later = (example_folder / n for n in ("truth.yaml", "poses.csv", "later.csv"))
    main(f"simulate {truth} --poses {poses} {words} -o {later}".split())
    return later


def test_calibrate_with_a_prior_reports_whether_the_freed_limb_changed(
    loopcal, later_data, example_folder
) -> None:
    out = loopcal(
        "calibrate hexapod-42 later.csv -o second --prior run --free-limb leg3 --force"
    ).out
    assert out.startswith("Undecided: hexapod-42")
    result = json.loads((example_folder / "second" / "result.json").read_text())
    assert result["change"]["subject"] == "leg3"
    assert result["change"]["moved"] is False
    assert set(result["made_by"]["inputs"]) == {"robot", "data", "prior"}
    first, second = (
        np.load(example_folder / name / "arrays.npz")["sd"] for name in ("run", "second")
    )
    others = np.delete(np.arange(42), slice(14, 21))
    assert (second[others] < first[others]).all()
