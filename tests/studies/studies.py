# SPDX-License-Identifier: Apache-2.0
"""Small studies for tests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.studies.simulation.block import compute_block, list_tasks
from loopcal.studies.specification import (
    Cell,
    InstrumentLevel,
    MethodLevel,
    PosesLevel,
    Robot,
    Scores,
    Study,
    compute_key,
    describe_cell,
)
from loopcal.typing import FloatArray

CAMERA = InstrumentLevel(("component",), ("x", "y", "z"), sigma_position=2e-5)
SIGMA = CAMERA.sigma_position


@cache
def read_robot(name: str) -> Robot:
    """Return a shipped robot for studies."""
    return Robot(name, list_shipped_robots()[name].read_text(encoding="utf-8"))


def compute_block_key(study: Study, cell: Cell, block: int) -> str:
    """Return the key of a block of a study."""
    return compute_key(describe_cell(study, cell) | {"block": block})


def make_study(name: str = "linear-delta", **changes: Any) -> Study:
    """Return a study of one cell and one block of 6 trials, with changes."""
    study = Study(
        title="test",
        robots={name: read_robot(name)},
        seed=3,
        replicates=6,
        block=6,
        instruments={"camera": CAMERA},
        poses={"12": PosesLevel(12)},
        methods={"least squares": MethodLevel("least-squares")},
        scores=Scores(held_out=5),
    )
    return replace(study, **changes)


def compute_cells(study: Study) -> list[dict[str, FloatArray]]:
    """Return name -> (B,) score of the first block of each cell."""
    names = [column.name for column in study.columns]
    tasks = [task for task in list_tasks(study) if task.block == 0]
    return [dict(zip(names, compute_block(task).T, strict=True)) for task in tasks]
