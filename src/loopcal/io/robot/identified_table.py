# SPDX-License-Identifier: Apache-2.0
"""The `identified:` table of a corrected robot file: values of parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from loopcal.errors import UnitError, suggest_names
from loopcal.io.core.numbers import format_scaled
from loopcal.io.core.yaml_file import Location, YamlFile, refuse_unknown_keys
from loopcal.io.core.yaml_text import add_key, quote_scalar
from loopcal.mechanism import Mechanism, find_impossible_values
from loopcal.typing import FloatArray
from loopcal.units import find_unit, to_si

TABLE = "identified"
PLUS_MINUS = "+/-"
KEYS = ("name", "value", PLUS_MINUS, "unit")
NOT_CALIBRATED = "# NOT CALIBRATED"
"""Beginning of a robot file that a failed calibration made."""
EXAMPLE = "'{name: .., value: .., unit: ..}'"


def format_table(robot: Mechanism, plus_minus: FloatArray | None = None) -> str:
    """Return the table as YAML: free parameters, and others that differ from their nominal value.

    Parameters
    ----------
    robot : its values and the units of its file.
    plus_minus : (p,) uncertainty of each value [SI]; what is not finite is written as null.

    Returns
    -------
    Lines with a final break; nothing where all values are nominal and no uncertainty is given.
    """
    return _format_rows(_list_rows(robot, plus_minus))


def _list_rows(robot: Mechanism, plus_minus: FloatArray | None) -> list[dict[str, str]]:
    """Return the rows of the table with the keys KEYS; numbers as their texts."""
    if plus_minus is None and (robot.values == robot.parameters.nominal).all():
        return []
    rows = []
    for i, parameter in enumerate(robot.parameters.entries):
        if parameter.free or robot.values[i] != parameter.nominal:
            shown = find_unit(robot.units[parameter.dimension])
            value = format_scaled(float(robot.values[i]), shown.factor_to_si)
            half = math.nan if plus_minus is None else float(plus_minus[i]) / shown.factor_to_si
            text = f"{half:.2g}" if math.isfinite(half) else "null"
            cells = (parameter.name, value, text, shown.symbol)
            rows.append(dict(zip(KEYS, cells, strict=True)))
    return rows


def _format_rows(rows: Sequence[Mapping[str, str]]) -> str:
    """Return rows as YAML; nothing without rows."""
    lines = [f"{TABLE}:  # delete this table to restore the nominal robot\n"] if rows else []
    for row in rows:
        name, unit = quote_scalar(row["name"]), quote_scalar(row["unit"])
        numbers = f"value: {row['value']}, {PLUS_MINUS}: {row[PLUS_MINUS]}"
        lines.append(f"  - {{name: {name}, {numbers}, unit: {unit}}}\n")
    return "".join(lines)


def _read_number(text: str) -> float | None:
    """Return what YAML reads from the text of a number, or from `null`."""
    if text == "null":
        return None
    return int(text) if text.lstrip("-").isdigit() else float(text)


def add_table(file: YamlFile, robot: Mechanism, plus_minus: FloatArray | None = None) -> YamlFile:
    """Return a robot file without a table with that of `format_table`."""
    rows = _list_rows(robot, plus_minus)
    if not rows:
        return file
    numbers = ("value", PLUS_MINUS)
    content: list[dict[str, Any]] = [
        {key: _read_number(text) if key in numbers else text for key, text in row.items()}
        for row in rows
    ]
    return add_key(file, _format_rows(rows), {TABLE: content})


def remove_mark(text: str) -> str:
    """Return the text of a robot file without the lines that say that its calibration failed."""
    while text.startswith(NOT_CALIBRATED):
        text = text.partition("\n")[2]
    return text


def read_identified_values(file: YamlFile, robot: Mechanism) -> FloatArray:
    """Return the robot's values (p,) [SI], with those of the file's table in place.

    Raises
    ------
    FileError
        A bad row, an unknown or duplicate parameter, a value that is not a number, a wrong unit.
    """
    values = robot.values.copy()
    for name, value in read_rows(file, robot).items():
        values[robot.parameters.index(name)] = value
    return values


def read_possible_values(file: YamlFile, robot: Mechanism) -> FloatArray:
    """Return the values as `read_identified_values`; refuse those that no machine has.

    A file of a calibration that failed keeps such values, to be looked at.
    """
    values = read_identified_values(file, robot)
    if file.text.startswith(NOT_CALIBRATED):
        return values
    for name, finding in find_impossible_values(robot, values)[:1]:
        rows = [row.get("name") for row in file.content[TABLE]]
        place: Location = (TABLE, rows.index(name)) if name in rows else (TABLE,)
        advice = "correct the value, or delete this table to restore the nominal robot"
        raise file.error(f"{finding}; {advice}", place)
    return values


def read_rows(file: YamlFile, robot: Mechanism) -> dict[str, float]:
    """Return the values [SI] of the file's table by name; raise as `read_identified_values`."""
    rows = file.content[TABLE]
    if not isinstance(rows, list):
        raise file.error(f"{TABLE!r} must be a list of {EXAMPLE}", (TABLE,))
    values: dict[str, float] = {}
    for i, row in enumerate(rows):
        place: Location = (TABLE, i)
        if not isinstance(row, dict):
            raise file.error(f"this row is not a mapping; write {EXAMPLE}", place)
        refuse_unknown_keys(file, list(row), KEYS, place)
        for key in (k for k in KEYS if k != PLUS_MINUS and k not in row):
            raise file.error(f"this row has no {key!r}; write {EXAMPLE}", place)
        name, value, symbol = row["name"], row["value"], row["unit"]
        if name not in robot.parameters.names:
            hint = suggest_names(str(name), robot.parameters.names)
            sentence = f"{name!r} is not a parameter of this robot{hint}; correct the name"
            raise file.error(sentence, place)
        if name in values:
            raise file.error(f"duplicate parameter {name!r}; remove one", place)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise file.error(f"the value of {name!r} is {value!r}; write a number", place)
        dimension = robot.parameters.dimensions[robot.parameters.index(name)]
        try:
            values[name] = to_si(value, find_unit(str(symbol), dimension))
        except UnitError as error:
            raise file.error(f"{name!r}: {error}", place) from None
    return values
