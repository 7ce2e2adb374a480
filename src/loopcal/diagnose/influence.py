# SPDX-License-Identifier: Apache-2.0
"""What each block of rows does to the fit, and what the others say of it, in one more pass over the
rows.

With the information M = sum_j w_j A_j'A_j + P (P the penalty), G = A_j M^-1 A_j' and the residual
r_j of block j, the residual that the block has with respect to a fit without it, and that
residual's squared Mahalanobis norm, are

    r_(j) = (I - w_j G)^-1 r_j,      d^2 = r_(j)' (I + G_(j))^-1 r_(j),      G_(j) = (I - w_j G)^-1 G

In the eigenvectors of G, eigenvalues g, d^2 = sum r^2 / ((1 - w g)(1 + (1 - w) g)): for a block
inside the fit r^2 / (1 - g), for one outside r^2 / (1 + g). If block and model are right it has a
chi-square distribution with as many degrees of freedom as there are directions with 1 - w g > 0.
The leverage is the trace of w G. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.linearization import Linearization
from loopcal.estimate.problem import Problem
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray, IntArray

TESTABLE = 1e-6
"""Part of a block's direction, 1 - w g, below which the block alone determines it and its residual
tests nothing.
"""

UNKNOWN = 1e6
"""Standard deviation, in tolerances, with which a direction that the fit does not use counts in G.
"""


@dataclass(frozen=True, eq=False)
class Influence:
    """One entry for each of u blocks.

    Attributes
    ----------
    leverage : (u,) trace of w G: parameters that the block determines. residuals : (u,) how many it
        has.
    distance : (u,) d^2. degrees : (u,) its degrees of freedom.
    deleted : (n,) squared norm of the block's leave-one-out residual r_(j), whitened, counted where
        it can be tested.
    """

    leverage: FloatArray
    residuals: IntArray
    distance: FloatArray
    degrees: IntArray
    deleted: FloatArray


def compute_influence(
    problem: Problem,
    linearization: Linearization,
    member: IntArray,
    decomposition: Decomposition,
    penalty: FloatArray,
    weight: FloatArray,
    at: FloatArray | None = None,
) -> Influence:
    """Return the influence of every block (one trial).

    Parameters
    ----------
    problem : unweighted. linearization : of the weighted problem.
    member : (n,) block 0..u-1 of each pose. weight : (u,) weight of each block in the fit.
    decomposition, penalty : of the weighted fit.
    at : (1, p), optional. Deviation at which the residuals are taken, to first order; default that
        of the linearization.
    """
    d = decomposition
    variance = d.variances(penalty)[0]
    root = np.sqrt(np.where(np.isfinite(variance), variance, UNKNOWN**2))
    spread = d.scale[:, None] * d.directions[0] * root
    change = np.zeros(d.scale.shape) if at is None else (at - linearization.deviation)[0]
    u = len(weight)
    found = Influence(
        np.zeros(u), np.zeros(u, np.int64), np.zeros(u), np.zeros(u, np.int64), np.zeros(u)
    )
    for blocks, columns, r in _by_block(problem, linearization, member, u):
        A, own = (
            columns[..., -len(root) :],
            columns[..., : -len(root)],
        )  # own unknowns are in units of their sd
        residual = r + A @ change
        present = np.any(A != 0.0, axis=2) | np.any(own != 0.0, axis=2) | (r != 0.0)
        half = np.concatenate([own, A @ spread], axis=2)
        g, vectors = np.linalg.eigh(half @ half.swapaxes(-1, -2))
        w = weight[blocks][:, None]
        inside = 1.0 - w * g
        # absent rows are zero: they are eigenvectors of value zero and of residual zero, and not
        # counted below
        tested = inside > TESTABLE
        parts = np.matmul(residual[:, None, :], vectors)[:, 0] ** 2
        safe = np.where(tested, inside, 1.0)
        found.leverage[blocks] = (w * g).sum(axis=1)
        found.residuals[blocks] = present.sum(axis=1)
        found.distance[blocks] = np.where(tested, parts / (safe * (1.0 + (1.0 - w) * g)), 0.0).sum(
            axis=1
        )
        found.degrees[blocks] = tested.sum(axis=1) - (~present).sum(axis=1)
        found.deleted[blocks] = np.where(tested, parts / safe**2, 0.0).sum(axis=1)
    return found


def _by_block(
    problem: Problem, linearization: Linearization, member: IntArray, count: int
) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
    """Give blocks of equal size together: their numbers (b,), matrices (b, m, p) and residuals (b,
    m).

    A block whose rows come with several blocks of poses waits until the last of them.
    """
    total = problem.count_leverage_rows(member, count)
    waiting: list[tuple[IntArray, FloatArray]] = []
    for parts in problem.leverage_rows(linearization):
        waiting += [
            (
                np.repeat(member[part.poses], part.rows.shape[1]),
                part.rows.reshape(-1, part.rows.shape[2]),
            )
            for part in parts
        ]
        if not waiting:
            continue
        of, stacked = (
            np.concatenate([w[0] for w in waiting]),
            np.concatenate([w[1] for w in waiting]),
        )
        order = np.argsort(of, kind="stable")
        of, stacked = of[order], stacked[order]
        numbers, first, sizes = np.unique(of, return_index=True, return_counts=True)
        complete = sizes == total[numbers]
        for size in np.unique(sizes[complete]):
            chosen = complete & (sizes == size)
            places = first[chosen][:, None] + np.arange(size)
            yield numbers[chosen], stacked[places, :-1], stacked[places, -1]
        left = np.repeat(~complete, sizes)
        waiting = [(of[left], stacked[left])] if left.any() else []
