# SPDX-License-Identifier: Apache-2.0
"""A URDF file as a tree of links and joints, and its loop closures.

A joint's frame is its parent link's frame moved by `<origin xyz rpy>`, rpy about fixed axes (R = Rz
Ry Rx); the child turns about, or slides along, `<axis>` in that frame. Lengths are meters, angles
radians. Source: the specification of URDF's joint element (ROS wiki).

A second file closes the loops: `closed_loop: [[A, B]]` with `type: ['6d']` makes one pin of two
revolute joints whose child links coincide, which turn about the same axis; `name_mot` lists the
motors. This is the convention of the example-parallel-robots collection.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError, MechanismError
from loopcal.io.core.limits import XML_DEPTH, XML_ELEMENTS, XML_JOINTS
from loopcal.io.core.names import find_fault
from loopcal.io.core.text_file import read_text
from loopcal.io.core.yaml_file import YamlFile, read_yaml
from loopcal.io.formats.program_format import parse_number
from loopcal.mechanism.joint_graph import GraphJoint, JointGraph, find_home
from loopcal.plain_text import quote
from loopcal.typing import FloatArray

WHAT = "URDF file"
KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": ""}


@dataclass(frozen=True)
class UrdfJoint:
    """A joint.

    Attributes
    ----------
    kind : R, P, or "" for a fixed joint. parent, child : links.
    origin : (4, 4) T_parent_joint [m]. axis : (3,) unit vector. limits : [rad or m].
    line : of the joint, from 1. start, end : bytes of its origin's tag, -1 without.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: FloatArray
    axis: FloatArray
    limits: tuple[float, float] | None
    line: int
    start: int
    end: int


@dataclass(frozen=True)
class Urdf:
    """A file: its text, joints by name, root link, and the joint that carries each other link."""

    path: Path
    text: str
    joints: Mapping[str, UrdfJoint]
    root: str
    carrier: Mapping[str, UrdfJoint]

    def error(self, sentence: Any, joint: str) -> FileError:
        """Return an error at the line of a joint."""
        line = self.joints[joint].line if joint in self.joints else None
        return FileError(sentence, self.path, line)

    def find_body(self, link: str) -> str:
        """Return the rigid body of a link: of links on fixed joints the one nearest to the root."""
        while link in self.carrier and not self.carrier[link].kind:
            link = self.carrier[link].parent
        return link

    def place_in_body(self, link: str) -> FloatArray:
        """Return T_body_link (4, 4) of a link in its rigid body."""
        T = np.eye(4)
        while link in self.carrier and not self.carrier[link].kind:
            T, link = self.carrier[link].origin @ T, self.carrier[link].parent
        return T

    def with_origin(self, joint: str, origin: FloatArray, turned: bool) -> Urdf:
        """Return the file with another origin of a joint; its rpy changes only where it `turned`.

        Raises
        ------
        FileError : the joint has no origin in the text, or the attribute is missing.
        """
        old = self.joints[joint]
        if old.start < 0:
            sentence = f"joint {joint!r} has no <origin>; add one with xyz and rpy"
            raise self.error(sentence, joint)
        raw = self.text.encode()
        tag = raw[old.start : old.end].decode()
        tag = self._replace_attribute(tag, "xyz", origin[:3, 3], joint)
        if turned:
            rpy = geometry.matrix_to_euler(origin[:3, :3], "xyz")
            tag = self._replace_attribute(tag, "rpy", rpy, joint)
        return parse((raw[: old.start] + tag.encode() + raw[old.end :]).decode(), self.path)

    def _replace_attribute(self, tag: str, name: str, values: FloatArray, joint: str) -> str:
        match = re.search(rf"""\s{name}\s*=\s*(["'])(.*?)\1""", tag, re.DOTALL)
        if match is None:
            raise self.error(f"the origin of joint {joint!r} has no {name}; add it", joint)
        text = " ".join(repr(float(v)) for v in values)
        return tag[: match.start(2)] + text + tag[match.end(2) :]


@dataclass
class _OpenJoint:
    """A joint while it is parsed: attributes of its elements by name."""

    name: str
    kind: str
    line: int
    elements: dict[str, dict[str, str]] = field(default_factory=dict)
    start: int = -1


class _Parser:
    """Handlers of expat that collect links and joints."""

    def __init__(self, raw: bytes, path: Path) -> None:
        self.raw, self.path = raw, path
        self.links: list[str] = []
        self.joints: dict[str, UrdfJoint] = {}
        self._stack: list[str] = []
        self._count = 0
        self._joint: _OpenJoint | None = None
        self._expat = expat.ParserCreate()
        self._expat.StartElementHandler = self._start
        self._expat.EndElementHandler = self._end
        self._expat.StartDoctypeDeclHandler = self._refuse_doctype

    def run(self) -> None:
        """Parse the bytes; FileError for text that is not XML."""
        try:
            self._expat.Parse(self.raw, True)
        except expat.ExpatError as error:
            sentence = f"not valid XML ({expat.ErrorString(error.code)}); correct it"
            raise FileError(sentence, self.path, error.lineno) from None

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._stack.append(name)
        self._count += 1
        line = self._expat.CurrentLineNumber
        if self._count > XML_ELEMENTS.count:
            raise XML_ELEMENTS.make_error(WHAT, self.path, line=line)
        if len(self._stack) > XML_DEPTH.count:
            raise XML_DEPTH.make_error(WHAT, self.path, line=line)
        if len(self._stack) < 3 and (fault := find_fault(attributes.get("name", ""))) is not None:
            raise FileError(fault, self.path, line)
        if self._stack == ["robot", "link"]:
            self.links.append(attributes.get("name", ""))
        elif self._stack == ["robot", "joint"]:
            self._joint = _OpenJoint(attributes.get("name", ""), attributes.get("type", ""), line)
        elif self._joint is not None and len(self._stack) == 3:
            self._joint.elements[name] = attributes
            if name == "origin":
                self._joint.start = self._expat.CurrentByteIndex

    def _end(self, name: str) -> None:
        del name
        if self._stack == ["robot", "joint"] and self._joint is not None:
            joint, self._joint = self._joint, None
            if joint.name in self.joints:
                sentence = f"duplicate joint {joint.name!r}; rename one"
                raise FileError(sentence, self.path, joint.line)
            XML_JOINTS.check(len(self.joints) + 1, WHAT, self.path, joint.line)
            self.joints[joint.name] = _build_joint(joint, self.raw, self.path)
        self._stack.pop()

    def _refuse_doctype(self, *_: Any) -> None:
        sentence = "a URDF has no document type; remove <!DOCTYPE ..>"
        raise FileError(sentence, self.path, self._expat.CurrentLineNumber)


def read(path: Path) -> Urdf:
    """Read a URDF; FileError where it is not one."""
    return parse(read_text(path, WHAT), path)


def parse(text: str, path: Path) -> Urdf:
    """Find links and joints; FileError for bad XML, an unknown type of joint, or not one tree."""
    parser = _Parser(text.encode(), path)
    parser.run()
    return _build_tree(text, path, parser.links, parser.joints)


def _build_joint(joint: _OpenJoint, raw: bytes, path: Path) -> UrdfJoint:
    """Return a joint from its elements."""
    name, elements, line = joint.name, joint.elements, joint.line
    if joint.kind not in KINDS:
        sentence = f"joint {name!r} is of type {joint.kind!r}; allowed: {', '.join(KINDS)}"
        raise FileError(sentence, path, line)
    for needed in ("parent", "child"):
        if not elements.get(needed, {}).get("link"):
            sentence = f"joint {name!r} names no {needed} link; add <{needed} link=..>"
            raise FileError(sentence, path, line)
    origin, limit = elements.get("origin", {}), elements.get("limit", {})
    xyz = _parse_three(origin.get("xyz", "0 0 0"), f"xyz of joint {name!r}", path, line)
    rpy = _parse_three(origin.get("rpy", "0 0 0"), f"rpy of joint {name!r}", path, line)
    direction = elements.get("axis", {}).get("xyz", "1 0 0")
    axis = _parse_three(direction, f"the axis of joint {name!r}", path, line)
    kind, length = KINDS[joint.kind], float(np.linalg.norm(axis))
    if kind and not length > 0:
        raise FileError(f"joint {name!r} has the axis 0 0 0; write a direction", path, line)
    limits = None
    if kind and joint.kind != "continuous" and {"lower", "upper"} <= limit.keys():
        low, high = (
            parse_number(limit[key], f"{key} of joint {name!r}", path, line)
            for key in ("lower", "upper")
        )
        limits = (low, high) if low < high else None
    end = raw.index(b">", joint.start) + 1 if joint.start >= 0 else -1
    T = geometry.make_pose(geometry.euler_to_matrix(rpy, "xyz"), xyz)
    parent, child = elements["parent"]["link"], elements["child"]["link"]
    axis = axis / (length or 1.0)
    return UrdfJoint(name, kind, parent, child, T, axis, limits, line, joint.start, end)


def _parse_three(text: str, what: str, path: Path, line: int) -> FloatArray:
    """Return three numbers."""
    numbers = text.split()
    if len(numbers) != 3:
        sentence = f"{what} is {text!r}, but three numbers are needed; correct it"
        raise FileError(sentence, path, line)
    return np.array([parse_number(number, what, path, line) for number in numbers])


def _build_tree(text: str, path: Path, links: list[str], joints: dict[str, UrdfJoint]) -> Urdf:
    """Return the tree of links and joints; FileError where they are not one tree."""
    carrier: dict[str, UrdfJoint] = {}
    known = set(links)
    for joint in joints.values():
        for link in (joint.parent, joint.child):
            if link not in known:
                sentence = f"joint {joint.name!r} names the link {link!r}, which does not exist"
                raise FileError(f"{sentence}; correct it", path, joint.line)
        if joint.child in carrier:
            other = carrier[joint.child].name
            sentence = f"link {joint.child!r} is the child of {other!r} and of {joint.name!r}"
            raise FileError(f"{sentence}, but a URDF is a tree; correct it", path, joint.line)
        carrier[joint.child] = joint
    roots = [link for link in links if link not in carrier]
    if len(roots) != 1:
        sentence = f"this URDF has {len(roots)} root links ({', '.join(roots[:4])}), but one is"
        raise FileError(f"{sentence} needed; join them", path)
    _refuse_cycles(path, links, roots[0], carrier)
    return Urdf(path, text, joints, roots[0], carrier)


def _refuse_cycles(
    path: Path, links: list[str], root: str, carrier: Mapping[str, UrdfJoint]
) -> None:
    """Raise FileError for a link that is not carried by the root, but by itself."""
    carried = {root}
    for start in links:
        chain: dict[str, None] = {}
        link = start
        while link not in carried and link not in chain:
            chain[link] = None
            link = carrier[link].parent
        if link in chain:
            joint = carrier[link]
            sentence = f"joint {joint.name!r} closes a circle of links: {joint.child!r} is carried"
            raise FileError(f"{sentence} by itself; correct its parent", path, joint.line)
        carried |= chain.keys()


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
    pins = tuple(_build_pin(urdf, first, second) for first, second in pairs)
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
    if not is_valid or any(not _is_pair_of_names(pair) for pair in pairs):
        sentence = "write 'closed_loop:' as a list of pairs, 'type:' with one entry for each, and"
        raise file.error(f"{sentence} 'name_mot:' as a list")
    for i, (pair, kind) in enumerate(zip(pairs, kinds, strict=True)):
        for name in pair:
            if not isinstance(name, str) or name not in urdf.joints:
                sentence = f"the closure {quote(name)} is not a joint of {urdf.path.name}"
                raise file.error(f"{sentence}; correct it", ("closed_loop", i))
        if str(kind).lower() != "6d":
            sentence = f"closure {pair[0]!r} is of type {kind!r}, but only '6d' is allowed"
            raise file.error(f"{sentence}, between two revolute joints", ("type", i))
    return [(a, b) for a, b in pairs], tuple(str(name) for name in motors)


def _is_pair_of_names(value: Any) -> bool:
    return isinstance(value, list) and [type(name) for name in value] == [str, str]


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
        for joint in ready:
            body = urdf.find_body(joint.parent)
            place = urdf.place_in_body(joint.parent) @ joint.origin
            joints.append(
                GraphJoint(joint.name, joint.kind, body, joint.child, place, np.eye(4), joint.axis)
            )
            bodies.add(joint.child)
        waiting = [joint for joint in waiting if joint not in ready]
    return tuple(joints)


def _build_pin(urdf: Urdf, first: str, second: str) -> GraphJoint:
    """Return the pin of two revolute joints whose child links coincide."""
    ends = urdf.joints[first], urdf.joints[second]
    for joint in ends:
        if joint.kind != "R":
            sentence = f"closure joint {joint.name!r} is not revolute, but closures must be"
            raise urdf.error(f"{sentence}; correct it", joint.name)
    if np.abs(ends[0].axis - ends[1].axis).max() > PARALLEL:
        sentence = f"closure joints {first!r} and {second!r} have different axes"
        raise urdf.error(f"{sentence}; give them the same axis", second)
    (a, T_a), (b, T_b) = (
        (urdf.find_body(j.parent), urdf.place_in_body(j.parent) @ j.origin) for j in ends
    )
    return GraphJoint(first, "R", a, b, T_a, T_b, ends[0].axis, is_pin=True, far=second)
