# SPDX-License-Identifier: Apache-2.0
"""Input of a plan: prediction poses, earlier measurements and the observable parameters."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.information import observe_poses
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.kinds import KINDS
from loopcal.mechanism.workspace import sample_workspace
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.pose_planning import round_shortfall
from loopcal.planning.problem import find_sample_size, prepare_problem
from tests.findings.expectations import expect_refusal

UM, URAD = 1e-6, 1e-6
FEW = PlanOptions(n_candidates=20)


def build_instrument(kind: str, sigma: float = 10 * UM, **settings) -> lc.Instrument:
    """Return an instrument of one kind with one sigma."""
    made = KINDS[kind](**settings)
    return lc.Instrument((lc.Sensor(made, lc.Gaussian(np.full(len(made.noise_columns), sigma))),))


def test_prediction_poses_depend_neither_on_constraints_nor_on_candidates():
    robot, sight = (
        load_robot("hexapod-42"),
        lc.LineOfSight(np.array([0.5, -0.3, 0.6]), np.array([0.0, 0.0, 1.0]), np.radians(60.0)),
    )
    free, other, narrow = (
        prepare_problem(
            robot,
            build_instrument("pose"),
            PlanOptions(constraints=constraints, n_candidates=count),
        )
        for constraints, count in (
            (lc.Constraints(), 30),
            (lc.Constraints(), 60),
            (lc.Constraints(0.3, np.radians(12.0), sight), 30),
        )
    )
    for made in (other, narrow):
        assert_allclose(made.prediction.pose, free.prediction.pose, atol=1e-12)  # [m] per tolerance
    assert len(free.prediction) == 200


def test_prediction_poses_are_spread_over_a_long_list_of_poses():
    robot = load_robot("linear-delta")
    listed = sample_workspace(robot, 260, seed=3).coordinates
    listed = listed[np.lexsort(listed.T[::-1])]
    made = prepare_problem(robot, build_instrument("position"), PlanOptions(allowed_poses=listed))
    free = select_free_parameters(robot)
    twists = observe_poses(free, lc.inverse(robot, listed[200:]).q).twists[0, :, 3:]
    # the instrument determines all nine parameters: nothing is projected out of the prediction
    # [m] per tolerance
    found = [
        np.abs(made.prediction.displacements - one).max(axis=(1, 2)).min() < 1e-9 for one in twists
    ]
    assert len(made.prediction) == 200
    # the last 60 of the list: with 200 of 260 drawn, 46 of them expected with a standard deviation
    # of 2.9
    assert sum(found) > 30


@pytest.mark.parametrize("kind", ["locked", "joint", "inclination"])
def test_instrument_without_information_is_refused(kind):
    with expect_refusal("plan.nothing-observable", kinds=(kind,), parameters=9):
        prepare_problem(load_robot("linear-delta"), build_instrument(kind), FEW)


def test_earlier_equations_are_counted_less_their_setup_parameters():
    robot = load_robot("linear-delta")
    poses = sample_workspace(robot, 5, seed=3).coordinates
    before = lc.simulate(robot, poses, build_instrument("position", unknown=("frame",)), seed=1)
    made = prepare_problem(robot, build_instrument("position"), replace(FEW, measured=before))
    assert made.n_earlier_equations == 15 - 6


def test_orientation_goal_for_a_robot_without_rotation_is_refused():
    options = replace(FEW, goal=10 * URAD, target="orientation")
    with expect_refusal("plan.target-unobservable", target="orientation", robot="linear-delta"):
        lc.plan(load_robot("linear-delta"), build_instrument("position"), options=options)


def test_finding_states_that_equations_decide_the_number_of_poses():
    options = replace(FEW, goal=100 * UM, target="position")
    made = prepare_problem(
        load_robot("linear-delta"), build_instrument("position", 0.1 * UM), options
    )
    found = find_sample_size(made)
    assert found.enough == 3
    finding = found.report(made.robot)
    assert finding.code == "plan.goal-reached"
    assert finding.data["number"] == 3
    assert finding.data["decided_by_equations"]


def test_efficiency_shortfall_is_rounded_up():
    assert [round_shortfall(share) for share in (0.99965, 1.0, 0.5)] == [0.1, 0.0, 50.0]


def test_planned_poses_get_unused_names():
    robot = load_robot("linear-delta")
    poses = sample_workspace(robot, 12, seed=3).coordinates
    before = lc.simulate(robot, poses, build_instrument("position"), seed=1)
    options = PlanOptions(
        n_poses=3, hold_out=0, measured=before, n_candidates=20, used_names=("14", "p3")
    )
    found = lc.plan(robot, build_instrument("position"), options=options)
    assert found.poses.labels == ("15", "16", "17")


def test_planned_readings_are_rounded_to_a_nanometer_in_files_in_meters(tmp_path):
    (tmp_path / "metres.yaml").write_text(
        "format: 1\nfamily: linear-delta\nname: metres\nunits: {length: m, angle: deg}\nradius: "
        "0.105\n"
        "angles: [210, 330, 90]\narms: 0.22\nstops: 0.3\nreadings: drop\nstroke: [0, 0.4]\nhome: "
        "{z: 0.12}\n"
        "workspace: {x: [-0.06, 0.06], y: [-0.06, 0.06], z: [0, 0.25]}\n"
        "tolerances: {radius: {sd: 0.0005}, arms: {sd: 0.0003}, stops: {sd: 0.0005}}\n"
    )
    robot = load_robot(tmp_path / "metres.yaml")
    options = replace(FEW, n_poses=4, hold_out=0)
    found = lc.plan(robot, build_instrument("position"), options=options)
    exact = lc.inverse(found.robot, found.poses.coordinates).q
    # [m], half of the last decimal place, a nanometre
    assert np.abs(found.poses.readings - exact).max() <= 0.51e-9
