# SPDX-License-Identifier: Apache-2.0
"""Calibrate a machine again: keep what the earlier calibration knows, and test whether the machine
has changed.

Two fits of the new rows with the earlier posterior are compared: one keeps all parameters of the
earlier calibration, one has no information on those in question. If nothing has changed, the
decrease of chi-square from the first to the second has a chi-square distribution; its degrees of
freedom are the directions that the second fit frees and the rows determine. It is the chi-square of
the change against its predicted covariance. The noise of both calibrations is the one that their
residuals show, so that a wrong sigma moves no machine; the probability allows for the uncertainty
of that noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import check_types, identify
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.prior import Prior, limb_parameters, prior_from, with_shown_noise
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.findings.catalog.phrases import MACHINE
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import compute_averaged_tail
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.typing import FloatArray, Progress, report_no_progress

MOST_TRIED = 60
"""Number of parameters up to which each is tried alone as the explanation of a change."""

CHANGE_LEVEL = 0.05
"""Probability of finding a change of a machine that has not changed."""

TOO_WELL = 1e-3
"""Probability of a chi-square as small as that of new data which contain rows of the earlier
calibration in a form that `loopcal.measure.fitted_rows.FittedRows` does not recognize.
"""

EXPLAINED = 0.5
"""A single parameter explains a change if freeing it leaves less than this share of chi-square."""


@dataclass(frozen=True, eq=False)
class Change(Result):
    """Whether parameters have changed between two calibrations.

    Attributes
    ----------
    subject : a limb, or "the machine". names : the parameters in question.
    change : (k,) estimate without the earlier calibration minus the earlier estimate [SI].
    chi_square, degrees : of the change, in units of the noise that both calibrations show.
    p_value : probability of a larger chi_square, which allows for the uncertainty of that noise;
        NaN where the new rows determine none of these parameters, or a fit did not converge.
        A p_value above 1 - TOO_WELL says that the two calibrations may share rows.
    moved : whether they have changed; None where it cannot be decided.
    finding : the result with its code.
    """

    subject: str
    names: tuple[str, ...]
    change: FloatArray
    chi_square: float
    degrees: float
    p_value: float
    moved: bool | None
    finding: Finding

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("subject", "names", "change", "chi_square", "degrees", "p_value", "moved"),
        sentence=lambda change: str(change.finding),
    )

    def __str__(self) -> str:
        return str(self.finding)


def recalibrate(
    robot: Mechanism,
    data: Measurements,
    earlier: Posterior,
    free_limb: str | None = None,
    *,
    options: FitOptions | None = None,
    progress: Progress = report_no_progress,
) -> tuple[Identification, Change]:
    """Identify a robot from new measurements and an earlier calibration.

    Parameters
    ----------
    robot : its table states what is nominal and tolerated. data : the new measurements.
    earlier : `Identification.posterior`, or the one of a run folder.
    free_limb : a limb that was repaired. Its parameters get the tolerances of the robot file about
        nominal again; the others keep what the earlier calibration knows of them.
    options : see `FitOptions`. The method is least squares: the prior replaces the tolerances.
    progress : receives the fits that are done where the machine has changed.

    Returns
    -------
    fit, change : the identification, and whether the limb (or without one, the machine) has changed
        since the earlier calibration.

    Raises
    ------
    EstimationError : an unknown limb, other parameters, an earlier calibration without uncertainty,
        or options with another method, a loss or a prior.
    """
    check_types(robot, data)
    options = _check_options(merge_options(options))
    prior = prior_from(earlier)
    _check_names(robot, prior)
    names = prior.names if free_limb is None else limb_parameters(robot, free_limb)
    change = assess_change(robot, data, earlier, names, free_limb or MACHINE, options, progress)
    if free_limb is not None:  # a freed limb is at its tolerances again
        free = select_free_parameters(robot)
        places = [free.names.index(name) for name in names]
        nominal, tolerance = free.nominal[places], free.tolerance[places]
        prior = prior.without(names).toleranced(names, nominal, tolerance)
    chosen = replace(options, prior=prior)
    fit = identify(robot, data, LeastSquares(), options=chosen, progress=progress)
    return replace(fit, findings=(*fit.findings, change.finding)), change


def assess_change(
    robot: Mechanism,
    data: Measurements,
    earlier: Posterior,
    names: tuple[str, ...],
    subject: str,
    options: FitOptions | None = None,
    progress: Progress = report_no_progress,
) -> Change:
    """Test whether the parameters `names` are still those of an earlier calibration; `subject` is
    their common name for the finding. Both calibrations count with the noise that their residuals
    show.
    """
    options = replace(options or FitOptions(), method=LeastSquares(), noise="given")
    prior = prior_from(with_shown_noise(earlier))

    def fit_with(used: Prior) -> Identification:
        chosen = replace(options, prior=used)
        return identify(robot, data, options=chosen, progress=progress)

    alone = fit_with(prior.without(prior.names))
    sigma, noise_degrees = _find_new_noise(alone, earlier)
    prior = prior.scaled(sigma)
    is_whole = len(names) == len(prior.names)
    kept, freed = fit_with(prior), alone if is_whole else fit_with(prior.without(names))
    of_prior, of_fit = ([table.index(n) for n in names] for table in (prior.names, freed.names))
    change = freed.estimate[of_fit] - prior.mean[of_prior]
    degrees = kept.residual_test.degrees - freed.residual_test.degrees
    gain = max(kept.chi_square - freed.chi_square, 0.0) / sigma**2
    if degrees < 1.0 or not (kept.converged and freed.converged):
        code = "prior.change-not-observable" if degrees < 1.0 else "prior.change-not-converged"
        finding = report_finding(code, subject=subject)
        return Change(subject, names, change, gain, degrees, np.nan, None, finding)
    by_noise, known = _divide_by_source(prior, names, kept, freed)
    by_new = max(degrees - by_noise - known, 0.0)
    sources = ((by_noise, prior.noise_degrees), (known, np.inf), (by_new, noise_degrees))
    p_value = compute_averaged_tail(gain, degrees, sources)
    moved = p_value < CHANGE_LEVEL
    numbers = {"chi_square": gain, "degrees": degrees, "p_value": p_value, "level": CHANGE_LEVEL}
    code, single = "prior.machine-unchanged", {}
    if p_value > 1.0 - TOO_WELL:
        code = "prior.agrees-too-well"
        numbers = {"chi_square": gain, "degrees": degrees, "p_value": 1.0 - p_value}
    if moved:
        code = "prior.machine-changed"
        single = _explain_by_one(robot, data, prior, names, kept.chi_square, options, progress)
    finding = report_finding(code, subject=subject, **numbers, **single)
    return Change(subject, names, change, gain, degrees, p_value, moved, finding)


def _find_new_noise(alone: Identification, earlier: Posterior) -> tuple[float, float]:
    """Return the noise of the new rows, in units of the stated sigma, and its degrees of freedom.

    It is what the residuals of a fit without the earlier calibration show. Where they leave fewer
    than five degrees of freedom, it is the larger of the stated noise, as far as they correct it,
    and the one that the residuals of the earlier calibration show.
    """
    own, before = alone.posterior.shown_noise, earlier.shown_noise
    if own is not None and own.is_known:
        return float(np.sqrt(own.variance)), own.degrees
    test = alone.residual_test
    stated = (test.sigma_scale, test.noise_degrees) if test.converged else (1.0, np.inf)
    if before is None or not before.is_known or before.variance <= stated[0] ** 2:
        return stated
    return float(np.sqrt(before.variance)), before.degrees


def _divide_by_source(
    prior: Prior, names: tuple[str, ...], kept: Identification, freed: Identification
) -> tuple[float, float]:
    """Return how many degrees of freedom of the chi-square of a change the noise of the earlier
    rows causes, and how many the known uncertainty of the earlier calibration, such as tolerances.

    The chi-square is the squared length of the projection of all rows on as many dimensions as it
    has degrees of freedom. The part of a row is its leverage in the fit that allows a change, less
    that in the fit without one.
    """
    depending, others = prior.split(names)
    part = (depending**2).sum(axis=1)
    part += _compute_leverage(others @ prior.without(names).rows, freed)
    part = np.maximum(part - _compute_leverage(prior.rows, kept), 0.0)
    share = np.ones(len(part)) if prior.noise_share is None else prior.noise_share
    return float(share @ part), float((1.0 - share) @ part)


def _compute_leverage(rows: FloatArray, fit: Identification) -> FloatArray:
    """Return the leverage (r,) of rows (r, p) [1 / SI] of unit variance in a fit."""
    root = fit.posterior.root / fit.residual_test.sigma_scale
    return np.asarray(((rows @ root) ** 2).sum(axis=1))


def _explain_by_one(
    robot: Mechanism,
    data: Measurements,
    prior: Prior,
    names: tuple[str, ...],
    kept: float,
    options: FitOptions,
    progress: Progress,
) -> dict[str, Any]:
    """Return which single parameter explains most of a change: `tried`, `parameter`, `change`."""
    unexplained = {"tried": len(names) <= MOST_TRIED, "parameter": "", "change": ""}
    if len(names) > MOST_TRIED:
        return unexplained
    fits = []
    for done, name in enumerate(names):
        progress(done, len(names), "trying each parameter as the change")
        fits.append(identify(robot, data, options=replace(options, prior=prior.without((name,)))))
    values = [fit.chi_square if fit.converged else np.inf for fit in fits]
    best = int(np.argmin(values))
    fit, name = fits[best], names[best]
    if not values[best] < EXPLAINED * kept:
        return unexplained
    i = fit.names.index(name)
    factor, symbols = fit.free_parameters.display()
    change = (fit.estimate[i] - prior.mean[prior.names.index(name)]) / factor[i]
    return {"tried": True, "parameter": name, "change": f"{change:+.3g} {symbols[i]}"}


def _check_options(options: FitOptions) -> FitOptions:
    """Return options for fits with an earlier calibration; refuse those that contradict it."""
    if options.method is not None and not isinstance(options.method, LeastSquares):
        raise EstimationError(
            f"method is {options.method!r}; recalibration uses LeastSquares(), because the earlier "
            "calibration replaces the tolerances"
        )
    if options.loss is not None or options.prior is not None:
        name = "loss" if options.loss is not None else "prior"
        raise EstimationError(f"recalibration takes no {name}; remove it from the options")
    return options


def _check_names(robot: Mechanism, prior: Prior) -> None:
    """Refuse a prior of another robot."""
    free = select_free_parameters(robot).names
    for name in (*prior.names, *free):
        if name not in prior.names or name not in free:
            place = "the earlier run" if name in prior.names else "the robot file"
            raise EstimationError(report_finding("prior.other-parameters", name=name, place=place))
