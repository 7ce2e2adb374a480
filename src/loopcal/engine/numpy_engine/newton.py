# SPDX-License-Identifier: Apache-2.0
"""Solve closure for the platform pose and the free joints: Newton with step control, row by row.

A step is a Householder reduction of each limb (its own joints) and one of each node. A row has
converged when a step below 1e-7 of the robot's size has been applied (the next one would be below
rounding) and the reducible part of its residual is at most 1e-13 of the size; it then stays as it
is. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np

from loopcal.engine.numpy_engine import closure
from loopcal.engine.numpy_engine.householder import back_substitute, count_reflections
from loopcal.engine.numpy_engine.nodes import (
    Front,
    factor_nodes,
    gather_unknowns,
    list_pairs,
    solve_nodes,
)
from loopcal.engine.program import (
    CONVERGED,
    EXHAUSTED,
    NEAR_GOAL,
    NOT_FINITE,
    PLATFORM,
    STALLED,
    Group,
    Program,
    State,
    Sums,
    Task,
)
from loopcal.typing import BoolArray, FloatArray

# --- Solve closure limb by limb where the platform is given, in closed form.

OPEN = 1e-9  # residual of a closed row, relative to the robot's size


def have_closed_form(program: Program) -> bool:
    """Return whether every limb ends in a distance and its rod or a prismatic joint is unknown."""
    unknown = [g.unknown_joints(free=True) for g in program.groups]
    return not program.others and all(
        g.ending == "distance" and len(j) == 1 and g.joints[j[0] : j[0] + 1] in ("", "P")
        for g, j in zip(program.groups, unknown, strict=True)
    )


def close_limbs(program: Program, e: FloatArray, q: FloatArray, start: State) -> State:
    """Return the state (t, n) with the platform of the start.

    A prismatic joint stays on the side of the start's value where the distance increases, or
    decreases.
    """
    t, n = max(len(e), len(q), len(start.T)), max(q.shape[1], start.T.shape[1])
    T = np.broadcast_to(start.T, (t, n, 4, 4)).reshape(-1, 4, 4)
    square, sign = np.zeros(t * n), np.ones(t * n)
    joints = []
    with np.errstate(all="ignore"):
        for group, values in zip(program.groups, start.joints, strict=True):
            links, shape = closure.place_links(group, e), (t, n, *values.shape[2:])
            filled = group.insert_driven(np.broadcast_to(values, shape), q)
            flat = filled.reshape(t * n, *shape[2:])  # a copy where the start is broadcast
            for part in closure.divide_rows(t * n):
                platform = T[part, :3].transpose(1, 2, 0).copy()
                theta = flat[part].transpose(2, 1, 0).copy()
                placed = links.select(np.arange(t * n)[part] // n)
                residual, signs = _close_group(group, placed, platform, theta, program.size)
                flat[part] = theta.transpose(2, 1, 0)
                square[part] += np.add.reduce(residual**2, axis=0)
                sign[part] *= np.multiply.reduce(signs, axis=0)
            joints.append(flat.reshape(shape))
        norm = np.sqrt(square)
        status = np.where(norm <= OPEN * program.size, CONVERGED, STALLED)
        status[~np.isfinite(norm)] = NOT_FINITE
    return State(
        T.reshape(t, n, 4, 4),
        tuple(joints),
        status.astype(np.int8).reshape(t, n),
        norm.reshape(t, n),
        np.zeros((t, n), np.int64),
        np.nan_to_num(sign).astype(np.int8).reshape(t, n),
    )


def _close_group(
    group: Group, links: closure.PlacedLinks, T: FloatArray, theta: FloatArray, size: float
) -> tuple[FloatArray, FloatArray]:
    """Set the unknown joint in theta (J + 1, k, N); return residuals and signs of slopes (k, N).

    A step d along a prismatic axis a changes the gap g to g - a d. From |g - a d| = reach follows
    a'g - d = +- sqrt((a'g)^2 - |g|^2 + reach^2), whose sign is that of a'g.
    """
    (j,) = group.unknown_joints(free=True)
    chain = closure.Chain(group, links, T[None], theta, size)
    if j == len(group.joints):
        theta[j] = chain.distance - links.length
        return chain.distance - (links.length + theta[j]), np.full(theta[j].shape, -1.0)
    axis, gap, reach = chain.axes[j], chain.gap, links.length + theta[-1]
    along = closure.dot(axis, gap)
    square = along**2 - closure.dot(gap, gap) + reach**2
    left = np.copysign(np.sqrt(np.maximum(square, 0.0)), along)
    theta[j] += along - left
    gap = gap - (along - left) * axis
    return np.sqrt(closure.dot(gap, gap)) - reach, -np.sign(left)


RESIDUAL, STEP = 1e-13, 1e-7
"""Residual and last step of a converged row, relative to the robot's size."""
NEAR, NEARER = 1e-2, 0.1
"""Distance from a goal, relative to the robot's size and to the step towards it, below which
Newton's method ends there. A step that ends so much closer than it was long converges
quadratically. Other solutions of the same readings are at least ten times as far from each other,
except close to a singularity.
"""
# Smallest pivot of a limb's joints, relative to its largest, below which a limb is singular.
SINGULAR = 1e-11


class Iterate(NamedTuple):
    """A Newton iterate of N rows.

    coordinates : (12 a node + joint values, N) rotation and position (3, 4) of each node, then all
        joints. step : (6 a node + unknown joints, N) Newton step: twists, then unknown joints.
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
        return Iterate(*(a.take(keep, axis=-1) for a in self))

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
    sums: Sums | None = None,
) -> State:
    """Find the pose and the joints that close every loop; see `loopcal.engine.solve`."""
    if not program.freedoms and free and have_closed_form(program):
        return close_limbs(program, e, q, start)
    t, n = max(len(e), len(q), len(start.T)), max(q.shape[1], start.T.shape[1])
    if sums is not None:
        t, n = max(t, *map(len, sums)), max(n, sums.values.shape[1])
        whole = np.broadcast_to(sums.values, (t, n, sums.values.shape[2]))
        sums = Sums(sums.weights, whole.reshape(t * n, -1))
    links = [closure.place_links(g, e) for g in program.groups]
    unknown = [g.unknown_joints(free) for g in program.groups]
    redundant = program.sigma is not None and not free
    begin = closure.list_coordinates(program, q, start, (t, n))
    is_plain = task is None and sums is None and not (free or redundant)
    has_rods = is_plain and not any(g.joints for g in program.groups)
    together = has_rods and len(e) == 1 and start.T.shape[:2] == (1, 1)
    goals = None if goal is None else goal.T.reshape(t * n, 4, 4)[:, :3].transpose(1, 2, 0)
    chunks = []
    for part in closure.divide_rows(t * n) or [slice(0)]:
        rows = np.arange(t * n)[part]
        placed = [p.select(rows // n) for p in links]
        own = None
        if sums is not None:
            weights = sums.weights[rows // n if len(sums.weights) > 1 else [0]]
            own = Sums(weights, sums.values[part])
        equations = _Equations(program, unknown, redundant, placed, task, rows, own)
        goal_rows = None if goals is None else goals[..., part]
        chunks.append(_iterate(equations, begin[:, part], max_iterations, goal_rows, together))
    whole = Solved(*(np.concatenate(arrays, axis=-1) for arrays in zip(*chunks, strict=True)))
    return _pack(program, whole, (t, n))


def follow_by(
    solve: Callable[..., State],
    program: Program,
    e: FloatArray,
    q: FloatArray,
    start: State,
    ends: bool = False,
    max_iterations: int = 60,
    sums: Sums | None = None,
) -> State:
    """Solve the poses of each trial one after the other; see `loopcal.engine.follow`."""
    given, states = sums, list[State]()
    for i in range(q.shape[1] if sums is None else sums.values.shape[1]):
        before, own = states[-1] if states else start, q[:, i : i + 1]
        if sums is not None:
            given = sums._replace(values=sums.values[:, i : i + 1])
            own = program.list_drives(before.joints)
        new = solve(program, e, own, before, None, False, max_iterations, None, given)
        if states and ends:
            status = np.where(before.status == CONVERGED, new.status, before.status)
            new = replace(new, status=status)
        states.append(new)

    return states[0].map(lambda *arrays: np.concatenate(arrays, axis=1), *states[1:])


def _iterate(
    equations: _Equations,
    coordinates: FloatArray,
    max_iterations: int,
    goal: FloatArray | None,
    together: bool,
) -> Solved:
    """Iterate rows until each has converged, is near its goal (3, 4, N), or failed.

    together : whether all rows begin with one Jacobian.
    """
    program, N = equations.program, coordinates.shape[1]
    size = program.size
    closed_gap, short_step = RESIDUAL * size, STEP * size
    may_stay_open = program.may_stay_open or program.sigma is not None
    status, steps = np.full(N, EXHAUSTED, np.int8), np.full(N, max_iterations)
    done = Solved(np.empty_like(coordinates), np.empty(N), np.empty(N), status, steps)
    # share of the full step, length of the last applied step, steps in a row at rounding level
    share, applied, at_rounding = np.ones(N), np.full(N, np.inf), np.zeros(N)
    alive = np.arange(N)
    with np.errstate(all="ignore"):
        now = equations.evaluate(coordinates, together)
        # some coordinates are in no equation
        now = now._replace(pivot=now.pivot * np.isfinite(np.add.reduce(coordinates[:12], axis=0)))
        for step in range(max_iterations):
            settled = (now.reducible <= closed_gap) & ((applied <= short_step) | (at_rounding > 2))
            is_sound = np.isfinite(now.reducible + now.length) & (now.pivot > SINGULAR)
            end = settled | ~is_sound | (share < 1e-5)
            is_near = False if goal is None else equations.lead_to(now, goal[..., alive]) & ~end
            end |= is_near
            if end.any():
                is_closed = settled & ((now.residual <= 1e4 * closed_gap) | may_stay_open)
                reason = np.where(is_sound, np.where(is_closed, CONVERGED, STALLED), NOT_FINITE)
                reason = np.where(is_near, NEAR_GOAL, reason)
                last = now if end.all() else now.select(np.flatnonzero(end))
                _store(done, alive[end], last, reason[end], step)
                if end.all():
                    return done
                keep = np.flatnonzero(~end)
                equations, now, alive = equations.select(keep), now.select(keep), alive[keep]
                share, applied, at_rounding = share[keep], applied[keep], at_rounding[keep]
            fraction = share * np.minimum(1.0, 0.5 * size / np.maximum(now.length, 1e-300))
            length, coordinates = fraction * now.length, equations.move(now, fraction)
            # where the loops are closed after such a step, the next one would be below rounding
            is_short = length <= short_step
            if is_short.any() and step + 1 < max_iterations:
                residual = equations.measure(coordinates, np.flatnonzero(is_short))
                end = residual <= closed_gap
                last = now._replace(coordinates=coordinates, residual=residual)
                _store(done, alive[end], last.select(np.flatnonzero(end)), CONVERGED, step + 1)
                if end.all():
                    return done
                keep = np.flatnonzero(~end)
                equations, now, alive = equations.select(keep), now.select(keep), alive[keep]
                share, applied, at_rounding = share[keep], applied[keep], at_rounding[keep]
                fraction, length = fraction[keep], length[keep]
                coordinates = coordinates.take(keep, axis=1)
            trial = equations.evaluate(coordinates)
            low = trial.reducible <= closed_gap
            better = low | (trial.residual <= (1 - 1e-4 * fraction) * now.residual)
            better |= trial.reducible <= 0.5 * now.reducible
            at_rounding = (at_rounding + 1) * low
            applied = np.where(better, length, applied)
            share = np.where(better, np.minimum(1.0, 4 * share), 0.25 * share)
            now = now.replace_where(better, trial)
        _store(done, alive, now, EXHAUSTED, max_iterations)
    return done


def _store(
    done: Solved, rows: np.ndarray, last: Iterate, status: np.ndarray | int, steps: int
) -> None:
    """Write the last iterates of these rows into a result under construction."""
    done.coordinates[:, rows] = last.coordinates
    done.residual[rows], done.sign[rows] = last.residual, last.sign
    done.status[rows], done.steps[rows] = status, steps


@dataclass(frozen=True, eq=False)
class _Equations:
    """The closure equations of N rows as a function of their coordinates.

    unknown : joints that closure determines, group by group. redundant : whether the residual is
        weighted by the standard deviations of redundant actuators. rows : (N,) numbers for `task`.
    sums : of each row, weights (1 | N, r, n_joints) and values (N, r).
    """

    program: Program
    unknown: list[list[int]]
    redundant: bool
    links: list[closure.PlacedLinks]
    task: Task | None
    rows: np.ndarray
    sums: Sums | None = None

    def select(self, keep: np.ndarray) -> _Equations:
        """Return the equations of these rows."""
        links, sums = [p.select(keep) for p in self.links], self.sums
        if sums is not None:
            weights = sums.weights if len(sums.weights) == 1 else sums.weights[keep]
            sums = Sums(weights, sums.values[keep])
        return replace(self, links=links, rows=self.rows[keep], sums=sums)

    def compare_sums(self, limbs: list[FloatArray]) -> FloatArray:
        """Return what the sums of driven joints lack or exceed (r, N), of all joint values."""
        assert self.sums is not None
        q = np.zeros((self.program.n_joints, len(self.rows)))
        for group, theta in zip(self.program.groups, limbs, strict=True):
            for j in group.driven_joints:
                q[group.actuator[j]] = theta[j]
        return closure.add_terms(self.sums.weights.T * q[:, None]) - self.sums.values.T

    def evaluate(self, coordinates: FloatArray, together: bool = False) -> Iterate:
        """Return the Newton step at these coordinates and its measures.

        together : all rows have the Jacobian of the first one.
        """
        program, N = self.program, coordinates.shape[1]
        bodies, limbs = (
            closure.split_bodies(program, coordinates),
            closure.split_joints(program, coordinates),
        )
        sides, bodies = (N, bodies[..., :1]) if together else (1, bodies)
        eliminated = [self._eliminate(i, bodies, theta) for i, theta in enumerate(limbs)]
        tops, lows, signs, pivots = map(list, zip(*eliminated, strict=True))
        fronts = [front for of_group in lows for front in of_group]
        if self.task is not None:
            residual, slopes = self.task(bodies[0].transpose(2, 0, 1), self.rows)
            demand = [slopes[..., list(program.freedoms)], residual[..., None]]
            rows = np.concatenate(demand, axis=2).transpose(1, 2, 0)
            fronts.append(Front((PLATFORM,), rows))
        if self.sums is not None:
            weights = self.sums.weights.transpose(1, 2, 0)
            gap = self.compare_sums(limbs)[:, None]
            rows = np.concatenate([np.broadcast_to(weights, (*weights.shape[:2], N)), gap], axis=1)
            fronts.append(Front((len(program.nodes),), rows))
        inner = np.zeros(N)
        for top in tops:
            if len(top):
                inner += closure.add_terms(closure.add_terms(top[:, -1] ** 2))
        right = np.concatenate([front.rows[:, -sides:] for front in fronts])
        norm = np.sqrt(inner + closure.add_terms(right**2).reshape(N))
        factored, sign = factor_nodes(program, fronts, sides, self.sums is not None)
        removable = np.concatenate([front.rows[:, -sides:] for front in factored])
        reducible = np.sqrt(inner + closure.add_terms(removable**2).reshape(N))
        y = {node: part.reshape(-1, N) for node, part in solve_nodes(program, factored, sides)}
        sign, pivot = reduce(np.multiply, signs) * sign, reduce(np.minimum, pivots)
        twist = np.zeros((6 * len(program.nodes), N))
        for node, freedoms in enumerate(program.nodes):
            twist[[6 * node + f for f in freedoms]] = y[node]
        turns = [top[:, -1] for top in tops]
        for i, (group, top) in enumerate(zip(program.groups, tops, strict=True)):
            if u := len(top):
                own = gather_unknowns(program, group, y)
                columns = top[:, u : u + len(own)].swapaxes(0, 1)
                rest = turns[i] + closure.add_terms(np.multiply(columns, own[:, None], order="C"))
                turns[i] = back_substitute(top[:, :u], -rest[:, None])[:, 0]
        driven = y.get(len(program.nodes), np.zeros((0, N)))
        step = np.concatenate([twist, *(turn.reshape(-1, N) for turn in turns), driven])
        length = np.abs(step * self.units).max(axis=0)
        return Iterate(coordinates, step, norm, reducible, length, sign, pivot)

    def measure(self, coordinates: FloatArray, of: np.ndarray) -> FloatArray:
        """Return the norm of the residual (N,) [m] of some rows; infinite elsewhere, and where
        redundant actuators weigh it.
        """
        program, out = self.program, np.full(coordinates.shape[1], np.inf)
        if self.redundant:
            return out
        equations, coordinates = self.select(of), coordinates.take(of, axis=1)
        bodies, square = closure.split_bodies(program, coordinates), np.zeros(len(of))
        values = closure.split_joints(program, coordinates)
        limbs = zip(program.groups, equations.links, values, strict=True)
        for group, links, theta in limbs:
            residual = closure.Chain(group, links, bodies, theta, program.size).residual()
            square += closure.add_terms(closure.add_terms(residual**2))
        if self.task is not None:
            residual, _ = self.task(bodies[0].transpose(2, 0, 1), equations.rows)
            square += np.add.reduce(residual**2, axis=1)
        if self.sums is not None:
            square += np.add.reduce(equations.compare_sums(values) ** 2, axis=0)
        out[of] = np.sqrt(square)
        return out

    def _eliminate(
        self, i: int, bodies: FloatArray, theta: FloatArray
    ) -> tuple[FloatArray, list[Front], FloatArray, FloatArray]:
        """Eliminate the joints of the limbs in group i.

        Returns the rows (u, columns, k, N) that determine these joints, the rows without them, and
        the sign of the determinant and the smallest relative pivot (N,). Rows with one Jacobian are
        one matrix with N right sides.
        """
        program, group, unknown = self.program, self.program.groups[i], self.unknown[i]
        chain, u = closure.Chain(group, self.links[i], bodies, theta, program.size), len(unknown)
        columns = chain.list_slopes(program)
        if self.sums is not None:
            columns += [self._list_drive(chain, column) for column in range(program.n_joints)]
        if self.redundant:
            j = int(np.flatnonzero(group.actuator[:, 0] >= 0)[0])
            sigma = np.array(program.sigma)[group.actuator[j], None]
            columns.append(chain.rows_of_joint(j) * sigma)
        residual, N = chain.residual(), theta.shape[-1]
        if residual.shape[-1] == chain.gap.shape[-1]:
            rows = chain.reduce(unknown, *columns, residual)
        else:
            right = residual.swapaxes(1, 2)[..., None]
            rows = np.concatenate([chain.reduce(unknown, *columns), right], axis=1)
        sign = pivot = np.ones(N)
        if u:
            count = count_reflections(len(rows), u) * len(group.limbs)
            diagonal = np.diagonal(rows[:u, :u])
            sign = (-1.0) ** count * np.prod(np.sign(diagonal), axis=(0, 2))
            largest = np.maximum(np.abs(diagonal).max(axis=-1), 1e-300)
            pivot = (np.abs(diagonal).min(axis=-1) / largest).min(axis=0)
        low = rows[u:, u:].transpose(2, 0, 1, 3)  # limb by limb
        joints = () if self.sums is None else (len(program.nodes),)
        fronts = [
            Front(nodes + joints, low[limbs].reshape(-1, *low.shape[2:]))
            for nodes, limbs in list_pairs(group)
        ]
        if self.redundant:
            # each row in standard deviations of the actuator that drives its limb
            fronts = [
                Front(nodes, np.delete(low / np.abs(low[:, -2, None]), -2, axis=1))
                for nodes, low in fronts
            ]
        return rows[:u], fronts, sign, pivot

    def _list_drive(self, chain: closure.Chain, column: int) -> FloatArray:
        """Return the rows of the driven joints of one column of q."""
        group, rows = chain.group, np.zeros((1, 1, 1))
        for j in group.driven_joints:
            share = group.actuator[j] == column
            rows = rows + chain.rows_of_joint(j) * share[:, None]
        return rows

    @cached_property
    def units(self) -> FloatArray:
        """Lengths (s, 1) [m] of a unit of each entry of a step: the robot's size for an angle."""
        program, driven = self.program, np.ones(self.program.n_joints)
        units = len(program.nodes) * np.repeat([program.size, 1.0], 3).tolist()
        for group, unknown in zip(program.groups, self.unknown, strict=True):
            of = [program.size if letter == "R" else 1.0 for letter in f"{group.joints}P"]
            units += [of[j] for j in unknown for _ in group.limbs]
            for j in group.driven_joints:
                driven[group.actuator[j]] = of[j]
        return np.array(units if self.sums is None else [*units, *driven])[:, None]

    def lead_to(self, now: Iterate, goal: FloatArray) -> BoolArray:
        """Return which full steps (N,) lead close to the platform of a goal (3, 4, N)."""
        size, T = self.program.size, now.coordinates[:12].reshape(3, 4, -1)
        rotation = closure.matmul(closure.exponential(now.step[:3]), T[:, :3]) - goal[:, :3]
        position = T[:, 3] + now.step[3:6] - goal[:, 3]
        turned = np.add.reduce(np.add.reduce(rotation**2, axis=0), axis=0)
        square = 0.5 * size**2 * turned + closure.dot(position, position)
        length = np.minimum(NEAR * size, NEARER * now.length)
        return (now.length <= 0.5 * size) & (square <= length**2)

    def move(self, now: Iterate, fraction: FloatArray) -> FloatArray:
        """Return the coordinates a fraction (N,) of its step beyond an iterate."""
        out, nodes = now.coordinates.copy(), len(self.program.nodes)
        twists = (fraction * now.step[: 6 * nodes]).reshape(nodes, 6, -1)
        old, bodies = (closure.split_bodies(self.program, a) for a in (now.coordinates, out))
        for twist, T, new in zip(twists, old, bodies, strict=True):
            new[:, :3] = closure.matmul(closure.exponential(twist[:3]), T[:, :3])
            new[:, 3] += twist[3:]
        first = 6 * nodes
        for theta, unknown in zip(
            closure.split_joints(self.program, out), self.unknown, strict=True
        ):
            last = first + len(unknown) * theta.shape[1]
            if unknown:
                theta[unknown] += fraction * now.step[first:last].reshape(-1, *theta.shape[1:])
            first = last
        driven = fraction * now.step[first:]
        limbs = closure.split_joints(self.program, out) if len(driven) else []
        for group, theta in zip(self.program.groups, limbs, strict=False):
            for j in group.driven_joints:
                theta[j] += driven[group.actuator[j]]
        return out


def _pack(program: Program, solved: Solved, shape: tuple[int, int]) -> State:
    """Return solved rows as a state with the axes (t, n)."""
    bodies = np.zeros((len(program.nodes), solved.coordinates.shape[1], 4, 4))
    bodies[:, :, :3] = closure.split_bodies(program, solved.coordinates).transpose(0, 3, 1, 2)
    bodies[..., 3, 3] = 1.0
    T, *others = bodies.reshape(-1, *shape, 4, 4)
    limbs = closure.split_joints(program, solved.coordinates)
    joints = tuple(a.transpose(2, 1, 0).reshape(*shape, *a.shape[1::-1]) for a in limbs)
    return State(
        T,
        joints,
        solved.status.reshape(shape),
        solved.residual.reshape(shape),
        solved.steps.reshape(shape),
        np.sign(np.nan_to_num(solved.sign)).astype(np.int8).reshape(shape),
        tuple(others),
    )
