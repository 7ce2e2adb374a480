# SPDX-License-Identifier: Apache-2.0
"""Phrases of statements on limits, as those of `loopcal.findings.catalog.phrases`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from loopcal.findings.wording import fill_template

ALMOST_CERTAIN = 0.999
"""Probability beyond which a statement gives a bound only."""


def conformity_probability(data: Mapping[str, Any]) -> str:
    """Return a probability as per cent, and what is close to certain as a bound."""
    probability = float(data["probability"])
    if probability > ALMOST_CERTAIN:
        return f"more than {100.0 * ALMOST_CERTAIN:g} %"
    if probability < 1.0 - ALMOST_CERTAIN:
        return f"less than {100.0 * (1.0 - ALMOST_CERTAIN):.1g} %"
    return f"{100.0 * probability:.3g} %" if probability > 0.99 else f"{100.0 * probability:.2g} %"


def largest_error(data: Mapping[str, Any]) -> str:
    """Return the largest true error with its expanded uncertainty, as the subject of a sentence."""
    estimate, expanded = data["estimate"], data["expanded"]
    value, unit = f"{estimate.value:.3g}", estimate.unit
    uncertainty = f"{expanded.value:.2g}"
    if expanded.value > 0.0:
        places = max(0, 1 - math.floor(math.log10(expanded.value)))
        value, uncertainty = (f"{x.value:.{places}f}" for x in (estimate, expanded))
    template = "Largest {quantity} error of {count}, without the noise of the measurement: "
    return f"{fill_template(template, **data)}{value} {unit} +/- {uncertainty} {unit} (95 %)"
