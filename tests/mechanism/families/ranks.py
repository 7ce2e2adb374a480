# SPDX-License-Identifier: Apache-2.0
"""Scaled sensitivities, measured rows, unknown frames and ranks that the tests of families share.

Angles count as lengths at 200 mm per radian, in rows and columns. Ranks come from the singular
values of the stacked matrix, never from its normal equations. A rank without a gap below it fails.
"""

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.units import Dimension

Array = NDArray[np.float64]
METERS_PER_RADIAN = 0.2  # [m/rad]


def random_coordinates(robot: Mechanism, n: int, seed: int) -> Array:
    """Random controlled coordinates (n, c) in the workspace [m, rad]; those without a range stay
    zero.
    """
    ranges = robot.assembly.workspace
    rng = np.random.default_rng(seed)
    return np.stack(
        [rng.uniform(*ranges.get(name, (0.0, 0.0)), n) for name in robot.controlled], axis=1
    )


def scaled_sensitivity(robot: Mechanism, solution: Solution) -> Array:
    """Return platform twists per parameter (n, 6, p), all lengths [m / m]."""
    D = differentiate_pose(robot, robot.values[None], solution.q[None], solution.state)
    return scale_angles(robot, D.parameters[0])


def scale_angles(robot: Mechanism, D: Array) -> Array:
    """Return a sensitivity (.., 6, p) with angles as lengths."""
    return D * np.array([METERS_PER_RADIAN] * 3 + [1.0] * 3)[:, None] * scale_parameters(robot)


def scale_parameters(robot: Mechanism) -> Array:
    """Return (p,) 1 for lengths, and the radians per meter for angles."""
    is_length = [d is Dimension.LENGTH for d in robot.parameters.dimensions]
    return np.where(is_length, 1.0, 1 / METERS_PER_RADIAN)


def perturb(robot: Mechanism, size: float, seed: int) -> Mechanism:
    """Change parameters at random by `size` [m], angles by size / 200 mm [rad], so that no axes
    stay parallel.
    """
    errors = np.random.default_rng(seed).standard_normal(len(robot.values))
    return robot.with_values(robot.values + size * scale_parameters(robot) * errors)


def solve_random_poses(robot: Mechanism, n: int = 80, seed: int = 3) -> Solution:
    """Solve the inverse kinematics of random poses; all must converge."""
    solution = inverse(robot, random_coordinates(robot, n, seed))
    assert solution.converged.all()
    return solution


def select_measured_rows(D: Array, T: Array, what: str) -> Array:
    """Return rows of a measurement: full, positions, orientation, or 5-dof (no rotation about the
    platform's normal).
    """
    if what == "positions":
        return D[:, 3:]
    if what == "orientation":
        return D[:, :3]
    if what == "5-dof":
        turned = np.einsum("nij,njp->nip", geometry.hat(-T[:, :3, 2]), D[:, :3])
        return np.concatenate([turned, D[:, 3:]], axis=1)
    assert what == "full"
    return D


def frame_columns(T: Array, base: bool, tool: bool) -> Array:
    """Twists (n, 6, 0 | 6 | 12) that an unknown frame of the instrument, of the target, or both
    give, scaled as above.
    """
    n, result = len(T), []
    if base:
        block = np.zeros((n, 6, 6))
        block[:, :3, :3] = np.eye(3)
        block[:, 3:, :3] = -geometry.hat(T[:, :3, 3]) / METERS_PER_RADIAN
        block[:, 3:, 3:] = np.eye(3)
        result.append(block)
    if tool:
        block = np.zeros((n, 6, 6))
        block[:, :3, :3] = block[:, 3:, 3:] = T[:, :3, :3]
        result.append(block)
    return np.concatenate(result, axis=2) if result else np.zeros((n, 6, 0))


def rank(rows: Array, tolerance: float = 1e-12, gap: float = 1e3) -> int:
    """Rank of the stacked rows (n, m, p) at a relative tolerance; the first value cut must lie
    `gap` below the last kept.
    """
    s = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), compute_uv=False)
    kept = int((s > tolerance * s[0]).sum())
    if kept < len(s):
        assert s[kept - 1] > gap * s[kept], (
            f"no gap: {s[kept - 1] / s[0]:.1e} and {s[kept] / s[0]:.1e}"
        )
    return kept


def null_vector(rows: Array) -> Array:
    """Return the last right singular vector (p,)."""
    return np.linalg.svd(rows.reshape(-1, rows.shape[-1]))[2][-1]
