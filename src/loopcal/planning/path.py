# SPDX-License-Identifier: Apache-2.0
"""Straight paths between poses: interpolation, distance, constraints, and a short order.

A path is straight in the controlled coordinates: positions and angles change evenly, the shorter
way round, and a tilt given by phi and theta changes as the vector (theta cos phi, theta sin phi),
which is regular at zero tilt. Paths are checked in small steps, many paths at once. Each step is
solved as its pose is commanded, from home; where a pose has several sets of readings, or infinitely
many with spare drives, they must not jump from one step to the next.

The order of visiting comes from nearest neighbors with several first poses, each improved by
reversing sections while that makes the path shorter (2-opt, Croes 1958,
doi:10.1287/opre.6.6.791). It is within a few per cent of the shortest for the few dozen poses of a
plan. Where no straight path is allowed between two poses, the path goes via home.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import TILT, list_dimensions, read_coordinates
from loopcal.mechanism.solutions import inverse
from loopcal.planning import constraints
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

STEPS = 40  # steps in which a path as long as the robot's size, or one radian, is checked
AT_ONCE = 4096  # paths of one number of steps
POSES_AT_ONCE = 1 << 12  # poses that are checked at once
JUMP = 4.0  # times the median step of its path: a longer step of readings is no even motion
FIRST_POSES = 8  # first poses that the order of visiting tries
# Share of the length by which a path must become shorter to count: rounding is no gain.
LEAST_GAIN = 1e-12
REVERSALS = 50  # reversals of sections for each pose of an order, at most: about one is enough
ORDERS = 100  # orders that are computed anew because a path is not allowed, at most


def locate_home(robot: Mechanism) -> FloatArray:
    """Return the controlled coordinates (c,) of home [m, rad], where every path starts."""
    return read_coordinates(robot.home, robot.controlled)


def find_angles(names: tuple[str, ...]) -> BoolArray:
    """Return which coordinates (c,) are angles."""
    return np.array([d is Dimension.ANGLE for d in list_dimensions(names)])


def interpolate_path(
    robot: Mechanism, start: FloatArray, end: FloatArray, share: float | FloatArray
) -> FloatArray:
    """Return coordinates (n, c) at a share (number or (n,)) of straight paths, start to end."""
    names, s = robot.controlled, np.asarray(share, dtype=float)
    angular = find_angles(names)
    step = end - start
    step = np.where(angular, geometry.wrap_angle(step), step)
    point = start + (s[..., None] if s.ndim else s) * step
    if "phi" in names:
        places = [names.index(name) for name in TILT[:2]]
        vector = (1.0 - s) * _tilt_vector(start, places) + s * _tilt_vector(end, places)
        point[:, places] = np.stack([np.angle(vector), np.abs(vector)], axis=1)
    return point


def measure_distance(robot: Mechanism, start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the length (..,) of straight paths [m]: the root of the squared changes, angles times
    the robot's size.
    """
    names = robot.controlled
    angular = find_angles(names)
    step = np.where(angular, robot.size * geometry.wrap_angle(end - start), end - start)
    if "phi" in names:
        places = [names.index(name) for name in TILT[:2]]
        tilted = robot.size * (_tilt_vector(end, places) - _tilt_vector(start, places))
        step[..., places] = np.stack([tilted.real, tilted.imag], axis=-1)
    return np.linalg.norm(step, axis=-1)


def check_paths(
    checker: constraints.ConstraintChecker, start: FloatArray, end: FloatArray, steps: int = STEPS
) -> constraints.ConstraintCheck:
    """Check straight paths from start (n, c) to end (n, c), both ends included, but for the line of
    sight.

    steps : of a path as long as the robot's size; longer paths get more, every path at least 4.
    """
    robot, n = checker.robot, len(start)
    violations = np.full(n, None, dtype=object)
    distance = measure_distance(robot, start, end)
    order = np.argsort(distance, kind="stable")
    scale = np.array(
        [robot.size if a.dimension is Dimension.LENGTH else 1.0 for a in robot.actuators]
    )
    for first in range(0, n, AT_ONCE):  # paths of similar length, in the same number of steps
        alike = order[first : first + AT_ONCE]
        count = max(int(np.ceil(steps * (float(distance[alike].max()) / robot.size))), 4)
        for i in range(0, len(alike), size := max(POSES_AT_ONCE // (count + 1), 1)):
            paths = alike[i : i + size]
            begin, goal = (np.repeat(ends[paths], count + 1, axis=0) for ends in (start, end))
            share = np.tile(np.arange(count + 1) / count, len(paths))
            solution = inverse(robot, interpolate_path(robot, begin, goal, share))
            check = checker.check_poses(solution, at_pose=False, steps=count + 1)
            allowed = check.allowed.reshape(-1, count + 1)
            step = np.arange(len(paths)), allowed.argmin(axis=1)
            found = check.violations.reshape(allowed.shape)[step]
            q = (solution.q / scale).reshape(*allowed.shape, -1)
            length = np.linalg.norm(np.diff(q, axis=1), axis=2)
            jumps = length.max(axis=1) > JUMP * np.median(length, axis=1)
            found[jumps & allowed.all(axis=1)] = constraints.Violation("branch-changed")
            violations[paths] = found
    are_allowed = np.array([violation is None for violation in violations], dtype=bool)
    return constraints.ConstraintCheck(are_allowed, violations)


def _tilt_vector(coordinates: FloatArray, places: list[int]) -> np.ndarray:
    """Return the tilt vector (..,) as a complex number: theta at the angle phi."""
    return coordinates[..., places[1]] * np.exp(1j * coordinates[..., places[0]])


@dataclass(frozen=True, eq=False)
class VisitingOrder:
    """An order of n poses."""

    order: IntArray  # (n,) indices of the poses
    # (n,) True where the path goes via home before the pose, because the straight path is not
    # allowed
    via_home: BoolArray
    length: float  # of the whole path from home to the last pose [m], see `measure_distance`
    # whether no reversal of a section makes it shorter; False where the search ran out of steps.
    # Paths that were not checked then go via home
    is_converged: bool


def order_poses(checker: constraints.ConstraintChecker, poses: FloatArray) -> VisitingOrder:
    """Return a short order of poses (n, c) [m, rad] that straight paths connect with home."""
    robot, n = checker.robot, len(poses)
    home = np.broadcast_to(locate_home(robot), poses.shape)
    from_home = measure_distance(robot, home, poses)
    direct = measure_distance(robot, poses[:, None], poses[None, :])
    around = from_home[:, None] + from_home[None, :]
    known, free = np.eye(n, dtype=bool), np.ones((n, n), dtype=bool)
    # A path is checked when an order uses it; one that is not allowed costs the way via home, and
    # the order is computed anew.
    order, length, is_converged = find_short_order(direct, from_home)
    for _ in range(ORDERS):
        first, second = order[:-1], order[1:]
        new = ~known[first, second]
        if not new.any():
            break
        first, second = first[new], second[new]
        allowed = check_paths(checker, poses[first], poses[second]).allowed
        known[first, second] = known[second, first] = True
        free[first, second] = free[second, first] = allowed
        order, length, is_converged = find_short_order(np.where(free, direct, around), from_home)
    first, second = order[:-1], order[1:]
    usable, is_checked = free & known, bool(known[first, second].all())
    if not is_checked:
        length = float(from_home[order[0]] + np.where(usable, direct, around)[first, second].sum())
    via = np.concatenate([[False], ~usable[first, second]])
    return VisitingOrder(order, via, length, is_checked and is_converged)


def find_short_order(cost: FloatArray, from_home: FloatArray) -> tuple[IntArray, float, bool]:
    """Return a short order (n,), its length, and whether no reversal makes it shorter, from
    symmetric costs (n, n) and costs from home (n,).
    """
    n = len(cost)
    whole = np.zeros((n + 1, n + 1))
    whole[1:, 1:], whole[0, 1:], whole[1:, 0] = cost, from_home, from_home
    firsts = np.argsort(from_home, kind="stable")[:FIRST_POSES] + 1
    tours, nearest = np.zeros((len(firsts), n + 1), dtype=np.int64), firsts
    left = np.arange(n + 1) > np.zeros((len(firsts), 1))
    for i in range(1, n + 1):  # to the nearest pose left
        tours[:, i] = nearest
        left[np.arange(len(firsts)), nearest] = False
        nearest = np.where(left, whole[nearest], np.inf).argmin(axis=1)
    best: tuple[IntArray, float, bool] | None = None
    for begun in tours:
        tour, is_converged = _reverse_sections(whole, begun)
        length = float(whole[tour[:-1], tour[1:]].sum())
        if best is None or length < best[1] * (1.0 - LEAST_GAIN):
            best = (tour[1:] - 1, length, is_converged)
    assert best is not None
    return best


def _reverse_sections(cost: FloatArray, tour: IntArray) -> tuple[IntArray, bool]:
    """Return the tour after reversing the section that shortens it most, until none does, and
    whether none does. The end is free, the beginning is not.
    """
    m, tour = len(tour), tour.copy()
    if m <= 2:
        return tour, True
    # in the order of the tour; after the last pose there is no step
    between = np.concatenate([cost[tour][:, tour], np.zeros((m, 1))], axis=1)
    is_section = np.triu(np.ones((m - 1, m - 1), dtype=bool))
    for _ in range(REVERSALS * m):
        # reversing i..j replaces the steps before i and after j
        steps = between.diagonal(1)
        gain = steps[:-1, None] + steps[1:] - between[:-1, 1:-1] - between[1:, 2:]
        gain = np.where(is_section, gain, -np.inf)
        i, j = divmod(int(np.argmax(gain)), m - 1)
        if not gain[i, j] > LEAST_GAIN * steps.sum():
            return tour, True
        section = slice(i + 1, j + 2)
        tour[section] = tour[section][::-1]
        between[section] = between[section][::-1]
        between[:, section] = between[:, section][:, ::-1]
    return tour, False


def check_route(robot: Mechanism, labels: Sequence[str], coordinates: FloatArray) -> FloatArray:
    """Return home (c,) [m, rad], after a check of the route from there through all stops and back.

    Strokes, joint limits, cones and singularities count; other constraints are those of a plan.

    labels : names of the stops. coordinates : (n, c) controlled coordinates [m, rad].
    """
    home = locate_home(robot)
    stops = np.vstack([home, coordinates, home])
    checker = constraints.build_checker(robot, constraints.Constraints(min_margin=0.0))
    check = check_paths(checker, stops[:-1], stops[1:])
    if not check.allowed.all():
        i = int(np.flatnonzero(~check.allowed)[0])
        names = ("home", *labels, "home")
        reasons = constraints.list_reasons(Counter([check.violations[i]]))
        raise MechanismError.of(
            "plan.route-blocked", first=names[i], last=names[i + 1], reasons=reasons
        )
    return home
