# SPDX-License-Identifier: Apache-2.0
"""The origin of Table 4: its Euler angles, the row of another machine, its rounding."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from loopcal import geometry
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.numerics.statistics import compute_chi_square_quantile
from loopcal.papers.hexapod_42.published import MM, Published
from loopcal.papers.hexapod_42.steps import Study, compute_actual_poses, iterate, to_measurements
from loopcal.papers.printed import Cell
from loopcal.typing import FloatArray

GREEK = ("alpha", "beta", "gamma")
LEVEL = 0.01
"""Probability of calling any pose of good data an outlier."""
UNITS = np.array([MM] * 3 + [1.0] * 3)
"""From the units of Table 4 to [m, rad]."""


@dataclass(frozen=True)
class Order:
    """Agreement of one product of three rotations with Table 4: rms over the poses [mm], [rad]."""

    formula: str
    position: float
    rotation: float


@dataclass(frozen=True)
class ReducedFit:
    """A fit without one pose. drop : by which chi-square falls."""

    label: str
    chi_square: float
    degrees: float
    p_value: float
    drop: float


@dataclass(frozen=True)
class Outliers:
    """The search for outliers.

    Attributes
    ----------
    labels : of the outliers, in the order in which they were removed.
    first, last : fits without each pose, before the first removal and after the last.
    """

    labels: tuple[str, ...]
    first: tuple[ReducedFit, ...]
    last: tuple[ReducedFit, ...]


def write_rotation(order: str, angles: tuple[int, ...] = (0, 1, 2)) -> str:
    """Return the product R of an Euler order whose angles are those of GREEK at these places.

    Examples
    --------
    >>> write_rotation("ZYX")
    'Rz(alpha) Ry(beta) Rx(gamma)'
    >>> write_rotation("xyz")
    'Rz(gamma) Ry(beta) Rx(alpha)'
    """
    turns = [f"R{axis.lower()}({GREEK[place]})" for axis, place in zip(order, angles, strict=True)]
    return " ".join(reversed(turns) if order.islower() else turns)


def rank_euler_orders(
    robot: Mechanism, truth: Mechanism, nominal: FloatArray, measured: FloatArray
) -> tuple[Order, ...]:
    """Return all products, the best first: 12 sequences of axes, angles in any order.

    Parameters
    ----------
    robot, truth : machines of Tables 2 and 3. nominal, measured : (n, 6) poses of Table 4 [m, rad].
    """
    orders = []
    for order in (name for name in geometry.EULER_ORDERS if name.islower()):
        for angles in permutations(range(3)):
            wanted, printed = (
                geometry.make_pose(
                    geometry.euler_to_matrix(poses[:, 3:][:, angles], order), poses[:, :3]
                )
                for poses in (nominal, measured)
            )
            commanded = inverse(robot, wanted)
            change = geometry.pose_difference(forward(truth, commanded.q, commanded).T, printed)
            position, rotation = (
                float(np.sqrt(np.mean(part**2))) for part in (change[:, 3:] / MM, change[:, :3])
            )
            orders.append(Order(write_rotation(order, angles), position, rotation))
    return tuple(sorted(orders, key=lambda o: o.position))


def search_outliers(study: Study, printed: Published, measured: FloatArray) -> Outliers:
    """Name poses of Table 4 that the others contradict, without using the errors of Table 3.

    Removing a pose lowers the chi-square of a least-squares fit (all legs, weighted by the rounding
    of each printed number) by a chi-square of its 6 equations if it belongs to the same machine.
    The pose with the largest drop is removed while that drop is too large at LEVEL over all poses.
    """
    sigma = printed.measured_poses.unit * UNITS / np.sqrt(12.0)
    data = to_measurements(study, measured, sigma)
    keep, labels, rounds = np.arange(len(measured)), [], []
    while True:
        whole = identify(study.robot, data.take(keep), LeastSquares()).chi_square
        fits = []
        for pose in keep:
            check = identify(
                study.robot, data.take(keep[keep != pose]), LeastSquares()
            ).residual_test
            numbers = (check.chi_square, check.degrees, check.p_value)
            fits.append(ReducedFit(data.labels[pose], *numbers, whole - check.chi_square))
        rounds.append(tuple(fits))
        worst = int(np.argmax([fit.drop for fit in fits]))
        largest = float(compute_chi_square_quantile(6, LEVEL / len(keep)))
        if fits[worst].drop <= largest or fits[worst].degrees < 6:
            return Outliers(tuple(labels), rounds[0], rounds[-1])
        labels.append(fits[worst].label)
        keep = np.delete(keep, worst)


def list_outliers(outliers: Outliers) -> list[tuple[Cell, ...]]:
    """Return table rows of the fits without each pose, before any was removed."""
    return [
        (o.label, o.chi_square, o.degrees, o.p_value, o.drop, o.label in outliers.labels)
        for o in outliers.first
    ]


def calibrate_from_print(
    study: Study, printed: Published, measured: FloatArray
) -> list[tuple[Cell, ...]]:
    """Return table rows of calibrations from Table 4 itself.

    The poses are those printed, with row A2 corrected, without it, and unrounded.
    """
    actual, bad = compute_actual_poses(study), printed.measured_poses.labels.index("A2")
    unit = printed.measured_poses.unit[bad - 1] * UNITS
    repaired = measured.copy()
    repaired[bad] = np.round(actual[bad] / unit) * unit
    keep = np.arange(len(measured)) != bad
    nine = Study(study.robot, study.truth, study.poses[keep], study.order)
    before = study.robot.values - study.truth.values
    rows: list[tuple[Cell, ...]] = [("not calibrated", None, _compute_rms(before))]
    for name, other, poses in (
        ("Table 4 as printed", study, measured),
        ("row A2 computed, rounded as row A1", study, repaired),
        ("without row A2", nine, measured[keep]),
        ("computed poses in full", study, actual),
    ):
        error = iterate(other, poses).compute_parameter_errors(study.truth)[-1]
        rows.append((name, len(poses), _compute_rms(error)))
    sigma = (printed.measured_poses.unit * UNITS / np.sqrt(12.0))[keep]
    data = to_measurements(nine, measured[keep], sigma)
    for name, method in (("least squares", LeastSquares()), ("tolerances as prior (MAP)", MAP())):
        error = identify(study.robot, data, method).robot.values - study.truth.values
        title = f"without row A2, all legs weighted by the rounding, {name}"
        rows.append((title, len(sigma), _compute_rms(error)))
    return rows


def _compute_rms(errors: FloatArray) -> float:
    """Return the root mean square [mm] of lengths [m]."""
    return float(np.sqrt(np.mean(errors**2)) / MM)
