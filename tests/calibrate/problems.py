# SPDX-License-Identifier: Apache-2.0
"""What the tests of the estimators share."""

import numpy as np

from loopcal.engine import accumulate
from loopcal.linalg import empty_factor


def folded(rows: np.ndarray) -> np.ndarray:
    """Triangular factor (t, p + 1, p + 1) of rows [A | b] (t, m, p + 1)."""
    return accumulate(empty_factor(len(rows), rows.shape[-1] - 1), rows)
