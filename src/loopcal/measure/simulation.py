# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements: a true machine is commanded by a controller that believes in another
geometry, and looked at.

Commanded poses become readings by the controller's inverse kinematics, readings become true poses
by the true machine's forward kinematics, and the instrument writes down what it sees of them, noise
included.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.engine import State
from loopcal.errors import DataError
from loopcal.measure.commanded_poses import solve_commanded_poses
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.joint_observation import list_sensed_joints, select_joint_values
from loopcal.measure.kinds import Kind
from loopcal.measure.measurements import Measurements, broadcast_reading_sigma
from loopcal.measure.noise import make_random_stream
from loopcal.measure.nuisance import NuisanceParameters, collect_nuisance_parameters
from loopcal.measure.observations import Observations
from loopcal.measure.readings import resolve_reading_sigma
from loopcal.mechanism import Mechanism, Status, forward_trials, solve_at_pose
from loopcal.typing import BoolArray, FloatArray

Ints = NDArray[np.intp]
Texts = NDArray[np.str_]
Bools = BoolArray

NOISE, TRUTH, READING = 0, 1, 2  # purposes of a trial's random streams


@dataclass(frozen=True, eq=False)
class Trials:
    """The same measurements made on t machines, as stacked arrays.

    Attributes
    ----------
    instrument : Instrument
        Mounted on the robot's tool, with the rows of every sensor spelt out.
    robot_name : str
    readings : (n, a) [SI]
        The controller's, equal in all trials.
    measured : tuple of (t, r, c) [SI]
        Columns of each sensor; NaN in rows whose true machine cannot follow the readings.
    truth : (t, p) [SI]
        True parameter values of each trial.
    T : (t, n, 4, 4)
        True T_base_platform.
    reached : (t, n) bool
        Poses to which the true machine could follow.
    local : NuisanceParameters
        Of the kinds, their true values as nominal ones.
    recorded : (t, n, a) [SI], optional
        What the readings were recorded as, with their noise; None where they are the controller's.
    reading_sigma : (n, a) [SI], optional
        As in `Measurements`.
    """

    instrument: Instrument
    robot_name: str
    readings: FloatArray
    measured: tuple[FloatArray, ...]
    truth: FloatArray
    T: FloatArray
    reached: Bools
    local: NuisanceParameters
    recorded: FloatArray | None = None
    reading_sigma: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.truth)

    def trial(self, i: int) -> Measurements:
        """Measurements of one trial."""
        observations = tuple(
            Observations.from_sigma(
                s.kind, rows_of(s), measured[i], s.noise.sigma, s.session, s.group
            )
            for s, measured in zip(self.instrument.sensors, self.measured, strict=True)
        )
        readings = self.readings if self.recorded is None else self.recorded[i]
        return Measurements(
            self.robot_name, readings, observations, reading_sigma=self.reading_sigma
        )


def sample_truth(robot: Mechanism, n_trials: int, seed: int) -> FloatArray:
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
    draws = [
        make_random_stream(seed, trial, TRUTH).standard_normal(len(table))
        for trial in range(n_trials)
    ]
    return table.nominal + spread * np.array(draws).reshape(n_trials, len(table))


def simulate_trials(
    robot: Mechanism,
    truth: ArrayLike,
    poses: ArrayLike,
    instrument: Instrument,
    seed: int,
    controller: Mechanism | None = None,
    nuisance_values: Mapping[str, float] | None = None,
    reading_sigma: ArrayLike | None = None,
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
    nuisance_values : name -> value [SI], optional
        True values of unknowns of the kinds, such as `tracker.x`; default: nominal.
    reading_sigma : number, (a,) or (n, a) [SI], optional
        Standard deviation of the recorded readings: normal noise on the true ones, at which the
        true machine stands; 0 is exact, infinite not taken. Default: what the robot states of its
        actuators.

    Returns
    -------
    trials : Trials

    Raises
    ------
    DataError
        If the controller cannot reach a pose, or an unknown is not there.
    """
    values = np.atleast_2d(np.asarray(truth, dtype=float))
    commanded = solve_commanded_poses(robot.nominal if controller is None else controller, poses)
    readings, n = commanded.q, len(commanded.q)
    mounted = Instrument(
        tuple(sensor.assign_rows(n) for sensor in instrument.with_tool(robot).sensors)
    )
    seeing = [_Seeing(s.kind, rows_of(s), s.session, s.group) for s in mounted.sensors]
    local = collect_nuisance_parameters(seeing, tuple(str(i + 1) for i in range(n)))
    local = local.with_nominal(local.values(nuisance_values))
    # Starting at the commanded pose keeps the true machine in the assembly mode of its controller.
    state = forward_trials(robot, values, readings[None], commanded.state)
    T = np.broadcast_to(state.T, (len(values), *state.T.shape[1:]))
    reached = np.zeros(T.shape[:2], dtype=np.bool_)
    reached[:] = state.status == Status.CONVERGED
    # Redundant actuators cannot all read what a wrong geometry told them: their true readings are
    # those of the pose.
    true = (
        readings[None] if robot.program.sigma is None else _closing(robot, values, readings, state)
    )
    joints = select_joint_values(
        robot, list_sensed_joints(s.kind for s in mounted.sensors), true, state
    )
    noise = [
        _drawn(mounted, make_random_stream(seed, trial, NOISE)) for trial in range(len(values))
    ]
    measured = tuple(
        _seen(k, one, T, reached, joints, noise, local) for k, one in enumerate(seeing)
    )
    recorded, sigma = _recorded(robot, true, reading_sigma, len(values), seed)
    return Trials(
        mounted, robot.name, readings, measured, values, T, reached, local, recorded, sigma
    )


def simulate(
    robot: Mechanism,
    poses: ArrayLike,
    instrument: Instrument,
    seed: int,
    controller: Mechanism | None = None,
    nuisance_values: Mapping[str, float] | None = None,
    reading_sigma: ArrayLike | None = None,
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
    nuisance_values : name -> value [SI], optional
        True values of unknowns of the kinds; default: nominal.
    reading_sigma : optional
        As for `simulate_trials`.

    Returns
    -------
    measurements : Measurements

    Raises
    ------
    DataError
        If the controller cannot reach a pose, or the true machine cannot follow the readings.
    """
    trials = simulate_trials(
        robot,
        robot.values[None],
        poses,
        instrument,
        seed,
        controller,
        nuisance_values,
        reading_sigma,
    )
    lost = np.flatnonzero(~trials.reached[0])
    if len(lost):
        raise DataError(
            f"the true machine cannot follow the readings of pose {int(lost[0]) + 1} ({len(lost)} "
            "of"
            f" {len(trials.readings)} fail); choose poses further inside the workspace, or smaller "
            "errors"
        )
    return trials.trial(0)


class _Seeing(NamedTuple):
    """A kind and its rows, before anything is measured."""

    kind: Kind
    rows: Ints
    session: Texts
    group: Texts


def _seen(
    k: int,
    one: _Seeing,
    T: FloatArray,
    reached: Bools,
    joints: Mapping[str, FloatArray],
    noise: list[list[FloatArray]],
    local: NuisanceParameters,
) -> FloatArray:
    """Columns (t, r, c) of sensor k at true poses; NaN where these could not be reached."""
    kind, rows = one.kind, one.rows
    safe = np.where(reached[..., None, None], T, np.eye(4))
    at = (
        np.stack([joints[name][:, rows] for name in kind.sensed_joints], axis=-1)
        if kind.sensed_joints
        else None
    )
    own = local.select(k, local.table.nominal[None]) if kind.nuisance_parameters else None
    seen = kind.measure(safe[:, rows], np.stack([drawn[k] for drawn in noise]), own, at)
    there = np.asarray(np.all(reached[:, rows].reshape(len(reached), len(rows), -1), axis=-1))
    return np.where(there[..., None], seen, np.nan)


def _closing(
    robot: Mechanism, values: FloatArray, readings: FloatArray, state: State
) -> FloatArray:
    """Readings (t, n, a) that close every limb at the poses of a state; as commanded where there is
    no such pose.
    """
    found = solve_at_pose(robot, values, state.T, state)[1]
    return np.where(np.isfinite(found), found, readings)


def _recorded(
    robot: Mechanism, true: FloatArray, sigma: ArrayLike | None, trials: int, seed: int
) -> tuple[FloatArray | None, FloatArray | None]:
    """Recorded readings (t, n, a) of true ones (t | 1, n, a), and their sigma (n, a); None, None
    where all are exact.
    """
    given = None if sigma is None else broadcast_reading_sigma(sigma, true[0])
    stated = resolve_reading_sigma(robot, given, true.shape[1])
    if stated is None:
        return None, given
    draws = np.stack(
        [
            make_random_stream(seed, trial, READING).standard_normal(stated.shape)
            for trial in range(trials)
        ]
    )
    taken = np.isfinite(stated)
    return np.where(taken, true + np.where(taken, stated, 0.0) * draws, np.nan), stated


def rows_of(sensor: Sensor) -> Ints:
    """Rows of a sensor whose rows are spelt out, see `Sensor.assign_rows`."""
    if sensor.rows is None:
        raise DataError("the rows of the sensor are not spelt out; use sensor.assign_rows(n_poses)")
    return sensor.rows


def _drawn(instrument: Instrument, generator: np.random.Generator) -> list[FloatArray]:
    """Noise (r, m) of each sensor, one after the other from one stream."""
    return [sensor.noise.draw(generator, len(rows_of(sensor))) for sensor in instrument.sensors]
