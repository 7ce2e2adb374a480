# SPDX-License-Identifier: Apache-2.0
"""Planning: coordinate exchange of 100 poses relative to 100 QR factorizations of the rows of
these poses, and a certified choice of 20 of 1000.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Metric, measure_ratio, measure_time
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.information import observe_poses
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import WorkspaceSample, sample_workspace
from loopcal.planning.design_space import Criterion, DesignProblem, PriorInformation
from loopcal.planning.exchange import choose_design, coordinate_exchange

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


def bench_coordinate_exchange() -> Metric:
    """Time the improvement of 100 random poses of the hexapod, criterion D, relative to 100 QR
    factorizations of all their rows.
    """
    free, drawn, middle, half = _hexapod()
    levels = [m + h * np.array(SHARES) for m, h in zip(middle, half, strict=True)]
    begin = drawn.coordinates[:POSES]
    start = PriorInformation.none(len(free))
    stack = np.random.default_rng(0).normal(size=(POSES * len(SIGMA), len(free)))

    def factorize() -> None:
        for _ in range(100):
            np.linalg.qr(stack, mode="r")

    return measure_ratio(
        "plan.coordinate_exchange",
        lambda: coordinate_exchange(lambda _, x: _rows(x), begin, levels, Criterion("D"), start),
        factorize,
        repeats=3,
        tolerance=0.5,
    )


def bench_certified_design() -> list[Metric]:
    """Time the choice of 20 of 1000 full poses of the hexapod, with its certificate, against the
    singular value decomposition of all their rows.
    """
    free, drawn, _, _ = _hexapod()
    rows = observe_poses(free, drawn.solution.q).twists[0] / SIGMA[:, None]
    stacked = rows.reshape(-1, rows.shape[-1])
    return measure_time(
        "plan.certified_design",
        lambda: choose_design(
            DesignProblem(rows, Criterion("D"), PriorInformation.none(len(free))), 20
        ),
        lambda: np.linalg.svd(stacked, full_matrices=False),
        limit=10.0,
        reference_name="svd",
        repeats=3,
        tolerance=0.5,
    )
