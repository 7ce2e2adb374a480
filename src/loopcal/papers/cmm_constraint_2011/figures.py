# SPDX-License-Identifier: Apache-2.0
"""The analogues of figures 4 and 5, and Table 3 as curves, as data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.papers.cmm_constraint_2011.calibrations import BEFORE, LS, METHODS, PRIOR
from loopcal.papers.cmm_constraint_2011.layouts import NOISE, SET
from loopcal.papers.cmm_constraint_2011.machines import ABSOLUTE, ALIGNED, MEASURES
from loopcal.papers.cmm_constraint_2011.published import MM
from loopcal.papers.cmm_constraint_2011.tables import Results
from loopcal.papers.reproduction import Figure, Series
from loopcal.papers.wording import read_wording
from loopcal.typing import FloatArray

FRAMES = {
    "": ("parameters [mm]", "position [mm]"),
    ", aligned": ("parameters without gauge [mm]", "position, aligned [mm]"),
}
"""Measures of figure 4 by frame."""


def make_figures(results: Results, seed: int) -> tuple[Figure, ...]:
    """Return all figures."""
    del seed
    return _draw_figure_4(results), _draw_figure_5(results), _draw_table_3(results)


def _draw_figure_4(results: Results) -> Figure:
    """Return pose error over parameter error, both after / before, so that growth has a place."""
    lines = []
    for frame, names in FRAMES.items():
        places = [MEASURES.index(name) for name in names]
        for method in METHODS:
            cells = results.cells.values()
            ratios = [c.compute_median(method) / c.compute_median(BEFORE) for c in cells]
            both = np.array(ratios)[:, places]
            x, y = both[np.argsort(both[:, 0])].T
            lines.append(_make_series(f"{method}{frame}", x, y))
    figure = read_wording(__file__).figure("figure_4", lines, count=len(results.cells))
    return replace(figure, joined=False)


def _draw_figure_5(results: Results) -> Figure:
    """Return position errors of single poses of the first machine, before and after."""
    study, made = results.study, results.cells[f"{SET:g}", f"{NOISE:g}"].machines
    true = study.held_out.solve(made.truth[:1])
    machines = {BEFORE: study.robot.parameters.nominal[None]}
    machines |= {name: made.estimates[name][:1] for name in METHODS}
    sizes = {}
    for name, values in machines.items():
        for frame in (ABSOLUTE, ALIGNED):
            twists = study.held_out.compute_twists(values, true, frame)[0]
            label = name if frame == ABSOLUTE else f"{name}, {frame}"
            sizes[label] = np.linalg.norm(twists[:, 3:], axis=1) / MM
    order = np.argsort(sizes[BEFORE])
    x = np.arange(1.0, len(order) + 1)
    lines = [_make_series(label, x, size[order]) for label, size in sizes.items()]
    data = {"errors": SET, "noise": NOISE, "count": len(order)}
    return replace(read_wording(__file__).figure("figure_5", lines, **data), joined=False)


def _draw_table_3(results: Results) -> Figure:
    """Return the position error by noise, for each set of errors."""
    place = MEASURES.index("position, aligned [mm]")
    lines, levels = [], {}
    for given in results.printed.sets:
        cells = [results.cells[given, noise] for noise in results.printed.noises]
        before = float(cells[0].compute_median(BEFORE)[place])
        levels[f"before, errors of {given} mm"] = before
        x = np.array([c.noise / MM for c in cells])
        for method in (LS, PRIOR):
            y = np.array([c.compute_median(method)[place] for c in cells])
            lines.append(_make_series(f"{method}, errors of {given} mm", x, y))
    trials = len(next(iter(results.cells.values())).iterations)
    return read_wording(__file__).figure("table_3", lines, levels, trials=trials)


def _make_series(label: str, x: FloatArray, y: FloatArray) -> Series:
    return Series(label, tuple(map(float, x)), tuple(map(float, y)))
