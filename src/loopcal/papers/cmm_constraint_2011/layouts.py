# SPDX-License-Identifier: Apache-2.0
"""What the paper leaves open: how many planes and lines, what its variances are, whether its true
errors had a gauge part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.papers.cmm_constraint_2011.cells import Cell, cell
from loopcal.papers.cmm_constraint_2011.published import MM, published
from loopcal.papers.cmm_constraint_2011.steps import WEIGHTS
from loopcal.papers.cmm_constraint_2011.study import GROUPS, MEASURES, POINTS, Study, plan, spread
from loopcal.papers.printed import Cell as Entry
from loopcal.papers.printed import Table
from loopcal.typing import FloatArray

SD, VARIANCE = "standard deviation", "variance"
READINGS: Mapping[str, Callable[[float], float]] = {
    SD: lambda given: given * MM,
    VARIANCE: lambda given: float(np.sqrt(given)) * MM,
}
"""From a printed number to a standard deviation [m]: "variance of 0.01mm" may mean either."""

TEN, ONE, ANY = (
    "ten planes, a line each",
    "one plane, one line",
    "ten planes of any axis, a line each",
)
SET, NOISE = 1.0, 0.01
"""Of figure 5, as printed [mm]."""


@dataclass(frozen=True, eq=False)
class Arrangement:
    """A way to place 100 points.

    Attributes
    ----------
    name : TEN, ONE or ANY. drawn, optimised : sd of the identifiable directions before and after
        exchange [mm per mm].
    cell : set 3 with noise 0.01 mm, as standard deviations. study : the points.
    """

    name: str
    drawn: float
    optimised: float
    cell: Cell
    study: Study

    @property
    def gain(self) -> float:
        """How many times smaller the sd is after exchange."""
        return self.drawn / self.optimised


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way to read the paper, and what figure 5 would then show.

    Attributes
    ----------
    name, reading, truth, frame : how. reductions : (3,) of parameters, position, orientation by
        least squares [%].
    """

    name: str
    reading: str
    truth: str
    frame: str
    reductions: FloatArray

    @property
    def distance(self) -> float:
        """Largest difference from the printed percentages."""
        return float(np.abs(self.reductions - printed_reductions()).max())


def printed_reductions() -> FloatArray:
    """(3,) of parameters, position and orientation [%]."""
    figure = published().figure_5
    return np.array(
        [
            float(figure["estimation"].stated),
            figure["position"].reduction,
            figure["orientation"].reduction,
        ]
    )


def arranged(name: str, study: Study, seed: int, trials: int) -> Arrangement:
    """Look at one way to place the points."""
    designs = (study.planned.linearize(study.first), study.optimised.rows)
    first, last = (spread(rows) for rows in designs)
    return Arrangement(name, first, last, cell(study, SET * MM, NOISE * MM, seed, trials), study)


def arrangements(
    study: Study, seed: int, trials: int, progress: Callable[[str], None]
) -> tuple[Arrangement, ...]:
    """The study's ten groups, one group of as many points, and ten groups whose lines run along any
    axis.
    """
    progress("one plane and one line")
    one = plan(study.robot, 1, GROUPS * POINTS, study.planned.axes, seed, sweeps=1)
    progress("planes of any axis")
    free = plan(study.robot, GROUPS, POINTS, ("x", "y", "z"), seed, sweeps=1)
    return tuple(
        arranged(name, s, seed, trials) for name, s in ((TEN, study), (ONE, one), (ANY, free))
    )


def candidates(found: tuple[Arrangement, ...], seed: int, trials: int) -> tuple[Candidate, ...]:
    """Every way to read the paper, the nearest to its printed reductions first."""
    rows = []
    for arrangement in found:
        if arrangement.name == ANY:
            continue
        for reading, size in READINGS.items():
            for gauge_free in (False, True):
                known = reading == SD and not gauge_free
                sizes = size(SET), size(NOISE)
                c = (
                    arrangement.cell
                    if known
                    else cell(arrangement.study, *sizes, seed, trials, gauge_free)
                )
                truth = "gauge-free" if gauge_free else "all 42"
                rows += [Candidate(arrangement.name, reading, truth, *seen) for seen in _seen(c)]
    return tuple(sorted(rows, key=lambda row: row.distance))


def weights_compared(study: Study, seed: int, trials: int) -> dict[str, Cell]:
    """The cell of figure 5 with every weighting of the rows."""
    return {
        weights: cell(study, SET * MM, NOISE * MM, seed, trials, weights=weights)
        for weights in WEIGHTS
    }


def _seen(c: Cell) -> tuple[tuple[str, FloatArray], ...]:
    """Reductions by least squares, in the absolute frame and after alignment."""
    reduction = c.reduction("LS")
    absolute = [
        MEASURES.index(m) for m in ("parameters [mm]", "position [mm]", "orientation [deg]")
    ]
    aligned = [
        MEASURES.index(m)
        for m in (
            "parameters without gauge [mm]",
            "position, aligned [mm]",
            "orientation, aligned [deg]",
        )
    ]
    return ("absolute", reduction[absolute]), ("aligned", reduction[aligned])


def arrangements_table(found: tuple[Arrangement, ...]) -> Table:
    """How much the arrangement matters, before and after exchange."""
    place = MEASURES.index("position, aligned [mm]")
    rows = tuple(
        (
            a.name,
            a.study.layout.equations,
            a.drawn,
            a.optimised,
            a.gain,
            *(float(a.cell.median(m)[place]) for m in ("LS", "MAP")),
        )
        for a in found
    )
    columns = (
        "100 points on",
        "rows",
        "drawn [mm / mm]",
        "optimised [mm / mm]",
        "gain",
        "LS [mm]",
        "MAP [mm]",
    )
    note = (
        "Root mean square standard deviation of the 33 identifiable directions per mm of noise, "
        "before and after coordinate"
        " exchange for log det (one plane, and planes of any axis: one sweep); then the position "
        "error after alignment"
        f" (medians of {len(found[0].cell.iterations)} draws) for errors of 1 mm and noise of 0.01 "
        "mm."
    )
    return Table(
        "arrangements",
        "How many planes and lines",
        columns,
        rows,
        ("", "d", ".3g", ".3g", ".2g", ".2g", ".2g"),
        note,
    )


def candidates_table(found: tuple[Candidate, ...]) -> Table:
    """Figure 5 under every reading."""
    printed: tuple[Entry, ...] = ("as printed", "", "", "", *map(float, printed_reductions()), None)
    rows = (
        (c.name, c.reading, c.truth, c.frame, *map(float, c.reductions), c.distance) for c in found
    )
    columns = ("100 points on", '"variance" read as', "true errors in", "frame", "parameters [%]", "position [%]",
               "orientation [%]", "largest difference")  # fmt: skip
    note = (
        "Reductions of the median errors by least squares, set 3 with noise 0.01, the nearest to "
        "print first; below zero:"
        " larger than before. Gauge-free: true errors without their part along the nine directions "
        "that nothing tells."
    )
    return Table(
        "figure_5_readings",
        "Figure 5 under every reading",
        columns,
        (printed, *rows),
        ("",) * 4 + (".0f",) * 4,
        note,
    )


def weights_table(found: Mapping[str, Cell]) -> Table:
    """What the covariance of the rows is worth."""
    words = {
        "printed": "as printed: weight one",
        "distance": "divided by |d_1|",
        "single": "divided by the sd of each",
        "full": "full covariance",
    }
    places = [
        MEASURES.index(m) for m in ("position, aligned [mm]", "parameters without gauge [mm]")
    ]
    rows = tuple(
        (words[w], *(float(c.median(m)[i]) for m in ("LS", "MAP") for i in places))
        for w, c in found.items()
    )
    columns = (
        "rows",
        *(
            f"{m}, {name}"
            for m in ("LS", "MAP")
            for name in ("position, aligned [mm]", "parameters [mm]")
        ),
    )
    note = "Medians; errors of 1 mm, noise 0.01 mm. Rows of a group share two points, so their noise is correlated."
    return Table(
        "weights", "Weights of the rows", columns, rows, ("", ".3g", ".3g", ".3g", ".3g"), note
    )
