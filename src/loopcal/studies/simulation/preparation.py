# SPDX-License-Identifier: Apache-2.0
"""What all blocks of a cell have in common, which a process prepares once."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from msgspec import convert

from loopcal.diagnose.error_frames import BASE, choose_error_frame, list_unfixed_motions
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP
from loopcal.estimate.plane_line_products import Layout
from loopcal.estimate.trial_identification import compute_trial_posterior, identify_trials
from loopcal.measure.instrument import Instrument, Noise, Seed, Uniform, make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import solve_commanded_poses
from loopcal.measure.simulation import Disturbance, simulate_trials
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.studies.simulation.machines import (
    build_robot_of,
    change_tolerances,
    check_effects,
    hide_columns,
    make_fit_options,
    make_instrument,
    measure_held_points,
    place_instrument,
)
from loopcal.studies.specification.levels import (
    Backlash,
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    Scores,
    ThermalGrowth,
)
from loopcal.studies.specification.study import format_json
from loopcal.typing import FloatArray
from loopcal.units import Dimension

EFFECTS = 3
"""Purpose of the random stream of a trial from which the direction of drift and jump is drawn."""


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
    plain = EffectsLevel()
    names = ("noise", "degrees", "correlation", "outliers")
    if all(getattr(effects, name) == getattr(plain, name) for name in names):
        return instrument
    sensors = tuple(
        replace(sensor, noise=AlteredNoise(sensor.noise, effects)) for sensor in instrument.sensors
    )
    return Instrument(sensors)


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
    """Return the cell of the content of a task; the latest ones are kept."""
    return _prepare(format_json({key: x for key, x in content.items() if key != "block"}))


@lru_cache(maxsize=4)
def _prepare(text: str) -> PreparedCell:
    """Return the cell of the common content of its blocks, as JSON."""
    content = json.loads(text)
    errors = convert(content["errors"], ErrorsLevel)
    robot = change_tolerances(build_robot_of(content["robot"]), errors).nominal
    noise = convert(content["noise"], NoiseLevel)
    level = convert(content["instrument"], InstrumentLevel)
    measured = np.array(content["measured"])
    poses = convert(content["poses"], PosesLevel)
    instrument = place_instrument(make_instrument(level, noise), robot, poses, measured)
    method = convert(content["method"], MethodLevel)
    effects = convert(content["effects"], EffectsLevel)
    scores = convert(content["scores"], Scores)
    layout = None
    if poses.is_on_surfaces:
        layout = Layout(robot, measured.reshape(poses.groups, -1, measured.shape[1]))
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
        # those that measurements of the nominal robot do not determine, if a parameter moves them
        posterior = compute_trial_posterior(identify_trials(robot, exact, MAP()), exact, 0)
        if choose_error_frame(posterior).fitted:
            motions = list_unfixed_motions(posterior)
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
