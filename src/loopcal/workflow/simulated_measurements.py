# SPDX-License-Identifier: Apache-2.0
"""Simulate a calibration's measurements: draw a true machine, command poses, measure them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.measure import (
    Instrument,
    Measurements,
    check_strokes,
    find_outside_strokes,
    replace_measured_values,
    sample_truth,
    simulate,
    simulate_contacts,
)
from loopcal.mechanism import Mechanism, forward, inverse, resolve_poses
from loopcal.typing import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedMeasurements:
    """Measurements of a simulated machine, that machine, and names of poses that were skipped."""

    data: Measurements
    truth: Mechanism
    skipped: tuple[str, ...] = ()


def simulate_measurements(
    robot: Mechanism,
    instrument: Instrument,
    poses: ArrayLike | int = 40,
    *,
    draw_errors: bool = False,
    reading_sigma: ArrayLike | None = None,
    labels: Sequence[str] = (),
    places: Sequence[str] = (),
    seed: int = 1,
    skip_unreachable: bool = False,
) -> SimulatedMeasurements:
    """Command a robot to poses by its nominal geometry, and measure where the true machine goes.

    Parameters
    ----------
    robot : its values are those of the true machine, its nominal values those of the controller.
    poses : (n, c) controlled coordinates [m, rad], or how many to draw from the workspace.
    draw_errors : draw the true machine from the tolerances instead.
    reading_sigma : (a,) [SI] noise of the recorded readings; None as the robot states.
    labels : (n,) names of the poses, which are numbered without them.
    places : (n,) places of the poses such as `poses.csv:12`, for messages.
    seed : of poses, errors and noise.
    skip_unreachable : leave out poses outside the reach or the strokes of the nominal or the true
        machine, and name them in the result. Poses without names keep their numbers.

    Raises
    ------
    MechanismError, DataError : the robot states no workspace, or a pose is outside its reach or
        strokes, with `skip_unreachable` every pose.
    """
    truth = draw_true_machine(robot, seed) if draw_errors else robot
    targets = resolve_poses(truth.nominal, poses, seed)
    skipped: tuple[str, ...] = ()
    if skip_unreachable:
        is_kept = find_reachable_poses(truth, targets)
        numbers = labels or tuple(str(i + 1) for i in range(len(targets)))
        skipped = tuple(name for name, keep in zip(numbers, is_kept, strict=True) if not keep)
        if len(skipped) == len(targets):
            raise DataError(
                f"{robot.name} reaches none of {len(targets)} poses; correct the poses or the "
                "strokes in the robot file"
            )
        if skipped:
            targets, kept = targets[is_kept], np.flatnonzero(is_kept).tolist()
            labels, places = [numbers[i] for i in kept], [places[i] for i in kept if places]
    names = (labels, places)
    data = simulate(truth, targets, instrument, seed, reading_sigma=reading_sigma, pose_names=names)
    if labels:
        data = replace(data, labels=tuple(labels))
    check_strokes(data, truth, places=dict(enumerate(places)))
    return SimulatedMeasurements(data, truth, skipped)


def find_reachable_poses(truth: Mechanism, targets: FloatArray) -> BoolArray:
    """Return which coordinates (n, c) nominal and true machine reach, inside the strokes (n,)."""
    commanded = inverse(truth.nominal, targets)
    reached = forward(truth, commanded.q, commanded).converged
    inside = ~find_outside_strokes(commanded.q, truth).any(axis=1)
    return commanded.converged & reached & inside


def fill_in_measurements(
    robot: Mechanism,
    sheet: Measurements,
    instrument: Instrument,
    *,
    draw_errors: bool = False,
    seed: int = 1,
) -> SimulatedMeasurements:
    """Simulate the measured values of a planned data sheet; the other arguments as above."""
    truth = draw_true_machine(robot, seed) if draw_errors else robot
    return SimulatedMeasurements(replace_measured_values(truth, sheet, instrument, seed), truth)


def fill_in_contacts(
    robot: Mechanism,
    sheet: Measurements,
    instrument: Instrument,
    *,
    draw_errors: bool = False,
    seed: int = 1,
) -> SimulatedMeasurements:
    """Simulate the readings of a planned sheet of planes and lines, whose readings are those of the
    commanded poses; the other arguments as above.
    """
    truth = draw_true_machine(robot, seed) if draw_errors else robot
    data = simulate_contacts(truth, sheet, instrument, seed)
    check_strokes(data, truth)
    return SimulatedMeasurements(data, truth)


def draw_true_machine(robot: Mechanism, seed: int) -> Mechanism:
    """Return a robot whose values are drawn from its tolerances."""
    return robot.with_values(sample_truth(robot, 1, seed)[0])


def predict_noise_free(
    robot: Mechanism,
    instrument: Instrument,
    poses: ArrayLike | int = 40,
    *,
    reading_sigma: ArrayLike | None = None,
    labels: Sequence[str] = (),
    places: Sequence[str] = (),
    seed: int = 1,
) -> Measurements:
    """Return what an instrument would measure of the robot as it is, to analyze its data.

    Parameters
    ----------
    poses : (n, c) controlled coordinates [m, rad], or how many to draw from the workspace.
    labels, places : (n,) names of the poses, and their places, for messages. seed : of the poses.
    """
    targets, names = resolve_poses(robot, poses, seed), (labels, places)
    return simulate(
        robot, targets, instrument, 0, robot, reading_sigma=reading_sigma, pose_names=names
    )
