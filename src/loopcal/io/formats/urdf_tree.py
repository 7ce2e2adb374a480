# SPDX-License-Identifier: Apache-2.0
"""A URDF file as a tree of links and joints that knows where each joint's origin stands in the
text.

A joint's frame is its parent link's frame moved by `<origin xyz rpy>`, rpy about fixed axes (R = Rz
Ry Rx); the child turns about, or slides along, `<axis>` in that frame. Lengths are metres, angles
radians. Source: the specification of URDF's joint element (ROS wiki).
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
from loopcal.errors import FileError
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import number
from loopcal.typing import FloatArray

KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": ""}


@dataclass(frozen=True)
class UrdfJoint:
    """A joint; `origin` is (4, 4) T_parent_joint [m], `axis` (3,) a unit vector, `limits` [rad or
    m].

    Attributes
    ----------
    kind : R, P, or nothing for a fixed joint. line : of the joint, from 1. start, end : bytes of
        its origin's tag, -1 without.
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

    def moved(self, value: float) -> FloatArray:
        """(4, 4) T_parent_child at a joint value [rad or m]."""
        R, t = np.eye(3), np.zeros(3)
        if self.kind == "R":
            R = geometry.exp_so3(value * self.axis)
        elif self.kind == "P":
            t = value * self.axis
        return self.origin @ geometry.make_pose(R, t)


@dataclass(frozen=True)
class Urdf:
    """A file: its text, joints by name in its order, and its links with the joint that carries
    each.
    """

    path: Path
    text: str
    joints: Mapping[str, UrdfJoint]
    root: str
    carrier: Mapping[str, UrdfJoint]

    def error(self, sentence: str, joint: str) -> FileError:
        """The error for a joint, with its line."""
        return FileError(
            sentence, self.path, self.joints[joint].line if joint in self.joints else None
        )

    def body(self, link: str) -> str:
        """The link that stands for a rigid body: of links joined by fixed joints the one nearest to
        the root.
        """
        while link in self.carrier and not self.carrier[link].kind:
            link = self.carrier[link].parent
        return link

    def in_body(self, link: str) -> FloatArray:
        """(4, 4) T_body_link of a link in its rigid body."""
        T = np.eye(4)
        while link in self.carrier and not self.carrier[link].kind:
            T, link = self.carrier[link].origin @ T, self.carrier[link].parent
        return T

    def with_origin(self, joint: str, origin: FloatArray, turned: bool) -> Urdf:
        """The same with another origin of a joint; its rpy is left alone unless it was turned.

        Raises
        ------
        FileError
            The joint has no origin in the text, or it lacks the attribute.
        """
        found = self.joints[joint]
        if found.start < 0:
            raise self.error(
                f"joint {joint!r} has no <origin> to correct; write one with xyz and rpy", joint
            )
        raw = self.text.encode()
        tag = raw[found.start : found.end].decode()
        tag = self._attribute(tag, "xyz", origin[:3, 3], joint)
        if turned:
            tag = self._attribute(
                tag, "rpy", geometry.matrix_to_euler(origin[:3, :3], "xyz"), joint
            )
        return parse((raw[: found.start] + tag.encode() + raw[found.end :]).decode(), self.path)

    def _attribute(self, tag: str, name: str, values: FloatArray, joint: str) -> str:
        found = re.search(rf"""\s{name}\s*=\s*(["'])(.*?)\1""", tag, re.DOTALL)
        if found is None:
            raise self.error(
                f"the origin of joint {joint!r} has no {name} to correct; write it out", joint
            )
        return (
            tag[: found.start(2)] + " ".join(repr(float(v)) for v in values) + tag[found.end(2) :]
        )


@dataclass
class _Open:
    """A joint while it is read."""

    name: str
    kind: str
    line: int
    found: dict[str, dict[str, str]] = field(default_factory=dict)
    start: int = -1


def read(path: Path) -> Urdf:
    """Read a URDF; FileError where it is none."""
    return parse(read_text(path, "URDF file"), path)


def parse(text: str, path: Path) -> Urdf:
    """Find links and joints; FileError for broken XML, a joint of an unknown kind, or what is no
    tree.
    """
    raw, links, joints = text.encode(), [], {}
    parser, depth, current = expat.ParserCreate(), [], None

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal current
        depth.append(name)
        line = parser.CurrentLineNumber
        if depth == ["robot", "link"]:
            links.append(attributes.get("name", ""))
        elif depth == ["robot", "joint"]:
            current = _Open(attributes.get("name", ""), attributes.get("type", ""), line)
        elif current is not None and depth[:2] == ["robot", "joint"] and len(depth) == 3:
            current.found[name] = attributes
            if name == "origin":
                current.start = parser.CurrentByteIndex

    def end(name: str) -> None:
        nonlocal current
        if depth == ["robot", "joint"] and current is not None:
            if current.name in joints:
                raise FileError(
                    f"joint {current.name!r} stands here for the second time; rename one",
                    path,
                    current.line,
                )
            joints[current.name] = _joint(current, raw, path)
            current = None
        del name
        depth.pop()

    def doctype(*_: Any) -> None:
        raise FileError(
            "a document type is no part of a URDF; leave out <!DOCTYPE ..>",
            path,
            parser.CurrentLineNumber,
        )

    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = (
        start,
        end,
        doctype,
    )
    try:
        parser.Parse(raw, True)
    except expat.ExpatError as error:
        raise FileError(
            f"this is no XML ({expat.ErrorString(error.code)}); correct it", path, error.lineno
        ) from None
    return _tree(text, path, links, joints)


def _joint(read_so_far: _Open, raw: bytes, path: Path) -> UrdfJoint:
    """A joint from its elements."""
    name, found, line = read_so_far.name, read_so_far.found, read_so_far.line
    if read_so_far.kind not in KINDS:
        raise FileError(
            f"joint {name!r} is of type {read_so_far.kind!r}; loopcal reads {', '.join(KINDS)}",
            path,
            line,
        )
    for needed in ("parent", "child"):
        if not found.get(needed, {}).get("link"):
            raise FileError(
                f"joint {name!r} names no {needed} link; add <{needed} link=..>", path, line
            )
    xyz, rpy = (
        _three(found.get("origin", {}).get(key, "0 0 0"), f"{key} of joint {name!r}", path, line)
        for key in ("xyz", "rpy")
    )
    axis = _three(
        found.get("axis", {}).get("xyz", "1 0 0"), f"the axis of joint {name!r}", path, line
    )
    kind = KINDS[read_so_far.kind]
    if kind and not np.linalg.norm(axis) > 0:
        raise FileError(f"joint {name!r} has the axis 0 0 0; give it a direction", path, line)
    limit, limits = found.get("limit", {}), None
    if kind and read_so_far.kind != "continuous" and {"lower", "upper"} <= limit.keys():
        low, high = (
            number(limit[key], f"{key} of joint {name!r}", path, line) for key in ("lower", "upper")
        )
        limits = (low, high) if low < high else None
    start, end = read_so_far.start, -1
    if start >= 0:
        end = raw.index(b">", start) + 1
    length = float(np.linalg.norm(axis)) or 1.0
    origin = geometry.make_pose(geometry.euler_to_matrix(rpy, "xyz"), xyz)
    return UrdfJoint(
        name,
        kind,
        found["parent"]["link"],
        found["child"]["link"],
        origin,
        axis / length,
        limits,
        line,
        start,
        end,
    )


def _three(text: str, what: str, path: Path, line: int) -> FloatArray:
    parts = text.split()
    if len(parts) != 3:
        raise FileError(
            f"{what} is {text!r} where three numbers are needed; correct it", path, line
        )
    return np.array([number(part, what, path, line) for part in parts])


def _tree(text: str, path: Path, links: list[str], joints: dict[str, UrdfJoint]) -> Urdf:
    """Check that links and joints make one tree."""
    carrier: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        for link in (joint.parent, joint.child):
            if link not in links:
                raise FileError(
                    f"joint {joint.name!r} names the link {link!r}, which is not there; correct it",
                    path,
                    joint.line,
                )
        if joint.child in carrier:
            other = carrier[joint.child].name
            raise FileError(
                f"link {joint.child!r} is the child of {other!r} and of {joint.name!r}; a URDF is "
                "a tree",
                path,
                joint.line,
            )
        carrier[joint.child] = joint
    roots = [link for link in links if link not in carrier]
    if len(roots) != 1:
        raise FileError(
            f"a URDF has one root link, this has {len(roots)} ({', '.join(roots[:4])}); join them",
            path,
        )
    return Urdf(path, text, joints, roots[0], carrier)
