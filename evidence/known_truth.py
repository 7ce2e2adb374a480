# SPDX-License-Identifier: Apache-2.0
"""Methods compared with the known truth: errors at held-out poses before and after calibration, by
robot, noise and method.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.diagnose.cross_validation import choose_model
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import (
    GCV,
    MAP,
    LeastSquares,
    Method,
    Ridge,
    TruncatedSVD,
    TruncationGCV,
)
from loopcal.estimate.tolerance_components import InflatedTolerances
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace

Array = NDArray[np.float64]

SEED, MACHINES, POSES, HELD_OUT, MODEL_CHOICES = 5, 40, 25, 60, 10
ROBOTS = ("hexapod-42", "3-prs", "ru-pus-prs", "linear-delta")
NOISE = {
    "1 um, 5 urad": (1e-6, 5e-6),
    "10 um, 50 urad": (1e-5, 5e-5),
    "100 um, 500 urad": (1e-4, 5e-4),
}
METHODS: dict[str, Method] = {
    "least squares": LeastSquares(),
    "ridge, GCV": Ridge(GCV()),
    "truncated SVD, GCV": TruncatedSVD(TruncationGCV()),
    "MAP": MAP(),
    "default": MAP(InflatedTolerances()),
}


def make_instrument(robot: Mechanism, length: float, angle: float) -> Instrument:
    """Return an instrument of full poses, or of positions if the platform does not rotate."""
    if len(robot.freedoms) == 3:
        return Instrument((Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, length))),))
    return Instrument((Sensor(Pose(), Gaussian(np.array([angle] * 3 + [length] * 3))),))


def position_errors(robot: Mechanism, values: Array, truth: Array, q: Array) -> Array:
    """Return the rms position error (t,) [m] of poses predicted at held-out readings q (n, a)."""
    predicted, true = forward_trials(robot, values, q[None]), forward_trials(robot, truth, q[None])
    gap = geometry.pose_difference(predicted.T, true.T)[..., 3:]
    return np.sqrt((gap**2).sum(axis=2).mean(axis=1))


def evaluate_cell(
    name: str, noise: tuple[float, float], machines: int = MACHINES, choices: int = MODEL_CHOICES
) -> dict[str, Array]:
    """Return the errors (t,) [m] before and after each method, for drawn machines, and of the
    first `choices` of them with a chosen model.
    """
    robot = load_robot(name)
    coordinates, q = (
        sample_workspace(robot, POSES, SEED).coordinates,
        sample_workspace(robot, HELD_OUT, SEED + 1).solution.q,
    )
    truth = sample_truth(robot, machines, SEED)
    trials = simulate_trials(robot, truth, coordinates, make_instrument(robot, *noise), SEED)
    result = {
        "before": position_errors(robot, np.broadcast_to(robot.values, truth.shape), truth, q)
    }
    for title, method in METHODS.items():
        result[title] = position_errors(
            robot, identify_trials(robot, trials, method).values, truth, q
        )
    if choices:
        chosen = np.array([choose_values(robot, trials.trial(i)) for i in range(choices)])
        result["chosen model"] = position_errors(robot, chosen, truth[:choices], q)
    return result


def choose_values(robot: Mechanism, data: Measurements) -> Array:
    """Return values (p,) [SI] of the simplest sufficient parameter set by cross-validation."""
    choice = choose_model(robot, data)
    return identify(choice.robot, data).robot.values if choice.chosen.parameters else robot.values


QUICK = {"MACHINES": 4, "MODEL_CHOICES": 1, "ROBOTS": ("3-prs", "linear-delta")}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    default = 3 + list(METHODS).index("default")
    for row in tables["median_error_um"]["rows"]:
        assert row[default] < 1.1 * row[2], row[:2]


def collect() -> dict:
    """Collect every cell: medians, and the number of machines that the default made worse."""
    rows = []
    for name in ROBOTS:
        for title, noise in NOISE.items():
            result = evaluate_cell(name, noise, MACHINES, MODEL_CHOICES)
            worse = int((result["default"] > result["before"]).sum())
            chosen = result.pop("chosen model")
            ratio = float(np.median(chosen / result["default"][: len(chosen)]))
            medians = [1e6 * float(np.median(e)) for e in result.values()]
            rows.append([name, title, *medians, ratio, worse])
    columns = ["robot", "noise", "before", *METHODS]
    columns.append(f"chosen model / default ({MODEL_CHOICES} machines)")
    columns.append(f"default worse than before, of {MACHINES}")
    formats = ["", "", *[".3g"] * (1 + len(METHODS)), ".2f", "d"]
    return {
        "seed": SEED,
        "machines": MACHINES,
        "poses": [POSES, HELD_OUT],
        "tables": {"median_error_um": {"columns": columns, "formats": formats, "rows": rows}},
    }
