# SPDX-License-Identifier: Apache-2.0
"""Driven joints: what parameter values and readings make of a robot before its loops are closed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.transmission.terms import evaluate_sums, joints_from_readings, select_weights
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


class DrivenSums(NamedTuple):
    """What values and readings make of a robot whose readings are fewer sums than its joints.

    e : (t | 1, n_displacements) [m, rad]. sums : (t | 1, n, a) of joint values [m, rad].
    weights : (t | 1, a, n_joints) of the joints in the sums.
    """

    e: FloatArray
    sums: FloatArray
    weights: FloatArray


def drive_sums(robot: Mechanism, values: FloatArray, q: FloatArray) -> DrivenSums:
    """Return displacements and sums for values (t | 1, p) and readings q (t | 1, n, a)."""
    e, tau = robot.slots(values)
    weights = select_weights(tau)
    assert weights is not None
    with np.errstate(invalid="ignore"):  # as in `drive_joints`
        return DrivenSums(e, evaluate_sums(q, tau, robot.slots.frequency), weights)
