# SPDX-License-Identifier: Apache-2.0
"""Mechanisms as the engine receives them, and their closure written independently, one limb at a
time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.engine import (
    LENGTH,
    PITCH,
    Block,
    Engine,
    Group,
    MapPattern,
    ParameterMap,
    Program,
    State,
    Sums,
    TwistRows,
)
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.model import Mechanism

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A program with displacements e (t, ..), joint values q (t, n, a) near home, and home as the
    start.
    """

    name: str
    program: Program
    e: Array
    q: Array
    home: State

    @property
    def home_q(self) -> Array:
        """Joint values (1, 1, a) at home."""
        return actuated_joint_values(self.program, self.home)


def make_case(robot: Mechanism, t: int = 1, n: int = 5, seed: int = 1) -> Case:
    """Draw displacements of about 1e-3 and joint values within 0.03 to 0.05 of home, in sizes."""
    rng, p = np.random.default_rng(seed), robot.program
    e = rng.normal(size=(t, p.n_displacements)) * 1e-3 * displacement_units(p)
    if p.freedoms == (2, 3, 4):
        # closure of orientation is asked for about z alone; what tilts out of the plane bends its
        # column by tilt^2 / 12
        e *= np.concatenate(
            [np.tile([s.axis not in (0, 1) for s in g.slots], len(g.limbs)) for g in p.groups]
        )
    steps = [0.03 * p.size if a.dimension.value == "length" else 0.05 for a in robot.assembly.rows]
    # sums of more lengths than there are readings, or coupled joints
    is_by_joint = robot.has_open_sums or bool(robot.assembly.couplings)
    step = np.array([0.03 * p.size] * p.n_joints if is_by_joint else steps)
    q = actuated_joint_values(p, robot.home_state) + rng.uniform(-1, 1, (t, n, p.n_joints)) * step
    return Case(robot.name, p, e, q, robot.home_state)


def draw_sums(case: Case) -> Sums:
    """Draw weights of as many sums as driven joints, and the sums of the case's joint values."""
    t, J = len(case.q), case.program.n_joints
    weights = np.eye(J) + 0.2 * np.random.default_rng(3).normal(size=(t, J, J))
    return Sums(weights, np.matmul(case.q, weights.swapaxes(1, 2)))


def actuated_joint_values(program: Program, state: State) -> Array:
    """Values of the actuated joints (t, n, a)."""
    q = np.zeros((*state.T.shape[:2], program.n_joints))
    for group, joints in zip(program.groups, state.joints, strict=True):
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                q[..., columns] = joints[..., j]
    return q


def displacement_units(program: Program) -> Array:
    """Return the unit of each displacement: a radian, or the size of the robot [m]."""
    unit = np.ones(program.n_displacements)
    for group in program.groups:
        own = [1.0 if s.axis < 3 else program.size for s in group.slots]
        unit[group.columns] = np.tile(own, len(group.limbs))
    return unit


def unknown_joint_values(program: Program, state: State, free: bool = False) -> Array:
    """Joints that closure determines (t, n, u): group by group, limb by limb."""
    parts = [
        joints[..., group.unknown_joints(free)].reshape(*state.T.shape[:2], -1)
        for group, joints in zip(program.groups, state.joints, strict=True)
    ]
    return np.concatenate(parts, axis=-1)


def measure_motion(program: Program, state: State, of: State, free: bool = False) -> Array:
    """Change (t, n, m + u) of the platform (as a twist, its freedoms only) and of the unknown
    joints since `of`.
    """
    twist = geometry.pose_difference(state.T, np.broadcast_to(of.T, state.T.shape))[
        ..., list(program.freedoms)
    ]
    return np.concatenate(
        [
            twist,
            unknown_joint_values(program, state, free) - unknown_joint_values(program, of, free),
        ],
        axis=-1,
    )


def pose_demand(
    target: Array, size: float
) -> Callable[[Array, NDArray[np.int64]], tuple[Array, Array]]:
    """Return the task of reaching poses (N, 4, 4) with all six freedoms."""

    def task(T: Array, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        gap = geometry.pose_difference(T, target[rows])
        columns = np.zeros((len(rows), 6, 6))
        columns[:, :3, :3] = geometry.left_jacobian_inverse_so3(gap[:, :3])
        columns[:, 3:, 3:] = np.eye(3)
        scale = np.array([size] * 3 + [1.0] * 3)
        return gap * scale, columns * scale[:, None]

    return task


# --- independent closure for numpy or jax, one row and one limb at a time
# ---------------------------------------------


_HAT = np.zeros((3, 3, 3))
_HAT[[0, 1, 2], [2, 0, 1], [1, 2, 0]], _HAT[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0, -1.0


def rotation(xp: ModuleType, w: Any) -> Any:
    """exp(hat(w)) for (..., 3), safe for differentiation at zero."""
    t2 = (w * w).sum(-1)[..., None, None]
    small = t2 < 1e-16
    t = xp.sqrt(xp.where(small, 1.0, t2))
    a = xp.where(small, 1.0 - t2 / 6, xp.sin(t) / t)
    b = xp.where(small, 0.5, (1 - xp.cos(t)) / (t * t))
    K = xp.einsum("ijl,...l->...ij", _HAT, w)
    return xp.eye(3) + a * K + b * (K @ K)


def homogeneous(xp: ModuleType, R: Any, t: Any) -> Any:
    """(..., 4, 4) of rotations and positions."""
    last = xp.broadcast_to(xp.array([0.0, 0.0, 0.0, 1.0]), (*t.shape[:-1], 1, 4))
    return xp.concatenate([xp.concatenate([R, t[..., None]], axis=-1), last], axis=-2)


def limb_residual(
    xp: ModuleType, group: Group, k: int, size: float, T: Any, theta: Any, own: Any
) -> Any:
    """Closure residual of limb k: T (4, 4), joint values theta (J + 1,), the limb's own
    displacements.
    """
    count = len(group.joints)
    place, pitch_of, length_of = (
        np.zeros((count + 2, 6, len(own))),
        np.zeros((count, len(own))),
        np.zeros(len(own)),
    )
    for s, slot in enumerate(group.slots):
        if slot.axis == PITCH:
            pitch_of[slot.element, s] = 1.0
        elif slot.axis == LENGTH:
            length_of[s] = 1.0
        else:
            place[slot.element, slot.axis, s] = 1.0
    move = place @ own
    shifted = homogeneous(xp, xp.broadcast_to(xp.eye(3), (count + 2, 3, 3)), move[:, 3:])
    turned = homogeneous(xp, rotation(xp, move[:, :3]), xp.zeros((count + 2, 3)))
    placed = group.links[k] @ shifted @ turned
    tip, z = placed[0], np.array([0.0, 0.0, 1.0])
    if count:
        turns = np.array([letter == "R" for letter in group.joints])
        advance = theta[:count] * xp.where(turns, group.pitch[k] + pitch_of @ own, 1.0)
        moved = homogeneous(
            xp, rotation(xp, (theta[:count] * turns)[:, None] * z), advance[:, None] * z
        )
        for j in range(count):
            tip = tip @ moved[j] @ placed[j + 1]
    end = T @ placed[-1]
    gap = end[:3, 3] - tip[:3, 3]
    if group.ending == "distance":
        return (xp.sqrt(gap @ gap) - group.length[k] - theta[count] - length_of @ own)[None]
    if group.ending == "ball":
        return gap[np.array(group.rows)]
    turn = end[:3, :3] @ tip[:3, :3].T
    skew = 0.5 * xp.einsum("ijl,ij->l", _HAT, turn)
    return xp.concatenate([size * skew, gap])[np.array(group.rows)]


def closure_gap(program: Program, state: State, e: Array) -> Array:
    """Return the norm of the independent closure residual (t, n) [m]."""
    t, n = state.T.shape[:2]
    out = np.zeros((t, n))
    for group, joints in zip(program.groups, state.joints, strict=True):
        for k in range(len(group.limbs)):
            for i, r in np.ndindex(t, n):
                own = e[min(i, len(e) - 1), group.columns].reshape(len(group.limbs), -1)[k]
                rows = limb_residual(
                    np, group, k, program.size, state.T[i, r], joints[i, r, k], own
                )
                out[i, r] = np.hypot(out[i, r], np.linalg.norm(rows))
    return out


# --- blocks of `linearize`, solved row by row
# -----------------------------------------------------------


def stack_dense_rows(program: Program, parts: tuple[Block, ...]) -> tuple[Array, Array, Array]:
    """Rows of all limbs, one after the other, against freedoms, displacements and joint values: (t,
    n, c, m | s | a).
    """
    A, E, Q = [], [], []
    for group, block in zip(program.groups, parts, strict=True):
        own = np.arange(program.n_displacements)[group.columns].reshape(len(group.limbs), -1)
        for k in range(len(group.limbs)):
            t, n, _, r = block.A.shape[:4]
            slots, drives = (
                np.zeros((t, n, r, program.n_displacements)),
                np.zeros((t, n, r, program.n_joints)),
            )
            slots[..., own[k]] = block.E[:, :, k]
            for j, columns in enumerate(group.actuator):
                if columns[0] >= 0:
                    drives[..., columns[k]] = block.Q[:, :, k, :, j]
            A.append(block.A[:, :, k])
            E.append(slots)
            Q.append(drives)
    return np.concatenate(A, axis=2), np.concatenate(E, axis=2), np.concatenate(Q, axis=2)


def dense_derivatives(program: Program, blocks: Any, free: bool = False) -> Array:
    """d (platform, unknown joints) / d (displacements, joint values): (t, n, m + u, s + a).

    With `free`, / d (platform, displacements): (t, n, m + u, m + s).
    """
    A, E, Q = stack_dense_rows(program, blocks.closure)
    m = len(program.freedoms)
    right = np.concatenate([E, Q], axis=-1)
    if free:
        platform = np.broadcast_to(np.eye(m, m + E.shape[-1]), (*A.shape[:2], m, m + E.shape[-1]))
    else:
        platform = -np.linalg.pinv(A) @ right
    parts = [platform]
    for group, block in zip(program.groups, blocks.passive, strict=True):
        own = np.arange(program.n_displacements)[group.columns].reshape(len(group.limbs), -1)
        for k in range(len(group.limbs)):
            U, E_k = (
                block.U[:, :, k],
                np.zeros((*block.U.shape[:2], block.U.shape[3], program.n_displacements)),
            )
            E_k[..., own[k]] = block.E[:, :, k]
            Q_k = np.zeros((*U.shape[:3], program.n_joints))
            for j, columns in enumerate(group.actuator):
                if columns[0] >= 0:
                    Q_k[..., columns[k]] = block.Q[:, :, k, :, j]
            own_rows = np.concatenate(
                [np.zeros((*U.shape[:3], m)), E_k] if free else [E_k, Q_k], axis=-1
            )
            rows = block.A[:, :, k] @ platform + own_rows
            parts.append(-np.linalg.solve(U, rows))
    return np.concatenate(parts, axis=2)


# --- maps of parameters ---------------------------------------------------------------------------


def draw_map(program: Program, shape: tuple[int, int], per_trial: bool) -> ParameterMap:
    """Draw the derivatives of displacements and joint values by parameters for (t, n) rows.

    One parameter for each displacement in another order, two that move many, some of them twice,
    and three functions of the pose for each joint. Without `per_trial` trials and poses share what
    they can.
    """
    rng, (t, n) = np.random.default_rng(program.n_displacements), shape
    s, a = program.n_displacements, program.n_joints
    many = np.arange(0, s, 2)
    places = np.concatenate([np.arange(s), many, many[::3]])
    parameters = np.concatenate([rng.permutation(s), np.full(len(many), s), many[::3] * 0 + s + 1])
    joint, function = (grid.ravel() for grid in np.mgrid[:a, :3])
    parameter = np.where(function == 0, s + 2, np.where(function == 1, s + 1, s + 3 + joint))
    pattern = MapPattern(
        s + 3 + a,
        np.column_stack([places, parameters]),
        np.column_stack([joint, function, parameter]),
    )
    first, rows = (t, (t, n)) if per_trial else (1, (1, 1))
    return ParameterMap(
        pattern,
        rng.normal(size=(first, len(places))),
        rng.normal(size=(first, len(joint))),
        rng.normal(size=(*rows, a, 3)),
        rng.uniform(0.5, 2.0, (*rows, a)),
    )


def spread_map(
    program: Program, inputs: ParameterMap, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Return de/dp (t, n, s, p) and dq/dp (t, n, a, p) of a map."""
    p, (t, n) = inputs.pattern.parameters, shape
    of_e, of_q = np.zeros((t, n, program.n_displacements, p)), np.zeros((t, n, program.n_joints, p))
    for z, (place, parameter) in enumerate(inputs.pattern.displacements):
        of_e[..., place, parameter] += inputs.displacements[:, None, z]
    for y, (joint, function, parameter) in enumerate(inputs.pattern.joints):
        change = inputs.basis[..., joint, function] * inputs.joints[:, None, y]
        of_q[..., joint, parameter] += change
    return of_e, of_q


# --- rows of poses
# -----------------------------------------------------------

PoseRows = tuple[Program, Array, Array, State, ParameterMap, list[TwistRows]]
"""The arguments of `fold_poses` behind the factor."""


def draw_twist_rows(t: int, n: int) -> list[TwistRows]:
    """Draw rows of two kinds: six of every pose, whose derivatives trials share, and one of some
    poses, in descending order.
    """
    rng, some = np.random.default_rng(n), np.arange(n)[::-2]
    return [
        TwistRows(
            poses, rng.normal(size=(first, len(poses), m, 6)), rng.normal(size=(t, len(poses), m))
        )
        for poses, m, first in ((np.arange(n), 6, 1), (some, 1, t))
    ]


def make_pose_rows(engine: Engine, name: str, t: int, n: int, per_trial: bool = True) -> PoseRows:
    """Return rows of a shipped robot at solved poses."""
    case = make_case(load_robot(name), t=t, n=n)
    state = engine.solve(case.program, case.e, case.q, case.home)
    inputs = draw_map(case.program, (t, n), per_trial)
    return case.program, case.e, case.q, state, inputs, draw_twist_rows(t, n)


def take_pose_rows(arguments: PoseRows, trials: NDArray[np.int64]) -> PoseRows:
    """Return the rows of some trials."""
    program, e, q, state, inputs, observed = arguments

    def take(a: Array) -> Array:
        return a if len(a) == 1 else a[trials]

    names = ("displacements", "joints", "basis", "readings")
    own = replace(inputs, **{name: take(getattr(inputs, name)) for name in names})
    rows = [replace(o, by_twist=take(o.by_twist), residual=o.residual[trials]) for o in observed]
    joints, others = (tuple(a[trials] for a in arrays) for arrays in (state.joints, state.others))
    moved = replace(state, T=state.T[trials], joints=joints, others=others)
    return program, e[trials], q[trials], moved, own, rows
