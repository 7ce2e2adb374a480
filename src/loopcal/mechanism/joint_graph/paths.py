# SPDX-License-Identifier: Apache-2.0
"""A mechanism of bodies and joints as limbs from body to body, in stages from base to platform.

Bodies with three or more joints are nodes, base and platform among them; the joints between two
nodes are a limb.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.joint_graph.graph import Coupling, GraphJoint, turn_between
from loopcal.mechanism.joint_graph.loops import (
    Freedoms,
    JointGraph,
    Repair,
    find_freedoms,
    find_homes,
    list_nearby,
    repair_rounded_loops,
)
from loopcal.typing import FloatArray

# Blocks of a mechanism: joints in no loop, and groups of loops that share more than one body.


@dataclass(frozen=True, eq=False)
class Block:
    """A block.

    graph : its joints; its base is the body that carries them. platform : the body that carries
        what follows; empty where this is not decided.
    """

    graph: JointGraph
    platform: str = ""

    @property
    def is_serial(self) -> bool:
        """Return whether the block is a joint in no loop."""
        return len(self.graph.joints) == 1


def list_blocks(graph: JointGraph) -> tuple[Block, ...]:
    """Return all blocks, each after the one that carries it."""
    carrier = {joint.body_b: joint for joint in graph.tree}
    group = {joint: joint for joint in graph.joints}
    for closing in graph.closing:
        loop = {closing}
        for end in closing.bodies:  # joints to the base that both have drop out
            body = end
            while body in carrier:
                loop ^= {carrier[body]}
                body = carrier[body].body_a
        joined = {group[joint] for joint in loop}
        group = {joint: closing if of in joined else of for joint, of in group.items()}
    blocks = []
    for first in dict.fromkeys(group[joint] for joint in graph.tree):
        own = select_joints(graph, {joint for joint, of in group.items() if of is first})
        blocks.append(Block(replace(own, base=own.tree[0].body_a)))
    return tuple(blocks)


def find_blocks(graph: JointGraph, platform: str) -> tuple[Block, ...]:
    """Return the blocks from the base to a platform, with the platform of each; those between two
    that one drive moves, or whose joints are coupled, are one block.
    """
    carrying = {body: block for block in list_blocks(graph) for body in block.graph.bodies[1:]}
    path: list[Block] = []
    body = platform
    while body != graph.base:
        path.insert(0, Block(carrying[body].graph, body))
        body = carrying[body].graph.base
    for drive in graph.leads:
        moved = [i for i, block in enumerate(path) if drive in block.graph.leads]
        if len(moved) > 1:
            first, last = moved[0], moved[-1]
            joints = {joint for block in path[first : last + 1] for joint in block.graph.joints}
            joined = replace(select_joints(graph, joints), base=path[first].graph.base)
            path[first : last + 1] = [Block(joined, path[last].platform)]
    return tuple(path)


def select_joints(graph: JointGraph, joints: Collection[GraphJoint]) -> JointGraph:
    """Return the mechanism with some of its joints only."""
    tree = tuple(joint for joint in graph.tree if joint in joints)
    drives = {joint.drive for joint in tree}
    return JointGraph(
        graph.base,
        tree,
        tuple(joint for joint in graph.closing if joint in joints),
        tuple(name for name in graph.motors if name in drives),
    )


MOTION = 1e-9  # smallest part of a motion that counts [m, rad]; rounding is below 1e-12
ACROSS = 5e-5  # smallest sine between a shift and the normal of its plane that counts [1]


@dataclass(frozen=True, eq=False)
class GraphLimb:
    """Joints from the body `on` to the body `to`, each from the body before it."""

    on: str
    to: str
    joints: tuple[GraphJoint, ...]

    def reverse(self) -> GraphLimb:
        """Return the limb from its other end."""
        joints = tuple(joint.reverse() for joint in reversed(self.joints))
        return GraphLimb(self.to, self.on, joints)


def find_limbs(graph: JointGraph, platform: str) -> tuple[GraphLimb, ...]:
    """Return limbs between base, platform and all bodies with three or more joints, without dead
    ends; the limbs of the first motor first. A ball joint is at the end of its limb.
    """
    ends, joints = (graph.base, platform), list(graph.joints)
    while True:
        count = Counter(body for joint in joints for body in joint.bodies)
        kept = [j for j in joints if all(count[b] > 1 or b in ends for b in j.bodies)]
        if len(kept) == len(joints):
            break
        joints = kept
    inner = [body for body in graph.bodies if count[body] > 2 and body not in ends]
    while True:
        limbs = list(_walk_limbs(joints, (graph.base, *inner, platform)))
        circle = next((limb for limb in limbs if limb.on == limb.to), None)
        if circle is None:
            break
        inner.append(circle.joints[len(circle.joints) // 2].body_a)
    order = {motor: i for i, motor in enumerate(graph.motors)}  # passive limbs last
    return tuple(
        sorted(limbs, key=lambda limb: min(order.get(j.drive, len(order)) for j in limb.joints))
    )


def _walk_limbs(joints: Sequence[GraphJoint], nodes: Sequence[str]) -> Iterator[GraphLimb]:
    """Yield the limbs of joints between bodies; each begins at the earlier one of its nodes, but a
    limb with a ball joint at its beginning only.
    """
    left = list(joints)
    for node in nodes:
        for first in [joint for joint in left if node in joint.bodies]:
            if first not in left:
                continue  # a circle has passed it
            path, joint, body = [], first, node
            while True:
                left.remove(joint)
                path.append(joint.orient(body))
                body = path[-1].body_b
                if body in nodes:
                    break
                joint = next(other for other in left if body in other.bodies)
            limb = GraphLimb(node, body, tuple(path))
            is_turned = node != nodes[0] and path[0].kind == "S" != path[-1].kind
            yield limb.reverse() if is_turned else limb


def _keep_shifts_in_plane(
    graph: JointGraph, home: FloatArray, limbs: tuple[GraphLimb, ...], freedoms: tuple[str, ...]
) -> tuple[GraphLimb, ...]:
    """Return limbs without the shifts that no equation contains: those normal to their plane, and
    of slides alone those across their motions.
    """
    turning, free = ([i for i in range(3) if AXES[i + k] in freedoms] for k in (0, 3))
    if len(turning) > 1 or {*turning} & {*free}:
        return limbs
    moved = [i for i in range(3) if i not in turning] if turning else free
    placement = graph.place(home[None])

    def keep(joint: GraphJoint) -> GraphJoint:
        R = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0, :3, :3]
        share = np.linalg.norm(R[moved], axis=0)
        across = [a for a in joint.shifts if share["xyz".index(a)] > ACROSS]
        return replace(joint, shifts="".join(across))

    return tuple(replace(limb, joints=tuple(map(keep, limb.joints))) for limb in limbs)


def list_freedoms(
    graph: JointGraph,
    home: FloatArray,
    platform: str,
    T_body_frame: FloatArray,
    of_joints: bool = False,
) -> tuple[str, ...]:
    """Return the components of twist in which a frame of the platform moves, at home or near it.

    With `of_joints`, those in which any joint alone would move it.
    """
    largest = np.zeros(6)
    for q in list_nearby(graph, home):
        motion = graph.find_twists(q, platform, T_body_frame) @ graph.find_motions(q)
        moves = [motion]
        if of_joints:
            moves += _list_joint_twists(graph, q, platform, T_body_frame)
        largest = np.maximum(largest, np.abs(np.column_stack(moves)).max(axis=1, initial=0.0))
    limit = MOTION * np.array([1.0] * 3 + [max(1.0, graph.size)] * 3)
    return tuple(name for name, size in zip(AXES, largest > limit, strict=True) if size)


def _list_joint_twists(
    graph: JointGraph, q: FloatArray, platform: str, T_body_frame: FloatArray
) -> list[FloatArray]:
    """Return the twists (6, 1 or 3) that each joint alone gives a frame of the platform."""
    placement = graph.place(q[None])
    origin = (graph.get_place(placement, platform) @ T_body_frame)[0, :3, 3]
    twists = []
    for joint in graph.joints:
        frame = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0]
        axes = frame[:3, :3] if joint.kind == "S" else (frame[:3, :3] @ joint.axis)[:, None]
        arms = np.cross(axes, origin - frame[:3, 3], axisa=0, axisc=0)
        slides = joint.kind == "P"
        twists.append(np.concatenate([0.0 * axes, axes] if slides else [axes, arms]))
    return twists


# A mechanism of bodies and joints as a chain of stages, from the base to the platform.

FIRM, FIRM_DRAWN = 0.5, 0.01
"""Share of the best firmness that a home pose must have, and the pose that was drawn [1]."""

FLOATING = 6  # number of passive joints by which a file lets the base of a machine float

PARALLEL, ALONG = 1e-9, 1e-12
"""Largest sine between axes that count as parallel, and component across an axis of a frame [1]."""


@dataclass(frozen=True, eq=False)
class ClosedStage:
    """A stage with closed loops, as limbs.

    graph : its base carries the limbs, with a frame of its own. home : joint values (j,).
    platform : the body that carries what follows. limbs : all joints but those of dead ends.
    freedoms : of the bodies, in base axes.
    mount : (4, 4) the base frame in the body that carries the stage [m]; turned where the normal of
        the plane of the loops is not an axis of that body.
    frame : (4, 4) of its platform in the body that carries what follows [m].
    """

    graph: JointGraph
    home: FloatArray
    platform: str
    limbs: tuple[GraphLimb, ...]
    freedoms: tuple[str, ...]
    mount: FloatArray
    frame: FloatArray

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Return the bodies beside base and platform that limbs join."""
        ends = dict.fromkeys(end for limb in self.limbs for end in (limb.on, limb.to))
        return tuple(body for body in ends if body not in (self.graph.base, self.platform))

    @cached_property
    def used(self) -> JointGraph:
        """Return the mechanism without dead ends."""
        names = {joint.name for limb in self.limbs for joint in limb.joints}
        return select_joints(self.graph, {j for j in self.graph.joints if j.name in names})


@dataclass(frozen=True, eq=False)
class SerialStage:
    """A driven joint in no loop.

    start : its value at home [rad or m]. frame : (4, 4) of its platform in the body that carries
        what follows [m].
    """

    joint: GraphJoint
    start: float
    frame: FloatArray

    @property
    def platform(self) -> str:
        """Return the body that carries what follows."""
        return self.joint.body_b


@dataclass(frozen=True, eq=False)
class StagePaths:
    """A mechanism as stages.

    graph : what is between base and platform. home : joint values (j,). platform : its body.
    stages : from the base on. motions : what motors and passive joints can do at home.
    dangling : joints that were left out. outside : motors among them.
    repair : what was done to loops with rounded numbers.
    """

    graph: JointGraph
    home: FloatArray
    platform: str
    stages: tuple[ClosedStage | SerialStage, ...]
    motions: Freedoms
    dangling: tuple[str, ...]
    outside: tuple[str, ...]
    repair: Repair

    @cached_property
    def freedoms(self) -> tuple[str, ...]:
        """Return the components of twist in which the platform moves, in base axes."""
        if len(self.stages) == 1 and isinstance(self.stages[0], ClosedStage):
            return self.stages[0].freedoms
        return list_freedoms(self.graph, self.home, self.platform, self.stages[-1].frame)


def find_stage_paths(
    whole: JointGraph,
    platform: str,
    locate_frame: Callable[[str], FloatArray],
    measure_rounding: Callable[[tuple[str, ...]], tuple[float, float]] = lambda _: (0.0, 0.0),
) -> StagePaths:
    """Return the stages at the nearest home pose in which the motors hold the platform firmly.

    `locate_frame` gives the frame (4, 4) of a body that is the platform of a stage,
    `measure_rounding` the rounding errors [m, rad] of numbers that describe some bodies. Refusals
    name the joints.
    """
    path = find_blocks(whole, platform)
    floating = next((i for i, block in enumerate(path) if block.graph.motors), 0)
    path = path[floating:] if floating >= FLOATING else path
    whole = replace(whole, base=path[0].graph.base)
    kept = select_joints(whole, {joint for block in path for joint in block.graph.joints})
    repair = _repair_blocks(kept, find_blocks(kept, platform), measure_rounding)
    graph = repair.graph
    blocks = find_blocks(graph, platform)
    for block in blocks:
        if not block.graph.motors:
            names = tuple(joint.name for joint in block.graph.joints)
            raise MechanismError.of("files.joints-not-held", joints=names, platform=platform)
    if all(block.is_serial for block in blocks):
        blocks = (Block(graph, platform),)
    homes, is_drawn = find_homes(graph)
    moving = [find_freedoms(graph, q, platform) for q in homes]
    limit = (FIRM_DRAWN if is_drawn else FIRM) * max(own.firmness for own in moving)
    home, motions = next(
        pair for pair in zip(homes, moving, strict=True) if pair[1].firmness >= limit
    )
    stages: list[ClosedStage | SerialStage] = []
    for block, mount in map(_turn_base, blocks):
        frame = locate_frame(block.platform)
        values = home[[graph.names.index(name) for name in block.graph.names]]
        if block.is_serial and len(blocks) > 1 and block.graph.tree[0].is_plain:
            stages.append(SerialStage(block.graph.tree[0], float(values[0]), frame))
        else:
            # loops are closed in all components of twist that one of their joints can have
            own = block.graph, values, block.platform
            freedoms = list_freedoms(*own, frame, of_joints=True)
            limbs = find_limbs(block.graph, block.platform)
            limbs = _keep_shifts_in_plane(block.graph, values, limbs, freedoms)
            if find_freedoms(*own).mobility == 0:
                raise MechanismError.of("files.no-motion", platform=block.platform)
            stages.append(ClosedStage(*own, limbs, freedoms, mount, _align_frame(*own, frame)))
    names = {joint.name for joint in kept.joints}
    dangling = tuple(joint.name for joint in whole.joints if joint.name not in names)
    outside = tuple(name for name in whole.motors if name not in graph.motors)
    return StagePaths(graph, home, platform, tuple(stages), motions, dangling, outside, repair)


def list_possible_platforms(graph: JointGraph) -> tuple[str, ...]:
    """Return the bodies at the ends of the mechanism: of a loop the ones with most joints, and not
    those that fewer joints than motors carry, where others have more.
    """
    driven = [block for block in list_blocks(graph) if block.graph.motors]
    carrying = {
        joint
        for block in driven
        for before in find_blocks(graph, block.graph.base)
        for joint in before.graph.joints
    }
    ends = [block.graph for block in driven if not carrying & {*block.graph.joints}]
    return tuple(body for end in ends for body in _list_ends(end))


def _list_ends(graph: JointGraph) -> tuple[str, ...]:
    """Return the bodies of a block that can be its platform."""
    counts = Counter(body for joint in graph.joints for body in joint.bodies)
    carried, left = {graph.base: 0}, list(graph.joints)
    while left:  # joints from the base to each body, along the shortest way
        reached = [joint for joint in left if {*joint.bodies} & {*carried}]
        count = max(carried.values()) + 1
        carried |= {b: count for joint in reached for b in joint.bodies if b not in carried}
        left = [joint for joint in left if joint not in reached]
    del counts[graph.base]
    most = [body for body, count in counts.items() if count == max(counts.values())]
    needed = min(max(carried[body] for body in most), len(graph.motors))
    return tuple(body for body in most if carried[body] >= needed)


def _repair_blocks(
    graph: JointGraph,
    blocks: tuple[Block, ...],
    measure_rounding: Callable[[tuple[str, ...]], tuple[float, float]],
) -> Repair:
    """Return the mechanism with the rounded loops of its blocks repaired, and the largest gaps."""
    repairs = [
        repair_rounded_loops(block.graph, measure_rounding(block.graph.bodies))
        for block in blocks
        if not block.is_serial
    ]
    joints = {joint.name: joint for repair in repairs for joint in repair.graph.joints}
    return Repair(
        graph.change_joints(lambda joint: joints.get(joint.name, joint)),
        max((repair.gap for repair in repairs), default=0.0),
        max((repair.angle for repair in repairs), default=0.0),
        max((repair.turn for repair in repairs), default=0.0),
    )


def _turn_base(block: Block) -> tuple[Block, FloatArray]:
    """Return a block in a base frame whose axes are along and across the plane of its loops, and
    that frame (4, 4) in the body that carries it, unturned where the loops are not in one plane.
    """
    graph = block.graph
    axes = graph.place(np.zeros((1, len(graph.tree)))).axes[0]
    turning = axes[graph.turns]
    if block.is_serial or not len(turning):
        return block, np.eye(4)
    normal = turning[0]
    is_plane = np.abs(np.cross(turning, normal)).max() < PARALLEL
    is_plane &= bool((np.abs(axes[~graph.turns] @ normal) < PARALLEL).all())
    if not is_plane or np.sort(np.abs(normal))[1] < ALONG:
        return block, np.eye(4)
    R = turn_between(np.eye(3)[2], normal)
    mount = geometry.make_pose(R, np.zeros(3))
    inverse, base = geometry.invert_pose(mount), graph.base

    def move(joint: GraphJoint) -> GraphJoint:
        near = inverse @ joint.T_a if joint.body_a == base else joint.T_a
        far = inverse @ joint.T_b if joint.body_b == base else joint.T_b
        return replace(joint, T_a=near, T_b=far)

    return replace(block, graph=graph.change_joints(move)), mount


def _align_frame(
    graph: JointGraph, home: FloatArray, platform: str, T_body_frame: FloatArray
) -> FloatArray:
    """Return a frame (4, 4) of the platform with only those angles at home that it can change: a
    robot file states no others.
    """
    moving = list_freedoms(graph, home, platform, T_body_frame)
    turns = [name in moving for name in AXES[:3]]
    place = graph.locate(home, platform)
    angles = geometry.matrix_to_euler((place @ T_body_frame)[:3, :3], "xyz")
    if not any(turns) or np.abs(angles[np.logical_not(turns)]).max(initial=0.0) < ALONG:
        return T_body_frame
    R = geometry.euler_to_matrix(np.where(turns, angles, 0.0), "xyz")
    return geometry.make_pose(place[:3, :3].T @ R, T_body_frame[:3, 3])


# From links, joints and welded frames to a mechanism: rigid bodies, pins, a tree and its
# closures.

COAXIAL = 1e-9  # difference of two frames or axes that count as the same [m, 1]


@dataclass(frozen=True, eq=False)
class Weld:
    """Frames `T_a` and `T_b` (4, 4) of two links that coincide. `name` is for messages."""

    name: str
    body_a: str
    body_b: str
    T_a: FloatArray
    T_b: FloatArray


@dataclass(frozen=True, eq=False)
class Bodies:
    """The rigid bodies that welds make: link -> its body and T_body_link (4, 4)."""

    places: dict[str, tuple[str, FloatArray]]

    def locate(self, link: str) -> tuple[str, FloatArray]:
        """Return the body of a link and T_body_link (4, 4)."""
        return self.places.get(link, (link, np.eye(4)))

    def list_links(self, body: str) -> tuple[str, ...]:
        """Return the links of a body, its own first."""
        return (body, *(link for link, (name, _) in self.places.items() if name == body != link))

    def move(self, joint: GraphJoint) -> GraphJoint:
        """Return a joint between links as one between bodies."""
        (a, A), (b, B) = self.locate(joint.body_a), self.locate(joint.body_b)
        return replace(joint, body_a=a, body_b=b, T_a=A @ joint.T_a, T_b=B @ joint.T_b)


def weld_bodies(base: str, welds: Sequence[Weld]) -> Bodies:
    """Return the rigid bodies that welds make; raises MechanismError for a weld within one."""
    bodies = Bodies({})
    for weld in welds:
        (a, A), (b, B) = bodies.locate(weld.body_a), bodies.locate(weld.body_b)
        if a == b:
            raise MechanismError.of("files.closure-within-body", closure=weld.name, body=a)
        T_ab = A @ weld.T_a @ geometry.invert_pose(B @ weld.T_b)
        if b == base:
            a, b, T_ab = b, a, geometry.invert_pose(T_ab)
        moved = {link: (a, T_ab @ bodies.locate(link)[1]) for link in bodies.list_links(b)}
        bodies = Bodies(bodies.places | moved)
    return bodies


def assemble_graph(base: str, joints: Sequence[GraphJoint], motors: tuple[str, ...]) -> JointGraph:
    """Return the mechanism of joints between bodies; raises MechanismError for a joint within a
    body, a repeated one, or a loop of driven joints only.
    """
    for joint in joints:
        if joint.body_a == joint.body_b:
            raise MechanismError.of(
                "files.closure-within-body", closure=joint.name, body=joint.body_a
            )
    _refuse_repeated(joints)
    joints = [replace(j, drive=j.name) if j.name in motors else j for j in joints]
    tree, closing = _span_tree(base, _merge_pins(base, list(joints)))
    return JointGraph(base, tree, closing, motors)


# Largest difference between a joint and the one that it follows [rad, m], and of factors [1].
MIMICS = 1e-9


def couple_joints(
    graph: JointGraph, couplings: Sequence[Coupling]
) -> tuple[JointGraph, tuple[Coupling, ...]]:
    """Return the mechanism in which joints follow a motor, or a passive joint, and the couplings
    that contradict others. Those that the loops contain are left out.
    """
    joints = {joint.name: joint for joint in graph.joints}
    plain = {name for name, joint in joints.items() if not joint.is_pin}  # not two joints in one
    known = [c for c in couplings if {c.joint, c.leader} <= plain]
    if not known:
        return graph, tuple(couplings)
    left = [c for c in couplings if c not in known or not c.factor]
    near = list_nearby(graph, find_homes(graph)[0][0]) if graph.closing else np.zeros((0, 0))
    known = [c for c in known if c.factor and not _is_contained(graph, near, c)]
    back = [Coupling(c.leader, c.joint, 1 / c.factor, -c.offset / c.factor) for c in known]
    both = [c for pair in zip(known, back, strict=True) for c in pair]
    laws: dict[str, tuple[str, float, float]] = {}
    # joints that no motor moves follow the first of them
    for leaders in ([j.name for j in graph.tree if j.drive], *([c.leader] for c in known)):
        laws = {name: (name, 1.0, 0.0) for name in leaders} | laws
        for c in both * len(known):
            if c.leader in laws:
                drive, ratio, offset = laws[c.leader]
                laws.setdefault(c.joint, (drive, c.factor * ratio, c.factor * offset + c.offset))
    for c in known:
        (drive, *values), (other, ratio, offset) = laws[c.joint], laws[c.leader]
        expected = c.factor * ratio, c.factor * offset + c.offset
        if drive != other or not np.allclose(values, expected, rtol=MIMICS, atol=MIMICS):
            left.append(c)
    for name, (drive, ratio, offset) in laws.items():
        joints[name] = replace(joints[name], drive=drive, ratio=ratio, offset=offset)
    tree, closing = _span_tree(graph.base, tuple(joints.values()))
    return JointGraph(graph.base, tree, closing, graph.motors), tuple(left)


def _is_contained(graph: JointGraph, near: FloatArray, coupling: Coupling) -> bool:
    """Return whether a coupling is true at poses (n, j) that the loops allow."""
    names = graph.names
    if len(near) < 2 or not {coupling.joint, coupling.leader} <= {*names}:
        return False
    i, j = names.index(coupling.joint), names.index(coupling.leader)
    gap = near[:, i] - coupling.factor * near[:, j] - coupling.offset
    turns = np.round(gap[0] / (2 * np.pi)) * 2 * np.pi if graph.tree[i].kind == "R" else 0.0
    return bool(np.abs(gap - turns).max() < MIMICS)


def _refuse_repeated(joints: Sequence[GraphJoint]) -> None:
    """Refuse two rotary or ball joints of the same points of two bodies; raises MechanismError."""
    turning = [joint for joint in joints if joint.kind != "P"]
    for i, joint in enumerate(turning):
        for other in turning[:i]:
            if {*joint.bodies} != {*other.bodies}:
                continue
            same = other.orient(joint.body_a)
            gaps = (joint.T_a[:3, 3] - same.T_a[:3, 3], joint.T_b[:3, 3] - same.T_b[:3, 3])
            if np.abs(gaps).max() < COAXIAL:
                raise MechanismError.of(
                    "files.closure-repeated",
                    closure=joint.name,
                    other=other.name,
                    body_a=joint.body_a,
                    body_b=joint.body_b,
                )


def _merge_pins(base: str, joints: list[GraphJoint]) -> tuple[GraphJoint, ...]:
    """Return the joints, in which two about one axis with nothing between them are one pin."""
    for body in dict.fromkeys(name for j in joints for name in j.bodies):
        ends = [joint for joint in joints if body in joint.bodies]
        if body == base or len(ends) != 2 or not _are_coaxial(body, *ends):
            continue
        first, second = ends
        if first.drive or second.drive or not (first.origin_a and second.origin_a):
            continue
        pin = replace(
            first, body_b=second.body_a, T_b=second.T_a, origin_b=second.origin_a, limits=None
        )
        joints = [joint for joint in joints if joint not in ends]
        joints.append(pin)
    return tuple(joints)


def _are_coaxial(body: str, first: GraphJoint, second: GraphJoint) -> bool:
    """Return whether two rotary joints carry a body at the same frame and axis."""
    if first.kind != "R" or second.kind != "R" or not first.body_b == second.body_b == body:
        return False
    same_frame = np.abs(first.T_b - second.T_b).max() < COAXIAL
    return bool(same_frame and np.abs(first.axis - second.axis).max() < COAXIAL)


def _span_tree(
    base: str, joints: Sequence[GraphJoint]
) -> tuple[tuple[GraphJoint, ...], tuple[GraphJoint, ...]]:
    """Return the joints of a tree, each after the one that carries it, and the other joints; raises
    MechanismError for a loop of driven and coupled joints only.
    """

    def rank(joint: GraphJoint) -> int:
        if joint.drive:
            return 0
        return 3 if joint.is_pin else "PR S".index(joint.kind) + 1

    group = {base: base} | {name: name for j in joints for name in j.bodies}
    chosen, closing = [], []
    for joint in sorted(joints, key=rank):
        group_a, group_b = group[joint.body_a], group[joint.body_b]
        (closing if group_a == group_b else chosen).append(joint)
        group = {body: group_a if name == group_b else name for body, name in group.items()}
    chosen = [joint for joint in joints if joint in chosen]
    tree: list[GraphJoint] = []
    bodies = {base}
    while chosen:
        ready = [joint for joint in chosen if {*joint.bodies} & bodies]
        if not ready:
            break  # joints of bodies that nothing joins to the base
        for joint in ready:
            oriented = joint.orient(joint.body_a if joint.body_a in bodies else joint.body_b)
            tree.append(oriented)
            bodies.add(oriented.body_b)
        chosen = [joint for joint in chosen if joint not in ready]
    lost = next((joint.name for joint in closing if joint.drive), None)
    if lost is not None:
        raise MechanismError.of("files.motors-in-loop", motor=lost)
    return tuple(tree), tuple(joint for joint in joints if joint in closing)
