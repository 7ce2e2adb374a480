# SPDX-License-Identifier: Apache-2.0
"""Stores with scores that the tests state, in place of those of simulated calibrations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from loopcal.io.robot.robot_file import find_robot_file
from loopcal.studies.files.store import StudySource, load_specification, open_study, read_store
from loopcal.studies.specification import (
    Cell,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    Question,
    Robot,
    Study,
)
from loopcal.studies.study_result import StudyResult, find_columns
from tests.studies.studies import compute_block_key

Scores = dict[str, np.ndarray]
"""Name of a score -> its values (t,)."""


def make_study(replicates: int = 400, questions: dict[str, Question] | None = None) -> Study:
    """Return a study with three numbers of poses, two noises and two methods."""
    text = find_robot_file("five-bar").read_text("utf-8")
    return Study(
        "Stated scores",
        robots={"five-bar": Robot("five-bar", text)},
        replicates=replicates,
        block=100,
        instruments={"tracker": InstrumentLevel(kinds=("position",))},
        noise={"1": NoiseLevel(1.0), "2": NoiseLevel(2.0)},
        poses={"40": PosesLevel(40), "10": PosesLevel(10), "20": PosesLevel(20)},
        methods={"map": MethodLevel("map"), "least-squares": MethodLevel("least-squares")},
        order=("poses", "noise", "method"),
        questions=questions or {},
    )


def store_scores(folder: Path, study: Study, compute: Callable[[Cell], Scores]) -> StudyResult:
    """Make the folder of a study whose trials have these scores, and 1 in all other columns."""
    names = [column.name for column in study.columns]
    with open_study(folder, StudySource(study)) as store:
        for cell in study.cells:
            scores = np.ones((study.blocks * study.block, len(names)))
            scores[:, 0] = 0.0
            for name, values in compute(cell).items():
                count = min(len(values), len(scores))
                scores[:count, find_columns(study, [name])[0]] = values[:count]
            for block in range(study.blocks):
                part = scores[block * study.block : (block + 1) * study.block]
                key = compute_block_key(study, cell, block)
                assert store.add_block(key, cell.levels, block, part, 0.1)
    with read_store(folder) as store:
        assert load_specification(store) == study
    return StudyResult(folder)
