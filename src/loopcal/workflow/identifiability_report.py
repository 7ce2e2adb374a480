# SPDX-License-Identifier: Apache-2.0
"""Analyze what measurements determine, and which further measurements determine the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from loopcal.diagnose import (
    Identifiability,
    IdentifiableSubset,
    MeasurementSuggestion,
    choose_identifiable_subset,
    identifiability,
    suggest_measurements,
)
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.serialization import json_fields


@dataclass(frozen=True, eq=False)
class IdentifiabilityReport:
    """What measurements determine.

    Attributes
    ----------
    analysis : rank, singular values and a statement on each parameter.
    suggestions : further measurements for open combinations.
    subset : a smallest set of parameters; None where it was not asked for.
    """

    analysis: Identifiability
    suggestions: tuple[MeasurementSuggestion, ...]
    subset: IdentifiableSubset | None

    def to_dict(self) -> dict[str, Any]:
        """Return the report by name for JSON."""
        document = {**json_fields(self.analysis), "remedies": self.suggestions}
        return document if self.subset is None else {**document, "reduction": self.subset}


def analyze_identifiability(
    robot: Mechanism, data: Measurements, choose_subset: bool = False
) -> IdentifiabilityReport:
    """Return what measurements determine of a robot's free parameters.

    Parameters
    ----------
    data : measurements, or simulated ones without noise for an instrument that is considered.
    choose_subset : also choose a smallest set of parameters that says the same.
    """
    analysis = identifiability(robot, data)
    subset = choose_identifiable_subset(analysis) if choose_subset else None
    return IdentifiabilityReport(analysis, suggest_measurements(analysis), subset)
