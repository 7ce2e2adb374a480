# SPDX-License-Identifier: Apache-2.0
"""Solve closure for the platform pose and the free joints: Newton with step control, row by row.

A step is a Householder reduction of each limb (its own joints) and one of the platform. A row has
converged when a step below 1e-7 of the robot's size has been applied (the next one would be below
rounding) and the reducible part of its residual is at most 1e-13 of the size; it then stays as it
is. Derivation: docs/theory/engine.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np

from loopcal.engine.numpy_engine.closure import (
    Chain,
    PlacedLinks,
    dot,
    exponential,
    matmul,
    place_links,
)
from loopcal.engine.numpy_engine.householder import back_substitute, triangularize
from loopcal.engine.numpy_engine.limbs import close_limbs, have_closed_form
from loopcal.engine.program import (
    CONVERGED,
    EXHAUSTED,
    NEAR_GOAL,
    NOT_FINITE,
    STALLED,
    Program,
    State,
    Task,
)
from loopcal.typing import BoolArray, FloatArray

CHUNK = 2048
"""Rows solved together: few enough for the cache, many enough that Python's share is small."""
RESIDUAL, STEP = 1e-13, 1e-7
"""Residual and last step of a converged row, relative to the robot's size."""
NEAR, NEARER = 1e-2, 0.1
"""Distance from a goal, relative to the robot's size and to the step towards it, below which
Newton's method ends there. A step that ends so much closer than it was long converges
quadratically. Other solutions of the same readings are at least ten times as far from each other,
except close to a singularity.
"""
SINGULAR = 1e-11
"""Smallest pivot of a limb's joints, relative to its largest, below which a limb is singular."""


class Iterate(NamedTuple):
    """A Newton iterate of N rows.

    coordinates : (12 + joint values, N) platform rotation and position (3, 4), then all joints.
    step : (6 + unknown joints, N) Newton step from there: twist, then unknown joints.
    residual : (N,) norm of the closure residual [m]. reducible : (N,) the part of it that a further
        step can remove [m]. length : (N,) length of the step [m], angles times the robot's size.
    sign : (N,) sign of the determinant. pivot : (N,) smallest relative pivot of the limbs.
    """

    coordinates: FloatArray
    step: FloatArray
    residual: FloatArray
    reducible: FloatArray
    length: FloatArray
    sign: FloatArray
    pivot: FloatArray

    def select(self, keep: np.ndarray) -> Iterate:
        """Return these rows."""
        return Iterate(*(a[..., keep] for a in self))

    def replace_where(self, better: np.ndarray, trial: Iterate) -> Iterate:
        """Return the rows of `trial` where it is better, the others as they are."""
        if better.all():
            return trial
        return Iterate(*(np.where(better, b, a) for a, b in zip(self, trial, strict=True)))


class Solved(NamedTuple):
    """The last iterates of N rows with their status and their numbers of steps."""

    coordinates: FloatArray
    residual: FloatArray
    sign: FloatArray
    status: np.ndarray
    steps: np.ndarray


def solve(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    start: State,
    task: Task | None = None,
    free: bool = False,
    max_iterations: int = 60,
    goal: State | None = None,
) -> State:
    """Find the pose and the joints that close every loop; see `loopcal.engine.solve`."""
    if not program.freedoms and free and have_closed_form(program):
        return close_limbs(program, e, q, start, CHUNK)
    t, n = max(len(e), len(q), len(start.T)), max(q.shape[1], start.T.shape[1])
    links = [place_links(g, e) for g in program.groups]
    unknown = [g.unknown_joints(free) for g in program.groups]
    redundant = program.sigma is not None and not free
    joints = [
        g.insert_driven(np.broadcast_to(a, (t, n, *a.shape[2:])), q).swapaxes(2, 3)
        for g, a in zip(program.groups, start.joints, strict=True)
    ]
    T = np.broadcast_to(start.T, (t, n, 4, 4))[:, :, :3]
    begin = np.concatenate([a.reshape(t * n, -1) for a in (T, *joints)], axis=1).T
    goals = None if goal is None else goal.T.reshape(t * n, 4, 4)[:, :3].transpose(1, 2, 0)
    chunks = []
    for rows in np.split(np.arange(t * n), range(CHUNK, t * n, CHUNK)):
        placed = [p.select(rows // n) for p in links]
        equations = _Equations(program, unknown, redundant, placed, task, rows)
        goal_rows = None if goals is None else goals[..., rows]
        chunks.append(_iterate(equations, begin[:, rows], max_iterations, goal_rows))
    whole = Solved(*(np.concatenate(arrays, axis=-1) for arrays in zip(*chunks, strict=True)))
    return _pack(program, whole, (t, n))


def _iterate(
    equations: _Equations, coordinates: FloatArray, max_iterations: int, goal: FloatArray | None
) -> Solved:
    """Iterate one chunk until every row has converged, is near its goal (3, 4, N), or failed."""
    size, N = equations.program.size, coordinates.shape[1]
    program = equations.program
    may_stay_open = program.may_stay_open or program.sigma is not None
    status, steps, alive = np.full(N, EXHAUSTED, np.int8), np.zeros(N, np.int64), np.arange(N)
    # share of the full step, length of the last applied step, steps in a row at rounding level
    share, applied, at_rounding = np.ones(N), np.full(N, np.inf), np.zeros(N)
    with np.errstate(all="ignore"):
        now = equations.evaluate(coordinates)
        done = Solved(now.coordinates.copy(), now.residual.copy(), now.sign.copy(), status, steps)
        for _ in range(max_iterations):
            settled = (now.reducible <= RESIDUAL * size) & (
                (applied <= STEP * size) | (at_rounding > 2)
            )
            finite = np.isfinite(now.reducible) & np.isfinite(now.length)
            finite &= np.isfinite(now.coordinates[:12]).all(axis=0)  # some are in no equation
            broken = ~(finite & (now.pivot > SINGULAR))
            end = settled | broken | (share < 1e-5)
            is_near = np.zeros_like(end)
            if goal is not None:
                is_near = equations.lead_to(now, goal[..., alive]) & ~end
                end |= is_near
            if end.any():
                closed = settled & ((now.residual <= 1e4 * RESIDUAL * size) | may_stay_open)
                reason = np.where(broken, NOT_FINITE, np.where(closed, CONVERGED, STALLED))
                reason[is_near] = NEAR_GOAL
                keep, status[alive[end]] = ~end, reason[end]
                _store(done, alive[end], now.select(end) if keep.any() else now)
                if not keep.any():
                    return done
                equations, now, alive = equations.select(keep), now.select(keep), alive[keep]
                share, applied, at_rounding = share[keep], applied[keep], at_rounding[keep]
            fraction = share * np.minimum(1.0, 0.5 * size / np.maximum(now.length, 1e-300))
            length = fraction * now.length
            tiny = bool((length <= STEP * size).all())
            trial = equations.evaluate(equations.move(now, fraction), now if tiny else None)
            low = trial.reducible <= RESIDUAL * size
            better = low | (trial.residual <= (1 - 1e-4 * fraction) * now.residual)
            better |= trial.reducible <= 0.5 * now.reducible
            applied = np.where(better, length, applied)
            at_rounding = np.where(better & low, at_rounding + 1, 0)
            share = np.where(better, np.minimum(1.0, 4 * share), 0.25 * share)
            steps[alive] += 1
            now = now.replace_where(better, trial)
        _store(done, alive, now)
    return done


def _store(done: Solved, rows: np.ndarray, last: Iterate) -> None:
    """Write the last iterates of these rows into a result under construction."""
    done.coordinates[:, rows] = last.coordinates
    done.residual[rows], done.sign[rows] = last.residual, last.sign


@dataclass(frozen=True)
class _Equations:
    """The closure equations of N rows as a function of their coordinates.

    unknown : joints that closure determines, group by group. redundant : whether the residual is
        weighted by the standard deviations of redundant actuators. rows : (N,) numbers for `task`.
    """

    program: Program
    unknown: list[list[int]]
    redundant: bool
    links: list[PlacedLinks]
    task: Task | None
    rows: np.ndarray

    def select(self, keep: np.ndarray) -> _Equations:
        """Return the equations of these rows."""
        return replace(self, links=[p.select(keep) for p in self.links], rows=self.rows[keep])

    def evaluate(self, coordinates: FloatArray, previous: Iterate | None = None) -> Iterate:
        """Return the Newton step at these coordinates and its measures.

        previous : an iterate that is a rounding error away; its step is not computed anew where all
        rows close.
        """
        program, m, N = self.program, len(self.program.freedoms), coordinates.shape[1]
        T, limbs = coordinates[:12].reshape(3, 4, N), _split_joints(program, coordinates)
        eliminated = [self._eliminate(i, T, theta) for i, theta in enumerate(limbs)]
        tops, lows, signs, pivots = map(list, zip(*eliminated, strict=True))
        if self.task is not None:
            residual, slopes = self.task(T.transpose(2, 0, 1), self.rows)
            demand = [slopes[..., list(program.freedoms)], residual[..., None]]
            lows.append(np.concatenate(demand, axis=2).transpose(1, 2, 0))
        if (missing := m - sum(map(len, lows))) > 0:
            lows.append(np.zeros((missing, m + 1, N)))
        low = np.concatenate(lows) if len(lows) > 1 else lows[0]
        used = (np.add.reduce(top[:, -1] ** 2, axis=(0, 1)) for top in tops if len(top))
        inner = sum(used, np.zeros(N))
        norm = np.sqrt(inner + np.add.reduce(low[:, m] ** 2, axis=0))
        if previous is not None and (norm <= RESIDUAL * program.size).all():
            still = previous._replace(step=0 * previous.step, length=0 * norm)
            return still._replace(coordinates=coordinates, residual=norm, reducible=norm)
        low, reflected = triangularize(low, m)
        signs += [reflected, np.multiply.reduce(np.sign(np.diagonal(low[:m, :m])), axis=-1)]
        y = back_substitute(low[:m, :m], -low[:m, m:])[:, 0]
        reducible = np.sqrt(inner + np.add.reduce(low[:m, m] ** 2, axis=0))
        twist = np.zeros((6, N))
        twist[list(program.freedoms)] = y
        turns = []
        for top in tops:
            u = len(top)
            rest = top[:, -1] + np.add.reduce(top[:, u : u + m] * y[:, None], axis=1)
            turns.append(back_substitute(top[:, :u], -rest[:, None])[:, 0])
        step = np.concatenate([twist, *(turn.reshape(-1, N) for turn in turns)])
        sign, pivot = reduce(np.multiply, signs), reduce(np.minimum, pivots)
        length = self._length(twist, turns)
        return Iterate(coordinates, step, norm, reducible, length, sign, pivot)

    def _eliminate(
        self, i: int, T: FloatArray, theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Eliminate the joints of the limbs in group i.

        Returns the rows (u, columns, k, N) that determine these joints, the rows (.., m + 1, N)
        without them, and the sign of the determinant and the smallest relative pivot (N,).
        """
        program, group, unknown = self.program, self.program.groups[i], self.unknown[i]
        chain, u, m = Chain(group, self.links[i], T, theta, program.size), len(unknown), 0
        columns = [chain.rows_of_joint(j) for j in unknown]
        columns += [chain.rows_of_freedom(f) for f in program.freedoms]
        if self.redundant:
            j = int(np.flatnonzero(group.actuator[:, 0] >= 0)[0])
            sigma = np.array(program.sigma)[group.actuator[j], None]
            columns.append(chain.rows_of_joint(j) * sigma)
        rows = chain.stack(*columns, chain.residual())
        sign = pivot = np.ones(T.shape[-1])
        if u:
            rows, reflected = triangularize(rows, u)
            diagonal = np.diagonal(rows[:u, :u])
            sign = np.prod(reflected * np.prod(np.sign(diagonal), axis=-1), axis=0)
            largest = np.maximum(np.abs(diagonal).max(axis=-1), 1e-300)
            pivot = (np.abs(diagonal).min(axis=-1) / largest).min(axis=0)
        low = rows[u:, u:].transpose(2, 0, 1, 3).reshape(-1, rows.shape[1] - u, T.shape[-1])
        if self.redundant:
            # each row in standard deviations of the actuator that drives its limb
            m = len(program.freedoms)
            low = np.delete(low / np.abs(low[:, m, None]), m, axis=1)
        return rows[:u], low, sign, pivot

    def _length(self, twist: FloatArray, turns: list[FloatArray]) -> FloatArray:
        """Return the length of a step [m]: its largest part, an angle times the robot's size."""
        size = self.program.size
        parts = np.maximum.reduce(np.abs(twist).reshape(2, 3, -1), axis=1)
        length = np.maximum(parts[0] * size, parts[1])
        for group, unknown, turn in zip(self.program.groups, self.unknown, turns, strict=True):
            for j, part in zip(unknown, turn, strict=True):
                unit = size if group.joints[j : j + 1] == "R" else 1.0
                length = np.maximum(length, np.abs(part).max(axis=0) * unit)
        return length

    def lead_to(self, now: Iterate, goal: FloatArray) -> BoolArray:
        """Return which full steps (N,) lead close to the platform of a goal (3, 4, N)."""
        size, T = self.program.size, now.coordinates[:12].reshape(3, 4, -1)
        rotation = matmul(exponential(now.step[:3]), T[:, :3]) - goal[:, :3]
        position = T[:, 3] + now.step[3:6] - goal[:, 3]
        square = 0.5 * size**2 * np.add.reduce(rotation**2, axis=(0, 1)) + dot(position, position)
        length = np.minimum(NEAR * size, NEARER * now.length)
        return (now.length <= 0.5 * size) & (square <= length**2)

    def move(self, now: Iterate, fraction: FloatArray) -> FloatArray:
        """Return the coordinates a fraction (N,) of its step beyond an iterate."""
        out, N = now.coordinates.copy(), len(fraction)
        twist, T, new = fraction * now.step[:6], now.coordinates[:12], out[:12].reshape(3, 4, N)
        new[:, :3] = matmul(exponential(twist[:3]), T.reshape(3, 4, N)[:, :3])
        new[:, 3] += twist[3:]
        first = 6
        for theta, unknown in zip(_split_joints(self.program, out), self.unknown, strict=True):
            last = first + len(unknown) * theta.shape[1]
            if unknown:
                theta[unknown] += fraction * now.step[first:last].reshape(-1, *theta.shape[1:])
            first = last
        return out


def _split_joints(program: Program, coordinates: FloatArray) -> list[FloatArray]:
    """Return the joint values (J + 1, k, N) of each group as views into coordinates."""
    out, first = [], 12
    for group in program.groups:  # the rod counts as a joint
        values, limbs = len(group.joints) + 1, len(group.limbs)
        last = first + values * limbs
        out.append(coordinates[first:last].reshape(values, limbs, coordinates.shape[1]))
        first = last
    return out


def _pack(program: Program, solved: Solved, shape: tuple[int, int]) -> State:
    """Return solved rows as a state with the axes (t, n)."""
    T = np.zeros((solved.coordinates.shape[1], 4, 4))
    T[:, :3], T[:, 3, 3] = solved.coordinates[:12].T.reshape(-1, 3, 4), 1.0
    limbs = _split_joints(program, solved.coordinates)
    joints = tuple(a.transpose(2, 1, 0).reshape(*shape, *a.shape[1::-1]) for a in limbs)
    return State(
        T.reshape(*shape, 4, 4),
        joints,
        solved.status.reshape(shape),
        solved.residual.reshape(shape),
        solved.steps.reshape(shape),
        np.sign(np.nan_to_num(solved.sign)).astype(np.int8).reshape(shape),
    )
