# SPDX-License-Identifier: Apache-2.0
"""Directions that the data cannot tell, as named combinations of parameters and as words.

A basis of the null space is turned into its sparsest readable form, one leading parameter a
combination, by elimination with pivoting; coefficients are displacements in the units of the
robot's file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.typing import FloatArray

NEGLIGIBLE = 1e-6
"""Part of a combination, in tolerances and relative to its largest, that is rounding and not shown.
"""

MINOR = 0.1
"""The same for a direction that is weak but not null, which has a small part of nearly every
parameter.
"""

SHOWN, SHOWN_WEAK = 8, 4
"""Parameters written out in the words of a combination, and of one that is only weak; the others
are counted.
"""

EQUAL = 1e-6
"""Relative difference of changes that are called equal parts."""


@dataclass(frozen=True, eq=False)
class Combination:
    """Parameters that, changed together like this, change nothing that was measured, or hardly
    anything.

    Attributes
    ----------
    names : (k,) strongest first. changes : (k,) displacements that belong together, in `units`
        (symbols).
    weights : (k,) the same in tolerances, of length one over all parameters.
    singular_value : what one tolerance along the direction changes, in standard deviations of the
        noise; 0 for a null one.
    meaning : what the robot does with such a change, in words; empty where there is nothing to say.
    """

    names: tuple[str, ...]
    changes: FloatArray
    units: tuple[str, ...]
    weights: FloatArray = field(default_factory=lambda: np.zeros(0))
    singular_value: float = 0.0
    meaning: str = ""

    def __str__(self) -> str:
        rest = f": {self.meaning}" if self.meaning else ""
        several = len(self.names) > 1
        if self.singular_value > 0.0:
            shows = (
                f"one tolerance shows as {self.singular_value:.2g} standard deviations of the noise"
            )
            return (
                f"together {self.parts}: {shows}" if several else f"{self.names[0]} alone: {shows}"
            )
        if several:
            return f"together {self.parts} change nothing that was measured{rest}"
        return f"{self.names[0]} alone changes nothing that was measured{rest}"

    @property
    def parts(self) -> str:
        """The parameters and how much of each: in equal parts, or each with its change."""
        signs = np.sign(self.changes)
        if len(set(self.units)) == 1 and (np.abs(np.abs(self.changes) - 1.0) < EQUAL).all():
            names = [n if s > 0 else f"minus {n}" for n, s in zip(self.names, signs, strict=True)]
            return f"{listed(names)}, in equal parts,"
        parts = [
            f"{n} {c:+.4g} {u}"
            for n, c, u in zip(self.names, self.changes, self.units, strict=True)
        ]
        return listed(parts, SHOWN if self.singular_value == 0.0 else SHOWN_WEAK)

    def to_dict(self) -> dict[str, object]:
        """All attributes by name, and the sentence."""
        numbers = {
            "changes": self.changes.tolist(),
            "units": list(self.units),
            "weights": self.weights.tolist(),
        }
        words = {
            "singular_value": self.singular_value,
            "meaning": self.meaning,
            "sentence": str(self),
        }
        return {"names": list(self.names), **numbers, **words}


def listed(words: list[str] | tuple[str, ...], most: int = SHOWN) -> str:
    """Words in a sentence, `a, b and c`; those beyond `most` are counted."""
    if len(words) > most:
        return f"{', '.join(words[:most])} and {len(words) - most} more"
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else "".join(words)


def describe_null_space(
    unknowns: FreeParameters, null_space: FloatArray
) -> tuple[Combination, ...]:
    """Return the combinations that span a null space (p, d) of deviations in tolerances."""
    return tuple(
        describe_direction(unknowns, direction) for direction in sparsify_basis(null_space)
    )


def describe_direction(
    unknowns: FreeParameters, direction: FloatArray, singular_value: float = 0.0
) -> Combination:
    """Return one direction (p,) of deviations in tolerances by names; small parts are left out."""
    factor, symbols = unknowns.display()
    size = np.abs(direction)
    chosen = np.flatnonzero(size > (MINOR if singular_value > 0.0 else NEGLIGIBLE) * size.max())
    # parts that differ by rounding stand in the order of the robot's parameters
    order = chosen[np.argsort(-np.round(size[chosen] / size.max(), 9), kind="stable")]
    changes = direction[order] * unknowns.tolerance[order] / factor[order]
    sign = np.sign(changes[0])
    return Combination(
        names=tuple(unknowns.names[i] for i in order),
        changes=changes / changes[0],
        units=tuple(symbols[i] for i in order),
        weights=sign * direction[order] / np.linalg.norm(direction),
        singular_value=singular_value,
    )


def sparsify_basis(null_space: FloatArray) -> FloatArray:
    """Return a basis (d, p) of the same space in which each vector has a parameter of its own."""
    d = null_space.shape[1]
    if d == 0:
        return np.zeros((0, len(null_space)))
    from scipy.linalg import lu_factor, lu_solve, qr

    *_, order = qr(null_space.T, mode="r", pivoting=True)
    pivots = np.sort(
        np.asarray(order)[:d]
    )  # a well-conditioned choice of leaders, in the order of the parameters
    return lu_solve(lu_factor(null_space[pivots].T), null_space.T)
