# SPDX-License-Identifier: Apache-2.0
"""A joint between two bodies of a mechanism."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from loopcal import geometry
from loopcal.mechanism.platform_coordinates import EULER, POSITION, TILT, differentiate_coordinates
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class GraphJoint:
    """A joint: the frame `T_a` of one body, moved by the joint, is the frame `T_b` of the other.

    kind : R (rotary), P (slide) or S (ball joint). body_a, body_b : the bodies.
    T_a, T_b : (4, 4) frames in their bodies [m]. axis : (3,) unit vector in both; unused for S.
    origin_a, origin_b : names of the places in the source file that give these frames; empty where
        nothing can be shifted there.
    shifts : axes of these frames along which a shift changes the mechanism.
    limits : allowed values [rad or m], or None.
    drive : the motor that moves it, or the passive joint that couplings make it follow, which then
        has itself as drive; empty where nothing does. Its value is `ratio` times that of the drive
        + `offset` [rad or m].
    """

    name: str
    kind: Literal["R", "P", "S"]
    body_a: str
    body_b: str
    T_a: FloatArray
    T_b: FloatArray
    axis: FloatArray
    origin_a: str = ""
    origin_b: str = ""
    shifts: str = "xyz"
    limits: tuple[float, float] | None = None
    drive: str = ""
    ratio: float = 1.0
    offset: float = 0.0

    @property
    def bodies(self) -> tuple[str, str]:
        """Return both bodies."""
        return self.body_a, self.body_b

    @property
    def is_plain(self) -> bool:
        """Return whether its value is that of its drive."""
        return (self.ratio, self.offset) == (1.0, 0.0)

    @property
    def is_pin(self) -> bool:
        """Return whether this rotary joint has places of its own on both bodies."""
        return self.kind == "R" and bool(self.origin_a and self.origin_b)

    def reverse(self) -> GraphJoint:
        """Return the joint from the other body; its value stays the same, because its axis is the
        opposite one. A pin that has the name of its place on the first body gets that of the other.
        """
        swapped = replace(
            self,
            body_a=self.body_b,
            body_b=self.body_a,
            T_a=self.T_b,
            T_b=self.T_a,
            axis=-self.axis,
            origin_a=self.origin_b,
            origin_b=self.origin_a,
        )
        is_named_after_end = self.is_pin and self.name == self.origin_a
        return replace(swapped, name=self.origin_b) if is_named_after_end else swapped

    def orient(self, body: str) -> GraphJoint:
        """Return the joint from one of its bodies."""
        return self if body == self.body_a else self.reverse()

    def move(self, values: FloatArray) -> FloatArray:
        """Return the frames (.., 4, 4) of the second body in the first one, at values (..)."""
        vectors = values[..., None] * self.axis
        turn, shift = (vectors, 0 * vectors) if self.kind == "R" else (0 * vectors, vectors)
        return self.T_a @ geometry.make_pose(geometry.exp_so3(turn), shift)


@dataclass(frozen=True)
class Coupling:
    """The value of a joint is factor * value of the leader + offset [rad or m]."""

    joint: str
    leader: str
    factor: float
    offset: float


def list_axes_across(axis: FloatArray) -> str:
    """Return the axes of a joint's frame that are not the joint's."""
    return "".join(a for a, part in zip("xyz", np.abs(axis), strict=True) if part < 1 - 1e-9)


def turn_between(vector: FloatArray, target: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) that turns a unit vector into another."""
    across = np.cross(vector, target)
    sine, cosine = float(np.linalg.norm(across)), float(vector @ target)
    if sine < 1e-12:
        across, sine = geometry.find_perpendicular(vector, vector), 1.0
        return geometry.exp_so3(across * (0.0 if cosine > 0 else np.pi))
    return geometry.exp_so3(across / sine * np.arctan2(sine, cosine))


# Coordinates in which a mechanism can be commanded: those that its motions change
# independently.

# Singular value, relative to the largest rate, above which coordinates are independent [1].
INDEPENDENT = 1e-3
STEEP = 0.2  # cosine of the pitch below which roll and yaw are not used [1]


def choose_coordinates(T: FloatArray, twists: FloatArray) -> tuple[str, ...]:
    """Return coordinates of a platform at T (4, 4) that move independently, positions first, of
    twists (6, m) (rotation, translation) [rad, m] for the m motions of the mechanism.
    """
    is_steep = np.hypot(T[0, 0], T[1, 0]) < STEEP
    names = (*POSITION, *(TILT if is_steep else EULER))
    rates = differentiate_coordinates(T[None], names, 1.0)[0] @ twists
    chosen: list[int] = []
    # phi and theta are one direction, and are named together
    for group in ([0], [1], [2], *([[3, 4], [5]] if is_steep else [[3], [4], [5]])):
        rows = rates[[*chosen, *group]]
        s = np.linalg.svd(rows, compute_uv=False)
        if len(rows) <= twists.shape[1] and s[-1] > INDEPENDENT * np.abs(twists).max():
            chosen += group
    return tuple(names[i] for i in chosen)
