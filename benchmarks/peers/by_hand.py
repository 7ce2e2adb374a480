# SPDX-License-Identifier: Apache-2.0
"""Fits as a user writes them for one robot, with scipy and with jax: estimate and covariance.

A hexapod has base point, platform point and length of each leg, (6, 7). The leg lengths of measured
poses are compared with the readings, each pose whitened by what its noise does to them: the same
estimate as that of the measured poses themselves to first order of the noise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Answer = tuple[np.ndarray, np.ndarray]
"""Estimate (p,) and covariance (p, p) [SI]."""


def fit_leg_lengths(start: np.ndarray, unit: np.ndarray, rows: np.ndarray) -> Answer:
    """Fit a hexapod; `rows` (n, 18) are readings, rotation vectors, positions and their sigmas."""
    n, k = len(rows), np.arange(6)
    q, R, t = rows[:, :6], Rotation.from_rotvec(rows[:, 6:9]).as_matrix(), rows[:, None, 9:12]

    def legs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        arms = np.einsum("nij,kj->nki", R, x[:, 3:6])
        vectors = t + arms - x[:, :3]
        return arms, vectors, np.linalg.norm(vectors, axis=2)

    arms, vectors, lengths = legs(start.reshape(6, 7))
    by_twist = np.concatenate([np.cross(arms, vectors), vectors], axis=2) / lengths[..., None]
    white = np.linalg.inv(by_twist * rows[:, None, 12:])

    def residual(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(6, 7)
        return np.einsum("nij,nj->ni", white, legs(x)[2] - x[:, 6] - q).ravel()

    def jacobian(flat: np.ndarray) -> np.ndarray:
        _, vectors, lengths = legs(flat.reshape(6, 7))
        along = vectors / lengths[..., None]
        J = np.zeros((n, 6, 6, 7))
        J[:, k, k, :3], J[:, k, k, 6] = -along, -1.0
        J[:, k, k, 3:6] = np.einsum("nji,nkj->nki", R, along)
        return (white @ J.reshape(n, 6, 42)).reshape(6 * n, 42)

    return _solve(residual, jacobian, start, unit)


def fit_poses(start: np.ndarray, unit: np.ndarray, rows: np.ndarray) -> Answer:
    """Fit a hexapod to the same cost as loopcal: predicted minus measured poses, solved from the
    readings by Newton's method.
    """
    n, k = len(rows), np.arange(6)
    q, sigma, place = rows[:, :6], rows[:, 12:], rows[:, 9:12]
    measured = Rotation.from_rotvec(rows[:, 6:9])
    state = [measured.as_matrix(), place.copy()]

    def close(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R, t = state
        while True:
            arms = np.einsum("nij,kj->nki", R, x[:, 3:6])
            vectors = t[:, None] + arms - x[:, :3]
            lengths = np.linalg.norm(vectors, axis=2)
            along = vectors / lengths[..., None]
            A = np.concatenate([np.cross(arms, along), along], axis=2)
            gap = lengths - x[:, 6] - q
            if np.abs(gap).max() < 1e-14:
                state[:] = R, t
                return A, along
            step = -np.linalg.solve(A, gap[..., None])[..., 0]
            R, t = Rotation.from_rotvec(step[:, :3]).as_matrix() @ R, t + step[:, 3:]

    def residual(flat: np.ndarray) -> np.ndarray:
        close(flat.reshape(6, 7))
        turn = (Rotation.from_matrix(state[0]) * measured.inv()).as_rotvec()
        return (np.concatenate([turn, state[1] - place], axis=1) / sigma).ravel()

    def jacobian(flat: np.ndarray) -> np.ndarray:
        A, along = close(flat.reshape(6, 7))
        E = np.zeros((n, 6, 6, 7))
        E[:, k, k, :3], E[:, k, k, 6] = -along, -1.0
        E[:, k, k, 3:6] = np.einsum("nji,nkj->nki", state[0], along)
        turn = (Rotation.from_matrix(state[0]) * measured.inv()).as_rotvec()
        by_twist = np.tile(np.eye(6), (n, 1, 1))
        by_twist[:, :3, :3] = _invert_left_jacobian(turn)
        J = -(by_twist / sigma[..., None]) @ np.linalg.solve(A, E.reshape(n, 6, 42))
        return J.reshape(6 * n, 42)

    return _solve(residual, jacobian, start, unit)


def _invert_left_jacobian(turn: np.ndarray) -> np.ndarray:
    """Return the inverse of the left Jacobian of SO(3) of small rotations (n, 3), to order 5."""
    x, y, z = turn.T
    K = np.moveaxis(np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]]), 2, 0)
    return np.eye(3) - 0.5 * K + K @ K / 12.0 * (1.0 + (turn**2).sum(1)[:, None, None] / 60.0)


def fit_delta(start: np.ndarray, unit: np.ndarray, rows: np.ndarray) -> Answer:
    """Fit radius, two angles, arms and stops of a linear delta; `rows` (n, 9) are readings,
    positions and their sigmas. Arm lengths at measured positions are compared, each whitened by
    what the noise of the position does to them.
    """
    q, place, sigma = rows[:, :3], rows[:, None, 3:6], rows[:, None, 6:]

    def carriages(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        angle, arm = np.array([x[1], x[4], 0.5 * np.pi]), x[[2, 5, 7]]
        rise = np.sqrt(arm**2 - x[0] ** 2)
        foot = np.stack([x[0] * np.cos(angle), x[0] * np.sin(angle), x[[3, 6, 8]] + rise], axis=1)
        vectors = place - foot + q[:, :, None] * np.array([0.0, 0.0, 1.0])
        return angle, arm, rise, vectors

    _, _, _, vectors = carriages(start)
    lengths = np.linalg.norm(vectors, axis=2)
    white = np.linalg.inv(vectors / lengths[..., None] * sigma)

    def residual(x: np.ndarray) -> np.ndarray:
        _, arm, _, vectors = carriages(x)
        return np.einsum("nij,nj->ni", white, np.linalg.norm(vectors, axis=2) - arm).ravel()

    def jacobian(x: np.ndarray) -> np.ndarray:
        angle, arm, rise, vectors = carriages(x)
        along = vectors / np.linalg.norm(vectors, axis=2)[..., None]
        c, s = np.cos(angle), np.sin(angle)
        J = np.zeros((len(rows), 3, 9))
        J[:, :, 0] = -(along[..., 0] * c + along[..., 1] * s - along[..., 2] * x[0] / rise)
        J[:, [0, 1], [1, 4]] = (x[0] * (along[..., 0] * s - along[..., 1] * c))[:, :2]
        J[:, [0, 1, 2], [2, 5, 7]] = -along[..., 2] * arm / rise - 1.0
        J[:, [0, 1, 2], [3, 6, 8]] = -along[..., 2]
        return (white @ J).reshape(-1, 9)

    return _solve(residual, jacobian, start, unit)


def _solve(
    residual: Callable[[np.ndarray], np.ndarray],
    jacobian: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    unit: np.ndarray,
) -> Answer:
    """Return estimate and covariance by Levenberg-Marquardt of MINPACK; `unit` (p,) scales."""
    solve: Any = least_squares  # the stubs know no function as a Jacobian
    fit = solve(residual, start, jacobian, method="lm", x_scale=unit, xtol=1e-12, ftol=1e-15)
    R = np.linalg.qr(fit.jac * unit, mode="r")
    root = unit[:, None] * np.linalg.inv(R)
    # one more step, which MINPACK refuses where rounding of the sum of squares hides its gain
    return fit.x - root @ (root.T @ fit.grad), root @ root.T


def make_jax_fit(start: np.ndarray, unit: np.ndarray, rows: np.ndarray) -> Callable[[], Answer]:
    """Return a compiled fit of a hexapod by jax: the same leg lengths, four Gauss-Newton steps with
    derivatives by automatic differentiation, and the covariance.
    """
    import jax
    from jax import numpy as jnp

    jax.config.update("jax_enable_x64", True)
    rotations = Rotation.from_rotvec(rows[:, 6:9]).as_matrix()

    @jax.jit
    def fit(start: Any, R: Any, t: Any, q: Any, sigma: Any) -> Any:
        def legs(flat: Any) -> tuple[Any, Any]:
            x = flat.reshape(6, 7)
            arms = jnp.einsum("nij,kj->nki", R, x[:, 3:6])
            return arms, t[:, None] + arms - x[:, :3]

        arms, vectors = legs(start)
        along = vectors / jnp.linalg.norm(vectors, axis=2)[..., None]
        by_twist = jnp.concatenate([jnp.cross(arms, along), along], axis=2)
        white = jnp.linalg.inv(by_twist * sigma[:, None])

        def residual(z: Any) -> Any:
            flat = start + unit * z
            length = jnp.linalg.norm(legs(flat)[1], axis=2)
            return jnp.einsum("nij,nj->ni", white, length - flat.reshape(6, 7)[:, 6] - q).ravel()

        z, triangle = jnp.zeros(len(start)), unit[:0]
        for _ in range(4):
            Q, triangle = jnp.linalg.qr(jax.jacfwd(residual)(z))
            z = z - jax.scipy.linalg.solve_triangular(triangle, Q.T @ residual(z))
        root = unit[:, None] * jax.scipy.linalg.solve_triangular(triangle, jnp.eye(len(start)))
        return start + unit * z, root @ root.T

    def run() -> Answer:
        found = fit(start, rotations, rows[:, 9:12], rows[:, :6], rows[:, 12:])
        return np.asarray(found[0]), np.asarray(found[1])

    return run
