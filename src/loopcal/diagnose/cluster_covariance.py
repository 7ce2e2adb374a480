# SPDX-License-Identifier: Apache-2.0
"""Compare the covariance of a fit with one that allows common errors within a day, session or pose.

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

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.outliers import TESTABLE
from loopcal.diagnose.residual_patterns import number_days
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.measure.measurements import Measurements
from loopcal.numerics.elimination import find_connected_groups, fold_at
from loopcal.numerics.statistics import choose_evenly, compute_chi_square_tail
from loopcal.typing import BoolArray, FloatArray, IntArray

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

    root: FloatArray  # (p, k) L in tolerances, for the k directions that the fit estimates
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
        """Return the ratio for what changes by effect (m, p) times deviations [tolerances]."""
        root = effect @ self.root
        total = float((root**2).sum())
        if not total > 0.0:
            return NO_RATIO
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
            rows, m = part.spread(setup)[member >= 0], part.rows.shape[1]
            if rows.size:
                places = np.repeat(member[member >= 0], m)
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
