# SPDX-License-Identifier: Apache-2.0
"""Frames, points and directions as unknowns: their parameters, their value, and the derivative by
these parameters.

A frame has six: `rx ry rz`, the turn w from its stated orientation about base axes, `R = exp(w)
R_stated`, and its position `x y z`. A direction has two: turns about two axes B across the stated
one, `n = exp(B (u, v)) n_stated`. All of them add up like plain numbers; the derivative carries the
left Jacobian of the rotation group, so it is exact anywhere, and only a direction turned by exactly
half a turn is singular.
"""

import numpy as np

from loopcal import geometry
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension

TURNS, POSITION = ("rx", "ry", "rz"), ("x", "y", "z")


def turn_part(name: str, scope: str = "session") -> tuple[Parameter, ...]:
    """Three unknowns of an orientation: `name.rx` .."""
    return tuple(Parameter(f"{name}.{axis}", Dimension.ANGLE, 0.0, scope=scope) for axis in TURNS)


def point_part(name: str, place: FloatArray, scope: str = "session") -> tuple[Parameter, ...]:
    """Three unknowns of a point: `name.x` .., nominally at `place` (3,)."""
    pairs = zip(POSITION, place.tolist(), strict=True)
    return tuple(
        Parameter(f"{name}.{axis}", Dimension.LENGTH, value, scope=scope) for axis, value in pairs
    )


def frame_part(name: str, T: FloatArray, scope: str = "session") -> tuple[Parameter, ...]:
    """Six unknowns of a frame stated as T (4, 4)."""
    return turn_part(name, scope) + point_part(name, T[:3, 3], scope)


def direction_part(name: str, scope: str = "session") -> tuple[Parameter, ...]:
    """Two unknowns of a direction: `name.u` and `name.v`."""
    return tuple(
        Parameter(f"{name}.{axis}", Dimension.ANGLE, 0.0, scope=scope) for axis in ("u", "v")
    )


def frame_at(stated: FloatArray, values: FloatArray | None) -> FloatArray:
    """The frame (.., 4, 4) at values (.., 6), or as stated."""
    if values is None:
        return stated
    return geometry.make_pose(geometry.exp_so3(values[..., :3]) @ stated[:3, :3], values[..., 3:])


def frame_values(stated: FloatArray, T: FloatArray) -> FloatArray:
    """Values (.., 6) that put a stated frame at T (.., 4, 4)."""
    return np.concatenate([turn_values(stated[:3, :3], T[..., :3, :3]), T[..., :3, 3]], axis=-1)


def turn_values(stated: FloatArray, rotation: FloatArray) -> FloatArray:
    """Values (.., 3) that turn a stated orientation (3, 3) to a rotation (.., 3, 3)."""
    return geometry.log_so3(rotation @ stated.T)


def frame_slope(values: FloatArray) -> FloatArray:
    """The frame's twist by its values (.., 6), as (.., 6, 6): the left Jacobian for the turn, the
    identity for x y z.
    """
    turning = geometry.left_jacobian_so3(values[..., :3])
    zero, one = np.zeros_like(turning), np.broadcast_to(np.eye(3), turning.shape)
    top = np.concatenate([turning, zero], axis=-1)
    return np.concatenate([top, np.concatenate([zero, one], axis=-1)], axis=-2)


def across(direction: FloatArray) -> FloatArray:
    """Two unit vectors B (.., 3, 2) across unit vectors (.., 3), smooth but for z = -0 to +0.

    Formula: Duff et al., Building an Orthonormal Basis, Revisited, Journal of Computer Graphics
    Techniques 6(1), 2017.
    """
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    s = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (s + z)
    b = x * y * a
    first = np.stack([1.0 + s * x * x * a, s * b, -s * x], axis=-1)
    return np.stack([first, np.stack([b, s + y * y * a, -y], axis=-1)], axis=-1)


def direction_turn(stated: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The turn R (.., 3, 3) of a direction at values (.., 2), and `dR = hat(spread d(u, v)) R` (..,
    3, 2).
    """
    B = across(stated)
    turn = (B @ values[..., None])[..., 0]
    return geometry.exp_so3(turn), geometry.left_jacobian_so3(turn) @ B


def direction_at(stated: FloatArray, values: FloatArray | None) -> FloatArray:
    """The direction (.., 3) at values (.., 2), or as stated (3,)."""
    return stated if values is None else direction_turn(stated, values)[0] @ stated


def direction_slope(stated: FloatArray, values: FloatArray) -> FloatArray:
    """The direction's derivative (.., 3, 2) by its values: `dn = (spread d(u, v)) x n`."""
    R, spread = direction_turn(stated, values)
    return -geometry.hat(R @ stated) @ spread


def direction_values(stated: FloatArray, direction: FloatArray) -> FloatArray:
    """Values (.., 2) that turn a stated direction (3,) to another (.., 3), by the shortest way."""
    axis = np.cross(stated, direction)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (direction @ stated)[..., None])
    safe = np.where(sine > 0.0, axis / np.where(sine > 0.0, sine, 1.0), across(stated)[:, 0])
    return (angle * safe) @ across(stated)
