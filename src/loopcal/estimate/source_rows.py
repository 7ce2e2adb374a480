# SPDX-License-Identifier: Apache-2.0
"""The rows of a problem by the source of their noise, nuisance parameters and poses eliminated.

Eliminating the coordinates u of a pose mixes the rows that see it. Here every row keeps its place:
with the best coordinates u = -X z of all rows [Y | A], the projected rows of a source are

    A_k - Y_k X

which, stacked over all sources, are A projected onto the complement of the range of Y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal import engine
from loopcal.estimate.elimination import NodeRows, divide_among_nodes
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.pose_blocks import PoseBlock, stack_rows
from loopcal.estimate.pose_linearization import KindRows
from loopcal.estimate.pose_rows import PoseRows
from loopcal.estimate.problem import Problem, spread_rows
from loopcal.numerics.elimination import eliminate_columns
from loopcal.typing import BoolArray, FloatArray, IntArray


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
    for block, linearized in poses.iterate_poses(solution, z):
        kinds = poses.linearize_kinds(block, linearized, problem.trials, fixed)
        for source in range(count):
            own = [
                of[numbers] == source
                for of, numbers in zip(sources, block.row_numbers, strict=True)
            ]
            node_rows = _select_rows(poses, block, kinds, own)
            for part in spread_rows(poses, block, node_rows, p, at_nodes):
                rows = part.rows.reshape(1, -1, wide + p + 1)
                factor[source] = engine.fold(factor[source : source + 1], rows)[0]
    return factor[:, :-1, :-1]


def _select_rows(
    poses: PoseRows, block: PoseBlock, kinds: Sequence[KindRows | None], own: Sequence[BoolArray]
) -> list[NodeRows]:
    """Return the rows of one source, `own` (r,) of every kind, projected along all rows of poses
    that have coordinates.
    """
    tree = None if poses.nuisance is None else poses.nuisance.tree
    chosen = []
    for part in divide_among_nodes(kinds, block.members, tree):
        kept = own[part.kind][part.numbers]
        nodes, numbers, rows = part.nodes[kept], part.numbers[kept], part.rows[:, kept]
        if kept.any():
            chosen.append(part._replace(nodes=nodes, numbers=numbers, rows=rows))
    k = poses.coordinates.count
    masked = [kind and _mask(kind, kept) for kind, kept in zip(kinds, own, strict=True)]
    for group in block.groups:
        all_rows, own_rows = (stack_rows(block, group, rows, k, tree) for rows in (kinds, masked))
        width = group.poses.shape[1] * k
        solved = eliminate_columns(all_rows, width).solution
        left = own_rows[..., width:] - own_rows[..., :width] @ solved
        chosen.append(NodeRows(group.structure, group.nodes, group.components, left))
    return chosen


def _mask(kind: KindRows, kept: BoolArray) -> KindRows:
    """Return the rows of a kind with zeros for those that are not kept."""

    def mask(array: FloatArray) -> FloatArray:
        return array * kept.reshape(-1, *[1] * (array.ndim - 2))

    by_nuisance, by_coordinates = kind.by_nuisance, kind.by_coordinates
    return KindRows(
        mask(kind.machine),
        None if by_nuisance is None else mask(by_nuisance),
        None if by_coordinates is None else mask(by_coordinates),
    )
