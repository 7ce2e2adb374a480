# SPDX-License-Identifier: Apache-2.0
"""Errors that the drives have at every pose by itself, and a noise that is smaller than stated:
what the stated uncertainty of poses covers, and whether the calibration names the cause.

Machines and measurements come from `assumptions/hexapod.py`, without the kinematics of loopcal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import loopcal as lc
from evidence.assumptions.hexapod import (
    ROBOT,
    DriveError,
    draw_repeatability,
    make_backlash,
    make_periodic_error,
    measure_hexapod,
)
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.mechanism.solutions import forward

FITS = 40
SIGMAS = ((5e-6, 2.5e-5), (2e-5, 1e-4))
"""Stated noise of positions [m] and angles [rad]."""
CASES: tuple[tuple[str, float, DriveError | None], ...] = (
    ("clean", 1.0, None),
    ("noise 0.5 times sigma", 0.5, None),
    ("repeatability of 5 um", 1.0, draw_repeatability(5e-6)),
    ("backlash of 10 um", 1.0, make_backlash(1e-5)),
    ("periodic error of 5 um, 10 mm", 1.0, make_periodic_error(5e-6, 1e-2)),
)
"""Name, true noise over the stated one, and errors of the drives."""
NAMED = ("residuals.drive-errors", "residuals.backlash", "noise.residuals-too-small",
         "noise.residuals-too-large")  # fmt: skip
QUICK = {"FITS": 2}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    rows = tables["coverage"]["rows"]
    assert len(rows) == len(SIGMAS) * len(CASES)
    assert all(0.0 <= row[2] <= 1.0 for row in rows)


def evaluate_case(sigma: tuple[float, float], noise: float, error: DriveError | None) -> list[Any]:
    """Return the share of unmeasured poses within U (95 %), U and the true error [um], the same
    share of the fits that are called calibrated, their share, and that of fits that name a cause.
    """
    inside, sizes, good, named = [], [], [], []
    for seed in range(FITS):
        hexapod = measure_hexapod(seed, sigma, noise=noise, error=error)
        report = lc.calibrate(ROBOT, hexapod.data, lc.CalibrationOptions(hold_out=0.2))
        fit = report.identification
        predicted = forward(fit.robot, hexapod.readings)
        U = pose_uncertainty(fit, predicted, frame="base").expanded_position
        gap = np.linalg.norm(predicted.T[:, :3, 3] - hexapod.positions, axis=1)
        inside.append(np.mean(gap <= U))
        sizes.append((np.mean(U**2), np.mean(gap**2)))
        good.append(report.verdict is lc.Verdict.CALIBRATED)
        named.append(any(finding.code in NAMED for finding in report.findings))
    covered, is_good = np.array(inside), np.array(good)
    U, gap = 1e6 * np.sqrt(np.mean(sizes, axis=0))
    of_good = float(covered[is_good].mean()) if is_good.any() else None
    numbers = (covered.mean(), U, gap, of_good, is_good.mean(), np.mean(named))
    return [None if number is None else float(number) for number in numbers]


def collect() -> dict[str, Any]:
    """Collect all cases."""
    columns = ["noise of positions [um]", "case", "poses within U", "U [um]", "true error [um]",
               "within U, verdict calibrated", "verdict calibrated", "cause named"]  # fmt: skip
    rows = [
        [1e6 * sigma[0], name, *evaluate_case(sigma, noise, error)]
        for sigma in SIGMAS
        for name, noise, error in CASES
    ]
    formats = [".0f", "", ".3f", ".1f", ".1f", ".3f", ".2f", ".2f"]
    return {
        "fits": FITS,
        "tables": {"coverage": {"columns": columns, "formats": formats, "rows": rows}},
    }
