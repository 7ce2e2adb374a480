# SPDX-License-Identifier: Apache-2.0
"""Numbers for people: digits that the uncertainty leaves, and the units of a robot's file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from loopcal.findings.wording import count_decimals
from loopcal.units import Dimension, Unit, find_unit

if TYPE_CHECKING:
    from loopcal.mechanism import Mechanism

ROUNDING = 1e-12
"""A number smaller than this, in whatever unit is shown, is rounding and printed as 0."""

INSIGNIFICANT = 0.01
"""Share of its uncertainty below which a value is printed as 0."""

ABSENT = "-"
"""Stands for a number that does not exist."""


def units_of(robot: Mechanism) -> dict[Dimension, Unit]:
    """Return the units in which the numbers of a robot are shown: those of its file."""
    return {dimension: find_unit(symbol) for dimension, symbol in robot.units.items()}


def format_number(value: float, digits: int = 6) -> str:
    """Return a number with `digits` significant digits; a dash where it is not finite."""
    if not math.isfinite(value):
        return ABSENT
    return f"{0.0 if abs(value) < ROUNDING else value:.{digits}g}"


def format_in(unit: Unit, value: float, digits: int = 6) -> str:
    """Return a number in SI as one in a unit, without its symbol."""
    return format_number(float(value) / unit.factor_to_si, digits)


def format_with_uncertainty(value: float, uncertainty: float, digits: int = 9) -> str:
    """Return a value to the third significant digit of its uncertainty.

    A value below a hundredth of its uncertainty is 0. Without a finite uncertainty above 0 the
    value has `digits` significant digits.
    """
    if not math.isfinite(value) or not math.isfinite(uncertainty) or uncertainty <= 0.0:
        return format_number(value, digits)
    if abs(value) < INSIGNIFICANT * uncertainty:
        value = 0.0
    return f"{value:.{count_decimals(uncertainty)}f}"


def format_exact_beside(value: float, uncertainty: float) -> str:
    """Return a value that is exact, such as a nominal one, with the decimals of the uncertainty
    beside it; with its own digits where these would show it as 0.
    """
    if ROUNDING <= abs(value) < INSIGNIFICANT * uncertainty < math.inf:
        return format_number(value)
    return format_with_uncertainty(value, uncertainty)


def format_uncertainty(uncertainty: float) -> str:
    """Return an uncertainty with three significant digits, or a word where it has no number."""
    if math.isnan(uncertainty):
        return "not given"
    if math.isinf(uncertainty):
        return "unknown"
    return f"{uncertainty:.{count_decimals(uncertainty)}f}" if uncertainty > 0.0 else "0"
