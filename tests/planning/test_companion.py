# SPDX-License-Identifier: Apache-2.0
"""The companion judges rows by what is known, chooses poses and says how accurate the robot is.

Rows are simulated: machines drawn from the spreads, measured with the stated noise.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal import geometry
from loopcal.apply.simulated_measurements import (
    InstrumentDescription,
    build_instrument,
    fill_in_measurements,
)
from loopcal.measure.measurements import Measurements
from loopcal.planning import companion as co
from loopcal.planning.constraints import PlanOptions, restore_options
from loopcal.planning.pose_planning import plan

SIGMA = 5e-6
# Place of an instrument whose frame is unknown [m].
PLACE = geometry.make_pose(geometry.exp_so3(np.array([1.1, -0.6, 2.2])), np.array([2.5, -1.3, 0.7]))
Wrong = Mapping[int, Any]


class Machine:
    """A plan for a robot, and a true machine whose poses are measured as often as one likes."""

    def __init__(self, name: str, frames: tuple[str, ...], seed: int, **options: Any) -> None:
        self.robot, self.is_framed = lc.load_robot(name), bool(frames)
        description = InstrumentDescription(
            ("position",), sigma_position=SIGMA, unknown_frames=frames
        )
        self.instrument = build_instrument(description)
        chosen = PlanOptions(n_poses=16, hold_out=3, n_candidates=60)
        self.plan = plan(self.robot, self.instrument, options=chosen)
        self.planned = _plan_rows(self.robot, self.instrument, self.plan.poses)
        self.fit = np.flatnonzero(~self.planned.is_held_out).tolist()
        self.truth = fill_in_measurements(
            self.robot, self.planned, self.instrument, draw_errors=True, seed=seed
        ).truth
        exact = build_instrument(replace(description, sigma_position=1e-12))
        self.exact = fill_in_measurements(
            self.truth, self.planned, exact, draw_errors=False, seed=1
        ).data
        self.task = co.prepare_task(
            self.planned, self.robot, self.instrument, PlanOptions(**options), co.Pace(2.0, 0.5)
        )

    def measure(self, poses: Sequence[int], wrong: Wrong | None = None) -> Measurements:
        """Return visits of poses, each with noise of its own; `wrong` rows are moved [m]."""
        (observed,), n = self.exact.observations, len(poses)
        exact = observed.measured
        if self.is_framed:
            exact = exact @ PLACE[:3, :3].T + PLACE[:3, 3]
        noise = [np.random.default_rng([7, i]).normal(size=3) for i in range(n)]
        values = exact[list(poses)] + SIGMA * np.array(noise)
        for i, error in (wrong or {}).items():
            if i < n:
                values[i] += error
        rows = lc.Observations(observed.kind, np.arange(n), values, SIGMA**2 * np.eye(3))
        return replace(
            self.exact,
            readings=self.exact.readings[list(poses)],
            observations=(rows,),
            labels=tuple(map(str, range(n))),
            block=np.arange(n),
            is_held_out=self.planned.is_held_out[list(poses)],
        )


def _plan_rows(robot, instrument, poses) -> Measurements:
    """Return the sheet of planned poses, with zeros as values."""
    n = len(poses)
    sensor = instrument.with_tool(robot).sensors[0]
    covariance = np.diag(sensor.noise.sigma**2)
    rows = lc.Observations(sensor.kind, np.arange(n), np.zeros((n, 3)), covariance)
    return Measurements(
        robot.name, poses.readings, (rows,), labels=poses.labels, is_held_out=poses.held_out
    )


@cache
def make_machine(frames: tuple[str, ...] = (), seed: int = 3) -> Machine:
    return Machine("hexapod-42", frames, seed, goal=2e-5, target="position")


def follow(machine: Machine, poses: Sequence[int], wrong: Wrong | None = None):
    """Measure poses one after the other; return the last state, and all verdicts."""
    state, verdicts = co.Companion(machine.task), []
    for count in range(1, len(poses) + 1):
        measured = machine.measure(poses[:count], wrong)
        verdict = co.examine_row(state, measured, poses[count - 1])
        state = co.take_rows(machine.task, measured, poses[:count], verdict.is_used, state)
        verdicts.append(verdict)
    return state, verdicts


def judge(machine: Machine, poses: Sequence[int], wrong: Wrong | None = None) -> list[str]:
    return [verdict.judgement for verdict in follow(machine, poses, wrong)[1]]


def test_rows_of_a_true_machine_fit_and_the_accuracy_improves() -> None:
    machine = make_machine()
    state, verdicts = follow(machine, machine.fit[:12])
    assert {verdict.judgement for verdict in verdicts} == {"fits"}
    before = co.predict_accuracy(co.Companion(machine.task))
    after = co.predict_accuracy(state)
    assert before is not None
    assert after is not None
    assert after.position < 0.2 * before.position
    assert state.scale == 1.0


def test_without_unknown_frame_a_wrong_first_row_is_found_by_the_tolerances() -> None:
    machine = make_machine()
    assert judge(machine, machine.fit[:1], {0: (0.0, 2e-3, 0.0)}) == ["repeat"]


def test_an_unknown_frame_leaves_the_first_row_without_judgement() -> None:
    machine = make_machine(("base",))
    _, verdicts = follow(machine, machine.fit[:6])
    first = verdicts[0]
    assert (first.judgement, first.prediction.degrees) == ("untestable", 0)
    assert np.isinf(first.prediction.sd).all()
    assert set(first.findings[0].data["setup"]) == {
        f"frame.{axis}" for axis in ("rx", "ry", "rz", "x", "y", "z")
    }
    degrees = [verdict.prediction.degrees for verdict in verdicts]
    assert degrees == sorted(degrees)
    assert degrees[-1] == 3
    assert {verdict.judgement for verdict in verdicts[1:]} == {"fits"}


@pytest.mark.parametrize("frames", [(), ("base",)])
def test_a_wrong_row_is_repeated_and_the_first_of_the_two_left_out(frames) -> None:
    machine = make_machine(frames)
    poses = [*machine.fit[:7], machine.fit[6]]
    state, verdicts = follow(machine, poses, {6: (1e-3, 0.0, 0.0)})
    assert [verdict.judgement for verdict in verdicts[6:]] == ["repeat", "fits"]
    assert verdicts[7].findings[0].data["earlier"] == 1
    assert state.is_used.tolist() == [True] * 6 + [False, True]
    assert state.pending == ()


def test_a_doubted_pose_comes_next() -> None:
    machine = make_machine()
    state, _ = follow(machine, machine.fit[:7], {6: (1e-3, 0.0, 0.0)})
    following = co.choose_next(state)
    assert (following.reason, following.pose) == ("repeat", machine.fit[6])


def test_rows_that_agree_are_used_although_they_do_not_fit() -> None:
    wrong = {6: (1e-3, 0.0, 0.0), 7: (1e-3, 0.0, 0.0)}  # such as a wrong commanded reading
    machine = make_machine()
    state, verdicts = follow(machine, [*machine.fit[:7], machine.fit[6]], wrong)
    assert verdicts[-1].judgement == "agree"
    assert state.is_used.all()
    assert state.scale > 10.0  # the contradiction widens all standard deviations


def test_rows_in_another_unit_are_named_and_not_used() -> None:
    machine = Machine("linear-delta", (), 1)
    poses = [machine.fit[0]] * 2
    exact = machine.exact.observations[0].measured[poses]
    state, verdicts = follow(machine, poses, dict(enumerate(-0.999 * exact)))
    assert [verdict.judgement for verdict in verdicts] == ["repeat", "misread"]
    assert verdicts[1].findings[1].code == "conventions.undecided"
    assert not state.is_used.any()
    assert state.pending == (machine.fit[0],)


def test_rows_in_another_unit_are_not_corrected_in_the_header_of_their_sheet() -> None:
    """A sheet with another header would begin another session."""
    machine = Machine("linear-delta", ("base",), 1)
    poses = [pose for pose in machine.fit[:8] for _ in range(2)]
    exact = machine.exact.observations[0].measured[poses]
    _, verdicts = follow(machine, poses, dict(enumerate(24.4 * exact)))
    found = [finding for verdict in verdicts for finding in verdict.findings]
    said = [str(f) for f in found if f.code == "conventions.other-interpretation"]
    assert said
    assert all("Measure again with the units" in text and "header" not in text for text in said)


def test_rows_that_contradict_each_other_are_measured_again() -> None:
    wrong = {6: (1e-3, 0.0, 0.0), 7: (0.0, 1e-3, 0.0)}
    machine = make_machine()
    state, verdicts = follow(machine, [*machine.fit[:7], machine.fit[6]], wrong)
    assert verdicts[-1].judgement == "differ"
    assert co.choose_next(state).pose == machine.fit[6]


def test_rows_on_one_line_and_repeated_points_leave_a_far_frame_open_but_fit() -> None:
    machine = make_machine(("base",))
    first, second, *others = machine.fit[:5]
    found = judge(machine, [first, first, second, first, *others])
    assert found == ["untestable", *["fits"] * 6]


def test_a_wrong_row_before_anything_could_be_tested_is_found_later() -> None:
    """Without an earlier judgement, a wrong first row makes right rows doubtful."""
    machine, wrong = make_machine(("base",)), {0: (3e-4, -3e-4, 3e-4)}
    poses, state, verdict = [machine.fit[0]], co.Companion(machine.task), None
    for _ in range(12):
        measured = machine.measure(poses, wrong)
        verdict = co.examine_row(state, measured, poses[-1])
        state = co.take_rows(machine.task, measured, poses, verdict.is_used, state)
        if verdict.judgement == "earlier-wrong":
            break
        pending = state.pending
        poses.append(pending[-1] if pending else next(i for i in machine.fit if i not in poses))
    assert verdict is not None
    assert verdict.judgement == "earlier-wrong"
    assert machine.task.labels[machine.fit[0]] in verdict.findings[0].data["suspects"]


def test_a_wrong_first_row_that_the_unknown_frame_hid_is_no_drift() -> None:
    """All other rows contradict it when its pose comes again."""
    machine = Machine("linear-delta", ("base",), 1, goal=4.5e-6, target="position")
    poses, state, said = list[int](), co.Companion(machine.task), list[str]()
    while (pose := co.choose_next(state).pose) in machine.fit:
        poses.append(pose)
        measured = machine.measure(poses, {0: (-3.5e-5, 0.0, 0.0)})
        verdict = co.examine_row(state, measured, pose)
        state = co.take_rows(machine.task, measured, poses, verdict.is_used, state)
        said.append(verdict.judgement)
    assert said[:2] == ["untestable", "fits"]
    assert "moved" not in said
    assert state.is_used.tolist().index(True) == 1
    assert state.pending == ()


def test_a_check_pose_tells_a_drift() -> None:
    machine = make_machine()
    drift: Wrong = {10: (8e-05, 0.0, 0.0), 11: (8e-05, 0.0, 0.0)}
    poses = [*machine.fit[:10], machine.fit[0], machine.fit[0]]
    verdicts = follow(machine, poses, drift)[1]
    assert [verdict.judgement for verdict in verdicts[10:]] == ["repeat", "moved"]
    doubted = follow(machine, poses[:11], drift)[0]
    following = co.choose_next(doubted)
    assert (following.reason, following.pose) == ("repeat", machine.fit[0])
    assert verdicts[-1].findings[0].data["between"] == 11
    assert verdicts[-1].findings[0].data["difference"].value == pytest.approx(0.08, abs=0.02)


def test_a_check_pose_is_suggested_after_some_rows() -> None:
    machine = make_machine()
    every = replace(machine.task, check_every=5)
    state, _ = follow(machine, machine.fit[:6])
    assert co.choose_next(replace(state, task=every)).reason == "check"
    assert co.choose_next(replace(state, task=replace(every, check_every=0))).reason == "best"


def test_the_goal_ends_the_measuring_of_fit_poses() -> None:
    machine, poses = make_machine(), []
    state, numbers = co.Companion(machine.task), []
    while (following := co.choose_next(state)).reason == "best":
        numbers.append(following.left)
        assert following.pose is not None
        poses.append(following.pose)
        measured = machine.measure(poses)
        verdict = co.examine_row(state, measured, poses[-1])
        state = co.take_rows(machine.task, measured, poses, verdict.is_used, state)
    errors = co.predict_accuracy(state)
    assert errors is not None
    assert errors.position <= 2e-5
    assert numbers[0] == len(poses)  # the number to the goal was right from the beginning
    assert numbers == list(range(len(poses), 0, -1))
    assert (following.reason, following.left) == ("validate", 0)
    assert following.minutes is not None
    assert following.minutes > 2.0 * following.held_out


def test_minutes_of_travel_change_the_next_pose() -> None:
    machine = make_machine()
    slow = replace(machine.task, pace=co.Pace(1.0, 1e-3))
    state, _ = follow(machine, machine.fit[:4])
    near = co.choose_next(replace(state, task=slow)).pose
    at = machine.task.problem.candidates.coordinates
    distance = np.linalg.norm(at[:, :3] - at[machine.fit[3], :3], axis=1)
    far = co.choose_next(state).pose
    assert near is not None
    assert far is not None
    assert distance[near] <= distance[far]


def test_noise_above_the_stated_one_widens_what_is_said() -> None:
    machine = make_machine()
    rng = np.random.default_rng(5)
    wrong = {i: 5.0 * SIGMA * rng.normal(size=3) for i in range(13)}
    measured, used = machine.measure(machine.fit, wrong), np.ones(len(machine.fit), dtype=bool)
    state = co.take_rows(machine.task, measured, machine.fit, used)
    assert 2.0 < state.scale < 8.0
    plain = co.take_rows(machine.task, machine.measure(machine.fit), machine.fit, used)
    errors, narrow = co.predict_accuracy(state), co.predict_accuracy(plain)
    assert errors is not None
    assert narrow is not None
    assert errors.position == pytest.approx(state.scale * narrow.position)
    codes = [f.code for f in co.report_progress(state, co.choose_next(state))]
    assert "companion.scatter" in codes


def test_noise_below_the_stated_one_saves_poses_and_wrong_spreads_do_not() -> None:
    """Repeats show the noise; a machine that is nominal, with wide spreads, shows none."""
    machine, counts = make_machine(), []
    poses = machine.fit[:5] * 3
    used, (observed,) = np.ones(15, dtype=bool), machine.measure(poses).observations
    exact = machine.exact.observations[0].measured[poses]
    for times in (1.0, 0.3):
        values = exact + times * (observed.measured - exact)
        measured = replace(
            machine.measure(poses), observations=(replace(observed, measured=values),)
        )
        state = co.take_rows(machine.task, measured, poses, used)
        assert state.scale == 1.0
        counts.append(co.choose_next(state).left)
        assert state.noise == pytest.approx(1.2 * times, rel=0.2)
    assert 0 <= counts[1] < counts[0]
    first = machine.measure(machine.fit[:8])  # 24 values of a machine of 42 parameters
    alone = co.take_rows(machine.task, first, machine.fit[:8], np.ones(8, dtype=bool))
    assert alone.noise == 1.0


def test_uncertain_readings_widen_the_expected_value() -> None:
    machine = make_machine()
    exact = follow(machine, machine.fit[:8])[1][-1].prediction.sd
    measured = machine.measure(machine.fit[:8])
    sigma = np.full(measured.readings.shape, 5e-5)
    before = replace(measured.take(np.arange(7)), reading_sigma=sigma[:7])
    state = co.take_rows(machine.task, before, machine.fit[:7], np.ones(7, dtype=bool))
    verdict = co.examine_row(state, replace(measured, reading_sigma=sigma), machine.fit[7])
    assert (verdict.prediction.sd > 3.0 * exact).all()


def test_an_update_takes_less_than_a_fifth_of_a_second() -> None:
    machine = make_machine()
    state, _ = follow(machine, machine.fit[:9])
    measured = machine.measure(machine.fit[:10])
    times = []
    for _ in range(3):
        begin = time.process_time()
        verdict = co.examine_row(state, measured, machine.fit[9])
        after = co.take_rows(machine.task, measured, machine.fit[:10], verdict.is_used, state)
        co.report_progress(after, co.choose_next(after))
        times.append(time.process_time() - begin)
    assert min(times) < 0.2  # [s] of the processor


def test_what_a_plan_was_asked_for_is_restored() -> None:
    sight = lc.LineOfSight(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    options = PlanOptions(
        goal=1e-5, target="orientation", share=0.8, constraints=lc.Constraints(sight=sight)
    )
    from loopcal.results.serialization import to_json

    restored = restore_options(to_json(options.asked, {}))
    assert (restored.goal, restored.target, restored.share) == (1e-5, "orientation", 0.8)
    assert restored.constraints.sight is not None
    assert restored.constraints.sight.farthest == np.inf
    assert restore_options({}).goal is None
