# SPDX-License-Identifier: Apache-2.0
"""A leg with closed loops in knee and ankle, described as a user would, against its equations."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.optimize import least_squares, root_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from loopcal.estimate.identification import identify
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace

Array = NDArray[np.float64]

LEG = """format: 1
family: stages
name: leg
units: {length: mm, angle: deg}
controlled: [x, y, z, roll, pitch, yaw]
stages:
  - name: hip-yaw
    joint: {kind: R, axis: z, errors: [offset]}
  - name: hip-roll
    joint: {kind: R, axis: x, errors: [offset]}
  - name: hip-pitch
    joint: {kind: R, axis: y, start: -30, errors: [offset, rz]}
  - name: knee
    mount: {z: -300}
    family: limbs
    controlled: [pitch]
    home: {pitch: 60}
    limbs:
      - {name: pin, ending: rigid, chain: [{joint: R, axis: y, start: 60}], attach: [0, 0, 0]}
      - name: rod
        ending: distance
        chain: [{joint: R, at: [50, 0, 100], axis: y, actuated: knee-motor, start: 60}]
        tip: [60, 0, 0]
        attach: [60, 0, -30]
        length: 138
        errors: [{of: platform, shift: [x, z]}]
  - name: ankle
    mount: {z: -300}
    family: limbs
    controlled: [roll, pitch]
    home: {pitch: -30}
    limbs:
      - name: cross
        ending: rigid
        chain: [{joint: U, axes: [x, y], start: [0, -30]}]
        attach: [0, 0, 0]
      - &rod
        name: left
        ending: distance
        chain: [{joint: R, at: [0, 40, 150], axis: y, actuated: left}]
        tip: [-50, 0, 0]
        attach: [-50, 40, 0]
        length: 150
        errors: [{of: platform, shift: [x]}]
      - <<: *rod
        name: right
        chain: [{joint: R, at: [0, -40, 150], axis: y, actuated: right}]
        attach: [-50, -40, 0]
tolerances: {lengths: {sd: 0.1}, angles: {sd: 0.05}}
workspace:
  {x: [-50, 50], y: [-50, 50], z: [-560, -480], roll: [-5, 5], pitch: [-5, 5], yaw: [-5, 5]}
"""


@pytest.fixture
def leg(tmp_path: Path) -> Mechanism:
    path = tmp_path / "leg.yaml"
    path.write_text(LEG, "utf-8")
    return load_robot(path)


def bend_knee(motor: float) -> float:
    """Return the angle about y at which the rod between crank and shank has its length."""
    crank = np.array([0.05, 0, 0.1]) + turn("y", motor) @ [0.06, 0, 0]

    def gap(angle: float) -> float:
        head = turn("y", angle) @ [0.06, 0, -0.03]
        return float(np.linalg.norm(head - crank)) - 0.138

    return root_scalar(gap, bracket=np.radians([20, 110]), xtol=1e-15).root


def bend_ankle(motors: Array) -> Array:
    """Return the rotation about x, then y, at which both rods have their length."""
    sides = np.array([0.04, -0.04])

    def gaps(angles: Array) -> list[float]:
        foot = turn("x", angles[0]) @ turn("y", angles[1])
        return [
            float(np.linalg.norm(foot @ [-0.05, side, 0] - crank)) - 0.15
            for side, motor in zip(sides, motors, strict=True)
            for crank in [np.array([0, side, 0.15]) + turn("y", motor) @ [-0.05, 0, 0]]
        ]

    found = least_squares(gaps, [0.0, np.radians(-30)], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.cost < 1e-28
    return turn("x", found.x[0]) @ turn("y", found.x[1])


def turn(axis: str, angle: float) -> Array:
    """Return the rotation (3, 3) about an axis."""
    return Rotation.from_euler(axis, angle).as_matrix()


def walk(q: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3) and position (3,) of the foot at readings (6,)."""
    hip = turn("z", q[0]) @ turn("x", q[1]) @ turn("y", q[2])
    knee = hip @ turn("y", bend_knee(q[3]))
    return knee @ bend_ankle(q[4:]), hip @ [0, 0, -0.3] + knee @ [0, 0, -0.3]


def test_a_leg_with_closed_knee_and_ankle_agrees_with_its_equations(leg: Mechanism) -> None:
    solution = sample_workspace(leg, 12, seed=3).solution
    for q, T in zip(solution.q, forward(leg, solution.q).T, strict=True):
        rotation, position = walk(q)
        # [1, m] 1e-9 of a size of 0.6 m
        assert_allclose(T[:3, :3], rotation, rtol=0, atol=6e-10)
        assert_allclose(T[:3, 3], position, rtol=0, atol=6e-10)
    again = inverse(leg, solution.T)
    assert again.converged.all()
    assert_allclose(again.q, solution.q, rtol=0, atol=1e-9)


def test_a_leg_with_closed_knee_and_ankle_is_calibrated(leg: Mechanism) -> None:
    instrument = Instrument((Sensor(Pose(), Gaussian(np.array([1e-5] * 3 + [5e-5] * 3))),))
    true = leg.with_values(sample_truth(leg, 1, 2)[0])
    data = simulate(true, sample_workspace(leg, 30, seed=1).coordinates, instrument, 4)
    fit = identify(leg, data)
    error = (fit.robot.values - true.values) / fit.standard_deviations
    assert np.abs(error).max() < 4.0
    low, high = chi2.ppf([0.005, 0.995], fit.residual_test.dof)
    assert low < fit.chi_square < high
