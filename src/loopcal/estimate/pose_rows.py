# SPDX-License-Identifier: Apache-2.0
"""The rows at the poses of a problem: solve for poses and nuisance parameters, give rows to nodes.

Every pose has k >= 0 coordinates. Where readings are exact, k is 0: the kinematics determine the
pose, and its rows go to the nodes of the nuisance parameters as they are. Where readings are
uncertain (errors in variables), a reading of stated sigma is a row like any other,
(true - recorded) / sigma, and closure ties pose and readings together. At given parameters of the
machine every pose stands where all its rows, readings among them, fit best, together with the
nuisance parameters. They are found by Gauss-Newton on many trials at once: every pose is closed by
the kinematics, the rows of its component are stacked, the coordinates of the component's poses are
eliminated by projection, and what is left determines the nuisance parameters; the best coordinates
follow. A step is no longer than closure is about linear, and one that does not lower the sum of
squares is halved. An exact reading has no coordinate: its row is not a heavy one, it does not
exist. See docs/theory/identification.md.

Rows are made block by block. Poses without coordinates are divided into runs of consecutive ones.
Rows that link poses of different runs form blocks of their own, with the poses that they name, so
that no block is larger than it must be. Poses with coordinates are divided into whole components:
poses that rows link, so that their coordinates are eliminated together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import itemgetter

import numpy as np

from loopcal import engine
from loopcal.errors import EstimationError
from loopcal.estimate.elimination import (
    NodeMembers,
    NodeRows,
    NuisanceElimination,
    divide_among_nodes,
    fold_node_rows,
    list_members,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import (
    KindRows,
    LinearizedPoses,
    PoseEstimates,
    PoseSolution,
    PoseStates,
    Start,
    evaluate_rows,
    linearize_rows,
)
from loopcal.estimate.observation_rows import ObservationRows, consecutive_pairs
from loopcal.estimate.pose_coordinates import PoseCoordinates
from loopcal.measure.kinds.kind import Evaluation
from loopcal.mechanism.actuation import drive_joints
from loopcal.mechanism.kinematics import WIDE, is_square
from loopcal.mechanism.sensitivity import fold_pose_rows
from loopcal.numerics import elimination
from loopcal.numerics.decomposition import NULL_COMPONENT, empty_factor
from loopcal.numerics.gauss_newton import Halving, minimize_by_halving
from loopcal.numerics.statistics import find_distinct
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class _Point:
    """All rows at closed poses and nuisance parameters, and the parts of the next step.

    Arrays are (a, ..): `squares` of the components, `gain` that the best coordinates promise.
    """

    states: PoseStates | None
    nuisance: FloatArray | None
    linearized: list[LinearizedPoses]
    evaluated: list[Evaluation | None] | None
    is_reached: BoolArray
    cost: FloatArray
    squares: FloatArray
    gain: FloatArray
    solutions: list[tuple[IntArray, ComponentGroup, FloatArray]]
    factors: elimination.NodeFactors | None
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
class PoseRows:
    """The rows at n poses, whose coordinates are eliminated before all other unknowns.

    free : the free parameters. rows : of every kind. nuisance : nuisance parameters, if any.
    coordinates : of the poses. member : (n,) component of each pose; one of all poses where they
        have no coordinates.
    """

    free: FreeParameters
    rows: tuple[ObservationRows, ...]
    nuisance: NuisanceElimination | None
    coordinates: PoseCoordinates
    member: IntArray

    @cached_property
    def blocks(self) -> tuple[PoseBlock, ...]:
        """The poses in blocks whose rows are made together."""
        count = len(self.rows) - self.coordinates.rows_of_readings
        is_needed = np.zeros(len(self.member), dtype=bool)
        for r in self.rows[:count]:
            is_needed[r.poses[r.is_present.any(axis=(0, 2))]] = True
        if self.coordinates.count:
            return divide_into_components(self.rows, is_needed, self.nuisance, self.member)
        return divide_into_runs(self.rows, is_needed, self.nuisance)

    @cached_property
    def first_pose(self) -> IntArray:
        """First pose of each component."""
        return np.unique(self.member, return_index=True)[1]

    @cached_property
    def component_count(self) -> IntArray:
        """(T | 1, components) residuals that are present."""
        components = int(self.member.max(initial=0)) + 1
        total = np.zeros((1, components), dtype=np.int64)
        for r in self.rows:
            of, present = self.member[r.first_poses], r.is_present.sum(axis=2)
            counts = np.stack([np.bincount(of, row, components) for row in present])
            total = total + counts.astype(np.int64)
        return total

    @cached_property
    def are_plain(self) -> bool:
        """Whether the platform's twist by the parameters determines all rows of solved poses, so
        that the engine folds them without writing its derivatives.
        """
        if not self.coordinates.are_shared or self.nuisance is not None:
            return False
        is_simple = all(r.kind.poses_per_row == 1 and not r.kind.sensed_joints for r in self.rows)
        robot = self.free.robot
        has_more = self.free.errors is not None or robot.stages or robot.has_open_sums
        return is_simple and not (has_more or robot.program.may_stay_open)

    @cached_property
    def compared(self) -> engine.ComparedPoses | None:
        """The rows of one trial as the engine compares them with poses that it solves; None where
        it cannot, or where poses may have to be solved again.
        """
        robot = self.free.robot
        is_simple = is_square(robot) and not robot.is_serial
        if not (self.are_plain and self.is_kept and is_simple and len(self.rows) == 1):
            return None
        (rows,) = self.blocks[0].rows
        columns, _ = rows.take_trials(np.zeros(1, dtype=np.int64))
        is_one = len(rows.measured) == len(rows.whitener) == 1 and rows.offset is None
        pairs = rows.kind.compare_platform(columns) if is_one and columns.is_complete else None
        if pairs is None or (rows.poses[1:] < rows.poses[:-1]).any():
            return None
        return engine.ComparedPoses(rows.poses, pairs[0][0], rows.whitener[0] @ pairs[1])

    @property
    def is_kept(self) -> bool:
        """Whether solved poses are kept from start to start: those of one block."""
        return len(self.blocks) == 1

    def solve(
        self,
        z: FloatArray,
        trials: IntArray,
        start: Start,
        control: Halving,
        fixed: FloatArray | None = None,
        known: PoseSolution | None = None,
        derivatives: bool = True,
    ) -> PoseSolution:
        """Solve for poses and nuisance parameters where all rows fit best, at deviations z (a, p).

        Nuisance parameters that are `fixed` (a, U) are not solved for. `known` are poses without
        coordinates that are solved already, the same for all trials; `derivatives` tells whether
        such poses are linearized.
        """
        solves_nuisance = self.nuisance is not None and fixed is None
        nuisance = start.predict_nuisance(z) if solves_nuisance else fixed
        if self.coordinates.count:
            assert start.poses is not None
            search = PoseSearch(self, z, trials, solves_nuisance)
            point, is_converged = search.minimize(start.poses, nuisance, control)
            assert point.states is not None
            is_free = self.coordinates.is_free(np.arange(len(self.member)))
            estimates = PoseEstimates(
                states=point.states,
                is_reached=point.is_reached,
                rank=point.rank,
                is_undetermined=np.asarray((point.is_unobservable & is_free).any(axis=2)),
                is_converged=is_converged,
            )
            linearized = point.linearized[0] if self.is_kept else None
            solved = point.nuisance, linearized, point.states, estimates
            return PoseSolution(*solved, evaluated=point.evaluated)
        if known is None:
            known = self.solve_exact_poses(z, start, derivatives)
        evaluated = None
        if solves_nuisance:
            located = [known.linearized] if known.linearized else self._locate_blocks(z)
            search = PoseSearch(self, z, trials, solves_nuisance, located)
            point = search.minimize(None, nuisance, control)[0]
            nuisance, evaluated = point.nuisance, point.evaluated
        return replace(known, nuisance=nuisance, evaluated=evaluated)

    def solve_exact_poses(
        self, z: FloatArray, start: Start, derivatives: bool = True
    ) -> PoseSolution:
        """Solve the poses of the only block, without coordinates, at deviations z (a | 1, p).

        Poses of several blocks are solved again wherever they are needed. A pose that Newton's
        method does not reach from a near start counts as not reached: the last step of a fit has
        the same readings, and no path to follow. Where a step is too long for Newton's method, a
        shorter one is tried.
        """
        if not self.is_kept:
            return PoseSolution(None, states=start.poses)
        begin = start.take(np.arange(len(z))) if len(z) < len(start) else start
        values, poses, driven = self.free.values(z), self.blocks[0].poses, None
        if self.are_plain and not derivatives:
            driven = drive_joints(self.free.robot, values, self.coordinates.readings)
        states = self.coordinates.close(values, poses, begin.poses, not begin.is_near, driven)
        linearized = self.coordinates.linearize(values, states, poses, derivatives)
        return PoseSolution(None, linearized, states, driven=driven)

    def next_start(self, solution: PoseSolution, start: Start) -> tuple[PoseStates | None, bool]:
        """Return the states for the next start, and whether they were solved at exact readings."""
        linearized, states, old = solution.linearized, solution.states, start.poses
        if self.coordinates.count:
            return states, False
        if linearized is None or states is None or old is None:
            return old, start.is_near
        a, ok = len(start), linearized.is_reached

        def kept(new: np.ndarray, before: np.ndarray) -> np.ndarray:
            if ok.all():
                return np.broadcast_to(new, (a, *new.shape[1:]))
            return np.where(ok.reshape(*ok.shape, *[1] * (new.ndim - 2)), new, before)

        is_new = ok.all() and len(ok) == a
        state = states.state if is_new else map_arrays(kept, states.state, old.state)
        return PoseStates(state, old.q), True

    def iterate_poses(
        self, solution: PoseSolution, z: FloatArray, derivatives: bool = True
    ) -> Iterator[tuple[PoseBlock, LinearizedPoses]]:
        """Give every block with its poses; without derivatives where they are not asked for."""
        values = self.free.values(z)
        for block in self.blocks:
            poses = solution.linearized
            if poses is None:
                poses = self._linearize_block(values, block, solution.states, derivatives)
            yield block, poses

    def iterate_rows(
        self, solution: PoseSolution, z: FloatArray, trials: IntArray
    ) -> Iterator[tuple[PoseBlock, list[NodeRows], BoolArray]]:
        """Give every block with the rows of the nodes, what is left of them once coordinates are
        eliminated, and which trials (a,) lack a needed pose.
        """
        tree = None if self.nuisance is None else self.nuisance.tree
        for block, poses in self.iterate_poses(solution, z):
            at = trials, solution.nuisance, True, solution.evaluated
            kinds = self.linearize_kinds(block, poses, *at)
            node_rows = divide_among_nodes(kinds, block.members)
            for group in block.groups:
                rest = self.eliminate(block, group, kinds, self.nuisance)[0].rest
                of_group = tree, group.structure, group.nodes, group.components
                node_rows.append(NodeRows.divide(*of_group, rest))
            yield block, node_rows, poses.is_lost(block.is_needed)

    def fold_plain_rows(
        self, factor: FloatArray, solution: PoseSolution, z: FloatArray, trials: IntArray
    ) -> tuple[FloatArray, BoolArray]:
        """Fold the rows of all blocks; return also which trials (a,) lack a needed pose.

        For rows that `are_plain`.
        """
        robot, is_lost = self.free.robot, np.zeros(len(z), dtype=bool)
        for block in self.blocks:
            states, poses = solution.states, solution.linearized
            readings = self.coordinates.readings_at(block.poses)
            if states is None or poses is None:
                all_values = self.free.values(z)
                states = self.coordinates.close(all_values, block.poses, None, True)
                poses = self.coordinates.linearize(all_values, states, block.poses, False)
            observed = []
            for r in (r for r in block.rows if len(r.poses)):
                evaluated, white = evaluate_rows(r, poses, trials, None)
                by_twist = r.whiten_columns(white, evaluated.jacobian)
                residual = r.whiten(white, evaluated.residual, trials)
                observed.append(engine.TwistRows(r.poses, by_twist, residual))
            values = self.free.values(z[: len(states.state.T)])  # one trial may stand for all
            inputs = values, readings, states.state, self.free.columns, observed, factor
            factor, is_finite = fold_pose_rows(robot, *inputs, solution.driven)
            is_lost |= np.any(~(poses.is_reached & is_finite) & block.is_needed, axis=1)
        return factor, is_lost

    def fold_compared(
        self, z: FloatArray, begin: PoseStates, steps: engine.Steps
    ) -> tuple[engine.Advanced, PoseStates] | None:
        """Solve the poses of one trial, fold their rows, and take full steps from z (1, p), by one
        call of the engine; return also the states. None where the engine does not, or where a pose
        is not solved.
        """
        if self.compared is None:
            return None
        robot, q, columns = self.free.robot, self.coordinates.readings, self.free.columns

        def move(z: FloatArray) -> tuple[FloatArray, FloatArray, engine.ParameterMap]:
            values = self.free.values(z[None])
            e, drives, joints = drive_joints(robot, values, q)
            return e, joints, columns.linearize(values, drives, q)

        own = steps._replace(deviation=z[0], widest=WIDE * robot.size, move=move)
        (e, joints, inputs), factor = move(z[0]), empty_factor(1, z.shape[1])
        at = robot.program, e, joints, begin.state, inputs, self.compared, own
        done = engine.fold_compared(factor, *at)
        if done is None or not len(done.deviations):
            return None
        return done, PoseStates(done.state, begin.q)

    def linearize_kinds(
        self,
        block: PoseBlock,
        poses: LinearizedPoses,
        trials: IntArray,
        nuisance: FloatArray | None,
        by_parameters: bool = True,
        evaluated: Sequence[Evaluation | None] | None = None,
    ) -> list[KindRows | None]:
        """Return the whitened rows of every kind at a block's poses; None without any.

        Without derivatives by the parameters, rows that nothing else changes are left out.
        `evaluated` are their residuals and derivatives, where they are known already.
        """
        return [
            linearize_rows(rows, poses, trials, nuisance, by_parameters, known)
            if len(rows.poses)
            and (by_parameters or self.coordinates.count or rows.nuisance.shape[1])
            else None
            for rows, known in zip(block.rows, evaluated or [None] * len(block.rows), strict=True)
        ]

    def count_rows(self, block_of_pose: IntArray, count: int) -> IntArray:
        """Return how many rows `iterate_rows` gives of each of `count` blocks of poses, without
        those of targets on the base; `block_of_pose` (n,) is the block of each pose.
        """
        total, k = np.zeros(count, dtype=np.int64), self.coordinates.count
        for block in self.blocks:
            for rows in block.rows if block.members else ():
                if not rows.kind.is_of_base:
                    of = block_of_pose[block.poses[rows.first_poses]]
                    total += np.bincount(of, minlength=count) * rows.whitener.shape[-1]
            for group in block.groups:
                height = max(group.height, group.poses.shape[1] * k)
                of = block_of_pose[self.first_pose[group.components]]
                total += height * np.bincount(of, minlength=count)
        return total

    def find_unreached(self, z: FloatArray, start: Start) -> IntArray:
        """Return the poses that a row needs and that cannot be reached at deviation z (1, p)."""
        located = zip(self.blocks, self._locate_blocks(z, start), strict=True)
        lost = [block.poses[~poses.is_reached[0] & block.is_needed] for block, poses in located]
        return find_distinct(np.concatenate(lost))

    def locate(
        self, z: FloatArray, start: Start
    ) -> tuple[FloatArray, dict[str, FloatArray]] | None:
        """Return poses (n, 4, 4) and joints name -> (1, n) of one trial; None if one is lost."""
        located = self._locate_blocks(z, start)
        pairs = zip(self.blocks, located, strict=True)
        if any(poses.is_lost(block.is_needed)[0] for block, poses in pairs):
            return None
        joints = {}
        for name in self.coordinates.names:
            parts = [np.broadcast_to(p.joints[name], p.is_reached.shape) for p in located]
            joints[name] = np.concatenate(parts, axis=1)[:, self.pose_order]
        return np.concatenate([p.T[0] for p in located])[self.pose_order], joints

    def _locate_blocks(self, z: FloatArray, start: Start | None = None) -> list[LinearizedPoses]:
        """Return the closed poses of every block, from home or a start."""
        states, values = None if start is None else start.poses, self.free.values(z)
        closed = []
        for block in self.blocks:
            begin = None if states is None else states.take_poses(block.poses)
            found = self.coordinates.close(values, block.poses, begin, True)
            closed.append(self.coordinates.linearize(values, found, block.poses, False))
        return closed

    def _linearize_block(
        self, values: FloatArray, block: PoseBlock, solved: PoseStates | None, derivatives: bool
    ) -> LinearizedPoses:
        """Return the poses of a block, closed as they are solved, or from home."""
        if solved is None:
            states = self.coordinates.close(values, block.poses, None, True)
        else:
            states = solved.take_poses(block.poses)
        return self.coordinates.linearize(values, states, block.poses, derivatives)

    @cached_property
    def pose_order(self) -> IntArray:
        """First places (n,) of all poses among those of the blocks, one after the other."""
        poses = np.concatenate([block.poses for block in self.blocks])
        return np.unique(poses, return_index=True)[1]

    def eliminate(
        self,
        block: PoseBlock,
        group: ComponentGroup,
        kinds: Sequence[KindRows | None],
        nuisance: NuisanceElimination | None,
    ) -> tuple[elimination.Elimination, FloatArray]:
        """Eliminate the coordinates of a group's components from their stacked rows.

        Return also the sums of squares (a, C) before.
        """
        tree, k = None if nuisance is None else nuisance.tree, self.coordinates.count
        rows = stack_rows(block, group, kinds, k, tree)
        squares = (rows[..., -1] ** 2).sum(axis=2)
        return elimination.eliminate_columns(rows, group.poses.shape[1] * k), squares


class PoseSearch:
    """The search for the best poses and nuisance parameters at deviations z (a, p) of trials (a,).

    `solves_nuisance` tells whether nuisance parameters are solved for; `located` are the poses of
    every block where these have no coordinates.
    """

    def __init__(
        self,
        rows: PoseRows,
        z: FloatArray,
        trials: IntArray,
        solves_nuisance: bool,
        located: list[LinearizedPoses] | None = None,
    ) -> None:
        self.rows: PoseRows = rows
        self.values: FloatArray = rows.free.values(z)
        self.trials: IntArray = trials
        self.nuisance: NuisanceElimination | None = rows.nuisance if solves_nuisance else None
        self.located: list[LinearizedPoses] | None = located

    def minimize(
        self, begin: PoseStates | None, nuisance: FloatArray | None, control: Halving
    ) -> tuple[_Point, BoolArray]:
        """Return the best poses and nuisance parameters, and which trials (a,) converged."""

        def is_part_worse(point: _Point, candidate: _Point) -> BoolArray:
            grew = ~(candidate.squares <= point.squares)[:, self.rows.member]
            return grew | ~candidate.is_reached

        first = self.evaluate(begin, nuisance)
        alone = None if self.nuisance is not None else is_part_worse
        return minimize_by_halving(first, self.propose, self.move, control, alone)

    def evaluate(
        self,
        begin: PoseStates | None,
        nuisance: FloatArray | None,
        is_still: BoolArray | None = None,
    ) -> _Point:
        """Close all poses that have coordinates and compare their rows.

        Where `is_still` (a, n) is given, these poses are closed already, and poses that Newton does
        not close are not followed. Rows of located poses that no nuisance parameter changes are
        left out.
        """
        pose_rows, values, a = self.rows, self.values, len(self.values)
        coordinates, k = pose_rows.coordinates, pose_rows.coordinates.count
        n, components = len(pose_rows.member), len(pose_rows.first_pose)
        tree, factors = None, None
        if self.nuisance is not None:
            tree = self.nuisance.tree
            factors = elimination.NodeFactors(tree, a, 0)
        squares, gain, cost = np.zeros((a, components)), np.zeros(a), np.zeros(a)
        rank = np.zeros((a, components), dtype=np.int64)
        is_unobservable = np.zeros((a, n, k), dtype=bool)
        linearized, solutions, closed, kinds = [], [], [], list[KindRows | None]()
        is_reached, is_lost = np.zeros((a, n), dtype=bool), np.zeros(a, dtype=bool)
        for i, block in enumerate(pose_rows.blocks):
            if self.located is None:
                assert begin is not None
                states = begin.take_poses(block.poses)
                solved = coordinates.close(values, block.poses, states, is_still is None)
                if is_still is not None and is_still.any():
                    # solved again, poses that did not move could end on another branch
                    still = np.nonzero(is_still[:, block.poses])
                    before = map_arrays(itemgetter(still), states)
                    solved = solved.put_poses(still[0], still[1], before)
                closed.append(solved)
                poses = coordinates.linearize(values, solved, block.poses)
            else:
                poses = self.located[i]
            is_reached[:, block.poses] = poses.is_reached
            is_lost |= poses.is_lost(block.is_needed)
            linearized = [poses] if pose_rows.is_kept else []
            kinds = pose_rows.linearize_kinds(block, poses, self.trials, nuisance, False)
            node_rows = divide_among_nodes(kinds, block.members)
            node_rows = [part for part in node_rows if part.structure >= 0]
            cost += sum((part.machine[..., -1] ** 2).sum(axis=(1, 2)) for part in node_rows)
            for group in block.groups:
                best, before = pose_rows.eliminate(block, group, kinds, self.nuisance)
                squares[:, group.components] = before
                gain += best.explained.sum(axis=1)
                rank[:, group.components] = best.rank
                part = np.sqrt((best.unobservable**2).sum(axis=-2)) > NULL_COMPONENT
                numbers = block.poses[group.poses]
                is_unobservable[:, numbers] = part.reshape(a, *group.poses.shape, k)
                solutions.append((numbers, group, best.solution))
                if group.structure >= 0:
                    own = tree, group.structure, group.nodes, group.components, best.rest
                    node_rows.append(NodeRows.divide(*own))
            if factors is not None:
                fold_node_rows(empty_factor(0, 0), factors, node_rows)
        cost = cost + squares.sum(axis=1)
        if factors is not None and self.nuisance is not None and nuisance is not None:
            unknowns = self.nuisance.take(self.trials)
            cost = cost + unknowns.prior_cost(nuisance)
            unknowns.fold_priors(factors, nuisance)
        return _Point(
            states=PoseStates.join_poses(closed, pose_rows.pose_order) if closed else None,
            nuisance=nuisance,
            linearized=linearized,
            evaluated=[k and k.evaluated for k in kinds] if pose_rows.is_kept else None,
            is_reached=is_reached,
            cost=np.where(is_lost | ~np.isfinite(cost), np.inf, cost),
            squares=squares,
            gain=gain,
            solutions=solutions,
            factors=factors,
            rank=rank,
            is_unobservable=is_unobservable,
        )

    def propose(self, point: _Point) -> _Step:
        """Return the Gauss-Newton step of all poses and nuisance parameters.

        The share of it that is tried first is one for all poses of a component, or of a trial where
        nuisance parameters move, too.
        """
        rows, a, nuisance, change = self.rows, len(self.values), None, point.gain
        u = np.zeros((a, len(rows.member), rows.coordinates.count))
        if point.factors is not None:
            done, _ = elimination.eliminate_tree(point.factors)
            nuisance, change = done.shift, change + done.explained
        for numbers, group, solution in point.solutions:
            right = np.ones((a, len(numbers), 1))
            if nuisance is not None and self.nuisance is not None and group.structure >= 0:
                tree = self.nuisance.tree
                path = tree.structures[group.structure].path[tree.place[group.nodes]]
                right = np.concatenate([nuisance[:, path], right], axis=2)
            best = -np.matmul(solution, right[..., None])[..., 0]
            u[:, numbers] = best.reshape(a, *numbers.shape, -1)
        each = rows.coordinates.limit_step(u)
        if self.nuisance is not None:
            share = np.repeat(each.min(axis=1, keepdims=True), each.shape[1], axis=1)
        else:
            least = np.ones((a, len(rows.first_pose)))
            np.minimum.at(least.T, rows.member, each.T)
            share = least[:, rows.member]
        return _Step(u, nuisance, change, share)

    def move(self, point: _Point, step: _Step, share: FloatArray) -> _Point:
        """Return the point to which shares (a, n) of a step lead."""
        states, nuisance = point.states, point.nuisance
        if states is not None:
            states = self.rows.coordinates.move(states, share[..., None] * step.u)
        if step.nuisance is not None and nuisance is not None:
            nuisance = nuisance + share[:, :1] * step.nuisance
        return self.evaluate(states, nuisance, is_still=share == 0.0)


BLOCK = 2048
"""Poses (of all trials together) whose rows are made at once: enough for NumPy to be efficient, few
enough for the cache."""
EXACT_BLOCK = 4096
"""The same of poses without coordinates. All problems of the same poses have the same blocks, so
that poses that one of them solved serve another one."""
LARGEST = 2000
"""Coordinates of one component, at most: its rows are one dense matrix."""


@dataclass(frozen=True, eq=False)
class ComponentGroup:
    """Components of equal structure within a block: C of them, of L poses each.

    components : (C,) their numbers. poses : (C, L) their places in the block.
    height : number of rows that are kept for each; rows that are not used are zero.
    structure, nodes : structure and nodes (C,) of the nuisance parameters that their rows use, -1
        without any.
    rows : for each kind the rows (k,), the component (k,) and first place (k,) of each, and the
        places of its poses (k, links) within the component.
    """

    components: IntArray
    poses: IntArray
    height: int
    structure: int
    nodes: IntArray
    rows: tuple[tuple[IntArray, IntArray, IntArray, IntArray], ...]


@dataclass(frozen=True, eq=False)
class PoseBlock:
    """Some poses and the rows that observed them.

    poses : (b,) numbers of the poses.
    row_numbers : of every kind, (k,). rows : of every kind, poses numbered within the block; where
        poses have no coordinates those of each target on its own, see `ObservationRows.divided`.
    is_needed : (b,) poses that some row needs.
    members : of every kind, its rows by nodes where poses have no coordinates. groups : of
        components, whose coordinates are eliminated before their rows go to the nodes.
    """

    poses: IntArray
    row_numbers: tuple[IntArray, ...]
    rows: tuple[ObservationRows, ...]
    is_needed: BoolArray
    members: tuple[tuple[NodeMembers, ...], ...] = ()
    groups: tuple[ComponentGroup, ...] = ()

    def locate(self, kind: int, numbers: IntArray) -> tuple[IntArray, IntArray]:
        """Return the rows (n,) of a kind, and their residuals (n, m), that some of `rows` are."""
        whole, m = self.row_numbers[kind], self.rows[kind].whitener.shape[-1]
        k = max(len(self.rows[kind].poses) // max(len(whole), 1), 1)
        return whole[numbers // k], (numbers % k * m)[:, None] + np.arange(m)


def divide_into_runs(
    rows: Sequence[ObservationRows], is_needed: BoolArray, nuisance: NuisanceElimination | None
) -> tuple[PoseBlock, ...]:
    """Divide n poses without coordinates.

    The first blocks cover every pose once, in order. Those of linked rows follow.
    """
    n, size, blocks = len(is_needed), EXACT_BLOCK, []
    runs = [r.poses_by_link // size for r in rows]
    inside = [
        np.where(np.ptp(run, axis=1) == 0, run[:, 0], -1) if len(run) else run[:, 0] for run in runs
    ]

    def add(poses: IntArray, chosen: tuple[IntArray, ...]) -> None:
        own = tuple(r.divided() for r in take_rows(rows, poses, chosen, n))
        members = tuple(list_members(nuisance, r) for r in own)
        blocks.append(PoseBlock(poses, chosen, own, is_needed[poses], members))

    for k in range(0, n, size):
        chosen = tuple(np.flatnonzero(run == k // size) for run in inside)
        add(np.arange(k, min(k + size, n)), chosen)
    nothing = np.zeros(0, dtype=np.int64)
    for i, run in enumerate(inside):
        linked = np.flatnonzero(run < 0)
        for first in range(0, len(linked), size // 2):
            linking = linked[first : first + size // 2]
            poses = find_distinct(rows[i].poses[linking])
            add(poses, tuple(linking if j == i else nothing for j in range(len(rows))))
    return tuple(blocks)


def divide_into_components(
    rows: Sequence[ObservationRows],
    is_needed: BoolArray,
    nuisance: NuisanceElimination | None,
    member: IntArray,
) -> tuple[PoseBlock, ...]:
    """Divide poses into blocks of whole components, of about `BLOCK` poses each.

    member : (n,) component of each pose.
    """
    counts = np.bincount(member)
    block = ((np.cumsum(counts) - counts) // BLOCK)[member]
    nodes, structures = np.full(len(counts), -1), np.full(len(counts), -1)
    if nuisance is not None:  # the innermost node that rows of each component use
        for r in (r for r in rows if r.nuisance.shape[1]):
            innermost = nuisance.tree.node[r.nuisance].max(axis=1)
            np.maximum.at(nodes, member[r.first_poses], innermost)
        structures[nodes >= 0] = nuisance.tree.structure[nodes[nodes >= 0]]
    blocks = []
    for k in find_distinct(block):
        chosen = tuple(np.flatnonzero(block[r.first_poses] == k) for r in rows)
        poses = np.flatnonzero(block == k)
        own = take_rows(rows, poses, chosen, len(member))
        groups = _group_components(own, member[poses], nodes, structures)
        blocks.append(PoseBlock(poses, chosen, own, is_needed[poses], groups=groups))
    return tuple(blocks)


def take_rows(
    rows: Sequence[ObservationRows], poses: IntArray, chosen: tuple[IntArray, ...], n: int
) -> tuple[ObservationRows, ...]:
    """Return the chosen rows of every kind, whose poses are among poses (b,) of n, by these."""
    place = np.zeros(n, dtype=np.int64)
    place[poses] = np.arange(len(poses))
    return tuple(r.take_rows(numbers, place) for r, numbers in zip(rows, chosen, strict=True))


def find_components(n: int, rows: Sequence[ObservationRows], coordinates: int) -> IntArray:
    """Return the component (n,) of each pose, numbered by first poses; raises EstimationError for
    one with more than `LARGEST` coordinates.
    """
    pairs = [consecutive_pairs(r.poses) for r in rows if r.poses.ndim > 1]
    links = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
    member = elimination.find_connected_groups(links, n)
    largest = int(np.bincount(member).max())
    if largest * coordinates > LARGEST:
        unknowns = largest * coordinates
        raise EstimationError.of(
            "poses.chain-too-long", poses=largest, unknowns=unknowns, allowed=LARGEST
        )
    return member


def _group_components(
    rows: Sequence[ObservationRows], member: IntArray, nodes: IntArray, structures: IntArray
) -> tuple[ComponentGroup, ...]:
    """Group a block's components by number of poses, structure and, roughly, number of rows.

    `member` (b,) is the component of each of its poses; `nodes` and `structures` are those of all
    components, -1 without nuisance parameters.
    """
    numbers, local, lengths = np.unique(member, return_inverse=True, return_counts=True)
    heights, starts = np.zeros(len(numbers), dtype=np.int64), []
    for r in rows:
        m, component = r.whitener.shape[-1], local[r.first_poses]
        order = np.argsort(component, kind="stable")
        within = np.zeros(len(component), dtype=np.int64)
        ordered = component[order]
        within[order] = np.arange(len(component)) - np.searchsorted(ordered, ordered)
        starts.append(heights[component] + m * within)
        heights += m * np.bincount(component, minlength=len(numbers))
    place = np.zeros(len(member), dtype=np.int64)
    order = np.argsort(local, kind="stable")
    place[order] = np.arange(len(order)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    size = np.ceil(np.log2(np.maximum(heights, 1)))
    key = np.column_stack([lengths, structures[numbers], size])
    groups = []
    for alike in np.unique(key, axis=0):
        chosen = np.flatnonzero((key == alike).all(axis=1))
        number = np.full(len(numbers), -1)
        number[chosen] = np.arange(len(chosen))
        rows_of_kinds = []
        for r, start in zip(rows, starts, strict=True):
            own = np.flatnonzero(number[local[r.first_poses]] >= 0)
            component = number[local[r.first_poses[own]]]
            rows_of_kinds.append((own, component, start[own], place[r.poses_by_link[own]]))
        poses = np.flatnonzero(number[local] >= 0)
        ranked = np.empty((len(chosen), int(alike[0])), dtype=np.int64)
        ranked[number[local[poses]], place[poses]] = poses
        groups.append(
            ComponentGroup(
                components=numbers[chosen],
                poses=ranked,
                height=int(heights[chosen].max()),
                structure=int(alike[1]),
                nodes=nodes[numbers[chosen]],
                rows=tuple(rows_of_kinds),
            )
        )
    return tuple(groups)


def stack_rows(
    block: PoseBlock,
    group: ComponentGroup,
    kinds: Sequence[KindRows | None],
    coordinates: int,
    tree: elimination.EliminationTree | None,
) -> FloatArray:
    """Stack the rows of a group's components, [u | nuisance | machine | residual], into (a, C,
    height, L k + w + p + 1).

    The w columns of nuisance parameters are those of the path of each component's node; there are
    none without a tree.
    """
    present = next(kind for kind in kinds if kind is not None)
    a, p, k = len(present.residual), present.by_parameters.shape[-1], coordinates
    w = 0 if tree is None or group.structure < 0 else tree.structures[group.structure].width
    first = group.poses.shape[1] * k
    out = np.zeros((a, len(group.components), max(group.height, first), first + w + p + 1))
    for kind, observed, (rows, component, start, links) in zip(
        kinds, block.rows, group.rows, strict=True
    ):
        if kind is None or not len(rows):
            continue
        m = kind.residual.shape[-1]
        cells = (slice(None), component[:, None], start[:, None] + np.arange(m))
        out[(*cells, -1)] = kind.residual[:, rows]
        if p:
            out[(*cells, slice(first + w, -1))] = kind.by_parameters[:, rows]
        if w and tree is not None and kind.by_nuisance is not None:
            columns = tree.columns(group.nodes[component], observed.nuisance[rows])
            spread = elimination.spread_columns(kind.by_nuisance[:, rows], columns, w)
            out[(*cells, slice(first, first + w))] = spread
        if kind.by_coordinates is None:
            continue
        for i in range(links.shape[1]):
            columns = (links[:, i, None] * k + np.arange(k))[:, None, :]
            where = (slice(None), component[:, None, None], cells[2][:, :, None], columns)
            out[where] = kind.by_coordinates[:, rows, i]
    return out
