# SPDX-License-Identifier: Apache-2.0
"""What all blocks of a cell have in common, which a process prepares once."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from loopcal.diagnose.error_frames import BASE, choose_error_frame, list_unfixed_motions
from loopcal.estimate import MAP, FitOptions
from loopcal.estimate.published_methods.plane_line_products import Layout
from loopcal.estimate.trial_identification import identify_trials
from loopcal.estimate.trial_posteriors import compute_trial_posterior
from loopcal.measure import Instrument, Measurements, Trials, simulate_trials, solve_commanded_poses
from loopcal.mechanism import Mechanism, Solution, inverse
from loopcal.studies.simulation.effects import alter_noise
from loopcal.studies.simulation.held_points import check_effects, make_layout, measure_held_points
from loopcal.studies.simulation.instruments import hide_columns, make_instrument, place_instrument
from loopcal.studies.simulation.machines import build_robot_of, change_tolerances
from loopcal.studies.simulation.methods import make_fit_options
from loopcal.studies.specification.keys import format_json, read_record
from loopcal.studies.specification.levels import (
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    Scores,
)
from loopcal.typing import FloatArray

OF_BLOCK = ("block",)
"""Keys of the content of a task that differ between the blocks of a cell."""

KEPT_CELLS = 4
"""Cells that a process keeps."""


@dataclass(frozen=True, eq=False)
class PreparedCell:
    """What the blocks of a cell compute with.

    Attributes
    ----------
    robot : nominal, with the tolerances of the cell. instrument : with its true noise.
    errors, effects, scores, method, fit_options : of the cell. unused : measured columns that the
        fit does not get. layout : points that are held on planes and lines; None for other poses.
    measured, validated : (n, c), (h, c) controlled coordinates of measured and held-out poses.
    held_out : solution of the nominal robot at the held-out poses.
    motions : (12, k) motions of the base and platform frames that are fitted before errors are
        stated: in the frame "fitted" those that the measurements do not determine.
    reference : solution of the nominal robot at the poses over which these are fitted: the measured
        ones, or none where there is no such motion.
    seed, trials : of the study, and of a block.
    """

    robot: Mechanism
    instrument: Instrument
    errors: ErrorsLevel
    effects: EffectsLevel
    scores: Scores
    method: MethodLevel
    unused: tuple[str, ...]
    layout: Layout | None
    fit_options: FitOptions
    measured: FloatArray
    validated: FloatArray
    held_out: Solution
    motions: FloatArray
    reference: Solution
    seed: int
    trials: int

    def hold_out(self, data: Measurements) -> Measurements:
        """Return measurements in which the poses behind the measured ones are held out."""
        return replace(data, is_held_out=np.arange(data.n_poses) >= len(self.measured))


def prepare_cell(content: Mapping[str, Any]) -> PreparedCell:
    """Return the cell of the content of a task."""
    common = {key: value for key, value in content.items() if key not in OF_BLOCK}
    return _prepare(format_json(common))


@lru_cache(maxsize=KEPT_CELLS)
def _prepare(text: str) -> PreparedCell:
    """Return the cell of the common content of its blocks, as JSON."""
    content = json.loads(text)
    errors = read_record(ErrorsLevel, content["errors"])
    robot = change_tolerances(build_robot_of(content["robot"]), errors).nominal
    noise = read_record(NoiseLevel, content["noise"])
    level = read_record(InstrumentLevel, content["instrument"])
    measured = np.array(content["measured"])
    poses = read_record(PosesLevel, content["poses"])
    instrument = place_instrument(make_instrument(level, noise), robot, poses, measured)
    method = read_record(MethodLevel, content["method"])
    effects = read_record(EffectsLevel, content["effects"])
    scores = read_record(Scores, content["scores"])
    layout = make_layout(robot, measured, poses.groups) if poses.is_on_surfaces else None
    motions = np.zeros((12, 0))
    if scores.error_frame != BASE:
        nominal = robot.values[None]
        if layout is None:
            exact = simulate_trials(robot, nominal, measured, instrument, 0)
            exact = hide_columns(exact, level.unused)
        else:
            check_effects(effects)
            exact = measure_held_points(layout, nominal, instrument, 0, is_exact=True)
            exact = replace(exact, recorded=None)
        motions = find_fitted_motions(robot, exact)
    commanded = solve_commanded_poses(robot, measured)
    return PreparedCell(
        robot,
        alter_noise(instrument, effects),
        errors,
        effects,
        scores,
        method,
        level.unused,
        layout,
        make_fit_options(method),
        measured,
        np.array(content["held_out"]),
        inverse(robot, content["held_out"]),
        motions,
        commanded if motions.shape[1] else commanded.take(np.arange(0)),
        content["seed"],
        content["trials"],
    )


def find_fitted_motions(robot: Mechanism, trials: Trials) -> FloatArray:
    """Return the motions (12, k) of frames that are fitted before errors are stated: those that
    measurements of the nominal robot do not determine; none where no parameter moves these frames.
    """
    fits = identify_trials(robot, trials, MAP())
    posterior = compute_trial_posterior(fits, trials, 0)
    is_moved = choose_error_frame(posterior).fitted
    return list_unfixed_motions(posterior) if is_moved else np.zeros((12, 0))
