# SPDX-License-Identifier: Apache-2.0
"""Distinct values and medians are those of numpy, and need no masked arrays."""

import subprocess
import sys

import numpy as np
import pytest

from loopcal.numerics.statistics import compute_median, find_distinct

ARRAYS = (
    np.array([3, 1, 3, 2, 1]),
    np.array([[2.0, -1.0], [np.nan, 2.0], [np.nan, 0.0]]),
    np.array(["day 2", "", "day 1", ""]),
    np.array([True, False, True]),
    np.zeros(0),
    np.zeros(0, dtype=np.intp),
)


@pytest.mark.parametrize("values", ARRAYS, ids=lambda values: f"{values.dtype}-{values.shape}")
def test_distinct_values_are_those_of_numpy(values) -> None:
    before, expected = values.copy(), np.unique(values)
    distinct = find_distinct(values)
    assert distinct.dtype == expected.dtype
    np.testing.assert_array_equal(distinct, expected)
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize(
    "values",
    [
        [3.0],
        [2.0, 1.0],
        [0.1, 0.7, 0.3],
        [0.1, 0.3, 0.2, 1e9],
        [1.0, np.nan, 2.0],
        [np.inf, 1.0],
        [[0.1, 9.0], [0.7, 0.3], [0.2, 0.8]],
    ],
)
def test_the_median_is_that_of_numpy_to_the_last_bit(values) -> None:
    np.testing.assert_array_equal(compute_median(np.array(values)), np.median(values))


def test_masked_arrays_are_not_imported() -> None:
    code = (
        "import sys, numpy as np; from loopcal.numerics import statistics as own; "
        "own.find_distinct(np.array([2, 1, 2])); own.compute_median(np.array([0.1, 0.2])); "
        "print('numpy.ma' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
