# SPDX-License-Identifier: Apache-2.0
"""Calibration with planes and perpendicular lines: errors by noise over many draws, and the gain
of coordinate exchange.
"""

from __future__ import annotations

import time
from typing import Any

from loopcal.papers.cmm_constraint_2011 import steps
from loopcal.papers.cmm_constraint_2011.steps import (
    ALIGNED,
    BEFORE,
    FRAMES,
    LS,
    METHODS,
    MM,
    ONE,
    PRIOR,
    SIZES,
    TEN,
    WEIGHTS,
    Cell,
    Study,
    calibrate_fifty,
    calibrate_figure_5,
    calibrate_grid,
    compare_estimates,
    compute_rank_correlation,
    draw_true_machines,
    list_printed,
    plan_points,
    rank_candidates,
)
from loopcal.planning.plane_line_planning import PlaneLineGroups
from loopcal.typing import FloatArray

SEED, DRAWS, STARTS, FEW_DRAWS, DRAWS_PER_INTERPRETATION = 0, 200, 5, 40, 60
MACHINES = 50
"""Identified with surfaces as unknowns."""
WEIGHT_NAMES = {
    "printed": "as printed: weight one",
    "distance": "divided by the distance d_1",
    "single": "divided by the sd of each, taken as independent",
    "full": "with their covariance",
}
"""Names of the weights of the rows."""


def time_linearization(planned: PlaneLineGroups, design: FloatArray) -> float:
    """Return the CPU time [s] of all rows at each level of each coordinate."""
    began = time.process_time()
    for c, values in enumerate(planned.list_levels()):
        for value in values:
            moved = design.copy()
            moved[:, c] = value
            planned.linearize(moved)
    return time.process_time() - began


def optimize_from_start(seed: int) -> tuple[Study, list]:
    """Run coordinate exchange from one random start; return the study and its row."""
    began = time.process_time()
    study = plan_points(seed=seed)
    spent = time.process_time() - began
    before, after = study.spreads
    cost = spent / time_linearization(study.planned, study.first) if seed == SEED else None
    return study, [seed, before, after, before / after, spent, cost]


MEDIANS = {
    "position, aligned [mm]": "position, aligned [mm]",
    "position, absolute [mm]": "position [mm]",
    "position, gauge at nominal [mm]": "position, gauge at nominal [mm]",
    "parameters without gauge [mm]": "parameters without gauge [mm]",
}
"""Columns of Table 3: their names in MEASURES."""


def list_medians(c: Cell) -> list[float]:
    """Return errors of position in each frame and of parameters: before, LS and MAP."""
    return [c.compute_median(m, name) for name in MEDIANS.values() for m in (BEFORE, LS, PRIOR)]


def compare_weights(study: Study) -> list[list[Any]]:
    """Return errors by LS and MAP for each weighting of the rows, and the ratio of LS to that as
    printed.
    """
    cells = {w: calibrate_figure_5(study, SEED, DRAWS, weights=w) for w in WEIGHTS}
    position, parameters = "position, aligned [mm]", "parameters without gauge [mm]"
    first = cells["printed"].compute_median(LS, position)
    return [
        [
            WEIGHT_NAMES[w],
            *(c.compute_median(m, name) for name in (position, parameters) for m in (LS, PRIOR)),
            c.compute_median(LS, position) / first,
        ]
        for w, c in cells.items()
    ]


def compare_interpretations(study: Study) -> list[list[Any]]:
    """Return figure 5 as printed and under every interpretation."""
    result = rank_candidates({TEN: study}, SEED, DRAWS_PER_INTERPRETATION)
    names = ("reading", "truth", "frame", "parameters", "position", "orientation")
    rows = [[row[name] for name in names] for row in result]
    return [["as printed", None, None, *map(float, list_printed())], *rows]


def identify_with_surfaces(study: Study) -> list[list[Any]]:
    """Return on how many machines fits with surfaces as unknowns converge, and how far their
    estimates are from those of the paper's rows.
    """
    forms = SIZES.find("forms")
    noise = max(forms["noises"]) * MM
    q = study.layout.solve_readings(
        draw_true_machines(study.robot, forms["errors"] * MM, MACHINES, SEED), noise, SEED
    )
    rows = (compare_estimates(study.layout, q, noise, name) for name in METHODS)
    return [
        [
            row["method"],
            f"{row['converged']} of {row['machines']}",
            *(row[name] for name in ("iterations", "median", "largest")),
        ]
        for row in rows
    ]


def compare_fifty_points(study: Study) -> list[list[Any]]:
    """Return mean position errors before, by LS and by MAP in each frame, and the share of LS fits
    that converge within 5 iterations.
    """
    position, planes = steps.STATISTICS[0], SIZES.find("fifty", "planes")
    cells = {groups: calibrate_fifty(study, groups, SEED, FEW_DRAWS) for groups in planes}
    return [
        [
            groups,
            frame,
            *(cell.compute_median(m, f"{position}, {frame}") for m in (BEFORE, LS, PRIOR)),
            cell.within_five if frame == ALIGNED else None,
        ]
        for groups, cell in cells.items()
        for frame in FRAMES
    ]


QUICK = {"DRAWS": 8, "STARTS": 1, "FEW_DRAWS": 3, "DRAWS_PER_INTERPRETATION": 4, "MACHINES": 4}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    _, before, after, gain, *_ = tables["exchange"]["rows"][0]
    assert after < before
    assert gain > 1.0


def collect() -> dict[str, Any]:
    """Collect the 3 x 4 cells, five starts, one plane and ten, weights, interpretations of
    figure 5, and fifty points.
    """
    study, first = optimize_from_start(SEED)
    starts = [first, *(optimize_from_start(seed)[1] for seed in range(SEED + 1, SEED + STARTS))]
    cells = calibrate_grid(study, SEED, DRAWS, lambda _: None)
    rows = [
        [given, noise, *list_medians(c), c.count_worse(PRIOR, "position, aligned [mm]"), c.failed]
        for (given, noise), c in cells.items()
    ]
    plan = plan_points(1, 100, seed=SEED, sweeps=1)
    one = calibrate_figure_5(plan, SEED, FEW_DRAWS)
    placed = [
        [TEN, first[1], first[2], *_pair(cells["1", "0.01"]), DRAWS],
        [ONE, *plan.spreads, *_pair(one), FEW_DRAWS],
    ]
    ranks = [
        [
            method,
            compute_rank_correlation(cells.values(), method),
            len(cells),
            len({c.ratio for c in cells.values()}),
        ]
        for method in METHODS
    ]
    table_3 = [f"{what}, {m}" for what in MEDIANS for m in (BEFORE, LS, PRIOR)]
    return {
        "seed": SEED,
        "draws": DRAWS,
        "tables": {
            "table_3": make_table(
                [
                    "errors [mm]",
                    "noise [mm]",
                    *table_3,
                    f"made worse by MAP, of {DRAWS}",
                    "not converged",
                ],
                ["", "", *[".2g"] * len(table_3), "d", "d"],
                rows,
            ),
            "exchange": make_table(
                [
                    "start",
                    "random [mm / mm]",
                    "optimized [mm / mm]",
                    "gain",
                    "CPU [s]",
                    "cost [evaluations]",
                ],
                ["d", ".3g", ".3g", ".2g", ".2g", ".2g"],
                starts,
            ),
            "layouts": make_table(
                [
                    "100 points on",
                    "random [mm / mm]",
                    "optimized [mm / mm]",
                    "LS [mm]",
                    "MAP [mm]",
                    "draws",
                ],
                ["", ".3g", ".3g", ".3g", ".3g", "d"],
                placed,
            ),
            "weights": make_table(
                [
                    "rows",
                    *(
                        f"{what}, {m}"
                        for what in ("position, aligned [mm]", "parameters [mm]")
                        for m in (LS, PRIOR)
                    ),
                    "position, LS, as printed = 1",
                ],
                ["", ".3g", ".3g", ".3g", ".3g", ".2f"],
                compare_weights(study),
            ),
            "readings": make_table(
                [
                    'interpretation of "variance"',
                    "true errors in",
                    "frame",
                    "parameters [%]",
                    "position [%]",
                    "orientation [%]",
                ],
                ["", "", "", ".0f", ".0f", ".0f"],
                compare_interpretations(study),
            ),
            "fifty": make_table(
                [
                    "planes",
                    "frame",
                    "before [mm]",
                    "LS [mm]",
                    "MAP [mm]",
                    "LS converged within 5 iterations [%]",
                ],
                ["d", "", ".2g", ".2g", ".2g", ".0f"],
                compare_fifty_points(study),
            ),
            "surfaces": make_table(
                [
                    "method",
                    "both forms converged",
                    "most iterations",
                    "difference of the estimates, median [sd]",
                    "largest [sd]",
                ],
                ["", "", "d", ".1e", ".1e"],
                identify_with_surfaces(study),
            ),
            "correlation": make_table(
                ["method", "rank correlation", "cells", "ratios"], ["", ".2f", "d", "d"], ranks
            ),
        },
    }


def make_table(columns: list[str], formats: list[str], rows: list[list[Any]]) -> dict[str, Any]:
    """Return a table as evidence/README.md describes it."""
    return {"columns": columns, "formats": formats, "rows": rows}


def _pair(c: Cell) -> list[float]:
    """Return the aligned position errors by LS and MAP."""
    return [c.compute_median(m, "position, aligned [mm]") for m in (LS, PRIOR)]
