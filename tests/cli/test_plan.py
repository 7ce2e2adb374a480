# SPDX-License-Identifier: Apache-2.0
"""`loopcal plan`: sheet, data file, calibration with the planned held-out poses, refusals."""

import csv
import json

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace

SMALL = ["--poses", "8", "--hold-out", "3", "--candidates", "24", "--kind", "position"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in an empty folder and return it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(command: str) -> int:
    """Run a command line; return its exit code."""
    return main(command.split())


def read_rows(path) -> list[dict[str, str]]:
    """Return the rows of a CSV file, without comment lines."""
    lines = [line for line in path.read_text("utf-8").splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


@pytest.mark.slow
def test_filled_in_plan_is_calibrated_with_its_held_out_poses(folder, capsys):
    assert main(["plan", "linear-delta", "-o", "plan", *SMALL, "--curve"]) == 0
    said = capsys.readouterr().out
    assert "8 poses of linear-delta for calibration and 3 for validation (position)" in said
    assert "Expected errors by number of poses" in said
    assert {p.name for p in (folder / "plan").iterdir()} == {
        "plan.csv", "measurements.csv", "plan.json", "plan.png", "curve.png",
    }  # fmt: skip
    assert (
        run(
            "simulate linear-delta --fill plan/measurements.csv --draw-errors --truth truth.yaml "
            "-o filled.csv"
        )
        == 0
    )
    assert run("calibrate linear-delta filled.csv -o run --limit-position 0.5mm") == 0
    assert "Errors at 3 held-out poses" in capsys.readouterr().out
    plan = json.loads((folder / "plan" / "plan.json").read_text())
    held = [pose["name"] for pose in plan["poses"] if pose["use"] == "held-out"]
    result = json.loads((folder / "run" / "result.json").read_text())
    assert result["split"]["held_out"] == held
    truth, found = load_robot("truth.yaml").values, load_robot("run/robot.yaml").values
    assert np.linalg.norm(found - truth) < 0.3 * np.linalg.norm(
        load_robot("linear-delta").values - truth
    )


@pytest.mark.slow
def test_sheet_states_commands_that_agree_with_the_data_file(folder):
    assert main(["plan", "hexapod-42", "-o", "plan", "--poses", "10", "--candidates", "30"]) == 0
    robot = load_robot("hexapod-42")
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
        inverse(robot, x).q, q, atol=2e-9
    )  # [m], readings are written to a nanometre


@pytest.mark.slow
def test_filled_in_plan_of_planes_and_lines_calibrates_the_robot(folder, capsys):
    ask = "plan hexapod-nategh-agheli -o plan --measure plane-line --groups 9 --points 6 --sigma-position 1um"  # noqa: E501
    assert run(ask) == 0
    assert "determine 33 parameter combinations" in capsys.readouterr().out
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
    assert run("calibrate hexapod-nategh-agheli plan/measurements.csv -o run") == 1
    assert "empty" in capsys.readouterr().err
    # the true machine is moved until its point agrees with what the sheet says to hold: its
    # readings are the data
    robot = load_robot("hexapod-nategh-agheli")
    truth = robot.with_values(sample_truth(robot, 1, 3)[0])
    commanded = [
        pose["commanded"]
        for pose in json.loads((folder / "plan" / "plan.json").read_text())["poses"]
    ]
    q = inverse(truth, np.array([list(pose.values()) for pose in commanded])).q * 1e3
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
    assert load_measurements("filled.csv", robot).n_poses == 54
    assert run("calibrate hexapod-nategh-agheli filled.csv -o run") == 0
    # of these data nine motions of frames are unknown, but none of them changes a distance between
    # places of the tool
    q = sample_workspace(robot, 20, seed=4).solution.q
    places = [forward(one, q).T[:, :3, 3] for one in (truth, robot, load_robot("run/robot.yaml"))]
    true, before, after = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in places)
    assert np.abs(before - true).max() > 1e-4  # [m]
    assert np.abs(after - true).max() < 1e-6  # [m], a thousandth of a millimetre without noise


def test_json_output_agrees_with_the_plan_file(folder, capsys):
    assert main(["plan", "linear-delta", "-o", "plan", *SMALL, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["n_poses"] == 8
    assert document["criterion"] == "I"
    assert document["target"] == "pose"
    assert document["format"] == 1
    assert 0.5 < document["efficiency"] <= 1.0
    assert document["expected"]["after"]["position"] < document["expected"]["before"]["position"]
    written = json.loads((folder / "plan" / "plan.json").read_text())
    assert document.items() <= written.items()


@pytest.mark.slow
def test_earlier_data_file_states_the_instrument_of_a_plan(folder, capsys):
    assert (
        run("simulate linear-delta --draw 12 --kind position --sigma-position 3um -o before.csv")
        == 0
    )
    assert (
        run(
            "plan linear-delta -o plan --poses 3 --candidates 40 --like before.csv --measured "
            "before.csv"
        )
        == 0
    )
    assert (
        "noise: {x: 3 um, y: 3 um, z: 3 um}" in (folder / "plan" / "measurements.csv").read_text()
    )
    assert run("plan linear-delta -o other --poses 3 --like before.csv --kind pose") == 1
    assert "leave out --kind" in capsys.readouterr().err


def test_data_file_with_a_surface_per_group_cannot_state_the_instrument(folder, capsys):
    settings = "# kind: plane\n# unknown: [surface]\n# noise: {gap: 1 um}\npose,group,q1 [mm],q2 [mm],q3 [mm],gap [mm]\n"  # noqa: E501
    for groups, code in ((("a", "b"), 1), (("a", "a"), 0)):
        text = settings + "".join(f"{i},{group},1,1,1,0\n" for i, group in enumerate(groups))
        (folder / "groups.csv").write_text(text)
        assert (
            run(
                "plan linear-delta -o plan --poses 12 --hold-out 0 --candidates 40 --like "
                "groups.csv --force"
            )
            == code
        )
    (folder / "groups.csv").write_text(text.replace("1,a,", "1,b,"))
    assert run("plan linear-delta -o other --like groups.csv") == 1
    assert "plan planes and lines" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--poses 2 --kind component --components z", "plan at least 9 poses"),
        ("--poses 10 --accuracy 20um", "--poses and --accuracy exclude each other"),
        ("--accuracy 20", "unit"),
        ("--accuracy 1nm --kind position --candidates 30", "out of reach"),
        ("--kind posse", "did you mean 'pose'"),
        ("--kind locked", "none of the 9 free parameters of linear-delta"),
        ("--accuracy 10urad --kind position --candidates 30", "does not turn"),
        ("--like robot.yaml", "is a YAML file"),
        ("--accuracy=-5um", "the accuracy goal is -0.005 mm"),
        ("--groups 3", "belong to --measure plane-line"),
        ("--measure plane-line --poses 10", "--poses cannot be combined with --measure plane-line"),
        ("--measure plane-line --poses 0", "--poses cannot be combined with --measure plane-line"),
        (
            "--measure plane-line --hold-out 0",
            "--hold-out cannot be combined with --measure plane-line, where every point is fitted",
        ),
        (
            "--measure plane-line --kind position",
            "--kind cannot be combined with --measure plane-line",
        ),
        (
            "--measure plane-line --components x,y",
            "--components cannot be combined with --measure plane-line",
        ),
        (
            "--measure plane-line --sigma-angle 5urad",
            "--sigma-angle cannot be combined with --measure plane-line",
        ),
        (
            "--measure plane-line --criterion I",
            "--criterion cannot be combined with --measure plane-line",
        ),
        (
            "--measure plane-line --candidates 100",
            "--candidates cannot be combined with --measure plane-line",
        ),
        (
            "--measure plane-line --frames base",
            "--frames cannot be combined with --measure plane-line",
        ),
        ("--measure plane-line --points 3", "give at least 4"),
        ("--min-margin 2", "share of the median"),
        ("--max-tilt -3deg", "angle above 0"),
        ("--seen-from 1m,2m", "give three numbers"),
        ("--cone 20deg", "--seen-from"),
        ("--seen-from 0m,0m,-5m --cone 10deg --candidates 10", "exclude the workspace"),
        ("--like nothing.csv", "does not exist"),
    ],
)
def test_invalid_plan_options_are_refused_and_nothing_is_written(folder, capsys, words, said):
    assert run(f"plan linear-delta -o plan {words}") == 1
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1 + captured.err.count("\nHint: ")
    assert captured.out == ""
    assert not (folder / "plan").exists()


@pytest.mark.slow
def test_force_replaces_a_plan_but_no_other_folder(folder, capsys):
    assert main(["plan", "linear-delta", "-o", "plan", *SMALL]) == 0
    (folder / "plan" / "plan.png").unlink()
    assert main(["plan", "linear-delta", "-o", "plan", *SMALL]) == 1
    assert "--force" in capsys.readouterr().err
    assert main(["plan", "linear-delta", "-o", "plan", *SMALL, "--force"]) == 0
    assert (folder / "plan" / "plan.png").exists()
    (folder / "mine").mkdir()
    for name in ("thesis.txt", "plan.json"):
        (folder / "mine" / name).write_text("{}")
        assert main(["plan", "linear-delta", "-o", "mine", *SMALL, "--force"]) == 1
        assert "something other than a plan" in capsys.readouterr().err


@pytest.mark.slow
def test_force_keeps_measured_values_and_files_of_the_user(folder, capsys):
    again = ["plan", "linear-delta", "-o", "plan", *SMALL, "--force"]
    assert main(again) == 0
    assert main(again) == 0
    data = folder / "plan" / "measurements.csv"
    empty = data.read_text()
    filled = empty.replace(",,,", ",1.5,2.5,3.5", 1)
    data.write_text(filled)
    capsys.readouterr()
    assert main(again) == 1
    said = capsys.readouterr().err
    assert "measurements.csv" in said
    assert "filled in or changed" in said
    assert data.read_text() == filled
    data.write_text(empty)
    (folder / "plan" / "notes.txt").write_text("leg 2 squeaks")
    assert main(again) == 1
    assert "notes.txt" in capsys.readouterr().err
    assert (folder / "plan" / "notes.txt").read_text() == "leg 2 squeaks"
    (folder / "plan" / "notes.txt").unlink()
    document = json.loads((folder / "plan" / "plan.json").read_text())
    del document["files"]  # of a plan that tells nothing of its files, a sheet may be filled in
    (folder / "plan" / "plan.json").write_text(json.dumps(document))
    assert main(again) == 1
    assert data.read_text() == empty


@pytest.mark.slow
def test_second_plan_builds_on_the_measurements_of_the_first(folder, capsys):
    first = [
        "plan",
        "linear-delta",
        "-o",
        "one",
        "--poses",
        "8",
        "--hold-out",
        "4",
        "--candidates",
        "40",
        "--kind",
        "position",
    ]
    assert main(first) == 0
    assert (
        run(
            "plan linear-delta -o two --kind position --poses 2 --candidates 40 --measured "
            "one/measurements.csv"
        )
        == 1
    )
    assert "one/measurements.csv contains no measured value" in capsys.readouterr().err
    fill = "simulate linear-delta --draw-errors --seed 2 --fill {}/measurements.csv -o {}.csv"
    assert run("calibrate linear-delta one/measurements.csv -o run") == 1
    assert "hold no measured value; fill in" in capsys.readouterr().err
    assert run(fill.format("one", "one")) == 0
    capsys.readouterr()
    assert (
        run(
            "plan linear-delta -o two --kind position --poses 2 --hold-out 1 --candidates 40 "
            "--measured one.csv"
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "Next: loopcal calibrate linear-delta one.csv two/measurements.csv -o run" in said
    names = [row["pose"] for row in read_rows(folder / "two" / "measurements.csv")]
    assert names == ["13", "14", "15"]
    # what the first plan promised of its 8 poses; the 4 that it holds out are not counted as known
    promised = json.loads((folder / "one" / "plan.json").read_text())["expected"]["after"][
        "position"
    ]
    known = json.loads((folder / "two" / "plan.json").read_text())["expected"]["before"]["position"]
    assert known == pytest.approx(promised, rel=1e-3)
    assert run(fill.format("two", "two")) == 0
    assert run("calibrate linear-delta one.csv two.csv -o run") == 0
    assert "Errors at 5 held-out poses" in capsys.readouterr().out


def test_data_file_and_sheet_state_the_same_digits(folder):
    assert main(["plan", "hexapod-42", "-o", "plan", "--poses", "10", "--candidates", "30"]) == 0
    sheet = [row for row in read_rows(folder / "plan" / "plan.csv") if row["use"] != "via"]
    data = read_rows(folder / "plan" / "measurements.csv")
    columns = [f"q{i} [mm]" for i in range(1, 7)]
    assert [[row[c] for c in columns] for row in data] == [
        [row[c] for c in columns] for row in sheet
    ]
    cells = [cell for row in sheet for name, cell in row.items() if "[" in name]
    assert all(len(cell) <= 11 for cell in cells)  # sign, point and nine digits
    assert "-0" not in cells


def test_sheet_states_the_coordinates_of_straight_tilt_paths(folder):
    assert (
        main(
            ["plan", "3-prs", "-o", "plan", "--poses", "8", "--hold-out", "0", "--candidates", "30"]
        )
        == 0
    )
    assert (
        "straight in z, theta*cos(phi), theta*sin(phi). Measure"
        in (folder / "plan" / "plan.csv").read_text()
    )


def test_column_use_is_checked_and_excludes_hold_out(folder, capsys):
    assert main(["plan", "linear-delta", "-o", "plan", *SMALL]) == 0
    assert run("simulate linear-delta --fill plan/measurements.csv -o filled.csv") == 0
    assert run("calibrate linear-delta filled.csv -o run --hold-out 0.25") == 1
    assert "leave out --hold-out" in capsys.readouterr().err
    text = (folder / "filled.csv").read_text()
    (folder / "wrong.csv").write_text(text.replace(",held-out,", ",perhaps,", 1))
    assert run("calibrate linear-delta wrong.csv -o run") == 1
    assert "'perhaps'; write fit or held-out" in capsys.readouterr().err
    (folder / "all.csv").write_text(text.replace(",fit,", ",held-out,"))
    assert run("calibrate linear-delta all.csv -o run") == 1
    assert "leave some to fit" in capsys.readouterr().err


def test_plan_takes_the_instrument_from_a_file_without_rows(folder) -> None:
    words = "new linear-delta -o p.yaml --measurements t.csv --kind position --frames base"
    assert run(words) == 0
    words = "plan p.yaml -o plan --like t.csv --poses 6 --hold-out 0 --candidates 40"
    assert run(f"{words} --stroke-margin 5mm") == 0
    assert "# unknown: [frame]" in (folder / "plan" / "measurements.csv").read_text()
