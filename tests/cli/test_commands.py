# SPDX-License-Identifier: Apache-2.0
"""simulate, calibrate, validate, identifiability and check on shipped robots."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.io.robot.robot_file import find_robot_file, list_shipped_robots
from tests.zoo import FEW_ROBOTS

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"
CALIBRATE = "calibrate hexapod-42 measurements.csv -o run"
SIMULATE = "simulate truth.yaml --poses poses.csv --sigma-position 0.001mm --sigma-angle 5urad --seed 3 -o again.csv"  # noqa: E501


@pytest.fixture
def loopcal(loopcal, tmp_path):
    """Run a command line in a copy of the example's folder."""
    for path in EXAMPLE.iterdir():
        shutil.copy(path, tmp_path)

    return loopcal


def test_simulate_reproduces_the_shipped_measurements(loopcal, tmp_path) -> None:
    loopcal(SIMULATE)
    simulated, shipped = (
        (tmp_path / "again.csv").read_text(),
        (EXAMPLE / "measurements.csv").read_text(),
    )
    assert [line for line in simulated.split("\n") if "," not in line] == [
        line for line in shipped.split("\n") if "," not in line
    ]
    numbers = [
        np.loadtxt(text.split("\n"), delimiter=",", skiprows=7) for text in (simulated, shipped)
    ]
    np.testing.assert_allclose(
        *numbers, rtol=0, atol=1e-10
    )  # [mm, deg]: rounding of another linear algebra library


def test_calibrate_without_a_folder_shows_the_same_result_and_writes_nothing(
    loopcal, tmp_path
) -> None:
    before = sorted(tmp_path.iterdir())
    shown = loopcal("calibrate hexapod-42 measurements.csv").out
    assert sorted(tmp_path.iterdir()) == before
    page, _, last = shown.strip().rpartition("\n\n")
    note = "No file written: use -o RUN to keep the result and the corrected robot file."
    assert " ".join(last.split()) == note
    assert loopcal(CALIBRATE).out.strip().rpartition("\n\n")[0] == page


def test_calibrate_estimates_the_truth_and_writes_a_complete_run_folder(loopcal, tmp_path) -> None:
    loopcal(
        "calibrate hexapod-42 measurements.csv -o out/run --hold-out 0.25",
        "leg6.base.x",
        "Errors at 10 held-out poses",
    )
    assert sorted(p.name for p in (tmp_path / "out" / "run").iterdir()) == [
        "arrays.npz",
        "result.json",
        "robot.yaml",
    ]
    result = json.loads(
        (tmp_path / "out" / "run" / "result.json").read_text(), parse_constant=pytest.fail
    )
    assert len(result["split"]["held_out"]) == 10
    assert set(result["made_by"]["inputs"]) == {"robot", "data"}
    assert result["fit"]["rank"] == 42
    truth, found = lc.load_robot("truth.yaml").values, lc.load_run("out/run").robot
    errors = np.abs(found.values - truth) / np.load("out/run/arrays.npz")["sd"]
    # 42 values, 180 equations: the mean square of errors over their sd is 1 within 1 / sqrt(21) per
    # sd; 4.5 sd allowed
    assert np.mean(errors**2) < 2.0
    after, before = (result["validation"][when]["position"]["rms"] for when in ("after", "before"))
    assert (
        after < 3e-6
    )  # [m]: three times the instrument's 1 um, one for each axis and some for the fit
    assert after < before / 15


@pytest.mark.parametrize(
    "words", ["check hexapod-42", "identifiability hexapod-42 measurements.csv", SIMULATE]
)
def test_json_option_prints_one_document_and_nothing_else(loopcal, words) -> None:
    printed = loopcal(f"{words} --json")
    assert printed.err == ""
    assert isinstance(printed.json, dict)


@pytest.mark.parametrize(
    ("words", "quantity", "sigma"),
    [
        ("simulate hexapod-42 --draw 2 --sigma-position 1um -o data.csv", "angle", "50 urad"),
        ("identifiability 3-prs --draw 9 --sigma-angle 1urad", "length", "10 um"),
        ("plan hexapod-42 -o plan --poses 7 --candidates 20 --sigma-position 1um", "angle",
         "50 urad"),
        ("new gough -o mine.yaml --measurements data.csv --sigma-angle 1urad", "length", "10 um"),
    ],
)  # fmt: skip
def test_noise_that_is_assumed_beside_a_stated_one_is_on_screen_and_in_json(
    loopcal, words, quantity, sigma
) -> None:
    printed = loopcal(f"{words} --json")
    text = f"Each measured {quantity} has no standard deviation in the file. Assumed: {sigma}. "
    text += "Enter both standard deviations."
    assert printed.err.count(text) == 1
    (finding,) = printed.json["input_findings"]
    assert (finding["code"], finding["text"]) == ("data.sigma-assumed", text)


@pytest.mark.parametrize(
    "noise",
    ["", "--kind position --sigma-position 1um", "--sigma-position 1um --sigma-angle 1urad"],
)
def test_noise_that_is_stated_in_full_or_by_default_needs_no_note(loopcal, noise) -> None:
    printed = loopcal(f"simulate hexapod-42 --draw 2 {noise} -o data.csv --json")
    assert printed.err == ""
    assert "input_findings" not in printed.json


def test_unmet_quality_gate_gives_exit_code_2_and_keeps_the_run(loopcal, tmp_path) -> None:
    words = f"{CALIBRATE} --force --limit-position"
    loopcal(f"{words} 0.02mm --limit-angle 0.01deg --hold-out 0.25")
    # few fitted poses, so that the errors exceed the noise: below it, a limit stays open
    said = "quality gate not met: Largest of 32 position errors"
    loopcal(f"{words} 0.1um --hold-out 0.8", said, code=2)
    assert (tmp_path / "run" / "result.json").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--limit-position 1mm", "Hint: add --hold-out 0.25"),
        ("--drop 99", "no pose '99'"),
        ("--lam 1", "--lam belongs to --method ridge"),
        ("--method ls --inflation groups", "--inflation belongs to --method auto"),
    ],
)
def test_option_that_does_not_fit_is_refused(loopcal, words, said) -> None:
    loopcal(f"{CALIBRATE} {words}", said, code=1)


def test_validate_needs_measurements_that_were_not_fitted(loopcal) -> None:
    loopcal(CALIBRATE)
    loopcal("validate run measurements.csv", "--allow-fitted-data", code=1)
    loopcal(SIMULATE.replace("--seed 3", "--seed 43"))
    loopcal("validate run again.csv", "Errors at 40 measured poses")
    assert loopcal("validate run again.csv --json").json["passed"] is True
    # noise of 5 urad leaves a limit of 1 urad open; less noise shows that it is missed
    loopcal("validate run again.csv --limit-angle 1urad", "accepts estimates to 0 deg")
    loopcal(f"{SIMULATE.replace('5urad', '0.5urad')} --force")
    loopcal("validate run again.csv --limit-angle 1urad", "does not conform", code=2)


def test_calibration_from_a_corrected_robot_file_gives_the_same_estimate(loopcal) -> None:
    loopcal(CALIBRATE)
    loopcal("calibrate run/robot.yaml measurements.csv -o run2")
    first, second = lc.load_run("run"), lc.load_run("run2")
    np.testing.assert_allclose(second.robot.values, first.robot.values, rtol=0, atol=1e-10)  # [m]
    np.testing.assert_allclose(
        second.initial_robot.values, first.robot.values, rtol=0, atol=1e-15
    )  # [m]
    assert first.robot.record.text == second.robot.record.text


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["map", "ls", "ridge", "ridge --lam 0.5", "tsvd --keep 30", "tsvd"]
)
def test_calibrate_accepts_every_method(loopcal, method) -> None:
    # what 30 of 42 directions leave is no noise
    words = f"{CALIBRATE} --hold-out 0.25 --method {method}"
    loopcal(words)


def test_drop_excludes_poses_and_loss_is_reported(loopcal) -> None:
    words = f"{CALIBRATE} --drop 3 --drop 7 --loss tukey --verbose"
    loopcal(words, "from 38 poses", "Tukey(c=4.685)")
    assert lc.load_run("run").result["fit"]["dropped"] == ["3", "7"]


def test_result_contains_outliers_expected_benefit_and_prior_conflict(loopcal) -> None:
    loopcal(f"{CALIBRATE} --verbose", "xpected error")
    found = lc.load_run("run").result
    assert found["examination"]["outliers"]["blocks"] == 40
    assert len(found["examination"]["outliers"]["outliers"]) <= 1  # right data: one in 5 % of cases
    assert found["examination"]["worth"]["calibrate"] is True
    assert found["fit"]["prior_conflict"]["conflict"] is False


def test_choose_model_selects_the_ideal_model(loopcal) -> None:
    loopcal(f"{CALIBRATE} --choose-model --verbose", "ideal (chosen)")
    assert lc.load_run("run").result["model_choice"]["chosen"] == "ideal"


def test_noise_estimated_from_the_residuals_is_reported(loopcal) -> None:
    loopcal(f"{CALIBRATE} --noise estimated", "residuals determine the noise")


def test_heights_alone_cannot_determine_all_parameters(loopcal) -> None:
    words = "identifiability hexapod-42 measurements.csv"
    loopcal(words, "42 of 42 parameter combinations")
    heights = "identifiability hexapod-42 --poses poses.csv --kind component --components z"
    loopcal(heights, "6 undetermined combinations only move the base and platform frames")
    loopcal(
        "identifiability hexapod-42 measurements.csv --poses poses.csv",
        "DATA and --poses exclude each other",
        code=1,
    )


def test_identifiability_states_assumptions_of_suggestions_beside_these_only(loopcal) -> None:
    assumption = "Suggested measurements assume"
    assert assumption not in loopcal("identifiability five-bar --draw 9").out  # lists none
    said = " ".join(loopcal("identifiability gripper --draw 9 --verbose").out.split())
    assert assumption in said
    assert "Measure the joint left.rail as well" in said


def test_chosen_joints_are_measured_in_their_dimension(loopcal) -> None:
    finger = "--kind position,joint --joints left.rail"
    loopcal(f"identifiability gripper --draw 9 {finger}", "7 of 7 parameter combinations")
    loopcal("simulate par4 --draw 2 --kind joint --joints hinge-front.pin -o pins.csv")
    assert "hinge-front.pin [deg]" in Path("pins.csv").read_text()
    loopcal(f"plan gripper --poses 6 {finger} -o plan-finger")
    assert "left.rail [mm]" in Path("plan-finger/measurements.csv").read_text()
    loopcal("identifiability gripper --joints left.rail", "does not belong to the kind", code=1)
    mixed = "identifiability gripper --kind joint --joints left.rail,motor"
    loopcal(mixed, "'motor' as length, but this joint is of angle", code=1)


@pytest.mark.parametrize("robot", ["hexapod-42", "3-prs", "five-bar"])
def test_identifiability_without_data_draws_poses_from_the_workspace(loopcal, robot) -> None:
    out = loopcal(f"identifiability {robot} --draw 30 --seed 3").out
    assert out.startswith(f"30 poses drawn from the workspace of {robot}, seed 3\n")
    assert "parameter combinations" in out


def test_check_expand_shows_joints_and_parameters_in_file_units(loopcal) -> None:
    out = loopcal("check linear-delta --expand").out
    rows = [line.split() for line in out.splitlines()]
    assert ["arm3", "carriage", "0", "105", "0"] in [row[:5] for row in rows]
    assert ["q1", "arm1/carriage", "offset", "493.326149", "mm"] in rows
    assert "radius tower1.angle" in out
    assert "q1/transmission/offset" in out
    rows = [line.split() for line in loopcal("check cable-4 --expand").out.splitlines()]
    gains = [row[-2:] for row in rows if "gain" in row]
    assert ["0.10262536", "mm/deg"] in gains  # 5.88 mm a radian
    assert ["0.0174533", "(mm/deg)/mm"] in [row[-2:] for row in rows]


@pytest.mark.parametrize("name", ["five-bar", "3-rrr", "rotary-delta"])
def test_check_expand_shows_joint_angles_at_the_home_pose(loopcal, name) -> None:
    """The angles differ from the start of the search for home (`start:`) by some degrees."""
    robot, out = lc.load_robot(name), loopcal(f"check {name} --expand").out
    shown = {
        tuple(row.split()[:2]): row.split()[-2]
        for row in out.splitlines()
        if " turns about z" in row
    }
    for group, joints in zip(robot.program.groups, robot.home_state.joints, strict=True):
        for k, i in enumerate(group.limbs):
            for j, joint in enumerate(robot.assembly.limbs[i].joints):
                if joint.kind == "R":
                    found = float(shown[robot.assembly.limbs[i].name, joint.name])
                    assert found == pytest.approx(np.degrees(joints[0, 0, k, j]), abs=1e-5)
                    assert found != pytest.approx(np.degrees(joint.start), abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("robot", FEW_ROBOTS)
def test_check_expand_of_every_shipped_robot_truncates_no_number(loopcal, robot) -> None:
    _, out, err = loopcal(f"check {robot} --expand")
    assert err == ""
    assert "…" not in out
    document = loopcal(f"check {robot} --expand --json").json
    assert {limb["name"] for limb in document["assembly"]["limbs"]}


def test_check_expand_shows_anchors_and_dead_points_of_triangle_drives(loopcal) -> None:
    page = " ".join(loopcal("check excavator --expand").out.split())
    assert "boom-cylinder -400 600 0 350 2300 0 mm" in page
    assert "boom-cylinder 1605.37 3047.59 mm" in page


def test_simulate_writes_the_drawn_errors_as_a_robot_file(loopcal) -> None:
    words = "simulate hexapod-42 --poses poses.csv --draw-errors --truth drawn.yaml -o drawn.csv"
    loopcal(words)
    drawn = lc.load_robot("drawn.yaml")
    assert 1e-6 < np.std(drawn.values - drawn.parameters.nominal) < 1e-4  # [m], tolerance 0.029 mm
    loopcal("calibrate hexapod-42 drawn.csv -o run")


def test_simulate_notes_that_a_robot_without_tolerances_has_no_errors_to_draw(
    loopcal, tmp_path
) -> None:
    text = find_robot_file("five-bar").read_text()
    bare = re.sub(r", (tolerance|angle): \{sd: 0.1\}", "", text)
    (tmp_path / "bare.yaml").write_text(bare)
    words = "simulate {} --kind position --draw 5 --draw-errors --truth {}-true.yaml -o {}.csv"
    loopcal(
        words.format("bare.yaml", "bare", "bare"),
        "no free parameter of five-bar has an expected spread",
    )
    true = lc.load_robot("bare-true.yaml")
    np.testing.assert_array_equal(true.values, true.parameters.nominal)
    assert loopcal(words.format("five-bar", "full", "full")).err == ""


def test_simulate_keeps_the_names_of_poses(loopcal, tmp_path) -> None:
    rows = ["home,0mm,0mm,200mm,0deg,0deg,0deg", "A2,5mm,-5mm,205mm,2deg,1deg,-1deg"]
    header = "pose,x [mm],y [mm],z [mm],roll [deg],pitch [deg],yaw [deg]"
    lines = [header, *(row.replace("mm", "").replace("deg", "") for row in rows)]
    (tmp_path / "named.csv").write_text("\n".join(lines) + "\n")
    loopcal("simulate hexapod-42 --poses named.csv -o data.csv")
    data = lc.load_measurements(tmp_path / "data.csv", lc.load_robot("hexapod-42"))
    assert data.labels == ("home", "A2")
    (tmp_path / "twice.csv").write_text("\n".join([*lines, lines[1]]) + "\n")
    loopcal(
        "simulate hexapod-42 --poses twice.csv -o other.csv",
        "pose 'home' is also row 1. Give each pose a separate name",
        code=1,
    )
    assert not (tmp_path / "other.csv").exists()


def test_simulate_skips_and_names_unreachable_poses(loopcal, tmp_path) -> None:
    rows = ["pose,x [mm],y [mm],z [mm]", "a,0,0,20", "far,900,0,20", "b,9,5,20", ""]
    (tmp_path / "p.csv").write_text("\n".join(rows))
    words = "simulate linear-delta --poses p.csv -o d.csv"
    loopcal(words, code=1)  # without the option the pose is refused
    loopcal(
        f"{words} --skip-unreachable",
        "1 of 3 poses are outside its reach or strokes, so loopcal skips them: far",
    )
    data = lc.load_measurements(tmp_path / "d.csv", lc.load_robot("linear-delta"))
    assert data.labels == ("a", "b")
    (tmp_path / "p.csv").write_text("\n".join([rows[0], rows[2], ""]))
    loopcal(f"{words} --skip-unreachable --force", "reaches none of 1 poses", code=1)


def test_check_names_one_actuator(loopcal, tmp_path) -> None:
    (tmp_path / "slide.yaml").write_text(
        "format: 1\nfamily: stages\nname: slide\nunits: {length: mm, angle: deg}\n"
        "controlled: [x]\nstages:\n"
        "  - {name: a, joint: {kind: P, axis: x, stroke: [0, 100], errors: [offset]}}\n"
        "tolerances: {lengths: {sd: 0.1}}\n"
    )
    out = loopcal("check slide.yaml").out
    assert out.startswith("slide: 1 actuator, 1 parameter, 1 free")


def test_check_shows_a_robot_without_unknowns(loopcal, tmp_path) -> None:
    lines = list_shipped_robots()["five-bar"].read_text("utf-8").split("\n")
    kept = [line for line in lines if "errors" not in line and "{of:" not in line]
    bare = "\n".join(line.split(", unknown:")[0] + "}" * (", unknown:" in line) for line in kept)
    (tmp_path / "bare.yaml").write_text(bare)
    for words in ("check bare.yaml", "check bare.yaml --expand"):
        loopcal(words, "has no unknown")
    loopcal("identifiability bare.yaml", "no free parameter", code=1)


def test_simulate_draws_uniform_noise_with_the_stated_sigma(loopcal, tmp_path) -> None:
    words = "simulate hexapod-42 --draw 200 --kind position --sigma-position 1um --seed 4"
    for name in ("normal", "uniform"):
        loopcal(f"{words} --distribution {name} -o {name}.csv")
    robot = lc.load_robot("hexapod-42")
    normal, uniform = (
        lc.load_measurements(tmp_path / f"{name}.csv", robot) for name in ("normal", "uniform")
    )
    true = lc.forward(robot, uniform.readings).T[:, :3, 3]
    noise, gaussian = (data.observations[0].measured - true for data in (uniform, normal))
    limit = np.sqrt(3.0) * 1e-6
    assert 0.99 * limit < np.abs(noise).max() < limit + 1e-9  # [m], digits of the file
    assert noise.std() == pytest.approx(1e-6, rel=0.08)  # 5 sd of the sd of 600 values
    assert np.abs(gaussian).max() > 1.3 * limit
    weights = (uniform.observations[0].weight, normal.observations[0].weight)
    np.testing.assert_array_equal(weights[0], weights[1])  # the file states the sigma
    loopcal(
        "simulate hexapod-42 --fill normal.csv --distribution uniform -o x.csv",
        "--distribution",
        code=1,
    )


def test_simulate_draws_a_scale_and_states_it_in_files_that_it_fills_in_too(
    loopcal, tmp_path
) -> None:
    words = "simulate core-xy --draw 30 --kind position --sigma-position 1nm --seed 4"
    loopcal(f"{words} -o exact.csv")
    loopcal(f"{words} --sigma-scale 100ppm -o scaled.csv")
    loopcal("simulate core-xy --fill scaled.csv --seed 9 -o filled.csv")
    robot = lc.load_robot("core-xy")
    exact, scaled, filled = (
        lc.load_measurements(tmp_path / f"{name}.csv", robot)
        for name in ("exact", "scaled", "filled")
    )
    lengths = exact.observations[0].measured
    drawn = []
    for data in (scaled, filled):
        measured = data.observations[0].measured
        factor = float((measured * lengths).sum() / (lengths**2).sum())
        assert measured == pytest.approx(factor * lengths, abs=1e-8)  # [m], noise of 1 nm twice
        drawn.append(factor - 1.0)
        assert 1e-6 < abs(drawn[-1]) < 4e-4
    assert abs(drawn[0] - drawn[1]) > 1e-6
    for data in (scaled, filled):
        (stated,) = data.stated_values
        assert (stated.name, stated.sd) == ("position.scale", 1e-4)
    loopcal(
        "simulate core-xy --kind inclination --sigma-scale 2ppm -o x.csv",
        "measures angles, which have no scale",
        code=1,
    )


def test_simulate_adds_the_requested_noise_to_readings_and_states_it(loopcal, tmp_path) -> None:
    words = "simulate linear-delta --draw 30 --kind position --seed 4"
    loopcal(f"{words} -o exact.csv")
    loopcal(f"{words} --sigma-reading 20um,q3=0um -o noisy.csv")
    robot = lc.load_robot("linear-delta")
    exact, noisy = (
        lc.load_measurements(tmp_path / name, robot) for name in ("exact.csv", "noisy.csv")
    )
    assert exact.reading_sigma is None
    assert noisy.reading_sigma is not None
    np.testing.assert_allclose(
        noisy.reading_sigma, np.tile([20e-6, 20e-6, 0.0], (30, 1)), rtol=1e-14
    )  # written in mm
    error = noisy.readings - exact.readings
    assert np.abs(error[:, 2]).max() < 1e-12  # [m], digits of the file
    assert (
        30.0 < ((error[:, :2] / 20e-6) ** 2).sum() < 100.0
    )  # chi-square of 60: 0.1 % on either side
    loopcal(
        "simulate linear-delta --fill noisy.csv --sigma-reading 5um -o x.csv",
        "--sigma-reading has no effect because --fill noisy.csv",
        code=1,
    )
    loopcal(
        "simulate linear-delta --fill noisy.csv --skip-unreachable -o x.csv",
        "--skip-unreachable has no effect because --fill noisy.csv",
        code=1,
    )
    loopcal(
        "identifiability linear-delta noisy.csv --sigma-reading 5um",
        "DATA defines the noise of its readings",
        code=1,
    )


@pytest.mark.parametrize(
    ("words", "method"),
    [
        ("--inflation none", "MAP(inflation=1.0"),
        ("--inflation groups", "InflatedTolerances(by='groups')"),
        ("--inflation heavy-tailed", "InflatedTolerances(by='heavy-tailed')"),
        ("", "InflatedTolerances(by='auto')"),
    ],
)
def test_what_may_be_inflated_is_an_option(loopcal, words, method) -> None:
    loopcal(f"{CALIBRATE} {words}")
    assert method in lc.load_run("run").result["fit"]["method"]
