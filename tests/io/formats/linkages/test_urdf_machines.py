# SPDX-License-Identifier: Apache-2.0
"""URDF of many machines agrees with a solver of its closures that knows nothing of loopcal.

Trees grow in random orders, so that legs are cut at any joint, and joints run in both directions.
"""

from pathlib import Path

import numpy as np
import pytest

from loopcal.io.formats.import_export import build_imported_robot, export_robot
from loopcal.io.formats.linkages import linkage_format, urdf
from loopcal.io.formats.program_format import ExportSource, Imported, ImportOptions
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse, jacobian
from tests.io.formats.linkages.urdf_machines import UrdfSolver, make_hexapod, write_machine

AGREES = 1e-9  # [m, 1]: of machines of about 1 m
MACHINES = {
    "UPS": ["UPS"] * 6,
    "SPS": ["SPS"] * 6,
    "PUS": ["PUS"] * 6,
    "RUS": ["RUS"] * 6,
    "PSS": ["PSS"] * 6,
    "RSS": ["RSS"] * 6,
    "mixed": ["UPS", "SPS", "PUS", "RUS", "SPU", "PSS"],
}
IDLE = {"UPS": 0, "SPS": 6, "PUS": 0, "RUS": 0, "PSS": 6, "RSS": 6, "mixed": 2}
"""Legs that spin about their own axis: those between two ball joints."""


def write(folder: Path, machine: str, seed: int | None) -> Path:
    text, closures = write_machine(make_hexapod(MACHINES[machine]), seed)
    (folder / "robot.urdf").write_text(text)
    (folder / "robot.yaml").write_text(closures)
    return folder / "robot.urdf"


def read(path: Path) -> tuple[Imported, Mechanism]:
    imported = linkage_format.read(urdf.read_tree(path), ImportOptions("machine"), "a URDF")
    return imported, build_imported_robot(path, imported)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(None, marks=pytest.mark.evidence), 1])
@pytest.mark.parametrize("machine", MACHINES)
def test_hexapods_of_any_legs_agree_with_the_solver(tmp_path, machine, seed) -> None:
    path = write(tmp_path, machine, seed)
    imported, robot = read(path)
    solver = UrdfSolver(path, path.with_suffix(".yaml"))
    assert [actuator.name for actuator in robot.actuators] == solver.motors
    q = np.random.default_rng(2).uniform(-0.05, 0.05, (3, 6))  # [m or rad]
    found = forward(robot, q)
    assert found.converged.all()
    expected = [solver.forward(one, "tool") for one in q]
    np.testing.assert_allclose(found.T, expected, rtol=0, atol=AGREES)
    back = inverse(robot, found.T)
    assert back.converged.all()
    np.testing.assert_allclose(back.q, q, rtol=0, atol=AGREES)
    np.testing.assert_allclose(back.T, found.T, rtol=0, atol=AGREES)
    idle = [f for f in imported.findings if f.code == "files.idle-motions"]
    assert sum(f.data["count"] for f in idle) == IDLE[machine]
    assert "files.motors-differ" not in {f.code for f in imported.findings}


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [None, 0, *(pytest.param(n, marks=pytest.mark.evidence) for n in (1, 2))]
)
@pytest.mark.parametrize("machine", ["mixed"])
def test_every_parameter_is_the_shift_of_an_origin_in_the_urdf(tmp_path, machine, seed) -> None:
    """The corrected file, closed by the solver, is the machine with the other parameters."""
    path = write(tmp_path, machine, seed)
    robot = read(path)[1]
    changes = 1e-3 * np.random.default_rng(3).uniform(-1, 1, len(robot.values))
    changed = robot.with_values(robot.values + changes)
    exported = export_robot(ExportSource(changed), urdf.FORMAT, path)
    assert "files.not-expressed" not in {finding.code for finding in exported.findings}
    (tmp_path / "corrected.urdf").write_text(exported.text)
    solver = UrdfSolver(tmp_path / "corrected.urdf", path.with_suffix(".yaml"))
    q = np.random.default_rng(4).uniform(-0.03, 0.03, (2, 6))  # [m or rad]
    found = forward(changed, q).T
    expected = [solver.forward(one, "tool") for one in q]
    np.testing.assert_allclose(found, expected, rtol=0, atol=AGREES)
    assert np.abs(forward(robot, q).T - found).max() > 1e-4  # [m, 1]: the changes matter


@pytest.mark.parametrize("machine", ["SPS", "mixed"])
def test_sensitivities_agree_with_finite_differences(tmp_path, machine) -> None:
    """Central differences of the solver's own poses by motors and of ours by parameters."""
    path = write(tmp_path, machine, 2)
    robot = read(path)[1]
    solver = UrdfSolver(path, path.with_suffix(".yaml"))
    q = np.random.default_rng(5).uniform(-0.03, 0.03, (1, 6))
    derivative = jacobian(robot, q)
    start = solver.solve(q[0])
    by_motor, by_parameter = derivative.readings[0], derivative.parameters[0]
    for i in range(6):
        step = 1e-5 * np.eye(6)[i]
        ends = [solver.forward(q[0] + s * step, "tool", start) for s in (1, -1)]
        np.testing.assert_allclose(by_motor[:, i], twist(ends[0], ends[1], 2e-5), rtol=0, atol=1e-7)
    for i in range(0, len(robot.values), 7):
        step = 1e-5 * np.eye(len(robot.values))[i]
        ends = [forward(robot.with_values(robot.values + s * step), q).T[0] for s in (1, -1)]
        slope = twist(ends[0], ends[1], 2e-5)
        np.testing.assert_allclose(by_parameter[:, i], slope, rtol=0, atol=1e-7)


def twist(T: np.ndarray, other: np.ndarray, step: float) -> np.ndarray:
    """Return (turn, shift) per unit between two poses, in base axes."""
    W = (T[:3, :3] - other[:3, :3]) / step @ ((T[:3, :3] + other[:3, :3]) / 2).T
    return np.array([W[2, 1], W[0, 2], W[1, 0], *((T - other)[:3, 3] / step)])
