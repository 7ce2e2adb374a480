# SPDX-License-Identifier: Apache-2.0
"""Derivatives that are nothing but rounding."""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray

ROUNDING = 1e-12
"""Share of the size of its terms below which a sum of a few products is rounding: some thousand
units of the last place.
"""


def without_rounding(values: FloatArray, size: FloatArray) -> FloatArray:
    """Return derivatives with zeros where they are rounding.

    They are rounding where they are at most ROUNDING of the size of the terms whose sum they are.
    A column that is rounding must be set to zero BEFORE columns are scaled to length one: after
    that, a few units of the last place look like any other direction and produce an unbounded step.

    Parameters
    ----------
    values : any shape. size : of the terms, broadcast to it; with a size of zero, or not finite,
        values stay.
    """
    return np.where(
        (np.abs(values) <= ROUNDING * size) & (size > 0.0) & (size < np.inf), 0.0, values
    )
