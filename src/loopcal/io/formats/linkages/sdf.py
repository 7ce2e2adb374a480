# SPDX-License-Identifier: Apache-2.0
"""SDF: links that are drawn in a pose, and joints that state their frame in the child link.

The frame of a joint in its parent link is where the drawn pose puts it. A link with two parents is
carried by the first of them, the other joint closes a loop. `<gazebo>` of a URDF contains such
joints. A gearbox couples two links that the same body carries: theta_2 = -ratio theta_1. A mimic
joint is multiplier (leader - reference) + offset. Source: the specification of SDFormat 1.4 to 1.11
(sdformat.org).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.linkages.linkage_format import make_format
from loopcal.io.formats.linkages.tree import (
    SAME,
    Constraint,
    Edit,
    Element,
    LinkTree,
    TreeJoint,
    apply_edits,
    build_tree,
    derive_end,
    draw_links,
    format_numbers,
    make_end,
    measure_rounding,
    parse_xml,
    require_links,
)
from loopcal.typing import FloatArray

WHAT = "SDF file"
MODEL, WORLD = "__model__", "world"
KINDS = {
    "revolute": "R",
    "continuous": "R",
    "prismatic": "P",
    "ball": "S",
    "universal": "U",
    "revolute2": "U",
    "fixed": "",
}
GEARBOX = "gearbox"
AXES_IN_MODEL = ("1.0", "1.2", "1.3", "1.4")
"""Versions in which axes are written in the frame of the model."""
UNLIMITED = 1e15
"""Limit from which a joint counts as unlimited; SDF writes 1e16 [rad, m]."""


@dataclass(frozen=True, eq=False)
class SdfJoint:
    """A joint: its name, kind and links, its frame (4, 4) in the child, axes (2, 3) in its frame,
    limits [rad, m], and the rounding of its numbers.
    """

    element: Element
    name: str
    kind: str
    parent: str
    child: str
    T_child: FloatArray
    axes: FloatArray
    limits: tuple[float, float] | None
    rounding: tuple[float, float]

    def close(self, drawn: Mapping[str, FloatArray]) -> Constraint:
        """Return it as a constraint that the drawn pose (link -> (4, 4)) closes."""
        T_parent = derive_end(drawn, self.parent, self.child, self.T_child)
        line = self.element.line
        ends = (
            make_end(self.name, "parent", self.parent, T_parent, line),
            make_end(
                self.name, "child", self.child, self.T_child, line, self.element, self.rounding
            ),
        )
        second = self.axes[1 if self.kind == "U" else 0]
        return Constraint(self.name, self.kind, ends, (self.axes[0], second), line, derived=True)


def _parse_pose(element: Element) -> FloatArray:
    """Return the pose (4, 4) that an element states; the identity without."""
    pose = element.find("pose")
    if pose is None or not pose.text.strip():
        return np.eye(4)
    what = f"pose of {element.name} {element.attributes.get('name', '')!r}"
    numbers = pose.parse_numbers(pose.text, 6, what)
    if pose.attributes.get("degrees") in ("true", "1"):
        numbers[3:] = np.deg2rad(numbers[3:])
    return geometry.make_pose(geometry.euler_to_matrix(numbers[3:], "xyz"), numbers[:3])


def _get_reference(element: Element) -> str:
    """Return the name of the frame in which the pose of a link, joint or frame is written."""
    pose = element.find("pose")
    stated = "" if pose is None else pose.attributes.get("relative_to", "")
    if element.name == "joint":
        return stated or element.get("child")
    return stated or element.attributes.get("attached_to", "") or MODEL


@dataclass(frozen=True, eq=False)
class Frames:
    """The named frames of a model; `known` are places (4, 4) in it that other values replace."""

    elements: Mapping[str, Element]
    known: Mapping[str, FloatArray]

    def place(self, name: str, by: tuple[str, ...] = ()) -> FloatArray:
        """Return the place (4, 4) of a frame in the model."""
        if name in (MODEL, WORLD):
            return np.eye(4)
        if name in self.known:
            return self.known[name]
        element = self.elements.get(name)
        if element is None or name in by:
            user = self.elements[by[-1]] if by else next(iter(self.elements.values()))
            circle = "which depends on itself" if element is not None else "which does not exist"
            near = suggest_names(name, [*self.elements])
            raise user.error(f"{by[-1] if by else ''!r} names {name!r}, {circle}{near}. Correct it")
        return self.place_element(element, (*by, name))

    def place_element(self, element: Element, by: tuple[str, ...] = ()) -> FloatArray:
        """Return the place (4, 4) of an element that states a pose, in the model."""
        return self.place(_get_reference(element), by) @ _parse_pose(element)


def _find_elements(model: Element) -> dict[str, Element]:
    """Return the elements whose names are frames; a joint may have the name of a link."""
    named = [*model.find_all("joint"), *model.find_all("link", "frame")]
    return {element.attributes.get("name", ""): element for element in named}


def _turn_axis(axis: Element, frames: Frames, R_joint: FloatArray, in_model: bool) -> FloatArray:
    """Return the rotation (3, 3) from the frame in which an axis is written to that of its joint,
    which stands in the model as R_joint (3, 3).
    """
    xyz = axis.find("xyz")
    frame = "" if xyz is None else xyz.attributes.get("expressed_in", "")
    if frame or in_model or axis.get("use_parent_model_frame") in ("1", "true"):
        return np.asarray(R_joint.T @ frames.place(frame or MODEL)[:3, :3])
    return np.eye(3)


def _read_joint(
    element: Element, frames: Frames, T_child_joint: FloatArray, in_model: bool
) -> SdfJoint:
    """Return a joint with its frame (4, 4) in the child; `in_model` tells whether its axes are
    written in the frame of the model.
    """
    name, stated = element.attributes.get("name", ""), element.attributes.get("type", "")
    if stated not in (*KINDS, GEARBOX):
        allowed = ", ".join((*KINDS, GEARBOX))
        raise element.error(f"joint {name!r} is of type {stated!r}. Allowed: {allowed}")
    parent, child = (
        element.get(end) or (getattr(element.find(end), "attributes", {}).get("link", ""))
        for end in ("parent", "child")
    )
    if not parent or not child:
        needed = "child" if parent else "parent"
        raise element.error(f"joint {name!r} names no {needed} link. Add <{needed}>")
    axes, texts, limits = np.eye(3)[[2, 2]], [], None
    R_joint = (frames.place(child) @ T_child_joint)[:3, :3]
    for i, key in enumerate(("axis", "axis2")):
        axis = element.find(key)
        if axis is None:
            continue
        texts.append(axis.get("xyz") or "0 0 1")
        stated_axis = element.parse_direction(texts[-1], f"joint {name!r}")
        axes[i] = _turn_axis(axis, frames, R_joint, in_model) @ stated_axis
        low, high = (axis.find("limit", key) for key in ("lower", "upper"))
        if i == 0 and stated != "continuous" and low is not None and high is not None:
            low, high = (e.parse_number(e.text, "limit") for e in (low, high))
            limits = (low, high) if -UNLIMITED < low < high < UNLIMITED else None
    pose = element.get("pose").split() or ["0"] * 6
    rounding = measure_rounding(pose[:3], [*pose[3:], *texts])
    kind = KINDS.get(stated, GEARBOX)
    return SdfJoint(element, name, kind, parent, child, T_child_joint, axes, limits, rounding)


def list_embedded_constraints(tree: LinkTree, parts: Sequence[Element]) -> LinkTree:
    """Return the tree of a URDF with the joints inside <gazebo> as constraints."""
    drawn, found = draw_links(tree), []
    for element in (joint for part in parts for joint in part.find_all("joint")):
        frames = Frames({element.attributes.get("name", ""): element}, drawn)
        joint = _read_joint(element, frames, _parse_pose(element), in_model=False)
        ends = (joint.parent, joint.child)
        require_links(drawn, f"joint {joint.name!r}", ends, element.error)
        if joint.name in tree.joints or joint.kind == GEARBOX:
            raise element.error(report_finding("files.urdf-other-loop", element=joint.name))
        found.append(joint.close(drawn))
    motors = {**tree.motors, **_list_motors(parts)} if found else tree.motors
    return replace(tree, constraints=(*tree.constraints, *found), motors=motors)


def _list_motors(parts: Sequence[Element]) -> dict[str, int]:
    """Return the joints that plug-ins move."""
    plugins = (element for part in parts for element in part.walk() if element.name == "plugin")
    named = (name for plugin in plugins for name in plugin.find_all("joint_name", "jointName"))
    return {name.text.strip(): name.line for name in named}


def read_tree(path: Path) -> LinkTree:
    """Read an SDF; FileError where it is not one, or contains no single model."""
    text = read_text(path, WHAT)
    root = parse_xml(text, path, WHAT)
    models = [element for element in root.walk() if element.name == "model"]
    if root.name != "sdf" or len(models) != 1:
        sentence = f"this SDF file has {len(models)} models. Allowed: one, without others in it"
        raise FileError(f"{sentence}. Write one model into a separate file", path)
    (model,) = models
    in_model = root.attributes.get("version", "1.7") in AXES_IN_MODEL
    frames, joints = Frames(_find_elements(model), {}), []
    for element in model.find_all("joint"):
        T_child = _place_in_child(frames, element)
        joints.append(_read_joint(element, frames, T_child, in_model))
    links = [link.attributes.get("name", "") for link in model.find_all("link")]
    drawn = {link: frames.place(link) for link in links}
    if any(WORLD in (joint.parent, joint.child) for joint in joints):
        drawn = {WORLD: np.eye(4), **drawn}
    for joint in joints:
        ends = (joint.parent, joint.child)
        require_links(drawn, f"joint {joint.name!r}", ends, joint.element.error)
    geared = [joint for joint in joints if joint.kind == GEARBOX]
    joints = [joint for joint in joints if joint.kind != GEARBOX]
    children = {joint.child for joint in joints}
    reached = {link for link in drawn if link not in children}
    carried: list[SdfJoint] = []  # of each link the first joint, from links without parents on
    while ready := [j for j in joints if j.parent in reached and j.child not in reached]:
        carried.append(ready[0])
        reached.add(ready[0].child)
    closing = [joint for joint in joints if joint not in carried]
    tree = [part for joint in carried for part in _carry(joint, drawn)]
    followed: dict[str, tuple[str, float, float]] = {}  # joint -> another one, factor and offset
    for joint in carried:
        if (mimic := joint.element.find("axis", "mimic")) is not None:
            factor, offset, reference = (
                mimic.parse_number(mimic.get(key) or default, key)
                for key, default in (("multiplier", "1"), ("offset", "0"), ("reference", "0"))
            )
            leader = mimic.attributes.get("joint", "")
            followed[joint.name] = leader, factor, offset - factor * reference
    by_child = {joint.child: joint.name for joint in carried}
    for gear in geared:
        if gear.parent not in by_child or gear.child not in by_child:
            raise gear.element.error(f"gearbox {gear.name!r} joins links that no joint carries")
        stated = gear.element.find("gearbox_ratio")
        ratio = 1.0 if stated is None else stated.parse_number(stated.text, "ratio")
        followed[by_child[gear.child]] = by_child[gear.parent], -ratio, 0.0
    tree = [replace(joint, mimic=followed.get(joint.name)) for joint in tree]
    frame_links = [joint.child for joint in tree if joint.child not in drawn]
    constraints = [joint.close(drawn) for joint in closing]
    motors, used = _list_motors([model]), [*drawn, *frame_links]
    built = build_tree(path, text, used, tree, constraints, motors, rewrite, WHAT)
    return replace(built, hidden=frozenset(frame_links))


def _carry(joint: SdfJoint, drawn: Mapping[str, FloatArray]) -> tuple[TreeJoint, ...]:
    """Return the joint that carries a link, and a fixed one where their frames differ."""
    is_moved = bool(joint.kind) and np.abs(joint.T_child - np.eye(4)).max() > 0
    T_child = joint.T_child if is_moved else np.eye(4)
    T_parent = derive_end(drawn, joint.parent, joint.child, T_child)
    name, line = joint.name, joint.element.line
    moving = TreeJoint(
        name,
        joint.kind,
        joint.parent,
        f"frame of {name}" if is_moved else joint.child,
        T_parent,
        joint.axes[0],
        joint.limits,
        line,
        joint.element,
        rounding=joint.rounding,
        axis_2=joint.axes[1],
    )
    if not is_moved:
        return (moving,)
    T, child, x = geometry.invert_pose(joint.T_child), joint.child, np.eye(3)[0]
    return (TreeJoint(f"{name} frame", "", moving.child, child, T, x, None, line), moving)


def _place_in_child(frames: Frames, element: Element) -> FloatArray:
    """Return the frame (4, 4) of a joint in its child link."""
    return geometry.invert_pose(frames.place(element.get("child"))) @ frames.place_element(element)


def rewrite(tree: LinkTree, other: LinkTree) -> str:
    """Return the text with poses of links, and of joints that close loops, of another tree."""
    root = parse_xml(tree.text, tree.path, WHAT)
    model = next(element for element in root.walk() if element.name == "model")
    before = Frames(_find_elements(model), {})
    drawn, moved = (draw_links(one) for one in (tree, other))
    base = np.eye(4)
    if tree.root != WORLD:
        base = before.place(tree.root) @ geometry.invert_pose(drawn[tree.root])
    links = {e.attributes.get("name", ""): e for e in model.find_all("link")}
    known = {name: base @ T for name, T in moved.items() if name in links}
    places, turned = [(links[name], T) for name, T in known.items()], dict[str, FloatArray]()
    for element in model.find_all("joint"):
        name, child = element.attributes.get("name", ""), element.get("child")
        if child in known:
            end = other.places.get(f"{name}_child")
            T = known[child] @ (_place_in_child(before, element) if end is None else end.origin)
            places.append((element, T))
            turned[name] = T[:3, :3]
            if before.elements[name] is element:
                known[name] = T
    after, edits = Frames(before.elements, known), []
    for element, place in places:
        stated = _parse_pose(element)
        T = geometry.invert_pose(after.place(_get_reference(element))) @ place
        if np.abs(T - stated).max() > SAME:
            edits.append(write_pose(tree, element, T, stated))
    in_model = root.attributes.get("version", "1.7") in AXES_IN_MODEL
    axes = [{j.name: (j.axis, j.axis_2) for j in one.joints.values()} for one in (tree, other)]
    for one, of in zip((tree, other), axes, strict=True):
        of |= {constraint.name: constraint.axes for constraint in one.constraints}
    for element in model.find_all("joint"):
        name = element.attributes.get("name", "")
        for i, key in enumerate(("axis", "axis2")):
            if (axis := element.find(key)) is None or name not in turned or name not in axes[0]:
                continue
            at = (before, before.place_element(element)[:3, :3]), (after, turned[name])
            stated, new = (
                _turn_axis(axis, *each, in_model).T @ of[name][i]
                for each, of in zip(at, axes, strict=True)
            )
            if np.abs(new - stated).max() > SAME:
                if (xyz := axis.find("xyz")) is None:
                    raise element.error(f"the axis of {name!r} turns. Write it as <xyz>")
                edits.append((xyz.end, xyz.close, format_numbers(new)))
    return apply_edits(tree.text, edits)


def write_pose(tree: LinkTree, element: Element, T: FloatArray, stated: FloatArray) -> Edit:
    """Return the edit that gives an element another pose; angles that stay keep their digits."""
    pose = element.find("pose")
    if pose is None:
        if tree.text.encode()[element.end - 2 : element.end] == b"/>":
            name = element.attributes.get("name", "")
            raise element.error(f"{element.name} {name!r} has no pose. Add one")
        values = [*T[:3, 3], *geometry.matrix_to_euler(T[:3, :3], "xyz")]
        return element.end, element.end, f"<pose>{format_numbers(values)}</pose>"
    angles = format_numbers(geometry.matrix_to_euler(T[:3, :3], "xyz"))
    if pose.attributes.get("degrees") in ("true", "1"):
        angles = format_numbers(np.rad2deg(geometry.matrix_to_euler(T[:3, :3], "xyz")))
    if np.abs(T[:3, :3] - stated[:3, :3]).max() <= SAME:
        angles = " ".join(pose.text.split()[3:])
    return pose.end, pose.close, f"{format_numbers(T[:3, 3])} {angles}"


FORMAT = make_format("an SDF", "SDF with joints that close loops", (".sdf",), read_tree)
