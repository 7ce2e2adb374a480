# SPDX-License-Identifier: Apache-2.0
"""Rows of poses as the library reads them, all kinds of rows pose by pose, and rows of blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from loopcal.engine import BlockRows, Structure, TwistRows
from loopcal.typing import FloatArray, IntArray
from loopcal_native.library import BlockRows as RowsOfLibrary
from loopcal_native.library import BlockStructure, Strided, allocate, as_reals, locate
from loopcal_native.library import TwistRows as StridedRows
from loopcal_native.programs import require


class FlatRows(NamedTuple):
    """M rows: pose (M,) of each, ascending; by_twist (t | 1, M, 6), residual (t | 1, M)."""

    pose: IntArray
    by_twist: FloatArray
    residual: FloatArray

    def describe(self) -> StridedRows:
        """Return the addresses and strides of these arrays, which must be kept."""
        count, strided = len(self.pose), []
        for array, size in ((self.by_twist, 6 * count), (self.residual, count)):
            strided.append(Strided(locate(array), size if len(array) > 1 else 0, 0))
        return StridedRows(count, locate(self.pose), *strided)


def flatten_rows(observed: Sequence[TwistRows], t: int, n: int) -> FlatRows:
    """Return the rows of all kinds, those of one pose behind each other.

    Raises
    ------
    ValueError : shapes differ from those of `TwistRows`, or a pose is not one of n.
    """
    poses, twists, residuals = [], [], []
    for rows in observed:
        r, m = rows.residual.shape[1:]
        require(len(rows.residual) in (1, t), f"residuals of {t} trials")
        expected = rows.by_twist.shape in ((1, r, m, 6), (t, r, m, 6))
        require(expected, f"derivatives ({t} | 1, {r}, {m}, 6), not {rows.by_twist.shape}")
        index = np.asarray(rows.poses, np.int64)
        require(index.shape == (r,), f"poses ({r},), not {index.shape}")
        require(bool(((index >= 0) & (index < n)).all()), f"poses of {n}")
        poses.append(np.repeat(index, m))
        twists.append(rows.by_twist.reshape(len(rows.by_twist), r * m, 6))
        residuals.append(rows.residual.reshape(len(rows.residual), r * m))
    if not observed:
        return FlatRows(np.zeros(0, np.int64), np.zeros((1, 0, 6)), np.zeros((1, 0)))
    pose, by_twist, residual = poses[0], twists[0], residuals[0]
    if len(observed) > 1:
        pose = np.concatenate(poses)
        by_twist, residual = (_join(arrays, t) for arrays in (twists, residuals))
    if (pose[1:] < pose[:-1]).any():
        order = np.argsort(pose, kind="stable")
        pose, by_twist, residual = pose[order], by_twist[:, order], residual[:, order]
    return FlatRows(pose, as_reals(by_twist), as_reals(residual))


def _join(arrays: Sequence[FloatArray], t: int) -> FloatArray:
    """Return the rows (t, M, ..) of all kinds behind each other."""
    return np.concatenate([np.broadcast_to(a, (t, *a.shape[1:])) for a in arrays], axis=1)


class FlatBlocks(NamedTuple):
    """Structures and rows of blocks as the library reads them; `kept` are their arrays, and
    `solutions` as of `EliminatedBlocks`.
    """

    structures: Any
    rows: Any
    solutions: list[tuple[FloatArray, FloatArray]]
    kept: list[np.ndarray]


def describe_blocks(
    structures: Sequence[Structure], rows: Sequence[BlockRows], shape: tuple[int, int, int]
) -> FlatBlocks:
    """Return blocks of t trials, U unknowns and q columns of the machine and the residual.

    Raises
    ------
    ValueError : shapes differ, or something points beyond the unknowns, blocks and structures.
    """
    (t, U, q), listed, parts, kept = shape, [], [], list[np.ndarray]()
    sizes = [(len(s), s.unknowns.shape[1], s.width) for s in structures]
    solved = [((t, n, u, u), (t, n, u, w - u + q)) for n, u, w in sizes]
    arrays = allocate(*((each, float) for pair in solved for each in pair))
    solutions = list(zip(arrays[::2], arrays[1::2], strict=True))
    for i, (s, (n, u, w)) in enumerate(zip(structures, sizes, strict=True)):
        path, place = (np.ascontiguousarray(a, np.int64) for a in (s.path, s.parent_place))
        require(path.shape == (n, w) and w >= u and _is_within(path, U), f"paths of {U} unknowns")
        parents = sizes[s.parent] if 0 <= s.parent < i else (1, 0, 0)
        is_right = s.parent < i and place.shape == (n,) and w == u + parents[2]
        is_right = is_right and (s.parent < 0 or _is_within(place, parents[0]))
        require(is_right, "a parent of each block before it")
        addresses = (locate(a) for a in (path, place, *solutions[i]))
        listed.append(BlockStructure(n, u, w, max(s.parent, -1), *addresses))
        kept += [path, place]
    for part in rows:
        require(0 <= part.structure < len(sizes), f"{len(sizes)} structures")
        n, _, w = sizes[part.structure]
        place, columns = (np.ascontiguousarray(a, np.int64) for a in part[1:3])
        require(part.machine.ndim == 4 and columns.ndim == 2, "rows (t, k, m, p + 1)")
        (_, k, m, _), c = part.machine.shape, columns.shape[1]
        is_right = part.machine.shape == (t, k, m, q)
        require(is_right, f"rows ({t}, k, m, {q}), not {part.machine.shape}")
        require(place.shape == (k,) and _is_within(place, n), f"places ({k},) of {n} blocks")
        is_right = columns.shape == (k, c) and part.by_unknowns.shape == (t, k, m, c)
        require(is_right and _is_within(columns, w + 1), f"columns ({k}, c) of {w}")
        rows_of = [_join_sets(a) for a in (part.by_unknowns, part.machine)]
        strided = (Strided(a.ctypes.data, *(step // 8 for step in a.strides[:2])) for a in rows_of)
        parts.append(
            RowsOfLibrary(part.structure, k, m, c, locate(place), locate(columns), *strided)
        )
        kept += [place, columns, *rows_of]
    structures_of_library = (BlockStructure * len(listed))(*listed)
    return FlatBlocks(structures_of_library, (RowsOfLibrary * len(parts))(*parts), solutions, kept)


def _join_sets(rows: FloatArray) -> FloatArray:
    """Return rows (t, k m, c) of k sets of m, each without gaps; a copy only where they have some.

    NumPy finds the step between rows: along an axis of length one, that of `rows` is arbitrary.
    """
    t, k, m, c = rows.shape
    joined = rows.reshape(t, k * m, c)
    return joined if joined.strides[2] == 8 and joined.dtype == np.float64 else as_reals(joined)


def _is_within(numbers: IntArray, count: int) -> bool:
    """Return whether all numbers are from 0 to below a count."""
    return not numbers.size or (int(numbers.min()) >= 0 and int(numbers.max()) < count)
