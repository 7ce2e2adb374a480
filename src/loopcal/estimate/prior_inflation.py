# SPDX-License-Identifier: Apache-2.0
"""The prior of a fit by MAP: which parts of the tolerances are wider than stated, the tests of the
tolerances, and the uncertainty of the factors by which they are inflated.

A factor is estimated from the data that are fitted. Its error moves the estimate, by dz / d(log
factor) times the error of its logarithm, and this is added to the covariance. It also changes the
variances that the tolerances cause: with the standard deviation s of its logarithm these have the
relative standard deviation 2 s, which is that of 1 / (2 s^2) degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.added_covariance import add_covariance
from loopcal.estimate.inference.covariance_parts import TOLERANCES, CovariancePart
from loopcal.estimate.inference.posterior import find_variance_sources
from loopcal.estimate.methods.component_choice import (
    ComponentSearch,
    compute_evidence,
    estimate_variance_spread,
    predict,
    restate,
)
from loopcal.estimate.methods.detectable_deviations import report_undetectable
from loopcal.estimate.methods.inflated_tolerances import (
    InflatedTolerances,
    are_penalized,
    estimate_excess_noise,
    estimate_factor_spread,
)
from loopcal.estimate.methods.penalties import MAP, Method
from loopcal.estimate.methods.prior_conflict import PriorConflict, assess_prior_conflict
from loopcal.estimate.methods.tolerance_components import (
    ToleranceComponent,
    compute_prior_covariance,
    list_components,
)
from loopcal.estimate.minimization.descent import Descent
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray

ROUNDS = 4
"""Fits at most until the chosen components are those of the fit."""

SAME_FACTOR = 0.05
"""Relative change of a component's factor below which the fit is not repeated."""


def choose_methods(
    free: FreeParameters, fit: Descent, method: Method, trials: Sequence[int] | None = None
) -> dict[int, MAP]:
    """Return the method with which a trial must be fitted again, by trial.

    These are trials whose data ask for other components of the tolerances than those of `method`.

    Parameters
    ----------
    free : the parameters. fit : of t trials by `method`. trials : that are asked, default all.
    """
    if not (isinstance(method, MAP) and isinstance(method.inflation, InflatedTolerances)):
        return {}
    candidates = list_components(free, method.inflation.by)
    converged = np.flatnonzero(fit.status == DescentStatus.CONVERGED.value)
    if not candidates or not len(converged):
        return {}
    chosen: dict[int, MAP] = {}
    rows = _divide(fit.decomposition, method)
    for i in (
        converged
        if method.components
        else _screen(
            rows, method.read_inflation(fit.decomposition, fit.penalty), candidates, converged
        )
    ):
        unpenalized = method.unpenalized(len(free))
        trial_rows = rows.take(np.array([i]))
        components = ComponentSearch(
            trial_rows, method.correlation, unpenalized, candidates
        ).choose()
        if not _are_same(components, method.components):
            chosen[int(i)] = replace(method, components=components)
    return chosen


def run_prior_tests(
    free: FreeParameters, fit: Descent, method: Method
) -> tuple[PriorConflict | None, list[Finding]]:
    """Return the tests of the prior, where the method uses one, and their findings: those on the
    tolerances, and which deviations from them the data could not show.
    """
    if not isinstance(method, MAP):
        return None, []
    rows = _divide(_restate_as_stated(free, fit, method), method)
    inflation = float(method.read_inflation(fit.decomposition, fit.penalty)[0])
    conflict = assess_prior_conflict(free, rows, inflation, fit.deviation[0], method.components)
    if fit.status[0] != DescentStatus.CONVERGED.value:
        return conflict, []
    return conflict, [*conflict.report(), *report_undetectable(free, rows)]


def _restate_as_stated(free: FreeParameters, fit: Descent, method: MAP) -> Decomposition:
    """Return the decomposition of the rows for the tolerances as stated."""
    if not method.components:
        return fit.decomposition
    stated = compute_prior_covariance(len(free), method.correlation, ())
    return restate(fit.decomposition, stated, method.unpenalized(len(free)))


def add_factor_uncertainty(result: Identification, fit: Descent) -> Identification:
    """Return the result with the uncertainty of the factors that inflated its tolerances.

    Nothing is added where the tolerances count as stated: below 1 no factor is used, and its
    distribution has no error to one side.
    """
    method = result.method
    if not (isinstance(method, MAP) and callable(method.inflation) and result.converged):
        return result
    factor = float(method.read_inflation(fit.decomposition, fit.penalty)[0])
    if factor <= 1.0 and not method.components:
        return result
    errors = [_estimate_factor_error(result, fit, factor)] if factor > 1.0 else []
    errors += _estimate_component_errors(fit, method, factor)
    scale = result.tolerance[:, None]
    component_rows = tuple(component.to_row(result.names) for component in method.components)
    finding = report_finding("prior.inflation", factor=factor, parts=component_rows)
    change = np.concatenate([error.change[:, None] for error in errors], axis=1)
    inflated = add_covariance(result, scale * change, np.inf, finding)
    uncertain = [CovariancePart(TOLERANCES, scale * e.caused, e.degrees) for e in errors]
    posterior = inflated.posterior
    return replace(inflated, posterior=replace(posterior, parts=(*posterior.parts, *uncertain)))


class _FactorError(NamedTuple):
    """What an error of a factor does.

    Attributes
    ----------
    change : (p,) of the estimate, in tolerances, by one standard deviation of the log factor.
    caused : (p, k) root of the covariance, in tolerances, that the inflated deviations cause.
    spread : standard deviation of the log factor.
    """

    change: FloatArray
    caused: FloatArray
    spread: float

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the variance that the deviations cause."""
        return 0.5 / self.spread**2


def _estimate_factor_error(result: Identification, fit: Descent, factor: float) -> _FactorError:
    """Return what the error of the factor on all tolerances does.

    In the coordinates y of the decomposition the estimate changes by 2 (1 - f_i) y_i; deviations
    of the variance tau_i^2 cause the error (1 - f_i) tau_i.
    """
    method = result.method
    assert isinstance(method, MAP)
    d, penalty = fit.decomposition, np.where(np.isfinite(fit.penalty), fit.penalty, 0.0)
    spread = float(estimate_factor_spread(_divide(d, method), np.array([factor]))[0])
    change = 2.0 * (1.0 - d.filter_factors(penalty)) * d.solution(fit.penalty)
    change = np.where(penalty > 0.0, change, 0.0)
    test, free = result.residual_test, result.free_parameters
    prior = find_variance_sources(d, fit.penalty, test, method, free).prior
    inverse = np.divide(1.0, penalty, out=np.zeros_like(penalty), where=penalty > 0.0)
    variance = inverse if prior is None else np.where(penalty > 0.0, prior, 0.0)
    left = (1.0 - d.filter_factors(penalty)) * np.sqrt(variance)
    caused = d.scale[:, None] * d.directions[0] * left[0]
    return _FactorError(d.deviation(change * spread)[0], caused, spread)


def _estimate_component_errors(fit: Descent, method: MAP, factor: float) -> list[_FactorError]:
    """Return what the errors of the factors of the components do.

    With the covariance S of the prior z = S h, and a variance v of E changes it by dz / dv = (1 - S
    Q) E E'h (`component_choice`), v = factor^2 - 1 of the component. Its deviations E w cause the
    error (1 - S Q) E w of the estimate.
    """
    rows, p = _divide(fit.decomposition, method), len(fit.deviation[0])
    data = predict(rows, np.array([factor]))
    Q, h = data.information[0], data.score[0]
    S = factor**2 * compute_prior_covariance(p, method.correlation, method.components)
    # parameters without a tolerance follow the others
    penalized = are_penalized(rows)
    errors = []
    for component in method.components:
        others = tuple(c for c in method.components if c is not component)
        stated = compute_prior_covariance(p, method.correlation, others)
        alone = restate(rows, stated, method.unpenalized(p))
        variance = factor**2 * component.variance
        spread = estimate_variance_spread(predict(alone, np.array([factor])), component, variance)
        E = component.columns(p)
        left = E - S @ (Q @ E)
        left = rows.deviation(np.where(penalized, rows.coordinates(left.T), 0.0)).T
        change = left @ (E.T @ h) * (2.0 * (1.0 + variance) * spread)
        errors.append(_FactorError(change, left * np.sqrt(variance), spread))
    return errors


def _divide(decomposition: Decomposition, method: MAP) -> Decomposition:
    """Return the decomposition of the rows divided by the noise that they show."""
    divided = decomposition.divided(method.sigma(decomposition))
    return divided.divided(estimate_excess_noise(divided))


def _screen(
    rows: Decomposition,
    factor: FloatArray,
    candidates: tuple[ToleranceComponent, ...],
    converged: np.ndarray,
) -> np.ndarray:
    """Return the converged trials in which any component has more evidence than none, besides the
    stated or the inflated tolerances.
    """
    rows, factor = rows.take(converged), factor[converged]
    evidence = compute_evidence(predict(rows, np.ones(len(factor))), candidates)
    if (factor > 1.0).any():
        evidence = np.maximum(evidence, compute_evidence(predict(rows, factor), candidates))
    return np.asarray(converged[(evidence > 0.0).any(axis=1)])


def _are_same(
    first: tuple[ToleranceComponent, ...], second: tuple[ToleranceComponent, ...]
) -> bool:
    """Return whether components are the same and their factors nearly so."""
    factors, other_factors = (
        {(c.kind, c.places): c.factor for c in components} for components in (first, second)
    )
    return factors.keys() == other_factors.keys() and all(
        abs(factor / other_factors[key] - 1.0) <= SAME_FACTOR for key, factor in factors.items()
    )
