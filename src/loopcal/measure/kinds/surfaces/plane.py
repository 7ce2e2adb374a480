# SPDX-License-Identifier: Apache-2.0
"""Kind `plane`: points of the platform on a plane, such as a probed bed or plate."""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal.geometry.alignment import solve_least_squares
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.points.target_kind import Prediction
from loopcal.measure.kinds.rows import Column
from loopcal.measure.kinds.surfaces.surface_kind import SurfaceKind
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Plane(SurfaceKind):
    """Points on a plane with normal n. Residual: `n'(x - through) - height - gap`.

    An unknown plane has three parameters for each group of rows: two rotations u, v of the normal
    and the height above the stated point.

    Setup parameters: `plane.u`, `plane.v` [rad] and `plane.height` [m], and `target.x` to
    `target.z` [m] of each target.

    Parameters
    ----------
    See `SurfaceKind`.

    Examples
    --------
    >>> kind = Plane(surface="bed", unknown=("surface",), places=np.zeros((1, 3)))
    >>> [parameter.name for parameter in kind.nuisance_parameters]
    ['bed.u', 'bed.v', 'bed.height']
    >>> height = np.array([[[0.0, 0.0, 0.002]]])
    >>> kind.evaluate(np.eye(4)[None, None], np.zeros((1, 1, 1)), height).residual
    array([[[-0.002]]])
    """

    surface: str = "plane"

    name: ClassVar[str] = "plane"
    per_target: ClassVar[tuple[Column, ...]] = (Column("gap", Dimension.LENGTH),)

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known plane, and an unknown one probed with an unknown offset."""
        return (
            cls(),
            cls(
                unknown=("surface", "targets"),
                targets=("probe",),
                along=np.array([0.6, 0.0, 0.8]),
                surface="bed",
            ),
        )

    @property
    def surface_parameters(self) -> tuple[Parameter, ...]:
        """Two rotations and a height."""
        return self.make_parameters(("u", "v"), Dimension.ANGLE) + self.make_parameters(
            ("height",), Dimension.LENGTH
        )

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return heights (.., k, 1) above the plane."""
        surface = self.item_values(values, "surface")
        lever = x - self.through
        if surface is None:
            return lever @ self.along[:, None], self.along[None], {}
        normal = setup.place_direction(self.along, surface[..., :2])[..., None, None, :]
        by_rotation = (
            lever[..., None, :]
            @ setup.linearize_direction(self.along, surface[..., :2])[..., None, :, :]
        )
        height = (normal @ lever[..., None])[..., 0] - surface[..., None, 2:]
        by_surface = np.concatenate([by_rotation, -np.ones_like(by_rotation[..., :1])], axis=-1)
        return height, normal, {"surface": by_surface}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the planes of least scatter, and, where the gaps differ, the one that the gaps
        determine.
        """
        x, gaps = self.collect_contacts(T, measured)
        if "surface" not in self.unknown or len(x) < 3:
            return self.nominal_values[None]
        middle = x.mean(axis=0)
        normals = [np.linalg.svd(x - middle, full_matrices=False)[2][2]]
        gradient = solve_least_squares(x - middle, gaps[:, 0] - gaps.mean())
        if np.linalg.norm(gradient) > 0.1:
            normals.append(gradient / np.linalg.norm(gradient))
        n = np.array([normal if normal @ self.along >= 0.0 else -normal for normal in normals])
        height = n @ (middle - self.through) - gaps.mean()
        values = np.concatenate([setup.encode_direction(self.along, n), height[:, None]], axis=-1)
        return self.assemble_values({"surface": values})
