# SPDX-License-Identifier: Apache-2.0
"""A mechanism of bodies and joints as a chain of stages, from the base to the platform.

A joint in no loop is a stage with one joint; a block of loops is a closed loop with limbs from the
body that carries it to the body that carries what follows. What is not on the way to the platform
is left out. A mechanism that is one block, or has no loops at all, is one stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.joint_graph.graph_blocks import (
    Block,
    find_blocks,
    keep_path,
    list_end_blocks,
)
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint, turn_between
from loopcal.mechanism.joint_graph.home_pose import (
    Freedoms,
    find_freedoms,
    find_homes,
    is_drawn_pose,
)
from loopcal.mechanism.joint_graph.limb_paths import (
    LimbPaths,
    find_complete_limbs,
    find_limbs,
    is_translating,
    list_freedoms,
    place_limbs,
)
from loopcal.mechanism.joint_graph.loop_closure import JointGraph
from loopcal.mechanism.joint_graph.rounded_loops import Repair, repair_rounded_loops
from loopcal.typing import FloatArray

FIRM, FIRM_DRAWN = 0.5, 0.01
"""Share of the best firmness that a home pose must have, and the pose that was drawn [1]."""

PARALLEL, ALONG = 1e-9, 1e-12
"""Largest sine between axes that count as parallel, and component across an axis of a frame [1]."""


@dataclass(frozen=True, eq=False)
class ClosedStage:
    """A stage with closed loops.

    Attributes
    ----------
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

    Attributes
    ----------
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

    Attributes
    ----------
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
    `measure_rounding` the rounding errors [m, rad] of numbers that describe some bodies.

    Raises
    ------
    MechanismError : the loops do not close, a limb branches, no limbs join base and platform, or no
        motor holds a joint between them; a finding with the joints.
    """
    kept = keep_path(whole, platform)
    repair = _repair_blocks(kept, find_blocks(kept, platform), measure_rounding)
    graph = repair.graph
    blocks = find_blocks(graph, platform)
    _refuse_passive_blocks(blocks, platform)
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
    home, motions = _choose_home(graph, homes, platform)
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
    """Return the bodies at the ends of the mechanism that limbs join to what carries them.

    Of the bodies of a loop, these are the ones with most limbs. Bodies in the middle of an
    unbranched chain are left out where another body has more limbs, and bodies that fewer joints
    than motors carry, where others have more.
    """
    return tuple(body for block in list_end_blocks(graph) for body in _list_ends(block.graph))


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


def _refuse_passive_blocks(blocks: tuple[Block, ...], platform: str) -> None:
    """Refuse joints between base and platform that no motor holds; raises MechanismError."""
    for block in blocks:
        if not block.graph.motors:
            names = tuple(joint.name for joint in block.graph.joints)
            finding = report_finding("files.joints-not-held", joints=names, platform=platform)
            raise MechanismError(finding)


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


def _choose_home(
    graph: JointGraph, homes: tuple[FloatArray, ...], platform: str
) -> tuple[FloatArray, Freedoms]:
    """Return the first home that is firm enough, with its motions."""
    motions = [find_freedoms(graph, home, platform) for home in homes]
    share = FIRM_DRAWN if is_drawn_pose(graph, homes[0]) else FIRM
    limit = share * max(freedoms.firmness for freedoms in motions)
    return next(pair for pair in zip(homes, motions, strict=True) if pair[1].firmness >= limit)


def _select(graph: JointGraph, q: FloatArray, block: Block) -> FloatArray:
    """Return the values (b,) of the joints of a block."""
    return q[[graph.names.index(name) for name in block.graph.names]]


def _turn_base(block: Block) -> tuple[Block, FloatArray]:
    """Return a block in a base frame whose axes are along and across the plane of its loops.

    Also returns that frame (4, 4) in the body that carries the block; it is that of the body where
    its axes do, and where the loops are not in one plane.
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
    """Return a frame (4, 4) of the platform with only those angles at home that it can change.

    A robot file states no others. It is the given frame where the platform turns about all axes or
    none.
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
