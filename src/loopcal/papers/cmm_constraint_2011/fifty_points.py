# SPDX-License-Identifier: Apache-2.0
"""The paper's experiment, simulated: fifty points spread over the workspace, then independent full
poses (its Table 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.papers.cmm_constraint_2011.cells import METHODS
from loopcal.papers.cmm_constraint_2011.machines import (
    AXES,
    FRAMES,
    Study,
    draw_true_machines,
    plan_points,
)
from loopcal.papers.cmm_constraint_2011.published import MM, read_published
from loopcal.papers.cmm_constraint_2011.steps import PaperRows, identify_from_rows
from loopcal.typing import FloatArray, IntArray

SD = 1.0e-3
"""Of the true errors [m]: those of set 3."""
LINES = (1, 5)
"""Planes with a line each on which the fifty points lie."""
STATISTICS = ("position, mean [mm]", "position, standard deviation [mm]", "orientation, mean [deg]",
              "orientation, standard deviation [deg]")  # fmt: skip


@dataclass(frozen=True, eq=False)
class FiftyPoints:
    """t machines calibrated from fifty points.

    Attributes
    ----------
    groups : planes. iterations : (t,) of least squares. converged : (t,). rank : (t,).
    statistics : by method and frame (see FRAMES), (t, 4) see STATISTICS, over held-out poses.
    """

    groups: int
    iterations: IntArray
    converged: np.ndarray
    rank: IntArray
    statistics: dict[tuple[str, str], FloatArray]

    @property
    def within_five(self) -> float:
        """Percentage of the machines on which least squares converges within 5 iterations."""
        return 100.0 * float(np.mean((self.iterations <= 5) & self.converged))

    @property
    def most_iterations(self) -> int:
        """Largest number of iterations of least squares."""
        return int(self.iterations.max())

    def compute_median(self, method: str, frame: str) -> FloatArray:
        """Return medians (4,) over the machines."""
        return np.median(self.statistics[method, frame], axis=0)

    def compute_factors(self, method: str, frame: str) -> FloatArray:
        """Return the factors (4,) by which calibration reduces the medians."""
        return self.compute_median("before", frame) / self.compute_median(method, frame)


def calibrate_fifty(study: Study, groups: int, seed: int, trials: int) -> FiftyPoints:
    """Calibrate machines from fifty random points with the noise of the paper's instrument."""
    points = read_published().measured // groups
    layout = plan_points(study.robot, groups, points, AXES, seed + 2, sweeps=0).layout
    truth = draw_true_machines(study.robot, SD, trials, seed)
    problem = PaperRows(
        layout, layout.held(truth, read_published().accuracy, seed), SD, read_published().accuracy
    )
    true, nominal = study.held_out.solve(truth), study.robot.parameters.nominal[None]
    machines, descents = {"before": nominal}, {}
    for name, method in METHODS.items():
        descents[name] = identify_from_rows(problem, method)
        machines[name] = problem.values(descents[name].deviation)
    statistics = {
        (name, frame): _statistics(study.held_out.compute_twists(values, true, frame))
        for name, values in machines.items()
        for frame in FRAMES
    }
    ls = descents["LS"]
    return FiftyPoints(groups, ls.iterations, ls.status == 0, ls.decomposition.rank, statistics)


def _statistics(twists: FloatArray) -> FloatArray:
    """Return statistics (t, 4), see STATISTICS, of differences (t, n, 6)."""
    position = np.linalg.norm(twists[:, :, 3:], axis=2) / MM
    orientation = np.rad2deg(np.linalg.norm(twists[:, :, :3], axis=2))
    return np.stack(
        [part(e, axis=1) for e in (position, orientation) for part in (np.mean, np.std)], axis=1
    )
