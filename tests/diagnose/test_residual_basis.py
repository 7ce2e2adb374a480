# SPDX-License-Identifier: Apache-2.0
"""A basis of columns: orthonormal, of the right rank, for columns of very different lengths."""

from __future__ import annotations

import numpy as np
import pytest

from loopcal.diagnose.residual_patterns import span_columns


@pytest.mark.parametrize("rows", [12, 300, 6000])
def test_a_basis_spans_the_columns_whatever_their_lengths(rows):
    rng = np.random.default_rng(rows)
    columns = rng.standard_normal((rows, 8)) * 10.0 ** rng.uniform(-150, 150, 8)
    columns[:, 3] = 0.0
    columns[:, 5] = 1e3 * columns[:, 4] + 1e-12 * np.abs(columns[:, 4]).max()
    basis = span_columns(columns)
    assert basis.shape == (rows, 6)
    assert np.allclose(basis.T @ basis, np.eye(6), atol=1e-12)
    unit = columns / np.where(
        np.linalg.norm(columns, axis=0) > 0, np.linalg.norm(columns, axis=0), 1
    )
    assert np.allclose(basis @ (basis.T @ unit), unit, atol=1e-5)


def test_columns_that_are_zero_span_nothing():
    assert span_columns(np.zeros((5, 3))).shape == (5, 0)
    assert span_columns(np.zeros((5, 0))).shape == (5, 0)


def test_graded_columns_of_a_large_fit_have_a_basis():
    """Singular values over 16 decades with repeats: a divide-and-conquer driver may fail here."""
    rng = np.random.default_rng(0)
    u, _ = np.linalg.qr(rng.standard_normal((1500, 70)))
    v, _ = np.linalg.qr(rng.standard_normal((70, 70)))
    s = np.repeat(10.0 ** -np.arange(0.0, 17.5, 0.5), 2)
    assert span_columns((u * s) @ v.T).shape[1] < 70
