# SPDX-License-Identifier: Apache-2.0
"""Calibrations of hexapod-42 in which one assumption is wrong: coverage, errors and findings."""

from __future__ import annotations

from typing import Any

from evidence.assumptions.tables import collect_robot


def collect() -> dict[str, Any]:
    """Collect all cases, and compare them with those of the code before."""
    return collect_robot("hexapod-42")
