# SPDX-License-Identifier: Apache-2.0
"""Links and joints of a file as a tree, with the constraints that close its loops.

Formats differ in where they write a number; all of them give such a tree. A joint's frame is its
parent link's frame moved by `origin`; the child link turns about, or slides along, `axis` in that
frame. Lengths are meters, angles radians.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError, suggest_names
from loopcal.io.core.limits import XML_DEPTH, XML_ELEMENTS, XML_JOINTS, find_fault
from loopcal.io.formats.program_format import parse_number
from loopcal.typing import FloatArray
from loopcal.units import NUMBER

ROUNDED = 4
"""Decimals from which a number counts as rounded, such as 1.5708 for a right angle."""

START_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")

Edit = tuple[int, int, str]
"""First byte and end of a part of a text, and what replaces it."""


@dataclass
class Element:
    """An element: `line` from 1, bytes `start` to `end` of its start tag, and of its content to
    `close`. `text` is the content before its first child.
    """

    name: str
    attributes: Mapping[str, str]
    path: Path
    line: int
    start: int
    end: int = 0
    close: int = 0
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def find_all(self, *names: str) -> Iterator[Element]:
        """Yield the children with these names."""
        return (child for child in self.children if child.name in names)

    def find(self, *path: str) -> Element | None:
        """Return the first child at a path of names, None without."""
        found: Element | None = self
        for name in path:
            found = None if found is None else next(found.find_all(name), None)
        return found

    def get(self, *path: str) -> str:
        """Return the text of the first child at a path of names, empty without."""
        found = self.find(*path)
        return "" if found is None else found.text.strip()

    def walk(self) -> Iterator[Element]:
        """Yield the element and all elements in it."""
        yield self
        for child in self.children:
            yield from child.walk()

    def error(self, sentence: Any) -> FileError:
        """Return an error at the line of the element."""
        return FileError(sentence, self.path, self.line)

    def parse_numbers(self, text: str, count: int, what: str) -> FloatArray:
        """Return the numbers of a text of this element; FileError unless there are `count`."""
        numbers = text.split()
        if len(numbers) != count:
            words = {1: "one number is", 3: "three numbers are"}.get(count, f"{count} numbers are")
            raise self.error(f"{what} is {text!r}, but {words} needed. Correct it")
        return np.array([parse_number(number, what, self.path, self.line) for number in numbers])

    def parse_number(self, text: str, what: str) -> float:
        """Return the only number of a text of this element."""
        return float(self.parse_numbers(text, 1, what)[0])

    def parse_direction(self, text: str, what: str) -> FloatArray:
        """Return the axis that a text of this element states as unit vector (3,)."""
        vector = self.parse_numbers(text, 3, f"the axis of {what}")
        if not (length := float(np.linalg.norm(vector))) > 0:
            raise self.error(f"{what} has the axis 0 0 0. Write a direction")
        return vector / length

    def replace_attribute(self, raw: bytes, name: str, values: FloatArray) -> Edit | None:
        """Return the edit of an attribute with other numbers; None where it has no such one."""
        tag = raw[self.start : self.end].decode()
        match = re.search(rf"""\s{name}\s*=\s*(["'])(.*?)\1""", tag, re.DOTALL)
        if match is None:
            return None
        first = self.start + len(tag[: match.start(2)].encode())
        return first, first + len(match[2].encode()), format_numbers(values)


SAME = 1e-13
"""Difference of places that count as the same, so that their text stays [m, 1]."""


def format_numbers(values: Iterable[float]) -> str:
    """Return numbers that read back as the same doubles."""
    return " ".join(repr(float(v)) for v in values)


def apply_edits(text: str, edits: Sequence[Edit]) -> str:
    """Return a text with parts replaced."""
    raw = text.encode()
    for first, end, new in sorted(edits, reverse=True):
        raw = raw[:first] + new.encode() + raw[end:]
    return raw.decode()


def measure_rounding(lengths: Iterable[str], angles: Iterable[str]) -> tuple[float, float]:
    """Return the units of the last digits of lengths and angles, as roots of sums of squares.

    Rounding errors are uniform in half a unit, so that this is 3.5 times the standard deviation of
    their sum. A number with fewer than ROUNDED decimals is a dimension that somebody chose, and is
    exact. What is no number is refused elsewhere.
    """

    def measure(texts: Iterable[str]) -> float:
        units = []
        for number in filter(NUMBER.fullmatch, " ".join(texts).lower().split()):
            mantissa, _, exponent = number.partition("e")
            decimals = len(mantissa.partition(".")[2]) - float(exponent or 0)
            units.append(10.0**-decimals if decimals >= ROUNDED else 0.0)
        return math.hypot(*units)

    return measure(lengths), measure(angles)


def parse_xml(text: str, path: Path, what: str) -> Element:
    """Return the root of a text; FileError where it is not XML, or larger than the limits."""
    raw = text.encode()
    parser = expat.ParserCreate()
    stack: list[Element] = []
    found: list[Element] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        line, first = parser.CurrentLineNumber, parser.CurrentByteIndex
        # the start tag ends at the first > outside of quotes
        tag = START_TAG.match(raw, first)
        end = raw.index(b">", first) + 1 if tag is None else tag.end()
        element = Element(name, attributes, path, line, first, end, end)
        found.append(element)
        if len(found) > XML_ELEMENTS.count:
            raise XML_ELEMENTS.make_error(what, path, line=line)
        if len(stack) >= XML_DEPTH.count:
            raise XML_DEPTH.make_error(what, path, line=line)
        if stack:
            stack[-1].children.append(element)
        stack.append(element)

    def end(_: str) -> None:
        element = stack.pop()
        element.close = max(element.end, parser.CurrentByteIndex)

    def read_characters(characters: str) -> None:
        if stack and not stack[-1].children:
            stack[-1].text += characters

    def refuse_doctype(*_: Any) -> None:
        sentence = f"this {what} has a document type. Remove <!DOCTYPE ..>"
        raise FileError(sentence, path, parser.CurrentLineNumber)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = read_characters
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(raw, True)
    except expat.ExpatError as error:
        sentence = f"not valid XML ({expat.ErrorString(error.code)}). Correct it"
        raise FileError(sentence, path, error.lineno) from None
    return found[0]


# Links and joints as a tree.


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """A joint from link `parent` to `child`: R, P, S, U (about `axis`, then `axis_2`), "" if fixed.

    `origin` : (4, 4) T_parent_joint [m]. `axis`, `axis_2` : (3,) unit vectors. `limits` : [rad or
    m]. `line` : from 1. `element` : what states its origin, None without. `mimic` : the joint that
    it follows, factor and offset [rad or m]; None without. `rounding` : error of origin and axis by
    the rounding of their numbers [m, rad]. `shifts` : whether the file can state another origin.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: FloatArray
    axis: FloatArray
    limits: tuple[float, float] | None
    line: int
    element: Element | None = None
    mimic: tuple[str, float, float] | None = None
    rounding: tuple[float, float] = (0.0, 0.0)
    axis_2: FloatArray = field(default_factory=lambda: np.eye(3)[1])
    shifts: bool = True


@dataclass(frozen=True, eq=False)
class Constraint:
    """A constraint between two links: R, P, S, U, or "" for a rigid link that was cut.

    `ends` are its frames on both links, as fixed joints without a child; `axes` (3,) unit vectors
    in each of the frames. `derived` : whether only one end is written, and the other one is where
    it is in the drawn pose.
    """

    name: str
    kind: str
    ends: tuple[TreeJoint, TreeJoint]
    axes: tuple[FloatArray, FloatArray]
    line: int
    derived: bool = False


@dataclass(frozen=True)
class LinkTree:
    """A file: joints by name, the link `root` that no joint carries, `carrier` link -> joint that
    carries it, constraints that close loops, and `motors` joint -> line.

    `rewrite` : returns the text with the origins and axes of another tree, from both trees.
    `hidden` : links that the file does not name. `notes` : what was left out.
    """

    path: Path
    text: str
    joints: Mapping[str, TreeJoint]
    root: str
    carrier: Mapping[str, TreeJoint]
    constraints: tuple[Constraint, ...]
    motors: Mapping[str, int]
    rewrite: Callable[[LinkTree, LinkTree], str]
    hidden: frozenset[str] = frozenset()
    notes: tuple[Any, ...] = ()

    @cached_property
    def places(self) -> Mapping[str, TreeJoint]:
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

    def with_joints(self, changed: Iterable[TreeJoint]) -> LinkTree:
        """Return the tree with other joints in the place of those of their names."""
        joints = {**self.joints, **{joint.name: joint for joint in changed}}
        carrier = {link: joints[joint.name] for link, joint in self.carrier.items()}
        return replace(self, joints=joints, carrier=carrier)

    def with_origins(self, moved: Mapping[str, FloatArray]) -> LinkTree:
        """Return the tree with other origins (4, 4) of joints and ends of constraints."""

        def move(place: TreeJoint) -> TreeJoint:
            return replace(place, origin=moved.get(place.name, place.origin))

        constraints = tuple(
            replace(constraint, ends=(move(constraint.ends[0]), move(constraint.ends[1])))
            for constraint in self.constraints
        )
        tree = self.with_joints(map(move, self.joints.values()))
        return replace(tree, constraints=constraints)


def require_links(
    known: Collection[str], what: str, links: Iterable[str], error: Callable[[str], FileError]
) -> None:
    """Refuse a joint or constraint that names a link which is not among the known ones."""
    for link in links:
        if link not in known:
            sentence = f"{what} names the link {link!r}, which does not exist"
            raise error(f"{sentence}{suggest_names(link, known)}. Correct it")


def make_end(
    constraint: str,
    end: str,
    link: str,
    origin: FloatArray,
    line: int,
    element: Element | None = None,
    rounding: tuple[float, float] = (0.0, 0.0),
) -> TreeJoint:
    """Return the end `parent` or `child` of a constraint, a frame (4, 4) of a link [m]."""
    name, x = f"{constraint}_{end}", np.eye(3)[0]
    return TreeJoint(name, "", link, "", origin, x, None, line, element, rounding=rounding)


def build_tree(
    path: Path,
    text: str,
    links: Sequence[str],
    joints: Sequence[TreeJoint],
    constraints: Sequence[Constraint],
    motors: Mapping[str, int],
    rewrite: Callable[[LinkTree, LinkTree], str],
    what: str,
) -> LinkTree:
    """Return the tree of links and joints; FileError for repeated names, or no single tree."""
    named: dict[str, set[str]] = {"joint": set(), "constraint": set()}
    known = dict.fromkeys(links)
    joined = [("joint", joint, (joint.parent, joint.child)) for joint in joints]
    joined += [("constraint", c, tuple(end.parent for end in c.ends)) for c in constraints]
    for sort, entry, _ in joined:
        if entry.name in named[sort]:
            raise FileError(f"duplicate {sort} {entry.name!r}. Rename one", path, entry.line)
        if (fault := find_fault(entry.name)) is not None:
            raise FileError(fault, path, entry.line)
        named[sort].add(entry.name)
        XML_JOINTS.check(len(named[sort]), what, path, entry.line)
    for sort, entry, ends in joined:
        error = partial(FileError, path=path, line=entry.line)
        require_links(known, f"{sort} {entry.name!r}", ends, error)
    carrier: dict[str, TreeJoint] = {}
    for joint in joints:
        if joint.child in carrier:
            other = carrier[joint.child].name
            sentence = f"link {joint.child!r} is the child of {other!r} and of {joint.name!r}"
            raise FileError(f"{sentence}, but a URDF is a tree. Correct it", path, joint.line)
        carrier[joint.child] = joint
    roots = [link for link in links if link not in carrier]
    if len(roots) != 1:
        listed = ", ".join((*roots[:4], "..")[: len(roots)])
        sentence = f"this {what.removesuffix(' file')} has {len(roots)} root links ({listed})"
        raise FileError(f"{sentence}. Allowed: one. Join them", path)
    _refuse_cycles(path, links, roots[0], carrier)
    tree = {joint.name: joint for joint in joints}
    return LinkTree(path, text, tree, roots[0], carrier, tuple(constraints), motors, rewrite)


def _refuse_cycles(
    path: Path, links: Collection[str], root: str, carrier: Mapping[str, TreeJoint]
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
            sentence = f"joint {joint.name!r} closes a circle of links: {joint.child!r} carries"
            raise FileError(f"{sentence} itself. Correct its parent", path, joint.line)
        carried |= chain.keys()


def draw_links(tree: LinkTree) -> dict[str, FloatArray]:
    """Return link -> T_root_link (4, 4) with all joints at zero [m]."""
    drawn = {tree.root: np.eye(4)}
    for start in tree.carrier:
        chain, link = [], start
        while link not in drawn:
            chain.append(tree.carrier[link])
            link = chain[-1].parent
        for joint in reversed(chain):
            drawn[joint.child] = drawn[joint.parent] @ joint.origin
    return drawn


def derive_end(drawn: Mapping[str, FloatArray], link: str, other: str, T: FloatArray) -> FloatArray:
    """Return the frame of a link that is drawn where the frame T (4, 4) of another one is."""
    return geometry.invert_pose(drawn[link]) @ drawn[other] @ T
