# SPDX-License-Identifier: Apache-2.0
"""The result of a convention check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from loopcal.findings import Finding, Severity
from loopcal.findings.wording import round_to_digits
from loopcal.presentation import HtmlResult

if TYPE_CHECKING:
    from loopcal.diagnose.conventions.interpretations.interpretation import Interpretation

IMPLAUSIBLE = 10.0
"""Misfit above which conventions are in doubt. Tolerances exceeded three times, and a noise stated
three times too small, give about 3 each.
"""


@dataclass(frozen=True, eq=False)
class ConventionCheck(HtmlResult):
    """The stated conventions of measurements against the robot, and the best other interpretation.

    Attributes
    ----------
    misfit : root mean square of the residuals over what tolerances and noise allow [1]; NaN with
        too few rows.
    interpretation : another one that fits far better; None without one.
    other_misfit : its misfit, or that without stated setup parameters which the data contradict;
        NaN without either.
    alternatives : other interpretations that fit as well.
    finding : the result; None where the data agree with the stated conventions.
    """

    misfit: float
    interpretation: Interpretation | None = None
    other_misfit: float = float("nan")
    alternatives: tuple[Interpretation, ...] = ()
    finding: Finding | None = None

    @property
    def is_doubtful(self) -> bool:
        """Whether tolerances and noise do not explain the data as they are stated."""
        return self.misfit > IMPLAUSIBLE

    @property
    def is_refused(self) -> bool:
        """Whether there is clear evidence that the stated conventions are wrong."""
        return self.finding is not None and self.finding.severity is Severity.REFUSAL

    def __repr__(self) -> str:
        code = "agrees" if self.finding is None else self.finding.code
        return f"<ConventionCheck: {code}, misfit {round_to_digits(self.misfit)}>"

    def __str__(self) -> str:
        return repr(self) if self.finding is None else str(self.finding)

    def to_dict(self) -> dict[str, Any]:
        """Return misfits and findings for JSON."""
        other = self.interpretation
        return {
            "misfit": self.misfit,
            "interpretation": None if other is None else other.finding,
            "other_misfit": self.other_misfit,
            "alternatives": [interpretation.finding for interpretation in self.alternatives],
            "refused": self.is_refused,
            "finding": self.finding,
        }
