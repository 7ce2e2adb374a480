# SPDX-License-Identifier: Apache-2.0
"""Nuisance parameters: frames, targets, surfaces and offsets that measurements bring with them.

At every point of the descent they have the values that fit the rows best at the machine's present
poses, so that the sum of squares is a function of the machine alone (variable projection). The
rows [F | A | r], nuisance columns first, are folded into the factors of an elimination tree, and
what the elimination leaves is the factor of the rows projected onto the complement of F. Rank,
filters and covariance of the machine are read from it as if the frames were known. A tolerance of a
nuisance parameter is one more row. See docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.engine import BlockRows
from loopcal.estimate.linearization import KindRows
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.numerics.elimination import (
    TARGET,
    EliminationTree,
    NodeFactors,
    TreeElimination,
    build_tree,
    eliminate_tree,
    use_path,
)
from loopcal.numerics.statistics import find_distinct, find_distinct_rows
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray


class NodeMembers(NamedTuple):
    """Rows of one kind that belong to nodes of one structure.

    structure : of the nodes, -1 for rows that use no free nuisance parameter.
    rows : (k,) numbers of the rows. nodes : (k,) their nodes.
    columns : (k, u) columns of their nuisance parameters in the node's path; fixed ones have the
        column after the last.
    """

    structure: int
    rows: IntArray
    nodes: IntArray
    columns: IntArray


class NodeRows(NamedTuple):
    """Whitened rows of nodes of one structure.

    structure : -1 for rows of the machine alone. nodes : (k,). numbers : (k,) what each of the k
        sets of rows belongs to: the row of a kind, or the component of poses.
    by_unknowns : (a, k, m, c) at columns (k, c), see `BlockRows`. machine : (a, k, m, p + 1).
    kind : number of the kind; -1 where they are of several.
    """

    structure: int
    nodes: IntArray
    numbers: IntArray
    by_unknowns: FloatArray
    columns: IntArray
    machine: FloatArray
    kind: int = -1

    @classmethod
    def divide(
        cls,
        tree: EliminationTree | None,
        structure: int,
        nodes: IntArray,
        numbers: IntArray,
        rows: FloatArray,
    ) -> NodeRows:
        """Return rows (a, k, m, w + p + 1) of several kinds, with columns of the whole path."""
        w, columns = 0, np.zeros((len(nodes), 0), dtype=np.int64)
        if tree is not None and structure >= 0:
            columns = use_path(tree.structures[structure], len(nodes))
            w = columns.shape[1]
        return cls(structure, nodes, numbers, rows[..., :w], columns, rows[..., w:])


@dataclass(frozen=True, eq=False)
class EliminatedNuisance(TrialBatch):
    """Nuisance parameters of t trials at the point of a linearization.

    values : (t, U) at which the rows are linearized.
    elimination : step to the best values, their change with the machine, and their variances.
    """

    values: FloatArray
    elimination: TreeElimination

    @property
    def best(self) -> FloatArray:
        """(t, U) best values."""
        return self.values + self.elimination.shift


@dataclass(frozen=True, eq=False)
class NuisanceElimination:
    """The U nuisance parameters of a problem and their elimination tree.

    local : their table, and which rows use them. tree : in which order they are eliminated.
    is_free : (U,). has_prior : (U,) free with a spread.
    prior_mean : (T | 1, U) [SI] means of the priors of T trials.
    """

    local: NuisanceParameters
    tree: EliminationTree
    is_free: BoolArray
    has_prior: BoolArray
    prior_mean: FloatArray

    def __len__(self) -> int:
        return len(self.local)

    @property
    def unpenalized_count(self) -> int:
        """Number of free parameters without a prior."""
        return int((self.is_free & ~self.has_prior).sum())

    def take(self, trials: IntArray) -> NuisanceElimination:
        """Return this value with the means of the priors of some trials (a,)."""
        if len(self.prior_mean) == 1:
            return self
        return replace(self, prior_mean=self.prior_mean[trials])

    def keep_apart(
        self, parameters: int, nodes: IntArray
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return paths (k, w) of nodes (k,), with roots and slopes of parameters that are not
        eliminated: 1 and 0. See `TreeElimination.at_nodes`.
        """
        structure = self.tree.structures[int(self.tree.structure[nodes[0]])]
        w = structure.width
        return structure.path[self.tree.place[nodes]], np.eye(w), np.zeros((1, w, parameters))

    def prior_cost(self, values: FloatArray) -> FloatArray:
        """Return the sum of squares (a,) of the priors at values (a, U)."""
        known = self.has_prior
        off = (values - self.prior_mean)[:, known] / self.local.table.tolerance[known]
        return (off**2).sum(axis=1)

    def fold_priors(self, factors: NodeFactors, values: FloatArray) -> None:
        """Fold the priors at values (a, U) into the factors of their nodes."""
        off = values - self.prior_mean
        for i, structure in enumerate(self.tree.structures):
            place, column = np.nonzero(self.has_prior[structure.unknowns])
            if not len(place):
                continue
            unknown = structure.unknowns[place, column]
            tolerance = self.local.table.tolerance[unknown]
            unit = np.broadcast_to(1.0 / tolerance[:, None, None], (len(values), len(place), 1, 1))
            machine = np.zeros((len(values), len(place), 1, factors.parameters + 1))
            machine[:, :, 0, -1] = off[:, unknown] / tolerance
            factors.add(BlockRows(i, place, column[:, None], unit, machine))

    def eliminate(
        self, factors: NodeFactors, values: FloatArray
    ) -> tuple[EliminatedNuisance, FloatArray]:
        """Eliminate all parameters from rows at values (a, U), to which the priors are added.

        Returns
        -------
        estimate : of the nuisance parameters.
        factor : (a, p + 1, p + 1) of the machine's rows that are left.
        """
        self.fold_priors(factors, values)
        elimination, rest = eliminate_tree(factors)
        return EliminatedNuisance(values, elimination), rest


def plan_elimination(
    local: NuisanceParameters, rows: Sequence[ObservationRows], member: IntArray | None = None
) -> NuisanceElimination | None:
    """Return the nuisance parameters of observed rows; None where there are none.

    `member` (n,) is the component of each pose, whose rows are eliminated together.
    """
    if not len(local):
        return None
    used = np.concatenate([r.nuisance.ravel() for r in rows])  # others are fixed
    is_free = np.isin(np.arange(len(local)), used) & local.table.free
    scopes = [p.scope for p in local.table.entries]
    if member is None:  # rows of poses with coordinates are eliminated together
        for i in (i for r in rows for i in r.list_target_parameters().tolist()):
            scopes[i] = TARGET
        rows = [r.divided() for r in rows]
    tree = build_tree(is_free, scopes, _sets(rows, member))
    has_prior = is_free & ~np.isnan(local.table.tolerance)
    return NuisanceElimination(local, tree, is_free, has_prior, local.table.nominal[None])


def list_members(
    nuisance: NuisanceElimination | None, rows: ObservationRows
) -> tuple[NodeMembers, ...]:
    """Return the rows of a kind by the structure of the node that each belongs to.

    All are of the machine where they use no nuisance parameter.
    """
    numbers = np.arange(len(rows.poses))
    if nuisance is None or not rows.nuisance.shape[1]:
        return (NodeMembers(-1, numbers, np.full(len(numbers), -1), rows.nuisance),)
    tree, node = nuisance.tree, nuisance.tree.node[rows.nuisance].max(axis=1)
    structure = np.full(len(node), -1)
    structure[node >= 0] = tree.structure[node[node >= 0]]
    groups = []
    for s in find_distinct(structure):
        chosen = np.flatnonzero(structure == s)
        nodes, used = node[chosen], rows.nuisance[chosen]
        columns = np.zeros_like(used) if s < 0 else tree.columns(nodes, used)
        groups.append(NodeMembers(int(s), chosen, nodes, columns))
    return tuple(groups)


def divide_among_nodes(
    kinds: Sequence[KindRows | None], members: Sequence[tuple[NodeMembers, ...]]
) -> list[NodeRows]:
    """Return the rows of every kind by nodes.

    `members` are those of the kinds; none where the rows do not go to the nodes as they are.
    """
    divided = []
    for i, (kind, of_kind) in enumerate(zip(kinds, members, strict=False)):
        if kind is None:
            continue
        rows = kind.machine
        for structure, numbers, nodes, columns in of_kind:
            is_all = len(numbers) == rows.shape[1]
            chosen, own = rows if is_all else rows[:, numbers], rows[:, numbers, :, :0]
            if structure >= 0 and kind.by_nuisance is not None:
                own = kind.by_nuisance if is_all else kind.by_nuisance[:, numbers]
            used = columns[:, : own.shape[3]]
            divided.append(NodeRows(structure, nodes, numbers, own, used, chosen, i))
    return divided


def fold_node_rows(
    factor: FloatArray, factors: NodeFactors | None, node_rows: Sequence[NodeRows]
) -> FloatArray:
    """Fold rows into the factors of their nodes; return the machine's factor with its own rows."""
    of_machine = (part.machine for part in node_rows if part.structure < 0)
    plain = [rows.reshape(len(rows), -1, rows.shape[-1]) for rows in of_machine]
    if plain:
        factor = engine.fold(factor, plain[0] if len(plain) == 1 else np.concatenate(plain, axis=1))
    if factors is None:
        return factor
    for part in (part for part in node_rows if part.structure >= 0):
        rows = part.columns, part.by_unknowns, part.machine
        factors.add(BlockRows(part.structure, factors.tree.place[part.nodes], *rows))
    return factor


def _sets(rows: Sequence[ObservationRows], member: IntArray | None) -> IntArray:
    """Return pairs (set, unknown): one set for each row and, with `member`, for each component."""
    sets, count = [np.zeros((0, 2), dtype=np.int64)], 0
    using = [r for r in rows if r.nuisance.shape[1]]
    for r in using:
        used, _ = find_distinct_rows(r.nuisance)
        number = np.repeat(count + np.arange(len(used)), used.shape[1])
        sets.append(np.column_stack([number, used.ravel()]))
        count += len(used)
    if member is not None:
        for r in using:
            number = np.repeat(count + member[r.first_poses], r.nuisance.shape[1])
            sets.append(np.column_stack([number, r.nuisance.ravel()]))
    return np.concatenate(sets)
