# SPDX-License-Identifier: Apache-2.0
"""Polynomial regression on [-1, 1], whose optimal designs are known in closed form, and random
problems.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Places = NDArray[np.int64]


def polynomial(x: Array, degree: int) -> Array:
    """Rows (N, 1, degree + 1) of 1, x, x^2, ..."""
    return (x[:, None] ** np.arange(degree + 1))[:, None, :]


def grid(extra: float = 0.0) -> Array:
    """Points of [-1, 1] in steps of 0.02, and +-extra."""
    return np.unique(np.concatenate([np.arange(-50, 51) / 50, [-extra, extra]]))


def random_rows(N: int = 12, r: int = 2, own: int = 0, machine: int = 4, seed: int = 0) -> Array:
    """Rows (N, r, own + machine) of normal numbers."""
    return np.random.default_rng(seed).normal(size=(N, r, own + machine))


def covariance(rows: Array, start: Array, own: int) -> Array:
    """Covariance of the machine's unknowns by the textbook: a block of the inverse of the
    information.
    """
    stacked = np.concatenate([start, rows.reshape(-1, rows.shape[-1])])
    return np.asarray(np.linalg.inv(stacked.T @ stacked), dtype=np.float64)[own:, own:]
