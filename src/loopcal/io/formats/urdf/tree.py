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
from loopcal.io.core.limits import XML_DEPTH, XML_ELEMENTS, XML_JOINTS
from loopcal.io.core.names import find_fault
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.urdf.elements import (
    OpenElement,
    UrdfConstraint,
    UrdfJoint,
    build_constraint,
    build_joint,
)
from loopcal.typing import FloatArray

WHAT = "URDF file"
OTHER_LOOPS = ("loop_joint", "loop")
"""Elements by which other programs close loops in a URDF."""


@dataclass(frozen=True)
class Urdf:
    """A file.

    Attributes
    ----------
    joints : by name. root : the link that no joint carries. carrier : link -> joint that carries
        it. constraints : that close loops. motors : joint -> line, of transmissions.
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

        Raises
        ------
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
