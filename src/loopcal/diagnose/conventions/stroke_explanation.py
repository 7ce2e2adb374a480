# SPDX-License-Identifier: Apache-2.0
"""Explain readings outside their strokes by another unit, order, sign or zero."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopcal.diagnose.conventions.convention_check import compare_conventions
from loopcal.diagnose.conventions.judgement import judge_data, list_rms_residuals
from loopcal.diagnose.conventions.selection import ALLOWED
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, describe_outside_strokes
from loopcal.mechanism import Mechanism, fix_breaking_parameters


def explain_outside_strokes(
    robot: Mechanism, data: Measurements, described: Mapping[str, Any] | None = None
) -> Finding | None:
    """Find the interpretation that puts all readings inside their strokes and fits the data.

    Parameters
    ----------
    robot : as given. data : with readings outside their strokes. described : these readings, as of
        `loopcal.measure.describe_outside_strokes`; default: described without places.

    Returns
    -------
    Finding or None
        `conventions.strokes-explained`, or `conventions.strokes-contradicted` if the data fit as
        they are written; None if nothing explains them.
    """
    described = describe_outside_strokes(data, robot) if described is None else described
    if described is None:
        return None
    check = compare_conventions(robot, data)
    if check.misfit <= ALLOWED:
        return report_finding("conventions.strokes-contradicted", **described)
    candidates = () if check.interpretation is None else (check.interpretation, *check.alternatives)
    inside = [
        candidate
        for candidate in candidates
        if describe_outside_strokes(candidate.apply(data), robot) is None
    ]
    if not inside or not check.other_misfit <= ALLOWED:
        return None
    comparison = judge_data(
        select_free_parameters(fix_breaking_parameters(robot)), inside[0].apply(data)
    )
    if comparison is None:
        return None
    return report_finding(
        "conventions.strokes-explained",
        **described,
        interpretation=inside[0].describe(),
        alternatives=tuple(interpretation.describe() for interpretation in inside[1:]),
        other_residuals=list_rms_residuals(comparison),
    )
