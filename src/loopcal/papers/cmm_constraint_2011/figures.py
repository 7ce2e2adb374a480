# SPDX-License-Identifier: Apache-2.0
"""The analogues of figures 4 and 5, and Table 3 as curves, as data."""

from __future__ import annotations

import numpy as np

from loopcal.papers.cmm_constraint_2011.cells import BEFORE, LS, METHODS, PRIOR
from loopcal.papers.cmm_constraint_2011.layouts import NOISE, SET
from loopcal.papers.cmm_constraint_2011.published import MM
from loopcal.papers.cmm_constraint_2011.steps import PaperRows, identify_from_rows
from loopcal.papers.cmm_constraint_2011.study import (
    ABSOLUTE,
    ALIGNED,
    MEASURES,
    Study,
    true_machines,
)
from loopcal.papers.cmm_constraint_2011.tables import Results
from loopcal.papers.reproduction import Figure, Series


def figures(found: Results, seed: int) -> tuple[Figure, ...]:
    """All figures."""
    return _figure_4(found), _figure_5(found.study, seed), _curves(found)


def _figure_4(found: Results) -> Figure:
    """Pose error over the parameters' error, both as shares of what they were, so that errors that
    grew have a place, too.
    """
    frames = {
        "": ("parameters [mm]", "position [mm]"),
        ", aligned": ("parameters without gauge [mm]", "position, aligned [mm]"),
    }
    series = []
    for frame, names in frames.items():
        places = [MEASURES.index(name) for name in names]
        for method in METHODS:
            both = np.array(
                [c.median(method)[places] / c.median(BEFORE)[places] for c in found.cells.values()]
            )
            x, y = both[np.argsort(both[:, 0])].T
            series.append(Series(f"{method}{frame}", tuple(map(float, x)), tuple(map(float, y))))
    return Figure(
        "figure_4", "Figure 4: pose error over parameter error", "parameters' error, after / "
                                                                 "before [1]",
        "position error, after / before [1]",
        f"Medians of the {len(found.cells)} cells of Table 3; aligned: after the motions that "
        "plane and line leave open, over"
        " the parameters' error without them. The paper draws reductions in percent: 0.25 here is "
        "one of 75 %, and above 1"
        " an error grew.",
        tuple(series), log="xy", joined=False,
    )  # fmt: skip


def _figure_5(study: Study, seed: int) -> Figure:
    """Position errors of single poses before and after."""
    truth = true_machines(study.robot, SET * MM, 1, seed)
    problem = PaperRows(
        study.layout, study.layout.held(truth, NOISE * MM, seed), SET * MM, NOISE * MM
    )
    true = study.unseen.poses(truth)
    machines = {BEFORE: study.robot.parameters.nominal[None]}
    machines |= {
        name: problem.values(identify_from_rows(problem, method).deviation)
        for name, method in METHODS.items()
    }
    sizes = {}
    for name, values in machines.items():
        for frame in (ABSOLUTE, ALIGNED):
            size = np.linalg.norm(study.unseen.twists(values, true, frame)[0, :, 3:], axis=1) / MM
            sizes[name if frame == ABSOLUTE else f"{name}, {frame}"] = size
    order = np.argsort(sizes[BEFORE])
    x = tuple(map(float, range(1, len(order) + 1)))
    series = tuple(
        Series(label, x, tuple(map(float, size[order]))) for label, size in sizes.items()
    )
    return Figure(
        "figure_5", "Figure 5: pose errors before and after", "unseen pose, in order of its error "
                                                              "before [1]",
        "position error [mm]",
        f"One machine with errors of {SET:g} mm, noise of {NOISE:g} mm, {len(order)} random poses.", series, joined=False,
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
            Series(
                f"{method}, errors of {given} mm",
                x,
                tuple(float(c.median(method)[place]) for c in cells),
            )
            for method in (LS, PRIOR)
        ]
    first = next(iter(found.cells.values()))
    return Figure(
        "table_3", "Table 3 as curves: position error over noise", "noise of a held coordinate [mm]",
        "position error, aligned [mm]", f"Medians of {len(first.iterations)} drawn machines.", tuple(series), levels, "xy",
    )  # fmt: skip
