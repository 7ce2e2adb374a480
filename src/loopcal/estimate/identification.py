# SPDX-License-Identifier: Apache-2.0
"""Identify the free parameters of a robot from measurements, with all diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from loopcal.errors import DataError, EstimationError, suggest_names
from loopcal.estimate.descent import Descent
from loopcal.estimate.fit_descent import fit_with_tolerances, get_method, report_closure_start
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.losses import Loss
from loopcal.estimate.nuisance_estimate import NuisanceEstimate, add_followers, estimate_nuisance
from loopcal.estimate.null_space import describe_null_space
from loopcal.estimate.observation_rows import Residuals, linked_blocks
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.penalties import LeastSquares, Method, adapt_method, describe_regularization
from loopcal.estimate.pose_estimate import (
    estimate_poses,
    find_unclosed_poses,
    predict_from_readings,
    report_doubtful_readings,
    report_uneven_sigmas,
)
from loopcal.estimate.pose_linearization import PoseEstimates
from loopcal.estimate.posterior import (
    collect_information,
    compute_posterior,
    find_shown_noise,
    find_variance_sources,
)
from loopcal.estimate.prior import refuse_reused_rows
from loopcal.estimate.prior_inflation import add_factor_uncertainty, run_prior_tests
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.residual_test import FEWEST_DEGREES, ResidualTest, run_residual_test
from loopcal.estimate.result import (
    History,
    Identification,
    Spectrum,
    label_residuals,
    report_divergence,
    report_equations,
    report_unknown_bias,
    report_used_poses,
)
from loopcal.estimate.robust_descent import add_loss_uncertainty
from loopcal.estimate.unfixed_motions import FrameRows, describe_frames
from loopcal.findings import Finding, report_finding
from loopcal.measure.array_checks import check_type
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.fitted_rows import FittedRows, collect_fitted_rows
from loopcal.measure.kinds.kind import list_error_groups
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.readings import fill_in_reading_sigma, weight_reading_sigma
from loopcal.mechanism.compilation import find_impossible_values
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.parameters import ParameterTable
from loopcal.typing import FloatArray, Progress, report_no_progress

HUGE = 1e150
"""Residuals, in units of sigma, whose squares cannot be summed."""


def check_types(robot: object, data: object) -> None:
    """Refuse anything but a robot and measurements, such as file names."""
    check_type(robot, Mechanism, "robot", "as from loopcal.load_robot('hexapod-42')")
    check_type(data, Measurements, "data", "as from load_measurements('data.csv', robot)")


def prepare_fitted_data(fit: Identification, data: Measurements) -> Measurements:
    """Return the measurements of a fit as it used them: with the sigma of their readings, without
    excluded poses. Raises DataError unless they have as many poses as the fit was made from.
    """
    if data.n_poses != len(fit.pose_weights):
        raise DataError(
            f"the data have {data.n_poses} poses, but the fit was made from "
            f"{len(fit.pose_weights)}; give the measurements that were fitted, without held-out "
            "poses"
        )
    return exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)


def exclude_poses(data: Measurements, excluded: Sequence[str]) -> Measurements:
    """Return the measurements with weight 0 for every row and reading of poses of these labels;
    they keep their places. Raises DataError for an unknown label.
    """
    if not excluded:
        return data
    known, unwanted = set(data.labels), set(excluded)
    for label in excluded:
        if label not in known:
            raise DataError(
                f"no pose {label!r} to exclude{suggest_names(label, data.labels)}; give labels of "
                "poses in the data"
            )
    kept = np.array([label not in unwanted for label in data.labels])
    observations = tuple(
        o.with_weights(o.weight * kept[o.rows].reshape(len(o), o.kind.poses_per_row).all(axis=1))
        for o in data.observations
    )
    return replace(
        data,
        observations=observations,
        reading_sigma=weight_reading_sigma(data.reading_sigma, kept.astype(np.float64)),
    )


def check_rows(problem: Problem, data: Measurements, robot: Mechanism) -> None:
    """Refuse readings of another robot, held-out poses, a robot without free parameters, and data
    without any row.
    """
    check_actuators(data, robot)
    if count := int(data.is_held_out.sum()):
        raise DataError(report_finding("data.held-out-fitted", count=count))
    if problem.parameters == 0:
        raise EstimationError(
            report_finding("fit.no-free-parameter", robot=robot.name, total=len(robot.parameters))
        )
    if problem.residual_count[0] == 0:
        raise EstimationError(report_finding("fit.no-measured-value"))


def check_count(problem: Problem, data: Measurements, method: Method, allow_fewer: bool) -> None:
    """Refuse fewer equations than parameters where the method has no prior to fill the gap."""
    nuisance = 0 if problem.nuisance is None else problem.nuisance.unpenalized_count
    required = method.required_equations(problem.parameters)
    m, p = int(problem.equations[0]), required + nuisance
    if m >= p or allow_fewer:
        return
    if m == 0:
        raise EstimationError(
            report_finding("fit.no-equation-left", poses=data.n_poses, unknowns=p)
        )
    raise EstimationError(
        report_finding(
            "fit.too-few-equations",
            equations=m,
            poses=data.n_poses,
            unknowns=p,
            nuisance=nuisance,
            has_prior=required != problem.parameters,
            poses_needed=int(np.ceil(p * data.n_poses / m)),
        )
    )


def check_start(
    problem: Problem, data: Measurements, deviation: FloatArray, cost: FloatArray
) -> None:
    """Refuse a start at which some residuals are not finite, with the poses."""
    if np.isfinite(cost[0]):
        return
    start = problem.start(deviation)
    lost = problem.poses.find_unreached(deviation, start)
    if len(lost) > 0:
        raise EstimationError(
            report_finding(
                "fit.poses-out-of-reach",
                count=len(lost),
                total=data.n_poses,
                poses=tuple(data.labels[i] for i in lost),
            )
        )
    with np.errstate(all="ignore"):
        residuals = problem.residuals(deviation, problem.solve(deviation, start))
    bad = {
        int(i)
        for s, r in zip(problem.rows, residuals, strict=True)
        for i in s.poses_by_link[~(np.abs(r.whitened[0]) < HUGE).all(axis=1)].ravel()
    }
    raise EstimationError(
        report_finding("fit.residuals-not-finite", poses=tuple(data.labels[i] for i in sorted(bad)))
    )


def fit_setup_alone(
    robot: Mechanism, data: Measurements, nuisance: NuisanceParameters
) -> FloatArray:
    """Return nuisance parameters (U,) [SI] that fit measurements best at the robot's geometry.

    Poses that the geometry does not reach do not count. NaN where the others do not determine the
    parameters, and no value is stated.
    """
    table = nuisance.table
    unknown = np.where(table.free & np.isnan(table.tolerance), np.nan, nuisance.values())
    solution, known = predict_from_readings(robot, data)
    reached = solution.converged & known
    if not reached.any():
        return unknown
    reached_data = data.take(reached)
    reached_setup = reached_data.nuisance_parameters
    entries = {entry.name: entry for entry in table.entries}
    stated = ParameterTable(tuple(entries[name] for name in reached_setup.table.names))
    nothing = np.zeros(0)
    fixed = FreeParameters(robot, nothing.astype(np.int64), nothing, nothing, nothing.astype(bool))
    setup, z = replace(reached_setup, table=stated), nothing[None]
    problem = problem_of(fixed, reached_data, setup)
    try:
        fitted = problem.solve(z, problem.start(z)).nuisance
    except DataError:  # too few rows for a closed form
        return unknown
    values = {} if fitted is None else dict(zip(reached_setup.table.names, fitted[0], strict=True))
    return np.array([values.get(name, unknown[i]) for i, name in enumerate(table.names)])


ASSUMED = "assumed"
"""Noise that nobody stated: a program that wrote the measurements assumed it."""


def choose_noise(options: FitOptions, data: Measurements, left: int) -> FitOptions:
    """Return options that estimate the noise where all of it is assumed; `left` is the number of
    equations less that of all unknowns.
    """
    is_free = options.noise == "given" and options.prior is None
    if is_free and data.noise_source == ASSUMED and left >= FEWEST_DEGREES:
        return replace(options, noise="estimated")
    return options


def report_noise(data: Measurements, robot: Mechanism, test: ResidualTest) -> Finding:
    """Return the residuals against the noise, with assumed and estimated sigmas where some are."""
    if data.noise_source == "stated" or not test.converged or test.weighted:
        return test.finding
    if test.noise == "estimated":
        if not test.intervals:
            return test.finding
        sigmas = _list_sigmas(data, robot, test.sigma_scale)
        return report_finding("noise.assumed-replaced", sigmas=sigmas, dof=test.dof)
    if test.degrees < 0.5 or np.isnan(test.p_value):
        return report_finding("noise.assumed-untested", sigmas=_list_sigmas(data, robot, 1.0))
    ratio = float(np.sqrt(test.chi_square / test.degrees))
    return report_finding(
        "noise.assumed",
        sigmas=_list_sigmas(data, robot, ratio),
        ratio=ratio,
        degrees=test.degrees,
        p_value=test.p_value,
    )


def _list_sigmas(data: Measurements, robot: Mechanism, scale: float) -> list[dict[str, Any]]:
    """Return kind, quantity, assumed and estimated sigma of each quantity with assumed noise."""
    sigmas: dict[tuple[str, str], dict[str, Any]] = {}
    for rows in (o for o in data.observations if o.is_noise_assumed and len(o)):
        variance = np.diagonal(rows.covariance, axis1=1, axis2=2)
        for group in list_error_groups(rows.kind):
            sigma = float(np.sqrt(np.median(variance[:, list(group.columns)])))
            values = (robot.to_quantity(value, group.dimension) for value in (sigma, scale * sigma))
            assumed, estimated = values
            sigmas[rows.kind.name, group.quantity] = {
                "kind": rows.kind.name,
                "quantity": group.quantity,
                "assumed": assumed,
                "estimated": estimated,
            }
    return list(sigmas.values())


def identify(
    robot: Mechanism,
    data: Measurements,
    method: Method | None = None,
    *,
    loss: Loss | None = None,
    options: FitOptions | None = None,
    progress: Progress = report_no_progress,
) -> Identification:
    """Identify the free parameters of a robot; see `loopcal.estimate.penalties`.

    Parameters
    ----------
    robot : its values are the start; its table states what is nominal, free and tolerated.
    data : the measurements. Where a reading has a sigma, given or stated by the robot, its pose is
        estimated as well (docs/theory/uncertain-readings.md).
    method, loss : in place of those of `options`.
    options : see `FitOptions`. By default stated tolerances are a prior, which is inflated where
        the data contradict it.
    progress : receives the steps of the iteration, with the sum of squares.

    Returns
    -------
    Identification; an iteration that did not converge is no error: see `status` and `findings`.

    Raises
    ------
    EstimationError : nothing to identify, fewer equations than parameters, poses out of reach at
        the start, or redundant readings that contradict each other so widely that the fit does not
        converge.
    """
    check_types(robot, data)
    options = merge_options(options, method, loss)
    free = select_free_parameters(robot)
    default = LeastSquares() if options.prior is not None else None
    data = exclude_poses(fill_in_reading_sigma(robot, data), options.excluded_poses)
    problem = problem_of(free, data, options.nuisance)
    check_rows(problem, data, robot)
    refuse_reused_rows(options.prior, data)
    unknowns = len(free) + (0 if problem.nuisance is None else problem.nuisance.unpenalized_count)
    options = choose_noise(options, data, int(problem.equations[0]) - unknowns)
    method = adapt_method(options.method or default, free.assumed, options.noise, free.correlation)
    options = replace(options, method=method)
    check_count(problem, data, method, options.allow_fewer_equations or options.prior is not None)
    values = robot.values if options.start is None else np.asarray(options.start)
    z = free.deviation(robot.with_values(values).values[None])
    fit, weights, weighted, options = fit_with_tolerances(problem, data, z, options, free, progress)
    if fit.status[0] == DescentStatus.BAD_START.value:
        check_start(problem, data, z, fit.cost)
    unclosed = find_unclosed_poses(robot.with_values(values), data)
    if fit.status[0] != DescentStatus.CONVERGED.value and unclosed.are_most:
        raise EstimationError(unclosed.report("fit.poses-open"))
    result = _assemble(robot, free, options, data, fit, weights, problem, weighted)
    result = add_factor_uncertainty(result, fit)
    if options.loss is not None:
        result = add_loss_uncertainty(result, fit, problem, weighted, linked_blocks(data))
    findings = list(result.findings)
    rows: FittedRows | None = collect_fitted_rows(
        data, are_readings_fitted=robot.program.sigma is not None
    )
    if (earlier := options.prior) is not None:
        if earlier.fitted_rows is None:
            findings.append(report_finding("prior.rows-unknown"))
        rows = None if earlier.fitted_rows is None else earlier.fitted_rows.joined(rows)
    if unclosed.poses:
        findings.append(unclosed.report("fit.poses-open-at-start"))
    d, test = fit.decomposition, result.residual_test
    posterior = replace(
        result.posterior,
        fitted_rows=rows,
        shown_noise=find_shown_noise(d, test),
        information=collect_information(free, d, test),
    )
    return replace(result, posterior=posterior, findings=tuple(findings))


def _examine_estimate(
    problem: Problem, weighted: Problem, fit: Descent
) -> tuple[PoseEstimates | None, tuple[Residuals, ...], Linearization | None, FloatArray | None]:
    """Solve and evaluate the rows of a fit once more, where its last step ended.

    Poses and residuals are those of the rows without weights of a loss, at the setup parameters of
    the weighted ones; None: exact readings. The linearization is that of the weighted rows; None
    without setup parameters. The last are the unfixed motions, see `FrameRows.find_unfixed`.
    """
    z, start = fit.deviation, fit.start
    solution, linearization, nuisance = None, None, None
    if weighted.nuisance is not None:
        solution = weighted.solve(z, start, derivatives=True)
        linearization, nuisance = weighted.linearize_at(z, start, solution), solution.nuisance
    if solution is None or weighted is not problem:
        solution = problem.solve(z, start, nuisance)
    rows = FrameRows(weighted, nuisance)
    residuals = problem.residuals(z, solution, rows.add)
    return solution.estimates, residuals, linearization, rows.find_unfixed()


def _assemble(
    robot: Mechanism,
    free: FreeParameters,
    options: FitOptions,
    data: Measurements,
    fit: Descent,
    weights: FloatArray,
    problem: Problem,
    weighted: Problem,
) -> Identification:
    """Return the result of a fit with all diagnostics."""
    converged = bool(fit.status[0] == DescentStatus.CONVERGED.value)
    d, penalty, method = fit.decomposition, fit.penalty, get_method(options)
    is_assumed = options.noise == "given" and data.noise_source != "stated"
    noise, is_weighted = ASSUMED if is_assumed else options.noise, options.loss is not None
    test = run_residual_test(d, penalty, noise, options.sigma_uncertainty, is_weighted, converged)
    sources = find_variance_sources(d, penalty, test, method, free)
    test = replace(test, intervals=bool(np.isfinite(sources.noise)))
    estimates, residuals, linearization, unfixed = _examine_estimate(problem, weighted, fit)
    conflict, on_prior = run_prior_tests(free, fit, method)
    plain, values = d.plain(), free.values(fit.deviation)[0]
    corrected, setup = robot.with_values(values), weighted.nuisance
    nuisance = NuisanceEstimate.empty(problem.parameters)
    if setup is not None and linearization is not None:
        # a fit begins with the setup that fits its first robot best, with all poses and no weights
        began_there = options.start is None and not is_weighted
        baseline = None
        if not (began_there and np.isfinite(fit.cost_history[0, 0])):
            baseline = fit_setup_alone(robot, data.with_weights(weights), setup.local)
        variance = d.variances(penalty, *sources)[0]
        nuisance = estimate_nuisance(
            setup, linearization, robot, d, variance, sources.noise, baseline
        )
    frames = describe_frames(weighted, data, unfixed, options.prior, linearization, sources.noise)
    null_space = plain.null_space()
    unidentifiable = add_followers(describe_null_space(free, null_space), null_space, nuisance)
    excluded = tuple(options.excluded_poses)
    poses, on_poses = None, []
    if estimates is not None:
        poses = estimate_poses(estimates, data, excluded)
        doubtful = report_doubtful_readings(corrected, poses)
        on_poses = [*poses.report(), *doubtful, *report_uneven_sigmas(problem)]
    history = History(
        status=DescentStatus(int(fit.status[0])),
        iterations=int(fit.iterations[0]),
        cost=fit.cost_history[:, 0],
        estimate=free.nominal + free.tolerance * fit.deviation_history[:, 0],
    )
    regularization = describe_regularization(method, d, penalty)
    findings = [
        *([] if converged else [history.finding]),
        report_noise(data, robot, test),
        *report_divergence(free, fit.deviation[0], method, converged),
        *(finding for _, finding in find_impossible_values(robot, values)),
        *on_prior,
        *(combination.finding for combination in unidentifiable),
        *nuisance.report_unobservable(),
        *free.findings(),
        *report_closure_start(problem, options, fit),
        *([] if regularization is None else [regularization.finding]),
        *report_unknown_bias(free, method, sources.prior),
        *report_equations(int(problem.equations[0]), problem.parameters, method),
        *report_used_poses(data, weights, options.loss, excluded),
        *on_poses,
    ]
    return Identification(
        robot=corrected,
        initial=robot,
        options=options,
        free_parameters=free,
        covariance=d.covariance(penalty, *sources)[0] * free.tolerance[:, None] * free.tolerance,
        posterior=compute_posterior(
            corrected, free.places, free.tolerance, d, penalty, sources, frames, test.noise_degrees
        ),
        spectrum=Spectrum(
            int(plain.rank[0]), float(plain.condition[0]), plain.singular_values[0], d.tolerance
        ),
        regularization=regularization,
        unidentifiable=unidentifiable,
        residual_test=test,
        prior_conflict=conflict,
        residuals=label_residuals(residuals, data, problem),
        pose_weights=weights,
        history=history,
        nuisance=nuisance,
        poses=poses,
        findings=tuple(findings),
    )
