# SPDX-License-Identifier: Apache-2.0
"""A camera and a flat board: projection, the pose of a board, and a camera calibrated alone.

The pinhole camera with the distortion of Brown and Conrady, as in OpenCV. With a point (x, y, z) in
the frame of the camera, whose z axis is the line of sight, a = x / z, b = y / z, s = a^2 + b^2:

    g = 1 + k1 s + k2 s^2 + k3 s^3
    u = fx (a g + 2 p1 a b + p2 (s + 2 a^2)) + cx
    v = fy (b g + p1 (s + 2 b^2) + 2 p2 a b) + cy

Source: Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8) 855, 1971.
The closed form of the focal length is that of Zhang, IEEE Transactions on Pattern Analysis and
Machine Intelligence 22(11) 1330, 2000, doi 10.1109/34.888718, for a known center.
Arrays of pictures: n pictures of k points; a point that a picture lacks is NaN.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.numerics.elimination import eliminate_columns
from loopcal.typing import BoolArray, FloatArray

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2")  # the order of lens parameters
NEAREST = 1e-3
"""Share of the distance from the camera below which the depth of a point is not taken, so that a
point beside or behind the camera has a large, finite residual that leads back."""
FEWEST = 4  # points of a picture that determine the pose of a board
LEVEL = 1e-5  # tilt of boards, as a share of squared slopes, below which they count as level
STEPS, HALVINGS, CHANGE = 40, 6, 1e-8  # of the descent; a relative change that ends it
FEW_STEPS = 10  # of the descent to the pose of a board from a closed form
ROUNDING = 1e-12  # relative increase of a sum of squares that is none


def project(
    x: FloatArray, lens: FloatArray, with_slopes: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels (.., 2) of points x (.., 3) [m] in the frame of the camera, and their
    derivatives (.., 2, 3) by the points and (.., 2, 9) by the lens (.., 9); without slopes, empty.
    """
    fx, fy, cx, cy, k1, k2, k3, p1, p2 = (lens[..., i] for i in range(9))
    near = NEAREST * np.sqrt((x * x).sum(axis=-1))
    is_ahead = x[..., 2].real > near.real
    depth = np.where(is_ahead, x[..., 2], np.where(near == 0.0, 1.0, near))
    a, b = x[..., 0] / depth, x[..., 1] / depth
    aa, ab, bb = a * a, a * b, b * b
    s = aa + bb
    g = 1.0 + s * (k1 + s * (k2 + s * k3))
    across, up = a * g + 2.0 * p1 * ab + p2 * (s + 2.0 * aa), b * g + p1 * (s + 2.0 * bb)
    up = up + 2.0 * p2 * ab
    pixels = np.stack([fx * across + cx, fy * up + cy], axis=-1)
    if not with_slopes:
        return pixels, np.empty(0), np.empty(0)
    bend = k1 + s * (2.0 * k2 + 3.0 * s * k3)  # dg / ds
    by_a = fx * (g + 2.0 * aa * bend + 2.0 * p1 * b + 6.0 * p2 * a)
    mixed = 2.0 * (ab * bend + p1 * a + p2 * b)
    by_b = fy * (g + 2.0 * bb * bend + 6.0 * p1 * b + 2.0 * p2 * a)
    rows = []
    for of_a, of_b in ((by_a, fx * mixed), (fy * mixed, by_b)):
        by_depth = np.where(is_ahead, -(of_a * a + of_b * b) / depth, 0.0)
        rows.append(np.stack([of_a / depth, of_b / depth, by_depth], axis=-1))
    by_point = np.stack(rows, axis=-2)
    zero, one = np.zeros_like(a), np.ones_like(a)
    fa, fb = fx * a * s, fy * b * s
    of_u = (across, zero, one, zero, fa, fa * s, fa * s * s, fx * 2.0 * ab, fx * (s + 2.0 * aa))
    of_v = (zero, up, zero, one, fb, fb * s, fb * s * s, fy * (s + 2.0 * bb), fy * 2.0 * ab)
    by_lens = np.stack(
        [np.stack(np.broadcast_arrays(*row), axis=-1) for row in (of_u, of_v)], axis=-2
    )
    return pixels, by_point, by_lens


def find_rays(pixels: FloatArray, lens: FloatArray) -> FloatArray:
    """Return (a, b, 1) (.., 3) of pixels (.., 2): the distortion removed by Newton's method."""
    ray = np.ones((*pixels.shape[:-1], 3))
    ray[..., :2] = plain = (pixels - lens[2:4]) / lens[:2]
    for _ in range(10):
        found, by_point, _ = project(ray, lens)
        step = np.linalg.solve(by_point[..., :2], (found - pixels)[..., None])[..., 0]
        ray[..., :2] -= np.where(np.isfinite(step), np.clip(step, -0.2, 0.2), 0.0)
    # far outside the picture a distortion may have no inverse: then without it
    is_found = np.abs(ray[..., :2] - plain).max(axis=-1, keepdims=True) < 0.5
    ray[..., :2] = np.where(is_found, ray[..., :2], plain)
    return ray


def find_present(pixels: FloatArray) -> BoolArray:
    """Return which points (n, k) pictures (n, k, 2) show."""
    return np.asarray(~np.isnan(pixels).any(axis=-1))


def shows_board(points: FloatArray, pixels: FloatArray) -> BoolArray:
    """Return which pictures (n, k, 2) show enough of the points (k, 3) for the pose of the board:
    four or more that are not on a line.
    """
    present = find_present(pixels)
    enough = present.sum(axis=1) >= FEWEST
    for i in np.flatnonzero(enough):
        flat = points[present[i], :2] - points[present[i], :2].mean(axis=0)
        s = np.linalg.svd(flat, compute_uv=False)
        enough[i] = s[1] > 0.02 * s[0]
    return np.asarray(enough)


def solve_homography(flat: FloatArray, image: FloatArray) -> FloatArray:
    """Return H (3, 3) with `image ~ H (flat, 1)` for points (k, 2), by the normalized direct linear
    transformation (Hartley, IEEE TPAMI 19(6) 580, 1997, doi 10.1109/34.601246).
    """
    normal = []
    for points in (flat, image):
        middle = points.mean(axis=0)
        scale = np.sqrt(2.0) / max(np.sqrt(((points - middle) ** 2).sum(axis=1)).mean(), 1e-300)
        normal.append(
            np.array(
                [[scale, 0.0, -scale * middle[0]], [0.0, scale, -scale * middle[1]], [0, 0, 1]]
            )
        )
    ones = np.ones((len(flat), 1))
    p, q = (np.hstack([of, ones]) @ N.T for of, N in zip((flat, image), normal, strict=True))
    zero = np.zeros_like(p)
    rows = np.concatenate(
        [np.hstack([p, zero, -q[:, :1] * p]), np.hstack([zero, p, -q[:, 1:2] * p])]
    )
    H = np.linalg.svd(rows, full_matrices=True)[2][-1].reshape(3, 3)
    return np.linalg.solve(normal[1], H @ normal[0])


def solve_focal_lengths(
    points: FloatArray, pixels: FloatArray, center: FloatArray
) -> FloatArray | None:
    """Return fx and fy (2,) from pictures (n, k, 2) of points (k, 3) and the center (2,); None
    where the pictures do not determine them.

    The first two columns h of a homography are perpendicular and of equal length in the image of
    the absolute conic, diag(1 / fx^2, 1 / fy^2, 1) about the center: two equations a picture.
    """
    present = find_present(pixels)
    H = np.array(
        [solve_homography(points[present[i], :2], of[present[i]]) for i, of in enumerate(pixels)]
    )
    H[:, :2] -= center[:, None] * H[:, 2:]
    H /= np.linalg.norm(H, axis=(1, 2), keepdims=True)
    first, second = H[..., 0], H[..., 1]
    both = np.concatenate([first * second, first * first - second * second])
    scale = np.linalg.norm((first * first + second * second)[:, :2])
    for columns in (both[:, :2], both[:, :2].sum(axis=1, keepdims=True)):  # else fx = fy
        weights, _, rank, s = np.linalg.lstsq(columns, -both[:, 2], rcond=None)
        is_determined = rank == columns.shape[1] and s[-1] > max(1e-4 * s[0], LEVEL * scale)
        if is_determined and (weights > 0.0).all():
            focal = 1.0 / np.sqrt(weights)
            return np.broadcast_to(focal, 2).copy()
    return None


def locate_boards(points: FloatArray, pixels: FloatArray, lens: FloatArray) -> FloatArray:
    """Return T_camera_board (n, 4, 4) of pictures (n, k, 2) of points (k, 3), which are nearly flat
    in z, with a lens (9,); the better of the two poses that a flat board may have.
    """
    rays = find_rays(np.nan_to_num(pixels), lens)
    starts = []
    for i, present in enumerate(find_present(pixels)):
        H = solve_homography(points[present, :2], rays[i, present, :2])
        H = H / np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1]))
        middle = H @ np.append(points[present, :2].mean(axis=0), 1.0)
        H = H if middle[2] > 0.0 else -H
        R = geometry.project_to_rotations(
            np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])])
        )
        # the other pose: the normal mirrored at the line of sight, about the middle of the board
        sight = middle / np.linalg.norm(middle)
        half = np.cross(R[:, 2], sight)
        sine = np.linalg.norm(half)
        turn = 2.0 * np.arctan2(sine, abs(R[:, 2] @ sight)) * np.sign(R[:, 2] @ sight)
        R_other = geometry.exp_so3(turn * half / max(sine, 1e-300)) @ R
        arm = np.append(points[present, :2].mean(axis=0), 0.0)
        starts.append(
            [
                geometry.make_pose(R, H[:, 2]),
                geometry.make_pose(R_other, H[:, 2] + R @ arm - R_other @ arm),
            ]
        )
    begin = np.array(starts).reshape(-1, 4, 4)
    twice = np.repeat(pixels, 2, axis=0)
    none = np.zeros(len(LENS), dtype=bool)
    ends, squares = _descend(points, twice, lens, none, begin, FEW_STEPS)[1:3]
    best = np.argmin(squares.reshape(-1, 2), axis=1)
    return ends.reshape(-1, 2, 4, 4)[np.arange(len(best)), best]


class CameraFit(NamedTuple):
    """A camera that pictures of a known board determine, each with a pose of its own."""

    lens: FloatArray  # (9,) the parameters `LENS`
    sd: FloatArray  # (9,) their standard deviations, with the sigma of the residuals; 0 if known
    poses: FloatArray  # (n, 4, 4) T_camera_board
    residuals: FloatArray  # (n, k, 2) [px] predicted - measured, NaN where absent
    sigma: float  # [px] standard deviation of a residual, by the degrees of freedom

    @property
    def rms(self) -> float:
        """Root mean square distance [px] of the points, as OpenCV states it."""
        return float(np.sqrt(np.nanmean((self.residuals**2).sum(axis=-1))))


def calibrate_camera(
    points: FloatArray, pixels: FloatArray, lens: FloatArray, free: BoolArray
) -> CameraFit:
    """Return the lens and the poses of a board that fit pictures best, in least squares.

    points : (k, 3) [m] of the board. pixels : (n, k, 2), NaN where absent.
    lens : (9,) start; a focal length that is NaN begins with Zhang's closed form. free : (9,).
    DataError : a picture shows too little, or the pictures do not determine the focal length.
    """
    few = np.flatnonzero(~shows_board(points, pixels))
    if len(few):
        raise DataError(
            f"picture {few[0] + 1} shows too little of the board. Use pictures with at least "
            f"{FEWEST} corners that are not on a line"
        )
    present = find_present(pixels)
    if np.isnan(lens[:2]).any():
        focal = solve_focal_lengths(points, pixels, lens[2:4])
        if focal is None:
            raise DataError(
                "the pictures do not determine the focal length. Tilt the board by 30 deg in some, "
                "or give the focal length"
            )
        lens = np.concatenate([focal, lens[2:]])
    poses = locate_boards(points, pixels, lens)
    lens, poses, _, factor, residuals = _descend(points, pixels, lens, free, poses)
    count = 2 * int(present.sum()) - 6 * len(pixels) - int(free.sum())
    sigma = float(np.sqrt(np.nansum(residuals**2) / max(count, 1)))
    sd, q = np.zeros(9), int(free.sum())
    if q:
        root = np.linalg.lstsq(factor[:q, :q], np.eye(q), rcond=1e-14)[0]
        sd[free] = sigma * np.linalg.norm(root, axis=1)
    return CameraFit(lens, sd, poses, residuals, sigma)


def _descend(
    points: FloatArray,
    pixels: FloatArray,
    lens: FloatArray,
    free: BoolArray,
    poses: FloatArray,
    steps: int = STEPS,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return lens, poses, sums of squares (n,), factor of the lens and residuals (n, k, 2) after
    Gauss-Newton with halved steps, poses eliminated; without a free lens, each picture by itself.
    """
    present, q = ~np.isnan(pixels), int(free.sum())
    factor = np.zeros((q + 1, q + 1))

    def evaluate(lens: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        arm = (poses[:, None, :3, :3] @ points[..., None])[..., 0]
        found, by_point, by_lens = project(arm + poses[:, None, :3, 3], lens)
        residual = np.where(present, found - np.nan_to_num(pixels), 0.0)
        by_turn = np.cross(arm[..., None, :], by_point)
        rows = np.concatenate([by_turn, by_point, by_lens[..., free], residual[..., None]], axis=-1)
        rows = np.where(present[..., None], rows, 0.0).reshape(len(pixels), -1, 7 + q)
        return residual, (residual**2).sum(axis=(1, 2)), rows

    residual, squares, rows = evaluate(lens, poses)
    for _ in range(steps):
        missing = max(7 + q - rows.shape[1], 0)
        padded = np.pad(rows, ((0, 0), (0, missing), (0, 0)))
        done = eliminate_columns(_factor(padded), 6)
        factor = _factor(done.rest.reshape(-1, q + 1))
        change = np.linalg.lstsq(factor[:, :q], -factor[:, q], rcond=1e-12)[0]
        twist = -(done.solution @ np.append(change, 1.0)[:, None])[..., 0]
        before, share = squares, np.ones(len(poses))
        first_lens, first_poses = lens, poses
        for k in range(HALVINGS + 1):
            lens = np.array(first_lens)
            lens[free] += share[0] * change
            poses = geometry.apply_twist(first_poses, share[:, None] * twist)
            residual, squares, rows = evaluate(lens, poses)
            most = (1.0 + ROUNDING) * before
            worse = ~(squares <= most)
            if q:  # all pictures move together
                worse = np.full_like(worse, not squares.sum() <= most.sum())
            if not worse.any():
                break
            share = np.where(worse, 0.5 * share if k < HALVINGS - 1 else 0.0, share)
        if not (before - squares > CHANGE * before).any():
            break
    return lens, poses, squares, factor, np.where(present, residual, np.nan)


def _factor(rows: FloatArray) -> FloatArray:
    """Return the triangular factors of rows (.., m, w)."""
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=float)
