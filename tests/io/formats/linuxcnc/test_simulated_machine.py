# SPDX-License-Identifier: Apache-2.0
"""The real LinuxCNC with simulated axes runs the exported kinematics."""

import fcntl
import json
import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.compensation import TableSize, make_tables
from loopcal.io.formats import linuxcnc
from loopcal.io.formats.correction_files import write_compensation
from loopcal.io.formats.linuxcnc_kinematics import NAME, write
from loopcal.io.formats.program_format import ExportSource
from tests.robot_texts import load_text

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("halcompile") is None or os.geteuid() != 0,
        reason="needs linuxcnc-uspace-dev, and root to install a component",
    ),
]

MM, POSES = 1e-3, 20
UNITS = np.repeat([MM, np.pi / 180], 3)
"""Of x, y, z, a, b, c in LinuxCNC."""
MODULES = Path("/usr/lib/linuxcnc/modules")
GAINS = """
drives:
  q: {reads: length, stroke: [-75, 75], unknown: [gain], ratio: {sd: 0.002}}
"""
"""Scale errors of screws, which genhexkins cannot store."""

DRIVER = """#!/usr/bin/python3
import json, time, hal, linuxcnc
moves, joints = json.load(open("moves.json"))
command, state, reached, motors = linuxcnc.command(), linuxcnc.stat(), [], []
reader = hal.component("reader"); reader.ready()
def wait(condition):
    end = time.time() + 20
    while time.time() < end:
        state.poll()
        if condition():
            return
        time.sleep(0.005)
    raise SystemExit("LinuxCNC does not answer")
command.state(linuxcnc.STATE_ESTOP_RESET); command.wait_complete()
command.state(linuxcnc.STATE_ON); command.wait_complete()
command.mode(linuxcnc.MODE_MANUAL); command.wait_complete()
command.home(-1)
wait(lambda: all(state.homed[:joints]))
command.teleop_enable(1); command.wait_complete()
command.mode(linuxcnc.MODE_MDI); command.wait_complete()
for move in moves:
    command.mdi("G0 " + " ".join("%s%.9f" % pair for pair in zip("XYZABC", move)))
    command.wait_complete(20)
    seen = []
    def rests():
        seen.append(state.joint_position[:joints])
        return state.inpos and len(seen) > 9 and seen[-1] == seen[-2] == seen[-10]
    wait(rests)
    reached.append(state.joint_position[:joints])
    motors.append([hal.get_value("joint.%d.motor-pos-cmd" % j) for j in range(joints)])
json.dump([reached, motors], open("reached.json", "w"))
"""

SETTINGS = """[EMC]
VERSION = 1.1
MACHINE = simulated
[DISPLAY]
DISPLAY = ./driver.py
[TASK]
TASK = milltask
CYCLE_TIME = 0.001
[RS274NGC]
PARAMETER_FILE = machine.var
[EMCMOT]
EMCMOT = motmod
COMM_TIMEOUT = 4.0
SERVO_PERIOD = 1000000
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.1
[HAL]
HALFILE = machine.hal
[TRAJ]
COORDINATES = XYZABC
LINEAR_UNITS = mm
ANGULAR_UNITS = degree
MAX_LINEAR_VELOCITY = 2000
DEFAULT_LINEAR_VELOCITY = 2000
[KINS]
"""
AXIS = "[AXIS_{}]\nMIN_LIMIT = -900\nMAX_LIMIT = 900\nMAX_VELOCITY = 900\nMAX_ACCELERATION = 9000\n"
JOINT = """[JOINT_{}]
TYPE = LINEAR
MIN_LIMIT = -900
MAX_LIMIT = 900
MAX_VELOCITY = 900
MAX_ACCELERATION = 9000
HOME_SEQUENCE = 0
HOME = {}
HOME_OFFSET = {}
"""


class Calibrated(NamedTuple):
    """A true machine, what was identified of it, poses to go to (n, 6) [mm, deg], and the
    covariance (n, 3, 3) [m^2] of the position there.
    """

    truth: lc.Mechanism
    identified: lc.Mechanism
    poses: np.ndarray
    covariance: np.ndarray


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """A hexapod with scale errors of its screws, calibrated by 60 measured poses."""
    shipped = (Path(lc.__file__).parent / "robots" / "hexapod-42.yaml").read_text("utf-8")
    robot = load_text(tmp_path_factory.mktemp("robot"), shipped + GAINS)
    noise = lc.Gaussian(np.repeat([5e-6, 2e-5], 3))
    return calibrate(robot, lc.Sensor(lc.Pose(), noise))


def calibrate(robot: lc.Mechanism, sensor: lc.Sensor) -> Calibrated:
    """Return a machine with errors of its tolerances, calibrated by 60 measured poses."""
    spread = np.nan_to_num(robot.parameters.tolerance) * robot.parameters.free
    errors = spread * np.random.default_rng(3).standard_normal(len(spread))
    truth = robot.with_values(robot.values + errors)
    target = lc.sample_workspace(robot, 60 + POSES, 1).coordinates
    tracker = lc.Instrument((sensor,))
    report = lc.calibrate(robot, lc.simulate(truth, target[:60], tracker, seed=2))
    fit = report.identification
    covariance = lc.pose_uncertainty(fit, target[60:], frame="base").covariance[:, -3:, -3:]
    return Calibrated(truth, fit.robot, target[60:] / UNITS[: target.shape[1]], covariance)


@pytest.fixture
def component(tmp_path: Path) -> Iterator[Path]:
    """Where the component of a test stands; it is removed from LinuxCNC afterwards, which runs once
    at a time on a machine.
    """
    with (Path(gettempdir()) / "linuxcnc-of-tests.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield tmp_path / f"{NAME}.comp"
        (MODULES / f"{NAME}.so").unlink(missing_ok=True)


def run_linuxcnc(
    kinematics: str,
    hal: str,
    homes: np.ndarray,
    poses: np.ndarray,
    compensation: Mapping[str, str] = MappingProxyType({}),
) -> np.ndarray:
    """Return positions of joints and of their motors (2, n, k) [mm] after moves to poses (n, k),
    from a home (k). `compensation` : name -> text of the file of each joint, none by default.
    """
    count, axes = len(homes), "XYZABC"[: len(homes)]
    joints = [f"net J{j} joint.{j}.motor-pos-cmd => joint.{j}.motor-pos-fb" for j in range(count)]
    lines = [
        f"loadrt {kinematics}",
        "loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS",
        "addf motion-command-handler servo-thread",
        "addf motion-controller servo-thread",
        *joints,
        "net estop iocontrol.0.user-enable-out iocontrol.0.emc-enable-in",
    ]
    text = SETTINGS.replace("XYZABC", axes) + f"KINEMATICS = {kinematics}\nJOINTS = {count}\n"
    text += "".join(map(AXIS.format, axes))
    for j, home in enumerate(homes.tolist()):
        text += JOINT.format(j, home, home)
        if (name := f"table-joint{j}.comp") in compensation:
            text += f"COMP_FILE = {name}\nCOMP_FILE_TYPE = 1\n"
    with TemporaryDirectory() as name:  # LinuxCNC refuses to run as root
        place = Path(name)
        (place / "machine.ini").write_text(text)
        (place / "machine.hal").write_text("\n".join(lines) + "\n" + hal + "\n")
        (place / "moves.json").write_text(json.dumps([poses.tolist(), count]))
        (place / "driver.py").write_text(DRIVER)
        for file, content in compensation.items():
            (place / file).write_text(content)
        (place / "driver.py").chmod(0o755)
        for path in (place, *place.iterdir()):
            shutil.chown(path, "nobody")
        command = ["runuser", "-u", "nobody", "--", "env", "-i", f"HOME={place}"]
        command += ["PATH=/usr/bin:/bin", "linuxcnc", "machine.ini"]
        for _ in range(3):  # where all processors are busy, its parts wait for each other in vain
            subprocess.run(command, cwd=place, timeout=120, check=False)
            if (place / "reached.json").exists():
                break
        return np.array(json.loads((place / "reached.json").read_text()))


def measure_errors(calibrated: Calibrated, readings: np.ndarray) -> np.ndarray:
    """Return how far (n, 3) [m] the true machine stands from the poses at readings (n, k) [m]."""
    reached = lc.forward(calibrated.truth, readings).T
    return reached[:, :3, 3] - calibrated.poses[:, :3] * MM


def test_the_component_moves_the_true_machine_to_the_commanded_poses(
    calibrated: Calibrated, component: Path
) -> None:
    source = ExportSource(calibrated.identified, {}, {})
    component.write_text(write(source, None).text, "utf-8")
    subprocess.run(["halcompile", "--install", component], check=True, capture_output=True)
    wanted = lc.inverse(calibrated.identified, calibrated.poses * UNITS).q
    homes = lc.inverse(calibrated.identified, calibrated.identified.home[None]).q[0] / MM
    joints = run_linuxcnc(NAME, "", homes, calibrated.poses)[0] * MM
    assert np.abs(joints - wanted).max() < 1e-6 * MM
    errors = measure_errors(calibrated, joints)
    square = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(calibrated.covariance), errors)
    assert square.max() < 21.1  # chi-square of three, exceeded with 1e-4

    # genhexkins has the corrected joint centers, but no scale of a screw
    pins = linuxcnc.write(source, None).text
    lengths = calibrated.identified
    starts = (
        np.array(
            [lengths.values[lengths.parameters.names.index(f"leg{n}.length")] for n in range(1, 7)]
        )
        / MM
    )
    struts = run_linuxcnc("genhexkins", pins, homes + starts, calibrated.poses)[0]
    left = measure_errors(calibrated, (struts - starts) * MM)
    rms, of_old = (float(np.sqrt((e**2).sum(axis=1).mean())) for e in (errors, left))
    assert rms < 10e-6
    assert of_old > 5 * rms


def test_lineardeltakins_leaves_what_its_two_pins_cannot_hold(component: Path) -> None:
    machine = calibrate(
        lc.load_robot("linear-delta"), lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 5e-6)))
    )
    source, own = ExportSource(machine.identified), machine.identified
    component.write_text(write(source, None).text, "utf-8")
    subprocess.run(["halcompile", "--install", component], check=True, capture_output=True)
    homes = lc.inverse(own, own.home[None]).q[0]
    joints = run_linuxcnc(NAME, "", homes / MM, machine.poses)[0] * MM
    assert np.abs(joints - lc.inverse(own, machine.poses * MM).q).max() < 1e-6 * MM
    exact = measure_errors(machine, joints)
    # its joints are heights of carriages, counted from HOME_OFFSET, of towers at 90, 210, 330 deg
    exported = linuxcnc.write(source, None)
    lines = linuxcnc.write_ini(source, None).text.splitlines()
    zeros, towers = np.array([float(line.split("=")[1]) for line in lines[1::2]]), [2, 0, 1]
    heights = run_linuxcnc(
        "lineardeltakins", exported.text, zeros - homes[towers] / MM, machine.poses
    )[0]
    left = measure_errors(machine, ((zeros - heights) * MM)[:, np.argsort(towers)])
    rms, of_pins = (float(np.sqrt((e**2).sum(axis=1).mean())) for e in (exact, left))
    assert rms < 5e-6
    assert of_pins > 50 * rms


def test_a_pin_changes_a_parameter_without_compiling(
    calibrated: Calibrated, component: Path
) -> None:
    nominal = calibrated.truth.nominal
    source = ExportSource(nominal, {}, {})
    component.write_text(write(source, None).text, "utf-8")
    subprocess.run(["halcompile", "--install", component], check=True, capture_output=True)
    table, own = nominal.parameters, calibrated.identified
    units = [own.get_unit(d).factor_to_si for d in table.dimensions]
    pins = [
        f"setp {NAME}.{name} {value / unit!r}"
        for name, value, unit in zip(table.names, own.values.tolist(), units, strict=True)
    ]
    homes = lc.inverse(own, own.home[None]).q[0] / MM
    joints = run_linuxcnc(NAME, "\n".join(pins), homes, calibrated.poses[:5])[0] * MM
    wanted = lc.inverse(own, calibrated.poses[:5] * UNITS).q
    assert np.abs(joints - wanted).max() < 1e-6 * MM


def test_compensation_files_of_the_joints_correct_the_screws(
    calibrated: Calibrated, component: Path
) -> None:
    """The controller has the joint centers, and the scales of the screws as tables."""
    truth, table = calibrated.identified, calibrated.identified.parameters
    is_gain = np.array([name.endswith(".gain") for name in table.names])
    controller = truth.with_values(np.where(is_gain, table.nominal, truth.values))
    tables, found = make_tables(truth, controller, TableSize("readings", 256, 256), 1e-6)
    assert found.data["is_met"]
    files = write_compensation(ExportSource(truth, tables=tables, stem="table")).beside
    component.write_text(write(ExportSource(controller, {}, {}), None).text, "utf-8")
    subprocess.run(["halcompile", "--install", component], check=True, capture_output=True)
    homes = lc.inverse(controller, controller.home[None]).q[0] / MM
    joints, motors = run_linuxcnc(NAME, "", homes, calibrated.poses, files)
    wanted = lc.inverse(truth, calibrated.poses * UNITS).q / MM
    assert np.abs(joints - wanted).max() > 0.02
    # homed in place, motors count from the home; six decimals of a table, at both of its nodes
    assert np.abs(motors + homes - wanted).max() < 2e-6
