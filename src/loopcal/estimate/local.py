# SPDX-License-Identifier: Apache-2.0
"""Unknowns that measurements bring with them (frames, targets, surfaces, offsets) inside a fit:
solved for and eliminated.

At every point of the descent their values are those that fit the rows best at the machine's present
poses, so that the sum of squares is a function of the machine alone. The rows [F | A | r], own
columns first, are folded into one triangular factor; the block below the own columns is the factor
of the rows projected onto the complement of F. Rank, filters and covariance of the machine are read
from it as if the frames were known. Unknowns are nested, see `loopcal.estimate.nesting`: a factor
has the columns of a surface and of what it shares with others, however many sessions and groups
there are. A tolerance is one more row. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.estimate.elimination import Eliminated, Factors, eliminate
from loopcal.estimate.nesting import nest
from loopcal.estimate.sensed import Sensed
from loopcal.measure import Measurements, NuisanceParameters, Observations, guess_nuisance_values
from loopcal.parameters import ParameterTable
from loopcal.typing import FloatArray, IntArray

STEPS, HALVINGS = 30, 20
"""Gauss-Newton steps to the best own unknowns at fixed poses, and halvings of each; two or three
steps are usual.
"""

CLOSE, NOTHING = 1e-7, 1e-5
"""Change of the whitened residuals, as a share of them and in standard deviations, below which a
step is the last: what
is left to first order the elimination removes."""


class Own:
    """Own unknowns of the rows of t machines: how they are nested, present values, and how these
    follow the machine.

    Rows and their reweighted copies share one of these: `solved` and the values belong to the last
    fold of any of them. At most `steps` of Gauss-Newton, each halved `halvings` times at most, are
    taken where a fold begins.

    Parameters
    ----------
    local : the U unknowns. sensed : the rows of every kind. trials : number of machines. parameters
        : p.
    data : from a trial's number to its measurements, from which values to begin with are found.
    together : (n,) poses of equal number have unknowns of their own in common, so that their rows
        stand side by side.
    """

    def __init__(
        self,
        local: NuisanceParameters,
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
        self.nesting = nest(self.free, [p.scope for p in table.entries], _sets(sensed, together))
        cluster = self.nesting.cluster
        self.clusters = [
            np.flatnonzero(cluster == c) for c in range(int(cluster.max(initial=-1)) + 1)
        ]
        self.priors = int(self.held.sum())
        self.values = np.tile(local.values(), (trials, 1))
        self.start = local.values()
        self.started = np.zeros(trials, dtype=bool)
        self.steps, self.halvings = STEPS, HALVINGS
        self.at = np.zeros((trials, parameters))
        self.slope = np.zeros((trials, len(local), parameters))
        self.cost = np.full(trials, np.inf)
        self.rank = np.full(trials, int(self.free.sum()))
        self.solved: Eliminated | None = None

    @property
    def unheld(self) -> int:
        """How many are estimated without a prior."""
        return int((self.free & ~self.held).sum())

    def members(self, sensed: Sensed) -> list[tuple[int, IntArray, IntArray, IntArray]]:
        """Rows of a kind by the form of the node that each belongs to, -1 without one.

        Returns
        -------
        (form, rows (k,), their nodes (k,), columns (k, u) that their unknowns have in the path of
        these); fixed unknowns have the column after the last.
        """
        every = np.arange(len(sensed.poses))
        if not sensed.places.shape[1]:
            return [(-1, every, np.full(len(every), -1), np.zeros((len(every), 0), dtype=np.int64))]
        nest, node = self.nesting, self.nesting.node[sensed.places].max(axis=1)
        form = np.full(len(node), -1)
        form[node >= 0] = nest.form[node[node >= 0]]
        found = []
        for f in np.unique(form):
            rows = np.flatnonzero(form == f)
            nodes, places = node[rows], sensed.places[rows]
            columns = np.zeros_like(places) if f < 0 else nest.columns(nodes, places)
            found.append((int(f), rows, nodes, columns))
        return found

    def fold_priors(self, factors: Factors, values: FloatArray) -> None:
        """Fold the priors in at values (a, U), a row each."""
        table = self.local.table
        for i, form in enumerate(self.nesting.forms):
            place, column = np.nonzero(self.held[form.own])
            if not len(place):
                continue
            unknown = form.own[place, column]
            rows = np.zeros((len(values), len(place), form.path.shape[1] + factors.parameters + 1))
            rows[:, np.arange(len(place)), column] = 1.0 / table.tolerance[unknown]
            rows[:, :, -1] = (values[:, unknown] - table.nominal[unknown]) / table.tolerance[
                unknown
            ]
            factors.add(i, rows, place)

    def begin(self, trial: int, T: FloatArray, joints: Mapping[str, FloatArray]) -> None:
        """Put a trial at the values that fit its poses (n, 4, 4) and joints name -> (1, n), cluster
        by cluster.
        """
        values, data = self.local.values(), self.data(trial)
        clusters = [
            self.nesting.cluster[places].max(axis=1, initial=-1) for places in self.local.indices
        ]
        for c in range(len(self.clusters)):
            some = [
                (o.take(of == c), p[of == c])
                for o, p, of in self._rows(data, clusters)
                if (of == c).any()
            ]
            used = np.unique(np.concatenate([places.ravel() for _, places in some]))
            entries = tuple(self.local.table.entries[i] for i in used)
            local = NuisanceParameters(
                ParameterTable(entries), tuple(np.searchsorted(used, places) for _, places in some)
            )
            part = replace(data, observations=tuple(rows for rows, _ in some))
            values[used] = guess_nuisance_values(part, T, local, joints)
        self.values[trial], self.started[trial] = values, True
        self.start = values.copy()

    def follow(self, trial: int) -> None:
        """Put a trial at the values with which the first one began."""
        self.values[trial], self.started[trial] = self.start, True

    def _rows(
        self, data: Measurements, clusters: list[IntArray]
    ) -> list[tuple[Observations, IntArray, IntArray]]:
        """Kinds with rows, which unknowns each uses, and the cluster of each row."""
        every = zip(data.observations, self.local.indices, clusters, strict=True)
        return [(o, places, of) for o, places, of in every if len(o) and places.shape[1]]

    def predicted(self, trials: IntArray, deviation: FloatArray) -> FloatArray:
        """Values (a, U) of some trials at deviations (a, p), to first order from where they were
        found last.
        """
        change = deviation - self.at[trials]
        return self.values[trials] + np.matmul(self.slope[trials], change[..., None])[..., 0]

    def settled(self, values: FloatArray, factors: Callable[[FloatArray], Factors]) -> FloatArray:
        """The values (a, U) next to given ones that make the sum of squares smallest, by
        Gauss-Newton with halving.

        Parameters
        ----------
        factors : from values to the factors of [F | r], priors folded in.
        """
        found = factors(values)
        cost = found.squares()
        for _ in range(self.steps):
            step, offset = self.step(found)
            far = offset > CLOSE**2 * cost + NOTHING**2
            if not far.any():
                break
            share = far.astype(np.float64)
            for _ in range(self.halvings):
                found = factors(values + share[:, None] * step)
                worse = (share > 0.0) & ~(found.squares() <= cost)
                if not worse.any():
                    break
                share[worse] *= 0.5
            else:
                share[~(found.squares() <= cost)] = 0.0
                found = factors(values + share[:, None] * step)
            values, cost = values + share[:, None] * step, found.squares()
            if not share.any():
                break
        return values

    def step(self, factors: Factors) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton step (a, U), and by how much (squared) it changes the whitened residuals
        (a,).
        """
        step = eliminate(factors)[0].shift
        return step, factors.moved(step)

    def finish(self, factors: Factors, values: FloatArray) -> FloatArray:
        """Eliminate all at values (a, U) and remember it: the factor (a, p + 1, p + 1) of what is
        left for the machine.
        """
        self.fold_priors(factors, values)
        self.solved, rest = eliminate(factors)
        return rest

    def keep(
        self, trials: IntArray, deviation: FloatArray, values: FloatArray, cost: FloatArray
    ) -> None:
        """Remember a fold: how many directions it solved for and, where it is the best one yet,
        from where to go on.
        """
        assert self.solved is not None
        self.rank[trials] = self.solved.rank
        better = np.isfinite(cost) & (cost <= self.cost[trials])
        chosen = trials[better]
        self.cost[chosen], self.at[chosen], self.values[chosen] = (
            cost[better],
            deviation[better],
            values[better],
        )
        self.slope[chosen] = self.solved.slope[better]


class Part(NamedTuple):
    """Rows of a kind that belong to nodes of one form, -1 without: their numbers (k,), nodes (k,),
    and whitened rows (a, k * m, path + p + 1).
    """

    form: int
    which: IntArray
    nodes: IntArray
    rows: FloatArray


def fold_parts(factors: Factors | None, parts: list[Part]) -> None:
    """Fold the rows with own unknowns into the factors of their nodes, those of one form at once."""
    if factors is None:
        return
    for form in sorted({part.form for part in parts if part.form >= 0}):
        some = [part for part in parts if part.form == form]
        places = [
            np.repeat(factors.nesting.place[part.nodes], part.rows.shape[1] // len(part.nodes))
            for part in some
        ]
        factors.add(
            form, np.concatenate([part.rows for part in some], axis=1), np.concatenate(places)
        )


def spread_columns(own: FloatArray, columns: IntArray, width: int) -> FloatArray:
    """Derivatives (a, k, m, u) of rows at the columns (k, u) of their cluster: (a, k, m, width)."""
    wide = np.zeros((*own.shape[:3], width + 1))
    places = np.broadcast_to(columns[:, None, :], own.shape)
    np.put_along_axis(wide, places, own, axis=-1)
    return wide[..., :width]


def _sets(sensed: tuple[Sensed, ...], together: IntArray | None) -> IntArray:
    """Pairs (set, unknown), one set for the unknowns of each row and, with `together`, of the rows
    that stand side by side.
    """
    found, number = [np.zeros((0, 2), dtype=np.int64)], 0
    using = [s for s in sensed if s.places.shape[1]]
    for s in using:
        used = np.unique(s.places, axis=0)
        found.append(
            np.column_stack([np.repeat(number + np.arange(len(used)), used.shape[1]), used.ravel()])
        )
        number += len(used)
    if together is not None:
        sides = [
            (np.repeat(number + together[s.first], s.places.shape[1]), s.places.ravel())
            for s in using
        ]
        found += [np.column_stack(pair) for pair in sides]
    return np.concatenate(found)
