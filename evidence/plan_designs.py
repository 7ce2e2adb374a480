# SPDX-License-Identifier: Apache-2.0
"""Quality of designs: 20 of 1000 candidates compared with the certified bound, random designs and
plain exchange.

Robots and measurements are those of `evidence.planned`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evidence.planned import CASES, Case
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.information import observe_poses
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.workspace import sample_workspace
from loopcal.planning.design_space import Criterion, DesignProblem, PriorInformation
from loopcal.planning.exchange import choose_design, draw_groups, exchange_from_start

CANDIDATES, POSES, STARTS, DRAWS, PREDICTED = 1000, 20, 20, 200, 200
SIGMA = np.array([5e-5] * 3 + [1e-5] * 3)
"""Noise of the simulated instrument: rotation [rad], position [m]."""


DESIGNS = (*((case, "D") for case in CASES[:4]), *((case, "I") for case in CASES[:3]))
"""Hexapod and 3-PRS by full poses and by positions, with the criterion of the design."""


def exchange_random_starts(problem: DesignProblem, n: int, starts: int) -> list[float]:
    """Return the values of designs of n groups that are exchanged from random starts."""
    candidates, values = problem.scale_candidates(n), []
    for stream in np.random.default_rng(0).spawn(starts):
        begin = draw_groups(candidates, stream, n, None)
        score = exchange_from_start(candidates, begin, stream)[1][-1]
        values.append(candidates.scoring.value(score))
    return values


def evaluate_design(case: Case, criterion_name: str) -> list[object]:
    """Return one row: efficiencies relative to the bound, and the gap of the certified design."""
    free = select_free_parameters(load_robot(case.robot))
    twists = observe_poses(free, sample_workspace(free.robot, CANDIDATES, 0).solution.q).twists[0]
    rows = (twists / SIGMA[:, None])[
        :, slice(0, 6) if case.measured == "full pose" else slice(3, 6)
    ]
    prior, p = PriorInformation.none(len(free)), len(free)
    criterion: Criterion = (
        Criterion("D")
        if criterion_name == "D"
        else Criterion("I", twists[:PREDICTED, 3:].reshape(-1, p), PREDICTED)
    )
    problem = DesignProblem(rows, criterion, prior)
    certified = choose_design(problem, POSES)
    relaxed = certified.relaxed
    random = np.random.default_rng(0)
    even = [
        relaxed.efficiency(problem.evaluate(chosen))
        for chosen in (random.choice(CANDIDATES, POSES, replace=False) for _ in range(DRAWS))
    ]
    plain = [relaxed.efficiency(value) for value in exchange_random_starts(problem, POSES, STARTS)]
    return [
        case.robot,
        case.measured,
        criterion_name,
        len(problem.space),
        float(np.median(even)),
        float(np.median(plain)),
        max(plain),
        certified.efficiency,
        1.0 - certified.efficiency,
    ]


QUICK = {"DESIGNS": DESIGNS[2:3], "CANDIDATES": 200, "STARTS": 2, "DRAWS": 20}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    for row in tables["designs"]["rows"]:
        assert row[7] >= row[6] - 1e-6 > row[4], row


def collect() -> dict:
    """Compute the table."""
    columns = [
        "robot",
        "measured",
        "criterion",
        "directions",
        "random designs (median)",
        "exchange, 20 starts (median)",
        "exchange, best start",
        "certified design",
        "gap to the bound",
    ]
    formats = ["", "", "", "d", ".3f", ".3f", ".4f", ".4f", ".1%"]
    rows = [evaluate_design(*design) for design in DESIGNS]
    return {
        "candidates": CANDIDATES,
        "poses": POSES,
        "noise": SIGMA.tolist(),
        "tables": {"designs": {"columns": columns, "formats": formats, "rows": rows}},
    }
