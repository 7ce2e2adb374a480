# SPDX-License-Identifier: Apache-2.0
"""Closure of a group of limbs and its columns, for many rows at once.

Inside, arrays carry their components first and the batch (rows, limbs) last, so that every operation runs along
contiguous memory: vectors (3, N, k), matrices (3, 3, N, k), columns (r, c, N, k). Formulas: docs/theory/engine.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.engine.program import LENGTH, PITCH, Array, Group


@dataclass(frozen=True)
class Geometry:
    """Displaced links of a group, (.., t, k): placed = nominal . translation(d) . rotation(exp(w)).

    `frame` is the nominal rotation of a link, `turn` the displaced one, `shift` the displaced origin, `spread` the left
    Jacobian of the rotation displacement (what a small change of w turns the link by), (J + 2, 3[, 3], t, k);
    `pitch` (J, t, k), `length` (t, k). `turns[j]` is False where link j never rotates anything.
    """

    frame: Array
    turn: Array
    shift: Array
    spread: Array
    pitch: Array
    length: Array
    turns: tuple[bool, ...]


def geometry(group: Group, e: Array) -> Geometry:
    """Place the links of a group for displacements e (t, n_displacements) [m, rad]."""
    t, k, links = e.shape[0], group.size, len(group.joints) + 2
    own = e[:, group.columns].reshape(t, k, len(group.slots))
    move = np.zeros((links, 6, t, k))
    pitch = np.repeat(group.pitch.T[:, None, :], t, axis=1)
    length = np.repeat(group.length[None, :], t, axis=0)
    for s, slot in enumerate(group.slots):
        if slot.axis == PITCH:
            pitch[slot.element] += own[:, :, s]
        elif slot.axis == LENGTH:
            length += own[:, :, s]
        else:
            move[slot.element, slot.axis] += own[:, :, s]
    nominal = group.links.transpose(1, 2, 3, 0)[:, :, :, None, :]
    frame = np.broadcast_to(nominal[:, :3, :3], (links, 3, 3, t, k))
    shift = nominal[:, :3, 3] + _matvec_stack(frame, move[:, 3:])
    rotated = {slot.element for slot in group.slots if slot.axis < 3}
    turn, spread = np.array(frame), np.zeros((links, 3, 3, t, k))
    for j in rotated:
        turn[j] = matmul(frame[j], rotation(move[j, :3]))
        spread[j] = left_jacobian(move[j, :3])
    plain = np.all(group.links[:, :, :3, :3] == np.eye(3), axis=(0, 2, 3))
    turns = tuple(bool(j in rotated or not plain[j]) for j in range(links))
    return Geometry(frame, turn, shift, spread, pitch, length, turns)


def at_rows(g: Geometry, trial: np.ndarray) -> Geometry:
    """The geometry of each row's trial, or one that broadcasts where there is a single trial."""
    if g.length.shape[0] == 1:
        return g
    return Geometry(
        *(a[..., trial, :] for a in (g.frame, g.turn, g.shift, g.spread, g.pitch, g.length)), turns=g.turns
    )


def closure(
    group: Group, g: Geometry, T: Array, theta: Array, freedoms: tuple[int, ...], size: float, joints: list[int], full: bool
) -> Array:
    """Columns of the closure of a group: [unknown joints | platform freedoms | displacements, all joints if `full` | residual].

    Parameters
    ----------
    T : (3, 4, N) platform in base; theta : (J + 1, N, k) joint values; joints : the unknown ones, first columns.

    Returns
    -------
    (r, c, N, k), rows of rotation multiplied by `size`; the residual is the last column.
    """
    last = len(group.joints) + 1
    R = T[:, :3, :, None]
    frames, axes, points, turn, tip = _walk(group, g, theta)
    arm = matvec(R, g.shift[last])
    gap = arm + T[:, 3, :, None] - tip
    tie = _Tie(group, size, gap)
    if full:
        frames.append(matmul(R, g.frame[last]))
    columns = [_joint_column(group, g, tie, j, axes, points, tip) for j in joints]
    columns += [tie.platform(freedom, arm) for freedom in freedoms]
    if full:
        columns += [_slot_column(group, g, tie, s, frames, axes, points, tip, arm, theta) for s in group.slots]
        columns += [_joint_column(group, g, tie, j, axes, points, tip) for j in range(last)]
    if group.ending == "rigid":
        turn = matmul(matmul(R, g.turn[last]), transpose(turn))
    columns.append(tie.residual(turn, g.length + theta[-1]))
    shape = (len(group.rows), len(columns), *gap.shape[1:])
    out = np.empty(shape)
    for c, column in enumerate(columns):
        out[:, c] = column
    return out


class _Tie:
    """How relative motion of attachment against tip appears in the rows of an ending."""

    def __init__(self, group: Group, size: float, gap: Array) -> None:
        self.ending, self.rows, self.size, self.gap = group.ending, list(group.rows), size, gap
        self.zero = np.zeros_like(gap)
        if group.ending == "distance":
            self.distance = np.sqrt(gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2])
            with np.errstate(divide="ignore", invalid="ignore"):
                self.u = gap / self.distance

    def shift(self, direction: Array) -> Array:
        """Rows of a translation along `direction` (3, N, k)."""
        if self.ending == "distance":
            return dot(self.u, direction)[None]
        if self.ending == "ball":
            return direction[self.rows]
        return np.concatenate([self.zero, direction + self.zero])[self.rows]

    def turn(self, axis: Array, arm: Array) -> Array:
        """Rows of a rotation about `axis` whose centre lies `arm` before the point (3, N, k)."""
        velocity = cross(axis, arm)
        if self.ending != "rigid":
            return self.shift(velocity)
        return np.concatenate([self.size * axis + self.zero, velocity + self.zero])[self.rows]

    def platform(self, freedom: int, arm: Array) -> Array:
        """Rows of one platform freedom: a unit turn about, or shift along, a base axis."""
        axis = np.zeros((3,) + (1,) * (arm.ndim - 1))
        axis[freedom % 3] = 1.0
        if self.ending == "distance" and freedom >= 3:
            return self.u[freedom - 3 : freedom - 2]
        return self.turn(axis, arm) if freedom < 3 else self.shift(axis + self.zero)

    def residual(self, turn: Array, length: Array) -> Array:
        """Rows of the closure residual [m]; `turn` takes the tip's orientation to the attachment's."""
        if self.ending == "distance":
            return (self.distance - length)[None]
        if self.ending == "ball":
            return self.gap[self.rows]
        return np.concatenate([self.size * rotation_vector(turn), self.gap])[self.rows]


def _walk(group: Group, g: Geometry, theta: Array) -> tuple[list[Array], list[Array], list[Array], Array, Array]:
    """Frames of the links before their own displaced rotation, joint axes and points, and the tip."""
    frames, axes, points = [g.frame[0]], [], []
    turn, point = g.turn[0], g.shift[0]
    for j, letter in enumerate(group.joints):
        axis, value = turn[:, 2], theta[j]
        axes.append(axis)
        points.append(point)
        if letter == "R":
            c, s = np.cos(value), np.sin(value)
            turn = np.stack(np.broadcast_arrays(c * turn[:, 0] + s * turn[:, 1], c * turn[:, 1] - s * turn[:, 0], axis), axis=1)
            if np.any(g.pitch[j]):
                point = point + (g.pitch[j] * value) * axis
        else:
            point = point + value * axis
        point = point + matvec(turn, g.shift[j + 1])
        frames.append(matmul(turn, g.frame[j + 1]) if g.turns[j + 1] else turn)
        turn = matmul(turn, g.turn[j + 1]) if g.turns[j + 1] else turn
    return frames, axes, points, turn, point


def _joint_column(group: Group, g: Geometry, tie: _Tie, j: int, axes: list[Array], points: list[Array], tip: Array) -> Array:
    """Rows of a unit change of joint j: the tip moves, so closure takes the opposite sign."""
    if j == len(group.joints):
        return np.full((1, *tie.gap.shape[1:]), -1.0) if group.ending == "distance" else np.zeros((len(group.rows), 1, 1))
    if group.joints[j] == "P":
        return -tie.shift(axes[j])
    rows = tie.turn(axes[j], tip - points[j])
    return -(rows + tie.shift(g.pitch[j] * axes[j])) if np.any(g.pitch[j]) else -rows


def _slot_column(
    group: Group, g: Geometry, tie: _Tie, slot, frames: list[Array], axes: list[Array], points: list[Array], tip: Array, arm: Array, theta: Array
) -> Array:
    """Rows of a unit change of one displacement."""
    j, axis, last = slot.element, slot.axis, len(group.joints) + 1
    if axis == LENGTH:
        return np.full((1, *tie.gap.shape[1:]), -1.0)
    if axis == PITCH:
        return -tie.shift(theta[j] * axes[j])
    if axis >= 3:
        rows = tie.shift(frames[j][:, axis - 3])
    else:
        direction = matvec(frames[j], g.spread[j][:, axis])
        origin = points[j] if j < len(points) else tip
        rows = tie.turn(direction, np.zeros_like(arm) if j == last else tip - origin)
    return rows if j == last else -rows


def transpose(a: Array) -> Array:
    """Transpose of (3, 3, ..)."""
    return np.swapaxes(a, 0, 1)


def matmul(a: Array, b: Array) -> Array:
    """Product of (3, 3, ..) and (3, 3, ..)."""
    return a[:, 0, None] * b[None, 0] + a[:, 1, None] * b[None, 1] + a[:, 2, None] * b[None, 2]


def matvec(a: Array, v: Array) -> Array:
    """Product of (3, 3, ..) and (3, ..)."""
    return a[:, 0] * v[0] + a[:, 1] * v[1] + a[:, 2] * v[2]


def _matvec_stack(a: Array, v: Array) -> Array:
    return a[:, :, 0] * v[:, None, 0] + a[:, :, 1] * v[:, None, 1] + a[:, :, 2] * v[:, None, 2]


def dot(a: Array, b: Array) -> Array:
    """Inner product of (3, ..) and (3, ..)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Array, b: Array) -> Array:
    """Cross product of (3, ..) and (3, ..)."""
    return np.stack(
        np.broadcast_arrays(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    )


def _angle_terms(w: Array) -> tuple[Array, Array, Array]:
    """sin(t)/t, (1 - cos t)/t^2, (t - sin t)/t^3 for t = |w|, accurate at zero."""
    t2 = dot(w, w)
    t = np.sqrt(t2)
    small = t < 1e-2
    safe, half = np.where(small, 1.0, t), 0.5 * t
    a = np.where(small, 1 - t2 / 6 * (1 - t2 / 20), np.sin(t) / safe)
    sinc_half = np.where(small, 1 - t2 / 24 * (1 - t2 / 80), np.sin(half) / np.where(small, 1.0, half))
    c = np.where(small, 1 / 6 - t2 / 120 * (1 - t2 / 42), (t - np.sin(t)) / safe**3)
    return a, 0.5 * sinc_half * sinc_half, c


def _series(w: Array, a: Array, b: Array) -> Array:
    """I + a hat(w) + b hat(w)^2 for (3, ..)."""
    x, y, z = w
    one = 1.0 - b * dot(w, w)
    return np.stack(
        [
            np.stack([one + b * x * x, b * x * y - a * z, b * x * z + a * y]),
            np.stack([b * x * y + a * z, one + b * y * y, b * y * z - a * x]),
            np.stack([b * x * z - a * y, b * y * z + a * x, one + b * z * z]),
        ]
    )


def rotation(w: Array) -> Array:
    """exp(hat(w)) by Rodrigues' formula, (3, ..) -> (3, 3, ..)."""
    a, b, _ = _angle_terms(w)
    return _series(w, a, b)


def left_jacobian(w: Array) -> Array:
    """exp(hat(w + d)) = exp(hat(left_jacobian(w) d)) exp(hat(w)) to first order in d, (3, ..) -> (3, 3, ..)."""
    _, b, c = _angle_terms(w)
    return _series(w, b, c)


def rotation_vector(R: Array) -> Array:
    """A vector along the rotation's axis that equals the logarithm for small angles: 2 tan(t/2) axis, safe up to pi.

    Closure only asks for its zero and its slope there, so the cheaper vector serves; measured rotations use the logarithm.
    """
    v = np.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return 2.0 * v / np.maximum(1.0 + R[0, 0] + R[1, 1] + R[2, 2], 1e-3)
