# SPDX-License-Identifier: Apache-2.0
"""Poses left out on request, by their labels, with their place kept: their rows get weight 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.measure import Measurements
from loopcal.measure.measurements import weight_reading_sigma


def exclude_poses(data: Measurements, drop: Sequence[str]) -> Measurements:
    """Return the measurements with weight 0 for every row that sees one of these poses, and their
    readings not believed.

    Parameters
    ----------
    data : measurements. drop : labels.

    Raises
    ------
    DataError
        A label is not there, or a text was given where a sequence of labels is meant.
    """
    if isinstance(drop, str):
        raise DataError(f"drop is the text {drop!r}; give a sequence of labels, such as [{drop!r}]")
    if not drop:
        return data
    for label in drop:
        if label not in data.labels:
            raise DataError(
                f"there is no pose {label!r} to leave out{suggest_names(label, data.labels)}; give "
                "labels of the data"
            )
    kept = np.array([label not in drop for label in data.labels])
    observations = tuple(
        o.with_weights(o.weight * kept[o.rows].reshape(len(o), -1).all(axis=1))
        for o in data.observations
    )
    return replace(
        data,
        observations=observations,
        reading_sigma=weight_reading_sigma(data.reading_sigma, kept.astype(np.float64)),
    )
