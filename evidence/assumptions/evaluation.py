# SPDX-License-Identifier: Apache-2.0
"""Calibrate the machines of a case as `calibrate` does, and compare the results with the truth.

Every fit takes the path of `calibrate`: `identify`, the adjustment of the uncertainty by the
residuals, the search for outliers and for common errors. The errors of held-out poses are those of
the tool point in the base frame, which is also the frame of the instrument.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from evidence.assumptions.cases import OUTLIERS, Case, Setup, list_cases
from evidence.assumptions.levels import name_group
from evidence.assumptions.simulation import Array, BoolArray, Simulation, simulate_case
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty, check_heavy_tails
from loopcal.diagnose.outliers import find_outliers
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.findings import Severity
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward

FITS, EXAMINED = 400, 25
"""Fits of a case; those of them that are searched for outliers and common errors, where these
neither explain the case nor would be false alarms.
"""

COMMON = 0.1
"""Share of clean fits above which a finding explains nothing."""

COVERED, EXPLAINED, CLEAN_BAND = 0.93, 0.95, 0.015
"""Required coverage, or share of fits with an explanation, where an assumption is wrong; largest
difference from a coverage of 95 % where none is.
"""


@dataclass(frozen=True, eq=False)
class Outcome:
    """One fit: which parameters (p free,) and held-out poses (h,) lie in their intervals, the codes
    and severities of its findings and of those of its examination (None without one), and its
    held-out position error, rms [m].
    """

    parameters: BoolArray
    position: BoolArray
    orientation: BoolArray
    findings: dict[str, Severity]
    examination: dict[str, Severity] | None
    error: float

    @property
    def codes(self) -> set[str]:
        """Codes of all findings, those of the examination included."""
        return set(self.findings) | set(self.examination or {})

    @property
    def alarms(self) -> set[str]:
        """Codes of the findings that say that something may be wrong."""
        findings = self.findings | (self.examination or {})
        return {code for code, s in findings.items() if s in (Severity.WARNING, Severity.FAILURE)}


def evaluate_fit(
    robot: Mechanism, case: Case, simulation: Simulation, i: int, is_examined: bool
) -> Outcome:
    """Calibrate machine i and compare the result with its truth."""
    data = simulation.measurements[i]
    options = FitOptions(
        method=LeastSquares() if case.least_squares else None,
        noise="estimated" if case.estimated else "given",
    )
    fit = identify(robot, data, options=options)
    linear = linearize_fit(fit, data) if fit.converged else None
    fit = adjust_uncertainty(fit, data, linear)
    examination = None
    if is_examined and fit.converged:
        outliers = find_outliers(fit, data)
        tails = check_heavy_tails(fit, data, outliers.suspects, linear)
        findings = (*outliers.findings, *tails.findings)
        examination = {finding.code: finding.severity for finding in findings}
    truth = simulation.trials.truth[i][fit.free_parameters.places]
    predicted = forward(fit.robot, simulation.q)
    U = pose_uncertainty(fit, predicted, frame="base")
    gap = np.linalg.norm(predicted.T[:, :3, 3] - simulation.position[i], axis=1)
    turn = predicted.T[:, :3, :3] @ simulation.R[i].swapaxes(1, 2)
    cosine = 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0)
    skew = np.linalg.norm(turn - turn.swapaxes(1, 2), axis=(1, 2)) / np.sqrt(8.0)
    angle = np.arctan2(skew, cosine)
    return Outcome(
        np.abs(fit.estimate - truth) <= fit.interval(),
        gap <= U.expanded_position,
        angle <= U.expanded_orientation,
        {finding.code: finding.severity for finding in fit.findings},
        examination,
        float(np.sqrt(np.mean(gap**2))),
    )


def evaluate_least_squares(robot: Mechanism, simulation: Simulation) -> Array:
    """Return held-out position errors (t,) [m] of least squares."""
    fits = identify_trials(robot, simulation.trials, LeastSquares())
    position = forward_trials(robot, fits.values, simulation.q[None]).T[..., :3, 3]
    return np.sqrt(((position - simulation.position) ** 2).sum(axis=2).mean(axis=1))


def evaluate_case(
    setup: Setup, case: Case, fits: int = FITS, common: frozenset[str] = frozenset()
) -> dict[str, Any]:
    """Return the statistics of a case: coverages, error over that of least squares, and the rate of
    every code, all as shares. Codes that are `common` in clean data explain nothing.
    """
    robot = load_robot(setup.robot)
    simulation = simulate_case(setup, case, fits)
    examined = fits if case.is_clean or set(OUTLIERS) & set(case.explaining) else EXAMINED
    outcomes = [evaluate_fit(robot, case, simulation, i, i < examined) for i in range(fits)]
    errors = np.array([o.error for o in outcomes])
    reference = errors if case.least_squares else evaluate_least_squares(robot, simulation)
    parameters = np.array([o.parameters for o in outcomes])
    rates = count_codes([o.findings for o in outcomes])
    rates |= count_codes([o.examination for o in outcomes if o.examination is not None])
    has_angle = not setup.columns
    return {
        "fits": fits,
        "parameters": float(parameters.mean()),
        "moved": float(parameters[simulation.moved].mean()),
        "worst": float(parameters.mean(axis=0).min()),
        "position": float(np.mean([o.position for o in outcomes])),
        "orientation": float(np.mean([o.orientation for o in outcomes])) if has_angle else None,
        "median": float(np.median(errors / reference)),
        "rms": float(np.sqrt(np.mean(errors**2) / np.mean(reference**2))),
        "explained": None
        if not case.explaining
        else float(np.mean([is_explained(case, o.codes - common) for o in outcomes])),
        "codes": dict(sorted(rates.items())),
        "groups": count_codes([{name_group(code) for code in o.alarms} for o in outcomes]),
        "alarms": sorted(set().union(*(o.alarms for o in outcomes))),
    }


def count_codes(findings: Sequence[Iterable[str]]) -> dict[str, float]:
    """Return the share of the fits that have each code."""
    counts = Counter(code for of_fit in findings for code in of_fit)
    return {code: count / len(findings) for code, count in counts.items()}


def is_explained(case: Case, codes: set[str]) -> bool:
    """Return whether a finding names the assumption that the case breaks."""
    return any(code.startswith(case.explaining) for code in codes)


def evaluate_setup(setup: Setup, fits: int = FITS) -> dict[str, dict[str, Any]]:
    """Return the statistics of all cases by name."""
    cases = list_cases()
    clean = {c.name: evaluate_case(setup, c, fits) for c in cases if c.is_clean}
    rates = [statistics["codes"] for statistics in clean.values()]
    common = frozenset(code for codes in rates for code in codes if codes[code] > COMMON)
    others = (c for c in cases if not c.is_clean)
    return clean | {c.name: evaluate_case(setup, c, fits, common) for c in others}


def is_met(statistics: dict[str, Any], is_clean: bool) -> bool:
    """Return whether the requirement is met: correct coverage where every assumption holds; else a
    coverage of at least 93 %, or an explanation in at least 95 % of the fits.
    """
    covered = [statistics[key] for key in ("parameters", "moved", "position", "orientation")]
    shares = [share for share in covered if share is not None]
    if is_clean:
        return all(abs(share - 0.95) <= CLEAN_BAND for share in shares)
    return min(shares) >= COVERED or (statistics["explained"] or 0.0) >= EXPLAINED
