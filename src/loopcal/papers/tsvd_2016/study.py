# SPDX-License-Identifier: Apache-2.0
"""The whole study: both manipulators with 6- and 5-DOF measurement, then many machines."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopcal.papers.printed import Comparison
from loopcal.papers.reproduction import Content
from loopcal.papers.tsvd_2016.cases import Case, follow_ridge, measure_case, solve_case
from loopcal.papers.tsvd_2016.draws import draw_machines
from loopcal.papers.tsvd_2016.figures import make_figures
from loopcal.papers.tsvd_2016.machines import ROBOTS
from loopcal.papers.tsvd_2016.published import read_published
from loopcal.papers.tsvd_2016.tables import RIDGE_STEPS, Results, make_tables
from loopcal.papers.tsvd_2016.verdicts import judge_claims
from loopcal.papers.wording import read_wording


def present(results: Results, seed: int) -> Content:
    """Return the results as tables, verdicts and figures; `seed` is that of `compute`."""
    del seed
    return (results.counts,), make_tables(results), judge_claims(results), make_figures(results)


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything: one machine of each kind with the printed noise, then drawn machines."""
    cases = []
    for name in ROBOTS:
        whole = measure_case(name, seed)
        cases += [solve_case(measured, progress) for measured in (whole, whole.five)]
    progress("ridge steps")
    steps = follow_ridge(measure_case("3-PRS", seed), RIDGE_STEPS)
    draws = tuple(draw_machines(name, seed, trials, progress) for name in ROBOTS)
    return Results(read_published(), tuple(cases), draws, steps, _counts(tuple(cases)))


def _counts(cases: tuple[Case, ...]) -> Comparison:
    """Return the numbers that the text states, beside the computed ranks."""
    rank = {case.study.name: case.rank for case in cases if case.study.freedoms == 6}
    tripod = next(case.study for case in cases if case.study.name == "3-PRS")
    chain = sum("1" in name for name in tripod.robot.parameters.names)
    computed = np.array(
        [[rank["RU-PUS-PRS"]], [rank["3-PRS"]], [chain], [len(tripod.trials.readings)]],
        dtype=np.float64,
    )
    return read_wording(__file__).compare("counts", read_published().counts, computed)
