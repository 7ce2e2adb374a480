# SPDX-License-Identifier: Apache-2.0
"""What cannot be estimated is refused beforehand, with what was found and what to do."""

from __future__ import annotations

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.problem import Problem
from loopcal.measure import Measurements, check_actuators
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray

HUGE = 1e150
"""Residuals, in units of sigma, whose squares cannot be summed."""


def check_noise(noise: str) -> None:
    """Refuse anything but the two words.

    Raises
    ------
    EstimationError
        Naming them.
    """
    if noise not in {"given", "estimated"}:
        raise EstimationError(f"noise is {noise!r}; it must be 'given' or 'estimated'")


def check_settings(method: object, rank_tolerance: float, noise: str) -> None:
    """Refuse a method that is a word or a class, a rank tolerance outside (0, 1), and a noise that
    is neither word.

    Raises
    ------
    EstimationError
        Naming what is allowed.
    """
    check_noise(noise)
    parts = ("needs", "flat", "scale", "penalty")
    if method is not None and (
        isinstance(method, type) or not all(hasattr(method, name) for name in parts)
    ):
        raise EstimationError(
            f"method is {method!r}; it must be an instance such as MAP(), LeastSquares(), "
            "Ridge(1.0) or TruncatedSVD(10)"
        )
    if not 0.0 < rank_tolerance < 1.0:
        raise EstimationError(f"rank_tolerance is {rank_tolerance}; it must be above 0 and below 1")


def check_rows(rows: Problem, data: Measurements, robot: Mechanism) -> None:
    """Refuse readings of another robot, a robot without free parameters, and data without any row.

    Raises
    ------
    DataError
        Wrong number of actuators.
    EstimationError
        Nothing to identify, or nothing to identify it from.
    """
    check_actuators(data, robot)
    if rows.parameters == 0:
        raise EstimationError(
            f"{robot.name} has no free parameter: free at least one of {len(robot.parameters)}"
        )
    if rows.residual_count[0] == 0:
        raise EstimationError(
            "no measured value counts: every row is absent or has weight 0; give at least one"
        )


def check_count(rows: Problem, data: Measurements, method: Method, allow_fewer: bool) -> None:
    """Refuse fewer equations than parameters where the method has no prior to fill the gap.

    Raises
    ------
    EstimationError
        Naming both numbers and the poses that would do.
    """
    own = 0 if rows.nuisance is None else rows.nuisance.unpenalized_count
    m, p = int(rows.equations[0]), method.needs(rows.parameters) + own
    if m >= p or allow_fewer:
        return
    if m == 0:
        raise EstimationError(
            f"nothing is left to determine {p} parameters once the {data.n_poses} poses themselves "
            "are found from what was"
            " measured there: measure more at each pose, or state readings that can be trusted as "
            "exact (sigma 0)"
        )
    poses = int(np.ceil(p * data.n_poses / m))
    without = "" if p - own == rows.parameters else " without a tolerance"
    without += f" ({own} of them in frames, targets and the like)" if own else ""
    raise EstimationError(
        f"{m} equations from {data.n_poses} poses cannot determine {p} parameters{without}: "
        f"measure at least {poses} poses like"
        " these (better twice as many), fix parameters, or state their tolerances and use a "
        "method with a prior (MAP)"
    )


def check_start(rows: Problem, data: Measurements, deviation: FloatArray, cost: FloatArray) -> None:
    """Refuse a start from which some poses cannot be reached.

    Raises
    ------
    EstimationError
        Naming the first poses and how many there are.
    """
    if np.isfinite(cost[0]):
        return
    start = rows.start(deviation)
    lost = rows.find_unreached(deviation, start)
    if len(lost) == 0:
        with np.errstate(all="ignore"):
            parts = rows.residuals(deviation, rows.solve(deviation, start))
        bad = {
            int(i)
            for s, r in zip(rows.rows, parts, strict=True)
            for i in s.poses_by_link[~(np.abs(r.whitened[0]) < HUGE).all(axis=1)].ravel()
        }
        poses = ", ".join(repr(data.labels[i]) for i in sorted(bad)[:5]) + (
            ", ..." if len(bad) > 5 else ""
        )
        raise EstimationError(
            f"residuals are not finite, or too large to square, at poses {poses}; correct these "
            "rows"
        )
    names = ", ".join(repr(data.labels[i]) for i in lost[:5]) + (", ..." if len(lost) > 5 else "")
    raise EstimationError(
        f"the robot cannot reach {len(lost)} of {data.n_poses} poses with the readings given there "
        f"(poses {names});"
        " correct the readings, their unit or the robot's dimensions, or give these rows weight 0"
    )
