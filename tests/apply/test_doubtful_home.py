# SPDX-License-Identifier: Apache-2.0
"""The check of a robot file doubts a home that is nearly singular, and lengths of no machine."""

from pathlib import Path

import pytest

import loopcal as lc
from loopcal.apply.inspection import inspect_robot
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

FIVE_BAR = """
format: 1
family: limbs
name: five-bar
units: {{length: {unit}, angle: deg}}
freedoms: [x, y]
controlled: [x, y]
drives: {{a: {{reads: angle}}, b: {{reads: angle}}}}
limbs:
  - name: left
    chain: [{{joint: R, name: motor, at: [-100, 0, 0], actuated: a, start: {left}}}]
    tip: [200, 0, 0]
    ending: distance
    length: 300
  - name: right
    chain: [{{joint: R, name: motor, at: [100, 0, 0], actuated: b, start: {right}}}]
    tip: [200, 0, 0]
    ending: distance
    length: 300
home: {{x: 0, y: {y}}}
"""


def list_doubts(tmp_path: Path, **numbers: object) -> list[str]:
    robot = load_text(tmp_path, FIVE_BAR.format(**numbers))
    findings = inspect_robot(robot).findings
    return [str(f) for f in findings if f.code.endswith(("near-singularity", "unusual-size"))]


def test_a_home_with_stretched_arms_is_named_with_the_weak_drive(tmp_path: Path) -> None:
    """Arms and rods reach from (100, 0) to (0, 489.9) mm."""
    (doubt,) = list_doubts(tmp_path, unit="mm", left=80, right=100, y=489.8)
    assert doubt.startswith("Home is close to a singularity: ")
    assert "moves the platform too little (margin 0.0157, 0 is singular)" in doubt


def test_a_home_whose_rods_lie_in_line_is_named_with_the_motion_that_is_free(
    tmp_path: Path,
) -> None:
    """Two rods of 300 mm with a rise of 3 mm hold y by 0.01 sqrt(2)."""
    gap = 299.985
    text = FIVE_BAR.replace("[-100, 0, 0]", f"[{-gap}, -200, 0]")
    text = text.replace("[100, 0, 0]", f"[{gap}, -200, 0]")
    robot = load_text(tmp_path, text.format(unit="mm", left=90, right=90, y=3))
    (doubt,) = (str(f) for f in inspect_robot(robot).findings if "near-sing" in f.code)
    assert "the drives resist translation along y too little" in doubt


def test_a_home_in_the_anchor_of_a_line_is_refused_with_the_line(tmp_path: Path) -> None:
    text = FIVE_BAR.format(unit="mm", left=120, right=60, y=0)
    chain = "chain: [{joint: R, name: motor, at: [-100, 0, 0], actuated: a, start: 120}]"
    text = text.replace(f"{chain}\n    tip: [200, 0, 0]", "tip: [0, 0, 0]\n    actuated: a")
    text = text.replace("ending: distance\n    length: 300", "ending: distance\n    length: 0", 1)
    text = text.replace("a: {reads: angle}", "a: {reads: length}")
    with pytest.raises(lc.MechanismError, match="the limb left has no direction"):
        load_text(tmp_path, text)


@pytest.mark.parametrize(("unit", "size"), [("um", "um apart"), ("m", "m apart")])
def test_lengths_in_another_unit_are_doubted(tmp_path: Path, unit: str, size: str) -> None:
    (doubt,) = list_doubts(tmp_path, unit=unit, left=120, right=60, y=450)
    assert size in doubt
    assert "correct `units:`" in doubt


@pytest.mark.parametrize("name", ["hexapod-nategh-agheli", "h4", "pentapod", "6-rus"])
def test_the_shipped_robots_with_the_smallest_margins_are_not_doubted(name: str) -> None:
    findings = inspect_robot(load_cached_robot(name)).findings
    assert not [f for f in findings if f.code.endswith(("near-singularity", "unusual-size"))]
