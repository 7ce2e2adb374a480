# SPDX-License-Identifier: Apache-2.0
"""Sums of joint values: s = W joints, with a weight for each reading and driven joint.

A belt or cable over several pulleys, a differential and a coupled wrist have readings that are such
sums. Weights are (t | 1, a, J); the engine knows joint values only. Derivation:
docs/theory/summed-drives.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import FloatArray

SINGULAR = 1e-9
"""Ratio of singular values of weights, each row divided by its largest weight, below which they are
singular."""


def apply_weights(weights: FloatArray, values: FloatArray) -> FloatArray:
    """Return W values (t, n, a) of values (t | 1, n, J)."""
    return np.matmul(values, np.swapaxes(weights, -1, -2))


def invert_weights(weights: FloatArray) -> FloatArray:
    """Return the inverses of matrices (.., J, J), NaN where one is singular or not finite."""
    finite = np.all(np.isfinite(weights), axis=(-1, -2), keepdims=True)
    unit = np.eye(weights.shape[-1])
    weights = np.where(finite, weights, unit)
    with np.errstate(all="ignore"):
        try:
            inverse = np.linalg.inv(weights)
        except np.linalg.LinAlgError:
            rank = np.asarray(np.linalg.matrix_rank(weights))[..., None, None]
            finite = finite & (rank == len(unit))
            inverse = np.linalg.inv(np.where(finite, weights, unit))
        return np.where(finite, inverse, np.nan)


def count_independent(weights: FloatArray) -> int:
    """Return how many rows of W (a, J) are independent."""
    scale = np.abs(weights).max(axis=1, initial=0.0, keepdims=True)
    s = np.linalg.svd(weights / np.where(scale > 0.0, scale, 1.0), compute_uv=False)
    return int(are_nonzero(s, SINGULAR).sum())
