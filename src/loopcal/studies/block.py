# SPDX-License-Identifier: Apache-2.0
"""The scores of a block: draw machines, measure and calibrate them, compare with the truth."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.estimate.identification import identify_trials
from loopcal.measure import Instrument, Trials, simulate_trials
from loopcal.measure.instrument import BlockStream
from loopcal.mechanism import Mechanism, Solution, Status, forward_trials, inverse
from loopcal.studies.instruments import make_instrument
from loopcal.studies.keys import read_record
from loopcal.studies.machines import build_robot_of, change_tolerances, draw_machines
from loopcal.studies.methods import make_fit_options
from loopcal.studies.scores import list_columns
from loopcal.studies.specification import (
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    Scores,
)
from loopcal.typing import FloatArray
from loopcal.units import Dimension

OUTCOMES: tuple[str, ...] = (
    "study.converged",
    "study.not-converged",
    "study.held-out-not-reached",
    "study.refused",
)
"""Codes of the outcomes of a trial, by their number."""

LEVEL_95 = 1.959963984540054
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True, eq=False)
class BlockInput:
    """What a block computes with.

    Attributes
    ----------
    robot : nominal, with the tolerances of the cell. instrument, errors, method, effects, scores :
        of the cell. measured : (n, c) controlled coordinates. held_out : solution at h poses.
    stream : the random stream. trials : their number.
    """

    robot: Mechanism
    instrument: Instrument
    errors: ErrorsLevel
    method: MethodLevel
    effects: EffectsLevel
    scores: Scores
    measured: FloatArray
    held_out: Solution
    stream: BlockStream
    trials: int


def read_block(content: Mapping[str, Any]) -> BlockInput:
    """Return what the content of a task describes."""
    errors = read_record(ErrorsLevel, content["errors"])
    robot = change_tolerances(build_robot_of(content["robot"]), errors).nominal
    noise = read_record(NoiseLevel, content["noise"])
    return BlockInput(
        robot,
        make_instrument(read_record(InstrumentLevel, content["instrument"]), noise),
        errors,
        read_record(MethodLevel, content["method"]),
        read_record(EffectsLevel, content["effects"]),
        read_record(Scores, content["scores"]),
        np.array(content["measured"]),
        inverse(robot, content["held_out"]),
        make_stream(content["seed"], content["block"]),
        content["trials"],
    )


def make_stream(seed: int, block: int) -> BlockStream:
    """Return the random stream of a block. It depends on the seed of the study and the number of
    the block only, so that all cells see the same machines and the same noise, as far as they have
    the same parameters, poses and columns: differences between cells are paired.
    """
    digest = hashlib.sha256(f"loopcal study {seed}".encode()).digest()
    return BlockStream(int.from_bytes(digest[:16], "little"), block)


def simulate_block(block: BlockInput) -> Trials:
    """Draw the true machines of a block and measure them."""
    truth = draw_machines(block.robot, block.errors, block.trials, block.stream)
    return simulate_trials(block.robot, truth, block.measured, block.instrument, block.stream)


def compute_scores(content: Mapping[str, Any]) -> FloatArray:
    """Return the scores (B, s) of the content of a task."""
    block = read_block(content)
    trials = simulate_block(block)
    fits = identify_trials(block.robot, trials, options=make_fit_options(block.method))
    robot, places, h = block.robot, fits.free_parameters.places, block.held_out
    poses = [
        forward_trials(robot, values, h.q[None], h.state)
        for values in (trials.truth, fits.values, robot.values[None])
    ]
    reached = [(state.status == Status.CONVERGED).all(axis=1) for state in poses]
    outcome = np.where(reached[0] & reached[1], 0, 2)
    outcome = np.where(fits.converged, outcome, 1)
    after, before = (geometry.pose_difference(state.T, poses[0].T) for state in poses[1:])
    error = (fits.values - trials.truth)[:, places]
    scaled = error / fits.free_parameters.tolerance
    dimensions = np.array([robot.parameters.dimensions[i] for i in places])
    plain = fits.decomposition.plain()
    scores: dict[str, FloatArray] = {
        "outcome": outcome,
        **_summarize_poses(before, "_before"),
        **_summarize_poses(after, ""),
        "parameters": _rms(scaled),
        "parameters_max": np.abs(scaled).max(axis=1),
        "lengths": _rms(error[:, dimensions == Dimension.LENGTH]),
        "angles": _rms(error[:, dimensions == Dimension.ANGLE]),
        "covered_parameters": (np.abs(error) <= LEVEL_95 * fits.standard_deviations()).mean(axis=1),
        "rank": plain.rank,
        "condition": plain.condition,
        "iterations": fits.iterations,
        "noise": np.sqrt(fits.cost / np.maximum(plain.rows - plain.rank, 1)),
    }
    values = np.full((block.trials, len(list_columns(block.scores))), np.nan)
    for i, column in enumerate(list_columns(block.scores)):
        if column.name in scores:
            values[:, i] = scores[column.name]
    return values


def _summarize_poses(error: FloatArray, suffix: str) -> dict[str, FloatArray]:
    """Return rms and largest errors (t,) of poses with errors (t, h, 6)."""
    lengths = {"orientation": slice(0, 3), "position": slice(3, 6)}
    result = {}
    for name, part in lengths.items():
        size = np.linalg.norm(error[..., part], axis=2)
        result[name + suffix] = _rms(size)
        result[f"{name}{suffix}_max"] = size.max(axis=1)
    return result


def _rms(values: FloatArray) -> FloatArray:
    """Return the root mean square (t,) of values (t, k); NaN of none."""
    if not values.shape[1]:
        return np.full(len(values), np.nan)
    return np.sqrt(np.mean(values**2, axis=1))
