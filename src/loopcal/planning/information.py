# SPDX-License-Identifier: Apache-2.0
"""Information of measurements not yet made: whitened rows of pose groups, prior, and prediction.

A group is what is measured together: one pose, or the poses that one row of the instrument
compares. Its rows are in tolerances of the machine's free parameters, behind the columns of the
nuisance parameters of the instrument, which all groups share (frames, targets, one surface). The
prediction is the pose of the tool all over the workspace,

    d tool = (size * rotation, displacement)      [m]

without the rigid motions of a frame that no measurement of this instrument determines: the frame
then is the one that the estimate defines. Derivations: docs/theory/identification.md,
docs/theory/gauge.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np

from loopcal.apply.accuracy import transport
from loopcal.diagnose import find_frame_motions
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.information import observe_poses, observe_rows
from loopcal.measure import (
    Instrument,
    Measurements,
    NuisanceParameters,
    Observations,
    collect_nuisance_parameters,
    list_sensed_joints,
)
from loopcal.mechanism import Solution
from loopcal.numerics.decomposition import Decomposition, decompose
from loopcal.numerics.elimination import eliminate_from_factor
from loopcal.numerics.triangular_factor import empty_factor, fold_rows
from loopcal.planning.design import PriorInformation, is_allowed
from loopcal.planning.pose_combinations import (
    MOST,
    add_informative_groups,
    count_poses_per_group,
    list_groups,
)
from loopcal.typing import FloatArray, IntArray

BLOCK = 256
"""Groups whose rows are computed at once."""


@dataclass(frozen=True, eq=False)
class GroupRows:
    """Rows of N groups of poses.

    Attributes
    ----------
    rows : (N, r, o + p) whitened, machine columns in tolerances; NaN where a pose is not reached.
    members : (N, k) indices of the poses of each group.
    nuisance : names of the o nuisance parameters of the instrument.
    nuisance_prior : (o, o + p) rows of their stated tolerances.
    """

    rows: FloatArray
    members: IntArray
    nuisance: tuple[str, ...]
    nuisance_prior: FloatArray


def linearize_candidate_groups(
    free: FreeParameters, instrument: Instrument, readings: FloatArray, rng: np.random.Generator
) -> GroupRows:
    """Return the rows of all groups that a plan may choose from.

    Where the instrument compares poses and there are too many combinations, half of the groups are
    drawn and half are made of the most informative poses.

    Parameters
    ----------
    readings : (n, a) of the candidate poses [m, rad].

    Raises
    ------
    DataError
        See `list_groups`.
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
    free: FreeParameters, instrument: Instrument, readings: FloatArray, members: IntArray
) -> GroupRows:
    """Return the rows of groups with these members (N, k), at readings (n, a) of all poses."""
    mounted = instrument.with_tool(free.robot)
    nuisance = _list_nuisance(mounted, members[:1])
    blocks = [
        _linearize_block(free, mounted, readings, members[i : i + BLOCK])
        for i in range(0, len(members), BLOCK)
    ]
    stated = nuisance.table.free & ~np.isnan(nuisance.table.tolerance)
    weight = np.where(stated, 1.0 / np.where(stated, nuisance.table.tolerance, 1.0), 0.0)
    prior = np.concatenate([np.diag(weight), np.zeros((len(nuisance), len(free)))], axis=1)
    return GroupRows(np.concatenate(blocks), members, nuisance.table.names, prior)


def combine_prior(
    free: FreeParameters, groups: GroupRows, measured: FloatArray | None = None
) -> PriorInformation:
    """Return the information before the first new pose: tolerances and earlier measurements.

    Only stated tolerances of the robot and of the instrument count.

    Parameters
    ----------
    measured : (p, p) factor of earlier measurements, their nuisance parameters eliminated (the
        instrument was set up anew since).
    """
    o, p = len(groups.nuisance), len(free)
    stated = PriorInformation(np.eye(o + p)[o:][~free.assumed], o)
    prior = stated.with_rows(groups.nuisance_prior)
    if measured is None:
        return prior
    return prior.with_rows(np.concatenate([np.zeros((len(measured), o)), measured], axis=1))


def decompose_information(
    free: FreeParameters, groups: GroupRows, measured: FloatArray | None = None
) -> Decomposition:
    """Return the decomposition of all that could be measured, without tolerances of the machine.

    The nuisance parameters are eliminated.

    Parameters
    ----------
    measured : as for `combine_prior`.
    """
    o, p = len(groups.nuisance), len(free)
    factor = empty_factor(1, o + p)
    allowed = groups.rows[is_allowed(groups.rows)]
    flat = np.concatenate([allowed.reshape(-1, o + p), groups.nuisance_prior])
    factor = fold_rows(factor, np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)[None])
    factor = eliminate_from_factor(factor, o)
    if measured is not None:
        factor = fold_rows(factor, np.concatenate([measured, np.zeros((p, 1))], axis=1)[None])
    return decompose(factor, np.full(1, len(flat)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Derivatives of the tool's pose at k poses of the workspace.

    Attributes
    ----------
    rotations, displacements : (k, 3, p) derivatives of its rotation [rad] and displacement [m] by
        the parameters in tolerances.
    size : makes rotations comparable with displacements [m].
    frames : names of the frames whose rigid motions are left out.
    """

    rotations: FloatArray
    displacements: FloatArray
    size: float
    frames: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.displacements)

    @property
    def position(self) -> FloatArray:
        """Rows (3 k, p) of positions [m]."""
        return self.displacements.reshape(-1, self.displacements.shape[2])

    @property
    def orientation(self) -> FloatArray:
        """Rows (3 k, p) of orientations [rad]."""
        return self.rotations.reshape(-1, self.rotations.shape[2])

    @property
    def pose(self) -> FloatArray:
        """Rows (6 k, p) of poses [m], rotations times size."""
        return np.concatenate([self.size * self.orientation, self.position])


def linearize_prediction(
    free: FreeParameters, solution: Solution, observable: Decomposition
) -> Prediction:
    """Return how the tool's pose depends on the parameters.

    Parameters
    ----------
    solution : the poses to predict. observable : of `decompose_information`.
    """
    poses = observe_poses(free, solution.q)
    tool_twists = transport(free.robot, poses.T[0], "base", "tool") @ poses.twists[0]
    used, V = observable.used[0], observable.directions[0]
    variance = np.where(used, 1.0, np.where(free.assumed.any(), np.inf, 1.0))
    posterior = Posterior(free.robot, free.places, free.tolerance, V, variance, used)
    motions = find_frame_motions(posterior)
    # P removes rigid motions of frames from a deviation and leaves the rest as it is
    P = V[:, used] @ V[:, used].T + motions.kept @ V[:, ~used].T
    kept = tool_twists[poses.is_reached] @ P
    return Prediction(kept[:, :3], kept[:, 3:], free.robot.size, motions.frames)


def _list_nuisance(mounted: Instrument, members: IntArray) -> NuisanceParameters:
    """Return the nuisance parameters of the instrument."""
    count = int(members.max()) + 1
    sensors = tuple(
        replace(sensor, rows=rows).assign_rows(count)
        for sensor, rows in _assign_poses(mounted, members)
    )
    return collect_nuisance_parameters(sensors, tuple(str(i) for i in range(count)))  # pyright: ignore[reportArgumentType]


def _assign_poses(mounted: Instrument, members: IntArray) -> list[tuple]:
    """Return each sensor with the poses of its rows, group by group."""
    return [(s, members.ravel() if s.kind.poses_per_row == 1 else members) for s in mounted.sensors]


def _linearize_block(
    free: FreeParameters, mounted: Instrument, readings: FloatArray, members: IntArray
) -> FloatArray:
    """Return the rows (b, r, o + p) of some groups."""
    poses, places = np.unique(members, return_inverse=True)
    places = places.reshape(members.shape)
    observed = observe_poses(
        free, readings[poses], list_sensed_joints(sensor.kind for sensor in mounted.sensors)
    )
    nuisance = _list_nuisance(mounted, places)
    observations, unusable = [], np.zeros(len(members), dtype=bool)
    for i, (sensor, rows) in enumerate(_assign_poses(mounted, places)):
        kind = sensor.kind
        values = (
            nuisance.select(i, nuisance.table.nominal[None]) if kind.nuisance_parameters else None
        )
        joints = (
            np.stack([observed.joints[name][:, rows] for name in kind.sensed_joints], axis=-1)
            if kind.sensed_joints
            else None
        )
        noise = np.zeros((1, len(rows), len(kind.noise_columns)))
        measured = kind.measure(observed.T[:, rows], noise, values, joints)[0]
        # what is undefined there, such as the direction from a point to itself
        undefined = [row for row, _ in kind.find_invalid_rows(measured)]
        unusable[[row * len(members) // len(rows) for row in undefined]] = True
        measured = np.where(np.isin(np.arange(len(rows)), undefined)[:, None], np.nan, measured)
        observations.append(
            Observations.from_sigma(kind, rows, measured, sensor.noise.sigma, "", "")
        )
    data = Measurements(free.robot.name, observed.readings, tuple(observations))
    whitened = observe_rows(observed, data, nuisance, nuisance.values())[0, :, :-1]
    counts = [len(part) * len(part.kind.noise_columns) for part in observations]
    pieces = np.split(whitened, np.cumsum(counts)[:-1])
    rows = np.concatenate(
        [piece.reshape(len(members), -1, whitened.shape[1]) for piece in pieces], axis=1
    )
    rows[unusable | ~observed.is_reached[places].all(axis=1)] = np.nan
    return rows
