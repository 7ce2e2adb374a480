# SPDX-License-Identifier: Apache-2.0
"""Over-constrained machines as users describe them, and one of them solved independently."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from loopcal.mechanism.model import Mechanism

Array = NDArray[np.float64]

SIDE = """
  - name: {name}
    ending: rigid
    chain:
      - {{joint: U, name: gimbal, at: [{base}, 0, 0], axes: [x, y], start: [0, {start}]}}
      - {{joint: P, name: leg, axis: z, actuated: {drive}, start: 1000}}
      - {{joint: R, name: hinge, axis: y, start: {back}}}
    attach: [{attach}, 0, 0]
    errors:
      - {{of: gimbal, shift: [x, y, z], tolerance: {{sd: 0.1}}}}
      - {{of: hinge, tilt: [rx, rz], tolerance: {{sd: 0.02}}}}
      - {{of: platform, shift: [x, y, z], tolerance: {{sd: 0.1}}}}"""
LEFT = SIDE.format(name="left", base=-300, start=-5, back=5, drive="a", attach=-200)
RIGHT = SIDE.format(name="right", base=300, start=5, back=-5, drive="b", attach=200)

EXECHON = f"""format: 1
family: limbs
name: head
source: ours
units: {{length: mm, angle: deg}}
controlled: [z, phi, theta]
actuators:
  a: {{reads: length, stroke: [700, 1300], unknown: [offset], length: {{sd: 0.1}}}}
  b: {{reads: length, stroke: [700, 1300], unknown: [offset], length: {{sd: 0.1}}}}
  c: {{reads: length, stroke: [700, 1300], unknown: [offset], length: {{sd: 0.1}}}}
limbs:{LEFT}{RIGHT}
  - name: middle
    ending: rigid
    chain:
      - {{joint: S, name: ball, at: [0, 300, 0], start: [0, 0, -5]}}
      - {{joint: P, name: leg, axis: z, actuated: c, start: 1000}}
      - {{joint: R, name: hinge, axis: x, start: 5}}
    attach: [0, 200, 0]
    errors:
      - {{of: ball, shift: [x, y, z], tolerance: {{sd: 0.1}}}}
      - {{of: hinge, tilt: [ry], tolerance: {{sd: 0.02}}}}
      - {{of: platform, shift: [x, y, z], tolerance: {{sd: 0.1}}}}
home: {{z: 1000}}
workspace: {{z: [950, 1100], phi: [-180, 180], theta: [0, 10]}}
"""
"""The head of an Exechon machine: two U-P-R limbs in one plane, and one S-P-R limb."""

FOUR_BAR = """format: 1
family: limbs
name: four-bar
source: ours
units: {length: mm, angle: deg}
controlled: [x]
actuators:
  q: {reads: angle, stroke: [-60, 60], unknown: [offset], angle: {sd: 0.1}}
limbs:
  - name: crank
    ending: rigid
    chain:
      - {joint: R, name: motor, at: [-150, 0, 0], axis: y, actuated: q, start: 0}
      - {joint: R, name: upper, at: [0, 0, 200], axis: y, start: 0}
    attach: [-150, 0, 0]
    errors:
      - {of: motor, tilt: [rx, rz], tolerance: {sd: 0.02}}
      - {of: upper, shift: [y, z], tolerance: {sd: 0.05}}
      - {of: upper, tilt: [rx, rz], tolerance: {sd: 0.05}}
  - name: rocker
    ending: rigid
    chain:
      - {joint: R, name: low, at: [150, 0, 0], axis: y, start: 0}
      - {joint: R, name: upper, at: [0, 0, 250], axis: y, start: 0}
    attach: [150, 0, 50]
    errors:
      - {of: low, shift: [x, y, z], tolerance: {sd: 0.05}}
      - {of: upper, shift: [z], tolerance: {sd: 0.05}}
      - {of: upper, tilt: [rx, rz], tolerance: {sd: 0.05}}
home: {z: 200}
workspace: {x: [-80, 80]}
"""
"""A planar four-bar linkage described in space, with four R joints."""


TWO_FOUR_BARS = """format: 1
family: limbs
name: two-four-bars
source: ours
units: {length: mm, angle: deg}
controlled: [x, z]
actuators:
  q: {reads: angle, stroke: [-60, 60], unknown: [offset], angle: {sd: 0.1}}
  p: {reads: angle, stroke: [-60, 60], unknown: [offset], angle: {sd: 0.1}}
bodies:
  - {name: mid, home: {z: 200}}
limbs:
  - name: crank
    to: mid
    ending: rigid
    chain:
      - {joint: R, name: motor, at: [-150, 0, 0], axis: y, actuated: q, start: 0}
      - {joint: R, name: upper, at: [0, 0, 200], axis: y, start: 0}
    attach: [-150, 0, 0]
    errors:
      - {of: motor, tilt: [rx, rz], tolerance: {sd: 0.1}}
      - {of: upper, tilt: [rx, rz], tolerance: {sd: 0.1}}
  - name: rocker
    to: mid
    ending: rigid
    chain:
      - {joint: R, name: low, at: [150, 0, 0], axis: y, start: 0}
      - {joint: R, name: upper, at: [0, 0, 250], axis: y, start: 0}
    attach: [150, 0, 50]
    errors:
      - {of: upper, tilt: [rx, rz], tolerance: {sd: 0.1}}
  - name: crank2
    on: mid
    ending: rigid
    chain:
      - {joint: R, name: motor, at: [-100, 0, 0], axis: y, actuated: p, start: 0}
      - {joint: R, name: upper, at: [100, 0, 150], axis: y, start: 0}
    attach: [-50, 0, 0]
    errors:
      - {of: upper, tilt: [rx, rz], tolerance: {sd: 0.1}}
  - name: rocker2
    on: mid
    ending: rigid
    chain:
      - {joint: R, name: low, at: [100, 0, 0], axis: y, start: 0}
      - {joint: R, name: upper, at: [0, 0, 150], axis: y, start: 0}
    attach: [150, 0, 0]
    errors:
      - {of: upper, tilt: [rx, rz], tolerance: {sd: 0.1}}
home: {x: 0, z: 350}
workspace: {x: [-40, 40], z: [340, 350]}
"""
"""A four-bar linkage in space on the coupler of another one."""

THREE_RRR = """format: 1
family: limbs
name: three-rrr
source: ours
units: {length: mm, angle: deg}
controlled: [x, y, yaw]
limbs:
  - name: arm
    ending: rigid
    chain:
      - {joint: R, name: motor, at: [300, 0, 0], axis: z, actuated: q, start: 130}
      - {joint: R, name: elbow, at: [150, 0, 0], axis: z, start: 97}
      - {joint: R, name: wrist, at: [170, 0, 0], axis: z, start: -29}
    attach: [60, 0, 0]
    copies: {count: 3}
    errors:
      - {of: elbow, shift: [x, z], tolerance: {sd: 0.1}}
      - {of: wrist, tilt: [rx], tolerance: {sd: 0.02}}
workspace: {x: [-50, 50], y: [-50, 50], yaw: [-10, 10]}
"""
"""A planar machine described in space, with three equal limbs."""

RAILS = """format: 1
family: limbs
name: rails
source: ours
units: {length: mm, angle: deg}
controlled: [z]
limbs:
  - name: left
    ending: rigid
    chain: [{joint: P, name: rail, at: [-100, 0, 0], axis: z, start: 200}]
    attach: [-100, 0, 0]
  - name: right
    ending: rigid
    chain: [{joint: P, name: rail, at: [100, 0, 0], axis: z, start: 200}]
    attach: [100, 0, 0]
  - {name: ram, ending: distance, actuated: q}
home: {z: 200}
"""
"""A table on two parallel rails, moved by a cylinder."""


def close_by_least_squares(text: str) -> str:
    """Return the text with the least-squares closure."""
    return text.replace("controlled:", "closure: least-squares\ncontrolled:")


def solve_exechon(robot: Mechanism, values: Array, q: Array, start: Array) -> Array:
    """Return the platform (4, 4) whose loops stay open least, by scipy and explicit matrices.

    values : (p,), by the names of EXECHON. q : (3,) readings [m]. start : (4, 4) platform.
    """
    v = dict(zip(robot.parameters.names, values.tolist(), strict=True))

    def turn(*vector: float) -> Array:
        return Rotation.from_rotvec(vector).as_matrix()

    def end(limb: str, joint: str, tilt: list[float], angles: Array, length: float) -> list[Array]:
        """Return the rotation and the place of the tip of a limb."""
        foot = np.array([v[f"{limb}.{joint}.{axis}"] for axis in "xyz"])
        swing = angles[:-1]
        rotation = (
            turn(swing[0], 0, 0) @ turn(0, swing[1], 0)
            if limb != "middle"
            else turn(0, 0, swing[0]) @ turn(0, swing[1], 0) @ turn(swing[2], 0, 0)
        )
        place = foot + rotation @ [0, 0, length]
        hinge = [0, angles[-1], 0] if limb != "middle" else [angles[-1], 0, 0]
        return [rotation @ turn(*tilt) @ turn(*hinge), place]

    def gaps(u: Array) -> Array:
        R, p = Rotation.from_rotvec(u[:3]).as_matrix() @ start[:3, :3], u[3:6]
        out = []
        tips = [
            end("left", "gimbal", [v["left.hinge.rx"], 0, v["left.hinge.rz"]], u[6:9],
                q[0] + v["a.offset"]),
            end("right", "gimbal", [v["right.hinge.rx"], 0, v["right.hinge.rz"]], u[9:12],
                q[1] + v["b.offset"]),
            end("middle", "ball", [0, v["middle.hinge.ry"], 0], u[12:16], q[2] + v["c.offset"]),
        ]  # fmt: skip
        for limb, (rotation, place) in zip(("left", "right", "middle"), tips, strict=True):
            attachment = p + R @ [v[f"{limb}.platform.{axis}"] for axis in "xyz"]
            w = Rotation.from_matrix(R @ rotation.T).as_rotvec()
            angle = np.linalg.norm(w)
            out += [robot.size * w * (2 * np.tan(angle / 2) / angle if angle else 1.0)]
            out += [attachment - place]
        return np.concatenate(out)

    slant = np.deg2rad(5.7)
    first = [0, 0, 0, *start[:3, 3], 0, -slant, slant, 0, slant, -slant, 0, 0, -slant, slant]
    found = least_squares(
        gaps, first, jac="3-point", method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(found.x[:3]).as_matrix() @ start[:3, :3]
    T[:3, 3] = found.x[3:6]
    return T


def put_on_wrist(text: str) -> str:
    """Return the text of a chain: the machine of a text as its first stage, and a wrist."""
    kept = [line for line in text.splitlines()[5:] if not line.startswith("workspace")]
    head = "\n".join(f"    {line}" for line in kept)
    return f"""format: 1
family: stages
name: chain
source: ours
units: {{length: mm, angle: deg}}
controlled: [z, phi, theta, psi]
stages:
  - name: head
    family: limbs
{head}
  - name: wrist
    joint: {{kind: R, stroke: [-170, 170], start: 10, errors: [x, offset]}}
tolerances: {{lengths: {{sd: 0.1}}, angles: {{sd: 0.02}}}}
workspace: {{z: [950, 1100], phi: [-180, 180], theta: [1, 10], psi: [-90, 90]}}
"""
