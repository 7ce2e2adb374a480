# SPDX-License-Identifier: Apache-2.0
"""Kind `line`: points of the platform on a straight line, such as a ruler, an edge or a beam."""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.points.target_kind import Prediction
from loopcal.measure.kinds.rows import Column
from loopcal.measure.kinds.surfaces.surface_kind import SurfaceKind
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Line(SurfaceKind):
    """Points on a line. Residual: `B'R'(x - through) - shift - gap`, with B two unit vectors
    perpendicular to the stated direction.

    R rotates the stated direction to the true one. An unknown line has four parameters for each
    group of rows: two rotations u, v and two shifts a, b along the rotated B.

    Setup parameters: `line.u`, `line.v` [rad], `line.a` and `line.b` [m], and `target.x` to
    `target.z` [m] of each target.

    Parameters
    ----------
    See `SurfaceKind`.

    Examples
    --------
    >>> kind = Line(surface="ruler", unknown=("surface",))
    >>> [column.name for column in kind.columns]
    ['gap_a', 'gap_b']
    >>> [parameter.name for parameter in kind.nuisance_parameters]
    ['ruler.u', 'ruler.v', 'ruler.a', 'ruler.b']
    """

    surface: str = "line"

    name: ClassVar[str] = "line"
    mixes_components: ClassVar[bool] = True
    per_target: ClassVar[tuple[Column, ...]] = (
        Column("gap_a", Dimension.LENGTH),
        Column("gap_b", Dimension.LENGTH),
    )

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known line, and an unknown one."""
        return (cls(), cls(unknown=("surface",), along=np.array([0.6, 0.0, 0.8]), surface="ruler"))

    @property
    def surface_parameters(self) -> tuple[Parameter, ...]:
        """Two rotations and two shifts."""
        return self.make_parameters(("u", "v"), Dimension.ANGLE) + self.make_parameters(
            ("a", "b"), Dimension.LENGTH
        )

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return distances (.., k, 2) from the line along B."""
        surface = self.item_values(values, "surface")
        B, lever = setup.make_perpendicular_basis(self.along), x - self.through
        if surface is None:
            return lever @ B, B.T, {}
        R, S = setup.rotate_basis(self.along, surface[..., :2])
        rows = np.swapaxes(R @ B, -1, -2)[..., None, :, :]
        # d (R b)'x = (w x R b)'x = (R b)'(x x w)
        by_rotation = rows @ geometry.hat(lever) @ S[..., None, :, :]
        by_shift = np.broadcast_to(-np.eye(2), (*by_rotation.shape[:-1], 2))
        gaps = (rows @ lever[..., None])[..., 0] - surface[..., None, 2:]
        return gaps, rows, {"surface": np.concatenate([by_rotation, by_shift], axis=-1)}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the line of largest scatter of the points."""
        x, gaps = self.collect_contacts(T, measured)
        if "surface" not in self.unknown or len(x) < 2:
            return self.nominal_values[None]
        middle = x.mean(axis=0)
        direction = np.linalg.svd(x - middle, full_matrices=False)[2][0]
        rotations = setup.encode_direction(
            self.along, direction if direction @ self.along >= 0.0 else -direction
        )
        R, _ = setup.rotate_basis(self.along, rotations)
        across = R @ setup.make_perpendicular_basis(self.along)
        shifts = (middle - self.through) @ across - gaps.mean(axis=0)
        return self.assemble_values({"surface": np.concatenate([rotations, shifts])})
