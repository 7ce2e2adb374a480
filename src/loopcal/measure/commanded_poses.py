# SPDX-License-Identifier: Apache-2.0
"""Commanded poses instead of readings: the controller's own geometry says what the actuators did."""

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.mechanism import Mechanism, Solution, inverse
from loopcal.typing import FloatArray


def solve_commanded_readings(
    controller: Mechanism, commanded: ArrayLike, labels: tuple[str, ...] = ()
) -> FloatArray:
    """Actuator readings with which a controller answers commanded poses.

    Parameters
    ----------
    controller : Mechanism
        The geometry the controller computes with, usually the nominal robot.
    commanded : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI]
    labels : tuple of str, optional
        Names of the poses for messages; default "1", "2", ...

    Returns
    -------
    readings : (n, a) [SI]

    Raises
    ------
    DataError
        If the controller's geometry does not reach a pose.
    """
    return solve_commanded_poses(controller, commanded, labels).q


def solve_commanded_poses(
    controller: Mechanism, commanded: ArrayLike, labels: tuple[str, ...] = ()
) -> Solution:
    """`solve_commanded_readings`, with the poses and passive joints that belong to the readings.

    Raises
    ------
    DataError
        If the controller's geometry does not reach a pose.
    """
    solution = inverse(controller, commanded)
    failed = np.flatnonzero(~solution.converged)
    if len(failed):
        first = int(failed[0])
        name = labels[first] if labels else str(first + 1)
        raise DataError(
            f"{controller.name!r} cannot be commanded to pose {name!r} ({len(failed)} of "
            f"{len(solution.q)} fail):"
            f" {solution.explain(first)}; correct the pose, or the geometry of the controller"
        )
    return solution
