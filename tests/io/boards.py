# SPDX-License-Identifier: Apache-2.0
"""OpenCV's own boards, and pictures of them by a camera of our own."""

import cv2
import numpy as np

from loopcal.io.pictures import Board


def make_charuco(board: Board) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's board [m]."""
    number = getattr(cv2.aruco, f"DICT_{board.dictionary}")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    return cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, dictionary)


def render(
    board: Board,
    T_camera_board: np.ndarray,
    lens: np.ndarray,
    size: tuple[int, int],
    blur: float = 0.7,
    noise: float = 2.0,
    seed: int = 1,
    scale: tuple[float, float] = (1.0, 1.0),
    fine: int = 3,
) -> np.ndarray:
    """Return a picture (height, width) of a board in front of a gray wall, by rays of our own.

    lens : fx, fy, cx, cy, k1, k2, k3, p1, p2. blur : of a Gaussian [px]. noise : of gray values.
    scale : of the print along x and y. A pixel is the mean of `fine` x `fine` rays, computed where
    the board may be. The edges of the picture are darker (vignetting).
    """
    # pixels from ray to ray whose place is computed (linear between them, to a thousandth of a
    # pixel), texture pixels per meter
    step, dense = 4, 8000.0
    width, height = (round(n * board.square * dense) for n in board.squares)
    texture = 30.0 + 0.75 * make_charuco(board).generateImage((width, height)).astype(np.float32)
    margin = round(board.square * dense)  # white paper around the squares
    texture = np.pad(texture, margin, constant_values=texture.max())
    if fine == 1:  # rays are as far apart as pixels: no details are finer
        pixel = dense * T_camera_board[2, 3] / lens[0]
        texture = cv2.GaussianBlur(texture, (0, 0), 0.5 * pixel)
    fx, fy, cx, cy, k1, k2, k3, p1, p2 = lens
    # where a circle about the paper is, in whole steps
    middle = 0.5 * board.square * np.array([*(n - 2 for n in board.squares), 0.0])
    center = T_camera_board[:3, :3] @ middle + T_camera_board[:3, 3]
    slope, reach = center[:2] / center[2], 0.7 * board.square * np.hypot(*board.squares)
    reach = (1.0 + np.hypot(*slope)) * reach / (center[2] - reach) if center[2] > reach else np.inf
    reach = 1.2 * reach + 10.0 / fx
    low, high = (
        np.clip(lens[:2] * (slope + side) + lens[2:4], 0, size) for side in (-reach, reach)
    )
    first = step * np.floor(low / step).astype(int)
    part = np.minimum(step * np.ceil(high / step).astype(int), size) - first
    u, v = (
        np.arange(b - 0.5 * step - 0.5, b + n + 1.5 * step, step)
        for b, n in zip(first, part, strict=True)
    )
    x, y = np.meshgrid((u - cx) / fx, (v - cy) / fy)
    seen_x, seen_y = x, y
    for _ in range(6):  # the distortion is inverted by a fixed-point iteration
        r = x * x + y * y
        radial = 1.0 + r * (k1 + r * (k2 + r * k3))
        dx = 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x)
        dy = p1 * (r + 2.0 * y * y) + 2.0 * p2 * x * y
        x, y = (seen_x - dx) / radial, (seen_y - dy) / radial
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    depth = (R[:, 2] @ t) / (rays @ R[:, 2])
    p = (rays * depth[..., None] - t) @ R  # on the board, from corner 0
    # linear between the middles of texels, or edges along rows of rays jump by a ray
    place = (p[..., :2] / scale + board.square) * dense + margin - 0.5
    times = step * fine
    every = cv2.resize(place.astype(np.float32), None, fx=times, fy=times)
    every = every[times:, times:][: fine * part[1], : fine * part[0]]
    across, down = cv2.split(every)
    values = cv2.remap(
        texture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110
    )
    if blur > 0.0:
        values = cv2.GaussianBlur(values, (0, 0), blur * fine)
    picture = np.full(size[::-1], 110.0, np.float32)
    picture[first[1] :, first[0] :][: part[1], : part[0]] = cv2.resize(
        values, part.tolist(), interpolation=cv2.INTER_AREA
    )
    across, down = (np.linspace(-1, 1, n, dtype=np.float32) for n in size)
    picture *= 1.0 - 0.15 * (across**2 + down[:, None] ** 2)
    random = np.random.default_rng(seed).standard_normal(picture.shape, np.float32)
    return np.clip(np.round(picture + noise * random), 0, 255).astype(np.uint8)


def project_corners(
    board: Board,
    T_camera_board: np.ndarray,
    lens: np.ndarray,
    scale: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Return the true pixels (corners, 2), by the formulas of OpenCV's documentation."""
    fx, fy, cx, cy, k1, k2, k3, p1, p2 = lens
    columns, rows = board.corners
    number = np.arange(columns * rows)
    place = np.stack([number % columns, number // columns, 0 * number], axis=1) * board.square
    place = place * [*scale, 0.0]
    c = place @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    x, y = c[:, 0] / c[:, 2], c[:, 1] / c[:, 2]
    r = x * x + y * y
    radial = 1.0 + r * (k1 + r * (k2 + r * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x)
    v = y * radial + p1 * (r + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], axis=1)
