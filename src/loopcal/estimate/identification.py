# SPDX-License-Identifier: Apache-2.0
"""Identify a robot's free parameters from measurements: one machine with all its diagnostics, or
many trials at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import EstimationError
from loopcal.estimate.closure_start import descend_from_closure, report_unused_closure
from loopcal.estimate.descent import Descent, DescentStatus, StepControl, descend
from loopcal.estimate.divergence import find_diverged
from loopcal.estimate.excluded_poses import exclude_poses
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.inference.null_space import describe_null_space
from loopcal.estimate.inference.posterior import compute_posterior
from loopcal.estimate.inference.prior import Prior
from loopcal.estimate.inference.residual_test import ResidualTest, run_residual_test
from loopcal.estimate.input_checks import check_count, check_rows, check_settings, check_start
from loopcal.estimate.methods.losses import Loss
from loopcal.estimate.methods.penalties import MAP, LeastSquares, Method, adapt_method
from loopcal.estimate.methods.prior_conflict import assess_prior_conflict
from loopcal.estimate.nuisance_estimate import (
    NuisanceEstimate,
    add_followers,
    empty_nuisance_estimate,
    estimate_nuisance,
)
from loopcal.estimate.observation_rows import Residuals, linked_blocks
from loopcal.estimate.poses.estimate import (
    estimate_poses,
    report_doubtful_readings,
    report_uneven_sigmas,
)
from loopcal.estimate.poses.solution import PoseSolution
from loopcal.estimate.problem import Problem, problem_of, problem_of_trials
from loopcal.estimate.result import Identification, KindResiduals
from loopcal.estimate.robust_descent import Run, descend_robustly
from loopcal.estimate.start import Start
from loopcal.measure import Measurements, NuisanceParameters, Trials, fill_in_reading_sigma
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import RANK_TOLERANCE, Decomposition
from loopcal.typing import FloatArray, IntArray

Begin = Literal["kinematics", "closure"]
BEGINS = get_args(Begin)


def identify(
    robot: Mechanism,
    data: Measurements,
    method: Method | None = None,
    *,
    noise: Literal["given", "estimated"] = "given",
    prior: Prior | None = None,
    start: ArrayLike | None = None,
    begin: Begin = "kinematics",
    control: StepControl | None = None,
    rank_tolerance: float = RANK_TOLERANCE,
    allow_fewer_equations: bool = False,
    loss: Loss | None = None,
    drop: Sequence[str] = (),
    local: NuisanceParameters | None = None,
) -> Identification:
    """Identify the free parameters of a robot; the theory is in `loopcal.estimate.methods.penalties`.

    Parameters
    ----------
    robot : its values are the start, its table says what is nominal, free and tolerated. data : the
        measurements; where a reading has a sigma, given or stated by the robot, its pose is an
        unknown, too (docs/theory/latent.md).
    method : default `MAP(InflatedTolerances())`: stated tolerances are a prior, widened where the data
        contradict them; with `prior` least squares.
    noise : "given": the sigmas of the data are true; "estimated": true up to one common factor.
    prior : what an earlier calibration knows, as further rows; see `loopcal.estimate.inference.prior`.
    start : (parameters of the robot,) [SI] values to begin with instead of the robot's.
    begin : "closure": where all poses are measured in full, first linearise closure there (for
        starts far off).
    control : settings of the iteration. rank_tolerance : relative to the largest singular value.
    allow_fewer_equations : let least squares return the smallest deviation that explains too few
        equations.
    loss : `Huber()` or `Tukey()`: blocks of rows far from the fit count less. drop : labels of
        poses to leave out.
    local : unknowns of the instruments with priors or fixed, see `loopcal.measure.collect_nuisance_parameters`;
        default all free.

    Returns
    -------
    Identification; an iteration that did not converge is not raised, look at `status`.

    Raises
    ------
    EstimationError : nothing to identify, fewer equations than parameters, or poses out of reach at
        the start.
    """
    check_settings(method, rank_tolerance, noise)
    free = select_free_parameters(robot)
    method = adapt_method(
        LeastSquares() if method is None and prior is not None else method, free.assumed, noise
    )
    rows = problem_of(free, data := exclude_poses(fill_in_reading_sigma(robot, data), drop), local)
    check_rows(rows, data, robot)
    check_count(rows, data, method, allow_fewer_equations or prior is not None)
    z = free.deviation((robot if start is None else robot.with_values(start)).values[None])
    run: Run = partial(
        _descended,
        method=method,
        control=control,
        tolerance=rank_tolerance,
        begin=begin,
        prior=prior,
    )
    fit, weight, weighed = _weighed(rows, data, z, loss, noise, run, prior)
    if fit.status[0] == DescentStatus.BAD_START:
        check_start(rows, data, z, fit.cost)
    check = run_residual_test(
        fit.decomposition,
        fit.penalty,
        noise,
        loss is not None,
        fit.status[0] == DescentStatus.CONVERGED,
    )
    solution = _solve_unweighted(rows, weighed, fit)
    residuals = _labelled(rows.residuals(fit.deviation, solution), data, rows)
    result = _identification(robot, free, method, fit, check, residuals, weighed)
    latent = None if solution.estimates is None else estimate_poses(solution.estimates, data, drop)
    notes = (
        *result.notes,
        *_row_notes(rows, method, begin),
        *_weight_notes(data, weight, loss),
        *_drop_notes(drop),
    )
    doubts = (*latent.report(), *report_doubtful_readings(result.robot, latent)) if latent else ()
    doubts += report_uneven_sigmas(rows) if latent else ()
    notes += tuple(str(doubt) for doubt in doubts)
    return replace(result, weight=weight, dropped=tuple(drop), notes=notes, latent=latent)


def _weighed(
    rows: Problem,
    data: Measurements,
    z: FloatArray,
    loss: Loss | None,
    noise: str,
    run: Run,
    prior: Prior | None,
) -> tuple[Descent, FloatArray, Problem]:
    """Descend, with a loss or without; return the weight (n,) of each pose, too, and the rows with
    these weights.
    """
    if loss is None:
        return run(rows, z, None), np.ones(data.n_poses), rows
    robust = descend_robustly(rows, linked_blocks(data), loss, z, noise == "estimated", run, prior)
    return robust.fit, robust.weight, robust.problem


def _solve_unweighted(rows: Problem, weighed: Problem, fit: Descent) -> PoseSolution:
    """Solve for the poses of unweighted rows at the nuisance parameters of the weighted fit."""
    nuisance = None if weighed is rows else weighed.solve(fit.deviation, fit.start).nuisance
    return rows.solve(fit.deviation, fit.start, nuisance)


def _row_notes(rows: Problem, method: Method, begin: Begin) -> list[str]:
    """Say where tolerances alone hold some directions, equations being fewer than parameters, and
    where it could not begin.
    """
    m, p = int(rows.equations[0]), rows.parameters
    notes = [str(why)] if begin == "closure" and (why := report_unused_closure(rows)) else []
    if m < p and isinstance(method, MAP):
        notes.append(
            f"{m} equations for {p} parameters: at least {p - m} directions rest on tolerances "
            "alone"
        )
    return notes


def _weight_notes(data: Measurements, weight: FloatArray, loss: Loss | None) -> list[str]:
    """Say which poses a loss made count less than half."""
    if loss is None:
        return []
    little = [data.labels[i] for i in np.flatnonzero(weight < 0.5)]
    if not little:
        return [f"{loss!r}: every pose counts at least half"]
    shown = ", ".join(little[:10]) + (f" and {len(little) - 10} more" if len(little) > 10 else "")
    return [f"{loss!r}: {len(little)} of {data.n_poses} poses count less than half ({shown})"]


def _drop_notes(drop: Sequence[str]) -> list[str]:
    """Say which poses were left out."""
    return [f"left out as asked: poses {', '.join(drop)}"] if drop else []


@dataclass(frozen=True, eq=False)
class IdentifiedTrials:
    """t machines identified at once. Arrays are (t, ...), parameters all of the robot's, SI.

    Attributes
    ----------
    values : (t, p). status : (t,) DescentStatus. iterations : (t,). cost : (t,) whitened sum of
        squares.
    unknowns : the free parameters. decomposition, penalty : from which variances and leverages are
        read.
    """

    values: FloatArray
    status: IntArray
    iterations: IntArray
    cost: FloatArray
    unknowns: FreeParameters
    decomposition: Decomposition
    penalty: FloatArray

    @property
    def converged(self) -> np.ndarray:
        """(t,) which trials converged."""
        return self.status == DescentStatus.CONVERGED

    def standard_deviations(self, noise_variance: FloatArray | float = 1.0) -> FloatArray:
        """Return standard deviations (t, p free) [SI], infinite where the data cannot tell."""
        scaled = self.decomposition.standard_deviations(self.penalty, noise_variance)
        return scaled * self.unknowns.tolerance


def identify_trials(
    robot: Mechanism,
    trials: Trials,
    method: Method | None = None,
    *,
    start: ArrayLike | None = None,
    begin: Begin = "kinematics",
    control: StepControl | None = None,
    rank_tolerance: float = RANK_TOLERANCE,
) -> IdentifiedTrials:
    """Identify t simulated machines at once; each equals its own `identify` and no trial stops
    another.

    Parameters
    ----------
    robot : as for `identify`. trials : their measurements.
    start : (t | 1, parameters of the robot) [SI], default the robot's values. The others: as for
        `identify`.
    """
    free = select_free_parameters(robot)
    rows = problem_of_trials(free, trials)
    values = np.atleast_2d(robot.values if start is None else np.asarray(start, dtype=np.float64))
    z = np.broadcast_to(free.deviation(values), (len(trials), len(free)))
    fit = _descended(
        rows, z, None, adapt_method(method, free.assumed, "given"), control, rank_tolerance, begin
    )
    return IdentifiedTrials(
        free.values(fit.deviation),
        fit.status,
        fit.iterations,
        fit.cost,
        free,
        fit.decomposition,
        fit.penalty,
    )


def _descended(
    rows: Problem,
    z: FloatArray,
    start: Start | None,
    method: Method,
    control: StepControl | None,
    tolerance: float,
    begin: Begin,
    prior: Prior | None = None,
) -> Descent:
    """Descend from deviations z (t, p); steps of the beginning count and stand first in the
    history.
    """
    control = control or StepControl()
    if begin not in BEGINS:
        raise EstimationError(f"begin is {begin!r}; it must be one of {', '.join(BEGINS)}")
    problem = rows if prior is None else prior.added(rows)
    if begin == "kinematics":
        return descend(problem, z, method, control, tolerance, start)
    z, first = descend_from_closure(rows, z, method, control, tolerance)
    fit = descend(problem, z, method, control, tolerance, start)
    return fit if first is None else fit.after(first)


def _identification(
    robot: Mechanism,
    free: FreeParameters,
    method: Method,
    fit: Descent,
    check: ResidualTest,
    residuals: tuple[KindResiduals, ...],
    rows: Problem,
) -> Identification:
    """Put the result together; `rows` are folded once more where they have unknowns of their own."""
    d, penalty, variance = (
        fit.decomposition,
        fit.penalty,
        check.sigma_scale**2 if check.intervals else np.nan,
    )
    plain = d.plain()
    conflict = None
    if isinstance(method, MAP):
        sigma = float(method.sigma(d)[0])
        conflict = assess_prior_conflict(free, d, penalty, sigma, fit.deviation[0])
        if (
            check.intervals and check.noise == "estimated"
        ):  # the penalty holds its variance: divided by it, all is as stated
            d, penalty, variance = d.divided(np.full(1, check.sigma_scale)), penalty / variance, 1.0
    covariance = d.covariance(penalty, variance)[0] * free.tolerance[:, None] * free.tolerance
    values = free.values(fit.deviation)[0]
    status = DescentStatus(int(fit.status[0]))
    local = _estimate_nuisance(rows, robot, fit, d, penalty, variance)
    open_ = add_followers(describe_null_space(free, plain.null_space()), plain.null_space(), local)
    converged = status is DescentStatus.CONVERGED
    notes = [
        *([] if converged else [status.sentence]),
        check.sentence,
        *find_diverged(free, fit.deviation[0], method, converged),
    ]
    if converged and conflict is not None and conflict.conflict:
        notes.append(conflict.sentence)
    notes += [f"not identifiable: {combination}" for combination in open_]
    notes += [str(finding) for finding in local.report_unobservable()]
    if assumed := free.note():
        notes.append(assumed)
    return Identification(
        robot=robot.with_values(values),
        initial=robot,
        method=method,
        unknowns=free,
        estimate=values[free.places],
        covariance=covariance,
        posterior=compute_posterior(
            robot.with_values(values), free.places, free.tolerance, d, penalty, variance
        ),
        rank=int(plain.rank[0]),
        condition=float(plain.condition[0]),
        singular_values=plain.singular_values[0],
        rank_tolerance=d.tolerance,
        unidentifiable=open_,
        check=check,
        conflict=conflict,
        residuals=residuals,
        status=status,
        iterations=int(fit.iterations[0]),
        cost_history=fit.cost_history[:, 0],
        estimate_history=free.nominal + free.tolerance * fit.deviation_history[:, 0],
        notes=tuple(notes),
        weight=np.ones(0),
        dropped=(),
        local=local,
    )


def _estimate_nuisance(
    rows: Problem,
    robot: Mechanism,
    fit: Descent,
    d: Decomposition,
    penalty: FloatArray,
    variance: float,
) -> NuisanceEstimate:
    """Return the nuisance parameters at the estimate, linearized there once more."""
    if rows.nuisance is None:
        return empty_nuisance_estimate(rows.parameters)
    at = rows.linearize(fit.deviation, fit.start)
    return estimate_nuisance(rows.nuisance, at, robot, d, penalty, variance)


def _labelled(
    residuals: tuple[Residuals, ...], data: Measurements, rows: Problem
) -> tuple[KindResiduals, ...]:
    """Put names to the residuals (t = 1) of every kind, uncertain readings the last."""
    observations = [o for o in data.observations if len(o)]
    present, context = [o.present for o in observations], [o.context for o in observations]
    if rows.is_uncertain:
        present.append(np.isfinite(data.readings))
        context.append(data.context)
    return tuple(
        KindResiduals(
            kind=s.kind.name,
            components=tuple(column.name for column in s.kind.noise_columns),
            poses=tuple("/".join(data.labels[i] for i in seen) for seen in s.poses_by_link),
            raw=np.where(there, r.raw[0], np.nan),
            whitened=r.whitened[0],
            context=beside,
        )
        for s, there, beside, r in zip(rows.rows, present, context, residuals, strict=True)
    )
