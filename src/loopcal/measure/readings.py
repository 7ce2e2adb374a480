# SPDX-License-Identifier: Apache-2.0
"""Actuator readings of commanded poses, and values of joints that kinds sense."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from loopcal import mechanism
from loopcal.engine import State
from loopcal.errors import DataError, suggest_names
from loopcal.measure.kinds import Kind
from loopcal.mechanism import Mechanism, Solution, inverse
from loopcal.typing import FloatArray

if TYPE_CHECKING:
    from loopcal.measure.kinds import ActuatorReadings

# --- commanded poses


def solve_commanded_poses(
    controller: Mechanism,
    commanded: ArrayLike,
    labels: Sequence[str] = (),
    places: Sequence[str] = (),
) -> Solution:
    """Return readings, poses and passive joints that a controller computes for commanded poses.

    Parameters
    ----------
    controller : Mechanism
        The geometry that the controller uses, usually the nominal robot.
    commanded : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI]
    labels, places : sequence of str, optional
        Names of the poses, and their places such as `poses.csv:12`, for messages; see `name_pose`.

    Raises
    ------
    DataError
        If the controller's geometry does not reach a pose, or there is another number of names.
    """
    solution = inverse(controller, commanded)
    if labels and len(labels) != len(solution):
        raise DataError(f"{len(labels)} names are given for {len(solution)} poses; name each pose")
    failed = np.flatnonzero(~solution.converged)
    if len(failed):
        first = int(failed[0])
        name = name_pose(first, labels, places)
        raise DataError(
            f"{controller.name!r} does not reach commanded pose {name} ({len(failed)} of "
            f"{len(solution.q)} fail): {solution.explain(first)}; correct the pose, or the "
            "geometry of the controller"
        )
    return solution


def name_pose(index: int, labels: Sequence[str] = (), places: Sequence[str] = ()) -> str:
    """Return how a message names a pose: `'p3' at poses.csv:12`; "1", "2", ... without labels."""
    label = repr(labels[index] if labels else str(index + 1))
    return f"{label} at {places[index]}" if places else label


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
    entries = mechanism.select_platform_entries(robot, state) if robot.stages else {}
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


def _index_passive_joints(robot: Mechanism) -> dict[str, tuple[int, int, int]]:
    """Return the indices of passive joints by name: group, limb in the group, joint in the limb."""
    limbs = robot.assembly.limbs
    passive = {f"{limb.name}.{joint.name}" for limb, joint in robot.assembly.passive_joints}
    places = {
        f"{limbs[limb].name}.{joint.name}": (g, k, j)
        for g, group in enumerate(robot.program.groups)
        for k, limb in enumerate(group.limbs)
        for j, joint in enumerate(limbs[limb].joints)
    }
    return {name: place for name, place in places.items() if name in passive}


def make_readings_kind(robot: Mechanism) -> ActuatorReadings:
    """Return the kind of a robot's readings.

    An uncertain reading is a measurement of the true one, by this kind.
    """
    from loopcal.measure.kinds import ActuatorReadings

    return ActuatorReadings({actuator.name: actuator.dimension for actuator in robot.actuators})
