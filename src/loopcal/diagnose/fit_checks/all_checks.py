# SPDX-License-Identifier: Apache-2.0
"""Examine a fit in one call: outliers, heavy tails, lack of fit, common errors, correlations,
expected gain.
"""

from __future__ import annotations

from dataclasses import dataclass

from loopcal.diagnose.error_frames import FITTED
from loopcal.diagnose.fit_checks.cluster_covariance import ClusterCheck, check_clusters
from loopcal.diagnose.fit_checks.correlations import CorrelatedGroup, find_correlated_groups
from loopcal.diagnose.fit_checks.expected_errors import CalibrationGain, estimate_calibration_gain
from loopcal.diagnose.fit_checks.outliers import OutlierCheck, find_outliers
from loopcal.diagnose.fit_checks.repeated_poses import LackOfFit, check_lack_of_fit
from loopcal.diagnose.residuals.heavy_tails import HeavyTails, check_heavy_tails
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.result import Identification
from loopcal.findings import Finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.presentation import HtmlResult
from loopcal.typing import Progress, report_no_progress


@dataclass(frozen=True, eq=False)
class FitExamination(HtmlResult):
    """The results of all examinations of a fit by its own data.

    Attributes
    ----------
    outliers : poses that do not fit the others. lack_of_fit : the test against repeated poses.
    clusters : the uncertainty that allows for common errors of a day, session or pose.
    correlated : groups of strongly correlated parameters. gain : expected errors before and after.
    tails : the test of the other residuals for heavy tails.
    """

    outliers: OutlierCheck
    lack_of_fit: LackOfFit
    clusters: ClusterCheck
    correlated: tuple[CorrelatedGroup, ...]
    gain: CalibrationGain
    tails: HeavyTails

    JSON_FIELDS = {  # noqa: RUF012
        "outliers": "outliers",
        "lack_of_fit": "lack_of_fit",
        "clusters": "clusters",
        "correlated": "correlated",
        "worth": "gain",
        "heavy_tails": "tails",
        "findings": "findings",
    }

    def __repr__(self) -> str:
        names = ", ".join(finding.code for finding in self.findings) or "none"
        return f"<FitExamination: findings: {names}>"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, the most important ones first."""
        findings = [*self.outliers.findings, *self.tails.findings]
        if self.gain.is_worthwhile is not None:
            findings.insert(len(findings) if self.gain.is_worthwhile else 0, self.gain.finding)
        if self.lack_of_fit.groups:
            findings += self.lack_of_fit.findings
        findings.append(self.clusters.finding)
        return (*findings, *(group.finding for group in self.correlated))


def examine_fit(
    fit: Identification,
    data: Measurements,
    progress: Progress = report_no_progress,
    frame: str = FITTED,
) -> FitExamination:
    """Examine a fit with the data it was made from.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    progress : receives the rounds of the search for outliers, which takes longest, and that the
        other tests begin.
    frame : in which expected errors are stated, see `choose_error_frame`.
    """
    check_fitted_data(fit, data)
    outliers = find_outliers(fit, data, progress=progress)
    progress(0, 1, "testing for common errors and heavy tails")
    linear = None
    if fit.converged and fit.residual_test.intervals:
        filled = fill_in_reading_sigma(fit.robot, data)
        linear = linearize_fit(fit, exclude_poses(filled, fit.options.excluded_poses))
    return FitExamination(
        outliers,
        check_lack_of_fit(fit, data),
        check_clusters(fit, data, frame, linear),
        find_correlated_groups(fit),
        estimate_calibration_gain(fit, data, frame),
        check_heavy_tails(fit, data, outliers.suspects, linear),
    )
