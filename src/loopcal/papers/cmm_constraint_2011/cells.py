# SPDX-License-Identifier: Apache-2.0
"""Table 3 repeated: machines with three sizes of errors and four levels of noise, LS and MAP."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.methods.penalties import MAP, LeastSquares, Method
from loopcal.papers.cmm_constraint_2011.machines import MEASURES, Study, draw_true_machines
from loopcal.papers.cmm_constraint_2011.published import MM, read_published
from loopcal.papers.cmm_constraint_2011.steps import PaperRows, Weights, identify_from_rows
from loopcal.typing import FloatArray, IntArray

BEFORE, LS, PRIOR = "before", "LS", "MAP"
METHODS: Mapping[str, Method] = {LS: LeastSquares(), PRIOR: MAP()}


@dataclass(frozen=True, eq=False)
class Cell:
    """t machines with errors of one size, calibrated from points with noise of one size.

    Attributes
    ----------
    sd, noise : standard deviations [m]. is_gauge_free : whether the true errors have no part
        that plane and line cannot determine.
    errors : by BEFORE, LS, MAP, (t, 7) see MEASURES. iterations : (t,) of LS. failed : descents
        that did not converge.
    """

    sd: float
    noise: float
    is_gauge_free: bool
    errors: Mapping[str, FloatArray]
    iterations: IntArray
    failed: int

    def compute_median(self, method: str) -> FloatArray:
        """Return medians (7,) over the draws."""
        return np.median(self.errors[method], axis=0)

    def compute_reduction(self, method: str) -> FloatArray:
        """Return percentages (7,) by which the medians fall."""
        return 100.0 * (1.0 - self.compute_median(method) / self.compute_median(BEFORE))

    @property
    def ratio(self) -> float:
        """Noise over errors. To first order the reductions of cells depend on it only."""
        return float(f"{self.noise / self.sd:.6g}")

    def count_worse(self, method: str, measure: int) -> int:
        """Return how many machines a method makes worse."""
        return int((self.errors[method][:, measure] > self.errors[BEFORE][:, measure]).sum())


def calibrate_cell(
    study: Study,
    sd: float,
    noise: float,
    seed: int,
    trials: int,
    gauge_free: bool = False,
    weights: Weights = "full",
) -> Cell:
    """Draw machines, hold their coordinates with noise, identify, compare at held-out poses.

    Parameters
    ----------
    sd, noise : standard deviations [m], of a parameter and of a coordinate of a point. The prior of
        MAP has this sd.
    """
    truth = draw_true_machines(study.robot, sd, trials, seed, gauge_free)
    problem = PaperRows(study.layout, study.layout.held(truth, noise, seed), sd, noise, weights)
    true = study.held_out.solve(truth)
    errors = {
        BEFORE: study.held_out.compute_errors(study.robot.parameters.nominal[None], truth, true)
    }
    failed, iterations = 0, np.zeros(trials, dtype=np.int64)
    for name, method in METHODS.items():
        descent = identify_from_rows(problem, method)
        errors[name] = study.held_out.compute_errors(problem.values(descent.deviation), truth, true)
        failed += int((descent.status != 0).sum())
        iterations = descent.iterations if name == LS else iterations
    return Cell(sd, noise, gauge_free, errors, iterations, failed)


def calibrate_grid(
    study: Study, seed: int, trials: int, progress: Callable[[str], None]
) -> dict[tuple[str, str], Cell]:
    """Return the 3 x 4 cells by (set, noise) as printed, taken as standard deviations."""
    cells = {}
    for given in read_published().sets:
        progress(f"Table 3, set {given} mm")
        for noise in read_published().noises:
            cells[given, noise] = calibrate_cell(
                study, float(given) * MM, float(noise) * MM, seed, trials
            )
    return cells


def compute_rank_correlation(cells: Iterable[Cell], method: str) -> float:
    """Return the rank correlation over cells of the reductions of parameters and positions."""
    both = np.array([c.compute_reduction(method) for c in cells])
    return _compute_spearman(
        both[:, MEASURES.index("parameters [mm]")], both[:, MEASURES.index("position [mm]")]
    )


def _compute_spearman(x: FloatArray, y: FloatArray) -> float:
    """Return the rank correlation of numbers without ties."""
    first, second = (np.argsort(np.argsort(v)).astype(np.float64) for v in (x, y))
    return float(np.corrcoef(first, second)[0, 1])
