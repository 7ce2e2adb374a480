# SPDX-License-Identifier: Apache-2.0
"""The scatter of the estimates of one calibration over resampled blocks of data, and the covariance
that allows common errors within a block: a day, session or pose.

Blocks of poses that may share an error are resampled together. In the world of the bootstrap the
estimate is the truth, and each of the t resamples is fitted as the data were, by the same method,
nonlinearly, with setup parameters and poses of uncertain readings. Priors are observations whose
errors are drawn from their stated distributions.

    wild     errors of a block, corrected for leverage, times one random number (default)
    pairs    blocks are drawn with replacement: multinomial weights
    normal   independent normal errors of the stated sigmas (Monte Carlo, JCGM 101)

The rows of a cluster g, whitened, nuisance parameters and poses eliminated, are A_g with residuals
r_g and leverage H_gg. With the bread B = (A'A + P)^-1 (P the penalty) and the covariance C of the
fit, whose rows have variance sigma^2, the cluster-robust covariance is

    C_robust = C + B sum_g (u_g u_g' - sigma^2 A_g' A_g) B,     u_g = A_g' (I - H_gg)^(-1/2) r_g

The factor (I - H_gg)^(-1/2) is the small-sample correction CR2 of Bell and McCaffrey (2002): for
independent errors the expectation of C_robust is exactly C. Its scatter is that of a chi-square
whose degrees of freedom have the moments of the quadratic form (Satterthwaite; Pustejovsky and
Tipton, 2018). See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np

from loopcal.checks import check_choice
from loopcal.diagnose import intervals
from loopcal.diagnose.outliers import TESTABLE
from loopcal.diagnose.residual_patterns import number_days, order_by_time
from loopcal.errors import EstimationError
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.linearization import linearize_rows
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.penalties import MAP
from loopcal.estimate.resampling import ResampleFits, Resamples, draw_centers, fit_resamples
from loopcal.estimate.residual_test import LEVEL, coverage_factor
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.numerics.decomposition import NUISANCE_TOLERANCE, are_nonzero
from loopcal.numerics.elimination import find_connected_groups, fold_at, spread_columns
from loopcal.numerics.statistics import choose_evenly, compute_chi_square_tail, compute_single_level
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

# Clusters that a cluster-robust variance needs. The variance of a mean has one degree of freedom
# less, and with fewer than 4 its distribution is not known well enough (Tipton, 2015).
FEWEST_CLUSTERS = 5


@dataclass(frozen=True, eq=False)
class Clusters:
    """Poses that may share an error, and are independent of the poses of other clusters."""

    unit: str  # "day", "session", "block" or "pose"
    member: IntArray  # (n,) cluster 0..count-1 of each pose
    count: int


def divide_into_clusters(data: Measurements) -> tuple[Clusters, ...]:
    """Return the possible divisions of n poses with at least `FEWEST_CLUSTERS` clusters, the
    largest units first. Days are runs of poses without a break of `NIGHT` in the column `time`.
    Units that share a pose, a block or a row that compares poses are one cluster.
    """
    blocks = linked_blocks(data)
    count = int(blocks.max()) + 1
    unit = "pose" if count == data.n_poses else "block"
    divisions = [Clusters(unit, blocks, count)]
    time, days = data.context.get("time"), np.zeros((0, 2), dtype=np.int64)  # pose and day
    if time is not None and not np.isnan(time).any():
        days = np.column_stack([np.arange(data.n_poses), number_days(time)])
    for name, pairs in (("session", _pose_sessions(data)), ("day", days)):
        if len(pairs):
            links = np.column_stack([blocks[pairs[:, 0]], count + pairs[:, 1]])
            joined = find_connected_groups(links, int(links.max()) + 1)[blocks]
            names, member = np.unique(joined, return_inverse=True)
            divisions.append(Clusters(name, member, len(names)))
    enough = [clusters for clusters in reversed(divisions) if clusters.count >= FEWEST_CLUSTERS]
    return tuple(sorted(enough, key=lambda clusters: clusters.count))


def _pose_sessions(data: Measurements) -> IntArray:
    """Return pairs (k, 2) of a pose and a session that measured it; none without named sessions.
    Rows without a session belong to those of the same pose, or else to one session.
    """
    poses = [np.zeros(0, dtype=np.int64)]
    names = [np.zeros(0, dtype=str)]
    for rows in (rows for rows in data.observations if len(rows)):
        numbers = rows.rows.reshape(len(rows), -1)
        poses.append(numbers.ravel())
        names.append(np.repeat(rows.session.astype(str), numbers.shape[1]))
    pose, name = np.concatenate(poses), np.concatenate(names)
    is_named = name != ""
    if not is_named.any():
        return np.zeros((0, 2), dtype=np.int64)
    unnamed = np.setdiff1d(np.arange(data.n_poses), pose[is_named])
    pose = np.concatenate([pose[is_named], unnamed])
    name = np.concatenate([name[is_named], np.full(len(unnamed), "")])
    return np.column_stack([pose, np.unique(name, return_inverse=True)[1]])


# Degrees of freedom below which the distribution of a ratio is not known well (Tipton, 2015), and
# its own standard deviation exceeds 35 %.
FEWEST_DEGREES = 4.0
# Clusters, evenly chosen, whose scores are compared: the degrees of freedom of more of them
# change no conclusion.
MOST_CLUSTERS = 10_000
COMMON = 1e-9  # share of its own size below which a variance of poses is zero


class Ratio(NamedTuple):
    """Cluster-robust standard uncertainty of poses over the one that the fit states."""

    ratio: float  # of the root mean square over the measured poses; NaN without uncertainty
    degrees: float  # degrees of freedom of its square for independent errors
    share: float  # of the stated variance that comes from rows which residuals can judge
    p_value: float  # probability of a larger ratio for independent errors


NO_RATIO = Ratio(np.nan, np.nan, np.nan, np.nan)


class RobustSpread(NamedTuple):
    """The cluster-robust covariance C_robust = L (I + spread) L' of a fit with C = L L'. With the
    scores h_g of the G clusters, spread = sum_g (h_g h_g' - E_g), E_g the expectation for
    independent errors. Each cluster has h rows, turned into the eigenvectors of its leverage H_gg.
    """

    root: FloatArray  # (p, k) L in spreads, for the k directions that the fit estimates
    scores: FloatArray  # (G, k) h_g, the u_g in units of L
    # (G, k, h) the rows in units of L; without a prior the sum of their squares is k
    scaled_rows: FloatArray
    # (G, h) (1 - g)^(-1/2) for the leverages `leverage` (G, h); 0 where g is 1, so that no
    # residual can judge the row
    correction: FloatArray
    leverage: FloatArray
    # (G, h, w) rows by everything that is estimated, in standard deviations: their products are
    # the leverages
    columns: FloatArray
    times: float = 1.0  # number of all clusters for each of the G

    @property
    def is_tested(self) -> BoolArray:
        """(G, h) rows that a residual can judge."""
        return self.correction > 0.0

    def compare(self, effect: FloatArray) -> Ratio:
        """Return the ratio for what changes by effect (m, p) times deviations [spreads]."""
        root = effect @ self.root
        total = float((root**2).sum())
        # Q = sum_g |E' h_g|^2 with E E' = root' root; for independent errors its mean is `mean`
        _, s, vt = np.linalg.svd(root, full_matrices=False)
        E = vt[s > COMMON * s[0]].T * s[s > COMMON * s[0]]
        tested_rows = np.matmul(E.T, self.scaled_rows) * self.is_tested[:, None, :]
        mean, observed = float((tested_rows**2).sum()), float(((self.scores @ E) ** 2).sum())
        if not mean > 0.0:
            return NO_RATIO
        excess = self.times * (observed - mean)
        ratio = float(np.sqrt(max(total + excess, 0.0) / total))
        # degrees of freedom 2 mean^2 / variance of Q = e' K e, whose variance is 2 tr (K K): with
        # D the corrections, Z the columns and F_g = D_g rows_g' rows_g D_g, the blocks of two
        # clusters give tr (F_g Z_g Z_h' F_h Z_h Z_g'), and those of one |rows_g' rows_g|^2
        products = np.matmul(tested_rows.swapaxes(-1, -2), tested_rows)
        F = products * self.correction[:, :, None] * self.correction[:, None, :]
        width = self.columns.shape[-1]
        joint = self.columns.reshape(-1, width).T @ np.matmul(F, self.columns).reshape(-1, width)
        leveled = self.leverage[:, None, :]
        single = (np.matmul(F * leveled, F) * leveled).trace(axis1=1, axis2=2)
        trace = float((joint * joint.T).sum() - single.sum() + (products**2).sum())
        degrees = mean**2 / trace if trace > 0.0 else np.inf
        p_value = float(compute_chi_square_tail(degrees, degrees * observed / mean))
        return Ratio(ratio, degrees, mean / total, p_value)


def compute_robust_spread(linear: FitLinearization, clusters: Clusters) -> RobustSpread:
    """Return the cluster-robust covariance of a fit with intervals, beside the stated one. Of more
    than `MOST_CLUSTERS` clusters, an even choice stands for all.
    """
    clusters, times = choose_clusters(clusters)
    p, used = linear.problem.parameters, linear.is_estimated
    V, total = linear.decomposition.directions[0][:, used], linear.information[used]
    sd = np.sqrt(linear.variance[used])
    sigma = linear.fit.residual_test.sigma_scale
    setup = 0 if linear.problem.nuisance is None else len(linear.problem.nuisance)
    width = setup + p + 1
    folded = np.zeros((1, clusters.count, 0, width))  # the rows of each cluster
    for rows_of_block in linear.problem.leverage_rows(linear.linearization, linear.solution):
        for part in rows_of_block:
            member = clusters.member[part.poses]
            own, machine = np.split(part.rows, [part.unknowns.shape[1]], axis=2)
            whole = np.concatenate([spread_columns(own, part.unknowns, setup), machine], axis=2)
            rows = whole[member >= 0]
            if rows.size:
                places = np.repeat(member[member >= 0], rows.shape[1])
                folded = fold_at(folded, rows.reshape(1, -1, width), places)
    rows = folded[0] / np.r_[np.ones(width - 1), sigma]
    nuisance, A, r = rows[..., : -p - 1], rows[..., -p - 1 : -1], rows[..., -1]
    half = np.concatenate([nuisance, (A @ V) / np.sqrt(total)], axis=2)
    P = (A @ V) * (sigma / (total * sd))
    leverage, vectors = np.linalg.eigh(half @ half.swapaxes(-1, -2))
    remaining = 1.0 - leverage
    is_tested = remaining > TESTABLE
    correction = np.where(is_tested, 1.0 / np.sqrt(np.where(is_tested, remaining, 1.0)), 0.0)
    scaled_rows = np.matmul(P.swapaxes(-1, -2), vectors)
    residual = correction * np.matmul(r[:, None, :], vectors)[:, 0]
    scores = np.matmul(scaled_rows, residual[..., None])[..., 0]
    columns = np.matmul(vectors.swapaxes(-1, -2), half)
    return RobustSpread(V * sd, scores, scaled_rows, correction, leverage, columns, times)


def choose_clusters(clusters: Clusters) -> tuple[Clusters, float]:
    """Return at most `MOST_CLUSTERS` clusters, evenly chosen, with member -1 for the poses of the
    others; and the number of all clusters for each of these.
    """
    if clusters.count <= MOST_CLUSTERS:
        return clusters, 1.0
    number = np.full(clusters.count, -1)
    number[choose_evenly(clusters.count, MOST_CLUSTERS)] = np.arange(MOST_CLUSTERS)
    times = clusters.count / MOST_CLUSTERS
    return replace(clusters, member=number[clusters.member], count=MOST_CLUSTERS), times


class ObservedValues(NamedTuple):
    """The M present measured values of a fit (one trial), by block, kind, row and component."""

    block: IntArray  # (M,)
    kind: IntArray  # (M,)
    row: IntArray  # (M,)
    component: IntArray  # (M,)
    residual: FloatArray  # (M,) whitened
    by_nuisance: FloatArray  # (M, U) in units of the standard deviations of nuisance parameters
    by_parameters: FloatArray  # (M, p) deviations of the machine, as nuisance parameters follow it
    poses: IntArray  # (M, links) that each value sees
    by_coordinates: FloatArray  # (M, links, k) their coordinates; k is 0 where poses have none


def list_observed_values(linear: FitLinearization, clusters: Clusters) -> ObservedValues:
    """Return the measured values of a fit at its linearization, block by block."""
    problem, linearization = linear.problem, linear.linearization
    z, trials, estimate = linearization.deviation, problem.trials, linearization.nuisance
    fixed = None if estimate is None else estimate.values
    solution = problem.poses.solve(z, trials, linearization.next_start, problem.control, fixed)
    root = np.zeros((0, 0))
    if estimate is not None:
        root = estimate.elimination.list_root().fill(np.arange(estimate.values.shape[1]))
    links = max(rows.poses_by_link.shape[1] for rows in problem.rows)
    parts, coordinates = [], []
    for block, poses in problem.poses.iterate_poses(solution, z):
        for i, (of_kind, rows) in enumerate(zip(problem.rows, block.rows, strict=True)):
            place, column = np.nonzero(rows.is_present[0])
            if not len(place):
                continue
            row, of_row = block.locate(i, place)
            component = of_row[np.arange(len(place)), column]
            own = linearize_rows(rows, poses, trials, fixed)
            by_parameters = own.by_parameters[0]
            by_nuisance = np.zeros((*by_parameters.shape[:2], root.shape[1]))
            if own.by_nuisance is not None and estimate is not None:
                wide = spread_columns(own.by_nuisance, rows.nuisance, len(root))[0]
                by_parameters = by_parameters + wide @ estimate.elimination.slope[0]
                by_nuisance = wide @ root
            seen = of_kind.poses_by_link[row]
            parts.append(
                (
                    *(clusters.member[of_kind.first_poses[row]], np.full(len(row), i)),
                    *(row, component, own.residual[0][place, column]),
                    *(by_nuisance[place, column], by_parameters[place, column]),
                    seen[:, np.minimum(np.arange(links), seen.shape[1] - 1)],
                )
            )
            coordinates.append(np.zeros((len(row), 1, 0)))
            if own.by_coordinates is not None:
                coordinates[-1] = own.by_coordinates[0][place, :, column]
    columns: list[Any] = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
    by_coordinates = np.zeros((len(columns[0]), links, max(c.shape[2] for c in coordinates)))
    first = 0
    for part in coordinates:
        by_coordinates[first : first + len(part), : part.shape[1], : part.shape[2]] = part
        first += len(part)
    order = np.lexsort(columns[3::-1])  # by block, kind, row and component
    columns.append(by_coordinates)
    return ObservedValues(*(column[order] for column in columns))


@dataclass(frozen=True, eq=False)
class BlockErrors:
    """Errors of the M present measured values, block by block, corrected for leverage."""

    values: ObservedValues
    residual: FloatArray  # (M,) whitened residuals at the truth of the resamples
    error: FloatArray  # (M,) those at the estimate, corrected for leverage
    # of every block (M_g, d) an orthonormal basis of the directions without residuals
    untested: tuple[FloatArray, ...]
    shapes: tuple[tuple[int, int], ...]  # (r, m) of every kind

    def draw(
        self, factor: FloatArray | int, sigma: float, rng: np.random.Generator
    ) -> tuple[FloatArray, ...]:
        """Return offsets (t, r, m) of every kind that replace the residuals by errors.

        factor : (t, blocks) by which the error of each block is multiplied; or t, for independent
            normal errors. sigma : standard deviation of these, and of untested directions.
        """
        block = self.values.block
        if isinstance(factor, int | np.integer):
            offset = sigma * rng.standard_normal((factor, len(block))) - self.residual
        else:
            offset = factor[:, block] * self.error - self.residual
            for g, basis in enumerate(self.untested):
                if basis.shape[1]:
                    drawn = rng.standard_normal((len(factor), basis.shape[1]))
                    offset[:, block == g] += sigma * drawn @ basis.T
        by_kind = []
        for i, shape in enumerate(self.shapes):
            own = self.values.kind == i
            by_kind.append(np.zeros((len(offset), *shape)))
            by_kind[i][:, self.values.row[own], self.values.component[own]] = offset[:, own]
        return tuple(by_kind)


def compute_block_errors(
    linear: FitLinearization, clusters: Clusters, shift: FloatArray
) -> BlockErrors:
    """Return the errors of the rows of a fit, by independent blocks of poses.

    shift : (p,) in spreads, from the estimate to the truth of the resamples, at which the rows
        have the residuals that the errors replace.
    """
    values = list_observed_values(linear, clusters)
    used = linear.is_estimated
    V = linear.decomposition.directions[0][:, used] / np.sqrt(linear.information[used])
    residual, error = values.residual.copy(), np.zeros(len(values.block))
    untested = []
    for g in range(clusters.count):
        mine = np.flatnonzero(values.block == g)
        by_parameters = values.by_parameters[mine]
        # half half' is the leverage of the block by setup and machine
        half = np.concatenate([values.by_nuisance[mine], by_parameters @ V], axis=1)
        poses = np.unique(values.poses[mine])
        k = values.by_coordinates.shape[2]
        by_poses = np.zeros((len(mine), len(poses), k))
        for link in range(values.poses.shape[1]):
            place = np.searchsorted(poses, values.poses[mine, link])
            by_poses[np.arange(len(mine)), place] += values.by_coordinates[mine, link]
        by_poses = by_poses.reshape(len(mine), len(poses) * k)
        Q = by_poses  # its range has leverage 1
        if Q.shape[1]:
            length = np.linalg.norm(Q, axis=0)
            u, s, _ = np.linalg.svd(Q / np.where(length > 0.0, length, 1.0), full_matrices=False)
            Q = u[:, are_nonzero(s, NUISANCE_TOLERANCE)]
        left, half = residual[mine] - Q @ (Q.T @ residual[mine]), half - Q @ (Q.T @ half)
        L, s, _ = np.linalg.svd(half, full_matrices=False)
        remaining = 1.0 - s**2
        is_tested = remaining > TESTABLE
        gain = np.where(is_tested, 1.0 / np.sqrt(np.where(is_tested, remaining, 1.0)), 0.0)
        error[mine] = left + L @ ((gain - 1.0) * (L.T @ left))
        residual[mine] += by_parameters @ shift
        untested.append(np.concatenate([Q, L[:, ~is_tested]], axis=1))
    shapes = tuple(rows.whitener.shape[1:3] for rows in linear.problem.rows)
    return BlockErrors(values, residual, error, tuple(untested), shapes)


# Probability that any parameter is reported where errors are independent and as stated.
FALSE_ALARMS = 0.01


@dataclass(frozen=True, eq=False)
class BlockScatter:
    """The scatter of blocks, parameter by parameter (p,)."""

    # cluster-robust standard deviation over the one of independent errors; NaN where the data
    # determine none
    ratio: FloatArray
    noise_degrees: FloatArray  # degrees of freedom of the part of the variance that the blocks show
    # effective degrees of freedom of the whole variance (Welch-Satterthwaite): what a prior
    # contributes is known
    degrees: FloatArray
    tail: FloatArray  # probability of a larger ratio for independent errors of the stated size
    unit_sd: FloatArray  # standard deviations [SI] for rows of unit variance
    # factor on the stated sigmas that the residuals show; NaN without degrees of freedom
    noise: float

    def report(self, names: tuple[str, ...], ratio: FloatArray, blocks: Clusters) -> Finding:
        """Return whether the ratio (p,) of bootstrapped to stated standard deviations is off by
        more than `OFF`, beyond chance, for any parameter.
        """
        tested = np.isfinite(self.tail) & (self.noise_degrees >= FEWEST_DEGREES)
        level = 0.5 * compute_single_level(FALSE_ALARMS, int(tested.sum()))
        larger = (ratio > 1.0 + intervals.OFF) & (self.tail < level)
        smaller = (ratio < 1.0 / (1.0 + intervals.OFF)) & (self.tail > 1.0 - level)
        off = tested & (larger | smaller)
        unit = {"unit": blocks.unit, "blocks": blocks.count, "limit": intervals.OFF}
        if not off.any():
            return report_finding("sampling.scatter-agrees", **unit)
        order = np.argsort(-np.where(off, np.abs(np.log(ratio)), -1.0))[: int(off.sum())]
        return report_finding(
            "sampling.scatter-differs",
            **unit,
            count=int(off.sum()),
            total=len(names),
            names=tuple(names[i] for i in order[: intervals.NAMED]),
            ratio=float(ratio[order[0]]),
        )


def describe_scatter(linear: FitLinearization, blocks: Clusters) -> BlockScatter:
    """Return the scatter of blocks of a fit; without intervals its degrees are blocks - 1."""
    fit, p = linear.fit, linear.problem.parameters
    nan = np.full(p, np.nan)
    d, penalty = linear.decomposition, linear.penalty
    unit_sd = d.standard_deviations(penalty)[0] * fit.tolerance
    left = float(d.rows[0] - d.filter_factors(penalty).sum())
    noise = float(np.sqrt(d.remaining(penalty)[0] / left)) if left > 0.5 else np.nan
    if not fit.residual_test.intervals:
        few = np.full(p, float(blocks.count - 1))
        return BlockScatter(nan, few, few, nan, unit_sd, noise)
    spread = compute_robust_spread(linear, blocks)
    ratio, degrees, share, tail = np.array([spread.compare(e[None]) for e in np.eye(p)]).T
    safe = np.where(np.isfinite(degrees) & (share > 0.0), share, 1.0)
    effective = np.where(np.isfinite(degrees), degrees / safe**2, np.inf)
    return BlockScatter(ratio, degrees, effective, tail, unit_sd, noise)


# Blocks of a unit with which it is resampled by default: with fewer, the scatter of the resamples
# is itself known to 20 % at best.
ENOUGH_BLOCKS = 12
UNITS = ("pose", "block", "session", "day")  # names of units


def choose_blocks(data: Measurements, unit: str | int | None = None) -> Clusters:
    """Return the blocks of poses that are resampled together.

    unit : "pose", "block", "session" or "day", or the number of consecutive poses of a block, in
        the order of the column `time`, or else of the file. None takes the largest unit with at
        least `ENOUGH_BLOCKS` blocks, or else the smallest.
    """
    if isinstance(unit, int | np.integer):  # runs of poses; blocks of linked poses stay together
        if unit < 1:
            raise EstimationError(f"blocks of {unit} poses: give a number of at least 1")
        n, linked = data.n_poses, linked_blocks(data)
        run = np.empty(n, dtype=np.int64)
        run[order_by_time(data.context.get("time"), n)] = np.arange(n) // unit
        links: IntArray = np.column_stack([run, run.max() + 1 + linked])
        joined = find_connected_groups(links, int(links.max()) + 1)[run]
        names, member = np.unique(joined, return_inverse=True)
        runs = Clusters(f"{unit}-pose run", member, len(names))
        if runs.count < FEWEST_CLUSTERS:
            raise EstimationError.of("sampling.too-few-blocks", unit=runs.unit)
        return runs
    if unit is not None and unit not in UNITS:
        raise EstimationError(
            f"unit is {unit!r}, but must be one of {', '.join(UNITS)}, or a number of consecutive "
            "poses"
        )
    divisions = divide_into_clusters(data)
    if not divisions:
        raise EstimationError.of("sampling.too-few-blocks", unit=unit or "pose")
    if unit is None:
        enough = (blocks for blocks in divisions if blocks.count >= ENOUGH_BLOCKS)
        return next(enough, divisions[-1])
    named = [blocks for blocks in divisions if blocks.unit == unit]
    if not named:
        available = tuple(f"{blocks.count} {blocks.unit}s" for blocks in divisions)
        raise EstimationError.of("sampling.unit-unknown", unit=unit, available=available)
    return named[0]


Scheme = Literal["wild", "pairs", "normal"]  # how resamples are drawn
# How intervals are read from the resamples, see `Bootstrap.intervals`.
IntervalKind = Literal["widened", "percentile", "bias-corrected", "studentized"]
MOST_FAILED = 0.02  # share of resamples that do not converge above which it is reported
BATCH = 250  # resamples that are fitted at once; progress is reported between them
# Number of blocks below which the random factor of the wild bootstrap has six values instead of
# two, so that there are enough different resamples (Webb, 2023).
FEW_BLOCKS = 12
WEBB = np.sqrt([0.5, 1.0, 1.5])  # sizes of the six values +/-


@dataclass(frozen=True, eq=False, repr=False)
class Bootstrap(TableResult):
    """Estimates of T resamples of one calibration. Arrays over parameters are (p,) as in the fit.

    Attributes
    ----------
    fit : the calibration. scheme : "wild", "pairs" or "normal". seed : of the random numbers.
    blocks : what was resampled together.
    draws : (T, p) [SI] estimates of the resamples that converged.
    linear : (T, p) [SI] the same to first order about the estimate.
    sd : (T, p) [SI] standard deviations that each resample states by its own residuals; NaN without
        degrees of freedom.
    failed : number of resamples that did not converge; they are left out.
    scatter : the scatter of the blocks' errors against the stated uncertainty.
    """

    fit: Identification
    scheme: Scheme
    seed: int
    blocks: Clusters
    draws: FloatArray
    linear: FloatArray
    sd: FloatArray
    failed: int
    scatter: BlockScatter

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(robot="fit.robot.name", scheme="", seed="", unit="blocks.unit"),
        *fields(blocks="blocks.count", resamples=lambda boot: len(boot.draws), failed=""),
        *fields(degrees="scatter.degrees", findings=""),
        Field("estimate", "draws", "draw parameter", units="fit.free_parameters.dimensions"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="fit.names")

    @property
    def is_known(self) -> BoolArray:
        """(p,) parameters whose standard deviation the fit states."""
        return np.isfinite(self.fit.standard_deviations)

    @property
    def standard_deviations(self) -> FloatArray:
        """(p,) of the resamples [SI]; infinite where the data determine no parameter."""
        return np.where(self.is_known, self.draws.std(axis=0, ddof=1), np.inf)

    def intervals(
        self, level: float = LEVEL, kind: IntervalKind = "widened"
    ) -> intervals.Intervals:
        """Return intervals of the parameters.

        Parameters
        ----------
        level : coverage of each. kind : "percentile": between quantiles of the resamples.
            "widened" (default): the same, its ends moved away from the estimate by t(nu) / 1.96,
            because the scatter was estimated from few blocks (nu: see `BlockScatter`).
            "bias-corrected": quantiles shifted by the share of resamples below the estimate (Efron,
            1981). "studentized": quantiles of (resample - estimate) / sd, each with its own noise.
        """
        check_choice("kind of interval", kind, get_args(IntervalKind))
        estimate, weight = self.fit.estimate, np.full(len(self.draws), 1.0 / len(self.draws))
        quantile, linear, error = intervals.compare_ends(
            self.draws, weight, self.linear, weight, level
        )
        half = 0.5 * (linear[1] - linear[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            shift, shift_error = (quantile - linear) / half, error / half
        degrees = self.scatter.degrees if self.scheme != "normal" else np.inf
        widen = coverage_factor(degrees, level) / coverage_factor(np.inf, level)
        if kind == "widened":
            quantile, linear = (estimate + (ends - estimate) * widen for ends in (quantile, linear))
        elif kind != "percentile":
            quantile = self._find_ends(kind, level)
        return intervals.mask_intervals(
            self.is_known,
            self.fit.names,
            level,
            f"{self.scheme} bootstrap, {kind}",
            center=self.draws.mean(axis=0),
            sd=self.draws.std(axis=0, ddof=1),
            **dict(zip(intervals.ENDS, (*quantile, *linear), strict=True)),
            shift=shift,
            shift_error=shift_error,
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """How many resamples failed, and whether the stated intervals agree with the scatter."""
        total = len(self.draws) + self.failed
        findings = []
        if self.failed > MOST_FAILED * total:
            findings.append(report_finding("sampling.failures", failed=self.failed, count=total))
        codes = ("sampling.bootstrap-agrees", "sampling.bootstrap-differs")
        findings += intervals.report_intervals(self.intervals(kind="percentile"), *codes)
        if self.fit.method.is_biased:
            name = type(self.fit.method).__name__
            findings.append(report_finding("sampling.bias-not-drawn", method=name))
        if self.scheme == "normal" or self.fit.method.is_biased:
            return tuple(findings)
        stated = np.where(self.is_known, self.fit.standard_deviations, np.nan)
        ratio = self.standard_deviations / stated
        return (*findings, self.scatter.report(self.fit.names, ratio, self.blocks))

    def _find_ends(self, kind: IntervalKind, level: float) -> FloatArray:
        """Return the ends (2, p) of intervals that are not those of the resamples."""
        estimate, tails = self.fit.estimate, np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
        if kind == "studentized":
            q = np.quantile((self.draws - estimate) / self.sd, tails, axis=0)
            own = self.scatter.noise * self.scatter.unit_sd
            return estimate - q[::-1] * own
        # bias-corrected: shifted by the share of resamples below the estimate
        from scipy.special import ndtr, ndtri

        share, least = (self.draws < estimate).mean(axis=0), 0.5 / len(self.draws)
        z = 2.0 * ndtri(np.clip(share, least, 1.0 - least)) + ndtri(tails)[:, None]
        pairs = zip(self.draws.T, ndtr(z).T, strict=True)
        return np.array([np.quantile(of_one, shares) for of_one, shares in pairs]).T


def bootstrap(
    fit: Identification,
    data: Measurements,
    count: int = 1000,
    *,
    scheme: Scheme = "wild",
    unit: str | int | None = None,
    seed: int = 1,
    progress: Progress = report_no_progress,
) -> Bootstrap:
    """Resample a calibration by blocks.

    Parameters
    ----------
    fit : an identification that converged. data : the measurements it was made from.
    count : number of resamples. scheme : see the module.
    unit : what is resampled together: "pose", "block", "session", "day", or a number of
        consecutive poses; None takes the largest unit of which there are enough, see
        `choose_blocks`.
    seed : of all random numbers. progress : receives the resamples that are done.

    Raises
    ------
    EstimationError : the fit did not converge, the data have no such unit, or fewer than two
        resamples converged.
    """
    check_choice("scheme", scheme, get_args(Scheme))
    if count < 2:
        raise EstimationError(f"{count} resamples: give at least 2")
    if not fit.converged:
        raise EstimationError.of("sampling.not-converged")
    if not np.isfinite(fit.standard_deviations).any():
        raise EstimationError.of("sampling.without-intervals")
    if scheme == "pairs" and isinstance(fit.method, MAP) and callable(fit.method.inflation):
        raise EstimationError.of("sampling.pairs-with-rule")
    linear = linearize_fit(fit, data)
    blocks = choose_blocks(linear.data, unit)
    rng, errors, batches = np.random.default_rng(np.random.SeedSequence(seed)), None, []
    if scheme != "pairs":
        # the penalty of a ridge or a truncation is no observation and stays as it is: the truth is
        # the least-squares solution, so that the resamples scatter about the estimate
        d, z = linear.decomposition, linear.linearization.deviation
        truth = z
        if not fit.method.has_prior:
            truth = d.deviation(d.solution(np.where(d.used, 0.0, np.inf)))
        errors = compute_block_errors(linear, blocks, (truth - z)[0])
    for first in range(0, count, BATCH):
        progress(first, count, "fitting resamples")
        size = min(BATCH, count - first)
        resamples = _draw_resamples(linear, blocks, errors, scheme, size, rng)
        batches.append(fit_resamples(linear, resamples))
    progress(count, count, "fitting resamples")
    fits = ResampleFits.join(batches)
    kept = fits.take(np.flatnonzero(fits.converged))
    if len(kept.deviation) < 2:
        raise EstimationError.of("sampling.resamples-failed", count=count)
    nominal, unit_of = fit.nominal, fit.tolerance
    return Bootstrap(
        fit=fit,
        scheme=scheme,
        seed=seed,
        blocks=blocks,
        draws=nominal + unit_of * kept.deviation,
        linear=nominal + unit_of * kept.linear,
        sd=unit_of * kept.sd * np.sqrt(kept.noise)[:, None],
        failed=count - len(kept.deviation),
        scatter=describe_scatter(linear, blocks),
    )


def _draw_resamples(
    linear: FitLinearization,
    blocks: Clusters,
    errors: BlockErrors | None,
    scheme: Scheme,
    count: int,
    rng: np.random.Generator,
) -> Resamples:
    """Draw `count` resamples of the rows of a fit, and of its priors.

    Priors scatter about the truth of the resamples where errors of rows are drawn, and about the
    given values where the residuals keep their bias.
    """
    fit, G, sigma = linear.fit, blocks.count, linear.fit.residual_test.sigma_scale
    equations = np.full(count, int(linear.linearization.equations[0]))
    weight, offset = None, None
    if errors is None:
        drawn = rng.multinomial(G, np.full(G, 1.0 / G), count)
        weight = drawn[:, blocks.member].astype(np.float64)
        total = np.zeros(G, dtype=np.int64)
        for rows in linear.problem.rows:
            present = rows.is_present[0].sum(axis=1)
            total += np.bincount(blocks.member[rows.first_poses], present, G).astype(np.int64)
        equations = equations + (drawn - 1) @ total
    elif scheme == "normal":
        offset = errors.draw(count, sigma, rng)
    else:  # factors of mean 0 and variance 1
        factor = rng.choice([-1.0, 1.0], (count, G))
        if G < FEW_BLOCKS:
            factor = factor * rng.choice(WEBB, factor.shape)
        offset = errors.draw(factor, sigma, rng)
    z, nuisance = linear.linearization.deviation, linear.problem.nuisance
    center = np.zeros((count, z.shape[1]))
    if fit.method.has_prior:
        center = draw_centers(linear, count, rng) + (0.0 if errors is None else z)
    prior = None
    if fit.options.prior is not None:
        rows = fit.options.prior.added(linear.problem)
        at_estimate = 0.0 if errors is None else rows.residuals(z)
        prior = rng.standard_normal((count, rows.constant.shape[1])) - at_estimate
    means = np.zeros((count, 0))
    if nuisance is not None:
        table = nuisance.local.table
        sd = np.where(nuisance.has_prior, np.nan_to_num(table.tolerance), 0.0)
        mean = table.nominal if errors is None else fit.nuisance.estimate
        means = mean + sd * rng.standard_normal((count, len(sd)))
    return Resamples(weight, offset, center, prior, means, equations)
