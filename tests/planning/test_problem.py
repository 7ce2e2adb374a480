# SPDX-License-Identifier: Apache-2.0
"""What a choice of poses is made from: where errors are predicted, what was measured before, and
what tells nothing.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.outlook import scene
from loopcal.io import load_robot
from loopcal.measure import KINDS
from loopcal.mechanism import sample_workspace
from loopcal.planning.needed import poses_needed
from loopcal.planning.pose_planning import planned, planned_for
from loopcal.planning.problem import problem
from loopcal.planning.result import at_least

UM, URAD = 1e-6, 1e-6


def looking(kind: str, sigma: float = 10 * UM, **settings) -> lc.Instrument:
    """One kind with one sigma."""
    made = KINDS[kind](**settings)
    return lc.Instrument((lc.Sensor(made, lc.Gaussian(np.full(len(made.noise_columns), sigma))),))


def test_where_errors_are_predicted_depends_neither_on_the_line_of_sight_nor_on_the_candidates():
    robot, sight = (
        load_robot("hexapod-42"),
        lc.Sight(np.array([0.5, -0.3, 0.6]), np.array([0.0, 0.0, 1.0]), np.radians(60.0)),
    )
    free, other, narrow = (
        problem(robot, looking("pose"), constraints, count=count, seed=1)
        for constraints, count in (
            (None, 30),
            (None, 60),
            (lc.Constraints(0.3, np.radians(12.0), sight), 30),
        )
    )
    for made in (other, narrow):
        assert_allclose(made.wanted.pose, free.wanted.pose, atol=1e-12)  # [m] per tolerance
    assert len(free.wanted.shifts) == 200


def test_of_many_listed_poses_errors_are_predicted_all_over_the_list():
    robot = load_robot("linear-delta")
    listed = sample_workspace(robot, 260, seed=3).coordinates
    listed = listed[np.lexsort(listed.T[::-1])]
    made = problem(robot, looking("position"), poses=listed)
    twists = scene(select_free_parameters(robot), lc.inverse(robot, listed[200:]).q).twists[
        0, :, 3:
    ]
    # the instrument tells all nine parameters: nothing is projected out of what is predicted
    found = [
        np.abs(made.wanted.shifts - one).max(axis=(1, 2)).min() < 1e-9 for one in twists
    ]  # [m] per tolerance
    assert len(made.wanted.shifts) == 200
    # the last 60 of the list: with 200 of 260 drawn, 46 of them expected with a standard deviation
    # of 2.9
    assert sum(found) > 30


@pytest.mark.parametrize("kind", ["locked", "joint", "inclination"])
def test_an_instrument_that_tells_nothing_is_refused(kind):
    with pytest.raises(
        EstimationError,
        match=f"kind {kind} tells nothing of the 9 free parameters .*choose another kind",
    ):
        problem(load_robot("linear-delta"), looking(kind), count=20)


def test_equations_of_earlier_measurements_pay_for_their_own_set_up_first():
    robot = load_robot("linear-delta")
    before = lc.simulate(
        robot,
        sample_workspace(robot, 5, seed=3).coordinates,
        looking("position", unknown=("frame",)),
        seed=1,
    )
    assert problem(robot, looking("position"), measured=before, count=20).equations == 15 - 6


def test_an_orientation_that_the_machine_does_not_have_cannot_be_asked_for():
    made = problem(load_robot("linear-delta"), looking("position"), count=20)
    with pytest.raises(EstimationError, match=r"linear-delta does not turn.*give a length"):
        planned_for(made, 10 * URAD, "orientation")


def test_where_equations_decide_the_number_of_poses_the_sentence_says_so():
    made = problem(load_robot("linear-delta"), looking("position", 0.1 * UM), count=20)
    found = poses_needed(made, 100 * UM, "position")
    assert found.enough == 3
    assert "3 poses reach" in found.sentences(made.free.robot)[0]
    assert (
        "fewer give fewer equations than there are unknowns" in found.sentences(made.free.robot)[0]
    )


def test_what_is_guaranteed_is_rounded_down():
    assert [at_least(share) for share in (0.99965, 1.0, 0.5)] == ["99.9%", "100.0%", "50.0%"]


def test_poses_get_names_that_were_not_measured_yet():
    robot = load_robot("linear-delta")
    before = lc.simulate(
        robot, sample_workspace(robot, 12, seed=3).coordinates, looking("position"), seed=1
    )
    found = planned(
        problem(robot, looking("position"), measured=before, count=20, taken=("14", "p3")),
        3,
        hold_out=0,
    )
    assert found.labels == ("15", "16", "17")


def test_readings_are_stated_as_finely_in_metres_as_in_millimetres(tmp_path):
    (tmp_path / "metres.yaml").write_text(
        "format: 1\nfamily: linear-delta\nname: metres\nunits: {length: m, angle: deg}\nradius: "
        "0.105\n"
        "angles: [210, 330, 90]\narms: 0.22\nstops: 0.3\nreadings: drop\nstroke: [0, 0.4]\nhome: "
        "{z: 0.12}\n"
        "workspace: {x: [-0.06, 0.06], y: [-0.06, 0.06], z: [0, 0.25]}\n"
        "tolerances: {radius: {sd: 0.0005}, arms: {sd: 0.0003}, stops: {sd: 0.0005}}\n"
    )
    found = planned(
        problem(load_robot(tmp_path / "metres.yaml"), looking("position"), count=20), 4, hold_out=0
    )
    exact = lc.inverse(found.robot, found.coordinates).q
    assert (
        np.abs(found.readings - exact).max() <= 0.51e-9
    )  # [m], half of the last decimal place, a nanometre
