# SPDX-License-Identifier: Apache-2.0
"""The six least-squares problems of the paper's section 3: changes of leg length by parameters.

The error model of a pose, twist = D dp + S dq (S by the readings), becomes
S^-1 twist = S^-1 D dp = G dp. Rows of G belong to one leg each, so each leg is a problem of n rows
and its own parameters. It ignores that the noise of a pose is shared by all legs, which costs
accuracy: use `identify` for real work. Derivation: docs/theory/hexapod.md. Source: "Numerical
simulation of the calibration algorithm for a 6-DOF parallel mechanism", section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.published_methods.raw_steps import list_raw_units
from loopcal.measure import Measurements, Observations
from loopcal.mechanism import Mechanism, Solution, differentiate_pose, forward
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import FloatArray, IntArray

SHARED = 1e-9
"""Share of a column of G, relative to its largest entry, that counts as no effect on a leg."""


@dataclass(frozen=True, eq=False)
class LegForm:
    """The matrices at one machine.

    Attributes
    ----------
    G : (n, 6, p) change of each leg's length with the parameters.
    S : (n, 6, 6) twist by leg lengths. D : (n, 6, p) twist by parameters.
    members : for each leg, the positions of its parameters.
    """

    G: FloatArray
    S: FloatArray
    D: FloatArray
    members: tuple[IntArray, ...]

    @classmethod
    def at(cls, machine: Mechanism, solution: Solution) -> LegForm:
        """Linearize a machine at solved poses."""
        slopes = differentiate_pose(machine, machine.values[None], solution.q[None], solution.state)
        S, D = slopes.readings[0], slopes.parameters[0]
        G = np.asarray(np.linalg.solve(S, D), dtype=np.float64)
        size = np.abs(G).max(axis=0)
        touched = size > SHARED * size.max(axis=0, keepdims=True)
        members = tuple(np.flatnonzero(row) for row in touched)
        return cls(G, S, D, members)

    def compute_lengths(self, twists: FloatArray) -> FloatArray:
        """Return the changes of leg length (n, 6) [m] that twists (n, 6) mean."""
        return np.asarray(np.linalg.solve(self.S, twists[..., None])[..., 0], dtype=np.float64)

    def fit(self, twists: FloatArray) -> FloatArray:
        """Return the change (p,) of the parameters that fits twists (n, 6) best, leg by leg."""
        lengths, change = self.compute_lengths(twists), np.zeros(self.G.shape[2])
        for leg, members in enumerate(self.members):
            change[members] = np.linalg.lstsq(self.G[:, leg, members], lengths[:, leg])[0]
        return change

    def explain(self, twists: FloatArray) -> FloatArray:
        """Return the share (6,) of each leg's length changes that parameters could explain.

        It is the ratio of norms, and 0 for residuals of least squares.
        """
        lengths, shares = self.compute_lengths(twists), []
        for leg, members in enumerate(self.members):
            q, _ = np.linalg.qr(self.G[:, leg, members])
            explained = np.linalg.norm(q.T @ lengths[:, leg])
            shares.append(float(explained / np.linalg.norm(lengths[:, leg])))
        return np.array(shares)

    @property
    def conditions(self) -> FloatArray:
        """(6,) condition number of each leg's matrix, columns unscaled."""
        columns = [self.G[:, leg, members] for leg, members in enumerate(self.members)]
        return np.array([np.linalg.cond(matrix) for matrix in columns])


@dataclass(frozen=True, eq=False)
class PerLegEstimate:
    """Result of the identification leg by leg.

    Attributes
    ----------
    robot : at the estimated values. estimate_history : (steps + 1, p) parameters after each step
        [SI]. conditions : (6,) condition number of each leg's matrix in the last step.
    is_converged : whether the last step was at most epsilon; always with a fixed number of steps.
    """

    robot: Mechanism
    estimate_history: FloatArray
    conditions: FloatArray
    is_converged: bool = True

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters in the units of the robot file, and the condition numbers."""
        factor, symbols = select_free_parameters(self.robot).display()
        table = zip(self.robot.parameters.entries, self.robot.values, factor, symbols, strict=True)
        rows = [
            {
                "name": p.name,
                "unit": unit,
                "nominal": p.nominal / unit_in_si,
                "estimate": value / unit_in_si,
            }
            for p, value, unit_in_si, unit in table
        ]
        conditions = self.conditions.tolist()
        return {"robot": self.robot.name, "parameters": rows, "conditions": conditions}


def identify_per_leg(
    robot: Mechanism, data: Measurements, steps: int = 3, epsilon: float = 0.0
) -> PerLegEstimate:
    """Identify a hexapod leg by leg by full Gauss-Newton steps.

    Parameters
    ----------
    robot : start values; all parameters free. data : full poses of one kind. steps : at most.
    epsilon : largest component of a step [mm, rad] at which they end; 0 takes all steps.

    Raises
    ------
    EstimationError
        The robot has not six actuators, the data are not full poses in known frames or too few, a
        parameter moves no leg or several, or a pose is out of reach.
    """
    if len(robot.actuators) != 6:
        raise EstimationError(
            f"{robot.name} has {len(robot.actuators)} actuators; identification leg by leg needs "
            "six legs with one actuator each; use identify"
        )
    observations = _select_full_poses(data)
    q = data.readings[observations.rows]
    values, history, conditions = robot.values.copy(), [robot.values.copy()], np.zeros(0)
    units, is_converged = list_raw_units(robot.parameters.dimensions), epsilon == 0.0
    for _ in range(steps):
        machine = robot.with_values(values)
        solution = forward(machine, q)
        if not solution.converged.all():
            raise EstimationError(
                f"{robot.name} cannot reach {int((~solution.converged).sum())} of these poses; "
                "check the readings"
            )
        legs = LegForm.at(machine, solution)
        _check_members(robot, legs, len(q))
        evaluated = observations.kind.evaluate(solution.T[None], observations.measured[None])
        twists = -np.linalg.solve(evaluated.jacobian[0], evaluated.residual[0, :, :, None])[:, :, 0]
        change = legs.fit(twists)
        values = values + change
        history.append(values.copy())
        conditions = legs.conditions
        if epsilon and np.abs(change / units).max() <= epsilon:
            is_converged = True
            break
    machine = robot.with_values(values)
    return PerLegEstimate(machine, np.stack(history), conditions, is_converged)


def _check_members(robot: Mechanism, legs: LegForm, poses: int) -> None:
    """Refuse parameters that do not move exactly one leg, or that these poses do not determine."""
    count = np.zeros(len(robot.parameters), dtype=int)
    for members in legs.members:
        count[members] += 1
    if (count != 1).any():
        name = robot.parameters.names[int(np.argmax(count != 1))]
        raise EstimationError(
            f"{name} moves {int(count[count != 1][0])} legs, not exactly one, so the legs cannot "
            "be identified one by one; use identify"
        )
    most = max(len(members) for members in legs.members)
    if poses < most:
        raise EstimationError(
            f"{poses} poses are too few for the {most} parameters of a leg; measure at least {most}"
        )
    for leg, members in enumerate(legs.members):
        columns = legs.G[:, leg, members]
        scaled = columns / np.linalg.norm(columns, axis=0)
        rank = int(are_nonzero(np.linalg.svd(scaled, compute_uv=False)).sum())
        if rank < len(members):
            raise EstimationError(
                f"these poses determine {rank} of the {len(members)} parameters of leg {leg + 1} "
                "(relative rank tolerance 1e-11); use identify"
            )


def _select_full_poses(data: Measurements) -> Observations:
    """Return the rows of the one kind, which must measure all six coordinates of every pose."""
    kinds = [observations for observations in data.observations if len(observations)]
    if len(kinds) == 1:
        kept = kinds[0].take(kinds[0].weight > 0.0)
        unknown = kept.kind.unknown
        if unknown:
            raise EstimationError(
                f"identification leg by leg needs poses in known frames, but {unknown[0]} is "
                "unknown; use identify"
            )
        if kept.present.shape[1] == 6 and kept.present.all() and len(kept):
            return kept
    raise EstimationError(
        "identification leg by leg needs full poses of one kind; use identify for other data"
    )
