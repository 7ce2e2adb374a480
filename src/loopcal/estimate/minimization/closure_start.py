# SPDX-License-Identifier: Apache-2.0
"""A start for geometries that are far off: closure linearized at the measured poses.

Where every pose is measured in full and no passive joint is unknown, the loop closure f(x, q, e) =
0 can be written down at the measured x. Its residual is nearly linear in the parameters, so that a
few steps from nominal bring them to within the square of the noise of the least-squares solution,
however far off the predicted poses are (the "implicit loop method", Hollerbach and Wampler, "The
calibration index and taxonomy for robot kinematic calibration methods", International Journal of
Robotics Research 15, 1996). The exact least-squares descent goes on from there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import geometry
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.minimization.descent import Descent, StepControl, descend
from loopcal.estimate.problem import Problem
from loopcal.findings import Finding, report_finding
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray

RELATIVE = 1e-3
"""Share of the residual by which a step may still change it when the exact descent takes over."""

STEPS = 20
"""Newton steps by which a pose is located; a rotation vector takes one, angles a few."""


def descend_from_closure(
    problem: Problem, deviation: FloatArray, method: Method, control: StepControl, tolerance: float
) -> tuple[FloatArray, Descent | None]:
    """Return the deviation (t, p) to which linearized closure leads, and the descent to it.

    Where closure cannot be used this is the deviation that was given, and None.
    """
    located = locate_measured_poses(problem)
    if located is None:
        return deviation, None
    coarse = replace(control, relative=max(control.relative, RELATIVE))
    fit = descend(replace(problem, located=located), deviation, method, coarse, tolerance)
    good = fit.status == DescentStatus.CONVERGED
    return np.where(good[:, None], fit.deviation, deviation), fit


def report_unused_closure(problem: Problem) -> Finding | None:
    """Return why closure cannot be linearized at the measured poses; None where it can."""
    if problem.is_uncertain:
        return report_finding("poses.closure-start-uncertain-readings")
    if locate_measured_poses(problem) is None:
        return report_finding("poses.closure-start-incomplete-poses")
    return None


def locate_measured_poses(problem: Problem) -> FloatArray | None:
    """Return the measured poses T_base_platform (t | 1, n, 4, 4).

    None where readings are uncertain or not all poses are measured in full, in a known frame.
    """
    robot = problem.free.robot
    passive = any(group.unknown_joints(False) for group in robot.program.groups)
    if robot.stages or passive or len(robot.program.freedoms) < 6:
        return None
    if problem.is_uncertain or len(problem.rows) != 1 or problem.nuisance is not None:
        return None
    (rows,) = problem.rows
    t, (r, m) = max(len(rows.measured), len(rows.whitener)), rows.whitener.shape[1:3]
    plain = rows.kind.poses_per_row == 1 and not rows.kind.sensed_joints
    n = problem.readings.shape[1]
    if not (m == 6 and plain and rows.is_present.all()):
        return None
    if not np.array_equal(rows.poses, np.arange(n)):
        return None
    T = np.broadcast_to(robot.home, (t, r, 4, 4))
    for _ in range(STEPS):
        evaluation = rows.kind.evaluate(T, rows.measured)
        solved = np.linalg.solve(evaluation.jacobian, evaluation.residual[..., None])[..., 0]
        step = -np.asarray(solved, dtype=np.float64)
        T = geometry.apply_twist(T, step)
        turn, shift = np.abs(step[..., :3]).max(), np.abs(step[..., 3:]).max()
        if turn < 1e-14 and shift < 1e-14 * robot.size:
            break
    return T if np.isfinite(T).all() else None
