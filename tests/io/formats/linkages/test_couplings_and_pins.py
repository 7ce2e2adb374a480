# SPDX-License-Identifier: Apache-2.0
"""Joints that follow others, pins of other programs, and files beside a URDF."""

import re

import numpy as np
import pytest

from loopcal.errors import LoopcalError
from loopcal.io.formats.import_export import export_robot
from loopcal.io.formats.linkages import urdf
from loopcal.io.formats.program_format import ExportSource
from loopcal.mechanism.solutions import forward, inverse
from tests.io.formats.linkages.test_urdf_closures import (
    BARE,
    FIVE_BAR,
    MOTORS,
    PIN,
    make_joint,
    read,
)

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


@pytest.mark.parametrize(("factor", "offset"), [(-1, 0.02), (1, 0), (0.5, 0.1), (-1.7, -0.05)])
def test_two_cranks_of_one_motor_are_the_five_bar_with_both_readings(
    tmp_path, factor, offset
) -> None:
    both = read(tmp_path, FIVE_BAR)[1]
    crank = make_joint("mot2", "base", "arm2", "0.075 0 0", 0.84)
    coupled = FIVE_BAR.replace(crank, make_mimic(crank, "mot1", factor, offset))
    text = coupled.replace(MOTORS, TRANSMISSION.format("mot1"))
    imported, robot = read(tmp_path, text)
    assert imported.findings[0].data["mobility"] == 1
    home = inverse(robot, robot.home[None]).q
    q = home + np.linspace(-0.1, 0.1, 5)[:, None]
    expected = forward(both, np.column_stack([q, factor * q + offset])).T
    np.testing.assert_allclose(forward(robot, q).T, expected, rtol=0, atol=1e-12)
    check_written_back(tmp_path, text, robot, q)


def check_written_back(folder, text, robot, q, platform=None) -> None:
    """Change all parameters, write the file, and read the machine with these values again."""
    (folder / "r.urdf").write_text(text)
    changes = 1e-3 * np.random.default_rng(3).uniform(-1, 1, len(robot.values))
    changed = robot.with_values(robot.values + changes)
    exported = export_robot(ExportSource(changed), urdf.FORMAT, folder / "r.urdf")
    assert "files.not-expressed" not in {finding.code for finding in exported.findings}
    again = read(folder, exported.text, platform=platform)[1]
    expected = forward(changed, q).T
    np.testing.assert_allclose(forward(again, q).T, expected, rtol=0, atol=1e-9)
    assert np.abs(expected - forward(robot, q).T).max() > 1e-4  # [m, 1]: the changes matter


CHAIN = '<robot name="c">' + "".join(f'<link name="{n}"/>' for n in "abcde")


def make_chain(kinds: str, mimics: dict[int, tuple[int, float, float]], parents: str) -> str:
    """Return a tree of joints j1, j2, .. from links `parents` to b, c, .., of kinds R and P."""
    text = CHAIN
    for i, (kind, parent) in enumerate(zip(kinds, parents, strict=True), 1):
        sort = {"R": "revolute", "P": "prismatic"}[kind]
        joint = make_joint(f"j{i}", parent, "abcde"[i], "0.3 0.1 0", 0.4 * i, sort)
        if kind == "P":
            joint = joint.replace('axis xyz="0 0 1"', 'axis xyz="1 0 0"')
        if i in mimics:
            followed, factor, offset = mimics[i]
            joint = make_mimic(joint, f"j{followed}", factor, offset)
        text += joint
    text += "".join(f'<link name="{n}"/>' for n in "fghi"[: 4 - len(kinds)])
    for link, n in zip("abcde"[len(kinds) + 1 :], "fghi", strict=False):
        text = text.replace(f'<link name="{link}"/>', "").replace(f'<link name="{n}"/>', "")
    return text


def place_chain(kinds: str, values: dict[int, np.ndarray], path: tuple[int, ...]) -> np.ndarray:
    """Return places (n, 2) and angle (n,) of the link behind joints of a plane tree."""
    count = len(next(iter(values.values())))
    place, angle = np.zeros(count, dtype=complex), np.zeros(count)
    for i in path:
        place = place + (0.3 + 0.1j) * np.exp(1j * angle)
        angle = angle + 0.4 * i
        if kinds[i - 1] == "R":
            angle = angle + values[i]
        else:
            place = place + values[i] * np.exp(1j * angle)
    return np.column_stack([np.real(place), np.imag(place), np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(
    ("kinds", "parents", "mimics", "path"),
    [
        ("RRR", "abc", {2: (1, -0.5, 0.1)}, (1, 2, 3)),  # a belt in an arm
        ("RPR", "abc", {2: (1, 0.04, 0.01)}, (1, 2, 3)),  # a pinion
        ("PRR", "abc", {2: (1, 3.0, 0.1)}, (1, 2, 3)),  # a rack
        ("PPR", "abc", {2: (1, -0.5, 0.01)}, (1, 2, 3)),  # a telescope
        ("RRR", "abc", {3: (2, 2.0, 0.0), 2: (1, 1.5, 0.1)}, (1, 2, 3)),  # one after the other
        ("RRR", "aab", {2: (1, 0.5, 0.1)}, (1, 3)),  # what follows carries nothing
        ("RRR", "aac", {2: (1, 0.5, 0.1)}, (2, 3)),  # the motor is on another branch
        ("RPR", "aac", {2: (1, 0.04, 0.01)}, (2, 3)),
    ],
)
def test_chains_of_coupled_joints_agree_with_their_drawing(
    tmp_path, kinds, parents, mimics, path
) -> None:
    motors = [i for i in range(1, len(kinds) + 1) if i not in mimics and (i in path or i == 1)]
    text = make_chain(kinds, mimics, parents) + "".join(
        TRANSMISSION.format(f"j{i}") for i in motors
    )
    text += "</robot>"
    platform = "abcde"[path[-1]]
    robot = read(tmp_path, text, platform=platform)[1]
    names = [int(actuator.name[1:]) for actuator in robot.actuators]
    q = inverse(robot, robot.home[None]).q + np.random.default_rng(1).uniform(
        -0.2, 0.2, (5, len(names))
    )
    values = dict(zip(names, q.T, strict=True))
    while left := [i for i in mimics if i not in values and mimics[i][0] in values]:
        for i in left:
            followed, factor, offset = mimics[i]
            values[i] = factor * values[followed] + offset
    T = forward(robot, q).T
    found = np.column_stack([T[:, 0, 3], T[:, 1, 3], T[:, 0, 0], T[:, 1, 0]])
    np.testing.assert_allclose(found, place_chain(kinds, values, path), rtol=0, atol=1e-12)
    check_written_back(tmp_path, text, robot, q, platform)


def test_platform_that_is_drawn_upside_down_has_only_angles_that_it_can_change(tmp_path) -> None:
    """The ball joint alone would tilt the second arm, the loop does not."""
    ball = PIN.replace("rod2", "arm2").replace("rod1", "rod").replace('"revolute"', '"ball"')
    ball = ball.replace('child_origin xyz="0.3', 'child_origin xyz="0.2')
    text = f"{FOUR_BAR}{ball}{TRANSMISSION.format('motor')}</robot>"
    flipped = text.replace('xyz="0.3 0 0" rpy="0 0 1.0"', f'xyz="0.3 0 0" rpy="{np.pi} 0 1.0"', 1)
    assert flipped != text
    q = np.linspace(-0.3, 0.3, 5)[:, None]
    upright, robot = (read(tmp_path, one, platform="arm2")[1] for one in (text, flipped))
    expected, found = forward(upright, q).T, forward(robot, q).T @ robot.tool
    expected[:, :3, :3] *= [1.0, -1.0, -1.0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_a_five_bar_with_one_motor_is_refused_with_its_mobility(tmp_path) -> None:
    text = FIVE_BAR.replace(MOTORS, TRANSMISSION.format("mot1"))
    with pytest.raises(LoopcalError, match=r"1 motor cannot hold .* the mobility is 2; name more"):
        read(tmp_path, text)


def test_gears_between_passive_joints_take_a_freedom(tmp_path) -> None:
    """The elbows of a five-bar turn together: with one motor it is the one with two motors at
    readings where this is true.
    """
    both = read(tmp_path, FIVE_BAR)[1]
    elbow = make_joint("elbow2", "arm2", "rod2", "0.2 0 0", 1.2, "continuous")
    coupled = FIVE_BAR.replace(elbow, make_mimic(elbow, "elbow1", -0.8, 0.1))
    text = coupled.replace(MOTORS, TRANSMISSION.format("mot1"))
    imported, robot = read(tmp_path, text)
    assert imported.findings[0].data["mobility"] == 1
    q = inverse(robot, robot.home[None]).q + np.linspace(-0.1, 0.1, 5)[:, None]
    T = forward(robot, q).T
    readings = inverse(both, T).q
    np.testing.assert_allclose(readings[:, :1], q, rtol=0, atol=1e-9)
    point = T[:, 0, 3] + 1j * T[:, 1, 3]
    first, second = readings.T + np.array([[2.3], [0.84]])
    turn1 = np.angle(point + 0.075 - 0.2 * np.exp(1j * first)) - first + 1.2
    turn2 = np.angle(point - 0.075 - 0.2 * np.exp(1j * second)) - second - 1.2
    np.testing.assert_allclose(turn2, -0.8 * turn1 + 0.1, rtol=0, atol=1e-9)
    check_written_back(tmp_path, text, robot, q)


TWO = TRANSMISSION.format("j1") + TRANSMISSION.format("j2")
THREE = TRANSMISSION.format("j1") + TRANSMISSION.format("j3")
REFUSED = {
    "two motors": ("RR", {2: (1, 0.5, 0.0)}, "ab", TWO, "'j2' cannot follow 'j1' .* factor 0.5"),
    "no factor": ("RR", {2: (1, 0.0, 0.0)}, "ab", "", "'j2' cannot follow 'j1' .* factor 0"),
    "unknown leader": (
        "RR",
        {2: (7, 1.0, 0.0)},
        "ab",
        "",
        "'j2' .* 'j7' .* not an independent motion",
    ),
    "contradiction": ("RRR", {2: (3, 1, 0), 3: (2, 2, 0)}, "abc", "", "'j3' cannot follow 'j2'"),
    "slide elsewhere": ("PRR", {2: (1, 3.0, 0.0)}, "aac", THREE, "'j2' turns with the slide 'j1'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_couplings_that_no_machine_has_are_refused(tmp_path, case) -> None:
    kinds, mimics, parents, motors, sentence = REFUSED[case]
    text = make_chain(kinds, mimics, parents) + (motors or TRANSMISSION.format("j1")) + "</robot>"
    with pytest.raises(LoopcalError, match=sentence):
        read(tmp_path, text, platform="abcd"[len(kinds)])


def test_a_coupled_joint_that_is_half_of_a_pin_is_refused(tmp_path) -> None:
    pin = make_mimic(make_joint("half", "rod1", "pin1", "0.3 0 0"), "mot1", 0.5)
    end = make_joint("other_half", "rod2", "end2", "0.3 0 0")
    text = BARE.replace("</robot>", f'<link name="pin1"/><link name="end2"/>{pin}{end}</robot>')
    closures = "closed_loop: [[half, other_half]]\ntype: [6d]\nname_mot: [mot1, mot2]\n"
    with pytest.raises(LoopcalError, match="'half' cannot follow 'mot1'"):
        read(tmp_path, text, closures)
    read(tmp_path, re.sub("<mimic[^>]*>", "", text), closures)


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
