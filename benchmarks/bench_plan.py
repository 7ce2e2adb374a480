# SPDX-License-Identifier: Apache-2.0
"""Planning: coordinate exchange of 100 poses, a certified choice of 20 of 1000, and a whole plan of
40 of 500, relative to an exchange by hand.

The references are what one would write with NumPy: they consist of as many small arrays as the
subjects. Factorizations of all rows, the references before, are one call of LAPACK: on a processor
on which it is fast beside Python the ratios grew by 40 %. Times are those of the process, since a
busy machine disturbs a long subject more often than a short reference.
"""

import time
from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Metric, measure_ratio, measure_time
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.information import observe_poses
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import WorkspaceSample, sample_workspace
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.design_space import Criterion, DesignProblem, PriorInformation
from loopcal.planning.exchange import choose_design, coordinate_exchange
from loopcal.planning.pose_planning import plan

Array = NDArray[np.float64]
SIGMA = np.array([5e-5] * 3 + [1e-5] * 3)
"""Of a full pose: rotation [rad] and position [m]."""

POSES, SHARES = 100, (-1.0, -0.5, 0.0, 0.5, 1.0)


@cache
def _hexapod() -> tuple[FreeParameters, WorkspaceSample, Array, Array]:
    """Return free parameters, sampled poses, and mean and half range of their coordinates."""
    free = select_free_parameters(load_robot("hexapod-42"))
    drawn = sample_workspace(free.robot, 1000, 0)
    return free, drawn, drawn.coordinates.mean(axis=0), 0.5 * np.ptp(drawn.coordinates, axis=0)


def _rows(coordinates: np.ndarray) -> np.ndarray:
    """Return whitened rows (b, 6, p) at controlled coordinates (b, 6); NaN where out of reach."""
    free = _hexapod()[0]
    solution = inverse(free.robot, coordinates)
    rows = (
        observe_poses(free, np.where(solution.converged[:, None], solution.q, 0.0)).twists[0]
        / SIGMA[:, None]
    )
    return np.where(solution.converged[:, None, None], rows, np.nan)


def _exchange_by_hand(rows: Array, n: int) -> Array:
    """Return n of the groups of rows (N, r, p): a greedy start, and one pass of Fedorov exchange
    for the largest determinant of the information.
    """

    def gain(M: Array) -> Array:
        """Return the log determinants (N,) that each group multiplies the one of M by."""
        return np.linalg.slogdet(
            np.eye(rows.shape[1]) + rows @ np.linalg.solve(M, rows.swapaxes(1, 2))
        )[1]

    scale = np.sqrt((rows**2).sum(axis=(0, 1)))
    rows = rows / scale
    M, places = 1e-6 * np.eye(rows.shape[2]), list[int]()
    for _ in range(n):
        places.append(int(np.argmax(gain(M))))
        M = M + rows[places[-1]].T @ rows[places[-1]]
    chosen = np.array(places)
    for j in range(n):
        M = M - rows[chosen[j]].T @ rows[chosen[j]]
        chosen[j] = np.argmax(gain(M))
        M = M + rows[chosen[j]].T @ rows[chosen[j]]
    return chosen


def bench_coordinate_exchange() -> Metric:
    """Time the improvement of 100 random poses of the hexapod, criterion D, relative to one pass by
    hand over the same levels, with their rows given.
    """
    free, drawn, middle, half = _hexapod()
    levels = [m + h * np.array(SHARES) for m, h in zip(middle, half, strict=True)]
    begin = drawn.coordinates[:POSES]
    start = PriorInformation.none(len(free))
    given = np.random.default_rng(0).normal(size=(len(middle), POSES, len(SHARES), 6, len(free)))

    def exchange_by_hand() -> None:
        present = given[0, :, 0].copy()
        M = np.einsum("nri,nrj->ij", present, present)
        for trials in given:
            for i, levels in enumerate(trials):
                less = M - present[i].T @ present[i]
                more = np.eye(6) + levels @ np.linalg.solve(less, levels.swapaxes(1, 2))
                present[i] = levels[np.argmax(np.linalg.slogdet(more)[1])]
                M = less + present[i].T @ present[i]

    return measure_ratio(
        "plan.coordinate_exchange_of_one_pass",
        lambda: coordinate_exchange(lambda _, x: _rows(x), begin, levels, Criterion("D"), start),
        exchange_by_hand,
        repeats=5,
        tolerance=0.3,
        clock=time.process_time,
    )


def bench_certified_design() -> list[Metric]:
    """Time the choice of 20 of 1000 full poses of the hexapod, with its certificate, against a
    choice by hand.
    """
    free, drawn, _, _ = _hexapod()
    rows = observe_poses(free, drawn.solution.q).twists[0] / SIGMA[:, None]
    return measure_time(
        "plan.certified_design",
        lambda: choose_design(
            DesignProblem(rows, Criterion("D"), PriorInformation.none(len(free))), 20
        ),
        lambda: _exchange_by_hand(rows, 20),
        limit=2.0,
        reference_name="exchange",
        repeats=5,
        tolerance=0.3,
        clock=time.process_time,
    )


def bench_whole_plan() -> list[Metric]:
    """Time a plan of 40 of 500 full poses of the hexapod with certificate, held-out poses and path,
    criterion I, against a choice of 40 of 500 by hand.
    """
    free, drawn, _, _ = _hexapod()
    seen_by = Instrument((Sensor(KINDS["pose"](), Gaussian(SIGMA)),))
    rows = observe_poses(free, drawn.solution.q[:500]).twists[0] / SIGMA[:, None]
    return measure_time(
        "plan.whole",
        lambda: plan(free.robot, seen_by, 40, options=PlanOptions(n_candidates=500)),
        lambda: _exchange_by_hand(rows, 40),
        limit=300.0,
        unit="ms",
        reference_name="exchange",
        repeats=7,
        tolerance=0.3,
        clock=time.process_time,
    )
