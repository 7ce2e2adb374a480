# SPDX-License-Identifier: Apache-2.0
"""Division of poses of uncertain readings into blocks of components, with their rows."""

from __future__ import annotations

from collections.abc import Sequence

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.nuisance.elimination import NuisanceElimination
from loopcal.estimate.observation_rows import ObservationRows, find_needed_poses
from loopcal.estimate.poses.components import divide_components, group_components, groups_of_nodes
from loopcal.estimate.poses.coordinates import PoseCoordinates, TwistCoordinates
from loopcal.estimate.poses.uncertain import UncertainPoses
from loopcal.measure import list_sensed_joints
from loopcal.typing import FloatArray, IntArray


def divide_uncertain_poses(
    free: FreeParameters,
    readings: FloatArray,
    rows: Sequence[ObservationRows],
    nuisance: NuisanceElimination | None,
    coordinates: PoseCoordinates,
    member: IntArray,
    size: int,
) -> UncertainPoses:
    """Return the rows at poses of uncertain readings, in blocks of components.

    member : (n,) component of each pose. size : of a block, in poses.
    """
    redundant = isinstance(coordinates, TwistCoordinates)
    is_needed = find_needed_poses(rows if redundant else rows[:-1], len(member))
    blocks = divide_components(readings, rows, member, is_needed, size)
    nodes, structures = groups_of_nodes(rows, member, nuisance)
    groups = tuple(group_components(block, member, nodes, structures) for block in blocks)
    names = list_sensed_joints(r.kind for r in rows)
    return UncertainPoses(free, names, coordinates, member, blocks, groups, nuisance, is_needed)
