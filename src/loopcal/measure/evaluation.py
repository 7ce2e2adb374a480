# SPDX-License-Identifier: Apache-2.0
"""Whitened rows of measurements at given poses and nuisance parameters, without any robot.

    # U nuisance parameters: frames, targets, surfaces
    local = measurements.nuisance_parameters
    # (U,), or guess_nuisance_values(measurements, T, local)
    values = local.values()
    # one `KindRows` for each kind
    parts = evaluate_all(measurements, T, values[None], local)
    # (t, M, p + U + 1): [machine | nuisance | residual]
    rows = whitened_rows(parts, D)

With D = d twist / d parameter (t, n, 6, p) of the mechanism, a Gauss-Newton step (machine,
nuisance) solves `rows[..., :-1] step = -rows[..., -1]` in the least-squares sense. Both parts of
the step are added: values of nuisance parameters are plain numbers, frames too (see
`loopcal.measure.kinds.parts`). Rows and components that are absent are zero.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import Observations
from loopcal.typing import FloatArray

Ints = NDArray[np.intp]


class KindRows(NamedTuple):
    """Rows of one kind; l poses per row, l = 1 unless rows compare poses.

    Attributes
    ----------
    poses : (r, l) the poses each row saw.
    residual : (t, r, m) predicted - measured [SI].
    jacobian : (t, r, l, m, 6) by the platform twists.
    own : (t, r, m, U) by all local unknowns of the measurements; zero where a row does not use one,
        or it is fixed.
    joints : (t, r, m, j) by the values of the joints `sensed_joints`, at the row's pose.
    sensed_joints : names of these joints.
    whitener : (r, m, m), zero where absent.
    """

    poses: Ints
    residual: FloatArray
    jacobian: FloatArray
    own: FloatArray
    joints: FloatArray
    sensed_joints: tuple[str, ...]
    whitener: FloatArray


def evaluate_all(
    measurements: Measurements,
    T: FloatArray,
    values: FloatArray,
    local: NuisanceParameters | None = None,
    joints: Mapping[str, FloatArray] | None = None,
) -> tuple[KindRows, ...]:
    """Evaluate every kind at poses.

    Parameters
    ----------
    measurements : Measurements
    T : (t, n, 4, 4)
        T_base_platform of each pose.
    values : (t or 1, U)
        Of the local unknowns.
    local : NuisanceParameters, optional
        Default: gathered from the measurements; gather them once where this is called often.
    joints : name -> (t or 1, n), optional
        Values of the joints that kinds look at, see `loopcal.measure.joint_observation`.

    Returns
    -------
    parts : one `KindRows` for each kind, in order

    Raises
    ------
    DataError
        If a joint's values are missing.
    """
    gathered = measurements.nuisance_parameters if local is None else local
    return tuple(
        _kind_rows(rows, T, gathered.select(i, values), gathered.indices[i], gathered, joints or {})
        for i, rows in enumerate(measurements.observations)
    )


def whitened_rows(
    parts: tuple[KindRows, ...], twists: FloatArray, joints: Mapping[str, FloatArray] | None = None
) -> FloatArray:
    """Return the whitened rows [machine | nuisance | residual] of all kinds, stacked.

    Parameters
    ----------
    parts : from `evaluate_all`
    twists : (t or 1, n, 6, p)
        How the platform's twist depends on the machine's unknowns; p = 0 for local unknowns alone.
    joints : name -> (t or 1, n, p), optional
        How the joints' values depend on them; default: not at all.

    Returns
    -------
    rows : (t, M, p + U + 1)
    """
    p = twists.shape[-1]
    found = []
    for part in parts:
        t = np.broadcast_shapes(part.residual.shape[:1], twists.shape[:1])[0]
        machine = (
            np.sum(part.jacobian @ twists[:, part.poses], axis=2)
            if p
            else np.zeros((*part.residual.shape, 0))
        )
        for j, name in enumerate(part.sensed_joints):
            if joints is not None and name in joints:
                machine = (
                    machine + part.joints[..., j, None] * joints[name][:, part.poses[:, 0], None, :]
                )
        blocks = (machine, part.own, part.residual[..., None])
        raw = np.concatenate([np.broadcast_to(b, (t, *b.shape[1:])) for b in blocks], axis=-1)
        white = part.whitener @ raw
        found.append(white.reshape(t, -1, white.shape[-1]))
    return np.concatenate(found, axis=1)


def _kind_rows(
    rows: Observations,
    T: FloatArray,
    values: FloatArray,
    places: Ints,
    local: NuisanceParameters,
    joints: Mapping[str, FloatArray],
) -> KindRows:
    kind = rows.kind
    for name in kind.sensed_joints:
        if name not in joints:
            raise DataError(
                f"the kind {kind.name!r} needs the values of joint {name!r}; hand them over as "
                "joints"
            )
    seen = (
        np.stack([joints[name][:, rows.rows] for name in kind.sensed_joints], axis=-1)
        if kind.sensed_joints
        else None
    )
    found = rows.evaluate(T, values, seen)
    t, r, m = found.residual.shape
    jacobian = found.jacobian[:, :, None] if kind.poses_per_row == 1 else found.jacobian
    own = np.zeros((t, r, m, len(local)))
    if found.nuisance is not None:
        free = local.table.free[places]
        each = np.broadcast_to(found.nuisance * free[:, None, :], (t, r, m, places.shape[1]))
        np.put_along_axis(own, np.broadcast_to(places[:, None, :], each.shape), each, axis=-1)
    moved = np.zeros((t, r, m, 0)) if found.joints is None else found.joints
    return KindRows(
        rows.rows.reshape(r, -1),
        found.residual,
        jacobian,
        own,
        moved,
        kind.sensed_joints,
        rows.whitener,
    )
