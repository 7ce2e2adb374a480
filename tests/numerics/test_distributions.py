# SPDX-License-Identifier: Apache-2.0
"""Our probabilities and quantiles against those of scipy."""

import numpy as np
import pytest
import scipy.special

import loopcal.numerics.distributions as ours
from loopcal.numerics.distributions import FEW

RNG = np.random.default_rng(0)
N = 200
K, LEFT = 10.0 ** RNG.uniform(-0.3, 4.0, (2, N))
P, X = RNG.uniform(0.0, 1.0, N) ** 3, RNG.normal(0.0, 3.0, N)
NEAR = np.exp(X / np.sqrt(np.minimum(K, LEFT)))

CASES = [
    ("normal_probability", "ndtr", (X,)),
    ("normal_quantile", "ndtri", (P,)),
    ("chi_square_tail", "chdtrc", (K, K * NEAR)),
    ("chi_square_quantile", "chdtri", (K, P)),
    ("f_tail", "fdtrc", (K, LEFT, NEAR)),
    ("f_quantile", "fdtri", (K, LEFT, 1.0 - P)),
    ("student_probability", "stdtr", (K, X)),
    ("student_quantile", "stdtrit", (K, P)),
    ("beta_probability", "betainc", (K, LEFT, 1.0 / (1.0 + LEFT / K * NEAR))),
    ("binomial_tail", "bdtrc", (np.floor(P * 300.0), np.full(N, 300), P[::-1])),
]


@pytest.mark.parametrize(("name", "of_scipy", "arguments"), CASES)
def test_values_are_those_of_scipy(name, of_scipy, arguments) -> None:
    expected = getattr(scipy.special, of_scipy)(*arguments)
    # both lose digits in proportion to the degrees of freedom, at most 1e4
    np.testing.assert_allclose(getattr(ours, name)(*arguments), expected, rtol=1e-11, atol=1e-250)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (ours.chi_square_tail([3, 3, 3], [0.0, np.inf, np.nan]), [1.0, 0.0, np.nan]),
        (ours.f_tail(2, 3, [0.0, np.inf, np.nan]), [1.0, 0.0, np.nan]),
        (ours.chi_square_quantile(3, [0.0, 1.0, np.nan]), [np.inf, 0.0, np.nan]),
        (ours.f_quantile(2, 3, [0.0, 1.0]), [0.0, np.inf]),
        (ours.normal_quantile([0.0, 0.5, 1.0, np.nan]), [-np.inf, 0.0, np.inf, np.nan]),
        (ours.student_quantile(4, [0.0, 0.5, 1.0]), [-np.inf, 0.0, np.inf]),
        (ours.student_probability(np.inf, [-1.0]), scipy.special.ndtr([-1.0])),
        (ours.binomial_tail([-1, 5, 6], 5, 0.2), [1.0, 0.0, 0.0]),
        (ours.beta_probability(2, 3, [0.0, 1.0]), [0.0, 1.0]),
        # far tails, from their first digits: exp(-x / 2) for two degrees of freedom
        (ours.chi_square_tail(2, [1400.0]), np.exp([-700.0])),
        (ours.chi_square_quantile(2, [1e-300]), [-2.0 * np.log(1e-300)]),
    ],
)
def test_ends_and_tails(value, expected) -> None:
    np.testing.assert_allclose(value, expected, rtol=1e-13)


def test_many_values_are_those_of_a_few() -> None:
    k = np.linspace(1.0, 50.0, FEW + 1)
    many = ours.chi_square_quantile(k, 0.05)
    np.testing.assert_allclose(many[::400], ours.chi_square_quantile(k[::400], 0.05), rtol=1e-13)
    assert ours.chi_square_tail(np.zeros((0, 3)), 1.0).shape == (0, 3)


@pytest.mark.parametrize("degrees", [1.0, 100.0, 4287.0, 1e5, 1e7])
def test_quantile_of_any_degrees_of_freedom_takes_few_steps(monkeypatch, degrees) -> None:
    """The rounding of thousands of degrees kept Newton's steps above the smallest one."""
    calls, split = [], ours._split_beta

    def count(*arguments):
        calls.append(arguments)
        return split(*arguments)

    monkeypatch.setattr(ours, "_split_beta", count)
    for probability in (0.6, 0.975, 1e-6):
        calls.clear()
        found = ours._find_student_quantile(degrees, probability)
        assert found == pytest.approx(scipy.special.stdtrit(degrees, probability), rel=1e-10)
        assert len(calls) < 80


@pytest.mark.parametrize("degrees", [1e9, 1e13, 1e17, 1e30])
def test_so_many_degrees_of_freedom_that_rounding_decides_give_limits(degrees) -> None:
    """The series would need a share of the root of the degrees; its two halves are equal."""
    assert ours.student_quantile(degrees, 0.975) == pytest.approx(1.959963984540054)
    assert ours.beta_probability(degrees, degrees, 0.5) == pytest.approx(0.5)
    assert ours.chi_square_quantile(degrees, 0.05) == pytest.approx(degrees, rel=1e-4)
