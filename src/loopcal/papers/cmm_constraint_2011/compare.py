# SPDX-License-Identifier: Apache-2.0
"""The paper repeated: points chosen, machines drawn, calibrated and judged, and its open questions
tried out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopcal.papers import PAPERS
from loopcal.papers.cmm_constraint_2011.cells import grid
from loopcal.papers.cmm_constraint_2011.fifty import LINES, fifty
from loopcal.papers.cmm_constraint_2011.forms import compare_forms
from loopcal.papers.cmm_constraint_2011.layouts import arrangements, candidates, weights_compared
from loopcal.papers.cmm_constraint_2011.published import published
from loopcal.papers.cmm_constraint_2011.study import AXES, GROUPS, POINTS, SWEEPS, machine, plan
from loopcal.papers.cmm_constraint_2011.tables import Results, ranks, tables
from loopcal.papers.printed import Comparison, Printed
from loopcal.papers.reproduction import Reproduction

NAME = "cmm-constraint-2011"


def reproduce(seed: int, trials: int, progress: Callable[[str], None]) -> Reproduction:
    """Repeat the paper; see `loopcal.papers.Paper.run`."""
    return told(compute(seed, trials, progress), seed, trials)


def told(found: Results, seed: int, trials: int) -> Reproduction:
    """Put what was computed into tables, figures and verdicts."""
    from loopcal.papers.cmm_constraint_2011.figures import figures
    from loopcal.papers.cmm_constraint_2011.verdicts import verdicts

    paper = PAPERS[NAME]
    return Reproduction(
        paper=paper.name,
        title=paper.title,
        source=paper.source,
        about=_about(),
        settings={"seed": seed, "trials": trials},
        comparisons=(_counts(found), _percentages(found)),
        tables=tables(found),
        verdicts=verdicts(found),
        figures=figures(found, seed),
    )


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything."""
    robot = machine()
    progress("coordinate exchange, ten planes")
    study = plan(robot, GROUPS, POINTS, AXES, seed, SWEEPS)
    cells = grid(study, seed, trials, progress)
    placed = arrangements(study, seed, trials, progress)
    progress("readings of figure 5")
    read = candidates(placed, seed, trials)
    progress("weights of the rows")
    weighed = weights_compared(study, seed, trials)
    progress("fifty points, and both forms")
    fifties = tuple(fifty(study, groups, seed, trials) for groups in LINES)
    return Results(
        published(),
        study,
        cells,
        placed,
        read,
        weighed,
        fifties,
        compare_forms(study, seed),
        ranks(study, seed),
    )


def _counts(found: Results) -> Comparison:
    """Parameters and what the constraints tell of them."""
    printed = found.printed
    rows = {
        "parameters identified": str(printed.parameters),
        "iterations for 50 points, at most": "5",
    }
    computed = np.array(
        [
            [float(max(r[3] for r in found.ranks))],
            [float(max(f.iterations.max() for f in found.fifties))],
        ]
    )
    note = "Computed: rank of the rows; the most iterations of least squares over all machines and both ways to place the points."
    return Comparison(
        "counts", "Numbers that the text states", ("number",), Printed.parse(rows), computed, note
    )


def _percentages(found: Results) -> Comparison:
    """Figure 5 beside the nearest reading."""
    figure = found.printed.figure_5
    nearest = found.candidates[0]
    rows = {name: given.stated for name, given in figure.items()}
    order = {"estimation": 0, "position": 1, "orientation": 2}
    computed = np.array([[nearest.reductions[order[name]]] for name in rows])
    note = (
        f"Computed with our robot: {nearest.name}, {nearest.reading}, true errors in "
        f"{nearest.truth}, {nearest.frame}: the"
        " nearest of all readings tried, see below."
    )
    return Comparison(
        "figure_5", "Figure 5, reductions", ("reduction [%]",), Printed.parse(rows), computed, note
    )


def _about() -> tuple[str, ...]:
    done = (
        "What the paper does, done again: the end point of a hexapod is brought to points of equal "
        "z and to points of equal x"
        " and y by a coordinate measuring machine whose readings are not used otherwise; 42 "
        "parameters are identified from the"
        " products (p_i - p_0)'(p_1 - p_0) = 0. Positions are chosen by coordinate exchange, "
        "errors and noise of three and four"
        " sizes are drawn, and machines are compared at 100 random poses before and after."
    )
    ours = (
        "Robot and workspace are ours (the robot file hexapod-nategh-agheli), and so is the number "
        "of planes: the paper's"
        " statements are judged, its numbers cannot be. Least squares takes the smallest deviation "
        "along what no row tells,"
        " since the printed inverse does not exist; MAP has the sd of the true errors as prior."
    )
    return done, published().source, ours
