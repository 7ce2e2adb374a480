# SPDX-License-Identifier: Apache-2.0
"""Convention checks on the command line, and setup frames that `validate` takes from a run."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.robot.robot_file import list_shipped_robots


def write_simulated_data(path, kind, n=9, seed=0, change=None, unknowns=None):
    """Write simulated measurements of a hexapod within its spreads."""
    robot = lc.load_robot("hexapod-42")
    truth = robot.with_values(
        robot.values + 0.03e-3 * np.random.default_rng(0).standard_normal(len(robot.values))
    )
    instrument = lc.Instrument((lc.Sensor(kind, lc.Gaussian(np.array([5e-6] * 3 + [1e-6] * 3))),))
    poses = lc.sample_workspace(robot, n, seed + 1).coordinates
    lc.save_measurements(
        lc.simulate(truth, poses, instrument, seed, controller=robot, nuisance_values=unknowns),
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
        write_simulated_data(data, lc.Pose(unknown=("frame",)), 20, 0, unknowns=PLACED)
        assert main(["calibrate", "hexapod-42", "data.csv", "-o", "run"]) == 0
    return folder


def read_codes(printed) -> set[str]:
    """Return the codes of the findings in a JSON document."""
    return {finding["code"] for finding in printed.json["findings"]}


def state_lengths_in_meters(text: str) -> str:
    return text.replace("x [mm]", "x [m]").replace("y [mm]", "y [m]").replace("z [mm]", "z [m]")


def test_wrong_length_unit_is_refused_without_allow_implausible(loopcal, folder) -> None:
    robot = write_simulated_data(folder / "data.csv", lc.Pose(), change=state_lengths_in_meters)
    for command in ("calibrate hexapod-42 data.csv -o run", "identifiability hexapod-42 data.csv"):
        said = ("lengths 1000 times smaller", "--allow-implausible")
        assert loopcal(command, *said, code=1).err.startswith("loopcal: data.csv: ")
    assert not (folder / "run").exists()
    loopcal("identifiability hexapod-42 data.csv --allow-implausible")
    with pytest.raises(lc.DataError) as error:
        lc.calibrate(robot, lc.load_measurements(folder / "data.csv", robot))
    assert error.value.code == "conventions.other-interpretation"
    assert "data.csv: " in str(error.value)
    loopcal("calibrate hexapod-42 data.csv -o run --allow-implausible", code=(0, 2))


def test_target_that_never_moves_is_refused_without_allow_still(loopcal, folder) -> None:

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

    write_simulated_data(folder / "data.csv", lc.Pose(), change=freeze_target)
    loopcal(
        "calibrate hexapod-42 data.csv -o run",
        "'pose' of kind 'pose' never moves: its readings stay within 0",
        "--allow-still",
        code=1,
    )
    loopcal("identifiability hexapod-42 data.csv --allow-still --allow-implausible")


def test_validate_uses_the_frame_estimated_by_the_run(loopcal, folder, placed_run) -> None:
    shutil.copytree(placed_run, folder, dirs_exist_ok=True)
    write_simulated_data(folder / "more.csv", lc.Pose(unknown=("frame",)), 6, 1, unknowns=PLACED)
    assert read_codes(loopcal("validate run more.csv --json")) == {"validation.setup-kept"}
    assert read_codes(loopcal("validate run more.csv --refit frame --json")) == {
        "validation.setup-fitted"
    }
    loopcal(
        "validate run more.csv --refit tracker",
        "has the name 'tracker'; the data have: frame",
        code=1,
    )


def test_frame_moved_since_the_fit_is_reported_and_kept_for_both_errors(
    loopcal, folder, placed_run
) -> None:
    shutil.copytree(placed_run, folder, dirs_exist_ok=True)
    write_simulated_data(
        folder / "moved.csv",
        lc.Pose(unknown=("frame",)),
        6,
        1,
        unknowns=PLACED | {"frame.x": 0.105},
    )
    write_simulated_data(
        folder / "one.csv", lc.Pose(unknown=("frame",)), 1, 1, unknowns=PLACED | {"frame.x": 0.105}
    )
    loopcal("validate run moved.csv", "kept from the fit", "Hint: use --refit frame")
    assert MOVED in read_codes(loopcal("validate run moved.csv --json"))
    loopcal("validate run moved.csv --refit frame", "times smaller after calibration")
    assert MOVED not in read_codes(loopcal("validate run moved.csv --refit frame --json"))
    # one pose cannot show it: six numbers, six unknowns
    assert MOVED not in read_codes(loopcal("validate run one.csv --json"))


def test_prior_or_fixed_value_that_contradicts_the_data_is_refused_by_name(
    loopcal, folder, placed_run
) -> None:
    shutil.copytree(placed_run, folder, dirs_exist_ok=True)
    text = (folder / "data.csv").read_text()

    def state(statement: str, *said: str, code: int = 0) -> str:
        (folder / "stated.csv").write_text(f"# unknowns: {{{statement}}}\n{text}")
        return loopcal("identifiability hexapod-42 stated.csv", *said, code=code).err

    for statement, shown in (
        (
            "frame.x: {start: 1500 mm, sd: 1 mm}, frame.y: {start: 0 mm, sd: 1 mm}",
            "not at 1500 mm (sd 1 mm)",
        ),
        ("frame.x: fixed", "not at 0 mm (fixed)"),
    ):
        err = state(statement, "frame.x at ", shown, "--allow-implausible", code=1)
        assert err.startswith("loopcal: stated.csv: ")
    state("frame.x: {start: 101 mm, sd: 1 mm}")
    # noted: a robot far off its spreads shows the same
    state("frame.x: {start: 105 mm, sd: 10 um}", "note: stated.csv: ", "frame.x at 100")


FIRST_CALIBRATIONS = [
    ("tower1.angle", np.deg2rad(2.0)),
    ("tower2.stop", 5e-3),
    ("tower1.stop", -8e-3),
    ("radius", 5e-3),
    ("radius", -8e-3),
]


@pytest.mark.parametrize(("parameter", "error"), FIRST_CALIBRATIONS)
def test_first_calibration_of_a_printer_with_probed_heights_is_not_refused(
    loopcal, folder, parameter, error
) -> None:
    """The firmware stops at the bed, so all heights are 0; the given geometry moves the nozzle by
    up to 8 mm.
    """
    robot = lc.load_robot("linear-delta")
    values = robot.values.copy()
    values[robot.parameters.names.index(parameter)] += error
    truth = robot.with_values(values)
    angle = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    rings = [0.09 * np.column_stack([np.cos(a), np.sin(a)]) for a in (angle, 2.0 * angle + 0.3)]
    points = np.concatenate([rings[0], 0.5 * rings[1], np.zeros((1, 2))])
    probe = lc.Instrument((lc.Sensor(lc.Component(("z",)), lc.Gaussian(np.array([2e-5]))),))
    bed = np.column_stack([points, np.zeros(len(points))])
    data = lc.simulate(truth, bed, probe, 0, controller=truth)
    lc.save_measurements(data, folder / "data.csv", robot)
    text = list_shipped_robots()["linear-delta"].read_text()
    (folder / "printer.yaml").write_text(f"{text}fixed: [arm*.length]\n")
    out = loopcal("calibrate printer.yaml data.csv -o run --json").out
    for row in json.loads(out)["fit"]["parameters"]:
        true = float(values[robot.parameters.names.index(row["name"])])
        true = true * 1e3 if row["unit"] == "mm" else float(np.rad2deg(true))
        assert abs(row["estimate"] - true) < 2.0 * row["plus_minus"], row["name"]
