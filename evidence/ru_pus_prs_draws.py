# SPDX-License-Identifier: Apache-2.0
"""The comparison of tsvd-2016 on many RU-PUS-PRS machines; fewer than for the 3-PRS, because
diverging fits take long.
"""

from __future__ import annotations

from typing import Any

from evidence.three_prs_draws import to_document
from loopcal.papers.tsvd_2016.steps import load_design, simulate_machines

DRAWS, SEED = 50, 0


QUICK = {"DRAWS": 3}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert len(tables["medians"]["rows"]) > 1


def collect() -> dict[str, Any]:
    """Collect medians with the middle half of the machines, and curves over lambda and k."""
    return to_document(simulate_machines(load_design("RU-PUS-PRS"), SEED, DRAWS), SEED)
