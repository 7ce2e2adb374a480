# SPDX-License-Identifier: Apache-2.0
"""Cable robots with unmeasured poses: the samples of the shipped example, and an independent
estimator.

The reference has every pose as three explicit unknowns and is solved densely by scipy. With anchors
a_k, lengths at zero c_k, spool radius r, gear g, line moved for line unwound s_k and build-up b_k,
and positions x_i,

    |x_i - a_k| = c_k + s_k (r g q_ik - b_k (g q_ik)^2 / 4),

whose residuals are motor angles q (over their sigma) and known positions x (over theirs).

Lengths in mm, angles in degrees as in the files of samples.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
NAMES = (
    *(
        f"{line}.{what}"
        for line in "ABCD"
        for what in ("anchor.x", "anchor.y", "anchor.z", "length")
    ),
    "spool.radius",
    *(f"{line}.buildup" for line in "ABCD"),
)
"""Parameters in the order of the robot file that the import writes."""

TRUTH = np.array(
    [
        *(12.0, -1480.0, -95.0, 1484.5),
        *(1250.0, 690.0, -130.0, 1433.5),
        *(-1310.0, 720.0, -110.0, 1498.0),
        *(15.0, -20.0, 2150.0, 2150.6),
        60.8,
        *(0.07, 0.05, 0.06, 0.055),
    ]
)
"""The example's machine in that order [mm]."""

LINE, POSITION = 0.5, 0.5
"""Noise of the example [mm]."""


@dataclass(frozen=True, eq=False)
class ReferenceSolution:
    """Result of the reference estimator. values, sd : (21,) in the order of `NAMES` [mm] (22 with a
    stretch). poses : (N, 3).

    lines : (N, 4) residuals of the lines [mm]. positions : (K, 3). chi_square, dof, covariance : of
        the fit.
    """

    values: Array
    covariance: Array
    poses: Array
    lines: Array
    positions: Array
    chi_square: float
    dof: int

    @property
    def sd(self) -> Array:
        """Standard deviations by the stated sigmas (21,) [mm]."""
        return np.sqrt(np.diag(self.covariance))


def load_real_samples(data_folder: Path) -> dict[str, Any]:
    """Load the samples of a real machine."""
    return json.loads((data_folder / "cable_robot" / "hp_mark_adjusted.json").read_text("utf-8"))


def gear_and_line_ratios(samples: dict[str, Any]) -> tuple[float, Array]:
    """Return the gear ratio g, and line moved over line unwound (4,)."""
    gear = samples["motor_gear_teeth"] / samples["spool_gear_teeth"]
    return gear, np.array(samples["lines_per_spool"]) / np.array(samples["mechanical_advantage"])


def compute_paid_out(samples: dict[str, Any], radius: float, buildup: Array) -> Array:
    """Return the line paid out at the motor angles (N, 4) [mm]."""
    gear, s = gear_and_line_ratios(samples)
    turn = gear * np.radians(samples["motor_pos_samp"])
    return s * (radius * turn - buildup * turn**2 / 4)


def compute_motor_angles(
    samples: dict[str, Any], radius: float, buildup: Array, paid: Array
) -> tuple[Array, Array]:
    """Return motor angles (N, 4) [rad] for the line paid out, and the derivative of the line."""
    gear, s = gear_and_line_ratios(samples)
    # r t - b t^2 / 4 = u has the root t = 2 u / (r + sqrt(r^2 - b u)), and dt/du = 1 / sqrt(r^2 - b
    # u)
    root = np.sqrt(radius**2 - buildup * paid / s)
    return 2 * (paid / s) / (radius + root) / gear, root * gear * s


def solve_reference(
    samples: dict[str, Any],
    line: float,
    position: float,
    start: Array,
    stretch: Array | None = None,
) -> ReferenceSolution:
    """Solve densely for 21 parameters and all poses.

    Parameters
    ----------
    samples : of the cable robot. line : sigma of motor angles as line on the guessed spools,
        position : sigma [mm].
    start : (21,) parameters to begin with [mm]. stretch : (N, 4) that lengthens the lines by an
        unknown factor, the last parameter; none by default.
    """
    known, measured = np.array(samples["xyz_of_samp"]), np.radians(samples["motor_pos_samp"])
    n, k, p21 = len(measured), len(known), 21 + (stretch is not None)
    gear, s = gear_and_line_ratios(samples)
    sigma = line / (np.array(samples["spool_r_in_origin_first_guess"]) * gear * s)  # [rad]
    first = np.concatenate([start, np.zeros(p21 - 21), _first_poses(samples, start).ravel()])
    more = np.zeros((n, 4)) if stretch is None else stretch

    def modelled(p: Array) -> tuple[Array, Array, Array]:
        a, c, r, b = _split(p)
        apart = p[p21:].reshape(-1, 1, 3) - a
        length = np.linalg.norm(apart, axis=2)
        factor = p[21] if stretch is not None else 0.0
        angles, slope = compute_motor_angles(samples, r, b, length - c - factor * more)
        return angles, slope, apart / length[..., None]

    def residual(p: Array) -> Array:
        seen = (p[p21 : p21 + 3 * k] - known.ravel()) / position
        return np.concatenate([((modelled(p)[0] - measured) / sigma).ravel(), seen])

    def jacobian(p: Array) -> Array:
        angles, slope, u = modelled(p)
        turn = gear * angles
        J = np.zeros((n, 4, len(p)))
        for j in range(4):
            J[:, j, 4 * j : 4 * j + 3], J[:, j, 4 * j + 3] = -u[:, j], -1.0
            J[:, j, 16], J[:, j, 17 + j] = -s[j] * turn[:, j], s[j] * turn[:, j] ** 2 / 4
        J[..., 21:p21] = -more[..., None]
        for i in range(n):
            J[i, :, p21 + 3 * i : p21 + 3 * i + 3] = u[i]
        J /= (sigma * slope)[..., None]
        seen = np.zeros((3 * k, len(p)))
        seen[:, p21 : p21 + 3 * k] = np.eye(3 * k) / position
        return np.concatenate([J.reshape(4 * n, -1), seen])

    options: Any = {"method": "lm", "x_scale": "jac", "xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    done = least_squares(residual, first, jac=cast(Any, jacobian), **options)
    inverse = np.linalg.inv(np.linalg.qr(done.jac, mode="r"))
    angles, positions = np.split(done.fun, [4 * n])
    return ReferenceSolution(
        done.x[:p21],
        (inverse @ inverse.T)[:p21, :p21],
        done.x[p21:].reshape(-1, 3),
        angles.reshape(n, 4) * sigma * modelled(done.x)[1],
        positions.reshape(k, 3) * position,
        float(done.fun @ done.fun),
        len(done.fun) - len(done.x),
    )


def _split(p: Array) -> tuple[Array, Array, float, Array]:
    """Return anchors (4, 3), lengths (4,), radius and build-ups (4,)."""
    limbs = p[:16].reshape(4, 4)
    return limbs[:, :3], limbs[:, 3], float(p[16]), p[17:21]


def _first_poses(samples: dict[str, Any], start: Array) -> Array:
    """Estimate poses by least squares on their lines, from the known position or from above the
    origin.
    """
    known = np.array(samples["xyz_of_samp"])
    a, c, r, b = _split(start)
    lengths = c + compute_paid_out(samples, r, b)
    free = [
        least_squares(
            lambda x, want=want: np.linalg.norm(x - a, axis=1) - want, [0.0, 0.0, 400.0]
        ).x
        for want in lengths[len(known) :]
    ]
    return np.concatenate([known, free])


def simulate_example(seed: int = 11) -> dict[str, Any]:
    """Simulate noisy samples of the example: 9 known poses (8 on the bed) and 36 unknown ones."""
    rng = np.random.default_rng(seed)
    ring = 0.25 * np.pi * np.arange(8)
    bed = np.column_stack([320 * np.cos(ring), 320 * np.sin(ring), np.zeros(8)])
    unknown = np.column_stack(
        [rng.uniform(-450, 450, 36), rng.uniform(-450, 450, 36), rng.uniform(50, 1300, 36)]
    )
    poses = np.concatenate([bed, [[40.0, -30.0, 1200.0]], unknown])
    result: dict[str, Any] = {
        "_source": f"simulated for loopcal's example, seed {seed}; the machine is truth.yaml",
        "spool_r_in_origin_first_guess": [60.0] * 4,
        "spool_gear_teeth": 240,
        "motor_gear_teeth": 18,
        "mechanical_advantage": [2.0, 2.0, 2.0, 4.0],
        "lines_per_spool": [1.0] * 4,
        "xyz_of_samp": np.round(poses[:9] + POSITION * rng.standard_normal((9, 3)), 3).tolist(),
    }
    a, c, r, b = _split(TRUTH)
    paid = np.linalg.norm(poses[:, None] - a, axis=2) - c + LINE * rng.standard_normal((45, 4))
    angles, _ = compute_motor_angles(result, r, b, paid)
    return result | {"motor_pos_samp": np.round(np.degrees(angles), 2).tolist()}


def format_samples(samples: dict[str, Any]) -> str:
    """Return the text of a file of samples, one row of numbers on a line."""
    rows = [f'  "{key}": {_rows(value)}' for key, value in samples.items()]
    return "{\n" + ",\n".join(rows) + "\n}\n"


def _rows(value: Any) -> str:
    """Return the JSON of a value; nested lists have one inner list on a line."""
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "[\n    " + ",\n    ".join(json.dumps(row) for row in value) + "\n  ]"
    return json.dumps(value)
