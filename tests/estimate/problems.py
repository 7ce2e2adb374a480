# SPDX-License-Identifier: Apache-2.0
"""Triangular factors, instruments and measured robots that the tests of estimation share."""

from dataclasses import replace

import numpy as np

from loopcal.engine import fold
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.numerics.decomposition import empty_factor
from loopcal.parameters import ParameterTable
from tests import zoo

MM, UM, URAD = 1e-3, 1e-6, 1e-6


def fold_rows(rows: np.ndarray) -> np.ndarray:
    """Triangular factor (t, p + 1, p + 1) of rows [A | b] (t, m, p + 1)."""
    return fold(empty_factor(len(rows), rows.shape[-1] - 1), rows)


def noise(*sigma: float) -> Gaussian:
    """Normal noise with these standard deviations [SI]."""
    return Gaussian(np.array(sigma))


def tracker(sigma_position: float = UM, sigma_angle: float = 5 * URAD) -> Instrument:
    """Return an instrument of full poses with these sigmas [m, rad]."""
    return Instrument((Sensor(Pose(), noise(*[sigma_angle] * 3, *[sigma_position] * 3)),))


def five_dof() -> Instrument:
    """Return an instrument of position and the two angles of the normal, without torsion."""
    kind = Component(("x", "y", "z", "phi", "theta"), "tilt-torsion")
    return Instrument((Sensor(kind, noise(UM, UM, UM, 5 * URAD, 5 * URAD)),))


def probe(sigma: float = 5 * UM) -> Instrument:
    """Return an instrument of heights only."""
    return Instrument((Sensor(Component(("z",)), noise(sigma)),))


def with_tolerance(robot: Mechanism, tolerance: float) -> Mechanism:
    """Return the robot with one spread [SI] for all parameters."""
    entries = tuple(replace(p, tolerance=tolerance) for p in robot.parameters.entries)
    return replace(robot, parameters=ParameterTable(entries))


def hexapod_poses(n: int, seed: int = 0) -> np.ndarray:
    """Random poses (n, 4, 4) of the 42-parameter hexapod: +-40 mm about z = 200 mm, +-0.25 rad."""
    rng = np.random.default_rng(seed)
    middle, half = np.array([0, 0, 0.2, 0, 0, 0]), np.array([0.04, 0.04, 0.03, 0.25, 0.25, 0.25])
    return zoo.make_poses(middle + rng.uniform(-1.0, 1.0, (n, 6)) * half)


def hexapod_data(n: int = 30, seed: int = 0, instrument: Instrument | None = None) -> Measurements:
    """Simulate measurements of the true hexapod."""
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    return simulate(truth, hexapod_poses(n, seed), instrument or tracker(), seed)


def hexapod() -> Mechanism:
    """The nominal hexapod with the tolerance of its true errors."""
    return with_tolerance(zoo.hexapod(), 0.035e-3)


def simulate_heights(
    truth: Mechanism, grid: np.ndarray, seed: int = 0, sigma: float = 5 * UM
) -> Measurements:
    """Heights (z alone) of a restricted robot commanded by its nominal geometry to x, y, z (n, 3)
    [m].
    """
    readings = inverse(truth.nominal, grid).q
    kind = Component(("z",)).with_tool(truth.tool)
    drawn = sigma * np.random.default_rng(seed).standard_normal((1, len(grid), 1))
    seen = kind.measure(forward(truth, readings).T[None], drawn)[0]
    rows = Observations.from_sigma(kind, np.arange(len(grid)), seen, sigma)
    return Measurements(truth.name, readings, (rows,))


def bed_points(n: int, seed: int = 0, top: float = 0.0) -> np.ndarray:
    """Random points (n, 3) over the bed of the delta, up to `top` above it [m]."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.07, 0.07, (n, 2)), rng.uniform(0.0, 1.0, n) * top])
