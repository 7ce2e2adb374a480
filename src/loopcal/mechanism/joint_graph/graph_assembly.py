# SPDX-License-Identifier: Apache-2.0
"""From links, joints and welded frames to a mechanism: rigid bodies, pins, a tree and its closures.

A weld (a loop that is cut through a rigid link) makes one body of two. Two rotary joints about one
axis that hold a body with nothing else on it are one pin. The tree takes the driven joints first,
then slides, rotary joints, pins and ball joints, so that loops are closed at the joints with the
fewest equations, whose values nobody needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint
from loopcal.mechanism.joint_graph.loop_closure import JointGraph
from loopcal.typing import FloatArray

COAXIAL = 1e-9
"""Difference of two frames or axes that count as the same [m, 1]."""


@dataclass(frozen=True, eq=False)
class Weld:
    """Frames `T_a` and `T_b` (4, 4) of two links that coincide. `name` is for messages."""

    name: str
    body_a: str
    body_b: str
    T_a: FloatArray
    T_b: FloatArray


@dataclass(frozen=True, eq=False)
class Bodies:
    """The rigid bodies that welds make: link -> its body and T_body_link (4, 4)."""

    places: dict[str, tuple[str, FloatArray]]

    def locate(self, link: str) -> tuple[str, FloatArray]:
        """Return the body of a link and T_body_link (4, 4)."""
        return self.places.get(link, (link, np.eye(4)))

    def list_links(self, body: str) -> tuple[str, ...]:
        """Return the links of a body, its own first."""
        return (body, *(link for link, (name, _) in self.places.items() if name == body != link))

    def move(self, joint: GraphJoint) -> GraphJoint:
        """Return a joint between links as one between bodies."""
        (a, A), (b, B) = self.locate(joint.body_a), self.locate(joint.body_b)
        return replace(joint, body_a=a, body_b=b, T_a=A @ joint.T_a, T_b=B @ joint.T_b)


def weld_bodies(base: str, welds: Sequence[Weld]) -> Bodies:
    """Return the rigid bodies that welds make.

    Raises
    ------
    MechanismError : a weld joins two links that are one rigid body already.
    """
    bodies = Bodies({})
    for weld in welds:
        (a, A), (b, B) = bodies.locate(weld.body_a), bodies.locate(weld.body_b)
        if a == b:
            raise MechanismError(
                report_finding("files.closure-within-body", closure=weld.name, body=a)
            )
        T_ab = A @ weld.T_a @ geometry.invert_pose(B @ weld.T_b)
        if b == base:
            a, b, T_ab = b, a, geometry.invert_pose(T_ab)
        moved = {link: (a, T_ab @ bodies.locate(link)[1]) for link in bodies.list_links(b)}
        bodies = Bodies(bodies.places | moved)
    return bodies


def assemble_graph(base: str, joints: Sequence[GraphJoint], motors: tuple[str, ...]) -> JointGraph:
    """Return the mechanism of joints between bodies.

    Raises
    ------
    MechanismError : a joint joins a body to itself, two join the same points of two bodies, or a
        loop has driven joints only.
    """
    for joint in joints:
        if joint.body_a == joint.body_b:
            raise MechanismError(
                report_finding("files.closure-within-body", closure=joint.name, body=joint.body_a)
            )
    _refuse_repeated(joints)
    tree, closing = _span_tree(base, _merge_pins(base, list(joints), motors), motors)
    lost = next((joint.name for joint in closing if joint.name in motors), None)
    if lost is not None:
        raise MechanismError(report_finding("files.motors-in-loop", motor=lost))
    return JointGraph(base, tree, closing, motors)


def _refuse_repeated(joints: Sequence[GraphJoint]) -> None:
    """Refuse two rotary or ball joints of the same points of two bodies; raises MechanismError."""
    turning = [joint for joint in joints if joint.kind != "P"]
    for i, joint in enumerate(turning):
        for other in turning[:i]:
            if {joint.body_a, joint.body_b} != {other.body_a, other.body_b}:
                continue
            same = other.orient(joint.body_a)
            gaps = (joint.T_a[:3, 3] - same.T_a[:3, 3], joint.T_b[:3, 3] - same.T_b[:3, 3])
            if np.abs(gaps).max() < COAXIAL:
                finding = report_finding(
                    "files.closure-repeated",
                    closure=joint.name,
                    other=other.name,
                    body_a=joint.body_a,
                    body_b=joint.body_b,
                )
                raise MechanismError(finding)


def _merge_pins(
    base: str, joints: list[GraphJoint], motors: tuple[str, ...]
) -> tuple[GraphJoint, ...]:
    """Return the joints, in which two about one axis that hold a body without other joints are one
    pin.
    """
    for body in dict.fromkeys(name for j in joints for name in (j.body_a, j.body_b)):
        ends = [joint for joint in joints if body in (joint.body_a, joint.body_b)]
        if body == base or len(ends) != 2 or not _are_coaxial(body, *ends):
            continue
        first, second = ends
        if {first.name, second.name} & {*motors} or not (first.origin_a and second.origin_a):
            continue
        pin = replace(
            first, body_b=second.body_a, T_b=second.T_a, origin_b=second.origin_a, limits=None
        )
        joints = [joint for joint in joints if joint not in ends]
        joints.append(pin)
    return tuple(joints)


def _are_coaxial(body: str, first: GraphJoint, second: GraphJoint) -> bool:
    """Return whether two rotary joints carry a body at the same frame and axis."""
    if first.kind != "R" or second.kind != "R" or not first.body_b == second.body_b == body:
        return False
    same_frame = np.abs(first.T_b - second.T_b).max() < COAXIAL
    return bool(same_frame and np.abs(first.axis - second.axis).max() < COAXIAL)


def _span_tree(
    base: str, joints: Sequence[GraphJoint], motors: tuple[str, ...]
) -> tuple[tuple[GraphJoint, ...], tuple[GraphJoint, ...]]:
    """Return the joints of a tree, each after the one that carries it, and the other joints."""

    def rank(joint: GraphJoint) -> int:
        if joint.name in motors:
            return 0
        return 3 if joint.is_pin else "PR S".index(joint.kind) + 1

    group = {base: base} | {name: name for j in joints for name in (j.body_a, j.body_b)}
    chosen, closing = [], []
    for joint in sorted(joints, key=rank):
        group_a, group_b = group[joint.body_a], group[joint.body_b]
        (closing if group_a == group_b else chosen).append(joint)
        group = {body: group_a if name == group_b else name for body, name in group.items()}
    chosen = [joint for joint in joints if joint in chosen]
    tree: list[GraphJoint] = []
    bodies = {base}
    while chosen:
        ready = [joint for joint in chosen if {joint.body_a, joint.body_b} & bodies]
        if not ready:
            break  # joints of bodies that nothing joins to the base
        for joint in ready:
            oriented = joint.orient(joint.body_a if joint.body_a in bodies else joint.body_b)
            tree.append(oriented)
            bodies.add(oriented.body_b)
        chosen = [joint for joint in chosen if joint not in ready]
    return tuple(tree), tuple(joint for joint in joints if joint in closing)
