# SPDX-License-Identifier: Apache-2.0
"""The comparison of tsvd-2016 on many 3-PRS machines: LS, RE and TSVD of the paper at their best,
and loopcal's methods.
"""

from __future__ import annotations

from typing import Any

from loopcal.papers.tsvd_2016.results import to_document
from loopcal.papers.tsvd_2016.steps import draw_machines

DRAWS, SEED = 100, 0


QUICK = {"DRAWS": 3}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert len(tables["medians"]["rows"]) > 1


def collect() -> dict[str, Any]:
    """Collect medians with bootstrap intervals, ratios, and curves over lambda and k."""
    return to_document(draw_machines("3-PRS", SEED, DRAWS), SEED)
