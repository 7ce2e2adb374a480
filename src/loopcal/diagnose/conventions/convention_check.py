# SPDX-License-Identifier: Apache-2.0
"""Check the stated conventions of measurements against the robot, before anything is fitted.

With the robot as given, unknown frames estimated and its parameters free within their tolerances,
whitened rows cost

    C = min_z |r + A z|^2 + |z|^2,    A = W G D diag(tolerance)

which has a chi-square distribution with as many degrees of freedom as rows where tolerances and
noise are true. The misfit sqrt(C / rows) is then 1, and at most k where all deviations are k
tolerances large. A wrong unit, order, sign or column gives tens to millions. Only then are other
interpretations of the data tested (`loopcal.diagnose.conventions.interpretations`), and the data
are refused only where one of them fits far better: see docs/theory/convention-check.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.diagnose.conventions.equal_interpretations import (
    compute_opposite_misfit,
    find_equal_orders,
)
from loopcal.diagnose.conventions.interpretations import Interpretation
from loopcal.diagnose.conventions.judgement import BETTER, list_rms_residuals
from loopcal.diagnose.conventions.misfit import (
    Comparison,
    compare_with_robot,
    compute_fitted_misfit,
    compute_quick_misfit,
    exclude_far_rows,
    is_redundant,
    select_reached,
)
from loopcal.diagnose.conventions.refinement import refine_misfit
from loopcal.diagnose.conventions.selection import (
    ALLOWED,
    EQUALLY,
    GROSS,
    Search,
    Selection,
    search_interpretations,
    shares_poses,
)
from loopcal.diagnose.conventions.setup_interpretations import SetupInterpretation
from loopcal.diagnose.conventions.setup_parameters import Contradiction, find_contradiction
from loopcal.errors import DataError
from loopcal.estimate.fit_input import check_types
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.findings import Finding, Severity, report_finding
from loopcal.findings.wording import round_to_digits
from loopcal.measure import Measurements, check_actuators, check_targets_move, has_static_targets
from loopcal.mechanism import Mechanism, fix_breaking_parameters, forward
from loopcal.numerics.sorted_values import find_distinct
from loopcal.presentation import HtmlResult

IMPLAUSIBLE = 10.0
"""Misfit above which conventions are in doubt. Tolerances exceeded three times, and a noise stated
three times too small, give about 3 each.
"""

FEWEST_TO_REFUSE = 8
"""Smallest number of equations beyond those of unknown frames by which data are refused. With
fewer, frames and parameters alone explain nearly anything.
"""

MOST_POSES, RUNS = 120, 4
"""Number of poses of large data sets by which interpretations are judged, and number of runs of
neighbors (rows may be shifted by one) that contain them.
"""


@dataclass(frozen=True, eq=False)
class ConventionCheck(HtmlResult):
    """The stated conventions of measurements against the robot, and the best other interpretation.

    Attributes
    ----------
    misfit : root mean square of the residuals over what tolerances and noise allow [1]; NaN with
        too few rows.
    interpretation : another one that fits far better; None without one.
    other_misfit : its misfit, or that without stated setup parameters which the data contradict;
        NaN without either.
    alternatives : other interpretations that fit as well.
    finding : the result; None where the data agree with the stated conventions.
    """

    misfit: float
    interpretation: Interpretation | None = None
    other_misfit: float = float("nan")
    alternatives: tuple[Interpretation, ...] = ()
    finding: Finding | None = None

    @property
    def is_doubtful(self) -> bool:
        """Whether tolerances and noise do not explain the data as they are stated."""
        return self.misfit > IMPLAUSIBLE

    @property
    def is_refused(self) -> bool:
        """Whether there is clear evidence that the stated conventions are wrong."""
        return self.finding is not None and self.finding.severity is Severity.REFUSAL

    def __repr__(self) -> str:
        code = "agrees" if self.finding is None else self.finding.code
        return f"<ConventionCheck: {code}, misfit {round_to_digits(self.misfit)}>"

    def __str__(self) -> str:
        return repr(self) if self.finding is None else str(self.finding)

    def to_dict(self) -> dict[str, Any]:
        """Return misfits and findings for JSON."""
        other = self.interpretation
        return {
            "misfit": self.misfit,
            "interpretation": None if other is None else other.finding,
            "other_misfit": self.other_misfit,
            "alternatives": [interpretation.finding for interpretation in self.alternatives],
            "refused": self.is_refused,
            "finding": self.finding,
        }


def check_conventions(
    robot: Mechanism,
    data: Measurements,
    *,
    allow_still: bool = False,
    allow_implausible: bool = False,
) -> ConventionCheck:
    """Refuse measurements with clear evidence of a wrong convention, and targets that never move.

    `loopcal.calibrate` begins with this check, and so does every command that reads measured data.

    Parameters
    ----------
    robot, data : see `compare_conventions`.
    allow_still : accept targets that no pose moves. allow_implausible : accept any convention
        without comparing others.

    Returns
    -------
    ConventionCheck
        Its finding, where there is one, is a warning: the data fit badly, but no tested
        interpretation fits far better.

    Raises
    ------
    DataError
        With the files of the data and the evidence; its code is that of the finding.
    """
    check_types(robot, data)
    try:
        return _check_conventions(robot, data, allow_still, allow_implausible)
    except DataError as error:
        files = " and ".join(dict.fromkeys(o.source for o in data.observations if o.source))
        if not files:
            raise
        raise DataError(f"{files}: {error}") from error


def _check_conventions(
    robot: Mechanism, data: Measurements, allow_still: bool, allow_implausible: bool
) -> ConventionCheck:
    """Check as `check_conventions`; its errors name no files."""
    if not allow_still and has_static_targets(data):
        solution = forward(robot, data.readings)
        if solution.converged.any():
            T = solution.T[solution.converged]
            check_targets_move(data.take(solution.converged), T, robot.size)
    if allow_implausible:
        return ConventionCheck(float("nan"))
    check = compare_conventions(robot, data)
    if check.is_refused:
        raise DataError(check.finding)
    return check


def compare_conventions(robot: Mechanism, data: Measurements) -> ConventionCheck:
    """Compare measurements with a robot under the stated conventions and, where these are
    implausible, under others.

    Parameters
    ----------
    robot : as given, before any fit: its values, and its tolerances (stated or default).
    data : as read. The `source` of its observations, such as a file, appears in the messages.
        Targets on the base are left out: they say nothing about the robot, and
        `loopcal.diagnose.report_base_targets` compares them with each other.

    Raises
    ------
    DataError
        The readings have another number of actuators.
    """
    check_types(robot, data)
    check_actuators(data, robot)
    data = replace(data, base_observations=())
    robot = fix_breaking_parameters(robot)  # no data contain other values of them
    free = select_free_parameters(robot)
    known = _select_known_readings(data, is_redundant(free))
    if known is None:
        return ConventionCheck(float("nan"))
    misfit = compute_quick_misfit(free, known)
    if not misfit > ALLOWED:
        return ConventionCheck(misfit, finding=_report_equals(free, known, misfit))
    thinned = _thin_out(known)
    fitted = compute_fitted_misfit(robot, thinned) if np.isinf(misfit) else np.inf
    if not fitted > ALLOWED:
        return ConventionCheck(fitted)
    has_errors = not is_redundant(free) and _has_uncertain_readings(data)
    return _compare_interpretations(free, thinned, has_errors)


def _compare_interpretations(
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
                whole.misfit, finding=_report_equals(free, reach.data, whole.misfit)
            )
        stated = exclude_far_rows(whole)
        misfit = min(whole.misfit, refine_misfit(stated)[0])
        if not misfit > ALLOWED:
            has_far_rows = whole.misfit > IMPLAUSIBLE and bool(stated.excluded)
            if has_far_rows:
                return ConventionCheck(misfit, finding=_report_far_rows(stated))
            return ConventionCheck(misfit, finding=_report_equals(free, reach.data, misfit))
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


def _select_known_readings(data: Measurements, redundant: bool) -> Measurements | None:
    """Return the poses all of whose readings exist and are believed; None where there is none.

    Only redundant readings keep their sigma: those of other robots contradict nothing.
    """
    if data.reading_sigma is None:
        return data
    known = np.isfinite(data.reading_sigma).all(axis=1) & np.isfinite(data.readings).all(axis=1)
    if not known.any():
        return None
    poses = data.take(known)
    return poses if redundant else replace(poses, reading_sigma=None)


def _has_uncertain_readings(data: Measurements) -> bool:
    """Return whether readings have errors, which may explain a misfit of exact ones."""
    sigma = data.reading_sigma
    return sigma is not None and bool(np.any(np.isfinite(sigma) & (sigma > 0.0)))


def _thin_out(data: Measurements) -> Measurements:
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


def _report_equals(free: FreeParameters, data: Measurements, misfit: float) -> Finding | None:
    """Report other orders of the actuators, or the other sign of heights, that explain data as well
    as they are written; None without any.
    """
    opposite = compute_opposite_misfit(free, data)
    if opposite <= max(EQUALLY * misfit, 1.0):
        return report_finding(
            "conventions.height-sign-undecided",
            robot=free.robot.name,
            misfit=misfit,
            other_misfit=opposite,
        )
    orders = find_equal_orders(free, data)
    if not orders:
        return None
    return report_finding(
        "conventions.orders-undecided",
        robot=free.robot.name,
        alternatives=tuple(order.describe() for order in orders),
    )


def _report_far_rows(stated: Comparison) -> Finding:
    """Report the rows that do not fit the others, which fit; they stay in the data."""
    return report_finding(
        "conventions.rows-far-off",
        count=len(stated.excluded),
        rows=sum(len(o) for o in stated.data.observations),
        poses=tuple(dict.fromkeys(stated.excluded)),
    )
