# SPDX-License-Identifier: Apache-2.0
"""Files of compensation: targets as CSV with units, and the readings or commands for them.

pose,z [mm],phi [deg],theta [deg]      targets: one column for each controlled coordinate
pose,q1 [mm],..,note before x [mm],..  result: readings, or `commanded.z [mm],..` for a closed
controller; `note` columns state the expected errors,
so that the file is the start of a measurement file
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import suggest_names
from loopcal.io.core import csv_table
from loopcal.io.core.outputs import FolderKind
from loopcal.io.data.columns import COMMANDED, NOTE
from loopcal.io.data.measurement_file import load_pose_names, load_poses
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import get_dimension
from loopcal.plain_text import escape_formula
from loopcal.typing import FloatArray
from loopcal.units import format_scaled

if TYPE_CHECKING:
    from loopcal.apply.compensation import Compensation

NAMES = ("rx", "ry", "rz", "x", "y", "z")
DIGITS = 6  # significant digits of an expected error


def load_targets(path: str | Path, robot: Mechanism) -> tuple[FloatArray, tuple[str, ...]]:
    """Read targets: a CSV file with one column, and its unit, for each controlled coordinate.

    Returns
    -------
    targets : (n, c) [m, rad], in the robot's order.
    labels : (n,) cells of the column `pose`; "1", "2", ... without it.

    FileError : a value that does not fit, at its line.
    """
    table = csv_table.read_table(path)
    coordinates, known = load_poses(table, robot), ("pose", *robot.controlled)
    for name in table.names:
        if name not in known and not name.startswith(NOTE):
            sentence = f"column {name!r} is unknown{suggest_names(name, known)}"
            act = f"allowed: {', '.join(known)}. Call it '{NOTE} {name}' to ignore it"
            raise table.header_error(f"{sentence}; {act}")
    return coordinates, load_pose_names(table)[0]


def format_compensation(result: Compensation) -> str:
    """Return the result as CSV text; expected errors that are rounding are 0."""
    robot, columns = result.robot, dict[str, Iterable[str]](pose=result.labels)
    dimensions, values = {a.name: a.dimension for a in robot.actuators}, result.readings
    if result.commands is not None:
        names = result.controller.controlled
        dimensions = {COMMANDED + name: get_dimension(name) for name in names}
        values = result.commands
    for (name, dimension), column in zip(dimensions.items(), values.T.tolist(), strict=True):
        unit, cells = robot.get_unit(dimension), zip(column, result.usable, strict=True)
        columns[f"{name} [{unit.symbol}]"] = [
            csv_table.format_exact(value, unit.factor_to_si) if is_usable else ""
            for value, is_usable in cells
        ]
    errors = {"before": result.before, "remaining": result.remaining}
    if result.uncertainty is not None:
        errors["U"] = result.uncertainty.expanded
    for title, error in errors.items():
        for name, column in zip(NAMES, result.drop_rounding(error).T.tolist(), strict=True):
            unit = robot.get_unit(get_dimension(name))
            cells = [_format_error(value / unit.factor_to_si) for value in column]
            columns[f"{NOTE} {title} {name} [{unit.symbol}]"] = cells
    return csv_table.format_columns(columns | {f"{NOTE} status": map(str, result.findings)})


def _format_error(value: float) -> str:
    """Return a number; nothing where it is unknown, a word where it is unbounded."""
    if math.isinf(value):
        return "unbounded"
    return "" if math.isnan(value) else f"{value:.{DIGITS}g}"


def format_comparison(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return the table of a comparison as CSV: titles of columns, and their cells as text."""
    lines = [titles, *rows]
    return "".join(csv_table.format_row(map(escape_formula, line)) + "\n" for line in lines)


CURVES_FORMAT, POINTS, PICTURE = 1, "curves.csv", "curves.png"
CURVES = FolderKind(
    "folder of curves",
    "curves.json",
    ("robot", "ridge", "truncation", "made_by"),
    (POINTS, PICTURE),
)


def format_draws(
    names: Sequence[str],
    units: Sequence[str],
    factors: FloatArray,
    draws: FloatArray,
    weight: FloatArray | None = None,
) -> str:
    """Return draws (T, p) [SI] as CSV text.

    names, units, factors : (p,) names, symbols of units, and their factors to SI. weight : (T,) of
    the draws, whose sum is 1; None where all weigh the same.
    """
    columns: dict[str, Iterable[str]] = {}
    if weight is not None:
        columns["weight"] = map(repr, weight.tolist())
    for name, unit, factor, column in zip(names, units, factors, draws.T.tolist(), strict=True):
        columns[f"{name} [{unit}]"] = [format_scaled(value, factor) for value in column]
    return csv_table.format_columns(columns)
