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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.measure.kinds.kind import list_components
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import (
    compute_any_probability,
    compute_f_tail,
    compute_single_level,
    estimate_variance_component,
    find_distinct,
)
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

EXPLAINED = 1e-6  # share of its length below which a column counts as explained by other columns


@dataclass(frozen=True, eq=False)
class ResidualRows:
    """R whitened rows of a fit, those of one series (a kind and its column) in order."""

    basis: FloatArray  # (R, q) orthonormal, what is estimated
    residual: FloatArray  # (R,) of the least-squares fit
    gain: FloatArray  # (R, k) change of the k directions of the fit by an error of each row
    # (p, k) these directions [SI]: an error e of the rows changes the estimate by root gain' e,
    # up to its sign
    root: FloatArray
    # kind, row, column: (R,) number of the kind, of its row, and of its residual
    kind: IntArray
    row: IntArray
    column: IntArray
    series: IntArray  # (R,) number of the series, in ascending order

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the residuals."""
        return self.basis.shape[0] - self.basis.shape[1]

    @cached_property
    def square(self) -> float:
        """Sum of squares of the residuals."""
        return float((self.residual**2).sum())

    def project(self, columns: FloatArray) -> FloatArray:
        """Return the part of columns (R, c) that nothing estimated explains; zero where that is
        rounding.
        """
        left = columns - self.basis @ (self.basis.T @ columns)
        left -= self.basis @ (self.basis.T @ left)  # the first projection leaves rounding
        size = np.linalg.norm(columns, axis=0)
        return np.where(np.linalg.norm(left, axis=0) > EXPLAINED * size, left, 0.0)

    def with_effects(self, columns: FloatArray) -> ResidualRows:
        """Return the rows as if the fit had also estimated effects with these columns (R, c)."""
        new = span_columns(self.project(columns))
        left = self.residual - new @ (new.T @ self.residual)
        return replace(self, basis=np.concatenate([self.basis, new], axis=1), residual=left)

    def without(self, rows: IntArray) -> ResidualRows:
        """Return the rows as if the fit had not used some of them (w,)."""
        kept = np.ones(len(self.residual), dtype=bool)
        kept[rows] = False
        basis = span_columns(self.basis[kept])
        left = self.residual[kept] - basis @ (basis.T @ self.residual[kept])
        return replace(
            self,
            basis=basis,
            residual=left,
            gain=self.gain[kept],
            kind=self.kind[kept],
            row=self.row[kept],
            column=self.column[kept],
            series=self.series[kept],
        )


def span_columns(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis (R, q) of columns (R, c), each scaled to length one."""
    length = np.linalg.norm(columns, axis=0)
    scaled = columns[:, length > 0.0] / length[length > 0.0]
    if not scaled.size:
        return scaled
    Q, R = np.linalg.qr(scaled)  # the triangle first: LAPACK divides and conquers many rows
    try:
        inner, s, _ = np.linalg.svd(R, full_matrices=False)
    except np.linalg.LinAlgError:  # divide and conquer may fail; the slower driver does not
        from scipy.linalg import svd

        inner, s, _ = svd(R, full_matrices=False, lapack_driver="gesvd")
    u = Q @ inner
    return np.asarray(u[:, s > EXPLAINED])


def collect_residual_rows(linear: FitLinearization) -> ResidualRows | None:
    """Return the residuals of a fit with intervals in the order of measurement; None where rows
    cannot be told apart, because their readings are uncertain, or where there are none.
    """
    if linear.problem.is_uncertain:
        return None
    observations = [rows for rows in linear.data.observations if len(rows)]
    groups: list[tuple[FloatArray, IntArray, IntArray, IntArray]] = []  # present rows
    for node_rows in linear.problem.leverage_rows(linear.linearization, linear.solution):
        for part in node_rows:
            present = np.diagonal(observations[part.kind].whitener, axis1=1, axis2=2) != 0.0
            i, column = np.nonzero(present[part.numbers])
            kind = np.full(len(i), part.kind)
            groups.append((part.rows[i, column], kind, part.numbers[i], column))
    if not groups:
        return None
    rows, kind, row, column = (np.concatenate(arrays) for arrays in zip(*groups, strict=True))
    first = np.cumsum([0, *(o.present.shape[1] for o in observations)])
    series = first[kind] + column
    place = np.concatenate([order_rows(o) for o in observations])
    start = np.cumsum([0, *(len(o) for o in observations)])
    order = np.lexsort((place[start[kind] + row], series))
    rows, kind, row, column = rows[order], kind[order], row[order], column[order]
    d, p = linear.decomposition, len(linear.fit.names)
    used, determined = linear.is_estimated, d.used[0]
    by_direction = rows[:, -p - 1 : -1] @ d.directions[0]
    machine = by_direction[:, determined] / d.singular_values[0][determined]
    basis = span_columns(np.concatenate([rows[:, : -p - 1], machine], axis=1))
    residual = rows[:, -1] - basis @ (basis.T @ rows[:, -1])
    return ResidualRows(
        basis=basis,
        residual=residual,
        gain=by_direction[:, used] / linear.information[used],
        root=linear.fit.tolerance[:, None] * d.directions[0][:, used],
        kind=kind,
        row=row,
        column=column,
        series=np.unique(series[order], return_inverse=True)[1],
    )


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


# What residuals may depend on.
ORDER, TIME, TEMPERATURE, READING = "order", "time", "temperature", "reading"
SESSION, BLOCK = "session", "block"


class Effect(NamedTuple):
    """A dependence of the measured values on one quantity."""

    source: str  # what it depends on, such as "time"
    name: str  # of the temperature or actuator, else empty
    columns: FloatArray  # (R, c) whitened rows by the sizes, less their means
    labels: tuple[tuple[str, Dimension], ...]  # component and dimension of each of the c columns
    # (R, c) the same with their means, where the sizes are drawn and their mean is an error, too
    whole: FloatArray | None = None


def list_effects(rows: ResidualRows, data: Measurements, robot: Mechanism) -> tuple[Effect, ...]:
    """Return the effects that measurements without excluded poses can have.

    Linear in time, or in the order of measurement where the rows state no time, linear in each
    temperature, and quadratic in each actuator reading; an error of each session, and of each block
    where blocks are large.
    """
    observations = [o for o in data.observations if len(o)]
    kinds = []  # of each kind: places among all rows, its rows, and what a unit of a component adds
    for number, o in enumerate(observations):
        chosen = np.flatnonzero(rows.kind == number)
        whitener = o.whitener[rows.row[chosen], rows.column[chosen]]
        members = list_components(o.kind).items()
        shifts = [(each, whitener[:, columns].sum(axis=1)) for each, columns in members]
        kinds.append((chosen, rows.row[chosen], shifts))

    def build(functions: Sequence[Sequence[FloatArray]], source: str, name: str = "") -> Effect:
        """Return an effect from functions (r,) of the rows of each kind, less their means: an
        offset of all rows is no such effect.
        """
        columns, whole, labels = [np.zeros((len(rows.residual), 0))], [], []
        for (places, row, shifts), of_kind in zip(kinds, functions, strict=True):
            for label, shift in shifts:
                for function in of_kind:
                    column, mean = np.zeros((2, len(rows.residual), 1))
                    column[places, 0] = -shift * (function - function.mean())[row]
                    mean[places, 0] = -shift * function.mean()
                    if column.any():
                        columns.append(column)
                        whole.append(column + mean)
                        labels.append(label)
        centered, drawn = np.concatenate(columns, axis=1), None
        if whole and source in (SESSION, BLOCK):
            drawn = np.concatenate(whole, axis=1)
        return Effect(source, name, centered, tuple(labels), drawn)

    has_time = all(TIME in o.context and np.isfinite(o.context[TIME]).all() for o in observations)
    place = [o.context[TIME] if has_time else order_rows(o).astype(float) for o in observations]
    effects = [build([[scale_to_range(x)] for x in place], TIME if has_time else ORDER)]
    for name in dict.fromkeys(name for o in observations for name in o.context if name != TIME):
        functions = [
            [scale_to_range(o.context[name])] if name in o.context else [] for o in observations
        ]
        effects.append(build(functions, TEMPERATURE, name))
    blocks = [data.block[o.rows.reshape(len(o), -1)[:, 0]] for o in observations]
    has_blocks = 2 * len(find_distinct(data.block)) <= data.n_poses
    sessions = [o.session for o in observations]
    for source, groups in ((SESSION, sessions), (BLOCK, blocks if has_blocks else [])):
        functions = [[(g == name).astype(float) for name in find_distinct(g)] for g in groups]
        if functions:
            effects.append(build(functions, source))
    for i, actuator in enumerate(robot.actuators):
        readings = (data.readings[o.rows.reshape(len(o), -1)[:, 0], i] for o in observations)
        functions = [[x, 4.0 * x**2] for x in map(scale_to_range, readings)]
        effects.append(build(functions, READING, actuator.name))
    return tuple(effects)


def scale_to_range(values: FloatArray) -> FloatArray:
    """Return values (r,) in the range -0.5 to 0.5; 0 where they are missing, or all equal."""
    known = np.isfinite(values)
    if not known.any() or not np.ptp(values[known]) > 0.0:
        return np.zeros(len(values))
    low, high = values[known].min(), values[known].max()
    return np.where(known, (values - 0.5 * (low + high)) / (high - low), 0.0)


# Probability that independent errors change the uncertainty of a fit: patterns or slow errors.
FALSE_ALARMS = 0.05
# Probability that independent errors show any pattern, over all tests of a fit (Sidak); and the
# same for slow errors of the poses (`model_discrepancy`).
LEVEL = compute_single_level(FALSE_ALARMS, 2)
# Share of an effect that the parameters must leave in the residuals: with less, an effect that they
# show is more than ten times as large as they are. Of readings where a probe touched a bed, the
# rest is the noise of the probe itself.
LEFT = 0.1
# Degrees of freedom of the residuals for each size of an effect that is tested, at least.
FEWEST_LEFT = 3.0


class EffectSizes(NamedTuple):
    """The sizes of a significant effect, and how they act on the residuals."""

    effect: Effect  # what the residuals depend on
    # probability (Sidak) that independent errors show an effect as large in any test of a fit
    p_value: float
    # sizes, errors: (c,) [SI] estimates and standard deviations
    sizes: FloatArray
    errors: FloatArray
    moments: FloatArray  # (c, c) [SI] expected products of the sizes
    degrees: float = np.inf  # degrees of freedom of their size


class ResidualPatterns(NamedTuple):
    """What the residuals of a fit show."""

    effects: tuple[EffectSizes, ...]  # that are significant, the first found first
    p_value: float  # of the correlation of neighbors for independent errors, in any of the tests
    is_correlated: bool  # whether it is significant
    order: str  # "time" or "order", that of the rows
    rows: ResidualRows  # the residuals, as if the fit had estimated the effects


def find_patterns(rows: ResidualRows, data: Measurements, robot: Mechanism) -> ResidualPatterns:
    """Test the residuals against every effect, then against correlation in the order of rows.

    The most significant effect is estimated, and the others are tested again without it, until none
    is significant.
    """
    listed = list_effects(rows, data, robot)
    order = TIME if any(effect.source == TIME for effect in listed) else ORDER
    effects = _list_testable(rows, listed)
    p_value = test_correlation(rows)[1]
    tests = len(effects) + int(np.isfinite(p_value))
    significant: list[EffectSizes] = []
    while effects:
        p_values = [test_effect(rows, basis) for _, basis in effects]
        best = int(np.argmin(p_values))
        p_any = compute_any_probability(p_values[best], tests)
        if not p_any < LEVEL:
            break
        effect, _ = effects.pop(best)
        significant.append(estimate_sizes(rows, effect, p_any))
        rows = rows.with_effects(effect.columns)
        effects = _list_testable(rows, [other for other, _ in effects])
    if significant:
        p_value = test_correlation(rows)[1]
    p_any = compute_any_probability(p_value, tests)
    return ResidualPatterns(tuple(significant), p_any, p_any < LEVEL, order, rows)


def test_effect(rows: ResidualRows, basis: FloatArray) -> float:
    """Return the probability of a larger F for independent errors.

    basis : (R, q) orthonormal, of the part of an effect that nothing estimated explains.
    """
    q, explained = basis.shape[1], float(((basis.T @ rows.residual) ** 2).sum())
    left = rows.degrees - q
    statistic = explained / q / ((rows.square - explained) / left)
    return float(compute_f_tail(q, left, statistic))


def estimate_sizes(rows: ResidualRows, effect: Effect, p_value: float) -> EffectSizes:
    """Return the sizes of an effect, by least squares where residuals show them.

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
        own = np.linalg.norm(effect.whole, axis=0)
        w, y, rest = find_spectrum(rows, effect.whole / own)
        component = estimate_variance_component(w, y, rest=rest)
        moments = np.diag(component.variance / own**2)
        return EffectSizes(effect, p_value, sizes, errors, moments, component.degrees)
    moments = back[:, None] * (np.outer(mean, mean) + spread @ spread.T) * back
    return EffectSizes(effect, p_value, sizes, errors, moments)


def find_spectrum(
    rows: ResidualRows, columns: FloatArray
) -> tuple[FloatArray, FloatArray, tuple[float, float]]:
    """Return the weights (k,) and the elements (k,) of the residuals that errors of unit variance
    with these columns (R, c) change, and sum of squares and number of all other elements.
    """
    left = rows.project(columns)
    w, vectors = np.linalg.eigh(left.T @ left)
    kept = w > EXPLAINED * w.max(initial=0.0)
    w, y = w[kept], (rows.residual @ left) @ vectors[:, kept] / np.sqrt(w[kept])
    square = max(rows.square - float(y @ y), 0.0)
    return w, y, (square, float(rows.degrees - len(y)))


def test_correlation(rows: ResidualRows) -> tuple[float, float]:
    """Return the correlation of neighboring residuals less its mean for independent errors, and the
    probability of a larger one; NaN without neighbors or degrees of freedom.
    """
    pairs = np.flatnonzero(rows.series[1:] == rows.series[:-1])
    nu = rows.degrees
    if len(pairs) == 0 or nu < FEWEST_LEFT:
        return np.nan, np.nan
    r, U = rows.residual, rows.basis
    observed = float(r[pairs] @ r[pairs + 1]) / rows.square
    # L columns, L the symmetric matrix with 1/2 for each pair of neighbors
    LU = np.zeros_like(U)
    LU[pairs] += 0.5 * U[pairs + 1]
    LU[pairs + 1] += 0.5 * U[pairs]
    inner = U.T @ LU
    # traces of B = M L M, from tr L = 0 and tr L^2 = pairs / 2
    first = -float(np.trace(inner))
    second = 0.5 * len(pairs) - 2.0 * float((LU**2).sum()) + float((inner**2).sum())
    mean = first / nu
    variance = 2.0 * (second - first**2 / nu) / (nu * (nu + 2.0))
    if not variance > 0.0:
        return np.nan, np.nan
    # the beta distribution on (-1, 1) of this mean and variance
    center = 0.5 * (1.0 + mean)
    total = center * (1.0 - center) / (0.25 * variance) - 1.0
    if not total > 0.0:
        return observed - mean, np.nan
    from scipy.special import betainc

    place = float(np.clip(0.5 * (1.0 - observed), 0.0, 1.0))
    return observed - mean, float(betainc((1.0 - center) * total, center * total, place))


def _list_testable(
    rows: ResidualRows, effects: Iterable[Effect]
) -> list[tuple[Effect, FloatArray]]:
    """Return the effects that residuals can show, each with its basis, see `test_effect`."""
    testable = []
    for effect in effects:
        if effect.columns.shape[1]:
            scaled = effect.columns / np.linalg.norm(effect.columns, axis=0)
            u, s, _ = np.linalg.svd(rows.project(scaled), full_matrices=False)
            basis = u[:, s > LEFT]
            if basis.shape[1] > 0 and rows.degrees >= (1.0 + FEWEST_LEFT) * basis.shape[1]:
                testable.append((effect, basis))
    return testable


# The covariance of a fit whose errors are correlated in the order of measurement.

# Correlations of neighbors between which the average is taken.
RHO = (0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.87, 0.92, 0.96, 0.98, 0.99)
SHARE = (1.0, 0.75, 0.5, 0.3, 0.15)  # shares a of the correlated noise
# Relative variance of the size of the covariance below which it counts as known.
LEAST_SCATTER = 1e-9
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
    segments = [np.array(segments) for segments in by_length.values()]
    nu = rows.degrees + sigma_degrees
    logs, scales, covariances, neighbors = [], [], [], []
    for rho in RHO:
        for share in SHARE if rho > 0.0 else (1.0,):
            log_det, square, explained = _evaluate(rows, segments, rho, share)
            scale = (sigma_degrees + square) / nu if np.isfinite(nu) else 1.0
            by_size = nu * np.log(scale) if np.isfinite(nu) else square
            logs.append(-0.5 * (log_det + by_size))
            scales.append(scale)
            covariances.append(scale * explained)
            neighbors.append(share * rho)
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    covariance = np.einsum("i,ijk->jk", weight, np.array(covariances))
    sizes = np.array([np.trace(c) for c in covariances])
    mean = float(weight @ sizes)
    # without a direction that the data determine there is no covariance, hence no scatter of it
    scatter = float(weight @ (sizes - mean) ** 2) / mean**2 if mean > 0.0 else 0.0
    return CorrelatedErrors(
        covariance,
        2.0 / max(scatter + 2.0 / nu, LEAST_SCATTER),
        float(weight @ np.array(neighbors)),
        float(np.sqrt(weight @ np.array(scales))),
    )


def _evaluate(
    rows: ResidualRows, segments: list[IntArray], rho: float, share: float
) -> tuple[float, float, FloatArray]:
    """Return log |K| + log |X'K^-1 X|, the sum of squares S, and G'K G (k, k)."""
    from scipy.linalg import solve_triangular

    q, k = rows.basis.shape[1], rows.gain.shape[1]
    columns = np.column_stack([rows.basis, rows.residual])
    log_det, white, spread = 0.0, [], np.zeros((k, k))
    for members in segments:
        count, n = members.shape
        K = share * rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        K[np.diag_indices(n)] = 1.0
        L = np.linalg.cholesky(K)
        log_det += 2.0 * count * float(np.log(np.diag(L)).sum())
        # one system for all segments: the triangle is the same for each
        stacked = columns[members.T].reshape(n, count * (q + 1))
        white.append(solve_triangular(L, stacked, lower=True).reshape(n * count, q + 1))
        part = (L.T @ rows.gain[members.T].reshape(n, count * k)).reshape(n * count, k)
        spread += part.T @ part
    R = np.asarray(np.linalg.qr(np.concatenate(white), mode="r"))
    log_det += 2.0 * float(np.log(np.abs(np.diag(R)[:q])).sum())
    return log_det, float(R[-1, -1] ** 2), spread
