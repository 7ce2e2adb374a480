# SPDX-License-Identifier: Apache-2.0
"""Unknowns that measurements bring with them (frames, targets, surfaces, offsets) inside a fit: solved for and eliminated.

At every point of the descent their values are those that fit the rows best at the machine's present poses, so that the
sum of squares is a function of the machine alone. The rows [F | A | r], own columns first, are folded into one triangular
factor; the block below the own columns is the factor of the rows projected onto the complement of F. Rank, filters and
covariance of the machine are read from it as if the frames were known. Unknowns that share no row, directly or through
others, are different clusters and are eliminated one by one: a factor is as wide as the largest cluster, however many
sessions and groups there are. A tolerance is one more row. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine
from loopcal.calibrate.sensed import Sensed
from loopcal.linalg import NULL_COMPONENT, FloatArray, IntArray, empty_factor
from loopcal.measure import LocalUnknowns, Measurements, Observations, start_values
from loopcal.parameters import ParameterTable

OWN_RANK = 1e-10
"""Share of the largest singular value (columns of length one) below which a direction of the own unknowns is none."""

STEPS, HALVINGS = 30, 20
"""Gauss-Newton steps to the best own unknowns at fixed poses, and halvings of each; two or three steps are usual."""

CLOSE, NOTHING = 1e-7, 1e-5
"""Change of the whitened residuals, as a share of them and in standard deviations, below which a step is the last: what
is left to first order the elimination removes."""


@dataclass(frozen=True, eq=False)
class Eliminated:
    """A cluster of u own unknowns at the point of a fold: their best values are a linear function of the machine's.

    Attributes
    ----------
    columns : (u,) among all own unknowns. inverse : (a, u, u) pseudo-inverse of their triangle: F^+ = inverse Q'.
    slope : (a, u, p) change of the best values by the machine's deviations. shift : (a, u) to the best values here.
    rank : (a,). open : (a, u) which have a part in a direction that no row sees.
    """

    columns: IntArray
    inverse: FloatArray
    slope: FloatArray
    shift: FloatArray
    rank: IntArray
    open: np.ndarray


class Own:
    """Own unknowns of the rows of t machines: clusters, present values, and how these follow the machine.

    Rows and their reweighted copies share one of these: `solved` and the values belong to the last fold of any of them.
    At most `steps` of Gauss-Newton, each halved `halvings` times at most, are taken where a fold begins.

    Parameters
    ----------
    local : the U unknowns. sensed : the rows of every kind. trials : number of machines. parameters : p.
    data : from a trial's number to its measurements, from which values to begin with are found.
    together : (n,) poses of equal number have unknowns of their own in common, so that their rows are one cluster's.
    """

    def __init__(
        self,
        local: LocalUnknowns,
        sensed: tuple[Sensed, ...],
        trials: int,
        parameters: int,
        data: Callable[[int], Measurements],
        together: IntArray | None = None,
    ) -> None:
        self.local, self.data = local, data
        table = local.table
        self.free = np.asarray(table.free, dtype=bool)
        self.held = self.free & ~np.isnan(table.tolerance)
        self.cluster, self.column, self.clusters = _clusters(self.free, sensed, together)
        self.priors = int(self.held.sum())
        self.values = np.tile(local.values(), (trials, 1))
        self.start = local.values()
        self.started = np.zeros(trials, dtype=bool)
        self.steps, self.halvings = STEPS, HALVINGS
        self.at = np.zeros((trials, parameters))
        self.slope = np.zeros((trials, len(local), parameters))
        self.cost = np.full(trials, np.inf)
        self.rank = np.full(trials, int(self.free.sum()))
        self.solved: tuple[Eliminated, ...] = ()

    @property
    def unheld(self) -> int:
        """How many are estimated without a prior."""
        return int((self.free & ~self.held).sum())

    def members(self, sensed: Sensed) -> list[tuple[int, IntArray, IntArray]]:
        """Rows of a kind by cluster: its number (-1 without one), rows (k,), and the columns (k, u) their unknowns have in it.

        Fixed unknowns have the column after the last.
        """
        if not sensed.places.shape[1]:
            return [(-1, np.arange(len(sensed.poses)), np.zeros((len(sensed.poses), 0), dtype=np.int64))]
        of = self.cluster[sensed.places].max(axis=1)
        found = []
        for c in np.unique(of):
            rows = np.flatnonzero(of == c)
            places = sensed.places[rows]
            width = len(self.clusters[c]) if c >= 0 else 0
            found.append((int(c), rows, np.where(self.free[places], self.column[places], width)))
        return found

    def prior_rows(self, cluster: int, values: FloatArray, width: int) -> FloatArray:
        """Rows (a, h, width) of the priors of a cluster, own columns first and the residual last."""
        columns = self.clusters[cluster]
        held = np.flatnonzero(self.held[columns])
        rows = np.zeros((len(values), len(held), width))
        table = self.local.table
        tolerance = table.tolerance[columns[held]]
        rows[:, np.arange(len(held)), held] = 1.0 / tolerance
        rows[:, :, -1] = (values[:, columns[held]] - table.nominal[columns[held]]) / tolerance
        return rows

    def begin(self, trial: int, T: FloatArray, joints: Mapping[str, FloatArray]) -> None:
        """Put a trial at the values that fit its poses (n, 4, 4) and joints name -> (1, n), cluster by cluster."""
        values, data = self.local.values(), self.data(trial)
        clusters = [self.cluster[places].max(axis=1, initial=-1) for places in self.local.places]
        for c in range(len(self.clusters)):
            some = [(o.take(of == c), p[of == c]) for o, p, of in self._rows(data, clusters) if (of == c).any()]
            used = np.unique(np.concatenate([places.ravel() for _, places in some]))
            entries = tuple(self.local.table.entries[i] for i in used)
            local = LocalUnknowns(ParameterTable(entries), tuple(np.searchsorted(used, places) for _, places in some))
            part = replace(data, observations=tuple(rows for rows, _ in some))
            values[used] = start_values(part, T, local, joints)
        self.values[trial], self.started[trial] = values, True
        self.start = values.copy()

    def follow(self, trial: int) -> None:
        """Put a trial at the values with which the first one began."""
        self.values[trial], self.started[trial] = self.start, True

    def _rows(self, data: Measurements, clusters: list[IntArray]) -> list[tuple[Observations, IntArray, IntArray]]:
        """Kinds with rows, which unknowns each uses, and the cluster of each row."""
        every = zip(data.observations, self.local.places, clusters, strict=True)
        return [(o, places, of) for o, places, of in every if len(o) and places.shape[1]]

    def predicted(self, trials: IntArray, deviation: FloatArray) -> FloatArray:
        """Values (a, U) of some trials at deviations (a, p), to first order from where they were found last."""
        change = deviation - self.at[trials]
        return self.values[trials] + np.matmul(self.slope[trials], change[..., None])[..., 0]

    def settled(self, values: FloatArray, factors: Callable[[FloatArray], list[FloatArray]]) -> FloatArray:
        """The values (a, U) next to given ones that make the sum of squares smallest, by Gauss-Newton with halving.

        Parameters
        ----------
        factors : from values to one triangular factor (a, u + 1, u + 1) of [F | r] for each cluster.
        """
        found = factors(values)
        cost = _squares(found)
        for _ in range(self.steps):
            step, offset = self.step(found, len(values))
            far = offset > CLOSE**2 * cost + NOTHING**2
            if not far.any():
                break
            share = far.astype(np.float64)
            for _ in range(self.halvings):
                found = factors(values + share[:, None] * step)
                worse = (share > 0.0) & ~(_squares(found) <= cost)
                if not worse.any():
                    break
                share[worse] *= 0.5
            else:
                share[~(_squares(found) <= cost)] = 0.0
                found = factors(values + share[:, None] * step)
            values, cost = values + share[:, None] * step, _squares(found)
            if not share.any():
                break
        return values

    def step(self, factors: list[FloatArray], trials: int) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton step (a, U), and by how much (squared) it changes the whitened residuals (a,)."""
        step, offset = np.zeros((trials, len(self.local))), np.zeros(trials)
        for columns, factor in zip(self.clusters, factors, strict=True):
            one, _ = eliminate(factor, columns)
            step[:, columns] = one.shift
            moved = np.matmul(factor[:, : len(columns), : len(columns)], one.shift[..., None])[..., 0]
            offset += (moved**2).sum(axis=1)
        return step, offset

    def keep(self, trials: IntArray, deviation: FloatArray, values: FloatArray, cost: FloatArray) -> None:
        """Remember a fold: how many directions it solved for and, where it is the best one yet, from where to go on."""
        self.rank[trials] = sum(one.rank for one in self.solved)
        better = np.isfinite(cost) & (cost <= self.cost[trials])
        chosen = trials[better]
        self.cost[chosen], self.at[chosen], self.values[chosen] = cost[better], deviation[better], values[better]
        for one in self.solved:
            self.slope[chosen[:, None], one.columns] = one.slope[better]


class Folding:
    """The factors of all clusters while blocks are folded into them: working memory of one fold.

    A cluster's factor is begun with its first row; see `Own`.
    """

    def __init__(self, own: Own | None, trials: int, parameters: int) -> None:
        self.own, self.trials, self.parameters = own, trials, parameters
        self.factors: dict[int, FloatArray] = {}
        self.solved: list[Eliminated] = []

    def add(self, parts: list[tuple[int, FloatArray]]) -> None:
        """Fold rows into the factors of their clusters."""
        for c in sorted({c for c, _ in parts if c >= 0}):
            rows = np.concatenate([rows for of, rows in parts if of == c], axis=1)
            begun = self.factors.get(c)
            begun = empty_factor(self.trials, rows.shape[-1] - 1) if begun is None else begun
            self.factors[c] = engine.accumulate(begun, rows)

    def whole(self, values: FloatArray) -> list[FloatArray]:
        """The factor of every cluster, its priors at values (a, U) folded in."""
        assert self.own is not None
        found = []
        for c, columns in enumerate(self.own.clusters):
            width = len(columns) + self.parameters + 1
            factor = self.factors.get(c)
            factor = empty_factor(self.trials, width - 1) if factor is None else factor
            prior = self.own.prior_rows(c, values, width)
            found.append(engine.accumulate(factor, prior) if prior.shape[1] else factor)
        return found

    def finish(self, factor: FloatArray, values: FloatArray) -> FloatArray:
        """Eliminate every cluster and fold what is left of it into the machine's factor (a, p + 1, p + 1)."""
        assert self.own is not None
        for columns, own in zip(self.own.clusters, self.whole(values), strict=True):
            done, rest = eliminate(own, columns)
            self.solved.append(done)
            factor = engine.accumulate(factor, rest)
        return factor


def eliminate(factor: FloatArray, columns: IntArray) -> tuple[Eliminated, FloatArray]:
    """Eliminate the first u columns of triangular factors (a, u + p + 1, u + p + 1): what is left, (a, p + 1, p + 1).

    Directions that no row sees are left out of the solution; their rows stay.
    """
    u = len(columns)
    top, right = factor[:, :u, :u], factor[:, :u, u:]
    norm = np.linalg.norm(top, axis=1)
    norm = np.where(norm > 0.0, norm, 1.0)
    left, s, vt = np.linalg.svd(top / norm[:, None, :])
    used = s > OWN_RANK * s[:, :1]
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=used)
    inverse = np.matmul(vt.swapaxes(-1, -2) * inverse[:, None, :], left.swapaxes(-1, -2)) / norm[:, :, None]
    best = -np.matmul(inverse, right)
    rest = factor[:, u:, u:]
    if not used.all():
        turned = np.matmul(left.swapaxes(-1, -2), right)
        rest = engine.accumulate(rest, np.where(used[:, :, None], 0.0, turned))
    lost = np.sqrt(np.where(used[:, :, None], 0.0, vt**2).sum(axis=1)) > NULL_COMPONENT
    return Eliminated(columns, inverse, best[..., :-1], best[..., -1], used.sum(axis=1), lost), rest


def spread_columns(own: FloatArray, columns: IntArray, width: int) -> FloatArray:
    """Derivatives (a, k, m, u) of rows at the columns (k, u) of their cluster: (a, k, m, width)."""
    wide = np.zeros((*own.shape[:3], width + 1))
    places = np.broadcast_to(columns[:, None, :], own.shape)
    np.put_along_axis(wide, places, own, axis=-1)
    return wide[..., :width]


def _clusters(
    free: np.ndarray, sensed: tuple[Sensed, ...], together: IntArray | None
) -> tuple[IntArray, IntArray, tuple[IntArray, ...]]:
    """Cluster (U,) of each unknown (-1 where fixed), its column there (U,), and the unknowns of each cluster."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for s in sensed:
        for places in np.unique(s.places, axis=0):
            chosen = places[free[places]]
            pairs.append(np.column_stack([np.full(len(chosen), chosen[:1].sum()), chosen]))
    if together is not None:  # nodes behind those of the unknowns stand for what poses have in common
        for s in (s for s in sensed if s.places.shape[1]):
            row, column = np.nonzero(free[s.places])
            pairs.append(np.column_stack([len(free) + together[s.first[row]], s.places[row, column]]))
    links = np.concatenate(pairs)
    nodes = len(free) if together is None else len(free) + int(together.max()) + 1
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(nodes, nodes))
    name = connected_components(graph, directed=False)[1][: len(free)]
    clusters = tuple(np.flatnonzero(free & (name == c)) for c in np.unique(name[free]))
    cluster, column = np.full(len(free), -1), np.zeros(len(free), dtype=np.int64)
    for c, columns in enumerate(clusters):
        cluster[columns], column[columns] = c, np.arange(len(columns))
    return cluster, column, clusters


def _squares(factors: list[FloatArray]) -> FloatArray:
    """Sum of squares (a,) of the right-hand sides; infinite where one is not finite."""
    total = np.asarray(sum((factor[:, :, -1] ** 2).sum(axis=1) for factor in factors))
    return np.where(np.isfinite(total), total, np.inf)
