# SPDX-License-Identifier: Apache-2.0
"""Shared maps of one kind are evaluated together, also where several lead to one address."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.io.robot.robot_file import load_robot


@pytest.mark.parametrize("is_common", [False, True], ids=["own addresses", "one address"])
def test_shared_maps_add_to_their_addresses(is_common: bool) -> None:
    robot = load_robot("linear-delta")
    slots, values = robot.slots, robot.values + np.array([[0.0], [1e-3]])
    if is_common:
        shared = tuple((of, i, slots.shared[0][2]) for of, i, _ in slots.shared)
        slots = replace(slots, shared=shared)
    parts = [replace(slots, shared=(one,), matrix=0.0 * slots.matrix) for one in slots.shared]
    e, drives = slots(values)
    linear = replace(slots, shared=())
    expected = [linear(values), *(part(values) for part in parts)]
    assert_allclose(e, sum(each[0] for each in expected), atol=1e-15)
    changes = (each[1].tau - slots.terms for each in expected)
    assert_allclose(drives.tau - slots.terms, sum(changes), atol=1e-15)
    jacobians = [linear.jacobian(values), *(part.jacobian(values) for part in parts)]
    assert_allclose(slots.jacobian(values), sum(jacobians), atol=1e-15)
