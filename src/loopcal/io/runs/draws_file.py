# SPDX-License-Identifier: Apache-2.0
"""Draws of parameters as a CSV file: one row for each draw, units in the header."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from loopcal.io.core.csv_table import format_header, format_row, read_table
from loopcal.io.core.numbers import format_scaled
from loopcal.io.core.read_back import require_same, require_same_numbers
from loopcal.io.core.text_file import write_text
from loopcal.typing import FloatArray

ROUNDING = float(np.finfo(float).eps)
"""Relative difference of a draw: one number times the factor of its unit."""

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

    def check(written: Path) -> None:
        table = read_table(written)
        of_weight = [] if weight is None else [WEIGHT]
        require_same("columns", (*of_weight, *names), table.names)
        numbers = np.array(list(table.columns.values()), dtype=float).T
        require_same_numbers("draws", draws, numbers[:, len(of_weight) :] * factors, ROUNDING)
        if weight is not None:
            require_same_numbers("weights", weight, numbers[:, 0])

    write_text(path, format_draws(names, units, factors, draws, weight), check)


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
