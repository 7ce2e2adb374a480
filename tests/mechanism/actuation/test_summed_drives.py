# SPDX-License-Identifier: Apache-2.0
"""Readings that are weighted sums of joint values, against closed forms and a constraint solver;
sums that no machine has are refused; belts that are read by their lengths.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.optimize import fsolve, least_squares
from scipy.spatial.transform import Rotation

import loopcal as lc
from loopcal.apply.calibration import calibrate
from loopcal.errors import FileError, MechanismError
from loopcal.estimate.identification import identify_trials
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.readings import select_joint_values
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.actuation import differentiate_at_pose, solve_at_pose
from loopcal.mechanism.kinematics import compute_closure_sign, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.modes import find_assembly_modes
from loopcal.mechanism.sensitivity import differentiate_passive_joints, differentiate_pose
from loopcal.mechanism.singularities import analyze_singularity
from loopcal.mechanism.solutions import forward, inverse, jacobian
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from tests.jacobians import central_difference, check_jacobian, compile_quickly
from tests.mechanism.derivatives import check_pose_derivatives
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]

WRIST = """format: 1
family: limbs
name: coupled-wrist
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
actuators:
  m1: {reads: angle, gain: 0.5, sum: {j1: 1}, unknown: [offset], angle: {sd: 0.1}}
  j2: {reads: angle, stroke: [-170, 170]}
  j3: {reads: angle, sum: {j2: -0.1, j3: 1}, unknown: [weight.j2], weights: {sd: 0.001}}
limbs:
  - name: arm
    ending: rigid
    chain:
      - {joint: R, name: a, axis: z, actuated: j1, start: 20}
      - {joint: R, name: b, at: [300, 0, 0], axis: z, actuated: j2, start: 60}
      - {joint: R, name: c, at: [250, 0, 0], axis: z, actuated: j3, start: 10}
    tip: [80, 0, 0]
    errors: [{of: b, shift: [x], tolerance: {sd: 0.2}}]
home: {x: 300, y: 350, yaw: 90}
"""

STRUTS = """format: 1
family: limbs
name: struts
units: {length: m, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
actuators:
  q1: {reads: length, sum: {s1: 1, s2: 1}, unknown: [weight, gain, offset], weights: {sd: 0.01}, ratio: {sd: 0.01}, length: {sd: 0.01}}
  q2: {reads: length, period: 0.3, sum: {s1: 1, s3: 2}, unknown: [sin1], length: {sd: 0.001}}
  q3: {reads: angle, radius: 0.1, buildup: 0.001, sum: {s2: 1, s4: 2}, unknown: [radius, buildup], radii: {sd: 0.001}, buildups: {sd: 0.0001}}
limbs:
  - {name: one, tip: [0.1, 0, 0], ending: ball, attach: [-0.15, -0.1, 0], errors: &errors [{of: hinge, shift: [x, y], tolerance: {sd: 0.002}}], chain: [{joint: R, name: hinge, at: [-1, 0.8, 0], start: -45}, {joint: P, name: slide, axis: x, actuated: s1, start: 0.9}]}
  - {name: two, tip: [0.1, 0, 0], ending: ball, attach: [-0.15, 0.1, 0], errors: *errors, chain: [{joint: R, name: hinge, at: [1, 0.8, 0], start: 210}, {joint: P, name: slide, axis: x, actuated: s2, start: 1.2}]}
  - {name: three, tip: [0.1, 0, 0], ending: ball, attach: [0.15, -0.1, 0], errors: *errors, chain: [{joint: R, name: hinge, at: [-1, -0.7, 0], start: 30}, {joint: P, name: slide, axis: x, actuated: s3, start: 1.2}]}
  - {name: four, tip: [0.1, 0, 0], ending: ball, attach: [0.15, 0.1, 0], errors: *errors, chain: [{joint: R, name: hinge, at: [1, -0.7, 0], start: 140}, {joint: P, name: slide, axis: x, actuated: s4, start: 1.1}]}
"""  # noqa: E501

CELL = """format: 1
family: stages
name: cell
units: {length: mm, angle: deg}
controlled: [x, y, z, yaw]
stages:
  - {name: lift, joint: {kind: P, axis: z}}
  - name: plate
    family: limbs
    freedoms: [x, y, rz]
    controlled: [x, y, yaw]
    home: {x: 10}
    actuators:
      q1: {reads: length, sum: {m: 1, n: 1}, unknown: [weight.n], weights: {sd: 0.001}}
      q2: {reads: length, sum: {m: 1, k: 2}}
      q3: {reads: length, sum: {n: 1, h: 2}}
    limbs:
      - {name: m, tip: [-1000, 800, 0], ending: distance, attach: [-150, -100, 0], actuated: m}
      - {name: n, tip: [1000, 800, 0], ending: distance, attach: [-150, 100, 0], actuated: n}
      - {name: k, tip: [-1000, -700, 0], ending: distance, attach: [150, -100, 0], actuated: k}
      - {name: h, tip: [1000, -700, 0], ending: distance, attach: [150, 100, 0], actuated: h}
"""

ARM = """format: 1
family: stages
name: coupled-arm
units: {length: mm, angle: deg}
controlled: [x, z, yaw, roll]
stages:
  - {name: j1, joint: {kind: R, axis: z, start: 20}}
  - name: wrist
    mount: {x: 200}
    family: limbs
    actuators:
      m4: {reads: angle, sum: {j4: 50}, gain: 50}
      m5: {reads: angle, sum: {j5: 1, j4: 0.02}, unknown: [weight.j4], weights: {sd: 0.001}}
      m6: {reads: angle, sum: {j6: 1, j5: -0.5, j4: 0.01}}
    limbs:
      - name: hand
        ending: rigid
        chain:
          - {joint: R, name: d, axis: x, actuated: j4, start: 10}
          - {joint: R, name: e, at: [200, 0, 0], axis: y, actuated: j5, start: 30}
          - {joint: R, name: f, at: [80, 0, 0], axis: x, actuated: j6, start: 20}
        tip: [20, 0, 0]
"""

PLATE = """format: 1
family: limbs
name: plate
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
actuators:
  q1: {reads: length, sum: {m: 1, n: 1}, unknown: [weight.n], weights: {sd: 0.001}}
  q2: {reads: length, sum: {m: 1, k: 2}}
  q3: {reads: length, sum: {n: 1, h: 2}}
limbs:
  - {name: M, tip: [-1000, 800, 0], ending: distance, attach: [-150, -100, 0], actuated: m}
  - {name: N, tip: [1000, 800, 0], ending: distance, attach: [-150, 100, 0], actuated: n}
  - {name: K, tip: [-1000, -700, 0], ending: distance, attach: [150, -100, 0], actuated: k}
  - {name: H, tip: [1000, -700, 0], ending: distance, attach: [150, 100, 0], actuated: h}
"""


def draw_errors(robot: Mechanism, seed: int) -> Mechanism:
    """Return a robot with parameters off by one spread, drawn."""
    sd = np.array([p.tolerance or 0.0 for p in robot.parameters.entries])
    return robot.with_values(
        robot.values + sd * np.random.default_rng(seed).standard_normal(sd.size)
    )


def get(robot: Mechanism, name: str) -> float:
    """Return the value of a parameter [SI]."""
    return float(robot.values[robot.parameters.index(name)])


# --- as many readings as joints


def test_crossed_belts_agree_with_their_closed_form() -> None:
    nominal = load_cached_robot("core-xy")
    robot = draw_errors(nominal, 1)
    q = np.random.default_rng(2).uniform([-20, -20, 0.01], [20, 20, 0.25], (500, 3))
    sums = [
        get(robot, f"{m}.offset") + get(robot, f"{m}.radius") * q[:, i] for i, m in enumerate("ab")
    ]
    u, v = get(robot, "a.weight.y"), get(robot, "b.weight.y")
    y = (sums[0] - sums[1]) / (u - v)  # x + u y = a, x + v y = b
    x = sums[0] - u * y
    z = get(robot, "z.offset") + get(robot, "z.gain") * q[:, 2]
    bridge = [get(robot, f"gantry.x.{axis}") for axis in ("rx", "ry", "rz")]
    lift = [get(robot, f"gantry.z.{axis}") for axis in ("rx", "ry")]
    T = forward(robot, q).T
    # first order in the tilts, of 1 mrad over 0.35 m
    near = np.column_stack([x, y, z]) + np.column_stack(
        [z * (bridge[1] + lift[1]), x * bridge[2] - z * (bridge[0] + lift[0]), -x * bridge[1]]
    )
    assert np.abs(T[:, :3, 3] - near).max() < 3e-6
    straight = nominal.with_values(
        np.where(["gantry" in n for n in robot.parameters.names], 0.0, robot.values)
    )
    exact = forward(straight, q).T[:, :3, 3]
    assert_allclose(exact, np.column_stack([x, y, z]), rtol=0, atol=1e-12)


def test_a_joint_is_read_alone_and_in_a_sum(tmp_path: Path) -> None:
    robot = load_text(tmp_path, WRIST)
    assert [a.name for a in robot.actuators] == ["m1", "j2", "j3"]
    q = np.random.default_rng(3).uniform(-1, 1, (20, 3))
    first, second = 0.5 * q[:, 0], q[:, 1]
    third = q[:, 2] + 0.1 * second
    yaw = first + second + third
    x = 0.3 * np.cos(first) + 0.25 * np.cos(first + second) + 0.08 * np.cos(yaw)
    T = forward(robot, q).T
    assert_allclose(T[:, 0, 3], x, rtol=0, atol=1e-12)
    assert_allclose(T[:, 0, 0], np.cos(yaw), rtol=0, atol=1e-12)


def read_shipped(name: str) -> str:
    """Return the file of a shipped robot."""
    return list_shipped_robots()[name].read_text("utf-8")


def test_a_differential_moves_a_closed_loop_like_its_motors(tmp_path: Path) -> None:
    text = read_shipped("five-bar")
    for name, sign in (("left", 1), ("right", -1)):
        old = f"  {name}: {{reads: angle, "
        text = text.replace(old, f"{old}sum: {{left: 1, right: {sign}}}, ")
    robot, plain = load_text(tmp_path, text), load_cached_robot("five-bar")
    sample = sample_workspace(plain, 100, seed=2)
    left, right = sample.solution.q.T
    q = np.column_stack([left + right, left - right])
    solved = forward(robot, q)
    assert solved.converged.all()
    assert_allclose(solved.T, sample.solution.T, rtol=0, atol=1e-12)
    assert_allclose(inverse(robot, solved.T).q, q, rtol=0, atol=1e-11)
    half = np.array([[0.5, 0.5], [0.5, -0.5]])
    slope = jacobian(plain, sample.solution.q).readings @ half
    assert_allclose(jacobian(robot, q).readings, slope, rtol=0, atol=1e-11)


def test_a_shared_drive_can_be_in_sums(tmp_path: Path) -> None:
    text = read_shipped("linear-delta-6")
    old = text[text.index("  q: {reads") :].split("\n")[0]
    new = """  m1: {reads: length, sum: {q1: 1, q2: 1}}
  m2: {reads: length, sum: {q1: 1, q2: -1}}
  m3: {reads: length, sum: {q2: 0.25, q3: 1}}"""
    robot, plain = (
        load_text(tmp_path, text.replace(old, new)),
        load_cached_robot("linear-delta-6"),
    )
    there = inverse(plain, np.array([[0.02, -0.03, 0.1], [0.0, 0.05, 0.05]]))
    height = 0.493326149 - there.q
    wanted = height @ np.array([[1, 1, 0], [1, -1, 0], [0, 0.25, 1]]).T
    solved = forward(robot, wanted)
    assert solved.converged.all()
    assert_allclose(solved.T, there.T, rtol=0, atol=1e-11)
    assert_allclose(inverse(robot, there.T).q, wanted, rtol=0, atol=1e-10)


def test_the_complete_error_model_has_the_offsets_of_the_sums(tmp_path: Path) -> None:
    text = f"{PLATE}error_model: complete\ntolerances: {{lengths: {{sd: 1}}, angles: {{sd: 1}}}}\n"
    robot = load_text(tmp_path, text)
    offsets = [name for name in robot.parameters.names if name.endswith(".offset")]
    assert offsets == ["q1.offset", "q2.offset", "q3.offset"]


@pytest.mark.parametrize("name", ["core-xy", "pulley-3"])
def test_weights_of_simulated_machines_are_as_accurate_as_stated(name: str) -> None:
    robot = load_cached_robot(name)
    noise = Gaussian(np.repeat([5e-5, 1e-5], 3))  # [rad, m]
    instrument = Instrument((Sensor(Pose("rotation-vector"), noise),))
    poses, truth = sample_workspace(robot, 40, seed=1).coordinates, sample_truth(robot, 200, 2)
    trials = simulate_trials(robot, truth, poses, instrument, 3)
    fits = identify_trials(robot, trials, LeastSquares())
    assert fits.converged.all()
    is_weight = np.array([".weight." in p for p in robot.parameters.names])
    error = ((fits.values - truth) / fits.standard_deviations())[:, is_weight]
    before = (robot.values - truth)[:, is_weight] / 1e-3  # in spreads
    assert np.abs(fits.values - truth)[:, is_weight].max() < 0.3e-3 * np.abs(before).max()
    # squares of 200 draws have the mean 1 +- sqrt(2 / 200), 2.6 times that
    assert_allclose((error**2).mean(axis=0), 1.0, rtol=0, atol=2.6 * np.sqrt(2 / 200))


def test_uncertain_readings_of_sums_are_estimated(tmp_path: Path) -> None:
    robot = load_cached_robot("pulley-3")
    noise = Gaussian(np.repeat([5e-5, 1e-5], 3))  # [rad, m]
    instrument = Instrument((Sensor(Pose("rotation-vector"), noise),))
    coordinates = sample_workspace(robot, 30, seed=3).coordinates
    truth = draw_errors(robot, 4)
    data = simulate(truth, coordinates, instrument, 5, reading_sigma=np.full(3, 1e-5))
    report = calibrate(robot, data)
    spread = report.identification.standard_deviations
    error = (report.robot.values - truth.values) / spread
    # 14 values with the mean square 1 +- sqrt(2 / 14), 2.6 times that
    assert np.mean(error**2) < 1 + 2.6 * np.sqrt(2 / 14)
    assert report.reading_errors is not None
    assert [error.name for error in report.reading_errors] == ["q1", "q2", "q3"]


def test_the_arm_on_the_page_of_robots_is_that_of_its_formula(tmp_path: Path, root: Path) -> None:
    page = (root / "docs" / "robots.md").read_text("utf-8")
    section = page[page.index("### Summed drives") :]
    robot = load_text(tmp_path, section[section.index("```yaml\n") + 8 :].split("```")[0])
    reached = inverse(robot, sample_workspace(robot, 40, seed=1).coordinates)
    assert reached.converged.all()
    first, second = reached.q.T  # the motor of the elbow reads the direction of the forearm
    x = 0.3 * np.cos(first) + 0.25 * np.cos(second)
    y = 0.3 * np.sin(first) + 0.25 * np.sin(second)
    assert_allclose(reached.T[:, :2, 3], np.column_stack([x, y]), rtol=0, atol=1e-12)


# --- fewer readings than lengths

ANCHORS = {"m": (-1.0, 0.8), "n": (1.0, 0.8), "k": (-1.0, -0.7), "h": (1.0, -0.7)}

POINTS = {"m": (-0.15, -0.1), "n": (-0.15, 0.1), "k": (0.15, -0.1), "h": (0.15, 0.1)}

SUMS = {"q1": ("m", 1.0, "n"), "q2": ("m", 2.0, "k"), "q3": ("n", 2.0, "h")}


def compute_readings(robot: Mechanism, y: Any, values: Any, module: Any = np) -> Any:
    """Return the three readings of pulley-3 at a pose (x, y, yaw), from its drawing."""

    def value(name: str) -> Any:
        return values[robot.parameters.index(name)]

    def length(name: str) -> Any:
        px, py = POINTS[name]
        cos, sin = module.cos(y[2]), module.sin(y[2])
        dx = y[0] + cos * px - sin * py - value(f"{name}.anchor.x")
        dy = y[1] + sin * px + cos * py - value(f"{name}.anchor.y")
        return module.sqrt(dx**2 + dy**2)

    return module.stack(
        [
            length(one) + value(f"{q}.weight.{other}") * length(other) - value(f"{q}.offset")
            for q, (one, _, other) in SUMS.items()
        ]
    )


def test_pulleys_agree_with_a_constraint_solver() -> None:
    robot = draw_errors(load_cached_robot("pulley-3"), 4)
    sample = sample_workspace(load_cached_robot("pulley-3"), 60, seed=5)
    q = sample.solution.q
    solved = forward(robot, q)
    assert solved.converged.all()
    for i, wanted in enumerate(q):
        y = np.asarray(
            fsolve(
                lambda y, wanted=wanted: compute_readings(robot, y, robot.values) - wanted,
                sample.coordinates[i],
                xtol=1e-12,
            )
        )
        assert_allclose(solved.T[i, :2, 3], y[:2], rtol=0, atol=1e-9 * robot.size)
        turn = Rotation.from_matrix(solved.T[i, :3, :3]).as_rotvec()
        assert_allclose(turn, [0, 0, y[2]], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_pulleys_agree_with_differences_and_jax() -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    robot = draw_errors(load_cached_robot("pulley-3"), 8)
    y, free = np.array([0.12, -0.2, 0.07]), [3, 4, 2]
    q = compute_readings(robot, y, robot.values)
    state = forward_trials(robot, robot.values[None], q[None, None])
    known = differentiate_pose(robot, robot.values[None], q[None, None], state)

    def closed_form(y: Any, values: Any) -> Any:
        return compute_readings(robot, y, values, jax.numpy)

    both = compile_quickly(jax.jacfwd(closed_form, (0, 1)))(y, robot.values)
    slope = np.linalg.inv(both[0])
    by_values = -slope @ both[1]
    assert_allclose(known.readings[0, 0][free], slope, rtol=0, atol=1e-11)
    assert_allclose(known.parameters[0, 0][free], by_values, rtol=0, atol=1e-11)

    def move(x: Array) -> Array:
        T = forward_trials(robot, x, q[None, None], state).T[:, 0]
        return np.column_stack([T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])

    check_jacobian(
        move,
        known.parameters[0, 0][free],
        robot.values,
        scale=0.05,
        atol=1e-9,
        atol_reason="[m, rad] Newton's own accuracy over the smallest step",
        is_batched=True,
    )


@pytest.mark.parametrize("text", [WRIST, STRUTS, CELL])
def test_poses_and_passive_joints_are_differentiated_by_every_term(tmp_path, text):
    robot = load_text(tmp_path, text)
    reached = inverse(robot, robot.home[None])
    assert reached.converged.all()
    values, a = robot.values, len(robot.actuators)
    q = reached.q[0] + 0.02
    state = forward_trials(robot, values[None], q[None, None])
    assert state.status == Status.CONVERGED
    known = differentiate_pose(robot, values[None], q[None, None], state)
    passive = differentiate_passive_joints(robot, values[None], q[None, None], state)

    def move(x: Array) -> Array:
        shown = x[:, None, :a]
        solved = forward_trials(robot, x[:, a:], shown, state)
        T = solved.T[:, 0]
        pose = [T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])]
        joints = select_joint_values(robot, passive.names, shown, solved)
        return np.column_stack([*pose, *(value[:, 0] for value in joints.values())])

    both = [
        np.concatenate([one[0, 0][[3, 4, 2]], two[0, 0]])
        for one, two in ((known.readings, passive.readings), (known.parameters, passive.parameters))
    ]
    check_jacobian(
        move,
        np.concatenate(both, axis=1),
        np.concatenate([q, values]),
        scale=0.05,
        atol=1e-9,
        atol_reason="[m, rad] Newton's own accuracy over the smallest step",
        is_batched=True,
    )


def test_struts_with_hinges_are_the_same_machine_as_rods(tmp_path: Path) -> None:
    robot = load_text(tmp_path, STRUTS)
    y = np.array([[0.05, 0.02, 0.03]])
    solved = inverse(robot, y)
    assert solved.converged.all()
    turn = Rotation.from_rotvec([0, 0, 0.03]).as_matrix()[:2, :2]
    slides = {  # of the slides, which begin 0.1 m before their tips
        name: np.linalg.norm(turn @ POINTS[name] + y[0, :2] - ANCHORS[name]) - 0.1
        for name in ANCHORS
    }
    first = slides["m"] + slides["n"]
    third = slides["n"] + 2 * slides["h"]
    assert solved.q[0, 0] == pytest.approx(first, abs=1e-12)
    wound = 0.1 * solved.q[0, 2] + 0.001 / (4 * np.pi) * solved.q[0, 2] ** 2
    assert wound == pytest.approx(third, abs=1e-12)


def test_readings_far_from_the_start_follow_a_path_or_state_why_not() -> None:
    robot = load_cached_robot("pulley-3")
    q = np.random.default_rng(9).uniform([1, 2, 2], [5, 6, 6], (200, 3))
    solved = forward(robot, q)
    assert not (solved.status == Status.NOT_FINITE).any()
    good = solved.converged
    assert 30 < good.sum() < 100  # of 200; other readings are far out of reach
    assert (solved.state.closure_sign[0, good] == robot.home_state.closure_sign).all()
    for i in np.flatnonzero(good):
        T = solved.T[i]
        y = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
        assert_allclose(compute_readings(robot, y, robot.values), q[i], atol=1e-9)


def test_assembly_modes_of_sums_have_the_readings_of_home() -> None:
    robot = load_cached_robot("pulley-3")
    home = inverse(robot, np.zeros((1, 3))).q[0]
    modes = find_assembly_modes(robot, home).solution
    assert len(modes.T) > 1
    assert np.abs(modes.T - robot.home).max(axis=(1, 2)).min() < 1e-9
    for T in modes.T:
        y = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
        assert_allclose(compute_readings(robot, y, robot.values), home, atol=1e-9)


def test_a_coupled_wrist_ends_a_chain(tmp_path: Path) -> None:
    robot = load_text(tmp_path, ARM)
    q = np.random.default_rng(12).uniform(-1.5, 1.5, (50, 4))
    solved = forward(robot, q)
    weights = np.array([[50.0, 0.0, 0.0], [0.02, 1.0, 0.0], [0.01, -0.5, 1.0]])
    for i, (first, *motors) in enumerate(q):
        wrist = np.linalg.solve(weights, np.multiply([50.0, 1.0, 1.0], motors))
        upper = Rotation.from_euler("ZX", [first, wrist[0]])
        fore = upper * Rotation.from_euler("Y", wrist[1])
        turn = fore * Rotation.from_euler("X", wrist[2])
        end = upper.apply([0.4, 0, 0]) + fore.apply([0.1, 0, 0])
        assert_allclose(solved.T[i, :3, :3], turn.as_matrix(), rtol=0, atol=1e-12)
        assert_allclose(solved.T[i, :3, 3], end, rtol=0, atol=1e-12)
    near = forward(robot, inverse(robot, robot.home[None]).q + 0.1 * q[:10])
    back = inverse(robot, near.T)
    assert back.converged.all()
    assert_allclose(back.q, near.q, rtol=0, atol=1e-9)


def test_the_sign_of_closure_is_that_of_the_derivative_of_the_sums() -> None:
    robot = load_cached_robot("pulley-3")
    y = np.random.default_rng(10).uniform([-0.6, -0.5, -2.5], [0.6, 0.5, 2.5], (60, 3))
    T = inverse(robot, np.zeros((1, 3))).T.repeat(60, axis=0)
    T[:, :3, :3] = Rotation.from_rotvec(y[:, 2:] * [[0, 0, 1]]).as_matrix()
    T[:, :2, 3] = y[:, :2]
    state = solve_at_pose(robot, robot.values[None], T[None], robot.home_state)[0]
    slopes = np.array(
        [
            central_difference(lambda x: compute_readings(robot, x, robot.values), x, np.ones(3))[0]
            for x in [np.zeros(3), *y]
        ]
    )
    home, *signs = np.sign(np.linalg.det(slopes))
    assert min(signs) < max(signs)
    found = compute_closure_sign(robot, robot.values[None], state)[0]
    assert_array_equal(found * robot.home_state.closure_sign[0, 0], np.multiply(signs, home))
    margins = analyze_singularity(robot, T).drive_margin
    assert (margins > 0).any()


def test_sums_of_a_stage_are_solved_in_the_chain(tmp_path: Path) -> None:
    robot = load_text(tmp_path, CELL)
    wanted = np.random.default_rng(11).uniform([-0.3, -0.3, -1, -0.1], [0.3, 0.3, 1, 0.1], (30, 4))
    solved = inverse(robot, wanted)
    assert solved.converged.all()
    assert_allclose(forward(robot, solved.q).T, solved.T, rtol=0, atol=1e-11)
    assert_allclose(solved.q[:, 0], wanted[:, 2], rtol=0, atol=1e-11)
    assert_allclose(solved.T[:, :3, 3], wanted[:, :3], rtol=0, atol=1e-11)


SECOND, THIRD = "q2: {reads: length, sum: {m: 1, k: 2}}", "q3: {reads: length, sum: {n: 1, h: 2}}"


@pytest.mark.parametrize(
    ("old", "new", "sentence", "line"),
    [
        (SECOND, "q2: {reads: length, sum: {m: 1, kk: 2}}", "names 'kk', which is neither", 9),
        (SECOND, "q2: {reads: length, sum: {m: 1, h: 2}}", "'k' of limb 'K' is in no sum", 8),
        (SECOND, "q2: {reads: length, sum: {m: 2, n: 2}}\n  k: {reads: length}",
         "'q2' has a sum that follows from q1", 9),
        (SECOND, "q2: {reads: length, sum: {m: 0, k: 0}}", "no weight other than 0", 9),
        (SECOND, "q2: {reads: length, sum: {m: 1, k: .inf}}", "is inf. Write a finite number", 9),
        (SECOND, "q2: {reads: length, sum: [m, k]}",
         "'actuators.q2.sum' is a list of 2, but must be a mapping", 9),
        (SECOND, "q2: {reads: lenght, sum: {m: 1, k: 2}}",
         "'lenght' .did you mean 'length'... Allowed: 'length', 'angle'", 9),
        (SECOND, "q2: {reads: length}", "'q2' drives no joint", 9),
        ("[weight.n]", "[weight.k]", "no term 'weight.k'", 8),
        ("[weight.n]", "[wait.n]", "no term 'wait.n'", None),
        (f"  {THIRD}\n", "", "'h' of limb 'H' is in no sum", 8),
        (f"  {SECOND}\n  {THIRD}\n", "  q2: {reads: length, sum: {k: 1, h: 2}}\n",
         "it can move while all sums are constant", None),
        (THIRD, "q3: {reads: angle, sum: {n: 1, h: 2}}", "adds angles and 'n', which slides", None),
        (THIRD, "q3: {triangle: {foot: [1, 0, 0], head: [0, 1, 0]}}", "drives no joint", 10),
    ],
)  # fmt: skip
def test_impossible_sums_are_refused_in_one_sentence(tmp_path, old, new, sentence, line):
    assert load_text(tmp_path, PLATE).has_open_sums
    assert old in PLATE
    with pytest.raises((FileError, MechanismError), match=sentence) as error:
        load_text(tmp_path, PLATE.replace(old, new, 1))
    text = str(error.value)
    assert "\n" not in text
    assert "robot.yaml" in text
    assert line is None or f"line {line}" in text or f":{line}" in text


def test_a_sum_of_an_angle_and_a_length_is_refused(tmp_path: Path) -> None:
    text = WRIST.replace("{joint: R, name: b", "{joint: P, name: b").replace(
        "start: 60", "start: 6"
    )
    with pytest.raises(FileError, match="adds angles and 'j2', which slides"):
        load_text(tmp_path, text)


def test_sums_that_do_not_hold_the_platform_are_refused(tmp_path: Path) -> None:
    # no cable holds the plate against rotation about the point in which all of them meet
    text = PLATE
    for point in ("[-150, -100, 0]", "[-150, 100, 0]", "[150, -100, 0]", "[150, 100, 0]"):
        text = text.replace(f"attach: {point}", "attach: [0, 0, 0]")
    with pytest.raises((FileError, MechanismError), match=r"can rotate|leave|free|hold"):
        load_text(tmp_path, text)
    symmetric = PLATE.replace(SECOND, "q2: {reads: length, sum: {k: 1, h: 1}}").replace(
        THIRD, "q3: {reads: length, sum: {m: 1, n: 1, k: 1, h: 2}}"
    )
    symmetric = symmetric.replace("-700", "-800").replace("150, 100", "150, 99.999")
    assert load_text(tmp_path, symmetric).has_open_sums


# --- more readings than freedoms

WINCHES = """format: 1
family: limbs
name: winches
units: {length: m, angle: rad}
freedoms: [x, z]
controlled: [x, z]
drives:
  w1: {reads: length, sum: {a: 1}, unknown: [offset], length: {sd: 0.002}}
  w2: {reads: angle, radius: 0.05, sum: {b: 1}, unknown: [offset], length: {sd: 0.002}}
  w3: {reads: length, sum: {c: 1, d: 0.5}, unknown: [weight.d], weights: {sd: 0.001}}
limbs:
  - {name: A, tip: [-1, 0, 0.8], ending: distance, attach: [-0.15, 0, 0.1], actuated: a}
  - {name: B, tip: [1, 0, 0.8], ending: distance, attach: [0.15, 0, 0.1], actuated: b, errors: [{of: base, shift: [x], tolerance: {sd: 0.002}}]}
  - {name: C, tip: [-1, 0, -0.7], ending: distance, attach: [-0.15, 0, -0.1], actuated: c}
  - {name: D, tip: [1, 0, -0.7], ending: distance, attach: [0.15, 0, -0.1], actuated: d}
workspace: {x: [-0.4, 0.4], z: [-0.3, 0.3]}
"""  # noqa: E501

TENDONS = """format: 1
family: limbs
name: tendons
units: {length: m, angle: rad}
freedoms: [x, y, rz]
controlled: [x, y]
drives:
  t1: {reads: length, radius: {q1: 0.02}, unknown: [offset], length: {sd: 0.0002}}
  t2: {reads: length, radius: {q1: -0.018, q2: 0.015}, unknown: [radius.q2], radii: {sd: 0.0001}}
  t3: {reads: length, radius: {q1: -0.017, q2: -0.016}}
limbs:
  - name: arm
    ending: rigid
    chain:
      - {joint: R, name: a, axis: z, actuated: q1, start: 0.3}
      - {joint: R, name: b, at: [0.3, 0, 0], axis: z, actuated: q2, start: 1}
    tip: [0.25, 0, 0]
    errors: [{of: b, shift: [x], tolerance: {sd: 0.0002}}]
home: {x: 0.33, y: 0.34, yaw: 1.4}
workspace: {x: [0.25, 0.4], y: [0.25, 0.4]}
"""


def measure_winches(robot: Mechanism, T: Array) -> Array:
    """Return the readings of WINCHES at poses (n, 4, 4), from its drawing."""
    ends = {"a": (-1, 0.8), "b": (get(robot, "B.base.x"), 0.8), "c": (-1, -0.7), "d": (1, -0.7)}
    sides = {"a": (-0.15, 0.1), "b": (0.15, 0.1), "c": (-0.15, -0.1), "d": (0.15, -0.1)}
    cables = {n: np.linalg.norm(T[:, [0, 2], 3] + sides[n] - ends[n], axis=1) for n in ends}
    first, second = (cables[n] - get(robot, f"{w}.offset") for n, w in (("a", "w1"), ("b", "w2")))
    third = cables["c"] + get(robot, "w3.weight.d") * cables["d"]
    return np.column_stack([first, second / 0.05, third])


def measure_tendons(robot: Mechanism, T: Array) -> Array:
    """Return the readings of TENDONS at poses (n, 4, 4), from its drawing."""
    forearm = T[:, 0, 0] + 1j * T[:, 1, 0]
    upper = T[:, 0, 3] + 1j * T[:, 1, 3] - 0.25 * forearm
    assert_allclose(np.abs(upper), get(robot, "arm.b.x"), rtol=0, atol=1e-12)
    joints = np.column_stack([np.angle(upper), np.angle(forearm / upper)])
    radii = [[0.02, 0], [-0.018, get(robot, "t2.radius.q2")], [-0.017, -0.016]]
    return joints @ np.transpose(radii) - [get(robot, "t1.offset"), 0, 0]


REDUNDANT = {"winches": (WINCHES, measure_winches), "tendons": (TENDONS, measure_tendons)}


@pytest.mark.parametrize("name", REDUNDANT)
def test_redundant_readings_may_be_sums(tmp_path: Path, name: str) -> None:
    """Three winches on four cables that move a point, three tendons on two joints."""
    text, measure = REDUNDANT[name]
    nominal = load_text(tmp_path, text)
    robot = draw_errors(nominal, 1)
    reached = inverse(robot, sample_workspace(nominal, 100, seed=2).coordinates)
    assert reached.converged.all()
    assert_allclose(reached.q, measure(robot, reached.T), rtol=0, atol=1e-9)
    there = forward(robot, measure(robot, reached.T))
    assert there.converged.all()
    assert_allclose(there.T, reached.T, rtol=0, atol=1e-9)
    assert_allclose(inverse(robot, reached.T).q, reached.q, rtol=0, atol=1e-9)
    check_pose_derivatives(robot, there.q[None, :3])


@pytest.mark.parametrize("name", REDUNDANT)
def test_machines_with_redundant_sums_are_as_accurate_as_stated(tmp_path, name):
    robot = load_text(tmp_path, REDUNDANT[name][0])
    instrument = Instrument((Sensor(Pose("rotation-vector"), Gaussian(np.repeat(1e-5, 6))),))
    poses, truth = sample_workspace(robot, 30, seed=1).coordinates, sample_truth(robot, 100, 2)
    trials = simulate_trials(robot, truth, poses, instrument, 3)
    fits = identify_trials(robot, trials, LeastSquares())
    assert fits.converged.all()
    error = (fits.values - truth) / fits.standard_deviations()
    # squares of 100 draws have the mean 1 +- sqrt(2 / 100), 3 times that
    assert_allclose((error**2).mean(axis=0), 1.0, rtol=0, atol=3 * np.sqrt(2 / 100))
    before = (np.median(np.abs(a - truth), axis=0) for a in (robot.values, fits.values))
    assert np.less(*list(before)[::-1]).all()


def test_redundant_sums_that_contradict_each_other_open_a_little(tmp_path: Path) -> None:
    """By standard deviations of the readings, where these are known: the worst one gives way."""
    text = WINCHES
    for name, sigma in (("w1: {", 1e-6), ("w2: {", 2e-5), ("w3: {", 1e-3)):
        text = text.replace(name, f"{name}sigma: {sigma}, ")
    robot = load_text(tmp_path, text)
    q = measure_winches(robot, robot.home[None])
    solved = forward(robot, q + np.array([0, 0, 1e-3]))
    assert solved.converged.all()
    assert np.abs(solved.T - robot.home).max() < 1e-8
    moved = forward(robot, q + np.array([1e-3, 0, 0])).T[0, :3, 3] - robot.home[:3, 3]
    with_two = np.linalg.solve([[0.85, -0.7], [-0.85, -0.7]], [1e-3 * np.hypot(0.85, 0.7), 0])
    assert_allclose(moved[[0, 2]], with_two, rtol=0, atol=3e-6)


@pytest.mark.parametrize(
    "new",
    ["h: {reads: length}\n  k: {reads: length}", f"{THIRD}\n  m: {{reads: length}}\n  k: {{reads: length}}"],  # noqa: E501
    ids=["as many as joints", "more than joints"],
)  # fmt: skip
def test_a_plate_with_readings_and_sums_is_redundant(tmp_path: Path, new: str) -> None:
    robot = load_text(tmp_path, PLATE.replace(THIRD, new))
    y = np.random.default_rng(3).uniform(-0.2, 0.2, (20, 3))
    there = inverse(robot, y)
    plain = inverse(load_text(tmp_path, PLATE), y)
    assert_array_equal(there.q[:, :2], plain.q[:, :2])
    assert_allclose(forward(robot, there.q).T, plain.T, rtol=0, atol=1e-11)
    cell = load_text(tmp_path, CELL.replace(THIRD, new.replace("\n", "\n    ")))
    lifted = inverse(cell, np.insert(y, 2, 0.1, axis=1))
    assert_allclose(lifted.q, np.insert(there.q, 0, 0.1, axis=1), rtol=0, atol=1e-12)
    assert_allclose(forward(cell, lifted.q).T, lifted.T, rtol=0, atol=1e-11)


SPLINE = """format: 1
family: limbs
name: screw-spline
units: {length: mm, angle: deg}
freedoms: [x, y, z, rx, ry, rz]
controlled: [z, yaw]
drives:
  spline: {reads: angle, sum: {t: 1}, unknown: [offset], angle: {sd: 0.1}}
  nut: {reads: angle, lead: 20, sum: {h: 1}, radius: {t: -3.2}, unknown: [lead, radius], radii: {sd: 0.1}, leads: {sd: 0.1}}
limbs:
  - {name: shaft, ending: rigid, chain: [{joint: P, name: slide, actuated: h}, {joint: R, name: turn, actuated: t}], attach: [-40, 0, 0]}
"""  # noqa: E501


def test_a_nut_and_a_spline_move_one_shaft(tmp_path: Path) -> None:
    """The wrist of a SCARA arm: the nut lifts by its lead, and the spline turns the screw in it."""
    robot = draw_errors(load_text(tmp_path, SPLINE), 1)
    value = dict(zip(robot.parameters.names, robot.values, strict=True))
    assert set(value) == {"spline.offset", "nut.lead", "nut.radius.t"}
    q = np.random.default_rng(2).uniform(-2, 2, (20, 2))
    T, turn = forward(robot, q).T, q[:, 0] + value["spline.offset"]
    rise = value["nut.lead"] * q[:, 1] / (2 * np.pi) - value["nut.radius.t"] * turn
    assert_allclose(T[:, 2, 3], rise, rtol=0, atol=1e-12)
    assert_allclose(np.arctan2(T[:, 1, 0], T[:, 0, 0]), turn, rtol=0, atol=1e-12)
    assert_allclose(inverse(robot, T).q, q, rtol=0, atol=1e-9)
    check_pose_derivatives(robot, q[None, :3])


def test_a_sum_over_copied_limbs_is_one_for_each_copy(tmp_path: Path) -> None:
    text = (
        PLATE[: PLATE.index("actuators:")]
        + """drives:
  q: {reads: length, sum: {m: 1, n: 0.2}, unknown: [weight.n], weights: {sd: 0.001}}
limbs:
"""
    )
    for name, y, end in (("m", 800, "[-150, -100, 0]"), ("n", -800, "[150, 300, 0]")):
        text += f"  - {{name: {name.upper()}, tip: [-1000, {y}, 0], ending: distance, "
        text += f"attach: {end}, actuated: {name}, copies: {{count: 3}}}}\n"
    robot = load_text(tmp_path, text)
    assert robot.parameters.names == ("q1.weight.n", "q2.weight.n", "q3.weight.n")
    sums = [(a.name, *a.weights) for a in robot.actuators]
    assert sums == [(f"q{i}", f"m{i}", f"n{i}") for i in (1, 2, 3)]


def test_a_triangle_drive_beside_sums_turns_its_joint(tmp_path: Path) -> None:
    """As many readings as joints, and fewer: then closure determines the joints."""
    anchors = "unknown: [offset, foot.x], length: {sd: 0.1}"
    ram = f"j1: {{triangle: {{foot: [-300, 100, 0], head: [200, 50, 0]}}, {anchors}}}"
    motor = "m1: {reads: angle, gain: 0.5, sum: {j1: 1}, unknown: [offset], angle: {sd: 0.1}}"
    wrist = draw_errors(load_text(tmp_path, WRIST.replace(motor, ram)), 1)
    value = dict(zip(wrist.parameters.names, wrist.values, strict=True))
    angles = np.array([[0.3, 1.0, -0.2], [0.5, 0.7, 0.4]])
    head = np.exp(1j * angles[:, 0]) * (0.2 + 0.05j)
    ram_length = np.abs(head - value["j1.foot.x"] - 0.1j) - value["j1.offset"]
    sums = angles[:, 2] + value["j3.weight.j2"] * angles[:, 1]
    q = np.column_stack([ram_length, angles[:, 1], sums])
    yaw = np.cumsum(angles, axis=1)
    arms = np.exp(1j * yaw) * [value["arm.b.x"], 0.25, 0.08]
    T = forward(wrist, q).T
    assert_allclose(T[:, 0, 3] + 1j * T[:, 1, 3], arms.sum(axis=1), rtol=0, atol=1e-12)
    check_pose_derivatives(wrist, q[None])
    text = PLATE.replace("actuated: m}", "length: 900, chain: [{joint: R, name: pin, "
        "at: [-1000, 800, 0], actuated: m, start: -80}]}")  # fmt: skip
    text = text.replace("M, tip: [-1000, 800, 0]", "M, tip: [500, 0, 0]")
    q1 = next(line for line in PLATE.splitlines() if "q1:" in line)
    turned = f"  m: {{triangle: {{foot: [300, 100, 0], head: [20, -150, 0]}}, {anchors}}}"
    text = text.replace(q1, turned).replace("{m: 1, k: 2}", "{n: 1, k: 2}")
    plate = draw_errors(load_text(tmp_path, text), 2)
    assert plate.has_open_sums
    wanted = np.array([[0.0, 0.0, 0.0], [0.006, -0.006, 0.02]])
    solved = forward(plate, inverse(plate, wanted).q)
    assert_allclose(solved.T[:, :2, 3], wanted[:, :2], rtol=0, atol=1e-12)
    check_pose_derivatives(plate, solved.q[None])


def test_a_drive_of_two_stages_is_refused(tmp_path: Path) -> None:
    text = CELL.replace("joint: {kind: P, axis: z}", "joint: {kind: P, axis: z, drive: q1}")
    with pytest.raises(FileError, match="actuator 'q1' drives the stages 'lift' and 'plate'"):
        load_text(tmp_path, text)


SIZE = 4.3  # [m] of the machine


@pytest.fixture(scope="module")
def machine():
    """A machine that differs from its file, positions (50, 2) and their readings in closed form."""
    nominal = lc.load_robot("belt-4")
    robot = nominal.with_values(lc.sample_truth(nominal, 1, seed=4)[0])
    x = np.random.default_rng(1).uniform([-1.1, -0.7], [1.1, 0.7], (50, 2))
    return robot, x, compute_belt_readings(robot.values, x)


def compute_belt_readings(values, x, module=np):
    """Return the readings (.., 4) [m] at positions (.., 2), by parameter values (12,)."""
    anchors = values.reshape(4, 3)
    return module.linalg.norm(x[..., None, :] - anchors[:, :2], axis=-1) - anchors[:, 2]


def intersect_circles(values, q):
    """Return the positions (n, 2) where the first and second belt meet, above their anchors."""
    anchors = values.reshape(4, 3)
    a, b = anchors[0, :2], anchors[1, :2]
    r, s = (q[:, :2] + anchors[:2, 2]).T
    span = np.linalg.norm(b - a)
    along = (r**2 - s**2 + span**2) / (2 * span)
    across = np.sqrt(r**2 - along**2)
    unit = (b - a) / span
    return a + along[:, None] * unit + across[:, None] * np.array([-unit[1], unit[0]])


def test_inverse_kinematics_are_distances_from_the_anchors(machine):
    robot, x, readings = machine
    solution = lc.inverse(robot, x)
    assert solution.converged.all()
    assert_allclose(solution.q, readings, atol=1e-9 * SIZE, rtol=0)


def test_forward_kinematics_are_intersections_of_circles(machine):
    robot, x, readings = machine
    solution = lc.forward(robot, readings)
    assert solution.converged.all()
    T = solution.T
    assert_allclose(intersect_circles(robot.values, readings), x, atol=1e-9)
    assert_allclose(T[:, :2, 3], x, atol=1e-9 * SIZE, rtol=0)
    assert_allclose(T[:, :3, :3], np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-12)


def test_contradicting_readings_lead_to_their_least_squares_position(machine):
    robot, x, readings = machine
    shown = readings + 1e-3 * np.random.default_rng(2).standard_normal(readings.shape)
    found = lc.forward(robot, shown).T[:, :2, 3]
    for start, q, position in zip(x, shown, found, strict=True):

        def gap(p, q=q):
            return compute_belt_readings(robot.values, p) - q

        best = least_squares(gap, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert_allclose(position, best.x, atol=1e-8 * SIZE)  # [m] of scipy's minimum


@pytest.mark.slow
def test_sensitivities_agree_with_automatic_derivatives(machine):
    import jax

    jax.config.update("jax_enable_x64", True)
    compute = partial(compute_belt_readings, module=jax.numpy)
    robot, x, readings = machine
    state = lc.forward(robot, readings).state
    found = differentiate_at_pose(robot, robot.values[None], readings[None], state)
    by_values = jax.jacobian(compute)(robot.values, x)
    by_position = jax.vmap(jax.jacobian(compute, argnums=1), (None, 0))(robot.values, x)
    assert_allclose(found.readings[0][0], by_values, atol=1e-11)
    assert_allclose(found.readings[1][0], by_position, atol=1e-11)
    # the pose at given readings, by least squares of equal weights: x' = -(J'J)^-1 J' dq/dp
    D = differentiate_pose(robot, robot.values[None], readings[None], state).parameters[0]
    expected = -np.linalg.pinv(np.asarray(by_position)) @ np.asarray(by_values)
    assert_allclose(D[:, 3:5], expected, atol=1e-10)
