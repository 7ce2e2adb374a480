# SPDX-License-Identifier: Apache-2.0
"""Table 3 again: true machines of three sizes of errors, four levels of noise, many draws, least
squares and MAP.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.methods.penalties import MAP, LeastSquares, Method
from loopcal.papers.cmm_constraint_2011.published import MM, published
from loopcal.papers.cmm_constraint_2011.steps import PaperRows, Weights, identify_from_rows
from loopcal.papers.cmm_constraint_2011.study import MEASURES, Study, true_machines
from loopcal.typing import FloatArray, IntArray

BEFORE, LS, PRIOR = "before", "LS", "MAP"
METHODS: Mapping[str, Method] = {LS: LeastSquares(), PRIOR: MAP()}


@dataclass(frozen=True, eq=False)
class Cell:
    """t machines with errors of one size, calibrated from points with noise of one size.

    Attributes
    ----------
    sd, noise : standard deviations [m]. gauge_free : whether the true errors have no part that
        plane and line cannot tell.
    errors : by BEFORE, LS, MAP, (t, 7) see MEASURES. iterations : (t,) of LS. failed : descents
        that did not converge.
    """

    sd: float
    noise: float
    gauge_free: bool
    errors: Mapping[str, FloatArray]
    iterations: IntArray
    failed: int

    def median(self, method: str) -> FloatArray:
        """(7,) over the draws."""
        return np.median(self.errors[method], axis=0)

    def reduction(self, method: str) -> FloatArray:
        """(7,) percentages by which the medians fall."""
        return 100.0 * (1.0 - self.median(method) / self.median(BEFORE))

    @property
    def ratio(self) -> float:
        """Noise over errors, by which alone the reductions of cells differ, but for what is not
        linear.
        """
        return float(f"{self.noise / self.sd:.6g}")

    def worse(self, method: str, measure: int) -> int:
        """How many machines a method makes worse."""
        return int((self.errors[method][:, measure] > self.errors[BEFORE][:, measure]).sum())


def cell(
    study: Study,
    sd: float,
    noise: float,
    seed: int,
    trials: int,
    gauge_free: bool = False,
    weights: Weights = "full",
) -> Cell:
    """Draw true machines, hold their coordinates with noise, identify by each method, compare at
    unseen poses.

    Parameters
    ----------
    sd, noise : standard deviations [m], of a parameter and of a coordinate of a point. The prior of
        MAP has this sd.
    """
    truth = true_machines(study.robot, sd, trials, seed, gauge_free)
    problem = PaperRows(study.layout, study.layout.held(truth, noise, seed), sd, noise, weights)
    true = study.unseen.poses(truth)
    errors = {BEFORE: study.unseen.errors(study.robot.parameters.nominal[None], truth, true)}
    failed, iterations = 0, np.zeros(trials, dtype=np.int64)
    for name, method in METHODS.items():
        found = identify_from_rows(problem, method)
        errors[name] = study.unseen.errors(problem.values(found.deviation), truth, true)
        failed += int((found.status != 0).sum())
        iterations = found.iterations if name == LS else iterations
    return Cell(sd, noise, gauge_free, errors, iterations, failed)


def grid(
    study: Study, seed: int, trials: int, progress: Callable[[str], None]
) -> dict[tuple[str, str], Cell]:
    """Compute the 3 x 4 cells by (set, noise) as printed, read as standard deviations."""
    cells = {}
    for given in published().sets:
        progress(f"Table 3, set {given} mm")
        for noise in published().noises:
            cells[given, noise] = cell(study, float(given) * MM, float(noise) * MM, seed, trials)
    return cells


def correlation(cells: Iterable[Cell], method: str) -> float:
    """Rank correlation over cells of the reductions of parameter error and position error."""
    both = np.array([c.reduction(method) for c in cells])
    return spearman(
        both[:, MEASURES.index("parameters [mm]")], both[:, MEASURES.index("position [mm]")]
    )


def spearman(x: FloatArray, y: FloatArray) -> float:
    """Rank correlation of numbers without ties."""
    first, second = (np.argsort(np.argsort(v)).astype(np.float64) for v in (x, y))
    return float(np.corrcoef(first, second)[0, 1])
