# SPDX-License-Identifier: Apache-2.0
"""Array types, defined once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Numbers in SI units, double precision."""

IntArray = NDArray[np.int64]
"""Counts, positions in a table, or status codes."""

BoolArray = NDArray[np.bool_]
"""Yes or no, element by element."""
