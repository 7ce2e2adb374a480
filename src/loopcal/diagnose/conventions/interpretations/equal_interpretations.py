# SPDX-License-Identifier: Apache-2.0
"""Report interpretations that explain data as well as the stated one, which explains them: the data
cannot show which is true.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.diagnose.conventions.misfit import EQUALLY, compute_quick_misfit, is_redundant
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements
from loopcal.measure.kinds.rows import Column
from loopcal.units import Dimension

HEIGHT, SIGNIFICANT = (Column("z", Dimension.LENGTH),), 10.0
"""Columns of a height, and standard deviations of the noise from which its sign matters."""


def report_equals(free: FreeParameters, data: Measurements, misfit: float) -> Finding | None:
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
    if not is_redundant(free):
        return None
    from loopcal.diagnose.conventions.interpretations.actuator_orders import find_equal_orders

    orders = find_equal_orders(free, data)
    if not orders:
        return None
    return report_finding(
        "conventions.orders-undecided",
        robot=free.robot.name,
        alternatives=tuple(order.describe() for order in orders),
    )


def compute_opposite_misfit(free: FreeParameters, data: Measurements) -> float:
    """Return the misfit of data that consist of heights alone with the opposite sign of these; NaN
    for other data, and for heights within the noise.
    """
    if not data.observations or any(o.kind.columns != HEIGHT for o in data.observations):
        return float("nan")
    sizes = [np.nan_to_num(o.whitener[:, 0, 0] * o.measured[:, 0]) for o in data.observations]
    if not np.abs(np.concatenate(sizes)).max(initial=0.0) > SIGNIFICANT:
        return float("nan")
    opposite = tuple(replace(o, measured=-o.measured) for o in data.observations)
    return compute_quick_misfit(free, replace(data, observations=opposite))
