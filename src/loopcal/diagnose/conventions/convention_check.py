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

from dataclasses import replace

import numpy as np

from loopcal.diagnose.conventions.convention_result import ConventionCheck
from loopcal.diagnose.conventions.interpretations.equal_interpretations import report_equals
from loopcal.diagnose.conventions.misfit import (
    ALLOWED,
    compute_fitted_misfit,
    compute_quick_misfit,
    is_redundant,
)
from loopcal.errors import DataError
from loopcal.estimate.fit_input import check_types
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.measure import Measurements, check_actuators, check_targets_move, has_static_targets
from loopcal.mechanism import Mechanism, fix_breaking_parameters, forward


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
        return ConventionCheck(misfit, finding=report_equals(free, known, misfit))
    from loopcal.diagnose.conventions.implausible_data import compare_interpretations, thin_out

    thinned = thin_out(known)
    fitted = compute_fitted_misfit(robot, thinned) if np.isinf(misfit) else np.inf
    if not fitted > ALLOWED:
        return ConventionCheck(fitted)
    has_errors = not is_redundant(free) and _has_uncertain_readings(data)
    return compare_interpretations(free, thinned, has_errors)


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
