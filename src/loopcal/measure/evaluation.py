# SPDX-License-Identifier: Apache-2.0
"""Whitened rows of measurements at given poses and nuisance parameters, without any robot.

    # U nuisance parameters: frames, targets, surfaces
    nuisance = measurements.nuisance_parameters
    # (U,), or guess_nuisance_values(measurements, T, nuisance)
    values = nuisance.values()
    # one `EvaluatedRows` for each kind
    evaluated = evaluate_measurements(measurements, T, values[None], nuisance)
    # (t, M, p + U + 1): [machine | nuisance | residual]
    rows = whiten_rows(evaluated, D)

With D = d twist / d parameter (t, n, 6, p) of the mechanism, a Gauss-Newton step (machine,
nuisance) solves `rows[..., :-1] step = -rows[..., -1]` in the least-squares sense. Both parts of
the step are added: values of nuisance parameters are plain numbers, frames too (see
`loopcal.measure.kinds.setup_parameters`). Rows and components that are absent are zero.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import Observations
from loopcal.typing import FloatArray, IntArray


class EvaluatedRows(NamedTuple):
    """Residuals and derivatives of one kind; l poses per row, l = 1 unless rows compare poses.

    Attributes
    ----------
    poses : (r, l) the poses of each row.
    residual : (t, r, m) predicted - measured [SI].
    jacobian : (t, r, l, m, 6) by the platform twists.
    nuisance : (t, r, m, U) by all nuisance parameters of the measurements; zero where a row does
        not use one, or it is fixed.
    joints : (t, r, m, j) by the values of the joints `sensed_joints`, at the row's pose.
    sensed_joints : names of these joints.
    whitener : (r, m, m), zero where absent.
    """

    poses: IntArray
    residual: FloatArray
    jacobian: FloatArray
    nuisance: FloatArray
    joints: FloatArray
    sensed_joints: tuple[str, ...]
    whitener: FloatArray


def evaluate_measurements(
    measurements: Measurements,
    T: FloatArray,
    values: FloatArray,
    nuisance: NuisanceParameters | None = None,
    joints: Mapping[str, FloatArray] | None = None,
) -> tuple[EvaluatedRows, ...]:
    """Evaluate every kind at poses.

    Parameters
    ----------
    measurements : Measurements
    T : (t, n, 4, 4)
        T_base_platform of each pose.
    values : (t or 1, U)
        Of the nuisance parameters.
    nuisance : NuisanceParameters, optional
        Default: collected from the measurements; collect them once for repeated calls.
    joints : name -> (t or 1, n), optional
        Values of the joints that kinds sense, see `loopcal.measure.select_joint_values`.

    Returns
    -------
    evaluated : one `EvaluatedRows` for each kind, in order; those of targets on the base last

    Raises
    ------
    DataError
        If a joint's values are missing.
    """
    collected = measurements.nuisance_parameters if nuisance is None else nuisance
    return tuple(
        _evaluate_kind(rows, T, collected.select(i, values), i, collected, joints or {})
        for i, rows in enumerate(measurements.all_observations)
    )


def whiten_rows(
    evaluated: tuple[EvaluatedRows, ...],
    twists: FloatArray,
    joints: Mapping[str, FloatArray] | None = None,
) -> FloatArray:
    """Return the whitened rows [machine | nuisance | residual] of all kinds, stacked.

    Parameters
    ----------
    evaluated : from `evaluate_measurements`
    twists : (t or 1, n, 6, p)
        Derivative of the platform's twist by the machine's parameters; p = 0 for nuisance
        parameters alone.
    joints : name -> (t or 1, n, p), optional
        Derivatives of the joints' values by these parameters; default: zero.

    Returns
    -------
    rows : (t, M, p + U + 1)
    """
    p = twists.shape[-1]
    whitened = []
    for rows in evaluated:
        t = np.broadcast_shapes(rows.residual.shape[:1], twists.shape[:1])[0]
        machine = (
            np.sum(rows.jacobian @ twists[:, rows.poses], axis=2)
            if p
            else np.zeros((*rows.residual.shape, 0))
        )
        for j, name in enumerate(rows.sensed_joints):
            if joints is not None and name in joints:
                machine = (
                    machine + rows.joints[..., j, None] * joints[name][:, rows.poses[:, 0], None, :]
                )
        blocks = (machine, rows.nuisance, rows.residual[..., None])
        raw = np.concatenate([np.broadcast_to(b, (t, *b.shape[1:])) for b in blocks], axis=-1)
        white = rows.whitener @ raw
        whitened.append(white.reshape(t, -1, white.shape[-1]))
    return np.concatenate(whitened, axis=1)


def _evaluate_kind(
    rows: Observations,
    T: FloatArray,
    values: FloatArray,
    number: int,
    nuisance: NuisanceParameters,
    joints: Mapping[str, FloatArray],
) -> EvaluatedRows:
    kind, indices, factor = rows.kind, nuisance.indices[number], nuisance.factor(number)
    evaluation = rows.evaluate(T, values, kind.stack_joints(joints, rows.rows))
    t, r, m = evaluation.residual.shape
    jacobian = evaluation.jacobian
    by_nuisance = np.zeros((t, r, m, len(nuisance)))
    if evaluation.nuisance is not None:
        part = nuisance.table.free[indices] * (1.0 if factor is None else factor)
        used = np.broadcast_to(evaluation.nuisance * part[:, None, :], (t, r, m, indices.shape[1]))
        columns = np.broadcast_to(indices[:, None, :], used.shape)
        np.put_along_axis(by_nuisance, columns, used, axis=-1)
    return EvaluatedRows(
        rows.rows.reshape(r, -1),
        evaluation.residual,
        jacobian[:, :, None] if kind.poses_per_row == 1 else jacobian,
        by_nuisance,
        np.zeros((t, r, m, 0)) if evaluation.joints is None else evaluation.joints,
        kind.sensed_joints,
        rows.whitener,
    )
