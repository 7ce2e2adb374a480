# SPDX-License-Identifier: Apache-2.0
"""A basis of columns: orthonormal, of the right rank, for columns of very different lengths."""

from __future__ import annotations

import numpy as np
import pytest

from loopcal.numerics.split_columns import span_columns as span
from loopcal.numerics.split_columns import split_columns


def span_columns(columns):
    """Return the basis of columns that are listed row by row."""
    places = np.broadcast_to(np.arange(columns.shape[1]), columns.shape)
    return span(split_columns([(columns, places)], columns.shape[1])[0]).toarray()


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


def test_columns_of_sessions_are_decomposed_on_their_own(monkeypatch):
    rng = np.random.default_rng(0)
    columns = np.zeros((240, 40))
    for i in range(12):  # sessions of 20 rows and three columns, of which one depends on the others
        own = rng.standard_normal((20, 3))
        own[:, 2] = own[:, 0] - 2.0 * own[:, 1]
        columns[20 * i : 20 * (i + 1), 3 * i : 3 * (i + 1)] = own
    columns[:, 36:39] = rng.standard_normal((240, 3))
    columns[:, 39] = columns[:, :39] @ rng.standard_normal(39)
    order = rng.permutation(240), rng.permutation(40)
    mixed = columns[np.ix_(*order)]
    whole = np.linalg.svd(mixed, full_matrices=False)[0][:, : 2 * 12 + 3]
    sizes, decompose = [], np.linalg.svd
    monkeypatch.setattr(
        np.linalg, "svd", lambda a, **how: (sizes.append(a.shape[-2:]), decompose(a, **how))[1]
    )
    basis = span_columns(mixed)
    assert basis.shape == (240, 27)
    assert np.allclose(basis @ basis.T, whole @ whole.T, atol=1e-10)
    assert max(map(max, sizes)) <= 4
