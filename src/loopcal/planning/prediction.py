# SPDX-License-Identifier: Apache-2.0
"""Prediction that a plan improves: the pose of the tool all over the workspace, and its errors.

    d tool = (size * rotation, displacement)      [m]

in a stated frame, see `loopcal.diagnose.error_frames`: after the best rigid fit of the base and
platform frames as far as no measurement of this instrument determines them. Derivation:
docs/theory/gauge.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.apply.accuracy import transport
from loopcal.diagnose.error_frames import (
    BASE,
    FITTED,
    RELATIVE,
    ErrorFrame,
    ReferencePoses,
    check_frame,
    follow_pose,
    refer_errors,
    solve_home,
)
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.information import observe_poses
from loopcal.findings import Quantity, report_finding
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution
from loopcal.planning.constraints import Target
from loopcal.typing import FloatArray
from loopcal.units import Dimension

FRAMES = (FITTED, BASE, RELATIVE)  # frames in which a plan can state errors
DIMENSIONS: dict[Target, Dimension] = {  # of the error of each target
    "pose": Dimension.LENGTH,
    "position": Dimension.LENGTH,
    "orientation": Dimension.ANGLE,
}


@dataclass(frozen=True, eq=False)
class Prediction:
    """Derivatives of the tool's pose at k poses of the workspace."""

    rotations: FloatArray  # (k, 3, p) derivatives of its rotation [rad per tolerance]
    displacements: FloatArray  # (k, 3, p) derivatives of its displacement [m per tolerance]
    size: float  # makes rotations comparable with displacements [m]
    frame: ErrorFrame  # in which errors are stated

    def __len__(self) -> int:
        return len(self.displacements)

    @property
    def position(self) -> FloatArray:
        """Rows (3 k, p) of positions [m]."""
        return self.displacements.reshape(-1, self.displacements.shape[2])

    @property
    def orientation(self) -> FloatArray:
        """Rows (3 k, p) of orientations [rad]."""
        return self.rotations.reshape(-1, self.rotations.shape[2])

    @property
    def pose(self) -> FloatArray:
        """Rows (6 k, p) of poses [m], rotations times size."""
        return np.concatenate([self.size * self.orientation, self.position])


def linearize_prediction(
    free: FreeParameters, solution: Solution, unfixed: FloatArray, frame: str = FITTED
) -> Prediction:
    """Return how the tool's pose depends on the parameters, in a frame of FRAMES.

    solution : the poses to predict. unfixed : (12, k) motions of frames that the measurements will
        not determine; "fitted" is after the best rigid fit of them over the poses to predict.
    """
    check_frame(frame, FRAMES)
    poses = observe_poses(free, solution.q)
    T, twists = poses.T[0, poses.is_reached], poses.twists[0, poses.is_reached]
    followed = None
    if frame == RELATIVE:
        home = observe_poses(free, solve_home(free.robot).q)
        own = np.zeros((6, 0))
        followed = follow_pose(free.robot, home.T[0, 0], home.twists[0, 0], own, "home")
    chosen = refer_errors(
        free.robot, frame, ReferencePoses(T, twists, "predicted"), unfixed, followed
    )
    if chosen.undetermined and free.assumed.any():
        missing = int(free.assumed.sum())
        raise EstimationError(
            report_finding("plan.frame-unbounded", frames=chosen.undetermined, missing=missing)
        )
    kept = transport(free.robot, T, "base", "tool") @ chosen.relate(twists, T)
    return Prediction(kept[:, :3], kept[:, 3:], free.robot.size, chosen)


@dataclass(frozen=True, eq=False)
class ExpectedErrors:
    """Predicted errors of the tool, root mean square over the workspace."""

    position: float  # [m]
    orientation: float  # [rad]

    def select(self, target: Target, size: float) -> float:
        """Return the error of a target [m, rad]; of a pose with rotations times `size` [m]."""
        if target == "pose":
            return float(np.hypot(self.position, size * self.orientation))
        return self.position if target == "position" else self.orientation

    def to_quantities(self, robot: Mechanism) -> tuple[Quantity, ...]:
        """Return the errors above 0 in the units of the robot's file."""
        pairs = ((self.position, Dimension.LENGTH), (self.orientation, Dimension.ANGLE))
        return tuple(
            robot.to_quantity(value, dimension) for value, dimension in pairs if value > 0.0
        )
