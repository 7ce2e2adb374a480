# SPDX-License-Identifier: Apache-2.0
"""Predict the same measurements with two geometries of a robot.

A prediction error is what a model predicts at the readings that were recorded, minus what was
measured; `loopcal.diagnose.row_errors` has its statistics. Where readings do not determine a pose,
because one is missing, the pose is estimated together with the rows at it; its errors are then
residuals, and the pose takes up some of them. Readings of redundant actuators must agree on one
pose, so they are rows themselves: true minus recorded readings at the pose that fits them best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loopcal import measure
from loopcal.diagnose.row_errors import READINGS, KindErrors, compute_kind_errors, summarize_kinds
from loopcal.errors import DataError
from loopcal.estimate.poses.prediction import PoseFit, fit_poses, predict_from_readings
from loopcal.findings import Finding, report_finding
from loopcal.measure import (
    Measurements,
    NuisanceParameters,
    Observations,
    list_sensed_joints,
    select_joint_values,
)
from loopcal.mechanism import Mechanism, Solution, inverse, make_solution, read_coordinates
from loopcal.numerics.trial_batch import map_arrays
from loopcal.parameters import ParameterTable
from loopcal.typing import BoolArray, FloatArray, IntArray


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

    def regrouped(self, data: Measurements) -> PosePredictions:
        """Return the same prediction for fewer rows of the same poses."""
        setup, place = (
            data.nuisance_parameters,
            {n: i for i, n in enumerate(self.setup.table.names)},
        )
        values = self.values[:, [place[name] for name in setup.table.names]]
        return replace(self, setup=setup, values=values)

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
    usable : (n,) poses that are compared. predictable : (n,) poses that the data determine.
    estimated : (n,) poses of these that were estimated together with their rows.
    absorbed : (n,) number of residuals that each of these takes up.
    solution : poses of the geometry after. before, after : predictions of the two geometries.
    reached : poses that the geometry after reaches when it is commanded to those of `before`.
    reading_fits : of the two geometries, the fits of redundant readings alone; None where there are
        none.
    """

    data: Measurements
    rows: tuple[str, ...]
    usable: BoolArray
    predictable: BoolArray
    estimated: BoolArray
    absorbed: IntArray
    solution: Solution
    before: PosePredictions
    after: PosePredictions
    reached: PosePredictions
    reading_fits: tuple[PoseFit | None, PoseFit | None]

    def count_judged(self) -> int:
        """Return the number of poses that rows or redundant readings check."""
        judged = np.zeros(len(self.usable), dtype=bool)
        for o in self.data.observations:
            judged[o.rows] = True
        return int((self.usable if self.readings is not None else judged & self.usable).sum())

    def without(self, poses: BoolArray) -> PredictionComparison:
        """Return the comparison without some poses (n,), with the same setup parameters."""
        data, usable = _take_rows(self.data, ~poses), self.usable & ~poses
        predictions = {
            name: getattr(self, name).regrouped(data) for name in ("before", "after", "reached")
        }
        return replace(
            self,
            data=data,
            rows=label_rows(data),
            usable=usable,
            absorbed=np.where(usable, self.absorbed, 0),
            **predictions,
        )

    @property
    def readings(self) -> KindErrors | None:
        """Errors of the readings of redundant actuators; None where there are none."""
        return _compare_readings(*self.reading_fits, self.usable)

    def kind_errors(self) -> tuple[KindErrors, ...]:
        """Return the errors of each kind, readings among them, and last of all kinds."""
        rows = self.data.observations
        kinds = compute_kind_errors(rows, self.before.residuals(rows), self.after.residuals(rows))
        if self.readings is None:
            return kinds
        errors = (*kinds[:-1], self.readings)
        return summarize_kinds(
            {
                k.kind: np.array([1.0, k.before**2, k.after**2, k.change**2]) * k.count
                for k in errors
                if k.count
            }
        )


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
    counted = (o.take((o.weight > 0.0) & o.present.any(axis=1)) for o in data.observations)
    data = _take_rows(replace(data, observations=tuple(counted)), np.ones(data.n_poses, dtype=bool))
    if not data.n_rows and after.program.sigma is None:
        raise DataError(report_finding("residuals.no-rows-to-predict"))
    first, last = (
        _locate_poses(robot, data, setup or {})
        for robot, setup in ((before, setup_before), (after, setup_after))
    )
    predictable = first.is_determined & last.is_determined
    # a controller states coordinates; of a whole pose, `inverse` would return the nearest one
    commanded = inverse(after, read_coordinates(first.solution.T, after.controlled))
    reached = first.solution.converged & last.solution.converged & commanded.converged
    usable = reached & predictable
    if not usable.any():
        solutions = (first.solution.converged, last.solution.converged)
        raise DataError(_explain_unreached(after, predictable, *solutions))
    data = _take_rows(data, usable)
    return PredictionComparison(
        data,
        label_rows(data),
        usable,
        predictable,
        last.estimated,
        np.where(last.estimated & usable, last.absorbed, 0),
        last.solution,
        predict_poses(before, data, first.solution, usable, setup_before or {}),
        predict_poses(after, data, last.solution, usable, setup_after or {}),
        predict_poses(before, data, commanded, usable, None),
        (first.readings, last.readings),
    )


class _LocatedPoses(NamedTuple):
    """Poses of a geometry: from readings, or where `estimated` (n,) together with their rows.

    `readings` is the fit of redundant readings alone; None where they are not redundant.
    """

    solution: Solution
    is_determined: BoolArray
    estimated: BoolArray
    absorbed: IntArray
    readings: PoseFit | None


def _locate_poses(
    robot: Mechanism, data: Measurements, setup: Mapping[str, float]
) -> _LocatedPoses:
    """Return the poses of a geometry, with setup parameters that are kept."""
    solution, known = predict_from_readings(robot, data)
    readings = None if robot.program.sigma is None else fit_poses(robot, data)
    nothing = np.zeros(data.n_poses, dtype=np.int64)
    if known.all() or not data.n_rows:
        return _LocatedPoses(solution, known, np.zeros_like(known), nothing, readings)
    fitted = fit_poses(robot, data, _fix_nuisance(data.nuisance_parameters, setup))
    reached = fitted.solution.converged
    estimated = ~known & fitted.is_determined & reached & (fitted.left > 0)

    def choose(predicted: np.ndarray, of_rows: np.ndarray) -> np.ndarray:
        mask = estimated.reshape(1, -1, *[1] * (predicted.ndim - 2))
        return np.where(mask, of_rows, predicted)

    state = map_arrays(choose, solution.state, fitted.solution.state)
    q = np.where(estimated[:, None], fitted.solution.q, solution.q)
    mixed = make_solution(robot, state, q)
    return _LocatedPoses(mixed, known | estimated, estimated, fitted.absorbed, readings)


def _take_rows(data: Measurements, poses: BoolArray) -> Measurements:
    """Return the measurements with the rows of some poses (n,) only, without kinds of no row."""
    kept = (
        o.take(poses[o.rows].reshape(len(o), -1).all(axis=1)) for o in data.observations if len(o)
    )
    return replace(data, observations=tuple(o for o in kept if len(o)))


def label_rows(data: Measurements) -> tuple[str, ...]:
    """Return the label of the pose of each row, or of the poses that it compares."""
    return tuple(
        "/".join(data.labels[i] for i in poses)
        for o in data.observations
        for poses in o.rows.reshape(len(o), -1)
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
        values = measure.guess_nuisance_values(data, T, _fix_nuisance(unknowns, setup), joints)
    return PosePredictions(T[None], joints, unknowns, values[None], kept)


def _fix_nuisance(nuisance: NuisanceParameters, kept: Mapping[str, float]) -> NuisanceParameters:
    """Return the nuisance parameters with those that are kept fixed at their values [SI]."""
    entries = tuple(
        p if p.name not in kept else replace(p, nominal=kept[p.name], free=False)
        for p in nuisance.table.entries
    )
    return replace(nuisance, table=ParameterTable(entries))


def _compare_readings(
    first: PoseFit | None, last: PoseFit | None, usable: BoolArray
) -> KindErrors | None:
    """Return the whitened errors of redundant readings of two geometries, at usable poses."""
    if first is None or last is None:
        return None
    residuals = [fit.reading_residuals[usable] for fit in (first, last)]
    squares = [(r**2).sum() for r in (*residuals, residuals[0] - residuals[1])]
    count = int(last.left[usable].sum())
    return summarize_kinds({READINGS: np.array([count, *squares])})[0]


def _explain_unreached(
    robot: Mechanism, predictable: BoolArray, before: BoolArray, after: BoolArray
) -> Finding:
    """Return why no pose is left: readings are missing, or a geometry does not reach it."""
    poses, reached, calibrated = len(predictable), int(before.sum()), int(after.sum())
    if not predictable.any():
        return report_finding("residuals.readings-missing", robot=robot.name, poses=poses)
    if not reached and calibrated:
        return report_finding("residuals.before-out-of-reach", poses=poses, after=calibrated)
    if not reached:
        return report_finding("residuals.poses-out-of-reach", robot=robot.name, poses=poses)
    return report_finding(
        "residuals.calibrated-out-of-reach",
        robot=robot.name,
        poses=poses,
        before=reached,
        after=calibrated,
    )
