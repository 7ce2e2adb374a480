# SPDX-License-Identifier: Apache-2.0
"""Frames, points and surfaces from measurements in closed form, as starts that need no guess.
Arrays only; SI.

A rotation that enters squares linearly is found on the whole rotation group: `rotations` minimises
a quadratic form of its nine entries from 24 orientations spread evenly over all of them.
"""

from itertools import permutations, product

import numpy as np

from loopcal import geometry
from loopcal.typing import FloatArray

_SIGNED = [
    np.eye(3)[list(order)] * sign
    for order in permutations(range(3))
    for sign in product((1.0, -1.0), repeat=3)
]
OCTAHEDRAL: FloatArray = np.array([R for R in _SIGNED if np.linalg.det(R) > 0.0])
"""The 24 rotations (24, 3, 3) of a cube: none is further than 63 degrees from the nearest."""
OCTAHEDRAL.setflags(write=False)

FLAT = 1e-6
"""Extent across over extent along [1] below which points lie in a plane or on a line."""

SETTLED = 1e-6
"""Change of the entries of a rotation [1] below which taking turns is over: a descent improves what
it finds.
"""


def linear(A: FloatArray, b: FloatArray) -> FloatArray:
    """Least-squares solution of A x = b, the shortest one where it is not unique (relative rank
    tolerance 1e-9).
    """
    return np.asarray(np.linalg.lstsq(A, b, rcond=1e-9)[0], dtype=float)


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Rotations (.., 3, 3) nearest to matrices (.., 3, 3)."""
    U, _, V = np.linalg.svd(M)
    sign = np.ones(M.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(U @ V))
    return (U * sign[..., None, :]) @ V


def kabsch(points: FloatArray, seen: FloatArray) -> FloatArray:
    """Pose T (4, 4) that takes points (r, 3) nearest to others (r, 3), in the mean square.

    Source: Umeyama, IEEE Transactions on Pattern Analysis 13(4) 376, 1991, doi 10.1109/34.88573,
    without the scale.
    """
    middle, centre = points.mean(axis=0), seen.mean(axis=0)
    R = nearest_rotation((seen - centre).T @ (points - middle))
    return geometry.make_pose(R, centre - R @ middle)


def rotations(H: FloatArray, g: FloatArray, best: int = 3) -> FloatArray:
    """Rotations (k, 3, 3) at the lowest local minima of `v' H v - 2 g' v`, v the nine entries of R
    row by row.

    Gauss-Newton on the group from the rotation nearest to the unconstrained minimum and from the 24
    of a cube.

    Parameters
    ----------
    H : (9, 9), positive semidefinite. g : (9,)
    best : how many different ones at most.
    """
    free = nearest_rotation(linear(H, g).reshape(3, 3))
    R = np.concatenate([free[None], OCTAHEDRAL])
    root = _square_root(H)
    target = linear(root.T, g)
    damping = np.full((len(R), 1, 1), 1e-3 * max(float(np.trace(H)), 1e-300))
    cost = _cost(root, target, R)
    for _ in range(40):
        residual = R.reshape(-1, 9) @ root.T - target
        # dR = hat(w) R for w along each axis
        J = root @ np.stack(
            [(geometry.hat(axis) @ R).reshape(-1, 9) for axis in np.eye(3)], axis=-1
        )
        A = np.swapaxes(J, -1, -2) @ J + damping * np.eye(3)
        step = np.asarray(
            -np.linalg.solve(A, np.swapaxes(J, -1, -2) @ residual[..., None])[..., 0], dtype=float
        )
        moved = geometry.exp_so3(step) @ R
        new = _cost(root, target, moved)
        better = new <= cost
        R, cost = np.where(better[:, None, None], moved, R), np.where(better, new, cost)
        damping = np.where(better[:, None, None], 0.1 * damping, 10.0 * damping)
        if np.abs(step).max() < 1e-9:
            break
    return distinct(R[np.argsort(cost)])[:best]


def distinct(R: FloatArray) -> FloatArray:
    """Those of rotations (k, 3, 3) that are further than 0.02 from all before them."""
    kept: list[FloatArray] = []
    for one in R:
        if all(np.abs(one - other).max() > 0.02 for other in kept):
            kept.append(one)
    return np.array(kept)


def hand_eye(
    T: FloatArray, seen: FloatArray, frame: FloatArray | None, tool: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Frame F and tool X with `F seen = T X`; one of them may be known.

    Rotations: the trace of `sum R_F' R_T R_X R_seen'` is largest at the leading singular vectors of
    `sum R_T kron R_seen` (Shah, Journal of Mechanisms and Robotics 5(3) 031007, 2013, doi
    10.1115/1.4024473). Translations: linear.

    Parameters
    ----------
    T : (r, 4, 4) T_base_platform. seen : (r, 4, 4) T_frame_tool. frame, tool : (4, 4), None where
        unknown.
    """
    A, B = T[:, :3, :3], seen[:, :3, :3]
    if tool is not None:
        R_F = (
            nearest_rotation(np.einsum("rij,jk,rlk->il", A, tool[:3, :3], B))
            if frame is None
            else frame[:3, :3]
        )
        R_X = tool[:3, :3]
    elif frame is not None:
        R_F = frame[:3, :3]
        R_X = nearest_rotation(np.einsum("rji,jk,rkl->il", A, R_F, B))
    else:
        K = np.einsum("rij,rkl->ikjl", A, B).reshape(9, 9)
        U, _, V = np.linalg.svd(K)
        left, right = U[:, 0].reshape(3, 3), V[0].reshape(3, 3)
        sign = 1.0 if np.linalg.det(left) > 0.0 else -1.0
        R_F, R_X = nearest_rotation(sign * left), nearest_rotation(sign * right)
    # R_F m + t_F = A t_X + t
    one = np.broadcast_to(np.eye(3), A.shape)
    known = T[:, :3, 3] - seen[:, :3, 3] @ R_F.T
    columns = []
    if frame is None:
        columns.append(one)
    else:
        known = known - frame[:3, 3]
    if tool is None:
        columns.append(-A)
    else:
        known = known + A @ tool[:3, 3]
    found = linear(np.concatenate(columns, axis=-1).reshape(known.size, -1), known.ravel())
    t_F = found[:3] if frame is None else frame[:3, 3]
    t_X = found[-3:] if tool is None else tool[:3, 3]
    return geometry.make_pose(R_F, t_F), geometry.make_pose(R_X, t_X)


def frame_and_points(
    seen: FloatArray, moving: FloatArray, known: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Frames and points from what a frame saw of points on a moving body: `R seen + t = moving p +
    known`.

    Given R, the rest is linear; eliminating it leaves a quadratic form of R.

    Parameters
    ----------
    seen : (q, 3) in the frame. moving : (q, 3, w). known : (q, 3).

    Returns
    -------
    frames : (k, 4, 4) candidates. points : (k, w) with each.
    """
    q, w = len(seen), moving.shape[-1]
    C = np.concatenate([moving, -np.broadcast_to(np.eye(3), (q, 3, 3))], axis=-1).reshape(
        3 * q, w + 3
    )
    M = (np.eye(3)[None, :, :, None] * seen[:, None, None, :]).reshape(3 * q, 9)
    Q = _range(C)
    b = known.ravel()
    M_out, b_out = M - Q @ (Q.T @ M), b - Q @ (Q.T @ b)
    R = rotations(M_out.T @ M_out, M_out.T @ b_out)
    rest = linear(C, (M @ R.reshape(-1, 9).T) - b[:, None]).T
    return geometry.make_pose(R, rest[:, w:]), rest[:, :w]


def resection(rays: FloatArray, points: FloatArray) -> FloatArray:
    """Frames (k, 4, 4) of a station from unit rays (r, 3) in it towards points (r, 3) in the base.

    `(1 - b b') (A p - s) = 0` with A = R' and s = R' t: linear in both; eliminating s leaves a
    quadratic form of A.
    """
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    middle = points.mean(axis=0)
    M = np.einsum("rij,rk->rijk", across, points - middle).reshape(-1, 9)
    C = across.reshape(-1, 3)
    Q = _range(C)
    out = M - Q @ (Q.T @ M)
    A = rotations(out.T @ out, np.zeros(9), best=8)
    s = linear(C, M @ A.reshape(-1, 9).T).T
    ahead = np.einsum("ri,kij,rj->kr", rays, A, points - middle) - np.einsum("ri,ki->kr", rays, s)
    order = np.argsort(-np.mean(ahead > 0.0, axis=1), kind="stable")
    R = np.swapaxes(A, -1, -2)
    return geometry.make_pose(R, (R @ s[..., None])[..., 0] + middle)[order]


def trilateration(
    points: FloatArray, distances: FloatArray, *, with_offset: bool
) -> tuple[FloatArray, FloatArray]:
    """Points c and offsets o with `|p - c| + o = d`; both sides of a plane in or near which all
    points lie.

    `|p|^2 - d^2 = 2 p'c - 2 d o - (|c|^2 - o^2)` is linear in c, o and the bracket.

    Returns
    -------
    centres : (k, 3), offsets : (k,); k = 3, or 2 (one on each side) where the points lie in a
        plane.
    """
    middle = points.mean(axis=0)
    p = points - middle
    _, s, axes = np.linalg.svd(p, full_matrices=False)
    columns = [2.0 * p, -np.ones((len(p), 1))] + (
        [-2.0 * distances[:, None]] if with_offset else []
    )
    found = linear(np.concatenate(columns, axis=1), np.sum(p * p, axis=1) - distances**2)
    offset, centre, normal = found[4] if with_offset else 0.0, found[:3], axes[2]
    foot = centre - (centre @ normal) * normal
    height = np.sqrt(
        max(float(np.mean((distances - offset) ** 2 - np.sum((p - foot) ** 2, axis=1))), 0.0)
    )
    centres = foot + height * np.array([[1.0], [-1.0]]) * normal
    if s[2] > FLAT * s[0]:
        centres = np.concatenate([centre[None], centres])
    return middle + centres, np.full(len(centres), offset)


def directions(
    seen: FloatArray, turns: FloatArray, axis: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Orientations R and directions a with `R seen = turns a`, both unknown (or the direction
    known), best first.

    Each is found in closed form from the other, in turn, from 24 orientations.

    Parameters
    ----------
    seen : (r, 3) unit, in the frame. turns : (r, 3, 3). axis : (3,) or None.

    Returns
    -------
    R : (k, 3, 3). a : (k, 3).
    """
    if axis is not None:
        R = nearest_rotation(np.einsum("rij,j,rk->ik", turns, axis, seen))
        return R[None], axis[None]
    R = np.array(OCTAHEDRAL)
    a = np.zeros((len(R), 3))
    # both steps see the rows through these 27 sums alone
    sums = np.einsum("rji,rl->ijl", turns, seen)
    for _ in range(100):
        a = np.einsum("ijl,kjl->ki", sums, R)
        a /= np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-300)
        before, R = R, nearest_rotation(np.einsum("jil,kj->kil", sums, a))
        if np.abs(R - before).max() < SETTLED:
            break
    missed = np.linalg.norm(
        np.einsum("kij,rj->kri", R, seen) - np.einsum("rij,kj->kri", turns, a), axis=(1, 2)
    )
    order = np.argsort(missed)
    return R[order][:6], a[order][:6]


def _cost(root: FloatArray, target: FloatArray, R: FloatArray) -> FloatArray:
    return np.sum((R.reshape(-1, 9) @ root.T - target) ** 2, axis=-1)


def _square_root(H: FloatArray) -> FloatArray:
    """A matrix S with S'S = H."""
    values, vectors = np.linalg.eigh(H)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def _range(C: FloatArray) -> FloatArray:
    """Orthonormal basis of the columns of C."""
    U, s, _ = np.linalg.svd(C, full_matrices=False)
    return U[:, s > 1e-9 * s[0]]
