# SPDX-License-Identifier: Apache-2.0
"""Distinct values and medians without masked arrays.

`np.unique` and `np.median` ask whether their argument is masked, and import numpy.ma for it. That
takes 15 ms, a sixth of the import of numpy, in every command.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal.typing import FloatArray


def find_distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Return the distinct values of an array, of any shape and type, in ascending order.

    They are those of `np.unique`. With `return_counts`, it does not ask whether the array is masked
    (numpy 2.4).
    """
    return np.unique(values, return_counts=True)[0]


def compute_median(values: FloatArray) -> float:
    """Return the median of at least one number: NaN if one is NaN, as `np.median`.

    values : any shape.
    """
    ordered = np.sort(values, axis=None)  # NaN come last
    if np.isnan(ordered[-1]):
        return float("nan")
    return float(np.mean(ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1]))
