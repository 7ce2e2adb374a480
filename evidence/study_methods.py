# SPDX-License-Identifier: Apache-2.0
"""Which method should I use? Six methods for a five-bar robot.

The study is examples/studies/methods.yaml.
"""

from __future__ import annotations

from typing import Any

from evidence.questions.example_studies import Shown, collect_study

SHOWN = Shown(("position", "covered_position"), ("position", "covered_position"), "method")
IS_QUICK = False


QUICK = {"IS_QUICK": True}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert tables["scores"]["rows"]


def collect() -> dict[str, Any]:
    """Return answers, medians and figures of the study."""
    return collect_study("methods", SHOWN, IS_QUICK)
