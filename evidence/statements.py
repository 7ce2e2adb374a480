# SPDX-License-Identifier: Apache-2.0
"""What `calibrate` states where an assumption breaks, of machines that are simulated without the
kinematics of loopcal: what the stated uncertainty of unmeasured poses covers, and whether the
report names the cause; and how often clean data get a warning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import loopcal as lc
from evidence.assumptions.machines import (
    FRAME,
    SETUPS,
    Effects,
    Setup,
    draw_repeatability,
    make_backlash,
    make_periodic_error,
    measure_machine,
)
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.diagnose.residual_patterns import CAUSE
from loopcal.findings import Severity
from loopcal.geometry import exp_so3
from loopcal.mechanism.solutions import forward

FITS = 200
HOLD_OUT = 0.2
COVERED, NAMED = 0.93, 0.8
"""Required of each case: poses within U (95 %), or else this share of fits that name the cause and
are not called calibrated.
"""

DRIVES = ("residuals.drive-errors", "residuals.backlash", "residuals.depend-on-reading", "drives")
TIME = ("residuals.drift", "residuals.trend", "residuals.sessions", "residuals.correlated",
        "time", "order", "session", "walk")  # fmt: skip
SIZE = ("noise.residuals", "noise.doubtful")
SMOOTH = ("residuals.model-discrepancy",)
SHARED = ("pose",)
ALARMS = (Severity.WARNING, Severity.FAILURE)
WIDENING = ("residuals.drift", "residuals.trend", "residuals.sessions", "residuals.depend",
            "residuals.correlated", "residuals.model-discrepancy", "residuals.drive-errors",
            "residuals.backlash", "residuals.shared-errors")  # fmt: skip
"""Beginnings of the codes of findings that widen an uncertainty, also without a warning."""
NEUTRAL = "residuals.correlated-parameters"  # it tests nothing
QUICK = {"FITS": 2}


@dataclass(frozen=True)
class Case:
    """An assumption that breaks. causes : beginnings of the codes that name it, or its name as the
    most probable cause; empty where the data are clean or no residual can show the cause.
    """

    name: str
    effects: Effects
    causes: tuple[str, ...] = ()
    sigma_uncertainty: float = lc.FitOptions.sigma_uncertainty


CLEAN = Case("clean", Effects())
GENERAL = (
    Case("noise half the stated one", Effects(noise=0.5), SIZE),
    Case("noise 1.25 times, sigma known to 25 %", Effects(noise=1.25),
         sigma_uncertainty=0.25),
    Case("offsets of four sessions, 3 sigma, not named", Effects(session=3.0), TIME),
    Case("random walk, half a sigma a pose", Effects(walk=0.5), TIME),
    Case("sag of 30 um", Effects(sag=3e-5), SMOOTH),
)  # fmt: skip
LINEAR = (
    Case("offsets of four sessions, 3 sigma, named", Effects(session=3.0, is_named=True), TIME),
    Case("repeatability of 5 um", Effects(drives=draw_repeatability(5e-6)), DRIVES),
    Case("backlash of 10 um", Effects(drives=make_backlash(1e-5)), DRIVES),
    Case("periodic error of 5 um, 10 mm", Effects(drives=make_periodic_error(5e-6, 1e-2)), DRIVES),
)
CASES = {
    "hexapod, pose probe": (CLEAN, *LINEAR, *GENERAL),
    "hexapod, tracker": (
        CLEAN,
        Case("error shared by the targets of a pose, 2 sigma", Effects(shared=2.0), SHARED),
        *GENERAL,
    ),
    "delta, points": (CLEAN, *LINEAR, *GENERAL),
    "delta, heights": (CLEAN,),
    "five-bar, camera": (CLEAN, *GENERAL),
    "five-bar, known camera": (CLEAN,),
}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    rows = tables["coverage"]["rows"]
    assert len(rows) == sum(map(len, CASES.values()))
    assert all(0.0 <= row[2] <= 1.0 for row in rows)
    assert len(tables["alarms"]["rows"]) == len(CASES)


@dataclass(frozen=True)
class Outcome:
    """One fit: the share of unmeasured poses within U, mean squares of U and of the true error
    [m^2], the codes and severities of the findings, and the most probable cause that they name.
    """

    covered: float
    squares: tuple[float, float]
    verdict: lc.Verdict
    findings: dict[str, Severity]
    cause: str


def evaluate_fit(setup: Setup, case: Case, seed: int) -> Outcome:
    """Calibrate a machine, and compare what is stated with the truth."""
    robot = lc.load_robot(setup.robot)
    machine = measure_machine(setup, seed, case.effects)
    fit_options = lc.FitOptions(sigma_uncertainty=case.sigma_uncertainty)
    options = lc.CalibrationOptions(fit=fit_options, hold_out=HOLD_OUT)
    report = lc.calibrate(robot, machine.data, options)
    fit = report.identification
    predicted = forward(fit.robot, machine.readings)
    U = pose_uncertainty(fit, predicted, frame=FRAME if setup.in_frame else "base")
    position = predicted.T[:, :3, 3]
    if setup.in_frame:
        place = dict(zip(fit.nuisance.names, fit.nuisance.estimate, strict=True))
        turn, origin = (
            np.array([place[f"{FRAME}.{axis}"] for axis in axes])
            for axes in (("rx", "ry", "rz"), ("x", "y", "z"))
        )
        position = (position - origin) @ exp_so3(turn)
    gap = np.linalg.norm(position - machine.positions, axis=1)
    inside = gap <= U.expanded_position
    squares = float(np.mean(U.expanded_position**2)), float(np.mean(gap**2))
    findings = {f.code: f.severity for f in report.findings if f.code != NEUTRAL}
    cause = [finding.data["cause"] for finding in report.findings if finding.code == CAUSE]
    return Outcome(float(inside.mean()), squares, report.verdict, findings, "".join(cause))


def tabulate(outcomes: dict[tuple[str, str], list[Outcome]]) -> dict[str, Any]:
    """Return the tables of coverage and of alarms."""
    rows, alarms = [], []
    for (setup, name), of_case in outcomes.items():
        case = next(case for case in CASES[setup] if case.name == name)
        covered = np.array([outcome.covered for outcome in of_case])
        good = np.array([outcome.verdict is lc.Verdict.CALIBRATED for outcome in of_case])
        named = np.array(
            [any(c.startswith(case.causes) for c in (*o.findings, o.cause)) for o in of_case]
        )
        U, gap = 1e6 * np.sqrt(np.median([outcome.squares for outcome in of_case], axis=0))
        of_good = float(covered[good].mean()) if good.any() else None
        told = (named & ~good).mean()
        shares = [float(named.mean()), float(told)] if case.causes else [None, None]
        is_met = covered.mean() >= COVERED or (bool(case.causes) and told >= NAMED)
        numbers = [
            float(covered.mean()),
            float(U),
            float(gap),
            of_good,
            float(good.mean()),
            *shares,
        ]
        rows.append([setup, name, *numbers, "yes" if is_met else "no"])
        if case is CLEAN:
            warned = [
                {c for c, s in o.findings.items() if s in ALARMS or c.startswith(WIDENING)}
                for o in of_case
            ]
            codes = sorted({code for codes in warned for code in codes})
            listed = ", ".join(f"{c} {100 * np.mean([c in w for w in warned]):.1f}" for c in codes)
            alarms.append([setup, len(of_case), 100.0 * np.mean([bool(w) for w in warned]), listed])
    columns = ["machine and instrument", "case", "poses within U", "U [um], rms",
               "true error [um], rms",
               "within U, verdict calibrated", "verdict calibrated", "cause named",
               "cause named, not calibrated", "met"]  # fmt: skip
    return {
        "coverage": {
            "columns": columns,
            "formats": ["", "", ".3f", ".1f", ".1f", ".3f", ".2f", ".2f", ".2f", ""],
            "rows": rows,
        },
        "alarms": {
            "columns": ["machine and instrument", "fits", "any warning or widening [% of fits]",
                        "of them [% of fits]"],
            "formats": ["", "d", ".1f", ""],
            "rows": alarms,
        },
    }  # fmt: skip


def collect() -> dict[str, Any]:
    """Collect all cases."""
    outcomes = {
        (name, case.name): [evaluate_fit(SETUPS[name], case, seed) for seed in range(FITS)]
        for name, cases in CASES.items()
        for case in cases
    }
    return {"fits": FITS, "tables": tabulate(outcomes)}
