# SPDX-License-Identifier: Apache-2.0
"""What an identification costs: against numpy's own decompositions, with a prior, for many filters,
trials and poses.
"""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.harness import Metric, measure_ratio, time_in_turns
from loopcal.diagnose.cross_validation import score_leave_one_out
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge, TruncatedSVD
from loopcal.estimate.problem import problem_of
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.model import Mechanism

UM, URAD = 1e-6, 1e-6
TRIALS = 1000
SIZES = (1_000, 10_000, 100_000)
GROUPS, TOUCHES = 400, 4


def _tracker() -> Instrument:
    return Instrument((Sensor(Pose(), Gaussian(np.array([5 * URAD] * 3 + [UM] * 3))),))


def _poses(robot: Mechanism, n: int) -> np.ndarray:
    """Random controlled coordinates in the workspace."""
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    return np.random.default_rng(0).uniform(ranges[:, 0], ranges[:, 1], (n, len(ranges)))


def _measured(robot: Mechanism, n: int) -> Measurements:
    """A machine drawn from the tolerances, measured in n poses."""
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    return simulate(truth, _poses(robot, n), _tracker(), 0)


def bench_fit() -> Metric:
    """Fit 42 parameters to 50 poses, against the singular value decompositions of its steps'
    matrices alone.
    """
    robot = load_robot("hexapod-42")
    data = _measured(robot, 50)
    steps = identify(robot, data, LeastSquares()).history.iterations
    A = np.random.default_rng(0).normal(size=(300, 42))

    def decompositions() -> None:
        for _ in range(steps):
            np.linalg.svd(A, full_matrices=False)

    return measure_ratio(
        "identify.fit_of_its_svds",
        lambda: identify(robot, data, LeastSquares()),
        decompositions,
        repeats=31,
        # The aim is 6, which no version reached (8.6 to 10). The rest is the cost of some thousand
        # small numpy calls (13 Newton steps, 3 linearizations), which only compiled code avoids.
        limit=10.0,
    )


def bench_map() -> Metric:
    """Time MAP with covariance, prior conflict test and inflation, against least squares."""
    robot = load_robot("hexapod-42")
    data = _measured(robot, 50)
    return measure_ratio(
        "identify.map_of_least_squares",
        lambda: (identify(robot, data, MAP()).covariance, identify(robot, data).covariance),
        lambda: (identify(robot, data, LeastSquares()), identify(robot, data, LeastSquares())),
        repeats=31,
        limit=1.5,
    )


def bench_filters() -> Metric:
    """Forty ridge parameters and all truncations with leave-one-out from one linearisation, against
    one fit.
    """
    robot = load_robot("hexapod-42")
    data = _measured(robot, 50)
    fit = identify(robot, data, LeastSquares())
    ridges = (Ridge(float(lam)) for lam in np.logspace(-8.0, 4.0, 40))
    methods = (*ridges, *(TruncatedSVD(k) for k in range(43)))
    return measure_ratio(
        "identify.paths_of_one_fit",
        lambda: score_leave_one_out(fit.robot, data, methods),
        lambda: identify(robot, data, LeastSquares()),
        repeats=15,
        limit=5.0,
    )


def bench_trials() -> Metric:
    """A thousand simulated machines at once, against one after the other (a twentieth of them),
    time for each fit.
    """
    robot = load_robot("hexapod-42")
    trials = simulate_trials(
        robot, sample_truth(robot, TRIALS, 0), _poses(robot, 50), _tracker(), 0
    )
    single = [trials.trial(i) for i in range(0, TRIALS, 20)]
    alone, together = time_in_turns(
        lambda: [identify(robot, data, LeastSquares()) for data in single],
        lambda: identify_trials(robot, trials, LeastSquares()),
        repeats=3,
    )
    value = 20 * min(alone) / min(together)
    note = f"{min(together) / TRIALS * 1e3:.3g} ms a fit"
    return Metric("identify.stacked_speed_up", value, "1", "higher", 0.25, 1.5, note)


def bench_poses() -> list[Metric]:
    """Exponent of the cost over the number of poses, and growth of the memory of folding, up to 1e5
    poses.
    """
    robot = load_robot("hexapod-42")
    largest = _measured(robot, SIZES[-1])
    parts = [largest.take(np.arange(n)) for n in SIZES[:-1]] + [largest]
    times = time_in_turns(
        *(lambda d=d: identify(robot, d, LeastSquares()) for d in parts), repeats=2
    )
    seconds = [min(t) for t in times]
    exponent = float(np.polyfit(np.log(SIZES), np.log(seconds), 1)[0])
    memory = [_memory_of_folding(robot, d) for d in parts]
    return [
        Metric(
            "identify.exponent_of_poses",
            exponent,
            "1",
            "lower",
            0.05,
            1.05,
            f"{seconds[-1]:.3g} s for 1e5 poses",
        ),
        Metric(
            "identify.memory_of_poses",
            memory[2] / memory[1],
            "1",
            "lower",
            0.1,
            1.1,
            f"{memory[2] / 1e6:.3g} MB",
        ),
    ]


def _memory_of_folding(robot: Mechanism, data: Measurements) -> float:
    """Peak of what one folding of the rows allocates [bytes], its input not counted."""
    free = select_free_parameters(robot)
    problem = problem_of(free, data)
    z = free.deviation(robot.values[None])
    start = problem.linearize(z, problem.start(z)).next_start
    tracemalloc.start()
    problem.linearize(z, start)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return float(peak)


def bench_latent() -> Metric:
    """Fit with noisy readings, every pose an unknown, against the fit of the same data with exact
    ones.
    """
    robot = load_robot("hexapod-42")
    data = _measured(robot, 50)
    uncertain = replace(data, reading_sigma=2 * UM)
    return measure_ratio(
        "identify.latent_of_exact",
        lambda: identify(robot, uncertain, LeastSquares()),
        lambda: identify(robot, data, LeastSquares()),
        repeats=15,
        limit=10.0,
    )


def bench_groups() -> Metric:
    """Fold the touches of 400 planes that share an unknown probe, against the same with a known
    one, each plane by itself.
    """
    robot = load_robot("hexapod-42")
    free, group = (
        select_free_parameters(robot),
        np.array([f"plane{i % GROUPS}" for i in range(GROUPS * TOUCHES)]),
    )
    z = free.deviation(robot.values[None])

    def folding(unknown: tuple[str, ...]) -> Callable[[], object]:
        probe = Plane(unknown=unknown, targets=("probe",), places=np.array([[0.0, 0.0, 0.06]]))
        touching = Instrument((Sensor(probe, Gaussian(np.full(1, 5 * UM)), group=group),))
        problem = problem_of(free, simulate(robot, _poses(robot, len(group)), touching, 0))
        start = problem.start(z, seek=False)
        return lambda: problem.linearize(z, start)

    return measure_ratio(
        "identify.shared_of_known_probe",
        folding(("surface", "targets")),
        folding(("surface",)),
        repeats=7,
        limit=1.5,
    )
