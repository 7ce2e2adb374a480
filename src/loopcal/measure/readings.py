# SPDX-License-Identifier: Apache-2.0
"""Actuator readings of commanded poses, values of joints that kinds sense, and poses that repeat
another one: their readings differ by less than shows in the measurements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from loopcal.engine import State
from loopcal.errors import DataError, suggest_names
from loopcal.measure.array_checks import broadcast_array, refuse_first
from loopcal.measure.kinds.joints import ActuatorReadings
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.observations import Observations
from loopcal.mechanism.chains import locate_bodies, select_entries
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.numerics.statistics import binomial_tail, compute_median
from loopcal.typing import FloatArray, IntArray
from loopcal.units import SMALLEST_SD, Dimension

if TYPE_CHECKING:
    from loopcal.measure.measurements import Measurements


# Largest finite standard deviation of a reading, in sizes of the robot or radians.
LARGEST_SIGMA = 1e6


def solve_commanded_poses(
    controller: Mechanism,
    commanded: ArrayLike,
    labels: Sequence[str] = (),
    places: Sequence[str] = (),
) -> Solution:
    """Return readings, poses and passive joints that a controller computes for commanded poses;
    DataError where its geometry does not reach one.

    commanded : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI].
    labels, places : names of the poses, and their places such as `poses.csv:12`, for messages.
    """
    solution = inverse(controller, commanded)
    if labels and len(labels) != len(solution):
        raise DataError(f"{len(labels)} names for {len(solution)} poses. Name each pose")
    failed = ~solution.converged
    refuse_first(
        failed,
        lambda i: (
            f"{controller.name!r} does not reach commanded pose {name_pose(i, labels, places)} "
            f"({failed.sum()} of {len(failed)} fail): {solution.explain(i)}. Correct the pose, or "
            "the geometry of the controller"
        ),
    )
    return solution


def name_pose(index: int, labels: Sequence[str] = (), places: Sequence[str] = ()) -> str:
    """Return how a message names a pose: `'p3' at poses.csv:12`; "1", "2", ... without labels."""
    label = repr(labels[index] if labels else str(index + 1))
    return f"{label} at {places[index]}" if places else label


def list_sensed_joints(kinds: Iterable[Kind]) -> tuple[str, ...]:
    """Return the names of all joints that kinds sense, each once."""
    return tuple(dict.fromkeys(name for kind in kinds for name in kind.sensed_joints))


def list_joint_dimensions(robot: Mechanism) -> dict[str, Dimension]:
    """Return the dimensions of the joints for a sensor, by name."""
    passive = {f"{limb.name}.{j.name}": j.dimension for limb, j in robot.assembly.passive_joints}
    return {actuator.name: actuator.dimension for actuator in robot.actuators} | passive


def select_joint_values(
    robot: Mechanism, names: Iterable[str], readings: FloatArray, state: State
) -> dict[str, FloatArray]:
    """Return values (t or 1, n) [SI] of joints by name; DataError if the robot does not have one.

    names : of actuators, whose value is their reading, or of passive joints as `limb.joint`.
    readings : (t or 1, n, a) [SI]. state : of t trials and n poses.
    """
    actuators = [actuator.name for actuator in robot.actuators]
    passive = {f"{limb.name}.{joint.name}" for limb, joint in robot.assembly.passive_joints}
    entries = select_entries(robot, state)
    values = {}
    for name in names:
        if name in actuators:
            values[name] = readings[..., actuators.index(name)]
        elif name in passive:
            values[name] = robot.select_joint(state, name)
        elif name in entries:
            values[name] = entries[name]
        elif ":" in name:
            body, bodies = name.partition(":")[0], list(locate_bodies(robot, state))
            raise DataError(
                f"{robot.name!r} has no stage or body {body!r}{suggest_names(body, bodies)}; "
                f"it has {', '.join(bodies) or 'none beside the platform'}"
            )
        else:
            known = [*actuators, *passive]
            raise DataError(
                f"{robot.name!r} has no joint {name!r}{suggest_names(name, known)}; joints for a "
                f"sensor are {', '.join(known)}"
            )
    return values


def make_readings_kind(robot: Mechanism) -> ActuatorReadings:
    """Return the kind of a robot's readings, by which an uncertain one measures the true one."""
    return ActuatorReadings({actuator.name: actuator.dimension for actuator in robot.actuators})


def weight_reading_sigma(sigma: FloatArray | None, weight: FloatArray) -> FloatArray | None:
    """Return standard deviations (n, a) of readings whose squares count by a weight (n,), of which
    0 makes them infinite; exact readings stay exact.
    """
    if sigma is None:
        return None
    root = np.sqrt(weight)[:, None]
    weighted = np.divide(sigma, root, out=np.full(sigma.shape, np.inf), where=root > 0.0)
    return np.where(sigma == 0.0, 0.0, weighted)


def broadcast_reading_sigma(sigma: ArrayLike, readings: FloatArray) -> FloatArray:
    """Return standard deviations (n, a) of readings (n, a) from what broadcasts to them."""
    n, a = readings.shape
    wanted = (
        f"numbers, in meters and radians: one, or one for each of the {a} actuators, or one for "
        f"each of the {n} x {a} readings"
    )
    return broadcast_array(sigma, readings.shape, "reading_sigma", wanted)


def _refuse_wrong_sigma(sigma: FloatArray, name: Callable[[int, int], str]) -> None:
    """Raise DataError for a sigma (n, a) that is none; `name` it by pose and actuator."""
    act = f"Give 0 (exact), a positive number from {SMALLEST_SD:g} on, or infinity (missing)"
    refuse_first(
        ~((sigma == 0.0) | (sigma >= SMALLEST_SD)),
        lambda i, j: f"{name(i, j)} is not a standard deviation. {act}",
    )


def check_reading_sigma(
    sigma: ArrayLike, readings: FloatArray, labels: tuple[str, ...]
) -> FloatArray:
    """Return checked, read-only standard deviations of readings (n, a); DataError if one is
    negative or not a number, or a reading is missing although its sigma is finite.
    """
    checked = broadcast_reading_sigma(sigma, readings)

    def name(pose: int, column: int) -> str:
        value = f"{checked[pose, column]:.6g}"
        return f"pose {labels[pose]!r}: the sigma {value} [m or rad] of reading {column + 1}"

    _refuse_wrong_sigma(checked, name)
    refuse_first(
        np.isnan(readings) & np.isfinite(checked),
        lambda i, j: f"{name(i, j)} belongs to a missing reading. Give the reading, or infinity",
    )
    checked.setflags(write=False)
    return checked


def resolve_reading_sigma(robot: Mechanism, given: FloatArray | None, n: int) -> FloatArray | None:
    """Return the standard deviations (n, a) [SI] of readings, or None where all are exact; those
    that are given win over those that the robot states.

    DataError : a sigma is no standard deviation, or too large to mean anything; or a reading of a
        robot with redundant actuators is exact. The poses of such a robot are free and readings
        follow from them, see docs/theory/identification.md.
    """
    if given is None:
        if not robot.stated_sigma.any():
            return None
        given = np.tile(robot.stated_sigma, (n, 1))
    is_length = [actuator.dimension is Dimension.LENGTH for actuator in robot.actuators]
    size = np.where(is_length, robot.size, 1.0)

    def name(pose: int, column: int) -> str:
        actuator = robot.actuators[column]
        shown = robot.get_unit(actuator.dimension)
        value = f"{given[pose, column] / shown.factor_to_si:.6g} {shown.symbol}"
        return f"the sigma {value} of the reading of {actuator.name} in row {pose + 1}"

    _refuse_wrong_sigma(given, name)
    refuse_first(
        np.isfinite(given) & (given / size > LARGEST_SIGMA),
        lambda i, j: (
            f"{name(i, j)} is larger than any possible error of a reading. Give inf (missing) "
            "instead"
        ),
    )
    wrong = (given == 0.0) == robot.is_commanded
    if robot.redundancy is not None and wrong.any():
        column = int(np.argwhere(wrong)[0, 1])
        reading = robot.actuators[column].name
        if not robot.is_commanded[column]:
            raise DataError(
                f"the data state a sigma of {reading}, but conditions of a robot with redundant "
                "actuators count as exact. Leave out this sigma"
            )
        raise DataError(
            f"the data declare exact readings of {reading}, but {robot.name!r} has "
            f"{robot.is_commanded.sum()} actuators for {len(robot.freedoms)} degrees of freedom. "
            "Readings of redundant actuators cannot be exact. Give each a sigma above 0, a "
            "small one for very good encoders"
        )
    return given if np.any(given != 0.0) else None


def fill_in_reading_sigma(robot: Mechanism, data: Measurements) -> Measurements:
    """Return measurements with the robot's standard deviations; the same if readings are exact."""
    sigma = resolve_reading_sigma(robot, data.reading_sigma, data.n_poses)
    is_same = sigma is None or sigma is data.reading_sigma
    return data if is_same else replace(data, reading_sigma=sigma)


# Standard deviations of the noise by which repeats may differ. The readings of a few visits span
# two to four standard deviations of their jitter, so jitter below the noise is accepted. Errors
# of the model change over a much larger share of the range.
SIGMAS = 3.0
# Largest tolerance, as a share of the range of a reading, however coarse the instrument is: the
# errors of a geometry are equal at poses that are this near.
LARGEST_SHARE = 1e-3
# Least range of a reading, as a share of the largest one: measurements of one pose have no range.
LEAST_RANGE = 1e-2
RANGE = (0.1, 0.9)  # quantiles, so that a wrong row does not change the tolerance
MISSING = 1e300  # stands for readings that are NaN: equal to each other
STEP, STEPS = 4.0, 8  # factor and number of the finer gaps at which long chains are divided


def find_reading_tolerance(
    readings: FloatArray,
    observations: Sequence[Observations],
    reading_sigma: FloatArray | None = None,
) -> FloatArray:
    """Return by how much each reading (a,) [SI] of repeats may differ.

    A controller records the readings of each visit of a pose with jitter of its own, so repeats
    seldom have equal readings. The tolerance of a reading is the share of its range that the noise
    has of the range of measured values: it moves none of them much beyond its noise.

    readings : (n, a) [SI]. observations : with the noise of their rows. reading_sigma : (n, a)
        [SI] or None, of uncertain readings, which differ by it although the pose is the same.
    """
    share = LARGEST_SHARE
    for o in observations:
        places = {column.name: j for j, column in enumerate(o.kind.columns)}
        for i, column in enumerate(o.kind.noise_columns):
            seen = o.present[:, i] & (o.weight > 0.0)
            if seen.any() and column.name in places:
                span = np.ptp(np.quantile(o.measured[seen, places[column.name]], RANGE))
                sd = compute_median(np.sqrt(o.covariance[seen, i, i]))
                share = min(share, SIGMAS * sd / span) if span > 0.0 else share
    is_known = np.isfinite(readings)
    first = np.take_along_axis(readings, is_known.argmax(axis=0)[None], axis=0)
    known = np.where(is_known, readings, np.nan_to_num(first))
    least = LEAST_RANGE * np.abs(known).max(initial=0.0)
    tolerance = share * np.maximum(np.ptp(np.quantile(known, RANGE, axis=0), axis=0), least)
    if reading_sigma is not None:
        jitter = np.median(np.where(np.isfinite(reading_sigma), reading_sigma, 0.0), axis=0)
        tolerance = np.maximum(tolerance, 2.0 * SIGMAS * jitter)
    return np.asarray(tolerance)


def find_repeats(readings: FloatArray, tolerance: FloatArray) -> IntArray:
    """Return the number (n,) of the pose that each pose repeats, whatever their order.

    Poses without a gap above the tolerance (a,) between their readings (n, a) are repeats where all
    lie within the tolerance. Longer chains, as of a slow scan, are divided at smaller gaps, in the
    end between all readings that differ.
    """
    values, sorting = np.nan_to_num(readings, nan=MISSING), np.zeros((0, 0), dtype=np.intp)
    label, is_open = np.zeros(len(values), dtype=np.intp), np.ones(len(values), dtype=bool)
    for gap in (*(tolerance / STEP**k for k in range(STEPS)), np.zeros_like(tolerance)):
        if len(sorting) != np.count_nonzero(is_open):
            sorting = np.argsort(values[is_open], axis=0, kind="stable")
        label[is_open] = label.max() + 1 + _divide(values[is_open], gap, label[is_open], sorting)
        label = np.unique(label, return_inverse=True)[1].reshape(-1)
        order = np.argsort(label, kind="stable")
        begin = np.flatnonzero(np.diff(label[order], prepend=-1))
        ordered = values[order]
        extent = np.maximum.reduceat(ordered, begin) - np.minimum.reduceat(ordered, begin)
        is_open = np.any(extent > tolerance, axis=1)[label]
        if not is_open.any():
            break
    return label


def _divide(values: FloatArray, gap: FloatArray, label: IntArray, sorting: IntArray) -> IntArray:
    """Return the numbers (n,) of groups that no column of values (n, a) can divide at a gap above
    that of the column (a,), within those of a label (n,). `sorting` (n, a) orders each column.
    """
    count = 0
    while (groups := int(label.max()) + 1) > count:
        count = groups
        for column, largest, by_column in zip(values.T, gap, sorting.T, strict=True):
            order = by_column[np.argsort(label[by_column], kind="stable")]
            is_new = (np.diff(label[order]) != 0) | (np.diff(column[order]) > largest)
            label = np.empty_like(label)
            label[order] = np.concatenate([[0], np.cumsum(is_new)])
    return label


# Probability of refusing measurements in which every row was measured. Stated sigmas may be larger
# than the noise of repeats by this factor: those of one session share errors of the instrument.
CHANCE, OVERSTATED = 1e-5, 3.0
LEVELS = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4, 1e-6, 1e-9)  # of agreement [standard deviations]
# Steps [SI] of lengths and of angles of which the rounding of values is a multiple.
SMALLEST_STEPS = (1e-9, np.deg2rad(1e-7))
ROUNDED, FULL_DIGITS = 1e-3, 1e-13  # part of a step that is rounding, and step of unrounded numbers


def find_copies(member: IntArray, values: FloatArray, sd: FloatArray, degrees: int) -> IntArray:
    """Return which earlier row each row (r,) copies, perhaps with fewer digits; -1 for none.

    Two measurements of one value differ by at most e standard deviations with the probability
    `(2 floor(e sigma / s) + 1) s / (2 sqrt(pi) sigma)`, rounded to steps s. Rows are copies where
    more of the repeats agree in all values than the binomial distribution explains. So an equal
    height says nothing if the step is coarse, unless most heights of the file are equal.

    member : (r,) equal for rows of one pose. values : (r, c) [SI], NaN where absent. sd : (c,)
        [SI]. degrees : how many of the c values are independent.
    """
    result, sizes = np.full(len(member), -1), np.bincount(member)
    rows = np.flatnonzero(sizes[member] > 1)
    step, filled = find_steps(values) / sd, np.nan_to_num(values / sd, nan=MISSING)
    repeats, pairs = int((sizes - 1).clip(0).sum()), float((sizes * (sizes - 1.0) / 2.0).sum())
    for level in LEVELS:
        if not len(rows):
            break
        sorting = np.argsort(filled[rows], axis=0, kind="stable")
        label = _divide(filled[rows], np.full(len(sd), level), member[rows], sorting)
        _, first, group = np.unique(label, return_index=True, return_inverse=True)
        original, agreeing = rows[first[group.reshape(-1)]], len(rows) - len(first)
        single = OVERSTATED * (2.0 * np.floor(level / step) + 1.0) * step / (2.0 * np.sqrt(np.pi))
        single = np.sort(np.minimum(np.nan_to_num(single, nan=1.0), 1.0))
        chance = min(pairs / repeats * float(np.prod(single[-degrees:])), 1.0)
        if agreeing and binomial_tail(agreeing - 1, repeats, chance) < CHANCE:
            result[rows] = np.where(original < rows, original, -1)
            break
        rows = rows[np.bincount(label)[label] > 1]  # the others agree at no smaller level
    return result


def find_steps(values: FloatArray) -> FloatArray:
    """Return the step (c,) to which the values (r, c) of each column are rounded: the largest of
    which all are multiples, `FULL_DIGITS` where there is none; infinite for columns of zeros.
    """
    numbers, steps = np.nan_to_num(values), np.full(values.shape[1], FULL_DIGITS)
    for unit in SMALLEST_STEPS:
        counts = np.rint(numbers / unit)
        is_multiple = (np.abs(numbers / unit - counts) < ROUNDED).all(axis=0)
        step = unit * np.gcd.reduce(counts.astype(np.int64), axis=0, initial=0)
        steps = np.where(is_multiple, np.maximum(steps, step), steps)
    return np.where(numbers.any(axis=0), steps, np.inf)
