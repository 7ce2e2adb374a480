# SPDX-License-Identifier: Apache-2.0
"""The null space as combinations of parameters that change no measured value.

A basis of the null space is brought to a sparse form, in which each combination has a leading
parameter of its own, by elimination with pivoting. Coefficients are changes in the units of the
robot's file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.findings import Finding, report_finding
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.typing import FloatArray, IntArray

NEGLIGIBLE = 1e-6
"""Part of a combination, in tolerances and relative to its largest, that is rounding and left out.
"""

MINOR = 0.1
"""The same for a weak direction, which has a small part of nearly every parameter."""

TIE = 1e-6
"""Relative difference below which two candidates for a pivot are equal. Symmetric parameters differ
by rounding, 1e-13 in practice, which is another one for every engine and processor.
"""


@dataclass(frozen=True, eq=False)
class Combination(Result):
    """A combined change of parameters that changes no measured value, or hardly any.

    Attributes
    ----------
    names : (k,) strongest first. changes : (k,) changes that belong together, in `units` (symbols).
    weights : (k,) the same in tolerances, of length one over all parameters.
    singular_value : change of the whitened residuals per tolerance along the direction, in standard
        deviations of the noise; 0 for a null direction.
    meaning : what the robot does with such a change; empty where it is no rigid motion.
    nuisance : frames, targets and surfaces of the measurements that change with it.
    direction : (p,) all parameters, in tolerances, with the parts that are left out.
    """

    names: tuple[str, ...]
    changes: FloatArray
    units: tuple[str, ...]
    weights: FloatArray = field(default_factory=lambda: np.zeros(0))
    singular_value: float = 0.0
    meaning: str = ""
    nuisance: tuple[str, ...] = ()
    direction: FloatArray = field(default_factory=lambda: np.zeros(0))

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("names", "changes", "units", "weights", "singular_value"),
        meaning=lambda combination: str(combination.meaning),
        nuisance="nuisance",
        sentence=str,
    )

    @property
    def is_harmless(self) -> bool:
        """Whether it is known that no pose depends on it."""
        return getattr(self.meaning, "code", "") == "identifiability.no-motion"

    @property
    def finding(self) -> Finding:
        """That the data do not determine this combination, or hardly."""
        weak = self.singular_value > 0.0
        return report_finding(
            "fit.hardly-observable" if weak else "fit.unidentifiable",
            names=self.names,
            changes=tuple(self.changes.tolist()),
            units=self.units,
            weights=tuple(self.weights.tolist()),
            singular_value=self.singular_value,
            meaning=str(self.meaning),
            nuisance=self.nuisance,
        )

    def __str__(self) -> str:
        """Return the text of the finding."""
        return str(self.finding)


def describe_null_space(free: FreeParameters, null_space: FloatArray) -> tuple[Combination, ...]:
    """Return the combinations that span a null space (p, d) of deviations in tolerances."""
    return tuple(describe_direction(free, direction) for direction in sparsify_basis(null_space))


def describe_direction(
    free: FreeParameters, direction: FloatArray, singular_value: float = 0.0
) -> Combination:
    """Return a direction (p,) of deviations in tolerances by names; small parts are left out."""
    factor, symbols = free.display()
    size = np.abs(direction)
    chosen = np.flatnonzero(size > (MINOR if singular_value > 0.0 else NEGLIGIBLE) * size.max())
    # parts that differ by rounding stay in the order of the robot's parameters
    order = chosen[np.argsort(-np.round(size[chosen] / size.max(), 9), kind="stable")]
    changes = direction[order] * free.tolerance[order] / factor[order]
    sign = np.sign(changes[0])
    return Combination(
        names=tuple(free.names[i] for i in order),
        changes=changes / changes[0],
        units=tuple(symbols[i] for i in order),
        weights=sign * direction[order] / np.linalg.norm(direction),
        singular_value=singular_value,
        direction=direction,
    )


def sparsify_basis(null_space: FloatArray) -> FloatArray:
    """Return a basis (d, p) of the space (p, d) in which each vector has a parameter of its own.

    It depends on the space alone, not on the basis that spans it.
    """
    if null_space.shape[1] == 0:
        return np.zeros((0, len(null_space)))
    from scipy.linalg import lu_factor, lu_solve

    pivots = choose_pivots(null_space.T, first=True)
    return lu_solve(lu_factor(null_space[pivots].T), null_space.T)


def choose_pivots(columns: FloatArray, first: bool) -> IntArray:
    """Return d well-conditioned columns of (d, p), ascending, by elimination with pivoting.

    Of columns that are equally large, the first one is taken, or the last one.
    """
    rest, chosen = columns, []
    for _ in range(len(columns)):
        size = np.linalg.norm(rest, axis=0)
        size[chosen] = 0.0
        equal = np.flatnonzero(size >= (1.0 - TIE) * size.max())
        pivot = int(equal[0 if first else -1])
        chosen.append(pivot)
        direction = rest[:, pivot] / size[pivot]
        rest = rest - direction[:, None] * (direction @ rest)
    return np.sort(np.array(chosen, dtype=np.int64))
