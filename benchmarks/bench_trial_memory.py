# SPDX-License-Identifier: Apache-2.0
"""Resident memory of fits of many machines at once, beyond their data and results."""

import gc
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench_engine import ENGINES, ROOT, simulate_hexapods, use_engine
from benchmarks.harness import Metric
from loopcal.estimate.identification import identify_trials
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot

FEW, MANY = 1_000, 10_000
CLEAR = Path("/proc/self/clear_refs")
"""Writing 5 to this file resets the peak of the resident memory, on Linux."""
RETURNED = dict.fromkeys(("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"), "16384")
"""Settings with which glibc returns what is freed at once, so that it is not resident."""


def bench_trial_memory() -> list[Metric]:
    """Peak at 10,000 fits over that at 1,000, each in a process of its own.

    Parts are fitted one after the other, so that ten times as many need about the same memory.
    """
    if not CLEAR.exists():
        return []
    metrics = []
    for engine in ENGINES:
        with use_engine(engine):
            few, many = (_run(count) for count in (FEW, MANY))
        note = f"{few / 1e6:.3g} MB for {FEW:,} fits, {many / 1e6:.3g} MB for {MANY:,}"
        name = f"engine.{engine}.memory_of_trials"
        metrics.append(Metric(name, many / few, tolerance=None, limit=2.0, note=note))
    return metrics


def _run(count: int) -> float:
    """Return the memory [bytes] that a process measures for so many fits."""
    command = [sys.executable, "-m", "benchmarks.bench_trial_memory", str(count)]
    environment = os.environ | RETURNED
    process = subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True, env=environment
    )
    return float(process.stdout)


def measure_memory(count: int) -> float:
    """Return the peak of the resident memory [bytes] during fits, without data and results."""
    robot = load_robot("hexapod-42")
    identify_trials(robot, simulate_hexapods(200), LeastSquares(), chord_start=True)
    with ProcessPoolExecutor(1) as pool:  # what the simulation frees is not resident here
        trials = pool.submit(simulate_hexapods, count).result()
    gc.collect()
    before = _read_status("VmRSS")
    CLEAR.write_text("5", encoding="ascii")
    result = identify_trials(robot, trials, LeastSquares(), chord_start=True)
    return _read_status("VmHWM") - before - _count_bytes((result.values, result.linear_models))


def _read_status(name: str) -> float:
    """Return a number of the process [bytes]."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith(name))


def _count_bytes(value: Any) -> int:
    """Return the bytes of all arrays in dataclasses and tuples."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if is_dataclass(value):
        return sum(_count_bytes(getattr(value, f.name)) for f in fields(value))
    return sum(map(_count_bytes, value)) if isinstance(value, tuple) else 0


if __name__ == "__main__":
    print(measure_memory(int(sys.argv[1])))
