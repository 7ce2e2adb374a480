# SPDX-License-Identifier: Apache-2.0
"""Pages of results that are more than a text and the main table: those of the command line."""

from __future__ import annotations

from loopcal.apply.calibration_report import CalibrationReport
from loopcal.apply.compensation import Compensation
from loopcal.apply.height_errors import HeightErrors
from loopcal.apply.repeatability import Repeatability
from loopcal.apply.run_comparison import RunComparison
from loopcal.apply.validation import Validation
from loopcal.diagnose.bootstrap import Bootstrap
from loopcal.diagnose.cross_validation import RegularizationCurves
from loopcal.diagnose.posterior_sample import PosteriorSample
from loopcal.estimate.result import Identification
from loopcal.report.calibration_view import (
    view_calibration,
    view_compensation,
    view_fit,
    view_heights,
)
from loopcal.report.validation_view import (
    view_bootstrap,
    view_comparison,
    view_posterior,
    view_regularization,
    view_repeatability,
    view_validation,
)
from loopcal.results.presenters import register
from loopcal.results.tables import Block

register("page", CalibrationReport)(view_calibration)
register("page", RegularizationCurves)(view_regularization)
register("page", Repeatability)(view_repeatability)
register("page", Validation)(view_validation)
register("page", HeightErrors)(view_heights)
register("page", Bootstrap)(view_bootstrap)
register("page", PosteriorSample)(view_posterior)
register("page", RunComparison)(view_comparison)


@register("page", Identification)
def write_fit(fit: Identification) -> list[Block]:
    """Return the page of a fit, and its findings."""
    return [*view_fit(fit), *(f"{f.severity.value}: {f}" for f in fit.findings)]


@register("page", Compensation)
def write_compensation(result: Compensation) -> list[Block]:
    """Return the targets, and the findings of those that are not reached."""
    return [str(result), *view_compensation(result)]
