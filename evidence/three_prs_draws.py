# SPDX-License-Identifier: Apache-2.0
"""The comparison of tsvd-2016 on many 3-PRS machines: LS, RE and TSVD of the paper at their best,
and loopcal's methods.
"""

from __future__ import annotations

from typing import Any

from loopcal.papers.tsvd_2016 import steps
from loopcal.papers.tsvd_2016.results import Draws, make_curves, make_medians
from loopcal.papers.tsvd_2016.steps import RE, SIZES, TSVD, load_design, simulate_machines

DRAWS, SEED = 100, 0


QUICK = {"DRAWS": 3}


def to_document(draws: Draws, seed: int) -> dict[str, Any]:
    """Return the draws for evidence: tables by name, and which curves have an interior minimum."""
    made = (make_medians(draws), *map(make_curves, draws))
    tables = dict(zip(("medians", "curves", "curves_5"), made, strict=True))
    gain, inside = SIZES.find("gain"), {}
    for sweep in draws:
        of_sweep = inside[str(sweep.study.freedoms)] = {RE: {}, TSVD: {}}
        for algorithm, measures in of_sweep.items():
            for i, name in enumerate(steps.MEASURES[:2]):
                median = steps.compute_rise(sweep.compute_median(algorithm)[:, i]) > gain
                machines = int((sweep.compute_rises(algorithm, i) > gain).sum())
                measures[name] = {"median": median, "machines": machines}
    return {
        "robot": draws[0].study.design.name,
        "seed": seed,
        "draws": len(draws[0]),
        "minimum_inside": inside,
        "tables": {
            name: {"columns": list(table.columns), "formats": list(table.formats),
                   "rows": [list(row) for row in table.rows]}
            for name, table in tables.items()
        },
    }  # fmt: skip


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert len(tables["medians"]["rows"]) > 1


def collect() -> dict[str, Any]:
    """Collect medians with the middle half of the machines, and curves over lambda and k."""
    return to_document(simulate_machines(load_design("3-PRS"), SEED, DRAWS), SEED)
