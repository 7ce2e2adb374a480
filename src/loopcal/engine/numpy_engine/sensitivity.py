# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the nodes in parameters and readings, by the wrenches of the closure rows.

A closure row without passive joints is a wrench on the limb's tip, a moment and a force that the
passive joints do not feel. Its product with the velocity that a displacement or a joint causes is
the entry of that column: every link takes the wrench to its own axes once, for all its
displacements. Shapes as in closure.py, with the r rows of a limb behind the components: (3, r, k,
N). Formulas: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.engine.numpy_engine.closure import Chain, cross, dot, list_bodies, place_links
from loopcal.engine.numpy_engine.householder import fold, triangularize
from loopcal.engine.numpy_engine.nodes import Front, factor_nodes, list_pairs, solve_nodes
from loopcal.engine.program import (
    BASE,
    LENGTH,
    PITCH,
    Group,
    ParameterMap,
    Program,
    State,
    TwistRows,
)
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
                closed = _close(program, chain, entries.driven)
                A.append(closed.freedoms)
                columns = closed.columns.transpose(3, 0, 1, 2)
                moving.append(entries.by_parameter(columns, p, trial, pose))
                readings = _pick(inputs.readings, trial, pose)
                driving.append(entries.by_reading(columns, readings, group))
                sigma.append(_deviations(program, group, closed))
            weights = 1.0 / np.concatenate(sigma) if program.sigma else None
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
    (t | 1, z). basis : (t | 1, n | 1, z), one for displacements. driven : the driven joints.
    """

    limb: IntArray
    column: IntArray
    parameter: IntArray
    coefficient: FloatArray
    basis: FloatArray
    driven: tuple[int, ...]

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
        for i, j in enumerate(self.driven):
            actuator = group.actuator[j]
            slopes = columns[:, :, len(group.slots) + i] * readings[:, None, actuator]
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
    driven = tuple(np.flatnonzero(group.actuator[:, 0] >= 0).tolist())
    joint, function, parameter = pattern.joints.T
    for i, j in enumerate(driven):
        limb, own = np.nonzero(group.actuator[j][:, None] == joint)
        basis = inputs.basis[:, :, joint[own], function[own]]
        column = np.full(len(own), slots + i)
        entries.append((limb, column, parameter[own], inputs.joints[:, own], basis))
    arrays = [np.concatenate(of_all, axis=-1) for of_all in zip(*entries, strict=True)]
    order = np.lexsort((arrays[2], arrays[0]))
    return _Entries(*(array[..., order] for array in arrays), driven=driven)


class _ClosedRows(NamedTuple):
    """Closure rows of a group: r of each limb, against the freedoms of the bodies at which it
    begins, then ends (r, m, k, N), and against its slots and driven joints (r, c, k, N).
    """

    freedoms: FloatArray
    columns: FloatArray


def _close(program: Program, chain: Chain, driven: tuple[int, ...]) -> _ClosedRows:
    """Return the rows of a group that no passive joint changes."""
    group = chain.group
    shares = _eliminate(chain)
    moment, force = _list_wrenches(chain, shares)
    freedoms = []
    if group.on[0] != BASE:
        assert chain.carrier is not None
        arm = (chain.tip - chain.carrier[:, 3])[:, None]
        wrench = -np.concatenate([moment + cross(arm, force), force])
        freedoms.append(wrench[list(program.nodes[group.on[0]])])
    if group.to[0] != BASE:
        at_center = moment + cross(chain.arm[:, None], force)
        wrench = np.concatenate([at_center, force])
        freedoms.append(wrench[list(program.nodes[group.to[0]])])
    r, k, N = moment.shape[1:]
    columns = np.zeros((r, len(group.slots) + len(driven), k, N))
    # the tip moves with its links, hence the minus signs
    bending = {
        j: moment + cross((chain.tip - chain.origins[j])[:, None], force)
        for j in {s.element for s in group.slots if s.axis < 3 and s.element != chain.last}
        | {j for j in driven if group.joints[j : j + 1] == "R"}
    }
    local: dict[tuple[int, bool], FloatArray] = {}
    for c, (j, axis) in enumerate((s.element, s.axis) for s in group.slots):
        if axis == LENGTH:
            columns[:, c] = -shares[:, 0]
        elif axis == PITCH:
            columns[:, c] = -chain.theta[j] * dot(chain.axes[j][:, None], force)
        else:
            turns, tip = axis < 3, j != chain.last
            if (j, turns) not in local:
                wrench = (bending[j] if tip else moment) if turns else force
                local[j, turns] = _take_to_link(chain, j, -wrench if tip else wrench)
            frame = chain.links.slope[j] if turns else chain.links.nominal[j]
            columns[:, c] = dot(frame[:, axis % 3, None], local[j, turns])
    for c, j in enumerate(driven, len(group.slots)):
        if j == len(group.joints):
            columns[:, c] = -shares[:, 0] if group.ending == "distance" else 0.0
            continue
        along = -dot(chain.axes[j][:, None], force)
        columns[:, c] = along
        if group.joints[j] == "R":
            about = -dot(chain.axes[j][:, None], bending[j])
            columns[:, c] = about + chain.links.pitch[j] * along
    both = freedoms[0] if len(freedoms) == 1 else np.concatenate(freedoms)
    return _ClosedRows(both.swapaxes(0, 1), columns)


def _eliminate(chain: Chain) -> FloatArray:
    """Return how much of each row of the ending the r closure rows take, (r, rows, k, N)."""
    unknown, rows = chain.group.unknown_joints(False), len(chain.group.rows)
    identity = np.eye(rows)[..., None, None]
    if not unknown:
        return np.broadcast_to(identity, (rows, rows, *chain.gap.shape[1:]))
    columns = chain.stack(*(chain.rows_of_joint(j) for j in unknown), *identity.swapaxes(0, 1))
    return triangularize(columns, len(unknown))[len(unknown) :, len(unknown) :]


def _list_wrenches(chain: Chain, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return moment [m] and force of each closure row at the tip, (3, r, k, N)."""
    group = chain.group
    wrench = np.zeros((6, len(shares), *shares.shape[2:]))
    if group.ending == "distance":
        wrench[3:] = shares[:, 0] * chain.direction[:, None]
    elif group.ending == "ball":
        wrench[[3 + row for row in group.rows]] = shares.swapaxes(0, 1)
    else:
        wrench[list(group.rows)] = shares.swapaxes(0, 1)
        wrench[:3] *= chain.size
    return wrench[:3], wrench[3:]


def _take_to_link(chain: Chain, j: int, vectors: FloatArray) -> FloatArray:
    """Return vectors (3, r, k, N) in the axes before link j."""
    axes = chain.before[j]
    if axes is None:
        return vectors
    return np.stack([dot(axes[:, i, None], vectors) for i in range(3)])


def _deviations(program: Program, group: Group, closed: _ClosedRows) -> FloatArray:
    """Return the standard deviation (r k, N) that a redundant actuator gives each row."""
    if program.sigma is None:
        return np.ones(())[None]
    drive = closed.columns[:, len(group.slots)]
    j = int(np.flatnonzero(group.actuator[:, 0] >= 0)[0])
    sigma = np.array(program.sigma)[group.actuator[j]]
    return (np.abs(drive) * sigma[:, None]).reshape(-1, drive.shape[-1])


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
    shared = _differentiate(program, e, q, state, inputs) if len(state.T) < t else None
    for first in range(0, t, step):
        part = slice(first, min(first + step, t))
        if shared is None:
            joints, others = (tuple(a[part] for a in of) for of in (state.joints, state.others))
            own = replace(state, T=state.T[part], joints=joints, others=others)
            arrays = _take(e, part), _take(q, part), own, _take_inputs(inputs, part)
            D, ok = _differentiate(program, *arrays)
        else:
            D, ok = shared
        is_finite[part] = ok
        rows = [_make_rows(twists, D, ok, part) for twists in observed]
        whole = rows[0] if len(rows) == 1 else np.concatenate(rows, axis=1)
        folded[part] = fold(factor[part], whole)
    return folded, is_finite


def _differentiate(
    program: Program, e: FloatArray, q: FloatArray, state: State, inputs: ParameterMap
) -> tuple[FloatArray, BoolArray]:
    """Return D (a, n, 6, p), zero where it is not finite, and where it is (a, n)."""
    D, _ = differentiate(program, e, q, state, inputs)
    if np.isfinite(D.sum()):
        return D, np.ones(D.shape[:2], dtype=bool)
    ok = np.asarray(np.isfinite(D).all(axis=(2, 3)))
    return np.where(ok[..., None, None], D, 0.0), ok


def _make_rows(twists: TwistRows, D: FloatArray, ok: BoolArray, part: slice) -> FloatArray:
    """Return the rows (a, r m, p + 1) of some trials."""
    poses, residual = twists.poses, twists.residual[part]
    if not np.array_equal(poses, np.arange(D.shape[1])):
        D, ok = D[:, poses], ok[:, poses]
    rows = np.empty((*residual.shape, D.shape[-1] + 1))
    # one order of the products for any number of trials: each has its bits by itself
    np.matmul(_take(twists.by_twist, part), D, out=rows[..., :-1])
    rows[..., -1] = residual if ok.all() else np.where(ok[..., None], residual, 0.0)
    return rows.reshape(len(rows), -1, rows.shape[-1])


def _take(array: FloatArray, part: slice) -> FloatArray:
    """Return some trials of an array (t | 1, ..)."""
    return array if len(array) == 1 else array[part]


def _take_inputs(inputs: ParameterMap, part: slice) -> ParameterMap:
    """Return the map of some trials."""
    names = ("displacements", "joints", "basis", "readings")
    return replace(inputs, **{name: _take(getattr(inputs, name), part) for name in names})
