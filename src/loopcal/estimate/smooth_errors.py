# SPDX-License-Identifier: Apache-2.0
"""Errors of the platform that vary slowly with its pose: what no geometry explains.

The error of the tool at a pose T is the sum of a displacement and a rotation about base axes, each
component a Gaussian process of the pose with the covariance

    amplitude^2 exp(-|x - x'|^2 / 2)

x are the place of the tool and the rotation of the platform, or the place alone, relative to the
center of the range of some reference poses, each coordinate in units of a length that is a multiple
of half its range. With k of these poses as centers and the triangle L of
their correlations, L L' = K(centers, centers), the error is phi(T) c with phi = K(T, centers) L^-T,
independent c of variance 1, plus an independent rest that matters only far from all centers
(Nystroem approximation; exact for up to `CENTERS` reference poses). Source: Rasmussen and Williams,
Gaussian Processes for Machine Learning, 2006, sections 2.2 and 8.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal import geometry
from loopcal.numerics.statistics import compute_median
from loopcal.typing import FloatArray, IntArray

CENTERS = 40
"""Largest number of centers: more of them are closer to each other than the error varies."""

FINE_CENTERS = 150
"""The same where the length of the errors is chosen, or rows of all poses are compared."""

DENSE = np.sqrt(0.5)
"""Correlation of errors at neighboring centers from which these are dense."""

STILL = 0.01
"""Half the range of a coordinate, as a share of the largest one (rotations times the robot's size),
below which poses do not differ in it. Small differences, as of heights probed on a bed, are errors
of the machine and noise: as a coordinate, they would explain the residuals by themselves."""

ROUNDING = 1e-9
"""Share of the robot's size below which no difference is one."""

SAME = 1e-6
"""Distance in normalized coordinates below which poses are the same."""

JITTER = 1e-9
"""Added to the correlation of a center with itself, so that its triangle exists."""


@dataclass(frozen=True, eq=False)
class SmoothErrors:
    """Slow errors of the tool with the amplitudes of their components.

    tool : (3,) [m] tool point in the platform frame. rotation : (3, 3) to which rotations refer.
    origin, length : (6,) of rotation vectors [rad] and places [m]; an infinite length leaves a
        coordinate out.
    centers : (k, 6) normalized coordinates. whitening : (k, k) L^-T.
    amplitude : (6, d) rotation [rad] and displacement [m] of the tool by independent errors in d
        directions, those of rotation first.
    """

    tool: FloatArray
    rotation: FloatArray
    origin: FloatArray
    length: FloatArray
    centers: FloatArray
    whitening: FloatArray
    amplitude: FloatArray

    @property
    def count(self) -> int:
        """Number of coefficients, those of each direction in turn."""
        return self.amplitude.shape[1] * len(self.centers)

    @property
    def is_dense(self) -> bool:
        """Whether most centers share more than half of the variance of their errors with another
        one; otherwise errors of this length look like noise.
        """
        shared = correlate(self.centers, self.centers) - np.eye(len(self.centers))
        return compute_median(shared.max(axis=1)) > DENSE

    def group_regions(self, T: FloatArray, fewest: int = 1) -> IntArray:
        """Return the numbers (n,) of regions of poses T (n, 4, 4): each pose belongs to the nearest
        of some that are more than a length apart, over which errors are hardly correlated, or of
        the `fewest` that are farthest apart.
        """
        x = self.normalize(T)
        apart = _spread(x, len(x), 1.0)
        centers = x[apart if len(apart) >= fewest else _spread(x, fewest)]
        return np.argmin(((x[:, None] - centers) ** 2).sum(axis=2), axis=1)

    def recentered(self, T: FloatArray) -> SmoothErrors:
        """Return the errors with up to `FINE_CENTERS` of the poses T (n, 4, 4) as centers."""
        return self._centered(self.normalize(T), FINE_CENTERS)

    def _centered(self, x: FloatArray, most: int) -> SmoothErrors:
        """Return the errors with up to `most` of normalized coordinates (n, 6) as centers."""
        centers = x[_spread(x, most)]
        triangle = np.linalg.cholesky(correlate(centers, centers) + JITTER * np.eye(len(centers)))
        whitening = np.asarray(np.linalg.inv(triangle).T, dtype=np.float64)
        return replace(self, centers=centers, whitening=whitening)

    def scaled(self, amplitude: FloatArray) -> SmoothErrors:
        """Return the errors with other amplitudes (6, d)."""
        return replace(self, amplitude=amplitude)

    def twists(self, T: FloatArray) -> FloatArray:
        """Return twists (.., 6, d k) of the platform's origin at poses T (.., 4, 4)."""
        shares = self._correlate(T) @ self.whitening
        directions = self._at_origin(T) @ self.amplitude
        own = directions[..., None] * shares[..., None, None, :]
        return np.asarray(own.reshape(*T.shape[:-2], 6, self.count))

    def rest(self, T: FloatArray) -> FloatArray:
        """Return twists (.., 6, d) by the errors that have nothing to do with those at the centers,
        independent at every pose.
        """
        left = np.sqrt(1.0 - self.share(T))
        return self._at_origin(T) @ (left[..., None, None] * self.amplitude)

    def share(self, T: FloatArray) -> FloatArray:
        """Return the share (..,) of the variance at poses that follows from errors at centers."""
        return np.minimum(((self._correlate(T) @ self.whitening) ** 2).sum(axis=-1), 1.0)

    def _correlate(self, T: FloatArray) -> FloatArray:
        """Return the correlations (.., k) of errors at poses with those at the centers."""
        return correlate(self.normalize(T), self.centers)

    def normalize(self, T: FloatArray) -> FloatArray:
        """Return normalized coordinates (.., 6) of poses."""
        return (_coordinates(T, self.tool, self.rotation) - self.origin) / self.length

    def _at_origin(self, T: FloatArray) -> FloatArray:
        """Return (.., 6, 6) from twists of the tool point to those of the platform's origin."""
        arm = T[..., :3, :3] @ self.tool
        return geometry.transport_matrix(-arm.reshape(-1, 3)).reshape(*T.shape[:-2], 6, 6)


def correlate(x: FloatArray, centers: FloatArray) -> FloatArray:
    """Return the correlations (.., k) of errors at normalized coordinates (.., 6) and (k, 6)."""
    return np.asarray(np.exp(-0.5 * ((x[..., None, :] - centers) ** 2).sum(axis=-1)))


def describe_smooth_errors(
    T: FloatArray,
    tool: FloatArray,
    size: float,
    length: float = 1.0,
    most: int = CENTERS,
    *,
    by_rotation: bool = True,
) -> SmoothErrors:
    """Return errors of unit amplitude (1 rad, 1 m) about reference poses T (n, 4, 4), at a tool
    point (3,) [m] of a robot of this size [m].

    They vary over `length` halves of the range of each coordinate; a small one leaves errors that
    different poses do not share. There are at most `most` centers.
    """
    u, _, vt = np.linalg.svd(T[:, :3, :3].mean(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    x = _coordinates(T, tool, rotation)
    low, high = x.min(axis=0), x.max(axis=0)
    origin, half = 0.5 * (low + high), 0.5 * (high - low)
    lengths = half * np.r_[[size] * 3, [1.0] * 3]
    used = (lengths > max(STILL * lengths.max(), ROUNDING * size)) & (
        by_rotation | (np.arange(6) >= 3)
    )
    scale = np.where(used, length * np.where(used, half, 1.0), np.inf)
    nothing = np.zeros((0, 6))
    errors = SmoothErrors(tool, rotation, origin, scale, nothing, nothing, np.eye(6))
    return errors._centered((x - origin) / scale, most)


def _spread(x: FloatArray, most: int, apart: float = SAME) -> list[int]:
    """Return the outermost of coordinates (n, 6), then always the one farthest from all chosen
    ones, up to `most` that are this far apart.
    """
    chosen = [int(np.argmax((x**2).sum(axis=1)))]
    distance = ((x - x[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < most and distance.max() > apart**2:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((x - x[chosen[-1]]) ** 2).sum(axis=1))
    return chosen


def _coordinates(T: FloatArray, tool: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return rotation vectors relative to a rotation [rad] and places of the tool [m], (.., 6)."""
    R = T[..., :3, :3]
    return np.concatenate([geometry.log_so3(R @ rotation.T), T[..., :3, 3] + R @ tool], axis=-1)
