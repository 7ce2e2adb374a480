# SPDX-License-Identifier: Apache-2.0
"""The instrument of a measurement file: its kinds, frames and noise, without measured values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io.core.csv_table import Table, read_table
from loopcal.io.data.kind_rows import KindRows, read_kinds
from loopcal.mechanism import Mechanism
from loopcal.units import EXAMPLES

if TYPE_CHECKING:
    from loopcal.measure import Instrument


def load_instrument(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file, which measures every pose.

    Raises
    ------
    FileError : a value that does not fit, at its line; noise that the settings do not state.
    """
    table = read_table(path)
    return _build_instrument(table, read_kinds(table, robot))


def load_instrument_to_plan(path: str | Path, robot: Mechanism) -> Instrument:
    """Return the instrument of a measurement file for planning poses.

    Raises
    ------
    FileError
        As `load_instrument`; or each group of rows has setup parameters of its own, such as a
        surface, which a choice of poses does not determine.
    """
    table = read_table(path)
    kinds = read_kinds(table, robot)
    groups, poses = table.text("group"), table.pose_names()
    apart = len({frozenset(poses[row] for row in one.rows) for one in kinds}) > 1
    for one in kinds:
        own = [
            parameter.name
            for parameter in one.kind.nuisance_parameters
            if parameter.scope == "group"
        ]
        if own and (apart or len({groups[row] for row in one.rows}) > 1):
            is_surface = one.kind.name in {"plane", "line"}
            code = "files.surfaces-in-plan" if is_surface else "files.groups-in-plan"
            raise table.settings.error(
                report_finding(code, kind=one.kind.name, parameters=tuple(own)), one.location
            )
    return _build_instrument(table, kinds)


def refuse_empty_readings(path: str | Path, robot: Mechanism) -> None:
    """Raise FileError for a sheet without any reading, where poses are to come from readings."""
    table = read_table(path)
    columns = [actuator.name for actuator in robot.actuators if actuator.name in table.units]
    if columns and table.rows and not any(cell for name in columns for cell in table.text(name)):
        sentence = "this sheet has no readings, because they are what is to be measured"
        act = "fill in the readings, or simulate a plan of poses"
        raise FileError(f"{sentence}; {act}", table.path)


def _build_instrument(table: Table, kinds: Sequence[KindRows]) -> Instrument:
    """Return the instrument with the noise that the settings of a table state."""
    from loopcal.measure import Gaussian, Instrument, Sensor

    sensors = []
    for one in kinds:
        for column in one.kind.noise_columns:
            if column.name not in one.noise:
                example = f"noise: {{{column.name}: {EXAMPLES[column.dimension]}}}"
                sentence = f"the settings state no noise of {column.name!r}; add '{example}'"
                raise table.settings.error(sentence, (*one.location, "noise"))
        sigma = np.array([one.noise[column.name] for column in one.kind.noise_columns])
        sensors.append(Sensor(one.kind, Gaussian(sigma)))
    return Instrument(tuple(sensors))
