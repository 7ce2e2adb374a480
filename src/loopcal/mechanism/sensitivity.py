# SPDX-License-Identifier: Apache-2.0
"""How the platform moves with parameters and readings, by the implicit function theorem on the
closure of all limbs.

Closure linearised, passive joints eliminated: A y + E de + Q dq = 0, so y = -A^-1 (E de/dp + Q
dq/dp). A limb's rows are touched by its own displacements and actuators only, so its part of the
right-hand side has few columns. Rows are worked on in blocks that fit the cache. Derivation:
docs/theory/engine.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from loopcal import engine
from loopcal.engine import Block, State
from loopcal.mechanism.limb_maps import Columns, LimbMap
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.transmission import joint_slopes, joints_from_readings, term_derivatives
from loopcal.typing import FloatArray

ROWS = 512
"""Rows linearised together."""


@dataclass(frozen=True)
class PoseSensitivity:
    """How the platform moves with parameters and readings.

    Attributes
    ----------
    parameters : (t, n, 6, p) twist (omega in base axes, velocity of the platform's origin) per unit
        of each parameter.
    readings : (t, n, 6, a) the same per unit of each reading.
    """

    parameters: FloatArray
    readings: FloatArray


def differentiate_pose(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> PoseSensitivity:
    """Derivative of the platform's pose by the implicit function theorem, D = -A^-1 [E de/dp + Q
    dq/dp].

    Parameters
    ----------
    values : (t | 1, p). q : (t | 1, n, a) readings. state : (t, n), converged rows.

    Returns
    -------
    Sensitivity; failed rows hold NaN, rows of singular states infinities or NaN.
    """
    t, n = state.T.shape[:2]
    freedoms = list(robot.program.freedoms)
    out = PoseSensitivity(
        np.zeros((t, n, 6, len(robot.parameters))), np.zeros((t, n, 6, len(robot.actuators)))
    )
    for rows in split_rows(t, n):
        work = LinearizedLimbs(
            robot,
            select_block(values, rows[:1]),
            select_block(q, rows),
            select_state_block(state, rows),
        )
        by_parameter, by_reading = work.platform()
        if len(freedoms) == 6:
            out.parameters[rows], out.readings[rows] = by_parameter, by_reading
        else:
            out.parameters[rows][:, :, freedoms], out.readings[rows][:, :, freedoms] = (
                by_parameter,
                by_reading,
            )
    lost = (state.status != Status.CONVERGED) & (state.status != Status.OTHER_MODE)
    out.parameters[lost], out.readings[lost] = np.nan, np.nan
    return out


def split_rows(t: int, n: int) -> Iterator[tuple[slice, slice]]:
    """Slices of trials and poses that cover (t, n) by at most ROWS rows each."""
    poses = min(n, ROWS)
    trials = max(1, ROWS // max(poses, 1))
    for i in range(0, t, trials):
        for j in range(0, n, max(poses, 1)):
            yield slice(i, min(i + trials, t)), slice(j, min(j + poses, n))


def select_block(array: FloatArray, rows: tuple[slice, ...]) -> FloatArray:
    """A block of rows of an array whose leading axes may be 1 and then broadcast."""
    return array[
        tuple(
            s if length > 1 else slice(None) for s, length in zip(rows, array.shape, strict=False)
        )
    ]


def select_state_block(state: State, rows: tuple[slice, slice]) -> State:
    """A block of rows of a state (t, n)."""
    cut = {f.name: getattr(state, f.name)[rows] for f in fields(State) if f.name != "joints"}
    return replace(state, **cut, joints=tuple(j[rows] for j in state.joints))


class LinearizedLimbs:
    """Closure of some rows, with the parameters and readings that each limb's equations hold."""

    def __init__(self, robot: Mechanism, values: FloatArray, q: FloatArray, state: State) -> None:
        slots, self.robot, self.shape = robot.slots, robot, state.T.shape[:2]
        e, tau = slots(values)
        self.blocks = engine.linearize(
            robot.program, e, joints_from_readings(q, tau, slots.frequency), state
        )
        J = slots.jacobian(values)
        self.of_slots = J[:, : slots.n_displacements]
        self.of_terms = J[:, slots.n_displacements :].reshape(len(J), *slots.terms.shape, -1)
        self.terms = term_derivatives(q, slots.frequency)
        self.slope = joint_slopes(q, tau, slots.frequency)

    def limbs(
        self, parts: tuple[Block, ...]
    ) -> Iterator[tuple[FloatArray, Columns, FloatArray, Columns, FloatArray]]:
        """For each limb: its rows (t, n, r, m) against the platform, its parameters with their
        columns (t, n, r, ..), its actuators with theirs.
        """
        for maps, block in zip(self.robot.limb_maps, parts, strict=True):
            for k, limb in enumerate(maps):
                right = self._right(limb, block, k)
                yield (
                    block.A[:, :, k],
                    limb.parameters,
                    right,
                    limb.readings,
                    self._driven(limb, block, k),
                )

    def platform(self) -> tuple[FloatArray, FloatArray]:
        """d platform freedoms / d parameters (t, n, m, p), and / d readings (t, n, m, a)."""
        program = self.robot.program
        inverse = _pseudo_inverse(
            stack_platform_rows(self.blocks), _row_weights(program, self.blocks)
        )
        m = len(program.freedoms)
        by_parameter = np.zeros((*self.shape, m, len(self.robot.parameters)))
        by_reading = np.zeros((*self.shape, m, program.n_joints))
        first = 0
        for A, parameters, of_parameters, drives, of_drives in self.limbs(self.blocks.closure):
            for i in range(A.shape[2]):
                column = inverse[..., first + i, None]
                by_parameter[..., parameters] -= column * of_parameters[:, :, i, None]
                by_reading[..., drives] -= column * of_drives[:, :, i, None]
            first += A.shape[2]
        return by_parameter, by_reading

    def _right(self, limb: LimbMap, block: Block, k: int) -> FloatArray:
        """d rows / d parameters of limb k (t, n, r, ..)."""
        right = block.E[:, :, k]
        if not limb.plain:
            t, n, r, width = right.shape
            of_slots = self.of_slots[:, limb.own, limb.parameters]
            right = np.matmul(right.reshape(t, n * r, width), of_slots).reshape(
                t, n, r, of_slots.shape[-1]
            )
        for j, a, terms in limb.drives:
            for i in terms:
                slopes = self.of_terms[:, None, None, a, i, limb.parameters]
                right = (
                    right
                    + (block.Q[:, :, k, :, j] * self.terms[i][:, :, a, None])[..., None] * slopes
                )
        return right

    def _driven(self, limb: LimbMap, block: Block, k: int) -> FloatArray:
        """d rows / d readings of limb k (t, n, r, ..)."""
        return (
            block.Q[:, :, k][..., [j for j, *_ in limb.drives]]
            * self.slope[:, :, None, limb.readings]
        )


def stack_platform_rows(blocks: engine.ClosureBlocks) -> FloatArray:
    """All closure rows against the platform's freedoms, (t, n, c, m)."""
    return np.concatenate(
        [b.A.reshape(*b.A.shape[:2], -1, b.A.shape[-1]) for b in blocks.closure], axis=2
    )


def _row_weights(program: engine.Program, blocks: engine.ClosureBlocks) -> FloatArray | None:
    """One over the standard deviation that a redundant actuator gives each row, (t, n, c); None
    without redundancy.
    """
    if program.sigma is None:
        return None
    weights = []
    for group, block in zip(program.groups, blocks.closure, strict=True):
        j = int(np.flatnonzero(group.actuator[:, 0] >= 0)[0])
        drive = np.abs(block.Q[..., j]) * np.array(program.sigma)[group.actuator[j], None]
        weights.append(1.0 / drive.reshape(*drive.shape[:2], -1))
    return np.concatenate(weights, axis=2)


def _pseudo_inverse(A: FloatArray, weights: FloatArray | None) -> FloatArray:
    """Inverse, or weighted pseudo-inverse, of A (t, n, c, m) -> (t, n, m, c); rows that cannot be
    inverted are NaN.
    """
    if weights is not None:
        A = A * weights[..., None]
    good = np.asarray(np.isfinite(A).all(axis=(-1, -2)))
    safe = np.where(good[..., None, None], A, np.eye(*A.shape[-2:]))
    if A.shape[-1] == A.shape[-2]:
        try:
            out = np.linalg.solve(safe, np.eye(A.shape[-1]))
        except np.linalg.LinAlgError:
            out = np.linalg.pinv(safe)
    else:
        out = np.linalg.pinv(safe)
    out = np.where(good[..., None, None], out, np.nan)
    return out if weights is None else out * weights[..., None, :]
