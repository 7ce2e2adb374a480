# SPDX-License-Identifier: Apache-2.0
"""From a file of another program to a robot file and a measurement file, and from a run back to it."""

from __future__ import annotations

import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import DataError, FileError, MechanismError
from loopcal.io.core.text_file import write_text
from loopcal.io.data.measurement_writer import save_measurements
from loopcal.io.formats import FORMATS
from loopcal.io.formats.program_format import Exported, ExportSource, Format, Imported
from loopcal.io.robot.robot_file import load_robot
from loopcal.io.runs.calibration_run import load_run_or_robot

if TYPE_CHECKING:
    from loopcal.mechanism import Mechanism


def choose_format(path: Path, name: str | None) -> Format:
    """The format by name, or by the ending of a file.

    Raises
    ------
    FileError
        The ending tells no format.
    """
    if name is not None:
        return FORMATS[name]
    for found in FORMATS.values():
        if path.suffix.lower() in found.endings:
            return found
    raise FileError(
        f"the name of this file tells no format; state one as --format, of {', '.join(FORMATS)}",
        path,
    )


def build_imported_robot(path: Path, imported: Imported) -> Mechanism:
    """Build the robot that was read, before anything is written.

    Raises
    ------
    MechanismError
        It cannot be built; told with the name of the file it came from.
    """
    with tempfile.TemporaryDirectory() as folder:
        robot_file = Path(folder) / "robot.yaml"
        write_text(robot_file, imported.robot_text)
        try:
            return load_robot(robot_file)
        except MechanismError as error:
            raise MechanismError(f"{path}: {str(error).removeprefix(f'{robot_file}: ')}") from error


def save_imported(path: Path, imported: Imported, output: Path, data: Path | None) -> Mechanism:
    """Write the robot file, and the measurement file where one is asked for; return the robot.

    Raises
    ------
    DataError
        Measurements are asked for, but there are none.
    FileError, MechanismError
        A file cannot be written, or the robot cannot be built.
    """
    robot = build_imported_robot(path, imported)
    if data is not None:
        if imported.measurements is None:
            raise DataError(
                f"{path}: there are no measurements in this file; leave out --data and "
                "--corrected, or measure first"
            )
        save_measurements(imported.measurements, data, robot, f"read from {path.name}")
    write_text(output, imported.robot_text)
    return load_robot(output)


def load_source(path: str | Path) -> ExportSource:
    """What to export: a run folder, a robot file, or the name of a shipped robot.

    Raises
    ------
    FileError
        None of these.
    """
    run = load_run_or_robot(path)
    rows = run.result.get("fit", {}).get("parameters", [])
    nulls = run.result.get("nulls", {})
    why = {
        row["name"]: nulls.get(f"fit/parameters/{i}/plus_minus", "not known")
        for i, row in enumerate(rows)
        if row["plus_minus"] is None
    }
    return ExportSource(run.robot, {row["name"]: row["plus_minus"] for row in rows}, why)


def export_robot(source: ExportSource, target: Format, into: Path | None) -> Exported:
    """The text of a source in a format.

    Raises
    ------
    DataError
        The format is read only, or holds no other robot's file to correct.
    FileError
        The file to correct cannot be read, or is of another kind.
    """
    if target.write is None:
        raise DataError(
            f"loopcal reads the format {target.name}, but does not write it; known are "
            f"{', '.join(names('write'))}"
        )
    if into is not None and not target.takes_file:
        raise DataError(f"the format {target.name} is written whole; leave out --into")
    return target.write(source, into)


def names(what: str) -> Collection[str]:
    """Names of the formats that can be read, or written."""
    return [name for name, found in FORMATS.items() if getattr(found, what) is not None]
