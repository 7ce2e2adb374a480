# SPDX-License-Identifier: Apache-2.0
"""A mechanism as bodies and joints: a tree of joints from the base, and joints that close loops.

With q the values of the tree, joint by joint, every joint of the tree places a body, T_b = T_a J(q)
(frames of both bodies on the joint). A joint that closes a loop adds equations between two bodies
that the tree has placed already: a ball joint p_a = p_b for its centers, a rotary joint also a_a =
a_b for its axes, and a slide equal orientations and (p_a - p_b) x a = 0. Their derivatives by q are
those of the two points and directions, which only the joints below each body move.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, compress

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.findings import Quantity, report_finding
from loopcal.mechanism.joint_graph.graph import GraphJoint, turn_between
from loopcal.numerics.decomposition import find_null_space
from loopcal.numerics.elimination import find_connected_groups
from loopcal.typing import BoolArray, FloatArray

# Singular value of the scaled closures, relative to the largest, that counts as zero [1].
CLOSURE_RANK_TOLERANCE = 1e-8
CLOSED = 1e-13  # largest closure residual of a home pose, lengths as a share of the largest one [1]

STEPS, LARGEST_STEP = 40, 0.6
"""Newton steps, and the largest change of a joint value in one of them [rad, sizes]."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Places of a tree at n joint values.

    T : (n, bodies, 4, 4) T_base_body [m]. axes, points : (n, j, 3) axis and a point of each joint.
    """

    T: FloatArray
    axes: FloatArray
    points: FloatArray


@dataclass(frozen=True)
class JointGraph:
    """A mechanism.

    base : the root body. tree : joints, each after the one that carries its first body.
    closing : joints that close loops. motors : names of driven joints. All joints with a `drive`
        are in the tree.
    """

    base: str
    tree: tuple[GraphJoint, ...]
    closing: tuple[GraphJoint, ...]
    motors: tuple[str, ...]

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """All bodies, the base first."""
        return (self.base, *(joint.body_b for joint in self.tree))

    @property
    def joints(self) -> tuple[GraphJoint, ...]:
        """All joints."""
        return self.tree + self.closing

    def change_joints(self, change: Callable[[GraphJoint], GraphJoint]) -> JointGraph:
        """Return the mechanism with other places of its joints."""
        tree, closing = (tuple(map(change, joints)) for joints in (self.tree, self.closing))
        return replace(self, tree=tree, closing=closing)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the joints of the tree."""
        return tuple(joint.name for joint in self.tree)

    @cached_property
    def is_driven(self) -> BoolArray:
        """Which joints of the tree are driven (j,)."""
        return np.array([joint.drive in self.motors for joint in self.tree], dtype=bool)

    @cached_property
    def leads(self) -> Mapping[str, GraphJoint]:
        """The joint of each drive: its own, or else the first that follows it."""
        driven = [joint for joint in reversed(self.tree) if joint.drive]
        own = [joint for joint in driven if joint.drive == joint.name]
        return {joint.drive: joint for joint in (*driven, *own)}

    def find_lead(self, joint: GraphJoint) -> tuple[GraphJoint, float, float]:
        """Return lead, factor and offset of a joint: value = factor * lead value + offset."""
        lead = self.leads.get(joint.drive, joint)
        factor = joint.ratio / lead.ratio
        return lead, factor, joint.offset - factor * lead.offset

    @cached_property
    def coupled(self) -> tuple[FloatArray, FloatArray]:
        """Rows (s, j) and values (s,) of the couplings: rows @ (q / units) = values."""
        units, index, count = self.units, self.names.index, len(self.tree)
        rows, values = [], []
        for i, joint in enumerate(self.tree):
            lead, factor, offset = self.find_lead(joint)
            if lead is not joint:
                k = index(lead.name)
                rows.append(np.eye(count)[i] - factor * units[k] / units[i] * np.eye(count)[k])
                values.append(offset / units[i])
        return np.reshape(rows, (-1, count)), np.array(values)

    @cached_property
    def turns(self) -> BoolArray:
        """Which joints of the tree are rotary (j,)."""
        return np.array([joint.kind == "R" for joint in self.tree], dtype=bool)

    @cached_property
    def size(self) -> float:
        """Largest distance of a joint from the frame of its body [m]; 1 where all are zero."""
        places = [T[:3, 3] for joint in self.joints for T in (joint.T_a, joint.T_b)]
        return float(np.linalg.norm(places, axis=-1).max(initial=0.0)) or 1.0

    @cached_property
    def units(self) -> FloatArray:
        """Unit of each joint value in the scaled closures (j,) [rad, m]."""
        return np.where(self.turns, 1.0, self.size)

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest values of the joints of the tree (j,) [rad, m]."""
        limits = [joint.limits or (-np.inf, np.inf) for joint in self.tree]
        low, high = np.array(limits, dtype=float).reshape(-1, 2).T
        return low, high

    @cached_property
    def _index(self) -> Mapping[str, int]:
        return {body: i for i, body in enumerate(self.bodies)}

    @cached_property
    def _is_below(self) -> BoolArray:
        """Which joints (j,) of the tree move each body (bodies, j)."""
        below = np.zeros((len(self.bodies), len(self.tree)), dtype=bool)
        for i, joint in enumerate(self.tree):
            below[i + 1] = below[self._index[joint.body_a]]
            below[i + 1, i] = True
        return below

    def find_carriers(self, body: str) -> BoolArray:
        """Return which joints (j,) of the tree move a body."""
        return self._is_below[self._index[body]]

    def place(self, q: FloatArray) -> Placement:
        """Return the places of all bodies and joints at joint values (n, j)."""
        n, j = q.shape
        T, axes, points = (
            np.tile(np.eye(4), (n, j + 1, 1, 1)),
            np.zeros((n, j, 3)),
            np.zeros((n, j, 3)),
        )
        for i, joint in enumerate(self.tree):
            carrier = T[:, self._index[joint.body_a]]
            frame = carrier @ joint.T_a
            axes[:, i], points[:, i] = frame[:, :3, :3] @ joint.axis, frame[:, :3, 3]
            T[:, i + 1] = carrier @ joint.move(q[:, i]) @ geometry.invert_pose(joint.T_b)
        return Placement(T, axes, points)

    def get_place(self, placement: Placement, body: str) -> FloatArray:
        """Return the places (n, 4, 4) of a body."""
        return placement.T[:, self._index[body]]

    def locate(self, q: FloatArray, body: str) -> FloatArray:
        """Return the place (4, 4) of a body at joint values (j,)."""
        return self.get_place(self.place(q[None]), body)[0]

    def locate_ends(self, placement: Placement, joint: GraphJoint) -> tuple[FloatArray, FloatArray]:
        """Return the frames (n, 4, 4) of a joint on both of its bodies, in the base."""
        return (
            self.get_place(placement, joint.body_a) @ joint.T_a,
            self.get_place(placement, joint.body_b) @ joint.T_b,
        )

    def relate(self, placement: Placement, joint: GraphJoint) -> FloatArray:
        """Return the frame (4, 4) of a joint on its second body in that on its first one."""
        A, B = self.locate_ends(placement, joint)
        return (geometry.invert_pose(A) @ B)[0]

    def differentiate(self, placement: Placement, body: str, point: FloatArray) -> FloatArray:
        """Return the twist (n, 6, j) (rotation, velocity) at a point (n, 3) [m] of a body by joint
        values, in base axes.
        """
        arms = np.cross(placement.axes, point[:, None] - placement.points)
        turns = self.turns[:, None]
        parts = np.where(turns, placement.axes, 0.0), np.where(turns, arms, placement.axes)
        twists = np.concatenate(parts, axis=2) * self.find_carriers(body)[:, None]
        return twists.swapaxes(1, 2)

    def linearize(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, e) of the closures at joint values (n, j), and derivatives by them.

        Lengths are divided by `size`, and a slide's value is counted in it.
        """
        placement = self.place(q)
        coupled, values = self.coupled
        residual = [q / self.units @ coupled.T - values]
        rows = [np.tile(coupled, (len(q), 1, 1))]
        for joint in self.closing:
            r, J = self._linearize_joint(placement, joint)
            residual.append(r)
            rows.append(J * self.units)
        return np.concatenate(residual, axis=1), np.concatenate(rows, axis=1)

    def _linearize_joint(
        self, placement: Placement, joint: GraphJoint
    ) -> tuple[FloatArray, FloatArray]:
        """Return residuals and derivatives of one closure."""
        P, Q = self.locate_ends(placement, joint)
        by_p, by_q = (
            self.differentiate(placement, body, T[:, :3, 3])
            for body, T in zip(joint.bodies, (P, Q), strict=True)
        )
        gap = (P[:, :3, 3] - Q[:, :3, 3]) / self.size
        rows = (by_p[:, 3:] - by_q[:, 3:]) / self.size
        if joint.kind == "P":
            # d (axis x gap) = axis x d gap - gap x (turn x axis)
            axis = P[:, :3, :3] @ joint.axis
            swing = geometry.hat(gap) @ geometry.hat(axis) @ by_p[:, :3]
            gap, rows = np.cross(axis, gap), geometry.hat(axis) @ rows + swing
        parts = [(gap, rows)]
        # directions that the joint keeps equal on both bodies
        for kept in {"R": joint.axis[None], "P": np.eye(3), "S": ()}[joint.kind]:
            u, w = P[:, :3, :3] @ kept, Q[:, :3, :3] @ kept
            turned = geometry.hat(w) @ by_q[:, :3] - geometry.hat(u) @ by_p[:, :3]
            parts.append((u - w, turned))
        residual, jacobian = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        return residual, jacobian

    def close(
        self, starts: FloatArray, fixed: BoolArray | None = None, gap: float = CLOSED
    ) -> FloatArray:
        """Close the loops by Newton's method from joint values (n, j); NaN where it diverges.

        `fixed` (j,) are joints that keep their values. Steps are of least norm. gap : largest
        residual of closed loops.
        """
        q, is_closed = starts.copy(), np.zeros(len(starts), dtype=bool)
        free = np.ones(len(self.tree), dtype=bool) if fixed is None else ~fixed
        for _ in range(STEPS):
            left = np.flatnonzero(~is_closed)
            if not left.size:
                break
            residual, step = self._propose(q[left], free, CLOSURE_RANK_TOLERANCE, LARGEST_STEP)
            is_closed[left] = np.abs(residual).max(axis=1, initial=0.0) < gap
            active = ~is_closed[left]
            q[left[active]] += step[active]
        q[~is_closed] = np.nan
        return q

    def approach(self, starts: FloatArray) -> FloatArray:
        """Return joint values (n, j) near starts (n, j) at which the loops are open the least.

        Directions that hardly change the closures are left out of the steps.
        """
        q, free = starts, np.ones(len(self.tree), dtype=bool)
        for _ in range(STARTS):
            q = q + self._propose(q, free, WEAK, LARGEST_STEP / 2)[1]
        return q

    def _propose(
        self, q: FloatArray, free: BoolArray, tolerance: float, largest: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, e) at joint values (n, j), and Newton steps (n, j) of least norm."""
        residual, rows = self.linearize(q)
        step = np.zeros(q.shape)
        inverse = np.linalg.pinv(rows[:, :, free], rcond=tolerance)
        step[:, free] = -(inverse @ residual[:, :, None])[:, :, 0]
        length = np.abs(step).max(axis=1, initial=1e-300, keepdims=True)
        return residual, step * np.minimum(1.0, largest / length) * self.units

    def find_motions(self, q: FloatArray) -> FloatArray:
        """Return rates (j, m) that keep the loops closed at joint values (j,); m is the mobility.

        Rates are orthonormal in the scaled values.
        """
        rows = self.linearize(q[None])[1][0]
        return self.units[:, None] * find_null_space(rows, CLOSURE_RANK_TOLERANCE)

    def find_twists(self, q: FloatArray, body: str, frame: FloatArray) -> FloatArray:
        """Return the twist (6, j) of a frame (4, 4) of a body by joint values (j,), about its
        origin in base axes, as (turn, velocity) [rad, m].
        """
        placement = self.place(q[None])
        point = (self.get_place(placement, body) @ frame)[:, :3, 3]
        return self.differentiate(placement, body, point)[0]


# Poses at which the loops of a mechanism close, and which of them is a good home.

STARTS, SPREAD = 24, 0.6
"""Tries to close the loops, and range of their first joint values [rad, sizes]."""

FEW = 12  # largest number of closures that are left out one by one, to find the wrong one
SAME = 1e-6  # difference of joint values of poses that count as one [rad, sizes]
DRAWN = 1e-3  # largest joint value of a pose that counts as the drawn one [rad, sizes]
# Singular value of the closures, relative to the largest, below which a step leaves it out [1].
WEAK = 1e-3
ACROSS = 0.1  # smallest sine between two axes from which their common point is computed [1]

NEAR, NEAR_RANGE = 4, 0.15
"""Number of poses near a pose, and range of their motors [rad, sizes]."""

IDLE = 1e-9  # largest part of a motion, scaled, in which neither motors nor platform move [1]


@dataclass(frozen=True)
class Freedoms:
    """What a mechanism can do at a pose.

    mobility : freedoms of motors and platform. idle : motions in which only passive joints move.
    moved : joints that move in these. firmness : how well the motors hold the passive joints and
        move the platform [1]; zero at a singular pose.
    """

    mobility: int
    idle: int
    moved: tuple[str, ...]
    firmness: float


def find_homes(graph: JointGraph) -> tuple[list[FloatArray], bool]:
    """Return joint values (j,) that close the loops, those within their limits and nearest to zero
    first, without poses of larger mobility, and whether the first is the pose that all joints have
    at zero, or at a limit near it; raises MechanismError where the loops do not close.
    """
    starts = _draw_starts(graph)
    closed = graph.close(starts)
    closed = closed[np.isfinite(closed).all(axis=1)]
    if not len(closed):
        closed = _close_groups(graph, starts)
    mobilities = np.array([graph.find_motions(q).shape[1] for q in closed])
    homes: list[FloatArray] = []
    for q in _sort_poses(graph, closed[mobilities == mobilities.min()], starts[0]):
        if all(np.abs((q - other) / graph.units).max(initial=0.0) > SAME for other in homes):
            homes.append(q)
    return homes, bool(np.abs((homes[0] - starts[0]) / graph.units).max(initial=0.0) < DRAWN)


def _draw_starts(graph: JointGraph) -> FloatArray:
    """Return joint values (n, j) near zero, or limits near it; the first are there."""
    low, high = graph.limits
    drawn = [np.random.default_rng(i).uniform(-SPREAD, SPREAD, len(low)) for i in range(STARTS)]
    drawn[0] *= 0.0
    return np.clip(np.zeros(len(low)), low, high) + np.stack(drawn) * graph.units


def _sort_poses(graph: JointGraph, q: FloatArray, rest: FloatArray) -> FloatArray:
    """Return poses (n, j), those within their limits and nearest to rest (j,) first."""
    low, high = graph.limits
    is_outside = ((q < low - SAME) | (q > high + SAME)).any(axis=1)
    return q[np.lexsort(((((q - rest) / graph.units) ** 2).sum(axis=1), is_outside))]


def _close_groups(
    graph: JointGraph, starts: FloatArray, gap: float = CLOSED, holds_motors: bool = False
) -> FloatArray:
    """Return joint values (1, j) that close the loops within a gap. Loops that share no joint close
    one group after the other, and if a motor joins them with the motors as in the first of starts
    (n, j): one start seldom closes all legs of a machine. Refuse loops that no start closes.
    """
    moves = np.array([np.logical_xor(*map(graph.find_carriers, j.bodies)) for j in graph.closing])
    links = np.argwhere(moves & ~(graph.is_driven & holds_motors)) + np.array([0, len(moves)])
    groups = find_connected_groups(links, len(moves) + len(graph.tree))
    q = starts[0]
    for group in dict.fromkeys(groups[: len(moves)]):
        part = replace(graph, closing=tuple(compress(graph.closing, groups == group)))
        is_free = groups[len(moves) :] == group
        tries = np.where(is_free, starts, q)
        closed = part.close(tries, ~is_free, gap)
        closed = closed[np.isfinite(closed).all(axis=1)]
        if not len(closed):
            if holds_motors:
                raise MechanismError(_describe_gap(part, tries))
            try:
                closed = _close_groups(part, tries, gap, holds_motors=True)
            except MechanismError:
                raise MechanismError(_describe_gap(part, tries)) from None
        q = _sort_poses(graph, closed, starts[0])[0]
    return q[None]


def find_freedoms(graph: JointGraph, q: FloatArray, platform: str) -> Freedoms:
    """Return the freedoms of a mechanism at a home pose (j,); the firmness is the product of the
    smallest singular values of the closures by the passive joints, and of the platform's twist by
    the rates.
    """
    passive, rates = ~graph.is_driven, graph.find_motions(q) / graph.units[:, None]
    place = graph.locate(q, platform)
    twists = graph.find_twists(q, platform, np.eye(4)) * graph.units
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
    shifts, unit = [np.zeros(len(home))], dict(zip(graph.names, graph.units, strict=True))
    laws = map(graph.find_lead, graph.tree)
    scales = NEAR_RANGE * np.array([factor * unit[lead.name] for lead, factor, _ in laws])
    for seed in range(NEAR):
        rng = np.random.default_rng(seed)
        values = dict(zip(graph.motors, rng.uniform(-1, 1, len(graph.motors)), strict=True))
        shifts.append(scales * [values.get(joint.drive, 0.0) for joint in graph.tree])
    near = graph.close(home + np.stack(shifts), graph.is_driven)
    near[0] = home
    return near[np.isfinite(near).all(axis=1)]


def get_value(graph: JointGraph, q: FloatArray, joint: GraphJoint) -> float:
    """Return the value of a rotary joint or slide [rad, m], also of one that closes a loop."""
    for i, other in enumerate(graph.tree):
        if joint.name in (other.name, other.origin_a, other.origin_b):
            return float(q[i])
    T = graph.relate(graph.place(q[None]), joint)
    return float((geometry.log_so3(T[:3, :3]) if joint.kind == "R" else T[:3, 3]) @ joint.axis)


def count_repeated_closures(graph: JointGraph, q: FloatArray) -> int:
    """Return how many closure equations repeat others at a pose (j,)."""
    count = len(graph.coupled[1]) + sum({"R": 5, "P": 5, "S": 3}[j.kind] for j in graph.closing)
    return count - (len(q) - graph.find_motions(q).shape[1])


def measure_gap(graph: JointGraph, placement: Placement, joint: GraphJoint) -> tuple[float, float]:
    """Return the distance [m] and angle [rad] between both sides of a closing joint."""
    T, axis = graph.relate(placement, joint), joint.axis
    gap, turned = T[:3, 3], T[:3, :3] @ axis
    if joint.kind == "P":
        gap = gap - axis * (axis @ gap)
    angle = float(np.arctan2(np.linalg.norm(np.cross(axis, turned)), axis @ turned))
    return float(np.linalg.norm(gap)), 0.0 if joint.kind == "S" else angle


def _describe_gap(graph: JointGraph, starts: FloatArray) -> object:
    """Return the finding of loops that do not close: of the closures without which the others
    close, or else of all, the one that is open the most in the best pose.
    """
    q = graph.approach(starts)
    best = q[[int(np.argmin((graph.linearize(q)[0] ** 2).sum(axis=1)))]]
    placement = graph.place(best)
    few = graph.closing if len(graph.closing) <= FEW else ()
    rest = {joint: tuple(other for other in graph.closing if other is not joint) for joint in few}
    first = starts[:NEAR]
    alone = [
        joint
        for joint, others in rest.items()
        if np.isfinite(replace(graph, closing=others).close(first)).any()
    ]
    gaps = [(measure_gap(graph, placement, joint), joint) for joint in alone or graph.closing]
    (gap, angle), joint = max(gaps, key=lambda entry: entry[0][0] / graph.size + entry[0][1])
    return report_finding(
        "files.loops-open",
        closure=joint.name,
        body_a=joint.body_a,
        body_b=joint.body_b,
        gap=Quantity(gap * 1e3, "mm"),
        angle=Quantity(angle, "rad"),
    )


# Loops that close but for the rounded digits of their file.


@dataclass(frozen=True)
class Repair:
    """A mechanism whose loops close exactly.

    graph : with closed loops. gap, angle : largest gap of a closure before the repair [m, rad].
    turn : largest rotation of an axis [rad].
    """

    graph: JointGraph
    gap: float = 0.0
    angle: float = 0.0
    turn: float = 0.0


def repair_rounded_loops(graph: JointGraph, rounding: tuple[float, float]) -> Repair:
    """Return a mechanism with loops that close; as it is where they do, or where no repair helps.
    `rounding` is the error of its lengths [m] and angles [rad].
    """
    unchanged = Repair(graph)
    limit = rounding[1] + rounding[0] / graph.size
    start = np.zeros((1, len(graph.tree)))
    if limit == 0.0 or _can_move(graph, graph.close(start)[0]):
        return unchanged
    q = graph.approach(start)[0]
    if np.abs(graph.linearize(q[None])[0]).max(initial=0.0) > limit:
        starts = _draw_starts(graph)
        try:
            if np.isfinite(graph.close(starts)).any():
                return unchanged
            q = graph.approach(_close_groups(graph, starts, limit))[0]
        except MechanismError:
            return unchanged
    repaired, turn = _align_axes(graph, q, limit)
    if not np.isfinite(repaired.close(q[None])).all():  # with too many motors it cannot move either
        return unchanged
    placement = graph.place(q[None])
    gaps = [measure_gap(graph, placement, joint) for joint in graph.closing]
    return Repair(repaired, max(gap for gap, _ in gaps), max(angle for _, angle in gaps), turn)


def _can_move(graph: JointGraph, q: FloatArray) -> bool:
    """Return whether the loops are closed at joint values (j,) and let all motors move."""
    if not np.isfinite(q).all() or graph.find_motions(q).shape[1] < len(graph.motors):
        return False
    return len(list_nearby(graph, q)) > 1


def _align_axes(graph: JointGraph, q: FloatArray, limit: float) -> tuple[JointGraph, float]:
    """Return the mechanism with axes parallel and closures without gaps at joint values (j,),
    bodies in their places, and the largest rotation of an axis [rad].
    """
    placement = graph.place(q[None])
    frames = {joint: graph.locate_ends(placement, joint)[0][0] for joint in graph.joints}
    moving = [joint for joint in graph.joints if joint.kind != "S"]
    axes = {joint: frames[joint][:3, :3] @ joint.axis for joint in moving}
    known = list(np.eye(3))
    aligned = {}
    for joint in sorted(moving, key=lambda joint: joint.kind == "P"):
        normals = [aligned[other] for other in aligned if other.kind == "R"]
        aligned[joint] = _align(axes[joint], known, normals if joint.kind == "P" else [], limit)
        known.append(aligned[joint])
    tree = {joint.name: float(value) for joint, value in zip(graph.tree, q, strict=True)}
    lines = {joint: (frames[joint][:3, 3], aligned[joint]) for joint in moving if joint.kind == "R"}
    shifts = dict(zip(lines, _meet(np.array([*lines.values()]), limit * graph.size), strict=True))

    def move(joint: GraphJoint) -> GraphJoint:
        A, B = (graph.get_place(placement, body)[0] for body in (joint.body_a, joint.body_b))
        frame, far = frames[joint].copy(), B @ joint.T_b
        if joint.kind == "S":
            far[:3, 3] = frame[:3, 3]
            return replace(joint, T_b=geometry.invert_pose(B) @ far)
        frame[:3, :3] = turn_between(axes[joint], aligned[joint]) @ frame[:3, :3]
        frame[:3, 3] += shifts.get(joint, 0.0)
        near = replace(joint, T_a=geometry.invert_pose(A) @ frame, T_b=np.eye(4))
        if joint in graph.tree:
            value = tree[joint.name]
        elif joint.kind == "R":
            value = float(geometry.log_so3(frame[:3, :3].T @ far[:3, :3]) @ joint.axis)
        else:
            value = float((far[:3, 3] - frame[:3, 3]) @ aligned[joint])
        # the far frame is where the joint moves the near one
        far = A @ near.move(np.array(value))
        return replace(near, T_b=geometry.invert_pose(B) @ far)

    turns = [np.linalg.norm(np.cross(axes[joint], aligned[joint])) for joint in moving]
    return graph.change_joints(move), float(max(turns, default=0.0))


def _meet(lines: FloatArray, limit: float) -> FloatArray:
    """Return the shifts (n, 3) by which lines (n, 2, 3) of points and directions meet in the point
    that most of them pass within a limit [m], at least three; zero for the others.
    """
    points, axes = lines[:, 0], lines[:, 1]
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    shifts, most = np.zeros(points.shape), 2
    for i, k in combinations(range(len(lines)), 2):
        if np.linalg.norm(np.cross(axes[i], axes[k])) > ACROSS:
            pair = across[[i, k]]
            center = np.linalg.solve(pair.sum(axis=0), np.einsum("nij,nj->i", pair, points[[i, k]]))
            gaps = np.einsum("nij,nj->ni", across, center - points)
            near = np.linalg.norm(gaps, axis=1) <= limit
            if near.sum() > most:
                shifts, most = gaps * near[:, None], int(near.sum())
    return shifts


def _align(
    axis: FloatArray, known: list[FloatArray], normals: list[FloatArray], limit: float
) -> FloatArray:
    """Return the known direction (3,) that an axis is parallel to within a limit [rad], or itself
    across the first of the normals that it is almost across.
    """
    for other in known:
        if np.linalg.norm(np.cross(axis, other)) <= limit:
            return other if axis @ other > 0 else -other
    for normal in normals:
        if abs(axis @ normal) <= limit:
            across = axis - normal * (normal @ axis)
            return np.asarray(across / np.linalg.norm(across), dtype=np.float64)
    return axis
