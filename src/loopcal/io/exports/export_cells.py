# SPDX-License-Identifier: Apache-2.0
"""Numbers in the cells of an export: what they say does not depend on how many digits say it."""

from __future__ import annotations

import math


def with_point(text: str, decimal: str) -> str:
    """Return a number that is written with this decimal mark with a point; a point that is none
    becomes no number.
    """
    return text if decimal == "." else text.replace(".", "?").replace(decimal, ".")


def plain_number(text: str) -> float | None:
    """Return the finite number that a text says, None where it says none."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and text.isascii() and "_" not in text else None
