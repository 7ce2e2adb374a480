# SPDX-License-Identifier: Apache-2.0
"""Trials that are calibrated one by one: losses, adjusted intervals, verdicts, refused trials."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.studies.simulation.fits import OUTCOMES
from loopcal.studies.specification.levels import (
    EffectsLevel,
    InstrumentLevel,
    MethodLevel,
    Outliers,
    PosesLevel,
    Scores,
)
from tests.studies.studies import compute_cells, make_study


@pytest.mark.slow
def test_errors_in_fitted_frames_are_those_of_one_calibration():
    tracker = InstrumentLevel(("position",), sigma_position=2e-5, unknown_frames=("base", "tool"))
    study = make_study("hexapod-42", instruments={"t": tracker}, poses={"40": PosesLevel(40)})
    (together,) = compute_cells(study)
    (each,) = compute_cells(
        make_study(
            "hexapod-42",
            instruments={"t": tracker},
            poses={"40": PosesLevel(40)},
            scores=Scores(held_out=5, intervals="adjusted"),
        )
    )
    for name in ("position", "orientation", "position_before", "parameters", "rank"):
        assert_allclose(together[name], each[name], rtol=1e-4)
    (base,) = compute_cells(
        make_study(
            "hexapod-42",
            instruments={"t": tracker},
            poses={"40": PosesLevel(40)},
            scores=Scores(held_out=5, frame="base"),
        )
    )
    assert np.all(base["position"] > 1.5 * together["position"])
    assert_array_equal(base["covered_position"], 1.0)  # a frame that nothing determines


def test_trials_that_are_refused_are_counted():
    methods = {"huber": MethodLevel("least-squares", loss="huber")}
    (scores,) = compute_cells(make_study(methods=methods, poses={"2": PosesLevel(2)}))
    assert {OUTCOMES[int(code)] for code in scores["outcome"]} == {"study.refused"}
    assert np.isnan(scores["position"]).all()


def test_losses_resist_outliers():
    methods = {"plain": MethodLevel("map"), "tukey": MethodLevel("map", loss="tukey")}
    effects = {"outliers": EffectsLevel(outliers=Outliers(0.1, 30.0))}
    plain, tukey = compute_cells(
        make_study(methods=methods, effects=effects, poses={"20": PosesLevel(20)})
    )
    assert np.median(tukey["position"]) < 0.6 * np.median(plain["position"])
    assert tukey["covered_position"].mean() > 0.8


def test_adjusted_intervals_cover_the_truth_where_the_noise_is_larger_than_stated():
    effects = {"noise": EffectsLevel(noise=2.0)}
    scores = [
        compute_cells(
            make_study(
                effects=effects,
                poses={"20": PosesLevel(20)},
                replicates=15,
                block=15,
                scores=Scores(held_out=5, intervals=intervals),
            )
        )[0]
        for intervals in ("stated", "adjusted")
    ]
    assert_allclose(scores[0]["position"], scores[1]["position"], rtol=1e-6)
    assert scores[0]["covered_position"].mean() < 0.8
    assert scores[1]["covered_position"].mean() > 0.88


def test_verdicts_are_those_of_calibrations():
    scores = Scores(held_out=6, verdict=True, limit_position=1e-3)
    effects = {"none": EffectsLevel(), "noise": EffectsLevel(noise=4.0)}
    study = make_study(scores=scores, effects=effects, replicates=2, block=2)
    good, bad = compute_cells(study)
    assert set(good["verdict"]) <= {0.0, 1.0}
    assert_array_equal(bad["verdict"], 3.0)  # not calibrated
