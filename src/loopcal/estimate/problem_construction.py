# SPDX-License-Identifier: Apache-2.0
"""Construction of a problem: from the measurements of one machine, or of many simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.nuisance.elimination import plan_elimination
from loopcal.estimate.observation_rows import BLOCK, ObservationRows
from loopcal.estimate.poses.consistent import LOOSE, ConsistentPoses, select_mixing_rows
from loopcal.estimate.poses.exact import ExactPoses
from loopcal.estimate.problem import Problem
from loopcal.measure import (
    Kind,
    Measurements,
    NuisanceParameters,
    collect_nuisance_parameters,
    list_sensed_joints,
    make_readings_kind,
    resolve_reading_sigma,
)
from loopcal.measure.base_rows import anchor_rows
from loopcal.measure.whitening import compute_whitener
from loopcal.mechanism import Mechanism
from loopcal.numerics.gauss_newton import Halving
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.estimate.poses.coordinates import PoseCoordinates
    from loopcal.measure import Sensor, Trials

POSE_CONTROL = Halving(attempts=10, stuck=1e-3)
"""Control of the iteration to uncertain poses, which may lie at the end of their reach."""

UNKNOWN_READING = 1e-3
"""Unit of a reading that was not taken: this share of the robot's size, or this many radians. It
has no row."""


def problem_of(
    free: FreeParameters, data: Measurements, stated: NuisanceParameters | None = None
) -> Problem:
    """Return the problem of one machine's measurements.

    Where readings have a sigma above 0, poses are unknowns, too. `stated` are the nuisance
    parameters of the measurements, default as stated there.
    """
    nuisance = data.nuisance_parameters if stated is None else stated
    rows = tuple(
        ObservationRows(
            o.kind,
            anchor_rows(o, data.observations) if o.kind.is_of_base else o.rows,
            o.measured[None],
            o.whitener[None],
            nuisance.indices[i],
            nuisance.factor(i),
        )
        for i, o in enumerate(data.all_observations)
        if len(o)
    )
    return make_problem(
        free, data.readings[None], data.reading_sigma, rows, 1, nuisance, lambda _: data
    )


def problem_of_trials(free: FreeParameters, trials: Trials) -> Problem:
    """Return the problem of t simulated machines."""
    sensors, first = trials.instrument.sensors, trials.trial(0)
    local = collect_nuisance_parameters(first.all_observations, first.labels)
    order = sorted(range(len(sensors)), key=lambda i: sensors[i].kind.is_of_base)  # stable
    rows = []
    for i, (number, o) in enumerate(zip(order, first.all_observations, strict=True)):
        sensor, measured = sensors[number], trials.measured[number]
        kind, places, factor = sensor.kind, local.indices[i], local.factor(i)
        white = _compute_whiteners(sensor, measured)
        poses = anchor_rows(o, first.observations) if kind.is_of_base else sensor.assigned_rows
        rows.append(ObservationRows(kind, poses, measured, white, places, factor))
    recorded = trials.readings[None] if trials.recorded is None else trials.recorded
    return make_problem(
        free, recorded, trials.reading_sigma, tuple(rows), len(trials), local, trials.trial
    )


def _compute_whiteners(sensor: Sensor, measured: FloatArray) -> FloatArray:
    """Return the whiteners (t | 1, r, m, m) of the rows of a sensor, one set where those of all
    trials are equal.
    """
    kind, step = sensor.kind, max(1, BLOCK // max(1, measured.shape[1]))
    batches = [measured[first : first + step] for first in range(0, len(measured), step)]
    first = _list_noise(kind, batches[0][:1])
    if all(_is_equal(_list_noise(kind, batch), first) for batch in batches):
        batches = [batches[0][:1]]
    white = []
    for batch in batches:  # so that what they are computed with stays small
        N, present = _list_noise(kind, batch)
        covariance = (N * np.asarray(sensor.noise.sigma) ** 2) @ np.swapaxes(N, -1, -2)
        t, r, m = present.shape
        flat = np.broadcast_to(covariance, (t, r, m, m)).reshape(-1, m, m)
        whitener = compute_whitener(flat, present.reshape(-1, m), np.ones(t * r))
        white.append(whitener.reshape(t, r, m, m))
    return np.concatenate(white)


def _list_noise(kind: Kind, measured: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return by what noise changes the columns, and which residuals exist, of trials (t, ..)."""
    return kind.linearize_noise(measured), kind.detect_present(measured)


def _is_equal(noise: tuple[FloatArray, BoolArray], first: tuple[FloatArray, BoolArray]) -> bool:
    """Return whether all trials have the noise of the first one."""
    return all(
        np.array_equal(a[:1], b) and (not a.strides[0] or bool((a == b).all()))
        for a, b in zip(noise, first, strict=True)
    )


def make_problem(
    free: FreeParameters,
    recorded: FloatArray,
    sigma: FloatArray | None,
    rows: tuple[ObservationRows, ...],
    trials: int,
    local: NuisanceParameters,
    data: Callable[[int], Measurements],
) -> Problem:
    """Return the problem of observed rows at readings (t | 1, n, actuators) [SI].

    `sigma` (n, actuators) [SI] of the readings; None where they are exact unless the robot states
    the sigma of its actuators.
    """
    numbers, robot = np.arange(trials), free.robot
    believed = resolve_reading_sigma(robot, sigma, recorded.shape[1])
    consistent = _plan_consistent_poses(free, recorded, believed, rows, numbers, data)
    if believed is None:
        nuisance = plan_elimination(local, rows)
        return Problem(free, recorded[:1], rows, numbers, nuisance, data, consistent=consistent)
    uncertain = _make_uncertain(free, recorded, believed, rows, numbers, data)
    nuisance = plan_elimination(local, rows, uncertain.member)
    return replace(uncertain, nuisance=nuisance, consistent=consistent)


def _make_uncertain(
    free: FreeParameters,
    recorded: FloatArray,
    sigma: FloatArray,
    rows: tuple[ObservationRows, ...],
    numbers: IntArray,
    data: Callable[[int], Measurements],
) -> Problem:
    """Return the problem with uncertain readings, before nuisance parameters are eliminated."""
    from loopcal.estimate.poses.components import find_components
    from loopcal.estimate.poses.coordinates import ReadingCoordinates, TwistCoordinates

    all_rows, robot = (*rows, _reading_rows(free, recorded, sigma)), free.robot
    names = list_sensed_joints(r.kind for r in all_rows)
    if robot.program.sigma is None:
        scale = np.where(np.isinf(sigma), UNKNOWN_READING * _reading_units(robot), sigma)
        coordinates: PoseCoordinates = ReadingCoordinates(free, scale, names)
    else:
        coordinates = TwistCoordinates(free, names)
    return Problem(
        free,
        recorded,
        all_rows,
        numbers,
        None,
        data,
        control=POSE_CONTROL,
        sigma=sigma,
        member=find_components(recorded.shape[1], all_rows, coordinates.freedoms),
        coordinates=coordinates,
    )


def _plan_consistent_poses(
    free: FreeParameters,
    recorded: FloatArray,
    sigma: FloatArray | None,
    rows: tuple[ObservationRows, ...],
    numbers: IntArray,
    data: Callable[[int], Measurements],
) -> ConsistentPoses | None:
    """Return poses that follow the rows of kinds that mix their components; None without any."""
    mixing = select_mixing_rows(rows)
    if not mixing:
        return None
    loose = np.broadcast_to(LOOSE * _reading_units(free.robot), recorded.shape[1:])
    if sigma is not None:
        loose = np.where(np.isinf(sigma), np.inf, loose)
    problem = _make_uncertain(free, recorded, loose, mixing, numbers, data)
    assert not isinstance(problem.poses, ExactPoses)
    return ConsistentPoses(problem.poses, recorded)


def _reading_units(robot: Mechanism) -> FloatArray:
    """Return the units (actuators,) of readings [SI]: the size of the robot, or a radian."""
    return np.array(
        [robot.size if a.dimension is Dimension.LENGTH else 1.0 for a in robot.actuators]
    )


def _reading_rows(free: FreeParameters, recorded: FloatArray, sigma: FloatArray) -> ObservationRows:
    """Return the rows of uncertain readings, (true - recorded) / sigma."""
    is_row = np.isfinite(sigma) & (sigma > 0.0)
    weight = np.where(is_row, 1.0 / np.where(is_row, sigma, 1.0), 0.0)
    white = weight[None, :, :, None] * np.eye(sigma.shape[1])
    return ObservationRows(make_readings_kind(free.robot), np.arange(len(sigma)), recorded, white)
