# SPDX-License-Identifier: Apache-2.0
"""Division of the poses of a problem into blocks, with the rows that observed them."""

from __future__ import annotations

from collections.abc import Sequence

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.nuisance.elimination import NuisanceElimination, list_members
from loopcal.estimate.observation_rows import ObservationRows, divide_poses, find_needed_poses
from loopcal.estimate.poses.components import divide_components, group_components, groups_of_nodes
from loopcal.estimate.poses.coordinates import PoseCoordinates, TwistCoordinates
from loopcal.estimate.poses.exact import ExactPoses
from loopcal.estimate.poses.uncertain import UncertainPoses
from loopcal.measure import list_sensed_joints
from loopcal.typing import FloatArray, IntArray


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
