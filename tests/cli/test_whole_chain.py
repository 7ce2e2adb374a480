# SPDX-License-Identifier: Apache-2.0
"""All commands from a plan to compensation, on shipped robots with bodies, couplings and stages."""

import csv
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.io.core.csv_table import read_table
from loopcal.mechanism.platform_coordinates import compare_coordinates, get_dimension

ROBOTS = (
    "par4",
    "parallelogram-delta",
    "telescopic-delta",
    "six-bar",
    "klann-leg",
    "jansen-leg",
    "gripper",
    "biped-leg",
    "hexapod-turntable",
    "cable-4",
    "orthoglide",
    "6-rus",
    "warm-delta",
)


def measure_errors(robot: lc.Mechanism, q: np.ndarray, targets: np.ndarray) -> float:
    """Return how far readings lead a robot from targets [m], angles times its size (rms)."""
    T = lc.forward(robot, q).T
    gap, _ = compare_coordinates(T, targets, robot.controlled, robot.size)
    return float(np.sqrt(np.mean(gap**2)))


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_plan_is_measured_calibrated_validated_and_compensated(loopcal, robot) -> None:
    loopcal(f"plan {robot} --poses 12 --hold-out 5 --candidates 30 -o plan")
    filled = "--fill plan/measurements.csv --draw-errors --seed 1 --truth truth.yaml"
    loopcal(f"simulate {robot} {filled} -o data.csv", "data.csv: 17 poses")
    loopcal(f"identifiability {robot} data.csv", "parameter combinations")
    loopcal(f"calibrate {robot} data.csv -o run", "Recommendation: Apply the identified values.")
    loopcal("simulate truth.yaml --draw 8 --seed 2 -o new.csv")
    loopcal("validate run new.csv", "times smaller after calibration")

    nominal, truth = lc.load_robot(robot), lc.load_robot("truth.yaml")
    names, commanded = nominal.controlled, np.array(nominal.actuators)[nominal.is_commanded]
    with Path("plan/plan.csv").open() as file:
        header, *rows = csv.reader(line for line in file if not line.startswith("#"))
    places = [i for i, column in enumerate(header) if column.split()[0] in names]
    numbers = np.array([[float(row[i]) for i in places] for row in rows])
    inner = numbers.mean(axis=0) + 0.5 * (numbers - numbers.mean(axis=0))  # away from all limits
    columns = ",".join(header[i] for i in places)
    np.savetxt("targets.csv", inner, delimiter=",", header=columns, comments="")
    loopcal("compensate run targets.csv -o readings.csv")
    wanted = read_table(Path("targets.csv"))
    targets = np.column_stack([wanted.numbers(name, get_dimension(name)) for name in names])
    written = read_table(Path("readings.csv"))
    q = np.column_stack([written.numbers(a.name, a.dimension) for a in commanded])
    before = measure_errors(truth, lc.inverse(nominal, targets).q, targets)
    assert measure_errors(truth, q, targets) < 0.3 * before
