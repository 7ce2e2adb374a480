# SPDX-License-Identifier: Apache-2.0
"""How many poses do I need? Random and planned poses of a linear delta.

The study is examples/studies/poses.yaml.
"""

from __future__ import annotations

from typing import Any

from evidence.questions.example_studies import Shown, collect_study

SHOWN = Shown(("position_before_max", "position_max"), ("position_max",), levels={"noise": "1"})
IS_QUICK = False


QUICK = {"IS_QUICK": True}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert tables["answers-0"]["rows"]


def collect() -> dict[str, Any]:
    """Return answers, medians and figures of the study."""
    return collect_study("poses", SHOWN, IS_QUICK)
