# SPDX-License-Identifier: Apache-2.0
"""The test of a variance component against simulated vectors, its size against an integral. The
chi-square distribution against closed forms. Distinct values and medians are those of numpy, and
need no masked arrays.
"""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import integrate

from loopcal.numerics.statistics import (
    compute_chi_square_quantile,
    compute_chi_square_tail,
    compute_component_tail,
    compute_known_median,
    compute_median,
    compute_weighted_quantile,
    estimate_variance_component,
    find_distinct,
    find_distinct_rows,
)

WEIGHTS = np.geomspace(5.0, 1e-3, 12)


@pytest.mark.parametrize("further", [0, 3, 40])
def test_tail_is_the_share_of_vectors_without_the_component_that_exceed_it(further):
    weights = np.r_[WEIGHTS, np.zeros(further)]
    y = np.random.default_rng(3).standard_normal((40_000, len(weights)))
    ratios = (y**2 @ weights) / (y**2).sum(axis=1)
    for quantile in (0.02, 0.5, 0.9, 0.95, 0.99, 0.999):
        i = int(np.argsort(ratios)[int(quantile * len(ratios))])
        tail = compute_component_tail(weights, y[i])
        scatter = 4.0 * np.sqrt(quantile * (1.0 - quantile) / len(ratios))
        assert tail == pytest.approx(1.0 - quantile, rel=0.03, abs=scatter)


def test_tail_does_not_depend_on_the_unit_of_elements_or_weights():
    y = np.random.default_rng(1).standard_normal(12)
    first = compute_component_tail(WEIGHTS, y)
    assert compute_component_tail(1e-12 * WEIGHTS, 1e3 * y) == pytest.approx(first)


def test_without_weights_or_elements_nothing_is_tested():
    assert compute_component_tail(np.zeros(3), np.ones(3)) == 1.0
    assert compute_component_tail(np.ones(3), np.zeros(3)) == 1.0


@pytest.mark.parametrize("typical", [np.inf, 0.5])
def test_size_is_the_mean_over_its_distribution(typical):
    rng = np.random.default_rng(5)
    weights = np.r_[WEIGHTS, np.zeros(30)]
    y = np.sqrt(1.0 + 4.0 * weights) * rng.standard_normal(42)
    found = estimate_variance_component(weights, y, 8.0, typical=typical)

    def density(tau: float, power: int) -> float:
        scale = 1.0 + tau**2 * weights
        square = float((y**2 / scale).sum()) + 8.0
        variance = tau**2 * square / 50.0
        value = variance**power / (1.0 + variance / typical)  # half-Cauchy
        return value * np.prod(scale) ** -0.5 * (square / 50.0) ** -25.0

    moments = [integrate.quad(density, 0.0, 200.0, args=(k,), limit=400)[0] for k in range(3)]
    mean, square = moments[1] / moments[0], moments[2] / moments[0] * (1.0 + 2.0 / 46.0)
    assert found.variance == pytest.approx(mean, rel=5e-3)
    assert found.degrees == pytest.approx(2.0 * mean**2 / (square - mean**2), rel=2e-2)


def test_a_large_component_is_found_with_about_as_many_degrees_as_elements():
    rng = np.random.default_rng(2)
    weights = np.r_[np.ones(200), np.zeros(300)]
    y = np.sqrt(1.0 + 100.0 * weights) * rng.standard_normal(500)
    found = estimate_variance_component(weights, y)
    assert found.variance == pytest.approx(100.0, rel=0.2)
    assert 150.0 < found.degrees < 220.0


def test_an_exact_sigma_is_the_limit_of_many_degrees_of_freedom():
    rng = np.random.default_rng(1)
    weights = np.geomspace(1e-2, 1e2, 12)
    y = rng.standard_normal(12) * np.sqrt(1.0 + 0.1 * weights)
    exact = estimate_variance_component(weights, y, np.inf)
    assert np.allclose(exact, estimate_variance_component(weights, y, 1e9), rtol=1e-5)


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


def test_the_median_of_known_values_is_that_of_numpy() -> None:
    values = np.random.default_rng(0).normal(size=(7, 6))
    values[0] = values[:3, 1] = values[1, 2] = np.nan
    for axis in (0, 1):
        with np.errstate(invalid="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of a row without values
            expected = np.nanmedian(values, axis=axis)
        np.testing.assert_array_equal(compute_known_median(values, axis), expected)


def test_masked_arrays_are_not_imported() -> None:
    code = (
        "import sys, numpy as np; from loopcal.numerics import statistics as own; "
        "own.find_distinct(np.array([2, 1, 2])); own.compute_median(np.array([0.1, 0.2])); "
        "print('numpy.ma' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


@pytest.mark.parametrize("share", [0.7, 0.9, 0.95, 0.99])
def test_quantile_of_a_weighted_sum_of_squares_is_that_of_known_distributions(share):
    for count, tolerance in ((1, 0.02), (2, 0.006), (3, 0.003), (42, 3e-5)):
        exact = compute_chi_square_quantile(count, 1.0 - share)
        found = compute_weighted_quantile(np.full(count, 2e-12), share)
        assert found == pytest.approx(2e-12 * exact, rel=tolerance)
    # weights in pairs make a sum of exponential variables: P(> x) = sum a_i exp(-x / (2 w_i))
    w = np.array([1.0, 0.3, 0.05, 1e-4])
    ratio = w[:, None] / np.where(np.eye(4, dtype=bool), np.inf, w[:, None] - w)
    a = np.where(np.eye(4, dtype=bool), 1.0, ratio).prod(axis=1)
    x = compute_weighted_quantile(np.r_[w, w, 0.0], share)
    tail = float(a @ np.exp(-x / (2.0 * w)))
    assert tail == pytest.approx(1.0 - share, rel=0.02)


def test_quantile_of_no_weight_is_zero():
    assert compute_weighted_quantile(np.zeros(3), 0.9) == 0.0
    assert compute_weighted_quantile(np.zeros(0), 0.9) == 0.0


def test_distinct_rows_are_those_of_numpy_even_where_their_sums_are_equal():
    weights = np.uint64(0x9E3779B97F4A7C15) ** np.arange(1, 3, dtype=np.uint64)
    equal = np.array([[weights[1], 0], [0, weights[0]]], dtype=np.uint64).astype(np.int64)
    for rows in (np.random.default_rng(2).integers(-2, 3, (500, 4)), equal, equal[:0]):
        distinct, member = find_distinct_rows(rows)
        assert_array_equal(distinct, np.unique(rows, axis=0))
        assert_array_equal(distinct[member], rows)
