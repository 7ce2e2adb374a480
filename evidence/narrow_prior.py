# SPDX-License-Identifier: Apache-2.0
"""Spreads that are stated too small, and parameters far from nominal, alone or together: how
often the conflict is reported, what the default fit loses by it, and what its intervals cover.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from evidence.known_truth import Array, make_instrument, position_errors
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import MAP, LeastSquares, Method
from loopcal.estimate.result import Identification
from loopcal.estimate.tolerance_components import InflatedTolerances
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.simulation import Trials, sample_truth, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import ParameterTable

SEED, MACHINES, POSES, HELD_OUT = 9, 60, 25, 60
FACTORS = (1.0, 1.4, 1.7, 3.0, 10.0)
NOISE = (1e-5, 5e-5)
COARSE = (5e-5, 2.5e-4)
FAR = ("linear-delta", "five-bar", "hexapod-42")
SINGLE, TOGETHER = (5.0, 10.0, 20.0), (4.0, 6.0)
METHODS: dict[str, Method] = {
    "least squares": LeastSquares(),
    "MAP": MAP(),
    "default": MAP(InflatedTolerances()),
}


def narrow_tolerances(robot: Mechanism, factor: float) -> Mechanism:
    """Return the robot with its spreads divided by a factor."""
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
    result = _compare(stated, robot, trials, truth, q)
    fits = [identify(stated, trials.trial(i)) for i in range(machines)]
    return {**result, "conflict named": float(np.mean([_reports_conflict(f) for f in fits]))}


def evaluate_deviation(
    name: str, size: float, is_shared: bool, machines: int = MACHINES
) -> dict[str, float]:
    """Return median errors [m] at held-out poses, the share of fits that report the conflict, and
    the share of parameters that their intervals contain, with MAP and by default.

    One parameter, another one in each machine, is `size` spreads off; or all lengths of the
    limbs are.
    """
    robot = load_robot(name)
    table, rng = robot.parameters, np.random.default_rng(SEED)
    truth, free = sample_truth(robot, machines, SEED), np.flatnonzero(table.free)
    lengths = [i for i in free if table.names[i].endswith(".length")]
    for machine in truth:
        moved = lengths if is_shared else rng.choice(free, 1)
        sign = 1.0 if is_shared else rng.choice([-1.0, 1.0])
        machine[moved] = table.nominal[moved] + sign * size * table.tolerance[moved]
    coordinates = sample_workspace(robot, POSES, SEED).coordinates
    q = sample_workspace(robot, HELD_OUT, SEED + 1).solution.q
    trials = simulate_trials(robot, truth, coordinates, make_instrument(robot, *COARSE), SEED)
    result = _compare(robot, robot, trials, truth, q)
    for title in ("MAP", "default"):
        fits = [identify(robot, trials.trial(i), METHODS[title]) for i in range(machines)]
        near = [
            np.abs(f.estimate - t[free]) < f.interval() for f, t in zip(fits, truth, strict=True)
        ]
        result[f"covered, {title}"] = float(np.mean(near))
    return {**result, "conflict named": float(np.mean([_reports_conflict(f) for f in fits]))}


def _compare(
    stated: Mechanism, robot: Mechanism, trials: Trials, truth: Array, q: Array
) -> dict[str, float]:
    """Return the median error [m] of each method at held-out readings q (n, a)."""
    return {
        title: float(
            np.median(
                position_errors(robot, identify_trials(stated, trials, method).values, truth, q)
            )
        )
        for title, method in METHODS.items()
    }


def _reports_conflict(fit: Identification) -> bool:
    """Return whether a fit reports that data and spreads contradict each other."""
    return fit.prior_conflict is not None and bool(fit.prior_conflict.report())


def _collect_deviations() -> dict:
    """Collect single parameters and lengths that are off."""
    rows = []
    for name in FAR:
        cases = [(False, size) for size in SINGLE]
        if name != "hexapod-42":
            cases += [(True, size) for size in TOGETHER]
        for is_shared, size in cases:
            r = evaluate_deviation(name, size, is_shared, MACHINES)
            what = "all lengths of the limbs" if is_shared else "one parameter"
            errors_um = [1e6 * r[key] for key in METHODS]
            covered = [100 * r[f"covered, {title}"] for title in ("MAP", "default")]
            ratios = [r[title] / r["least squares"] for title in ("MAP", "default")]
            rows.append(
                [name, what, size, *errors_um, *ratios, *covered, 100 * r["conflict named"]]
            )
    columns = [
        "robot",
        "off",
        "by spreads",
        "least squares [um]",
        "MAP [um]",
        "default [um]",
        "MAP / least squares",
        "default / least squares",
        "MAP: parameters covered [%]",
        "default: parameters covered [%]",
        "conflict reported [% of fits]",
    ]
    formats = ["", "", ".0f", *[".3g"] * 3, ".2f", ".2f", ".1f", ".1f", ".0f"]
    return {"columns": columns, "formats": formats, "rows": rows}


QUICK = {"MACHINES": 4, "FACTORS": (1.0, 10.0), "FAR": ("five-bar",)}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    for robot, factor, *_, ratio, named in tables["narrow"]["rows"]:
        assert ratio < 1.2, (robot, factor)
        assert factor == 1.0 or named == 100.0, robot


def collect() -> dict:
    """Collect every robot and factor."""
    rows = []
    for name in ("hexapod-42", "3-prs"):
        for factor in FACTORS:
            r = evaluate_case(name, factor, MACHINES)
            errors_um = [1e6 * r[key] for key in METHODS]
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
        "spreads too small by a factor of",
        "least squares [um]",
        "MAP [um]",
        "default [um]",
        "default / least squares",
        "conflict reported [% of fits]",
    ]
    formats = ["", ".3g", ".3g", ".3g", ".3g", ".2f", ".0f"]
    return {
        "seed": SEED,
        "machines": MACHINES,
        "tables": {
            "narrow": {"columns": columns, "formats": formats, "rows": rows},
            "deviations": _collect_deviations(),
        },
    }
