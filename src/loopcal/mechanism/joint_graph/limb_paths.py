# SPDX-License-Identifier: Apache-2.0
"""Limbs of a mechanism of bodies and joints: paths from base to platform that share nothing else.

Other bodies that branch from the limbs cannot be expressed, with one exception: where they only
keep the platform from turning (the parallelograms of a delta), the freedoms of the platform express
the same, and one path for each motor is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.joint_graph.loop_closure import GraphJoint, JointGraph
from loopcal.typing import FloatArray

MOTION = 1e-9
"""Smallest part of a motion that counts [m, rad]; rounding is below 1e-12."""

FIRM = 0.3
"""Share of the best firmness that a home pose must have [1]."""

INDEPENDENT = 1e-3
"""Singular value, relative to the largest twist, above which coordinates are independent [1]."""

Path = tuple[GraphJoint, ...]


@dataclass(frozen=True)
class LimbPaths:
    """A mechanism as limbs.

    Attributes
    ----------
    graph : at its home pose. platform : its body. limbs : joints of each from base to platform.
    freedoms : of the platform, in base axes. replaced : joints that the freedoms express.
    """

    graph: JointGraph
    platform: str
    limbs: tuple[Path, ...]
    freedoms: tuple[str, ...]
    replaced: tuple[str, ...] = ()


def find_limb_paths(graph: JointGraph, platform: str) -> LimbPaths:
    """Return the limbs at the nearest home pose in which the motors hold the platform firmly.

    Raises
    ------
    MechanismError : a limb branches, or no limbs join base and platform; a finding with the joints.
    """
    candidates, refusal = [], None
    for values in graph.homes:
        try:
            candidates.append(_divide_at(replace(graph, values=values), platform))
        except MechanismError as error:
            refusal = refusal or error
    if refusal is not None and not candidates:
        raise refusal
    firmness = [paths.graph.measure_firmness(platform) for paths in candidates]
    limit = FIRM * max(firmness)
    return next(p for p, value in zip(candidates, firmness, strict=True) if value >= limit)


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


def get_other_body(joint: GraphJoint, body: str) -> str:
    """Return the body at the other end of a joint."""
    return joint.body_b if body == joint.body_a else joint.body_a


def orient_path(path: Path, body: str) -> Path:
    """Return the joints of a limb, each pin as the body before it carries it."""
    oriented = []
    for joint in path:
        oriented.append(joint.flip() if joint.is_pin and joint.body_a != body else joint)
        body = get_other_body(joint, body)
    return tuple(oriented)


def _divide_at(graph: JointGraph, platform: str) -> LimbPaths:
    """Return the limbs at one home pose."""
    freedoms = _list_freedoms(graph, platform)
    limbs = _find_complete_limbs(graph, platform)
    if limbs is not None:
        return LimbPaths(graph, platform, limbs, freedoms)
    turns = any(name.startswith("r") for name in freedoms)
    if not turns and graph.motions().shape[1] == len(freedoms) == len(graph.motors):
        limbs = _find_driven_limbs(graph, platform)
    if limbs is None:
        raise _describe_branch(graph, platform)
    used = {joint.name for limb in limbs for joint in limb}
    replaced = tuple(joint.name for joint in graph.joints if joint.name not in used)
    return LimbPaths(graph, platform, limbs, freedoms, replaced)


def _list_freedoms(graph: JointGraph, platform: str) -> tuple[str, ...]:
    """Return the components of twist in which the platform moves, at home or near it."""
    largest = np.zeros(6)
    for near in graph.list_nearby():
        motion = near.twists(platform, near.places[platform][:3, 3]) @ near.motions()
        largest = np.maximum(largest, np.abs(motion).max(axis=1))
    return tuple(name for name, size in zip(AXES, largest, strict=True) if size > MOTION)


def _find_complete_limbs(graph: JointGraph, platform: str) -> tuple[Path, ...] | None:
    """Return limbs that contain every body and joint; None where there are none."""
    left, limbs = list(graph.joints), []
    for first in [joint for joint in graph.joints if graph.base in (joint.body_a, joint.body_b)]:
        body, path = graph.base, [first]
        while (body := get_other_body(path[-1], body)) != platform:
            onward = [j for j in graph.joints if j is not path[-1] and body in (j.body_a, j.body_b)]
            if len(onward) != 1 or body == graph.base:
                return None
            path.append(onward[0])
        left = [joint for joint in left if joint not in path]
        limbs.append(tuple(path))
    return None if left else tuple(limbs)


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
        limbs.append(path)
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
                after = get_other_body(joint, body)
                if after not in visited:
                    visited.add(after)
                    queue.append((*path, joint))
    return None


def _describe_branch(graph: JointGraph, platform: str) -> MechanismError:
    """Return the refusal, with the joints of the first body at which a limb branches."""
    for body in graph.bodies:
        names = tuple(joint.name for joint in graph.joints if body in (joint.body_a, joint.body_b))
        if body not in (graph.base, platform) and len(names) > 2:
            return MechanismError(
                report_finding("files.limb-branches", joints=names, body=body, platform=platform)
            )
    return MechanismError(report_finding("files.no-limbs", platform=platform))


def _get_end(path: Sequence[GraphJoint], body: str) -> str:
    """Return the body at the end of a path."""
    for joint in path:
        body = get_other_body(joint, body)
    return body
