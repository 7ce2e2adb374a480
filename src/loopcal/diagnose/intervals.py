# SPDX-License-Identifier: Apache-2.0
"""Intervals of parameters from draws, compared with linear ones, regions of several parameters, and
weighted draws from the exact posterior of one calibration.

A linear interval is off where one of its ends differs from that of the draws by more than 10 % of
its half-width, beyond what the finite number of draws explains. The ends are compared draw by draw:
with the same random numbers, the difference of a quantile from its linear counterpart is known far
better than either, with the standard error of the influence of each draw.

For q quantities with the covariance C, the region (x - estimate)' C^-1 (x - estimate) <= c contains
the truth with the stated probability for c = q F(q, nu), nu the degrees of freedom of the noise.
Intervals of all q quantities at once have the half-width k sd with

    maximum      the quantile of max |t_j| for these correlations (simulated; the narrowest)
    sidak        single level 1 - (1 - level)^(1/q): exact for independent quantities
    bonferroni   single level (1 - level) / q
    scheffe      sqrt(c): holds for all linear combinations, too

Draws come from a multivariate t distribution about the estimate with the covariance of the fit, so
that its tails are heavier than those of the posterior. Each draw gets the exact density of all rows
and priors, with the kinematics solved at it, divided by the density of the proposal (importance
sampling). Where few draws have all the weight, the proposal is moved to them, and drawn from again.
See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np

from loopcal.checks import check_choice
from loopcal.errors import EstimationError, suggest_names
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.prior import WithPrior
from loopcal.estimate.resampling import repeat_trial, resample_rows
from loopcal.estimate.residual_test import LEVEL, coverage_factor
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.numerics.decomposition import NULL_COMPONENT, Decomposition
from loopcal.numerics.statistics import compute_f_quantile, compute_f_tail, compute_single_level
from loopcal.results.description import OTHER, Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

LARGEST_TAIL = 0.2  # share of the draws whose weights are the tail, at most; see `fit_tail_shape`


def normalize_weights(log_weight: FloatArray) -> FloatArray:
    """Return weights (T,) of sum 1 from their logarithms; zero where these are not finite."""
    from scipy.special import softmax

    finite = np.isfinite(log_weight)
    return softmax(np.where(finite, log_weight, -np.inf)) if finite.any() else np.zeros(len(finite))


def effective_size(weight: FloatArray) -> float:
    """Return the number of independent draws that are worth as much as the weighted ones."""
    total = float((weight**2).sum())
    return 1.0 / total if total > 0.0 else 0.0


def fit_tail_shape(weight: FloatArray) -> float:
    """Return the shape k of the generalized Pareto distribution of the largest weights.

    The estimate of Zhang and Stephens (2009), with the weak prior of Vehtari et al. (2024,
    doi:10.48550/arXiv.1507.02646, appendix C), of the M largest weights over the next one,
    M = min(T / 5, 3 sqrt(T)). NaN with fewer than 5 of them.
    """
    total = len(weight)
    count = int(min(LARGEST_TAIL * total, 3.0 * np.sqrt(total)))
    ordered = np.sort(weight)
    x = ordered[-count:] - ordered[-count - 1]
    x = x[x > 0.0]
    n = len(x)
    if n < 5:
        return np.nan
    m = 30 + int(np.sqrt(n))
    quartile = x[int(n / 4 + 0.5) - 1]
    b = 1.0 / x[-1] + (1.0 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3.0 * quartile)
    k = np.log1p(-b[:, None] * x).mean(axis=1)
    likelihood = n * (np.log(-b / k) - k - 1.0)
    share = 1.0 / np.exp(likelihood - likelihood[:, None]).sum(axis=1)
    best = float((b * share).sum() / share.sum())
    shape = float(np.log1p(-best * x).mean())
    return (n * shape + 10.0 * 0.5) / (n + 10.0)


def weighted_quantiles(draws: FloatArray, weight: FloatArray, level: FloatArray) -> FloatArray:
    """Return quantiles (len(level), p) of draws (T, p) with weights (T,) of sum 1.

    Between two draws the distribution function is linear, with half the weight of a draw below it.
    """
    order = np.argsort(draws, axis=0, kind="stable")
    values = np.take_along_axis(draws, order, axis=0)
    ordered = weight[order]
    below = np.cumsum(ordered, axis=0) - 0.5 * ordered
    columns = [np.interp(level, below[:, j], values[:, j]) for j in range(draws.shape[1])]
    return np.stack(columns, axis=1)


OFF = 0.10  # difference of an end of an interval, in linear half-widths, above which it is reported
NAMED = 3  # parameters that a finding names, at most
# Probability that any end is reported by the random draws alone, where linear intervals hold.
FALSE_ALARMS = 0.01


ENDS = ("lower", "upper", "linear_lower", "linear_upper")


@dataclass(frozen=True, eq=False, repr=False)
class Intervals(TableResult):
    """Intervals of parameters; arrays are (p,) [SI], NaN where the data determine none.

    Attributes
    ----------
    names : of the parameters. level : coverage of each interval. source : what was drawn.
    center, sd : mean and standard deviation of the draws. lower, upper : the interval.
    linear_lower, linear_upper : the linear interval, under the same assumptions on the noise.
    shift : (2, p) differences of the ends from the linear ones, in linear half-widths.
    shift_error : (2, p) their standard errors by the finite number of draws.
    """

    names: tuple[str, ...]
    level: float
    source: str
    center: FloatArray
    sd: FloatArray
    lower: FloatArray
    upper: FloatArray
    linear_lower: FloatArray
    linear_upper: FloatArray
    shift: FloatArray
    shift_error: FloatArray

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("level", "source", parameters=lambda intervals: intervals._list_rows()),
        *(Field(name, axes="parameter", unit="SI") for name in ("center", "sd", *ENDS)),
        Field("linear_is_off", "is_off", "parameter"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="names")

    @property
    def is_off(self) -> BoolArray:
        """(p,) whether the linear interval is off by more than `OFF`, beyond the random draws."""
        tested = max(int(np.isfinite(self.shift).sum()), 1)
        quantile = float(coverage_factor(np.inf, 1.0 - compute_single_level(FALSE_ALARMS, tested)))
        beyond = np.abs(self.shift) - quantile * self.shift_error
        return np.asarray((np.where(np.isnan(beyond), 0.0, beyond) > OFF).any(axis=0))

    @property
    def largest_shift(self) -> FloatArray:
        """(p,) largest difference of an end, in linear half-widths."""
        return np.asarray(np.abs(np.nan_to_num(self.shift)).max(axis=0))

    def _list_rows(self) -> list[dict[str, Any]]:
        """Return one entry for each parameter [SI]."""
        columns = {name: getattr(self, name) for name in ENDS}
        columns |= {"shift": self.shift.T, "shift_error": self.shift_error.T}
        columns = {"name": self.names, "mean": self.center, "sd": self.sd, **columns}
        columns["linear_is_off"] = self.is_off
        rows = zip(*columns.values(), strict=True)
        return [dict(zip(columns, row, strict=True)) for row in rows]


def mask_intervals(
    is_known: BoolArray, names: tuple[str, ...], level: float, source: str, **columns: FloatArray
) -> Intervals:
    """Return intervals with columns (.., p) that are NaN where no parameter is known (p,)."""
    known = {name: np.where(is_known, values, np.nan) for name, values in columns.items()}
    return Intervals(names, level, source, **known)


def compare_ends(
    draws: FloatArray,
    weight: FloatArray,
    linear: FloatArray,
    linear_weight: FloatArray,
    level: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the ends (2, p) of intervals of draws and of linear draws (T, p), with weights (T,) of
    sum 1, and the standard error of their difference.
    """
    tails = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
    quantile = weighted_quantiles(draws, weight, tails)
    reference = weighted_quantiles(linear, linear_weight, tails)
    mean = linear_weight @ linear
    sd = np.sqrt(linear_weight @ (linear - mean) ** 2)
    density = np.exp(-0.5 * float(coverage_factor(np.inf, level)) ** 2) / np.sqrt(2.0 * np.pi)
    error = np.zeros_like(quantile)
    for i, tail in enumerate(tails):
        own = weight[:, None] * ((draws <= quantile[i]) - tail)
        other = linear_weight[:, None] * ((linear <= reference[i]) - tail)
        error[i] = np.sqrt(((own - other) ** 2).sum(axis=0)) * sd / density
    return quantile, reference, error


def report_intervals(intervals: Intervals, agrees: str, differs: str) -> list[Finding]:
    """Return whether linear intervals hold, with the codes for yes and no."""
    off, size = np.flatnonzero(intervals.is_off), intervals.largest_shift
    share: dict[str, Any] = {"limit": OFF, "level": intervals.level}
    if not len(off):
        return [report_finding(agrees, **share, count=len(intervals.names))]
    order = off[np.argsort(-size[off])]
    names = tuple(intervals.names[i] for i in order)
    return [
        report_finding(
            differs,
            **share,
            count=len(off),
            total=len(intervals.names),
            names=names[:NAMED],
            largest=float(size[order[0]]),
        )
    ]


Rule = Literal["maximum", "sidak", "bonferroni", "scheffe"]  # how simultaneous intervals are made
DRAWS = 100_000  # simulated maxima: the quantile has a standard error of about 0.3 %

BATCH = 10_000
SMALLEST = 1e-10  # eigenvalue of a correlation matrix below which quantities depend on each other


@dataclass(frozen=True, eq=False, repr=False)
class JointRegion(TableResult):
    """An ellipsoid of q quantities.

    Attributes
    ----------
    names : of the quantities. center : (q,) estimates [SI]. covariance : (q, q) [SI].
    level : probability. degrees : of freedom of the noise; infinite where it is known.
    square : c, the largest squared distance within the region.
    """

    names: tuple[str, ...]
    center: FloatArray
    covariance: FloatArray
    level: float
    degrees: float
    square: float

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("*", "half_widths", "axes", "correlation"),
        *(
            Field(name, axes="quantity", unit="SI")
            for name in ("center", "standard_deviations", "half_widths")
        ),
        Field("covariance", axes=f"quantity {OTHER}", unit="SI times SI"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(quantity="names", other="names")

    @property
    def standard_deviations(self) -> FloatArray:
        """(q,) [SI]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> FloatArray:
        """(q, q)."""
        sd = self.standard_deviations
        return self.covariance / (sd[:, None] * sd)

    @property
    def half_widths(self) -> FloatArray:
        """(q,) half-widths [SI] of the box around the region; those of Scheffe's intervals."""
        return np.sqrt(self.square) * self.standard_deviations

    @property
    def axes(self) -> FloatArray:
        """(q, q) vectors [SI] from the center to the ends of the principal axes, one per row, the
        longest in standard deviations first.

        They are principal for quantities in units of their standard deviations, so that they do
        not depend on units.
        """
        value, vectors = np.linalg.eigh(self.correlation)
        sd = self.standard_deviations
        return (sd[:, None] * vectors * np.sqrt(self.square * np.maximum(value, 0.0))).T[::-1]

    def measure_distance(self, values: FloatArray) -> FloatArray:
        """Return squared distances (..,) of values (.., q) [SI], comparable with `square`."""
        sd = self.standard_deviations
        off = (np.asarray(values, dtype=np.float64) - self.center) / sd
        value, vectors = np.linalg.eigh(self.correlation)
        return np.asarray(((off @ vectors) ** 2 / value).sum(axis=-1))

    def contains(self, values: FloatArray) -> np.ndarray:
        """Return whether values (.., q) [SI] lie in the region."""
        return np.asarray(self.measure_distance(values) <= self.square)

    def compute_p_value(self, values: FloatArray) -> FloatArray:
        """Return the probability (..,) of estimates as far from values (.., q) [SI], if these were
        true.
        """
        q = len(self.names)
        return compute_f_tail(q, self.degrees, self.measure_distance(values) / q)


@dataclass(frozen=True, eq=False, repr=False)
class SimultaneousIntervals(TableResult):
    """Intervals that hold for all q quantities at once with a probability.

    Attributes
    ----------
    names : of the quantities. center : (q,) [SI]. half_widths : (q,) [SI]. level : of all together.
    rule : how they were made. factor : (q,) half-widths in standard deviations.
    single : (q,) half-widths [SI] of the intervals that hold one at a time.
    """

    names: tuple[str, ...]
    center: FloatArray
    half_widths: FloatArray
    level: float
    rule: Rule
    factor: FloatArray
    single: FloatArray

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("*"),
        *(Field(name, axes="quantity", unit="SI") for name in ("center", "half_widths", "single")),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(quantity="names")

    def contains(self, values: FloatArray) -> np.ndarray:
        """Return whether all of values (.., q) [SI] lie in their intervals."""
        off = np.abs(np.asarray(values) - self.center)
        return np.asarray((off <= self.half_widths).all(axis=-1))


def compute_joint_region(
    fit: Identification | Posterior,
    names: str | Sequence[str] | None = None,
    level: float = LEVEL,
    combinations: FloatArray | None = None,
) -> JointRegion:
    """Return the joint region of parameters, or of combinations of them.

    Parameters
    ----------
    fit : an identification, or the posterior of a run. names : parameters; `*` stands for any
        characters, as in `leg1.*`. None takes all that the data determine.
    level : probability. combinations : (q, len(names)), optional; rows of factors, so that the
        quantities are combinations @ parameters.

    Raises
    ------
    EstimationError : an unknown name, a parameter that the data do not determine, quantities that
        depend on each other, or a fit without intervals.
    """
    chosen = _select(fit, names, level, combinations)
    q = len(chosen.names)
    value, vectors = np.linalg.eigh(chosen.correlation)
    if value[0] < SMALLEST:
        raise EstimationError.of("sampling.region-dependent", names=chosen.names)
    white = (vectors / np.sqrt(value)).T / chosen.sd
    degrees = float(chosen.posterior.count_degrees(white @ chosen.effect))
    square = q * float(compute_f_quantile(q, degrees, 1.0 - level))
    return JointRegion(
        chosen.names, chosen.center, chosen.root @ chosen.root.T, level, degrees, square
    )


def compute_simultaneous_intervals(
    fit: Identification | Posterior,
    names: str | Sequence[str] | None = None,
    level: float = LEVEL,
    rule: Rule = "maximum",
    combinations: FloatArray | None = None,
    seed: int = 1,
) -> SimultaneousIntervals:
    """Return intervals that hold for all selected quantities at once.

    Parameters
    ----------
    fit, names, level, combinations : as for `compute_joint_region`; quantities may depend on each
        other. rule : see the module. seed : of the simulated maxima.

    Raises
    ------
    EstimationError : as `compute_joint_region`, or an unknown rule.
    """
    check_choice("rule", rule, get_args(Rule))
    chosen = _select(fit, names, level, combinations)
    q = len(chosen.names)
    degrees = chosen.posterior.count_degrees(chosen.effect[:, None, :])
    least = float(degrees.min())
    if rule == "maximum":
        value, vectors = np.linalg.eigh(chosen.correlation)
        root = vectors * np.sqrt(np.maximum(value, 0.0))
        rng, largest = np.random.default_rng(np.random.SeedSequence(seed)), []
        for _ in range(DRAWS // BATCH):  # of max |t_j| for these correlations
            drawn = np.abs(rng.standard_normal((BATCH, len(root))) @ root.T).max(axis=1)
            if np.isfinite(least):
                drawn = drawn / np.sqrt(rng.chisquare(least, BATCH) / least)
            largest.append(drawn)
        factor = np.full(q, float(np.quantile(np.concatenate(largest), level)))
    elif rule == "scheffe":
        rank = int((np.linalg.eigvalsh(chosen.correlation) > SMALLEST).sum())
        factor = np.full(q, np.sqrt(rank * compute_f_quantile(rank, least, 1.0 - level)))
    else:
        tail = 1.0 - level
        single = 1.0 - (compute_single_level(tail, q) if rule == "sidak" else tail / q)
        factor = coverage_factor(degrees, single)
    return SimultaneousIntervals(
        chosen.names,
        chosen.center,
        factor * chosen.sd,
        level,
        rule,
        factor,
        coverage_factor(degrees, level) * chosen.sd,
    )


class _Selection(NamedTuple):
    """Quantities of a posterior."""

    posterior: Posterior
    names: tuple[str, ...]
    center: FloatArray
    effect: FloatArray  # (q, p) by the parameters
    root: FloatArray  # (q, k) of the covariance
    sd: FloatArray
    correlation: FloatArray


def _select(
    fit: Identification | Posterior,
    names: str | Sequence[str] | None,
    level: float,
    combinations: FloatArray | None,
) -> _Selection:
    """Return the selected quantities; raise EstimationError where they are not determined."""
    posterior = fit if isinstance(fit, Posterior) else fit.posterior
    if not 0.0 < level < 1.0:
        raise EstimationError(f"level is {level}. Give a probability between 0 and 1")
    if np.isnan(posterior.variance).any():
        raise EstimationError.of("sampling.without-intervals")
    size = np.abs(posterior.directions[:, np.isinf(posterior.variance)]).max(axis=1, initial=0.0)
    is_known = size <= NULL_COMPONENT
    places = np.flatnonzero(is_known) if names is None else _find_places(posterior.names, names)
    unknown = tuple(posterior.names[i] for i in places[~is_known[places]])
    if combinations is None and unknown:
        raise EstimationError.of("sampling.region-undetermined", names=unknown)
    if not len(places):
        raise EstimationError.of("sampling.region-undetermined", names=posterior.names)
    effect = np.eye(len(posterior.names))[places]
    labels = tuple(posterior.names[i] for i in places)
    if combinations is not None:
        rows = np.atleast_2d(np.asarray(combinations, dtype=np.float64))
        if rows.ndim != 2 or rows.shape[1] != len(places):
            raise EstimationError(
                f"combinations have shape {rows.shape} for {len(places)} parameters. Give rows "
                "with one factor for each"
            )
        if not np.isfinite(rows).all() or not rows.any(axis=1).all():
            raise EstimationError(
                "combinations have a row of zeros, or a number that is not finite. Give finite "
                "factors, not all of them 0"
            )
        effect, labels = rows @ effect, tuple(f"combination {i + 1}" for i in range(len(rows)))
        open_part = effect * posterior.unit @ posterior.directions[:, np.isinf(posterior.variance)]
        length = np.linalg.norm(effect * posterior.unit, axis=1)
        if (np.abs(open_part).max(axis=1, initial=0.0) > NULL_COMPONENT * length).any():
            raise EstimationError.of("sampling.region-undetermined", names=labels)
    center, root = effect @ posterior.estimate, effect @ posterior.root
    sd = np.sqrt((root**2).sum(axis=1))
    correlation = (root / sd[:, None]) @ (root / sd[:, None]).T
    return _Selection(posterior, labels, center, effect, root, sd, correlation)


def _find_places(available: tuple[str, ...], names: str | Sequence[str]) -> IntArray:
    """Return the places of names or patterns among the available names, in the order of these."""
    if isinstance(names, str):
        names = [names]
    chosen = []
    for name in names:
        matching = [i for i, known in enumerate(available) if fnmatchcase(known, name)]
        if not matching:
            similar = suggest_names(name, available)
            raise EstimationError(f"no free parameter has the name {name!r}{similar}")
        chosen += [i for i in matching if i not in chosen]
    return np.array(chosen, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class PosteriorDensity:
    """The posterior of a fit in the coordinates v = (y, w) of its linear approximation."""

    linear: FitLinearization  # the fit and its rows
    prior: WithPrior | None  # rows of an earlier calibration with them, or None
    # decomposition, penalty: of rows divided by s; the penalty is that of a prior, or 0
    decomposition: Decomposition
    penalty: FloatArray
    mean: FloatArray  # (p,) of the linear posterior, in spreads
    root: FloatArray  # (p, k) E
    setup_root: FloatArray  # (U, u) T
    scale: float  # s
    degrees: float  # nu
    directions: int  # K

    @property
    def size(self) -> int:
        """Number k + u of coordinates."""
        return self.root.shape[1] + self.setup_root.shape[1]

    def parameters(self, coordinates: FloatArray) -> FloatArray:
        """Return deviations (T, p) in spreads at coordinates (T, k + u)."""
        return self.mean + coordinates[:, : self.root.shape[1]] @ self.root.T

    def setup(self, coordinates: FloatArray) -> FloatArray:
        """Return setup parameters (T, U) [SI] at coordinates (T, k + u)."""
        nuisance = self.linear.linearization.nuisance
        if nuisance is None:
            return np.zeros((len(coordinates), 0))
        change = self.parameters(coordinates) - self.linear.linearization.deviation
        own = coordinates[:, self.root.shape[1] :] @ self.setup_root.T
        return nuisance.best[0] + change @ nuisance.elimination.slope[0].T + own

    def exact(self, coordinates: FloatArray) -> FloatArray:
        """Return log p (T,) at coordinates (T, k + u); -inf where a pose is not reached."""
        z, x = self.parameters(coordinates), self.setup(coordinates)
        count = len(z)
        nuisance = self.linear.problem.nuisance
        mean = np.zeros((count, 0)) if nuisance is None else nuisance.prior_mean.repeat(count, 0)
        problem = resample_rows(self.linear.problem, None, None, mean)
        start = repeat_trial(self.linear.linearization.next_start, count)
        has_setup = x.shape[1] > 0
        if has_setup:
            start = start.with_nuisance(x)
        solution = problem.solve(z, start, x if has_setup else None)
        total = np.zeros(count)
        for rows, kind in zip(problem.rows, problem.residuals(z, solution), strict=True):
            white = np.where(rows.is_present, kind.whitened, 0.0)
            total += (white**2).sum(axis=(1, 2))
        if problem.nuisance is not None:
            total += problem.nuisance.prior_cost(x)
        if self.prior is not None:
            total += (self.prior.residuals(z) ** 2).sum(axis=1)
        value = self._of_squares(total / self.scale**2) - 0.5 * self._penalize(z)
        return np.where(np.isfinite(value), value, -np.inf)

    def approximate(self, coordinates: FloatArray) -> FloatArray:
        """Return log p (T,) of the linear posterior at coordinates (T, k + u)."""
        d, z = self.decomposition, self.parameters(coordinates)
        y = d.coordinates(z)
        left = ((d.singular_values[0] * y - d.projections[0]) ** 2).sum(axis=1) + d.outside[0]
        own = coordinates[:, self.root.shape[1] :]
        return self._of_squares(left + (own**2).sum(axis=1)) - 0.5 * self._penalize(z)

    def _of_squares(self, total: FloatArray) -> FloatArray:
        """Return g (T,) of sums of squares R / s^2."""
        above = total - self.decomposition.unexplained[0]
        if np.isinf(self.degrees):
            return -0.5 * above
        with np.errstate(invalid="ignore"):
            return -0.5 * (self.degrees + self.directions) * np.log(self.degrees + above)

    def _penalize(self, z: FloatArray) -> FloatArray:
        """Return the penalty (T,) of the spreads."""
        return (self.penalty * self.decomposition.coordinates(z) ** 2).sum(axis=1)


def describe_density(linear: FitLinearization) -> PosteriorDensity:
    """Return the posterior of a fit by least squares or MAP, with intervals."""
    fit = linear.fit
    scale, degrees = fit.residual_test.sigma_scale, fit.residual_test.noise_degrees
    stated, penalty = linear.decomposition, linear.prior_weight
    d = stated.divided(np.array([scale]))
    finite = np.where(np.isfinite(penalty), penalty, 0.0)
    # without a prior a direction is used within the rank; with one, also beyond it
    used = np.where(np.isfinite(penalty), finite, np.inf)[None]
    variance = d.variances(used)[0]
    is_known = np.isfinite(variance)
    root = d.directions[0][:, is_known] * np.sqrt(variance[is_known])
    mean = d.deviation(d.solution(used))[0]
    setup_root, rank = np.zeros((0, 0)), 0
    nuisance = linear.linearization.nuisance
    if nuisance is not None:
        joint = scale * nuisance.elimination.list_root().fill(np.arange(nuisance.values.shape[1]))
        setup_root = joint[:, (joint != 0.0).any(axis=0)]
        rank = int(nuisance.elimination.rank[0])
    prior = None if fit.options.prior is None else fit.options.prior.added(linear.problem)
    directions = int(stated.used[0].sum()) + rank
    return PosteriorDensity(
        linear, prior, d, finite, mean, root, setup_root, scale, degrees, directions
    )


EVALUATED = 250  # draws that are evaluated at once; progress is reported between them
ROUNDS = 4  # proposals that are tried, at most
GOOD_SHARE = 0.2  # effective size, as a share of the draws, with which a proposal is kept
# Limits of the degrees of freedom of the proposal. As many as there are directions lose about a
# third of the draws where the posterior is normal.
SMALLEST_DEGREES, LARGEST_DEGREES = 8.0, 100.0
# Effective size below which, and shape of the tail of the weights above which, the draws do not
# represent the posterior (Vehtari et al., 2024).
FEWEST_DRAWS, LARGEST_SHAPE = 400.0, 0.7
# Effective size, in directions, to which weights are flattened before a proposal is moved.
FLATTENED = 50.0


@dataclass(frozen=True, eq=False)
class PosteriorSample(TableResult):
    """T weighted draws from the posterior of a fit.

    Attributes
    ----------
    fit : the calibration. seed : of the random numbers. rounds : proposals that were tried.
    draws : (T, p) [SI]. setup : (T, U) [SI] setup parameters that belong to them.
    weight : (T,) of sum 1. linear_weight : (T,) with which the same draws represent the linear
        posterior.
    linear_mean, linear_sd : (p,) [SI] of the linear posterior, known exactly; for Student's t the
        scale. Infinite where the data do not determine a parameter.
    degrees : degrees of freedom of the noise; infinite where it is known.
    tail_shape : of the largest weights, see `fit_tail_shape`.
    """

    fit: Identification
    seed: int
    rounds: int
    draws: FloatArray
    setup: FloatArray
    weight: FloatArray
    linear_weight: FloatArray
    linear_mean: FloatArray
    linear_sd: FloatArray
    degrees: float
    tail_shape: float

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(robot="fit.robot.name", seed="", draws=lambda sample: len(sample.draws)),
        *fields("effective_size", "tail_shape", "rounds", "findings"),
        Field("weight", axes="draw", unit="1"),
        Field("estimate", "draws", "draw parameter", units="fit.free_parameters.dimensions"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="fit.names")

    @property
    def effective_size(self) -> float:
        """Number of independent draws that are worth as much."""
        return effective_size(self.weight)

    def intervals(self, level: float = LEVEL) -> Intervals:
        """Return intervals between quantiles, corrected by the known linear posterior.

        A quantile is the linear one plus the difference of the two in the same draws.
        """
        weights = (self.weight, self.draws, self.linear_weight)
        quantile, drawn, error = compare_ends(self.draws, *weights, level)
        half = coverage_factor(self.degrees, level) * self.linear_sd
        linear = self.linear_mean + np.array([[-1.0], [1.0]]) * half
        change = quantile - drawn
        center = self.weight @ self.draws
        return mask_intervals(
            np.isfinite(self.linear_sd),
            self.fit.names,
            level,
            "posterior",
            center=self.linear_mean + (self.weight - self.linear_weight) @ self.draws,
            sd=np.sqrt(self.weight @ (self.draws - center) ** 2),
            **dict(zip(ENDS, (*(linear + change), *linear), strict=True)),
            shift=change / half,
            shift_error=error / half,
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Whether the draws represent the posterior, whether linear intervals hold, and whether the
        fit states wider ones.
        """
        size, intervals = self.effective_size, self.intervals()
        if size < FEWEST_DRAWS or self.tail_shape > LARGEST_SHAPE:
            size_or_tail = {"size": size, "count": len(self.draws), "shape": self.tail_shape}
            return (report_finding("sampling.few-effective-draws", **size_or_tail),)
        codes = ("sampling.posterior-agrees", "sampling.posterior-differs")
        rest = report_intervals(intervals, *codes)
        known = np.isfinite(self.linear_sd)
        ratio = (self.fit.standard_deviations[known] / self.linear_sd[known]).max(initial=1.0)
        if ratio > 1.0 + OFF:
            rest.append(report_finding("sampling.stated-wider", ratio=float(ratio)))
        if self.rounds == ROUNDS and size < GOOD_SHARE * len(self.draws):
            tried = {"rounds": ROUNDS, "size": size, "count": len(self.draws)}
            rest.append(report_finding("sampling.proposals-exhausted", **tried))
        return tuple(rest)


def sample_posterior(
    fit: Identification,
    data: Measurements,
    count: int = 4000,
    *,
    seed: int = 1,
    progress: Progress = report_no_progress,
) -> PosteriorSample:
    """Draw parameters from the posterior of a fit by least squares or MAP.

    The prior is that of the fit: the spreads of MAP, the earlier calibration, and the priors of
    setup parameters. Other parameters have a flat prior.

    Parameters
    ----------
    fit : an identification that converged. data : the measurements it was made from.
    count : number of draws. seed : of all random numbers.
    progress : receives the draws that are evaluated.

    Raises
    ------
    EstimationError : the fit did not converge, has no intervals, or was made by a method that
        states no prior; or no draw is possible.
    """
    if count < 100:
        raise EstimationError(f"{count} draws: give at least 100")
    if not fit.converged:
        raise EstimationError.of("sampling.not-converged")
    if fit.method.is_biased:
        name = type(fit.method).__name__
        raise EstimationError.of("sampling.method-without-prior", method=name)
    if not fit.residual_test.intervals:
        raise EstimationError.of("sampling.without-intervals")
    density = describe_density(linearize_fit(fit, data))
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    # the linear posterior with heavier tails
    degrees = float(np.clip(density.size, SMALLEST_DEGREES, LARGEST_DEGREES))
    degrees = min(degrees, density.degrees)
    proposal = _Proposal(np.zeros(density.size), np.eye(density.size), degrees)
    rounds, best = 0, None
    while rounds < ROUNDS:
        rounds += 1
        v, log_q = proposal.draw(count, rng)
        log_densities = []
        for first in range(0, len(v), EVALUATED):
            progress(first, len(v), "evaluating draws")
            log_densities.append(density.exact(v[first : first + EVALUATED]))
        progress(len(v), len(v), "evaluating draws")
        log_p = np.concatenate(log_densities)
        weight = normalize_weights(log_p - log_q)
        size = effective_size(weight)
        if best is None or size > effective_size(best[1]):
            best = (v, weight, log_q)
        if not size or size >= GOOD_SHARE * count:
            break
        proposal = proposal.moved(v, log_p - log_q)
    assert best is not None
    v, weight, log_q = best
    if not weight.any():
        raise EstimationError.of("sampling.no-draw-possible", count=count)
    tolerance = fit.tolerance
    sd = np.sqrt((density.root**2).sum(axis=1))
    return PosteriorSample(
        fit=fit,
        seed=seed,
        rounds=rounds,
        draws=fit.nominal + tolerance * density.parameters(v),
        setup=density.setup(v),
        weight=weight,
        linear_weight=normalize_weights(density.approximate(v) - log_q),
        linear_mean=fit.nominal + tolerance * density.mean,
        linear_sd=np.where(np.isfinite(fit.standard_deviations), sd * tolerance, np.inf),
        degrees=density.degrees,
        tail_shape=fit_tail_shape(weight),
    )


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A multivariate t distribution of coordinates v: mean (K,), root (K, K), degrees."""

    mean: FloatArray
    root: FloatArray
    degrees: float

    def draw(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return draws (count, K) and the logarithm of their density (count,)."""
        from scipy.special import gammaln

        size, nu = len(self.mean), self.degrees
        normal = rng.standard_normal((count, size))
        scale = np.sqrt(nu / rng.chisquare(nu, count))[:, None]
        square = ((scale * normal) ** 2).sum(axis=1)
        log_q = -0.5 * (nu + size) * np.log1p(square / nu)
        constant = gammaln(0.5 * (nu + size)) - gammaln(0.5 * nu) - 0.5 * size * np.log(nu * np.pi)
        determinant = np.log(np.abs(np.diag(self.root))).sum()
        return self.mean + scale * normal @ self.root.T, log_q + constant - determinant

    def moved(self, v: FloatArray, log_weight: FloatArray) -> _Proposal:
        """Return a proposal with the mean and the covariance of weighted draws.

        Where few draws have all the weight, the weights are flattened by a power below 1, so that
        enough draws determine the covariance.
        """
        size = len(self.mean)
        needed, power = min(FLATTENED + 4.0 * size, 0.5 * len(v)), 1.0
        weight = normalize_weights(log_weight)
        while effective_size(weight) < needed and power > 1e-3:
            power *= 0.7
            weight = normalize_weights(power * log_weight)
        mean = weight @ v
        spread = (v - mean) * np.sqrt(weight)[:, None]
        rows = np.concatenate([spread, 0.1 * np.eye(size)])
        triangle = np.asarray(np.linalg.qr(rows, mode="r"))
        return _Proposal(mean, triangle.T, self.degrees)
