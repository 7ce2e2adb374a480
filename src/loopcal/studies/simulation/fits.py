# SPDX-License-Identifier: Apache-2.0
"""Calibrate the trials of a block: all at once where the method allows it, else one by one."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal.apply.accuracy import combine_errors, expand_length, pose_uncertainty, transport
from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.verdict import Verdict
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.diagnose.error_frames import FITTED, ReferencePoses, refer_errors
from loopcal.diagnose.gauge_freedoms import twist_weights
from loopcal.engine import State
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.plane_line_products import Layout, PaperRows, Weights, identify_from_rows
from loopcal.estimate.published_steps import (
    EPSILON,
    LIMIT,
    StepRule,
    identify_per_leg,
    make_raw_problem,
    penalize_none,
    penalize_ridge,
    penalize_truncated,
    take_steps,
)
from loopcal.estimate.trial_identification import IdentifiedTrials, identify_trials
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import Trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.states import Status
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.studies.simulation.machines import make_method
from loopcal.studies.simulation.preparation import PreparedCell
from loopcal.studies.specification.levels import MethodLevel
from loopcal.typing import BoolArray, FloatArray, IntArray

# --- Calibrate the trials of a block by the methods of published studies, without uncertainties.

MOST_LEG_STEPS = 100
"""Steps of a fit leg by leg at most, where epsilon ends them."""


@dataclass(frozen=True, eq=False)
class PublishedFits:
    """Fits of t trials.

    Attributes
    ----------
    values : (t, p of the robot) [SI], NaN where there are none. iterations : (t,).
    is_converged, is_diverged, is_refused : (t,); none of them: out of steps.
    rank : (t,), where the method has one.
    """

    values: FloatArray
    iterations: IntArray
    is_converged: BoolArray
    is_diverged: BoolArray
    is_refused: BoolArray
    rank: IntArray | None = None


def fit_published(
    method: MethodLevel, robot: Mechanism, trials: Trials, layout: Layout | None
) -> PublishedFits:
    """Calibrate all trials; a trial that fails does not stop the others.

    Raises
    ------
    DataError : products of points that are not held on planes and lines.
    """
    if method.is_of_products:
        if layout is None:
            raise DataError(
                "products of points need 'choice: plane-line' of the poses; add it, or remove "
                f"'rows: {method.rows}'"
            )
        return _fit_products(method, robot, trials, layout)
    if method.method == "per-leg":
        return _fit_per_leg(method, robot, trials)
    raw = make_raw_problem(robot, trials)
    steps = take_steps(raw, choose_penalty(method, raw.problem.parameters), choose_rule(method))
    is_counted = method.epsilon is None and method.steps is not None
    is_converged = ~steps.is_diverged if is_counted else steps.is_converged
    nowhere = np.zeros(len(trials), dtype=bool)
    return PublishedFits(steps.values, steps.count, is_converged, steps.is_diverged, nowhere)


def _fit_products(
    method: MethodLevel, robot: Mechanism, trials: Trials, layout: Layout
) -> PublishedFits:
    """Calibrate all trials from products of points, with the library's descent."""
    free, sd = select_free_parameters(robot), np.zeros(len(robot.parameters))
    sd[free.places] = free.tolerance
    sigma = float(trials.instrument.sensors[0].noise.sigma[0])
    weights: Weights = "full" if method.rows == "products" else "printed"
    assert trials.recorded is not None
    rows = PaperRows(layout, trials.recorded, sd, sigma, weights)
    fit = identify_from_rows(rows, make_method(method))
    nowhere = np.zeros(len(trials), dtype=bool)
    return PublishedFits(
        rows.values(fit.deviation),
        fit.iterations,
        fit.status == DescentStatus.CONVERGED,
        nowhere,
        nowhere,
        fit.decomposition.rank,
    )


def choose_penalty(method: MethodLevel, parameters: int) -> FloatArray:
    """Return the penalty (1, p) of each direction."""
    if method.method == "ridge":
        return penalize_ridge(np.array([method.lam]), parameters)
    if method.method == "truncated-svd":
        return penalize_truncated(np.array([method.keep]), parameters)
    return penalize_none(parameters)


def choose_rule(method: MethodLevel) -> StepRule:
    """Return when the steps of raw fits end."""
    if method.steps is None:
        return StepRule(EPSILON if method.epsilon is None else method.epsilon, LIMIT)
    return StepRule(method.epsilon or 0.0, method.steps)


def refuse_per_leg(method: MethodLevel, robot: Mechanism, data: Measurements) -> None:
    """Raise the reason for which the fit of a trial leg by leg is refused; nothing without one.

    Raises
    ------
    EstimationError, DataError : see `identify_per_leg`.
    """
    rule = choose_rule(method)
    identify_per_leg(robot, data, rule.limit if method.steps else MOST_LEG_STEPS, rule.epsilon)


def _fit_per_leg(method: MethodLevel, robot: Mechanism, trials: Trials) -> PublishedFits:
    """Calibrate the trials one by one, leg by leg."""
    rule, t = choose_rule(method), len(trials)
    values = np.full((t, len(robot.parameters)), np.nan)
    iterations, converged = np.zeros(t, dtype=np.int64), np.zeros(t, dtype=bool)
    refused = np.zeros(t, dtype=bool)
    for i in range(t):
        steps = rule.limit if method.steps else MOST_LEG_STEPS
        try:
            fit = identify_per_leg(robot, trials.trial(i), steps, rule.epsilon)
        except (EstimationError, DataError):
            refused[i] = True
            continue
        values[i], converged[i] = fit.robot.values, fit.is_converged
        iterations[i] = len(fit.estimate_history) - 1
    return PublishedFits(values, iterations, converged, np.zeros(t, dtype=bool), refused)


OUTCOMES: tuple[str, ...] = (
    "study.converged",
    "study.out-of-iterations",
    "study.no-descent",
    "study.start-not-reached",
    "study.refused",
    "study.held-out-not-reached",
    "study.diverged",
)
"""Codes of the outcomes of a trial, by their number; new ones are added at the end."""

_OF_STATUS = {
    DescentStatus.CONVERGED: 0,
    DescentStatus.OUT_OF_ITERATIONS: 1,
    DescentStatus.NO_DESCENT: 2,
    DescentStatus.BAD_START: 3,
    DescentStatus.RUNNING: 1,
    DescentStatus.NO_PROGRESS: 2,
}
REFUSED, NOT_REACHED, DIVERGED, EXHAUSTED = (
    OUTCOMES.index(f"study.{name}")
    for name in ("refused", "held-out-not-reached", "diverged", "out-of-iterations")
)

POSE_TIME = 60.0
"""Seconds from one pose to the next."""

VERDICTS = (Verdict.CALIBRATED, Verdict.RESERVATIONS, Verdict.UNDECIDED, Verdict.NOT_CALIBRATED)
"""Verdicts by their number."""

LEVEL_95 = 1.959963984540054
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True, eq=False)
class FittedTrials:
    """The calibrations of t trials; NaN in those that have none.

    Attributes
    ----------
    values : (t, p of the robot) [SI]. outcome : (t,) numbers of OUTCOMES.
    T, reached : (t, h, 4, 4), (t,) calibrated machines at the readings of the held-out poses.
    T_measured : (t, n, 4, 4) at those of the measured poses; n = 0 where no frame is fitted.
    half_width : (t, p free) of 95 % intervals [SI]. expanded : (t, h, 2) position and rotation
        errors that 95 % of the errors of held-out poses do not exceed [m], [rad].
    rank, condition, iterations : (t,). noise_scale : (t,) residuals over stated noise.
    verdict : (t,) numbers of VERDICTS.
    """

    values: FloatArray
    outcome: IntArray
    T: FloatArray
    reached: BoolArray
    T_measured: FloatArray
    half_width: FloatArray
    expanded: FloatArray
    rank: FloatArray
    condition: FloatArray
    iterations: FloatArray
    noise_scale: FloatArray
    verdict: FloatArray


def fit_trials(cell: PreparedCell, trials: Trials, threads: int = 1) -> FittedTrials:
    """Calibrate all trials; threads compute those that are one batch."""
    options, scores = cell.fit_options, cell.scores
    if cell.method.is_published:
        return describe_published(cell, fit_published(cell.method, cell.robot, trials, cell.layout))
    is_batch = options.loss is None and options.noise == "given" and cell.layout is None
    if is_batch and not scores.verdict and scores.intervals == "stated":
        return fit_together(cell, trials, threads)
    return fit_each(cell, trials)


def fit_together(cell: PreparedCell, trials: Trials, threads: int = 1) -> FittedTrials:
    """Calibrate all trials as one batch. The stated noise counts as known.

    The fits begin with chords, see `identify_trials`: estimates are those of single fits within
    1e-3 standard deviations.
    """
    options = cell.fit_options
    fits = identify_trials(cell.robot, trials, options=options, threads=threads, chord_start=True)
    plain = fits.decomposition.plain()
    state, measured = solve_cell_poses(cell, fits.values)
    return FittedTrials(
        values=fits.values,
        outcome=np.array([_OF_STATUS[DescentStatus(int(status))] for status in fits.status]),
        T=state.T,
        reached=is_reached(state),
        T_measured=measured.T,
        half_width=LEVEL_95 * fits.standard_deviations(),
        expanded=_expand_errors(cell, fits, state, measured),
        rank=plain.rank.astype(float),
        condition=plain.condition,
        iterations=fits.iterations.astype(float),
        noise_scale=compute_noise(plain.unexplained, plain.rows - plain.rank),
        verdict=np.full(len(trials), np.nan),
    )


def describe_published(cell: PreparedCell, fits: PublishedFits) -> FittedTrials:
    """Return fits of a published method, whose intervals do not exist."""
    t, free = len(fits.values), select_free_parameters(cell.robot)
    is_known = np.asarray(np.isfinite(fits.values).all(axis=1))
    values = np.where(is_known[:, None], fits.values, cell.robot.values)
    state, measured = solve_cell_poses(cell, values)
    outcome = np.where(fits.is_converged, 0, EXHAUSTED)
    outcome = np.where(fits.is_diverged, DIVERGED, np.where(fits.is_refused, REFUSED, outcome))
    lost = ~is_known[:, None, None, None]
    nothing = np.full(t, np.nan)
    return FittedTrials(
        values=fits.values,
        outcome=outcome,
        T=np.where(lost, np.nan, state.T),
        reached=is_reached(state),
        T_measured=np.where(lost, np.nan, measured.T),
        half_width=np.full((t, len(free)), np.nan),
        expanded=np.full((*state.T.shape[:2], 2), np.nan),
        rank=nothing if fits.rank is None else fits.rank.astype(float),
        condition=nothing,
        iterations=fits.iterations.astype(float),
        noise_scale=nothing,
        verdict=nothing,
    )


def compute_noise(chi_square: ArrayLike, degrees: ArrayLike) -> FloatArray:
    """Return the residuals over the stated noise; NaN where no degree of freedom is left."""
    left = np.asarray(degrees, dtype=float)
    return np.sqrt(np.asarray(chi_square) / np.where(left > 0.0, left, np.nan))


def solve_cell_poses(cell: PreparedCell, values: FloatArray) -> tuple[State, State]:
    """Return the states of machines (t, p) at the readings of the held-out poses, and at those of
    the measured poses, of which there are none where no frame is fitted.
    """
    held_out, commanded = cell.held_out, cell.reference
    return (
        forward_trials(cell.robot, values, held_out.q[None], held_out.state),
        forward_trials(cell.robot, values, commanded.q[None], commanded.state),
    )


def is_reached(state: State) -> BoolArray:
    """Return in which trials (t,) all poses are reached."""
    return np.asarray((state.status == Status.CONVERGED).all(axis=1))


def _expand_errors(
    cell: PreparedCell, fits: IdentifiedTrials, state: State, measured: State
) -> FloatArray:
    """Return what 95 % of the errors of held-out poses do not exceed (t, h, 2) [m], [rad], as
    `pose_uncertainty` does for one machine.

    state, measured : of `solve_cell_poses`.
    """
    robot, free = cell.robot, fits.free_parameters
    unit = free.tolerance * fits.decomposition.scale
    slopes = differentiate_pose(robot, fits.values, cell.held_out.q[None], state)
    D = slopes.parameters[..., free.places] * unit
    size = np.linalg.norm(D * twist_weights(robot)[:, None], axis=(2, 3))
    if cell.motions.shape[1]:
        by_measured = differentiate_pose(robot, fits.values, cell.reference.q[None], measured)
        reference = by_measured.parameters[..., free.places] * unit
        D = np.stack(
            [
                _refer_to_fitted(cell, *of_trial)
                for of_trial in zip(D, state.T, reference, measured.T, strict=True)
            ]
        )
    t, n = state.T.shape[:2]
    H = transport(robot, state.T.reshape(-1, 4, 4), "base", "tool").reshape(t, n, 6, 6)
    directions, variance = _list_knowledge(fits)
    others = (H @ (slopes.readings * robot.stated_sigma),) if robot.stated_sigma.any() else ()
    covariance = combine_errors(robot, H @ D, directions, variance, size, others)
    covariance[state.status != Status.CONVERGED] = np.nan
    flat, is_known = covariance.reshape(-1, 6, 6), np.full(t * n, np.inf)
    lengths = [expand_length(flat[:, part, part], is_known) for part in (slice(3, 6), slice(0, 3))]
    return np.stack(lengths, axis=-1).reshape(t, n, 2)


def _refer_to_fitted(
    cell: PreparedCell, D: FloatArray, T: FloatArray, reference: FloatArray, measured: FloatArray
) -> FloatArray:
    """Return errors D (h, 6, p) of poses T (h, 4, 4) by the parameters, after the best rigid fit of
    frames over measured poses (n, 4, 4) with errors `reference` (n, 6, p).
    """
    usable = np.isfinite(reference).all(axis=(1, 2))
    poses = ReferencePoses(measured[usable], reference[usable], "measured")
    return refer_errors(cell.robot, FITTED, poses, cell.motions).relate(D, T)


def _list_knowledge(fits: IdentifiedTrials) -> tuple[FloatArray, FloatArray]:
    """Return directions (t, p, p) and their variances (t, p), as in the posterior of each trial."""
    knowledge = []
    for i in range(len(fits.values)):
        chosen = np.array([i])
        prior = None if fits.prior_variance is None else fits.prior_variance[chosen]
        knowledge.append(
            fits.decomposition.take(chosen).knowledge(fits.penalty[chosen], 1.0, prior)
        )
    return np.stack([part[0] for part in knowledge]), np.stack([part[1] for part in knowledge])


def fit_each(cell: PreparedCell, trials: Trials) -> FittedTrials:
    """Calibrate the trials one by one, each with all that its calibration finds in the residuals.

    A trial that is refused does not stop the others.
    """
    free, h, n = select_free_parameters(cell.robot), len(cell.held_out.q), len(cell.reference.q)
    nothing = FittedTrials(
        values=np.full(len(cell.robot.parameters), np.nan),
        outcome=np.array(REFUSED),
        T=np.full((h, 4, 4), np.nan),
        reached=np.array(False),
        T_measured=np.full((n, 4, 4), np.nan),
        half_width=np.full(len(free), np.nan),
        expanded=np.full((h, 2), np.nan),
        **dict.fromkeys(
            ("rank", "condition", "iterations", "noise_scale", "verdict"), np.array(np.nan)
        ),
    )
    single = []
    for i in range(len(trials)):
        try:
            single.append(_fit_one(cell, state_times(trials.trial(i))))
        except (EstimationError, DataError):
            single.append(nothing)
    names = [entry.name for entry in fields(FittedTrials)]
    return FittedTrials(**{name: np.stack([getattr(f, name) for f in single]) for name in names})


def state_times(data: Measurements) -> Measurements:
    """Return measurements with the time of each row, as instruments record it: the tests for slow
    errors need it.
    """
    first = [rows.rows.reshape(len(rows), -1)[:, 0] for rows in data.observations]
    observations = tuple(
        replace(rows, context={"time": POSE_TIME * poses})
        for rows, poses in zip(data.observations, first, strict=True)
    )
    return replace(data, observations=observations)


def _fit_one(cell: PreparedCell, data: Measurements) -> FittedTrials:
    """Return the calibration of one trial, without the axis of trials."""
    verdict = np.nan
    if cell.scores.verdict:
        options = CalibrationOptions(
            fit=cell.fit_options,
            limit_position=cell.scores.limit_position,
            limit_angle=cell.scores.limit_angle,
        )
        report = calibrate(cell.robot, cell.hold_out(data), options)
        fit, verdict = report.identification, float(VERDICTS.index(report.verdict))
    else:
        fit = identify(cell.robot, data, options=cell.fit_options)
        if cell.scores.intervals == "adjusted":
            fit = adjust_uncertainty(fit, data)
    U = pose_uncertainty(fit, forward(fit.robot, cell.held_out.q), frame=cell.scores.error_frame)
    state, measured = solve_cell_poses(cell, fit.robot.values[None])
    test = fit.residual_test
    return FittedTrials(
        values=fit.robot.values,
        outcome=np.array(_OF_STATUS[fit.status]),
        T=state.T[0],
        reached=is_reached(state)[0],
        T_measured=measured.T[0],
        half_width=fit.interval(),
        expanded=np.stack([U.expanded_position, U.expanded_orientation], axis=-1),
        rank=np.array(float(fit.rank)),
        condition=np.array(fit.spectrum.condition),
        iterations=np.array(float(fit.history.iterations)),
        noise_scale=compute_noise(test.chi_square, test.degrees),
        verdict=np.array(verdict),
    )
