# SPDX-License-Identifier: Apache-2.0
"""The chi-square distribution against closed forms."""

import numpy as np
from numpy.testing import assert_allclose

from loopcal.numerics.statistics import compute_chi_square_quantile, compute_chi_square_tail


def test_tail_of_two_degrees_of_freedom_is_exponential():
    statistic = np.array([0.0, 0.5, 3.0, 40.0])
    tail = compute_chi_square_tail(2, statistic)
    assert_allclose(tail, np.exp(-statistic / 2.0), rtol=1e-13)  # rounding of the series


def test_tail_without_a_degree_of_freedom_is_one():
    assert compute_chi_square_tail([0.0, -1.0, 2.0], [5.0, 5.0, 0.0]).tolist() == [1.0, 1.0, 1.0]


def test_quantile_is_the_inverse_of_the_tail():
    degrees, probability = np.array([1.0, 6.0, 300.0]), np.array([1e-6, 0.05, 0.5])
    statistic = compute_chi_square_quantile(degrees, probability)
    assert_allclose(compute_chi_square_tail(degrees, statistic), probability, rtol=1e-9)
