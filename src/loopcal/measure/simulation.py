# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements of one machine or of many at once.

The controller's inverse kinematics turns commanded poses into readings. The forward kinematics of
the true machine turns readings into true poses. The instrument measures these poses with noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.measure.array_checks import check_array, check_type
from loopcal.measure.closure_checks import check_closure, check_redundancy
from loopcal.measure.disturbances import NO_DISTURBANCE, Disturbance, reach_poses
from loopcal.measure.instrument import Distribution, Instrument, Seed, Sensor, make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters, collect_nuisance_parameters
from loopcal.measure.observations import Observations
from loopcal.measure.reading_sigma import broadcast_reading_sigma, resolve_reading_sigma
from loopcal.measure.readings import (
    list_sensed_joints,
    name_pose,
    select_joint_values,
    solve_commanded_poses,
)
from loopcal.mechanism import Mechanism, Status, forward, refuse_drawn_errors
from loopcal.typing import BoolArray, FloatArray

NOISE, TRUTH, READING = 0, 1, 2  # purposes of a trial's random streams


@dataclass(frozen=True, eq=False, repr=False)
class Trials:
    """The same measurements of t machines, as stacked arrays.

    Attributes
    ----------
    instrument : Instrument
        With the robot's tool, and with explicit rows of every sensor.
    robot_name : str
    readings : (n, a) [SI]
        Of the controller, equal in all trials.
    measured : tuple of (t, r, c) [SI]
        Columns of each sensor; NaN in rows that the true machine cannot reach.
    truth : (t, p) [SI]
        True parameter values of each trial.
    T : (t, n, 4, 4)
        True T_base_platform.
    reached : (t, n) bool
        Poses that the true machine reaches.
    nuisance_parameters : NuisanceParameters
        Of the kinds, with their true values as nominal ones.
    recorded : (t, n, a) [SI], optional
        Recorded readings with their noise; None where they equal those of the controller.
    reading_sigma : (n, a) [SI], optional
        As in `Measurements`.
    """

    instrument: Instrument
    robot_name: str
    readings: FloatArray
    measured: tuple[FloatArray, ...]
    truth: FloatArray
    T: FloatArray
    reached: BoolArray
    nuisance_parameters: NuisanceParameters
    recorded: FloatArray | None = None
    reading_sigma: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.truth)

    def __repr__(self) -> str:
        t, n = self.reached.shape
        missed = int(np.count_nonzero(~self.reached))
        note = f", {missed} of {self.reached.size} poses not reached" if missed else ""
        return (
            f"Trials of {self.robot_name!r}: {t} trials, {n} poses each{note}\n{self.instrument!r}"
        )

    def trial(self, i: int) -> Measurements:
        """Return the measurements of one trial."""
        observations = [
            Observations.from_sigma(
                s.kind, s.assigned_rows, measured[i], s.noise.sigma, s.session, s.group
            )
            for s, measured in zip(self.instrument.sensors, self.measured, strict=True)
        ]
        return Measurements(
            self.robot_name,
            self.readings if self.recorded is None else self.recorded[i],
            tuple(rows for rows in observations if not rows.kind.is_of_base),
            reading_sigma=self.reading_sigma,
            base_observations=tuple(rows for rows in observations if rows.kind.is_of_base),
        )


def sample_truth(
    robot: Mechanism, n_trials: int, seed: Seed, distribution: Distribution = "normal"
) -> FloatArray:
    """Draw true parameter values from the tolerances: `nominal + tolerance * standard normal`.

    A common error of several parameters is drawn once and added to each of them.

    Parameters
    ----------
    robot : Mechanism
        Parameters that are fixed or have no tolerance stay nominal.
    n_trials : int
    seed : int or BlockStream
        Trial i gets the same values for any number of trials.
    distribution : "normal" or "uniform"
        Of the errors. The tolerances are their standard deviations in both: uniform errors lie
        within sqrt(3) of them.

    Returns
    -------
    truth : (t, p) [SI]

    Raises
    ------
    DataError
        If there is no such distribution.
    MechanismError
        If the robot is over-constrained, so that its loops do not close with such errors.
    """
    check_type(robot, Mechanism, "robot", "from loopcal.load_robot")
    refuse_drawn_errors(robot)
    if distribution not in get_args(Distribution):
        raise DataError(f"distribution is {distribution!r}; give 'normal' or 'uniform'")
    table = robot.parameters
    own = np.array([entry.tolerance or 0.0 for entry in table.entries])
    effects = np.column_stack([np.diag(own), table.common_effects]) * table.free[:, None]
    streams = (make_random_stream(seed, trial, TRUTH) for trial in range(n_trials))
    limit = np.sqrt(3.0)
    draws = [
        stream.standard_normal(effects.shape[1])
        if distribution == "normal"
        else stream.uniform(-limit, limit, effects.shape[1])
        for stream in streams
    ]
    return table.nominal + np.array(draws).reshape(n_trials, effects.shape[1]) @ effects.T


def simulate_trials(
    robot: Mechanism,
    truth: ArrayLike,
    poses: ArrayLike,
    instrument: Instrument,
    seed: Seed,
    controller: Mechanism | None = None,
    nuisance_values: Mapping[str, float] | None = None,
    reading_sigma: ArrayLike | None = None,
    disturbance: Disturbance = NO_DISTURBANCE,
    pose_names: tuple[Sequence[str], Sequence[str]] = ((), ()),
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
    seed : int or BlockStream
        Trial i draws the same noise for any number of trials.
    controller : Mechanism, optional
        The geometry that turns poses into readings; default: the robot at its nominal values.
    nuisance_values : name -> value [SI], optional
        True values of setup parameters, such as `tracker.x`; default: nominal.
    reading_sigma : number, (a,) or (n, a) [SI], optional
        Standard deviation of the recorded readings, which are the true ones plus normal noise; 0 is
        exact, infinity is missing. Default: as the robot states for its actuators.
    disturbance : Disturbance, optional
        What happens at each pose although the model does not contain it.
    pose_names : (labels, places), optional
        Names of the poses, and their places such as `poses.csv:12`, for messages.

    Raises
    ------
    DataError
        If the controller cannot reach a pose, a setup parameter does not exist, `truth` has another
        shape; or the kind `closure` is asked of a robot without redundant actuators or of exact
        readings.
    """
    check_type(robot, Mechanism, "robot", "from loopcal.load_robot")
    check_type(instrument, Instrument, "instrument", "such as loopcal.Instrument((sensor,))")
    kinds = [sensor.kind for sensor in instrument.sensors]
    check_redundancy(robot, kinds)
    values = _check_truth(robot, truth)
    geometry = robot.nominal if controller is None else controller
    commanded = solve_commanded_poses(geometry, poses, *pose_names)
    readings, n = commanded.q, len(commanded.q)
    given = None if reading_sigma is None else broadcast_reading_sigma(reading_sigma, readings)
    check_closure(robot, kinds, given, n)
    assigned = Instrument(tuple(s.assign_rows(n) for s in instrument.with_tool(robot).sensors))
    labels = tuple(str(i + 1) for i in range(n))
    nuisance = collect_nuisance_parameters(assigned.sensors, labels)
    nuisance = nuisance.with_nominal(nuisance.values(nuisance_values))
    # Starting at the commanded pose keeps the true machine in the assembly mode of its controller.
    true, state = reach_poses(robot, values, readings, commanded.state, disturbance)
    T = np.broadcast_to(state.T, (len(values), *state.T.shape[1:]))
    reached = np.array(np.broadcast_to(state.status == Status.CONVERGED, T.shape[:2]))
    joints = select_joint_values(
        robot, list_sensed_joints(s.kind for s in assigned.sensors), true, state
    )
    noise = [_draw_noise(assigned, make_random_stream(seed, i, NOISE)) for i in range(len(values))]
    measured = tuple(
        _measure_sensor(k, sensor, disturbance.displace(T), reached, joints, noise, nuisance)
        for k, sensor in enumerate(assigned.sensors)
    )
    shown = true if disturbance.readings is None else true - disturbance.readings
    recorded, sigma = record_readings(robot, shown, reading_sigma, len(values), seed)
    return Trials(
        assigned, robot.name, readings, measured, values, T, reached, nuisance, recorded, sigma
    )


def simulate(
    robot: Mechanism,
    poses: ArrayLike,
    instrument: Instrument,
    seed: int,
    controller: Mechanism | None = None,
    nuisance_values: Mapping[str, float] | None = None,
    reading_sigma: ArrayLike | None = None,
    pose_names: tuple[Sequence[str], Sequence[str]] = ((), ()),
) -> Measurements:
    """Measure commanded poses on one machine: trial 0 of `simulate_trials`.

    Parameters
    ----------
    robot : Mechanism
        The true machine, at its true values.
    poses, instrument, seed, controller, nuisance_values, reading_sigma, pose_names
        As for `simulate_trials`.

    Returns
    -------
    measurements : Measurements

    Raises
    ------
    DataError
        If the controller cannot reach a pose, or the true machine cannot reach it with the readings
        of the controller.
    """
    check_type(robot, Mechanism, "robot", "from loopcal.load_robot")
    truth = robot.values[None]
    trials = simulate_trials(
        robot,
        truth,
        poses,
        instrument,
        seed,
        controller,
        nuisance_values,
        reading_sigma,
        pose_names=pose_names,
    )
    failed = np.flatnonzero(~trials.reached[0])
    if len(failed):
        name = name_pose(int(failed[0]), *pose_names)
        raise DataError(
            f"the true machine does not reach pose {name} with the readings of the controller "
            f"({len(failed)} of {len(trials.readings)} poses fail); choose poses further inside "
            "the workspace, or smaller errors"
        )
    return trials.trial(0)


def replace_measured_values(
    robot: Mechanism, data: Measurements, instrument: Instrument, seed: int
) -> Measurements:
    """Return measurements with simulated values in place of theirs, at their readings; those of
    redundant actuators are simulated, too.

    Parameters
    ----------
    robot : Mechanism
        The true machine, at its values.
    data : Measurements
        Poses and rows; their measured values are ignored.
    instrument : Instrument
        A sensor with its noise for each of `data.all_observations`, in their order.
    seed : int
        Of the noise.

    Raises
    ------
    DataError
        If the nominal or the true robot does not reach a pose.
    """
    nominal = forward(robot.nominal, data.readings)
    failed = np.flatnonzero(~nominal.converged)
    if len(failed):
        first = int(failed[0])
        raise DataError(
            f"{robot.name} does not reach pose {data.labels[first]!r} with its readings "
            f"({nominal.explain(first)}); correct the readings"
        )
    sensors = tuple(
        replace(sensor, rows=rows.rows, session=rows.session, group=rows.group)
        for sensor, rows in zip(instrument.sensors, data.all_observations, strict=True)
    )
    how = {"controller": robot.nominal, "reading_sigma": data.reading_sigma}
    measured = simulate(robot, nominal.T, Instrument(sensors), seed, **how)
    filled = replace(
        data, observations=measured.observations, base_observations=measured.base_observations
    )
    if robot.program.sigma is None:
        return filled
    # redundant actuators of the true machine cannot all have the readings of the controller
    return replace(filled, readings=measured.readings, reading_sigma=measured.reading_sigma)


def _check_truth(robot: Mechanism, truth: ArrayLike) -> FloatArray:
    """Return true parameter values (t, p) of at least one machine, checked."""
    values = check_array(np.atleast_2d(np.asarray(truth)), "truth", (None, len(robot.parameters)))
    if not len(values):
        raise DataError("truth has no row; give the parameter values of at least one machine")
    return values


def _measure_sensor(
    k: int,
    sensor: Sensor,
    T: FloatArray,
    reached: BoolArray,
    joints: Mapping[str, FloatArray],
    noise: list[list[FloatArray]],
    nuisance: NuisanceParameters,
) -> FloatArray:
    """Return columns (t, r, c) of sensor k at true poses; NaN where these were not reached."""
    kind, rows = sensor.kind, sensor.assigned_rows
    safe = np.where(reached[..., None, None], T, np.eye(4))
    values = nuisance.select(k, nuisance.table.nominal[None])
    drawn = np.stack([of_trial[k] for of_trial in noise])
    measured = kind.measure(safe[:, rows], drawn, values, kind.stack_joints(joints, rows))
    if kind.is_of_base:
        return measured
    complete = np.asarray(np.all(reached[:, rows].reshape(len(reached), len(rows), -1), axis=-1))
    return np.where(complete[..., None], measured, np.nan)


def record_readings(
    robot: Mechanism, true: FloatArray, sigma: ArrayLike | None, trials: int, seed: Seed
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return recorded readings (t, n, a) of true ones (t | 1, n, a), and their sigma (n, a); None
    for the readings where all are exact.
    """
    given = None if sigma is None else broadcast_reading_sigma(sigma, true[0])
    resolved = resolve_reading_sigma(robot, given, true.shape[1])
    if resolved is None:
        return None, given
    streams = (make_random_stream(seed, trial, READING) for trial in range(trials))
    draws = np.stack([stream.standard_normal(resolved.shape) for stream in streams])
    present = np.isfinite(resolved)
    noise = np.where(present, resolved, 0.0) * draws
    return np.where(present, true + noise, np.nan), resolved


def _draw_noise(instrument: Instrument, generator: np.random.Generator) -> list[FloatArray]:
    """Return noise (r, m) of each sensor, in order from one stream."""
    return [
        sensor.noise.draw(generator, len(sensor.assigned_rows)) for sensor in instrument.sensors
    ]
