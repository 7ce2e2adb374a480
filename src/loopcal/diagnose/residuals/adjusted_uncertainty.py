# SPDX-License-Identifier: Apache-2.0
"""Adjust the uncertainty of a fit to what its residuals show about their errors.

An effect of size g, with whitened columns Z, that the model does not have displaces the estimate by
root G'Z g. As g is not known, only its second moments, root G'Z E[g g'] Z'G root' is added to the
covariance: an interval then contains the truth at least as often as one without the effect.
Correlated errors replace the part of the covariance that independent errors cause, where theirs is
larger. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.error_frames import FITTED
from loopcal.diagnose.residuals.model_discrepancy import add_slow_errors, find_slow_errors
from loopcal.diagnose.residuals.residual_effects import READING, SESSION, TEMPERATURE, TIME
from loopcal.diagnose.residuals.residual_patterns import (
    EffectSizes,
    ResidualPatterns,
    find_patterns,
)
from loopcal.diagnose.residuals.residual_rows import ResidualRows, collect_residual_rows
from loopcal.diagnose.tool_errors import (
    MOST_POSES,
    choose_evenly,
    linearize_tool_errors,
    locate_measured_poses,
)
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.inference.added_covariance import add_covariance
from loopcal.estimate.inference.covariance_parts import NOISE
from loopcal.estimate.inference.residual_test import choose_severity
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Quantity, Severity, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.mechanism import Solution
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS

NOTICEABLE = 1.05
"""Factor of the uncertainty of the measured poses from which a correlation that no test shows is
allowed for.
"""

TOO_SMALL = "noise.residuals-too-small"
"""Code of the finding that independent errors would mean that sigma is too large."""


def adjust_uncertainty(
    fit: Identification, data: Measurements, linear: FitLinearization | None = None
) -> Identification:
    """Return a fit whose covariance allows for what the residuals show, and says why.

    Estimates stay. No variance becomes smaller. A fit that did not converge, has no intervals, or
    has weights by a loss is returned as it is.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    linear : of both, where the caller has it, see `linearize_fit`.

    Raises
    ------
    DataError : another number of poses.
    """
    check_fitted_data(fit, data)
    if not (fit.converged and fit.residual_test.intervals) or fit.options.loss is not None:
        return fit
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    linear = linearize_fit(fit, data) if linear is None else linear
    rows = collect_residual_rows(fit, data, linear)
    slow = find_slow_errors(fit, data, linear, _place_measured_poses(fit, data, linear))
    if rows is not None:
        fit = _add_patterns(fit, data, rows, is_slow=slow is not None)
    return fit if slow is None else add_slow_errors(fit, slow)


def _place_measured_poses(
    fit: Identification, data: Measurements, linear: FitLinearization
) -> FloatArray:
    """Return the measured poses (n, 4, 4) [m] that the calibrated robot reaches: those of the
    linearization, where readings are exact and it has kept them.
    """
    poses = linear.solution.linearized
    if poses is None or fit.poses is not None:
        return locate_measured_poses(fit, data).T
    return poses.T[0, poses.is_reached[0]]


def _add_patterns(
    fit: Identification, data: Measurements, rows: ResidualRows, *, is_slow: bool
) -> Identification:
    """Return a fit whose covariance allows for the patterns of its residuals. A dependence on a
    reading is a slow error of the poses, and counts once where such errors were found.
    """
    patterns = find_patterns(rows, data, fit.robot)
    effects = [e for e in patterns.effects if not (is_slow and e.effect.source == READING)]
    is_small = any(finding.code == TOO_SMALL for finding in fit.findings)
    if not (effects or patterns.is_correlated or is_small):
        return fit
    tool = state_tool_uncertainty(fit, locate_measured_poses(fit, data))
    for effect in effects:
        root = rows.root @ (rows.gain.T @ effect.effect.columns) @ take_root(effect.moments)
        finding = _report_effect(effect, tool.measure_growth(root))
        fit = add_covariance(fit, root, np.inf, finding)
    if patterns.is_correlated or is_small:
        fit = _add_correlation(fit, patterns, tool)
    return _without_doubt_of_sigma(fit) if effects or patterns.is_correlated else fit


def _add_correlation(
    fit: Identification, patterns: ResidualPatterns, tool: ToolUncertainty
) -> Identification:
    """Return a fit with what correlated errors add to the covariance by independent ones.

    Where residuals are too small and no test shows a correlation, it is added if it matters: the
    parameters may have taken up errors that are too slow for the tests.
    """
    from loopcal.diagnose.residuals.correlated_errors import estimate_correlated_errors

    rows = patterns.rows
    errors = estimate_correlated_errors(rows, fit.residual_test.sigma_degrees)
    independent = np.zeros_like(errors.covariance)
    for part in (part for part in fit.posterior.parts if part.source == NOISE):
        scaled = part.root / fit.tolerance[:, None]
        by_noise = np.linalg.lstsq(rows.root / fit.tolerance[:, None], scaled, rcond=None)[0]
        independent += by_noise @ by_noise.T
    root = rows.root @ take_larger(errors.covariance, independent)
    ratio = tool.measure_growth(root)
    if not patterns.is_correlated and ratio < NOTICEABLE:
        return fit
    finding = report_finding(
        "residuals.correlated" if patterns.is_correlated else "residuals.perhaps-correlated",
        correlation=errors.correlation,
        order=patterns.order,
        ratio=ratio,
        severity=choose_severity(patterns.p_value) if patterns.is_correlated else None,
    )
    return add_covariance(fit, root, errors.degrees, finding)


class ToolUncertainty(NamedTuple):
    """The uncertainty of the measured poses as a fit states it.

    Attributes
    ----------
    effects : orientation and position (3 n, p) by deviations of the parameters [per SI].
    stated : sum of the variances of each [SI].
    """

    effects: tuple[FloatArray, FloatArray]
    stated: tuple[float, float]

    def measure_growth(self, root: FloatArray) -> float:
        """Return the factor by which a covariance of root (p, k) [SI] increases the standard
        uncertainty, the larger one of position and orientation.
        """
        pairs = zip(self.effects, self.stated, strict=True)
        shares = [_sum_squares(E @ root) / stated for E, stated in pairs if stated > 0.0]
        return float(np.sqrt(1.0 + max(shares, default=0.0)))


def state_tool_uncertainty(fit: Identification, measured: Solution) -> ToolUncertainty:
    """Return the uncertainty of some evenly chosen measured poses of a fit, frames fitted."""
    posterior, solution = fit.posterior, measured.take(choose_evenly(len(measured.q), MOST_POSES))
    D = linearize_tool_errors(posterior, solution, FITTED).by_parameters / posterior.unit
    p = D.shape[-1]
    angle, position = D[:, :3].reshape(-1, p), D[:, 3:].reshape(-1, p)
    stated = (_sum_squares(angle @ posterior.root), _sum_squares(position @ posterior.root))
    return ToolUncertainty((angle, position), stated)


def take_root(moments: FloatArray) -> FloatArray:
    """Return a square root (c, c) of a positive semidefinite matrix (c, c)."""
    scale = np.sqrt(np.diag(moments))
    scale = np.where(scale > 0.0, scale, 1.0)
    s, v = np.linalg.eigh(moments / scale[:, None] / scale)
    return np.asarray(scale[:, None] * v * np.sqrt(np.maximum(s, 0.0)))


def take_larger(covariance: FloatArray, stated: FloatArray) -> FloatArray:
    """Return a root (k, c) of what a covariance (k, k) has more than a stated one, in the
    directions, relative to the sum of both, in which it is larger.
    """
    scale = np.sqrt(np.diag(covariance + stated))
    scale = np.where(scale > 0.0, scale, 1.0)
    s, v = np.linalg.eigh((covariance - stated) / scale[:, None] / scale)
    return np.asarray(scale[:, None] * v[:, s > 0.0] * np.sqrt(s[s > 0.0]))


def _sum_squares(values: FloatArray) -> float:
    return float((values**2).sum())


def _report_effect(effect: EffectSizes, ratio: float) -> Finding:
    """Return what the residuals depend on, with the size that exceeds its uncertainty most."""
    most = int(np.argmax(np.abs(effect.sizes) / effect.errors))
    label = effect.effect.labels[most]
    unit = DISPLAY_UNITS[label.dimension]
    shown = {
        "component": label.component,
        "size": Quantity(float(effect.sizes[most]) / unit.factor_to_si, unit.symbol),
        "error": Quantity(float(effect.errors[most]) / unit.factor_to_si, unit.symbol),
        "ratio": ratio,
        "severity": choose_severity(effect.p_value),
    }
    source, name = effect.effect.source, effect.effect.name
    if source == TIME:
        return report_finding("residuals.drift", **shown)
    if source == SESSION:
        return report_finding("residuals.sessions-differ", **shown)
    if source == TEMPERATURE:
        return report_finding("residuals.depend-on-temperature", name=name, **shown)
    if source == READING:
        return report_finding("residuals.depend-on-reading", name=name, **shown)
    return report_finding("residuals.trend", **shown)


def _without_doubt_of_sigma(fit: Identification) -> Identification:
    """Return a fit that does not call sigma alone too large: correlated errors make residuals
    small. Where the dependence is no warning, the small residuals still are.
    """
    warned = any(
        f.code.startswith("residuals.") and f.severity is Severity.WARNING for f in fit.findings
    )
    severity = Severity.INFO if warned else Severity.WARNING
    findings = tuple(
        report_finding("noise.not-independent", ratio=f.data["ratio"], severity=severity)
        if f.code == TOO_SMALL
        else f
        for f in fit.findings
    )
    return replace(fit, findings=findings)
