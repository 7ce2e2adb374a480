# SPDX-License-Identifier: Apache-2.0
"""Matrices of many rows, most of whose columns have values in few of them.

Rows of a measurement move the setup of their own session and target, and the machine. Its columns
are dense, the others sparse: work and memory grow with the rows, not with rows times setup.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.numerics.elimination import find_connected_groups
from loopcal.numerics.statistics import find_distinct, find_distinct_rows
from loopcal.typing import FloatArray, IntArray

EXPLAINED = 1e-6  # share of its length below which a column counts as explained by other columns


@dataclass(frozen=True, eq=False)
class SplitColumns:
    """A matrix (R, s + d): s columns with values in few rows, then d with values in all.

    narrow : sparse (R, s), or an array without columns: scipy.sparse is imported where it is
        needed, which takes 0.1 s. wide : (R, d).
    """

    narrow: Any
    wide: FloatArray

    @classmethod
    def of(cls, wide: FloatArray) -> SplitColumns:
        """Return columns (R, d) that have values in all rows."""
        return cls(wide[:, :0], wide)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return len(self.wide), self.narrow.shape[1] + self.wide.shape[1]

    def take(self, rows: IntArray) -> SplitColumns:
        """Return some rows (r,)."""
        return SplitColumns(self.narrow[rows], self.wide[rows])

    def localize(self, rows: IntArray) -> tuple[IntArray, FloatArray]:
        """Return the columns (c,) that some rows (r,) have, and their values (r, c)."""
        part, s, used = self.narrow[rows], self.narrow.shape[1], np.zeros(0, dtype=np.int64)
        if s:
            used = find_distinct(part.indices).astype(np.int64)
            part = part[:, used].toarray()
        columns = np.concatenate([used, s + np.arange(self.wide.shape[1])])
        return columns, np.concatenate([part, self.wide[rows]], axis=1)

    def append(self, columns: FloatArray) -> SplitColumns:
        """Return the matrix with further columns (R, c) at its end."""
        return replace(self, wide=np.concatenate([self.wide, columns], axis=1))

    def times(self, x: FloatArray) -> FloatArray:
        """Return the matrix times x (s + d, ..)."""
        s = self.narrow.shape[1]
        return np.asarray(self.wide @ x[s:] + (self.narrow @ x[:s] if s else 0.0))

    def products(self, x: FloatArray) -> FloatArray:
        """Return the products (s + d, ..) of the columns with x (R, ..)."""
        of_wide = self.wide.T @ x
        if not self.narrow.shape[1]:
            return of_wide
        return np.concatenate([self.narrow.T @ x, of_wide])

    def remove(self, x: FloatArray) -> FloatArray:
        """Return x (R, ..) without its part in the span of the columns, which are orthonormal."""
        return x - self.times(self.products(x))

    def squares(self) -> FloatArray:
        """Return the sum of squares (R,) of each row."""
        return np.asarray((self.wide**2).sum(axis=1) + (self.narrow**2).sum(axis=1))

    def trace_neighbors(self, pairs: IntArray) -> tuple[float, float, float]:
        """Return tr U'LU, tr (LU)'LU and tr (U'LU)^2 of the matrix U; L is symmetric, with 1/2 for
        each pair of a row (n,), ascending, and the next one.
        """
        first, second = self.take(pairs), self.take(pairs + 1)
        between = pairs[1:][np.diff(pairs) == 1]  # rows with two neighbors
        squares = 0.25 * float((first.squares() + second.squares()).sum())
        squares += 0.5 * self.take(between - 1).inner(self.take(between + 1))
        parts = [(first.narrow, second.narrow), (first.wide, second.wide)]
        product = 0.0  # of U'LU = (A'B + B'A) / 2, rows A and B of the pairs
        for i, (A, B) in enumerate(parts):
            for times, (C, D) in zip((1.0, 2.0), reversed(parts[: i + 1]), strict=False):
                product += times * float(((0.5 * (C.T @ B + D.T @ A)) ** 2).sum())
        return first.inner(second), squares, product

    def inner(self, other: SplitColumns) -> float:
        """Return the sum of the products of all entries with those of another matrix."""
        return float((self.narrow * other.narrow).sum() + (self.wide * other.wide).sum())

    def toarray(self) -> FloatArray:
        """Return the matrix (R, s + d)."""
        return self.times(np.eye(self.shape[1]))


def split_columns(
    parts: Sequence[tuple[FloatArray, IntArray]], count: int
) -> tuple[SplitColumns, IntArray]:
    """Return the matrix of the rows of all parts, and the number of each of its columns.

    parts : values (r, w) at the columns (r, w) of these rows, of `count` columns; -1 for none.
    """
    first, entries = 0, []
    for values, places in parts:
        row, at = np.nonzero((values != 0.0) & (places >= 0))
        entries.append((values[row, at], first + row, places[row, at]))
        first += len(values)
    value, row, column = (np.concatenate(arrays) for arrays in zip(*entries, strict=True))
    filled = np.bincount(column, minlength=count)
    is_wide = 2 * filled > first
    order = np.concatenate([np.flatnonzero(~is_wide & (filled > 0)), np.flatnonzero(is_wide)])
    new = np.full(count, -1)
    new[order] = np.arange(len(order))
    s = len(order) - int(is_wide.sum())
    wide, own = np.zeros((first, len(order) - s)), is_wide[column]
    wide[row[own], new[column[own]] - s] = value[own]
    if not s:
        return SplitColumns.of(wide), order
    from scipy import sparse

    at = row[~own], new[column[~own]]
    return SplitColumns(sparse.csr_array((value[~own], at), shape=(first, s)), wide), order


def span_columns(columns: SplitColumns) -> SplitColumns:
    """Return an orthonormal basis (R, q) of columns, each scaled to length one.

    Columns without values in common rows, such as those of different sessions, are decomposed on
    their own, and columns with values in most rows after all others: what is left of them.
    """
    basis = replace(columns, wide=columns.wide[:, :0])
    if columns.narrow.shape[1]:
        basis = replace(basis, narrow=_span_narrow(columns.narrow))
    length = np.linalg.norm(columns.wide, axis=0)
    left = columns.wide[:, length > 0.0] / length[length > 0.0]
    if basis.narrow.shape[1]:
        left = basis.remove(basis.remove(left))  # the first projection leaves rounding
        length = np.linalg.norm(left, axis=0)
        left = left[:, length > EXPLAINED] / length[length > EXPLAINED]
    if not left.size:
        return basis
    u, s = _decompose(left)
    return replace(basis, wide=u[:, s > EXPLAINED])


def _span_narrow(columns: Any) -> Any:
    """Return an orthonormal basis of sparse columns: of those with values in less than half of the
    rows of their group first, and of what is left of the others.
    """
    from scipy import sparse

    columns = columns[:, np.flatnonzero(abs(columns).sum(axis=0))]
    entries = columns.tocoo()
    length = np.sqrt(np.bincount(entries.col, entries.data**2, columns.shape[1]))
    columns = columns @ sparse.diags_array(1.0 / length)
    if not columns.shape[1]:
        return columns
    used, place = np.unique(entries.row, return_index=True)
    first = np.zeros(columns.shape[0], dtype=np.int64)
    first[used] = entries.col[place]
    group = find_connected_groups(
        np.column_stack([first[entries.row], entries.col]).astype(np.int64), columns.shape[1]
    )
    of_row = np.full(columns.shape[0], -1)
    of_row[used] = group[first[used]]
    rows = np.bincount(of_row[used])
    is_wide = 2 * np.bincount(entries.col, minlength=len(group)) > rows[group]
    if is_wide.all() or not is_wide.any():
        return _decompose_groups(columns, of_row, group)
    inner, outer = _span_narrow(columns[:, ~is_wide]), columns[:, is_wide]
    for _ in range(2):
        outer = outer - inner @ (inner.T @ outer)
    size = np.sqrt((outer**2).sum(axis=0))
    return sparse.hstack([inner, _span_narrow(outer[:, size > EXPLAINED])], format="csr")


def _decompose_groups(columns: Any, of_row: IntArray, group: IntArray) -> Any:
    """Return orthonormal bases of the groups (c,) of sparse columns in their rows (R,), groups of
    equal size together.
    """
    from scipy import sparse

    place, count = _number_within(of_row), np.bincount(of_row[of_row >= 0])
    inside, width = _number_within(group), np.bincount(group)
    entries, parts, total = columns.tocoo(), [], 0
    of_entry = group[entries.col]
    for shape in find_distinct_rows(np.column_stack([count, width]))[0].tolist():
        alike = np.flatnonzero((count == shape[0]) & (width == shape[1]))
        number = np.full(len(count), -1)
        number[alike] = np.arange(len(alike))
        own = number[of_entry] >= 0
        blocks = np.zeros((len(alike), *shape))
        at = number[of_entry[own]], place[entries.row[own]], inside[entries.col[own]]
        blocks[at] = entries.data[own]
        u, s = _decompose(blocks)
        rows = np.zeros((len(alike), shape[0]), dtype=np.int64)
        mine = np.flatnonzero((of_row >= 0) & (number[of_row] >= 0))
        rows[number[of_row[mine]], place[mine]] = mine
        of_group, kept = np.nonzero(s > EXPLAINED)
        values, numbers = u[of_group, :, kept], total + np.arange(len(kept))
        parts.append((values.ravel(), rows[of_group].ravel(), np.repeat(numbers, shape[0])))
        total += len(kept)
    data, row, column = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return sparse.csr_array((data, (row, column)), shape=(columns.shape[0], total))


def _number_within(group: IntArray) -> IntArray:
    """Return the place (n,) of each member in its group, of which -1 is one."""
    order = np.argsort(group, kind="stable")
    count = np.bincount(group + 1)
    place = np.empty(len(group), dtype=np.int64)
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    return place


def _decompose(scaled: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return left singular vectors (.., R, c) and singular values of columns (.., R, c)."""
    Q, R = np.linalg.qr(scaled)  # the triangle first: LAPACK divides and conquers many rows
    try:
        inner, s, _ = np.linalg.svd(R, full_matrices=False)
    except np.linalg.LinAlgError:  # divide and conquer may fail; the slower driver does not
        from scipy.linalg import svd

        inner, s, _ = svd(R, full_matrices=False, lapack_driver="gesvd")
    return Q @ inner, s
