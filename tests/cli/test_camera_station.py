# SPDX-License-Identifier: Apache-2.0
"""The station of a camera, from the plan to pictures and the calibration."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import loopcal as lc
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.data.measurement_file import load_instrument
from loopcal.io.pictures import read_board
from loopcal.measure.kinds.image import Image as ImageKind
from loopcal.measure.simulation import sample_truth
from tests.io.boards import render


def test_options_that_a_camera_does_not_take_are_refused(loopcal):
    loopcal("plan five-bar -o p --measure camera --sigma-position 1um", "takes no", code=1)
    loopcal("plan five-bar -o p --board b.yaml", "--board belongs to --measure camera", code=1)
    loopcal("identifiability five-bar --measure camera --draw 6", "Put the camera at x")


def test_priors_of_the_setup_in_a_sheet_count_in_the_plan_and_stay_in_its_sheet(loopcal, tmp_path):
    """A prior of a known frame lowers the promised error; both once were lost."""
    sheet = (
        "# kind: position\n# unknown: [frame]\n# frame: tracker\n# noise: {'*': 10 um}\n"
        "# unknowns: {'tracker.*': {sd: SD}}\npose,x [mm],y [mm],z [mm]\n"
    ).replace(" {'tracker.*': {sd: SD}}", " {'tracker.?': {sd: 1 um}, 'tracker.r?': {sd: 1 urad}}")
    (tmp_path / "known.csv").write_text(sheet)
    (tmp_path / "open.csv").write_text(
        "\n".join(line for line in sheet.splitlines() if "unknowns" not in line) + "\n"
    )
    words = "--poses 12 --candidates 60 --frame base --json"
    known, without = (
        loopcal(f"plan linear-delta -o {name} --like {name}.csv {words}").json
        for name in ("known", "open")
    )
    assert known["expected"]["after"]["position"] < 0.8 * without["expected"]["after"]["position"]
    included = [
        any(f["code"] == "plan.frames-included" for f in of["findings"]) for of in (known, without)
    ]
    assert included == [True, False]
    text = (tmp_path / "known" / "measurements.csv").read_text("utf-8")
    assert "tracker.x: {sd: 0.001 mm}" in text


def test_prior_of_a_session_is_left_out_and_one_of_nothing_is_refused(loopcal, tmp_path):
    head = "# kind: position\n# unknown: [frame]\n# noise: {'*': 10 um}\n"
    for name, known in (("session", "may.frame.x"), ("wrong", "frame-may.x")):
        text = f"{head}# unknowns: {{{known}: {{sd: 1 mm}}}}\npose,x [mm],y [mm],z [mm]\n"
        (tmp_path / f"{name}.csv").write_text(text)
    words = "plan linear-delta --poses 12 --candidates 40"
    loopcal(f"{words} -o a --like session.csv")
    assert "unknowns" not in (tmp_path / "a" / "measurements.csv").read_text("utf-8")
    loopcal(f"{words} -o b --like wrong.csv", "no setup parameter 'frame-may.x'", code=1)


@pytest.mark.slow
def test_planned_stations_lead_by_rendered_pictures_to_the_true_machine(loopcal):
    """Board, plan, pictures of a machine with errors, corners, calibration: as a user does it."""
    stations = 2
    loopcal("board -o board.yaml --columns 5 --rows 4 --square 30mm")
    board = Path("board.yaml").read_text("utf-8").replace("# measured", "measured")
    Path("board.yaml").write_text(board)
    words = "plan hexapod-42 -o plan --measure camera --board board.yaml --poses 10 --hold-out 5"
    words += f" --candidates 60 --seen-from 0.15m,0.15m,0.75m --stations {stations}"
    loopcal(words, "Put the camera at x 150 mm", "loopcal photos PICTURES")
    assert Path("plan/plan.csv").read_text("utf-8").count(": Put the camera at") == stations
    robot = lc.load_robot("hexapod-42")
    truth = robot.with_values(sample_truth(robot, 1, 8)[0])
    planned = [sensor.kind for sensor in load_instrument("plan/measurements.csv", robot).sensors]
    kinds = {kind.camera: kind for kind in planned if isinstance(kind, ImageKind)}
    assert len(kinds) == len(planned) == stations
    size, shown = (640, 480), read_board("board.yaml")
    lens = np.array([640.0, 641.5, 322.0, 237.0, 0.04, -0.08, 0.0, 0.0, 0.0])
    Path("pictures").mkdir()
    rows = Path("plan/plan.csv").read_text("utf-8").splitlines()
    names = [line.split(",") for line in rows if not line.startswith("##")]
    place, first = names[0].index("pose"), names[0].index("q1 [mm]")
    camera, used = names[0].index("camera"), set()
    turned = make_pose(exp_so3(np.array([0.02, -0.01, 0.03])), np.array([0.004, -0.006, 0.01]))
    for i, row in enumerate(row for row in names[1:] if row[place] != "home"):
        T = lc.forward(truth, 1e-3 * np.array([row[first : first + 6]], dtype=float)).T[0]
        kind = kinds[row[camera]]
        used.add(kind.camera)
        seen = np.linalg.inv(kind.T_camera @ turned) @ T @ kind.T_board
        Image.fromarray(render(shown, seen, lens, size, seed=i)).save(f"pictures/{row[place]}.png")
    assert used == kinds.keys()
    loopcal("photos pictures --board board.yaml --poses plan/poses.csv -o plan/points.csv")
    loopcal("calibrate hexapod-42 plan/points.csv -o run", code=(0, 2))
    fit = lc.load_run("run").result["fit"]
    assert fit["chi_square"] / fit["degrees"] < 0.15  # of the assumed 0.1 px: below 0.04 px
    assert set(lc.load_measurements("plan/points.csv", robot).labels) == {
        r[place] for r in names[1:] if r[place] != "home"
    }
