# SPDX-License-Identifier: Apache-2.0
"""Rows of measurements at poses whose readings are not exact, or that nobody measured: each pose is
an unknown, too.

A reading of stated sigma is a row like any other, (true - recorded) / sigma, and closure ties pose
and readings together. At every point of the descent each pose stands where all its rows, readings
among them, fit best (variable projection by Gauss-Newton, the measurements' own unknowns with it),
so that the sum of squares is a function of the machine alone. The free numbers of a pose are then
eliminated by orthogonal projection, component by component, and what is left are rows [own |
machine | residual] as of any other measurement. An exact reading has no free number: its row is not
a heavy one, it is none. See docs/theory/latent.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from loopcal import engine
from loopcal.estimate.components import components_of
from loopcal.estimate.elimination import Factors
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.latent_start import start_of
from loopcal.estimate.local import Own
from loopcal.estimate.moves import evaluated
from loopcal.estimate.sensed import BLOCK, Residuals, Sensed
from loopcal.estimate.settle import Poses, Settled
from loopcal.estimate.standing import ByPose, ByReadings, Chart, Standing
from loopcal.measure import list_sensed_joints, make_readings_kind
from loopcal.mechanism import Status
from loopcal.numerics.decomposition import empty_factor
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

UNSEEN = 1e-3
"""Unit of a reading that was not taken: this share of the robot's size, or this many radians. It
has no row.
"""


class Memory:
    """Where the poses of all trials stood last, where they stood at the best fold, and how many
    directions rows saw.
    """

    def __init__(
        self, start: Callable[[], Standing], trials: int, components: int, poses: int
    ) -> None:
        self.start = start
        self.best: Standing | None = None
        self.cost = np.full(trials, np.inf)
        self.rank = np.zeros((trials, components), dtype=np.int64)
        self.calm = np.ones(trials, dtype=bool)
        self.open = np.zeros((trials, poses), dtype=bool)
        self.last: Settled | None = None

    def take(self, trials: IntArray) -> Standing:
        """Where some trials begin."""
        if self.best is None:
            self.best = self.start()
        return self.best.of(trials)

    def keep(self, trials: IntArray, settled: Settled, cost: FloatArray) -> None:
        """Remember a fold, where it is the best one yet, as the place to go on from."""
        better = np.isfinite(cost) & (cost <= self.cost[trials])
        self.cost[trials[better]] = cost[better]
        if better.all() and len(trials) == len(self.cost):
            self.best = settled.standing
        elif better.any() and self.best is not None:
            self.best = self.best.put(
                (trials[better], slice(None)), settled.standing.of(np.flatnonzero(better))
            )


class LatentRows:
    """Whitened rows of t machines whose poses are unknowns, too; a `Problem` of the descent with
    the interface of `Rows`.

    Parameters
    ----------
    unknowns : the free parameters and their units. sensed : the rows of every kind, those of the
        readings last.
    trials : number of machines t. chart : how poses move. member : (n,) component of each pose.
    own : the unknowns that the measurements bring with them. memory : shared by rows that differ in
        weights alone.
    """

    located = None

    def __init__(
        self,
        unknowns: FreeParameters,
        sensed: tuple[Sensed, ...],
        trials: int,
        chart: Chart,
        member: IntArray,
        own: Own | None,
        memory: Memory,
    ) -> None:
        self.unknowns, self.sensed, self.own = unknowns, sensed, own
        self.chart, self.member, self.memory = chart, member, memory
        self.parameters = len(unknowns)
        self.first = np.unique(member, return_index=True)[1]
        components, n = int(member.max()) + 1, len(member)
        self.present = np.zeros((trials, components), dtype=np.int64)
        needed = np.zeros(n, dtype=bool)
        for i, s in enumerate(sensed):
            there = np.einsum("trii->tri", s.whitener) != 0.0
            of = np.repeat(member[s.first], there.shape[2])
            for t, row in enumerate(there.reshape(len(there), -1)):
                found = np.bincount(of[row], minlength=components)
                self.present[slice(None) if len(there) == 1 else t] += found
            if i < len(sensed) - 1 or isinstance(chart, ByPose):
                needed[s.poses[there.any(axis=(0, 2))]] = True
        self.counted: IntArray = self.present.sum(axis=1)
        self.needed = needed
        self.poses = Poses(unknowns, sensed, chart, member, own, needed)

    @property
    def rows(self) -> IntArray:
        """(t,) equations, less the directions of own unknowns and of poses that the last fold
        solved for.
        """
        own = 0 if self.own is None else self.own.priors - self.own.rank
        return self.counted - self.memory.rank.sum(axis=1) + own

    @property
    def equations(self) -> IntArray:
        """(t,) equations that are left, at least, once every pose is found: what counts before
        anything is solved.
        """
        free = np.bincount(
            self.member,
            self.chart.free(np.arange(len(self.member))).sum(axis=1),
            self.present.shape[1],
        )
        return np.maximum(self.present - free.astype(np.int64), 0).sum(axis=1)

    def fold(self, deviation: FloatArray, trials: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return triangular factor (a, p + 1, p + 1) and sum of squares (a,); infinite where a pose
        is out of reach.
        """
        factor = empty_factor(len(trials), self.parameters)
        lost = np.zeros(len(trials), dtype=bool)
        together = max(1, BLOCK // max(len(block.poses) for block in self.poses.blocks))
        for first in range(0, len(trials), together):
            some = slice(first, first + together)
            factor[some], lost[some] = self._folded(deviation[some], trials[some])
        return factor, np.where(lost, np.inf, (factor[:, :, -1] ** 2).sum(axis=1))

    def _folded(self, z: FloatArray, trials: IntArray) -> tuple[FloatArray, np.ndarray]:
        """Factor (a, p + 1, p + 1) of some trials, all but the machine settled and eliminated;
        which are out of reach.
        """
        here = self._settled(z, trials)
        factor = empty_factor(len(trials), self.parameters)
        folding = (
            None if self.own is None else Factors(self.own.nesting, len(trials), self.parameters)
        )
        for group, done in self.poses.projected(here, z, trials):
            rest = done.rest.reshape(len(trials), -1, done.rest.shape[-1])
            if folding is None or group.form < 0:
                factor = engine.fold(factor, rest)
            else:
                folding.add(
                    group.form,
                    rest,
                    np.repeat(folding.nesting.place[group.nodes], done.rest.shape[2]),
                )
        cost = (factor[:, :, -1] ** 2).sum(axis=1)
        if self.own is not None and folding is not None and here.values is not None:
            factor = engine.fold(factor, self.own.finish(folding, here.values))
            cost = np.where(here.failed, np.inf, (factor[:, :, -1] ** 2).sum(axis=1))
            self.own.keep(trials, z, here.values, cost)
        self.memory.keep(trials, here, np.where(here.failed, np.inf, cost))
        return factor, here.failed

    def own_values(self, deviation: FloatArray) -> FloatArray | None:
        """Return the own unknowns (t, U) that fit best at deviations (t, p); None where there are
        none.
        """
        return (
            None if self.own is None else self._settled(deviation, np.arange(len(deviation))).values
        )

    def residuals(
        self, deviation: FloatArray, own: FloatArray | None = None
    ) -> tuple[Residuals, ...]:
        """Return the residuals of every kind at deviations (t, p), the readings' last; NaN where a
        pose is out of reach.

        Own unknowns are as given (t, U); by default those that fit best. Every pose stands where
        its own rows put it.
        """
        trials = np.arange(len(deviation))
        here = self._settled(deviation, trials, own)
        shapes = [(len(trials), *s.whitener.shape[1:3]) for s in self.sensed]
        found = [Residuals(np.full(shape, np.nan), np.full(shape, np.nan)) for shape in shapes]
        for block in self.poses.blocks:
            moves = self.chart.linearised(
                self.unknowns.values(deviation),
                here.standing.at(block.poses),
                block.poses,
                block.needed,
            )
            for kind, rows, sensed in zip(found, block.rows, block.sensed, strict=True):
                if len(rows):
                    seen, white = evaluated(sensed, moves, trials, here.values)
                    closed = np.all(moves.ok[:, sensed.per_pose], axis=2, keepdims=True)
                    raw = np.where(closed, seen.residual, np.nan)
                    kind.raw[:, rows], kind.whitened[:, rows] = (
                        raw,
                        np.matmul(white, raw[..., None])[..., 0],
                    )
        return tuple(found)

    def linearised(self, deviation: FloatArray) -> Iterator[list[tuple[IntArray, FloatArray]]]:
        """Give, block by block, first poses (r,) and rows (r, m, U + p + 1) of components, their
        poses eliminated.

        Columns as for `Rows.linearised`, own unknowns where the last fold left them. Poses stand
        where these rows put them at these own unknowns: the last fold may be of rows with other
        weights, some of them absent, which did not move them.
        """
        trial, p = np.arange(1), self.parameters
        last = self.memory.last
        assert last is not None
        here = self.poses.settle(deviation, trial, last.standing, last.values)
        wide = 0 if self.own is None else len(self.own.local)
        for group, done in self.poses.projected(here, deviation, trial):
            one = done.rest[0]
            w = one.shape[-1] - p - 1
            rows = np.zeros((*one.shape[:2], wide + p + 1))
            rows[..., -p - 1 :] = one[..., w:]
            if self.own is not None and self.own.solved is not None and group.form >= 0:
                path, root, slope = self.own.solved.at(group.nodes)
                rows[..., -p - 1 : -1] += one[..., :w] @ slope
                every, m = np.arange(len(one))[:, None, None], np.arange(one.shape[1])[:, None]
                rows[every, m, path[:, None, :]] = one[..., :w] @ root
            yield [(self.first[group.components], rows)]

    def sizes(self, member: IntArray, count: int) -> IntArray:
        """How many rows `linearised` gives of each of `count` blocks; member (n,) is the block of
        each pose.
        """
        k, total = self.chart.freedoms, np.zeros(count, dtype=np.int64)
        for group in (group for groups in self.poses.groups for group in groups):
            height = max(group.height, group.poses.shape[1] * k)
            total += height * np.bincount(member[self.first[group.components]], minlength=count)
        return total

    def spent(self, member: IntArray, count: int) -> IntArray:
        """How many of the residuals of each of `count` blocks (trial 0) its poses have used up."""
        return np.bincount(member[self.first], self.memory.rank[0], count).astype(np.int64)

    def weighted(self, weight: FloatArray) -> LatentRows:
        """Return these rows with a factor (n,) on each pose's squares, its readings among them; 0
        makes its rows absent.
        """
        root = np.sqrt(weight)
        scaled = []
        for s in self.sensed:
            each = root[s.per_pose].prod(axis=1) ** (1.0 / s.per_pose.shape[1])
            scaled.append(dataclasses.replace(s, whitener=s.whitener * each[:, None, None]))
        self.memory.cost[:] = np.inf
        if self.own is not None:
            self.own.cost[:] = np.inf
        return LatentRows(
            self.unknowns,
            tuple(scaled),
            len(self.counted),
            self.chart,
            self.member,
            self.own,
            self.memory,
        )

    def unreachable(self, deviation: FloatArray) -> IntArray:
        """Return the poses that some row needs and that cannot be reached at deviation (1, p)."""
        here = self.poses.look(
            deviation, np.arange(1), self.memory.take(np.arange(1)), None, own=False
        )
        return np.flatnonzero(~here.ok[0] & self.needed)

    def standing(self) -> tuple[np.ndarray, Standing]:
        """Where every pose stood (a, n) when the rows were looked at last, and which of them are in
        reach.
        """
        here = self.memory.last
        assert here is not None
        return np.asarray(here.standing.state.status == Status.CONVERGED), here.standing

    def _settled(self, z: FloatArray, trials: IntArray, own: FloatArray | None = None) -> Settled:
        """Poses and own unknowns where all rows fit best at deviations z (a, p), from where they
        stood last.
        """
        here = self.poses.settle(z, trials, self.memory.take(trials), own)
        self.memory.last = here
        self.memory.rank[trials], self.memory.calm[trials] = here.rank, here.calm
        self.memory.open[trials] = (here.open & self.chart.free(np.arange(len(self.member)))).any(
            axis=2
        )
        return here


def latent_rows(
    unknowns: FreeParameters,
    recorded: FloatArray,
    sigma: FloatArray,
    sensed: tuple[Sensed, ...],
    trials: int,
    own: Callable[[IntArray], Own | None],
) -> LatentRows:
    """Return the rows of t machines whose readings are not exact.

    Parameters
    ----------
    recorded : (t | 1, n, a) [SI], NaN where not taken. sigma : (n, a) [SI], 0 exact, infinite not
        taken or not believed.
    own : from the component (n,) of each pose to the unknowns that the measurements bring with
        them.
    """
    robot, n = unknowns.robot, len(sigma)
    believed = np.isfinite(sigma) & (sigma > 0.0)
    weight = np.zeros((1, *sigma.shape, sigma.shape[1]))
    weight[0, :, range(sigma.shape[1]), range(sigma.shape[1])] = np.where(
        believed, 1.0 / np.where(believed, sigma, 1.0), 0.0
    ).T
    readings = Sensed(make_readings_kind(robot), np.arange(n), recorded, weight)
    every = (*sensed, readings)
    names = list_sensed_joints(s.kind for s in every)
    unseen = np.array(
        [UNSEEN * (robot.size if a.dimension is Dimension.LENGTH else 1.0) for a in robot.actuators]
    )
    scale = np.where(np.isinf(sigma), unseen, sigma)
    chart = (
        ByReadings(unknowns, scale, names)
        if robot.program.sigma is None
        else ByPose(unknowns, names)
    )
    member = components_of(n, every, chart.freedoms)
    memory = Memory(
        lambda: start_of(robot, recorded, sigma, every[:-1], trials),
        trials,
        int(member.max()) + 1,
        n,
    )
    return LatentRows(unknowns, every, trials, chart, member, own(member), memory)
