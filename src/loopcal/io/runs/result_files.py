# SPDX-License-Identifier: Apache-2.0
"""Files of compensation: targets as CSV with units, and the readings or commands for them.

pose,z [mm],phi [deg],theta [deg]      targets: one column for each controlled coordinate
pose,q1 [mm],..,note before x [mm],..  result: readings, or `commanded.z [mm],..` for a closed
controller; `note` columns state the expected errors,
so that the file is the start of a measurement file
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import suggest_names
from loopcal.io.core.csv_table import (
    format_exact,
    format_header,
    format_row,
    format_scaled,
    read_table,
    require_columns,
)
from loopcal.io.core.outputs import FolderKind, write_result_folder
from loopcal.io.core.text_file import write_text
from loopcal.io.data.columns import COMMANDED, NOTE, get_dimension
from loopcal.mechanism.model import Mechanism
from loopcal.plain_text import escape_formula
from loopcal.typing import FloatArray
from loopcal.units import Dimension, Unit

if TYPE_CHECKING:
    from loopcal.apply.compensation import Compensation

NAMES = ("rx", "ry", "rz", "x", "y", "z")
STATUS = f"{NOTE} status"
DIGITS = 6
"""Significant digits of an expected error."""


def load_targets(path: str | Path, robot: Mechanism) -> tuple[FloatArray, tuple[str, ...]]:
    """Read targets: a CSV file with one column, and its unit, for each controlled coordinate.

    Returns
    -------
    targets : (n, c) [m, rad], in the robot's order.
    labels : (n,) cells of the column `pose`; "1", "2", ... without it.

    Raises
    ------
    FileError : a value that does not fit, at its line.
    """
    table = read_table(path)
    known = ("pose", *robot.controlled)
    require_columns(table, robot.controlled, f"a commanded coordinate of {robot.name}")
    for name in table.names:
        if name not in known and not name.startswith(NOTE):
            sentence = f"column {name!r} is unknown{suggest_names(name, known)}"
            act = f"allowed: {', '.join(known)}; call it '{NOTE} {name}' to ignore it"
            raise table.header_error(f"{sentence}; {act}")
    columns = [table.numbers(name, get_dimension(name), empty=False) for name in robot.controlled]
    labels = table.pose_names()
    used: set[str] = set()
    for i, label in enumerate(labels):
        if not label or label in used:
            problem = f"duplicate target {label!r}" if label else "this target has no name"
            raise table.row_error(i, f"{problem}; give each target a name of its own")
        used.add(label)
    return np.column_stack(columns), labels


def _list_columns(result: Compensation) -> tuple[list[tuple[str, Unit]], FloatArray]:
    """Return name and unit of the columns to set, and their values (n, columns) [SI]."""
    robot = result.robot
    if result.commands is None:
        return [(a.name, robot.get_unit(a.dimension)) for a in robot.actuators], result.readings
    names = result.controller.controlled
    columns = [(COMMANDED + name, robot.get_unit(get_dimension(name))) for name in names]
    return columns, result.commands


def _list_errors(result: Compensation) -> list[tuple[str, Unit, FloatArray]]:
    """Return column, unit and values (n,) [SI] of the expected errors; those that are rounding are
    0.
    """
    errors = {"before": result.before, "remaining": result.remaining}
    if result.uncertainty is not None:
        errors["U"] = result.uncertainty.expanded
    dimensions = [Dimension.LENGTH if name in "xyz" else Dimension.ANGLE for name in NAMES]
    errors = {title: result.drop_rounding(values) for title, values in errors.items()}
    return [
        (f"{NOTE} {title} {name}", result.robot.get_unit(dimension), values[:, k])
        for title, values in errors.items()
        for k, (name, dimension) in enumerate(zip(NAMES, dimensions, strict=True))
    ]


def format_compensation(result: Compensation) -> str:
    """Return the result as CSV text, units in the header."""
    columns, values = _list_columns(result)
    errors = _list_errors(result)
    units = {name: unit.symbol for name, unit in columns}
    units |= {name: unit.symbol for name, unit, _ in errors}
    lines = [format_row(["pose", *format_header(units), STATUS])]
    usable = result.usable
    for i, label in enumerate(result.labels):
        cells = [
            format_exact(float(v), unit.factor_to_si) if usable[i] else ""
            for v, (_, unit) in zip(values[i], columns, strict=True)
        ]
        cells += [_format_error(v[i] / unit.factor_to_si) for _, unit, v in errors]
        lines.append(format_row([label, *cells, str(result.findings[i])]))
    return "\n".join(lines) + "\n"


def _format_error(value: float) -> str:
    """Return a number; nothing where it is unknown, a word where it is unbounded."""
    if math.isinf(value):
        return "unbounded"
    return "" if math.isnan(value) else f"{value:.{DIGITS}g}"


# The CSV file of a comparison of runs: one row for each run and parameter.


def save_comparison(path: Path, titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write the table of a comparison: titles of columns, and their cells as text."""
    lines = [titles, *rows]
    write_text(path, "".join(format_row(map(escape_formula, line)) + "\n" for line in lines))


# The folder of regularization curves.

FORMAT = 1
RESULT, POINTS, PICTURE = "curves.json", "curves.csv", "curves.png"
CURVES = FolderKind(
    "folder of curves", RESULT, ("robot", "ridge", "truncation", "made_by"), (POINTS, PICTURE)
)


def write_curves(
    path: Path, document: Mapping[str, Any], points: str, picture: bytes, force: bool = False
) -> None:
    """Write the folder whole or not at all, see `write_result_folder`; `format` and `files` are
    added to the document.
    """
    files = {POINTS: points.encode(), PICTURE: picture}
    write_result_folder(path, CURVES, {"format": FORMAT, **document}, files, force)


# Draws of parameters as a CSV file: one row for each draw, units in the header.

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
    header = format_header(dict(zip(names, units, strict=True)))
    lines = [format_row([*([] if weight is None else [WEIGHT]), *header])]
    for i, row in enumerate(draws):
        own = [] if weight is None else [repr(float(weight[i]))]
        numbers = (format_scaled(float(v), f) for v, f in zip(row, factors, strict=True))
        lines.append(format_row([*own, *numbers]))
    return "\n".join(lines) + "\n"
