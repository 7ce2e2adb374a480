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
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from loopcal import geometry
from loopcal.errors import EstimationError
from loopcal.estimate.elimination import (
    NodeRows,
    NuisanceElimination,
    fold_node_rows,
    spread_columns,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Start
from loopcal.estimate.observation_rows import (
    ObservationRows,
    PoseBlock,
    consecutive_pairs,
    find_needed_poses,
    make_block,
)
from loopcal.estimate.pose_linearization import (
    KindRows,
    LinearizedPoses,
    PoseEstimates,
    PoseSolution,
    PoseStates,
    join_located,
    linearize_poses,
    linearize_rows,
    mask_unreached,
    scale_parameters,
)
from loopcal.findings import report_finding
from loopcal.measure.readings import list_sensed_joints
from loopcal.mechanism.actuation import differentiate_at_pose, solve_at_pose
from loopcal.mechanism.assembly import Actuator
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import NULL_COMPONENT, empty_factor
from loopcal.numerics.elimination import (
    Elimination,
    EliminationTree,
    NodeFactors,
    eliminate_columns,
    eliminate_tree,
    find_connected_groups,
)
from loopcal.numerics.gauss_newton import Halving, minimize_by_halving
from loopcal.numerics.statistics import find_distinct
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# --- Components: poses whose coordinates are eliminated together, and their stacked rows.

LARGEST = 2000
"""Coordinates of one component, at most: its rows are one dense matrix."""


@dataclass(frozen=True, eq=False)
class ComponentGroup:
    """Components of equal structure within a block: C of them, of L poses each.

    Attributes
    ----------
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


def find_components(n: int, rows: Sequence[ObservationRows], freedoms: int) -> IntArray:
    """Return the component (n,) of each pose, numbered by first poses.

    Raises
    ------
    EstimationError
        A component has more than `LARGEST` coordinates.
    """
    pairs = [consecutive_pairs(r.poses) for r in rows if r.poses.ndim > 1]
    links = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
    member = find_connected_groups(links, n)
    largest = int(np.bincount(member).max())
    if largest * freedoms > LARGEST:
        raise EstimationError(
            report_finding(
                "poses.chain-too-long", poses=largest, unknowns=largest * freedoms, allowed=LARGEST
            )
        )
    return member


def divide_components(
    readings: FloatArray,
    rows: Sequence[ObservationRows],
    member: IntArray,
    is_needed: BoolArray,
    size: int,
) -> tuple[PoseBlock, ...]:
    """Divide poses into blocks of whole components, of about `size` poses each."""
    counts = np.bincount(member)
    block = ((np.cumsum(counts) - counts) // size)[member]
    blocks = []
    for k in find_distinct(block):
        chosen = tuple(np.flatnonzero(block[r.first_poses] == k) for r in rows)
        poses = np.flatnonzero(block == k)
        blocks.append(make_block(poses, readings, rows, chosen, is_needed))
    return tuple(blocks)


def group_components(
    block: PoseBlock, member: IntArray, nodes: IntArray, structures: IntArray
) -> tuple[ComponentGroup, ...]:
    """Group a block's components by number of poses, structure and, roughly, number of rows.

    `nodes` and `structures` are those of all components, -1 without nuisance parameters.
    """
    component_of_pose = member[block.poses]
    numbers, local, lengths = np.unique(component_of_pose, return_inverse=True, return_counts=True)
    heights, starts = np.zeros(len(numbers), dtype=np.int64), []
    for r in block.rows:
        m, component = r.whitener.shape[-1], local[r.first_poses]
        order = np.argsort(component, kind="stable")
        within = np.zeros(len(component), dtype=np.int64)
        sorted_ = component[order]
        within[order] = np.arange(len(component)) - np.searchsorted(sorted_, sorted_)
        starts.append(heights[component] + m * within)
        heights += m * np.bincount(component, minlength=len(numbers))
    place = np.zeros(len(block.poses), dtype=np.int64)
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
        for r, start in zip(block.rows, starts, strict=True):
            rows = np.flatnonzero(number[local[r.first_poses]] >= 0)
            component = number[local[r.first_poses[rows]]]
            rows_of_kinds.append((rows, component, start[rows], place[r.poses_by_link[rows]]))
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
    group: ComponentGroup, kinds: Sequence[KindRows | None], freedoms: int, width: int
) -> FloatArray:
    """Stack the rows of a group's components, [u | nuisance | machine | residual].

    Parameters
    ----------
    kinds : rows of every kind, None without any; nuisance columns are those of the node's path.
    freedoms : k of a pose. width : number w of nuisance columns.

    Returns
    -------
    rows : (a, C, height, L k + w + p + 1).
    """
    present = next(kind for kind in kinds if kind is not None)
    a, p, k = len(present.residual), present.by_parameters.shape[-1], freedoms
    n_coordinates = group.poses.shape[1] * k
    out = np.zeros(
        (a, len(group.components), max(group.height, n_coordinates), n_coordinates + width + p + 1)
    )
    for kind, (rows, component, start, links) in zip(kinds, group.rows, strict=True):
        if kind is None or not len(rows):
            continue
        m = kind.residual.shape[-1]
        cells = (slice(None), component[:, None], start[:, None] + np.arange(m))
        out[(*cells, -1)] = kind.residual[:, rows]
        if p:
            out[(*cells, slice(n_coordinates + width, -1))] = kind.by_parameters[:, rows]
        if width and kind.by_nuisance is not None:
            out[(*cells, slice(n_coordinates, n_coordinates + width))] = kind.by_nuisance[:, rows]
        if kind.by_coordinates is None:
            continue
        for i in range(links.shape[1]):
            columns = (links[:, i, None] * k + np.arange(k))[:, None, :]
            where = (slice(None), component[:, None, None], cells[2][:, :, None], columns)
            out[where] = kind.by_coordinates[:, rows, i]
    return out


def spread_nuisance(
    tree: EliminationTree, kinds: Sequence[KindRows | None], block: PoseBlock, group: ComponentGroup
) -> list[KindRows | None]:
    """Return the rows with nuisance columns at those of the paths of the group's components."""
    width = tree.structures[group.structure].width
    spread: list[KindRows | None] = []
    for kind, observed, (rows, of, _, _) in zip(kinds, block.rows, group.rows, strict=True):
        if kind is None or kind.by_nuisance is None:
            spread.append(kind)
            continue
        columns = np.full(observed.nuisance.shape, width)
        columns[rows] = tree.columns(group.nodes[of], observed.nuisance[rows])
        spread.append(kind._replace(by_nuisance=spread_columns(kind.by_nuisance, columns, width)))
    return spread


def groups_of_nodes(
    rows: Sequence[ObservationRows], member: IntArray, nuisance: NuisanceElimination | None
) -> tuple[IntArray, IntArray]:
    """Return the innermost node of nuisance parameters of each component, and its structure.

    Both are -1 for components whose rows use none.
    """
    count = int(member.max()) + 1
    nodes, structures = np.full(count, -1), np.full(count, -1)
    if nuisance is not None:
        for r in (r for r in rows if r.nuisance.shape[1]):
            innermost = nuisance.tree.node[r.nuisance].max(axis=1)
            np.maximum.at(nodes, member[r.first_poses], innermost)
        structures[nodes >= 0] = nuisance.tree.structure[nodes[nodes >= 0]]
    return nodes, structures


# --- Coordinates in which a pose of uncertain readings moves while the loops stay closed.

LONGEST_STEP = 0.25
"""Longest step of a reading, as a share of its stroke, or of a pose, as a share of the robot's
size. Beyond it closure is not linear."""


class PoseCoordinates(Protocol):
    """How coordinates u move poses that satisfy closure."""

    freedoms: int

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which coordinates (n, k) of some poses may move."""
        ...

    def close(self, values: FloatArray, poses: PoseStates, follow: bool) -> PoseStates:
        """Solve closure at parameter values (a, p), keeping what u moves.

        `follow` tells whether a pose that Newton does not solve is followed along a path.
        """
        ...

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the largest share (a, n), at most 1, of steps u (a, n, k) that is about linear."""
        ...

    def move(self, poses: PoseStates, u: FloatArray) -> PoseStates:
        """Move all poses by u (a, n, k), without solving closure."""
        ...

    def linearize(
        self, values: FloatArray, poses: PoseStates, numbers: IntArray
    ) -> LinearizedPoses:
        """Linearize closed poses, whose numbers are (n,), by parameters and coordinates."""
        ...


class ReadingCoordinates:
    """As many actuators as freedoms: u moves the readings, in units of their sigma.

    Parameters
    ----------
    free : the free parameters. scale : (n, actuators) [SI]. names : joints that kinds look at.
    """

    free: FreeParameters
    scale: FloatArray
    names: tuple[str, ...]
    freedoms: int
    longest: FloatArray

    def __init__(self, free: FreeParameters, scale: FloatArray, names: tuple[str, ...]) -> None:
        self.free, self.scale, self.names = free, scale, names
        self.freedoms = scale.shape[1]
        strokes = [stroke_of(free.robot, a) for a in free.robot.actuators]
        self.longest = LONGEST_STEP * np.array(strokes)

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which readings (n, actuators) are not exact."""
        return self.scale[poses] > 0.0

    def close(self, values: FloatArray, poses: PoseStates, follow: bool) -> PoseStates:
        """Solve the forward kinematics."""
        state = forward_trials(self.free.robot, values, poses.q, poses.state, follow)
        return PoseStates(state, poses.q)

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the share by which no reading moves more than `LONGEST_STEP` of its stroke."""
        return _largest_share(u * self.scale, self.longest)

    def move(self, poses: PoseStates, u: FloatArray) -> PoseStates:
        """Move the readings."""
        return replace(poses, q=poses.q + self.scale * u)

    def linearize(
        self, values: FloatArray, poses: PoseStates, numbers: IntArray
    ) -> LinearizedPoses:
        """Linearize by the implicit function theorem."""
        scale = self.scale[numbers]
        return linearize_poses(self.free, values, poses.q, poses.state, self.names, scale)


class TwistCoordinates:
    """More actuators than freedoms: u moves the platform in its freedoms, turns in units of 1 m
    over the robot's size.

    Raises
    ------
    EstimationError
        An actuator drives several limbs, so that the pose does not determine its reading.
    """

    free: FreeParameters
    names: tuple[str, ...]
    places: list[int]
    freedoms: int
    scale: FloatArray
    longest: FloatArray

    def __init__(self, free: FreeParameters, names: tuple[str, ...]) -> None:
        robot = free.robot
        drives = np.concatenate([g.actuator[g.actuator >= 0] for g in robot.program.groups])
        if len(drives) != len(robot.actuators):
            raise EstimationError(report_finding("poses.shared-actuators", robot=robot.name))
        self.free, self.names = free, names
        self.places = list(robot.program.freedoms)
        self.freedoms = len(self.places)
        self.scale = np.array([1.0 / robot.size] * 3 + [1.0] * 3)[self.places]
        self.longest = LONGEST_STEP * np.array([1.0] * 3 + [robot.size] * 3)[self.places]

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return (n, m): all coordinates move."""
        return np.ones((len(poses), self.freedoms), dtype=bool)

    def close(self, values: FloatArray, poses: PoseStates, follow: bool) -> PoseStates:
        """Solve the inverse kinematics of every limb."""
        del follow
        return PoseStates(*solve_at_pose(self.free.robot, values, poses.state.T, poses.state))

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the share by which no shift exceeds `LONGEST_STEP` of the robot's size, and no
        turn as many radians.
        """
        return _largest_share(u * self.scale, self.longest)

    def move(self, poses: PoseStates, u: FloatArray) -> PoseStates:
        """Move the poses."""
        twist = np.zeros((*u.shape[:2], 6))
        twist[..., self.places] = u * self.scale
        T = geometry.apply_twist(poses.state.T, twist)
        return replace(poses, state=replace(poses.state, T=T))

    def linearize(
        self, values: FloatArray, poses: PoseStates, numbers: IntArray
    ) -> LinearizedPoses:
        """Linearize: the pose depends on u alone, readings and passive joints on u and z."""
        robot, shape = self.free.robot, poses.q.shape[:2]
        Y = np.zeros((*shape, 6, self.freedoms))
        Y[..., self.places, range(self.freedoms)] = self.scale
        moves = differentiate_at_pose(robot, values, poses.q, poses.state)
        slopes, turns = {}, {}
        joints = (
            ([a.name for a in robot.actuators], moves.readings),
            (list(moves.names), moves.passive),
        )
        for names, (by_parameter, by_freedom) in joints:
            for i, name in enumerate(names):
                if name in self.names:
                    slopes[name] = scale_parameters(self.free, by_parameter[:, :, i])
                    turns[name] = by_freedom[:, :, i] * self.scale
        unmasked = LinearizedPoses(
            poses.state.T,
            np.zeros(0, dtype=bool),
            np.zeros((*shape, 6, len(self.free.places))),
            joints_by_parameters=slopes,
            by_coordinates=Y,
            joints_by_coordinates=turns,
        )
        return mask_unreached(self.free, self.names, poses.q, poses.state, unmasked)


def stroke_of(robot: Mechanism, actuator: Actuator) -> float:
    """Return the stroke of an actuator [m or rad]; without one the robot's size, or a radian."""
    if actuator.stroke is None:
        return robot.size if actuator.dimension is Dimension.LENGTH else 1.0
    return actuator.stroke[1] - actuator.stroke[0]


def _largest_share(step: FloatArray, longest: FloatArray) -> FloatArray:
    """Return the share (a, n) of steps (a, n, k) that leaves each number within `longest` (k,)."""
    return 1.0 / np.maximum(np.abs(step) / longest, 1.0).max(axis=2, initial=1.0)


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


# --- Division of poses of uncertain readings into blocks of components, with their rows.


def divide_uncertain_poses(
    free: FreeParameters,
    readings: FloatArray,
    rows: Sequence[ObservationRows],
    nuisance: NuisanceElimination | None,
    coordinates: PoseCoordinates,
    member: IntArray,
    size: int,
) -> UncertainPoses:
    """Return the rows at poses of uncertain readings, in blocks of components.

    member : (n,) component of each pose. size : of a block, in poses.
    """
    redundant = isinstance(coordinates, TwistCoordinates)
    is_needed = find_needed_poses(rows if redundant else rows[:-1], len(member))
    blocks = divide_components(readings, rows, member, is_needed, size)
    nodes, structures = groups_of_nodes(rows, member, nuisance)
    groups = tuple(group_components(block, member, nodes, structures) for block in blocks)
    names = list_sensed_joints(r.kind for r in rows)
    return UncertainPoses(free, names, coordinates, member, blocks, groups, nuisance, is_needed)
