# SPDX-License-Identifier: Apache-2.0
"""Limbs of a mechanism of bodies and joints: paths from base to platform that share nothing else.

Other bodies that branch from the limbs cannot be expressed, with one exception: where they only
keep the platform from turning (the parallelograms of a delta), the freedoms of the platform express
the same, and one path for each motor is left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint
from loopcal.mechanism.joint_graph.home_pose import (
    Freedoms,
    find_freedoms,
    find_homes,
    is_drawn_pose,
    list_nearby,
)
from loopcal.mechanism.joint_graph.loop_closure import JointGraph
from loopcal.typing import FloatArray
from loopcal.value_classes import dataclass

MOTION = 1e-9
"""Smallest part of a motion that counts [m, rad]; rounding is below 1e-12."""

FIRM, FIRM_DRAWN = 0.5, 0.01
"""Share of the best firmness that a home pose must have, and the pose that was drawn [1]."""

INDEPENDENT = 1e-3
"""Singular value, relative to the largest twist, above which coordinates are independent [1]."""

Path = tuple[GraphJoint, ...]


@dataclass(frozen=True)
class LimbPaths:
    """A mechanism as limbs.

    Attributes
    ----------
    graph : without bodies that hang on it only. home : joint values (j,). platform : its body.
    limbs : joints of each limb, each from the body before it. freedoms : of the platform, in base
        axes. motions : what motors and passive joints can do at home.
    replaced : joints that the freedoms express. dangling : joints that were left out.
    """

    graph: JointGraph
    home: FloatArray
    platform: str
    limbs: tuple[Path, ...]
    freedoms: tuple[str, ...]
    motions: Freedoms
    replaced: tuple[str, ...] = ()
    dangling: tuple[str, ...] = ()


def find_limb_paths(graph: JointGraph, platform: str) -> LimbPaths:
    """Return the limbs at the nearest home pose in which the motors hold the platform firmly.

    Raises
    ------
    MechanismError : the loops do not close, a limb branches, no limbs join base and platform, or a
        motor moves nothing between them; a finding with the joints.
    """
    whole, graph = graph, remove_dangling(graph, platform)
    dangling = tuple(joint.name for joint in whole.joints if joint not in graph.joints)
    outside = tuple(name for name in whole.motors if name in dangling)
    if outside:
        finding = report_finding("files.motors-outside", motors=outside, platform=platform)
        raise MechanismError(finding)
    homes = find_homes(graph)
    motions = [find_freedoms(graph, home, platform) for home in homes]
    complete = limbs = _find_complete_limbs(graph, platform)
    if limbs is None:
        limbs = _find_driven_limbs(graph, platform)
        kept = [
            i for i in range(len(homes)) if _is_translating(graph, homes[i], motions[i], platform)
        ]
        homes, motions = tuple(homes[i] for i in kept), [motions[i] for i in kept]
    if limbs is None or not homes:
        raise MechanismError(_describe_branch(whole, graph, platform))
    share = FIRM_DRAWN if is_drawn_pose(graph, homes[0]) else FIRM
    limit = share * max(one.firmness for one in motions)
    home, motion = next(
        pair for pair in zip(homes, motions, strict=True) if pair[1].firmness >= limit
    )
    freedoms = _list_freedoms(graph, home, platform)
    if complete and not _stay_within(graph, home, platform, freedoms):
        freedoms = AXES
    limbs = _sort_limbs(limbs, graph.motors)
    used = {joint.name for limb in limbs for joint in limb}
    used |= {joint.origin_b for limb in limbs for joint in limb}
    replaced = tuple(joint.name for joint in graph.joints if joint.name not in used)
    return LimbPaths(graph, home, platform, limbs, freedoms, motion, replaced, dangling)


def remove_dangling(graph: JointGraph, platform: str) -> JointGraph:
    """Return the mechanism without bodies that hang on it by one joint, such as a camera."""
    while True:
        counts = dict.fromkeys(graph.bodies, 0)
        for joint in graph.joints:
            counts[joint.body_a] += 1
            counts[joint.body_b] += 1
        loose = frozenset(
            body for body, n in counts.items() if n < 2 and body not in (graph.base, platform)
        )
        if not loose:
            return graph
        graph = graph.without(loose)


def list_possible_platforms(graph: JointGraph) -> tuple[str, ...]:
    """Return the bodies that limbs join to the base without branches, those with most limbs first.

    Bodies in the middle of an unbranched chain are left out where another body has more limbs, and
    bodies that fewer joints than motors carry, where others have more.
    """
    counts, carried = {}, {}
    for body in graph.bodies[1:]:
        limbs = _find_complete_limbs(remove_dangling(graph, body), body)
        if limbs is not None:
            carried[body] = min(len(limb) for limb in limbs)
            counts[body] = len(limbs)
    needed = min(max(carried.values(), default=0), len(graph.motors))
    counts = {body: count for body, count in counts.items() if carried[body] >= needed}
    most = max(counts.values(), default=0)
    return tuple(body for body, count in counts.items() if count == most)


def choose_coordinates(twists: FloatArray) -> list[str]:
    """Return coordinates of the platform that move independently, positions first.

    `twists` (6, m) are those of the platform for the m motions of the mechanism.
    """
    chosen: list[str] = []
    for name in ("x", "y", "z", "rx", "ry", "rz"):
        rows = twists[[AXES.index(n) for n in (*chosen, name)]]
        s = np.linalg.svd(rows, compute_uv=False)
        if len(chosen) < twists.shape[1] and s[-1] > INDEPENDENT * np.abs(twists).max():
            chosen.append(name)
    return chosen


def _is_translating(graph: JointGraph, home: FloatArray, motion: Freedoms, platform: str) -> bool:
    """Return whether motors set all freedoms of a platform that does not turn near a home pose."""
    if motion.mobility != len(graph.motors):
        return False
    freedoms = _list_freedoms(graph, home, platform)
    return len(freedoms) == motion.mobility and not any(name.startswith("r") for name in freedoms)


def _list_freedoms(graph: JointGraph, home: FloatArray, platform: str) -> tuple[str, ...]:
    """Return the components of twist in which the platform moves, at home or near it."""
    largest = np.zeros(6)
    for q in list_nearby(graph, home):
        motion = graph.find_twists(q, platform, np.eye(4)) @ graph.find_motions(q)
        largest = np.maximum(largest, np.abs(motion).max(axis=1, initial=0.0))
    return tuple(name for name, size in zip(AXES, largest, strict=True) if size > MOTION)


def _stay_within(
    graph: JointGraph, home: FloatArray, platform: str, freedoms: tuple[str, ...]
) -> bool:
    """Return whether rotary joints and slides move the platform in its freedoms only.

    Loops are closed in the freedoms of the platform. A joint across them, which its loop keeps from
    moving, would be free there.
    """
    placement = graph.place(home[None])
    origin = graph.get_place(placement, platform)[0, :3, 3]
    others = [AXES.index(name) for name in AXES if name not in freedoms]
    for joint in graph.joints:
        if joint.kind == "S":
            continue
        frame = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0]
        axis = frame[:3, :3] @ joint.axis
        arm = np.cross(axis, origin - frame[:3, 3])
        turn, velocity = (axis, arm) if joint.kind == "R" else (0 * axis, axis)
        twist = dict(zip(("rx", "ry", "rz", "x", "y", "z"), (*turn, *velocity), strict=True))
        if any(abs(twist[AXES[i]]) > MOTION * max(1.0, graph.size) for i in others):
            return False
    return True


def _find_complete_limbs(graph: JointGraph, platform: str) -> tuple[Path, ...] | None:
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


def _sort_limbs(limbs: tuple[Path, ...], motors: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the limbs in the order of their motors, passive ones last."""

    def rank(limb: Path) -> int:
        driven = [motors.index(joint.name) for joint in limb if joint.name in motors]
        return min(driven, default=len(motors))

    return tuple(sorted(limbs, key=rank))


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


def _describe_branch(whole: JointGraph, graph: JointGraph, platform: str) -> object:
    """Return the refusal, with the joints of the first body at which a limb branches."""
    others = tuple(body for body in list_possible_platforms(whole) if body != platform)
    for body in graph.bodies:
        names = tuple(joint.name for joint in graph.joints if body in (joint.body_a, joint.body_b))
        if body not in (graph.base, platform) and len(names) > 2:
            return report_finding(
                "files.limb-branches", joints=names, body=body, platform=platform, platforms=others
            )
    return report_finding("files.no-limbs", platform=platform, platforms=others)


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
