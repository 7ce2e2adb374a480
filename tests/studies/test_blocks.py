# SPDX-License-Identifier: Apache-2.0
"""The scores of blocks: against calibrations made by hand, their coverage, and their bits; trials
that are calibrated one by one; effects that a fit does not know of.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import loopcal as lc
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.apply.simulated_measurements import InstrumentDescription, build_instrument
from loopcal.errors import DataError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.instrument import Gaussian, Uniform, make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import Disturbance, sample_truth, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.studies.simulation import block, machines
from loopcal.studies.simulation.block import (
    OUTCOMES,
    compute_block,
    list_tasks,
    make_stream,
    replay_trial,
)
from loopcal.studies.simulation.machines import (
    AlteredNoise,
    alter_noise,
    draw_motion,
    make_disturbance,
)
from loopcal.studies.specification import (
    Backlash,
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    Outliers,
    PosesLevel,
    Scores,
    ThermalGrowth,
)
from loopcal.units import Dimension
from tests.studies.studies import CAMERA, SIGMA, compute_cells, make_study

ROTATION_FREE = ("orientation", "covered_orientation", "angles")


def test_machines_and_measurements_are_made_once_for_all_methods_with_the_same_bits():
    study = make_study(
        poses={"8": PosesLevel(8), "12": PosesLevel(12)},
        methods={"LS": MethodLevel("least-squares"), "MAP": MethodLevel("map"),
                 "ridge": MethodLevel("ridge", lam=2.0)},
    )  # fmt: skip
    tasks = [*list_tasks(study)]
    block._simulate.cache_clear()
    together = [compute_block(task) for task in tasks]
    assert block._simulate.cache_info().misses == 2  # one for each number of poses
    assert len(together) == 6
    for task, scores in zip(tasks, together, strict=True):
        block._simulate.cache_clear()
        machines._prepare.cache_clear()
        assert_array_equal(compute_block(task), scores)


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
    # commands that other tests ran in this process let Python import nothing from this folder
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    environment |= {"OPENBLAS_NUM_THREADS": "3", "OMP_NUM_THREADS": "3"}
    command = [sys.executable, "-c", CHILD, "-1"]  # in the opposite order, with other threads
    child = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert child.stdout.strip() == here


def test_a_replayed_trial_gives_the_scores_of_its_block():
    study = make_study(replicates=12)
    _, task = list_tasks(study)
    column = [c.name for c in study.columns].index("parameters")
    expected = compute_block(task)[2, column]
    prepared, truth, data = replay_trial(study, 0, 8)
    fit = identify(prepared.robot, data, options=prepared.fit_options)
    places = fit.free_parameters.places
    off = (fit.robot.values - truth.values)[places] / fit.free_parameters.tolerance
    assert_allclose(np.sqrt(np.mean(off**2)), expected, rtol=1e-6)
    for cell, number in ((1, 0), (0, 12), (0, -1)):
        with pytest.raises(DataError, match="have the numbers 0"):
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


@pytest.mark.slow
def test_errors_in_fitted_frames_are_those_of_one_calibration():
    tracker = InstrumentLevel(("position",), sigma_position=2e-5, unknown_frames=("base", "tool"))
    study = make_study("hexapod-42", instruments={"t": tracker}, poses={"40": PosesLevel(40)})
    (together,) = compute_cells(study)
    (each,) = compute_cells(
        make_study(
            "hexapod-42",
            instruments={"t": tracker},
            poses={"40": PosesLevel(40)},
            scores=Scores(held_out=5, intervals="adjusted"),
        )
    )
    for name in ("position", "orientation", "position_before", "parameters", "rank"):
        assert_allclose(together[name], each[name], rtol=1e-4)
    (base,) = compute_cells(
        make_study(
            "hexapod-42",
            instruments={"t": tracker},
            poses={"40": PosesLevel(40)},
            scores=Scores(held_out=5, frame="base"),
        )
    )
    assert np.all(base["position"] > 1.5 * together["position"])
    assert_array_equal(base["covered_position"], 1.0)  # a frame that nothing determines


def test_trials_that_are_refused_are_counted():
    methods = {"huber": MethodLevel("least-squares", loss="huber")}
    (scores,) = compute_cells(make_study(methods=methods, poses={"2": PosesLevel(2)}))
    assert {OUTCOMES[int(code)] for code in scores["outcome"]} == {"study.refused"}
    assert np.isnan(scores["position"]).all()


def test_losses_resist_outliers():
    methods = {"plain": MethodLevel("map"), "tukey": MethodLevel("map", loss="tukey")}
    effects = {"outliers": EffectsLevel(outliers=Outliers(0.1, 30.0))}
    plain, tukey = compute_cells(
        make_study(methods=methods, effects=effects, poses={"20": PosesLevel(20)})
    )
    assert np.median(tukey["position"]) < 0.6 * np.median(plain["position"])
    assert tukey["covered_position"].mean() > 0.8


def test_adjusted_intervals_cover_the_truth_where_the_noise_is_larger_than_stated():
    effects = {"noise": EffectsLevel(noise=2.0)}
    scores = [
        compute_cells(
            make_study(
                effects=effects,
                poses={"20": PosesLevel(20)},
                replicates=15,
                block=15,
                scores=Scores(held_out=5, intervals=intervals),
            )
        )[0]
        for intervals in ("stated", "adjusted")
    ]
    assert_allclose(scores[0]["position"], scores[1]["position"], rtol=1e-6)
    assert scores[0]["covered_position"].mean() < 0.8
    assert scores[1]["covered_position"].mean() > 0.88


def test_verdicts_are_those_of_calibrations():
    scores = Scores(held_out=6, verdict=True, limit_position=1e-3)
    effects = {"none": EffectsLevel(), "noise": EffectsLevel(noise=9.0)}
    study = make_study(scores=scores, effects=effects, replicates=2, block=2)
    good, bad = compute_cells(study)
    assert set(good["verdict"]) <= {0.0, 1.0}
    assert_array_equal(bad["verdict"], 3.0)  # not calibrated


STATED = np.array([1e-5, 2e-5])

NORMAL, UNIFORM = Gaussian(STATED), Uniform(STATED * np.sqrt(3.0))

POSES = 10

EXACT = build_instrument(InstrumentDescription(sigma_position=1e-12, sigma_angle=1e-12))


def draw(effects: EffectsLevel, n: int = 40_000, stated=NORMAL) -> np.ndarray:
    """Return noise (n, 2) in stated sigmas, which are those that the fit is told."""
    noise = AlteredNoise(stated, effects)
    assert_array_equal(noise.sigma, stated.sigma)
    return noise.draw(make_random_stream(1, 0), n) / STATED


def disturb(effects: EffectsLevel, name: str = "linear-delta") -> tuple[Any, ...]:
    """Return robot, disturbance, trials with it, and trials without it."""
    robot = lc.load_robot(name)
    poses, truth = sample_workspace(robot, POSES, 1).coordinates, sample_truth(robot, 3, 1)
    disturbance = make_disturbance(robot, truth, poses, effects, 1)
    moved = simulate_trials(robot, truth, poses, EXACT, 1, disturbance=disturbance)
    return robot, disturbance, moved, simulate_trials(robot, truth, poses, EXACT, 1)


def test_without_effects_the_noise_is_the_stated_one():
    plain = Gaussian(STATED).draw(make_random_stream(1, 0), 50) / STATED
    assert_allclose(draw(EffectsLevel(), 50), plain)
    instrument = build_instrument(InstrumentDescription())
    assert alter_noise(instrument, EffectsLevel(drift=1.0)) is instrument


@pytest.mark.parametrize(
    ("effects", "stated", "sd", "rtol"),
    [
        (EffectsLevel(noise=2.5), NORMAL, 2.5, 0.02),
        (EffectsLevel(noise=2.0), UNIFORM, 2.0, 0.02),
        (EffectsLevel(degrees=4.0), NORMAL, 1.0, 0.05),
        (EffectsLevel(correlation=0.7), NORMAL, 1.0, 0.03),
    ],
)
def test_altered_noise_has_the_standard_deviation_that_is_asked_for(effects, stated, sd, rtol):
    drawn = draw(effects, stated=stated)
    assert_allclose(drawn.std(axis=0), sd, rtol=rtol)
    if stated is UNIFORM:  # it stays uniform
        assert np.abs(drawn).max() <= 2.0 * np.sqrt(3.0)
    if effects.degrees is not None:  # it has heavy tails
        assert np.mean(np.abs(drawn) > 4.0) > 20 * np.mean(np.abs(draw(EffectsLevel())) > 4.0)
    if effects.correlation:
        neighbors = np.mean(drawn[1:] * drawn[:-1], axis=0)
        assert_allclose(neighbors, effects.correlation, rtol=0.03)


def test_the_stated_share_of_rows_is_far_off():
    plain, wrong = draw(EffectsLevel(), 200), draw(EffectsLevel(outliers=Outliers(0.05, 30.0)), 200)
    distance = np.linalg.norm(wrong - plain, axis=1)
    assert np.count_nonzero(distance) == 10
    assert_allclose(distance[distance > 0], 30.0)


def test_a_share_of_less_than_one_row_is_off_in_as_many_trials():
    noise = AlteredNoise(Gaussian(STATED), EffectsLevel(outliers=Outliers(0.05, 1000.0)))
    streams = [make_random_stream(1, trial) for trial in range(2000)]
    sizes = np.array([np.abs(noise.draw(stream, 6) / STATED).max(axis=1) for stream in streams])
    assert set((sizes > 100.0).sum(axis=1)) == {0, 1}
    assert abs(np.mean(sizes > 100.0) - 0.05) < 0.008


def test_drift_and_jump_have_the_stated_size_and_no_mean():
    drift = draw_motion(EffectsLevel(drift=1e-4), 5, POSES, 1)
    assert_allclose(np.linalg.norm(drift[:, -1] - drift[:, 0], axis=1), 1e-4)
    assert_allclose(drift.mean(axis=1), 0.0, atol=1e-18)
    jump = draw_motion(EffectsLevel(jump=5e-5), 5, POSES, 1)
    assert_allclose(np.linalg.norm(jump[:, 5] - jump[:, 4], axis=1), 5e-5)
    assert_allclose(np.ptp(jump[:, :5], axis=1), 0.0, atol=1e-18)


@pytest.mark.parametrize("name", ["linear-delta", "hexapod-42"])
def test_drift_moves_what_is_measured_and_not_the_machine(name):
    _, disturbance, moved, plain = disturb(EffectsLevel(drift=1e-4), name)
    assert_array_equal(moved.T, plain.T)
    shift = (moved.measured[0] - plain.measured[0])[..., 3:]
    assert_allclose(shift, disturbance.motion, atol=1e-15)


def test_lengths_grow_with_the_temperature():
    thermal = ThermalGrowth(expansion=1e-5, rise=4.0)
    robot, _, trials, _ = disturb(EffectsLevel(thermal=thermal))
    is_length = np.array([d is Dimension.LENGTH for d in robot.parameters.dimensions])
    for pose, growth in enumerate(np.linspace(-2e-5, 2e-5, POSES)):
        warm = trials.truth * np.where(is_length, 1.0 + growth, 1.0)
        T = forward_trials(robot, warm, trials.readings[None, [pose]]).T
        assert_allclose(trials.T[:, pose], T[:, 0], atol=1e-12)


def test_every_pose_of_a_disturbed_machine_may_be_another_machine():
    robot = lc.load_robot("five-bar")
    poses, truth = sample_workspace(robot, POSES, 1).coordinates, sample_truth(robot, 3, 1)
    nothing = Disturbance(values=np.zeros((1, POSES, truth.shape[1])))
    plain = simulate_trials(robot, truth, poses, EXACT, 1)
    same = simulate_trials(robot, truth, poses, EXACT, 1, disturbance=nothing)
    assert_array_equal(same.measured[0], plain.measured[0])


def test_backlash_lags_behind_the_direction_of_motion():
    robot, disturbance, trials, plain = disturb(EffectsLevel(backlash=Backlash(length=2e-5)))
    direction = np.sign(np.diff(trials.readings, axis=0))
    assert_allclose(disturbance.readings[0, 1:], -1e-5 * direction)
    T = forward_trials(robot, trials.truth, trials.readings[None] + disturbance.readings).T
    assert_allclose(trials.T, T, atol=1e-12)
    assert_array_equal(trials.readings, plain.readings)  # the controller does not know it


def test_effects_make_calibrations_worse_and_leave_the_machines():
    effects = {
        "none": EffectsLevel(),
        "noise": EffectsLevel(noise=3.0),
        "drift": EffectsLevel(drift=6e-4),
        "warm": EffectsLevel(thermal=ThermalGrowth(1.2e-5, 60.0)),
        "backlash": EffectsLevel(backlash=Backlash(length=2e-4)),
    }
    none, *others = compute_cells(make_study(effects=effects, replicates=20, block=20))
    for scores in others:
        assert_array_equal(scores["position_before"], none["position_before"])
        assert np.median(scores["position"]) > 1.2 * np.median(none["position"])
        assert scores["noise_scale"].mean() > 1.3
