# SPDX-License-Identifier: Apache-2.0
"""Whether a machine is given the identified values or keeps its current ones.

Two tests must agree, because other values that are no better only carry the noise of the
measurements into the machine:

1. The gain of the fit over the current values, at the fitted poses, is more than noise explains
   (`check_start_values`, which allows for the number of fitted parameters).
2. The identified values predict the held-out poses better, beyond their noise (`KindErrors.gain`).
   Without held-out poses the first test decides alone.
"""

from __future__ import annotations

from loopcal.apply import Validation
from loopcal.apply.validation_findings import FEW_ROWS
from loopcal.diagnose import StartCheck
from loopcal.diagnose.fit_checks.start_values import StartVerdict
from loopcal.estimate.inference.residual_test import ResidualTest, coverage_factor
from loopcal.findings import Finding, report_finding
from loopcal.workflow.verdict import Verdict


def recommend_values(
    verdict: Verdict, start: StartCheck, residual_test: ResidualTest, errors: Validation | None
) -> Finding:
    """Return the recommendation to apply the identified values or to keep the current ones.

    Parameters
    ----------
    start : the current values against the fit. residual_test : of the fit, for the scale of the
        noise. errors : at held-out poses; None without any.
    """
    if verdict is Verdict.NOT_CALIBRATED:
        return report_finding("values.keep-not-calibrated")
    if start.verdict is StartVerdict.OPEN:
        return report_finding("values.keep-undecided")
    if start.verdict is not StartVerdict.NOT_CALIBRATED:
        return report_finding("values.keep-within-noise")
    checked = None if errors is None else errors.without_blunders or errors
    if checked is None or min(checked.judged, checked.values_left) < FEW_ROWS:
        return report_finding("values.apply-fitted")
    gain = checked.kinds[-1].gain / residual_test.sigma_scale
    needed = coverage_factor(residual_test.noise_degrees)
    code = "values.apply" if gain >= needed else "values.keep-not-confirmed"
    return report_finding(code, gain=gain, needed=float(needed), poses=checked.judged)
