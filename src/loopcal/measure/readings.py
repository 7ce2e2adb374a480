# SPDX-License-Identifier: Apache-2.0
"""Actuator readings of commanded poses, and values of joints that kinds sense."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from loopcal.engine import State
from loopcal.errors import DataError, suggest_names
from loopcal.measure.array_checks import broadcast_array, refuse_first
from loopcal.measure.kinds.kind import Kind
from loopcal.mechanism.chains import select_platform_entries
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.typing import FloatArray
from loopcal.units import SMALLEST_SD, Dimension

if TYPE_CHECKING:
    from loopcal.measure.kinds.joints import ActuatorReadings
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
    failed = np.flatnonzero(~solution.converged)
    if len(failed):
        first = int(failed[0])
        name = name_pose(first, labels, places)
        raise DataError(
            f"{controller.name!r} does not reach commanded pose {name} ({len(failed)} of "
            f"{len(solution.q)} fail): {solution.explain(first)}. Correct the pose, or the "
            "geometry of the controller"
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
    limbs = robot.assembly.limbs
    places = {
        f"{limbs[limb].name}.{joint.name}": (g, k, j)
        for g, group in enumerate(robot.program.groups)
        for k, limb in enumerate(group.limbs)
        for j, joint in enumerate(limbs[limb].joints)
    }
    passive = {f"{limb.name}.{joint.name}" for limb, joint in robot.assembly.passive_joints}
    passive = {name: place for name, place in places.items() if name in passive}
    entries = select_platform_entries(robot, state) if robot.stages else {}
    values = {}
    for name in names:
        if name in actuators:
            values[name] = readings[..., actuators.index(name)]
        elif name in passive:
            group, limb, joint = passive[name]
            values[name] = state.joints[group][:, :, limb, joint]
        elif name in entries:
            values[name] = entries[name]
        elif ":" in name:
            stage, stages = name.partition(":")[0], [stage.name for stage in robot.stages]
            raise DataError(
                f"{robot.name!r} has no stage {stage!r}{suggest_names(stage, stages)}; "
                f"{'its stages are ' + ', '.join(stages) if stages else 'it is not a chain'}"
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
    from loopcal.measure.kinds.joints import ActuatorReadings

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
    if robot.program.sigma is not None and np.any(given == 0.0):
        exact = robot.actuators[int(np.argwhere(given == 0.0)[0, 1])].name
        raise DataError(
            f"the data declare exact readings of {exact}, but {robot.name!r} has "
            f"{len(robot.actuators)} actuators for {len(robot.freedoms)} degrees of freedom. "
            "Readings of redundant actuators cannot be exact. Give each a sigma above 0, a "
            "small one for very good encoders"
        )
    return given if np.any(given != 0.0) else None


def fill_in_reading_sigma(robot: Mechanism, data: Measurements) -> Measurements:
    """Return measurements that contain the standard deviations that the robot states; the same
    object where all readings are exact.
    """
    sigma = resolve_reading_sigma(robot, data.reading_sigma, data.n_poses)
    is_same = sigma is None or sigma is data.reading_sigma
    return data if is_same else replace(data, reading_sigma=sigma)
