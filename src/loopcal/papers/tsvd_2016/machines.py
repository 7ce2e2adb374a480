# SPDX-License-Identifier: Apache-2.0
"""The given machines, their errors, the poses to measure, the noise and the output range.

Dimensions, poses, true errors and output range are ours: the paper's Tables 1 to 4 are not in our
text. The noise is the paper's (Appendix 1). Poses are x, y, z, phi, theta, psi with tilt and
torsion, as in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.engine import State
from loopcal.estimate.published_steps import RawProblem, make_raw_problem
from loopcal.measure.instrument import Instrument, Noise, Sensor, Uniform, make_random_stream
from loopcal.measure.kinds.poses import Component
from loopcal.measure.simulation import Trials, simulate_trials
from loopcal.mechanism.kinematics import compute_readings, forward_trials, inverse_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.papers.tsvd_2016.published import MM, read_published
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

ROBOTS = {"RU-PUS-PRS": "ru-pus-prs", "3-PRS": "3-prs"}
"""Names in the paper, and of our robot files."""

COLUMNS = ("x", "y", "z", "phi", "theta", "psi")
LENGTH_ERRORS, ANGLE_ERRORS = (0.05e-3, 0.1e-3), (2.5e-4, 5e-4)
"""Least and largest size of true errors [m], [rad]; the sign is drawn."""

TILTS, AZIMUTHS = (10.0, 20.0, 30.0), 12
EVALUATED_TILTS = (5.0, 15.0, 25.0, 35.0)
EVALUATED = 96
HEIGHTS = (0.65, 0.7, 0.75)
"""Of measured poses and output range [m], if z is free."""
LIMITS = np.array([0.01e-3] * 3 + [np.deg2rad(0.01)] * 3)
"""Limits of the noise [m, rad], as Appendix 1 shows."""
MEASURES = (
    "position [mm]",
    "phi and theta [deg]",
    "direction of the normal [deg]",
    "parameters [tolerances]",
    "parameters farther from the truth than nominal [share]",
)
COMMANDED = ("position after commanding [mm]", "phi and theta after commanding [deg]")
ERRORS = 3  # purpose of a random stream


class AppendixNoise(Noise):
    """The 36 measurement errors that the paper prints, the same in every drawing."""

    def __init__(self, columns: int = 6) -> None:
        self.columns = columns

    @property
    def sigma(self) -> FloatArray:
        """Return that of uniform noise between the limits."""
        return LIMITS[: self.columns] / np.sqrt(3.0)

    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """Return the printed errors (36, m) [SI]; nothing is drawn."""
        del generator
        return read_published().noise_si[:n, : self.columns]


@dataclass(frozen=True, eq=False)
class Study:
    """t machines of one structure, measured.

    Attributes
    ----------
    name : of the structure in the paper. robot : as designed.
    trials : true machines and their measurements.
    """

    name: str
    robot: Mechanism
    trials: Trials

    @property
    def kind(self) -> Component:
        """The measurement kind."""
        kind = self.trials.instrument.sensors[0].kind
        assert isinstance(kind, Component)
        return kind

    @property
    def freedoms(self) -> int:
        """Measured coordinates of a pose, 6 or 5."""
        return len(self.kind.components)

    @cached_property
    def five(self) -> Study:
        """The same measurements without psi."""
        return replace(self, trials=_without_psi(self.trials))

    @property
    def exact(self) -> Study:
        """The same measurements without noise."""
        T = self.trials.T
        measured = self.kind.measure(T, np.zeros((*T.shape[:2], self.freedoms)))
        return replace(self, trials=replace(self.trials, measured=(measured,)))

    @cached_property
    def raw(self) -> RawProblem:
        """The measurements as the paper weights them."""
        return make_raw_problem(self.robot, self.trials)

    @cached_property
    def commanded(self) -> State:
        """States of the machine as designed at the readings, (1, 36): starts of corrected ones."""
        return forward_trials(
            self.robot, self.robot.parameters.nominal[None], self.trials.readings[None]
        )

    @cached_property
    def grid(self) -> Solution:
        """The output range: 96 poses, commanded with the machine as designed."""
        return inverse(self.robot, list_output_range(self.robot))

    @cached_property
    def true_outputs(self) -> FloatArray:
        """(t, 96, 4, 4) poses of the true machines, commanded to the output range."""
        return self._outputs(self.trials.truth)

    def _outputs(self, values: FloatArray) -> FloatArray:
        return forward_trials(self.robot, values, self.grid.q[None], self.grid.state).T

    def compute_output_errors(
        self, values: FloatArray, machine: IntArray | None = None
    ) -> FloatArray:
        """Return errors of poses over the output range, at equal readings, and of parameters.

        Parameters
        ----------
        values : (a, p) identified [SI]; NaN rows give NaN. machine : (a,) of which machine;
            default: one row each.

        Returns
        -------
        errors : (a, 5) root mean squares, and a share, see MEASURES. psi counts in none of them:
            the paper considers it unnecessary.
        """
        is_finite = np.isfinite(values).all(axis=1, keepdims=True)
        machine = np.arange(len(values)) if machine is None else machine
        T = self._outputs(np.where(is_finite, values, self.robot.values))
        truth, nominal = self.trials.truth[machine], self.robot.parameters.nominal
        parameters = ((values - truth) / self.robot.parameters.tolerance) ** 2
        worse = np.abs(values - truth) > np.abs(nominal - truth)
        errors = np.column_stack(
            [
                _compare_poses(T, self.true_outputs[machine]),
                np.sqrt(parameters.mean(axis=1)),
                worse.mean(axis=1),
            ]
        )
        return np.where(is_finite, errors, np.nan)

    def compute_commanded_errors(
        self, values: FloatArray, machine: IntArray | None = None
    ) -> FloatArray:
        """Return errors of the true machines, commanded to the output range with identified values.

        The readings come from the inverse kinematics of the identified machine; the true machine
        takes its pose at them; the error is relative to the pose of the machine as designed.
        Coordinates without an actuator keep their errors, even with the true values.

        Parameters
        ----------
        values, machine : as for `compute_output_errors`.

        Returns
        -------
        errors : (a, 2) root mean squares, see COMMANDED.
        """
        is_finite = np.isfinite(values).all(axis=1, keepdims=True)
        machine = np.arange(len(values)) if machine is None else machine
        known = np.where(is_finite, values, self.robot.values)
        target = list_output_range(self.robot)[None]
        state = inverse_trials(self.robot, known, target, self.grid.state)
        q = compute_readings(self.robot, known, state)
        T = forward_trials(self.robot, self.trials.truth[machine], q, self.grid.state).T
        return np.where(is_finite, _compare_poses(T, self.grid.T[None])[:, :2], np.nan)


def _compare_poses(T: FloatArray, reference: FloatArray) -> FloatArray:
    """Return rms differences (a, 3) of poses (a, n, 4, 4): the first three MEASURES."""
    position = np.sum((T[..., :3, 3] - reference[..., :3, 3]) ** 2, axis=-1) / MM**2
    first, second = (geometry.matrix_to_tilt_torsion(x[..., :3, :3]) for x in (T, reference))
    angles = sum(
        np.rad2deg(geometry.wrap_angle(a - b)) ** 2
        for a, b in zip(first[:2], second[:2], strict=True)
    )
    normal = np.rad2deg(1.0) ** 2 * np.sum((T[..., :3, 2] - reference[..., :3, 2]) ** 2, axis=-1)
    return np.sqrt(np.stack([np.mean(x, axis=1) for x in (position, angles, normal)], axis=1))


def measure_machines(
    name: str, truth: FloatArray, noise: Noise | None = None, seed: int = 0
) -> Study:
    """Measure 36 poses of true machines in six coordinates: steps 3 and 4.

    Parameters
    ----------
    name : one of ROBOTS. truth : (t, p) [SI]. noise : default drawn within +-0.01 mm and +-0.01
        deg. seed : of the noise.
    """
    robot = load_machine(name)
    instrument = Instrument(
        (Sensor(Component(COLUMNS, "tilt-torsion"), Uniform(LIMITS) if noise is None else noise),)
    )
    return Study(
        name, robot, simulate_trials(robot, truth, list_measured_poses(robot), instrument, seed)
    )


def load_machine(name: str) -> Mechanism:
    """Return the machine as designed, from the shipped robot file: step 1."""
    from loopcal.io.robot.robot_file import load_robot

    return load_robot(ROBOTS[name])


def list_measured_poses(robot: Mechanism) -> FloatArray:
    """Return controlled coordinates (36, c) [m, rad]: 12 azimuths at each of TILTS.

    Free z takes the three heights in turn.
    """
    phi, theta = (g.ravel() for g in np.meshgrid(np.arange(AZIMUTHS) * 360.0 / AZIMUTHS, TILTS))
    i = np.arange(len(phi))
    return _coordinates(robot, phi, theta, np.array(HEIGHTS)[(i // AZIMUTHS + i) % 3])


def list_output_range(robot: Mechanism) -> FloatArray:
    """Return controlled coordinates (96, c) [m, rad]: tilts of 5 to 35 degrees, more azimuths."""
    heights = HEIGHTS if "z" in robot.controlled else (0.0,)
    count = EVALUATED // (len(EVALUATED_TILTS) * len(heights))
    phi, theta, z = np.meshgrid(np.arange(count) * 360.0 / count, EVALUATED_TILTS, heights)
    return _coordinates(robot, phi.ravel(), theta.ravel(), z.ravel())


def draw_true_values(robot: Mechanism, trials: int, seed: int) -> FloatArray:
    """Return nominal values (t, p) [SI] with errors of drawn size and sign.

    Machine i is the same for any number of machines.
    """
    table = robot.parameters
    low, high = np.array(
        [LENGTH_ERRORS if d is Dimension.LENGTH else ANGLE_ERRORS for d in table.dimensions]
    ).T
    values = []
    for trial in range(trials):
        drawn = make_random_stream(seed, trial, ERRORS)
        size, sign = drawn.uniform(low, high), drawn.choice([-1.0, 1.0], len(table))
        values.append(table.nominal + sign * size)
    return np.array(values)


def _coordinates(robot: Mechanism, phi: FloatArray, theta: FloatArray, z: FloatArray) -> FloatArray:
    given = {"phi": geometry.wrap_angle(np.deg2rad(phi)), "theta": np.deg2rad(theta), "z": z}
    return np.column_stack([given[name] for name in robot.controlled])


def _without_psi(trials: Trials) -> Trials:
    sensor = trials.instrument.sensors[0]
    kind = sensor.kind
    assert isinstance(kind, Component)
    noise = AppendixNoise(5) if isinstance(sensor.noise, AppendixNoise) else Uniform(LIMITS[:5])
    five = replace(kind, components=kind.components[:5])
    instrument = Instrument((Sensor(five, noise, sensor.rows, sensor.session, sensor.group),))
    return replace(trials, instrument=instrument, measured=(trials.measured[0][..., :5],))
