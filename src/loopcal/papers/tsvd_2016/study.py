# SPDX-License-Identifier: Apache-2.0
"""What is given: machines, poses to measure, errors to find, noise, and the range over which output
errors are taken.

Dimensions, poses, true errors and output range are ours: the paper's Tables 1 to 4 are not in our
text. Its noise is (Appendix 1). Poses are written as the paper does, x, y, z, phi, theta, psi with
tilt and torsion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.engine import State
from loopcal.measure import (
    Component,
    Instrument,
    Noise,
    Sensor,
    Trials,
    Uniform,
    make_random_stream,
    simulate_trials,
)
from loopcal.mechanism import Mechanism, Solution, forward_trials, inverse
from loopcal.papers.tsvd_2016.published import MM, published
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
"""Of measured poses and output range [m], where z is free."""
LIMITS = np.array([0.01e-3] * 3 + [np.deg2rad(0.01)] * 3)
"""Of the noise [m, rad], as Appendix 1 shows."""
MEASURES = (
    "position [mm]",
    "phi and theta [deg]",
    "direction of the normal [deg]",
    "parameters [tolerances]",
)
ERRORS = 3  # purpose of a random stream


class AppendixNoise(Noise):
    """The 36 measurement errors that the paper prints, the same in every drawing."""

    def __init__(self, columns: int = 6) -> None:
        self.columns = columns

    @property
    def sigma(self) -> FloatArray:
        """Of uniform noise between the limits."""
        return LIMITS[: self.columns] / np.sqrt(3.0)

    def draw(self, generator: np.random.Generator, n: int) -> FloatArray:
        """(36, m) [SI]; nothing is drawn."""
        del generator
        return published().noise_si[:n, : self.columns]


@dataclass(frozen=True, eq=False)
class Study:
    """t machines of one structure, measured.

    Attributes
    ----------
    name : of the structure in the paper. robot : as designed. trials : true machines and what was
        measured of them.
    """

    name: str
    robot: Mechanism
    trials: Trials

    @property
    def kind(self) -> Component:
        """What is measured of a pose."""
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

    @cached_property
    def commanded(self) -> State:
        """Where the machine as designed stands at the readings, (1, 36): from there corrected
        machines are solved.
        """
        return forward_trials(
            self.robot, self.robot.parameters.nominal[None], self.trials.readings[None]
        )

    @cached_property
    def grid(self) -> Solution:
        """The output range: 96 poses, as the machine as designed is commanded to them."""
        return inverse(self.robot, output_range(self.robot))

    @cached_property
    def true_outputs(self) -> FloatArray:
        """(t, 96, 4, 4) where the true machines are when commanded to the output range."""
        return self._outputs(self.trials.truth)

    def _outputs(self, values: FloatArray) -> FloatArray:
        return forward_trials(self.robot, values, self.grid.q[None], self.grid.state).T

    def output_errors(self, values: FloatArray, machine: IntArray | None = None) -> FloatArray:
        """Differences of predicted from true poses over the output range at equal readings, and of
        the parameters.

        Parameters
        ----------
        values : (a, p) identified [SI]; NaN rows give NaN. machine : (a,) of which machine;
            default: one row each.

        Returns
        -------
        errors : (a, 4) root mean squares, see MEASURES. psi counts in none of them: the paper holds
            it unnecessary.
        """
        found = np.isfinite(values).all(axis=1, keepdims=True)
        machine = np.arange(len(values)) if machine is None else machine
        T, true = (
            self._outputs(np.where(found, values, self.robot.values)),
            self.true_outputs[machine],
        )
        position = np.sum((T[..., :3, 3] - true[..., :3, 3]) ** 2, axis=-1) / MM**2
        first, second = (geometry.matrix_to_tilt_torsion(x[..., :3, :3]) for x in (T, true))
        angles = sum(
            np.rad2deg(geometry.wrap_angle(a - b)) ** 2
            for a, b in zip(first[:2], second[:2], strict=True)
        )
        normal = np.rad2deg(1.0) ** 2 * np.sum((T[..., :3, 2] - true[..., :3, 2]) ** 2, axis=-1)
        parameters = ((values - self.trials.truth[machine]) / self.robot.parameters.tolerance) ** 2
        squares = [
            np.asarray(square).mean(axis=1) for square in (position, angles, normal, parameters)
        ]
        return np.where(found, np.sqrt(np.stack(squares, axis=1)), np.nan)


def study(name: str, truth: FloatArray, noise: Noise | None = None, seed: int = 0) -> Study:
    """Steps 3 and 4: measure 36 poses of true machines in six coordinates.

    Parameters
    ----------
    name : one of ROBOTS. truth : (t, p) [SI]. noise : default drawn within +-0.01 mm and +-0.01
        deg. seed : of the noise.
    """
    robot = machine(name)
    instrument = Instrument(
        (Sensor(Component(COLUMNS, "tilt-torsion"), Uniform(LIMITS) if noise is None else noise),)
    )
    return Study(
        name, robot, simulate_trials(robot, truth, measured_poses(robot), instrument, seed)
    )


def machine(name: str) -> Mechanism:
    """Step 1: the machine as designed, from the robot file that is shipped."""
    from loopcal.io import load_robot

    return load_robot(ROBOTS[name])


def measured_poses(robot: Mechanism) -> FloatArray:
    """(36, c) controlled coordinates [m, rad]: 12 azimuths at tilts of 10, 20 and 30 degrees; z in
    turn where it is free.
    """
    phi, theta = (g.ravel() for g in np.meshgrid(np.arange(AZIMUTHS) * 360.0 / AZIMUTHS, TILTS))
    i = np.arange(len(phi))
    return _coordinates(robot, phi, theta, np.array(HEIGHTS)[(i // AZIMUTHS + i) % 3])


def output_range(robot: Mechanism) -> FloatArray:
    """(96, c) controlled coordinates [m, rad]: tilts of 5 to 35 degrees at azimuths between the
    measured ones too.
    """
    heights = HEIGHTS if "z" in robot.controlled else (0.0,)
    count = EVALUATED // (len(EVALUATED_TILTS) * len(heights))
    phi, theta, z = np.meshgrid(np.arange(count) * 360.0 / count, EVALUATED_TILTS, heights)
    return _coordinates(robot, phi.ravel(), theta.ravel(), z.ravel())


def true_values(robot: Mechanism, trials: int, seed: int) -> FloatArray:
    """(t, p) [SI] nominal values with errors of a drawn size and sign; machine i is the same
    however many there are.
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
