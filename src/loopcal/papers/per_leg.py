# SPDX-License-Identifier: Apache-2.0
"""Each leg on its own, unweighted: the variant of the 42-parameter hexapod study ("6 sets of
equations").

Closure linearised at a pose reads A_k dx + E_k de_k = 0 for leg k: the pose error dx = measured -
predicted enters every leg, the displacements de_k its own leg only. So each leg is a least-squares
problem of n rows and its own parameters. It ignores that the noise of one pose is shared by all
legs, which costs a factor in accuracy: use `identify`; this is for comparison. Source: "Numerical
simulation of the calibration algorithm for a 6-DOF parallel mechanism", section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal import engine
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.measure import Measurements, Observations
from loopcal.mechanism import Mechanism, Status, forward_trials, joints_from_readings
from loopcal.numerics.decomposition import RANK_TOLERANCE, decompose, empty_factor
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class PerLeg:
    """Result of the per-leg variant.

    Attributes
    ----------
    robot : at the estimated values. estimate_history : (steps + 1, p) free parameters after each
        step [SI].
    conditions : (legs,) condition of each leg's matrix at the last step, columns as they are (all
        lengths, unscaled).
    """

    robot: Mechanism
    estimate_history: FloatArray
    conditions: FloatArray


def identify_per_leg(robot: Mechanism, data: Measurements, steps: int = 3) -> PerLeg:
    """Identify leg by leg in a fixed number of Gauss-Newton steps.

    Parameters
    ----------
    robot : start values and free parameters. data : full poses, one kind. steps : number of steps.

    Raises
    ------
    EstimationError
        Not full poses, a free parameter that moves no leg or several, or a pose out of reach.
    """
    free = select_free_parameters(robot)
    observations = _full_poses(data)
    q = data.readings[None, observations.rows]
    values = robot.values[None].copy()
    history, conditions = [values[0, free.places].copy()], np.zeros(0)
    for _ in range(steps):
        state = forward_trials(robot, values, q)
        if (state.status != Status.CONVERGED).any():
            raise EstimationError(
                f"{robot.name} cannot reach {int((state.status != 0).sum())} of these poses"
            )
        seen = observations.kind.evaluate(state.T, observations.measured[None])
        dx = -np.linalg.solve(seen.jacobian[0], seen.residual[0, :, :, None])[:, :, 0]
        change, conditions = _step(robot, free, values, q, state, dx)
        values[:, free.places] += change
        history.append(values[0, free.places].copy())
    return PerLeg(robot.with_values(values[0]), np.stack(history), conditions)


def _step(
    robot: Mechanism,
    free: FreeParameters,
    values: FloatArray,
    q: FloatArray,
    state: engine.State,
    dx: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Change (p,) of the free parameters from pose errors dx (n, 6), and each leg's condition."""
    e, tau = robot.slots(values)
    n_e = robot.slots.n_displacements
    J = robot.slots.jacobian(values)[0][:, free.places]
    blocks = engine.linearize(
        robot.program, e, joints_from_readings(q, tau, robot.slots.frequency), state
    )
    change, conditions, owners = np.zeros(len(free)), [], np.zeros(len(free), dtype=int)
    for group, block in zip(robot.program.groups, blocks.closure, strict=True):
        k, s = block.E.shape[2], block.E.shape[-1]
        columns = np.arange(n_e)[group.columns].reshape(k, s)
        for leg in range(k):
            own = J[columns[leg]]
            mine = np.flatnonzero(own.any(axis=0))
            owners[mine] += 1
            A, E = block.A[0, :, leg], block.E[0, :, leg]
            right = -np.einsum("ncm,nm->nc", A, dx[:, list(robot.program.freedoms)])
            rows = np.concatenate([(E @ own[:, mine]), right[..., None]], axis=-1).reshape(
                1, -1, len(mine) + 1
            )
            factor = engine.fold(empty_factor(1, len(mine)), rows)
            d = decompose(factor, np.array([rows.shape[1]]), tolerance=RANK_TOLERANCE)
            change[mine] = d.deviation(d.solution(np.where(d.used, 0.0, np.inf)))[0]
            conditions.append(float(d.condition[0]))
    if (owners != 1).any() or J[n_e:].any():
        name = free.names[int(np.argmax((owners != 1) | J[n_e:].any(axis=0)))]
        raise EstimationError(
            f"{name} does not move the geometry of exactly one leg, so the legs cannot be "
            "identified one by one: use identify"
        )
    return change, np.array(conditions)


def _full_poses(data: Measurements) -> Observations:
    """The rows of the one kind, which must see all six coordinates of every pose."""
    rows = [o for o in data.observations if len(o)]
    if len(rows) == 1:
        kept = rows[0].take(rows[0].weight > 0.0)
        if kept.present.shape[1] == 6 and kept.present.all() and len(kept):
            return kept
    raise EstimationError(
        "the legs can be identified one by one from full poses of one kind only: use identify"
    )
