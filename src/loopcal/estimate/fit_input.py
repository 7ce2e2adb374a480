# SPDX-License-Identifier: Apache-2.0
"""The input of a fit: exclude poses, and refuse what cannot be fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal.errors import DataError, EstimationError, suggest_names
from loopcal.estimate.penalties import Method
from loopcal.estimate.problem import Problem
from loopcal.estimate.result import Identification
from loopcal.findings import report_finding
from loopcal.measure.array_checks import check_type
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import weight_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.typing import FloatArray

HUGE = 1e150
"""Residuals, in units of sigma, whose squares cannot be summed."""


def check_types(robot: object, data: object) -> None:
    """Refuse anything but a robot and measurements, such as file names."""
    check_type(robot, Mechanism, "robot", "as from loopcal.load_robot('hexapod-42')")
    check_type(data, Measurements, "data", "as from load_measurements('data.csv', robot)")


def check_fitted_data(fit: Identification, data: Measurements) -> None:
    """Raise DataError unless the data have as many poses as the fit was made from."""
    if data.n_poses != len(fit.pose_weights):
        raise DataError(
            f"the data have {data.n_poses} poses, but the fit was made from "
            f"{len(fit.pose_weights)}; give the measurements that were fitted, without held-out "
            "poses"
        )


def exclude_poses(data: Measurements, excluded: Sequence[str]) -> Measurements:
    """Return the measurements with weight 0 for every row that belongs to one of these poses.

    The poses keep their places; their readings do not count either.

    Parameters
    ----------
    data : measurements. excluded : labels of poses.

    Raises
    ------
    DataError : the data have no such pose.
    """
    if not excluded:
        return data
    known, unwanted = set(data.labels), set(excluded)
    for label in excluded:
        if label not in known:
            raise DataError(
                f"no pose {label!r} to exclude{suggest_names(label, data.labels)}; give labels of "
                "poses in the data"
            )
    kept = np.array([label not in unwanted for label in data.labels])
    observations = tuple(
        o.with_weights(o.weight * kept[o.rows].reshape(len(o), o.kind.poses_per_row).all(axis=1))
        for o in data.observations
    )
    return replace(
        data,
        observations=observations,
        reading_sigma=weight_reading_sigma(data.reading_sigma, kept.astype(np.float64)),
    )


def check_rows(problem: Problem, data: Measurements, robot: Mechanism) -> None:
    """Refuse readings of another robot, held-out poses, a robot without free parameters, and data
    without any row.

    Raises
    ------
    DataError : wrong number of actuators, or `data.held-out-fitted`.
    EstimationError : `fit.no-free-parameter` or `fit.no-measured-value`.
    """
    check_actuators(data, robot)
    if count := int(data.is_held_out.sum()):
        raise DataError(report_finding("data.held-out-fitted", count=count))
    if problem.parameters == 0:
        raise EstimationError(
            report_finding("fit.no-free-parameter", robot=robot.name, total=len(robot.parameters))
        )
    if problem.residual_count[0] == 0:
        raise EstimationError(report_finding("fit.no-measured-value"))


def count_spare_equations(problem: Problem) -> int:
    """Return the number of equations less that of parameters and nuisance parameters."""
    nuisance = 0 if problem.nuisance is None else problem.nuisance.unpenalized_count
    return int(problem.equations[0]) - problem.parameters - nuisance


def check_count(problem: Problem, data: Measurements, method: Method, allow_fewer: bool) -> None:
    """Refuse fewer equations than parameters where the method has no prior to fill the gap.

    Raises
    ------
    EstimationError : `fit.too-few-equations`, with the number of poses that would be enough, or
        `fit.no-equation-left`.
    """
    nuisance = 0 if problem.nuisance is None else problem.nuisance.unpenalized_count
    required = method.required_equations(problem.parameters)
    m, p = int(problem.equations[0]), required + nuisance
    if m >= p or allow_fewer:
        return
    if m == 0:
        raise EstimationError(
            report_finding("fit.no-equation-left", poses=data.n_poses, unknowns=p)
        )
    raise EstimationError(
        report_finding(
            "fit.too-few-equations",
            equations=m,
            poses=data.n_poses,
            unknowns=p,
            nuisance=nuisance,
            has_prior=required != problem.parameters,
            poses_needed=int(np.ceil(p * data.n_poses / m)),
        )
    )


def check_start(
    problem: Problem, data: Measurements, deviation: FloatArray, cost: FloatArray
) -> None:
    """Refuse a start at which some residuals are not finite.

    Raises
    ------
    EstimationError : `fit.poses-out-of-reach` or `fit.residuals-not-finite`, with the poses.
    """
    if np.isfinite(cost[0]):
        return
    start = problem.start(deviation)
    lost = problem.find_unreached(deviation, start)
    if len(lost) > 0:
        raise EstimationError(
            report_finding(
                "fit.poses-out-of-reach",
                count=len(lost),
                total=data.n_poses,
                poses=tuple(data.labels[i] for i in lost),
            )
        )
    with np.errstate(all="ignore"):
        residuals = problem.residuals(deviation, problem.solve(deviation, start))
    bad = {
        int(i)
        for s, r in zip(problem.rows, residuals, strict=True)
        for i in s.poses_by_link[~(np.abs(r.whitened[0]) < HUGE).all(axis=1)].ravel()
    }
    raise EstimationError(
        report_finding("fit.residuals-not-finite", poses=tuple(data.labels[i] for i in sorted(bad)))
    )
