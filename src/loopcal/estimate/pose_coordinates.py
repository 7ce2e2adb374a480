# SPDX-License-Identifier: Apache-2.0
"""The k >= 0 coordinates of each pose, in which it moves while the loops stay closed.

A pose of exact readings has none: the kinematics determine it. A pose of uncertain readings moves
with its readings or, where there are more actuators than freedoms, with the platform. A pose that
was measured in full has none either, where closure is linearized there and not solved.

A pose of uncertain readings begins at its recorded reading. Where a reading is missing or not
believed, the pose begins where its rows measure it in full; otherwise the missing reading is that
of the nearest pose in the list, that of home, or one of a few values across the stroke, whichever
fits the rows best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal import engine, geometry
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import (
    LinearizedPoses,
    PoseStates,
    linearize_closure,
    linearize_poses,
    mask_unreached,
    scale_parameters,
    spread_states,
)
from loopcal.estimate.observation_rows import ObservationRows, whiten
from loopcal.mechanism.actuation import DrivenJoints, differentiate_at_pose, solve_at_pose
from loopcal.mechanism.assembly import Actuator
from loopcal.mechanism.inverse import inverse_trials
from loopcal.mechanism.kinematics import compute_readings, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import differentiate_by_coordinates, inverse
from loopcal.mechanism.states import Status
from loopcal.numerics.decomposition import are_nonzero
from loopcal.numerics.elimination import eliminate_columns
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

LONGEST_STEP = 0.25
"""Longest step of a reading, as a share of its stroke, or of a pose, as a share of the robot's
size. Beyond it closure is not linear."""


class PoseCoordinates:
    """Coordinates of n poses; these have none, because their readings are exact.

    free : the free parameters. names : joints that kinds look at.
    readings : (1, n, actuators) [SI] exact ones; those of states come first where they have any.

    count : number k of each pose.
    are_shared : whether trials of equal parameters have equal poses.
    rows_of_readings : number of kinds, the last ones, whose rows depend on coordinates alone.
    scale, longest : unit of the coordinates [SI], and their longest step (k,) that is about linear.
    """

    count = 0
    are_shared = True
    rows_of_readings = 0
    scale: FloatArray = np.ones(0)
    longest: FloatArray = np.ones(0)

    def __init__(self, free: FreeParameters, names: tuple[str, ...], readings: FloatArray) -> None:
        self.free: FreeParameters = free
        self.names: tuple[str, ...] = names
        self.readings: FloatArray = readings

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which coordinates (n, k) of some poses may move."""
        return np.ones((len(poses), self.count), dtype=bool)

    def first_states(self, trials: IntArray) -> PoseStates:
        """Return the states with which the poses of trials (t,) begin: home."""
        n = self.readings.shape[1]
        state = spread_states(self.free.robot.home_state, len(trials), n)
        return PoseStates(state, np.zeros((len(trials), n, 0)))

    def readings_at(self, poses: IntArray) -> FloatArray:
        """Return the exact readings (1, m, actuators) of poses (m,)."""
        is_all = len(poses) == self.readings.shape[1]
        return self.readings if is_all else self.readings[:, poses]

    def close(
        self,
        values: FloatArray,
        poses: IntArray,
        begin: PoseStates | None,
        follow: bool,
        driven: DrivenJoints | None = None,
    ) -> PoseStates:
        """Solve closure of poses (m,) at parameter values (a, p) from states (a, m), keeping what u
        moves. `follow` tells whether a pose that Newton does not solve is followed along a path,
        `driven` are joints that these readings drive, where they are known.
        """
        if not self.are_shared:
            assert begin is not None
            return self.close_from(values, begin, follow)
        robot, state = self.free.robot, None if begin is None else begin.state
        q = self.readings_at(poses)
        state = forward_trials(robot, values, q, state, follow, driven=driven)
        return PoseStates(state, np.zeros((len(state.T), len(poses), 0)))

    def close_from(self, values: FloatArray, begin: PoseStates, follow: bool) -> PoseStates:
        """Solve closure where trials do not share poses; measured ones stay as they are."""
        del values, follow
        return begin

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the largest share (a, n), at most 1, of steps u (a, n, k) that is about linear."""
        return 1.0 / np.maximum(np.abs(u * self.scale) / self.longest, 1.0).max(2, initial=1.0)

    def move(self, states: PoseStates, u: FloatArray) -> PoseStates:
        """Move all poses by u (a, n, k), without solving closure."""
        del u
        return states

    def linearize(
        self, values: FloatArray, states: PoseStates, poses: IntArray, by_parameters: bool = True
    ) -> LinearizedPoses:
        """Linearize closed poses (m,) by parameters and coordinates.

        Derivatives may be left out where those by parameters are not needed.
        """
        q = states.q if states.q.shape[2] else self.readings_at(poses)
        if by_parameters or self.count:
            scale = self.scale[poses] if self.count else None
            return linearize_poses(self.free, values, q, states.state, self.names, scale)
        none = np.zeros((*states.state.T.shape[:2], 6, 0))
        unmasked = LinearizedPoses(states.state.T, np.zeros(0, dtype=bool), none)
        return mask_unreached(self.free, self.names, q, states.state, unmasked)


class MeasuredPoses(PoseCoordinates):
    """Poses that were measured in full, at which closure is linearized and not solved.

    T : (T | 1, n, 4, 4) [m] of every trial.
    """

    are_shared = False

    def __init__(
        self, free: FreeParameters, names: tuple[str, ...], readings: FloatArray, T: FloatArray
    ) -> None:
        super().__init__(free, names, readings)
        self.T = T

    def first_states(self, trials: IntArray) -> PoseStates:
        """Return the measured poses of trials (t,)."""
        home = super().first_states(trials)
        T = self.T if len(self.T) == 1 else self.T[trials]
        T = np.broadcast_to(T, (len(trials), *T.shape[1:]))
        return replace(home, state=replace(home.state, T=T))

    def linearize(
        self, values: FloatArray, states: PoseStates, poses: IntArray, by_parameters: bool = True
    ) -> LinearizedPoses:
        """Linearize the loop closure."""
        del by_parameters
        return linearize_closure(self.free, values, self.readings_at(poses), states.state.T)


class ReadingCoordinates(PoseCoordinates):
    """As many actuators as freedoms: u moves the readings, in units of their sigma.

    scale : (n, actuators) [SI]; 0 of exact readings.
    """

    are_shared = False
    rows_of_readings = 1

    def __init__(self, free: FreeParameters, names: tuple[str, ...], scale: FloatArray) -> None:
        super().__init__(free, names, np.zeros((1, 0, 0)))
        self.scale: FloatArray = scale
        self.count: int = scale.shape[1]
        strokes = [stroke_of(free.robot, a) for a in free.robot.actuators]
        self.longest: FloatArray = LONGEST_STEP * np.array(strokes)

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which readings (n, actuators) are not exact."""
        return self.scale[poses] > 0.0

    def close_from(self, values: FloatArray, begin: PoseStates, follow: bool) -> PoseStates:
        """Solve the forward kinematics."""
        state = forward_trials(self.free.robot, values, begin.q, begin.state, follow)
        return PoseStates(state, begin.q)

    def move(self, states: PoseStates, u: FloatArray) -> PoseStates:
        """Move the readings."""
        return replace(states, q=states.q + self.scale * u)


class TwistCoordinates(PoseCoordinates):
    """More actuators than freedoms: u moves the platform in its freedoms, turns in units of 1 m
    over the robot's size.

    EstimationError
        An actuator drives several limbs, so that the pose does not determine its reading.
    """

    are_shared = False

    def __init__(self, free: FreeParameters, names: tuple[str, ...]) -> None:
        super().__init__(free, names, np.zeros((1, 0, 0)))
        robot = free.robot
        drives = np.concatenate([g.actuator[g.actuator >= 0] for g in robot.program.groups])
        if len(drives) != robot.program.n_joints:
            raise EstimationError.of("poses.shared-actuators", robot=robot.name)
        self.places: list[int] = list(robot.program.freedoms)
        self.count: int = len(self.places)
        self.scale: FloatArray = np.array([1.0 / robot.size] * 3 + [1.0] * 3)[self.places]
        self.longest: FloatArray = (
            LONGEST_STEP * np.array([1.0] * 3 + [robot.size] * 3)[self.places]
        )

    def close_from(self, values: FloatArray, begin: PoseStates, follow: bool) -> PoseStates:
        """Solve the inverse kinematics of every limb."""
        del follow
        robot = self.free.robot
        return PoseStates(*solve_at_pose(robot, values, begin.state.T, begin.state, begin.q))

    def move(self, states: PoseStates, u: FloatArray) -> PoseStates:
        """Move the platform."""
        twist = np.zeros((*u.shape[:2], 6))
        twist[..., self.places] = u * self.scale
        T = geometry.apply_twist(states.state.T, twist)
        return replace(states, state=replace(states.state, T=T))

    def linearize(
        self, values: FloatArray, states: PoseStates, poses: IntArray, by_parameters: bool = True
    ) -> LinearizedPoses:
        """Linearize: the pose depends on u alone, readings and passive joints on u and z."""
        del poses, by_parameters
        robot, shape = self.free.robot, states.q.shape[:2]
        Y = np.zeros((*shape, 6, self.count))
        Y[..., self.places, range(self.count)] = self.scale
        moves = differentiate_at_pose(robot, values, states.q, states.state)
        slopes, turns = {}, {}
        joints = (
            ([a.name for a in robot.actuators], moves.readings),
            (list(moves.names), moves.passive),
        )
        for names, (by_parameter, by_freedom) in joints:
            for i, name in enumerate(names):
                if name in self.names:
                    slopes[name] = scale_parameters(self.free, by_parameter[:, :, i])
                    turns[name] = by_freedom[:, :, i] * self.scale
        unmasked = LinearizedPoses(
            states.state.T,
            np.zeros(0, dtype=bool),
            np.zeros((*shape, 6, len(self.free.places))),
            joints_by_parameters=slopes,
            by_coordinates=Y,
            joints_by_coordinates=turns,
        )
        return mask_unreached(self.free, self.names, states.q, states.state, unmasked)


def stroke_of(robot: Mechanism, actuator: Actuator) -> float:
    """Return the stroke of an actuator [m or rad]; without one the robot's size, or a radian."""
    if actuator.stroke is None:
        return robot.size if actuator.dimension is Dimension.LENGTH else 1.0
    return actuator.stroke[1] - actuator.stroke[0]


# Poses that rows measure in full, without readings.

POSE_STEPS = 30
"""Gauss-Newton steps, at most. A position takes one, an orientation four."""

LONGEST_MEASURED_STEP = 0.5
"""Longest step, as a share of the robot's size."""

NEGLIGIBLE_STEP = 1e-6
"""Step, as a share of the size, at which a pose is found: a search begins there, no more."""

FULL_RANK = 1e-6
"""Smallest singular value of the whitened rows, columns of length one, relative to the largest,
with which they determine all freedoms."""


def measure_poses(
    robot: Mechanism, rows: Sequence[ObservationRows], trial: IntArray, pose: IntArray
) -> tuple[FloatArray, BoolArray]:
    """Return where the rows of k poses, of these trials and numbers (k,), put the platform (k, 4,
    4), and which poses (k,) they determine in full; T has no meaning for the others.

    Rows that use nuisance parameters, compare poses, or look at joints are passed over.
    """
    usable, is_found = _usable_rows(rows, pose), np.zeros(len(pose), dtype=bool)
    T, active, state = np.tile(robot.home, (len(pose), 1, 1)), np.arange(len(pose)), None
    for _ in range(POSE_STEPS + 1 if usable else 0):
        if not active.size:
            break
        parts = [
            _whitened_rows(r, places[active], trial[active], T[active]) for r, places in usable
        ]
        residual, by_twist = (np.concatenate([part[i] for part in parts], axis=1) for i in (0, 1))
        closed, slope, is_closed, state = _linearize_freedoms(robot, T[active], state)
        stacked = np.concatenate([by_twist @ slope, residual[..., None]], axis=2)
        count = slope.shape[-1]
        found = eliminate_columns(np.pad(stacked, ((0, 0), (0, count), (0, 0))), count)
        is_full = np.asarray(are_nonzero(found.singular_values, FULL_RANK).all(axis=1))
        step = np.where(is_full[:, None], -found.solution[..., 0], 0.0)
        length, longest = np.linalg.norm(step, axis=1), LONGEST_MEASURED_STEP * robot.size
        step *= np.minimum(1.0, longest / np.maximum(length, longest))[:, None]
        twist = np.matmul(slope, step[..., None])[..., 0]
        T[active] = geometry.apply_twist(closed, twist)
        is_last = is_full & is_closed & (length < NEGLIGIBLE_STEP * robot.size)
        is_found[active] = is_last
        goes_on = is_full & ~is_last
        state = state if goes_on.all() and len(active) == len(pose) else None
        active = active[goes_on]
    return T, is_found


def _linearize_freedoms(
    robot: Mechanism, T: FloatArray, state: engine.State | None
) -> tuple[FloatArray, FloatArray, BoolArray, engine.State | None]:
    """Return closed poses (k, 4, 4) next to T, the twists (6, f) or (k, 6, f) by what the platform
    can do there, which poses are closed, and their states.
    """
    is_closed = np.ones(len(T), dtype=bool)
    if set(robot.controlled) == set(robot.freedoms) or len(robot.controlled) == 6:
        slope = np.diag([1.0 / robot.size] * 3 + [1.0] * 3)[:, robot.program.freedoms]
        return T, slope, is_closed, None
    target = read_coordinates(T[None], robot.controlled)
    state = inverse_trials(robot, robot.values[None], target, state)
    slope = differentiate_by_coordinates(robot, robot.values[None], state)[0]
    is_closed = np.asarray(state.status[0] == Status.CONVERGED)
    return np.where(is_closed[:, None, None], state.T[0], T), slope, is_closed, state


def _usable_rows(
    rows: Sequence[ObservationRows], pose: IntArray
) -> list[tuple[ObservationRows, IntArray]]:
    """Return the kinds whose rows need nothing but a pose, and their rows (k, c) of k > 0 poses."""
    usable = [
        r
        for r in rows
        if not r.nuisance.shape[1]
        and r.kind.poses_per_row == 1
        and not (r.kind.sensed_joints or r.kind.is_of_base)
        and len(r.poses)
    ]
    return [(r, _rows_of_poses(r, pose)) for r in usable]


def _rows_of_poses(rows: ObservationRows, pose: IntArray) -> IntArray:
    """Return the rows (k, c) that observed each of k poses, -1 where there are fewer than c."""
    order = np.argsort(rows.poses, kind="stable")
    count = np.bincount(rows.poses, minlength=pose.max() + 1)
    nth = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    table = np.full((len(count), count.max()), -1)
    table[rows.poses[order], nth] = order
    return table[pose]


def _whitened_rows(
    observed: ObservationRows, rows: IntArray, trial: IntArray, T: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return whitened residuals (k, c m) of rows (k, c) at poses T (k, 4, 4), and their derivatives
    (k, c m, 6) by the twist.
    """
    k, c = rows.shape
    measured, white = (
        array[np.where(len(array) > 1, trial, 0)[:, None], np.maximum(rows, 0)]
        for array in (observed.measured, observed.whitener)
    )
    evaluated = observed.kind.evaluate(
        np.repeat(T, c, axis=0)[None], measured.reshape(1, k * c, -1)
    )
    white = np.where(rows[..., None, None] >= 0, white, 0.0)
    m = white.shape[-1]
    residual = whiten(white, evaluated.residual.reshape(k, c, m))
    jacobian = np.matmul(white, evaluated.jacobian.reshape(k, c, m, 6))
    return residual.reshape(k, c * m), jacobian.reshape(k, c * m, 6)


TRIED = 9
"""Values of a missing reading, evenly across its stroke, that are tried."""


def first_poses(
    robot: Mechanism,
    recorded: FloatArray,
    sigma: FloatArray,
    rows: Sequence[ObservationRows],
    trials: int,
) -> PoseStates:
    """Return where the poses of all trials begin, at the robot's present values.

    `recorded` (t | 1, n, actuators) is NaN where a reading was not taken, `sigma` (n, actuators) is
    infinite where one is not believed.
    """
    missing = np.isnan(recorded) | np.isinf(sigma)
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    q = _fill_from_nearest(recorded, home)
    begin = PoseStates(spread_states(robot.home_state, len(q), q.shape[1]), q)
    if missing.any():
        trial, pose = np.nonzero(missing.any(axis=2))
        T, is_full = measure_poses(robot, rows, trial, pose)
        if is_full.any():
            solution = inverse(robot, T[is_full])
            good = solution.closed
            chosen = (trial[is_full][good], pose[is_full][good])
            own = np.where(missing[chosen], solution.q[good], begin.q[chosen])
            state = map_arrays(lambda array: array[0, good], solution.state)
            begin = begin.put_poses(*chosen, PoseStates(state, own))
        if robot.redundancy is None and not is_full.all():
            where = (trial[~is_full], pose[~is_full])
            begin = _begin_at_best_reading(robot, begin, missing, recorded, rows, where)
    if robot.redundancy is not None:
        begin = _solve_redundant(robot, begin)
    if len(q) < trials:
        begin = begin.take(np.zeros(trials, dtype=np.int64))
    return begin


def _begin_at_best_reading(
    robot: Mechanism,
    begin: PoseStates,
    missing: BoolArray,
    recorded: FloatArray,
    rows: Sequence[ObservationRows],
    where: tuple[IntArray, IntArray],
) -> PoseStates:
    """Return starts with poses (trials, poses) at the best of a few values of missing readings.

    The values are those of the nearest pose, of home, and across the stroke. Readings that were all
    recorded, if not believed, come first.
    """
    trial, pose = where
    is_recorded = np.asarray(np.isfinite(recorded[trial, pose]).all(axis=1))
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    width = np.array([stroke_of(robot, a) for a in robot.actuators])
    low = np.array(
        [
            h - w / 2 if a.stroke is None else a.stroke[0]
            for a, h, w in zip(robot.actuators, home, width, strict=True)
        ]
    )
    across = low + width * ((np.arange(TRIED) + 0.5) / TRIED)[:, None]
    own = begin.q[trial, pose][:, None]
    others = np.concatenate([home[None], across])
    tried = np.concatenate([own, np.where(missing[trial, pose][:, None], others, own)], axis=1)
    count = tried.shape[1]
    flat = tried.reshape(1, -1, len(home))
    state = forward_trials(robot, robot.values[None], flat, follow=False)
    closed = np.asarray(state.status[0] == Status.CONVERGED)
    T = np.where(closed[:, None, None], state.T[0], robot.home)
    each = np.repeat(trial, count), T
    squares = np.zeros(len(T))
    for r, places in _usable_rows(rows, np.repeat(pose, count)):
        squares = squares + (_whitened_rows(r, places, *each)[0] ** 2).sum(axis=1)
    squares = np.where(closed, squares, np.inf).reshape(-1, count)
    squares[is_recorded & np.isfinite(squares[:, 0]), 0] = -1.0
    best = squares.argmin(axis=1)
    good = np.isfinite(squares.min(axis=1))
    pick = (np.arange(len(pose)) * count + best)[good]
    chosen = map_arrays(lambda array: array[0, pick], state)
    q = tried[np.flatnonzero(good), best[good]]
    return begin.put_poses(trial[good], pose[good], PoseStates(chosen, q))


def _fill_from_nearest(recorded: FloatArray, home: FloatArray) -> FloatArray:
    """Return readings (t, n, a); a missing one is that of the nearest pose that has it, or home."""
    is_known = np.isfinite(recorded)
    n = recorded.shape[1]
    index = np.arange(n)[None, :, None]
    before = np.maximum.accumulate(np.where(is_known, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(is_known, index, 2 * n)[:, ::-1], axis=1)[:, ::-1]
    near = np.where((before >= 0) & (index - before <= after - index), before, after)
    far = np.where(near < n, near, before)
    nearest = np.take_along_axis(recorded, np.clip(far, 0, n - 1), axis=1)
    filled = np.where((far >= 0) & np.isfinite(nearest), nearest, home)
    return np.where(is_known, recorded, filled)


def _solve_redundant(robot: Mechanism, begin: PoseStates) -> PoseStates:
    """Return poses of redundant readings by their weighted least squares.

    A pose where that fails begins at the nearest pose where it does not.
    """
    state = forward_trials(robot, robot.values[None], begin.q, begin.state)
    good = np.asarray(state.status == Status.CONVERGED)
    n = good.shape[1]
    numbers = np.where(good, np.arange(n, dtype=np.float64), np.nan)[..., None]
    near = _fill_from_nearest(numbers, np.full(1, np.nan))[..., 0]
    is_known = np.isfinite(near)
    pick = np.where(is_known, near, 0.0).astype(np.int64)
    trial = np.arange(len(good))[:, None]

    def chosen(solved: np.ndarray, first: np.ndarray) -> np.ndarray:
        spread = is_known.reshape(*is_known.shape, *[1] * (solved.ndim - 2))
        return np.where(spread, solved[trial, pick], first)

    placed = map_arrays(chosen, state, begin.state)
    return PoseStates(replace(placed, status=np.zeros_like(placed.status)), begin.q)
