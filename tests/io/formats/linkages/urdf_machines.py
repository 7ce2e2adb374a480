# SPDX-License-Identifier: Apache-2.0
"""URDF files of machines that are drawn at home, and a solver of their closures without loopcal.

A machine is a list of joints between bodies, with frames in the base. `write_machine` spans a tree,
in an order that a seed decides, and writes the other joints as closures. `UrdfSolver` reads any
such URDF with xml and yaml, and closes its loops by Newton's method with finite differences.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

BASE, PLATFORM = "base", "platform"
TOOL = (0.02, -0.01, 0.05)
"""Place of the platform frame in its link [m]."""


@dataclass(frozen=True)
class MachineJoint:
    """A joint R, P (about or along z), U (about x, then y) or S of two bodies; T in the base."""

    name: str
    kind: str
    a: str
    b: str
    T: np.ndarray
    is_motor: bool = False


def make_pose(R: np.ndarray, p: ArrayLike) -> np.ndarray:
    """Return a pose (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def make_hexapod(legs: Sequence[str], seed: int = 0) -> list[MachineJoint]:
    """Return a hexapod whose legs are chains such as UPS or RUS, with irregular joint centers.

    The one letter P, or else the first R, is driven.
    """
    rng = np.random.default_rng(seed)
    is_second = np.arange(6) % 2 == 1
    below = np.deg2rad(120) * (np.arange(6) // 2) + np.where(is_second, 0.2, -0.2)
    above = below + np.where(is_second, 0.7, -0.7)
    joints = []
    for k, letters in enumerate(legs):
        foot = np.array([0.5 * np.cos(below[k]), 0.5 * np.sin(below[k]), 0.0])
        head = np.array([0.3 * np.cos(above[k]), 0.3 * np.sin(above[k]), 0.6])
        foot, head = foot + rng.uniform(-0.02, 0.02, 3), head + rng.uniform(-0.02, 0.02, 3)
        knee = foot + np.array([0.0, 0.0, 0.1]) if letters[0] == "P" else foot
        if letters[0] == "R":
            knee = foot + 0.15 * np.array([-np.sin(below[k]), np.cos(below[k]), 0.3])
        along = Rotation.align_vectors([head - knee], [[0.0, 0.0, 1.0]])[0].as_matrix()
        across = Rotation.from_euler("zy", [below[k], np.pi / 2]).as_matrix()
        places = {
            "UPS": [(along, foot), (along, (foot + head) / 2), (along, head)],
            "PUS": [(np.eye(3), foot), (along, knee), (along, head)],
            "RUS": [(across, foot), (along, knee), (along, head)],
        }
        frames = places["PUS" if letters[0] == "P" else "RUS" if letters[0] == "R" else "UPS"]
        bodies = (BASE, f"leg{k + 1}_a", f"leg{k + 1}_b", PLATFORM)
        driven = letters.index("P") if "P" in letters else 0
        for i, (letter, (R, p)) in enumerate(zip(letters, frames, strict=True)):
            name = f"{letter.lower()}{k + 1}_{i + 1}"
            a, b = bodies[i], bodies[i + 1]
            joint = MachineJoint(name, letter, a, b, make_pose(R, p), i == driven)
            joints.append(joint)
    return joints


def write_machine(
    joints: Sequence[MachineJoint], seed: int | None = None, has_constraints: bool = False
) -> tuple[str, str]:
    """Return a URDF and its closure file.

    The tree grows from the base in the order of the joints, or in a random one. Other joints are
    closures: of type 3d at ball joints, else of type 6d between a link that the joint moves and a
    frame on the other body. With `has_constraints`, they are <constraint> elements, save slides.
    """
    order = list(joints)
    if seed is not None:
        np.random.default_rng(seed).shuffle(order)  # type: ignore[arg-type]
    frames, text, closures, kinds = {BASE: np.eye(4)}, [], [], []
    overrides: dict[str, str] = {}
    links = [BASE]
    waiting = sorted(order, key=lambda j: not j.is_motor) if seed is not None else order
    while True:
        ready = [j for j in waiting if (j.a in frames) != (j.b in frames)]
        if not ready:
            break
        joint = ready[0]
        parent, child = (joint.a, joint.b) if joint.a in frames else (joint.b, joint.a)
        text.append(_write_joint(joint, parent, child, frames[parent], overrides))
        frames[child] = joint.T
        links.append(child)
        waiting = [j for j in waiting if j is not joint]
    for joint in waiting:
        if has_constraints and joint.kind != "P":
            text.append(write_constraint(joint, frames))
            continue
        near, far = f"{joint.name}_near", f"{joint.name}_far"
        links += [near, far]
        carrier = joint.a
        if joint.kind != "S":
            carrier = f"{joint.name}_moved"
            links.append(carrier)
            text.append(_write_joint(joint, joint.a, carrier, frames[joint.a], overrides))
            frames[carrier] = joint.T
        for link, on in ((near, carrier), (far, joint.b)):
            place = np.linalg.inv(frames[on]) @ joint.T
            text.append(write_element(f"{link}_frame", "fixed", on, link, place))
        closures.append([near, far])
        kinds.append("3d" if joint.kind == "S" else "6d")
    links.append("tool")
    text.append(write_element("tool_frame", "fixed", PLATFORM, "tool", make_pose(np.eye(3), TOOL)))
    names = "".join(f'<link name="{link}"/>\n' for link in links)
    urdf = f'<robot name="machine">\n{names}{"".join(text)}</robot>\n'
    motors = [joint.name for joint in joints if joint.is_motor]
    closing = f"closed_loop: {closures}\ntype: {kinds}\nname_mot: {motors}\n"
    replaced = f"joint_name: {list(overrides)}\njoint_type: {list(overrides.values())}\n"
    return urdf, closing + replaced


def _write_joint(
    joint: MachineJoint, parent: str, child: str, frame: np.ndarray, overrides: dict[str, str]
) -> str:
    """Return a joint of the tree; a reversed one has the opposite axis, so that values agree."""
    is_reversed = parent != joint.a
    if joint.kind in "US":
        universal = "UJOINT_YX" if is_reversed else "UJOINT_XY"
        overrides[joint.name] = universal if joint.kind == "U" else "SPHERICAL"
    kind = "prismatic" if joint.kind == "P" else "revolute"
    axis = "0 0 -1" if is_reversed else "0 0 1"
    place = np.linalg.inv(frame) @ joint.T
    return write_element(joint.name, kind, parent, child, place, axis)


def write_constraint(joint: MachineJoint, frames: dict[str, np.ndarray]) -> str:
    """Return a joint as a <constraint>."""
    kind = {"R": "revolute", "S": "spherical", "U": "universal"}[joint.kind]
    axes = {"R": ("0 0 1", None), "S": (None, None), "U": ("1 0 0", "0 1 0")}[joint.kind]
    lines = [f'<constraint name="{joint.name}" type="{kind}">\n']
    for end, body, axis in zip(("parent", "child"), (joint.a, joint.b), axes, strict=True):
        origin = write_origin(f"{end}_origin", np.linalg.inv(frames[body]) @ joint.T)
        lines.append(f'  <{end} link="{body}"/>\n  {origin}\n')
        lines += [] if axis is None else [f'  <{end}_axis xyz="{axis}"/>\n']
    return "".join([*lines, "</constraint>\n"])


def write_origin(element: str, T: np.ndarray) -> str:
    """Return an origin."""
    xyz = " ".join(repr(float(v)) for v in T[:3, 3])
    with warnings.catch_warnings():  # of a pitch of 90 degrees, where one of many is as good
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    rpy = " ".join(repr(float(v)) for v in angles)
    return f'<{element} xyz="{xyz}" rpy="{rpy}"/>'


def write_element(
    name: str, kind: str, parent: str, child: str, T: np.ndarray, axis: str = "0 0 1"
) -> str:
    """Return a <joint>."""
    return (
        f'<joint name="{name}" type="{kind}">\n  {write_origin("origin", T)}\n'
        f'  <parent link="{parent}"/>\n  <child link="{child}"/>\n'
        f'  <axis xyz="{axis}"/>\n</joint>\n'
    )


class UrdfSolver:
    """Closes the loops of a URDF; an implementation of its own, for comparison."""

    def __init__(self, urdf: Path, closures: Path | None) -> None:
        self.root = ET.fromstring(urdf.read_text())
        content = {} if closures is None else YAML(typ="safe").load(closures.read_text())
        self.pairs = content.get("closed_loop", [])
        self.kinds = [str(kind).lower() for kind in content.get("type", [])]
        self.motors = content.get("name_mot", [])
        self.overrides = dict(
            zip(content.get("joint_name", []), content.get("joint_type", []), strict=True)
        )
        self.joints = {joint.attrib["name"]: joint for joint in self.root.findall("joint")}
        self.columns: dict[str, slice] = {}
        n = 0
        for name, joint in self.joints.items():
            kind: str = self.overrides.get(name, joint.attrib["type"])
            width = {"SPHERICAL": 3, "FIXED": 0, "fixed": 0}.get(kind, 2 if "UJ" in kind else 1)
            self.columns[name] = slice(n, n + width)
            n += width
        self.values = np.zeros(n)
        driven = [i for name in self.motors for i in range(n)[self.columns[name]]]
        self.driven, self.free = np.array(driven), np.setdiff1d(np.arange(n), driven)
        self.order, self.root_link = self._order_joints()
        self.origins = {name: read_origin(j.find("origin")) for name, j in self.joints.items()}

    def _order_joints(self) -> tuple[list[tuple[str, str, str]], str]:
        """Return (name, parent, child) of all joints, each after its parent, and the root link."""
        ends = {n: (find_link(j, "parent"), find_link(j, "child")) for n, j in self.joints.items()}
        children = {child for _, child in ends.values()}
        links = [link.attrib["name"] for link in self.root.findall("link")]
        root = next(link for link in links if link not in children)
        order: list[tuple[str, str, str]] = []
        placed, left = {root}, dict(ends)
        while left:
            for name, (parent, child) in list(left.items()):
                if parent in placed:
                    order.append((name, parent, child))
                    placed.add(child)
                    del left[name]
        return order, root

    def place(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return the poses (..., 4, 4) of all links in the base at joint values (..., n)."""
        T = {self.root_link: np.eye(4)}
        for name, parent, child in self.order:
            motion = self._move(name, self.joints[name], values[..., self.columns[name]])
            T[child] = T[parent] @ self.origins[name] @ motion
        return T

    def _move(self, name: str, joint: ET.Element, value: np.ndarray) -> np.ndarray:
        kind: str = self.overrides.get(name, joint.attrib["type"])
        motion = np.tile(np.eye(4), (*value.shape[:-1], 1, 1))
        if not value.shape[-1]:
            return motion
        axis = read_vector(joint.find("axis"), (1.0, 0.0, 0.0))
        axis /= np.linalg.norm(axis)
        if kind == "SPHERICAL":
            motion[..., :3, :3] = Rotation.from_rotvec(value).as_matrix()
        elif "UJOINT" in kind:
            motion[..., :3, :3] = Rotation.from_euler(kind[-2:], value).as_matrix()
        elif kind == "prismatic":
            motion[..., :3, 3] = value * axis
        else:
            motion[..., :3, :3] = Rotation.from_rotvec(value * axis).as_matrix()
        return motion

    def _residual(self, values: np.ndarray) -> np.ndarray:
        """Return how far the loops are from closed (..., e), at joint values (..., n)."""
        T = self.place(values)
        T = {link: np.broadcast_to(one, (*values.shape[:-1], 4, 4)) for link, one in T.items()}
        parts = []
        for pair, kind in zip(self.pairs, self.kinds, strict=True):
            A, B = (T[find_link(self.joints[n], "child") if n in self.joints else n] for n in pair)
            parts.append(A[..., :3, 3] - B[..., :3, 3])
            if kind == "6d":
                parts.append(measure_turn(A, B))
        for constraint in self.root.findall("constraint"):
            A, B = (
                T[find_link(constraint, end)] @ read_origin(constraint.find(f"{end}_origin"))
                for end in ("parent", "child")
            )
            parts.append(A[..., :3, 3] - B[..., :3, 3])
            R = A[..., :3, :3].swapaxes(-1, -2) @ B[..., :3, :3]
            first, second = (
                read_vector(constraint.find(f"{end}_axis"), (0.0, 0.0, 1.0))
                for end in ("parent", "child")
            )
            if constraint.get("type") == "fixed":
                parts.append(measure_turn(A, B))
            elif constraint.get("type") == "revolute":
                parts.append(np.cross(first, R @ first))
            elif constraint.get("type") == "universal":
                parts.append((R @ second @ first)[..., None])
        return np.concatenate(parts, axis=-1)

    def solve(self, q: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """Return all joint values with the motors at q, with idle motions as at the start."""
        values = np.zeros(len(self.values)) if start is None else start.copy()
        values[self.driven] = q
        step = 1e-7
        steps = step * np.eye(len(values))[self.free]
        r = self._residual(values)
        for _ in range(25):
            if np.abs(r).max() < 1e-14:
                break
            J = (self._residual(values + steps) - r).T / step
            values[self.free] -= np.linalg.lstsq(J, r, rcond=1e-6)[0]
            r = self._residual(values)
        assert np.abs(r).max() < 1e-11  # [m, rad]
        return values

    def forward(self, q: np.ndarray, link: str, start: np.ndarray | None = None) -> np.ndarray:
        """Return the pose of a link with the motors at q."""
        return self.place(self.solve(q, start))[link]


def find_link(element: ET.Element, end: str) -> str:
    """Return the link of an end of a joint or constraint."""
    found = element.find(end)
    assert found is not None
    return found.attrib["link"]


def measure_turn(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) [rad] between poses (..., 4, 4)."""
    R = A[..., :3, :3].swapaxes(-1, -2) @ B[..., :3, :3]
    return Rotation.from_matrix(R).as_rotvec()


def read_origin(origin: ET.Element | None) -> np.ndarray:
    """Return an origin as (4, 4)."""
    if origin is None:
        return np.eye(4)
    xyz, rpy = (
        np.array([float(v) for v in origin.get(k, "0 0 0").split()]) for k in ("xyz", "rpy")
    )
    return make_pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def read_vector(element: ET.Element | None, default: tuple[float, float, float]) -> np.ndarray:
    """Return the xyz of an element."""
    xyz = None if element is None else element.get("xyz")
    return np.array(default if xyz is None else [float(v) for v in xyz.split()])
