# SPDX-License-Identifier: Apache-2.0
"""The Jacobian checker accepts a correct Jacobian and refuses a slightly wrong one."""

import numpy as np
import pytest

from loopcal import geometry as rotations
from tests.jacobians import central_difference, check_jacobian, under_jax

POINT = np.array([0.3, -1.2])


def example_function(x):
    return np.stack([np.sin(x[0]) * x[1], np.exp(x[0] * x[1]), x[0] ** 5])


DERIVATIVE = np.array(
    [
        [np.cos(POINT[0]) * POINT[1], np.sin(POINT[0])],
        [POINT[1] * np.exp(POINT[0] * POINT[1]), POINT[0] * np.exp(POINT[0] * POINT[1])],
        [5 * POINT[0] ** 4, 0.0],
    ]
)


def test_correct_jacobian_passes_in_any_units():
    check_jacobian(example_function, DERIVATIVE, POINT, scale=1.0)
    units = np.array([1e-6, 1e3])
    check_jacobian(
        lambda y: example_function(y * units), DERIVATIVE * units, POINT / units, scale=1.0 / units
    )


@pytest.mark.parametrize("place", [(0, 0), (1, 1), (2, 1)])
def test_jacobian_error_of_one_millionth_is_detected(place):
    wrong = DERIVATIVE.copy()
    wrong[place] += 1e-6
    with pytest.raises(AssertionError, match="1 entries differ from central differences"):
        check_jacobian(example_function, wrong, POINT, scale=1.0)


def test_nan_in_a_jacobian_is_detected():
    wrong = DERIVATIVE.copy()
    wrong[0, 0] = np.nan
    with pytest.raises(AssertionError):
        check_jacobian(example_function, wrong, POINT, scale=1.0)


def test_function_too_rough_for_differences_is_refused():
    with pytest.raises(AssertionError, match="too coarse to prove anything"):
        check_jacobian(
            lambda x: example_function(x) + 1e-4 * np.sin(1e7 * x[0]), DERIVATIVE, POINT, scale=1.0
        )


def test_error_bound_of_differences_holds_and_is_small():
    difference, bound = central_difference(example_function, POINT, np.ones(2))
    assert np.all(np.abs(difference - DERIVATIVE) <= bound)
    assert np.all(bound < 1e-9)  # [1], fourth-order differences of a function of size one


def test_numpy_is_restored_after_an_error_under_jax():
    def fail():
        with under_jax():
            assert vars(rotations)["np"] is not np
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert vars(rotations)["np"] is np
