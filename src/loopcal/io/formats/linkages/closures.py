# SPDX-License-Identifier: Apache-2.0
"""The mechanism of a file: its tree, its own constraints, and the closures of a YAML file.

`closed_loop: [[A, B]]` names frames: links, or joints, which mean the links that they carry. With
`type: ['6d']` the two frames coincide (a cut through a rigid link, or through a pin that two
revolute joints describe), with `5d` their origins and z axes do (a pin), with `3d` their origins
do (a ball joint). `name_mot` lists the motors.
`joint_name` and `joint_type` replace joints of the tree: SPHERICAL by a ball joint, UJOINT_XY by a
rotary joint about x, then one about y of the joint's frame, FIXED by none. This is the dialect of
the example-parallel-robots collection.

`closures: [{link_a, link_b, point, axis}]` are pins: point and axis are in the root link with all
joints at zero; `independent` lists the motors. This is the dialect of scikit-robot.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any, Literal

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError, MechanismError, suggest_names
from loopcal.io.core.yaml_file import YamlFile, read_yaml, refuse_unknown_keys
from loopcal.io.formats.linkages.tree import (
    Constraint,
    LinkTree,
    TreeJoint,
    derive_end,
    draw_links,
    make_end,
    require_links,
)
from loopcal.mechanism.joint_graph import paths
from loopcal.mechanism.joint_graph.graph import Coupling, GraphJoint, list_axes_across, turn_between
from loopcal.mechanism.joint_graph.loops import JointGraph
from loopcal.mechanism.joint_graph.paths import Bodies, Weld
from loopcal.plain_text import quote
from loopcal.typing import FloatArray

WHAT = "file of loop closures"
KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
PINS = ("closures", "independent", "dependent")
"""Keys of a file, and those of a file of scikit-robot."""

SPHERICAL = "SPHERICAL"
OVERRIDES = (SPHERICAL, "FIXED", *(f"UJOINT_{a}{b}" for a, b in permutations("XYZ", 2)))
"""Types by which a closure file replaces joints."""

WELD, PIN, BALL = "6d", "5d", "3d"

BALL_NAME = "_ball"
"""Ending of the name of a ball joint at the origin of a movable joint, which has its own name."""


@dataclass(frozen=True)
class Closures:
    """The content of a closure file: pairs of frames with their kinds (WELD, PIN or BALL), driven
    joints, joint -> type of OVERRIDES, and pins.
    """

    file: YamlFile | None = None
    pairs: tuple[tuple[str, str], ...] = ()
    kinds: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    overrides: Mapping[str, str] = field(default_factory=dict)
    pins: tuple[Constraint, ...] = ()


@dataclass(frozen=True)
class Linkage:
    """A file with its loops closed, as a graph of bodies and joints.

    `bodies` are the rigid bodies that closures make of links, `frames` links that close loops
    only, `couplings` those that neither the loops nor a drive express, `rigid_closures` the frames
    of the closures of type 6d at whose ends no joint moves.
    """

    tree: LinkTree
    graph: JointGraph
    bodies: Bodies
    frames: frozenset[str]
    couplings: tuple[Coupling, ...] = ()
    rigid_closures: tuple[str, ...] = ()

    def locate(self, link: str) -> tuple[str, FloatArray]:
        """Return the rigid body of a link, and T_body_link (4, 4)."""
        body, T = self.bodies.locate(self.tree.find_body(link))
        return body, T @ self.tree.place_in_body(link)

    def measure_rounding(self, bodies: Collection[str]) -> tuple[float, float]:
        """Return the rounding error of all origins that join or are on bodies [m, rad]."""
        ends = [end for constraint in self.tree.constraints for end in constraint.ends]
        chosen = [
            *(j for j in self.tree.joints.values() if self.locate(j.child)[0] in bodies),
            *(end for end in ends if self.locate(end.parent)[0] in bodies),
        ]
        return math.hypot(*(j.rounding[0] for j in chosen)), math.hypot(
            *(j.rounding[1] for j in chosen)
        )

    def list_links(self, body: str) -> tuple[str, ...]:
        """Return the links of a rigid body."""
        links = (self.tree.root, *self.tree.carrier)
        return tuple(link for link in links if self.locate(link)[0] == body)


def read_mechanism(tree: LinkTree, path: Path | None) -> Linkage:
    """Return the mechanism of a URDF with its closures.

    FileError : an unknown frame or joint, a closure of a rigid body with itself, a motor that is
    not a movable joint.
    """
    closures = Closures() if path is None else _read_closures(path, tree)
    fixed = {name for name, kind in closures.overrides.items() if kind == "FIXED"}
    tree = tree.with_joints(replace(tree.joints[name], kind="") for name in fixed)
    tree = replace(tree, constraints=(*tree.constraints, *closures.pins))
    motors = closures.motors or tuple(tree.motors)
    welds, balls = [], []
    for i, (pair, kind) in enumerate(zip(closures.pairs, closures.kinds, strict=True)):
        closure = _build_closure(tree, closures, i, pair, kind)
        (welds if isinstance(closure, Weld) else balls).append(closure)
    _check_motors(tree, closures, motors)
    constraints = [_build_constraint(tree, constraint) for constraint in tree.constraints]
    welds += [closure for group in constraints for closure in group if isinstance(closure, Weld)]
    # a ball joint at the origin of a movable joint has no origin of its own to shift
    centers = {
        joint.body_a if not joint.origin_a else joint.body_b
        for joint in balls
        if not (joint.origin_a and joint.origin_b)
    }
    joints = [
        *(
            replace(joint, shifts="xyz") if joint.body_b in centers else joint
            for joint in _list_joints(tree, closures.overrides)
        ),
        *balls,
        *(closure for group in constraints for closure in group if isinstance(closure, GraphJoint)),
    ]
    links = [_find_link(tree, name) for pair in closures.pairs for name in pair]
    ends = frozenset(link for link in links if link is not None)
    try:
        bodies = paths.weld_bodies(tree.root, welds)
        graph = paths.assemble_graph(tree.root, [bodies.move(joint) for joint in joints], motors)
        known = tree.joints.values()
        couplings = [Coupling(j.name, *j.mimic) for j in known if j.mimic is not None and j.kind]
        graph, left = paths.couple_joints(graph, couplings)
    except MechanismError as error:
        # at the line of the closure that the error names
        finding = error.finding
        name = "" if finding is None else finding.data.get("closure", "")
        frame = name.removesuffix(BALL_NAME)
        at = [i for i, pair in enumerate(closures.pairs) if frame == pair[0]]
        at = at or [i for i, pair in enumerate(closures.pairs) if frame in pair]
        if at and closures.file is not None:
            raise closures.file.error(finding, ("closed_loop", at[-1])) from None
        lines = {constraint.name: constraint.line for constraint in tree.constraints}
        line = lines.get(name) or (tree.joints[name].line if name in tree.joints else None)
        raise FileError(error.args[0], tree.path, line) from None
    rigid = []
    # a pin is a closure of type 6d only where a revolute joint carries one of its frames
    for pair, kind in zip(closures.pairs, closures.kinds, strict=True):
        joints_at = [tree.carrier.get(_find_link(tree, name) or "") for name in pair]
        if kind == WELD and not any(joint is not None and joint.kind for joint in joints_at):
            rigid.append(f"{pair[0]}, {pair[1]}")
    return Linkage(tree, graph, bodies, ends, left, tuple(rigid))


def _read_closures(path: Path, tree: LinkTree) -> Closures:
    """Return the content of a closure file."""
    file = read_yaml(path, WHAT)
    if PINS[0] in file.content:
        refuse_unknown_keys(file, tuple(file.content), PINS)
        motors = file.content.get("independent", [])
        _check_lists(file, [], [], motors)
        return Closures(file, motors=tuple(map(str, motors)), pins=_read_pins(file, tree))
    refuse_unknown_keys(file, tuple(file.content), KEYS)
    pairs, kinds, motors, names, types = (file.content.get(key, []) for key in KEYS)
    _check_lists(file, pairs, kinds, motors)
    for i, kind in enumerate(kinds):
        if str(kind).lower() not in (WELD, PIN, BALL):
            sentence = f"closure {pairs[i][0]!r} is of type {quote(str(kind))}. Allowed: 6d (the"
            sentence += " frames coincide), 5d (their z axes do), 3d (their origins do)"
            raise file.error(sentence, ("type", i))
    return Closures(
        file,
        tuple((a, b) for a, b in pairs),
        tuple(str(kind).lower() for kind in kinds),
        tuple(str(name) for name in motors),
        _read_overrides(file, names, types, tree),
    )


def _check_lists(file: YamlFile, pairs: Any, kinds: Any, motors: Any) -> None:
    """Refuse closures, types and motors that are no lists, or do not belong together."""
    for key, value in zip(KEYS, (pairs, kinds, motors), strict=False):
        if not isinstance(value, list):
            raise file.error(f"{key!r} is {quote(str(value))}, but must be a list", (key,))
    for i, pair in enumerate(pairs):
        if not isinstance(pair, list) or [type(name) for name in pair] != [str, str]:
            sentence = f"closure {i + 1} is {quote(str(pair))}, but must be the names of two frames"
            raise file.error(f"{sentence}: [A, B]", ("closed_loop", i))
    if len(kinds) != len(pairs):
        sentence = f"'closed_loop' has {len(pairs)} pairs, but 'type' has {len(kinds)} entries"
        raise file.error(f"{sentence}. Write 6d or 3d for each pair", ("type",))


def find_closures(path: Path) -> Path | None:
    """Return the file of loop closures beside a file: of its name, or that of scikit-robot. It has
    a key of a closure file, or one that is almost `closed_loop`.
    """
    for beside in (path.with_suffix(".yaml"), path.with_name("loop_closures.yaml")):
        if beside != path and beside.is_file():
            keys = [str(key) for key in read_yaml(beside, WHAT).content]
            if any(key in (*KEYS, *PINS) or suggest_names(key, KEYS[:1]) for key in keys):
                return beside
    return None


def _read_pins(file: YamlFile, tree: LinkTree) -> tuple[Constraint, ...]:
    """Return the pins of a file of scikit-robot."""
    entries, drawn, pins = file.content[PINS[0]], draw_links(tree), []
    listed: list[Any] = entries if isinstance(entries, list) else [None]
    for i, entry in enumerate(listed):
        place = (PINS[0], i)
        if not isinstance(entry, dict) or not {"link_a", "link_b", "point", "axis"} <= {*entry}:
            sentence = f"closure {i + 1} needs link_a, link_b, point and axis. Write all four"
            raise file.error(sentence, place)
        links, vectors = (str(entry["link_a"]), str(entry["link_b"])), []
        require_links(drawn, f"closure {i + 1}", links, partial(file.error, location=place))
        for key in ("point", "axis"):
            numbers = entry[key] if isinstance(entry[key], list) else []
            if [type(v) in (int, float) for v in numbers] != [True] * 3:
                sentence = f"{key} of closure {i + 1} must be three numbers. Correct it"
                raise file.error(sentence, place)
            vectors.append(np.array(numbers, dtype=np.float64))
        point, axis = vectors
        if not np.linalg.norm(axis) > 0:
            raise file.error(f"closure {i + 1} has the axis 0 0 0. Write a direction", place)
        name, frame = "_".join(links), geometry.make_pose(np.eye(3), point)
        ends = [
            make_end(name, end, link, derive_end(drawn, link, tree.root, frame), 0)
            for end, link in zip(("parent", "child"), links, strict=True)
        ]
        axis = axis / np.linalg.norm(axis)
        pins.append(Constraint(name, "R", (ends[0], ends[1]), (axis, axis), 0, derived=True))
    return tuple(pins)


def _read_overrides(file: YamlFile, names: Any, types: Any, tree: LinkTree) -> dict[str, str]:
    """Return joint -> type of the joints that a closure file replaces."""
    if not isinstance(names, list) or not isinstance(types, list) or len(names) != len(types):
        sentence = "'joint_name:' and 'joint_type:' must be lists of equal length. Correct them"
        raise file.error(sentence, ("joint_name",))
    overrides: dict[str, str] = {}
    for i, (name, kind) in enumerate(zip(map(str, names), map(str, types), strict=True)):
        if name not in tree.joints or not tree.joints[name].kind:
            near = suggest_names(name, [n for n, joint in tree.joints.items() if joint.kind])
            sentence = f"{quote(name)} is not a movable joint of {tree.path.name}{near}"
            raise file.error(f"{sentence}. Correct it", ("joint_name", i))
        if kind.upper() not in OVERRIDES:
            sentence = f"cannot replace joint {name!r} by {quote(kind)}. Allowed: "
            raise file.error(sentence + ", ".join(OVERRIDES), ("joint_type", i))
        if name in overrides:
            raise file.error(f"two entries replace joint {name!r}. Remove one", ("joint_name", i))
        overrides[name] = kind.upper()
    return overrides


def _check_motors(tree: LinkTree, closures: Closures, motors: Sequence[str]) -> None:
    """Refuse motors that are no movable joints of the tree."""
    ends = {name for pair in closures.pairs for name in pair}
    for i, name in enumerate(motors):
        if name in motors[:i] and closures.file is not None:
            raise closures.file.error(f"motor {name!r} occurs twice. Remove one", ("name_mot", i))
        joint = tree.joints.get(name)
        if joint is not None and joint.kind and name not in ends | {*closures.overrides}:
            continue
        near = suggest_names(name, [n for n, joint in tree.joints.items() if joint.kind])
        reason = f"is not a movable joint of {tree.path.name}{near}"
        if name in ends:
            reason = f"is not a movable joint of {tree.path.name} that a motor can drive: it closes"
            reason += " a loop"
        elif name in closures.overrides:
            reason = "is not a movable joint that a motor can drive: joint_type replaces it"
        sentence = f"the motor {quote(name)} {reason}. Correct it"
        if closures.file is None or name not in closures.motors:
            raise FileError(sentence, tree.path, tree.motors.get(name))
        raise closures.file.error(sentence, ("name_mot", i))
    if not motors:
        sentence = "the list of motors is empty. List the driven joints in 'name_mot:'"
        if closures.file is not None:
            raise closures.file.error(sentence)
        raise FileError(f"{sentence} of a YAML file in its folder", tree.path)


def _find_link(tree: LinkTree, name: str) -> str | None:
    """Return the link of a frame: a link, or the one that a joint carries; None where unknown."""
    if name in tree.joints:
        return tree.joints[name].child
    return name if name in tree.carrier or name == tree.root else None


def _build_closure(
    tree: LinkTree, closures: Closures, i: int, pair: tuple[str, str], kind: str
) -> Weld | GraphJoint:
    """Return one closure of the YAML file."""
    file = closures.file
    assert file is not None
    if pair[0] == pair[1]:
        sentence = f"closure {i + 1} names the frame {pair[0]!r} twice. Name two frames"
        raise file.error(sentence, ("closed_loop", i))
    ends: list[tuple[str, FloatArray, str]] = []
    for name in pair:
        link = _find_link(tree, name)
        if link is None:
            near = suggest_names(name, [*tree.joints, *tree.carrier])
            sentence = f"the closure {quote(name)} is not a joint or link of {tree.path.name}"
            raise file.error(f"{sentence}{near}. Correct it", ("closed_loop", i))
        carrier = tree.carrier.get(link)
        origin = carrier.name if carrier is not None and not carrier.kind else ""
        ends.append((tree.find_body(link), tree.place_in_body(link), origin))
    (a, T_a, near), (b, T_b, far) = ends
    if kind == WELD:
        return Weld(pair[0], a, b, T_a, T_b)
    name = pair[0] + BALL_NAME if pair[0] in tree.joints else pair[0]
    z = np.eye(3)[2]
    if kind == PIN:
        return GraphJoint(name, "R", a, b, T_a, T_b, z, near, far, "xy")
    return GraphJoint(name, "S", a, b, T_a, T_b, z, near, far)


def _build_constraint(tree: LinkTree, constraint: Constraint) -> tuple[Weld | GraphJoint, ...]:
    """Return a `<constraint>` of the URDF; a universal one has a body between its two joints."""
    (a, A), (b, B) = (
        (tree.find_body(end.parent), tree.place_in_body(end.parent) @ end.origin)
        for end in constraint.ends
    )
    near, far = (end.name for end in constraint.ends)
    name, (first, second) = constraint.name, constraint.axes
    if not constraint.kind:
        return (Weld(name, a, b, A, B),)
    if constraint.kind != "U":
        kind: Literal["R", "P", "S"] = constraint.kind  # type: ignore[assignment]
        shifts = "xyz" if kind == "S" else list_axes_across(first)
        return (GraphJoint(name, kind, a, b, A, B, first, near, far, shifts),)
    # the cross: at value zero the second axis is turned across the first
    cross = f"cross of {name}"
    across = geometry.find_perpendicular(first, second)
    turn = geometry.make_pose(turn_between(second, across), np.zeros(3))
    return (
        GraphJoint(f"{name}_1", "R", a, cross, A, np.eye(4), first, near),
        GraphJoint(f"{name}_2", "R", cross, b, turn, B, second, "", far),
    )


def _list_joints(tree: LinkTree, overrides: Mapping[str, str]) -> Iterator[GraphJoint]:
    """Yield the movable joints of the tree, with those that the closure file replaces."""
    for joint in tree.joints.values():
        if not joint.kind:
            continue
        axes = {"S": np.eye(3)[::-1], "U": np.array([joint.axis, joint.axis_2])}.get(joint.kind)
        if kind := overrides.get(joint.name, ""):
            axes = np.eye(3)[["XYZ".index(a) for a in ("ZYX" if kind == SPHERICAL else kind[-2:])]]
        yield from [_make_joint(tree, joint)] if axes is None else _split(tree, joint, axes)


def _make_joint(tree: LinkTree, joint: TreeJoint) -> GraphJoint:
    """Return a joint of the tree."""
    kind: Literal["R", "P"] = "R" if joint.kind == "R" else "P"
    return GraphJoint(
        joint.name,
        kind,
        tree.find_body(joint.parent),
        joint.child,
        tree.place_in_body(joint.parent) @ joint.origin,
        np.eye(4),
        joint.axis,
        joint.name if joint.shifts else "",
        shifts=list_axes_across(joint.axis),
        limits=joint.limits,
    )


def _split(tree: LinkTree, joint: TreeJoint, axes: FloatArray) -> Iterator[GraphJoint]:
    """Yield rotary joints about axes (a, 3) by which one joint is replaced: of a ball z, y, x."""
    first = _make_joint(tree, joint)
    body, bodies = first.body_a, [f"cross {i + 1} of {joint.name}" for i in range(len(axes) - 1)]
    for i, (axis, after) in enumerate(zip(axes, [*bodies, first.body_b], strict=True)):
        name = "XYZ"[int(axis.argmax())] if axis.max() == 1.0 else str(i + 1)
        yield replace(
            first,
            name=f"{joint.name}_{name}",
            kind="R",
            body_a=body,
            body_b=after,
            T_a=first.T_a if i == 0 else np.eye(4),
            axis=axis,
            origin_a=first.origin_a if i == 0 else "",
            shifts="xyz",
            limits=None,
        )
        body = after
