# SPDX-License-Identifier: Apache-2.0
"""Joints that gears, racks and belts couple, against closure equations in numpy."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from loopcal.apply.compensation import compensate
from loopcal.cli.entry_point import main
from loopcal.errors import FileError, MechanismError
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import MAP
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.readings import select_joint_values
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.sensitivity import differentiate_passive_joints
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from tests.jacobians import check_jacobian
from tests.mechanism.derivatives import check_pose_derivatives
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]

HEAD = """format: 1
family: limbs
units: {length: mm, angle: deg}
"""

GEARED = f"""{HEAD}name: geared-five-bar
freedoms: [x, y]
controlled: [x]
drives:
  motor: {{reads: angle, stroke: [60, 150], unknown: [offset], angle: {{sd: 0.3}}}}
couplings:
  gears: {{sum: {{motor: 2, b.pin: 1}}, offset: 290, unknown: [offset, weight.motor], angle: {{sd: 0.3}}, weights: {{sd: 0.01}}}}
limbs:
  - {{name: a, chain: [{{joint: R, name: pin, at: [-100, 0, 0], axis: z, actuated: motor, start: 110}}], tip: [100, 0, 0], ending: distance, length: 200, errors: [{{of: rod, shift: [length], tolerance: {{sd: 0.1}}}}]}}
  - {{name: b, chain: [{{joint: R, name: pin, at: [100, 0, 0], axis: z, start: 70}}], tip: [100, 0, 0], ending: distance, length: 200, errors: [{{of: tip, shift: [x], tolerance: {{sd: 0.1}}}}]}}
home: {{y: 240}}
workspace: {{x: [-15, 10]}}
"""  # noqa: E501

TRAIN = f"""{HEAD}name: passive-gears
freedoms: [x, y]
controlled: [y]
drives:
  rod: {{reads: length, unknown: [offset], length: {{sd: 0.2}}}}
couplings:
  gears: {{sum: {{a.pin: 1, b.pin: 1.2}}, offset: 194, unknown: [offset, weight.b.pin], angle: {{sd: 0.3}}, weights: {{sd: 0.01}}}}
limbs:
  - {{name: a, chain: [{{joint: R, name: pin, at: [-100, 0, 0], start: 110}}], tip: [100, 0, 0], ending: distance, length: 200}}
  - {{name: b, chain: [{{joint: R, name: pin, at: [100, 0, 0], start: 70}}], tip: [100, 0, 0], ending: distance, length: 200, errors: [{{of: tip, shift: [x], tolerance: {{sd: 0.1}}}}]}}
  - {{name: c, tip: [0, -50, 0], ending: distance, actuated: rod}}
home: {{y: 240}}
workspace: {{y: [225, 250]}}
"""  # noqa: E501

RACK = f"""{HEAD}name: rack
freedoms: [x, y, rz]
controlled: [x]
drives:
  slide: {{reads: length, stroke: [-50, 50], unknown: [gain], ratio: {{sd: 0.001}}}}
couplings:
  rack: {{of: length, sum: {{slide: 1}}, radius: {{arm.pinion: -12}}, offset: 2, unknown: [offset, radius], length: {{sd: 0.1}}, radii: {{sd: 0.05}}}}
limbs:
  - {{name: arm, ending: rigid, chain: [{{joint: P, name: way, axis: x, actuated: slide}}, {{joint: R, name: pinion, axis: z}}], attach: [-100, 0, 0]}}
workspace: {{x: [-40, 40]}}
"""  # noqa: E501

GRIPPER = f"""{HEAD}name: gripper
freedoms: [x, y, rz]
controlled: [y]
drives:
  motor: {{reads: angle, stroke: [-20, 60], unknown: [offset], angle: {{sd: 0.3}}}}
bodies: [{{name: other, home: {{x: 59, y: -30}}}}]
couplings:
  mimic: {{sum: {{drvo.pin: 1, motor: -0.5}}, unknown: [weight.motor], weights: {{sd: 0.01}}}}
limbs:
  - {{name: drv, ending: ball, chain: [{{joint: R, name: pin, at: [0, 20, 0], axis: z, actuated: motor, start: 20}}], tip: [60, 0, 0], errors: [{{of: tip, shift: [x], tolerance: {{sd: 0.1}}}}]}}
  - {{name: fol, ending: ball, chain: [{{joint: R, name: pin, at: [20, 20, 0], axis: z, start: 20}}], tip: [60, 0, 0], attach: [20, 0, 0]}}
  - {{name: drvo, to: other, ending: ball, chain: [{{joint: R, name: pin, at: [0, -20, 0], axis: -z, start: 10}}], tip: [60, 0, 0]}}
  - {{name: folo, to: other, ending: ball, chain: [{{joint: R, name: pin, at: [20, -20, 0], axis: -z, start: 10}}], tip: [60, 0, 0], attach: [20, 0, 0]}}
home: {{x: 56, y: 40}}
workspace: {{y: [25, 60]}}
"""  # noqa: E501


def draw_errors(robot: Mechanism, seed: int) -> Mechanism:
    """Return a machine with drawn errors of all parameters."""
    return robot.with_values(sample_truth(robot, 1, seed)[0])


def get(robot: Mechanism, name: str) -> float:
    """Return the value of a parameter [SI]."""
    return float(robot.values[robot.parameters.index(name)])


def draw_readings(robot: Mechanism, count: int) -> Array:
    """Return readings of reachable poses."""
    return sample_workspace(robot, count, seed=3).solution.q


def point_at(x: float, length: float | Array, angle: Array) -> Array:
    """Return the end (.., 2) of a crank on the x axis."""
    return np.stack([x + length * np.cos(angle), length * np.sin(angle)], axis=-1)


def test_a_crank_that_gears_turn_agrees_with_its_drawing(tmp_path: Path) -> None:
    robot = draw_errors(load_text(tmp_path, GEARED), 1)
    q = draw_readings(robot, 100)
    solved = forward(robot, q)
    assert solved.converged.all()
    first = q[:, 0] + get(robot, "motor.offset")
    second = get(robot, "gears.offset") - get(robot, "gears.weight.motor") * first
    a, b = point_at(-0.1, 0.1, first), point_at(0.1, get(robot, "b.tip.x"), second)
    center = solved.T[:, :2, 3]
    gaps = np.linalg.norm(center - a, axis=1) - get(robot, "a.length")
    assert np.abs(gaps).max() < 1e-9
    assert np.abs(np.linalg.norm(center - b, axis=1) - 0.2).max() < 1e-9
    assert_allclose(inverse(robot, solved.T).q, q, rtol=0, atol=1e-9)


def test_a_driven_joint_with_the_name_of_its_drive_is_not_passive(tmp_path: Path) -> None:
    text = GEARED.replace("actuated: motor", "actuated: pin").replace("{motor: 2,", "{pin: 2,")
    text = text.replace("weight.motor", "weight.pin").replace("motor: {", "motor: {sum: {pin: 1}, ")
    robot = load_text(tmp_path, text)
    assert [f"{limb.name}.{j.name}" for limb, j in robot.assembly.passive_joints] == ["b.pin"]


def test_gears_between_passive_joints_agree_with_their_drawing(tmp_path: Path) -> None:
    robot = draw_errors(load_text(tmp_path, TRAIN), 1)
    q = draw_readings(robot, 100)
    solved = forward(robot, q)
    center = solved.T[:, :2, 3]
    rod = np.linalg.norm(center - [0.0, -0.05], axis=1)
    assert_allclose(rod, q[:, 0] + get(robot, "rod.offset"), rtol=0, atol=1e-9)

    def turn(x: float, crank: float, side: float) -> Array:
        arm = center - [x, 0.0]
        square = (arm**2).sum(axis=1)
        cosine = (square + crank**2 - 0.04) / (2 * crank * np.sqrt(square))
        return np.arctan2(arm[:, 1], arm[:, 0]) + side * np.arccos(cosine)

    first, second = turn(-0.1, 0.1, 1.0), turn(0.1, get(robot, "b.tip.x"), -1.0)
    total = first + get(robot, "gears.weight.b.pin") * second
    assert_allclose(total, get(robot, "gears.offset"), rtol=0, atol=1e-8)
    assert_allclose(inverse(robot, solved.T).q, q, rtol=0, atol=1e-9)


def test_a_pinion_turns_by_the_path_of_its_rack(tmp_path: Path) -> None:
    robot = draw_errors(load_text(tmp_path, RACK), 2)
    q = draw_readings(robot, 100)
    path = q[:, 0] * get(robot, "slide.gain")
    radius = get(robot, "rack.radius.arm.pinion")
    assert radius == pytest.approx(-0.012, abs=3e-4)
    angle = (get(robot, "rack.offset") - path) / radius
    T = forward(robot, q).T
    assert_allclose(np.arctan2(T[:, 1, 0], T[:, 0, 0]), angle, rtol=0, atol=1e-12)
    assert_allclose(T[:, 0, 3], path + 0.1 * np.cos(angle), rtol=0, atol=1e-12)


@pytest.mark.parametrize("text", [GEARED, TRAIN, RACK])
def test_poses_of_coupled_joints_are_differentiated_by_all_terms(tmp_path: Path, text: str) -> None:
    robot = draw_errors(load_text(tmp_path, text), 3)
    check_pose_derivatives(robot, draw_readings(robot, 3)[None])


@pytest.mark.parametrize("text", [GEARED, TRAIN, RACK])
def test_calibration_finds_the_ratio_of_gears(tmp_path: Path, text: str) -> None:
    robot = load_text(tmp_path, text)
    truth = draw_errors(robot, 4)
    instrument = Instrument((Sensor(Pose(), Gaussian(np.repeat([1e-5, 1e-6], 3))),))
    poses = sample_workspace(robot, 40, seed=5).coordinates
    fit = identify(robot, simulate(truth, poses, instrument, 6), MAP())
    score = (fit.robot.values - truth.values)[fit.free_parameters.places] / fit.standard_deviations
    assert np.sqrt(np.mean(score**2)) < 2.0
    places = [i for i, name in enumerate(robot.parameters.names) if "gears.weight" in name]
    assert (
        np.abs(fit.robot.values - truth.values)[places].max(initial=0.0) < 2.5e-3
    )  # a quarter of the tolerance
    reached = forward(truth, compensate(fit.robot, poses[:10]).readings).T
    moved = read_coordinates(reached, robot.controlled)
    assert_allclose(moved, poses[:10], rtol=0, atol=2e-5)


@pytest.mark.parametrize("text", [GEARED, TRAIN, GRIPPER])
def test_passive_joints_are_differentiated_also_where_they_are_coupled(tmp_path, text):
    robot = draw_errors(load_text(tmp_path, text), 5)
    values, q = robot.values[None], draw_readings(robot, 2)
    state = forward_trials(robot, values, q[None])
    known = differentiate_passive_joints(robot, values, q[None], state)
    coupled = {"b.pin", "drvo.pin"} & set(known.names)
    assert coupled

    def move(x: Array) -> Array:
        solved = forward_trials(robot, x, q[None], state)
        joints = select_joint_values(robot, known.names, q[None], solved)
        return np.stack([joints[name] for name in known.names], axis=2)

    check_jacobian(
        move,
        known.parameters[0],
        robot.values,
        scale=0.01,
        atol=1e-8,
        atol_reason="[rad] Newton's own accuracy over the smallest step",
        is_batched=True,
    )


def test_two_fingers_on_one_motor_agree_with_their_drawing(tmp_path: Path) -> None:
    robot = draw_errors(load_text(tmp_path, GRIPPER), 6)
    q = draw_readings(robot, 100)
    state = forward_trials(robot, robot.values[None], q[None])
    assert (state.status == Status.CONVERGED).all()
    angle = q[:, 0] + get(robot, "motor.offset")
    second = get(robot, "mimic.weight.motor") * angle  # its nominal value is negative
    finger, other = state.T[0, :, :2, 3], state.others[0][0, :, :2, 3]
    first = get(robot, "drv.tip.x")
    assert_allclose(finger, np.add(point_at(0, first, angle), [0, 0.02]), rtol=0, atol=1e-9)
    assert_allclose(other, np.add(point_at(0, 0.06, second), [0, -0.02]), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "old", "new", "said"),
    [
        (GEARED, "b.pin: 1", "b.pn: 1", "did you mean 'b.pin'"),
        (GEARED, "motor: 2, b.pin: 1", "motor: 0, b.pin: 0", "no weight other than 0"),
        (GEARED, "unknown: [offset, weight.motor]", "unknown: [weight.b]", "no term 'weight.b'"),
        (GEARED, "{motor: 2, b.pin: 1}", "{motor: 2, b.pin: .inf}", "b.pin"),
        (GEARED, "gears:", "other: {sum: {motor: 1, b.pin: 1}}\n  gears:", "Leave out"),
        (TRAIN, "gears:", "other: {sum: {a.pin: 2, b.pin: 2.4}}\n  gears:", "follows from"),
        (
            TRAIN,
            "gears:",
            "other: {sum: {a.pin: 2, b.pin: 1}, offset: 290}\n  gears:",
            "leave it 0 freedoms",
        ),
        (RACK, "sum: {slide: 1}", "sum: {slide: 1, arm.pinion: 2}", "under both"),
        (
            RACK,
            "radius: {arm.pinion: -12}",
            "radius: {arm.way: -12}",
            "radius of 'arm.way', which slides",
        ),
        (
            RACK,
            "of: length, sum: {slide: 1}, radius: {arm.pinion: -12}",
            "of: length, sum: {arm.pinion: 1}",
            "or under `radius:`",
        ),
    ],
)
def test_impossible_couplings_are_refused(tmp_path, text, old, new, said):
    changed = text.replace(old, new)
    assert changed != text
    with pytest.raises((FileError, MechanismError)) as refused:
        load_text(tmp_path, changed)
    assert said in str(refused.value)


def test_the_gears_of_par4_turn_its_tool_as_its_closure_states() -> None:
    nominal = load_cached_robot("par4")
    robot = draw_errors(nominal, 7)
    q = draw_readings(nominal, 100)
    state = forward_trials(robot, robot.values[None], q[None])
    assert (state.status == Status.CONVERGED).all()
    front, back, bar = (T[0] for T in state.others)
    tool = state.T[0]

    def yaw(T: Array) -> Array:
        return np.arctan2(T[:, 1, 0], T[:, 0, 0])

    for half, name in ((front, "front"), (back, "back")):
        at_bar = [get(robot, f"hinge-{name}.bar.{axis}") for axis in "xy"]
        gap = half @ [0, 0.06, 0, 1] - bar @ [*at_bar, 0.0, 1.0]
        assert np.abs(gap).max() < 1e-9
    turn = get(robot, "gears.offset") - get(robot, "gears.weight.hinge-front.pin") * (
        yaw(bar) - yaw(front)
    )
    assert_allclose(yaw(tool) - yaw(bar), turn, rtol=0, atol=1e-9)
    assert_allclose(tool[:, :3, 3], bar[:, :3, 3], rtol=0, atol=1e-9)
    motors = {1: (0.2, 0.2, 45), 2: (0.2, -0.2, -45), 3: (-0.2, -0.2, -135), 4: (-0.2, 0.2, 135)}
    for name, half, elbow, ball in (
        ("arm1a", front, 0.04, [1.7157, 88.2843]),
        ("arm1b", front, -0.04, [58.2843, 31.7157]),
        ("arm2", front, 0.0, [30, -60]),
        ("arm3a", back, 0.04, [-1.7157, -88.2843]),
        ("arm3b", back, -0.04, [-58.2843, -31.7157]),
        ("arm4", back, 0.0, [-30, 60]),
    ):
        number = int(name[3])
        x, y, heading = motors[number]
        angle = q[:, number - 1] + get(robot, f"q{number}.offset")
        c, s = np.cos(np.deg2rad(heading)), np.sin(np.deg2rad(heading))
        reach = 0.3 * np.cos(angle)
        tip = [x + c * reach - s * elbow, y + s * reach + c * elbow, -0.3 * np.sin(angle)]
        end = half @ [ball[0] * 1e-3, ball[1] * 1e-3, 0.0, 1.0]
        rod = np.linalg.norm(end[:, :3] - np.stack(tip, axis=1), axis=1)
        assert_allclose(rod, get(robot, f"{name}.length"), rtol=0, atol=1e-9)


def test_poses_of_par4_are_differentiated_by_all_terms() -> None:
    robot = draw_errors(load_cached_robot("par4"), 3)
    check_pose_derivatives(robot, draw_readings(robot, 2)[None])


def test_a_stage_of_a_chain_has_couplings_of_its_own(tmp_path: Path) -> None:
    own = GEARED.partition("name: geared-five-bar\n")[2].partition("workspace:")[0]
    text = """format: 1
family: stages
name: cell
units: {length: mm, angle: deg}
controlled: [x, z]
stages:
  - {name: lift, joint: {kind: P, axis: z, stroke: [-100, 100]}}
  - name: bars
    family: limbs
""" + "".join(f"    {line}\n" for line in own.splitlines())
    cell, bars = load_text(tmp_path, text), load_text(tmp_path, GEARED)
    assert "bars.gears.weight.motor" in cell.parameters.names
    inner = draw_readings(bars, 20)
    q = np.column_stack([np.linspace(-0.05, 0.05, 20), inner])
    machine = draw_errors(cell, 3)
    alone = bars.with_values(machine.values[-len(bars.parameters) :])
    T, expected = forward(machine, q).T, forward(alone, inner).T
    assert_allclose(T[:, :2, 3], expected[:, :2, 3], rtol=0, atol=1e-12)
    assert_allclose(inverse(machine, T).q, q, rtol=0, atol=1e-9)
    check_pose_derivatives(machine, q[None, :2])


@pytest.mark.parametrize("name", ["par4", "warm-delta"])
def test_the_check_of_a_robot_lists_its_couplings(name, capsys):
    assert main(["check", name, "--expand"]) == 0
    assert "what couplings hold" in capsys.readouterr().out


def write_arm(name: str, x: float, more: str = "") -> str:
    """Return one of three parallel arms of a loop that is closed for exact geometry only."""
    return (
        f"  - {{name: {name}, {more}tip: [100, 0, 0], ending: ball, attach: [{x - 100}, 0, 0], "
        f"chain: [{{joint: R, name: pin, at: [{x}, 0, 0], start: 70, actuated: {name}}}], "
        "errors: [{of: tip, shift: [x], tolerance: {sd: 0.1}}]}\n"
    )


OPEN = f"{HEAD}name: arms\nclosure: least-squares\nfreedoms: [x, y, rz]\ncontrolled: [x]\n"
BELT = f"""{OPEN}drives: {{a: {{reads: angle, unknown: [offset], angle: {{sd: 0.3}}}}}}
couplings:
  belt: {{sum: {{a: 1, b.pin: -1}}, unknown: [offset, weight.a], angle: {{sd: 0.01}},
    weights: {{sd: 0.0001}}}}
limbs:
{write_arm("a", 0)}{write_arm("b", 100)}{write_arm("c", 200)}\
home: {{x: 134.2020143, y: 93.96926208}}
workspace: {{x: [100, 150]}}
""".replace(", actuated: b", "").replace(", actuated: c", "")
ON_CAR = "".join(write_arm(n, x, "on: car, ") for n, x in zip("abc", (0, 100, 200), strict=True))
PINION = (
    f"""{OPEN}drives: {{rod: {{reads: length, unknown: [offset], length: {{sd: 0.1}}}}}}
bodies: [{{name: car}}]
couplings:
  rack: {{of: length, sum: {{s.way: 1}}, radius: {{a.pin: 30}}, offset: 36.65,
    unknown: [offset, radius], length: {{sd: 0.01}}, radii: {{sd: 0.01}}}}
limbs:
  - {{name: s, to: car, ending: rigid, chain: [{{joint: P, name: way, axis: x}}]}}
{ON_CAR}  - {{name: r, tip: [250, 0, 0], ending: distance, actuated: rod}}
home: {{x: 134.2020143, y: 93.96926208}}
workspace: {{x: [100, 150]}}
""".replace(", actuated: a}", "}")
    .replace(", actuated: b}", "}")
    .replace(", actuated: c}", "}")
)


@pytest.mark.parametrize(("text", "share"), [(BELT, 1e-6), (PINION, 1e-3)])
def test_derivatives_of_loops_that_stay_open_between_gears(tmp_path, text, share) -> None:
    """Where closure determines coupled joints, terms of the gap over the size are neglected."""
    robot = draw_errors(load_text(tmp_path, text), 1)
    solved = forward(robot, inverse(robot.nominal, np.array([[0.12], [0.134], [0.14]])).q)
    assert 1e-5 < solved.residual.max() < 1e-4  # [m]: the loops stay open
    values, q = robot.values[None], solved.q[None]
    names, *_ = sensed = differentiate_passive_joints(robot, values, q, solved.state)
    assert names == solved.passive_names
    for p, step in enumerate(1e-6 * np.eye(len(robot.values))):
        up, down = (forward(robot.with_values(robot.values + s), solved.q, start=solved).passive
                    for s in (step, -step))  # fmt: skip
        slope = (up - down) / 2e-6
        assert np.abs(slope - sensed.parameters[0, ..., p]).max() < share * np.abs(slope).max()


# --- couplings between the stages of a chain

LEVEL_ARM = """format: 1
family: stages
name: level-arm
units: {length: m, angle: rad}
controlled: [x, z, pitch]
couplings:
  belts: {sum: {shoulder: 1, elbow.serial.joint: 0.5}, offset: 0.4, unknown: [offset, weight.elbow.serial.joint], angle: {sd: 0.003}, weights: {sd: 0.001}}
stages:
  - {name: shoulder, joint: {kind: R, axis: y, start: 0.5, errors: [offset], angle: {sd: 0.002}}}
  - {name: elbow, mount: {x: 0.3}, joint: {kind: R, axis: y, drive: none, start: -0.2, errors: [x], length: {sd: 0.0002}}}
  - {name: slide, mount: {x: 0.2}, joint: {kind: P, axis: x, start: 0.05}}
  - {name: wrist, joint: {kind: R, axis: y, start: 0.1, tip: [0.08, 0, 0]}}
workspace: {x: [0.4, 0.5], z: [-0.25, -0.15], pitch: [0, 0.5]}
"""  # noqa: E501

ROPE_TABLE = """format: 1
family: stages
name: rope-table
units: {length: m, angle: rad}
controlled: [x, y, z, roll, pitch, yaw]
couplings:
  rope: {of: length, sum: {q1: 1}, radius: {table.serial.joint: 0.25}, unknown: [offset, radius], length: {sd: 0.0002}, radii: {sd: 0.0005}}
stages:
  - {name: table, joint: {kind: R, axis: z, drive: none, tip: [0, 0, 0.02]}}
  - name: legs
    mount: {x: 0.03, yaw: 0.3}
    family: gough
    base: [[0.25, -0.02, 0], [0.25, 0.02, 0], [-0.107, 0.226, 0], [-0.142, 0.206, 0], [-0.142, -0.206, 0], [-0.107, -0.226, 0]]
    platform: [[0.092, -0.119, 0], [0.092, 0.119, 0], [0.057, 0.139, 0], [-0.15, 0.02, 0], [-0.15, -0.02, 0], [0.057, -0.139, 0]]
    lengths: 0.353
    home: {z: 0.3}
    tolerances: {base: {sd: 0.0002}, platform: {sd: 0.0002}, length: {sd: 0.0002}}
workspace: {x: [0, 0.06], y: [-0.03, 0.03], z: [0.3, 0.34], roll: [-0.1, 0.1], pitch: [-0.1, 0.1], yaw: [0.25, 0.35]}
"""  # noqa: E501


LOADER = """format: 1
family: stages
name: loader
units: {length: m, angle: rad}
controlled: [x, z]
couplings:
  belt: {sum: {shoulder: 0.5, bars.a.crank: 1}, offset: 0.35, unknown: [offset], angle: {sd: 0.003}}
stages:
  - {name: shoulder, joint: {kind: R, axis: y, start: 0.5}}
  - name: bars
    mount: {x: 0.3}
    family: limbs
    freedoms: [x, z, ry]
    controlled: [x]
    home: {x: 0.1, z: 0.12}
    limbs:
      - {name: a, ending: rigid, attach: [-0.1, 0, 0], chain: [{joint: R, name: crank, axis: y, start: 0.1}, {joint: R, name: pin, at: [0, 0, 0.12], axis: y}], errors: [{of: pin, shift: [z], tolerance: {sd: 0.0002}}]}
      - {name: b, ending: rigid, attach: [0.1, 0, 0], chain: [{joint: R, name: rocker, at: [0.2, 0, 0], axis: y, start: 0.1}, {joint: R, name: pin, at: [0, 0, 0.14], axis: y}]}
  - {name: slide, joint: {kind: P, axis: x, start: 0.05, tip: [0.1, 0, 0]}}
workspace: {x: [0.35, 0.5], z: [-0.15, -0.05]}
"""  # noqa: E501


def turn(axis: str, angle: Array) -> Array:
    """Return poses (n, 4, 4) turned about an axis."""
    T = np.tile(np.eye(4), (len(angle), 1, 1))
    T[:, :3, :3] = Rotation.from_euler(axis, angle[:, None]).as_matrix()
    return T


def compare_level_arm(value: dict[str, float], q: Array, T: Array) -> Array:
    """Return by how much poses (n, 4, 4) of LEVEL_ARM differ from those of its drawing."""
    upper = q[:, 0] + value["shoulder.offset"]
    fore = upper + (value["belts.offset"] - upper) / value["belts.weight.elbow.serial.joint"]
    arms = [(0.3 + value["elbow.x"], upper), (0.2 + q[:, 1], fore), (0.08, fore + q[:, 2])]
    end = turn("y", fore + q[:, 2])
    end[:, 0, 3] = sum(length * np.cos(angle) for length, angle in arms)
    end[:, 2, 3] = sum(-length * np.sin(angle) for length, angle in arms)
    return T - end


def compare_rope_table(value: dict[str, float], q: Array, T: Array) -> Array:
    """Return by how much readings (n, 6) of ROPE_TABLE differ from the lengths of its legs."""
    angle = (value["rope.offset"] - q[:, 0]) / value["rope.radius.table.serial.joint"]
    mount = turn("z", np.array([0.3]))
    mount[:, :3, 3] = [0.03, 0, 0.02]
    own = np.linalg.inv(turn("z", angle) @ mount) @ T
    base, top = (
        np.array([[value[f"legs.leg{i}.{part}.{a}"] for a in "xyz"] for i in range(1, 7)])
        for part in ("base", "platform")
    )
    gaps = own[:, None, :3, 3] + np.einsum("nij,kj->nki", own[:, :3, :3], top) - base
    lengths = [value[f"legs.leg{i}.length"] for i in range(1, 7)]
    return np.asarray(np.linalg.norm(gaps, axis=2) - lengths - q)


def compare_loader(value: dict[str, float], q: Array, T: Array) -> Array:
    """Return by how much the bars (n, 3) of LOADER are off their pins, at its slide and belt."""
    carrier, slide = turn("y", q[:, 0]), turn("x", np.zeros(len(q)))
    carrier[:, :3, 3] = carrier[:, :3, 0] * 0.3
    slide[:, 0, 3] = q[:, 1] + 0.1
    coupler = np.linalg.inv(carrier) @ T @ np.linalg.inv(slide)
    crank = value["belt.offset"] - 0.5 * q[:, 0]
    pin = value["bars.a.pin.z"] * np.column_stack([np.sin(crank), np.cos(crank)])
    first, last = (coupler[:, [0, 2], 3] + x * coupler[:, [0, 2], 0] for x in (-0.1, 0.1))
    rocker = np.linalg.norm(last - [0.2, 0.0], axis=1) - 0.14
    return np.column_stack([first - pin, rocker])


CHAINS = {
    "level-arm": (LEVEL_ARM, compare_level_arm),
    "rope-table": (ROPE_TABLE, compare_rope_table),
    "loader": (LOADER, compare_loader),
}


@pytest.mark.parametrize("name", CHAINS)
def test_stages_of_a_chain_are_coupled(tmp_path: Path, name: str) -> None:
    """An arm whose belts turn its elbow, a hexapod that turns the table that carries it, and an arm
    whose shoulder turns a plane linkage.
    """
    text, compare = CHAINS[name]
    nominal = load_text(tmp_path, text)
    robot = nominal.with_values(sample_truth(nominal, 1, 1)[0])
    reached = inverse(robot, sample_workspace(nominal, 100, seed=2).coordinates)
    assert reached.converged.all()
    value = dict(zip(robot.parameters.names, robot.values, strict=True))
    assert np.abs(compare(value, reached.q, reached.T)).max() < 1e-9
    there = forward(robot, reached.q)
    assert there.converged.all()
    assert_allclose(there.T, reached.T, rtol=0, atol=1e-9)
    check_pose_derivatives(robot, there.q[None, :3])


@pytest.mark.parametrize("name", CHAINS)
def test_coupled_chains_are_as_accurate_as_stated(tmp_path: Path, name: str) -> None:
    robot = load_text(tmp_path, CHAINS[name][0])
    instrument = Instrument((Sensor(Pose("rotation-vector"), Gaussian(np.repeat(1e-5, 6))),))
    poses, truth = sample_workspace(robot, 40, seed=1).coordinates, sample_truth(robot, 40, 2)
    trials = simulate_trials(robot, truth, poses, instrument, 3)
    fits = identify_trials(robot, trials, MAP())
    assert fits.converged.all()
    error = (fits.values - truth) / fits.standard_deviations()
    assert (error**2).mean() == pytest.approx(1.0, abs=3 * np.sqrt(2 / error.size))


def test_a_coupled_chain_refuses_what_it_cannot_be(tmp_path: Path) -> None:
    for old, new, sentence in (
        ("drive: none, start: -0.2, errors: [x]", "drive: none, errors: [gain]", "has no drive"),
        ("elbow.serial.joint: 0.5", "elbow.joint: 0.5", "'elbow.joint', which is neither"),
        ("of: length, sum", "of: length, condition: temperature, sum", "does not state"),
        ("    family: gough\n", "    family: gough\n    tool: {z: 0.1}\n", "states a tool"),
    ):
        text = LEVEL_ARM if old in LEVEL_ARM else ROPE_TABLE
        with pytest.raises((FileError, MechanismError), match=sentence):
            load_text(tmp_path, text.replace(old, new))
    plain = LEVEL_ARM[: LEVEL_ARM.index("couplings:")] + LEVEL_ARM[LEVEL_ARM.index("stages:\n") :]
    with pytest.raises(FileError, match="stage 'elbow' has no actuators"):
        load_text(tmp_path, plain)
