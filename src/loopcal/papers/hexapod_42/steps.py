# SPDX-License-Identifier: Apache-2.0
"""The ten steps of the paper's section 5, one function of this library for each of them.

 1 nominal poses, nominal parameters, errors          Study
 2 actual poses: inverse kinematics of the nominal,   actual_poses
   forward kinematics of the machine with errors
 3 measured poses: noise added                        measured_poses
 4 pose errors: measured minus nominal                \
 5 parameter errors, least squares leg by leg          |
 6 corrected parameters                                |  iterate
 7 corrected poses by forward kinematics               |
 8 corrected pose errors: measured minus corrected     |
 9 max dQint <= epsilon?                               |
10 if not, on from step 5 with the corrected errors   /

Least squares is `identify_per_leg`, one step at a time, every equation of weight one and every
parameter of scale one. Poses are (x, y, z, alpha, beta, gamma) [m, rad] in the paper's order.
Derivation: docs/theory/hexapod.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.diagnose import compute_pose_errors
from loopcal.geometry import OrientationForm, parse_orientation
from loopcal.measure import Measurements, Observations, Pose, make_random_stream
from loopcal.mechanism import Mechanism, Solution, forward, inverse
from loopcal.papers.hexapod_42.leg_form import LegForm
from loopcal.papers.per_leg import identify_per_leg
from loopcal.typing import FloatArray

ORDER = "xyz"
"""R = Rz(gamma) Ry(beta) Rx(alpha), with which Table 4 was made; not what equation (2) says, see
`orders` in studies.py.
"""


@dataclass(frozen=True, eq=False)
class Study:
    """Step 1: what is given.

    Attributes
    ----------
    robot : the machine as designed. truth : with its errors. poses : (n, 6) nominal [m, rad]. order
        : Euler order.
    """

    robot: Mechanism
    truth: Mechanism
    poses: FloatArray
    order: str = ORDER

    @cached_property
    def commanded(self) -> Solution:
        """Nominal poses and the leg readings that the nominal machine answers them with."""
        return inverse(self.robot, transforms(self.poses, self.order))

    def reached(self, machine: Mechanism) -> FloatArray:
        """(n, 6) poses [m, rad] of a machine at the readings of the nominal one."""
        return coordinates(forward(machine, self.commanded.q, self.commanded).T, self.order)


@dataclass(frozen=True, eq=False)
class Iterations:
    """What steps 4 to 10 yield; index k is the state after k iterations, 0 the nominal machine.

    Attributes
    ----------
    machines : (k + 1) corrected machines. pose_errors : (k + 1, n, 6) measured minus corrected [m,
        rad].
    integrated : (k + 1,) max dQint [mm + rad]. conditions : (6,) condition of each leg's matrix in
        the first iteration.
    """

    machines: tuple[Mechanism, ...]
    pose_errors: FloatArray
    integrated: FloatArray
    conditions: FloatArray

    def needed(self, threshold: float) -> int | None:
        """Iterations until max dQint is at most the threshold; None where it never is."""
        met = np.flatnonzero(self.integrated[1:] <= threshold)
        return int(met[0]) + 1 if len(met) else None

    def parameter_errors(self, truth: Mechanism) -> FloatArray:
        """(k + 1, p) true minus corrected parameters [m]."""
        return truth.values - np.stack([machine.values for machine in self.machines])


def actual_poses(study: Study) -> FloatArray:
    """Step 2: (n, 6) true poses [m, rad] at the readings with which the nominal machine answers the
    nominal poses.
    """
    return study.reached(study.truth)


def measured_poses(
    study: Study, noise: FloatArray | None = None, seed: int = 0, trial: int = 0
) -> FloatArray:
    """Step 3: (n, 6) true poses with noise uniform in +-`noise` (6,) [m, rad]; none: exact.

    The numbers drawn are those of `simulate_trials` for the same seed and trial.
    """
    actual = actual_poses(study)
    if noise is None:
        return actual
    drawn = make_random_stream(seed, trial).uniform(-1.0, 1.0, actual.shape)
    return actual + np.roll(drawn, 3, axis=1) * noise  # a kind has its angles first


def iterate(study: Study, measured: FloatArray, limit: int = 4, renewed: bool = True) -> Iterations:
    """Steps 4 to 10: a fixed number of iterations, so that what happens after the rule is met is
    seen too.

    Parameters
    ----------
    study : what is given. measured : (n, 6) [m, rad]. limit : number of iterations.
    renewed : whether the matrix is made anew at every corrected machine; the paper does not say.
        False: that of the nominal machine throughout.

    Raises
    ------
    EstimationError
        A corrected machine cannot reach a pose.
    """
    data = measurements(study, measured)
    fixed = None if renewed else LegForm.at(study.robot, study.commanded)
    machines, errors, conditions = [study.robot], [difference(measured, study.poses)], np.zeros(0)
    for k in range(limit):
        if fixed is None or k == 0:
            found = identify_per_leg(machines[-1], data, steps=1)
            conditions = found.conditions if k == 0 else conditions
            corrected = found.robot
        else:
            change = fixed.change(twists(errors[-1], measured, study.order))
            corrected = machines[-1].with_values(machines[-1].values + change)
        machines.append(corrected)
        errors.append(difference(measured, study.reached(corrected)))
    stacked = np.stack(errors)
    return Iterations(tuple(machines), stacked, integrated(stacked), conditions)


def measurements(
    study: Study, measured: FloatArray, sigma: FloatArray | float = 1.0
) -> Measurements:
    """Measured poses (n, 6) [m, rad] as measurements, with a sigma of one unless sigmas (n, 6) [m,
    rad] are given.
    """
    kind = Pose(form_name(study.order)).with_tool(study.robot.tool)
    sd = sigma if isinstance(sigma, float) else np.roll(sigma, 3, axis=1)
    rows = Observations.from_sigma(kind, np.arange(len(measured)), np.roll(measured, 3, axis=1), sd)
    labels = tuple(f"A{i + 1}" for i in range(len(measured)))
    return Measurements(study.robot.name, study.commanded.q, (rows,), labels=labels)


def integrated(errors: FloatArray) -> FloatArray:
    """Largest dQint (k,) [mm + rad] over the poses of errors (k, n, 6) [m, rad]: equations (15) to
    (17).
    """
    return np.array(
        [compute_pose_errors(e[:, :3], e[:, 3:]).statistics("integrated").max for e in errors]
    )


def transforms(poses: FloatArray, order: str) -> FloatArray:
    """(n, 4, 4) of poses (n, 6) [m, rad]."""
    return geometry.make_pose(form(order).to_matrix(poses[:, 3:]), poses[:, :3])


def coordinates(T: FloatArray, order: str) -> FloatArray:
    """(n, 6) [m, rad] of poses (n, 4, 4)."""
    return np.concatenate([T[:, :3, 3], form(order).from_matrix(T[:, :3, :3])], axis=1)


def difference(first: FloatArray, second: FloatArray) -> FloatArray:
    """Differences (n, 6) of coordinates, angles wrapped."""
    change = first - second
    return np.concatenate([change[:, :3], geometry.wrap_angle(change[:, 3:])], axis=1)


def form(order: str) -> OrientationForm:
    """Euler angles of this order."""
    return parse_orientation(form_name(order))


def form_name(order: str) -> str:
    """As measurement files call it."""
    return f"euler-{order}"


def twists(errors: FloatArray, poses: FloatArray, order: str) -> FloatArray:
    """Twists (n, 6), rotation first, of errors (n, 6) [m, rad] of coordinates near poses (n, 6)."""
    omega = form(order).rates(poses[:, 3:]) @ errors[:, 3:, None]
    return np.concatenate([omega[..., 0], errors[:, :3]], axis=1)
