# SPDX-License-Identifier: Apache-2.0
"""Rows of any measurements at a robot's present values, their own unknowns eliminated: what
identifiability is read from.

Rows are [F | A | r]: the unknowns that the measurements bring with them (frames, targets,
surfaces), the robot's free parameters in tolerances, the residual; all whitened. Folded in this
order into one triangular factor, the rows below those of F are what is left of A after the best
choice of those unknowns: projection onto the complement of F, without forming it. See
docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine
from loopcal.estimate.elimination import OWN_RANK
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.rows import rows_of
from loopcal.measure import (
    Measurements,
    NuisanceParameters,
    evaluate_all,
    guess_nuisance_values,
    list_sensed_joints,
    resolve_reading_sigma,
    select_joint_values,
    whitened_rows,
)
from loopcal.mechanism import (
    Mechanism,
    Status,
    differentiate_passive_joints,
    differentiate_pose,
    forward_trials,
)
from loopcal.numerics.decomposition import empty_factor
from loopcal.typing import BoolArray, FloatArray

BLOCK = 512
"""Rows of a kind that are made at once."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses of a robot, solved and linearised once; any kind may look at them.

    Attributes
    ----------
    free : the robot's unknowns. readings : (n, a). reached : (n,) where the loops close.
    T : (1, n, 4, 4) [m]. twists : (1, n, 6, p) by deviations in tolerances; identity and zero where
        not reached.
    joints : name -> (1, n) [SI]. slopes : name -> (1, n, p), of the joints asked for.
    """

    free: FreeParameters
    readings: FloatArray
    reached: BoolArray
    T: FloatArray
    twists: FloatArray
    joints: Mapping[str, FloatArray]
    slopes: Mapping[str, FloatArray]


def scene(free: FreeParameters, readings: FloatArray, joints: Iterable[str] = ()) -> Scene:
    """Solve and linearise a robot at readings (n, a), at its present values."""
    robot, values, names = free.robot, free.robot.values[None], tuple(joints)
    state = forward_trials(robot, values, readings[None])
    D = (
        differentiate_pose(robot, values, readings[None], state).parameters[..., free.places]
        * free.tolerance
    )
    reached = (state.status == Status.CONVERGED) & np.isfinite(D).all(axis=(2, 3))
    T = np.where(reached[..., None, None], state.T, np.eye(4))
    D = np.where(reached[..., None, None], D, 0.0)
    slopes: dict[str, FloatArray] = {}
    passive = [
        name for name in names if name not in {actuator.name for actuator in robot.actuators}
    ]
    at = select_joint_values(robot, names, readings[None], state)
    if passive:
        moved = differentiate_passive_joints(robot, values, readings[None], state)
        scaled = np.nan_to_num(moved.parameters[..., free.places] * free.tolerance)
        slopes = {name: scaled[:, :, moved.names.index(name)] for name in passive}
    return Scene(free, readings, np.asarray(reached[0]), T, D, at, slopes)


def look(
    at: Scene, measured: Measurements, local: NuisanceParameters, values: FloatArray
) -> FloatArray:
    """Whitened rows (1, M, U + p + 1), [own | machine | residual], of measurements at a scene;
    values (U,) of the own.
    """
    parts = evaluate_all(measured, at.T, values[None], local, at.joints)
    rows = whitened_rows(parts, at.twists, at.slopes)
    p, own = len(at.free), len(local)
    return np.concatenate([rows[..., p : p + own], rows[..., :p], rows[..., p + own :]], axis=-1)


def without_own(factor: FloatArray, own: int) -> FloatArray:
    """Eliminate the first `own` columns of a triangular factor (1, own + p + 1, ..): (1, p + 1, p +
    1).

    Directions of the own unknowns that no row shows are told from the others by singular values, so
    that a frame that cannot be found takes nothing away.
    """
    if own == 0:
        return factor
    top = factor[0, :own, :own]
    norm = np.linalg.norm(top, axis=0)
    u, s, _ = np.linalg.svd(top / np.where(norm > 0.0, norm, 1.0))
    free = (u.T @ factor[0, :own, own:])[s <= OWN_RANK * s[0]]
    return engine.fold(factor[:, own:, own:], free[None])


def information(free: FreeParameters, data: Measurements) -> tuple[FloatArray, BoolArray]:
    """Fold all rows of measurements at the robot's present values.

    Parameters
    ----------
    free : the robot's unknowns. data : of any kinds; unknowns that they bring are put where the
        measurements want them.

    Returns
    -------
    factor : (1, p + 1, p + 1) of rows [A | r] with own unknowns eliminated. reached : (n,) poses
        that close or are not needed; where one is False its rows are missing.
    """
    if resolve_reading_sigma(free.robot, data.reading_sigma, data.n_poses) is not None:
        return _uncertain(free, data)
    local = data.nuisance_parameters
    own = len(local)
    factor = empty_factor(1, own + len(free))
    values = _own_values(free, data, local) if own else np.zeros(0)
    reached = np.ones(data.n_poses, dtype=bool)
    for i, kind_rows in enumerate(data.observations):
        names = list_sensed_joints([kind_rows.kind])
        for first in range(0, len(kind_rows), BLOCK):
            chosen = np.arange(first, min(first + BLOCK, len(kind_rows)))
            poses, rows = np.unique(kind_rows.rows[chosen], return_inverse=True)
            part = kind_rows.take(chosen)
            part = replace(part, rows=rows.reshape(part.rows.shape))
            at = scene(free, data.readings[poses], names)
            needed = np.zeros(len(poses), dtype=bool)
            needed[part.rows[np.any(part.whitener != 0.0, axis=(1, 2))].ravel()] = True
            reached[poses[needed & ~at.reached]] = False
            some = Measurements(data.robot_name, at.readings, (part,))
            used = replace(local, indices=(local.indices[i][chosen],))
            factor = engine.fold(factor, look(at, some, used, values))
    return without_own(engine.fold(factor, _prior_rows(local, len(free))), own), reached


def _uncertain(free: FreeParameters, data: Measurements) -> tuple[FloatArray, BoolArray]:
    """The same where poses are unknowns, too: at those that fit the robot's present values best."""
    rows, z = rows_of(free, data), free.deviation(free.robot.values[None])
    factor, _ = rows.fold(z, np.arange(1))
    reached = np.ones(data.n_poses, dtype=bool)
    reached[rows.unreachable(z)] = False
    return factor, reached


def equations(robot: Mechanism, data: Measurements) -> int:
    """How many equations measurements give: their rows; where readings are uncertain, less what the
    poses take of them.
    """
    if resolve_reading_sigma(robot, data.reading_sigma, data.n_poses) is None:
        return data.n_rows
    return int(rows_of(select_free_parameters(robot), data).equations[0])


def alone(at: Scene, measured: Measurements) -> FloatArray:
    """Factor (1, p + 1, p + 1) of one instrument's rows at a scene, its own unknowns eliminated at
    their stated values.
    """
    local = measured.nuisance_parameters
    rows = look(at, measured, local, local.values())
    factor = engine.fold(empty_factor(1, len(local) + len(at.free)), rows)
    return without_own(engine.fold(factor, _prior_rows(local, len(at.free))), len(local))


def _own_values(free: FreeParameters, data: Measurements, local: NuisanceParameters) -> FloatArray:
    """Values (U,) of the own unknowns that fit the measurements at the robot's present poses."""
    at = [
        scene(
            free,
            data.readings[first : first + BLOCK],
            list_sensed_joints(o.kind for o in data.observations),
        )
        for first in range(0, data.n_poses, BLOCK)
    ]
    T = np.concatenate([part.T[0] for part in at])
    joints = {
        name: np.concatenate([part.joints[name] for part in at], axis=1) for name in at[0].joints
    }
    return guess_nuisance_values(data, T, local, joints)


def _prior_rows(local: NuisanceParameters, p: int) -> FloatArray:
    """Rows (1, U, U + p + 1) of the own unknowns that have a tolerance; zero for the others."""
    known = local.table.free & ~np.isnan(local.table.tolerance)
    weight = np.where(known, 1.0 / np.where(known, local.table.tolerance, 1.0), 0.0)
    return np.concatenate([np.diag(weight), np.zeros((len(local), p + 1))], axis=1)[None]
