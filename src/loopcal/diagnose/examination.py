# SPDX-License-Identifier: Apache-2.0
"""How far a fit can be trusted, in one call: wrong rows, lack of fit, what is known only together,
whether it was worth it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from loopcal.diagnose.component_worth import CalibrationGain, estimate_calibration_gain
from loopcal.diagnose.correlation import CorrelatedGroup, find_correlated_groups
from loopcal.diagnose.outliers import OutlierCheck, find_outliers
from loopcal.diagnose.repeats import LackOfFit, check_lack_of_fit
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements

SHOWN = 3
"""Correlated groups and outliers written out; the others are counted."""


@dataclass(frozen=True, eq=False)
class FitExamination:
    """What a fit's own data say about it."""

    outliers: OutlierCheck
    lack_of_fit: LackOfFit
    correlated: tuple[CorrelatedGroup, ...]
    worth: CalibrationGain

    @property
    def sentences(self) -> tuple[str, ...]:
        """All of it in words, most important first."""
        found = [
            self.outliers.sentence,
            *_some([str(o) for o in (*self.outliers.outliers, *self.outliers.undecided)]),
        ]
        if self.worth.calibrate is not None:
            found.insert(0 if not self.worth.calibrate else len(found), self.worth.sentence)
        if self.lack_of_fit.groups:
            found.append(self.lack_of_fit.sentence)
        return (*found, *_some([str(group) for group in self.correlated]))

    def to_dict(self) -> dict[str, Any]:
        """Return the parts by name for JSON."""
        return {
            "outliers": self.outliers.to_dict(),
            "lack_of_fit": self.lack_of_fit.to_dict(),
            "correlated": [{**vars(group), "sentence": str(group)} for group in self.correlated],
            "worth": self.worth.to_dict(),
            "sentences": list(self.sentences),
        }


def examine_fit(fit: Identification, data: Measurements) -> FitExamination:
    """Examine a fit.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    """
    return FitExamination(
        find_outliers(fit, data),
        check_lack_of_fit(fit, data),
        find_correlated_groups(fit),
        estimate_calibration_gain(fit, data),
    )


def _some(sentences: list[str]) -> list[str]:
    """The first few, and how many there are more."""
    if len(sentences) <= SHOWN:
        return sentences
    return [*sentences[:SHOWN], f"and {len(sentences) - SHOWN} more of this sort"]
