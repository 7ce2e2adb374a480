# SPDX-License-Identifier: Apache-2.0
"""Poses and rows, linearized at a deviation, and the warm start of the next linearization.

A start belongs to the deviations at which it was made. It predicts nuisance parameters at other
deviations to first order; poses begin where they were, which costs one Newton step more than their
prediction and none of the products with all parameters. It only chooses where iterations begin:
their results do not depend on it beyond rounding, as long as it is near.

At solved poses the pose and the joint values are linear functions of the scaled parameters z and,
where readings are uncertain, of the coordinates u in which a pose may move:

    twist = D dz + Y du,    joint = slope dz + turn du

For a row with residual r = predicted - measured, whitener W, and the kind's derivatives G by the
platform's twist, J by joint values and F by nuisance parameters, the whitened row is
[W (G Y + J turn) | W F | W (G D + J slope) | W r]. A row that compares poses has the sum over its
poses. This module is the only place where poses and rows are linearized.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal import engine, geometry
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.smooth_errors import SmoothErrors
from loopcal.measure.kinds.kind import Evaluation
from loopcal.measure.readings import select_joint_values
from loopcal.mechanism.actuation import DrivenJoints
from loopcal.mechanism.kinematics import drive_loops
from loopcal.mechanism.sensitivity import differentiate_pose, differentiate_sensed_values
from loopcal.mechanism.states import Status
from loopcal.numerics.elimination import without_rounding
from loopcal.numerics.trial_batch import TrialBatch, map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.estimate.elimination import EliminatedNuisance


@dataclass(frozen=True, eq=False)
class Start(TrialBatch):
    """Warm start of t trials.

    deviation : (t, p) where it was made.
    nuisance : (t, U) values of the nuisance parameters [SI]. slope : (t, U, p) their change.
    first_nuisance : (t, U) values with which the first linearization began.
    poses : states (t, n) of all poses; None where every solution begins at home.
    is_near : whether a linearization solved these poses, so that those at the next deviations are
        near and Newton's method need not follow a path to them.
    """

    deviation: FloatArray
    nuisance: FloatArray
    slope: FloatArray
    first_nuisance: FloatArray
    poses: PoseStates | None = None
    is_near: bool = False

    def __len__(self) -> int:
        return len(self.deviation)

    def predict_nuisance(self, deviation: FloatArray) -> FloatArray:
        """Return the nuisance parameters (t, U) at deviations (t, p), to first order."""
        change = deviation - self.deviation
        return self.nuisance + np.matmul(self.slope, change[..., None])[..., 0]

    def with_nuisance(self, values: FloatArray) -> Start:
        """Return this start with other nuisance parameters (t, U), which do not move."""
        values = np.broadcast_to(values, self.nuisance.shape)
        return replace(
            self, nuisance=values, first_nuisance=values, slope=np.zeros_like(self.slope)
        )


@dataclass(frozen=True, eq=False)
class Linearization(TrialBatch):
    """A problem of t trials at deviations z, nuisance parameters and poses eliminated.

    deviation : (t, p) z.
    factor : (t, p + 1, p + 1) triangular factor of the whitened rows [A | r] that are left.
    cost : (t,) sum of squares; infinite where a needed pose is not reached.
    equations : (t,) number of equations, less the directions of nuisance parameters and poses that
        the rows determine.
    next_start : warm start for a linearization nearby.
    nuisance : estimate of the nuisance parameters; None without any.
    poses : estimates of the poses; None where readings are exact.
    """

    deviation: FloatArray
    factor: FloatArray
    cost: FloatArray
    equations: IntArray
    next_start: Start
    nuisance: EliminatedNuisance | None = None
    poses: PoseEstimates | None = None


class LeverageRows(NamedTuple):
    """Whitened rows by everything that they determine, poses eliminated.

    poses : (k,) first pose of each set of rows. unknowns : (k, w) nuisance parameters that these
        move; no others are among the columns.
    rows : (k, m, w + p + 1). The first w columns are by standard normal variables in the place of
        these (`TreeElimination.roots`); the next p are those of the machine as the nuisance
        parameters follow it; the last are residuals.
    kind : number of the kind; -1 where they are of several. numbers : (k,) rows of the kind.
        columns : (k, m) which of its residuals they are.
    """

    poses: IntArray
    unknowns: IntArray
    rows: FloatArray
    kind: int
    numbers: IntArray
    columns: IntArray


@dataclass(frozen=True, eq=False)
class LinearizedPoses:
    """Poses of a batch of trials, with their derivatives. Leading axes are (a | 1, n).

    Where a pose is not reached T is the identity and all derivatives are zero.

    T : (a, n, 4, 4) T_base_platform [m]. is_reached : (a, n).
    by_parameters : (a, n, 6, p) twist by the scaled parameters; p = 0 where not asked for.
    joints : name -> (a, n) [SI]. joints_by_parameters : name -> (a, n, p), passive joints and
        those that move although readings are fixed.
    by_coordinates : (a, n, 6, k) twist by the coordinates of the pose.
    joints_by_coordinates : name -> (a, n, k).
    closure_step : (a, n, 6) Newton step of closure, where closure is linearized and not solved.
    """

    T: FloatArray
    is_reached: BoolArray
    by_parameters: FloatArray
    joints: Mapping[str, FloatArray] = field(default_factory=dict)
    joints_by_parameters: Mapping[str, FloatArray] = field(default_factory=dict)
    by_coordinates: FloatArray | None = None
    joints_by_coordinates: Mapping[str, FloatArray] = field(default_factory=dict)
    closure_step: FloatArray | None = None

    def with_errors(self, errors: SmoothErrors) -> LinearizedPoses:
        """Return the poses with the coefficients of errors of the poses as further parameters."""
        twists = np.where(self.is_reached[..., None, None], errors.twists(self.T), 0.0)
        slopes = {
            name: np.concatenate([slope, np.zeros((*slope.shape[:-1], errors.count))], axis=-1)
            for name, slope in self.joints_by_parameters.items()
        }
        by_parameters = np.concatenate([self.by_parameters, twists], axis=-1)
        return replace(self, by_parameters=by_parameters, joints_by_parameters=slopes)

    def is_lost(self, is_needed: BoolArray) -> BoolArray:
        """Return the trials (a,) in which a needed pose (n,) is not reached."""
        return np.asarray(np.any(~self.is_reached & is_needed, axis=1))


def scale_parameters(free: FreeParameters, by_parameter: FloatArray) -> FloatArray:
    """Return derivatives (.., p) by the free parameters in units of their tolerance."""
    p = by_parameter.shape[-1]
    columns = by_parameter[..., free.places] if len(free.places) < p else by_parameter
    return columns * free.tolerance


def linearize_poses(
    free: FreeParameters,
    values: FloatArray,
    q: FloatArray,
    state: engine.State,
    names: Sequence[str] = (),
    reading_scale: FloatArray | None = None,
) -> LinearizedPoses:
    """Linearize solved poses (a, n) at readings q by the implicit function theorem, with the named
    joints. With `reading_scale` (n, actuators) [SI] the coordinates of a pose are its readings in
    these units.
    """
    robot = free.robot
    solved = differentiate_pose(robot, values, q, state, free.columns)
    actuators = [actuator.name for actuator in robot.actuators]
    passive = [name for name in names if name not in actuators]
    slopes, turns, Y = {}, {}, None
    if reading_scale is not None:
        Y = solved.readings * reading_scale[:, None, :]
        unit = np.eye(len(actuators))
        turns = {n: unit[actuators.index(n)] * reading_scale[None] for n in names if n in actuators}
    if passive:
        moved = differentiate_sensed_values(robot, values, q, state, passive)
        for i, name in enumerate(passive):
            slopes[name] = scale_parameters(free, moved.parameters[:, :, i])
            if reading_scale is not None:
                turns[name] = moved.readings[:, :, i] * reading_scale
    poses = LinearizedPoses(
        state.T,
        np.zeros(0, dtype=bool),
        solved.parameters,
        joints_by_parameters=slopes,
        by_coordinates=Y,
        joints_by_coordinates=turns,
    )
    return mask_unreached(free, names, q, state, poses)


def linearize_closure(
    free: FreeParameters, values: FloatArray, readings: FloatArray, T: FloatArray
) -> LinearizedPoses:
    """Linearize the loop closure at given poses T (a, n, 4, 4), without solving it."""
    robot = free.robot
    loops, joints = drive_loops(robot, values, readings)
    state = loops.solve(joints, replace(robot.home_state, T=T), max_iterations=1)
    step = geometry.pose_difference(state.T, T)
    given_state = replace(state, T=T, status=np.zeros_like(state.status))
    D = differentiate_pose(robot, values, readings, given_state, free.columns).parameters
    ok = np.asarray(np.isfinite(step).all(axis=2) & np.isfinite(D).all(axis=(2, 3)))
    step, D = np.where(ok[..., None], step, 0.0), np.where(ok[..., None, None], D, 0.0)
    return LinearizedPoses(T, ok, D, closure_step=step)


def mask_unreached(
    free: FreeParameters,
    names: Sequence[str],
    q: FloatArray,
    state: engine.State,
    poses: LinearizedPoses,
) -> LinearizedPoses:
    """Complete linearized poses: joint values, which are reached, and zeros where one is not."""
    shape = state.T.shape[:2]
    Y, slopes, turns = poses.by_coordinates, poses.joints_by_parameters, poses.joints_by_coordinates
    derivatives = [poses.by_parameters, *slopes.values(), *turns.values()]
    derivatives += [] if Y is None else [Y, q]
    ok = np.asarray(state.status == Status.CONVERGED.value)
    for array in derivatives:
        if not np.isfinite(array.sum()):  # else no entry is infinite or NaN
            ok = ok & np.isfinite(array).all(axis=tuple(range(2, array.ndim)))
    values = select_joint_values(free.robot, tuple(names), q, state)

    def masked(array: np.ndarray) -> FloatArray:
        if ok.all():
            return array
        return np.where(ok.reshape(*ok.shape, *[1] * (array.ndim - 2)), array, 0.0)

    def spread(array: np.ndarray) -> FloatArray:
        return np.broadcast_to(masked(array), (*shape, array.shape[-1]))

    complete = LinearizedPoses(
        T=state.T if ok.all() else np.where(ok[..., None, None], state.T, np.eye(4)),
        is_reached=ok,
        by_parameters=masked(poses.by_parameters),
        joints={name: masked(value) for name, value in values.items()},
        joints_by_parameters={name: masked(slope) for name, slope in slopes.items()},
        by_coordinates=None if Y is None else masked(Y),
        joints_by_coordinates={name: spread(turn) for name, turn in turns.items()},
    )
    if free.errors is None or not complete.by_parameters.shape[-1]:
        return complete
    return complete.with_errors(free.errors)


class KindRows(NamedTuple):
    """Whitened rows of one kind.

    machine : (a, r, m, p + 1) by the scaled parameters, and the residual behind them; p = 0 where
        derivatives were not asked for.
    by_nuisance : (a, r, m, u) by the nuisance parameters that each row uses; None without any.
    by_coordinates : (a, r, links, m, k) by the coordinates of each linked pose; None where poses
        have none.
    evaluated : what they were made of, if it is known.
    """

    machine: FloatArray
    by_nuisance: FloatArray | None
    by_coordinates: FloatArray | None
    evaluated: Evaluation | None = None

    @property
    def residual(self) -> FloatArray:
        """(a, r, m)."""
        return self.machine[..., -1]

    @property
    def by_parameters(self) -> FloatArray:
        """(a, r, m, p)."""
        return self.machine[..., :-1]


def evaluate_rows(
    rows: ObservationRows, poses: LinearizedPoses, trials: IntArray, nuisance: FloatArray | None
) -> tuple[Evaluation, FloatArray]:
    """Return residuals and derivatives of a kind at poses, and its whiteners.

    `trials` (a,) are numbers of the rows' trials. `nuisance` (a, U) are values of the nuisance
    parameters.
    """
    measured, white = rows.take_trials(trials)
    T = poses.T
    if rows.rows_of_each != 1 or len(rows.poses) != T.shape[1]:
        T = T[:, rows.poses]
    T = np.broadcast_to(T, (len(trials), *T.shape[1:]))
    values = None
    if nuisance is not None and rows.nuisance.shape[1]:
        values = nuisance[:, rows.nuisance]
        values = values if rows.factor is None else values * rows.factor
    joints = rows.kind.stack_joints(poses.joints, rows.poses)
    if joints is not None:
        joints = np.broadcast_to(joints, (len(trials), *joints.shape[1:]))
    evaluated = rows.kind.evaluate(T, measured, values, joints)
    if rows.factor is not None and evaluated.nuisance is not None:
        evaluated = evaluated._replace(nuisance=evaluated.nuisance * rows.factor[:, None, :])
    return evaluated, white


def linearize_rows(
    rows: ObservationRows,
    poses: LinearizedPoses,
    trials: IntArray,
    nuisance: FloatArray | None,
    by_parameters: bool = True,
    evaluated: Evaluation | None = None,
) -> KindRows:
    """Return the whitened rows of a kind at linearized poses; arguments as of `evaluate_rows`.

    `evaluated` are its residuals and derivatives, where they are known already.
    """
    if evaluated is None:
        evaluated, white = evaluate_rows(rows, poses, trials, nuisance)
    else:
        _, white = rows.take_trials(trials)
    residual = evaluated.residual
    if poses.closure_step is not None:
        step = poses.closure_step[:, rows.poses, :, None]
        residual = residual + np.matmul(evaluated.jacobian, step)[..., 0]
    a, r, m = residual.shape
    by_nuisance = None
    if evaluated.nuisance is not None:
        whole = np.broadcast_to(evaluated.nuisance, (a, r, m, evaluated.nuisance.shape[-1]))
        by_nuisance = rows.whiten_columns(white, whole)
    machine = np.empty((a, r, m, 1 + (poses.by_parameters.shape[-1] if by_parameters else 0)))
    machine[..., -1] = rows.whiten(white, residual, trials)
    if by_parameters:
        _write_parameter_columns(rows, evaluated, white, poses, machine)
    return KindRows(
        machine,
        by_nuisance=by_nuisance,
        by_coordinates=None
        if poses.by_coordinates is None
        else _coordinate_columns(rows, evaluated, white, poses, poses.by_coordinates),
        evaluated=evaluated,
    )


def coordinate_derivative(jacobian: FloatArray, Y: FloatArray) -> FloatArray:
    """Return derivatives (a, r, m, k) of rows by the coordinates of a pose.

    They are zero where a row depends on a coordinate by rounding alone.
    """
    return without_rounding(np.matmul(jacobian, Y), np.matmul(np.abs(jacobian), np.abs(Y)))


def _write_parameter_columns(
    rows: ObservationRows,
    evaluated: Evaluation,
    white: FloatArray,
    poses: LinearizedPoses,
    machine: FloatArray,
) -> None:
    """Write whitened derivatives of a kind by the p scaled parameters to rows (a, r, m, p + 1)."""
    D, out = poses.by_parameters, machine[..., :-1]
    if rows.kind.poses_per_row > 1:
        np.matmul(white, np.matmul(evaluated.jacobian, D[:, rows.poses]).sum(axis=2), out=out)
        return
    by_twist, product = rows.whiten_columns(white, evaluated.jacobian), out
    n, count = D.shape[1], rows.rows_of_each
    if count and count * n == len(rows.poses):
        by_twist = by_twist.reshape(len(by_twist), n, -1, 6)
        product = machine.reshape(len(machine), n, -1, machine.shape[-1])[..., :-1]
    else:
        D = D[:, rows.poses]
    # one order of the products for any number of trials: each trial equals its own fit bit for bit
    np.matmul(by_twist, D, out=product)
    for j, name in enumerate(rows.kind.sensed_joints):
        if name in poses.joints_by_parameters and evaluated.joints is not None:
            slope = poses.joints_by_parameters[name][:, rows.poses, None, :]
            out += np.matmul(white, evaluated.joints[..., j, None] * slope)


def _coordinate_columns(
    rows: ObservationRows,
    evaluated: Evaluation,
    white: FloatArray,
    poses: LinearizedPoses,
    Y: FloatArray,
) -> FloatArray:
    """Return whitened derivatives (a, r, links, m, k) of a kind by the coordinates of its poses."""
    columns = coordinate_derivative(evaluated.jacobian, Y[:, rows.poses])
    if rows.kind.poses_per_row > 1:
        return np.matmul(white[:, :, None], columns)
    if evaluated.joints is not None and rows.kind.sensed_joints:
        turns = [
            poses.joints_by_coordinates[name][:, rows.poses] for name in rows.kind.sensed_joints
        ]
        columns = columns + np.matmul(evaluated.joints, np.stack(turns, axis=2))
    return np.matmul(white, columns)[:, :, None]


# Poses of a batch of trials: their states, and what solving for them gives.


@dataclass(frozen=True, eq=False)
class PoseStates(TrialBatch):
    """Poses of a trials: states (a, n) and true readings q (a, n, actuators) [SI]."""

    state: engine.State
    q: FloatArray

    def take_poses(self, poses: IntArray) -> PoseStates:
        """Return some poses."""
        return map_arrays(lambda array: array[:, poses], self)

    def put_poses(self, trials: IntArray, poses: IntArray, other: PoseStates) -> PoseStates:
        """Return a copy in which k poses of given trials and numbers (k,) are other ones (k,)."""

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = np.array(old)
            out[trials, poses] = new
            return out

        return map_arrays(replaced, self, other)

    @staticmethod
    def join_poses(states: Sequence[PoseStates], order: IntArray) -> PoseStates:
        """Return the poses of all states side by side, then in an order."""
        return map_arrays(lambda *arrays: np.concatenate(arrays, axis=1)[:, order], *states)


def spread_states(state: engine.State, trials: int, poses: int) -> engine.State:
    """Return a state (1, 1) or (1, n) as that of all trials and poses, for several trials without
    copying.
    """
    if trials == 1:
        return map_arrays(lambda a: a.repeat(poses // a.shape[1], axis=1), state)
    return map_arrays(lambda a: np.broadcast_to(a, (trials, poses, *a.shape[2:])), state)


@dataclass(frozen=True, eq=False)
class PoseEstimates(TrialBatch):
    """Poses of t trials that are unknown because readings are uncertain, where all rows fit best.

    states : (t, n) closed poses and true readings. is_reached : (t, n).
    rank : (t, components) coordinates of poses that rows determine.
    is_undetermined : (t, n) poses with a coordinate that no row determines; they stay where the
        search began.
    is_converged : (t,).
    """

    states: PoseStates
    is_reached: BoolArray
    rank: IntArray
    is_undetermined: BoolArray
    is_converged: BoolArray


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Poses and nuisance parameters of a trials at given deviations.

    nuisance : (a, U) values that fit best, or as given; None without any.
    linearized : the poses of the only block; None where there are several, which are solved again
        block by block.
    states : (a, n) of the only block, for the next start; None as above.
    estimates : of uncertain poses; None where readings are exact.
    driven : joints of the only block; None where the next step has no use for them.
    evaluated : rows of every kind at the poses of the only block, None for unknown ones.
    """

    nuisance: FloatArray | None
    linearized: LinearizedPoses | None = None
    states: PoseStates | None = None
    estimates: PoseEstimates | None = None
    driven: DrivenJoints | None = None
    evaluated: Sequence[Evaluation | None] | None = None

    @property
    def has_derivatives(self) -> bool:
        """Whether poses of a single block are linearized."""
        return self.linearized is not None and self.linearized.by_parameters.shape[-1] > 0
