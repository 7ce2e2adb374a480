# SPDX-License-Identifier: Apache-2.0
"""The analogues of figures 4 and 5, and Table 3 as curves, as data."""

from __future__ import annotations

import numpy as np

from loopcal.papers.cmm_constraint_2011.cells import BEFORE, LS, METHODS, PRIOR
from loopcal.papers.cmm_constraint_2011.layouts import NOISE, SET
from loopcal.papers.cmm_constraint_2011.published import MM
from loopcal.papers.cmm_constraint_2011.steps import PaperRows, identify_from_rows
from loopcal.papers.cmm_constraint_2011.study import MEASURES, Study, true_machines
from loopcal.papers.cmm_constraint_2011.tables import Results
from loopcal.papers.reproduction import Figure, Series

LEAST = 100.0
"""Largest growth of an error [%] that figure 4 shows."""


def figures(found: Results, seed: int) -> tuple[Figure, ...]:
    """All figures."""
    return _figure_4(found), _figure_5(found.study, seed), _curves(found)


def _figure_4(found: Results) -> Figure:
    """Reduction of the pose error over that of the parameters' error."""
    frames = {
        "": ("parameters [mm]", "position [mm]"),
        ", aligned": ("parameters without gauge [mm]", "position, aligned [mm]"),
    }
    series, lost = [], 0
    for frame, names in frames.items():
        for method in METHODS:
            both = np.array([c.reduction(method)[[MEASURES.index(name) for name in names]] for c in found.cells.values()])
            shown = both[(both > -LEAST).all(axis=1)]
            lost += len(both) - len(shown)
            x, y = shown[np.argsort(shown[:, 0])].T
            series.append(Series(f"{method}{frame}", tuple(map(float, x)), tuple(map(float, y))))
    return Figure(
        "figure_4", "Figure 4: pose error over parameter error", "reduction of the parameters' error [%]",
        "reduction of the position error [%]",
        f"Medians of the {len(found.cells)} cells of Table 3; aligned: after the motions that plane and line leave open, over"
        f" the parameters' error without them. {lost} points are not drawn, where an error more than doubles.",
        tuple(series), log="",
    )  # fmt: skip


def _figure_5(study: Study, seed: int) -> Figure:
    """Position errors of single poses before and after."""
    truth = true_machines(study.robot, SET * MM, 1, seed)
    problem = PaperRows(study.layout, study.layout.held(truth, NOISE * MM, seed), SET * MM, NOISE * MM)
    true = study.unseen.poses(truth)
    machines = {BEFORE: study.robot.parameters.nominal[None]}
    machines |= {name: problem.values(identify_from_rows(problem, method).deviation) for name, method in METHODS.items()}
    series = []
    for name, values in machines.items():
        for aligned in (False, True):
            size = np.linalg.norm(study.unseen.twists(values, true, aligned)[0, :, 3:], axis=1) / MM
            label = f"{name}{', aligned' if aligned else ''}"
            series.append(Series(label, tuple(map(float, range(1, len(size) + 1))), tuple(map(float, size))))
    return Figure(
        "figure_5", "Figure 5: pose errors before and after", "unseen pose [1]", "position error [mm]",
        f"One machine with errors of {SET:g} mm, noise of {NOISE:g} mm, {len(true[0])} random poses.", tuple(series),
    )  # fmt: skip


def _curves(found: Results) -> Figure:
    """Position error over noise, set by set."""
    place = MEASURES.index("position, aligned [mm]")
    series, levels = [], {}
    for given in found.printed.sets:
        cells = [found.cells[given, noise] for noise in found.printed.noises]
        levels[f"before, errors of {given} mm"] = float(cells[0].median(BEFORE)[place])
        x = tuple(c.noise / MM for c in cells)
        series += [
            Series(f"{method}, errors of {given} mm", x, tuple(float(c.median(method)[place]) for c in cells))
            for method in (LS, PRIOR)
        ]
    first = next(iter(found.cells.values()))
    return Figure(
        "table_3", "Table 3 as curves: position error over noise", "noise of a held coordinate [mm]",
        "position error, aligned [mm]", f"Medians of {len(first.iterations)} drawn machines.", tuple(series), levels, "xy",
    )  # fmt: skip
