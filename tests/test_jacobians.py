# SPDX-License-Identifier: Apache-2.0
"""The Jacobian checker itself: it passes what is right and fails what is slightly wrong."""

import numpy as np
import pytest

from loopcal.geometry import rotations
from tests.jacobians import central_difference, check_jacobian, under_jax

X = np.array([0.3, -1.2])


def curve(x):
    return np.stack([np.sin(x[0]) * x[1], np.exp(x[0] * x[1]), x[0] ** 5])


SLOPES = np.array(
    [
        [np.cos(X[0]) * X[1], np.sin(X[0])],
        [X[1] * np.exp(X[0] * X[1]), X[0] * np.exp(X[0] * X[1])],
        [5 * X[0] ** 4, 0.0],
    ]
)


def test_a_right_jacobian_passes_whatever_the_units_of_the_unknowns():
    check_jacobian(curve, SLOPES, X, scale=1.0)
    units = np.array([1e-6, 1e3])
    check_jacobian(lambda y: curve(y * units), SLOPES * units, X / units, scale=1.0 / units)


@pytest.mark.parametrize("place", [(0, 0), (1, 1), (2, 1)])
def test_an_error_of_a_millionth_is_found(place):
    wrong = SLOPES.copy()
    wrong[place] += 1e-6
    with pytest.raises(AssertionError, match="1 entries differ from central differences"):
        check_jacobian(curve, wrong, X, scale=1.0)


def test_a_nan_is_found():
    wrong = SLOPES.copy()
    wrong[0, 0] = np.nan
    with pytest.raises(AssertionError):
        check_jacobian(curve, wrong, X, scale=1.0)


def test_a_function_too_rough_to_prove_anything_fails():
    with pytest.raises(AssertionError, match="too coarse to prove anything"):
        check_jacobian(lambda x: curve(x) + 1e-4 * np.sin(1e7 * x[0]), SLOPES, X, scale=1.0)


def test_the_bound_of_the_differences_holds_and_is_small():
    difference, bound = central_difference(curve, X, np.ones(2))
    assert np.all(np.abs(difference - SLOPES) <= bound)
    assert np.all(bound < 1e-9)  # [1], fourth-order differences of a function of size one


def test_numpy_is_back_in_its_place_after_jax_even_after_an_error():
    def fail():
        with under_jax():
            assert vars(rotations)["np"] is not np
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert vars(rotations)["np"] is np
