# SPDX-License-Identifier: Apache-2.0
"""Robots with bodies that carry three joints inside a loop, against closure equations written here.

The equations know circles, spheres and rotations, and nothing of loopcal: from the readings they
construct every joint, or state what must vanish at a pose.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.modes import find_assembly_modes
from loopcal.mechanism.sensitivity import differentiate_passive_joints
from loopcal.mechanism.solutions import Solution, forward, inverse, jacobian
from tests.mechanism.families.ranks import random_coordinates
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]
POSES = 100
ATOL = 1e-9  # [m, rad]: Newton stops below 1e-13 of the size; the rest is the condition


def meet(P: Array, r: float, Q: Array, s: float, side: int) -> Array:
    """Return the points (n, 2) at distances r from P and s from Q, left (+1) of P -> Q or right."""
    d = Q - P
    length = np.linalg.norm(d, axis=-1, keepdims=True)
    along = (r**2 - s**2 + length**2) / (2 * length)
    across = side * np.sqrt(r**2 - along**2)
    u = d / length
    return P + along * u + across * np.stack([-u[..., 1], u[..., 0]], axis=-1)


def angle(d: Array) -> Array:
    return np.arctan2(d[..., 1], d[..., 0])


def turn(a: Array, v: Array) -> Array:
    """Return vectors (n, 2), v turned by angles (n,)."""
    c, s = np.cos(a), np.sin(a)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)


def place_six_bar(q: Array) -> tuple[Array, Array]:
    """Return origins (n, 2) and angles (n,) of the output lever, of crank angles (n,)."""
    B = 0.06 * np.stack([np.cos(q), np.sin(q)], axis=1)
    coupler = angle(meet(B, 0.18, np.array([0.2, 0.0]), 0.12, 1) - B)
    E, G = B + turn(coupler, np.array([0.09, 0.08])), np.array([[0.32, 0.06]])
    return np.repeat(G, len(q), axis=0), angle(meet(E, 0.22, G, 0.12, 1) - G)


def place_jansen_leg(q: Array) -> tuple[Array, Array]:
    """Return feet (n, 2) in (x, z) and the directions (n,) from the feet to the lower joints."""
    a, b, c, d, e, f, g, h, i, j, k, low, m = 1e-3 * np.array(
        [38, 41.5, 39.3, 40.1, 55.8, 39.4, 36.7, 65.7, 49, 50, 61.9, 7.8, 15]
    )
    Z, Y = np.array([[-a, -low]]), m * np.stack([np.cos(q), np.sin(q)], axis=1)
    X, U = meet(Z, b, Y, j, 1), meet(Y, k, Z, c, 1)
    W = meet(X, e, Z, d, -1)
    V = meet(W, f, U, g, -1)
    foot = meet(V, h, U, i, -1)
    return foot, angle(U - foot)


def place_klann_leg(q: Array) -> tuple[Array, Array]:
    """Return feet (n, 2) in (x, z) and the directions (n,) from the feet to the knees."""
    AC, BH, CF, CH, DE, EF, EG, FG, FH = 1e-3 * np.array(
        [17.5, 23.7, 73.4, 38.8, 34.1, 57.7, 111.7, 59, 35.2]
    )
    B, D = 1e-3 * np.array([[-38.8, -12.5]]), 1e-3 * np.array([[-14.6, 41.9]])
    C = AC * np.stack([np.cos(q), np.sin(q)], axis=1)
    H = meet(C, CH, B, BH, -1)
    F = meet(C, CF, H, FH, -1)
    E = meet(F, EF, D, DE, 1)
    foot = meet(E, EG, F, FG, 1)
    return foot, angle(F - foot)


@pytest.mark.parametrize(
    ("name", "place", "axes", "first"),
    [
        ("six-bar", place_six_bar, [0, 1], 0.0),
        ("jansen-leg", place_jansen_leg, [0, 2], np.pi / 2),
        ("klann-leg", place_klann_leg, [0, 2], np.pi / 2),
    ],
)
def test_planar_linkage_agrees_with_constructed_circles(
    name: str, place: Callable[[Array], tuple[Array, Array]], axes: list[int], first: float
) -> None:
    machine = load_cached_robot(name)
    wanted = inverse(machine, random_coordinates(machine, POSES, seed=3))
    assert wanted.converged.all()
    for solution in (wanted, forward(machine, wanted.q)):
        origin, direction = place(wanted.q[:, 0])
        assert_allclose(solution.T[:, axes, 3], origin, rtol=0, atol=ATOL)
        # the x axis of the lever in the plane (x, y), the z axis of the foot in (x, z)
        column = 0 if not first else 2
        assert_allclose(angle(solution.T[:, axes, column]), direction, rtol=0, atol=ATOL)


def draw_machine(name: str, seed: int) -> tuple[Mechanism, dict[str, float]]:
    """Return a shipped robot with errors as large as its spreads, and its values by name."""
    nominal = load_cached_robot(name)
    draws = np.random.default_rng(seed).standard_normal(len(nominal.parameters))
    machine = nominal.with_values(nominal.values + draws * nominal.parameters.tolerance)
    return machine, dict(zip(machine.parameters.names, machine.values.tolist(), strict=True))


def reach_poses(machine: Mechanism, seed: int) -> Solution:
    """Return forward solutions of poses that inverse kinematics reaches, which must be the same."""
    wanted = inverse(machine, random_coordinates(machine, POSES, seed))
    assert wanted.converged.all()
    back = forward(machine, wanted.q)
    assert_allclose(back.T, wanted.T, rtol=0, atol=ATOL)
    return back


def test_both_fingers_of_a_gripper_are_where_the_rods_of_its_disc_put_them() -> None:
    machine, value = draw_machine("gripper", 6)
    solution = reach_poses(machine, 6)
    q = solution.q[:, 0] + value["motor.offset"]
    for side, way in (("right", 1.0), ("left", -1.0)):
        pin = value[f"{side}-rod.pin.x"] * np.stack([np.cos(q), np.sin(q)], axis=1)
        across = value[f"{side}.rail.y"] - pin[:, 1]
        x = pin[:, 0] + way * np.sqrt(value[f"{side}-rod.length"] ** 2 - across**2)
        if side == "right":
            assert_allclose(solution.T[:, 0, 3], x, rtol=0, atol=ATOL)
            assert_allclose(solution.T[:, 1, 3], value["right.rail.y"], rtol=0, atol=ATOL)
        else:
            rail = solution.passive_names.index("left.rail")
            assert_allclose(solution.passive[:, rail], -x, rtol=0, atol=ATOL)


def test_foot_of_a_biped_is_where_knee_and_push_rods_put_it() -> None:
    machine, value = draw_machine("biped-leg", 7)
    solution = reach_poses(machine, 7)
    q = solution.q + [value[f"{name}.offset"] for name in ("knee", "left", "right")]
    # the knee in the plane (z, x), in which a rotation about y is counterclockwise
    arm = np.array([0.0, value["bend.crank.x"]])
    crank = turn(q[:, 0], arm) + np.array([0.28, 0.0])
    lever = np.array([-0.045962667, -0.038567257])
    radius = float(np.linalg.norm(lever))
    tip = meet(crank, value["bend.length"], np.zeros((1, 2)), radius, 1)
    knee = angle(tip) - np.arctan2(*lever[::-1])
    shank = geometry.exp_so3(knee[:, None] * [0.0, 1.0, 0.0])
    cross = np.array([value["ankle.cross.x"], 0.0, value["ankle.cross.z"]])
    assert_allclose(solution.T[:, :3, 3], shank @ cross, rtol=0, atol=ATOL)
    foot = shank.swapaxes(1, 2) @ solution.T[:, :3, :3]
    assert_allclose(foot[:, 1, 0], 0.0, atol=ATOL)  # its x axis is across the axis of the pitch
    for k, (side, y, z) in enumerate((("left", 0.04, -0.08), ("right", -0.04, -0.18)), 1):
        radius = value[f"{side}.crank.x"]
        top = radius * np.stack([np.cos(q[:, k]), 0.0 * q[:, k], -np.sin(q[:, k])], axis=1)
        ball = [value[f"{side}.platform.x"], value[f"{side}.platform.y"], -0.01]
        rod = cross + foot @ ball - (top + np.array([0.0, y, z]))
        length = np.linalg.norm(rod, axis=1)
        assert_allclose(length, value[f"{side}.length"], rtol=0, atol=ATOL)


def rotate(axis: Array | list[float], a: Array | float = 1.0) -> Array:
    """Return rotations (n, 3, 3) by angles (n,) about an axis (3,) or axes (n, 3)."""
    return geometry.exp_so3(np.atleast_1d(a)[:, None] * np.asarray(axis))


def test_tool_of_a_delta_turns_with_its_telescopic_shaft() -> None:
    machine, value = draw_machine("telescopic-delta", 8)
    solution = reach_poses(machine, 8)
    q, tool, origin = solution.q, solution.T[:, :3, :3], solution.T[:, :3, 3]
    spindle = solution.passive[:, solution.passive_names.index("bearing.spindle")]
    plate = tool @ rotate([0.0, 0.0, -1.0], spindle)
    off = np.array([value["bearing.platform.x"], value["bearing.platform.y"], 0.0])
    axis = np.array([value["bearing.spindle.x"], value["bearing.spindle.y"], 0.0])
    center = origin + tool @ off - plate @ axis
    for k in range(3):
        arm, base = k + 1, rotate([0.0, 0.0, 2 * np.pi * k / 3])
        tilt = [value[f"shoulder{arm}.motor.rx"], 0.0, value[f"shoulder{arm}.motor.rz"]]
        swing = rotate(tilt) @ rotate([0.0, 1.0, 0.0], q[:, k] + value[f"q{arm}.offset"])
        for side, y in (("left", 0.04), ("right", -0.04)):
            elbow = swing @ [value[f"{side}{arm}.arm.x"], y, 0.0] + [0.2, 0.0, 0.0]
            end = center + plate @ (base[0] @ [0.05, y, 0.0])
            length = np.linalg.norm(end - elbow @ base[0].T, axis=1)
            assert_allclose(length, value[f"{side}{arm}.length"], rtol=0, atol=ATOL)
    tilt = rotate([value["shaft.motor.rx"], value["shaft.motor.ry"], 0.0])
    yoke = (tilt @ rotate([0.0, 0.0, 1.0], q[:, 3] + value["tool.offset"]))[..., 0]
    up = -origin / np.linalg.norm(origin, axis=1, keepdims=True)
    upper = np.cross(up, yoke)  # the cross of a joint is square to its yoke and to the shaft
    upper /= np.linalg.norm(upper, axis=1, keepdims=True)
    lower = rotate(value["shaft.yoke.rz"] * up) @ upper[..., None]
    assert_allclose(np.einsum("ni,ni->n", lower[..., 0], tool[..., 0]), 0.0, atol=ATOL)


ARMS_OF_H4 = (
    # foot, angle of the arm's plane, half of the plate, attachments on that half
    ((0.4, 0.0), 0.0, 0, ((0.05, 0.05), (0.05, -0.05))),
    ((0.1, 0.4), np.pi / 2, 0, ((-0.05, 0.05), (0.05, 0.05))),
    ((-0.4, 0.0), np.pi, 1, ((-0.05, -0.05), (-0.05, 0.05))),
    ((-0.1, 0.4), np.pi / 2, 1, ((-0.05, 0.05), (0.05, 0.05))),
)


def locate_elbows(q: Array, foot: tuple[float, float], plane: float, y: float) -> Array:
    """Return ends (n, 3) of a bar that an arm of 0.3 m carries at its elbow, `y` beside it."""
    arm = np.stack([0.3 * np.cos(q), np.full(len(q), y), -0.3 * np.sin(q)], axis=1)
    c, s = np.cos(plane), np.sin(plane)
    return arm @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [*foot, 0.0]


def test_four_arm_robot_with_a_plate_of_two_halves_has_bars_of_their_length() -> None:
    machine = load_cached_robot("h4")
    solution = inverse(machine, random_coordinates(machine, POSES, seed=4))
    assert solution.converged.all()
    back = forward(machine, solution.q)
    assert_allclose(back.T, solution.T, rtol=0, atol=ATOL)
    # the halves do not turn, because their bars are parallel; the crossbar turns alone
    hinge = np.stack([solution.T[:, :3, 0] * 0.1, solution.T[:, :3, 0] * -0.1], axis=1)
    hinge = hinge + solution.T[:, None, :3, 3]
    for k, (foot, plane, half, attachments) in enumerate(ARMS_OF_H4):
        for y, (ax, ay) in zip((0.05, -0.05), attachments, strict=True):
            end = hinge[:, half] + [ax, ay, 0.0]
            rod = end - locate_elbows(solution.q[:, k], foot, plane, y)
            assert_allclose(np.linalg.norm(rod, axis=1), 0.8, rtol=0, atol=ATOL)
    assert_allclose(solution.T[:, 2, :3], np.tile([0.0, 0.0, 1.0], (POSES, 1)), atol=ATOL)


@pytest.mark.parametrize("errors", [0.0, 1.0], ids=["nominal", "with errors"])
def test_delta_with_real_parallelograms_has_six_bars_of_their_length(errors: float) -> None:
    nominal = load_cached_robot("parallelogram-delta")
    draws = np.random.default_rng(5).standard_normal(len(nominal.parameters))
    machine = nominal.with_values(nominal.values + errors * draws * nominal.parameters.tolerance)
    solution = inverse(machine, random_coordinates(machine, POSES, seed=5))
    assert solution.converged.all()
    assert_allclose(forward(machine, solution.q).T, solution.T, rtol=0, atol=ATOL)
    value = dict(zip(machine.parameters.names, machine.values, strict=True))
    for k in range(3):
        arm, (side_of, plane) = k + 1, ({"left": 0.05, "right": -0.05}, 2 * np.pi * k / 3)
        base = geometry.exp_so3(np.array([0.0, 0.0, plane]))
        tilt = geometry.exp_so3(
            np.array([value[f"shoulder{arm}.motor.rx"], 0.0, value[f"shoulder{arm}.motor.rz"]])
        )
        q = solution.q[:, k] + value[f"q{arm}.offset"]
        swing = geometry.exp_so3(q[:, None] * np.array([0.0, 1.0, 0.0]))
        for side, y in side_of.items():
            tip = np.array([value[f"{side}{arm}.arm.x"], y, value.get(f"{side}{arm}.arm.z", 0.0)])
            elbow = (swing @ tip) @ tilt.T + [0.2, 0.0, 0.0]
            end = np.array([value[f"{side}{arm}.platform.{axis}"] for axis in "xyz"])
            at = solution.T[:, :3, 3] + (base @ end) @ solution.T[:, :3, :3].swapaxes(1, 2)
            length = np.linalg.norm(at - elbow @ base.T, axis=1)
            assert_allclose(length, value[f"{side}{arm}.length"], rtol=0, atol=ATOL)
    turned = geometry.log_so3(solution.T[:, :3, :3])
    assert (np.abs(turned).max() > 1e-4) == bool(errors)  # [rad] only errors turn the platform


HEAD = """
format: 1
family: limbs
name: three-arms
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
actuators: {q: {reads: angle, stroke: [-90, 90], unknown: [offset], angle: {sd: 0.1}}}
workspace: {x: [-40, 40], y: [-40, 40], yaw: [-15, 15]}
"""
MOTOR = "{joint: R, name: motor, at: [300, 0, 0], actuated: q, start: 60}"
ROD = "copies: {count: 3}, ending: distance, length: 250, errors: [{of: rod, shift: [length]}]"
MOTORS = f"  - {{name: motor, to: arm, ending: rigid, copies: {{count: 3}}, chain: [{MOTOR}]}}\n"
BODIES = f"bodies:\n  - {{name: arm, copies: {{count: 3}}}}\nlimbs:\n{MOTORS}"
FORMS = {
    "limbs from base to platform": "limbs:\n"
    f"  - {{name: rod, chain: [{MOTOR}], tip: [150, 0, 0], attach: [100, 0, 0], {ROD}}}\n",
    "arms as bodies": BODIES
    + f"  - {{name: rod, on: arm, tip: [150, 0, 0], attach: [100, 0, 0], {ROD}}}\n",
    "rods from the platform to the arms": BODIES
    + f"  - {{name: rod, on: platform, to: arm, tip: [100, 0, 0], attach: [150, 0, 0], {ROD}}}\n",
}
PLAIN, *OTHERS = FORMS
IDLER = """  - {name: idler}
limbs:
  - {name: idler, to: idler, ending: rigid, chain: [{joint: R}]}
  - {name: again, on: arm, tip: [150, 0, 0], attach: [100, 0, 0], copies: {count: 3},
     ending: distance, length: 250}
"""


def load_form(path: Path, form: str, change: str = "") -> Mechanism:
    """Return three arms around a plate in one of its forms; `change` is put into its file."""
    old, _, new = change.partition(" -> ")
    file = path / "robot.yaml"
    file.write_text((HEAD + FORMS[form]).replace(old or HEAD, new or HEAD), "utf-8")
    return load_robot(file)


@pytest.mark.parametrize("form", OTHERS)
def test_machine_has_the_same_poses_derivatives_and_modes_in_every_form(
    form: str, tmp_path: Path
) -> None:
    plain, machine = load_form(tmp_path, PLAIN), load_form(tmp_path, form)
    target = random_coordinates(plain, 20, seed=1)
    here, there = inverse(plain, target), inverse(machine, target)
    assert here.converged.all()
    assert there.converged.all()
    assert_allclose(there.q, here.q, rtol=0, atol=ATOL)
    assert_allclose(forward(machine, here.q).T, here.T, rtol=0, atol=ATOL)
    ours, theirs = jacobian(machine, here.q), jacobian(plain, here.q)
    assert machine.parameters.names == plain.parameters.names
    assert_allclose(ours.parameters, theirs.parameters, rtol=0, atol=1e-8)
    assert_allclose(ours.readings, theirs.readings, rtol=0, atol=1e-8)
    modes = [len(find_assembly_modes(m, here.q[0], patience=500)) for m in (plain, machine)]
    assert modes[0] == modes[1] > 1


@pytest.mark.parametrize("name", ["six-bar", "h4", "klann-leg", "telescopic-delta"])
def test_passive_joints_beside_bodies_have_the_derivatives_of_forward_kinematics(name: str) -> None:
    machine = load_cached_robot(name)
    q = inverse(machine, random_coordinates(machine, 2, seed=6)).q
    solution, values = forward(machine, q), machine.values[None]
    exact = differentiate_passive_joints(machine, values, q[None], solution.state)
    assert exact.names
    h = 1e-6
    for i in range(len(machine.parameters)):
        step = h * np.eye(len(machine.parameters))[i]
        ends = [forward(machine.with_values(machine.values + s * step), q) for s in (1, -1)]
        slope = (ends[0].passive - ends[1].passive) / (2 * h)
        assert_allclose(exact.parameters[0, :, :, i], slope, rtol=1e-6, atol=1e-6)
    for i in range(q.shape[1]):
        ends = [forward(machine, q + s * h * np.eye(q.shape[1])[i]) for s in (1, -1)]
        slope = (ends[0].passive - ends[1].passive) / (2 * h)
        assert_allclose(exact.readings[0, :, :, i], slope, rtol=1e-6, atol=1e-6)


TWINS = """closure: least-squares
limbs:
  - {name: twin, on: arm, tip: [150, 0, 0], attach: [100, 0, 0], copies: {count: 3},
     ending: distance, length: 250, errors: [{of: rod, shift: [length]}]}
"""


def test_loops_with_bodies_close_in_the_least_squares_sense_with_exact_derivatives(
    tmp_path: Path,
) -> None:
    closure, limbs = TWINS.split("\n", 1)
    file = tmp_path / "robot.yaml"
    text = f"{HEAD}{closure}\n{FORMS[OTHERS[0]].replace('limbs:', limbs.rstrip())}"
    file.write_text(text, "utf-8")
    robot = load_robot(file)
    errors = 1e-4 * np.random.default_rng(0).standard_normal(len(robot.parameters))
    machine = robot.with_values(robot.values + errors)
    q = inverse(machine, np.array([[0.01, 0.02, 0.05], [-0.02, 0.01, -0.1]])).q
    solution, exact, h = forward(machine, q), jacobian(machine, q), 1e-6
    assert solution.converged.all()
    assert (solution.residual > 1e-5).all()  # [m] rods of unequal lengths leave the loops open
    for i in range(len(machine.parameters)):
        step = h * np.eye(len(machine.parameters))[i]
        ends = [forward(machine.with_values(machine.values + s * step), q) for s in (1, -1)]
        slope = geometry.pose_difference(ends[0].T, ends[1].T) / (2 * h)
        # 1e-6 squared of the differences, and rounding of 1e-15 m over 2e-6
        assert_allclose(exact.parameters[..., i], slope, rtol=1e-6, atol=1e-7)


def test_frame_of_a_body_is_no_unknown_of_the_complete_model(tmp_path: Path) -> None:
    change = "controlled: -> error_model: complete\ntolerances: {lengths: {sd: 0.1}}\ncontrolled:"
    names = load_form(tmp_path, OTHERS[0], change).parameters.names
    assert "rod1.arm.x" in names
    assert "rod1.platform.x" in names
    assert not any(name.startswith("motor1.arm.") for name in names)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("on: arm, -> on: arm7,", "'arm7', which is not a body \\(did you mean"),
        ("on: arm, -> on: arm, to: arm,", "limb 'rod1' begins and ends on 'arm1'"),
        ("bodies: -> bodies:\n  - {name: base}", "two bodies have the name 'base'"),
        ("bodies: -> bodies:\n  - {name: arm2}", "two bodies have the name 'arm2'"),
        ("bodies: -> bodies:\n  - {name: idler}", "no limb joins the body 'idler'"),
        (f"limbs: -> {IDLER.replace('chain', 'tip: [0, 0, 0], chain')}", "'idler' can move while"),
        (f"limbs: -> {IDLER.replace('rigid', 'ball')}", "'idler' has no rigid limb from a body wi"),
        ("{name: arm, copies: {count: 3}} -> {name: arm, copies: {count: 2}}", "has 3 copies"),
        ("name: motor, at -> name: arm, at", "limb 'motor' has a joint 'arm', like the body"),
    ],
)
def test_bodies_that_do_not_fit_are_refused(change: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(MechanismError, match=reason):
        load_form(tmp_path, OTHERS[0], change)
