# SPDX-License-Identifier: Apache-2.0
"""What a target costs that a robot does not reach, against one that it reaches, for every shipped
robot.

Targets are positions 8 m away, coordinates 10 % beyond the workspace, and poses turned by 170
degrees. Those that do not converge count, whatever the reason: out of reach, or in another mode.
"""

import time

import numpy as np

from benchmarks.harness import Metric, time_once
from loopcal import geometry
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import inverse
from loopcal.typing import FloatArray

ROWS = 32
"""Targets of each kind, and rows of a batch."""
SINGLE = 4
"""Targets of each kind that are solved one by one."""
REPEATS = 2
"""Times of each measurement, of which the shortest counts."""
AWAY = 8.0
"""Distance of positions [m]."""
BEYOND = 1.1
"""Size of the ranges of coordinates relative to the workspace."""
TURN = np.radians(170)


def bench_unreachable() -> list[Metric]:
    """Time of an unreachable row over that of a reachable one, alone and in a batch; the worst."""
    alone, together = {}, {}
    for name in list_shipped_robots():
        robot = load_robot(name)
        pairs = list_targets(robot)
        if pairs:
            alone[name] = max(compare_single_rows(robot, *pair) for pair in pairs)
            together[name] = max(compare_batches(robot, *pair) for pair in pairs)
    return [
        make_metric("kinematics.unreachable", alone),
        make_metric("kinematics.unreachable_batch", together),
    ]


def make_metric(name: str, ratios: dict[str, float]) -> Metric:
    """Return the worst ratio, with those of all robots as a note."""
    ordered = sorted(ratios.items(), key=lambda item: -item[1])
    note = ", ".join(f"{robot} {ratio:.3g}" for robot, ratio in ordered)
    return Metric(name, ordered[0][1], tolerance=0.5, note=note)


def list_targets(robot: Mechanism) -> list[tuple[FloatArray, FloatArray]]:
    """Return pairs of reachable targets and of those that are not reached, of the same kind."""
    rng = np.random.default_rng(0)
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    middle, half = ranges.mean(axis=1), (ranges[:, 1] - ranges[:, 0]) / 2
    near = middle + half * rng.uniform(-1.0, 1.0, (ROWS, len(half)))
    poses = inverse(robot, near).T
    edge = rng.uniform(-1.0, 1.0, near.shape)
    edge *= BEYOND / np.abs(edge).max(axis=1, keepdims=True)
    turned = poses.copy()
    turned[:, :3, :3] = geometry.exp_so3(TURN * draw_directions(rng, 3)) @ poses[:, :3, :3]
    kinds = [(near, middle + half * edge), (poses, turned)]
    axes = [i for i, name in enumerate(robot.controlled) if name in ("x", "y", "z")]
    if axes:
        away = near.copy()
        away[:, axes] += AWAY * draw_directions(rng, len(axes))
        kinds.append((near, away))
    failed = [(reached, far[~inverse(robot, far).converged]) for reached, far in kinds]
    return [(reached, rows) for reached, rows in failed if len(rows)]


def draw_directions(rng: np.random.Generator, n: int) -> FloatArray:
    """Draw unit vectors (ROWS, n)."""
    vectors = rng.normal(size=(ROWS, n))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def compare_single_rows(robot: Mechanism, reached: FloatArray, failed: FloatArray) -> float:
    """Return the ratio of the mean times of rows that are solved one by one."""

    def measure(rows: FloatArray) -> float:
        return float(np.mean([measure_rows(robot, row[None]) for row in rows[:SINGLE]]))

    return measure(failed) / measure(reached)


def compare_batches(robot: Mechanism, reached: FloatArray, failed: FloatArray) -> float:
    """Return the ratio of the times of batches of equal size."""
    repeated = failed[np.resize(np.arange(len(failed)), len(reached))]
    return measure_rows(robot, repeated) / measure_rows(robot, reached)


def measure_rows(robot: Mechanism, rows: FloatArray) -> float:
    """Return the shortest time of inverse kinematics of rows [s], of this process alone."""
    return min(time_once(lambda: inverse(robot, rows), time.process_time) for _ in range(REPEATS))
