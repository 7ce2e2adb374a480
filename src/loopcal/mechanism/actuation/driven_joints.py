# SPDX-License-Identifier: Apache-2.0
"""Driven joints: what parameter values and readings make of a robot before its loops are closed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.transmission.terms import joints_from_readings
from loopcal.typing import FloatArray


class DrivenJoints(NamedTuple):
    """What values and readings make of a robot of one stage.

    e : (t | 1, n_displacements) [m, rad]. tau : (t | 1, a, k) transmission terms.
    joints : (t | 1, n, n_joints) values of the driven joints [m, rad].
    """

    e: FloatArray
    tau: FloatArray
    joints: FloatArray


def drive_joints(robot: Mechanism, values: FloatArray, q: FloatArray) -> DrivenJoints:
    """Return displacements and driven joints for values (t | 1, p) and readings q (t | 1, n, a)."""
    e, tau = robot.slots(values)
    with np.errstate(invalid="ignore"):
        # an infinite reading turns into NaN, and the engine marks its row
        return DrivenJoints(e, tau, joints_from_readings(q, tau, robot.slots.frequency))
