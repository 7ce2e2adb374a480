# SPDX-License-Identifier: Apache-2.0
"""Kind `position`: points of the platform in a frame, as a tracker sees reflectors or a CMM touches
spheres.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.closed_form import FLAT, frame_and_points, kabsch, linear
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Column
from loopcal.measure.kinds.target import TargetKind, points_of
from loopcal.measure.kinds.tool import position_columns, stacked
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Position(TargetKind):
    """Positions of one or several targets. Residual: `x_predicted - x_measured` in axes of the
    frame.

    Parameters
    ----------
    See `TargetKind`; "frame" and "targets" may be unknown.
    """

    name: ClassVar[str] = "position"
    per_target: ClassVar[tuple[Column, ...]] = position_columns()

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """The tool's origin, an unknown target in an unknown frame, and three targets in one row."""
        corners = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02], [-0.05, -0.08, 0.02]])
        return (
            cls(),
            cls(targets=("reflector",), unknown=("frame", "targets"), frame="tracker"),
            cls(targets=("a", "b", "c"), places=corners),
            cls(targets=("a", "b", "c"), places=corners, unknown=("targets", "frame")),
        )

    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """The points themselves."""
        return x, np.eye(3), {}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Frame and targets in closed form.

        Raises
        ------
        DataError
            If all points lie on a line, about which an unknown frame could turn.
        """
        moving, origin, points, seen = points_of(self, T, measured)
        if not self.unknown or len(seen) < 3:
            return self.nominal_values[None]
        extent = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
        if "frame" in self.unknown and extent[1] <= FLAT * extent[0]:
            raise DataError(
                f"the {len(seen)} positions lie on a line, about which the frame {self.frame!r} "
                "could turn; measure poses off"
                " the line, or state T_base_frame as known"
            )
        if "targets" not in self.unknown:
            return parts.frame_values(self.T_base_frame, kabsch(seen, points))[None]
        if "frame" in self.unknown:
            frames, places = frame_and_points(seen, moving, origin)
            found = {"frame": parts.frame_values(self.T_base_frame, frames), "targets": places}
            return stacked(self, found, len(frames))
        base = seen @ self.T_base_frame[:3, :3].T + self.T_base_frame[:3, 3]
        return linear(moving.reshape(base.size, -1), (base - origin).ravel())[None]
