# SPDX-License-Identifier: Apache-2.0
"""Numbers as text: the fewest digits that read back as the same double."""

from __future__ import annotations

import math
from decimal import Decimal

DIGITS = range(12, 18)
"""Significant digits that are tried, fewest first; 17 always suffice for one double."""


def format_scaled(value: float, factor: float) -> str:
    """Return value / factor with the fewest digits whose double times `factor` is `value` again.

    Parameters
    ----------
    value : in SI. factor : SI per unit of the text.

    Returns
    -------
    All 17 digits where rounding prevents that any shorter text returns the value.
    """
    scaled = value / factor
    texts = (f"{scaled:.{digits}g}" for digits in DIGITS)
    return next((text for text in texts if float(text) * factor == value), repr(float(scaled)))


def format_exact(value: float, factor: float) -> str:
    """Return the shortest text (12 to 17 digits) from which `parse_exact` makes the same double.

    17 digits suffice for every double: rounding to them changes a number by at most 0.5e-16 of it,
    and half the distance of two doubles is at least 0.55e-16 of them.
    """
    scaled = Decimal(value) / Decimal(repr(factor))
    texts = (f"{float(scaled):.{digits}g}" for digits in DIGITS)
    # rounded once: through a double, the last digit may be that of a neighbor
    nearest = f"{scaled:.{DIGITS[-1]}g}"
    return next((text for text in texts if parse_exact(text, factor) == value), nearest)


def parse_exact(text: str, factor: float) -> float:
    """Return the double nearest to the decimal product of a text and a factor, rounded once.

    Raises
    ------
    decimal.InvalidOperation : the text is not a number.
    """
    return float(Decimal(text) * Decimal(repr(factor)))


def parse_finite(text: str) -> float | None:
    """Return the finite number that a text states; None for any other text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and text.isascii() and "_" not in text else None
