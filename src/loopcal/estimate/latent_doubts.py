# SPDX-License-Identifier: Apache-2.0
"""Readings that were not taken and were found where the machine hardly was: outside the stroke, or
bent the other way.

Rows at the platform cannot tell the ways in which a limb bends to one pose, nor do they know of end
stops. Both fit equally well and both are said, so that nobody takes such a reading for a measured
one. So is a spread of sigmas that rounding cannot bear.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.latent import LatentRows
from loopcal.estimate.latent_estimate import LatentEstimate
from loopcal.geometry import wrap_angle
from loopcal.mechanism import Mechanism, inverse
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

APART = 1e-6
"""Difference of readings, as a share of the robot's size or in radians, above which they are two
solutions, not rounding.
"""

UNEVEN = 1e9
"""Ratio of standard deviations beyond which whitened rows of one sort drown in the rounding of
another.
"""

SHOWN = 3
"""Readings told one by one; the others are counted."""


def latent_doubts(robot: Mechanism, latent: LatentEstimate) -> list[str]:
    """Return sentences on readings that were found outside their stroke or on another branch than
    home's.

    Parameters
    ----------
    robot : the identified one.
    """
    known = np.asarray(np.isfinite(latent.poses).all(axis=(1, 2)) & ~latent.open)
    found = np.isinf(latent.sigma) & known[:, None]
    low, high = np.array([a.stroke or (-np.inf, np.inf) for a in robot.actuators]).T
    outside = found & ((latent.readings < low) | (latent.readings > high))
    beside = found & _other_branch(robot, latent, np.asarray(found.any(axis=1)))
    notes = []
    if outside.any():
        notes.append(
            f"found outside the stroke: {_named(robot, latent, outside)}; measure more at these "
            "poses, or leave them out"
        )
    if beside.any():
        notes.append(
            f"found on another branch than that of home: {_named(robot, latent, beside)}; rows at "
            "the platform fit both;"
            " where the machine stood as at home, give the reading roughly, its sigma infinite, as "
            "a start"
        )
    return notes


def uneven(rows: LatentRows) -> list[str]:
    """Return a sentence where the sigmas of all rows, in sizes of the robot or radians, differ by
    more than rounding bears.
    """
    robot = rows.unknowns.robot
    least, most, name = np.inf, 0.0, ""
    for s in rows.sensed:
        weight = np.einsum("trii->tri", s.whitener)
        for i, column in enumerate(s.kind.noise_columns):
            there = weight[..., i][weight[..., i] > 0.0]
            if len(there) and column.dimension in (Dimension.LENGTH, Dimension.ANGLE):
                scale = robot.size if column.dimension is Dimension.LENGTH else 1.0
                most = max(most, 1.0 / (there.min() * scale))
                if 1.0 / (there.max() * scale) < least:
                    least, name = 1.0 / (there.max() * scale), f"{s.kind.name} {column.name}"
    if most <= UNEVEN * least:
        return []
    what = f"standard deviations differ by a factor of {most / least:.2g}"
    return [
        (
            f"{what}: what only the larger tell drowns in rounding and counts as not determined; "
            "check "
            f"the smallest, of {name}"
        )
    ]


def _other_branch(robot: Mechanism, latent: LatentEstimate, poses: np.ndarray) -> np.ndarray:
    """Readings (n, a) that differ from those with which home's branch reaches the same pose."""
    other = np.zeros(latent.readings.shape, dtype=bool)
    if poses.any():
        home = inverse(robot, latent.poses[poses])
        gap = latent.readings[poses] - home.q
        turning = np.array([a.dimension is Dimension.ANGLE for a in robot.actuators])
        gap = np.abs(np.where(turning, wrap_angle(gap), gap)) / np.where(turning, 1.0, robot.size)
        other[poses] = home.converged[:, None] & (gap > APART)
    return other


def _named(robot: Mechanism, latent: LatentEstimate, chosen: np.ndarray) -> str:
    """Readings by actuator and pose, with their values."""
    words = []
    for pose, column in np.argwhere(chosen)[:SHOWN]:
        actuator = robot.actuators[column]
        shown = find_unit(
            robot.units.get(actuator.dimension, DISPLAY_UNITS[actuator.dimension].symbol)
        )
        value = latent.readings[pose, column] / shown.factor_to_si
        words.append(f"{actuator.name} at pose {latent.labels[pose]} ({value:.6g} {shown.symbol})")
    more = int(chosen.sum()) - len(words)
    return ", ".join(words) + (f" and {more} more" if more else "")
