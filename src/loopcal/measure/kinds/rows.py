# SPDX-License-Identifier: Apache-2.0
"""Rows of a kind: their columns, residuals and derivatives, and rows that are invalid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.numerics.rounding import without_rounding
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

InvalidRows = tuple[tuple[int, str], ...]
"""Index of each invalid row, and the end of a sentence that says why."""


@dataclass(frozen=True)
class Column:
    """A column of a measurement file: its name, and the dimension of its numbers."""

    name: str
    dimension: Dimension


POSITION_COLUMNS = tuple(Column(name, Dimension.LENGTH) for name in ("x", "y", "z"))
"""Columns of a position."""


class Evaluation(NamedTuple):
    """Residuals (predicted - measured) and their derivatives.

    Components that were not measured are zero in all arrays.

    Attributes
    ----------
    residual : (t, r, m) [SI]
    jacobian : (t, r, m, 6)
        By the platform twist (omega, v) in base axes; with an axis of poses before m where a row
        compares several poses.
    nuisance : (t, r, m, u) or None
        By the nuisance parameters of the kind; None where it has none.
    joints : (t, r, m, j) or None
        By the values of the joints that the kind senses; None where it senses poses only.
    """

    residual: FloatArray
    jacobian: FloatArray
    nuisance: FloatArray | None = None
    joints: FloatArray | None = None


class MeasuredColumns(NamedTuple):
    """Columns of rows as a kind compares its predictions with them, see `Kind.prepare_columns`.

    Attributes
    ----------
    columns : (t, r, c) [SI], with a placeholder where nothing was measured.
    reference : (t, r, k) the columns, or what a kind computes from them alone.
    present : (t, r, m) residuals that exist. is_complete : whether all do.
    """

    columns: FloatArray
    reference: FloatArray
    present: BoolArray
    is_complete: bool

    def take(self, trials: IntArray) -> MeasuredColumns:
        """Return the columns of some trials."""
        arrays = (self.columns[trials], self.reference[trials], self.present[trials])
        return MeasuredColumns(*arrays, self.is_complete)


def list_rows(wrong: BoolArray, describe: Callable[[int], str]) -> InvalidRows:
    """Return the rows of a mask (r,), each with its description."""
    return tuple((int(i), describe(int(i))) for i in np.flatnonzero(wrong))


def is_incomplete(columns: FloatArray) -> BoolArray:
    """Return the rows of columns (.., c) in which some values are missing, but not all."""
    missing = np.isnan(columns)
    return np.any(missing, axis=-1) & ~np.all(missing, axis=-1)


def drop_rounding(evaluation: Evaluation) -> Evaluation:
    """Return the evaluation with zeros where derivatives by nuisance parameters cancel, as those by
    the place of a target do between parallel poses.

    They are compared with derivatives by the platform twist. A meter is compared with a radian
    there; the tolerance is so small that the size of a machine does not matter.
    """
    if evaluation.nuisance is None:
        return evaluation
    by_twist = np.linalg.norm(evaluation.jacobian, axis=-1)
    by_twist = by_twist.sum(axis=-2) if evaluation.jacobian.ndim > 4 else by_twist
    return evaluation._replace(nuisance=without_rounding(evaluation.nuisance, by_twist[..., None]))


def zero_absent(evaluation: Evaluation, present: BoolArray) -> Evaluation:
    """Return the evaluation with zeros for components that are not `present` (t, r, m)."""
    by_row = present[..., None]
    has_links = evaluation.jacobian.ndim > present.ndim + 1
    by_nuisance, by_joints = (
        None if derivative is None else np.where(by_row, derivative, 0.0)
        for derivative in (evaluation.nuisance, evaluation.joints)
    )
    return Evaluation(
        np.where(present, evaluation.residual, 0.0),
        np.where(present[..., None, :, None] if has_links else by_row, evaluation.jacobian, 0.0),
        by_nuisance,
        by_joints,
    )
