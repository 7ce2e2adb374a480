# SPDX-License-Identifier: Apache-2.0
"""Columns of a measurement file that enter no equation: the time of a row, and temperatures.

    time                        date and time, 2026-05-04T10:22:31.5 (UTC where no offset is written)
    time [s]                    or seconds, minutes or hours since anything
    temperature [degC]          of the room, or what `temperature.PLACE` names; degC, K or degF

They are kept in seconds (since 1970-01-01 UTC where dates are written) and degrees Celsius.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from loopcal.io.core.numbers import exact

if TYPE_CHECKING:
    import numpy as np

    from loopcal.io.core.csv_table import Table

TIME, TEMPERATURE = "time", "temperature"
TIME_UNITS: Mapping[str, tuple[float, float]] = {
    "s": (1.0, 0.0),
    "ms": (1e-3, 0.0),
    "min": (60.0, 0.0),
    "h": (3600.0, 0.0),
}
TEMPERATURE_UNITS: Mapping[str, tuple[float, float]] = {
    "degC": (1.0, 0.0),
    "K": (1.0, -273.15),
    "degF": (5 / 9, -160 / 9),
}
"""Unit -> factor and offset to seconds, or degrees Celsius."""

ZERO, COARSE = -273.15, 1e-9
"""Absolute zero, and how far below it rounding of another unit may lie [degC]."""


def is_context(name: str) -> bool:
    """Tell whether a column is one of these."""
    return name in {TIME, TEMPERATURE} or (
        name.startswith(f"{TEMPERATURE}.") and len(name) > len(TEMPERATURE) + 1
    )


def context_header(name: str) -> str:
    """Return the header under which a column is written."""
    return f"{name} [{'s' if name == TIME else 'degC'}]"


def read_context(table: Table) -> dict[str, np.ndarray]:
    """Return name -> (rows,) values [s] or [degC], NaN where a cell is empty.

    Raises
    ------
    FileError
        A unit that is none of these, a cell that is no number, or no date, a temperature below
        absolute zero.
    """
    import numpy as np

    found = {}
    for name in filter(is_context, table.names):
        symbol, cells = table.units[name], table.text(name)
        if name == TIME and symbol is None:
            found[name] = np.array([_seconds(table, row, cell) for row, cell in enumerate(cells)])
            continue
        known = TIME_UNITS if name == TIME else TEMPERATURE_UNITS
        if symbol is None or symbol not in known:
            has = "no unit" if symbol is None else f"the unit {symbol!r}"
            raise table.header_error(
                f"column {name!r} has {has}; write one of {', '.join(f'[{s}]' for s in known)}"
            )
        factor, offset = known[symbol]
        numbers = [
            math.nan
            if math.isnan(table.number(name, row, cell, empty=True))
            else exact(cell, factor) + offset
            for row, cell in enumerate(cells)
        ]
        for row, value in enumerate(numbers):
            if name != TIME and value < ZERO - COARSE:
                raise table.row_error(
                    row,
                    f"column {name!r} is {cells[row]} {symbol}, below absolute zero; correct it, "
                    "or leave the cell empty",
                )
        found[name] = np.array(numbers)
    return found


def _seconds(table: Table, row: int, cell: str) -> float:
    """Return seconds since 1970-01-01 UTC of a date and time."""
    if not cell:
        return math.nan
    try:
        found = datetime.fromisoformat(cell)
    except ValueError:
        raise table.row_error(
            row,
            f"column 'time' is {cell!r} where a date and time is needed; write it like "
            "2026-05-04T10:22:31, or give the "
            "column a unit, as 'time [s]'",
        ) from None
    return (found if found.tzinfo is not None else found.replace(tzinfo=UTC)).timestamp()
