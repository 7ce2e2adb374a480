# SPDX-License-Identifier: Apache-2.0
"""A mechanism as bodies and joints: a tree of joints from the base, and joints that close loops.

With q the values of the tree, joint by joint, every joint of the tree places a body, T_b = T_a J(q)
(frames of both bodies on the joint). A joint that closes a loop adds equations between two bodies
that the tree has placed already: a ball joint p_a = p_b for its centers, a rotary joint also a_a =
a_b for its axes, and a slide equal orientations and (p_a - p_b) x a = 0. Their derivatives by q are
those of the two points and directions, which only the joints below each body move.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.mechanism.joint_graph.graph_joint import GraphJoint
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import BoolArray, FloatArray

CLOSURE_RANK_TOLERANCE = 1e-8
"""Singular value of the scaled closures, relative to the largest, that counts as zero [1]."""

CLOSED = 1e-13
"""Largest closure residual of a home pose, lengths as a share of the largest one [1]."""

STEPS, LARGEST_STEP = 40, 0.6
"""Newton steps, and the largest change of a joint value in one of them [rad, sizes]."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Places of a tree at n joint values.

    Attributes
    ----------
    T : (n, bodies, 4, 4) T_base_body [m]. axes, points : (n, j, 3) axis and a point of each joint.
    """

    T: FloatArray
    axes: FloatArray
    points: FloatArray


@dataclass(frozen=True)
class JointGraph:
    """A mechanism.

    Attributes
    ----------
    base : the root body. tree : joints, each after the one that carries its first body.
    closing : joints that close loops. motors : names of driven joints, all in the tree.
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

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the joints of the tree."""
        return tuple(joint.name for joint in self.tree)

    @cached_property
    def is_driven(self) -> BoolArray:
        """Which joints of the tree are driven (j,)."""
        return np.array([name in self.motors for name in self.names], dtype=bool)

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
    def _columns(self) -> FloatArray:
        """Unit of each joint value in the scaled closures (j,) [rad, m]."""
        return np.where(self.turns, 1.0, self.size)

    @cached_property
    def _index(self) -> Mapping[str, int]:
        return {body: i for i, body in enumerate(self.bodies)}

    @cached_property
    def _carriers(self) -> list[int]:
        """Return the number of the first body of each joint of the tree."""
        return [self._index[joint.body_a] for joint in self.tree]

    @cached_property
    def _axes(self) -> FloatArray:
        """Axes (j, 3) of the joints of the tree in their frames."""
        return np.reshape([joint.axis for joint in self.tree], (-1, 3))

    @cached_property
    def _frames(self) -> FloatArray:
        """Frames (j, 4, 4) of the joints of the tree in their first bodies."""
        return np.reshape([joint.T_a for joint in self.tree], (-1, 4, 4))

    @cached_property
    def _back(self) -> FloatArray:
        """Second bodies (j, 4, 4) of the joints of the tree in the frames of the joints."""
        return geometry.invert_pose(np.reshape([joint.T_b for joint in self.tree], (-1, 4, 4)))

    @cached_property
    def _is_below(self) -> BoolArray:
        """Which joints (j,) of the tree move each body (bodies, j)."""
        below = np.zeros((len(self.bodies), len(self.tree)), dtype=bool)
        for i, joint in enumerate(self.tree):
            below[i + 1] = below[self._index[joint.body_a]]
            below[i + 1, i] = True
        return below

    def place(self, q: FloatArray) -> Placement:
        """Return the places of all bodies and joints at joint values (n, j)."""
        n, j = q.shape
        T = np.tile(np.eye(4), (n, j + 1, 1, 1))
        moves = self._move_all(q)
        for i, carrier in enumerate(self._carriers):
            T[:, i + 1] = T[:, carrier] @ moves[:, i] @ self._back[i]
        frames = T[:, self._carriers] @ self._frames
        axes = (frames[..., :3, :3] @ self._axes[:, :, None])[..., 0]
        points = frames[..., :3, 3]
        return Placement(T, axes, points)

    def _move_all(self, q: FloatArray) -> FloatArray:
        """Return the frames (n, j, 4, 4) of the second bodies of the joints in the first ones."""
        vectors = q[..., None] * self._axes
        turns = np.where(self.turns[:, None], vectors, 0.0)
        shifts = np.where(self.turns[:, None], 0.0, vectors)
        return self._frames @ geometry.make_pose(geometry.exp_so3(turns), shifts)

    def get_place(self, placement: Placement, body: str) -> FloatArray:
        """Return the places (n, 4, 4) of a body."""
        return placement.T[:, self._index[body]]

    def differentiate(
        self, placement: Placement, body: str, point: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return turn and velocity (n, 3, j) of a point (n, 3) [m] of a body by joint values."""
        below = self._is_below[self._index[body]][:, None]
        turns = self.turns[:, None]
        arms = np.cross(placement.axes, point[:, None] - placement.points)
        velocity = np.where(turns, arms, placement.axes) * below
        return (
            np.where(turns & below, placement.axes, 0.0).swapaxes(-1, -2),
            velocity.swapaxes(-1, -2),
        )

    def linearize(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, e) of the closures at joint values (n, j), and derivatives by them.

        Lengths are divided by `size`, and a slide's value is counted in it.
        """
        placement = self.place(q)
        residual, rows = [np.zeros((len(q), 0))], [np.zeros((len(q), 0, len(self.tree)))]
        for joint in self.closing:
            r, J = self._linearize_joint(placement, joint)
            residual.append(r)
            rows.append(J * self._columns)
        return np.concatenate(residual, axis=1), np.concatenate(rows, axis=1)

    def _linearize_joint(
        self, placement: Placement, joint: GraphJoint
    ) -> tuple[FloatArray, FloatArray]:
        """Return residuals and derivatives of one closure."""
        P = self.get_place(placement, joint.body_a) @ joint.T_a
        Q = self.get_place(placement, joint.body_b) @ joint.T_b
        p, q = P[:, :3, 3], Q[:, :3, 3]
        turn_p, speed_p = self.differentiate(placement, joint.body_a, p)
        turn_q, speed_q = self.differentiate(placement, joint.body_b, q)
        gap, gap_rows = (p - q) / self.size, (speed_p - speed_q) / self.size
        if joint.kind == "S":
            return gap, gap_rows
        # directions that the joint keeps equal on both bodies
        kept = [joint.axis] if joint.kind == "R" else list(np.eye(3))
        u = [P[:, :3, :3] @ v for v in kept]
        w = [Q[:, :3, :3] @ v for v in kept]
        apart = np.concatenate([a - b for a, b in zip(u, w, strict=True)], axis=1)
        turned = [
            geometry.hat(b) @ turn_q - geometry.hat(a) @ turn_p for a, b in zip(u, w, strict=True)
        ]
        if joint.kind == "P":
            axis = P[:, :3, :3] @ joint.axis
            # d (axis x gap) = axis x d gap - gap x (turn x axis)
            swing = geometry.hat(gap) @ geometry.hat(axis) @ turn_p
            gap, gap_rows = np.cross(axis, gap), geometry.hat(axis) @ gap_rows + swing
        return (np.concatenate([gap, apart], axis=1), np.concatenate([gap_rows, *turned], axis=1))

    def close(self, starts: FloatArray, fixed: BoolArray | None = None) -> FloatArray:
        """Close the loops by Newton's method from joint values (n, j); NaN where it diverges.

        `fixed` (j,) are joints that keep their values. Steps are of least norm.
        """
        q, is_closed = starts.copy(), np.zeros(len(starts), dtype=bool)
        free = np.ones(len(self.tree), dtype=bool) if fixed is None else ~fixed
        for _ in range(STEPS):
            left = np.flatnonzero(~is_closed)
            if not left.size:
                break
            residual, rows = self.linearize(q[left])
            is_closed[left] = np.abs(residual).max(axis=1, initial=0.0) < CLOSED
            active = ~is_closed[left]
            step = np.zeros((int(active.sum()), len(free)))
            inverse = np.linalg.pinv(rows[active][:, :, free], rcond=CLOSURE_RANK_TOLERANCE)
            step[:, free] = -(inverse @ residual[active][:, :, None])[:, :, 0]
            largest = np.abs(step).max(axis=1, initial=1e-300, keepdims=True)
            q[left[active]] += step * np.minimum(1.0, LARGEST_STEP / largest) * self._columns
        q[~is_closed] = np.nan
        return q

    def find_motions(self, q: FloatArray) -> FloatArray:
        """Return rates (j, m) that keep the loops closed at joint values (j,); m is the mobility.

        Rates are orthonormal in the scaled values.
        """
        rows = self.linearize(q[None])[1][0]
        if not len(rows):
            return np.diag(self._columns)
        _, s, V = np.linalg.svd(rows)
        null = V[int(are_nonzero(s, CLOSURE_RANK_TOLERANCE).sum()) :]
        return self._columns[:, None] * null.T

    def find_twists(self, q: FloatArray, body: str, frame: FloatArray) -> FloatArray:
        """Return the twist (6, j) of a frame (4, 4) of a body by joint values (j,), about its
        origin in base axes, as (turn, velocity) [rad, m].
        """
        placement = self.place(q[None])
        point = (self.get_place(placement, body) @ frame)[:, :3, 3]
        return np.concatenate(self.differentiate(placement, body, point), axis=1)[0]

    def without(self, bodies: frozenset[str]) -> JointGraph:
        """Return the mechanism without bodies that carry no others, and without their joints."""
        ends = lambda joint: bodies & {joint.body_a, joint.body_b}  # noqa: E731
        return replace(
            self,
            tree=tuple(joint for joint in self.tree if not ends(joint)),
            closing=tuple(joint for joint in self.closing if not ends(joint)),
        )
