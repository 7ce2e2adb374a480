# SPDX-License-Identifier: Apache-2.0
"""What an instrument would tell at poses not yet measured: whitened rows of units, and what is to
be predicted.

A unit is what is measured together: one pose, or the poses that one row of the instrument compares.
Its rows stand in tolerances of the machine's free parameters, behind the columns of the unknowns
that the instrument brings with it and that all units share (frames, targets, one surface). What is
to be predicted are the poses of the workspace,
    d tool = (size * rotation, displacement)      [m]
with motions of a frame as a whole left out that no measurement of this instrument can tell: the
frame then is the one that the estimate defines. Derivations: docs/theory/identification.md,
docs/theory/gauge.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np

from loopcal import engine
from loopcal.apply.accuracy import transport
from loopcal.diagnose import find_frame_motions
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.outlook import look, scene, without_own
from loopcal.measure import (
    Instrument,
    Measurements,
    NuisanceParameters,
    Observations,
    collect_nuisance_parameters,
    list_sensed_joints,
)
from loopcal.mechanism import Solution
from loopcal.numerics.decomposition import Decomposition, decompose, empty_factor
from loopcal.planning.compared import MOST, poses_in_unit, telling, units_of
from loopcal.planning.design import Start, allowed
from loopcal.typing import FloatArray, IntArray

BLOCK = 256
"""Units whose rows are made at once."""


@dataclass(frozen=True, eq=False)
class UnitRows:
    """Rows of N units.

    Attributes
    ----------
    rows : (N, r, o + p) whitened, machine's columns in tolerances; NaN where a pose is not reached.
    members : (N, k) numbers of the poses of each unit. own : names of the o unknowns of the
        instrument.
    prior : (o, o + p) rows of what is stated of them.
    """

    rows: FloatArray
    members: IntArray
    own: tuple[str, ...]
    prior: FloatArray


def considered(
    free: FreeParameters, instrument: Instrument, readings: FloatArray, rng: np.random.Generator
) -> UnitRows:
    """Return the rows of all units that a plan may choose from, at readings (n, a) of the
    candidates' poses.

    Where poses are compared and there are too many combinations, half are drawn and half made of
    the poses that tell most.

    Raises
    ------
    DataError
        See `units_of`.
    """
    n, k = len(readings), poses_in_unit(instrument)
    most = MOST if k == 1 or comb(n, k) <= MOST else MOST // 2
    first = unit_rows(free, instrument, readings, units_of(n, instrument, rng, most))
    if most == MOST:
        return first
    further = telling(first.rows, first.members, n, most, rng)
    if not len(further):
        return first
    rows = np.concatenate([first.rows, unit_rows(free, instrument, readings, further).rows])
    return replace(first, rows=rows, members=np.concatenate([first.members, further]))


def unit_rows(
    free: FreeParameters, instrument: Instrument, readings: FloatArray, members: IntArray
) -> UnitRows:
    """Return the rows of units at readings (n, a) of the candidates' poses; members (N, k) as of
    `units_of`.
    """
    mounted = instrument.with_tool(free.robot)
    local = _local(mounted, members[:1])
    parts = [
        _block(free, mounted, readings, members[i : i + BLOCK])
        for i in range(0, len(members), BLOCK)
    ]
    known = local.table.free & ~np.isnan(local.table.tolerance)
    weight = np.where(known, 1.0 / np.where(known, local.table.tolerance, 1.0), 0.0)
    prior = np.concatenate([np.diag(weight), np.zeros((len(local), len(free)))], axis=1)
    return UnitRows(np.concatenate(parts), members, local.table.names, prior)


def start_of(free: FreeParameters, rows: UnitRows, measured: FloatArray | None = None) -> Start:
    """Return what is known before: stated tolerances, what is stated of the instrument, and a
    factor of rows measured.

    Parameters
    ----------
    measured : (p, p) of earlier measurements, their own unknowns eliminated (the instrument was set
        up anew since).
    """
    o, p = len(rows.own), len(free)
    start = Start(np.eye(o + p)[o:][~free.assumed], o).plus(rows.prior)
    if measured is None:
        return start
    return start.plus(np.concatenate([np.zeros((len(measured), o)), measured], axis=1))


def knowable(
    free: FreeParameters, rows: UnitRows, measured: FloatArray | None = None
) -> Decomposition:
    """Return the decomposition of all that could be measured, without tolerances, own unknowns
    eliminated.
    """
    o, p = len(rows.own), len(free)
    factor = empty_factor(1, o + p)
    good = rows.rows[allowed(rows.rows)]
    flat = np.concatenate([good.reshape(-1, o + p), rows.prior])
    factor = engine.fold(factor, np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)[None])
    factor = without_own(factor, o)
    if measured is not None:
        factor = engine.fold(factor, np.concatenate([measured, np.zeros((p, 1))], axis=1)[None])
    return decompose(factor, np.full(1, len(flat)))


@dataclass(frozen=True, eq=False)
class Predicted:
    """What is to be predicted: the tool at k poses of the workspace.

    Attributes
    ----------
    turns, shifts : (k, 3, p) derivatives of its rotation [rad] and displacement [m] by the
        parameters in tolerances.
    size : makes turns comparable with shifts [m]. frames : whose motions as a whole are left out.
    """

    turns: FloatArray
    shifts: FloatArray
    size: float
    frames: tuple[str, ...]

    @property
    def position(self) -> FloatArray:
        """Rows (3 k, p) of positions [m]."""
        return self.shifts.reshape(-1, self.shifts.shape[2])

    @property
    def orientation(self) -> FloatArray:
        """Rows (3 k, p) of orientations [rad]."""
        return self.turns.reshape(-1, self.turns.shape[2])

    @property
    def pose(self) -> FloatArray:
        """Rows (6 k, p) of poses [m], turns times size."""
        return np.concatenate([self.size * self.orientation, self.position])


def predicted(free: FreeParameters, solution: Solution, seen: Decomposition) -> Predicted:
    """Return how poses of a solution depend on the parameters.

    Parameters
    ----------
    solution : the poses that are to be predicted. seen : of `knowable`.
    """
    at = scene(free, solution.q)
    moves = transport(free.robot, at.T[0], "base", "tool") @ at.twists[0]
    used, V = seen.used[0], seen.directions[0]
    variance = np.where(used, 1.0, np.where(free.assumed.any(), np.inf, 1.0))
    motions = find_frame_motions(
        Posterior(free.robot, free.places, free.tolerance, V, variance, used)
    )
    # P takes motions of frames out of a deviation, and leaves the rest as it is
    P = V[:, used] @ V[:, used].T + motions.kept @ V[:, ~used].T
    kept = moves[at.reached] @ P
    return Predicted(kept[:, :3], kept[:, 3:], free.robot.size, motions.frames)


def _local(mounted: Instrument, members: IntArray) -> NuisanceParameters:
    """Return the unknowns that the instrument brings with it."""
    looking = _looking(mounted, members)
    seen = tuple(
        replace(sensor, rows=rows).assign_rows(members.max() + 1) for sensor, rows in looking
    )
    return collect_nuisance_parameters(seen, tuple(str(i) for i in range(int(members.max()) + 1)))  # pyright: ignore[reportArgumentType]


def _looking(mounted: Instrument, members: IntArray) -> list[tuple]:
    """Return each sensor with the poses of its rows, unit by unit."""
    return [(s, members.ravel() if s.kind.poses_per_row == 1 else members) for s in mounted.sensors]


def _block(
    free: FreeParameters, mounted: Instrument, readings: FloatArray, members: IntArray
) -> FloatArray:
    """Return the rows (b, r, o + p) of some units."""
    poses, places = np.unique(members, return_inverse=True)
    places = places.reshape(members.shape)
    at = scene(free, readings[poses], list_sensed_joints(sensor.kind for sensor in mounted.sensors))
    local = _local(mounted, places)
    parts, useless = [], np.zeros(len(members), dtype=bool)
    for i, (sensor, rows) in enumerate(_looking(mounted, places)):
        kind = sensor.kind
        own = local.select(i, local.table.nominal[None]) if kind.nuisance_parameters else None
        joints = (
            np.stack([at.joints[name][:, rows] for name in kind.sensed_joints], axis=-1)
            if kind.sensed_joints
            else None
        )
        measured = kind.measure(
            at.T[:, rows], np.zeros((1, len(rows), len(kind.noise_columns))), own, joints
        )[0]
        # what cannot be measured there, such as the distance of a point from itself
        doubted = [row for row, _ in kind.find_invalid_rows(measured)]
        useless[[row * len(members) // len(rows) for row in doubted]] = True
        measured = np.where(np.isin(np.arange(len(rows)), doubted)[:, None], np.nan, measured)
        parts.append(Observations.from_sigma(kind, rows, measured, sensor.noise.sigma, "", ""))
    found = look(
        at, Measurements(free.robot.name, at.readings, tuple(parts)), local, local.values()
    )[0, :, :-1]
    counts = [len(part) * len(part.kind.noise_columns) for part in parts]
    pieces = np.split(found, np.cumsum(counts)[:-1])
    rows = np.concatenate(
        [piece.reshape(len(members), -1, found.shape[1]) for piece in pieces], axis=1
    )
    rows[useless | ~at.reached[places].all(axis=1)] = np.nan
    return rows
