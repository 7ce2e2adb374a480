# SPDX-License-Identifier: Apache-2.0
"""Results do not depend on what a user may choose freely: the base frame, the frame of the
instrument, the units of the file, and the order of poses, limbs and actuators. Every shipped robot.

A new file in src/loopcal/robots is included automatically.
"""

import json
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.calibration_report import CalibrationReport
from loopcal.errors import MechanismError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.io.core.records import get_field_types
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families import FAMILIES
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests.zoo import FEW_ROBOTS, ROBOTS, load_cached_robot, move_base

Array = NDArray[np.float64]
SINGLE = [robot for robot in ROBOTS if not load_cached_robot(str(robot.values[0])).stages]
"""Robots that are no chains: the order of the stages of a chain is their order in space, and the
stages are read by their own families.
"""
POSES = 20
CORNERS = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02], [-0.05, -0.08, 0.1]])


@cache
def draw_readings(name: str) -> Array:
    return sample_workspace(load_cached_robot(name), POSES, seed=4).solution.q


def make_motion(robot: Mechanism, seed: int = 1) -> Array:
    """Return a rigid motion (4, 4) that keeps the plane of a planar robot, and the axis of one that
    turns about a single one.
    """
    w, v = 0.2 * np.random.default_rng(seed).standard_normal((2, 3))
    turns = np.array([f"r{axis}" in robot.freedoms for axis in "xyz"])
    if turns.sum() == 1:
        w[~turns] = 0.0
    for normal, axis in enumerate("xyz"):
        across = {"rx", "ry", "rz", axis} - {"r" + axis}
        if not across & set(robot.freedoms):
            w[np.arange(3) != normal], v[normal] = 0.0, 0.0
    return geometry.make_pose(geometry.exp_so3(w), v)


@pytest.mark.parametrize("name", ROBOTS)
def test_poses_move_with_the_base(name: str) -> None:
    robot, q = load_cached_robot(name), draw_readings(name)
    G = make_motion(robot)
    moved = build(move_base(robot.assembly, G))
    here, there = forward(robot, q), forward(moved, q)
    assert there.converged.all()
    assert_allclose(there.T, G @ here.T, rtol=0, atol=1e-10)
    if len(robot.controlled) == 6:
        back = inverse(moved, G @ here.T)
        if len(robot.actuators) == 6:
            assert_allclose(back.q, q, rtol=0, atol=1e-10)
        assert_allclose(forward(moved, back.q).T, there.T, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", SINGLE)
def test_order_of_limbs_and_actuators_does_not_matter(name: str) -> None:
    robot, q = load_cached_robot(name), draw_readings(name)
    rng = np.random.default_rng(2)
    limbs = rng.permutation(len(robot.assembly.limbs))
    order = rng.permutation(len(robot.actuators))
    changed = replace(
        robot.assembly,
        limbs=tuple(robot.assembly.limbs[i] for i in limbs),
        actuators=tuple(robot.actuators[i] for i in order),
    )
    other = build(changed)
    assert_allclose(forward(other, q[:, order]).T, forward(robot, q).T, rtol=0, atol=1e-11)
    back = inverse(other, forward(robot, q).T)
    assert back.converged.all()
    assert_allclose(back.q, q[:, order], rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", [*SINGLE, "arm-6r"])
def test_units_of_the_file_do_not_matter(name: str, tmp_path: Path) -> None:
    from ruamel.yaml import YAML

    robot, q = load_cached_robot(name), draw_readings(name)
    record = robot.record.record  # type: ignore[union-attr]
    head = {"format": 1, "units": {"length": "m", "angle": "rad"}, "family": record.family}
    path = tmp_path / "robot.yaml"
    with path.open("w") as stream:
        YAML().dump(head | _to_content(record), stream)
    other = load_robot(path)
    assert other.parameters.names == robot.parameters.names
    assert_allclose(other.values, robot.values, rtol=1e-15, atol=0)
    assert_allclose(other.parameters.tolerance, robot.parameters.tolerance, rtol=1e-15, atol=0)
    assert_allclose(forward(other, q).T, forward(robot, q).T, rtol=0, atol=1e-12)
    assert_allclose(inverse(other, forward(robot, q).T).q, q, rtol=0, atol=1e-10)


def _to_content(value: Any) -> Any:
    """Return a record as the content of a file in SI units."""
    if is_dataclass(value):
        keys = get_field_types(FAMILIES.get(getattr(value, "family", ""), type(value)))
        stated = {f.name.removesuffix("_"): getattr(value, f.name) for f in fields(value)}
        return {key: _to_content(stated[key]) for key in keys if stated[key] is not None}
    if isinstance(value, dict):
        return {key: _to_content(item) for key, item in value.items()}
    return [_to_content(item) for item in value] if isinstance(value, tuple) else value


@cache
def measure_robot(name: str) -> Measurements:
    """Return positions of three targets on a robot with the errors of its spreads."""
    robot = load_cached_robot(name)
    true = robot.with_values(sample_truth(robot, 1, 5)[0])
    kind = Position(targets=("a", "b", "c"), places=CORNERS, unknown=("frame",), frame="tracker")
    instrument = Instrument((Sensor(kind, Gaussian(np.full(9, 2e-5))),))
    return simulate(true, draw_poses(name), instrument, 6)


@cache
def draw_poses(name: str) -> Array:
    return sample_workspace(load_cached_robot(name), POSES, seed=4).coordinates


@cache
def identify_values(name: str) -> Array:
    return identify(load_cached_robot(name), measure_robot(name), options=OPTIONS).robot.values


OPTIONS = FitOptions()
SHARE = 1e-5
"""Of a standard deviation: how far two descents may end from each other."""


def check_estimate(name: str, data: Measurements, order: Array | None = None) -> None:
    """Assert that data lead to the values of `measure_robot`, within a share of their sd."""
    robot = load_cached_robot(name)
    result = identify(robot, data, options=OPTIONS)
    sd = np.zeros(len(robot.values))
    sd[result.free_parameters.places] = result.standard_deviations
    gap = np.abs(result.robot.values - identify_values(name))
    assert (gap <= SHARE * sd + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW_ROBOTS)
def test_fit_does_not_depend_on_the_frame_of_the_instrument(name: str) -> None:
    data = measure_robot(name)
    (rows,) = data.observations
    G = geometry.invert_pose(make_motion(load_cached_robot(name), seed=7))
    points = rows.measured.reshape(-1, 3) @ G[:3, :3].T + G[:3, 3]
    moved = replace(rows, measured=points.reshape(rows.measured.shape))
    check_estimate(name, replace(data, observations=(moved,)))


@pytest.mark.parametrize("name", FEW_ROBOTS)
def test_fit_does_not_depend_on_the_order_of_poses(name: str) -> None:
    data = measure_robot(name)
    check_estimate(name, data.take(np.random.default_rng(8).permutation(POSES)))


# A whole calibration, with its validation and its verdict.


def rotate(axis: int, angle: float) -> Array:
    return geometry.make_pose(geometry.exp_so3(angle * np.eye(3)[axis]), np.array([1.0, -2.0, 0.5]))


BASES = {
    "upside down": rotate(0, np.pi),
    "on a wall, where roll and yaw are one angle": rotate(1, np.pi / 2),
    "turned to the other side": rotate(2, np.pi - 1e-9),
}


@cache
def calibrate_robot(name: str) -> CalibrationReport:
    return calibrate(load_cached_robot(name), measure_robot(name), SPLIT)


SPLIT = CalibrationOptions(hold_out=0.25)


def check_report(name: str, robot: Mechanism, data: Measurements) -> CalibrationReport:
    """Assert that a calibration gives the numbers and the statements of `measure_robot`."""
    report, usual = calibrate(robot, data, SPLIT), calibrate_robot(name)
    fit, expected = report.identification, usual.identification
    assert_allclose(fit.standard_deviations, expected.standard_deviations, rtol=1e-4)
    gap = np.abs(fit.estimate - expected.estimate) / expected.standard_deviations
    assert gap.max() <= SHARE
    assert report.verdict == usual.verdict
    assert report.validation is not None
    assert usual.validation is not None
    for quantity, change in usual.validation.changes().items():
        there = report.validation.changes()[quantity]
        assert_allclose((there.before, there.after), (change.before, change.after), rtol=1e-4)
    assert [f.code for f in report.findings] == [f.code for f in usual.findings]
    return report


@pytest.mark.parametrize("base", BASES.values(), ids=BASES)
@pytest.mark.parametrize("name", ["hexapod-42", "ru-pus-prs"])
def test_calibration_does_not_depend_on_how_the_machine_stands(name: str, base: Array) -> None:
    """The frame of the tracker is unknown, so the data are the same. Tilt and torsion stay regular
    where roll and yaw do not.
    """
    moved = move_base(load_cached_robot(name).assembly, base)
    if "roll" in moved.controlled and abs(base[2, 0]) > 0.5:
        moved = replace(moved, controlled=("x", "y", "z", "phi", "theta", "psi"))
    check_report(name, build(moved), measure_robot(name))


@pytest.mark.parametrize("leg", ["Bein", "\u811a", "q.", "frame"])
def test_calibration_does_not_depend_on_the_names_of_limbs(leg: str, tmp_path: Path) -> None:
    text = list_shipped_robots()["3-rps"].read_text("utf-8")
    file = tmp_path / "robot.yaml"
    file.write_text(text.replace("name: leg", f"name: {json.dumps(leg)}"), "utf-8")
    report = check_report("3-rps", load_robot(file), measure_robot("3-rps"))
    assert report.identification.names[0].startswith(leg)


def test_coordinates_that_are_singular_at_home_are_refused_by_name() -> None:
    """Roll and yaw on a wall, and torsion upside down."""
    assembly = load_cached_robot("hexapod-42").assembly
    tilted = replace(assembly, controlled=("x", "y", "z", "phi", "theta", "psi"))
    for robot, base in ((assembly, list(BASES.values())[1]), (tilted, rotate(0, np.pi))):
        with pytest.raises(MechanismError, match=r"cannot set the coordinates .* independently"):
            build(move_base(robot, base))
