# SPDX-License-Identifier: Apache-2.0
"""The same points as the library takes them: surfaces with unknown direction, height and shifts,
one set for each group.

Kinds `plane` and `line` that name the same surface share the unknowns of that name, so that the
line is perpendicular to the plane by construction. Measured gaps are zero: the coordinates were
held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.information import collect_information
from loopcal.estimate.plane_line_products import Layout, PaperRows, identify_from_rows
from loopcal.measure.instrument import Gaussian
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.papers.cmm_constraint_2011.calibrations import LS, METHODS
from loopcal.papers.cmm_constraint_2011.machines import Study, draw_true_machines
from loopcal.planning.plane_line_planning import make_plane_line_instrument
from loopcal.typing import FloatArray

ERRORS, NOISES = 1e-3, (1e-6, 1e-5)
"""Standard deviations [m] of parameters and of held coordinates."""
HARDEST, SHARE = (max(NOISES), LS), 5
"""The noise and method with which fits converge worst, identified on all machines; with the others
on one machine of so many."""


@dataclass(frozen=True)
class FormRow:
    """How the two forms differ over many machines, with one noise and one method.

    Attributes
    ----------
    noise : [m]. method : its name. machines : their number. converged : on how many both forms
        converged; the differences are of these.
    iterations : largest number with surfaces as unknowns. ranks : that occur there.
    median, largest : over the machines, of the largest difference of the estimates along an
        identifiable direction [sd].
    """

    noise: float
    method: str
    machines: int
    converged: int
    iterations: int
    ranks: tuple[int, ...]
    median: float
    largest: float


@dataclass(frozen=True)
class Forms:
    """How the two forms differ.

    Attributes
    ----------
    hardest : all machines, with HARDEST. others : a part of them, with other noises and methods.
    covariance : largest relative difference of a variance.
    """

    hardest: FormRow
    others: tuple[FormRow, ...]
    covariance: float

    @property
    def rows(self) -> tuple[FormRow, ...]:
        """All rows, the hardest first."""
        return (self.hardest, *self.others)


def build_measurements(layout: Layout, q: FloatArray, sigma: float) -> Measurements:
    """Return points on planes and lines as measurements.

    Parameters
    ----------
    layout : lines along any axes of the base. q : (n, a) readings [SI]. sigma : of a held
        coordinate [m].
    """
    number = np.arange(layout.points).reshape(layout.groups, -1)
    axis = np.abs(layout.levers[0]).argmax(axis=1)
    instrument = make_plane_line_instrument(
        layout.robot, axis, number, lambda _, gaps: Gaussian(np.full(gaps, sigma))
    )
    observations = tuple(
        Observations.from_sigma(
            sensor.kind,
            sensor.assigned_rows,
            np.zeros((len(sensor.assigned_rows), len(sensor.noise.sigma))),
            sigma,
            group=sensor.group,
        )
        for sensor in instrument.sensors
    )
    return Measurements(layout.robot.name, q, observations)


def compare_forms(study: Study, seed: int, trials: int) -> Forms:
    """Identify machines in both forms, at several noises and by both methods.

    All `trials` machines are identified with HARDEST, a part of them with the others: these fits
    take most of the time of the study.
    """
    few = max(trials // SHARE, 2)
    truth = draw_true_machines(study.robot, ERRORS, trials, seed)
    rows = {}
    for noise in NOISES:
        q = study.layout.solve_readings(truth, noise, seed)
        for name in METHODS:
            count = trials if (noise, name) == HARDEST else few
            rows[noise, name] = compare_estimates(study.layout, q[:count], noise, name)
    hardest = rows.pop(HARDEST)
    return Forms(hardest, tuple(rows.values()), compare_covariances(study.layout, NOISES[0]))


def compare_estimates(layout: Layout, q: FloatArray, noise: float, name: str) -> FormRow:
    """Identify machines with readings (t, n, a) in both forms by one method."""
    sd = select_free_parameters(layout.robot).tolerance[0]
    problem = PaperRows(layout, q, sd, noise)
    paper = identify_from_rows(problem, METHODS[name], 1e-6)
    values = problem.values(paper.deviation)
    iterations, ranks, unlike = 0, set(), []
    for i, readings in enumerate(q):
        data = build_measurements(layout, readings, noise)
        fit = identify(layout.robot, data, METHODS[name])
        iterations, ranks = max(iterations, fit.history.iterations), ranks | {fit.rank}
        if fit.history.status == paper.status[i] == DescentStatus.CONVERGED:
            paper_row = PaperRows(layout, q[i : i + 1], sd, noise)
            unlike.append(float(np.abs(_count_sds(paper_row, fit.robot.values - values[i])).max()))
    middle, largest = (np.median(unlike), max(unlike)) if unlike else (np.nan, np.nan)
    return FormRow(
        noise, name, len(q), len(unlike), iterations, tuple(sorted(ranks)), float(middle), largest
    )


def compare_covariances(layout: Layout, noise: float) -> float:
    """Return the largest relative difference of the variances that both forms give any direction,
    on surfaces reached exactly.
    """
    robot = layout.robot
    q = layout.solve_readings(robot.parameters.nominal[None], 0.0, 0)
    free = select_free_parameters(robot)
    factor = collect_information(free, build_measurements(layout, q[0], noise))[0]
    s, vt = _decompose_rows(PaperRows(layout, q, free.tolerance[0], noise))
    ratio = np.linalg.svd(factor[0, : len(free), : len(free)] @ (vt.T / s), compute_uv=False)
    return float(np.abs(ratio**2 - 1.0).max())


def _count_sds(problem: PaperRows, change: FloatArray) -> FloatArray:
    """Return a change of the parameters (p,) [m] along the identifiable directions, in standard
    deviations (rank,).
    """
    s, vt = _decompose_rows(problem)
    return s * (vt @ change) / problem.sd


def _decompose_rows(problem: PaperRows) -> tuple[FloatArray, FloatArray]:
    """Return singular values and directions of the paper's rows that count, of the first machine as
    designed.
    """
    A = problem.whiten(np.zeros((1, problem.parameters)), np.zeros(1, dtype=np.int64))[0][0, :, :-1]
    _, s, vt = np.linalg.svd(A, full_matrices=False)
    kept = s > 1e-10 * s[0]
    return s[kept], vt[kept]
