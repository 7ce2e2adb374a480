# SPDX-License-Identifier: Apache-2.0
"""What kinematics and fits cost with each installed engine, in processor time of one thread,
against numpy on the same amount of work and against a fit that a user writes by hand.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench_identify import _measured, _poses, _tracker
from benchmarks.bench_kinematics import _problem
from benchmarks.bench_sensitivity import _first_answer, _record
from benchmarks.bench_start import import_numpy, read_processor_time, run_python
from benchmarks.harness import Metric, measure_ratio, time_in_turns
from loopcal.engine import get_current_engine
from loopcal.engine.selection import VARIABLE
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.simulation import Trials, sample_truth, simulate, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward, inverse

ENGINES = ("numpy", "native") if find_spec("loopcal_native") else ("numpy",)
POSES, TRIALS, MANY = 10_000, 200, 10_000
ROOT = Path(__file__).resolve().parents[1]

measure = partial(measure_ratio, clock=time.process_time, tolerance=0.3)


@contextmanager
def use_engine(name: str) -> Iterator[None]:
    """Compute the body with an engine."""
    before = os.environ.get(VARIABLE, "")
    os.environ[VARIABLE] = name
    get_current_engine.cache_clear()
    try:
        yield
    finally:
        os.environ[VARIABLE] = before
        get_current_engine.cache_clear()


def _of_each(
    name: str, make: Callable[[], tuple[Callable[[], object], Callable[[], object]]], repeats: int
) -> list[Metric]:
    """Measure work and reference that `make` returns, for each engine."""
    metrics = []
    for engine in ENGINES:
        with use_engine(engine):
            subject, reference = make()
            metrics.append(measure(f"engine.{engine}.{name}", subject, reference, repeats=repeats))
    return metrics


def _systems() -> Callable[[], object]:
    """Return numpy's solution of as many 6 x 6 systems as there are poses."""
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(POSES, 6, 6)), rng.normal(size=(POSES, 6, 1))
    return lambda: np.linalg.solve(A, b)


def bench_kinematics() -> list[Metric]:
    """Forward and inverse kinematics of 10 000 hexapod poses, and all sensitivities of a hexapod
    of chains (102 parameters), against np.linalg.solve of as many 6 x 6 systems.
    """
    robot, target, readings, _, _ = _problem()
    chains, rng = _first_answer(_record().expand()), np.random.default_rng(0)
    values, q = chains.values[None], rng.uniform(-0.02, 0.02, (1, POSES, 6))
    state = forward_trials(chains, values, q)
    return [
        *_of_each("forward", lambda: (lambda: forward(robot, readings), _systems()), 7),
        *_of_each("inverse", lambda: (lambda: inverse(robot, target), _systems()), 7),
        *_of_each(
            "sensitivity",
            lambda: (lambda: differentiate_pose(chains, values, q, state), _systems()),
            5,
        ),
    ]


def bench_stacked_fits() -> list[Metric]:
    """Fits of 42 parameters to 50 poses of many machines at once, against np.linalg.qr of their
    300 x 43 rows.
    """
    robot = load_robot("hexapod-42")
    truth = sample_truth(robot, TRIALS, 0)
    trials = simulate_trials(robot, truth, _poses(robot, 50), _tracker(), 0)
    rows = np.random.default_rng(0).normal(size=(TRIALS, 300, 43))
    return _of_each(
        "stacked_fits",
        lambda: (
            lambda: identify_trials(robot, trials, LeastSquares()),
            lambda: np.linalg.qr(rows, mode="r"),
        ),
        3,
    )


def bench_chord_fits() -> list[Metric]:
    """The same fits as in studies: the first step of all by one factor."""
    robot = load_robot("hexapod-42")
    trials = simulate_hexapods(TRIALS)
    rows = np.random.default_rng(0).normal(size=(TRIALS, 300, 43))
    fit = partial(identify_trials, robot, trials, LeastSquares(), chord_start=True)
    return _of_each("chord_fits", lambda: (fit, lambda: np.linalg.qr(rows, mode="r")), 3)


def bench_threads() -> list[Metric]:
    """How many times as fast two threads are as one, in wall time, both measured in turns: 10 000
    fits of studies. It needs two idle processors.
    """
    robot, trials = load_robot("hexapod-42"), simulate_hexapods(MANY)
    fit = partial(identify_trials, robot, trials, LeastSquares(), chord_start=True)
    metrics = []
    for engine in ENGINES:
        with use_engine(engine):
            fits = (partial(fit, threads=n) for n in (1, 2))
            one, two = map(min, time_in_turns(*fits, repeats=3))
        name = f"engine.{engine}.two_threads"
        note = f"one {one:.1f} s, two {two:.1f} s"
        metrics.append(Metric(name, one / two, direction="higher", tolerance=0.3, note=note))
    return metrics


def simulate_hexapods(count: int) -> Trials:
    """Return measurements of 50 poses of so many hexapods."""
    robot = load_robot("hexapod-42")
    truth = sample_truth(robot, count, 0)
    return simulate_trials(robot, truth, _poses(robot, 50), _tracker(), 0)


def bench_single_fit() -> list[Metric]:
    """One fit of 42 parameters to 50 poses with all that `identify` returns, against scipy's
    Levenberg-Marquardt on leg lengths with a Jacobian written by hand.
    """
    robot = load_robot("hexapod-42")
    return _of_each(
        "one_fit",
        lambda: (
            partial(identify, robot, _measured(robot, 50), LeastSquares()),
            _fit_by_hand(robot.values.reshape(6, 7)),
        ),
        15,
    )


def bench_many_poses() -> list[Metric]:
    """One fit of 42 parameters to 100,000 poses, against np.linalg.qr of its 600,000 x 43 rows."""
    robot = load_robot("hexapod-42")
    data = _measured(robot, 100_000)
    rows = np.random.default_rng(0).normal(size=(100, 6000, 43))

    def factorize() -> None:
        np.linalg.qr(np.asarray(np.linalg.qr(rows, mode="r")).reshape(-1, 43), mode="r")

    return _of_each(
        "many_poses", lambda: (partial(identify, robot, data, LeastSquares()), factorize), 2
    )


def bench_delta() -> list[Metric]:
    """One fit of a delta with 9 parameters to positions of one session, against a thousand calls of
    np.linalg.solve for one small system.
    """
    robot = load_robot("linear-delta")
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    sensor = Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 1e-5)))
    data = simulate(truth, _poses(robot, 30), Instrument((sensor,)), 0)
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(6, 6)), rng.normal(size=6)

    def solve_often() -> None:
        for _ in range(1000):
            np.linalg.solve(A, b)

    return _of_each(
        "delta", lambda: (partial(identify, robot, data, LeastSquares()), solve_often), 15
    )


def bench_command() -> list[Metric]:
    """A calibration by the command line from the start of the process to its end, against a Python
    that imports numpy and ends; in processor time of the processes.
    """
    data = ROOT / "examples" / "hexapod-42" / "measurements.csv"
    words = ("-m", "loopcal", "calibrate", "hexapod-42", str(data), "--hold-out", "0.25", "-o")

    def calibrate(engine: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            run_python(*words, str(Path(folder) / "run"), engine=engine)

    return [
        measure(
            f"engine.{engine}.command",
            partial(calibrate, engine),
            import_numpy,
            repeats=9,
            clock=read_processor_time,
        )
        for engine in ENGINES
    ]


def bench_loop() -> list[Metric]:
    """Forward kinematics of 1000 hexapod poses against a loop over scipy's fsolve."""
    robot, _, readings, _, _ = _problem()
    some = readings[:1000]
    return _of_each(
        "forward_of_fsolve",
        lambda: (partial(forward, robot, some), _loop_over_fsolve(robot, some)),
        3,
    )


def _loop_over_fsolve(robot: Mechanism, readings: np.ndarray) -> Callable[[], object]:
    """Return forward kinematics as a user writes it: one pose after the other, from home."""
    from scipy.optimize import fsolve
    from scipy.spatial.transform import Rotation

    base, platform, length = np.split(robot.values.reshape(6, 7), [3, 6], axis=1)
    home = np.concatenate([np.zeros(3), robot.home[:3, 3]])

    def gap(pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        legs = pose[3:] + platform @ Rotation.from_rotvec(pose[:3]).as_matrix().T - base
        return np.linalg.norm(legs, axis=1) - length[:, 0] - q

    poses = np.array([fsolve(gap, home, args=(q,)) for q in readings])
    by_loopcal = forward(robot, readings).T[:, :3, 3]
    assert np.abs(poses[:, 3:] - by_loopcal).max() < 1e-6  # [m], the tolerance of fsolve
    return lambda: [fsolve(gap, home, args=(q,)) for q in readings]


def _fit_by_hand(nominal: np.ndarray) -> Callable[[], object]:
    """Return the fit of base points, platform points and lengths (6, 7) to 50 measured poses as a
    user writes it for a hexapod.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    truth = nominal + rng.normal(size=(6, 7)) * 1e-3
    R = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, (50, 3))).as_matrix()
    t = np.mean([nominal[:, 2].min(), 0.5]) + rng.uniform(-0.05, 0.05, (50, 3))

    def legs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        legs = t[:, None] + np.einsum("nij,kj->nki", R, x[:, 3:6]) - x[:, :3]
        return legs, np.linalg.norm(legs, axis=2)

    readings = legs(truth)[1] - truth[:, 6] + rng.normal(size=(50, 6)) * 1e-6

    def residual(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(6, 7)
        return (legs(x)[1] - x[:, 6] - readings).ravel()

    def jacobian(flat: np.ndarray) -> np.ndarray:
        vectors, length = legs(flat.reshape(6, 7))
        unit = vectors / length[..., None]
        J = np.zeros((50, 6, 6, 7))
        k = np.arange(6)
        J[:, k, k, :3] = -unit
        J[:, k, k, 3:6] = np.einsum("nji,nkj->nki", R, unit)
        J[:, k, k, 6] = -1.0
        return J.reshape(300, 42)

    fit: Any = least_squares  # the stubs know no function as a Jacobian
    return lambda: fit(residual, nominal.ravel(), jacobian, method="lm")
