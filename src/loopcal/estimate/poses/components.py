# SPDX-License-Identifier: Apache-2.0
"""Components: poses whose coordinates are eliminated together, and their stacked rows.

Poses that a row links, directly or through others, form one component. A pose that no row links is
a component of its own. Components are the innermost nodes of the elimination tree. Their rows are
[u | nuisance | machine | residual]: the coordinates u of the component's poses, and the path of the
node of nuisance parameters to which the rows left belong. Components of equal structure are
stacked and eliminated together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.nuisance.elimination import NuisanceElimination, spread_columns
from loopcal.estimate.observation_rows import (
    ObservationRows,
    PoseBlock,
    consecutive_pairs,
    make_block,
)
from loopcal.estimate.poses.linearization import KindRows
from loopcal.findings import report_finding
from loopcal.numerics.elimination_tree import EliminationTree, find_connected_groups
from loopcal.numerics.sorted_values import find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray

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
