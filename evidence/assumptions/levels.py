# SPDX-License-Identifier: Apache-2.0
"""The stated false-alarm levels of the findings, by groups of codes that share one level."""

from __future__ import annotations

from loopcal.estimate.residual_test import FALSE_ALARMS

STATED_LEVELS = {
    "noise.doubtful": FALSE_ALARMS["doubtful noise"],
    "noise.residuals-too-large": 0.5 * FALSE_ALARMS["noise"],
    "noise.residuals-too-small": 0.5 * FALSE_ALARMS["noise"],
    "outliers": FALSE_ALARMS["outliers"],
    "prior.components-inflated": FALSE_ALARMS["tolerance components"],
    "prior.tolerances": FALSE_ALARMS["tolerances"],
    "residuals.causes": FALSE_ALARMS["causes of residuals"],
    "residuals.correlated": FALSE_ALARMS["correlation of neighbors"],
    "residuals.heavy-tailed": FALSE_ALARMS["heavy tails"],
    "residuals.model-discrepancy": FALSE_ALARMS["model discrepancy"],
}
"""Stated probabilities of alarms where every assumption holds, by group of codes."""

CAUSES = ("drift", "trend", "sessions-differ", "depend-on", "shared", "drive-errors", "backlash")
"""Beginnings of the codes of the residuals that share one level: causes of these."""


def name_group(code: str) -> str:
    """Return the group of codes that share the level of a code; the code itself without one."""
    subject, name = code.split(".", 1)
    if subject == "outliers":
        return "outliers"
    if subject == "residuals" and name.startswith(CAUSES):
        return "residuals.causes"
    return next((group for group in STATED_LEVELS if code.startswith(group)), code)
