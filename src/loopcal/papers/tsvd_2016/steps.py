# SPDX-License-Identifier: Apache-2.0
"""The nine steps of the paper, for t machines or t settings of lambda and k at once.

 1 nominal parameters, e = 0                          `load_machine`                 \
 2 forward kinematic model                            `forward_trials`                |
 3 measured poses                                     `list_measured_poses`          | machines.py
 4 measured data: true machine, with noise            `simulate_trials`               /
 5 error transfer matrix T_j of pose j                `differentiate_pose`, x y z phi theta (psi)
 6 identification matrix H, all T_j in one column     `make_raw_problem`: one triangular factor
 7 de from H de = D, by LS, RE or TSVD                `take_steps`, with the filter factors below
 8 e + de; again from step 5 unless |de| is small     `take_steps`
 9 save e

Raw numbers as in the paper: millimeters and radians, every equation and every parameter of weight
one, and the filter acts on the step. With H = U S V' and s_i = S_ii the step is de = sum f_i (u_i'D
/ s_i) v_i, where f_i = 1 for LS, s_i^2 / (s_i^2 + lambda) for RE, and 1 for i <= k, else 0, for
TSVD.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.published_steps import (
    AHEAD,
    LIMIT,
    RawSteps,
    StepRule,
    list_raw_units,
    take_steps,
)
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.papers.tsvd_2016.machines import Study
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Iterations(RawSteps):
    """Result of the steps for t settings. machine : (t,) which machine was measured."""

    machine: IntArray


def iterate(
    study: Study,
    penalty: FloatArray,
    machine: IntArray | None = None,
    limit: int = LIMIT,
    ahead: float = AHEAD,
) -> Iterations:
    """Run steps 5 to 9.

    Parameters
    ----------
    study : the machines. penalty : (t | 1, p) of each setting, see above.
    machine : (t,) which machine was measured; default: the first. limit, ahead : see `StepRule`.
    """
    machine = np.zeros(len(penalty), dtype=np.int64) if machine is None else machine
    rule = StepRule(limit=limit, ahead=ahead)
    return Iterations(**vars(take_steps(study.raw.take(machine), penalty, rule)), machine=machine)


def linearize(
    study: Study, values: FloatArray, machine: IntArray
) -> tuple[Decomposition, BoolArray]:
    """Return the decomposition of H (steps 5 and 6), and which settings (a,) reach all poses.

    Parameters
    ----------
    values : (a, p) corrected parameters [SI]. machine : (a,) which of the machines was measured.
    """
    return study.raw.take(machine).linearize(values)


def list_scales(robot: Mechanism) -> FloatArray:
    """Return the paper's units (p,) in SI: millimeters and radians."""
    return list_raw_units(robot.parameters.dimensions)
