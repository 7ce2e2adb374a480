# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the nodes in parameters and readings, by the closure rows of `linearize`.

Closure rows without passive joints read A y + E de + Q dq = 0, so that y = -A^-1 (E de + Q dq).
Shapes as in closure.py: rows (r, c, k, N) of a group. Formulas: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from loopcal.engine.numpy_engine.closure import Chain, list_bodies, place_links
from loopcal.engine.numpy_engine.householder import fold
from loopcal.engine.numpy_engine.nodes import Front, factor_nodes, list_pairs, solve_nodes
from loopcal.engine.program import Group, ParameterMap, Program, State, TwistRows
from loopcal.typing import BoolArray, FloatArray, IntArray

CHUNK = 1024  # rows differentiated together


def differentiate(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    state: State,
    inputs: ParameterMap,
    nodes: int = 1,
) -> tuple[FloatArray, FloatArray]:
    """Differentiate the first nodes; see `loopcal.engine.differentiate`."""
    t, n = state.T.shape[:2]
    p, a = inputs.pattern.parameters, program.n_joints
    bodies = list_bodies(state)
    limbs = [
        (place_links(g, e), g.insert_driven(values, q), _select_entries(g, inputs))
        for g, values in zip(program.groups, state.joints, strict=True)
    ]
    by_parameter, by_reading = (np.zeros((t * n, 6 * nodes, width)) for width in (p, a))
    freedoms = [6 * node + f for node, f in program.unknown_twists if node < nodes]
    m = len(freedoms)
    for first in range(0, t * n, CHUNK):
        part = slice(first, first + CHUNK)
        trial, pose = np.divmod(np.arange(t * n)[part], n)
        A, sigma, moving, driving = [], [], [], []
        with np.errstate(all="ignore"):
            for group, (links, values, entries) in zip(program.groups, limbs, strict=True):
                theta = values.reshape(t * n, len(group.limbs), -1)[part].transpose(2, 1, 0).copy()
                own = bodies[..., part].copy()
                chain = Chain(group, links.select(trial), own, theta, program.size)
                slopes, passive = chain.list_slopes(program), group.unknown_joints(False)
                moved = [*map(chain.rows_of_slot, group.slots)]
                moved += map(chain.rows_of_joint, group.driven_joints)
                rows = chain.reduce(passive, *slopes, *moved)[len(passive) :, len(passive) :]
                A.append(rows[:, : len(slopes)])
                columns = rows[:, len(slopes) :].transpose(3, 0, 1, 2)
                moving.append(entries.by_parameter(columns, p, trial, pose))
                readings = _pick(inputs.readings, trial, pose)
                driving.append(entries.by_reading(columns, readings, group))
                if program.sigma:
                    deviation = np.array(program.sigma)[group.actuator.max(axis=0)]
                    of_rows = np.abs(columns[:, :, len(group.slots)]) * deviation
                    sigma.append(of_rows.reshape(len(of_rows), -1).T)
            weights = 1.0 / np.concatenate(sigma) if sigma else None
            steps = np.ascontiguousarray(_invert(program, A, weights)[:m].transpose(2, 0, 1))
            for out, of_groups in ((by_parameter, moving), (by_reading, driving)):
                right = of_groups[0] if len(of_groups) == 1 else np.concatenate(of_groups, axis=1)
                if m == 6 * nodes:
                    np.matmul(steps, right, out=out[part])
                else:
                    out[part, freedoms] = np.matmul(steps, right)
    return by_parameter.reshape(t, n, 6 * nodes, p), by_reading.reshape(t, n, 6 * nodes, a)


class _Entries(NamedTuple):
    """Entries of a map that move the k limbs of a group, sorted by limb and parameter.

    limb, column, parameter : (z,); columns are the slots, then the driven joints. coefficient :
    (t | 1, z). basis : (t | 1, n | 1, z), one for displacements.
    """

    limb: IntArray
    column: IntArray
    parameter: IntArray
    coefficient: FloatArray
    basis: FloatArray

    def by_parameter(
        self, columns: FloatArray, p: int, trial: IntArray, pose: IntArray
    ) -> FloatArray:
        """Return the rows of all limbs by p parameters, (N, r k, p), of columns (N, r, c, k)."""
        N, r, c, k = columns.shape
        factor = _pick(self.basis, trial, pose) * _pick(self.coefficient, trial)
        values = columns.reshape(N, r, c * k)[..., self.column * k + self.limb] * factor[:, None]
        target = self.limb * p + self.parameter
        begin = np.flatnonzero(np.diff(target, prepend=-1))
        if len(begin) < len(target):  # several entries of one parameter in one limb
            values, target = np.add.reduceat(values, begin, axis=2), target[begin]
        out = np.zeros((N, r, k * p))
        out[..., target] = values
        return out.reshape(N, r * k, p)

    def by_reading(self, columns: FloatArray, readings: FloatArray, group: Group) -> FloatArray:
        """Return the rows by a readings, (N, r k, a), of columns (N, r, c, k)."""
        N, r, _, k = columns.shape
        out = np.zeros((N, r, k, readings.shape[-1]))
        for i, j in enumerate(group.driven_joints, len(group.slots)):
            actuator = group.actuator[j]
            slopes = columns[:, :, i] * readings[:, None, actuator]
            out[:, :, np.arange(k), actuator] += slopes
        return out.reshape(N, r * k, -1)


def _pick(array: FloatArray, *rows: IntArray) -> FloatArray:
    """Return the rows of an array whose leading axes may be 1 and then broadcast."""
    return array[
        tuple(i if length > 1 else 0 * i[:1] for i, length in zip(rows, array.shape, strict=False))
    ]


def _select_entries(group: Group, inputs: ParameterMap) -> _Entries:
    """Return the entries of a group."""
    pattern, slots = inputs.pattern, len(group.slots)
    place, parameter = pattern.displacements.T
    own = np.flatnonzero((place >= group.columns.start) & (place < group.columns.stop))
    limb, column = np.divmod(place[own] - group.columns.start, max(slots, 1))
    ones = np.ones((*inputs.basis.shape[:2], len(own)))
    entries = [(limb, column, parameter[own], inputs.displacements[:, own], ones)]
    joint, function, parameter = pattern.joints.T
    for i, j in enumerate(group.driven_joints, slots):
        limb, own = np.nonzero(group.actuator[j][:, None] == joint)
        basis = inputs.basis[:, :, joint[own], function[own]]
        column = np.full(len(own), i)
        entries.append((limb, column, parameter[own], inputs.joints[:, own], basis))
    arrays = [np.concatenate(of_all, axis=-1) for of_all in zip(*entries, strict=True)]
    order = np.lexsort((arrays[2], arrays[0]))
    return _Entries(*(array[..., order] for array in arrays))


def _invert(
    program: Program, closed: Sequence[FloatArray], weights: FloatArray | None
) -> FloatArray:
    """Return -A^-1 (M, c, N) of the closure rows A, of each group (r, m, k, N) and c together; with
    weights (c, N) the least-squares inverse. The freedoms of the platform come first.

    Singular matrices give infinities or NaN.
    """
    c = sum(a.shape[0] * a.shape[2] for a in closed)
    unit = np.eye(c)[..., None]
    if weights is not None:
        unit = unit * weights[:, None]
    fronts, first = [], 0
    for group, rows in zip(program.groups, closed, strict=True):
        r, m, k, N = rows.shape
        for nodes, limbs in list_pairs(group):
            own = first + (np.arange(r)[:, None] * k + np.arange(k)[limbs]).ravel()
            by_freedoms = rows[:, :, limbs].swapaxes(1, 2).reshape(len(own), m, N)
            if weights is not None:
                by_freedoms = by_freedoms * weights[own, None]
            sides = np.broadcast_to(unit[own], (len(own), c, N))
            fronts.append(Front(nodes, np.concatenate([by_freedoms, sides], axis=1)))
        first += r * k
    factored, _ = factor_nodes(program, fronts, c)
    solved = dict(solve_nodes(program, factored, c))
    return np.concatenate([solved[node] for node in range(len(program.nodes))])


# --- Rows of poses, [G D | r], folded for some trials at a time, so that they fit the cache.

PART = 2048  # poses whose rows are made together


def fold_poses(
    factor: FloatArray,
    program: Program,
    e: FloatArray,
    q: FloatArray,
    state: State,
    inputs: ParameterMap,
    observed: Sequence[TwistRows],
) -> tuple[FloatArray, BoolArray]:
    """Fold the rows of observed poses; see `loopcal.engine.fold_poses`."""
    t, n = len(factor), state.T.shape[1]
    if not observed:
        return factor, np.ones((t, n), dtype=bool)
    folded, is_finite = np.empty_like(factor), np.empty((t, n), dtype=bool)
    step = max(1, PART // max(n, 1))
    for first in range(0, t, step):
        part = slice(first, first + step)
        take = partial(_take, part)
        names = ("displacements", "joints", "basis", "readings")
        own = replace(inputs, **{name: take(getattr(inputs, name)) for name in names})
        D, _ = differentiate(program, take(e), take(q), state.map(take), own)
        ok = np.asarray(np.isfinite(D).all(axis=(2, 3)))
        D, is_finite[part] = np.where(ok[..., None, None], D, 0.0), ok
        rows = []
        for twists in observed:
            residual = np.where(ok[:, twists.poses, None], twists.residual[part], 0.0)
            whole = np.empty((*residual.shape, D.shape[-1] + 1))
            # one order of the products for any number of trials: each has its bits by itself
            np.matmul(take(twists.by_twist), D[:, twists.poses], out=whole[..., :-1])
            whole[..., -1] = residual
            rows.append(whole.reshape(len(whole), -1, D.shape[-1] + 1))
        folded[part] = fold(factor[part], np.concatenate(rows, axis=1))
    return folded, is_finite


def _take(part: slice, array: FloatArray) -> FloatArray:
    """Return some trials of an array (t | 1, ..)."""
    return array if len(array) == 1 else array[part]
