# SPDX-License-Identifier: Apache-2.0
"""The scores of blocks: against calibrations made by hand, their coverage, and their bits."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import loopcal as lc
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.errors import DataError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.instrument import make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.solutions import forward, inverse
from loopcal.studies.simulation.block import compute_block, list_tasks, make_stream, replay_trial
from loopcal.studies.simulation.fits import OUTCOMES
from loopcal.studies.specification.levels import (
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
)
from tests.studies.studies import CAMERA, SIGMA, compute_cells, make_study

ROTATION_FREE = ("orientation", "covered_orientation", "angles")


def test_scores_equal_calibrations_made_by_hand():
    study = make_study()
    (task,) = list_tasks(study)
    (scores,) = compute_cells(study)
    content = json.loads(task.content)
    robot, stream = lc.load_robot("linear-delta"), make_stream(3, 0)
    commanded, held_out = (inverse(robot, content[key]) for key in ("measured", "held_out"))
    table = robot.parameters
    tolerance = table.free * np.array([entry.tolerance for entry in table.entries], dtype=float)
    for i in range(study.block):
        deviation = tolerance * make_random_stream(stream, i, 1).standard_normal(len(tolerance))
        truth = robot.with_values(table.nominal + deviation)
        noise = SIGMA * make_random_stream(stream, i, 0).standard_normal((12, 3))
        measured = forward(truth, commanded.q).T[:, :3, 3] + noise
        kind = lc.Component(("x", "y", "z")).with_tool(robot.tool)
        rows = Observations.from_sigma(kind, np.arange(12), measured, np.full(3, SIGMA))
        data = Measurements("linear-delta", commanded.q, (rows,))
        fit = identify(robot, data, options=FitOptions(LeastSquares(), sigma_uncertainty=0.0))
        true, predicted, nominal = (forward(r, held_out.q) for r in (truth, fit.robot, robot))
        error, before = (
            np.linalg.norm(pose.T[:, :3, 3] - true.T[:, :3, 3], axis=1)
            for pose in (predicted, nominal)
        )
        U = pose_uncertainty(fit, predicted)
        off = fit.estimate - truth.values[fit.free_parameters.places]
        by_hand = {
            "outcome": 0.0,
            "position": np.sqrt(np.mean(error**2)),
            "position_max": error.max(),
            "position_before": np.sqrt(np.mean(before**2)),
            "position_before_max": before.max(),
            "parameters": np.sqrt(np.mean((off / fit.free_parameters.tolerance) ** 2)),
            "covered_parameters": np.mean(np.abs(off) <= fit.interval()),
            "covered_position": np.mean(error <= U.expanded_position),
            "rank": fit.rank,
            "condition": fit.spectrum.condition,
            "noise_scale": np.sqrt(fit.chi_square / fit.residual_test.degrees),
        }
        # single fits are linearized closer to their estimates, which changes the condition number
        assert_allclose([scores[name][i] for name in by_hand], list(by_hand.values()), rtol=1e-5)


@pytest.mark.parametrize("name", ["linear-delta", "five-bar"])
@pytest.mark.parametrize("method", ["map", "least-squares"])
def test_coverage_is_95_percent(name, method):
    axes = ("x", "y", "z") if name == "linear-delta" else ("x", "y")
    study = make_study(
        name,
        replicates=200,
        block=200,
        instruments={"camera": InstrumentLevel(("component",), axes, sigma_position=1e-5)},
        poses={"20": PosesLevel(20)},
        methods={method: MethodLevel(method)},
    )
    (scores,) = compute_cells(study)
    assert_array_equal(scores["outcome"], 0)
    for score in ("covered_parameters", "covered_position"):
        share, spread = scores[score].mean(), scores[score].std() / np.sqrt(200)
        assert abs(share - 0.95) < 4.0 * spread + 0.003, score
    assert abs(np.mean(scores["noise_scale"] ** 2) - 1.0) < 0.06


def test_methods_see_the_same_machines_and_measurements():
    methods = {
        "a": MethodLevel("map"),
        "b": MethodLevel("least-squares"),
        "c": MethodLevel("ridge"),
    }
    cells = compute_cells(make_study(methods=methods))
    for other in cells[1:]:
        for name in ("position_before", "position_before_max"):
            assert_array_equal(other[name], cells[0][name])
        assert np.all(other["position"] != cells[0]["position"])


def test_all_cells_have_the_same_machines():
    cells = compute_cells(
        make_study(
            noise={"1": NoiseLevel(), "4": NoiseLevel(4.0)},
            poses={"12": PosesLevel(12), "15": PosesLevel(15)},
        )
    )
    for other in cells[1:]:
        assert_array_equal(other["position_before"], cells[0]["position_before"])
    single, fourfold = cells[0], cells[2]  # linear in the noise, as it is small
    assert_allclose(fourfold["position"], 4.0 * single["position"], rtol=0.02)


def test_more_poses_are_the_same_poses_and_further_ones():
    study = make_study(poses={"12": PosesLevel(12), "15": PosesLevel(15)})
    few, many = (json.loads(task.content)["measured"] for task in list_tasks(study))
    assert many[:12] == few


@pytest.mark.parametrize(("choice", "seeds"), [("random", 6), ("planned", 2)])
def test_measured_poses_are_never_the_held_out_ones(choice, seeds):
    levels = {str(seed): PosesLevel(20, choice, seed=seed) for seed in range(seeds)}
    for task in list_tasks(make_study(poses=levels)):
        content = json.loads(task.content)
        distance = np.array(content["measured"])[:, None] - np.array(content["held_out"])
        assert np.abs(distance).max(axis=2).min() > 1e-6


def test_planned_poses_are_better_than_random_ones():
    levels = {"random": PosesLevel(8), "planned": PosesLevel(8, "planned")}
    random, planned = compute_cells(make_study(poses=levels, replicates=30, block=30))
    assert np.median(planned["position"]) < 0.8 * np.median(random["position"])


@pytest.mark.parametrize("distribution", ["normal", "uniform"])
def test_errors_have_the_stated_distribution(distribution):
    from loopcal.studies.simulation.machines import draw_machines

    robot = lc.load_robot("linear-delta")
    level = ErrorsLevel(error_factor=2.0, distribution=distribution)
    truth = draw_machines(robot, level, 2000, make_stream(3, 0))
    free = robot.parameters.free
    scaled = (truth - robot.parameters.nominal)[:, free] / robot.parameters.tolerance[free]
    assert_array_equal(truth[:, ~free], robot.parameters.nominal[~free] + 0.0 * truth[:, ~free])
    assert_allclose(scaled.std(axis=0), 2.0, rtol=0.06)
    largest = np.abs(scaled).max()
    assert largest <= 2.0 * np.sqrt(3.0) if distribution == "uniform" else largest > 6.0


def test_fixed_deviations_are_those_of_every_trial():
    name = lc.load_robot("linear-delta").parameters.names[0]
    errors = ErrorsLevel(deviations={name: "0.3 mm"})
    (scores,) = compute_cells(make_study(errors={"set": errors}))
    assert np.ptp(scores["position_before"]) == 0.0
    assert np.ptp(scores["position"]) > 0.0


def test_tolerances_are_known_to_the_fit_and_error_factors_are_not():
    errors = {
        "as stated": ErrorsLevel(),
        "tolerances": ErrorsLevel(tolerance_factor=3.0),
        "errors": ErrorsLevel(error_factor=3.0),
    }
    study = make_study(
        errors=errors,
        methods={"map": MethodLevel("map")},
        instruments={"z": InstrumentLevel(("component",), ("z",), sigma_position=5e-5)},
        replicates=60,
        block=60,
    )
    stated, tolerances, wrong = compute_cells(study)
    assert_allclose(tolerances["position_before"], wrong["position_before"])
    assert tolerances["covered_parameters"].mean() > 0.93
    assert wrong["covered_parameters"].mean() < 0.75
    assert_allclose(tolerances["parameters"].mean(), stated["parameters"].mean(), rtol=0.35)


def test_a_trial_that_fails_does_not_change_the_others():
    errors = {"usual": ErrorsLevel(), "huge": ErrorsLevel(error_factor=300.0)}
    usual, huge = compute_cells(
        make_study(
            "five-bar",
            errors=errors,
            instruments={
                "camera": InstrumentLevel(("component",), ("x", "y"), sigma_position=1e-5)
            },
            replicates=30,
            block=30,
        )
    )
    assert_array_equal(usual["outcome"], 0)
    failed = huge["outcome"] > 0
    assert 0 < failed.sum() < 30
    assert np.isfinite(huge["position"][~failed]).all()
    assert {OUTCOMES[int(code)] for code in huge["outcome"]} <= set(OUTCOMES)


CHILD = """
import hashlib, sys
from loopcal.studies.simulation.block import compute_block, list_tasks
from tests.studies.studies import make_study
study = make_study(replicates=12)
tasks = list(list_tasks(study))[:: int(sys.argv[1])]
values = {task.block: compute_block(task) for task in tasks}
print(hashlib.sha256(b"".join(values[b].tobytes() for b in sorted(values))).hexdigest())
"""


def test_blocks_have_the_same_bits_in_every_process():
    study = make_study(replicates=12)
    values = [compute_block(task).tobytes() for task in list_tasks(study)]
    here = hashlib.sha256(b"".join(values)).hexdigest()
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "3", "OMP_NUM_THREADS": "3"}
    command = [sys.executable, "-c", CHILD, "-1"]  # in the opposite order, with other threads
    child = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert child.stdout.strip() == here


def test_a_replayed_trial_gives_the_scores_of_its_block():
    study = make_study(replicates=12)
    _, task = list_tasks(study)
    column = [c.name for c in study.columns].index("parameters")
    expected = compute_block(task)[2, column]
    trial = replay_trial(study, 0, 8)
    fit = identify(trial.robot, trial.data, options=trial.options)
    places = fit.free_parameters.places
    off = (fit.robot.values - trial.truth.values)[places] / fit.free_parameters.tolerance
    assert_allclose(np.sqrt(np.mean(off**2)), expected, rtol=1e-6)
    for cell, number in ((1, 0), (0, 12), (0, -1)):
        with pytest.raises(DataError, match="numbered from 0"):
            replay_trial(study, cell, number)


def test_a_trial_is_the_same_in_blocks_of_any_size():
    six, three = (compute_cells(make_study(block=block))[0] for block in (6, 3))
    for name in ("position_before", "position", "parameters", "condition"):
        assert_allclose(three[name], six[name][:3], rtol=1e-7)


def test_blocks_differ():
    study = make_study(replicates=12)
    first, second = (compute_block(task) for task in list_tasks(study))
    assert np.all(first[:, 1] != second[:, 1])


def test_columns_are_those_of_the_study():
    study = make_study()
    (task,) = list_tasks(study)
    result = compute_block(task)
    assert result.shape == (6, len(study.columns))
    assert result.dtype == np.float64
    assert study.columns[0].name == "outcome"
    undefined = {c.name for c, v in zip(study.columns, result.T, strict=True) if np.isnan(v).any()}
    assert all(name.startswith(ROTATION_FREE) for name in undefined)
    assert CAMERA.components == ("x", "y", "z")
