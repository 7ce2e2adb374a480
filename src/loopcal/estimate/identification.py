# SPDX-License-Identifier: Apache-2.0
"""Identify the free parameters of a robot from measurements, with all diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.fit_descent import descend_to_prior, get_method
from loopcal.estimate.fit_findings import (
    report_divergence,
    report_equations,
    report_unknown_bias,
    report_used_poses,
)
from loopcal.estimate.fit_input import (
    check_count,
    check_rows,
    check_start,
    check_types,
    count_spare_equations,
    exclude_poses,
)
from loopcal.estimate.frame_freedoms import FrameRows, describe_frames
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.inference.assumed_noise import choose_noise, name_noise, report_noise
from loopcal.estimate.inference.null_space import describe_null_space
from loopcal.estimate.inference.posterior import (
    VarianceSources,
    add_data,
    compute_posterior,
    find_variance_sources,
)
from loopcal.estimate.inference.prior import (
    collect_used_rows,
    refuse_reused_rows,
    report_unknown_rows,
)
from loopcal.estimate.inference.residual_test import ResidualTest, run_residual_test
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.methods.losses import Loss
from loopcal.estimate.methods.penalties import LeastSquares, Method, adapt_method
from loopcal.estimate.methods.regularization import describe_regularization
from loopcal.estimate.minimization.descent import Descent
from loopcal.estimate.nuisance.baseline import fit_setup_before
from loopcal.estimate.nuisance.estimate import (
    NuisanceEstimate,
    add_followers,
    empty_nuisance_estimate,
    estimate_nuisance,
)
from loopcal.estimate.observation_rows import Residuals, linked_blocks
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.poses.open_poses import find_open_poses
from loopcal.estimate.poses.states import PoseEstimates
from loopcal.estimate.prior_inflation import add_factor_uncertainty, run_prior_tests
from loopcal.estimate.problem import Problem
from loopcal.estimate.problem_construction import problem_of
from loopcal.estimate.residuals import label_residuals
from loopcal.estimate.result import History, Identification, Spectrum
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.mechanism import Mechanism, find_impossible_values
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray, Progress, report_no_progress

if TYPE_CHECKING:
    from loopcal.estimate.poses.estimate import EstimatedPoses


def identify(
    robot: Mechanism,
    data: Measurements,
    method: Method | None = None,
    *,
    loss: Loss | None = None,
    options: FitOptions | None = None,
    progress: Progress = report_no_progress,
) -> Identification:
    """Identify the free parameters of a robot; see `loopcal.estimate.methods.penalties`.

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
    options = choose_noise(options, data, count_spare_equations(problem))
    method = adapt_method(options.method or default, free.assumed, options.noise, free.correlation)
    options = replace(options, method=method)
    check_count(problem, data, method, options.allow_fewer_equations or options.prior is not None)
    values = robot.values if options.start is None else np.asarray(options.start)
    z = free.deviation(robot.with_values(values).values[None])
    fit, weights, weighted, options = descend_to_prior(problem, data, z, options, free, progress)
    if fit.status[0] == DescentStatus.BAD_START.value:
        check_start(problem, data, z, fit.cost)
    open_poses = find_open_poses(robot.with_values(values), data)
    if fit.status[0] != DescentStatus.CONVERGED.value and open_poses.are_most:
        raise EstimationError(open_poses.report("fit.poses-open"))
    result = _assemble(robot, free, options, data, fit, weights, problem, weighted)
    result = add_factor_uncertainty(result, fit)
    if options.loss is not None:
        from loopcal.estimate.loss_uncertainty import add_loss_uncertainty

        result = add_loss_uncertainty(result, fit, problem, weighted, linked_blocks(data))
    findings = [*result.findings, *report_unknown_rows(options.prior)]
    if open_poses.poses:
        findings.append(open_poses.report("fit.poses-open-at-start"))
    rows = collect_used_rows(robot, data, options.prior)
    posterior = add_data(result.posterior, free, fit.decomposition, result.residual_test, rows)
    return replace(result, posterior=posterior, findings=tuple(findings))


class _Estimate(NamedTuple):
    """The rows of a fit at its estimate.

    Attributes
    ----------
    poses : estimates of the poses without weights of a loss; None where readings are exact.
    residuals : without these weights. linearization : with them; None without setup parameters.
    unfixed : from `FrameRows.find_unfixed`.
    """

    poses: PoseEstimates | None
    residuals: tuple[Residuals, ...]
    linearization: Linearization | None
    unfixed: FloatArray | None


def _examine_estimate(problem: Problem, weighted: Problem, fit: Descent) -> _Estimate:
    """Solve and evaluate the rows of a fit once more, where its last step ended.

    Poses are those of the rows without weights, at the setup parameters of the weighted ones.
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
    return _Estimate(solution.estimates, residuals, linearization, rows.find_unfixed())


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
    test, sources = _test_noise(free, fit, options, data)
    estimate = _examine_estimate(problem, weighted, fit)
    conflict, on_prior = run_prior_tests(free, fit, method)
    plain, values = d.plain(), free.values(fit.deviation)[0]
    corrected = robot.with_values(values)
    linearization = estimate.linearization
    baseline = fit_setup_before(problem, robot, options, data, weights, fit)
    nuisance = _estimate_nuisance(weighted, linearization, robot, fit, sources, baseline)
    frames = describe_frames(
        weighted, data, estimate.unfixed, options.prior, linearization, sources.noise
    )
    null_space = plain.null_space()
    unidentifiable = add_followers(describe_null_space(free, null_space), null_space, nuisance)
    excluded = tuple(options.excluded_poses)
    poses = _estimate_poses(estimate.poses, data, excluded)
    history = _record_history(free, fit)
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
        *_report_closure(problem, options, fit),
        *([] if regularization is None else [regularization.finding]),
        *report_unknown_bias(free, method, sources.prior),
        *report_equations(int(problem.equations[0]), problem.parameters, method),
        *report_used_poses(data, weights, options.loss, excluded),
        *_report_poses(problem, corrected, poses),
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
        residuals=label_residuals(estimate.residuals, data, problem),
        pose_weights=weights,
        history=history,
        nuisance=nuisance,
        poses=poses,
        findings=tuple(findings),
    )


def _test_noise(
    free: FreeParameters, fit: Descent, options: FitOptions, data: Measurements
) -> tuple[ResidualTest, VarianceSources]:
    """Return the test of the residuals, and what the variances of the fit are made of."""
    d, penalty, noise = fit.decomposition, fit.penalty, name_noise(options, data)
    converged = bool(fit.status[0] == DescentStatus.CONVERGED.value)
    is_weighted = options.loss is not None
    test = run_residual_test(d, penalty, noise, options.sigma_uncertainty, is_weighted, converged)
    sources = find_variance_sources(d, penalty, test, get_method(options), free)
    return replace(test, intervals=bool(np.isfinite(sources.noise))), sources


def _record_history(free: FreeParameters, fit: Descent) -> History:
    """Return the iteration of the first trial."""
    status, steps = DescentStatus(int(fit.status[0])), int(fit.iterations[0])
    values = free.nominal + free.tolerance * fit.deviation_history[:, 0]
    return History(status, steps, fit.cost_history[:, 0], values)


def _estimate_nuisance(
    problem: Problem,
    linearization: Linearization | None,
    robot: Mechanism,
    fit: Descent,
    sources: VarianceSources,
    baseline: FloatArray | None,
) -> NuisanceEstimate:
    """Return the nuisance parameters at the estimate, where the rows are linearized."""
    if problem.nuisance is None or linearization is None:
        return empty_nuisance_estimate(problem.parameters)
    variance = fit.decomposition.variances(fit.penalty, *sources)[0]
    return estimate_nuisance(
        problem.nuisance, linearization, robot, fit.decomposition, variance, sources.noise, baseline
    )


def _report_closure(problem: Problem, options: FitOptions, fit: Descent) -> list[Finding]:
    """Return why the fit did not begin with the closure, where the options ask for it, or that
    the steps of this start ran out.
    """
    if fit.is_start_exhausted:
        return [report_finding("poses.closure-start-exhausted", steps=options.control.iterations)]
    if options.begin != "closure":
        return []
    from loopcal.estimate.minimization.closure_start import report_unused_closure

    unused = report_unused_closure(problem)
    return [] if unused is None else [unused]


def _estimate_poses(
    estimates: PoseEstimates | None, data: Measurements, excluded: Sequence[str]
) -> EstimatedPoses | None:
    """Return the poses that were estimated; None where the readings are exact."""
    if estimates is None:
        return None
    from loopcal.estimate.poses.estimate import estimate_poses

    return estimate_poses(estimates, data, excluded)


def _report_poses(
    problem: Problem, robot: Mechanism, poses: EstimatedPoses | None
) -> list[Finding]:
    """Return findings on poses and readings that were estimated."""
    if poses is None:
        return []
    from loopcal.estimate.poses.estimate import report_doubtful_readings, report_uneven_sigmas

    doubtful = report_doubtful_readings(robot, poses)
    return [*poses.report(), *doubtful, *report_uneven_sigmas(problem)]
