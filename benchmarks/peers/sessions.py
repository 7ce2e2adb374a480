# SPDX-License-Identifier: Apache-2.0
"""Time fits with a tracker frame and three targets in every session beside Ceres in C++.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.peers.sessions [--rounds 5]

One thread, processor time, both programs in turns, the best of all rounds: estimate and covariance
of the machine, the tolerances as they are stated. Ceres eliminates the sessions by a Schur
complement and begins at the true frames and places; loopcal seeks them. Estimates must agree to
1e-4 standard deviations: each ends where its own measure of a step is small.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.bench_growth import draw_sessions
from benchmarks.peers.__main__ import compile_ceres, read_words
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.kinds.position import Position
from loopcal.measure.kinds.setup_parameters import encode_rotation

SOURCE = Path(__file__).with_name("sessions_ceres.cpp")
CASES = ((200, 1), (200, 20), (200, 50), (4000, 200))
ALIKE = 1e-4


def main() -> int:
    """Print the table; 1 where an estimate differs."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers.sessions")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of both programs (5)")
    rounds, robot, faults = parser.parse_args().rounds, load_robot("hexapod-42"), 0
    print("| poses | sessions | loopcal [ms] | Ceres [ms] | share | difference [sigma] |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        compiled = compile_ceres(Path(name), SOURCE)
        if compiled is None:
            print("Ceres needs g++ and the headers of ceres, glog and eigen (libceres-dev)")
            return 1
        printed: dict[str, list[str]] = {}
        for poses, sessions in CASES:
            data = draw_sessions(robot, poses, sessions, 3)
            (rows,), file = data.observations, Path(name) / "numbers.txt"
            kind, entries = rows.kind, robot.parameters.entries
            assert isinstance(kind, Position)
            assert kind.places is not None
            number = np.unique(rows.session, return_inverse=True)[1]
            station = encode_rotation(np.eye(3), kind.T_base_frame[:3, :3])
            start = np.r_[station, kind.T_base_frame[:3, 3], kind.places.ravel()]
            parts = [
                np.array([entry.tolerance for entry in entries]),
                robot.parameters.nominal,
                np.tile(start, sessions),
                np.column_stack([number, data.readings, rows.measured]),
            ]
            head = f"{poses} 3 {sessions} {float(np.sqrt(rows.covariance[0, 0, 0]))!r}"
            text = (" ".join(map(repr, part.ravel().tolist())) for part in parts)
            file.write_text("\n".join([head, *text]) + "\n", encoding="ascii")
            ours, theirs, fit = [], [], identify(robot, data, MAP())
            for _ in range(rounds):
                begin = time.process_time()
                fit = identify(robot, data, MAP())
                assert np.isfinite(fit.covariance).any()
                ours.append(time.process_time() - begin)
                printed = read_words([str(compiled[0]), str(file), "2"])
                theirs += map(float, printed["seconds"])
            z = (fit.estimate - robot.parameters.nominal) / parts[0]
            other, sd = (np.array(printed[key], dtype=float) for key in ("estimate", "sd"))
            largest = float(np.abs((z - other) / sd).max())
            faults += not largest <= ALIKE
            milliseconds = 1e3 * min(ours), 1e3 * min(theirs)
            shown = f"{milliseconds[0]:.0f} | {milliseconds[1]:.0f} | {min(theirs) / min(ours):.2f}"
            print(f"| {poses} | {sessions} | {shown} | {largest:.1g} |", flush=True)
        print(f"\nCeres {printed['version'][0]}, {compiled[1]}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
