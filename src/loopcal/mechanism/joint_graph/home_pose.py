# SPDX-License-Identifier: Apache-2.0
"""Poses at which the loops of a mechanism close, and which of them is a good home."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.findings import Quantity, report_finding
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint
from loopcal.mechanism.joint_graph.loop_closure import CLOSURE_RANK_TOLERANCE, JointGraph, Placement
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import FloatArray

STARTS, SPREAD = 24, 0.6
"""Tries to close the loops, and range of their first joint values [rad, sizes]."""

SAME = 1e-6
"""Difference of joint values of poses that count as one [rad, sizes]."""

DRAWN = 1e-3
"""Largest joint value of a pose that counts as the drawn one [rad, sizes]."""

WEAK = 1e-3
"""Singular value of the closures, relative to the largest, below which a step leaves it out [1]."""

NEAR, NEAR_RANGE = 4, 0.15
"""Number of poses near a pose, and range of their motors [rad, sizes]."""

IDLE = 1e-9
"""Largest part of a motion, scaled, in which neither motors nor platform move [1]."""


@dataclass(frozen=True)
class Freedoms:
    """What a mechanism can do at a pose.

    Attributes
    ----------
    mobility : freedoms of motors and platform. idle : motions in which only passive joints move.
    moved : joints that move in these. firmness : how well the motors hold the passive joints and
        move the platform [1]; zero at a singular pose.
    """

    mobility: int
    idle: int
    moved: tuple[str, ...]
    firmness: float


def find_homes(graph: JointGraph) -> tuple[FloatArray, ...]:
    """Return joint values (j,) that close the loops, those within their limits and nearest to zero
    first.

    Poses of larger mobility, from which a link could move either way, are left out.

    Raises
    ------
    MechanismError : the loops do not close; names the closure that remains open.
    """
    sizes = np.where(graph.turns, 1.0, graph.size)
    low, high = _list_limits(graph)
    rest = np.clip(np.zeros(len(low)), low, high)
    starts = np.stack([rest + _draw(graph, seed) * sizes for seed in range(STARTS)])
    closed = [q for q in graph.close(starts) if np.isfinite(q).all()]
    if not closed:
        raise MechanismError(_describe_gap(graph, starts))
    mobilities = [graph.find_motions(q).shape[1] for q in closed]
    regular = [q for q, m in zip(closed, mobilities, strict=True) if m == min(mobilities)]
    inside = [bool(((low - SAME <= q) & (q <= high + SAME)).all()) for q in regular]
    distances = [float((((q - rest) / sizes) ** 2).sum()) for q in regular]
    order = sorted(range(len(regular)), key=lambda i: (not inside[i], distances[i]))
    homes: list[FloatArray] = []
    for q in (regular[i] for i in order):
        if all(np.abs((q - other) / sizes).max(initial=0.0) > SAME for other in homes):
            homes.append(q)
    return tuple(homes)


def is_drawn_pose(graph: JointGraph, q: FloatArray) -> bool:
    """Return whether a pose (j,) is the one that all joints have at zero, or at a limit near it."""
    rest = np.clip(np.zeros(len(q)), *_list_limits(graph))
    sizes = np.where(graph.turns, 1.0, graph.size)
    return bool(np.abs((q - rest) / sizes).max(initial=0.0) < DRAWN)


def find_freedoms(graph: JointGraph, q: FloatArray, platform: str) -> Freedoms:
    """Return the freedoms of a mechanism at a home pose (j,).

    The firmness is the product of two smallest singular values: of the closures by the passive
    joints, idle motions left out, and of the platform's twist by the joint rates.
    """
    sizes, passive = np.where(graph.turns, 1.0, graph.size), ~graph.is_driven
    rates = graph.find_motions(q) / sizes[:, None]
    place = graph.get_place(graph.place(q[None]), platform)[0]
    twists = graph.find_twists(q, platform, np.eye(4)) * sizes
    twists[3:] /= max(graph.size, float(np.linalg.norm(place[:3, 3])))
    outputs = np.concatenate([rates[graph.is_driven], twists @ rates])
    _, s, V = np.linalg.svd(outputs)
    mobility = int((s > IDLE * s.max(initial=1.0)).sum())
    idle = rates @ V[mobility:].T
    moved = np.abs(idle).max(axis=1, initial=0.0) > IDLE
    rows = graph.linearize(q[None])[1][0][:, passive]
    n_held = int(passive.sum()) - idle.shape[1]
    hold = np.linalg.svd(rows, compute_uv=False) if rows.size else np.ones(0)
    firmness = 1.0 if n_held == 0 else 0.0 if n_held > len(hold) else float(hold[n_held - 1])
    moves = np.linalg.svd(twists @ rates @ V[:mobility].T, compute_uv=False)
    firmness *= float(moves[-1]) if len(moves) else 0.0
    names = tuple(name for name, is_moved in zip(graph.names, moved, strict=True) if is_moved)
    return Freedoms(mobility, idle.shape[1], names, firmness)


def list_nearby(graph: JointGraph, home: FloatArray) -> FloatArray:
    """Return a pose (j,), and others (n, j) with the motors moved a little."""
    sizes = np.where(graph.turns, 1.0, graph.size) * graph.is_driven
    shifts = [np.zeros(len(home))]
    for seed in range(NEAR):
        rng = np.random.default_rng(seed)
        shifts.append(rng.uniform(-NEAR_RANGE, NEAR_RANGE, len(home)) * sizes)
    near = graph.close(home + np.stack(shifts), graph.is_driven)
    near[0] = home
    return near[np.isfinite(near).all(axis=1)]


def measure_rotation(graph: JointGraph, q: FloatArray, joint: GraphJoint) -> FloatArray:
    """Return the rotation (3, 3) of a joint that closes a loop, at joint values (j,)."""
    placement = graph.place(q[None])
    A, B = (
        (graph.get_place(placement, body) @ T)[0, :3, :3]
        for body, T in ((joint.body_a, joint.T_a), (joint.body_b, joint.T_b))
    )
    return A.T @ B


def get_value(graph: JointGraph, q: FloatArray, joint: GraphJoint) -> float:
    """Return the value of a rotary joint or slide [rad, m], also of one that closes a loop."""
    for i, other in enumerate(graph.tree):
        if joint.name in (other.name, other.origin_a, other.origin_b):
            return float(q[i])
    if joint.kind == "R":
        return float(geometry.log_so3(measure_rotation(graph, q, joint)) @ joint.axis)
    placement = graph.place(q[None])
    A = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0]
    B = (graph.get_place(placement, joint.body_b) @ joint.T_b)[0]
    return float((geometry.invert_pose(A) @ B)[:3, 3] @ joint.axis)


def count_repeated_closures(graph: JointGraph, q: FloatArray) -> int:
    """Return how many closure equations repeat others at a pose (j,)."""
    rows = graph.linearize(q[None])[1][0]
    rank = sum({"R": 5, "P": 5, "S": 3}[joint.kind] for joint in graph.closing)
    s = np.linalg.svd(rows, compute_uv=False) if rows.size else np.zeros(0)
    return rank - int(are_nonzero(s, CLOSURE_RANK_TOLERANCE).sum())


def _draw(graph: JointGraph, seed: int) -> FloatArray:
    """Return the differences of a start from zero (j,) [rad, sizes]; none for the first seed."""
    spread = 0.0 if seed == 0 else SPREAD
    return np.random.default_rng(seed).uniform(-spread, spread, len(graph.tree))


def _list_limits(graph: JointGraph) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper limits (j,) of the joints of the tree, infinite without limits."""
    limits = [joint.limits or (-np.inf, np.inf) for joint in graph.tree]
    low, high = np.array(limits, dtype=float).reshape(-1, 2).T
    return low, high


def approach_closure(graph: JointGraph, starts: FloatArray) -> FloatArray:
    """Return joint values (n, j) near starts (n, j) at which the loops are open the least.

    Directions that hardly change the closures are left out of the steps.
    """
    sizes = np.where(graph.turns, 1.0, graph.size)
    q = starts
    for _ in range(STARTS):
        residual, rows = graph.linearize(q)
        step = -(np.linalg.pinv(rows, rcond=WEAK) @ residual[:, :, None])[:, :, 0]
        largest = np.abs(step).max(axis=1, initial=1e-300, keepdims=True)
        q = q + step * np.minimum(1.0, 0.3 / largest) * sizes
    return q


def measure_gap(graph: JointGraph, placement: Placement, joint: GraphJoint) -> tuple[float, float]:
    """Return the distance [m] and angle [rad] between both sides of a closing joint."""
    A = (graph.get_place(placement, joint.body_a) @ joint.T_a)[0]
    B = (graph.get_place(placement, joint.body_b) @ joint.T_b)[0]
    gap = B[:3, 3] - A[:3, 3]
    if joint.kind == "S":
        return float(np.linalg.norm(gap)), 0.0
    a, b = A[:3, :3] @ joint.axis, B[:3, :3] @ joint.axis
    if joint.kind == "P":
        gap = gap - a * (a @ gap)
    angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
    return float(np.linalg.norm(gap)), angle


def _describe_gap(graph: JointGraph, starts: FloatArray) -> object:
    """Return the finding of loops that do not close: the worst closure of the best pose."""
    q = approach_closure(graph, starts)
    best = q[[int(np.argmin((graph.linearize(q)[0] ** 2).sum(axis=1)))]]
    placement = graph.place(best)
    gaps = [(measure_gap(graph, placement, joint), joint) for joint in graph.closing]
    (gap, angle), joint = max(gaps, key=lambda entry: entry[0])
    return report_finding(
        "files.loops-open",
        closure=joint.name,
        body_a=joint.body_a,
        body_b=joint.body_b,
        gap=Quantity(gap * 1e3, "mm"),
        angle=Quantity(angle, "rad"),
    )
