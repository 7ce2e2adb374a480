# SPDX-License-Identifier: Apache-2.0
"""Initial values of nuisance parameters, from the data and the poses of the nominal robot.

Each kind offers candidates (`Kind.guess_values`) for the rows that share its parameters. Damped
Gauss-Newton on these rows, at fixed poses, refines every candidate. The best one is kept, and a
last descent uses all rows together. Parameters with a prior and fixed ones begin at their nominal
values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.position import Position
from loopcal.measure.kinds.setup_parameters import shorten_rotations
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import Observations
from loopcal.numerics.gauss_newton import STEPS, minimize_from_starts, sum_squares
from loopcal.typing import BoolArray, FloatArray, IntArray

ALIKE = 1.0
"""Sum of squares, in variances of the noise, by which one solution fits better than another without
being told from it: one standard deviation.
"""


class EvaluatedRows(NamedTuple):
    """Residuals and derivatives of one kind; l poses per row, l = 1 unless rows compare poses."""

    poses: IntArray  # (r, l) of each row
    residual: FloatArray  # (t, r, m) predicted - measured [SI]
    jacobian: FloatArray  # (t, r, l, m, 6) by the platform twists
    # (t, r, m, U) by all nuisance parameters of the measurements; zero where a row does not use
    # one, or it is fixed
    nuisance: FloatArray
    joints: FloatArray  # (t, r, m, j) by the values of the joints `sensed_joints`, at its pose
    sensed_joints: tuple[str, ...]
    whitener: FloatArray  # (r, m, m), zero where absent


def evaluate_measurements(
    measurements: Measurements,
    T: FloatArray,
    values: FloatArray,
    nuisance: NuisanceParameters | None = None,
    joints: Mapping[str, FloatArray] | None = None,
) -> tuple[EvaluatedRows, ...]:
    """Return the evaluated rows of every kind at poses, those of targets on the base last.

    T : (t, n, 4, 4) T_base_platform of each pose. values : (t or 1, U) of the nuisance parameters.
    nuisance : default: collected from the measurements; collect them once for repeated calls.
    joints : name -> (t or 1, n) of the joints that kinds sense, see `select_joint_values`.
    """
    collected = measurements.nuisance_parameters if nuisance is None else nuisance
    evaluated = []
    for i, rows in enumerate(measurements.all_observations):
        kind, indices, factor = rows.kind, collected.indices[i], collected.factor(i)
        own = kind.stack_joints(joints or {}, rows.rows)
        residual, jacobian, by_own, by_joints = rows.evaluate(T, collected.select(i, values), own)
        t, r, m = residual.shape
        by_nuisance = np.zeros((t, r, m, len(collected)))
        if by_own is not None:
            part = collected.table.free[indices] * (1.0 if factor is None else factor)
            used = by_own * part[:, None, :]
            used = np.broadcast_to(used, (t, r, m, indices.shape[1]))
            columns = np.broadcast_to(indices[:, None, :], used.shape)
            np.put_along_axis(by_nuisance, columns, used, axis=-1)
        evaluated.append(
            EvaluatedRows(
                rows.rows.reshape(r, -1),
                residual,
                jacobian[:, :, None] if kind.poses_per_row == 1 else jacobian,
                by_nuisance,
                np.zeros((t, r, m, 0)) if by_joints is None else by_joints,
                kind.sensed_joints,
                rows.whitener,
            )
        )
    return tuple(evaluated)


def whiten_rows(
    evaluated: tuple[EvaluatedRows, ...],
    twists: FloatArray,
    joints: Mapping[str, FloatArray] | None = None,
) -> FloatArray:
    """Return the whitened rows (t, M, p + U + 1) [machine | nuisance | residual] of all kinds.

    twists : (t or 1, n, 6, p) derivative of the platform's twist by the machine's parameters; p = 0
        for nuisance parameters alone.
    joints : name -> (t or 1, n, p) derivatives of the joints' values; default: zero.
    """
    p = twists.shape[-1]
    whitened = []
    for rows in evaluated:
        t = np.broadcast_shapes(rows.residual.shape[:1], twists.shape[:1])[0]
        machine = np.zeros((*rows.residual.shape, 0))
        if p:
            machine = np.sum(rows.jacobian @ twists[:, rows.poses], axis=2)
        for j, name in enumerate(rows.sensed_joints):
            if joints is not None and name in joints:
                by_machine = joints[name][:, rows.poses[:, 0], None, :]
                machine = machine + rows.joints[..., j, None] * by_machine
        blocks = (machine, rows.nuisance, rows.residual[..., None])
        raw = np.concatenate([np.broadcast_to(b, (t, *b.shape[1:])) for b in blocks], axis=-1)
        white = rows.whitener @ raw
        whitened.append(white.reshape(t, -1, white.shape[-1]))
    return np.concatenate(whitened, axis=1)


def guess_nuisance_values(
    measurements: Measurements,
    T: FloatArray,
    nuisance: NuisanceParameters | None = None,
    joints: Mapping[str, FloatArray] | None = None,
) -> FloatArray:
    """Return values (U,) of the nuisance parameters that fit the measurements at given poses.

    T : (n, 4, 4) T_base_platform of each pose, usually of the nominal robot at the readings.
    nuisance : with priors and fixed values; default: `measurements.nuisance_parameters`.
    joints : name -> (1, n) of joints that kinds sense.
    DataError : the poses are too few or too similar to determine a parameter.
    """
    collected = measurements.nuisance_parameters if nuisance is None else nuisance
    if not collected.table.free.any():
        return collected.values()
    values = guess_nuisance_values_batch(
        measurements, [o.measured[None] for o in measurements.all_observations], T[None], collected
    )[0]
    return _refine_together(measurements, T, collected, values, joints)


def guess_nuisance_values_batch(
    measurements: Measurements,
    measured: Sequence[FloatArray],
    T: FloatArray,
    nuisance: NuisanceParameters,
    *,
    most: int | None = None,
    steps: int = STEPS,
) -> FloatArray:
    """Return values (t, U) of the nuisance parameters for several sets of measured values, kind by
    kind; of several sets, one without candidates keeps the nominal values.

    measured : (t, r, c) of each kind; those of targets on the base last.
    T : (t | 1, n, 4, 4) T_base_platform.
    most : number of candidates of each set to refine, those with the lowest cost; default all.
    """
    known = ~(nuisance.table.free & np.isnan(nuisance.table.tolerance))
    observations = measurements.all_observations
    sets = max((len(m) for m in measured), default=len(T))
    values = np.tile(nuisance.values(), (sets, 1))
    for i, members, indices in _list_groups(measurements, nuisance):
        # a drift begins at zero: every row takes another part of it
        is_kept = known[indices] | observations[i].kind.is_drift
        if is_kept.all():
            continue
        chosen = observations[i].take(members)
        given = (measured[i][:, members], T[:, chosen.rows], values[:, indices], is_kept)
        refined, cost = _refine_candidates(chosen, *given, most, steps)
        values[:, indices] = refined[np.arange(len(refined)), np.argmin(cost, axis=1)]
        known[indices] = True
    return values


def find_equal_values(
    measurements: Measurements, T: FloatArray, nuisance: NuisanceParameters, values: FloatArray
) -> FloatArray:
    """Return other values (k, U) of the nuisance parameters that fit all measurements at poses
    (n, 4, 4) as well as given ones (U,), up to `ALIKE`; fixed ones and those with a prior stay.
    """
    known = ~(nuisance.table.free & np.isnan(nuisance.table.tolerance))
    observations = measurements.all_observations
    others = [values]
    for i, members, indices in _list_groups(measurements, nuisance):
        is_kept = known[indices] | observations[i].kind.is_drift
        if not is_kept.all():
            chosen = observations[i].take(members)
            given = (chosen.measured[None], T[None, chosen.rows], values[None, indices], is_kept)
            try:
                refined = _refine_candidates(chosen, *given)[0][0]
            except DataError:  # too few rows for candidates
                continue
            for candidate in refined:
                other = values.copy()
                other[indices] = candidate
                others.append(other)
    tested = np.array(others)
    evaluated = evaluate_measurements(measurements, T[None], tested, nuisance)
    rows = whiten_rows(evaluated, np.zeros((1, len(T), 6, 0)))
    cost = sum_squares(rows[..., -1])
    return tested[1:][cost[1:] <= cost[0] + ALIKE]


def _list_groups(
    measurements: Measurements, nuisance: NuisanceParameters
) -> list[tuple[int, IntArray, IntArray]]:
    """Return the groups of rows that use the same parameters: number of the observations, indices
    of its rows that measured something, and the parameters.

    They are in the order of the observations. Of the same kind, the group with the most rows is
    first, so that a file with few rows does not determine the parameters that it shares. Targets on
    the base whose stated places determine a frame are before all others, since no pose is needed;
    other targets on the base are last.
    """

    def rank(kind: Kind) -> int:
        if isinstance(kind, Position) and kind.locates_frame:
            return 0
        return 2 if kind.is_of_base else 1

    kinds = [(rank(rows.kind), type(rows.kind)) for rows in measurements.all_observations]
    groups = []
    for i, rows in enumerate(measurements.all_observations):
        if not rows.kind.nuisance_parameters or rows.kind.sensed_joints:
            continue
        counts = (rows.weight > 0.0) & rows.present.any(axis=1)
        sets, member = np.unique(nuisance.indices[i], axis=0, return_inverse=True)
        for k, indices in enumerate(sets):
            counted = np.flatnonzero((member.ravel() == k) & counts)
            if len(counted):
                groups.append((i, counted, indices))
    return sorted(
        groups, key=lambda group: (kinds[group[0]][0], kinds.index(kinds[group[0]]), -len(group[1]))
    )


def _refine_candidates(
    rows: Observations,
    measured: FloatArray,
    poses: FloatArray,
    values: FloatArray,
    known: BoolArray,
    most: int | None = None,
    steps: int = STEPS,
) -> tuple[FloatArray, FloatArray]:
    """Return refined candidates (t, k, u) for rows that share their parameters, and their sums of
    squares (t, k); known parameters keep their values (t, u).
    """
    kind, t = rows.kind, len(measured)
    candidates = _collect_candidates(kind, poses, measured, bool(known.any()))
    k = candidates.shape[1]
    candidates = np.where(known, values[:, None, :], candidates).reshape(t * k, -1)

    def whiten(x: FloatArray, sets: IntArray) -> tuple[FloatArray, FloatArray]:
        evaluated = kind.evaluate(
            poses[sets if len(poses) > 1 else [0]], measured[sets if t > 1 else [0]], x[:, None, :]
        )
        c, r, m = len(x), *evaluated.residual.shape[1:]
        by_nuisance = evaluated.nuisance
        slopes = np.zeros((1, 1, 1, x.shape[1])) if by_nuisance is None else by_nuisance
        J = rows.whitener @ np.broadcast_to(slopes, (c, r, m, x.shape[1]))
        e = (rows.whitener @ np.broadcast_to(evaluated.residual, (c, r, m))[..., None])[..., 0]
        return e.reshape(c, -1), np.where(known, 0.0, J).reshape(c, r * m, -1)

    sets = np.repeat(np.arange(t), k)
    if most is not None and most < k:
        cost = sum_squares(whiten(candidates, sets)[0]).reshape(t, k)
        chosen = (np.argsort(cost, axis=1)[:, :most] + k * np.arange(t)[:, None]).ravel()
        candidates, sets, k = candidates[chosen], sets[chosen], most
    refined, cost = minimize_from_starts(lambda x, which: whiten(x, sets[which]), candidates, steps)
    names = [parameter.name for parameter in kind.nuisance_parameters]
    shortest = shorten_rotations(names, refined)
    is_kept = ((shortest == refined) | ~known).all(axis=1, keepdims=True)
    return np.where(is_kept, shortest, refined).reshape(t, k, -1), cost.reshape(t, k)


def _collect_candidates(
    kind: Kind, poses: FloatArray, measured: FloatArray, is_partly_known: bool
) -> FloatArray:
    """Return the candidates of a kind for each set of measured values, the nominal values last, (t,
    k, u). Data that leave some parameters open may do for the others, if any are known.
    """
    offered = []
    for j, of_set in enumerate(measured):
        try:
            own = kind.without_shared_errors() if kind.shared_errors else kind
            guesses = own.guess_values(poses[j if len(poses) > 1 else 0], of_set)
            shared = len(kind.nominal_values) - guesses.shape[1]  # a bias or drift begins at zero
            guesses = np.pad(guesses, ((0, 0), (0, shared)))
        except DataError:
            if len(measured) == 1 and not is_partly_known:
                raise
            guesses = kind.spread_frames()
        offered.append(np.concatenate([guesses, kind.nominal_values[None]]))
    k = max(len(guesses) for guesses in offered)
    return np.stack([np.concatenate([g, np.repeat(g[-1:], k - len(g), axis=0)]) for g in offered])


def _refine_together(
    measurements: Measurements,
    T: FloatArray,
    nuisance: NuisanceParameters,
    values: FloatArray,
    joints: Mapping[str, FloatArray] | None,
) -> FloatArray:
    """Return values (U,) after a descent over all parameters and all rows, priors included."""
    no_motion = np.zeros((1, len(T), 6, 0))
    weight = np.where(nuisance.table.free, 1.0 / nuisance.table.tolerance, 0.0)
    prior = np.diag(np.nan_to_num(weight, nan=0.0))

    def whiten(x: FloatArray, which: IntArray) -> tuple[FloatArray, FloatArray]:
        del which
        rows = whiten_rows(
            evaluate_measurements(measurements, T[None], x, nuisance, joints), no_motion
        )
        e = np.concatenate([rows[..., -1], (x - nuisance.table.nominal) @ prior], axis=1)
        return e, np.concatenate(
            [rows[..., :-1], np.broadcast_to(prior, (len(x), *prior.shape))], axis=1
        )

    return minimize_from_starts(whiten, values[None])[0][0]
