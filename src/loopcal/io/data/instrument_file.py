# SPDX-License-Identifier: Apache-2.0
"""The instrument that a measurement file describes: its kinds, their frames and their noise,
without what it measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import FileError
from loopcal.io.core.csv_table import Table, read_table
from loopcal.io.data.kind_rows import Sensor as Found
from loopcal.io.data.kind_rows import read_sensors
from loopcal.units import EXAMPLES

if TYPE_CHECKING:
    from loopcal.measure import Instrument
    from loopcal.mechanism import Mechanism


def load_instrument(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file, which looks at every pose.

    Raises
    ------
    FileError
        What does not fit, at its line; noise that is not in the settings.
    """
    table = read_table(path)
    return _instrument(table, read_sensors(table, robot))


def load_instrument_to_plan(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file as `load_instrument` does, where all its sensors
    can look at every pose.

    Raises
    ------
    FileError
        As there; or each group of rows has unknowns of its own, such as a surface, which a choice
        of poses does not give.
    """
    table = read_table(path)
    found = read_sensors(table, robot)
    groups = table.text("group") if "group" in table.units else ("",) * len(table.rows)
    poses = table.text("pose") if "pose" in table.units else tuple(map(str, range(len(table.rows))))
    apart = len({frozenset(poses[row] for row in sensor.rows) for sensor in found}) > 1
    for sensor in found:
        own = [
            parameter.name
            for parameter in sensor.kind.nuisance_parameters
            if parameter.scope == "group"
        ]
        if own and (apart or len({groups[row] for row in sensor.rows}) > 1):
            surfaces = sensor.kind.name in ("plane", "line")
            remedy = (
                "plan planes and lines with --measure plane-line"
                if surfaces
                else "describe the instrument by options"
            )
            raise table.settings.error(
                f"the rows of kind {sensor.kind.name!r} have unknowns of their own group by group "
                f"({', '.join(own)}), and no "
                f"pose is seen by all of them; {remedy}",
                sensor.location,
            )
    return _instrument(table, found)


def refuse_readings_to_measure(path: str | Path, robot: Mechanism) -> None:
    """Refuse a sheet whose readings are empty because they are what is measured, where poses are to
    come from readings.

    Raises
    ------
    FileError
        No reading of any actuator is stated.
    """
    table = read_table(path)
    columns = [actuator.name for actuator in robot.actuators if actuator.name in table.units]
    if columns and table.rows and not any(cell for name in columns for cell in table.text(name)):
        raise FileError(
            "every reading in this sheet is empty, because the machine is to be moved until a "
            "measuring machine shows the held "
            "coordinates, which is not simulated; fill in the readings, or simulate a plan of poses",
            table.path,
        )


def _instrument(table: Table, found: Sequence[Found]) -> Instrument:
    """Return the sensors of a table, with the noise that its settings state."""
    import numpy as np

    from loopcal.measure import Gaussian, Instrument, Sensor

    sensors = []
    for one in found:
        columns = one.kind.noise_columns
        for column in columns:
            if column.name not in one.noise:
                example = f"noise: {{{column.name}: {EXAMPLES[column.dimension]}}}"
                sentence = f"the settings state no noise of {column.name!r}, which a plan needs; add '{example}'"
                raise table.settings.error(sentence, (*one.location, "noise"))
        sensors.append(
            Sensor(one.kind, Gaussian(np.array([one.noise[column.name] for column in columns])))
        )
    return Instrument(tuple(sensors))
