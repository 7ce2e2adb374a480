# SPDX-License-Identifier: Apache-2.0
"""Kind `image`: corners of a printed board in pictures; and a camera that is calibrated alone.

The pinhole camera with the distortion of Brown and Conrady, as in OpenCV. With a point (x, y, z) in
the frame of the camera, whose z axis is the line of sight, a = x / z, b = y / z, s = a^2 + b^2:

    g = 1 + k1 s + k2 s^2 + k3 s^3
    u = fx (a g + 2 p1 a b + p2 (s + 2 a^2)) + cx
    v = fx (1 + aspect) (b g + p1 (s + 2 b^2) + 2 p2 a b) + cy

Pixels of phones are square: aspect is 0 to `ASPECT_SD`. A board that never turns determines the
focal length by this alone.

Source: Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8) 855, 1971.
The closed form of the focal length is that of Zhang, IEEE Transactions on Pattern Analysis and
Machine Intelligence 22(11) 1330, 2000, doi 10.1109/34.888718, for a known center.
Arrays of pictures: n pictures of k points; a point that a picture lacks is NaN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar, NamedTuple, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.array_checks import check_pose, set_fields
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Column, Evaluation, InvalidRows, Kind, checked, list_rows
from loopcal.measure.nuisance import StatedValue
from loopcal.numerics.elimination import eliminate_columns
from loopcal.numerics.statistics import choose_evenly
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension, Length, Pixel, Ratio

LENS = ("fx", "aspect", "cx", "cy", "k1", "k2", "k3", "p1", "p2")  # the order of lens parameters
NEAREST = 1e-3
"""Share of the distance from the camera below which the depth of a point is not taken, so that a
point beside or behind the camera has a large, finite residual that leads back."""
FEWEST = 4  # points of a picture that determine the pose of a board
# Tilt of boards, as a share of squared slopes, and squared slope of the sight to a corner of the
# picture, below which they count as level.
LEVEL = 1e-5
STEPS, HALVINGS, CHANGE = 40, 6, 1e-8  # of the descent; a relative change that ends it
FEW_STEPS = 10  # of the descent to the pose of a board from a closed form
ROUNDING = 1e-12  # relative increase of a sum of squares that is none
LENS_ITEMS: Mapping[str, tuple[str, ...]] = {
    "focal": LENS[:2], "center": LENS[2:4], "radial": LENS[4:7], "tangential": LENS[7:],
}  # fmt: skip
PIXELS = ("fx", "cx", "cy")  # lens parameters in pixels; others are ratios
# What pictures of a board that never turns may leave anywhere.
VAGUE = ("aspect", *LENS_ITEMS["center"], *LENS_ITEMS["tangential"])
PRINT, BEND = ("scale_x", "scale_y"), ("bend_x", "bend_y", "bend_xy")
PICTURES = 40  # pictures, evenly chosen, of which start values are made
# Standard deviations of what nobody measured: a center as a share of the width, a scale of a print,
# and what a few pictures may not determine of the distortion, three times as large as in phones.
CENTER_SD, PRINT_SD = 0.02, 0.02
ASPECT_SD = 0.002  # of pixels that are as wide as high, by how they are resized and stabilized
LENS_SD = {"aspect": ASPECT_SD, "k3": 0.1, "p1": 0.003, "p2": 0.003}
# Sine of the angle between board and line of sight, and width of a square in a picture [px] where
# it looks narrowest, below which corners are left out. From there on rendered ones are found as
# exactly as others to a factor of 2; at 76 deg from the normal of 3, and below 15 px of 8.
GRAZING, NARROW = 0.4, 25.0


def project(
    x: FloatArray, lens: FloatArray, with_slopes: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels (.., 2) of points x (.., 3) [m] in the frame of the camera, and their
    derivatives (.., 2, 3) by the points and (.., 2, 9) by the lens (.., 9); without slopes, empty.
    """
    fx, aspect, cx, cy, k1, k2, k3, p1, p2 = (lens[..., i] for i in range(9))
    ratio = 1.0 + aspect
    fy = fx * ratio
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
    bent_u, bent_v = (fx * 2.0 * ab, fx * (s + 2.0 * aa)), (fy * (s + 2.0 * bb), fy * 2.0 * ab)
    of_u = (across, zero, one, zero, fa, fa * s, fa * s * s, *bent_u)
    of_v = (ratio * up, fx * up, zero, one, fb, fb * s, fb * s * s, *bent_v)
    by_lens = np.stack(
        [np.stack(np.broadcast_arrays(*row), axis=-1) for row in (of_u, of_v)], axis=-2
    )
    return pixels, by_point, by_lens


def list_focal_lengths(lens: FloatArray) -> FloatArray:
    """Return the focal lengths (.., 2) [px] across and up of a lens (.., 9)."""
    return np.stack([lens[..., 0], lens[..., 0] * (1.0 + lens[..., 1])], axis=-1)


def find_rays(pixels: FloatArray, lens: FloatArray) -> FloatArray:
    """Return (a, b, 1) (.., 3) of pixels (.., 2): the distortion removed by Newton's method."""
    ray = np.ones((*pixels.shape[:-1], 3))
    ray[..., :2] = plain = (pixels - lens[2:4]) / list_focal_lengths(lens)
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
    """Return which pictures (n, k, 2) show four of the points (k, 3) or more, not on a line."""
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


def solve_focal_length(
    points: FloatArray, pixels: FloatArray, center: FloatArray
) -> FloatArray | None:
    """Return fx and aspect (2,) from pictures (n, k, 2) of points (k, 3) and the center (2,); None
    where the pictures do not determine fx.

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
        if is_determined and (weights * (center @ center) > LEVEL).all():
            focal = 1.0 / np.sqrt(weights)
            return np.array([focal[0], focal[-1] / focal[0] - 1.0])
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
        focal = solve_focal_length(points, pixels, lens[2:4])
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


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Image(Kind):
    """Pixels u, v of the corners of a printed board. Residual: `predicted - measured`.

    A row is one corner of one picture. The corner i of a board with c columns is at column `i mod
    c` and row `i div c`. The corner (0, 0) is the origin of the board, x runs along its columns and
    y along its rows. A printer scales both axes, and paper bends: with column and row h, k from -1
    to 1, `p = (x (1 + scale_x), y (1 + scale_y), bend_x h^2 + bend_y k^2 + bend_xy h k)`. The
    camera's z axis is the line of sight, x is right and y down in the picture.

    Setup parameters: `camera.rx` to `camera.z`, `board.rx` to `board.z` [rad, m], `camera.fx`,
    `cx`, `cy` [px], `aspect`, `k1`, `k2`, `k3`, `p1`, `p2`, `board.scale_x`, `board.scale_y`, and
    `board.bend_x`, `bend_y`, `bend_xy` [m].

    mount : what the platform carries, the "board" or the "camera". The base carries the other one.
    T_camera, T_board : (4, 4), camera and board in the body that carries them (platform or base).
        If unknown, the nominal values.
    camera, board : their names. Kinds with equal names share the parameters.
    lens : name of the lens, by which several cameras share its parameters, such as one phone at
        two stations. Default: the name of the camera.
    size : width and height of a picture. focal : (fx, fy). Default: the width of the picture.
    center : (cx, cy). Default: the middle of the picture. distortion : (k1, k2, k3, p1, p2).
    corners : columns and rows of corners. square : distance of neighbors, as designed.
    unknown : which of "camera", "board", "focal" (fx, aspect), "center", "radial" (k1, k2, k3),
        "tangential" (p1, p2), "print" (the scales) and "bend" are unknown.

    DataError : another mount, a board with fewer than two corners a side, or a length not above 0.
    """

    unknown: tuple[str, ...] = ()
    mount: str = "board"
    T_camera: FloatArray = checked(check_pose, "T_camera", np.eye(4))
    T_board: FloatArray = checked(check_pose, "T_board", np.eye(4))
    camera: str = "camera"
    board: str = "board"
    lens: str = ""
    size: tuple[int, int] = (4000, 3000)
    focal: tuple[Pixel, Pixel] | None = None
    center: tuple[Pixel, Pixel] | None = None
    distortion: tuple[Ratio, Ratio, Ratio, Ratio, Ratio] = (0.0, 0.0, 0.0, 0.0, 0.0)
    corners: tuple[int, int] = (9, 6)
    square: Length = 0.02

    name: ClassVar[str] = "image"
    label_count: ClassVar[int] = 1
    description: ClassVar[str] = "pictures of a printed board by a camera"
    allowed_unknown: ClassVar[tuple[str, ...]] = ("camera", "board", *LENS_ITEMS, "print", "bend")
    common_items: ClassVar[tuple[str, ...]] = (*LENS_ITEMS, "print", "bend")
    row_settings: ClassVar[tuple[str, ...]] = ("camera", "board")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mount not in ("board", "camera"):
            raise DataError(
                f"the mount is {self.mount!r}. Write what the platform carries: board or camera"
            )
        for name in ("size", "corners", "distortion"):
            set_fields(self, **{name: tuple(getattr(self, name))})
        if min(self.corners) < 2 or not self.square > 0.0:
            raise DataError(
                f"a board of {self.corners[0]} x {self.corners[1]} corners at {self.square} m. "
                "Give at least 2 columns and rows of corners, at a distance above 0"
            )
        if min(self.size) < 1 or not all(f > 0.0 for f in self.focal or ()):
            raise DataError("the size of a picture and the focal length must be above 0")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a known camera, one of which all is unknown, and one on the platform."""
        twice = np.array([0.3, -0.2, 0.1])
        rotations = geometry.exp_so3(np.array([twice, [0.2, 0.3, -0.1], twice]))
        places = np.array([[0.3, 0.4, -1.1], [-0.05, 0.02, 0.1], [0.1, 0.1, 2.2]])
        ahead, board, wide = geometry.make_pose(rotations, places)
        focal = (1500.0, 1510.0)
        some = cls(unknown=cls.allowed_unknown, focal=focal, corners=(3, 2), square=0.1)
        return (
            cls(T_camera=ahead),
            replace(some, T_camera=ahead, T_board=board, lens="phone", camera="left"),
            replace(some, T_board=wide, mount="camera"),
        )

    @property
    def columns(self) -> tuple[Column, ...]:
        """The number of the corner, and its pixels."""
        return (Column("corner", Dimension.COUNT), *self.noise_columns)

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """The pixels."""
        return Column("u", Dimension.PIXEL), Column("v", Dimension.PIXEL)

    @property
    def target_columns(self) -> Mapping[str, tuple[int, ...]]:
        """The board, with the indices of its pixels."""
        return {self.board: (1, 2)}

    @property
    def rows_per_pose(self) -> int:
        """Number of corners."""
        return self.corners[0] * self.corners[1]

    @property
    def nominal_lens(self) -> FloatArray:
        """The stated lens (9,), in the order of `LENS`."""
        width, height = self.size
        focal = self.focal or (float(width), float(width))
        center = self.center or (0.5 * (width - 1), 0.5 * (height - 1))
        return np.array([focal[0], focal[1] / focal[0] - 1.0, *center, *self.distortion])

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """The poses of camera and board, the lens, and the print."""
        lens, ratio, flat = self.lens or self.camera, Dimension.RATIO, np.zeros(3)
        stated: Mapping[str, FloatArray] = dict(zip(LENS, self.nominal_lens[:, None], strict=True))
        numbers: dict[str, list[tuple[str, Sequence[str], Dimension, FloatArray]]] = {
            item: [(lens, [n], Dimension.PIXEL if n in PIXELS else ratio, stated[n]) for n in names]
            for item, names in LENS_ITEMS.items()
        }
        numbers["print"] = [(self.board, PRINT, ratio, flat[:2])]
        numbers["bend"] = [(self.board, BEND, Dimension.LENGTH, flat)]
        return {
            "camera": setup.make_frame_item(self.camera, self.T_camera),
            "board": setup.make_frame_item(self.board, self.T_board),
        } | {
            item: setup.SetupItem(tuple(p for of in parts for p in setup.make_parameters(*of)))
            for item, parts in numbers.items()
        }

    def list_labels(self, r: int) -> FloatArray:
        """Return the corners (r, 1): all of them, again and again."""
        return (np.arange(r) % self.rows_per_pose)[:, None].astype(float)

    def detect_present(self, measured: FloatArray) -> BoolArray:
        """Return which pixels exist."""
        return ~np.isnan(measured[..., 1:] + measured[..., :1])

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows of a corner that the board does not have."""
        corner, count = measured[:, 0], self.rows_per_pose
        is_one = (corner >= 0) & (corner < count) & (corner == np.round(corner))
        is_one |= np.isnan(measured[:, 1:]).all(axis=1) & np.isnan(corner)
        return list_rows(
            ~is_one,
            lambda i: (
                f"has the corner {corner[i]:g}, but the corners of the board are 0 to {count - 1}. "
                "Correct it, or the setting 'corners'"
            ),
        )

    def hide_unseen(self, T: FloatArray, columns: FloatArray, values: FloatArray) -> FloatArray:
        """Return columns (t, r, 3) without corners outside the picture, behind the camera, or on a
        board that is seen from behind or at a grazing angle.
        """
        camera_board = self._locate_board(T, self._unite(values))
        arm, normal = camera_board[..., :3, 3], camera_board[..., :3, 2]
        p = self._list_points(columns[..., 0].astype(np.intp), self._unite(values))[0]
        x = (camera_board[..., :3, :3] @ p[..., None])[..., 0] + arm
        facing = (normal * x).sum(axis=-1) > GRAZING * np.linalg.norm(x, axis=-1)
        # beyond the largest angle of a picture the polynomial of the distortion may come back
        reach = 1.5 * np.linalg.norm(self.size) / self.nominal_lens[0]
        ahead = np.linalg.norm(x[..., :2], axis=-1) < reach * x[..., 2]
        inside = ((columns[..., 1:] >= 0.0) & (columns[..., 1:] < self.size)).all(axis=-1)
        seen = np.concatenate(
            [np.ones_like(x[..., :1]), np.repeat((inside & facing & ahead)[..., None], 2, -1)], -1
        )
        return np.where(seen > 0.0, columns, np.nan)

    def _unite(self, values: FloatArray) -> FloatArray:
        """Return values (t, 1, u) where all rows have the same, as they mostly have."""
        is_one = values.shape[1] == 1 or (values == values[:, :1]).all()
        return values[:, :1] if is_one else values

    def _place(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return camera and board (.., 4, 4) in the bodies that carry them."""
        of_camera, of_board = (self.item_values(values, name) for name in ("camera", "board"))
        return setup.place_frame(self.T_camera, of_camera), setup.place_frame(
            self.T_board, of_board
        )

    def _locate_board(self, T: FloatArray, values: FloatArray) -> FloatArray:
        """Return T_camera_board (.., 4, 4)."""
        camera, board = self._place(values)
        moved = T if self.mount == "board" else geometry.invert_pose(T)
        return geometry.invert_pose(camera) @ (moved @ board)

    def _list_points(
        self, corner: IntArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points (.., 3) of corners on the board, x and y as designed (.., 2), and the
        shapes (.., 3) of the bends.
        """
        columns, rows = self.corners
        place = np.stack([corner % columns, corner // columns], axis=-1).astype(float)
        h, k = np.moveaxis(2.0 * place / np.array([columns - 1, rows - 1]) - 1.0, -1, 0)
        shapes, flat = np.stack([h * h, k * k, h * k], axis=-1), place * self.square
        scale, bend = (self.stated_or_unknown(values, name) for name in ("print", "bend"))
        height = (shapes * bend).sum(axis=-1, keepdims=True)
        scaled = flat * (1.0 + scale)
        lead = np.broadcast_shapes(scaled.shape[:-1], height.shape[:-1])
        parts = [np.broadcast_to(part, (*lead, part.shape[-1])) for part in (scaled, height)]
        return np.concatenate(parts, axis=-1), flat, shapes

    @cached_property
    def _stated_points(self) -> FloatArray:
        """The points (corners, 3) of the board as stated."""
        corner = np.arange(self.rows_per_pose)
        return self._list_points(corner, self.nominal_values[None, None])[0].reshape(-1, 3)

    def _find_lens(self, values: FloatArray) -> FloatArray:
        """Return the lens (.., 9)."""
        parts = [self.stated_or_unknown(values, name) for name in LENS_ITEMS]
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return np.concatenate([np.broadcast_to(p, (*shape, p.shape[-1])) for p in parts], axis=-1)

    def _measure(
        self, T: FloatArray, noise: FloatArray, values: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return corners and pixels (t, r, 3); the noise (t, r, 3) begins with the corners."""
        values, corner = self._unite(values), noise[..., 0].astype(np.intp)
        p, C = self._list_points(corner, values)[0], self._locate_board(T, values)
        x = (C[..., :3, :3] @ p[..., None])[..., 0] + C[..., :3, 3]
        pixels = project(x, self._find_lens(values), False)[0] + noise[..., 1:]
        label = np.broadcast_to(noise[..., :1], (*pixels.shape[:-1], 1))
        return np.concatenate([label, pixels], axis=-1)

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        """Return the residuals. With g the derivative of a pixel by a point of the carrier of the
        camera, a twist (w, v) of the board about an origin at a distance a changes the pixel by
        `w.(a x g) + v.g`, and one of the camera by the opposite.
        """
        values = self._unite(values)
        p, flat, shapes = self._list_points(measured[..., 0].astype(np.intp), values)
        camera, board = self._place(values)
        F, B, R = camera[..., :3, :3], board[..., :3, :3], T[..., :3, :3]
        arm = (B @ p[..., None])[..., 0]  # of the board, in axes of the body that carries it
        q = arm + board[..., :3, 3]
        if self.mount == "board":
            lever = (R @ q[..., None])[..., 0]
            y = lever + T[..., :3, 3]
        else:
            lever = q - T[..., :3, 3]
            y = (np.swapaxes(R, -1, -2) @ lever[..., None])[..., 0]
        z = y - camera[..., :3, 3]
        x = (np.swapaxes(F, -1, -2) @ z[..., None])[..., 0]
        pixels, by_point, by_lens = project(x, self._find_lens(values))
        by_y = by_point @ np.swapaxes(F, -1, -2)
        on_board = by_y @ (R if self.mount == "board" else np.swapaxes(R, -1, -2))
        by_twist = _turn(lever, by_y) if self.mount == "board" else -_turn(lever, on_board)
        blocks = {"twist": by_twist}
        if (of_camera := self.item_values(values, "camera")) is not None:
            blocks["camera"] = -_turn(z, by_y) @ setup.linearize_frame(of_camera)
        if (of_board := self.item_values(values, "board")) is not None:
            blocks["board"] = _turn(arm, on_board) @ setup.linearize_frame(of_board)
        by_p = on_board @ B
        blocks["print"] = by_p[..., :2] * flat[..., None, :]
        blocks["bend"] = by_p[..., 2:] * shapes[..., None, :]
        for item, names in LENS_ITEMS.items():
            first = LENS.index(names[0])
            blocks[item] = by_lens[..., first : first + len(names)]
        blocks = {k: b for k, b in blocks.items() if k == "twist" or k in self.own_items}
        residual = pixels - measured[..., 1:]
        return self.split_columns(residual, self.join_columns(blocks, residual.shape))

    # Start values.

    def list_pictures(self, T: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the poses (n, 4, 4) and pixels (n, corners, 2) of pictures, NaN where absent, in
        the order of their first rows: rows of one pose, and of two pictures where a corner occurs
        twice.
        """
        _, of_pose = np.unique(T.reshape(len(T), -1), axis=0, return_inverse=True)
        corner = measured[:, 0].astype(np.intp)
        key = of_pose.ravel() * self.rows_per_pose + corner
        order = np.argsort(key, kind="stable")
        again = np.zeros(len(key), dtype=np.intp)
        again[order] = np.arange(len(key)) - np.searchsorted(key[order], key[order])
        shown = np.column_stack([of_pose.ravel(), again])
        _, first, picture = np.unique(shown, axis=0, return_index=True, return_inverse=True)
        pixels = np.full((len(first), self.rows_per_pose, 2), np.nan)
        pixels[picture.ravel(), corner] = measured[:, 1:]
        order = np.argsort(first)
        return T[first[order]], pixels[order]

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the lens by Zhang's closed form and all pictures, the board in each picture, and
        from these camera and board on their bodies.
        """
        T, pixels = self.list_pictures(T, measured)
        chosen = np.flatnonzero(shows_board(self._stated_points, pixels))
        if not self.own_items or len(chosen) < 2:
            return self.nominal_values[None]
        chosen = chosen[choose_evenly(len(chosen), PICTURES)]
        T, pixels = T[chosen], pixels[chosen]
        candidates = [
            self.assemble_values(of_lens | of_frames)
            for of_lens, poses in _guess_lenses(self, pixels.tobytes())
            for of_frames in self._guess_frames(T, poses)
        ]
        return np.concatenate(candidates)

    def _guess_frames(self, T: FloatArray, poses: FloatArray) -> list[dict[str, FloatArray]]:
        """Return values of camera and board, from T_base_platform and T_camera_board (n, 4, 4)."""
        # on the fixed body a frame, on the platform a tool: frame measured = T tool
        fixed, carried = ("camera", "board") if self.mount == "board" else ("board", "camera")
        measured = poses if self.mount == "board" else geometry.invert_pose(poses)
        stated = {"camera": self.T_camera, "board": self.T_board}
        known = [name not in self.unknown for name in (fixed, carried)]
        if all(known):
            return [{}]
        pairs = []
        if not any(known):
            # four points about the tool, as far apart as the camera is away
            size = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))
            q = size * np.concatenate([np.zeros((1, 3)), np.eye(3)])
            seen = (measured[:, None, :3, :3] @ q[..., None])[..., 0] + measured[:, None, :3, 3]
            moving = (T[:, None, :3, None, :3] * np.eye(4)[:, None, :, None]).reshape(-1, 3, 12)
            origin = np.repeat(T[:, :3, 3], 4, axis=0)
            sets = (seen.reshape(-1, 3)[None], moving[None], origin[None])
            frames, places, _ = geometry.solve_frame_and_points(*sets)
            tools = [geometry.align_point_sets(q, of.reshape(4, 3)) for of in places]
            pairs += list(zip(frames, tools, strict=True))
        for frame, tool in ((None, stated[carried]), (stated[fixed], None)):
            if (frame is None and not known[0]) or (tool is None and not known[1]):
                pairs.append(geometry.solve_hand_eye(T, measured, frame, tool))
        return [
            {
                name: setup.encode_frame(stated[name], of)
                for name, of in ((fixed, frame), (carried, tool))
            }
            for frame, tool in pairs
        ]


# A search for conventions guesses the lens of the same pictures with many sets of readings.
@lru_cache(maxsize=8)
def _guess_lenses(camera: Image, seen: bytes) -> list[tuple[dict[str, FloatArray], FloatArray]]:
    """Return values of the items of the lens, and T_camera_board (n, 4, 4) with each, of pictures:
    `seen` has the doubles of their pixels (n, corners, 2).
    """
    points, pixels = camera._stated_points, np.frombuffer(seen).reshape(-1, camera.rows_per_pose, 2)
    lens, free = camera.nominal_lens, np.zeros(len(LENS), dtype=bool)
    found = [(lens, locate_boards(points, pixels, lens))]
    for item in (item for item in LENS_ITEMS if item in camera.unknown):
        free |= np.isin(LENS, LENS_ITEMS[item])
    starts = [lens] if free.any() else []
    focal = solve_focal_length(points, pixels, lens[2:4]) if "focal" in camera.unknown else None
    if focal is not None:
        closed = np.concatenate([focal, lens[2:]])
        starts.append(closed)
        found.append((closed, locate_boards(points, pixels, closed)))
    for start in starts:
        fit = calibrate_camera(points, pixels, start, free)
        if not (fit.sd[2:4] < CENTER_SD * max(camera.size)).all():  # as if a board never turns
            fit = calibrate_camera(points, pixels, start, free & ~np.isin(LENS, VAGUE))
        # pictures that do not determine a lens leave it anywhere
        if np.isfinite(fit.lens).all() and list_focal_lengths(fit.lens).min() > 0.0:
            found.append((fit.lens, fit.poses))
    items = {name: [LENS.index(n) for n in names] for name, names in LENS_ITEMS.items()}
    return [({name: of[i] for name, i in items.items()}, poses) for of, poses in found]


def state_camera(
    camera: Image, scales: Sequence[tuple[float, float]] = ((0.0, PRINT_SD),) * 2
) -> tuple[Image, tuple[StatedValue, ...]]:
    """Return a camera of which all but bends is unknown, and what is known before.

    scales : those of the print along x and y, with their standard deviations. All sessions share
    them. They give the machine its size, which pictures do not determine.
    """
    unknown = ("camera", "board", *LENS_ITEMS, "print")
    lens, center = camera.lens or camera.camera, CENTER_SD * max(camera.size)
    stated = [StatedValue(f"{lens}.{name}", center) for name in LENS_ITEMS["center"]]
    stated += [StatedValue(f"{lens}.{name}", sd) for name, sd in LENS_SD.items()]
    stated += [StatedValue(f"{camera.board}.{name}", sd, scale, scope="all")
               for name, (scale, sd) in zip(PRINT, scales, strict=True)]  # fmt: skip
    return replace(camera, unknown=unknown), tuple(stated)


def _turn(arm: FloatArray, slope: FloatArray) -> FloatArray:
    """Return derivatives (.., 2, 6) by a twist about an origin from which the point is at `arm`
    (.., 3), from those by the point (.., 2, 3): `[a x g, g]`.
    """
    by_turn = np.cross(arm[..., None, :], slope)
    return np.concatenate([by_turn, np.broadcast_to(slope, by_turn.shape)], axis=-1)
