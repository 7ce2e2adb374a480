# SPDX-License-Identifier: Apache-2.0
"""Rows of pose groups of a machine with redundant actuators, whose readings are measurements, too.

Redundant readings contradict each other by their errors, so that the pose is an unknown: its m
freedoms u. The rows of a group are

    [ W G Y | W F | 0       ]    measured values, by the twist G and by the setup parameters F
    [ Q_u/s | 0   | Q_p/s   ]    readings of sigma s, which close every limb

by (u, setup parameters, machine). What is left of them once u is eliminated is what the group
contributes. The fit eliminates poses in the same way; see docs/theory/uncertain-readings.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.information import ObservedPoses
from loopcal.estimate.poses.coordinates import TwistCoordinates
from loopcal.estimate.poses.states import PoseStates
from loopcal.measure import Gaussian, Instrument, Sensor, make_readings_kind, resolve_reading_sigma
from loopcal.mechanism import Mechanism, forward_trials
from loopcal.numerics.column_elimination import eliminate_columns
from loopcal.typing import FloatArray


def add_redundant_readings(instrument: Instrument, robot: Mechanism) -> Instrument | None:
    """Return the instrument with the readings of redundant actuators as one more sensor.

    None where the robot has none, or states no sigma of its readings.

    Raises
    ------
    DataError
        Some readings of redundant actuators are stated to be exact.
    """
    if robot.program.sigma is None or resolve_reading_sigma(robot, None, 1) is None:
        return None
    readings = Sensor(make_readings_kind(robot), Gaussian(robot.stated_sigma))
    return Instrument((*instrument.sensors, readings))


def observe_groups(
    free: FreeParameters, readings: FloatArray, joints: Iterable[str], size: int
) -> ObservedPoses:
    """Return poses of groups of `size` poses each, with their freedoms as further parameters.

    Parameters
    ----------
    readings : (N size, a) of the groups, one after the other. joints : names of joints that kinds
        look at.

    Returns
    -------
    Poses with p + size m columns: behind those of the machine are the m freedoms of the first pose
    of the group, then of the second.
    """
    names = tuple(dict.fromkeys([*joints, *(a.name for a in free.robot.actuators)]))
    values = free.robot.values[None]
    coordinates = TwistCoordinates(free, names)
    state = forward_trials(free.robot, values, readings[None])
    closed = coordinates.close(values, PoseStates(state, readings[None]), follow=True)
    poses = coordinates.linearize(values, closed, np.arange(len(readings)))
    assert poses.by_coordinates is not None
    place = np.arange(len(readings)) % size
    slopes: Mapping[str, FloatArray] = {
        name: _append_freedoms(
            poses.joints_by_parameters[name], poses.joints_by_coordinates[name], place, size
        )
        for name in names
    }
    by_parameters = _append_freedoms(poses.by_parameters, poses.by_coordinates, place, size)
    extended = replace(poses, by_parameters=by_parameters, joints_by_parameters=slopes)
    return ObservedPoses(free, closed.q[0], extended)


def _append_freedoms(
    by_parameters: FloatArray, by_freedoms: FloatArray, place: np.ndarray, size: int
) -> FloatArray:
    """Return derivatives (1, n, .., p + size m): those by the m freedoms of a pose are at its place
    (n,) in the group, and zero at the places of the others.
    """
    is_own = place[:, None] == np.arange(size)
    own = is_own.reshape(1, len(place), *[1] * (by_freedoms.ndim - 3), size, 1)
    spread = by_freedoms[..., None, :] * own
    return np.concatenate([by_parameters, spread.reshape(*by_freedoms.shape[:-1], -1)], axis=-1)


def eliminate_freedoms(rows: FloatArray, count: int) -> FloatArray:
    """Return what is left of the rows (N, r, c) of groups without their last `count` columns.

    (N, r - count, c - count) where the rows determine the freedoms of every pose, as redundant
    readings do; else (N, r, c - count).
    """
    kept, freedoms = np.split(rows, [rows.shape[2] - count], axis=2)
    nothing = np.zeros((*rows.shape[:2], 1))  # residuals, which a plan does not have
    done = eliminate_columns(np.concatenate([freedoms, kept, nothing], axis=2), count)
    first = count if done.is_observable.all() else 0
    return done.rest[:, first:, :-1]
