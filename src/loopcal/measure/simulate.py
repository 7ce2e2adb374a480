# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements: a true machine is commanded by a controller that believes in another geometry, and looked at.

Commanded poses become readings by the controller's inverse kinematics, readings become true poses by the true machine's
forward kinematics, and the instrument writes down what it sees of them, noise included.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.errors import DataError
from loopcal.measure.commanded import solve_commanded
from loopcal.measure.instrument import Instrument
from loopcal.measure.measurements import Measurements
from loopcal.measure.noise import stream
from loopcal.measure.observations import Observations
from loopcal.mechanism import Mechanism, Status
from loopcal.mechanism.trials import forward_trials

Array = NDArray[np.float64]

NOISE, TRUTH = 0, 1  # purposes of a trial's random streams


@dataclass(frozen=True, eq=False)
class Trials:
    """The same measurements made on t machines, as stacked arrays.

    Attributes
    ----------
    instrument : Instrument
        Mounted on the robot's tool.
    robot_name : str
    readings : (n, a) [SI]
        The controller's, equal in all trials.
    measured : tuple of (t, n, c) [SI]
        Columns of each sensor; NaN in rows whose true machine cannot follow the readings.
    truth : (t, p) [SI]
        True parameter values of each trial.
    T : (t, n, 4, 4)
        True T_base_platform.
    """

    instrument: Instrument
    robot_name: str
    readings: Array
    measured: tuple[Array, ...]
    truth: Array
    T: Array

    def __len__(self) -> int:
        return len(self.truth)

    def trial(self, i: int) -> Measurements:
        """Measurements of one trial."""
        rows = np.arange(len(self.readings))
        observations = tuple(
            Observations.from_sigma(sensor.kind, rows, measured[i], sensor.noise.sigma)
            for sensor, measured in zip(self.instrument.sensors, self.measured, strict=True)
        )
        return Measurements(self.robot_name, self.readings, observations)


def sample_truth(robot: Mechanism, n_trials: int, seed: int) -> Array:
    """True parameter values drawn from the tolerances: `nominal + tolerance * standard normal`.

    Parameters
    ----------
    robot : Mechanism
        Parameters that are fixed or have no tolerance stay nominal.
    n_trials : int
    seed : int
        Trial i gets the same values however many trials there are.

    Returns
    -------
    truth : (t, p) [SI]
    """
    table = robot.parameters
    spread = np.where(table.free, np.nan_to_num(table.tolerance, nan=0.0), 0.0)
    draws = [stream(seed, trial, TRUTH).standard_normal(len(table)) for trial in range(n_trials)]
    return table.nominal + spread * np.array(draws).reshape(n_trials, len(table))


def simulate_trials(
    robot: Mechanism, truth: ArrayLike, poses: ArrayLike, instrument: Instrument, seed: int, controller: Mechanism | None = None
) -> Trials:
    """Measure the same commanded poses on t machines.

    Parameters
    ----------
    robot : Mechanism
        Structure and tool of all machines; its own values do not matter.
    truth : (t, p) [SI]
        True parameter values of each machine, see `sample_truth`.
    poses : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI]
        As commanded.
    instrument : Instrument
    seed : int
        Trial i draws the same noise however many trials there are.
    controller : Mechanism, optional
        The geometry that turns poses into readings; default: the robot at its nominal values.

    Returns
    -------
    trials : Trials

    Raises
    ------
    DataError
        If the controller cannot reach a pose.
    """
    values = np.atleast_2d(np.asarray(truth, dtype=float))
    mounted = instrument.mounted(robot)
    commanded = solve_commanded(robot.nominal if controller is None else controller, poses)
    readings = commanded.q
    # Starting at the commanded pose keeps the true machine in the assembly mode of its controller.
    state = forward_trials(robot, values, readings[None], commanded.state)
    T = np.broadcast_to(state.T, (len(values), *state.T.shape[1:]))
    reached = np.broadcast_to(state.status == Status.CONVERGED, T.shape[:2])
    noise = [_drawn(mounted, len(readings), stream(seed, trial, NOISE)) for trial in range(len(values))]
    measured = []
    for k, sensor in enumerate(mounted.sensors):
        seen = sensor.kind.measure(np.where(reached[..., None, None], T, np.eye(4)), np.stack([d[k] for d in noise]))
        measured.append(np.where(reached[..., None], seen, np.nan))
    return Trials(mounted, robot.name, readings, tuple(measured), values, T)


def simulate(
    robot: Mechanism, poses: ArrayLike, instrument: Instrument, seed: int, controller: Mechanism | None = None
) -> Measurements:
    """Measure commanded poses on one machine.

    Parameters
    ----------
    robot : Mechanism
        The true machine, at its true values.
    poses : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI]
        As commanded.
    instrument : Instrument
    seed : int
        The result is that of trial 0 of `simulate_trials`.
    controller : Mechanism, optional
        The geometry that turns poses into readings; default: the robot at its nominal values.

    Returns
    -------
    measurements : Measurements

    Raises
    ------
    DataError
        If the controller cannot reach a pose, or the true machine cannot follow the readings.
    """
    trials = simulate_trials(robot, robot.values[None], poses, instrument, seed, controller)
    lost = np.flatnonzero(np.isnan(trials.measured[0][0]).all(axis=-1))
    if len(lost):
        raise DataError(
            f"the true machine cannot follow the readings of pose {int(lost[0]) + 1} ({len(lost)} of"
            f" {len(trials.readings)} fail); choose poses further inside the workspace, or smaller errors"
        )
    return trials.trial(0)


def _drawn(instrument: Instrument, n: int, generator: np.random.Generator) -> list[Array]:
    """Noise (n, m) of each sensor, one after the other from one stream."""
    return [sensor.noise.draw(generator, n) for sensor in instrument.sensors]
