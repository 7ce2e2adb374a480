# SPDX-License-Identifier: Apache-2.0
"""Pose groups that a plan chooses from: whitened rows of measurements not yet made, and the prior.

A group is what is measured together: one pose, or the poses that one row of the instrument
compares. Its rows are in spreads of the machine's free parameters, behind the columns of the
nuisance parameters of the instrument, which all groups share (frames, targets, one surface).

N poses make N (N - 1) / 2 pairs, too many to linearize where there are hundreds of poses. Then half
of the candidate pairs are drawn from all of them. The other half is made of the poses whose pairs
of the first half are most informative, by

    d = |x R^-1|^2,   R'R = sum x'x + 1,

the slope of log det for a row x where all rows count alike. A certificate then holds among the
candidate pairs. Derivations: docs/theory/identification.md, docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from loopcal import engine
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.information import ObservedPoses, observe_poses, observe_rows, unfixed_motions
from loopcal.estimate.linearization import PoseStates
from loopcal.estimate.pose_coordinates import TwistCoordinates
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters, collect_nuisance_parameters
from loopcal.measure.observations import Observations
from loopcal.measure.readings import list_sensed_joints, make_readings_kind, resolve_reading_sigma
from loopcal.mechanism.kinematics import forward_trials
from loopcal.numerics.decomposition import Decomposition, decompose, empty_factor
from loopcal.numerics.elimination import eliminate_columns, eliminate_from_factor
from loopcal.numerics.statistics import choose_evenly
from loopcal.planning import design_space
from loopcal.typing import FloatArray, IntArray

BLOCK = 256  # groups whose rows are computed at once
MOST = 5000  # largest number of candidate combinations: as many rows are computed in some seconds
ENOUGH = 100  # groups from which the motions of frames are found that no group determines
# Up to this many times the requested number all combinations are enumerated before drawing.
DENSE = 20


@dataclass(frozen=True, eq=False)
class GroupRows:
    """Rows of N groups of poses."""

    # (N, r, o + p) whitened, machine columns in spreads; NaN where a pose is not reached
    rows: FloatArray
    members: IntArray  # (N, k) indices of the poses of each group
    n_nuisance: int  # number o of nuisance parameters of the instrument
    # (b, o + p) rows of their stated spreads and of targets on the base, which do not depend
    # on the choice of poses
    nuisance_prior: FloatArray
    # number of stations: all groups from the first one, then from the second ..
    n_stations: int = 1

    def fold(self) -> tuple[FloatArray, int]:
        """Return the factor (1, p + 1, p + 1) of all that could be measured, without spreads of
        the machine and the nuisance parameters eliminated, and the number of its rows.
        """
        width = self.rows.shape[2]
        allowed = self.rows[design_space.is_allowed(self.rows)].reshape(-1, width)
        flat = np.concatenate([allowed, self.nuisance_prior])
        factor = engine.fold(empty_factor(1, width), with_zeros(flat))
        return eliminate_from_factor(factor, self.n_nuisance), len(flat)


def with_zeros(rows: FloatArray) -> FloatArray:
    """Return rows (m, c) with residuals of zero, which a plan does not have, (1, m, c + 1)."""
    return np.concatenate([rows, np.zeros((len(rows), 1))], axis=1)[None]


def _observe_groups(
    free: FreeParameters, readings: FloatArray, joints: Iterable[str], size: int
) -> ObservedPoses:
    """Return poses of groups of `size` poses each, for a machine with redundant actuators, whose
    readings are measurements, too.

    readings : (N size, a) of the groups, one after the other. joints : names of joints that kinds
        look at.
    The columns of the machine are followed by the m freedoms of the first pose of the group, then
    of the second: p + size m in all.
    """
    names = tuple(dict.fromkeys([*joints, *(a.name for a in free.robot.actuators)]))
    values = free.robot.values[None]
    coordinates = TwistCoordinates(free, names)
    state = forward_trials(free.robot, values, readings[None])
    begin, numbers = PoseStates(state, readings[None]), np.arange(len(readings))
    closed = coordinates.close(values, numbers, begin, follow=True)
    poses = coordinates.linearize(values, closed, numbers)
    assert poses.by_coordinates is not None
    is_own = (numbers % size)[:, None] == np.arange(size)  # the place of each pose in its group

    def append_freedoms(by_parameters: FloatArray, by_freedoms: FloatArray) -> FloatArray:
        """Return derivatives (1, n, .., p + size m): those by the m freedoms of a pose are at its
        place in the group, and zero at the places of the others.
        """
        own = is_own.reshape(1, len(readings), *[1] * (by_freedoms.ndim - 3), size, 1)
        spread = by_freedoms[..., None, :] * own
        return np.concatenate([by_parameters, spread.reshape(*by_freedoms.shape[:-1], -1)], axis=-1)

    slopes: Mapping[str, FloatArray] = {
        name: append_freedoms(poses.joints_by_parameters[name], poses.joints_by_coordinates[name])
        for name in names
    }
    by_parameters = append_freedoms(poses.by_parameters, poses.by_coordinates)
    extended = replace(poses, by_parameters=by_parameters, joints_by_parameters=slopes)
    return ObservedPoses(free, closed.q[0], extended)


def linearize_candidate_groups(
    free: FreeParameters, instrument: Instrument, readings: FloatArray, rng: np.random.Generator
) -> GroupRows:
    """Return the rows of all groups that a plan may choose from, at readings (n, a) of all poses.

    Of too many combinations, half are drawn and half made of the most informative poses.
    """
    n, k = len(readings), count_poses_per_group(instrument)
    most = MOST if k == 1 or comb(n, k) <= MOST else MOST // 2
    first = linearize_groups(free, instrument, readings, list_groups(n, instrument, rng, most))
    if most == MOST:
        return first
    further = add_informative_groups(first.rows, first.members, n, most, rng)
    if not len(further):
        return first
    more = linearize_groups(free, instrument, readings, further)
    return replace(
        first,
        rows=np.concatenate([first.rows, more.rows]),
        members=np.concatenate([first.members, further]),
    )


def linearize_groups(
    free: FreeParameters,
    instrument: Instrument,
    readings: FloatArray,
    members: IntArray,
    by_frames: bool = False,
) -> GroupRows:
    """Return the rows of groups with these members (N, k), at readings (n, a) of all poses.

    With `by_frames` the machine's columns are motions of frames, see `ObservedPoses.by_frames`.
    """
    mounted = instrument.with_tool(free.robot)
    nuisance = _list_nuisance(mounted, members[:1])
    blocks = [
        _linearize_block(free, mounted, readings, members[i : i + BLOCK], by_frames)
        for i in range(0, len(members), BLOCK)
    ]
    stated = nuisance.table.free & ~np.isnan(nuisance.table.tolerance)
    weight = np.where(stated, 1.0 / np.where(stated, nuisance.table.tolerance, 1.0), 0.0)
    rows = np.concatenate(blocks, axis=1)
    stations, rows = len(rows), rows.reshape(len(rows) * len(members), *rows.shape[2:])
    prior = np.zeros((len(nuisance), rows.shape[2]))
    prior[:, : len(nuisance)] = np.diag(weight)
    prior = np.concatenate([prior, _linearize_base(mounted, nuisance, rows.shape[2])])
    return GroupRows(rows, np.tile(members, (stations, 1)), len(nuisance), prior, stations)


def combine_prior(
    free: FreeParameters, groups: GroupRows, measured: FloatArray | None = None
) -> design_space.PriorInformation:
    """Return the information before the first new pose: stated spreads of the robot and of the
    instrument, and earlier measurements.

    measured : (p, p) factor of these, their nuisance parameters eliminated (the instrument was set
        up anew since).
    """
    o = groups.n_nuisance
    rows = free.prior_rows()
    stated = design_space.PriorInformation(
        np.concatenate([np.zeros((len(rows), o)), rows], axis=1), o
    )
    prior = stated.with_rows(groups.nuisance_prior)
    if measured is None:
        return prior
    return prior.with_rows(np.concatenate([np.zeros((len(measured), o)), measured], axis=1))


def decompose_information(groups: GroupRows, measured: FloatArray | None = None) -> Decomposition:
    """Return the decomposition of all that could be measured and of earlier measurements, as for
    `combine_prior`, without spreads of the machine.
    """
    factor, count = groups.fold()
    if measured is not None:
        factor = engine.fold(factor, with_zeros(measured))
    return decompose(factor, np.full(1, count))


def find_group_motions(
    free: FreeParameters, instrument: Instrument, readings: FloatArray, members: IntArray
) -> FloatArray:
    """Return the motions (12, k) of frames that measurements of these groups do not determine.

    readings : (n, a) of all poses. members : (N, k) of the groups; some of them are enough.
    """
    some = members[choose_evenly(len(members), ENOUGH)]
    groups = linearize_groups(free, instrument, readings, some, True)
    of_frames = groups.rows[design_space.is_allowed(groups.rows)][:, :, groups.n_nuisance :]
    return unfixed_motions(groups.fold()[0], float(np.linalg.norm(of_frames)))


def _list_nuisance(mounted: Instrument, members: IntArray) -> NuisanceParameters:
    """Return the nuisance parameters of the instrument."""
    count = int(members.max()) + 1
    assigned = _assign_poses(mounted, members)
    of_poses = (replace(sensor, rows=rows).assign_rows(count) for sensor, rows in assigned)
    sensors = (*of_poses, *_list_base_sensors(mounted))
    labels = tuple(str(i) for i in range(count))
    return collect_nuisance_parameters(sensors, labels, mounted.stated_values)


def _assign_poses(mounted: Instrument, members: IntArray) -> list[tuple[Sensor, IntArray]]:
    """Return each sensor of poses with the poses of its rows, group by group."""
    return [
        (s, np.repeat(members, s.kind.rows_per_pose) if s.kind.poses_per_row == 1 else members)
        for s in mounted.sensors
        if not s.kind.is_of_base
    ]


def _list_base_sensors(mounted: Instrument) -> tuple[Sensor, ...]:
    """Return the sensors that measure targets on the base, with their rows."""
    return tuple(s.assign_rows(1) for s in mounted.sensors if s.kind.is_of_base)


def _linearize_base(mounted: Instrument, nuisance: NuisanceParameters, width: int) -> FloatArray:
    """Return the whitened rows (b, width) of targets on the base: nuisance columns come first."""
    rows, sensors = [np.zeros((0, width))], _list_base_sensors(mounted)
    for sensor, number in zip(sensors, range(-len(sensors), 0), strict=True):
        kind, r = sensor.kind, len(sensor.assigned_rows)
        T = np.broadcast_to(np.eye(4), (1, r, 4, 4))
        values = nuisance.table.nominal[None][:, nuisance.indices[number]]
        measured = kind.measure(T, np.zeros((1, r, len(kind.noise_columns))), values)
        slopes = kind.evaluate(T, measured, values).nuisance
        if slopes is None:
            continue
        white = slopes[0] / sensor.noise.sigma[:, None]
        wide = np.zeros((*white.shape[:2], width))
        columns = np.broadcast_to(nuisance.indices[number][:, None, :], white.shape)
        np.put_along_axis(wide, columns, white, axis=-1)
        rows.append(wide.reshape(-1, width))
    return np.concatenate(rows)


def _linearize_block(
    free: FreeParameters,
    mounted: Instrument,
    readings: FloatArray,
    members: IntArray,
    by_frames: bool,
) -> FloatArray:
    """Return the rows (s, b, r, o + p) of some groups from s stations.

    Redundant readings with a stated sigma are measured, too. Where they determine the freedoms of
    every pose, the rows are those that remain after elimination of the freedoms.
    """
    robot, size = free.robot, members.shape[1]
    joints = list_sensed_joints(sensor.kind for sensor in mounted.sensors)
    is_redundant = (
        not by_frames
        and robot.redundancy is not None
        and resolve_reading_sigma(robot, None, 1) is not None
    )
    if is_redundant:
        read = Sensor(make_readings_kind(robot), Gaussian(robot.stated_sigma))
        mounted, places = (
            replace(mounted, sensors=(*mounted.sensors, read)),
            np.arange(members.size).reshape(members.shape),
        )
        observed = _observe_groups(free, readings[members.ravel()], joints, size)
    else:
        poses, places = np.unique(members, return_inverse=True)
        places = places.reshape(members.shape)
        observed = observe_poses(free, readings[poses], joints)
    nuisance = _list_nuisance(mounted, places)
    observations, unusable = [], np.zeros(len(members), dtype=bool)
    for i, (sensor, rows) in enumerate(_assign_poses(mounted, places)):
        kind = sensor.kind
        values = (
            nuisance.select(i, nuisance.table.nominal[None]) if kind.nuisance_parameters else None
        )
        joints = kind.stack_joints(observed.joints, rows)
        noise = np.zeros((1, len(rows), len(kind.noise_columns)))
        measured = kind.measure(observed.T[:, rows], noise, values, joints)
        setup = kind.nominal_values[None, None] if values is None else values
        measured = kind.hide_unseen(observed.T[:, rows], measured, setup)[0]
        # what is undefined there, such as the direction from a point to itself
        undefined = [row for row, _ in kind.find_invalid_rows(measured)]
        unusable[[row * len(members) // len(rows) for row in undefined]] = True
        measured = np.where(np.isin(np.arange(len(rows)), undefined)[:, None], np.nan, measured)
        observations.append(
            Observations.from_sigma(
                kind, rows, measured, sensor.noise.sigma, sight=sensor.noise.sight
            )
        )
    data = Measurements(robot.name, observed.readings, tuple(observations))
    columns = observed.by_frames() if by_frames else observed
    whitened = observe_rows(columns, data, nuisance, nuisance.values())[0, :, :-1]
    counts = [len(part) * len(part.kind.noise_columns) for part in observations]
    pieces = np.split(whitened, np.cumsum(counts)[:-1])
    by_group = [piece.reshape(len(members), -1, whitened.shape[1]) for piece in pieces]
    read = by_group[-1:] if is_redundant and mounted.has_stations else []
    views = [[v, *read] for v in by_group[: len(by_group) - len(read)]]
    views = views if mounted.has_stations else [by_group]
    rows = np.stack([np.concatenate(view, axis=1) for view in views])
    rows[:, unusable | ~observed.is_reached[places].all(axis=1)] = np.nan
    if not is_redundant:
        return rows
    stacked, rows = rows.shape[:2], rows.reshape(-1, *rows.shape[2:])
    count = size * len(robot.freedoms)
    kept, freedoms = np.split(rows, [rows.shape[2] - count], axis=2)
    nothing = np.zeros((*rows.shape[:2], 1))  # residuals, which a plan does not have
    done = eliminate_columns(np.concatenate([freedoms, kept, nothing], axis=2), count)
    rest = done.rest[:, count if done.is_observable.all() else 0 :, :-1]
    return rest.reshape(*stacked, *rest.shape[1:])


def count_poses_per_group(instrument: Instrument) -> int:
    """Return how many poses are measured together."""
    links = sorted({sensor.kind.poses_per_row for sensor in instrument.sensors} - {1})
    if len(links) > 1:
        raise DataError(
            f"kinds that compare {links[0]} and {links[1]} poses need separate plans. Plan "
            "one of them"
        )
    return links[0] if links else 1


def list_groups(
    poses: int, instrument: Instrument, rng: np.random.Generator, most: int = MOST
) -> IntArray:
    """Return members (N, k) of groups: each pose alone, or combinations, all or `most` drawn."""
    k = count_poses_per_group(instrument)
    if k == 1:
        return np.arange(poses)[:, None]
    if poses < k:
        raise DataError(
            f"this instrument compares {k} poses. Allowed: only {poses}. Relax a constraint"
        )
    return draw_combinations(np.arange(poses), k, most, rng)


def add_informative_groups(
    rows: FloatArray, members: IntArray, poses: int, most: int, rng: np.random.Generator
) -> IntArray:
    """Return members (M, k) of at most `most` further groups of the most informative poses.

    rows : (N, r, c) of groups, whitened and in spreads; NaN where not allowed.
    members : (N, k) their poses.
    """
    good, k, c = design_space.is_allowed(rows), members.shape[1], rows.shape[2]
    if not good.any():
        return members[:0]
    R = design_space.factor_rows(np.concatenate([np.eye(c), rows[good].reshape(-1, c)]))
    slopes = (design_space.divide_by_factor(rows[good], R) ** 2).sum(axis=(1, 2))
    best = np.zeros(poses)
    np.maximum.at(best, members[good].ravel(), np.repeat(slopes, k))
    count = k
    while count < poses and comb(count + 1, k) <= most:
        count += 1
    # in the order of their numbers, so that a combination is written in one way only
    informative = np.sort(np.argsort(-best, kind="stable")[:count])
    further = draw_combinations(informative, k, most, rng)
    # one number for each combination tells which of them are listed already
    places = float(poses) ** np.arange(further.shape[1])
    return further[~np.isin(further @ places, members @ places)]


def draw_combinations(poses: IntArray, k: int, most: int, rng: np.random.Generator) -> IntArray:
    """Return combinations (N, k) of k of the poses (n,): all, or `most` different ones."""
    n = len(poses)
    if comb(n, k) <= DENSE * most:
        indices = np.array(list(combinations(range(n), k)), dtype=np.int64).reshape(-1, k)
        if len(indices) > most:
            indices = indices[np.sort(rng.choice(len(indices), most, replace=False))]
        return poses[indices]
    draws = np.sort(rng.integers(0, n, (2 * most, k)), axis=1)
    draws = np.unique(draws[(np.diff(draws, axis=1) > 0).all(axis=1)], axis=0)
    return poses[draws[np.sort(rng.permutation(len(draws))[:most])]]
