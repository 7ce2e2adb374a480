# SPDX-License-Identifier: Apache-2.0
"""Changes of tables of numbers: pure functions that scale or permute columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from loopcal.typing import BoolArray, FloatArray

Change = Callable[[FloatArray], FloatArray]
"""From written values (r, c), or readings (n, a), to those that the stated convention would write
[SI].
"""


def scale_columns(columns: Sequence[int], factor: float, zero: FloatArray | float = 0.0) -> Change:
    """Return the change that multiplies columns by a factor, counted from `zero` (k,) or ()."""
    chosen = list(columns)

    def change(values: FloatArray) -> FloatArray:
        changed = np.array(values)
        changed[:, chosen] = zero + factor * (values[:, chosen] - zero)
        return changed

    return change


def scale_chosen(chosen: BoolArray, factor: float) -> Change:
    """Return the change that multiplies chosen values (n, a) by a factor."""
    return lambda values: np.where(chosen, factor * values, values)


def permute_columns(columns: Sequence[int], sources: Sequence[int]) -> Change:
    """Return the change that takes the values of columns from other columns."""
    chosen, taken = list(columns), list(sources)

    def change(values: FloatArray) -> FloatArray:
        changed = np.array(values)
        changed[:, chosen] = values[:, taken]
        return changed

    return change
