# SPDX-License-Identifier: Apache-2.0
"""The stated false-alarm levels of the findings, by groups of codes that share one level."""

from __future__ import annotations

STATED_LEVELS = {
    "noise.doubtful": 0.01,
    "noise.residuals-too-large": 0.001,
    "noise.residuals-too-small": 0.001,
    "outliers": 0.05,
    "prior.components-inflated": 0.03,
    "prior.tolerances": 0.01,
    "residuals.common-errors": 0.01,
    "residuals.heavy-tailed": 0.001,
    "residuals.model-discrepancy": 0.05,
    "residuals.patterns": 0.05,
    "residuals.perhaps-correlated": 0.001,  # of results that were made before it was removed
}
"""Stated probabilities of alarms where every assumption holds, by group of codes."""

PATTERNS = ("drift", "trend", "sessions-differ", "depend-on", "correlated", "shared")
"""Beginnings of the codes of the residuals that share one level."""


def name_group(code: str) -> str:
    """Return the group of codes that share the level of a code; the code itself without one."""
    subject, name = code.split(".", 1)
    if subject == "outliers":
        return "outliers"
    if subject == "residuals" and name.startswith(PATTERNS):
        return "residuals.patterns"
    return next((group for group in STATED_LEVELS if code.startswith(group)), code)
