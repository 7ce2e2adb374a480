# SPDX-License-Identifier: Apache-2.0
"""Measured and held-out poses of a cell, which are computed once and are part of its tasks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.mechanism import Mechanism, sample_workspace
from loopcal.planning import PlanOptions, plan
from loopcal.planning.plane_line_groups import PlaneLineGroups
from loopcal.planning.plane_line_planning import improve_groups
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

TOLERANCES = ("tolerance_factor", "tolerances")
"""Settings of errors that change the tolerances, and with them planned poses."""

SURFACE_SIGMA = 1e-3
"""Noise for which points on surfaces are planned [m]; it does not change which are best."""


@dataclass(frozen=True, eq=False)
class CellPoses:
    """The poses of all blocks of a cell, and of all cells that have the same ones.

    Attributes
    ----------
    measured, held_out : controlled coordinates [m, rad], a list for each pose.
    """

    measured: list[list[float]]
    held_out: list[list[float]]


def describe_poses(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return everything that determines the poses of a block, from its description.

    Drawn poses depend on the machine only. Planned ones also depend on what is measured, and on the
    tolerances.
    """
    level = read_record(PosesLevel, content["poses"])
    description = {key: content[key] for key in ("robot", "poses", "seed")}
    description["held_out"] = read_record(Scores, content["scores"]).held_out
    if is_planned(level):
        errors = content["errors"]
        tolerances = {key: errors[key] for key in TOLERANCES if key in errors}
        description |= {key: content[key] for key in ("instrument", "noise")}
        description["errors"] = tolerances
    return description


def compute_poses(description: Mapping[str, Any]) -> CellPoses:
    """Return the poses of a description: given ones, drawn from the workspace, or planned."""
    level, seed = read_record(PosesLevel, description["poses"]), description["seed"]
    robot = build_robot_of(description["robot"])
    held_out = sample_workspace(robot.nominal, description["held_out"], seed + 1).coordinates
    chosen_seed = seed if level.seed is None else level.seed
    stream = choose_stream(chosen_seed, seed + 1)
    if level.coordinates:
        measured = np.array(level.coordinates)
    elif level.is_on_surfaces:
        measured = plan_plane_line_points(robot.nominal, level, stream)
    elif not is_planned(level):
        measured = sample_workspace(robot.nominal, level.count, stream).coordinates
    else:
        errors = read_record(ErrorsLevel, description["errors"])
        instrument = make_instrument(
            read_record(InstrumentLevel, description["instrument"]),
            read_record(NoiseLevel, description["noise"]),
        )
        options = PlanOptions(n_poses=level.count, hold_out=0, seed=chosen_seed)
        chosen = plan(change_tolerances(robot, errors).nominal, instrument, options=options)
        measured = chosen.poses.coordinates
    return CellPoses(measured.tolist(), held_out.tolist())


def choose_stream(seed: int, held_out: int) -> int | np.random.Generator:
    """Return the seed of drawn poses, or another stream in place of the seed of the held-out poses:
    with the same one, the measured poses would be the held-out ones.
    """
    if seed != held_out:
        return seed
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))


def plan_plane_line_points(
    robot: Mechanism, level: PosesLevel, seed: int | np.random.Generator
) -> FloatArray:
    """Return coordinates (n, c) of points on planes and perpendicular lines; cells that differ in
    tolerances, noise or method have the same points.
    """
    points = level.count // level.groups
    planned = PlaneLineGroups(robot, points, SURFACE_SIGMA, (level.axis,))
    drawn, equations = planned.draw(level.groups, seed), level.groups * (points - 2)
    is_complete = equations >= len(planned.free)
    design = improve_groups(planned, drawn, level.sweeps, is_complete).design
    return planned.place_points(design).reshape(level.count, -1)


def is_planned(level: PosesLevel) -> bool:
    """Return whether the poses of a level are planned, which takes as long as many trials."""
    return level.choice == "planned" and not level.coordinates
