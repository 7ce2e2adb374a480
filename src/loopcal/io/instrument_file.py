# SPDX-License-Identifier: Apache-2.0
"""The instrument that a measurement file describes: its kinds, their frames and their noise, without what it measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.io.csv_table import read_table
from loopcal.io.sensor_rows import read_sensors
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
    import numpy as np

    from loopcal.measure import Gaussian, Instrument, Sensor

    table = read_table(path)
    sensors = []
    for found in read_sensors(table, robot):
        columns = found.kind.noise_columns
        for column in columns:
            if column.name not in found.noise:
                example = f"noise: {{{column.name}: {EXAMPLES[column.dimension]}}}"
                sentence = f"the settings state no noise of {column.name!r}, which a plan needs; add '{example}'"
                raise table.settings.error(sentence, (*found.location, "noise"))
        sensors.append(Sensor(found.kind, Gaussian(np.array([found.noise[column.name] for column in columns]))))
    return Instrument(tuple(sensors))
