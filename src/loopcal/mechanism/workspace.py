# SPDX-License-Identifier: Apache-2.0
"""Limits of strokes, joints and rods, and random positions within the stated workspace."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal import geometry
from loopcal.engine import State
from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism.kinematics import compute_limb_frames
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse, make_solution
from loopcal.mechanism.states import join_states, select_poses
from loopcal.results.result import Result
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

MIN_DRAWS = 2000  # positions drawn before a workspace is refused
# Share of them that must be reachable: drawing n positions tries at most 100 n.
MIN_REACHABLE_SHARE = 1e-2


class Limit(NamedTuple):
    """A quantity (t, n) that must stay between two bounds [m or rad], such as `stroke of q3`."""

    name: str
    dimension: Dimension
    low: float
    high: float
    value: FloatArray
    is_stroke: bool = False

    @property
    def margin(self) -> FloatArray:
        """Distance to the nearer bound (t, n), negative outside [m or rad]."""
        return np.minimum(self.value - self.low, self.high - self.value)


def evaluate_limits(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> tuple[Limit, ...]:
    """Return all limits of a machine at readings q (t | 1, n, a) and their states (t, n)."""
    shape = state.status.shape
    limits = [
        Limit(
            f"stroke of {a.name}", a.dimension, *a.stroke, np.broadcast_to(q[..., i], shape), True
        )
        for i, a in enumerate(robot.actuators)
        if a.stroke is not None
    ]
    for limb in robot.assembly.limbs:
        for joint in limb.joints:
            if joint.limits is not None:
                name = f"{limb.name}.{joint.name}"
                value = robot.select_joint(state, name)
                limits.append(Limit(name, joint.dimension, *joint.limits, value))
    if any(limb.cones for limb in robot.assembly.limbs):
        all_frames = compute_limb_frames(robot, values, state)
        for limb, frames in zip(robot.assembly.limbs, all_frames, strict=True):
            rod = frames[:, :, -1, :3, 3] - frames[:, :, -2, :3, 3]
            rod = rod / np.linalg.norm(rod, axis=-1, keepdims=True)
            for cone in limb.cones:
                place, sign = (-2, 1.0) if cone.end == "tip" else (-1, -1.0)
                unit = np.array(cone.axis) / np.linalg.norm(cone.axis)
                axis = frames[:, :, place, :3, :3] @ unit
                sine = np.linalg.norm(np.cross(axis, rod), axis=-1)
                angle = np.arctan2(sine, sign * (axis * rod).sum(axis=-1))
                name = f"inclination of {limb.name} at its {cone.end}"
                limits.append(Limit(name, Dimension.ANGLE, 0.0, cone.angle, angle))
    return tuple(limits)


def check_limits(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> tuple[BoolArray, NDArray[np.object_]]:
    """Return which rows keep all limits (t, n), and the finding of the first exceeded, or None."""
    allowed, findings = np.ones(state.status.shape, bool), np.full(state.status.shape, None)
    for limit in evaluate_limits(robot, values, q, state):
        # a bound itself is allowed, up to the rounding of its own number
        outside = ~(limit.margin >= -1e-12 * max(abs(limit.low), abs(limit.high)))
        for row in zip(*np.nonzero(outside & allowed), strict=True):
            value, low, high = (
                robot.to_quantity(float(number), limit.dimension)
                for number in (limit.value[row], limit.low, limit.high)
            )
            findings[row] = report_finding(
                "limits.exceeded", name=limit.name, value=value, low=low, high=high
            )
        allowed &= ~outside
    return allowed, findings


@dataclass(frozen=True, eq=False, repr=False)
class WorkspaceSample(Result):
    """Positions drawn at random from a workspace.

    coordinates : (n, c) controlled coordinates [m, rad]. solution : their readings and poses.
    reachable_share : share of the stated ranges that the machine reaches.
    rejected : number of rejected positions by reason, the most frequent first.
    """

    coordinates: FloatArray
    solution: Solution
    reachable_share: float
    rejected: Mapping[str, int]


def sample_workspace(
    robot: Mechanism, n: int, seed: int | np.random.Generator = 0
) -> WorkspaceSample:
    """Draw n positions evenly from the ranges of `workspace`; draw unreachable ones again.

    Coordinates are uniform in their ranges; phi and theta are uniform over the area of the sphere
    that they enclose. Positions are rejected if the loops cannot be closed, if a stroke, a joint
    limit or a cone is exceeded, and where the readings lead from home to another pose (see
    `inverse`).

    Parameters
    ----------
    n : number of positions. seed : of the random stream, or the stream itself.

    Returns
    -------
    WorkspaceSample; the same for the same robot, n and seed.

    Raises
    ------
    MechanismError : n is below 1, the robot states no range for a controlled coordinate, or almost
        nothing of its workspace can be reached.
    """
    if n < 1:
        raise MechanismError(f"{n} positions to draw. Give 1 or more")
    rng = np.random.default_rng(seed)
    wanted = workspace_ranges(robot)
    rejected: Counter[str] = Counter()
    batches: list[tuple[FloatArray, Solution]] = []
    kept = tried = 0
    while kept < n or not tried:
        coordinates = draw_coordinates(rng, robot.controlled, wanted, max(n, MIN_DRAWS // 8))
        good, solution = find_reachable(robot, coordinates, rejected)
        batches.append((coordinates[good], solution.take(good)))
        kept, tried = kept + int(good.sum()), tried + len(coordinates)
        if tried >= MIN_DRAWS and kept < MIN_REACHABLE_SHARE * tried:
            reason, count = rejected.most_common(1)[0]
            raise MechanismError(
                f"{robot.name} reaches almost nothing of its workspace: {kept} of {tried} random "
                f"positions (at least {MIN_REACHABLE_SHARE:.0%} needed), most frequent reason: "
                f"{reason} ({count} positions). Correct `workspace:`, the strokes or the limits"
            )
    drawn, solutions = zip(*batches, strict=True)
    coordinates = np.concatenate(drawn)[:n]
    state = join_states(*(solution.state for solution in solutions))
    q = np.concatenate([solution.q for solution in solutions])[:n]
    solution = make_solution(robot, select_poses(state, np.arange(n)), q)
    return WorkspaceSample(coordinates, solution, kept / tried, dict((+rejected).most_common()))


class ReachableShare(NamedTuple):
    """Which share of the stated workspace a machine reaches, of `positions` random ones.

    low, high : 95 % interval of the share by Wilson's formula. reasons : those out of reach by
    what prevents them, the most frequent first.
    """

    share: float
    low: float
    high: float
    positions: int
    reasons: Mapping[str, int]


def measure_reachable_share(robot: Mechanism, n: int, seed: int = 0) -> ReachableShare | None:
    """Return the reachable share of the stated workspace, of n random poses; None without one."""
    try:
        ranges = workspace_ranges(robot)
    except MechanismError:
        return None
    if not ranges:
        return None
    rejected: Counter[str] = Counter()
    drawn = draw_coordinates(np.random.default_rng(seed), robot.controlled, ranges, n)
    k = int(find_reachable(robot, drawn, rejected)[0].sum())
    z = 1.96  # of the normal distribution at 95 %
    middle, half = k + z * z / 2, z * np.sqrt(k * (n - k) / n + z * z / 4)
    low, high = ((middle + sign * half) / (n + z * z) for sign in (-1.0, 1.0))
    return ReachableShare(k / n, float(low), float(high), n, dict((+rejected).most_common()))


# Tilts of rings of poses, as shares of the largest one; the tilts between them stay for checks.
RING_SHARES = (2 / 7, 4 / 7, 6 / 7)


def list_tilt_rings(robot: Mechanism, n: int) -> FloatArray:
    """Return coordinates (n, c) [m, rad] on three rings of equal tilt at even azimuths. If z is
    controlled, it takes the ends and the middle of its range in turn, begun anew on each ring.

    MechanismError : n is no multiple of 3, the robot controls other coordinates than phi, theta and
        z, states no range for one, or does not reach all of these positions.
    """
    rings, azimuths = len(RING_SHARES), n // len(RING_SHARES)
    if n < 1 or n % rings or not {"phi", "theta"} <= {*robot.controlled} <= {"phi", "theta", "z"}:
        raise MechanismError(
            f"{n} poses of {robot.name} are not {rings} rings of equal tilt. Take a multiple of "
            f"{rings} and a robot that controls phi and theta, or with z, alone"
        )
    ranges = workspace_ranges(robot)
    ring, i = np.repeat(np.arange(rings), azimuths), np.tile(np.arange(azimuths), rings)
    given = {
        "phi": geometry.wrap_angle(i * 2.0 * np.pi / azimuths),
        "theta": np.take(RING_SHARES, ring) * ranges["theta"][1],
    }
    if "z" in ranges:
        given["z"] = np.linspace(*ranges["z"], 3)[(ring + i) % 3]
    coordinates = np.column_stack([given[name] for name in robot.controlled])
    rejected: Counter[str] = Counter()
    if not find_reachable(robot, coordinates, rejected)[0].all():
        reason, count = rejected.most_common(1)[0]
        raise MechanismError(
            f"{robot.name} does not reach {count} of {n} poses on rings of equal tilt ({reason}). "
            "Reduce `workspace:`, or draw poses at random"
        )
    return coordinates


def resolve_poses(robot: Mechanism, poses: ArrayLike | int, seed: int) -> FloatArray:
    """Return coordinates (n, c) [m, rad]: those given, or a number of them from the workspace."""
    if isinstance(poses, int | np.integer):
        return sample_workspace(robot, int(poses), seed).coordinates
    return np.asarray(poses, dtype=np.float64)


def workspace_ranges(robot: Mechanism) -> dict[str, tuple[float, float]]:
    """Return the range of every controlled coordinate [m, rad]; phi is a full turn by default."""
    stated = dict(robot.assembly.workspace)
    if "theta" in stated:
        stated.setdefault("phi", (-np.pi, np.pi))
    missing = [name for name in robot.controlled if name not in stated]
    if missing:
        raise MechanismError(
            f"{robot.name} has no workspace for {', '.join(missing)}. Add `workspace:` with a "
            f"range for each of {', '.join(robot.controlled)} to its file"
        )
    return {name: stated[name] for name in robot.controlled}


def draw_coordinates(
    rng: np.random.Generator,
    names: tuple[str, ...],
    ranges: Mapping[str, tuple[float, float]],
    n: int,
) -> FloatArray:
    """Draw coordinates (n, c) evenly from their ranges [m, rad], reachable or not."""
    columns = []
    for name in names:
        low, high = ranges[name]
        if name == "theta":
            # the area of a cap grows with 1 - cos(theta)
            columns.append(np.arccos(rng.uniform(np.cos(high), np.cos(max(low, 0.0)), n)))
        else:
            columns.append(rng.uniform(low, high, n))
    return np.stack(columns, axis=-1)


def find_reachable(
    robot: Mechanism, coordinates: FloatArray, rejected: Counter[str]
) -> tuple[BoolArray, Solution]:
    """Return which rows the machine reaches (n,), and all solved; count reasons of the others."""
    values, solution = robot.values[None], inverse(robot, coordinates)
    good = np.array(solution.closed)
    rejected["the loops do not close"] += int((~good).sum())
    for limit in evaluate_limits(robot, values, solution.q[None], solution.state):
        outside = good & ~(limit.margin[0] >= 0)
        rejected[f"{limit.name} is exceeded"] += int(outside.sum())
        good &= ~outside
    rejected["in another mode than home"] += int((good & ~solution.converged).sum())
    return good & solution.converged, solution
