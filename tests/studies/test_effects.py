# SPDX-License-Identifier: Apache-2.0
"""Effects that a fit does not know of: each does what its record says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import loopcal as lc
from loopcal.apply.simulated_measurements import InstrumentDescription, build_instrument
from loopcal.measure.instrument import Gaussian, Uniform, make_random_stream
from loopcal.measure.simulation import Disturbance, sample_truth, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.workspace import sample_workspace
from loopcal.studies.simulation.machines import (
    AlteredNoise,
    alter_noise,
    draw_motion,
    make_disturbance,
)
from loopcal.studies.specification.levels import Backlash, EffectsLevel, Outliers, ThermalGrowth
from loopcal.units import Dimension
from tests.studies.studies import compute_cells, make_study

SIGMA = np.array([1e-5, 2e-5])
NORMAL, UNIFORM = Gaussian(SIGMA), Uniform(SIGMA * np.sqrt(3.0))
POSES = 10
EXACT = build_instrument(InstrumentDescription(sigma_position=1e-12, sigma_angle=1e-12))


def draw(effects: EffectsLevel, n: int = 40_000, stated=NORMAL) -> np.ndarray:
    """Return noise (n, 2) in stated sigmas, which are those that the fit is told."""
    noise = AlteredNoise(stated, effects)
    assert_array_equal(noise.sigma, stated.sigma)
    return noise.draw(make_random_stream(1, 0), n) / SIGMA


def disturb(effects: EffectsLevel, name: str = "linear-delta") -> tuple[Any, ...]:
    """Return robot, disturbance, trials with it, and trials without it."""
    robot = lc.load_robot(name)
    poses, truth = sample_workspace(robot, POSES, 1).coordinates, sample_truth(robot, 3, 1)
    disturbance = make_disturbance(robot, truth, poses, effects, 1)
    moved = simulate_trials(robot, truth, poses, EXACT, 1, disturbance=disturbance)
    return robot, disturbance, moved, simulate_trials(robot, truth, poses, EXACT, 1)


def test_without_effects_the_noise_is_the_stated_one():
    plain = Gaussian(SIGMA).draw(make_random_stream(1, 0), 50) / SIGMA
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
    noise = AlteredNoise(Gaussian(SIGMA), EffectsLevel(outliers=Outliers(0.05, 1000.0)))
    streams = [make_random_stream(1, trial) for trial in range(2000)]
    sizes = np.array([np.abs(noise.draw(stream, 6) / SIGMA).max(axis=1) for stream in streams])
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
