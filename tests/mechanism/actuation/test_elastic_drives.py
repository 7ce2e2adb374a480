# SPDX-License-Identifier: Apache-2.0
"""Elastic drives: loads from the wrench on the platform, against statics written for the test."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.apply.compensation import compensate
from loopcal.diagnose.fit_examination import compute_reading_errors
from loopcal.errors import FileError, MechanismError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP
from loopcal.io.data.measurement_file import load_measurements, save_measurements
from loopcal.io.robot.robot_file import SHIPPED_ROBOTS, load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.assembly import FORCES
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests.mechanism.derivatives import check_pose_derivatives
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

NAME = "hexapod-elastic"
TIP = np.array([0.0, 0.0, 0.18])
SIGMA = np.repeat([10e-6, 2e-6], 3)
INSTRUMENT = Instrument((Sensor(Pose(), Gaussian(SIGMA)),))


def shipped_text(name: str) -> str:
    return (SHIPPED_ROBOTS / f"{name}.yaml").read_text("utf-8")


def get_points(robot: Mechanism, part: str) -> np.ndarray:
    """Return the points (6, 3) of the legs of a hexapod, or their lengths (6,)."""
    names, axes = robot.parameters.names, [f".{a}" for a in "xyz"] if part != "length" else [""]
    places = [[names.index(f"leg{k}.{part}{axis}") for axis in axes] for k in range(1, 7)]
    return robot.values[places].squeeze()


def find_leg_loads(robot: Mechanism, T: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the forces (n, 6) of legs that hold the platform at T (n, 4, 4) under forces (n, 3) at
    the tip: equilibrium of forces and moments, leg by leg along the line of its joints.
    """
    arms = get_points(robot, "platform") @ np.swapaxes(T[:, :3, :3], 1, 2)
    legs = arms + T[:, None, :3, 3] - get_points(robot, "base")
    along = legs / np.linalg.norm(legs, axis=2, keepdims=True)
    balance = np.concatenate([along, np.cross(arms, along)], axis=2)  # of each leg's tension
    moment = np.cross(T[:, :3, :3] @ TIP, force)
    applied = np.concatenate([force, moment], axis=1)
    return np.linalg.solve(np.swapaxes(balance, 1, 2), applied[..., None])[..., 0]


def draw_forces(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-1e3, -1e3, -3e3], [1e3, 1e3, 1e3], (count, 3))


def test_a_hexapod_yields_as_equilibrium_at_its_own_pose_states() -> None:
    nominal = load_cached_robot(NAME)
    robot = nominal.with_values(sample_truth(nominal, 1, 2)[0])
    compliance = robot.values[[robot.parameters.index(f"q{k}.compliance") for k in range(1, 7)]]
    poses, force = sample_workspace(nominal, 100, seed=3).solution.T, draw_forces(100, 4)
    for i in range(100):
        today = dict(zip(FORCES, force[i], strict=False))
        loaded = robot.with_conditions(today)
        solved = inverse(loaded, poses[i : i + 1])
        loads = find_leg_loads(robot, poses[i : i + 1], force[i : i + 1])
        legs = poses[i, :3, :3] @ get_points(robot, "platform").T + poses[i, :3, 3:]
        length = np.linalg.norm(legs.T - get_points(robot, "base"), axis=1)
        known = length - get_points(robot, "length") - compliance * loads[0]
        assert_allclose(solved.q[0, :6], known, rtol=0, atol=1e-9)
        assert_allclose(solved.q[0, 6:], loads[0], rtol=0, atol=1e-6)  # [N]
        if i < 10:  # the way back, with loads of the file and with today's
            for q in (solved.q, solved.q[:, :6]):
                assert_allclose(forward(loaded, q).T[0], poses[i], rtol=0, atol=1e-9)


@pytest.mark.parametrize("axes", ["base", "platform"])
def test_the_force_acts_at_its_point_in_its_axes(tmp_path: Path, axes: str) -> None:
    text = shipped_text(NAME).replace("load: {at", f"load: {{axes: {axes}, at")
    robot = load_text(tmp_path, text)
    poses = sample_workspace(robot, 5, seed=5).solution.T
    force = np.tile([300.0, -200.0, -900.0], (5, 1))
    own = np.einsum("nij,nj->ni", poses[:, :3, :3], force) if axes == "platform" else force
    q = inverse(robot.with_conditions(dict(zip(FORCES, force[0], strict=False))), poses).q
    assert_allclose(q[:, 6:], find_leg_loads(robot, poses, own), rtol=0, atol=1e-6)


KNOWN = "compliance: 1.0e-4, compliances: {sd: 1.0e-5}"
CHAIN = "\ndrives: {NAME: {reads: angle, unknown: [compliance], " + KNOWN + "}}\nstages:"
DRIVES = {
    "rotary-delta": (("unknown: [offset]", f"unknown: [offset, compliance], {KNOWN}"),),
    "warm-delta": (("unknown: [offset]", f"unknown: [offset, compliance], {KNOWN}"),),
    "core-xy": (("unknown: [offset, radius", f"{KNOWN}, unknown: [compliance, offset, radius"),),
    "arm-6r": (("\nstages:", CHAIN.replace("NAME", "j2")),),
    "hexapod-turntable": (("\nstages:", CHAIN.replace("NAME", "turntable")),),
    "excavator": (
        ("length: &length", "compliance: 0.001\n        length: &length"),
        ("length: &length", "compliances: {sd: 0.0001}\n        length: &length"),
        ("unknown: [offset", "unknown: [compliance, offset"),
    ),
}
"""Shipped robots of other kinds -> what makes drives of them elastic."""


def make_elastic(folder: Path, name: str) -> Mechanism:
    text = shipped_text(name)
    for old, new in DRIVES[name]:
        assert old in text
        text = text.replace(old, new, 1)
    return load_text(folder, text)


@pytest.mark.parametrize("name", DRIVES)
def test_a_load_is_the_work_of_the_wrench_where_its_drive_moves_alone(tmp_path, name):
    robot = make_elastic(tmp_path, name)
    wrench = np.array([30.0, -20.0, -100.0, 2.0, 1.0, -3.0])
    today = robot.with_conditions(dict(zip(FORCES, wrench, strict=True)))
    solved = forward(today, sample_workspace(robot, 5, seed=1).solution.q[:, robot.is_commanded])
    assert solved.converged.all()
    names = [a.name for a in robot.actuators]
    elastic = [name.removeprefix("load.") for name in names if name.startswith("load.")]
    assert elastic
    for drive in elastic:
        step = np.zeros(len(names))
        step[names.index(drive)] = 1e-6
        ends = [forward(robot, solved.q + s * step, solved) for s in (1.0, -1.0)]
        twist = geometry.pose_difference(ends[0].T, ends[1].T) / 2e-6
        work = twist @ np.concatenate([wrench[3:], wrench[:3]])
        if name == "core-xy":  # in which the load is that of the belt, not of the motor
            work /= 6.36619772e-3
        assert_allclose(solved.q[:, names.index(f"load.{drive}")], work, rtol=1e-6, atol=1e-6)


def test_a_rotary_delta_twists_its_motors_by_the_moment_of_its_rods(tmp_path: Path) -> None:
    robot = make_elastic(tmp_path, "rotary-delta")
    force = np.array([12.0, -7.0, -60.0])
    today = robot.with_conditions(dict(zip(FORCES, force, strict=False)))
    solved = inverse(today, sample_workspace(robot, 20, seed=2).solution.T)
    from loopcal.mechanism.kinematics import compute_limb_frames

    frames = compute_limb_frames(robot, robot.values[None], solved.state)
    motors, elbows, balls = [], [], []
    for limb, chain in zip(robot.assembly.limbs, frames, strict=True):
        driven = next(j for j, joint in enumerate(limb.joints) if joint.actuator)
        motors.append(chain[0, :, driven])
        elbows.append(chain[0, :, -2, :3, 3])
        balls.append(chain[0, :, -1, :3, 3])
    rods = np.stack(balls, axis=1) - np.stack(elbows, axis=1)
    rods /= np.linalg.norm(rods, axis=2, keepdims=True)
    pull = np.linalg.solve(np.swapaxes(rods, 1, 2), np.tile(force[:, None], (20, 1, 1)))[..., 0]
    for k, motor in enumerate(motors):
        arm = elbows[k] - motor[:, :3, 3]
        moment = np.einsum(
            "ni,ni->n", np.cross(arm, pull[:, k, None] * rods[:, k]), motor[:, :3, 2]
        )
        assert_allclose(solved.q[:, 3 + k], moment, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", [*DRIVES, NAME])
def test_derivatives_by_compliances_and_loads_agree_with_differences(tmp_path, name):
    robot = make_elastic(tmp_path, name) if name in DRIVES else load_cached_robot(NAME)
    machine = robot.with_values(sample_truth(robot, 1, 2)[0])
    q = sample_workspace(robot, 2, seed=4).solution.q
    q[:, ~robot.is_commanded] = 40.0
    check_pose_derivatives(machine, q[None])


def measure_machine(robot: Mechanism, seed: int, folder: Path) -> tuple[Mechanism, Path]:
    """Return a machine with drawn errors, and a file of its measurements under known forces. It
    yields by equilibrium of its own geometry, which the reader of the file does not know.
    """
    machine = robot.with_values(sample_truth(robot, 1, seed)[0])
    q = sample_workspace(robot, 60, seed=seed + 100).solution.q
    force, rng = draw_forces(60, seed), np.random.default_rng(seed)
    for _ in range(4):
        q[:, 6:] = find_leg_loads(machine, forward(machine, q).T, force)
    T = forward(machine, q).T @ robot.tool
    noise = SIGMA * rng.standard_normal((60, 6))
    position = (T[:, :3, 3] + noise[:, 3:]) * 1e3
    turn = np.rad2deg(geometry.log_so3(geometry.exp_so3(noise[:, :3]) @ T[:, :3, :3]))
    head = "# format: 1\n# kind: pose\n# orientation: rotation-vector\n"
    head += "# noise: {rx: 10 urad, ry: 10 urad, rz: 10 urad, x: 2 um, y: 2 um, z: 2 um}\n"
    columns = [*(f"q{k} [mm]" for k in range(1, 7)), *(f"force.{a} [N]" for a in "xyz")]
    columns += [*(f"r{a} [deg]" for a in "xyz"), *(f"{a} [mm]" for a in "xyz")]
    rows = np.concatenate([q[:, :6] * 1e3, force, turn, position], axis=1)
    path = folder / f"machine{seed}.csv"
    np.savetxt(path, rows, "%.15g", ",", header=head + ",".join(columns), comments="")
    return machine, path


def test_compliances_of_machines_in_equilibrium_are_as_accurate_as_stated(tmp_path: Path) -> None:
    robot = load_cached_robot(NAME)
    scores, own = [], []
    is_compliance = ["compliance" in name for name in robot.parameters.names]
    for seed in range(20):
        machine, path = measure_machine(robot, seed, tmp_path)
        fit = identify(robot, load_measurements(path, robot), MAP())
        deviation = (fit.robot.values - machine.values)[fit.free_parameters.places]
        scores.append(deviation / fit.standard_deviations)
        own.append(scores[-1][is_compliance])
        assert fit.standard_deviations[is_compliance].max() < 1.2e-9  # of 10e-9 m/N before
    # 960 values of a standard normal distribution, and 120
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.1
    assert 0.8 < np.sqrt(np.mean(np.square(own))) < 1.2


def test_simulated_machines_and_compensation_know_the_load(tmp_path: Path) -> None:
    robot = load_cached_robot(NAME)
    machine = robot.with_values(sample_truth(robot, 1, 3)[0])
    poses = sample_workspace(robot, 60, seed=7).solution.T
    data = simulate(machine, poses, INSTRUMENT, 3)
    path = tmp_path / "data.csv"
    save_measurements(data, path, machine)
    assert_allclose(load_measurements(path, robot).readings, data.readings, rtol=1e-12, atol=1e-12)
    fit = identify(robot, data, MAP())
    load = {"force.z": -2500.0, "force.x": 600.0}
    q = compensate(fit.posterior, poses[:8], conditions=load).readings
    reached = forward(machine.with_conditions(load), q[:, :6]).T
    assert_allclose(reached[:, :3, 3], poses[:8, :3, 3], rtol=0, atol=10e-6)
    forgotten = forward(
        machine.with_conditions(load), compensate(fit.posterior, poses[:8]).readings[:, :6]
    )
    assert np.linalg.norm(forgotten.T[:, :3, 3] - poses[:8, :3, 3], axis=1).min() > 15e-6


HEAD = "# format: 1\n# kind: component\n# components: [x]\n# noise: {x: 0.01mm}\n"
LEGS = ",".join(f"q{k} [mm]" for k in range(1, 7))
ZERO = "0,0,0,0,0,0"


def write(folder: Path, columns: str, *rows: str) -> Path:
    path = folder / "data.csv"
    text = "".join(f"{i},{ZERO},{row},0\n" for i, row in enumerate(rows, 1))
    path.write_text(f"{HEAD}pose,{LEGS},{columns},x [mm]\n{text}", "utf-8")
    return path


def test_forces_of_a_file_are_read_in_their_units(tmp_path: Path) -> None:
    robot = load_cached_robot(NAME)
    columns = "force.x [N],force.y [N],force.z [kN],moment.z [Nm]"
    path = write(tmp_path, columns, "100,0,-1.5,20", "0,0,0,0")
    loads = load_measurements(path, robot).readings[:, 6:]
    today = {"force.x": 100.0, "force.z": -1500.0, "moment.z": 20.0}
    known = forward(robot.with_conditions(today), np.zeros((1, 6))).q[0, 6:]
    assert_allclose(loads, [known, np.zeros(6)], rtol=1e-9, atol=1e-9)
    assert known.sum() < -1000.0  # the tool is pushed to the base, so the struts are shortened


@pytest.mark.parametrize(
    ("columns", "row", "said"),
    [
        ("force.x [N],force.z [N]", "1,2", "no column 'force.y'"),
        ("force.x [N],force.y [N],force.z [N]", "1,2,", "column 'force.z' is empty"),
        ("force.x [N],force.y [N],force.z [mm]", "1,2,3", "unit of length, not of a force"),
        ("force.x,force.y [N],force.z [N]", "1,2,3", "'force.x' "),
        ("Fx [N],force.y [N],force.z [N]", "1,2,3", "'Fx' is unknown"),
        ("load.q1 [N],force.x [N],force.y [N],force.z [N]", "1,1,2,3", "remove one of the two"),
        ("load.q1 [N]", "1", "no column 'load.q2'"),
        ("note nothing", "1", "no column 'force.x'"),
    ],
)
def test_a_mistake_in_the_columns_of_the_load_is_refused(tmp_path, columns, row, said):
    with pytest.raises(FileError) as refused:
        load_measurements(write(tmp_path, columns, row), load_cached_robot(NAME))
    assert said in str(refused.value)


def test_a_force_on_a_stiff_robot_is_refused(tmp_path: Path) -> None:
    robot = load_cached_robot("hexapod-octahedral")
    with pytest.raises(FileError, match=r"force\.z"):
        load_measurements(write(tmp_path, "force.z [N]", "1"), robot)
    with pytest.raises(MechanismError, match="no condition"):
        robot.with_conditions({"force.z": 1.0})


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("cable-4", "reads: angle", "reads: angle\n    compliance: 1.0e-4", "does not determine"),
        (NAME, "compliance: 5.0e-5, unknown: [compliance], compliances", "length", "no drive with"),
        (NAME, "force.y:", "force.q:", "Call it temperature"),
        (NAME, "[-3000, 1000]", "[3000, 1000]", "first value must be smaller"),
        (NAME, ", compliances: {sd: 1.0e-5}", "", "Give `compliances:`"),
        (NAME, "compliance: 5.0e-5", "compliance: -5.0e-5", "negative"),
    ],
)
def test_loads_that_mean_nothing_are_refused(tmp_path, name, old, new, said):
    text = shipped_text(name)
    assert old in text
    with pytest.raises((FileError, MechanismError)) as refused:
        load_text(tmp_path, text.replace(old, new, 1))
    assert said in str(refused.value)


def test_an_elastic_robot_is_shipped_with_units_of_its_compliances() -> None:
    robot = load_robot(NAME)
    unit = robot.get_unit(robot.parameters.dimensions[-1])
    assert (unit.symbol, unit.factor_to_si) == ("um/N", 1e-6)
    assert robot.parameters.nominal[-1] == pytest.approx(5e-8)


def test_reading_errors_are_those_of_commanded_readings() -> None:
    robot = load_cached_robot(NAME)
    poses = sample_workspace(robot, 30, seed=7).solution.T
    sigma = np.repeat([20e-6, 0.0], 6)
    data = simulate(robot, poses, INSTRUMENT, 3, reading_sigma=sigma)
    errors = compute_reading_errors(identify(robot, data, MAP()), data)
    assert errors is not None
    assert [error.name for error in errors] == [f"q{k}" for k in range(1, 7)]
    assert all(error.joint == pytest.approx(error.reading) for error in errors)
