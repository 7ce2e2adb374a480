# SPDX-License-Identifier: Apache-2.0
"""MJCF of MuJoCo: bodies in bodies, and equalities that close loops or couple joints.

A body is drawn in its parent; its joints move it from there, one after the other. `connect` and
`weld` state a place in one body, the other one is where the drawn pose puts it, or two sites.
`joint polycoef` makes a joint follow another. Source: XML reference of MuJoCo 3.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

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
    draw_links,
    format_numbers,
    make_end,
    measure_rounding,
    parse_xml,
)
from loopcal.mechanism.joint_graph.graph import turn_between
from loopcal.typing import FloatArray

WHAT = "MJCF file"
WORLD = "world"
KINDS = {"hinge": "R", "slide": "P", "ball": "S"}
TURNS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
"""Attributes that state an orientation; one of them at most."""
MOST_INCLUDES = 50
"""Largest number of files that one file includes."""


@dataclass
class _Reader:
    """What is collected while bodies are read."""

    root: Element
    degrees: bool = True
    sequence: str = "xyz"
    limited: bool = True
    defaults: dict[str, dict[str, dict[str, str]]] = field(default_factory=dict)
    bodies: dict[str, FloatArray] = field(default_factory=dict)
    carriers: dict[str, str] = field(default_factory=dict)
    elements: dict[str, Element] = field(default_factory=dict)
    sites: dict[str, tuple[str, FloatArray, Element, FloatArray]] = field(default_factory=dict)
    joints: list[TreeJoint] = field(default_factory=list)
    references: dict[str, float] = field(default_factory=dict)
    floating: list[str] = field(default_factory=list)

    @property
    def equalities(self) -> list[Element]:
        """The active equalities."""
        parts = [part for group in self.root.find_all("equality") for part in group.children]
        return [p for p in parts if self.get_attributes(p, "main").get("active") != "false"]

    def read_all(self) -> None:
        """Read the settings, and all bodies."""
        for compiler in self.root.find_all("compiler"):
            stated = compiler.attributes
            self.degrees = stated.get("angle", "degree" if self.degrees else "radian") == "degree"
            self.sequence = stated.get("eulerseq", self.sequence)
            self.limited = stated.get("autolimits", "true") == "true"
            if stated.get("coordinate", "local") != "local":
                raise compiler.error("coordinates are global. Write coordinate='local'")
        for default in self.root.find_all("default"):
            self._read_defaults(default, {})
        self.bodies[WORLD] = np.eye(4)
        for world in self.root.find_all("worldbody"):
            self.read_body(world, WORLD, np.eye(4), "main")

    def _read_defaults(self, element: Element, above: Mapping[str, dict[str, str]]) -> None:
        """Read a class of defaults and those in it."""
        name = element.attributes.get("class", "main")
        own = {kind: dict(values) for kind, values in above.items()}
        for child in element.children:
            if child.name != "default":
                own[child.name] = {**own.get(child.name, {}), **child.attributes}
        self.defaults[name] = own
        for child in element.find_all("default"):
            self._read_defaults(child, own)

    def get_attributes(self, element: Element, inherited: str) -> Mapping[str, str]:
        """Return the attributes of an element with the defaults of its class."""
        chosen = element.attributes.get("class", inherited) or "main"
        return {**self.defaults.get(chosen, {}).get(element.name, {}), **element.attributes}

    def parse_angle(self, number: float) -> float:
        """Return an angle of the file [rad]."""
        return float(np.deg2rad(number)) if self.degrees else float(number)

    def parse_pose(self, element: Element, stated: Mapping[str, str]) -> FloatArray:
        """Return the pose (4, 4) that attributes state."""
        name = stated.get("name", "")
        what = f"{element.name} {name!r}"
        position = element.parse_numbers(stated.get("pos", "0 0 0"), 3, f"pos of {what}")
        R, turn = np.eye(3), next((key for key in TURNS if key in stated), None)
        if turn is not None:
            count = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}[turn]
            numbers = element.parse_numbers(stated[turn], count, f"{turn} of {what}")
            if turn != "euler" and not np.linalg.norm(numbers[: 3 if turn != "quat" else 4]) > 0:
                raise element.error(f"{turn} of {what} is zero. Write a direction")
            R = self._find_rotation(turn, numbers)
        return geometry.make_pose(R, position)

    def _find_rotation(self, turn: str, numbers: FloatArray) -> FloatArray:
        """Return the rotation (3, 3) of one of the attributes TURNS."""
        if turn == "quat":
            return geometry.quaternion_to_matrix(numbers / np.linalg.norm(numbers))
        if turn == "axisangle":
            angle, axis = self.parse_angle(numbers[3]), numbers[:3] / np.linalg.norm(numbers[:3])
            return geometry.exp_so3(angle * axis)
        if turn == "euler":
            R = np.eye(3)
            for letter, number in zip(self.sequence, numbers, strict=False):
                unit = np.eye(3)["xyz".index(letter.lower())] * self.parse_angle(number)
                step = geometry.exp_so3(unit)
                R = R @ step if letter.islower() else step @ R
            return R
        if turn == "zaxis":
            return turn_between(np.eye(3)[2], numbers / np.linalg.norm(numbers))
        x = numbers[:3] / np.linalg.norm(numbers[:3])
        y = numbers[3:] - x * (x @ numbers[3:])
        y = y / np.linalg.norm(y)
        return np.column_stack([x, y, np.cross(x, y)])

    def read_body(
        self, element: Element, parent: str, T_parent: FloatArray, inherited: str
    ) -> None:
        """Read a body or a frame, and what it carries; T_parent (4, 4) is its frame in `parent`."""
        inherited = element.attributes.get("childclass", inherited)
        T = T_parent
        if element.name == "frame":
            T = T_parent @ self.parse_pose(element, element.attributes)
        if element.name == "body":
            name = element.attributes.get("name") or f"body {len(self.bodies)}"
            if name in self.bodies:
                raise element.error(f"duplicate body {name!r}. Rename one")
            T_body = T_parent @ self.parse_pose(element, element.attributes)
            self.bodies[name] = self.bodies[parent] @ T_body
            self.elements[name], self.carriers[name] = element, parent
            self._read_joints(element, name, parent, T_body, inherited)
            parent, T = name, np.eye(4)
        for child in element.children:
            if child.name in ("body", "frame"):
                self.read_body(child, parent, T, inherited)
            elif child.name == "site" and "name" in child.attributes:
                place = T @ self.parse_pose(child, self.get_attributes(child, inherited))
                self.sites[child.attributes["name"]] = parent, place, child, T
            elif child.name in ("replicate", "attach", "composite", "flexcomp"):
                sentence = f"<{child.name}> makes bodies that the file does not write"
                raise child.error(f"{sentence}. Save the model from MuJoCo with all bodies first")

    def _read_joints(
        self, element: Element, body: str, parent: str, T_body: FloatArray, inherited: str
    ) -> None:
        """Read the joints of a body that is drawn at T_body (4, 4) in its parent; none is fixed."""
        found = [*element.find_all("joint", "freejoint")]
        x, origin, carrier = np.eye(3)[0], T_body, parent
        moving: list[TreeJoint] = []
        for i, joint in enumerate(found):
            stated = self.get_attributes(joint, inherited)
            kind = "free" if joint.name == "freejoint" else stated.get("type", "hinge")
            if kind == "free":
                self.floating.append(body)
                break
            if kind not in KINDS:
                allowed = ", ".join((*KINDS, "free"))
                raise joint.error(f"a joint of {body!r} is of type {kind!r}. Allowed: {allowed}")
            name = stated.get("name") or f"joint {i + 1} of {body}"
            texts = stated.get("pos", "0 0 0"), stated.get("axis", "0 0 1")
            center = joint.parse_numbers(texts[0], 3, f"pos of joint {name!r}")
            axis = joint.parse_direction(texts[1], f"joint {name!r}")
            reference, limits = joint.parse_number(stated.get("ref", "0"), "ref"), None
            if reference and kind != "ball":
                turned = self.parse_angle(reference) if kind == "hinge" else reference
                self.references[stated.get("name", "")] = turned
            limited = stated.get("limited", "auto")
            is_limited = self.limited if limited == "auto" else limited != "false"
            if "range" in stated and is_limited and kind != "ball":
                low, high = joint.parse_numbers(stated["range"], 2, "range") - reference
                if kind == "hinge":
                    low, high = self.parse_angle(low), self.parse_angle(high)
                limits = (float(low), float(high)) if low < high else None
            place = geometry.make_pose(np.eye(3), center)
            link = f"{body} at {name}"
            where = element.attributes
            rounding = measure_rounding(
                [where.get("pos", ""), texts[0]], [where.get("quat", ""), texts[1]]
            )
            moving.append(
                TreeJoint(
                    name,
                    KINDS[kind],
                    carrier,
                    link,
                    origin @ place,
                    axis,
                    limits,
                    joint.line,
                    joint,
                    rounding=rounding,
                    shifts=i == 0,
                )
            )
            origin, carrier = geometry.invert_pose(place), link
        if moving and np.array_equal(origin, np.eye(4)):
            moving[-1] = replace(moving[-1], child=body)
        else:
            line, what = element.line, f"{body} frame"
            self.joints.append(TreeJoint(what, "", carrier, body, origin, x, None, line))
        self.joints += moving


def _include(root: Element, path: Path) -> Element:
    """Return the tree with the files that it includes."""

    def expand(element: Element, count: int) -> None:
        children: list[Element] = []
        for child in element.children:
            if child.name != "include":
                expand(child, count)
                children.append(child)
                continue
            name = Path(child.attributes.get("file", ""))
            other = path.parent / name
            is_beside = not name.is_absolute() and ".." not in name.parts
            if count >= MOST_INCLUDES or not is_beside or not other.is_file():
                raise child.error(f"cannot read the included {other.name!r}. Put it next to this")
            inner = parse_xml(read_text(other, WHAT), other, WHAT)
            expand(inner, count + 1)
            children += inner.children
        element.children = children

    expand(root, 0)
    return root


def read_tree(path: Path) -> LinkTree:
    """Read an MJCF; FileError where it is not one."""
    text = read_text(path, WHAT)
    root = parse_xml(text, path, WHAT)
    if root.name != "mujoco":
        raise FileError(f"the root is <{root.name}>, not <mujoco>. Check the file", path)
    reader = _Reader(_include(root, path))
    reader.read_all()
    links = _list_carried(reader)
    joints = [joint for joint in reader.joints if joint.parent in links and joint.child in links]
    constraints = [closure.constraint for closure in _read_closures(reader, links)]
    joints, notes = _couple(reader, joints)
    motors, driven_notes = _list_motors(reader, joints)
    tree = build_tree(path, text, [*links], joints, constraints, motors, rewrite, WHAT)
    hidden = frozenset(link for link in links if link not in reader.bodies)
    return replace(tree, hidden=hidden, notes=(*notes, *driven_notes))


def _list_carried(reader: _Reader) -> dict[str, None]:
    """Return the links of the mechanism, from its base on: the world, or the only free body if
    nothing else moves. Other free bodies are left out.
    """
    free = reader.floating

    def find_top(body: str) -> str:
        while reader.carriers.get(body, WORLD) != WORLD:
            body = reader.carriers[body]
        return body

    moving = {joint.parent for joint in reader.joints if joint.kind} & reader.bodies.keys()
    on_world = any(find_top(body) not in free for body in moving)
    links = {free[0] if len(free) == 1 and not on_world else WORLD: None}
    joints = [j for j in reader.joints if j.child not in free]
    while more := {j.child: None for j in joints if j.parent in links and j.child not in links}:
        links |= more
    return links


@dataclass(frozen=True, eq=False)
class Closure:
    """A constraint, and of each point (3,) in its frames [m] the elements that state it at both
    ends, None where the drawn pose does.
    """

    constraint: Constraint
    points: tuple[tuple[FloatArray, tuple[Element | None, Element | None]], ...]


def _read_closures(reader: _Reader, links: Mapping[str, None]) -> list[Closure]:
    """Return the closures of the mechanism; two points of the same bodies are a hinge."""
    closures: list[Closure] = []
    for i, part in enumerate(reader.equalities):
        closure = _read_closure(reader, part, i, links)
        if closure is None:
            continue
        ends = [end.parent for end in closure.constraint.ends]
        for k, other in enumerate(closures):
            one = other.constraint
            same = one.kind == "S" == closure.constraint.kind and one.derived
            if same == closure.constraint.derived and ends == [end.parent for end in one.ends]:
                closures[k] = _join(other, closure)
                break
        else:
            closures.append(closure)
    return closures


def _join(first: Closure, second: Closure) -> Closure:
    """Return the hinge through two points of the same bodies, z of its frames along it."""
    ends, length = [], 0.0
    for near, far in zip(first.constraint.ends, second.constraint.ends, strict=True):
        along = far.origin[:3, 3] - near.origin[:3, 3]
        length = float(np.linalg.norm(along)) or 1.0
        R = turn_between(np.eye(3)[2], along / length)
        ends.append(replace(near, origin=geometry.make_pose(R, near.origin[:3, 3])))
    joined = replace(first.constraint, kind="R", ends=(ends[0], ends[1]))
    tip = np.array([0.0, 0.0, length])
    return Closure(joined, (*first.points, *((tip, part) for _, part in second.points)))


def _read_closure(
    reader: _Reader, part: Element, i: int, links: Mapping[str, None]
) -> Closure | None:
    """Return the closure of `connect` or `weld`; None for another equality, or other bodies."""
    if part.name not in ("connect", "weld"):
        return None
    stated = reader.get_attributes(part, "main")
    name = stated.get("name") or f"{part.name} {i + 1}"
    kind, z = "S" if part.name == "connect" else "", np.eye(3)[2]
    rounding = measure_rounding([stated.get("anchor", "")], [])
    is_derived, elements = True, (part if kind else None, None)
    if "site1" in stated:
        sites = [_find(reader.sites, stated.get(f"site{k}", ""), "site", part) for k in (1, 2)]
        (first, A, a, _), (second, B, b, _) = sites
        elements, is_derived = (a, b), False
    else:
        first, second = stated.get("body1", ""), stated.get("body2", WORLD)
        T_1, T_2 = (_find(reader.bodies, body, "body", part) for body in (first, second))
        anchor = part.parse_numbers(stated.get("anchor", "0 0 0"), 3, f"anchor of {name!r}")
        A = geometry.make_pose(np.eye(3), anchor)
        relpose = part.parse_numbers(stated.get("relpose", "0 0 0 0 0 0 0"), 7, "relpose")
        B = geometry.invert_pose(T_2) @ T_1 @ A
        if not kind and np.linalg.norm(relpose[3:]) > 0:
            turn = relpose[3:] / np.linalg.norm(relpose[3:])
            A = geometry.make_pose(geometry.quaternion_to_matrix(turn), relpose[:3])
            B, is_derived = np.eye(4), False
    if first not in links or second not in links:
        return None
    ends = (
        make_end(name, "parent", first, A, part.line, elements[0], rounding),
        make_end(name, "child", second, B, part.line, elements[1]),
    )
    constraint = Constraint(name, kind, ends, (z, z), part.line, is_derived)
    return Closure(constraint, ((np.zeros(3), elements),))


def _find(named: Mapping[str, Any], name: str, what: str, part: Element) -> Any:
    """Return a named thing; FileError where there is none."""
    if name not in named:
        near = suggest_names(name, [*named])
        raise part.error(f"<{part.name}> names the {what} {name!r}, which does not exist{near}")
    return named[name]


def _couple(
    reader: _Reader, joints: Sequence[TreeJoint]
) -> tuple[list[TreeJoint], tuple[Any, ...]]:
    """Return the joints, those of equalities following others, and what was left out."""
    known, notes = {joint.name: joint for joint in joints}, []
    for part in reader.equalities:
        stated = reader.get_attributes(part, "main")
        if part.name in ("connect", "weld") or stated.get("joint1", "") not in known:
            if part.name not in ("connect", "weld", "joint"):
                notes.append(report_finding("files.part-left-out", part=f"<{part.name}>"))
            continue
        joint = known[stated["joint1"]]
        what = f"polycoef of {joint.name!r}"
        texts = (stated.get("polycoef", "0 1 0 0 0").split() + ["0"] * 5)[:5]
        c = part.parse_numbers(" ".join(texts), 5, what)
        if "joint2" not in stated:
            motion = geometry.exp_so3(c[0] * joint.axis) if joint.kind == "R" else np.eye(3)
            shift = c[0] * joint.axis if joint.kind == "P" else np.zeros(3)
            origin = joint.origin @ geometry.make_pose(motion, shift)
            known[joint.name] = replace(joint, kind="", origin=origin)
            continue
        if np.any(c[2:]):
            raise part.error(f"{what} is not linear. Allowed: constant and linear terms")
        if stated["joint2"] in known:
            known[joint.name] = replace(joint, mimic=(stated["joint2"], float(c[1]), float(c[0])))
    return list(known.values()), tuple(notes)


def _list_motors(
    reader: _Reader, joints: Sequence[TreeJoint]
) -> tuple[dict[str, int], tuple[Any, ...]]:
    """Return the joints that actuators drive, and remarks; a tendon drives its first joint."""
    root, notes = reader.root, []
    known = {joint.name for joint in joints if joint.kind}
    tendons = {
        fixed.attributes.get("name", ""): [j.attributes.get("joint", "") for j in fixed.children]
        for tendon in root.find_all("tendon")
        for fixed in tendon.find_all("fixed")
    }
    motors: dict[str, int] = {}
    for actuator in (part for group in root.find_all("actuator") for part in group.children):
        stated = actuator.attributes
        joint, tendon = (
            stated.get("joint", stated.get("jointinparent", "")),
            stated.get("tendon", ""),
        )
        if tendons.get(tendon):
            joint = tendons[tendon][0]
            notes.append(report_finding("files.tendon-drives", tendon=tendon, joint=joint))
        elif not joint:
            notes.append(report_finding("files.part-left-out", part=stated.get("name", "")))
        if joint in known:
            motors.setdefault(joint, actuator.line)
    moved = [name for name in motors if name in reader.references]
    notes += [report_finding("files.joint-reference", joint=name) for name in moved]
    return motors, tuple(notes)


def rewrite(tree: LinkTree, other: LinkTree) -> str:
    """Return the text with the places of bodies, joints, anchors and sites of another tree."""
    raw = tree.text.encode()
    reader = _Reader(_include(parse_xml(tree.text, tree.path, WHAT), tree.path))
    reader.read_all()
    # the file draws locked joints at zero
    locked = [j for j in reader.joints if j.kind and not tree.joints.get(j.name, j).kind]
    back = {j: geometry.invert_pose(tree.joints[j.name].origin) @ j.origin for j in locked}
    tree, changed = (
        one.with_joints(replace(j, origin=one.joints[j.name].origin @ T) for j, T in back.items())
        for one in (tree, other)
    )
    (drawn, after), edits = map(draw_links, (tree, changed)), list[Edit]()
    for body, element in reader.elements.items():
        parent = reader.carriers[body]
        if body not in after or parent not in after:
            continue
        old = geometry.invert_pose(reader.bodies[parent]) @ reader.bodies[body]
        new = geometry.invert_pose(after[parent]) @ after[body]
        if np.abs(new - old).max() > SAME:
            stated = reader.parse_pose(element, element.attributes)
            outer = old @ geometry.invert_pose(stated)  # of <frame> elements around it
            edits += _write_pose(tree, raw, element, geometry.invert_pose(outer) @ new, stated)
        chain = [tree.carrier[body]]
        while chain[-1].parent != parent:
            chain.append(tree.carrier[chain[-1].parent])
        for joint in chain:
            if not joint.kind or (element := joint.element) is None:
                continue
            old, new = (geometry.invert_pose(at[body]) @ at[joint.child] for at in (drawn, after))
            for key, stated, now in (
                ("pos", old[:3, 3], new[:3, 3]),
                ("axis", old[:3, :3] @ joint.axis, new[:3, :3] @ joint.axis),
            ):
                if np.abs(now - stated).max() > SAME and (key == "pos" or joint.kind != "S"):
                    edits.append(_replace(tree, raw, element, key, now))
    for closure in _read_closures(reader, dict.fromkeys((tree.root, *tree.carrier))):
        for k, end in enumerate(closure.constraint.ends):
            T = other.places[end.name].origin
            for point, elements in closure.points:
                shift = (T[:3, :3] @ point + T[:3, 3]) - (
                    end.origin[:3, :3] @ point + end.origin[:3, 3]
                )
                element = elements[k]
                if element is None or np.abs(shift).max() <= SAME:
                    continue
                edits.append(_replace(tree, raw, element, *_shift_point(reader, element, shift)))
    return apply_edits(tree.text, edits)


def _shift_point(reader: _Reader, element: Element, by: FloatArray) -> tuple[str, FloatArray]:
    """Return the attribute that states the point of a site or an anchor, and its value where the
    point moves by (3,) [m] in its body; a site is written in the <frame> around it.
    """
    if element.name == "site":
        _, place, _, outer = reader.sites[element.attributes["name"]]
        return "pos", outer[:3, :3].T @ (place[:3, 3] + by - outer[:3, 3])
    anchor = reader.get_attributes(element, "main").get("anchor", "0 0 0")
    return "anchor", element.parse_numbers(anchor, 3, "anchor") + by


def _write_pose(
    tree: LinkTree, raw: bytes, element: Element, T: FloatArray, stated: FloatArray
) -> Iterator[Edit]:
    """Yield the edits that give a body another pose (4, 4)."""
    if np.abs(T[:3, 3] - stated[:3, 3]).max() > SAME:
        yield _replace(tree, raw, element, "pos", T[:3, 3])
    if np.abs(T[:3, :3] - stated[:3, :3]).max() > SAME:
        turn = next((key for key in TURNS if key in element.attributes), "quat")
        quaternion = geometry.matrix_to_quaternion(T[:3, :3])
        first, end, numbers = _replace(tree, raw, element, turn, quaternion)
        if turn != "quat" and turn in element.attributes:
            tag = raw[element.start : first].decode()
            name = element.start + len(tag[: tag.rindex(turn)].encode())
            quote = raw[first - 1 : first].decode()
            yield name, end, f"quat={quote}{numbers}"
        else:
            yield first, end, numbers


def _replace(
    tree: LinkTree, raw: bytes, element: Element, attribute: str, values: FloatArray
) -> Edit:
    """Return the edit of an attribute, which is added where it is missing."""
    if element.path != tree.path:
        sentence = f"{element.attributes.get('name', element.name)!r} is in an included file"
        raise element.error(f"{sentence}. Write it into {tree.path.name}")
    edit = element.replace_attribute(raw, attribute, values)
    after_name = element.start + 1 + len(element.name)
    added = f' {attribute}="{format_numbers(values)}"'
    return edit if edit is not None else (after_name, after_name, added)


FORMAT = make_format(
    "an MJCF", "MJCF with equalities that close loops", (".xml", ".mjcf"), read_tree
)
