# SPDX-License-Identifier: Apache-2.0
"""Limbs are checked one by one; redundant closure equations; mechanisms without any length."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import MechanismError
from loopcal.geometry import invert_pose
from loopcal.mechanism.assembly import Joint, Limb, Link
from loopcal.mechanism.compilation import build
from loopcal.mechanism.modes import find_assembly_modes
from loopcal.mechanism.solutions import forward, inverse
from tests import zoo

HOME = zoo.place((0.01, -0.02, 0.25), (0.05, -0.08, 0.1))


RIGID = ("rigid",) * 3


def make_rigid_limb(name, frames, joints, corner):
    """Return a rigid limb with joints in these frames [base] at home, at joint values of zero."""
    attachment = zoo.place(corner)
    ends = [np.eye(4), *frames, HOME @ attachment]
    links = tuple(Link(f"link{i}", invert_pose(a) @ b) for i, (a, b) in enumerate(pairwise(ends)))
    return Limb(name, links, joints, "rigid", Link("attachment", attachment))


def leg_frame(i):
    """Return the frame at a leg's foot, with z along the leg, and the leg's length."""
    foot, end = zoo.HEXAPOD_BASE[i] * zoo.MM, HOME @ zoo.place(zoo.HEXAPOD_PLATFORM[i] * zoo.MM)
    z = (end[:3, 3] - foot) / np.linalg.norm(end[:3, 3] - foot)
    x = np.cross((0.3, 1.0, 0.2), z)
    frame = np.eye(4)
    frame[:3, 0] = x / np.linalg.norm(x)
    frame[:3, 1], frame[:3, 2], frame[:3, 3] = np.cross(z, frame[:3, 0]), z, foot
    return frame, float(np.linalg.norm(end[:3, 3] - foot))


ABOUT_X, ABOUT_Y = zoo.place((0, 0, 0), (0, np.pi / 2, 0)), zoo.place((0, 0, 0), (-np.pi / 2, 0, 0))


def make_sps_leg(i, apart=0.0):
    """Return a leg RRR-P-RRR; its base axes intersect unless `apart` [m]."""
    F, length = leg_frame(i)
    top = F @ zoo.place((0, 0, length))
    askew = zoo.place((0, 0, 0), (0.3, 0.2, 0))
    frames = [
        F @ ABOUT_X @ zoo.place((0, apart, 0)),
        F @ ABOUT_Y,
        F @ askew @ zoo.place((apart, 0, 0)),
        F,
    ]
    frames += [top @ ABOUT_X, top @ ABOUT_Y, top @ askew]
    joints = tuple(
        Joint(f"j{n}", k, f"q{i + 1}" if k == "P" else None)
        for n, k in enumerate("RRRPRRR", start=1)
    )
    return make_rigid_limb(f"leg{i + 1}", frames, joints, zoo.HEXAPOD_PLATFORM[i] * zoo.MM)


def make_rrrprr_leg(i, loose):
    """Return a leg RRRPRR with its third axis along the slide.

    With `loose` the axis after the slide is parallel to it, else skew.
    """
    F, length = leg_frame(i)
    middle = F @ zoo.place((0, 0, length / 2))
    if not loose:
        middle = middle @ zoo.place((0.02, 0.01, 0), (0.4, -0.5, 0))
    askew = F @ zoo.place((0.01, -0.02, length), (0.9, 0.3, 0.2))
    frames = [F @ ABOUT_X, F @ ABOUT_Y, F, F, middle, askew]
    joints = tuple(
        Joint(f"j{n}", k, f"q{i + 1}" if k == "P" else None)
        for n, k in enumerate("RRRPRR", start=1)
    )
    return make_rigid_limb(f"leg{i + 1}", frames, joints, zoo.HEXAPOD_PLATFORM[i] * zoo.MM)


def make_assembly(limbs, controlled=("x", "y", "z", "roll", "pitch", "yaw")):
    return zoo.assemble("machine", tuple(limbs), zoo.AXES, controlled, HOME)


@pytest.mark.parametrize("odd", [0, 3])
def test_underdetermined_limb_is_named_in_any_order_of_limbs(odd):
    limbs = [make_sps_leg(i, 0.02 if i == odd else 0.0) for i in range(6)]
    messages = set()
    for shift in range(6):
        with pytest.raises(
            MechanismError, match=f"limb 'leg{odd + 1}' has 7 joints, but 6 closure equations"
        ) as error:
            build(make_assembly(np.roll(np.array(limbs, dtype=object), shift)))
        messages.add(str(error.value))
    assert len(messages) == 1


def test_limb_order_does_not_change_poses_or_the_locked_joint():
    limbs = [make_rrrprr_leg(i, loose=i == 2) for i in range(5)]
    orders = [(0, 1, 2, 3, 4), (2, 0, 1, 3, 4), (4, 3, 1, 0, 2)]
    robots = [
        build(make_assembly([limbs[i] for i in order], ("x", "y", "z", "roll", "pitch")))
        for order in orders
    ]
    target = np.array([[0.012, -0.018, 0.252, 0.06, -0.07]])
    poses = [inverse(robot, target) for robot in robots]
    for robot, result in zip(robots, poses, strict=True):
        assert result.converged.all()
        assert_allclose(result.T, poses[0].T, atol=1e-12)
        assert_allclose(forward(robot, result.q).T, result.T, atol=1e-11)
        held = [
            (limb, j)
            for g in robot.program.groups
            for limb in g.limbs
            for j, h in enumerate(g.locked)
            if h
        ]
        (limb, joint), (finding,) = held[0], robot.findings
        assert len(held) == 1
        assert finding.code == "mechanism.locked-joint"
        assert finding.data == {
            "limb": "leg3",
            "joint": robot.assembly.limbs[limb].joints[joint].name,
            "turns": True,
            "value": (0.0, "rad"),
        }


def test_locked_joint_keeps_its_reported_start_value():
    limbs = [make_rrrprr_leg(i, loose=i == 2) for i in range(5)]
    robot = build(make_assembly(limbs, ("x", "y", "z", "roll", "pitch")))
    joint = robot.findings[0].data["joint"]
    turned = replace(
        limbs[2],
        joints=tuple(replace(j, start=0.4) if j.name == joint else j for j in limbs[2].joints),
    )
    other = build(make_assembly([*limbs[:2], turned, *limbs[3:]], ("x", "y", "z", "roll", "pitch")))
    assert other.findings[0].data["joint"] == joint
    assert other.findings[0].data["value"] == (0.4, "rad")
    q = inverse(robot, np.array([[0.012, -0.018, 0.252, 0.06, -0.07]])).q
    assert_allclose(forward(other, q).T, forward(robot, q).T, atol=1e-11)


def test_planar_robot_with_six_freedoms_is_solved_and_reported_as_redundant():
    whole, flat = zoo.planar_arms(RIGID, zoo.AXES), zoo.planar_arms(RIGID)
    assert flat.findings == ()
    (finding,) = whole.findings
    assert finding.code == "mechanism.repeated-equations"
    assert (finding.data["count"], finding.data["freedoms"]) == (6, ("rz", "x", "y"))
    asked = np.random.default_rng(0).uniform((-0.06, -0.06, -0.45), (0.06, 0.06, 0.45), (300, 3))
    result = inverse(flat, asked)
    result = result.take(result.converged)
    assert len(result.q) > 200
    again = forward(whole, result.q)
    # the closure matrix is not square, so its determinant must not select a mode by its sign
    assert again.converged.all()
    assert_allclose(again.T, result.T, atol=1e-11)
    assert (again.state.closure_sign == 0).all()
    assert (whole.home_state.closure_sign == 0).all()
    modes = [find_assembly_modes(robot, result.q[0], patience=2048) for robot in (whole, flat)]
    assert_allclose(modes[0].solution.T, modes[1].solution.T, atol=1e-9)
    assert (modes[0].solution.state.closure_sign == 0).all()


def test_redundant_equations_are_reported_when_no_freedoms_avoid_them():
    turned = zoo.place((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    whole = zoo.planar_arms(RIGID, zoo.AXES)
    assembly = zoo.move_base(whole.assembly, turned)
    robot = build(replace(assembly, parameters=(), maps=(), controlled=("x", "y", "yaw")))
    (finding,) = robot.findings
    assert finding.code == "mechanism.repeated-equations"
    assert (finding.data["count"], finding.data["freedoms"]) == (6, ())


def build_spherical_3rrr():
    """Build a spherical 3-RRR with every frame at the origin and axes 60 degrees apart."""
    limbs = []
    for i in range(3):
        turn = zoo.place((0, 0, 0), (0, 0, 2 * np.pi * i / 3))
        bend = zoo.place((0, 0, 0), (np.pi / 3, 0, 0))
        links = (
            Link("base", turn @ zoo.place((0, 0, 0), (np.pi / 4, 0, 0))),
            Link("crank", bend),
            Link("rod", bend),
        )
        joints = (
            Joint("motor", "R", f"q{i + 1}", start=0.6),
            Joint("elbow", "R", start=1.4),
            Joint("wrist", "R", start=0.5),
        )
        tip = turn @ zoo.place((0, 0, 0), (np.pi / 4, 0, 0))
        for joint, link in zip(joints, (bend, bend, np.eye(4)), strict=True):
            tip = tip @ zoo.place((0, 0, 0), (0, 0, joint.start)) @ link
        limbs.append(
            Limb(f"arm{i + 1}", (*links, Link("hand", np.eye(4))), joints, "rigid", Link("on", tip))
        )
    freedoms, wanted = ("rx", "ry", "rz"), ("roll", "pitch", "yaw")
    return build(zoo.assemble("wrist", tuple(limbs), freedoms, wanted, np.eye(4)))


def test_spherical_robot_without_lengths_has_a_size_of_one_meter():
    robot = build_spherical_3rrr()
    assert robot.size == 1.0
    asked = np.random.default_rng(1).uniform(-0.2, 0.2, (50, 3))
    result = inverse(robot, asked)
    assert result.converged.all()
    assert_allclose(forward(robot, result.q).T, result.T, atol=1e-10)
