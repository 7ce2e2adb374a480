# SPDX-License-Identifier: Apache-2.0
"""How often a test warns of data with which nothing is wrong, or widens their uncertainty."""

from collections.abc import Mapping

FALSE_ALARMS: Mapping[str, float] = {
    "noise": 0.002,  # residuals too large, and too small, for the stated sigma
    "doubtful noise": 0.004,  # the same where few degrees of freedom are left
    "tolerances": 0.003,
    "tolerance components": 0.009,  # as measured; they are chosen by odds, see `PRIOR_ODDS`
    "outliers": 0.01,
    "causes of residuals": 0.009,  # as measured; chosen by odds, see `error_causes.EXCLUDED`
    "correlation of neighbors": 0.002,
    "model discrepancy": 0.004,
    "motion of frames": 0.002,
    "heavy tails": 0.001,
    "held-out rows": 0.001,
}
"""Probability that each test of a calibration rejects where every assumption holds. Together they
are below 5 %, and `compute_single_level` divides each one among the tests of its kind.
"""
