# SPDX-License-Identifier: Apache-2.0
"""Contract of every shipped robot. A new file in src/loopcal/robots is included automatically."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.platform_coordinates import compare_coordinates, read_coordinates
from loopcal.mechanism.solutions import forward, inverse
from tests.mechanism.derivatives import check_pose_derivatives
from tests.mechanism.families.ranks import random_coordinates
from tests.zoo import load_cached_robot

ROBOTS = tuple(list_shipped_robots())


@pytest.mark.parametrize("name", ROBOTS)
def test_shipped_robot_closes_at_the_home_pose_of_its_file(name: str) -> None:
    machine = load_cached_robot(name)
    assert machine.home_state.residual.max() <= 1e-12 * machine.size
    home = machine.assembly.home
    read = [read_coordinates(T, machine.controlled) for T in (machine.home, home)]
    tilt = geometry.log_so3(machine.home[:3, :3] @ home[:3, :3].T)
    if "phi" in machine.controlled and abs(tilt).max() < 1e-12:  # phi is anything at zero tilt
        read = [np.delete(r, machine.controlled.index("phi")) for r in read]
    assert_allclose(read[0], read[1], atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_shipped_robot_file_states_source_workspace_strokes_and_tolerances(name: str) -> None:
    machine = load_cached_robot(name)
    assert machine.name == name
    assert machine.assembly.source
    assert set(machine.assembly.workspace) <= set(machine.controlled)
    assert len(machine.assembly.workspace) == len(machine.controlled)
    assert all(a.stroke or a.name.startswith("load.") for a in machine.actuators)
    assert np.isfinite(machine.parameters.tolerance).all()


@pytest.mark.parametrize("errors", [0.0, 1.0], ids=["nominal", "with errors"])
@pytest.mark.parametrize("name", ROBOTS)
def test_forward_kinematics_inverts_inverse_kinematics_in_the_workspace(name, errors):
    nominal = load_cached_robot(name)
    drawn = np.random.default_rng(2).standard_normal(len(nominal.parameters))
    machine = nominal.with_values(nominal.values + errors * drawn * nominal.parameters.tolerance)
    wanted = random_coordinates(machine, 1000 if not errors else 100, seed=11)
    solution = inverse(machine, wanted)
    back = forward(machine, solution.q)
    good = solution.converged & back.converged
    assert good.mean() >= 0.999
    # [m, rad] Newton stops below 1e-13 of the size; the rest is the condition of the mechanism
    assert_allclose(back.T[good], solution.T[good], atol=1e-9)
    residual = compare_coordinates(back.T[good], wanted[good], machine.controlled, machine.size)[0]
    assert_allclose(residual, 0.0, atol=1e-9 * machine.size)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_sensitivities_are_the_derivatives_of_forward_kinematics(name: str) -> None:
    machine = load_cached_robot(name)
    solution = inverse(machine, random_coordinates(machine, 3, seed=13))
    assert solution.converged.all()
    check_pose_derivatives(machine, compute_readings(machine, machine.values[None], solution.state))


def test_documentation_lists_every_robot_with_its_parameter_count() -> None:
    """| name | family | .. | parameters |; the table has no others."""
    page = (Path(__file__).parents[3] / "docs" / "robots.md").read_text("utf-8")
    table = page[page.index("| name | family |") :].split("\n\n")[0]
    rows = [
        [cell.strip().strip("`") for cell in line.split("|")[1:-1]]
        for line in table.splitlines()[2:]
    ]
    assert sorted(row[0] for row in rows) == sorted(ROBOTS)
    for name, _, _, _, parameters in rows:
        assert int(parameters) == len(load_cached_robot(name).parameters), name
