# SPDX-License-Identifier: Apache-2.0
"""Poses with missing readings: they start from any full measurement, in a bounded number of
evaluations.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal.mechanism.kinematics as trials_module
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import PoseStates
from loopcal.estimate.pose_coordinates import measure_poses
from loopcal.estimate.pose_estimate import report_doubtful_readings
from loopcal.estimate.pose_rows import PoseSearch
from loopcal.estimate.problem import problem_of
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.distance import Distance
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.kinematics import find_directly_reachable
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.gauss_newton import Halving
from tests.estimate.problems import UM, noise


def simulate_with_missing_readings(name, sensors, n, seed, share=0.0, sigma=20 * UM):
    """Return robot, true robot, and measurements of n poses with a share of readings missing."""
    robot = load_robot(name)
    truth = robot.with_values(sample_truth(robot, 1, seed)[0])
    data = simulate(
        truth,
        sample_workspace(robot, n, seed).coordinates,
        Instrument(sensors),
        seed,
        reading_sigma=sigma,
    )
    return (
        robot,
        truth,
        remove_readings(data, np.random.default_rng(seed).random(data.readings.shape) < share),
    )


def remove_readings(data: Measurements, lost: np.ndarray) -> Measurements:
    """Return the measurements without the readings `lost` (n, a)."""
    assert data.reading_sigma is not None
    return replace(
        data,
        readings=np.where(lost, np.nan, data.readings),
        reading_sigma=np.where(lost, np.inf, data.reading_sigma),
    )


@pytest.fixture
def evaluation_counter(monkeypatch):
    """Count evaluations of poses, and poses that are followed along a path."""
    count = {"evaluations": 0, "followed": 0}

    def counting(owner, attribute, word):
        original = getattr(owner, attribute)

        def wrapped(*args, **named):
            count[word] += 1
            return original(*args, **named)

        monkeypatch.setattr(owner, attribute, wrapped)

    counting(PoseSearch, "evaluate", "evaluations")
    counting(trials_module, "follow_path", "followed")
    return count


ANCHORS = ((0.9, 0.1, 1.0), (-0.5, 0.8, 1.1), (-0.4, -0.9, 0.9))

FULL_MEASUREMENTS = {
    "a position of a delta robot": ("linear-delta", (Sensor(Position(), noise(UM, UM, UM)),)),
    "two coordinates of a planar robot": (
        "five-bar",
        (Sensor(Component(("x", "y")), noise(UM, UM)),),
    ),
    "two coordinates from two instruments": (
        "five-bar",
        (Sensor(Component(("x",)), noise(UM)), Sensor(Component(("y",)), noise(50 * UM))),
    ),
    "three distances": (
        "linear-delta",
        tuple(
            Sensor(Distance(anchor=np.array(a), anchor_name=f"wire{i}"), noise(UM))
            for i, a in enumerate(ANCHORS)
        ),
    ),
    "a position of a robot with three freedoms of six": (
        "3-prs",
        (Sensor(Position(), noise(UM, UM, UM)),),
    ),
    "a pose": ("hexapod-42", (Sensor(Pose(), noise(*[5 * UM] * 3, *[UM] * 3)),)),
}


@pytest.mark.parametrize("case", FULL_MEASUREMENTS)
def test_rows_that_determine_all_freedoms_give_the_pose(case):
    robot, sensors = FULL_MEASUREMENTS[case]
    robot = load_robot(robot)
    result = inverse(robot, sample_workspace(robot, 6, 1).coordinates)
    data = simulate(robot, result.T, Instrument(sensors), 0, reading_sigma=20 * UM)
    problem = problem_of(select_free_parameters(robot), data)
    T, known = measure_poses(robot, problem.rows[:-1], np.zeros(6, dtype=int), np.arange(6))
    assert known.all()
    assert_allclose(
        T[:, :3, 3], result.T[:, :3, 3], atol=2e-3, rtol=0
    )  # [m] of noise and, for 3-prs, of its weak direction
    fewer = tuple(replace(s, rows=np.array([0, 1, 3])) for s in sensors[:1])
    problem = problem_of(
        select_free_parameters(robot),
        simulate(robot, result.T, Instrument((*fewer, *sensors[1:])), 0, reading_sigma=20 * UM),
    )
    _, known = measure_poses(robot, problem.rows[:-1], np.zeros(6, dtype=int), np.arange(6))
    assert known.tolist() == [True, True, False, True, False, False]


PARTIAL_READINGS = {
    "linear-delta, positions": ("linear-delta", (Sensor(Position(), noise(*[10 * UM] * 3)),), 0.1),
    "linear-delta, x and y": (
        "linear-delta",
        (Sensor(Component(("x", "y")), noise(*[10 * UM] * 2)),),
        0.05,
    ),
    "3-rrr, x and y": ("3-rrr", (Sensor(Component(("x", "y")), noise(*[10 * UM] * 2)),), 0.05),
}


@pytest.mark.parametrize("case", PARTIAL_READINGS)
def test_missing_readings_are_estimated_in_few_evaluations_without_paths(case, evaluation_counter):
    name, sensors, share = PARTIAL_READINGS[case]
    for seed in range(3):
        robot, _, data = simulate_with_missing_readings(name, sensors, 30, seed, share)
        evaluation_counter.update(evaluations=0, followed=0)
        fit = identify(robot, data)
        assert fit.converged
        assert fit.chi_square < 2.0 * fit.residual_test.dof
        assert (
            evaluation_counter["evaluations"] < 60
        )  # some ten folds of two to four evaluations; 559 and more without a bound of the step
        assert evaluation_counter["followed"] == 0


def test_missing_reading_is_estimated_in_the_working_mode_of_home():
    for seed in range(4):
        robot, truth, data = simulate_with_missing_readings(
            "linear-delta", (Sensor(Position(), noise(*[10 * UM] * 3)),), 20, seed
        )
        lost = np.zeros(data.readings.shape, dtype=bool)
        lost[7, 0] = True
        fit = identify(robot, remove_readings(data, lost))
        assert fit.poses is not None
        true = inverse(truth, sample_workspace(robot, 20, seed).coordinates).q[7, 0]
        assert fit.poses.readings[7, 0] == pytest.approx(
            true, abs=2e-3
        )  # [m]: errors of lengths; the other branch is 0.3 off
        assert not any("branch" in note or "stroke" in note for note in map(str, fit.findings))


def test_reading_outside_its_stroke_or_in_another_working_mode_is_reported():
    robot, _, data = simulate_with_missing_readings(
        "linear-delta", (Sensor(Position(), noise(*[10 * UM] * 3)),), 20, 0
    )
    lost = np.zeros(data.readings.shape, dtype=bool)
    lost[7, 0] = lost[9, 2] = True
    fit = identify(robot, remove_readings(data, lost))
    assert fit.poses is not None
    assert report_doubtful_readings(fit.robot, fit.poses) == ()
    result = fit.poses.readings.copy()
    result[7, 0] += 0.1 if result[7, 0] < 0.3 else -0.1  # [m]: within the stroke of 0 to 0.4 m
    result[9, 2] = -0.02
    outside, beside = report_doubtful_readings(fit.robot, replace(fit.poses, readings=result))
    name = robot.actuators[2].name
    assert outside.code == "poses.outside-stroke"
    reading = outside.data["readings"][-1]
    assert (reading["actuator"], reading["pose"]) == (name, "10")
    assert reading["value"].value == pytest.approx(-20.0)
    assert reading["value"].unit == "mm"
    assert beside.code == "poses.other-branch"
    reading = beside.data["readings"][0]
    assert (reading["actuator"], reading["pose"]) == (robot.actuators[0].name, "8")
    assert (
        report_doubtful_readings(
            fit.robot, replace(fit.poses, readings=result, is_undetermined=np.ones(20, dtype=bool))
        )
        == ()
    )


@pytest.mark.parametrize("name", ["linear-delta", "3-rrr", "hexapod-42"])
def test_pose_search_from_random_starts_is_bounded_and_never_increases_cost(
    name, evaluation_counter
):
    size = 6 if name == "hexapod-42" else 2
    kind = Pose() if name == "hexapod-42" else Component(("x", "y"))
    robot, _, data = simulate_with_missing_readings(
        name, (Sensor(kind, noise(*[10 * UM] * size)),), 12, 5
    )
    lost = np.zeros(data.readings.shape, dtype=bool)
    lost[:, 0] = True
    data = remove_readings(data, lost)
    problem = problem_of(select_free_parameters(robot), data)
    assert problem.is_uncertain
    stroke = np.array([a.stroke for a in robot.actuators], dtype=float)
    rng, z = np.random.default_rng(3), np.zeros((1, problem.parameters))
    for _ in range(4):
        readings = data.readings.copy()
        readings[:, 0] = stroke[0, 0] + (stroke[0, 1] - stroke[0, 0]) * rng.random(len(readings))
        reached = find_directly_reachable(robot, robot.values[None], readings[None])[0]
        readings = np.where(reached[:, None], readings, home_readings(robot))
        begin = PoseStates(forward(robot, readings).state, readings[None])
        start = replace(problem.start(z), poses=begin)
        at_once = replace(problem, control=Halving(steps=0))
        first = at_once.linearize(z, start)
        assert np.isfinite(first.cost).all()
        evaluation_counter.update(evaluations=0, followed=0)
        last = problem.linearize(z, start)
        assert evaluation_counter["evaluations"] <= 1 + problem.control.steps * (
            problem.control.attempts + 1
        )
        assert evaluation_counter["followed"] == 0
        assert np.isfinite(last.cost).all()
        assert last.cost[0] <= first.cost[0]


def home_readings(robot):
    """Return the readings (a,) of the home pose."""
    return inverse(robot, robot.home[None]).q[0]
