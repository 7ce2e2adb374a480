# SPDX-License-Identifier: Apache-2.0
"""Which method to trust when the truth is known: errors on unseen poses before and after, robots by
noise by method.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.diagnose import choose_model
from loopcal.estimate import (
    GCV,
    MAP,
    InflatedTolerances,
    LeastSquares,
    Ridge,
    TruncatedSVD,
    TruncationGCV,
    identify,
    identify_trials,
)
from loopcal.estimate.methods.penalties import Method
from loopcal.io import load_robot
from loopcal.measure import (
    Component,
    Gaussian,
    Instrument,
    Measurements,
    Pose,
    Sensor,
    sample_truth,
    simulate_trials,
)
from loopcal.mechanism import Mechanism, forward_trials, sample_workspace

Array = NDArray[np.float64]

SEED, MACHINES, POSES, UNSEEN, CHOSEN = 5, 40, 25, 60, 20
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


def instrument(robot: Mechanism, length: float, angle: float) -> Instrument:
    """Full poses, or positions where the platform does not turn."""
    if len(robot.freedoms) == 3:
        return Instrument((Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, length))),))
    return Instrument((Sensor(Pose(), Gaussian(np.array([angle] * 3 + [length] * 3))),))


def errors(robot: Mechanism, values: Array, truth: Array, q: Array) -> Array:
    """Root mean square position error (t,) [m] of poses predicted at unseen readings q (n, a)."""
    predicted, true = forward_trials(robot, values, q[None]), forward_trials(robot, truth, q[None])
    gap = geometry.pose_difference(predicted.T, true.T)[..., 3:]
    return np.sqrt((gap**2).sum(axis=2).mean(axis=1))


def cell(name: str, noise: tuple[float, float], machines: int = MACHINES) -> dict[str, Array]:
    """Error (t,) [m] before and after each method, for machines drawn from the tolerances."""
    robot = load_robot(name)
    coordinates, q = (
        sample_workspace(robot, POSES, SEED).coordinates,
        sample_workspace(robot, UNSEEN, SEED + 1).solution.q,
    )
    truth = sample_truth(robot, machines, SEED)
    trials = simulate_trials(robot, truth, coordinates, instrument(robot, *noise), SEED)
    found = {"before": errors(robot, np.broadcast_to(robot.values, truth.shape), truth, q)}
    for title, method in METHODS.items():
        found[title] = errors(robot, identify_trials(robot, trials, method).values, truth, q)
    few = min(machines, CHOSEN)
    chosen = np.array([simplest(robot, trials.trial(i)) for i in range(few)])
    found["chosen model"] = errors(robot, chosen, truth[:few], q)
    return found


def simplest(robot: Mechanism, data: Measurements) -> Array:
    """Values (p,) [SI] of the simplest set of parameters that cross-validation finds enough."""
    choice = choose_model(robot, data)
    return identify(choice.robot, data).robot.values if choice.chosen.parameters else robot.values


def collect() -> dict:
    """Every cell: medians, and how many machines the default made worse."""
    rows = []
    for name in ROBOTS:
        for title, noise in NOISE.items():
            found = cell(name, noise)
            worse = int((found["default"] > found["before"]).sum())
            rows.append([name, title, *(1e6 * float(np.median(e)) for e in found.values()), worse])
    columns = ["robot", "noise", "before", *METHODS, f"chosen model ({CHOSEN} machines)"]
    columns.append(f"default worse than before, of {MACHINES}")
    formats = ["", "", *[".3g"] * (2 + len(METHODS)), "d"]
    return {
        "seed": SEED,
        "machines": MACHINES,
        "poses": [POSES, UNSEEN],
        "tables": {"median_error_um": {"columns": columns, "formats": formats, "rows": rows}},
    }
