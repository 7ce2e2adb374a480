# SPDX-License-Identifier: Apache-2.0
"""Actuator readings: from commanded poses, their standard deviations, and values of joints.

A reading may be exact or uncertain. An uncertain reading is a measurement of the true one, by the
kind `ActuatorReadings`.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal.engine import State
from loopcal.errors import DataError, suggest_names
from loopcal.measure.kinds import ActuatorReadings, Kind
from loopcal.measure.measurements import Measurements
from loopcal.mechanism import Mechanism, Solution, inverse
from loopcal.typing import FloatArray
from loopcal.units import Dimension

LARGEST_SIGMA = 1e6
"""Largest finite sigma of a reading, in sizes of the robot or radians."""


# --- commanded poses


def solve_commanded_readings(
    controller: Mechanism, commanded: ArrayLike, labels: tuple[str, ...] = ()
) -> FloatArray:
    """Return the actuator readings that a controller computes for commanded poses.

    Parameters
    ----------
    controller : Mechanism
        The geometry that the controller uses, usually the nominal robot.
    commanded : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI]
    labels : tuple of str, optional
        Names of the poses for messages; default "1", "2", ...

    Returns
    -------
    readings : (n, a) [SI]

    Raises
    ------
    DataError
        If the controller's geometry does not reach a pose.
    """
    return solve_commanded_poses(controller, commanded, labels).q


def solve_commanded_poses(
    controller: Mechanism, commanded: ArrayLike, labels: tuple[str, ...] = ()
) -> Solution:
    """Return readings, poses and passive joints for commanded poses, see
    `solve_commanded_readings`.
    """
    solution = inverse(controller, commanded)
    failed = np.flatnonzero(~solution.converged)
    if len(failed):
        first = int(failed[0])
        name = labels[first] if labels else str(first + 1)
        raise DataError(
            f"{controller.name!r} does not reach commanded pose {name!r} ({len(failed)} of "
            f"{len(solution.q)} fail): {solution.explain(first)}; correct the pose, or the "
            "geometry of the controller"
        )
    return solution


# --- values of joints


def list_sensed_joints(kinds: Iterable[Kind]) -> tuple[str, ...]:
    """Return the names of all joints that kinds sense, each once."""
    return tuple(dict.fromkeys(name for kind in kinds for name in kind.sensed_joints))


def select_joint_values(
    robot: Mechanism, names: Iterable[str], readings: FloatArray, state: State
) -> dict[str, FloatArray]:
    """Return values of joints by name.

    Parameters
    ----------
    robot : Mechanism
    names : of actuators, whose value is their reading, or of passive joints as `limb.joint`.
    readings : (t or 1, n, a) [SI]
    state : of t trials and n poses

    Returns
    -------
    values : name -> (t or 1, n) [SI]

    Raises
    ------
    DataError
        If the robot does not have a joint.
    """
    actuators = [actuator.name for actuator in robot.actuators]
    passive = _index_passive_joints(robot)
    values = {}
    for name in names:
        if name in actuators:
            values[name] = readings[..., actuators.index(name)]
        elif name in passive:
            group, limb, joint = passive[name]
            values[name] = state.joints[group][:, :, limb, joint]
        else:
            known = [*actuators, *passive]
            raise DataError(
                f"{robot.name!r} has no joint {name!r}{suggest_names(name, known)}; joints for a "
                f"sensor are {', '.join(known)}"
            )
    return values


def _index_passive_joints(robot: Mechanism) -> dict[str, tuple[int, int, int]]:
    """Return the indices of passive joints by name: group, limb in the group, joint in the limb."""
    limbs = robot.assembly.limbs
    return {
        f"{limbs[limb].name}.{joint.name}": (g, k, j)
        for g, group in enumerate(robot.program.groups)
        for k, limb in enumerate(group.limbs)
        for j, joint in enumerate(limbs[limb].joints)
        if joint.actuator is None
    }


# --- uncertain readings


def make_readings_kind(robot: Mechanism) -> ActuatorReadings:
    """Return the kind of a robot's readings."""
    return ActuatorReadings({actuator.name: actuator.dimension for actuator in robot.actuators})


def resolve_reading_sigma(robot: Mechanism, given: FloatArray | None, n: int) -> FloatArray | None:
    """Return the standard deviations (n, a) [SI] of readings, or None where all are exact.

    Given ones win over those that the robot states.

    Parameters
    ----------
    given : (n, a) or None, as in `Measurements.reading_sigma`.

    Raises
    ------
    DataError
        If a sigma is negative, not a number, or finite but too large to mean anything; or if a
        reading of a robot with redundant actuators is exact. The poses of such a robot are free
        and readings follow from them, so that no reading can be kept; see
        docs/theory/uncertain-readings.md.
    """
    stated = [actuator.sigma for actuator in robot.actuators]
    if given is None:
        if not any(stated):
            return None
        given = np.tile([sigma or 0.0 for sigma in stated], (n, 1))
    _check_sigma(robot, given)
    if robot.program.sigma is not None and np.any(given == 0.0):
        name = robot.actuators[int(np.argwhere(given == 0.0)[0, 1])].name
        raise DataError(
            f"the readings of {name} are stated to be exact, but {robot.name!r} has {len(stated)} "
            f"actuators for {len(robot.freedoms)} degrees of freedom; readings of redundant "
            "actuators cannot be exact: state a sigma above 0 for each, a small one for very good "
            "encoders"
        )
    return given if np.any(given != 0.0) else None


def fill_in_reading_sigma(robot: Mechanism, data: Measurements) -> Measurements:
    """Return measurements that contain the standard deviations that the robot states.

    It is the same object where all readings are exact.
    """
    sigma = resolve_reading_sigma(robot, data.reading_sigma, data.n_poses)
    return (
        data if sigma is None or sigma is data.reading_sigma else replace(data, reading_sigma=sigma)
    )


def _check_sigma(robot: Mechanism, sigma: FloatArray) -> None:
    """Refuse standard deviations (n, a) that are negative or too large, naming the actuator."""
    size = np.array(
        [
            robot.size if actuator.dimension is Dimension.LENGTH else 1.0
            for actuator in robot.actuators
        ]
    )
    for wrong, what in (
        (
            ~(sigma >= 0.0),
            "is not a standard deviation; give 0 (exact), a positive number, or infinity (missing)",
        ),
        (
            np.isfinite(sigma) & (sigma / size > LARGEST_SIGMA),
            "is larger than any possible error of a reading; give inf (missing) instead",
        ),
    ):
        if np.any(wrong):
            pose, column = (int(i) for i in np.argwhere(wrong)[0])
            actuator = robot.actuators[column]
            shown = robot.get_unit(actuator.dimension)
            value = f"{sigma[pose, column] / shown.factor_to_si:.6g} {shown.symbol}"
            raise DataError(
                f"the sigma {value} of the reading of {actuator.name} in row {pose + 1} {what}"
            )
