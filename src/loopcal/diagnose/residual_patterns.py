# SPDX-License-Identifier: Apache-2.0
"""Test whether residuals depend on order, time, temperature, session or actuator readings.

With r the residuals that no parameter explains, of nu degrees of freedom (`ResidualRows`), and Q
the basis of the part of an effect's columns that nothing estimated explains, of rank q,

    F = |Q'r|^2 / q  /  ((|r|^2 - |Q'r|^2) / (nu - q))

has an F distribution for independent normal errors of any size. The correlation of neighbors in the
order of measurement is r'L r / |r|^2, L the mean of the shifts by one row in both directions within
every series. Its mean and variance for independent errors follow from the traces of M L and
(M L)^2, M = I - U U'; it is compared with the beta distribution on (-1, 1) of these moments.
Source: Durbin and Watson, Testing for serial correlation in least squares regression, Biometrika
37 (1950) and 58 (1971).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.identification import prepare_fitted_data
from loopcal.estimate.linearization import LeverageRows
from loopcal.estimate.problem import Problem
from loopcal.estimate.residual_test import FALSE_ALARMS
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.elimination import TreeElimination
from loopcal.numerics.split_columns import EXPLAINED, SplitColumns, span_columns, split_columns
from loopcal.numerics.statistics import (
    Remainder,
    VarianceComponent,
    beta_probability,
    choose_evenly,
    compute_f_tail,
    find_distinct,
)
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension


class FitRoot(NamedTuple):
    """How independent variables move the estimate, and the setup at a known machine [SI].

    machine : (p, k) by those of the machine. setup : (s,) the setup parameters in whose place the
    others are. elimination : of the U setup parameters; None without any.
    """

    machine: FloatArray
    setup: IntArray
    elimination: TreeElimination | None

    def times(self, x: FloatArray) -> FloatArray:
        """Return what variables x (s + k, c) do (p + U, c)."""
        s, done = len(self.setup), self.elimination
        moved = np.zeros((0 if done is None else done.shift.shape[1], x.shape[1]))
        moved[self.setup] = x[:s]
        own = moved if done is None else done.move_unknowns(moved)
        return np.concatenate([self.machine @ x[s:], own])


@dataclass(frozen=True, eq=False)
class ResidualRows:
    """R whitened rows of a fit, those of one series (a kind and its column) in order."""

    basis: SplitColumns  # (R, q) orthonormal, what is estimated
    residual: FloatArray  # (R,) of the least-squares fit
    # (R, s + k) change of the variables of the setup, and of the k directions of the fit, by an
    # error of each row: an error e of the rows changes the estimate, and the setup at a known
    # machine, by root gain' e, up to its sign
    gain: SplitColumns
    root: FitRoot
    # kind, row, column: (R,) number of the kind, of its row, and of its residual
    kind: IntArray
    row: IntArray
    column: IntArray
    series: IntArray  # (R,) number of the series, in ascending order

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the residuals."""
        return self.basis.shape[0] - self.basis.shape[1]

    @property
    def remainder(self) -> Remainder:
        """What independent errors of the rows leave."""
        return Remainder(self.basis, self.residual, float(self.degrees))

    @cached_property
    def square(self) -> float:
        """Sum of squares of the residuals."""
        return float((self.residual**2).sum())

    def project(self, columns: FloatArray) -> FloatArray:
        """Return the part of columns (R, c) that nothing estimated explains; 0 for rounding."""
        left = self.basis.remove(self.basis.remove(columns))  # the first one leaves rounding
        size = np.linalg.norm(columns, axis=0)
        return np.where(np.linalg.norm(left, axis=0) > EXPLAINED * size, left, 0.0)

    def with_effects(self, columns: FloatArray) -> ResidualRows:
        """Return the rows as if the fit had also estimated effects with these columns (R, c)."""
        new = span_columns(SplitColumns.of(self.project(columns)))
        return replace(self, basis=self.basis.append(new.wide), residual=new.remove(self.residual))

    def move(self, errors: FloatArray) -> FloatArray:
        """Return the change (p + U, c) [SI] of the estimate, and of the setup at a known machine,
        by errors (R, c) of the rows.
        """
        return self.root.times(self.gain.products(errors))

    def without(self, rows: IntArray) -> ResidualRows:
        """Return the rows as if the fit had not used some of them (w,)."""
        kept = np.delete(np.arange(len(self.residual)), rows)
        basis = span_columns(self.basis.take(kept))
        return replace(
            self,
            basis=basis,
            residual=basis.remove(self.residual[kept]),
            gain=self.gain.take(kept),
            kind=self.kind[kept],
            row=self.row[kept],
            column=self.column[kept],
            series=self.series[kept],
        )

    def take_poses(self, data: Measurements) -> ResidualRows:
        """Return the rows as if the fit had only used an even choice of `MOST_POSES` poses, fewer
        where their rows are more than `MOST_VALUES`.
        """
        most = int(MOST_VALUES * data.n_poses / max(len(self.residual), 1))
        chosen = choose_evenly(data.n_poses, min(MOST_POSES, max(most, FEWEST_POSES)))
        if len(chosen) == data.n_poses:
            return self
        left = ~np.isin(self.locate_poses(data), chosen)
        return self.without(np.flatnonzero(left))

    def locate_poses(self, data: Measurements) -> IntArray:
        """Return the first pose (R,) of each row."""
        pose = np.zeros(len(self.residual), dtype=np.int64)
        for number, o in enumerate(o for o in data.observations if len(o)):
            own = self.kind == number
            pose[own] = o.rows.reshape(len(o), -1)[self.row[own], 0]
        return pose


def linearize_examined(
    fit: Identification, data: Measurements, linear: FitLinearization | None = None
) -> FitLinearization:
    """Linearize the rows of a fit as `linearize_fit`; of exact readings and more than `EXAMINED`
    residuals those of a part of the poses, as if it had been made from these: `MOST_POSES` runs in
    their order, evenly chosen, that determine the same setup parameters.
    """
    if linear is not None:
        known = linear.fit
        fit = replace(fit, pose_weights=known.pose_weights, options=known.options)
        return linear._replace(fit=fit)
    prepared = prepare_fitted_data(fit, data)
    if prepared.n_rows <= EXAMINED or fit.poses is not None:
        return linearize_fit(fit, data)
    first = choose_evenly(data.n_poses, MOST_POSES)
    length = max(EXAMINED * data.n_poses // (prepared.n_rows * len(first)), 1)
    poses = find_distinct(np.minimum(first[:, None] + np.arange(length), data.n_poses - 1).ravel())
    part = prepared.take(poses)
    if part.nuisance_parameters.table.names != prepared.nuisance_parameters.table.names:
        return linearize_fit(fit, data)
    options = replace(fit.options, excluded_poses=())  # their rows have no weight
    weights = fit.pose_weights[poses]
    return linearize_fit(replace(fit, options=options, pose_weights=weights), part)


class StackedRows(NamedTuple):
    """R rows of a problem, those of one series (a kind and its column) in order."""

    setup: IntArray  # (s,) numbers of the setup parameters
    columns: SplitColumns  # (R, s + p) by these and the parameters
    residual: FloatArray  # (R,)
    kind: IntArray
    row: IntArray
    column: IntArray
    series: IntArray


def collect_rows(
    data: Measurements, problem: Problem, blocks: Iterable[Sequence[LeverageRows]]
) -> StackedRows | None:
    """Return the measured rows of a problem of exact readings, block by block; None without any."""
    observations = [rows for rows in data.observations if len(rows)]
    moved: list[tuple[FloatArray, IntArray]] = []  # present rows by setup parameters
    groups: list[tuple[FloatArray, IntArray, IntArray, IntArray]] = []  # and by the others
    for block in blocks:
        for part in block:
            present = np.diagonal(observations[part.kind].whitener, axis1=1, axis2=2) != 0.0
            i, own = np.nonzero(present[part.numbers[:, None], part.columns])
            kind, w = np.full(len(i), part.kind), part.unknowns.shape[1]
            rows, column = part.rows[i, own], part.columns[i, own]
            moved.append((rows[:, :w], part.unknowns[i]))
            groups.append((rows[:, w:], kind, part.numbers[i], column))
    if not groups:
        return None
    rows, kind, row, column = (np.concatenate(arrays) for arrays in zip(*groups, strict=True))
    columns, setup = split_columns(moved, 0 if problem.nuisance is None else len(problem.nuisance))
    columns = columns.append(rows[:, :-1])
    first = np.cumsum([0, *(o.present.shape[1] for o in observations)])
    series = first[kind] + column
    place = np.concatenate([order_rows(o) for o in observations])
    start = np.cumsum([0, *(len(o) for o in observations)])
    order = np.lexsort((place[start[kind] + row], series))
    by_row = (rows[:, -1], kind, row, column, series)
    return StackedRows(setup, columns.take(order), *(array[order] for array in by_row))


def collect_residual_rows(linear: FitLinearization) -> ResidualRows | None:
    """Return the residuals of a fit with intervals in the order of measurement; None where rows
    cannot be told apart, because their readings are uncertain, or where there are none.
    """
    if linear.problem.is_uncertain:
        return None
    blocks = linear.problem.leverage_rows(linear.linearization, linear.solution)
    stacked = collect_rows(linear.data, linear.problem, blocks)
    if stacked is None:
        return None
    d, wide, setup = linear.decomposition, stacked.columns.wide, linear.linearization.nuisance
    used, determined, p = linear.is_estimated, d.used[0], len(linear.fit.names)
    of_setup, by_direction = wide[:, :-p], wide[:, -p:] @ d.directions[0]
    machine = by_direction[:, determined] / d.singular_values[0][determined]
    basis = span_columns(replace(stacked.columns, wide=np.concatenate([of_setup, machine], axis=1)))
    gain = np.concatenate([of_setup, by_direction[:, used] / linear.information[used]], axis=1)
    root = linear.fit.tolerance[:, None] * d.directions[0][:, used]
    return ResidualRows(
        basis=basis,
        residual=basis.remove(stacked.residual),
        gain=replace(stacked.columns, wide=gain),
        root=FitRoot(root, stacked.setup, setup and setup.elimination),
        kind=stacked.kind,
        row=stacked.row,
        column=stacked.column,
        series=np.unique(stacked.series, return_inverse=True)[1],
    )


def has_time(data: Measurements) -> bool:
    """Return whether all rows state the time at which they were measured."""
    listed = [o.context.get(TIME) for o in data.observations if len(o)]
    return all(time is not None and np.isfinite(time).all() for time in listed)


def order_rows(rows: Observations) -> IntArray:
    """Return the place (r,) of each row in the order of measurement: by time where all rows state
    it, else as in the file.
    """
    place = np.empty(len(rows), dtype=np.int64)
    place[order_by_time(rows.context.get(TIME), len(rows))] = np.arange(len(rows))
    return place


def order_by_time(time: FloatArray | None, count: int) -> IntArray:
    """Return the order (count,) by time where all state it; without that as they are."""
    if time is None or not np.isfinite(time).all():
        return np.arange(count)
    return np.argsort(time, kind="stable")


NIGHT = 6 * 3600.0  # time without a measurement [s] after which another day begins


def number_days(time: FloatArray) -> IntArray:
    """Return the number of the day of each row (n,), a run of times [s] without a `NIGHT`."""
    order = np.argsort(time, kind="stable")
    day = np.empty(len(time), np.int64)
    day[order] = np.cumsum(np.diff(time[order], prepend=time[order[:1]]) > NIGHT)
    return day


# What residuals may depend on.
ORDER, TIME, TEMPERATURE, READING = "order", "time", "temperature", "reading"
SESSION, BLOCK, POSE, TARGET, WALK = "session", "block", "pose", "target", "walk"
SMOOTH, ROUGH = "smooth", "rough"
RANDOM = {SESSION, BLOCK, POSE, TARGET, WALK, SMOOTH, ROUGH}  # whose sizes are drawn
CAUSE = "residuals.cause"  # code of the finding on the cause of residuals
MOST_POSES = 100  # poses that show an effect well enough, evenly chosen of more
MOST_VALUES, FEWEST_POSES = 6000, 30  # values of these, and poses that they need at least
EXAMINED = 120_000  # residuals that are examined at most: more would show the same


@dataclass(frozen=True, eq=False)
class Effect:
    """A dependence of the measured values on one quantity."""

    source: str  # what it depends on, such as "time"
    name: str  # of the temperature or actuator, else empty
    columns: FloatArray  # (R, c) whitened rows by the sizes, less their means
    labels: tuple[tuple[str, Dimension], ...]  # component and dimension of each of the c columns
    # (R, c) the same with their means, where the sizes are drawn and their mean is an error, too
    whole: FloatArray | None = None

    @property
    def acting(self) -> FloatArray:
        """(R, c) the columns by which the sizes act on the estimate."""
        return self.columns if self.whole is None else self.whole

    @cached_property
    def unit(self) -> FloatArray:
        """(c,) sizes [SI], equal for equal labels, that add the variance 1 to the rows that they
        change.
        """
        names = list(dict.fromkeys(self.labels))
        number = np.array([names.index(label) for label in self.labels], dtype=np.int64)
        squares = self.acting**2 @ (number[:, None] == np.arange(len(names)))
        changed = (squares > 0.0).sum(axis=0)
        mean = np.where(changed > 0, squares.sum(axis=0) / np.maximum(changed, 1), 1.0)
        return 1.0 / np.sqrt(mean[number])

    @cached_property
    def scaled(self) -> FloatArray:
        """(R, c) the columns in these units: independent sizes of one variance are the effect."""
        return self.acting * self.unit


class Cause(NamedTuple):
    """What probably causes the residuals."""

    source: str  # such as "pose", "session", "drives" or "outliers"
    name: str  # of the actuator or temperature, else empty
    probability: float
    second: str  # the next probable source
    second_probability: float
    effect: Effect | None  # None for outliers and a larger noise
    size: VarianceComponent | None  # of the effect, in columns of unit variance
    p_value: float  # (Sidak) of such an effect by noise alone, in any of those that are compared
    # severity of findings on it: it is beyond doubt where noise of the stated size is
    severity: Severity = Severity.INFO

    @property
    def finding(self) -> Finding:
        """The comparison as a finding."""
        names = ("name", "probability", "second", "second_probability")
        data = {name: getattr(self, name) for name in names}
        return report_finding(CAUSE, cause=self.source, **data)


class ExplainedResiduals(NamedTuple):
    """The rows of a fit, None where they cannot be told apart, and the causes of its residuals."""

    rows: ResidualRows | None
    causes: tuple[Cause, ...] = ()


def list_effects(rows: ResidualRows, data: Measurements, robot: Mechanism) -> tuple[Effect, ...]:
    """Return the effects that measurements without excluded poses can have.

    Linear in time, or in the order of measurement where the rows state no time, linear in each
    temperature, and quadratic in each actuator reading; an error of each session, or day where
    none is named, of each block where blocks are large, and of each pose where several targets
    share it.
    """
    observations = [o for o in data.observations if len(o)]
    place = [order_rows(o).astype(float) for o in observations]
    is_timed = has_time(data)
    along = [o.context[TIME] for o in observations] if is_timed else place
    listed = [(TIME if is_timed else ORDER, "", [scale_to_range(x)[:, None] for x in along])]
    for name in dict.fromkeys(name for o in observations for name in o.context if name != TIME):
        missing = [np.full(len(o), np.nan) for o in observations]
        values = [o.context.get(name, x) for o, x in zip(observations, missing, strict=True)]
        listed.append((TEMPERATURE, name, [scale_to_range(x)[:, None] for x in values]))
    poses = [o.rows.reshape(len(o), -1)[:, 0] for o in observations]
    sessions = [o.session for o in observations]
    if is_timed and not any(np.concatenate(sessions)):
        sessions = [number_days(o.context[TIME]) for o in observations]
    listed.append((SESSION, "", [indicate_groups(session) for session in sessions]))
    blocks = len(find_distinct(data.block))
    is_finer = blocks > len({session for o in observations for session in o.session.tolist()})
    if is_finer and 2 * blocks <= data.n_poses:
        listed.append((BLOCK, "", [indicate_groups(data.block[i]) for i in poses]))
    members = [columns for o in observations for columns in o.kind.component_columns.values()]
    if max(map(len, members)) > 1:
        chosen = choose_evenly(data.n_poses, MOST_POSES)
        listed.append((POSE, "", [(i[:, None] == chosen).astype(float) for i in poses]))
    for i, actuator in enumerate(robot.actuators):
        readings = [scale_to_range(data.readings[of_kind, i]) for of_kind in poses]
        functions = [np.column_stack([x, 4.0 * x**2]) for x in readings]
        listed.append((READING, actuator.name, functions))
    return tuple(build_effect(rows, observations, *each) for each in listed)


def list_shared_errors(
    rows: ResidualRows, data: Measurements, place: FloatArray
) -> tuple[Effect, ...]:
    """Return effects whose sizes are drawn, beside those of `list_effects`: an error of each
    target, steps of a walk in the order of the rows, and linear and quadratic errors of the place
    (n, 3) of each pose, about 0, such as by sag; where poses are repeated, an error of each of
    these, which its repeats share.
    """
    observations = [o for o in data.observations if len(o)]
    poses = [o.rows.reshape(len(o), -1)[:, 0] for o in observations]
    x = np.column_stack([np.ones(len(place)), place])
    products = np.column_stack([x[:, i] * x[:, j] for i in range(4) for j in range(i, 4)])
    # orthonormal over the poses, the constant first
    root = span_columns(SplitColumns.of(products - products.mean(axis=0))).wide
    root = root * np.sqrt(len(place))
    steps = [choose_evenly(len(o), MOST_POSES)[1:] for o in observations]
    listed = [
        (SMOOTH, [root[i] for i in poses]),
        (WALK, [order_rows(o)[:, None] >= i for o, i in zip(observations, steps, strict=True)]),
    ]
    repeated = np.flatnonzero(np.bincount(data.repeats) > 1)
    if repeated.size:
        chosen = repeated[choose_evenly(len(repeated), MOST_POSES)]
        listed.append((ROUGH, [data.repeats[i, None] == chosen for i in poses]))
    effects = [build_effect(rows, observations, s, "", f) for s, f in listed]
    of_targets, labels = [], [label for o in observations for label in _label_columns(o.kind)]
    for number, o in enumerate(observations):
        own = rows.kind == number
        columns = np.zeros((len(own), o.present.shape[1]))
        columns[own] = -o.whitener[rows.row[own], rows.column[own]]
        of_targets.append(columns)
    targets = np.concatenate(of_targets, axis=1)
    return (*effects, Effect(TARGET, "", targets, tuple(labels), targets))


def _label_columns(kind: Kind) -> list[tuple[str, Dimension]]:
    """Return the component and dimension of each noise column of a kind."""
    named = {i: label for label, columns in kind.component_columns.items() for i in columns}
    return [named[i] for i in sorted(named)]


def build_effect(
    rows: ResidualRows, observations: Sequence[Observations], source: str, name: str,
    functions: Sequence[NDArray[Any]],
) -> Effect:  # fmt: skip
    """Return an effect from functions (r, f) of the rows of each kind, less their means: an offset
    of all rows is no such effect.
    """
    columns, whole, labels = [np.zeros((len(rows.residual), 0))], [], []
    for number, (o, of_kind) in enumerate(zip(observations, functions, strict=True)):
        chosen = np.flatnonzero(rows.kind == number)
        whitener, row = o.whitener[rows.row[chosen], rows.column[chosen]], rows.row[chosen]
        for label, members in o.kind.component_columns.items():
            shift = -whitener[:, members].sum(axis=1)[:, None]
            both = np.zeros((2, len(rows.residual), of_kind.shape[1]))
            both[0, chosen] = shift * (of_kind - of_kind.mean(axis=0))[row]
            both[1, chosen] = shift * of_kind[row]
            both = both[:, :, both[0].any(axis=0)]
            columns.append(both[0])
            whole.append(both[1])
            labels += [label] * both.shape[2]
    drawn = np.concatenate(whole, axis=1) if source in RANDOM and whole else None
    return Effect(source, name, np.concatenate(columns, axis=1), tuple(labels), drawn)


def indicate_groups(names: NDArray[Any]) -> FloatArray:
    """Return (r, g) 1 where a row belongs to a group, of names (r,), else 0."""
    return (names[:, None] == find_distinct(names)).astype(float)


def scale_to_range(values: FloatArray) -> FloatArray:
    """Return values (r,) in the range -0.5 to 0.5; 0 where they are missing, or all equal."""
    known = np.isfinite(values)
    if not known.any() or not np.ptp(values[known]) > 0.0:
        return np.zeros(len(values))
    low, high = values[known].min(), values[known].max()
    return np.where(known, (values - 0.5 * (low + high)) / (high - low), 0.0)


# Probability that neighbors are alike by independent errors.
LEVEL = FALSE_ALARMS["correlation of neighbors"]
# Share of an effect that the parameters must leave in the residuals: with less, an effect that they
# show is more than ten times as large as they are. Of readings where a probe touched a bed, the
# rest is the noise of the probe itself.
LEFT = 0.1
# Degrees of freedom of the residuals for each size of an effect that is tested, at least.
FEWEST_LEFT = 3.0


class EffectSizes(NamedTuple):
    """The sizes of a significant effect, and how they act on the residuals."""

    cause: Cause  # what the residuals depend on
    effect: Effect  # of it
    # sizes, errors: (c,) [SI] estimates and standard deviations
    sizes: FloatArray
    errors: FloatArray
    moments: FloatArray  # (c, c) [SI] expected products of the sizes
    degrees: float = np.inf  # degrees of freedom of their size


def test_effect(rows: ResidualRows, effect: Effect) -> float:
    """Return the probability of a larger F, or of a larger component of the variance where sizes
    are drawn, for independent errors; NaN where residuals cannot show it.
    """
    if effect.whole is not None:
        spectrum = rows.remainder.find_spectrum(effect.scaled)
        is_open = spectrum.rest[1] >= FEWEST_LEFT and len(spectrum.y) > 0
        return spectrum.compute_tail() if is_open else np.nan
    columns = effect.columns[:, effect.columns.any(axis=0)]  # of a drive that does not move: 0
    length = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(rows.project(columns / length), full_matrices=False)
    basis = u[:, s > LEFT]
    q, explained = basis.shape[1], float(((basis.T @ rows.residual) ** 2).sum())
    left = rows.degrees - q
    if q == 0 or left < FEWEST_LEFT * q:
        return np.nan
    return float(compute_f_tail(q, left, explained / q / ((rows.square - explained) / left)))


def estimate_sizes(rows: ResidualRows, cause: Cause, effect: Effect) -> EffectSizes:
    """Return the sizes of the effect of a cause, by least squares where residuals show them.

    Sizes that the residuals hardly show, because they are like a parameter of the machine, get the
    variance that the others have: g ~ N(0, tau^2) in units of the noise, tau^2 by its moments.
    Combinations that change no row, such as an equal offset of all sessions, count as zero.
    """
    length = np.linalg.norm(effect.columns, axis=0) / np.sqrt(len(rows.residual))
    scaled = effect.columns / length
    left = rows.project(scaled)
    noise = rows.square / rows.degrees
    u, s, vt = np.linalg.svd(left, full_matrices=False)
    is_observable = s > 1e-6 * np.linalg.norm(scaled)
    c = np.where(is_observable, u.T @ rows.residual, 0.0)
    excess = float((c**2).sum()) - noise * int(is_observable.sum())
    tau2 = max(excess, noise) / float((s[is_observable] ** 2).sum())
    variance = 1.0 / (s**2 / noise + 1.0 / tau2)
    mean = vt.T @ (variance * s * c / noise)
    # only combinations of the columns that change a row
    _, size, axes = np.linalg.svd(scaled, full_matrices=False)
    kept = axes[size > 1e-10 * size.max(initial=0.0)]
    spread = (kept.T @ kept) @ (vt.T * np.sqrt(variance))
    back = 1.0 / length
    sizes, errors = back * mean, back * np.linalg.norm(spread, axis=1)
    if effect.whole is not None:  # the mean of all sizes moves the estimate, and no residual
        component = rows.remainder.find_spectrum(effect.scaled).estimate()
        moments = np.diag(component.variance * effect.unit**2)
        return EffectSizes(cause, effect, sizes, errors, moments, component.degrees)
    moments = back[:, None] * (np.outer(mean, mean) + spread @ spread.T) * back
    return EffectSizes(cause, effect, sizes, errors, moments)


def test_correlation(rows: ResidualRows) -> tuple[float, float]:
    """Return the correlation of neighboring residuals less its mean for independent errors, and the
    probability of a larger one; NaN without neighbors or degrees of freedom.
    """
    pairs = np.flatnonzero(rows.series[1:] == rows.series[:-1])
    nu = rows.degrees
    if len(pairs) == 0 or nu < FEWEST_LEFT:
        return np.nan, np.nan
    observed = float(rows.residual[pairs] @ rows.residual[pairs + 1]) / rows.square
    # traces of B = M L M, L the symmetric matrix with 1/2 for each pair of neighbors, from tr L = 0
    # and tr L^2 = pairs / 2
    first, squared, product = rows.basis.trace_neighbors(pairs)
    second = 0.5 * len(pairs) - 2.0 * squared + product
    first = -first
    mean = first / nu
    variance = 2.0 * (second - first**2 / nu) / (nu * (nu + 2.0))
    if not variance > 0.0:
        return np.nan, np.nan
    # the beta distribution on (-1, 1) of this mean and variance
    center = 0.5 * (1.0 + mean)
    total = center * (1.0 - center) / (0.25 * variance) - 1.0
    if not total > 0.0:
        return observed - mean, np.nan
    place = float(np.clip(0.5 * (1.0 - observed), 0.0, 1.0))
    return observed - mean, float(beta_probability((1.0 - center) * total, center * total, place))


# The covariance of a fit whose errors are correlated in the order of measurement.

# Correlations of neighbors between which the average is taken.
RHO = (0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.87, 0.92, 0.96, 0.98, 0.99)
SHARE = (1.0, 0.75, 0.5, 0.3, 0.15)  # shares a of the correlated noise
# Relative variance of the size of the covariance below which it counts as known.
LEAST_SCATTER = 1e-9
NO_WEIGHT = 1e-12  # share of a correlation that adds nothing to the average
LONGEST = 400  # rows of a series whose correlation is considered at once; longer series are cut


@dataclass(frozen=True, eq=False)
class CorrelatedErrors:
    """The covariance of a fit by correlated errors."""

    covariance: FloatArray  # (k, k) of the directions of the rows' gain
    degrees: float  # degrees of freedom of its size
    correlation: float  # of neighboring errors, mean
    sigma: float  # their size over the stated sigma, mean


def estimate_correlated_errors(rows: ResidualRows, sigma_degrees: float) -> CorrelatedErrors:
    """Return the covariance by errors that are correlated within each series.

    sigma_degrees : degrees of freedom of the stated sigmas, infinite where they are exact.
    """
    starts = np.flatnonzero(np.r_[True, np.diff(rows.series) != 0])
    by_length: dict[int, list[IntArray]] = {}
    for first, last in zip(starts, np.r_[starts[1:], len(rows.series)], strict=True):
        for part in np.array_split(np.arange(first, last), -(-(last - first) // LONGEST)):
            by_length.setdefault(len(part), []).append(part)
    whole = rows.basis.append(rows.residual[:, None])
    segments = [(n, [whole.localize(own) for own in parts]) for n, parts in by_length.items()]
    gains = [(n, [rows.gain.localize(own) for own in parts]) for n, parts in by_length.items()]
    nu = rows.degrees + sigma_degrees
    tried = [(rho, share) for rho in RHO for share in (SHARE if rho > 0.0 else (1.0,))]
    logs, scales = [], []
    for rho, share in tried:
        log_det, square = _evaluate(rows, segments, rho, share)
        scale = (sigma_degrees + square) / nu if np.isfinite(nu) else 1.0
        by_size = nu * np.log(scale) if np.isfinite(nu) else square
        logs.append(-0.5 * (log_det + by_size))
        scales.append(scale)
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    k = rows.gain.shape[1]
    covariance, sizes = np.zeros((k, k)), np.zeros(len(tried))
    for i in np.flatnonzero(weight > NO_WEIGHT).tolist():
        explained = scales[i] * _add_products(k, gains, lambda K, X: K.T @ X, *tried[i])
        covariance += weight[i] * explained
        sizes[i] = np.trace(explained)
    mean = float(weight @ sizes)
    # without a direction that the data determine there is no covariance, hence no scatter of it
    scatter = float(weight @ (sizes - mean) ** 2) / mean**2 if mean > 0.0 else 0.0
    return CorrelatedErrors(
        covariance,
        2.0 / max(scatter + 2.0 / nu, LEAST_SCATTER),
        float(weight @ [rho * share for rho, share in tried]),
        float(np.sqrt(weight @ np.array(scales))),
    )


Segments = Sequence[tuple[int, Sequence[tuple[IntArray, FloatArray]]]]
"""Runs of n neighbors: their columns (c,) and values (n, c), those of one n together."""


def _factorize(n: int, rho: float, share: float) -> FloatArray:
    """Return the Cholesky factor (n, n) of the covariance K of n neighbors."""
    K = share * rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    K[np.diag_indices(n)] = 1.0
    return np.asarray(np.linalg.cholesky(K), dtype=float)


def _add_products(
    count: int,
    segments: Segments,
    weigh: Callable[[FloatArray, FloatArray], FloatArray],
    rho: float,
    share: float,
) -> FloatArray:
    """Return the sum X'X (count, count) over segments, weighed by the factors of their K."""
    total = np.zeros((count, count))
    for n, parts in segments:
        # one system for all segments: the triangle is the same for each
        stacked = weigh(_factorize(n, rho, share), np.concatenate([X for _, X in parts], axis=1))
        ends = np.cumsum([len(columns) for columns, _ in parts])[:-1]
        for (columns, _), X in zip(parts, np.split(stacked, ends, axis=1), strict=True):
            total[np.ix_(columns, columns)] += X.T @ X
    return total


def _evaluate(
    rows: ResidualRows, segments: Segments, rho: float, share: float
) -> tuple[float, float]:
    """Return log |K| + log |X'K^-1 X|, X orthonormal, and the sum of squares S."""
    from scipy.linalg import solve_triangular

    def whiten(L: FloatArray, X: FloatArray) -> FloatArray:
        return np.asarray(solve_triangular(L, X, lower=True))

    q, s = rows.basis.shape[1], rows.basis.narrow.shape[1]
    inside, log_det = _add_products(q + 1, segments, whiten, rho, share), 0.0
    for n, parts in segments:
        log_det += 2.0 * len(parts) * float(np.log(np.diag(_factorize(n, rho, share))).sum())
    if s:  # the columns of sessions are linked where these are neighbors
        from scipy.sparse import csc_array
        from scipy.sparse.linalg import splu

        lu = splu(csc_array(inside[:s, :s]))
        log_det += float(np.log(np.abs(lu.U.diagonal())).sum())
        inside = inside[s:, s:] - inside[s:, :s] @ lu.solve(inside[:s, s:])
    R = np.asarray(np.linalg.cholesky(inside).T)
    log_det += 2.0 * float(np.log(np.diag(R)[:-1]).sum())
    return log_det, float(R[-1, -1] ** 2)
