# SPDX-License-Identifier: Apache-2.0
"""Kind `plane`: points of the platform that lie on a plane, as when a bed or a plate is probed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.measure.closed_form import linear
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Column
from loopcal.measure.kinds.surface import SurfaceKind
from loopcal.measure.kinds.tool import stacked
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class Plane(SurfaceKind):
    """Points on a plane with normal n. Residual: `n'(x - through) - height - gap`.

    Unknown are two turns u, v of the normal and the height above the stated point, one set for each
    group of rows.

    Parameters
    ----------
    See `SurfaceKind`.
    """

    surface: str = "plane"

    name: ClassVar[str] = "plane"
    per_target: ClassVar[tuple[Column, ...]] = (Column("gap", Dimension.LENGTH),)

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """A known plane, and an unknown one touched by a probe of unknown offset."""
        return (
            cls(),
            cls(
                unknown=("surface", "targets"),
                targets=("probe",),
                along=np.array([0.6, 0.0, 0.8]),
                surface="bed",
            ),
        )

    def own_item(self, name: str) -> tuple[Parameter, ...]:
        """Two turns and a height."""
        height = Parameter(f"{self.surface}.height", Dimension.LENGTH, 0.0, scope="group")
        return (*parts.direction_part(self.surface, "group"), height)

    def predict(
        self, x: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, Mapping[str, FloatArray]]:
        """Heights (.., k, 1) above the plane."""
        own = self.item_values(values, "surface")
        lever = x - self.through
        if own is None:
            return lever @ self.along[:, None], self.along[None], {}
        normal = parts.direction_at(self.along, own[..., :2])[..., None, None, :]
        turning = (
            lever[..., None, :] @ parts.direction_slope(self.along, own[..., :2])[..., None, :, :]
        )
        height = (normal @ lever[..., None])[..., 0] - own[..., None, 2:]
        return (
            height,
            normal,
            {"surface": np.concatenate([turning, -np.ones_like(turning[..., :1])], axis=-1)},
        )

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """The plane through the points: with least scatter across, or by the gaps where they
        differ.
        """
        x, gaps = self.touched(T, measured)
        if "surface" not in self.unknown or len(x) < 3:
            return self.nominal_values[None]
        middle = x.mean(axis=0)
        normals = [np.linalg.svd(x - middle, full_matrices=False)[2][2]]
        sloped = linear(x - middle, gaps[:, 0] - gaps.mean())
        if np.linalg.norm(sloped) > 0.1:
            normals.append(sloped / np.linalg.norm(sloped))
        n = np.array([normal if normal @ self.along >= 0.0 else -normal for normal in normals])
        height = n @ (middle - self.through) - gaps.mean()
        values = np.concatenate([parts.direction_values(self.along, n), height[:, None]], axis=-1)
        return stacked(self, {"surface": values}, len(n))
