# SPDX-License-Identifier: Apache-2.0
"""Rows of poses, [G D | r], folded for some trials at a time, so that they fit the cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal.engine.numpy_engine.householder import fold
from loopcal.engine.numpy_engine.sensitivity import differentiate
from loopcal.engine.program import ParameterMap, Program, State, TwistRows
from loopcal.typing import BoolArray, FloatArray

PART = 2048
"""Poses whose rows are made together."""


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
            own = replace(state, T=state.T[part], joints=tuple(a[part] for a in state.joints))
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
