# SPDX-License-Identifier: Apache-2.0
"""Values of joints by name, driven or passive, for the kinds that look at them."""

from collections.abc import Iterable

from loopcal.engine import State
from loopcal.errors import DataError, suggest_names
from loopcal.measure.kinds import Kind
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray


def list_sensed_joints(kinds: Iterable[Kind]) -> tuple[str, ...]:
    """Names of all joints that kinds look at, each once."""
    return tuple(dict.fromkeys(name for kind in kinds for name in kind.sensed_joints))


def select_joint_values(
    robot: Mechanism, names: Iterable[str], readings: FloatArray, state: State
) -> dict[str, FloatArray]:
    """Values of joints.

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
        If a joint is not there.
    """
    actuators = [actuator.name for actuator in robot.actuators]
    passive = _passive(robot)
    found = {}
    for name in names:
        if name in actuators:
            found[name] = readings[..., actuators.index(name)]
        elif name in passive:
            group, limb, joint = passive[name]
            found[name] = state.joints[group][:, :, limb, joint]
        else:
            known = [*actuators, *passive]
            raise DataError(
                f"{robot.name!r} has no joint {name!r}{suggest_names(name, known)}; those a sensor can "
                f"look at are {', '.join(known)}"
            )
    return found


def _passive(robot: Mechanism) -> dict[str, tuple[int, int, int]]:
    """Passive joints by name: their group, their place among its limbs, and along the limb."""
    limbs = robot.assembly.limbs
    return {
        f"{limbs[limb].name}.{joint.name}": (g, k, j)
        for g, group in enumerate(robot.program.groups)
        for k, limb in enumerate(group.limbs)
        for j, joint in enumerate(limbs[limb].joints)
        if joint.actuator is None
    }
