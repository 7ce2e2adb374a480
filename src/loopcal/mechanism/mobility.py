# SPDX-License-Identifier: Apache-2.0
"""Can the actuators move and hold the platform? Told in words where they cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import engine
from loopcal.engine import Array
from loopcal.errors import MechanismError
from loopcal.mechanism import coordinates
from loopcal.mechanism.assembly import AXES, Assembly, Limb
from loopcal.mechanism.model import Mechanism

RANK = 1e-9
"""Relative size below which a singular value at home counts as zero; real margins are above 1e-4, rounding below 1e-13."""

WORDS = {
    "rx": "turn about x",
    "ry": "turn about y",
    "rz": "turn about z",
    "x": "shift along x",
    "y": "shift along y",
    "z": "shift along z",
}


def checked(robot: Mechanism) -> Mechanism:
    """The robot, or MechanismError naming the freedoms that are too many or too few at home."""
    program, home = robot.program, robot.home_state
    e = robot.slots(robot.values[None])[0]
    q = _joint_values(robot)
    blocks = engine.linearise(program, e, q, home)
    scale = np.array([1 / robot.size if f < 3 else 1.0 for f in program.freedoms])
    A = blocks.A[0, 0] * scale
    _, s, V = np.linalg.svd(A, full_matrices=True)
    m = len(program.freedoms)
    rank = int((s > RANK * max(s[0], 1e-300)).sum()) if len(s) else 0
    if rank < m:
        raise MechanismError(
            f"{robot.name}: with every actuator held the platform can still move at home ({_motion(program.freedoms, V[rank])}); "
            f"its {len(A)} closure equations hold {rank} of {m} freedoms; add a limb or actuator, or state fewer freedoms"
        )
    movable = _mobility(robot, blocks, scale)
    a = program.n_joints
    if movable < min(a, m):
        raise MechanismError(
            f"{robot.name}: {a} actuators, but the limbs leave the platform only {movable} freedoms at home; "
            "the machine is over-constrained: remove a constraint or make a joint passive"
        )
    if len(robot.controlled) != movable:
        raise MechanismError(
            f"{robot.name} can be moved in {movable} freedoms, but {len(robot.controlled)} controlled coordinates are named "
            f"({', '.join(robot.controlled)}); name {movable}"
        )
    return _commandable(robot, movable)


def _mobility(robot: Mechanism, blocks: engine.Blocks, scale: Array) -> int:
    """Freedoms of the platform that the actuators reach: rank of d pose / d joint values."""
    m, a = len(robot.program.freedoms), robot.program.n_joints
    Q = np.zeros((blocks.A.shape[2], a))
    for group, part, rows in zip(robot.program.groups, blocks.Q, blocks.rows, strict=True):
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                for k, column in enumerate(columns):
                    Q[rows[k], column] = part[0, 0, k, :, j]
    D = np.linalg.lstsq(blocks.A[0, 0] * scale, Q, rcond=None)[0]
    s = np.linalg.svd(D, compute_uv=False)
    return int((s > RANK * max(s.max(initial=0.0), 1e-300)).sum()) if m else 0


def _commandable(robot: Mechanism, movable: int) -> Mechanism:
    """Refuse controlled coordinates that the machine has no way of choosing."""
    from loopcal.mechanism.trials import readings_at, sensitivity

    values = robot.values[None]
    D = sensitivity(robot, values, readings_at(robot, values, robot.home_state), robot.home_state).readings[0, 0]
    target = coordinates.read(robot.home[None], robot.controlled)
    _, columns = coordinates.demands(robot.home[None], target, robot.controlled, robot.size)
    s = np.linalg.svd(columns[0] @ D, compute_uv=False)
    if (s > RANK * s.max(initial=1e-300)).sum() < movable:
        raise MechanismError(
            f"{robot.name}: the coordinates {', '.join(robot.controlled)} cannot all be chosen freely at home; "
            f"name {movable} that the actuators move independently, of {', '.join(coordinates.NAMES)}"
        )
    return robot


def held_joints(assembly: Assembly, limb: Limb) -> tuple[bool, ...]:
    """Joints that only spin a limb about itself and keep their start value, (J + 1,): none where passive rank is full."""
    return (False,) * (len(limb.joints) + 1)


def _motion(freedoms: tuple[int, ...], direction: Array) -> str:
    """A twist in words: its largest components first."""
    order = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.3 * np.abs(direction).max()]
    return " with ".join(WORDS[AXES[freedoms[i]]] for i in order)


def _joint_values(robot: Mechanism) -> Array:
    out = np.zeros((1, 1, robot.program.n_joints))
    for group, joints in zip(robot.program.groups, robot.home_state.joints, strict=True):
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                out[..., columns] = joints[..., j]
    return out


__all__ = ["checked", "held_joints", "replace"]
