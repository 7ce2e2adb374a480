# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements: noise, random streams, commanded poses, checks against the robot."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.apply.simulated_measurements import simulate_measurements
from loopcal.cli.entry_point import main
from loopcal.errors import DataError
from loopcal.io.robot.robot_file import find_robot_file, load_robot
from loopcal.measure.data_checks import check_actuators, check_duplicates, check_strokes
from loopcal.measure.instrument import (
    BlockStream,
    Gaussian,
    Instrument,
    Sensor,
    Uniform,
    make_random_stream,
)
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.joints import Closure
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.readings import solve_commanded_poses
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import ParameterTable
from tests import zoo
from tests.findings.expectations import expect_refusal

SIGMA = np.array([5e-6, 5e-6, 5e-6, 1e-6, 1e-6, 1e-6])
COMMANDED = zoo.make_poses(
    np.random.default_rng(4).uniform(-1.0, 1.0, (12, 6)) * [0.01, 0.01, 0.01, 0.05, 0.05, 0.05]
    + [0, 0, 0.2, 0, 0, 0]
)
TRACKER = Instrument(
    (Sensor(Pose(), Gaussian(SIGMA)), Sensor(Component(("z",)), Uniform(np.array([1e-6]))))
)


@pytest.fixture(scope="module")
def robot():
    robot = zoo.hexapod()
    return replace(
        robot,
        parameters=ParameterTable(
            tuple(replace(p, tolerance=5e-5) for p in robot.parameters.entries)
        ),
    )


@pytest.fixture(scope="module")
def truth(robot):
    return robot.with_values(sample_truth(robot, 1, seed=5)[0])


def test_readings_are_those_of_the_controller_for_the_commanded_poses(robot, truth):
    assert_allclose(
        solve_commanded_poses(robot, COMMANDED).q, inverse(robot, COMMANDED).q, atol=0.0
    )
    assert_allclose(
        simulate(truth, COMMANDED, TRACKER, seed=1).readings, inverse(robot, COMMANDED).q, atol=0.0
    )
    own = simulate(truth, COMMANDED, TRACKER, seed=1, controller=truth).readings
    assert_allclose(own, inverse(truth, COMMANDED).q, atol=0.0)


def test_nominal_machine_is_measured_at_the_commanded_poses_within_noise(robot):
    data = simulate(robot, COMMANDED, TRACKER, seed=1)
    for rows in data.observations:
        white = (rows.whitener @ rows.evaluate(COMMANDED[None]).residual[0, ..., None])[..., 0]
        assert 0.0 < np.abs(white).max() < 5.0
    assert data.n_rows == 7 * len(COMMANDED)
    assert data.robot_name == robot.name


def test_true_machine_is_measured_at_the_poses_of_its_geometry(robot, truth):
    trials = simulate_trials(robot, truth.values, COMMANDED, TRACKER, seed=1)
    white = (trials.trial(0).observations[0].whitener @ _evaluate_first_sensor(trials)[..., None])[
        ..., 0
    ]
    assert np.abs(white).max() < 5.0
    moved = geometry.pose_difference(trials.T[0], COMMANDED)
    assert np.abs(moved[:, 3:]).max() > 20 * SIGMA[-1]
    # The rods of the true machine are as long as its readings say.
    assert_allclose(inverse(truth, trials.T[0]).q, trials.readings, atol=1e-12)


def _evaluate_first_sensor(trials):
    return trials.trial(0).observations[0].evaluate(trials.T[:1]).residual[0]


def test_trial_does_not_depend_on_the_number_of_trials(robot):
    values = sample_truth(robot, 5, seed=9)
    assert np.array_equal(values[:2], sample_truth(robot, 2, seed=9))
    five = simulate_trials(robot, values, COMMANDED, TRACKER, seed=3)
    two = simulate_trials(robot, values[:2], COMMANDED, TRACKER, seed=3)
    one = simulate(robot.with_values(values[0]), COMMANDED, TRACKER, seed=3)
    assert (len(five), five.measured[0].shape) == (5, (5, len(COMMANDED), 6))
    for k in range(2):
        # [m, rad] machines solved in batches of other sizes may differ by a rounding
        assert_allclose(five.measured[k][:2], two.measured[k], atol=1e-14)
        assert_allclose(five.measured[k][0], one.observations[k].measured, atol=1e-14)
    assert not np.allclose(five.measured[0][0], five.measured[0][1], atol=1e-9)


def test_second_sensor_does_not_change_the_noise_of_the_first(robot):
    alone = simulate(robot, COMMANDED, Instrument(TRACKER.sensors[:1]), seed=3)
    assert np.array_equal(
        alone.observations[0].measured,
        simulate(robot, COMMANDED, TRACKER, seed=3).observations[0].measured,
    )


@pytest.mark.parametrize("distribution", ["normal", "uniform"])
def test_true_values_have_the_tolerances_as_standard_deviations(robot, distribution):
    drawn = sample_truth(robot, 4000, 2, distribution)
    scaled = (drawn - robot.parameters.nominal) / robot.parameters.tolerance
    # Relative sd of a standard deviation from 4000 draws is 1 / sqrt(8000) = 1.1 %; 42 of them stay
    # within 4.5 of those.
    assert_allclose(scaled.std(axis=0), 1.0, atol=0.05)
    assert (np.abs(scaled).max() <= np.sqrt(3.0)) == (distribution == "uniform")


def test_drawn_noise_has_the_stated_standard_deviation():
    for noise in (Gaussian(SIGMA), Uniform(SIGMA)):
        drawn = noise.draw(make_random_stream(1, 0), 20000)
        # 1 / sqrt(40000) = 0.5 % for the normal one, less for the uniform one; six columns within
        # five of those
        assert_allclose(drawn.std(axis=0), noise.sigma, rtol=0.025)
    assert np.all(np.abs(Uniform(SIGMA).draw(make_random_stream(1, 0), 20000)) <= SIGMA)


def test_commanded_pose_out_of_reach_is_refused_by_name(robot):
    far = COMMANDED.copy()
    far[2, 0, 3] = np.nan
    with pytest.raises(DataError, match="does not reach commanded pose '3'"):
        simulate(robot, far, TRACKER, seed=1)
    labels = tuple("abcdefghijklmnopqrst"[: len(far)])
    with pytest.raises(DataError, match="pose 'c'"):
        solve_commanded_poses(robot, far, labels)


def test_machine_that_cannot_reach_its_poses_has_nan_in_its_trial_only(robot):
    values = np.stack([robot.values, robot.values])
    values[1, robot.parameters.index("leg1.length")] += 10.0
    trials = simulate_trials(robot, values, COMMANDED, TRACKER, seed=1)
    assert np.isfinite(trials.measured[0][0]).all()
    assert np.isnan(trials.measured[0][1]).all()
    assert trials.trial(1).n_rows == 0
    with pytest.raises(DataError, match="the true machine does not reach pose '1'"):
        simulate(robot.with_values(values[1]), COMMANDED, TRACKER, seed=1)


def test_readings_outside_the_stroke_are_refused_by_name_value_and_stroke(robot):
    data = simulate(robot, COMMANDED, TRACKER, seed=1)
    check_strokes(data, robot)
    high = robot.actuators[1].stroke[1]
    readings = data.readings.copy()
    readings[3, 1] = high + 0.002
    outside = Measurements(robot.name, readings, data.observations)
    with pytest.raises(DataError) as error:
        check_strokes(outside, robot)
    assert error.value.code == "data.outside-stroke"
    found = error.value.args[0].data
    assert (found["pose"], found["actuator"], found["count"]) == ("4", robot.actuators[1].name, 1)
    assert float(found["reading"]) == pytest.approx(float(found["upper"]) + 2.0)  # [mm]
    assert found["unit"] == "mm"
    check_strokes(outside, robot, allow=True)


def test_readings_of_another_robot_are_refused_with_the_actuators(robot):
    data = Measurements("delta", np.zeros((2, 3)), ())
    with expect_refusal(
        "data.wrong-actuator-count",
        DataError,
        columns=3,
        actuators=tuple(a.name for a in robot.actuators),
    ):
        check_actuators(data, robot)


def test_duplicate_row_is_refused():
    kind = Component(("z",), T_platform_tool=np.eye(4))
    rows = Observations.from_sigma(kind, [0, 1, 2], [[0.123456789], [2.0], [0.123456789]], 1.0)
    once = Measurements("toy", np.array([[1.0], [1.0], [2.0]]), (rows,))
    check_duplicates(once)
    twice = Measurements("toy", np.ones((3, 1)), (rows,))
    with expect_refusal("data.duplicate-rows", DataError, poses=("1", "3")):
        check_duplicates(twice)
    check_duplicates(twice, allow=True)


def test_stated_nuisance_values_are_simulated_and_unknown_names_are_refused(robot):
    tracker = Position(targets=("ball",), unknown=("frame", "targets"), frame="tracker")
    instrument = Instrument((Sensor(tracker, Gaussian(np.full(3, 1e-9))),))
    at = {"tracker.x": 1.0, "tracker.rz": np.pi / 2, "ball.z": 0.1}
    data = simulate(robot, COMMANDED, instrument, seed=1, nuisance_values=at)
    point = (COMMANDED @ [0.0, 0.0, 0.1, 1.0])[:, :3]
    seen = np.stack(
        [point[:, 1], 1.0 - point[:, 0], point[:, 2]], axis=1
    )  # turned by a quarter about z, one metre off
    assert_allclose(data.observations[0].measured, seen, atol=1e-8)
    trials = simulate_trials(robot, robot.values, COMMANDED, instrument, seed=1, nuisance_values=at)
    assert (
        trials.nuisance_parameters.values()[trials.nuisance_parameters.table.index("tracker.x")]
        == 1.0
    )
    with pytest.raises(
        DataError, match=r"no setup parameter 'traker\.x'.*did you mean 'tracker\.x'"
    ):
        simulate(robot, COMMANDED, instrument, seed=1, nuisance_values={"traker.x": 1.0})


def test_sensors_measure_selected_poses_pairs_and_sessions(robot):
    pairs = np.array([[0, 5], [3, 1]])
    bar = Sensor(Separation(), Gaussian(np.array([1e-9])), rows=pairs)
    some = Sensor(
        Position(),
        Gaussian(np.full(3, 1e-9)),
        rows=np.array([2, 2, 7]),
        session=np.array(["a", "a", "b"]),
    )
    every = Sensor(Separation(), Gaussian(np.array([1e-9])))
    data = simulate(robot, COMMANDED, Instrument((bar, some, every)), seed=1)
    place = COMMANDED[:, :3, 3]
    length = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1)
    assert_allclose(data.observations[0].measured[:, 0], length, atol=1e-8)
    assert_allclose(data.observations[1].measured, place[[2, 2, 7]], atol=1e-8)
    assert data.observations[1].session.tolist() == ["a", "a", "b"]
    assert data.observations[2].rows.tolist() == [[i, (i + 1) % 12] for i in range(12)]
    part = data.take([1, 3, 2])
    assert part.observations[0].rows.tolist() == [[1, 0]]
    assert part.observations[1].session.tolist() == ["a", "a"]


def test_streams_of_blocks_are_parts_of_one_philox_stream():
    stream = BlockStream(key=7, block=3)
    first = make_random_stream(stream, 2, 1).standard_normal(5)
    assert_allclose(make_random_stream(stream, 2, 1).standard_normal(5), first)
    others = [
        make_random_stream(stream, 2, 0),
        make_random_stream(stream, 1, 1),
        make_random_stream(BlockStream(7, 4), 2, 1),
        make_random_stream(BlockStream(8, 3), 2, 1),
    ]
    assert all(np.all(other.standard_normal(5) != first) for other in others)
    counter = make_random_stream(stream, 2, 1).bit_generator.state["state"]["counter"]
    assert counter.tolist() == [0, 1, 2, 3]  # 2^64 counts before the next purpose begins


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ("b,0,499.9", "does not reach commanded pose 'b' at poses.csv:4 (1 of 2 fail)"),
        ("b,-100,330", "pose 'b' (poses.csv:4): left reads 157"),
    ],
)
def test_a_refused_pose_is_called_as_in_its_file(
    tmp_path, monkeypatch, capsys, row: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    robot = find_robot_file("five-bar").read_text("utf-8").replace("[45, 225]", "[45, 150]")
    (tmp_path / "robot.yaml").write_text(robot)
    (tmp_path / "poses.csv").write_text(f"## remark\npose,x [mm],y [mm]\na,0,330\n{row}\n")
    poses = "robot.yaml --poses poses.csv --kind position"
    commands = [f"simulate {poses} -o data.csv"]
    commands += [f"identifiability {poses}"] if "commanded" in sentence else []
    for command in commands:
        assert main(command.split()) == 1
        assert sentence in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", ["belt-4", "cable-4"])
def test_skipping_leaves_out_only_poses_that_cannot_be_measured(name):
    """Redundant drives of a true machine contradict each other; its poses are reached all the
    same.
    """
    robot = zoo.load_cached_robot(name)
    instrument = Instrument((Sensor(Position(), Gaussian(np.full(3, 1e-5))),))
    for seed in (1, 2, 3):
        made = [
            simulate_measurements(
                robot, instrument, 30, draw_errors=True, seed=seed, skip_unreachable=skip
            )
            for skip in (False, True)
        ]
        assert not made[1].skipped
        assert_allclose(made[1].data.readings, made[0].data.readings, rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    "kind",
    [Distance(anchor=np.zeros(3), places=np.zeros((1, 3))), Separation(places=np.zeros((1, 3)))],
)
def test_a_length_between_points_that_coincide_is_refused(kind):
    robot = load_robot("agile-eye")  # all its poses have one position
    instrument = Instrument((Sensor(kind, Gaussian(np.full(1, 1e-5))),))
    poses = np.random.default_rng(0).uniform(-0.2, 0.2, (8, 3))
    with expect_refusal("data.simulated-row-impossible", DataError):
        simulate(robot, poses, instrument, seed=1)


def test_a_kind_without_measured_columns_is_simulated():
    robot = load_robot("belt-4")
    poses = sample_workspace(robot, 6, seed=1).coordinates
    data = simulate(robot, poses, Instrument((Sensor(Closure(), Gaussian(np.zeros(0))),)), seed=1)
    assert data.readings.shape == (6, 4)
