# SPDX-License-Identifier: Apache-2.0
"""The closure residual of a group of limbs and its derivatives, for many rows at once.

Inside, arrays carry their components first and the batch (k limbs, N rows) last, so that every
operation runs along contiguous memory: vectors (3, k, N), matrices (3, 3, k, N), columns (r, c, k,
N). Formulas: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from loopcal.engine.numpy_engine.householder import SMALLEST, triangularize
from loopcal.engine.program import (
    BASE,
    LENGTH,
    PITCH,
    Block,
    ClosureBlocks,
    Group,
    Program,
    Slot,
    State,
)
from loopcal.typing import FloatArray

# Rows computed together: few enough for the cache, and enough that Python costs little.
CHUNK = 5120


def linearize(
    program: Program, e: FloatArray, q: FloatArray, state: State, free: bool = False
) -> ClosureBlocks:
    """Linearize closure and eliminate the passive joints; see `loopcal.engine.linearize`."""
    t, n = state.T.shape[:2]
    bodies, trial = list_bodies(state), np.arange(t * n) // max(n, 1)
    closure, passive, eliminated = [], [], []
    for group, joints in zip(program.groups, state.joints, strict=True):
        values = joints if free else group.insert_driven(joints, q)
        theta = values.reshape(t * n, *values.shape[2:]).transpose(2, 1, 0)
        unknown = group.unknown_joints(free)
        with np.errstate(all="ignore"):
            chain = Chain(group, place_links(group, e).select(trial), bodies, theta, program.size)
            rows = chain.reduce(
                unknown,
                *(chain.rows_of_twist(node, f) for node, f in program.unknown_twists),
                *map(chain.rows_of_slot, group.slots),
                *map(chain.rows_of_joint, range(chain.last)),
            )
        rows = rows.transpose(3, 2, 0, 1).reshape(t, n, len(group.limbs), *rows.shape[:2])
        u = len(unknown)
        cuts = np.cumsum([u, len(program.unknown_twists), len(group.slots)])
        passive.append(Block(*np.split(rows[..., :u, :], cuts, axis=-1)))
        closure.append(Block(*np.split(rows[..., u:, :], cuts, axis=-1)))
        eliminated.append(tuple(unknown))
    return ClosureBlocks(tuple(closure), tuple(passive), tuple(eliminated))


class PlacedLinks(NamedTuple):
    """The J + 2 displaced links of a group: placed = nominal . translation(d) . rotation(exp(w)).

    Shapes end in (k, t), or in (k, 1) where all trials are the same. nominal : rotations without
    displacement (J + 2, 3, 3, ..). rotation : the displaced ones. slope : rotation of a link per
    unit of w, nominal . left_jacobian(w). origin : displaced origins (J + 2, 3, ..) [m]. pitch :
    (J, ..). length : (k, ..) of the rods.
    """

    nominal: FloatArray
    rotation: FloatArray
    slope: FloatArray
    origin: FloatArray
    pitch: FloatArray
    length: FloatArray

    def select(self, trial: np.ndarray) -> PlacedLinks:
        """Return the links of each row's trial; a single trial serves all rows."""
        return PlacedLinks(*(a if a.shape[-1] == 1 else a.take(trial, axis=-1) for a in self))


def place_links(group: Group, e: FloatArray) -> PlacedLinks:
    """Place the links of a group for displacements e (t, n_displacements) [m, rad]."""
    t, k, links = len(e), len(group.limbs), len(group.joints) + 2
    displacements = e[:, group.columns].reshape(t, k, len(group.slots)).transpose(2, 1, 0)
    move = np.zeros((links, 6, k, t))
    pitch, length = group.pitch.T[..., None], group.length[:, None]
    if any(slot.axis == PITCH for slot in group.slots):
        pitch = np.repeat(pitch, t, axis=-1)
    for slot, value in zip(group.slots, displacements, strict=True):
        if slot.axis == PITCH:
            pitch[slot.element] += value
        elif slot.axis == LENGTH:
            length = length + value
        else:
            move[slot.element, slot.axis] += value
    transforms = group.links.transpose(1, 2, 3, 0)[..., None]
    nominal = rotation = slope = transforms[:, :3, :3]
    shift = sum(nominal[:, :, i] * move[:, None, 3 + i] for i in range(3))
    if any(slot.axis < 3 for slot in group.slots):
        turned, whole = move[:, :3].swapaxes(0, 1), np.moveaxis(nominal, 0, 2)
        rotation, slope = (
            np.moveaxis(matmul(whole, turn(turned)), 2, 0) for turn in (exponential, left_jacobian)
        )
    return PlacedLinks(nominal, rotation, slope, transforms[:, :3, 3] + shift, pitch, length)


def list_bodies(state: State) -> FloatArray:
    """Return the poses (nodes, 3, 4, t n) of all nodes at a state, as a view of a single one."""
    poses = [T.reshape(-1, 4, 4)[:, :3].transpose(1, 2, 0) for T in (state.T, *state.others)]
    return poses[0][None] if len(poses) == 1 else stack(poses)


class Chain:
    """The limbs of a group at nodes (nodes, 3, 4, N) and joint values theta (J + 1, k, N).

    platform : (3, 3, 1 | k, N) rotation of the body where a limb ends. carrier : (3, 4, 1 | k, N)
    the body where it begins, None for the base. `residual` gives the rows of its ending, the
    `rows_of_` methods their derivatives. Only limbs that end in a distance have `distance`,
    `direction` and `moment`.
    """

    group: Group
    links: PlacedLinks
    theta: FloatArray
    size: float
    last: int
    carrier: FloatArray | None
    before: list[FloatArray | None]
    axes: list[FloatArray]
    origins: list[FloatArray]
    platform: FloatArray
    tip: FloatArray
    tip_rotation: FloatArray
    arm: FloatArray
    gap: FloatArray
    distance: FloatArray

    def __init__(
        self, group: Group, links: PlacedLinks, bodies: FloatArray, theta: FloatArray, size: float
    ) -> None:
        self.group, self.links, self.theta, self.size = group, links, theta, size
        self.last = len(group.joints) + 1
        # rotation before each link, axis of each joint, origin behind each link
        rotation, point = links.rotation[0], links.origin[0]
        self.carrier = None
        if group.on[0] != BASE:
            self.carrier = carrier = _select_bodies(bodies, group.on)
            rotation = matmul(carrier[:, :3], rotation)
            point = matvec(carrier[:, :3], point) + carrier[:, 3]
        before = None if self.carrier is None else self.carrier[:, :3]
        self.before = [before]
        self.axes, self.origins = list[FloatArray](), [point]
        for j, letter in enumerate(group.joints):
            axis, value = rotation[:, 2], theta[j]
            self.axes.append(axis)
            if letter == "P" or links.pitch[j].any():
                point = point + (value if letter == "P" else links.pitch[j] * value) * axis
            if letter == "R":
                c, s = np.cos(value), np.sin(value)
                x, y = rotation[:, 0], rotation[:, 1]
                rotation = stack((c * x + s * y, c * y - s * x, axis)).swapaxes(0, 1)
            self.before.append(rotation)
            point = point + matvec(rotation, links.origin[j + 1])
            self.origins.append(point)
            rotation = matmul(rotation, links.rotation[j + 1])
        end = _select_bodies(bodies, group.to)
        self.platform = end[:, :3]
        self.before.append(self.platform)
        self.tip, self.tip_rotation = point, rotation
        self.arm = matvec(self.platform, links.origin[self.last])
        self.gap = self.arm + end[:, 3] - point
        if group.ending == "distance":
            self.distance = np.sqrt(dot(self.gap, self.gap))

    @cached_property
    def direction(self) -> FloatArray:
        """Unit vector of the gap (3, k, N)."""
        return self.gap / self.distance

    @cached_property
    def moment(self) -> FloatArray:
        """Moment of this unit vector at the attachment about the platform's origin (3, k, N)."""
        return cross(self.arm, self.direction)

    def residual(self) -> FloatArray:
        """Return the closure residual (r, k, N) [m]."""
        if self.group.ending == "distance":
            return (self.distance - (self.links.length + self.theta[-1]))[None]
        if self.group.ending == "ball":
            return self.gap[list(self.group.rows)]
        # 2 tan(a/2) along the axis: zero and slope as the logarithm's, and safe up to half a turn
        attachment = matmul(self.platform, self.links.rotation[self.last])
        R = matmul(attachment, np.swapaxes(self.tip_rotation, 0, 1))
        v = np.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        twice = 2.0 * self.size * v / np.maximum(1.0 + R[0, 0] + R[1, 1] + R[2, 2], 1e-3)
        return np.concatenate([twice, self.gap])[list(self.group.rows)]

    def rows_of_shift(self, direction: FloatArray) -> FloatArray:
        """Return the rows of moving the attachment along `direction` (3, k, N) against the tip."""
        if self.group.ending == "distance":
            return dot(self.direction, direction)[None]
        if self.group.ending == "ball":
            return direction[list(self.group.rows)]
        rows = stack((*np.zeros((3, 1, 1)), *direction))
        return rows[list(self.group.rows)]

    def rows_of_turn(self, axis: FloatArray, arm: FloatArray) -> FloatArray:
        """Return the rows of turning about `axis`, attachment or tip at `arm` from the center."""
        if self.group.ending != "rigid":
            return self.rows_of_shift(cross(axis, arm))
        rows = stack((*(self.size * axis), *cross(axis, arm)))
        return rows[list(self.group.rows)]

    def rows_of_axis(self, f: int, arm: FloatArray) -> FloatArray:
        """Return the rows of a turn about (f = 0..2) or a shift along (3..5) a base axis."""
        axis = np.eye(3)[f % 3, :, None, None]
        return self.rows_of_turn(axis, arm) if f < 3 else self.rows_of_shift(axis)

    def rows_of_freedom(self, f: int) -> FloatArray:
        """Return the rows of a freedom of the body at which the limbs end."""
        if self.group.ending == "distance":
            return (self.moment if f < 3 else self.direction)[f % 3][None]
        return self.rows_of_axis(f, self.arm)

    def rows_of_carrier(self, f: int) -> FloatArray:
        """Return the rows of a freedom of the body on which the limbs begin; it moves the tip."""
        assert self.carrier is not None
        return -self.rows_of_axis(f, self.tip - self.carrier[:, 3])

    def list_slopes(self, program: Program) -> list[FloatArray]:
        """Return the rows of the freedoms of the bodies at which the limbs begin, then end."""
        on, to = (
            () if i == BASE else program.nodes[i] for i in (self.group.on[0], self.group.to[0])
        )
        return [*map(self.rows_of_carrier, on), *map(self.rows_of_freedom, to)]

    def rows_of_twist(self, node: int, f: int) -> FloatArray:
        """Return the rows of a freedom of a node, zero in limbs that it does not touch."""
        rows: FloatArray = np.zeros((1, 1, 1))
        for ends, slopes in (
            (self.group.to, self.rows_of_freedom),
            (self.group.on, self.rows_of_carrier),
        ):
            if node in ends:
                share = np.equal(ends, node)
                rows = rows + (slopes(f) if share.all() else slopes(f) * share[:, None])
        return rows

    def rows_of_joint(self, j: int) -> FloatArray:
        """Return the rows of a unit change of joint j; it moves the tip, hence the minus sign."""
        if j == len(self.group.joints):
            return -np.ones((1, 1, 1)) if self.group.ending == "distance" else np.zeros((1, 1, 1))
        axis = self.axes[j]
        if self.group.joints[j] == "P":
            return -self.rows_of_shift(axis)
        rows, pitch = self.rows_of_turn(axis, self.tip - self.origins[j]), self.links.pitch[j]
        return -rows - self.rows_of_shift(pitch * axis) if pitch.any() else -rows

    def rows_of_slot(self, slot: Slot) -> FloatArray:
        """Return the rows of a unit change of a displacement."""
        j, axis = slot.element, slot.axis
        if axis == LENGTH:
            return -np.ones((1, 1, 1))
        if axis == PITCH:
            return -self.rows_of_shift(self.theta[j] * self.axes[j])
        local = self.links.slope[j][:, axis] if axis < 3 else self.links.nominal[j][:, axis - 3]
        before = self.before[j]
        direction = local if before is None else matvec(before, local)
        arm = np.zeros((3, 1, 1)) if j == self.last else self.tip - self.origins[j]
        rows = self.rows_of_shift(direction) if axis >= 3 else self.rows_of_turn(direction, arm)
        return rows if j == self.last else -rows

    def reduce(self, unknown: Sequence[int], *columns: FloatArray) -> FloatArray:
        """Return rows (r, c, k, N) against unknown joints, which eliminate them, then columns."""
        columns = (*map(self.rows_of_joint, unknown), *columns)
        k, N = self.gap.shape[1:]
        # limb by limb in memory: the rows of all limbs are one matrix without a copy
        out = np.empty((k, len(self.group.rows), len(columns), N)).transpose(1, 2, 0, 3)
        for c, column in enumerate(columns):
            out[:, c] = column
        return triangularize(out, len(unknown))


def _select_bodies(bodies: FloatArray, numbers: Sequence[int]) -> FloatArray:
    """Return the poses (3, 4, k, N) of bodies; (3, 4, 1, N | 1) where all are the same one."""
    if len(set(numbers)) > 1:
        return np.ascontiguousarray(bodies[list(numbers)].transpose(1, 2, 0, 3))
    return np.eye(4)[:3, :, None, None] if numbers[0] == BASE else bodies[numbers[0], :, :, None]


def list_coordinates(
    program: Program, q: FloatArray, start: State, shape: tuple[int, int]
) -> FloatArray:
    """Return the coordinates (12 a node + joint values, t n) of a start, actuated joints at q."""
    count = sum(joints.shape[2] * joints.shape[3] for joints in start.joints)
    out = np.empty((12 * len(program.nodes) + count, *shape))
    for i, T in enumerate((start.T, *start.others)):
        out[12 * i : 12 * i + 12].reshape(3, 4, *shape)[:] = T[:, :, :3].transpose(2, 3, 0, 1)
    flat = out.reshape(len(out), shape[0] * shape[1])
    limbs = split_joints(program, flat)
    for group, joints, theta in zip(program.groups, start.joints, limbs, strict=True):
        values = theta.reshape(*theta.shape[:2], *shape)
        values[:] = group.insert_driven(joints, q).transpose(3, 2, 0, 1)
    return flat


def split_bodies(program: Program, coordinates: FloatArray) -> FloatArray:
    """Return the poses (nodes, 3, 4, N) of the nodes as a view into coordinates."""
    count = len(program.nodes)
    return coordinates[: 12 * count].reshape(count, 3, 4, coordinates.shape[1])


def divide_rows(count: int) -> list[slice]:
    """Return parts of almost equal size, at most CHUNK rows each, that are computed together."""
    step = -(-count // max(-(-count // CHUNK), 1))
    return [slice(first, first + step) for first in range(0, count, max(step, 1))]


def split_joints(program: Program, coordinates: FloatArray) -> list[FloatArray]:
    """Return the joint values (J + 1, k, N) of each group as views into coordinates."""
    out, first = [], 12 * len(program.nodes)
    for group in program.groups:  # the rod counts as a joint
        values, limbs = len(group.joints) + 1, len(group.limbs)
        last = first + values * limbs
        out.append(coordinates[first:last].reshape(values, limbs, coordinates.shape[1]))
        first = last
    return out


def add_terms(terms: FloatArray) -> FloatArray:
    """Return the sums (..) of terms (k, ..), always added in their order.

    NumPy adds eight or more numbers of a single row in pairs, so that its sum would have other bits
    than beside other rows.
    """
    is_single = terms.size == len(terms)
    return np.add.accumulate(terms)[-1] if is_single and terms.size else np.add.reduce(terms)


def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """Multiply (3, 3, ..) by (3, 3, ..)."""
    return a[:, 0, None] * b[None, 0] + a[:, 1, None] * b[None, 1] + a[:, 2, None] * b[None, 2]


def matvec(a: FloatArray, v: FloatArray) -> FloatArray:
    """Multiply (3, 3, ..) by (3, ..)."""
    return a[:, 0] * v[0] + a[:, 1] * v[1] + a[:, 2] * v[2]


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the inner product of (3, ..) and (3, ..)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product of (3, ..) and (3, ..)."""
    out = np.empty((3, *np.broadcast(a[0], b[0]).shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=out[i])
        out[i] -= a[k] * b[j]
    return out


def stack(arrays: Sequence[FloatArray]) -> FloatArray:
    """Return arrays as one, (arrays, ..), each as large as the largest; faster than `np.stack`."""
    out = np.empty((len(arrays), *max(arrays, key=np.size).shape))
    for i, array in enumerate(arrays):
        out[i] = array
    return out


def exponential(w: FloatArray) -> FloatArray:
    """Return exp(hat(w)) by Rodrigues' formula, (3, ..) -> (3, 3, ..)."""
    # SMALLEST keeps sin(t) / t at one for no turn; (1 - cos t) / t^2 = (sin(t / 2) / (t / 2))^2 / 2
    t = np.sqrt(dot(w, w) + SMALLEST)
    half = np.sin(0.5 * t) / (0.5 * t)
    return _polynomial(w, np.sin(t) / t, 0.5 * half * half)


def left_jacobian(w: FloatArray) -> FloatArray:
    """Return J with exp(hat(w + d)) = exp(hat(J d)) exp(hat(w)) to first order in d."""
    t2 = dot(w, w)
    t, half = np.sqrt(t2), np.sinc(np.sqrt(t2) / (2 * np.pi))
    tail = np.where(t < 0.02, 1 / 6 - t2 / 120, (t - np.sin(t)) / np.where(t < 0.02, 1.0, t2 * t))
    return _polynomial(w, 0.5 * half * half, tail)


def _polynomial(w: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return I + a hat(w) + b hat(w)^2 for (3, ..)."""
    x, y, z = w
    bx, by, bz, rest = b * x, b * y, b * z, 1.0 - b * dot(w, w)
    ax, ay, az, bxy, bxz, byz = a * x, a * y, a * z, bx * y, bx * z, by * z
    first = (rest + bx * x, bxy - az, bxz + ay, bxy + az, rest + by * y)
    last = (byz - ax, bxz - ay, byz + ax, rest + bz * z)
    return stack(first + last).reshape(3, 3, *rest.shape)
