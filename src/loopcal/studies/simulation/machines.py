# SPDX-License-Identifier: Apache-2.0
"""The machines of a block: the robot of a file text, its tolerances, and the true values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import convert

from loopcal.apply.simulated_measurements import InstrumentDescription, build_instrument
from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.plane_line_products import Layout
from loopcal.estimate.tolerance_components import InflatedTolerances
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.robot.robot_file import build_robot
from loopcal.measure.instrument import Instrument, Seed, make_random_stream
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.simulation import Trials, sample_truth
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import ParameterTable
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.plane_line_planning import (
    PlaneLineGroups,
    find_line_axes,
    improve_groups,
    make_plane_line_instrument,
)
from loopcal.planning.pose_planning import plan
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
from loopcal.units import parse_quantity

KEPT_ROBOTS = 8
"""Robots that a process keeps; building one takes as long as fitting a few of its machines."""


@lru_cache(maxsize=KEPT_ROBOTS)
def build_robot_of(text: str) -> Mechanism:
    """Return the robot of the text of a robot file."""
    return build_robot(parse_yaml(text, Path("robot of the study"), "robot file"))


def change_tolerances(robot: Mechanism, errors: ErrorsLevel) -> Mechanism:
    """Return a robot with the tolerances of a level, which the fit knows.

    Raises DataError: a pattern that no parameter has, or a quantity of another dimension.
    """
    table, factor = robot.parameters, errors.tolerance_factor
    stated = resolve_patterns(table, errors.tolerances)
    entries = tuple(
        replace(entry, tolerance=stated[entry.name])
        if entry.name in stated
        else replace(entry, tolerance=None if entry.tolerance is None else factor * entry.tolerance)
        for entry in table.entries
    )
    common = tuple(replace(error, tolerance=factor * error.tolerance) for error in table.common)
    return replace(robot, parameters=ParameterTable(entries, common))


def draw_machines(robot: Mechanism, errors: ErrorsLevel, n_trials: int, seed: Seed) -> FloatArray:
    """Return true parameter values (t, p) [SI]; `robot` has the tolerances of the level."""
    table = robot.parameters
    if errors.deviations:
        values = np.array(table.nominal)
        for name, deviation in resolve_patterns(table, errors.deviations).items():
            values[table.index(name)] += deviation
        return np.tile(values, (n_trials, 1))
    truth = sample_truth(robot, n_trials, seed, errors.distribution)
    drawn = truth - table.nominal
    if errors.smallest:
        # sizes from `smallest` times the largest one to the largest one, with the same signs and
        # standard deviations
        tolerance, least = np.nan_to_num(table.tolerance), errors.smallest
        largest = np.sqrt(3.0 / (1.0 + least + least**2)) * tolerance
        share = np.abs(drawn) / np.where(tolerance > 0.0, np.sqrt(3.0) * tolerance, 1.0)
        size = np.where(drawn == 0.0, 0.0, largest * (least + (1 - least) * share))
        drawn = np.sign(drawn) * size
    return table.nominal + errors.error_factor * drawn


def resolve_patterns(table: ParameterTable, values: Mapping[str, str]) -> dict[str, float]:
    """Return name -> value [SI] of quantities by name or pattern; the last that fits counts.

    Raises DataError: as for `change_tolerances`.
    """
    resolved: dict[str, float] = {}
    for pattern, text in values.items():
        fitting = [entry for entry in table.entries if fnmatchcase(entry.name, pattern)]
        if not fitting:
            raise DataError(
                f"no parameter is named {pattern!r}{suggest_names(pattern, table.names)}; correct "
                "the name; a pattern such as 'leg*.length' names several"
            )
        for entry in fitting:
            try:
                resolved[entry.name] = parse_quantity(text, entry.dimension)
            except UnitError as error:
                raise DataError(f"{pattern!r} of {entry.name}: {error}") from None
    return resolved


SURFACES = {"plane", "line"}
"""Kinds of an instrument for points of planes and perpendicular lines."""


def make_instrument(level: InstrumentLevel, noise: NoiseLevel) -> Instrument:
    """Return the instrument of a level, with its sigmas times the factor of the noise.

    Raises DataError: as `build_instrument`, or an unused column that it does not measure.
    """
    instrument = build_instrument(
        InstrumentDescription(
            kinds=level.kinds,
            components=level.components,
            orientation=level.orientation,
            sigma_position=noise.factor * level.sigma_position,
            sigma_angle=noise.factor * level.sigma_angle,
            unknown_frames=level.unknown_frames,
            distribution=level.distribution,
        )
    )
    known = [column.name for sensor in instrument.sensors for column in sensor.kind.columns]
    for name in level.unused:
        if name not in known:
            hint = suggest_names(name, known)
            raise DataError(f"{name!r} is not measured{hint}; unused may name {', '.join(known)}")
    if set(level.unused) >= set(known):
        raise DataError("all measured columns are unused; leave at least one")
    return instrument


def place_instrument(
    instrument: Instrument, robot: Mechanism, level: PosesLevel, coordinates: FloatArray
) -> Instrument:
    """Return an instrument at its poses (n, c): on the planes and lines of their groups, where the
    level puts them there.

    Raises DataError: points on planes and lines, and an instrument for something else.
    """
    if not level.is_on_surfaces:
        return instrument
    check_surfaces(instrument)
    noise = {sensor.kind.name: sensor.noise for sensor in instrument.sensors}
    axis = find_line_axes(robot, coordinates, level.groups)
    points = np.arange(len(coordinates)).reshape(level.groups, -1)
    return make_plane_line_instrument(robot, axis, points, lambda name, _: noise[name])


def check_surfaces(instrument: Instrument) -> None:
    """Raise DataError where an instrument does not touch planes and lines."""
    kinds = [sensor.kind.name for sensor in instrument.sensors]
    if set(kinds) != SURFACES:
        raise DataError(
            "points on planes and lines need an instrument of the kinds plane and line, not "
            f"{', '.join(kinds)}; write 'kinds: [plane, line]'"
        )


def hide_columns(trials: Trials, unused: tuple[str, ...]) -> Trials:
    """Return trials in which unused columns are not measured."""
    if not unused:
        return trials
    measured = []
    for sensor, values in zip(trials.instrument.sensors, trials.measured, strict=True):
        is_hidden = np.array([column.name in unused for column in sensor.kind.columns])
        measured.append(np.where(is_hidden, np.nan, values))
    return replace(trials, measured=tuple(measured))


def measure_held_points(
    layout: Layout, truth: FloatArray, instrument: Instrument, seed: Seed, is_exact: bool = False
) -> Trials:
    """Return the measurements of true machines (t, p) [SI] that are held on planes and lines: each
    moves until its tool is there, so that all gaps are zero and the readings differ.

    instrument : kinds plane and line at the points. The noise of the plane is that of each held
    coordinate. is_exact : whether the points are held without noise.
    """
    n = layout.points
    assigned = Instrument(tuple(sensor.assign_rows(n) for sensor in instrument.sensors))
    (noise,) = {id(s.noise): s.noise for s in assigned.sensors if s.kind.name == "plane"}.values()
    drawn = np.zeros((len(truth), n, 3))
    if not is_exact:
        streams = (make_random_stream(seed, trial) for trial in range(len(truth)))
        drawn = np.stack([noise.draw(stream, 3 * n).reshape(n, 3) for stream in streams])
    state, readings = layout.hold_points(truth, drawn)
    gaps = [(len(truth), len(s.assigned_rows), len(s.noise.sigma)) for s in assigned.sensors]
    labels = tuple(str(i + 1) for i in range(n))
    return Trials(
        assigned,
        layout.robot.name,
        layout.commanded_readings,
        tuple(np.zeros(shape) for shape in gaps),
        truth,
        state.T,
        state.status == Status.CONVERGED,
        collect_nuisance_parameters(assigned.sensors, labels),
        readings,
    )


def check_effects(effects: EffectsLevel) -> None:
    """Raise DataError for effects that held points do not have."""
    plain = EffectsLevel()
    for name in ("drift", "jump", "thermal", "backlash"):
        if getattr(effects, name) != getattr(plain, name):
            raise DataError(
                f"points that are held on planes and lines are simulated without {name}; remove it"
            )


SURFACE_SIGMA = 1e-3
"""Noise for which points on surfaces are planned [m]; it does not change which are best."""


@dataclass(frozen=True, eq=False)
class CellPoses:
    """The poses of all blocks of a cell, and of all cells that have the same ones, as lists of
    controlled coordinates [m, rad].
    """

    measured: list[list[float]]
    held_out: list[list[float]]


def describe_poses(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return everything that determines the poses of a block, from its description.

    Drawn poses depend on the machine only. Planned ones also depend on what is measured, and on the
    tolerances.
    """
    level = convert(content["poses"], PosesLevel)
    description = {key: content[key] for key in ("robot", "poses", "seed")}
    description["held_out"] = convert(content["scores"], Scores).held_out
    if is_planned(level):
        description |= {key: content[key] for key in ("instrument", "noise")}
        stated = content["errors"]  # those settings that change the tolerances
        names = ("tolerance_factor", "tolerances")
        description["errors"] = {name: stated[name] for name in names if name in stated}
    return description


def compute_poses(description: Mapping[str, Any]) -> CellPoses:
    """Return the poses of a description: given ones, drawn from the workspace, or planned."""
    level, seed = convert(description["poses"], PosesLevel), description["seed"]
    robot = build_robot_of(description["robot"])
    held_out = sample_workspace(robot.nominal, description["held_out"], seed + 1).coordinates
    chosen_seed = seed if level.seed is None else level.seed
    stream: int | np.random.Generator = chosen_seed
    if chosen_seed == seed + 1:  # otherwise the measured poses would be the held-out ones
        stream = np.random.default_rng(np.random.SeedSequence(chosen_seed, spawn_key=(0,)))
    if level.coordinates:
        measured = np.array(level.coordinates)
    elif level.is_on_surfaces:
        measured = plan_plane_line_points(robot.nominal, level, stream)
    elif not is_planned(level):
        measured = sample_workspace(robot.nominal, level.count, stream).coordinates
    else:
        errors = convert(description["errors"], ErrorsLevel)
        instrument = make_instrument(
            convert(description["instrument"], InstrumentLevel),
            convert(description["noise"], NoiseLevel),
        )
        options = PlanOptions(n_poses=level.count, hold_out=0, seed=chosen_seed)
        chosen = plan(change_tolerances(robot, errors).nominal, instrument, options=options)
        measured = chosen.poses.coordinates
    return CellPoses(measured.tolist(), held_out.tolist())


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


def make_fit_options(level: MethodLevel) -> FitOptions:
    """Return the options of a fit; without uncertainties, those of published steps."""
    if level.has_steps:
        return FitOptions(LeastSquares())
    stated = {key: getattr(level, key) for key in ("method", "lam", "keep", "loss", "noise")}
    options = FitOptions.from_dict(stated)
    # a method that is stated does not refuse fewer equations than parameters
    return options if options.method else replace(options, method=MAP(InflatedTolerances()))
