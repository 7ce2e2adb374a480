# SPDX-License-Identifier: Apache-2.0
"""Calibrate a hexapod from a file of a million poses as a user does, and keep what it took.

Run as `python -m benchmarks.many_rows [ROWS]`, from the root; a million rows take about two
minutes of one core. benchmarks/many_rows.json keeps rows, CPU seconds, peak memory and the machine.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from loopcal.geometry import log_so3
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.solutions import forward, inverse
from tools.machine import describe_machine

RESULT = Path(__file__).resolve().parent / "many_rows.json"
ROBOT, SIGMA = "hexapod-42", np.array([50e-6] * 3 + [10e-6] * 3)
HEAD = """# kind: pose
# noise: {"r*": 50 urad, x: 10 um, y: 10 um, z: 10 um}
"""
COLUMNS = [*(f"q{i} [mm]" for i in range(1, 7)), "rx [mrad]", "ry [mrad]", "rz [mrad]"]
COLUMNS += ["x [mm]", "y [mm]", "z [mm]"]
LARGEST = 0.0749  # of a reading [m], just inside the stroke


def write_rows(path: Path, count: int) -> None:
    """Write poses of a machine drawn from the tolerances, all over its workspace."""
    robot = load_robot(ROBOT)
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    rng = np.random.default_rng(0)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(HEAD + ",".join(["pose", *COLUMNS]) + "\n")
        written = 0
        while written < count:
            commanded = rng.uniform(ranges[:, 0], ranges[:, 1], (10_000, len(ranges)))
            q = inverse(robot, commanded).q
            q = q[(np.abs(q) < LARGEST).all(axis=1)][: count - written]
            T = forward(truth, q).T
            at = np.hstack([log_so3(T[:, :3, :3]), T[:, :3, 3]]) + rng.normal(0.0, SIGMA, q.shape)
            for cells in (1e3 * np.hstack([q, at])).tolist():
                written += 1
                file.write(f"p{written}," + ",".join(f"{v:.6f}" for v in cells) + "\n")


def measure_calibration(count: int) -> dict[str, object]:
    """Return what `loopcal calibrate --hold-out 0.25` takes for a file of so many rows."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data.csv"
        write_rows(data, count)
        words = ["calibrate", ROBOT, str(data), "--hold-out", "0.25", "-o", f"{folder}/run"]
        one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, "-m", "loopcal", *words],
            env={**os.environ, **one_thread},
            capture_output=True,
            text=True,
            check=False,
        )
        size = data.stat().st_size
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "rows": count,
        "file_bytes": size,
        "exit_code": done.returncode,
        "cpu_seconds": round(used.ru_utime + used.ru_stime, 1),
        "peak_bytes": used.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
    }


def main() -> None:
    """Measure, print, and write the result of a million rows."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    result = {**measure_calibration(count), "machine": describe_machine()}
    text = json.dumps(result, indent=2) + "\n"
    sys.stdout.write(text)
    if count == 1_000_000:
        RESULT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
