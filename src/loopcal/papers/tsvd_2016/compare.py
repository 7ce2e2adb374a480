# SPDX-License-Identifier: Apache-2.0
"""The paper repeated on both manipulators, with 6- and 5-DOF measurement, and asked again on many
machines.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopcal.papers import PAPERS
from loopcal.papers.printed import Comparison
from loopcal.papers.reproduction import Reproduction
from loopcal.papers.tsvd_2016.cases import Case, measure, ridge_steps, solve
from loopcal.papers.tsvd_2016.draws import draw
from loopcal.papers.tsvd_2016.published import published
from loopcal.papers.tsvd_2016.study import ROBOTS
from loopcal.papers.tsvd_2016.tables import RIDGE_STEPS, Results, tables

NAME = "tsvd-2016"


def reproduce(seed: int, trials: int, progress: Callable[[str], None]) -> Reproduction:
    """Repeat the paper; see `loopcal.papers.Paper.run`."""
    from loopcal.papers.tsvd_2016.figures import figures
    from loopcal.papers.tsvd_2016.verdicts import verdicts

    paper = PAPERS[NAME]
    found = compute(seed, trials, progress)
    return Reproduction(
        paper=paper.name,
        title=paper.title,
        source=paper.source,
        about=_about(),
        settings={"seed": seed, "trials": trials},
        comparisons=(found.counts,),
        tables=tables(found),
        verdicts=verdicts(found),
        figures=figures(found),
    )


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything: one machine of each kind with the printed noise, then `trials` machines
    with drawn noise.
    """
    cases = []
    for name in ROBOTS:
        whole = measure(name, seed)
        cases += [solve(measured, progress) for measured in (whole, whole.five)]
    progress("ridge steps")
    steps = ridge_steps(measure("3-PRS", seed), RIDGE_STEPS)
    drawn = tuple(draw(name, seed, trials, progress) for name in ROBOTS)
    return Results(published(), tuple(cases), drawn, steps, _counts(tuple(cases)))


def _counts(cases: tuple[Case, ...]) -> Comparison:
    """Numbers that the text states, beside the ranks found."""
    rank = {case.study.name: case.rank for case in cases if case.study.freedoms == 6}
    tripod = next(case.study for case in cases if case.study.name == "3-PRS")
    chain = sum("1" in name for name in tripod.robot.parameters.names)
    computed = np.array(
        [[rank["RU-PUS-PRS"]], [rank["3-PRS"]], [chain], [len(tripod.trials.readings)]],
        dtype=np.float64,
    )
    note = "Computed: rank of the identification matrix with 6-DOF measurement; names of one chain; poses measured here."
    return Comparison(
        "counts", "Numbers of parameters and poses", ("number",), published().counts, computed, note
    )


def _about() -> tuple[str, ...]:
    done = (
        "What the paper does, done again: errors are assumed in the parameters of two parallel "
        "manipulators, 36 poses are"
        " measured in six or five coordinates with the noise that Appendix 1 prints, and the "
        "errors are identified by Newton"
        " steps in raw millimetres and radians with least squares (LS), ridge estimation (RE) and "
        "truncated singular values"
        " (TSVD), lambda and k chosen where the output error is least."
    )
    ours = (
        "Dimensions, poses, true errors (0.05 to 0.1 mm and 2.5e-4 to 5e-4 rad in size) and output "
        "range are ours, and so is"
        " the choice of the 25 parameters of the RU-PUS-PRS manipulator, of which the paper's text "
        "names five. The paper's"
        " statements are judged, its numbers cannot be."
    )
    return done, published().source, ours
