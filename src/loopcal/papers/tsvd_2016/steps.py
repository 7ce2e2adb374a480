# SPDX-License-Identifier: Apache-2.0
"""The nine steps of the paper, for t machines or t settings of lambda and k at once.

 1 nominal parameters, e = 0                          `load_machine`                 \
 2 forward kinematic model                            `forward_trials`                |
 3 measured poses                                     `list_measured_poses`          | machines.py
 4 measured data: true machine, with noise            `simulate_trials`               /
 5 error transfer matrix T_j of pose j                `differentiate_pose`, x y z phi theta (psi)
 6 identification matrix H, all T_j in one column     `fold`: one triangular factor
 7 de from H de = D, by LS, RE or TSVD                `decompose`, with the filter factors below
 8 e + de; again from step 5 unless |de| is small     `iterate`
 9 save e

Raw numbers as in the paper: millimeters and radians, every equation and every parameter of weight
one, and the filter acts on the step. With H = U S V' and s_i = S_ii the step is de = sum f_i (u_i'D
/ s_i) v_i, where f_i = 1 for LS, s_i^2 / (s_i^2 + lambda) for RE, and 1 for i <= k, else 0, for
TSVD.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal import engine
from loopcal.mechanism import Mechanism, Status, differentiate_pose, forward_trials
from loopcal.numerics.decomposition import Decomposition, decompose, empty_factor
from loopcal.papers.tsvd_2016.machines import Study
from loopcal.papers.tsvd_2016.published import MM
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

ENOUGH = 1e-6
"""Largest component of a step [mm, rad] at which the iteration ends; the paper's is not in our
text.
"""

LIMIT = 1_000_000
"""Iterations at most; ridge steps shorten slowly, and 100,000 of them are common."""

LINEARIZATIONS = 40
"""Matrices H at most: enough for `LIMIT` ridge steps, see `AHEAD`, and for 40 steps of LS."""

AHEAD = 0.5
"""Steps taken with one H, as a share of the iterations done before.

Ridge converges in many steps that hardly change the machine, and so hardly change H. With the same
H the sum of m steps has a closed form, the filter 1 - (lambda / (s^2 + lambda))^m. LS and TSVD,
whose steps with the same H are zero after the first, take one step with each H.
"""

LOST = 1e4
"""A step of more than this [mm, rad] has diverged: ten meters."""


@dataclass(frozen=True, eq=False)
class Iterations:
    """Result of the steps for t settings; index k of a history is the state at the k-th H.

    Attributes
    ----------
    values : (t, p) identified parameters [SI], NaN where diverged. history : (k + 1, t, p) [SI],
        NaN from the step on that diverged.
    steps : (k, t) largest component of the first step with each H [mm, rad], NaN after the end and
        where it diverged. done : (k + 1, t) iterations before each state of the history.
    is_converged, is_diverged : (t,); neither: stopped by `LIMIT` or `LINEARIZATIONS`.
    machine : (t,) as given.
    """

    values: FloatArray
    history: FloatArray
    steps: FloatArray
    done: IntArray
    is_converged: BoolArray
    is_diverged: BoolArray
    machine: IntArray

    @property
    def count(self) -> IntArray:
        """(t,) iterations done."""
        return self.done[-1]


def penalize_none(parameters: int) -> FloatArray:
    """Return the penalties (1, p) of LS: none."""
    return np.zeros((1, parameters))


def penalize_ridge(lam: FloatArray, parameters: int) -> FloatArray:
    """Return the penalties (l, p) of RE for each lambda."""
    return np.repeat(np.asarray(lam, dtype=np.float64)[:, None], parameters, axis=1)


def penalize_truncated(k: IntArray, parameters: int) -> FloatArray:
    """Return the penalties (l, p) of TSVD for each k: infinite beyond it."""
    return np.where(np.arange(parameters) < np.asarray(k)[:, None], 0.0, np.inf)


def iterate(
    study: Study,
    penalty: FloatArray,
    machine: IntArray | None = None,
    limit: int = LIMIT,
    ahead: float = AHEAD,
) -> Iterations:
    """Run steps 5 to 9.

    Parameters
    ----------
    study : the machines. penalty : (t | 1, p) of each setting, see above.
    machine : (t,) which machine was measured; default: the first. limit : iterations at most.
    ahead : see `AHEAD`; 0 computes H in every iteration.
    """
    machine = np.zeros(len(penalty), dtype=np.int64) if machine is None else machine
    t = len(machine)
    penalty = np.broadcast_to(penalty, (t, penalty.shape[1]))
    values = np.repeat(study.robot.parameters.nominal[None], t, axis=0)
    diverged, converged = np.zeros(t, dtype=bool), np.zeros(t, dtype=bool)
    count = np.zeros(t, dtype=np.int64)
    history, steps, done = [values.copy()], [], [count.copy()]
    for _ in range(LINEARIZATIONS if ahead else limit):
        active = np.flatnonzero(~diverged & ~converged & (count < limit))
        if not active.size:
            break
        decomposition, reached = linearize(study, values[active], machine[active])
        wanted = np.minimum(np.maximum(1, ahead * count[active]), limit - count[active])
        taken = _count_steps(decomposition, penalty[active], wanted.astype(np.int64))
        size = _measure_step(decomposition, penalty[active], np.zeros(len(active), np.int64))
        change = decomposition.deviation(_sum_steps(decomposition, penalty[active], taken))
        good = reached & (size < LOST) & (np.abs(change).max(axis=1) < LOST)
        values[active] += np.where(good[:, None], change, np.nan) * list_scales(study.robot)
        count[active] += np.where(good, taken, 1)
        converged[active], diverged[active] = good & (size <= ENOUGH), ~good
        history.append(values.copy())
        done.append(count.copy())
        steps.append(np.full(t, np.nan))
        steps[-1][active] = np.where(good, size, np.nan)
    size = np.stack(steps) if steps else np.zeros((0, t))
    return Iterations(values, np.stack(history), size, np.stack(done), converged, diverged, machine)


def _sum_steps(decomposition: Decomposition, penalty: FloatArray, count: IntArray) -> FloatArray:
    """Return the coordinates (a, p) of the sum of `count` (a,) steps with the same H.

    Step m + 1 has the filter f r^m with f = s^2 / (s^2 + penalty) and r = 1 - f, so that the sum
    has the filter 1 - r^m.
    """
    left = 1.0 - decomposition.filter_factors(penalty)
    kept = 1.0 - left ** count[:, None]
    s = decomposition.singular_values
    return np.divide(kept * decomposition.projections, s, out=np.zeros_like(s), where=s > 0.0)


def _measure_step(
    decomposition: Decomposition, penalty: FloatArray, before: IntArray
) -> FloatArray:
    """Return the largest component (a,) of the step after `before` (a,) steps with this H."""
    left = (1.0 - decomposition.filter_factors(penalty)) ** before[:, None]
    step = decomposition.deviation(left * decomposition.solution(penalty))
    return np.abs(step).max(axis=1)


def _count_steps(decomposition: Decomposition, penalty: FloatArray, wanted: IntArray) -> IntArray:
    """Return how many of the `wanted` (a,) steps are larger than `ENOUGH`, and one at least."""
    low, high = np.ones_like(wanted), np.maximum(wanted, 1)
    while (low < high).any():
        middle = (low + high) // 2
        is_small = _measure_step(decomposition, penalty, middle) <= ENOUGH
        low, high = np.where(is_small, low, middle + 1), np.where(is_small, middle, high)
        low = np.minimum(low, high)
    return low


def linearize(
    study: Study, values: FloatArray, machine: IntArray
) -> tuple[Decomposition, BoolArray]:
    """Return the decomposition of H (steps 5 and 6), and which settings (a,) reach all poses.

    Parameters
    ----------
    values : (a, p) corrected parameters [SI]. machine : (a,) which of the machines was measured.
    """
    robot, readings = study.robot, study.trials.readings[None]
    kind, measured = study.kind, study.trials.measured[0]
    shared = len(values) > 1 and bool((values == values[0]).all())
    distinct = values[:1] if shared else values
    state = forward_trials(robot, distinct, readings, study.commanded)
    reached = (state.status == Status.CONVERGED).all(axis=1)
    T = np.where(reached[:, None, None, None], state.T, np.eye(4))
    D = np.where(
        reached[:, None, None, None],
        differentiate_pose(robot, distinct, readings, state).parameters,
        0.0,
    ) * list_scales(robot)
    if shared:
        T, reached = (
            np.broadcast_to(T, (len(values), *T.shape[1:])),
            np.broadcast_to(reached, len(values)),
        )
    evaluated = kind.evaluate(T, measured[machine])
    raw = np.where([c.dimension is Dimension.LENGTH for c in kind.columns], 1.0 / MM, 1.0)
    H = np.matmul(evaluated.jacobian * raw[:, None], D)
    rows = np.concatenate([H, -(evaluated.residual * raw)[..., None]], axis=-1)
    rows = rows.reshape(len(values), -1, rows.shape[-1])
    factor = engine.fold(empty_factor(len(rows), rows.shape[-1] - 1), rows)
    return decompose(factor, np.full(len(values), rows.shape[1]), tolerance=0.0), reached


def list_scales(robot: Mechanism) -> FloatArray:
    """Return the paper's units (p,) in SI: millimeters and radians."""
    return np.where([d is Dimension.LENGTH for d in robot.parameters.dimensions], MM, 1.0)
