# SPDX-License-Identifier: Apache-2.0
"""Platform coordinates: the numbers in which a machine is commanded, and their derivatives.

Names: `x y z` of the platform's origin in the base; `phi theta psi` tilt-and-torsion, R = Rz(phi)
Ry(theta) Rz(psi - phi); `roll pitch yaw`, R = Rz(yaw) Ry(pitch) Rx(roll). phi and theta together
are compared as a unit normal, which stays regular at zero tilt. Formulas:
docs/theory/conventions.md.
"""

from __future__ import annotations

import numpy as np

from loopcal import geometry
from loopcal.engine import Target
from loopcal.errors import MechanismError
from loopcal.typing import FloatArray
from loopcal.units import Dimension

POSITION = ("x", "y", "z")
TILT = ("phi", "theta", "psi")
EULER = ("roll", "pitch", "yaw")
COORDINATES = (*POSITION, *EULER, *TILT)


def get_dimension(coordinate: str) -> Dimension:
    """Return the dimension of a coordinate: x, y, z are lengths, others angles."""
    return Dimension.LENGTH if coordinate in POSITION else Dimension.ANGLE


def list_dimensions(names: tuple[str, ...]) -> tuple[Dimension, ...]:
    """Return the dimensions of coordinates."""
    return tuple(map(get_dimension, names))


def check_coordinates(names: tuple[str, ...]) -> None:
    """Refuse unknown, repeated or mixed coordinates; raises MechanismError."""
    wrong = [n for n in names if n not in COORDINATES]
    if wrong:
        raise MechanismError(
            f"{wrong[0]!r} is not a platform coordinate. Allowed: {', '.join(COORDINATES)}"
        )
    if len(set(names)) < len(names):
        raise MechanismError(f"duplicate coordinate in {', '.join(names)}. Name each once")
    if set(names) & set(TILT) and set(names) & set(EULER):
        raise MechanismError(
            f"{', '.join(names)} mixes roll-pitch-yaw with phi-theta-psi. Describe the orientation "
            "by one of the two"
        )
    if ("phi" in names) != ("theta" in names):
        raise MechanismError(
            "phi and theta give the direction of the normal together. Name both or neither"
        )


def read_coordinates(T: FloatArray, names: tuple[str, ...]) -> FloatArray:
    """Return these coordinates (.., c) of poses T (.., 4, 4) [m, rad]."""
    values = {name: T[..., i, 3] for i, name in enumerate(POSITION)}
    if set(names) & set(TILT):
        angles = geometry.matrix_to_tilt_torsion(T[..., :3, :3])
        values |= {name: angles[..., i] for i, name in enumerate(TILT)}
    if set(names) & set(EULER):
        angles = geometry.matrix_to_euler(T[..., :3, :3], "xyz")
        values |= {name: angles[..., i] for i, name in enumerate(EULER)}
    return np.stack([values[name] for name in names], axis=-1)


def pose_from_coordinates(
    values: FloatArray, names: tuple[str, ...], base: FloatArray
) -> FloatArray:
    """Return poses (.., 4, 4) with coordinates values (.., c); all others are those of `base`."""
    return state_target(values, names, base).poses


def state_target(values: FloatArray, names: tuple[str, ...], base: FloatArray) -> Target:
    """Return the poses of `pose_from_coordinates` as the engine states them."""
    values, names = _add_turns(values, names, base)
    turns = ("phi", "theta", "psi") if set(names) & set(TILT) else ("yaw", "pitch", "roll")
    places = {name: i for i, name in enumerate(names)}
    columns = tuple(places.get(name, -1) for name in (*POSITION, *turns))
    return Target(values, columns, turns[0] == "phi", base)


def _add_turns(
    values: FloatArray, names: tuple[str, ...], base: FloatArray
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return coordinates with those angles of `base` that other angles do not give."""
    for turns in (TILT, EULER):
        missing = tuple(name for name in turns if name not in names)
        if 0 < len(missing) < len(turns) and (own := read_coordinates(base, missing)).any():
            own = np.broadcast_to(own, (*values.shape[:-1], len(missing)))
            return np.concatenate([values, own], axis=-1), (*names, *missing)
    return values, names


def compare_coordinates(
    T: FloatArray, target: FloatArray, names: tuple[str, ...], size: float
) -> tuple[FloatArray, FloatArray]:
    """Return how far poses T (N, 4, 4) are from target coordinates (N, c) [m], present - target
    with angles times `size`, and the columns (N, c, 6) per twist (rotation, translation).
    """
    residual = np.zeros(target.shape)
    columns = np.zeros((*target.shape, 6))
    at = [i for i, name in enumerate(names) if name in POSITION]
    axes = np.array([POSITION.index(names[i]) for i in at], int)
    residual[:, at], columns[:, at, 3 + axes] = T[:, axes, 3] - target[:, at], 1.0
    rotation = T[:, :3, :3]
    if "phi" in names:
        at = [names.index("phi"), names.index("theta")]
        wanted = target[:, at[0]], target[:, at[1]]
        residual[:, at], columns[:, at, :3] = _compare_normals(rotation, *wanted, size)
    if "psi" in names:
        place, normal = names.index("psi"), rotation[:, :, 2]
        angle = geometry.matrix_to_tilt_torsion(rotation)[..., 2]
        residual[:, place] = size * geometry.wrap_angle(angle - target[:, place])
        # d psi = (ez + n) . omega / (1 + cos theta): orthogonal to the axes that phi and theta turn
        # about. Upside down torsion has no meaning, and no slope
        left = 1.0 + normal[:, 2:]
        inverse = np.divide(size, left, out=np.zeros_like(left), where=left > 0.0)
        columns[:, place, :3] = (normal + np.eye(3)[2]) * inverse
    if at := [i for i, name in enumerate(names) if name in EULER]:
        own, angles = [EULER.index(names[i]) for i in at], geometry.matrix_to_euler(rotation, "xyz")
        residual[:, at] = size * geometry.wrap_angle(angles[:, own] - target[:, at])
        columns[:, at, :3] = size * geometry.euler_rates_inverse(angles, "xyz")[:, own]
    return residual, columns


def differentiate_coordinates(T: FloatArray, names: tuple[str, ...], size: float) -> FloatArray:
    """Return the columns (N, c, 6) of `compare_coordinates` at the coordinates of T (N, 4, 4)."""
    return compare_coordinates(T, read_coordinates(T, names), names, size)[1]


def _compare_normals(
    rotation: FloatArray, phi: FloatArray, theta: FloatArray, size: float
) -> tuple[FloatArray, FloatArray]:
    """Return the components of the platform normal across the target normal, and their slopes."""
    s, c = np.sin(theta), np.cos(theta)
    across = np.stack(
        [
            np.stack([c * np.cos(phi), c * np.sin(phi), -s], axis=-1),
            np.stack([-np.sin(phi), np.cos(phi), np.zeros_like(phi)], axis=-1),
        ],
        axis=1,
    )
    normal = rotation[:, :, 2]
    residual = np.einsum("nij,nj->ni", across, normal)
    # d normal = omega x normal, so d (a . normal) = (normal x a) . omega
    return size * residual, size * np.cross(normal[:, None], across)
