# SPDX-License-Identifier: Apache-2.0
"""Will this instrument suffice? Four instruments for a hexapod.

The study is examples/studies/instruments.yaml.
"""

from __future__ import annotations

from typing import Any

from evidence.questions.example_studies import Shown, collect_study

SHOWN = Shown(("position_before_max", "position_max"), ("position_max",), levels={"poses": "40"})
IS_QUICK = False


QUICK = {"IS_QUICK": True}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert tables["answers-0"]["rows"]


def collect() -> dict[str, Any]:
    """Return answers, medians and figures of the study."""
    return collect_study("instruments", SHOWN, IS_QUICK)
