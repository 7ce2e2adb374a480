# SPDX-License-Identifier: Apache-2.0
"""Plans: rows are those of the estimator, what is predicted comes true, planned poses beat drawn
ones, nonsense is refused.
"""

from dataclasses import replace
from math import comb

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.outlook import information
from loopcal.io import load_robot
from loopcal.measure import KINDS, sample_truth
from loopcal.mechanism import sample_workspace
from loopcal.planning.certified import certified_design
from loopcal.planning.compared import MOST, units_of
from loopcal.planning.criteria import D
from loopcal.planning.design import Start, design_factor
from loopcal.planning.information import considered, start_of, unit_rows
from loopcal.planning.needed import poses_needed
from loopcal.planning.pose_planning import planned, planned_for
from loopcal.planning.problem import problem

UM, URAD = 1e-6, 1e-6


def looking(kind: str, sigma: float = 10 * UM, **settings) -> lc.Instrument:
    """One kind with one sigma."""
    made = KINDS[kind](**settings)
    return lc.Instrument((lc.Sensor(made, lc.Gaussian(np.full(len(made.noise_columns), sigma))),))


@pytest.fixture(scope="module")
def tracker():
    """A hexapod to be seen by a laser tracker that measures whole poses."""
    return problem(load_robot("hexapod-42"), looking("pose", 10 * UM), count=80, seed=1)


@pytest.fixture(scope="module")
def found(tracker):
    """A plan of twelve poses."""
    return planned(tracker, 12, hold_out=5)


@pytest.mark.parametrize(
    ("name", "kind", "settings"),
    [
        ("3-prs", "pose", {"unknown": ("frame",)}),
        ("hexapod-42", "position", {"unknown": ("frame", "targets")}),
        ("hexapod-42", "separation", {}),
        ("hexapod-42", "plane", {"unknown": ("surface",)}),
    ],
)
def test_rows_of_units_are_those_that_identification_folds(name, kind, settings):
    robot = load_robot(name)
    free, seen_by = select_free_parameters(robot), looking(kind, **settings)
    q = sample_workspace(robot, 30, seed=2).solution.q
    members = units_of(len(q), seen_by, np.random.default_rng(0))
    if members.shape[1] > 1:  # as a sensor looks that is told nothing: each with the next
        members = np.stack([np.arange(30), (np.arange(30) + 1) % 30], axis=1)
    units = unit_rows(free, seen_by, q, members)
    data = lc.simulate(
        robot, sample_workspace(robot, 30, seed=2).coordinates, seen_by, seed=0, controller=robot
    )
    rows = np.concatenate(
        [units.rows.reshape(-1, units.rows.shape[2]), np.eye(units.rows.shape[2])[len(units.own) :]]
    )
    ours = design_factor(rows[None], Start.nothing(len(free), len(units.own)), _all(free, units))
    theirs = information(free, data)[0][0, :-1, :-1]
    theirs = np.concatenate([theirs, np.eye(len(free))])
    # data of this seed have noise, so that the frames found from them differ by some 1e-4 from the
    # stated ones
    assert_allclose(
        np.linalg.svd(ours, compute_uv=False),
        np.linalg.svd(theirs, compute_uv=False),
        rtol=2e-3 if settings else 1e-6,
    )


def _all(free, units):
    """Every direction of the machine, and those of the own unknowns."""
    from loopcal.planning.design import directions

    return directions(units.rows, Start.tolerances(len(free), len(units.own)))


def test_what_is_predicted_comes_true(tracker, found):
    robot, trials = tracker.free.robot, 40
    truth = sample_truth(robot, trials, seed=5)
    fitted = found.coordinates[~found.held_out]
    measured = lc.simulate_trials(robot, truth, fitted, found.instrument, seed=6)
    estimates = lc.identify_trials(robot, measured, method=lc.MAP()).values
    q = tracker.candidates.solution.q[tracker.candidates.even]
    errors = []
    for true, estimate in zip(truth, estimates, strict=True):
        a, b = (lc.forward(robot.with_values(values), q).T[:, :3, 3] for values in (true, estimate))
        errors.append(((a - b) ** 2).sum(axis=1).mean())
    rms = np.sqrt(np.mean(errors))
    # mean of 40 squares that are dominated by a dozen directions: relative sd about sqrt(2 / (40 *
    # 12)) = 0.065 of the square
    assert rms == pytest.approx(found.expected.position, rel=0.12)


def test_planned_poses_predict_better_than_drawn_ones_and_the_certificate_is_near_one(found):
    assert found.even is not None
    assert found.before is not None
    assert found.expected.position < 0.85 * found.even.position < found.before.position
    assert 0.9 < found.efficiency <= 1.0
    assert set(found.figures) == {"D", "I", "A", "E"}
    text = str(found)
    assert "12 poses of hexapod-42 to measure (pose) and 5 to judge by" in text
    assert "mm" in text
    assert "deg" in text


def test_poses_to_judge_by_are_others_than_those_fitted_and_lie_inside(found, tracker):
    assert found.n_poses == 12
    assert found.held_out.sum() == 5
    assert len(np.unique(found.coordinates, axis=0)) == 17
    even = tracker.candidates.coordinates[tracker.candidates.even]
    for pose in found.coordinates[found.held_out]:
        assert (np.abs(even - pose).max(axis=1) == 0.0).any()


def test_a_plan_is_the_same_for_the_same_seed():
    small = problem(load_robot("linear-delta"), looking("position"), count=20, seed=4)
    one, other = (planned(small, 4, hold_out=2, seed=9) for _ in range(2))
    np.testing.assert_array_equal(one.coordinates, other.coordinates)
    np.testing.assert_array_equal(one.held_out, other.held_out)


def test_poses_measured_already_are_taken_into_account(tracker, found):
    robot = tracker.free.robot
    data = lc.simulate(robot, found.coordinates[~found.held_out], found.instrument, seed=3)
    after = problem(robot, looking("pose", 10 * UM), measured=data, count=30, seed=2)
    more = planned(after, 2, hold_out=2)
    assert more.before is not None
    # nothing new was measured yet: what is known now is what the first plan promised, on other
    # poses of the workspace
    assert more.before.position == pytest.approx(found.expected.position, rel=0.15)
    assert more.expected.position < more.before.position


def test_how_many_poses_reach_a_goal_and_below_how_many_none_can():
    made, goal = (
        problem(load_robot("linear-delta"), looking("position", 20 * UM), count=60, seed=1),
        15 * UM,
    )
    needed = poses_needed(made, goal, "position")
    assert needed.at_least is not None
    assert needed.enough is not None
    assert needed.values[needed.numbers == needed.enough] <= goal
    assert needed.at_least <= needed.enough <= 1.2 * needed.at_least
    assert (needed.bounds <= needed.values * (1 + 1e-9)).all()
    assert (np.diff(needed.values) < 0.0).all()
    plan = planned_for(made, goal, "position", hold_out=10)
    assert plan.expected.position <= goal
    assert plan.n_poses < 1.5 * needed.at_least
    with pytest.raises(
        EstimationError,
        match=r"out of reach: \d+ poses leave .* mm, and no choice .*better instrument",
    ):
        planned_for(made, 0.05 * UM, "position")


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (
            {"n_poses": 6},
            r"6 poses give 36 equations, but there are 42 unknowns .*plan at least 7 poses",
        ),
        ({"n_poses": 0}, "0 poses to measure were asked for; ask for 1 or more"),
        ({"n_poses": 10, "hold_out": -1}, "-1 poses to hold out"),
        ({"n_poses": 10, "hold_out": 100}, "hold out fewer"),
        ({"n_poses": 5000, "hold_out": 0}, "only .* are left to choose from"),
        ({"n_poses": 10, "criterion": "G"}, "allowed are I .* and D"),
    ],
)
def test_demands_that_cannot_be_met_are_refused_with_the_reason(tracker, ask, said):
    with pytest.raises(EstimationError, match=said):
        planned(tracker, **ask)


@pytest.fixture(scope="module")
def callipers():
    """A delta of which distances between places are measured."""
    return problem(load_robot("linear-delta"), looking("separation"), count=80, seed=1)


def test_kinds_that_compare_poses_are_planned_in_pairs(callipers):
    made = callipers
    found = planned(made, 24, hold_out=4)
    judged = {i for pair in found.units[found.held_out[found.units].all(axis=1)] for i in pair}
    assert (
        f"12 pairs to measure (separation) and 2 to judge by, of {len(found.labels)} poses of "
        "linear-delta" in str(found)
    )
    assert f"of the {found.considered} pairs considered allow" in str(found)
    assert found.considered == comb(len(made.candidates) - len(judged), 2)
    assert found.units.shape[1] == 2
    held = found.held_out[found.units]
    assert (held.all(axis=1) | ~held.any(axis=1)).all()
    assert held.all(axis=1).sum() == 2
    assert "cannot tell how the frame base lies as a whole" in str(found)
    with pytest.raises(EstimationError, match="in multiples of 2"):
        planned(made, 25)


def test_no_choice_of_pairs_beats_what_is_said_of_pairs_not_even_all_pairs_of_few_poses(callipers):
    made = callipers
    assert len(made.units.members) == comb(len(made.candidates), 2)
    # twelve poses with all their 66 pairs, the best of some that are drawn
    poses, rng, tried = np.unique(made.units.members), np.random.default_rng(0), []
    for few in (rng.choice(poses, 12, replace=False) for _ in range(300)):
        chosen = np.flatnonzero(np.isin(made.units.members, few).all(axis=1))
        tried.append((made.accuracy(chosen), len(chosen)))
    reached, pairs = min(tried, key=lambda one: one[0].position if one[0] else np.inf)
    assert reached is not None
    needed = poses_needed(made, reached.position, "position")
    assert needed.at_least is not None
    # were each pair counted as two poses, twelve poses would contradict what is said
    assert 12 < 2 * needed.at_least <= 2 * pairs == 132
    sentence = needed.sentences(made.free.robot)[0]
    assert f"{needed.enough} pairs reach" in sentence
    assert (
        f"no choice of fewer than {needed.at_least} of the {len(made.units.members)} pairs "
        "considered can" in sentence
    )
    assert needed.to_dict()["counted"] == "pairs"


def test_of_many_poses_the_pairs_considered_are_different_and_tell_more_than_as_many_drawn():
    robot, seen_by = load_robot("linear-delta"), looking("separation")
    free, q = select_free_parameters(robot), sample_workspace(robot, 400, seed=2).solution.q
    mounted = seen_by.with_tool(robot)
    ours = considered(free, mounted, q, np.random.default_rng(3))
    drawn = unit_rows(
        free, mounted, q, units_of(len(q), mounted, np.random.default_rng(3), len(ours.members))
    )
    assert 0.9 * MOST < len(ours.members) <= MOST
    for units in (ours, drawn):
        assert (units.members[:, 0] < units.members[:, 1]).all()
        assert len(np.unique(units.members, axis=0)) == len(units.members)
    best = [
        certified_design(u.rows, 12, D(), Start.tolerances(len(free)), shakes=5).design.value
        for u in (ours, drawn)
    ]
    assert best[0] > best[1]


def test_a_weak_certificate_is_called_weak(found):
    assert "little is guaranteed" in str(replace(found, efficiency=0.4))
    assert "little is guaranteed" not in str(found)


def test_an_instrument_with_rows_of_its_own_is_refused():
    sensor = lc.Sensor(lc.Pose(), lc.Gaussian(np.full(6, UM)), rows=np.arange(3))
    with pytest.raises(DataError, match="leave out the rows"):
        lc.plan(load_robot("hexapod-42"), lc.Instrument((sensor,)))


def test_an_unknown_frame_changes_nothing_of_what_is_expected_before():
    robot = load_robot("3-prs")
    known, unknown = (
        problem(robot, looking("pose", unknown=u), count=30, seed=1) for u in ((), ("frame",))
    )
    nothing = np.zeros(0, dtype=int)
    before, behind = known.accuracy(nothing), unknown.accuracy(nothing)
    assert before is not None
    assert behind is not None
    assert before.position == pytest.approx(
        np.sqrt((known.wanted.position**2).sum() / len(known.wanted.shifts)), rel=1e-9
    )
    # motions of the base, which an unknown frame hides, are left out
    assert 0.0 < behind.position <= before.position * (1 + 1e-9)


def test_stated_tolerances_are_the_only_prior():
    free = select_free_parameters(load_robot("hexapod-42"))
    q = sample_workspace(free.robot, 4, seed=1).solution.q
    units = unit_rows(free, looking("pose"), q, np.arange(4)[:, None])
    assert len(start_of(free, units).rows) >= 42
    assert not free.assumed.any()
