# SPDX-License-Identifier: Apache-2.0
"""Division of the poses of a problem into blocks, with the rows that observed them.

That of poses of uncertain readings is in `uncertain_division`, with what only they need.
"""

from __future__ import annotations

from collections.abc import Sequence

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.nuisance.elimination import NuisanceElimination, list_members
from loopcal.estimate.observation_rows import ObservationRows, divide_poses, find_needed_poses
from loopcal.estimate.poses.exact import ExactPoses
from loopcal.measure import list_sensed_joints
from loopcal.typing import FloatArray


def divide_exact_poses(
    free: FreeParameters,
    readings: FloatArray,
    rows: Sequence[ObservationRows],
    nuisance: NuisanceElimination | None,
    located: FloatArray | None,
    size: int,
) -> ExactPoses:
    """Return the rows at poses of exact readings (n, actuators), in blocks of `size` poses."""
    is_needed = find_needed_poses(rows, len(readings))
    blocks = divide_poses(readings, rows, is_needed, size)
    members = tuple(tuple(list_members(nuisance, own) for own in block.rows) for block in blocks)
    names = list_sensed_joints(r.kind for r in rows)
    return ExactPoses(free, len(readings), names, blocks, members, nuisance, located)
