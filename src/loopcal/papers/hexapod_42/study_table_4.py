# SPDX-License-Identifier: Apache-2.0
"""Where Table 4 comes from: which Euler angles, which row is of another machine, what its rounding
allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from loopcal import geometry
from loopcal.estimate import MAP, LeastSquares, identify
from loopcal.mechanism import Mechanism, forward, inverse
from loopcal.papers.hexapod_42.published import MM, Published
from loopcal.papers.hexapod_42.steps import ORDER, Study, actual_poses, iterate, measurements
from loopcal.papers.printed import Cell, Table
from loopcal.typing import FloatArray

GREEK = ("alpha", "beta", "gamma")
LEVEL = 0.01
"""Probability of naming any pose of good data an outlier."""


@dataclass(frozen=True)
class Order:
    """How well one product of three turns explains Table 4. position [mm] and rotation [rad] : rms
    over the poses.
    """

    formula: str
    position: float
    rotation: float


def rotation_formula(order: str, angles: tuple[int, ...] = (0, 1, 2)) -> str:
    """Name the product R of an Euler order whose angles are those of GREEK at these places.

    Examples
    --------
    >>> rotation_formula("ZYX")
    'Rz(alpha) Ry(beta) Rx(gamma)'
    >>> rotation_formula("xyz")
    'Rz(gamma) Ry(beta) Rx(alpha)'
    """
    turns = [f"R{axis.lower()}({GREEK[place]})" for axis, place in zip(order, angles, strict=True)]
    return " ".join(reversed(turns) if order.islower() else turns)


def orders(
    robot: Mechanism, truth: Mechanism, nominal: FloatArray, measured: FloatArray
) -> tuple[Order, ...]:
    """Try all products: 12 sequences of axes, each with the three angles in any order; the best
    first.

    Parameters
    ----------
    robot, truth : machines of Tables 2 and 3. nominal, measured : (n, 6) poses of Table 4 [m, rad].
    """
    found = []
    for order in (name for name in geometry.EULER_ORDERS if name.islower()):
        for angles in permutations(range(3)):
            wanted, seen = (
                geometry.make_pose(
                    geometry.euler_to_matrix(poses[:, 3:][:, angles], order), poses[:, :3]
                )
                for poses in (nominal, measured)
            )
            commanded = inverse(robot, wanted)
            difference = geometry.pose_difference(forward(truth, commanded.q, commanded).T, seen)
            sizes = (
                float(np.sqrt(np.mean(part**2)))
                for part in (difference[:, 3:] / MM, difference[:, :3])
            )
            found.append(Order(rotation_formula(order, angles), *sizes))
    return tuple(sorted(found, key=lambda o: o.position))


def orders_table(found: tuple[Order, ...], printed: str) -> Table:
    """All products, the best first, with the one that the paper prints marked."""
    rows = tuple(
        (o.formula, i + 1, o.position, o.rotation, o.formula == printed)
        for i, o in enumerate(found)
    )
    columns = ("R", "rank", "position rms [mm]", "rotation rms [rad]", "equation (2)")
    note = "Computed minus printed actual poses of Table 4, without row A2."
    return Table(
        "euler_orders",
        "Euler order of Table 4",
        columns,
        rows,
        ("", "d", ".2g", ".2g", ""),
        note,
        shown=6,
    )


@dataclass(frozen=True)
class LeftOut:
    """A pose left out of a fit. chi_square, degrees, p_value : of the others. drop : of chi-square
    that it accounts for.
    """

    label: str
    chi_square: float
    degrees: float
    p_value: float
    drop: float


@dataclass(frozen=True)
class Outliers:
    """Poses named, in turn, and every pose left out once before the first was named (`first`) and
    after the last (`last`).
    """

    named: tuple[str, ...]
    first: tuple[LeftOut, ...]
    last: tuple[LeftOut, ...]


def outliers(study: Study, printed: Published, measured: FloatArray) -> Outliers:
    """Name poses of Table 4 that the others contradict; the errors of Table 3 are not used.

    Leaving out a pose lowers the chi-square of a least-squares fit (all legs, weighted by the
    rounding of each printed number) by a chi-square of its 6 equations if it belongs to the same
    machine. The pose with the largest drop is left out while that drop is too large at LEVEL over
    all poses.
    """
    from scipy.special import chdtri

    sigma = printed.measured_poses.unit * np.array([MM] * 3 + [1.0] * 3) / np.sqrt(12.0)
    data = measurements(study, measured, sigma)
    keep, named, rounds = np.arange(len(measured)), [], []
    while True:
        whole = identify(study.robot, data.take(keep), LeastSquares()).chi_square
        left = []
        for pose in keep:
            check = identify(study.robot, data.take(keep[keep != pose]), LeastSquares()).check
            left.append(
                LeftOut(
                    data.labels[pose],
                    check.chi_square,
                    check.degrees,
                    check.p_value,
                    whole - check.chi_square,
                )
            )
        rounds.append(tuple(left))
        worst = int(np.argmax([one.drop for one in left]))
        if left[worst].drop <= chdtri(6, LEVEL / len(keep)) or left[worst].degrees < 6:
            return Outliers(tuple(named), rounds[0], rounds[-1])
        named.append(left[worst].label)
        keep = np.delete(keep, worst)


def outliers_table(found: Outliers) -> Table:
    """Every pose left out once, before any was named."""
    rows = tuple(
        (o.label, o.chi_square, o.degrees, o.p_value, o.drop, o.label in found.named)
        for o in found.first
    )
    columns = (
        "left out",
        "chi-square of the others",
        "degrees",
        "p-value",
        "drop of chi-square",
        "named",
    )
    largest = max(o.drop for o in found.last)
    note = (
        "Least squares over Table 4 as printed, weighted by its rounding; for poses of one machine "
        "a drop is a"
        " chi-square with 6 degrees of freedom. Without the poses named, the largest drop is "
        f"{largest:.1f}."
    )
    return Table(
        "outliers",
        "Which pose does not belong",
        columns,
        rows,
        ("", ".4g", ".0f", ".2g", ".4g", ""),
        note,
    )


def rounding(study: Study, printed: Published, measured: FloatArray) -> Table:
    """Calibrate from Table 4 itself: as printed, with row A2 put right, without it, and with
    numbers in full.
    """
    actual, bad = actual_poses(study), printed.measured_poses.labels.index("A2")
    unit = printed.measured_poses.unit[bad - 1] * np.array([MM] * 3 + [1.0] * 3)
    repaired = measured.copy()
    repaired[bad] = np.round(actual[bad] / unit) * unit
    keep = np.arange(len(measured)) != bad
    nine = Study(study.robot, study.truth, study.poses[keep], study.order)
    before = study.robot.values - study.truth.values
    rows: list[tuple[Cell, ...]] = [
        ("not calibrated", None, float(np.sqrt(np.mean(before**2)) / MM))
    ]
    for name, own, poses in (
        ("Table 4 as printed", study, measured),
        ("row A2 computed, rounded as row A1", study, repaired),
        ("without row A2", nine, measured[keep]),
        ("computed poses in full", study, actual),
    ):
        error = iterate(own, poses).parameter_errors(study.truth)[-1]
        rows.append((name, len(poses), float(np.sqrt(np.mean(error**2)) / MM)))
    sigma = (printed.measured_poses.unit * np.array([MM] * 3 + [1.0] * 3) / np.sqrt(12.0))[keep]
    data = measurements(nine, measured[keep], sigma)
    for name, method in (("least squares", LeastSquares()), ("tolerances as prior (MAP)", MAP())):
        error = identify(study.robot, data, method).robot.values - study.truth.values
        title = f"without row A2, all legs weighted by the rounding, {name}"
        rows.append((title, len(sigma), float(np.sqrt(np.mean(error**2)) / MM)))
    columns = ("measured poses", "number", "parameter error rms [mm]")
    note = f"Leg by leg, as in the paper, unless weighted; R = {rotation_formula(ORDER)}."
    return Table(
        "rounding",
        "Calibrating from Table 4 as printed",
        columns,
        tuple(rows),
        ("", "d", ".2g"),
        note,
    )
