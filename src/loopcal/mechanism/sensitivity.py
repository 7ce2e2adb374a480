# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the platform pose and of passive joints in parameters and readings.

Linearized closure without passive joints reads A y + E de + Q dq = 0, so that the platform's twist
is y = -A^-1 (E de/dp + Q dq/dp), which the engine computes. A limb's eliminated joints follow from
U dtheta + A y + E de + Q dq = 0; these equations contain its own displacements and actuators only.
They are computed in blocks that fit the cache. Derivation: docs/theory/kinematics.md.

Arguments are values (t | 1, p), readings q (t | 1, n, a) and the states (t, n) that they lead to.
Failed rows have NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import State
from loopcal.mechanism import actuation
from loopcal.mechanism.chains import each_stage, locate_bodies, transport_to_end
from loopcal.mechanism.least_squares_closure import (
    differentiate_unknowns,
    find_open_loops,
    list_unknown_joints,
)
from loopcal.mechanism.limb_rows import move_passive_joints, name_entries, name_passive_joints
from loopcal.mechanism.model import Mechanism, ParameterUnits
from loopcal.mechanism.states import is_closed
from loopcal.typing import BoolArray, FloatArray


def differentiate_pose(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    columns: ParameterUnits | None = None,
    nodes: int = 1,
) -> actuation.Derivatives:
    """Differentiate the pose by the implicit function theorem, D = -A^-1 [E de/dp + Q dq/dp].

    Return the twists (omega in base axes, velocity of the platform's origin) per unit of each
    parameter (t, n, 6, p), all in SI or those of `columns`, and reading (t, n, 6, a); of several
    `nodes` their twists node by node, the platform first. Rows of singular states have infinities
    or NaN.
    """
    if robot.stages:
        return differentiate_platform(robot, values, q, state, columns)
    chosen = columns or robot.all_parameters
    p = len(chosen.places)
    if robot.has_open_sums:
        moved = chosen.select(actuation.differentiate_open_sums(robot, values, q, state))
        derivatives = np.split(actuation.spread_twists(robot.program, moved, nodes), [p], axis=3)
    else:
        e, drives, joints = actuation.drive_joints(robot, values, q)
        with np.errstate(invalid="ignore"):  # as in `drive_joints`
            inputs = chosen.linearize(values, drives, q)
            given = robot.program, e, joints, state, inputs, nodes
            by_parameters, turned = engine.differentiate(*given)
            if robot.has_sums:
                by_inputs = actuation.differentiate_driven_joints(robot, values, q)
                turned = np.matmul(turned, by_inputs[..., len(robot.parameters) :])
        derivatives = [by_parameters, turned]
    is_open = find_open_loops(robot, state)
    if is_open.any():
        moved = differentiate_unknowns(robot, values, q, state, chosen)
        parts = np.split(actuation.spread_twists(robot.program, moved, nodes), [p], axis=3)
        for derivative, own in zip(derivatives, parts, strict=True):
            derivative[is_open] = own[is_open]
    lost = ~is_closed(state.status)
    if lost.any():
        for derivative in derivatives:
            derivative[lost] = np.nan
    return actuation.Derivatives(*derivatives)


def differentiate_platform(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    columns: ParameterUnits | None = None,
    end: int = -1,
) -> actuation.Derivatives:
    """Differentiate the platform of a stage of a chain (default: the end) as `differentiate_pose`
    does that of a robot, by the twists of the stages that carry it.
    """
    columns = columns or robot.all_parameters
    whole = _make_zeros(robot, state, 6, len(columns.places))
    parts = list(each_stage(robot, values, state, q))
    for i, transport in transport_to_end(robot, state, end):
        stage, own, part, readings = parts[i]
        first, last = stage.parameters.start, stage.parameters.stop
        place = np.flatnonzero((columns.places >= first) & (columns.places < last))
        own_columns = ParameterUnits(
            stage.robot.slots, columns.places[place] - first, columns.units[place]
        )
        by_own = differentiate_pose(stage.robot, own, readings, part, own_columns)
        whole.parameters[..., place] = np.matmul(transport, by_own.parameters)
        whole.readings[..., stage.actuators] = np.matmul(transport, by_own.readings)
    return whole


def _make_zeros(robot: Mechanism, state: State, rows: int, columns: int) -> actuation.Derivatives:
    """Return derivatives (t, n, rows, ..) of zero by `columns` parameters and all readings."""
    t, n = state.T.shape[:2]
    return actuation.Derivatives(
        np.zeros((t, n, rows, columns)), np.zeros((t, n, rows, len(robot.actuators)))
    )


def differentiate_by_drives(
    robot: Mechanism, e: FloatArray, u: FloatArray, state: State, weights: FloatArray | None
) -> FloatArray:
    """Return twists (t, n, 6, u) per unit of driven joints u (t, n, u), or (t, n, 6, r) of their
    sums with `weights` (t | 1, r, J), of a robot without stages at displacements e (t | 1, d).
    """
    if weights is None:
        return engine.differentiate(robot.program, e, u, state, robot.program.drive_map)[1]
    return actuation.spread_twists(
        robot.program, actuation.differentiate_unknowns_by_sums(robot, e, state, weights)
    )


def fold_pose_rows(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    columns: ParameterUnits,
    observed: Sequence[engine.TwistRows],
    factor: FloatArray,
    driven: actuation.DrivenJoints | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Fold rows [G D | r] of observed poses into factors (t, p + 1, p + 1), with D of
    `differentiate_pose`; see `engine.fold_poses`. For robots without stages whose readings
    determine the joints, and whose loops close.
    """
    e, drives, joints = driven or actuation.drive_joints(robot, values, q)
    inputs = columns.linearize(values, drives, q)
    return engine.fold_poses(factor, robot.program, e, joints, state, inputs, observed)


class PassiveSensitivity(NamedTuple):
    """Derivatives of named passive joints, (t, n, j, p) by parameters, (t, n, j, a) by readings."""

    names: tuple[str, ...]
    parameters: FloatArray
    readings: FloatArray


def differentiate_passive_joints(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PassiveSensitivity:
    """Differentiate passive joints in every parameter and reading; a locked joint has zeros."""
    names = name_passive_joints(robot)
    if robot.stages:
        whole = _make_zeros(robot, state, len(names), len(robot.parameters))
        first = 0
        for stage, own, part, readings in each_stage(robot, values, state, q):
            moved = differentiate_passive_joints(stage.robot, own, readings, part)
            rows = slice(first, first + len(moved.names))
            whole.parameters[:, :, rows, stage.parameters] = moved.parameters
            whole.readings[:, :, rows, stage.actuators] = moved.readings
            first = rows.stop
        return PassiveSensitivity(names, *whole)
    program, p = robot.program, len(robot.parameters)
    if robot.has_open_sums:
        moved = actuation.differentiate_open_sums(robot, values, q, state)
        twists, driven = np.split(moved, [len(program.unknown_twists)], axis=2)
    else:
        nodes = differentiate_pose(robot, values, q, state, nodes=len(program.nodes))
        freedoms = [6 * node + f for node, f in program.unknown_twists]
        twists = np.concatenate(nodes, axis=3)[:, :, freedoms]
        driven = actuation.differentiate_driven_joints(robot, values, q)
    by_inputs = move_passive_joints(robot, values, state, twists, driven)
    is_open = find_open_loops(robot, state)
    if is_open.any():
        own = differentiate_unknowns(robot, values, q, state, robot.all_parameters)
        for i, (g, k, j) in enumerate(list_unknown_joints(program), len(program.unknown_twists)):
            limb = robot.assembly.limbs[program.groups[g].limbs[k]]
            place = names.index(f"{limb.name}.{limb.joints[j].name}")
            by_inputs[is_open, place] = own[is_open, i]
    by_inputs[~is_closed(state.status)] = np.nan
    return PassiveSensitivity(names, by_inputs[..., :p], by_inputs[..., p:])


def differentiate_bodies(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State, names: Sequence[str]
) -> dict[str, actuation.Derivatives]:
    """Differentiate bodies of `locate_bodies` as `differentiate_pose` the platform, by name."""
    if robot.stages:
        ends = [stage.name for stage in robot.stages]
        parts = ((name, ends.index(name)) for name in names)
        given = robot, values, q, state
        return {name: differentiate_platform(*given, end=end) for name, end in parts}
    bodies = list(robot.assembly.bodies) if names else []
    whole = differentiate_pose(robot, values, q, state, nodes=1 + len(bodies))
    rows = {name: slice(6 * i, 6 * i + 6) for i, name in enumerate(bodies, 1)}
    return {name: actuation.Derivatives(*(by[:, :, rows[name]] for by in whole)) for name in names}


def differentiate_sensed_values(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State, names: Sequence[str]
) -> actuation.Derivatives:
    """Differentiate passive joints and the numbers of bodies, by name."""
    known: list[str] = []
    derivatives: list[tuple[FloatArray, FloatArray]] = []
    poses = locate_bodies(robot, state)
    bodies = [body for body in poses if not set(name_entries(body)).isdisjoint(names)]
    for body, twist in differentiate_bodies(robot, values, q, state, bodies).items():
        known += name_entries(body)
        # a column r of the rotation moves by omega x r, the origin by v
        slope = geometry.differentiate_entries(poses[body])
        derivatives.append((slope @ twist.parameters, slope @ twist.readings))
    if not set(names) <= set(known):
        joints = differentiate_passive_joints(robot, values, q, state)
        known += joints.names
        derivatives.append((joints.parameters, joints.readings))
    places = [known.index(name) for name in names]
    arrays = zip(*derivatives, strict=True)
    return actuation.Derivatives(*(np.concatenate(of, axis=2)[:, :, places] for of in arrays))
