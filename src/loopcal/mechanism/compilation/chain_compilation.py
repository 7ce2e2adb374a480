# SPDX-License-Identifier: Apache-2.0
"""Compilation of a chain: its stages one by one, then their structures one after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from loopcal.engine import Program
from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism.assembly import AXES, BASE, Assembly, AttachedStage
from loopcal.mechanism.compilation.mobility import count_rank
from loopcal.mechanism.model import Mechanism, SlotMap, Stage
from loopcal.mechanism.platform_coordinates import compare_coordinates, read_coordinates
from loopcal.mechanism.stages.chain_kinematics import PoseDerivative, differentiate_end
from loopcal.mechanism.stages.chain_state import (
    ChainState,
    find_carrying_actuators,
    join_stage_states,
)
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission.terms import ALL_TERMS, readings_from_joints
from loopcal.parameters import ParameterTable
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension

DEFAULT_SIZE = 1.0
"""Characteristic length [m] of a chain whose platforms all coincide."""


def build_chain(
    assembly: Assembly,
    units: Mapping[Dimension, str],
    record: Any,
    build: Callable[[AttachedStage], Mechanism],
    differentiate: PoseDerivative,
) -> Mechanism:
    """Return the mechanism of a chain; `build` compiles a stage, `differentiate` is that of one.

    Raises
    ------
    MechanismError
        A stage cannot be built (names it), or the actuators cannot set the controlled coordinates.
    """
    stages = _build_stages(assembly.stages, build)
    table = ParameterTable(assembly.parameters, assembly.common_errors)
    size = compute_chain_size(stages)
    program = _join_programs(stages, size)
    robot = Mechanism(
        assembly,
        table,
        table.nominal,
        program,
        _join_slots(stages, table.nominal),
        size,
        stages[-1].robot.home_state,
        {d: unit.symbol for d, unit in DISPLAY_UNITS.items()} | dict(units),
        tuple(finding for stage in stages for finding in stage.robot.findings),
        record,
        stages,
    )
    home = join_stage_states(robot, [stage.robot.home_state for stage in stages])
    robot = replace(robot, home_state=home, assembly=replace(assembly, home=np.array(home.T[0, 0])))
    _check_mobility(robot, home, differentiate)
    return robot


def _build_stages(
    attached: Sequence[AttachedStage], build: Callable[[AttachedStage], Mechanism]
) -> tuple[Stage, ...]:
    """Return the compiled stages; an error names its stage."""
    stages: list[Stage] = []
    places = {BASE: -1}
    p = a = g = 0
    for stage in attached:
        try:
            robot = build(stage)
        except MechanismError as error:
            raise MechanismError(f"stage {stage.name!r}: {error}") from None
        if robot.program.sigma is not None:
            raise MechanismError(
                f"stage {stage.name!r} has {len(robot.actuators)} actuators for "
                f"{len(robot.freedoms)} freedoms; a stage of a chain must have one actuator for "
                "each coordinate that it sets"
            )
        counts = len(robot.parameters), len(robot.actuators), len(robot.program.groups)
        stages.append(
            Stage(
                stage.name,
                places[stage.on],
                stage.mount,
                robot,
                *(slice(i, i + n) for i, n in zip((p, a, g), counts, strict=True)),
            )
        )
        places[stage.name] = len(stages) - 1
        p, a, g = (i + n for i, n in zip((p, a, g), counts, strict=True))
    return tuple(stages)


def compute_chain_size(stages: Sequence[Stage]) -> float:
    """Return the characteristic length [m] of a chain.

    It is the root mean square distance of the end platform from the bases of the stages at home, or
    the size of the largest stage with a loop, if that is larger.
    """
    bases: list[FloatArray] = []
    platforms: list[FloatArray] = []
    for stage in stages:
        base = stage.mount if stage.parent < 0 else platforms[stage.parent] @ stage.mount
        bases.append(base)
        platforms.append(base @ stage.robot.home)
    arms = np.array([platforms[-1][:3, 3] - base[:3, 3] for base in bases])
    reach = float(np.sqrt((arms**2).sum() / len(arms)))
    loops = [stage.robot.size for stage in stages if not stage.robot.is_serial]
    return max([reach, *loops]) or DEFAULT_SIZE


def _join_programs(stages: Sequence[Stage], size: float) -> Program:
    """Return the structure of all stages, with the platform's six freedoms."""
    groups, limbs, first, joints = [], 0, 0, 0
    for stage in stages:
        own = stage.robot.program
        for group in own.groups:
            driven = np.where(group.actuator >= 0, group.actuator + joints, -1)
            groups.append(
                replace(
                    group,
                    limbs=tuple(limbs + i for i in group.limbs),
                    actuator=driven,
                    columns=slice(first + group.columns.start, first + group.columns.stop),
                )
            )
        limbs += len(stage.robot.assembly.limbs)
        first, joints = first + own.n_displacements, joints + own.n_joints
    return Program(tuple(groups), tuple(range(len(AXES))), size, first, joints)


def _join_slots(stages: Sequence[Stage], nominal: FloatArray) -> SlotMap:
    """Return the maps of all stages: first the displacements of all, then their transmissions."""
    maps = [stage.robot.slots for stage in stages]
    displacements = sum(own.n_displacements for own in maps)
    actuators = sum(len(own.terms) for own in maps)
    k = max(own.terms.shape[1] for own in maps)
    has_sums = any(stage.robot.has_sums for stage in stages)
    if has_sums:
        k = len(ALL_TERMS) + sum(stage.robot.program.n_joints for stage in stages)
    matrix = np.zeros((displacements + actuators * k, len(nominal)))
    shared, first, term, joint = [], 0, displacements, 0
    terms = np.zeros((actuators, k))
    for stage, own in zip(stages, maps, strict=True):
        d = own.n_displacements
        a, width = own.terms.shape
        columns = np.arange(width)
        columns[len(ALL_TERMS) :] += joint  # the weights of its own joints
        terms[stage.actuators, columns] = own.terms
        if has_sums and width <= len(ALL_TERMS):
            terms[stage.actuators, len(ALL_TERMS) + joint + np.arange(a)] = np.eye(a)
        joint += stage.robot.program.n_joints
        of_terms = (np.arange(a)[:, None] * k + columns).ravel()
        places = np.concatenate([np.arange(d) + first, of_terms + term])
        matrix[places, stage.parameters] = own.matrix
        for function, inputs, outputs in own.shared:
            values = tuple(i + stage.parameters.start for i in inputs)
            shared.append((function, values, tuple(int(places[o]) for o in outputs)))
        first, term = first + d, term + a * k
    frequency = np.concatenate([own.frequency for own in maps])
    return SlotMap(matrix, tuple(shared), nominal, displacements, terms, frequency)


def _check_mobility(robot: Mechanism, home: ChainState, differentiate: PoseDerivative) -> None:
    """Refuse a chain whose actuators do not set the controlled coordinates one by one.

    The freedoms of the end platform are the rank of its derivatives by the readings.
    """
    moving = find_carrying_actuators(robot)
    values = robot.values[None]
    _, tau = robot.slots(values)
    q = readings_from_joints(driven_values(robot.program, home), tau, robot.slots.frequency)
    D = differentiate_end(robot, values, q, home, differentiate).readings[0, 0]
    turning = np.array([a.dimension is Dimension.ANGLE for a in robot.actuators])
    scaled = D * robot.twist_scale[:, None] / np.where(turning, robot.size, 1.0)
    freedoms = count_rank(np.linalg.svd(scaled, compute_uv=False))
    c, a = len(robot.controlled), len(moving)
    if c != a:
        raise MechanismError(
            report_finding(
                "mechanism.chain-controlled",
                name=robot.name,
                named=c,
                actuators=a,
                freedoms=freedoms,
            )
        )
    target = read_coordinates(home.T[0], robot.controlled)
    _, slope = compare_coordinates(home.T[0], target, robot.controlled, robot.size)
    rates = slope[0] / robot.twist_scale @ scaled
    independent = count_rank(np.linalg.svd(rates, compute_uv=False))
    if independent < c:
        finding = report_finding(
            "mechanism.chain-singular-home",
            name=robot.name,
            controlled=robot.controlled,
            independent=independent,
        )
        raise MechanismError(finding)
