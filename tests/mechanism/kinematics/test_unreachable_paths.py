# SPDX-License-Identifier: Apache-2.0
"""Paths that leave the reach of a robot end where they leave it."""

import numpy as np
import pytest

from loopcal import engine
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism import kinematics as reading_paths
from loopcal.mechanism.solutions import forward


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    solve, calls = engine.solve, []

    def counted(*args, **options):
        calls.append(1)
        return solve(*args, **options)

    monkeypatch.setattr(engine, "solve", counted)
    return calls


def test_unreachable_readings_take_few_solutions_and_stay_marked(calls) -> None:
    far = 0.45 * np.array([[1.0, 1.0, 1.0, -1.0, -1.0, -1.0], [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0]])
    robot = load_robot("hexapod-42")
    calls.clear()
    assert not forward(robot, far).converged.any()
    first, last = reading_paths.PATH_STEPS
    assert len(calls) < 1 + first + last  # the finer path ended before its last step


def test_redundant_readings_that_contradict_each_other_take_few_solutions(calls) -> None:
    robot = load_robot("cable-4")
    calls.clear()
    state = forward(robot, np.full((3, 4), 80.0))  # every line half a meter shorter than at home
    assert not state.converged.any()
    first, last = reading_paths.PATH_STEPS
    assert len(calls) < 1 + first + last / 2  # the finer path ended where the gap opened wide
