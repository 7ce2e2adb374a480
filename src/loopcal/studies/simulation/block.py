# SPDX-License-Identifier: Apache-2.0
"""The scores of a block: draw machines, measure and calibrate them, compare with the truth.

Trials are calibrated all at once where the method allows it, else one by one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.apply.accuracy import combine_errors, expand_length, pose_uncertainty, transport
from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.calibration_report import Verdict
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.diagnose.error_frames import FITTED, ReferencePoses, fit_frames, refer_errors
from loopcal.diagnose.gauge_freedoms import twist_weights
from loopcal.engine import State
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import IdentifiedTrials, identify, identify_trials
from loopcal.estimate.information import frame_twists
from loopcal.estimate.penalties import Ridge
from loopcal.measure.instrument import BlockStream, make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import Trials, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.states import Status
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.studies import specification
from loopcal.studies.simulation import machines, published_steps
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# Codes of the outcomes of a trial, by their number; new ones are added at the end.
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


POSE_TIME = 60.0  # seconds from one pose to the next
# Verdicts by their number.
VERDICTS = (Verdict.CALIBRATED, Verdict.RESERVATIONS, Verdict.UNDECIDED, Verdict.NOT_CALIBRATED)

# Half-width of the 95 % interval of a normal distribution, in standard deviations.
LEVEL_95 = 1.959963984540054


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


def fit_trials(cell: machines.PreparedCell, trials: Trials, threads: int = 1) -> FittedTrials:
    """Calibrate all trials; threads compute those that are one batch."""
    options, scores = cell.fit_options, cell.content.scores
    if cell.content.method.is_published:
        return fit_published(cell, trials)
    is_batch = options.loss is None and options.noise == "given" and cell.layout is None
    if is_batch and not scores.verdict and scores.intervals == "stated":
        return fit_together(cell, trials, threads)
    return fit_each(cell, trials)


def fit_together(cell: machines.PreparedCell, trials: Trials, threads: int = 1) -> FittedTrials:
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


def fit_per_leg(
    robot: Mechanism, data: Measurements, method: specification.MethodLevel
) -> published_steps.PerLegEstimate:
    """Fit leg by leg. EstimationError as of `identify_per_leg`."""
    steps, epsilon = method.steps or published_steps.LEG_STEPS, method.epsilon or 0.0
    return published_steps.identify_per_leg(robot, data, steps, epsilon, method.stop or "dQint")


def fit_published(cell: machines.PreparedCell, trials: Trials) -> FittedTrials:
    """Calibrate all trials by a method of published studies, whose intervals do not exist; a trial
    that fails does not stop the others.

    Raises DataError: products of points that are not held on planes and lines.
    """
    method, robot, fits = cell.content.method, cell.robot, refuse_all(cell, len(trials))
    values, outcome, scores = fits.values, fits.outcome, dict[str, Any]()
    if method.is_of_products:
        values, outcome, iterations, scores["rank"] = _fit_products(cell, trials)
    elif method.method == specification.PER_LEG:
        iterations = np.zeros(len(trials), dtype=np.int64)
        for i in range(len(trials)):
            with suppress(EstimationError, DataError):
                fit = fit_per_leg(robot, trials.trial(i), method)
                values[i], outcome[i] = fit.robot.values, 0 if fit.is_converged else STEPS_REMAIN
                iterations[i] = fit.steps
    else:
        names = select_free_parameters(robot).names
        ridge = Ridge(method.lam or 0.0).resolve(names)
        raw = published_steps.make_raw_problem(robot, trials, ridge)
        lam = 1.0 if isinstance(ridge.lam, tuple) else ridge.lam  # 0 of least squares
        penalty = published_steps.penalize_ridge(np.array([lam]), len(names))
        if method.method == "truncated-svd":
            penalty = published_steps.penalize_truncated(np.array([method.keep]), len(names))
        is_counted = method.epsilon is None and method.steps is not None
        epsilon = 0.0 if is_counted else method.epsilon or published_steps.EPSILON
        steps = published_steps.take_steps(
            raw, penalty, published_steps.StepRule(epsilon, method.steps or published_steps.LIMIT)
        )
        outcome = np.where(steps.is_converged | is_counted, 0, STEPS_REMAIN)
        outcome = np.where(steps.is_diverged, DIVERGED, outcome)
        values, iterations = steps.values, steps.count
    scores["iterations"] = iterations.astype(float)
    return replace(fits, values=values, outcome=outcome, scores=scores)


def _fit_products(
    cell: machines.PreparedCell, trials: Trials
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
    stated: list[published_steps.Weights] = [
        w for w in published_steps.WEIGHTS if method.rows == f"products-{w}"
    ]
    weights: published_steps.Weights = stated[0] if stated else "full"
    chosen = machines.make_fit_options(method).method
    assert trials.recorded is not None
    assert chosen is not None
    if isinstance(chosen, Ridge):
        chosen = chosen.resolve(robot.parameters.names)
    rows = published_steps.PaperRows(cell.layout, trials.recorded, sd, sigma, weights)
    fit = published_steps.identify_from_rows(rows, chosen)
    outcome = np.where(fit.status == DescentStatus.CONVERGED, 0, EXHAUSTED)
    rank = fit.decomposition.rank.astype(float)
    return rows.values(fit.deviation), outcome, fit.iterations, rank


def compute_noise(chi_square: ArrayLike, degrees: ArrayLike) -> FloatArray:
    """Return the residuals over the stated noise; NaN where no degree of freedom is left."""
    left = np.asarray(degrees, dtype=float)
    return np.sqrt(np.asarray(chi_square) / np.where(left > 0.0, left, np.nan))


def solve_cell_poses(cell: machines.PreparedCell, values: FloatArray) -> tuple[State, State]:
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
    cell: machines.PreparedCell, fits: IdentifiedTrials, state: State, measured: State
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


def fit_each(cell: machines.PreparedCell, trials: Trials) -> FittedTrials:
    """Calibrate the trials one by one, each with all that its calibration finds in the residuals.

    A trial that is refused does not stop the others.
    """
    fits, scores = refuse_all(cell, len(trials)), dict[str, FloatArray]()
    for i in range(len(trials)):
        with suppress(EstimationError, DataError):
            one = _fit_one(cell, state_times(trials.trial(i)))
            for name in ("values", "outcome", "half_width", "expanded"):
                getattr(fits, name)[i] = getattr(one, name)
            for name, score in one.scores.items():
                scores.setdefault(name, np.full(len(trials), np.nan))[i] = score
    return replace(fits, scores=scores)


def refuse_all(cell: machines.PreparedCell, t: int) -> FittedTrials:
    """Return t trials that are refused, without numbers."""
    shapes = len(cell.robot.parameters), len(select_free_parameters(cell.robot))
    values, half_width = (np.full((t, count), np.nan) for count in shapes)
    expanded = np.full((t, len(cell.held_out.q), 2), np.nan)
    return FittedTrials(values, np.full(t, REFUSED), half_width, expanded, {})


def state_times(data: Measurements) -> Measurements:
    """Return measurements with the time of each row, for the tests of slow errors."""
    first = [rows.rows.reshape(len(rows), -1)[:, 0] for rows in data.observations]
    observations = tuple(
        replace(rows, context={"time": POSE_TIME * poses})
        for rows, poses in zip(data.observations, first, strict=True)
    )
    return replace(data, observations=observations)


def _fit_one(cell: machines.PreparedCell, data: Measurements) -> FittedTrials:
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


# The scores of a block.

# Purpose of the random stream from which the errors of the readings of held-out poses come.
HELD_OUT = 4

PARTS = {"position": slice(3, 6), "orientation": slice(0, 3)}  # score -> its components of a twist


@dataclass(frozen=True)
class PosesTask:
    """Poses to draw or to plan. `content` : what determines them, as JSON. `key` : its hash."""

    key: str
    content: str


@dataclass(frozen=True)
class BlockTask:
    """A block to compute.

    key : hash of everything that determines its numbers. cell : number of its cell.
    block : number of the block in its cell. content : all that `compute_block` needs, as JSON.
    """

    key: str
    cell: int
    block: int
    content: str


def compute_block(task: BlockTask, threads: int = 1) -> FloatArray:
    """Simulate and calibrate the machines of a block, and return their scores (B, s), SI.

    Columns are `Study.columns`. Column 0 is the outcome: 0 for a trial that converged, else the
    number of a code in OUTCOMES. Other numbers of a failed trial are NaN where they do not exist.

    It is a pure function of `task.content`: the same numbers to the last bit in every process, for
    every number of threads and workers.

    Raises LoopcalError: the cell cannot be simulated at all, such as a kind that the robot does not
    have.
    """
    content = json.loads(task.content)
    cell, trials, fits = calibrate_block(content, threads)
    stream = make_stream(cell.content.seed, content["block"])
    names = [column.name for column in specification.list_columns(cell.content.scores)]
    scores: dict[str, Any] = dict.fromkeys(names, np.nan)
    scores |= score_poses(cell, trials, fits, stream) | score_parameters(cell, trials, fits)
    scores |= fits.scores
    assert set(scores) == set(names), "a score needs its column in studies/scores.toml"
    columns = np.broadcast_arrays(*(scores[name] for name in names))
    return np.stack(columns, axis=1)


def compute_task(task: BlockTask | PosesTask, threads: int = 1) -> FloatArray | machines.CellPoses:
    """Compute a block, see `compute_block`, or poses."""
    return compute_plan(task) if isinstance(task, PosesTask) else compute_block(task, threads)


def compute_plan(task: PosesTask) -> machines.CellPoses:
    """Draw or plan poses."""
    return machines.compute_poses(json.loads(task.content))


def make_poses_task(content: Mapping[str, Any]) -> PosesTask:
    """Return the task of the poses of a block, from its description."""
    description = machines.describe_poses(content)
    return PosesTask(specification.compute_key(description), specification.format_json(description))


def make_block_task(cell: int, content: Mapping[str, Any], poses: machines.CellPoses) -> BlockTask:
    """Return the task of a block of a cell, from its description and its poses."""
    complete = specification.format_json({**content, **vars(poses)})
    return BlockTask(specification.compute_key(content), cell, content["block"], complete)


def list_tasks(
    study: specification.Study,
    cells: Sequence[int] | None = None,
    blocks: Sequence[int] | None = None,
) -> Iterator[BlockTask]:
    """Yield the tasks of these blocks of these cells, of all by default. The poses of a cell are
    drawn or planned here; the driver of a study leaves them to workers.
    """
    known = dict[str, machines.CellPoses]()
    for number in range(len(study.cells)) if cells is None else cells:
        of_cell = specification.describe_cell(study, study.cells[number])
        task = make_poses_task(of_cell)
        poses = known.get(task.key) or compute_plan(task)
        known[task.key] = poses
        for block in range(study.blocks) if blocks is None else blocks:
            yield make_block_task(number, of_cell | {"block": block}, poses)


def calibrate_block(
    content: Mapping[str, Any], threads: int = 1
) -> tuple[machines.PreparedCell, Trials, FittedTrials]:
    """Simulate and calibrate the machines of the content of a task, by so many threads."""
    cell, trials = (
        machines.prepare_cell(content),
        _simulate(specification.format_json(machines.share_content(content, "block"))),
    )
    return cell, trials, fit_trials(cell, trials, threads)


@lru_cache(maxsize=2)
def _simulate(text: str) -> Trials:
    """Return the machines of a block and their measurements, which are those of all methods; text :
    its `share_content`, as JSON.
    """
    content = json.loads(text)
    cell = machines.prepare_cell(content)
    return simulate_block(cell, make_stream(cell.content.seed, content["block"]))


def make_stream(seed: int, block: int) -> BlockStream:
    """Return the random stream of a block.

    It depends on the seed of the study and the number of the block only. All cells see the same
    machines and the same noise as far as they have the same parameters, poses and columns, so that
    differences between cells are paired.
    """
    digest = hashlib.sha256(f"loopcal study {seed}".encode()).digest()
    return BlockStream(int.from_bytes(digest[:16], "little"), block)


def simulate_block(cell: machines.PreparedCell, stream: BlockStream) -> Trials:
    """Draw the true machines of a block and measure them; with a verdict, also held-out poses."""
    poses = cell.measured
    if cell.content.scores.verdict:
        poses = np.concatenate([poses, np.array(cell.content.held_out)])
    truth = machines.draw_machines(cell.robot, cell.content.errors, cell.content.trials, stream)
    if cell.layout is not None:
        return machines.measure_held_points(cell.layout, truth, cell.instrument, stream)
    disturbance = machines.make_disturbance(cell.robot, truth, poses, cell.content.effects, stream)
    trials = simulate_trials(
        cell.robot, truth, poses, cell.instrument, stream, disturbance=disturbance
    )
    return machines.hide_columns(trials, cell.content.instrument.unused)


def score_poses(
    cell: machines.PreparedCell, trials: Trials, fits: FittedTrials, stream: BlockStream
) -> dict[str, FloatArray]:
    """Return the outcome, the errors of held-out poses before and after calibration, and how many
    lie within their expanded uncertainty.
    """
    robot, held_out = cell.robot, cell.held_out
    readings, sigma = held_out.q[None], robot.stated_sigma  # true ones are those that are shown,
    if sigma.any():  # with errors where the robot states their standard deviation
        streams = (make_random_stream(stream, trial, HELD_OUT) for trial in range(len(trials)))
        drawn = np.stack([s.standard_normal(readings.shape[1:]) for s in streams])
        readings = readings + drawn * sigma
    truth = forward_trials(robot, trials.truth, readings, held_out.state)
    state, reference = fits.states or solve_cell_poses(cell, fits.values)
    is_lost = has_result(fits.outcome) & ~(is_reached(truth) & is_reached(state))
    is_known = np.all(np.isfinite(fits.values), axis=1)[:, None, None, None]
    nominal = held_out.T[None], cell.reference.T[None]
    fitted = (np.where(is_known, s.T, np.nan) for s in (state, reference))
    scores: dict[str, FloatArray] = {"outcome": np.where(is_lost, NOT_REACHED, fits.outcome)}
    for when, (T, measured) in {"_before": nominal, "": tuple(fitted)}.items():
        tools = np.broadcast_to(T, truth.T.shape) @ robot.tool
        error = geometry.pose_difference(tools, truth.T @ robot.tool)
        if not robot.can_rotate:
            error[..., :3] = np.nan
        if cell.content.scores.frame == "both":
            for name, part in PARTS.items():
                size = np.linalg.norm(error[..., part], axis=2)
                scores[f"{name}_base{when}"] = compute_rms(size)
        if cell.motions.shape[1]:
            error = error - _fit_motions(cell, trials, T, measured)
        for name, part in PARTS.items():
            size = np.linalg.norm(error[..., part], axis=2)
            scores[name + when] = compute_rms(size)
            scores[f"{name}{when}_max"] = size.max(axis=1)
            if not when:
                limit = fits.expanded[..., 0 if name == "position" else 1]
                scores[f"covered_{name}"] = compute_share(size, limit)
    return scores


def score_parameters(
    cell: machines.PreparedCell, trials: Trials, fits: FittedTrials
) -> dict[str, FloatArray]:
    """Return the errors of the free parameters, and how many lie in their intervals."""
    free = select_free_parameters(cell.robot)
    error = (fits.values - trials.truth)[:, free.places]
    dimensions = [cell.robot.parameters.dimensions[i] for i in free.places]
    is_length = np.array([d is Dimension.LENGTH for d in dimensions])
    is_angle = np.array([d is Dimension.ANGLE for d in dimensions])
    scaled = error / free.tolerance
    return {
        "parameters": compute_rms(scaled),
        "parameters_max": np.abs(scaled).max(axis=1),
        "lengths": compute_rms(error[:, is_length]),
        "angles": compute_rms(error[:, is_angle]),
        "covered_parameters": compute_share(np.abs(error), fits.half_width),
    }


def compute_rms(values: FloatArray) -> FloatArray:
    """Return the root mean square (t,) of values (t, k); NaN of none."""
    if not values.shape[1]:
        return np.full(len(values), np.nan)
    return np.sqrt(np.mean(values**2, axis=1))


def compute_share(error: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the share (t,) of k errors up to their limits (t, k), which may be infinite; NaN where
    an error or a limit does not exist.
    """
    is_undefined = np.isnan(error).any(axis=1) | np.isnan(limit).any(axis=1)
    return np.where(is_undefined, np.nan, (error <= limit).mean(axis=1))


def _fit_motions(
    cell: machines.PreparedCell, trials: Trials, T: FloatArray, measured: FloatArray
) -> FloatArray:
    """Return the errors (t, h, 6) of the tool at platform poses T (t | 1, h, 4, 4) that motions of
    frames explain: those that fit the errors of the measured poses (t | 1, n, 4, 4) best.
    """
    robot, n = cell.robot, len(cell.measured)
    true, usable = trials.T[:, :n], trials.reached[:, :n]
    if cell.layout is not None:  # the poses at the readings of the nominal robot
        state = forward_trials(robot, trials.truth, cell.reference.q[None], cell.reference.state)
        true, usable = state.T, state.status == Status.CONVERGED
    poses, places = (np.broadcast_to(a, (len(true), *a.shape[1:])) for a in (measured, T))
    errors = geometry.pose_difference(poses, true)
    explained = []
    for i, used in enumerate(usable & np.isfinite(poses).all(axis=(2, 3))):
        if not used.any():  # a trial without a calibrated machine
            explained.append(np.full((places.shape[1], 6), np.nan))
            continue
        motion = fit_frames(robot, poses[i, used], cell.motions)(errors[i, used][..., None])
        arm = places[i, :, :3, :3] @ robot.tool[:3, 3]
        twists = frame_twists(places[i], robot.size) @ motion
        explained.append((geometry.transport_matrix(arm) @ twists)[..., 0])
    return np.stack(explained)


@dataclass(frozen=True, eq=False)
class CalibratedCell:
    """t calibrated machines, which are not scored.

    levels : factor -> level. robot : nominal. readings : (n, a) [SI] of the controller.
    truth, values : (t, p) [SI] true and estimated parameters; values are NaN where there are none.
    measured : of each sensor (t, r, c) [SI]. outcome : (t,) numbers of OUTCOMES before held-out
        poses are looked at. iterations : (t,).
    """

    levels: Mapping[str, str]
    robot: Mechanism
    readings: FloatArray
    truth: FloatArray
    values: FloatArray
    measured: tuple[FloatArray, ...]
    outcome: IntArray
    iterations: IntArray

    @property
    def is_converged(self) -> BoolArray:
        """(t,) which fits converged."""
        return self.outcome == 0


def calibrate_cells(
    study: specification.Study, cells: Sequence[int] | None = None
) -> Iterator[CalibratedCell]:
    """Yield the calibrations of these cells, of all by default, one cell after the other."""
    if not study.scores.verdict:  # held-out poses are not looked at
        study = replace(study, scores=replace(study.scores, held_out=1, frame="base"))
    for number, tasks in groupby(list_tasks(study, cells), lambda task: task.cell):
        blocks = [calibrate_block(json.loads(task.content)) for task in tasks]
        prepared, trials, fits = zip(*blocks, strict=True)

        def join(arrays: Iterable[np.ndarray]) -> np.ndarray:
            return np.concatenate(list(arrays))[: study.replicates]

        iterations = join(f.scores.get("iterations", 0 * f.outcome) for f in fits)
        yield CalibratedCell(
            study.cells[number].levels,
            prepared[0].robot,
            trials[0].readings,
            join(t.truth for t in trials),
            join(f.values for f in fits),
            tuple(join(measured) for measured in zip(*(t.measured for t in trials), strict=True)),
            join(f.outcome for f in fits),
            np.nan_to_num(iterations).astype(np.int64),
        )


def find_cells(study: specification.Study, **levels: str) -> tuple[int, ...]:
    """Return the numbers of the cells with these levels, factor=level."""
    return tuple(
        cell.number
        for cell in study.cells
        if all(cell.levels[factor] == level for factor, level in levels.items())
    )


def set_size(study: specification.Study, seed: int, trials: int) -> specification.Study:
    """Return a study with another seed and so many trials in each cell; machine i of its first
    block is the same for any number of trials.
    """
    return replace(study, seed=seed, replicates=trials, block=min(trials, study.block))


def replay_trial(
    study: specification.Study, cell: int, trial: int
) -> tuple[machines.PreparedCell, Mechanism, Measurements]:
    """Return the cell, the true machine and the measurements of a trial, to the last bit; trials of
    a cell are numbered from 0, over all of its blocks.

    Raises DataError: the study has no such cell or trial.
    """
    for name, number, count in (
        ("cell", cell, len(study.cells)),
        ("trial", trial, study.blocks * study.block),
    ):
        if not 0 <= number < count:
            raise DataError(
                f"this study has no {name} {number}. Its {name}s have the numbers 0 to {count - 1}"
            )
    block, place = divmod(trial, study.block)
    (task,) = list_tasks(study, [cell], blocks=[block])
    content = json.loads(task.content)
    prepared = machines.prepare_cell(content)
    trials = simulate_block(prepared, make_stream(prepared.content.seed, block))
    data = state_times(trials.trial(place))
    if prepared.content.scores.verdict:
        data = prepared.hold_out(data)
    return prepared, prepared.robot.with_values(trials.truth[place]), data
