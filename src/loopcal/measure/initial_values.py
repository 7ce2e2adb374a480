# SPDX-License-Identifier: Apache-2.0
"""Initial values of nuisance parameters, from the data and the poses of the nominal robot.

Each kind offers candidates (`Kind.guess_values`) for the rows that share its parameters. Damped
Gauss-Newton on these rows, at fixed poses, refines every candidate. The best one is kept, and a
last descent uses all rows together. Parameters with a prior and fixed ones begin at their nominal
values.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.evaluation import evaluate_measurements, whiten_rows
from loopcal.measure.kinds import Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import Observations
from loopcal.numerics.gauss_newton import DescentStatus, FixedFactors, minimize
from loopcal.typing import BoolArray, FloatArray, IntArray

STEPS = 60
"""Steps of damped Gauss-Newton [1]; candidates in the right basin need fewer than ten."""

FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e4
"""Damping of the first step [1], in columns of length one, and that at which a descent ends."""

NEGLIGIBLE_STEP = 1e-6
"""Step, in standard deviations or as a share of the residuals, that is as good as none."""

SMALLEST = 1e-12
"""Singular value of columns of length one that counts as zero."""


def guess_nuisance_values(
    measurements: Measurements,
    T: FloatArray,
    nuisance: NuisanceParameters | None = None,
    joints: Mapping[str, FloatArray] | None = None,
) -> FloatArray:
    """Return values of the nuisance parameters that fit the measurements at given poses.

    Parameters
    ----------
    measurements : Measurements
    T : (n, 4, 4)
        T_base_platform of each pose, usually of the nominal robot at the readings.
    nuisance : NuisanceParameters, optional
        With priors and fixed values, if any; default: `measurements.nuisance_parameters`.
    joints : name -> (1, n), optional
        Values of joints that kinds sense.

    Returns
    -------
    values : (U,)

    Raises
    ------
    DataError
        If the poses are too few or too similar to determine a parameter.
    """
    collected = measurements.nuisance_parameters if nuisance is None else nuisance
    if not collected.table.free.any():
        return collected.values()
    values = guess_nuisance_values_batch(
        measurements, [o.measured[None] for o in measurements.observations], T[None], collected
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
    """Return values of the nuisance parameters for several sets of measured values, kind by kind.

    Parameters
    ----------
    measurements : to which the rows belong.
    measured : (t, r, c) of each kind.
    T : (t | 1, n, 4, 4) T_base_platform.
    nuisance : see `guess_nuisance_values`.
    most : number of candidates of each set to refine, those with the lowest cost; default all.
    steps : of the descent.

    Returns
    -------
    values : (t, U)

    Raises
    ------
    DataError
        See `guess_nuisance_values`. Of several sets, one without candidates keeps the nominal
        values instead.
    """
    known = ~(nuisance.table.free & np.isnan(nuisance.table.tolerance))
    sets = max((len(m) for m in measured), default=1)
    values = np.tile(nuisance.values(), (sets, 1))
    for i, rows in enumerate(measurements.observations):
        if not rows.kind.nuisance_parameters or rows.kind.sensed_joints:
            continue
        for members, indices in _group_rows(nuisance.indices[i]):
            if not known[indices].all():
                counted = members[rows.weight[members] > 0.0]
                if len(counted):
                    chosen = rows.take(counted)
                    values[:, indices] = _refine_best_candidate(
                        chosen,
                        measured[i][:, counted],
                        T[:, chosen.rows],
                        values[:, indices],
                        known[indices],
                        most,
                        steps,
                    )
                known[indices] = True
    return values


def _group_rows(indices: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Return groups of rows that use the same parameters: their row indices and the parameters."""
    sets, member = np.unique(indices, axis=0, return_inverse=True)
    return [(np.flatnonzero(member.ravel() == k), sets[k]) for k in range(len(sets))]


def _refine_best_candidate(
    rows: Observations,
    measured: FloatArray,
    poses: FloatArray,
    values: FloatArray,
    known: BoolArray,
    most: int | None,
    steps: int,
) -> FloatArray:
    """Return the best candidates (t, u) for rows that share their parameters; known ones keep their
    values (t, u).
    """
    kind, t = rows.kind, len(measured)
    candidates = _collect_candidates(kind, poses, measured)
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
    refined, cost = descend(lambda x, which: whiten(x, sets[which]), candidates, steps)
    return refined.reshape(t, k, -1)[np.arange(t), np.argmin(cost.reshape(t, k), axis=1)]


def _collect_candidates(kind: Kind, poses: FloatArray, measured: FloatArray) -> FloatArray:
    """Return the candidates of a kind for each set of measured values, the nominal values last, (t,
    k, u).
    """
    offered = []
    for j, of_set in enumerate(measured):
        try:
            guesses = kind.guess_values(poses[j if len(poses) > 1 else 0], of_set)
        except DataError:
            if len(measured) == 1:
                raise
            guesses = kind.nominal_values[None]
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

    return descend(whiten, values[None])[0][0]


# --- descent


def descend(
    whiten: Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]],
    x: FloatArray,
    steps: int = STEPS,
) -> tuple[FloatArray, FloatArray]:
    """Minimize least squares from several starts at once, by damped Gauss-Newton.

    Parameters
    ----------
    whiten : from values (c, u) of starts, whose numbers are (c,), to residuals (c, M) and Jacobians
        (c, M, u).
    x : (c, u) starts. steps : at most.

    Returns
    -------
    x : (c, u). cost : (c,) sums of squares; infinite where a start cannot be evaluated.
    """
    residual, jacobian = whiten(x, np.arange(len(x)))
    start = _Point(x, residual, jacobian, sum_squares(residual))
    damping = FixedFactors(np.full(len(x), FIRST_DAMPING))
    point = minimize(_Candidates(whiten), start, damping, steps).point
    return point.x, point.cost


@dataclass(frozen=True, eq=False)
class _Point:
    """Values x (c, u), whitened residuals (c, M), Jacobians (c, M, u), sums of squares (c,)."""

    x: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    cost: FloatArray

    def take(self, chosen: IntArray) -> "_Point":
        """Return some starts."""
        return _Point(*(array[chosen] for array in vars(self).values()))

    def put(self, chosen: IntArray, other: "_Point") -> "_Point":
        """Return these points with some taken from others."""
        arrays = [array.copy() for array in vars(self).values()]
        for array, new in zip(arrays, vars(other).values(), strict=True):
            array[chosen] = new
        return _Point(*arrays)


class _Step(NamedTuple):
    """A damped step (c, u), its length (c,) in whitened residuals, and its damping (c,)."""

    x: FloatArray
    length: FloatArray
    damping: FloatArray

    def take(self, chosen: BoolArray) -> "_Step":
        """Return some steps."""
        return _Step(*(array[chosen] for array in self))


@dataclass(frozen=True, eq=False)
class _Candidates:
    """The rules of the descent for `loopcal.numerics.gauss_newton.minimize`."""

    whiten: Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]]

    def propose(self, point: _Point, damping: FloatArray) -> _Step:
        """Return the damped steps, from a decomposition of columns of length one."""
        norm = np.linalg.norm(point.jacobian, axis=1)
        scale = np.where(norm > 0.0, norm, 1.0)
        # one triangular factor, so that the decomposition does not grow with the rows
        columns = point.jacobian / scale[:, None, :]
        stack = np.nan_to_num(np.concatenate([columns, point.residual[..., None]], axis=-1))
        R = np.asarray(np.linalg.qr(stack, mode="r"), dtype=float)
        U, s, V = np.linalg.svd(R[..., :-1], full_matrices=False)
        right = np.einsum("cmk,cm->ck", U, R[..., -1])
        total = s * s + damping[:, None] ** 2 + SMALLEST**2
        gain = np.where(s > SMALLEST, s / total, 0.0)
        step = np.where(norm > 0.0, -np.einsum("cku,ck->cu", V, gain * right) / scale, 0.0)
        return _Step(step, np.linalg.norm(step * scale, axis=1), damping)

    def is_negligible(self, point: _Point, step: _Step) -> BoolArray:
        """Return no step: all are evaluated."""
        del point
        return np.zeros(len(step.x), dtype=bool)

    def finish(self, point: _Point, step: _Step) -> _Point:
        """Return the points as they are."""
        del step
        return point

    def evaluate(self, point: _Point, step: _Step, trials: IntArray) -> _Point:
        """Return the points to which steps lead."""
        x = point.x + step.x
        residual, jacobian = self.whiten(x, trials)
        return _Point(x, residual, jacobian, sum_squares(residual))

    def judge(self, point: _Point, step: _Step, candidate: _Point) -> tuple[BoolArray, FloatArray]:
        """Accept every decrease."""
        del step
        return candidate.cost < point.cost, np.ones(len(point.cost))

    def ending(
        self, point: _Point, step: _Step, candidate: _Point, accepted: BoolArray
    ) -> IntArray:
        """End where a step moves the residuals by a millionth of their sigma, or of themselves."""
        del point, accepted
        is_small = step.length <= NEGLIGIBLE_STEP * (1.0 + np.sqrt(candidate.cost))
        stuck = np.where(
            step.damping > LARGEST_DAMPING, DescentStatus.NO_DESCENT, DescentStatus.RUNNING
        )
        return np.where(is_small, DescentStatus.CONVERGED, stuck)


def sum_squares(e: FloatArray) -> FloatArray:
    """Return sums of squares (c,) of residuals (c, M); infinite where they are not finite."""
    total = np.sum(e * e, axis=1)
    return np.where(np.isfinite(total), total, np.inf)
