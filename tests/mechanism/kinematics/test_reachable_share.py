# SPDX-License-Identifier: Apache-2.0
"""The check of a robot file states how much of its workspace the machine reaches."""

from pathlib import Path

import pytest

from loopcal.apply.inspection import inspect_robot
from loopcal.io.robot.robot_file import SHIPPED_ROBOTS
from loopcal.mechanism.workspace import measure_reachable_share
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

STAGE = """
format: 1
family: limbs
name: stage
units: {length: mm, angle: deg}
freedoms: [x, y]
controlled: [x, y]
drives:
  a: {reads: length, stroke: [-100, 100]}
  b: {reads: length, stroke: [-25, 25]}
limbs:
  - name: arm
    ending: rigid
    chain: [{joint: P, axis: x, actuated: a}, {joint: P, axis: y, actuated: b}]
workspace: {x: [-100, 100], y: [-100, 100]}
"""


def test_the_share_of_a_stage_is_that_of_its_stroke_within_the_stated_interval(
    tmp_path: Path,
) -> None:
    """Of y from -100 to 100 mm the stroke of b allows a quarter."""
    robot = load_text(tmp_path, STAGE)
    for seed in range(3):
        reachable = measure_reachable_share(robot, 400, seed)
        assert reachable is not None
        assert reachable.low < 0.25 < reachable.high
        assert list(reachable.reasons) == ["stroke of b is exceeded"]
    (finding,) = (f for f in inspect_robot(robot).findings if "unreachable" in f.code)
    assert "stage reaches 2" in str(finding)
    assert "stroke of b is exceeded at 7" in str(finding)


@pytest.mark.parametrize("name", ["hexapod-42", "excavator"])
def test_a_machine_that_reaches_its_workspace_is_not_warned_of(name: str) -> None:
    inspection = inspect_robot(load_cached_robot(name))
    assert inspection.reachable is not None
    assert inspection.reachable.share > 0.95
    assert not [f for f in inspection.findings if "unreachable" in f.code]


def test_without_a_stated_workspace_there_is_no_share(tmp_path: Path) -> None:
    robot = load_text(tmp_path, STAGE.replace("workspace:", "# workspace:"))
    assert inspect_robot(robot).reachable is None


def test_a_workspace_far_too_wide_is_warned_of_with_its_limits(tmp_path: Path) -> None:
    text = (SHIPPED_ROBOTS / "linear-delta.yaml").read_text().replace("[-60, 60]", "[-600, 600]")
    (finding,) = (
        f for f in inspect_robot(load_text(tmp_path, text)).findings if "unreachable" in f.code
    )
    assert "the loops do not close" in str(finding)
