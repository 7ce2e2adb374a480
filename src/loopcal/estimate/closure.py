# SPDX-License-Identifier: Apache-2.0
"""A better start for least squares: closure linearised at the measured poses instead of the
predicted ones.

Where every pose is measured in full and no passive joint is unknown, the loop closure f(x, q, e) =
0 can be written down at the measured x. Its residual is nearly linear in the parameters, so that a
few steps from nominal bring them to within the square of the noise of the least-squares solution,
however far off the predicted poses are (the "implicit loop method", Hollerbach and Wampler, "The
calibration index and taxonomy for robot kinematic calibration methods", International Journal of
Robotics Research 15, 1996). The exact least-squares descent goes on from there.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from loopcal import geometry
from loopcal.estimate.descent import Descent, DescentStatus, StepControl, descend
from loopcal.estimate.latent import LatentRows
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.rows import AnyRows, Rows
from loopcal.typing import FloatArray

RELATIVE = 1e-3
"""Share of the residual by which a step may still change it when the exact descent takes over."""

STEPS = 20
"""Newton steps by which a pose is located; one is enough for a rotation vector, a few for angles.
"""


def descend_from_closure(
    rows: AnyRows, start: FloatArray, method: Method, control: StepControl, tolerance: float
) -> tuple[FloatArray, Descent | None]:
    """Return the deviation (t, p) to which the linearised closure leads, and how; `start` itself
    where it cannot.
    """
    located = None if isinstance(rows, LatentRows) else locate(rows)
    if located is None or isinstance(rows, LatentRows):
        return start, None
    problem = Rows(rows.unknowns, rows.readings, rows.sensed, rows.rows.size, located)
    coarse = dataclasses.replace(control, relative=max(control.relative, RELATIVE))
    fit = descend(problem, start, method, coarse, tolerance)
    good = fit.status == DescentStatus.CONVERGED
    return np.where(good[:, None], fit.deviation, start), fit


def not_used(rows: AnyRows) -> str:
    """Return why closure cannot be linearised at the measured poses; empty where it can."""
    if isinstance(rows, LatentRows):
        return (
            "begin closure was not used: it needs exact readings; the fit began with the kinematics"
        )
    if locate(rows) is None:
        whole = "one kind that measures all poses in full, in a known frame, of a robot with six freedoms and no passive joints"
        return f"begin closure was not used: it needs {whole}; the fit began with the kinematics"
    return ""


def locate(rows: Rows) -> FloatArray | None:
    """Return the measured poses T_base_platform (t | 1, n, 4, 4); None where they are not all
    measured in full.
    """
    robot = rows.unknowns.robot
    passive = any(group.unknown_joints(False) for group in robot.program.groups)
    if passive or len(robot.program.freedoms) < 6 or len(rows.sensed) != 1 or rows.own is not None:
        return None
    (sensed,) = rows.sensed
    t, r, m = sensed.whitener.shape[:3]
    full = (
        m == 6
        and not rows.joints
        and sensed.kind.poses_per_row == 1
        and (np.einsum("trii->tri", sensed.whitener) != 0.0).all()
    )
    if not full or not np.array_equal(sensed.poses, np.arange(len(rows.readings))):
        return None
    T = np.broadcast_to(robot.home, (t, r, 4, 4))
    for _ in range(STEPS):
        seen = sensed.kind.evaluate(T, sensed.measured)
        step: FloatArray = -np.linalg.solve(seen.jacobian, seen.residual[..., None])[..., 0].astype(
            np.float64
        )
        T = geometry.apply_twist(T, step)
        if np.abs(step[..., :3]).max() < 1e-14 and np.abs(step[..., 3:]).max() < 1e-14 * robot.size:
            break
    return T if np.isfinite(T).all() else None
