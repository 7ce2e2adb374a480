# SPDX-License-Identifier: Apache-2.0
"""Methods and measurements of published studies: raw rows, leg by leg, points held on planes;
coverage, rank and medians agree with the evidence, which has other code.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.errors import FileError
from loopcal.studies.files.study_file import load_study
from loopcal.studies.simulation.block import (
    OUTCOMES,
    calibrate_cells,
    compute_block,
    find_cells,
    list_tasks,
    make_stream,
    replay_trial,
    set_size,
    simulate_block,
)
from loopcal.studies.simulation.machines import draw_machines, prepare_cell
from loopcal.studies.simulation.published_steps import identify_per_leg, make_raw_problem
from loopcal.studies.specification import (
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    PosesLevel,
    Scores,
)
from tests.studies.studies import compute_block_key, compute_cells, make_study, read_robot

POSE = InstrumentLevel(("pose",), sigma_position=1e-7, sigma_angle=1e-7)

FIRST_KEY = "5015342e7fd26b3f806c4ffaebf4648f7555c9e0cc9512b67ff41e6e4aa2ab58"

SECOND_KEY = "5632e757e0e76b6b74972babdc06f50b590121e9827f5bde6d71b79cf40d63e3"

CMM = InstrumentLevel(("plane", "line"), sigma_position=1e-6)

HELD = PosesLevel(100, "plane-line", sweeps=0)

POSES = PosesLevel(36)

SMALL = ErrorsLevel(0.1)


def make_held(method: MethodLevel, **changes):
    """Return a study of points on planes and lines of a hexapod."""
    settings = {
        "instruments": {"cmm": CMM},
        "poses": {"held": HELD},
        "errors": {"small": SMALL},
        "methods": {"m": method},
        "replicates": 2,
        "block": 2,
        **changes,
    }
    return make_study("hexapod-nategh-agheli", **settings)


def test_keys_of_blocks_are_those_of_version_2_of_the_numbers():
    study = make_study()
    assert compute_block_key(study, study.cells[0], 0) == FIRST_KEY
    changed = make_study(
        errors={"u": ErrorsLevel(distribution="uniform")},
        methods={"t": MethodLevel("truncated-svd", keep=3)},
        poses={"p": PosesLevel(8, "planned", seed=2)},
        scores=Scores(5, "base"),
    )
    assert compute_block_key(changed, changed.cells[0], 1) == SECOND_KEY


def test_raw_rows_without_noise_find_the_machine_and_stop_at_epsilon():
    exact = InstrumentLevel(("component",), ("x", "y", "z"), sigma_position=1e-12)
    methods = {
        "fine": MethodLevel("least-squares", rows="raw"),
        "coarse": MethodLevel("least-squares", rows="raw", epsilon=0.5),
        "two": MethodLevel("least-squares", rows="raw", steps=2),
        "short": MethodLevel("least-squares", rows="raw", epsilon=1e-9, steps=2),
    }
    fine, coarse, two, short = compute_cells(
        make_study(instruments={"i": exact}, methods=methods, poses={"30": PosesLevel(30)})
    )
    assert_array_equal(fine["outcome"], 0.0)
    assert_array_equal(two["outcome"], 0.0)  # a fixed number of steps
    assert {OUTCOMES[int(code)] for code in short["outcome"]} == {"study.steps-remain"}
    assert_array_equal(short["position"], two["position"])  # the same values, another status
    assert_array_equal(two["iterations"], 2.0)
    assert fine["position"].max() < 1e-9  # [m]
    assert (coarse["iterations"] < fine["iterations"]).all()
    assert np.isnan(fine["covered_position"]).all()


def test_raw_least_squares_without_rank_detection_diverges_and_truncated_svd_does_not():
    five = InstrumentLevel(
        ("component",), ("x", "y", "z", "phi", "theta", "psi"), "tilt-torsion", unused=("psi",)
    )
    methods = {
        "ls": MethodLevel("least-squares", rows="raw"),
        "tsvd": MethodLevel("truncated-svd", rows="raw", keep=32),
        "ridge": MethodLevel("ridge", rows="raw", lam=1.0, steps=3),
    }
    study = make_study("3-prs", instruments={"5": five}, methods=methods, poses={"36": POSES})
    ls, tsvd, ridge = compute_cells(replace(study, replicates=2, block=2))
    assert {OUTCOMES[int(code)] for code in ls["outcome"]} == {"study.diverged"}
    assert np.isnan(ls["position"]).all()
    assert np.isfinite(ls["position_before"]).all()
    assert_array_equal(tsvd["outcome"], 0.0)
    assert_array_equal(ridge["iterations"], 3.0)


def test_one_lambda_per_parameter_takes_the_step_of_equation_11():
    six = InstrumentLevel(("component",), ("x", "y", "z", "phi", "theta", "psi"), "tilt-torsion")
    lam = {"*": 0.01, "a*": 1.0, "q*": 0.0}
    levels = {
        "vector": MethodLevel("ridge", rows="raw", lam=lam, steps=1),
        "alike": MethodLevel("ridge", rows="raw", lam={"*": 0.01}, steps=1),
        "number": MethodLevel("ridge", rows="raw", lam=0.01, steps=1),
    }
    study = make_study("3-prs", instruments={"6": six}, methods=levels, poses={"36": POSES})
    study = replace(study, replicates=2, block=2)
    vector, alike, number = calibrate_cells(study)
    assert_allclose(alike.values, number.values, rtol=0, atol=1e-12)
    task = next(list_tasks(study))
    cell = prepare_cell(json.loads(task.content))
    trials = simulate_block(cell, make_stream(study.seed, 0))
    raw = make_raw_problem(cell.robot, trials)
    free = raw.problem.free
    weight = np.array([{"a": 1.0, "q": 0.0}.get(name[0], 0.01) for name in free.names])
    z = np.zeros((2, len(free)))
    factor = raw.problem.linearize(z, raw.start).factor
    H, D = factor[:, :, :-1], -factor[:, :, -1:]
    step = np.linalg.solve(H.mT @ H + np.diag(weight), H.mT @ D)[..., 0]
    expected = cell.robot.values + 0.0 * vector.values
    expected[:, free.places] += step * free.tolerance
    moved = np.abs(step * free.tolerance).max()
    assert_allclose(vector.values, expected, rtol=0, atol=1e-9 * moved)  # condition of H'H
    assert np.abs(vector.values - number.values).max() > 1e-3 * moved


@pytest.mark.parametrize("rows", ["weighted", "raw"])
def test_a_study_file_states_lambda_by_pattern(tmp_path, rows):
    text = """
format: 1
title: One lambda for each parameter
seed: 1
robots: [hexapod-42]
replicates: 2
block: 2
poses: [12]
methods:
  m: {method: ridge, rows: ROWS, lam: {"*.length": 1.0, "*": 0.01}}
scores: {held_out: 3}
"""
    path = tmp_path / "study.yaml"
    path.write_text(text.replace("ROWS", rows), "utf-8")
    (scores,) = compute_cells(load_study(path))
    assert np.isfinite(scores["position"]).all()
    path.write_text(path.read_text("utf-8").replace("*.length", "*.lengths"), "utf-8")
    with pytest.raises(FileError, match=r"study.yaml:10: 'm' of 'methods': no parameter has"):
        load_study(path)


def test_per_leg_trials_are_those_of_identify_per_leg():
    methods = {
        "steps": MethodLevel("per-leg", steps=2),
        "epsilon": MethodLevel("per-leg", epsilon=1e-3, stop="step"),
        "poses": MethodLevel("per-leg", epsilon=1.0),
        "never": MethodLevel("per-leg", epsilon=1e-9, steps=5),
    }
    study = make_study(
        "hexapod-42",
        instruments={"pose": POSE},
        methods=methods,
        poses={"12": PosesLevel(12)},
        replicates=2,
        block=2,
    )
    two, rule, poses, never = calibrate_cells(study)
    prepared, truth, data = replay_trial(study, 0, 1)
    fit = identify_per_leg(prepared.robot, data, 2)
    assert_allclose(two.values[1], fit.robot.values, rtol=0, atol=1e-15)
    assert_array_equal(two.truth[1], truth.values)
    assert rule.is_converged.all()
    assert (rule.iterations > 1).all()
    assert_array_equal(poses.iterations, 1)
    assert poses.is_converged.all()
    assert_array_equal(never.iterations, 5)
    assert {OUTCOMES[code] for code in never.outcome} == {"study.steps-remain"}
    delta = {"delta": read_robot("linear-delta")}
    (refused,) = calibrate_cells(replace(study, robots=delta, methods={"m": methods["steps"]}))
    assert {OUTCOMES[code] for code in refused.outcome} == {"study.refused"}


def test_unused_columns_change_no_noise_of_the_others():
    full, less = (
        make_study(instruments={"i": InstrumentLevel(("component",), ("x", "y", "z"), unused=u)})
        for u in ((), ("z",))
    )
    (a,), (b,) = calibrate_cells(full), calibrate_cells(less)
    assert_array_equal(a.measured[0][..., :2], b.measured[0][..., :2])
    assert np.isnan(b.measured[0][..., 2]).all()
    assert_array_equal(a.truth, b.truth)
    assert (compute_cells(less)[0]["rank"] <= compute_cells(full)[0]["rank"]).all()


def test_sizes_of_errors_lie_between_the_smallest_and_the_largest():
    study = make_study(errors={"e": ErrorsLevel(distribution="uniform", smallest=0.5)})
    (task,) = list_tasks(study)
    cell = prepare_cell(json.loads(task.content))
    drawn = draw_machines(cell.robot, cell.content.errors, 4000, 0) - cell.robot.parameters.nominal
    tolerance = cell.robot.parameters.tolerance
    free = np.flatnonzero(cell.robot.parameters.free)
    scaled = drawn[:, free] / tolerance[free]
    largest = np.sqrt(3.0 / 1.75)
    assert 0.5 * largest <= np.abs(scaled).min() < 0.52 * largest
    assert 0.98 * largest < np.abs(scaled).max() <= largest
    assert abs(np.sqrt(np.mean(scaled**2)) - 1.0) < 0.01
    assert abs(np.mean(scaled > 0) - 0.5) < 0.02


def test_held_points_leave_nine_motions_and_33_combinations():
    study = make_held(MethodLevel("least-squares", rows="products"), scores=Scores(5, frame="both"))
    (scores,) = compute_cells(study)
    assert_array_equal(scores["outcome"], 0.0)
    assert_array_equal(scores["rank"], 33.0)
    assert (scores["position"] < 0.2 * scores["position_before"]).all()
    assert (scores["position_base"] > 2.0 * scores["position"]).all()
    content = next(list_tasks(study)).content
    assert prepare_cell(json.loads(content)).motions.shape == (12, 9)


def test_products_of_held_points_equal_fits_with_surfaces_as_unknowns():
    study = make_held(
        MethodLevel("map", rows="products"),
        methods={"p": MethodLevel("map", rows="products"), "s": MethodLevel("map")},
    )
    products, surfaces = calibrate_cells(study)
    assert_array_equal(products.truth, surfaces.truth)
    size = np.abs(products.values - products.robot.values).max()
    assert_allclose(products.values, surfaces.values, rtol=0, atol=1e-3 * size)


def test_cells_with_held_points_see_the_same_points_and_machines():
    noises = {"1": CMM, "2": replace(CMM, sigma_position=1e-5)}
    method = MethodLevel("least-squares", rows="products-printed")
    a, b = calibrate_cells(make_held(method, instruments=noises))
    assert_array_equal(a.readings, b.readings)
    assert_array_equal(a.truth, b.truth)


def test_sizes_and_levels_choose_cells():
    study = set_size(make_study(methods={"a": MethodLevel(), "b": MethodLevel("map")}), 7, 3)
    assert (study.seed, study.replicates, study.block) == (7, 3, 3)
    assert find_cells(study, method="b") == (1,)


TEXT = """\
format: 1
title: t
replicates: 2
robots: [hexapod-42]
instruments:
  a: {kinds: [pose]}
poses: [12]
methods:
  m: {method: least-squares}
"""


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("method: least-squares", "method: map, rows: raw", 9, "map needs weighted rows"),
        ("method: least-squares", "method: ridge, rows: raw", 9, "needs lam"),
        ("method: least-squares", "method: map, epsilon: 1", 9, "rows: raw"),
        ("method: least-squares", "method: per-leg, epsilon: 0", 9, "must be above 0"),
        ("method: least-squares", "method: per-leg, stop: step", 9, "per-leg with epsilon"),
        ("method: least-squares", "rows: raw, epsilon: 1, stop: dQint", 9, "per-leg with epsilon"),
        ("method: least-squares", "method: per-leg, steps: 0", 9, "must be from 1 to"),
        ("method: least-squares", "method: per-leg, loss: huber", 9, "has neither loss"),
        ("method: least-squares", "method: per-leg, rows: raw", 9, "Remove 'rows'"),
        ("method: least-squares", "method: map, rows: products", 9, "choice: plane-line"),
        ("method: least-squares", "method: map, rows: rough", 9, "rows"),
        ("[12]", "{p: {count: 40, choice: plane-line}}", 7, "kinds: [plane, line]"),
        ("[12]", "{p: {count: 41, choice: plane-line}}", 7, "equal groups"),
        ("[12]", "{p: {count: 30, choice: plane-line}}", 7, "at least 4"),
        ("kinds: [pose]", "kinds: [pose], unused: [w]", 6, "an unused column is 'w'"),
        ("poses: [12]", "errors:\n  e: {smallest: 0.5}", 8, "distribution: uniform"),
    ],
)
def test_settings_that_do_not_fit_are_refused_at_their_line(tmp_path, old, new, line, words):
    path = tmp_path / "study.yaml"
    path.write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(FileError) as caught:
        load_study(path)
    assert f"study.yaml:{line}:" in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("robot", "words"), [("tricept", "moves 4 legs"), ("3-prs", "has 3 actuators"), ("6-rus", "")]
)
def test_a_robot_that_per_leg_does_not_fit_is_refused_before_the_study_runs(tmp_path, robot, words):
    path = tmp_path / "study.yaml"
    text = TEXT.replace("hexapod-42", robot).replace("least-squares", "per-leg")
    path.write_text(text, encoding="utf-8")
    if not words:
        assert list(load_study(path).robots) == [robot]
        return
    with pytest.raises(FileError, match=words) as caught:
        load_study(path)
    assert "study.yaml:9:" in str(caught.value)


def test_published_methods_know_no_verdict_and_no_adjusted_intervals(tmp_path):
    path = tmp_path / "study.yaml"
    for scores in ("verdict: true", "intervals: adjusted"):
        text = TEXT.replace("method: least-squares", "method: per-leg")
        path.write_text(text + f"scores: {{{scores}}}\n", encoding="utf-8")
        with pytest.raises(FileError, match="neither a verdict nor intervals"):
            load_study(path)


EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence" / "coverage.json"

TRIALS = 1000

FULL_POSE = InstrumentLevel(("pose",), sigma_position=5e-6, sigma_angle=25e-6)

CAMERA = InstrumentLevel(("component",), ("x", "y", "z"), sigma_position=5e-6)

CASES = {
    "hexapod, least squares": ("hexapod-42", FULL_POSE, "least-squares", 1.0, 42),
    "3-PRS, MAP": ("3-prs", FULL_POSE, "map", 1.0, 33),
    "delta, MAP": ("linear-delta", CAMERA, "map", 1.0, 9),
    "hexapod, noise twice its sigma": ("hexapod-42", FULL_POSE, "least-squares", 2.0, 42),
}


@pytest.mark.evidence
@pytest.mark.parametrize("case", CASES)
def test_coverage_and_rank_agree(case):
    rows = json.loads(EVIDENCE.read_text("utf-8"))["tables"]["coverage"]["rows"]
    fits, expected = next(row[1:3] for row in rows if row[0] == case)
    robot, instrument, method, noise, rank = CASES[case]
    study = make_study(
        robot,
        seed=11,
        replicates=TRIALS,
        block=250,
        instruments={"i": instrument},
        poses={"20": PosesLevel(20)},
        methods={method: MethodLevel(method)},
        effects={"noise": EffectsLevel(noise=noise)},
    )
    values = np.concatenate([compute_block(task) for task in list_tasks(study)])
    scores = dict(zip((column.name for column in study.columns), values.T, strict=True))
    assert_array_equal(scores["outcome"], 0)
    assert_array_equal(scores["rank"], rank)
    share = 100.0 * scores["covered_parameters"]
    spread = share.std() * np.sqrt(1.0 / TRIALS + 1.0 / fits)
    assert abs(share.mean() - expected) < 3.5 * spread


METHODS = {
    "least squares": MethodLevel("least-squares"),
    "MAP": MethodLevel("map"),
    "default": MethodLevel("auto"),
}

MEDIANS = {
    "hexapod-42": InstrumentLevel(("pose",), sigma_position=1e-5, sigma_angle=5e-5),
    "3-prs": InstrumentLevel(("pose",), sigma_position=1e-5, sigma_angle=5e-5),
    "linear-delta": InstrumentLevel(("component",), ("x", "y", "z"), sigma_position=1e-5),
}

MEDIAN_TRIALS, MEDIAN_POSES = 200, 25


@pytest.mark.evidence
@pytest.mark.parametrize("robot", MEDIANS)
def test_medians_of_errors_agree(robot):
    """The study has the measured and the held-out poses of the evidence, which follow from the
    seed, and other machines and noise. Errors are in the base frame; every coordinate is measured.

    The logarithm of the median of n machines scatters by 1.2533 sd(log error) / sqrt(n).
    """
    document = json.loads((EVIDENCE.parent / "known_truth.json").read_text("utf-8"))
    table = document["tables"]["median_error_um"]
    row = next(r for r in table["rows"] if r[0] == robot and r[1] == "10 um, 50 urad")
    expected = dict(zip(table["columns"], row, strict=True))
    assert document["poses"][0] == MEDIAN_POSES
    study = make_study(
        robot,
        seed=document["seed"],
        replicates=MEDIAN_TRIALS,
        block=MEDIAN_TRIALS,
        instruments={"i": MEDIANS[robot]},
        poses={"25": PosesLevel(MEDIAN_POSES)},
        methods=METHODS,
        scores=Scores(held_out=60, frame="base"),
    )
    names = [column.name for column in study.columns]
    errors: dict[str, np.ndarray] = {}
    for task in list_tasks(study):
        scores = dict(zip(names, compute_block(task).T, strict=True))
        errors[study.cells[task.cell].levels["method"]] = np.log(1e6 * scores["position"])
        errors["before"] = np.log(1e6 * scores["position_before"])
    assert set(errors) == {"before", *METHODS}
    for name, values in errors.items():
        spread = 1.2533 * values.std() * np.sqrt(1.0 / MEDIAN_TRIALS + 1.0 / document["machines"])
        assert abs(np.median(values) - np.log(expected[name])) < 3.5 * spread
