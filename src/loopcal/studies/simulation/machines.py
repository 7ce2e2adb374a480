# SPDX-License-Identifier: Apache-2.0
"""What the blocks of a cell compute with: robot, tolerances, true machines, instrument, poses,
effects and method; a process prepares them once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import convert

from loopcal.apply.simulated_measurements import InstrumentDescription, build_instrument
from loopcal.checks import check_choice
from loopcal.diagnose.error_frames import BASE, choose_error_frame, list_unfixed_motions
from loopcal.errors import DataError, FileError, UnitError
from loopcal.estimate.identification import compute_trial_posterior, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.tolerance_components import InflatedTolerances
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.robot.robot_file import build_robot
from loopcal.measure.instrument import Instrument, Noise, Seed, Uniform, make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.readings import solve_commanded_poses
from loopcal.measure.simulation import Disturbance, Trials, sample_truth, simulate_trials
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import list_tilt_rings, sample_workspace
from loopcal.parameters import ParameterTable, match_names
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.plane_line_planning import (
    PlaneLineGroups,
    find_line_axes,
    improve_groups,
    make_plane_line_instrument,
)
from loopcal.planning.pose_planning import plan
from loopcal.studies.simulation.published_steps import Layout
from loopcal.studies.specification import (
    Backlash,
    CellContent,
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    ThermalGrowth,
    describe_record,
    format_json,
)
from loopcal.typing import FloatArray
from loopcal.units import Dimension, parse_quantity

# Robots that a process keeps; building one takes as long as fitting a few of its machines.
KEPT_ROBOTS = 8


@lru_cache(maxsize=KEPT_ROBOTS)
def build_robot_of(text: str) -> Mechanism:
    """Return the robot of the text of a robot file; DataError where it is none."""
    try:
        return build_robot(parse_yaml(text, Path("robot"), "robot file"))
    except FileError as error:
        where = f"line {error.line or 1} of a robot of the study"
        raise DataError(f"{where}: {error.sentence}") from error


def change_tolerances(robot: Mechanism, errors: ErrorsLevel) -> Mechanism:
    """Return a robot with the spreads of a level, which the fit knows.

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
    """Return true parameter values (t, p) [SI]; `robot` has the spreads of the level."""
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
        for entry in (table.entries[table.index(n)] for n in match_names(table.names, pattern)):
            try:
                resolved[entry.name] = parse_quantity(text, entry.dimension)
            except UnitError as error:
                raise DataError(f"{pattern!r} of {entry.name}: {error}") from None
    return resolved


SURFACES = {"plane", "line"}  # kinds of an instrument for points of planes and perpendicular lines


def make_instrument(level: InstrumentLevel, noise: NoiseLevel) -> Instrument:
    """Return the instrument of a level, with its sigmas times the factor of the noise.

    Raises DataError: as `build_instrument`, or an unused column that it does not measure.
    """
    names = [item.name for item in fields(InstrumentDescription) if hasattr(level, item.name)]
    described = {name: getattr(level, name) for name in names}
    for name in ("sigma_position", "sigma_angle"):
        described[name] *= noise.factor
    instrument = build_instrument(InstrumentDescription(**described))
    known = [column.name for sensor in instrument.sensors for column in sensor.kind.columns]
    for name in level.unused:
        check_choice("an unused column", name, known, DataError)
    if set(level.unused) >= set(known):
        raise DataError("the study uses no measured column. Leave at least one")
    return instrument


def check_surfaces(instrument: Instrument) -> None:
    """Raise DataError where an instrument does not touch planes and lines."""
    kinds = [sensor.kind.name for sensor in instrument.sensors]
    if set(kinds) != SURFACES:
        raise DataError(
            "points on planes and lines need an instrument of the kinds plane and line, not "
            f"{', '.join(kinds)}. Write 'kinds: [plane, line]'"
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
    drawn: FloatArray | float = 0.0
    if not is_exact:
        streams = (make_random_stream(seed, trial) for trial in range(len(truth)))
        drawn = np.stack([noise.draw(stream, 3 * n).reshape(n, 3) for stream in streams])
    state, readings = layout.hold_points(truth, drawn)
    gaps = [(len(truth), len(s.assigned_rows), len(s.noise.sigma)) for s in assigned.sensors]
    labels = tuple(str(i + 1) for i in range(n))
    return Trials(
        assigned,
        layout.robot.name,
        compute_readings(layout.robot, layout.robot.parameters.nominal[None], layout.state)[0],
        tuple(np.zeros(shape) for shape in gaps),
        truth,
        state.T,
        state.status == Status.CONVERGED,
        collect_nuisance_parameters(assigned.sensors, labels),
        readings,
    )


def check_effects(effects: EffectsLevel) -> None:
    """Raise DataError for effects that held points do not have."""
    for name in ("drift", "jump", "thermal", "backlash"):
        if name in describe_record(effects):
            raise DataError(
                f"a simulation of points on planes and lines takes no {name}. Remove it"
            )


# Noise for which points on surfaces are planned [m]; it does not change which are best.
SURFACE_SIGMA = 1e-3


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
    spreads.
    """
    given = convert(content, CellContent)
    description = {key: content[key] for key in ("robot", "poses", "seed")}
    description["scores"] = {"held_out": given.scores.held_out}
    if is_planned(given.poses):
        description |= {key: content[key] for key in ("instrument", "noise")}
        stated = content["errors"]  # those settings that change the spreads
        names = ("tolerance_factor", "tolerances")
        description["errors"] = {name: stated[name] for name in names if name in stated}
    return description


def compute_poses(description: Mapping[str, Any]) -> CellPoses:
    """Return the poses of a description: given ones, drawn from the workspace, or planned."""
    content = convert(description, CellContent)
    level, seed, robot = content.poses, content.seed, build_robot_of(content.robot)
    held_out = sample_workspace(robot.nominal, content.scores.held_out, seed + 1).coordinates
    chosen_seed = seed if level.seed is None else level.seed
    stream: int | np.random.Generator = chosen_seed
    if chosen_seed == seed + 1:  # otherwise the measured poses would be the held-out ones
        stream = np.random.default_rng(np.random.SeedSequence(chosen_seed, spawn_key=(0,)))
    if level.coordinates:
        measured = np.array(level.coordinates)
    elif level.is_on_surfaces:
        # cells that differ in spreads, noise or method have the same points
        groups = make_groups(robot.nominal, level)
        is_complete = level.count - 2 * level.groups >= len(groups.free)
        drawn = groups.draw(level.groups, stream)
        design = improve_groups(groups, drawn, level.sweeps, is_complete).design
        measured = groups.place_points(design).reshape(level.count, -1)
    elif level.choice == "tilts":
        measured = list_tilt_rings(robot.nominal, level.count)
    elif not is_planned(level):
        measured = sample_workspace(robot.nominal, level.count, stream).coordinates
    else:
        instrument = make_instrument(content.instrument, content.noise)
        options = PlanOptions(n_poses=level.count, hold_out=0, seed=chosen_seed)
        nominal = change_tolerances(robot, content.errors).nominal
        measured = plan(nominal, instrument, options=options).poses.coordinates
    return CellPoses(measured.tolist(), held_out.tolist())


def make_groups(robot: Mechanism, level: PosesLevel) -> PlaneLineGroups:
    """Return the groups of points on planes and lines of a level; EstimationError for a robot that
    does not follow them.
    """
    return PlaneLineGroups(robot, level.count // level.groups, SURFACE_SIGMA, (level.axis,))


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


# Purpose of the random stream of a trial from which the direction of drift and jump is drawn.
EFFECTS = 3


@dataclass(frozen=True, eq=False)
class AlteredNoise(Noise):
    """Noise whose true distribution, by the effects, differs from that which the fit is told."""

    stated: Noise
    effects: EffectsLevel

    @property
    def sigma(self) -> FloatArray:
        """Stated standard deviations (m,) [SI]."""
        return self.stated.sigma

    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return noise of n rows in the order of their measurement, (n, m) [SI].

        Student's t noise has the stated variance. Correlated noise is autoregressive: each row
        takes the stated share of the row before, and the variance stays the same.
        """
        effects, shape = self.effects, (n, len(self.sigma))
        if isinstance(self.stated, Uniform):
            noise = generator.uniform(-1.0, 1.0, shape) * np.sqrt(3.0)
        else:
            noise = generator.standard_normal(shape)
        if effects.degrees is not None:
            scale = np.sqrt((effects.degrees - 2.0) / effects.degrees)
            noise = scale * generator.standard_t(effects.degrees, shape)
        if effects.correlation:
            share = np.sqrt(1.0 - effects.correlation**2)
            for i in range(1, n):
                noise[i] = effects.correlation * noise[i - 1] + share * noise[i]
        if effects.outliers is not None:
            count = effects.outliers.share * n
            wrong = generator.permutation(n)[: round(count) or int(generator.random() < count)]
            direction = generator.standard_normal((len(wrong), shape[1]))
            length = np.linalg.norm(direction, axis=1, keepdims=True)
            noise[wrong] += effects.outliers.size * direction / length
        return effects.noise * noise * self.sigma


def alter_noise(instrument: Instrument, effects: EffectsLevel) -> Instrument:
    """Return an instrument whose true noise is that of the effects; its stated one is the same."""
    if describe_record(effects).keys().isdisjoint(("noise", "degrees", "correlation", "outliers")):
        return instrument
    sensors = tuple(
        replace(sensor, noise=AlteredNoise(sensor.noise, effects)) for sensor in instrument.sensors
    )
    return replace(instrument, sensors=sensors)


def make_disturbance(
    robot: Mechanism, truth: FloatArray, poses: FloatArray, effects: EffectsLevel, seed: Seed
) -> Disturbance:
    """Return what the effects do to true machines (t, p) [SI] while they are measured at commanded
    coordinates (n, c), in this order; robot : nominal.
    """
    n = len(poses)
    return Disturbance(
        None if effects.thermal is None else grow_lengths(robot, truth, n, effects.thermal),
        None if effects.backlash is None else lag_readings(robot, poses, effects.backlash),
        draw_motion(effects, len(truth), n, seed) if effects.drift or effects.jump else None,
    )


def grow_lengths(robot: Mechanism, truth: FloatArray, n: int, thermal: ThermalGrowth) -> FloatArray:
    """Return what thermal growth adds to the true values at each of n poses, (t, n, p) [SI]: all
    lengths of the machine grow in proportion, also those that are not identified.
    """
    is_length = np.array([d is Dimension.LENGTH for d in robot.parameters.dimensions])
    growth = thermal.expansion * thermal.rise * np.linspace(-0.5, 0.5, n)
    return growth[:, None] * np.where(is_length, truth, 0.0)[:, None, :]


def lag_readings(robot: Mechanism, poses: FloatArray, backlash: Backlash) -> FloatArray:
    """Return true joint values minus readings (1, n, a) [SI] of poses that are approached one after
    the other, the first from home: minus half of the play in the direction of motion.
    """
    commanded = solve_commanded_poses(robot, poses).q
    home = compute_readings(robot, robot.values[None], robot.home_state)[0]
    direction = np.sign(np.diff(np.concatenate([home, commanded]), axis=0))
    by_dimension = {Dimension.LENGTH: backlash.length, Dimension.ANGLE: backlash.angle}
    play = np.array([by_dimension[actuator.dimension] for actuator in robot.actuators])
    return -0.5 * (play * direction)[None]


def draw_motion(effects: EffectsLevel, trials: int, n: int, seed: Seed) -> FloatArray:
    """Return the displacement of what is measured (t, n, 3) [m] by drift and jump: in a random
    direction of each trial, and zero in the mean over the poses.
    """
    streams = (make_random_stream(seed, trial, EFFECTS) for trial in range(trials))
    direction = np.array([stream.standard_normal(3) for stream in streams])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    later = 2 * np.arange(n) >= n
    size = effects.drift * np.linspace(-0.5, 0.5, n) + effects.jump * (later - later.mean())
    return size[:, None] * direction[:, None, :]


@dataclass(frozen=True, eq=False)
class PreparedCell:
    """What the blocks of a cell compute with.

    content : of its tasks. robot : nominal, with the spreads of the cell.
    instrument : with its true noise. fit_options : of the cell.
    layout : points that are held on planes and lines; None for other poses.
    measured : (n, c) controlled coordinates of the measured poses.
    held_out : solution of the nominal robot at the held-out poses.
    motions : (12, k) motions of the base and platform frames that are fitted before errors are
        stated: in the frame "fitted" those that the measurements do not determine.
    reference : solution of the nominal robot at the poses over which these are fitted: the measured
        ones, or none where there is no such motion.
    """

    content: CellContent
    robot: Mechanism
    instrument: Instrument
    layout: Layout | None
    fit_options: FitOptions
    measured: FloatArray
    held_out: Solution
    motions: FloatArray
    reference: Solution

    def hold_out(self, data: Measurements) -> Measurements:
        """Return measurements in which the poses behind the measured ones are held out."""
        return replace(data, is_held_out=np.arange(data.n_poses) >= len(self.measured))


def prepare_cell(content: Mapping[str, Any]) -> PreparedCell:
    """Return the cell of the content of a task; the latest ones are kept, and serve all methods."""
    given, cell = convert(content, CellContent), _prepare(format_json(share_content(content)))
    return replace(cell, content=given, fit_options=make_fit_options(given.method))


def share_content(content: Mapping[str, Any], *more: str) -> dict[str, Any]:
    """Return the part of the content of a task that cells with other methods have in common, and
    its blocks; more : further keys to keep.
    """
    return {key: x for key, x in content.items() if key not in {"block", "method"} - {*more}}


@lru_cache(maxsize=4)
def _prepare(text: str) -> PreparedCell:
    """Return the cell of `share_content`, as JSON."""
    content = msgspec.json.decode(text, type=CellContent)
    robot = change_tolerances(build_robot_of(content.robot), content.errors).nominal
    measured, poses = np.array(content.measured), content.poses
    instrument = make_instrument(content.instrument, content.noise)
    layout = None
    if poses.is_on_surfaces:
        check_surfaces(instrument)
        noise = {sensor.kind.name: sensor.noise for sensor in instrument.sensors}
        axis = find_line_axes(robot, measured, poses.groups)
        points = np.arange(len(measured)).reshape(poses.groups, -1)
        instrument = make_plane_line_instrument(robot, axis, points, lambda name, _: noise[name])
        layout = Layout(robot, measured.reshape(poses.groups, -1, measured.shape[1]))
    motions = np.zeros((12, 0))
    if content.scores.error_frame != BASE:
        nominal = robot.values[None]
        if layout is None:
            exact = simulate_trials(robot, nominal, measured, instrument, 0)
            exact = hide_columns(exact, content.instrument.unused)
        else:
            check_effects(content.effects)
            exact = measure_held_points(layout, nominal, instrument, 0, is_exact=True)
            exact = replace(exact, recorded=None)
        # those that measurements of the nominal robot do not determine, if a parameter moves them
        posterior = compute_trial_posterior(identify_trials(robot, exact, MAP()), exact, 0)
        if choose_error_frame(posterior).fitted:
            motions = list_unfixed_motions(posterior)
    commanded = solve_commanded_poses(robot, measured)
    return PreparedCell(
        content,
        robot,
        alter_noise(instrument, content.effects),
        layout,
        make_fit_options(content.method),
        measured,
        inverse(robot, content.held_out),
        motions,
        commanded if motions.shape[1] else commanded.take(np.arange(0)),
    )
