# SPDX-License-Identifier: Apache-2.0
"""Calibration from planes and perpendicular lines: errors by noise over many draws, and what coordinate exchange gains."""

from __future__ import annotations

import time
from typing import Any

from loopcal.calibrate.plan.groups import PlaneAndLine
from loopcal.linalg import FloatArray
from loopcal.mechanism import Mechanism
from loopcal.papers.cmm_constraint_2011.cells import BEFORE, LS, PRIOR, Cell, cell, grid
from loopcal.papers.cmm_constraint_2011.layouts import ONE, arranged
from loopcal.papers.cmm_constraint_2011.published import MM
from loopcal.papers.cmm_constraint_2011.study import AXES, GROUPS, MEASURES, POINTS, SWEEPS, Study, machine, plan, spread

SEED, DRAWS, STARTS, FEW = 0, 200, 5, 40
INDEPENDENT = (1.0, 0.01)
"""Errors and noise [mm] of the cell that is looked at with rows taken as independent, too."""


def once(planned: PlaneAndLine, design: FloatArray) -> float:
    """Seconds of one evaluation of every group's rows for each level of each coordinate."""
    began = time.process_time()
    for c, values in enumerate(planned.levels()):
        for value in values:
            moved = design.copy()
            moved[:, c] = value
            planned.rows(moved)
    return time.process_time() - began


def start(robot: Mechanism, seed: int) -> tuple[Study, list]:
    """Coordinate exchange from one random start: the study, and its row."""
    began = time.process_time()
    study = plan(robot, GROUPS, POINTS, AXES, seed, SWEEPS)
    spent = time.process_time() - began
    before, after = (spread(rows) for rows in (study.planned.rows(study.first), study.optimised.rows))
    cost = spent / once(study.planned, study.first) if seed == SEED else None
    return study, [seed, before, after, before / after, spent, cost]


def medians(c: Cell) -> list[float]:
    """Aligned and absolute position errors and the parameters', before, LS and MAP."""
    chosen = [MEASURES.index(name) for name in ("position, aligned [mm]", "position [mm]", "parameters without gauge [mm]")]
    return [float(c.median(m)[i]) for i in chosen for m in (BEFORE, LS, PRIOR)]


def collect() -> dict[str, Any]:
    """The 3 x 4 cells, the five starts, and one plane against ten."""
    robot = machine()
    study, first = start(robot, SEED)
    starts = [first, *(start(robot, seed)[1] for seed in range(SEED + 1, SEED + STARTS))]
    cells = grid(study, SEED, DRAWS, lambda _: None)
    rows = [[given, noise, *medians(c), c.worse(PRIOR, 2), c.failed] for (given, noise), c in cells.items()]
    single = cell(study, INDEPENDENT[0] * MM, INDEPENDENT[1] * MM, SEED, DRAWS, weights="single")
    ten, one = cells["1", "0.01"], arranged(ONE, plan(robot, 1, GROUPS * POINTS, AXES, SEED, sweeps=1), SEED, FEW)
    layouts = [
        ["ten planes, a line each", first[1], first[2], *_pair(ten), DRAWS],
        ["the same, rows taken as independent", None, None, *_pair(single), DRAWS],
        ["one plane, one line", one.drawn, one.optimised, *_pair(one.cell), FEW],
    ]
    names = [f"{what}, {m}" for what in ("position, aligned [mm]", "position, absolute [mm]", "parameters without gauge [mm]")
             for m in (BEFORE, LS, PRIOR)]  # fmt: skip
    return {
        "seed": SEED,
        "draws": DRAWS,
        "tables": {
            "table_3": {
                "columns": ["errors [mm]", "noise [mm]", *names, f"made worse by MAP, of {DRAWS}", "not converged"],
                "formats": ["", "", *[".2g"] * 9, "d", "d"],
                "rows": rows,
            },
            "exchange": {
                "columns": ["start", "drawn [mm / mm]", "optimised [mm / mm]", "gain", "CPU [s]", "cost [evaluations]"],
                "formats": ["d", ".3g", ".3g", ".2g", ".2g", ".2g"],
                "rows": starts,
            },
            "layouts": {
                "columns": ["100 points on", "drawn [mm / mm]", "optimised [mm / mm]", "LS [mm]", "MAP [mm]", "draws"],
                "formats": ["", ".3g", ".3g", ".3g", ".3g", "d"],
                "rows": layouts,
            },
        },
    }


def _pair(c: Cell) -> list[float]:
    """Aligned position error by LS and MAP."""
    return [float(c.median(m)[MEASURES.index("position, aligned [mm]")]) for m in (LS, PRIOR)]
