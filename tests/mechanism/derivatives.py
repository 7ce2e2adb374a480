# SPDX-License-Identifier: Apache-2.0
"""The check that derivatives of poses are those of forward kinematics."""

import numpy as np

from loopcal import geometry
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.units import Dimension
from tests.jacobians import check_jacobian


def check_pose_derivatives(machine: Mechanism, q: np.ndarray) -> None:
    """Fail unless the derivatives of poses by parameters and readings (1, n, a) agree with central
    differences.
    """
    values = machine.values
    state = forward_trials(machine, values[None], q)
    known = differentiate_pose(machine, values[None], q, state)

    def by_value(x: np.ndarray) -> np.ndarray:
        return geometry.pose_difference(forward_trials(machine, x, q, state).T, state.T[0])

    def by_reading(x: np.ndarray) -> np.ndarray:
        moved = forward_trials(machine, values[None], q + x[:, None], state)
        return geometry.pose_difference(moved.T, state.T[0])

    # the difference of two rotations is a logarithm, whose slope at zero is the angular velocity
    unit = {Dimension.LENGTH: 0.02 * machine.size, Dimension.FORCE: 50.0}
    unit |= {Dimension.LENGTH_PER_FORCE: 1e-4 * machine.size, Dimension.ANGLE_PER_MOMENT: 1e-4}
    zero = np.zeros(len(machine.actuators))
    for function, slopes, start, dimensions in (
        (by_value, known.parameters, values, machine.parameters.dimensions),
        (by_reading, known.readings, zero, [a.dimension for a in machine.actuators]),
    ):
        check_jacobian(
            function,
            slopes[0],
            start,
            scale=np.array([unit.get(d, 0.02) for d in dimensions]),
            atol=1e-9 * machine.size,
            atol_reason="[m] Newton's own accuracy over the smallest step",
            is_batched=True,
        )
