# SPDX-License-Identifier: Apache-2.0
"""Measured and held-out poses of a cell, which the driver computes once and adds to its tasks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from loopcal.measure import Instrument
from loopcal.mechanism import Mechanism, sample_workspace
from loopcal.planning import PlanOptions, plan
from loopcal.studies.simulation.instruments import make_instrument
from loopcal.studies.simulation.machines import build_robot_of, change_tolerances
from loopcal.studies.specification.keys import read_record
from loopcal.studies.specification.levels import (
    ErrorsLevel,
    InstrumentLevel,
    NoiseLevel,
    PosesLevel,
    Scores,
)
from loopcal.typing import FloatArray


def add_poses(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the controlled coordinates [m, rad] of the measured and held-out poses of a block,
    from its description.
    """
    errors = read_record(ErrorsLevel, content["errors"])
    robot = change_tolerances(build_robot_of(content["robot"]), errors)
    level = read_record(PosesLevel, content["poses"])
    instrument = make_instrument(
        read_record(InstrumentLevel, content["instrument"]),
        read_record(NoiseLevel, content["noise"]),
    )
    scores = read_record(Scores, content["scores"])
    seed = content["seed"]
    measured = choose_poses(robot, instrument, level, seed if level.seed is None else level.seed)
    held_out = sample_workspace(robot.nominal, scores.held_out, seed + 1).coordinates
    return {"measured": measured.tolist(), "held_out": held_out.tolist()}


def choose_poses(
    robot: Mechanism, instrument: Instrument, level: PosesLevel, seed: int
) -> FloatArray:
    """Return coordinates (n, c) of poses: given ones, drawn from the workspace, or planned."""
    if level.coordinates:
        return np.array(level.coordinates)
    if level.choice == "random":
        return sample_workspace(robot.nominal, level.count, seed).coordinates
    options = PlanOptions(n_poses=level.count, hold_out=0, seed=seed)
    return plan(robot.nominal, instrument, options=options).poses.coordinates
