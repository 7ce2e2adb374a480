# SPDX-License-Identifier: Apache-2.0
"""Poses at exact readings: the forward kinematics determine them, and they have no coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine
from loopcal.estimate.elimination import (
    NodeMembers,
    NodeRows,
    NuisanceElimination,
    divide_among_nodes,
    fold_node_rows,
    list_members,
    solve_for_nuisance,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Start
from loopcal.estimate.observation_rows import (
    ObservationRows,
    PoseBlock,
    divide_poses,
    find_needed_poses,
)
from loopcal.estimate.pose_linearization import (
    LinearizedPoses,
    PoseSolution,
    PoseStates,
    join_located,
    linearize_closure,
    linearize_poses,
    linearize_rows,
    list_twist_rows,
    locate_poses,
    spread_states,
)
from loopcal.measure.readings import list_sensed_joints
from loopcal.mechanism.actuation import drive_joints
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.sensitivity import fold_pose_rows
from loopcal.numerics.decomposition import empty_factor
from loopcal.numerics.elimination import NodeFactors
from loopcal.numerics.gauss_newton import Halving
from loopcal.numerics.statistics import find_distinct
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray


def have_plain_rows(
    free: FreeParameters, rows: Sequence[ObservationRows], nuisance: NuisanceElimination | None
) -> bool:
    """Return whether the platform's twist by the parameters determines all rows of solved poses, so
    that the engine folds them without writing its derivatives.
    """
    is_simple = all(r.kind.poses_per_row == 1 and not r.kind.sensed_joints for r in rows)
    has_more = nuisance is not None or free.errors is not None
    return is_simple and not (has_more or free.robot.stages or free.robot.has_open_sums)


@dataclass(frozen=True, eq=False)
class ExactPoses:
    """Rows at poses of exact readings.

    Attributes
    ----------
    free : the free parameters. count : n poses. names : joints that kinds look at.
    blocks : of poses. members : of every block and kind, the rows by nodes.
    nuisance : nuisance parameters, if any.
    located : (t | 1, n, 4, 4) [m], optional. With it closure is linearized at these poses and not
        solved, see `loopcal.estimate.fit_descent`.
    """

    free: FreeParameters
    count: int
    names: tuple[str, ...]
    blocks: tuple[PoseBlock, ...]
    members: tuple[tuple[tuple[NodeMembers, ...], ...], ...]
    nuisance: NuisanceElimination | None
    located: FloatArray | None = None

    @property
    def block_size(self) -> int:
        """Poses of the largest block of consecutive poses."""
        return len(self.blocks[0].poses)

    @property
    def is_single_block(self) -> bool:
        """Whether all rows belong to one block, so that poses are kept from start to start."""
        return len(self.blocks) == 1 and self.located is None

    def at_readings(self, q: FloatArray) -> ExactPoses:
        """Return these rows at other readings (a, n, actuators) [SI]."""
        blocks = tuple(replace(block, readings=q[:, block.poses]) for block in self.blocks)
        return replace(self, blocks=blocks)

    def first_states(self, trials: int) -> PoseStates | None:
        """Return the home pose for all trials and poses; None where poses are not kept."""
        if not self.is_single_block:
            return None
        state = spread_states(self.free.robot.home_state, trials, self.count)
        return PoseStates(state, np.zeros((trials, self.count, 0)))

    def next_start(self, solution: PoseSolution, start: Start) -> tuple[PoseStates | None, bool]:
        """Return the states for the next start, and whether they were solved."""
        linearized, states, old = solution.linearized, solution.states, start.poses
        if linearized is None or states is None or old is None:
            return start.poses, start.is_near
        a, ok = len(start), linearized.is_reached

        def kept(new: np.ndarray, before: np.ndarray) -> np.ndarray:
            if ok.all():
                return np.broadcast_to(new, (a, *new.shape[1:]))
            return np.where(ok.reshape(*ok.shape, *[1] * (new.ndim - 2)), new, before)

        is_new = ok.all() and len(ok) == a
        state = states.state if is_new else map_arrays(kept, states.state, old.state)
        return PoseStates(state, old.q), True

    def solve(
        self,
        z: FloatArray,
        trials: IntArray,
        start: Start,
        control: Halving,
        fixed: FloatArray | None = None,
        shared: PoseSolution | None = None,
        derivatives: bool = True,
    ) -> PoseSolution:
        """Solve for the poses, and for the nuisance parameters that fit best there.

        Parameters
        ----------
        z : (a, p) deviations. trials : (a,) numbers of the rows' trials. start : of the a trials.
        fixed : (a, U), optional; nuisance parameters that are not solved for.
        shared : poses that are the same for all trials, where they are known already.
        derivatives : whether poses are linearized, too.
        """
        single = shared
        if single is None and len(self.blocks) == 1:
            if derivatives:
                single = self.solve_single_block(z, trials, start)
            else:
                begin = start.states
                single = PoseSolution(None, self._locate(self.blocks[0], z, begin))
        linearized, states, driven = None, None, None
        if single is not None:
            linearized, states, driven = single.linearized, single.states, single.driven
        nuisance = fixed
        if self.nuisance is not None and fixed is None:
            located = (
                [linearized]
                if linearized is not None
                else [self._locate(b, z) for b in self.blocks]
            )
            nuisance = self._solve_for_nuisance(located, start.predict_nuisance(z), trials, control)
        return PoseSolution(nuisance, linearized, states, driven=driven)

    def solve_single_block(
        self, z: FloatArray, trials: IntArray, start: Start, derivatives: bool = True
    ) -> PoseSolution:
        """Solve the poses of the only block at deviations z (a | 1, p), and linearize them."""
        first = start.take(np.arange(len(z))) if len(z) < len(start) else start
        begin, follow, block, driven = first.states, not first.is_near, self.blocks[0], None
        if derivatives:
            poses, state = self._linearize(block, z, trials, begin, follow)
        else:
            values, q = self.free.values(z), block.readings
            driven = drive_joints(self.free.robot, values, q)
            state = forward_trials(self.free.robot, values, q, begin, follow, driven=driven)
            poses = locate_poses(self.free, q, state, self.names)
        return PoseSolution(None, poses, PoseStates(state, np.zeros(0)), driven=driven)

    def fold_rows(
        self, factor: FloatArray, solution: PoseSolution, z: FloatArray, trials: IntArray
    ) -> tuple[FloatArray, BoolArray]:
        """Fold the rows of all blocks; return also which trials (a,) lack a needed pose.

        For rows that are plain, see `have_plain_rows`.
        """
        robot, is_lost = self.free.robot, np.zeros(len(z), dtype=bool)
        for block in self.blocks:
            if solution.states is not None and solution.linearized is not None:
                state, poses = solution.states.state, solution.linearized
            else:
                state = forward_trials(robot, self.free.values(z), block.readings)
                poses = locate_poses(self.free, block.readings, state, self.names)
            observed = [list_twist_rows(r, poses, trials) for r in block.rows if len(r.poses)]
            values = self.free.values(z[: len(state.T)])  # one trial may stand for all
            inputs = values, block.readings, state, self.free.columns, observed, factor
            factor, is_finite = fold_pose_rows(robot, *inputs, solution.driven)
            is_lost |= np.any(~(poses.is_reached & is_finite) & block.is_needed, axis=1)
        return factor, is_lost

    def iterate_rows(
        self, solution: PoseSolution, z: FloatArray, trials: IntArray
    ) -> Iterator[tuple[list[NodeRows], BoolArray]]:
        """Give, block by block, the rows of the nodes, and which trials (a,) lack a needed pose."""
        tree = None if self.nuisance is None else self.nuisance.tree
        linearized = self.iterate_linearized(solution, z, trials)
        for (block, poses), members in zip(linearized, self.members, strict=True):
            node_rows = []
            for i, (rows, nodes) in enumerate(zip(block.rows, members, strict=True)):
                if len(rows.poses):
                    kind = linearize_rows(rows, poses, trials, solution.nuisance)
                    node_rows += [p._replace(kind=i) for p in divide_among_nodes(kind, nodes, tree)]
            yield node_rows, poses.is_lost(block.is_needed)

    def poses_of(self, block: PoseBlock, part: NodeRows) -> IntArray:
        """Return the first pose of each of the rows of a part."""
        return block.poses[block.rows[part.kind].first_poses[part.numbers]]

    def iterate_poses(
        self, solution: PoseSolution, z: FloatArray
    ) -> Iterator[tuple[PoseBlock, LinearizedPoses]]:
        """Give every block with its solved poses."""
        for block in self.blocks:
            yield block, solution.linearized or self._locate(block, z)

    def iterate_linearized(
        self, solution: PoseSolution, z: FloatArray, trials: IntArray
    ) -> Iterator[tuple[PoseBlock, LinearizedPoses]]:
        """Give every block with its poses, linearized."""
        for block in self.blocks:
            yield block, solution.linearized or self._linearize(block, z, trials, None)[0]

    def find_unreached(self, z: FloatArray, start: Start) -> IntArray:
        """Return the poses that a row needs and that cannot be reached at deviation z (1, p)."""
        del start
        lost = [
            block.poses[~self._locate(block, z).is_reached[0] & block.is_needed]
            for block in self.blocks
        ]
        return find_distinct(np.concatenate(lost))

    def locate(
        self, z: FloatArray, start: Start, solution: PoseSolution | None = None
    ) -> tuple[FloatArray, dict[str, FloatArray]] | None:
        """Return poses (n, 4, 4) and joints name -> (1, n) of one trial; None if one is lost.

        `solution` is one of these readings at z, if there is one.
        """
        if solution is not None and solution.linearized is not None:
            located = [solution.linearized]
        else:
            located = [self._locate(block, z, start.states) for block in self.blocks]
        pairs = zip(self.blocks, located, strict=True)
        if any(poses.is_lost(block.is_needed)[0] for block, poses in pairs):
            return None
        poses_of_blocks = [(poses.T[0], poses) for poses in located]
        return join_located(poses_of_blocks, self.names, np.arange(self.count))

    def _solve_for_nuisance(
        self, located: list[LinearizedPoses], values: FloatArray, trials: IntArray, control: Halving
    ) -> FloatArray:
        """Return the values (a, U) that fit best at the poses of all blocks."""
        assert self.nuisance is not None
        nuisance = self.nuisance.take(trials)

        def fold_at(tried: FloatArray) -> NodeFactors:
            factors = NodeFactors(nuisance.tree, len(trials), 0)
            for block, members, poses in zip(self.blocks, self.members, located, strict=True):
                node_rows = []
                for rows, nodes in zip(block.rows, members, strict=True):
                    if rows.nuisance.shape[1] and len(rows.poses):
                        kind = linearize_rows(rows, poses, trials, tried, by_parameters=False)
                        node_rows += divide_among_nodes(kind, nodes, nuisance.tree)
                within = [part for part in node_rows if part.structure >= 0]
                fold_node_rows(empty_factor(0, 0), factors, within)
            return factors

        return solve_for_nuisance(nuisance, values, fold_at, control)

    def _linearize(
        self,
        block: PoseBlock,
        z: FloatArray,
        trials: IntArray,
        begin: engine.State | None = None,
        follow: bool = True,
    ) -> tuple[LinearizedPoses, engine.State]:
        """Solve and linearize the poses of a block.

        Without `follow`, a pose that Newton's method does not reach from `begin` counts as not
        reached. The states of the last step of the fit have the same readings, and no path to
        follow: where a step is too long for Newton's method, a shorter one is tried.
        """
        values = self.free.values(z)
        if self.located is not None:
            T = self.located if len(self.located) == 1 else self.located[trials]
            T = np.broadcast_to(T, (len(trials), *T.shape[1:]))[:, block.poses]
            poses = linearize_closure(self.free, values, block.readings, T)
            return poses, self.free.robot.home_state
        state = forward_trials(self.free.robot, values, block.readings, begin, follow)
        poses = linearize_poses(self.free, values, block.readings, state, self.names)
        return poses, state

    def _locate(
        self, block: PoseBlock, z: FloatArray, begin: engine.State | None = None
    ) -> LinearizedPoses:
        """Solve the poses of a block without linearizing them."""
        state = forward_trials(self.free.robot, self.free.values(z), block.readings, begin)
        return locate_poses(self.free, block.readings, state, self.names)


# --- Division of the poses of a problem into blocks, with the rows that observed them.


def divide_exact_poses(
    free: FreeParameters,
    readings: FloatArray,
    rows: Sequence[ObservationRows],
    nuisance: NuisanceElimination | None,
    located: FloatArray | None,
    size: int,
) -> ExactPoses:
    """Return the rows at poses of exact readings (n, actuators), in blocks of `size` poses."""
    is_needed = find_needed_poses(rows, len(readings))
    blocks = divide_poses(readings, rows, is_needed, size)
    members = tuple(tuple(list_members(nuisance, own) for own in block.rows) for block in blocks)
    names = list_sensed_joints(r.kind for r in rows)
    return ExactPoses(free, len(readings), names, blocks, members, nuisance, located)
