# SPDX-License-Identifier: Apache-2.0
"""Blocks of a mechanism: joints in no loop, and groups of loops that share more than one body.

Two joints are in one block if a loop contains both (biconnected components). A joint in no loop is
a block of its own. Blocks share single bodies only, so that each moves by its own motors alone, and
those from the base to the platform are stages of a chain. A joint that closes the tree makes one
loop with the joints of the tree around it; loops with a common joint are in one block.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from loopcal.mechanism.joint_graph.graph_joint import GraphJoint
from loopcal.mechanism.joint_graph.loop_closure import JointGraph


@dataclass(frozen=True, eq=False)
class Block:
    """A block.

    Attributes
    ----------
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
        carriers_a, carriers_b = (
            _list_carriers(carrier, body) for body in (closing.body_a, closing.body_b)
        )
        joined = {group[joint] for joint in {closing} | ({*carriers_a} ^ {*carriers_b})}
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


def list_end_blocks(graph: JointGraph) -> tuple[Block, ...]:
    """Return the blocks with motors that carry no other block with motors."""
    driven = [block for block in list_blocks(graph) if block.graph.motors]
    carrying = {
        joint
        for block in driven
        for before in find_blocks(graph, block.graph.base)
        for joint in before.graph.joints
    }
    return tuple(block for block in driven if not carrying & {*block.graph.joints})


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


def keep_path(graph: JointGraph, platform: str) -> JointGraph:
    """Return the mechanism without the joints that move nothing between base and platform."""
    blocks = find_blocks(graph, platform)
    return select_joints(graph, {joint for block in blocks for joint in block.graph.joints})


def _list_carriers(carrier: dict[str, GraphJoint], body: str) -> list[GraphJoint]:
    """Return the joints of the tree from a body to the base."""
    joints = []
    while body in carrier:
        joints.append(carrier[body])
        body = carrier[body].body_a
    return joints
