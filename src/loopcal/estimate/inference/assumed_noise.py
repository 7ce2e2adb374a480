# SPDX-License-Identifier: Apache-2.0
"""Noise that nobody stated: a program that wrote the measurements assumed it.

A test against an assumed sigma says nothing about the fit, so it decides no quality gate. Where all
rows have assumed noise and enough degrees of freedom are left, the noise is estimated from the
residuals: one factor on all assumed sigmas. Otherwise the assumed sigmas are used and reported with
what the residuals suggest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from loopcal.estimate.inference.residual_test import FEWEST_DEGREES, ResidualTest
from loopcal.estimate.options import FitOptions
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements
from loopcal.measure.kinds.error_groups import list_error_groups
from loopcal.mechanism import Mechanism

ASSUMED = "assumed"


def choose_noise(options: FitOptions, data: Measurements, left: int) -> FitOptions:
    """Return options that estimate the noise where all of it is assumed.

    Parameters
    ----------
    options : of the fit. left : equations less all unknowns of the fit.
    """
    is_free = options.noise == "given" and options.prior is None
    if is_free and data.noise_source == ASSUMED and left >= FEWEST_DEGREES:
        return replace(options, noise="estimated")
    return options


def name_noise(options: FitOptions, data: Measurements) -> str:
    """Return how the noise of a fit is known: "given", "estimated" or "assumed"."""
    is_assumed = options.noise == "given" and data.noise_source != "stated"
    return ASSUMED if is_assumed else options.noise


def report_noise(data: Measurements, robot: Mechanism, test: ResidualTest) -> Finding:
    """Return the residuals against the noise, with assumed and estimated sigmas where some are."""
    if data.noise_source == "stated" or not test.converged or test.weighted:
        return test.finding
    if test.noise == "estimated":
        if not test.intervals:
            return test.finding
        sigmas = _list_sigmas(data, robot, test.sigma_scale)
        return report_finding("noise.assumed-replaced", sigmas=sigmas, dof=test.dof)
    if test.degrees < 0.5 or np.isnan(test.p_value):
        return report_finding("noise.assumed-untested", sigmas=_list_sigmas(data, robot, 1.0))
    ratio = float(np.sqrt(test.chi_square / test.degrees))
    return report_finding(
        "noise.assumed",
        sigmas=_list_sigmas(data, robot, ratio),
        ratio=ratio,
        degrees=test.degrees,
        p_value=test.p_value,
    )


def _list_sigmas(data: Measurements, robot: Mechanism, scale: float) -> list[dict[str, Any]]:
    """Return kind, quantity, assumed and estimated sigma of each quantity with assumed noise."""
    sigmas: dict[tuple[str, str], dict[str, Any]] = {}
    for rows in (o for o in data.observations if o.is_noise_assumed and len(o)):
        variance = np.diagonal(rows.covariance, axis1=1, axis2=2)
        for group in list_error_groups(rows.kind):
            sigma = float(np.sqrt(np.median(variance[:, list(group.columns)])))
            values = (robot.to_quantity(value, group.dimension) for value in (sigma, scale * sigma))
            assumed, estimated = values
            sigmas[rows.kind.name, group.quantity] = {
                "kind": rows.kind.name,
                "quantity": group.quantity,
                "assumed": assumed,
                "estimated": estimated,
            }
    return list(sigmas.values())
