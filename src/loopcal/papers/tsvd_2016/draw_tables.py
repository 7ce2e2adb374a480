# SPDX-License-Identifier: Apache-2.0
"""Tables of the drawn machines: medians, ratios of medians, curves of medians."""

from __future__ import annotations

from typing import Any

import numpy as np

from loopcal.papers.printed import Cell, Table
from loopcal.papers.tsvd_2016.draws import (
    CROSS,
    HINDSIGHT,
    METHODS,
    NARROW,
    PRIOR,
    RAW_LS,
    RAW_RE,
    RAW_TSVD,
    WHITENED,
    WIDE,
    Draws,
)
from loopcal.papers.tsvd_2016.machines import MEASURES
from loopcal.papers.tsvd_2016.situations import GAIN, RE, TSVD, Situation, has_interior_minimum
from loopcal.papers.wording import read_wording
from loopcal.typing import FloatArray

DIVERGED = "diverged"
"""Cell of a number that a diverged fit does not have."""
ROUNDING = 1e-10
"""Size below which an error [mm, deg, tolerances] is rounding."""
COMPARED = (
    RAW_LS, RAW_RE, RAW_TSVD, WHITENED, CROSS, NARROW, WIDE, HINDSIGHT,
)  # fmt: skip
"""Methods that MAP is compared with, all with 6-DOF measurement."""


def show_number(value: float) -> Cell:
    """Return a number as a cell: rounding as 0, and what is not finite as a fit that diverged."""
    if not np.isfinite(value):
        return DIVERGED
    return float(value) if abs(value) > ROUNDING else 0.0


def make_medians(draws: Draws) -> Table:
    """Return medians with their intervals."""
    rows: list[tuple[Cell, ...]] = []
    for method in METHODS:
        middle, (low, high) = draws.compute_median(method), draws.compute_interval(method)
        cells: list[Cell] = []
        for i in (0, 1, 2):
            cells += [show_number(middle[i]), f"{_format(low[i])} to {_format(high[i])}"]
        after: list[Cell] = [None, None]
        if method in draws.commanded:
            after = [show_number(x) for x in np.median(draws.commanded[method], axis=0)]
        lost = int(draws.find_diverged(method).sum())
        rows.append((method, *cells, *after, show_number(middle[3]), lost))
    words, name = read_wording(__file__), f"draws_{write_file_name(draws.name)}"
    return words.table("draws", rows, name, name=draws.name, trials=len(draws))


def make_ratios(draws: Draws) -> Table:
    """Return ratios of medians: MAP, the default kind of fit, over each of the others."""
    rows: list[tuple[Cell, ...]] = []
    for other in COMPARED:
        ratio = draws.compute_ratio(PRIOR, other)
        low, high = draws.compute_ratio_interval(PRIOR, other)
        cells = (show_number(c) for i in (0, 1) for c in (ratio[i], low[i], high[i]))
        rows.append((f"MAP over {other}", *cells))
    words, name = read_wording(__file__), f"ratios_{write_file_name(draws.name)}"
    return words.table("ratios", rows, name, name=draws.name, trials=len(draws))


def make_median_curves(situation: Situation) -> Table:
    """Return median errors at every lambda and k."""
    rows: list[tuple[Cell, ...]] = []
    for algorithm in (RE, TSVD):
        curve = np.median(situation.get_curves(algorithm), axis=0)
        short = np.median(situation.short, axis=0)[:, :2] if algorithm == RE else None
        for i, setting in enumerate(situation.get_settings(algorithm)):
            early: list[Cell] = [None, None]
            if short is not None and i > 0:
                early = [show_number(x) for x in short[i - 1]]
            cells = [show_number(error) for error in curve[i, :3]]
            rows.append((algorithm, float(setting), *cells, *early))
    words = read_wording(__file__)
    name = f"curves_{write_file_name(situation.name)}_{situation.freedoms}_machines"
    label, trials = situation.label, len(situation)
    return words.table("median_curves", rows, name, name=label, trials=trials)


def to_document(draws: Draws, seed: int) -> dict[str, Any]:
    """Return the draws for evidence: tables by name, and which curves have an interior minimum."""
    tables = {
        "medians": make_medians(draws),
        "ratios": make_ratios(draws),
        "curves": make_median_curves(draws.six),
        "curves_5": make_median_curves(draws.five),
    }
    inside = {
        str(situation.freedoms): {
            algorithm: {
                measure: {
                    "median": has_interior_minimum(_take_median(situation, algorithm, i)),
                    "machines": int((situation.compute_rises(algorithm, i) > GAIN).sum()),
                }
                for i, measure in enumerate(MEASURES[:2])
            }
            for algorithm in (RE, TSVD)
        }
        for situation in draws.situations
    }
    return {
        "robot": draws.name,
        "seed": seed,
        "draws": len(draws),
        "minimum_inside": inside,
        "tables": {
            name: {
                "columns": list(t.columns),
                "formats": list(t.formats),
                "rows": [list(row) for row in t.rows],
            }
            for name, t in tables.items()
        },
    }


def write_file_name(name: str) -> str:
    """Return the name of a manipulator in file names."""
    return name.lower().replace("-", "_")


def _take_median(situation: Situation, algorithm: str, measure: int) -> FloatArray:
    return np.median(situation.get_curves(algorithm)[:, :, measure], axis=0)


def _format(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else DIVERGED
