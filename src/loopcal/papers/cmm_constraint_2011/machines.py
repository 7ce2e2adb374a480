# SPDX-License-Identifier: Apache-2.0
"""The robot, its points, true machines, and the errors that judge a calibration.

Robot and workspace are ours, those of the robot file hexapod-nategh-agheli: the paper's Tables 1
and 2 are not in our text.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.estimate.plane_line_products import Layout
from loopcal.measure.instrument import make_random_stream
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.mechanism.solutions import Solution
from loopcal.mechanism.workspace import sample_workspace
from loopcal.papers.cmm_constraint_2011.published import MM
from loopcal.planning.exchange import MovedDesign
from loopcal.planning.plane_line_planning import PlaneLineGroups, improve_groups
from loopcal.typing import FloatArray

ROBOT = "hexapod-nategh-agheli"
GROUPS, POINTS = 10, 10
"""Planes with a line each, and points of each: the paper's 100 positions."""
AXES = ("z",)
"""Along which lines run, as the paper describes it: planes of equal z."""
SWEEPS = 3
HELD_OUT = 100
"""Random poses over which errors are taken, as in the paper."""
TRUTH = 1  # purpose of a random stream
MEASURES = (
    "position [mm]",
    "orientation [deg]",
    "position, aligned [mm]",
    "orientation, aligned [deg]",
    "parameters [mm]",
    "parameters without gauge [mm]",
    "position, gauge at nominal [mm]",
)
"""Root mean squares over the held-out poses, and the 2-norm of the errors of the 42 parameters."""
ABSOLUTE, AT_NOMINAL, ALIGNED = FRAMES = ("absolute", "gauge at nominal", "aligned")
"""Placements of the base and the rotation of the platform, which plane and line do not determine:
as the least deviation leaves them; with poses nearest to the nominal ones, which needs no truth;
with poses nearest to the true ones.
"""

GAUGE_NAMES = tuple(
    f"{what} {axis}"
    for what in ("base shifted along", "base rotated about", "platform rotated about")
    for axis in POSITION
)
"""The nine directions of the 42 parameters that plane and line cannot determine, k = x, y, z:

    base shifted along k      db_i = k             the end point moves along k everywhere
    base rotated about k      db_i = k x b_i       it rotates about the base's origin everywhere
    platform rotated about k  dp_i = k x p_i       it does not move at all

The first six move all points as one body, which changes no distance and no angle between them.
"""


@dataclass(frozen=True, eq=False)
class HeldOutPoses:
    """Poses that were not measured, at which identified machines are compared with true ones.

    Attributes
    ----------
    robot : as designed. solution : 100 random poses of its workspace, as it is commanded to them.
    """

    robot: Mechanism
    solution: Solution

    def solve(self, values: FloatArray) -> FloatArray:
        """Return the poses (t, n, 4, 4) of machines (t, p) at the readings."""
        return forward_trials(self.robot, values, self.solution.q[None], self.solution.state).T

    def align(self, T: FloatArray, true: FloatArray, frame: str) -> FloatArray:
        """Return poses (t, n, 4, 4) in one of FRAMES."""
        if frame == ABSOLUTE:
            return T
        return fit_motions(
            T, true if frame == ALIGNED else np.broadcast_to(self.solution.T, true.shape)
        )

    def compute_twists(self, values: FloatArray, true: FloatArray, frame: str) -> FloatArray:
        """Return differences (t, n, 6) [rad, m], rotation first, of the poses of machines (t | 1,
        p) from true ones (t, n, 4, 4).

        In one of FRAMES.
        """
        return geometry.pose_difference(
            self.align(np.broadcast_to(self.solve(values), true.shape), true, frame), true
        )

    def compute_errors(self, values: FloatArray, truth: FloatArray, true: FloatArray) -> FloatArray:
        """Return errors (t, 7), see MEASURES; values (t | 1, p) and truth (t, p) [m], true (t, n,
        4, 4) the `poses` of the truth.
        """
        T = np.broadcast_to(self.solve(values), true.shape)
        errors = {}
        for frame in FRAMES:
            squares = np.mean(
                geometry.pose_difference(self.align(T, true, frame), true) ** 2, axis=1
            )
            errors[frame] = [
                np.sqrt(squares[:, 3:].sum(axis=1)) / MM,
                np.rad2deg(np.sqrt(squares[:, :3].sum(axis=1))),
            ]
        wrong = values - truth
        lengths = (np.linalg.norm(e, axis=1) / MM for e in (wrong, remove_gauge(self.robot, wrong)))
        return np.stack(
            [*errors[ABSOLUTE], *errors[ALIGNED], *lengths, errors[AT_NOMINAL][0]], axis=1
        )


@dataclass(frozen=True, eq=False)
class Study:
    """The robot, the points it is sent to, and the poses at which it is judged.

    Attributes
    ----------
    planned : how groups are written as designs. first, optimized : before and after coordinate
        exchange. seed : of both.
    """

    robot: Mechanism
    planned: PlaneLineGroups
    first: FloatArray
    optimized: MovedDesign
    seed: int

    @cached_property
    def layout(self) -> Layout:
        """The measured points."""
        return Layout(self.robot, self.planned.place_points(self.optimized.design))

    @cached_property
    def held_out(self) -> HeldOutPoses:
        """Held-out poses, drawn with another seed than the points."""
        poses = sample_workspace(self.robot, HELD_OUT, self.seed + 1)
        return HeldOutPoses(self.robot, poses.solution)


def load_machine() -> Mechanism:
    """Return the hexapod as designed."""
    from loopcal.io.robot.robot_file import load_robot

    return load_robot(ROBOT)


def plan_points(
    robot: Mechanism, groups: int, points: int, axes: tuple[str, ...], seed: int, sweeps: int
) -> Study:
    """Draw groups at random and improve log det of their information by coordinate exchange.

    With 0 sweeps they stay as drawn.
    """
    planned = PlaneLineGroups(robot, points, MM, axes)
    first = planned.draw(groups, seed)
    return Study(robot, planned, first, improve_groups(planned, first, sweeps), seed)


def compute_spread(rows: FloatArray) -> float:
    """Return the rms standard deviation of the identifiable directions [mm per mm of noise].

    The rows are those for a noise of 1 mm.
    """
    s = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), compute_uv=False)
    s = s[s > 1e-10 * s[0]]
    return float(np.sqrt(np.mean(1.0 / s**2)))


def draw_true_machines(
    robot: Mechanism, sd: float, trials: int, seed: int, is_gauge_free: bool = False
) -> FloatArray:
    """Return nominal values (t, p) [m] with Gaussian errors.

    Machine i has the same errors, scaled, for any sd and number of trials.
    """
    drawn = np.stack(
        [
            make_random_stream(seed, trial, TRUTH).standard_normal(len(robot.parameters))
            for trial in range(trials)
        ]
    )
    return robot.parameters.nominal + sd * (remove_gauge(robot, drawn) if is_gauge_free else drawn)


def fit_motions(T: FloatArray, others: FloatArray) -> FloatArray:
    """Return poses (t, n, 4, 4) after the motion of the base and the turn of the platform that
    bring them nearest to others.

    Positions fix the base's motion (their least squares), then orientations the platform's turn
    (nearest rotations): what plane and line leave open, and nothing else.
    """
    x, y = T[..., :3, 3], others[..., :3, 3]
    middle, centre = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    Q = find_nearest_rotations(np.swapaxes(y - centre, 1, 2) @ (x - middle))
    R = Q[:, None] @ T[..., :3, :3]
    turn = find_nearest_rotations(np.sum(np.swapaxes(R, 2, 3) @ others[..., :3, :3], axis=1))
    return geometry.make_pose(R @ turn[:, None], (x - middle) @ np.swapaxes(Q, 1, 2) + centre)


def find_nearest_rotations(M: FloatArray) -> FloatArray:
    """Return the rotations (t, 3, 3) nearest to matrices (t, 3, 3), in the mean square of their
    entries.
    """
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return U @ Vt


def list_gauge_directions(robot: Mechanism) -> FloatArray:
    """Return changes (9, p) of the parameters, see GAUGE_NAMES, [m per m] and [m per rad]."""
    table = robot.parameters
    names = [leg.name for leg in robot.assembly.limbs]
    changes = np.zeros((9, len(table)))
    for leg in names:
        base, platform = (
            [table.index(f"{leg}.{end}.{axis}") for axis in POSITION]
            for end in ("base", "platform")
        )
        changes[0:3, base] = np.eye(3)
        changes[3:6, base] = np.cross(np.eye(3), robot.values[base])
        changes[6:9, platform] = np.cross(np.eye(3), robot.values[platform])
    return changes


def remove_gauge(robot: Mechanism, deviation: FloatArray) -> FloatArray:
    """Return deviations (.., p) [m] without their part along the nine directions."""
    basis = np.linalg.qr(list_gauge_directions(robot).T)[0]
    return deviation - (deviation @ basis) @ basis.T
