# SPDX-License-Identifier: Apache-2.0
"""Errors of measured rows, by quantity and target, with their statistics and the noise floor.

An error is the difference of one target (or of the tool) between prediction and measurement: its
size is the root of the sum of squares of the measured components [m] or [rad], its balance their
largest minus their smallest. A row with three targets has three position errors; statistics run
over rows x targets. Which residuals belong together is what `error_groups` of a kind says.

Kinds of measurement are compared in units of their sigma: the root mean square of W r over all
measured components, r the residuals and W the inverse Cholesky factor of their covariance, so that
the least accurate instrument does not decide alone. The noise floor of a statistic is its value for
an exact geometry, see `NoiseFloor`. Source of size and balance: "Numerical simulation of the
calibration algorithm for a 6-DOF parallel mechanism", section 4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.estimate import pose_estimate
from loopcal.estimate.posterior import combine_degrees
from loopcal.estimate.result import SMALLEST_EFFECT
from loopcal.estimate.smooth_errors import SmoothErrors
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import Observations
from loopcal.measure.readings import list_sensed_joints, select_joint_values
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import Solution, inverse, make_solution
from loopcal.numerics import statistics
from loopcal.numerics.elimination import UnknownRoot
from loopcal.numerics.trial_batch import map_arrays
from loopcal.parameters import ParameterTable
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

MOST_COMPONENTS = 3  # components of the largest error
MOST_DEGREES = 1e10  # of Student's t, beyond which it is normal
# Kind of the readings of redundant actuators, which must agree on one pose.
READINGS = "actuator readings"


class Metric(NamedTuple):
    """A number that sums up the sizes (e,) of errors, one or more."""

    words: str  # its name in tables
    compute: Callable[[FloatArray], float]  # it from the sizes
    # its value for an exact geometry, from the variances (e, c) of the noise of components, NaN
    # where absent; None where tables do not compare it with the noise
    find_noise_floor: Callable[[FloatArray], float] | None = None


def _median_of_largest(variances: FloatArray) -> float:
    """Return the median of the largest of e errors with variances (e, c), NaN where absent."""
    mean, square = np.nansum(variances, axis=1), np.nansum(variances**2, axis=1)
    mean, square = mean[mean > 0.0], square[mean > 0.0]
    if not len(mean):
        return float("nan")
    degrees, unit = mean**2 / square, square / mean
    # if all errors were like one of them, the largest would be below its limit half of the time
    exceeded = -np.expm1(np.log(0.5) / len(mean))
    limits = unit * statistics.compute_chi_square_quantile(degrees, exceeded)
    lowest = float(limits.min())

    def compute_log_probability(above: float) -> float:
        tail = statistics.compute_chi_square_tail(degrees, (lowest + above) / unit)
        return float(np.log1p(-np.minimum(tail, statistics.NEAR_ONE)).sum())

    width = float(limits.max()) - lowest
    if width > 1e-12 * lowest:
        lowest += statistics.invert_increasing(compute_log_probability, np.log(0.5), width, 50)
    return float(np.sqrt(lowest))


# All numbers that results, JSON and tables state of errors, by their names there.
METRICS: Mapping[str, Metric] = {
    "max": Metric("largest", lambda sizes: float(sizes.max()), _median_of_largest),
    "rms": Metric(
        "rms",
        lambda sizes: float(np.sqrt(np.mean(sizes**2))),
        lambda variances: float(np.sqrt(np.mean(np.sqrt(np.nansum(variances, axis=1)) ** 2))),
    ),
    "mean": Metric("mean", lambda sizes: float(sizes.mean())),
    "sd": Metric("sd", lambda sizes: float(sizes.std(ddof=1)) if len(sizes) > 1 else np.nan),
}
# Those that tables compare with the noise floor, the rms first.
SUMMARY = sorted((k for k, m in METRICS.items() if m.find_noise_floor), key=lambda k: k != "rms")


class Statistics(dict[str, float]):
    """The `METRICS` of errors (rows x targets) and their `count`, also as attributes such as `rms`.

    All metrics are NaN where there is no error.
    """

    def __getattr__(self, name: str) -> float:
        if name in self:
            return self[name]
        raise AttributeError(f"no metric has the name {name!r}. Known: {', '.join(self)}")


@dataclass(frozen=True, eq=False)
class QuantityErrors:
    """Errors of one quantity: one entry for each measured row and target."""

    dimension: Dimension  # of the errors
    components: FloatArray  # (e, 3) differences [SI], NaN where not measured
    rows: IntArray  # (e,) number of the row of each entry
    targets: tuple[str, ...]  # (e,) names; empty for the only one
    measured: tuple[str, ...]  # names of the components that are measured, such as ("z",)

    @property
    def size(self) -> FloatArray:
        """(e,) root of the sum of squares of the measured components [m] or [rad]."""
        return np.sqrt(np.nansum(self.components**2, axis=1))

    @property
    def balance(self) -> FloatArray:
        """(e,) largest minus smallest measured component; NaN with fewer than two."""
        span = np.fmax.reduce(self.components, axis=1) - np.fmin.reduce(self.components, axis=1)
        return np.where(np.isfinite(self.components).sum(axis=1) > 1, span, np.nan)

    @property
    def statistics(self) -> Statistics:
        """Statistics of the size."""
        return compute_statistics(self.size)

    def take(self, rows: IntArray) -> QuantityErrors:
        """Return the errors of some rows only."""
        kept = np.isin(self.rows, rows)
        targets = tuple(np.array(self.targets, dtype=object)[kept])
        return replace(
            self, components=self.components[kept], rows=self.rows[kept], targets=targets
        )


# Errors of a quantity that no row measures.
NO_ERRORS = QuantityErrors(
    Dimension.LENGTH, np.zeros((0, MOST_COMPONENTS)), np.zeros(0, np.intp), (), ()
)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of r rows by quantity: "position", "orientation", "length" and others."""

    # the errors of each quantity that some row measures
    quantities: Mapping[str, QuantityErrors] = field(default_factory=dict)

    def __getitem__(self, quantity: str) -> QuantityErrors:
        return self.quantities.get(quantity, NO_ERRORS)

    @property
    def position(self) -> FloatArray:
        """(e,) sizes of the position errors [m], one for each row and target."""
        return self["position"].size

    @property
    def orientation(self) -> FloatArray:
        """(e,) sizes of the orientation errors [rad]."""
        return self["orientation"].size

    def statistics(self, quantity: str) -> Statistics:
        """Return the statistics of the sizes of a quantity."""
        return self[quantity].statistics

    def take(self, rows: IntArray) -> PoseErrors:
        """Return the errors of some rows only."""
        taken = {name: errors.take(rows) for name, errors in self.quantities.items()}
        return PoseErrors({name: errors for name, errors in taken.items() if len(errors.rows)})

    def to_dict(self) -> dict[str, Any]:
        """Return statistics, sizes, balances, rows and targets of every quantity, SI."""
        return {
            name: {
                **errors.statistics,
                "errors": errors.size,
                "balance": errors.balance,
                "rows": errors.rows,
                "targets": errors.targets,
                "components": errors.measured,
                "dimension": errors.dimension,
            }
            for name, errors in self.quantities.items()
        }


@dataclass(frozen=True)
class NoiseFloor:
    """Errors that an exact geometry would show, because the measurement itself has noise.

    With the covariances S_i of the e errors: rms^2 = mean of trace S_i. The largest is the median
    of the largest of e errors of that noise; the square of an error is taken as a multiple of
    chi-square with the same mean and variance, which is exact for components of equal sigma. The
    noise of uncertain joint readings is not part of it, so with such readings it is a lower bound.
    """

    # metric of `SUMMARY` -> quantity -> its value [m] or [rad]
    metrics: Mapping[str, Mapping[str, float]]

    def to_dict(self) -> Mapping[str, Mapping[str, float]]:
        """Return the values by metric and quantity for JSON, SI."""
        return self.metrics

    @property
    def rms(self) -> Mapping[str, float]:
        """Root mean square of the errors of each quantity [m] or [rad]."""
        return self.metrics["rms"]


@dataclass(frozen=True)
class KindErrors:
    """Whitened errors of one kind of measurement, or of all kinds."""

    kind: str  # its name; "all" for all kinds
    count: int  # measured components over all its rows
    # before, after: root mean square of the whitened residuals [sigma]
    before: float
    after: float
    noise_floor: float = 1.0  # the value for an exact geometry [sigma]
    # root mean square of their difference, which is that of the two predictions [sigma]; NaN
    # where it was not stored
    change: float = np.nan
    # standard deviation of `gain` by slow errors of the poses [sigma], and its degrees of freedom
    slow: float = 0.0
    slow_degrees: float = 1.0

    @property
    def gain(self) -> float:
        """By how much the geometry after calibration predicts these rows better [sigma].

        With the whitened residuals b and a of the geometries before and after, and d = b - a:
        (|b|^2 - |a|^2) / (2 |d|). The true errors b' and a' contain no noise n, so that
        (|b'|^2 - |a'|^2) / (2 |d|) is this plus n.d / |d|, which is standard normal where d was
        estimated from other rows. 0 where the predictions are equal.
        """
        if self.change == 0.0:
            return 0.0
        return float(np.sqrt(self.count)) * (self.before**2 - self.after**2) / (2.0 * self.change)

    def compute_better_probability(
        self, noise_scale: float, noise_degrees: float, values: int
    ) -> float:
        """Return the probability that the geometry after calibration predicts these rows better,
        without their noise and, where they have slow errors, at other poses of the same region; NaN
        where too little is known.

        noise_scale, noise_degrees : factor on the stated sigmas, and its degrees of freedom. With
            none, the part of b that is orthogonal to d is the noise: equal for both geometries.
        values : measured values that are left to check the geometry.
        """
        scale, degrees = noise_scale, noise_degrees
        if not noise_degrees > 0.0:
            along = 0.5 * self.change * np.sqrt(self.count) + self.gain  # b.d / |d|
            degrees = min(self.count, values) - 1
            scale = np.sqrt(max(self.count * self.before**2 - along**2, 0.0) / max(degrees, 1))
        if not degrees >= 1 or not np.isfinite(self.gain):
            return float("nan")
        squares = np.array([scale, self.slow]) ** 2
        total = squares.sum()
        if total == 0.0 or self.gain == 0.0:
            return 0.5 + 0.5 * float(np.sign(self.gain))
        both = zip(squares, (degrees, self.slow_degrees), strict=True)
        degrees = min(float(combine_degrees(total, both)), MOST_DEGREES)
        return float(statistics.student_probability(degrees, self.gain / np.sqrt(total)))


def compute_statistics(values: FloatArray) -> Statistics:
    """Return the statistics of errors (e,); NaN are not counted."""
    values = values[np.isfinite(values)]
    metrics = {name: m.compute(values) if len(values) else np.nan for name, m in METRICS.items()}
    return Statistics({**metrics, "count": len(values)})


def compute_row_errors(
    observations: Sequence[Observations], residuals: Sequence[FloatArray], first_row: int = 0
) -> PoseErrors:
    """Return the errors of the rows of all kinds, one kind after the other.

    observations : of every kind. residuals : (r, m) [SI] of each. first_row : number of the first.
    """
    errors_by_quantity: dict[str, list[QuantityErrors]] = {}
    for o, residual in zip(observations, residuals, strict=True):
        shown = np.where(o.present, residual, np.nan)
        for group in o.kind.error_groups:
            components = np.full((len(o), MOST_COMPONENTS), np.nan)
            components[:, : len(group.columns)] = shown[:, list(group.columns)]
            measured = np.isfinite(components).any(axis=1)
            columns = zip(group.components, components.T, strict=False)
            errors = QuantityErrors(
                group.dimension,
                components[measured],
                first_row + np.flatnonzero(measured),
                (group.target,) * int(measured.sum()),
                tuple(name for name, values in columns if np.isfinite(values).any()),
            )
            errors_by_quantity.setdefault(group.quantity, []).append(errors)
        first_row += len(o)
    joined = {name: _join(errors_by_kind) for name, errors_by_kind in errors_by_quantity.items()}
    return PoseErrors({name: errors for name, errors in joined.items() if len(errors.rows)})


def join_errors(errors: Sequence[PoseErrors]) -> PoseErrors:
    """Return the errors of several sets of rows as one set; their row numbers must differ."""
    names = dict.fromkeys(name for of_set in errors for name in of_set.quantities)
    return PoseErrors(
        {name: _join([e[name] for e in errors if name in e.quantities]) for name in names}
    )


def sum_kinds(
    observations: Sequence[Observations], before: list[FloatArray], after: list[FloatArray]
) -> dict[str, FloatArray]:
    """Return the totals of each kind from residuals (r, m), see `summarize_kinds`."""
    totals: dict[str, FloatArray] = {}
    for o, *residuals in zip(observations, before, after, strict=True):
        squares = [
            ((o.whitener @ np.where(o.present, r, 0.0)[..., None]) ** 2).sum()
            for r in (*residuals, residuals[0] - residuals[1])
        ]
        total = totals.setdefault(o.kind.name, np.zeros(4))
        total += [o.present.sum(), *squares]
    return totals


def summarize_kinds(totals: Mapping[str, FloatArray]) -> tuple[KindErrors, ...]:
    """Return the errors of each kind and, last, of all kinds.

    `totals` are the count and the sums of squares before, after and of the change, of each kind.
    """
    with_sum = {**totals, "all": np.sum([np.zeros(4), *totals.values()], axis=0)}
    kinds = []
    for name, (n, *squares) in with_sum.items():
        roots = [float(np.sqrt(square / n)) if n else np.nan for square in squares]
        kinds.append(KindErrors(name, int(n), roots[0], roots[1], change=roots[2]))
    return tuple(kinds)


def compute_noise_floor(observations: Sequence[Observations]) -> NoiseFloor:
    """Return the noise floor of rows with their stated covariances."""
    variances = [np.diagonal(o.covariance, axis1=1, axis2=2) for o in observations]
    both = zip(observations, variances, strict=True)
    sigma = [np.sqrt(np.where(o.present, v, 0.0)) for o, v in both]
    errors = compute_row_errors(observations, sigma).quantities
    floors = {name: METRICS[name].find_noise_floor for name in SUMMARY}
    return NoiseFloor(
        {
            name: {quantity: find(e.components**2) for quantity, e in errors.items()}
            for name, find in floors.items()
            if find is not None
        }
    )


def _join(errors_by_kind: Sequence[QuantityErrors]) -> QuantityErrors:
    """Return the errors of one quantity of several kinds or sets as one."""
    names = dict.fromkeys(name for errors in errors_by_kind for name in errors.measured)
    return QuantityErrors(
        errors_by_kind[0].dimension,
        np.concatenate([errors.components for errors in errors_by_kind]),
        np.concatenate([errors.rows for errors in errors_by_kind]),
        tuple(target for errors in errors_by_kind for target in errors.targets),
        tuple(names),
    )


@dataclass(frozen=True, eq=False)
class PosePredictions:
    """Poses that a geometry predicts, and the setup parameters with which it is compared."""

    T: FloatArray  # (1, n, 4, 4) [m]
    joints: Mapping[str, FloatArray]  # name -> (1, n) [SI]
    # the setup parameters (frames, targets, surfaces, offsets) of the measurements
    setup: NuisanceParameters
    values: FloatArray  # (1, U) their values [SI]
    kept: frozenset[str]  # names of those that were given and not fitted

    @property
    def fitted_count(self) -> int:
        """Number of setup parameters that were fitted to the measurements."""
        return sum(p.free and p.name not in self.kept for p in self.setup.table.entries)

    def regrouped(self, data: Measurements) -> PosePredictions:
        """Return the same prediction for fewer rows of the same poses."""
        setup = data.nuisance_parameters
        places = {name: i for i, name in enumerate(self.setup.table.names)}
        values = self.values[:, [places[name] for name in setup.table.names]]
        return replace(self, setup=setup, values=values)

    def residuals(self, observations: Sequence[Observations]) -> list[FloatArray]:
        """Return the prediction errors (r, m) of every kind."""
        return [
            o.compute_residuals(self.T, *self._inputs_of(i, o))[0]
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
            expected = o.kind.measure(self.T[:, o.rows], zero, setup, joints, o.labels)
            _, reached_joints = other._inputs_of(i, o)
            at = other.T[:, o.rows], expected, setup, reached_joints
            differences.append(o.kind.compute_residuals(*at)[0])
        return differences

    def setup_deviations(
        self, observations: Sequence[Observations], root: UnknownRoot
    ) -> list[FloatArray]:
        """Return how far the setup parameters with a square root [SI] of their covariance
        move the predictions (r,) of every kind, in standard deviations of its noise; 0 where that
        is rounding beside what each of them does by itself.
        """
        alone, sizes = np.linalg.norm(root.values, axis=1), []
        for i, o in enumerate(observations):
            used, factor = self.setup.indices[i], self.setup.factor(i)
            inputs = self._inputs_of(i, o)
            sizes.append(size := np.zeros(len(o)))
            if not used.size:
                continue
            sets, set_of = statistics.find_distinct_rows(used)
            order = np.argsort(set_of, kind="stable")
            parts = np.split(order, np.cumsum(np.bincount(set_of))[:-1])
            for own, mine in zip(sets, parts, strict=True):  # so that derivatives are of few rows
                of_part = (None if each is None else each[:, mine] for each in inputs)
                by_setup = o.take(mine).evaluate(self.T, *of_part).nuisance
                assert by_setup is not None
                moved = o.whitener[mine] @ by_setup[0]
                moved = moved if factor is None else moved * factor[mine, None]
                together = np.linalg.norm(moved @ root.fill(own), axis=(1, 2))
                most = np.linalg.norm(moved * alone[own], axis=(1, 2))
                size[mine] = np.where(together > SMALLEST_EFFECT * most, together, 0.0)
        return sizes

    def _inputs_of(self, i: int, o: Observations) -> tuple[FloatArray | None, FloatArray | None]:
        """Return setup parameters (1, r, u) and joint values (1, r, j) that a kind needs."""
        setup = self.setup.select(i, self.values) if o.kind.nuisance_parameters else None
        return setup, o.kind.stack_joints(self.joints, o.rows)


@dataclass(frozen=True, eq=False)
class PredictionComparison:
    """Two geometries at the same recorded readings, at the poses that both reach."""

    data: Measurements  # the measurements with the compared rows only
    rows: tuple[str, ...]  # (r,) labels of those rows
    usable: BoolArray  # (n,) poses that are compared
    predictable: BoolArray  # (n,) poses that the data determine
    estimated: BoolArray  # (n,) poses of these that were estimated together with their rows
    absorbed: IntArray  # (n,) number of residuals that each of these takes up
    solution: Solution  # poses of the geometry after
    # before, after: predictions of the two geometries
    before: PosePredictions
    after: PosePredictions
    # poses that the geometry after reaches when it is commanded to those of `before`
    reached: PosePredictions
    # of the two geometries, the fits of redundant readings alone; None where there are none
    reading_fits: tuple[pose_estimate.PoseFit | None, pose_estimate.PoseFit | None]

    def count_judged(self) -> int:
        """Return the number of poses that rows or redundant readings check."""
        judged = np.zeros(len(self.usable), dtype=bool)
        for o in self.data.observations:
            judged[o.rows] = True
        return int((self.usable if self.readings is not None else judged & self.usable).sum())

    def without(self, poses: BoolArray) -> PredictionComparison:
        """Return the comparison without some poses (n,), with the same setup parameters."""
        data, usable = _take_rows(self.data, ~poses), self.usable & ~poses
        return replace(
            self,
            data=data,
            rows=label_rows(data),
            usable=usable,
            absorbed=np.where(usable, self.absorbed, 0),
            before=self.before.regrouped(data),
            after=self.after.regrouped(data),
            reached=self.reached.regrouped(data),
        )

    @property
    def readings(self) -> KindErrors | None:
        """Errors of the readings of redundant actuators; None where there are none."""
        totals = self._sum_readings()
        return None if totals is None else summarize_kinds({READINGS: totals})[0]

    def kind_errors(self) -> tuple[KindErrors, ...]:
        """Return the errors of each kind, readings among them, and last of all kinds."""
        rows, readings = self.data.observations, self._sum_readings()
        totals = sum_kinds(rows, self.before.residuals(rows), self.after.residuals(rows))
        if readings is not None:
            totals = {k: t for k, t in {**totals, READINGS: readings}.items() if t[0]}
        return summarize_kinds(totals)

    def measure_slow_gain(self, errors: SmoothErrors) -> float:
        """Return the standard deviation of `KindErrors.gain` of all rows by slow errors e of their
        poses: that of d.e / |d|, with the change d of the predictions.
        """
        rows, T = self.data.observations, self.after.T[0]
        both = (self.before.residuals(rows), self.after.residuals(rows))
        own = errors.recentered(T[self.usable])
        twists, square, by_errors = own.twists(T), 0.0, np.zeros(own.count)
        for i, (o, first, last) in enumerate(zip(rows, *both, strict=True)):
            change = o.whitener @ np.where(o.present, first - last, 0.0)[..., None]
            square += float((change**2).sum())
            jacobian = o.evaluate(self.after.T, *self.after._inputs_of(i, o)).jacobian[0]
            J = jacobian.reshape(len(o), -1, jacobian.shape[-2], 6)
            by_twist = np.einsum("rm,rkmc->rkc", (o.whitener.swapaxes(-1, -2) @ change)[..., 0], J)
            by_errors += np.einsum("rkc,rkce->e", by_twist, twists[o.rows.reshape(len(o), -1)])
        return float(np.linalg.norm(by_errors) / np.sqrt(square)) if square > 0.0 else 0.0

    def _sum_readings(self) -> FloatArray | None:
        """Return the totals of redundant readings, see `summarize_kinds`."""
        first, last = self.reading_fits
        if first is None or last is None:
            return None
        residuals = [fit.reading_residuals[self.usable] for fit in (first, last)]
        squares = [(r**2).sum() for r in (*residuals, residuals[0] - residuals[1])]
        return np.array([int(last.left[self.usable].sum()), *squares])


def compare_predictions(
    before: Mechanism,
    after: Mechanism,
    data: Measurements,
    setup_before: Mapping[str, float] | None = None,
    setup_after: Mapping[str, float] | None = None,
) -> PredictionComparison:
    """Predict measurements with two geometries of a robot.

    setup_before, setup_after : values [SI] by name of setup parameters that are kept; the others
        are fitted to these rows.
    """
    counted = (o.take((o.weight > 0.0) & o.present.any(axis=1)) for o in data.observations)
    data = _take_rows(replace(data, observations=tuple(counted)), np.ones(data.n_poses, dtype=bool))
    if not data.n_rows and after.redundancy is None:
        raise DataError.of("residuals.no-rows-to-predict")
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
        reaching = [int(each.solution.converged.sum()) for each in (first, last)]
        numbers: dict[str, Any] = {"robot": after.name, "poses": len(predictable)}
        if not predictable.any():
            raise DataError.of("residuals.readings-missing", **numbers)
        if not any(reaching):
            raise DataError.of("residuals.poses-out-of-reach", **numbers)
        if not reaching[0]:
            numbers = {"poses": len(predictable), "after": reaching[1]}
            raise DataError.of("residuals.before-out-of-reach", **numbers)
        numbers |= {"before": reaching[0], "after": reaching[1]}
        raise DataError.of("residuals.calibrated-out-of-reach", **numbers)
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
    readings: pose_estimate.PoseFit | None


def _locate_poses(
    robot: Mechanism, data: Measurements, setup: Mapping[str, float]
) -> _LocatedPoses:
    """Return the poses of a geometry, with setup parameters that are kept."""
    solution, known = pose_estimate.predict_from_readings(robot, data)
    readings = None if robot.redundancy is None else pose_estimate.fit_poses(robot, data)
    nothing = np.zeros(data.n_poses, dtype=np.int64)
    if known.all() or not data.n_rows:
        return _LocatedPoses(solution, known, np.zeros_like(known), nothing, readings)
    fitted = pose_estimate.fit_poses(robot, data, _fix_nuisance(data.nuisance_parameters, setup))
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

    solution : poses of `data`. usable : (n,) which of them count.
    setup : values [SI] by name that are kept; None takes the nominal values of all and fits none.
    """
    T = np.where(usable[:, None, None], solution.T, np.eye(4))
    names = list_sensed_joints(o.kind for o in data.observations)
    joints = select_joint_values(robot, names, solution.q[None], solution.state)
    unknowns = data.nuisance_parameters
    values, kept = unknowns.values(), frozenset[str]()
    if setup is not None and len(unknowns):
        kept = frozenset(unknowns.table.names) & setup.keys()
        if len(kept) == len(unknowns):
            values = np.array([setup[name] for name in unknowns.table.names])
        else:
            values = pose_estimate.fit_nuisance_values(
                robot, data, T, _fix_nuisance(unknowns, setup), joints
            )
    return PosePredictions(T[None], joints, unknowns, values[None], kept)


def _fix_nuisance(nuisance: NuisanceParameters, kept: Mapping[str, float]) -> NuisanceParameters:
    """Return the nuisance parameters with those that are kept fixed at their values [SI]."""
    entries = tuple(
        p if p.name not in kept else replace(p, nominal=kept[p.name], free=False)
        for p in nuisance.table.entries
    )
    return replace(nuisance, table=ParameterTable(entries))
