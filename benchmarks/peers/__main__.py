# SPDX-License-Identifier: Apache-2.0
"""Time the fits of loopcal beside those of other programs, and print a table with versions.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.peers [--rounds 20]

One thread, processor time, all programs in turns, the best of all rounds. What is not installed is
left out: Ceres needs g++ and the headers of ceres, glog and eigen (Debian: libceres-dev), jax the
package jax. Every estimate is compared with that of loopcal's iteration run to rounding, in
standard deviations: programs that minimize the same cost must agree to 1e-9 sigma (the delta to
1e-8, see `Case`), those that compare lengths of legs to 1e-2.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
import scipy

from benchmarks.bench_identify import _measured, _poses
from benchmarks.peers import by_hand
from loopcal.engine.selection import collect_versions
from loopcal.estimate.descent import StepControl
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.result import Identification
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism

SOURCE = Path(__file__).with_name("fit.cpp")
SAME_ROWS = 1e-2
"""Largest difference of estimates [standard deviations] of programs with lengths of legs in place
of poses: of second order in the noise."""


@dataclass(frozen=True)
class Case:
    """A fit: a robot, its measurements, and the numbers that a program by hand needs.

    rows : (n, c) readings, measured values and their sigmas of each pose.
    rounding : largest difference of estimates of the same cost [standard deviations]. Spheres of a
        delta meet in closed form at places rounded to 5e-14 m, over a noise of 1e-5 m.
    """

    name: str
    robot: Mechanism
    data: Measurements
    rows: np.ndarray
    rounding: float
    by_hand: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], by_hand.Answer]]

    @property
    def start(self) -> np.ndarray:
        """(p,) nominal values of the free parameters [SI]."""
        return self.robot.values[self.robot.parameters.free]

    @property
    def unit(self) -> np.ndarray:
        """(p,) their tolerances [SI]."""
        entries, free = self.robot.parameters.entries, self.robot.parameters.free
        return np.array([e.tolerance for e, is_free in zip(entries, free, strict=True) if is_free])


@dataclass(frozen=True)
class Line:
    """A line of the table: shortest time [s] and difference from loopcal [standard deviations]."""

    program: str
    seconds: float
    difference: float
    allowed: float


def make_cases() -> dict[str, Case]:
    """Return the fits: a hexapod in 40 measured poses, a linear delta in 30 measured positions."""
    hexapod, delta = load_robot("hexapod-42"), load_robot("linear-delta")
    poses = _measured(hexapod, 40)
    truth = delta.with_values(sample_truth(delta, 1, 0)[0])
    sensor = Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 1e-5)))
    places = simulate(truth, _poses(delta, 30), Instrument((sensor,)), 0)
    return {
        "hexapod": Case(
            "hexapod, 42 parameters, 40 poses",
            hexapod,
            poses,
            _join_rows(poses, np.array([5e-6] * 3 + [1e-6] * 3)),
            1e-9,
            {"leg lengths": by_hand.fit_leg_lengths, "same cost": by_hand.fit_poses},
        ),
        "delta": Case(
            "linear delta, 9 parameters, 30 positions",
            delta,
            places,
            _join_rows(places, np.full(3, 1e-5)),
            1e-8,
            {"leg lengths": by_hand.fit_delta},
        ),
    }


def _join_rows(data: Measurements, sigma: np.ndarray) -> np.ndarray:
    """Return readings, measured values and sigmas (n, c) of each pose."""
    (measured,) = data.observations
    spread = np.broadcast_to(sigma, (data.n_poses, len(sigma)))
    return np.concatenate([data.readings, measured.measured, spread], axis=1)


def ask_everything(robot: Mechanism, data: Measurements) -> Identification:
    """Fit by least squares, and ask for all that the result promises."""
    fit = identify(robot, data, LeastSquares())
    for field in fields(fit):
        getattr(fit, field.name)
    return fit


def ask_estimate(robot: Mechanism, data: Measurements) -> by_hand.Answer:
    """Fit by least squares, and return estimate and covariance."""
    fit = identify(robot, data, LeastSquares())
    return fit.estimate, fit.covariance


def compile_ceres(folder: Path, source: Path = SOURCE) -> tuple[Path, str] | None:
    """Return the compiled program and the version of Ceres; None where a part is missing."""
    compiler = which(os.environ.get("CXX", "g++"))
    if compiler is None or not Path("/usr/include/ceres/ceres.h").is_file():
        return None
    program = folder / "fit"
    options = ["-O3", "-std=c++17", "-I/usr/include/eigen3"]
    command = [compiler, *options, str(source), "-o", str(program), "-lceres", "-lglog"]
    subprocess.run(command, check=True)
    first = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True)
    return program, first.stdout.splitlines()[0]


def run_ceres(program: Path, robot: str, numbers: Path, repeats: int) -> dict[str, list[str]]:
    """Return the words that the program printed, by the first one of each line."""
    return read_words([str(program), robot, str(numbers), str(repeats)])


def read_words(command: list[str]) -> dict[str, list[str]]:
    """Return the words that a program prints, by the first one of each line."""
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines()}


def measure_case(
    key: str, case: Case, program: Path | None, rounds: int, folder: Path
) -> tuple[list[Line], str]:
    """Time all programs in turns; return the lines of the table and the version of Ceres."""
    arguments = case.start, case.unit, case.rows
    runs: dict[str, Callable[[], Any]] = {
        "loopcal, estimate and covariance": partial(ask_estimate, case.robot, case.data),
        "loopcal, everything asked for": partial(ask_everything, case.robot, case.data),
    }
    hands = {name: partial(fit, *arguments) for name, fit in case.by_hand.items()}
    runs |= {f"scipy by hand, {name}": fit for name, fit in hands.items()}
    if key == "hexapod" and find_spec("jax"):
        runs["jax compiled, leg lengths"] = by_hand.make_jax_fit(*arguments)
    exact = FitOptions(control=StepControl(relative=1e-10))
    fit = identify(case.robot, case.data, LeastSquares(), options=exact)
    expected, sigma = fit.estimate, fit.standard_deviations
    differences = {}
    for name, run in runs.items():  # the first call also compiles
        answer = run()
        values = answer.estimate if isinstance(answer, Identification) else answer[0]
        differences[name] = float(np.abs((values - expected) / sigma).max())
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    version, own = "", "Ceres, C++, same cost"
    numbers = folder / f"{key}.txt"
    lines = [f"{len(case.rows)} {len(case.start)}"]
    parts = case.unit, case.start, case.rows
    lines += [" ".join(map(repr, values.ravel().tolist())) for values in parts]
    numbers.write_text("\n".join(lines) + "\n", encoding="ascii")
    for _ in range(rounds):
        for name, run in runs.items():
            begin = time.process_time()
            run()
            seconds[name].append(time.process_time() - begin)
        if program is not None:
            printed = run_ceres(program, key, numbers, 3)
            seconds.setdefault(own, []).extend(map(float, printed["seconds"]))
            version = printed["version"][0]
            values = np.array(printed["estimate"], dtype=np.float64)
            differences[own] = float(np.abs((values - expected) / sigma).max())
    table = []
    for name, times in seconds.items():
        allowed = SAME_ROWS if "leg lengths" in name else case.rounding
        table.append(Line(name, min(times), differences[name], allowed))
    return table, version


def main() -> int:
    """Print the table of every fit; 1 where an estimate differs."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--rounds", type=int, default=20, help="rounds of all programs (20)")
    rounds = parser.parse_args().rounds
    faults = 0
    with tempfile.TemporaryDirectory() as name:
        compiled = compile_ceres(Path(name))
        versions = collect_versions() | {"scipy": scipy.__version__}
        if find_spec("jax"):
            import jax

            versions["jax"] = jax.__version__
        for key, case in make_cases().items():
            program = compiled and compiled[0]
            table, version = measure_case(key, case, program, rounds, Path(name))
            if version and compiled:
                versions |= {"Ceres": version, "compiler": compiled[1]}
            first = table[0].seconds
            print(f"\n| {case.name} | ms | share of loopcal's | difference [sigma] |")
            print("|---|---|---|---|")
            for line in table:
                share, is_wrong = line.seconds / first, not line.difference <= line.allowed
                mark = f" (more than {line.allowed:g})" if is_wrong else ""
                faults += is_wrong
                figures = f"{1e3 * line.seconds:.3g} | {share:.2f} | {line.difference:.1g}{mark}"
                print(f"| {line.program} | {figures} |")
    print("\n" + ", ".join(f"{name} {version}" for name, version in versions.items()))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
