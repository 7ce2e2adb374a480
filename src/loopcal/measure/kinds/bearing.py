# SPDX-License-Identifier: Apache-2.0
"""Kind `bearing`: two angles of a point from a station, measured by a theodolite or a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.geometry import solve_resection
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Column
from loopcal.measure.kinds.points import (
    Prediction,
    TargetKind,
    convert_camera_angles,
    predict_camera_angles,
)
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Bearing(TargetKind):
    """Two angles of each target. Residual: differences of angles, wrapped.

    Theodolite: `azimuth = atan2(y, x)`, `elevation = atan2(z, hypot(x, y))`. Camera, whose optical
    axis is z: `azimuth = atan2(x, z)`, `elevation = atan2(y, z)`.

    Setup parameters: those of `Position`.

    Parameters
    ----------
    form : "theodolite" or "camera".
    Others : see `TargetKind`; "frame" (the station) and "targets" may be unknown.

    Examples
    --------
    >>> kind = Bearing(places=np.array([[1.0, 1.0, 0.0]]))
    >>> kind.measure(np.eye(4)[None, None], noise=np.zeros((1, 1, 2))).round(6)
    array([[[0.785398, 0.      ]]])
    """

    form: str = "theodolite"

    name: ClassVar[str] = "bearing"
    per_target: ClassVar[tuple[Column, ...]] = (
        Column("azimuth", Dimension.ANGLE),
        Column("elevation", Dimension.ANGLE),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.form not in ("theodolite", "camera"):
            raise DataError(f"the form of a bearing is {self.form!r}; use theodolite or camera")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a theodolite, a camera at an unknown station, and two targets."""
        station = geometry.make_pose(np.eye(3), np.array([-1.5, -0.8, 0.1]))
        behind = geometry.make_pose(np.eye(3), np.array([0.1, -0.1, -2.5]))
        pair = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])
        return (
            cls(T_base_frame=station),
            cls(T_base_frame=behind, form="camera", unknown=("frame",), frame="camera"),
            cls(
                targets=("a", "b"),
                places=pair,
                T_base_frame=station,
                unknown=("frame", "targets"),
                frame="station",
            ),
        )

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return both angles."""
        if self.form == "camera":
            return (*predict_camera_angles(x), {})
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        flat = a * a + b * b
        reach, level = flat + c * c, np.sqrt(flat)
        # a target straight above or below the station has an azimuth without a slope: NaN, by
        # which a fit refuses the row
        with np.errstate(invalid="ignore", divide="ignore"):
            slopes = [
                np.stack([-b / flat, a / flat, np.zeros_like(a)], axis=-1),
                np.stack([-a * c / level, -b * c / level, level], axis=-1) / reach[..., None],
            ]
        angles = np.stack([np.arctan2(b, a), np.arctan2(c, level)], axis=-1)
        return angles, np.stack(slopes, axis=-2), {}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the station by resection, with the targets at their stated places."""
        _, _, points, angles = self.collect_points(T, measured)
        if "frame" not in self.unknown or len(angles) < 4 or self.is_of_base:
            return self.nominal_values[None]
        rays = convert_camera_angles(angles)
        if self.form == "theodolite":
            (azimuth, elevation), level = angles.T, np.cos(angles[:, 1])
            rays = np.stack(
                [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1
            )
        frames = solve_resection(rays, points)
        return self.assemble_values({"frame": setup.encode_frame(self.T_base_frame, frames)})
