# SPDX-License-Identifier: Apache-2.0
"""Check-ups of calibrated machines: false alarms within a year, and changes that are found.

Machines are drawn from their spreads, calibrated at random poses and checked at five planned
ones, or at five random ones. The instrument stands elsewhere at each check. A change moves one
parameter, drawn at random, by so many tolerances.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

import loopcal as lc
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.workspace import sample_workspace

Array = NDArray[np.float64]

MACHINES, A_YEAR, POSES, CHECK_POSES = 60, 12, 30, 5
"""Machines of each robot; checks a year; poses of the calibration and of a check."""

RATE, CHANGES = 0.05, (0.5, 1.0, 2.0)
"""Rate of false alarms a year; sizes of changes [tolerances]."""

ROBOTS = ("hexapod-42", "linear-delta", "five-bar")
SIGMA = 1e-5
"""Noise of each coordinate, one standard deviation [m]."""

QUICK = {"MACHINES": 4, "ROBOTS": ("linear-delta",)}


def make_instrument(robot: lc.Mechanism) -> lc.Instrument:
    """Return a tracker at an unknown place, with a target on the tool, or three if this turns."""
    size = 0.2 * robot.size
    places = size * np.array([[1.0, 0.0, 0.2], [-0.5, 0.8, 0.0], [-0.5, -0.8, 0.1]])
    turns = len([name for name in robot.freedoms if name.startswith("r")]) == 3
    places = places if turns else np.zeros((1, 3))
    names = tuple("abc"[: len(places)])
    kind = lc.Position(targets=names, places=places, unknown=("frame",))
    return lc.Instrument((lc.Sensor(kind, lc.Gaussian(np.full(3 * len(places), SIGMA))),))


def measure(robot: lc.Mechanism, truth: Array, poses: Array, seed: int) -> lc.Measurements:
    """Return the measurements of a machine from some place."""
    rng = np.random.default_rng(seed)
    axes = ("rz", "x", "y") if "z" not in robot.freedoms else ("rx", "ry", "rz", "x", "y", "z")
    setup = {f"frame.{axis}": 0.2 * rng.standard_normal() for axis in axes}
    instrument = make_instrument(robot)
    return lc.simulate(robot.with_values(truth), poses, instrument, seed, nuisance_values=setup)


def calibrate(robot: lc.Mechanism, truth: Array, seed: int) -> lc.Run:
    """Return the run of a calibration."""
    poses = sample_workspace(robot, POSES, seed=seed).coordinates
    report = lc.calibrate(robot, measure(robot, truth, poses, seed))
    with TemporaryDirectory() as folder:
        lc.save_run(report, Path(folder) / "run")
        return lc.load_run(Path(folder) / "run")


def check_machine(name: str, seed: int) -> dict[str, Any]:
    """Return whether a year without a change has an alarm, and which changes are found and named
    at planned and at random poses.
    """
    robot = lc.load_robot(name)
    truth = sample_truth(robot, 1, seed)[0]
    run = calibrate(robot, truth, seed)
    options = lc.PlanOptions(
        n_poses=CHECK_POSES, criterion="D", hold_out=0, allow_fewer_equations=True,
        n_candidates=200, seed=seed,
    )  # fmt: skip
    planned = lc.plan(run.robot, make_instrument(robot), options=options).poses.coordinates
    rng = np.random.default_rng(seed)
    year = {str(i): measure(robot, truth, planned, 10_000 * seed + i) for i in range(A_YEAR)}
    result = lc.check_up(run, year, false_alarms=RATE, a_year=A_YEAR)
    answer: dict[str, Any] = {"alarm": any(check.alarm for check in result.checks)}
    places = np.flatnonzero(robot.parameters.free)
    for size in CHANGES:
        place = int(rng.choice(places))
        changed = truth.copy()
        changed[place] += size * robot.parameters.tolerance[place]
        random = sample_workspace(robot, CHECK_POSES, seed=900 + seed).coordinates
        for how, poses in (("planned", planned), ("random", random)):
            new = measure(robot, changed, poses, 20_000 * seed + 1)
            found = lc.check_up(run, {"new": new}, false_alarms=RATE, a_year=A_YEAR)
            limb = robot.parameters.names[place].split(".")[0]
            named = {name.split(".")[0] for name in found.cause}
            answer[f"{how} {size}"] = (found.moved, found.moved and limb in named)
    return answer


def collect() -> dict[str, Any]:
    """Return the tables."""
    alarms, power = [], []
    for name in ROBOTS:
        answers = [check_machine(name, seed) for seed in range(1, MACHINES + 1)]
        count = sum(answer["alarm"] for answer in answers)
        alarms.append([name, MACHINES, A_YEAR, count, 100.0 * count / MACHINES])
        for size in CHANGES:
            row: list[Any] = [name, size]
            for how in ("planned", "random"):
                found = np.array([answer[f"{how} {size}"] for answer in answers])
                row += [
                    100.0 * found[:, 0].mean(),
                    100.0 * found[:, 1].sum() / max(found[:, 0].sum(), 1),
                ]
            power.append(row)
    columns = ["robot", "change [spreads]"]
    columns += [
        f"{how}: {what} [%]" for how in ("planned", "random") for what in ("found", "named")
    ]
    tables = {
        "alarms": {
            "columns": ["robot", "machines", "checks a year", "with a false alarm", "share [%]"],
            "formats": ["", "d", "d", "d", ".1f"],
            "rows": alarms,
        },
        "power": {"columns": columns, "formats": ["", "g", *[".0f"] * 4], "rows": power},
    }
    return {"tables": tables}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert sum(row[3] for row in tables["alarms"]["rows"]) <= 1
    assert tables["power"]["rows"][-1][2] >= 50.0
