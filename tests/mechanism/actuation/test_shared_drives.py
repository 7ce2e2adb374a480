# SPDX-License-Identifier: Apache-2.0
"""Drives that several limbs share, and more actuators than freedoms: the pose is the weighted
least-squares solution of the readings.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.optimize import least_squares, root

from loopcal import geometry
from loopcal.estimate.identification import identify_trials
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism.actuation import differentiate_at_pose, solve_at_pose
from loopcal.mechanism.assembly import Actuator, Link
from loopcal.mechanism.chains import ChainState
from loopcal.mechanism.compilation import build
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.sensitivity import differentiate_passive_joints, differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from loopcal.units import Dimension
from tests import zoo
from tests.jacobians import check_jacobian
from tests.mechanism.derivatives import check_pose_derivatives
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]

# a crank with the coupler on its end, and a follower whose crank the same motor turns
FOUR_BAR = """format: 1
family: limbs
name: four-bar
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x]
actuators:
  q: {reads: angle, stroke: [30, 80], unknown: [offset], angle: {sd: 0.1}}
limbs:
  - name: crank
    ending: rigid
    chain:
      - {joint: R, name: shoulder, axis: z, actuated: q, start: 60}
      - {joint: R, name: pin, at: [800, 0, 0], axis: z, start: -60}
    errors: [{of: pin, shift: [x], tolerance: {sd: 0.5}}]
  - name: follower
    ending: ball
    chain:
      - {joint: R, name: shoulder, at: [-150, 100, 0], axis: z, actuated: q, start: 60}
      - {joint: R, name: elbow, at: [500, 0, 0], axis: z, start: 20}
    tip: [320, 0, 0]
    attach: [-150, 100, 0]
    errors: [{of: elbow, shift: [x], tolerance: {sd: 0.5}}]
home: {x: 400, y: 650, yaw: 5}
"""


def solve_four_bar(angle: float) -> tuple[Array, float]:
    """Return position (2,) [m] and yaw [rad] of the coupler at a motor angle."""
    along = np.array([np.cos(angle), np.sin(angle)])
    pin, elbow = 0.8 * along, np.array([-0.15, 0.1]) + 0.5 * along

    def miss_rod(yaw: Array) -> Array:
        c, s = np.cos(yaw[0]), np.sin(yaw[0])
        end = pin + np.array([[c, -s], [s, c]]) @ [-0.15, 0.1]
        return np.array([np.sum((end - elbow) ** 2) - 0.32**2])

    return pin, float(root(miss_rod, [0.0], tol=1e-14).x[0])


def test_orientation_that_follows_the_position_is_found(tmp_path: Path) -> None:
    robot = load_text(tmp_path, FOUR_BAR)
    angles = np.deg2rad(np.linspace(31, 79, 50))
    known = [solve_four_bar(float(angle)) for angle in angles]
    solution = forward(robot, angles[:, None])
    assert solution.converged.all()
    assert_allclose(solution.T[:, :2, 3], [pin for pin, _ in known], atol=1e-12)
    yaw = read_coordinates(solution.T, ("yaw",))[:, 0]
    assert_allclose(yaw, [y for _, y in known], atol=1e-9)
    for target in (solution.T, solution.T[:, :1, 3]):
        back = inverse(robot, target)
        assert back.converged.all()
        assert_allclose(back.q[:, 0], angles, rtol=0, atol=1e-11)


def test_poses_out_of_reach_are_marked_and_cost_no_exception(tmp_path: Path) -> None:
    robot = load_text(tmp_path, FOUR_BAR)
    far = np.repeat(robot.home[None], 3, axis=0)
    far[:, 0, 3] += [0.0, 2.0, np.nan]
    solution = inverse(robot, far)
    assert solution.status[0] == Status.CONVERGED
    assert not solution.converged[1:].any()
    assert solution.status[2] == Status.NOT_FINITE


def test_repeated_equations_of_a_spatial_parallelogram_are_no_obstacle(tmp_path: Path) -> None:
    """In all six freedoms the follower repeats that the coupler stays in its plane."""
    text = FOUR_BAR.replace("freedoms: [x, y, rz]\n", "").replace(
        "    errors: [{of: pin, shift: [x], tolerance: {sd: 0.5}}]\n", "", 1
    )
    robot, plane = load_text(tmp_path, text), load_text(tmp_path, FOUR_BAR)
    angles = np.deg2rad(np.linspace(31, 79, 7))[:, None]
    T = forward(plane, angles).T
    assert_allclose(forward(robot, angles).T, T, atol=1e-12)
    back = inverse(robot, T)
    assert back.converged.all()
    assert_allclose(back.q, angles, rtol=0, atol=1e-11)


def test_calibration_of_a_coupler_whose_orientation_follows(tmp_path: Path) -> None:
    robot = load_text(tmp_path, FOUR_BAR)
    poses = np.linspace(0.2, 0.6, 12)[:, None]
    noise = Gaussian(np.repeat([5e-5, 1e-5], 3))  # [rad, m]
    truth = sample_truth(robot, 20, 2)
    instrument = Instrument((Sensor(Pose("rotation-vector"), noise),))
    fits = identify_trials(
        robot, simulate_trials(robot, truth, poses, instrument, 3), LeastSquares()
    )
    assert fits.converged.all()
    error = (fits.values - truth) / fits.standard_deviations()
    # 3 values of 20 draws: their squares have the mean 1 +- sqrt(2 / 60), 2.6 times that
    assert (error**2).mean() == pytest.approx(1.0, abs=2.6 * np.sqrt(2 / 60))


# --- the palletizer


def solve_palletizer(robot: Mechanism, values: Array, q: Array) -> Array:
    """Return x, z and the pitch about -y of the wrist in the plane of the arm, at readings (2,)."""
    name = {n: float(v) for n, v in zip(robot.parameters.names, values, strict=True)}
    upper, lever = q[0] + name["arm.shoulder.offset"], q[1] + name["arm.lever.offset"]
    level = np.array([name["arm.level.shoulder.x"], name["arm.level.shoulder.z"]])

    def point(angle: float) -> Array:
        return np.array([np.cos(angle), np.sin(angle)])

    elbows = (
        name["arm.main.elbow.x"] * point(upper),
        level + name["arm.level.elbow.x"] * point(upper),
        name["arm.drive.rod.x"] * point(lever),
    )
    rods = [name[f"arm.{limb}.tip.x"] for limb in ("main", "level", "drive")]

    def miss_rods(x: Array) -> Array:
        c, s = np.cos(x[2]), np.sin(x[2])
        other = x[:2] + np.array([[c, -s], [s, c]]) @ [0.03, 0.15]
        ends = (x[:2], other, x[:2])
        gaps = [float(np.linalg.norm(end - elbow)) for end, elbow in zip(ends, elbows, strict=True)]
        return np.array(gaps) - rods

    guess = [*(0.8 * point(upper) + 0.9 * point(lever)), 0.0]
    return np.array([float(v) for v in root(miss_rods, guess, tol=1e-14).x])


def test_palletizer_agrees_with_a_constraint_solver() -> None:
    nominal = load_cached_robot("palletizer")
    errors = np.random.default_rng(4).standard_normal(len(nominal.parameters))
    robot = nominal.with_values(nominal.values + errors * nominal.parameters.tolerance)
    q = sample_workspace(nominal, 30, seed=1).solution.q
    state = forward(robot, q).state
    assert isinstance(state, ChainState)
    wrist = state.poses[1][0]  # platform of the arm in its own base
    known = np.array([solve_palletizer(robot, robot.values, row[1:3]) for row in q])
    assert_allclose(wrist[:, [0, 2], 3], known[:, :2], atol=1e-9 * robot.size)
    # a rotation about -y by the angle moves x towards z
    assert_allclose(wrist[:, 2, 0], np.sin(known[:, 2]), rtol=0, atol=1e-9)
    # the wrist stays level but for the errors
    assert 1e-6 < np.abs(known[:, 2]).max() < 0.02


def test_nominal_palletizer_stays_level() -> None:
    robot = load_cached_robot("palletizer")
    sample = sample_workspace(robot, 50, seed=2)
    assert_allclose(sample.solution.T[:, 2, :3], np.tile([0, 0, 1.0], (50, 1)), atol=1e-9)
    back = forward(robot, inverse(robot, sample.solution.T).q)
    assert back.converged.all()
    assert_allclose(back.T, sample.solution.T, rtol=0, atol=1e-9 * robot.size)


def test_sensitivities_of_a_shared_drive_are_derivatives(tmp_path: Path) -> None:
    check_pose_derivatives(load_text(tmp_path, FOUR_BAR), np.array([[[1.0]]]))


def load_cable_robot(sigmas=None):
    """Build the shipped four-line robot with these sigmas of its encoders."""
    assembly = load_robot("cable-4").assembly
    if sigmas is None:
        return build(assembly)
    return build(
        replace(
            assembly,
            actuators=tuple(
                replace(a, sigma=s) for a, s in zip(assembly.actuators, sigmas, strict=True)
            ),
        )
    )


def compute_line_lengths(robot, q):
    """Return the length of each line at readings q (a,), from the numbers of the assembly."""
    terms = [a.terms for a in robot.actuators]
    driven = np.array(
        [
            t.get("offset", 0.0) + t.get("gain", 1.0) * r + t.get("curve", 0.0) * r**2
            for t, r in zip(terms, q, strict=True)
        ]
    )
    return driven + np.array([limb.length for limb in robot.assembly.limbs])


def list_attachment_points(robot):
    """Return anchors and attachment points (k, 3) from the numbers of the assembly."""
    anchors = np.array([limb.links[-1].transform[:3, 3] for limb in robot.assembly.limbs])
    return anchors, np.array([limb.attachment.transform[:3, 3] for limb in robot.assembly.limbs])


def solve_position_by_scipy(robot, q, sigmas):
    """Minimize the weighted sum of squared length errors by scipy; return the position."""
    anchors, attached = list_attachment_points(robot)
    lengths = compute_line_lengths(robot, q)

    def misfit(x):
        return (np.linalg.norm(x + attached - anchors, axis=1) - lengths) / sigmas

    return least_squares(misfit, robot.home[:3, 3], xtol=1e-15, ftol=1e-15, gtol=1e-15).x


@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0, 1.0), (1.0, 5.0, 0.2, 2.0)])
def test_contradicting_readings_give_the_least_squares_pose(sigmas):
    robot = load_cable_robot(tuple(1e-3 * s for s in sigmas))
    rng = np.random.default_rng(2)
    asked = np.array([robot.home[:3, 3]]) + rng.uniform(-0.1, 0.1, (5, 3))
    q = inverse(robot, asked).q
    q = q + rng.normal(size=q.shape) * 1e-3 * np.abs(q).max()
    sol = forward(robot, q)
    assert (sol.status == Status.CONVERGED).all()
    gains = np.array([abs(a.terms.get("gain", 1.0)) for a in robot.actuators])
    for i, row in enumerate(q):
        # scipy stops at about the square root of rounding in x, the gap being millimetres
        assert_allclose(
            sol.T[i, :3, 3],
            solve_position_by_scipy(robot, row, np.array(sigmas) * gains),
            atol=1e-7 * robot.size,
        )
    assert (sol.residual > 1e-6).all()


def test_consistent_readings_leave_no_residual():
    robot = load_cable_robot((1e-3, 5e-3, 2e-4, 2e-3))
    asked = np.array([robot.home[:3, 3]]) + np.random.default_rng(3).uniform(-0.1, 0.1, (20, 3))
    sol = forward(robot, inverse(robot, asked).q)
    assert_allclose(sol.T[:, :3, 3], asked, atol=1e-12)
    assert sol.residual.max() <= 1e-12


def test_pose_derivatives_by_redundant_readings_agree_with_differences():
    robot = load_cable_robot((1e-3, 5e-3, 2e-4, 2e-3))
    q = inverse(robot, np.array([robot.home[:3, 3]]) + 0.05).q
    values = robot.values[None]

    def position(readings):
        return forward(robot, readings[None]).T[0, :3, 3]

    def slopes(readings):
        state = forward_trials(robot, values, readings[None, None])
        return differentiate_pose(robot, values, readings[None, None], state).readings[0, 0, 3:]

    check_jacobian(
        position,
        slopes(q[0]),
        q[0],
        scale=1e-2,
        atol=1e-9,
        atol_reason="poses solved to 1e-13, steps of 1e-2",
    )


def build_hexapod_with_seven_legs():
    """Build the small hexapod with a seventh driven leg from the middle of the base."""
    assembly = zoo.hexapod().assembly
    foot, corner = zoo.place((0.0, 0.0, 0.0)), zoo.place((0.02, 0.03, 0.0))
    length = float(np.linalg.norm((assembly.home @ corner)[:3, 3]))
    links = {"links": (Link("base", foot),), "attachment": Link("platform", corner)}
    leg = replace(assembly.limbs[0], name="leg7", actuator="q7", length=length, **links)
    actuators = (*assembly.actuators, Actuator("q7", Dimension.LENGTH))
    return build(
        replace(assembly, limbs=(*assembly.limbs, leg), actuators=actuators, parameters=(), maps=())
    )


def test_local_minimum_far_from_home_is_left_or_marked():
    robot = build_hexapod_with_seven_legs()
    reach = np.array([0.12, 0.12, 0.12, 1.2, 1.2, 1.2])
    asked = (
        np.array([0, 0, 0.2, 0, 0, 0]) + np.random.default_rng(0).uniform(-1, 1, (600, 6)) * reach
    )
    result = inverse(robot, asked)
    result = result.take(result.closed)
    again = forward(robot, result.q)
    # the readings are consistent, so a residual belongs to a local minimum beside the true pose
    assert again.residual[again.converged].max() < 1e-2 * robot.size
    right = np.abs(again.T - result.T).max(axis=(1, 2)) < 1e-9
    assert 0.85 < right.mean() < 1
    assert again.converged[right].all()
    for row in np.flatnonzero(~right).tolist():
        assert again.explain(row).code != "kinematics.closed"


def test_contradicting_readings_are_reported_as_a_compromise():
    robot = load_cable_robot((1e-3, 1e-3, 1e-3, 1e-3))
    q = inverse(robot, robot.home[None, :3, 3]).q
    fits, apart = forward(robot, q), forward(robot, q * [1.002, 1, 1, 1])
    assert fits.explain(0).code == "kinematics.closed"
    assert apart.converged.all()
    assert apart.explain(0).code == "kinematics.compromise"
    wild = forward(robot, q + np.array([40.0, 0, 0, 40.0]))
    assert wild.status[0] == Status.UNREACHABLE
    assert wild.explain(0).code == "kinematics.unreachable"


def solve_example_pose(robot, seed=0):
    """Return values (1, p), a pose (1, 1, 4, 4), and the state and readings at this pose."""
    rng = np.random.default_rng(seed)
    values = robot.values[None] + 1e-3 * rng.standard_normal((1, len(robot.values)))
    T = zoo.place((0.01, -0.02, 0.0), (0, 0, 0.1))[None, None]
    state, q = solve_at_pose(robot, values, T, robot.home_state)
    assert (state.status == Status.CONVERGED).all()
    return values, T, state, q


def test_every_limb_closes_at_the_given_pose():
    robot = zoo.planar_arms(("ball",) * 4, first=80.0)
    values, T, state, q = solve_example_pose(robot)
    assert_allclose(state.T, T, atol=1e-14)  # [m], [rad]
    assert state.residual.max() < 1e-12 * robot.size
    solution = forward(robot.with_values(values[0]), q[0])
    assert_allclose(solution.T, T[0], atol=1e-11)  # [m]: consistent readings give the same pose


def test_reading_and_passive_joint_derivatives_at_a_pose_agree_with_differences():
    robot = zoo.planar_arms(("ball",) * 4, first=80.0)
    values, T, state, q = solve_example_pose(robot)
    result = differentiate_at_pose(robot, values, q, state)
    p, freedoms = values.shape[1], robot.program.freedoms
    moved = np.zeros((3, 6))
    moved[range(3), list(freedoms)] = 1.0

    def joints(x):  # one trial a parameter or freedom
        at = np.concatenate(
            [
                np.tile(T, (p, 1, 1, 1)),
                geometry.apply_twist(np.tile(T, (3, 1, 1, 1)), x[0] * moved[:, None]),
            ]
        )
        every = np.concatenate([values + x[0] * np.eye(p), np.tile(values, (3, 1))])
        new, readings = solve_at_pose(robot, every, at, state)
        elbows = np.concatenate([new.joints[0][:, 0, k, 1:2] for k in range(4)], axis=1)
        return np.concatenate([readings[:, 0], elbows], axis=1)

    both = [np.concatenate(parts, axis=-1)[0, 0] for parts in (result.readings, result.passive)]
    expected = np.concatenate(both).T[..., None]
    check_jacobian(
        joints,
        expected,
        np.zeros(1),
        scale=0.1,
        atol=1e-6,
        atol_reason="closure to 1e-13, step 1e-4",
    )


def test_derivatives_by_pose_and_by_readings_agree():
    robot = zoo.planar_arms(("ball",) * 4, first=80.0)
    values, _, state, q = solve_example_pose(robot)
    result = differentiate_at_pose(robot, values, q, state)
    by_reading = differentiate_passive_joints(robot, values, q, state)
    # passive by readings, readings by pose
    turned = by_reading.readings[0, 0] @ result.readings[1][0, 0]
    assert_allclose(turned, result.passive[1][0, 0], atol=1e-9)  # [rad/m]
    assert inverse(robot, np.zeros((1, 3))).converged.all()
