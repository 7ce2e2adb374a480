# SPDX-License-Identifier: Apache-2.0
"""How far recorded readings are from those that a fit found, actuator by actuator, as readings and
as what they move.

A reading of stated sigma is a measurement with a residual. People judge it by what it moves: a
degree of a motor is a tenth of a millimetre of line on one spool and a millimetre on another. With
the transmission g of the identified robot the residual of the driven joint is g(recorded) -
g(found).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.fit_input import exclude_poses
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism, joints_from_readings
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True)
class ReadingError:
    """Recorded minus found, of one actuator.

    Attributes
    ----------
    name : of the actuator. count : readings that were taken.
    reading, joint : root mean square of the reading and of the joint it drives [SI], of these
        dimensions.
    largest : of the joint, by size, with its sign [SI]. pose : where that is.
    """

    name: str
    count: int
    reading: float
    reading_dimension: Dimension
    joint: float
    joint_dimension: Dimension
    largest: float
    pose: str

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON, SI."""
        words = {
            "reading_dimension": self.reading_dimension.value,
            "joint_dimension": self.joint_dimension.value,
        }
        return {**vars(self), **words}


def compute_reading_errors(
    fit: Identification, data: Measurements
) -> tuple[ReadingError, ...] | None:
    """Compare recorded readings with those found; None where readings were taken for exact.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    """
    if fit.poses is None:
        return None
    recorded, found = exclude_poses(data, fit.excluded_poses).readings, fit.poses.readings
    believed = (
        np.isfinite(fit.poses.sigma)
        & (fit.poses.sigma > 0.0)
        & np.isfinite(recorded)
        & np.isfinite(found)
    )
    off = np.where(believed, recorded - found, np.nan)
    moved = np.where(believed, _joints(fit.robot, recorded) - _joints(fit.robot, found), np.nan)
    drives, labels, errors = _driven(fit.robot), fit.poses.labels, []
    for i, actuator in enumerate(fit.robot.actuators):
        if not believed[:, i].any():
            continue
        worst = int(np.nanargmax(np.abs(moved[:, i])))
        reading, joint = (float(np.sqrt(np.nanmean(part[:, i] ** 2))) for part in (off, moved))
        errors.append(
            ReadingError(
                name=actuator.name,
                count=int(believed[:, i].sum()),
                reading=reading,
                reading_dimension=actuator.dimension,
                joint=joint,
                joint_dimension=drives[actuator.name],
                largest=float(moved[worst, i]),
                pose=labels[worst],
            )
        )
    return tuple(errors) or None


def _joints(robot: Mechanism, readings: FloatArray) -> FloatArray:
    """Values of the driven joints (n, a) at these readings."""
    _, tau = robot.slots(robot.values[None])
    return joints_from_readings(readings[None], tau, robot.slots.frequency)[0]


def _driven(robot: Mechanism) -> dict[str, Dimension]:
    """What each actuator moves: an angle of a turning joint, else a length."""
    limbs = robot.assembly.limbs
    turning = {joint.actuator for limb in limbs for joint in limb.joints if joint.kind == "R"}
    return {
        a.name: Dimension.ANGLE if a.name in turning else Dimension.LENGTH for a in robot.actuators
    }
