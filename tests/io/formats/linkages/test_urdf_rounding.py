# SPDX-License-Identifier: Apache-2.0
"""Loops of a URDF whose numbers are rounded are closed; larger gaps are refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopcal.errors import LoopcalError
from loopcal.io.formats.import_export import build_imported_robot, export_robot
from loopcal.io.formats.linkages import linkage_format, urdf
from loopcal.io.formats.program_format import ExportSource, Imported, ImportOptions
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from tests.io.formats.linkages.urdf_chains import make_leg, make_tilted_table
from tests.io.formats.linkages.urdf_machines import MachineJoint, make_pose, write_machine

MACHINES = {"leg": make_leg, "table": make_tilted_table}
GAP = r"closure '.*', between '.*' and '.*', stays .* [mun]+m and .* [mu]?rad apart"


def turn_frames(joints: list[MachineJoint]) -> list[MachineJoint]:
    """Return a machine with other frames, so that axes of a loop have other digits."""
    return [
        replace(
            joint,
            T=joint.T
            @ make_pose(Rotation.from_euler("zx", [0.3 * i, np.pi]).as_matrix(), np.zeros(3)),
        )
        if i % 2 and joint.kind == "R" and not joint.is_motor
        else joint
        for i, joint in enumerate(joints)
    ]


def write(folder: Path, machine: str, digits: int | None) -> Path:
    text, closures = write_machine(turn_frames(MACHINES[machine]()))
    path = folder / f"robot{digits or ''}.urdf"
    if digits is not None:
        text = re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda m: f"{float(m[0]):.{digits}f}", text)
    path.write_text(text)
    path.with_suffix(".yaml").write_text(closures)
    return path


def read(path: Path) -> tuple[Imported, Mechanism]:
    imported = linkage_format.read(urdf.read_tree(path), ImportOptions("machine"), "a URDF")
    return imported, build_imported_robot(path, imported)


@pytest.mark.parametrize(("machine", "digits"), [("leg", 6), ("table", 6), ("table", 4)])
def test_rounded_loops_are_closed_and_the_gap_is_stated(tmp_path, machine, digits) -> None:
    exact = read(write(tmp_path, machine, None))[1]
    path = write(tmp_path, machine, digits)
    imported, robot = read(path)
    (finding,) = [f for f in imported.findings if f.code == "files.loops-rounded"]
    unit = 10.0**-digits
    assert 0.0 < finding.data["angle"].value < 10 * unit  # [rad]: of at most eight axes
    assert 0.0 < finding.data["turn"].value < 10 * unit  # [rad]
    assert robot.parameters.names == exact.parameters.names
    q = inverse(exact, exact.home[None]).q + np.random.default_rng(2).uniform(
        -0.05, 0.05, (2, len(exact.actuators))
    )
    found = forward(robot, q)
    assert found.converged.all()
    # [m, 1]: half a unit turns a lever of the ankle, 0.05 m, by ten units of angle
    np.testing.assert_allclose(found.T, forward(exact, q).T, rtol=0, atol=50 * unit)
    np.testing.assert_allclose(inverse(robot, found.T).q, q, rtol=0, atol=1e-9)
    exported = export_robot(ExportSource(robot), urdf.FORMAT, path)
    assert exported.text == path.read_text()


def test_axes_of_a_spherical_loop_that_almost_meet_are_made_to_meet(tmp_path) -> None:
    rng = np.random.default_rng(4)
    axes = [Rotation.from_euler("xy", angles).as_matrix() for angles in rng.uniform(0, 2, (4, 2))]
    places = [make_pose(R, 0.1 * (i + 1) * R[:, 2]) for i, R in enumerate(axes)]
    pairs = [("base_link", "a"), ("a", "platform"), ("base_link", "b")]
    text = '<robot name="s">' + "".join(f'<link name="{n}"/>' for n in ("base_link", "a", "b"))
    text += '<link name="platform"/><transmission name="t"><joint name="j1"/></transmission>'
    text += '<link name="tip"/><joint name="tip_frame" type="fixed"><parent link="platform"/>'
    text += '<child link="tip"/><origin xyz="0.01 0.02 0.03"/></joint>'
    drawn = {"base_link": np.eye(4)}

    def format_origin(T: np.ndarray, tag: str = "origin") -> str:
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_euler("xyz")]
        xyz, rpy = (" ".join(f"{v:.6f}" for v in part) for part in (numbers[:3], numbers[3:]))
        return f'<{tag} xyz="{xyz}" rpy="{rpy}"/>'

    for i, ((parent, child), T) in enumerate(zip(pairs, places, strict=False), 1):
        text += (
            f'<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        )
        text += f'{format_origin(np.linalg.inv(drawn[parent]) @ T)}<axis xyz="0 0 1"/></joint>'
        drawn[child] = T
    ends = {
        n: np.linalg.inv(drawn[link]) @ places[3]
        for n, link in (("parent", "b"), ("child", "platform"))
    }
    text += '<constraint name="pin" type="revolute"><parent link="b"/><child link="platform"/>'
    text += "".join(format_origin(T, f"{n}_origin") for n, T in ends.items())
    path = tmp_path / "spherical.urdf"
    path.write_text(text + '<parent_axis xyz="0 0 1"/></constraint></robot>')
    imported, robot = read(path)
    assert imported.findings[0].data["mobility"] == 1
    assert "files.loops-rounded" in {finding.code for finding in imported.findings}
    solution = forward(robot, np.linspace(-0.05, 0.2, 5)[:, None])
    assert solution.converged.all()
    np.testing.assert_allclose(
        inverse(robot, solution.T).q[:, 0], np.linspace(-0.05, 0.2, 5), atol=1e-9
    )


def test_file_with_exact_numbers_is_not_repaired(tmp_path) -> None:
    imported = read(write(tmp_path, "table", None))[0]
    assert "files.loops-rounded" not in {finding.code for finding in imported.findings}


@pytest.mark.parametrize(("digits", "error"), [(6, 1e-4), (None, 1e-6)])
def test_gap_that_digits_do_not_explain_is_refused_with_its_size(tmp_path, digits, error) -> None:
    path = write(tmp_path, "table", digits)
    text = path.read_text()
    start = text.index("rpy=", text.index('name="elbow1"')) + len('rpy="')
    number = text[start : text.index(" ", start)]
    decimals = 6 if digits else 17
    moved = f"{float(number) + error:.{decimals}f}"
    path.write_text(text[:start] + moved + text[start + len(number) :])
    with pytest.raises(LoopcalError, match=GAP):
        read(path)


def test_rounded_loops_of_a_file_with_too_many_motors_are_not_called_open(tmp_path) -> None:
    path = write(tmp_path, "table", 6)
    closures = path.with_suffix(".yaml")
    closures.write_text(closures.read_text().replace("name_mot: [", "name_mot: ['elbow0', "))
    found = linkage_format.read(urdf.read_tree(path), ImportOptions("machine"), "a URDF")
    assert "files.loops-rounded" in {finding.code for finding in found.findings}
    assert "the mobility is 3, but there are 4 motors" in " ".join(map(str, found.findings))
