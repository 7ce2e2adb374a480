# SPDX-License-Identifier: Apache-2.0
"""The penalty of a method as rows beside the measured ones, where it does not depend on these."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.estimate.methods.penalties import MAP, LeastSquares, Method, Ridge
from loopcal.typing import FloatArray


class FixedPenalty(NamedTuple):
    """The penalty of a method that does not depend on the rows: |P z|^2 is added to their sum of
    squares.

    Attributes
    ----------
    unit : (p, p) S with z = S u, where the method filters the coordinates u; (p,) if S is diagonal,
        None if it is 1.
    rows : (k, p) P S, one row for each penalized coordinate; k = 0 where nothing is penalized.
    matrix : (k, p) P.
    """

    unit: FloatArray | None
    rows: FloatArray
    matrix: FloatArray

    @property
    def is_triangular(self) -> bool:
        """Whether R S is triangular for every triangular R."""
        return self.unit is None or self.unit.ndim == 1

    def scale_columns(self, triangle: FloatArray) -> FloatArray:
        """Return R S for R (t, p, p)."""
        if self.unit is None:
            return triangle
        return triangle * self.unit if self.unit.ndim == 1 else triangle @ self.unit

    def to_deviation(self, coordinates: FloatArray) -> FloatArray:
        """Return S u, (t, p), of u (t, p)."""
        if self.unit is None:
            return coordinates
        if self.unit.ndim == 1:
            return coordinates * self.unit
        return np.matmul(self.unit, coordinates[:, :, None])[:, :, 0]

    def evaluate(self, deviation: FloatArray) -> FloatArray:
        """Return P z (t, k) of deviations z (t, p)."""
        return np.matmul(self.matrix, deviation[:, :, None])[:, :, 0]


def fix_penalty(method: Method, parameters: int) -> FixedPenalty | None:
    """Return the penalty of a method for p parameters where it does not depend on the rows."""
    value = _find_fixed_penalty(method)
    if value is None:
        return None
    scale, root = method.scale(parameters), method.root(parameters)
    unpenalized = method.unpenalized(parameters)
    is_penalized = np.full(parameters, value > 0.0)
    if unpenalized is not None:
        is_penalized &= ~unpenalized
    rows = np.sqrt(value) * np.eye(parameters)[is_penalized]
    matrix, unit = rows, scale
    if root is not None:
        matrix = np.linalg.solve(root.T, rows.T).T
        unit = root if scale is None else scale[:, None] * root
    if scale is not None:
        matrix = matrix / scale
    return FixedPenalty(unit, rows, matrix)


def _find_fixed_penalty(method: Method) -> float | None:
    """Return the penalty of all penalized directions where the method states it, which is 0 for
    least squares; None where the method chooses it from the decomposition.

    Of another class, which may inherit from these, only its penalties of decompositions are known.
    """
    if type(method) is LeastSquares:
        return 0.0
    if type(method) is Ridge and not callable(method.lam):
        return 1.0 if isinstance(method.lam, tuple) else float(method.lam)
    if type(method) is MAP and not callable(method.inflation) and method.noise == "given":
        return 1.0 / method.inflation**2
    return None
