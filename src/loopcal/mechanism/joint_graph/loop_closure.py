# SPDX-License-Identifier: Apache-2.0
"""A mechanism as bodies and joints: a tree of joints from the base, and pins that close its loops.

A pin turns about one axis that both bodies carry: T_a R(axis, q) = T_b.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import FloatArray

CLOSURE_RANK_TOLERANCE = 1e-8
"""Singular value of the closures, relative to the largest, that counts as zero [1]."""

CLOSED = 1e-13
"""Largest closure residual of a home pose [m, 1]."""

STARTS, STEPS, SPREAD = 24, 40, 0.6
"""Tries to close the loops, Newton steps of each, and range of their first joint values [rad]."""

NEAR, NEAR_RANGE = 4, 0.15
"""Number of poses near a pose, and range of their motors [rad, m]."""


@dataclass(frozen=True)
class GraphJoint:
    """A joint between two bodies: `T_a` moved by the joint is `T_b`, each (4, 4) in its body.

    Attributes
    ----------
    kind : R or P. body_a, body_b : the bodies. axis : (3,) unit vector in the frame of the joint.
    is_pin : whether it closes a loop; then `name` is its end on the first body, `far` on the other.
    """

    name: str
    kind: str
    body_a: str
    body_b: str
    T_a: FloatArray
    T_b: FloatArray
    axis: FloatArray
    is_pin: bool = False
    far: str = ""

    def flip(self) -> GraphJoint:
        """Return a pin as the other body carries it."""
        swapped = replace(self, body_a=self.body_b, body_b=self.body_a, T_a=self.T_b, T_b=self.T_a)
        return replace(swapped, name=self.far, far=self.name)

    def move(self, value: float) -> FloatArray:
        """Return the joint frame of the other body (4, 4) in the first body."""
        turn, shift = (value, 0.0) if self.kind == "R" else (0.0, value)
        return self.T_a @ geometry.make_pose(geometry.exp_so3(turn * self.axis), shift * self.axis)


@dataclass(frozen=True)
class JointGraph:
    """A mechanism at joint values.

    Attributes
    ----------
    base : the root body. tree : joints, each after the one that carries it. pins : close the loops.
    motors : names of driven joints. values : joint -> value [rad or m].
    homes : joint values that close the loops, those nearest to zero first.
    """

    base: str
    tree: tuple[GraphJoint, ...]
    pins: tuple[GraphJoint, ...]
    motors: tuple[str, ...]
    values: Mapping[str, float]
    homes: tuple[Mapping[str, float], ...] = ()

    @property
    def bodies(self) -> tuple[str, ...]:
        """All bodies, the base first."""
        return (self.base, *(joint.body_b for joint in self.tree))

    @property
    def joints(self) -> tuple[GraphJoint, ...]:
        """All joints."""
        return self.tree + self.pins

    @cached_property
    def places(self) -> dict[str, FloatArray]:
        """Body -> T_base_body (4, 4)."""
        T = {self.base: np.eye(4)}
        for joint in self.tree:
            T[joint.body_b] = T[joint.body_a] @ joint.move(self.values[joint.name])
        return T

    def twists(self, body: str, point: FloatArray) -> FloatArray:
        """Return twists (6, j) (omega, v of a point [m] of the body) of the joints of the tree."""
        T, columns = self.places, np.zeros((6, len(self.tree)))
        index = {joint.body_b: i for i, joint in enumerate(self.tree)}
        while body in index:
            i = index[body]
            joint = self.tree[i]
            frame = T[joint.body_a] @ joint.T_a
            axis = frame[:3, :3] @ joint.axis
            arm = np.cross(axis, point - frame[:3, 3])
            columns[:, i] = np.concatenate(
                [axis, arm] if joint.kind == "R" else [np.zeros(3), axis]
            )
            body = joint.body_a
        return columns

    def linearize_closure(self) -> tuple[FloatArray, FloatArray]:
        """Return residuals (6 c,) [m, 1] of the c pins, and derivatives (6 c, j) by the tree."""
        T, residual, rows = self.places, [], []
        for pin in self.pins:
            frames = T[pin.body_a] @ pin.T_a, T[pin.body_b] @ pin.T_b
            (p, q), (a, b) = (f[:3, 3] for f in frames), (f[:3, :3] @ pin.axis for f in frames)
            A, B = self.twists(pin.body_a, p), self.twists(pin.body_b, q)
            residual += [p - q, a - b]
            rows += [A[3:] - B[3:], geometry.hat(b) @ B[:3] - geometry.hat(a) @ A[:3]]
        if not rows:
            return np.zeros(0), np.zeros((0, len(self.tree)))
        return np.concatenate(residual), np.concatenate(rows)

    def motions(self) -> FloatArray:
        """Return joint rates (j, m) that keep the loops closed; m is the mobility."""
        _, rows = self.linearize_closure()
        if not len(rows):
            return np.eye(len(self.tree))
        _, s, V = np.linalg.svd(rows)
        return V[int(are_nonzero(s, CLOSURE_RANK_TOLERANCE).sum()) :].T

    def measure_firmness(self, platform: str) -> float:
        """Return how well the motors hold the passive joints and move the platform.

        It is the product of two smallest singular values: of the closures by the passive joints,
        and of the platform's twist by the joint rates that keep the loops closed.
        """
        _, rows = self.linearize_closure()
        passive = rows[:, [joint.name not in self.motors for joint in self.tree]]
        hold = 1.0
        if passive.size:
            hold = float(np.linalg.svd(passive, compute_uv=False)[passive.shape[1] - 1])
        twists = self.twists(platform, self.places[platform][:3, 3]) @ self.motions()
        return hold * float(np.linalg.svd(twists, compute_uv=False)[-1])

    def close(self, start: Mapping[str, float], fixed: tuple[str, ...] = ()) -> JointGraph | None:
        """Close the loops by Newton's method from joint values; None where it does not converge."""
        free = np.array([joint.name not in fixed for joint in self.tree])
        graph = replace(self, values=dict(start))
        for _ in range(STEPS):
            residual, rows = graph.linearize_closure()
            if np.abs(residual).max(initial=0.0) < CLOSED:
                return graph
            step = np.zeros(len(free))
            step[free] = np.linalg.lstsq(rows[:, free], -residual, rcond=CLOSURE_RANK_TOLERANCE)[0]
            step *= min(1.0, SPREAD / max(float(np.abs(step).max()), 1e-300))
            values = {j.name: graph.values[j.name] + step[i] for i, j in enumerate(self.tree)}
            graph = replace(graph, values=values)
        return None

    def list_nearby(self) -> Iterator[JointGraph]:
        """Yield this pose, and others with the motors moved a little."""
        yield self
        for seed in range(NEAR):
            rng = np.random.default_rng(seed)
            start = {
                name: value + (rng.uniform(-NEAR_RANGE, NEAR_RANGE) if name in self.motors else 0.0)
                for name, value in self.values.items()
            }
            closed = self.close(start, self.motors)
            if closed is not None:
                yield closed

    def get_pin_angle(self, pin: GraphJoint) -> float:
        """Return the angle of a pin [rad]."""
        T = self.places
        between = geometry.invert_pose(T[pin.body_a] @ pin.T_a) @ T[pin.body_b] @ pin.T_b
        return float(geometry.log_so3(between[:3, :3]) @ pin.axis)


def find_home(graph: JointGraph) -> JointGraph:
    """Return the mechanism at the closed pose nearest to zero, with further ones as `homes`.

    Poses of larger mobility, from which a link could move either way, are left out.

    Raises
    ------
    MechanismError : the loops do not close.
    """
    closed = []
    for seed in range(STARTS):
        rng = np.random.default_rng(seed)
        spread = 0.0 if seed == 0 else SPREAD
        solution = graph.close({name: rng.uniform(-spread, spread) for name in graph.values})
        if solution is not None:
            closed.append(solution)
    if not closed:
        raise MechanismError("the loops do not close from any start; check the closures")
    mobilities = [pose.motions().shape[1] for pose in closed]
    regular = [pose for pose, m in zip(closed, mobilities, strict=True) if m == min(mobilities)]
    nearest = sorted(regular, key=lambda pose: sum(value**2 for value in pose.values.values()))
    return replace(nearest[0], homes=tuple(pose.values for pose in nearest))
