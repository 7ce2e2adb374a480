# SPDX-License-Identifier: Apache-2.0
"""Distribution functions equal those of scipy, which take longer to import than numpy."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.special

from loopcal.numerics import special_functions

RELATIVE = 1e-10
"""Relative difference: rounding of logarithms near 100 in either program, times the condition of a
tail at a million degrees of freedom."""

N = 400


def draw_degrees(rng: np.random.Generator, largest: float = 5.0) -> np.ndarray:
    return 10.0 ** rng.uniform(-0.5, largest, N)


def draw_probabilities(rng: np.random.Generator) -> np.ndarray:
    """Return probabilities of both tails, and of the middle."""
    small = 10.0 ** rng.uniform(-12, 0, N // 2)
    return np.concatenate([small, 1.0 - 10.0 ** rng.uniform(-6, 0, N - N // 2)])


def spread(rng: np.random.Generator, degrees: np.ndarray) -> np.ndarray:
    """Return values about one, up to some standard deviations of a variance."""
    return np.exp(rng.normal(size=N) * np.minimum(3.0, 4.0 / np.sqrt(degrees)))


RNG = np.random.default_rng(1)
FIRST, SECOND, P = draw_degrees(RNG), draw_degrees(RNG), draw_probabilities(RNG)
COUNTS = RNG.integers(1, 5000, N)
CASES = {
    "ndtr": (RNG.normal(size=N) * 8.0,),
    "ndtri": (P,),
    "chdtrc": (FIRST, FIRST * spread(RNG, FIRST)),
    "chdtri": (FIRST, P),
    "fdtrc": (FIRST, SECOND, spread(RNG, np.minimum(FIRST, SECOND))),
    "fdtri": (FIRST, SECOND, RNG.uniform(0.001, 0.999, N)),
    "stdtr": (SECOND, RNG.normal(size=N) * 4.0),
    "stdtrit": (SECOND, P),
    "betainc": (10.0 ** RNG.uniform(-1, 3, N), 10.0 ** RNG.uniform(-1, 3, N), RNG.uniform(size=N)),
    "betaincinv": (10.0 ** RNG.uniform(0, 3, N), 10.0 ** RNG.uniform(0, 3, N), P),
    "bdtr": ((COUNTS * RNG.uniform(size=N)).astype(int), COUNTS, RNG.uniform(0.05, 0.95, N)),
    "bdtrc": ((COUNTS * RNG.uniform(size=N)).astype(int), COUNTS, RNG.uniform(0.05, 0.95, N)),
}


@pytest.mark.parametrize("name", CASES)
def test_function_is_that_of_scipy(name: str) -> None:
    ours = getattr(special_functions, name)(*CASES[name])
    theirs = getattr(scipy.special, name)(*CASES[name])
    np.testing.assert_allclose(ours, theirs, rtol=RELATIVE, atol=1e-200)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("ndtri", ([0.0, 0.5, 1.0, np.nan],)),
        ("chdtrc", ([1.0, 2.0, 3.0], [0.0, np.inf, np.nan])),
        ("chdtri", (3.0, [0.0, 1.0, np.nan, 1e-300])),
        ("fdtrc", (3.0, 4.0, [0.0, np.inf, np.nan])),
        ("fdtri", (3.0, 4.0, [0.0, 1.0])),
        ("stdtrit", ([3.0, np.inf, 5.0], [0.5, 0.975, 1.0])),
        ("bdtr", ([0, 5], 5, 0.2)),
        ("bdtrc", ([-1, 5], 5, 0.2)),
    ],
)
def test_ends_and_missing_numbers_are_those_of_scipy(name: str, arguments) -> None:
    ours = getattr(special_functions, name)(*arguments)
    theirs = getattr(scipy.special, name)(*arguments)
    np.testing.assert_allclose(ours, theirs, rtol=RELATIVE, atol=1e-15)


def test_scipy_special_is_not_imported_and_left_as_it_is() -> None:
    code = (
        "import sys; from loopcal.numerics.special_functions import fdtri; fdtri(3, 4, 0.5); "
        "print('scipy.special' in sys.modules); import scipy.special; print(scipy.special.erf(0.5))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "0.5204998778130465"]
