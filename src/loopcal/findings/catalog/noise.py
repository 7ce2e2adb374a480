# SPDX-License-Identifier: Apache-2.0
"""The noise: the residuals of a fit against the stated or estimated noise."""

from __future__ import annotations

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry

ENTRIES = (
    Entry(
        "noise.consistent",
        Severity.INFO,
        "The residuals agree with the stated noise ({ratio} times as large).",
        when="The chi-square test accepts the residuals.",
        example={"ratio": 0.98, "degrees": 198.0, "p_value": 0.6},
    ),
    Entry(
        "noise.residuals-too-large",
        Severity.WARNING,
        "The residuals exceed the stated noise by a factor of {ratio}: some rows are wrong, the "
        "model is incomplete, or sigma is too small. All intervals are wider by this factor; they "
        "hold only if no row is wrong.",
        when="The chi-square test rejects the residuals (p < 0.001).",
        action="Look for outliers first, then for effects that the model does not have; state a "
        "larger sigma only if the instrument is worse than stated.",
        example={"ratio": 3.2, "degrees": 198.0, "p_value": 1e-9},
    ),
    Entry(
        "noise.residuals-too-small",
        Severity.INFO,
        "The residuals are {ratio} times the stated noise: sigma is probably too large.",
        when="The residuals are smaller than the stated noise explains (p > 0.999).",
        action="State a smaller sigma, or let the noise be estimated.",
        example={"ratio": 0.29, "degrees": 198.0, "p_value": 0.9999},
    ),
    Entry(
        "noise.no-degrees-of-freedom",
        Severity.WARNING,
        "No degree of freedom is left to test the residuals against the noise. Measure more poses.",
        when="The noise is given, and there are as many equations as parameters.",
        action="Measure more poses.",
    ),
    Entry(
        "noise.estimated",
        Severity.INFO,
        "The noise was estimated from the residuals: {scale} times the stated sigma, with {dof} "
        "degrees of freedom.",
        when="The options ask to estimate the noise.",
    ),
    Entry(
        "noise.too-few-degrees",
        Severity.WARNING,
        "No intervals are given: only {dof} of the {fewest} degrees of freedom that an estimate of "
        "the noise needs are left. Measure more poses or state the sigma of the instrument.",
        when="The noise is to be estimated from too few degrees of freedom.",
        action="Measure more poses, or state the sigma of the instrument and take it as given.",
    ),
    Entry(
        "noise.not-estimated",
        Severity.WARNING,
        "No intervals are given: no degree of freedom is left to estimate the noise. Measure more "
        "poses or state the sigma of the instrument.",
        when="The noise is to be estimated, and there are as many equations as parameters.",
        action="Measure more poses, or state the sigma of the instrument and take it as given.",
    ),
    Entry(
        "noise.weighted",
        Severity.INFO,
        "The noise is not tested, because the loss chooses the weights by the residuals.",
        when="A fit with a loss and given noise.",
    ),
    Entry(
        "noise.not-tested",
        Severity.INFO,
        "The noise is not tested and no intervals are given, because the iteration did not "
        "converge.",
        when="The fit did not converge.",
        action="See why it did not converge.",
    ),
)
