# SPDX-License-Identifier: Apache-2.0
"""Estimation methods: each says how much it penalizes every direction of the decomposition.

With singular values s_i of the whitened, tolerance-scaled matrix and projections c_i = u_i'b of the
total deviation, the estimate is z = sum_i f_i (c_i / s_i) v_i with the filter factors f_i = s_i^2 /
(s_i^2 + penalty_i):

    LeastSquares               0 up to the numerical rank, infinite beyond it
    TruncatedSVD(k)            0 up to k, infinite beyond it
    Ridge(lam)                 lam everywhere, or one lam per parameter (0: unpenalized)
    MAP()                      1: tolerances are standard deviations of a Gaussian prior
    MAP(InflatedTolerances())  the default: the same, with inflated tolerances where the data
                               contradict them

The penalty acts on the total deviation from nominal in units of tolerance, never on the step, so
the answer does not depend on the number of iterations. A new method is one more class here. See
docs/theory/estimation.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.residual_test import FEWEST_DEGREES
from loopcal.estimate.methods.inflated_tolerances import InflatedTolerances
from loopcal.estimate.methods.tolerance_components import (
    ToleranceComponent,
    compute_prior_covariance,
    compute_symmetric_root,
)
from loopcal.numerics.decomposition import RANK_TOLERANCE, Decomposition, decompose
from loopcal.typing import BoolArray, FloatArray, IntArray

Rule = Callable[[Decomposition], FloatArray | IntArray]
"""Choose one number per trial, (t,), from a decomposition; see
`loopcal.estimate.methods.regularization_rules`.
"""


class Method(Protocol):
    """The interface of a method, with what most methods do."""

    def required_equations(self, parameters: int) -> int:
        """Return how many equations the method needs for this many parameters."""
        ...

    def unpenalized(self, parameters: int) -> BoolArray | None:
        """Return which parameters (p,) are never penalized; None where all are treated alike."""
        return None

    def scale(self, parameters: int) -> FloatArray | None:
        """Return factors (p,) for the tolerance-scaled columns; None for ones."""
        return None

    def root(self, parameters: int) -> FloatArray | None:
        """Return the root (p, p) of the correlation of the scaled columns; None where the method
        takes them as independent.
        """
        return None

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return the penalty (t, p) of each direction; infinite where it is not used."""
        ...

    def prior_variance(
        self, decomposition: Decomposition, penalty: FloatArray, free: FreeParameters
    ) -> FloatArray | None:
        """Return the variance (t, p) of the true coordinates about nominal, from which the bias of
        the penalty is expected; NaN where it is not known. None stands for 1 / penalty.
        """
        return None


@dataclass(frozen=True)
class LeastSquares(Method):
    """Least squares with rank detection.

    Null directions get the smallest total deviation, in tolerances.

    Examples
    --------
    >>> LeastSquares()
    LeastSquares()
    """

    def required_equations(self, parameters: int) -> int:
        """Return the number of parameters."""
        return parameters

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return 0 for singular values within the numerical rank, infinity for the others."""
        return np.where(decomposition.used, 0.0, np.inf)


@dataclass(frozen=True)
class TruncatedSVD(Method):
    """Least squares over the k strongest directions; the others keep their nominal value.

    Parameters
    ----------
    k : number of directions, or a rule that chooses it. Directions beyond the numerical rank are
        never used.

    Raises
    ------
    EstimationError : k is negative or no integer.
    """

    k: int | Rule

    def __post_init__(self) -> None:
        if not callable(self.k) and (not isinstance(self.k, int | np.integer) or self.k < 0):
            raise EstimationError(
                f"truncation at k = {self.k}: k is a number of directions; give an integer >= 0, "
                "or a rule such as TruncationGCV()"
            )

    def required_equations(self, parameters: int) -> int:
        """Return 0: directions without data keep their nominal value."""
        return 0

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return 0 for the first k directions within the rank, infinity for the others."""
        k = _apply_rule(self.k, decomposition) if callable(self.k) else np.atleast_1d(self.k)
        first = np.arange(decomposition.singular_values.shape[1]) < k[:, None]
        return np.where(first & decomposition.used, 0.0, np.inf)


@dataclass(frozen=True)
class Ridge(Method):
    """Tikhonov regularization: the sum of squares plus lam |z|^2.

    z is the total deviation from nominal in tolerances.

    Parameters
    ----------
    lam : a number, one number per free parameter in the order of the parameter table (0 for an
        unpenalized one), or a rule that chooses one number.

    Raises
    ------
    EstimationError : lam is negative or not finite.
    """

    lam: float | tuple[float, ...] | Rule

    def __post_init__(self) -> None:
        if callable(self.lam):
            return
        values = np.asarray(self.lam, dtype=np.float64)
        if values.ndim > 1 or not np.all(np.isfinite(values)) or np.any(values < 0.0):
            raise EstimationError(
                f"ridge with lam = {self.lam}: give a finite number >= 0, one per parameter, or a "
                "rule such as GCV()"
            )
        if values.ndim == 1:
            object.__setattr__(self, "lam", tuple(float(v) for v in values))

    def required_equations(self, parameters: int) -> int:
        """Return the number of unpenalized parameters."""
        if isinstance(self.lam, tuple):
            return sum(value == 0.0 for value in self.lam)
        return parameters if self.lam == 0.0 else 0

    def unpenalized(self, parameters: int) -> BoolArray | None:
        """Return which parameters have lam = 0, where there is one lam per parameter."""
        if isinstance(self.lam, tuple) and 0.0 in self.lam:
            return np.array(self.lam) == 0.0
        return None

    def scale(self, parameters: int) -> FloatArray | None:
        """Return 1 / sqrt(lam) for one lam per parameter.

        Penalty 1 on the rescaled deviation is lam on the original one.
        """
        if not isinstance(self.lam, tuple):
            return None
        if len(self.lam) != parameters:
            raise EstimationError(
                f"ridge with {len(self.lam)} values of lam for {parameters} free parameters: give "
                "one value per parameter"
            )
        lam = np.asarray(self.lam)
        return 1.0 / np.sqrt(np.where(lam > 0.0, lam, 1.0))

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return lam for every direction; with lam = 0 directions beyond the rank are not used."""
        lam = 1.0 if isinstance(self.lam, tuple) else self.lam
        values = _apply_rule(lam, decomposition) if callable(lam) else np.atleast_1d(lam)
        return _penalize(decomposition, values)

    def prior_variance(
        self, decomposition: Decomposition, penalty: FloatArray, free: FreeParameters
    ) -> FloatArray | None:
        """Return the variance of the true coordinates if the stated tolerances are right: 1 in
        tolerances, whatever lam is.

        It is NaN where a penalized parameter has no stated tolerance, where the tolerances are
        correlated, or where different parameters have different lam: then the coordinates are
        correlated.
        """
        lam = np.array(self.lam if isinstance(self.lam, tuple) else [1.0])
        penalized = lam[lam > 0.0]
        is_known = (
            free.correlation is None
            and not self.lacks_tolerances(free).any()
            and (penalized == penalized[:1]).all()
        )
        return np.full(penalty.shape, penalized.max(initial=0.0) if is_known else np.nan)

    def lacks_tolerances(self, free: FreeParameters) -> BoolArray:
        """Return which parameters (p,) are penalized without a stated tolerance."""
        lam = 1.0 if callable(self.lam) else np.asarray(self.lam)
        return np.asarray(free.assumed & np.broadcast_to(lam > 0.0, free.assumed.shape))


@dataclass(frozen=True)
class MAP(Method):
    """Maximum a posteriori: each tolerance is the standard deviation of a Gaussian prior.

    This is ridge with lam = 1. Directions that the data do not determine keep their prior. A
    parameter without a stated tolerance is not penalized.

    Parameters
    ----------
    inflation : factor on all tolerances, or a rule that chooses it, such as `InflatedTolerances()`.
    free : (p,) parameters that are not penalized; `identify` enters those without a stated
        tolerance.
    noise : "given": the rows are divided by their true sigma. "estimated": by their true sigma up
        to one common factor. The factor is estimated from the part of the data that no parameters
        can explain, so that data and prior get their right weights.
    correlation : (p, p) of the deviations from nominal; `identify` enters the one of the common
        errors that the robot states. None takes the tolerances as independent.
    components : parts of the tolerances that are wider than stated; `identify` enters those that
        `InflatedTolerances` chose.

    Raises
    ------
    EstimationError : inflation is not positive and finite.
    """

    inflation: float | Rule = 1.0
    free: tuple[bool, ...] = ()
    noise: Literal["given", "estimated"] = "given"
    correlation: FloatArray | None = field(default=None, repr=False, compare=False)
    components: tuple[ToleranceComponent, ...] = ()

    def __post_init__(self) -> None:
        if not callable(self.inflation) and not 0.0 < self.inflation < np.inf:
            raise EstimationError(
                f"tolerances times {self.inflation}: give a finite factor above 0, or a rule such "
                "as InflatedTolerances()"
            )

    def required_equations(self, parameters: int) -> int:
        """Return the number of unpenalized parameters."""
        return sum(self.free)

    def unpenalized(self, parameters: int) -> BoolArray | None:
        """Return which parameters are not penalized."""
        return np.array(self.free) if any(self.free) else None

    def root(self, parameters: int) -> FloatArray | None:
        """Return the symmetric root of the covariance of the deviations, in tolerances."""
        if self.correlation is None and not self.components:
            return None
        covariance = compute_prior_covariance(parameters, self.correlation, self.components)
        return compute_symmetric_root(covariance)

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return sigma^2 / inflation^2, with sigma = 1 where the noise is given."""
        factor = self.sigma(decomposition) / self.compute_inflation(decomposition)
        return _penalize(decomposition, factor**2)

    def compute_inflation(self, decomposition: Decomposition) -> FloatArray:
        """Return the factor (t,) on all tolerances."""
        rule = self.inflation
        if not callable(rule):
            return np.full(len(decomposition.rows), rule)
        return _apply_rule(rule, decomposition.divided(self.sigma(decomposition)))

    def read_inflation(self, decomposition: Decomposition, penalty: FloatArray) -> FloatArray:
        """Return the factor (t,) on all tolerances that the penalty (t, p) of a fit contains; 1
        where no direction is penalized.
        """
        is_penalized = np.isfinite(penalty) & (penalty > 0.0)
        largest = np.where(is_penalized, penalty, 0.0).max(axis=1, initial=0.0)
        root = np.sqrt(np.where(largest > 0.0, largest, 1.0))
        return np.where(largest > 0.0, self.sigma(decomposition) / root, 1.0)

    def prior_variance(
        self, decomposition: Decomposition, penalty: FloatArray, free: FreeParameters
    ) -> FloatArray | None:
        """Return inflation^2, which an estimated noise does not change."""
        if self.noise == "given":
            return None
        square = self.sigma(decomposition)[:, None] ** 2
        return np.divide(square, penalty, out=np.zeros_like(penalty), where=penalty > 0.0)

    def sigma(self, decomposition: Decomposition) -> FloatArray:
        """Return the factor (t,) on the stated sigmas.

        It is 1 where fewer than FEWEST_DEGREES degrees of freedom are left to estimate it.
        """
        if self.noise == "given":
            return np.ones_like(decomposition.outside)
        left = decomposition.rows - decomposition.rank
        enough = (left >= FEWEST_DEGREES) & (decomposition.unexplained > 0.0)
        return np.sqrt(np.where(enough, decomposition.unexplained / np.maximum(left, 1), 1.0))


def _apply_rule(rule: Rule, decomposition: Decomposition) -> FloatArray:
    """Return what a rule chooses, (t,) or (1,); EstimationError where it is no number of that."""
    value = np.atleast_1d(np.asarray(rule(decomposition), dtype=np.float64))
    trials = len(decomposition.singular_values)
    if value.shape not in {(1,), (trials,)} or not np.all(np.isfinite(value) & (value >= 0.0)):
        name = getattr(rule, "__name__", type(rule).__name__)
        raise EstimationError(
            f"the rule {name} returned {np.array2string(value, threshold=6)} for {trials} fits; "
            "return one finite number of at least 0 for each fit, as an array (t,)"
        )
    return value


def _penalize(decomposition: Decomposition, lam: FloatArray) -> FloatArray:
    """Return the penalty (t, p): lam (t,) or (1,) for all directions but unpenalized ones.

    Unpenalized directions get 0 within the numerical rank and infinity beyond it.
    """
    free = np.where(decomposition.used, 0.0, np.inf)
    penalty = np.where(lam[:, None] > 0.0, lam[:, None], free)
    if decomposition.unpenalized is None:
        return penalty
    return np.where(decomposition.unpenalized, free, penalty)


def decompose_for(
    method: Method,
    factor: FloatArray,
    equations: IntArray,
    deviation: FloatArray,
    tolerance: float = RANK_TOLERANCE,
) -> Decomposition:
    """Decompose the factor of linearized rows in the coordinates that a method penalizes.

    Parameters
    ----------
    factor : (t, p + 1, p + 1), columns scaled by tolerance. equations : (t,) that were folded.
    deviation : (t, p) where the rows were linearized. tolerance : relative rank tolerance.
    """
    p = deviation.shape[1]
    return decompose(
        factor,
        equations,
        deviation,
        method.scale(p),
        tolerance,
        method.unpenalized(p),
        method.root(p),
    )


def adapt_method(
    method: Method | None,
    assumed: BoolArray,
    noise: Literal["given", "estimated"],
    correlation: FloatArray | None = None,
) -> Method:
    """Return the method of a fit: the default where it is None; MAP with what it must know.

    Parameters
    ----------
    assumed : (p,) free parameters whose tolerance is not stated. noise : see `FitOptions`.
    correlation : (p, p) of the deviations, where the robot states common errors.
    """
    method = MAP(InflatedTolerances()) if method is None else method
    if not isinstance(method, MAP):
        return method
    free = method.free or (tuple(assumed.tolist()) if assumed.any() else ())
    correlation = correlation if method.correlation is None else method.correlation
    return replace(method, free=free, noise=noise, correlation=correlation)
