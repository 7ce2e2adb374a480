# SPDX-License-Identifier: Apache-2.0
"""Calibrations of linear-delta in which one assumption is wrong: coverage, errors and findings."""

from __future__ import annotations

from typing import Any

from evidence.assumptions.tables import collect_robot

FITS = 400


QUICK = {"FITS": 3}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(row[1] == FITS for row in tables["coverage"]["rows"])


def collect() -> dict[str, Any]:
    """Collect all cases, and compare them with those of the code before."""
    return collect_robot("linear-delta", FITS)
