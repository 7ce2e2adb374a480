# SPDX-License-Identifier: Apache-2.0
"""Coverage, rank and medians of studies agree with the evidence, which has other code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from loopcal.studies.simulation.block import compute_block, list_tasks
from loopcal.studies.specification.levels import (
    EffectsLevel,
    InstrumentLevel,
    MethodLevel,
    PosesLevel,
    Scores,
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
        methods={method: MethodLevel(method)},
        effects={"noise": EffectsLevel(noise=noise)},
    )
    values = np.concatenate([compute_block(task) for task in list_tasks(study)])
    scores = dict(zip((column.name for column in study.columns), values.T, strict=True))
    assert_array_equal(scores["outcome"], 0)
    assert_array_equal(scores["rank"], rank)
    share = 100.0 * scores["covered_parameters"]
    spread = share.std() * np.sqrt(1.0 / TRIALS + 1.0 / fits)
    assert abs(share.mean() - expected) < 3.5 * spread


METHODS = {
    "least squares": MethodLevel("least-squares"),
    "MAP": MethodLevel("map"),
    "default": MethodLevel("auto"),
}
MEDIANS = {
    "hexapod-42": InstrumentLevel(("pose",), sigma_position=1e-5, sigma_angle=5e-5),
    "3-prs": InstrumentLevel(("pose",), sigma_position=1e-5, sigma_angle=5e-5),
    "linear-delta": InstrumentLevel(("component",), ("x", "y", "z"), sigma_position=1e-5),
}
MEDIAN_TRIALS, MEDIAN_POSES = 200, 25


@pytest.mark.evidence
@pytest.mark.parametrize("robot", MEDIANS)
def test_medians_of_errors_agree(robot):
    """The study has the measured and the held-out poses of the evidence, which follow from the
    seed, and other machines and noise. Errors are in the base frame; every coordinate is measured.

    The logarithm of the median of n machines scatters by 1.2533 sd(log error) / sqrt(n).
    """
    document = json.loads((EVIDENCE.parent / "known_truth.json").read_text("utf-8"))
    table = document["tables"]["median_error_um"]
    row = next(r for r in table["rows"] if r[0] == robot and r[1] == "10 um, 50 urad")
    expected = dict(zip(table["columns"], row, strict=True))
    assert document["poses"][0] == MEDIAN_POSES
    study = make_study(
        robot,
        seed=document["seed"],
        replicates=MEDIAN_TRIALS,
        block=MEDIAN_TRIALS,
        instruments={"i": MEDIANS[robot]},
        poses={"25": PosesLevel(MEDIAN_POSES)},
        methods=METHODS,
        scores=Scores(held_out=60, frame="base"),
    )
    names = [column.name for column in study.columns]
    errors: dict[str, np.ndarray] = {}
    for task in list_tasks(study):
        scores = dict(zip(names, compute_block(task).T, strict=True))
        errors[study.cells[task.cell].levels["method"]] = np.log(1e6 * scores["position"])
        errors["before"] = np.log(1e6 * scores["position_before"])
    assert set(errors) == {"before", *METHODS}
    for name, values in errors.items():
        spread = 1.2533 * values.std() * np.sqrt(1.0 / MEDIAN_TRIALS + 1.0 / document["machines"])
        assert abs(np.median(values) - np.log(expected[name])) < 3.5 * spread
