# SPDX-License-Identifier: Apache-2.0
"""Trials of a batch are selected by indices or by a mask."""

from dataclasses import dataclass

import numpy as np
import pytest

from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Values(TrialBatch):
    """A batch of a single array."""

    array: FloatArray


VALUES = Values(np.array([1.0, 2.0]))


@pytest.mark.parametrize(
    ("trials", "expected"),
    [
        ([0, 1], [1.0, 2.0]),
        ([1], [2.0]),
        ([False, True], [2.0]),  # equal to the indices [0, 1] as numbers
        ([True, True], [1.0, 2.0]),
    ],
)
def test_trials_are_selected_by_indices_or_by_a_mask(trials, expected) -> None:
    assert VALUES.take(np.array(trials)).array.tolist() == expected


def test_put_with_a_mask_replaces_the_marked_trials() -> None:
    changed = VALUES.put(np.array([False, True]), Values(np.array([5.0])))
    assert changed.array.tolist() == [1.0, 5.0]


def test_all_trials_are_not_copied() -> None:
    assert VALUES.take(np.array([0, 1])) is VALUES
    assert VALUES.take(np.array([True, True])) is VALUES
    assert VALUES.take(np.array([1, 0])) is not VALUES
