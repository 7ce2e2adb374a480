# SPDX-License-Identifier: Apache-2.0
"""Poses whose own unknowns must be found together, their rows side by side, and the elimination of
these unknowns.

Poses that a row links, directly or through others, are one component; a pose that no row links is
one of its own. The rows of a component are [B | F | A | r]: the free numbers u of its poses, the
measurements' own unknowns, the machine, the residual. With B = Q [R; 0] the rows Q' [F | A | r]
below R are free of u, and the best u is -R^-1 times those above: an orthogonal projection,
component by component. Components of equal form are worked on together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.elimination import OWN_RANK
from loopcal.estimate.sensed import Block, Sensed, block_of
from loopcal.numerics.decomposition import NULL_COMPONENT, without_rounding
from loopcal.typing import FloatArray, IntArray

LARGEST = 2000
"""Unknowns of one component, at most: its rows are one dense matrix."""

ROUNDING = 1e-14
"""Rows that projection leaves shorter than this share of the largest are rounding: no row is left
there.
"""


@dataclass(frozen=True, eq=False)
class Group:
    """Components of equal form within a block: C of them, of L poses each.

    Attributes
    ----------
    components : (C,) their numbers. poses : (C, L) places in the block. height : rows kept for
        each, those not used zero.
    form, nodes : (C,) of own unknowns that their rows use, -1 without any.
    rows : for each kind: rows (k,), the component of each (k,), its first place there (k,), and its
        poses' places (k, links).
    """

    components: IntArray
    poses: IntArray
    height: int
    form: int
    nodes: IntArray
    rows: tuple[tuple[IntArray, IntArray, IntArray, IntArray], ...]


class KindRows(NamedTuple):
    """Whitened rows of a kind: by u of each linked pose (a, r, links, m, k), own unknowns (a, r, m,
    w) or None, the machine (a, r, m, p), residual (a, r, m).
    """

    u: FloatArray
    own: FloatArray | None
    machine: FloatArray
    residual: FloatArray


def components_of(n: int, sensed: Sequence[Sensed], freedoms: int) -> IntArray:
    """Return the component (n,) of each pose, numbered by their first poses.

    Raises
    ------
    EstimationError
        One is larger than can be worked on.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = [np.zeros((0, 2), dtype=np.int64)]
    pairs += [
        np.column_stack([s.poses[:, :-1].ravel(), s.poses[:, 1:].ravel()])
        for s in sensed
        if s.poses.ndim > 1
    ]
    links = np.concatenate(pairs)
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
    member = connected_components(graph, directed=False)[1]
    _, first, member, sizes = np.unique(
        member, return_index=True, return_inverse=True, return_counts=True
    )
    if sizes.max() * freedoms > LARGEST:
        raise EstimationError(
            f"rows link {sizes.max()} poses with uncertain readings to one chain with "
            f"{sizes.max() * freedoms} unknowns;"
            f" at most {LARGEST} can be found together: link fewer poses, or state these readings "
            "as exact (sigma 0)"
        )
    return np.argsort(np.argsort(first))[member].astype(np.int64)


def component_blocks(
    readings: FloatArray,
    sensed: tuple[Sensed, ...],
    member: IntArray,
    needed: np.ndarray,
    size: int,
) -> list[Block]:
    """Divide poses into blocks of whole components, each of about this many poses."""
    counts = np.bincount(member)
    run = (np.cumsum(counts) - counts) // size
    of = run[member]
    made = []
    for k in np.unique(of):
        rows = tuple(np.flatnonzero(of[s.first] == k) for s in sensed)
        made.append(block_of(np.flatnonzero(of == k), readings, sensed, rows, needed))
    return made


def groups_of(
    block: Block, member: IntArray, nodes: IntArray, forms: IntArray
) -> tuple[Group, ...]:
    """Sort a block's components by poses, form of own unknowns and, roughly, number of rows.

    `nodes` and `forms` are those of all components, -1 where a component's rows use no own
    unknowns.
    """
    own = member[block.poses]
    numbers, local, lengths = np.unique(own, return_inverse=True, return_counts=True)
    heights, starts = np.zeros(len(numbers), dtype=np.int64), []
    for s in block.sensed:
        m, of = s.whitener.shape[-1], local[s.first]
        order = np.argsort(of, kind="stable")
        within = np.zeros(len(of), dtype=np.int64)
        within[order] = np.arange(len(of)) - np.searchsorted(of[order], of[order])
        starts.append(heights[of] + m * within)
        heights += m * np.bincount(of, minlength=len(numbers))
    place = np.zeros(len(block.poses), dtype=np.int64)
    order = np.argsort(local, kind="stable")
    place[order] = np.arange(len(order)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    form = np.column_stack([lengths, forms[numbers], np.ceil(np.log2(np.maximum(heights, 1)))])
    groups = []
    for key in np.unique(form, axis=0):
        chosen = np.flatnonzero((form == key).all(axis=1))
        number = np.full(len(numbers), -1)
        number[chosen] = np.arange(len(chosen))
        parts = []
        for s, start in zip(block.sensed, starts, strict=True):
            rows = np.flatnonzero(number[local[s.first]] >= 0)
            parts.append((rows, number[local[s.first[rows]]], start[rows], place[s.per_pose[rows]]))
        poses = np.flatnonzero(number[local] >= 0)
        ranked = np.empty((len(chosen), int(key[0])), dtype=np.int64)
        ranked[number[local[poses]], place[poses]] = poses
        used = nodes[numbers[chosen]]
        groups.append(
            Group(
                numbers[chosen], ranked, int(heights[chosen].max()), int(key[1]), used, tuple(parts)
            )
        )
    return tuple(groups)


def side_by_side(
    group: Group, kinds: Sequence[KindRows | None], k: int, width: int, p: int
) -> FloatArray:
    """Rows (a, C, height, L k + width + p + 1) of a group, [u | own | machine | residual]; kinds
    without rows are None.
    """
    a = next(len(kind.residual) for kind in kinds if kind is not None)
    free = group.poses.shape[1] * k
    out = np.zeros((a, len(group.components), max(group.height, free), free + width + p + 1))
    for kind, (rows, of, start, links) in zip(kinds, group.rows, strict=True):
        if kind is None or not len(rows):
            continue
        at = (slice(None), of[:, None], start[:, None] + np.arange(kind.residual.shape[-1]))
        out[(*at, -1)] = kind.residual[:, rows]
        if p:
            out[(*at, slice(free + width, -1))] = kind.machine[:, rows]
        if width and kind.own is not None:
            out[(*at, slice(free, free + width))] = kind.own[:, rows]
        for i in range(links.shape[1]):
            columns = links[:, i, None] * k + np.arange(k)
            out[:, of[:, None, None], at[2][:, :, None], columns[:, None, :]] = kind.u[:, rows, i]
    return out


class Projected(NamedTuple):
    """Rows without u.

    Attributes
    ----------
    rest : (a, C, N, w) rows left. best : (a, C, K, w): the best u is -best times (own, machine, 1).
    rank : (a, C) directions of u that rows see. open : (a, C, K) which have a part in one that no
        row sees.
    gain : (a, C) by how much the best u lowers the sum of squares.
    """

    rest: FloatArray
    best: FloatArray
    rank: IntArray
    open: np.ndarray
    gain: FloatArray


def project(rows: FloatArray, free: int) -> Projected:
    """Eliminate the first `free` columns of rows (a, C, N, free + w), N >= free, directions that no
    row sees left out.

    Columns are brought to length one; a singular value below OWN_RANK of the largest is none. A
    column that these take up whole leaves zeros, not its rounding. What is left of rows that are
    not finite is NaN.
    """
    if free == 0:
        empty = np.zeros((*rows.shape[:2], 0, rows.shape[-1]))
        none = np.zeros(rows.shape[:2])
        return Projected(
            rows, empty, none.astype(np.int64), np.zeros((*rows.shape[:2], 0), dtype=bool), none
        )
    # absent rows go last: no reflection touches them there, and what is left of the others stays
    # apart from them
    order = np.argsort(~rows.any(axis=-1), axis=-1, kind="stable")
    rows = np.take_along_axis(rows, order[..., None], axis=-2)
    bad = np.asarray(~np.isfinite(rows).all(axis=(-1, -2)))
    if bad.any():
        rows = np.where(bad[..., None, None], 0.0, rows)
    norm = np.linalg.norm(rows[..., :free], axis=-2)
    norm = np.where(norm > 0.0, norm, 1.0)
    q, r = np.linalg.qr(rows[..., :free] / norm[..., None, :], mode="complete")
    right = np.matmul(q.swapaxes(-1, -2), rows[..., free:])
    left, s, vt = np.linalg.svd(r[..., :free, :])
    used = s > OWN_RANK * np.maximum(s[..., :1], np.finfo(np.float64).tiny)
    top = np.matmul(left.swapaxes(-1, -2), right[..., :free, :])
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=used)
    best = np.matmul(vt.swapaxes(-1, -2) * inverse[..., None, :], top) / norm[..., None]
    rest = np.concatenate([np.where(used[..., None], 0.0, top), right[..., free:, :]], axis=-2)
    length = np.linalg.norm(rows[..., None, free:-1], axis=-3)
    rest[..., :-1] = without_rounding(rest[..., :-1], length)
    size = np.abs(right).max(axis=(-1, -2), keepdims=True, initial=0.0)
    rest = np.where(
        np.abs(rest).max(axis=-1, keepdims=True, initial=0.0) > ROUNDING * size, rest, 0.0
    )
    if bad.any():
        rest[bad] = np.nan
    unseen = np.sqrt(np.where(used[..., None], 0.0, vt**2).sum(axis=-2)) > NULL_COMPONENT
    gain = np.where(used, top[..., -1] ** 2, 0.0).sum(axis=-1)
    return Projected(rest, best, used.sum(axis=-1), unseen, gain)
