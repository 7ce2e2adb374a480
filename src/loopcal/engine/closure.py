# SPDX-License-Identifier: Apache-2.0
"""Closure of a group of limbs and its columns, for many rows at once.

Inside, arrays carry their components first and the batch (k limbs, N rows) last, so that every
operation runs along contiguous memory: vectors (3, k, N), matrices (3, 3, k, N), columns (r, c, k,
N). Formulas: docs/theory/engine.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.engine.program import LENGTH, PITCH, Group, Slot
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class PlacedLinks:
    """Displaced links of a group, (.., k, t): placed = nominal . translation(d) . rotation(exp(w)).

    `frame` is a link's nominal rotation, `turn` the displaced one, `spread` what a unit change of w
    turns it by, `shift` its displaced origin, for J + 2 links; `turns[j]` is False where link j
    never rotates anything.
    """

    frame: FloatArray
    turn: FloatArray
    spread: FloatArray
    shift: FloatArray
    pitch: FloatArray
    length: FloatArray
    turns: tuple[bool, ...]

    def rows(self, trial: np.ndarray) -> PlacedLinks:
        """The geometry of each row's trial; a single trial broadcasts over all rows."""
        if self.length.shape[1] == 1:
            return self
        values = [
            a[..., trial]
            for a in (self.frame, self.turn, self.spread, self.shift, self.pitch, self.length)
        ]
        return PlacedLinks(*values, turns=self.turns)


def place_links(group: Group, e: FloatArray) -> PlacedLinks:
    """Place the links of a group for displacements e (t, n_displacements) [m, rad]."""
    t, k, links = len(e), len(group.limbs), len(group.joints) + 2
    own = e[:, group.columns].reshape(t, k, len(group.slots)).transpose(2, 1, 0)
    move = np.zeros((links, 6, k, t))
    pitch, length = (np.repeat(a.T[..., None], t, axis=-1) for a in (group.pitch, group.length))
    for slot, value in zip(group.slots, own, strict=True):
        target = (
            pitch[slot.element]
            if slot.axis == PITCH
            else length
            if slot.axis == LENGTH
            else move[slot.element, slot.axis]
        )
        target += value
    nominal = group.links.transpose(1, 2, 3, 0)[..., None]
    frame = np.broadcast_to(nominal[:, :3, :3], (links, 3, 3, k, t))
    shift = nominal[:, :3, 3] + sum(frame[:, :, i] * move[:, None, 3 + i] for i in range(3))
    turn, spread = np.array(frame), np.zeros_like(frame)
    rotated = {slot.element for slot in group.slots if slot.axis < 3}
    for j in rotated:
        turn[j] = matmul(frame[j], rotation(move[j, :3]))
        spread[j] = matmul(frame[j], left_jacobian(move[j, :3]))
    plain = np.all(group.links[:, :, :3, :3] == np.eye(3), axis=(0, 2, 3))
    return PlacedLinks(
        frame,
        turn,
        spread,
        shift,
        pitch,
        length,
        tuple(j in rotated or not plain[j] for j in range(links)),
    )


class Chain:
    """A group at platform T (3, 4, N) and joint values theta (J + 1, k, N), and the rows that
    motions make in its ending.
    """

    def __init__(
        self, group: Group, g: PlacedLinks, T: FloatArray, theta: FloatArray, size: float
    ) -> None:
        self.group, self.g, self.theta, self.size = group, g, theta, size
        self.last = len(group.joints) + 1
        self.before, self.axes, self.origins = [g.frame[0]], [], [g.shift[0]]
        turn, point = g.turn[0], g.shift[0]
        for j, letter in enumerate(group.joints):
            axis, value = turn[:, 2], theta[j]
            self.axes.append(axis)
            if letter == "P" or g.pitch[j].any():
                point = point + (value if letter == "P" else g.pitch[j] * value) * axis
            if letter == "R":
                c, s = np.cos(value), np.sin(value)
                x, y = turn[:, 0], turn[:, 1]
                turn = np.stack(np.broadcast_arrays(c * x + s * y, c * y - s * x, axis), axis=1)
            self.before.append(turn)
            point = point + matvec(turn, g.shift[j + 1])
            self.origins.append(point)
            turn = matmul(turn, g.turn[j + 1]) if g.turns[j + 1] else turn
        self.platform = T[:, :3, None]
        self.before.append(self.platform)
        self.tip, self.tip_turn = point, turn
        self.arm = matvec(self.platform, g.shift[self.last])
        self.gap = self.arm + T[:, 3, None] - point
        if group.ending == "distance":
            self.distance = np.sqrt(dot(self.gap, self.gap))
            self.u = self.gap / self.distance
            self.moment = cross(self.arm, self.u)

    def residual(self) -> FloatArray:
        """Rows of the closure residual [m]."""
        if self.group.ending == "distance":
            return (self.distance - (self.g.length + self.theta[-1]))[None]
        if self.group.ending == "ball":
            return self.gap[list(self.group.rows)]
        # 2 tan(t/2) along the axis: the same zero and slope as the logarithm, and safe up to half a
        # turn
        R = matmul(matmul(self.platform, self.g.turn[self.last]), np.swapaxes(self.tip_turn, 0, 1))
        v = np.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        turn = 2.0 * self.size * v / np.maximum(1.0 + R[0, 0] + R[1, 1] + R[2, 2], 1e-3)
        return np.concatenate([turn, self.gap])[list(self.group.rows)]

    def shifting(self, direction: FloatArray) -> FloatArray:
        """Rows of the attachment moving along `direction` (3, k, N) against the tip."""
        if self.group.ending == "distance":
            return dot(self.u, direction)[None]
        if self.group.ending == "ball":
            return direction[list(self.group.rows)]
        return np.stack(np.broadcast_arrays(*np.zeros((3, 1, 1)), *direction))[
            list(self.group.rows)
        ]

    def turning(self, axis: FloatArray, arm: FloatArray) -> FloatArray:
        """Rows of turning about `axis`, with the attachment (or tip) at `arm` from the centre (3,
        k, N).
        """
        if self.group.ending != "rigid":
            return self.shifting(cross(axis, arm))
        return np.stack(np.broadcast_arrays(*(self.size * axis), *cross(axis, arm)))[
            list(self.group.rows)
        ]

    def freedom(self, f: int) -> FloatArray:
        """Rows of a platform freedom: a unit turn about (0..2), or shift along (3..5), a base axis."""
        if self.group.ending == "distance":
            return (self.moment if f < 3 else self.u)[f % 3][None]
        axis = np.zeros((3, 1, 1))
        axis[f % 3] = 1.0
        return self.turning(axis, self.arm) if f < 3 else self.shifting(axis)

    def joint(self, j: int) -> FloatArray:
        """Rows of a unit change of joint j: the tip moves, so closure takes the opposite sign."""
        if j == len(self.group.joints):
            return -np.ones((1, 1, 1)) if self.group.ending == "distance" else np.zeros((1, 1, 1))
        axis = self.axes[j]
        if self.group.joints[j] == "P":
            return -self.shifting(axis)
        rows = self.turning(axis, self.tip - self.origins[j])
        return -rows - self.shifting(self.g.pitch[j] * axis) if self.g.pitch[j].any() else -rows

    def slot(self, slot: Slot) -> FloatArray:
        """Rows of a unit change of a displacement."""
        j, axis = slot.element, slot.axis
        if axis == LENGTH:
            return -np.ones((1, 1, 1))
        if axis == PITCH:
            return -self.shifting(self.theta[j] * self.axes[j])
        local = self.g.spread[j][:, axis] if axis < 3 else self.g.frame[j][:, axis - 3]
        direction = matvec(self.before[j], local) if j else local
        arm = np.zeros((3, 1, 1)) if j == self.last else self.tip - self.origins[j]
        rows = self.shifting(direction) if axis >= 3 else self.turning(direction, arm)
        return rows if j == self.last else -rows

    def matrix(self, columns: list[FloatArray]) -> FloatArray:
        """Columns side by side, (r, c, k, N)."""
        out = np.empty((len(self.group.rows), len(columns), *self.gap.shape[1:]))
        for c, column in enumerate(columns):
            out[:, c] = column
        return out


def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """Product of (3, 3, ..) and (3, 3, ..)."""
    return a[:, 0, None] * b[None, 0] + a[:, 1, None] * b[None, 1] + a[:, 2, None] * b[None, 2]


def matvec(a: FloatArray, v: FloatArray) -> FloatArray:
    """Product of (3, 3, ..) and (3, ..)."""
    return a[:, 0] * v[0] + a[:, 1] * v[1] + a[:, 2] * v[2]


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner product of (3, ..) and (3, ..)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product of (3, ..) and (3, ..)."""
    parts = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return np.stack(np.broadcast_arrays(*parts))


def _series(w: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """I + a hat(w) + b hat(w)^2 for (3, ..)."""
    x, y, z = w
    bx, by, bz, one = b * x, b * y, b * z, 1.0 - b * dot(w, w)
    rows = (
        (one + bx * x, bx * y - a * z, bx * z + a * y),
        (bx * y + a * z, one + by * y, by * z - a * x),
        (bx * z - a * y, by * z + a * x, one + bz * z),
    )
    return np.stack([np.stack(row) for row in rows])


def rotation(w: FloatArray) -> FloatArray:
    """exp(hat(w)) by Rodrigues' formula, (3, ..) -> (3, 3, ..)."""
    t = np.sqrt(dot(w, w))
    # sinc(x) = sin(pi x) / (pi x), exact at zero; (1 - cos t) / t^2 = sinc(t / 2)^2 / 2
    half = np.sinc(t / (2 * np.pi))
    return _series(w, np.sinc(t / np.pi), 0.5 * half * half)


def left_jacobian(w: FloatArray) -> FloatArray:
    """J with exp(hat(w + d)) = exp(hat(J d)) exp(hat(w)) to first order in d, (3, ..) -> (3, 3,
    ..).
    """
    t2 = dot(w, w)
    t, half = np.sqrt(t2), np.sinc(np.sqrt(t2) / (2 * np.pi))
    tail = np.where(t < 0.02, 1 / 6 - t2 / 120, (t - np.sin(t)) / np.where(t < 0.02, 1.0, t2 * t))
    return _series(w, 0.5 * half * half, tail)
