# SPDX-License-Identifier: Apache-2.0
"""The whole study: choose points, draw machines, calibrate, judge, and answer open questions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopcal.papers.cmm_constraint_2011.calibrations import LINES, calibrate_fifty, calibrate_grid
from loopcal.papers.cmm_constraint_2011.figures import make_figures
from loopcal.papers.cmm_constraint_2011.forms import compare_forms
from loopcal.papers.cmm_constraint_2011.layouts import (
    compare_arrangements,
    compare_weights,
    rank_candidates,
)
from loopcal.papers.cmm_constraint_2011.machines import (
    AXES,
    GROUPS,
    POINTS,
    SWEEPS,
    load_machine,
    plan_points,
)
from loopcal.papers.cmm_constraint_2011.published import read_published
from loopcal.papers.cmm_constraint_2011.tables import Results, compute_ranks, make_tables
from loopcal.papers.cmm_constraint_2011.verdicts import judge_claims
from loopcal.papers.printed import Comparison, Printed
from loopcal.papers.reproduction import Content
from loopcal.papers.wording import read_wording


def present(results: Results, seed: int) -> Content:
    """Return the results as tables, verdicts and figures; `seed` is that of `compute`."""
    comparisons = (_compare_counts(results), _compare_figure_5(results))
    return comparisons, make_tables(results), judge_claims(results), make_figures(results, seed)


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything."""
    progress("coordinate exchange, ten planes")
    study = plan_points(load_machine(), GROUPS, POINTS, AXES, seed, SWEEPS)
    cells = calibrate_grid(study, seed, trials, progress)
    arrangements = compare_arrangements(study, seed, trials, progress)
    progress("interpretations of figure 5")
    candidates = rank_candidates(arrangements, seed, trials)
    progress("weights of the rows")
    weights = compare_weights(study, seed, trials)
    progress("fifty points, and both forms")
    return Results(
        printed=read_published(),
        study=study,
        cells=cells,
        arrangements=arrangements,
        candidates=candidates,
        weights=weights,
        fifties=tuple(calibrate_fifty(study, groups, seed, trials) for groups in LINES),
        forms=compare_forms(study, seed),
        ranks=compute_ranks(study, seed),
    )


def _compare_counts(results: Results) -> Comparison:
    """Return the stated numbers of parameters and iterations beside the computed ones."""
    printed = Printed.parse(
        {
            "parameters identified": str(results.printed.parameters),
            "iterations for 50 points, at most": "5",
        }
    )
    rank = max(r.rank for r in results.ranks)
    iterations = max(f.iterations.max() for f in results.fifties)
    computed = np.array([[float(rank)], [float(iterations)]])
    return read_wording(__file__).compare("counts", printed, computed)


def _compare_figure_5(results: Results) -> Comparison:
    """Return figure 5 beside the nearest interpretation."""
    figure, nearest = results.printed.figure_5, results.candidates[0]
    printed = Printed.parse({name: given.stated for name, given in figure.items()})
    order = {"estimation": 0, "position": 1, "orientation": 2}
    computed = np.array([[nearest.reductions[order[name]]] for name in figure])
    return read_wording(__file__).compare("figure_5", printed, computed, None, nearest=nearest)
