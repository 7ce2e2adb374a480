# SPDX-License-Identifier: Apache-2.0
"""How good are planned poses? 20 of 1000 candidates, against the certified bound, even draws and
plain exchange.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.outlook import scene
from loopcal.io import load_robot
from loopcal.mechanism import sample_workspace
from loopcal.planning.certified import certified_design
from loopcal.planning.criteria import Criterion, D, I, evaluate
from loopcal.planning.design import Start, design_factor
from loopcal.planning.fedorov import fedorov_exchange

CANDIDATES, POSES, STARTS, DRAWS, PREDICTED = 1000, 20, 20, 200, 200
SIGMA = np.array([5e-5] * 3 + [1e-5] * 3)
"""Of the simulated instrument: rotation [rad], position [m]."""


@dataclass(frozen=True)
class Case:
    """A robot, what is measured of its pose, and by which criterion."""

    robot: str
    measured: str
    criterion: str


CASES = (
    Case("hexapod-42", "full pose", "D"),
    Case("hexapod-42", "position", "D"),
    Case("3-prs", "full pose", "D"),
    Case("3-prs", "position", "D"),
    Case("hexapod-42", "full pose", "I"),
    Case("hexapod-42", "position", "I"),
    Case("3-prs", "full pose", "I"),
)


def study(case: Case) -> list[object]:
    """One row: efficiencies against the bound, and what the certified design leaves open."""
    free = select_free_parameters(load_robot(case.robot))
    twists = scene(free, sample_workspace(free.robot, CANDIDATES, 0).solution.q).twists[0]
    rows = (twists / SIGMA[:, None])[
        :, slice(0, 6) if case.measured == "full pose" else slice(3, 6)
    ]
    start, p = Start.nothing(len(free)), len(free)
    criterion: Criterion = (
        D() if case.criterion == "D" else I(twists[:PREDICTED, 3:].reshape(-1, p), PREDICTED)
    )
    found = certified_design(rows, POSES, criterion, start)
    space, relaxed = found.design.directions, found.relaxed
    random = np.random.default_rng(0)
    even = [
        relaxed.efficiency(
            evaluate(criterion, design_factor(rows[chosen], start, space), space.machine)
        )
        for chosen in (random.choice(CANDIDATES, POSES, replace=False) for _ in range(DRAWS))
    ]
    plain = [
        relaxed.efficiency(value)
        for value in fedorov_exchange(rows, POSES, criterion, start, starts=STARTS).values
    ]
    return [
        case.robot,
        case.measured,
        case.criterion,
        len(space),
        float(np.median(even)),
        float(np.median(plain)),
        max(plain),
        found.efficiency,
        1.0 - found.efficiency,
    ]


def collect() -> dict:
    """Make the table."""
    columns = [
        "robot",
        "measured",
        "criterion",
        "directions",
        "even draws (median)",
        "20 exchange starts (median)",
        "best of them",
        "certified design",
        "gap to the bound",
    ]
    formats = ["", "", "", "d", ".3f", ".3f", ".4f", ".4f", ".1%"]
    rows = [study(case) for case in CASES]
    return {
        "candidates": CANDIDATES,
        "poses": POSES,
        "noise": SIGMA.tolist(),
        "tables": {"designs": {"columns": columns, "formats": formats, "rows": rows}},
    }
