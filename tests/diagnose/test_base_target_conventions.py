# SPDX-License-Identifier: Apache-2.0
"""Targets on the base with places or units that are wrong, beside poses that fit the robot.

The check of conventions compares poses with the robot. Targets on the base say nothing about it.
"""

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.measured_points import report_base_targets
from loopcal.mechanism.workspace import resolve_poses

ROBOT = lc.load_robot("linear-delta")
PLACES = np.array([[0.3, -0.25, 0.0], [0.2, 0.35, 0.05], [-0.35, 0.05, 0.02]])


@pytest.fixture(scope="module")
def data():
    tool = lc.Position(targets=("tool",), unknown=("frame",))
    base = lc.Position(targets=("N1", "N2", "N3"), places=PLACES, unknown=("frame",), of="base")
    sensors = (
        lc.Sensor(tool, lc.Gaussian(np.full(3, 15e-6))),
        lc.Sensor(base, lc.Gaussian(np.full(9, 15e-6)), np.zeros(2, int)),
    )
    return lc.simulate(ROBOT, resolve_poses(ROBOT, 12, 2), lc.Instrument(sensors), 1)


def change_base(data, change):
    (rows,) = data.base_observations
    return replace(data, base_observations=(replace(rows, measured=change(rows.measured)),))


def interchange_two(measured):
    return measured[:, [3, 4, 5, 0, 1, 2, 6, 7, 8]]


@pytest.mark.parametrize("change", [interchange_two, lambda measured: 25.4 * measured])
def test_wrong_targets_on_the_base_do_not_make_poses_implausible(data, change):
    wrong = change_base(data, change)
    assert lc.check_conventions(ROBOT, wrong).finding is None
    (finding,) = report_base_targets(wrong)
    assert finding.code == "residuals.base-targets-moved"


def test_poses_in_another_unit_are_refused_beside_targets_on_the_base(data):
    (rows,) = data.observations
    inches = replace(data, observations=(replace(rows, measured=25.4 * rows.measured),))
    with pytest.raises(lc.DataError, match="mm written as inches"):
        lc.check_conventions(ROBOT, inches)
