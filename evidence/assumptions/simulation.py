# SPDX-License-Identifier: Apache-2.0
"""Simulate the machines and measurements of a case, and the true held-out poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evidence.assumptions.cases import Case, Setup
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import Trials, sample_truth, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.studies.simulation.machines import AlteredNoise
from loopcal.studies.specification import EffectsLevel, Outliers

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SEED, HELD_OUT = 23, 12
"""First seed of all draws; number of held-out poses."""

GROSS = 20.0
"""Distance of an outlier from the truth, in sigma."""

POSE_TIME = 60.0
"""Seconds from one pose to the next."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """Machines with measurements, and their true held-out poses.

    Attributes
    ----------
    trials : of t machines. measurements : of each machine, as a file would state them.
    moved : (t, p free) parameters that the case moves, all for a case that moves none.
    q : (h, a) held-out readings. R, position : (t, h, 3, 3), (t, h, 3) [m] true held-out poses.
    """

    trials: Trials
    measurements: tuple[Measurements, ...]
    moved: BoolArray
    q: Array
    R: Array
    position: Array


def simulate_case(setup: Setup, case: Case, fits: int) -> Simulation:
    """Simulate the machines of a case, their measurements and their held-out poses."""
    robot = load_robot(setup.robot)
    poses = sample_workspace(robot, setup.few if case.is_few else setup.poses, SEED).coordinates
    held_out = sample_workspace(robot, HELD_OUT, SEED + 1).solution.q
    truth, moved = draw_machines(robot, setup, case, fits)
    length, angle = setup.coarse if case.is_coarse else setup.sigma
    kind = Component(setup.columns) if setup.columns else Pose()
    sd = np.array([length] * len(setup.columns) if setup.columns else [angle] * 3 + [length] * 3)
    noise = AlteredNoise(Gaussian(sd), describe_noise(case))
    instrument = Instrument((Sensor(kind, noise),))
    trials = simulate_trials(robot, truth, poses, instrument, SEED)
    T = forward_trials(robot, truth, held_out[None]).T
    axes = len(setup.columns) or 3
    shift, held_out_shift = draw_shifts(robot, case, trials.T, T, axes, length)
    measured = np.array(trials.measured[0])
    measured[..., -axes:] += shift
    trials = replace(trials, measured=(measured,))
    position = np.array(T[..., :3, 3])
    position[..., :axes] += held_out_shift
    data = tuple(state_order(trials.trial(i), case) for i in range(fits))
    return Simulation(trials, data, moved, held_out, T[..., :3, :3], position)


def describe_noise(case: Case) -> EffectsLevel:
    """Return how the noise of a case differs from the stated one."""
    return EffectsLevel(
        noise=case.noise,
        degrees=case.degrees if np.isfinite(case.degrees) else None,
        correlation=case.correlation,
        outliers=Outliers(case.outliers, GROSS) if case.outliers else None,
    )


def draw_machines(robot: Mechanism, setup: Setup, case: Case, fits: int) -> tuple[Array, BoolArray]:
    """Return true values (t, p) [SI] and which free parameters (t, p free) the case moves."""
    nominal, places = robot.parameters.nominal, np.flatnonzero(robot.parameters.free)
    truth = nominal + case.tolerance * (sample_truth(robot, fits, SEED) - nominal)
    tolerance = np.asarray(robot.parameters.tolerance)[places]
    moved = np.zeros((fits, len(places)), dtype=bool)
    rng = np.random.default_rng(SEED)
    if case.single:
        moved[np.arange(fits), rng.integers(len(places), size=fits)] = True
    if case.group:
        names = [robot.parameters.names[i] for i in places]
        moved[:] = [name.endswith(setup.group) for name in names]
    sign = rng.choice([-1.0, 1.0], size=(fits, 1)) if case.single else 1.0
    shifted = nominal[places] + sign * (case.single + case.group) * tolerance
    truth[:, places] = np.where(moved, shifted, truth[:, places])
    return truth, moved if moved.any() else ~moved


def draw_shifts(
    robot: Mechanism, case: Case, T: Array, held_out: Array, axes: int, length: float
) -> tuple[Array, Array]:
    """Return what drift, jump and model error add to measured (t, n, axes) and to true held-out
    positions (t, h, axes) [m]. Drift and jump move the instrument only, and their mean is zero.
    """
    t, n = T.shape[:2]
    rng = np.random.default_rng(SEED + 1)
    direction = rng.standard_normal((t, 1, axes))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    order = np.linspace(-0.5, 0.5, n)[:, None]
    later = (2 * np.arange(n) >= n)[:, None]  # the second session
    moved = length * direction * (case.drift * order + case.jump * (later - later.mean()))
    wave, phase = rng.standard_normal((t, axes, 3)), rng.uniform(0.0, 2.0 * np.pi, (t, 1, axes))
    wave *= np.pi / np.linalg.norm(wave, axis=2, keepdims=True)
    places = T[..., :3, 3]
    low, high = places.min(axis=(0, 1)), places.max(axis=(0, 1))
    half = np.maximum(0.5 * (high - low), 1e-9 * robot.size)

    def add_wave(T: Array) -> Array:
        """Return one period of a sine over the workspace, in a direction of its own for each
        coordinate.
        """
        relative = (T[..., :3, 3] - 0.5 * (low + high)) / half
        angle = np.einsum("tnk,tak->tna", relative, wave) + phase
        return case.smooth * np.sqrt(2.0) * np.sin(angle)

    return moved + add_wave(T), add_wave(held_out)


def state_order(data: Measurements, case: Case) -> Measurements:
    """Return the measurements with the times of the poses and, for a jump, their sessions."""
    (rows,) = data.observations
    n = len(rows.rows)
    session = np.where(2 * np.arange(n) < n, "s1", "s2") if case.jump else rows.session
    timed = replace(rows, session=session, context={"time": POSE_TIME * np.arange(n)})
    return replace(data, observations=(timed,))
