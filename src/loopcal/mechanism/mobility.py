# SPDX-License-Identifier: Apache-2.0
"""Can the actuators move and hold the platform? Told in words where they cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import engine
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.coordinates import COORDINATES, compare_coordinates, read_coordinates
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import stack_platform_rows
from loopcal.mechanism.states import driven_values
from loopcal.typing import FloatArray

RANK = 1e-9
"""Relative size below which a singular value at home counts as zero; real margins are above 1e-4,
rounding below 1e-13.
"""

MOTIONS = {
    "rx": "turn about x",
    "ry": "turn about y",
    "rz": "turn about z",
    "x": "shift along x",
    "y": "shift along y",
    "z": "shift along z",
}


def check_mobility(robot: Mechanism) -> Mechanism:
    """The robot, or MechanismError naming the freedoms that are too many or too few at home."""
    program, home = robot.program, robot.home_state
    e = robot.slots(robot.values[None])[0]
    q = driven_values(program, home)
    blocks = engine.linearize(program, e, q, home)
    scale = np.array([1 / robot.size if f < 3 else 1.0 for f in program.freedoms])
    A = stack_platform_rows(blocks)[0, 0] * scale
    _, s, V = np.linalg.svd(A, full_matrices=True)
    m = len(program.freedoms)
    rank = int((s > RANK * max(s[0], 1e-300)).sum()) if len(s) else 0
    if rank < m:
        raise MechanismError(
            f"{robot.name}: with every actuator held the platform can still move at home: "
            f"{_motion(program.freedoms, V[rank])}; its {len(A)} closure equations hold {rank} of "
            f"{m} freedoms; "
            "add a limb or actuator, or state fewer freedoms"
        )
    Q = _drives(robot, blocks)
    _, both, W = np.linalg.svd(np.concatenate([A, Q], axis=1), full_matrices=True)
    # freedoms with every actuator free: solutions (y, dq) of A y + Q dq = 0, A of full column rank
    independent = int((both > RANK * both[0]).sum())
    moves = W[independent:, :m]
    movable, a = len(moves), program.n_joints
    if movable < min(a, m):
        held = np.linalg.svd(moves, full_matrices=True)[2][movable:] if movable else np.eye(m)
        raise MechanismError(
            f"{robot.name}: {a} actuators, but the limbs leave the platform only {movable} of {m} "
            "freedoms at home; it cannot "
            f"{', nor '.join(_motion(program.freedoms, y) for y in held)}; the machine is "
            "over-constrained: remove a "
            "constraint or make a joint passive"
        )
    if len(robot.controlled) != movable:
        raise MechanismError(
            f"{robot.name} can be moved in {movable} freedoms, but {len(robot.controlled)} "
            "controlled coordinates are named "
            f"({', '.join(robot.controlled)}); name {movable}"
        )
    if len(A) > independent:
        robot = replace(
            robot, notes=(*robot.notes, _repeated(program.freedoms, len(A) - independent, moves))
        )
    return _commandable(robot, movable, scale[:, None] * np.linalg.lstsq(A, -Q, rcond=None)[0])


def _repeated(freedoms: tuple[int, ...], count: int, moves: FloatArray) -> str:
    """What is said of closure equations that repeat others; moves (f, m): what the platform can do
    with free actuators.
    """
    used = [
        AXES[f]
        for f, part in zip(freedoms, np.abs(moves).max(axis=0), strict=True)
        if part > RANK * np.abs(moves).max()
    ]
    what = "equations repeat" if count > 1 else "equation repeats"
    told = f"{count} closure {what} others: it closes only for exact geometry"
    return (
        f"{told}; state freedoms: [{', '.join(used)}] to leave them out"
        if len(used) == len(moves)
        else told
    )


def _drives(robot: Mechanism, blocks: engine.ClosureBlocks) -> FloatArray:
    """Closure rows of the home position against the actuated joints (c, a)."""
    parts = []
    for group, block in zip(robot.program.groups, blocks.closure, strict=True):
        for k in range(len(group.limbs)):
            Q = np.zeros((block.Q.shape[3], robot.program.n_joints))
            for j, columns in enumerate(group.actuator):
                if columns[0] >= 0:
                    Q[:, columns[k]] = block.Q[0, 0, k, :, j]
            parts.append(Q)
    return np.concatenate(parts)


def _commandable(robot: Mechanism, movable: int, D: FloatArray) -> Mechanism:
    """Refuse controlled coordinates that the machine has no way of choosing; D (m, a): freedoms per
    actuated joint.
    """
    target = read_coordinates(robot.home[None], robot.controlled)
    _, columns = compare_coordinates(robot.home[None], target, robot.controlled, robot.size)
    s = np.linalg.svd(columns[0][:, list(robot.program.freedoms)] @ D, compute_uv=False)
    if (s > RANK * s.max(initial=1e-300)).sum() < movable:
        raise MechanismError(
            f"{robot.name}: the coordinates {', '.join(robot.controlled)} cannot all be chosen "
            "freely at home; "
            f"name {movable} that the actuators move independently, of "
            f"{', '.join(COORDINATES)}"
        )
    return robot


def refuse_uncontrolled(robot: Mechanism, state: engine.State) -> None:
    """Refuse coordinates that do not determine the platform where its limbs let it move, judged at
    a state (1, 1).
    """
    program = robot.program
    e, q = robot.slots(robot.values[None])[0], driven_values(program, state)
    rows = stack_platform_rows(engine.linearize(program, e, q, state, free=True))[0, 0]
    T = state.T[0]
    _, columns = compare_coordinates(
        T, read_coordinates(T, robot.controlled), robot.controlled, robot.size
    )
    scale = np.array([1 / robot.size if f < 3 else 1.0 for f in program.freedoms])
    s = np.linalg.svd(
        np.concatenate([rows, columns[0][:, list(program.freedoms)]]) * scale, compute_uv=False
    )
    if len(s) < len(scale) or (s <= RANK * s[0]).any():
        raise MechanismError(
            f"{robot.name}: the coordinates {', '.join(robot.controlled)} cannot all be chosen "
            "freely at home; "
            f"name {len(robot.controlled)} that the actuators move independently, of "
            f"{', '.join(COORDINATES)}"
        )


def find_idle_joints(program: engine.Program, guess: engine.State) -> dict[int, tuple[int, ...]]:
    """One joint of a limb for each way it can move while tip and platform stand still (the spin of
    an S-P-S leg).

    The passive twists of a limb are ranked by the singular values of their triangular factor at
    joint values off any special position; of the joints in a null combination the one that takes
    the largest part is chosen. Every limb is judged by its own geometry, whatever other limbs have
    the same joints and wherever it stands among them.

    Returns
    -------
    The joints to hold of each limb that has any.
    """
    # the same shake in every limb: what is held must not depend on the order of the limbs
    shakes = [np.random.default_rng(0).uniform(-0.3, 0.3, j.shape[-1]) for j in guess.joints]
    shaken = replace(
        guess, joints=tuple(j + shake for j, shake in zip(guess.joints, shakes, strict=True))
    )
    # driven joints as shaken too: a slide at zero would take a leg's lower joint for one that only
    # spins it
    e, q = np.zeros((1, program.n_displacements)), driven_values(program, shaken)
    blocks = engine.linearize(program, e, q, shaken)
    held = {}
    for group, block, joints in zip(program.groups, blocks.passive, blocks.joints, strict=True):
        for k, limb in enumerate(group.limbs):
            chosen = _dependent(block.U[0, 0, k]) if joints else []
            if chosen:
                held[limb] = tuple(joints[c] for c in chosen)
    return held


def _dependent(U: FloatArray) -> list[int]:
    """Columns to leave out so that the others are independent, one for each null direction."""
    chosen: list[int] = []
    while True:
        rest = [c for c in range(U.shape[1]) if c not in chosen]
        _, s, V = np.linalg.svd(U[:, rest])
        rank = int((s > RANK * s.max(initial=1e-300)).sum())
        if rank == len(rest):
            return chosen
        part = np.abs(V[-1])
        chosen.append(
            rest[int(np.argmax(part > (1 - 1e-6) * part.max()))]
        )  # of equal parts the first, whatever rounding says


def _motion(freedoms: tuple[int, ...], direction: FloatArray) -> str:
    """A twist in words: its largest components first."""
    order = [
        i
        for i in np.argsort(-np.abs(direction))
        if abs(direction[i]) > 0.3 * np.abs(direction).max()
    ]
    return " with ".join(MOTIONS[AXES[freedoms[i]]] for i in order)
