# SPDX-License-Identifier: Apache-2.0
"""Identified parameters as JSON or CSV, for programs that loopcal does not know.

Numbers are in the units of the robot file and read back as the same doubles. `plus_minus` is half
of the 95 % interval, empty (null in JSON) where it is unknown or not finite.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from loopcal.findings import Finding, report_finding
from loopcal.io.core.csv_table import format_scaled
from loopcal.io.formats.program_format import Exported, ExportSource, Format
from loopcal.units import find_unit

FORMAT = 1
COLUMNS = ("name", "nominal", "value", "plus_minus", "unit", "free")


def list_rows(source: ExportSource) -> Iterator[dict[str, Any]]:
    """Yield one row for each parameter, numbers as text."""
    robot = source.robot
    for parameter, value in zip(robot.parameters.entries, robot.values.tolist(), strict=True):
        unit = find_unit(robot.units[parameter.dimension])
        half = source.plus_minus.get(parameter.name)
        yield {
            "name": parameter.name,
            "nominal": format_scaled(parameter.nominal, unit.factor_to_si),
            "value": format_scaled(value, unit.factor_to_si),
            "plus_minus": "" if half is None else repr(half),
            "unit": unit.symbol,
            "free": "yes" if parameter.free else "no",
        }


def write_csv(source: ExportSource, into: Path | None) -> Exported:
    """Return the table as CSV."""
    del into
    stream = io.StringIO()
    writer: csv.DictWriter[str] = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
    writer.writeheader()
    rows = list(list_rows(source))
    writer.writerows(rows)

    return Exported(stream.getvalue(), _report_intervals(source))


def write_json(source: ExportSource, into: Path | None) -> Exported:
    """Return the table as one JSON document."""
    del into
    rows = [
        {**row, "nominal": float(row["nominal"]), "value": float(row["value"])}
        | {"plus_minus": source.plus_minus.get(row["name"]), "free": row["free"] == "yes"}
        for row in list_rows(source)
    ]
    document = {"format": FORMAT, "robot": source.robot.name, "parameters": rows}
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)

    return Exported(text + "\n", _report_intervals(source))


def _report_intervals(source: ExportSource) -> tuple[Finding, ...]:
    """Return which intervals are missing."""
    if not source.plus_minus:
        return (report_finding("files.intervals-need-run"),)
    return tuple(
        report_finding("files.interval-missing", name=name, reason=reason)
        for name, reason in source.nulls.items()
    )


JSON = Format("json", "identified parameters as JSON", (".json",), None, write_json, False)
CSV = Format("csv", "identified parameters as CSV", (".csv",), None, write_csv, False)
