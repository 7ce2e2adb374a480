# SPDX-License-Identifier: Apache-2.0
"""Choose which poses are resampled together."""

from __future__ import annotations

import numpy as np

from loopcal.diagnose.fit_checks.independent_units import (
    FEWEST_CLUSTERS,
    Clusters,
    divide_into_clusters,
)
from loopcal.errors import EstimationError
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.findings import report_finding
from loopcal.measure import Measurements
from loopcal.numerics.elimination_tree import find_connected_groups
from loopcal.typing import IntArray

ENOUGH_BLOCKS = 12
"""Blocks of a unit with which it is resampled by default: with fewer, the scatter of the resamples
is itself known to 20 % at best.
"""


UNITS = ("pose", "block", "session", "day")
"""Names of units."""


def choose_blocks(data: Measurements, unit: str | int | None = None) -> Clusters:
    """Return the blocks of poses that are resampled together.

    Parameters
    ----------
    unit : "pose", "block", "session" or "day", or the number of consecutive poses of a block, in
        the order of the column `time`, or else of the file. None takes the largest unit with at
        least `ENOUGH_BLOCKS` blocks, or else the smallest.

    Raises
    ------
    EstimationError : the data do not contain enough units of this name.
    """
    if isinstance(unit, int):
        return _consecutive(data, unit)
    if unit is not None and unit not in UNITS:
        raise EstimationError(
            f"unit is {unit!r}; it must be one of {', '.join(UNITS)}, or a number of consecutive "
            "poses"
        )
    divisions = divide_into_clusters(data)
    if not divisions:
        raise EstimationError(report_finding("sampling.too-few-blocks", unit=unit or "pose"))
    if unit is None:
        enough = (blocks for blocks in divisions if blocks.count >= ENOUGH_BLOCKS)
        return next(enough, divisions[-1])
    named = [blocks for blocks in divisions if blocks.unit == unit]
    if not named:
        available = tuple(f"{blocks.count} {blocks.unit}s" for blocks in divisions)
        raise EstimationError(
            report_finding("sampling.unit-unknown", unit=unit, available=available)
        )
    return named[0]


def _consecutive(data: Measurements, length: int) -> Clusters:
    """Return runs of `length` consecutive poses; blocks of linked poses stay together."""
    if length < 1:
        raise EstimationError(f"blocks of {length} poses: give a number of at least 1")
    n, linked = data.n_poses, linked_blocks(data)
    order = np.arange(n)
    time = data.context.get("time")
    if time is not None and not np.isnan(time).any():
        order = np.argsort(time, kind="stable")
    run = np.empty(n, dtype=np.int64)
    run[order] = np.arange(n) // length
    links: IntArray = np.column_stack([run, run.max() + 1 + linked])
    joined = find_connected_groups(links, int(links.max()) + 1)[run]
    names, member = np.unique(joined, return_inverse=True)
    name = f"{length}-pose run"
    if len(names) < FEWEST_CLUSTERS:
        raise EstimationError(report_finding("sampling.too-few-blocks", unit=name))
    return Clusters(name, member, len(names))
