# SPDX-License-Identifier: Apache-2.0
"""Draws of parameters as a CSV file: one row for each draw, units in the header."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from loopcal.io.core.numbers import format_scaled
from loopcal.typing import FloatArray

WEIGHT = "weight"
"""Column of the weights of draws, whose sum is 1; absent where all draws weigh the same."""


def format_draws(
    names: Sequence[str],
    units: Sequence[str],
    factors: FloatArray,
    draws: FloatArray,
    weight: FloatArray | None = None,
) -> str:
    """Return draws (T, p) [SI] as CSV text.

    Parameters
    ----------
    names, units, factors : (p,) names, symbols of units, and their factors to SI.
    weight : (T,), optional.
    """
    text = io.StringIO()
    write = csv.writer(text, lineterminator="\n").writerow
    header = [f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
    write([*([] if weight is None else [WEIGHT]), *header])
    for i, row in enumerate(draws):
        own = [] if weight is None else [repr(float(weight[i]))]
        write([*own, *(format_scaled(float(v), f) for v, f in zip(row, factors, strict=True))])
    return text.getvalue()
