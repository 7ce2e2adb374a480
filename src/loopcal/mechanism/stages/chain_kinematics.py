# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics and derivatives of chains; those of a single stage are handed over.

With T_s = T_parent M_s X_s(q_s), M_s the mount and X_s the pose of stage s in its own base, the
twist of the end platform is the sum of the twists of the stages that carry it, each transported:
omega = R_s omega_s, v = R_s v_s + omega x (p_end - p_s). Derivation: docs/theory/stages.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.engine import State
from loopcal.mechanism.model import Mechanism, Stage
from loopcal.mechanism.parameter_units import ParameterUnits
from loopcal.mechanism.stages.chain_state import (
    ChainState,
    get_platforms,
    join_stage_states,
    select_readings,
    split_stage_states,
    transport_to_end,
)
from loopcal.typing import BoolArray, FloatArray, IntArray


class StageSolver(Protocol):
    """Solves forward kinematics of one stage, as `forward_trials` does."""

    def __call__(
        self, robot: Mechanism, values: FloatArray, q: FloatArray, start: State | None
    ) -> State:
        """Return the state (t, n) at readings q (t | 1, n, a) and values (t | 1, p)."""
        ...


class Derivatives(NamedTuple):
    """Derivatives by parameters (t, n, .., p) and by readings (t, n, .., a)."""

    parameters: FloatArray
    readings: FloatArray


class OwnDerivatives(Protocol):
    """Derivatives of one stage, by its own parameters and readings; shapes as in `Derivatives`."""

    @property
    def parameters(self) -> FloatArray:
        """Derivatives by parameters."""
        ...

    @property
    def readings(self) -> FloatArray:
        """Derivatives by readings."""
        ...


class PoseDerivative(Protocol):
    """Differentiates the pose of one stage, as `differentiate_pose` does."""

    def __call__(
        self,
        robot: Mechanism,
        values: FloatArray,
        q: FloatArray,
        state: State,
        columns: ParameterUnits | None = None,
    ) -> OwnDerivatives:
        """Return (t, n, 6, p) by all parameters in SI, or by those of `columns`."""
        ...


JointDerivative = Callable[[Mechanism, FloatArray, FloatArray, State], OwnDerivatives]
"""Differentiates the passive joints of one stage, as `differentiate_passive_joints` does."""


def solve_stages(
    robot: Mechanism, values: FloatArray, q: FloatArray, start: State | None, solve: StageSolver
) -> ChainState:
    """Solve forward kinematics of a chain for readings q (t | 1, n, a) and values (t | 1, p).

    A row has the worst status of its stages. `start` (default: home) selects their modes.
    """
    begins = [None] * len(robot.stages) if start is None else split_stage_states(robot, start)
    count = len(robot.actuators)
    states = [
        solve(stage.robot, values[:, stage.parameters], select_readings(q, stage, count), begin)
        for stage, begin in zip(robot.stages, begins, strict=True)
    ]
    return join_stage_states(robot, states)


def multiply_signs(
    robot: Mechanism,
    values: FloatArray,
    state: State,
    compute: Callable[[Mechanism, FloatArray, State], NDArray[np.int8]],
) -> NDArray[np.int8]:
    """Return the product of the closure signs of all stages (t, n); `compute` is that of one."""
    signs = [
        compute(stage.robot, values[:, stage.parameters], own)
        for stage, own in zip(robot.stages, split_stage_states(robot, state), strict=True)
    ]
    return np.multiply.reduce(signs).astype(np.int8)


def judge_stage_modes(
    robot: Mechanism,
    state: State,
    begin: State,
    judge: Callable[[Mechanism, State, State], tuple[State, BoolArray]],
) -> tuple[State, BoolArray]:
    """Return a state (1, n) with closure signs, and its rows in which a stage is in another mode.

    `judge` is the same function of a stage at its present values.
    """
    is_other, judged = np.zeros(state.T.shape[1], bool), []
    states, begins = split_stage_states(robot, state), split_stage_states(robot, begin)
    for stage, own, first in zip(robot.stages, states, begins, strict=True):
        machine = stage.robot.with_values(robot.values[stage.parameters])
        part, is_part_other = judge(machine, own, first)
        judged.append(part)
        is_other |= is_part_other
    whole = join_stage_states(robot, judged)
    return replace(state, closure_sign=whole.closure_sign, signs=whole.signs), is_other


def differentiate_end(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    differentiate: PoseDerivative,
    columns: ParameterUnits | None = None,
) -> Derivatives:
    """Return the derivatives of the twist of the end platform, (t, n, 6, p) and (t, n, 6, a).

    `columns` : the parameters and their units; all parameters in SI without it.
    """
    chosen = robot.all_parameters if columns is None else columns
    return _differentiate_platform(
        robot, values, q, state, differentiate, chosen, len(robot.stages) - 1
    )


def differentiate_joints(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    differentiate: JointDerivative,
) -> Derivatives:
    """Return the derivatives of the passive joints of all stages, (t, n, j, p) and (t, n, j, a)."""
    count = len(robot.actuators)
    own = [
        differentiate(
            stage.robot, values[:, stage.parameters], select_readings(q, stage, count), part
        )
        for stage, part in zip(robot.stages, split_stage_states(robot, state), strict=True)
    ]
    rows = sum(part.parameters.shape[2] for part in own)
    whole = _make_zeros(robot, state, rows, len(robot.parameters))
    first = 0
    for stage, part in zip(robot.stages, own, strict=True):
        last = first + part.parameters.shape[2]
        whole.parameters[:, :, first:last, stage.parameters] = part.parameters
        whole.readings[:, :, first:last, stage.actuators] = part.readings
        first = last
    return whole


def name_platform_entries(stage: str) -> tuple[str, ...]:
    """Return the names of the twelve numbers of the platform of a stage, [R t] row by row."""
    return tuple(f"{stage}:T{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))


def select_platform_entries(robot: Mechanism, state: State) -> dict[str, FloatArray]:
    """Return the numbers of the platforms of all stages in the base by name, each (t, n)."""
    entries: dict[str, FloatArray] = {}
    for stage, T in zip(robot.stages, get_platforms(robot, state), strict=True):
        numbers = np.moveaxis(T[..., :3, :].reshape(*T.shape[:-2], 12), -1, 0)
        entries |= dict(zip(name_platform_entries(stage.name), numbers, strict=True))
    return entries


def differentiate_platform_entries(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    differentiate: PoseDerivative,
    name: str,
) -> Derivatives:
    """Return the derivatives of the numbers of a platform, (t, n, 12, p) and (t, n, 12, a).

    A column r of the rotation moves by omega x r, the origin by v.
    """
    i = [stage.name for stage in robot.stages].index(name)
    twist = _differentiate_platform(robot, values, q, state, differentiate, robot.all_parameters, i)
    slope = geometry.differentiate_entries(get_platforms(robot, state)[i])
    return Derivatives(*(slope @ part for part in twist))


def _differentiate_platform(
    robot: Mechanism,
    values: FloatArray,
    q: FloatArray,
    state: State,
    differentiate: PoseDerivative,
    columns: ParameterUnits,
    end: int,
) -> Derivatives:
    """Return the derivatives of the twist of platform `end` by these parameters and the readings.

    Only the stages that carry the platform are differentiated.
    """
    count, states = len(robot.actuators), split_stage_states(robot, state)
    whole = _make_zeros(robot, state, 6, len(columns.places))
    for i, transport in transport_to_end(robot, state, end):
        stage = robot.stages[i]
        place, own_columns = _select_columns(stage, columns)
        own = differentiate(
            stage.robot,
            values[:, stage.parameters],
            select_readings(q, stage, count),
            states[i],
            own_columns,
        )
        whole.parameters[..., place] = np.matmul(transport, own.parameters)
        whole.readings[..., stage.actuators] = np.matmul(transport, own.readings)
    return whole


def _select_columns(stage: Stage, columns: ParameterUnits) -> tuple[IntArray, ParameterUnits]:
    """Return which columns are parameters of a stage, and these parameters by its own numbers."""
    first, last = stage.parameters.start, stage.parameters.stop
    chosen = np.flatnonzero((columns.places >= first) & (columns.places < last))
    places = columns.places[chosen] - first
    return chosen, ParameterUnits(stage.robot.slots, places, columns.units[chosen])


def _make_zeros(robot: Mechanism, state: State, rows: int, columns: int) -> Derivatives:
    """Return derivatives (t, n, rows, ..) of zero by `columns` parameters and all readings."""
    t, n = state.T.shape[:2]
    return Derivatives(
        np.zeros((t, n, rows, columns)), np.zeros((t, n, rows, len(robot.actuators)))
    )
