# SPDX-License-Identifier: Apache-2.0
"""Check the stated conventions of measurements against the robot, before anything is fitted.

With the robot as given, unknown frames estimated and its parameters free within their spreads,
whitened rows cost

    C = min_z |r + A z|^2 + |z|^2,    A = W G D diag(tolerance)

which has a chi-square distribution with as many degrees of freedom as rows where spreads and
noise are true. The misfit sqrt(C / rows) is then 1, and at most k where all deviations are k
tolerances large. A wrong unit, order, sign or column gives tens to millions. Only then are other
interpretations of the data tested (`loopcal.diagnose.conventions.interpretations`), and the data
are refused only where one of them fits far better: see docs/theory/residual-patterns.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.diagnose.conventions.interpretations import Interpretation
from loopcal.diagnose.conventions.misfit import (
    ALLOWED,
    BETTER,
    GROSS,
    MOST_EXCLUDED,
    UNDECLARED,
    Comparison,
    compare_with_robot,
    compute_fitted_misfit,
    compute_quick_misfit,
    exclude_far_rows,
    find_reading_unit,
    is_redundant,
    judge_data,
    list_rms_residuals,
    refine_misfit,
    report_equals,
    search_interpretations,
    select_reached,
    shares_poses,
)
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure import data_checks
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import choose_setup_unit
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.over_constraint import fix_breaking_parameters
from loopcal.mechanism.solutions import forward
from loopcal.numerics.statistics import find_distinct
from loopcal.results.description import Field, fields
from loopcal.results.result import Result

# Misfit above which conventions are in doubt. Tolerances exceeded three times, and a noise stated
# three times too small, give about 3 each.
IMPLAUSIBLE = 10.0


@dataclass(frozen=True, eq=False, repr=False)
class ConventionCheck(Result):
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

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        "misfit",
        interpretation="interpretation.finding",
        other_misfit="other_misfit",
        alternatives="alternatives.finding",
        refused="is_refused",
        finding="finding",
    )

    @property
    def is_doubtful(self) -> bool:
        """Whether tolerances and noise do not explain the data as they are stated."""
        return self.misfit > IMPLAUSIBLE

    @property
    def is_refused(self) -> bool:
        """Whether there is clear evidence that the stated conventions are wrong."""
        return self.finding is not None and self.finding.severity is Severity.REFUSAL


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

    Returns the check; its finding, where there is one, is a warning: the data fit badly, but no
    tested interpretation fits far better.

    Raises
    ------
    DataError : with the files of the data and the evidence; its code is that of the finding.
    """
    try:
        if not allow_still and data_checks.has_static_targets(data):
            solution = forward(robot, data.readings)
            if solution.converged.any():
                T = solution.T[solution.converged]
                data_checks.check_targets_move(data.take(solution.converged), T, robot.size)
        if allow_implausible:
            return ConventionCheck(float("nan"))
        check = compare_conventions(robot, data)
        if check.is_refused:
            raise DataError(check.finding)
        return check
    except DataError as error:
        files = " and ".join(dict.fromkeys(o.source for o in data.observations if o.source))
        if not files:
            raise
        raise DataError(f"{files}: {error}") from error


def compare_conventions(robot: Mechanism, data: Measurements) -> ConventionCheck:
    """Compare measurements with a robot under the stated conventions and, where these are
    implausible, under others.

    Parameters
    ----------
    robot : as given, before any fit: its values, and its spreads (stated or default).
    data : as read. The `source` of its observations, such as a file, appears in the messages.
        Targets on the base are left out: they say nothing about the robot, and
        `loopcal.diagnose.measured_points.report_base_targets` compares them with each other.

    Raises
    ------
    DataError : the readings have another number of actuators.
    """
    data_checks.check_actuators(data, robot)
    data = replace(data, base_observations=())
    robot = fix_breaking_parameters(robot)  # no data contain other values of them
    free = select_free_parameters(robot)
    known, sigma = data, data.reading_sigma
    if sigma is not None:
        believed = np.isfinite(sigma).all(axis=1) & np.isfinite(data.readings).all(axis=1)
        if not believed.any():
            return ConventionCheck(float("nan"))
        known = data.take(believed)
        if not is_redundant(free):  # their errors contradict nothing
            known = replace(known, reading_sigma=None)
    misfit = compute_quick_misfit(free, known)
    if not misfit > ALLOWED:
        return ConventionCheck(misfit, finding=report_equals(free, known, misfit))

    thinned, n = known, known.n_poses
    if n > MOST_POSES and not shares_poses(known):  # runs of neighbors spread over the data
        first = np.linspace(0, n - MOST_POSES // RUNS, RUNS).astype(np.intp)
        thinned = known.take(find_distinct(first[:, None] + np.arange(MOST_POSES // RUNS)))
    in_other_unit = find_reading_unit(free, thinned) if np.isinf(misfit) else None
    if in_other_unit is not None:
        return ConventionCheck(misfit, finding=in_other_unit)
    fitted = compute_fitted_misfit(robot, thinned) if np.isinf(misfit) else np.inf
    if not fitted > ALLOWED:
        return ConventionCheck(fitted)
    has_errors = sigma is not None and bool(np.any(np.isfinite(sigma) & (sigma > 0.0)))
    return _compare_interpretations(free, thinned, has_errors and not is_redundant(free))


# Setup parameters (frames, targets, surfaces): stated values, and values kept from a fit.

# Number of stated parameters up to which each is estimated alone, to find the wrong one.
MOST_SINGLE = 12
SMALLER = 3.0  # factor by which errors must decrease when a moved setup item is fitted again
# Standard deviations of the noise (rms) that the errors with kept values must exceed; below,
# noise may be the reason.
ABOVE = 3.0
FEWEST = 8  # smallest number of equations beyond the fitted parameters that supports a result


class Contradiction(NamedTuple):
    """Stated setup parameters that the data contradict."""

    comparison: Comparison  # of the measurements with these parameters estimated
    misfit: float  # the remaining misfit
    names: tuple[str, ...]  # of the parameters
    values: tuple[dict[str, Any], ...]  # for each its name, estimate, stated value and certainty


def find_contradiction(stated: Comparison, misfit: float, better: float) -> Contradiction | None:
    """Return the stated setup parameter that alone explains the misfit, or else all stated ones,
    without which measurements fit better by this factor; None without any.
    """
    present = set(stated.data.nuisance_parameters.table.names)
    values = (v for v in stated.data.stated_values if not v.is_undetermined and v.sd < np.inf)
    names = tuple(value.name for value in values if value.name in present)
    if not names:
        return None
    together = _estimate_stated(stated, names)
    if not together.misfit * better < misfit:
        return None
    options = [together]
    if 1 < len(names) <= MOST_SINGLE:
        single = [_estimate_stated(stated, (name,)) for name in names]
        options += [option for option in single if option.misfit * better < misfit]
    return min(options, key=lambda option: (len(option.names), option.misfit))


def find_moved_setups(
    names: Sequence[str], sizes: Callable[[tuple[str, ...]], tuple[float, int]]
) -> tuple[tuple[str, ...], float] | None:
    """Return the frames, targets and surfaces that were moved since a fit, or all that may have
    moved, and the factor by which errors decrease when they are fitted again; None without any.

    names : of those whose values are kept.
    sizes : from the names that are fitted again to the root mean square [1] of whitened errors, per
        degree of freedom, and the number of equations left; NaN and 0 where the rows do not
        determine them.
    """
    names = tuple(names)
    if not names or not (kept := sizes(())[0]) > ABOVE:
        return None
    fitted, left = sizes(names)
    if left < FEWEST or not kept > SMALLER * fitted:
        return None
    moved = names
    if len(names) > 1:
        moved = tuple(
            name
            for name in names
            if sizes(tuple(other for other in names if other != name))[0] > SMALLER * fitted
        )
    return moved or names, kept / fitted


def _estimate_stated(stated: Comparison, names: tuple[str, ...]) -> Contradiction:
    """Compare the measurements with some stated parameters estimated."""
    free, data = stated.problem.free, stated.data
    stated_values = tuple(
        replace(value, sd=np.inf) if value.name in names else value for value in data.stated_values
    )
    freed = replace(data, stated_values=stated_values)
    comparison = exclude_far_rows(compare_with_robot(free, freed))
    misfit, estimates = refine_misfit(comparison)
    before, after = data.nuisance_parameters.table, freed.nuisance_parameters.table
    values = []
    for name in names:
        entry, estimate = before.entries[before.index(name)], float(estimates[after.index(name)])
        unit = choose_setup_unit(free.robot, entry)
        symbol, factor = unit.symbol, unit.factor_to_si
        certainty = "fixed"
        if entry.free and entry.tolerance is not None:
            certainty = f"sd {entry.tolerance / factor:.3g} {symbol}"
        value = {
            "name": name,
            "estimated": f"{estimate / factor:.4g} {symbol}",
            "stated": f"{entry.nominal / factor:.4g} {symbol}",
            "certainty": certainty,
        }
        values.append(value)
    return Contradiction(comparison, misfit, names, tuple(values))


# Judge measurements that the robot does not explain in one step of a fit: a few rows far off,
# a wrong statement about frames or targets, another interpretation, or none that is tested.

# Smallest number of equations beyond those of unknown frames by which data are refused. With
# fewer, frames and parameters alone explain nearly anything.
FEWEST_TO_REFUSE = 8
# Number of poses of large data sets by which interpretations are judged, and number of runs of
# neighbors (rows may be shifted by one) that contain them.
MOST_POSES, RUNS = 120, 4


def _compare_interpretations(
    free: FreeParameters, thinned: Measurements, has_errors: bool
) -> ConventionCheck:
    """Return the check of data that the robot does not explain in one step.

    `has_errors` : readings that count as exact here have errors, which may explain a misfit.
    """
    reached, n_reached, n_tried = select_reached(free, thinned, follow=True)
    stated, against, misfit = None, None, np.inf
    if reached is not None:
        whole = compare_with_robot(free, reached)
        misfit = whole.misfit
        if misfit > ALLOWED:
            stated = exclude_far_rows(whole)
            misfit = min(misfit, refine_misfit(stated)[0])
        if misfit > IMPLAUSIBLE and stated is not None and not stated.excluded:
            stated, misfit = _leave_out_pose(free, stated, misfit)
        if not misfit > ALLOWED:
            if stated is None or not stated.excluded or not whole.misfit > IMPLAUSIBLE:
                return ConventionCheck(misfit, finding=report_equals(free, reached, misfit))
            finding = report_finding(
                "conventions.rows-far-off",
                count=len(stated.excluded),
                rows=sum(len(o) for o in stated.data.observations),
                poses=tuple(dict.fromkeys(stated.excluded)),
            )
            return ConventionCheck(misfit, finding=finding)
        if stated is not None and misfit > IMPLAUSIBLE:
            against = find_contradiction(stated, misfit, BETTER)
    if against is not None and against.misfit <= ALLOWED:
        return _contradict(misfit, against)
    find_pairs = misfit > IMPLAUSIBLE
    chosen, tried, possible = search_interpretations(free, thinned, stated, misfit, find_pairs)
    # those beyond unknown frames: of the data as written or as read, whichever has fewer
    compared = (stated, None if chosen is None else chosen.comparison)
    linear = [c.linearization for c in compared if c is not None]
    counts = (int(each.equations[0]) for each in linear if each is not None)
    equations = min(counts, default=FEWEST_TO_REFUSE)
    has_enough = equations >= FEWEST_TO_REFUSE
    description = {
        "robot": free.robot.name,
        "misfit": misfit,
        "residuals": () if stated is None else list_rms_residuals(stated),
        "reached": n_reached if stated is None else None,
        "poses": n_tried,
    }
    if chosen is not None and has_enough:
        interpretation, alternatives = chosen.interpretation, chosen.alternatives
        # a robot far beyond its spreads looks the same as an undeclared setup item
        is_doubtful = interpretation.slip == UNDECLARED and not misfit > GROSS
        finding = report_finding(
            "conventions.other-interpretation",
            Severity.WARNING if is_doubtful else Severity.REFUSAL,
            **description,
            interpretation=interpretation.describe(),
            alternatives=tuple(other.describe() for other in alternatives),
            other_misfit=chosen.misfit,
            other_residuals=list_rms_residuals(chosen.comparison),
            is_consistent=chosen.misfit <= ALLOWED,
            heights=interpretation.slip == UNDECLARED
            and all(getattr(o.kind, "components", ()) == ("z",) for o in thinned.observations),
        )
        return ConventionCheck(misfit, interpretation, chosen.misfit, alternatives, finding)
    if against is not None:
        return _contradict(misfit, against)
    if not misfit > IMPLAUSIBLE or has_errors:
        return ConventionCheck(misfit)
    if has_enough:
        description |= {"tried": tried, "possible": possible}
        finding = report_finding("conventions.unexplained", **description)
        return ConventionCheck(misfit, finding=finding)
    listed = () if chosen is None else (chosen.interpretation, *chosen.alternatives)
    finding = report_finding(
        "conventions.undecided",
        **description,
        equations=equations,
        needed=FEWEST_TO_REFUSE,
        alternatives=tuple(other.describe() for other in listed),
    )
    return ConventionCheck(misfit, finding=finding)


def _leave_out_pose(
    free: FreeParameters, stated: Comparison, misfit: float
) -> tuple[Comparison, float]:
    """Compare without one of the poses of the largest residuals, and return the comparison without
    the one that alone explains the misfit; else the given ones. Of few poses, an unknown frame
    follows a wrong one, so that no row is far off the others.
    """
    data, size = stated.data, np.zeros(stated.data.n_poses)
    for rows, residual in zip(data.observations, stated.residuals(), strict=False):
        square = np.nan_to_num(residual.whitened[0]) ** 2
        np.add.at(size, rows.rows.reshape(len(rows), -1)[:, 0], square.sum(axis=1))
    poses, tried = np.arange(data.n_poses), np.argsort(-size, kind="stable")[:MOST_SINGLE]
    if MOST_EXCLUDED * np.count_nonzero(size) < 1.0:
        return stated, misfit
    for wrong in tried.tolist():
        left = compare_with_robot(free, data.take(poses != wrong))
        linear = left.linearization
        has_enough = linear is not None and int(linear.equations[0]) >= FEWEST_TO_REFUSE
        if has_enough and (alone := refine_misfit(left)[0]) <= ALLOWED:
            return replace(stated, excluded=(data.labels[wrong],)), alone
    return stated, misfit


def _contradict(misfit: float, against: Contradiction) -> ConventionCheck:
    """Report stated setup parameters without which the data fit; refuse gross contradictions."""
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


def explain_outside_strokes(
    robot: Mechanism, data: Measurements, described: Mapping[str, Any] | None = None
) -> Finding | None:
    """Find the interpretation that puts all readings inside their strokes and fits the data:
    `conventions.strokes-explained`, or `conventions.strokes-contradicted` if the data fit as they
    are written; None if nothing explains them.

    described : these readings, as of `describe_outside_strokes`; default: without places.
    """
    described = (
        data_checks.describe_outside_strokes(data, robot) if described is None else described
    )
    if described is None:
        return None
    check = compare_conventions(robot, data)
    if check.misfit <= ALLOWED:
        return report_finding("conventions.strokes-contradicted", **described)
    candidates = () if check.interpretation is None else (check.interpretation, *check.alternatives)
    inside = [
        candidate
        for candidate in candidates
        if data_checks.describe_outside_strokes(candidate.apply(data), robot) is None
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
