# SPDX-License-Identifier: Apache-2.0
"""Compute the errors of recorded actuator readings, per actuator and in terms of the driven joint.

A reading of stated sigma is a measurement with a residual. Its effect matters more than its size: a
degree of a motor is a tenth of a millimeter of line on one spool and a millimeter on another. With
the transmission g of the identified robot the residual of the driven joint is g(recorded) -
g(estimated).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.fit_input import exclude_poses
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism, transmit_readings
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True)
class ReadingError:
    """Recorded minus estimated readings of one actuator.

    Attributes
    ----------
    name : of the actuator. count : number of readings.
    reading, joint : root mean square of the reading and of the driven joint [SI], of these
        dimensions.
    largest : of the joint, by size, with its sign [SI]. pose : label of its pose.
    """

    name: str
    count: int
    reading: float
    reading_dimension: Dimension
    joint: float
    joint_dimension: Dimension
    largest: float
    pose: str


def compute_reading_errors(
    fit: Identification, data: Measurements
) -> tuple[ReadingError, ...] | None:
    """Compare recorded readings with the estimated ones; None where the readings are exact.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    """
    if fit.poses is None:
        return None
    robot, estimated, sigma = fit.robot, fit.poses.readings, fit.poses.sigma
    recorded = exclude_poses(data, fit.options.excluded_poses).readings
    compared = np.isfinite(sigma) & (sigma > 0.0) & np.isfinite(recorded) & np.isfinite(estimated)
    reading = np.where(compared, recorded - estimated, np.nan)
    joint = np.where(
        compared, _joint_values(robot, recorded) - _joint_values(robot, estimated), np.nan
    )
    limbs = robot.assembly.limbs
    turning = {joint.actuator for limb in limbs for joint in limb.joints if joint.kind == "R"}
    dimensions = [
        Dimension.LENGTH if turning.isdisjoint(a.driven_joints) else Dimension.ANGLE
        for a in robot.actuators
    ]
    errors = []
    for i, actuator in enumerate(robot.actuators):
        if not compared[:, i].any():
            continue
        worst = int(np.nanargmax(np.abs(joint[:, i])))
        errors.append(
            ReadingError(
                name=actuator.name,
                count=int(compared[:, i].sum()),
                reading=float(np.sqrt(np.nanmean(reading[:, i] ** 2))),
                reading_dimension=actuator.dimension,
                joint=float(np.sqrt(np.nanmean(joint[:, i] ** 2))),
                joint_dimension=dimensions[i],
                largest=float(joint[worst, i]),
                pose=fit.poses.labels[worst],
            )
        )
    return tuple(errors) or None


def _joint_values(robot: Mechanism, readings: FloatArray) -> FloatArray:
    """Return the values (n, a) of the driven joints, or their sums, at these readings."""
    _, tau = robot.slots(robot.values[None])
    return transmit_readings(readings[None], tau, robot.slots.frequency)[0]
