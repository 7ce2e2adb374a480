# SPDX-License-Identifier: Apache-2.0
"""What the printed tables of hexapod-42 say by themselves: the Euler order of Table 4, its row of
another machine, what its rounding leaves, and the noise behind Tables 5 and 6.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np

import loopcal as lc
from loopcal import geometry
from loopcal.mechanism.solutions import forward, inverse
from loopcal.numerics.statistics import compute_chi_square_quantile, compute_f_tail
from loopcal.papers.hexapod_42 import results as steps
from loopcal.papers.hexapod_42.results import (
    MM,
    ODD_POSE,
    PARAMETERS,
    PRINTED,
    TO_PRINTED,
    Setup,
    compute_rms,
    find_places,
)
from loopcal.studies.simulation.published_steps import LegForm, integrate_errors
from loopcal.typing import FloatArray

GREEK = ("alpha", "beta", "gamma")
OUTLIER_LEVEL = 0.01
"""Probability of calling any pose of good data an outlier."""
SHOWN = 6
"""Products of three rotations in the table, of 72."""
DRAWS = 50
"""Of each level of noise."""
QUICK = {"SHOWN": 3, "DRAWS": 10}

MEASURED = PRINTED.table("table_4", "PP")
POSES = MEASURED.values / TO_PRINTED  # (10, 6) [m, rad]
ROUNDING = MEASURED.unit / TO_PRINTED / np.sqrt(12.0)  # (10, 6) its standard deviation [m, rad]
ODD = MEASURED.labels.index(ODD_POSE)
GOOD = np.arange(len(POSES)) != ODD


def write_rotation(order: str, angles: tuple[int, ...] = (0, 1, 2)) -> str:
    """Return the product R of an Euler order whose angles are those of GREEK at these places, such
    as `Rz(gamma) Ry(beta) Rx(alpha)` of "xyz".
    """
    turns = [f"R{axis.lower()}({GREEK[place]})" for axis, place in zip(order, angles, strict=True)]
    return " ".join(reversed(turns) if order.islower() else turns)


def rank_euler_orders(setup: Setup) -> list[list[Any]]:
    """Return the rms differences [mm, rad] of computed and printed poses, and those of positions
    over their rounding, for 12 sequences of axes with angles in any order, the best first.
    """
    printed_order, orders = write_rotation(PRINTED.find("rotation", "order")), []
    for order in (name for name in geometry.EULER_ORDERS if name.islower()):
        for angles in permutations(range(3)):
            wanted, printed = (
                geometry.make_pose(
                    geometry.euler_to_matrix(poses[:, 3:][:, angles], order), poses[:, :3]
                )
                for poses in (setup.poses[GOOD], POSES[GOOD])
            )
            commanded = inverse(setup.robot, wanted)
            reached = forward(setup.truth, commanded.q, commanded).T
            change = geometry.pose_difference(reached, printed)
            shares = compute_rms(change[:, 3:] / ROUNDING[GOOD, :3])
            formula = write_rotation(order, angles)
            sizes = compute_rms(change[:, 3:] / MM), compute_rms(change[:, :3]), shares
            orders.append([formula, *sizes, "yes" if formula == printed_order else "no"])
    return sorted(orders, key=lambda row: row[1])


def search_outliers(setup: Setup) -> list[list[Any]]:
    """Return each pose of Table 4, the chi-square of a fit to the others, its drop, and whether
    the pose is an outlier; without the errors of Table 3.

    Removing a pose lowers the chi-square of a least-squares fit (all legs, weighted by the rounding
    of each printed number) by a chi-square of its 6 equations if it belongs to the same machine.
    The pose with the largest drop is removed while that drop is too large.
    """
    data = steps.to_measurements(setup, POSES, ROUNDING)
    keep, labels, first = np.arange(len(POSES)), list[str](), list[list[Any]]()
    while True:
        whole = lc.identify(setup.robot, data.take(keep), lc.LeastSquares()).chi_square
        tests = [
            lc.identify(setup.robot, data.take(keep[keep != i]), lc.LeastSquares()).residual_test
            for i in keep
        ]
        drops = [whole - test.chi_square for test in tests]
        first = first or [
            [data.labels[i], test.chi_square, test.degrees, test.exact_p_value, drop]
            for i, test, drop in zip(keep, tests, drops, strict=True)
        ]
        worst = int(np.argmax(drops))
        level = OUTLIER_LEVEL / len(keep)
        if drops[worst] <= float(compute_chi_square_quantile(6, level)) or tests[0].degrees < 6:
            return [[*row, "yes" if row[0] in labels else "no"] for row in first]
        labels.append(data.labels[keep[worst]])
        keep = np.delete(keep, worst)


def calibrate_from_print(setup: Setup) -> list[list[Any]]:
    """Return number of poses and rms parameter error [mm] of calibrations from Table 4 itself."""
    repaired, unit = POSES.copy(), MEASURED.unit[ODD - 1] / TO_PRINTED
    repaired[ODD] = np.round(setup.actual[ODD] / unit) * unit
    nine = replace(setup, coordinates=setup.coordinates[GOOD])
    made: list[tuple[str, int | None, FloatArray]] = [("not calibrated", None, setup.robot.values)]
    for name, other, poses in (
        ("Table 4 as printed", setup, POSES),
        (f"row {ODD_POSE} computed, rounded as row A1", setup, repaired),
        (f"without row {ODD_POSE}", nine, POSES[GOOD]),
        ("computed poses in full", setup, setup.actual),
    ):
        made.append((name, len(poses), steps.iterate(other, poses).values[-1]))
    data = steps.to_measurements(nine, POSES[GOOD], ROUNDING[GOOD])
    title = f"without row {ODD_POSE}, all legs weighted by the rounding"
    for name, method in (("least squares", lc.LeastSquares()), ("MAP", lc.MAP())):
        values = lc.identify(setup.robot, data, method).robot.values
        made.append((f"{title}, {name}", len(nine.poses), values))
    return [[name, n, compute_rms(v - setup.truth.values) / MM] for name, n, v in made]


def make_symmetric(setup: Setup) -> FloatArray:
    """Return Table 2 (6, 7) [mm] of a hexapod with threefold symmetry, from its first two legs."""
    printed = PRINTED.table("table_2").values
    table = printed.copy()
    for leg, (source, angle) in enumerate(((0, 0), (1, 0), (0, 120), (1, 120), (0, 240), (1, 240))):
        turn = geometry.rotation_about_axis(np.deg2rad(angle), 2)
        for part in (slice(0, 3), slice(4, 7)):
            table[leg, part] = turn @ printed[source, part]
    place = PARAMETERS.index("length")
    length = setup.robot.values[find_places(setup.robot)[:, place]]
    table[:, place] = (length + inverse(setup.robot, setup.robot.home[None]).q[0]) / MM
    return table


def recover_noise(setup: Setup, legs: LegForm) -> FloatArray:
    """Return the noise (n, 6) [m, rad] that Tables 5 and 6 together imply.

    residual = noise + D (true - corrected parameters), with D the change of the coordinates.
    """
    rates = steps.ANGLES.rates_inverse(setup.actual[:, 3:])
    by_coordinates = np.concatenate([legs.D[:, 3:], rates @ legs.D[:, :3]], axis=1)
    errors = np.zeros(len(setup.robot.parameters))
    errors[find_places(setup.robot)] = PRINTED.table("table_5", "after").values * 1e-3 * MM
    return PRINTED.table("table_6", "after").values / TO_PRINTED - by_coordinates @ errors


def explain(legs: LegForm, twists: FloatArray) -> FloatArray:
    """Return the share (6,) of each leg's length changes that parameters could explain.

    It is the ratio of norms, and 0 for residuals of least squares.
    """
    lengths, shares = legs.compute_lengths(twists), []
    for leg, members in enumerate(legs.members):
        q, _ = np.linalg.qr(legs.G[:, leg, members])
        explained = np.linalg.norm(q.T @ lengths[:, leg])
        shares.append(float(explained / np.linalg.norm(lengths[:, leg])))
    return np.array(shares)


def measure_printed() -> FloatArray:
    """Return the sizes (4,) of Tables 5 and 6, see `steps.Level`."""
    residual = PRINTED.table("table_6", "after").values / TO_PRINTED
    parameters = PRINTED.table("table_5", "after").values * 1e-3
    rms = [compute_rms(part) for part in (residual[:, :3] / MM, residual[:, 3:], parameters)]
    return np.array([*rms, integrate_errors(residual)])


def compute_p_value(drawn: FloatArray, sizes: FloatArray) -> float:
    """Return the p-value of sizes (4,) as one more of the drawn ones (t, 4): Student's t of their
    logarithms, the smallest of the four probabilities times four.
    """
    logs = np.log(drawn)
    spread = logs.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / len(logs))
    t = (np.log(sizes) - logs.mean(axis=0)) / spread
    return float(min(4.0 * compute_f_tail(1, len(logs) - 1, t**2).min(), 1.0))


def compare_noises(setup: Setup) -> list[list[Any]]:
    """Return the sizes of Tables 5 and 6, and those that each level of noise leaves, with the
    p-value of the printed ones among them.
    """
    sizes = measure_printed()
    rows: list[list[Any]] = [["published, Tables 5 and 6", None, None, *sizes.tolist(), None]]
    for level in steps.sweep_noise(setup, 0, DRAWS).values():
        p_value = compute_p_value(level.sizes, sizes)
        rows.append(["computed, median", *level.limits, *level.median.tolist(), p_value])
    return rows


def examine_tables(setup: Setup) -> list[list[Any]]:
    """Return what else the tables say, a number each."""
    legs = LegForm.at(setup.truth, forward(setup.truth, setup.commanded.q, setup.commanded))
    residual = PRINTED.table("table_6", "after").values / TO_PRINTED
    explained = 100.0 * explain(legs, setup.to_twists(residual, setup.actual))
    symmetric = np.abs(make_symmetric(setup) - PRINTED.table("table_2").values)
    without = setup.truth.values.copy()
    places = find_places(setup.robot)[:, PARAMETERS.index("length")]
    without[places] = setup.robot.values[places]
    odd = setup.compute_reached(setup.robot.with_values(without))[ODD] * TO_PRINTED
    is_row = np.abs(odd - MEASURED.values[ODD]) <= MEASURED.unit[ODD]
    before, computed = PRINTED.table("table_6", "before"), (setup.actual - setup.poses)[GOOD, 3:]
    unit = np.maximum(before.unit, MEASURED.unit)[GOOD, 3:]
    as_rad, as_mrad = (
        int((np.abs(factor * computed - before.values[GOOD, 3:]) <= unit).sum())
        for factor in (1.0, 1e3)
    )
    noise = recover_noise(setup, legs)
    mean, scatter = noise.mean(axis=0), noise.std(axis=0, ddof=1)
    lengths, angles = (
        f"({', '.join(f'{x:.1e}' for x in part)}) {unit}"
        for part, unit in ((mean[:3] / MM, "mm"), (mean[3:], "rad"))
    )
    return [
        ["Table 2: largest distance from threefold symmetry [mm]", float(symmetric.max())],
        ["Table 2: numbers off by more than a unit of the last digit",
         int((symmetric > PRINTED.table("table_2").unit).sum())],
        [f"row {ODD_POSE} with leg lengths without errors: numbers that agree, of 6",
         int(is_row.sum())],
        [f"Table 6, angles before, without {ODD_POSE}: numbers that agree as rad, of 27", as_rad],
        ["the same as mrad", as_mrad],
        ["Table 6, after: share that parameters explain, least of the legs [%]",
         float(explained.min())],
        ["the same, most [%]", float(explained.max())],
        ["the same of random numbers [%]", float(100.0 * np.sqrt(0.7))],
        ["offset of the noise that Tables 5 and 6 imply", f"{lengths}, {angles}"],
        ["scatter of the poses about it, largest sd [mm]", float(scatter[:3].max() / MM)],
        ["the same [rad]", float(scatter[3:].max())],
        ["offset over its standard error, largest",
         float((np.abs(mean) * np.sqrt(len(noise)) / scatter).max())],
    ]  # fmt: skip


def check(tables: dict[str, Any]) -> None:
    """Assert what the documentation says."""
    best, second, *_ = tables["euler_orders"]["rows"]
    assert best[0] == "Rz(gamma) Ry(beta) Rx(alpha)"
    # [mm, rad] rounding of the coarsest digits, 1e-4 / sqrt(12) = 2.9e-5 and 1e-5 / sqrt(12) =
    # 2.9e-6
    assert best[1] < 2.9e-5
    assert best[2] < 2.9e-6
    assert best[3] < 1.2
    assert second[3] > 50.0
    (printed,) = (row for row in tables["euler_orders"]["rows"] if row[-1] == "yes")
    np.testing.assert_allclose(printed[1:3], [2.8e-3, 7.1e-4], rtol=0.05)
    published, *levels = tables["noise"]["rows"]
    np.testing.assert_allclose(published[3:7], [3.04e-7, 9.1e-10, 2.39e-4, 7.2e-7], rtol=0.01)
    for length, angle, *_, p_value in (row[1:] for row in levels):
        assert p_value < 1e-3 or (length == 1e-6 and angle < 1e-6)
    assert max(row[-1] for row in levels) > 0.05
    outliers = {row[0]: row for row in tables["outliers"]["rows"]}
    assert [name for name, row in outliers.items() if row[-1] == "yes"] == [ODD_POSE]
    assert 1e-3 < outliers[ODD_POSE][3] < 1.0 - 1e-3
    assert all(row[3] < 1e-9 for name, row in outliers.items() if name != ODD_POSE)
    before, printed, corrected, nine, full, weighted, prior = (
        row[2] for row in tables["rounding"]["rows"]
    )
    assert min(printed, corrected, nine, weighted) > before > prior
    assert full < 1e-8  # [mm]
    (symmetric, differing, agreeing, as_rad, as_mrad, _, explained, _, _, scatter, _, offset) = (
        row[1] for row in tables["sizes"]["rows"]
    )
    assert (differing, agreeing, as_rad, as_mrad) == (6, 6, 27, 0)
    assert symmetric < 1e-5  # [mm]
    assert explained < 10.0
    assert scatter < 2e-6  # [mm]
    assert offset > 7.0  # of six means of ten poses 0.04 % exceed it


def collect() -> dict[str, Any]:
    """Collect what the printed tables say."""
    setup = steps.make_setup()
    orders = rank_euler_orders(setup)
    kept = [row for i, row in enumerate(orders) if i < SHOWN or row[-1] == "yes"]
    return {
        "tables": {
            "euler_orders": {
                "columns": ["R", "position rms [mm]", "rotation rms [rad]",
                            "position rms over rounding", "equation (2)"],
                "formats": ["", ".2g", ".2g", ".2g", ""],
                "rows": kept,
            },
            "outliers": {
                "columns": ["left out", "chi-square of the others", "degrees of freedom",
                            "p-value", "drop of chi-square", "outlier"],
                "formats": ["", ".4g", ".0f", ".2g", ".4g", ""],
                "rows": search_outliers(setup),
            },
            "rounding": {
                "columns": ["measured poses", "number", "parameter error rms [mm]"],
                "formats": ["", "d", ".2g"],
                "rows": calibrate_from_print(setup),
            },
            "noise": {
                "columns": ["", "noise +- [mm]", "noise +- [rad]",
                            "residual of position coordinates, rms [mm]",
                            "residual of angles, rms [rad]", "parameter error, rms [mm]",
                            "max dQint [mm + rad]", "p-value of the published sizes"],
                "formats": ["", ".0e", ".0e", ".2g", ".2g", ".2g", ".2g", ".1g"],
                "rows": compare_noises(setup),
            },
            "sizes": {
                "columns": ["", "number"],
                "formats": ["", ".2g"],
                "rows": examine_tables(setup),
            },
        },
    }  # fmt: skip
