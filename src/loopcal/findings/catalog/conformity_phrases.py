# SPDX-License-Identifier: Apache-2.0
"""Phrases of statements on limits, as those of `loopcal.findings.catalog.phrases`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from loopcal.findings.wording import fill_template

ALMOST_CERTAIN = 0.999
"""Probability beyond which a statement gives a bound only."""

LARGEST_SKEW = 0.1
"""Distance of the center of an interval from the estimate, as a share of half its width, up to
which +/- describes it."""


def conformity_probability(data: Mapping[str, Any]) -> str:
    """Return a probability as per cent, and what is close to certain as a bound."""
    probability = float(data["probability"])
    if probability > ALMOST_CERTAIN:
        return f"more than {100.0 * ALMOST_CERTAIN:g} %"
    if probability < 1.0 - ALMOST_CERTAIN:
        return f"less than {100.0 * (1.0 - ALMOST_CERTAIN):.1g} %"
    return f"{100.0 * probability:.3g} %" if probability > 0.99 else f"{100.0 * probability:.2g} %"


def largest_error(data: Mapping[str, Any]) -> str:
    """Return the largest true error with its expanded uncertainty, as the subject of a sentence.

    An interval that is not centered on the estimate is stated by its bounds: an error has no values
    below zero, and estimate plus half the interval would be below its upper bound.
    """
    estimate, expanded = data["estimate"], data["expanded"]
    value, unit = f"{estimate.value:.3g}", estimate.unit
    uncertainty, places = f"{expanded.value:.2g}", 0
    if expanded.value > 0.0:
        places = max(0, 1 - math.floor(math.log10(expanded.value)))
        value, uncertainty = (f"{x.value:.{places}f}" for x in (estimate, expanded))
    template = "Largest {quantity} error of {count}, without the noise of the measurement: "
    subject = f"{fill_template(template, **data)}{value} {unit}"
    low, high = data["low"].value, data["high"].value
    if abs(high + low - 2.0 * estimate.value) <= LARGEST_SKEW * (high - low):
        return f"{subject} +/- {uncertainty} {unit} (95 %)"
    return f"{subject} (95 % interval {low:.{places}f} {unit} to {high:.{places}f} {unit})"
