# SPDX-License-Identifier: Apache-2.0
"""Calibrate a linear delta from a file of a million rows as a user does, and keep what it took.

Run as `python -m benchmarks.many_rows [ROWS]`, from the root; a million rows take about seven
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

from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.solutions import forward, inverse
from tools.machine import describe_machine

RESULT = Path(__file__).resolve().parent / "many_rows.json"
ROBOT, SIGMA = "linear-delta", 10e-6
HEAD = """# kind: component
# components: [x, y, z]
# noise: {x: 10 um, y: 10 um, z: 10 um}
pose,q1 [mm],q2 [mm],q3 [mm],x [mm],y [mm],z [mm]
"""


def write_rows(path: Path, count: int) -> None:
    """Write positions of a machine drawn from the tolerances, all over its workspace."""
    robot = load_robot(ROBOT)
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    rng = np.random.default_rng(0)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(HEAD)
        for begin in range(0, count, 10_000):
            n = min(10_000, count - begin)
            commanded = rng.uniform(ranges[:, 0], ranges[:, 1], (n, len(ranges)))
            q = inverse(robot, commanded).q
            place = forward(truth, q).T[:, :3, 3] + rng.normal(0.0, SIGMA, (n, 3))
            for i, (reading, at) in enumerate(zip(1e3 * q, 1e3 * place, strict=True)):
                cells = [*(f"{v:.6f}" for v in reading), *(f"{v:.4f}" for v in at)]
                file.write(f"p{begin + i + 1},{','.join(cells)}\n")


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
