# SPDX-License-Identifier: Apache-2.0
"""Base of the kinds that touch a surface with points of the platform.

The columns are gaps between point and surface. A gap is 0 where a probe just touches, after
correction for its ball and its deflection. Rows of one group share the parameters of the surface.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.array_checks import check_direction, check_point
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.directions import UPWARD
from loopcal.measure.kinds.distance import measure_lengths
from loopcal.measure.kinds.kind import Column, checked
from loopcal.measure.kinds.position import Prediction, TargetKind
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Length


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SurfaceKind(TargetKind):
    """A kind that touches a surface, which is stated by a point and a direction.

    through : (3,) [m], a point of the surface (of a sphere: its center) in the frame. If the
        surface is unknown, its nominal value.
    along : (3,), normal of a plane or direction of a line, in the frame; of any length.
    surface : name of the surface; its parameters begin with it. A plane and a line with equal name,
        point and direction share `u` and `v`: the line is perpendicular to the plane.
    Others : see `TargetKind`; "frame", "surface" and "targets" (the offsets of the probe) may be
    unknown. Faces of a known body, such as a datum cube, are known surfaces in an unknown frame.
    """

    through: FloatArray = checked(check_point, "the point of the surface", np.zeros(3))
    along: FloatArray = checked(check_direction, "the direction of the surface", UPWARD)
    surface: str = "surface"

    allowed_unknown: ClassVar[tuple[str, ...]] = ("frame", "surface", "targets")
    changes_with_pose: ClassVar[bool] = False
    measures_points: ClassVar[bool] = False
    length_error: ClassVar[str] = "gap"
    fewest_points: ClassVar[int] = 3
    surface_axes: ClassVar[tuple[str, ...]]  # names of the parameters of the surface

    @property
    def nominal_surface(self) -> FloatArray:
        """Nominal values (w,) of the parameters of the surface."""
        return np.zeros(len(self.surface_axes))

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """Also the surface, whose parameters the rows of one group share."""
        stated = {f"{self.surface}.through": self.through, f"{self.surface}.along": self.along}
        k = len([axis for axis in self.surface_axes if axis in setup.DIRECTION_AXES])  # come first
        numbers = ((Dimension.ANGLE, slice(k)), (Dimension.LENGTH, slice(k, None)))
        own, nominal = self.surface_axes, self.nominal_surface
        parameters = (
            setup.make_parameters(self.surface, own[of], dimension, nominal[of], "group")
            for dimension, of in numbers
        )
        return {**super().possible_setup, "surface": setup.SetupItem(sum(parameters, ()), stated)}

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the surface in closed form, with the targets at their stated places."""
        _, _, points, gaps = self.collect_points(T, measured)
        if "surface" not in self.unknown or len(points) < self.fewest_points:
            return self.nominal_values[None]
        return self.assemble_values({"surface": self._fit_surface(self.to_frame(points), gaps)})

    @abstractmethod
    def _fit_surface(self, x: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return values (k, w) or (w,) of the surface from points (q, 3) in the frame and gaps."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Plane(SurfaceKind):
    """Points on a plane with normal n, such as a probed bed. Residual: `n'(x - through) - height -
    gap`.

    An unknown plane has three parameters for each group of rows: two rotations u, v of the normal
    and the height above the stated point.

    Setup parameters: `plane.u`, `plane.v` [rad] and `plane.height` [m], and `target.x` to
    `target.z` [m] of each target.

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
        tilted = cls(along=np.array([0.6, 0.0, 0.8]), targets=("probe",), surface="bed")
        return (cls(), replace(tilted, unknown=("surface", "targets")))

    surface_axes: ClassVar[tuple[str, ...]] = ("u", "v", "height")

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return heights (.., k, 1) above the plane."""
        surface, lever = self.stated_or_unknown(values, "surface"), x - self.through
        normal = setup.place_direction(self.along, surface[..., :2])[..., None, None, :]
        by_rotation = (
            lever[..., None, :]
            @ setup.linearize_direction(self.along, surface[..., :2])[..., None, :, :]
        )
        height = (normal @ lever[..., None])[..., 0] - surface[..., None, 2:]
        by_surface = np.concatenate([by_rotation, -np.ones_like(by_rotation[..., :1])], axis=-1)
        return height, normal, {"surface": by_surface}

    def _fit_surface(self, x: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return the planes of least scatter, and the one that unequal gaps determine."""
        middle = x.mean(axis=0)
        normals = [np.linalg.svd(x - middle, full_matrices=False)[2][2]]
        gradient = geometry.solve_least_squares(x - middle, gaps[:, 0] - gaps.mean())
        if np.linalg.norm(gradient) > 0.1:
            normals.append(gradient / np.linalg.norm(gradient))
        n = np.array([normal if normal @ self.along >= 0.0 else -normal for normal in normals])
        height = n @ (middle - self.through) - gaps.mean()
        return np.concatenate([setup.encode_direction(self.along, n), height[:, None]], axis=-1)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Line(SurfaceKind):
    """Points on a line, such as a ruler, an edge or a beam. Residual: `B'R'(x - through) - shift -
    gap`, with B two unit vectors perpendicular to the stated direction.

    R rotates the stated direction to the true one. An unknown line has four parameters for each
    group of rows: two rotations u, v and two shifts a, b along the rotated B.

    Setup parameters: `line.u`, `line.v` [rad], `line.a` and `line.b` [m], and `target.x` to
    `target.z` [m] of each target.
    """

    surface: str = "line"

    name: ClassVar[str] = "line"
    fewest_points: ClassVar[int] = 2
    mixes_components: ClassVar[bool] = True
    per_target: ClassVar[tuple[Column, ...]] = (
        Column("gap_a", Dimension.LENGTH),
        Column("gap_b", Dimension.LENGTH),
    )

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known line, and an unknown one."""
        return (cls(), cls(unknown=("surface",), along=np.array([0.6, 0.0, 0.8]), surface="ruler"))

    surface_axes: ClassVar[tuple[str, ...]] = ("u", "v", "a", "b")

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return distances (.., k, 2) from the line along B."""
        surface = self.stated_or_unknown(values, "surface")
        B, lever = setup.make_perpendicular_basis(self.along), x - self.through
        R, S = setup.rotate_basis(self.along, surface[..., :2])
        rows = np.swapaxes(R @ B, -1, -2)[..., None, :, :]
        # d (R b)'x = (w x R b)'x = (R b)'(x x w)
        by_rotation = rows @ geometry.hat(lever) @ S[..., None, :, :]
        by_shift = np.broadcast_to(-np.eye(2), (*by_rotation.shape[:-1], 2))
        gaps = (rows @ lever[..., None])[..., 0] - surface[..., None, 2:]
        return gaps, rows, {"surface": np.concatenate([by_rotation, by_shift], axis=-1)}

    def _fit_surface(self, x: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return the line of largest scatter of the points."""
        middle = x.mean(axis=0)
        direction = np.linalg.svd(x - middle, full_matrices=False)[2][0]
        rotations = setup.encode_direction(
            self.along, direction if direction @ self.along >= 0.0 else -direction
        )
        R, _ = setup.rotate_basis(self.along, rotations)
        across = R @ setup.make_perpendicular_basis(self.along)
        shifts = (middle - self.through) @ across - gaps.mean(axis=0)
        return np.concatenate([rotations, shifts])


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Sphere(SurfaceKind):
    """Points on a sphere about c, such as a probed ball. Residual: `|x - c| - radius - gap`.

    An unknown sphere has four parameters for each group of rows: its center and its radius, which
    includes the probe's.

    Setup parameters [m]: `sphere.x` to `sphere.z` and `sphere.radius`, and `target.x` to
    `target.z` of each target.

    Parameters
    ----------
    radius : sum of the radii of ball and probe [m]. If the surface is unknown, its nominal value.
    Others : see `SurfaceKind`; `through` is the center, and `along` does not matter.

    Raises
    ------
    DataError : as `SurfaceKind`, and if the radius is not above zero.
    """

    surface: str = "sphere"
    radius: Length = 0.0125

    name: ClassVar[str] = "sphere"
    fewest_points: ClassVar[int] = 4
    per_target: ClassVar[tuple[Column, ...]] = (Column("gap", Dimension.LENGTH),)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.radius > 0.0:
            raise DataError(f"the radius of a sphere is {self.radius} m. Give a length above 0")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known sphere, and an unknown one."""
        far = np.array([1.5, -0.8, 1.1])
        return (cls(through=far), cls(unknown=("surface",), through=far, surface="ball"))

    surface_axes: ClassVar[tuple[str, ...]] = ("x", "y", "z", "radius")

    @property
    def nominal_surface(self) -> FloatArray:
        """Center and radius."""
        return np.array([*self.through, self.radius])

    def predict(self, x: FloatArray, values: FloatArray) -> Prediction:
        """Return distances (.., k, 1) from the sphere."""
        surface = self.stated_or_unknown(values, "surface")
        distance, unit = measure_lengths(x - surface[..., None, :3])
        unit = unit[..., None, :]
        by_surface = -np.concatenate([unit, np.ones_like(unit[..., :1])], axis=-1)
        return distance - surface[..., None, 3:], unit, {"surface": by_surface}

    def _fit_surface(self, x: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return center and radius by trilateration: a distance from the center is a gap plus the
        radius, which is a common offset.
        """
        centers, offsets = geometry.solve_trilateration(x, gaps[:, 0], with_offset=True)
        return np.concatenate([centers, -offsets[:, None]], axis=-1)
