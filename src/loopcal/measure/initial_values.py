# SPDX-License-Identifier: Apache-2.0
"""Starts for unknown frames, targets, points and surfaces: from the data and the poses of the
nominal robot alone.

Each kind offers candidates in closed form (`Kind.guess_values`) for the rows that share its unknowns.
Every candidate is improved by damped Gauss-Newton on the kind's own rows at fixed poses, the best
one is kept, and a last descent runs over all rows together. Unknowns with a prior, and fixed ones,
keep their nominal value to begin with.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError
from loopcal.measure.evaluation import evaluate_all, whitened_rows
from loopcal.measure.kinds import Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import Observations
from loopcal.typing import FloatArray

Ints = NDArray[np.intp]

STEPS = 60
"""Steps of damped Gauss-Newton [1]; candidates in the right basin need fewer than ten."""


def guess_nuisance_values(
    measurements: Measurements,
    T: FloatArray,
    local: NuisanceParameters | None = None,
    joints: Mapping[str, FloatArray] | None = None,
) -> FloatArray:
    """Values of the local unknowns that fit the measurements at given poses.

    Parameters
    ----------
    measurements : Measurements
    T : (n, 4, 4)
        T_base_platform of each pose, usually of the nominal robot at the readings.
    local : NuisanceParameters, optional
        With priors and fixed values, if any; default: as the kinds state them.
    joints : name -> (1, n), optional
        Values of joints that kinds look at.

    Returns
    -------
    values : (U,)

    Raises
    ------
    DataError
        If poses are too few or too much alike to tell where something is.
    """
    gathered = measurements.nuisance_parameters if local is None else local
    if not gathered.table.free.any():
        return gathered.values()
    values = guess_nuisance_values_batch(
        measurements, [o.measured[None] for o in measurements.observations], T[None], gathered
    )[0]
    return _descended(measurements, T, gathered, values, joints)


def guess_nuisance_values_batch(
    measurements: Measurements,
    measured: Sequence[FloatArray],
    T: FloatArray,
    local: NuisanceParameters,
    *,
    most: int | None = None,
    steps: int = STEPS,
) -> FloatArray:
    """Values of the local unknowns for several sets of measured values at once, kind by kind.

    Parameters
    ----------
    measurements : whose rows these are.
    measured : (t, r, c) of each kind.
    T : (t | 1, n, 4, 4) T_base_platform.
    local : see `guess_nuisance_values`.
    most : candidates of each set that are improved, the best ones as they are offered; default all.
    steps : of the descent.

    Returns
    -------
    values : (t, U)

    Raises
    ------
    DataError
        See `guess_nuisance_values`; of several sets, one without candidates keeps the nominal values.
    """
    known = ~(local.table.free & np.isnan(local.table.tolerance))
    values = np.tile(local.values(), (max((len(m) for m in measured), default=1), 1))
    for i, rows in enumerate(measurements.observations):
        if not rows.kind.nuisance_parameters or rows.kind.sensed_joints:
            continue
        for members, places in _sharing(local.indices[i]):
            if not known[places].all():
                counted = members[rows.weight[members] > 0.0]
                if len(counted):
                    part, fixed = rows.take(counted), known[places]
                    values[:, places] = _best(
                        part,
                        measured[i][:, counted],
                        T[:, part.rows],
                        values[:, places],
                        fixed,
                        most,
                        steps,
                    )
                known[places] = True
    return values


def _sharing(places: Ints) -> list[tuple[Ints, Ints]]:
    """Rows that use the same unknowns: their indices, and the unknowns."""
    sets, member = np.unique(places, axis=0, return_inverse=True)
    return [(np.flatnonzero(member.ravel() == k), sets[k]) for k in range(len(sets))]


def _best(
    rows: Observations,
    measured: FloatArray,
    poses: FloatArray,
    values: FloatArray,
    known: np.ndarray,
    most: int | None,
    steps: int,
) -> FloatArray:
    """The best candidates (t, u) for rows that share their unknowns; known ones keep their values
    (t, u).
    """
    kind, t = rows.kind, len(measured)
    candidates = _candidates(kind, poses, measured)
    k = candidates.shape[1]
    candidates = np.where(known, values[:, None, :], candidates).reshape(t * k, -1)

    def white(x: FloatArray, of: Ints) -> tuple[FloatArray, FloatArray]:
        found = kind.evaluate(
            poses[of if len(poses) > 1 else [0]], measured[of if t > 1 else [0]], x[:, None, :]
        )
        c, r, m = len(x), *found.residual.shape[1:]
        own = np.zeros((1, 1, 1, x.shape[1])) if found.nuisance is None else found.nuisance
        J = rows.whitener @ np.broadcast_to(own, (c, r, m, x.shape[1]))
        e = (rows.whitener @ np.broadcast_to(found.residual, (c, r, m))[..., None])[..., 0]
        return e.reshape(c, -1), np.where(known, 0.0, J).reshape(c, r * m, -1)

    of = np.repeat(np.arange(t), k)
    if most is not None and most < k:
        cost = _squares(white(candidates, of)[0]).reshape(t, k)
        chosen = (np.argsort(cost, axis=1)[:, :most] + k * np.arange(t)[:, None]).ravel()
        candidates, of, k = candidates[chosen], of[chosen], most
    found, cost = descended(lambda x: white(x, of), candidates, steps)
    return found.reshape(t, k, -1)[np.arange(t), np.argmin(cost.reshape(t, k), axis=1)]


def _candidates(kind: Kind, poses: FloatArray, measured: FloatArray) -> FloatArray:
    """What a kind offers for each set of measured values, the nominal values last, (t, k, u)."""
    each = []
    for j, one in enumerate(measured):
        try:
            offered = kind.guess_values(poses[j if len(poses) > 1 else 0], one)
        except DataError:
            if len(measured) == 1:
                raise
            offered = kind.nominal_values[None]
        each.append(np.concatenate([offered, kind.nominal_values[None]]))
    k = max(len(one) for one in each)
    return np.stack(
        [np.concatenate([one, np.repeat(one[-1:], k - len(one), axis=0)]) for one in each]
    )


def _descended(
    measurements: Measurements,
    T: FloatArray,
    local: NuisanceParameters,
    values: FloatArray,
    joints: Mapping[str, FloatArray] | None,
) -> FloatArray:
    """Damped Gauss-Newton over all local unknowns together, priors included."""
    still = np.zeros((1, len(T), 6, 0))
    weight = np.where(local.table.free, 1.0 / local.table.tolerance, 0.0)
    prior = np.diag(np.nan_to_num(weight, nan=0.0))

    def white(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = whitened_rows(evaluate_all(measurements, T[None], x, local, joints), still)
        e = np.concatenate([rows[..., -1], (x - local.table.nominal) @ prior], axis=1)
        return e, np.concatenate(
            [rows[..., :-1], np.broadcast_to(prior, (len(x), *prior.shape))], axis=1
        )

    return descended(white, values[None])[0][0]


def descended(
    white: Callable[[FloatArray], tuple[FloatArray, FloatArray]], x: FloatArray, steps: int = STEPS
) -> tuple[FloatArray, FloatArray]:
    """Least squares from several starts at once, by Gauss-Newton damped on scaled columns.

    Parameters
    ----------
    white : from (c, u) to residuals (c, M) and Jacobians (c, M, u)
    x : (c, u) starts
    steps : at most

    Returns
    -------
    x : (c, u), cost : (c,) sums of squares; infinite where the start cannot be evaluated.
    """
    e, J = white(x)
    cost = _squares(e)
    damping = np.full(len(x), 1e-4)
    for _ in range(steps):
        norm = np.linalg.norm(J, axis=1)
        scale = np.where(norm > 0.0, norm, 1.0)
        # one triangular factor, so that the decomposition does not grow with the rows
        stack = np.nan_to_num(np.concatenate([J / scale[:, None, :], e[..., None]], axis=-1))
        R = np.asarray(np.linalg.qr(stack, mode="r"), dtype=float)
        U, s, V = np.linalg.svd(R[..., :-1], full_matrices=False)
        rhs = np.einsum("cmk,cm->ck", U, R[..., -1])
        gain = np.where(s > 1e-12, s / (s * s + damping[:, None] ** 2 + 1e-24), 0.0)
        step = np.where(norm > 0.0, -np.einsum("cku,ck->cu", V, gain * rhs) / scale, 0.0)
        tried = x + step
        e_new, J_new = white(tried)
        new = _squares(e_new)
        better = new < cost
        # a step that moves the residuals by a millionth of their sigma, or of themselves, is as
        # good as none
        done = np.linalg.norm(step * scale, axis=1) <= 1e-6 * (1.0 + np.sqrt(new))
        x, e = np.where(better[:, None], tried, x), np.where(better[:, None], e_new, e)
        J, cost = np.where(better[:, None, None], J_new, J), np.where(better, new, cost)
        if np.all(done | (damping > 1e4)):
            break
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
    return x, cost


def _squares(e: FloatArray) -> FloatArray:
    total = np.sum(e * e, axis=1)
    return np.where(np.isfinite(total), total, np.inf)
