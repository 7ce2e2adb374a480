# SPDX-License-Identifier: Apache-2.0
"""Machines of several loops in series, as lists of joints: a leg, a machine head, an arm, a digger.

They are drawn at home, in meters, with the bodies and frames of `urdf_machines`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tests.io.formats.linkages.urdf_machines import BASE, PLATFORM, MachineJoint, make_pose

ABOUT = {
    "x": Rotation.from_euler("y", np.pi / 2).as_matrix(),
    "y": Rotation.from_euler("x", -np.pi / 2).as_matrix(),
    "z": np.eye(3),
}
"""Rotations that turn the z axis to another one."""


def about(axis: str, point: ArrayLike) -> np.ndarray:
    """Return the frame of a joint about an axis of the base."""
    return make_pose(ABOUT[axis], point)


def make_leg(side: str = "", y: float = 0.0, foot: str = PLATFORM) -> list[MachineJoint]:
    """Return a leg: three joints of the hip, a four-bar in the knee, two push rods in the ankle."""
    shin, thigh = f"{side}shin", f"{side}thigh"
    knee, ankle = np.array([0.05, y, -0.3]), np.array([0.0, y, -0.6])
    crank, pin = np.array([0.06, y, -0.18]), np.array([0.09, y, -0.35])
    top = np.add(crank, [0.05, 0, 0])
    joints = [
        MachineJoint(f"{side}yaw", "R", BASE, f"{side}hip1", about("z", [0, y, 0]), True),
        MachineJoint(f"{side}roll", "R", f"{side}hip1", f"{side}hip2", about("x", [0, y, 0]), True),
        MachineJoint(f"{side}pitch", "R", f"{side}hip2", thigh, about("y", [0, y, 0]), True),
        MachineJoint(f"{side}knee", "R", thigh, shin, about("y", knee)),
        MachineJoint(f"{side}knee_motor", "R", thigh, f"{side}crank", about("y", crank), True),
        MachineJoint(
            f"{side}rod_top",
            "R",
            f"{side}crank",
            f"{side}rod",
            about("y", np.add(crank, [0.05, 0, 0])),
        ),
        MachineJoint(f"{side}rod_end", "R", f"{side}rod", shin, about("y", pin)),
        MachineJoint(f"{side}ankle", "U", shin, foot, make_pose(np.eye(3), ankle)),
    ]
    for name, across in (("in", 0.04), ("out", -0.04)):
        motor = np.add(ankle, [0.01, across, 0.15])
        top, heel = np.add(motor, [-0.05, 0, 0]), np.add(ankle, [-0.05, across, 0.01])
        crank_body, rod = f"{side}crank_{name}", f"{side}rod_{name}"
        joints += [
            MachineJoint(f"{side}{name}", "R", shin, crank_body, about("y", motor), True),
            MachineJoint(f"{side}top_{name}", "U", crank_body, rod, make_pose(np.eye(3), top)),
            MachineJoint(f"{side}heel_{name}", "S", rod, foot, make_pose(np.eye(3), heel)),
        ]
    return joints


def make_head_with_wrist() -> list[MachineJoint]:
    """Return a slide that carries a tripod (three UPS legs, a UP guide) with a wrist of two."""
    joints = [MachineJoint("column", "P", BASE, "carriage", about("x", [0, 0, 0]), True)]
    guide = make_pose(np.eye(3), [0.0, 0.0, 0.1])
    joints += [
        MachineJoint("guide_cross", "U", "carriage", "guide", guide),
        MachineJoint("guide_slide", "P", "guide", "head", make_pose(np.eye(3), [0, 0, 0.4])),
    ]
    for k, angle in enumerate(np.deg2rad([10.0, 125.0, 245.0])):
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        foot, end = 0.3 * out, 0.12 * out + [0, 0, 0.62]
        along = Rotation.align_vectors([end - foot], [[0.0, 0.0, 1.0]])[0].as_matrix()
        middle = make_pose(along, (foot + end) / 2)
        joints += [
            MachineJoint(f"u{k}", "U", "carriage", f"barrel{k}", make_pose(along, foot)),
            MachineJoint(f"leg{k}", "P", f"barrel{k}", f"rod{k}", middle, True),
            MachineJoint(f"s{k}", "S", f"rod{k}", "head", make_pose(along, end)),
        ]
    tilted = Rotation.from_euler("xy", [0.5, 0.3]).as_matrix()
    return [
        *joints,
        MachineJoint("w1", "R", "head", "fork", about("z", [0.02, 0, 0.7]), True),
        MachineJoint("w2", "R", "fork", PLATFORM, make_pose(tilted, [0.02, 0.01, 0.8]), True),
    ]


def make_lever_arm(bend: float = 0.6) -> list[MachineJoint]:
    """Return a robot arm whose forearm a lever and a rod move, between a slew and a wrist.

    The axis of the slew leans, so that no axis of the column's frame is in the plane of the loop.
    `bend` is the angle of the wrist, which is singular at zero.
    """
    slew = make_pose(Rotation.from_euler("xy", [0.3, 0.2]).as_matrix(), [0.0, 0.0, 0.2])
    tilted = Rotation.from_euler("y", np.pi / 2 + bend).as_matrix()
    elbow, rear = np.array([0.1, 0, 1.2]), np.array([-0.1, 0, 1.15])
    lever = np.array([-0.15, 0, 0.45])
    return [
        MachineJoint("slew", "R", BASE, "column", slew, True),
        MachineJoint("shoulder", "R", "column", "upper", about("y", [0, 0, 0.5]), True),
        MachineJoint("elbow", "R", "upper", "forearm", about("y", elbow)),
        MachineJoint("lever", "R", "column", "crank", about("y", [0, 0, 0.5]), True),
        MachineJoint("rod", "R", "crank", "tie", about("y", lever)),
        MachineJoint("rear", "R", "tie", "forearm", about("y", rear)),
        MachineJoint("roll", "R", "forearm", "hand1", about("x", [0.3, 0, 1.25]), True),
        MachineJoint("bend", "R", "hand1", "hand2", about("y", [0.7, 0, 1.25]), True),
        MachineJoint("flange", "R", "hand2", PLATFORM, make_pose(tilted, [0.8, 0, 1.25]), True),
    ]


def make_tilted_table() -> list[MachineJoint]:
    """Return a planar 3-RRR table, whose plane and whose platform frame are oblique."""
    tilt = make_pose(Rotation.from_euler("xyz", [0.4, 0.3, 0.2]).as_matrix(), [0.1, 0.0, 0.2])
    joints = []
    for k, angle in enumerate(np.deg2rad([210.0, 330.0, 90.0])):
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        across = np.array([-out[1], out[0], 0.0])
        places = (0.3 * out, 0.25 * out + 0.18 * across, 0.1 * out)
        bodies = (BASE, f"arm{k}", f"rod{k}", PLATFORM)
        for i, (name, place) in enumerate(zip(("motor", "elbow", "pin"), places, strict=True)):
            T = tilt @ make_pose(np.eye(3), place)
            joints.append(MachineJoint(f"{name}{k}", "R", bodies[i], bodies[i + 1], T, i == 0))
    return joints


def make_digger(has_rocker: bool = False) -> list[MachineJoint]:
    """Return an excavator: a slew, and cylinders that move boom, stick and bucket.

    With a rocker, the cylinder of the bucket pushes a rocker that a link joins to the bucket.
    """
    slew = MachineJoint("slew", "R", BASE, "house", about("z", [0, 0, 1]), True)
    boom = _make_cylinder("boom", "house", "boom", [0.2, 0, 1.5], [0.6, 0, 1.2], [2.0, 0, 2.6])
    stick = _make_cylinder("stick", "boom", "stick", [4.0, 0, 3.5], [2.6, 0, 3.6], [3.8, 0, 4.0])
    if not has_rocker:
        last = _make_cylinder("dig", "stick", PLATFORM, [5.0, 0, 1.8], [4.4, 0, 3.4], [5.2, 0, 2.2])
        return [slew, *boom, *stick, *last]
    push = _make_cylinder("dig", "stick", "rocker", [4.9, 0, 2.2], [4.4, 0, 3.4], [5.2, 0, 2.5])
    return [
        *(slew, *boom, *stick, *push),
        MachineJoint("link_top", "R", "rocker", "link", about("y", [5.25, 0, 2.45])),
        MachineJoint("link_end", "R", "link", PLATFORM, about("y", [5.4, 0, 2.0])),
        MachineJoint("bucket", "R", "stick", PLATFORM, about("y", [5.0, 0, 1.8])),
    ]


def _make_cylinder(
    name: str, a: str, b: str, pin: ArrayLike, foot: ArrayLike, head: ArrayLike
) -> list[MachineJoint]:
    """Return a pin between two bodies, and a cylinder that turns it."""
    along = np.subtract(head, foot)
    slide = Rotation.align_vectors([along, [0, 1, 0]], [[0, 0, 1], [0, 1, 0]])[0].as_matrix()
    return [
        MachineJoint(f"{name}_pin", "R", a, b, about("y", pin)),
        MachineJoint(f"{name}_foot", "R", a, f"{name}_barrel", about("y", foot)),
        MachineJoint(name, "P", f"{name}_barrel", f"{name}_rod", make_pose(slide, head), True),
        MachineJoint(f"{name}_head", "R", f"{name}_rod", b, about("y", head)),
    ]
