# SPDX-License-Identifier: Apache-2.0
"""Positions spread evenly over the stated workspace, as far as the machine reaches them within its
strokes and limits.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.batch_kinematics import compute_closure_sign
from loopcal.mechanism.kinematics import Solution, inverse
from loopcal.mechanism.limits import evaluate_limits
from loopcal.mechanism.model import Mechanism
from loopcal.typing import BoolArray, FloatArray

MIN_DRAWS, MIN_REACHABLE_SHARE = 2000, 1e-3
"""Positions drawn before a workspace is called empty, and the share of them that must be reachable.
"""


@dataclass(frozen=True)
class WorkspaceSample:
    """Positions drawn at random from a workspace.

    Attributes
    ----------
    coordinates : (n, c) controlled coordinates [m, rad]. solution : their readings and poses, n
        rows.
    reachable_share : share of the stated ranges that the machine reaches. rejected : what stops it elsewhere, in
        words, with the count.
    """

    coordinates: FloatArray
    solution: Solution
    reachable_share: float
    rejected: Mapping[str, int]


def sample_workspace(
    robot: Mechanism, n: int, seed: int | np.random.Generator = 0
) -> WorkspaceSample:
    """Draw n positions evenly from the ranges of `workspace`, those out of reach drawn anew.

    Coordinates are uniform in their ranges; phi and theta are uniform over the area of the sphere
    that they enclose. Left out is what cannot be closed, exceeds a stroke, a joint's limits or a
    cone, or lies beyond a singularity from home.

    Parameters
    ----------
    n : number of positions. seed : of the random stream, or the stream itself.

    Returns
    -------
    Sample; the same for the same robot, n and seed.

    Raises
    ------
    MechanismError
        The robot states no range for a controlled coordinate, or almost nothing of its workspace
        can be reached.
    """
    rng = np.random.default_rng(seed)
    wanted = workspace_ranges(robot)
    lost: Counter[str] = Counter()
    parts: list[FloatArray] = []
    kept = tried = 0
    while kept < n or not tried:
        coordinates = draw_coordinates(rng, robot.controlled, wanted, max(n, MIN_DRAWS // 8))
        good = _reached(robot, coordinates, lost)
        parts.append(coordinates[good])
        kept, tried = kept + int(good.sum()), tried + len(coordinates)
        if tried >= MIN_DRAWS and kept < MIN_REACHABLE_SHARE * tried:
            raise MechanismError(_empty(robot, kept, tried, lost))
    coordinates = np.concatenate(parts)[:n]
    return WorkspaceSample(
        coordinates, inverse(robot, coordinates), kept / tried, dict((+lost).most_common())
    )


def workspace_ranges(robot: Mechanism) -> dict[str, tuple[float, float]]:
    """Range of every controlled coordinate [m, rad]; phi runs all the way round where it is not
    stated.

    Raises
    ------
    MechanismError
        The robot states no range for a coordinate.
    """
    stated = dict(robot.assembly.workspace)
    if "theta" in stated:
        stated.setdefault("phi", (-np.pi, np.pi))
    missing = [name for name in robot.controlled if name not in stated]
    if missing:
        raise MechanismError(
            f"{robot.name} states no workspace for {', '.join(missing)}; add `workspace:` with a "
            "range for each of "
            f"{', '.join(robot.controlled)} to its file"
        )
    return {name: stated[name] for name in robot.controlled}


def draw_coordinates(
    rng: np.random.Generator,
    names: tuple[str, ...],
    within: Mapping[str, tuple[float, float]],
    n: int,
) -> FloatArray:
    """Coordinates (n, c) spread evenly over their ranges [m, rad], whether the machine reaches them
    or not.
    """
    columns = []
    for name in names:
        low, high = within[name]
        if name == "theta":
            # the area of a cap grows with 1 - cos(theta)
            columns.append(np.arccos(rng.uniform(np.cos(high), np.cos(max(low, 0.0)), n)))
        else:
            columns.append(rng.uniform(low, high, n))
    return np.stack(columns, axis=-1)


def _reached(robot: Mechanism, coordinates: FloatArray, lost: Counter[str]) -> BoolArray:
    """Which rows the machine reaches (n,); why it does not reach the others is added to `lost`."""
    values, found = robot.values[None], inverse(robot, coordinates)
    good = np.array(found.converged)
    lost["the loops cannot be closed"] += int((~good).sum())
    for limit in evaluate_limits(robot, values, found.q[None], found.state):
        outside = good & ~(limit.margin[0] >= 0)
        lost[f"{limit.name} is exceeded"] += int(outside.sum())
        good &= ~outside
    beyond = good & (
        compute_closure_sign(robot, values, found.state)[0]
        != compute_closure_sign(robot, values, robot.home_state)[0, 0]
    )
    lost["a singularity lies between it and home"] += int(beyond.sum())
    return good & ~beyond


def _empty(robot: Mechanism, kept: int, drawn: int, lost: Counter[str]) -> str:
    """The sentence for a workspace that cannot be reached."""
    reason, count = lost.most_common(1)[0]
    return (
        f"{robot.name}: the workspace is empty: {kept} of {drawn} positions drawn from it can be "
        "reached, most often because "
        f"{reason} ({count} of them); correct `workspace:`, the strokes or the limits"
    )
