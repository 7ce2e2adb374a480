# SPDX-License-Identifier: Apache-2.0
"""How fast kinematics is: poses a second against as many 6x6 systems solved by numpy in the same
run.
"""

from pathlib import Path

import numpy as np

from benchmarks.harness import Metric, measure_ratio
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse

ROBOT = Path(__file__).resolve().parent.parent / "src" / "loopcal" / "robots" / "hexapod-42.yaml"
POSES = 10_000


def _problem() -> tuple[Mechanism, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The hexapod, random coordinates in its workspace with their readings, and as many 6x6
    systems.
    """
    rng, robot = np.random.default_rng(0), load_robot(ROBOT)
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    target = rng.uniform(ranges[:, 0], ranges[:, 1], (POSES, 6))
    return (
        robot,
        target,
        inverse(robot, target).q,
        rng.normal(size=(POSES, 6, 6)),
        rng.normal(size=(POSES, 6, 1)),
    )


def bench_forward() -> Metric:
    """Forward kinematics of 10 000 hexapod poses from home, to rounding."""
    robot, _, readings, A, b = _problem()
    return measure_ratio(
        "kinematics.forward",
        lambda: forward(robot, readings),
        lambda: np.linalg.solve(A, b),
        limit=20.0,
        tolerance=0.3,
    )


def bench_inverse() -> Metric:
    """Inverse kinematics of 10 000 hexapod poses."""
    robot, target, _, A, b = _problem()
    return measure_ratio(
        "kinematics.inverse",
        lambda: inverse(robot, target),
        lambda: np.linalg.solve(A, b),
        tolerance=0.3,
    )
