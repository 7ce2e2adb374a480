# SPDX-License-Identifier: Apache-2.0
"""Solve closure for the platform's pose and the free joints: Newton with step control, every row on
its own.

A step is a Householder reduction of each limb (its own joints) and one of the platform. A row is
converged once a step below 1e-7 of the robot's size has been applied (the next would be below
rounding) and what can still be reduced of its residual is at max_iterations 1e-13 of the size; from then on
it is frozen. See docs/theory/engine.md.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopcal.engine.closure import Chain, PlacedLinks, matmul, place_links, rotation
from loopcal.engine.householder import back_substitute, triangularize
from loopcal.engine.program import (
    CONVERGED,
    EXHAUSTED,
    NOT_FINITE,
    STALLED,
    Block,
    ClosureBlocks,
    Group,
    Program,
    State,
)
from loopcal.typing import FloatArray

ROWS = 2048
"""Rows worked on together: few enough for the cache, many enough that Python's share is small."""
RESIDUAL, STEP, SINGULAR = 1e-13, 1e-7, 1e-11
"""Of the robot's size: residual and last step of a converged row. Of its largest: the smallest
pivot of a limb's joints.
"""

Task = Callable[[FloatArray, np.ndarray], tuple[FloatArray, FloatArray]]
"""Demands on the pose: (T (N, 3, 4), rows (N,)) -> residual (N, c) [m] and its columns (N, c, 6)
per twist.
"""


def solve(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    start: State,
    task: Task | None = None,
    free: bool = False,
    max_iterations: int = 60,
) -> State:
    """Find the pose and joints that close every loop.

    e : (t | 1, n_displacements) [m, rad]. q : (t | 1, n, n_joints) actuated joint values [m, rad];
        with `free` they are
    unknowns and q only a first guess. start : where to begin, (t | 1, n | 1) rows. task : demands
        on the pose, as many as
    freed actuators leave open. max_iterations : Newton steps allowed. Rows that fail are marked in `status`,
        never raised.
    """
    t = max(len(e), len(q), len(start.T))
    n = max(q.shape[1], start.T.shape[1])
    places = [place_links(g, e) for g in program.groups]
    joints = [
        insert_driven_values(g, np.broadcast_to(a, (t, n, *a.shape[2:])), q)
        for g, a in zip(program.groups, start.joints, strict=True)
    ]
    T = np.broadcast_to(start.T, (t, n, 4, 4))[:, :, :3]
    begin = np.concatenate(
        [a.reshape(t * n, -1) for a in (T, *(j.swapaxes(2, 3) for j in joints))], axis=1
    ).T
    parts = []
    for first in range(0, t * n, ROWS):
        rows = np.arange(first, min(first + ROWS, t * n))
        work = _Rows(program, [g.rows(rows // n) for g in places], task, free, rows)
        parts.append(_newton(work, begin[:, rows], max_iterations))
    points, status, steps = (np.concatenate(p, axis=-1) for p in zip(*parts, strict=True))
    return _Rows(program, places, task, free, np.arange(t * n)).state(points, status, steps, (t, n))


def linearize(
    program: Program, e: FloatArray, q: FloatArray, state: State, free: bool = False
) -> ClosureBlocks:
    """Closure linearised at a state (t, n), its passive joints (and, if `free`, the actuated ones)
    eliminated.

    e : (t | 1, n_displacements) [m, rad]. q : (t | 1, n, n_joints) actuated joint values [m, rad].
    """
    t, n = state.T.shape[:2]
    T, trial = state.T.reshape(-1, 4, 4)[:, :3].transpose(1, 2, 0), np.arange(t * n) // n
    low, top, eliminated = [], [], []
    for group, joints in zip(program.groups, state.joints, strict=True):
        values = joints if free else insert_driven_values(group, joints, q)
        theta = values.reshape(t * n, len(group.limbs), -1).transpose(2, 1, 0)
        with np.errstate(all="ignore"):
            chain = Chain(group, place_links(group, e).rows(trial), T, theta, program.size)
            unknown = group.unknown_joints(free)
            columns = [chain.joint(j) for j in unknown] + [
                chain.freedom(f) for f in program.freedoms
            ]
            columns += [chain.slot(s) for s in group.slots] + [
                chain.joint(j) for j in range(chain.last)
            ]
            block, _ = triangularize(chain.matrix(columns), len(unknown))
        block = block.transpose(3, 2, 0, 1).reshape(t, n, len(group.limbs), *block.shape[:2])
        u, m, s = len(unknown), len(program.freedoms), len(group.slots)
        top.append(Block(*np.split(block[..., :u, :], [u, u + m, u + m + s], axis=-1)))
        low.append(Block(*np.split(block[..., u:, :], [u, u + m, u + m + s], axis=-1)))
        eliminated.append(tuple(unknown))
    return ClosureBlocks(tuple(low), tuple(top), tuple(eliminated))


class _Rows:
    """Some rows as points: one array (fields, N) of coordinates (pose, joint values), Newton step
    and its measures.
    """

    def __init__(
        self,
        program: Program,
        places: list[PlacedLinks],
        task: Task | None,
        free: bool,
        rows: np.ndarray,
    ) -> None:
        self.program, self.places, self.task, self.free, self.rows = (
            program,
            places,
            task,
            free,
            rows,
        )
        self.unknown = [g.unknown_joints(free) for g in program.groups]
        self.shapes = [(len(g.joints) + 1, len(g.limbs)) for g in program.groups]
        self.ends = np.cumsum([12, *(a * k for a, k in self.shapes)])

    def only(self, keep: np.ndarray) -> _Rows:
        """These rows."""
        return _Rows(
            self.program, [g.rows(keep) for g in self.places], self.task, self.free, self.rows[keep]
        )

    def joints(self, point: FloatArray) -> list[FloatArray]:
        """Joint values (J + 1, k, N) a group, views into a point."""
        cuts = zip(self.ends[:-1], self.ends[1:], self.shapes, strict=True)
        return [point[a:b].reshape(*shape, point.shape[1]) for a, b, shape in cuts]

    def at(self, coordinates: FloatArray, last: FloatArray | None = None) -> FloatArray:
        """These coordinates, then step, norm, reducible norm, step length, orientation, pivot; no
        new step where all rows close and `last`, a rounding away, is given.
        """
        p, m, N = self.program, len(self.program.freedoms), coordinates.shape[1]
        redundant = p.sigma is not None and not self.free
        T, sign, pivot, tops, lows = (
            coordinates[:12].reshape(3, 4, N),
            np.ones(N),
            np.ones(N),
            [],
            [],
        )
        for group, g, theta, unknown in zip(
            p.groups, self.places, self.joints(coordinates), self.unknown, strict=True
        ):
            chain, u = Chain(group, g, T, theta, p.size), len(unknown)
            columns = [chain.joint(j) for j in unknown] + [chain.freedom(f) for f in p.freedoms]
            if redundant:
                j = int(np.flatnonzero(group.actuator[:, 0] >= 0)[0])
                columns.append(chain.joint(j) * np.array(p.sigma)[group.actuator[j], None])
            block, turn = triangularize(chain.matrix([*columns, chain.residual()]), u)
            if u:
                diagonal = np.diagonal(block[:u, :u])
                sign = sign * np.prod(turn * np.prod(np.sign(diagonal), axis=-1), axis=0)
                large = np.maximum(np.abs(diagonal).max(axis=-1), 1e-300)
                pivot = np.minimum(pivot, (np.abs(diagonal).min(axis=-1) / large).min(axis=0))
            tops.append(block[:u])
            low = block[u:, u:].transpose(2, 0, 1, 3).reshape(-1, block.shape[1] - u, N)
            # redundant actuators: each row in the standard deviations of what drives it
            lows.append(np.delete(low / np.abs(low[:, m, None]), m, axis=1) if redundant else low)
        if self.task is not None:
            residual, columns = self.task(T.transpose(2, 0, 1), self.rows)
            lows.append(
                np.concatenate(
                    [columns[..., list(p.freedoms)], residual[..., None]], axis=2
                ).transpose(1, 2, 0)
            )
        low = np.concatenate([*lows, np.zeros((max(0, m - sum(map(len, lows))), m + 1, N))])
        inner = sum(
            (np.add.reduce(top[:, -1] ** 2, axis=(0, 1)) for top in tops), start=np.zeros(N)
        )
        norm = np.sqrt(inner + np.add.reduce(low[:, m] ** 2, axis=0))
        if last is not None and (norm <= RESIDUAL * p.size).all():
            return np.concatenate(
                [coordinates, 0 * last[self.ends[-1] : -5], [norm, norm, 0 * norm], last[-2:]]
            )
        low, turn = triangularize(low, m)
        sign = sign * turn * np.prod(np.sign(np.diagonal(low[:m, :m])), axis=-1)
        y = back_substitute(low[:m, :m], -low[:m, m:])[:, 0]
        inner = inner + np.add.reduce(low[:m, m] ** 2, axis=0)
        twist = np.zeros((6, N))
        twist[list(p.freedoms)] = y
        rest = [
            top[:, -1] + np.add.reduce(top[:, len(top) : len(top) + m] * y[:, None], axis=1)
            for top in tops
        ]
        turns = [
            back_substitute(top[:, : len(top)], -r[:, None])[:, 0]
            for top, r in zip(tops, rest, strict=True)
        ]
        measures = [norm, np.sqrt(inner), self._length(twist, turns), sign, pivot]
        return np.concatenate(
            [coordinates, twist, *(turn.reshape(-1, N) for turn in turns), measures]
        )

    def _length(self, twist: FloatArray, turns: list[FloatArray]) -> FloatArray:
        """Length of a step [m], a turn counted with the robot's size."""
        size = self.program.size
        length = np.maximum(np.abs(twist[:3]).max(axis=0) * size, np.abs(twist[3:]).max(axis=0))
        for group, unknown, turn in zip(self.program.groups, self.unknown, turns, strict=True):
            for j, step in zip(unknown, turn, strict=True):
                length = np.maximum(
                    length,
                    np.abs(step).max(axis=0) * (size if group.joints[j : j + 1] == "R" else 1.0),
                )
        return length

    def moved(self, point: FloatArray, fraction: FloatArray) -> FloatArray:
        """Coordinates a fraction (N,) of its step beyond a point."""
        first, N = self.ends[-1], point.shape[1]
        out, T, twist = (
            point[:first].copy(),
            point[:12].reshape(3, 4, N),
            fraction * point[first : first + 6],
        )
        new = out[:12].reshape(3, 4, N)
        new[:, :3] = matmul(rotation(twist[:3]), T[:, :3])
        new[:, 3] += twist[3:]
        first += 6
        for theta, unknown in zip(self.joints(out), self.unknown, strict=True):
            last = first + len(unknown) * theta.shape[1]
            theta[unknown] += fraction * point[first:last].reshape(len(unknown), theta.shape[1], N)
            first = last
        return out

    def state(
        self, points: FloatArray, status: np.ndarray, steps: np.ndarray, shape: tuple[int, int]
    ) -> State:
        """Points of all rows with the axes (t, n) restored."""
        T = np.zeros((points.shape[1], 4, 4))
        T[:, :3], T[:, 3, 3] = points[:12].T.reshape(-1, 3, 4), 1.0
        joints = tuple(
            j.transpose(2, 1, 0).reshape(*shape, *s[::-1])
            for j, s in zip(self.joints(points), self.shapes, strict=True)
        )
        norm, _, _, sign, _ = points[-5:].reshape(5, *shape)
        sign = np.sign(np.nan_to_num(sign)).astype(np.int8)
        return State(
            T.reshape(*shape, 4, 4), joints, status.reshape(shape), norm, steps.reshape(shape), sign
        )


def _newton(
    work: _Rows, coordinates: FloatArray, max_iterations: int
) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """Iterate one chunk; returns its points, status and iteration counts."""
    size, N = work.program.size, coordinates.shape[1]
    status, steps, alive = np.full(N, EXHAUSTED, np.int8), np.zeros(N, np.int64), np.arange(N)
    shrink, applied, calm = np.ones(N), np.full(N, np.inf), np.zeros(N)
    with np.errstate(all="ignore"):
        point = work.at(coordinates)
        done = point.copy()
        for _ in range(max_iterations):
            reducible, length, pivot = point[-4], point[-3], point[-1]
            settled = (reducible <= RESIDUAL * size) & ((applied <= STEP * size) | (calm > 2))
            broken = ~(np.isfinite(reducible) & np.isfinite(length) & (pivot > SINGULAR))
            end = settled | broken | (shrink < 1e-5)
            if end.any():
                closed = settled & (
                    (point[-5] <= 1e4 * RESIDUAL * size) | (work.program.sigma is not None)
                )
                status[alive[end]] = np.where(
                    broken, NOT_FINITE, np.where(closed, CONVERGED, STALLED)
                )[end]
                done[:, alive[end]] = point[:, end]
                keep = ~end
                work, point, alive = work.only(keep), point[:, keep], alive[keep]
                shrink, applied, calm = shrink[keep], applied[keep], calm[keep]
                if not len(alive):
                    break
            fraction = shrink * np.minimum(1.0, 0.5 * size / np.maximum(point[-3], 1e-300))
            short = (fraction * point[-3] <= STEP * size).all()
            trial = work.at(work.moved(point, fraction), point if short else None)
            low = trial[-4] <= RESIDUAL * size
            better = (
                low
                | (trial[-5] <= (1 - 1e-4 * fraction) * point[-5])
                | (trial[-4] <= 0.5 * point[-4])
            )
            applied = np.where(better, fraction * point[-3], applied)
            calm = np.where(better & low, calm + 1, 0)
            shrink = np.where(better, np.minimum(1.0, 4 * shrink), 0.25 * shrink)
            steps[alive] += 1
            point = trial if better.all() else np.where(better, trial, point)
        done[:, alive] = point
    return done, status, steps


def insert_driven_values(group: Group, joints: FloatArray, q: FloatArray) -> FloatArray:
    """Joint values (t, n, k, J + 1) of a group with the actuated ones set to q."""
    shape = (max(len(joints), len(q)), max(joints.shape[1], q.shape[1]), *joints.shape[2:])
    out = np.array(np.broadcast_to(joints, shape))
    for j, columns in enumerate(group.actuator):
        if columns[0] >= 0:
            out[..., j] = q[:, :, columns]
    return out
