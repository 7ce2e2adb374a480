# SPDX-License-Identifier: Apache-2.0
"""URDF whose loops follow one another is read as a chain of stages, in agreement with a solver."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from loopcal.errors import LoopcalError
from loopcal.estimate.identification import identify
from loopcal.io.formats.import_export import build_imported_robot, export_robot
from loopcal.io.formats.linkages import linkage_format, urdf
from loopcal.io.formats.program_format import ExportSource, Imported, ImportOptions
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward, inverse
from tests.io.formats.linkages.urdf_chains import (
    make_digger,
    make_head_with_wrist,
    make_leg,
    make_lever_arm,
    make_tilted_table,
)
from tests.io.formats.linkages.urdf_machines import (
    MachineJoint,
    UrdfSolver,
    write_element,
    write_machine,
)

AGREES = 1e-9  # [m, 1]: of machines of about 1 m
MACHINES = {
    "leg": make_leg,
    "head": make_head_with_wrist,
    "arm": make_lever_arm,
    "digger": make_digger,
    "rocker": lambda: make_digger(has_rocker=True),
    "tilted table": make_tilted_table,
}
STAGES = {
    "leg": (("yaw", "roll", "pitch", "shin", "platform"), ("shin", "platform")),
    "head": (("column", "head", "w1", "w2"), ("head",)),
    "digger": (("slew", "boom", "stick", "platform"), ("boom", "stick", "platform")),
    "arm": (("slew", "forearm", "roll", "bend", "flange"), ("forearm",)),
}


def write(folder: Path, joints: list[MachineJoint], seed: int | None = None) -> Path:
    text, closures = write_machine(joints, seed)
    path = folder / "robot.urdf"
    path.write_text(text)
    path.with_suffix(".yaml").write_text(closures)
    return path


def read(path: Path, platform: str | None = None) -> tuple[Imported, Mechanism]:
    imported = linkage_format.read(
        urdf.read_tree(path), ImportOptions("machine", platform=platform), "a URDF"
    )
    return imported, build_imported_robot(path, imported)


def solve(path: Path, robot: Mechanism, q: np.ndarray, link: str = "tool") -> np.ndarray:
    """Return poses (n, 4, 4) of a link, by the solver that knows nothing of loopcal."""
    solver = UrdfSolver(path, path.with_name("robot.yaml"))
    names = [actuator.name for actuator in robot.actuators]
    order = [names.index(name) for name in solver.motors]
    return np.array([solver.forward(one[order], link) for one in q])


def draw_readings(robot: Mechanism, count: int) -> np.ndarray:
    """Return readings near home [rad or m]."""
    home = inverse(robot, robot.home[None]).q
    return home + np.random.default_rng(2).uniform(-0.05, 0.05, (count, home.shape[1]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("machine", "seed"),
    [
        ("leg", 3),
        ("head", 3),
        ("rocker", 3),
        pytest.param("digger", 3, marks=pytest.mark.evidence),
        pytest.param("leg", None, marks=pytest.mark.evidence),
        pytest.param("arm", None, marks=pytest.mark.evidence),
        pytest.param("tilted table", 3, marks=pytest.mark.evidence),
    ],
)
def test_chains_agree_with_the_solver(tmp_path, machine, seed) -> None:
    """So does the corrected file, after every parameter has been changed."""
    path = write(tmp_path, MACHINES[machine](), seed)
    robot = read(path)[1]
    q = draw_readings(robot, 2)
    found = forward(robot, q)
    np.testing.assert_allclose(found.T, solve(path, robot, q), rtol=0, atol=AGREES)
    back = inverse(robot, found.T)
    assert back.converged.all()
    np.testing.assert_allclose(back.q, q, rtol=0, atol=AGREES)
    changes = 1e-3 * np.random.default_rng(3).uniform(-1, 1, len(robot.values))
    changed = robot.with_values(robot.values + changes)
    exported = export_robot(ExportSource(changed), urdf.FORMAT, path)
    assert "files.not-expressed" not in {finding.code for finding in exported.findings}
    corrected = tmp_path / "corrected.urdf"
    corrected.write_text(exported.text)
    moved = forward(changed, q).T
    np.testing.assert_allclose(moved, solve(corrected, robot, q), rtol=0, atol=AGREES)
    assert np.abs(moved - found.T).max() > 1e-4  # [m, 1]: the changes matter


def test_shifts_at_constraints_in_a_limb_with_the_name_of_its_motor_agree(tmp_path) -> None:
    text, closures = write_machine(make_leg(), 0, has_constraints=True)
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    path.with_suffix(".yaml").write_text(closures)
    robot = read(path)[1]
    values = [1e-3 if "top_in_child" in name else 0.0 for name in robot.parameters.names]
    assert sum(values) == pytest.approx(3e-3)
    changed, q = robot.with_values(robot.values + values), draw_readings(robot, 1)
    corrected = tmp_path / "corrected.urdf"
    corrected.write_text(export_robot(ExportSource(changed), urdf.FORMAT, path).text)
    moved = forward(changed, q).T
    np.testing.assert_allclose(moved, solve(corrected, robot, q), rtol=0, atol=AGREES)


@pytest.mark.parametrize("machine", STAGES)
def test_stages_have_the_names_of_joints_and_links(tmp_path, machine) -> None:
    imported, robot = read(write(tmp_path, MACHINES[machine]()))
    (finding,) = [f for f in imported.findings if f.code == "files.urdf-stages"]
    assert (finding.data["stages"], finding.data["closed"]) == STAGES[machine]
    assert tuple(stage.name for stage in robot.stages) == STAGES[machine][0]


def test_stages_have_names_of_their_own_without_points(tmp_path) -> None:
    """The link that carries the wrist has the name of a joint, and the slew one with a point."""
    path = write(tmp_path, make_lever_arm())
    for file in (path, path.with_suffix(".yaml")):
        text = re.sub(r"\bforearm\b", "roll", file.read_text())
        file.write_text(re.sub(r"\bslew\b", "arm.slew:1", text))
    robot = read(path)[1]
    names = ("arm_slew_1", "roll", "roll_2", "bend", "flange")
    assert tuple(stage.name for stage in robot.stages) == names
    assert robot.actuators[0].name == "arm.slew:1"
    changed = robot.with_values(robot.values + 1e-4)
    exported = export_robot(ExportSource(changed), urdf.FORMAT, path)
    assert "files.not-expressed" not in {finding.code for finding in exported.findings}


def test_joint_without_motor_outside_of_loops_is_refused(tmp_path) -> None:
    joints = [
        MachineJoint(j.name, j.kind, j.a, j.b, j.T, j.is_motor and j.name != "bend")
        for j in make_lever_arm()
    ]
    with pytest.raises(LoopcalError, match=r"urdf:\d+: joint bend between the base and the pl"):
        read(write(tmp_path, joints))


def test_urdf_of_another_chain_is_refused(tmp_path) -> None:
    path = write(tmp_path, make_lever_arm())
    robot = read(path)[1]
    path.write_text(path.read_text().replace('xyz="0.0 0.0 0.2"', 'xyz="0.0 0.0 0.3"', 1))
    with pytest.raises(LoopcalError, match="Export into the file of origin"):
        export_robot(ExportSource(robot), urdf.FORMAT, path)


def make_humanoid() -> list[MachineJoint]:
    return [*make_leg("left_", 0.1), *make_leg("right_", -0.1, "right_foot")]


def test_leg_of_a_humanoid_is_the_leg_alone(tmp_path) -> None:
    path = write(tmp_path, make_humanoid())
    imported, robot = read(path, "tool")
    leg = read(write(tmp_path, make_leg("left_", 0.1)))[1]
    assert robot.parameters.names == leg.parameters.names
    q = draw_readings(leg, 2)
    np.testing.assert_allclose(forward(robot, q).T, forward(leg, q).T, rtol=0, atol=1e-14)  # [m, 1]
    (left_out,) = [f for f in imported.findings if f.code == "files.motors-left-out"]
    assert {name[:6] for name in left_out.data["motors"]} == {"right_"}
    other = read(write(tmp_path, make_humanoid()), "right_foot")[1]
    assert {actuator.name[:6] for actuator in other.actuators} == {"right_"}


def test_tips_of_a_humanoid_are_listed(tmp_path) -> None:
    path = write(tmp_path, make_humanoid())
    with pytest.raises(LoopcalError, match="move nothing between the base and the platform 'plat"):
        read(path)  # the only frame is on the left foot
    sole = write_element("sole_frame", "fixed", "right_foot", "sole", np.eye(4))
    two = path.read_text().replace("</robot>", f'<link name="sole"/>{sole}</robot>')
    path.write_text(two)
    with pytest.raises(LoopcalError, match=r"Name its link, one of tool and sole$"):
        read(path)
    with pytest.raises(LoopcalError, match=r"'head' is not a moving link .* one of tool and sole$"):
        read(path, "head")
    bare = two[: two.index('<joint name="tool_frame"')].replace('<link name="tool"/>', "")
    path.write_text(f"{bare}</robot>")
    with pytest.raises(LoopcalError, match=r"Name its link, one of platform and right_foot$"):
        read(path)


def test_rod_of_a_leg_is_its_platform_on_request(tmp_path) -> None:
    path = write(tmp_path, make_leg(), 3)
    robot = read(path, "rod_in")[1]
    q = draw_readings(robot, 2)
    found = forward(robot, q).T
    np.testing.assert_allclose(found, solve(path, robot, q, "rod_in"), rtol=0, atol=AGREES)


def test_wrist_that_is_drawn_in_a_singular_pose_has_another_home(tmp_path) -> None:
    path = write(tmp_path, make_lever_arm(bend=0.0))
    robot = read(path)[1]
    q = draw_readings(robot, 2)
    found = forward(robot, q).T
    np.testing.assert_allclose(found, solve(path, robot, q), rtol=0, atol=AGREES)
    np.testing.assert_allclose(inverse(robot, found).q, q, rtol=0, atol=AGREES)


@pytest.mark.parametrize("machine", ["leg", "arm"])
def test_chains_are_calibrated(tmp_path, machine) -> None:
    robot = read(write(tmp_path, MACHINES[machine]()))[1]
    rng = np.random.default_rng(5)
    true = robot.with_values(robot.values + 1e-3 * rng.uniform(-1, 1, len(robot.values)))
    home = inverse(robot, robot.home[None]).q
    q = home + rng.uniform(-0.2, 0.2, (60, len(robot.actuators)))
    measured, held_out = q[:40], q[40:]
    instrument = Instrument((Sensor(Pose(), Gaussian(np.array([1e-5] * 3 + [5e-5] * 3))),))
    poses = read_coordinates(forward(robot, measured).T, robot.controlled)
    fit = identify(robot, simulate(true, poses, instrument, 4))
    low, high = chi2.ppf([0.005, 0.995], fit.residual_test.dof)
    assert low < fit.chi_square < high
    expected = forward(true, held_out).T
    assert np.abs(forward(robot, held_out).T - expected).max() > 1e-3  # [m, 1]: before
    # [m, 1] ten times the noise of positions, twice that of angles
    np.testing.assert_allclose(forward(fit.robot, held_out).T, expected, rtol=0, atol=1e-4)
