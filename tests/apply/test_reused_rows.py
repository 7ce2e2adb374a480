# SPDX-License-Identifier: Apache-2.0
"""Rows that a run was fitted to are known again in other files, orders and units, and repeats are
not taken for them.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.apply.reused_rows import fitted_rows, seen_before
from loopcal.errors import DataError
from loopcal.measure import Measurements
from tests.estimate.problems import hexapod_data

FITTED = hexapod_data(20)
STORED = fitted_rows(FITTED)
OTHER = hexapod_data(20, 1)


def joined(*parts: Measurements) -> Measurements:
    """Poses of several measurements of one kind as one set."""
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


def test_a_part_of_the_fitted_rows_is_refused_in_another_order_and_after_rounding() -> None:
    some = FITTED.take(np.array([7, 3, 11, 0]))
    rows = some.observations[0]
    again = replace(some, observations=(replace(rows, measured=rows.measured * (1.0 + 1e-12)),))
    for data in (some, again):
        with pytest.raises(
            DataError,
            match=r"^4 of 4 rows are rows that this run was fitted to .*; give others, or use "
            r"--flag$",
        ):
            seen_before(STORED, data, "--flag")


def test_repeats_and_other_rows_are_unseen() -> None:
    rows = FITTED.observations[0]
    sigma = np.sqrt(np.einsum("rii->ri", rows.covariance))
    noise = (
        0.1 * sigma * np.random.default_rng(0).standard_normal(rows.measured.shape)
    )  # a tenth of what a repeat has
    assert (
        seen_before(
            STORED, replace(FITTED, observations=(replace(rows, measured=rows.measured + noise),))
        )
        == ""
    )
    assert seen_before(STORED, OTHER) == ""
    assert seen_before({}, FITTED) == ""


def test_few_fitted_rows_among_unseen_ones_are_named() -> None:
    found = seen_before(STORED, joined(FITTED.take(np.arange(3)), OTHER))
    assert found.startswith(
        "3 of 23 rows are rows that this run was fitted to (poses 1, 2, 3), which prove nothing"
    )


def test_poses_that_were_left_out_of_the_fit_are_unseen() -> None:
    assert seen_before(fitted_rows(FITTED, ("1", "2")), FITTED.take(np.arange(2))) == ""
    weight = np.ones(20)
    weight[:2] = 0.0
    assert seen_before(fitted_rows(FITTED.reweighted(weight)), FITTED.take(np.arange(2))) == ""


def test_absent_values_agree_with_absent_ones_only() -> None:
    rows = FITTED.observations[0]
    holes = np.array(rows.measured)
    holes[:, 0] = np.nan
    content = {"fitted_0_pose": np.concatenate([FITTED.readings, holes], axis=1)}
    assert seen_before(content, FITTED) == ""
    with pytest.raises(DataError, match="20 of 20"):
        seen_before(content | STORED, FITTED)
