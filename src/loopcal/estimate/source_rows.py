# SPDX-License-Identifier: Apache-2.0
"""The rows of a problem by the source of their noise, nuisance parameters and poses eliminated.

Eliminating the coordinates u of a pose mixes the rows that see it. Here every row keeps its place:
with the best coordinates u = -X z of all rows [Y | A], the projected rows of a source are

    A_k - Y_k X

which, stacked over all sources, are A projected onto the complement of the range of Y.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from loopcal import engine
from loopcal.estimate.elimination import NodeRows
from loopcal.estimate.exact_poses import ExactPoses
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.observation_rows import PoseBlock
from loopcal.estimate.pose_linearization import KindRows, PoseSolution, linearize_rows
from loopcal.estimate.problem import Problem, spread_rows
from loopcal.numerics.elimination import eliminate_columns
from loopcal.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.estimate.uncertain_poses import ComponentGroup, UncertainPoses


def fold_sources(
    problem: Problem, linearization: Linearization, sources: Sequence[IntArray], count: int
) -> FloatArray:
    """Return triangular factors (count, U + p, U + p) of the rows of each source.

    The first U columns are in units of the standard deviations of the nuisance parameters, those of
    the machine follow them; see `LeverageRows`.

    Parameters
    ----------
    problem : of one machine. linearization : of it. sources : of every kind, (r,) number of the
        source of each row.
    """
    z, p = linearization.deviation, problem.parameters
    estimate, poses = linearization.nuisance, problem.poses
    fixed = None if estimate is None else estimate.values
    at_nodes = None if estimate is None else estimate.elimination.at_nodes
    solution = poses.solve(z, problem.trials, linearization.next_start, problem.control, fixed)
    wide = 0 if problem.nuisance is None else len(problem.nuisance)
    factor = np.zeros((count, wide + p + 1, wide + p + 1))
    for source in range(count):
        if isinstance(poses, ExactPoses):
            blocks = _select_rows(poses, solution, z, problem.trials, sources, source)
        else:
            blocks = _project_rows(poses, solution, z, problem.trials, sources, source)
        for of_block in spread_rows(poses, blocks, p, problem.nuisance, at_nodes):
            for part in of_block:
                rows = part.rows.reshape(1, -1, wide + p + 1)
                factor[source] = engine.fold(factor[source : source + 1], rows)[0]
    return factor[:, :-1, :-1]


def _select_rows(
    poses: ExactPoses,
    solution: PoseSolution,
    z: FloatArray,
    trials: IntArray,
    sources: Sequence[IntArray],
    source: int,
) -> Iterator[tuple[list[NodeRows], BoolArray]]:
    """Give, block by block, the rows of a source at poses of exact readings."""
    for block, (node_rows, lost) in zip(
        poses.blocks, poses.iterate_rows(solution, z, trials), strict=True
    ):
        chosen = []
        for part in node_rows:
            kept = sources[part.kind][block.row_numbers[part.kind][part.numbers]] == source
            nodes, numbers, rows = part.nodes[kept], part.numbers[kept], part.rows[:, kept]
            if kept.any():
                chosen.append(part._replace(nodes=nodes, numbers=numbers, rows=rows))
        yield chosen, lost


def _project_rows(
    poses: UncertainPoses,
    solution: PoseSolution,
    z: FloatArray,
    trials: IntArray,
    sources: Sequence[IntArray],
    source: int,
) -> Iterator[tuple[list[NodeRows], BoolArray]]:
    """Give, block by block, the rows of a source, projected along all rows of uncertain poses."""
    for (block, linearized), groups in zip(
        poses.iterate_poses(solution, z), poses.groups, strict=True
    ):
        kinds = [
            linearize_rows(rows, linearized, trials, solution.nuisance) if len(rows.poses) else None
            for rows in block.rows
        ]
        own = [
            None if kind is None else _mask(kind, of[numbers] == source)
            for kind, of, numbers in zip(kinds, sources, block.row_numbers, strict=True)
        ]
        node_rows = []
        for group in groups:
            all_rows, own_rows = (_stack(poses, block, group, k) for k in (kinds, own))
            width = group.poses.shape[1] * poses.coordinates.freedoms
            solved = eliminate_columns(all_rows, width).solution
            rows = own_rows[..., width:] - own_rows[..., :width] @ solved
            node_rows.append(NodeRows(group.structure, group.nodes, group.components, rows))
        yield node_rows, linearized.is_lost(block.is_needed)


def _stack(
    poses: UncertainPoses, block: PoseBlock, group: ComponentGroup, kinds: Sequence[KindRows | None]
) -> FloatArray:
    """Return the stacked rows of a group's components."""
    from loopcal.estimate.uncertain_poses import spread_nuisance, stack_rows

    width = 0
    if poses.nuisance is not None and group.structure >= 0:
        tree = poses.nuisance.tree
        width = tree.structures[group.structure].width
        kinds = spread_nuisance(tree, kinds, block, group)
    return stack_rows(group, kinds, poses.coordinates.freedoms, width)


def _mask(kind: KindRows, kept: BoolArray) -> KindRows:
    """Return the rows of a kind with zeros for those that are not kept."""

    def mask(array: FloatArray) -> FloatArray:
        return array * kept.reshape(-1, *[1] * (array.ndim - 2))

    return KindRows(
        mask(kind.machine),
        None if kind.by_nuisance is None else mask(kind.by_nuisance),
        None if kind.by_coordinates is None else mask(kind.by_coordinates),
    )
