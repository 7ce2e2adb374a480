# SPDX-License-Identifier: Apache-2.0
"""Planes and lines from the plan to the calibrated robot, as docs/planning.md describes."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal import geometry
from loopcal.cli.entry_point import main

ROBOT = "hexapod-nategh-agheli"


def orientation_error(robot: lc.Mechanism, truth: lc.Mechanism) -> float:
    """Return the root mean square error [deg] over the workspace."""
    nominal = robot.nominal
    q = lc.inverse(nominal, lc.sample_workspace(nominal, 50, 3).coordinates).q
    R, true = lc.forward(robot, q).T[:, :3, :3], lc.forward(truth, q).T[:, :3, :3]
    angles = geometry.log_so3(np.swapaxes(R, 1, 2) @ true)
    return float(np.degrees(np.sqrt((angles**2).sum(axis=1).mean())))


def read_commands(root: Path) -> list[str]:
    """Return the commands of the page: plan, fill, calibrate and identifiability."""
    page = (root / "docs" / "planning.md").read_text("utf-8")
    return re.findall(rf"^loopcal (.*{ROBOT}.*)$", page, re.MULTILINE)


@pytest.fixture(scope="module")
def planned(tmp_path_factory, root) -> Path:
    """Folder with the plan of the page, which is made once."""
    folder = tmp_path_factory.mktemp("planned")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(read_commands(root)[0].split()) == 0
    return folder


@pytest.mark.slow
def test_commands_of_the_page_report_rank_33_from_plan_to_calibration(
    loopcal, folder, planned, root
):
    _, fill, calibrate, identify = read_commands(root)
    shutil.copytree(planned / "plan-cmm", "plan-cmm")
    assert json.loads(Path("plan-cmm/plan.json").read_text())["rank"] == 33
    loopcal(f"{fill} --truth truth.yaml")
    loopcal(calibrate)
    assert loopcal(f"{identify} --json").json["rank"] == 33
    result = json.loads((folder / "run" / "result.json").read_text())
    assert result["fit"]["rank"] == 33
    truth, nominal = lc.load_robot("truth.yaml"), lc.load_robot(ROBOT)
    before, after = (
        orientation_error(r, truth) for r in (nominal, lc.load_robot("run/robot.yaml"))
    )
    assert after < 0.5 * before
    # least squares, too, does not move along rotations of the base: it was 0.6 times before at one
    # seed, 2 times at another
    loopcal(calibrate.replace("-o run", "--method ls -o squares"))
    fit = json.loads(Path("squares/result.json").read_text())["fit"]
    # 81 rows less 45 coordinates of nine planes and lines
    assert (fit["rank"], fit["degrees"]) == (33, 36 - 33)
    assert orientation_error(lc.load_robot("squares/robot.yaml"), truth) < 0.5 * before


@pytest.mark.slow
def test_plan_with_fewer_equations_than_directions_says_so(loopcal):
    ask = f"plan {ROBOT} -o plan --measure plane-line --groups 6 --points 6"
    document = loopcal(f"{ask} --json").json
    assert (document["rank"], document["possible_rank"]) == (24, 33)
    assert "plan.few-groups" in [finding["code"] for finding in document["findings"]]
    assert document["sd_last"] < document["sd_first"]
    fill = f"simulate {ROBOT} --fill plan/measurements.csv --draw-errors"
    loopcal(f"{fill} -o filled.csv")
    robot = lc.load_robot(ROBOT)
    assert lc.identify(robot, lc.load_measurements("filled.csv", robot)).rank == 24


def test_a_sheet_without_readings_needs_its_plan(loopcal, planned):
    shutil.copy(planned / "plan-cmm" / "measurements.csv", "sheet.csv")
    message = "this sheet has no readings, and its folder lacks plan.csv"
    loopcal(f"simulate {ROBOT} --fill sheet.csv -o filled.csv", message, code=1)
