# SPDX-License-Identifier: Apache-2.0
"""Every family takes the same drives and parameters of one's own, by the same keys."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.io.robot.robot_file import list_shipped_robots

# Robot of a family, the drive that it states, its stroke and a period of it in the file's units.
MACHINES = {
    "hexapod-42": ("q", "[-75, 75]", 37),
    "hexapod-42 with legs: ups": ("q2", "[-75, 75]", 37),
    "3-prs": ("q", "[0, 450]", 90),
    "ru-pus-prs": ("q", "[-150, 350]", 90),
    "linear-delta": ("q", "[0, 400]", 90),
    "6-pus": ("a", "[-200, 500]", 90),
    "arm-6r": ("j2", "[-90, 150]", 77),
    "tricept": ("leg2", "[850, 1650]", 90),
}
LENGTH, ANGLE = 1e-4, 1e-3


def write_robot(folder: Path, name: str, drives: str) -> Path:
    """Write a shipped robot with drives of its own, in place of those that it states."""
    robot, _, change = name.partition(" with ")
    text = list_shipped_robots()[robot].read_text()
    kept, skips = list[str](), False
    for line in text.splitlines():
        skips = line.startswith("drives:") or (skips and line.startswith(" "))
        kept += [] if skips else ["legs: ups" if change and line == "legs: rod" else line]
    path = folder / "robot.yaml"
    path.write_text("\n".join([*kept, drives]) + "\n")
    return path


@pytest.mark.parametrize("has_table", [False, True])
@pytest.mark.parametrize("case", MACHINES)
def test_the_errors_of_drives_are_recovered_in_every_family(
    tmp_path: Path, case: str, has_table: bool
) -> None:
    drive, stroke, period = MACHINES[case]
    unit = "angle" if case == "arm-6r" else "length"
    terms = ("gain", "backlash", "sin1", "cos1", "curve")
    law = f"period: {period}, unknown: [{', '.join(terms)}], ratio: {{sd: 0.01}}"
    if has_table:
        low, high = (float(end) for end in stroke.strip("[]").split(","))
        points = [(low + share * (high - low), share) for share in (0.1, 0.45, 0.6, 0.95)]
        rows = ", ".join(f"[{reading}, {value}]" for reading, value in points)
        law = f"table: [{rows}], interpolation: cubic, unknown: [table]"
        terms = ("table1", "table2", "table3", "table4")
    text = f"reads: {unit}, stroke: {stroke}, {law}, {unit}: {{sd: 0.1}}"
    path = write_robot(tmp_path, case, f"drives:\n  {drive}: {{{text}}}")
    robot = lc.load_robot(path)
    names = [n for n in robot.parameters.names if n.rpartition(".")[2] in terms]
    count = sum(a.name.startswith(drive) for a in robot.actuators)
    assert len(names) == count * len(terms)
    rng = np.random.default_rng(2)
    places = [robot.parameters.index(name) for name in names]
    size = ANGLE if unit == "angle" else LENGTH
    truth = robot.values.copy()
    truth[places] += size * rng.standard_normal(len(places))
    pose = lc.sample_workspace(robot, 25, seed=1)
    q = lc.inverse(robot, pose.coordinates).q
    q = np.concatenate([q, rng.choice([-1.0, 1.0], q.shape)], axis=1)  # directions of approach
    T = lc.forward(robot.with_values(truth), q).T
    values = robot.values.copy()
    for _ in range(6):
        current = robot.with_values(values)
        reached = lc.forward(current, q).T
        change, own = np.linalg.inv(reached) @ T, reached[:, :3, :3]
        turn = np.einsum("nij,njk->nik", own, change[:, :3, :3] - np.eye(3))
        skew = np.einsum("nij,nkj->nik", turn, own)
        residual = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        residual = np.concatenate([residual, T[:, :3, 3] - reached[:, :3, 3]], 1)
        jacobian = lc.jacobian(current, q)
        columns = [jacobian.of(name).ravel() for name in names]
        step = np.linalg.lstsq(np.stack(columns, axis=1), residual.ravel(), rcond=1e-12)[0]
        values[places] += step
    # Newton's method squares what is left of the errors in each step
    assert_allclose(values[places], truth[places], rtol=0, atol=1e-6 * size)


def test_a_screw_with_a_motor_angle_drives_the_leg_of_a_hexapod(tmp_path: Path) -> None:
    """l = length + offset + lead q / (2 pi); the family's stroke of lengths is none of angles."""
    drives = "drives: {q: {reads: angle, lead: 5, offset: 2, unknown: [lead], leads: {sd: 0.01}}}"
    robot = lc.load_robot(write_robot(tmp_path, "hexapod-42", drives))
    plain = lc.load_robot("hexapod-42")
    coordinates = lc.sample_workspace(plain, 5, seed=1).coordinates
    turned, length = lc.inverse(robot, coordinates).q, lc.inverse(plain, coordinates).q
    assert_allclose(2e-3 + 5e-3 * turned / (2 * np.pi), length, atol=1e-14)  # [m] rounding
    assert robot.actuators[0].stroke is None
    lead = robot.parameters.entries[robot.parameters.index("q1.lead")]
    assert lead.nominal == 5e-3
    assert lead.positive


def test_readings_that_count_down_count_down_with_a_stated_drive(tmp_path: Path) -> None:
    """The family's direction and zero stay: a drop of gain 1.01 lowers the carriage by 1.01."""
    robot = lc.load_robot(
        write_robot(tmp_path, "linear-delta", "drives: {q: {reads: length, gain: 1.01}}")
    )
    plain, q = lc.load_robot("linear-delta"), np.array([[0.2, 0.21, 0.22]])
    assert_allclose(lc.forward(robot, q).T, lc.forward(plain, 1.01 * q).T, atol=1e-12)
    assert robot.actuators[0].stroke == plain.actuators[0].stroke


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("hexapod-42", "{limb: leg, element: platform, axis: z}"),
        ("3-prs", "{limb: chain, element: guide, axis: x}"),
        ("ru-pus-prs", "{limb: chain1, element: guide, axis: x}"),
        ("linear-delta", "{limb: arm, element: carriage, axis: x}"),
    ],
)
def test_every_family_has_parameters_of_ones_own(tmp_path: Path, name: str, entry: str) -> None:
    text = f"parameters: [{{name: own, length: 0, maps: [{entry}], tolerance: {{sd: 0.1}}}}]"
    robot, plain = lc.load_robot(write_robot(tmp_path, name, text)), lc.load_robot(name)
    assert robot.parameters.names == (*plain.parameters.names, "own")
    q = lc.inverse(robot, lc.sample_workspace(robot, 3, seed=1).coordinates).q
    assert np.abs(lc.jacobian(robot, q).of("own")).max() > 1e-2


REFUSED = {
    "hexapod-42": ("drives: {p: {reads: length}}", "actuator 'p' drives no joint"),
    "linear-delta": (
        "drives: {q2: {reads: length, unknown: [gian]}}",
        "actuator 'q2' has no term 'gian' (did you mean 'gain'?)",
    ),
    "3-prs": ("drives: {q: {reads: length, bakclash: 1}}", "unknown key 'bakclash'"),
    "ru-pus-prs": ("drives: {q1: {reads: angle}}", "actuator 'q1' drives a joint that slides"),
    "arm-6r": (
        "drives: {j2: {reads: angle, unknown: [sin1], angle: {sd: 0.1}}}",
        "actuator 'j2' has sin1, but no period",
    ),
    "hexapod-nategh-agheli": (
        "drives: {q: {reads: length, table: [[0, 0], [1, -2], [5, 0]]}}",
        "turns its joint back",
    ),
    "hexapod-octahedral": (
        "drives: {q: {reads: length}}\nactuators: {q: {reads: length}}",
        "unknown key 'actuators'",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_wrong_drive_is_refused_with_its_line(tmp_path: Path, name: str) -> None:
    drives, sentence = REFUSED[name]
    with pytest.raises(lc.FileError) as refusal:
        lc.load_robot(write_robot(tmp_path, name, drives))
    assert sentence in str(refusal.value)
    assert refusal.value.line is not None
