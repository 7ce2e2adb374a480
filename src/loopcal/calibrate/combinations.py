# SPDX-License-Identifier: Apache-2.0
"""Directions that the data cannot tell, as named combinations of parameters and as words.

A basis of the null space is turned into its sparsest readable form, one leading parameter a combination, by elimination
with pivoting; coefficients are displacements in the units of the robot's file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.calibrate.scaling import Unknowns
from loopcal.linalg import FloatArray

NEGLIGIBLE = 1e-6
"""Part of a combination, in tolerances and relative to its largest, that is rounding and not shown."""

SHOWN = 8
"""Parameters written out in the words of a combination; the others are counted."""


@dataclass(frozen=True, eq=False)
class Combination:
    """Parameters that, changed together like this, change nothing that was measured.

    Attributes
    ----------
    names : (k,) strongest first. changes : (k,) displacements that belong together, in `units` (symbols).
    """

    names: tuple[str, ...]
    changes: FloatArray
    units: tuple[str, ...]

    def __str__(self) -> str:
        parts = [f"{n} {c:+.4g} {u}" for n, c, u in zip(self.names, self.changes, self.units, strict=True)]
        if len(parts) > SHOWN:
            parts = [*parts[:SHOWN], f"and {len(parts) - SHOWN} more"]
        if len(parts) == 1:
            return f"{self.names[0]} alone changes nothing that was measured"
        return f"together {', '.join(parts)} change nothing that was measured"

    def to_dict(self) -> dict[str, object]:
        """Names, changes and units."""
        return {"names": list(self.names), "changes": self.changes.tolist(), "units": list(self.units)}


def combinations(unknowns: Unknowns, null_space: FloatArray) -> tuple[Combination, ...]:
    """Return the combinations that span a null space (p, d) of deviations in tolerances."""
    factor, symbols = unknowns.display()
    found = []
    for direction in _sparse(null_space):
        largest = np.abs(direction).max()
        chosen = np.flatnonzero(np.abs(direction) > NEGLIGIBLE * largest)
        order = chosen[np.argsort(-np.abs(direction[chosen]), kind="stable")]
        changes = direction[order] * unknowns.tolerance[order] / factor[order]
        names = tuple(unknowns.names[i] for i in order)
        found.append(Combination(names, changes / changes[0], tuple(symbols[i] for i in order)))
    return tuple(found)


def _sparse(null_space: FloatArray) -> FloatArray:
    """Return a basis (d, p) of the same space in which each vector has a parameter of its own."""
    d = null_space.shape[1]
    if d == 0:
        return np.zeros((0, len(null_space)))
    from scipy.linalg import lu_factor, lu_solve, qr

    *_, order = qr(null_space.T, mode="r", pivoting=True)
    pivots = np.asarray(order)[:d]  # a well-conditioned choice of leaders
    return lu_solve(lu_factor(null_space[pivots].T), null_space.T)
