# SPDX-License-Identifier: Apache-2.0
"""The ten steps of the paper's section 5, one library call for each of them.

 1 nominal poses, nominal parameters, errors          Study
 2 actual poses: inverse kinematics of the nominal,   compute_actual_poses
   forward kinematics of the machine with errors
 3 measured poses: noise added                        draw_measured_poses
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
from loopcal.estimate.published_steps import LegForm, identify_per_leg
from loopcal.geometry import OrientationForm, parse_orientation
from loopcal.measure.instrument import make_random_stream
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, forward, inverse
from loopcal.papers.hexapod_42.published import MM
from loopcal.typing import FloatArray

ORDER = "xyz"
"""R = Rz(gamma) Ry(beta) Rx(alpha), with which Table 4 was made. Equation (2) differs, see
`rank_euler_orders` in table_4_study.py.
"""


@dataclass(frozen=True, eq=False)
class Study:
    """Step 1: the given machine, its errors and the poses.

    Attributes
    ----------
    robot : the machine as designed. truth : with its errors. poses : (n, 6) nominal [m, rad].
    order : Euler order.
    """

    robot: Mechanism
    truth: Mechanism
    poses: FloatArray
    order: str = ORDER

    @cached_property
    def commanded(self) -> Solution:
        """Nominal poses with the leg readings of the nominal machine."""
        return inverse(self.robot, to_transforms(self.poses, self.order))

    def solve_truth(self) -> Solution:
        """Return the poses of the true machine at the readings of the nominal one."""
        return forward(self.truth, self.commanded.q, self.commanded)

    def compute_reached(self, machine: Mechanism) -> FloatArray:
        """Return the poses (n, 6) [m, rad] of a machine at the readings of the nominal one."""
        return to_coordinates(forward(machine, self.commanded.q, self.commanded).T, self.order)


@dataclass(frozen=True, eq=False)
class Iterations:
    """Result of steps 4 to 10. Index k is the state after k iterations, 0 the nominal machine.

    Attributes
    ----------
    machines : (k + 1) corrected machines.
    pose_errors : (k + 1, n, 6) measured minus corrected [m, rad].
    integrated : (k + 1,) max dQint [mm + rad].
    conditions : (6,) condition number of each leg's matrix in the first iteration.
    """

    machines: tuple[Mechanism, ...]
    pose_errors: FloatArray
    integrated: FloatArray
    conditions: FloatArray

    def count_needed(self, threshold: float) -> int | None:
        """Return the iterations until max dQint is at most the threshold; None if it never is."""
        met = np.flatnonzero(self.integrated[1:] <= threshold)
        return int(met[0]) + 1 if len(met) else None

    def compute_parameter_errors(self, truth: Mechanism) -> FloatArray:
        """Return true minus corrected parameters (k + 1, p) [m]."""
        return truth.values - np.stack([machine.values for machine in self.machines])


def compute_actual_poses(study: Study) -> FloatArray:
    """Return the true poses (n, 6) [m, rad] at the readings of the nominal machine: step 2."""
    return study.compute_reached(study.truth)


def draw_measured_poses(
    study: Study, noise: FloatArray | None = None, seed: int = 0, trial: int = 0
) -> FloatArray:
    """Return the true poses (n, 6) with noise uniform in +-`noise` (6,) [m, rad]: step 3.

    Without noise they are exact. The drawn numbers are those of `simulate_trials` for the same
    seed and trial.
    """
    actual = compute_actual_poses(study)
    if noise is None:
        return actual
    drawn = make_random_stream(seed, trial).uniform(-1.0, 1.0, actual.shape)
    return actual + np.roll(drawn, 3, axis=1) * noise  # a kind has its angles first


def iterate(
    study: Study, measured: FloatArray, limit: int = 4, is_renewed: bool = True
) -> Iterations:
    """Run steps 4 to 10 for a fixed number of iterations, beyond the paper's stopping rule too.

    Parameters
    ----------
    study : the given machine. measured : (n, 6) [m, rad]. limit : number of iterations.
    is_renewed : whether the matrix is computed anew at every corrected machine. The paper does not
        say. False keeps the matrix of the nominal machine throughout.

    Raises
    ------
    EstimationError
        A corrected machine cannot reach a pose.
    """
    data = to_measurements(study, measured)
    nominal = LegForm.at(study.robot, study.commanded)
    machines, errors = [study.robot], [subtract_poses(measured, study.poses)]
    conditions = np.zeros(0)
    for k in range(limit):
        if is_renewed or k == 0:
            estimate = identify_per_leg(machines[-1], data, steps=1)
            conditions = estimate.conditions if k == 0 else conditions
            corrected = estimate.robot
        else:
            change = nominal.fit(to_twists(errors[-1], measured, study.order))
            corrected = machines[-1].with_values(machines[-1].values + change)
        machines.append(corrected)
        errors.append(subtract_poses(measured, study.compute_reached(corrected)))
    stacked = np.stack(errors)
    return Iterations(tuple(machines), stacked, integrate_errors(stacked), conditions)


def to_measurements(
    study: Study, measured: FloatArray, sigma: FloatArray | float = 1.0
) -> Measurements:
    """Return measured poses (n, 6) [m, rad] as measurements.

    Parameters
    ----------
    sigma : one for all values, or (n, 6) [m, rad].
    """
    kind = Pose(f"euler-{study.order}").with_tool(study.robot.tool)
    sd = sigma if isinstance(sigma, float) else np.roll(sigma, 3, axis=1)
    rows = Observations.from_sigma(kind, np.arange(len(measured)), np.roll(measured, 3, axis=1), sd)
    labels = tuple(f"A{i + 1}" for i in range(len(measured)))
    return Measurements(study.robot.name, study.commanded.q, (rows,), labels=labels)


def integrate_errors(errors: FloatArray) -> FloatArray:
    """Return the largest integrated error dQint (k,) [mm + rad] of errors (k, n, 6) [m, rad].

    Equations (15) to (17): dQint = |(dx, dy, dz)| [mm] + |(dalpha, dbeta, dgamma)| [rad]. The index
    adds millimeters and radians as they are, so it exists in this paper only.
    """
    lengths, angles = (np.linalg.norm(part, axis=2) for part in (errors[..., :3], errors[..., 3:]))
    return (lengths / MM + angles).max(axis=1)


def to_transforms(poses: FloatArray, order: str) -> FloatArray:
    """Return transforms (n, 4, 4) of poses (n, 6) [m, rad]."""
    return geometry.make_pose(name_orientation(order).to_matrix(poses[:, 3:]), poses[:, :3])


def to_coordinates(T: FloatArray, order: str) -> FloatArray:
    """Return coordinates (n, 6) [m, rad] of transforms (n, 4, 4)."""
    angles = name_orientation(order).from_matrix(T[:, :3, :3])
    return np.concatenate([T[:, :3, 3], angles], axis=1)


def subtract_poses(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return differences (n, 6) of coordinates, angles wrapped."""
    change = first - second
    return np.concatenate([change[:, :3], geometry.wrap_angle(change[:, 3:])], axis=1)


def name_orientation(order: str) -> OrientationForm:
    """Return the Euler angles of this order."""
    return parse_orientation(f"euler-{order}")


def to_twists(errors: FloatArray, poses: FloatArray, order: str) -> FloatArray:
    """Return twists (n, 6), rotation first, of coordinate errors (n, 6) [m, rad] near poses."""
    omega = name_orientation(order).rates(poses[:, 3:]) @ errors[:, 3:, None]
    return np.concatenate([omega[..., 0], errors[:, :3]], axis=1)
