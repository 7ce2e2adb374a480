# SPDX-License-Identifier: Apache-2.0
"""The random parts of the study, drawn several times: points, machines and noise.

A statement that holds in some draws only is labelled so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from loopcal.papers.cmm_constraint_2011.calibrations import (
    LINES,
    Cell,
    FiftyPoints,
    calibrate_fifty,
    calibrate_grid,
)
from loopcal.papers.cmm_constraint_2011.layouts import compare_weights
from loopcal.papers.cmm_constraint_2011.machines import Study, compute_spread

DRAWS = 5
"""Times that points, machines and noise are drawn."""
SEED_STEP = 10
"""From the seed of one draw to that of the next; each uses a few of the seeds between."""


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw of points, machines and noise.

    Attributes
    ----------
    drawn, optimized : sd of the identifiable directions before and after exchange [mm per mm].
    cells : Table 3, by (set, noise) as printed. weights : the cell of figure 5 by weights of the
        rows. fifties : fifty points on each number of planes in LINES.
    """

    drawn: float
    optimized: float
    cells: Mapping[tuple[str, str], Cell]
    weights: Mapping[str, Cell]
    fifties: tuple[FiftyPoints, ...]

    @property
    def gain(self) -> float:
        """Factor by which exchange reduces the standard deviation."""
        return self.drawn / self.optimized


def compute_draw(study: Study, seed: int, trials: int, progress: Callable[[str], None]) -> Draw:
    """Calibrate the machines of one seed from the points of a study."""
    cells = calibrate_grid(study, seed, trials, progress)
    progress("weights of the rows, and fifty points")
    return Draw(
        drawn=compute_spread(study.planned.linearize(study.first)),
        optimized=compute_spread(study.optimized.rows),
        cells=cells,
        weights=compare_weights(study, seed, trials),
        fifties=tuple(calibrate_fifty(study, groups, seed, trials) for groups in LINES),
    )
