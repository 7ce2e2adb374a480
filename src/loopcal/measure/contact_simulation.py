# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements by contact: the operator moves a machine until its points touch surfaces.

The readings are what is measured; the gaps were chosen. A controller commands a pose by its nominal
geometry, the true machine goes somewhere else, and the operator corrects the commanded position
until each gap is the stated one but for the noise. An unknown plane or line is where the first
point of its group is when the machine is commanded there.
"""

from dataclasses import replace

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.evaluation import EvaluatedRows, evaluate_measurements
from loopcal.measure.instrument import Instrument, make_random_stream
from loopcal.measure.kinds import Line, Plane
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import record_readings
from loopcal.mechanism import POSITION, Mechanism, forward, inverse, read_coordinates
from loopcal.typing import FloatArray

STEPS = 20
"""Corrections of a commanded position: each leaves the share by which the geometry is wrong."""

EXACT = 1e-6
"""Share of the noise to which a gap is reached."""


def simulate_contacts(
    robot: Mechanism, sheet: Measurements, instrument: Instrument, seed: int
) -> Measurements:
    """Return measurements of planes and lines with the readings at which a true machine touches.

    Parameters
    ----------
    robot : at its true values; its nominal ones are those of the controller.
    sheet : rows of planes and lines; its readings are those of the commanded poses, its missing
        gaps are zero.
    instrument : a sensor for each of `sheet.observations`; its noise is that of the contacts.
    seed : of the noise of contacts and of readings.

    Raises
    ------
    DataError
        Another kind of rows, a machine that cannot move in x, y and z, or points that it cannot
        bring to their surfaces.
    """
    _check_sheet(robot, sheet)
    sheet = _fill_gaps(sheet)
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
            return _record(robot, sheet, q, seed)
        commanded[:, places] += shift
        q, T = _command(robot, commanded, sheet)
    raise DataError(
        f"{robot.name} does not bring all points to their surfaces: a gap of {largest:.3g} m is "
        f"left after {STEPS} corrections; simulate smaller errors"
    )


def _check_sheet(robot: Mechanism, sheet: Measurements) -> None:
    """Refuse rows other than planes and lines, and a machine that does not move in x, y and z."""
    other = [o.kind.name for o in sheet.observations if not isinstance(o.kind, Plane | Line)]
    if other:
        raise DataError(
            f"rows of the kind {other[0]!r} state no readings; only points on planes and lines are "
            "simulated without readings"
        )
    missing = [name for name in POSITION if name not in robot.controlled]
    if missing:
        raise DataError(
            f"{robot.name} does not control {', '.join(missing)}, so that its points cannot be "
            "moved to planes and lines"
        )


def _fill_gaps(sheet: Measurements) -> Measurements:
    """Return the sheet with a gap of zero where none is stated."""
    filled = tuple(
        replace(o, measured=np.nan_to_num(np.where(o.present, o.measured, 0.0)))
        for o in sheet.observations
    )
    return replace(sheet, observations=filled)


def _command(
    robot: Mechanism, commanded: FloatArray, sheet: Measurements
) -> tuple[FloatArray, FloatArray]:
    """Return readings (n, a) and true poses (n, 4, 4) at commanded coordinates (n, c)."""
    controller = inverse(robot.nominal, commanded)
    true = forward(robot, controller.q)
    lost = np.flatnonzero(~(controller.converged & true.converged))
    if len(lost):
        first = int(lost[0])
        solution = true if controller.converged[first] else controller
        raise DataError(
            f"{robot.name} does not reach pose {sheet.labels[first]!r} "
            f"({solution.explain(first)}); simulate smaller errors, or plan the points closer to "
            "the middle of the workspace"
        )
    return controller.q, true.T


def _place_surfaces(sheet: Measurements, T: FloatArray) -> FloatArray:
    """Return the values (U,) of unknown surfaces: parallel to the stated ones, through the first
    point of each group.
    """
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


OFFSETS = ("height", "a", "b")
"""Parameters of a surface that move it along the residuals of its points, in their order."""


def _correct_positions(
    sheet: Measurements, rows: tuple[EvaluatedRows, ...], noise: list[FloatArray]
) -> tuple[FloatArray, float]:
    """Return the smallest displacements (n, 3) [m] that close the gaps up to their noise, and the
    largest gap.
    """
    gaps = [r.residual[0] - drawn for r, drawn in zip(rows, noise, strict=True)]
    poses = np.concatenate([np.repeat(r.poses[:, 0], r.residual.shape[2]) for r in rows])
    along = np.concatenate([r.jacobian[0, :, 0, :, 3:].reshape(-1, 3) for r in rows])
    gap = np.concatenate([each.ravel() for each in gaps])
    shift = np.zeros((sheet.n_poses, 3))
    for pose in np.unique(poses):
        is_of_pose = poses == pose
        shift[pose] = np.linalg.lstsq(along[is_of_pose], -gap[is_of_pose], rcond=None)[0]
    return shift, float(np.abs(gap).max(initial=0.0))


def _record(robot: Mechanism, sheet: Measurements, q: FloatArray, seed: int) -> Measurements:
    """Return the sheet with recorded readings."""
    recorded, sigma = record_readings(robot, q[None], sheet.reading_sigma, 1, seed)
    readings = q if recorded is None else recorded[0]
    return replace(sheet, readings=readings, reading_sigma=sigma)
