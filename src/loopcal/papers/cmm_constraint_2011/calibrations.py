# SPDX-License-Identifier: Apache-2.0
"""Tables 3 and 4 repeated by LS and MAP: cells of machines with one size of errors and noise, and
the paper's experiment, fifty points spread over the workspace and then independent full poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.penalties import MAP, LeastSquares, Method
from loopcal.estimate.plane_line_products import PaperRows, Weights, identify_from_rows
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.papers.cmm_constraint_2011.machines import (
    AXES,
    FRAMES,
    MEASURES,
    Study,
    draw_true_machines,
    plan_points,
)
from loopcal.papers.cmm_constraint_2011.published import MM, read_published
from loopcal.papers.paper_studies import load_paper_study
from loopcal.studies.simulation.block import CalibratedCell, calibrate_cells, find_cells, set_size
from loopcal.typing import BoolArray, FloatArray, IntArray

BEFORE, LS, PRIOR = "before", "LS", "MAP"
METHODS: Mapping[str, Method] = {LS: LeastSquares(), PRIOR: MAP()}

FIFTY_SD = 1.0e-3
"""Of the true errors of machines calibrated from fifty points [m]: those of set 3."""
LINES = (1, 5)
"""Planes with a line each on which the fifty points lie."""
STATISTICS = ("position, mean [mm]", "position, standard deviation [mm]", "orientation, mean [deg]",
              "orientation, standard deviation [deg]")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Machines:
    """True values (t, p) [m] of t machines, and their estimates by method."""

    truth: FloatArray
    estimates: Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False)
class Cell:
    """t machines with errors of one size, calibrated from points with noise of one size.

    Attributes
    ----------
    sd, noise : standard deviations [m]. is_gauge_free : whether the true errors have no part
        that plane and line cannot determine.
    errors : by BEFORE, LS, MAP, (t, 7) see MEASURES. iterations : (t,) of LS. converged : by LS,
        MAP, (t,). machines : the true ones, and those that LS and MAP identified.
    """

    sd: float
    noise: float
    is_gauge_free: bool
    errors: Mapping[str, FloatArray]
    iterations: IntArray
    converged: Mapping[str, BoolArray]
    machines: Machines

    @property
    def failed(self) -> int:
        """Number of descents that did not converge."""
        return sum(int((~converged).sum()) for converged in self.converged.values())

    def compute_median(self, method: str) -> FloatArray:
        """Return medians (7,) over the machines on which the method converged."""
        return compute_median(self.errors[method], self.converged.get(method))

    def compute_reduction(self, method: str) -> FloatArray:
        """Return percentages (7,) by which the medians fall."""
        return 100.0 * (1.0 - self.compute_median(method) / self.compute_median(BEFORE))

    @property
    def ratio(self) -> float:
        """Noise over errors. To first order the reductions of cells depend on it only."""
        return float(f"{self.noise / self.sd:.6g}")

    def count_worse(self, method: str, measure: int) -> int:
        """Return how many machines a method makes worse, of those on which it converged."""
        is_worse = self.errors[method][:, measure] > self.errors[BEFORE][:, measure]
        return int((is_worse & self.converged[method]).sum())


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
    problem = PaperRows(
        study.layout, study.layout.solve_readings(truth, noise, seed), sd, noise, weights
    )
    descents = {name: identify_from_rows(problem, method) for name, method in METHODS.items()}
    values = {name: problem.values(descent.deviation) for name, descent in descents.items()}
    return Cell(
        sd,
        noise,
        gauge_free,
        _compute_errors(study, truth, values),
        descents[LS].iterations,
        {name: descent.status == DescentStatus.CONVERGED for name, descent in descents.items()},
        Machines(truth, values),
    )


def calibrate_grid(
    study: Study, seed: int, trials: int, progress: Callable[[str], None]
) -> dict[tuple[str, str], Cell]:
    """Return the 3 x 4 cells by (set, noise) as printed, taken as standard deviations: those of
    study.yaml at the points of this study.
    """
    grid = set_size(load_paper_study(__file__), seed, trials)
    (level,) = grid.poses.values()
    points = replace(level, coordinates=tuple(map(tuple, study.layout.flat.tolist())))
    grid = replace(grid, poses={"points": points})
    cells = {}
    for given in read_published().sets:
        progress(f"Table 3, set {given} mm")
        for noise in read_published().noises:
            levels = {"errors": f"set {given}", "instrument": f"{noise} mm"}
            made = {
                cell.levels["method"]: cell
                for cell in calibrate_cells(grid, find_cells(grid, **levels))
            }
            cells[given, noise] = _make_cell(study, float(given) * MM, float(noise) * MM, made)
    return cells


def _make_cell(study: Study, sd: float, noise: float, made: Mapping[str, CalibratedCell]) -> Cell:
    """Return the same machines calibrated by LS and MAP."""
    truth, values = made[LS].truth, {name: cell.values for name, cell in made.items()}
    return Cell(
        sd,
        noise,
        False,
        _compute_errors(study, truth, values),
        made[LS].iterations,
        {name: cell.is_converged for name, cell in made.items()},
        Machines(truth, values),
    )


def _compute_errors(
    study: Study, truth: FloatArray, values: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Return errors (t, 7) before calibration and by each method."""
    true, nominal = study.held_out.solve(truth), study.robot.parameters.nominal[None]
    return {
        name: study.held_out.compute_errors(machines, truth, true)
        for name, machines in {BEFORE: nominal, **values}.items()
    }


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


@dataclass(frozen=True, eq=False)
class FiftyPoints:
    """t machines calibrated from fifty points.

    Attributes
    ----------
    groups : planes. iterations : (t,) of least squares. converged : by LS, MAP, (t,).
    rank : (t,) of least squares.
    statistics : by method and frame (see FRAMES), (t, 4) see STATISTICS, over held-out poses.
    """

    groups: int
    iterations: IntArray
    converged: Mapping[str, BoolArray]
    rank: IntArray
    statistics: dict[tuple[str, str], FloatArray]

    @property
    def within_five(self) -> float:
        """Percentage of the machines on which least squares converges within 5 iterations."""
        return 100.0 * float(np.mean((self.iterations <= 5) & self.converged[LS]))

    @property
    def most_iterations(self) -> int:
        """Largest number of iterations of least squares."""
        return int(self.iterations.max())

    def compute_median(self, method: str, frame: str) -> FloatArray:
        """Return medians (4,) over the machines on which the method converged."""
        return compute_median(self.statistics[method, frame], self.converged.get(method))

    def compute_factors(self, method: str, frame: str) -> FloatArray:
        """Return the factors (4,) by which calibration reduces the medians."""
        return self.compute_median("before", frame) / self.compute_median(method, frame)


def calibrate_fifty(study: Study, groups: int, seed: int, trials: int) -> FiftyPoints:
    """Calibrate machines from fifty random points with the noise of the paper's instrument."""
    points = read_published().measured // groups
    layout = plan_points(study.robot, groups, points, AXES, seed + 2, sweeps=0).layout
    truth = draw_true_machines(study.robot, FIFTY_SD, trials, seed)
    problem = PaperRows(
        layout,
        layout.solve_readings(truth, read_published().accuracy, seed),
        FIFTY_SD,
        read_published().accuracy,
    )
    true, nominal = study.held_out.solve(truth), study.robot.parameters.nominal[None]
    machines, descents = {"before": nominal}, {}
    for name, method in METHODS.items():
        descents[name] = identify_from_rows(problem, method)
        machines[name] = problem.values(descents[name].deviation)
    statistics = {
        (name, frame): _compute_statistics(study.held_out.compute_twists(values, true, frame))
        for name, values in machines.items()
        for frame in FRAMES
    }
    ls = descents[LS]
    converged = {name: d.status == DescentStatus.CONVERGED for name, d in descents.items()}
    return FiftyPoints(groups, ls.iterations, converged, ls.decomposition.rank, statistics)


def compute_median(errors: FloatArray, converged: BoolArray | None = None) -> FloatArray:
    """Return medians (k,) of errors (t, k) of the converged machines (t,); NaN without any."""
    kept = errors if converged is None else errors[converged]
    return np.median(kept, axis=0) if len(kept) else np.full(errors.shape[1], np.nan)


def _compute_statistics(twists: FloatArray) -> FloatArray:
    """Return statistics (t, 4), see STATISTICS, of differences (t, n, 6)."""
    position = np.linalg.norm(twists[:, :, 3:], axis=2) / MM
    orientation = np.rad2deg(np.linalg.norm(twists[:, :, :3], axis=2))
    return np.stack(
        [part(e, axis=1) for e in (position, orientation) for part in (np.mean, np.std)], axis=1
    )
