# SPDX-License-Identifier: Apache-2.0
"""Tolerances that are stated too small: how often the conflict is reported, and its cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evidence.known_truth import make_instrument, position_errors
from loopcal.estimate import MAP, InflatedTolerances, LeastSquares, identify, identify_trials
from loopcal.io import load_robot
from loopcal.measure import Measurements, sample_truth, simulate_trials
from loopcal.mechanism import Mechanism, sample_workspace
from loopcal.parameters import ParameterTable

SEED, MACHINES, POSES, HELD_OUT = 9, 60, 25, 60
FACTORS = (1.0, 3.0, 10.0)
NOISE = (1e-5, 5e-5)


def narrow_tolerances(robot: Mechanism, factor: float) -> Mechanism:
    """Return the robot with its tolerances divided by a factor."""
    entries = (
        replace(p, tolerance=None if p.tolerance is None else p.tolerance / factor)
        for p in robot.parameters.entries
    )
    return replace(robot, parameters=ParameterTable(tuple(entries)))


def evaluate_case(name: str, factor: float, machines: int = MACHINES) -> dict[str, float]:
    """Return median errors [m] at held-out poses and the share of fits that report the conflict."""
    robot = load_robot(name)
    stated = narrow_tolerances(robot, factor)
    coordinates, q = (
        sample_workspace(robot, POSES, SEED).coordinates,
        sample_workspace(robot, HELD_OUT, SEED + 1).solution.q,
    )
    truth = sample_truth(robot, machines, SEED)
    trials = simulate_trials(robot, truth, coordinates, make_instrument(robot, *NOISE), SEED)
    result = {
        title: float(
            np.median(
                position_errors(robot, identify_trials(stated, trials, method).values, truth, q)
            )
        )
        for title, method in {
            "least squares": LeastSquares(),
            "MAP": MAP(),
            "default": MAP(InflatedTolerances()),
        }.items()
    }
    named = [_reports_conflict(stated, trials.trial(i)) for i in range(machines)]
    return {**result, "conflict named": float(np.mean(named))}


def _reports_conflict(robot: Mechanism, data: Measurements) -> bool:
    """Return whether the default fit reports that data and tolerances contradict each other."""
    fit = identify(robot, data)
    return fit.prior_conflict is not None and fit.prior_conflict.conflict


def collect() -> dict:
    """Collect every robot and factor."""
    rows = []
    for name in ("hexapod-42", "3-prs"):
        for factor in FACTORS:
            r = evaluate_case(name, factor)
            errors_um = [1e6 * r[key] for key in ("least squares", "MAP", "default")]
            rows.append(
                [
                    name,
                    factor,
                    *errors_um,
                    r["default"] / r["least squares"],
                    100 * r["conflict named"],
                ]
            )
    columns = [
        "robot",
        "tolerances too small by a factor of",
        "least squares [um]",
        "MAP [um]",
        "default [um]",
        "default / least squares",
        "conflict reported [% of fits]",
    ]
    formats = ["", ".0f", ".3g", ".3g", ".3g", ".2f", ".0f"]
    return {
        "seed": SEED,
        "machines": MACHINES,
        "tables": {"narrow": {"columns": columns, "formats": formats, "rows": rows}},
    }
