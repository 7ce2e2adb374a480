# SPDX-License-Identifier: Apache-2.0
"""Compute the influence of each observation block on a fit, in one more pass over the rows.

With the information M = sum_j w_j A_j'A_j + P (P the penalty), G = A_j M^-1 A_j' and the residual
r_j of block j, the residual that the block has with respect to a fit without it, and the squared
Mahalanobis norm of that residual, are

    r_(j) = (I - w_j G)^-1 r_j,    d^2 = r_(j)' (I + G_(j))^-1 r_(j),    G_(j) = (I - w_j G)^-1 G

In the eigenvectors of G, eigenvalues g, d^2 = sum r^2 / ((1 - w g)(1 + (1 - w) g)): for a block
inside the fit r^2 / (1 - g), for one outside r^2 / (1 + g). If block and model are right it has a
chi-square distribution with as many degrees of freedom as there are directions with 1 - w g > 0.
The leverage is the trace of w G. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from loopcal.estimate.linearization import LeverageRows, Linearization
from loopcal.estimate.pose_linearization import PoseSolution
from loopcal.estimate.problem import Problem
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.statistics import find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray

# Remaining part 1 - w g of a direction below which only this block determines it, so that its
# residual tests nothing.
TESTABLE = 1e-6
# Variance of a predicted residual outside the fit, in units of the noise, above which the fit
# does not predict it.
UNPREDICTABLE = 1e10
# Standard deviation in tolerances that stands in G for a direction that the fit does not use.
UNDETERMINED = 1e6


class Influence(NamedTuple):
    """One entry for each of u blocks."""

    leverage: FloatArray  # (u,) trace of w G: number of parameters that the block determines
    residuals: IntArray  # (u,) number of residuals
    distance: FloatArray  # (u,) d^2
    degrees: IntArray  # (u,) its degrees of freedom
    # (u,) squared norm of the whitened leave-one-out residual r_(j), over the directions that can
    # be tested
    deleted: FloatArray


def compute_influence(
    problem: Problem,
    linearization: Linearization,
    member: IntArray,
    decomposition: Decomposition,
    fits: Sequence[tuple[FloatArray, FloatArray]],
    weight: FloatArray,
    solution: PoseSolution | None = None,
) -> list[Influence]:
    """Return the influence of every block (one trial) on fits of the same rows, in one pass.

    problem : unweighted. linearization : of the weighted problem.
    member : (n,) block 0..u-1 of each pose. decomposition : of the weighted fits.
    fits : the penalty of each fit, and the deviation (1, p) at which its residuals are evaluated,
        to first order.
    weight : (u,) weight of each block in the fits.
    solution : poses and nuisance parameters of the rows, see `Problem.leverage_rows`.
    """
    d, u, p = decomposition, len(weight), len(decomposition.scale)
    roots, changes = [], []
    for penalty, solved in fits:
        variance = d.variances(penalty)[0]
        sd = np.sqrt(np.where(np.isfinite(variance), variance, UNDETERMINED**2))
        roots.append(d.scale[:, None] * d.directions[0] * sd)
        changes.append((solved - linearization.deviation)[0])
    results = [make_empty_influence(u) for _ in fits]
    total = problem.poses.count_rows(member, u)
    rows = problem.leverage_rows(linearization, solution)
    for blocks, columns, r in iterate_blocks(rows, member, total):
        # nuisance parameters come first, in units of their standard deviation
        A, nuisance = columns[..., -p:], columns[..., :-p]
        present = np.any(A != 0.0, axis=2) | np.any(nuisance != 0.0, axis=2) | (r != 0.0)
        for result, root, change in zip(results, roots, changes, strict=True):
            half = np.concatenate([nuisance, A @ root], axis=2)
            tested = compute_block_influence(half, r + A @ change, present, weight[blocks])
            for array, values in zip(result, tested, strict=True):
                array[blocks] = values
    return results


def make_empty_influence(blocks: int) -> Influence:
    """Return an influence of zeros, to be filled."""
    leverage, distance, deleted = np.zeros((3, blocks))
    residuals, degrees = np.zeros((2, blocks), np.int64)
    return Influence(leverage, residuals, distance, degrees, deleted)


def compute_block_influence(
    half: FloatArray, residual: FloatArray, present: BoolArray, weight: FloatArray
) -> Influence:
    """Return the influence of b blocks of equal size.

    half : (b, m, k) square root of G. residual : (b, m). present : (b, m) rows that exist; the
        others are zero. weight : (b,) of the blocks in the fit.
    """
    g, vectors = np.linalg.eigh(half @ half.swapaxes(-1, -2))
    w = weight[:, None]
    remaining = 1.0 - w * g
    # absent rows are zero: eigenvectors of value zero and residual zero, subtracted below
    tested = (remaining > TESTABLE) & ((1.0 - w) * g < UNPREDICTABLE)
    square = np.matmul(residual[:, None, :], vectors)[:, 0] ** 2
    safe = np.where(tested, remaining, 1.0)
    normed = square / (safe * (1.0 + (1.0 - w) * g))
    return Influence(
        (w * g).sum(axis=1),
        present.sum(axis=1),
        np.where(tested, normed, 0.0).sum(axis=1),
        tested.sum(axis=1) - (~present).sum(axis=1),
        np.where(tested, square / safe**2, 0.0).sum(axis=1),
    )


def iterate_blocks(
    rows_of_problem: Iterable[list[LeverageRows]], member: IntArray, total: IntArray
) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
    """Yield blocks of equal size together: numbers (b,), matrices (b, m, p), residuals (b, m).

    A block whose rows come with several chunks of poses waits until the last of them. `total` (u,)
    is the number of rows of each block, see `PoseRows.count_rows`.
    """
    waiting: list[tuple[IntArray, FloatArray]] = []
    for rows_of_block in rows_of_problem:
        for rows in rows_of_block:
            blocks = np.repeat(member[rows.poses], rows.rows.shape[1])
            waiting.append((blocks, rows.rows.reshape(-1, rows.rows.shape[2])))
        if not waiting:
            continue
        block_of_row = np.concatenate([w[0] for w in waiting])
        stacked = np.concatenate([w[1] for w in waiting])
        order = np.argsort(block_of_row, kind="stable")
        block_of_row, stacked = block_of_row[order], stacked[order]
        numbers, first, sizes = np.unique(block_of_row, return_index=True, return_counts=True)
        complete = sizes == total[numbers]
        for size in find_distinct(sizes[complete]):
            chosen = complete & (sizes == size)
            places = first[chosen][:, None] + np.arange(size)
            yield numbers[chosen], stacked[places, :-1], stacked[places, -1]
        left = np.repeat(~complete, sizes)
        waiting = [(block_of_row[left], stacked[left])] if left.any() else []
