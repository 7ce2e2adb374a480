# SPDX-License-Identifier: Apache-2.0
"""Per-leg identification: what it refuses, and its command; test_hexapod_42.py has its numbers."""

import json
from dataclasses import replace

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import EstimationError
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import ParameterTable
from loopcal.studies.simulation.published_steps import identify_per_leg, integrate_errors
from tests import zoo
from tests.estimate.problems import bed_points, hexapod, hexapod_poses, simulate_heights, tracker

MM = 1e-3


def test_data_and_robots_that_do_not_fit_are_refused():
    robot = zoo.delta()
    with pytest.raises(EstimationError, match=r"3 actuators, .* needs six legs") as refused:
        identify_per_leg(robot, simulate_heights(robot, bed_points(8)))
    assert refused.value.code == "fit.no-six-legs"
    precise, poses = tracker(1e-6, 1e-6), hexapod_poses(7)
    data = simulate(hexapod(), poses, precise, 0)
    with pytest.raises(EstimationError, match="6 poses are too few for the 7 parameters of a leg"):
        identify_per_leg(hexapod(), data.take(np.arange(6)))
    kind = replace(precise.sensors[0].kind, unknown=("frame",))
    unknown = Instrument((replace(precise.sensors[0], kind=kind),))
    with pytest.raises(EstimationError, match="known frames, but frame is unknown"):
        identify_per_leg(hexapod(), simulate(hexapod(), poses, unknown, 0))


def test_epsilon_ends_the_steps_at_the_error_of_poses_or_at_the_size_of_a_step():
    robot, precise = hexapod(), tracker(1e-15, 1e-15)
    truth = robot.with_values(robot.values + 1e-4 * np.cos(np.arange(len(robot.values))))
    data = simulate(truth, hexapod_poses(12), precise, 0, robot)
    every = identify_per_leg(robot, data, 6)
    assert (every.steps, every.is_converged) == (6, True)
    errors = every.integrated_errors  # [mm + rad]
    assert len(errors) == 7
    assert errors[2] < 1e-3 * errors[1] < 1e-5 * errors[0]
    for k in (1, 2):
        stopped = identify_per_leg(robot, data, 6, epsilon=1.01 * errors[k])
        assert (stopped.steps, stopped.is_converged) == (k, True)
        np.testing.assert_array_equal(stopped.estimate_history, every.estimate_history[: k + 1])
    change = np.abs(np.diff(every.estimate_history, axis=0)).max(axis=1) / MM
    sized = identify_per_leg(robot, data, 6, epsilon=1.01 * change[1], stop="step")
    assert (sized.steps, sized.is_converged) == (2, True)
    assert change[1] > errors[2]  # the rules differ
    short = identify_per_leg(robot, data, 1, epsilon=0.9 * errors[1])
    assert (short.steps, short.is_converged) == (1, False)
    for wrong in (np.nan, np.inf, -1.0):
        with pytest.raises(EstimationError, match=f"epsilon is {wrong}. Give a finite number"):
            identify_per_leg(robot, data, epsilon=wrong)


def test_integrated_error_adds_millimeters_and_radians_of_the_worst_pose():
    errors = np.array([[3e-3, 4e-3, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1e-3, 0.3, 0.0, 0.4]])
    assert integrate_errors(errors) == pytest.approx(5.0)
    assert integrate_errors(errors[1:]) == pytest.approx(1.5)


def test_fixed_parameters_stay_and_the_others_are_identified():
    robot = load_robot("hexapod-42")
    fixed = ("leg1.platform.z", "leg4.length")
    entries = tuple(replace(p, free=p.name not in fixed) for p in robot.parameters.entries)
    robot = replace(robot, parameters=ParameterTable(entries, robot.parameters.common))
    places = [robot.parameters.index(name) for name in fixed]
    values = robot.values + np.where(robot.parameters.free, 2e-5, 0.0)
    poses = sample_workspace(robot, 12, 0).coordinates
    data = simulate(robot.with_values(values), poses, tracker(1e-12, 1e-12), 0, robot)
    estimate = identify_per_leg(robot, data, 4)
    found = estimate.robot.values
    rows = {row["name"]: row for row in estimate.list_parameters()}
    assert rows["leg4.length"]["estimate"] == rows["leg4.length"]["nominal"]
    np.testing.assert_array_equal(found[places], robot.values[places])
    np.testing.assert_allclose(found, values, rtol=0, atol=1e-9)  # [m], noise of 1e-12


def test_steps_that_diverge_are_refused_with_their_number():
    robot = load_robot("hexapod-octahedral")
    poses = sample_workspace(robot, 12, 0).coordinates
    errors = 0.04 * np.random.default_rng(0).normal(size=len(robot.values))  # [m], a tenth of it
    data = simulate(robot, poses, tracker(1e-9, 1e-9), 0)
    with pytest.raises(EstimationError, match=r"diverged: .* corrected by \d steps?, cannot reach"):
        identify_per_leg(robot.with_values(robot.values + errors), data, 9)


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
    assert "max dQint" in out
    truth, found = (load_robot(tmp_path / f"{name}.yaml") for name in ("truth", "legs"))
    assert np.abs(found.values - truth.values).max() < 1e-9  # [m]
    document = json.loads(run("per-leg hexapod-42 data.csv --json")[1])
    estimates = [row["estimate"] * MM for row in document["parameters"]]
    np.testing.assert_allclose(estimates, found.values, atol=1e-12)


def test_per_leg_command_shows_values_that_are_zero_but_for_rounding_as_zero(run):
    noise = "--sigma-position 1e-6um --sigma-angle 1e-6urad"
    assert run(f"simulate hexapod-42 --draw 12 {noise} -o d.csv")[0] == 0
    rows = [line.split() for line in run("per-leg hexapod-42 d.csv")[1].splitlines()]
    shown = {words[0]: words[3] for words in rows if len(words) == 5 and words[1] == "mm"}
    assert len(shown) == 42
    assert shown["leg1.base.z"] == "0"
    assert shown["leg1.base.x"] == "120"


def test_per_leg_command_ends_by_epsilon_and_says_where_it_is_not_met(run):
    noise = "--sigma-position 1um --sigma-angle 1urad"
    assert run(f"simulate hexapod-42 --draw 12 --draw-errors {noise} -o data.csv")[0] == 0
    code, out, err = run("per-leg hexapod-42 data.csv --steps 9 --epsilon 0.01")
    assert (code, err) == (0, "")
    assert "12 full poses: 1 step\n" in out
    code, out, err = run("per-leg hexapod-42 data.csv --steps 9 --epsilon 1e-6 --json")
    document = json.loads(out)
    (finding,) = document["input_findings"]
    assert (code, document["steps"], document["is_converged"]) == (0, 9, False)
    assert finding["code"] == "fit.epsilon-not-met"
    assert finding["data"]["reached"] == document["integrated_errors"][-1]
    assert "Not converged: after 9 steps" in err
    for wrong in ("0", "-1", "nan"):
        assert run(f"per-leg hexapod-42 data.csv --epsilon {wrong}")[0] == 1


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
