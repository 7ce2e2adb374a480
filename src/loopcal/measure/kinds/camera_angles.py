# SPDX-License-Identifier: Apache-2.0
"""Two angles of a vector about an optical axis z, as cameras and autocollimators measure them."""

import numpy as np

from loopcal.typing import FloatArray


def predict_camera_angles(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `atan2(x, z)` and `atan2(y, z)` (.., 2) of vectors (.., 3), and their derivatives
    (.., 2, 3).
    """
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    zero = np.zeros_like(a)
    across, up = a * a + c * c, b * b + c * c
    slopes = [
        np.stack([c / across, zero, -a / across], axis=-1),
        np.stack([zero, c / up, -b / up], axis=-1),
    ]
    return np.stack([np.arctan2(a, c), np.arctan2(b, c)], axis=-1), np.stack(slopes, axis=-2)


def convert_camera_angles(angles: FloatArray) -> FloatArray:
    """Return the unit vectors (.., 3) of angles (.., 2)."""
    first, second = angles[..., 0], angles[..., 1]
    ray = np.stack([np.tan(first), np.tan(second), np.ones_like(first)], axis=-1)
    # behind the camera the tangents belong to the opposite ray
    ray = np.where((np.cos(first) < 0.0)[..., None], -ray, ray)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)
