# SPDX-License-Identifier: Apache-2.0
"""Alignment in closed form: frames, points and centers from points, poses, rays or lengths.

These functions need no initial guess. They work on arrays in SI units. Problems that are quadratic
in a rotation are solved over the whole rotation group by `minimize_over_rotations`. The only one
that scipy.spatial.transform could solve is `align_point_sets`, two lines on our projection.
"""

from itertools import permutations, product

import numpy as np

from loopcal.geometry.rigid_transforms import make_pose
from loopcal.geometry.rotations import exp_so3, hat, left_jacobian_so3, project_to_rotations
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import FloatArray, IntArray

_SIGNED_PERMUTATIONS = [
    np.eye(3)[list(order)] * sign
    for order in permutations(range(3))
    for sign in product((1.0, -1.0), repeat=3)
]
OCTAHEDRAL_ROTATIONS: FloatArray = np.array(
    [R for R in _SIGNED_PERMUTATIONS if np.linalg.det(R) > 0.0]
)
"""The 24 rotations (24, 3, 3) of a cube: every rotation is within 63 degrees of one of them."""
OCTAHEDRAL_ROTATIONS.setflags(write=False)

TINY = 1e-300
"""Divisor [1] in place of zero."""

FLATNESS = 1e-6
"""Ratio of extents [1] below which points count as coplanar, or as collinear."""

ROTATION_CHANGE = 1e-6
"""Change of the entries of a rotation [1] that ends the alternation in `solve_directions`; a
descent refines the result anyway.
"""

ALIGNMENT_TOLERANCE = 1e-9
"""Singular values below this share of the largest count as zero [1]."""

ANCHOR_TOLERANCE, ANCHOR_RANK = 1e-6, 4
"""Relative singular value [1] below which positions do not determine the anchor of a line, and the
rank that determines it.
"""


def solve_least_squares(A: FloatArray, b: FloatArray) -> FloatArray:
    """Return the least-squares solution of `A x = b`, the shortest one where it is not unique.

    Singular values below `ALIGNMENT_TOLERANCE` times the largest count as zero.
    """
    return np.asarray(np.linalg.lstsq(A, b, rcond=ALIGNMENT_TOLERANCE)[0], dtype=float)


def align_point_sets(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the pose T (4, 4) that minimizes `sum |T p - r|^2` over points p, reference r (r, 3).

    Source: Umeyama, IEEE Transactions on Pattern Analysis 13(4) 376, 1991, doi 10.1109/34.88573,
    without the scale.
    """
    middle, center = points.mean(axis=0), reference.mean(axis=0)
    R = project_to_rotations((reference - center).T @ (points - middle))
    return make_pose(R, center - R @ middle)


def minimize_over_rotations(H: FloatArray, g: FloatArray, count: int = 3) -> FloatArray:
    """Return the rotations (k, 3, 3) at the lowest local minima of `v' H v - 2 g' v`.

    The vector v holds the nine entries of R row by row. Damped Gauss-Newton on the rotation group
    begins at the rotation nearest to the unconstrained minimum and at the 24 rotations of a cube.

    Parameters
    ----------
    H : (9, 9), positive semidefinite. g : (9,)
    count : largest number of different rotations to return.
    """
    from loopcal.numerics.multistart import minimize_from_starts

    unconstrained = project_to_rotations(solve_least_squares(H, g).reshape(3, 3))
    start = np.concatenate([unconstrained[None], OCTAHEDRAL_ROTATIONS])
    root = _square_root(H)
    root = root / max(float(np.linalg.norm(root)), TINY)  # residuals of order one
    target = solve_least_squares(root.T, g / max(float(np.trace(H)), TINY))

    def linearize(vector: FloatArray, numbers: IntArray) -> tuple[FloatArray, FloatArray]:
        R, turn = exp_so3(vector) @ start[numbers], left_jacobian_so3(vector)
        # dR = hat(w) R for w along each axis
        by_turn = np.stack([(hat(axis) @ R).reshape(-1, 9) for axis in np.eye(3)], axis=-1)
        return R.reshape(-1, 9) @ root.T - target, root @ by_turn @ turn

    vector, cost = minimize_from_starts(linearize, np.zeros((len(start), 3)))
    return _select_distinct((exp_so3(vector) @ start)[np.argsort(cost)])[:count]


def _select_distinct(R: FloatArray) -> FloatArray:
    """Return those of the rotations (k, 3, 3) whose entries differ by more than 0.02 from all
    earlier ones.
    """
    kept: list[FloatArray] = []
    for rotation in R:
        if all(np.abs(rotation - other).max() > 0.02 for other in kept):
            kept.append(rotation)
    return np.array(kept)


def solve_hand_eye(
    T: FloatArray, measured: FloatArray, frame: FloatArray | None, tool: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return frame F and tool X (4, 4) with `F measured = T X`; at most one of them is given.

    Rotations: the trace of `sum R_F' R_T R_X R_measured'` is largest at the leading singular
    vectors of `sum R_T kron R_measured` (Shah, Journal of Mechanisms and Robotics 5(3) 031007,
    2013, doi 10.1115/1.4024473). Translations follow from a linear system.

    Parameters
    ----------
    T : (r, 4, 4) T_base_platform.
    measured : (r, 4, 4) T_frame_tool.
    frame, tool : (4, 4), or None where unknown.
    """
    A, B = T[:, :3, :3], measured[:, :3, :3]
    if tool is not None:
        R_F = (
            project_to_rotations(np.einsum("rij,jk,rlk->il", A, tool[:3, :3], B))
            if frame is None
            else frame[:3, :3]
        )
        R_X = tool[:3, :3]
    elif frame is not None:
        R_F = frame[:3, :3]
        R_X = project_to_rotations(np.einsum("rji,jk,rkl->il", A, R_F, B))
    else:
        K = np.einsum("rij,rkl->ikjl", A, B).reshape(9, 9)
        U, _, V = np.linalg.svd(K)
        left, right = U[:, 0].reshape(3, 3), V[0].reshape(3, 3)
        sign = 1.0 if np.linalg.det(left) > 0.0 else -1.0
        R_F, R_X = project_to_rotations(sign * left), project_to_rotations(sign * right)
    # R_F m + t_F = A t_X + t
    identity = np.broadcast_to(np.eye(3), A.shape)
    rhs = T[:, :3, 3] - measured[:, :3, 3] @ R_F.T
    columns = []
    if frame is None:
        columns.append(identity)
    else:
        rhs = rhs - frame[:3, 3]
    if tool is None:
        columns.append(-A)
    else:
        rhs = rhs + A @ tool[:3, 3]
    solution = solve_least_squares(
        np.concatenate(columns, axis=-1).reshape(rhs.size, -1), rhs.ravel()
    )
    t_F = solution[:3] if frame is None else frame[:3, 3]
    t_X = solution[-3:] if tool is None else tool[:3, 3]
    return make_pose(R_F, t_F), make_pose(R_X, t_X)


def solve_frame_and_points(
    measured: FloatArray, moving: FloatArray, constant: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a frame and points on a moving body from `R measured + t = moving p + constant`.

    For a given rotation R the other unknowns enter linearly. Eliminating them leaves a quadratic
    form of R.

    Parameters
    ----------
    measured : (q, 3) points in the frame. moving : (q, 3, w). constant : (q, 3).

    Returns
    -------
    frames : (k, 4, 4) candidates (R, t). points : (k, w), p of each candidate.
    """
    q, w = len(measured), moving.shape[-1]
    C = np.concatenate([moving, -np.broadcast_to(np.eye(3), (q, 3, 3))], axis=-1).reshape(
        3 * q, w + 3
    )
    M = (np.eye(3)[None, :, :, None] * measured[:, None, None, :]).reshape(3 * q, 9)
    Q = _column_space(C)
    b = constant.ravel()
    M_out, b_out = M - Q @ (Q.T @ M), b - Q @ (Q.T @ b)
    R = minimize_over_rotations(M_out.T @ M_out, M_out.T @ b_out)
    rest = solve_least_squares(C, (M @ R.reshape(-1, 9).T) - b[:, None]).T
    return make_pose(R, rest[:, w:]), rest[:, :w]


def solve_resection(rays: FloatArray, points: FloatArray) -> FloatArray:
    """Return candidate frames (k, 4, 4) of a station from rays to known points, the best first.

    `(1 - b b') (A p - s) = 0` with A = R' and s = R' t is linear in A and s. Eliminating s leaves a
    quadratic form of A.

    Parameters
    ----------
    rays : (r, 3) unit vectors b in the frame of the station.
    points : (r, 3) points p in the base [m].
    """
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    middle = points.mean(axis=0)
    M = np.einsum("rij,rk->rijk", across, points - middle).reshape(-1, 9)
    C = across.reshape(-1, 3)
    Q = _column_space(C)
    out = M - Q @ (Q.T @ M)
    A = minimize_over_rotations(out.T @ out, np.zeros(9), count=8)
    s = solve_least_squares(C, M @ A.reshape(-1, 9).T).T
    ahead = np.einsum("ri,kij,rj->kr", rays, A, points - middle) - np.einsum("ri,ki->kr", rays, s)
    order = np.argsort(-np.mean(ahead > 0.0, axis=1), kind="stable")
    R = np.swapaxes(A, -1, -2)
    return make_pose(R, (R @ s[..., None])[..., 0] + middle)[order]


def solve_trilateration(
    points: FloatArray, distances: FloatArray, *, with_offset: bool
) -> tuple[FloatArray, FloatArray]:
    """Return centers c and offsets o with `|p - c| + o = d`.

    `|p|^2 - d^2 = 2 p'c - 2 d o - (|c|^2 - o^2)` is linear in c, o and the bracket. Distances from
    points near a plane do not determine on which side of it c is, so both sides are candidates.

    Parameters
    ----------
    points : (r, 3) p [m]. distances : (r,) d [m]. with_offset : whether o is unknown; else 0.

    Returns
    -------
    centers : (k, 3), offsets : (k,); k = 3, or 2 (one on each side) where the points are coplanar.
    """
    middle = points.mean(axis=0)
    p = points - middle
    _, s, axes = np.linalg.svd(p, full_matrices=False)
    columns = [2.0 * p, -np.ones((len(p), 1))] + (
        [-2.0 * distances[:, None]] if with_offset else []
    )
    solution = solve_least_squares(
        np.concatenate(columns, axis=1), np.sum(p * p, axis=1) - distances**2
    )
    offset, center, normal = solution[4] if with_offset else 0.0, solution[:3], axes[2]
    foot = center - (center @ normal) * normal
    height = np.sqrt(
        max(float(np.mean((distances - offset) ** 2 - np.sum((p - foot) ** 2, axis=1))), 0.0)
    )
    centers = foot + height * np.array([[1.0], [-1.0]]) * normal
    if s[2] > FLATNESS * s[0]:
        centers = np.concatenate([center[None], centers])
    return middle + centers, np.full(len(centers), offset)


def solve_line_anchor(
    positions: FloatArray, extensions: FloatArray
) -> tuple[FloatArray, int, FloatArray]:
    """Return the anchor a of a line from positions x and the extensions d of the line at them.

    A line from a to x is d longer than at the origin: `|x - a| = |a| + d`, and therefore `x'a + d
    |a| = (x'x - d^2) / 2`, which is linear in a and |a|.

    Parameters
    ----------
    positions : (k, 3) x. extensions : (k,) d, in the same unit.

    Returns
    -------
    anchor : (3,) a.
    rank : of the equations. Below `ANCHOR_RANK` the positions are too few, or in a plane through
        the origin, and the anchor is not determined.
    singular_values : of the equations.
    """
    rows = np.column_stack([positions, extensions])
    target = 0.5 * ((positions * positions).sum(axis=1) - extensions * extensions)
    solution, _, rank, s = np.linalg.lstsq(rows, target, rcond=ANCHOR_TOLERANCE)
    return solution[:3], int(rank), s


def solve_directions(
    measured: FloatArray, rotations: FloatArray, axis: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return orientations R and directions a with `R measured = rotations a`, the best first.

    Each of R and a follows in closed form from the other one. The alternation begins at 24
    orientations. A given `axis` leaves R alone, in one step.

    Parameters
    ----------
    measured : (r, 3) unit vectors in the frame of the instrument.
    rotations : (r, 3, 3).
    axis : (3,) the direction a, or None where unknown.

    Returns
    -------
    R : (k, 3, 3). a : (k, 3).
    """
    if axis is not None:
        R = project_to_rotations(np.einsum("rij,j,rk->ik", rotations, axis, measured))
        return R[None], axis[None]
    R = np.array(OCTAHEDRAL_ROTATIONS)
    a = np.zeros((len(R), 3))
    # both steps need the rows only through these 27 sums
    sums = np.einsum("rji,rl->ijl", rotations, measured)
    for _ in range(100):
        a = np.einsum("ijl,kjl->ki", sums, R)
        a /= np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-300)
        before, R = R, project_to_rotations(np.einsum("jil,kj->kil", sums, a))
        if np.abs(R - before).max() < ROTATION_CHANGE:
            break
    error = np.linalg.norm(
        np.einsum("kij,rj->kri", R, measured) - np.einsum("rij,kj->kri", rotations, a), axis=(1, 2)
    )
    order = np.argsort(error)
    return R[order][:6], a[order][:6]


def _square_root(H: FloatArray) -> FloatArray:
    """Return a matrix S with S'S = H."""
    values, vectors = np.linalg.eigh(H)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def _column_space(C: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the columns of C."""
    U, s, _ = np.linalg.svd(C, full_matrices=False)
    return U[:, are_nonzero(s, ALIGNMENT_TOLERANCE)]
