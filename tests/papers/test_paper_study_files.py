# SPDX-License-Identifier: Apache-2.0
"""The study files of the papers: their levels are those of the papers, and other robots fit."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.cli.entry_point import main
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.measure.instrument import make_random_stream
from loopcal.papers.cmm_constraint_2011 import results as cmm
from loopcal.papers.hexapod_42 import results as hexapod
from loopcal.papers.paper import PAPERS
from loopcal.papers.tsvd_2016 import steps as tsvd
from loopcal.studies.files.study_file import load_study
from loopcal.studies.simulation.block import (
    OUTCOMES,
    calibrate_cells,
    find_cells,
    list_tasks,
    make_stream,
    set_size,
)
from loopcal.studies.simulation.published_steps import (
    Layout,
    PaperRows,
    identify_from_rows,
    penalize_ridge,
    penalize_truncated,
)
from loopcal.studies.specification import PosesLevel
from loopcal.studies.study_result import StudyResult

MM = 1e-3


def test_the_grid_of_cmm_constraint_has_the_printed_sets_and_noises():
    study = PAPERS["cmm-constraint-2011"].load_study()
    sets, noises = (cmm.PRINTED.find(key).split() for key in ("sets", "noises"))
    assert [f"set {given}" for given in sets] == list(study.errors)
    assert [level.tolerance_factor for level in study.errors.values()] == list(map(float, sets))
    for given in noises:
        assert study.instruments[f"{given} mm"].sigma_position == pytest.approx(float(given) * MM)
    few = {"points": PosesLevel(10, "plane-line", groups=1, sweeps=0)}
    quick = replace(set_size(study, 0, 2), poses=few)
    (cell,) = calibrate_cells(quick, find_cells(study, errors="set 1", method="MAP")[:1])
    assert_allclose(cell.robot.parameters.tolerance, MM)  # sets are standard deviations in mm


def test_cells_of_cmm_constraint_are_the_equations_of_the_paper():
    study = set_size(PAPERS["cmm-constraint-2011"].load_study(), 3, 2)
    study = replace(study, poses={"points": replace(study.poses["100 points"], sweeps=0)})
    numbers = find_cells(study, errors="set 1", instrument="0.01 mm")
    points = np.array(json.loads(next(list_tasks(study, [0])).content)["measured"])
    stream = make_stream(3, 0)
    noise = np.stack([make_random_stream(stream, i).standard_normal((100, 3)) for i in range(2)])
    for cell in calibrate_cells(study, numbers):
        layout = Layout(cell.robot, points.reshape(10, 10, 6))
        rows = PaperRows(layout, layout.hold_points(cell.truth, 1e-5 * noise)[1], MM, 1e-5)
        method = {"LS": LeastSquares(), "MAP": MAP()}[cell.levels["method"]]
        by_hand = identify_from_rows(rows, method)
        assert_allclose(cell.values, rows.values(by_hand.deviation), rtol=0, atol=1e-12)


def test_the_noise_study_has_the_errors_and_poses_of_the_tables():
    study, setup = PAPERS["hexapod-42"].load_study(), hexapod.make_setup()
    (poses,) = study.poses.values()
    assert_allclose(poses.coordinates, setup.poses, atol=1e-15)
    for errors in (study, setup.study):
        (cell,) = calibrate_cells(set_size(errors, 0, 2), find_cells(errors, method="MAP")[:1])
        assert_allclose(cell.truth, np.tile(setup.truth.values, (2, 1)), rtol=0, atol=1e-15)
    limits = hexapod.list_noises()
    assert len(study.instruments) == len(limits) == 8
    for name, (length, angle) in limits.items():
        level, made = study.instruments[f"{length:g} mm and {angle:g} rad"], setup.study
        sigmas = level.sigma_position, level.sigma_angle  # of nine digits
        exact = (np.array([length * MM, angle]) / np.sqrt(3.0)).tolist()
        assert sigmas == pytest.approx(exact, rel=1e-8)
        exactly = replace(level, sigma_position=exact[0], sigma_angle=exact[1])
        assert made.instruments[name] == exactly
    assert {hexapod.PER_LEG, hexapod.TOGETHER, hexapod.PRIOR} == set(study.methods)
    assert study.methods[hexapod.PER_LEG].steps == int(hexapod.PRINTED.find("iterations", "value"))


@pytest.mark.parametrize("name", tsvd.ROBOTS)
def test_the_sweeps_have_the_settings_and_poses_of_the_reproduction(name):
    study, robot = PAPERS["tsvd-2016"].load_study(tsvd.ROBOTS[name]), tsvd.load_design(name).robot
    p = len(robot.parameters)
    (poses,) = study.poses.values()
    assert (poses.count, poses.choice) == (len(tsvd.read_noise()), "tilts")
    keeps = [level.keep for level in study.methods.values() if level.keep is not None]
    assert keeps == list(range(p - 1, 0, -1))
    raw = [level for level in study.methods.values() if level.rows == "raw" and level.lam]
    lambdas = np.array([level.lam for level in raw], dtype=float)
    assert_allclose(lambdas, np.tile(tsvd.list_lambdas(), 2))
    assert {level.steps for level in raw} == {None, tsvd.SIZES.find("short")}
    for level in study.instruments.values():
        assert np.sqrt(3.0) * level.sigma_position == pytest.approx(tsvd.list_limits()[0])
        assert np.sqrt(3.0) * level.sigma_angle == pytest.approx(tsvd.list_limits()[3])
    assert study.instruments["5-DOF"].unused == ("psi",)


def test_cells_of_a_sweep_are_the_batch_of_settings_of_the_reproduction():
    """The reproduction runs all settings of a machine as one batch, which is faster."""
    study = set_size(PAPERS["tsvd-2016"].load_study("3-prs"), 1, 2)
    settings = {"TSVD 22": penalize_truncated(np.array([22]), 33),
                "RE 1e-3": penalize_ridge(np.array([1e-3]), 33)}  # fmt: skip
    for instrument in study.instruments:
        for method, penalty in settings.items():
            numbers = find_cells(study, instrument=instrument, method=method)
            (cell,) = calibrate_cells(study, numbers)
            measured = tsvd.measure_machines(tsvd.load_design("3-PRS"), cell.truth)
            trials = replace(measured.trials, measured=cell.measured)
            run = tsvd.iterate(replace(measured, trials=trials), penalty, np.arange(2))
            step = np.abs(run.values - measured.robot.values).max()
            assert_allclose(cell.values, run.values, rtol=0, atol=1e-6 * step)
            assert abs(cell.iterations - run.count).max() <= 1


@pytest.mark.parametrize(
    ("paper", "robot", "replaced", "cell"),
    [
        (
            "cmm-constraint-2011",
            "hexapod-octahedral",
            (),
            {"errors": "1 tolerance", "method": "MAP"},
        ),
        (
            "hexapod-42",
            "hexapod-nategh-agheli",
            (
                "10 poses come from the workspace",
                "drawn errors with standard deviations of 1 mm in place of one machine",
            ),
            {"method": "per leg"},
        ),
        (
            "tsvd-2016",
            "linear-delta-6",
            (
                "The robot is linear-delta-6 in place of 3-prs",
                "36 poses come",
                "in place of 0.076 mm and 0.022 deg of 3-prs",
            ),
            {"method": "TSVD 14"},
        ),
        (
            "tsvd-2016",
            "3-rps",
            ("TSVD 32 to TSVD 27 are left out", "rings of equal tilt"),
            {"method": "TSVD 26"},
        ),
        (
            "tsvd-2016",
            "five-bar",
            ("36 poses come", "instruments 3-DOF take the place of 6-DOF and 5-DOF"),
            {"method": "TSVD 4"},
        ),
    ],
)
def test_another_robot_replaces_that_of_a_paper(tmp_path, capsys, paper, robot, replaced, cell):
    path = tmp_path / "study.yaml"
    assert main(["study", "new", str(path), "--paper", paper, "--robot", robot]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert all(sentence in printed for sentence in replaced)
    study = set_size(load_study(path), 0, 2)
    if paper == "cmm-constraint-2011":
        study = replace(study, poses={"p": replace(study.poses["100 points"], sweeps=0)})
    assert list(study.robots) == [robot]
    numbers = find_cells(study, **cell)[-1:]
    (made,) = calibrate_cells(study, numbers)
    assert made.is_converged.all(), [OUTCOMES[code] for code in made.outcome]
    assert np.abs(made.values - made.robot.values).max() > 0.0


@pytest.mark.parametrize("paper", PAPERS)
def test_the_study_of_a_paper_is_written_with_its_poses_and_read(tmp_path, paper):
    path = tmp_path / "my study.yaml"
    assert main(["study", "new", str(path), "--paper", paper]) == 0
    study = load_study(path)
    assert [robot.source for robot in study.robots.values()] == [PAPERS[paper].robots[0]]
    assert main(["study", "new", str(path), "--paper", paper]) == 1  # not without --force
    assert main(["study", "new", str(path), "--paper", paper, "--force"]) == 0


def test_a_paper_study_runs_and_is_summarized(tmp_path):
    path, folder = tmp_path / "study.yaml", tmp_path / "results"
    words = ["study", "new", str(path), "--paper", "hexapod-42", "--robot", "hexapod-octahedral"]
    assert main(words) == 0
    text = path.read_text("utf-8")
    head, rest = text.split("instruments:")
    keys = rest[rest.index("\n# The") :] if "\n# The" in rest else rest[rest.index("\nposes") :]
    path.write_text(f"{head}instruments: {{i: {{kinds: [pose]}}}}\n{keys}", "utf-8")
    assert main(["study", "run", str(path), "-o", str(folder), "--quick", "--workers", "1"]) == 0
    (per_leg, *_) = StudyResult(folder).summarize().cells
    assert per_leg.trials == 5


@pytest.mark.slow
def test_errors_in_both_frames_are_summarized(tmp_path, capsys):
    path, folder = tmp_path / "study.yaml", tmp_path / "results"
    assert main(["study", "new", str(path), "--paper", "cmm-constraint-2011"]) == 0
    text = (
        path.read_text("utf-8")
        .replace("sweeps: 3", "sweeps: 0")
        .replace("held_out: 100", "held_out: 5")
    )
    one = "{kinds: [plane, line], sigma_position: 0.01 mm}"
    small = f"quick: {{errors: {{s: 1}}, instruments: {{one: {one}}}, replicates: 2,"
    text = text.replace("quick: {replicates: 5,", small)
    path.write_text(text, "utf-8")
    assert main(["study", "run", str(path), "-o", str(folder), "--quick", "--workers", "1"]) == 0
    capsys.readouterr()
    assert main(["study", "summary", str(folder)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "are in the base frame" in printed
    cell = StudyResult(folder).summarize().cells[0]
    fitted, base = (cell.find_score(name) for name in ("position", "position_base"))
    assert fitted is not None
    assert base is not None
    assert fitted.median is not None
    assert base.median is not None
    assert fitted.median.value < base.median.value


def test_an_unknown_robot_or_paper_is_refused(tmp_path, capsys):
    path = str(tmp_path / "study.yaml")
    assert main(["study", "new", path, "--paper", "hexapod"]) == 1
    assert "hexapod-42" in capsys.readouterr().err
    assert main(["study", "new", path, "--paper", "hexapod-42", "--robot", "nobody"]) == 1
    assert "nobody" in capsys.readouterr().err
    words = ["study", "new", path, "--paper", "cmm-constraint-2011", "--robot", "3-prs"]
    assert main(words) == 1  # before anything is written
    assert "3-prs does not control x and y" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "study.yaml").exists()
