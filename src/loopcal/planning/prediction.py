# SPDX-License-Identifier: Apache-2.0
"""Prediction that a plan improves: the pose of the tool all over the workspace, and its errors.

    d tool = (size * rotation, displacement)      [m]

without the rigid motions of a frame that no measurement of this instrument determines: the frame
then is the one that the estimate defines. Derivation: docs/theory/gauge.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.apply.accuracy import transport
from loopcal.diagnose import find_frame_motions
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.information import observe_poses
from loopcal.findings import Quantity
from loopcal.mechanism import Mechanism, Solution
from loopcal.numerics.decomposition import Decomposition
from loopcal.planning.options import Target
from loopcal.typing import FloatArray
from loopcal.units import Dimension

DIMENSIONS: dict[Target, Dimension] = {
    "pose": Dimension.LENGTH,
    "position": Dimension.LENGTH,
    "orientation": Dimension.ANGLE,
}
"""Dimension of the error of each target."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Derivatives of the tool's pose at k poses of the workspace.

    Attributes
    ----------
    rotations, displacements : (k, 3, p) derivatives of its rotation [rad] and displacement [m] by
        the parameters in tolerances.
    size : makes rotations comparable with displacements [m].
    frames : names of the frames whose rigid motions are left out.
    """

    rotations: FloatArray
    displacements: FloatArray
    size: float
    frames: tuple[str, ...]

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
    free: FreeParameters, solution: Solution, observable: Decomposition
) -> Prediction:
    """Return how the tool's pose depends on the parameters.

    Parameters
    ----------
    solution : the poses to predict. observable : of `decompose_information`.
    """
    poses = observe_poses(free, solution.q)
    tool_twists = transport(free.robot, poses.T[0], "base", "tool") @ poses.twists[0]
    used, V = observable.used[0], observable.directions[0]
    variance = np.where(used, 1.0, np.where(free.assumed.any(), np.inf, 1.0))
    posterior = Posterior(free.robot, free.places, free.tolerance, V, variance, used)
    motions = find_frame_motions(posterior)
    # P removes rigid motions of frames from a deviation and leaves the rest as it is
    P = V[:, used] @ V[:, used].T + motions.kept @ V[:, ~used].T
    kept = tool_twists[poses.is_reached] @ P
    return Prediction(kept[:, :3], kept[:, 3:], free.robot.size, motions.frames)


@dataclass(frozen=True, eq=False)
class ExpectedErrors:
    """Predicted errors of the tool, root mean square over the workspace.

    Attributes
    ----------
    position [m], orientation [rad].
    """

    position: float
    orientation: float

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
