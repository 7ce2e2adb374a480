# SPDX-License-Identifier: Apache-2.0
"""URDF: links, joints, constraints that close loops, and joints of SDF inside <gazebo>.

A joint's frame is its parent link's frame moved by `<origin xyz rpy>`, rpy about fixed axes (R = Rz
Ry Rx). Source: the specification of URDF's joint element (ROS wiki).

A `<constraint>` joins two links that the tree has placed already: `<parent link>` with
`<parent_origin>` and `<parent_axis>`, `<child link>` with `<child_origin>` and `<child_axis>`.
Source: pull request 264 of ros/urdfdom. A `<loop_joint>` has `<link1 link xyz rpy>`, `<link2>` of
the same form and `<axis>` (Isaac Sim, RigidBodyDynamics.jl). Motors may be named by
`<transmission>` or `<ros2_control>`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from loopcal import geometry
from loopcal.findings import report_finding
from loopcal.io.core.limits import find_fault
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.linkages.linkage_format import make_format
from loopcal.io.formats.linkages.sdf import list_embedded_constraints, write_pose
from loopcal.io.formats.linkages.tree import (
    Constraint,
    Edit,
    Element,
    LinkTree,
    TreeJoint,
    apply_edits,
    build_tree,
    make_end,
    measure_rounding,
    parse_xml,
)
from loopcal.typing import FloatArray

WHAT = "URDF file"
SAME_AXIS = 1e-9
"""Difference of two axes that count as the same [1]."""
KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": ""}
CONSTRAINTS = {
    "fixed": "",
    "link": "",
    "revolute": "R",
    "continuous": "R",
    "prismatic": "P",
    "spherical": "S",
    "ball": "S",
    "universal": "U",
}
"""Types of a constraint -> the joint that it is; "" for none."""
LOOP = "loop_joint"
OTHER_LOOPS = ("loop",)
"""Elements by which other programs close loops in a URDF."""


def read_tree(path: Path) -> LinkTree:
    """Read a URDF; FileError where it is not one."""
    return parse(read_text(path, WHAT), path)


def parse(text: str, path: Path) -> LinkTree:
    """Find links and joints; FileError for bad XML, an unknown type of joint, or not one tree."""
    root = parse_xml(text, path, WHAT)
    _refuse_elements(root)
    parts = root.children if root.name == "robot" else []
    links: dict[str, None] = {}
    for link in (part for part in parts if part.name == "link"):
        name = link.attributes.get("name", "")
        if name in links:
            raise link.error(f"duplicate link {name!r}. Rename one")
        links[name] = None
    joints = [_build_joint(part) for part in parts if part.name == "joint"]
    constraints = [_build_constraint(part) for part in parts if part.name == "constraint"]
    constraints += [_build_loop(part) for part in parts if part.name == LOOP]
    motors = dict(motor for part in parts for motor in _list_motors(part))
    tree = build_tree(path, text, [*links], joints, constraints, motors, rewrite, WHAT)
    return list_embedded_constraints(tree, [part for part in parts if part.name == "gazebo"])


def _refuse_elements(root: Element) -> None:
    """Refuse elements that would give another machine if ignored, and invisible characters."""
    depths = [(root, 1), *((a, 2) for a in root.children)]
    depths += [(b, 3) for a in root.children for b in a.children]
    for element, depth in depths:
        fault = find_fault(element.attributes.get("name", ""))
        if depth < 3 and fault is not None:
            raise element.error(fault)
        values = element.attributes.values()
        if element.name.startswith("xacro:") or any(v.startswith("${") for v in values):
            raise element.error(report_finding("files.urdf-macro", element=element.name))
        if depth == 2 and element.name in OTHER_LOOPS:
            raise element.error(report_finding("files.urdf-other-loop", element=element.name))


def _list_motors(part: Element) -> Iterator[tuple[str, int]]:
    """Yield the joints that a transmission or a control names, with their lines."""
    for joint in part.find_all("joint"):
        if part.name == "transmission":
            yield joint.attributes.get("name", ""), joint.line
        if part.name == "ros2_control" and joint.find("command_interface") is not None:
            yield joint.attributes.get("name", ""), joint.line


def _find(element: Element, name: str) -> Element | None:
    """Return the last child of a name, None without."""
    return next(reversed([*element.find_all(name)]), None)


def _get_attributes(element: Element, name: str) -> Mapping[str, str]:
    """Return the attributes of the last child of a name, empty without."""
    found = _find(element, name)
    return {} if found is None else found.attributes


def _build_joint(element: Element) -> TreeJoint:
    """Return a joint from its elements."""
    name, stated = element.attributes.get("name", ""), element.attributes.get("type", "")
    if stated not in KINDS:
        sentence = f"joint {name!r} is of type {stated!r}. Allowed: {', '.join(KINDS)}"
        raise element.error(sentence)
    parent, child = _get_links(element)
    kind, limit = KINDS[stated], _get_attributes(element, "limit")
    what = f"joint {name!r}"
    place, direction = _find(element, "origin"), _get_attributes(element, "axis").get("xyz", "")
    T, rounding = _read_place(element, place, what, direction)
    axis = _parse_axis(element, "axis", what) if kind else np.eye(3)[0]
    limits = None
    if kind and stated != "continuous" and {"lower", "upper"} <= limit.keys():
        low, high = (
            element.parse_number(limit[key], f"{key} of {what}") for key in ("lower", "upper")
        )
        limits = (low, high) if low < high else None
    mimic = _get_attributes(element, "mimic")
    followed = None
    if mimic:
        factor, offset = (
            element.parse_number(mimic.get(key, default), f"{key} of {what}")
            for key, default in (("multiplier", "1"), ("offset", "0"))
        )
        followed = mimic.get("joint", ""), factor, offset
    return TreeJoint(
        name, kind, parent, child, T, axis, limits, element.line, place, followed, rounding
    )


def _build_constraint(element: Element) -> Constraint:
    """Return a constraint from its elements."""
    name, stated = element.attributes.get("name", ""), element.attributes.get("type", "")
    what = f"constraint {name!r}"
    if stated.lower() not in CONSTRAINTS:
        sentence = f"{what} is of type {stated!r}. Allowed: {', '.join(CONSTRAINTS)}"
        raise element.error(sentence)
    kind = CONSTRAINTS[stated.lower()]
    ends = []
    for end, link in zip(("parent", "child"), _get_links(element), strict=True):
        place = _find(element, f"{end}_origin")
        direction = _get_attributes(element, f"{end}_axis").get("xyz", "")
        T, rounding = _read_place(element, place, what, direction)
        ends.append(make_end(name, end, link, T, element.line, place, rounding))
    given = [end for end in ("parent", "child") if element.find(f"{end}_axis") is not None]
    needed = {"R": ["parent"], "P": ["parent"], "U": ["parent", "child"]}.get(kind, [])
    if missing := [end for end in needed if end not in given]:
        sentence = f"{what} is {stated} and has no axis. Add <{missing[0]}_axis xyz=..>"
        raise element.error(sentence)
    axes = {
        end: _parse_axis(element, f"{end}_axis", what) if end in needed else np.eye(3)[2]
        for end in ("parent", "child")
    }
    if kind in ("R", "P") and "child" in given:
        other = _parse_axis(element, "child_axis", what)
        if np.abs(other - axes["parent"]).max() > SAME_AXIS:
            sentence = f"{what} is {stated}, but its child_axis is not its parent_axis"
            action = "turn child_origin so that both frames share the axis, or leave child_axis out"
            raise element.error(f"{sentence}; {action}")
    both = axes["parent"], axes["child"]
    return Constraint(name, kind, (ends[0], ends[1]), both, element.line)


def _build_loop(element: Element) -> Constraint:
    """Return a loop joint as a constraint."""
    name, kind = element.attributes.get("name", ""), element.attributes.get("type", "")
    what, links = f"{LOOP} {name!r}", [*element.find_all("link1", "link2")]
    if kind not in CONSTRAINTS or CONSTRAINTS[kind] == "U" or len(links) != 2:
        finding = report_finding("files.urdf-other-loop", element=f"{LOOP} type={kind!r}")
        raise element.error(finding)
    ends = []
    for end, link in zip(("parent", "child"), links, strict=True):
        (T, rounding), body = _read_place(link, link, what), link.attributes.get("link", "")
        ends.append(make_end(name, end, body, T, link.line, link, rounding))
    axis = _parse_axis(element, "axis", what)
    return Constraint(name, CONSTRAINTS[kind], (ends[0], ends[1]), (axis, axis), element.line)


def _get_links(element: Element) -> tuple[str, str]:
    """Return the links that a joint or constraint names."""
    parent, child = (_get_attributes(element, end).get("link", "") for end in ("parent", "child"))
    if not parent or not child:
        needed, name = "child" if parent else "parent", element.attributes.get("name", "")
        sentence = f"{element.name} {name!r} names no {needed} link. Add <{needed} link=..>"
        raise element.error(sentence)
    return parent, child


def _read_place(
    element: Element, place: Element | None, what: str, axis: str = ""
) -> tuple[FloatArray, tuple[float, float]]:
    """Return the origin (4, 4) that a place in an element states, the identity without, and the
    rounding errors of this origin and an axis [m, rad].
    """
    stated = {} if place is None else place.attributes
    xyz = element.parse_numbers(stated.get("xyz", "0 0 0"), 3, f"xyz of {what}")
    rpy = element.parse_numbers(stated.get("rpy", "0 0 0"), 3, f"rpy of {what}")
    rounding = measure_rounding([stated.get("xyz", "")], [stated.get("rpy", ""), axis])
    return geometry.make_pose(geometry.euler_to_matrix(rpy, "xyz"), xyz), rounding


def _parse_axis(element: Element, name: str, what: str) -> FloatArray:
    """Return an axis as unit vector (3,)."""
    return element.parse_direction(_get_attributes(element, name).get("xyz", "1 0 0"), what)


def rewrite(before: LinkTree, after: LinkTree) -> str:
    """Return the text with the origins of another tree; rpy changes only where it turned. FileError
    : a joint has no origin in the text, or the attribute is missing.
    """
    raw = before.text.encode()
    edits: list[Edit] = []
    for name, place in before.places.items():
        origin = after.places[name].origin
        if np.array_equal(origin, place.origin) or (
            place.element is None and name not in before.joints
        ):
            continue  # as it was, or the derived end of a constraint
        if place.element is None:
            raise before.error(f"{name!r} has no origin element. Add one with xyz and rpy", name)
        if place.element.name == "joint":  # of SDF inside <gazebo>
            edits.append(write_pose(before, place.element, origin, place.origin))
            continue
        values = {"xyz": origin[:3, 3]}
        if not np.array_equal(origin[:3, :3], place.origin[:3, :3]):
            values["rpy"] = geometry.matrix_to_euler(origin[:3, :3], "xyz")
        for attribute, numbers in values.items():
            edit = place.element.replace_attribute(raw, attribute, numbers)
            if edit is None:
                raise before.error(f"the origin of {name!r} has no {attribute}. Add it", name)
            edits.append(edit)
    return apply_edits(before.text, edits)


FORMAT = make_format("a URDF", "URDF with loop closures", (".urdf",), read_tree)
