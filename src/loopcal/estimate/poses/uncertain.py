# SPDX-License-Identifier: Apache-2.0
"""Poses at uncertain readings: errors in variables, every pose is estimated.

A reading of stated sigma is a row like any other, (true - recorded) / sigma, and closure ties pose
and readings together. At given parameters of the machine every pose stands where all its rows,
readings among them, fit best, together with the nuisance parameters. They are found by Gauss-Newton
on many trials at once: every pose is closed by the kinematics, the rows of its component are
stacked, the coordinates of the component's poses are eliminated by projection, and what is left
determines the nuisance parameters; the best coordinates follow. A step is no longer than closure is
about linear, and one that does not lower the sum of squares is halved. An exact reading has no
coordinate: its row is not a heavy one, it does not exist. See docs/theory/uncertain-readings.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Start
from loopcal.estimate.nuisance.elimination import NodeRows, NuisanceElimination, fold_node_rows
from loopcal.estimate.observation_rows import PoseBlock
from loopcal.estimate.poses.components import ComponentGroup, spread_nuisance, stack_rows
from loopcal.estimate.poses.coordinates import PoseCoordinates
from loopcal.estimate.poses.linearization import (
    KindRows,
    LinearizedPoses,
    join_located,
    linearize_rows,
)
from loopcal.estimate.poses.states import PoseEstimates, PoseSolution, PoseStates
from loopcal.numerics.column_elimination import Elimination, eliminate_columns
from loopcal.numerics.decomposition import NULL_COMPONENT, empty_factor
from loopcal.numerics.gauss_newton import Halving, minimize_by_halving
from loopcal.numerics.tree_elimination import NodeFactors, eliminate_tree
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is minimized: deviations z (a, p) and numbers (a,) of the trials; nuisance fixed?"""

    z: FloatArray
    trials: IntArray
    solves_nuisance: bool


@dataclass(frozen=True, eq=False)
class _Point:
    """All rows at closed poses and nuisance parameters, and the parts of the next step.

    Arrays are (a, ..): `squares` of the components, `gain` that the best coordinates promise.
    """

    states: PoseStates
    nuisance: FloatArray | None
    linearized: list[LinearizedPoses]
    is_reached: BoolArray
    is_lost: BoolArray
    cost: FloatArray
    squares: FloatArray
    gain: FloatArray
    solutions: list[tuple[IntArray, ComponentGroup, FloatArray]]
    factors: NodeFactors | None
    rank: IntArray
    is_unobservable: BoolArray


@dataclass(frozen=True, eq=False)
class _Step:
    """Full step of the coordinates (a, n, k) and nuisance parameters (a, U)."""

    u: FloatArray
    nuisance: FloatArray | None
    change: FloatArray
    share: FloatArray


@dataclass(frozen=True, eq=False)
class UncertainPoses:
    """Rows at poses of uncertain readings.

    Attributes
    ----------
    free : the free parameters. names : joints that kinds look at. coordinates : of the poses.
    member : (n,) component of each pose. blocks : of whole components. groups : of every block.
    nuisance : nuisance parameters, if any. is_needed : (n,) poses that must be reached.
    """

    free: FreeParameters
    names: tuple[str, ...]
    coordinates: PoseCoordinates
    member: IntArray
    blocks: tuple[PoseBlock, ...]
    groups: tuple[tuple[ComponentGroup, ...], ...]
    nuisance: NuisanceElimination | None
    is_needed: BoolArray
    first_pose: IntArray = field(init=False)

    def __post_init__(self) -> None:
        first = np.unique(self.member, return_index=True)[1]
        object.__setattr__(self, "first_pose", first)

    @property
    def block_size(self) -> int:
        """Poses of the largest block."""
        return max(len(block.poses) for block in self.blocks)

    @property
    def components(self) -> int:
        """Number of components."""
        return len(self.first_pose)

    def next_start(self, solution: PoseSolution, start: Start) -> tuple[PoseStates | None, bool]:
        """Return the pose estimates for the next start."""
        del start
        return solution.states, False

    def solve(
        self,
        z: FloatArray,
        trials: IntArray,
        start: Start,
        control: Halving,
        fixed: FloatArray | None = None,
        derivatives: bool = True,
    ) -> PoseSolution:
        """Estimate the poses and the nuisance parameters where all rows fit best.

        Parameters
        ----------
        z : (a, p) deviations. trials : (a,) numbers of the rows' trials. start : of the a trials.
        fixed : (a, U), optional; nuisance parameters that are not solved for.
        """
        del derivatives
        assert start.poses is not None
        problem = _Problem(z, trials, self.nuisance is not None and fixed is None)
        nuisance = fixed if not problem.solves_nuisance else start.predict_nuisance(z)

        def propose(point: _Point) -> _Step:
            return self._propose(problem, point)

        def move(point: _Point, step: _Step, share: FloatArray) -> _Point:
            return self._move(problem, point, step, share)

        def is_part_worse(point: _Point, candidate: _Point) -> BoolArray:
            grew = ~(candidate.squares <= point.squares)[:, self.member]
            return grew | ~candidate.is_reached

        point, is_converged = minimize_by_halving(
            self._evaluate(problem, start.poses, nuisance),
            propose,
            move,
            control,
            None if problem.solves_nuisance else is_part_worse,
        )
        is_free = self.coordinates.is_free(np.arange(len(self.member)))
        estimates = PoseEstimates(
            states=point.states,
            is_reached=point.is_reached,
            rank=point.rank,
            is_undetermined=(point.is_unobservable & is_free).any(axis=2),
            is_converged=is_converged,
        )
        linearized = point.linearized[0] if len(self.blocks) == 1 else None
        return PoseSolution(point.nuisance, linearized, point.states, estimates)

    def iterate_rows(
        self, solution: PoseSolution, z: FloatArray, trials: IntArray
    ) -> Iterator[tuple[list[NodeRows], BoolArray]]:
        """Give, block by block, the rows left for the nodes once the coordinates are eliminated,
        and which trials (a,) lack a needed pose.
        """
        linearized = self.iterate_linearized(solution, z, trials)
        for (block, poses), groups in zip(linearized, self.groups, strict=True):
            kinds = self._linearize_kinds(block, poses, trials, solution.nuisance)
            node_rows = []
            for group in groups:
                rest = self._eliminate(block, group, kinds)[0].rest
                node_rows.append(NodeRows(group.structure, group.nodes, group.components, rest))
            yield node_rows, poses.is_lost(block.is_needed)

    def poses_of(self, block: PoseBlock, part: NodeRows) -> IntArray:
        """Return the first pose of each component of a part."""
        del block
        return self.first_pose[part.numbers]

    def iterate_poses(
        self, solution: PoseSolution, z: FloatArray
    ) -> Iterator[tuple[PoseBlock, LinearizedPoses]]:
        """Give every block with its poses, linearized."""
        assert solution.states is not None
        values = self.free.values(z)
        for block in self.blocks:
            poses = solution.linearized
            if poses is None:
                states = solution.states.take_poses(block.poses)
                poses = self.coordinates.linearize(values, states, block.poses)
            yield block, poses

    def iterate_linearized(
        self, solution: PoseSolution, z: FloatArray, trials: IntArray
    ) -> Iterator[tuple[PoseBlock, LinearizedPoses]]:
        """Give every block with its poses, linearized."""
        del trials
        yield from self.iterate_poses(solution, z)

    def find_unreached(self, z: FloatArray, start: Start) -> IntArray:
        """Return the poses that a row needs and that cannot be reached at deviation z (1, p)."""
        assert start.poses is not None
        problem = _Problem(z, np.zeros(1, dtype=np.int64), False)
        point = self._evaluate(problem, start.poses, start.nuisance)
        return np.flatnonzero(~point.is_reached[0] & self.is_needed)

    def locate(
        self, z: FloatArray, start: Start, solution: PoseSolution | None = None
    ) -> tuple[FloatArray, dict[str, FloatArray]] | None:
        """Return poses (n, 4, 4) and joints name -> (1, n) of one trial; None if one is lost."""
        del solution
        assert start.poses is not None
        values, poses_of_blocks = self.free.values(z), []
        for block in self.blocks:
            closed = self.coordinates.close(values, start.poses.take_poses(block.poses), True)
            poses = self.coordinates.linearize(values, closed, block.poses)
            if poses.is_lost(block.is_needed)[0]:
                return None
            poses_of_blocks.append((closed.state.T[0], poses))
        return join_located(poses_of_blocks, self.names, self._pose_order())

    def _evaluate(
        self,
        problem: _Problem,
        begin: PoseStates,
        nuisance: FloatArray | None,
        is_still: BoolArray | None = None,
    ) -> _Point:
        """Close all poses and compare their rows.

        Where `is_still` (a, n) is given, these poses are closed already, and poses that Newton does
        not close are not followed.
        """
        values, k, a = self.free.values(problem.z), self.coordinates.freedoms, len(problem.z)
        factors = None
        if problem.solves_nuisance and self.nuisance is not None:
            factors = NodeFactors(self.nuisance.tree, a, 0)
        squares, gain = np.zeros((a, self.components)), np.zeros(a)
        rank = np.zeros((a, self.components), dtype=np.int64)
        is_unobservable = np.zeros((a, len(self.member), k), dtype=bool)
        kept, solutions, closed, reached = [], [], [], []
        is_lost = np.zeros(a, dtype=bool)
        for block, groups in zip(self.blocks, self.groups, strict=True):
            states = begin.take_poses(block.poses)
            solved = self.coordinates.close(values, states, is_still is None)
            if is_still is not None:
                solved = _keep_still(solved, states, is_still[:, block.poses])
            closed.append(solved)
            poses = self.coordinates.linearize(values, solved, block.poses)
            reached.append(poses.is_reached)
            is_lost |= poses.is_lost(block.is_needed)
            if len(self.blocks) == 1:
                kept.append(poses)
            kinds = self._linearize_kinds(block, poses, problem.trials, nuisance, False)
            for group in groups:
                best, before = self._eliminate(block, group, kinds, problem.solves_nuisance)
                squares[:, group.components] = before
                gain += best.explained.sum(axis=1)
                rank[:, group.components] = best.rank
                part = np.sqrt((best.unobservable**2).sum(axis=-2)) > NULL_COMPONENT
                numbers = block.poses[group.poses]
                is_unobservable[:, numbers] = part.reshape(a, *group.poses.shape, k)
                solutions.append((numbers, group, best.solution))
                if factors is not None and group.structure >= 0:
                    rows = NodeRows(group.structure, group.nodes, group.components, best.rest)
                    fold_node_rows(empty_factor(0, 0), factors, [rows])
        cost = squares.sum(axis=1)
        if factors is not None and self.nuisance is not None and nuisance is not None:
            unknowns = self.nuisance.take(problem.trials)
            cost = cost + unknowns.prior_cost(nuisance)
            unknowns.fold_priors(factors, nuisance)
        order = self._pose_order()
        return _Point(
            states=PoseStates.join_poses(closed, order),
            nuisance=nuisance,
            linearized=kept,
            is_reached=np.concatenate(reached, axis=1)[:, order],
            is_lost=is_lost,
            cost=np.where(is_lost, np.inf, cost),
            squares=squares,
            gain=gain,
            solutions=solutions,
            factors=factors,
            rank=rank,
            is_unobservable=is_unobservable,
        )

    def _propose(self, problem: _Problem, point: _Point) -> _Step:
        """Return the Gauss-Newton step of all poses and nuisance parameters."""
        a = len(problem.z)
        u = np.zeros((a, len(self.member), self.coordinates.freedoms))
        nuisance, change = None, point.gain
        if point.factors is not None:
            nuisance = eliminate_tree(point.factors)[0].shift
            change = change + point.factors.squared_change(nuisance)
        for numbers, group, solution in point.solutions:
            right = np.ones((a, len(numbers), 1))
            if nuisance is not None and group.structure >= 0:
                right = np.concatenate([nuisance[:, self._paths(group)], right], axis=2)
            best = -np.matmul(solution, right[..., None])[..., 0]
            u[:, numbers] = best.reshape(a, *numbers.shape, -1)
        return _Step(u, nuisance, change, self._first_share(u, problem.solves_nuisance))

    def _first_share(self, u: FloatArray, together: bool) -> FloatArray:
        """Return the share (a, n) of steps u that is tried first: one for all poses of a component,
        or of a trial where nuisance parameters move, too.
        """
        each = self.coordinates.limit_step(u)
        if together:
            return np.repeat(each.min(axis=1, keepdims=True), each.shape[1], axis=1)
        least = np.ones((len(u), self.components))
        np.minimum.at(least.T, self.member, each.T)
        return least[:, self.member]

    def _move(self, problem: _Problem, point: _Point, step: _Step, share: FloatArray) -> _Point:
        """Return the point to which shares (a, n) of a step lead."""
        states = self.coordinates.move(point.states, share[..., None] * step.u)
        nuisance = point.nuisance
        if step.nuisance is not None and nuisance is not None:
            nuisance = nuisance + share[:, :1] * step.nuisance
        return self._evaluate(problem, states, nuisance, is_still=share == 0.0)

    def _linearize_kinds(
        self,
        block: PoseBlock,
        poses: LinearizedPoses,
        trials: IntArray,
        nuisance: FloatArray | None,
        by_parameters: bool = True,
    ) -> list[KindRows | None]:
        """Return the whitened rows of every kind at a block's poses; None without any."""
        return [
            linearize_rows(rows, poses, trials, nuisance, by_parameters)
            if len(rows.poses)
            else None
            for rows in block.rows
        ]

    def _eliminate(
        self,
        block: PoseBlock,
        group: ComponentGroup,
        kinds: Sequence[KindRows | None],
        with_nuisance: bool = True,
    ) -> tuple[Elimination, FloatArray]:
        """Eliminate the coordinates of a group's components from their stacked rows.

        Return also the sums of squares (a, C) before.
        """
        k, width = self.coordinates.freedoms, 0
        if with_nuisance and self.nuisance is not None and group.structure >= 0:
            width = self.nuisance.tree.structures[group.structure].width
            kinds = spread_nuisance(self.nuisance.tree, kinds, block, group)
        rows = stack_rows(group, kinds, k, width)
        squares = (rows[..., -1] ** 2).sum(axis=2)
        return eliminate_columns(rows, group.poses.shape[1] * k), squares

    def _paths(self, group: ComponentGroup) -> IntArray:
        """Return the nuisance parameters (C, w) of the paths of a group's components."""
        assert self.nuisance is not None
        tree = self.nuisance.tree
        return tree.structures[group.structure].path[tree.place[group.nodes]]

    def _pose_order(self) -> IntArray:
        """Return the places (n,) of all poses among those of the blocks, one after the other."""
        return np.argsort(np.concatenate([block.poses for block in self.blocks]))


def _keep_still(solved: PoseStates, before: PoseStates, is_still: BoolArray) -> PoseStates:
    """Return solved poses, those that did not move (a, n) as before.

    Solved again, they could end on another branch.
    """
    rows, poses = np.nonzero(is_still)
    if not len(rows):
        return solved
    return solved.put_poses(rows, poses, map_arrays(lambda array: array[rows, poses], before))
