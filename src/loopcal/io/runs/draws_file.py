# SPDX-License-Identifier: Apache-2.0
"""Draws of parameters as a CSV file: one row for each draw, units in the header."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from loopcal.io.core.csv_table import format_header, format_row
from loopcal.io.core.numbers import format_scaled
from loopcal.io.core.text_file import write_text
from loopcal.typing import FloatArray

WEIGHT = "weight"
"""Column of the weights of draws, whose sum is 1; absent where all draws weigh the same."""


def save_draws(
    path: str | Path,
    names: Sequence[str],
    units: Sequence[str],
    factors: FloatArray,
    draws: FloatArray,
    weight: FloatArray | None = None,
) -> None:
    """Write draws as CSV; arguments as of `format_draws`.

    Raises
    ------
    FileError : the file cannot be written.
    """
    write_text(path, format_draws(names, units, factors, draws, weight))


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
    header = format_header(dict(zip(names, units, strict=True)))
    lines = [format_row([*([] if weight is None else [WEIGHT]), *header])]
    for i, row in enumerate(draws):
        own = [] if weight is None else [repr(float(weight[i]))]
        numbers = (format_scaled(float(v), f) for v, f in zip(row, factors, strict=True))
        lines.append(format_row([*own, *numbers]))
    return "\n".join(lines) + "\n"
