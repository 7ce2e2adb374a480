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
from loopcal.studies.simulation.published_steps import identify_per_leg
from tests import zoo
from tests.estimate.problems import bed_points, hexapod, hexapod_poses, simulate_heights, tracker

MM = 1e-3


def test_data_and_robots_that_do_not_fit_are_refused():
    robot = zoo.delta()
    with pytest.raises(EstimationError, match=r"3 actuators; .* needs six legs"):
        identify_per_leg(robot, simulate_heights(robot, bed_points(8)))
    precise, poses = tracker(1e-6, 1e-6), hexapod_poses(7)
    data = simulate(hexapod(), poses, precise, 0)
    with pytest.raises(EstimationError, match="6 poses are too few for the 7 parameters of a leg"):
        identify_per_leg(hexapod(), data.take(np.arange(6)))
    kind = replace(precise.sensors[0].kind, unknown=("frame",))
    unknown = Instrument((replace(precise.sensors[0], kind=kind),))
    with pytest.raises(EstimationError, match="known frames, but frame is unknown"):
        identify_per_leg(hexapod(), simulate(hexapod(), poses, unknown, 0))


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
