# SPDX-License-Identifier: Apache-2.0
"""Triangular systems agree with LAPACK's routine for triangles, also ill-conditioned ones."""

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from loopcal.numerics.decomposition import substitute_backward, substitute_transposed

SYSTEMS = ((substitute_backward, 0), (substitute_transposed, 1))


@pytest.fixture(params=[1.0, 1e-4, 1e-9])
def system(request):
    """A triangle whose diagonal falls by the factor from its first to its last entry."""
    rng = np.random.default_rng(5)
    R = np.linalg.qr(rng.normal(size=(60, 40)), mode="r")
    return R * np.geomspace(1.0, request.param, 40)[:, None], rng.normal(size=(40, 7))


@pytest.mark.parametrize(("substitute", "trans"), SYSTEMS)
def test_the_solution_is_that_of_lapack(system, substitute, trans) -> None:
    R, b = system
    expected = solve_triangular(R, b, trans=trans)
    error = np.abs(substitute(R, b) - expected).max(axis=0)
    assert (error <= 1e-12 * np.abs(expected).max(axis=0)).all()  # 40 rounded sums, condition 50


@pytest.mark.parametrize("substitute", [substitute for substitute, _ in SYSTEMS])
def test_a_zero_on_the_diagonal_is_refused(substitute) -> None:
    R = np.triu(np.ones((3, 3)))
    R[1, 1] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        substitute(R, np.ones((3, 1)))
