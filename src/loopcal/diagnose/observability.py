# SPDX-License-Identifier: Apache-2.0
"""The observability indices O1 to O5. Formulas and sources: docs/theory/observability.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.typing import FloatArray

SCALING = "rows divided by sigma, columns multiplied by tolerance"
"""Units of the singular values; every index depends on them."""

MEANING = {
    "o1": "(product of s)^(1/L) / sqrt(m): a small uncertainty ellipsoid",
    "o2": "smallest / largest: 1 / condition",
    "o3": "smallest: the worst direction",
    "o4": "smallest^2 / largest: noise amplification",
    "o5": "1 / sum(1/s): a small sum of semi-axes",
}


@dataclass(frozen=True)
class Observability:
    """The five indices over the L observable directions.

    Attributes
    ----------
    o1, o2, o3, o4, o5 : the larger the better. directions : L. left_out : number of null
        directions, which would make all five zero.
    equations : m. scaling : of rows and columns.
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float
    directions: int
    left_out: int
    equations: int
    scaling: str = SCALING

    def rows(self) -> list[tuple[str, float, str]]:
        """Return index, value and meaning, for a table."""
        return [(name.upper(), getattr(self, name), meaning) for name, meaning in MEANING.items()]

    def __str__(self) -> str:
        values = ", ".join(f"{name} {value:.3g}" for name, value, _ in self.rows())
        without = f", without {self.left_out} null directions" if self.left_out else ""
        counts = f"m = {self.equations}, L = {self.directions}{without}"
        return f"Observability: {values} ({self.scaling}; {counts})"


def compute_observability(singular_values: FloatArray, rank: int, equations: int) -> Observability:
    """Return the indices of the singular values of whitened rows in units of tolerance.

    Parameters
    ----------
    singular_values : (p,), descending. rank : how many of them count. equations : m, number of
        rows.

    Returns
    -------
    Observability; all indices are zero where the rank is zero.
    """
    s = singular_values[:rank]
    left_out = len(singular_values) - rank
    if rank == 0 or equations == 0:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0, 0, left_out, equations)
    return Observability(
        o1=float(np.exp(np.log(s).mean()) / np.sqrt(equations)),
        o2=float(s[-1] / s[0]),
        o3=float(s[-1]),
        o4=float(s[-1] ** 2 / s[0]),
        o5=float(1.0 / (1.0 / s).sum()),
        directions=rank,
        left_out=left_out,
        equations=equations,
    )
