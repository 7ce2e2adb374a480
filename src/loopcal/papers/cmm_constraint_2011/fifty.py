# SPDX-License-Identifier: Apache-2.0
"""The paper's experiment, simulated: fifty points spread over the workspace, then independent full
poses (its Table 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.papers.cmm_constraint_2011.cells import METHODS
from loopcal.papers.cmm_constraint_2011.published import MM, published
from loopcal.papers.cmm_constraint_2011.steps import PaperRows, identify_from_rows
from loopcal.papers.cmm_constraint_2011.study import AXES, FRAMES, Study, plan, true_machines
from loopcal.papers.printed import Table
from loopcal.typing import FloatArray, IntArray

SD = 1.0e-3
"""Of the true errors [m]: those of set 3."""
LINES = (1, 5)
"""Planes with a line each on which the fifty points lie."""
STATISTICS = ("position, mean [mm]", "position, standard deviation [mm]", "orientation, mean [deg]",
              "orientation, standard deviation [deg]")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Fifty:
    """t machines calibrated from fifty points.

    Attributes
    ----------
    groups : planes. iterations : (t,) of least squares. converged : (t,). rank : (t,).
    statistics : by method and frame (see FRAMES), (t, 4) see STATISTICS, over the unseen poses.
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

    def median(self, method: str, frame: str) -> FloatArray:
        """(4,) over the machines."""
        return np.median(self.statistics[method, frame], axis=0)

    def factors(self, method: str, frame: str) -> FloatArray:
        """(4,) how many times smaller the medians are after calibration."""
        return self.median("before", frame) / self.median(method, frame)


def fifty(study: Study, groups: int, seed: int, trials: int) -> Fifty:
    """Calibrate machines from fifty random points on `groups` planes, the noise that of the paper's
    measuring machine.
    """
    points = published().measured // groups
    layout = plan(study.robot, groups, points, AXES, seed + 2, sweeps=0).layout
    truth = true_machines(study.robot, SD, trials, seed)
    problem = PaperRows(
        layout, layout.held(truth, published().accuracy, seed), SD, published().accuracy
    )
    true, nominal = study.unseen.poses(truth), study.robot.parameters.nominal[None]
    machines, found = {"before": nominal}, {}
    for name, method in METHODS.items():
        found[name] = identify_from_rows(problem, method)
        machines[name] = problem.values(found[name].deviation)
    statistics = {
        (name, frame): _statistics(study.unseen.twists(values, true, frame))
        for name, values in machines.items()
        for frame in FRAMES
    }
    ls = found["LS"]
    return Fifty(groups, ls.iterations, ls.status == 0, ls.decomposition.rank, statistics)


def _statistics(twists: FloatArray) -> FloatArray:
    """(t, 4) see STATISTICS, of differences (t, n, 6)."""
    position = np.linalg.norm(twists[:, :, 3:], axis=2) / MM
    orientation = np.rad2deg(np.linalg.norm(twists[:, :, :3], axis=2))
    return np.stack(
        [part(e, axis=1) for e in (position, orientation) for part in (np.mean, np.std)], axis=1
    )


def fifty_table(found: tuple[Fifty, ...]) -> Table:
    """Table 4 for simulated machines."""
    rows = []
    for one in found:
        words = f"{one.groups} {'plane, one line' if one.groups == 1 else 'planes, a line each'}"
        for method, frame in one.statistics:
            rows.append((words, frame, method, *map(float, one.median(method, frame))))
    columns = ("50 points on", "frame", "method", *STATISTICS)
    note = (
        f"Medians of {len(found[0].iterations)} machines with errors of 1 mm, noise "
        f"{published().accuracy / MM:g} mm (the"
        " stated accuracy of the measuring machine), points drawn at random, errors at 100 other "
        "poses. Absolute: base and"
        " platform where the least deviation leaves them; gauge at nominal: where poses are "
        "nearest to those as designed, an"
        " equally good answer to the same data; aligned: nearest to the true ones, which is what "
        "the data can be judged by."
    )
    title = "Fifty points, verified by full poses (in place of Table 4)"
    return Table(
        "table_4", title, columns, tuple(rows), ("", "", "", ".3g", ".3g", ".3g", ".3g"), note
    )
