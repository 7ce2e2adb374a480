# SPDX-License-Identifier: Apache-2.0
"""Joints and constraints of a URDF, from the attributes of their elements."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError
from loopcal.io.formats.program_format import parse_number
from loopcal.typing import FloatArray

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
    """A joint.

    Attributes
    ----------
    kind : R, P, or "" for a fixed joint. parent, child : links.
    origin : (4, 4) T_parent_joint [m]. axis : (3,) unit vector. limits : [rad or m].
    line : of the joint, from 1. start, end : bytes of its origin's tag, -1 without.
    mimic : the joint that it follows, factor and offset [rad or m]; None without.
    rounding : error of its origin and axis by the rounding of their numbers [m, rad].
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
    """A constraint between two links.

    Attributes
    ----------
    kind : R, S, U, or "" for a rigid link that was cut. ends : its frames on the parent and on the
        child link, as fixed joints without a child. axes : (3,) unit vector in each of the frames.
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
    length, angle = (
        math.hypot(*(_get_unit(number) for text in texts for number in text.split()))
        for texts in (lengths, angles)
    )
    return length, angle


def _get_unit(number: str) -> float:
    """Return the unit of the last digit of a number; 0 where it has few decimals."""
    mantissa, _, exponent = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2]) - int(exponent or 0)
    return 10.0**-decimals if decimals >= ROUNDED else 0.0


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
