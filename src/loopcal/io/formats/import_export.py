# SPDX-License-Identifier: Apache-2.0
"""From a file of another program to a robot file and a measurement file, and back.

Programs that loopcal does not know get the identified parameters as JSON or CSV: numbers in the
units of the robot file, which read back as the same doubles. `plus_minus` is half of the 95 %
interval, empty (null in JSON) where it is unknown or not finite.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from loopcal.errors import DataError, FileError, MechanismError
from loopcal.findings import Finding, Severity, report_finding
from loopcal.io.core.csv_table import format_columns
from loopcal.io.core.text_file import read_text, write_text
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.data.measurement_file import save_measurements
from loopcal.io.formats import FORMATS
from loopcal.io.formats.probe_reports import ANSWER
from loopcal.io.formats.program_format import Exported, ExportSource, Format, Imported
from loopcal.io.robot.robot_file import build_robot, load_robot
from loopcal.io.runs.run_folder import Run
from loopcal.mechanism.model import Mechanism
from loopcal.units import find_unit, format_scaled

APPLY = "values.apply"  # begin of the codes of recommendations to use the values


def list_formats(ability: Literal["read", "write"]) -> tuple[str, ...]:
    """Return the names of the formats that can be read, or written."""
    return tuple(name for name, known in FORMATS.items() if getattr(known, ability) is not None)


def choose_format(path: Path, name: str | None, *, is_written: bool = False) -> Format:
    """Return the format of this name (DataError for another), or the one with the ending of a file
    to read or to write (FileError for another).
    """
    if name is not None:
        return FORMATS[name]
    for entry in FORMATS.values():
        if path.suffix.lower() in entry.endings:
            return entry
    if not is_written and path.is_file() and ANSWER.search(read_text(path, "G-code file")):
        raise FileError.of("files.report-first", path)
    names = list_formats("write" if is_written else "read")
    raise FileError.of("files.format-unknown", path, formats=names)


def recognize_format(path: Path, text: str) -> str | None:
    """Return the name of the format of a file by its ending and text; None without one."""
    readable = [FORMATS[name] for name in list_formats("read")]
    fitting = [entry for entry in readable if re.search(entry.mark or "(?!)", text)]
    plain = [entry for entry in readable if not entry.mark]
    of_ending = [e for e in (*fitting, *plain) if path.suffix.lower() in e.endings]
    return next((entry.name for entry in (*of_ending, *fitting)), None)


def build_imported_robot(path: Path, imported: Imported) -> Mechanism:
    """Build the imported robot before anything is written; errors name the file that it came from,
    as the lines of its text are not those of that file.
    """
    try:
        return build_robot(parse_yaml(imported.robot_text, path, "robot file"))
    except FileError as error:
        raise FileError(imported.doubt or error.sentence, path) from error
    except MechanismError as error:
        if imported.doubt is None:
            raise
        raise FileError(imported.doubt, path) from error


def save_imported(path: Path, imported: Imported, output: Path, data: Path | None) -> Mechanism:
    """Write the robot file and, where `data` names one, the measurement file (DataError where
    nothing was measured); return the robot.
    """
    robot = build_imported_robot(path, imported)
    if data is not None:
        if imported.measurements is None:
            reason = " ".join(
                str(f) for f in imported.findings if f.severity is Severity.SUGGESTION
            )
            raise DataError.of("files.no-measurements", file=str(path), reason=reason)
        save_measurements(imported.measurements, data, robot, f"read from {path.name}")
    write_text(output, imported.robot_text)
    return load_robot(output)


def build_source(run: Run) -> ExportSource:
    """Return the robot of a run to export, with its intervals."""
    rows = run.result.get("fit", {}).get("parameters", [])
    nulls = run.result.get("nulls", {})
    reasons = {
        row["name"]: nulls.get(f"fit/parameters/{i}/plus_minus", "unknown")
        for i, row in enumerate(rows)
        if row["plus_minus"] is None
    }
    advice = run.result.get("recommendation") or {"code": APPLY}
    told = () if advice["code"].startswith(APPLY) else (advice["text"],)
    doubts = tuple(report_finding("files.values-not-recommended", reason=text) for text in told)
    stated = {row["name"]: row["plus_minus"] for row in rows}
    return ExportSource(run.robot, stated, reasons, findings=doubts)


def export_robot(source: ExportSource, target: Format, into: Path | None) -> Exported:
    """Return the text of a source in a format; DataError where it is read only, or cannot correct
    an existing file.
    """
    if target.write is None:
        known = ", ".join(list_formats("write"))
        raise DataError(f"loopcal cannot write the format {target.name}; it writes {known}")
    if target.table is not None and not source.tables:
        raise DataError(f"the format {target.name} is a table of corrections. Give its tables")
    if into is not None and not target.takes_file:
        raise DataError.of("files.format-takes-no-file", format=target.name)
    exported = target.write(source, into)
    return replace(exported, findings=(*exported.findings, *source.findings))


COLUMNS = ("name", "nominal", "value", "plus_minus", "unit", "free")


def _list_rows(source: ExportSource) -> list[dict[str, Any]]:
    """Return one row for each parameter, numbers as text."""
    robot, rows = source.robot, []
    for parameter, value in zip(robot.parameters.entries, robot.values.tolist(), strict=True):
        unit = find_unit(robot.units[parameter.dimension])
        half = source.plus_minus.get(parameter.name)
        nominal, number = (format_scaled(v, unit.factor_to_si) for v in (parameter.nominal, value))
        free = "yes" if parameter.free else "no"
        cells = (parameter.name, nominal, number, "" if half is None else repr(half))
        rows.append(dict(zip(COLUMNS, (*cells, unit.symbol, free), strict=True)))
    return rows


def write_csv(source: ExportSource, into: Path | None) -> Exported:
    """Return the parameters as CSV."""
    rows = _list_rows(source)
    text = format_columns({name: [row[name] for row in rows] for name in COLUMNS})
    return Exported(text, _report_intervals(source))


def write_json(source: ExportSource, into: Path | None) -> Exported:
    """Return the parameters as one JSON document."""
    rows = [
        {**row, "nominal": float(row["nominal"]), "value": float(row["value"])}
        | {"plus_minus": source.plus_minus.get(row["name"]), "free": row["free"] == "yes"}
        for row in _list_rows(source)
    ]
    document = {"format": 1, "robot": source.robot.name, "parameters": rows}
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
