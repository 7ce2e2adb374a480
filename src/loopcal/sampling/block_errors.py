# SPDX-License-Identifier: Apache-2.0
"""Errors of the blocks of a fit, estimated from its residuals and corrected for leverage.

With the whitened rows of block g, its residual r_g and its leverage H_gg by everything that the
rows determine, Cov(r_g) = I - H_gg for independent errors of unit variance. The errors

    e_g = (I - H_gg)^(-1/2) r_g

have the covariance I again (CR2, Bell and McCaffrey, 2002). Directions that the block alone
determines leave no residual; in them errors can only be drawn as stated. See
docs/theory/resampling.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.fit_checks.independent_units import Clusters
from loopcal.diagnose.fit_checks.influence import TESTABLE
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.observed_columns import ObservedColumns, list_observed_columns
from loopcal.numerics.decomposition import NUISANCE_TOLERANCE, are_nonzero
from loopcal.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class BlockErrors:
    """Errors of the M present measured values, block by block.

    Attributes
    ----------
    residual : (M,) whitened residuals at the truth of the resamples.
    error : (M,) those at the estimate, corrected for leverage.
    block : (M,) number of the block of each, ascending. count : of blocks.
    untested : of every block (M_g, d) an orthonormal basis of the directions without residuals.
    places : of every kind, where (r, m) its components are among the M; -1 where absent.
    """

    residual: FloatArray
    error: FloatArray
    block: IntArray
    count: int
    untested: tuple[FloatArray, ...]
    places: tuple[IntArray, ...]

    def draw(
        self, factor: FloatArray, sigma: float, rng: np.random.Generator
    ) -> tuple[FloatArray, ...]:
        """Return offsets (t, r, m) of every kind that replace the residuals by errors.

        Parameters
        ----------
        factor : (t, count) by which the error of each block is multiplied.
        sigma : standard deviation of errors in untested directions.
        """
        offset = factor[:, self.block] * self.error - self.residual
        for g, basis in enumerate(self.untested):
            if basis.shape[1]:
                drawn = rng.standard_normal((len(factor), basis.shape[1]))
                offset[:, self.block == g] += sigma * drawn @ basis.T
        return self._by_kind(offset)

    def draw_normal(
        self, count: int, sigma: float, rng: np.random.Generator
    ) -> tuple[FloatArray, ...]:
        """Return offsets (count, r, m) of every kind that replace the residuals by independent
        normal errors.
        """
        drawn = sigma * rng.standard_normal((count, len(self.residual)))
        return self._by_kind(drawn - self.residual)

    def _by_kind(self, values: FloatArray) -> tuple[FloatArray, ...]:
        """Return values (t, M) as arrays (t, r, m) of every kind, 0 where absent."""
        padded = np.concatenate([values, np.zeros((len(values), 1))], axis=1)
        return tuple(padded[:, places] for places in self.places)


def compute_block_errors(
    linear: FitLinearization, clusters: Clusters, shift: FloatArray
) -> BlockErrors:
    """Return the errors of the rows of a fit, by independent blocks of poses.

    Parameters
    ----------
    shift : (p,) in tolerances, from the estimate to the truth of the resamples, at which the rows
        have the residuals that the errors replace.
    """
    problem, kinds = linear.problem, list_observed_columns(linear.problem, linear.linearization)
    cells = _list_cells(problem.rows, clusters)
    V = linear.decomposition.scale[:, None] * linear.decomposition.directions[0]
    total = linear.decomposition.singular_values[0] ** 2 + linear.penalty[0]
    V = V[:, linear.is_estimated] / np.sqrt(total[linear.is_estimated])
    residual, error = np.zeros(len(cells.block)), np.zeros(len(cells.block))
    untested = []
    for g in range(clusters.count):
        mine = np.flatnonzero(cells.block == g)
        cells_of_kinds = [cells.within(mine, i) for i in range(len(kinds))]
        pairs = list(zip(kinds, cells_of_kinds, strict=True))
        residual[mine] = np.concatenate([kind.residual[own_cells] for kind, own_cells in pairs])
        by_nuisance = np.concatenate([kind.by_nuisance[own_cells] for kind, own_cells in pairs])
        by_parameters = np.concatenate([kind.by_parameters[own_cells] for kind, own_cells in pairs])
        half = np.concatenate([by_nuisance, by_parameters @ V], axis=1)
        poses = _pose_columns(problem.rows, kinds, cells_of_kinds)
        error[mine], lost = _correct(residual[mine], half, poses)
        residual[mine] += by_parameters @ shift
        untested.append(lost)
    places = tuple(cells.places(i, kind.residual.shape) for i, kind in enumerate(kinds))
    return BlockErrors(residual, error, cells.block, clusters.count, tuple(untested), places)


@dataclass(frozen=True, eq=False)
class _Cells:
    """The present components of all rows, sorted by block and kind: (M,) each."""

    block: IntArray
    kind: IntArray
    row: IntArray
    component: IntArray

    def within(self, cells: IntArray, kind: int) -> tuple[IntArray, IntArray]:
        """Return rows and components of those of some cells that are of one kind."""
        mine = cells[self.kind[cells] == kind]
        return self.row[mine], self.component[mine]

    def places(self, kind: int, shape: tuple[int, ...]) -> IntArray:
        """Return the cell (r, m) of each component of a kind; -1 where absent."""
        places = np.full(shape, -1)
        mine = np.flatnonzero(self.kind == kind)
        places[self.row[mine], self.component[mine]] = mine
        return places


def _list_cells(rows: Sequence[ObservationRows], clusters: Clusters) -> _Cells:
    """Return the present components of rows (one trial)."""
    columns = []
    for i, of_kind in enumerate(rows):
        row, component = np.nonzero(of_kind.is_present[0])
        block = clusters.member[of_kind.first_poses[row]]
        columns.append(np.stack([block, np.full(len(row), i), row, component]))
    cells = np.concatenate(columns, axis=1)
    return _Cells(*cells[:, np.lexsort((cells[1], cells[0]))])


def _pose_columns(
    rows: Sequence[ObservationRows],
    kinds: Sequence[ObservedColumns],
    cells_of_kinds: Sequence[tuple[IntArray, IntArray]],
) -> FloatArray:
    """Return the columns (M, K) of a block's cells by the coordinates of its poses."""
    if all(kind.by_coordinates is None for kind in kinds):
        return np.zeros((sum(len(row) for row, _ in cells_of_kinds), 0))
    linked = [r.poses_by_link[row] for r, (row, _) in zip(rows, cells_of_kinds, strict=True)]
    poses = np.unique(np.concatenate([of_kind.ravel() for of_kind in linked]))
    blocks = []
    for kind, names, (row, component) in zip(kinds, linked, cells_of_kinds, strict=True):
        assert kind.by_coordinates is not None
        k = kind.by_coordinates.shape[-1]
        wide = np.zeros((len(row), len(poses), k))
        for link in range(names.shape[1]):
            place = np.searchsorted(poses, names[:, link])
            wide[np.arange(len(row)), place] += kind.by_coordinates[row, link, component]
        blocks.append(wide.reshape(len(row), len(poses) * k))
    return np.concatenate(blocks)


def _correct(
    residual: FloatArray, half: FloatArray, poses: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the corrected errors (M,) of a block, and a basis (M, d) of its untested directions.

    Parameters
    ----------
    half : (M, w) with half half' the leverage of the block by setup and machine. poses : (M, K)
        columns of the coordinates of its poses, whose range has leverage 1.
    """
    Q = _find_range(poses)
    residual, half = residual - Q @ (Q.T @ residual), half - Q @ (Q.T @ half)
    L, s, _ = np.linalg.svd(half, full_matrices=False)
    remaining = 1.0 - s**2
    is_tested = remaining > TESTABLE
    gain = np.where(is_tested, 1.0 / np.sqrt(np.where(is_tested, remaining, 1.0)), 0.0)
    error = residual + L @ ((gain - 1.0) * (L.T @ residual))
    return error, np.concatenate([Q, L[:, ~is_tested]], axis=1)


def _find_range(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis (M, d) of the range of columns (M, K)."""
    if not columns.shape[1]:
        return columns
    length = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns / np.where(length > 0.0, length, 1.0), full_matrices=False)
    return u[:, are_nonzero(s, NUISANCE_TOLERANCE)]
