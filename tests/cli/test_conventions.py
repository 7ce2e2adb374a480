# SPDX-License-Identifier: Apache-2.0
"""Convention checks on the command line, and setup frames that `validate` takes from a run."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from loopcal.apply.calibration import calibrate
from loopcal.cli.entry_point import main
from loopcal.errors import DataError
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.data.measurement_writer import save_measurements
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace


@pytest.fixture
def folder_and_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(words: str) -> tuple[int, str, str]:
        code = main(words.split())
        out, err = capsys.readouterr()
        return code, out, err

    return tmp_path, run


def write_simulated_data(path, kind, n=9, seed=0, change=None, unknowns=None):
    """Write simulated measurements of a hexapod within its tolerances."""
    robot = load_robot("hexapod-42")
    truth = robot.with_values(
        robot.values + 0.03e-3 * np.random.default_rng(0).standard_normal(len(robot.values))
    )
    instrument = Instrument((Sensor(kind, Gaussian(np.array([5e-6] * 3 + [1e-6] * 3))),))
    poses = sample_workspace(robot, n, seed + 1).coordinates
    save_measurements(
        simulate(truth, poses, instrument, seed, controller=robot, nuisance_values=unknowns),
        path,
        robot,
    )
    if change is not None:
        path.write_text(change(path.read_text()))
    return robot


MOVED = "validation.setup-moved"
PLACED = {"frame.x": 0.1, "frame.rz": 0.5}


@pytest.fixture(scope="module")
def placed_run(tmp_path_factory) -> Path:
    """Return a folder with measurements in an unknown frame and their calibration."""
    folder = tmp_path_factory.mktemp("placed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        data = Path("data.csv")
        write_simulated_data(data, Pose(unknown=("frame",)), 20, 0, unknowns=PLACED)
        assert main(["calibrate", "hexapod-42", "data.csv", "-o", "run"]) == 0
    return folder


def read_codes(result: tuple[int, str, str]) -> set[str]:
    """Return the codes of the findings in a JSON document of a command that succeeded."""
    code, out, _ = result
    assert code == 0
    return {finding["code"] for finding in json.loads(out)["findings"]}


def state_lengths_in_meters(text: str) -> str:
    return text.replace("x [mm]", "x [m]").replace("y [mm]", "y [m]").replace("z [mm]", "z [m]")


def test_wrong_length_unit_is_refused_without_allow_implausible(folder_and_run) -> None:
    folder, run = folder_and_run
    robot = write_simulated_data(folder / "data.csv", Pose(), change=state_lengths_in_meters)
    for command in ("calibrate hexapod-42 data.csv -o run", "identifiability hexapod-42 data.csv"):
        code, out, err = run(command)
        assert (code, out) == (1, "")
        assert err.startswith("loopcal: data.csv: ")
        assert "lengths 1000 times smaller" in err
        assert "--allow-implausible" in err
    assert not (folder / "run").exists()
    assert run("identifiability hexapod-42 data.csv --allow-implausible")[0] == 0
    with pytest.raises(DataError) as error:
        calibrate(robot, load_measurements(folder / "data.csv", robot))
    assert error.value.code == "conventions.other-interpretation"
    assert "data.csv: " in str(error.value)
    assert run("calibrate hexapod-42 data.csv -o run --allow-implausible")[0] in {0, 2}


def test_target_that_never_moves_is_refused_without_allow_still(folder_and_run) -> None:
    folder, run = folder_and_run

    def freeze_target(text: str) -> str:
        lines = text.splitlines()
        first = next(i for i, line in enumerate(lines) if line.startswith("pose,")) + 1
        tail = lines[first].split(",")[7:]
        return (
            "\n".join(
                [
                    *lines[:first],
                    *(",".join([*line.split(",")[:7], *tail]) for line in lines[first:]),
                ]
            )
            + "\n"
        )

    write_simulated_data(folder / "data.csv", Pose(), change=freeze_target)
    code, out, err = run("calibrate hexapod-42 data.csv -o run")
    assert (code, out) == (1, "")
    assert "'pose' of kind 'pose' never moves: its readings stay within 0" in err
    assert "--allow-still" in err
    assert run("identifiability hexapod-42 data.csv --allow-still --allow-implausible")[0] == 0


def test_validate_uses_the_frame_estimated_by_the_run(folder_and_run, placed_run) -> None:
    folder, run = folder_and_run
    shutil.copytree(placed_run, folder, dirs_exist_ok=True)
    write_simulated_data(folder / "more.csv", Pose(unknown=("frame",)), 6, 1, unknowns=PLACED)
    assert read_codes(run("validate run more.csv --json")) == {"validation.setup-kept"}
    assert read_codes(run("validate run more.csv --refit frame --json")) == {
        "validation.setup-fitted"
    }
    code, _, err = run("validate run more.csv --refit tracker")
    assert code == 1
    assert "is called 'tracker'; the data have: frame" in err


def test_frame_moved_since_the_fit_is_reported_and_kept_for_both_errors(
    folder_and_run, placed_run
) -> None:
    folder, run = folder_and_run
    shutil.copytree(placed_run, folder, dirs_exist_ok=True)
    write_simulated_data(
        folder / "moved.csv", Pose(unknown=("frame",)), 6, 1, unknowns=PLACED | {"frame.x": 0.105}
    )
    write_simulated_data(
        folder / "one.csv", Pose(unknown=("frame",)), 1, 1, unknowns=PLACED | {"frame.x": 0.105}
    )
    code, out, _ = run("validate run moved.csv")
    assert code == 0
    assert "Position error (rms): the same" in out  # 5 mm of the frame in both
    assert "Hint: use --refit frame" in out
    assert MOVED in read_codes(run("validate run moved.csv --json"))
    code, out, _ = run("validate run moved.csv --refit frame")
    assert code == 0
    assert "times smaller after calibration" in out
    assert MOVED not in read_codes(run("validate run moved.csv --refit frame --json"))
    # one pose cannot show it: six numbers, six unknowns
    assert MOVED not in read_codes(run("validate run one.csv --json"))


def test_prior_or_fixed_value_that_contradicts_the_data_is_refused_by_name(
    folder_and_run, placed_run
) -> None:
    folder, run = folder_and_run
    shutil.copytree(placed_run, folder, dirs_exist_ok=True)
    text = (folder / "data.csv").read_text()

    def run_with_statement(statement: str) -> tuple[int, str, str]:
        (folder / "stated.csv").write_text(f"# unknowns: {{{statement}}}\n{text}")
        return run("identifiability hexapod-42 stated.csv")

    for statement, shown in (
        (
            "frame.x: {start: 1500 mm, sd: 1 mm}, frame.y: {start: 0 mm, sd: 1 mm}",
            "not at 1500 mm (sd 1 mm)",
        ),
        ("frame.x: fixed", "not at 0 mm (fixed)"),
    ):
        code, out, err = run_with_statement(statement)
        assert (code, out) == (1, "")
        assert err.startswith("loopcal: stated.csv: ")
        assert "frame.x at " in err
        assert shown in " ".join(err.split())
        assert "--allow-implausible" in err
    assert run_with_statement("frame.x: {start: 101 mm, sd: 1 mm}")[0] == 0
    code, out, err = run_with_statement(
        "frame.x: {start: 105 mm, sd: 10 um}"
    )  # noted: a robot far off its tolerances shows the same
    assert code == 0
    assert "note: stated.csv: " in err
    assert "frame.x at 100" in " ".join(err.split())


FIRST_CALIBRATIONS = [
    ("tower1.angle", np.deg2rad(2.0)),
    ("tower2.stop", 5e-3),
    ("tower1.stop", -8e-3),
    ("radius", 5e-3),
    ("radius", -8e-3),
]


@pytest.mark.parametrize(("parameter", "error"), FIRST_CALIBRATIONS)
def test_first_calibration_of_a_printer_with_probed_heights_is_not_refused(
    folder_and_run, parameter, error
) -> None:
    """The firmware stops at the bed, so all heights are 0; the given geometry moves the nozzle by
    up to 8 mm.
    """
    folder, run = folder_and_run
    robot = load_robot("linear-delta")
    values = robot.values.copy()
    values[robot.parameters.names.index(parameter)] += error
    truth = robot.with_values(values)
    angle = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    rings = [0.09 * np.column_stack([np.cos(a), np.sin(a)]) for a in (angle, 2.0 * angle + 0.3)]
    points = np.concatenate([rings[0], 0.5 * rings[1], np.zeros((1, 2))])
    probe = Instrument((Sensor(Component(("z",)), Gaussian(np.array([2e-5]))),))
    bed = np.column_stack([points, np.zeros(len(points))])
    data = simulate(truth, bed, probe, 0, controller=truth)
    save_measurements(data, folder / "data.csv", robot)
    text = list_shipped_robots()["linear-delta"].read_text()
    (folder / "printer.yaml").write_text(f"{text}fixed: [arm*.length]\n")
    code, out, err = run("calibrate printer.yaml data.csv -o run --json")
    assert code == 0, err
    for row in json.loads(out)["fit"]["parameters"]:
        true = float(values[robot.parameters.names.index(row["name"])])
        true = true * 1e3 if row["unit"] == "mm" else float(np.rad2deg(true))
        assert abs(row["estimate"] - true) < 2.0 * row["plus_minus"], row["name"]
