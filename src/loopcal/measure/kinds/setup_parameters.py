# SPDX-License-Identifier: Apache-2.0
"""Setup parameters: frames, points and directions as unknown numbers, and their derivatives.

A frame has six numbers. `rx ry rz` is the rotation vector w from its stated orientation, about base
axes: `R = exp(w) R_stated`. `x y z` is its position. A direction has two numbers, rotations about
two axes B perpendicular to the stated direction: `n = exp(B (u, v)) n_stated`.

All numbers add up like plain numbers. The derivatives contain the left Jacobian of the rotation
group, so they are exact for rotations of any size. The only singular case is a direction rotated by
exactly 180 degrees.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from loopcal import geometry
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension

ROTATION_AXES, POSITION_AXES, DIRECTION_AXES = ("rx", "ry", "rz"), ("x", "y", "z"), ("u", "v")


@dataclass(frozen=True, eq=False)
class SetupItem:
    """A frame, direction, target, surface or offset that may be unknown."""

    parameters: tuple[Parameter, ...]  # with nominal values and scope
    # name -> stated orientation or point that they are counted from
    references: Mapping[str, FloatArray] = field(default_factory=dict)


def make_parameters(
    name: str,
    axes: Sequence[str],
    dimension: Dimension,
    nominal: FloatArray | None = None,
    scope: str = "session",
) -> tuple[Parameter, ...]:
    """Return one parameter `name.axis` for each axis; nominal values (w,) default to 0."""
    values = [0.0] * len(axes) if nominal is None else nominal.tolist()
    return tuple(
        Parameter(f"{name}.{axis}", dimension, value, scope=scope)
        for axis, value in zip(axes, values, strict=True)
    )


def make_frame_item(name: str, T: FloatArray) -> SetupItem:
    """Return a frame that is stated as T (4, 4): three rotations and a position."""
    position = make_parameters(name, POSITION_AXES, Dimension.LENGTH, T[:3, 3])
    orientation = make_orientation_item(name, T[:3, :3])
    return SetupItem(orientation.parameters + position, orientation.references)


def make_orientation_item(name: str, R: FloatArray) -> SetupItem:
    """Return an orientation that is stated as R (3, 3): three rotations."""
    return SetupItem(make_parameters(name, ROTATION_AXES, Dimension.ANGLE), {name: R})


def make_points_item(names: Sequence[str], points: FloatArray, scope: str = "session") -> SetupItem:
    """Return points that are stated as (k, 3): three coordinates of each."""
    of_each = (
        make_parameters(name, POSITION_AXES, Dimension.LENGTH, point, scope)
        for name, point in zip(names, points, strict=True)
    )
    return SetupItem(tuple(parameter for parameters in of_each for parameter in parameters))


def place_frame(stated: FloatArray, values: FloatArray | None) -> FloatArray:
    """Return the frame (.., 4, 4) at values (.., 6), or the stated one where values are None."""
    if values is None:
        return stated
    return geometry.make_pose(geometry.exp_so3(values[..., :3]) @ stated[:3, :3], values[..., 3:])


def encode_frame(stated: FloatArray, T: FloatArray) -> FloatArray:
    """Return the values (.., 6) that bring a stated frame to T (.., 4, 4)."""
    return np.concatenate([encode_rotation(stated[:3, :3], T[..., :3, :3]), T[..., :3, 3]], axis=-1)


def encode_rotation(stated: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the values (.., 3) that bring a stated orientation (3, 3) to a rotation (.., 3, 3)."""
    return geometry.log_so3(rotation @ stated.T)


def shorten_rotations(names: Sequence[str], values: FloatArray) -> FloatArray:
    """Return values (.., u) of parameters with given names in which each rotation vector has a
    length of at most pi: `w (1 - 2 pi k / |w|)`, `k` the rounded number of complete turns.
    """
    shortest = values.copy()
    for owner in {name.rpartition(".")[0] for name in names}:
        axes = [f"{owner}.{axis}" for axis in ROTATION_AXES]
        if set(axes) <= set(names):
            places = [names.index(axis) for axis in axes]
            angle = np.linalg.norm(values[..., places], axis=-1, keepdims=True)
            turns = np.round(angle / (2.0 * np.pi))
            turned = values[..., places] * (1.0 - 2.0 * np.pi * turns / np.maximum(angle, np.pi))
            shortest[..., places] = np.where(turns > 0.0, turned, values[..., places])
    return shortest


def linearize_frame(values: FloatArray) -> FloatArray:
    """Return the derivative (.., 6, 6) of a frame's twist by its values (.., 6)."""
    return stack_diagonally(geometry.left_jacobian_so3(values[..., :3]), np.eye(3))


def stack_diagonally(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return matrices (.., 6, 6) with two blocks (.., 3, 3), which broadcast, on their diagonal."""
    return geometry.stack_blocks(((first, None), (None, second)))


def make_perpendicular_basis(direction: FloatArray) -> FloatArray:
    """Return two unit vectors B (.., 3, 2) perpendicular to unit vectors (.., 3), of which they
    are a smooth function except where z changes its sign (Duff et al., Building an Orthonormal
    Basis, Revisited, Journal of Computer Graphics Techniques 6(1), 2017).
    """
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    s = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (s + z)
    b = x * y * a
    first = np.stack([1.0 + s * x * x * a, s * b, -s * x], axis=-1)
    return np.stack([first, np.stack([b, s + y * y * a, -y], axis=-1)], axis=-1)


def rotate_basis(stated: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotation R (.., 3, 3) of a direction at values (.., 2), and its derivative S
    (.., 3, 2): `dR = hat(S d(u, v)) R`.
    """
    B = make_perpendicular_basis(stated)
    rotation = (B @ values[..., None])[..., 0]
    return geometry.exp_so3(rotation), geometry.left_jacobian_so3(rotation) @ B


def place_direction(stated: FloatArray, values: FloatArray | None) -> FloatArray:
    """Return the direction (.., 3) at values (.., 2), or the stated one where they are None."""
    return stated if values is None else rotate_basis(stated, values)[0] @ stated


def linearize_direction(stated: FloatArray, values: FloatArray) -> FloatArray:
    """Return the derivative (.., 3, 2) of a direction by its values: `dn = (S d(u, v)) x n`."""
    R, S = rotate_basis(stated, values)
    return -geometry.hat(R @ stated) @ S


def encode_direction(stated: FloatArray, direction: FloatArray) -> FloatArray:
    """Return values (.., 2) of the least rotation of a stated direction (3,) to others (.., 3)."""
    axis = np.cross(stated, direction)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (direction @ stated)[..., None])
    B = make_perpendicular_basis(stated)
    safe = np.where(sine > 0.0, axis / np.where(sine > 0.0, sine, 1.0), B[:, 0])
    return (angle * safe) @ B
