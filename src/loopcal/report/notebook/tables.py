# SPDX-License-Identifier: Apache-2.0
"""The numbers of a result as a table of a page, as a pandas DataFrame and an xarray Dataset."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from loopcal.optional_packages import import_optional
from loopcal.report.notebook import fit_records, machine_records, pose_records, result_records
from loopcal.report.notebook.records import Records, Variable, collect_records
from loopcal.report.numbers import format_number
from loopcal.report.tables import Column, Table

REGISTERED = (fit_records, machine_records, pose_records, result_records)
"""Modules whose functions say which numbers a result has; importing them registers these."""

EXTRA = "tables"
"""Extra of loopcal that installs pandas and xarray."""

MOST_COLUMNS = 16
"""Columns of a table on a page."""


def build_frame(result: object) -> Any:
    """Return the main table of a result as a pandas DataFrame."""
    pandas = import_optional("pandas", EXTRA)
    return pandas.DataFrame(collect_records(result).list_columns())


def build_dataset(result: object) -> Any:
    """Return the arrays of a result as an xarray Dataset."""
    xarray = import_optional("xarray", EXTRA)
    records = collect_records(result)
    used = {name for variable in records.variables for name in variable.dimensions}
    labels = {name: list(values) for name, values in records.labels.items() if name in used}
    arrays, units = {}, {}
    for variable in records.variables:
        arrays[variable.name] = _build_array(variable)
        if not isinstance(variable.unit, str):
            axis = variable.dimensions[-1]
            units[f"{axis}_unit"] = (axis, list(variable.unit))
    return xarray.Dataset(arrays, coords={**labels, **units})


def _build_array(variable: Variable) -> tuple[tuple[str, ...], np.ndarray, dict[str, str]]:
    """Return dimensions, values and attributes of a variable."""
    unit = variable.unit
    if not isinstance(unit, str):
        unit = f"see {variable.dimensions[-1]}_unit"
    return variable.dimensions, np.asarray(variable.values), {"units": unit} if unit else {}


def build_main_table(records: Records, caption: str = "") -> Table:
    """Return the main table for a page; of many columns the first."""
    columns = list(records.list_columns().items())[:MOST_COLUMNS]
    has_numbers = [values.dtype.kind in "iuf" for _, values in columns]
    formatted = [[_format(value) for value in values.tolist()] for _, values in columns]
    return Table(
        caption,
        tuple(
            Column(heading, align="right" if is_number else "left")
            for (heading, _), is_number in zip(columns, has_numbers, strict=True)
        ),
        tuple(zip(*formatted, strict=True)),
    )


def _format(value: Any) -> str:
    """Return a cell."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "unknown" if math.isinf(value) else format_number(value)
    return str(value)
