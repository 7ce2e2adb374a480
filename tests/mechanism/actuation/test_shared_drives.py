# SPDX-License-Identifier: Apache-2.0
"""Drives that several limbs share, also where the platform's orientation follows its position."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.optimize import root

from loopcal.estimate.identification import identify_trials
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism.chains import ChainState
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
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
