# SPDX-License-Identifier: Apache-2.0
"""Mobility at home: whether the actuators can move and hold the platform, and which joints idle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopcal import engine
from loopcal.engine import ENDINGS
from loopcal.errors import MechanismError
from loopcal.mechanism.actuation import list_open_sums, measure_sums
from loopcal.mechanism.assembly import (
    AXES,
    MOST_ACTUATORS,
    MOST_JOINTS,
    MOST_LIMBS,
    MOST_PARAMETERS,
    Assembly,
    Limb,
    is_serial,
    refuse_more,
    select_rows,
)
from loopcal.mechanism.limb_rows import linearize_state, reduce_to_platform, stack_scaled_rows
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import (
    COORDINATES,
    check_coordinates,
    differentiate_coordinates,
)
from loopcal.mechanism.states import driven_values
from loopcal.numerics.decomposition import find_null_space
from loopcal.typing import FloatArray
from loopcal.units import SI_SYMBOLS, Dimension

RANK = 1e-9
"""Relative size below which a singular value of closure equations counts as zero.

Real margins are above 1e-4, rounding is below 1e-13.
"""
CLOSED = 1e-9  # gap of the loops, as a share of the robot's size, below which they are closed
# Motion of a loop's closure by an actuator, as a share of the robot's size or per unit of stroke,
# below which the actuator does not move it. An iteration ends this far from a singular position.
STRETCHED = 1e-5
# Components below this share of the largest one are left out of the description of a motion.
MAIN_SHARE = 0.3


def check_mobility(robot: Mechanism) -> Mechanism:
    """Return the robot, with loops that may stay open where its sums are more than its freedoms.
    Refuse actuators that cannot move and hold the platform at home; the error names freedoms.
    """
    program, home = robot.program, robot.home_state
    blocks = linearize_state(robot, home)
    lost = [
        robot.assembly.limbs[limb].name
        for group, block in zip(program.groups, blocks.closure, strict=True)
        for limb, A in zip(group.limbs, block.A[0, 0], strict=True)
        if not np.isfinite(A).all()
    ]
    if lost:
        raise MechanismError.of("mechanism.no-direction", name=robot.name, limbs=lost)
    refuse_free_bodies(robot, home)
    closure, names = stack_scaled_rows(robot, blocks)[0, 0], [AXES[f] for f in program.freedoms]
    m, a, M = len(names), program.n_joints, len(program.unknown_twists)
    free = find_null_space(closure[:, :M], RANK)
    if free.size:
        raise MechanismError.of(
            "mechanism.free-platform",
            name=robot.name,
            motion=tuple(list_main_freedoms(names, free[:m, 0])),
            equations=len(closure) - (M - m),
            rank=m - free.shape[1],
            freedoms=m,
        )
    rows = closure
    if robot.assembly.couplings:
        sums = list_open_sums(robot, robot.values[None])
        a, coupled = sums.chosen, sums.weights[:, sums.chosen :]
        coupled = coupled[0] * measure_sums(robot, coupled)[:, None]
        rows = np.concatenate([closure, np.pad(coupled, [(0, 0), (M, 0)])])
    # motions of the platform with every actuator free
    motions = find_null_space(rows, RANK)[:m]
    movable = motions.shape[1]
    if movable < min(a, m):
        raise MechanismError.of(
            "mechanism.over-constrained",
            name=robot.name,
            actuators=a,
            movable=movable,
            freedoms=m,
            motions=tuple(
                tuple(list_main_freedoms(names, y)) for y in find_null_space(motions.T, RANK).T
            ),
        )
    if len(robot.controlled) != movable:
        raise MechanismError(
            f"{robot.name} moves in {movable} freedoms, but names "
            f"{len(robot.controlled)} controlled coordinates ({', '.join(robot.controlled)}). Name "
            f"{movable}"
        )
    twists = motions / robot.twist_scale[list(program.freedoms), None]
    if count_rank(_differentiate_controlled(robot, robot.home) @ twists) < movable:
        raise MechanismError(_word_dependent(robot, movable))
    is_redundant = robot.has_open_sums and _check_open_sums(robot, closure)
    return replace(robot, program=replace(program, may_stay_open=True)) if is_redundant else robot


def refuse_free_bodies(robot: Mechanism, state: engine.State) -> None:
    """Refuse bodies that can move while platform and actuators rest, at a state (1, 1)."""
    m, columns = len(robot.program.freedoms), robot.program.unknown_twists
    rows = stack_scaled_rows(robot, linearize_state(robot, state))[0, 0]
    free = find_null_space(rows[:, m : len(columns)], RANK)
    if free.size:
        motion = free[:, 0]
        node, _ = columns[m + int(np.abs(motion).argmax())]
        own = [i for i, (other, _) in enumerate(columns[m:]) if other == node]
        names = [AXES[columns[m + i][1]] for i in own]
        raise MechanismError.of(
            "mechanism.free-body",
            name=robot.name,
            body=tuple(robot.assembly.bodies)[node - 1],
            motion=tuple(list_main_freedoms(names, motion[own])),
        )


def _check_open_sums(robot: Mechanism, rows: FloatArray) -> bool:
    """Return whether the sums are more than the freedoms at home, where they contradict each other
    by their errors, for closure rows (c, M + J). Refuse sums that leave the platform free.
    """
    weights = robot.present[1].weights
    assert weights is not None
    units = measure_sums(robot, weights)[:, None]
    sums = np.pad(weights[0] * units, [(0, 0), (rows.shape[1] - weights.shape[2], 0)])
    if count_rank(np.concatenate([rows, sums])) < rows.shape[1]:
        raise MechanismError(
            f"{robot.name}: the sums of its readings and couplings do not hold the platform "
            f"at home: it can move while all sums are constant. Correct the weights of "
            f"`sum:`, or give another `home:`"
        )
    return len(robot.assembly.rows) > rows.shape[1] - count_rank(rows)


def refuse_uncontrolled(robot: Mechanism, state: engine.State) -> None:
    """Refuse coordinates that do not determine the motion of the platform, at a state (1, 1)."""
    blocks = linearize_state(robot, state, free=True)
    rows = reduce_to_platform(robot.program, blocks)[0][0, 0]
    columns = _differentiate_controlled(robot, state.T[0, 0])
    scale = 1 / robot.twist_scale[list(robot.program.freedoms)]
    if count_rank(np.concatenate([rows, columns]) * scale) < len(scale):
        raise MechanismError(_word_dependent(robot, len(robot.controlled)))


def refuse_singular_home(robot: Mechanism, state: engine.State) -> None:
    """Refuse a home (1, 1) at which the loops are closed, but the iteration does not converge; the
    error names the actuators that move nothing there.
    """
    if not state.residual[0, 0] < CLOSED * robot.size:
        return
    rows = stack_scaled_rows(robot, linearize_state(robot, state))[0, 0]
    motion = np.linalg.norm(rows[:, len(robot.program.unknown_twists) :], axis=0)
    names = robot.assembly.driven_joints
    is_idle = motion < STRETCHED * robot.joint_units
    raise MechanismError.of(
        "mechanism.singular-home",
        name=robot.name,
        actuators=tuple(name for name, idle in zip(names, is_idle, strict=True) if idle),
    )


def _differentiate_controlled(robot: Mechanism, T: FloatArray) -> FloatArray:
    """Return d controlled coordinates / d freedoms (c, m) at a pose (4, 4)."""
    columns = differentiate_coordinates(T[None], robot.controlled, robot.size)
    return columns[0][:, list(robot.program.freedoms)]


def _word_dependent(robot: Mechanism, count: int) -> str:
    """Return the sentence for controlled coordinates that depend on each other."""
    return (
        f"{robot.name} cannot set the coordinates {', '.join(robot.controlled)} independently "
        f"at home. Name {count} that the actuators move independently, of {', '.join(COORDINATES)}"
    )


def shake_joints(state: engine.State, seed: int) -> engine.State:
    """Return a state with its joints away from any special position, by up to 0.3 rad or m."""
    # the same disturbance in every limb: the result must not depend on the order of the limbs
    shifts = [np.random.default_rng(seed).uniform(-0.3, 0.3, j.shape[-1]) for j in state.joints]
    return replace(state, joints=tuple(j + s for j, s in zip(state.joints, shifts, strict=True)))


def find_idle_joints(program: engine.Program, guess: engine.State) -> dict[int, tuple[int, ...]]:
    """Return the joints to lock of each limb that can move while tip and platform rest, one for
    each motion.

    Of the joints in a null combination the one with the largest component is chosen, at joint
    values away from any special position and independently of other limbs.
    """
    shaken = shake_joints(guess, 0)
    # driven joints are disturbed too: with a slide at zero the lower joint of a leg would seem to
    # spin it only
    e, q = np.zeros((1, program.n_displacements)), driven_values(program, shaken)
    blocks = engine.linearize(program, e, q, shaken)
    idle = {}
    for group, block, joints in zip(program.groups, blocks.passive, blocks.joints, strict=True):
        for k, limb in enumerate(group.limbs):
            chosen = _find_dependent_columns(block.U[0, 0, k]) if joints else []
            if chosen:
                idle[limb] = tuple(joints[c] for c in chosen)
    return idle


def _find_dependent_columns(U: FloatArray) -> list[int]:
    """Return the columns without which the others are independent, one for each null direction."""
    chosen: list[int] = []
    while True:
        rest = [c for c in range(U.shape[1]) if c not in chosen]
        null = find_null_space(U[:, rest], RANK)
        if not null.size:
            return chosen
        part = np.abs(null[:, -1])
        # of equal components the first, whatever their rounding errors
        chosen.append(rest[int(np.argmax(part > (1 - 1e-6) * part.max()))])


def count_rank(rows: FloatArray) -> int:
    """Return how many singular values of closure equations are above RANK times the largest."""
    return rows.shape[1] - find_null_space(rows, RANK).shape[1]


def list_main_freedoms(names: Sequence[str], direction: FloatArray) -> list[str]:
    """Return the freedoms with a large component in a motion (m,), the largest one first."""
    size = np.abs(direction)
    return [str(names[i]) for i in np.argsort(-size) if size[i] > MAIN_SHARE * size.max()]


# Checks of an assembly: names, limbs, freedoms and ranges that fit together.


def check_assembly(assembly: Assembly, *, is_stage: bool = False) -> None:
    """Refuse inconsistent names, limbs, freedoms and ranges; a stage that is a serial joint needs
    no controlled coordinates.
    """
    refuse_more(MOST_LIMBS, len(assembly.limbs), f"{assembly.name} has", "limbs")
    for limb in assembly.limbs:
        refuse_more(MOST_JOINTS, len(limb.joints), f"limb {limb.name!r} has", "joints")
    refuse_more(MOST_ACTUATORS, len(assembly.actuators), f"{assembly.name} has", "actuators")
    refuse_more(MOST_PARAMETERS, len(assembly.parameters), f"{assembly.name} has", "parameters")
    _check_names(assembly)
    for limb in assembly.limbs:
        _check_limb(limb)
    _check_freedoms(assembly, is_stage)
    _check_ranges(assembly)


def _check_names(assembly: Assembly) -> None:
    """Refuse duplicate names."""
    limbs, rows = [limb.name for limb in assembly.limbs], [a.name for a in assembly.couplings]
    actuators = [a.name for a in assembly.actuators]
    for kind, names in (("limb", limbs), ("actuator", actuators), ("coupling", rows)):
        for name in names:
            if names.count(name) > 1:
                raise MechanismError(f"two {kind}s have the name {name!r}. Give each its own name")
    driven = [name for limb in assembly.limbs for name in limb.drives]
    assert set(driven) == {*assembly.driven_joints}, driven


def _check_limb(limb: Limb) -> None:
    """Refuse duplicate names, and two joints on a drive."""
    joints = [joint.name for joint in limb.joints]
    if len(set(joints)) < len(joints):
        raise MechanismError(
            f"two joints of limb {limb.name!r} share one name ({', '.join(joints)}). Give each "
            "its own name"
        )
    if len(set(limb.drives)) < len(limb.drives):
        raise MechanismError(
            f"actuator {limb.drives[0]!r} drives two joints of limb {limb.name!r}; an actuator "
            "may drive one joint of a limb"
        )
    assert limb.ending in ENDINGS, limb.ending
    assert len(limb.links) == len(limb.joints) + 1, limb.links


def _check_freedoms(assembly: Assembly, is_stage: bool) -> None:
    """Refuse missing or duplicate freedoms and controlled coordinates."""
    freedoms = assembly.freedoms
    if not freedoms:
        raise MechanismError(
            f"{assembly.name} has no freedoms. Give those of its platform, of {', '.join(AXES)}"
        )
    duplicates = [f for f in freedoms if freedoms.count(f) > 1]
    if duplicates:
        raise MechanismError(
            f"duplicate freedom {duplicates[0]!r} in {', '.join(freedoms)}. Name each once"
        )
    balls = [limb.name for limb in assembly.limbs if not select_rows(limb.ending, freedoms)]
    if balls:
        raise MechanismError(
            f"limb {balls[0]!r} ends in a ball, whose closure equations are shifts, but the "
            f"freedoms of the platform are {', '.join(freedoms)}. Give the shifts of its origin, "
            "too, or leave out `freedoms:`"
        )
    rotations = [f for f in freedoms if f.startswith("r")]
    if len(rotations) == 2:
        raise MechanismError(
            f"{assembly.name} has the freedoms {' and '.join(rotations)}, which define no "
            f"pose: the order of the two rotations is open. Let the platform have "
            "all freedoms, and add a limb with the joint that holds it, such as {joint: U, axes: "
            "[x, y]} with the ending rigid"
        )
    if is_stage and is_serial(assembly):
        return
    if not assembly.controlled:
        raise MechanismError(
            f"{assembly.name} names no controlled coordinate. Give one for each freedom under "
            f"controlled:, of {', '.join(COORDINATES)}"
        )
    check_coordinates(assembly.controlled)


def _check_ranges(assembly: Assembly) -> None:
    """Refuse strokes and limits whose low end is not below the high one."""
    ranges = [(f"stroke of {a.name} runs", a.stroke, a.dimension) for a in assembly.actuators]
    ranges += [
        (f"limits of {limb.name}.{joint.name} run", joint.limits, joint.dimension)
        for limb in assembly.limbs
        for joint in limb.joints
    ]
    for name, bounds in assembly.load.ranges.items():
        ranges.append((f"range of {name} runs", bounds, Dimension(name.partition(".")[0])))
    for what, bounds, dimension in ranges:
        if bounds and not bounds[0] < bounds[1]:
            raise MechanismError(
                f"the {what} from {bounds[0]:g} to {bounds[1]:g} {SI_SYMBOLS[dimension]}; the "
                "first value must be smaller"
            )
