# SPDX-License-Identifier: Apache-2.0
"""Joints that a temperature or time of the data moves, against closed forms."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.apply.compensation import compensate
from loopcal.errors import DataError, FileError, MechanismError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP
from loopcal.estimate.result import Identification
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import load_robot, save_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.actuation import differentiate_at_pose, solve_at_pose
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests.mechanism.derivatives import check_pose_derivatives
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

BEAM = """format: 1
family: limbs
name: beam
units: {length: mm, angle: deg}
freedoms: [x]
controlled: [x]
drives:
  screw: {reads: length, stroke: [-100, 100]}
conditions:
  time: {reference: 60}
  temperature: {reference: 20}
couplings:
  drift: {of: length, sum: {beam.drift: 1}, condition: time, slope: 0.001, offset: 0.1, unknown: [slope, offset], slopes: {sd: 0.0005}, length: {sd: 0.1}}
  growth: {of: length, sum: {beam.growth: 1}, condition: temperature, slope: 0.002}
limbs:
  - {name: beam, ending: rigid, chain: [{joint: P, name: drift, axis: x}, {joint: P, name: way, axis: x, actuated: screw}, {joint: P, name: growth, axis: x}]}
workspace: {x: [-50, 50]}
"""  # noqa: E501
INSTRUMENT = Instrument((Sensor(Pose(), Gaussian(np.repeat([50e-6, 5e-6], 3))),))


def draw_readings(robot: Mechanism, count: int) -> np.ndarray:
    """Return readings of reachable poses at drawn conditions."""
    q = sample_workspace(robot, count, seed=3).solution.q
    rng = np.random.default_rng(4)
    for i, actuator in enumerate(robot.actuators):
        if actuator.reference is not None:
            q[:, i] = rng.uniform(*(actuator.stroke or (0.0, 30.0)), count)
    return q


def test_a_delta_grows_with_its_temperatures_as_its_closure_states() -> None:
    nominal = load_cached_robot("warm-delta")
    robot = nominal.with_values(sample_truth(nominal, 1, 2)[0])
    q = draw_readings(robot, 100)
    solved = forward(robot, q)
    assert solved.converged.all()
    rise = q[:, 3:] - 20.0

    def get(name: str) -> float:
        return float(robot.values[robot.parameters.index(name)])

    for i in range(3):
        angle, turn = q[:, i] + get(f"q{i + 1}.offset"), 2 * np.pi * i / 3
        arm = get(f"arm{i + 1}.upper.x") + get(f"upper{i + 1}.slope") * rise[:, 1]
        x = get(f"arm{i + 1}.base.x") + get(f"base{i + 1}.slope") * rise[:, 0] + arm * np.cos(angle)
        y, z = get(f"arm{i + 1}.base.y"), get(f"arm{i + 1}.base.z") - arm * np.sin(angle)
        tip = [np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z]
        ball = solved.T[:, :3, 3] + [0.04 * np.cos(turn), 0.04 * np.sin(turn), 0.0]
        rod = np.linalg.norm(ball - np.stack(tip, axis=1), axis=1)
        assert_allclose(rod, get(f"arm{i + 1}.length"), rtol=0, atol=1e-9)


def test_derivatives_by_slopes_and_conditions_agree_with_differences(tmp_path: Path) -> None:
    for robot in (load_cached_robot("warm-delta"), load_text(tmp_path, BEAM)):
        machine = robot.with_values(sample_truth(robot, 1, 2)[0])
        check_pose_derivatives(machine, draw_readings(machine, 2)[None])


def test_a_beam_drifts_and_grows_and_is_commanded_at_its_references(tmp_path: Path) -> None:
    robot = load_text(tmp_path, BEAM)
    assert [a.name for a in robot.actuators] == ["screw", "time", "temperature"]
    x = forward(robot, np.array([[0.01, 160.0, 30.0]])).T[0, 0, 3]
    assert x == pytest.approx(0.01 + 100 * 1e-6 + 1e-4 + 10 * 2e-6, abs=1e-12)
    assert_allclose(inverse(robot, [[0.01]]).q, [[0.0099, 60.0, 20.0]], rtol=0, atol=1e-12)
    warm = robot.with_conditions({"temperature": 30.0})
    assert_allclose(inverse(warm, [[0.01]]).q, [[0.00988, 60.0, 30.0]], rtol=0, atol=1e-12)
    with pytest.raises(MechanismError, match="no condition 'temperatur'"):
        robot.with_conditions({"temperatur": 30.0})


def test_a_file_states_conditions_in_their_units(tmp_path: Path) -> None:
    robot = load_text(tmp_path, BEAM)
    path = tmp_path / "data.csv"
    path.write_text(
        "# format: 1\n# kind: component\n# components: [x]\n# noise: {x: 0.01mm}\n"
        "pose,screw [mm],time [min],temperature [K],x [mm]\n"
        "1,10,2,303.15,10.18\n2,20,3,293.15,20.22\n",
        "utf-8",
    )
    data = load_measurements(path, robot)
    assert_allclose(data.readings, [[0.01, 120, 30], [0.02, 180, 20]], rtol=0, atol=1e-12)


def fit_machine(robot: Mechanism, seed: int) -> tuple[Mechanism, Identification]:
    """Return a machine with drawn errors, and the fit of its measurements."""
    machine = robot.with_values(sample_truth(robot, 1, seed)[0])
    poses = sample_workspace(robot, 25, seed=seed + 100).solution.T
    return machine, identify(robot, simulate(machine, poses, INSTRUMENT, seed), MAP())


def test_slopes_of_simulated_machines_are_as_accurate_as_stated() -> None:
    robot = load_cached_robot("warm-delta")
    scores = []
    for seed in range(20):
        machine, fit = fit_machine(robot, seed)
        deviation = (fit.robot.values - machine.values)[fit.free_parameters.places]
        scores.append(deviation / fit.standard_deviations)
    # 480 values of a standard normal distribution
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.1


# Four cranks with rods hold a plate that needs three, and all cranks grow.
LEGS = """format: 1
family: limbs
name: legs
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
drives: {q: {reads: angle, sigma: 0.002, unknown: [offset], angle: {sd: 0.2}}}
conditions: {temperature: {reference: 20, range: [15, 45]}}
couplings:
  grow: {of: length, sum: {leg.stretch: 1}, condition: temperature, slope: 0.0046, unknown: [slope], slopes: {sd: 0.0007}}
limbs:
  - name: leg
    copies: {count: 4}
    chain:
      - {joint: R, name: motor, at: {x: 320, yaw: 130}, actuated: q}
      - {joint: P, name: stretch, at: [200, 0, 0], axis: x}
    ending: distance
    length: 190
    attach: [70, 10, 0]
    errors: [{of: stretch, shift: [x], tolerance: {sd: 0.1}}, {of: rod, shift: [length], tolerance: {sd: 0.1}}]
workspace: {x: [-30, 30], y: [-30, 30], yaw: [-15, 15]}
"""  # noqa: E501


def test_a_leg_more_than_needed_grows_with_its_temperature(tmp_path: Path) -> None:
    robot = load_text(tmp_path, LEGS)
    machine = robot.with_values(sample_truth(robot, 1, 6)[0])
    value = dict(zip(robot.parameters.names, machine.values, strict=True))
    sharp = np.array([1e-9, 1e-9, 1e-9, 1e-9, 0.0])  # [rad], and the temperature
    poses = sample_workspace(robot, 20, seed=2).coordinates
    data = simulate(machine, poses, INSTRUMENT, 3, reading_sigma=sharp)
    warm = data.readings[:, 4]
    assert np.ptp(warm) > 20.0  # [K], as drawn from the range
    T = forward(machine, data.readings).T
    turn = T[:, 0, 0] + 1j * T[:, 1, 0]
    for i in range(4):
        angle = np.pi / 2 * i + np.deg2rad(130) + data.readings[:, i] + value[f"q{i + 1}.offset"]
        crank = value[f"leg{i + 1}.stretch.x"] + value[f"grow{i + 1}.slope"] * (warm - 20.0)
        elbow = 0.32 * 1j**i + crank * np.exp(1j * angle)
        tip = T[:, 0, 3] + 1j * T[:, 1, 3] + turn * (0.07 + 0.01j) * 1j**i
        assert_allclose(abs(tip - elbow), value[f"leg{i + 1}.length"], rtol=0, atol=2e-9)
    state, q = solve_at_pose(
        *(machine, machine.values[None], T[None], robot.home_state), data.readings[None]
    )
    moved = differentiate_at_pose(machine, machine.values[None], q, state)
    for k, change in enumerate(1e-6 * np.eye(len(robot.parameters))):
        ends = [
            solve_at_pose(machine, machine.values[None] + side * change, T[None], state, q)[1]
            for side in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / 2e-6
        assert_allclose(moved.readings[0][..., k], slope, rtol=0, atol=1e-5)  # step 1e-6


def test_estimates_of_warm_redundant_legs_are_as_accurate_as_stated(tmp_path: Path) -> None:
    robot, scores = load_text(tmp_path, LEGS), []
    for seed in range(20):
        machine, fit = fit_machine(robot, seed)
        scores.append((fit.robot.values - machine.values) / fit.standard_deviations)
    # 320 values, in part correlated
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.1
    with pytest.raises(DataError, match="a sigma of temperature, but conditions"):
        simulate(robot, robot.home[None], INSTRUMENT, 1, reading_sigma=1e-3)


def test_compensation_holds_todays_temperatures() -> None:
    robot = load_cached_robot("warm-delta")
    machine, fit = fit_machine(robot, 1)
    poses = sample_workspace(robot, 5, seed=2).solution.T
    today = {"temperature.base": 27.0, "temperature.arms": 40.0}
    q = compensate(fit.robot.with_conditions(today), poses).readings
    assert_allclose(q[:, 3:], np.tile([27.0, 40.0], (5, 1)))
    assert_allclose(forward(machine, q).T[:, :3, 3], poses[:, :3, 3], rtol=0, atol=3e-5)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("temperature", "heat", "Call it temperature"),
        ("condition: time", "condition: tim", "did you mean 'time'"),
        ("condition: time, ", "", "is in no coupling"),
    ],
)
def test_impossible_conditions_are_refused(tmp_path, old, new, said):
    changed = BEAM.replace(old, new)
    with pytest.raises((FileError, MechanismError)) as refused:
        load_text(tmp_path, changed)
    assert said in str(refused.value)


def test_slopes_are_shown_in_units_of_their_own(tmp_path: Path) -> None:
    for robot, name, symbol, shown in (
        (load_cached_robot("warm-delta"), "upper1.slope", "um/degC", 4.6),
        (load_text(tmp_path, BEAM), "drift.slope", "um/s", 1.0),
    ):
        i = robot.parameters.names.index(name)
        assert robot.get_unit(robot.parameters.dimensions[i]).symbol == symbol
        assert robot.list_shown(robot.values)[i] == pytest.approx(shown)
        path = tmp_path / "moved.yaml"  # a slope is written and read back in this unit
        moved = robot.with_values(robot.values * 1.01)
        save_robot(moved, path)
        assert_allclose(load_robot(path).values, moved.values, rtol=1e-12)
        path.unlink()
