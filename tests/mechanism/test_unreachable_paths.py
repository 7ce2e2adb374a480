# SPDX-License-Identifier: Apache-2.0
"""Paths that leave the reach of a robot end where they leave it."""

import numpy as np

from loopcal import engine
from loopcal.io import load_robot
from loopcal.mechanism import batch_kinematics, forward


def test_unreachable_readings_take_few_solutions_and_stay_marked(monkeypatch) -> None:
    robot, solve, calls = load_robot("hexapod-42"), engine.solve, []

    def counted(*args, **options):
        calls.append(1)
        return solve(*args, **options)

    monkeypatch.setattr(engine, "solve", counted)
    far = 0.45 * np.array([[1.0, 1.0, 1.0, -1.0, -1.0, -1.0], [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0]])
    assert not forward(robot, far).converged.any()
    first, last = batch_kinematics.PATH_STEPS
    assert len(calls) < 1 + first + last  # the finer path ended before its last step
