# SPDX-License-Identifier: Apache-2.0
"""Whether a machine is given the identified values or keeps its current ones.

Two tests must agree, because other values that are no better only carry the noise of the
measurements into the machine:

1. The gain of the fit over the current values, at the fitted poses, is more than noise explains
   (`check_start_values`, which allows for the number of fitted parameters).
2. The identified values predict the held-out poses better, beyond their noise (`KindErrors.gain`).
   Without held-out poses the first test decides alone, unless the residuals are doubtful and
   leave few degrees of freedom, or the expected error is as large as that of the tolerances.

Where the noise is not known well enough for the first test, the held-out poses decide alone, by a
test that needs no noise (`KindErrors.compute_gain_p_value`) and has the level of the first.
"""

from __future__ import annotations

from collections.abc import Iterable

from loopcal.apply import Validation
from loopcal.apply.validation_findings import FEW_ROWS
from loopcal.diagnose import StartCheck
from loopcal.diagnose.fit_checks.start_values import StartVerdict
from loopcal.estimate.inference.residual_test import SIGNIFICANCE, ResidualTest, coverage_factor
from loopcal.findings import Finding, report_finding
from loopcal.workflow.verdict import Verdict


def recommend_values(
    verdict: Verdict,
    start: StartCheck,
    residual_test: ResidualTest,
    errors: Validation | None,
    findings: Iterable[Finding] = (),
) -> Finding:
    """Return the recommendation to apply the identified values or to keep the current ones.

    Parameters
    ----------
    start : the current values against the fit. residual_test : of the fit, for the scale of the
        noise. errors : at held-out poses; None without any. findings : of the calibration.
    """
    if verdict is Verdict.NOT_CALIBRATED:
        return report_finding("values.keep-not-calibrated")
    if start.verdict in (StartVerdict.BEST, StartVerdict.WITHIN_NOISE):
        return report_finding("values.keep-within-noise")
    is_open = start.verdict is StartVerdict.OPEN
    checked = None if errors is None else errors.without_blunders or errors
    if checked is None or min(checked.judged, checked.values_left) < FEW_ROWS:
        if is_open:
            return report_finding("values.keep-undecided")
        return report_finding(_judge_fitted(residual_test, findings))
    if is_open:
        p_value = checked.kinds[-1].compute_gain_p_value(checked.values_left)
        code = "values.apply-held-out" if p_value < SIGNIFICANCE else "values.keep-undecided"
        return report_finding(code, p_value=p_value, poses=checked.judged)
    gain = checked.kinds[-1].gain / residual_test.sigma_scale
    needed = coverage_factor(residual_test.noise_degrees)
    code = "values.apply" if gain >= needed else "values.keep-not-confirmed"
    return report_finding(code, gain=gain, needed=float(needed), poses=checked.judged)


def _judge_fitted(test: ResidualTest, findings: Iterable[Finding]) -> str:
    """Return the code of the recommendation by fitted poses alone, whose gain is beyond noise."""
    if test.is_doubtful:
        return "values.keep-doubtful-residuals"
    if any(finding.code == "model.no-expected-gain" for finding in findings):
        return "values.keep-no-gain"
    return "values.apply-fitted"
