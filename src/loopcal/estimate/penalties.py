# SPDX-License-Identifier: Apache-2.0
"""Estimation methods: each says how much it penalizes every direction of the decomposition.

With singular values s_i of the whitened, tolerance-scaled matrix and projections c_i = u_i'b of the
total deviation, the estimate is z = sum_i f_i (c_i / s_i) v_i with the filter factors f_i = s_i^2 /
(s_i^2 + penalty_i):

    LeastSquares               0 up to the numerical rank, infinite beyond it
    TruncatedSVD(k)            0 up to k, infinite beyond it
    Ridge(lam)                 lam everywhere, or one lam per parameter (0: unpenalized)
    MAP()                      1: tolerances are standard deviations of a Gaussian prior
    MAP(InflatedTolerances())  the default: the same, with inflated spreads where the data
                               contradict them

The penalty acts on the total deviation from nominal in units of tolerance, never on the step, so
the answer does not depend on the number of iterations. A new method is one more class here, and
its line in `loopcal.estimate.methods`. See docs/theory/identification.md.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Protocol

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate import tolerance_components
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.residual_test import FEWEST_DEGREES
from loopcal.findings import Finding, report_finding
from loopcal.numerics.decomposition import RANK_TOLERANCE, Decomposition, decompose
from loopcal.parameters import match_names
from loopcal.typing import BoolArray, FloatArray, IntArray

Rule = Callable[[Decomposition], FloatArray | IntArray]
"""Choose one number per trial, (t,), from a decomposition."""


# Rules that choose the ridge parameter or the truncation from the decomposition itself.

# Grid points per factor of ten; around their minimum the criteria are flat over much more.
PER_DECADE = 16

LOWEST, HIGHEST = 1e-12, 1e4
"""Range of lam in units of the largest squared singular value: no effect to hardly any data."""


class _LowestScore:
    """A rule that chooses the ridge parameter lam of lowest score."""

    def score(self, decomposition: Decomposition, lam: FloatArray) -> FloatArray:
        """Return what is minimized (t,) at lam (t,)."""
        raise NotImplementedError

    def __call__(self, decomposition: Decomposition) -> FloatArray:
        """Return lam (t,) of the minimum of a parabola through the best point and its neighbors."""
        reference = _find_largest_square(decomposition)
        decades = np.log10(HIGHEST / LOWEST)
        grid = np.linspace(np.log10(LOWEST), np.log10(HIGHEST), int(PER_DECADE * decades) + 1)
        values = np.stack([self.score(decomposition, reference * 10.0**g) for g in grid])
        best = np.clip(np.argmin(values, axis=0), 1, len(grid) - 2)
        trial = np.arange(values.shape[1])
        low, middle, high = (values[best + shift, trial] for shift in (-1, 0, 1))
        curvature = low - 2.0 * middle + high
        with np.errstate(invalid="ignore"):
            safe = np.where(curvature > 0.0, curvature, 1.0)
            shift = np.where(curvature > 0.0, 0.5 * (low - high) / safe, 0.0)
        shift = np.clip(np.nan_to_num(shift), -1.0, 1.0)
        return reference * 10.0 ** (grid[best] + shift * (grid[1] - grid[0]))

    def is_limit(self, decomposition: Decomposition, lam: FloatArray) -> BoolArray:
        """Return which lam (t,) are within one grid point of an end of the range."""
        reference, point = _find_largest_square(decomposition), 10.0 ** (1.0 / PER_DECADE)
        return (lam <= LOWEST * reference * point) | (lam >= HIGHEST * reference / point)


@dataclass(frozen=True)
class GCV(_LowestScore):
    """Choose the ridge parameter that minimizes generalized cross-validation."""

    name: ClassVar[str] = "gcv"

    def score(self, decomposition: Decomposition, lam: FloatArray) -> FloatArray:
        """Return RSS / (m - sum f)^2 (t,) at lam (t,)."""
        penalty = np.broadcast_to(lam[:, None], decomposition.singular_values.shape)
        return _gcv(decomposition, penalty)


@dataclass(frozen=True)
class MarginalLikelihood(_LowestScore):
    """Choose the ridge parameter under which the whitened data are most probable."""

    name: ClassVar[str] = "marginal-likelihood"

    def score(self, decomposition: Decomposition, lam: FloatArray) -> FloatArray:
        """Return minus twice the log density of the data at lam (t,), up to a constant."""
        # directions of unpenalized parameters contain no information on lam
        unpenalized = decomposition.unpenalized
        counted = np.ones(1) if unpenalized is None else ~unpenalized
        square = decomposition.singular_values**2 * counted
        projected = decomposition.projections**2 * counted
        variance = 1.0 + square / lam[:, None]
        return (np.log(variance) + projected / variance).sum(axis=1)


@dataclass(frozen=True)
class TruncationGCV:
    """Choose the truncation k that minimizes generalized cross-validation."""

    name: ClassVar[str] = "truncation-gcv"

    def __call__(self, decomposition: Decomposition) -> IntArray:
        """Return k (t,)."""
        count = decomposition.singular_values.shape[1] + 1
        trials = np.ones(len(decomposition.singular_values))
        return np.argmin(
            np.stack([self.score(decomposition, k * trials) for k in range(count)]), axis=0
        )

    def score(self, decomposition: Decomposition, k: FloatArray) -> FloatArray:
        """Return RSS / (m - k)^2 (t,) at k (t,)."""
        order = np.arange(decomposition.singular_values.shape[1])
        kept = (order < k[:, None]) & decomposition.used
        return _gcv(decomposition, np.where(kept, 0.0, np.inf))


def _find_largest_square(decomposition: Decomposition) -> FloatArray:
    """Return the largest squared singular values (t,), never zero."""
    return np.maximum(decomposition.singular_values[:, 0] ** 2, np.finfo(np.float64).tiny)


def _gcv(decomposition: Decomposition, penalty: FloatArray) -> FloatArray:
    """Return generalized cross-validation (t,); infinite where no equation is left over."""
    left = decomposition.rows - decomposition.filter_factors(penalty).sum(axis=1)
    spare = left > 1e-6
    return np.where(
        spare, decomposition.remaining(penalty) / np.where(spare, left, 1.0) ** 2, np.inf
    )


# The methods.

# Standard deviation, in assumed spreads, of the prior that holds parameters without a stated
# tolerance: half a percent of the robot's size, and 5 mrad. With 10, the curvature of the residuals
# along weak combinations costs hundreds of steps; with 3, errors of five assumed spreads would
# be further than their standard deviation.
HOLD = 5.0
# Standard deviation of a combination, in assumed spreads, beyond which no descent is tried
# without that prior: a tenth of the robot's size, and 0.1 rad. Up to 27, most fits converge.
WEAKEST = 100.0


class Method(Protocol):
    """The interface of a method, with what most methods do.

    `what`: a few words about it, for the help of the command line.
    `has_prior`: whether it takes the stated spreads as standard deviations of a prior.
    `is_biased`: whether its penalty is neither nothing nor such a prior.
    """

    what: ClassVar[str] = ""
    has_prior: ClassVar[bool] = False
    is_biased: ClassVar[bool] = True

    def required_equations(self, parameters: int) -> int:
        """Return how many equations the method needs for this many parameters."""
        ...

    def unpenalized(self, parameters: int) -> BoolArray | None:
        """Return which parameters (p,) are never penalized; None where all are treated alike."""
        return None

    def root(self, parameters: int) -> FloatArray | None:
        """Return L (p, p) of z = L u, where the method penalizes u; None where it penalizes the
        deviations z, in spreads.
        """
        return None

    def find_weak(
        self, decomposition: Decomposition, limit: FloatArray | float = WEAKEST
    ) -> BoolArray:
        """Return the unpenalized directions (t, p) that the data determine, but with a standard
        deviation above a limit, (t,) in spreads, so that the method could hold them.
        """
        return np.zeros_like(decomposition.used)

    def hold(self) -> tuple[Method, ...]:
        """Return the methods that hold these directions, each for a fit that begins where the one
        before it ended.
        """
        return ()

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

    def lacks_tolerances(self, free: FreeParameters) -> BoolArray:
        """Return the parameters (p,) without whose stated spread that variance is not known."""
        return np.zeros_like(free.assumed)

    def choice(self) -> tuple[str, float | tuple[float, ...] | Rule] | None:
        """Return name and value of the number, or the rule, that regularizes; None without any."""
        return None


@dataclass(frozen=True)
class LeastSquares(Method):
    """Least squares with rank detection.

    Null directions get the smallest total deviation, in spreads.

    Examples
    --------
    >>> LeastSquares()
    LeastSquares()
    """

    name: ClassVar[str] = "least-squares"
    what: ClassVar[str] = "without expected spreads"
    is_biased: ClassVar[bool] = False

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
    k : number of directions, or a rule that chooses it, by default cross-validation. Directions
        beyond the numerical rank are never used.

    Raises
    ------
    EstimationError : k is negative or no integer.
    """

    name: ClassVar[str] = "truncated-svd"
    what: ClassVar[str] = "least squares over the strongest directions"
    k: int | Rule = TruncationGCV()

    def __post_init__(self) -> None:
        if not callable(self.k) and (not isinstance(self.k, int | np.integer) or self.k < 0):
            raise EstimationError(
                f"truncation at k = {self.k}: k is a number of directions. Give an integer >= 0, "
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

    def choice(self) -> tuple[str, int | Rule]:
        """Return the truncation."""
        return "k", self.k


@dataclass(frozen=True)
class Ridge(Method):
    """Tikhonov regularization: the sum of squares plus lam |z|^2.

    z is the total deviation from nominal in spreads.

    Parameters
    ----------
    lam : a number, one number per free parameter in the order of the parameter table (0 for an
        unpenalized one), numbers by name or pattern (see `resolve`), or a rule that chooses one
        number, by default cross-validation.

    Raises
    ------
    EstimationError : lam is negative or not finite.

    Examples
    --------
    >>> Ridge({"*": 0.01, "*.length": 1.0}).resolve(("leg1.length", "leg1.base.x"))
    Ridge(lam=(1.0, 0.01))
    """

    name: ClassVar[str] = "ridge"
    what: ClassVar[str] = "least squares with a penalty on deviations in prior sd"
    lam: float | tuple[float, ...] | Mapping[str, float] | Rule = GCV()

    def __post_init__(self) -> None:
        if callable(self.lam):
            return
        stated = list(self.lam.values()) if isinstance(self.lam, Mapping) else self.lam
        values = np.asarray(stated, dtype=np.float64)
        if values.ndim > 1 or not np.all(np.isfinite(values)) or np.any(values < 0.0):
            raise EstimationError(
                f"ridge with lam = {self.lam}: give a finite number >= 0, one per parameter, or a "
                "rule such as GCV()"
            )
        if values.ndim == 1 and not isinstance(self.lam, Mapping):
            object.__setattr__(self, "lam", tuple(float(v) for v in values))

    def resolve(self, names: Sequence[str]) -> Ridge:
        """Return this method with one number per free parameter of these names, where lam states
        numbers by name or pattern.

        The name or pattern with the most characters besides wildcards counts, the last of equal
        ones; parameters that none fits have 0. DataError for a pattern that no parameter has.
        """
        if not isinstance(self.lam, Mapping):
            return self
        lam = dict.fromkeys(names, 0.0)
        for pattern in sorted(self.lam, key=lambda text: len(re.sub(r"[*?]|\[.*?\]", "", text))):
            lam |= dict.fromkeys(match_names(names, pattern), float(self.lam[pattern]))
        return Ridge(tuple(lam.values()))

    @property
    def weights(self) -> float | tuple[float, ...] | Rule:
        """`lam`, with numbers by name resolved; EstimationError where they are not."""
        if isinstance(self.lam, Mapping):
            raise EstimationError(
                "ridge with lam by name needs the names of the parameters. Call resolve(names), or "
                "give it to identify"
            )
        return self.lam

    def required_equations(self, parameters: int) -> int:
        """Return the number of unpenalized parameters."""
        if isinstance(self.weights, tuple):
            return sum(value == 0.0 for value in self.weights)
        return parameters if self.weights == 0.0 else 0

    def unpenalized(self, parameters: int) -> BoolArray | None:
        """Return which parameters have lam = 0, where there is one lam per parameter."""
        if isinstance(self.weights, tuple) and 0.0 in self.weights:
            return np.array(self.weights) == 0.0
        return None

    def root(self, parameters: int) -> FloatArray | None:
        """Return diag(1 / sqrt(lam)) for one lam per parameter: penalty 1 on u is lam on z."""
        if not isinstance(self.weights, tuple):
            return None
        lam = np.asarray(self.weights)
        if len(lam) != parameters:
            raise EstimationError(
                f"ridge with {len(lam)} values of lam for {parameters} free parameters: give one "
                "value per parameter"
            )
        return np.diag(1.0 / np.sqrt(np.where(lam > 0.0, lam, 1.0)))

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return lam for every direction; with lam = 0 directions beyond the rank are not used."""
        lam = 1.0 if isinstance(self.weights, tuple) else self.weights
        values = _apply_rule(lam, decomposition) if callable(lam) else np.atleast_1d(lam)
        return _penalize(decomposition, values)

    def prior_variance(
        self, decomposition: Decomposition, penalty: FloatArray, free: FreeParameters
    ) -> FloatArray | None:
        """Return the variance of the true coordinates if the stated spreads are right: 1 in
        spreads, whatever lam is.

        It is NaN where a penalized parameter has no stated spread, where the spreads are
        correlated, or where different parameters have different lam: then the coordinates are
        correlated.
        """
        lam = np.array(self.weights if isinstance(self.weights, tuple) else [1.0])
        penalized = lam[lam > 0.0]
        is_known = (
            free.correlation is None
            and not self.lacks_tolerances(free).any()
            and (penalized == penalized[:1]).all()
        )
        return np.full(penalty.shape, penalized.max(initial=0.0) if is_known else np.nan)

    def lacks_tolerances(self, free: FreeParameters) -> BoolArray:
        """Return which parameters (p,) are penalized without a stated spread."""
        lam = 1.0 if callable(self.weights) else np.asarray(self.weights)
        return np.asarray(free.assumed & np.broadcast_to(lam > 0.0, free.assumed.shape))

    def choice(self) -> tuple[str, float | tuple[float, ...] | Rule]:
        """Return the ridge parameter."""
        return "lam", self.weights


@dataclass(frozen=True)
class MAP(Method):
    """Maximum a posteriori: each expected spread is the standard deviation of a Gaussian prior.

    This is ridge with lam = 1. Directions that the data do not determine keep their prior. A
    parameter without a stated spread is not penalized, unless it is held.

    Parameters
    ----------
    inflation : factor on all spreads, or a rule that chooses it, such as `InflatedTolerances()`.
    free : (p,) parameters that are not penalized; `identify` enters those without a stated
        spread.
    held : whether these have a prior nevertheless: HOLD times the tolerance that is assumed for
        them. `identify` enters it where the data determine some combination of them more weakly.
    noise : "given": the rows are divided by their true sigma. "estimated": by their true sigma up
        to one common factor. The factor is estimated from the part of the data that no parameters
        can explain, so that data and prior get their right weights.
    correlation : (p, p) of the deviations from nominal; `identify` enters the one of the common
        errors that the robot states. None takes the spreads as independent.
    components : parts of the spreads that are wider than stated; `identify` enters those that
        `InflatedTolerances` chose.

    Raises
    ------
    EstimationError : inflation is not positive and finite.
    """

    name: ClassVar[str] = "map"
    what: ClassVar[str] = "the expected spreads are a prior"
    has_prior: ClassVar[bool] = True
    is_biased: ClassVar[bool] = False
    inflation: float | Rule = 1.0
    free: tuple[bool, ...] = ()
    held: bool = False
    noise: Literal["given", "estimated"] = "given"
    correlation: FloatArray | None = field(default=None, repr=False, compare=False)
    components: tuple[tolerance_components.ToleranceComponent, ...] = ()

    def __post_init__(self) -> None:
        if not callable(self.inflation) and not 0.0 < self.inflation < np.inf:
            raise EstimationError(
                f"spreads times {self.inflation}: give a finite factor above 0, or a rule such "
                "as InflatedTolerances()"
            )

    def required_equations(self, parameters: int) -> int:
        """Return the number of unpenalized parameters."""
        return 0 if self.held else sum(self.free)

    def unpenalized(self, parameters: int) -> BoolArray | None:
        """Return which parameters are not penalized."""
        return np.array(self.free) if any(self.free) and not self.held else None

    def covariance(self, parameters: int) -> FloatArray | None:
        """Return the covariance (p, p) of the deviations in spreads, without components; None
        where they are independent, each with its spread.
        """
        if not self.held:
            return self.correlation
        covariance = tolerance_components.compute_prior_covariance(parameters, self.correlation, ())
        return covariance + np.diag(np.where(self.free, HOLD**2 - 1.0, 0.0))

    def root(self, parameters: int) -> FloatArray | None:
        """Return the symmetric root of the covariance of the deviations, in spreads."""
        covariance = self.covariance(parameters)
        if covariance is None and not self.components:
            return None
        covariance = tolerance_components.compute_prior_covariance(
            parameters, covariance, self.components
        )
        return tolerance_components.compute_symmetric_root(covariance)

    def find_weak(
        self, decomposition: Decomposition, limit: FloatArray | float = WEAKEST
    ) -> BoolArray:
        """Return the unpenalized directions whose standard deviation is above a limit."""
        d = decomposition
        if d.unpenalized is None:
            return super().find_weak(d)
        return d.unpenalized & d.used & (d.singular_values < (self.sigma(d) / limit)[:, None])

    def hold(self) -> tuple[MAP, ...]:
        """Return this method with a prior of the parameters without a stated tolerance: first with
        one that does not depend on the rows.
        """
        held = replace(self, held=True)
        return (replace(held, inflation=1.0), held) if callable(self.inflation) else (held,)

    def penalty(self, decomposition: Decomposition) -> FloatArray:
        """Return sigma^2 / inflation^2, with sigma = 1 where the noise is given."""
        sigma, inflation = self.sigma(decomposition), self.inflation
        if callable(inflation):
            inflation = _apply_rule(inflation, decomposition.divided(sigma))
        return _penalize(decomposition, (sigma / inflation) ** 2)

    def read_inflation(self, decomposition: Decomposition, penalty: FloatArray) -> FloatArray:
        """Return the factor (t,) on all spreads that the penalty (t, p) of a fit contains; 1
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
    """Decompose the factor (t, p + 1, p + 1) of rows that were linearized at deviations (t, p), in
    the coordinates that a method penalizes.
    """
    p = deviation.shape[1]
    of_method = method.unpenalized(p), method.root(p)
    d = decompose(factor, equations, deviation, tolerance, *of_method)
    return d.separated(np.array(method.free)) if isinstance(method, MAP) and method.held else d


def make_default_method(
    inflation: tolerance_components.By | Literal["none"] = "auto",
) -> Method | None:
    """Return the default method, None, or MAP with another choice of what may be inflated."""
    if inflation == "auto":
        return None
    return MAP() if inflation == "none" else MAP(tolerance_components.InflatedTolerances(inflation))


def adapt_method(
    method: Method | None,
    names: Sequence[str],
    assumed: BoolArray,
    noise: Literal["given", "estimated"],
    correlation: FloatArray | None = None,
) -> Method:
    """Return the method of a fit: the default where it is None; ridge with a number for each of the
    names (p,); MAP with what it must know, which tolerances (p,) are assumed and the correlation
    (p, p) of the deviations by common errors.
    """
    method = MAP(tolerance_components.InflatedTolerances()) if method is None else method
    if isinstance(method, Ridge):
        return method.resolve(names)
    if not isinstance(method, MAP):
        return method
    free = method.free or (tuple(assumed.tolist()) if assumed.any() else ())
    correlation = correlation if method.correlation is None else method.correlation
    return replace(method, free=free, noise=noise, correlation=correlation)


@dataclass(frozen=True)
class Regularization:
    """Ridge parameter or truncation of a fit.

    parameter : "lam", the ridge parameter in squared standard deviations of the noise per squared
        tolerance, or "k", the number of directions of a truncated SVD.
    value : of the parameter; the largest one where each parameter has its own `lam`.
    rule : name of the rule that chose it, such as "GCV"; "fixed" where it was given, "each" where
        one was given for each parameter.
    score : what the rule minimizes, at `value`; None where it was given or the rule has no score.
    effective : sum of the filter factors, the number of directions that the data determine after
        regularization. parameters, rank : p, and the number of directions without regularization.
    is_at_limit : whether a rule chose an end of its range, so that its minimum may lie beyond.
    """

    parameter: str
    value: float
    rule: str
    score: float | None
    effective: float
    parameters: int
    rank: int
    is_at_limit: bool

    @property
    def finding(self) -> Finding:
        """The parameter with rule and score."""
        code = "fit.regularization-at-limit" if self.is_at_limit else "fit.regularization"
        return report_finding(code, **vars(self))


def describe_regularization(
    method: Method, decomposition: Decomposition, penalty: FloatArray
) -> Regularization | None:
    """Return the regularization of trial 0; None for methods without a parameter to choose."""
    if (choice := method.choice()) is None:
        return None
    (name, stated), score, is_at_limit = choice, None, False
    if callable(stated):
        value = float(np.atleast_1d(np.asarray(stated(decomposition)))[0])
        rule = getattr(stated, "__name__", type(stated).__name__)
        if callable(measure := getattr(stated, "score", None)):
            score = float(np.asarray(measure(decomposition, np.full(1, value)))[0])
        if callable(is_limit := getattr(stated, "is_limit", None)):
            is_at_limit = bool(np.asarray(is_limit(decomposition, np.full(1, value)))[0])
    else:
        value, rule = float(np.max(stated)), "each" if isinstance(stated, tuple) else "fixed"
    return Regularization(
        parameter=name,
        value=value,
        rule=rule,
        score=score,
        effective=float(decomposition.filter_factors(penalty)[0].sum()),
        parameters=penalty.shape[1],
        rank=int(decomposition.rank[0]),
        is_at_limit=is_at_limit,
    )


def fix_penalty(method: Method, parameters: int) -> FloatArray | None:
    """Return P (k, p) of a method whose penalty |P z|^2 does not depend on the rows, with k = 0
    where nothing is penalized; None where the method chooses it from the decomposition.

    Of another class, which may inherit from these, only its penalties of decompositions are known.
    """
    if type(method) is LeastSquares:
        value = 0.0
    elif type(method) is Ridge and not callable(lam := method.weights):
        value = 1.0 if isinstance(lam, tuple) else float(lam)
    elif type(method) is MAP and not callable(method.inflation) and method.noise == "given":
        value = 1.0 / method.inflation**2
    else:
        return None
    root, unpenalized = method.root(parameters), method.unpenalized(parameters)
    is_penalized = np.full(parameters, value > 0.0)
    if unpenalized is not None:
        is_penalized &= ~unpenalized
    matrix = np.sqrt(value) * np.eye(parameters)[is_penalized]
    return matrix if root is None else np.linalg.solve(root.T, matrix.T).T
