# SPDX-License-Identifier: Apache-2.0
"""The whole study: choose points, draw machines, calibrate, judge, and answer open questions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopcal.papers.cmm_constraint_2011.draws import DRAWS, SEED_STEP, compute_draw
from loopcal.papers.cmm_constraint_2011.figures import make_figures
from loopcal.papers.cmm_constraint_2011.forms import compare_forms
from loopcal.papers.cmm_constraint_2011.layouts import compare_arrangements, rank_candidates
from loopcal.papers.cmm_constraint_2011.machines import (
    AXES,
    GROUPS,
    POINTS,
    SWEEPS,
    load_machine,
    plan_points,
)
from loopcal.papers.cmm_constraint_2011.published import read_published
from loopcal.papers.cmm_constraint_2011.tables import (
    Results,
    compute_gauge_effects,
    compute_pair_rank,
    compute_ranks,
    make_tables,
)
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
    draws = [compute_draw(study, seed, trials, progress)]
    arrangements = compare_arrangements(study, seed, trials, progress)
    progress("interpretations of figure 5")
    candidates = rank_candidates(arrangements, seed, trials)
    progress("both forms")
    forms = compare_forms(study, seed, trials)
    for i in range(1, DRAWS):
        other = seed + SEED_STEP * i
        drawn = plan_points(study.robot, GROUPS, POINTS, AXES, other, SWEEPS)
        draws.append(compute_draw(drawn, other, trials, _number_steps(progress, i + 1)))
    return Results(
        printed=read_published(),
        study=study,
        draws=tuple(draws),
        arrangements=arrangements,
        candidates=candidates,
        forms=forms,
        ranks=compute_ranks(study, seed),
        pair=compute_pair_rank(study),
        gauge_effects=compute_gauge_effects(study),
    )


def _number_steps(progress: Callable[[str], None], draw: int) -> Callable[[str], None]:
    """Return a callback that names the draw, too."""
    return lambda text: progress(f"draw {draw} of {DRAWS}: {text}")


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
