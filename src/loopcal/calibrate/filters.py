# SPDX-License-Identifier: Apache-2.0
"""Estimation methods as small values: each says how much it penalises every direction of the one decomposition.

With singular values s_i of the whitened, tolerance-scaled matrix and the projections c_i = u_i'b of the total
deviation, every method here is z = sum_i f_i (c_i / s_i) v_i with f_i = s_i^2 / (s_i^2 + penalty_i):

    LeastSquares     penalty 0 up to the numerical rank, infinite beyond it: the smallest total deviation there
    TruncatedSVD(k)  penalty 0 up to k, infinite beyond it
    Ridge(lam)       penalty lam everywhere (or one lam per parameter)
    MAP()            penalty 1: the tolerances are the standard deviations of a Gaussian prior

What is penalised is the total deviation from nominal in units of tolerance, never the step, so the answer does not
depend on the number of iterations. A new method is one more class here. See docs/theory/estimation.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from loopcal.errors import EstimationError
from loopcal.linalg import Decomposition, FloatArray, IntArray

Rule = Callable[[Decomposition], FloatArray | IntArray]
"""Chooses one number per trial, (t,), from a decomposition; see `loopcal.calibrate.rules`."""


class Method(Protocol):
    """What the descent asks of a method."""

    @property
    def has_prior(self) -> bool:
        """Whether the method can estimate more parameters than there are equations."""
        ...

    def scale(self, parameters: int) -> FloatArray | None:
        """Return factors (p,) for the tolerance-scaled columns, or None for ones."""
        ...

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return the penalty (t, p) of each direction; infinite where the direction is not used."""
        ...


@dataclass(frozen=True)
class LeastSquares:
    """Least squares with rank detection; along null directions the smallest total deviation, in tolerances.

    Examples
    --------
    >>> LeastSquares()
    LeastSquares()
    """

    has_prior = False

    def scale(self, parameters: int) -> None:
        """No factors: the columns stay scaled by tolerance."""

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Zero where the singular value counts, infinite where it does not."""
        return np.where(decomposition.used, 0.0, np.inf)


@dataclass(frozen=True)
class TruncatedSVD:
    """Least squares over the k strongest directions; the others keep their nominal value.

    Parameters
    ----------
    k : number of directions, or a rule that chooses it. Directions beyond the numerical rank are never used.

    Raises
    ------
    EstimationError
        k is negative.
    """

    k: int | Rule
    has_prior = True

    def __post_init__(self) -> None:
        if not callable(self.k) and self.k < 0:
            raise EstimationError(f"truncation at k = {self.k}: k counts directions; give 0 or more, or a rule")

    def scale(self, parameters: int) -> None:
        """No factors: the columns stay scaled by tolerance."""

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Zero for the first k directions that count, infinite for the others."""
        k = np.atleast_1d(np.asarray(self.k(decomposition) if callable(self.k) else self.k))
        first = np.arange(decomposition.singular_values.shape[1]) < k[:, None]
        return np.where(first & decomposition.used, 0.0, np.inf)


@dataclass(frozen=True)
class Ridge:
    """Tikhonov: lam |z|^2 is added, z the total deviation from nominal in tolerances.

    Parameters
    ----------
    lam : a number, one number per free parameter (in the order of the parameter table), or a rule that chooses one.

    Raises
    ------
    EstimationError
        lam is negative, not finite, or zero for some parameters only.
    """

    lam: float | tuple[float, ...] | Rule
    has_prior = True

    def __post_init__(self) -> None:
        if callable(self.lam):
            return
        values = np.asarray(self.lam, dtype=np.float64)
        if values.ndim > 1 or not np.all(np.isfinite(values)) or np.any(values < 0.0):
            raise EstimationError(f"ridge with lam = {self.lam}: give a finite number >= 0, one per parameter, or a rule")
        if values.ndim == 1:
            if np.any(values == 0.0):
                raise EstimationError("ridge with lam = 0 for a single parameter: give each parameter a positive lam")
            object.__setattr__(self, "lam", tuple(float(v) for v in values))

    def scale(self, parameters: int) -> FloatArray | None:
        """1 / sqrt(lam) for one lam per parameter: penalty 1 on the rescaled deviation is lam on the original."""
        if not isinstance(self.lam, tuple):
            return None
        if len(self.lam) != parameters:
            raise EstimationError(f"ridge with {len(self.lam)} values of lam for {parameters} free parameters: give one each")
        return 1.0 / np.sqrt(np.asarray(self.lam))

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return lam for every direction; where lam is 0, a direction that does not count is not used."""
        lam = 1.0 if isinstance(self.lam, tuple) else self.lam
        lam = np.atleast_1d(np.asarray(lam(decomposition) if callable(lam) else lam, dtype=np.float64))
        return np.where((lam[:, None] > 0.0) | decomposition.used, lam[:, None], np.inf)


@dataclass(frozen=True)
class MAP:
    """Most probable parameters when each tolerance is the standard deviation of a Gaussian prior: ridge with lam = 1.

    The rows must be divided by their true sigma. What the data cannot tell keeps its prior.
    """

    has_prior = True

    def scale(self, parameters: int) -> None:
        """No factors: the columns stay scaled by tolerance."""

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """One for every direction."""
        return np.ones_like(decomposition.singular_values)
