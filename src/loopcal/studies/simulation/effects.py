# SPDX-License-Identifier: Apache-2.0
"""Effects that a fit does not know of: altered noise, and disturbed machines and instruments."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.measure import (
    Disturbance,
    Instrument,
    Noise,
    Seed,
    Uniform,
    make_random_stream,
    solve_commanded_poses,
)
from loopcal.mechanism import Mechanism, compute_readings
from loopcal.studies.specification.levels import Backlash, EffectsLevel, ThermalGrowth
from loopcal.typing import FloatArray
from loopcal.units import Dimension

EFFECTS = 3
"""Purpose of the random stream of a trial from which the direction of drift and jump is drawn."""


@dataclass(frozen=True, eq=False)
class AlteredNoise(Noise):
    """Noise whose true distribution differs from the stated one.

    Parameters
    ----------
    stated : what the fit is told. effects : noise factor, Student's t, correlation and outliers.
    """

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
    """Return what the effects do to t machines while they are measured.

    Parameters
    ----------
    robot : nominal. truth : (t, p) [SI]. poses : (n, c) commanded coordinates, in their order.
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
