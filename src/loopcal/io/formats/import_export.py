# SPDX-License-Identifier: Apache-2.0
"""From a file of another program to a robot file and a measurement file, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from loopcal.errors import DataError, FileError, MechanismError
from loopcal.findings import report_finding
from loopcal.io.core.text_file import write_text
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.data.measurement_writer import save_measurements
from loopcal.io.formats import FORMATS
from loopcal.io.formats.program_format import Exported, ExportSource, Format, Imported
from loopcal.io.robot.robot_file import build_robot, load_robot
from loopcal.io.runs.run_folder import Run, load_run_or_robot
from loopcal.mechanism.model import Mechanism


def list_formats(ability: Literal["read", "write"]) -> tuple[str, ...]:
    """Return the names of the formats that can be read, or written."""
    return tuple(name for name, known in FORMATS.items() if getattr(known, ability) is not None)


def choose_format(path: Path, name: str | None, *, is_written: bool = False) -> Format:
    """Return the format of this name, or the one with the ending of a file to read or to write.

    Raises
    ------
    DataError : there is no format of this name. FileError : no format has this ending.
    """
    if name is not None:
        return FORMATS[name]
    for entry in FORMATS.values():
        if path.suffix.lower() in entry.endings:
            return entry
    names = list_formats("write" if is_written else "read")
    raise FileError(report_finding("files.format-unknown", formats=names), path)


def build_imported_robot(path: Path, imported: Imported) -> Mechanism:
    """Build the imported robot before anything is written.

    Raises
    ------
    FileError, MechanismError : it cannot be built; with the name of the file that it came from. The
        lines of its text are not those of that file.
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
    """Write the robot file and, where `data` names one, the measurement file; return the robot.

    Raises
    ------
    DataError : there are no measurements to write.
    FileError, MechanismError : a file cannot be written, or the robot cannot be built.
    """
    robot = build_imported_robot(path, imported)
    if data is not None:
        if imported.measurements is None:
            raise DataError(report_finding("files.no-measurements", file=str(path)))
        save_measurements(imported.measurements, data, robot, f"read from {path.name}")
    write_text(output, imported.robot_text)
    return load_robot(output)


def load_source(path: str | Path) -> ExportSource:
    """Return the robot of a run folder, a robot file, or a shipped robot by its name, to export."""
    return build_source(load_run_or_robot(path))


def build_source(run: Run) -> ExportSource:
    """Return the robot of a run to export, with its intervals."""
    rows = run.result.get("fit", {}).get("parameters", [])
    nulls = run.result.get("nulls", {})
    reasons = {
        row["name"]: nulls.get(f"fit/parameters/{i}/plus_minus", "unknown")
        for i, row in enumerate(rows)
        if row["plus_minus"] is None
    }
    return ExportSource(run.robot, {row["name"]: row["plus_minus"] for row in rows}, reasons)


def export_robot(source: ExportSource, target: Format, into: Path | None) -> Exported:
    """Return the text of a source in a format.

    Raises
    ------
    DataError : the format is read only, or cannot correct an existing file.
    FileError : the file to correct cannot be read, or is of another kind.
    """
    if target.write is None:
        known = ", ".join(list_formats("write"))
        raise DataError(f"loopcal cannot write the format {target.name}; it writes {known}")
    if into is not None and not target.takes_file:
        raise DataError(report_finding("files.format-takes-no-file", format=target.name))
    return target.write(source, into)
