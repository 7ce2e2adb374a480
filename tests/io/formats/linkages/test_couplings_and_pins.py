# SPDX-License-Identifier: Apache-2.0
"""Joints that follow others, pins of other programs, and files beside a URDF."""

import numpy as np
import pytest

from loopcal.errors import LoopcalError
from loopcal.io.formats.import_export import export_robot
from loopcal.io.formats.linkages import urdf
from loopcal.io.formats.program_format import ExportSource
from loopcal.mechanism.solutions import forward, inverse
from tests.io.formats.linkages.test_urdf_closures import FIVE_BAR, MOTORS, PIN, make_joint, read

LINKS = "".join(f'<link name="{n}"/>' for n in ("base", "arm1", "rod", "arm2", "tip"))
FOUR_BAR = (
    f'<robot name="p">{LINKS}'
    + make_joint("motor", "base", "arm1", "0 0 0", 1.0)
    + make_joint("elbow", "arm1", "rod", "0.2 0 0", -1.0)
    + make_joint("other", "base", "arm2", "0.3 0 0", 1.0)
    + make_joint("tip_frame", "rod", "tip", "0.1 0 0", kind="fixed")
)
TRANSMISSION = '<transmission name="t"><joint name="{}"/></transmission>'
GAZEBO = """\
<gazebo><joint name="pin" type="revolute"><!-- cut -->
<parent>rod</parent><child>arm2</child><pose>0.2 0 0 0 0 0</pose><axis><xyz>0 0 1</xyz></axis>
</joint></gazebo>
"""
END = np.array([0.3 + 0.2 * np.cos(1.0), 0.2 * np.sin(1.0), 0.0])
"""The pin of the four-bar in its base [m]."""
SCIKIT = f"""\
closures: [{{link_a: rod, link_b: arm2, point: {END.tolist()}, axis: [0, 0, 1]}}]
dependent: [elbow, other]
independent: [motor]
"""


def make_mimic(joint: str, followed: str, factor: float, offset: float = 0.0) -> str:
    """Return a joint with a mimic element."""
    mimic = f'<mimic joint="{followed}" multiplier="{factor}" offset="{offset}"/></joint>'
    return joint.replace("</joint>", mimic)


LOOP_JOINT = """\
<loop_joint name="pin" type="revolute"><axis xyz="0 0 1"/>
<link1 link="rod" xyz="0.3 0 0" rpy="0 0 0"/><link2 link="arm2" xyz="0.2 0 0" rpy="0 0 0"/>
</loop_joint>
"""


@pytest.mark.parametrize("how", ["gazebo", "loop_joint", "scikit-robot"])
def test_pins_of_other_programs_close_a_parallelogram(tmp_path, how) -> None:
    motor = TRANSMISSION.format("motor")
    if how != "scikit-robot":
        pin = {"gazebo": GAZEBO, "loop_joint": LOOP_JOINT}[how]
        robot = read(tmp_path, f"{FOUR_BAR}{pin}{motor}</robot>")[1]
    else:
        (tmp_path / "loop_closures.yaml").write_text(SCIKIT)
        robot = read(tmp_path, f"{FOUR_BAR}</robot>")[1]
    q = np.linspace(-0.4, 0.4, 5)[:, None]
    T = forward(robot, q).T
    place = 0.2 * np.exp(1j * (1.0 + q[:, 0])) + 0.1
    np.testing.assert_allclose(T[:, 0, 3] + 1j * T[:, 1, 3], place, rtol=0, atol=1e-12)  # [m]
    np.testing.assert_allclose(T[:, :3, :3], np.tile(np.eye(3), (5, 1, 1)), rtol=0, atol=1e-12)


def test_joint_inside_gazebo_is_written_back(tmp_path) -> None:
    text = f"{FOUR_BAR}{GAZEBO}{TRANSMISSION.format('motor')}</robot>"
    robot = read(tmp_path, text)[1]
    assert export_robot(ExportSource(robot), urdf.FORMAT, tmp_path / "r.urdf").text == text
    changes = 1e-3 * np.random.default_rng(3).uniform(-1, 1, len(robot.values))
    changed = robot.with_values(robot.values + changes)
    exported = export_robot(ExportSource(changed), urdf.FORMAT, tmp_path / "r.urdf")
    assert "<!-- cut -->" in exported.text
    q = np.linspace(-0.4, 0.4, 5)[:, None]
    expected = forward(changed, q).T
    again = read(tmp_path, exported.text)[1]
    np.testing.assert_allclose(forward(again, q).T, expected, rtol=0, atol=1e-9)  # [m, 1]
    assert np.abs(expected - forward(robot, q).T).max() > 1e-4


def test_file_of_another_purpose_beside_a_urdf_is_no_closure_file(tmp_path) -> None:
    robot = read(tmp_path, FIVE_BAR, "format: 1\nfamily: limbs\nname: r\n")[1]
    assert [actuator.name for actuator in robot.actuators] == ["mot1", "mot2"]


def test_pads_of_a_gripper_on_one_motor_move_against_each_other(tmp_path) -> None:
    text = (
        f'<robot name="g">{"".join(f"<link name={n!r}/>" for n in ("base", "left", "right"))}'
        + make_joint("left_finger", "base", "left", "0.05 0 0")
        + make_mimic(make_joint("right_finger", "base", "right", "-0.05 0 0"), "left_finger", -1)
        + TRANSMISSION.format("left_finger")
        + "</robot>"
    ).replace("'", '"')
    robot = read(tmp_path, text, platform="right")[1]
    q = np.linspace(-1, 1, 5)
    T = forward(robot, q[:, None]).T
    assert [actuator.name for actuator in robot.actuators] == ["left_finger"]
    np.testing.assert_allclose(np.arctan2(T[:, 1, 0], T[:, 0, 0]), -q, rtol=0, atol=1e-12)


def test_two_cranks_of_one_motor_are_the_five_bar_with_both_readings(tmp_path) -> None:
    both = read(tmp_path, FIVE_BAR)[1]
    crank = make_joint("mot2", "base", "arm2", "0.075 0 0", 0.84)
    coupled = FIVE_BAR.replace(crank, make_mimic(crank, "mot1", -1, 0.02))
    text = coupled.replace(MOTORS, TRANSMISSION.format("mot1"))
    imported, robot = read(tmp_path, text)
    assert imported.findings[0].data["mobility"] == 1
    home = inverse(robot, robot.home[None]).q
    q = home + np.linspace(-0.1, 0.1, 5)[:, None]
    expected = forward(both, np.column_stack([q, 0.02 - q])).T
    np.testing.assert_allclose(forward(robot, q).T, expected, rtol=0, atol=1e-12)


def test_wrong_closure_of_several_is_named_with_its_gaps(tmp_path) -> None:
    """Two four-bars side by side on one platform: the second pin is a meter off."""
    second = PIN.replace('"pin"', '"far_pin"').replace("rod2", "arm2").replace("rod1", "rod")
    good = second.replace("far_pin", "pin").replace(
        'child_origin xyz="0.3', 'child_origin xyz="0.2'
    )
    brace = (
        '<link name="arm3"/>'
        + make_joint("third", "base", "arm3", "0.2 0 0", 1.0)
        + good.replace('"pin"', '"{}"').replace("arm2", "arm3").replace("0.3 0 0", "{} 0 0")
    )
    start = f"{FOUR_BAR}{good}{TRANSMISSION.format('motor')}"
    read(tmp_path, f"{start}{brace.format('third_pin', 0.2)}</robot>", platform="rod")
    wrong = f"{start}{brace.format('third_pin', 1.2)}</robot>"
    with pytest.raises(LoopcalError, match=r"closure 'third_pin', .* stays .* mm and .* apart"):
        read(tmp_path, wrong, platform="rod")
