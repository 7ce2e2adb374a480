# SPDX-License-Identifier: Apache-2.0
"""The `identified:` table of a corrected robot file: name, value, uncertainty and unit of each
identified parameter.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

from loopcal.errors import UnitError, suggest_names
from loopcal.io.core.numbers import shortest
from loopcal.io.core.yaml_file import YamlFile, refuse_unknown_keys
from loopcal.units import find_unit

if TYPE_CHECKING:
    import numpy as np

    from loopcal.mechanism import Mechanism

TABLE = "identified"
PLUS_MINUS = "+/-"
KEYS = ("name", "value", PLUS_MINUS, "unit")
_ROW = "'{name: .., value: .., unit: ..}'"


def table_text(robot: Mechanism, plus_minus: np.ndarray | None = None) -> str:
    """Return the table as YAML text: every free parameter, and every other that is off its nominal
    value.

    Parameters
    ----------
    robot : Mechanism
        Its values and its file's units.
    plus_minus : ndarray, optional
        (p,) uncertainty of each value [SI]; what is not finite is written as null.

    Returns
    -------
    str
        Lines with a final break; nothing where there is nothing to tell: all values nominal, no
        uncertainty given.
    """
    if plus_minus is None and (robot.values == robot.parameters.nominal).all():
        return ""
    rows = [f"{TABLE}:  # delete this table and the nominal robot is back\n"]
    for i, parameter in enumerate(robot.parameters.entries):
        if parameter.free or robot.values[i] != parameter.nominal:
            deviation = math.nan if plus_minus is None else float(plus_minus[i])
            shown = find_unit(robot.units[parameter.dimension])
            rows.append(
                _row_text(
                    parameter.name,
                    float(robot.values[i]),
                    deviation,
                    shown.factor_to_si,
                    shown.symbol,
                )
            )
    return "".join(rows)


def table_values(file: YamlFile, robot: Mechanism) -> np.ndarray:
    """Return the robot's values (p,) [SI] with those of the file's table put in.

    Raises
    ------
    FileError
        Not such a table, an unknown or repeated parameter, a value that is no number, a wrong unit.
    """
    rows = file.content[TABLE]
    if not isinstance(rows, list):
        raise file.error(
            "this table must be a list of '{name: .., value: .., unit: ..}'; see the file reference",
            (TABLE,),
        )
    values, seen = robot.values.copy(), set()
    for i, row in enumerate(rows):
        place = (TABLE, i)
        if not isinstance(row, dict):
            raise file.error(f"each row of this table must be {_ROW}; correct it", place)
        refuse_unknown_keys(file, list(row), KEYS, place)
        for key in (k for k in KEYS if k != PLUS_MINUS and k not in row):
            raise file.error(f"this row has no {key!r}, which is needed; write it as {_ROW}", place)
        name, value, symbol = row["name"], row["value"], row["unit"]
        if name not in robot.parameters.names:
            hint = suggest_names(str(name), robot.parameters.names)
            raise file.error(
                f"{name!r} is not a parameter of this robot{hint}; correct its name", place
            )
        if name in seen:
            raise file.error(
                f"parameter {name!r} stands here for the second time; keep one of the two", place
            )
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise file.error(
                f"the value of {name!r} is {value!r} where a number is needed; write a number",
                place,
            )
        index = robot.parameters.index(name)
        try:
            factor = find_unit(str(symbol), robot.parameters.dimensions[index]).factor_to_si
        except UnitError as error:
            raise file.error(f"the unit of {name!r}: {error}", place) from None
        values[index] = value * factor
        seen.add(name)
    return values


def nominal_text(file: YamlFile) -> str:
    """Return a robot file's text without its `identified:` table: from its key to the next key at
    the left margin.
    """
    lines = file.text.split("\n")
    if TABLE not in file.content:
        return file.text
    start = file.line((TABLE,)) - file.first_line
    end = start + 1
    while end < len(lines) and (not lines[end] or lines[end][0] in " \t-}]"):
        end += 1
    return "\n".join(lines[:start] + lines[end:]).rstrip("\n") + "\n"


def _row_text(name: str, value: float, plus_minus: float, factor: float, symbol: str) -> str:
    """Return one line of the table; the value in the file's unit comes back to the same double
    where it can.
    """
    deviation = f"{plus_minus / factor:.2g}" if math.isfinite(plus_minus) else "null"
    quoted = json.dumps(symbol) if symbol[0].isdigit() else symbol
    return f"  - {{name: {name}, value: {shortest(value, factor)}, {PLUS_MINUS}: {deviation}, unit: {quoted}}}\n"
