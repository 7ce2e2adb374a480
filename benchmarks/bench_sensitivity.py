# SPDX-License-Identifier: Apache-2.0
"""Sensitivities of a hexapod whose legs are chains, all displacements, against np.linalg.solve of
as many 6 x 6 systems; and the first answer of a mechanism that has never been seen.
"""

import numpy as np

from benchmarks.harness import Metric, measure_ratio, measure_time
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.assembly import Assembly
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward

POSES = 10_000


def _record() -> Gough:
    """The shipped hexapod with `legs: ups` and `error_model: complete`."""
    rod = load_robot("hexapod-42").assembly
    return Gough(
        name="hexapod-ups",
        base=tuple(tuple(limb.links[0].transform[:3, 3].tolist()) for limb in rod.limbs),
        platform=tuple(tuple(limb.attachment.transform[:3, 3].tolist()) for limb in rod.limbs),
        lengths=tuple(limb.length for limb in rod.limbs),
        home=load_robot("hexapod-42").record.record.home,
        legs="ups",
        error_model="complete",
    )


def _first_answer(assembly: Assembly) -> Mechanism:
    """Build a mechanism and ask it for one pose."""
    robot = build(assembly)
    forward(robot, np.full((1, 6), 1e-3))
    return robot


def bench_sensitivity() -> Metric:
    """Time the sensitivities to 102 parameters (all displacements of six chains) at ten thousand
    poses.
    """
    robot, rng = _first_answer(_record().expand()), np.random.default_rng(0)
    values, q = robot.values[None], rng.uniform(-0.02, 0.02, (1, POSES, 6))
    state = forward_trials(robot, values, q)
    A, b = rng.normal(size=(POSES, 6, 6)), rng.normal(size=(POSES, 6, 1))
    return measure_ratio(
        "sensitivity.ups_hexapod",
        lambda: differentiate_pose(robot, values, q, state),
        lambda: np.linalg.solve(A, b),
        limit=80.0,
    )


def bench_first_answer() -> list[Metric]:
    """Time the first call of a new mechanism: build with home and all checks, and one forward
    solution, against a thousand calls of numpy for one small system.
    """
    assembly, rng = _record().expand(), np.random.default_rng(0)
    A, b = rng.normal(size=(6, 6)), rng.normal(size=6)
    return measure_time(
        "sensitivity.first_answer",
        lambda: _first_answer(assembly),
        lambda: [np.linalg.solve(A, b) for _ in range(1000)],
        limit=10.0,
        unit="ms",
        reference_name="thousand_solves",
        repeats=31,
        tolerance=0.5,
    )
