# SPDX-License-Identifier: Apache-2.0
"""Checks of measurements against their robot: readings, duplicates, targets that do not move.

Each check raises a `DataError` made from a finding of the catalog, unless the caller passes
`allow=True`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.kinds import CLOSURE
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.readings import (
    find_copies,
    find_reading_tolerance,
    list_joint_dimensions,
    resolve_reading_sigma,
)
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import compute_known_median, compute_median, find_distinct
from loopcal.results.tables import to_quantity
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import DISPLAY_UNITS, find_unit

# Values of a target within the first number of standard deviations count as static; the check
# refuses them if the robot moves the target by more than the second number. A single column is
# static if all its numbers are equal.
STATIC_SIGMAS, MOVING_SIGMAS = 10.0, 100.0
# Share of the motion of the robot below which values are constant by design: the poses are chosen
# so that a probe touches a surface, a bar keeps its length, or the platform stays level. A robot
# far from nominal then predicts a small change of a large motion.
CONSTANT_SHARE = 0.1
# Largest rotation of the base [rad], and displacement in sizes of the robot, with which values
# count as constant by design. End stops that are wrong by millimeters tilt the bed of a printer.
LARGEST_TILT = 0.25


def check_closure(
    robot: Mechanism, kinds: Sequence[Kind], reading_sigma: FloatArray | None, n_poses: int
) -> None:
    """Refuse the kind `closure` for a robot without redundant actuators, or for exact readings
    (standard deviations (n, a) [SI]; None as the robot states).
    """
    check_kinds(robot, kinds)
    is_closure = any(kind.name == CLOSURE for kind in kinds)
    if is_closure and resolve_reading_sigma(robot, reading_sigma, n_poses) is None:
        raise DataError.of("data.closure-without-sigma", robot=robot.name)


def check_kinds(robot: Mechanism, kinds: Sequence[Kind]) -> None:
    """Refuse the kind `closure` for a robot that does not have more actuators than freedoms, and
    sensors of another dimension than their joints.
    """
    if robot.redundancy is None and any(kind.name == CLOSURE for kind in kinds):
        counts: dict[str, Any] = {
            "actuators": len(robot.actuators),
            "freedoms": len(robot.freedoms),
        }
        code = "data.closure-without-redundancy"
        raise DataError.of(code, robot=robot.name, **counts)
    known = list_joint_dimensions(robot)
    for kind in (kind for kind in kinds if isinstance(kind, JointSensor)):
        for joint in kind.joints:
            if (dimension := known.get(joint, kind.dimension)) is not kind.dimension:
                raise DataError(
                    f"a sensor measures {joint!r} as {kind.measures}, but this joint is of "
                    f"{dimension.value}; write `measures: {dimension.value}`, or another joint"
                )


def check_actuators(measurements: Measurements, robot: Mechanism) -> None:
    """Refuse not one reading per actuator, and readings without information."""
    columns, names = measurements.readings.shape[1], tuple(a.name for a in robot.actuators)
    if columns != len(names):
        stated: dict[str, Any] = {"columns": columns, "robot": robot.name}
        stated |= {"actuators_count": len(names), "actuators": names}
        raise DataError.of("data.wrong-actuator-count", **stated)
    kinds = [rows.kind for rows in measurements.observations]
    check_closure(robot, kinds, measurements.reading_sigma, measurements.n_poses)


def find_outside_strokes(readings: FloatArray, robot: Mechanism) -> FloatArray:
    """Return by how much readings (n, a) are outside their strokes (n, a) [m or rad]; 0 inside."""
    strokes = [actuator.stroke or (-np.inf, np.inf) for actuator in robot.actuators]
    low, high = np.array(strokes).T
    return np.nan_to_num(np.maximum(np.maximum(low - readings, readings - high), 0.0))


def describe_outside_strokes(
    measurements: Measurements, robot: Mechanism, places: Sequence[str] = ()
) -> dict[str, Any] | None:
    """Return the data of a finding on readings outside their strokes; None without any: the reading
    that is farthest outside, as a share of its stroke, and the number and the actuators of all.

    places : of poses, such as `data.csv:12`.
    """
    beyond = find_outside_strokes(measurements.readings, robot) * robot.is_commanded
    if not beyond.any():
        return None
    widths = np.array([np.ptp(actuator.stroke or (0.0, 1.0)) for actuator in robot.actuators])
    pose, column = (int(i) for i in np.unravel_index(np.argmax(beyond / widths), beyond.shape))
    actuator = robot.actuators[column]
    assert actuator.stroke is not None
    shown = find_unit(robot.units[actuator.dimension])
    numbers = (measurements.readings[pose, column], *actuator.stroke)
    reading, lower, upper = (f"{number / shown.factor_to_si:.7g}" for number in numbers)
    outside = np.flatnonzero(beyond.any(axis=0)).tolist()
    return {
        "pose": measurements.labels[pose],
        "place": places[pose] if places else "",
        "actuator": actuator.name,
        "actuators": tuple(robot.actuators[j].name for j in outside),
        "reading": reading,
        "beyond": robot.to_quantity(float(beyond[pose, column]), actuator.dimension),
        "lower": lower,
        "upper": upper,
        "unit": str(shown),
        "count": int(np.count_nonzero(beyond)),
    }


def check_strokes(
    measurements: Measurements, robot: Mechanism, *, allow: bool = False, places: Sequence[str] = ()
) -> None:
    """Refuse readings outside the stroke of their actuator, unless they are allowed."""
    check_actuators(measurements, robot)
    described = None if allow else describe_outside_strokes(measurements, robot, places)
    if described is not None:
        raise DataError.of("data.outside-stroke", **described)


def check_duplicates(
    measurements: Measurements, *, allow: bool = False, places: Sequence[Sequence[str]] = ()
) -> None:
    """Refuse rows that are copies of others, perhaps with fewer digits; see `find_copies`.

    Two copies of one measurement count as twice the information. True repeats differ by their
    noise. Rows of weight 0 and rows without a measured value repeat nothing.

    places : of each row of each of the observations, those of the base last: `data.csv:12`.
    """
    if allow:
        return
    places_of = dict(zip(map(id, measurements.all_observations), places, strict=False))
    for alike in _group_equal_kinds(measurements.all_observations):
        kind = alike[0].kind
        parts = [(o, np.flatnonzero(o.is_measured & (o.weight > 0.0))) for o in alike]
        poses = np.concatenate(
            [o.rows.reshape(len(o), kind.poses_per_row)[rows] for o, rows in parts]
        )
        if len(poses) < 2:
            continue
        values, sd, degrees = _list_compared_values(measurements, kind, parts, poses)
        names = [
            np.concatenate([getattr(o, name)[rows] for o, rows in parts])
            for name in ("session", "group")
        ]
        numbers = [np.unique(of_rows, return_inverse=True)[1] for of_rows in names]
        key = np.column_stack([measurements.repeats[poses], *numbers, np.isnan(values)])
        member = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)
        original = find_copies(member, values, sd, degrees)
        copies = np.flatnonzero(original >= 0)
        if not len(copies):
            continue
        pair = (int(original[copies[0]]), int(copies[0]))
        lines = [
            places_of[id(o)][i] for o, rows in parts if id(o) in places_of for i in rows.tolist()
        ]
        where = tuple(lines[i] for i in pair) if lines else ()
        described: dict[str, Any] = {"kind": kind.name, "places": where, "more": len(copies) - 1}
        if kind.is_of_base:
            raise DataError.of("data.duplicate-base-rows", **described)
        labels = tuple(measurements.labels[poses[i, 0]] for i in pair)
        raise DataError.of("data.duplicate-rows", poses=labels, **described)


def _list_compared_values(
    measurements: Measurements,
    kind: Kind,
    parts: Sequence[tuple[Observations, IntArray]],
    poses: IntArray,
) -> tuple[FloatArray, FloatArray, int]:
    """Return values (r, c) [SI] of the rows of a kind at poses (r, l), standard deviations (c,) of
    their noise, and how many of the values are independent. A closure has those of the readings.
    """
    if not kind.columns:
        readings, sigma = measurements.readings, measurements.reading_sigma
        sd = find_reading_tolerance(readings, ())
        known = sd if sigma is None else np.median(sigma, axis=0)
        sd = np.where(np.isfinite(known) & (known > 0.0), known, sd)
        return readings[poses[:, 0]], sd, len(sd)
    values = np.concatenate([o.measured[rows] for o, rows in parts])
    variance = np.concatenate([np.einsum("rii->ri", o.covariance)[rows] for o, rows in parts])
    noise = np.sqrt(compute_known_median(variance, axis=0))
    named = {column.name: sd for column, sd in zip(kind.noise_columns, noise, strict=True)}
    # several columns of an orientation share the noise of its angles
    angles = [sd for name, sd in named.items() if name not in {c.name for c in kind.columns}]
    usual = compute_median(np.array(angles or noise))
    return values, np.array([named.get(c.name, usual) for c in kind.columns]), len(noise)


def check_targets_move(measurements: Measurements, T: FloatArray, size: float) -> None:
    """Refuse a target whose values stay within the noise, although the robot moves it.

    A reflector on the floor, a frozen display or the column of another target give such values. Any
    fit to them is wrong. Values that are constant by design are accepted: by the given geometry,
    the poses change them by less than `CONSTANT_SHARE` of what the motion of the platform could,
    perhaps after a small rigid motion of the base.

    T : (n, 4, 4) T_base_platform of each pose, of the nominal robot. size : of the robot [m].
    """
    for static in _find_static_targets(measurements):
        rows, kind = static.rows, static.rows.kind
        predicted = kind.measure(
            T[None, rows.rows],
            np.zeros((1, len(rows), len(kind.noise_columns))),
            labels=rows.labels,
        )[0]
        values = np.sort(predicted[static.present][:, static.columns], axis=0)
        # without the most extreme pose: a wrong one does not show that the others move the target
        expected = np.minimum(values[-1] - values[1], values[-2] - values[0])
        possible = _find_possible_change(static, T[rows.rows], size)
        moves = (expected > MOVING_SIGMAS * static.noise) & (expected > CONSTANT_SHARE * possible)
        if np.any(moves) and not _is_rigid_motion(static, predicted, possible, T[rows.rows], size):
            worst = int(np.argmax(np.where(moves, expected / static.noise, 0.0)))
            shown = DISPLAY_UNITS[kind.columns[static.columns[worst]].dimension]
            value, moved, planned = (
                to_quantity(number, shown)
                for number in (
                    rows.measured[static.present][0, static.columns[0]],
                    static.range[worst],
                    expected[worst],
                )
            )
            stated: dict[str, Any] = {"target": static.target, "kind": kind.name, "moved": moved}
            code = "conventions.target-never-moves"
            if static.target not in kind.target_columns:
                code = "conventions.column-never-changes"
                stated = {"column": static.target, "kind": kind.name, "value": value}
            raise DataError.of(code, **stated, expected=planned)


def has_static_targets(measurements: Measurements) -> bool:
    """Return whether `check_targets_move` has anything to compare with the robot."""
    return any(True for _ in _find_static_targets(measurements))


class _StaticTarget(NamedTuple):
    """A target whose values stay within the noise."""

    rows: Observations
    target: str
    present: BoolArray  # its rows
    columns: list[int]
    range: FloatArray  # (k,) of each column [SI]
    noise: FloatArray  # (k,) [SI]


def _find_possible_change(static: _StaticTarget, T: FloatArray, size: float) -> FloatArray:
    """Return how much columns (k,) [SI] would change by the motion of the platform between poses
    T (r, 4, 4) if it had the direction of the largest change.

    With the derivative (a, b) of a column by a rotation and a translation, and the largest rotation
    phi and translation d between the first and another pose, the change is |a| max(phi, d / size) +
    |b| d. Poses that keep a platform level show no rotation, so d / size is the least. The change
    is 0 for the forms of an orientation whose columns are no residuals: these cannot be constant.
    """
    T, kind = T[static.present], static.rows.kind
    if len(kind.columns) != len(kind.noise_columns):
        return np.zeros(len(static.columns))
    J = kind.evaluate(T[None], static.rows.measured[None, static.present]).jacobian[0]
    moved = geometry.invert_pose(T[0]) @ T
    d = float(np.linalg.norm(moved[:, :3, 3], axis=-1).max())
    angle = float(np.linalg.norm(geometry.log_so3(moved[:, :3, :3]), axis=-1).max())
    by_rotation, by_translation = np.median(
        np.linalg.norm(J[:, static.columns].reshape(len(T), -1, 2, 3), axis=-1), axis=0
    ).T
    return by_rotation * max(angle, d / size) + by_translation * d


def _is_rigid_motion(
    static: _StaticTarget, predicted: FloatArray, possible: FloatArray, T: FloatArray, size: float
) -> bool:
    """Return whether a small rigid motion of the base turns the predicted values (r, columns) [SI]
    of poses T (r, 4, 4) into constants, to first order.
    """
    kind, h = static.rows.kind, 1e-6
    motions = np.tile(np.eye(4), (6, 1, 1))
    motions[:3, :3, :3] = geometry.exp_so3(h * np.eye(3))
    motions[3:, :3, 3] = h * np.eye(3)
    noise = np.zeros((6, len(T), len(kind.noise_columns)))
    moved = kind.measure(motions[:, None] @ T, noise, labels=static.rows.labels)
    cells = np.ix_(np.flatnonzero(static.present), np.array(static.columns))
    slope = np.stack([(values[cells] - predicted[cells]).ravel() / h for values in moved], axis=1)
    change = predicted[cells] - static.rows.measured[cells]
    motion = np.linalg.lstsq(slope, -change.ravel(), rcond=1e-6)[0]
    rest = change + (slope @ motion).reshape(change.shape)
    is_constant = np.ptp(rest, axis=0) <= CONSTANT_SHARE * possible
    turn, shift = np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:]) / size
    return bool(is_constant.all() and max(turn, shift) <= LARGEST_TILT)


def _find_static_targets(measurements: Measurements) -> Iterator[_StaticTarget]:
    for rows in measurements.observations:
        kind = rows.kind
        comparable = kind.changes_with_pose and kind.poses_per_row == 1 and not kind.sensed_joints
        if not comparable or len(rows) < 3:
            continue
        noise = np.sqrt(np.einsum("rii->ri", rows.covariance)).max(axis=0)
        whole = kind.target_columns
        targets = {name: list(columns) for name, columns in whole.items()}
        if len(noise) != len(kind.columns):
            noise = np.full(len(kind.columns), noise.max())
        elif len(kind.columns) > 1:  # each column by itself, too
            for j, column in enumerate(kind.columns):
                targets.setdefault(column.name, [j])
        alike, is_measured = np.ones(len(rows), dtype=bool), rows.is_measured
        if kind.label_count:  # rows that measure what most do, such as one corner of a board
            own = rows.labels[is_measured]
            _, of, count = np.unique(own, axis=0, return_inverse=True, return_counts=True)
            alike = is_measured.copy()
            alike[is_measured] = of.ravel() == np.argmax(count) if len(count) else False
        limits = {
            target: STATIC_SIGMAS * noise[columns] if target in whole else 1e-15
            for target, columns in targets.items()
        }
        for session in find_distinct(rows.session):
            own = alike & (rows.session == session)
            ends = (np.inf, np.fmin), (-np.inf, np.fmax)
            low, high = (f.reduce(rows.measured[own], axis=0, initial=end) for end, f in ends)
            for target, columns in targets.items():
                if not np.all(high[columns] - low[columns] < limits[target]):
                    continue
                present = own & ~np.any(np.isnan(rows.measured[:, columns]), axis=1)
                if np.count_nonzero(present) >= 3:
                    range_ = np.ptp(rows.measured[present][:, columns], axis=0)
                    yield _StaticTarget(rows, target, present, columns, range_, noise[columns])


def _group_equal_kinds(observations: tuple[Observations, ...]) -> list[list[Observations]]:
    """Return observations in groups of one class and settings, as two files of one instrument."""

    def are_equal(kind: Kind, other: Kind) -> bool:
        names = [field.name for field in fields(kind) if field.init]
        return type(kind) is type(other) and all(
            np.array_equal(getattr(kind, name), getattr(other, name)) for name in names
        )

    groups: list[list[Observations]] = []
    for rows in observations:
        alike = next((group for group in groups if are_equal(rows.kind, group[0].kind)), None)
        if alike is None:
            groups.append([rows])
        else:
            alike.append(rows)
    return groups
