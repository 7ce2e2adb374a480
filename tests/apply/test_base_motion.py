# SPDX-License-Identifier: Apache-2.0
"""Motions of frames that nothing measured: stated, and undone by other values of equal accuracy."""

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.base_motion import choose_base, find_base_motion
from loopcal.geometry import exp_so3, make_pose

TURN, SHIFT = np.array([0.002, -0.001, 0.003]), np.array([1e-3, 2e-3, -1.5e-3])
F = make_pose(exp_so3(TURN), SHIFT)


def move_frames(base: np.ndarray, platform: np.ndarray) -> lc.Mechanism:
    """Return a hexapod whose centers are written in moved frames: T becomes base T platform^-1."""
    robot = lc.load_robot("hexapod-42")
    names, values = robot.parameters.names, robot.values.copy()
    for side, motion in (("base", base), ("platform", platform)):
        for leg in range(1, 7):
            at = [names.index(f"leg{leg}.{side}.{axis}") for axis in "xyz"]
            values[at] = (motion @ [*values[at], 1.0])[:3]
    return robot.with_values(values)


@pytest.mark.parametrize(
    ("base", "platform", "frames"),
    [
        (F, np.eye(4), ("base",)),
        (np.eye(4), F, ("platform",)),
        (F, make_pose(np.eye(3), -2 * SHIFT), ("base", "platform")),
    ],
)
def test_motions_of_both_frames_are_stated_and_undone(base, platform, frames) -> None:
    moved, robot = move_frames(base, platform), lc.load_robot("hexapod-42")
    finding, kept = find_base_motion(robot, moved, False, frames)
    assert finding is not None
    assert kept is not None
    assert finding.data["keeps"] == "both"
    for frame, motion in (("base", base), ("platform", platform)):
        shift = finding.data[f"{frame}_shift"]
        wanted = 1e3 * np.linalg.norm(motion[:3, 3])
        assert (shift.value if shift else 0.0) == pytest.approx(wanted, abs=1e-5)  # [mm]
    readings = lc.inverse(robot, lc.sample_workspace(robot, 20, 1).coordinates).q
    places = [lc.forward(machine, readings).T for machine in (robot, kept)]
    np.testing.assert_allclose(places[1], places[0], rtol=0, atol=1e-9)  # [m]
    assert find_base_motion(robot, kept, False, frames) == (None, None)


def test_a_shift_turns_nothing() -> None:
    moved, robot = move_frames(make_pose(np.eye(3), SHIFT), np.eye(4)), lc.load_robot("hexapod-42")
    finding, _ = find_base_motion(robot, moved, False, ("base",))
    assert finding is not None
    assert finding.data["base_turn"].value == 0.0


def test_a_frame_that_was_measured_is_not_taken_for_a_convention() -> None:
    moved, robot = move_frames(F, np.eye(4)), lc.load_robot("hexapod-42")
    assert find_base_motion(robot, moved, False, ()) == (None, None)


def test_a_table_leaves_out_motions_that_nobody_sees() -> None:
    small = make_pose(np.eye(3), 1e-2 * SHIFT)
    moved, robot = move_frames(small, np.eye(4)), lc.load_robot("hexapod-42")
    result = {"expected_error": {"finding": {"data": {"fitted": ["base"]}}}}
    assert choose_base(result, robot, moved, keep_frame=True) == (moved, ())
    kept, findings = choose_base(result, robot, moved, keep_frame=True, visible=0.0)
    assert not findings
    np.testing.assert_allclose(kept.values, robot.values, rtol=0, atol=1e-10)  # [m]
