# SPDX-License-Identifier: Apache-2.0
"""What many rows and targets cost: reading a file against csv, and the growth of whole tasks with
four times as many of them.
"""

import csv
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.harness import Metric, measure_ratio, time_once
from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.compensation import compensate
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.data.measurement_file import load_measurements, save_measurements
from loopcal.io.robot.robot_file import load_robot
from loopcal.io.runs.result_files import format_compensation
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism

UM = 1e-6
ROWS, FEW, MANY = 100_000, 10_000, 40_000
LIMIT = 5.0
"""Largest growth for four times as much: 4 in proportion, and a quarter for a busy machine. What
compares each row with all others grows sixteenfold.
"""


def _targets(robot: Mechanism, n: int) -> np.ndarray:
    """Random controlled coordinates in the workspace."""
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    return np.random.default_rng(0).uniform(ranges[:, 0], ranges[:, 1], (n, len(ranges)))


def _measured(robot: Mechanism, n: int) -> Measurements:
    """A machine drawn from the tolerances, whose position is measured in n poses."""
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    sensor = Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 10 * UM)))
    return simulate(truth, _targets(robot, n), Instrument((sensor,)), 0)


def draw_sessions(robot: Mechanism, n: int, sessions: int, targets: int) -> Measurements:
    """Draw a machine whose targets a tracker measures to 10 um in n poses; frame and targets are
    unknown in every session.
    """
    truth, rng = robot.with_values(sample_truth(robot, 1, 0)[0]), np.random.default_rng(1)
    names = tuple(f"t{i}" for i in range(targets))
    places = robot.tool[:3, 3] + rng.uniform(-0.05, 0.05, (targets, 3))
    station = make_pose(exp_so3(np.array([0.1, -0.2, 0.7])), np.array([-1.2, 0.4, 0.3]))
    unknown = ("frame", "targets")
    kind = Position(targets=names, places=places, T_base_frame=station, unknown=unknown)
    session = np.array([f"s{i * sessions // n}" for i in range(n)])
    sensor = Sensor(kind, Gaussian(np.full(3 * targets, 10 * UM)), session=session)
    return simulate(truth, _targets(robot, n), Instrument((sensor,)), 0)


def _growth(
    name: str,
    few: Callable[[], object],
    many: Callable[[], object],
    counts: tuple[int, int] = (FEW, MANY),
    clock: Callable[[], float] | None = None,
) -> Metric:
    """The ratio of the shorter of two times each."""
    less, more = (min(time_once(work, clock) for _ in range(2)) for work in (few, many))
    note = f"{less:.3g} s and {more:.3g} s for {counts[0]} and {counts[1]}"
    return Metric(name, more / less, tolerance=None, limit=LIMIT, note=note)


def bench_reading() -> Metric:
    """Read 1e5 rows with three readings and three coordinates, each number rounded once and every
    row checked, against Python's csv module, which only splits the same text.
    """
    robot = load_robot("linear-delta")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "data.csv"
        save_measurements(_measured(robot, ROWS), file, robot)
        lines = file.read_text(encoding="utf-8").splitlines()[-ROWS:]
        return measure_ratio(
            "growth.reading_of_csv",
            lambda: load_measurements(file, robot),
            lambda: [float(x) for row in csv.reader(lines) for x in row[1:]],
            repeats=5,
            tolerance=0.5,
        )


def bench_calibration() -> Metric:
    """Calibrate with 40,000 rows against 10,000: conventions, fit, all examinations, held-out
    poses.
    """
    robot = load_robot("linear-delta")
    options = CalibrationOptions(hold_out=0.25)
    data = [_measured(robot, n) for n in (FEW, MANY)]
    few, many = (partial(calibrate, robot, d, options) for d in data)
    return _growth("growth.calibration_of_rows", few, many)


def bench_compensation() -> Metric:
    """Compensate 40,000 targets against 10,000, and write the file."""
    robot = load_robot("linear-delta")
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    targets = [_targets(robot, n) for n in (FEW, MANY)]
    few, many = (partial(_write_compensation, truth, x) for x in targets)
    return _growth("growth.compensation_of_targets", few, many)


def _write_compensation(robot: Mechanism, targets: np.ndarray) -> str:
    """Return the file of compensated targets (n, c)."""
    return format_compensation(compensate(robot, targets))


def bench_sessions() -> Metric:
    """Calibrate with 100 sessions against 25, and the error budget: four poses of each, frame and
    targets unknown.
    """
    robot, counts = load_robot("hexapod-42"), (25, 100)
    data = [draw_sessions(robot, 4 * n, n, 3) for n in counts]
    few, many = (lambda d=d: calibrate(robot, d).budget for d in data)
    name = "growth.calibration_of_sessions"
    return _growth(name, few, many, counts, time.process_time)


def bench_targets() -> Metric:
    """Calibrate with 48 unknown targets in an unknown frame against 12, 60 poses."""
    robot, counts = load_robot("hexapod-42"), (12, 48)
    data = [draw_sessions(robot, 60, 1, n) for n in counts]
    few, many = (lambda d=d: calibrate(robot, d) for d in data)
    name = "growth.calibration_of_targets"
    return _growth(name, few, many, counts, time.process_time)
