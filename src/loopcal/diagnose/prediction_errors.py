# SPDX-License-Identifier: Apache-2.0
"""Errors with which two geometries of a robot predict the same measurements, and their statistics.

A prediction error is what a model predicts at the readings that were recorded, minus what was
measured. With the components (dx, dy, dz) and (da, db, dc) of one measured row:

    position     dQ1 = sqrt(dx^2 + dy^2 + dz^2)          [m]
    orientation  dQ2 = sqrt(da^2 + db^2 + dc^2)          [rad]
    balance      largest minus smallest component of one group

Source: "Numerical simulation of the calibration algorithm for a 6-DOF parallel mechanism", section
4. Where only some components are measured, the sums run over those.

Kinds of measurement are compared in units of their sigma: the root mean square of W r over all
measured components, r the residuals and W the inverse Cholesky factor of their covariance. It is 1
where the geometry explains everything but the noise. Without this division the least accurate
instrument would decide alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.errors import DataError
from loopcal.estimate.poses.prediction import predict_from_readings
from loopcal.findings import Finding, report_finding
from loopcal.measure import (
    Measurements,
    NuisanceParameters,
    Observations,
    guess_nuisance_values,
    list_sensed_joints,
    select_joint_values,
)
from loopcal.mechanism import Mechanism, Solution, inverse
from loopcal.parameters import ParameterTable
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

INDICES = ("position", "orientation", "position_balance", "orientation_balance")


@dataclass(frozen=True, eq=False)
class Statistics:
    """Maximum, root mean square, mean and standard deviation of an error over `count` rows.

    All are NaN where no row has the error.
    """

    max: float
    rms: float
    mean: float
    sd: float
    count: int


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of r rows; NaN where a row measures no component of the group.

    Attributes
    ----------
    position, orientation : (r,) [m], [rad].
    position_balance, orientation_balance : (r,) [m], [rad].
    """

    position: FloatArray
    orientation: FloatArray
    position_balance: FloatArray
    orientation_balance: FloatArray

    def statistics(self, index: str) -> Statistics:
        """Return the statistics of one of `INDICES`."""
        values = getattr(self, index)
        values = values[np.isfinite(values)]
        if len(values) == 0:
            return Statistics(np.nan, np.nan, np.nan, np.nan, 0)
        sd = float(values.std(ddof=1)) if len(values) > 1 else np.nan
        rms = float(np.sqrt(np.mean(values**2)))
        return Statistics(float(values.max()), rms, float(values.mean()), sd, len(values))

    def to_dict(self) -> dict[str, Any]:
        """Return statistics and rows of every index, SI."""
        return {i: {**vars(self.statistics(i)), "rows": getattr(self, i)} for i in INDICES}


@dataclass(frozen=True)
class KindErrors:
    """Whitened errors of one kind of measurement, or of all kinds.

    Attributes
    ----------
    kind : its name; "all" for all kinds. count : measured components over all its rows.
    before, after : root mean square of the whitened residuals [sigma].
    """

    kind: str
    count: int
    before: float
    after: float

    @property
    def improvement(self) -> float:
        """Factor by which the error became smaller."""
        return self.before / self.after if self.after > 0.0 else np.inf


@dataclass(frozen=True, eq=False)
class PosePredictions:
    """Poses that a geometry predicts, and the setup parameters with which it is compared.

    Attributes
    ----------
    T : (1, n, 4, 4) [m]. joints : name -> (1, n) [SI].
    setup : the setup parameters (frames, targets, surfaces, offsets) of the measurements.
    values : (1, U) their values [SI]. kept : names of those that were given and not fitted.
    """

    T: FloatArray
    joints: Mapping[str, FloatArray]
    setup: NuisanceParameters
    values: FloatArray
    kept: tuple[str, ...]

    @property
    def fitted_count(self) -> int:
        """Number of setup parameters that were fitted to the measurements."""
        return sum(p.free and p.name not in self.kept for p in self.setup.table.entries)

    def residuals(self, observations: Sequence[Observations]) -> list[FloatArray]:
        """Return the prediction errors (r, m) of every kind."""
        return [
            o.evaluate(self.T, *self._inputs_of(i, o)).residual[0]
            for i, o in enumerate(observations)
        ]

    def differences(
        self, observations: Sequence[Observations], other: PosePredictions
    ) -> list[FloatArray]:
        """Return what every kind (r, m) would measure at the other poses minus at these."""
        differences = []
        for i, o in enumerate(observations):
            setup, joints = self._inputs_of(i, o)
            zero = np.zeros((1, *o.present.shape))
            expected = o.kind.measure(self.T[:, o.rows], zero, setup, joints)
            _, reached_joints = other._inputs_of(i, o)
            evaluation = o.kind.evaluate(other.T[:, o.rows], expected, setup, reached_joints)
            differences.append(evaluation.residual[0])
        return differences

    def _inputs_of(self, i: int, o: Observations) -> tuple[FloatArray | None, FloatArray | None]:
        """Return setup parameters (1, r, u) and joint values (1, r, j) that a kind needs."""
        setup = self.setup.select(i, self.values) if o.kind.nuisance_parameters else None
        return setup, o.kind.stack_joints(self.joints, o.rows)


@dataclass(frozen=True, eq=False)
class PredictionComparison:
    """Two geometries at the same recorded readings, at the poses that both reach.

    Attributes
    ----------
    data : the measurements with the compared rows only. rows : (r,) labels of those rows.
    usable : (n,) poses that are compared. predictable : (n,) poses whose readings determine them.
    solution : poses of the geometry after. before, after : predictions of the two geometries.
    reached : poses that the geometry after reaches when it is commanded to those of `before`.
    """

    data: Measurements
    rows: tuple[str, ...]
    usable: BoolArray
    predictable: BoolArray
    solution: Solution
    before: PosePredictions
    after: PosePredictions
    reached: PosePredictions


def compare_predictions(
    before: Mechanism,
    after: Mechanism,
    data: Measurements,
    setup_before: Mapping[str, float] | None = None,
    setup_after: Mapping[str, float] | None = None,
) -> PredictionComparison:
    """Predict measurements with two geometries of a robot.

    Parameters
    ----------
    before, after : the geometries. data : the measurements.
    setup_before, setup_after : values [SI] by name of setup parameters that are kept; the others
        are fitted to these rows.

    Raises
    ------
    DataError
        No row counts, or no pose is reached by both geometries.
    """
    rows = [
        counted
        for o in data.observations
        if len(counted := o.take((o.weight > 0.0) & o.present.any(axis=1)))
    ]
    if not rows:
        raise DataError(report_finding("residuals.no-rows-to-predict"))
    first, _ = predict_from_readings(before, data)
    last, predictable = predict_from_readings(after, data)
    commanded = inverse(after, first.T)
    usable = first.converged & last.converged & commanded.converged & predictable
    if not usable.any():
        finding = _explain_unreached(after, predictable, first.converged, last.converged)
        raise DataError(finding)
    rows = [o.take(usable[o.rows].reshape(len(o), -1).all(axis=1)) for o in rows]
    labels = tuple(
        "/".join(data.labels[i] for i in poses)
        for o in rows
        for poses in o.rows.reshape(len(o), -1)
    )
    data = replace(data, observations=tuple(rows))
    return PredictionComparison(
        data,
        labels,
        usable,
        predictable,
        last,
        predict_poses(before, data, first, usable, setup_before or {}),
        predict_poses(after, data, last, usable, setup_after or {}),
        predict_poses(before, data, commanded, usable, None),
    )


def predict_poses(
    robot: Mechanism,
    data: Measurements,
    solution: Solution,
    usable: BoolArray,
    setup: Mapping[str, float] | None,
) -> PosePredictions:
    """Return the predicted poses with setup parameters that are kept or fit these rows best.

    Parameters
    ----------
    solution : poses of `data`. usable : (n,) which of them count.
    setup : values [SI] by name that are kept; None takes the nominal values of all and fits none.
    """
    T = np.where(usable[:, None, None], solution.T, np.eye(4))
    names = list_sensed_joints(o.kind for o in data.observations)
    joints = select_joint_values(robot, names, solution.q[None], solution.state)
    unknowns = data.nuisance_parameters
    values, kept = unknowns.values(), ()
    if setup is not None and len(unknowns):
        kept = tuple(name for name in unknowns.table.names if name in setup)
        entries = tuple(
            p if p.name not in kept else replace(p, nominal=setup[p.name], free=False)
            for p in unknowns.table.entries
        )
        values = guess_nuisance_values(
            data, T, replace(unknowns, table=ParameterTable(entries)), joints
        )
    return PosePredictions(T[None], joints, unknowns, values[None], kept)


def compute_row_errors(
    observations: Sequence[Observations], residuals: Sequence[FloatArray]
) -> PoseErrors:
    """Return the errors of the rows of all kinds, one kind after the other.

    Parameters
    ----------
    observations : of every kind. residuals : (r, m) [SI] of each.
    """
    kinds = []
    for o, residual in zip(observations, residuals, strict=True):
        shown = np.where(o.present, residual, np.nan)
        length = np.array([column.dimension is Dimension.LENGTH for column in o.kind.noise_columns])
        angle = np.array([column.dimension is Dimension.ANGLE for column in o.kind.noise_columns])
        kinds.append(compute_pose_errors(shown[:, length], shown[:, angle]))
    return join_errors(kinds)


def compute_pose_errors(position: FloatArray, orientation: FloatArray) -> PoseErrors:
    """Return the errors of rows from the components of the differences.

    Parameters
    ----------
    position : (r, 3) [m] and orientation : (r, 3) [rad] components (or fewer columns, or none); NaN
        where not measured. Orientation components may be a rotation vector or differences of
        declared angles.
    """
    return PoseErrors(
        _length(position), _length(orientation), _balance(position), _balance(orientation)
    )


def join_errors(errors: Sequence[PoseErrors]) -> PoseErrors:
    """Return the errors of several sets of rows as one set."""
    joined = (
        np.concatenate([np.zeros(0), *(getattr(rows, index) for rows in errors)])
        for index in INDICES
    )
    return PoseErrors(*joined)


def compute_kind_errors(
    observations: Sequence[Observations], before: list[FloatArray], after: list[FloatArray]
) -> tuple[KindErrors, ...]:
    """Return the whitened errors of each kind and, last, of all kinds.

    Parameters
    ----------
    observations : of every kind. before, after : residuals (r, m) [SI] of each.
    """
    totals: dict[str, FloatArray] = {}
    for o, *residuals in zip(observations, before, after, strict=True):
        squares = [
            ((o.whitener @ np.where(o.present, r, 0.0)[..., None]) ** 2).sum() for r in residuals
        ]
        total = totals.setdefault(o.kind.name, np.zeros(3))
        total += [o.present.sum(), *squares]
    totals["all"] = np.sum(list(totals.values()), axis=0)
    return tuple(
        KindErrors(
            name, int(n), *(float(np.sqrt(square / n)) if n else np.nan for square in squares)
        )
        for name, (n, *squares) in totals.items()
    )


def _length(components: FloatArray) -> FloatArray:
    """Return the root of the sum of squares of the measured components, NaN without any."""
    length = np.sqrt(np.nansum(components**2, axis=1))
    return np.where(np.isfinite(components).any(axis=1), length, np.nan)


def _balance(components: FloatArray) -> FloatArray:
    """Return the largest minus the smallest measured component, NaN with fewer than two."""
    present = np.isfinite(components)
    high = np.where(present, components, -np.inf).max(axis=1, initial=-np.inf)
    low = np.where(present, components, np.inf).min(axis=1, initial=np.inf)
    enough = present.sum(axis=1) > 1
    return np.where(enough, np.where(enough, high, 0.0) - np.where(enough, low, 0.0), np.nan)


def _explain_unreached(
    robot: Mechanism, predictable: BoolArray, before: BoolArray, after: BoolArray
) -> Finding:
    """Return why no pose is left: readings are missing, or a geometry does not reach it."""
    poses, reached = len(predictable), int(before.sum())
    if not predictable.any():
        return report_finding("residuals.readings-missing", robot=robot.name, poses=poses)
    if not reached:
        return report_finding("residuals.poses-out-of-reach", robot=robot.name, poses=poses)
    return report_finding(
        "residuals.calibrated-out-of-reach",
        robot=robot.name,
        poses=poses,
        before=reached,
        after=int(after.sum()),
    )
