# SPDX-License-Identifier: Apache-2.0
"""Levels and probabilities where several tests are made at once.

Without any effect, n independent tests of level a find something with the probability
1 - (1 - a)^n; for positively correlated ones it is smaller. Source: Sidak, Rectangular confidence
regions for the means of multivariate normal distributions, J. Am. Stat. Assoc. 62 (1967), 626-633.
"""

from __future__ import annotations

import numpy as np

NEAR_ONE = 1.0 - 1e-16
"""Largest probability of a test whose complement a double still has."""


def compute_any_probability(p_value: float, tests: int) -> float:
    """Return the probability 1 - (1 - p)^n that any of n tests is as significant; p without any."""
    return float(-np.expm1(max(tests, 1) * np.log1p(-min(p_value, NEAR_ONE))))


def compute_single_level(level: float, tests: int) -> float:
    """Return the level 1 - (1 - a)^(1 / n) of each of n tests, of which any finds something with
    the probability a; a itself without any test.
    """
    return float(-np.expm1(np.log1p(-min(level, NEAR_ONE)) / max(tests, 1)))
