# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements of one machine or of many at once.

The controller's inverse kinematics turns commanded poses into readings. The forward kinematics of
the true machine turns readings into true poses. The instrument measures these poses with noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from loopcal.engine import State
from loopcal.errors import DataError
from loopcal.measure.array_checks import check_array, refuse_first
from loopcal.measure.data_checks import check_closure, check_kinds
from loopcal.measure.initial_values import EvaluatedRows, evaluate_measurements
from loopcal.measure.instrument import Distribution, Instrument, Seed, make_random_stream
from loopcal.measure.kinds.surfaces import Line, Plane
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters, collect_nuisance_parameters
from loopcal.measure.observations import Observations
from loopcal.measure.readings import (
    broadcast_reading_sigma,
    list_sensed_joints,
    name_pose,
    resolve_reading_sigma,
    select_joint_values,
    solve_commanded_poses,
)
from loopcal.mechanism.actuation import keep_conditions, list_open_sums, solve_at_pose
from loopcal.mechanism.assembly import FORCES
from loopcal.mechanism.chains import each_stage, join_stage_states
from loopcal.mechanism.kinematics import Loops, compute_readings, forward_trials, load_readings
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.over_constraint import refuse_breaking_parameters
from loopcal.mechanism.platform_coordinates import POSITION, read_coordinates
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status, driven_values
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Disturbance:
    """What happens at each measured pose although the model does not contain it; None for 0."""

    # (t | 1, n, p) [SI] added to the true parameter values, such as thermal growth
    values: FloatArray | None = None
    readings: FloatArray | None = None  # (t | 1, n, a) [SI] joint values minus readings: backlash
    # (t | 1, n, 3) [m] displacement of what is measured, in base axes, such as the drift of an
    # instrument; it is no part of the true poses
    motion: FloatArray | None = None


NO_DISTURBANCE = Disturbance()
NOISE, TRUTH, READING, SETUP, CONDITIONS = 0, 1, 2, 5, 6  # purposes of a trial's random streams
STEPS = 20  # corrections of a commanded position; each leaves the share of the geometry's errors
EXACT = 1e-6  # share of the noise to which a gap is reached
# Parameters of a surface that move it along the residuals of its points, in their order.
OFFSETS = ("height", "a", "b")


def reach_poses(
    robot: Mechanism,
    values: FloatArray,
    readings: FloatArray,
    start: State,
    disturbance: Disturbance = NO_DISTURBANCE,
    are_exact: bool = True,
) -> tuple[FloatArray, State]:
    """Return the true readings (t | 1, n, a) and the states (t, n) of t machines of values (t, p)
    [SI], from the readings (n, a) of the controller and the state (1, n) of the commanded poses.

    are_exact : whether the readings of the controller count as exact, although redundant ones that
        the pose does not determine contradict each other.
    """
    true = readings[None]
    if disturbance.readings is not None:
        true = true + disturbance.readings
    shape = (len(values), len(readings))
    if disturbance.values is not None:  # every pose is a machine of its own
        values = (values[:, None] + disturbance.values).reshape(-1, values.shape[1])
        true = np.broadcast_to(true, (*shape, readings.shape[1]))
        true = true.reshape(-1, 1, readings.shape[1])
        start = _reshape_state(start, shape, (-1, 1))
    true, state = _close_redundant(robot, values, true, start, are_exact)
    if disturbance.values is not None:
        true, state = true.reshape(*shape, -1), _reshape_state(state, (len(values), 1), shape)
    return true, state


def _close_redundant(
    robot: Mechanism, values: FloatArray, readings: FloatArray, start: State, are_exact: bool
) -> tuple[FloatArray, State]:
    """Return readings (t | 1, n, a), redundant ones as the machines have them, and the states that
    they lead to from a start.

    Redundant actuators of a wrong geometry contradict each other: their true readings are those of
    the reached pose. Where they contradict each other so widely that they lead to none, the machine
    is moved to the commanded pose, with all but the needed actuators following it.
    """
    if robot.has_redundant_readings and robot.stages:
        a, parts = len(robot.actuators), each_stage(robot, values, start, readings)
        closed = [
            _close_redundant(p.stage.robot, p.values, p.readings, p.state, are_exact) for p in parts
        ]
        counts = [len(stage.robot.actuators) for stage in robot.stages]
        own = [q[..., :count] for (q, _), count in zip(closed, counts, strict=True)]
        own.append(readings[..., a:])  # directions of approach
        lead = np.broadcast_shapes(*(q.shape[:2] for q in own))
        whole = np.concatenate([np.broadcast_to(q, (*lead, q.shape[2])) for q in own], axis=2)
        return whole, join_stage_states(robot, [state for _, state in closed])
    state = forward_trials(robot, values, readings, start)
    if not robot.has_redundant_readings or (robot.redundancy is None and are_exact):
        return readings, state
    if robot.redundancy is None:
        exact, (e, _) = robot.exact, robot.slots(values)
        sums = list_open_sums(robot, values, robot.determining_readings, readings)
        own = sums.join(sums.read(driven_values(robot.program, state)))
        closed = Loops(exact, e, sums.weights).solve(own, state)
        return keep_conditions(robot, compute_readings(exact, values, closed), readings), closed
    lost = state.status != Status.CONVERGED

    def select(placed: np.ndarray, reached: np.ndarray) -> np.ndarray:
        mask = lost.reshape(*lost.shape, *[1] * (reached.ndim - 2))
        return np.where(mask, placed, reached)

    begin = replace(state, T=select(start.T, state.T))
    placed, closed = solve_at_pose(robot, values, begin.T, begin, readings)
    return np.where(np.isfinite(closed), closed, readings), map_arrays(select, placed, state)


def _reshape_state(state: State, shape: tuple[int, int], wanted: tuple[int, int]) -> State:
    """Return a state, broadcast to `shape` of trials and poses, with another shape of these."""

    def change(array: np.ndarray) -> np.ndarray:
        return np.broadcast_to(array, (*shape, *array.shape[2:])).reshape(*wanted, *array.shape[2:])

    return map_arrays(change, state)


@dataclass(frozen=True, eq=False, repr=False)
class Trials:
    """The same measurements of t machines, as stacked arrays.

    Attributes
    ----------
    instrument : with the robot's tool, and with explicit rows of every sensor.
    readings : (n, a) [SI], of the controller, equal in all trials.
    measured : (t, r, c) [SI] columns of each sensor; NaN where the true machine does not reach.
    truth : (t, p) [SI], true parameter values of each trial.
    T : (t, n, 4, 4), true T_base_platform.
    reached : (t, n) bool, poses that the true machine reaches.
    nuisance_parameters : of the kinds, with their true values, or the means from which these are
        drawn, as nominal ones.
    recorded : (t, n, a) [SI] readings with their noise; None where they are the controller's.
    reading_sigma : (n, a) [SI], as in `Measurements`.
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
        counts = f"{t} trials, {n} poses each{note}"
        return f"Trials of {self.robot_name!r}: {counts}\n{self.instrument!r}"

    def trial(self, i: int) -> Measurements:
        """Return the measurements of one trial."""
        observations = [
            Observations.from_sigma(
                *(s.kind, s.assigned_rows, measured[i], s.noise.sigma, s.session, s.group),
                sight=s.noise.sight,
            )
            for s, measured in zip(self.instrument.sensors, self.measured, strict=True)
        ]
        return Measurements(
            self.robot_name,
            self.readings if self.recorded is None else self.recorded[i],
            tuple(rows for rows in observations if not rows.kind.is_of_base),
            reading_sigma=self.reading_sigma,
            stated_values=self.instrument.stated_values,
            base_observations=tuple(rows for rows in observations if rows.kind.is_of_base),
        )


def sample_truth(
    robot: Mechanism, n_trials: int, seed: Seed, distribution: Distribution = "normal"
) -> FloatArray:
    """Draw true parameter values: `nominal + expected spread * standard normal`.

    A common error of several parameters is drawn once and added to each of them.

    Parameters
    ----------
    robot : parameters that are fixed or have no spread stay nominal.
    n_trials : trial i gets the same values for any number of trials.
    distribution : of the errors, "normal" or "uniform". The tolerances are their standard
        deviations in both: uniform errors lie within sqrt(3) of them.

    Returns
    -------
    truth : (t, p) [SI]

    Raises
    ------
    MechanismError : the robot is over-constrained, so that its loops do not close with such errors.
    """
    refuse_breaking_parameters(robot, drawn=True)
    if distribution not in get_args(Distribution):
        raise DataError(f"distribution is {distribution!r}. Give 'normal' or 'uniform'")
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
    robot : structure and tool of all machines; its own values do not matter.
    truth : (t, p) [SI], true parameter values of each machine, see `sample_truth`.
    poses : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI], as commanded.
    seed : trial i draws the same noise for any number of trials.
    controller : the geometry that turns poses into readings; default: the nominal robot.
    nuisance_values : true values [SI] of setup parameters, such as `tracker.x`; default: drawn
        where the instrument states a prior, such as that of its scale, else nominal.
    reading_sigma : number, (a,) or (n, a) [SI], standard deviation of the recorded readings, which
        are the true ones plus normal noise; 0 is exact, infinity is missing. Default: as the robot
        states for its actuators.
    disturbance : what happens at each pose although the model does not contain it.
    pose_names : names of the poses, and their places such as `poses.csv:12`, for messages.

    Raises
    ------
    DataError : a pose out of reach, an unknown setup parameter, or another shape of `truth`.
    """
    kinds = [sensor.kind for sensor in instrument.sensors]
    check_kinds(robot, kinds)
    values = check_array(np.atleast_2d(np.asarray(truth)), "truth", (None, len(robot.parameters)))
    if not len(values):
        raise DataError("truth has no row. Give the parameter values of at least one machine")
    geometry = robot.nominal if controller is None else controller
    commanded = solve_commanded_poses(geometry, poses, *pose_names)
    readings, n = draw_conditions(robot, commanded.q, seed), len(commanded.q)
    given = None if reading_sigma is None else broadcast_reading_sigma(reading_sigma, readings)
    check_closure(robot, kinds, given, n)
    mounted = instrument.with_tool(robot)
    assigned = replace(mounted, sensors=tuple(s.assign_rows(n) for s in mounted.sensors))
    labels = tuple(str(i + 1) for i in range(n))
    nuisance = collect_nuisance_parameters(assigned.sensors, labels, instrument.stated_values)
    nuisance = nuisance.with_nominal(nuisance.values(nuisance_values))
    true_setup = _draw_setup(nuisance, nuisance_values or {}, len(values), seed)
    # Starting at the commanded pose keeps the true machine in the assembly mode of its controller.
    true, state = reach_poses(
        *(robot, values, readings, commanded.state, disturbance),
        are_exact=resolve_reading_sigma(robot, given, n) is None,
    )
    T = np.broadcast_to(state.T, (len(values), *state.T.shape[1:]))
    reached = np.array(np.broadcast_to(state.status == Status.CONVERGED, T.shape[:2]))
    joints = select_joint_values(
        robot, list_sensed_joints(s.kind for s in assigned.sensors), true, state
    )
    streams = [make_random_stream(seed, trial, NOISE) for trial in range(len(values))]
    seen = np.where(reached[..., None, None], T, np.eye(4))
    if disturbance.motion is not None:
        seen[..., :3, 3] += np.where(reached[..., None], disturbance.motion, 0.0)
    measured = []
    for k, sensor in enumerate(assigned.sensors):
        kind, rows = sensor.kind, sensor.assigned_rows
        noise = np.stack([sensor.noise.draw(stream, len(rows)) for stream in streams])
        setup = nuisance.select(k, true_setup)
        measure = partial(kind.measure, seen[:, rows], nuisance=setup)
        measure = partial(measure, joints=kind.stack_joints(joints, rows))
        if sight := sensor.noise.sight:
            spread = kind.spread_sight_noise(measure(np.zeros_like(noise)))
            parts = (sd * sd * spread[name] for name, sd in sight.items())
            noise = noise + _draw_noise(sum(parts, np.zeros(())), streams)
        columns = measure(noise)
        columns = kind.hide_unseen(seen[:, rows], columns, setup)
        if kind.label_count and not kind.detect_present(columns).any():
            raise DataError(
                f"the kind {kind.name!r} sees nothing at any pose: every corner is outside the "
                "picture, behind the camera, or on the back of the board. Correct T_camera and "
                "T_board"
            )
        for _, problem in kind.find_invalid_rows(np.concatenate(columns)):
            raise DataError.of(
                "data.simulated-row-impossible",
                kind=kind.name,
                robot=robot.name,
                problem=problem.partition(";")[0],
            )
        if not kind.is_of_base:
            complete = np.all(reached[:, rows].reshape(len(reached), len(rows), -1), axis=-1)
            is_measured = np.arange(columns.shape[-1]) >= kind.label_count
            columns = np.where(complete[..., None] | ~is_measured, columns, np.nan)
        measured.append(columns)
    shown = true if disturbance.readings is None else true - disturbance.readings
    recorded = _record_readings(robot, shown, reading_sigma, len(values), seed)
    columns = tuple(measured)
    return Trials(assigned, robot.name, readings, columns, values, T, reached, nuisance, *recorded)


def _draw_noise(covariance: FloatArray, streams: Sequence[np.random.Generator]) -> FloatArray:
    """Return noise (t, r, m) [SI] of covariances (t, r, m, m), which may be singular."""
    roots = np.linalg.eigh(covariance)
    axes = roots.eigenvectors * np.sqrt(np.maximum(roots.eigenvalues, 0.0))[..., None, :]
    drawn = np.stack([stream.standard_normal(axes.shape[1:3]) for stream in streams])
    return np.einsum("trij,trj->tri", axes, drawn)


def draw_conditions(robot: Mechanism, readings: FloatArray, seed: Seed) -> FloatArray:
    """Return readings (n, a) with conditions drawn from their ranges, for all trials the same."""
    out, stream = np.array(readings), make_random_stream(seed, 0, CONDITIONS)
    for i, actuator in enumerate(robot.actuators):
        if actuator.reference is not None and actuator.stroke is not None:
            out[:, i] = stream.uniform(*actuator.stroke, len(out))
    if not robot.is_elastic:
        return out
    load, wrench = robot.assembly.load, np.tile(robot.assembly.load.wrench, (len(out), 1))
    for name, ends in load.ranges.items():
        wrench[:, FORCES.index(name)] = stream.uniform(*ends, len(out))
    return load_readings(robot, robot.values[None], out[None], wrench)[0]


def _draw_setup(
    nuisance: NuisanceParameters, stated: Mapping[str, float], trials: int, seed: Seed
) -> FloatArray:
    """Return true values (t | 1, U) of setup parameters: the `stated` ones, else of priors."""
    table = nuisance.table
    is_drawn = table.free & ~np.isnan(table.tolerance)
    is_drawn &= np.array([name not in stated for name in table.names], dtype=bool)
    if not is_drawn.any():
        return table.nominal[None]
    streams = (make_random_stream(seed, trial, SETUP) for trial in range(trials))
    draws = np.stack([stream.standard_normal(len(table)) for stream in streams])
    return table.nominal + np.where(is_drawn, table.tolerance, 0.0) * draws


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
    """Measure commanded poses on one machine, at its true values: trial 0 of `simulate_trials`.

    Raises
    ------
    DataError : the controller or the true machine does not reach a pose.
    """
    how = (controller, nuisance_values, reading_sigma, NO_DISTURBANCE, pose_names)
    trials = simulate_trials(robot, robot.values[None], poses, instrument, seed, *how)
    failed = ~trials.reached[0]
    refuse_first(
        failed,
        lambda i: (
            f"the true machine does not reach pose {name_pose(i, *pose_names)} with the readings "
            f"of the controller ({failed.sum()} of {len(failed)} poses fail). Choose poses further "
            "inside the workspace, or smaller errors"
        ),
    )
    return trials.trial(0)


def replace_measured_values(
    robot: Mechanism, data: Measurements, instrument: Instrument, seed: int
) -> Measurements:
    """Return measurements with simulated values of the true `robot` in place of theirs, at their
    readings; those of redundant actuators are simulated, too.

    instrument : a sensor with its noise for each of `data.all_observations`, in their order.
    """
    nominal = forward(robot.nominal, data.readings)
    refuse_first(
        ~nominal.converged,
        lambda i: (
            f"{robot.name} does not reach pose {data.labels[i]!r} with its readings "
            f"({nominal.explain(i)}). Correct the readings"
        ),
    )
    sensors = tuple(
        replace(sensor, rows=rows.rows, session=rows.session, group=rows.group)
        for sensor, rows in zip(instrument.sensors, data.all_observations, strict=True)
    )
    how = {"controller": robot.nominal, "reading_sigma": data.reading_sigma}
    measuring = Instrument(sensors, data.stated_values)
    measured = simulate(robot, nominal.T, measuring, seed, **how)
    filled = replace(
        data, observations=measured.observations, base_observations=measured.base_observations
    )
    if not robot.has_redundant_readings:
        return filled
    # redundant actuators of the true machine cannot all have the readings of the controller
    return replace(filled, readings=measured.readings, reading_sigma=measured.reading_sigma)


def _record_readings(
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


def simulate_contacts(
    robot: Mechanism, sheet: Measurements, instrument: Instrument, seed: int
) -> Measurements:
    """Return measurements of planes and lines with the readings at which a true machine touches.

    robot : at its true values; its nominal ones are those of the controller.
    sheet : rows of planes and lines; its readings are those of the commanded poses, its missing
        gaps are zero.
    instrument : a sensor for each of `sheet.observations`; its noise is that of the contacts.
    DataError : another kind of rows, a machine that cannot move in x, y and z, or points that it
        cannot bring to their surfaces.
    """
    other = [o.kind.name for o in sheet.observations if not isinstance(o.kind, Plane | Line)]
    if other:
        raise DataError(
            f"rows of the kind {other[0]!r} have no readings. Simulation without readings is for "
            "points on planes and lines"
        )
    missing = [name for name in POSITION if name not in robot.controlled]
    if missing:
        raise DataError(
            f"points on planes and lines need a robot that controls "
            f"{', '.join(missing)}, unlike {robot.name}"
        )
    filled = tuple(
        replace(o, measured=np.nan_to_num(np.where(o.present, o.measured, 0.0)))
        for o in sheet.observations
    )
    sheet = replace(sheet, observations=filled)
    generator = make_random_stream(seed, 0)
    noise = [
        sensor.noise.draw(generator, len(rows))
        for sensor, rows in zip(instrument.sensors, sheet.observations, strict=True)
    ]
    names = robot.controlled
    places = [names.index(name) for name in POSITION]
    commanded = read_coordinates(forward(robot.nominal, sheet.readings).T, names)
    q, T = _command(robot, commanded, sheet)
    values = _place_surfaces(sheet, T)
    limit = EXACT * min(float(np.min(sensor.noise.sigma)) for sensor in instrument.sensors)
    largest = np.inf
    for _ in range(STEPS):
        rows = evaluate_measurements(sheet, T[None], values[None])
        shift, largest = _correct_positions(sheet, rows, noise)
        if largest <= limit:
            recorded, sigma = _record_readings(robot, q[None], sheet.reading_sigma, 1, seed)
            readings = q if recorded is None else recorded[0]
            return replace(sheet, readings=readings, reading_sigma=sigma)
        commanded[:, places] += shift
        q, T = _command(robot, commanded, sheet)
    raise DataError(
        f"{robot.name} does not bring all points to their surfaces: a gap of {largest:.3g} m is "
        f"open after {STEPS} corrections. Simulate smaller errors"
    )


def _command(
    robot: Mechanism, commanded: FloatArray, sheet: Measurements
) -> tuple[FloatArray, FloatArray]:
    """Return readings (n, a) and true poses (n, 4, 4) at commanded coordinates (n, c)."""
    controller = inverse(robot.nominal, commanded)
    true = forward(robot, controller.q)
    refuse_first(
        ~(controller.converged & true.converged),
        lambda i: (
            f"{robot.name} does not reach pose {sheet.labels[i]!r} "
            f"({(true if controller.converged[i] else controller).explain(i)}). Simulate smaller "
            "errors, or plan the points closer to the middle of the workspace"
        ),
    )
    return controller.q, true.T


def _place_surfaces(sheet: Measurements, T: FloatArray) -> FloatArray:
    """Return values (U,) of unknown surfaces, moved parallel to the first point of each group."""
    nuisance = sheet.nuisance_parameters
    values = nuisance.values()
    rows = evaluate_measurements(sheet, T[None], values[None], nuisance)
    for o, evaluated, indices in zip(sheet.observations, rows, nuisance.indices, strict=True):
        names = [parameter.name for parameter in o.kind.nuisance_parameters]
        shifts = [i for i, name in enumerate(names) if name.rpartition(".")[2] in OFFSETS]
        if not shifts:
            continue
        _, first = np.unique(indices[:, shifts[0]], return_index=True)
        values[indices[first][:, shifts]] += evaluated.residual[0, first]
    return values


def _correct_positions(
    sheet: Measurements, rows: tuple[EvaluatedRows, ...], noise: list[FloatArray]
) -> tuple[FloatArray, float]:
    """Return the least shifts (n, 3) [m] that close the gaps up to noise, and the largest gap."""
    poses = np.concatenate([np.repeat(r.poses[:, 0], r.residual.shape[2]) for r in rows])
    along = np.concatenate([r.jacobian[0, :, 0, :, 3:].reshape(-1, 3) for r in rows])
    gaps = [r.residual[0] - drawn for r, drawn in zip(rows, noise, strict=True)]
    gap = np.concatenate([each.ravel() for each in gaps])
    shift = np.zeros((sheet.n_poses, 3))
    for pose in np.unique(poses):
        is_of_pose = poses == pose
        shift[pose] = np.linalg.lstsq(along[is_of_pose], -gap[is_of_pose], rcond=None)[0]
    return shift, float(np.abs(gap).max(initial=0.0))
