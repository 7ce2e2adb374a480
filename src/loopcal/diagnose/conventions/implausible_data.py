# SPDX-License-Identifier: Apache-2.0
"""Judge measurements that the robot does not explain in one step of a fit: a few rows far off, a
wrong statement about frames or targets, another interpretation, or none that is tested.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from loopcal.diagnose.conventions.convention_result import IMPLAUSIBLE, ConventionCheck
from loopcal.diagnose.conventions.interpretations.equal_interpretations import report_equals
from loopcal.diagnose.conventions.interpretations.setup_interpretations import SetupInterpretation
from loopcal.diagnose.conventions.judgement import BETTER, list_rms_residuals
from loopcal.diagnose.conventions.misfit import (
    ALLOWED,
    Comparison,
    compare_with_robot,
    exclude_far_rows,
    select_reached,
)
from loopcal.diagnose.conventions.refinement import refine_misfit
from loopcal.diagnose.conventions.selection import (
    GROSS,
    Search,
    Selection,
    search_interpretations,
    shares_poses,
)
from loopcal.diagnose.conventions.setup_parameters import Contradiction, find_contradiction
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure import Measurements
from loopcal.numerics.sorted_values import find_distinct

FEWEST_TO_REFUSE = 8
"""Smallest number of equations beyond those of unknown frames by which data are refused. With
fewer, frames and parameters alone explain nearly anything.
"""

MOST_POSES, RUNS = 120, 4
"""Number of poses of large data sets by which interpretations are judged, and number of runs of
neighbors (rows may be shifted by one) that contain them.
"""


def compare_interpretations(
    free: FreeParameters, thinned: Measurements, has_errors: bool
) -> ConventionCheck:
    """Return the check of data that the robot does not explain in one step.

    `has_errors` : readings that count as exact here have errors, which may explain a misfit.
    """
    reach = select_reached(free, thinned, follow=True)
    stated, against, misfit = None, None, np.inf
    if reach.is_enough:
        whole = compare_with_robot(free, reach.data)
        if not whole.misfit > ALLOWED:
            return ConventionCheck(
                whole.misfit, finding=report_equals(free, reach.data, whole.misfit)
            )
        stated = exclude_far_rows(whole)
        misfit = min(whole.misfit, refine_misfit(stated)[0])
        if not misfit > ALLOWED:
            has_far_rows = whole.misfit > IMPLAUSIBLE and bool(stated.excluded)
            if has_far_rows:
                return ConventionCheck(misfit, finding=_report_far_rows(stated))
            return ConventionCheck(misfit, finding=report_equals(free, reach.data, misfit))
        if misfit > IMPLAUSIBLE:
            against = find_contradiction(stated, misfit, BETTER)
    description = {
        "robot": free.robot.name,
        "misfit": misfit,
        "residuals": () if stated is None else list_rms_residuals(stated),
        "reached": reach.n_reached if stated is None else None,
        "poses": reach.n_tested,
    }
    if against is not None and against.misfit <= ALLOWED:
        return _contradict(misfit, against)
    search = search_interpretations(free, thinned, stated, misfit, misfit > IMPLAUSIBLE)
    equations = _count_equations(stated, search)
    if search.selection is not None and equations >= FEWEST_TO_REFUSE:
        return _refuse(description, misfit, search.selection)
    if against is not None:
        return _contradict(misfit, against)
    if not misfit > IMPLAUSIBLE or has_errors:
        return ConventionCheck(misfit)
    return _report_unexplained(description, misfit, search, equations)


def _report_unexplained(
    description: dict[str, Any], misfit: float, search: Search, equations: int
) -> ConventionCheck:
    """Report data that no tested interpretation explains, or too few rows to decide which."""
    if equations < FEWEST_TO_REFUSE:
        chosen = search.selection
        listed = () if chosen is None else (chosen.interpretation, *chosen.alternatives)
        finding = report_finding(
            "conventions.undecided",
            **description,
            equations=equations,
            needed=FEWEST_TO_REFUSE,
            alternatives=tuple(other.describe() for other in listed),
        )
        return ConventionCheck(misfit, finding=finding)
    finding = report_finding(
        "conventions.unexplained", **description, tried=search.tried, pairs=search.pairs
    )
    return ConventionCheck(misfit, finding=finding)


def _count_equations(stated: Comparison | None, search: Search) -> int:
    """Return the number of equations beyond those of unknown frames: of the data as written or of
    the interpretation, whichever has fewer.
    """
    chosen = None if search.selection is None else search.selection.comparison
    compared = [c.linearization for c in (stated, chosen) if c is not None]
    counts = [int(linear.equations[0]) for linear in compared if linear is not None]
    return min(counts, default=FEWEST_TO_REFUSE)


def thin_out(data: Measurements) -> Measurements:
    """Return at most `MOST_POSES` poses, in runs of neighbors spread over the data; all where rows
    share more than their pose.
    """
    n = data.n_poses
    if n <= MOST_POSES or shares_poses(data):
        return data
    first = np.linspace(0, n - MOST_POSES // RUNS, RUNS).astype(np.intp)
    return data.take(find_distinct(first[:, None] + np.arange(MOST_POSES // RUNS)))


def _refuse(description: dict[str, Any], misfit: float, chosen: Selection) -> ConventionCheck:
    """Refuse data that fit far better in another interpretation; warn where a robot far beyond its
    tolerances looks the same as a setup item that is not declared unknown.
    """
    interpretation, alternatives = chosen.interpretation, chosen.alternatives
    is_setup = isinstance(interpretation, SetupInterpretation)
    finding = report_finding(
        "conventions.other-interpretation",
        Severity.WARNING if is_setup and not misfit > GROSS else Severity.REFUSAL,
        **description,
        interpretation=interpretation.describe(),
        alternatives=tuple(other.describe() for other in alternatives),
        other_misfit=chosen.misfit,
        other_residuals=list_rms_residuals(chosen.comparison),
        is_consistent=chosen.misfit <= ALLOWED,
    )
    return ConventionCheck(misfit, interpretation, chosen.misfit, alternatives, finding)


def _contradict(misfit: float, against: Contradiction) -> ConventionCheck:
    """Report stated setup parameters without which the data fit: refused where they contradict the
    data grossly, else a warning.
    """
    finding = report_finding(
        "conventions.stated-values-contradicted",
        Severity.REFUSAL if misfit > GROSS else Severity.WARNING,
        values=against.values,
        names=against.names,
        misfit=misfit,
        other_misfit=against.misfit,
        residuals=list_rms_residuals(against.comparison),
        is_consistent=against.misfit <= ALLOWED,
    )
    return ConventionCheck(misfit, other_misfit=against.misfit, finding=finding)


def _report_far_rows(stated: Comparison) -> Finding:
    """Report the rows that do not fit the others, which fit; they stay in the data."""
    return report_finding(
        "conventions.rows-far-off",
        count=len(stated.excluded),
        rows=sum(len(o) for o in stated.data.observations),
        poses=tuple(dict.fromkeys(stated.excluded)),
    )
