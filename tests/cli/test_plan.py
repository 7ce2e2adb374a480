# SPDX-License-Identifier: Apache-2.0
"""`loopcal plan`: sheet, data file, calibration with the planned held-out poses, refusals."""

import csv
import json

import numpy as np
import pytest

import loopcal as lc

NO_PLANE_LINE = (
    "--poses 10", "--poses 0", "--hold-out 0", "--kind position", "--components x,y",
    "--sigma-angle 5urad", "--criterion I", "--candidates 100", "--frames base",
)  # fmt: skip
SMALL = "--poses 8 --hold-out 3 --candidates 24 --kind position"


def read_rows(path) -> list[dict[str, str]]:
    """Return the rows of a CSV file, without comment lines."""
    lines = [line for line in path.read_text("utf-8").splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


@pytest.mark.slow
def test_filled_in_plan_is_calibrated_with_its_held_out_poses(loopcal, folder):
    loopcal(
        f"plan linear-delta -o plan {SMALL} --curve",
        "8 poses of linear-delta for calibration and 3 for validation (position)",
        "9 of 10 machines end below these errors over the workspace (rms), by number of poses",
    )
    assert {p.name for p in (folder / "plan").iterdir()} == {
        "plan.csv", "measurements.csv", "plan.json", "plan.png", "curve.png",
    }  # fmt: skip
    loopcal(
        "simulate linear-delta --fill plan/measurements.csv --draw-errors --truth truth.yaml "
        "-o filled.csv"
    )
    loopcal(
        "calibrate linear-delta filled.csv -o run --limit-position 0.5mm",
        "Errors at 3 held-out poses",
    )
    plan = json.loads((folder / "plan" / "plan.json").read_text())
    held = [pose["name"] for pose in plan["poses"] if pose["use"] == "held-out"]
    result = json.loads((folder / "run" / "result.json").read_text())
    assert result["split"]["held_out"] == held
    truth, found = lc.load_robot("truth.yaml").values, lc.load_robot("run/robot.yaml").values
    assert np.linalg.norm(found - truth) < 0.3 * np.linalg.norm(
        lc.load_robot("linear-delta").values - truth
    )


@pytest.mark.slow
def test_sheet_states_commands_that_agree_with_the_data_file(loopcal, folder):
    loopcal("plan hexapod-42 -o plan --poses 10 --candidates 30")
    robot = lc.load_robot("hexapod-42")
    sheet = [row for row in read_rows(folder / "plan" / "plan.csv") if row["use"] != "via"]
    data = read_rows(folder / "plan" / "measurements.csv")
    assert [row["pose"] for row in sheet] == [row["pose"] for row in data]
    assert [row["use"] for row in sheet] == [row["use"] for row in data]
    assert [row["use"] for row in data].count("held-out") == 5  # a verdict needs five
    assert all(row["x [mm]"] == "" for row in data)
    headers = [
        f"{name} [{unit}]"
        for name, unit in zip(robot.controlled, ["mm"] * 3 + ["deg"] * 3, strict=True)
    ]
    x = np.array([[float(row[header]) for header in headers] for row in sheet]) * np.array(
        [1e-3] * 3 + [np.pi / 180.0] * 3
    )
    q = np.array([[float(row[f"q{i} [mm]"]) for i in range(1, 7)] for row in data]) * 1e-3
    np.testing.assert_allclose(
        lc.inverse(robot, x).q, q, atol=2e-9
    )  # [m], readings are written to a nanometre


@pytest.mark.slow
def test_filled_in_plan_of_planes_and_lines_calibrates_the_robot(loopcal, folder):
    ask = "plan hexapod-nategh-agheli -o plan --measure plane-line --groups 9 --points 6 --sigma-position 1um"  # noqa: E501
    loopcal(ask, "determine 33 parameter combinations")
    sheet = read_rows(folder / "plan" / "plan.csv")
    assert [row["role"] for row in sheet[:6]] == ["p0", "p1", "plane", "plane", "plane", "plane"]
    assert {(row["role"] == "p0", row["tolerance [mm]"]) for row in sheet} == {
        (True, ""),
        (False, "0.001"),
    }
    assert {row["hold"].split()[0] for row in sheet if row["role"] == "p0"} == {"free"}
    assert all(
        len(row["hold"].split(" (")[0].split()) == {"p0": 1, "p1": 2, "plane": 1}[row["role"]]
        for row in sheet
    )
    loopcal("calibrate hexapod-nategh-agheli plan/measurements.csv -o run", "empty", code=1)
    # the true machine is moved until its point agrees with what the sheet says to hold: its
    # readings are the data
    robot = lc.load_robot("hexapod-nategh-agheli")
    truth = robot.with_values(lc.sample_truth(robot, 1, 3)[0])
    commanded = [
        pose["commanded"]
        for pose in json.loads((folder / "plan" / "plan.json").read_text())["poses"]
    ]
    q = lc.inverse(truth, np.array([list(pose.values()) for pose in commanded])).q * 1e3
    by_pose = {
        row["pose"]: [f"{value:.12g}" for value in values]
        for row, values in zip(sheet, q, strict=True)
    }
    lines = (folder / "plan" / "measurements.csv").read_text().splitlines()
    filled = [
        ",".join([*(c := line.split(","))[:3], *by_pose[c[0]], *c[9:]])
        if line[0].isdigit()
        else line
        for line in lines
    ]
    (folder / "filled.csv").write_text("\n".join(filled) + "\n")
    assert lc.load_measurements("filled.csv", robot).n_poses == 54
    loopcal("calibrate hexapod-nategh-agheli filled.csv -o run")
    # of these data nine motions of frames are unknown, but none of them changes a distance between
    # places of the tool
    q = lc.sample_workspace(robot, 20, seed=4).solution.q
    places = [
        lc.forward(one, q).T[:, :3, 3] for one in (truth, robot, lc.load_robot("run/robot.yaml"))
    ]
    true, before, after = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in places)
    assert np.abs(before - true).max() > 1e-4  # [m]
    assert np.abs(after - true).max() < 1e-6  # [m], a thousandth of a millimetre without noise


def test_json_output_agrees_with_the_plan_file(loopcal, folder):
    document = loopcal(f"plan linear-delta -o plan {SMALL} --json").json
    assert document["n_poses"] == 8
    assert document["criterion"] == "I"
    assert document["target"] == "pose"
    assert document["format"] == 1
    assert 0.5 < document["efficiency"] <= 1.0
    assert document["expected"]["after"]["position"] < document["expected"]["before"]["position"]


@pytest.mark.slow
def test_earlier_data_file_states_the_instrument_of_a_plan(loopcal, folder):
    loopcal("simulate linear-delta --draw 12 --kind position --sigma-position 3um -o before.csv")
    loopcal(
        "plan linear-delta -o plan --poses 3 --candidates 40 --like before.csv --measured "
        "before.csv"
    )
    assert (
        "noise: {x: 3 um, y: 3 um, z: 3 um}" in (folder / "plan" / "measurements.csv").read_text()
    )
    loopcal(
        "plan linear-delta -o other --poses 3 --like before.csv --kind pose",
        "Leave out --kind",
        code=1,
    )


def test_data_file_with_a_surface_per_group_cannot_state_the_instrument(loopcal, folder):
    settings = "# kind: plane\n# unknown: [surface]\n# noise: {gap: 1 um}\npose,group,q1 [mm],q2 [mm],q3 [mm],gap [mm]\n"  # noqa: E501
    for groups, code in ((("a", "b"), 1), (("a", "a"), 0)):
        text = settings + "".join(f"{i},{group},1,1,1,0\n" for i, group in enumerate(groups))
        (folder / "groups.csv").write_text(text)
        words = "plan linear-delta -o plan --poses 12 --hold-out 0 --candidates 40 --force"
        loopcal(f"{words} --like groups.csv", code=code)
    (folder / "groups.csv").write_text(text.replace("1,a,", "1,b,"))
    loopcal("plan linear-delta -o other --like groups.csv", "Plan planes and lines", code=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--poses 2 --kind component --components z", "Plan at least 9 poses"),
        ("--poses 10 --accuracy 20um", "--poses and --accuracy exclude each other"),
        ("--accuracy 20", "unit"),
        ("--accuracy 1nm --kind position --candidates 30", "out of reach"),
        ("--kind posse", "did you mean 'pose'"),
        ("--kind locked", "none of the 9 free parameters of linear-delta"),
        ("--accuracy 10urad --kind position --candidates 30", "does not turn"),
        ("--like robot.yaml", "is a YAML file"),
        ("--accuracy=-5um", "the accuracy goal is -5 um"),
        ("--groups 3", "belong to --measure plane-line"),
        *(
            (f"--measure plane-line {option}", f"takes no {option.split()[0]}")
            for option in NO_PLANE_LINE
        ),
        ("--measure plane-line --hold-out 0", "because it fits every point"),
        ("--measure plane-line --points 3", "must be at least 4"),
        ("--min-margin 2", "not in the range 0<=x<=1"),
        ("--max-tilt -3deg", "angle above 0"),
        ("--seen-from 1m,2m", "Give three numbers"),
        ("--cone 20deg", "--seen-from"),
        ("--seen-from 0m,0m,-5m --cone 10deg --candidates 10", "exclude the workspace"),
        ("--like nothing.csv", "does not exist"),
    ],
)
def test_invalid_plan_options_are_refused_and_nothing_is_written(loopcal, folder, words, said):
    loopcal(f"plan linear-delta -o plan {words}", said, code=1)
    assert not (folder / "plan").exists()


@pytest.mark.slow
def test_force_replaces_a_plan_but_no_other_folder(loopcal, folder):
    loopcal(f"plan linear-delta -o plan {SMALL}")
    (folder / "plan" / "plan.png").unlink()
    loopcal(f"plan linear-delta -o plan {SMALL}", "--force", code=1)
    loopcal(f"plan linear-delta -o plan {SMALL} --force")
    assert (folder / "plan" / "plan.png").exists()
    (folder / "mine").mkdir()
    for name in ("thesis.txt", "plan.json"):
        (folder / "mine" / name).write_text("{}")
        loopcal(f"plan linear-delta -o mine {SMALL} --force", "something other than a plan", code=1)


@pytest.mark.slow
def test_force_keeps_measured_values_and_files_of_the_user(loopcal, folder):
    again = f"plan linear-delta -o plan {SMALL} --force"
    loopcal(again)
    loopcal(again)
    data = folder / "plan" / "measurements.csv"
    empty = data.read_text()
    filled = empty.replace(",,,", ",1.5,2.5,3.5", 1)
    data.write_text(filled)
    loopcal(again, "measurements.csv", "has changed since", code=1)
    assert data.read_text() == filled
    data.write_text(empty)
    (folder / "plan" / "notes.txt").write_text("leg 2 squeaks")
    loopcal(again, "notes.txt", code=1)
    assert (folder / "plan" / "notes.txt").read_text() == "leg 2 squeaks"
    (folder / "plan" / "notes.txt").unlink()
    document = json.loads((folder / "plan" / "plan.json").read_text())
    del document["files"]  # such a folder is not one that loopcal wrote
    (folder / "plan" / "plan.json").write_text(json.dumps(document))
    loopcal(again, code=1)
    assert data.read_text() == empty


@pytest.mark.slow
def test_second_plan_builds_on_the_measurements_of_the_first(loopcal, folder):
    loopcal("plan linear-delta -o one --poses 8 --hold-out 4 --candidates 40 --kind position")
    loopcal(
        "plan linear-delta -o two --kind position --poses 2 --candidates 40 --measured "
        "one/measurements.csv",
        "one/measurements.csv contains no measured value",
        code=1,
    )
    fill = "simulate linear-delta --draw-errors --seed 2 --fill {}/measurements.csv -o {}.csv"
    loopcal(
        "calibrate linear-delta one/measurements.csv -o run",
        "contain no measured value. Fill in",
        code=1,
    )
    loopcal(fill.format("one", "one"))
    loopcal(
        "plan linear-delta -o two --kind position --poses 2 --hold-out 1 --candidates 40 "
        "--measured one.csv",
        "Next: loopcal calibrate linear-delta one.csv two/measurements.csv -o run",
    )
    names = [row["pose"] for row in read_rows(folder / "two" / "measurements.csv")]
    assert names == ["13", "14", "15"]
    # what the first plan promised of its 8 poses; the 4 that it holds out are not counted as known
    promised = json.loads((folder / "one" / "plan.json").read_text())["expected"]["after"][
        "position"
    ]
    known = json.loads((folder / "two" / "plan.json").read_text())["expected"]["before"]["position"]
    assert known == pytest.approx(promised, rel=1e-3)
    loopcal(fill.format("two", "two"))
    loopcal("calibrate linear-delta one.csv two.csv -o run", "Errors at 5 held-out poses")


def test_data_file_and_sheet_state_the_same_digits(loopcal, folder):
    loopcal("plan hexapod-42 -o plan --poses 10 --candidates 30")
    sheet = [row for row in read_rows(folder / "plan" / "plan.csv") if row["use"] != "via"]
    data = read_rows(folder / "plan" / "measurements.csv")
    columns = [f"q{i} [mm]" for i in range(1, 7)]
    assert [[row[c] for c in columns] for row in data] == [
        [row[c] for c in columns] for row in sheet
    ]
    cells = [cell for row in sheet for name, cell in row.items() if "[" in name]
    assert all(len(cell) <= 11 for cell in cells)  # sign, point and nine digits
    assert "-0" not in cells


def test_sheet_states_the_coordinates_of_straight_tilt_paths(loopcal, folder):
    loopcal("plan 3-prs -o plan --poses 8 --hold-out 0 --candidates 30")
    assert (
        "straight in z, theta*cos(phi), theta*sin(phi). Measure"
        in (folder / "plan" / "plan.csv").read_text()
    )


def test_column_use_is_checked_and_excludes_hold_out(loopcal, folder):
    loopcal(f"plan linear-delta -o plan {SMALL}")
    loopcal("simulate linear-delta --fill plan/measurements.csv -o filled.csv")
    loopcal(
        "calibrate linear-delta filled.csv -o run --hold-out 0.25", "leave out --hold-out", code=1
    )
    text = (folder / "filled.csv").read_text()
    (folder / "wrong.csv").write_text(text.replace(",held-out,", ",perhaps,", 1))
    loopcal("calibrate linear-delta wrong.csv -o run", "'perhaps'. Write fit or held-out", code=1)
    (folder / "all.csv").write_text(text.replace(",fit,", ",held-out,"))
    loopcal("calibrate linear-delta all.csv -o run", "Leave some to fit", code=1)


def test_plan_takes_the_instrument_from_a_file_without_rows(loopcal, folder) -> None:
    words = "new linear-delta -o p.yaml --measurements t.csv --kind position --frames base"
    loopcal(words)
    words = "plan p.yaml -o plan --like t.csv --poses 6 --hold-out 0 --candidates 40"
    loopcal(f"{words} --stroke-margin 5mm")
    assert "# unknown: [frame]" in (folder / "plan" / "measurements.csv").read_text()


def test_rounding_is_no_error_of_the_orientation(loopcal, folder) -> None:
    """A delta turns its platform by 1e-16 degrees, which is none."""
    words = "plan linear-delta -o heights --kind component --components z --poses 10"
    said = loopcal(f"{words} --candidates 40").words
    assert "mm before calibration" in said
    assert " deg " not in said
