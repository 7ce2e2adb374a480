# SPDX-License-Identifier: Apache-2.0
"""Kind `position`: points of the platform in a frame, as a tracker measures reflectors or a CMM
measures spheres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.geometry import FLATNESS, align_point_sets, solve_frame_and_points, solve_least_squares
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import POSITION_COLUMNS, Column
from loopcal.measure.kinds.points import Prediction, TargetKind
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Position(TargetKind):
    """Positions of one or several targets. Residual: `x_predicted - x_measured` in axes of the
    frame.

    Setup parameters: `frame.rx` to `frame.rz` [rad], `frame.x` to `frame.z` [m], and `target.x`
    to `target.z` [m] of each target.

    Parameters
    ----------
    Those of `TargetKind`; "frame" and "targets" may be unknown.

    Examples
    --------
    >>> kind = Position(targets=("ball",), places=np.array([[0.0, 0.0, 0.1]]), unknown=("targets",))
    >>> [parameter.name for parameter in kind.nuisance_parameters]
    ['ball.x', 'ball.y', 'ball.z']
    >>> kind.measure(np.eye(4)[None, None], noise=np.zeros((1, 1, 3)))
    array([[[0. , 0. , 0.1]]])
    """

    name: ClassVar[str] = "position"
    length_error: ClassVar[str] = "position"
    per_target: ClassVar[tuple[Column, ...]] = POSITION_COLUMNS

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return the tool's origin, an unknown target in an unknown frame, and three targets."""
        corners = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02], [-0.05, -0.08, 0.02]])
        return (
            cls(),
            cls(targets=("reflector",), unknown=("frame", "targets"), frame="tracker"),
            cls(targets=("a", "b", "c"), places=corners),
            cls(targets=("a", "b", "c"), places=corners, unknown=("targets", "frame")),
        )

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return the points themselves."""
        return x, np.eye(3), {}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return frame and targets in closed form; DataError where the frame is unknown and all
        points are collinear.
        """
        if self.is_of_base:
            base = np.broadcast_to(np.eye(4), (len(measured), 4, 4))
            _, _, points, positions = self.collect_points(base, measured)
            if not self.locates_frame or len(positions) < 3:
                return self.nominal_values[None]
            frame = align_point_sets(positions, points)
            return self.assemble_values({"frame": setup.encode_frame(self.T_base_frame, frame)})
        moving, origin, points, positions = self.collect_points(T, measured)
        if not self.unknown or len(positions) < 3:
            return self.nominal_values[None]
        extent = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
        if "frame" in self.unknown and extent[1] <= FLATNESS * extent[0]:
            raise DataError(
                f"the {len(positions)} positions are collinear, so the rotation of the frame "
                f"{self.frame!r} about their line is not determined; measure poses off the line, "
                "or state T_base_frame as known"
            )
        if "targets" not in self.unknown:
            return setup.encode_frame(self.T_base_frame, align_point_sets(positions, points))[None]
        if "frame" in self.unknown:
            frames, places = solve_frame_and_points(positions, moving, origin)
            items = {"frame": setup.encode_frame(self.T_base_frame, frames), "targets": places}
            return self.assemble_values(items)
        base = positions @ self.T_base_frame[:3, :3].T + self.T_base_frame[:3, 3]
        return solve_least_squares(moving.reshape(base.size, -1), (base - origin).ravel())[None]

    @property
    def locates_frame(self) -> bool:
        """Whether stated places of targets on the base are not collinear, so that their measured
        positions determine the frame.
        """
        if not self.is_of_base or self.places is None or "frame" not in self.unknown:
            return False
        extent = np.linalg.svd(self.places - self.places.mean(axis=0), compute_uv=False)
        return len(self.places) > 2 and bool(extent[1] > FLATNESS * extent[0])
