# SPDX-License-Identifier: Apache-2.0
"""The result of an identification: corrected robot, uncertainty of each number, fit to the data.

Errors that the rows of a fit show and its assumptions do not contain are added to its covariance
(`add_covariance`). The deviation of the machine from the estimate becomes e = diag(unit) V y + L w
with independent w of variance 1. In the coordinates y, of covariance S = diag(variance), the sum
has the covariance S + K K', K = V^-1 diag(1 / unit) L. Let y1 be the directions that the rows
determine and y2 the others of finite variance. Independent coordinates of the sum are those of y1,
turned to their principal axes, and of y2 - G y1, G = S21 S11^-1:

    V y = (V1 + V2 G) y1 + V2 (y2 - G y1)

so that the directions that no row determines stay what they are. Directions of infinite variance
stay infinite, whatever is added to them.

Given the machine's deviation z, the best nuisance parameters are b = b0 + S (z - z0) with the
covariance (F'F)^+ of their own. z has the covariance C of the fit, so that b has
(F'F)^+ + S C S'. A direction of infinite variance that moves b makes the variance of b infinite,
too: a frame is then known only together with the machine.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopcal.estimate.elimination import NuisanceElimination
from loopcal.estimate.free_parameters import Combination, FreeParameters, sparsify_basis
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.losses import Loss, describe_loss
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import Method, Regularization
from loopcal.estimate.posterior import NOISE, CovariancePart, Posterior, combine_degrees
from loopcal.estimate.residual_test import LEVEL, ResidualTest, coverage_factor
from loopcal.findings import Finding, report_finding
from loopcal.measure.kinds.setup_parameters import ROTATION_AXES
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import choose_setup_unit
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import Decomposition, are_nonzero
from loopcal.numerics.elimination import UnknownRoot
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.parameters import ParameterTable
from loopcal.plain_text import represent
from loopcal.results.deferred import DeferredFields, deferred, later
from loopcal.results.description import OTHER, Field, Source, fields, label_axes
from loopcal.results.presenters import draw
from loopcal.results.result import TableResult
from loopcal.results.storage import restore_arrays, store_arrays
from loopcal.results.tables import Column, build_table, format_uncertainty, format_with_uncertainty
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import SI_SYMBOLS, Dimension

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from loopcal.estimate.observation_rows import Residuals
    from loopcal.estimate.pose_estimate import EstimatedPoses
    from loopcal.estimate.prior_inflation import PriorConflict
    from loopcal.estimate.problem import Problem


@dataclass(frozen=True, eq=False)
class KindResiduals:
    """Residuals (predicted - measured) of the rows of one kind after the fit.

    kind : its name. components : names of the m residuals. poses : (r,) labels.
    raw : (r, m) [SI]. whitened : (r, m), divided by sigma (zero where absent).
    measured : (r, m) the values that the residuals are of [SI]; NaN where a residual is of none.
    context : name -> (r,), time [s] and temperatures [degC] of the rows, to plot the residuals
        against.
    dimensions : (m,) of the components. readings : (r, a) actuator readings of the rows [SI], of
        the first pose where a row compares several; NaN where missing.
    """

    kind: str
    components: tuple[str, ...]
    poses: tuple[str, ...]
    raw: FloatArray
    whitened: FloatArray
    measured: FloatArray
    context: Mapping[str, FloatArray] = field(default_factory=dict)
    dimensions: tuple[Dimension, ...] = ()
    readings: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    # first words of the names of stored arrays, beside those of the context; `rows` are labels
    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("residual", "raw", is_stored=True),
        *(
            Field(name, is_stored=True)
            for name in ("whitened", "measured", "components", "dimensions", "readings")
        ),
        Field("rows", "poses", is_stored=True),
    )

    __repr__ = represent


_NAME = re.compile(r"residual_(\d+)_(.+)", re.DOTALL)


def store_residuals(residuals: Sequence[KindResiduals]) -> dict[str, np.ndarray]:
    """Return residuals by name, `<what>_<i>_<kind>`; a quantity of the context keeps its name."""
    stored: dict[str, np.ndarray] = {}
    for i, r in enumerate(residuals):
        ending = f"_{i}_{r.kind}"
        stored |= {name + ending: array for name, array in r.context.items()}
        stored |= store_arrays(r, "", ending)
    return stored


def residuals_from_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[KindResiduals, ...]:
    """Return the residuals in the arrays of a run folder; none where an array of one is missing."""
    matches = [match for name in arrays if (match := _NAME.fullmatch(name))]
    others, result = (*(field.name for field in KindResiduals.FIELDS), "fitted_"), []
    for match in sorted(matches, key=lambda m: int(m[1])):
        ending = f"_{match[1]}_{match[2]}"
        context = {
            name.removesuffix(ending): array
            for name, array in arrays.items()
            if name.endswith(ending) and not name.startswith(others)
        }
        given = {"kind": match[2], "context": context}
        if (restored := restore_arrays(KindResiduals, arrays, "", ending, **given)) is None:
            return ()
        result.append(restored)
    return tuple(result)


def label_residuals(
    residuals: tuple[Residuals, ...], data: Measurements, problem: Problem
) -> tuple[KindResiduals, ...]:
    """Return the residuals (t = 1) of every kind with labels; those of uncertain readings last."""
    observations = [o for o in data.all_observations if len(o)]
    present, context = [o.present for o in observations], [o.context for o in observations]
    if problem.is_uncertain:
        present.append(np.isfinite(data.readings))
        context.append(data.context)
    return tuple(
        KindResiduals(
            kind=s.kind.name,
            components=tuple(column.name for column in s.kind.noise_columns),
            # those of the poses that a row observed, or "base"
            poses=tuple(
                s.kind.of if s.kind.is_of_base else "/".join(map(data.labels.__getitem__, poses))
                for poses in s.poses_by_link.tolist()
            ),
            raw=np.where(measured, r.raw[0], np.nan),
            whitened=r.whitened[0],
            measured=np.reshape(  # of a kind without columns, an empty one
                [
                    s.measured[0, :, s.kind.columns.index(column)]
                    if column in s.kind.columns
                    else np.full(len(s.poses), np.nan)
                    for column in s.kind.noise_columns
                ],
                (len(s.kind.noise_columns), len(s.poses)),
            ).T,
            context=columns,
            dimensions=tuple(column.dimension for column in s.kind.noise_columns),
            # of the first pose of each row; targets on the base have none
            readings=np.where(s.kind.is_of_base, np.nan, data.readings[s.poses_by_link[:, 0]]),
        )
        for s, measured, columns, r in zip(problem.rows, present, context, residuals, strict=True)
    )


# Deviation from nominal, in stated spreads (standard deviations), that contradicts the
# tolerance; noise alone does not cause it.
FAR = 10.0
LOW_WEIGHT = 0.5  # weight of a pose below which it is named
STATUS_CODES = {
    DescentStatus.CONVERGED: "fit.converged",
    DescentStatus.OUT_OF_ITERATIONS: "fit.out-of-iterations",
    DescentStatus.NO_DESCENT: "fit.no-descent",
    DescentStatus.NO_PROGRESS: "fit.no-progress",
}


def report_divergence(
    free: FreeParameters, deviation: FloatArray, method: Method, converged: bool
) -> list[Finding]:
    """Return findings on estimates (p,) far beyond their stated spreads, in these.

    Nothing is reported where the spreads are a prior: then `PriorConflict` tests them.
    """
    if method.has_prior:
        return []
    far = np.flatnonzero((np.abs(deviation) > FAR) & ~free.assumed)
    if len(far) == 0:
        stated = not free.assumed.all()
        return [report_finding("fit.no-prior")] if stated and not converged else []
    order = far[np.argsort(-np.abs(deviation[far]), kind="stable")]
    return [
        report_finding(
            "fit.beyond-tolerance",
            names=tuple(free.names[i] for i in order),
            factor=abs(float(deviation[order[0]])),
        )
    ]


def report_used_poses(
    data: Measurements, weights: FloatArray, loss: Loss | None, excluded: tuple[str, ...]
) -> list[Finding]:
    """Return which poses, of weights (n,), a loss gave less than half of their weight, and which
    ones the options exclude.
    """
    findings = []
    if loss is not None:
        low = tuple(data.labels[i] for i in np.flatnonzero(weights < LOW_WEIGHT))
        stated: dict[str, Any] = {"loss": describe_loss(loss), "total": data.n_poses}
        code = "fit.low-weights" if low else "fit.full-weights"
        if low:
            stated |= {"count": len(low), "poses": low}
        findings.append(report_finding(code, **stated))
    if excluded:
        findings.append(report_finding("fit.excluded-poses", poses=excluded))
    return findings


def report_equations(equations: int, parameters: int, method: Method) -> list[Finding]:
    """Return how many directions are known from spreads alone."""
    if equations >= parameters or not method.has_prior:
        return []
    return [
        report_finding(
            "fit.few-equations",
            equations=equations,
            parameters=parameters,
            directions=parameters - equations,
        )
    ]


def report_unknown_bias(
    free: FreeParameters, method: Method, prior: FloatArray | None
) -> list[Finding]:
    """Return why a ridge has no intervals, where its bias is not known: where `prior`, see
    `Method.prior_variance`, is NaN.
    """
    if prior is None or not np.isnan(prior).any():
        return []
    return [
        report_finding(
            "fit.ridge-without-intervals",
            names=tuple(compress(free.names, method.lacks_tolerances(free))),
            is_correlated=free.correlation is not None,
        )
    ]


LAST_DIGITS = 3  # digits of the values at which an iteration ended that did not converge


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Singular values of the whitened, tolerance-scaled matrix of a fit.

    rank : number of singular values above `tolerance` times the largest.
    condition : the largest over the smallest that counts. singular_values : (p,), descending.
    """

    rank: int
    condition: float
    singular_values: FloatArray
    tolerance: float


@dataclass(frozen=True, eq=False)
class History:
    """The iteration of a fit.

    status : how it ended. iterations : steps taken.
    cost : (i + 1,) whitened sum of squares. With a loss, the first and those after the last change
        of weights use the final weights; those between use the weights of their time. A fit of very
        many poses begins with the estimate of a part of them: the first sum is that of all poses,
        those of the part's further steps are estimates, its sums times the ratio of the numbers of
        equations.
    estimate : (i + 1, p) [SI].
    """

    status: DescentStatus
    iterations: int
    cost: FloatArray
    estimate: FloatArray

    @property
    def finding(self) -> Finding:
        """How the iteration ended."""
        return report_finding(STATUS_CODES[self.status], iterations=self.iterations)

    __repr__ = represent


@dataclass(frozen=True, eq=False)
class Identification(DeferredFields, TableResult):
    """A robot identified from measurements.

    Arrays over parameters are (p,) in the order of `names`, in SI units. Fields but the first four
    are computed when they are first asked for; their values do not depend on the order of asking.

    Attributes
    ----------
    robot : Mechanism at the estimate. initial : the robot as it was given.
    options : of the fit, with the method that was used.
    free_parameters : names, nominal values and spreads.
    covariance : (p, p), infinite and NaN where the data do not determine a parameter.
    posterior : the same uncertainty by directions; accuracy of poses and a later prior use it.
    spectrum : singular values and rank. regularization : ridge parameter or truncation, with rule
        and score; None for other methods. unidentifiable : combinations that change no measured
        value.
    residual_test : the residuals against the noise.
    prior_conflict : the stated spreads against the data, where the method uses them; else None.
    residuals : of every kind. pose_weights : (n,) by the loss; 1 without one.
    history : status, steps and values of the iteration.
    nuisance : frames, targets, surfaces and offsets of the measurements.
    poses : pose and reading estimates, where readings are uncertain; else None.
    findings : what the fit noticed.
    """

    robot: Mechanism
    initial: Mechanism
    options: FitOptions
    free_parameters: FreeParameters
    covariance: FloatArray = deferred()
    posterior: Posterior = deferred()
    spectrum: Spectrum = deferred()
    regularization: Regularization | None = deferred()
    unidentifiable: tuple[Combination, ...] = deferred()
    residual_test: ResidualTest = deferred()
    prior_conflict: PriorConflict | None = deferred()
    residuals: tuple[KindResiduals, ...] = deferred()
    pose_weights: FloatArray = deferred()
    history: History = deferred()
    nuisance: NuisanceEstimate = deferred()
    poses: EstimatedPoses | None = deferred()
    findings: tuple[Finding, ...] = deferred()

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(robot="robot.name", method=lambda fit: repr(fit.method)),
        *fields(parameters=lambda fit: fit.list_parameters()),
        *fields(interval_note=lambda fit: fit.interval_note and str(fit.interval_note)),
        *fields(local=lambda fit: fit.list_nuisance()),
        Field("rank", lambda fit: fit.rank if fit.converged else None),
        Field("condition", lambda fit: fit.spectrum.condition if fit.converged else None),
        *fields(singular_values="spectrum.singular_values", rank_tolerance="spectrum.tolerance"),
        *fields("regularization", "unidentifiable", dof="residual_test.dof"),
        *fields("chi_square", degrees="residual_test.degrees", p_value="residual_test.p_value"),
        *fields(noise="residual_test.noise", sigma_uncertainty="options.sigma_uncertainty"),
        Field("sigma_scale", lambda fit: fit.residual_test.sigma_scale if fit.converged else None),
        Field(
            "noise_degrees", lambda fit: fit.residual_test.noise_degrees if fit.converged else None
        ),
        *fields("prior_conflict", dropped="excluded_poses", readings="poses"),
        *fields(status=lambda fit: fit.status.name.lower(), iterations="history.iterations"),
        *fields(cost_history="history.cost", notes=lambda fit: list(map(str, fit.findings))),
        *fields("findings"),
        Field("unit", lambda fit: fit.free_parameters.display()[1], "parameter"),
        *(
            Field(
                name,
                lambda fit, name=name: [row[name] for row in fit.list_parameters()],
                "parameter",
            )
            for name in ("nominal", "estimate", "sd", "plus_minus", "degrees", "tolerance")
        ),
        Field(
            "covariance",
            lambda fit: fit.covariance / np.multiply.outer(*2 * [fit.free_parameters.display()[0]]),
            f"parameter {OTHER}",
            "unit times unit of other",
        ),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="names", other="names")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.free_parameters.names

    @property
    def nominal(self) -> FloatArray:
        """(p,) nominal values."""
        return self.free_parameters.nominal

    @property
    def tolerance(self) -> FloatArray:
        """(p,) tolerances used, stated or default."""
        return self.free_parameters.tolerance

    @property
    def estimate(self) -> FloatArray:
        """(p,) estimates."""
        return self.robot.values[self.free_parameters.places]

    @cached_property
    def standard_deviations(self) -> FloatArray:
        """(p,) standard deviations: infinite where the data do not determine a parameter, NaN
        without intervals.
        """
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def degrees(self) -> FloatArray:
        """(p,) effective degrees of freedom of the standard deviations (Welch-Satterthwaite):
        infinite where nothing in them was estimated.
        """
        return self.posterior.count_degrees(np.eye(len(self.names))[:, None])

    def interval(self, level: float = LEVEL) -> FloatArray:
        """Return half-widths (p,) of intervals of this coverage, by Student's t."""
        return coverage_factor(self.degrees, level) * self.standard_deviations

    @property
    def plus_minus(self) -> FloatArray:
        """Half-widths of 95 % intervals over ALL parameters of the robot, NaN for fixed ones: for
        `save_robot`.
        """
        result = np.full(len(self.robot.parameters), np.nan)
        result[self.free_parameters.places] = self.interval()
        return result

    @property
    def method(self) -> Method:
        """The method that was used."""
        assert self.options.method is not None
        return self.options.method

    @property
    def excluded_poses(self) -> tuple[str, ...]:
        """Labels of the poses that the options exclude."""
        return tuple(self.options.excluded_poses)

    @property
    def rank(self) -> int:
        """Number of directions that the data determine."""
        return self.spectrum.rank

    @property
    def status(self) -> DescentStatus:
        """How the iteration ended."""
        return self.history.status

    @property
    def converged(self) -> bool:
        """Whether the iteration converged."""
        return self.history.status is DescentStatus.CONVERGED

    @property
    def interval_note(self) -> Finding | None:
        """What the coverage of the intervals is an average over, where they use a prior."""
        if not self.converged or not self.residual_test.intervals:
            return None
        if self.options.prior is not None:
            return report_finding("prior.intervals", source="the earlier calibration")
        if self.method.has_prior and not self.free_parameters.assumed.all():
            return report_finding("prior.intervals", source="the expected spreads")
        return None

    @property
    def chi_square(self) -> float:
        """Whitened sum of squares, see `ResidualTest`."""
        return self.residual_test.chi_square

    def describe_statistics(self) -> str:
        """Return rank and chi-square. Where the iteration did not converge they belong to no fit;
        then return by how much it lowered the sum of squares, or nothing.
        """
        test, cost = self.residual_test, self.history.cost
        if self.converged:
            rank, square = f"Rank {self.rank} of {len(self.names)}.", test.chi_square
            if test.weighted:
                return f"{rank} The squares of the weighted residuals add up to {square:.5g}."
            return f"{rank} Chi-square {square:.5g} with {test.degrees:.4g} degrees of freedom."
        if not cost[-1] < cost[0]:
            return ""
        fell = f"The sum of squared residuals, each divided by its sigma, fell from {cost[0]:.3g}"
        return f"{fell} to {cost[-1]:.3g}."

    def describe_intervals(self) -> str:
        """Return coverage factor and degrees of freedom of the 95 % intervals; "" without any."""
        known = np.isfinite(self.standard_deviations)
        if not known.any():
            return ""
        nu, k = self.degrees[known], coverage_factor(self.degrees[known])
        least, most = (format(k.min(), ".3g"), format(k.max(), ".3g"))
        factor = least if least == most else f"{least} to {most}"
        law = "normal" if np.isinf(nu).all() else f"Student's t, at least {nu.min():.3g} degrees"
        return f"95 % intervals: {factor} standard uncertainties ({law})."

    def __repr__(self) -> str:
        """Return a summary on one screen; `print` shows the parameters."""
        codes = ", ".join(dict.fromkeys(finding.code for finding in self.findings))
        return "\n".join(
            [
                f"<Identification of {self.robot.name} by {type(self.method).__name__}",
                f"  {len(self.names)} parameters, {len(self.nuisance)} nuisance parameters",
                f"  {self.status.name.lower()} after {self.history.iterations} steps",
                f"  {self.describe_statistics()}",
                f"  findings: {codes or 'none'}>",
            ]
        )

    def list_fields(self) -> Iterator[Field]:
        """Yield the fields, among them the residuals of each kind (predicted - measured)."""
        yield from self.FIELDS
        for i, r in enumerate(self.residuals, 1):
            axes, named = f"row_{i} component_{i}", f"{i}_{r.kind}"
            symbols = tuple(SI_SYMBOLS[dimension] for dimension in r.dimensions)
            yield Field(f"residual_{named}", lambda _, r=r: r.raw, axes, symbols)
            yield Field(f"whitened_{named}", lambda _, r=r: r.whitened, axes, "sigma")
        yield Field("sum_of_squares", "history.cost", "step", "1")

    def list_labels(self) -> Mapping[str, Source | Sequence[Any]]:
        """Return the names along the axes, among them poses and components of the residuals."""
        named = {"step": range(len(self.history.cost))}
        for i, r in enumerate(self.residuals, 1):
            named |= {f"row_{i}": r.poses, f"component_{i}": r.components}
        return {**self.LABELS, **named}

    @property
    def plot(self) -> FitFigures:
        """The figures of the fit, such as `fit.plot.residuals()`."""
        return FitFigures(self)

    def list_nuisance(self) -> list[dict[str, Any]]:
        """Return one row for each nuisance parameter, with 95 % intervals."""
        degrees = self.nuisance.count_degrees(self.posterior.parts, self.tolerance)
        return self.nuisance.rows(coverage_factor(degrees), degrees)

    def list_parameters(self) -> list[dict[str, Any]]:
        """Return one row for each parameter, in the units of the robot's file."""
        factor, symbols = self.free_parameters.display()
        numbers = {
            "nominal": self.nominal,
            "estimate": self.estimate,
            "sd": self.standard_deviations,
            "plus_minus": self.interval(),
        }
        units = zip(factor, symbols, strict=True)
        further = zip(self.tolerance / factor, self.free_parameters.assumed.tolist(), strict=True)
        return [
            row | {"tolerance": tolerance, "tolerance_assumed": is_assumed}
            for row, (tolerance, is_assumed) in zip(
                _list_rows(self.names, units, numbers, self.degrees), further, strict=True
            )
        ]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder by name [SI]."""
        return {
            "nominal": self.nominal,
            "estimate": self.estimate,
            "sd": self.standard_deviations,
            "covariance": self.covariance,
            "singular_values": self.spectrum.singular_values,
            "estimate_history": self.history.estimate,
            "cost_history": self.history.cost,
            "weight": self.pose_weights,
            "local_estimate": self.nuisance.estimate,
            "local_sd": self.nuisance.sd,
            "local_start": self.nuisance.start,
            "local_slope": self.nuisance.slope / self.tolerance,
            "local_root": self.nuisance.root.values,
            "local_columns": self.nuisance.root.columns,
            **self.posterior.arrays(),
            **({} if self.poses is None else self.poses.arrays()),
            **store_residuals(self.residuals),
        }


class FitFigures:
    """The figures of a fit."""

    def __init__(self, fit: Identification) -> None:
        self._fit = fit

    def __repr__(self) -> str:
        return "<FitFigures: residuals(), parameters(), correlation(), convergence()>"

    def residuals(self) -> Figure:
        """Draw the residuals by pose and component, as histogram and normal plot, and against
        actuator readings, time and temperatures.
        """
        return draw(self._fit, "figure residuals")

    def parameters(self) -> Figure:
        """Draw the shift of each parameter in spreads with its 95 % interval."""
        return draw(self._fit, "figure parameters")

    def correlation(self) -> Figure:
        """Draw the correlations of the parameters as a matrix of colors."""
        return draw(self._fit, "figure correlation")

    def convergence(self) -> Figure:
        """Draw the sum of squares and the parameters by step of the iteration."""
        return draw(self._fit, "figure convergence")


def add_covariance(
    fit: Identification,
    root: FloatArray,
    degrees: float,
    finding: Finding,
    uncertain: Sequence[CovariancePart] = (),
) -> Identification:
    """Return a fit whose parameters have the additional covariance root root', root (p, k) [SI], or
    (p + U, k) where the same errors also move the setup at a known machine.

    Estimates do not change. Directions of infinite variance stay infinite, and a fit without
    intervals (NaN) stays without. The setup parameters follow the machine by their slope. `degrees`
    of freedom of the size of the covariance, infinite where it is known, count in the effective
    ones of every interval. The finding says why it is added; its code is the source of the new part
    of `posterior.parts`, which the `uncertain` ones of the old covariance follow.
    """
    root, own = np.split(np.asarray(root, dtype=np.float64), [len(fit.tolerance)])

    def move_setup() -> NuisanceEstimate:
        nuisance = fit.nuisance
        if not len(nuisance):
            return nuisance
        # infinite standard deviations stay infinite, and NaN stays NaN
        change = nuisance.slope @ (root / fit.tolerance[:, None]) + (own if len(own) else 0.0)
        added = np.where(nuisance.table.free, (change**2).sum(axis=1), 0.0)
        return replace(nuisance, sd=np.sqrt(nuisance.sd**2 + added))

    def turn_directions() -> Posterior:
        posterior = add_to_posterior(fit.posterior, CovariancePart(finding.code, root, degrees))
        posterior = replace(posterior, parts=(*posterior.parts, *uncertain))
        if not len(own) or posterior.frames is None:
            return posterior
        frames = posterior.frames.add_errors(fit.nuisance.names, fit.nuisance.estimate, own)
        return replace(posterior, frames=frames)

    return fit.with_fields(
        covariance=later(lambda: fit.covariance + root @ root.T),
        posterior=later(turn_directions),
        nuisance=later(move_setup),
        findings=later(lambda: (*fit.findings, finding)),
    )


def add_to_posterior(posterior: Posterior, part: CovariancePart) -> Posterior:
    """Return a posterior with an additional covariance, direction by direction."""
    variance, parts = posterior.variance, (*posterior.parts, part)
    if np.isnan(variance).any():
        return replace(posterior, parts=parts)
    is_finite = np.isfinite(variance)
    first, second = is_finite & posterior.determined, is_finite & ~posterior.determined
    added = np.linalg.solve(posterior.directions, part.root / posterior.unit[:, None])
    added = np.asarray(added, dtype=np.float64)
    spread = np.concatenate([np.diag(np.sqrt(np.where(is_finite, variance, 0.0))), added], axis=1)
    directions, variance = posterior.directions.copy(), variance.copy()
    turned, squares, towards = _diagonalize(spread[first])
    # the part of y2 that y1 explains: G of y1 in its principal axes
    slope = spread[second] @ towards
    directions[:, first] = posterior.directions[:, first] @ turned
    directions[:, first] += posterior.directions[:, second] @ slope
    variance[first] = squares
    rest = spread[second] - slope @ (turned.T @ spread[first])
    turned, squares, _ = _diagonalize(rest)
    directions[:, second] = posterior.directions[:, second] @ turned
    variance[second] = squares
    return replace(posterior, directions=directions, variance=variance, parts=parts)


def _diagonalize(spread: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return principal axes U (a, a) and variances (a,) of coordinates spread (a, b) times
    independent variables, and the pseudoinverse (b, a) of U' spread.
    """
    u, s, vt = np.linalg.svd(spread, full_matrices=False)
    used = are_nonzero(s)
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=used)
    return u, s**2, vt.T * inverse


# Share of all that the machine does to a nuisance parameter below which a direction does not move
# it: rounding.
SMALLEST_EFFECT = 1e-7
# Standard deviation [m] or [rad] that stands for that of a direction that no row determines.
UNDETERMINED = 1.0


@dataclass(frozen=True, eq=False)
class NuisanceEstimate(TableResult):
    """Nuisance parameters after a fit. Arrays are (U,) in the order of `table`, SI.

    table : nominal values, priors, and which were kept fixed.
    start : values that fit best at the geometry from which the fit starts; NaN where its poses do
        not determine them.
    estimate : (U,).
    sd : standard deviations; infinite where the data do not determine the parameter, 0 where it is
        fixed, NaN without an interval.
    slope : (U, p) change of the best values by the machine's deviations in spreads.
    root : square root (U, U + d) of their covariance at a known machine, empty without intervals;
        its last columns are the d directions that no row determines, with `UNDETERMINED`.
    is_unobservable : (U,) parameters with a part in a direction that no row determines, whatever
        the machine.
    display : factor to SI and symbol of the unit in which each is shown.
    is_harmless : whether the unobservable directions only displace targets and frames together,
        along directions that the platform never turns: no pose of this robot shows them.
    """

    table: ParameterTable
    start: FloatArray
    estimate: FloatArray
    sd: FloatArray
    slope: FloatArray
    root: UnknownRoot
    is_unobservable: BoolArray
    display: tuple[tuple[float, str], ...]
    is_harmless: bool = False

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("unit", lambda setup: [symbol for _, symbol in setup.display], "parameter"),
        Field("nominal", lambda setup: setup.list_shown(setup.table.nominal), "parameter"),
        Field("estimate", lambda setup: setup.list_shown(setup.estimate), "parameter"),
        Field("sd", lambda setup: setup.list_shown(setup.sd), "parameter"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="names")

    def list_shown(self, values: FloatArray) -> FloatArray:
        """Return values (U,) [SI] in the units in which they are shown."""
        return values / [factor for factor, _ in self.display]

    def __len__(self) -> int:
        return len(self.table)

    __repr__ = represent

    def __str__(self) -> str:
        """Return one line for each: name, estimate and standard deviation in its unit."""
        rows = self.rows(np.ones(len(self)), np.full(len(self), np.inf))
        table = build_table(
            "",
            rows,
            ("setup parameter", lambda row: row["name"]),
            (Column("estimate"), lambda row: format_with_uncertainty(row["estimate"], row["sd"])),
            (
                Column("standard deviation"),
                lambda row: format_uncertainty(row["sd"]) if row["free"] else "fixed",
            ),
            ("unit", lambda row: row["unit"]),
        )
        return table.to_text() if rows else "no setup parameters"

    @classmethod
    def empty(cls, parameters: int) -> NuisanceEstimate:
        """Return the estimate of no nuisance parameters at all, for p parameters."""
        nothing, slope = np.zeros(0), np.zeros((0, parameters))
        root, is_unobservable = UnknownRoot.make_empty(0), np.zeros(0, dtype=bool)
        return cls(ParameterTable(()), nothing, nothing, nothing, slope, root, is_unobservable, ())

    @property
    def names(self) -> tuple[str, ...]:
        """Names, such as `tracker.x`."""
        return self.table.names

    @property
    def values(self) -> Mapping[str, float]:
        """Estimates by name [SI]."""
        return dict(zip(self.names, self.estimate.tolist(), strict=True))

    @property
    def starts(self) -> Mapping[str, float]:
        """Values by name [SI] that fit best at the geometry from which the fit starts."""
        return dict(zip(self.names, self.start.tolist(), strict=True))

    def count_degrees(self, parts: Iterable[CovariancePart], tolerance: FloatArray) -> FloatArray:
        """Return the effective degrees of freedom (U,) of the standard deviations; infinite where
        nothing in them was estimated. The noise among the parts of the machine's posterior is also
        that of the setup parameters at a known machine; `tolerance` (p,) [SI].
        """
        is_own = self.root.columns < len(self)
        own = np.sum(self.root.values**2, axis=1, where=is_own)
        squares = []
        for part in parts:
            by_machine = ((self.slope @ (part.root / tolerance[:, None])) ** 2).sum(axis=1)
            squares.append((by_machine + own * (part.source == NOISE), part.degrees))
        return combine_degrees(self.sd**2, squares)

    def rows(self, coverage: FloatArray, degrees: FloatArray) -> list[dict[str, Any]]:
        """Return one entry for each, in its unit, ready for JSON; `coverage` (U,) is the number of
        standard deviations in `plus_minus`, `degrees` (U,) is theirs.
        """
        numbers = {
            "nominal": self.table.nominal,
            "estimate": self.estimate,
            "sd": self.sd,
            "plus_minus": coverage * self.sd,
        }
        rows = _list_rows(self.names, self.display, numbers, degrees)
        for row, entry, (factor, _) in zip(rows, self.table.entries, self.display, strict=True):
            row["tolerance"] = None if entry.tolerance is None else entry.tolerance / factor
            row["free"] = entry.free
        return rows

    def report_unobservable(self) -> tuple[Finding, ...]:
        """Return which frames, targets, surfaces and offsets cannot be determined."""
        owners = _owners(compress(self.names, self.is_unobservable))
        code = "setup.common-displacement" if self.is_harmless else "setup.unobservable"
        return (report_finding(code, names=owners),) if owners else ()


def _list_rows(
    names: Sequence[str],
    units: Iterable[tuple[float, str]],
    numbers: Mapping[str, FloatArray],
    degrees: FloatArray,
) -> list[dict[str, Any]]:
    """Return one row for each parameter, `numbers` (p,) [SI] in units of this factor and symbol."""
    return [
        {
            "name": name,
            "unit": symbol,
            **{key: float(values[i]) / factor for key, values in numbers.items()},
            "degrees": float(degrees[i]),
        }
        for i, (name, (factor, symbol)) in enumerate(zip(names, units, strict=True))
    ]


def estimate_nuisance(
    nuisance: NuisanceElimination,
    linearization: Linearization,
    robot: Mechanism,
    decomposition: Decomposition,
    variance: FloatArray,
    noise: float,
    start: FloatArray | None = None,
) -> NuisanceEstimate:
    """Return the nuisance parameters of one trial after a fit, linearized at the estimate, where
    all residuals are finite.

    `variance` (p,) is that of each direction of the decomposition, `noise` that of the whitened
    rows; NaN where no interval is given. `start` (U,) fits the initial geometry; by default the fit
    began there.
    """
    table = nuisance.local.table
    begin = linearization.next_start.first_nuisance[0] if start is None else start
    units = [choose_setup_unit(robot, entry) for entry in table.entries]
    shown = tuple((unit.factor_to_si, unit.symbol) for unit in units)
    assert linearization.nuisance is not None
    done, is_free = linearization.nuisance.elimination, nuisance.is_free
    V = decomposition.directions[0]
    slope, is_unobservable, root = done.slope[0], done.is_unobservable[0], done.list_root()
    moved = slope[is_free] @ V
    unknown = np.isinf(variance)
    moved_by_unknown = np.linalg.norm(moved[:, unknown], axis=1)
    is_infinite = moved_by_unknown > SMALLEST_EFFECT * np.linalg.norm(moved, axis=1)
    by_machine = (moved**2) @ np.where(unknown, 0.0, variance)
    # common displacements of targets and frames along directions that the platform never turns: all
    # three where it only translates, and the axis where it has one rotation
    count = int(is_free.sum() - done.rank[0])
    rotations = sum(freedom in ROTATION_AXES for freedom in robot.freedoms)
    lost = [*compress(table.entries, is_unobservable)]
    square = np.zeros(len(table))
    square[is_free] = np.where(
        is_infinite | is_unobservable[is_free],
        np.inf,
        (root.values**2).sum(axis=1)[is_free] * noise + by_machine,
    )
    root = root._replace(values=np.nan_to_num(root.values * np.sqrt(noise), posinf=0.0))
    return NuisanceEstimate(
        table,
        begin,
        linearization.nuisance.best[0],
        np.sqrt(square),
        slope,
        root.append(UNDETERMINED * done.null_directions()),
        is_unobservable,
        shown,
        count <= {0: 3, 1: 1}.get(rotations, 0)
        and all(p.dimension is Dimension.LENGTH for p in lost)
        and len(_owners(p.name for p in lost)) > 1,
    )


def add_followers(
    combinations: tuple[Combination, ...], null: FloatArray, nuisance: NuisanceEstimate
) -> tuple[Combination, ...]:
    """Add to unidentifiable combinations the frames and targets that change with them.

    The combinations must be those that describe the null space (p, d).
    """
    if not len(nuisance) or not combinations:
        return combinations
    changed = np.abs(sparsify_basis(null) @ nuisance.slope.T)
    limit = SMALLEST_EFFECT * np.abs(nuisance.slope).max(axis=1, initial=0.0)
    return tuple(
        replace(combination, nuisance=tuple(_owners(compress(nuisance.names, moved))))
        for combination, moved in zip(combinations, changed > limit, strict=True)
    )


def _owners(names: Iterable[str]) -> list[str]:
    """Return the frames, targets and surfaces to which parameters such as `tracker.x` belong."""
    return list(dict.fromkeys(name.rsplit(".", 1)[0] for name in names))
