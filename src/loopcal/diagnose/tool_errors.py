# SPDX-License-Identifier: Apache-2.0
"""What the parameters, the frame and the readings of a calibrated robot do to its tool at poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.diagnose.error_frames import choose_error_frame, list_error_twists, solve_home
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.findings import Finding
from loopcal.measure import Measurements
from loopcal.mechanism import Solution, differentiate_pose, forward
from loopcal.numerics.sorted_values import find_distinct
from loopcal.typing import FloatArray, IntArray

MOST_POSES = 1000
"""Measured poses, evenly chosen, by which two uncertainties are compared: ratios over more poses
hardly differ.
"""


class ToolErrors(NamedTuple):
    """Twists (n, 6, ..) of the tool point in a frame: by the parameters in the units of the
    posterior without its discrepancy, by independent errors of the frame itself, by the readings in
    their sigmas, and by independent errors of the model discrepancy.
    """

    by_parameters: FloatArray
    by_frame: FloatArray
    by_readings: FloatArray
    by_discrepancy: FloatArray
    reference: Finding


def linearize_tool_errors(posterior: Posterior, solution: Solution, frame: str) -> ToolErrors:
    """Return the derivatives of the errors of the tool at poses, and the frame in words.

    Parameters
    ----------
    solution : poses that the calibrated robot reaches.
    frame : see `choose_error_frame`; "relative" means relative to the home pose.

    Raises
    ------
    EstimationError : no such frame.
    """
    robot = posterior.robot
    chosen = choose_error_frame(posterior, frame, solve_home(robot), "home")
    S = differentiate_pose(robot, robot.values[None], solution.q[None], solution.state)
    D = list_error_twists(posterior, solution.T, S.parameters[0][..., posterior.places])
    H = geometry.transport_matrix(solution.T[:, :3, :3] @ robot.tool[:3, 3])
    p, by_errors = len(posterior.unit), H @ chosen.relate(D, solution.T)
    by_discrepancy = by_errors[..., p:]
    if posterior.discrepancy is not None:
        rest = H @ posterior.discrepancy.errors.rest(solution.T)
        by_discrepancy = np.concatenate([by_discrepancy, rest], axis=2)
    return ToolErrors(
        by_errors[..., :p],
        H @ chosen.own_errors(solution.T),
        H @ (S.readings[0] * robot.stated_sigma),
        by_discrepancy,
        chosen.describe(axes=""),
    )


def locate_measured_poses(
    fit: Identification, data: Measurements, most: int | None = None
) -> Solution:
    """Return the measured poses that the calibrated robot reaches, or `most`, evenly chosen."""
    readings = data.readings if fit.poses is None else fit.poses.readings[fit.poses.kept]
    readings = readings[np.isfinite(readings).all(axis=1)]
    if most is not None:
        readings = readings[choose_evenly(len(readings), most)]
    solution = forward(fit.robot, readings)
    return solution.take(np.flatnonzero(solution.converged))


def choose_evenly(count: int, most: int) -> IntArray:
    """Return at most so many of the numbers below `count`, evenly chosen."""
    return find_distinct(np.linspace(0, count - 1, min(most, count)).astype(np.int64))
