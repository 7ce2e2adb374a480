# SPDX-License-Identifier: Apache-2.0
"""The residuals of a fit that no parameter explains, in the order of measurement.

The whitened rows have the errors e. With an orthonormal basis U of the columns of everything that
is estimated (machine, frames, targets, surfaces, offsets), whatever penalty the fit used, the
residuals r = (I - U U') e of a least-squares fit have the covariance sigma^2 (I - U U') for
independent errors. Tests of r are exact in small data sets if they use this projector: the
residuals themselves are correlated even where the errors are not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements, Observations
from loopcal.typing import FloatArray, IntArray

EXPLAINED = 1e-6
"""Share of its length below which a column counts as explained by other columns."""


@dataclass(frozen=True, eq=False)
class ResidualRows:
    """R whitened rows of a fit, those of one series (a kind and its column) in order.

    Attributes
    ----------
    basis : (R, q) orthonormal, what is estimated. residual : (R,) of the least-squares fit.
    gain : (R, k) change of the k directions of the fit by an error of each row.
    root : (p, k) these directions [SI]: an error e of the rows changes the estimate by
        root gain' e, up to its sign.
    kind, row, column : (R,) number of the kind, of its row, and of its residual.
    series : (R,) number of the series, in ascending order.
    """

    basis: FloatArray
    residual: FloatArray
    gain: FloatArray
    root: FloatArray
    kind: IntArray
    row: IntArray
    column: IntArray
    series: IntArray

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the residuals."""
        return self.basis.shape[0] - self.basis.shape[1]

    @cached_property
    def square(self) -> float:
        """Sum of squares of the residuals."""
        return float((self.residual**2).sum())

    def project(self, columns: FloatArray) -> FloatArray:
        """Return the part of columns (R, c) that nothing estimated explains; zero where that is
        rounding.
        """
        left = columns - self.basis @ (self.basis.T @ columns)
        left -= self.basis @ (self.basis.T @ left)  # the first projection leaves rounding
        size = np.linalg.norm(columns, axis=0)
        return np.where(np.linalg.norm(left, axis=0) > EXPLAINED * size, left, 0.0)

    def with_effects(self, columns: FloatArray) -> ResidualRows:
        """Return the rows as if the fit had also estimated effects with these columns (R, c)."""
        new = span_columns(self.project(columns))
        left = self.residual - new @ (new.T @ self.residual)
        return replace(self, basis=np.concatenate([self.basis, new], axis=1), residual=left)

    def without(self, rows: IntArray) -> ResidualRows:
        """Return the rows as if the fit had not used some of them (w,)."""
        kept = np.ones(len(self.residual), dtype=bool)
        kept[rows] = False
        basis = span_columns(self.basis[kept])
        left = self.residual[kept] - basis @ (basis.T @ self.residual[kept])
        return replace(
            self,
            basis=basis,
            residual=left,
            gain=self.gain[kept],
            kind=self.kind[kept],
            row=self.row[kept],
            column=self.column[kept],
            series=self.series[kept],
        )


def span_columns(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis (R, q) of columns (R, c), each scaled to length one."""
    length = np.linalg.norm(columns, axis=0)
    scaled = columns[:, length > 0.0] / length[length > 0.0]
    if not scaled.size:
        return scaled
    Q, R = np.linalg.qr(scaled)  # the triangle first: LAPACK divides and conquers many rows
    try:
        inner, s, _ = np.linalg.svd(R, full_matrices=False)
    except np.linalg.LinAlgError:  # divide and conquer may fail; the slower driver does not
        from scipy.linalg import svd

        inner, s, _ = svd(R, full_matrices=False, lapack_driver="gesvd")
    u = Q @ inner
    return np.asarray(u[:, s > EXPLAINED])


def collect_residual_rows(
    fit: Identification, data: Measurements, linear: FitLinearization
) -> ResidualRows | None:
    """Return the residuals of a fit in the order of measurement; None where rows cannot be told
    apart, because their readings are uncertain, or where there are none.

    Parameters
    ----------
    fit : with intervals. data : its measurements, with the sigma of their readings, without
        excluded poses. linear : of both, see `linearize_fit`.
    """
    if linear.problem.is_uncertain:
        return None
    observations = [rows for rows in data.observations if len(rows)]
    row_groups = list(_iterate_rows(linear, observations))
    if not row_groups:
        return None
    rows, kind, row, column = (np.concatenate(arrays) for arrays in zip(*row_groups, strict=True))
    first = np.cumsum([0, *(o.present.shape[1] for o in observations)])
    series = first[kind] + column
    place = np.concatenate([order_rows(o) for o in observations])
    start = np.cumsum([0, *(len(o) for o in observations)])
    order = np.lexsort((place[start[kind] + row], series))
    rows, kind, row, column = rows[order], kind[order], row[order], column[order]
    d, p = linear.decomposition, len(fit.names)
    used = linear.is_estimated
    V = d.scale[:, None] * d.directions[0][:, used]
    by_direction = rows[:, -p - 1 : -1] @ V
    total = (d.singular_values[0] ** 2 + linear.penalty[0])[used]
    determined = d.scale[:, None] * d.directions[0][:, d.used[0]]
    machine = rows[:, -p - 1 : -1] @ (determined / d.singular_values[0][d.used[0]])
    basis = span_columns(np.concatenate([rows[:, : -p - 1], machine], axis=1))
    residual = rows[:, -1] - basis @ (basis.T @ rows[:, -1])
    return ResidualRows(
        basis=basis,
        residual=residual,
        gain=by_direction / total,
        root=fit.tolerance[:, None] * V,
        kind=kind,
        row=row,
        column=column,
        series=np.unique(series[order], return_inverse=True)[1],
    )


def order_rows(rows: Observations) -> IntArray:
    """Return the place (r,) of each row in the order of measurement: by time where all rows state
    it, else as in the file.
    """
    place = np.arange(len(rows))
    time = rows.context.get("time")
    if time is not None and np.isfinite(time).all():
        place[np.argsort(time, kind="stable")] = np.arange(len(rows))
    return place


def _iterate_rows(
    linear: FitLinearization, observations: list[Observations]
) -> Iterator[tuple[FloatArray, IntArray, IntArray, IntArray]]:
    """Give rows (k, U + p + 1) that are present, with their kind, row and column (k,)."""
    for node_rows in linear.problem.leverage_rows(linear.linearization, linear.solution):
        for part in node_rows:
            present = np.diagonal(observations[part.kind].whitener, axis1=1, axis2=2) != 0.0
            i, column = np.nonzero(present[part.numbers])
            kind = np.full(len(i), part.kind)
            yield part.rows[i, column], kind, part.numbers[i], column
