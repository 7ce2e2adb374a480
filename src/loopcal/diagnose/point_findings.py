# SPDX-License-Identifier: Apache-2.0
"""Findings on measured points that do not lie where their names say.

Each session is examined by itself, since the instrument may have moved between two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.diagnose.point_names import MOVED, PointCheck, check_point_names, find_other_scale
from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, Position
from loopcal.measure.kinds.points.target_kind import name_point
from loopcal.mechanism import Mechanism, forward
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit, list_symbols


def examine_points(robot: Mechanism, data: Measurements, unit: str) -> tuple[Finding, ...]:
    """Return findings on points that are far from where the nominal robot predicts them.

    Rows of other kinds than `position` are not examined.

    Parameters
    ----------
    unit : in which the points were read, for messages.

    Raises
    ------
    DataError
        Points have each other's names, all names are shifted by one pose, another unit explains the
        points, or the instrument has moved.
    """
    findings: list[Finding] = []
    solution = forward(robot, data.readings)
    for rows in data.observations:
        kind = rows.kind
        if not isinstance(kind, Position):
            continue
        for session in np.unique(rows.session):
            chosen = np.flatnonzero((rows.session == session) & solution.converged[rows.rows])
            T, measured = solution.T[rows.rows[chosen]], rows.measured[chosen]
            _refuse_other_unit(robot, kind, T, measured, unit)
            check = check_point_names(kind, T, measured)
            if check is not None:
                labels = [data.labels[i] for i in rows.rows[chosen]]
                findings += _report_point_check(robot, check, labels, kind.targets)
    return tuple(findings)


def _refuse_other_unit(
    robot: Mechanism, kind: Position, T: FloatArray, measured: FloatArray, stated: str
) -> None:
    """Raise DataError where the points fit in another unit of length than the stated one."""
    scale = find_unit(stated, Dimension.LENGTH).factor_to_si
    known = {s: find_unit(s).factor_to_si for s in list_symbols(Dimension.LENGTH)}
    others = {symbol: factor / scale for symbol, factor in known.items() if symbol != stated}
    other = find_other_scale(kind, T, measured, others)
    if other is not None:
        typical, before = (robot.to_quantity(d, Dimension.LENGTH) for d in other[1:])
        finding = report_finding(
            "sheet.points-unit", stated=stated, unit=other[0], typical=typical, before=before
        )
        raise DataError(finding)


def _report_point_check(
    robot: Mechanism, check: PointCheck, labels: Sequence[str], targets: Sequence[str]
) -> list[Finding]:
    """Return what a check says about far points; raise DataError for names and moves."""

    def name(place: tuple[int, int]) -> str:
        return name_point(labels[place[0]], targets[place[1]], targets)

    findings: list[Finding] = []
    if check.moved_before is not None:
        first, last = labels[check.moved_before], labels[check.moved_before - 1]
        if check.move_gain > MOVED:
            raise DataError(report_finding("sheet.instrument-moved", first=first, last=last))
        findings.append(
            report_finding(
                "sheet.instrument-perhaps-moved", first=first, last=last, gain=check.move_gain
            )
        )
    if check.shift:
        typical, before = (
            robot.to_quantity(distance, Dimension.LENGTH)
            for distance in (check.distance, check.distance_as_named)
        )
        facts = {"is_late": check.shift > 0, "typical": typical, "before": before}
        if not check.shifted_from:
            raise DataError(report_finding("sheet.points-shifted", **facts))
        first = labels[check.shifted_from]
        raise DataError(report_finding("sheet.points-shifted-later", first=first, **facts))
    if check.renamed:
        points = tuple({"found": name(a), "place": name(b)} for a, b in check.renamed)
        limit = robot.to_quantity(check.limit, Dimension.LENGTH)
        raise DataError(
            report_finding("sheet.points-misnamed", points=points, count=len(points), limit=limit)
        )
    if not check.far:
        return findings
    far = tuple(
        {"item": name(place), "distance": robot.to_quantity(distance, Dimension.LENGTH)}
        for place, distance in check.far
    )
    typical = robot.to_quantity(check.distance, Dimension.LENGTH)
    return [*findings, report_finding("sheet.points-far", points=far, typical=typical)]
