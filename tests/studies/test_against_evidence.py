# SPDX-License-Identifier: Apache-2.0
"""Coverage and rank of studies agree with the evidence, which was computed without them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from loopcal.studies import compute_block, list_tasks
from loopcal.studies.specification.levels import (
    EffectsLevel,
    InstrumentLevel,
    MethodLevel,
    MethodName,
    PosesLevel,
)
from tests.studies.studies import make_study

EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence" / "coverage.json"
TRIALS = 1000

POSE = InstrumentLevel(("pose",), sigma_position=5e-6, sigma_angle=25e-6)
CAMERA = InstrumentLevel(("component",), ("x", "y", "z"), sigma_position=5e-6)
CASES = {
    "hexapod, least squares": ("hexapod-42", POSE, "least-squares", 1.0, 42),
    "3-PRS, MAP": ("3-prs", POSE, "map", 1.0, 33),
    "delta, MAP": ("linear-delta", CAMERA, "map", 1.0, 9),
    "hexapod, noise twice as large as stated": ("hexapod-42", POSE, "least-squares", 2.0, 42),
}


@pytest.mark.evidence
@pytest.mark.parametrize("case", CASES)
def test_coverage_and_rank_agree(case):
    rows = json.loads(EVIDENCE.read_text("utf-8"))["tables"]["coverage"]["rows"]
    fits, expected = next(row[1:3] for row in rows if row[0] == case)
    robot, instrument, method, noise, rank = CASES[case]
    study = make_study(
        robot,
        seed=11,
        replicates=TRIALS,
        block=250,
        instruments={"i": instrument},
        poses={"20": PosesLevel(20)},
        methods={method: MethodLevel(cast(MethodName, method))},
        effects={"noise": EffectsLevel(noise=noise)},
    )
    values = np.concatenate([compute_block(task).values for task in list_tasks(study)])
    scores = dict(zip((column.name for column in study.columns), values.T, strict=True))
    assert_array_equal(scores["outcome"], 0)
    assert_array_equal(scores["rank"], rank)
    share = 100.0 * scores["covered_parameters"]
    spread = share.std() * np.sqrt(1.0 / TRIALS + 1.0 / fits)
    assert abs(share.mean() - expected) < 3.5 * spread
