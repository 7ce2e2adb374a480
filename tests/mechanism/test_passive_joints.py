# SPDX-License-Identifier: Apache-2.0
"""Derivatives of passive joints by parameters and readings agree with differences."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.mechanism.compilation import build
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.sensitivity import differentiate_passive_joints
from loopcal.mechanism.solutions import forward, make_solution
from loopcal.units import Dimension
from tests.jacobians import check_jacobian
from tests.mechanism.families.test_gough import CHAIN
from tests.mechanism.kinematics.test_kinematics import sample_inverse


def build_ups_hexapod():
    return build(replace(CHAIN, error_model="complete").expand())


@pytest.mark.parametrize("name", ["mixed_hexapod", "three_prs", "planar_rrr"])
def test_passive_joint_derivatives_agree_with_differences(name):
    robot, sol, _ = sample_inverse(name, 1)
    values, q = robot.values[None], sol.q[None]
    state = forward_trials(robot, values, q, start=sol.state)
    result = differentiate_passive_joints(robot, values, q, state)
    assert result.names == sol.passive_names
    dimensions = [*robot.parameters.dimensions, *(a.dimension for a in robot.actuators)]
    unit = np.array([robot.size if d is Dimension.LENGTH else 1.0 for d in dimensions])
    moved, p = np.diag(unit), values.shape[1]

    def joints(x):  # one trial a parameter or reading
        at = forward_trials(
            robot, values + x[0] * moved[:, :p], q + x[0] * moved[:, None, p:], start=state
        )
        by_limb = sorted(
            (limb, g, k)
            for g, group in enumerate(robot.program.groups)
            for k, limb in enumerate(group.limbs)
        )
        return np.concatenate(
            [
                at.joints[g][:, 0, k, : len(robot.program.groups[g].joints)][
                    :, list_passive_joints(robot, limb)
                ]
                for limb, g, k in by_limb
            ],
            axis=1,
        )

    both = np.concatenate([result.parameters, result.readings], axis=-1)[0, 0] * unit
    check_jacobian(
        joints, both.T[..., None], np.zeros(1), scale=0.1,
        atol=1e-6, atol_reason="closure to 1e-13, condition of platform and limb 30 each, step 1e-4",  # noqa: E501
    )  # fmt: skip


def list_passive_joints(robot, limb):
    return [
        j for j, joint in enumerate(robot.assembly.limbs[limb].joints) if joint.actuator is None
    ]


def test_passive_joint_derivatives_do_not_depend_on_row_blocks():
    robot = build_ups_hexapod()
    q = np.random.default_rng(0).uniform(-0.01, 0.01, (1, 700, 6))
    values = robot.values[None]
    state = forward_trials(robot, values, q)
    whole = differentiate_passive_joints(robot, values, q, state)
    single = forward(robot, q[0, 600:601])
    alone = differentiate_passive_joints(robot, values, q[:, 600:601], single.state)
    # numpy's matmul rounds a batch by its size; a turn per meter is about 10
    assert_allclose(whole.parameters[:, 600:601], alone.parameters, rtol=0, atol=1e-11)
    assert make_solution(robot, state, q[0]).passive_names == whole.names


def test_failed_rows_have_nan_derivatives_of_passive_joints():
    robot, q = build_ups_hexapod(), np.zeros((1, 2, 6))
    q[0, 1, 2] = np.nan
    result = differentiate_passive_joints(
        robot, robot.values[None], q, forward_trials(robot, robot.values[None], q)
    )
    assert np.isfinite(result.parameters[0, 0]).all()
    assert np.isnan(result.parameters[0, 1]).all()


def test_ups_legs_have_no_locked_joint():
    # regression: at slide length zero the universal joint had no effect and both axes were locked
    robot = build_ups_hexapod()
    assert robot.findings == ()
    assert_array_equal([g.locked for g in robot.program.groups], [(False, False, False)])
