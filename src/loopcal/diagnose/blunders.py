# SPDX-License-Identifier: Apache-2.0
"""Name held-out poses that do not fit, and try what explains each of them.

Explanations are tried in this order, and the first kind that fits is stated: targets of one row
interchanged, values interchanged with those of another such pose, values in another unit, one wrong
column, one wrong target. One fits where the pose, read in this way, agrees with the prediction at
the level of the search. Where none fits, the finding says which were tried.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from loopcal import engine
from loopcal.diagnose import outliers
from loopcal.diagnose.conventions import interpretations
from loopcal.errors import LoopcalError
from loopcal.estimate.elimination import NodeRows, fold_node_rows
from loopcal.estimate.fit_descent import estimate_scale_of
from loopcal.estimate.fit_linearization import FitUncertainty
from loopcal.estimate.free_parameters import fix_all
from loopcal.estimate.observation_rows import linked_blocks, list_block_labels
from loopcal.estimate.problem import problem_of
from loopcal.estimate.residual_test import FALSE_ALARMS
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import substitute_backward, substitute_transposed
from loopcal.numerics.elimination import (
    EliminationTree,
    NodeFactors,
    TreeElimination,
    UnknownRoot,
    build_tree,
    eliminate_tree,
    spread_columns,
    use_path,
)
from loopcal.numerics.statistics import compute_chi_square_tail, find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# Probability of naming any block where none is wrong. It is small, because a named block changes
# the verdict.
LEVEL = FALSE_ALARMS["held-out rows"]
# Standard deviation of an unknown nuisance parameter, in sizes of the robot or radians.
ANYWHERE = 1e3


class BlockRows(NamedTuple):
    """Rows of b held-out blocks of equal size in nodes of one structure, -1 without any, by what
    predicts them: independent standard normal variables, those of the nodes' paths first, and the
    residuals last.
    """

    structure: int
    blocks: IntArray  # (b,) their numbers
    nodes: IntArray  # (b,)
    rows: FloatArray  # (b, m, w + k + 1)
    present: BoolArray  # (b, m)


class Prediction(NamedTuple):
    """The best values of these variables, and the factor R (k, k) and best values y (k,) of those
    that predict all blocks, the others eliminated.
    """

    elimination: TreeElimination | None
    triangle: FloatArray
    y: FloatArray


class HeldOutBlocks(NamedTuple):
    """Rows of held-out blocks with what predicts them."""

    poses: tuple[tuple[str, ...], ...]  # labels of each of u blocks
    member: IntArray  # (n,) block of each pose
    groups: tuple[BlockRows, ...]
    tree: EliminationTree  # of the variables that predict blocks of one session
    shared: int  # number k of those that predict all blocks

    def fit_without(self, excluded: BoolArray) -> outliers.PartialFit:
        """Return the prediction by all blocks that are not excluded (u,)."""
        influence = self.compare(self.combine(excluded), ~excluded)
        inside, scale = (influence.degrees > 0) & ~excluded, 1.0
        if inside.any():
            distance, degrees = np.sqrt(influence.distance[inside]), influence.degrees[inside]
            # the lower middle: of two blocks, one may be wrong
            order = np.argsort(distance / np.sqrt(degrees), kind="stable")
            middle = order[[(len(order) - 1) // 2]]
            scale = max(1.0, estimate_scale_of(distance[middle], degrees[middle].astype(float)))
        return outliers.PartialFit(excluded, influence, scale, 0)

    def compare(self, prediction: Prediction, inside: BoolArray) -> outliers.Influence:
        """Return the influence of every block for a prediction by the blocks that are `inside`
        (u,), and of others.
        """
        influence, (done, triangle, y) = outliers.make_empty_influence(len(self.poses)), prediction
        for structure, numbers, nodes, rows, present in self.groups:
            own, half, r = np.split(rows, [rows.shape[2] - self.shared - 1, -1], axis=2)
            if done is not None and structure >= 0:
                path, root, slope = done.at_nodes(nodes)
                half = half + own @ slope
                r = r + own @ done.shift[0, path][..., None]
                own = own @ root
            at_best = r[..., 0] + half @ y
            if half.size:  # one system for all blocks
                stacked = half.reshape(-1, half.shape[2]).T
                half = substitute_transposed(triangle, stacked).T.reshape(half.shape)
            half = np.concatenate([own, half], axis=2)
            weight = inside[numbers].astype(np.float64)
            influence.fill(
                numbers, outliers.compute_block_influence(half, at_best, present, weight)
            )
        return influence

    def combine(self, excluded: BoolArray) -> Prediction:
        """Return the prediction by the blocks that are not excluded."""
        k = self.shared
        factors = NodeFactors(self.tree, 1, k, most=np.inf)  # these rows are in memory
        for i, structure in enumerate(self.tree.structures):  # of variance 1
            n, u = structure.unknowns.shape
            unit, rest = np.eye(u, structure.width), np.zeros((1, n, u, k + 1))
            rows = np.broadcast_to(unit, (1, n, *unit.shape))
            factors.add(engine.BlockRows(i, np.arange(n), use_path(structure, n), rows, rest))
        factor = np.eye(k + 1)[None]
        factor[0, k, k] = 0.0
        for structure, numbers, nodes, rows, _ in self.groups:
            kept = ~excluded[numbers]
            own = nodes[kept], numbers[kept], (rows if kept.all() else rows[kept])[None]
            part = NodeRows.divide(self.tree, structure, *own)
            factor = fold_node_rows(factor, factors, [part] if kept.any() else [])
        done = None
        if self.tree.structures:
            done, rest = eliminate_tree(factors)
            factor = engine.fold(factor, rest)
        R = factor[0, :k, :k]
        return Prediction(done, R, -substitute_backward(R, factor[0, :k, k]))


@dataclass(frozen=True, eq=False)
class HeldOutCheck:
    """The search for held-out blocks that do not fit."""

    predictor: Predictor  # makes the rows of other measurements of the same poses
    blocks: HeldOutBlocks  # those of the data
    search: outliers.BlockSearch  # `suspects` (b,) are the numbers of the blocks that do not fit
    suspects: IntArray

    @cached_property
    def prediction(self) -> Prediction:
        """The prediction by all blocks that do fit."""
        return self.blocks.combine(self.search.end.excluded)

    def p_values(self, data: Measurements) -> FloatArray:
        """Return the probability of a larger distance, of each block (b,) of other values of some
        of these poses: against the prediction by all blocks that do fit.
        """
        other = self.predictor.make_blocks(data, self.blocks.tree)
        outside = np.zeros(len(other.poses), dtype=bool)
        tested = other.compare(self.prediction, outside)
        tail = compute_chi_square_tail(tested.degrees, tested.distance / self.search.end.scale**2)
        has_rows = np.zeros(len(other.poses), dtype=bool)
        for group in other.groups:
            has_rows[group.blocks] = True
        return np.where(has_rows & (tested.degrees < 1), np.nan, tail)


class Predictor(NamedTuple):
    """What predicts held-out rows."""

    robot: Mechanism  # the calibrated one
    values: Mapping[str, float]  # name -> nuisance parameter [SI]
    kept: frozenset[str]  # names of those that the fit knows; the others are unknown
    # of the fit; None where robot and nuisance parameters are taken as exact
    uncertainty: FitUncertainty | None
    unknown: tuple[str, ...]

    def make_blocks(self, data: Measurements, tree: EliminationTree | None = None) -> HeldOutBlocks:
        """Return the rows of measurements with what predicts them, in a tree of the same
        variables; by default in one of their own.
        """
        data = fill_in_reading_sigma(self.robot, data)
        table = data.nuisance_parameters.table
        member = np.unique(linked_blocks(data), return_inverse=True)[1]
        poses = list_block_labels(data.labels, member)
        by_shared = self._predict(table.names)
        variables, root = self._list_own(table.names, table.dimensions)
        parts = []
        for blocks, unknowns, columns, r in self._iterate_blocks(data, member):
            present, c = np.any(columns != 0.0, axis=2) | (r != 0.0), unknowns.shape[1]
            own, machine = columns[..., :c], columns[..., c:]
            used = np.where(unknowns[..., None] >= 0, variables[unknowns], -1)
            moved, to_own = outliers.join_columns(used, root[unknowns])
            shared = own @ by_shared[unknowns] + machine @ by_shared[len(table.names) :]
            right = np.concatenate([shared, r[..., None]], axis=2)
            parts.append((blocks, moved, own @ to_own, right, present))
        if tree is None:
            tree = _build_tree([moved for _, moved, *_ in parts], self._count_own())
        groups = list[BlockRows]()
        while parts:  # so that they are not in memory twice
            groups += _divide(tree, *parts.pop(0))
        return HeldOutBlocks(poses, member, tuple(groups), tree, by_shared.shape[1])

    def _iterate_blocks(
        self, data: Measurements, member: IntArray
    ) -> Iterator[tuple[IntArray, IntArray, FloatArray, FloatArray]]:
        """Yield blocks as `iterate_blocks`, in standard deviations of the noise; `member` (n,) is
        the block of each pose.
        """
        free = fix_all(self.robot) if self.uncertainty is None else self.uncertainty.free
        problem, table = problem_of(free, data), data.nuisance_parameters.table
        z = free.deviation(self.robot.values[None])
        values = np.array([[self.values[name] for name in table.names]]).reshape(1, -1)
        total = problem.poses.count_rows(member, int(member.max(initial=-1)) + 1)
        noise = 1.0 if self.uncertainty is None else self.uncertainty.noise_scale
        rows = problem.rows_at(z, values)
        for blocks, unknowns, columns, r in outliers.iterate_blocks(rows, member, total):
            yield blocks, unknowns, columns / noise, r / noise

    def iterate_rows(
        self, data: Measurements, member: IntArray
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield blocks (b,) of equal size with their derivatives (b, m, U + p + e) by nuisance
        parameters, free parameters and errors of a model discrepancy, and residuals (b, m), in
        standard deviations of the noise; `member` (n,) is the block of each pose.
        """
        U = len(data.nuisance_parameters)
        for blocks, unknowns, columns, r in self._iterate_blocks(data, member):
            moved, machine = np.split(columns, [unknowns.shape[1]], axis=2)
            whole = spread_columns(moved, np.where(unknowns < 0, U, unknowns), U)
            yield blocks, np.concatenate([whole, machine], axis=2), r

    def predict(self, data: Measurements) -> FloatArray:
        """Return the derivative (U + p + m, k) of nuisance parameters of data, free parameters and
        the errors of a model discrepancy by independent standard normal variables.
        """
        table = data.nuisance_parameters.table
        shared = self._predict(table.names)
        variables, root = self._list_own(table.names, table.dimensions)
        own = np.zeros((len(shared), self._count_own() + 1))
        np.put_along_axis(own[: len(table)], variables, root, axis=1)  # -1 is the last
        return np.concatenate([shared, own[:, :-1]], axis=1)

    def _count_own(self) -> int:
        """Return the number of variables that move nuisance parameters at a known machine."""
        fit = self.uncertainty
        return len(self.unknown) + (0 if fit is None else fit.root.total)

    def _predict(self, names: tuple[str, ...]) -> FloatArray:
        """Return the derivative (U + p + m, p + m) of nuisance parameters, free parameters and the
        errors of a model discrepancy by the variables that these have in common.
        """
        fit, U = self.uncertainty, len(names)
        if fit is None:
            return np.zeros((U, 0))
        p, own = len(fit.posterior.unit), fit.posterior.discrepancy
        m = 0 if own is None else own.errors.count
        by_y, spread = np.zeros((U + p + m, p + m)), fit.spread
        by_y[U : U + p, :p] = spread / fit.posterior.unit[:, None]
        if own is not None:  # parameters follow the errors, which predictions lack
            by_y[U : U + p, p:] = own.root / fit.posterior.unit[:, None]
            by_y[U + p :, p:] = -np.eye(m)
        follow, places = fit.slope @ spread, {name: i for i, name in enumerate(fit.names)}
        for i, name in enumerate(names):
            if name in self.kept and name in places:
                by_y[i, :p] = follow[places[name]]
        return by_y

    def _list_own(
        self, names: tuple[str, ...], dimensions: tuple[Dimension, ...]
    ) -> tuple[IntArray, FloatArray]:
        """Return the numbers (U, e) of the other variables that move each nuisance parameter at a
        known machine, -1 for none, and the derivatives (U, e) by these.
        """
        fit, unknown = self.uncertainty, {name: i for i, name in enumerate(self.unknown)}
        root = UnknownRoot.make_empty(len(names))
        if fit is not None:
            places = {name: i for i, name in enumerate(fit.names) if name in self.kept}
            root = fit.root.take(np.array([places.get(n, -1) for n in names], dtype=np.int64))
            unknown = {name: i for name, i in unknown.items() if name not in places}
        units = [self.robot.size if d is Dimension.LENGTH else 1.0 for d in dimensions]
        free = np.array([root.total + unknown[n] if n in unknown else -1 for n in names], dtype=int)
        numbers = np.column_stack([root.columns, free])
        values = np.column_stack([root.values, np.where(free < 0, 0.0, ANYWHERE * np.array(units))])
        used = (values != 0.0).any(axis=0)
        return np.where(values == 0.0, -1, numbers)[:, used], values[:, used]


def _build_tree(moved: Sequence[IntArray], count: int) -> EliminationTree:
    """Return the elimination tree of variables, those (b, n) that blocks have together in a node;
    -1 for none.
    """
    sets, first, is_used = [np.zeros((0, 2), dtype=np.int64)], 0, np.zeros(count, dtype=bool)
    for of_blocks in moved:
        number = first + np.arange(len(of_blocks))[:, None] + np.zeros_like(of_blocks)
        sets.append(np.column_stack([number[of_blocks >= 0], of_blocks[of_blocks >= 0]]))
        is_used[sets[-1][:, 1]] = True
        first += len(of_blocks)
    return build_tree(is_used, ["session"] * count, np.concatenate(sets))


def _divide(
    tree: EliminationTree, blocks: IntArray, moved: IntArray, rows: FloatArray,
    right: FloatArray, present: BoolArray,
) -> list[BlockRows]:  # fmt: skip
    """Return the rows of blocks by the structure of their nodes; arguments as in `make_blocks`."""
    node = np.where(moved >= 0, tree.node[moved], -1).max(axis=1, initial=-1)
    structure = np.where(node >= 0, tree.structure[node], -1) if len(tree.width) else node
    groups = []
    for s in find_distinct(structure).tolist():
        own = structure == s
        spread = rows[own][..., :0]
        if s >= 0:
            width = tree.structures[s].width
            columns = np.where(moved[own] >= 0, tree.columns(node[own], moved[own]), width)
            spread = spread_columns(rows[own], columns, width)
        both = np.concatenate([spread, right[own]], axis=2)
        groups.append(BlockRows(s, blocks[own], node[own], both, present[own]))
    return groups


def check_held_out_rows(
    robot: Mechanism,
    data: Measurements,
    values: Mapping[str, float],
    kept: frozenset[str],
    uncertainty: FitUncertainty | None = None,
) -> HeldOutCheck | None:
    """Search the held-out blocks that neither the fit nor the other blocks explain; None without
    any block that can be tested.

    robot, values, kept, uncertainty : see `Predictor`. data : held-out rows whose poses are
        reached.
    """
    table = data.nuisance_parameters.table
    unknown = tuple(p.name for p in table.entries if p.free and p.name not in kept)
    predictor = Predictor(robot, values, kept, uncertainty, unknown)
    blocks = predictor.make_blocks(data)
    if not blocks.groups:
        return None
    nothing = np.zeros(len(blocks.poses), dtype=bool)
    search = outliers.search_blocks(blocks.fit_without, nothing, LEVEL)
    if search.whole.tested == 1:  # only the fit predicts it
        tested = search.whole.influence.degrees > 0
        alone = blocks.fit_without(tested)
        is_wrong = bool((alone.p_value() < LEVEL).any())
        search = replace(search, fits=(alone if is_wrong else search.whole,))
    always = np.all([fit.excluded for fit in search.fits], axis=0)
    order = np.argsort(-search.end.ratio, kind="stable")
    return HeldOutCheck(predictor, blocks, search, order[always[order]])


MOST_EXPLAINED = 10  # poses for which explanations are tried, the farthest first
# Other poses that do not fit, the farthest first, with which the values of one are exchanged.
MOST_EXCHANGED = 50
# Data of the finding that only some explanations have.
UNUSED: dict[str, Any] = {
    "pairs": (),
    "other": "",
    "dimension": "",
    "factor": 1.0,
    "column": "",
    "left_out": "",
}


@dataclass(frozen=True)
class Explanation:
    """A way to read a pose in which it fits, or none."""

    what: str  # "targets", "poses", "unit", "column", "target", or "none"
    data: dict[str, Any] = field(default_factory=dict)  # its names and numbers
    tried: tuple[str, ...] = ()  # what was tried


@dataclass(frozen=True)
class Blunder:
    """A held-out block that neither the fit nor the other held-out blocks explain."""

    poses: tuple[str, ...]  # its labels
    times: float  # its residuals in units of what noise and uncertainty explain
    p_value: float  # probability of a larger distance
    explanation: Explanation  # what it may be

    def report(self, **error: Any) -> Finding:
        """Return the finding, with `quantity`, `target` and `error` of its largest error."""
        return report_finding(
            "validation.blunder",
            poses=self.poses,
            times=self.times,
            p_value=self.p_value,
            explanation=self.explanation.what,
            tried=self.explanation.tried,
            **(UNUSED | self.explanation.data),
            **error,
        )


def name_blunders(check: HeldOutCheck, data: Measurements) -> tuple[Blunder, ...]:
    """Return the held-out blocks that do not fit, the farthest first, each with its explanation."""
    end, p_value = check.search.end, check.search.end.p_value()
    blunders = []
    for count, i in enumerate(check.suspects.tolist()):
        explanation = _explain(check, data, i) if count < MOST_EXPLAINED else Explanation("none")
        times, p = float(np.sqrt(end.ratio[i])), float(p_value[i])
        blunders.append(Blunder(check.blocks.poses[i], times, p, explanation))
    return tuple(blunders)


def _explain(check: HeldOutCheck, data: Measurements, block: int) -> Explanation:
    """Return the first kind of explanation that fits, in the best of its forms."""
    poses = np.flatnonzero(check.blocks.member == block)
    alone = data.take(poses)
    others = [int(i) for i in check.suspects[:MOST_EXCHANGED] if i != block]
    tried: dict[str, None] = {}
    for what, readings in (
        ("targets", _permute_targets(alone)),
        ("poses", _exchange_poses(check, data, poses, others)),
        ("unit", _convert_units(check, alone)),
        ("column", _leave_out(alone, "column")),
        ("target", _leave_out(alone, "left_out")),
    ):
        best, fitting = 0.0, None
        for words, read in readings:
            tried[what] = None
            p_value = _worst_p_value(check, read)
            if p_value >= check.search.limit and p_value > best:
                best, fitting = p_value, words
        if fitting is not None:
            return Explanation(what, fitting, tuple(tried))
    return Explanation("none", {}, tuple(tried))


# Names and numbers for the sentence, and the measurements read in another way.
Reading = tuple[dict[str, Any], Measurements]


def _worst_p_value(check: HeldOutCheck, data: Measurements) -> float:
    """Return the smallest p-value of the blocks; 0 where nothing is left to test."""
    try:
        p_values = check.p_values(data)
    except LoopcalError:
        return 0.0
    return float(np.nan_to_num(p_values, nan=0.0).min(initial=1.0))


def _permute_targets(data: Measurements) -> Iterator[Reading]:
    """Give the data with the targets of one kind in another order."""
    for i, rows in enumerate(data.observations):
        names, columns = list(rows.kind.target_columns), list(rows.kind.target_columns.values())
        if len(names) < 2 or not len(rows) or len({len(places) for places in columns}) > 1:
            continue
        for order in interpretations.list_orders(len(names)):
            sources = [column for source in order for column in columns[source]]
            change = interpretations.permute_columns(
                [column for places in columns for column in places], sources
            )
            moved = [j for j, source in enumerate(order) if j != source]
            pairs = [{"target": names[j], "holds": names[order[j]]} for j in moved]
            yield {"pairs": pairs}, _with_measured(data, i, change(rows.measured))


def _exchange_poses(
    check: HeldOutCheck, data: Measurements, poses: IntArray, others: Sequence[int]
) -> Iterator[Reading]:
    """Give the values of a pose exchanged with those of another pose that does not fit."""
    for other in others if len(poses) == 1 else ():
        places = np.flatnonzero(check.blocks.member == other)
        if len(places) != 1:
            continue
        both = data.take(np.array([poses[0], places[0]]))
        exchanged = both
        for i, rows in enumerate(both.observations):
            if rows.kind.poses_per_row > 1:
                continue
            first, second = (np.flatnonzero(rows.rows == j) for j in (0, 1))
            if len(first) != len(second):
                break
            measured = np.array(rows.measured)
            measured[first], measured[second] = rows.measured[second], rows.measured[first]
            exchanged = _with_measured(exchanged, i, measured)
        else:
            yield {"other": data.labels[int(places[0])]}, exchanged


def _convert_units(check: HeldOutCheck, data: Measurements) -> Iterator[Reading]:
    """Give the data with the lengths or the angles of one kind in another unit.

    Where zeros fit as well, the expected values are within the noise and say nothing of a unit.
    """
    for i, rows in enumerate(data.observations):
        for dimension, factors in interpretations.FACTORS.items():
            columns = [c.dimension is dimension for c in rows.kind.columns]
            if not any(columns) or not len(rows):
                continue
            scaled = {
                factor: _with_measured(
                    data, i, np.where(columns, rows.measured * factor, rows.measured)
                )
                for factor in (0.0, *factors)
            }
            if _worst_p_value(check, scaled.pop(0.0)) >= check.search.limit:
                continue
            for factor, read in scaled.items():
                yield {"dimension": dimension.value, "factor": factor}, read


def _leave_out(data: Measurements, what: str) -> Iterator[Reading]:
    """Give the data without one "column" of one row, or without one target ("left_out") of it."""
    for i, rows in enumerate(data.observations):
        kind = rows.kind
        groups: list[tuple[str, Sequence[int]]] = list(kind.target_columns.items())
        if what == "column":
            groups = [(column.name, (j,)) for j, column in enumerate(kind.columns)]
        elif len(groups) < 2:
            groups = [(kind.name, range(len(kind.columns)))]
        for row in range(len(rows)):
            label = "/".join(data.labels[pose] for pose in np.ravel(rows.rows[row]))
            place = f" of the row {label}" if len(rows) > 1 else ""
            for name, columns in groups:
                measured = np.array(rows.measured)
                measured[row, list(columns)] = np.nan
                yield {what: f"{name}{place}"}, _with_measured(data, i, measured)


def _with_measured(data: Measurements, i: int, measured: FloatArray) -> Measurements:
    """Return measurements with other values of one kind; rows that become invalid are absent."""
    measured = np.array(measured)
    kind = data.observations[i].kind
    measured[[row for row, _ in kind.find_invalid_rows(measured)]] = np.nan
    return interpretations.with_measured(data, i, measured)
