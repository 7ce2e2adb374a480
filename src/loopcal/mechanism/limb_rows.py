# SPDX-License-Identifier: Apache-2.0
"""Linearized closure limb by limb, in blocks that fit the cache, and frames along limbs.

A limb's rows are A y + E de + Q dq = 0 and, for its eliminated joints, U dtheta + A y + E de + Q dq
= 0; they contain only its displacements and driven joints. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import LENGTH, PITCH, Group, Program, State
from loopcal.mechanism.assembly import Joint
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission import invert_weights
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray, IntArray

BLOCK_ROWS = 1024  # rows linearized together
Placed = tuple[FloatArray, FloatArray]  # links and advances, as of `place_serial`


def name_passive_joints(robot: Mechanism) -> tuple[str, ...]:
    """Return the names `limb.joint` of all joints that no reading states, limb by limb."""
    return tuple(f"{limb.name}.{joint.name}" for limb, joint in robot.assembly.passive_joints)


def name_entries(body: str) -> tuple[str, ...]:
    """Return the names of the twelve numbers of the pose of a body, [R t] row by row."""
    return tuple(f"{body}:T{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))


class LimbRows(NamedTuple):
    """Rows U dtheta + A y + E de + Q dq = 0 of one limb, with its own columns only.

    limb : its number. joints : its eliminated joints. slots, drives : the places of its
    displacements in e, and of its driven joints in q.
    U : (t, n, r, u) against the eliminated joints. A : (t, n, r, M) against the freedoms of all
    nodes. E : (t, n, r, ..) against the displacements. Q : (t, n, r, ..) against driven joints.
    """

    limb: int
    joints: tuple[int, ...]
    slots: slice
    drives: IntArray
    U: FloatArray
    A: FloatArray
    E: FloatArray
    Q: FloatArray


def divide_limbs(
    program: Program, blocks: engine.ClosureBlocks, *, passive: bool = False
) -> Iterator[LimbRows]:
    """Yield the closure rows of each limb, group by group, or those of its `passive` joints."""
    chosen = blocks.passive if passive else blocks.closure
    for group, block, joints in zip(program.groups, chosen, blocks.joints, strict=True):
        width = len(group.slots)
        for k, limb in enumerate(group.limbs):
            first = group.columns.start + k * width
            driven = np.flatnonzero(group.actuator[:, k] >= 0)
            U, A, E, Q = (a[:, :, k] for a in (block.U, block.A, block.E, block.Q))
            drives, slots = group.actuator[driven, k], slice(first, first + width)
            yield LimbRows(limb, joints, slots, drives, U, A, E, Q[..., driven])


def linearize_limbs(
    robot: Mechanism, values: FloatArray, state: State
) -> Iterator[tuple[tuple[slice, slice], engine.ClosureBlocks]]:
    """Linearize all limbs at a state (t, n); yields the trials and poses of each block with it."""
    t, n = state.T.shape[:2]
    e, _ = robot.slots(values)
    poses = max(min(n, BLOCK_ROWS), 1)
    trials = max(1, BLOCK_ROWS // poses)
    for i in range(0, t, trials):
        for j in range(0, max(n, 1), poses):
            rows = slice(i, min(i + trials, t)), slice(j, min(j + poses, n))
            part = map_arrays(lambda a, rows=rows: a[rows], state)
            joints = driven_values(robot.program, part)
            yield rows, engine.linearize(robot.program, select_block(e, rows[:1]), joints, part)


def linearize_state(
    robot: Mechanism, state: State, values: FloatArray | None = None, free: bool = False
) -> engine.ClosureBlocks:
    """Linearize all limbs at a state (t, n), at the present values without others (t | 1, p)."""
    e, _ = robot.slots(robot.values[None] if values is None else values)
    return engine.linearize(robot.program, e, driven_values(robot.program, state), state, free)


def select_block(array: FloatArray, rows: tuple[slice, ...]) -> FloatArray:
    """Return a block of an array whose leading axes may be 1 and then broadcast."""
    pairs = zip(rows, array.shape, strict=False)
    return array[tuple(s if length > 1 else slice(None) for s, length in pairs)]


def differentiate_displacements(robot: Mechanism, values: FloatArray) -> FloatArray:
    """Return the derivatives (t | 1, d, p) of displacements by parameters in SI."""
    return robot.slots.jacobian(values)[:, : robot.program.n_displacements]


def move_passive_joints(
    robot: Mechanism, values: FloatArray, state: State, twists: FloatArray, driven: FloatArray
) -> FloatArray:
    """Return the derivatives (t, n, j, w) of the passive joints of `name_passive_joints` by w
    inputs, of which the first p are the parameters; those of a locked joint are zero.

    twists : (t, n, M, w) the freedoms of all nodes by the inputs. driven : (t | 1, n | 1, J, w)
    the driven joints by them.
    """
    names, limbs = name_passive_joints(robot), robot.assembly.limbs
    out = np.zeros((*state.T.shape[:2], len(names), twists.shape[-1]))
    displacements = differentiate_displacements(robot, values)
    for rows, blocks in linearize_limbs(robot, values, state):
        slopes, turned = select_block(displacements, rows[:1]), select_block(driven, rows)
        for own in divide_limbs(robot.program, blocks, passive=True):
            if own.joints:
                moved = np.matmul(own.A, twists[rows])
                moved += np.matmul(own.Q, turned[:, :, own.drives])
                moved[..., : slopes.shape[2]] += np.matmul(own.E, slopes[:, None, own.slots])
                limb = limbs[own.limb]
                places = [names.index(f"{limb.name}.{limb.joints[j].name}") for j in own.joints]
                out[rows][:, :, places] = -np.matmul(invert_weights(own.U), moved)
    for i, (_, joint) in enumerate(robot.assembly.passive_joints):
        if joint.actuator is not None:  # the pin of a triangle, which its drive turns
            out[:, :, i] = driven[:, :, robot.assembly.driven_joints.index(joint.actuator)]
    return out


def stack_limb_rows(
    program: Program,
    blocks: engine.ClosureBlocks,
    inputs: FloatArray | None = None,
    *,
    passive: bool = False,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return all closure rows, or those of passive joints, limb by limb: against the freedoms of
    all nodes, then the driven joints (t, n, c, M + J), and against inputs (t, n, c, w), by which
    the displacements have the derivatives (t | 1, d, w), none by default; and the limb of each row.
    """
    M, limbs = len(program.unknown_twists), [*divide_limbs(program, blocks, passive=passive)]
    counts = [own.A.shape[2] for own in limbs]
    rows = np.zeros((*limbs[0].A.shape[:2], sum(counts), M + program.n_joints))
    moved = np.zeros((1, program.n_displacements, 0)) if inputs is None else inputs
    for own, last in zip(limbs, np.cumsum(counts), strict=True):
        part = slice(last - own.A.shape[2], last)
        rows[:, :, part, :M], rows[:, :, part, M + own.drives] = own.A, own.Q
    opened = [np.matmul(own.E, moved[:, None, own.slots]) for own in limbs]
    return rows, np.concatenate(opened, axis=2), np.repeat([own.limb for own in limbs], counts)


def stack_scaled_rows(robot: Mechanism, blocks: engine.ClosureBlocks) -> FloatArray:
    """Return the rows of `stack_limb_rows`, where rotations are lengths at the robot's size."""
    rows, *_ = stack_limb_rows(robot.program, blocks)
    twists = [f for _, f in robot.program.unknown_twists]
    rows[..., : len(twists)] /= robot.twist_scale[twists]
    return rows


def reduce_to_platform(
    program: Program, blocks: engine.ClosureBlocks
) -> tuple[FloatArray, FloatArray]:
    """Return the closure rows that contain no twist of other nodes than the platform, against its
    freedoms (t, n, c, m) and the actuated joints (t, n, c, a), by an orthogonal reduction.
    """
    rows, *_ = stack_limb_rows(program, blocks)
    m, M, c = len(program.freedoms), len(program.unknown_twists), rows.shape[2]
    if m < M:
        whole = np.concatenate([rows[..., m:M], rows[..., :m], rows[..., M:]], axis=-1)
        none = np.zeros((*whole.shape[:2], whole.shape[3], whole.shape[3]))
        folded = engine.fold(*(a.reshape(-1, *a.shape[2:]) for a in (none, whole)))
        rows = folded.reshape(none.shape)[:, :, M - m : c, M - m :]
    return rows[..., :m], rows[..., m:]


# Frames along a limb for displacements and joint values.


def follow_links(
    letters: str, links: FloatArray, advance: FloatArray, joints: FloatArray
) -> list[FloatArray]:
    """Return the frames (.., 4, 4) behind each link of (.., J + 1, 4, 4) [m], for the advances
    (.., J) and the values (.., J) of the joints between them.
    """
    turns, count = np.array([letter == "R" for letter in letters], bool), len(letters)
    steps = move_joints(turns, joints[..., :count], advance) @ links[..., 1 : count + 1, :, :]
    frames = [links[..., 0, :, :]]
    for j in range(count):
        frames.append(frames[-1] @ steps[..., j, :, :])
    return frames


def place_serial(group: Group, displacements: FloatArray) -> Placed:
    """Return the links (t, J + 1, 4, 4) of a limb whose joints are all driven, the platform behind
    the last one, and the advances (t, J) of its joints for displacements (t, s).
    """
    links, advance = place_links(group, 0, displacements)
    last = links[:, -2] @ geometry.invert_pose(links[:, -1])
    return np.concatenate([links[:, :-2], last[:, None]], axis=1), advance


def place_links(group: Group, k: int, displacements: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the displaced links (t, J + 2, 4, 4) of limb k, the attachment last, and the advances
    (t, J) of its joints, pitches and 1 for a slide, for its displacements (t, s).
    """
    # rotations and translations of the links in their own frames
    move = np.zeros((len(displacements), len(group.joints) + 2, 6))
    slides = [letter == "P" for letter in group.joints]
    advance = np.tile(np.where(slides, 1.0, group.pitch[k]), (len(displacements), 1))
    for slot, value in zip(group.slots, displacements.T, strict=True):
        if slot.axis == PITCH:
            advance[:, slot.element] += value
        elif slot.axis != LENGTH:
            move[:, slot.element, slot.axis] += value
    if not move.any():  # at nominal values
        return np.broadcast_to(group.links[k], (len(move), *group.links[k].shape)), advance
    displaced = geometry.make_pose(geometry.exp_so3(move[..., :3]), move[..., 3:])
    return group.links[k] @ displaced, advance


def move_joints(turns: BoolArray, value: FloatArray, advance: FloatArray) -> FloatArray:
    """Return the motions (.., J, 4, 4) of joints, about z where they turn (J,), and along it."""
    angle = np.where(turns, value, 0.0)
    T = np.zeros((*angle.shape, 4, 4))
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    T[..., 0, 0] = T[..., 1, 1] = np.cos(angle)
    T[..., 1, 0] = np.sin(angle)
    T[..., 0, 1] = -T[..., 1, 0]
    T[..., 2, 3] = advance * value
    return T


def move_joint(joint: Joint, value: float) -> FloatArray:
    """Return the motion (4, 4) of one joint."""
    advance = 1.0 if joint.kind == "P" else joint.pitch
    return move_joints(np.array(joint.kind == "R"), np.array(value), np.array(advance))
