# SPDX-License-Identifier: Apache-2.0
"""A URDF file as a tree of links and joints, with the constraints that close its loops.

A joint's frame is its parent link's frame moved by `<origin xyz rpy>`, rpy about fixed axes (R = Rz
Ry Rx); the child turns about, or slides along, `<axis>` in that frame. Lengths are meters, angles
radians. Source: the specification of URDF's joint element (ROS wiki).

A `<constraint>` joins two links that the tree has placed already: `<parent link>` with
`<parent_origin>` and `<parent_axis>`, `<child link>` with `<child_origin>` and `<child_axis>`.
Source: pull request 264 of ros/urdfdom. Motors may be named by `<transmission>` or
`<ros2_control>`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.limits import XML_DEPTH, XML_ELEMENTS, XML_JOINTS, find_fault
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import parse_number
from loopcal.typing import FloatArray

# Joints and constraints of a URDF, from the attributes of their elements.

SAME_AXIS = 1e-9
"""Difference of two axes that count as the same [1]."""
ROUNDED = 4
"""Decimals from which a number counts as rounded, such as 1.5708 for a right angle."""
KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": ""}
CONSTRAINTS = {
    "fixed": "",
    "link": "",
    "revolute": "R",
    "continuous": "R",
    "spherical": "S",
    "ball": "S",
    "universal": "U",
}
"""Types of a constraint -> the joint that it is; "" for none."""


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint from link `parent` to `child`: R, P, or "" for a fixed one.

    `origin` : (4, 4) T_parent_joint [m]. `axis` : (3,) unit vector. `limits` : [rad or m]. `line`
    : from 1. `start`, `end` : bytes of its origin's tag, -1 without. `mimic` : the joint that it
    follows, factor and offset [rad or m]; None without. `rounding` : error of origin and axis by
    the rounding of their numbers [m, rad].
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
    mimic: tuple[str, float, float] | None = None
    rounding: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class UrdfConstraint:
    """A constraint between two links: R, S, U, or "" for a rigid link that was cut.

    `ends` are its frames on the parent and on the child link, as fixed joints without a child;
    `axes` (3,) unit vectors in each of the frames.
    """

    name: str
    kind: str
    ends: tuple[UrdfJoint, UrdfJoint]
    axes: tuple[FloatArray, FloatArray]
    line: int


@dataclass
class OpenElement:
    """A joint or constraint while it is parsed: attributes of its elements by name, and the bytes
    at which these start.
    """

    name: str
    kind: str
    line: int
    elements: dict[str, dict[str, str]] = field(default_factory=dict)
    starts: dict[str, int] = field(default_factory=dict)


def build_joint(joint: OpenElement, raw: bytes, path: Path) -> UrdfJoint:
    """Return a joint from its elements."""
    name, elements, line = joint.name, joint.elements, joint.line
    if joint.kind not in KINDS:
        sentence = f"joint {name!r} is of type {joint.kind!r}; allowed: {', '.join(KINDS)}"
        raise FileError(sentence, path, line)
    parent, child = _get_links(joint, "joint", path)
    limit, kind = elements.get("limit", {}), KINDS[joint.kind]
    T = _parse_origin(elements.get("origin", {}), f"joint {name!r}", path, line)
    axis = np.array([1.0, 0.0, 0.0])
    if kind:
        axis = _parse_axis(elements.get("axis", {}), f"joint {name!r}", path, line)
    limits = None
    if kind and joint.kind != "continuous" and {"lower", "upper"} <= limit.keys():
        low, high = (
            parse_number(limit[key], f"{key} of joint {name!r}", path, line)
            for key in ("lower", "upper")
        )
        limits = (low, high) if low < high else None
    start, end = _find_tag(joint, "origin", raw)
    mimic = elements.get("mimic")
    followed = None
    if mimic is not None:
        factor, offset = (
            parse_number(mimic.get(key, default), f"{key} of joint {name!r}", path, line)
            for key, default in (("multiplier", "1"), ("offset", "0"))
        )
        followed = mimic.get("joint", ""), factor, offset
    rounding = _measure_rounding(elements, "origin", "axis")
    return UrdfJoint(
        name, kind, parent, child, T, axis, limits, line, start, end, followed, rounding
    )


def build_constraint(constraint: OpenElement, raw: bytes, path: Path) -> UrdfConstraint:
    """Return a constraint from its elements."""
    name, elements, line = constraint.name, constraint.elements, constraint.line
    what = f"constraint {name!r}"
    if constraint.kind.lower() not in CONSTRAINTS:
        sentence = f"{what} is of type {constraint.kind!r}; allowed: {', '.join(CONSTRAINTS)}"
        raise FileError(sentence, path, line)
    kind, links = CONSTRAINTS[constraint.kind.lower()], _get_links(constraint, "constraint", path)
    first, second = (
        UrdfJoint(
            f"{name}_{end}",
            "",
            link,
            "",
            _parse_origin(elements.get(f"{end}_origin", {}), what, path, line),
            np.eye(3)[0],
            None,
            line,
            *_find_tag(constraint, f"{end}_origin", raw),
            None,
            _measure_rounding(elements, f"{end}_origin", f"{end}_axis"),
        )
        for end, link in zip(("parent", "child"), links, strict=True)
    )
    stated = [end for end in ("parent", "child") if f"{end}_axis" in elements]
    needed = {"R": ["parent"], "U": ["parent", "child"]}.get(kind, [])
    if missing := [end for end in needed if end not in stated]:
        sentence = f"{what} is {constraint.kind} and states no axis; add <{missing[0]}_axis xyz=..>"
        raise FileError(sentence, path, line)
    axes = {
        end: _parse_axis(elements[f"{end}_axis"], what, path, line)
        if end in needed
        else np.eye(3)[2]
        for end in ("parent", "child")
    }
    if kind == "R" and "child" in stated:
        other = _parse_axis(elements["child_axis"], what, path, line)
        if np.abs(other - axes["parent"]).max() > SAME_AXIS:
            sentence = f"{what} is {constraint.kind}, but its child_axis is not its parent_axis"
            action = "turn child_origin so that both frames share the axis, or leave child_axis out"
            raise FileError(f"{sentence}; {action}", path, line)
    return UrdfConstraint(name, kind, (first, second), (axes["parent"], axes["child"]), line)


def _measure_rounding(
    elements: Mapping[str, Mapping[str, str]], origin: str, axis: str
) -> tuple[float, float]:
    """Return the units of the last digits of an origin and an axis, as roots of sums of squares.

    Rounding errors are uniform in half a unit, so that this is 3.5 times the standard deviation of
    their sum. A number with fewer than ROUNDED decimals is a dimension that somebody chose, and is
    exact.
    """
    place, direction = elements.get(origin, {}), elements.get(axis, {})
    lengths, angles = (place.get("xyz", ""),), (place.get("rpy", ""), direction.get("xyz", ""))

    def measure(texts: tuple[str, ...]) -> float:
        units = []
        for number in " ".join(texts).lower().split():
            mantissa, _, exponent = number.partition("e")
            decimals = len(mantissa.partition(".")[2]) - float(exponent or 0)
            units.append(10.0**-decimals if decimals >= ROUNDED else 0.0)
        return math.hypot(*units)

    return measure(lengths), measure(angles)


def _find_tag(element: OpenElement, name: str, raw: bytes) -> tuple[int, int]:
    """Return the bytes of the tag of an element inside, -1 without."""
    start = element.starts.get(name, -1)
    return start, raw.index(b">", start) + 1 if start >= 0 else -1


def _get_links(joint: OpenElement, what: str, path: Path) -> tuple[str, str]:
    """Return the links that a joint or constraint names."""
    for needed in ("parent", "child"):
        if not joint.elements.get(needed, {}).get("link"):
            sentence = f"{what} {joint.name!r} names no {needed} link; add <{needed} link=..>"
            raise FileError(sentence, path, joint.line)
    return joint.elements["parent"]["link"], joint.elements["child"]["link"]


def _parse_origin(origin: Mapping[str, str], what: str, path: Path, line: int) -> FloatArray:
    """Return an origin as (4, 4)."""
    xyz = _parse_three(origin.get("xyz", "0 0 0"), f"xyz of {what}", path, line)
    rpy = _parse_three(origin.get("rpy", "0 0 0"), f"rpy of {what}", path, line)
    return geometry.make_pose(geometry.euler_to_matrix(rpy, "xyz"), xyz)


def _parse_axis(axis: Mapping[str, str], what: str, path: Path, line: int) -> FloatArray:
    """Return an axis as unit vector (3,)."""
    vector = _parse_three(axis.get("xyz", "1 0 0"), f"the axis of {what}", path, line)
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise FileError(f"{what} has the axis 0 0 0; write a direction", path, line)
    return vector / length


def _parse_three(text: str, what: str, path: Path, line: int) -> FloatArray:
    """Return three numbers."""
    numbers = text.split()
    if len(numbers) != 3:
        sentence = f"{what} is {text!r}, but three numbers are needed; correct it"
        raise FileError(sentence, path, line)
    return np.array([parse_number(number, what, path, line) for number in numbers])


WHAT = "URDF file"
OTHER_LOOPS = ("loop_joint", "loop")
"""Elements by which other programs close loops in a URDF."""


@dataclass(frozen=True)
class Urdf:
    """A file: joints by name, the link `root` that no joint carries, `carrier` link -> joint that
    carries it, constraints that close loops, and `motors` joint -> line, of transmissions.
    """

    path: Path
    text: str
    joints: Mapping[str, UrdfJoint]
    root: str
    carrier: Mapping[str, UrdfJoint]
    constraints: tuple[UrdfConstraint, ...] = ()
    motors: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def places(self) -> Mapping[str, UrdfJoint]:
        """Joints and the ends of constraints, by name."""
        ends = {end.name: end for constraint in self.constraints for end in constraint.ends}
        return {**ends, **self.joints}

    def error(self, sentence: Any, joint: str) -> FileError:
        """Return an error at the line of a joint."""
        line = self.places[joint].line if joint in self.places else None
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

    def with_fixed(self, names: Collection[str]) -> Urdf:
        """Return the tree with some joints fixed at zero."""
        joints = {
            name: replace(joint, kind="") if name in names else joint
            for name, joint in self.joints.items()
        }
        carrier = {link: joints[joint.name] for link, joint in self.carrier.items()}
        return replace(self, joints=joints, carrier=carrier)

    def with_origin(self, joint: str, origin: FloatArray, turned: bool) -> Urdf:
        """Return the file with another origin of a place; its rpy changes only where it `turned`.
        FileError : the joint has no origin in the text, or the attribute is missing.
        """
        old = self.places[joint]
        if old.start < 0:
            sentence = f"{joint!r} has no origin element; add one with xyz and rpy"
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
            raise self.error(f"the origin of {joint!r} has no {name}; add it", joint)
        text = " ".join(repr(float(v)) for v in values)
        return tag[: match.start(2)] + text + tag[match.end(2) :]


class _Parser:
    """Handlers of expat that collect links and joints."""

    def __init__(self, raw: bytes, path: Path) -> None:
        self.raw, self.path = raw, path
        self.links: list[str] = []
        self.joints: dict[str, UrdfJoint] = {}
        self.constraints: dict[str, UrdfConstraint] = {}
        self.motors: dict[str, int] = {}
        self._commanded = ""
        self._stack: list[str] = []
        self._count = 0
        self._joint: OpenElement | None = None
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
        self._refuse_element(name, attributes, line)
        text = attributes.get("name", "")
        if self._stack == ["robot", "link"]:
            if text in self.links:
                raise FileError(f"duplicate link {text!r}; rename one", self.path, line)
            self.links.append(text)
        elif self._stack in (["robot", "joint"], ["robot", "constraint"]):
            self._joint = OpenElement(text, attributes.get("type", ""), line)
        elif self._joint is not None and len(self._stack) == 3:
            self._joint.elements[name] = attributes
            self._joint.starts[name] = self._expat.CurrentByteIndex
        elif self._stack == ["robot", "transmission", "joint"]:
            self.motors[text] = line
        elif self._stack == ["robot", "ros2_control", "joint"]:
            self._commanded = text
        elif self._stack == ["robot", "ros2_control", "joint", "command_interface"]:
            self.motors[self._commanded] = line

    def _end(self, name: str) -> None:
        del name
        known: Mapping[str, object] = self.joints
        if self._joint is not None and len(self._stack) == 2:
            joint, self._joint = self._joint, None
            what = self._stack[1]
            known = self.joints if what == "joint" else self.constraints
            if joint.name in known:
                sentence = f"duplicate {what} {joint.name!r}; rename one"
                raise FileError(sentence, self.path, joint.line)
            XML_JOINTS.check(len(known) + 1, WHAT, self.path, joint.line)
            if what == "joint":
                self.joints[joint.name] = build_joint(joint, self.raw, self.path)
            else:
                self.constraints[joint.name] = build_constraint(joint, self.raw, self.path)
        self._stack.pop()

    def _refuse_element(self, name: str, attributes: Mapping[str, str], line: int) -> None:
        """Refuse elements whose neglect would give another machine."""
        is_macro = name.startswith("xacro:") or any(v.startswith("${") for v in attributes.values())
        if is_macro and len(self._stack) < 4:
            finding = report_finding("files.urdf-macro", element=name)
            raise FileError(finding, self.path, line)
        if len(self._stack) == 2 and name in OTHER_LOOPS:
            raise FileError(report_finding("files.urdf-other-loop", element=name), self.path, line)

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
    tree = _build_tree(text, path, parser.links, parser.joints)
    constraints = tuple(parser.constraints.values())
    for constraint in constraints:
        for link in (end.parent for end in constraint.ends):
            if link not in parser.links:
                what = f"constraint {constraint.name!r} names the link {link!r}"
                sentence = f"{what}, which does not exist{suggest_names(link, parser.links)}"
                raise FileError(f"{sentence}; correct it", path, constraint.line)
    return replace(tree, constraints=constraints, motors=parser.motors)


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
