# SPDX-License-Identifier: Apache-2.0
"""Identified parameters as JSON or CSV, for programs that loopcal does not know: name, nominal,
value, +/-, unit.

Numbers are in the units of the robot's file and read back as the same doubles. `plus_minus` is half
of the 95 % interval, empty (null in JSON) where it is not known or not finite.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from loopcal.io.core.numbers import format_scaled
from loopcal.io.formats.program_format import Exported, ExportSource, Format
from loopcal.units import find_unit

FORMAT = 1
COLUMNS = ("name", "nominal", "value", "plus_minus", "unit", "free")


def rows(source: ExportSource) -> Iterator[dict[str, Any]]:
    """One row for each parameter, numbers as text."""
    robot = source.robot
    for parameter, value in zip(robot.parameters.entries, robot.values.tolist(), strict=True):
        shown = find_unit(robot.units[parameter.dimension])
        half = source.plus_minus.get(parameter.name)
        yield {
            "name": parameter.name,
            "nominal": format_scaled(parameter.nominal, shown.factor_to_si),
            "value": format_scaled(value, shown.factor_to_si),
            "plus_minus": "" if half is None else repr(half),
            "unit": shown.symbol,
            "free": "yes" if parameter.free else "no",
        }


def to_csv(source: ExportSource, into: Path | None) -> Exported:
    """The table as CSV."""
    del into
    stream = io.StringIO()
    writer: csv.DictWriter[str] = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows(source))
    return Exported(stream.getvalue(), _notes(source))


def to_json(source: ExportSource, into: Path | None) -> Exported:
    """The table as one JSON document."""
    del into
    found = [
        {**row, "nominal": float(row["nominal"]), "value": float(row["value"])}
        | {"plus_minus": source.plus_minus.get(row["name"]), "free": row["free"] == "yes"}
        for row in rows(source)
    ]
    document = {"format": FORMAT, "robot": source.robot.name, "parameters": found}
    return Exported(
        json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n", _notes(source)
    )


def _notes(source: ExportSource) -> tuple[str, ...]:
    if source.plus_minus:
        return tuple(f"{name}: +/- is not given ({why})" for name, why in source.nulls.items())
    return ("intervals come from a run; export the run folder to have them",)


JSON = Format("json", "identified parameters as JSON", (".json",), write=to_json, takes_file=False)
CSV = Format("csv", "identified parameters as CSV", (".csv",), write=to_csv, takes_file=False)
