# SPDX-License-Identifier: Apache-2.0
"""Calibrate the trials of a block: all at once where the method allows it, else one by one."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

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
from loopcal.estimate.identification import IdentifiedTrials, identify, identify_trials
from loopcal.estimate.penalties import Ridge
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import Trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.states import Status
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.studies.simulation.machines import PreparedCell, make_fit_options
from loopcal.studies.simulation.published_steps import (
    EPSILON,
    LEG_STEPS,
    LIMIT,
    WEIGHTS,
    PaperRows,
    PerLegEstimate,
    StepRule,
    Weights,
    identify_from_rows,
    identify_per_leg,
    make_raw_problem,
    penalize_ridge,
    penalize_truncated,
    take_steps,
)
from loopcal.studies.specification.levels import PER_LEG, MethodLevel
from loopcal.typing import BoolArray, FloatArray, IntArray

OUTCOMES: tuple[str, ...] = (
    "study.converged",
    "study.out-of-iterations",
    "study.no-descent",
    "study.start-not-reached",
    "study.refused",
    "study.held-out-not-reached",
    "study.diverged",
    "study.steps-remain",
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
REFUSED, NOT_REACHED, DIVERGED, EXHAUSTED, STEPS_REMAIN = (
    OUTCOMES.index(f"study.{name}")
    for name in ("refused", "held-out-not-reached", "diverged", "out-of-iterations", "steps-remain")
)


def has_result(outcome: FloatArray | IntArray) -> BoolArray:
    """Return which trials count by their outcome: those that converged, and those whose undamped
    steps reached their limit, where the values of the last step are the result of the study.
    """
    return np.isin(outcome, (0, STEPS_REMAIN))


POSE_TIME = 60.0
"""Seconds from one pose to the next."""

VERDICTS = (Verdict.CALIBRATED, Verdict.RESERVATIONS, Verdict.UNDECIDED, Verdict.NOT_CALIBRATED)
"""Verdicts by their number."""

LEVEL_95 = 1.959963984540054
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True, eq=False)
class FittedTrials:
    """The calibrations of t trials; NaN in those that have none.

    values : (t, p of the robot) [SI]. outcome : (t,) numbers of OUTCOMES.
    half_width : (t, p free) of 95 % intervals [SI]. expanded : (t, h, 2) position and rotation
        errors that 95 % of the errors of held-out poses do not exceed [m], [rad].
    scores : name -> (t,) of further scores that the method has: rank, condition, iterations,
        residuals over the stated noise, numbers of VERDICTS.
    states : of the calibrated machines, see `solve_cell_poses`; None where they are not known yet.
    """

    values: FloatArray
    outcome: IntArray
    half_width: FloatArray
    expanded: FloatArray
    scores: Mapping[str, Any]
    states: tuple[State, State] | None = None


def fit_trials(cell: PreparedCell, trials: Trials, threads: int = 1) -> FittedTrials:
    """Calibrate all trials; threads compute those that are one batch."""
    options, scores = cell.fit_options, cell.content.scores
    if cell.content.method.is_published:
        return fit_published(cell, trials)
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
        half_width=LEVEL_95 * fits.standard_deviations(),
        expanded=_expand_errors(cell, fits, state, measured),
        scores={
            "rank": plain.rank.astype(float),
            "condition": plain.condition,
            "iterations": fits.iterations.astype(float),
            "noise_scale": compute_noise(plain.unexplained, plain.rows - plain.rank),
        },
        states=(state, measured),
    )


def fit_per_leg(robot: Mechanism, data: Measurements, method: MethodLevel) -> PerLegEstimate:
    """Fit leg by leg. EstimationError as of `identify_per_leg`."""
    steps, epsilon = method.steps or LEG_STEPS, method.epsilon or 0.0
    return identify_per_leg(robot, data, steps, epsilon, method.stop or "dQint")


def fit_published(cell: PreparedCell, trials: Trials) -> FittedTrials:
    """Calibrate all trials by a method of published studies, whose intervals do not exist; a trial
    that fails does not stop the others.

    Raises DataError: products of points that are not held on planes and lines.
    """
    method, robot, t = cell.content.method, cell.robot, len(trials)
    scores: dict[str, Any] = {}
    if method.is_of_products:
        values, outcome, iterations, scores["rank"] = _fit_products(cell, trials)
    elif method.method == PER_LEG:
        values = np.full((t, len(robot.parameters)), np.nan)
        outcome, iterations = np.full(t, REFUSED), np.zeros(t, dtype=np.int64)
        for i in range(t):
            with suppress(EstimationError, DataError):
                fit = fit_per_leg(robot, trials.trial(i), method)
                values[i], outcome[i] = fit.robot.values, 0 if fit.is_converged else STEPS_REMAIN
                iterations[i] = fit.steps
    else:
        names = select_free_parameters(robot).names
        ridge = Ridge(method.lam or 0.0).resolve(names)
        raw = make_raw_problem(robot, trials, ridge)
        p = len(names)
        penalty = np.zeros((1, p))
        if method.method == "ridge":
            lam = 1.0 if isinstance(ridge.lam, tuple) else ridge.lam
            penalty = penalize_ridge(np.array([lam]), p)
        elif method.method == "truncated-svd":
            penalty = penalize_truncated(np.array([method.keep]), p)
        is_counted = method.epsilon is None and method.steps is not None
        epsilon = 0.0 if is_counted else method.epsilon or EPSILON
        steps = take_steps(raw, penalty, StepRule(epsilon, method.steps or LIMIT))
        outcome = np.where(steps.is_converged | is_counted, 0, STEPS_REMAIN)
        outcome = np.where(steps.is_diverged, DIVERGED, outcome)
        values, iterations = steps.values, steps.count
    return FittedTrials(
        values=values,
        outcome=outcome,
        half_width=np.full((t, len(select_free_parameters(robot))), np.nan),
        expanded=np.full((t, len(cell.held_out.q), 2), np.nan),
        scores=scores | {"iterations": iterations.astype(float)},
    )


def _fit_products(
    cell: PreparedCell, trials: Trials
) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Return values, outcomes, iterations and ranks of fits to products of points, with the
    library's descent.
    """
    method, robot = cell.content.method, cell.robot
    if cell.layout is None:
        raise DataError(
            "products of points need 'choice: plane-line' of the poses. Add it, or remove "
            f"'rows: {method.rows}'"
        )
    free, sd = select_free_parameters(robot), np.zeros(len(robot.parameters))
    sd[free.places] = free.tolerance
    sigma = float(trials.instrument.sensors[0].noise.sigma[0])
    stated: list[Weights] = [w for w in WEIGHTS if method.rows == f"products-{w}"]
    weights: Weights = stated[0] if stated else "full"
    chosen = make_fit_options(method).method
    assert trials.recorded is not None
    assert chosen is not None
    if isinstance(chosen, Ridge):
        chosen = chosen.resolve(robot.parameters.names)
    rows = PaperRows(cell.layout, trials.recorded, sd, sigma, weights)
    fit = identify_from_rows(rows, chosen)
    outcome = np.where(fit.status == DescentStatus.CONVERGED, 0, EXHAUSTED)
    rank = fit.decomposition.rank.astype(float)
    return rows.values(fit.deviation), outcome, fit.iterations, rank


def compute_noise(chi_square: ArrayLike, degrees: ArrayLike) -> FloatArray:
    """Return the residuals over the stated noise; NaN where no degree of freedom is left."""
    left = np.asarray(degrees, dtype=float)
    return np.sqrt(np.asarray(chi_square) / np.where(left > 0.0, left, np.nan))


def solve_cell_poses(cell: PreparedCell, values: FloatArray) -> tuple[State, State]:
    """Return the states of machines (t, p) at the readings of the held-out poses, and at those of
    the measured poses, see `PreparedCell.reference`; those of lost trials do not count.
    """
    is_known = np.isfinite(values).all(axis=1, keepdims=True)
    values = np.where(is_known, values, cell.robot.values)
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

    """
    robot, free = cell.robot, fits.free_parameters
    unit = free.tolerance
    slopes = differentiate_pose(robot, fits.values, cell.held_out.q[None], state)
    D = slopes.parameters[..., free.places] * unit
    size = np.linalg.norm(D * twist_weights(robot.size)[:, None], axis=(2, 3))
    if cell.motions.shape[1]:
        by_measured = differentiate_pose(robot, fits.values, cell.reference.q[None], measured)
        reference = by_measured.parameters[..., free.places] * unit
        related = []  # after the best rigid fit of frames over the measured poses
        for D_i, T, error, reached in zip(D, state.T, reference, measured.T, strict=True):
            usable = np.isfinite(error).all(axis=(1, 2))
            poses = ReferencePoses(reached[usable], error[usable], "measured")
            related.append(refer_errors(robot, FITTED, poses, cell.motions).relate(D_i, T))
        D = np.stack(related)
    t, n = state.T.shape[:2]
    H = transport(robot, state.T.reshape(-1, 4, 4), "base", "tool").reshape(t, n, 6, 6)
    knowledge = []  # as in the posterior of each trial
    for i in range(t):
        one = np.array([i])
        prior = None if fits.prior_variance is None else fits.prior_variance[one]
        knowledge.append(fits.decomposition.take(one).knowledge(fits.penalty[one], 1.0, prior))
    directions, variance = (np.stack([part[j] for part in knowledge]) for j in (0, 1))
    others = (H @ (slopes.readings * robot.stated_sigma),) if robot.stated_sigma.any() else ()
    covariance = combine_errors(robot, H @ D, directions, variance, size, others)
    covariance[state.status != Status.CONVERGED] = np.nan
    flat, is_known = covariance.reshape(-1, 6, 6), np.full(t * n, np.inf)
    lengths = [expand_length(flat[:, part, part], is_known) for part in (slice(3, 6), slice(0, 3))]
    return np.stack(lengths, axis=-1).reshape(t, n, 2)


def fit_each(cell: PreparedCell, trials: Trials) -> FittedTrials:
    """Calibrate the trials one by one, each with all that its calibration finds in the residuals.

    A trial that is refused does not stop the others.
    """
    free = select_free_parameters(cell.robot)
    nothing = FittedTrials(
        values=np.full(len(cell.robot.parameters), np.nan),
        outcome=np.array(REFUSED),
        half_width=np.full(len(free), np.nan),
        expanded=np.full((len(cell.held_out.q), 2), np.nan),
        scores={},
    )
    single = []
    for i in range(len(trials)):
        try:
            single.append(_fit_one(cell, state_times(trials.trial(i))))
        except (EstimationError, DataError):
            single.append(nothing)
    names = ("values", "outcome", "half_width", "expanded")
    arrays = [np.stack([getattr(fit, name) for fit in single]) for name in names]
    known = dict.fromkeys(name for fit in single for name in fit.scores)
    scores = {name: np.array([f.scores.get(name, np.nan) for f in single]) for name in known}
    values, outcome, half_width, expanded = arrays
    return FittedTrials(values, outcome, half_width, expanded, scores)


def state_times(data: Measurements) -> Measurements:
    """Return measurements with the time of each row, for the tests of slow errors."""
    first = [rows.rows.reshape(len(rows), -1)[:, 0] for rows in data.observations]
    observations = tuple(
        replace(rows, context={"time": POSE_TIME * poses})
        for rows, poses in zip(data.observations, first, strict=True)
    )
    return replace(data, observations=observations)


def _fit_one(cell: PreparedCell, data: Measurements) -> FittedTrials:
    """Return the calibration of one trial, without the axis of trials."""
    asked, scores = cell.content.scores, dict[str, Any]()
    if asked.verdict:
        options = CalibrationOptions(
            fit=cell.fit_options, limit_position=asked.limit_position, limit_angle=asked.limit_angle
        )
        report = calibrate(cell.robot, cell.hold_out(data), options)
        fit, scores["verdict"] = report.identification, float(VERDICTS.index(report.verdict))
    else:
        fit = identify(cell.robot, data, options=cell.fit_options)
        if asked.intervals == "adjusted":
            fit = adjust_uncertainty(fit, data)
    U = pose_uncertainty(fit, forward(fit.robot, cell.held_out.q), frame=asked.error_frame)
    test = fit.residual_test
    return FittedTrials(
        values=fit.robot.values,
        outcome=np.array(_OF_STATUS[fit.status]),
        half_width=fit.interval(),
        expanded=np.stack([U.expanded_position, U.expanded_orientation], axis=-1),
        scores=scores
        | {
            "rank": float(fit.rank),
            "condition": fit.spectrum.condition,
            "iterations": float(fit.history.iterations),
            "noise_scale": float(compute_noise(test.chi_square, test.degrees)),
        },
    )
