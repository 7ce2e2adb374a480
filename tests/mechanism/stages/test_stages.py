# SPDX-License-Identifier: Apache-2.0
"""Chains of stages, and a leg with closed loops in knee and ankle: their kinematics agree with
closed forms and solvers that are written here.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.optimize import least_squares, root_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from loopcal import geometry
from loopcal.errors import DataError, FileError, MechanismError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.chains import locate_bodies
from loopcal.mechanism.kinematics import compute_limb_frames, forward_trials
from loopcal.mechanism.limb_rows import name_entries
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.modes import find_assembly_modes, find_working_modes
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.sensitivity import (
    differentiate_passive_joints,
    differentiate_pose,
    differentiate_sensed_values,
)
from loopcal.mechanism.singularities import analyze_singularity
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from loopcal.report.scene.scene import list_parts
from tests.denavit_hartenberg import multiply_denavit_hartenberg
from tests.jacobians import check_jacobian
from tests.mechanism.derivatives import check_pose_derivatives
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]

CHAINS = ("arm-6r", "excavator", "hexapod-turntable", "solar-tracker", "tricept")

HEAD = """format: 1
family: stages
name: chain
units: {length: mm, angle: deg}
"""


def load_text(folder: Path, text: str) -> Mechanism:
    """Return the robot of a file whose text follows the header."""
    path = folder / "chain.yaml"
    path.write_text(HEAD + text, "utf-8")
    return load_robot(path)


def draw_readings(machine: Mechanism, n: int, seed: int) -> Array:
    """Draw readings (n, a) evenly from the strokes."""
    low, high = np.array([a.stroke for a in machine.actuators]).T
    return np.random.default_rng(seed).uniform(low, high, (n, len(low)))


def draw_values(machine: Mechanism, seed: int) -> Array:
    """Draw values (p,) of all parameters by their spreads."""
    errors = np.random.default_rng(seed).standard_normal(len(machine.parameters))
    return machine.parameters.nominal + errors * machine.parameters.tolerance


# --- 6R arm: Denavit-Hartenberg


def test_arm_agrees_with_denavit_hartenberg_products() -> None:
    arm = load_cached_robot("arm-6r")
    q = draw_readings(arm, 1000, seed=1)
    # [1, m] rounding of some twenty products of numbers up to 1.4
    assert_allclose(forward(arm, q).T, multiply_denavit_hartenberg(q), rtol=0, atol=1e-12)


# --- excavator: triangles


def rotate_about_y(angle: float, x: float = 0.0, z: float = 0.0) -> Array:
    """Return a rotation about y behind a translation in the x-z plane."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, x], [0, 1.0, 0, 0], [-s, 0, c, z], [0, 0, 0, 1.0]])


def solve_triangle(foot: tuple[float, float], head: tuple[float, float], length: float) -> Array:
    """Return both angles about y of a link whose point `head` has this distance from `foot`.

    Points (x, z) are counted from the pin. Law of cosines; a rotation about y turns x towards -z,
    so that it is subtracted from the angle of the head.
    """
    a, b = np.hypot(*foot), np.hypot(*head)
    opening = np.arccos((a**2 + b**2 - length**2) / (2 * a * b))
    between = np.arctan2(head[1], head[0]) - np.arctan2(foot[1], foot[0])
    return between + np.array([opening, -opening])


LINKS = (
    # mount (x, z), foot, head [m], angle at home [deg]
    ((0.1, 1.8), (0.6, -0.4), (2.3, 0.35), -45.0),
    ((5.7, 0.0), (-2.7, 0.9), (-0.8, 0.2), 75.0),
    ((2.9, 0.0), (-2.2, 0.5), (-0.3, 0.45), 30.0),
)


def multiply_triangles(q: Array) -> Array:
    """Return the end poses (n, 4, 4) of an excavator at readings (n, 4), by the law of cosines."""
    poses = []
    for slew, *lengths in q:
        T = np.eye(4)
        T[:2, :2] = [[np.cos(slew), -np.sin(slew)], [np.sin(slew), np.cos(slew)]]
        for (mount, foot, head, home), length in zip(LINKS, lengths, strict=True):
            angles = solve_triangle(foot, head, length)
            turns = np.abs(np.angle(np.exp(1j * (angles - np.deg2rad(home)))))
            T = T @ rotate_about_y(float(angles[turns.argmin()]), *mount)
        poses.append(T)
    return np.array(poses)


def test_excavator_agrees_with_the_law_of_cosines() -> None:
    machine = load_cached_robot("excavator")
    q = sample_workspace(machine, 200, seed=1).solution.q
    back = forward(machine, q)
    assert back.converged.all()
    assert_allclose(back.T, multiply_triangles(q), rtol=0, atol=1e-9 * machine.size)


@pytest.mark.slow
def test_four_targets_in_four_coordinates_are_no_pose() -> None:
    machine = load_cached_robot("excavator")
    sample = sample_workspace(machine, 4, seed=1)
    alone = [inverse(machine, row[None]).q[0] for row in sample.coordinates]
    assert_array_equal(inverse(machine, sample.coordinates).q, alone)
    one = inverse(machine, sample.solution.T[2])
    assert_allclose(one.q[0], alone[2], rtol=0, atol=1e-9)  # [m, rad]


# --- Tricept: a constraint solver


def solve_tricept(q: Array) -> Array:
    """Return the end pose (4, 4) at readings (6,): tilts and length of the guide that fit the legs.

    [m, rad] of the guide, by least squares on the lengths of the legs.
    """
    turns = np.deg2rad([0.0, 120.0, 240.0])
    around = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)

    def place_platform(x: Array) -> Array:
        R = geometry.exp_so3(np.array([x[0], 0, 0])) @ geometry.exp_so3(np.array([0, x[1], 0]))
        return geometry.make_pose(R, R @ np.array([0, 0, x[2]]))

    def miss_lengths(x: Array) -> Array:
        T = place_platform(x)
        heads = 0.2 * around @ T[:3, :3].T + T[:3, 3]
        return np.linalg.norm(heads - 0.5 * around, axis=1) - q[:3]

    solved = least_squares(miss_lengths, [0.0, 0.0, 1.2], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    T = place_platform(solved.x)
    for angle, axis, shift in ((q[3], 2, 0.15), (q[4], 1, 0.0), (q[5], 2, 0.0)):
        step = geometry.make_pose(
            geometry.exp_so3(angle * np.eye(3)[axis]), np.array([0, 0, shift])
        )
        T = T @ step
    return T @ geometry.make_pose(np.eye(3), np.array([0, 0, 0.12]))


def test_tricept_agrees_with_a_constraint_solver() -> None:
    machine = load_cached_robot("tricept")
    q = sample_workspace(machine, 50, seed=1).solution.q
    back = forward(machine, q)
    assert back.converged.all()
    known = np.array([solve_tricept(row) for row in q])
    assert_allclose(back.T, known, rtol=0, atol=1e-9 * machine.size)


FEET, HEADS = np.radians([[0.0, 0, 120, 120, 240, 240], [-60.0, 60, 60, 180, 180, -60]])
SIDE = np.array([-1.0, 1.0] * 3)  # two legs share a corner, 40 mm apart


def measure_legs(q: Array, T: Array) -> Array:
    """Return by how much (n, 6) the legs of `hexapod-turntable` miss their lengths [m]."""

    def place(radius: float, angle: Array, side: Array) -> Array:
        out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * radius
        across = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=-1)
        return out + 0.02 * side[:, None] * across

    feet = place(0.25, FEET + q[:, :1], SIDE) + np.array([0, 0, 0.12])
    heads = place(0.15, HEADS, -SIDE) @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]
    return np.linalg.norm(heads - feet, axis=-1) - 0.353332129 - q[:, 1:]


def draw_coordinates(machine: Mechanism, n: int) -> Array:
    """Draw controlled coordinates (n, c) evenly from the workspace."""
    low, high = np.array([machine.assembly.workspace[name] for name in machine.controlled]).T
    return np.random.default_rng(4).uniform(low, high, (n, len(low)))


def test_hexapod_on_a_turntable_closes_its_legs_in_both_directions() -> None:
    robot = load_cached_robot("hexapod-turntable")
    target = draw_coordinates(robot, 100)
    solution = inverse(robot, target)
    assert solution.converged.all()
    shown = read_coordinates(solution.T, robot.controlled)
    assert np.abs(shown - target).max() < 1e-9  # [m, rad]
    assert np.abs(measure_legs(solution.q, solution.T)).max() < 1e-9  # [m]
    readings = draw_readings(robot, 100, 5) * ([1.0] + 6 * [0.3])
    there = forward(robot, readings)
    assert there.converged.all()
    assert np.abs(measure_legs(readings, there.T)).max() < 1e-9  # [m]


def test_more_drives_than_coordinates_take_shares_of_their_strokes() -> None:
    robot = load_cached_robot("hexapod-turntable")
    target = draw_coordinates(robot, 100)
    solution = inverse(robot, target)
    low, high = np.array([a.stroke for a in robot.actuators]).T
    assert ((low <= solution.q) & (solution.q <= high)).all()
    # of a small step, no change of the readings at constant pose makes the shares smaller
    step = inverse(robot, target + 1e-7, start=solution).q - solution.q
    kept = np.linalg.svd(
        differentiate_pose(robot, robot.values[None], solution.q[None], solution.state).readings[0]
    )[2][:, -1]
    shares = 1 / (high - low) ** 2
    across = np.abs((step * shares * kept).sum(axis=1))
    assert (across < 1e-4 * np.linalg.norm(step * shares, axis=1)).all()


def test_a_held_drive_keeps_the_reading_of_the_start(tmp_path: Path) -> None:
    text = (list_shipped_robots()["hexapod-turntable"]).read_text("utf-8") + "held: [turntable]\n"
    path = tmp_path / "held.yaml"
    path.write_text(text, "utf-8")
    robot = load_robot(path)
    at_home = draw_coordinates(robot, 20) * ([1.0] * 5 + [0.05])
    solution = inverse(robot, at_home)
    assert solution.converged.all()
    assert_array_equal(solution.q[:, 0], 0.0)
    turned = forward(robot, np.eye(7)[:1] * 0.5)
    solution = inverse(robot, at_home + np.array([0, 0, 0, 0, 0, 0.5]), start=turned)
    assert solution.converged.all()
    assert_allclose(solution.q[:, 0], 0.5, rtol=0, atol=1e-15)
    path.write_text(text.replace("[turntable]", "[turntabel]"), "utf-8")
    with pytest.raises((FileError, MechanismError), match="turntable"):
        load_robot(path)


def test_modes_of_a_machine_with_a_drive_more_than_coordinates_are_refused() -> None:
    with pytest.raises(DataError, match="held:"):
        find_working_modes(load_cached_robot("hexapod-turntable"), [0, 0, 0.42, 0, 0, 0])


def test_an_angle_beyond_the_dead_center_of_its_cylinder_is_another_mode() -> None:
    robot = load_cached_robot("excavator")
    there = forward(robot, [[0.0, 2.4, 2.7, 1.716]])  # 1.715 m is the shortest bucket cylinder
    assert there.converged.all()
    pin = compute_limb_frames(robot, robot.values[None], there.state)[3][0, 0, 0, :3, 3]
    turned = np.array([rotate_about_y(angle) for angle in (0.3, -0.3)])
    T = turned @ there.T
    T[:, :3, 3] = (turned[:, :3, :3] @ (there.T[0, :3, 3] - pin)) + pin
    solution = inverse(robot, read_coordinates(T, robot.controlled))
    assert {Status(s) for s in solution.status} == {Status.CONVERGED, Status.OTHER_MODE}
    back = forward(robot, solution.q)
    assert_array_equal(np.abs(back.T - T).max(axis=(1, 2)) < 1e-9, solution.converged)


# --- every chain, with errors of all parameters


@pytest.mark.slow
@pytest.mark.parametrize("name", CHAINS)
def test_each_trial_of_a_batch_equals_its_own_solution(name: str) -> None:
    machine = load_cached_robot(name)
    wanted = sample_workspace(machine, 5, seed=3).coordinates
    values = np.stack([draw_values(machine, seed) for seed in (3, 4)])
    q = inverse(machine, wanted).q
    together = forward_trials(machine, values, q[None])
    D = differentiate_pose(machine, values, q[None], together).parameters
    for trial, own in enumerate(values):
        alone = forward(machine.with_values(own), q)
        assert_array_equal(together.T[trial], alone.T)
        single = differentiate_pose(machine, own[None], q[None], alone.state).parameters
        assert_allclose(D[trial], single[0], rtol=0, atol=1e-12)


def test_passive_joints_of_a_stage_are_differentiated_by_its_own_parameters() -> None:
    machine = load_cached_robot("excavator")
    values, q = draw_values(machine, 5), sample_workspace(machine, 1, seed=5).solution.q
    state = forward_trials(machine, values[None], q[None])
    known = differentiate_passive_joints(machine, values[None], q[None], state)
    assert known.names == ("boom.serial.joint", "stick.serial.joint", "bucket.serial.joint")

    def read_pins(x: Array) -> Array:
        moved = forward_trials(machine, x, q[None], state)
        return np.stack([moved.joints[g][:, 0, 0, 0] for g in (1, 2, 3)], axis=-1)

    scale = np.where(machine.parameters.nominal != 0, 0.5, 0.05)
    check_jacobian(
        read_pins,
        known.parameters[0, 0],
        values,
        scale=scale,
        atol=1e-9,
        atol_reason="[rad] Newton's own accuracy over the smallest step",
        is_batched=True,
    )
    own = [name.startswith("stick.") for name in machine.parameters.names]
    assert (known.parameters[0, 0, 1] != 0).any()
    assert not (known.parameters[0, 0, 1] != 0)[~np.array(own)].any()


def test_frames_of_limbs_are_those_of_their_stages_in_the_base() -> None:
    machine = load_cached_robot("excavator")
    solution = sample_workspace(machine, 3, seed=6).solution
    frames = compute_limb_frames(machine, machine.values[None], solution.state)
    names = [limb.name for limb in machine.assembly.limbs]
    # the last pin is where the platform is
    pin = frames[names.index("bucket.serial")][0, :, 0, :3, 3]
    assert_allclose(pin, solution.T[:, :3, 3], atol=1e-12)
    tricept = load_cached_robot("tricept")
    solution = sample_workspace(tricept, 3, seed=6).solution
    frames = compute_limb_frames(tricept, tricept.values[None], solution.state)
    # a leg is as long as its reading, wherever its stage is
    for i in range(3):
        ends = frames[i][0, :, -2:, :3, 3]
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        assert_allclose(lengths, solution.q[:, i])


def test_names_of_parameters_limbs_and_joints_begin_with_their_stage() -> None:
    machine = load_cached_robot("tricept")
    assert {name.split(".")[0] for name in machine.parameters.names} == {"head", "w1", "w2", "w3"}
    assert "head.leg2.offset" in machine.parameters.names
    assert machine.assembly.limbs[0].name == "head.leg1"
    assert [a.name for a in machine.actuators] == ["leg1", "leg2", "leg3", "w1", "w2", "w3"]


def test_outlines_of_platforms_join_what_moves_together() -> None:
    machine = load_cached_robot("excavator")
    parts = list_parts(machine, machine.home_state)
    bodies = [part.points for part in parts if part.role == "platform"]
    assert len(bodies) == 4
    later = list_parts(machine, sample_workspace(machine, 1, seed=9).solution.state)
    moved = [part.points for part in later if part.role == "platform"]
    for before, after in zip(bodies, moved, strict=True):
        sides = [np.linalg.norm(np.diff(points[0], axis=0), axis=1) for points in (before, after)]
        assert_allclose(np.sort(sides[0]), np.sort(sides[1]), atol=1e-9)


# --- inverse kinematics


def test_inverse_kinematics_of_an_arm_keeps_the_elbow_of_its_start() -> None:
    arm = load_cached_robot("arm-6r")
    wanted = sample_workspace(arm, 20, seed=7).solution.T
    up = inverse(arm, wanted)
    folded = forward(arm, [[0.2, 1.3, -1.9, 0.3, 0.9, 0.1]])
    down = inverse(arm, wanted, start=folded)
    assert up.converged.all()
    assert down.converged.all()
    # the elbow is on one side of its stretched position in all of them, and on the other side here
    stretched = -np.arctan2(0.620, 0.125)
    assert (up.q[:, 2] + np.pi / 2 > stretched + np.pi / 2).all()
    assert (down.q[:, 2] < stretched).all()
    assert_allclose(down.T, up.T, rtol=0, atol=1e-9)


def test_poses_out_of_reach_are_marked_and_cost_no_exception() -> None:
    arm = load_cached_robot("arm-6r")
    far = np.repeat(arm.home[None], 3, axis=0)
    far[:, 0, 3] += [0.0, 2.0, np.nan]
    solution = inverse(arm, far)
    assert solution.status.tolist() == [Status.CONVERGED, Status.UNREACHABLE, Status.NOT_FINITE]
    assert solution.residual[1] > 0.5


@pytest.mark.evidence
def test_an_arm_with_a_spherical_wrist_has_eight_working_modes() -> None:
    """Shoulder, elbow and wrist have two each; Pieper 1968."""
    arm = load_cached_robot("arm-6r")
    wanted = sample_workspace(arm, 1, seed=8)
    modes = find_working_modes(arm, wanted.coordinates[0], patience=1)
    assert len(modes) == 8
    back = forward(arm, modes.solution.q)
    assert_allclose(back.T, np.tile(wanted.solution.T, (8, 1, 1)), atol=1e-9)


def test_triangles_of_an_excavator_stay_on_the_side_of_their_start() -> None:
    machine = load_cached_robot("excavator")
    solution = sample_workspace(machine, 1, seed=8).solution
    modes = find_assembly_modes(machine, solution.q[0], patience=1)
    assert_allclose(modes.solution.T, solution.T, rtol=0, atol=1e-9)


def test_margins_of_a_chain_vanish_where_its_arm_is_stretched() -> None:
    arm = load_cached_robot("arm-6r")
    elbow = -np.arctan2(0.620, 0.125)
    bends = np.deg2rad([60.0, 6.0, 0.6])
    path = forward(arm, [[0.2, 0.6, elbow + bend, 0.3, 0.9, 0.1] for bend in bends])
    near = analyze_singularity(arm, path)
    ratio = near.drive_margin[1:] / near.drive_margin[:-1]
    assert_allclose(ratio, 0.1, rtol=0.15)  # in proportion to a small bend
    assert near.is_near.tolist() == [False, True, True]
    assert near.margin.tolist() == [1.0, 1.0, 1.0]


# --- files

ARM = """controlled: [x, y]
stages:
  - name: shoulder
    joint: {kind: R, start: 20, errors: [offset]}
  - name: elbow
    mount: {x: 300}
    joint: {kind: R, start: 60, tip: [200, 0, 0], errors: [x, offset]}
"""


def test_a_chain_of_two_joints_is_read_from_its_file(tmp_path: Path) -> None:
    arm = load_text(tmp_path, ARM)
    q = np.array([[0.3, 0.9]])
    x = 0.3 * np.cos(0.3) + 0.2 * np.cos(1.2)
    y = 0.3 * np.sin(0.3) + 0.2 * np.sin(1.2)
    assert_allclose(forward(arm, q).T[0, :2, 3], [x, y], atol=1e-15)
    assert arm.parameters.names == ("shoulder.offset", "elbow.x", "elbow.offset")
    assert_allclose(inverse(arm, [[x, y]]).q, q, atol=1e-12)


def test_a_stage_on_a_named_one_branches_off_it(tmp_path: Path) -> None:
    text = ARM.replace("controlled: [x, y]", "controlled: [x]") + (
        "  - {name: finger, on: shoulder, mount: {x: 100}, joint: {kind: R, start: 70, "
        "tip: [50, 0, 0]}}\n"
    )
    text = text.replace("controlled: [x]", "controlled: [x, y]")
    machine = load_text(tmp_path, text)
    q = np.array([[0.3, 0.9, 0.5]])
    x = 0.1 * np.cos(0.3) + 0.05 * np.cos(0.8)
    assert_allclose(forward(machine, q).T[0, 0, 3], x, atol=1e-15)
    # the elbow does not carry the end platform: it moves nothing, and keeps its reading
    D = differentiate_pose(machine, machine.values[None], q[None], forward(machine, q).state)
    assert not D.readings[..., 1].any()
    there = inverse(machine, forward(machine, q).T[:, :2, 3])
    assert there.q[0, 1] == pytest.approx(np.deg2rad(60))
    assert_allclose(there.q[0, [0, 2]], q[0, [0, 2]], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "line", "sentence"),
    [
        ("mount:", "on: shoulde\n    mount:", 9, "not a stage .*. Allowed: base, shoulder$"),
        (
            "    joint: {kind: R, start: 20",
            "    on: elbow\n    joint: {kind: R, start: 20",
            7,
            "'shoulder' is on 'elbow', which is not an earlier stage",
        ),
        (
            "name: elbow",
            "name: elbow\n    on: elbow",
            9,
            "on 'elbow', which is not an earlier stage",
        ),
        ("start: 60", "start: 60, drive: shoulder", 9, "drives the stages 'shoulder' and 'elbow'"),
        ("name: elbow", "name: shoulder", 9, "two stages have the name 'shoulder'"),
        ("name: elbow", "name: base", 9, "cannot have the name 'base'"),
        ("kind: R, start: 60", "kind: X, start: 60", 11, "joint.kind' is 'X'"),
        ("mount: {x: 300}", "mounted: {x: 300}", 10, "unknown key 'mounted'"),
        ("mount: {x: 300}", "family: limbs", 9, "states both 'joint' and 'family'"),
        ("mount: {x: 300}", "mount: {u: 300}", 10, "unknown key 'u'"),
    ],
)
def test_impossible_stages_are_refused_at_their_line(tmp_path, old, new, line, sentence):
    assert old in ARM
    with pytest.raises(FileError, match=sentence) as error:
        load_text(tmp_path, ARM.replace(old, new, 1))
    assert error.value.line == line
    assert "\n" not in str(error.value)


PIN = """  - name: link
    family: limbs
    controlled: [yaw]
    limbs:
      - {name: pin, ending: rigid, chain: [{joint: R, name: pin}], errors: [{of: pin, shift: [x]}]}
"""
IMPOSSIBLE_CHAINS = {
    "listed before its carrier": (
        ARM.replace("name: shoulder", "name: shoulder\n    on: elbow").replace(
            "name: elbow", "name: elbow\n    on: base"
        ),
        "list 'elbow' first",
    ),
    "no actuators": (ARM + PIN, ":12: .*stage 'link' has no actuators"),
    "no stages": ("controlled: [x]\n", "the list of stages is empty"),
    "more actuators than coordinates": (
        ARM + "  - {name: wrist, joint: {kind: R, tip: [50, 0, 0]}}\n",
        r"3 actuators .* 2 controlled coordinates",
    ),
    "stretched home": (
        ARM.replace("start: 60", "start: 0"),
        "at home its actuators set only 1 of the coordinates",
    ),
    "no family of a stage": (
        ARM + "  - name: loop\n    family: five-bar\n",
        "'five-bar' is not a family of a stage",
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE_CHAINS)
def test_impossible_chains_are_refused(case: str, tmp_path: Path) -> None:
    text, sentence = IMPOSSIBLE_CHAINS[case]
    with pytest.raises((FileError, MechanismError), match=sentence):
        load_text(tmp_path, text)


LEG = """format: 1
family: stages
name: leg
units: {length: mm, angle: deg}
controlled: [x, y, z, roll, pitch, yaw]
stages:
  - name: hip-yaw
    joint: {kind: R, axis: z, errors: [offset]}
  - name: hip-roll
    joint: {kind: R, axis: x, errors: [offset]}
  - name: hip-pitch
    joint: {kind: R, axis: y, start: -30, errors: [offset, rz]}
  - name: knee
    mount: {z: -300}
    family: limbs
    controlled: [pitch]
    home: {pitch: 60}
    limbs:
      - {name: pin, ending: rigid, chain: [{joint: R, axis: y, start: 60}], attach: [0, 0, 0]}
      - name: rod
        ending: distance
        chain: [{joint: R, at: [50, 0, 100], axis: y, actuated: knee-motor, start: 60}]
        tip: [60, 0, 0]
        attach: [60, 0, -30]
        length: 138
        errors: [{of: platform, shift: [x, z]}]
  - name: ankle
    mount: {z: -300}
    family: limbs
    controlled: [roll, pitch]
    home: {pitch: -30}
    limbs:
      - name: cross
        ending: rigid
        chain: [{joint: U, axes: [x, y], start: [0, -30]}]
        attach: [0, 0, 0]
      - &rod
        name: left
        ending: distance
        chain: [{joint: R, at: [0, 40, 150], axis: y, actuated: left}]
        tip: [-50, 0, 0]
        attach: [-50, 40, 0]
        length: 150
        errors: [{of: platform, shift: [x]}]
      - <<: *rod
        name: right
        chain: [{joint: R, at: [0, -40, 150], axis: y, actuated: right}]
        attach: [-50, -40, 0]
tolerances: {lengths: {sd: 0.1}, angles: {sd: 0.05}}
workspace:
  {x: [-50, 50], y: [-50, 50], z: [-560, -480], roll: [-5, 5], pitch: [-5, 5], yaw: [-5, 5]}
"""


@pytest.fixture
def leg(tmp_path: Path) -> Mechanism:
    path = tmp_path / "leg.yaml"
    path.write_text(LEG, "utf-8")
    return load_robot(path)


def bend_knee(motor: float) -> float:
    """Return the angle about y at which the rod between crank and shank has its length."""
    crank = np.array([0.05, 0, 0.1]) + turn("y", motor) @ [0.06, 0, 0]

    def gap(angle: float) -> float:
        head = turn("y", angle) @ [0.06, 0, -0.03]
        return float(np.linalg.norm(head - crank)) - 0.138

    return root_scalar(gap, bracket=np.radians([20, 110]), xtol=1e-15).root


def bend_ankle(motors: Array) -> Array:
    """Return the rotation about x, then y, at which both rods have their length."""
    sides = np.array([0.04, -0.04])

    def gaps(angles: Array) -> list[float]:
        foot = turn("x", angles[0]) @ turn("y", angles[1])
        return [
            float(np.linalg.norm(foot @ [-0.05, side, 0] - crank)) - 0.15
            for side, motor in zip(sides, motors, strict=True)
            for crank in [np.array([0, side, 0.15]) + turn("y", motor) @ [-0.05, 0, 0]]
        ]

    found = least_squares(gaps, [0.0, np.radians(-30)], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.cost < 1e-28
    return turn("x", found.x[0]) @ turn("y", found.x[1])


def turn(axis: str, angle: float) -> Array:
    """Return the rotation (3, 3) about an axis."""
    return Rotation.from_euler(axis, angle).as_matrix()


def walk(q: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3) and position (3,) of the foot at readings (6,)."""
    hip = turn("z", q[0]) @ turn("x", q[1]) @ turn("y", q[2])
    knee = hip @ turn("y", bend_knee(q[3]))
    return knee @ bend_ankle(q[4:]), hip @ [0, 0, -0.3] + knee @ [0, 0, -0.3]


def test_a_leg_with_closed_knee_and_ankle_agrees_with_its_equations(leg: Mechanism) -> None:
    solution = sample_workspace(leg, 12, seed=3).solution
    for q, T in zip(solution.q, forward(leg, solution.q).T, strict=True):
        rotation, position = walk(q)
        # [1, m] 1e-9 of a size of 0.6 m
        assert_allclose(T[:3, :3], rotation, rtol=0, atol=6e-10)
        assert_allclose(T[:3, 3], position, rtol=0, atol=6e-10)
    again = inverse(leg, solution.T)
    assert again.converged.all()
    assert_allclose(again.q, solution.q, rtol=0, atol=1e-9)


def test_a_leg_with_closed_knee_and_ankle_is_calibrated(leg: Mechanism) -> None:
    instrument = Instrument((Sensor(Pose(), Gaussian(np.array([1e-5] * 3 + [5e-5] * 3))),))
    true = leg.with_values(sample_truth(leg, 1, 2)[0])
    data = simulate(true, sample_workspace(leg, 30, seed=1).coordinates, instrument, 4)
    fit = identify(leg, data)
    error = (fit.robot.values - true.values) / fit.standard_deviations
    assert np.abs(error).max() < 4.0
    low, high = chi2.ppf([0.005, 0.995], fit.residual_test.dof)
    assert low < fit.chi_square < high


# --- more drives than freedoms and than coordinates

POINTS = {
    "l1": ([250, -20, 0], [92, -120, 0]),
    "l2": ([250, 20, 0], [92, 120, 0]),
    "l3": ([-108, 226, 0], [58, 140, 0]),
    "l4": ([-142, 206, 0], [-150, 20, 0]),
    "l5": ([-142, -206, 0], [-150, -20, 0]),
    "l6": ([-108, -226, 0], [58, -140, 0]),
    "l7": ([0, 0, 0], [40, 30, 20]),
}
LEGS = "\n".join(
    f"      - {{name: {name}, tip: {tip}, attach: {attach}, ending: distance, actuated: {name},\n"
    "         errors: [{of: base, shift: [x, y], tolerance: {sd: 0.1}}]}"
    for name, (tip, attach) in POINTS.items()
)
TURNED = f"""controlled: [x, y, z, roll, pitch, yaw]
stages:
  - name: turntable
    joint: {{kind: R, stroke: [-180, 180], errors: [x, y, rx, ry]}}
  - name: column
    joint: {{kind: P, axis: z, stroke: [-50, 50], errors: [offset]}}
  - name: hexapod
    mount: {{z: 120}}
    family: limbs
    controlled: [x, y, z, roll, pitch, yaw]
    home: {{z: 300}}
    drives: {{l: {{reads: length, stroke: [250, 450], sigma: 0.01}}}}
    limbs:
{LEGS}
tolerances: {{lengths: {{sd: 0.1}}, angles: {{sd: 0.02}}}}
workspace: {{x: [-50, 50], y: [-50, 50], z: [380, 460], roll: [-9, 9], pitch: [-9, 9], yaw: [-99, 99]}}
"""  # noqa: E501
WARM = TURNED.replace("stroke: [-50, 50], errors: [offset]", "drive: none") + (
    """conditions: {temperature: {reference: 20, range: [15, 35]}}
couplings:
  grow: {of: length, sum: {column.serial.joint: 1}, condition: temperature, slope: 0.003}
"""
)
SPARE = {"chain": TURNED, "coupled": WARM}
POSES = Instrument((Sensor(Pose("rotation-vector"), Gaussian(np.repeat(2e-5, 6))),))


@pytest.mark.parametrize("name", SPARE)
def test_a_redundant_leg_and_a_turntable_are_spare_drives(name: str, tmp_path: Path) -> None:
    robot = load_text(tmp_path, SPARE[name])
    reached = sample_workspace(robot, 100, seed=3).solution
    q, T = reached.q, reached.T
    assert np.ptp(q[:, 0]) > 1.0  # the turntable takes a part of the yaw
    legs = q[:, 2:9] if name == "chain" else q[:, 1:8]
    height = q[:, 1] if name == "chain" else 3e-6 * (q[:, 8] - 20)
    base = Rotation.from_euler("z", q[:, [0]]).as_matrix()
    for length, (tip, attach) in zip(legs.T, POINTS.values(), strict=True):
        foot = base @ (np.array(tip) / 1e3) + np.outer(height + 0.12, [0, 0, 1])
        head = T[:, :3, :3] @ (np.array(attach) / 1e3) + T[:, :3, 3]
        assert_allclose(np.linalg.norm(head - foot, axis=1), length, rtol=0, atol=1e-9)
    assert_allclose(forward(robot, q).T, T, rtol=0, atol=1e-9)
    other = robot.with_values(sample_truth(robot, 1, seed=1)[0])
    measured = simulate(other, T[:5], POSES, 1, reading_sigma=1e-9).readings
    assert np.abs(measured - q[:5]).max() > 1e-6
    assert forward(other, measured).residual.max() < 1e-8
    check_pose_derivatives(robot, q[None, :2])
    body, state = "column", forward(robot, q[:2]).state
    given = robot, robot.values[None], q[None, :2], state, name_entries(body)
    sensed = differentiate_sensed_values(*given)
    for i, step in enumerate(1e-6 * np.eye(q.shape[1])):
        ends = (locate_bodies(robot, forward(robot, q[:2] + s * step).state) for s in (1, -1))
        ahead, behind = (of[body][0, :, :3].reshape(2, 12) for of in ends)
        assert_allclose(sensed.readings[0, ..., i], (ahead - behind) / 2e-6, rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", SPARE)
def test_chains_with_spare_and_redundant_drives_are_as_accurate_as_stated(name, tmp_path):
    robot = load_text(tmp_path, SPARE[name])
    poses, z = sample_workspace(robot, 30, seed=1).coordinates, []
    options = FitOptions(method=MAP(), sigma_uncertainty=0.0)
    for i, truth in enumerate(sample_truth(robot, 20, seed=2)):
        data = simulate(robot.with_values(truth), poses, POSES, i)
        fit = identify(robot, data, options=options)
        z.append(np.linalg.solve(np.linalg.cholesky(fit.covariance), fit.estimate - truth))
    assert 0.9 < np.sqrt(np.mean(np.square(z))) < 1.1  # 20 machines of 18 parameters: 1 +- 0.04
