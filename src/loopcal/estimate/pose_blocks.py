# SPDX-License-Identifier: Apache-2.0
"""Blocks of poses with the rows that observed them, and whose coordinates are eliminated together.

Poses without coordinates are divided into runs of consecutive ones. Rows that link poses of
different runs form blocks of their own, with the poses that they name, so that no block is larger
than it must be. Poses with coordinates are divided into whole components: poses that rows link, so
that their coordinates are eliminated together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.elimination import (
    NodeMembers,
    NuisanceElimination,
    list_members,
    spread_columns,
)
from loopcal.estimate.observation_rows import ObservationRows, consecutive_pairs
from loopcal.estimate.pose_linearization import KindRows
from loopcal.findings import report_finding
from loopcal.numerics.elimination import EliminationTree, find_connected_groups
from loopcal.numerics.statistics import find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray

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


@dataclass(frozen=True, eq=False)
class PoseBlock:
    """Some poses and the rows that observed them.

    Attributes
    ----------
    poses : (b,) numbers of the poses.
    row_numbers : of every kind, (k,). rows : of every kind, poses numbered within the block.
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
        own = _take_rows(rows, poses, chosen, n)
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
        own = _take_rows(rows, poses, chosen, len(member))
        groups = _group_components(own, member[poses], nodes, structures)
        blocks.append(PoseBlock(poses, chosen, own, is_needed[poses], groups=groups))
    return tuple(blocks)


def _take_rows(
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
    member = find_connected_groups(links, n)
    largest = int(np.bincount(member).max())
    if largest * coordinates > LARGEST:
        unknowns = largest * coordinates
        raise EstimationError(
            report_finding(
                "poses.chain-too-long", poses=largest, unknowns=unknowns, allowed=LARGEST
            )
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
    tree: EliminationTree | None,
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
            spread = spread_columns(kind.by_nuisance[:, rows], columns, w)
            out[(*cells, slice(first, first + w))] = spread
        if kind.by_coordinates is None:
            continue
        for i in range(links.shape[1]):
            columns = (links[:, i, None] * k + np.arange(k))[:, None, :]
            where = (slice(None), component[:, None, None], cells[2][:, :, None], columns)
            out[where] = kind.by_coordinates[:, rows, i]
    return out
