# SPDX-License-Identifier: Apache-2.0
"""Poses at given parameters of the machine: where they, and the measurements' own unknowns, fit all
rows best.

Gauss-Newton on both together, many trials at once: every pose is closed by the kinematics, its rows
are put side by side with those of the poses it is linked to, its free numbers are eliminated by
projection, and what is left gives the own unknowns; the best free numbers follow. A step is no
longer than closure is about linear, and one that does not lower the sum of squares, or to which
Newton does not get at once, is halved. See docs/theory/latent.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal import engine
from loopcal.estimate.components import (
    Group,
    KindRows,
    Projected,
    component_blocks,
    groups_of,
    project,
    side_by_side,
)
from loopcal.estimate.elimination import Factors
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.local import CLOSE, NOTHING, Own, spread_columns
from loopcal.estimate.moves import evaluated, machine_columns, mapped
from loopcal.estimate.sensed import BLOCK, Block, Sensed
from loopcal.estimate.standing import Chart, FreeMoves, Standing
from loopcal.measure import Evaluation, list_sensed_joints
from loopcal.numerics.decomposition import without_rounding
from loopcal.typing import FloatArray, IntArray

STEPS = 30
"""Gauss-Newton steps to the best poses at given parameters; two are usual."""

HALVINGS = 10
"""Halvings of a step; a pose that still gets worse by a thousandth of it stays."""

STUCK = 1e-3
"""Share of what a step promises that it must gain where it promises as much of the sum of squares:
a pose at the end of its reach gains nothing however often it is halved.
"""

ROUNDING = 1e-12
"""Change of the sum of squares, relative, that is rounding and says nothing about a step."""


@dataclass(frozen=True, eq=False)
class Settled:
    """Poses of a trials where their rows fit best.

    Attributes
    ----------
    standing : closed. values : (a, U) of the own unknowns, None without any. moves : of every
        block, where there is one.
    failed : (a,) where a needed pose is out of reach. cost : (a,). calm : (a,) which came to rest.
    rank : (a, components) directions of poses that rows see. open : (a, n, k) numbers with a part
        in one that none sees.
    """

    standing: Standing
    values: FloatArray | None
    moves: FreeMoves | None
    failed: np.ndarray
    cost: FloatArray
    calm: np.ndarray
    rank: IntArray
    open: np.ndarray


@dataclass(frozen=True, eq=False)
class Look:
    """All rows at a point: closed poses, sums of squares of the components, and the parts of the
    next step.
    """

    standing: Standing
    values: FloatArray | None
    moves: list[FreeMoves]
    ok: np.ndarray
    joints: dict[str, FloatArray]
    failed: np.ndarray
    cost: FloatArray
    squares: FloatArray
    gain: FloatArray
    parts: list[tuple[IntArray, Group, FloatArray]]
    factors: Factors | None
    rank: IntArray
    open: np.ndarray


@dataclass(frozen=True, eq=False)
class _Step:
    """Step of the poses and own unknowns, and by how much (squared) it changes the rows."""

    u: FloatArray
    b: FloatArray | None
    gain: FloatArray


class Poses:
    """Poses that are unknowns, and the rows that see them.

    Parameters
    ----------
    unknowns : the free parameters and their units. sensed : the rows of every kind. chart : how
        poses move.
    member : (n,) component of each pose. own : the unknowns that the measurements bring with them.
    needed : (n,) poses that must be in reach.
    """

    def __init__(
        self,
        unknowns: FreeParameters,
        sensed: tuple[Sensed, ...],
        chart: Chart,
        member: IntArray,
        own: Own | None,
        needed: np.ndarray,
    ) -> None:
        self.unknowns, self.sensed, self.chart, self.member, self.own = (
            unknowns,
            sensed,
            chart,
            member,
            own,
        )
        self.components = int(member.max()) + 1
        self.joints = list_sensed_joints(s.kind for s in sensed)
        self.blocks = component_blocks(sensed[-1].measured[0], sensed, member, needed, BLOCK)
        nodes, forms = self._nodes()
        self.groups = [groups_of(block, member, nodes, forms) for block in self.blocks]

    def _nodes(self) -> tuple[IntArray, IntArray]:
        """Innermost node of own unknowns that each component's rows use, and its form; -1 without
        any.
        """
        found, forms = np.full(self.components, -1), np.full(self.components, -1)
        if self.own is not None:
            for s in (s for s in self.sensed if s.places.shape[1]):
                np.maximum.at(
                    found, self.member[s.first], self.own.nesting.node[s.places].max(axis=1)
                )
            forms[found >= 0] = self.own.nesting.form[found[found >= 0]]
        return found, forms

    def settle(
        self, z: FloatArray, trials: IntArray, begin: Standing, fixed: FloatArray | None = None
    ) -> Settled:
        """Move poses and own unknowns to where all rows fit best at deviations z (a, p); `fixed`
        (a, U) holds the latter.
        """
        own = self.own is not None and fixed is None
        values = fixed
        if own:
            values = self._own_values(z, trials, begin)
        here = self.look(z, trials, begin, values, own)
        calm, stuck = np.zeros(len(trials), dtype=bool), ~np.isfinite(here.cost)
        for _ in range(STEPS):
            step = self._step(here, len(trials), own)
            calm = step.gain <= CLOSE**2 * here.cost + NOTHING**2
            if (calm | stuck).all():
                break
            before = here.cost
            here, moved = self._moved(z, trials, here, step, ~calm & ~stuck, own)
            stuck |= (step.gain > STUCK * before) & ~(before - here.cost > STUCK * step.gain)
            if not moved:
                break
        alone = here.moves[0] if len(self.blocks) == 1 else None
        return Settled(
            here.standing, here.values, alone, here.failed, here.cost, calm, here.rank, here.open
        )

    def projected(
        self, here: Settled, z: FloatArray, trials: IntArray
    ) -> Iterator[tuple[Group, Projected]]:
        """Every group of components with its rows, poses eliminated, at settled poses."""
        k = self.chart.freedoms
        for block, groups in zip(self.blocks, self.groups, strict=True):
            moves = here.moves
            if moves is None:
                values = self.unknowns.values(z)
                moves = self.chart.linearised(
                    values, here.standing.at(block.poses), block.poses, block.needed
                )
            kinds = self._kinds(block, moves, trials, here.values)
            for group in groups:
                width = self.width(group)
                rows = side_by_side(
                    group, self._own_columns(kinds, block, group), k, width, len(self.unknowns)
                )
                done = project(rows, group.poses.shape[1] * k)
                yield group, done

    def _own_values(self, z: FloatArray, trials: IntArray, begin: Standing) -> FloatArray:
        """Values (a, U) with which the own unknowns begin: those followed from the last fold, or
        found from the poses.
        """
        own = self.own
        assert own is not None
        fresh = np.flatnonzero(~own.started[trials])
        if len(fresh):
            here = self.look(z, trials, begin, own.predicted(trials, z), own=False)
            for i in fresh[~here.failed[fresh]]:
                joints = {name: value[i : i + 1] for name, value in here.joints.items()}
                own.begin(int(trials[i]), here.standing.state.T[i], joints)
        return own.predicted(trials, z)

    def look(
        self,
        z: FloatArray,
        trials: IntArray,
        at: Standing,
        values: FloatArray | None,
        own: bool,
        still: np.ndarray | None = None,
    ) -> Look:
        """Close all poses and compare their rows; `own` tells whether the own unknowns move, too.

        Where `still` (a, n) is given, these poses are closed already, and those that Newton does
        not close are not followed.
        """
        free, k, a = self.unknowns.values(z), self.chart.freedoms, len(trials)
        folding = Factors(self.own.nesting, a, 0) if own and self.own is not None else None
        squares, gain = np.zeros((a, self.components)), np.zeros(a)
        rank = np.zeros((a, self.components), dtype=np.int64)
        unseen = np.zeros((a, len(self.member), k), dtype=bool)
        kept, parts, closed, ok, failed, joints = [], [], [], [], [], []
        for block, groups in zip(self.blocks, self.groups, strict=True):
            begin = at.at(block.poses)
            found = self.chart.closed(free, begin, follow=still is None)
            closed.append(found if still is None else _kept(found, begin, still[:, block.poses]))
            moves = self.chart.linearised(free, closed[-1], block.poses, block.needed)
            ok.append(moves.ok)
            failed.append(moves.failed)
            joints.append(
                {name: np.broadcast_to(moves.joints[name], moves.ok.shape) for name in self.joints}
            )
            if len(self.blocks) == 1:
                kept.append(moves)
            kinds = self._kinds(block, moves, trials, values, machine=False)
            for group in groups:
                width = self.width(group) if own else 0
                rows = side_by_side(
                    group, self._own_columns(kinds, block, group) if width else kinds, k, width, 0
                )
                squares[:, group.components] = (rows[..., -1] ** 2).sum(axis=2)
                done = project(rows, group.poses.shape[1] * k)
                gain += done.gain.sum(axis=1)
                rank[:, group.components] = done.rank
                unseen[:, block.poses[group.poses]] = done.open.reshape(a, *group.poses.shape, k)
                parts.append((block.poses[group.poses], group, done.best))
                if width and folding is not None:
                    places = np.repeat(folding.nesting.place[group.nodes], done.rest.shape[2])
                    folding.add(group.form, done.rest.reshape(a, -1, width + 1), places)
        cost = squares.sum(axis=1) + (0.0 if not own else self._held(values))
        where = np.argsort(np.concatenate([block.poses for block in self.blocks]))
        whole = Standing(
            engine.State(**_joined([c.state for c in closed], where)),
            np.concatenate([c.q for c in closed], axis=1)[:, where],
        )
        lost = np.any(failed, axis=0)
        seen = {
            name: np.concatenate([part[name] for part in joints], axis=1)[:, where]
            for name in self.joints
        }
        if folding is not None and self.own is not None and values is not None:
            self.own.fold_priors(folding, values)
        cost = np.where(lost, np.inf, cost)
        reached = np.concatenate(ok, axis=1)[:, where]
        return Look(
            whole,
            values,
            kept,
            reached,
            seen,
            lost,
            cost,
            squares,
            gain,
            parts,
            folding,
            rank,
            unseen,
        )

    def _held(self, values: FloatArray | None) -> FloatArray | float:
        """Sum of squares (a,) of the priors of own unknowns."""
        if self.own is None or values is None or not self.own.held.any():
            return 0.0
        table, held = self.own.local.table, self.own.held
        return (((values[:, held] - table.nominal[held]) / table.tolerance[held]) ** 2).sum(axis=1)

    def _step(self, here: Look, a: int, own: bool) -> _Step:
        """Gauss-Newton step of all poses (a, n, k) and own unknowns (a, U), and by how much it
        lowers the squares.
        """
        u = np.zeros((a, len(self.member), self.chart.freedoms))
        b, gain = None, here.gain
        if own and self.own is not None and here.factors is not None:
            b, offset = self.own.step(here.factors)
            gain = gain + offset
        for poses, group, best in here.parts:
            right = np.ones((a, len(poses), 1))
            if b is not None and group.form >= 0 and self.own is not None:
                right = np.concatenate([b[:, self._path(group)], right], axis=2)
            u[:, poses] = -np.matmul(best, right[..., None])[..., 0].reshape(a, *poses.shape, -1)
        return _Step(u, b, gain)

    def _moved(
        self, z: FloatArray, trials: IntArray, here: Look, step: _Step, going: np.ndarray, own: bool
    ) -> tuple[Look, bool]:
        """Take the step of the trials that are going, halved where it does not lower the sum of
        squares; tell if any moved.

        Without own unknowns components are independent, and only those that got worse are halved.
        """
        every = np.arange(len(self.member))
        share = np.where(going[:, None], self._share(step.u, own), 0.0)
        found = here
        for i in range(HALVINGS + 1):
            at = self.chart.moved(here.standing, share[..., None] * step.u, every)
            values = here.values
            if own and step.b is not None and values is not None:
                values = values + share[:, :1] * step.b
            found = self.look(z, trials, at, values, own, still=share == 0.0)
            worse = going & ~(found.cost <= (1.0 + ROUNDING) * here.cost + NOTHING**2)
            if not worse.any():
                break
            bad = np.repeat(worse[:, None], len(every), axis=1)
            if not own:
                bad &= ~(found.squares <= here.squares)[:, self.member] | ~found.ok
            share[bad] *= 0.5 if i < HALVINGS - 1 else 0.0
        return found, bool(share.any())

    def _share(self, u: FloatArray, own: bool) -> FloatArray:
        """Share (a, n) of steps u that is tried first: one for all poses of a component, with own
        unknowns for all.
        """
        each, least = self.chart.share(u), np.ones((len(u), self.components))
        np.minimum.at(least.T, self.member, each.T)
        return (
            np.repeat(each.min(axis=1, keepdims=True), each.shape[1], axis=1)
            if own
            else least[:, self.member]
        )

    def _kinds(
        self,
        block: Block,
        moves: FreeMoves,
        trials: IntArray,
        values: FloatArray | None,
        machine: bool = True,
    ) -> list[KindRows | None]:
        """Whitened rows of every kind at a block's poses."""
        found: list[KindRows | None] = []
        for s in block.sensed:
            if not len(s.poses):
                found.append(None)
                continue
            seen, white = evaluated(s, moves, trials, values)
            a, r, m = seen.residual.shape
            by_own = (
                None
                if seen.nuisance is None
                else np.matmul(
                    white, np.broadcast_to(seen.nuisance, (a, r, m, seen.nuisance.shape[-1]))
                )
            )
            by_machine = (
                machine_columns(s, seen, white, moves) if machine else np.zeros((a, r, m, 0))
            )
            residual = np.matmul(white, seen.residual[..., None])[..., 0]
            found.append(
                KindRows(_free_columns(s, seen, white, moves), by_own, by_machine, residual)
            )
        return found

    def _own_columns(
        self, kinds: Sequence[KindRows | None], block: Block, group: Group
    ) -> list[KindRows | None]:
        """The rows with their own unknowns at the columns of the paths of the group's components."""
        if self.own is None or group.form < 0:
            return list(kinds)
        width, found = self.width(group), []
        for kind, s, (rows, of, _, _) in zip(kinds, block.sensed, group.rows, strict=True):
            if kind is None or kind.own is None:
                found.append(kind)
                continue
            columns = np.full(s.places.shape, width)
            columns[rows] = self.own.nesting.columns(group.nodes[of], s.places[rows])
            found.append(kind._replace(own=spread_columns(kind.own, columns, width)))
        return found

    def _path(self, group: Group) -> IntArray:
        """Own unknowns (C, w) of the paths of a group's components."""
        assert self.own is not None
        return self.own.nesting.forms[group.form].path[self.own.nesting.place[group.nodes]]

    def width(self, group: Group) -> int:
        """Columns of own unknowns of a group's rows."""
        return (
            0
            if self.own is None or group.form < 0
            else self.own.nesting.forms[group.form].path.shape[1]
        )


def _free_columns(
    sensed: Sensed, seen: Evaluation, white: FloatArray, moves: FreeMoves
) -> FloatArray:
    """Whitened derivatives (a, r, links, m, k) of a kind's rows by the free numbers of the poses
    they saw.
    """
    if sensed.kind.poses_per_row > 1:
        every = range(sensed.kind.poses_per_row)
        parts = [
            np.matmul(white, by_pose(seen.jacobian[:, :, i], moves.Y[:, sensed.poses[:, i]]))
            for i in every
        ]
        return np.stack(parts, axis=2)
    columns = by_pose(seen.jacobian, moves.Y[:, sensed.poses])
    if seen.joints is not None and sensed.kind.sensed_joints:
        turns = np.stack(
            [moves.turns[name][:, sensed.poses] for name in sensed.kind.sensed_joints], axis=2
        )
        columns = columns + np.matmul(seen.joints, turns)
    return np.matmul(white, columns)[:, :, None]


def by_pose(jacobian: FloatArray, Y: FloatArray) -> FloatArray:
    """Derivatives (a, r, m, k) of rows by the free numbers of a pose, with zeros where a row does
    not see their move.
    """
    return without_rounding(np.matmul(jacobian, Y), np.matmul(np.abs(jacobian), np.abs(Y)))


def _kept(found: Standing, begin: Standing, still: np.ndarray) -> Standing:
    """Poses as they were found, those that were still (a, n) as they began: solved anew they could
    end on another branch.
    """
    trial, pose = np.nonzero(still)
    if not len(trial):
        return found
    return found.put(
        (trial, pose),
        Standing(mapped(lambda array: array[trial, pose], begin.state), begin.q[trial, pose]),
    )


def _joined(parts: list[engine.State], where: IntArray) -> dict:
    """Fields of states of all blocks, poses in their own order."""
    found = {}
    for f in dataclasses.fields(engine.State):
        if f.name == "joints":
            found["joints"] = tuple(
                np.concatenate(j, axis=1)[:, where]
                for j in zip(*(p.joints for p in parts), strict=True)
            )
        else:
            found[f.name] = np.concatenate([getattr(p, f.name) for p in parts], axis=1)[:, where]
    return found
