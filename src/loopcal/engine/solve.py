# SPDX-License-Identifier: Apache-2.0
"""Solve closure for the platform's pose and the free joints: Newton with step control, every row on its own.

A step is one Householder reduction a limb (its own joints), one for the platform, and back-substitution. A row is
converged once a step below 1e-7 of the robot's size has been applied (so the next would be below rounding) and its
residual is at most 1e-13 of the size; from then on it is frozen. See docs/theory/engine.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopcal.engine.closure import Geometry, at_rows, closure, geometry, matmul, rotation
from loopcal.engine.householder import back_substitute, triangularise
from loopcal.engine.program import Array, Blocks, Group, Passive, Program, State

CONVERGED, STALLED, EXHAUSTED, NOT_FINITE = 0, 1, 2, 3
ROWS = 2048
"""Rows worked on together: small enough for the cache, large enough that Python's share is small."""

RESIDUAL = 1e-13
"""A converged row's closure residual, of the robot's size (rounding of its coordinates is about 1e-15)."""

Task = Callable[[Array, np.ndarray], tuple[Array, Array]]
"""Demands on the pose: (T (N, 4, 4), rows (N,)) -> residual (N, c) [m] and its columns (N, c, 6) per twist."""


@dataclass
class _Point:
    """Where some rows stand and the Newton step from there; working memory of the iteration."""

    T: Array
    theta: list[Array]
    norm: Array
    reducible: Array
    twist: Array
    turn: list[Array]
    length: Array
    orientation: Array

    def put(self, rows: np.ndarray, other: _Point) -> None:
        """Overwrite these rows (the batch is the last axis, or the last but one for joints)."""
        for mine, new in zip(vars(self).values(), vars(other).values(), strict=True):
            if isinstance(mine, list):
                for a, b in zip(mine, new, strict=True):
                    a[:, rows] = b
            else:
                mine[..., rows] = new

    def take(self, rows: np.ndarray) -> _Point:
        """These rows only."""
        return _Point(
            *([a[:, rows] for a in v] if isinstance(v, list) else v[..., rows] for v in vars(self).values())
        )


def solve(
    program: Program, e: Array, q: Array, start: State, task: Task | None = None, free: bool = False, most: int = 60
) -> State:
    """Find the pose and joints that close every loop.

    Parameters
    ----------
    program : the mechanism. e : (t | 1, n_displacements) [m, rad].
    q : (t | 1, n, n_joints) actuated joint values [m, rad]; with `free` they are unknowns and q only a first guess.
    start : where to begin, (t | 1, n | 1) rows.
    task : demands on the pose, as many as freed actuators leave open.
    most : Newton steps before a row is given up.

    Returns
    -------
    State for (t, n); rows that fail are marked in `status`, never raised.
    """
    t = max(e.shape[0], q.shape[0], start.T.shape[0])
    n = max(q.shape[1], start.T.shape[1])
    geometries = [geometry(g, e) for g in program.groups]
    T = np.broadcast_to(start.T, (t, n, 4, 4)).reshape(-1, 4, 4)
    theta = [_merge(g, np.broadcast_to(a, (t, n, *a.shape[2:])), q) for g, a in zip(program.groups, start.joints, strict=True)]
    flat = [a.reshape(-1, *a.shape[2:]) for a in theta]
    parts = []
    for first in range(0, t * n, ROWS):
        rows = np.arange(first, min(first + ROWS, t * n))
        begin = _Rows(program, [at_rows(g, rows // n) for g in geometries], task, free, rows)
        parts.append(_newton(begin, T[rows, :3].transpose(1, 2, 0), [a[rows].transpose(2, 0, 1) for a in flat], most))
    return _state(program, parts, t, n)


def linearise(program: Program, e: Array, q: Array, state: State, free: bool = False) -> Blocks:
    """Closure linearised at a state, passive joints (and, if `free`, the actuated ones) eliminated.

    Parameters
    ----------
    e : (t | 1, n_displacements); q : (t | 1, n, n_joints); state : (t, n).

    Returns
    -------
    Blocks for (t, n); see there for the meaning of A, E, Q.
    """
    t, n = state.T.shape[:2]
    T = state.T.reshape(-1, 4, 4)[:, :3].transpose(1, 2, 0)
    trial = np.arange(t * n) // n
    A, E, Q, places, passive, count = [], [], [], [], [], 0
    m = len(program.freedoms)
    for group, joints in zip(program.groups, state.joints, strict=True):
        theta = (joints if free else _merge(group, joints, q)).reshape(t * n, group.size, -1).transpose(2, 0, 1)
        unknown = group.unknown(free)
        u, s, last = len(unknown), len(group.slots), len(group.joints) + 1
        block = closure(group, at_rows(geometry(group, e), trial), T, theta, program.freedoms, program.size, unknown, True)
        reduced, _ = triangularise(block.reshape(*block.shape[:2], -1), u)
        # (r, c, N k) -> (t, n, k, r, c)
        reduced = reduced.reshape(block.shape).transpose(2, 3, 0, 1).reshape(t, n, group.size, *block.shape[:2])
        ends = np.cumsum([u, m, s, last])
        top, low = reduced[..., :u, :], reduced[..., u:, :]
        r = low.shape[-2]
        A.append(low[..., ends[0] : ends[1]].reshape(t, n, -1, m))
        E.append(low[..., ends[1] : ends[2]])
        Q.append(low[..., ends[2] : ends[3]])
        places.append(count + np.arange(group.size * r).reshape(group.size, r))
        count += group.size * r
        parts = (top[..., a:b] for a, b in zip((0, *ends[:3]), ends, strict=True))
        passive.append(Passive(tuple(unknown), *parts))
    return Blocks(np.concatenate(A, axis=2), tuple(E), tuple(Q), tuple(places), tuple(passive))


class _Rows:
    """The rows of one chunk: evaluates closure and the Newton step at any point."""

    def __init__(self, program: Program, geometries: list[Geometry], task: Task | None, free: bool, rows: np.ndarray) -> None:
        self.program, self.geometries, self.task, self.free, self.rows = program, geometries, task, free, rows
        self.unknown = [g.unknown(free) for g in program.groups]

    def take(self, keep: np.ndarray) -> _Rows:
        """These rows only."""
        return _Rows(self.program, [at_rows(g, keep) for g in self.geometries], self.task, self.free, self.rows[keep])

    def at(self, T: Array, theta: list[Array]) -> _Point:
        """Residual and Newton step at T (3, 4, N), theta (J + 1, N, k) a group."""
        p, m, N = self.program, len(self.program.freedoms), T.shape[2]
        tops, lows, sign = [], [], np.ones(N)
        for group, g, joints, unknown in zip(p.groups, self.geometries, theta, self.unknown, strict=True):
            block = closure(group, g, T, joints, p.freedoms, p.size, unknown, False)
            u = len(unknown)
            if u:
                block, turn = triangularise(block, u)
                sign = sign * np.prod(turn * np.prod(np.sign(np.diagonal(block[:u, :u])), axis=-1), axis=-1)
            tops.append(block[:u])
            lows.append(block[u:].transpose(0, 3, 1, 2).reshape(-1, m + 1, N))
        low = np.concatenate(lows)
        if self.task is not None:
            low = np.concatenate([low, self._demands(T, m)])
        norm = np.sqrt(sum((np.add.reduce(top[:, -1] ** 2, axis=(0, 2)) for top in tops), np.add.reduce(low[:, -1] ** 2, axis=0)))
        y = np.zeros((m, N))
        inner = [np.add.reduce(top[:, -1] ** 2, axis=(0, 2)) for top in tops]
        if low.shape[0]:
            low, turn = triangularise(low, m)
            sign = sign * turn * np.prod(np.sign(np.diagonal(low[:m, :m])), axis=-1)
            y = back_substitute(low[:m, :m], -low[:m, m:])[:, 0]
            inner.append(np.add.reduce(low[:m, m] ** 2, axis=0))
        turns = [self._joints(top, y) for top in tops]
        return self._point(T, theta, norm, np.sqrt(sum(inner)), y, turns, sign)

    def _demands(self, T: Array, m: int) -> Array:
        """Rows of the task in the platform's freedoms, (c, m + 1, N)."""
        assert self.task is not None
        full = np.zeros((T.shape[2], 4, 4))
        full[:, :3], full[:, 3, 3] = T.transpose(2, 0, 1), 1.0
        residual, columns = self.task(full, self.rows)
        return np.concatenate([columns[..., list(self.program.freedoms)], residual[..., None]], axis=2).transpose(1, 2, 0)

    def _joints(self, top: Array, y: Array) -> Array:
        """Steps of a group's own unknown joints, (u, N, k)."""
        u = top.shape[0]
        if not u:
            return np.empty((0, *top.shape[2:]))
        right = -(top[:, -1] + np.add.reduce(top[:, u:-1] * y[None, :, :, None], axis=1))
        return back_substitute(top[:, :u], right[:, None])[:, 0]

    def _point(self, T: Array, theta: list[Array], norm: Array, reducible: Array, y: Array, turns: list[Array], sign: Array) -> _Point:
        """Put the step in one place and measure it, with a joint's turn as long as the robot's size."""
        p, size = self.program, self.program.size
        twist = np.zeros((6, T.shape[2]))
        twist[list(p.freedoms)] = y
        length = np.maximum(np.abs(twist[:3]).max(axis=0) * size, np.abs(twist[3:]).max(axis=0))
        for group, unknown, turn in zip(p.groups, self.unknown, turns, strict=True):
            for j, step in zip(unknown, turn, strict=True):
                arm = size if j < len(group.joints) and group.joints[j] == "R" else 1.0
                length = np.maximum(length, arm * np.abs(step).max(axis=-1))
        return _Point(T, theta, norm, reducible, twist, turns, length, sign)

    def move(self, point: _Point, fraction: Array) -> tuple[Array, list[Array]]:
        """The point a fraction (N,) of its step further."""
        T = np.empty_like(point.T)
        T[:, :3] = matmul(rotation(point.twist[:3] * fraction), point.T[:, :3])
        T[:, 3] = point.T[:, 3] + fraction * point.twist[3:]
        theta = []
        for old, unknown, turn in zip(point.theta, self.unknown, point.turn, strict=True):
            new = old.copy()
            new[unknown] += fraction[:, None] * turn
            theta.append(new)
        return T, theta


def _newton(work: _Rows, T: Array, theta: list[Array], most: int) -> tuple[_Point, np.ndarray, np.ndarray]:
    """Iterate one chunk; returns its points, status and iteration counts."""
    size, count = work.program.size, T.shape[2]
    with np.errstate(all="ignore"):
        point = work.at(T.copy(), [a.copy() for a in theta])
        done, status, steps = point, np.full(count, EXHAUSTED, np.int8), np.zeros(count, np.int64)
        alive, shrink, applied, calm = np.arange(count), np.ones(count), np.full(count, np.inf), np.zeros(count, int)
        done = point.take(alive)
        for _ in range(most):
            settled = (point.reducible <= RESIDUAL * size) & ((applied <= 1e-7 * size) | (calm > 2))
            broken = ~np.isfinite(point.norm + point.length)
            stuck = shrink < 1e-5
            end = settled | broken | stuck
            if end.any():
                which = alive[end]
                status[which] = np.where(settled, CONVERGED, np.where(broken, NOT_FINITE, STALLED))[end]
                done.put(which, point.take(end))
                keep = ~end
                if not keep.any():
                    break
                work, point, alive = work.take(keep), point.take(keep), alive[keep]
                shrink, applied, calm = shrink[keep], applied[keep], calm[keep]
            fraction = shrink * np.minimum(1.0, 0.5 * size / np.maximum(point.length, 1e-300))
            trial = work.at(*work.move(point, fraction))
            low = trial.reducible <= RESIDUAL * size
            better = (trial.norm <= (1 - 1e-4 * fraction) * point.norm) | (trial.reducible <= 0.5 * point.reducible) | low
            applied = np.where(better, fraction * point.length, applied)
            calm = np.where(better & low, calm + 1, 0)
            shrink = np.where(better, np.minimum(1.0, 4 * shrink), 0.25 * shrink)
            steps[alive] += 1
            if better.all():
                point = trial
            elif better.any():
                point.put(better, trial.take(better))
        else:
            done.put(alive, point)
    return done, status, steps


def _merge(group: Group, joints: Array, q: Array) -> Array:
    """Joint values of a group with the actuated ones set to q, (t, n, k, J + 1)."""
    out = np.array(np.broadcast_to(joints, (max(joints.shape[0], q.shape[0]), max(joints.shape[1], q.shape[1]), *joints.shape[2:])))
    for j, columns in enumerate(group.actuator):
        if columns[0] >= 0:
            out[..., j] = q[:, :, columns]
    return out


def _state(program: Program, parts: list, t: int, n: int) -> State:
    """Join the chunks and restore the (t, n) axes."""
    points, status, steps = zip(*parts, strict=True)
    T = np.zeros((t * n, 4, 4))
    T[:, 3, 3] = 1.0
    T[:, :3] = np.concatenate([p.T for p in points], axis=2).transpose(2, 0, 1)
    joints = tuple(
        np.concatenate([p.theta[g] for p in points], axis=1).transpose(1, 2, 0).reshape(t, n, group.size, -1)
        for g, group in enumerate(program.groups)
    )
    scalars = [np.concatenate([getattr(p, name) for p in points]).reshape(t, n) for name in ("norm", "orientation")]
    return State(
        T.reshape(t, n, 4, 4),
        joints,
        np.concatenate(status).reshape(t, n),
        scalars[0],
        np.concatenate(steps).reshape(t, n),
        np.sign(np.nan_to_num(scalars[1])).astype(np.int8),
    )
