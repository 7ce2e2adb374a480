# SPDX-License-Identifier: Apache-2.0
"""Tolerances stated too narrow: is the conflict found, and what does it cost?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evidence.known_truth import errors, instrument
from loopcal.estimate import MAP, InflatedTolerances, LeastSquares, identify, identify_trials
from loopcal.io import load_robot
from loopcal.measure import Measurements, sample_truth, simulate_trials
from loopcal.mechanism import Mechanism, sample_workspace
from loopcal.parameters import ParameterTable

SEED, MACHINES, POSES, UNSEEN = 9, 60, 25, 60
FACTORS = (1.0, 3.0, 10.0)
NOISE = (1e-5, 5e-5)


def narrowed(robot: Mechanism, factor: float) -> Mechanism:
    """The same robot, its tolerances stated smaller by a factor."""
    entries = (
        replace(p, tolerance=None if p.tolerance is None else p.tolerance / factor)
        for p in robot.parameters.entries
    )
    return replace(robot, parameters=ParameterTable(tuple(entries)))


def judge(name: str, factor: float, machines: int = MACHINES) -> dict[str, float]:
    """Median errors [m] on unseen poses and the share of fits that name the conflict."""
    robot = load_robot(name)
    stated = narrowed(robot, factor)
    coordinates, q = (
        sample_workspace(robot, POSES, SEED).coordinates,
        sample_workspace(robot, UNSEEN, SEED + 1).solution.q,
    )
    truth = sample_truth(robot, machines, SEED)
    trials = simulate_trials(robot, truth, coordinates, instrument(robot, *NOISE), SEED)
    found = {
        title: float(
            np.median(errors(robot, identify_trials(stated, trials, method).values, truth, q))
        )
        for title, method in {
            "least squares": LeastSquares(),
            "MAP": MAP(),
            "default": MAP(InflatedTolerances()),
        }.items()
    }
    named = [_names_conflict(stated, trials.trial(i)) for i in range(machines)]
    return {**found, "conflict named": float(np.mean(named))}


def _names_conflict(robot: Mechanism, data: Measurements) -> bool:
    """Whether the default fit says that data and tolerances contradict each other."""
    fit = identify(robot, data)
    return fit.prior_conflict is not None and fit.prior_conflict.conflict


def collect() -> dict:
    """Every robot and factor."""
    rows = []
    for name in ("hexapod-42", "3-prs"):
        for factor in FACTORS:
            r = judge(name, factor)
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
        "tolerances stated too small by",
        "least squares [um]",
        "MAP [um]",
        "default [um]",
        "default / least squares",
        "conflict named [% of fits]",
    ]
    formats = ["", ".0f", ".3g", ".3g", ".3g", ".2f", ".0f"]
    return {
        "seed": SEED,
        "machines": MACHINES,
        "tables": {"narrow": {"columns": columns, "formats": formats, "rows": rows}},
    }
