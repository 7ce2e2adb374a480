# SPDX-License-Identifier: Apache-2.0
"""Numbers as text: the fewest digits that read back as the same double."""

from __future__ import annotations

from decimal import Decimal


def shortest(value: float, factor: float) -> str:
    """Return value / factor with the fewest digits (12 at least) whose product with factor is
    `value` again.

    Parameters
    ----------
    value : float
        In SI.
    factor : float
        SI per unit of what is written.

    Returns
    -------
    str
        All 17 digits where rounding keeps every shorter text from coming back.
    """
    scaled = value / factor
    texts = (f"{scaled:.{digits}g}" for digits in range(12, 18))
    return next((text for text in texts if float(text) * factor == value), repr(float(scaled)))


def exact(text: str, factor: float) -> float:
    """Return the double next to the decimal product of a finite number's text and a factor: rounded
    once, not twice.

    Raises
    ------
    decimal.InvalidOperation
        The text is no number.
    """
    return float(Decimal(text) * Decimal(repr(factor)))


def exactly(value: float, factor: float) -> str:
    """Return the shortest text (12 digits at least) from which `exact` makes the same double, for
    any double.
    """
    scaled = Decimal(value) / Decimal(repr(factor))
    short = (f"{float(scaled):.{digits}g}" for digits in range(12, 18))
    return next((text for text in short if exact(text, factor) == value), f"{scaled:.24g}")
