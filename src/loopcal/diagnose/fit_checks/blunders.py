# SPDX-License-Identifier: Apache-2.0
"""Name held-out poses that do not fit, and try what explains each of them.

Explanations are tried in this order, and the first kind that fits is stated: targets of one row
interchanged, values interchanged with those of another such pose, values in another unit, one wrong
column, one wrong target. One fits where the pose, read in this way, agrees with the prediction at
the level of the search. Where none fits, the finding says which were tried.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations
from typing import Any

import numpy as np

from loopcal.diagnose.fit_checks.held_out_rows import HeldOutCheck
from loopcal.errors import LoopcalError
from loopcal.findings import Finding, report_finding
from loopcal.measure import Kind, Measurements, Observations
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

MOST_PERMUTED = 4
"""Targets of which all orders are tried; of more only exchanges of two."""

MOST_EXPLAINED = 10
"""Poses for which explanations are tried, the farthest first."""

MOST_EXCHANGED = 50
"""Other poses that do not fit, the farthest first, with which the values of one are exchanged."""

UNUSED: dict[str, Any] = {
    "pairs": (),
    "other": "",
    "dimension": "",
    "factor": 1.0,
    "column": "",
    "left_out": "",
}
"""Data of the finding that only some explanations have."""

FACTORS: dict[Dimension, tuple[float, ...]] = {
    Dimension.LENGTH: (1e3, 1e-3, 10.0, 0.1, 25.4, 1.0 / 25.4),
    Dimension.ANGLE: (180.0 / np.pi, np.pi / 180.0, 1e3, 1e-3, 60.0, 1.0 / 60.0),
}
"""Factors by which values in another unit differ."""


@dataclass(frozen=True)
class Explanation:
    """A way to read a pose in which it fits, or none.

    Attributes
    ----------
    what : "targets", "poses", "unit", "column", "target", or "none". data : its names and numbers.
    tried : what was tried.
    """

    what: str
    data: dict[str, Any] = field(default_factory=dict)
    tried: tuple[str, ...] = ()


@dataclass(frozen=True)
class Blunder:
    """A held-out block that neither the fit nor the other held-out blocks explain.

    Attributes
    ----------
    poses : its labels. times : its residuals in units of what noise and uncertainty explain.
    p_value : probability of a larger distance. explanation : what it may be.
    """

    poses: tuple[str, ...]
    times: float
    p_value: float
    explanation: Explanation

    def report(self, **error: Any) -> Finding:
        """Return the finding, with `quantity`, `target` and `error` of its largest error."""
        explanation = self.explanation
        return report_finding(
            "validation.blunder",
            poses=self.poses,
            times=self.times,
            p_value=self.p_value,
            explanation=explanation.what,
            tried=explanation.tried,
            **{**UNUSED, **explanation.data},
            **error,
        )


def name_blunders(check: HeldOutCheck, data: Measurements) -> tuple[Blunder, ...]:
    """Return the held-out blocks that do not fit, the farthest first, each with its explanation.

    Parameters
    ----------
    check : of these held-out data.
    """
    end, p_value = check.search.end, check.search.end.p_value()
    blunders = []
    for count, i in enumerate(check.suspects.tolist()):
        explanation = Explanation("none")
        if count < MOST_EXPLAINED:
            explanation = _explain(check, data, i)
        times, p = float(np.sqrt(end.ratio[i])), float(p_value[i])
        blunders.append(Blunder(check.blocks.poses[i], times, p, explanation))
    return tuple(blunders)


def _explain(check: HeldOutCheck, data: Measurements, block: int) -> Explanation:
    """Return the first kind of explanation that fits, in the best of its forms."""
    poses = np.flatnonzero(check.blocks.member == block)
    alone = data.take(poses)
    others = [int(i) for i in check.suspects[:MOST_EXCHANGED] if i != block]
    tried = []
    for what, readings in (
        ("targets", _permute_targets(alone)),
        ("poses", _exchange_poses(check, data, poses, others)),
        ("unit", _convert_units(check, alone)),
        ("column", _leave_out_columns(alone)),
        ("target", _leave_out_targets(alone)),
    ):
        best, fitting = 0.0, None
        for words, read in readings:
            tried.append(what)
            p_value = _worst_p_value(check, read)
            if p_value >= check.search.limit and p_value > best:
                best, fitting = p_value, words
        if fitting is not None:
            return Explanation(what, fitting, tuple(dict.fromkeys(tried)))
    return Explanation("none", {}, tuple(dict.fromkeys(tried)))


Reading = tuple[dict[str, Any], Measurements]
"""Names and numbers for the sentence, and the measurements read in another way."""


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
        names = tuple(rows.kind.target_columns)
        columns = [list(places) for places in rows.kind.target_columns.values()]
        k = len(names)
        if k < 2 or not len(rows) or len({len(places) for places in columns}) > 1:
            continue
        for order in _list_orders(k):
            measured = np.array(rows.measured)
            for target, source in enumerate(order):
                measured[:, columns[target]] = rows.measured[:, columns[source]]
            moved = [j for j, source in enumerate(order) if j != source]
            pairs = [{"target": names[j], "holds": names[order[j]]} for j in moved]
            yield {"pairs": pairs}, _with_measured(data, i, measured)


def _list_orders(k: int) -> Iterator[Sequence[int]]:
    """Give the other orders of k targets: all of a few, else exchanges of two."""
    if k <= MOST_PERMUTED:
        yield from (order for order in permutations(range(k)) if list(order) != list(range(k)))
        return
    for a, b in combinations(range(k), 2):
        order = list(range(k))
        order[a], order[b] = b, a
        yield order


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
        for dimension, factors in FACTORS.items():
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


def _leave_out_columns(data: Measurements) -> Iterator[Reading]:
    """Give the data without one column of one row."""
    for i, row, place in _list_rows(data):
        for j, column in enumerate(data.observations[i].kind.columns):
            yield {"column": f"{column.name}{place}"}, _without(data, i, row, (j,))


def _leave_out_targets(data: Measurements) -> Iterator[Reading]:
    """Give the data without one target of one row."""
    for i, row, place in _list_rows(data):
        for name, columns in _list_targets(data.observations[i].kind).items():
            yield {"left_out": f"{name}{place}"}, _without(data, i, row, columns)


def _list_rows(data: Measurements) -> Iterator[tuple[int, int, str]]:
    """Give number of the kind and number of the row of all rows, and words for the row where the
    kind has several.
    """
    for i, rows in enumerate(data.observations):
        for row in range(len(rows)):
            label = "/".join(data.labels[pose] for pose in np.ravel(rows.rows[row]))
            yield i, row, f" of the row {label}" if len(rows) > 1 else ""


def _without(data: Measurements, i: int, row: int, columns: Sequence[int]) -> Measurements:
    """Return measurements without some values of one row of one kind."""
    measured = np.array(data.observations[i].measured)
    measured[row, list(columns)] = np.nan
    return _with_measured(data, i, measured)


def _list_targets(kind: Kind) -> dict[str, tuple[int, ...]]:
    """Return the targets of a kind with several, or the kind as a whole, with their columns."""
    targets = dict(kind.target_columns)
    return targets if len(targets) > 1 else {kind.name: tuple(range(len(kind.columns)))}


def _with_measured(data: Measurements, i: int, measured: FloatArray) -> Measurements:
    """Return measurements with other values of one kind; rows that become invalid are absent."""
    rows = data.observations[i]
    invalid = [row for row, _ in rows.kind.find_invalid_rows(measured)]
    measured = np.array(measured)
    measured[invalid] = np.nan
    changed: Observations = replace(rows, measured=measured)
    observations = (*data.observations[:i], changed, *data.observations[i + 1 :])
    return replace(data, observations=observations)
