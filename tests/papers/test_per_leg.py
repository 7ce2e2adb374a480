# SPDX-License-Identifier: Apache-2.0
"""Per-leg identification of the 42-parameter hexapod study, at the ten poses of the study."""

import json
from dataclasses import replace

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.published_steps import identify_per_leg
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from tests import zoo
from tests.estimate.problems import bed_points, hexapod, hexapod_poses, simulate_heights, tracker

MM = 1e-3
# Table 4 of the study: the ten commanded poses (x, y, z [mm], roll, pitch, yaw [rad]).
PAPER_POSES = np.array(
    [
        (10, 0, 200, 0.017453292, 0.034907, 0.05236),
        (10, 10, 200, 0.034906584, -0.03491, 0.017453),
        (0, 10, 200, 0.052359877, 0.034907, -0.01745),
        (-10, 10, 200, -0.05235988, -0.01745, 0.017453),
        (-10, 0, 200, -0.01745329, 0.017453, 0.034907),
        (-10, -10, 200, 0.017453292, -0.05236, 0.017453),
        (0, -10, 200, 0.034906584, 0.05236, -0.03491),
        (10, -10, 200, 0.052359877, 0.017453, 0.05236),
        (0, 0, 210, -0.03490658, 0.034907, -0.05236),
        (0, 0, 210, 0.034906584, -0.03491, 0.034907),
    ]
) * np.array([MM, MM, MM, 1, 1, 1])


def test_noise_free_steps_and_conditions_agree_with_the_study():
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    data = simulate(truth, PAPER_POSES, tracker(1e-15, 1e-15), 0)
    found = identify_per_leg(hexapod(), data, steps=3)
    errors = np.abs(found.estimate_history - zoo.hexapod_truth()).max(axis=1) / MM
    assert errors[1] == pytest.approx(1.6e-3, rel=0.1)
    assert errors[2] < 3e-6
    assert errors[3] < 1e-8
    # our own computation, to the three digits that survive the printed rounding of the poses
    np.testing.assert_allclose(found.conditions, [5822, 3501, 4924, 4570, 3385, 4683], rtol=0.01)


def test_per_leg_fit_has_larger_errors_than_the_joint_fit():
    robot = hexapod()
    trials = simulate_trials(
        robot, sample_truth(robot, 12, 0), hexapod_poses(15), tracker(1e-6, 1e-6), 0
    )
    error = {"alone": 0.0, "together": 0.0}
    for i in range(12):
        data, truth = trials.trial(i), trials.truth[i]
        error["alone"] += float(np.sum((identify_per_leg(robot, data).robot.values - truth) ** 2))
        error["together"] += float(np.sum((identify(robot, data).estimate - truth) ** 2))
    assert np.sqrt(error["alone"] / error["together"]) > 1.5


def test_data_and_robots_that_do_not_fit_are_refused():
    robot = zoo.delta()
    with pytest.raises(EstimationError, match=r"3 actuators; .* needs six legs"):
        identify_per_leg(robot, simulate_heights(robot, bed_points(8)))
    data = simulate(hexapod(), PAPER_POSES, tracker(1e-6, 1e-6), 0)
    with pytest.raises(EstimationError, match="6 poses are too few for the 7 parameters of a leg"):
        identify_per_leg(hexapod(), data.take(np.arange(6)))


def test_poses_in_an_unknown_frame_are_refused():
    sensor = tracker(1e-6, 1e-6).sensors[0]
    unknown = Instrument((replace(sensor, kind=replace(sensor.kind, unknown=("frame",))),))
    data = simulate(hexapod(), PAPER_POSES, unknown, 0)
    with pytest.raises(EstimationError, match="known frames, but frame is unknown"):
        identify_per_leg(hexapod(), data)


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(words: str) -> tuple[int, str, str]:
        code = main(words.split())
        return code, *capsys.readouterr()

    return run


def test_per_leg_command_finds_the_true_machine_from_precise_poses(run, tmp_path):
    noise = "--sigma-position 1e-6um --sigma-angle 1e-6urad --distribution uniform"
    words = f"simulate hexapod-42 --draw 12 --draw-errors --truth truth.yaml {noise} -o data.csv"
    assert run(words)[0] == 0
    code, out, err = run("per-leg hexapod-42 data.csv -o legs.yaml")
    assert code == 0, err
    assert "identified leg by leg from 12 full poses: 3 steps" in out
    assert "No uncertainties" in out
    truth, found = (load_robot(tmp_path / f"{name}.yaml") for name in ("truth", "legs"))
    assert np.abs(found.values - truth.values).max() < 1e-9  # [m]
    document = json.loads(run("per-leg hexapod-42 data.csv --json")[1])
    estimates = [row["estimate"] * MM for row in document["parameters"]]
    np.testing.assert_allclose(estimates, found.values, atol=1e-12)


@pytest.mark.parametrize(
    ("robot", "how", "message"),
    [
        ("hexapod-42", "--kind position", "needs full poses of one kind"),
        ("3-prs", "", "has 3 actuators"),
        ("hexapod-42", "--draw 6", "6 poses are too few for the 7 parameters of a leg"),
    ],
)
def test_per_leg_command_refuses_what_does_not_decouple(run, robot, how, message):
    assert run(f"simulate {robot} --draw 12 {how} -o data.csv")[0] == 0
    code, out, err = run(f"per-leg {robot} data.csv")
    assert (code, out) == (1, "")
    assert message in " ".join(err.split())
