# SPDX-License-Identifier: Apache-2.0
"""Estimation methods as small values: each says how much it penalises every direction of the one
decomposition.

With singular values s_i of the whitened, tolerance-scaled matrix and the projections c_i = u_i'b of
the total deviation, every method here is z = sum_i f_i (c_i / s_i) v_i with f_i = s_i^2 / (s_i^2 +
penalty_i):

    LeastSquares     penalty 0 up to the numerical rank, infinite beyond it: the smallest total deviation there
    TruncatedSVD(k)  penalty 0 up to k, infinite beyond it
    Ridge(lam)       penalty lam everywhere, or one lam per parameter, zero for those that are not held back
    MAP()            penalty 1: the tolerances are the standard deviations of a Gaussian prior; none where none is stated
    MAP(InflatedTolerances())   the default: the same, with all tolerances widened where the data contradict them

What is penalised is the total deviation from nominal in units of tolerance, never the step, so the
answer does not depend on the number of iterations. A new method is one more class here. See
docs/theory/estimation.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.inference.residual_test import FEWEST_DEGREES
from loopcal.estimate.methods.prior_conflict import InflatedTolerances
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import BoolArray, FloatArray, IntArray

Rule = Callable[[Decomposition], FloatArray | IntArray]
"""Chooses one number per trial, (t,), from a decomposition; see
`loopcal.estimate.methods.regularization_rules`.
"""


class Method(Protocol):
    """What the descent asks of a method."""

    def needs(self, parameters: int) -> int:
        """Return how many equations the method needs: the number of parameters without anything
        else to hold them.
        """
        ...

    def flat(self, parameters: int) -> BoolArray | None:
        """Return which parameters (p,) are never penalised, or None where the method does not tell
        them apart.
        """
        ...

    def scale(self, parameters: int) -> FloatArray | None:
        """Return factors (p,) for the tolerance-scaled columns, or None for ones."""
        ...

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return the penalty (t, p) of each direction; infinite where the direction is not used."""
        ...


@dataclass(frozen=True)
class LeastSquares:
    """Least squares with rank detection; along null directions the smallest total deviation, in
    tolerances.

    Examples
    --------
    >>> LeastSquares()
    LeastSquares()
    """

    def needs(self, parameters: int) -> int:
        """Return as many as there are parameters."""
        return parameters

    def flat(self, parameters: int) -> None:
        """All parameters are alike."""

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
    k : number of directions, or a rule that chooses it. Directions beyond the numerical rank are
        never used.

    Raises
    ------
    EstimationError
        k is negative, or no integer.
    """

    k: int | Rule

    def __post_init__(self) -> None:
        if not callable(self.k) and (not isinstance(self.k, int | np.integer) or self.k < 0):
            raise EstimationError(
                f"truncation at k = {self.k}: k counts directions; give an integer, 0 or more, or "
                "a rule"
            )

    def needs(self, parameters: int) -> int:
        """Return 0: directions without data keep their nominal value."""
        return 0

    def flat(self, parameters: int) -> None:
        """All parameters are alike."""

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
    lam : a number, one number per free parameter (in the order of the parameter table; 0 for one
        that is not held back), or a rule that chooses one.

    Raises
    ------
    EstimationError
        lam is negative or not finite.
    """

    lam: float | tuple[float, ...] | Rule

    def __post_init__(self) -> None:
        if callable(self.lam):
            return
        values = np.asarray(self.lam, dtype=np.float64)
        if values.ndim > 1 or not np.all(np.isfinite(values)) or np.any(values < 0.0):
            raise EstimationError(
                f"ridge with lam = {self.lam}: give a finite number >= 0, one per parameter, or a "
                "rule"
            )
        if values.ndim == 1:
            object.__setattr__(self, "lam", tuple(float(v) for v in values))

    def needs(self, parameters: int) -> int:
        """Return the number of parameters that are not held back."""
        if isinstance(self.lam, tuple):
            return sum(value == 0.0 for value in self.lam)
        return parameters if self.lam == 0.0 else 0

    def flat(self, parameters: int) -> BoolArray | None:
        """Return where lam is 0, for one lam per parameter."""
        return (
            np.array(self.lam) == 0.0 if isinstance(self.lam, tuple) and 0.0 in self.lam else None
        )

    def scale(self, parameters: int) -> FloatArray | None:
        """1 / sqrt(lam) for one lam per parameter: penalty 1 on the rescaled deviation is lam on
        the original.
        """
        if not isinstance(self.lam, tuple):
            return None
        if len(self.lam) != parameters:
            raise EstimationError(
                f"ridge with {len(self.lam)} values of lam for {parameters} free parameters: give "
                "one each"
            )
        lam = np.asarray(self.lam)
        return 1.0 / np.sqrt(np.where(lam > 0.0, lam, 1.0))

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return lam for every direction; where lam is 0, a direction that does not count is not
        used.
        """
        lam = 1.0 if isinstance(self.lam, tuple) else self.lam
        lam = np.atleast_1d(
            np.asarray(lam(decomposition) if callable(lam) else lam, dtype=np.float64)
        )
        return _held(decomposition, lam)


@dataclass(frozen=True)
class MAP:
    """Most probable parameters when each tolerance is the standard deviation of a Gaussian prior:
    ridge with lam = 1.

    What the data cannot tell keeps its prior. A parameter without a stated tolerance is not held
    back.

    Parameters
    ----------
    spread : factor on all tolerances, or a rule that chooses it, such as `InflatedTolerances()`.
    free : (p,) parameters that are not held back; `identify` puts in those without a stated
        tolerance.
    noise : "given": the rows are divided by their true sigma; "estimated": true up to one factor,
        which is estimated from what no parameters could explain, so that data and prior are weighed
        against each other rightly.

    Raises
    ------
    EstimationError
        spread is not positive and finite.
    """

    spread: float | Rule = 1.0
    free: tuple[bool, ...] = ()
    noise: Literal["given", "estimated"] = "given"

    def __post_init__(self) -> None:
        if not callable(self.spread) and not 0.0 < self.spread < np.inf:
            raise EstimationError(
                f"tolerances times {self.spread}: give a finite factor above 0, or a rule"
            )

    def needs(self, parameters: int) -> int:
        """Return the number of parameters that are not held back."""
        return sum(self.free)

    def flat(self, parameters: int) -> BoolArray | None:
        """Return the parameters that are not held back."""
        return np.array(self.free) if any(self.free) else None

    def scale(self, parameters: int) -> None:
        """No factors: the columns stay scaled by tolerance."""

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return sigma^2 / spread^2, sigma = 1 where the noise is given."""
        sigma = self.sigma(decomposition)
        spread = self.spread(decomposition.divided(sigma)) if callable(self.spread) else self.spread
        return _held(decomposition, (sigma / spread) ** 2)

    def sigma(self, decomposition: Decomposition) -> FloatArray:
        """Return the factor (t,) on the stated sigmas that is used; 1 where too little is left over
        to estimate it.
        """
        if self.noise == "given":
            return np.ones_like(decomposition.outside)
        left = decomposition.rows - decomposition.rank
        enough = (left >= FEWEST_DEGREES) & (decomposition.unexplained > 0.0)
        return np.sqrt(np.where(enough, decomposition.unexplained / np.maximum(left, 1), 1.0))


def _held(decomposition: Decomposition, lam: FloatArray) -> FloatArray:
    """Return lam (t,) or (1,) for all directions but flat ones: those are free where the data see
    them, else not used.
    """
    free = np.where(decomposition.used, 0.0, np.inf)
    held = np.where(lam[:, None] > 0.0, lam[:, None], free)
    return held if decomposition.flat is None else np.where(decomposition.flat, free, held)


def adapt_method(
    method: Method | None, assumed: BoolArray, noise: Literal["given", "estimated"]
) -> Method:
    """Return the method for a robot and its data: the default where there is none, and what MAP
    must know.

    Parameters
    ----------
    assumed : (p,) free parameters whose tolerance is not stated. noise : see `identify`.
    """
    method = MAP(InflatedTolerances()) if method is None else method
    if not isinstance(method, MAP):
        return method
    free = method.free or (tuple(assumed.tolist()) if assumed.any() else ())
    return replace(method, free=free, noise=noise)
