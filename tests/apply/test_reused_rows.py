# SPDX-License-Identifier: Apache-2.0
"""Validation detects rows that were used in the fit, also in other files, orders and units;
repeated measurements are accepted.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.apply.reused_rows import collect_fitted_rows, find_reused_rows
from loopcal.errors import DataError
from loopcal.findings import Severity
from loopcal.measure import Measurements
from tests.estimate.problems import hexapod_data

FITTED = hexapod_data(20)
STORED = collect_fitted_rows(FITTED)
OTHER = hexapod_data(20, 1)


def join_measurements(*parts: Measurements) -> Measurements:
    """Join measurements of one kind."""
    readings = np.concatenate([part.readings for part in parts])
    rows = [part.observations[0] for part in parts]
    measured = np.concatenate([one.measured for one in rows])
    covariance = np.concatenate([one.covariance for one in rows])
    one = replace(
        rows[0].take(np.zeros(len(readings), dtype=int)),
        rows=np.arange(len(readings)),
        measured=measured,
        covariance=covariance,
    )
    return Measurements(parts[0].robot_name, readings, (one,))


def test_subset_of_fitted_rows_is_refused_in_another_order_and_after_rounding() -> None:
    some = FITTED.take(np.array([7, 3, 11, 0]))
    rows = some.observations[0]
    again = replace(some, observations=(replace(rows, measured=rows.measured * (1.0 + 1e-12)),))
    for data in (some, again):
        with pytest.raises(DataError) as refused:
            find_reused_rows(STORED, data)
        assert refused.value.code == "validation.rows-reused"
        assert refused.value.args[0].data["count"] == refused.value.args[0].data["total"] == 4


def test_repeated_and_new_measurements_are_accepted() -> None:
    rows = FITTED.observations[0]
    sigma = np.sqrt(np.einsum("rii->ri", rows.covariance))
    noise = (
        0.1 * sigma * np.random.default_rng(0).standard_normal(rows.measured.shape)
    )  # a tenth of what a repeat has
    assert (
        find_reused_rows(
            STORED, replace(FITTED, observations=(replace(rows, measured=rows.measured + noise),))
        )
        is None
    )
    assert find_reused_rows(STORED, OTHER) is None
    assert find_reused_rows({}, FITTED) is None


def test_few_fitted_rows_among_new_ones_are_reported() -> None:
    result = find_reused_rows(STORED, join_measurements(FITTED.take(np.arange(3)), OTHER))
    assert result is not None
    assert result.severity is Severity.WARNING
    assert result.data == {"count": 3, "total": 23, "poses": ("1", "2", "3")}


def test_poses_excluded_from_the_fit_are_accepted() -> None:
    assert (
        find_reused_rows(collect_fitted_rows(FITTED, ("1", "2")), FITTED.take(np.arange(2))) is None
    )
    weight = np.ones(20)
    weight[:2] = 0.0
    assert (
        find_reused_rows(
            collect_fitted_rows(FITTED.with_weights(weight)), FITTED.take(np.arange(2))
        )
        is None
    )


def test_missing_values_match_missing_values_only() -> None:
    rows = FITTED.observations[0]
    holes = np.array(rows.measured)
    holes[:, 0] = np.nan
    content = {"fitted_0_pose": np.concatenate([FITTED.readings, holes], axis=1)}
    assert find_reused_rows(content, FITTED) is None
    with pytest.raises(DataError, match="20 of 20"):
        find_reused_rows(content | STORED, FITTED)
