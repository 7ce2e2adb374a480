# SPDX-License-Identifier: Apache-2.0
"""The file of loop closures of a URDF: pairs of revolute joints whose child links coincide.

`closed_loop: [[A, B]]` with `type: ['6d']` makes one pin of the two joints, which turn about the
same axis; `name_mot` lists the motors. This is the convention of the example-parallel-robots
collection.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from loopcal.errors import FileError, MechanismError
from loopcal.io.core.yaml_file import YamlFile, read_yaml
from loopcal.io.formats.urdf_tree import Urdf
from loopcal.mechanism.joint_graph import GraphJoint, JointGraph, find_home

PARALLEL = 1e-9
"""Difference of two axes that count as the same [1]."""


def read_joint_graph(urdf: Urdf, closures: Path) -> JointGraph:
    """Return the mechanism of a URDF with its loops closed.

    Raises
    ------
    FileError : an unknown joint, a closure that is not a pin, or loops that do not close.
    """
    file = read_yaml(closures, "file of loop closures")
    pairs, motors = _read_names(file, urdf)
    ends = {name for pair in pairs for name in pair}
    for name in motors:
        if name not in urdf.joints or not urdf.joints[name].kind or name in ends:
            sentence = f"the motor {name!r} is not a movable joint of {urdf.path.name}; correct it"
            raise file.error(sentence, ("name_mot",))
    if not motors:
        raise file.error("no motor is named; list the driven joints in 'name_mot:'")
    tree = _list_tree_joints(urdf, ends)
    pins = tuple(_build_pin(urdf, one, other) for one, other in pairs)
    values = {joint.name: 0.0 for joint in tree}
    try:
        return find_home(JointGraph(urdf.root, tree, pins, motors, values))
    except MechanismError as error:
        raise FileError(f"{urdf.path.name}: {error}", closures) from None


def _read_names(file: YamlFile, urdf: Urdf) -> tuple[list[tuple[str, str]], tuple[str, ...]]:
    """Return the pairs of joints that close loops, and the motors."""
    pairs, kinds, motors = (file.content.get(k, []) for k in ("closed_loop", "type", "name_mot"))
    lists = isinstance(pairs, list) and isinstance(kinds, list) and isinstance(motors, list)
    is_valid = lists and len(kinds) == len(pairs)
    if not is_valid or any(not isinstance(pair, list) or len(pair) != 2 for pair in pairs):
        sentence = "write 'closed_loop:' as a list of pairs, 'type:' with one entry for each, and"
        raise file.error(f"{sentence} 'name_mot:' as a list")
    for i, (pair, kind) in enumerate(zip(pairs, kinds, strict=True)):
        for name in pair:
            if name not in urdf.joints:
                sentence = f"the closure {name!r} is not a joint of {urdf.path.name}; correct it"
                raise file.error(sentence, ("closed_loop", i))
        if str(kind).lower() != "6d":
            sentence = f"closure {pair[0]!r} is of type {kind!r}, but only '6d' is allowed"
            raise file.error(f"{sentence}, between two revolute joints", ("type", i))
    return [(a, b) for a, b in pairs], tuple(str(name) for name in motors)


def _list_tree_joints(urdf: Urdf, ends: set[str]) -> tuple[GraphJoint, ...]:
    """Return the movable joints of the tree, each after the one that carries it."""
    joints, bodies = [], {urdf.root}
    waiting = [joint for joint in urdf.joints.values() if joint.kind and joint.name not in ends]
    while waiting:
        ready = [joint for joint in waiting if urdf.find_body(joint.parent) in bodies]
        if not ready:
            name = waiting[0].name
            sentence = f"joint {name!r} is carried by a link that a closure holds"
            raise urdf.error(f"{sentence}; close the loop at another joint", name)
        for one in ready:
            body = urdf.find_body(one.parent)
            place = urdf.place_in_body(one.parent) @ one.origin
            joints.append(
                GraphJoint(one.name, one.kind, body, one.child, place, np.eye(4), one.axis)
            )
            bodies.add(one.child)
        waiting = [joint for joint in waiting if joint not in ready]
    return tuple(joints)


def _build_pin(urdf: Urdf, first: str, second: str) -> GraphJoint:
    """Return the pin of two revolute joints whose child links coincide."""
    one, other = urdf.joints[first], urdf.joints[second]
    for joint in (one, other):
        if joint.kind != "R":
            sentence = f"closure joint {joint.name!r} is not revolute, but closures must be"
            raise urdf.error(f"{sentence}; correct it", joint.name)
    if np.abs(one.axis - other.axis).max() > PARALLEL:
        sentence = f"closure joints {first!r} and {second!r} have different axes"
        raise urdf.error(f"{sentence}; give them the same axis", second)
    (a, T_a), (b, T_b) = (
        (urdf.find_body(j.parent), urdf.place_in_body(j.parent) @ j.origin) for j in (one, other)
    )
    return GraphJoint(first, "R", a, b, T_a, T_b, one.axis, is_pin=True, far=second)
