# SPDX-License-Identifier: Apache-2.0
"""Whitened rows of a fit in the order of its kinds, with columns for everything that they
determine.

`Problem.leverage_rows` gives rows from which poses are eliminated: they are combinations of the
measured rows. Errors that are drawn for each measured row need the rows themselves, with the
coordinates of the poses as further columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.linearization import Linearization
from loopcal.estimate.nuisance.elimination import spread_columns
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.poses.linearization import linearize_rows
from loopcal.estimate.problem import Problem
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class ObservedColumns:
    """The whitened rows of one kind (one trial).

    Attributes
    ----------
    residual : (r, m).
    by_nuisance : (r, m, U) by the nuisance parameters, in units of their standard deviations.
    by_parameters : (r, m, p) by the machine's deviations, as the nuisance parameters follow it.
    by_coordinates : (r, links, m, k) by the coordinates of each linked pose; None where poses have
        none.
    """

    residual: FloatArray
    by_nuisance: FloatArray
    by_parameters: FloatArray
    by_coordinates: FloatArray | None


def list_observed_columns(
    problem: Problem, linearization: Linearization
) -> tuple[ObservedColumns, ...]:
    """Return the rows of every kind of a problem, at its linearization (one trial)."""
    z, trials, estimate = linearization.deviation, problem.trials, linearization.nuisance
    fixed = None if estimate is None else estimate.values
    solution = problem.poses.solve(z, trials, linearization.next_start, problem.control, fixed)
    root = None if estimate is None else estimate.elimination.joint_root()[0]
    width = 0 if root is None else len(root)
    kinds = [_make_empty(problem, rows, width) for rows in problem.rows]
    for block, poses in problem.poses.iterate_linearized(solution, z, trials):
        for kind, numbers, rows in zip(kinds, block.row_numbers, block.rows, strict=True):
            if not len(numbers):
                continue
            own = linearize_rows(rows, poses, trials, fixed)
            columns = own.by_parameters[0]
            if own.by_nuisance is not None and estimate is not None:
                wide = spread_columns(own.by_nuisance, rows.nuisance, width)[0]
                columns = columns + wide @ estimate.elimination.slope[0]
                kind.by_nuisance[numbers] = wide @ root
            kind.residual[numbers], kind.by_parameters[numbers] = own.residual[0], columns
            if own.by_coordinates is not None and kind.by_coordinates is not None:
                kind.by_coordinates[numbers] = own.by_coordinates[0]
    return tuple(kinds)


def _make_empty(problem: Problem, rows: ObservationRows, width: int) -> ObservedColumns:
    """Return arrays of zeros for the rows of a kind and `width` nuisance parameters."""
    r, m = rows.whitener.shape[1:3]
    coordinates = None
    if problem.coordinates is not None:
        links = rows.poses_by_link.shape[1]
        coordinates = np.zeros((r, links, m, problem.coordinates.freedoms))
    by_parameters = np.zeros((r, m, problem.parameters))
    return ObservedColumns(np.zeros((r, m)), np.zeros((r, m, width)), by_parameters, coordinates)
