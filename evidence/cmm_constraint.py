# SPDX-License-Identifier: Apache-2.0
"""Calibration with planes and perpendicular lines: errors by noise over many draws, and the gain
of coordinate exchange.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from loopcal.papers.cmm_constraint_2011 import results as steps
from loopcal.papers.cmm_constraint_2011.results import (
    ABSOLUTE,
    ALIGNED,
    AT_NOMINAL,
    BEFORE,
    CASE,
    DETERMINED,
    LS,
    METHODS,
    PARAMETERS,
    PRIOR,
    SIZES,
    Cell,
    Study,
    calibrate,
    change_sizes,
    load_grid,
    name_measure,
    place_fifty,
    plan_points,
    rank_correlations,
    take_median,
)
from loopcal.planning.plane_line_planning import PlaneLineGroups
from loopcal.studies.simulation.block import calibrate_cells, set_size
from loopcal.studies.simulation.published_steps import WEIGHTS
from loopcal.typing import FloatArray

SEED, DRAWS, STARTS, FEW_DRAWS, DRAWS_PER_INTERPRETATION = 0, 200, 5, 40, 60
MACHINES, NOISE = 50, 0.01
"""Identified with surfaces as unknowns, and the noise of their held coordinates [mm]."""
SD, VARIANCE = "standard deviation", "variance"
"""Interpretations of a printed "variance of 0.01mm"."""
ANY_TRUTH, OBSERVABLE = "all parameters", "gauge-free"
"""True errors: of all parameters, or without their part that plane and line cannot determine."""
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
    study = plan_points(load_grid(CASE, seed, DRAWS))
    spent = time.process_time() - began
    before, after = study.spreads
    cost = spent / time_linearization(study.planned, study.first) if seed == SEED else None
    return study, [seed, before, after, before / after, spent, cost]


MEDIANS = {
    "position, aligned [mm]": name_measure("position", ALIGNED),
    "position, absolute [mm]": name_measure("position", ABSOLUTE),
    "position, gauge at nominal [mm]": name_measure("position", AT_NOMINAL),
    "parameters without gauge [mm]": DETERMINED,
}
"""Columns of Table 3 and the names of their measures."""
POSITION = name_measure("position", ALIGNED)


def take_machines(study: Study, machines: int) -> Study:
    """Return a study of so many machines."""
    return replace(study, grid=set_size(study.grid, SEED, machines))


def list_medians(c: Cell) -> list[float]:
    """Return errors of position in each frame and of parameters: before, LS and MAP."""
    return [c.compute_median(m, name) for name in MEDIANS.values() for m in (BEFORE, LS, PRIOR)]


def calibrate_figure_5(study: Study, rows: str = "", reading: str = SD) -> Cell:
    """Calibrate machines with the errors and the noise of figure 5, read as SD or VARIANCE; rows :
    weights of the rows, by default their full covariance.
    """
    errors, noise = (
        {text: float(text) if reading == SD else float(np.sqrt(float(text)))}
        for text in steps.find_figure_5()
    )
    grid = change_sizes(study.grid, errors, noise)
    if rows:
        levels = {name: replace(level, rows=rows) for name, level in grid.methods.items()}
        grid = replace(grid, methods=levels)
    (cell,) = calibrate(study, grid).values()
    return cell


def compare_weights(study: Study) -> list[list[Any]]:
    """Return errors by LS and MAP for each weighting of the rows, and the ratio of LS to that as
    printed.
    """
    cells = {w: calibrate_figure_5(study, "" if w == "full" else f"products-{w}") for w in WEIGHTS}
    first = cells["printed"].compute_median(LS, POSITION)
    return [
        [
            WEIGHT_NAMES[w],
            *(c.compute_median(m, name) for name in (POSITION, DETERMINED) for m in (LS, PRIOR)),
            c.compute_median(LS, POSITION) / first,
        ]
        for w, c in cells.items()
    ]


def list_printed() -> dict[str, float]:
    """Return the printed reductions of parameters, position and orientation [%]; those of poses
    from the errors before and after.
    """
    return {
        name: 100.0 * (1.0 - float(given["after"]) / float(given["before"]))
        if "before" in given
        else float(given["stated"])
        for name, given in steps.PRINTED.find("figure_5").items()
    }


def remove_gauge(study: Study, cell: Cell) -> Cell:
    """Return a cell whose true errors are without their part that plane and line do not determine.

    To first order it changes neither the readings nor the estimates, which are those of the cell.
    """
    nominal = study.robot.values
    truth = nominal + study.remove_unobservable(cell.truth - nominal)
    errors = {name: study.compute_errors(v, truth) for name, v in cell.values.items()}
    return replace(cell, truth=truth, errors=errors)


def list_interpretations(study: Study) -> list[list[Any]]:
    """Return the reductions of figure 5 [%] as printed, and by least squares under every
    interpretation, the nearest first.
    """
    study, printed = take_machines(study, DRAWS_PER_INTERPRETATION), list_printed()
    rows = list[list[Any]]()
    for reading in (SD, VARIANCE):
        cell = calibrate_figure_5(study, reading=reading)
        for truth, of in {ANY_TRUTH: cell, OBSERVABLE: remove_gauge(study, cell)}.items():
            for frame, parameters in {ABSOLUTE: PARAMETERS, ALIGNED: DETERMINED}.items():
                measures = [parameters, *(name_measure(what, frame) for what in study.parts)]
                left = [take_median(of.compute_left(LS, measure)) for measure in measures]
                rows.append([reading, truth, frame, *(100.0 * (1.0 - x) for x in left)])

    def measure_distance(row: list[Any]) -> float:
        return float(np.abs(np.subtract(row[3:], [*printed.values()])).max())

    rows.sort(key=measure_distance)
    return [["as printed", None, None, *printed.values()], *rows]


def identify_with_surfaces(study: Study) -> list[list[Any]]:
    """Return on how many machines fits with surfaces as unknowns converge, and how far their
    estimates are from those of the paper's rows: the largest difference along a direction [sd].
    """
    rows, compared = study.optimized.rows.reshape(-1, len(study.planned.free)), []
    for name in METHODS:
        grid = change_sizes(set_size(study.grid, SEED, MACHINES), {"": 1.0}, {"": NOISE})
        level = grid.methods[name]
        methods = {"products": level, "surfaces": replace(level, rows="weighted")}
        products, surfaces = calibrate_cells(replace(grid, methods=methods))
        both = products.is_converged & surfaces.is_converged
        free = study.planned.free
        z = (surfaces.values - products.values)[both][:, free.places] / free.tolerance
        unlike = np.linalg.norm(z @ rows.T, axis=1) / NOISE  # rows have a noise of 1 mm
        compared.append(
            [
                name,
                f"{both.sum()} of {len(both)}",
                int(surfaces.iterations.max()),
                float(np.median(unlike)),
                float(unlike.max()),
            ]
        )
    return compared


def compare_fifty_points(study: Study) -> list[list[Any]]:
    """Return mean position errors before, by LS and by MAP in each frame, and the share of LS fits
    that converge within 5 iterations.
    """
    rows, study = list[list[Any]](), take_machines(study, FEW_DRAWS)
    most = int(steps.PRINTED.find("experiment", "iterations"))
    for groups in SIZES.find("fifty", "planes"):
        (cell,) = calibrate(study, place_fifty(study.grid, groups)).values()
        for frame in steps.FRAMES:
            mean = name_measure("position", frame, ", mean")
            within = 100.0 * float(cell.is_within(most).mean()) if frame == ALIGNED else None
            medians = (cell.compute_median(m, mean) for m in (BEFORE, LS, PRIOR))
            rows.append([groups, frame, *medians, within])
    return rows


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
    cells = calibrate(study)
    rows = [
        [given, noise, *list_medians(c), int((c.compute_left(PRIOR, POSITION) > 1.0).sum()),
         sum(int((~converged).sum()) for converged in c.converged.values())]
        for (given, noise), c in sorted(cells.items(), key=lambda of: of[1].size)
    ]  # fmt: skip
    (level,) = study.grid.poses.values()
    few = load_grid(CASE, SEED, FEW_DRAWS)
    plan = plan_points(few, replace(level, groups=1, sweeps=1, coordinates=()))
    one = calibrate_figure_5(plan)
    placed = [
        [steps.name_planes(level.groups), *first[1:3], *_pair(cells["1", "0.01"]), DRAWS],
        [steps.name_planes(1), *plan.spreads, *_pair(one), FEW_DRAWS],
    ]
    ranks = [
        [
            method,
            take_median(rank_correlations(cells.values(), method)),
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
                list_interpretations(study),
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
    return [c.compute_median(m, POSITION) for m in (LS, PRIOR)]
