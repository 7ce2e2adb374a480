# SPDX-License-Identifier: Apache-2.0
"""Initial values of nuisance parameters, from the data and the poses of the nominal robot.

Each kind offers candidates (`Kind.guess_values`) for the rows that share its parameters. Damped
Gauss-Newton on these rows, at fixed poses, refines every candidate, and the best one is kept.
Parameters with a prior and fixed ones begin at their nominal values.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.position import Position
from loopcal.measure.kinds.setup_parameters import shorten_rotations
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import Observations, whiten_columns
from loopcal.numerics.elimination import find_connected_groups
from loopcal.numerics.gauss_newton import STEPS, minimize_from_starts, sum_squares
from loopcal.numerics.statistics import choose_evenly, find_distinct_rows
from loopcal.typing import BoolArray, FloatArray, IntArray

# Sum of squares, in variances of the noise, by which one solution fits better than another without
# being told from it: one standard deviation.
ALIKE = 1.0
# Ratio of sums of squares above which rounding and curvature cannot change which one is lower.
AS_LOW = 4.0
# Ratio of the largest and the smallest variance up to which noise is equal, apart from rounding.
EQUAL_NOISE = 1.0 + 1e-9
# Rows of a group, and values for each of its unknowns, from which start values are sought: more
# would make them no better, since the geometry of the robot is not known yet.
FEWEST_ROWS, VALUES = 60, 20.0
# Targets from which a start value of their frame is sought; positions are linear in the places of
# the others, which begin at nominal values.
TARGETS = 8


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
        white = whiten_columns(rows.whitener, raw)
        whitened.append(white.reshape(t, -1, white.shape[-1]))
    return np.concatenate(whitened, axis=1)


def guess_nuisance_values(
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
    most : number of candidates of each set to refine, those with the lowest cost; default all, and
        of many targets an even choice, because a fit to all rows follows.
    """
    observations, own = measurements.all_observations, nuisance
    sets = max((len(m) for m in measured), default=len(T))
    values = np.tile(nuisance.values(), (sets, 1))
    if most is None:
        parts = zip(observations, measured, nuisance.indices, strict=True)
        chosen = [_choose_targets(*part) for part in parts]
        observations, measured, indices = zip(*chosen, strict=True) if chosen else ((), (), ())
        own = replace(nuisance, indices=indices)
    for groups in _list_groups(observations, own) if sets else ():
        rows = observations[groups.number]
        given = (measured[groups.number], T, values[:, groups.parameters])
        refined, cost = _refine_candidates(rows, groups, *given, most, steps)
        best = np.argmin(cost, axis=2)[..., None, None]
        values[:, groups.parameters] = np.take_along_axis(refined, best, axis=2)[:, :, 0]
    return values


def find_equal_values(
    measurements: Measurements, T: FloatArray, nuisance: NuisanceParameters, values: FloatArray
) -> FloatArray:
    """Return other values (k, U) of the nuisance parameters that fit all measurements at poses
    (n, 4, 4) as well as given ones (U,), up to `ALIKE`; fixed ones and those with a prior stay.

    Each of them changes the parameters of every cluster on its own.
    """
    observations, cluster = measurements.all_observations, _find_clusters(nuisance)
    others = values[None]
    used = np.ones(int(cluster.max(initial=-1)) + 1, dtype=np.int64)  # values of each cluster
    for groups in _list_groups(observations, nuisance, is_alone=True):
        rows = observations[groups.number]
        given = (rows.measured[None], T[None], values[None, groups.parameters])
        try:
            refined = _refine_candidates(rows, groups, *given)[0][0]
        except DataError:  # too few rows for candidates
            continue
        for own, candidates in zip(groups.parameters, refined, strict=True):
            c = cluster[own].max()
            places = used[c] + np.arange(len(candidates))
            used[c] += len(candidates)
            more = max(int(used[c]) - len(others), 0)
            others = np.concatenate([others, np.tile(values, (more, 1))])
            others[places[:, None], own] = candidates
    cost = np.zeros((len(others), len(used)))
    for i, rows in enumerate(observations):
        if len(rows) and nuisance.indices[i].shape[1]:
            residual = rows.compute_residuals(T[None], nuisance.select(i, others))
            square = ((rows.whitener @ residual[..., None]) ** 2).sum(axis=(2, 3))
            of = cluster[nuisance.indices[i]].max(axis=1)
            np.add.at(cost.T, of[of >= 0], square.T[of >= 0])
    is_equal = np.isfinite(cost) & (cost <= cost[0] + ALIKE)
    kept = (cluster >= 0) & is_equal[:, cluster]
    return np.where(kept, others, values)[1:]


def _choose_targets(
    rows: Observations, measured: FloatArray, indices: IntArray
) -> tuple[Observations, FloatArray, IntArray]:
    """Return rows of an even choice of many unknown targets, with several sets of measured values
    (t, r, c) and the parameters (r, u); all where the choice lacks most of a row.
    """
    kind, k = rows.kind, len(getattr(rows.kind, "targets", ()))
    if not isinstance(kind, Position) or kind.places is None or k <= TARGETS:
        return rows, measured, indices
    few, seen = choose_evenly(k, TARGETS), rows.present.reshape(-1, k, 3)[..., 0]
    if (seen[:, few].sum(axis=1) < np.minimum(seen.sum(axis=1), TARGETS // 2)).any():
        return rows, measured, indices
    chosen = replace(kind, targets=tuple(kind.targets[i] for i in few), places=kind.places[few])
    cells = (3 * few[:, None] + np.arange(3)).ravel()
    own = {"measured": rows.measured[:, cells], "noise_parts": ()}
    own["covariance"] = rows.covariance[:, cells[:, None], cells]
    names = [parameter.name for parameter in kind.nuisance_parameters]
    used = [names.index(parameter.name) for parameter in chosen.nuisance_parameters]
    return replace(rows, kind=chosen, **own), measured[..., cells], indices[:, used]


class _Groups(NamedTuple):
    """g groups of rows of one kind, each of which shares its parameters."""

    number: int  # of the observations
    # (g, r) their rows, the first one again in place of missing ones, and which are none
    rows: IntArray
    is_row: BoolArray
    parameters: IntArray  # (g, u)
    is_kept: BoolArray  # (u,) parameters that keep their values


def _list_groups(
    observations: Sequence[Observations], nuisance: NuisanceParameters, *, is_alone: bool = False
) -> Iterator[_Groups]:
    """Give the groups of rows that use the same parameters, of which some are to be found, those of
    one kind with about as many rows together.

    They are in the order of the observations. Of the same kind, the group with the most rows is
    first, so that a file with few rows does not determine the parameters that it shares, which a
    later group keeps unless each `is_alone`. Targets on the base whose stated places determine a
    frame are before all others, since no pose is needed; other targets on the base are last.
    """

    def rank(kind: Kind) -> int:
        if isinstance(kind, Position) and kind.locates_frame:
            return 0
        return 2 if kind.is_of_base else 1

    known = ~(nuisance.table.free & np.isnan(nuisance.table.tolerance))
    kinds = [(rank(rows.kind), type(rows.kind)) for rows in observations]
    listed: list[tuple[int, IntArray, IntArray]] = []
    for i, rows in enumerate(observations):
        if not rows.kind.nuisance_parameters or rows.kind.sensed_joints:
            continue
        counts = np.flatnonzero((rows.weight > 0.0) & rows.present.any(axis=1))
        sets, member = find_distinct_rows(nuisance.indices[i][counts])
        order = np.argsort(member, kind="stable")
        ends = np.cumsum(np.bincount(member, minlength=len(sets)))[:-1]
        parts = np.split(counts[order], ends) if len(sets) else []
        # an even choice of enough rows will do, unless it lacks most values of a component
        unknowns = len(rows.kind.nuisance_parameters)
        most = max(FEWEST_ROWS, int(VALUES * unknowns / rows.present.shape[1]))
        for own, indices in zip(parts, sets, strict=True):
            listed.append((i, own, indices))
            if len(own) > most:
                chosen = own[choose_evenly(len(own), most)]
                left, whole = (rows.present[some].sum(axis=0) for some in (chosen, own))
                if (left >= np.minimum(whole, most // 2)).all():
                    listed[-1] = (i, chosen, indices)
    listed.sort(key=lambda g: (kinds[g[0]][0], kinds.index(kinds[g[0]]), -len(g[1])))
    # a group comes in a later turn than those before it with which it shares an unknown parameter
    turn, turns = np.zeros(len(known), dtype=np.int64), defaultdict(list)
    for group in listed:
        own = group[2][~known[group[2]]]
        now = 0 if is_alone else int(turn[own].max(initial=0))
        turn[own] = now + 1
        turns[now].append(group)
    for _, together in sorted(turns.items()):
        alike = defaultdict(list)
        for group in together:
            i, own, indices = group
            # a drift begins at zero: every row takes another part of it
            is_kept = known[indices] | observations[i].kind.is_drift
            if not is_kept.all():
                alike[i, tuple(is_kept), len(own).bit_length()].append(group)
        for (i, is_kept, _), groups in alike.items():
            count = np.array([len(own) for _, own, _ in groups])
            rows = np.array([np.resize(own, count.max()) for _, own, _ in groups])
            is_row = np.arange(count.max()) < count[:, None]
            parameters = np.array([indices for *_, indices in groups])
            yield _Groups(i, rows, is_row, parameters, np.array(is_kept))
        if not is_alone:
            for *_, indices in together:
                known[indices] = True


def _find_clusters(nuisance: NuisanceParameters) -> IntArray:
    """Return the cluster (U,) of each free parameter, -1 for others; rows join its parameters."""
    free, links = nuisance.table.free, [np.zeros((0, 2), dtype=np.int64)]
    for used in nuisance.indices:
        if used.shape[1]:
            first = np.take_along_axis(used, np.argmax(free[used], axis=1)[:, None], axis=1)
            pairs = np.stack([np.broadcast_to(first, used.shape), used], axis=-1)
            links.append(pairs[free[used]].reshape(-1, 2))
    cluster = np.full(len(free), -1)
    joined = find_connected_groups(np.unique(np.concatenate(links), axis=0), len(free))
    cluster[free] = np.unique(joined[free], return_inverse=True)[1]
    return cluster


def _refine_candidates(
    rows: Observations,
    groups: _Groups,
    measured: FloatArray,
    T: FloatArray,
    values: FloatArray,
    most: int | None = None,
    steps: int = STEPS,
) -> tuple[FloatArray, FloatArray]:
    """Return refined candidates (t, g, k, u) of groups for t sets of measured values (t, r, c) at
    poses (t | 1, n, 4, 4), and their sums of squares (t, g, k); kept values (t, g, u) stay.
    """
    kind, t, (g, r) = rows.kind, len(measured), groups.rows.shape

    def spread(array: np.ndarray) -> np.ndarray:
        """Return arrays (s | 1, ..) of the groups in each of t sets from (t | 1, g, ..)."""
        if g > 1:
            array = np.broadcast_to(array, (t, *array.shape[1:]))
        return array.reshape(-1, *array.shape[2:])

    poses, columns = spread(T[:, rows.rows[groups.rows]]), spread(measured[:, groups.rows])
    whitener = spread((rows.whitener[groups.rows] * groups.is_row[..., None, None])[None])
    is_row, kept = spread(groups.is_row[None]), groups.is_kept
    is_strict = t == 1 and not kept.any()
    worth, is_plain = np.inf, not (kind.is_of_base or kind.shared_errors or kept.any())
    if is_plain and isinstance(kind, Position) and {"frame", "targets"} <= set(kind.unknown):
        # minima for equal noise: each is left where another one is lower for any other noise, too
        size = np.abs(np.einsum("...mm->...m", whitener))
        seen = size.reshape(*size.shape[:-1], -1, 3) > 0.0
        is_whole = (seen.any(axis=-1) == seen.all(axis=-1)).all()
        if is_whole and np.count_nonzero(size) == np.count_nonzero(whitener):
            worth = AS_LOW * (size.max() / size.min(where=size > 0.0, initial=np.inf)) ** 2
    candidates = _collect_candidates(kind, poses, columns, is_row, is_strict, worth)
    k, own = candidates.shape[1], values.reshape(t * g, 1, -1)
    candidates = np.where(kept, own, candidates).reshape(t * g * k, -1)

    def whiten(x: FloatArray, sets: IntArray) -> tuple[FloatArray, FloatArray]:
        at, seen, white = (a[sets] if len(a) > 1 else a for a in (poses, columns, whitener))
        evaluated = kind.evaluate(at, seen, x[:, None, :])
        c, m = len(x), evaluated.residual.shape[2]
        by_nuisance = evaluated.nuisance
        slopes = np.zeros((1, 1, 1, x.shape[1])) if by_nuisance is None else by_nuisance
        J = whiten_columns(white, np.broadcast_to(slopes, (c, r, m, x.shape[1])))
        e = whiten_columns(white, np.broadcast_to(evaluated.residual, (c, r, m))[..., None])
        J = np.where(kept, 0.0, J) if kept.any() else J
        return e.reshape(c, -1), J.reshape(c, r * m, -1)

    sets = np.repeat(np.arange(t * g), k)
    if most is not None and most < k:
        cost = sum_squares(whiten(candidates, sets)[0]).reshape(t * g, k)
        chosen = (np.argsort(cost, axis=1)[:, :most] + k * np.arange(t * g)[:, None]).ravel()
        candidates, sets, k = candidates[chosen], sets[chosen], most
    is_minimum = (candidates != kind.nominal_values).any(axis=1).all()
    if k == 1 and worth <= AS_LOW * EQUAL_NOISE and is_minimum:
        refined, cost = candidates, np.zeros(len(candidates))
    else:
        refined, cost = minimize_from_starts(
            lambda x, which: whiten(x, sets[which]), candidates, steps, sets, worth
        )
    names = [parameter.name for parameter in kind.nuisance_parameters]
    shortest = shorten_rotations(names, refined)
    is_same = ((shortest == refined) | ~kept).all(axis=1, keepdims=True)
    return np.where(is_same, shortest, refined).reshape(t, g, k, -1), cost.reshape(t, g, k)


def _collect_candidates(
    kind: Kind,
    poses: FloatArray,
    measured: FloatArray,
    is_row: BoolArray,
    is_strict: bool,
    worth: float,
) -> FloatArray:
    """Return the candidates of a kind for each set of measured values, (s, k, u), the nominal
    values last unless `worth` tells that candidates are minima. Data that leave some parameters
    open may do for the others: without a closed form, frames are spread unless this `is_strict`.
    """
    offered, own = [], kind.without_shared_errors() if kind.shared_errors else kind
    for guesses in own.guess_sets(poses, measured, is_row, worth):
        if not isinstance(guesses, DataError):
            shared = len(kind.nominal_values) - guesses.shape[1]  # a bias or drift begins at zero
            candidates = np.concatenate([guesses, np.zeros((len(guesses), shared))], axis=1)
        elif is_strict:
            raise guesses
        else:
            candidates = kind.spread_frames()
        if worth == np.inf:
            candidates = np.concatenate([candidates, kind.nominal_values[None]])
        offered.append(candidates)
    k = max(len(guesses) for guesses in offered)
    return np.stack([np.concatenate([g, np.repeat(g[-1:], k - len(g), axis=0)]) for g in offered])
