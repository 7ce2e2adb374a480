# SPDX-License-Identifier: Apache-2.0
"""Starts for unknown frames, targets, points and surfaces: from the data and the poses of the nominal robot alone.

Each kind offers candidates in closed form (`Kind.starts`) for the rows that share its unknowns. Every candidate is improved
by damped Gauss-Newton on the kind's own rows at fixed poses, the best one is kept, and a last descent runs over all
rows together. Unknowns with a prior, and fixed ones, keep their nominal value to begin with.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from loopcal.measure.evaluate import evaluate_all, whitened_rows
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.unknowns import LocalUnknowns

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

STEPS = 60
"""Steps of damped Gauss-Newton [1]; candidates in the right basin need fewer than ten."""


def start_values(
    measurements: Measurements, T: Array, local: LocalUnknowns | None = None, joints: Mapping[str, Array] | None = None
) -> Array:
    """Values of the local unknowns that fit the measurements at given poses.

    Parameters
    ----------
    measurements : Measurements
    T : (n, 4, 4)
        T_base_platform of each pose, usually of the nominal robot at the readings.
    local : LocalUnknowns, optional
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
    gathered = measurements.unknowns if local is None else local
    values, free = gathered.values(), gathered.table.free
    sought = free & np.isnan(gathered.table.tolerance)
    if not free.any():
        return values
    known = ~sought
    for i, rows in enumerate(measurements.observations):
        if not rows.kind.unknowns or rows.kind.looks_at:
            continue
        for members, places in _sharing(gathered.places[i]):
            if not known[places].all():
                part = rows.take(members)
                values[places] = _best(part, T, values[places], known[places])
                known[places] = True
    return _descended(measurements, T, gathered, values, joints)


def _sharing(places: Ints) -> list[tuple[Ints, Ints]]:
    """Rows that use the same unknowns: their indices, and the unknowns."""
    sets, member = np.unique(places, axis=0, return_inverse=True)
    return [(np.flatnonzero(member.ravel() == k), sets[k]) for k in range(len(sets))]


def _best(rows: Observations, T: Array, values: Array, known: np.ndarray) -> Array:
    """The best candidate (u,) for rows that share their unknowns; known ones keep their values."""
    counted = rows.take(rows.weight > 0.0)
    if not len(counted):
        return values
    poses = T[counted.rows]
    candidates = counted.kind.starts(poses, counted.measured)
    candidates = np.concatenate([candidates, counted.kind.nominal[None]])
    candidates = np.where(known, values, candidates)

    def white(x: Array) -> tuple[Array, Array]:
        found = counted.kind.evaluate(poses[None], counted.measured[None], x[:, None, :])
        c, r, m = len(x), *found.residual.shape[1:]
        own = np.zeros((1, 1, 1, x.shape[1])) if found.own is None else found.own
        J = counted.whitener @ np.broadcast_to(own, (c, r, m, x.shape[1]))
        e = (counted.whitener @ np.broadcast_to(found.residual, (c, r, m))[..., None])[..., 0]
        return e.reshape(c, -1), np.where(known, 0.0, J).reshape(c, r * m, -1)

    found, cost = descended(white, candidates)
    return found[int(np.argmin(cost))]


def _descended(
    measurements: Measurements, T: Array, local: LocalUnknowns, values: Array, joints: Mapping[str, Array] | None
) -> Array:
    """Damped Gauss-Newton over all local unknowns together, priors included."""
    still = np.zeros((1, len(T), 6, 0))
    weight = np.where(local.table.free, 1.0 / local.table.tolerance, 0.0)
    prior = np.diag(np.nan_to_num(weight, nan=0.0))

    def white(x: Array) -> tuple[Array, Array]:
        rows = whitened_rows(evaluate_all(measurements, T[None], x, local, joints), still)
        e = np.concatenate([rows[..., -1], (x - local.table.nominal) @ prior], axis=1)
        return e, np.concatenate([rows[..., :-1], np.broadcast_to(prior, (len(x), *prior.shape))], axis=1)

    return descended(white, values[None])[0][0]


def descended(white: Callable[[Array], tuple[Array, Array]], x: Array) -> tuple[Array, Array]:
    """Least squares from several starts at once, by Gauss-Newton damped on scaled columns.

    Parameters
    ----------
    white : from (c, u) to residuals (c, M) and Jacobians (c, M, u)
    x : (c, u) starts

    Returns
    -------
    x : (c, u), cost : (c,) sums of squares; infinite where the start cannot be evaluated.
    """
    e, J = white(x)
    cost = _squares(e)
    damping = np.full(len(x), 1e-4)
    for _ in range(STEPS):
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
        # a step that moves the residuals by a millionth of their sigma, or of themselves, is as good as none
        done = np.linalg.norm(step * scale, axis=1) <= 1e-6 * (1.0 + np.sqrt(new))
        x, e = np.where(better[:, None], tried, x), np.where(better[:, None], e_new, e)
        J, cost = np.where(better[:, None, None], J_new, J), np.where(better, new, cost)
        if np.all(done | (damping > 1e4)):
            break
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
    return x, cost


def _squares(e: Array) -> Array:
    total = np.sum(e * e, axis=1)
    return np.where(np.isfinite(total), total, np.inf)
