# SPDX-License-Identifier: Apache-2.0
"""Limbs of a mechanism of bodies and joints: paths from base to platform that share nothing else.

Other bodies that branch from the limbs cannot be expressed, with one exception: where they only
keep the platform from turning (the parallelograms of a delta), the freedoms of the platform express
the same, and one path for each motor is left.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.joint_graph.graph import GraphJoint, turn_between
from loopcal.mechanism.joint_graph.loops import (
    Freedoms,
    JointGraph,
    Repair,
    find_freedoms,
    find_homes,
    is_drawn_pose,
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
        return not self.graph.closing


def list_blocks(graph: JointGraph) -> tuple[Block, ...]:
    """Return all blocks, each after the one that carries it."""
    carrier = {joint.body_b: joint for joint in graph.tree}
    group = {joint: joint for joint in graph.joints}
    for closing in graph.closing:
        loop = {closing}
        for end in (closing.body_a, closing.body_b):  # joints to the base that both have drop out
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
    """Return the blocks from the base to a platform, with the platform of each."""
    carrying = {body: block for block in list_blocks(graph) for body in block.graph.bodies[1:]}
    path: list[Block] = []
    body = platform
    while body != graph.base:
        path.append(Block(carrying[body].graph, body))
        body = carrying[body].graph.base
    return tuple(reversed(path))


def select_joints(graph: JointGraph, joints: Collection[GraphJoint]) -> JointGraph:
    """Return the mechanism with some of its joints only."""
    tree = tuple(joint for joint in graph.tree if joint in joints)
    names = {joint.name for joint in tree}
    return JointGraph(
        graph.base,
        tree,
        tuple(joint for joint in graph.closing if joint in joints),
        tuple(name for name in graph.motors if name in names),
    )


MOTION = 1e-9
"""Smallest part of a motion that counts [m, rad]; rounding is below 1e-12."""

Path = tuple[GraphJoint, ...]


@dataclass(frozen=True, eq=False)
class LimbPaths:
    """A mechanism as limbs.

    graph : its base carries the limbs. home : joint values (j,). platform : its body.
    limbs : joints of each limb, each from the body before it. freedoms : of the platform, in base
        axes. motions : what motors and passive joints can do at home.
    replaced : joints that the freedoms express.
    """

    graph: JointGraph
    home: FloatArray
    platform: str
    limbs: tuple[Path, ...]
    freedoms: tuple[str, ...]
    motions: Freedoms
    replaced: tuple[str, ...] = ()


def find_limbs(block: Block) -> tuple[tuple[Path, ...] | None, bool]:
    """Return the limbs of a block, None where one branches, and whether they are all of it; others
    need `is_translating`.
    """
    complete = find_complete_limbs(block.graph, block.platform)
    if complete is not None:
        return complete, True
    return _find_driven_limbs(block.graph, block.platform), False


def place_limbs(
    block: Block,
    home: FloatArray,
    limbs: tuple[Path, ...],
    is_complete: bool,
    T_body_frame: FloatArray,
) -> LimbPaths:
    """Return the limbs of a block at its home pose (j,), for a frame (4, 4) of its platform.

    Loops of complete limbs are closed in all components of twist that one of their joints can have.
    """
    graph, platform = block.graph, block.platform
    freedoms = list_freedoms(graph, home, platform, T_body_frame, is_complete)
    drives = {motor: i for i, motor in enumerate(graph.motors)}
    last = len(drives)  # passive limbs
    limbs = tuple(sorted(limbs, key=lambda limb: min(drives.get(j.name, last) for j in limb)))
    used = {joint.name for limb in limbs for joint in limb}
    used |= {joint.origin_b for limb in limbs for joint in limb}
    replaced = tuple(joint.name for joint in graph.joints if joint.name not in used)
    motions = find_freedoms(graph, home, platform)
    limbs = _keep_shifts_in_plane(graph, home, limbs, freedoms)
    return LimbPaths(graph, home, platform, limbs, freedoms, motions, replaced)


def _keep_shifts_in_plane(
    graph: JointGraph, home: FloatArray, limbs: tuple[Path, ...], freedoms: tuple[str, ...]
) -> tuple[Path, ...]:
    """Return limbs without the shifts normal to their plane, which no equation of it contains."""
    normals = [AXES[i + 3] for i in range(3) if AXES[i] in freedoms]
    if len(normals) != 1 or normals[0] in freedoms:
        return limbs
    normal = np.eye(3)[AXES[3:].index(normals[0])]
    placement = graph.place(home[None])

    def keep(joint: GraphJoint) -> GraphJoint:
        R = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0, :3, :3]
        across = [a for a in joint.shifts if abs(normal @ R[:, "xyz".index(a)]) < 1 - MOTION]
        return replace(joint, shifts="".join(across))

    return tuple(tuple(map(keep, limb)) for limb in limbs)


def is_translating(block: Block, home: FloatArray) -> bool:
    """Return whether motors set all freedoms of a platform that does not turn near a home pose."""
    motion = find_freedoms(block.graph, home, block.platform)
    if motion.mobility != len(block.graph.motors):
        return False
    freedoms = list_freedoms(block.graph, home, block.platform, np.eye(4))
    return len(freedoms) == motion.mobility and not any(name.startswith("r") for name in freedoms)


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


def find_complete_limbs(graph: JointGraph, platform: str) -> tuple[Path, ...] | None:
    """Return limbs that contain every body and joint; None where there are none."""
    left, limbs = list(graph.joints), []
    for first in [joint for joint in graph.joints if graph.base in (joint.body_a, joint.body_b)]:
        body, path = graph.base, [first]
        while (body := path[-1].get_other_body(body)) != platform:
            onward = [j for j in graph.joints if j is not path[-1] and body in (j.body_a, j.body_b)]
            if len(onward) != 1 or body == graph.base:
                return None
            path.append(onward[0])
        left = [joint for joint in left if joint not in path]
        limbs.append(_orient_path(path, graph.base))
    return tuple(limbs) if limbs and not left else None


def _find_driven_limbs(graph: JointGraph, platform: str) -> tuple[Path, ...] | None:
    """Return the shortest path through each motor on the base; None where two of them meet."""
    limbs, taken = [], {graph.base}
    for first in [joint for joint in graph.tree if joint.name in graph.motors]:
        path = _find_shortest_path(graph, first, platform)
        if path is None:
            return None
        bodies = {_get_end(path[: i + 1], graph.base) for i in range(len(path) - 1)}
        if taken & bodies:
            return None
        taken |= bodies
        limbs.append(_orient_path(path, graph.base))
    return tuple(limbs)


def _find_shortest_path(graph: JointGraph, first: GraphJoint, platform: str) -> Path | None:
    """Return the shortest path that begins with a joint on the base; None where there is none."""
    if first.body_a != graph.base:
        return None
    queue: list[Path] = [(first,)]
    visited = {graph.base, first.body_b}
    while queue:
        path = queue.pop(0)
        body = _get_end(path, graph.base)
        if body == platform:
            return path
        for joint in graph.joints:
            if body in (joint.body_a, joint.body_b):
                after = joint.get_other_body(body)
                if after not in visited:
                    visited.add(after)
                    queue.append((*path, joint))
    return None


def _orient_path(path: Sequence[GraphJoint], body: str) -> Path:
    """Return the joints of a limb, each from the body before it."""
    oriented = []
    for joint in path:
        oriented.append(joint.orient(body))
        body = joint.get_other_body(body)
    return tuple(oriented)


def _get_end(path: Sequence[GraphJoint], body: str) -> str:
    """Return the body at the end of a path."""
    for joint in path:
        body = joint.get_other_body(body)
    return body


# A mechanism of bodies and joints as a chain of stages, from the base to the platform.

FIRM, FIRM_DRAWN = 0.5, 0.01
"""Share of the best firmness that a home pose must have, and the pose that was drawn [1]."""

PARALLEL, ALONG = 1e-9, 1e-12
"""Largest sine between axes that count as parallel, and component across an axis of a frame [1]."""


@dataclass(frozen=True, eq=False)
class ClosedStage:
    """A stage with closed loops.

    paths : its limbs, from a base frame of its own.
    mount : (4, 4) that frame in the body that carries the stage [m]; turned where the normal of
        the plane of the loops is not an axis of that body.
    frame : (4, 4) of its platform in the body that carries what follows [m].
    """

    paths: LimbPaths
    mount: FloatArray
    frame: FloatArray

    @property
    def platform(self) -> str:
        """Return the body that carries what follows."""
        return self.paths.platform


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
            return self.stages[0].paths.freedoms
        return list_freedoms(self.graph, self.home, self.platform, self.stages[-1].frame)

    @property
    def replaced(self) -> tuple[str, ...]:
        """Return the joints that the freedoms of stages express."""
        closed = [stage for stage in self.stages if isinstance(stage, ClosedStage)]
        return tuple(name for stage in closed for name in stage.paths.replaced)


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
    path = find_blocks(whole, platform)  # without joints that move nothing in between
    kept = select_joints(whole, {joint for block in path for joint in block.graph.joints})
    repair = _repair_blocks(kept, find_blocks(kept, platform), measure_rounding)
    graph = repair.graph
    blocks = find_blocks(graph, platform)
    for block in blocks:
        if not block.graph.motors:
            names = tuple(joint.name for joint in block.graph.joints)
            finding = report_finding("files.joints-not-held", joints=names, platform=platform)
            raise MechanismError(finding)
    if all(block.is_serial for block in blocks):
        blocks = (Block(graph, platform),)
    turned = [_turn_base(block) for block in blocks]
    homes, limbs = find_homes(graph), []
    for i, (block, _) in enumerate(turned):
        limbs.append(find_limbs(block))
        paths, is_complete = limbs[i]
        if paths is not None and not is_complete:
            homes = tuple(q for q in homes if is_translating(block, _select(graph, q, block)))
        if paths is None or not homes:
            raise MechanismError(_describe_branch(whole, block, platform))
    moving = [find_freedoms(graph, q, platform) for q in homes]
    share = FIRM_DRAWN if is_drawn_pose(graph, homes[0]) else FIRM
    limit = share * max(freedoms.firmness for freedoms in moving)
    pairs = zip(homes, moving, strict=True)
    home, motions = next(pair for pair in pairs if pair[1].firmness >= limit)
    stages: list[ClosedStage | SerialStage] = []
    for (block, mount), (paths, is_complete) in zip(turned, limbs, strict=True):
        assert paths is not None
        frame = locate_frame(block.platform)
        values = _select(graph, home, block)
        if block.is_serial and len(blocks) > 1:
            stages.append(SerialStage(block.graph.tree[0], float(values[0]), frame))
        else:
            closed = place_limbs(block, values, paths, is_complete, frame)
            stages.append(ClosedStage(closed, mount, _align_frame(closed, frame)))
    names = {joint.name for joint in kept.joints}
    dangling = tuple(joint.name for joint in whole.joints if joint.name not in names)
    outside = tuple(name for name in whole.motors if name not in graph.motors)
    return StagePaths(graph, home, platform, tuple(stages), motions, dangling, outside, repair)


def list_possible_platforms(graph: JointGraph) -> tuple[str, ...]:
    """Return the bodies at the ends of the mechanism that limbs join to what carries them: of a
    loop the ones with most limbs, and not those that fewer joints than motors carry, where others
    have more.
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
    counts, carried = {}, {}
    for body in graph.bodies[1:]:
        limbs = find_complete_limbs(graph, body)
        if limbs is not None:
            carried[body] = min(len(limb) for limb in limbs)
            counts[body] = len(limbs)
    needed = min(max(carried.values(), default=0), len(graph.motors))
    counts = {body: count for body, count in counts.items() if carried[body] >= needed}
    most = max(counts.values(), default=0)
    return tuple(body for body, count in counts.items() if count == most)


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
    tree, closing = (
        tuple(joints.get(joint.name, joint) for joint in before)
        for before in (graph.tree, graph.closing)
    )
    return Repair(
        replace(graph, tree=tree, closing=closing),
        max((repair.gap for repair in repairs), default=0.0),
        max((repair.angle for repair in repairs), default=0.0),
        max((repair.turn for repair in repairs), default=0.0),
    )


def _select(graph: JointGraph, q: FloatArray, block: Block) -> FloatArray:
    """Return the values (b,) of the joints of a block."""
    return q[[graph.names.index(name) for name in block.graph.names]]


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

    tree, closing = (tuple(map(move, joints)) for joints in (graph.tree, graph.closing))
    return replace(block, graph=replace(graph, tree=tree, closing=closing)), mount


def _align_frame(paths: LimbPaths, T_body_frame: FloatArray) -> FloatArray:
    """Return a frame (4, 4) of the platform with only those angles at home that it can change: a
    robot file states no others.
    """
    turns = [name in paths.freedoms for name in AXES[:3]]
    place = paths.graph.get_place(paths.graph.place(paths.home[None]), paths.platform)[0]
    angles = geometry.matrix_to_euler((place @ T_body_frame)[:3, :3], "xyz")
    if not any(turns) or np.abs(angles[np.logical_not(turns)]).max(initial=0.0) < ALONG:
        return T_body_frame
    R = geometry.euler_to_matrix(np.where(turns, angles, 0.0), "xyz")
    return geometry.make_pose(place[:3, :3].T @ R, T_body_frame[:3, 3])


def _describe_branch(whole: JointGraph, block: Block, platform: str) -> object:
    """Return the refusal, with the joints of the first body at which a limb branches."""
    others = tuple(body for body in list_possible_platforms(whole) if body != platform)
    graph = block.graph
    for body in graph.bodies:
        names = tuple(joint.name for joint in graph.joints if body in (joint.body_a, joint.body_b))
        if body not in (graph.base, block.platform) and len(names) > 2:
            return report_finding(
                "files.limb-branches", joints=names, body=body, platform=platform, platforms=others
            )
    return report_finding("files.no-limbs", platform=platform, platforms=others)


# From links, joints and welded frames to a mechanism: rigid bodies, pins, a tree and its
# closures.

COAXIAL = 1e-9
"""Difference of two frames or axes that count as the same [m, 1]."""


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
            raise MechanismError(
                report_finding("files.closure-within-body", closure=weld.name, body=a)
            )
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
            raise MechanismError(
                report_finding("files.closure-within-body", closure=joint.name, body=joint.body_a)
            )
    _refuse_repeated(joints)
    tree, closing = _span_tree(base, _merge_pins(base, list(joints), motors), motors)
    lost = next((joint.name for joint in closing if joint.name in motors), None)
    if lost is not None:
        raise MechanismError(report_finding("files.motors-in-loop", motor=lost))
    return JointGraph(base, tree, closing, motors)


def _refuse_repeated(joints: Sequence[GraphJoint]) -> None:
    """Refuse two rotary or ball joints of the same points of two bodies; raises MechanismError."""
    turning = [joint for joint in joints if joint.kind != "P"]
    for i, joint in enumerate(turning):
        for other in turning[:i]:
            if {joint.body_a, joint.body_b} != {other.body_a, other.body_b}:
                continue
            same = other.orient(joint.body_a)
            gaps = (joint.T_a[:3, 3] - same.T_a[:3, 3], joint.T_b[:3, 3] - same.T_b[:3, 3])
            if np.abs(gaps).max() < COAXIAL:
                finding = report_finding(
                    "files.closure-repeated",
                    closure=joint.name,
                    other=other.name,
                    body_a=joint.body_a,
                    body_b=joint.body_b,
                )
                raise MechanismError(finding)


def _merge_pins(
    base: str, joints: list[GraphJoint], motors: tuple[str, ...]
) -> tuple[GraphJoint, ...]:
    """Return the joints, in which two about one axis that hold a body without other joints are one
    pin.
    """
    for body in dict.fromkeys(name for j in joints for name in (j.body_a, j.body_b)):
        ends = [joint for joint in joints if body in (joint.body_a, joint.body_b)]
        if body == base or len(ends) != 2 or not _are_coaxial(body, *ends):
            continue
        first, second = ends
        if {first.name, second.name} & {*motors} or not (first.origin_a and second.origin_a):
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
    base: str, joints: Sequence[GraphJoint], motors: tuple[str, ...]
) -> tuple[tuple[GraphJoint, ...], tuple[GraphJoint, ...]]:
    """Return the joints of a tree, each after the one that carries it, and the other joints."""

    def rank(joint: GraphJoint) -> int:
        if joint.name in motors:
            return 0
        return 3 if joint.is_pin else "PR S".index(joint.kind) + 1

    group = {base: base} | {name: name for j in joints for name in (j.body_a, j.body_b)}
    chosen, closing = [], []
    for joint in sorted(joints, key=rank):
        group_a, group_b = group[joint.body_a], group[joint.body_b]
        (closing if group_a == group_b else chosen).append(joint)
        group = {body: group_a if name == group_b else name for body, name in group.items()}
    chosen = [joint for joint in joints if joint in chosen]
    tree: list[GraphJoint] = []
    bodies = {base}
    while chosen:
        ready = [joint for joint in chosen if {joint.body_a, joint.body_b} & bodies]
        if not ready:
            break  # joints of bodies that nothing joins to the base
        for joint in ready:
            oriented = joint.orient(joint.body_a if joint.body_a in bodies else joint.body_b)
            tree.append(oriented)
            bodies.add(oriented.body_b)
        chosen = [joint for joint in chosen if joint not in ready]
    return tuple(tree), tuple(joint for joint in joints if joint in closing)
