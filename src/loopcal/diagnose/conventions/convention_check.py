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

from loopcal.diagnose.conventions.interpretations import Interpretation
from loopcal.diagnose.conventions.misfit import (
    Comparison,
    compare_with_robot,
    compute_quick_misfit,
    exclude_far_rows,
    refine_misfit,
    select_reached,
)
from loopcal.diagnose.conventions.selection import (
    ALLOWED,
    BETTER,
    Selection,
    select_interpretation,
    shares_poses,
)
from loopcal.diagnose.conventions.setup_parameters import Contradiction, find_contradiction
from loopcal.errors import DataError
from loopcal.estimate.fit_input import check_types
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.findings import Finding, Quantity, Severity, report_finding
from loopcal.measure import Measurements, check_actuators, check_targets_move, has_static_targets
from loopcal.mechanism import Mechanism, forward
from loopcal.typing import FloatArray
from loopcal.units import Dimension

IMPLAUSIBLE = 10.0
"""Misfit above which conventions are in doubt. Tolerances exceeded three times, and a noise stated
three times too small, give about 3 each.
"""

MOST_POSES, RUNS = 120, 4
"""Number of poses of large data sets by which interpretations are judged, and number of runs of
neighbors (rows may be shifted by one) that contain them.
"""

GROSS = 100.0
"""Misfit above which data that contradict stated setup parameters are refused. Below it, robots far
beyond their tolerances look the same, and it is a warning.
"""


@dataclass(frozen=True, eq=False)
class ConventionCheck:
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
        return f"<ConventionCheck: {code}, misfit {self.misfit:.3g}>"

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

    Raises
    ------
    DataError
        The readings have another number of actuators.
    """
    check_types(robot, data)
    check_actuators(data, robot)
    free, known = select_free_parameters(robot), _select_known_readings(data)
    if known is None:
        return ConventionCheck(float("nan"))
    misfit = compute_quick_misfit(free, known)
    if misfit <= IMPLAUSIBLE:
        return ConventionCheck(misfit)
    thinned = _thin_out(known)
    reach = select_reached(free, thinned, follow=True)
    stated, against, misfit = None, None, np.inf
    if reach.is_enough:
        whole = compare_with_robot(free, reach.data)
        if not whole.misfit > IMPLAUSIBLE:
            return ConventionCheck(whole.misfit)
        stated = exclude_far_rows(whole)
        misfit = min(whole.misfit, refine_misfit(stated)[0])
        if not misfit > IMPLAUSIBLE:
            return ConventionCheck(misfit, finding=_report_far_rows(stated))
        against = find_contradiction(stated, misfit, BETTER)
    description = {
        "robot": robot.name,
        "misfit": misfit,
        "residuals": () if stated is None else _rms_residuals(stated),
        "reached": reach.n_reached if stated is None else None,
        "poses": reach.n_tested,
    }
    if against is None or against.misfit > ALLOWED:
        chosen = select_interpretation(free, thinned, stated, misfit)
        if chosen is not None:
            return _refuse(description, misfit, chosen)
    if against is not None:
        return _contradict(misfit, against)
    sigma = data.reading_sigma
    if sigma is not None and bool(np.any(np.isfinite(sigma) & (sigma > 0.0))):
        return ConventionCheck(misfit)
    return ConventionCheck(misfit, finding=report_finding("conventions.unexplained", **description))


def _select_known_readings(data: Measurements) -> Measurements | None:
    """Return the poses all of whose readings exist and are believed; None where there is none."""
    if data.reading_sigma is None:
        return data
    known = np.isfinite(data.reading_sigma).all(axis=1) & np.isfinite(data.readings).all(axis=1)
    return replace(data.take(known), reading_sigma=None) if known.any() else None


def _thin_out(data: Measurements) -> Measurements:
    """Return at most `MOST_POSES` poses, in runs of neighbors spread over the data; all where rows
    share more than their pose.
    """
    n = data.n_poses
    if n <= MOST_POSES or shares_poses(data):
        return data
    first = np.linspace(0, n - MOST_POSES // RUNS, RUNS).astype(np.intp)
    return data.take(np.unique(first[:, None] + np.arange(MOST_POSES // RUNS)))


def _refuse(description: dict[str, Any], misfit: float, chosen: Selection) -> ConventionCheck:
    """Refuse data that fit far better in another interpretation."""
    interpretation, alternatives = chosen.interpretation, chosen.alternatives
    finding = report_finding(
        "conventions.other-interpretation",
        **description,
        interpretation=interpretation.describe(),
        alternatives=tuple(other.describe() for other in alternatives),
        other_misfit=chosen.misfit,
        other_residuals=_rms_residuals(chosen.comparison),
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
        residuals=_rms_residuals(against.comparison),
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


def _rms_residuals(comparison: Comparison) -> tuple[Quantity, ...]:
    """Return root mean squares of the first interpretation's residuals by dimension, in units of
    the robot's file, without far rows.
    """
    robot = comparison.problem.free.robot
    square: dict[Dimension, list[FloatArray]] = {}
    for s, r in zip(comparison.problem.rows, comparison.residuals(), strict=True):
        present = np.einsum("rmm->rm", s.whitener[0]) != 0.0
        for j, column in enumerate(s.kind.noise_columns):
            square.setdefault(column.dimension, []).append(r.raw[0, present[:, j], j] ** 2)
    residuals = []
    for dimension, squares in square.items():
        values = np.concatenate(squares)
        if len(values):
            residuals.append(robot.to_quantity(float(np.sqrt(values.mean())), dimension))
    return tuple(residuals)
