# SPDX-License-Identifier: Apache-2.0
"""What can be known from these data, before or without fitting: rank, condition and the combinations that stay open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.calibrate.checks import check_rows, check_start
from loopcal.calibrate.combinations import Combination, combinations
from loopcal.calibrate.rows import rows_of
from loopcal.calibrate.scaling import Unknowns, unknowns
from loopcal.linalg import RANK_TOLERANCE, Decomposition, FloatArray, decompose
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What the measurements determine, in units of sigma (rows) and tolerance (columns).

    Attributes
    ----------
    n_parameters, n_equations : numbers of free parameters and of equations.
    rank : how many independent combinations the data determine.
    condition : largest over smallest singular value that counts.
    gap : smallest singular value that counts over the largest that does not; infinite where none was cut.
    singular_values : (p,) descending. tolerance : share of the largest below which one counts as zero.
    improved : directions that the data know better than their tolerance (singular value above 1).
    unidentifiable : combinations of parameters that change nothing that was measured.
    notes : sentences on what was assumed.
    """

    n_parameters: int
    n_equations: int
    rank: int
    condition: float
    gap: float
    singular_values: FloatArray
    tolerance: float
    improved: int
    unidentifiable: tuple[Combination, ...]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        largest, smallest = self.singular_values[0], self.singular_values[max(self.rank - 1, 0)]
        cut = ", ".join(f"{s:.2g}" for s in self.singular_values[self.rank :])
        lines = [
            f"{self.rank} of {self.n_parameters} parameter combinations can be identified from {self.n_equations} equations",
            f"condition {self.condition:.3g}, singular values {largest:.3g} to {smallest:.3g}",
            f"singular values below {self.tolerance:.0e} of the largest count as zero",
            f"{self.improved} of {self.n_parameters} directions become better known than their tolerance",
        ]
        if self.unidentifiable:
            lines.append(f"singular values counted as zero: {cut} ({self.gap:.1e} times below the next)")
            lines += [f"not identifiable: {combination}" for combination in self.unidentifiable]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes by name, ready for JSON (numbers that are not finite are left to the writer)."""
        plain = {k: v for k, v in vars(self).items() if k != "unidentifiable"}
        return {**plain, "unidentifiable": [c.to_dict() for c in self.unidentifiable]}


def identifiability(robot: Mechanism, data: Measurements, rank_tolerance: float = RANK_TOLERANCE) -> Identifiability:
    """Tell which combinations of a robot's free parameters these measurements determine, at the robot's values.

    Parameters
    ----------
    robot : its values, free parameters and tolerances. data : the readings and what is measured there; the measured
        values matter only through which of them are present.
    rank_tolerance : relative to the largest singular value.

    Raises
    ------
    EstimationError
        No free parameter, no row, or a pose out of reach.
    """
    free = unknowns(robot)
    rows = rows_of(free, data)
    check_rows(rows, data, robot)
    z = free.deviation(robot.values[None])
    factor, cost = rows.fold(z, np.arange(1))
    check_start(rows, data, z, cost)
    return summary(free, decompose(factor, rows.rows, z, tolerance=rank_tolerance))


def summary(free: Unknowns, decomposition: Decomposition) -> Identifiability:
    """Return what a decomposition (t = 1) says about identifiability."""
    s = decomposition.singular_values[0]
    note = free.note()
    return Identifiability(
        n_parameters=len(free),
        n_equations=int(decomposition.rows[0]),
        rank=int(decomposition.rank[0]),
        condition=float(decomposition.condition[0]),
        gap=float(decomposition.gap[0]),
        singular_values=s,
        tolerance=decomposition.tolerance,
        improved=int((s > 1.0).sum()),
        unidentifiable=combinations(free, decomposition.null_space()),
        notes=() if note is None else (note,),
    )
