# SPDX-License-Identifier: Apache-2.0
"""The scores of a block: draw machines, measure and calibrate them, compare with the truth."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.diagnose.error_frames import fit_frames
from loopcal.estimate.frame_freedoms import frame_twists
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.measure import BlockStream, Trials, make_random_stream, simulate_trials
from loopcal.mechanism import Mechanism, Status, forward_trials
from loopcal.studies.simulation.effects import make_disturbance
from loopcal.studies.simulation.fits import NOT_REACHED, FittedTrials, fit_trials, is_reached
from loopcal.studies.simulation.held_points import measure_held_points
from loopcal.studies.simulation.instruments import hide_columns
from loopcal.studies.simulation.machines import draw_machines
from loopcal.studies.simulation.preparation import PreparedCell, prepare_cell
from loopcal.studies.specification.scores import list_columns
from loopcal.typing import FloatArray
from loopcal.units import Dimension

HELD_OUT = 4
"""Purpose of the random stream from which the errors of the readings of held-out poses come."""

PARTS = {"position": slice(3, 6), "orientation": slice(0, 3)}
"""Score -> its components of a twist."""


@dataclass(frozen=True, eq=False)
class CalibratedBlock:
    """The calibrations of a block of trials, before they are scored."""

    cell: PreparedCell
    stream: BlockStream
    trials: Trials
    fits: FittedTrials


def calibrate_block(content: Mapping[str, Any], threads: int = 1) -> CalibratedBlock:
    """Simulate and calibrate the machines of the content of a task, by so many threads."""
    cell = prepare_cell(content)
    stream = make_stream(cell.seed, content["block"])
    trials = simulate_block(cell, stream)
    return CalibratedBlock(cell, stream, trials, fit_trials(cell, trials, threads))


def compute_scores(content: Mapping[str, Any], threads: int = 1) -> FloatArray:
    """Return the scores (B, s) of the content of a task."""
    block = calibrate_block(content, threads)
    cell, stream, trials, fits = block.cell, block.stream, block.trials, block.fits
    scores = score_poses(cell, trials, fits, stream) | score_parameters(cell, trials, fits)
    for name in ("rank", "condition", "iterations", "noise_scale", "verdict"):
        scores[name] = getattr(fits, name)
    return np.stack([scores[column.name] for column in list_columns(cell.scores)], axis=1)


def make_stream(seed: int, block: int) -> BlockStream:
    """Return the random stream of a block.

    It depends on the seed of the study and the number of the block only. All cells see the same
    machines and the same noise as far as they have the same parameters, poses and columns, so that
    differences between cells are paired.
    """
    digest = hashlib.sha256(f"loopcal study {seed}".encode()).digest()
    return BlockStream(int.from_bytes(digest[:16], "little"), block)


def simulate_block(cell: PreparedCell, stream: BlockStream) -> Trials:
    """Draw the true machines of a block and measure them; with a verdict, also held-out poses."""
    poses = cell.measured
    if cell.scores.verdict:
        poses = np.concatenate([poses, cell.validated])
    truth = draw_machines(cell.robot, cell.errors, cell.trials, stream)
    if cell.layout is not None:
        return measure_held_points(cell.layout, truth, cell.instrument, stream)
    disturbance = make_disturbance(cell.robot, truth, poses, cell.effects, stream)
    trials = simulate_trials(
        cell.robot, truth, poses, cell.instrument, stream, disturbance=disturbance
    )
    return hide_columns(trials, cell.unused)


def score_poses(
    cell: PreparedCell, trials: Trials, fits: FittedTrials, stream: BlockStream
) -> dict[str, FloatArray]:
    """Return the outcome, the errors of held-out poses before and after calibration, and how many
    lie within their expanded uncertainty.
    """
    robot, held_out = cell.robot, cell.held_out
    readings = _draw_true_readings(cell, len(trials), stream)
    truth = forward_trials(robot, trials.truth, readings, held_out.state)
    nominal = held_out.T[None], cell.reference.T[None]
    reached = is_reached(truth) & fits.reached
    scores: dict[str, FloatArray] = {
        "outcome": np.where((fits.outcome == 0) & ~reached, NOT_REACHED, fits.outcome)
    }
    for when, (T, measured) in {"_before": nominal, "": (fits.T, fits.T_measured)}.items():
        error = _tool_errors(robot, T, truth.T)
        if not can_rotate(robot):
            error[..., :3] = np.nan
        if cell.scores.frame == "both":
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
    cell: PreparedCell, trials: Trials, fits: FittedTrials
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


def can_rotate(robot: Mechanism) -> bool:
    """Return whether the platform has a rotation that an error could change."""
    return any(freedom < 3 for freedom in robot.program.freedoms)


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


def _draw_true_readings(cell: PreparedCell, trials: int, stream: BlockStream) -> FloatArray:
    """Return true readings (t | 1, h, a) of the held-out poses: those that are shown, with errors
    where the robot states a standard deviation of its readings.
    """
    shown, sigma = cell.held_out.q[None], cell.robot.stated_sigma
    if not sigma.any():
        return shown
    streams = (make_random_stream(stream, trial, HELD_OUT) for trial in range(trials))
    return shown + np.stack([s.standard_normal(shown.shape[1:]) for s in streams]) * sigma


def _tool_errors(robot: Mechanism, T: FloatArray, truth: FloatArray) -> FloatArray:
    """Return errors (t, n, 6) of the tool at platform poses T (t | 1, n, 4, 4), in base axes."""
    return geometry.pose_difference(
        np.broadcast_to(T, truth.shape) @ robot.tool, truth @ robot.tool
    )


def _fit_motions(
    cell: PreparedCell, trials: Trials, T: FloatArray, measured: FloatArray
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
