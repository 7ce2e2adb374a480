# SPDX-License-Identifier: Apache-2.0
"""What a fit says beside its estimate: noise, uncertainty, frames, setup, combinations, findings.

Each is computed when it is first asked for, from where the descent ended.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from loopcal.errors import DataError
from loopcal.estimate import fit_descent, free_parameters, pose_estimate, posterior
from loopcal.estimate.descent import Descent
from loopcal.estimate.information import FrameRows, UnfixedMotions, describe_frames
from loopcal.estimate.linearization import Linearization, PoseEstimates
from loopcal.estimate.observation_rows import Residuals, linked_blocks
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import Method, Regularization, describe_regularization
from loopcal.estimate.prior_inflation import PriorConflict, add_factor_uncertainty, run_prior_tests
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.residual_test import FEWEST_DEGREES, NOTABLE, ResidualTest, run_residual_test
from loopcal.estimate.result import (
    History,
    Identification,
    KindResiduals,
    NuisanceEstimate,
    Spectrum,
    add_followers,
    estimate_nuisance,
    label_residuals,
    report_divergence,
    report_equations,
    report_unknown_bias,
    report_used_poses,
)
from loopcal.findings import Finding, report_finding
from loopcal.measure.fitted_rows import FittedRows, collect_fitted_rows
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.mechanism.compilation import find_impossible_values
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.parameters import ParameterTable
from loopcal.results.deferred import later
from loopcal.typing import FloatArray

ASSUMED = "assumed"
"""Noise that nobody stated: a program that wrote the measurements assumed it."""


@dataclass(frozen=True, eq=False)
class FitAnalysis:
    """What the end of a fit shows.

    robot : as it was given. free : its free parameters. options : with the method that was used.
    data, problem : the measurements and their rows. weights : (n,) of the poses by a loss.
    weighted : the problem with these weights. fit : where the descent ended.
    unclosed : poses whose loops the readings do not close at the start.
    """

    robot: Mechanism
    free: free_parameters.FreeParameters
    options: FitOptions
    data: Measurements
    problem: Problem
    weights: FloatArray
    weighted: Problem
    fit: Descent
    unclosed: pose_estimate.UnclosedPoses

    def identification(self) -> Identification:
        """Return the result, whose fields are computed when they are asked for."""
        covariance = later(lambda: self.completed.covariance)
        nuisance = later(lambda: self.completed.nuisance)
        others = {name: self._later(name) for name in ("posterior", "findings")}
        return self._identification(covariance=covariance, nuisance=nuisance, **others)

    def _identification(self, **own: Any) -> Identification:
        others = ("history", "residual_test", "spectrum", "regularization", "unidentifiable")
        others += ("prior_conflict", "residuals", "poses")
        late = {name: self._later(name) for name in others}
        return Identification(
            robot=self.corrected,
            initial=self.robot,
            options=self.options,
            free_parameters=self.free,
            pose_weights=self.weights,
            **late,
            **own,
        )

    def _later(self, name: str) -> Any:
        return later(partial(getattr, self, name))

    # --- where the descent ended

    @cached_property
    def corrected(self) -> Mechanism:
        """The robot at the estimate."""
        return self.robot.with_values(self.free.values(self.fit.deviation)[0])

    @cached_property
    def is_converged(self) -> bool:
        """Whether the iteration converged."""
        return bool(self.fit.status[0] == DescentStatus.CONVERGED.value)

    @cached_property
    def history(self) -> History:
        """Status, steps and values of the iteration."""
        fit, free = self.fit, self.free
        return History(
            status=DescentStatus(int(fit.status[0])),
            iterations=int(fit.iterations[0]),
            cost=fit.cost_history[:, 0],
            estimate=free.nominal + free.tolerance * fit.deviation_history[:, 0],
        )

    @property
    def method(self) -> Method:
        """The method that was used."""
        return fit_descent.get_method(self.options)

    # --- noise and uncertainty

    @cached_property
    def _noise(self) -> tuple[ResidualTest, posterior.VarianceSources]:
        options, d, penalty = self.options, self.fit.decomposition, self.fit.penalty
        is_assumed = options.noise == "given" and self.data.noise_source != "stated"
        noise, is_weighted = ASSUMED if is_assumed else options.noise, options.loss is not None
        uncertainty = options.sigma_uncertainty
        test = run_residual_test(d, penalty, noise, uncertainty, is_weighted, self.is_converged)
        sources = posterior.find_variance_sources(d, penalty, test, self.method, self.free)
        return replace(test, intervals=bool(np.isfinite(sources.noise))), sources

    @property
    def residual_test(self) -> ResidualTest:
        """The residuals against the noise."""
        return self._noise[0]

    @property
    def sources(self) -> posterior.VarianceSources:
        """What the variances are made of."""
        return self._noise[1]

    @cached_property
    def stated_covariance(self) -> FloatArray:
        """(p, p) covariance [SI] by noise and spreads as stated."""
        scale = self.free.tolerance
        scaled = self.fit.decomposition.covariance(self.fit.penalty, *self.sources)[0]
        return scaled * scale[:, None] * scale

    @cached_property
    def stated_posterior(self) -> posterior.Posterior:
        """The same by directions."""
        linearization, motions = self._estimated[2:]
        prior, noise = self.options.prior, self.sources.noise
        frames = describe_frames(self.weighted, self.data, motions, prior, linearization, noise)
        free, fit = self.free, self.fit
        at = self.corrected, free.places, free.tolerance, fit.decomposition, fit.penalty
        return posterior.compute_posterior(
            *at, self.sources, frames, self.residual_test.noise_degrees
        )

    @cached_property
    def prior_tests(self) -> tuple[PriorConflict | None, list[Finding]]:
        """The stated spreads against the data, and findings on them."""
        return run_prior_tests(self.free, self.fit, self.method)

    @property
    def prior_conflict(self) -> PriorConflict | None:
        """The stated spreads against the data, where the method uses them."""
        return self.prior_tests[0]

    @cached_property
    def spectrum(self) -> Spectrum:
        """Singular values and rank."""
        d = self.fit.decomposition.plain()
        return Spectrum(int(d.rank[0]), float(d.condition[0]), d.singular_values[0], d.tolerance)

    @cached_property
    def regularization(self) -> Regularization | None:
        """Ridge parameter or truncation."""
        return describe_regularization(self.method, self.fit.decomposition, self.fit.penalty)

    @cached_property
    def unidentifiable(self) -> tuple[free_parameters.Combination, ...]:
        """Combinations that change no measured value."""
        null_space = self.fit.decomposition.plain().null_space()
        combinations = free_parameters.describe_null_space(self.free, null_space)
        return add_followers(combinations, null_space, self.stated_nuisance)

    # --- poses and setup where the last step ended

    @cached_property
    def _estimated(
        self,
    ) -> tuple[
        PoseEstimates | None, tuple[Residuals, ...], Linearization | None, UnfixedMotions | None
    ]:
        """Poses, residuals, linearization and motions of the rows where the last step ended.

        Poses and residuals are those of the rows without weights of a loss, at the setup parameters
        of the weighted ones; None: exact readings. The linearization is that of the weighted rows;
        None without setup parameters. The last are the unfixed motions, see
        `FrameRows.find_unfixed`.
        """
        problem, weighted = self.problem, self.weighted
        z, start = self.fit.deviation, self.fit.start
        solution, linearization, nuisance = None, None, None
        if weighted.nuisance is not None:
            solution = weighted.solve(z, start, derivatives=True)
            linearization, nuisance = weighted.linearize_at(z, start, solution), solution.nuisance
        if solution is None or weighted is not problem:
            solution = problem.solve(z, start, nuisance)
        rows = FrameRows(weighted, nuisance)
        residuals = problem.residuals(z, solution, rows.add)
        return solution.estimates, residuals, linearization, rows.find_unfixed()

    @cached_property
    def residuals(self) -> tuple[KindResiduals, ...]:
        """Residuals of every kind."""
        return label_residuals(self._estimated[1], self.data, self.problem)

    @cached_property
    def poses(self) -> pose_estimate.EstimatedPoses | None:
        """Pose and reading estimates, where readings are uncertain."""
        estimates, excluded = self._estimated[0], tuple(self.options.excluded_poses)
        return (
            None
            if estimates is None
            else pose_estimate.estimate_poses(estimates, self.data, excluded)
        )

    @cached_property
    def stated_nuisance(self) -> NuisanceEstimate:
        """Frames, targets, surfaces and offsets by noise and spreads as stated."""
        fit, setup = self.fit, self.weighted.nuisance
        if setup is None or (linearization := self._estimated[2]) is None:
            return NuisanceEstimate.empty(self.problem.parameters)
        # a fit begins with the setup that fits its first robot best, with all poses and no weights
        began_there = self.options.start is None and self.options.loss is None
        baseline = None
        if not (began_there and np.isfinite(fit.cost_history[0, 0])):
            weighted = self.data.with_weights(self.weights)
            baseline = fit_setup_alone(self.robot, weighted, setup.local)
        d, noise = fit.decomposition, self.sources.noise
        variance = d.variances(fit.penalty, *self.sources)[0]
        return estimate_nuisance(setup, linearization, self.robot, d, variance, noise, baseline)

    # --- what errors beyond these add, and what is noticed

    @cached_property
    def completed(self) -> Identification:
        """The result with the uncertainty of factors on spreads, of stated setup parameters and
        of a loss.
        """
        stated = {name: self._later(f"stated_{name}") for name in COMPLETED}
        result = add_factor_uncertainty(self._identification(**stated), self.fit)
        if (setup := self.weighted.nuisance) is not None and setup.has_prior.any():
            result = fit_descent.add_setup_uncertainty(result, self.fit)
        if self.options.loss is None:
            return result
        blocks = linked_blocks(self.data)
        return fit_descent.add_loss_uncertainty(
            result, self.fit, self.problem, self.weighted, blocks
        )

    @cached_property
    def fitted_rows(self) -> FittedRows | None:
        """The measured rows behind the result; None where those of an earlier one are unknown."""
        is_fitted = self.robot.redundancy is not None
        rows = collect_fitted_rows(self.data, are_readings_fitted=is_fitted)
        if (earlier := self.options.prior) is None:
            return rows
        return None if earlier.fitted_rows is None else earlier.fitted_rows.joined(rows)

    @cached_property
    def posterior(self) -> posterior.Posterior:
        """The uncertainty by directions."""
        d, test = self.fit.decomposition, self.residual_test
        shown = posterior.find_shown_noise(d, test)
        return replace(
            self.completed.posterior,
            fitted_rows=self.fitted_rows,
            shown_noise=shown,
            information=posterior.describe_information(self.free, d, test, shown),
        )

    @cached_property
    def stated_findings(self) -> tuple[Finding, ...]:
        """What the fit noticed, but what errors beyond noise and spreads add."""
        fit, free, options, problem = self.fit, self.free, self.options, self.problem
        on_poses = list[Finding]()
        if (poses := self.poses) is not None:
            doubtful = pose_estimate.report_doubtful_readings(self.corrected, poses)
            on_poses = [*poses.report(), *doubtful, *pose_estimate.report_uneven_sigmas(problem)]
        method, excluded = self.method, tuple(options.excluded_poses)
        return (
            *([] if self.is_converged else [self.history.finding]),
            report_noise(self.data, self.robot, self.residual_test),
            *report_divergence(free, fit.deviation[0], method, self.is_converged),
            *(found for _, found in find_impossible_values(self.robot, self.corrected.values)),
            *self.prior_tests[1],
            *(combination.finding for combination in self.unidentifiable),
            *self.stated_nuisance.report_unobservable(),
            *free.findings(),
            *fit_descent.report_closure_start(problem, options, fit),
            *([] if self.regularization is None else [self.regularization.finding]),
            *report_unknown_bias(free, method, self.sources.prior),
            *report_equations(int(problem.equations[0]), problem.parameters, method),
            *report_used_poses(self.data, self.weights, options.loss, excluded),
            *on_poses,
        )

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What the fit noticed."""
        findings, earlier = list(self.completed.findings), self.options.prior
        if earlier is not None and earlier.fitted_rows is None:
            findings.append(report_finding("prior.rows-unknown"))
        if self.unclosed.poses:
            findings.append(self.unclosed.report("fit.poses-open-at-start"))
        return tuple(findings)


COMPLETED = ("covariance", "posterior", "nuisance", "findings")
"""Fields of the result to which errors beyond noise and spreads may add."""


def fit_setup_alone(
    robot: Mechanism, data: Measurements, nuisance: NuisanceParameters
) -> FloatArray:
    """Return nuisance parameters (U,) [SI] that fit measurements best at the robot's geometry.

    Poses that the geometry does not reach do not count. NaN where the others do not determine the
    parameters, and no value is stated.
    """
    table = nuisance.table
    unknown = np.where(table.free & np.isnan(table.tolerance), np.nan, nuisance.values())
    solution, known = pose_estimate.predict_from_readings(robot, data)
    reached = solution.converged & known
    if not reached.any():
        return unknown
    reached_data = data.take(reached)
    reached_setup = reached_data.nuisance_parameters
    entries = {entry.name: entry for entry in table.entries}
    stated = ParameterTable(tuple(entries[name] for name in reached_setup.table.names))
    setup, z = replace(reached_setup, table=stated), np.zeros((1, 0))
    problem = problem_of(free_parameters.fix_all(robot), reached_data, setup)
    try:
        fitted = problem.solve(z, problem.start(z)).nuisance
    except DataError:  # too few rows for a closed form
        return unknown
    values = {} if fitted is None else dict(zip(reached_setup.table.names, fitted[0], strict=True))
    return np.array([values.get(name, unknown[i]) for i, name in enumerate(table.names)])


def report_noise(data: Measurements, robot: Mechanism, test: ResidualTest) -> Finding:
    """Return the residuals against the noise, with assumed and estimated sigmas where some are."""
    if data.noise_source == "stated" or not test.converged or test.weighted:
        return test.finding
    if test.noise == "estimated":
        if not test.intervals:
            return test.finding
        sigmas = _list_sigmas(data, robot, test.sigma_scale)
        return report_finding("noise.assumed-replaced", sigmas=sigmas, dof=test.dof)
    ratio = float(np.sqrt(test.chi_square / max(test.degrees, 0.5)))
    is_chance = test.degrees < FEWEST_DEGREES and test.exact_p_value > 1.0 - NOTABLE
    if test.degrees < 0.5 or np.isnan(test.p_value) or is_chance:
        return report_finding("noise.assumed-untested", sigmas=_list_sigmas(data, robot, 1.0))
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
        for group in rows.kind.error_groups:
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
