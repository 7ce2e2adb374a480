# SPDX-License-Identifier: Apache-2.0
"""Questions that the paper leaves open: number of planes, meaning of variances, gauge of errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.plane_line_products import WEIGHTS
from loopcal.papers.cmm_constraint_2011.calibrations import Cell, calibrate_cell
from loopcal.papers.cmm_constraint_2011.machines import (
    GROUPS,
    MEASURES,
    POINTS,
    Study,
    compute_spread,
    plan_points,
)
from loopcal.papers.cmm_constraint_2011.published import MM, read_published
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
    name : TEN, ONE or ANY. drawn, optimized : sd of the identifiable directions before and after
        exchange [mm per mm].
    cell : set 3 with noise 0.01 mm, as standard deviations. study : the points.
    """

    name: str
    drawn: float
    optimized: float
    cell: Cell
    study: Study

    @property
    def gain(self) -> float:
        """Factor by which exchange reduces the standard deviation."""
        return self.drawn / self.optimized


@dataclass(frozen=True, eq=False)
class Candidate:
    """One interpretation of the paper, and the figure 5 that follows from it.

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
        return float(np.abs(self.reductions - list_printed()).max())


def list_printed() -> FloatArray:
    """Return the printed reductions (3,) of parameters, position and orientation [%]."""
    figure = read_published().figure_5
    return np.array(
        [
            float(figure["estimation"].stated),
            figure["position"].reduction,
            figure["orientation"].reduction,
        ]
    )


def evaluate_arrangement(name: str, study: Study, seed: int, trials: int) -> Arrangement:
    """Evaluate one way to place the points."""
    designs = (study.planned.linearize(study.first), study.optimized.rows)
    first, last = (compute_spread(rows) for rows in designs)
    return Arrangement(
        name, first, last, calibrate_cell(study, SET * MM, NOISE * MM, seed, trials), study
    )


def compare_arrangements(
    study: Study, seed: int, trials: int, progress: Callable[[str], None]
) -> tuple[Arrangement, ...]:
    """Compare ten groups, one group of as many points, and ten groups with lines along any axis."""
    progress("one plane and one line")
    one_group = plan_points(study.robot, 1, GROUPS * POINTS, study.planned.axes, seed, sweeps=1)
    progress("planes of any axis")
    any_axis = plan_points(study.robot, GROUPS, POINTS, ("x", "y", "z"), seed, sweeps=1)
    return tuple(
        evaluate_arrangement(name, s, seed, trials)
        for name, s in ((TEN, study), (ONE, one_group), (ANY, any_axis))
    )


def rank_candidates(
    arrangements: tuple[Arrangement, ...], seed: int, trials: int
) -> tuple[Candidate, ...]:
    """Return every interpretation of the paper, the nearest to its printed reductions first."""
    rows = []
    for arrangement in arrangements:
        if arrangement.name == ANY:
            continue
        for reading, size in READINGS.items():
            for is_gauge_free in (False, True):
                known = reading == SD and not is_gauge_free
                sizes = size(SET), size(NOISE)
                c = (
                    arrangement.cell
                    if known
                    else calibrate_cell(arrangement.study, *sizes, seed, trials, is_gauge_free)
                )
                truth = "gauge-free" if is_gauge_free else "all 42"
                rows += [
                    Candidate(arrangement.name, reading, truth, *row) for row in _list_reductions(c)
                ]
    return tuple(sorted(rows, key=lambda row: row.distance))


def compare_weights(study: Study, seed: int, trials: int) -> dict[str, Cell]:
    """Return calibrations with the errors and the noise of figure 5 by every weighting of the rows,
    of the same machines.
    """
    return {
        weights: calibrate_cell(study, SET * MM, NOISE * MM, seed, trials, weights=weights)
        for weights in WEIGHTS
    }


def _list_reductions(c: Cell) -> tuple[tuple[str, FloatArray], ...]:
    """Return reductions by least squares, in the absolute frame and after alignment."""
    reduction = c.compute_reduction("LS")
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
