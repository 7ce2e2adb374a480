# SPDX-License-Identifier: Apache-2.0
"""Check an installed loopcal-native, outside the repository.

Every instruction set of this processor has the same bits, they agree with NumPy, and a calibration
by `loopcal` states the engine.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from loopcal_native import list_instruction_sets

import loopcal as lc
from loopcal.engine import select_engine

ROUNDING = 2e-14
"""Of a coordinate, in sizes of the robot: rounding times the condition of a hexapod."""


def check_bits() -> None:
    """Compare poses of all engines."""
    program = lc.load_robot("hexapod-42").program
    home = lc.load_robot("hexapod-42").home_state
    q = np.random.default_rng(0).uniform(-0.02, 0.02, (1, 100, program.n_joints))
    e = np.zeros((1, program.n_displacements))
    expected = select_engine("numpy").solve(program, e, q, home).T
    first = None
    for name in list_instruction_sets():
        T = select_engine(f"native:{name}").solve(program, e, q, home).T
        first = T if first is None else first
        assert np.array_equal(T, first), f"{name} has other bits"
        assert np.abs(T - expected).max() <= ROUNDING, f"{name} differs from NumPy"
        print(f"native:{name}: {np.abs(T - expected).max():.1e} from NumPy")


def check_calibration() -> None:
    """Calibrate the example of the hexapod by commands."""
    command = [str(Path(sys.executable).with_name("loopcal"))]
    with tempfile.TemporaryDirectory() as folder:
        for words in (
            "example hexapod-42",
            "calibrate hexapod-42 hexapod-42/measurements.csv -o run --hold-out 0.25",
        ):
            subprocess.run(
                [*command, *words.split()],
                check=True,
                cwd=folder,
                env=os.environ | {"LOOPCAL_ENGINE": "native"},
                stdout=subprocess.DEVNULL,
            )
        result = json.loads(Path(folder, "run", "result.json").read_text("utf-8"))
    engine = result["made_by"]["versions"]["engine"]
    assert engine.startswith("native:"), f"the run folder states the engine {engine}"
    print(f"the run folder states the engine {engine}")


if __name__ == "__main__":
    check_bits()
    check_calibration()
